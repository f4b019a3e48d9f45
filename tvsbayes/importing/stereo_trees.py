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
from collections.abc import Callable, Iterable
from pathlib import PurePath
from typing import Any

import numpy as np

from tvsbayes.errors import InputError, escaped, refusal, shown
from tvsbayes.files.csv_table import NUMBER
from tvsbayes.files.disk import array_of, arrays_of
from tvsbayes.files.documents import Keys, parse_json, parse_toml
from tvsbayes.importing.stereo_programs import printed_trees
from tvsbayes.importing.text import text_of

PACKED = struct.error, zlib.error
TREE_BYTES_MAX = 4 * 1024 * 1024
ENTRIES_MAX, PRINTED_CHARS_MAX = 200_000, 1_000_000
DEPTH_MAX = 12
LIMITS_TEXT, TRIM_REMEDY = f"more than {ENTRIES_MAX} entries, or {DEPTH_MAX} levels", "keep the calibration alone"
_FORMATS_TEXT = (
    "YAML, XML or JSON of OpenCV, ROS, Kalibr and others, TOML, .npz, .npy, .mat of MATLAB up to version 7, a ZED's "
    "SN*.conf, what rs-enumerate-devices -c prints"
)
REWRITE_REMEDY = "write it as its own program does"
_TEXT_REMEDY = "name a calibration file; from Python save the matrices by numpy.savez, not as pickles or pictures"
MAT_SECONDS_MAX = 60.0
_DAMAGE = ArithmeticError, AttributeError, LookupError, MemoryError, OSError, TypeError, ValueError, *PACKED
_MAT_HEADER_BYTES, _MAT_COMPRESSED = 128, 15
"""MAT-file 5: length of the header, and type of a compressed element (MATLAB MAT-File Format, 1-3, 1-6)."""


def read_trees(data: bytes, file: str) -> list[Keys]:
    """Read the top table of a calibration file; several where it contains those of several cameras.

    Raises:
        InputError: too large, unknown, damaged, or above the limits; with file and line.
    """
    if len(data) > TREE_BYTES_MAX:
        found, allowed = f"{len(data)} bytes", f"at most {TREE_BYTES_MAX} bytes"
        raise refusal("size", file=file, found=found, allowed=allowed, remedy="remove what is not needed")
    for magic, reader in _BINARY.items():
        if data.startswith(magic):
            try:
                values = reader(data)
            except _DAMAGE as error:
                found = str(error) if isinstance(error, ValueError) else "a damaged file"
                raise container_error(file, None, found, "write it again with its program") from error
            values = values if isinstance(values, dict) else {PurePath(file).stem: values}
            return [Keys(_plain(values, file), file, "")]
    text = text_of(data, file, _FORMATS_TEXT, _TEXT_REMEDY).text
    try:
        printed = printed_trees(text) if len(text) <= PRINTED_CHARS_MAX else []
    except (ValueError, ArithmeticError) as error:
        found, *remedy = map(str, error.args)
        raise container_error(file, None, found, *remedy or ["take the file as the program wrote it"]) from error
    if printed:
        return [Keys(_plain(values, file), file, text) for values in printed]
    if (rows := _rows(text)) is not None:
        return [Keys(_plain({PurePath(file).stem: rows}, file), file, text)]
    if text.lstrip().startswith("<"):
        return [Keys(_plain(_xml(text, file), file), file, "")]
    if re.match(r"\s*\{\s*[\"}]", text):
        if text.count(",") > ENTRIES_MAX:
            raise container_error(file, None, LIMITS_TEXT, TRIM_REMEDY)
        return [parse_json(text.encode(), file)]
    if re.match(r"(?:\s|#.*\n)*+(\[[\w.\"-]+\]\s*(#.*)?$|[\w.-]+\s*=)", text, re.MULTILINE):
        return [parse_toml(text.encode(), file)]
    return [Keys(_plain(document, file), file, text) for document in _yaml(text, file)]


def container_error(file: str, line: int | None, found: str, remedy: str = REWRITE_REMEDY) -> InputError:
    """The refusal of a container."""
    return refusal("container", file=file, line=line, found=escaped(found, 120), allowed=_FORMATS_TEXT, remedy=remedy)


def _plain(value: Any, file: str) -> Any:
    """Reduce a value to tables, lists, numbers and text, within the limits."""
    count = 0

    def plain(value: Any, depth: int) -> Any:
        nonlocal count
        count += 1
        if count > ENTRIES_MAX or depth > DEPTH_MAX:
            raise container_error(file, None, LIMITS_TEXT, TRIM_REMEDY)
        if isinstance(value, dict):
            return {str(key): plain(item, depth + 1) for key, item in value.items()}
        if isinstance(value, list | tuple):
            return [plain(item, depth + 1) for item in value]
        if isinstance(value, np.ndarray | np.generic):
            if value.size > ENTRIES_MAX:
                raise container_error(file, None, f"an array of {value.size} numbers", TRIM_REMEDY)
            return plain(value.tolist(), depth)
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
        kind, size = struct.unpack(f"{order}II", data[offset : offset + 8])
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
    variables = json.loads(result.stdout)
    return variables if isinstance(variables, dict) else {}


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
    if not re.fullmatch(r"(?:[0-9eE+\-.,\s]++|#[^\n]*+)++", text) or sum(map(text.count, ", \n")) > ENTRIES_MAX:
        return None
    rows = [line.split("#")[0].replace(",", " ").split() for line in text.splitlines()]
    numbers = [[number(word) for word in row] for row in rows if row]
    return None if not numbers or any(None in row for row in numbers) else numbers


