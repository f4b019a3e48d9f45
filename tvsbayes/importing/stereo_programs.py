"""Calibrations in the formats of programs and of makers of cameras, converted to the names of `data/words/stereo.toml`.

These formats need more than names: cameras are given by the number of a socket and poses by a chain (DepthAI), each
size of the pictures has its calibration (ZED, RealSense), numbers stand in sentences (Kalibr, ROS' ost), or origins and
orders differ (Metashape). Each becomes tables `left` and `right` with poses; numbers change only as the format defines.
"""

from __future__ import annotations

import configparser
import re
import tomllib
from collections.abc import Callable, Iterable
from functools import cache
from typing import Any

import cv2
import numpy as np

from tvsbayes.errors import escaped, listed
from tvsbayes.files.csv_table import NUMBER
from tvsbayes.files.disk import shipped_data
from tvsbayes.files.documents import Keys
from tvsbayes.importing.asking import refused

Size = tuple[int, int]
Values = dict[str, Any]
SIDES = ("left", "right")
STEREO_STREAMS = ("Infrared 1", "Infrared 2")
"""The left and the right camera of a RealSense D400."""
DEPTHAI_MODELS = {0: "perspective", 1: "equidistant"}
"""`CameraModel` of depthai-core; its fisheye is OpenCV's of four coefficients."""
RATIONAL = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tauX", "tauY")
"""OpenCV's order of the coefficients of a rational lens."""
FIRST_TWO = "cameras 1 (left) and 2 (right) of {}"
FOCAL = ("fx", "fy", "cx", "cy")
_DAMAGE = (ArithmeticError, AttributeError, LookupError, TypeError, ValueError)


@cache
def words() -> dict[str, Any]:
    """The names of sides, lenses and programs; `fields`: names of all fields and the counts of their numbers."""
    tables = tomllib.loads((shipped_data() / "words" / "stereo.toml").read_text(encoding="utf-8"))
    return tables | {"fields": {**tables["camera"], **tables["pair"], **tables["made"]}}


def printed_trees(text: str) -> list[Values]:
    """What a program prints as text, a table for each camera or one; none for any other text, ValueError if broken."""
    with np.errstate(over="raise", invalid="raise", divide="raise"):
        return next((read(text) for mark, read in _PRINTED.items() if re.search(mark, text, re.MULTILINE)), [])


def adapted(keys: Keys, size: Size | None) -> tuple[Keys, str, str | None, list[str]]:
    """A program's own structure under known names, its program, unit of lengths ("?" where they have none) and notes.

    Any other file as it is; `size` as the user states it, px.

    Raises:
        InputError: no pair in the file, a lens that is none of ours, or several picture sizes and none stated.
    """
    key = next((key for key in _STRUCTURES if key in keys), None)
    if key is None:
        return keys, "", None, []
    (read, source, unit), notes = _STRUCTURES[key], list[str]()
    try:
        with np.errstate(over="raise", invalid="raise", divide="raise"):
            values = read(keys.values, keys.file, size, notes)
    except (*_DAMAGE, configparser.Error, cv2.error) as error:
        raise refused("stereo-structure", keys.file, error=escaped(str(error), 100)) from error
    return Keys(values, keys.file, keys.content), source, str(values.pop("unit", unit)), notes


def _numbers(text: str) -> list[float]:
    return [float(word) for word in re.split(r"[\s,;\[\]]+", text) if NUMBER.fullmatch(word)]


def rigid(turn: Any, shift: Any) -> np.ndarray:
    """Transformation (4, 4) of Rodrigues' vector, a matrix, or a quaternion x y z w, and a shift."""
    turn = np.array(turn, float)
    if turn.size == 4:
        x, y, z, w = turn / np.linalg.norm(turn)
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        turn = np.eye(3) + 2 * w * cross + 2 * cross @ cross
    turn = cv2.Rodrigues(turn)[0] if turn.size == 3 else turn.reshape(3, 3)
    return np.vstack([np.column_stack([turn, np.array(shift, float)]), [0, 0, 0, 1.0]])


