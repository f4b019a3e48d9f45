"""Stereo calibrations of other programs, recognised by content, and `stereo.json`.

`calibration_names` finds the meaning of each number; here numbers become a pair: M and D of both cameras, R and T of
x_right = R x_left + T. None of these files contains an uncertainty: an import gets the covariance of
`assumed_covariance` and `assumed = true`. Lengths in `Stereo` are mm; Kalibr, ROS and EuRoC write metres, others
the unit of the squares of their board.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from tvsbayes.cameras.assumed_covariance import GUESS_FACTOR, Provenance, with_assumed_covariance
from tvsbayes.cameras.calibration_containers import CONTAINER_BYTES_MAX, read_container
from tvsbayes.cameras.calibration_names import PROVENANCE_FIELDS, ROTATION_TOLERANCE, Entry, Fields
from tvsbayes.cameras.lens_models import ERROR_MAX_PX, Kind, fitted_to_five, kind_of
from tvsbayes.cameras.maker_calibrations import MakersPair, makers_pair
from tvsbayes.errors import InputError, escaped, refusal
from tvsbayes.files.disk import read_bytes
from tvsbayes.instrument.campaign import CAMERAS
from tvsbayes.instrument.stereo_pair import (
    ASSUMED_REMEDY,
    Stereo,
    pair_doubts,
    parse_stereo,
    rotation_vector,
    same_shape,
    scaled_px,
    stereo_bytes,
)

UNITS_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
BASELINE_RANGE_MM = (20.0, 3000.0)
"""Distance of the cameras of one bench; outside this range the user must state the unit."""
RMS_PX_MAX, VIEWS_MAX = 20.0, 100_000
NO_PROVENANCE = Provenance()
KEY_FIELDS = ("M1", "D1", "M2", "D2", "R", "T")
"""Fields that `--key` can name."""
POSE_KEYS = {"kalibr": ("T_cn_cnm1",), "orb-slam": ("Stereo.T_c1_c2",), "boofcv": ("rightToLeft",)}
"""Keys of a pose that identify one program."""
TURN_NOTED_DEG = 0.5
"""Angle below which a rotation and its transpose are hardly different."""


@dataclass(frozen=True)
class Imported:
    """A calibration from another tool.

    Attributes:
        stereo: the pair, mm and px.
        source: opencv (also any other program whose names are known), ros, kalibr, euroc, matlab, realsense, depthai,
            orb-slam, zed, boofcv or tvsbayes.
        notes: assumptions.
        warnings: implausible values (`pair_doubts`).
    """

    stereo: Stereo
    source: str
    notes: tuple[str, ...]
    warnings: tuple[str, ...]


def read_calibration(
    paths: Sequence[Path],
    size: tuple[int, int] | None = None,
    *,
    unit_mm: float | None = None,
    stated: Provenance = NO_PROVENANCE,
    keys: Mapping[str, str] | None = None,
) -> Imported:
    """Read a stereo calibration from the files of another program, or from `stereo.json`.

    Args:
        paths: one file of a pair, or two or three: one for each camera, or intrinsics and extrinsics.
        size: image width and height, px, where the files do not state it.
        unit_mm: unit of lengths, mm; None: that of the format; with an implausible baseline the user must state it.
        stated: how the calibration was made, with its uncertainties, for the covariance, which no such file contains.
        keys: keys of M1, D1, M2, D2, R, T in the file, where their names are unknown.

    Raises:
        InputError: unreadable, unknown, contradictory, or of lenses that five coefficients do not describe.
    """
    names = [escaped(Path(path).name) for path in paths]
    contents = [read_bytes(path, CONTAINER_BYTES_MAX) for path in paths]
    files = [table for data, name in zip(contents, names, strict=True) for table in read_container(data, name)]
    if len(paths) == 1 and str(files[0].values.get("format", "")).startswith("tvsbayes"):
        stereo = parse_stereo(contents[0], names[0])
        if stated != NO_PROVENANCE:
            if not stereo.assumed:
                remedy = "leave out --rms-px, --views, --board, --pitch-mm, --u-...: they are for files without one"
                raise refusal("usage", file=names[0], found="its own covariance", allowed="no other", remedy=remedy)
            stereo = with_assumed_covariance(stereo, stated, NO_PROVENANCE)
        return Imported(stereo, "tvsbayes", (), pair_doubts(stereo))
    if len(files) > 3:
        found, allowed = f"{len(files)} files", "one, two or three"
        raise refusal("usage", file=names[0], found=found, allowed=allowed, remedy="name those of one pair")
    makers = makers_pair(files[0], size) if len(files) == 1 else None
    reader = _Reader(Fields([makers.keys] if makers else files, keys or {}), size, unit_mm)
    if makers is not None:
        reader.take(makers)
    bare = reader.pair()
    doubts = (*reader.warnings, *pair_doubts(bare, reader.places))
    try:
        stereo = with_assumed_covariance(
            bare, stated, _stated_provenance(reader.fields.pair, {"ros": True, "kalibr": False}.get(reader.source))
        )
    except InputError as error:
        if error.code != "no-common-view":
            raise
        hint = "; ".join(doubts) or "look at R, T and the image size"
        found = "two cameras that do not see one board together"
        raise refusal("no-common-view", file=", ".join(names), found=found, allowed="a pair", remedy=hint) from error
    good_to = f"all its sds together are correct within a factor of {GUESS_FACTOR:g}"
    reader.notes.append(f"the file has no covariance: assumed from {stereo.assumed_from}; {good_to}")
    reader.notes.append(f"for a better one {ASSUMED_REMEDY}")
    return Imported(stereo, reader.source, tuple(reader.notes), doubts)


@dataclass(frozen=True)
class _Pose:
    """R (3, 3) and T (3,) of x_right = R x_left + T, T in the file's unit.

    Attributes:
        rotation, translation: R and T.
        turn, shift: their entries in the file.
        source: the program, "" where the entries do not identify it.
        plain: whether the name of R leaves its direction open.
    """

    rotation: np.ndarray
    translation: np.ndarray
    turn: Entry
    shift: Entry
    source: str = ""
    plain: bool = False


class _Reader:
    """Builds a pair from the entries by field.

    Attributes:
        source: the program that probably wrote the file.
        notes: assumptions.
        warnings: doubtful values.
        places: key and file of M1, M2, D1, D2, R, T, in words.
        right_size: size of the right camera's pictures, where it differs from the left.
        matrices: matrices of both cameras, as the file states them.
        transposed: whether the file stores a camera matrix by columns.
    """

    def __init__(self, fields: Fields, size: tuple[int, int] | None, unit_mm: float | None):
        self.fields, self.stated_size, self.unit_mm = fields, size, unit_mm
        self.source = "opencv"
        self.unit: str | None = None
        self.notes: list[str] = []
        self.warnings: list[str] = []
        self.places: dict[str, str] = {}
        self.right_size: tuple[int, int] | None = None
        self.matrices: list[np.ndarray] = []
        self.transposed: Entry | None = None

    def take(self, maker: MakersPair) -> None:
        """Take the source and the unit from a maker's format."""
        self.source, self.unit = maker.source, maker.unit
        self.notes += [f"{maker.keys.file}: {note}" for note in maker.notes]

    def pair(self) -> Stereo:
        """The pair, without a covariance, checked like `stereo.json`."""
        for name, (first, second) in self.fields.twice.items():
            remedy = f"say which: --key {name}={second.path}" if name in KEY_FIELDS else "remove one of them"
            raise first.refuse("twice", "every quantity once", remedy, f"another under {second.place}")
        self._swap_sides()
        self._complete_rectified()
        for side in (0, 1):
            self._check_model(side)
        matrices = self.matrices = [self._matrix(side) for side in (0, 1)]
        size = self._size(matrices)
        if self._from_matlab():
            self.source = "matlab"
            matrices = [matrix - np.outer([1, 1, 0], [0, 0, 1]) for matrix in matrices]
            self.notes.append("MATLAB counts pixels from 1: 1 px is taken off cx and cy of both cameras")
        sizes = (size, self.right_size or size)
        left, right = (self._distortion(side, matrices[side], sizes[side]) for side in (0, 1))
        scaled = matrices[1] * np.array([[size[0] / sizes[1][0]] * 2 + [1.0]] * 2 + [[1.0] * 3])
        scaled[:2, 2] = scaled_px(matrices[1][:2, 2], sizes[1], size)
        pose = self._pose()
        translation = pose.translation * self._unit(float(np.linalg.norm(pose.translation)))
        inner = matrices[0], left, scaled, right
        bare = Stereo(*size, *inner, pose.rotation, translation, np.zeros((24, 24)), 0.0, assumed=True)
        bare = replace(bare, right_image_size=self.right_size)
        return parse_stereo(stereo_bytes(bare), "the imported calibration")

    def _check_model(self, side: int) -> None:
        """Refuse a lens model that cannot be converted."""
        model = self.fields.model(side)
        if kind_of(model) is None:
            raise refusal(
                "lens-model",
                file=", ".join(keys.file for keys in self.fields.files),
                found=f"the model {escaped(model, 40)} of the {CAMERAS[side]} camera",
                allowed="plumb_bob, radtan, rational or equidistant",
                remedy="calibrate the pair again with five coefficients; renaming the model makes wrong rays",
            )

    def _from_matlab(self) -> bool:
        """Whether the fields are those of MATLAB's stereoParameters."""
        pair = self.fields.pair
        structured = (
            any(_has_key(camera.get("radial"), "radialdistortion") for camera in self.fields.cameras)
            or "R_transposed" in pair
        )
        return structured or self.transposed is not None or _has_key(pair.get("pose"), "a")

    def _swap_sides(self) -> None:
        """Swap two files of one camera each, named in reverse order: only the left projection has no shift."""
        cameras = self.fields.cameras
        if self.fields.by_file and all("P" in camera for camera in cameras):
            shifts = [np.abs(camera["P"].numbers[[3, 7]]).max() for camera in cameras]
            if shifts[1] == 0 and shifts[0] > 0:
                self.fields.cameras = cameras[::-1]

    def _complete_rectified(self) -> None:
        """Complete one camera and a baseline: the right camera of a rectified pair equals the left one."""
        left, right = self.fields.cameras
        if "baseline" in self.fields.pair and "fx" in left and not {"M", "fx", "P"} & set(right):
            right.update({key: entry for key, entry in left.items() if key in ("fx", "fy", "cx", "cy")})

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
            cameras = self.fields.cameras
            raise self.fields.missing([f"M{k + 1}" for k in (0, 1) if not {"M", "fx"} & set(cameras[k])])
        assert entry is not None
        self.places[name] = entry.place
        skew = abs(matrix[0, 1]) <= 1e-9 * abs(matrix[0, 0])
        if not (
            matrix[0, 0] > 0 and matrix[1, 1] > 0 and skew and np.allclose(matrix[2], [0, 0, 1]) and matrix[1, 0] == 0
        ):
            allowed = "fx 0 cx, 0 fy cy, 0 0 1 with fx, fy > 0, px"
            raise entry.refuse(
                "camera-matrix", allowed, "is it another matrix? name it: --key M1=NAME", "no camera matrix"
            )
        return np.array([[matrix[0, 0], 0, matrix[0, 2]], [0, matrix[1, 1], matrix[1, 2]], [0, 0, 1.0]])

    def _distortion(self, side: int, matrix: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        """The coefficients k1 k2 p1 p2 k3; fitted where the file has another model."""
        camera, kind = self.fields.cameras[side], kind_of(self.fields.model(side))
        coefficients = self._coefficients(camera, kind)
        if coefficients is None:
            if {"M", "fx"} & set(camera) and self.fields.model(side) != "rectified":
                raise self.fields.missing([f"D{side + 1}"])
            return np.zeros(5)
        values, entry = coefficients
        self.places[f"D{side + 1}"] = entry.place
        if kind == "fisheye" and not values[4:].any():
            values = values[:4]
        if not values.any() and kind != "fisheye":
            return np.zeros(5)
        if kind == "five" and values.size == 4 and not self.fields.model(side):
            note = (
                "four coefficients without the name of a model, taken as k1 k2 p1 p2; of cv2.fisheye they are others:"
            )
            self.notes.append(f"{entry.place}: {note} then add distortion_model: equidistant")
        if kind in ("five", "rational") and not values[5:].any():
            return np.append(values[:5], np.zeros(max(0, 5 - values.size)))
        count = {"fisheye": 4, "inverse": 5}.get(str(kind), values.size)
        if values.size != count:
            found_here = f"{values.size} of a {kind} lens"
            raise entry.refuse("lens-model", f"{count} coefficients", "take the file as it was", found_here)
        assert kind is not None
        fitted = fitted_to_five(matrix, values, size, "rational" if kind == "five" else kind)
        lens = {"fisheye": "a fisheye lens", "inverse": "a lens described from pixels to rays"}.get(
            kind, f"a lens of {values.size} coefficients"
        )
        if not fitted.error_px <= ERROR_MAX_PX:
            miss = f"up to {fitted.error_px:.2g} px" if math.isfinite(fitted.error_px) else "an undetermined amount"
            allowed = f"what k1 k2 p1 p2 k3 describe to {ERROR_MAX_PX:g} px over the picture"
            remedy = "do not rename the model: calibrate again with five coefficients, or crop the pictures"
            raise entry.refuse("lens-model", allowed, remedy, f"{lens}, which five coefficients miss by {miss}")
        self.notes.append(f"{entry.place}: {lens}, fitted to five coefficients within {fitted.error_px:.2g} px")
        return fitted.distortion

    @staticmethod
    def _coefficients(camera: Mapping[str, Entry], kind: Kind | None) -> tuple[np.ndarray, Entry] | None:
        """Coefficients in OpenCV's order and their entry: one entry, MATLAB's two, or single numbers."""
        if "D" in camera:
            return camera["D"].numbers, camera["D"]
        if "radial" in camera:
            radial = camera["radial"].numbers
            single = [camera.get(f"coefficient_{name}") for name in ("p1", "p2")]
            tangential = np.array([0.0 if entry is None else float(entry.numbers[0]) for entry in single])
            tangential = camera["tangential"].numbers if "tangential" in camera else tangential
            return np.array([*radial[:2], *tangential, *radial[2:]]), camera["radial"]
        names = ("k1", "k2", "k3", "k4") if kind == "fisheye" else ("k1", "k2", "p1", "p2", "k3")
        single = [camera.get(f"coefficient_{name}") for name in names]
        present = [entry for entry in single if entry is not None]
        values = np.array([0.0 if entry is None else float(entry.numbers[0]) for entry in single])
        return (values, present[0]) if present else None

    def _size(self, matrices: Sequence[np.ndarray]) -> tuple[int, int]:
        """The size of the left camera's pictures; stores the size of the right camera's where it differs."""
        sizes: list[tuple[tuple[int, int], Entry]] = []
        for side, camera in enumerate(self.fields.cameras):
            if "size" in camera:
                entry = camera["size"]
                pixels = entry.numbers
            elif "width" in camera and "height" in camera:
                entry = camera["width"]
                pixels = np.array([camera["width"].numbers[0], camera["height"].numbers[0]])
            else:
                continue
            if not all(n == int(n) and 1 <= n <= 65_535 for n in pixels):
                raise entry.refuse(
                    "image-size", "whole numbers of pixels", "correct it", escaped(str(pixels.tolist()), 60)
                )
            width, height = int(pixels[0]), int(pixels[1])
            by_rows = _offset_share(matrices[side], (height, width)) < _offset_share(matrices[side], (width, height))
            if "size" in camera and (by_rows or self._from_matlab()) and width != height:
                width, height = height, width
                self.notes += [f"{entry.place} is taken as rows, columns: {width} x {height} px"] * (not sizes)
            sizes.append(((width, height), entry))
        if len({size for size, _ in sizes}) > 1:
            (left, entry), (right, _) = sizes
            found = f"left and right have two sizes: {left[0]} x {left[1]} and {right[0]} x {right[1]}"
            if not same_shape(left, right):
                remedy = "calibrate them at sizes of one proportion"
                raise entry.refuse("image-size", "sizes of one proportion of width to height", remedy, found)
            self.right_size = right
            self.notes.append(f"{found}: the right camera's numbers are those of its pictures scaled to the left one's")
        for size, entry in sizes[:1]:
            if self.stated_size not in (None, size):
                found = f"{size[0]} x {size[1]} px"
                raise entry.refuse("image-size", "the size of the pictures", "leave out --image-size", found)
            return size
        if self.stated_size is not None:
            return self.stated_size
        remedy = "give it with --image-size, for example 1280x720"
        file = self.fields.files[0].file
        raise refusal("missing-key", file=file, found="no image size", allowed="image_width", remedy=remedy)

    def _pose(self) -> _Pose:
        """R and T of x_right = R x_left + T, T in the file's unit: the first pose, checked against all others."""
        poses = list(self._poses())
        if not poses:
            left, pair = self.fields.cameras[0], self.fields.pair
            if self.fields.by_file or "M" in left or "fx" in left:
                raise self.fields.missing([name for name in ("R", "T") if name not in pair])
            raise self.fields.missing(["M1", "M2", "R", "T"])
        first, *others = poses
        self.places |= {"R": first.turn.place, "T": first.shift.place}
        self.source = first.source or self.source
        checks = [_pose_deviation(other) for other in others]
        cameras = self.fields.cameras
        if all("rectification" in c for c in cameras) and not any("P" in c for c in cameras):
            left_part, right_part = (c["rectification"].rotation() for c in cameras)
            if first.turn not in (c["rectification"] for c in cameras):
                checks.append(lambda r, t: float(np.abs(right_part.T @ left_part - r).max()))
        for name, (left_part, right_part) in {"E": (np.eye(3), np.eye(3)), "F": self.matrices}.items():
            if name in self.fields.pair:
                essential = right_part.T @ self.fields.pair[name].numbers.reshape(3, 3) @ left_part
                checks.append(partial(_essential_deviation, essential))
        for deviation in checks:
            if deviation(first.rotation, first.translation) > ROTATION_TOLERANCE:
                allowed, found_here = "one pose of the right camera", "another pose than the rest of the file says"
                remedy = "take the files as they were written, or remove what is of another calibration"
                if deviation(first.rotation.T, first.translation) <= ROTATION_TOLERANCE:
                    allowed, found_here = "R from left to right", "R transposed, by what else the file says"
                    remedy = f"take its transpose: --key R={first.turn.path}.T"
                raise first.turn.refuse("rotation", allowed, remedy, found_here)
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
                source = next((source for source, keys in POSE_KEYS.items() if entry.key in keys), "")
                pose = entry.pose() if field == "pose" else np.linalg.inv(entry.pose())
                yield _Pose(pose[:3, :3], pose[:3, 3], entry, entry, source)
        for field, source in (("from_body", "kalibr"), ("to_body", "euroc")):
            if field in left and field in right:
                t_left, t_right = (camera[field].pose() for camera in (left, right))
                pose = t_right @ np.linalg.inv(t_left) if field == "from_body" else np.linalg.inv(t_right) @ t_left
                yield _Pose(pose[:3, :3], pose[:3, 3], right[field], right[field], source)
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
            allowed = "P[0][3] = 0 in the left camera, -fx baseline in the right one"
            remedy = "take both files from one stereo calibration"
            raise right["P"].refuse("projection", allowed, remedy, "files that are no stereo pair")
        turns = [c["rectification"].rotation() if "rectification" in c else np.eye(3) for c in (left, right)]
        if "M" not in left and "fx" not in left:
            # The files contain the rectified pair itself.
            turns = [np.eye(3), np.eye(3)]
        shift = np.array([right_p[0, 3] / right_p[0, 0], right_p[1, 3] / right_p[1, 1], 0.0])
        source = "ros" if self.fields.by_file else ""
        return _Pose(turns[1].T @ turns[0], turns[1].T @ shift, right["P"], right["P"], source)

    def _check_direction(self, pose: _Pose) -> None:
        """Note the meaning of R and of its transpose, where nothing else in the file determines it.

        Raises:
            InputError: the camera matrices are transposed, so that R may be too.
        """
        path = pose.turn.path
        if self.transposed is not None:
            remedy = f"say which: --key R={path}.T where it is transposed too, as by MATLAB, or --key R={path}"
            found = f"R beside {self.transposed.place}, which is transposed: R may be too"
            raise pose.turn.refuse("rotation", "R from left to right", remedy, found)
        if math.degrees(float(np.linalg.norm(rotation_vector(pose.rotation)))) < TURN_NOTED_DEG:
            return
        stated_deg, transposed_deg = (_toe_in_deg(r, pose.translation) for r in (pose.rotation, pose.rotation.T))
        text = f"{pose.turn.place} is taken from left to right, x_right = R x_left + T, and nothing else in the file "
        text += f"says so: the optical axes {_toe_in(stated_deg)}; "
        text += (
            f"transposed they {_toe_in(transposed_deg)}: --key R={path}.T; `check` of a campaign with spots says which"
        )
        if stated_deg < -TURN_NOTED_DEG < TURN_NOTED_DEG < transposed_deg:
            self.warnings.append(f"is R transposed? {text}")
        else:
            self.notes.append(text)

    def _unit(self, length: float) -> float:
        """Millimetres per unit of the file: as stated, or by the format; an implausible one must be stated."""
        if not 0 < length < math.inf:
            raise refusal(
                "translation",
                file=self.places["T"],
                found="cameras in one place",
                allowed="a baseline",
                remedy="T is 0: name the right one, --key T=NAME",
            )
        in_metres = ("kalibr", "ros", "euroc", "realsense", "orb-slam")
        stated = self.unit or ("m" if self.source in in_metres else "")
        if self.unit_mm is not None:
            return self.unit_mm
        unit = stated or "mm"
        low, high = BASELINE_RANGE_MM
        if not low <= length * UNITS_MM[unit] <= high:
            options = [
                f"--import-unit {name} ({length * mm:.4g} mm)"
                for name, mm in UNITS_MM.items()
                if low <= length * mm <= high
            ]
            options.append(f"--import-unit {unit} if it is so")
            options += ["--import-unit 25 where it counts squares of 25 mm"] * (length < low)
            remedy = f"give {', or '.join(options)}"
            found = f"cameras {length * UNITS_MM[unit]:.4g} mm apart, taken in {unit}"
            raise refusal(
                "unit",
                file=self.places["T"],
                found=found,
                allowed=f"{low:g} to {high:g} mm without an option",
                remedy=remedy,
            )
        if not stated:
            self.notes.append("T is taken in mm: the file does not state a unit")
        return UNITS_MM[unit]


def _offset_share(matrix: np.ndarray, size: tuple[int, int]) -> float:
    """Offset of a principal point from the middle of the pictures, as a share of their size."""
    return max(abs(c - (n - 1) / 2) / n for c, n in zip(matrix[:2, 2], size, strict=True))


def _has_key(entry: Entry | None, word: str) -> bool:
    """Whether the key of an entry is a word, ignoring case and underscores."""
    return entry is not None and entry.key.lower().replace("_", "") == word


def _pose_deviation(other: _Pose) -> Callable[[np.ndarray, np.ndarray], float]:
    """Function that returns the deviation of a pose from another one, whose unit may differ."""

    def deviation(rotation: np.ndarray, translation: np.ndarray) -> float:
        directions = [t / np.linalg.norm(t) for t in (translation, other.translation) if t.any()]
        distance = float(np.abs(directions[0] - directions[1]).max()) if len(directions) == 2 else 0.0
        return max(float(np.abs(other.rotation - rotation).max()), distance)

    return deviation


def _essential_deviation(essential: np.ndarray, rotation: np.ndarray, translation: np.ndarray) -> float:
    """Deviation of [T]x R from an essential matrix of any length and sign."""
    x, y, z = translation
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    stated, expected = (e / np.linalg.norm(e) for e in (essential, cross @ rotation))
    return float(min(np.abs(stated - expected).max(), np.abs(stated + expected).max()))


def _toe_in_deg(rotation: np.ndarray, translation: np.ndarray) -> float:
    """Angle between the optical axes in the plane of the baseline, deg; negative where they diverge."""
    to_right, to_left = -rotation.T @ translation, translation
    sines = [direction[2] / np.linalg.norm(direction) for direction in (to_right, to_left)]
    return math.degrees(sum(map(math.asin, sines)))


def _toe_in(angle_deg: float) -> str:
    return f"{'converge' if angle_deg >= 0 else 'diverge'} by {abs(angle_deg):.1f} deg"


def _stated_provenance(pair: Mapping[str, Entry], fixed_intrinsics: bool | None) -> Provenance:
    """The provenance of the calibration, as its files state it."""
    rms, views, columns, rows = (float(pair[name].numbers[0]) if name in pair else 0.0 for name in PROVENANCE_FIELDS)
    return Provenance(
        rms_px=rms if 0 < rms <= RMS_PX_MAX else None,
        views=int(views) if 3 <= views <= VIEWS_MAX else None,
        board=(int(columns), int(rows)) if 3 <= columns <= 100 and 3 <= rows <= 100 else None,
        fixed_intrinsics=fixed_intrinsics,
    )
