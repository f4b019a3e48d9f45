"""A head in a URDF: nominal terms from two of its joints, and the same file with what was estimated.

The base is the parent link of the pan joint, z up; the beam is x of the child link of the tilt joint (REP 103). Joints
turn by the right-hand rule about their axes: a tilt joint about +y lowers the beam. URDF: m and rad, `rpy` about fixed
axes; terms in mm and degrees. Text outside what changes is kept byte for byte.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any
from xml.parsers import expat

import numpy as np

from tvsbayes.errors import InputError, closest, escaped, listed, refusal
from tvsbayes.instrument.axes import AXES, FULL_TURN_DEG

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

URDF_BYTES_MAX = 32 * 1024 * 1024
MOVING = ("revolute", "continuous")
WORDS = {"pan": ("pan", "yaw", "azimuth"), "tilt": ("tilt", "pitch", "elevation")}
"""Parts of names by which joints are taken where nobody names them."""
LEAN_MAX_DEG = 30.0
PARALLEL_DEG = 45.0
"""Angle of both axes, and of beam and tilt axis, below which these are no head."""
SAME = 1e-12
"""Change of a number below which it is kept as it stands."""
CORRECTS = "head_corrects"
LISTED = 20


@dataclass(frozen=True)
class _Tag:
    """A start tag: its attributes, and where it stands in the file."""

    attributes: Mapping[str, str]
    begin: int
    end: int


@dataclass
class _Element:
    """A joint or transmission: its own tag, those of its children by name, and texts with their places."""

    tag: _Tag
    parts: dict[str, _Tag] = field(default_factory=dict)
    texts: dict[str, tuple[str, int]] = field(default_factory=dict)

    def numbers(self, part: str, attribute: str, default: tuple[float, ...]) -> np.ndarray:
        """Numbers of an attribute."""
        text = self.parts[part].attributes.get(attribute) if part in self.parts else None
        values = default if text is None else tuple(map(float, text.split()))
        if len(values) != len(default) or not all(map(math.isfinite, values)):
            raise ValueError(f"{part} {attribute}={text!r}: {len(default)} numbers are expected")
        return np.array(values)

    def named(self, part: str, attribute: str) -> str:
        """A text attribute, "" without it."""
        return self.parts[part].attributes.get(attribute, "") if part in self.parts else ""

    @property
    def rotation(self) -> Rotation:
        """Of its origin."""
        from scipy.spatial.transform import Rotation

        return Rotation.from_euler("xyz", self.numbers("origin", "rpy", (0.0, 0.0, 0.0)))

    @property
    def shift_m(self) -> np.ndarray:
        """Of its origin, shape (3,)."""
        return self.numbers("origin", "xyz", (0.0, 0.0, 0.0))

    @property
    def axis(self) -> np.ndarray:
        """A unit vector in the joint's frame, shape (3,)."""
        axis = self.numbers("axis", "xyz", (1.0, 0.0, 0.0))
        if not np.linalg.norm(axis) > 0:
            raise ValueError("axis 0 0 0")
        return axis / np.linalg.norm(axis)


@dataclass(frozen=True)
class Urdf:
    """A URDF that was read.

    Attributes:
        data: its bytes.
        root: of its element `robot`.
        joints: by name.
        transmissions: by the name of their joint.
        properties: of `xacro:property`, by name.
    """

    data: bytes
    root: _Tag
    joints: Mapping[str, _Element]
    transmissions: Mapping[str, _Element]
    properties: Mapping[str, _Tag]