def _chosen(sizes: Iterable[Size], size: Size | None, file: str) -> Size:
    """The size that the user states, or the only one."""
    matching = [picture_size for picture_size in sizes if size in (None, picture_size)]
    if len(matching) == 1:
        return matching[0]
    texts = [f"{width}x{height}" for width, height in sizes]
    found = (
        f"calibrations for pictures of {listed(texts, 8)} px"
        if texts
        else "no calibration of both cameras for one size"
    )
    raise refused("stereo-which-size", file, found=found, example=[*texts, "1280x720"][0])


def _kalibr_text(text: str) -> list[Values]:
    """Kalibr's results-cam.txt: the numbers of its camchain, without the size of the pictures; uncertainties stay."""
    values: Values = {"size_in": "camchain-*.yaml of Kalibr"}
    for name, body in re.findall(r"^(cam\d) .*?:\n((?:[ \t]+\S.*\n?)*)", text, re.MULTILINE):
        lines = dict(re.findall(r"^\s*(\w+): (.*?)(?:\+-.*)?$", body, re.MULTILINE))
        model = "".join(re.findall(r"(\w+)CameraGeometry", lines.get("type", ""))).replace("Distorted", "").lower()
        numbers = (_numbers(lines.get(key, "")) for key in ("projection", "distortion"))
        values[name] = dict(zip(("intrinsics", "distortion_coeffs"), numbers, strict=True))
        values[name]["distortion_model"] = model or "no type"
    for before, after, turn, shift in re.findall(r"T_(\d)_(\d):\s*q: (\[.*?\]).*\n\s*t: (\[.*?\])", text):
        quaternion = _numbers(turn)
        if f"cam{before}" in values and int(before) == int(after) + 1 and len(quaternion) == 4 and any(quaternion):
            # JPL's quaternion of Kalibr turns the other way than Hamilton's: that of the inverse rotation.
            inverse = [*(-part for part in quaternion[:3]), quaternion[3]]
            values[f"cam{before}"]["T_cn_cnm1"] = rigid(inverse, _numbers(shift)).tolist()
    if errors_px := _numbers(" ".join(re.findall(r"reprojection error: .*\+-(.*)", text))):
        values["rms_px"] = float(np.sqrt(np.sum(np.square(errors_px)) * 2 / len(errors_px)))
    return [values]


def _ost_text(text: str) -> list[Values]:
    """ost.txt of ROS' camera_calibration: the numbers of camera_info, one camera after the other."""
    block = re.compile(r"^([a-z ]+)\n((?:[\d.eE+\- \t]+\n?)+)", re.MULTILINE)
    parts = re.split(r"^[ \t]*\[image\][ \t]*$", text, flags=re.MULTILINE)[1:]
    return [{name: _numbers(rows) for name, rows in block.findall(part)} for part in parts]


def _halcon_text(text: str) -> list[Values]:
    found = "parameters of HALCON: a lens by division (Kappa) or in other units, R and T in another file"
    raise ValueError(found, "calibrate from the same pictures: `tvsbayes stereo FOLDER`")


def _zed(document: Values, file: str, size: Size | None, notes: list[str]) -> Values:
    """SN*.conf: R from the vector RX, CV, RZ; T = (-Baseline, TY, TZ) mm.

    As StereoLabs' zedx-one-capture writes it from cv2.stereoCalibrate (stereo_calibration/main.cpp).
    """
    parser = configparser.ConfigParser(interpolation=None, inline_comment_prefixes=(";", "#"))
    parser.read_string(document["printed zed"])
    sections = {name.lower(): dict(section) for name, section in parser.items()}
    complete = [name for name in words()["zed"] if {f"left_cam_{name}", f"right_cam_{name}"} <= set(sections)]
    names = {(width, height): name for name, (width, height) in words()["zed"].items() if name in complete}
    width, height = _chosen(names, size, file)
    name = names[width, height]

    def number(section: str, key: str, default: str | None = None) -> float:
        table = sections.get(section, {})
        word = table.get(f"{key}_{name}", table.get(key, default))
        if word is None or not NUMBER.fullmatch(word):
            found = "nothing" if word is None else escaped(word, 40)
            raise refused("stereo-no-number", file, column=f"{section}.{key}", found=found)
        return float(word)

    values: Values = {"R": [number("stereo", key) for key in ("rx", "cv", "rz")]}
    if not {"ty", f"ty_{name}"} & set(sections["stereo"]):
        notes.append("TY and TZ: none in the file, so 0")
    values["T"] = [-number("stereo", "baseline"), number("stereo", "ty", "0"), number("stereo", "tz", "0")]
    for side in SIDES:
        camera = f"{side}_cam_{name}"
        lens = f"{side}_disto" if f"{side}_disto" in sections else camera
        order = RATIONAL[:8] if "k4" in sections[lens] else RATIONAL[:5]
        values[side] = {"K": [number(camera, key) for key in FOCAL], "width": width, "height": height}
        values[side]["D"] = [number(lens, key, "0" if key in ("p1", "p2", "k3") else None) for key in order]
    return values


