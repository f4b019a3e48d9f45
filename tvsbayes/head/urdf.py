"""A head in a URDF: nominal terms from two of its joints, and the same file with the estimated terms.

The base is the parent link of the pan joint, z up; the beam is x of the child link of the tilt joint (REP 103). Joints
turn by the right-hand rule about their axes: a tilt joint about +y lowers the beam. URDF: m and rad, `rpy` about fixed
axes; terms in mm and degrees. Text that does not change is kept byte for byte.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple
from xml.parsers import expat

import numpy as np

from tvsbayes.errors import InputError, closest, escaped, listed, refusal
from tvsbayes.instrument.axes import AXES, FULL_TURN_DEG

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

URDF_BYTES_MAX = 32 * 1024 * 1024
MOVING = ("revolute", "continuous")
WORDS = {"pan": ("pan", "yaw", "azimuth"), "tilt": ("tilt", "pitch", "elevation")}
"""Parts of names by which joints are found where the user names none."""
LEAN_MAX_DEG = 30.0
PARALLEL_DEG = 45.0
"""Least angle between both axes, and between beam and tilt axis, of a head."""
SAME = 1e-12
"""Change of a number below which its text is kept."""
CORRECTS = "head_corrects"
PROPERTY = "xacro:property"
DEPTH_MAX, LISTED = 100, 20
_LEAN = "azimuth_axis_tilt_deg"


@dataclass
class _Tag:
    """An element: its start tag and text with their positions in the file, and its child elements."""

    name: str
    attributes: Mapping[str, str]
    begin: int
    end: int
    children: list[_Tag] = field(default_factory=list)
    text: str = ""
    text_begin: int = 0

    def first(self, name: str) -> _Tag | None:
        """The first descendant with this name."""
        tags = (child if child.name == name else child.first(name) for child in self.children)
        return next((tag for tag in tags if tag is not None), None)

    def named(self, part: str, attribute: str) -> str:
        """A text attribute of a descendant, "" if absent."""
        tag = self.first(part)
        return "" if tag is None else tag.attributes.get(attribute, "")

    def numbers(self, part: str, attribute: str, default: tuple[float, ...]) -> np.ndarray:
        """Numbers in an attribute of a descendant."""
        tag = self.first(part)
        text = None if tag is None else tag.attributes.get(attribute)
        values = default if text is None else tuple(map(float, text.split()))
        if len(values) != len(default) or not all(map(math.isfinite, values)):
            raise ValueError(f"{part} {attribute}={text!r}: {len(default)} numbers are expected")
        return np.array(values)

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
        if not np.linalg.norm(axis) > 0:
            raise ValueError("axis 0 0 0")
        return axis / np.linalg.norm(axis)


@dataclass(frozen=True)
class Urdf:
    """A parsed URDF: its bytes, and its element `robot`."""

    data: bytes
    root: _Tag

    def listed(self, kind: str) -> dict[str, _Tag]:
        """Elements of a kind directly below `robot`, by name."""
        return {tag.attributes.get("name", ""): tag for tag in self.root.children if tag.name == kind}

    def reduction(self, joint: str) -> _Tag | None:
        """`mechanicalReduction` of the transmission of a joint, None where none is stated."""
        tags = (tag for tag in self.listed("transmission").values() if tag.named("joint", "name") == joint)
        return next((tag.first("mechanicalReduction") for tag in tags), None)


def read_urdf(data: bytes, file: str) -> Urdf:
    """Parse a URDF.

    Raises:
        InputError: not XML, a document type declaration, no robot, or an unexpanded xacro.
    """
    parser = expat.ParserCreate()
    path = [_Tag("", {}, 0, 0)]
    top = path[0]

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
        tag = _Tag(name, attributes, at, close.end() if close else at)
        path[-1].children.append(tag)
        path.append(tag)

    def text(words: str) -> None:
        if words.strip() and not path[-1].text:
            path[-1].text, path[-1].text_begin = words, parser.CurrentByteIndex

    def doctype(*_: object) -> None:
        raise refuse("a document type", "a URDF without one", "remove the lines of <!DOCTYPE>")

    parser.StartElementHandler, parser.EndElementHandler = begin, lambda _: path.pop() and None
    parser.CharacterDataHandler, parser.StartDoctypeDeclHandler = text, doctype
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise refuse(escaped(str(error)), "XML", "give a URDF file") from error
    return Urdf(data, top.children[0])


@dataclass(frozen=True)
class _Frames:
    """Frames of a head with both joints at zero, in the base: pan stage, the beam's link, and the tilt axis (3,)."""

    stage: Rotation
    link: Rotation
    axis: np.ndarray

    @classmethod
    def of(cls, terms: Mapping[str, float]) -> _Frames:
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
    """Two joints of a URDF as a head.

    Attributes:
        urdf: the file.
        names: names of the joints, by axis.
        terms: nominal values, by the names of the head's terms; mm, degrees.
        sign: sense of a joint's motion where azimuth or elevation grows, by axis.
        height_m: distance of the tilt axis from the pan joint, along the pan axis.
        between: rotation and shift (m) from the child link of the pan joint to the parent link of the tilt joint.
    """

    urdf: Urdf
    names: Mapping[str, str]
    terms: Mapping[str, float]
    sign: Mapping[str, int]
    height_m: float
    between: tuple[Rotation, np.ndarray]

    def joint(self, axis: str) -> _Tag:
        """The joint of an axis."""
        return self.urdf.listed("joint")[self.names[axis]]

    def reduction(self, axis: str) -> float | None:
        """`mechanicalReduction` of its transmission, None where none is stated."""
        tag = self.urdf.reduction(self.names[axis])
        return None if tag is None else float(tag.text)

    def limits_deg(self, axis: str) -> tuple[float, float] | None:
        """Lowest and highest angle from the joint's zero, in the sense of azimuth or elevation; None without limits."""
        joint = self.joint(axis)
        if joint.type == "continuous" or joint.first("limit") is None:
            return None
        ends = [float(joint.numbers("limit", end, (0.0,))[0]) for end in ("lower", "upper")]
        low, high = sorted(math.degrees(self.sign[axis] * end) for end in ends)
        return low, high


