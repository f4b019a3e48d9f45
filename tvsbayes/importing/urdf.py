"""A head in a URDF: nominal terms from two of its joints.

The base is the parent link of the pan joint, z up; the beam is x of the child link of the tilt joint (REP 103). Joints
turn by the right-hand rule about their axes: a tilt joint about +y lowers the beam. URDF: m and rad, `rpy` about fixed
axes; terms in mm and degrees. Numbers are what XML says, by expat. Positions of elements are those in UTF-8.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple
from xml.parsers import expat

import numpy as np

from tvsbayes.errors import InputError, closest, escaped, listed, plural, refusal, shown
from tvsbayes.files.csv_table import NUMBER

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

URDF_BYTES_MAX, TAGS_MAX = 10 * 1024 * 1024, 400_000
MOVING = ("revolute", "continuous")
WORDS = {"pan": ("pan", "yaw", "azimuth"), "tilt": ("tilt", "pitch", "elevation")}
"""Parts of names by which joints are found where the user names none."""
LEAN_MAX_DEG = 30.0
PARALLEL_DEG = 45.0
"""Least angle between both axes, and between beam and tilt axis, of a head."""
NUMBER_MAX, REDUCTION_MIN = 1e6, 1e-6
"""Largest m, rad or reduction, and least reduction: motors of heads have 1 to 10 000."""
SAME = 1e-12
"""Change of a number below which its text is kept, and length of an axis that has no direction."""
PROPERTY = "xacro:property"
DEPTH_MAX, LISTED, TEXT_MAX = 100, 20, 100
_LEAN = "azimuth_axis_tilt_deg"


@dataclass
class Tag:
    """An element: its attributes, text and children; bytes of its start tag and, up to its end tag, of its content."""

    name: str
    attributes: Mapping[str, str]
    file: str
    line: int
    begin: int
    end: int
    children: list[Tag] = field(default_factory=list)
    text: str = ""
    content_end: int = 0

    def first(self, name: str) -> Tag | None:
        """The first descendant with this name."""
        tags = (child if child.name == name else child.first(name) for child in self.children)
        return next((tag for tag in tags if tag is not None), None)

    def named(self, part: str, attribute: str) -> str:
        """A text attribute of a descendant, "" if absent."""
        tag = self.first(part)
        return "" if tag is None else tag.attributes.get(attribute, "")

    def refuse(self, found: str, allowed: str, remedy: str) -> InputError:
        """The refusal of this element."""
        return refusal("urdf", file=self.file, line=self.line, found=found, allowed=allowed, remedy=remedy)

    def numbers(self, part: str, attribute: str, default: tuple[float, ...]) -> np.ndarray:
        """Numbers in an attribute of a descendant."""
        tag = self.first(part)
        text = None if tag is None else tag.attributes.get(attribute)
        if tag is None or text is None:
            return np.array(default)
        words = text.split()
        if len(words) != len(default) or not all(NUMBER.fullmatch(w) and abs(float(w)) <= NUMBER_MAX for w in words):
            allowed = f"{plural(len(default), 'finite number')} up to {NUMBER_MAX:g}"
            raise tag.refuse(f"{part} {attribute} {shown(text)}", allowed, "correct the numbers of the joint")
        return np.array(words, float)

    @property
    def type(self) -> str:
        """Type of a joint."""
        return self.attributes.get("type", "no type")

    @property
    def rotation(self) -> Rotation:
        """Rotation of a joint's origin."""
        from scipy.spatial.transform import Rotation

        return Rotation.from_euler("xyz", self.numbers("origin", "rpy", (0.0, 0.0, 0.0)))

    @property
    def shift_m(self) -> np.ndarray:
        """Translation of a joint's origin, shape (3,)."""
        return self.numbers("origin", "xyz", (0.0, 0.0, 0.0))

    @property
    def axis(self) -> np.ndarray:
        """Axis of a joint: unit vector in its frame, shape (3,)."""
        axis = self.numbers("axis", "xyz", (1.0, 0.0, 0.0))
        if not np.linalg.norm(axis) > SAME:
            raise (self.first("axis") or self).refuse("an axis of length 0", "a direction", "write a unit vector")
        return axis / np.linalg.norm(axis)


@dataclass(frozen=True)
class Urdf:
    """A parsed URDF: its text in UTF-8, and its element `robot`."""

    data: bytes
    root: Tag

    def listed(self, kind: str) -> dict[str, Tag]:
        """Elements of a kind directly below `robot`, by name."""
        return {tag.attributes.get("name", ""): tag for tag in self.root.children if tag.name == kind}

    def reduction(self, joint: str) -> Tag | None:
        """`mechanicalReduction` of the transmission of a joint, None where none is stated."""
        tags = (tag for tag in self.listed("transmission").values() if tag.named("joint", "name") == joint)
        return next((tag.first("mechanicalReduction") for tag in tags), None)


