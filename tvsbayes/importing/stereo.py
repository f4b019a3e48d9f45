"""Stereo calibrations of other programs, recognised by content: M and D of two cameras, x_right = R x_left + T.

`stereo_trees` makes entries of a file, `stereo_programs` brings structures of programs to known names. Here every entry
is looked up by its path in `data/words/stereo.toml`, and the numbers become a pair by the names of `stereo.json`, with
assumptions in words. A name states a field and often a camera: `M1`, `K_left`, `cam0.intrinsics`, `Camera1.fx`. It fits
a field by its count of numbers too: `P1` of 12 numbers is a projection, `p1` of one number a coefficient of a lens.
R and T can follow from several entries: all must agree. Lengths of a pair are mm; Kalibr, ROS and EuRoC write metres,
others the unit of the squares of their board. Other lenses are fitted to k1 k2 p1 p2 k3 by linear least squares over a
grid of pixels, the camera matrix unchanged.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import product
from typing import Any, NamedTuple

import cv2
import numpy as np

from tvsbayes.errors import InputError, closest, escaped, listed
from tvsbayes.files.documents import Keys
from tvsbayes.importing.asking import refused
from tvsbayes.importing.stereo_programs import FOCAL, RATIONAL, SIDES, Size, adapted, rigid, words
from tvsbayes.importing.stereo_trees import ROTATION_TOLERANCE, Entry, entries_of, letters

GRID = 25
"""Number of grid points along each side of the picture."""
ERROR_MAX_PX = 0.1
"""Largest accepted error of a fit, equal to that of a centroid."""
WIDEST_TAN = 4.0
"""Tangent of the angle off the axis, 76 deg, beyond which five coefficients are not tried."""
UNDISTORTION = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
"""Iterations, and the error of a distorted ray in px."""
LEFT, RIGHT = r"left|cam(era)?[ _-]?0", r"right|cam(era)?[ _-]?1"
UNITS_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
BASELINE_RANGE_MM = (20.0, 3000.0)
"""Distance of the cameras of one bench; outside this range the user must state the unit."""
RMS_PX_MAX, VIEWS_MAX = 20.0, 100_000
KEY_FIELDS = ("M1", "D1", "M2", "D2", "R", "T")
"""Fields that `--key` can name."""
NAMES_LISTED, FOCAL_MIN = 12, 1e-9
TURN_NOTED_DEG = 0.5
"""Angle below which a rotation and its transpose are hardly different."""
SHAPE_SHARE_MAX = 0.005
"""Largest relative difference of the aspect ratios of two picture sizes: rounding to whole pixels."""


class FittedLens(NamedTuple):
    """Five coefficients, their largest and rms error in the picture, px; infinite where the other model has no ray."""

    distortion: np.ndarray
    error_px: float
    rms_px: float


def kind_of(model: str) -> str | None:
    """The kind of a lens model by its name: five (also of no name), rational, fisheye or inverse; else None."""
    name = re.sub(r"[ -]", "_", model.strip().lower()).removeprefix("distortion.")
    return next((kind for kind, names in words()["lens"].items() if name in names.split()), None if name else "five")


def fitted_to_five(matrix: np.ndarray, distortion: np.ndarray, size: Size, kind: str) -> FittedLens:
    """Fit five coefficients to another model in a picture of this size, px.

    `distortion` holds OpenCV's 8, 12 or 14 coefficients, the 4 of its fisheye model, or the 5 of the inverse one.
    """
    pixels: np.ndarray = np.stack(np.meshgrid(*(np.linspace(0, n - 1, GRID) for n in size)), axis=-1).reshape(-1, 2)
    target = (pixels - matrix[:2, 2]) / matrix[[0, 1], [0, 1]]
    again, points = pixels, pixels[:, None]
    if kind == "inverse":
        rays = _projected(target, np.eye(3), distortion)
    elif kind == "fisheye":
        rays = cv2.fisheye.undistortPoints(points, matrix, distortion.reshape(4, 1)).reshape(-1, 2)
        again = cv2.fisheye.distortPoints(rays[:, None], matrix, distortion.reshape(4, 1)).reshape(-1, 2)
    else:
        if hasattr(cv2, "undistortPointsIter"):  # OpenCV 4: undistortPoints takes no criteria in Python
            rays = cv2.undistortPointsIter(points, matrix, distortion, None, None, UNDISTORTION).reshape(-1, 2)
        else:
            rays = cv2.undistortPoints(points, matrix, distortion, criteria=UNDISTORTION).reshape(-1, 2)
        again = _projected(rays, matrix, distortion)
    valid = np.isfinite(rays).all(axis=1) & (np.linalg.norm(rays, axis=1) < WIDEST_TAN)
    valid[valid] &= np.abs(again[valid] - pixels[valid]).max(axis=1) < ERROR_MAX_PX
    if not valid.all():
        return FittedLens(np.zeros(5), np.inf, np.inf)
    columns = [(_projected(rays, np.eye(3), unit) - rays).ravel() for unit in np.eye(5)]
    five = np.linalg.lstsq(np.stack(columns, axis=1), (target - rays).ravel())[0]
    errors_px = np.linalg.norm(_projected(rays, matrix, five) - pixels, axis=1)
    return FittedLens(five, float(errors_px.max()), float(np.sqrt(np.mean(errors_px**2))))


def _projected(rays: np.ndarray, matrix: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """Pixels (n, 2) of rays (n, 2) by any of OpenCV's pinhole models."""
    points = np.column_stack([rays, np.ones(len(rays))])
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, distortion)[0].reshape(-1, 2)


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


