"""Stereo calibrations of other tools: OpenCV's YAML and JSON, ROS camera_info, Kalibr camchains; and `stereo.json`.

None of these formats carries an uncertainty. An import therefore gets the covariance of `assumed_covariance` and
`assumed = true`.
Lengths in `Stereo` are mm; ROS and Kalibr write metres, OpenCV whatever unit the squares had.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from tvsbayes.cameras.assumed_covariance import GUESS_FACTOR, Known, with_assumed_covariance
from tvsbayes.cameras.calibration_yaml import MATRIX_TAG, YAML_BYTES_MAX, parse_yaml
from tvsbayes.errors import escaped, refusal
from tvsbayes.files.disk import read_bytes
from tvsbayes.files.documents import Keys, parse_json
from tvsbayes.instrument.stereo_pair import (
    ASSUMED_REMEDY,
    Stereo,
    pair_doubts,
    parse_stereo,
    rotation_matrix,
    rotation_vector,
    stereo_bytes,
)

ROTATION_TOLERANCE = 1e-3
"""R from a file of few digits may miss a rotation by this much; the nearest rotation is taken."""
SHORTEST_MM = 1.0
M_TO_MM = 1000.0
RMS_PX_MAX, VIEWS_MAX = 20.0, 100_000
NOTHING_KNOWN = Known()
_MADE_BY = {
    **dict.fromkeys(("rms", "rms_px", "rms_error", "stereo_rms", "reprojection_error"), "rms_px"),
    **dict.fromkeys(("avg_reprojection_error", "reprojectionerror", "reprojection_rms", "ret", "retval"), "rms_px"),
    **dict.fromkeys(("views", "n_views", "num_views", "nframes", "nr_of_frames", "num_images"), "views"),
    **dict.fromkeys(("board_width", "board_columns", "board_cols"), "columns"),
    **dict.fromkeys(("board_height", "board_rows"), "rows"),
}
"""Keys, in small letters, under which files say how they were made, and what each is in `Known`. The pitch is left out:
its unit is not known."""
Format = Literal["opencv", "ros"]
_OPENCV_KEYS = ("M1", "M2", "R", "T")
EXPORT_NAMES: dict[Format, tuple[str, str]] = {
    "opencv": ("intrinsics.yml", "extrinsics.yml"),
    "ros": ("left.yaml", "right.yaml"),
}
"""The files of an export."""


@dataclass(frozen=True)
class Imported:
    """A calibration of another tool.

    Attributes:
        stereo: the pair, mm and px.
        source: opencv, ros, kalibr or tvsbayes.
        notes: what was assumed.
        warnings: what makes it implausible (`pair_doubts`).
    """

    stereo: Stereo
    source: str
    notes: tuple[str, ...]
    warnings: tuple[str, ...]


def read_calibration(
    paths: Sequence[Path], size: tuple[int, int] | None = None, *, unit_mm: float = 1.0, stated: Known = NOTHING_KNOWN
) -> Imported:
    """A stereo calibration from the files of another tool, or from `stereo.json`.

    Args:
        paths: OpenCV: one file or two; ROS: both cameras' camera_info; Kalibr: one camchain; `stereo.json`.
        size: image width and height, px, where the files do not tell (OpenCV).
        unit_mm: unit of OpenCV's T, mm.
        stated: how it was made, and how uncertain it is: for the covariance that no such file has.

    Raises:
        InputError: unreadable, unknown or contradictory.
    """
    names = [escaped(Path(path).name) for path in paths]
    contents = [read_bytes(path, YAML_BYTES_MAX) for path in paths]
    files = [_keys(path, data, name) for path, data, name in zip(paths, contents, names, strict=True)]
    if len(paths) == 1 and Path(paths[0]).suffix.lower() == ".json" and not _by_opencv(files[0]):
        stereo = parse_stereo(contents[0], names[0])
        if stated != NOTHING_KNOWN:
            if not stereo.assumed:
                remedy = "leave out --rms-px, --views, --board, --pitch-mm, --u-...: they are for files without one"
                raise refusal("usage", file=names[0], found="its own covariance", allowed="no other", remedy=remedy)
            stereo = with_assumed_covariance(stereo, stated, NOTHING_KNOWN)
        return Imported(stereo, "tvsbayes", (), pair_doubts(stereo))
    if any("cam0" in keys for keys in files):
        if len(files) != 1:
            remedy = "name one camchain"
            raise refusal("usage", file=names[0], found=f"{len(files)} files", allowed="one file", remedy=remedy)
        source, (stereo, notes) = "kalibr", _kalibr(files)
    elif any("projection_matrix" in keys for keys in files):
        source, (stereo, notes) = "ros", _ros(files)
    elif any(key in keys for keys in files for key in _OPENCV_KEYS):
        source, (stereo, notes) = "opencv", _opencv(files, size, unit_mm)
    else:
        one = any("camera_matrix" in keys or "Camera_Matrix" in keys for keys in files)
        found = "the calibration of one camera" if one else "no calibration that is known here"
        allowed = "OpenCV's M1 D1 M2 D2 R T, ROS camera_info of both cameras, a Kalibr camchain, stereo.json"
        remedy = "a pair needs R and T between its cameras: calibrate both together"
        raise refusal("format", file=names[0], found=found, allowed=allowed, remedy=remedy)
    way = {"ros": True, "kalibr": False}.get(source)
    stereo = with_assumed_covariance(stereo, stated, _made_by(files, way))
    good_to = f"all its sds together are good to a factor of {GUESS_FACTOR:g}"
    notes.append(f"the file has no covariance: assumed from {stereo.assumed_from}; {good_to}")
    notes.append(f"for a better one {ASSUMED_REMEDY}")
    return Imported(stereo, source, tuple(notes), pair_doubts(stereo))


def _made_by(files: Sequence[Keys], fixed_intrinsics: bool | None) -> Known:
    """What files say of how they were made."""
    values: dict[str, float] = {}
    for keys in files:
        for key, value in keys.values.items():
            name = _MADE_BY.get(key.lower())
            if name is not None and isinstance(value, int | float) and not isinstance(value, bool) and value > 0:
                values.setdefault(name, value)
    columns, rows = values.get("columns", 0), values.get("rows", 0)
    views = values.get("views", 0.0)
    return Known(
        rms_px=values["rms_px"] if values.get("rms_px", math.inf) <= RMS_PX_MAX else None,
        views=int(views) if 3 <= views <= VIEWS_MAX else None,
        board=(int(columns), int(rows)) if 3 <= columns <= 100 and 3 <= rows <= 100 else None,
        fixed_intrinsics=fixed_intrinsics,
    )


def _keys(path: Path, data: bytes, name: str) -> Keys:
    """The top map of a file: JSON by its suffix, else YAML."""
    return (parse_json if Path(path).suffix.lower() == ".json" else parse_yaml)(data, name)


def _by_opencv(keys: Keys) -> bool:
    """Whether a JSON file is OpenCV's (FileStorage): its matrices are maps, those of `stereo.json` lists."""
    return "format" not in keys and any(isinstance(keys.values.get(key), dict) for key in _OPENCV_KEYS)


