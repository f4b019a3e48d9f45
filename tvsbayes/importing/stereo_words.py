"""Which number of a calibration is which: every entry of a file, looked up by its path in `data/words/stereo.toml`.

A name states a field and often a camera: `M1`, `K_left`, `cameraMatrixL`, `cam0.intrinsics`, `Camera1.fx`. The
innermost names of a path count, up to three of them. An entry fits a field by its name and by its number of values:
`P1` of 12 numbers is a projection, `p1` of one number is a coefficient of a lens.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

import cv2
import numpy as np

from tvsbayes.errors import InputError, closest, escaped, listed, shown
from tvsbayes.files.disk import shipped_data
from tvsbayes.files.documents import Keys
from tvsbayes.importing import asking

NAMES_LISTED = 12
LEFT, RIGHT = r"left|cam(era)?[ _-]?0", r"right|cam(era)?[ _-]?1"
NUMBER_MAX = 1e12
ROTATION_TOLERANCE = 1e-3
"""Largest deviation of R from a rotation, for files of few digits; the nearest rotation is used."""


@cache
def words() -> dict[str, Any]:
    """The names of fields, sides, lenses and programs."""
    return tomllib.loads((shipped_data() / "words" / "stereo.toml").read_text(encoding="utf-8"))


@cache
def fields() -> dict[str, tuple[tuple[int, ...], list[str]]]:
    """Counts of numbers that a field can have, and its names."""
    tables = (words()[kind] for kind in ("camera", "pair", "made"))
    return {name: (tuple(of["counts"]), of["names"].split()) for table in tables for name, of in table.items()}


def refused(what: str, file: str, keys: Keys | None = None, key: str = "", /, **values: Any) -> InputError:
    """A refusal in a file, or of a key of a table."""
    if keys is None:
        return asking.refused(f"stereo-{what}", file, **values)
    text = asking.filled(f"stereo-{what}", values)
    return keys.refuse(key, text["code"], text["allowed"], text["remedy"], text["found"])


class Meaning(NamedTuple):
    """A field, and the side that a name states for it, "" where it states none."""

    field: str
    side: str


@cache
def known_names() -> dict[str, list[Meaning]]:
    """Meanings by name."""
    found: dict[str, dict[Meaning, None]] = {}
    marks = words()["marks"]["camera"]
    for field, (_, names) in fields().items():
        for name in names:
            for mark in marks:
                found.setdefault(f"{mark}{name}", {})[Meaning(field, "")] = None
                for side in (*words()["sides"], "0", "1", "2") if field in words()["camera"] else ():
                    for order in ((mark, side, name), (side, mark, name), (name, mark, side), (mark, name, side)):
                        found.setdefault("".join(order), {})[Meaning(field, side)] = None
    return {name: list(meant) for name, meant in found.items()}


class Entry(NamedTuple):
    """Numbers of a file: the table that contains them, their name there, flat and by shape; number of the file."""

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

    def refuse(self, what: str, **values: Any) -> InputError:
        """The refusal of these numbers."""
        return refused(what, "", self.keys, self.key, **values)

    def rotation(self) -> np.ndarray:
        """The rotation (3, 3): nearest to a matrix of nine numbers, or from Rodrigues' three."""
        if self.numbers.size == 3:
            if np.linalg.norm(self.numbers) > math.pi:
                raise self.refuse("degrees", found=escaped(str(self.numbers.tolist()), 60))
            return cv2.Rodrigues(self.numbers)[0]
        return self._nearest(self.numbers.reshape(3, 3))

    def transposed(self) -> Entry:
        """The inverse rotation: the transpose of a matrix, the negative of a vector."""
        inverse = self.numbers.reshape(3, 3).T.ravel() if self.numbers.size == 9 else -self.numbers
        return self._replace(numbers=inverse)

    def pose(self) -> np.ndarray:
        """The homogeneous transformation (4, 4) of 12 or 16 numbers."""
        pose = np.vstack([self.numbers[:12].reshape(3, 4), [0, 0, 0, 1.0]])
        pose[:3, :3] = self._nearest(pose[:3, :3])
        return pose

    def _nearest(self, matrix: np.ndarray) -> np.ndarray:
        deviation = max(np.abs(matrix @ matrix.T - np.eye(3)).max(), abs(np.linalg.det(matrix) - 1.0))
        if not deviation <= ROTATION_TOLERANCE:
            raise self.refuse("no-rotation", found=deviation, tolerance=ROTATION_TOLERANCE)
        u, _, vt = np.linalg.svd(matrix)
        return u @ vt


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
            return np.c_[turn.reshape(3, 3), shift.ravel()]
        return None
    if isinstance(value, bool) or not isinstance(value, int | float | list):
        return None
    try:
        numbers = np.array(value, dtype=float)
    except (ValueError, TypeError, OverflowError):
        return None
    return numbers if numbers.size and (np.abs(numbers) <= NUMBER_MAX).all() else None


def entries_of(keys: Keys, file: int) -> Iterator[Entry]:
    """All entries with numbers, in the order of the file; lists that are no numbers as empty ones."""
    for key, value in keys.values.items():
        numbers = numbers_of(value)
        if numbers is None and isinstance(value, dict) and {"rows", "cols", "data"} <= {name.lower() for name in value}:
            raise refused("not-finite", "", keys, key)
        if isinstance(value, str) and any(letters(key) in fields()[side][1] for side in ("width", "height")):
            raise refused("pixel-text", "", keys, key, found=shown(value))
        if numbers is not None:
            yield Entry(keys, key, numbers.ravel(), numbers.shape, file)
        elif isinstance(value, dict):
            yield from entries_of(keys.table(key), file)
        elif isinstance(value, list) and value and all(isinstance(item, dict) for item in value):
            for number, item in enumerate(value):
                yield from entries_of(Keys(item, keys.file, keys.text, (*keys.path, key, str(number))), file)
        elif isinstance(value, list):
            yield Entry(keys, key, np.empty(0), (0,), file)