@cache
def _known_names() -> dict[str, list[tuple[str, str]]]:
    """Meanings by name: a field, and the side that the name states for it, "" where it states none."""
    found: dict[str, dict[tuple[str, str], None]] = {}
    for field, stated in words()["fields"].items():
        for name, mark in product(stated["names"].split(), words()["marks"]["camera"]):
            found.setdefault(f"{mark}{name}", {})[field, ""] = None
            for side in (*words()["sides"], "0", "1", "2") if field in words()["camera"] else ():
                for order in ((mark, side, name), (side, mark, name), (name, mark, side), (mark, name, side)):
                    found.setdefault("".join(order), {})[field, side] = None
    return {name: list(meant) for name, meant in found.items()}


def _meanings(entry: Entry, *, of_any_count: bool = False) -> list[tuple[str, str]]:
    """Possible meanings of an entry, by the longest part of its path that is a known name; for its count of numbers."""
    parts = (*entry.tables[-1].path, entry.key)
    for count in range(min(4, len(parts)), 0, -1) if not set(words()["marks"]["ignored"]) & set(parts) else ():
        known = _known_names().get(letters("".join(parts[-count:])), ())
        matches = [
            match for match in known if of_any_count or entry.numbers.size in words()["fields"][match[0]]["counts"]
        ]
        if matches:
            # A name without a side may be in the table of one camera.
            around = next((side for part in reversed(parts[:-count]) if (side := _side(part))), "")
            return [(field, side or (around if field in words()["camera"] else "")) for field, side in matches]
    return []


def _side(part: str) -> str:
    """The camera in the name of a table, "" if none."""
    name = letters(part)
    for mark in ("cameraparameters", "camera", "cam", "sensor"):
        name = name.replace(mark, "", 1)
    return name if name in (*words()["sides"], "0", "1", "2") else ""


class _Pose(NamedTuple):
    """A pose of the right camera (4, 4), in the file's unit; the entries of R and T, and the program they show."""

    matrix: np.ndarray
    turn: Entry
    shift: Entry
    source: str = ""
    plain: bool = False
    """Whether the name of R leaves its direction open."""

    def deviation(self, rotation: np.ndarray, translation: np.ndarray) -> float:
        """Deviation of another pose, whose unit may differ."""
        directions = [t / np.linalg.norm(t) for t in (translation, self.matrix[:3, 3]) if t.any()]
        distance = float(np.abs(directions[0] - directions[1]).max()) if len(directions) == 2 else 0.0
        return max(float(np.abs(self.matrix[:3, :3] - rotation).max()), distance)


