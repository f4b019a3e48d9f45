"""Files of calibrations as trees of tables, lists and numbers: YAML, XML, JSON, TOML, .npz, .npy, .mat, plain rows.

A container is recognised by its content; what programs print is read by `stereo_programs`. Every tree is a `Keys` with
file and lines. OpenCV's matrices stay tables of rows, cols, data. OpenCV's FileStorage has had memory errors on hostile
files (CVE-2019-5063, -5064; opencv #28619): general libraries read the formats instead, with limits on bytes, entries
(aliases expanded) and depth; no entities, no pickles.
"""

from __future__ import annotations

import json
import math
import re
import struct
import subprocess
import sys
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path, PurePath
from typing import Any, NamedTuple
from xml.etree import ElementTree

import cv2
import numpy as np
import yaml

from tvsbayes.errors import InputError, escaped, refusal, shown
from tvsbayes.files.csv_table import NUMBER
from tvsbayes.files.disk import array_of, arrays_of, read_bytes
from tvsbayes.files.documents import Keys, parse_json, parse_toml
from tvsbayes.importing.asking import filled, refused
from tvsbayes.importing.stereo_programs import printed_trees, rigid, words
from tvsbayes.importing.text import text_of

TREE_BYTES_MAX, PRINTED_CHARS_MAX = 4 * 1024 * 1024, 1_000_000
ENTRIES_MAX, DEPTH_MAX, NUMBER_MAX = 200_000, 12, 1e12
FILES_MAX, ARRAY_FILES_MAX = 3, 40
ROTATION_TOLERANCE = 1e-3
"""Largest deviation of R from a rotation, for files of few digits; the nearest rotation is used."""
MAT_SECONDS_MAX = 60.0
_FORMATS = (
    "YAML, XML or JSON of OpenCV, ROS, Kalibr and others, TOML, .npz, .npy, .mat of MATLAB up to version 7, a ZED's "
    "SN*.conf, what rs-enumerate-devices -c prints"
)
_NO_TEXT_REMEDY = "name a calibration file; from Python save the matrices by numpy.savez, not as pickles or pictures"
_LIMITS = f"more than {ENTRIES_MAX} entries, or {DEPTH_MAX} levels", "keep the calibration alone"
_DAMAGE = (ArithmeticError, AttributeError, LookupError, MemoryError, OSError, TypeError, ValueError, struct.error)
_MAT_HEADER_BYTES, _MAT_COMPRESSED = 128, 15
"""MAT-file 5: length of the header, and type of a compressed element (MATLAB MAT-File Format, 1-3, 1-6)."""
_YAML_TAGS = "map opencv-matrix opencv-nd-matrix seq python/tuple str int float bool null timestamp merge value".split()


def read_trees(data: bytes, file: str) -> list[Keys]:
    """Read the top table of a calibration file; several where it contains those of several cameras.

    Raises:
        InputError: too large, unknown, damaged, or above the limits; with file and line.
    """
    if len(data) > TREE_BYTES_MAX:
        found, allowed = f"{len(data)} bytes", f"at most {TREE_BYTES_MAX} bytes"
        raise refusal("size", file=file, found=found, allowed=allowed, remedy="remove what is not needed")
    stem = PurePath(file).stem
    for read in (reader for magic, reader in _BINARY.items() if data.startswith(magic)):
        try:
            values = read(data)
        except (*_DAMAGE, zlib.error) as error:
            found = str(error) if isinstance(error, ValueError) else "a damaged file"
            raise _refused(file, None, found, "write it again with its program") from error
        return [Keys(_plain(values if isinstance(values, dict) else {stem: values}, file), file, "")]
    text = text_of(data, file, _FORMATS, _NO_TEXT_REMEDY).text
    if sum(map(text.count, ",\n[{<")) > ENTRIES_MAX:
        raise _refused(file, None, *_LIMITS)
    try:
        printed = printed_trees(text) if len(text) <= PRINTED_CHARS_MAX else []
    except (ValueError, ArithmeticError) as error:
        found, *remedy = map(str, error.args)
        raise _refused(file, None, found, *remedy or ["take the file as the program wrote it"]) from error
    if printed:
        return [Keys(_plain(values, file), file, text) for values in printed]
    if (rows := _rows(text)) is not None:
        return [Keys(_plain({stem: rows}, file), file, text)]
    if text.lstrip().startswith("<"):
        return [Keys(_plain(_xml(text, file), file), file, "")]
    if re.match(r"\s*\{\s*[\"}]", text):
        return [parse_json(text.encode(), file)]
    if re.match(r"(?:\s|#.*\n)*+(\[[\w.\"-]+\]\s*(#.*)?$|[\w.-]+\s*=)", text, re.MULTILINE):
        return [parse_toml(text.encode(), file)]
    return [Keys(document, file, text) for document in _yaml(text, file)]


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
                raise refused("stereo-folder", escaped(str(path), 200), count=len(inner), most=ARRAY_FILES_MAX)
        files += inner
    trees = [tree for path in files for tree in read_trees(read_bytes(path, TREE_BYTES_MAX), escaped(path.name))]
    if len(trees) > 1:
        arrays = [tree for tree in trees if set(tree.values) == {Path(tree.file).stem}]
        values = {name: value for tree in arrays for name, value in tree.values.items()}
        trees = [tree for tree in trees if tree not in arrays]
        trees += [Keys(values, escaped(files[0].parent.name or "the arrays"), "")] if arrays else []
    if len(trees) > FILES_MAX:
        raise refused("stereo-files", trees[0].file, count=len(trees))
    return trees