def letters(name: str) -> str:
    """A name as it is looked up."""
    return re.sub(r"[^a-z0-9]", "", name.lower())


def meanings(entry: Entry, *, of_any_count: bool = False) -> list[Meaning]:
    """Possible meanings of an entry, by the longest part of its path that is a known name; for its count of numbers."""
    parts = (*entry.keys.path, entry.key)
    if set(words()["marks"]["ignored"]) & set(parts):
        return []
    for count in range(min(4, len(parts)), 0, -1):
        known = known_names().get(letters("".join(parts[-count:])), ())
        matches = [match for match in known if of_any_count or entry.numbers.size in fields()[match.field][0]]
        if matches:
            # A name without a side may be in the table of one camera.
            side = next((s for part in reversed(parts[:-count]) if (s := side_of(part))), "")
            return [m if m.side or m.field not in words()["camera"] else Meaning(m.field, side) for m in matches]
    return []


def side_of(part: str) -> str:
    """The camera in the name of a table, "" if none."""
    name = letters(part)
    for mark in ("cameraparameters", "camera", "cam", "sensor"):
        name = name.replace(mark, "", 1)
    return name if name in (*words()["sides"], "0", "1", "2") else ""


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
        camera_files = sorted({entry.file for entry, of in readings if of.field in ("M", "fx") and not of.side})
        self.by_file = len(camera_files) == 2
        names = [files[k].file.lower() for k in camera_files]
        if self.by_file and re.search(RIGHT, names[0]) and re.search(LEFT, names[1]) and not re.search(LEFT, names[0]):
            camera_files.reverse()
        for entry, (field, side) in readings:
            if field in words()["made"]:
                if not any(map(side_of, entry.keys.path)):
                    self.pair.setdefault(field, entry)
            elif field not in words()["camera"]:
                if not (self.by_file and field == "R" and entry.file in camera_files):
                    self._add(self.pair, field, field, entry)
            elif side or (self.by_file and entry.file in camera_files):
                number = words()["sides"].get(side, int(side) - offset if side.isdigit() else 0)
                number = number if side else camera_files.index(entry.file)
                if number in (0, 1):
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
        if len(hits) != 1 or hits[0].numbers.size not in fields()[field.rstrip("12")][0]:
            paths = [entry.path for entry in self.entries]
            found = f"{len(hits)} entries of that name" if len(hits) != 1 else f"{hits[0].numbers.size} numbers"
            known = listed([escaped(path, 40) for path in paths], NAMES_LISTED)
            remedy = closest(name[:80], paths) if paths else "name a file that holds numbers"
            said = {"field": field, "name": escaped(name, 60), "found": found, "paths": known, "remedy": remedy}
            raise refused("stated-key", self.files[0].file, **said)
        return hits[0]

    def missing(self, lacking: Sequence[str]) -> InputError:
        """The refusal of files that lack fields; it lists the fields that exist."""
        sideless = {f: [e.path for e in self.entries if (f, "") in meanings(e)] for f in ("M", "D", "fx")}
        file = ", ".join(keys.file for keys in self.files)
        if len(self.files) == 1 and len(sideless["M"]) > 1 and "M1" in lacking:
            stated = [f"--key {field}{k}={name}" for field in "MD" for k, name in enumerate(sideless[field][:2], 1)]
            return refused("sides", file, names=listed(sideless["M"], NAMES_LISTED), options=" ".join(stated))
        if len(self.files) == 1 and (sideless["M"] or sideless["fx"]):
            return refused("one-camera", file)
        bare = {field.rstrip("12") for field in lacking}
        for entry in self.entries:
            names = {meaning.field for meaning in meanings(entry, of_any_count=True)} & bare
            if names and entry.numbers.size != 1 and not meanings(entry):
                counts = ", ".join(map(str, fields()[min(names)][0]))
                remedy = "write k1 k2 p1 p2 k3, 0 for those that the lens lacks" if "D" in names else "correct it"
                found = f"{entry.numbers.size} numbers" if entry.numbers.size else "no list of finite numbers"
                return entry.refuse("count", counts=counts, remedy=remedy, found=found)
        unknown = [entry.path for entry in self.entries if not meanings(entry) and entry.numbers.size > 1]
        others = listed([escaped(path, 40) for path in unknown], NAMES_LISTED) if unknown else "no other numbers"
        remedy = "a pair needs M D of both cameras and R T between them: name the other file too"
        if unknown:
            remedy = f"name what holds it: --key {lacking[0]}=NAME"
        return refused("missing", file, lacking=" ".join(lacking), others=others, remedy=remedy)

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
        for key, value in (item for keys in tables for item in keys.values.items()):
            if isinstance(value, str) and letters(key).endswith(tuple(words()["marks"]["model"])):
                any_pinhole = letters(value) in ("pinhole", "perspective")
                if not (any_pinhole and letters(key).endswith(("cameramodel", "cameratype"))):
                    return value.strip().lower()
        return ""
