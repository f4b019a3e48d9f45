"""The meaning of each number of a calibration file: one table of names, searched for every entry with its path.

A name states a field and often a camera: `M1`, `K_left`, `cameraMatrixL`, `cam0.intrinsics`, `Camera1.fx`. Case, dots
and underscores are ignored; the innermost names of a path count, up to three of them. An entry fits a field by its name
and by its number of values: `P1` of 12 numbers is a projection, `p1` of one number is a coefficient of a lens.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from tvsbayes.errors import InputError, closest, escaped, listed, refusal
from tvsbayes.files.documents import Keys
from tvsbayes.instrument.stereo_pair import rotation_matrix, rotation_vector

NAMES_LISTED = 12
NUMBER_MAX = 1e12
ROTATION_TOLERANCE = 1e-3
"""Largest deviation of R from a rotation, for files of few digits; the nearest rotation is used."""
FIELDS: dict[str, tuple[tuple[int, ...], str]] = {
    # Fields of each camera.
    "M": (
        (9, 4),
        "m k a cm mtx matrix cammat cameramatrix cammatrix cameramtx intrinsic intrinsics intrinsicmatrix "
        "intrinsicsmatrix intrinsicparameters cameraintrinsics kmatrix kk intrinsicsk "
        "intrinsicsintrinsicmatrix",
    ),
    "D": (
        (4, 5, 8, 12, 14),
        "d dc dist distortion distortions distcoeff distcoeffs distcoefs distcoef coeffs distortioncoeff "
        "distortioncoeffs distortioncoefs distortioncoefficients distortioncoefficient distortionparameters "
        "kc distvec distortionvector intrinsicscoeffs",
    ),
    "radial": ((2, 3), "radialdistortion intrinsicsradialdistortion radialtangentialradial"),
    "tangential": ((2,), "tangentialdistortion intrinsicstangentialdistortion"),
    "focal": ((2,), "fc focallength intrinsicsfocallength"),
    "centre": ((2,), "cc principalpoint intrinsicsprincipalpoint"),
    "rectification": ((9,), "r rect rectification rectificationmatrix rectificationtransform rectify"),
    "P": ((12,), "p proj projection projectionmatrix projmatrix"),
    "from_body": ((16,), "tcamimu tcimu tcambody"),
    "to_body": ((16,), "tbs timucam tbc tbodycam bodyt"),
    "camera_R": ((9, 3), "rotation rvec rotationvector"),
    "camera_T": ((3,), "translation tvec translationvector t trans"),
    "size": ((2,), "size resolution imagesize imgsize imagesizewh imageshape shape framesize"),
    "width": ((1,), "width imagewidth imgwidth w sizex nx"),
    "height": ((1,), "height imageheight imgheight h sizey ny"),
    "fx": ((1,), "fx intrinsicsfx"),
    "fy": ((1,), "fy intrinsicsfy"),
    "cx": ((1,), "cx ppx intrinsicscx intrinsicsppx"),
    "cy": ((1,), "cy ppy intrinsicscy intrinsicsppy"),
    **{f"coefficient_{name}": ((1,), name) for name in ("k1", "k2", "k3", "k4")},
    **{f"coefficient_p{n}": ((1,), f"p{n} radialtangentialt{n}") for n in (1, 2)},
    # Fields of the pair.
    "R": (
        (9, 3),
        "r rot rotation rotationmatrix rmat rmatrix stereor rstereo rotationvector rvec om rotmatrix rlr "
        "extrinsicsr extrinsicsrotation rotationlefttoright",
    ),
    "R_transposed": ((9,), "rotationofcamera2"),
    "T": (
        (3,),
        "t trans translation translationvector tvec tmat stereot tstereo transvec tvector "
        "translationofcamera2 extrinsicst extrinsicstranslation translationlefttoright tlr",
    ),
    "pose": (
        (16, 12),
        "tcncnm1 tc1c0 tcam1cam0 trightleft trl posecamera2a extrinsics extrinsic rt extrinsicmatrix "
        "tlefttoright cam1tcncnm1 t transform transformation transformationmatrix",
    ),
    "pose_backwards": ((16, 12), "tc1c2 stereotc1c2 tcam0cam1 tleftright trighttoleft righttoleft tc0c1"),
    "E": ((9,), "e essential essentialmatrix"),
    "F": ((9,), "f fundamental fundamentalmatrix"),
    "baseline": ((1,), "stereob baseline"),
    "rms_px": (
        (1,),
        "rms rmse rmspx rmserror rmsstereo stereorms error stereoerror ret retval rets retstereo stereoret "
        "reprojectionerror reprojerror reprojectionrms avgreprojectionerror meanreprojectionerror "
        "calibrationerror",
    ),
    "views": ((1,), "views nviews numviews nframes nrofframes numimages nimages"),
    "board_columns": ((1,), "boardwidth boardcolumns boardcols"),
    "board_rows": ((1,), "boardheight boardrows"),
}
"""Counts of numbers that a field can have, and its names. The side is before or after the name of a camera's field."""
PROVENANCE_FIELDS = tuple(FIELDS)[tuple(FIELDS).index("rms_px") :]
"""Fields that state how a calibration was made. The pitch is left out, since its unit is unknown."""
CAMERA_FIELDS = tuple(FIELDS)[: tuple(FIELDS).index("R")]
SIDES = {"left": 0, "right": 1, "l": 0, "r": 1, "first": 0, "second": 1}
"""Words for the camera; numbers start at 0 where one of them is 0, else at 1."""
_MARKS = ("cam", "camera", "cameraparameters", "sensor", "")
_IGNORED_TABLES = {"roi", "region_of_interest", "header"}
"""Tables whose numbers are not part of the calibration."""
MODEL_NAMES = ("distortionmodel", "distmodel", "cameratype", "cameramodel", "model", "lensmodel", "distortiontype")