_STREAM = re.compile(
    r'Intrinsic of "([^"\n]+)" / ([0-9]{1,6})x([0-9]{1,6})(.*?)(?=Intrinsic of "|Extrinsic from "|\Z)', re.DOTALL
)
_POSE = re.compile(r'Extrinsic from "([^"\n]+)"\s+To\s+"([^"\n]+)"\s*:([^"]*?)Translation Vector:\s*([^\n]*)')
_OBJECT = (
    r"\[\s*([0-9]{1,6})x([0-9]{1,6})\s+p\[(\S+)\s+([^\]\s]+)\]\s+f\[(\S+)\s+([^\]\s]+)\]\s+"
    r"([A-Za-z][\w ]*?)\s*\[([^\]]*)\]\s*\]"
)
_POSE_OBJECT = r"rotation:\s*\[([^\]]*)\]\s*translation:\s*\[([^\]]*)\]"


def _realsense(document: Values, file: str, size: Size | None, notes: list[str]) -> Values:
    """The output of rs-enumerate-devices -c, or printed objects of pyrealsense2; lengths in m.

    The tool prints R row by row (`print` in rs-enumerate-devices.cpp), an object has it column by column (rs_types.h).
    """
    text, streams = document["printed realsense"], dict[str, dict[Size, Values]]()
    found = [(f"camera {number}", *fields) for number, fields in enumerate(re.findall(_OBJECT, text), start=1)]
    for *name_and_size, rest in _STREAM.findall(text):
        lines = dict(reversed(re.findall(r"(\w+):([^\n]*)", rest)))
        found.append((*name_and_size, *(lines.get(key, "") for key in "PPX PPY Fx Fy Distortion Coeffs".split())))
    for name, width, height, ppx, ppy, fx, fy, model, coefficients in found:
        size_px = int(width), int(height)
        stream: Values = {"K": _numbers(f"{fx} {fy} {ppx} {ppy}"), "D": _numbers(coefficients), "model": model.strip()}
        streams.setdefault(name, {})[size_px] = stream | dict(zip(("width", "height"), size_px, strict=True))
    pair = STEREO_STREAMS if set(STEREO_STREAMS) <= set(streams) else tuple(streams)
    poses = [(turn, shift, False) for *ends, turn, shift in _POSE.findall(text) if tuple(ends) == pair]
    poses += [(turn, shift, True) for turn, shift in re.findall(_POSE_OBJECT, text)]
    if len(pair) != 2 or not poses:
        raise refused("stereo-streams", file, streams=listed([escaped(name, 30) for name in streams], 8))
    left, right = (streams[name] for name in pair)
    chosen = _chosen([of_left for of_left in left if of_left in right], size, file)
    notes.append(f"left is {escaped(pair[0], 30)}, right {escaped(pair[1], 30)}")
    turn, shift, by_columns = poses[0]
    rotation = np.reshape(_numbers(turn), (3, 3))
    rotation = rotation.T if by_columns else rotation
    return {"left": left[chosen], "right": right[chosen], "R": rotation.tolist(), "T": _numbers(shift)}