def read_urdf(data: bytes, file: str) -> Urdf:
    """The joints of a URDF.

    Raises:
        InputError: no XML, a document type, no robot, or a xacro that was not expanded.
    """
    parser = expat.ParserCreate()
    path: list[tuple[str, _Element]] = []
    joints: dict[str, _Element] = {}
    transmissions: dict[str, _Element] = {}
    properties: dict[str, _Tag] = {}
    roots: list[_Tag] = []

    def refuse(found: str, allowed: str, remedy: str) -> InputError:
        return refusal("urdf", file=file, line=parser.CurrentLineNumber, found=found, allowed=allowed, remedy=remedy)

    def begin(name: str, attributes: dict[str, str]) -> None:
        at = parser.CurrentByteIndex
        # A ">" inside quotes is none of the tag's.
        close = re.compile(rb"""(?:[^>"']|"[^"]*"|'[^']*')*>""").match(data, at)
        tag = _Tag(attributes, at, close.end() if close else at)
        own_property = name == "xacro:property"
        if (name.startswith("xacro:") and not own_property) or any("${" in v or "$(" in v for v in attributes.values()):
            raise refuse("xacro that is not expanded", "a plain URDF", "run `xacro FILE > head.urdf`, and give that")
        if not path and name != "robot":
            raise refuse(f"<{escaped(name)}>", "<robot>", "give a URDF; an SDF or MJCF converts to one")
        if not path:
            roots.append(tag)
        element = _Element(tag)
        if len(path) == 1 and name == "joint":
            joints[attributes.get("name", "")] = element
        elif len(path) > 1:
            owner = path[1][1]
            owner.parts.setdefault(name, tag)
            if path[1][0] == "transmission" and name == "joint":
                transmissions[attributes.get("name", "")] = owner
        elif own_property:
            properties[attributes.get("name", "")] = tag
        path.append((name, element))

    def end(_: str) -> None:
        path.pop()

    def text(words: str) -> None:
        if len(path) > 2 and words.strip():
            path[1][1].texts.setdefault(path[-1][0], (words, parser.CurrentByteIndex))

    def doctype(*_: object) -> None:
        raise refuse("a document type", "a URDF without one", "remove the lines of <!DOCTYPE>")

    parser.StartElementHandler, parser.EndElementHandler = begin, end
    parser.CharacterDataHandler, parser.StartDoctypeDeclHandler = text, doctype
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise refuse(escaped(str(error)), "XML", "give a URDF file") from error
    return Urdf(data, roots[0], joints, transmissions, properties)


@dataclass(frozen=True)
class _Frames:
    """Of a head at zero of both joints, in the base: the stage that pans, the beam's link, and the tilt axis (3,)."""

    stage: Rotation
    link: Rotation
    axis: np.ndarray

    @classmethod
    def of(cls, terms: Mapping[str, float]) -> _Frames:
        """By terms in degrees: the chain of `head.chain` without flexure; x of the link is the beam."""
        from scipy.spatial.transform import Rotation

        rad = {name: math.radians(value) for name, value in terms.items()}
        north, east = (rad[f"azimuth_axis_tilt_deg.{side}"] for side in ("north", "east"))
        stage = Rotation.from_rotvec([-east, north, 0.0])
        stage *= Rotation.from_rotvec([0.0, 0.0, rad["azimuth_zero_deg"]])
        skew = rad["axes_not_square_deg"]
        axis = np.array([0.0, math.cos(skew), math.sin(skew)])
        up = np.array([0.0, -math.sin(skew), math.cos(skew)])
        raised = Rotation.from_rotvec(-rad["elevation_zero_deg"] * axis)
        return cls(stage, stage * raised * Rotation.from_rotvec(-rad["beam_not_square_deg"] * up), stage.apply(axis))


@dataclass(frozen=True)
class HeadJoints:
    """Two joints of a URDF as a head.

    Attributes:
        urdf: the file.
        names: of the joints, by axis.
        terms: nominal, by the names of the head's terms; mm, degrees.
        sign: of a joint's motion where azimuth or elevation grows, by axis.
        height_m: of the tilt axis over the pan joint, along the pan axis.
        between: rotation and shift (m) from the child link of the pan joint to the parent link of the tilt joint.
    """

    urdf: Urdf
    names: Mapping[str, str]
    terms: Mapping[str, float]
    sign: Mapping[str, int]
    height_m: float
    between: tuple[Rotation, np.ndarray]

    def joint(self, axis: str) -> _Element:
        """Of an axis."""
        return self.urdf.joints[self.names[axis]]

    def reduction(self, axis: str) -> float | None:
        """`mechanicalReduction` of its transmission, None where none is stated."""
        found = self.urdf.transmissions.get(self.names[axis])
        return (
            None
            if found is None or "mechanicalReduction" not in found.texts
            else float(found.texts["mechanicalReduction"][0])
        )

    def limits_deg(self, axis: str) -> tuple[float, float] | None:
        """Lowest and highest angle from the joint's zero, where azimuth or elevation grows; None without limits."""
        joint = self.joint(axis)
        if joint.tag.attributes.get("type") == "continuous" or "limit" not in joint.parts:
            return None
        ends = [float(joint.numbers("limit", end, (0.0,))[0]) for end in ("lower", "upper")]
        low, high = sorted(math.degrees(self.sign[axis] * end) for end in ends)
        return low, high


