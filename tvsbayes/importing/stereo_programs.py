"""Calibrations in the formats of programs and of makers of cameras, converted to the names of `data/words/stereo.toml`.

These formats need more than names: cameras are given by the number of a socket and poses by a chain (DepthAI), each
size of the pictures has its calibration (ZED, RealSense), numbers stand in sentences (Kalibr, ROS' ost), or origins and
orders differ (Metashape). Each becomes tables `left` and `right` with poses; numbers change only as the format defines.
"""

from __future__ import annotations

import configparser
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np

from tvsbayes.errors import escaped, listed
from tvsbayes.files.csv_table import NUMBER
from tvsbayes.files.documents import Keys
from tvsbayes.importing.stereo_words import refused, words

Size = tuple[int, int]
Values = dict[str, Any]
DEPTHAI_MODELS = {0: "perspective", 1: "equidistant"}
"""`CameraModel` of depthai-core; its fisheye is OpenCV's of four coefficients."""
STEREO_STREAMS = ("Infrared 1", "Infrared 2")
"""The left and the right camera of a RealSense D400."""
STREAMS_MAX = 1000
RATIONAL = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tauX", "tauY")
"""OpenCV's order of the coefficients of a rational lens."""
FIRST_TWO = "cameras 1 (left) and 2 (right) of {}"


class Adapted(NamedTuple):
    """A calibration under known names; `unit` of lengths is m, cm or mm, or "?" where the numbers have none."""

    keys: Keys
    source: str
    unit: str
    notes: list[str]


def printed_trees(text: str) -> list[Values]:
    """What a program prints as text, a table for each camera or one; none for any other text, ValueError if broken."""
    with np.errstate(over="raise", invalid="raise", divide="raise"):
        return next((read(text) for mark, read in _PRINTED if mark.search(text)), [])


def adapted(keys: Keys, size: Size | None) -> Adapted | None:
    """A program's own structure under known names; None for any other file. `size` as the user states it, px.

    Raises:
        InputError: no pair in the file, a lens that is none of ours, or several picture sizes and none stated.
    """
    for key, (read, source, unit) in _STRUCTURES.items():
        if key in keys.values:
            notes: list[str] = []
            try:
                with np.errstate(over="raise", invalid="raise", divide="raise"):
                    values = read(keys.values, keys.file, size, notes)
                unit = str(values.pop("unit", unit))
                return Adapted(Keys(values, keys.file, keys.text), source, unit, notes)
            except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError, cv2.error) as error:
                raise refused("structure", keys.file, error=escaped(str(error), 60)) from error
    return None


def _numbers(text: str) -> list[float]:
    return [float(word) for word in re.split(r"[\s,;\[\]]+", text) if NUMBER.fullmatch(word)]


def _homogeneous(turn: Any, shift: Any) -> np.ndarray:
    """Transformation (4, 4) of Rodrigues' vector, a matrix, or a quaternion x y z w, and a shift."""
    turn = np.array(turn, float)
    if turn.size == 4:
        x, y, z, w = turn / np.linalg.norm(turn)
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        turn = np.eye(3) + 2 * w * cross + 2 * cross @ cross
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(turn)[0] if turn.size == 3 else turn.reshape(3, 3)
    pose[:3, 3] = np.array(shift, float).ravel()
    return pose


def _zed_text(text: str) -> list[Values]:
    """Sections of an ini file, keys in lower case."""
    parser = configparser.ConfigParser(interpolation=None, inline_comment_prefixes=(";", "#"))
    try:
        parser.read_string(text)
    except configparser.Error as error:
        raise ValueError(str(error).replace("\n", " ")) from error
    values = {
        name.lower(): {key: float(word) if NUMBER.fullmatch(word) else word for key, word in section.items()}
        for name, section in parser.items()
        if name != parser.default_section
    }
    return [{"printed zed": values}]


_STREAM = re.compile(r'Intrinsic of "([^"\n]+)" / ([0-9]{1,6})x([0-9]{1,6})(.*)', re.DOTALL)
_POSE = re.compile(r'Extrinsic from "([^"\n]+)"\s+To\s+"([^"\n]+)"\s*:(.*)', re.DOTALL)
_OBJECT = (
    r"\[\s*([0-9]{1,6})x([0-9]{1,6})\s+p\[(\S+)\s+([^\]\s]+)\]\s+f\[(\S+)\s+([^\]\s]+)\]\s+"
    r"([A-Za-z][\w ]*?)\s*\[([^\]]*)\]\s*\]"
)
_POSE_OBJECT = re.compile(r"rotation:\s*\[([^\]]*)\]\s*translation:\s*\[([^\]]*)\]")


