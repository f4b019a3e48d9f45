"""Calibrations in the formats of the makers of stereo cameras, converted to the names of `calibration_names`.

These formats need more than names. Cameras are given by the number of a socket and poses by a chain (DepthAI), each
size of the pictures has its calibration (ZED, RealSense), or a pose is in components. Each becomes tables `left` and
`right` with the pose between them; numbers change only by the transformation that the format defines.
"""

from __future__ import annotations

import configparser
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tvsbayes.errors import escaped, listed, refusal
from tvsbayes.files.csv_table import NUMBER
from tvsbayes.files.documents import Keys

Size = tuple[int, int]
Values = dict[str, Any]
ZED_SIZES: dict[str, Size] = {
    **{"2k": (2208, 1242), "fhd": (1920, 1080), "fhd1200": (1920, 1200), "hd": (1280, 720), "svga": (960, 600)},
    **{"vga": (672, 376), "4k": (3840, 2160), "qhdplus": (3200, 1800)},
}
"""Size of one camera's pictures, by the end of a section's name (StereoLabs, zed-open-capture and zedx-one-capture)."""
DEPTHAI_MODELS = {0: "perspective", 1: "equidistant"}
"""`CameraModel` of depthai-core; its fisheye is OpenCV's of four coefficients."""
_ZED_SECTION = re.compile(r"^\s*\[LEFT_CAM_\w+\]\s*$", re.MULTILINE | re.IGNORECASE)
_PART = re.compile(r'(?=Intrinsic of "|Extrinsic from ")')
_STREAM = re.compile(r'Intrinsic of "([^"\n]+)" / ([0-9]+)x([0-9]+)(.*)', re.DOTALL)
_POSE = re.compile(r'Extrinsic from "([^"\n]+)"\s+To\s+"([^"\n]+)"\s*:(.*)', re.DOTALL)
_STREAM_OBJECT = re.compile(
    r"\[\s*([0-9]+)x([0-9]+)\s+p\[(\S+)\s+([^\]\s]+)\]\s+f\[(\S+)\s+([^\]\s]+)\]\s+"
    r"([A-Za-z][\w ]*?)\s*\[([^\]]*)\]\s*\]"
)
_POSE_OBJECT = re.compile(r"rotation:\s*\[([^\]]*)\]\s*translation:\s*\[([^\]]*)\]")
STEREO_STREAMS = ("Infrared 1", "Infrared 2")
"""The left and the right camera of a RealSense D400."""


@dataclass(frozen=True)
class MakersPair:
    """A maker's calibration under the names of `calibration_names`.

    Attributes:
        keys: its tables; refusals name the file.
        source: the maker.
        unit: unit of the translation: "m", "cm", "mm"; "" where the file does not state it.
        notes: assumptions.
    """

    keys: Keys
    source: str
    unit: str
    notes: tuple[str, ...] = ()


def printed_values(text: str) -> Values | None:
    """The values of a ZED's settings file or of the output of RealSense's tools; None for any other text."""
    if _ZED_SECTION.search(text):
        return _sections(text)
    if _STREAM.search(text) or len(_STREAM_OBJECT.findall(text)) > 1:
        return {"realsense": _streams(text)}
    return None


def makers_pair(keys: Keys, size: Size | None) -> MakersPair | None:
    """A maker's file under known names; None for any other file.

    Args:
        keys: the file.
        size: size of the pictures, px, where the user states it.

    Raises:
        InputError: no pair in the file, or several picture sizes and none stated.
    """
    for matches, read in _MAKERS:
        if matches(keys.values):
            try:
                return read(keys.values, keys, size)
            except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
                raise refusal(
                    "container",
                    file=keys.file,
                    found=f"entries that a file of this kind does not have, or lacks ({escaped(str(error), 60)})",
                    allowed="the file as the camera's program writes it",
                    remedy="take it again from there, whole",
                ) from error
    return None


def _sections(text: str) -> Values:
    """Sections of an ini file, keys in lower case."""
    parser = configparser.ConfigParser(interpolation=None, inline_comment_prefixes=(";", "#"))
    try:
        parser.read_string(text)
    except configparser.Error as error:
        raise ValueError(str(error).replace("\n", " ")) from error
    return {
        name.lower(): {key: float(word) if NUMBER.fullmatch(word) else word for key, word in section.items()}
        for name, section in parser.items()
        if name != parser.default_section
    }


def _numbers(text: str) -> list[float]:
    return [float(word) for word in re.split(r"[\s,]+", text) if NUMBER.fullmatch(word)]