def _xml(text: str, file: str) -> dict[str, Any]:
    """Elements by name with their attributes; several of one name as a list; words that are numbers as numbers."""
    from xml.etree import ElementTree

    if "<!" in re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL):
        raise container_error(file, None, "a document type or entity")
    if text.count("<") > ENTRIES_MAX:
        raise container_error(file, None, LIMITS_TEXT, TRIM_REMEDY)
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        line = getattr(error, "position", (None,))[0]
        raise container_error(file, line, str(error)) from error

    def value(element: Any, depth: int) -> Any:
        if depth > DEPTH_MAX:
            raise container_error(file, None, f"elements nested deeper than {DEPTH_MAX}")
        stated = {key: _word(text) for key, text in element.attrib.items() if key != "type_id"}
        if len(element) or stated:
            if len(element) and all(child.tag == "_" for child in element):
                return [value(child, depth + 1) for child in element]
            found: dict[str, list[Any]] = {}
            for child in element:
                found.setdefault(child.tag, []).append(value(child, depth + 1))
            if root.tag == "opencv_storage" and (twice := [tag for tag, items in found.items() if len(items) > 1]):
                raise container_error(file, None, f"{shown(twice[0])} twice", "remove one of them")
            inner = {tag: items[0] if len(items) == 1 else items for tag, items in found.items()}
            return stated | inner | ({} if len(element) else {"value": _word(element.text or "")})
        return _word(element.text or "", listed=element.tag == "data")

    content = value(root, 0)
    return content if isinstance(content, dict) else {root.tag: content}


def _word(text: str, listed: bool = False) -> Any:
    """Numbers of a text, a single one alone unless `listed`; or the text."""
    numbers = [number(word) for word in text.split()]
    if not numbers or None in numbers:
        return text.strip().strip('"')
    return numbers if len(numbers) > 1 or listed else numbers[0]


def number(word: str) -> int | float | None:
    """A finite number in a text, else None."""
    if not NUMBER.fullmatch(word) or not math.isfinite(float(word)):
        return None
    return int(word) if re.fullmatch(r"[+-]?[0-9]{1,15}", word) else float(word)


def _yaml(text: str, file: str) -> list[dict[str, Any]]:
    """The documents of YAML, by PyYAML's safe loader, which does not know the tags of OpenCV.

    Repeated messages of one camera, which differ only in their headers, are left out.
    """
    import yaml

    class Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
        """Refuses duplicate keys; reads numbers as OpenCV, ROS and Kalibr write them (`1.`, `2e-05`)."""

    def mapping(loader: Any, node: Any) -> dict[str, Any]:
        keys = [str(key.value) for key, _ in node.value]
        for k, key in enumerate(keys):
            if key in keys[:k]:
                line = node.value[k][0].start_mark.line + 1
                raise container_error(file, line, f"{shown(key)} twice", "remove one of them")
        return {key: loader.construct_object(part, deep=True) for key, (_, part) in zip(keys, node.value, strict=True)}

    def scalar(loader: Any, node: Any) -> Any:
        found = None if node.style in ("'", '"', "|", ">") else number(node.value)
        return node.value if found is None else found

    sequence, tag = yaml.SafeLoader.construct_yaml_seq, "tag:yaml.org,2002:"
    Loader.yaml_constructors = {None: yaml.SafeLoader.construct_undefined}
    for kinds, constructor in (
        ("map opencv-matrix opencv-nd-matrix", mapping),
        ("str int float bool null timestamp merge value", scalar),
        ("seq python/tuple", sequence),
    ):
        Loader.yaml_constructors |= {f"{tag}{kind}": constructor for kind in kinds.split()}
    # OpenCV's header is not a YAML directive; what mrcal packs of its corners is no YAML.
    body = re.sub(r"\A%YAML[^\n]*\n", "\n", text)
    body = re.sub(r"'optimization_inputs':\s*b'[^']*',?", lambda match: "\n" * match.group().count("\n"), body)
    try:
        _check_limits(yaml.parse(body, Loader=Loader), file)
        documents = list(yaml.load_all(body, Loader=Loader))
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        problem = getattr(error, "problem", None) or str(error)
        remedy = "save lists, M.tolist(), or the matrices by numpy.savez" if "python/" in problem else REWRITE_REMEDY
        raise container_error(file, None if mark is None else mark.line + 1, str(problem), remedy) from error
    except (RecursionError, ValueError) as error:
        raise container_error(file, None, "YAML that is nested too deeply") from error
    distinct: list[dict[str, Any]] = []
    for document in documents:
        # Separators of ROS' dumps start empty documents.
        if document and not isinstance(document, dict):
            raise container_error(file, 1, shown(document), "name a calibration file")
        plain = {key: value for key, value in (document or {}).items() if key != "header"}
        if plain and plain not in distinct:
            distinct.append(plain)
    if not distinct:
        raise container_error(file, 1, "nothing", "name a calibration file")
    return distinct


def _check_limits(events: Iterable[Any], file: str) -> None:
    """Check depth and number of entries before any object is built; `_plain` counts expanded aliases."""
    depth = count = 0
    for event in events:
        name, line = type(event).__name__, event.start_mark.line + 1
        count += 1
        depth += name.endswith("StartEvent") - name.endswith("EndEvent")
        if depth > DEPTH_MAX or count > ENTRIES_MAX:
            raise container_error(file, line, LIMITS_TEXT, TRIM_REMEDY)