def read_urdf(data: bytes, file: str) -> Urdf:
    """Parse a URDF; refuses document types, entities, an unexpanded xacro, and two joints of one name."""
    # Without a mark the declaration is ASCII in all other encodings.
    declared = re.match(rb"\s*<\?xml[^>]*?\sencoding\s*=\s*[\"']([\w.-]+)", data)
    wide = data.startswith((b"\xff\xfe", b"\xfe\xff"))
    encoding = "utf-16" if wide else declared[1].decode() if declared else "utf-8"
    try:
        text = data.decode("utf-8-sig" if encoding.lower() in ("utf-8", "utf8") else encoding)
    except (LookupError, ValueError) as error:
        found, remedy = f"text that is not {escaped(encoding)}", "save it as UTF-8"
        raise refusal("urdf", file=file, found=found, allowed="XML", remedy=remedy) from error
    data = re.sub(r"\A(\s*<\?xml[^>]*?\sencoding\s*=\s*[\"'])[\w.-]+", r"\1UTF-8", text).encode()
    if text.count("<") > TAGS_MAX:
        found, remedy = f"more than {TAGS_MAX // 2} elements", "give a URDF file"
        raise refusal("size", file=file, found=found, allowed="a plain URDF", remedy=remedy)
    parser = expat.ParserCreate("utf-8")
    top = Tag("", {}, file, 0, 0, 0)
    path = [top]

    def refuse(found: str, allowed: str, remedy: str) -> InputError:
        return refusal("urdf", file=file, line=parser.CurrentLineNumber, found=found, allowed=allowed, remedy=remedy)

    def begin(name: str, attributes: dict[str, str]) -> None:
        at = parser.CurrentByteIndex
        # A ">" inside quotes does not end the tag.
        close = re.compile(rb"""(?:[^>"']|"[^"]*"|'[^']*')*>""").match(data, at)
        foreign = name.startswith("xacro:") and name != PROPERTY
        if foreign or any("${" in v or "$(" in v for v in attributes.values()):
            raise refuse("xacro that is not expanded", "a plain URDF", "run `xacro FILE > head.urdf`, and give that")
        if path[-1] is top and name != "robot":
            raise refuse(f"<{escaped(name)}>", "<robot>", "give a URDF; an SDF or MJCF converts to one")
        if len(path) > DEPTH_MAX:
            raise refuse(f"more than {DEPTH_MAX} elements in each other", "a plain URDF", "give a URDF file")
        tag = Tag(name, attributes, file, parser.CurrentLineNumber, at, close.end() if close else at)
        path[-1].children.append(tag)
        path.append(tag)

    def end(_: str) -> None:
        path.pop().content_end = parser.CurrentByteIndex

    def text_part(words: str) -> None:
        path[-1].text += words if len(path[-1].text) < TEXT_MAX else ""

    def doctype(*_: object) -> None:
        raise refuse("a document type", "a URDF without one", "remove the lines of <!DOCTYPE>")

    parser.StartElementHandler, parser.EndElementHandler = begin, end
    parser.CharacterDataHandler, parser.StartDoctypeDeclHandler = text_part, doctype
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise refuse(escaped(str(error)), "XML", "give a URDF file") from error
    first: dict[str, Tag] = {}
    for tag in (child for child in top.children[0].children if child.name == "joint"):
        other = first.setdefault(name := tag.attributes.get("name", ""), tag)
        if other is not tag:
            remedy = f"remove one of both, or give it a name of its own; the first is in line {other.line}"
            raise tag.refuse(f"a second joint {shown(name)}", "one joint of each name", remedy)
    return Urdf(data, top.children[0])


class Frames(NamedTuple):
    """Frames of a head with both joints at zero, in the base: pan stage, the beam's link, and the tilt axis (3,)."""

    stage: Rotation
    link: Rotation
    axis: np.ndarray

    @classmethod
    def of(cls, terms: Mapping[str, float]) -> Frames:
        """Build from terms in degrees: the chain of `instrument.chains` without flexure; x of the link is the beam."""
        from scipy.spatial.transform import Rotation

        rad = {name: math.radians(value) for name, value in terms.items()}
        lean = Rotation.from_rotvec([-rad[f"{_LEAN}.east"], rad[f"{_LEAN}.north"], 0.0])
        stage, skew = lean * Rotation.from_euler("Z", rad["azimuth_zero_deg"]), rad["axes_not_square_deg"]
        square = stage * Rotation.from_euler("X", skew)
        raised = Rotation.from_euler("YZX", [-rad["elevation_zero_deg"], -rad["beam_not_square_deg"], -skew])
        return cls(stage, square * raised, square.apply([0.0, 1.0, 0.0]))


