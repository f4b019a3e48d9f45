"""Stereo calibrations of other programs, by content, and `stereo.json`; and the files of an export.

`calibration_names` says what a number is; here numbers become a pair: M and D of both cameras, R and T of
x_right = R x_left + T. None of these files carries an uncertainty: an import gets the covariance of
`assumed_covariance` and `assumed = true`. Lengths in `Stereo` are mm; Kalibr, ROS and EuRoC write metres, others
whatever unit the squares of their board had.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from tvsbayes.cameras.assumed_covariance import GUESS_FACTOR, Known, with_assumed_covariance
from tvsbayes.cameras.calibration_containers import CONTAINER_BYTES_MAX, read_container
from tvsbayes.cameras.calibration_names import MADE_BY, ROTATION_TOLERANCE, Entry, Fields
from tvsbayes.cameras.lens_models import ERROR_MAX_PX, Kind, fitted_to_five, kind_of
from tvsbayes.cameras.maker_calibrations import MakersPair, makers_pair
from tvsbayes.errors import InputError, escaped, refusal
from tvsbayes.files.disk import read_bytes
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
BASELINES_MM = (20.0, 3000.0)
"""Cameras of one bench stand so far apart; what is outside is asked, not taken."""
RMS_PX_MAX, VIEWS_MAX = 20.0, 100_000
NOTHING_KNOWN = Known()
SIDE_NAMES = ("left", "right")
STATED = ("M1", "D1", "M2", "D2", "R", "T")
"""What `--key` may name."""
POSES_OF = {"kalibr": ("T_cn_cnm1",), "orb-slam": ("Stereo.T_c1_c2",), "boofcv": ("rightToLeft",)}
"""Programs whose poses stand under a key of their own."""
TURN_SAID_DEG = 0.5
"""Rotations by less change little where they are transposed."""


@dataclass(frozen=True)
class Imported:
    """A calibration of another tool.

    Attributes:
        stereo: the pair, mm and px.
        source: opencv (also any other program whose names are known), ros, kalibr, euroc, matlab, realsense, depthai,
            orb-slam, zed, boofcv or tvsbayes.
        notes: what was assumed.
        warnings: what makes it implausible (`pair_doubts`).
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
    stated: Known = NOTHING_KNOWN,
    keys: Mapping[str, str] | None = None,
) -> Imported:
    """A stereo calibration from the files of another program, or from `stereo.json`.

    Args:
        paths: one file of a pair, or two or three: of each camera, of what is inside and between them.
        size: image width and height, px, where the files do not tell.
        unit_mm: unit of lengths, mm; None: as the format has it, and asked for where the baseline is implausible.
        stated: how it was made, and how uncertain it is: for the covariance that no such file has.
        keys: what holds M1, D1, M2, D2, R, T, where no name that is known does.

    Raises:
        InputError: unreadable, unknown, contradictory, or of lenses that five coefficients do not describe.
    """
    names = [escaped(Path(path).name) for path in paths]
    contents = [read_bytes(path, CONTAINER_BYTES_MAX) for path in paths]
    files = [keys for data, name in zip(contents, names, strict=True) for keys in read_container(data, name)]
    if len(paths) == 1 and str(files[0].values.get("format", "")).startswith("tvsbayes"):
        stereo = parse_stereo(contents[0], names[0])
        if stated != NOTHING_KNOWN:
            if not stereo.assumed:
                remedy = "leave out --rms-px, --views, --board, --pitch-mm, --u-...: they are for files without one"
                raise refusal("usage", file=names[0], found="its own covariance", allowed="no other", remedy=remedy)
            stereo = with_assumed_covariance(stereo, stated, NOTHING_KNOWN)
        return Imported(stereo, "tvsbayes", (), pair_doubts(stereo))
    if len(files) > 3:
        found, allowed = f"{len(files)} files", "one, two or three"
        raise refusal("usage", file=names[0], found=found, allowed=allowed, remedy="name those of one pair")
    maker = makers_pair(files[0], size) if len(files) == 1 else None
    reader = _Reader(Fields([maker.keys] if maker else files, keys or {}), size, unit_mm)
    if maker is not None:
        reader.take(maker)
    bare = reader.pair()
    doubts = (*reader.warnings, *pair_doubts(bare, reader.places))
    try:
        stereo = with_assumed_covariance(
            bare, stated, _made_by(reader.fields.pair, {"ros": True, "kalibr": False}.get(reader.source))
        )
    except InputError as error:
        if error.code != "no-common-view":
            raise
        hint = "; ".join(doubts) or "look at R, T and the image size"
        found = "two cameras that do not see one board together"
        raise refusal("no-common-view", file=", ".join(names), found=found, allowed="a pair", remedy=hint) from error
    good_to = f"all its sds together are good to a factor of {GUESS_FACTOR:g}"
    reader.notes.append(f"the file has no covariance: assumed from {stereo.assumed_from}; {good_to}")
    reader.notes.append(f"for a better one {ASSUMED_REMEDY}")
    return Imported(stereo, reader.source, tuple(reader.notes), doubts)