class _Fields:
    """Entries of all files by field; those of cameras by field and number (0 left, 1 right)."""

    def __init__(self, files: Sequence[Keys], stated: Mapping[str, str]):
        """Sort the entries by name, and by `stated`: field, such as M1, to the path of its entry."""
        self.files, self.stated = files, set(stated)
        self.entries = [entry for keys in files for entry in entries_of((keys,))]
        self.pair: dict[str, Entry] = {}
        self.cameras: tuple[dict[str, Entry], dict[str, Entry]] = ({}, {})
        self.twice: dict[str, tuple[Entry, Entry]] = {}
        self.by_columns: Entry | None = None
        """A camera matrix that the file stores by columns."""
        self.notes: list[str] = []
        readings = [(entry, meaning) for entry in self.entries for meaning in _meanings(entry)]
        # Entries without a side come last: they fill the gaps of a camera.
        readings.sort(key=lambda reading: not reading[1][1])
        digits = {side for _, (_, side) in readings if side.isdigit()}
        order = words()["sides"] | ({"0": 0, "1": 1} if "0" in digits or not digits else {"1": 0, "2": 1})
        # Files of one camera each have entries without a side: the first file is the left one, unless names state it.
        without = [entry.tables[0] for entry, (field, side) in readings if field in ("M", "fx") and not side]
        ones = [keys for keys in files if keys in without]
        self.by_file = len(ones) == 2
        names = [keys.file.lower() for keys in ones]
        if self.by_file and re.search(RIGHT, names[0]) and re.search(LEFT, names[1]) and not re.search(LEFT, names[0]):
            ones.reverse()
        for entry, (field, side) in readings:
            alone = self.by_file and entry.tables[0] in ones
            if field in words()["made"]:
                if not any(map(_side, entry.tables[-1].path)):
                    self.pair.setdefault(field, entry)
            elif field in words()["pair"]:
                if not (alone and field == "R"):
                    self._add(self.pair, field, field, entry)
            elif side or alone:
                number = order.get(side) if side else ones.index(entry.tables[0])
                if number is not None:
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
        self._complete()

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
            entry = self._stated_entry(field, name.removesuffix(".T"))
            turned = entry.numbers.reshape(3, 3).T.ravel() if entry.numbers.size == 9 else -entry.numbers
            return entry._replace(numbers=turned)
        if len(hits) != 1 or hits[0].numbers.size not in words()["fields"][field.rstrip("12")]["counts"]:
            paths = [entry.path for entry in self.entries]
            found = f"{len(hits)} entries of that name" if len(hits) != 1 else f"{hits[0].numbers.size} numbers"
            said = f"{field}={escaped(name, 60)}: {found}"
            known = listed([escaped(path, 40) for path in paths], NAMES_LISTED)
            remedy = closest(name[:80], paths) if paths else "name a file that holds numbers"
            raise refused("stereo-stated-key", self.files[0].file, said=said, paths=known, remedy=remedy)
        return hits[0]

    def _complete(self) -> None:
        """Refuse what is stated twice; find the sides of two files by their projections, and fields of another name."""
        for name, (first, second) in self.twice.items():
            remedy = f"say which: --key {name}={second.path}" if name in KEY_FIELDS else "remove one of them"
            raise first.refuse("twice", remedy=remedy, place=second.place)
        if self.by_file and all("P" in camera for camera in self.cameras):
            shifts = [np.abs(camera["P"].numbers[[3, 7]]).max() for camera in self.cameras]
            if shifts[1] == 0 and shifts[0] > 0:
                # Two files of one camera each, named in reverse order: only the left projection has no shift.
                self.cameras = self.cameras[::-1]
        left, right = self.cameras
        if "baseline" in self.pair and "fx" in left and not {"M", "fx", "P"} & set(right):
            # The right camera of a rectified pair equals the left one.
            right.update({key: entry for key, entry in left.items() if key in FOCAL})
        for field, camera_field in (("R", "rectification"), ("T", "camera_T")):
            # An entry for one camera only belongs to the pair; rectifications and poses of cameras come in twos.
            if field not in self.pair and (camera_field in left) != (camera_field in right) and "P" not in left:
                self.pair[field] = left.get(camera_field) or right[camera_field]

    def missing(self, *lacking: str) -> InputError:
        """The refusal of files that lack fields; it lists the fields that exist."""
        sideless = {f: [e.path for e in self.entries if (f, "") in _meanings(e)] for f in ("M", "D", "fx")}
        file = ", ".join(keys.file for keys in self.files)
        if len(self.files) == 1 and len(sideless["M"]) > 1 and "M1" in lacking:
            stated = [f"--key {field}{k}={name}" for field in "MD" for k, name in enumerate(sideless[field][:2], 1)]
            return refused("stereo-sides", file, names=listed(sideless["M"], NAMES_LISTED), options=" ".join(stated))
        if len(self.files) == 1 and (sideless["M"] or sideless["fx"]):
            return refused("stereo-one-camera", file)
        unknown = [entry for entry in self.entries if entry.numbers.size != 1 and not _meanings(entry)]
        bare = {field.rstrip("12") for field in lacking}
        for entry in unknown:
            if names := {field for field, _ in _meanings(entry, of_any_count=True)} & bare:
                counts = ", ".join(map(str, words()["fields"][min(names)]["counts"]))
                remedy = "write k1 k2 p1 p2 k3, 0 for those that the lens lacks" if "D" in names else "correct it"
                found = f"{entry.numbers.size} numbers" if entry.numbers.size else "no list of finite numbers"
                return entry.refuse("count", counts=counts, remedy=remedy, found=found)
        paths = [escaped(entry.path, 40) for entry in unknown if entry.numbers.size]
        remedy = "a pair needs M D of both cameras and R T between them: name the other file too"
        remedy = f"name what holds it: --key {lacking[0]}=NAME" if paths else remedy
        others = listed(paths, NAMES_LISTED) if paths else "no other numbers"
        return refused("stereo-missing", file, lacking=" ".join(lacking), others=others, remedy=remedy)

    def model(self, side: int) -> str:
        """The name of a camera's lens model in the tables around its numbers, lower case; "" if none."""
        lens = next((self.cameras[side][field] for field in ("D", "M", "fx") if field in self.cameras[side]), None)
        tables = self.files if lens is None else lens.tables[::-1]
        for key, value in (item for keys in tables for item in keys.values.items()):
            name = letters(key)
            if isinstance(value, str) and name.endswith(tuple(words()["marks"]["model"])):
                any_pinhole = letters(value) in ("pinhole", "perspective")
                if not (any_pinhole and name.endswith(("cameramodel", "cameratype"))):
                    return value.strip().lower()
        return ""