@dataclass(frozen=True)
class HeadJoints:
    """Two joints of a URDF as a head; dictionaries by "pan" and "tilt".

    Attributes:
        urdf, names: the file, and the names of the joints.
        terms: nominal values, by the names of the head's terms; mm, degrees.
        sign: sense of a joint's motion where azimuth or elevation grows.
        height_m: distance of the tilt axis from the pan joint, along the pan axis.
        between: rotation and shift (m) from the child link of the pan joint to the parent link of the tilt joint.
        reductions: turns of the motor for one of the joint; None where not stated.
        limits_deg: lowest and highest angle from the zero, as azimuth or elevation grows; None where not stated.
    """

    urdf: Urdf
    names: Mapping[str, str]
    terms: Mapping[str, float]
    sign: Mapping[str, int]
    height_m: float
    between: tuple[Rotation, np.ndarray]
    reductions: Mapping[str, float | None]
    limits_deg: Mapping[str, tuple[float, float] | None]

    def joint(self, axis: str) -> Tag:
        """The joint of an axis."""
        return self.urdf.listed("joint")[self.names[axis]]


def head_joints(data: bytes, file: str, names: Mapping[str, str | None]) -> HeadJoints:
    """Read two joints of the URDF in `file` as a head; `names` by axis, None to find them in the file.

    Raises:
        InputError: a joint is missing, does not turn, or is not mounted on the other; a number is none or absurd; the
            axes are parallel, or the pan axis does not point upwards.
    """
    from scipy.spatial.transform import Rotation

    urdf = read_urdf(data, file)
    chosen, joints = _named(urdf, names, file), urdf.listed("joint")
    pan, tilt = (joints[chosen[axis]] for axis in WORDS)
    between = _between(joints, pan, tilt, file)
    # The place of the pan joint changes no term; a correction keeps it.
    first, _ = pan.rotation, pan.shift_m
    joint_frame = first * between[0] * tilt.rotation
    pan_axis, tilt_axis = first.apply(pan.axis), joint_frame.apply(tilt.axis)
    beam = joint_frame.apply([1.0, 0.0, 0.0])
    for one, other, what in (
        (pan_axis, tilt_axis, "the axes of both joints"),
        (beam, tilt_axis, "x of the tilt joint's child link, the beam, and the tilt axis"),
    ):
        angle = math.degrees(math.asin(min(1.0, float(np.linalg.norm(np.cross(one, other))))))
        if angle < PARALLEL_DEG:
            remedy = "name other joints by --pan-joint and --tilt-joint, or turn the link's frame so that x looks ahead"
            raise _refused(file, f"{what} stand at {angle:.0f} deg", "axes that cross", remedy)
    upwards = 1 if pan_axis[2] >= 0 else -1
    up = upwards * pan_axis
    level = math.hypot(up[0], up[1])
    lean = math.atan2(level, up[2])
    if math.degrees(lean) > LEAN_MAX_DEG:
        remedy = "pan is the joint that turns about the vertical: name it by --pan-joint; z of its parent link is up"
        found = f"the pan axis leans by {math.degrees(lean):.0f} deg"
        raise _refused(file, found, f"at most {LEAN_MAX_DEG:g} deg", remedy)
    north, east = (lean * up[k] / level if level > 0 else 0.0 for k in (0, 1))
    upright = Rotation.from_rotvec([-east, north, 0.0]).inv()
    across, sight = upright.apply(tilt_axis), upright.apply(beam)
    # The sense of counting in which the beam points forward at zero.
    sense = 1 if sight[0] * across[1] - sight[1] * across[0] >= 0 else -1
    x, y, z = sense * across
    azimuth, skew = math.atan2(-x, y), math.asin(max(-1.0, min(1.0, z)))
    ahead, aside, over = Rotation.from_euler("ZX", [azimuth, skew]).inv().apply(sight)
    angles = {
        "azimuth_zero_deg": azimuth,
        "elevation_zero_deg": math.atan2(over, ahead),
        f"{_LEAN}.north": north,
        f"{_LEAN}.east": east,
        "axes_not_square_deg": skew,
        "beam_not_square_deg": -math.asin(max(-1.0, min(1.0, aside))),
    }
    terms = {name: math.degrees(angle) for name, angle in angles.items()}
    place = first.apply(between[1] + between[0].apply(tilt.shift_m))
    ahead_m, aside_m, height_m = Frames.of(terms).stage.inv().apply(place)
    terms |= {"elevation_axis_offset_mm": 1000 * ahead_m, "beam_offset_mm.y": 1000 * aside_m}
    terms = {name: 0.0 if abs(value) < 1e3 * SAME else value for name, value in terms.items()}
    sign = {"pan": upwards, "tilt": -sense}
    limits = {axis: _limits_deg(joints[name], sign[axis]) for axis, name in chosen.items()}
    reductions = {axis: _reduction(urdf.reduction(name)) for axis, name in chosen.items()}
    return HeadJoints(urdf, chosen, terms, sign, height_m, between, reductions, limits)