@dataclass(frozen=True)
class _Pose:
    """A way to R (3, 3) and T (3,) of x_right = R x_left + T, T in the file's unit.

    Attributes:
        rotation, translation: both.
        turn, shift: entries that they come from.
        source: whose file it is, "" where this does not tell.
        plain: whether R stands under a name that does not tell its direction.
    """

    rotation: np.ndarray
    translation: np.ndarray
    turn: Entry
    shift: Entry
    source: str = ""
    plain: bool = False


class _Reader:
    """From entries by field to a pair.

    Attributes:
        source: whose file it seems to be.
        notes: what was assumed.
        warnings: what is doubtful.
        places: key and file of M1, M2, D1, D2, R, T, in words.
        right_size: of the right camera's pictures, where it is not that of the left one's.
        matrices: of both cameras, as the file has them.
        transposed: a camera matrix that the file has by columns.
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
        """Whose file it is, and in which unit, where a maker's format tells."""
        self.source, self.unit = maker.source, maker.unit
        self.notes += [f"{maker.keys.file}: {note}" for note in maker.notes]

    def pair(self) -> Stereo:
        """The pair, without a covariance, checked as `stereo.json` is."""
        for name, (first, second) in self.fields.twice.items():
            remedy = f"say which: --key {name}={second.path}" if name in STATED else "remove one of them"
            raise first.refuse("twice", "every quantity once", remedy, f"another under {second.place}")
        self._exchange()
        self._take_rectified()
        for side in (0, 1):
            self._check_model(side)
        matrices = self.matrices = [self._matrix(side) for side in (0, 1)]
        size = self._size(matrices)
        if self._of_matlab():
            self.source = "matlab"
            matrices = [matrix - np.outer([1, 1, 0], [0, 0, 1]) for matrix in matrices]
            self.notes.append("MATLAB counts pixels from 1: 1 px is taken off cx and cy of both cameras")
        sizes = (size, self.right_size or size)
        left, right = (self._distortion(side, matrices[side], sizes[side]) for side in (0, 1))
        scaled = matrices[1] * np.array([[size[0] / sizes[1][0]] * 2 + [1.0]] * 2 + [[1.0] * 3])
        scaled[:2, 2] = scaled_px(matrices[1][:2, 2], sizes[1], size)
        rotation, translation = self._extrinsics()
        translation = translation * self._unit(float(np.linalg.norm(translation)))
        inner = matrices[0], left, scaled, right
        bare = Stereo(*size, *inner, rotation, translation, np.zeros((24, 24)), 0.0, assumed=True)
        bare = replace(bare, right_image_size=self.right_size)
        return parse_stereo(stereo_bytes(bare), "the imported calibration")

    def _check_model(self, side: int) -> None:
        """Refuses a lens model that nothing here converts."""
        model = self.fields.model(side)
        if kind_of(model) is None:
            raise refusal(
                "lens-model",
                file=", ".join(keys.file for keys in self.fields.files),
                found=f"the model {escaped(model, 40)} of the {SIDE_NAMES[side]} camera",
                allowed="plumb_bob, radtan, rational or equidistant",
                remedy="calibrate the pair again with five coefficients; renaming the model makes wrong rays",
            )

    def _of_matlab(self) -> bool:
        """Whether the fields are those of MATLAB's stereoParameters."""
        pair = self.fields.pair
        structured = (
            any(_named(camera.get("radial"), "radialdistortion") for camera in self.fields.cameras)
            or "R_transposed" in pair
        )
        return structured or self.transposed is not None or _named(pair.get("pose"), "a")

    def _exchange(self) -> None:
        """Files of one camera in the other order: the left projection alone has no shift."""
        cameras = self.fields.cameras
        if self.fields.by_file and all("P" in camera for camera in cameras):
            shifts = [np.abs(camera["P"].numbers[[3, 7]]).max() for camera in cameras]
            if shifts[1] == 0 and shifts[0] > 0:
                self.fields.cameras = cameras[::-1]

    def _take_rectified(self) -> None:
        """One camera and a baseline: the right camera of a rectified pair is as the left one."""
        left, right = self.fields.cameras
        if "baseline" in self.fields.pair and "fx" in left and not {"M", "fx", "P"} & set(right):
            right.update({key: entry for key, entry in left.items() if key in ("fx", "fy", "cx", "cy")})

    def _matrix(self, side: int) -> np.ndarray:
        """The camera matrix, of nine numbers, of four, of two and two, of single ones, or of a projection alone."""
        camera, name = self.fields.cameras[side], f"M{side + 1}"
        parts = [camera.get(key) for key in ("fx", "fy", "cx", "cy")]
        if "focal" in camera and "centre" in camera:
            parts = [camera["focal"], camera["centre"]]
        entry = camera.get("M")
        if entry is not None and entry.numbers.size == 9:
            matrix = entry.numbers.reshape(3, 3)
            if matrix[0, 2] == matrix[1, 2] == 0 and matrix[2, :2].all():
                matrix, self.transposed = matrix.T, entry
        elif entry is not None or all(one is not None for one in parts):
            entries = [one for one in (parts if entry is None else [entry]) if one is not None]
            fx, fy, cx, cy = np.concatenate([one.numbers for one in entries])
            matrix, entry = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), entries[0]
        elif "P" in camera and not any({"M", "fx"} & set(one) for one in self.fields.cameras):
            entry = camera["P"]
            matrix = entry.numbers.reshape(3, 4)[:, :3]
            self.notes.append(f"{entry.place} alone: the rectified {SIDE_NAMES[side]} camera, without distortion")
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
        """k1 k2 p1 p2 k3, fitted where the file has another model."""
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
            said = (
                "four coefficients without the name of a model, taken as k1 k2 p1 p2; of cv2.fisheye they are others:"
            )
            self.notes.append(f"{entry.place}: {said} then add distortion_model: equidistant")
        if kind in ("five", "rational") and not values[5:].any():
            return np.append(values[:5], np.zeros(max(0, 5 - values.size)))
        wanted = {"fisheye": 4, "inverse": 5}.get(str(kind), values.size)
        if values.size != wanted:
            found_here = f"{values.size} of a {kind} lens"
            raise entry.refuse("lens-model", f"{wanted} coefficients", "take the file as it was", found_here)
        assert kind is not None
        fitted = fitted_to_five(matrix, values, size, "rational" if kind == "five" else kind)
        what = {"fisheye": "a fisheye lens", "inverse": "a lens described from pixels to rays"}.get(
            kind, f"a lens of {values.size} coefficients"
        )
        if not fitted.error_px <= ERROR_MAX_PX:
            off = f"up to {fitted.error_px:.2g} px" if math.isfinite(fitted.error_px) else "more than any fit tells"
            allowed = f"what k1 k2 p1 p2 k3 describe to {ERROR_MAX_PX:g} px over the picture"
            remedy = "do not rename the model: calibrate again with five coefficients, or crop the pictures"
            raise entry.refuse("lens-model", allowed, remedy, f"{what}, which five coefficients miss by {off}")
        self.notes.append(f"{entry.place}: {what}, fitted to five coefficients within {fitted.error_px:.2g} px")
        return fitted.distortion

    @staticmethod
    def _coefficients(camera: Mapping[str, Entry], kind: Kind | None) -> tuple[np.ndarray, Entry] | None:
        """Coefficients in OpenCV's order and where they stand: of one entry, of MATLAB's two, of single numbers."""
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
        some = [entry for entry in single if entry is not None]
        values = np.array([0.0 if entry is None else float(entry.numbers[0]) for entry in single])
        return (values, some[0]) if some else None

    def _size(self, matrices: Sequence[np.ndarray]) -> tuple[int, int]:
        """The size of the left camera's pictures; that of the right one's, where it is another, is kept beside."""
        sizes: list[tuple[tuple[int, int], Entry]] = []
        for side, camera in enumerate(self.fields.cameras):
            if "size" in camera:
                entry = camera["size"]
                one = entry.numbers
            elif "width" in camera and "height" in camera:
                entry = camera["width"]
                one = np.array([camera["width"].numbers[0], camera["height"].numbers[0]])
            else:
                continue
            if not all(n == int(n) and 1 <= n <= 65_535 for n in one):
                raise entry.refuse(
                    "image-size", "whole numbers of pixels", "correct it", escaped(str(one.tolist()), 60)
                )
            width, height = int(one[0]), int(one[1])
            by_rows = _off_middle(matrices[side], (height, width)) < _off_middle(matrices[side], (width, height))
            if "size" in camera and (by_rows or self._of_matlab()) and width != height:
                width, height = height, width
                self.notes += [f"{entry.place} is taken as rows, columns: {width} x {height} px"] * (not sizes)
            sizes.append(((width, height), entry))
        if len({size for size, _ in sizes}) > 1:
            (one_size, entry), (other, _) = sizes
            found = f"left and right have two sizes: {one_size[0]} x {one_size[1]} and {other[0]} x {other[1]}"
            if not same_shape(one_size, other):
                remedy = "calibrate them at sizes of one proportion"
                raise entry.refuse("image-size", "sizes of one proportion of width to height", remedy, found)
            self.right_size = other
            self.notes.append(f"{found}: the right camera's numbers are those of its pictures scaled to the left one's")
        if sizes and self.stated_size not in (None, sizes[0][0]):
            found = f"{sizes[0][0][0]} x {sizes[0][0][1]} px"
            raise sizes[0][1].refuse("image-size", "the size of the pictures", "leave out --image-size", found)
        if sizes or self.stated_size is not None:
            return sizes[0][0] if sizes else self.stated_size  # type: ignore[return-value]
        remedy = "give it with --image-size, for example 1280x720"
        file = self.fields.files[0].file
        raise refusal("missing-key", file=file, found="no image size", allowed="image_width", remedy=remedy)

    def _extrinsics(self) -> tuple[np.ndarray, np.ndarray]:
        """R and T of x_right = R x_left + T, T in the file's unit: the first way to them, which all others confirm."""
        ways = list(self._ways())
        if not ways:
            left, pair = self.fields.cameras[0], self.fields.pair
            if self.fields.by_file or "M" in left or "fx" in left:
                raise self.fields.missing([name for name in ("R", "T") if name not in pair])
            raise self.fields.missing(["M1", "M2", "R", "T"])
        first, *others = ways
        self.places |= {"R": first.turn.place, "T": first.shift.place}
        self.source = first.source or self.source
        checks = [_of_pose(other) for other in others]
        cameras = self.fields.cameras
        if all("rectification" in c for c in cameras) and not any("P" in c for c in cameras):
            one, two = (c["rectification"].rotation() for c in cameras)
            if first.turn not in (c["rectification"] for c in cameras):
                checks.append(lambda r, t: float(np.abs(two.T @ one - r).max()))
        for name, (one, two) in {"E": (np.eye(3), np.eye(3)), "F": self.matrices}.items():
            if name in self.fields.pair:
                essential = two.T @ self.fields.pair[name].numbers.reshape(3, 3) @ one
                checks.append(partial(_off_essential, essential))
        for off in checks:
            if off(first.rotation, first.translation) > ROTATION_TOLERANCE:
                allowed, found_here = "one pose of the right camera", "another pose than the rest of the file says"
                remedy = "take the files as they were written, or remove what is of another calibration"
                if off(first.rotation.T, first.translation) <= ROTATION_TOLERANCE:
                    allowed, found_here = "R from left to right", "R transposed, by what else the file says"
                    remedy = f"take its transpose: --key R={first.turn.path}.T"
                raise first.turn.refuse("rotation", allowed, remedy, found_here)
        if not checks and first.plain and "R" not in self.fields.stated:
            self._doubt_turn(first)
        return first.rotation, first.translation

    def _ways(self) -> Iterator[_Pose]:
        """Every pose of the right camera that the files hold."""
        pair, (left, right) = self.fields.pair, self.fields.cameras
        for field, of_one in (("R", "rectification"), ("T", "camera_T")):
            # In the file or table of one camera: that of the pair, since both would have a rectification or a pose.
            if field not in pair and (of_one in left) != (of_one in right) and "P" not in left:
                pair[field] = left.get(of_one) or right[of_one]
        if "baseline" in pair and right.get("fx") is left.get("fx") and "fx" in left:
            shift = np.array([-pair["baseline"].numbers[0], 0.0, 0.0])
            yield _Pose(np.eye(3), shift, pair["baseline"], pair["baseline"], "orb-slam")
        turn = pair.get("R") or pair.get("R_transposed")
        if turn is not None and "T" in pair:
            rotation, source = turn.rotation(), ""
            by_columns = turn.numbers.size == 9 and turn.shape == (9,) and _named(left.get("cx"), "ppx")
            if "R" not in pair or by_columns:
                rotation, source = rotation.T, "matlab" if "R" not in pair else "realsense"
                if by_columns:
                    self.notes.append(f"{turn.place}: nine numbers, taken column by column as librealsense has them")
            yield _Pose(rotation, pair["T"].numbers, turn, pair["T"], source, plain=not source and self.unit is None)
        for field in ("pose", "pose_backwards"):
            if (entry := pair.get(field)) is not None:
                source = next((source for source, keys in POSES_OF.items() if entry.key in keys), "")
                pose = entry.pose() if field == "pose" else np.linalg.inv(entry.pose())
                yield _Pose(pose[:3, :3], pose[:3, 3], entry, entry, source)
        for field, source in (("from_body", "kalibr"), ("to_body", "euroc")):
            if field in left and field in right:
                one, two = (camera[field].pose() for camera in (left, right))
                pose = two @ np.linalg.inv(one) if field == "from_body" else np.linalg.inv(two) @ one
                yield _Pose(pose[:3, :3], pose[:3, 3], right[field], right[field], source)
        turns = [turn for c in (left, right) if (turn := c.get("camera_R", c.get("rectification"))) is not None]
        if all("camera_T" in camera for camera in (left, right)) and len(turns) == 2:
            one, two = (turn.rotation() for turn in turns)
            shift = right["camera_T"].numbers - two @ one.T @ left["camera_T"].numbers
            yield _Pose(two @ one.T, shift, turns[1], right["camera_T"])
        if "P" in left and "P" in right and not ("R" in pair and "T" in pair and "rectification" not in left):
            yield self._from_projections()

    def _from_projections(self) -> _Pose:
        """Rectified, the right camera sees x' = x + (P03 / P00, P13 / P11, 0): R = R2^T R1, T = R2^T of that."""
        left, right = self.fields.cameras
        one, two = (camera["P"].numbers.reshape(3, 4) for camera in (left, right))
        if np.any(one[:2, 3] != 0) or not np.any(two[:2, 3]) or not (two[0, 0] > 0 and two[1, 1] > 0):
            allowed = "P[0][3] = 0 in the left camera, -fx baseline in the right one"
            remedy = "take both files from one stereo calibration"
            raise right["P"].refuse("projection", allowed, remedy, "files that are no stereo pair")
        turns = [c["rectification"].rotation() if "rectification" in c else np.eye(3) for c in (left, right)]
        if "M" not in left and "fx" not in left:
            # The rectified pair itself is what is there.
            turns = [np.eye(3), np.eye(3)]
        shift = np.array([two[0, 3] / two[0, 0], two[1, 3] / two[1, 1], 0.0])
        source = "ros" if self.fields.by_file else ""
        return _Pose(turns[1].T @ turns[0], turns[1].T @ shift, right["P"], right["P"], source)

    def _doubt_turn(self, pose: _Pose) -> None:
        """Say what R means and what its transpose would mean, where nothing else in the file decides.

        Raises:
            InputError: the camera matrices are transposed, so that R may be too.
        """
        path = pose.turn.path
        if self.transposed is not None:
            remedy = f"say which: --key R={path}.T where it is transposed too, as by MATLAB, or --key R={path}"
            found = f"R beside {self.transposed.place}, which is transposed: R may be too"
            raise pose.turn.refuse("rotation", "R from left to right", remedy, found)
        if math.degrees(float(np.linalg.norm(rotation_vector(pose.rotation)))) < TURN_SAID_DEG:
            return
        stated_deg, transposed_deg = (_toe_in_deg(r, pose.translation) for r in (pose.rotation, pose.rotation.T))
        said = f"{pose.turn.place} is taken from left to right, x_right = R x_left + T, and nothing else in the file "
        said += f"says so: the optical axes {_toe_in(stated_deg)}; "
        said += (
            f"transposed they {_toe_in(transposed_deg)}: --key R={path}.T; `check` of a campaign with spots says which"
        )
        if stated_deg < -TURN_SAID_DEG < TURN_SAID_DEG < transposed_deg:
            self.warnings.append(f"is R transposed? {said}")
        else:
            self.notes.append(said)

    def _unit(self, length: float) -> float:
        """Millimetres of the file's unit: as stated, as the format has it, asked where that is implausible."""
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
        low, high = BASELINES_MM
        if not low <= length * UNITS_MM[unit] <= high:
            fits = [
                f"--import-unit {name} ({length * mm:.4g} mm)"
                for name, mm in UNITS_MM.items()
                if low <= length * mm <= high
            ]
            fits.append(f"--import-unit {unit} if it is so")
            fits += ["--import-unit 25 where it counts squares of 25 mm"] * (length < low)
            remedy = f"give {', or '.join(fits)}"
            found = f"cameras {length * UNITS_MM[unit]:.4g} mm apart, taken in {unit}"
            raise refusal(
                "unit",
                file=self.places["T"],
                found=found,
                allowed=f"{low:g} to {high:g} mm without a word",
                remedy=remedy,
            )
        if not stated:
            self.notes.append("T is taken in mm: the file does not state a unit")
        return UNITS_MM[unit]