def foreign_pair(
    files: Sequence[Keys], size: Size | None, unit_mm: float | None, keys: Mapping[str, str]
) -> ForeignPair:
    """The pair in the tables of another program; options as of `cameras.imported_calibration.read_calibration`.

    Raises:
        InputError: unknown, contradictory, or of lenses that five coefficients do not describe.
    """
    programs = [adapted(tree, size) for tree in files]
    fields = _Fields([tree for tree, *_ in programs], keys)
    fields.notes += [f"{tree.file}: {note}" for tree, _, _, notes in programs for note in notes]
    source, unit = next(((source, unit) for _, source, unit, _ in programs if source), ("", None))
    for side in (0, 1):
        if kind_of(model := fields.model(side)) is None:
            file = ", ".join(tree.file for tree in files)
            raise refused("stereo-model", file, model=escaped(model, 40), side=SIDES[side])
    as_stated, of_matrices = zip(*(_matrix(fields, side) for side in (0, 1)), strict=True)
    named = {
        letters(table[f].key) for table in (fields.pair, *fields.cameras) for f in ("radial", "pose") if f in table
    }
    # By the names of MATLAB's stereoParameters.
    matlab = bool(named & {"radialdistortion", "a"}) or "R_transposed" in fields.pair or fields.by_columns is not None
    (width, height), right_size = _sizes(fields, as_stated, size, matlab)
    matrices = as_stated
    if matlab:
        source, matrices = "matlab", [matrix - np.outer([1, 1, 0], [0, 0, 1]) for matrix in as_stated]
        fields.notes.append("MATLAB counts pixels from 1: 1 px is taken off cx and cy of both cameras")
    sizes = (width, height), right_size or (width, height)
    lenses, of_lenses = zip(*(_distortion(fields, k, matrices[k], sizes[k], source) for k in (0, 1)), strict=True)
    scale = np.array(sizes[0]) / sizes[1]
    M2 = matrices[1] * np.array([[scale[0]] * 2 + [1.0]] * 2 + [[1.0] * 3])
    # The integer is at the centre of a pixel, so pictures begin at -1/2.
    M2[:2, 2] = (matrices[1][:2, 2] + 0.5) * scale - 0.5
    pose, warnings = _checked_pose(fields, as_stated, unit is None)
    source = source or pose.source or "opencv"
    T = pose.matrix[:3, 3] * _unit(fields, pose, unit_mm, unit, source)
    values = {"image_width": width, "image_height": height, "right_image_size": right_size, "M1": matrices[0]}
    values |= {"D1": lenses[0], "M2": M2, "D2": lenses[1], "R": pose.matrix[:3, :3], "T": T}
    entries = zip(("M1", "M2", "D1", "D2", "R", "T"), (*of_matrices, *of_lenses, pose.turn, pose.shift), strict=True)
    places = {name: entry.place for name, entry in entries if entry is not None}
    return ForeignPair(values, source, _made(fields.pair, source), fields.notes, warnings, places)