def exported(stereo: Stereo, form: Format) -> dict[str, bytes]:
    """Files by name for another tool; none of them keeps the covariance.

    `opencv`: `intrinsics.yml` (M1 D1 M2 D2, image size) and `extrinsics.yml` (R T R1 R2 P1 P2 Q) of the stereo
    sample, mm. `ros`: `left.yaml` and `right.yaml`, camera_info, metres.
    """
    import cv2

    size = (stereo.image_width, stereo.image_height)
    # alpha = 0: only pixels that both cameras have, as ROS' calibrator and OpenCV's sample do by default.
    R1, R2, P1, P2, Q, *_ = cv2.stereoRectify(
        stereo.M1, stereo.D1, stereo.M2, stereo.D2, size, stereo.R, stereo.T.reshape(3, 1), alpha=0
    )
    if form == "opencv":
        inner = {"M1": stereo.M1, "D1": stereo.D1[None], "M2": stereo.M2, "D2": stereo.D2[None]}
        outer = {"R": stereo.R, "T": stereo.T[:, None], "R1": R1, "R2": R2, "P1": P1, "P2": P2, "Q": Q}
        sizes = {"image_width": size[0], "image_height": size[1]}
        return dict(zip(EXPORT_NAMES[form], (_opencv_text(inner, sizes), _opencv_text(outer, {})), strict=True))
    files = {}
    cameras = (("left", stereo.M1, stereo.D1, R1, P1), ("right", stereo.M2, stereo.D2, R2, P2))
    for file, (name, matrix, distortion, turn, projection) in zip(EXPORT_NAMES[form], cameras, strict=True):
        in_metres = np.array(projection, float)
        in_metres[:, 3] /= M_TO_MM
        matrices = {
            "camera_matrix": matrix,
            "distortion_coefficients": distortion[None],
            "rectification_matrix": turn,
            "projection_matrix": in_metres,
        }
        files[file] = _ros_text(name, size, matrices)
    return files


@dataclass(frozen=True)
class _Camera:
    """Inner parameters of one camera: matrix (3, 3) and k1 k2 p1 p2 k3."""

    matrix: np.ndarray
    distortion: np.ndarray