def _realsense_text(text: str) -> list[Values]:
    """Streams and poses between them, from `rs-enumerate-devices -c` or of printed objects of pyrealsense2.

    The tool prints R row by row (`print` in rs-enumerate-devices.cpp), an object has it column by column (rs_types.h).
    """

    def stream(name: str, size: Sequence[str], fields: Mapping[str, str], model: str, coefficients: str) -> Values:
        inner: Values = {key: values[0] for key, word in fields.items() if (values := _numbers(word))}
        inner |= {"distortion_model": model.strip(), "D": _numbers(coefficients)}
        return {"name": name, "width": int(size[0]), "height": int(size[1]), **inner}

    def line(text: str, key: str) -> str:
        return text.partition(f"{key}:")[2].split("\n")[0]

    streams, poses = [], []
    parts = re.split(r'(?=Intrinsic of "|Extrinsic from ")', text, maxsplit=STREAMS_MAX)
    for name, width, height, rest in (match.groups() for part in parts if (match := _STREAM.match(part))):
        fields = {key.lower(): line(rest, key) for key in ("PPX", "PPY", "Fx", "Fy")}
        streams.append(stream(name, (width, height), fields, line(rest, "Distortion"), line(rest, "Coeffs")))
    for source, target, rest in (match.groups() for part in parts if (match := _POSE.match(part))):
        turn, _, shift = rest.partition("Translation Vector:")
        poses.append({"from": source, "to": target, "R": _numbers(turn), "T": _numbers(shift.strip().split("\n")[0])})
    for k, (width, height, ppx, ppy, fx, fy, model, rest) in enumerate(re.findall(_OBJECT, text), start=1):
        fields = {"ppx": ppx, "ppy": ppy, "fx": fx, "fy": fy}
        streams.append(stream(f"camera {k}", (width, height), fields, model, rest))
    for turn, shift in _POSE_OBJECT.findall(text):
        rows = np.array(by_columns).reshape(3, 3).T.ravel().tolist() if len(by_columns := _numbers(turn)) == 9 else []
        poses.append({"from": "camera 1", "to": "camera 2", "R": rows, "T": _numbers(shift)})
    return [{"printed realsense": {"streams": streams, "poses": poses}}]


def _kalibr_text(text: str) -> list[Values]:
    """Kalibr's results-cam.txt: the numbers of its camchain, without the size of the pictures; uncertainties stay."""
    values, errors_px = Values(), list[float]()
    for name, body in re.findall(r"^(cam\d) .*?:\n((?:[ \t]+\S.*\n?)*)", text, re.MULTILINE):
        lines = dict(re.findall(r"^\s*([\w ]+): (.*)$", body, re.MULTILINE))
        model = "".join(re.findall(r"(\w+)CameraGeometry", lines.get("type", ""))).replace("Distorted", "").lower()
        model = {"pinhole": "radtan", "equidistantpinhole": "equidistant"}.get(model, model or "no type")
        numbers = {key: _numbers(lines.get(key, "").partition("+-")[0]) for key in ("projection", "distortion")}
        values[name] = {"intrinsics": numbers["projection"], "distortion_coeffs": numbers["distortion"]}
        values[name]["distortion_model"] = model
        errors_px += _numbers(lines.get("reprojection error", "").partition("+-")[2])
    for before, after, turn, shift in re.findall(r"T_(\d)_(\d):\s*q: (\[.*?\]).*\n\s*t: (\[.*?\])", text):
        quaternion = _numbers(turn)
        if f"cam{before}" in values and int(before) == int(after) + 1 and len(quaternion) == 4 and any(quaternion):
            # JPL's quaternion of Kalibr turns the other way than Hamilton's: its R is the transpose.
            pose = _homogeneous(quaternion, _numbers(shift))
            pose[:3, :3] = pose[:3, :3].T
            values[f"cam{before}"]["T_cn_cnm1"] = pose.tolist()
    if errors_px:
        values["rms_px"] = float(np.sqrt(np.sum(np.square(errors_px)) * 2 / len(errors_px)))
    return [values | {"size_in": "camchain-*.yaml of Kalibr"}]


def _ost_text(text: str) -> list[Values]:
    """ost.txt of ROS' camera_calibration: the numbers of camera_info, one camera after the other."""
    trees = []
    for part in re.split(r"^[ \t]*\[image\][ \t]*$", text, flags=re.MULTILINE)[1:]:
        found = re.findall(r"^([a-z ]+)\n((?:[\d.eE+\- \t]+\n?)+)", part, re.MULTILINE)
        blocks = {name: _numbers(rows) for name, rows in found}
        values: Values = {f"image_{key}": int(blocks[key][0]) for key in ("width", "height") if blocks.get(key)}
        for key, name in (("camera matrix", "K"), ("distortion", "D"), ("rectification", "R"), ("projection", "P")):
            values[name] = blocks.get(key, [])
        trees.append(values)
    return trees