def _refused(file: str, line: int | None, found: str, remedy: str = "write it as its own program does") -> InputError:
    return refusal("container", file=file, line=line, found=escaped(found, 120), allowed=_FORMATS, remedy=remedy)


def number(word: str) -> int | float | None:
    """A finite number in a text, else None."""
    if not NUMBER.fullmatch(word) or not math.isfinite(float(word)):
        return None
    return int(word) if re.fullmatch(r"[+-]?[0-9]{1,15}", word) else float(word)


def _plain(value: Any, file: str) -> Any:
    """Values of NumPy, elements of XML and nodes of YAML as tables, lists, numbers and text, within the limits."""
    count = 0

    def plain(value: Any, depth: int) -> Any:
        nonlocal count
        count += 1
        if count > ENTRIES_MAX or depth > DEPTH_MAX or (isinstance(value, np.ndarray) and value.size > ENTRIES_MAX):
            raise _refused(file, None, *_LIMITS)
        if isinstance(value, np.ndarray | np.generic):
            value = value.tolist()
        elif isinstance(value, ElementTree.Element):
            value = _content(value)
        elif isinstance(value, yaml.Node):
            value = _constructed(value, file)
        if isinstance(value, dict):
            return {str(key): plain(item, depth + 1) for key, item in value.items()}
        if isinstance(value, list | tuple):
            return [plain(item, depth + 1) for item in value]
        if isinstance(value, float) and not math.isfinite(value):
            return None
        return value if isinstance(value, int | float | str | bool) else None

    return plain(value, 0)


_MAT_PROGRAM = """
import io, json, sys
from scipy.io import loadmat

values = loadmat(io.BytesIO(sys.stdin.buffer.read()), simplify_cells=True)
values = {key: value for key, value in values.items() if not key.startswith("__")}
json.dump(values, sys.stdout, default=lambda value: value.tolist() if hasattr(value, "tolist") else None)
"""


def _mat(data: bytes) -> dict[str, Any]:
    """Variables of a MAT-file of version 5 (saved by -v6 or -v7); structures become tables.

    `scipy.io.loadmat` ends in a segmentation fault on some damaged files: they are read in a separate process.
    """
    offset, unpacked = _MAT_HEADER_BYTES, 0
    order = "<" if data[126:128] == b"IM" else ">"
    while offset + 8 <= len(data):
        kind, size = struct.unpack_from(f"{order}II", data, offset)
        if kind == _MAT_COMPRESSED:
            packed = data[offset + 8 : offset + 8 + size]
            unpacked += len(zlib.decompressobj().decompress(packed, TREE_BYTES_MAX + 1))
        if unpacked > TREE_BYTES_MAX:
            raise ValueError(f"variables of more than {TREE_BYTES_MAX} bytes")
        offset += 8 + size
    command = [sys.executable, "-I", "-c", _MAT_PROGRAM]
    try:
        result = subprocess.run(command, input=data, capture_output=True, timeout=MAT_SECONDS_MAX, check=True)
    except subprocess.SubprocessError as error:
        raise ValueError("a damaged file, or variables that are no plain matrices and structures") from error
    return dict(json.loads(result.stdout))


def _hdf5(data: bytes) -> dict[str, Any]:
    raise ValueError("an HDF5 file (MATLAB's -v7.3 is one): save it with save(..., '-v7')")


_BINARY: dict[bytes, Callable[[bytes], Any]] = {
    b"PK\x03\x04": lambda data: arrays_of(data, TREE_BYTES_MAX),
    b"\x93NUMPY": lambda data: array_of(data, "the file"),
    b"MATLAB 5.0": _mat,
    b"\x89HDF": _hdf5,
    b"MATLAB 7.3": _hdf5,
}
"""Readers by the first bytes of a file."""