def head_joints(data: bytes, file: str, names: Mapping[str, str | None]) -> HeadJoints:
    """Read two joints as a head.

    Args:
        data: the URDF.
        file: its name.
        names: names of the joints by axis, None to find them in the file.

    Raises:
        InputError: a joint is missing, does not turn, or is not mounted on the other; the axes are parallel, or the pan
            axis does not point upwards.
    """
    urdf = read_urdf(data, file)
    try:
        return _head_joints(urdf, file, names)
    except ValueError as error:
        remedy = "correct the numbers of the joint"
        raise refusal("urdf", file=file, found=escaped(str(error)), allowed="finite numbers", remedy=remedy) from error


def _head_joints(urdf: Urdf, file: str, names: Mapping[str, str | None]) -> HeadJoints:
    from scipy.spatial.transform import Rotation

    chosen, joints = _named(urdf, names, file), urdf.listed("joint")
    pan, tilt = (joints[chosen[axis]] for axis in AXES)
    between = _between(joints, pan, tilt, file)
    first = pan.rotation
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
    lean = math.atan2(math.hypot(up[0], up[1]), up[2])
    if math.degrees(lean) > LEAN_MAX_DEG:
        remedy = "pan is the joint that turns about the vertical: name it by --pan-joint; z of its parent link is up"
        raise _refused(
            file, f"the pan axis leans by {math.degrees(lean):.0f} deg", f"at most {LEAN_MAX_DEG:g} deg", remedy
        )
    level = math.hypot(up[0], up[1])
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
    ahead_m, aside_m, height_m = _Frames.of(terms).stage.inv().apply(place)
    terms |= {"elevation_axis_offset_mm": 1000 * ahead_m, "beam_offset_mm.y": 1000 * aside_m}
    terms = {name: 0.0 if abs(value) < 1e3 * SAME else value for name, value in terms.items()}
    return HeadJoints(urdf, chosen, terms, {"pan": upwards, "tilt": -sense}, height_m, between)


def _refused(file: str, found: str, allowed: str, remedy: str) -> InputError:
    """The error for joints that do not form a head."""
    return refusal("urdf-joint", file=file, found=found, allowed=allowed, remedy=remedy)


def _named(urdf: Urdf, names: Mapping[str, str | None], file: str) -> dict[str, str]:
    """The joints by axis: as the user names them, else by parts of their names, else the only two revolute joints."""
    joints = urdf.listed("joint")
    turning = [name for name, joint in joints.items() if joint.type in MOVING]
    shown = "joints that turn: " + (escaped(listed(turning, LISTED), 400) or "none")
    joint_names: dict[str, str] = {}
    for k, axis in enumerate(AXES):
        name = names[axis]
        if name is None:
            like = [one for one in turning if any(word in one.lower() for word in WORDS[axis])]
            like = like if len(like) == 1 else turning[k : k + 1] if len(turning) == len(AXES) else []
            if not like:
                raise _refused(file, f"no {axis} joint by its name", shown, f"name it by --{axis}-joint")
            name = like[0]
        elif name not in joints:
            raise _refused(file, f"no joint {escaped(name)}", shown, closest(name, joints, "name one of them"))
        elif name not in turning:
            what = f"joint {escaped(name)} is {escaped(joints[name].type)}"
            raise _refused(file, what, shown, "name a joint that is revolute or continuous")
        joint_names[axis] = name
    if joint_names["pan"] == joint_names["tilt"]:
        what, remedy = f"{escaped(joint_names['pan'])} twice", "name two joints by --pan-joint and --tilt-joint"
        raise _refused(file, what, shown, remedy)
    return joint_names