def _streams(text: str) -> Values:
    """Streams and poses between them, from `rs-enumerate-devices -c` or of printed objects of pyrealsense2.

    The tool prints R row by row (`print` in rs-enumerate-devices.cpp), an object has it column by column (rs_types.h).
    """
    streams, poses = [], []
    parts = _PART.split(text)
    for name, width, height, rest in (match.groups() for part in parts if (match := _STREAM.match(part))):
        fields = {key.lower(): rest.partition(f"{key}:")[2].split("\n")[0] for key in ("PPX", "PPY", "Fx", "Fy")}
        model, coefficients = (rest.partition(f"{key}:")[2].split("\n")[0] for key in ("Distortion", "Coeffs"))
        streams.append(_stream(name, (width, height), fields, model, coefficients))
    for source, target, rest in (match.groups() for part in parts if (match := _POSE.match(part))):
        turn, _, translation = rest.partition("Translation Vector:")
        translation = translation.strip().split("\n")[0]
        poses.append({"from": source, "to": target, "R": _numbers(turn), "T": _numbers(translation)})
    for number, (width, height, ppx, ppy, fx, fy, model, rest) in enumerate(_STREAM_OBJECT.findall(text)):
        fields = {"ppx": ppx, "ppy": ppy, "fx": fx, "fy": fy}
        streams.append(_stream(f"camera {number + 1}", (width, height), fields, model, rest))
    for turn, translation in _POSE_OBJECT.findall(text):
        rows = np.array(numbers).reshape(3, 3).T.ravel().tolist() if len(numbers := _numbers(turn)) == 9 else numbers
        poses.append({"from": "camera 1", "to": "camera 2", "R": rows, "T": _numbers(translation)})
    return {"streams": streams, "poses": poses}


def _stream(name: str, size: Sequence[str], fields: Mapping[str, str], model: str, coefficients: str) -> Values:
    numbers = {key: values[0] for key, word in fields.items() if (values := _numbers(word))}
    inner = {**numbers, "distortion_model": model.strip(), "D": _numbers(coefficients)}
    return {"name": name, "width": int(size[0]), "height": int(size[1]), **inner}


def _name_of_size(sizes: Mapping[str, Size], size: Size | None, file: str) -> str:
    """The name of the size that the user states, or the only one."""
    matching = [name for name, picture_size in sizes.items() if size in (None, picture_size)]
    if len(matching) == 1:
        return matching[0]
    sizes_text = listed([f"{width}x{height}" for width, height in sizes.values()], len(ZED_SIZES))
    found = f"calibrations for pictures of {sizes_text} px" if sizes else "no calibration of both cameras for one size"
    example = "x".join(map(str, next(iter(sizes.values()), (1280, 720))))
    raise refusal(
        "image-size",
        file=file,
        found=found,
        allowed="the size of the pictures that the spots are in",
        remedy=f"state it, for example --image-size {example}",
    )


def _zed(document: Values, keys: Keys, size: Size | None) -> MakersPair:
    """SN*.conf: R from the vector RX, CV, RZ; T = (-Baseline, TY, TZ) mm.

    As StereoLabs' zedx-one-capture writes it from cv2.stereoCalibrate (stereo_calibration/main.cpp).
    """
    sections = {name: table for name, table in document.items() if isinstance(table, dict)}
    complete = {
        name: picture_size
        for name, picture_size in ZED_SIZES.items()
        if f"left_cam_{name}" in sections and f"right_cam_{name}" in sections
    }
    name = _name_of_size(complete, size, keys.file)
    stereo, notes = sections.get("stereo", {}), []

    def number(table: Values, section: str, key: str, default: float | None = None) -> float:
        value = table.get(f"{key}_{name}", table.get(key, default))
        if not isinstance(value, float):
            found = "nothing" if value is None else escaped(str(value), 40)
            remedy = "take the file as the ZED's program wrote it"
            column = f"{section}.{key}"
            raise refusal("missing-key", file=keys.file, column=column, found=found, allowed="a number", remedy=remedy)
        return value

    values: Values = {}
    for side in ("left", "right"):
        section = f"{side}_cam_{name}"
        lens = sections.get(f"{side}_disto", sections[section])
        names = ("k1", "k2", "p1", "p2", "k3") + (("k4", "k5", "k6") if "k4" in lens else ())
        values[side] = {key: number(sections[section], section, key) for key in ("fx", "fy", "cx", "cy")}
        values[side] |= dict(zip(("width", "height"), complete[name], strict=True))
        values[side]["D"] = [number(lens, section, key, 0.0 if key in ("p1", "p2", "k3") else None) for key in names]
    values["R"] = [number(stereo, "stereo", key) for key in ("rx", "cv", "rz")]
    if not {"ty", f"ty_{name}"} & set(stereo):
        notes.append("TY and TZ: none in the file, so 0")
    ty_tz = [number(stereo, "stereo", key, 0.0) for key in ("ty", "tz")]
    values["T"] = [-number(stereo, "stereo", "baseline"), *ty_tz]
    return MakersPair(Keys(values, keys.file, keys.text), "zed", "mm", tuple(notes))


