"""Stereo calibrations of other programs, recognised by content: M and D of two cameras, x_right = R x_left + T.

`stereo_trees` makes tables of a file, `stereo_programs` brings structures of programs to known names, `stereo_words`
finds the meaning of each number; here numbers become a pair by the names of `stereo.json`, with assumptions in words.
R and T can follow from several entries: all must agree. Lengths of a pair are mm; Kalibr, ROS and EuRoC write metres,
others the unit of the squares of their board.

Other lenses are fitted to k1 k2 p1 p2 k3 by linear least squares over a grid of pixels, the camera matrix unchanged.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from tvsbayes.errors import escaped
from tvsbayes.files.disk import read_bytes
from tvsbayes.files.documents import Keys
from tvsbayes.importing.stereo_programs import RATIONAL, adapted
from tvsbayes.importing.stereo_trees import TREE_BYTES_MAX, read_trees
from tvsbayes.importing.stereo_words import ROTATION_TOLERANCE, Entry, Fields, letters, refused, words

GRID = 25
"""Number of grid points along each side of the picture."""
ERROR_MAX_PX = 0.1
"""Largest accepted error of a fit, equal to that of a centroid."""
WIDEST_TAN = 4.0
"""Tangent of the angle off the axis, 76 deg, beyond which five coefficients are not tried."""
UNDISTORTION = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
"""Iterations, and the error of a distorted ray in px."""


class FittedLens(NamedTuple):
    """Five coefficients, their largest and rms error in the picture, px; infinite where the other model has no ray."""

    distortion: np.ndarray
    error_px: float
    rms_px: float


def kind_of(model: str) -> str | None:
    """The kind of a lens model by its name: five (also of no name), rational, fisheye or inverse; else None."""
    name = re.sub(r"[ -]", "_", model.strip().lower()).removeprefix("distortion.")
    return next((kind for kind, names in words()["lens"].items() if name in names.split()), None if name else "five")


def fitted_to_five(matrix: np.ndarray, distortion: np.ndarray, size: tuple[int, int], kind: str) -> FittedLens:
    """Fit five coefficients to another model in a picture of this size, px.

    `distortion` holds OpenCV's 8, 12 or 14 coefficients, the 4 of its fisheye model, or the 5 of the inverse one.
    """
    pixels: np.ndarray = np.stack(np.meshgrid(*(np.linspace(0, n - 1, GRID) for n in size)), axis=-1).reshape(-1, 2)
    target = (pixels - matrix[:2, 2]) / matrix[[0, 1], [0, 1]]
    rays: np.ndarray = target
    reprojected = pixels
    if kind == "inverse":
        rays = projected(target, np.eye(3), distortion)
    elif kind == "fisheye":
        four = distortion.reshape(4, 1)
        rays = cv2.fisheye.undistortPoints(pixels[:, None], matrix, four).reshape(-1, 2)
        reprojected = cv2.fisheye.distortPoints(rays[:, None], matrix, four).reshape(-1, 2)
    else:
        if hasattr(cv2, "undistortPointsIter"):  # OpenCV 4: undistortPoints takes no criteria in Python
            points = cv2.undistortPointsIter(pixels[:, None], matrix, distortion, None, None, UNDISTORTION)
        else:
            points = cv2.undistortPoints(pixels[:, None], matrix, distortion, criteria=UNDISTORTION)
        rays = points.reshape(-1, 2)
        reprojected = projected(rays, matrix, distortion)
    valid = np.isfinite(rays).all(axis=1) & (np.linalg.norm(rays, axis=1) < WIDEST_TAN)
    valid[valid] &= np.abs(reprojected[valid] - pixels[valid]).max(axis=1) < ERROR_MAX_PX
    if not valid.all():
        return FittedLens(np.zeros(5), np.inf, np.inf)
    columns = [(projected(rays, np.eye(3), unit) - rays).ravel() for unit in np.eye(5)]
    five = np.linalg.lstsq(np.stack(columns, axis=1), (target - rays).ravel())[0]
    errors_px = np.linalg.norm(projected(rays, matrix, five) - pixels, axis=1)
    return FittedLens(five, float(errors_px.max()), float(np.sqrt(np.mean(errors_px**2))))


def projected(rays: np.ndarray, matrix: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """Pixels (n, 2) of rays (n, 2) by any of OpenCV's pinhole models."""
    points = np.column_stack([rays, np.ones(len(rays))])
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, distortion)[0].reshape(-1, 2)