def head_joints(data: bytes, file: str, names: Mapping[str, str | None]) -> HeadJoints:
    """Two joints as a head.

    Args:
        data: the URDF.
        file: its name.
        names: of the joints by axis, None where the file is to say it.

    Raises:
        InputError: a joint that is missing, does not turn, or is not mounted on the other; axes that are parallel, or
            no pan axis upwards.
    """
    urdf = read_urdf(data, file)
    try:
        return _head_joints(urdf, file, names)
    except ValueError as error:
        remedy = "correct the numbers of the joint"
        raise refusal("urdf", file=file, found=escaped(str(error)), allowed="finite numbers", remedy=remedy) from error


def _head_joints(urdf: Urdf, file: str, names: Mapping[str, str | None]) -> HeadJoints:
    from scipy.spatial.transform import Rotation

    def refuse(found: str, allowed: str, remedy: str) -> InputError:
        return refusal("urdf-joint", file=file, found=found, allowed=allowed, remedy=remedy)

    chosen = _named(urdf, names, refuse)
    pan, tilt = (urdf.joints[chosen[axis]] for axis in AXES)
    between = _between(urdf, pan, tilt, refuse)
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
            raise refuse(f"{what} stand at {angle:.0f} deg", "axes that cross", remedy)
    upwards = 1 if pan_axis[2] >= 0 else -1
    up = upwards * pan_axis
    lean = math.atan2(math.hypot(up[0], up[1]), up[2])
    if math.degrees(lean) > LEAN_MAX_DEG:
        remedy = "pan is the joint that turns about the vertical: name it by --pan-joint; z of its parent link is up"
        raise refuse(f"the pan axis leans by {math.degrees(lean):.0f} deg", f"at most {LEAN_MAX_DEG:g} deg", remedy)
    level = math.hypot(up[0], up[1])
    north, east = (lean * up[k] / level if level > 0 else 0.0 for k in (0, 1))
    upright = Rotation.from_rotvec([-east, north, 0.0]).inv()
    across, sight = upright.apply(tilt_axis), upright.apply(beam)
    # Of both ways to count, the one in which the beam looks ahead at zero.
    sense = 1 if sight[0] * across[1] - sight[1] * across[0] >= 0 else -1
    across = sense * across
    azimuth, skew = math.atan2(-across[0], across[1]), math.asin(max(-1.0, min(1.0, across[2])))
    sight = Rotation.from_rotvec([0.0, 0.0, -azimuth]).apply(sight)
    over = -math.sin(skew) * sight[1] + math.cos(skew) * sight[2]
    aside = math.cos(skew) * sight[1] + math.sin(skew) * sight[2]
    angles = {
        "azimuth_zero_deg": azimuth,
        "elevation_zero_deg": math.atan2(over, sight[0]),
        "azimuth_axis_tilt_deg.north": north,
        "azimuth_axis_tilt_deg.east": east,
        "axes_not_square_deg": skew,
        "beam_not_square_deg": -math.asin(max(-1.0, min(1.0, aside))),
    }
    terms = {name: math.degrees(angle) for name, angle in angles.items()}
    place = first.apply(between[1] + between[0].apply(tilt.shift_m))
    ahead_m, aside_m, height_m = _Frames.of(terms).stage.inv().apply(place)
    terms |= {"elevation_axis_offset_mm": 1000 * ahead_m, "beam_offset_mm.y": 1000 * aside_m}
    terms = {name: 0.0 if abs(value) < 1e3 * SAME else value for name, value in terms.items()}
    return HeadJoints(urdf, chosen, terms, {"pan": upwards, "tilt": -sense}, height_m, between)


type _Refuse = Callable[[str, str, str], InputError]


def _named(urdf: Urdf, names: Mapping[str, str | None], refuse: _Refuse) -> dict[str, str]:
    """The joints by axis: as they were named, else by parts of their names, else the only two that turn."""
    turning = [name for name, joint in urdf.joints.items() if joint.tag.attributes.get("type") in MOVING]
    shown = "joints that turn: " + (escaped(listed(turning, LISTED), 400) or "none")
    found: dict[str, str] = {}
    for k, axis in enumerate(AXES):
        name = names[axis]
        if name is not None and name not in urdf.joints:
            raise refuse(f"no joint {escaped(name)}", shown, closest(name, urdf.joints, "name one of them"))
        if name is not None and name not in turning:
            kind = escaped(urdf.joints[name].tag.attributes.get("type", "no type"))
            raise refuse(f"joint {escaped(name)} is {kind}", shown, "name a joint that is revolute or continuous")
        if name is None:
            like = [one for one in turning if any(word in one.lower() for word in WORDS[axis])]
            like = like if len(like) == 1 else turning[k : k + 1] if len(turning) == len(AXES) else []
            if not like:
                raise refuse(f"no {axis} joint by its name", shown, f"name it by --{axis}-joint")
            name = like[0]
        found[axis] = name
    if found["pan"] == found["tilt"]:
        raise refuse(f"{escaped(found['pan'])} twice", shown, "name two joints by --pan-joint and --tilt-joint")
    return found