def _made(pair: Mapping[str, Entry], source: str) -> dict[str, Any]:
    """How the calibration was made, as its files state it."""
    rms, views, columns, rows = (float(pair[name].numbers[0]) if name in pair else 0.0 for name in words()["made"])
    return {
        "rms_px": rms if 0 < rms <= RMS_PX_MAX else None,
        "views": int(views) if 3 <= views <= VIEWS_MAX else None,
        "board": (int(columns), int(rows)) if 3 <= columns <= 100 and 3 <= rows <= 100 else None,
        "fixed_intrinsics": words()["programs"]["fixed_intrinsics"].get(source),
    }


def _matrix(fields: _Fields, side: int) -> tuple[np.ndarray, Entry]:
    """The camera matrix and its entry: of nine numbers, four, two pairs, single numbers, or a projection."""
    camera, others = fields.cameras[side], [{"M", "fx"} & set(camera) for camera in fields.cameras]
    forms = [form for form in (("M",), ("focal", "centre"), FOCAL) if set(form) <= set(camera)]
    if not forms and "P" in camera and not any(others):
        forms = [("P",)]
        fields.notes.append(f"{camera['P'].place} alone: the rectified {SIDES[side]} camera, without distortion")
    if not forms:
        raise fields.missing(*([f"M{k + 1}" for k in (0, 1) if not others[k]] or [f"M{side + 1}"]))
    entry = camera[forms[0][0]]
    numbers = np.concatenate([camera[name].numbers for name in forms[0]])
    if numbers.size == 4:
        numbers = np.array([numbers[0], 0, numbers[2], 0, numbers[1], numbers[3], 0, 0, 1.0])
    matrix = numbers.reshape(3, -1)[:, :3]
    if matrix[0, 2] == matrix[1, 2] == 0 and matrix[2, :2].all():
        matrix, fields.by_columns = matrix.T, entry
    skewed = abs(matrix[0, 1]) > 1e-9 * abs(matrix[0, 0]) or matrix[1, 0] != 0
    if not (min(matrix[0, 0], matrix[1, 1]) > FOCAL_MIN and np.allclose(matrix[2], [0, 0, 1])) or skewed:
        raise entry.refuse("matrix-pattern")
    return np.array([[matrix[0, 0], 0, matrix[0, 2]], [0, matrix[1, 1], matrix[1, 2]], [0, 0, 1.0]]), entry


def _sizes(
    fields: _Fields, matrices: Sequence[np.ndarray], stated: Size | None, matlab: bool
) -> tuple[Size, Size | None]:
    """The size of the left camera's pictures, and that of the right one's where it differs."""
    sizes: list[tuple[Size, Entry]] = []
    for matrix, camera in zip(matrices, fields.cameras, strict=True):
        form = ("size",) if "size" in camera else ("width", "height")
        if not set(form) <= set(camera):
            continue
        entry, pixels = camera[form[0]], np.concatenate([camera[name].numbers for name in form])
        if not all(n == int(n) and 1 <= n <= 65_535 for n in pixels):
            raise entry.refuse("pixels", found=escaped(str(pixels.tolist()), 60))
        width, height = map(int, pixels)
        # Offset of the principal point from the middle of the pictures, as a share of their size.
        shares = [np.abs((matrix[:2, 2] + 0.5) / n - 0.5).max() for n in ((width, height), (height, width))]
        by_rows = matlab or shares[1] < shares[0]
        if form == ("size",) and by_rows and width != height:
            width, height = height, width
            fields.notes += [f"{entry.place} is taken as rows, columns: {width} x {height} px"] * (not sizes)
        sizes.append(((width, height), entry))
    if not sizes:
        if stated is not None:
            return stated, None
        first = fields.files[0]
        where = f", or name {first.values['size_in']}, which has it" if "size_in" in first else ""
        raise refused("stereo-no-size", first.file, where=where)
    (left, entry), (right, _) = sizes[0], sizes[-1]
    if left != right:
        found = f"left and right have two sizes: {left[0]} x {left[1]} and {right[0]} x {right[1]}"
        if abs(left[0] * right[1] / (left[1] * right[0]) - 1.0) > SHAPE_SHARE_MAX:
            raise entry.refuse("proportion", found=found)
        fields.notes.append(f"{found}: the right camera's numbers are those of its pictures scaled to the left one's")
    if stated not in (None, left):
        raise entry.refuse("stated-size", found=f"{left[0]} x {left[1]}")
    return left, right if right != left else None