CAMERAS = ("left", "right")
UNITS_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
BASELINE_RANGE_MM = (20.0, 3000.0)
"""Distance of the cameras of one bench; outside this range the user must state the unit."""
RMS_PX_MAX, VIEWS_MAX = 20.0, 100_000
KEY_FIELDS = ("M1", "D1", "M2", "D2", "R", "T")
"""Fields that `--key` can name."""
FILES_MAX, ARRAY_FILES_MAX = 3, 40
FOCAL_MIN = 1e-9
TURN_NOTED_DEG = 0.5
"""Angle below which a rotation and its transpose are hardly different."""
SHAPE_SHARE_MAX = 0.005
"""Largest relative difference of the aspect ratios of two picture sizes: rounding to whole pixels."""


@dataclass(frozen=True)
class ForeignPair:
    """A calibration of another program, in plain numbers.

    Attributes:
        values: image_width, image_height, M1, D1 (k1 k2 p1 p2 k3), M2, D2, R, T in mm, as in `stereo.json`;
            right_image_size where the right camera's pictures have another size: its numbers are those of pictures
            scaled to the left one's.
        source: the program; opencv for any whose names are known.
        made: rms_px, views, board (columns and rows), fixed_intrinsics; None where the file does not say.
        notes, warnings: assumptions, and doubtful values.
        places: key and file of M1, M2, D1, D2, R, T, in words.
    """

    values: dict[str, Any]
    source: str
    made: dict[str, Any]
    notes: list[str]
    warnings: list[str]
    places: dict[str, str]


def read_files(paths: Sequence[Path]) -> list[Keys]:
    """The tables in files of a calibration; a folder stands for its arrays (.npy, else .txt), as do several such files.

    Raises:
        InputError: a file is unreadable, unknown or damaged, or a folder without arrays.
    """
    files: list[Path] = []
    for path in map(Path, paths):
        inner = [path]
        if path.is_dir():
            inner = sorted(path.glob("*.npy")) or sorted(path.glob("*.txt"))
            if not 0 < len(inner) <= ARRAY_FILES_MAX:
                raise refused("folder", escaped(str(path), 200), count=len(inner), most=ARRAY_FILES_MAX)
        files += inner
    trees = [tree for path in files for tree in read_trees(read_bytes(path, TREE_BYTES_MAX), escaped(path.name))]
    if len(trees) > 1:
        alone = [tree for tree in trees if set(tree.values) == {Path(tree.file).stem}]
        arrays = {name: value for tree in alone for name, value in tree.values.items()}
        trees = [tree for tree in trees if tree not in alone]
        trees += [Keys(arrays, escaped(files[0].parent.name or "the arrays"), "")] if arrays else []
    if len(trees) > FILES_MAX:
        raise refused("files", trees[0].file, count=len(trees))
    return trees


def foreign_pair(
    files: Sequence[Keys], size: tuple[int, int] | None, unit_mm: float | None, keys: Mapping[str, str]
) -> ForeignPair:
    """The pair in the tables of another program; options as of `cameras.imported_calibration.read_calibration`.

    Raises:
        InputError: unknown, contradictory, or of lenses that five coefficients do not describe.
    """
    programs = [adapted(tree, size) for tree in files]
    tables = [tree if program is None else program.keys for program, tree in zip(programs, files, strict=True)]
    reader = _Reader(Fields(tables, keys), size, unit_mm)
    for program in programs:
        if program is not None:
            reader.source, reader.unit = program.source, program.unit
            reader.notes += [f"{program.keys.file}: {note}" for note in program.notes]
    values = reader.pair()
    source = reader.source or "opencv"
    return ForeignPair(values, source, reader.made(source), reader.notes, reader.warnings, reader.places)


class _Pose(NamedTuple):
    """R (3, 3) and T (3,) of x_right = R x_left + T in the file's unit, their entries, and the program they show."""

    rotation: np.ndarray
    translation: np.ndarray
    turn: Entry
    shift: Entry
    source: str = ""
    plain: bool = False
    """Whether the name of R leaves its direction open."""