def _halcon_text(text: str) -> list[Values]:
    found = "parameters of HALCON: a lens by division (Kappa) or in other units, R and T in another file"
    raise ValueError(found, "calibrate from the same pictures: `tvsbayes stereo FOLDER`")


_PRINTED: tuple[tuple[re.Pattern[str], Callable[[str], list[Values]]], ...] = (
    (re.compile(r"^[ \t]*\[LEFT_CAM_\w+\]\s*$", re.MULTILINE | re.IGNORECASE), _zed_text),
    (re.compile(rf'Intrinsic of "[^"\n]+" / [0-9]+x[0-9]|{_OBJECT}.*{_OBJECT}', re.DOTALL), _realsense_text),
    (re.compile(r"\A\s*Calibration results\s*\n=+\s*\n"), _kalibr_text),
    (re.compile(r"\A\s*# oST version"), _ost_text),
    (re.compile(r"^[ \t]*ParGroup: Cam\d|^# Used representation type", re.MULTILINE), _halcon_text),
)


def _name_of_size(sizes: Mapping[str, Size], size: Size | None, file: str) -> str:
    """The name of the size that the user states, or the only one."""
    matching = [name for name, picture_size in sizes.items() if size in (None, picture_size)]
    if len(matching) == 1:
        return matching[0]
    texts = [f"{width}x{height}" for width, height in sizes.values()]
    found = "no calibration of both cameras for one size"
    found = f"calibrations for pictures of {listed(texts, 8)} px" if texts else found
    raise refused("which-size", file, found=found, example=[*texts, "1280x720"][0])


def _zed(document: Values, file: str, size: Size | None, notes: list[str]) -> Values:
    """SN*.conf: R from the vector RX, CV, RZ; T = (-Baseline, TY, TZ) mm.

    As StereoLabs' zedx-one-capture writes it from cv2.stereoCalibrate (stereo_calibration/main.cpp).
    """
    sections = document["printed zed"]
    complete = {
        name: (width, height)
        for name, (width, height) in words()["zed"].items()
        if f"left_cam_{name}" in sections and f"right_cam_{name}" in sections
    }
    name = _name_of_size(complete, size, file)
    stereo = sections.get("stereo", {})

    def number(table: Values, section: str, key: str, default: float | None = None) -> float:
        value = table.get(f"{key}_{name}", table.get(key, default))
        if not isinstance(value, float):
            found = "nothing" if value is None else escaped(str(value), 40)
            raise refused("no-number", "", Keys({}, file, "", (section,)), key, found=found)
        return value

    values: Values = {}
    for side in ("left", "right"):
        section = f"{side}_cam_{name}"
        lens = sections.get(f"{side}_disto", sections[section])
        names = RATIONAL[:8] if "k4" in lens else RATIONAL[:5]
        values[side] = {key: number(sections[section], section, key) for key in ("fx", "fy", "cx", "cy")}
        values[side] |= dict(zip(("width", "height"), complete[name], strict=True))
        values[side]["D"] = [number(lens, section, key, 0.0 if key in ("p1", "p2", "k3") else None) for key in names]
    values["R"] = [number(stereo, "stereo", key) for key in ("rx", "cv", "rz")]
    if not {"ty", f"ty_{name}"} & set(stereo):
        notes.append("TY and TZ: none in the file, so 0")
    ty_tz = [number(stereo, "stereo", key, 0.0) for key in ("ty", "tz")]
    values["T"] = [-number(stereo, "stereo", "baseline"), *ty_tz]
    return values