def _between(joints: Mapping[str, _Tag], pan: _Tag, tilt: _Tag, file: str) -> tuple[Rotation, np.ndarray]:
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


def corrected(head: HeadJoints, terms: Mapping[str, float], reductions: Mapping[str, float], block: str) -> bytes:
    """The URDF with estimated terms; all else is unchanged.

    Args:
        head: its joints.
        terms: estimates by name, mm and degrees; terms left out are nominal.
        reductions: new reductions of transmissions, by axis.
        block: lines inserted after the start tag of `robot`, in place of those of an earlier correction.
    """
    after = {**head.terms, **{name: value for name, value in terms.items() if name in head.terms}}
    old, new = _Frames.of(head.terms), _Frames.of(after)
    pan, tilt = (head.joint(axis) for axis in AXES)
    turn, shift = head.between
    first = new.stage * old.stage.inv() * pan.rotation
    link = new.link * old.link.inv() * (pan.rotation * turn * tilt.rotation)
    base = first * turn
    offsets_m = 1e-3 * after["elevation_axis_offset_mm"], 1e-3 * after["beam_offset_mm.y"], head.height_m
    place = new.stage.apply(offsets_m)
    edits: list[_Edit] = []
    edits += _origin(head.urdf, pan, first, pan.shift_m)
    edits += _origin(head.urdf, tilt, base.inv() * link, turn.inv().apply(first.inv().apply(place) - shift))
    # The joint keeps its sense of counting.
    axis = link.inv().apply(new.axis * -head.sign["tilt"])
    if np.max(np.abs(axis - tilt.axis)) > SAME:
        edits += _element(head.urdf, tilt, "axis", {"xyz": axis})
    for name, value in reductions.items():
        if (tag := head.urdf.reduction(head.names[name])) is not None:
            edits.append(_Edit(tag.text_begin, tag.text_begin + len(tag.text.encode()), f"{value:.12g}".encode()))
    data = head.urdf.data
    edits += [
        _Edit(tag.begin, re.compile(rb"\s*").match(data, tag.end).end(), b"")  # type: ignore[union-attr]
        for name, tag in head.urdf.listed(PROPERTY).items()
        if name.startswith("head_")
    ]
    root = data[head.urdf.root.begin : head.urdf.root.end]
    if b"xmlns:xacro" not in root:
        root = root[:-1] + b' xmlns:xacro="http://www.ros.org/wiki/xacro">'
    edits.append(_Edit(head.urdf.root.begin, head.urdf.root.end, root + b"\n" + block.rstrip().encode()))
    for edit in sorted(edits, reverse=True):
        data = data[: edit.begin] + edit.text + data[edit.end :]
    return data


def _attribute(text: bytes, name: str, values: np.ndarray) -> bytes:
    """A start tag with new numbers in an attribute."""
    words = " ".join(f"{0.0 if abs(value) < SAME else value:.12g}" for value in values.tolist()).encode()
    pattern = re.compile(rb"(\b" + name.encode() + rb"\s*=\s*)(\"[^\"]*\"|'[^']*')")
    written, count = pattern.subn(rb'\1"' + words + b'"', text)
    if count:
        return written
    end = -2 if text.endswith(b"/>") else -1
    return text[:end].rstrip() + b" " + name.encode() + b'="' + words + b'"' + text[end:]


class _Edit(NamedTuple):
    """A text that replaces the bytes from `begin` to `end` of a file."""

    begin: int
    end: int
    text: bytes


def _element(urdf: Urdf, joint: _Tag, name: str, values: Mapping[str, np.ndarray]) -> list[_Edit]:
    """An element of a joint with new numbers; inserted where the joint has none."""
    tag = joint.first(name)
    begin, end = (joint.end, joint.end) if tag is None else (tag.begin, tag.end)
    text = f"\n    <{name}/>".encode() if tag is None else urdf.data[begin:end]
    for attribute, numbers in values.items():
        text = _attribute(text, attribute, numbers)
    return [_Edit(begin, end, text)] if values else []