def _between(urdf: Urdf, pan: _Element, tilt: _Element, refuse: _Refuse) -> tuple[Rotation, np.ndarray]:
    """From the child link of the pan joint to the parent link of the tilt joint, over joints that are fixed."""
    from scipy.spatial.transform import Rotation

    above = {joint.named("child", "link"): joint for joint in urdf.joints.values()}
    turn, shift, link = Rotation.identity(), np.zeros(3), tilt.named("parent", "link")
    for _ in urdf.joints:
        if link == pan.named("child", "link"):
            return turn, shift
        joint = above.get(link)
        if joint is None or joint.tag.attributes.get("type") != "fixed":
            break
        turn, shift = joint.rotation * turn, joint.shift_m + joint.rotation.apply(shift)
        link = joint.named("parent", "link")
    found, remedy = "a tilt joint that is not mounted on the pan joint", "exchange the names, or name other joints"
    raise refuse(found, "a tilt joint on the child link of the pan joint, fixed joints between them", remedy)


def corrected(head: HeadJoints, terms: Mapping[str, float], reductions: Mapping[str, float], block: str) -> bytes:
    """The URDF with estimated terms; what is not estimated stays as it stands.

    Args:
        head: its joints.
        terms: estimated, by name, mm and degrees; those left out are nominal.
        reductions: of transmissions, by axis, where they change.
        block: lines that go behind the start of `robot`, in place of those of an earlier correction.
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
    edits: list[tuple[int, int, bytes]] = []
    edits += _origin(head.urdf, pan, first, pan.shift_m)
    edits += _origin(head.urdf, tilt, base.inv() * link, turn.inv().apply(first.inv().apply(place) - shift))
    # The sense in which the joint counts stays.
    axis = link.inv().apply(new.axis * -head.sign["tilt"])
    if np.max(np.abs(axis - tilt.axis)) > SAME:
        tag = tilt.parts["axis"]
        edits.append((tag.begin, tag.end, _attribute(head.urdf.data[tag.begin : tag.end], "xyz", axis)))
    for name, value in reductions.items():
        text, at = head.urdf.transmissions[head.names[name]].texts["mechanicalReduction"]
        edits.append((at, at + len(text.encode()), f"{value:.12g}".encode()))
    data = head.urdf.data
    edits += [
        (tag.begin, re.compile(rb"\s*").match(data, tag.end).end(), b"")  # type: ignore[union-attr]
        for name, tag in head.urdf.properties.items()
        if name.startswith("head_")
    ]
    root = data[head.urdf.root.begin : head.urdf.root.end]
    if b"xmlns:xacro" not in root:
        root = root[:-1] + b' xmlns:xacro="http://www.ros.org/wiki/xacro">'
    edits.append((head.urdf.root.begin, head.urdf.root.end, root + b"\n" + block.rstrip().encode()))
    for begin, end, written in sorted(edits, reverse=True):
        data = data[:begin] + written + data[end:]
    return data


def _attribute(text: bytes, name: str, values: np.ndarray) -> bytes:
    """A start tag with other numbers in an attribute."""
    words = " ".join(f"{0.0 if abs(value) < SAME else value:.12g}" for value in values.tolist()).encode()
    found = re.compile(rb"(\b" + name.encode() + rb"\s*=\s*)(\"[^\"]*\"|'[^']*')")
    written, count = found.subn(rb'\1"' + words + b'"', text)
    if count:
        return written
    end = -2 if text.endswith(b"/>") else -1
    return text[:end].rstrip() + b" " + name.encode() + b'="' + words + b'"' + text[end:]


def _origin(urdf: Urdf, joint: _Element, turn: Rotation, shift_m: np.ndarray) -> list[tuple[int, int, bytes]]:
    """What changes of a joint's origin."""
    turned = float((turn * joint.rotation.inv()).magnitude()) > SAME
    moved = bool(np.max(np.abs(shift_m - joint.shift_m)) > SAME)
    if not (turned or moved):
        return []
    tag = joint.parts.get("origin")
    begin, end = (joint.tag.end, joint.tag.end) if tag is None else (tag.begin, tag.end)
    text = b"\n    <origin/>" if tag is None else urdf.data[begin:end]
    for name, values, changed in (("xyz", shift_m, moved), ("rpy", turn.as_euler("xyz"), turned)):
        text = _attribute(text, name, values) if changed else text
    return [(begin, end, text)]