class Meaning(NamedTuple):
    """A field, and the side that a name states for it, "" where it states none."""

    field: str
    side: str


def _table() -> dict[str, list[Meaning]]:
    """Meanings by name."""
    fields: dict[str, list[Meaning]] = {}
    for field, (_, words) in FIELDS.items():
        names = {(f"{mark}{word}", "") for word in words.split() for mark in _MARKS}
        if field in CAMERA_FIELDS:
            for word in words.split():
                for side in (*SIDES, "0", "1", "2"):
                    for mark in _MARKS:
                        names |= {(f"{mark}{side}{word}", side), (f"{side}{mark}{word}", side)}
                        names |= {(f"{word}{mark}{side}", side), (f"{mark}{word}{side}", side)}
        for name, side in names:
            fields.setdefault(name, []).append(Meaning(field, side))
    return fields


_NAMES = _table()


@dataclass(frozen=True)
class Entry:
    """Numbers of a file.

    Attributes:
        keys: the table that contains them.
        key: their name in the table.
        numbers: the numbers, flattened.
        shape: their shape in the file.
        file: number of the file.
    """

    keys: Keys
    key: str
    numbers: np.ndarray
    shape: tuple[int, ...]
    file: int

    @property
    def path(self) -> str:
        """Dotted path, as users name it."""
        return ".".join((*self.keys.path, self.key))

    @property
    def place(self) -> str:
        """Key and file, in words."""
        return f"{escaped(self.path, 80)} of {self.keys.file}"

    def refuse(self, code: str, allowed: str, remedy: str, found: str) -> InputError:
        """The refusal of these numbers."""
        return self.keys.refuse(self.key, code, allowed, remedy, found)

    def rotation(self) -> np.ndarray:
        """The rotation (3, 3): nearest to a matrix of nine numbers, or from Rodrigues' three."""
        if self.numbers.size == 3:
            if np.linalg.norm(self.numbers) > math.pi:
                found = escaped(str(self.numbers.tolist()), 60)
                raise self.refuse("rotation", "Rodrigues' vector, rad", "is it in degrees? give R as a matrix", found)
            return rotation_matrix(self.numbers)
        return self._nearest(self.numbers.reshape(3, 3))

    def transposed(self) -> Entry:
        """The inverse rotation: the transpose of a matrix, the negative of a vector."""
        return replace(self, numbers=self.numbers.reshape(3, 3).T.ravel() if self.numbers.size == 9 else -self.numbers)

    def pose(self) -> np.ndarray:
        """The homogeneous transformation (4, 4) of 12 or 16 numbers."""
        pose = np.vstack([self.numbers[:12].reshape(3, 4), [0, 0, 0, 1.0]])
        pose[:3, :3] = self._nearest(pose[:3, :3])
        return pose

    def _nearest(self, matrix: np.ndarray) -> np.ndarray:
        deviation = max(np.abs(matrix @ matrix.T - np.eye(3)).max(), abs(np.linalg.det(matrix) - 1.0))
        if not deviation <= ROTATION_TOLERANCE:
            allowed = f"R R^T = 1 and det R = +1 to {ROTATION_TOLERANCE:g}"
            remedy = "take the file as its tool wrote it, or name the right entry: --key R=NAME"
            raise self.refuse("rotation", allowed, remedy, f"a matrix that misses it by {deviation:.3g}")
        return rotation_matrix(rotation_vector(matrix))