def _matrix(keys: Keys, key: str, *shapes: tuple[int, int]) -> np.ndarray:
    """A matrix of rows, cols, data (OpenCV, ROS) or of nested lists (Kalibr), in one of `shapes`."""
    allowed = "finite numbers, " + " or ".join("x".join(map(str, shape)) for shape in shapes)
    remedy = "take the file as its tool wrote it"
    value = keys.values.get(key)
    if isinstance(value, dict):
        table = keys.table(key)
        shape = table.integer("rows", 1, 1000), table.integer("cols", 1, 1000)
        entries = value.get("data")
    else:
        rows = value if isinstance(value, list) else []
        nested = bool(rows) and all(isinstance(row, list) for row in rows)
        widths = {len(row) for row in rows} if nested else {len(rows)}
        shape = (len(rows) if nested else 1, min(widths))
        entries = [x for row in rows for x in row] if nested else rows
        if len(widths) > 1:
            entries = None
    numbers = entries if isinstance(entries, list) else []
    good = all(isinstance(x, int | float) and abs(x) <= 1e12 for x in numbers)
    if not good or shape not in shapes or len(numbers) != shape[0] * shape[1]:
        found = "x".join(map(str, shape)) if value is not None and shape not in shapes else None
        raise keys.refuse(key, "matrix", allowed, remedy, found)
    return np.array(numbers, float).reshape(shape)


def _distortion(keys: Keys, key: str) -> np.ndarray:
    """k1 k2 p1 p2 k3; further coefficients must be zero."""
    shapes = [shape for n in (4, 5, 8, 12, 14) for shape in ((1, n), (n, 1))]
    values = _matrix(keys, key, *shapes).ravel()
    if values[5:].any():
        allowed, remedy = "k1 k2 p1 p2 k3 (plumb bob)", "calibrate again without the rational or thin prism model"
        raise keys.refuse(key, "distortion", allowed, remedy, f"{values.size} coefficients, not all beyond k3 zero")
    return np.append(values, 0.0)[:5] if values.size == 4 else values[:5]


def _rotation(keys: Keys, key: str, matrix: np.ndarray) -> np.ndarray:
    """The nearest rotation, where the file's digits allow."""
    deviation = max(np.abs(matrix @ matrix.T - np.eye(3)).max(), abs(np.linalg.det(matrix) - 1.0))
    if not deviation <= ROTATION_TOLERANCE:
        allowed = f"R R^T = 1 and det R = +1 to {ROTATION_TOLERANCE:g}"
        remedy = "take the file as its tool wrote it"
        raise keys.refuse(key, "rotation", allowed, remedy, f"a matrix that misses it by {deviation:.3g}")
    return rotation_matrix(rotation_vector(matrix))


def _size(keys: Sequence[Keys], size: tuple[int, int] | None) -> tuple[int, int]:
    """Image size from the files, else as given."""
    for table in keys:
        if "image_width" in table:
            return table.integer("image_width", 1, 65_535), table.integer("image_height", 1, 65_535)
    if size is None:
        remedy = "give it with --image-size, for example 1280x720"
        raise refusal("missing-key", file=keys[0].file, found="no image size", allowed="image_width", remedy=remedy)
    return size


def _opencv(files: Sequence[Keys], size: tuple[int, int] | None, unit_mm: float) -> tuple[Stereo, list[str]]:
    """M1 D1 M2 D2 and R T of the stereo sample, in one file or two."""
    home = {}
    for key in ("M1", "D1", "M2", "D2", "R", "T"):
        holders = [keys for keys in files if key in keys]
        if len(holders) != 1:
            found = f"{key} in {len(holders)} of the files"
            remedy = "name both files: --import intrinsics.yml --import extrinsics.yml"
            raise refusal("missing-key", file=files[0].file, found=found, allowed="M1 D1 M2 D2 R T once", remedy=remedy)
        home[key] = holders[0]
    translation = _matrix(home["T"], "T", (3, 1), (1, 3)).ravel() * unit_mm
    if np.linalg.norm(translation) < SHORTEST_MM:
        found = f"cameras {np.linalg.norm(translation):.3g} mm apart"
        remedy = "OpenCV keeps the unit of the squares: give --import-unit m if they were in metres"
        raise home["T"].refuse("T", "unit", f"at least {SHORTEST_MM:g} mm", remedy, found)
    left, right = (
        _Camera(_matrix(home[f"M{n}"], f"M{n}", (3, 3)), _distortion(home[f"D{n}"], f"D{n}")) for n in (1, 2)
    )
    rotation = _rotation(home["R"], "R", _matrix(home["R"], "R", (3, 3)))
    stereo = _stereo(_size(files, size), left, right, rotation, translation)
    return stereo, [f"T is taken in {'mm' if unit_mm == 1 else 'm'}: OpenCV's files do not state a unit"]