def _limits_deg(joint: Tag, sign: int) -> tuple[float, float] | None:
    tag = joint.first("limit")
    if joint.type == "continuous" or tag is None:
        return None
    lower, upper = (float(joint.numbers("limit", end, (0.0,))[0]) for end in ("lower", "upper"))
    if not lower < upper:
        raise tag.refuse(f"lower {lower:g}, upper {upper:g}", "lower < upper, rad", "exchange or correct them")
    low, high = sorted(math.degrees(sign * end) for end in (lower, upper))
    return low, high


def _reduction(tag: Tag | None) -> float | None:
    if tag is None:
        return None
    text = tag.text.strip()
    if not NUMBER.fullmatch(text) or not REDUCTION_MIN <= abs(float(text)) <= NUMBER_MAX:
        allowed = f"a number from {REDUCTION_MIN:g} to {NUMBER_MAX:g}, of either sign"
        remedy = "state turns of the motor for one of the joint, or remove the element"
        raise tag.refuse(f"mechanicalReduction {shown(text)}", allowed, remedy)
    return float(text)


def _refused(file: str, found: str, allowed: str, remedy: str) -> InputError:
    return refusal("urdf-joint", file=file, found=found, allowed=allowed, remedy=remedy)


def _named(urdf: Urdf, names: Mapping[str, str | None], file: str) -> dict[str, str]:
    """The joints by axis: as the user names them, else by parts of their names, else the only two revolute joints."""
    joints = urdf.listed("joint")
    turning = [name for name, joint in joints.items() if joint.type in MOVING]
    allowed = "joints that turn: " + (escaped(listed(turning, LISTED), 400) or "none")
    joint_names: dict[str, str] = {}
    for k, axis in enumerate(WORDS):
        name = names[axis]
        if name is None:
            like = [one for one in turning if any(word in one.lower() for word in WORDS[axis])]
            like = like if len(like) == 1 else turning[k : k + 1] if len(turning) == len(WORDS) else []
            if not like:
                raise _refused(file, f"no {axis} joint by its name", allowed, f"name it by --{axis}-joint")
            name = like[0]
        elif name not in joints:
            raise _refused(file, f"no joint {escaped(name)}", allowed, closest(name, joints, "name one of them"))
        elif name not in turning:
            what = f"joint {escaped(name)} is {escaped(joints[name].type)}"
            raise _refused(file, what, allowed, "name a joint that is revolute or continuous")
        joint_names[axis] = name
    if joint_names["pan"] == joint_names["tilt"]:
        what, remedy = f"{escaped(joint_names['pan'])} twice", "name two joints by --pan-joint and --tilt-joint"
        raise _refused(file, what, allowed, remedy)
    return joint_names


def _between(joints: Mapping[str, Tag], pan: Tag, tilt: Tag, file: str) -> tuple[Rotation, np.ndarray]:
    """Transform from the child link of the pan joint to the parent link of the tilt joint, over fixed joints."""
    from scipy.spatial.transform import Rotation

    above = {joint.named("child", "link"): joint for joint in joints.values()}
    turn, shift, link = Rotation.identity(), np.zeros(3), tilt.named("parent", "link")
    for _ in joints:
        if link == pan.named("child", "link"):
            return turn, shift
        joint = above.get(link)
        if joint is None or joint.type != "fixed":
            break
        turn, shift = joint.rotation * turn, joint.shift_m + joint.rotation.apply(shift)
        link = joint.named("parent", "link")
    found, remedy = "a tilt joint that is not mounted on the pan joint", "exchange the names, or name other joints"
    raise _refused(file, found, "a tilt joint on the child link of the pan joint, fixed joints between them", remedy)