def numbers_of(value: Any) -> np.ndarray | None:
    """Finite numbers, in their shape, of a number, nested lists or OpenCV's or ROS' rows, cols, data; else None."""
    if isinstance(value, Mapping):
        rows, cols = value.get("rows", value.get("Rows")), value.get("cols", value.get("Cols"))
        data = numbers_of(value.get("data", value.get("Data")))
        if data is not None and "sizes" in value:
            return data.ravel()
        if data is not None and isinstance(rows, int) and isinstance(cols, int) and rows * cols == data.size:
            # In an untrusted file both may be negative.
            return data.reshape(abs(rows), abs(cols))
        if {"x", "y", "z"} <= set(value) <= {"x", "y", "z", "rotation"}:
            # BoofCV states the rotation of a pose in the same table as its shift.
            shift, turn = numbers_of([value[axis] for axis in "xyz"]), numbers_of(value.get("rotation"))
            if shift is None or turn is None or turn.size != 9:
                return shift
            return np.column_stack([turn.reshape(3, 3), shift.ravel()])
        return None
    if isinstance(value, bool) or not isinstance(value, int | float | list):
        return None
    try:
        numbers = np.array(value, dtype=float)
    except (ValueError, TypeError, OverflowError):
        return None
    return numbers if numbers.size and (np.abs(numbers) <= NUMBER_MAX).all() else None


def entries_of(keys: Keys, file: int) -> Iterator[Entry]:
    """All entries with numbers, in the order of the file."""
    for key, value in keys.values.items():
        numbers = numbers_of(value)
        if numbers is None and isinstance(value, dict) and {"rows", "cols", "data"} <= {name.lower() for name in value}:
            raise keys.refuse(key, "matrix", "rows times cols finite numbers", "take the file as its tool wrote it")
        if isinstance(value, str) and _letters(key) in FIELDS["width"][1].split() + FIELDS["height"][1].split():
            raise keys.refuse(key, "integer", "a whole number of px", "correct the value")
        if numbers is not None:
            yield Entry(keys, key, numbers.ravel(), numbers.shape, file)
        elif isinstance(value, dict):
            yield from entries_of(keys.table(key), file)
        elif isinstance(value, list) and value and all(isinstance(item, dict) for item in value):
            for number, item in enumerate(value):
                yield from entries_of(Keys(item, keys.file, keys.text, (*keys.path, key, str(number))), file)
        elif isinstance(value, list):
            yield Entry(keys, key, np.empty(0), (0,), file)


def _letters(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())


def meanings(entry: Entry, *, of_any_count: bool = False) -> list[Meaning]:
    """Possible meanings of an entry, by the longest part of its path that is a known name.

    Args:
        entry: an entry of a file.
        of_any_count: use its name alone, for any count of numbers.
    """
    parts = (*entry.keys.path, entry.key)
    if _IGNORED_TABLES & set(parts):
        return []
    for count in range(min(4, len(parts)), 0, -1):
        known = _NAMES.get(_letters("".join(parts[-count:])), ())
        matches = [match for match in known if of_any_count or entry.numbers.size in FIELDS[match.field][0]]
        if matches:
            # A name without a side may be in the table of one camera.
            side = next((s for part in reversed(parts[:-count]) if (s := _side_of(part))), "")
            return [one if one.side or one.field not in CAMERA_FIELDS else Meaning(one.field, side) for one in matches]
    return []