def _coefficients(camera: Mapping[str, Entry], kind: str) -> tuple[np.ndarray, Entry | None]:
    """Coefficients in OpenCV's order and their entry: one entry, MATLAB's two, or single numbers; None where none."""
    if "D" in camera:
        return camera["D"].numbers, camera["D"]
    order = ("k1", "k2", "k3", "k4") if kind == "fisheye" and "radial" not in camera else RATIONAL[:5]
    parts: dict[str, tuple[str, ...]] = {f"coefficient_{name}": (name,) for name in order}
    parts |= {"radial": ("k1", "k2", "k3"), "tangential": ("p1", "p2")}
    stated: dict[str, float] = {}
    for field in (field for field in parts if field in camera):
        stated |= zip(parts[field], camera[field].numbers, strict=False)
    # What is called tangential alone lacks its other half.
    first = next((camera[field] for field in parts if field in camera and field != "tangential"), None)
    return np.array([stated.get(name, 0.0) for name in order]), first


def _distortion(
    fields: _Fields, side: int, matrix: np.ndarray, size: Size, source: str
) -> tuple[np.ndarray, Entry | None]:
    """The coefficients k1 k2 p1 p2 k3, and their entry; fitted where the file has another model."""
    camera, model = fields.cameras[side], fields.model(side)
    kind = kind_of(model) or "five"
    values, entry = _coefficients(camera, kind)
    if entry is None:
        if {"M", "fx"} & set(camera) and model != "rectified":
            raise fields.missing(f"D{side + 1}")
        return np.zeros(5), None
    if kind == "fisheye" and not values[4:].any():
        values = values[:4]
    if not values.any() and kind != "fisheye":
        return np.zeros(5), entry
    if kind == "five" and values.size == 4 and not model:
        said = "four coefficients without the name of a model, taken as k1 k2 p1 p2"
        remedy = "of cv2.fisheye they are others: then add distortion_model: equidistant"
        fields.notes.append(f"{entry.place}: {said}; {remedy}")
    if kind in ("five", "rational") and not values[5:].any():
        return np.append(values[:5], np.zeros(max(0, 5 - values.size))), entry
    count = {"fisheye": 4, "inverse": 5}.get(kind, values.size)
    if values.size != count:
        raise entry.refuse("coefficients", found=values.size, kind=kind, count=count)
    fitted = fitted_to_five(matrix, values, size, kind)
    lens = {"fisheye": "a fisheye lens", "inverse": "a lens described from pixels to rays"}
    said = lens.get(kind, f"a lens of {values.size} coefficients") + (f" of {source}" if source else "")
    if not fitted.error_px <= ERROR_MAX_PX:
        miss = f"up to {fitted.error_px:.2g} px, {fitted.rms_px:.2g} px rms"
        miss = miss if math.isfinite(fitted.error_px) else "an undetermined amount"
        convert = words()["programs"]["convert"].get(source, "")
        raise entry.refuse("lens", lens=said, miss=miss, most=ERROR_MAX_PX, convert=convert)
    fields.notes.append(f"{entry.place}: {said}, fitted to five coefficients within {fitted.error_px:.2g} px")
    return fitted.distortion, entry