def _rows(text: str) -> list[Any] | None:
    """Rows of numbers, as `numpy.savetxt` writes them; None for any other text, and beyond the limits."""
    if not re.fullmatch(r"(?:[0-9eE+\-.,\s]++|#[^\n]*+)++", text) or text.count(" ") > ENTRIES_MAX:
        return None
    rows = [line.split("#")[0].replace(",", " ").split() for line in text.splitlines()]
    numbers = [[number(word) for word in row] for row in rows if row]
    return None if not numbers or any(None in row for row in numbers) else numbers


def _xml(text: str, file: str) -> ElementTree.Element | dict[str, Any]:
    """The root of a document without document type and entities; a table of it where it has no children."""
    if "<!" in re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL):
        raise _refused(file, None, "a document type or entity")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise _refused(file, getattr(error, "position", (None,))[0], str(error)) from error
    for tags in ([child.tag for child in element] for element in root.iter() if root.tag == "opencv_storage"):
        if twice := [tag for tag, times in Counter(tags).items() if times > 1 and tags != ["_"] * times]:
            raise _refused(file, None, f"{shown(twice[0])} twice", "remove one of them")
    return root if isinstance(_content(root), dict) else {root.tag: root}


def _content(element: ElementTree.Element) -> Any:
    """Attributes and children by name, several of one name as a list; words that are numbers as numbers."""
    if len(element) and all(child.tag == "_" for child in element):
        return list(element)
    stated = {key: _word(text) for key, text in element.attrib.items() if key != "type_id"}
    if not len(element):
        value = _word(element.text or "", listed=element.tag == "data")
        return {**stated, "value": value} if stated else value
    children: dict[str, list[ElementTree.Element]] = {}
    for child in element:
        children.setdefault(child.tag, []).append(child)
    return stated | {tag: items if len(items) > 1 else items[0] for tag, items in children.items()}


def _word(text: str, listed: bool = False) -> Any:
    """Numbers of a text, a single one alone unless `listed`; or the text."""
    numbers = [number(word) for word in text.split()]
    if not numbers or None in numbers:
        return text.strip().strip('"')
    return numbers if len(numbers) > 1 or listed else numbers[0]


def _yaml(text: str, file: str) -> list[dict[str, Any]]:
    """The tables in documents of YAML; those that differ only in their headers, as repeated messages, count once."""
    # OpenCV's header is not a YAML directive; what mrcal packs of its corners is no YAML.
    body = re.sub(r"\A%YAML[^\n]*\n", "\n", text)
    body = re.sub(r"'optimization_inputs':\s*b'[^']*',?", lambda match: "\n" * match.group().count("\n"), body)
    loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    depth = 0
    try:
        # The composer is recursive: depth is limited before it.
        for event in yaml.parse(body, loader):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > DEPTH_MAX:
                raise _refused(file, event.start_mark.line + 1, *_LIMITS)
        documents = [_plain(node, file) for node in yaml.compose_all(body, loader)]
    except (yaml.YAMLError, ValueError) as error:
        mark, problem = (getattr(error, name, None) for name in ("problem_mark", "problem"))
        raise _refused(file, None if mark is None else mark.line + 1, str(problem or error)) from error
    tables: list[dict[str, Any]] = []
    # Separators of ROS' dumps start empty documents.
    for document in filter(None, documents):
        if not isinstance(document, dict):
            raise _refused(file, 1, shown(document), "name a calibration file")
        table = {key: value for key, value in document.items() if key != "header"}
        if table and table not in tables:
            tables.append(table)
    if not tables:
        raise _refused(file, 1, "nothing", "name a calibration file")
    return tables


def _constructed(node: yaml.Node, file: str) -> Any:
    """One level of YAML without duplicate keys, numbers as OpenCV, ROS and Kalibr write them (`1.`, `2e-05`)."""
    line, tag = node.start_mark.line + 1, node.tag.removeprefix("tag:yaml.org,2002:")
    if tag not in _YAML_TAGS:
        remedy = "save lists, M.tolist(), or the matrices by numpy.savez" if "python/" in tag else "remove the tag"
        raise _refused(file, line, f"the tag {shown(tag)}", remedy)
    if isinstance(node, yaml.ScalarNode):
        value = None if node.style in ("'", '"', "|", ">") else number(node.value)
        return node.value if value is None else value
    if not isinstance(node, yaml.MappingNode):
        return node.value
    table: dict[str, yaml.Node] = {}
    for key, item in node.value:
        if str(key.value) in table:
            raise _refused(file, key.start_mark.line + 1, f"{shown(str(key.value))} twice", "remove one of them")
        table[str(key.value)] = item
    return table