def _depthai(document: Values, keys: Keys, size: Size | None) -> MakersPair:
    """EEPROM of an OAK: x_to = R x_from + T along a chain of sockets, cm (`CalibrationHandler` of depthai-core)."""
    del size
    cameras = {entry[0]: entry[1] for entry in document["cameraData"] if _is_socket(entry)}
    stated = document.get("stereoRectificationData", {})
    sockets = [stated.get(f"{side}CameraSocket") for side in ("left", "right")]
    if not all(socket in cameras for socket in sockets) or sockets[0] == sockets[1]:
        # CAM_B and CAM_C are used where the rectification was never stored.
        sockets = [1, 2]
    chains = [chain for s in sockets if s in cameras and (chain := _chain_pose(cameras, s)) is not None]
    if len(chains) < 2 or len({end for end, _ in chains}) > 1:
        raise refusal(
            "missing-key",
            file=keys.file,
            found=f"cameras at the sockets {listed([str(s) for s in cameras], 8) if cameras else 'none'}",
            allowed="two cameras, and a chain of toCameraSocket between them",
            remedy="take it from the device again: dai.CalibrationHandler.eepromToJsonFile()",
        )
    (_, left), (_, right) = chains
    pose = np.linalg.inv(right) @ left
    values: Values = {"R": pose[:3, :3].tolist(), "T": pose[:3, 3].tolist()}
    for side, socket in zip(("left", "right"), sockets, strict=True):
        camera = cameras[socket]
        kind = camera.get("cameraType", 0)
        lens = {key: camera[key] for key in ("intrinsicMatrix", "distortionCoeff", "width", "height") if key in camera}
        values[side] = {**lens, "camera_model": DEPTHAI_MODELS.get(kind, f"cameraType {escaped(str(kind), 20)}")}
    note = f"sockets {sockets[0]} (left) and {sockets[1]} (right)"
    return MakersPair(Keys(values, keys.file, keys.text), "depthai", "cm", (note,))


def _is_socket(entry: object) -> bool:
    return isinstance(entry, list) and len(entry) == 2 and isinstance(entry[0], int) and isinstance(entry[1], dict)


def _chain_pose(cameras: Mapping[int, Values], socket: int) -> tuple[int, np.ndarray] | None:
    """The last socket of a camera's chain, and the transformation (4, 4) to it; None for a broken chain."""
    pose = np.eye(4)
    for _ in cameras:
        extrinsics = cameras[socket]["extrinsics"]
        if extrinsics["toCameraSocket"] not in cameras:
            return socket, pose
        step = np.eye(4)
        step[:3, :3] = extrinsics["rotationMatrix"]
        step[:3, 3] = [extrinsics["translation"][axis] for axis in "xyz"]
        pose, socket = step @ pose, extrinsics["toCameraSocket"]
    return None


def _realsense(document: Values, keys: Keys, size: Size | None) -> MakersPair:
    """The output of rs-enumerate-devices -c, or printed objects of pyrealsense2; lengths in m."""
    printed = document["realsense"]
    names = list(dict.fromkeys(stream["name"] for stream in printed["streams"]))
    pair = STEREO_STREAMS if set(STEREO_STREAMS) <= set(names) else tuple(names)
    poses = [p for p in printed["poses"] if (p["from"], p["to"]) == pair and len(p["R"]) == 9 and len(p["T"]) == 3]
    if len(pair) != 2 or not poses:
        raise refusal(
            "missing-key",
            file=keys.file,
            found=f"streams {listed([escaped(name, 30) for name in names], 8)}, and no pose between two of them alone",
            allowed="the intrinsics of two cameras, and the extrinsics from the first to the second",
            remedy="keep both Infrared streams, or those of your two cameras, and the extrinsics between them",
        )
    by_name = [{(s["width"], s["height"]): s for s in printed["streams"] if s["name"] == name} for name in pair]
    sizes = {f"{width}x{height}": (width, height) for width, height in by_name[0] if (width, height) in by_name[1]}
    chosen = sizes[_name_of_size(sizes, size, keys.file)]
    values = {side: streams[chosen] for side, streams in zip(("left", "right"), by_name, strict=True)}
    pose = {"R": np.reshape(poses[0]["R"], (3, 3)).tolist(), "T": poses[0]["T"]}
    note = f"left is {escaped(pair[0], 30)}, right {escaped(pair[1], 30)}"
    return MakersPair(Keys({**values, **pose}, keys.file, keys.text), "realsense", "m", (note,))


_MAKERS: tuple[tuple[Callable[[Values], bool], Callable[[Values, Keys, Size | None], MakersPair]], ...] = (
    (lambda values: isinstance(values.get("cameraData"), list), _depthai),
    (lambda values: isinstance(values.get("realsense"), dict) and "streams" in values["realsense"], _realsense),
    (lambda values: any(str(name).lower().startswith("left_cam_") for name in values), _zed),
)