def _poses(fields: _Fields, unit_open: bool) -> Iterator[_Pose]:
    """All poses of the right camera in the files."""
    pair, (left, right) = fields.pair, fields.cameras
    if "baseline" in pair and right.get("fx") is left.get("fx") and "fx" in left:
        shift = np.array([-pair["baseline"].numbers[0], 0.0, 0.0])
        yield _Pose(rigid(np.eye(3), shift), pair["baseline"], pair["baseline"], "orb-slam")
    turn = pair.get("R") or pair.get("R_transposed")
    if turn is not None and "T" in pair:
        by_columns = turn.shape == (9,) and "cx" in left and letters(left["cx"].key) == "ppx"
        source = "matlab" if "R" not in pair else "realsense" if by_columns else ""
        rotation = turn.rotation().T if source else turn.rotation()
        if by_columns:
            fields.notes.append(f"{turn.place}: nine numbers, taken column by column as librealsense has them")
        plain = not source and unit_open
        yield _Pose(rigid(rotation, pair["T"].numbers), turn, pair["T"], source, plain)
    for field in ("pose", "pose_backwards"):
        if (entry := pair.get(field)) is not None:
            known = words()["programs"]["pose_keys"]
            source = next((source for source, keys in known.items() if entry.key in keys), "")
            pose = entry.pose() if field == "pose" else np.linalg.inv(entry.pose())
            yield _Pose(pose, entry, entry, source)
    for field, source in (("from_body", "kalibr"), ("to_body", "euroc")):
        if field in left and field in right:
            of_left, of_right = left[field].pose(), right[field].pose()
            pose = of_right @ np.linalg.inv(of_left) if field == "from_body" else np.linalg.inv(of_right) @ of_left
            yield _Pose(pose, right[field], right[field], source)
    turns = [turn for camera in (left, right) if (turn := camera.get("camera_R", camera.get("rectification")))]
    shifts = [camera["camera_T"] for camera in (left, right) if "camera_T" in camera]
    if len(turns) == len(shifts) == 2:
        poses = [rigid(turn.rotation(), shift.numbers) for turn, shift in zip(turns, shifts, strict=True)]
        yield _Pose(poses[1] @ np.linalg.inv(poses[0]), turns[1], shifts[1])
    if "P" in left and "P" in right and not ("R" in pair and "T" in pair and "rectification" not in left):
        yield _pose_of_projections(fields)


def _pose_of_projections(fields: _Fields) -> _Pose:
    """The rectified right camera sees x' = x + (P03 / P00, P13 / P11, 0): R = R2^T R1, T = R2^T times the shift."""
    left, right = fields.cameras
    left_p, right_p = (camera["P"].numbers.reshape(3, 4) for camera in (left, right))
    if np.any(left_p[:2, 3] != 0) or not np.any(right_p[:2, 3]) or not (right_p[0, 0] > 0 and right_p[1, 1] > 0):
        raise right["P"].refuse("projection")
    # Without matrices the files contain the rectified pair itself.
    raw = "M" in left or "fx" in left
    turns = [c["rectification"].rotation() if raw and "rectification" in c else np.eye(3) for c in (left, right)]
    shift = np.array([right_p[0, 3] / right_p[0, 0], right_p[1, 3] / right_p[1, 1], 0.0])
    matrix = rigid(turns[1].T @ turns[0], turns[1].T @ shift)
    return _Pose(matrix, right["P"], right["P"], "ros" if fields.by_file else "")


def _checked_pose(fields: _Fields, matrices: Sequence[np.ndarray], unit_open: bool) -> tuple[_Pose, list[str]]:
    """The first pose of the right camera, checked against all others and E and F; with doubts of its direction."""
    poses, cameras, pair = list(_poses(fields, unit_open)), fields.cameras, fields.pair
    if not poses:
        raise fields.missing(*[name for name in ("R", "T") if name not in pair] or ["R", "T"])
    first, *others = poses
    rectifications = [camera["rectification"] for camera in cameras if "rectification" in camera]
    others_state_it = any("P" in camera for camera in cameras) or any(first.turn is entry for entry in rectifications)
    if len(rectifications) == 2 and not others_state_it:
        left_part, right_part = (entry.rotation() for entry in rectifications)
        others.append(first._replace(matrix=rigid(right_part.T @ left_part, np.zeros(3))))
    checks: list[Callable[[np.ndarray, np.ndarray], float]] = [other.deviation for other in others]
    for name, (of_left, of_right) in {"E": (np.eye(3), np.eye(3)), "F": matrices}.items():
        if name in pair:
            checks.append(partial(_essential_deviation, of_right.T @ pair[name].numbers.reshape(3, 3) @ of_left))
    rotation, translation = first.matrix[:3, :3], first.matrix[:3, 3]
    for deviation in checks:
        if not deviation(rotation, translation) <= ROTATION_TOLERANCE:
            turned = deviation(rotation.T, translation) <= ROTATION_TOLERANCE
            raise first.turn.refuse("transposed" if turned else "other-pose", path=first.turn.path)
    if checks or not first.plain or "R" in fields.stated:
        return first, []
    return first, _doubted_direction(fields, first)