class Entry(NamedTuple):
    """Numbers of a file, flat and by shape: the tables around them from the top of the file, and their name there."""

    tables: tuple[Keys, ...]
    key: str
    numbers: np.ndarray
    shape: tuple[int, ...]

    @property
    def path(self) -> str:
        """Dotted path, as users name it."""
        return ".".join((*self.tables[-1].path, self.key))

    @property
    def place(self) -> str:
        """Key and file, in words."""
        return f"{escaped(self.path, 80)} of {self.tables[0].file}"

    def refuse(self, what: str, **values: Any) -> InputError:
        """The refusal of these numbers."""
        text = filled(f"stereo-{what}", values)
        return self.tables[-1].refuse(self.key, text["code"], text["allowed"], text["remedy"], text["found"])

    def rotation(self, numbers: np.ndarray | None = None) -> np.ndarray:
        """The rotation (3, 3): nearest to a matrix of nine numbers, or from Rodrigues' three."""
        numbers = self.numbers if numbers is None else numbers
        if numbers.size == 3:
            if np.linalg.norm(numbers) > math.pi:
                raise self.refuse("degrees", found=escaped(str(numbers.tolist()), 60))
            return cv2.Rodrigues(numbers)[0]
        matrix = numbers.reshape(3, 3)
        deviation = max(
            np.abs(matrix @ matrix.T - np.eye(3)).max(), abs(np.cross(matrix[0], matrix[1]) @ matrix[2] - 1.0)
        )
        if not deviation <= ROTATION_TOLERANCE:
            raise self.refuse("no-rotation", found=deviation, tolerance=ROTATION_TOLERANCE)
        u, _, vt = np.linalg.svd(matrix)
        return u @ vt

    def pose(self) -> np.ndarray:
        """The homogeneous transformation (4, 4) of 12 or 16 numbers."""
        rows = self.numbers[:12].reshape(3, 4)
        return rigid(self.rotation(rows[:, :3]), rows[:, 3])


def letters(name: str) -> str:
    """A name as it is looked up."""
    return re.sub(r"[^a-z0-9]", "", name.lower())


def _numbers(value: Any) -> np.ndarray | None:
    """Finite numbers, in their shape, of a number, nested lists or OpenCV's or ROS' rows, cols, data; else None."""
    if isinstance(value, dict):
        rows, columns, data = (value.get(name, value.get(name.title())) for name in ("rows", "cols", "data"))
        numbers = _numbers(data)
        if numbers is not None and "sizes" in value:
            return numbers.ravel()
        if numbers is not None and isinstance(rows, int) and isinstance(columns, int):
            # In an untrusted file both may be negative.
            return numbers.reshape(abs(rows), abs(columns)) if rows * columns == numbers.size else None
        if {"x", "y", "z"} <= set(value) <= {"x", "y", "z", "rotation"}:
            # BoofCV states the rotation of a pose in the same table as its shift.
            shift, turn = _numbers([value[axis] for axis in "xyz"]), _numbers(value.get("rotation"))
            if shift is None or turn is None or turn.size != 9:
                return shift
            return np.column_stack([turn.reshape(3, 3), shift])
        return None
    if isinstance(value, bool) or not isinstance(value, int | float | list):
        return None
    try:
        numbers = np.array(value, dtype=float)
    except (ValueError, TypeError, OverflowError):
        return None
    return numbers if numbers.size and (np.abs(numbers) <= NUMBER_MAX).all() else None


def entries_of(tables: tuple[Keys, ...]) -> Iterator[Entry]:
    """All entries with numbers, in the order of the file; lists that are no numbers as empty ones."""
    keys = tables[-1]
    for key, value in keys.values.items():
        numbers = _numbers(value)
        nothing = Entry(tables, key, np.empty(0), (0,))
        if numbers is not None:
            yield Entry(tables, key, numbers.ravel(), numbers.shape)
        elif isinstance(value, dict):
            if {"rows", "cols", "data"} <= {name.lower() for name in value}:
                raise nothing.refuse("not-finite")
            yield from entries_of((*tables, keys.table(key)))
        elif isinstance(value, list) and value and all(isinstance(item, dict) for item in value):
            for number, item in enumerate(value):
                yield from entries_of((*tables, Keys(item, keys.file, keys.content, (*keys.path, key, str(number)))))
        elif isinstance(value, list):
            yield nothing
        elif isinstance(value, str):
            width, height = (words()["fields"][field]["names"].split() for field in ("width", "height"))
            if letters(key) in (*width, *height):
                raise nothing.refuse("pixel-text", found=shown(value))