def _depthai(document: Values, file: str, size: Size | None, notes: list[str]) -> Values:
    """EEPROM of an OAK: x_to = R x_from + T along a chain of sockets, cm (`CalibrationHandler` of depthai-core)."""
    cameras = {s: camera for s, camera in document["cameraData"] if isinstance(s, int) and isinstance(camera, dict)}
    stated = document.get("stereoRectificationData", {})
    sockets = [stated.get(f"{side}CameraSocket") for side in SIDES]
    if not set(sockets) <= set(cameras) or sockets[0] == sockets[1]:
        # CAM_B and CAM_C are used where the rectification was never stored.
        sockets = [1, 2]
    broken = refused("stereo-chain", file, sockets=listed([str(s) for s in cameras], 8) if cameras else "none")
    if not set(sockets) <= set(cameras):
        raise broken
    values, ends = Values(), set[int]()
    for side, socket in zip(SIDES, sockets, strict=True):
        camera, end, pose = cameras[socket], socket, np.eye(4)
        for _ in cameras:
            extrinsics = cameras[end]["extrinsics"]
            if extrinsics["toCameraSocket"] not in cameras:
                break
            shift = [extrinsics["translation"][axis] for axis in "xyz"]
            pose, end = rigid(extrinsics["rotationMatrix"], shift) @ pose, extrinsics["toCameraSocket"]
        else:
            raise broken
        ends.add(end)
        kind = camera.get("cameraType", 0)
        values[side] = {key: camera.get(key) for key in ("intrinsicMatrix", "distortionCoeff", "width", "height")}
        values[side]["camera_model"] = DEPTHAI_MODELS.get(kind, f"cameraType {escaped(str(kind), 20)}")
        values[side]["T_body_cam"] = pose.tolist()
    if len(ends) > 1:
        raise broken
    notes.append(f"sockets {sockets[0]} (left) and {sockets[1]} (right)")
    return values


def _mrcal(document: Values, file: str, size: Size | None, notes: list[str]) -> Values:
    """One camera in mrcal's .cameramodel: fx fy cx cy and OpenCV's coefficients, pose from a reference; m."""
    model, numbers = str(document["lensmodel"]), [float(number) for number in document["intrinsics"]]
    if not re.fullmatch(r"LENSMODEL_(PINHOLE|OPENCV(4|5|8|12))", model):
        raise refused("stereo-mrcal", file, model=escaped(model, 60))
    values = {"K": numbers[:4], "D": numbers[4:] or [0.0] * 4, "distortion_model": model.removeprefix("LENSMODEL_")}
    pose = rigid(document["extrinsics"][:3], document["extrinsics"][3:])
    return {**values, "size": document["imagersize"], "T_cam_body": pose.tolist()}


def _basalt(document: Values, file: str, size: Size | None, notes: list[str]) -> Values:
    """Basalt's calibration.json: pose of each camera in the body as a quaternion, m."""
    content, values = document["value0"], Values()
    cameras = zip(SIDES, content["T_imu_cam"], content["intrinsics"], content["resolution"], strict=False)
    for side, pose, lens, pixels in cameras:
        turn, shift = ([pose[key] for key in names] for names in (("qx", "qy", "qz", "qw"), ("px", "py", "pz")))
        inner, model = lens["intrinsics"], str(lens["camera_type"])
        order = ("k1", "k2", "k3", "k4") if model == "kb4" else RATIONAL
        values[side] = {key: inner[key] for key in FOCAL} | {"camera_model": model, "size": pixels}
        values[side]["D"] = [inner[key] for key in order if key in inner] or [0.0] * 4
        values[side]["T_body_cam"] = rigid(turn, shift).tolist()
    notes += [FIRST_TWO.format(len(content["intrinsics"]))] * (len(content["intrinsics"]) > 2)
    return values


def _calibio(document: Values, file: str, size: Size | None, notes: list[str]) -> Values:
    """calib.io's stereo.json: f and its ratio, OpenCV's coefficients, pose from a reference; m."""
    cameras, values, name = document["Calibration"]["cameras"], Values(), ""
    for side, camera in zip(SIDES, cameras, strict=False):
        # Only the first object of a class states its name (cereal).
        name = camera["model"].get("polymorphic_name", name)
        if name != "libCalib::CameraModelOpenCV":
            raise refused("stereo-calibio", file, model=escaped(str(name), 60))
        data, pose = camera["model"]["ptr_wrapper"]["data"], camera["transform"]
        stated = {key: float(entry["val"]) for key, entry in data["parameters"].items()}
        values[side] = {"K": [stated["f"], stated["f"] * stated["ar"], stated["cx"], stated["cy"]], "model": "rational"}
        values[side] |= data["CameraModelCRT"]["CameraModelBase"]["imageSize"]
        values[side]["D"] = [stated.get(key, 0.0) for key in RATIONAL]
        turn, shift = [pose["rotation"][f"r{axis}"] for axis in "xyz"], [pose["translation"][axis] for axis in "xyz"]
        values[side]["T_cam_body"] = rigid(turn, shift).tolist()
    notes += [FIRST_TWO.format(len(cameras))] * (len(cameras) > 2)
    return values