def _essential_deviation(essential: np.ndarray, rotation: np.ndarray, translation: np.ndarray) -> float:
    """Deviation of [T]x R from an essential matrix of any length and sign."""
    product_of_columns = np.cross(translation, rotation, axisb=0, axisc=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        stated, expected = (e / np.linalg.norm(e) for e in (essential, product_of_columns))
    return float(min(np.abs(stated - expected).max(), np.abs(stated + expected).max()))


def _doubted_direction(fields: _Fields, pose: _Pose) -> list[str]:
    """Warnings of the meaning of R where nothing else in the file determines it; a note of it and of its transpose."""
    path, rotation, translation = pose.turn.path, pose.matrix[:3, :3], pose.matrix[:3, 3]
    if fields.by_columns is not None:
        raise pose.turn.refuse("maybe-transposed", place=fields.by_columns.place, path=path)
    if math.degrees(float(np.linalg.norm(cv2.Rodrigues(rotation)[0]))) < TURN_NOTED_DEG:
        return []

    def toe_in_deg(rotation: np.ndarray) -> float:
        """Angle between the optical axes in the plane of the baseline, deg; negative where they diverge."""
        sines = [direction[2] / np.linalg.norm(direction) for direction in (-rotation.T @ translation, translation)]
        return math.degrees(sum(map(math.asin, np.clip(sines, -1.0, 1.0))))

    angles_deg = toe_in_deg(rotation), toe_in_deg(rotation.T)
    stated, turned = (f"{'converge' if deg >= 0 else 'diverge'} by {abs(deg):.1f} deg" for deg in angles_deg)
    text = (
        f"{pose.turn.place} is taken from left to right, x_right = R x_left + T, and nothing else in the file says "
        f"so: the optical axes {stated}; transposed they {turned}: --key R={path}.T; `check` of a campaign with "
        "spots says which"
    )
    if angles_deg[0] < -TURN_NOTED_DEG < TURN_NOTED_DEG < angles_deg[1]:
        return [f"is R transposed? {text}"]
    fields.notes.append(text)
    return []


def _unit(fields: _Fields, pose: _Pose, unit_mm: float | None, of_format: str | None, source: str) -> float:
    """Millimetres per unit of the file: as stated, or by the format; an implausible one must be stated."""
    place, length = pose.shift.place, float(np.linalg.norm(pose.matrix[:3, 3]))
    if not 0 < length < math.inf:
        raise refused("stereo-no-baseline", place)
    if unit_mm is not None:
        return unit_mm
    stated = of_format or ("m" if source in words()["programs"]["metres"] else "")
    unit = stated.strip("?") or "mm"
    low, high = BASELINE_RANGE_MM
    if stated == "?" or not low <= length * UNITS_MM[unit] <= high:
        inside = {name: length * mm for name, mm in UNITS_MM.items() if low <= length * mm <= high}
        options = [f"--import-unit {name} ({mm:.4g} mm)" for name, mm in inside.items()]
        options += [] if stated == "?" else [f"--import-unit {unit} if it is so"]
        options += ["--import-unit 25 where it counts squares of 25 mm"] * (length < low or not options)
        row, length = ("stereo-no-unit", length) if stated == "?" else ("stereo-unit", length * UNITS_MM[unit])
        raise refused(row, place, length=length, unit=unit, low=low, high=high, options=", or ".join(options))
    if not stated:
        fields.notes.append("T is taken in mm: the file does not state a unit")
    return UNITS_MM[unit]