class _Reader:
    """Builds a pair from the entries by field."""

    def __init__(self, fields: Fields, size: tuple[int, int] | None, unit_mm: float | None):
        self.fields, self.stated_size, self.unit_mm = fields, size, unit_mm
        self.source = ""
        self.unit: str | None = None
        """As the format of a program states it."""
        self.notes: list[str] = []
        self.warnings: list[str] = []
        self.places: dict[str, str] = {}
        self.right_size: tuple[int, int] | None = None
        self.matrices: list[np.ndarray] = []
        """Of both cameras, as the file states them."""
        self.transposed: Entry | None = None
        """A camera matrix that the file stores by columns."""

    def pair(self) -> dict[str, Any]:
        """The pair by the names of `stereo.json`."""
        for name, (first, second) in self.fields.twice.items():
            remedy = f"say which: --key {name}={second.path}" if name in KEY_FIELDS else "remove one of them"
            raise first.refuse("twice", remedy=remedy, place=second.place)
        left, right = cameras = self.fields.cameras
        if self.fields.by_file and all("P" in camera for camera in cameras):
            shifts = [np.abs(camera["P"].numbers[[3, 7]]).max() for camera in cameras]
            if shifts[1] == 0 and shifts[0] > 0:
                # Two files of one camera each, named in reverse order: only the left projection has no shift.
                self.fields.cameras = left, right = right, left
        if "baseline" in self.fields.pair and "fx" in left and not {"M", "fx", "P"} & set(right):
            # The right camera of a rectified pair equals the left one.
            right.update({key: entry for key, entry in left.items() if key in ("fx", "fy", "cx", "cy")})
        for side in (0, 1):
            if kind_of(model := self.fields.model(side)) is None:
                files = ", ".join(keys.file for keys in self.fields.files)
                raise refused("model", files, model=escaped(model, 40), side=CAMERAS[side])
        matrices = self.matrices = [self._matrix(side) for side in (0, 1)]
        size = self._size(matrices)
        if self._from_matlab():
            self.source = "matlab"
            matrices = [matrix - np.outer([1, 1, 0], [0, 0, 1]) for matrix in matrices]
            self.notes.append("MATLAB counts pixels from 1: 1 px is taken off cx and cy of both cameras")
        sizes = size, self.right_size or size
        D1, D2 = (self._distortion(side, matrices[side], sizes[side]) for side in (0, 1))
        scale = np.array(size) / sizes[1]
        M2 = matrices[1] * np.array([[scale[0]] * 2 + [1.0]] * 2 + [[1.0] * 3])
        # The integer is at the centre of a pixel, so pictures begin at -1/2.
        M2[:2, 2] = (matrices[1][:2, 2] + 0.5) * scale - 0.5
        pose = self._pose()
        T = pose.translation * self._unit(float(np.linalg.norm(pose.translation)))
        values = {"image_width": size[0], "image_height": size[1], "right_image_size": self.right_size}
        return values | {"M1": matrices[0], "D1": D1, "M2": M2, "D2": D2, "R": pose.rotation, "T": T}

    def made(self, source: str) -> dict[str, Any]:
        """How the calibration was made, as its files state it."""
        stated = {name: entry.numbers[0] for name, entry in self.fields.pair.items() if name in words()["made"]}
        rms, views, columns, rows = (float(stated.get(name, 0.0)) for name in words()["made"])
        return {
            "rms_px": rms if 0 < rms <= RMS_PX_MAX else None,
            "views": int(views) if 3 <= views <= VIEWS_MAX else None,
            "board": (int(columns), int(rows)) if 3 <= columns <= 100 and 3 <= rows <= 100 else None,
            "fixed_intrinsics": words()["programs"]["fixed_intrinsics"].get(source),
        }

    def _from_matlab(self) -> bool:
        """Whether the fields are those of MATLAB's stereoParameters."""
        pair = self.fields.pair
        radial = any(_has_key(camera.get("radial"), "radialdistortion") for camera in self.fields.cameras)
        return radial or "R_transposed" in pair or self.transposed is not None or _has_key(pair.get("pose"), "a")

    def _matrix(self, side: int) -> np.ndarray:
        """The camera matrix: from nine numbers, from four, from two pairs, from single numbers or from a projection."""
        camera, name = self.fields.cameras[side], f"M{side + 1}"
        parts = [camera.get(key) for key in ("fx", "fy", "cx", "cy")]
        if "focal" in camera and "centre" in camera:
            parts = [camera["focal"], camera["centre"]]
        entry = camera.get("M")
        if entry is not None and entry.numbers.size == 9:
            matrix = entry.numbers.reshape(3, 3)
            if matrix[0, 2] == matrix[1, 2] == 0 and matrix[2, :2].all():
                matrix, self.transposed = matrix.T, entry
        elif entry is not None or all(part is not None for part in parts):
            entries = [part for part in (parts if entry is None else [entry]) if part is not None]
            fx, fy, cx, cy = np.concatenate([part.numbers for part in entries])
            matrix, entry = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), entries[0]
        elif "P" in camera and not any({"M", "fx"} & set(part) for part in self.fields.cameras):
            entry = camera["P"]
            matrix = entry.numbers.reshape(3, 4)[:, :3]
            self.notes.append(f"{entry.place} alone: the rectified {CAMERAS[side]} camera, without distortion")
        else:
            lacking = [f"M{k + 1}" for k in (0, 1) if not {"M", "fx"} & set(self.fields.cameras[k])]
            raise self.fields.missing(lacking or [name])
        self.places[name] = entry.place
        skewed = abs(matrix[0, 1]) > 1e-9 * abs(matrix[0, 0]) or matrix[1, 0] != 0
        if not (min(matrix[0, 0], matrix[1, 1]) > FOCAL_MIN and np.allclose(matrix[2], [0, 0, 1])) or skewed:
            raise entry.refuse("matrix-pattern")
        return np.array([[matrix[0, 0], 0, matrix[0, 2]], [0, matrix[1, 1], matrix[1, 2]], [0, 0, 1.0]])

    def _distortion(self, side: int, matrix: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        """The coefficients k1 k2 p1 p2 k3; fitted where the file has another model."""
        camera, model = self.fields.cameras[side], self.fields.model(side)
        kind = kind_of(model) or "five"
        values, entry = _coefficients(camera, kind)
        if entry is None:
            if {"M", "fx"} & set(camera) and model != "rectified":
                raise self.fields.missing([f"D{side + 1}"])
            return np.zeros(5)
        self.places[f"D{side + 1}"] = entry.place
        if kind == "fisheye" and not values[4:].any():
            values = values[:4]
        if not values.any() and kind != "fisheye":
            return np.zeros(5)
        if kind == "five" and values.size == 4 and not model:
            said = "four coefficients without the name of a model, taken as k1 k2 p1 p2"
            remedy = "of cv2.fisheye they are others: then add distortion_model: equidistant"
            self.notes.append(f"{entry.place}: {said}; {remedy}")
        if kind in ("five", "rational") and not values[5:].any():
            return np.append(values[:5], np.zeros(max(0, 5 - values.size)))
        count = {"fisheye": 4, "inverse": 5}.get(kind, values.size)
        if values.size != count:
            raise entry.refuse("coefficients", found=values.size, kind=kind, count=count)
        fitted = fitted_to_five(matrix, values, size, "rational" if kind == "five" else kind)
        lens = {"fisheye": "a fisheye lens", "inverse": "a lens described from pixels to rays"}
        said = lens.get(kind, f"a lens of {values.size} coefficients") + (f" of {self.source}" if self.source else "")
        if not fitted.error_px <= ERROR_MAX_PX:
            miss = f"up to {fitted.error_px:.2g} px, {fitted.rms_px:.2g} px rms"
            miss = miss if math.isfinite(fitted.error_px) else "an undetermined amount"
            convert = words()["programs"]["convert"].get(self.source, "")
            raise entry.refuse("lens", lens=said, miss=miss, most=ERROR_MAX_PX, convert=convert)
        self.notes.append(f"{entry.place}: {said}, fitted to five coefficients within {fitted.error_px:.2g} px")
        return fitted.distortion

    def _size(self, matrices: Sequence[np.ndarray]) -> tuple[int, int]:
        """The size of the left camera's pictures; stores the size of the right camera's where it differs."""
        sizes: list[tuple[tuple[int, int], Entry]] = []
        for matrix, camera in zip(matrices, self.fields.cameras, strict=True):
            if "size" not in camera and not {"width", "height"} <= set(camera):
                continue
            entry = camera.get("size") or camera["width"]
            pixels = entry.numbers if "size" in camera else np.append(entry.numbers, camera["height"].numbers)
            if not all(n == int(n) and 1 <= n <= 65_535 for n in pixels):
                raise entry.refuse("pixels", found=escaped(str(pixels.tolist()), 60))
            width, height = int(pixels[0]), int(pixels[1])
            by_rows = _offset_share(matrix, (height, width)) < _offset_share(matrix, (width, height))
            if "size" in camera and (by_rows or self._from_matlab()) and width != height:
                width, height = height, width
                self.notes += [f"{entry.place} is taken as rows, columns: {width} x {height} px"] * (not sizes)
            sizes.append(((width, height), entry))
        if len({size for size, _ in sizes}) > 1:
            (left, entry), (right, _) = sizes
            found = f"left and right have two sizes: {left[0]} x {left[1]} and {right[0]} x {right[1]}"
            if abs(left[0] * right[1] / (left[1] * right[0]) - 1.0) > SHAPE_SHARE_MAX:
                raise entry.refuse("proportion", found=found)
            self.right_size = right
            self.notes.append(f"{found}: the right camera's numbers are those of its pictures scaled to the left one's")
        for size, entry in sizes[:1]:
            if self.stated_size not in (None, size):
                raise entry.refuse("stated-size", found=f"{size[0]} x {size[1]}")
            return size
        if self.stated_size is not None:
            return self.stated_size
        first = self.fields.files[0]
        where = f", or name {first.values['size_in']}, which has it" if "size_in" in first else ""
        raise refused("no-size", first.file, where=where)

    def _pose(self) -> _Pose:
        """R and T of x_right = R x_left + T, T in the file's unit: the first pose, checked against all others."""
        poses, cameras = list(self._poses()), self.fields.cameras
        if not poses:
            if self.fields.by_file or "M" in cameras[0] or "fx" in cameras[0]:
                raise self.fields.missing([name for name in ("R", "T") if name not in self.fields.pair] or ["R", "T"])
            raise self.fields.missing(["M1", "M2", "R", "T"])
        first, *others = poses
        self.places |= {"R": first.turn.place, "T": first.shift.place}
        self.source = self.source or first.source
        checks: list[Callable[[np.ndarray, np.ndarray], float]] = [partial(_pose_deviation, other) for other in others]
        if all("rectification" in c for c in cameras) and not any("P" in c for c in cameras):
            left_part, right_part = (c["rectification"].rotation() for c in cameras)
            if not any(first.turn is c["rectification"] for c in cameras):
                checks.append(lambda r, t: float(np.abs(right_part.T @ left_part - r).max()))
        for name, (left_part, right_part) in {"E": (np.eye(3), np.eye(3)), "F": self.matrices}.items():
            if name in self.fields.pair:
                essential = right_part.T @ self.fields.pair[name].numbers.reshape(3, 3) @ left_part
                checks.append(partial(_essential_deviation, essential))
        for deviation in checks:
            if not deviation(first.rotation, first.translation) <= ROTATION_TOLERANCE:
                turned = deviation(first.rotation.T, first.translation) <= ROTATION_TOLERANCE
                raise first.turn.refuse("transposed" if turned else "other-pose", path=first.turn.path)
        if not checks and first.plain and "R" not in self.fields.stated:
            self._check_direction(first)
        return first

    def _poses(self) -> Iterator[_Pose]:
        """All poses of the right camera in the files."""
        pair, (left, right) = self.fields.pair, self.fields.cameras
        for field, camera_field in (("R", "rectification"), ("T", "camera_T")):
            # An entry for one camera only belongs to the pair; rectifications and poses of cameras come in twos.
            if field not in pair and (camera_field in left) != (camera_field in right) and "P" not in left:
                pair[field] = left.get(camera_field) or right[camera_field]
        if "baseline" in pair and right.get("fx") is left.get("fx") and "fx" in left:
            shift = np.array([-pair["baseline"].numbers[0], 0.0, 0.0])
            yield _Pose(np.eye(3), shift, pair["baseline"], pair["baseline"], "orb-slam")
        turn = pair.get("R") or pair.get("R_transposed")
        if turn is not None and "T" in pair:
            rotation, source = turn.rotation(), ""
            by_columns = turn.numbers.size == 9 and turn.shape == (9,) and _has_key(left.get("cx"), "ppx")
            if "R" not in pair or by_columns:
                rotation, source = rotation.T, "matlab" if "R" not in pair else "realsense"
                if by_columns:
                    self.notes.append(f"{turn.place}: nine numbers, taken column by column as librealsense has them")
            yield _Pose(rotation, pair["T"].numbers, turn, pair["T"], source, plain=not source and self.unit is None)
        for field in ("pose", "pose_backwards"):
            if (entry := pair.get(field)) is not None:
                known = words()["programs"]["pose_keys"]
                pose = entry.pose() if field == "pose" else np.linalg.inv(entry.pose())
                yield _of(pose, entry, next((source for source, keys in known.items() if entry.key in keys), ""))
        for field, source in (("from_body", "kalibr"), ("to_body", "euroc")):
            if field in left and field in right:
                t_left, t_right = (camera[field].pose() for camera in (left, right))
                pose = t_right @ np.linalg.inv(t_left) if field == "from_body" else np.linalg.inv(t_right) @ t_left
                yield _of(pose, right[field], source)
        turns = [turn for c in (left, right) if (turn := c.get("camera_R", c.get("rectification"))) is not None]
        if all("camera_T" in camera for camera in (left, right)) and len(turns) == 2:
            r_left, r_right = (turn.rotation() for turn in turns)
            shift = right["camera_T"].numbers - r_right @ r_left.T @ left["camera_T"].numbers
            yield _Pose(r_right @ r_left.T, shift, turns[1], right["camera_T"])
        if "P" in left and "P" in right and not ("R" in pair and "T" in pair and "rectification" not in left):
            yield self._from_projections()

    def _from_projections(self) -> _Pose:
        """The rectified right camera sees x' = x + (P03 / P00, P13 / P11, 0): R = R2^T R1, T = R2^T times the shift."""
        left, right = self.fields.cameras
        left_p, right_p = (camera["P"].numbers.reshape(3, 4) for camera in (left, right))
        if np.any(left_p[:2, 3] != 0) or not np.any(right_p[:2, 3]) or not (right_p[0, 0] > 0 and right_p[1, 1] > 0):
            raise right["P"].refuse("projection")
        turns = [c["rectification"].rotation() if "rectification" in c else np.eye(3) for c in (left, right)]
        if "M" not in left and "fx" not in left:
            # The files contain the rectified pair itself.
            turns = [np.eye(3), np.eye(3)]
        shift = np.array([right_p[0, 3] / right_p[0, 0], right_p[1, 3] / right_p[1, 1], 0.0])
        source = "ros" if self.fields.by_file else ""
        return _Pose(turns[1].T @ turns[0], turns[1].T @ shift, right["P"], right["P"], source)

    def _check_direction(self, pose: _Pose) -> None:
        """Note the meaning of R and of its transpose, where nothing else in the file determines it."""
        path = pose.turn.path
        if self.transposed is not None:
            raise pose.turn.refuse("maybe-transposed", place=self.transposed.place, path=path)
        if math.degrees(float(np.linalg.norm(cv2.Rodrigues(pose.rotation)[0]))) < TURN_NOTED_DEG:
            return
        stated_deg, transposed_deg = (_toe_in_deg(r, pose.translation) for r in (pose.rotation, pose.rotation.T))
        stated, turned = (
            f"{'converge' if deg >= 0 else 'diverge'} by {abs(deg):.1f} deg" for deg in (stated_deg, transposed_deg)
        )
        text = (
            f"{pose.turn.place} is taken from left to right, x_right = R x_left + T, and nothing else in the file says "
            f"so: the optical axes {stated}; transposed they {turned}: --key R={path}.T; `check` of a campaign with "
            "spots says which"
        )
        if stated_deg < -TURN_NOTED_DEG < TURN_NOTED_DEG < transposed_deg:
            self.warnings.append(f"is R transposed? {text}")
        else:
            self.notes.append(text)

    def _unit(self, length: float) -> float:
        """Millimetres per unit of the file: as stated, or by the format; an implausible one must be stated."""
        if not 0 < length < math.inf:
            raise refused("no-baseline", self.places["T"])
        if self.unit_mm is not None:
            return self.unit_mm
        stated = self.unit or ("m" if self.source in words()["programs"]["metres"] else "")
        unit = stated.strip("?") or "mm"
        low, high = BASELINE_RANGE_MM
        if stated == "?" or not low <= length * UNITS_MM[unit] <= high:
            inside = {name: length * mm for name, mm in UNITS_MM.items() if low <= length * mm <= high}
            options = [f"--import-unit {name} ({mm:.4g} mm)" for name, mm in inside.items()]
            options += [] if stated == "?" else [f"--import-unit {unit} if it is so"]
            options += ["--import-unit 25 where it counts squares of 25 mm"] * (length < low or not options)
            said = {"unit": unit, "low": low, "high": high, "options": ", or ".join(options)}
            if stated == "?":
                raise refused("no-unit", self.places["T"], length=length, **said)
            raise refused("unit", self.places["T"], length=length * UNITS_MM[unit], **said)
        if not stated:
            self.notes.append("T is taken in mm: the file does not state a unit")
        return UNITS_MM[unit]


def _of(pose: np.ndarray, entry: Entry, source: str) -> _Pose:
    return _Pose(pose[:3, :3], pose[:3, 3], entry, entry, source)


def _coefficients(camera: Mapping[str, Entry], kind: str) -> tuple[np.ndarray, Entry | None]:
    """Coefficients in OpenCV's order and their entry: one entry, MATLAB's two, or single numbers; None where none."""
    if "D" in camera:
        return camera["D"].numbers, camera["D"]

    def single(names: Sequence[str]) -> np.ndarray:
        entries = [camera.get(f"coefficient_{name}") for name in names]
        return np.array([0.0 if entry is None else float(entry.numbers[0]) for entry in entries])

    if "radial" in camera:
        radial = camera["radial"].numbers
        tangential = camera["tangential"].numbers if "tangential" in camera else single(("p1", "p2"))
        return np.array([*radial[:2], *tangential, *radial[2:]]), camera["radial"]
    names = ("k1", "k2", "k3", "k4") if kind == "fisheye" else RATIONAL[:5]
    entries = (camera.get(f"coefficient_{name}") for name in names)
    return single(names), next((entry for entry in entries if entry is not None), None)


def _offset_share(matrix: np.ndarray, size: tuple[int, int]) -> float:
    """Offset of a principal point from the middle of the pictures, as a share of their size."""
    return max(abs(c - (n - 1) / 2) / n for c, n in zip(matrix[:2, 2], size, strict=True))


def _has_key(entry: Entry | None, word: str) -> bool:
    return entry is not None and letters(entry.key) == word


def _pose_deviation(other: _Pose, rotation: np.ndarray, translation: np.ndarray) -> float:
    """Deviation of a pose from another one, whose unit may differ."""
    directions = [t / np.linalg.norm(t) for t in (translation, other.translation) if t.any()]
    distance = float(np.abs(directions[0] - directions[1]).max()) if len(directions) == 2 else 0.0
    return max(float(np.abs(other.rotation - rotation).max()), distance)


def _essential_deviation(essential: np.ndarray, rotation: np.ndarray, translation: np.ndarray) -> float:
    """Deviation of [T]x R from an essential matrix of any length and sign."""
    x, y, z = translation
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    with np.errstate(invalid="ignore", divide="ignore"):
        stated, expected = (e / np.linalg.norm(e) for e in (essential, cross @ rotation))
    return float(min(np.abs(stated - expected).max(), np.abs(stated + expected).max()))


def _toe_in_deg(rotation: np.ndarray, translation: np.ndarray) -> float:
    """Angle between the optical axes in the plane of the baseline, deg; negative where they diverge."""
    to_right, to_left = -rotation.T @ translation, translation
    sines = [direction[2] / np.linalg.norm(direction) for direction in (to_right, to_left)]
    return math.degrees(sum(map(math.asin, np.clip(sines, -1.0, 1.0))))