def _depthai(document: Values, file: str, size: Size | None, notes: list[str]) -> Values:
    """EEPROM of an OAK: x_to = R x_from + T along a chain of sockets, cm (`CalibrationHandler` of depthai-core)."""
    cameras = {s: camera for s, camera in document["cameraData"] if isinstance(s, int) and isinstance(camera, dict)}
    stated = document.get("stereoRectificationData", {})
    sockets = [stated.get(f"{side}CameraSocket") for side in ("left", "right")]
    if not all(socket in cameras for socket in sockets) or sockets[0] == sockets[1]:
        # CAM_B and CAM_C are used where the rectification was never stored.
        sockets = [1, 2]
    chains = [chain for s in sockets if s in cameras and (chain := _chain_pose(cameras, s)) is not None]
    if len(chains) < 2 or len({end for end, _ in chains}) > 1:
        raise refused("chain", file, sockets=listed([str(s) for s in cameras], 8) if cameras else "none")
    (_, left), (_, right) = chains
    pose = np.linalg.inv(right) @ left
    values: Values = {"R": pose[:3, :3].tolist(), "T": pose[:3, 3].tolist()}
    for side, socket in zip(("left", "right"), sockets, strict=True):
        camera = cameras[socket]
        kind = camera.get("cameraType", 0)
        lens = {key: camera[key] for key in ("intrinsicMatrix", "distortionCoeff", "width", "height") if key in camera}
        values[side] = {**lens, "camera_model": DEPTHAI_MODELS.get(kind, f"cameraType {escaped(str(kind), 20)}")}
    notes.append(f"sockets {sockets[0]} (left) and {sockets[1]} (right)")
    return values


def _chain_pose(cameras: Mapping[int, Values], socket: int) -> tuple[int, np.ndarray] | None:
    """The last socket of a camera's chain, and the transformation (4, 4) to it; None for a broken chain."""
    pose = np.eye(4)
    for _ in cameras:
        extrinsics = cameras[socket]["extrinsics"]
        if extrinsics["toCameraSocket"] not in cameras:
            return socket, pose
        turn = np.array(extrinsics["rotationMatrix"], float)
        pose = _homogeneous(turn.reshape(9), [extrinsics["translation"][axis] for axis in "xyz"]) @ pose
        socket = extrinsics["toCameraSocket"]
    return None


def _realsense(document: Values, file: str, size: Size | None, notes: list[str]) -> Values:
    """The output of rs-enumerate-devices -c, or printed objects of pyrealsense2; lengths in m."""
    printed = document["printed realsense"]
    names = list(dict.fromkeys(stream["name"] for stream in printed["streams"]))
    pair = STEREO_STREAMS if set(STEREO_STREAMS) <= set(names) else tuple(names)
    poses = [p for p in printed["poses"] if (p["from"], p["to"]) == pair and len(p["R"]) == 9 and len(p["T"]) == 3]
    if len(pair) != 2 or not poses:
        raise refused("streams", file, streams=listed([escaped(name, 30) for name in names], 8))
    by_name = [{(s["width"], s["height"]): s for s in printed["streams"] if s["name"] == name} for name in pair]
    sizes = {f"{width}x{height}": (width, height) for width, height in by_name[0] if (width, height) in by_name[1]}
    chosen = sizes[_name_of_size(sizes, size, file)]
    values: Values = {side: streams[chosen] for side, streams in zip(("left", "right"), by_name, strict=True)}
    values |= {"R": np.reshape(poses[0]["R"], (3, 3)).tolist(), "T": poses[0]["T"]}
    notes.append(f"left is {escaped(pair[0], 30)}, right {escaped(pair[1], 30)}")
    return values


def _mrcal(document: Values, file: str, size: Size | None, notes: list[str]) -> Values:
    """One camera in mrcal's .cameramodel: fx fy cx cy and OpenCV's coefficients, pose from a reference; m."""
    model, numbers = str(document["lensmodel"]), [float(number) for number in document["intrinsics"]]
    if not re.fullmatch(r"LENSMODEL_(PINHOLE|OPENCV(4|5|8|12))", model):
        raise refused("mrcal", file, model=escaped(model, 60))
    values: Values = dict(zip(("fx", "fy", "cx", "cy"), numbers, strict=False))
    values |= {"distortion_model": model.removeprefix("LENSMODEL_").lower(), "D": numbers[4:] or [0.0] * 4}
    pose = _homogeneous(document["extrinsics"][:3], document["extrinsics"][3:])
    return values | {"size": document["imagersize"], "T_cam_body": pose.tolist()}


def _basalt(document: Values, file: str, size: Size | None, notes: list[str]) -> Values:
    """Basalt's calibration.json: pose of each camera in the body as a quaternion, m."""
    content = document["value0"]
    values: Values = {}
    for side, pose, lens, pixels in zip(
        ("left", "right"), content["T_imu_cam"], content["intrinsics"], content["resolution"], strict=False
    ):
        turn, shift = ([pose[key] for key in names] for names in (("qx", "qy", "qz", "qw"), ("px", "py", "pz")))
        inner, model = lens["intrinsics"], str(lens["camera_type"])
        order = ("k1", "k2", "k3", "k4") if model == "kb4" else RATIONAL
        values[side] = {key: inner[key] for key in ("fx", "fy", "cx", "cy")}
        values[side] |= {"D": [inner[key] for key in order if key in inner] or [0.0] * 4, "camera_model": model}
        values[side] |= {"size": pixels, "T_body_cam": _homogeneous(turn, shift).tolist()}
    notes += [FIRST_TWO.format(len(content["intrinsics"]))] * (len(content["intrinsics"]) > 2)
    return values