def _origin(urdf: Urdf, joint: _Tag, turn: Rotation, shift_m: np.ndarray) -> list[_Edit]:
    """Edits of a joint's origin."""
    values: dict[str, np.ndarray] = {}
    if np.max(np.abs(shift_m - joint.shift_m)) > SAME:
        values["xyz"] = shift_m
    if float((turn * joint.rotation.inv()).magnitude()) > SAME:
        values["rpy"] = turn.as_euler("xyz")
    return _element(urdf, joint, "origin", values)


def ratios_of(head: HeadJoints, steps_per_turn: float) -> dict[str, float]:
    """Nominal degrees per step, from the transmissions and the motors' steps per turn."""
    return {
        f"degrees_per_step.{axis}": FULL_TURN_DEG / (steps_per_turn * abs(head.reduction(axis) or 1.0)) for axis in AXES
    }


UNSAID = (
    "a URDF holds no play, no error by position, no flexure and no beam over the tilt axis: they stay",
    "a driver turns counters into joint angles by the reduction alone: zeros are in the origins of the joints",
)


@dataclass(frozen=True)
class HeadModel:
    """Results of a head's fit, for the model of a robot.

    Attributes:
        names: names of `values`, those of the head's parameters.
        values: estimates, units of the names, shape (n,).
        covariance: covariance of `values`, shape (n, n).
        origin: program and data of the estimate, in one line.
        data_sha256: hash of the data.
        steps_per_turn: steps per turn of the motors, None where not stated.
    """

    names: tuple[str, ...]
    values: np.ndarray
    covariance: np.ndarray
    origin: str
    data_sha256: str
    steps_per_turn: float | None = None

    @property
    def by_name(self) -> dict[str, float]:
        """Estimates by name."""
        return dict(zip(self.names, self.values.tolist(), strict=True))

    def steps_per_rad(self, head: HeadJoints | None) -> dict[str, float]:
        """Counters per radian of each joint, by axis."""
        sign = dict.fromkeys(AXES, 1) if head is None else head.sign
        return {axis: sign[axis] * math.degrees(1.0) / self.by_name[f"degrees_per_step.{axis}"] for axis in AXES}

    def properties(self, head: HeadJoints | None) -> dict[str, str]:
        """Properties by name: estimates with their u, and counters per radian of each joint."""
        properties = {CORRECTS: self.data_sha256}
        properties |= {f"head_{axis}_steps_per_rad": f"{n:.12g}" for axis, n in self.steps_per_rad(head).items()}
        for (name, value), u in zip(self.by_name.items(), np.sqrt(np.diag(self.covariance)), strict=True):
            word = name.replace(".", "_")
            properties |= {f"head_{word}": f"{value:.12g}", f"head_u_{word}": f"{u:.4g}"}
        return properties

    def urdf(self, head: HeadJoints | None) -> bytes:
        """The URDF with the estimated terms, or without a URDF a file of xacro properties.

        Raises:
            InputError: the URDF already contains the correction from these data.
        """
        lines = [f'  <{PROPERTY} name="{name}" value="{text}"/>\n' for name, text in self.properties(head).items()]
        if head is None:
            said = "\n".join(f"       {line.replace('--', '- -')}" for line in (self.origin, *UNSAID))
            start = '<?xml version="1.0"?>\n<robot xmlns:xacro="http://www.ros.org/wiki/xacro">\n'
            return f"{start}  <!--\n{said}\n  -->\n{''.join(lines)}</robot>\n".encode()
        before = head.urdf.listed(PROPERTY).get(CORRECTS)
        if before is not None and before.attributes.get("value") == self.data_sha256:
            message = "head.urdf has the correction by these data already: it is not applied twice"
            raise InputError("applied", message, remedy="use it, then `tvsbayes verify` it with fresh looks")
        reductions: dict[str, float] = {}
        for axis in AXES if self.steps_per_turn is not None else ():
            if (stated := head.reduction(axis)) is not None:
                turns = FULL_TURN_DEG / (float(self.steps_per_turn or 1.0) * self.by_name[f"degrees_per_step.{axis}"])
                reductions[axis] = math.copysign(turns, stated)
        return corrected(head, self.by_name, reductions, "".join(lines))

    def document(self, head: HeadJoints | None) -> dict[str, Any]:
        """The estimates for programs, with their covariance; units of the names."""
        joints = {
            axis: {"name": axis if head is None else head.names[axis], "steps_per_rad": float(f"{n:.12g}")}
            for axis, n in self.steps_per_rad(head).items()
        }
        return {
            CORRECTS: self.data_sha256,
            "applied": False,
            "joints": joints,
            "names": list(self.names),
            "values": self.values.tolist(),
            "u": np.sqrt(np.diag(self.covariance)).tolist(),
            "covariance": self.covariance.tolist(),
            "unsaid": list(UNSAID),
        }