def _side_of(part: str) -> str:
    """The camera in the name of a table, "" if none."""
    name = _letters(part)
    for mark in ("cameraparameters", "camera", "cam", "sensor"):
        name = name.replace(mark, "", 1)
    return name if name in (*SIDES, "0", "1", "2") else ""


def _side_in_name(file: str) -> int | None:
    """The camera in the name of a file; None if none."""
    for number, pattern in enumerate((r"left|cam(era)?[ _-]?0", r"right|cam(era)?[ _-]?1")):
        if re.search(pattern, file.lower()):
            return number
    return None


class Fields:
    """Entries of all files by field; those of cameras by field and number (0 left, 1 right)."""

    def __init__(self, files: Sequence[Keys], stated: Mapping[str, str]):
        """Sort the entries by name, and by `stated`: field, such as M1, to the path of its entry."""
        self.files, self.stated = files, set(stated)
        self.entries = [entry for k, keys in enumerate(files) for entry in entries_of(keys, k)]
        self.pair: dict[str, Entry] = {}
        self.cameras: tuple[dict[str, Entry], dict[str, Entry]] = ({}, {})
        self.twice: dict[str, tuple[Entry, Entry]] = {}
        readings = [(entry, meaning) for entry in self.entries for meaning in meanings(entry)]
        # Entries without a side come last: they fill the gaps of a camera.
        readings.sort(key=lambda reading: not reading[1].side)
        numbers = {meaning.side for _, meaning in readings if meaning.side.isdigit()}
        offset = 0 if "0" in numbers or not numbers else 1
        # Files of one camera each have entries without a side: the first file is the left one, unless names state it.
        camera_files = [k for k in range(len(files)) if self._has_camera(readings, k)]
        one_camera_each = len(camera_files) == 2
        if one_camera_each and [_side_in_name(files[k].file) for k in camera_files] == [1, 0]:
            camera_files.reverse()
        self.by_file = one_camera_each
        for entry, (field, side) in readings:
            if field in PROVENANCE_FIELDS:
                if not any(map(_side_of, entry.keys.path)):
                    self.pair.setdefault(field, entry)
            elif field not in CAMERA_FIELDS:
                if not (one_camera_each and field == "R" and entry.file in camera_files):
                    self._add(self.pair, field, field, entry)
            elif side:
                number = SIDES[side] if side in SIDES else int(side) - offset
                if number in (0, 1):
                    self._add(self.cameras[number], field, f"{field}{number + 1}", entry)
            elif one_camera_each and entry.file in camera_files:
                number = camera_files.index(entry.file)
                self._add(self.cameras[number], field, f"{field}{number + 1}", entry)
            elif field in ("size", "width", "height"):
                for camera in self.cameras:
                    camera.setdefault(field, entry)
        for field, name in stated.items():
            entry = self._stated_entry(field, name)
            self.twice.pop(field, None)
            if field in ("R", "T"):
                self.pair[field] = entry
                self.pair.pop("pose", None)
            else:
                self.cameras[int(field[-1]) - 1][field[:-1]] = entry

    @staticmethod
    def _has_camera(readings: Sequence[tuple[Entry, Meaning]], file: int) -> bool:
        """Whether a file contains a camera matrix without a side."""
        return any(e.file == file and of.field in ("M", "fx") and not of.side for e, of in readings)

    def _add(self, table: dict[str, Entry], field: str, name: str, entry: Entry) -> None:
        previous = table.get(field)
        if previous is None or (previous.numbers.size == 3 and entry.numbers.size == 9):
            # The matrix of a rotation replaces its vector.
            table[field] = entry
        elif previous.numbers.size == entry.numbers.size and not np.array_equal(previous.numbers, entry.numbers):
            self.twice[name] = previous, entry

    def _stated_entry(self, field: str, name: str) -> Entry:
        """The entry that the user named; transposed for NAME.T."""
        hits = [entry for entry in self.entries if name in (entry.path, entry.key)]
        if not hits and field == "R" and name.endswith(".T"):
            return self._stated_entry(field, name.removesuffix(".T")).transposed()
        if len(hits) != 1 or hits[0].numbers.size not in FIELDS[field.rstrip("12")][0]:
            paths = [entry.path for entry in self.entries]
            found = f"{len(hits)} entries of that name" if len(hits) != 1 else f"{hits[0].numbers.size} numbers"
            raise refusal(
                "usage",
                file=self.files[0].file,
                found=f"--key {field}={escaped(name, 60)}: {found}",
                allowed=f"one of {listed([escaped(path, 40) for path in paths], NAMES_LISTED)}",
                remedy=closest(name[:80], paths) if paths else "name a file that holds numbers",
            )
        return hits[0]

    def missing(self, fields_missing: Sequence[str]) -> InputError:
        """The refusal of files that lack fields; it lists the fields that exist."""
        sideless = {f: [e.path for e in self.entries if (f, "") in meanings(e)] for f in ("M", "D")}
        if len(self.files) == 1 and len(sideless["M"]) > 1 and "M1" in fields_missing:
            stated = [f"--key {field}{k}={name}" for field in sideless for k, name in enumerate(sideless[field][:2], 1)]
            return refusal(
                "missing-key",
                file=self.files[0].file,
                found=f"camera matrices that no name gives to left and right: {listed(sideless['M'], NAMES_LISTED)}",
                allowed="names with left and right, 0 and 1 or 1 and 2",
                remedy=f"say which is which: {' '.join(stated)}",
            )
        if len(self.files) == 1 and sideless["M"]:
            return refusal(
                "missing-file",
                file=self.files[0].file,
                found="the calibration of one camera",
                allowed="a pair: both cameras, and R and T between them",
                remedy="name the other camera's file too: --import LEFT --import RIGHT; R and T need pictures of both",
            )
        fields = {field.rstrip("12") for field in fields_missing}
        for entry in self.entries:
            names = {meaning.field for meaning in meanings(entry, of_any_count=True)} & fields
            if names and entry.numbers.size != 1 and not meanings(entry):
                counts = FIELDS[min(names)][0]
                return entry.refuse(
                    "matrix",
                    f"{listed([str(count) for count in counts], len(counts))} finite numbers",
                    "write k1 k2 p1 p2 k3, 0 for those that the lens lacks" if "D" in names else "correct it",
                    f"{entry.numbers.size} numbers" if entry.numbers.size else "no list of finite numbers",
                )
        unknown = [entry.path for entry in self.entries if not meanings(entry) and entry.numbers.size > 1]
        others = listed([escaped(path, 40) for path in unknown], NAMES_LISTED) if unknown else "no other numbers"
        remedy = "a pair needs M D of both cameras and R T between them: name the other file too"
        if unknown:
            remedy = f"name what holds it: --key {fields_missing[0]}=NAME"
        return refusal(
            "missing-key",
            file=", ".join(keys.file for keys in self.files),
            found=f"no {' '.join(fields_missing)} under a name that is known, and {others}",
            allowed="M1 D1 M2 D2 and R T, or what gives them",
            remedy=remedy,
        )

    def model(self, camera: int) -> str:
        """The name of a camera's lens model in the files, lower case; "" if none."""
        lens = next((self.cameras[camera][f] for f in ("D", "M", "fx") if f in self.cameras[camera]), None)
        tables = list(self.files)
        if lens is not None:
            tables = [self.files[lens.file]]
            for part in lens.keys.path:
                if isinstance(tables[0].values.get(part), dict):
                    tables.insert(0, tables[0].table(part))
            tables.insert(0, lens.keys)
        for keys in tables:
            for key, value in keys.values.items():
                bare = _letters(key)
                if isinstance(value, str) and any(bare.endswith(name) for name in MODEL_NAMES):
                    if bare.endswith(("cameramodel", "cameratype")) and _letters(value) in ("pinhole", "perspective"):
                        continue
                    return value.strip().lower()
        return ""