def _calibio(document: Values, file: str, size: Size | None, notes: list[str]) -> Values:
    """calib.io's stereo.json: f and its ratio, OpenCV's coefficients, pose from a reference; m."""
    values, name = Values(), ""
    cameras = document["Calibration"]["cameras"]
    for side, camera in zip(("left", "right"), cameras, strict=False):
        # Only the first object of a class states its name (cereal).
        name = camera["model"].get("polymorphic_name", name)
        if name != "libCalib::CameraModelOpenCV":
            raise refused("calibio", file, model=escaped(str(name), 60))
        data = camera["model"]["ptr_wrapper"]["data"]
        stated = {key: float(entry["val"]) for key, entry in data["parameters"].items()}
        values[side] = {"fx": stated["f"], "fy": stated["f"] * stated["ar"], "cx": stated["cx"], "cy": stated["cy"]}
        values[side] |= {"D": [stated.get(key, 0.0) for key in RATIONAL], "model": "rational"}
        values[side] |= data["CameraModelCRT"]["CameraModelBase"]["imageSize"]
        pose = camera["transform"]
        turn, shift = [pose["rotation"][f"r{axis}"] for axis in "xyz"], [pose["translation"][axis] for axis in "xyz"]
        values[side]["T_cam_body"] = _homogeneous(turn, shift).tolist()
    notes += [FIRST_TWO.format(len(cameras))] * (len(cameras) > 2)
    return values


def _metashape(document: Values, file: str, size: Size | None, notes: list[str]) -> Values:
    """Metashape's cameras.xml: cx and cy from the middle of the picture, p1 and p2 exchanged, fx = f + b1.

    Appendix C of the Metashape manual; the middle of a picture is at half its size, pixels have their integers at the
    centre here. The transform of a camera is its pose in the chunk, whose unit is a metre only where it has a scale.
    """

    def listed_in(table: Any, group: str, item: str) -> Iterator[Values]:
        found = table[group][item]
        yield from found if isinstance(found, list) else [found]

    chunk = document["chunk"]
    sensors = {sensor["id"]: sensor for sensor in listed_in(chunk, "sensors", "sensor")}
    cameras = [camera for camera in listed_in(chunk, "cameras", "camera") if len(camera.get("transform", ())) == 16]
    if len(cameras) != 2:
        raise refused("metashape-poses", file, count=len(cameras))
    values: Values = {}
    for side, camera in zip(("left", "right"), cameras, strict=True):
        sensor = sensors[camera["sensor_id"]]
        options = sensor["calibration"] if isinstance(sensor["calibration"], list) else [sensor["calibration"]]
        stated = {"b1": 0.0, "b2": 0.0, "cx": 0.0, "cy": 0.0, **options[-1]}
        if sensor.get("type") != "frame" or any(stated.get(key) for key in ("b2", "k4", "p3", "p4")):
            raise refused("metashape-lens", file, model=escaped(str(sensor.get("type")), 20))
        width, height = (int(stated["resolution"][key]) for key in ("width", "height"))
        values[side] = {"fx": stated["f"] + stated["b1"], "fy": stated["f"], "width": width, "height": height}
        values[side] |= {"cx": width / 2 - 0.5 + stated["cx"], "cy": height / 2 - 0.5 + stated["cy"]}
        values[side]["D"] = [float(stated.get(key, 0.0)) for key in ("k1", "k2", "p2", "p1", "k3")]
        values[side]["T_body_cam"] = np.reshape(camera["transform"], (4, 4)).tolist()
    components = chunk.get("components", {}).get("component", [])
    places = [part.get("transform") for part in (components if isinstance(components, list) else [components])]
    places = [place for place in (chunk.get("transform"), *places) if isinstance(place, dict)]
    scales = [place["scale"] for place in places if "scale" in place]
    scale = float(scales[0]["value"] if isinstance(scales[0], dict) else scales[0]) if scales else 1.0
    for side in ("left", "right"):
        rows = values[side]["T_body_cam"]
        values[side]["T_body_cam"] = [*([*row[:3], scale * row[3]] for row in rows[:3]), rows[3]]
    left, right = (escaped(str(camera.get("label")), 40) for camera in cameras)
    notes.append(f"left is {left}, right {right}")
    # A project without a scale has 1.
    return values | {"unit": "?" if scale == 1.0 else "m"}


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