def ratios_of(head: HeadJoints, steps_per_turn: float) -> dict[str, float]:
    """Nominal degrees per step, by transmissions and the counts of a turn of the motors."""
    return {
        f"degrees_per_step.{axis}": FULL_TURN_DEG / (steps_per_turn * abs(head.reduction(axis) or 1.0)) for axis in AXES
    }


UNSAID = (
    "a URDF knows no play, no error by position, no flexure and no beam over the tilt axis: they stay",
    "a driver turns counters into joint angles by the reduction alone: zeros are in the origins of the joints",
)


@dataclass(frozen=True)
class HeadModel:
    """What a fit says of a head, for a model of a robot.

    Attributes:
        names: of `values`, those of the head's parameters.
        values: estimates, units of the names, shape (n,).
        covariance: of them, shape (n, n).
        origin: what made them, in a line.
        data_sha256: of the data.
        steps_per_turn: of the motors, None where not stated.
    """

    names: tuple[str, ...]
    values: np.ndarray
    covariance: np.ndarray
    origin: str
    data_sha256: str
    steps_per_turn: float | None = None

    def properties(self, sign: Mapping[str, int]) -> dict[str, str]:
        """By name: estimates with their u, and counters per radian of each joint."""
        by_name = dict(zip(self.names, self.values.tolist(), strict=True))
        found = {CORRECTS: self.data_sha256}
        for axis in AXES:
            per_rad = sign[axis] * math.degrees(1.0) / by_name[f"degrees_per_step.{axis}"]
            found[f"head_{axis}_steps_per_rad"] = f"{per_rad:.12g}"
        for name, value, u in zip(self.names, self.values.tolist(), np.sqrt(np.diag(self.covariance)), strict=True):
            word = name.replace(".", "_")
            found |= {f"head_{word}": f"{value:.12g}", f"head_u_{word}": f"{u:.4g}"}
        return found

    def urdf(self, head: HeadJoints | None) -> bytes:
        """The URDF with what was estimated, or where none is known a file of xacro properties.

        Raises:
            InputError: the URDF has these data's correction already.
        """
        sign: Mapping[str, int] = {"pan": 1, "tilt": 1} if head is None else head.sign
        said = "\n".join(f"       {line.replace('--', '- -')}" for line in (self.origin, *UNSAID))
        block = f"  <!--\n{said}\n  -->\n" if head is None else ""
        properties = self.properties(sign)
        block += "".join(f'  <xacro:property name="{name}" value="{text}"/>\n' for name, text in properties.items())
        if head is None:
            start = '<?xml version="1.0"?>\n<robot xmlns:xacro="http://www.ros.org/wiki/xacro">\n'
            return f"{start}{block}</robot>\n".encode()
        before = head.urdf.properties.get(CORRECTS)
        if before is not None and before.attributes.get("value") == self.data_sha256:
            message = "head.urdf has the correction by these data already: it is not applied twice"
            raise InputError("applied", message, remedy="use it, then `tvsbayes verify` it with fresh looks")
        ratios = {} if self.steps_per_turn is None else dict(zip(self.names, self.values.tolist(), strict=True))
        reductions: dict[str, float] = {}
        for axis in AXES:
            stated = head.reduction(axis)
            if ratios and stated is not None:
                turns = FULL_TURN_DEG / (float(self.steps_per_turn or 1.0) * ratios[f"degrees_per_step.{axis}"])
                reductions[axis] = math.copysign(turns, stated)
        return corrected(head, dict(zip(self.names, self.values.tolist(), strict=True)), reductions, block)

    def document(self, head: HeadJoints | None) -> dict[str, Any]:
        """The same for programs, with the covariance; units of the names."""
        sign: Mapping[str, int] = {"pan": 1, "tilt": 1} if head is None else head.sign
        joints = {
            axis: {
                "name": axis if head is None else head.names[axis],
                "steps_per_rad": float(self.properties(sign)[f"head_{axis}_steps_per_rad"]),
            }
            for axis in AXES
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
