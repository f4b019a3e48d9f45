"""The URDF of a head with the estimated terms; text that does not change is kept byte for byte.

Without a URDF: a file of xacro properties.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from tvsbayes.errors import InputError
from tvsbayes.importing.urdf import PROPERTY, SAME, Frames, HeadJoints, Tag, Urdf
from tvsbayes.instrument.axes import AXES, FULL_TURN_DEG

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

CORRECTS = "head_corrects"


def corrected(head: HeadJoints, terms: Mapping[str, float], reductions: Mapping[str, float], block: str) -> bytes:
    """The URDF with estimated terms; all else is unchanged.

    Args:
        head: its joints.
        terms: estimates by name, mm and degrees; terms left out are nominal.
        reductions: new reductions of transmissions, by axis.
        block: lines inserted after the start tag of `robot`, in place of those of an earlier correction.
    """
    after = {**head.terms, **{name: value for name, value in terms.items() if name in head.terms}}
    old, new = Frames.of(head.terms), Frames.of(after)
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
            edits.append(_Edit(tag.end, tag.content_end, f"{value:.12g}".encode()))
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
    pattern = re.compile(rb"(\s" + name.encode() + rb"\s*=\s*)(\"[^\"]*\"|'[^']*')")
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


def _element(urdf: Urdf, joint: Tag, name: str, values: Mapping[str, np.ndarray]) -> list[_Edit]:
    """An element of a joint with new numbers; inserted where the joint has none."""
    tag = joint.first(name)
    begin, end = (joint.end, joint.end) if tag is None else (tag.begin, tag.end)
    text = f"\n    <{name}/>".encode() if tag is None else urdf.data[begin:end]
    for attribute, numbers in values.items():
        text = _attribute(text, attribute, numbers)
    return [_Edit(begin, end, text)] if values else []


def _origin(urdf: Urdf, joint: Tag, turn: Rotation, shift_m: np.ndarray) -> list[_Edit]:
    """Edits of a joint's origin."""
    values: dict[str, np.ndarray] = {}
    if np.max(np.abs(shift_m - joint.shift_m)) > SAME:
        values["xyz"] = shift_m
    if float((turn * joint.rotation.inv()).magnitude()) > SAME:
        values["rpy"] = turn.as_euler("xyz")
    return _element(urdf, joint, "origin", values)


def ratios_of(head: HeadJoints, steps_per_turn: float) -> dict[str, float]:
    """Nominal degrees per step, from the transmissions and the motors' steps per turn."""
    turns = {axis: abs(head.reductions[axis] or 1.0) for axis in AXES}
    return {f"degrees_per_step.{axis}": FULL_TURN_DEG / (steps_per_turn * turns[axis]) for axis in AXES}


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
            if (stated := head.reductions[axis]) is not None:
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