def _metashape(document: Values, file: str, size: Size | None, notes: list[str]) -> Values:
    """Metashape's cameras.xml: cx and cy from the middle of the picture, p1 and p2 exchanged, fx = f + b1.

    Appendix C of the Metashape manual; the middle of a picture is at half its size, pixels have their integers at the
    centre here. The transform of a camera is its pose in the chunk, whose unit is a metre only where it has a scale.
    """

    def each(tables: Any) -> list[Values]:
        return tables if isinstance(tables, list) else [tables]

    chunk = document["chunk"]
    sensors = {sensor["id"]: sensor for sensor in each(chunk["sensors"]["sensor"])}
    cameras = [camera for camera in each(chunk["cameras"]["camera"]) if len(camera.get("transform", ())) == 16]
    if len(cameras) != 2:
        raise refused("stereo-metashape-poses", file, count=len(cameras))
    # A project without a scale has 1.
    parts = [part.get("transform") for part in (chunk, *each(chunk.get("components", {}).get("component", [])))]
    scales = [part["scale"] for part in parts if isinstance(part, dict) and "scale" in part] or [1.0]
    scale = float(scales[0]["value"] if isinstance(scales[0], dict) else scales[0])
    values: Values = {"unit": "?" if scale == 1.0 else "m"}
    for side, camera in zip(SIDES, cameras, strict=True):
        sensor = sensors[camera["sensor_id"]]
        stated = {"b1": 0.0, "b2": 0.0, "cx": 0.0, "cy": 0.0, **each(sensor["calibration"])[-1]}
        if sensor.get("type") != "frame" or any(stated.get(key) for key in ("b2", "k4", "p3", "p4")):
            raise refused("stereo-metashape-lens", file, model=escaped(str(sensor.get("type")), 20))
        width, height = (int(stated["resolution"][key]) for key in ("width", "height"))
        middle = width / 2 - 0.5 + stated["cx"], height / 2 - 0.5 + stated["cy"]
        values[side] = {"K": [stated["f"] + stated["b1"], stated["f"], *middle], "width": width, "height": height}
        values[side]["D"] = [float(stated.get(key, 0.0)) for key in ("k1", "k2", "p2", "p1", "k3")]
        scaled = np.reshape(camera["transform"], (4, 4)) * np.array([[1, 1, 1, scale]] * 3 + [[1, 1, 1, 1]])
        values[side]["T_body_cam"] = scaled.tolist()
    left, right = (escaped(str(camera.get("label")), 40) for camera in cameras)
    notes.append(f"left is {left}, right {right}")
    return values


_PRINTED: dict[str, Callable[[str], list[Values]]] = {
    r"(?i)^[ \t]*\[LEFT_CAM_\w+\]\s*$": lambda text: [{"printed zed": text}],
    rf'(?s)Intrinsic of "[^"\n]+" / [0-9]+x[0-9]|{_OBJECT}.*{_OBJECT}': lambda text: [{"printed realsense": text}],
    r"\A\s*Calibration results\s*\n=+\s*\n": _kalibr_text,
    r"\A\s*# oST version": _ost_text,
    r"^[ \t]*ParGroup: Cam\d|^# Used representation type": _halcon_text,
}
"""Readers of printed text by a mark in it; what needs the size of the pictures is read later."""

_STRUCTURES: dict[str, tuple[Callable[[Values, str, Size | None, list[str]], Values], str, str]] = {
    "cameraData": (_depthai, "depthai", "cm"),
    "printed realsense": (_realsense, "realsense", "m"),
    "printed zed": (_zed, "zed", "mm"),
    "lensmodel": (_mrcal, "mrcal", "m"),
    "value0": (_basalt, "basalt", "m"),
    "Calibration": (_calibio, "calib.io", "m"),
    "chunk": (_metashape, "metashape", "m"),
}
"""Readers by a key at the top of the file, with the program and its unit of lengths."""