def _ros(files: Sequence[Keys]) -> tuple[Stereo, list[str]]:
    """Two camera_info files. Rectified, the right camera sees x' = x + (P03 / P00, 0, 0): R = R2^T R1, T = R2^T t."""
    if len(files) != 2:
        remedy = "name both cameras' files: --import left.yaml --import right.yaml"
        found = f"{len(files)} file{'s' * (len(files) != 1)}"
        raise refusal("missing-file", file=files[0].file, found=found, allowed="two camera_info files", remedy=remedy)
    projections = [_matrix(keys, "projection_matrix", (3, 4)) for keys in files]
    if projections[1][0, 3] == 0 and projections[0][0, 3] != 0:
        files, projections = files[::-1], projections[::-1]
    cameras, turns = [], []
    for keys in files:
        keys.word("distortion_model", ("plumb_bob",))
        matrix = _matrix(keys, "camera_matrix", (3, 3))
        cameras.append(_Camera(matrix, _distortion(keys, "distortion_coefficients")))
        turn = _matrix(keys, "rectification_matrix", (3, 3))
        turns.append(_rotation(keys, "rectification_matrix", turn))
    sizes = [_size([keys], None) for keys in files]
    left, right = projections
    if sizes[0] != sizes[1] or left[0, 3] != 0 or right[0, 3] == 0 or not right[0, 0] > 0:
        allowed = "P[0][3] = 0 in the left file, -fx baseline (m) in the right one; images of one size"
        remedy = "take both files from one stereo calibration"
        raise files[1].refuse("projection_matrix", "projection", allowed, remedy, "files that are no stereo pair")
    shift = np.array([right[0, 3] / right[0, 0], right[1, 3] / right[1, 1] if right[1, 1] else 0.0, 0.0])
    stereo = _stereo(sizes[0], cameras[0], cameras[1], turns[1].T @ turns[0], M_TO_MM * turns[1].T @ shift)
    return stereo, []


def _kalibr(files: Sequence[Keys]) -> tuple[Stereo, list[str]]:
    """cam0 and cam1 of a camchain; T_cn_cnm1 maps points of cam0 into cam1."""
    keys = files[0]
    cameras, sizes = [], []
    for name in ("cam0", "cam1"):
        camera = keys.table(name)
        camera.word("camera_model", ("pinhole",))
        camera.word("distortion_model", ("radtan",))
        fu, fv, pu, pv = _matrix(camera, "intrinsics", (1, 4)).ravel()
        matrix = np.array([[fu, 0.0, pu], [0.0, fv, pv], [0.0, 0.0, 1.0]])
        cameras.append(_Camera(matrix, _distortion(camera, "distortion_coeffs")))
        width, height = _matrix(camera, "resolution", (1, 2)).ravel()
        sizes.append((int(width), int(height)))
    camera = keys.table("cam1")
    if sizes[0] != sizes[1]:
        raise camera.refuse("resolution", "image-size", "two images of one size", "calibrate them at one size")
    pose = _matrix(camera, "T_cn_cnm1", (4, 4))
    turn = _rotation(camera, "T_cn_cnm1", pose[:3, :3])
    stereo = _stereo(sizes[0], cameras[0], cameras[1], turn, M_TO_MM * pose[:3, 3])
    return stereo, ["radtan has no k3: it is 0 and as uncertain"]


def _stereo(
    size: tuple[int, int], left: _Camera, right: _Camera, rotation: np.ndarray, translation_mm: np.ndarray
) -> Stereo:
    """Checked as `stereo.json` is; without a covariance."""
    inner = left.matrix, left.distortion, right.matrix, right.distortion
    bare = Stereo(*size, *inner, rotation, translation_mm, np.zeros((24, 24)), 0.0, assumed=True)
    return parse_stereo(stereo_bytes(bare), "the imported calibration")


def _opencv_text(matrices: Mapping[str, np.ndarray], numbers: Mapping[str, int]) -> bytes:
    """OpenCV's YAML 1.0 of 2-D matrices: 4.x and 5.x read it alike."""
    lines = ["%YAML:1.0", "---", *(f"{key}: {value}" for key, value in numbers.items())]
    for key, matrix in matrices.items():
        rows, cols = matrix.shape
        data = ", ".join(map(repr, map(float, matrix.ravel())))
        lines += [f"{key}: {MATRIX_TAG}", f"   rows: {rows}", f"   cols: {cols}", "   dt: d", f"   data: [ {data} ]"]
    return ("\n".join(lines) + "\n").encode()


def _ros_text(name: str, size: tuple[int, int], matrices: Mapping[str, np.ndarray]) -> bytes:
    lines = [f"image_width: {size[0]}", f"image_height: {size[1]}", f"camera_name: {name}"]
    for key, matrix in matrices.items():
        if key == "distortion_coefficients":
            lines.append("distortion_model: plumb_bob")
        rows, cols = matrix.shape
        data = ", ".join(map(repr, map(float, matrix.ravel())))
        lines += [f"{key}:", f"  rows: {rows}", f"  cols: {cols}", f"  data: [{data}]"]
    return ("\n".join(lines) + "\n").encode()