def _off_middle(matrix: np.ndarray, size: tuple[int, int]) -> float:
    """By which share of pictures of a size a principal point misses their middle."""
    return max(abs(c - (n - 1) / 2) / n for c, n in zip(matrix[:2, 2], size, strict=True))


def _named(entry: Entry | None, word: str) -> bool:
    """Whether an entry's own key is a word, marks aside."""
    return entry is not None and entry.key.lower().replace("_", "") == word


def _of_pose(other: _Pose) -> Callable[[np.ndarray, np.ndarray], float]:
    """How far a pose is off another one, whose unit may be another."""

    def off(rotation: np.ndarray, translation: np.ndarray) -> float:
        ways = [t / np.linalg.norm(t) for t in (translation, other.translation) if t.any()]
        apart = float(np.abs(ways[0] - ways[1]).max()) if len(ways) == 2 else 0.0
        return max(float(np.abs(other.rotation - rotation).max()), apart)

    return off


def _off_essential(essential: np.ndarray, rotation: np.ndarray, translation: np.ndarray) -> float:
    """How far [T]x R is off an essential matrix of any length and sign."""
    x, y, z = translation
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    one, two = (e / np.linalg.norm(e) for e in (essential, cross @ rotation))
    return float(min(np.abs(one - two).max(), np.abs(one + two).max()))


def _toe_in_deg(rotation: np.ndarray, translation: np.ndarray) -> float:
    """Angle between the optical axes in the plane of the baseline, deg; negative where they diverge."""
    to_right, to_left = -rotation.T @ translation, translation
    sines = [way[2] / np.linalg.norm(way) for way in (to_right, to_left)]
    return math.degrees(sum(map(math.asin, sines)))


def _toe_in(angle_deg: float) -> str:
    return f"{'converge' if angle_deg >= 0 else 'diverge'} by {abs(angle_deg):.1f} deg"


def _made_by(pair: Mapping[str, Entry], fixed_intrinsics: bool | None) -> Known:
    """What files say of how they were made."""
    rms, views, columns, rows = (float(pair[name].numbers[0]) if name in pair else 0.0 for name in MADE_BY)
    return Known(
        rms_px=rms if 0 < rms <= RMS_PX_MAX else None,
        views=int(views) if 3 <= views <= VIEWS_MAX else None,
        board=(int(columns), int(rows)) if 3 <= columns <= 100 and 3 <= rows <= 100 else None,
        fixed_intrinsics=fixed_intrinsics,
    )
