"""Rows of studies, one simulated and fitted campaign each, in a file of JSON lines.

Headlines in deg/step, deg and mm, the target in its unit, seconds of computing. A row is identified by its design, the
hash of all its inputs, and the number of its campaign; its line ends with the hash of all that it says.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import msgspec

from tvsbayes.errors import InputError, escaped, refusal
from tvsbayes.files.disk import read_bytes
from tvsbayes.results.records import plain

STUDY_FORMAT = "tvsbayes-study/1"
ROWS_BYTES_MAX = 128 * 1024 * 1024
_LINE_BEGINS = b'{"format": "tvsbayes-study/'
"""Beginning of every line in all versions, before a part that may be torn."""


@dataclass(frozen=True)
class HeadlineRow:
    """Result of one headline in one campaign.

    Attributes:
        truth: true value.
        value: estimate.
        sd: its reported standard deviation.
        interval95: reported 95 % interval.
        pit: weight of the estimator's draws below the truth.
        predicted_sd: sd predicted by the planner at that truth.
    """

    truth: float
    value: float
    sd: float
    interval95: tuple[float, float]
    pit: float
    predicted_sd: float


@dataclass(frozen=True)
class StudyRow:
    """One campaign of a study; a fit that failed has no headlines.

    Attributes:
        design: hash of its design.
        index: number of the campaign.
        seed: seed of the campaign.
        converged: whether the fit and its sampling converged.
        unseen: looks without a spot.
        problems: problems of the fit, in words.
        seconds: time of simulation and fit.
        headlines: results by name.
        target: reported value of the target, None where the fit has none.
        estimator: "importance" or "laplace", which is that of rows without this entry.
    """

    design: str
    index: int
    seed: int
    converged: bool
    unseen: int
    problems: tuple[str, ...]
    seconds: float
    headlines: dict[str, HeadlineRow] = field(default_factory=dict)
    target: float | None = None
    estimator: str = "laplace"

    def as_json(self) -> dict[str, object]:
        """Return its line in a file of rows, without the format."""
        absent = () if self.headlines else ("headlines", "target")
        return {name: value for name, value in plain(self).items() if name not in absent}

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> StudyRow:
        """Build the row of a line.

        Raises:
            msgspec.ValidationError: the document has another structure.
        """
        return msgspec.convert(document, cls)


class StudyRows:
    """Rows of studies in a file of JSON lines: appended one by one, each on disk before the next.

    A process that is killed while it writes leaves a torn last line, which is removed before the next row is added.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        data = read_bytes(self.path, ROWS_BYTES_MAX) if self.path.exists() else b""
        whole = data[: data.rfind(b"\n") + 1]
        self.rows: dict[tuple[str, int], StudyRow] = {}
        self._damaged: dict[int, tuple[str, int]] = {}
        for number, line in enumerate(whole.splitlines(), 1):
            self._take(line, number)
        self.torn, self._size = len(data) - len(whole), len(data)
        # Without a complete row the file may not be a study's; its unterminated line must not be removed as torn.
        if not whole and not (data.startswith(_LINE_BEGINS) or _LINE_BEGINS.startswith(data)):
            raise self._no_row(1)
        self._try()

    def _try(self) -> None:
        """Refuse a file that cannot be written before the first campaign is fitted; the test leaves no file."""
        try:
            if self.path.exists():
                self.path.open("ab").close()
            else:
                tempfile.TemporaryFile(dir=self.path.parent).close()
        except OSError as error:
            raise self._unwritable(escaped(error.strerror or str(error))) from error

    def _unwritable(self, found: str) -> InputError:
        allowed, remedy = "a file that can be written", "name another with --rows"
        return refusal("write", file=escaped(str(self.path), 200), found=found, allowed=allowed, remedy=remedy)

    @contextmanager
    def _open(self) -> Iterator[BinaryIO]:
        """Open the file for appending whole lines, even if others write to it; it is created where missing."""
        try:
            with self.path.open("ab") as file:
                yield file
        except OSError as error:
            raise self._unwritable(escaped(error.strerror or str(error))) from error

    def _take(self, line: bytes, number: int) -> None:
        """Read a row; one that does not say what was written counts as damaged."""
        try:
            document = json.loads(line)
            if document["format"] != STUDY_FORMAT:
                raise self._no_row(number)
            stated, row = document.pop("sha256", ""), StudyRow.from_json(document)
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError, msgspec.ValidationError) as error:
            raise self._no_row(number) from error
        key = row.design, row.index
        if stated == _digest(document):
            self.rows[key] = row
        else:
            self._damaged[number] = key

    def damaged(self, design: str) -> list[int]:
        """Return lines of a design that are not as they were written, and whose campaigns have no other row."""
        return [line for line, key in self._damaged.items() if key[0] == design and key not in self.rows]

    def _no_row(self, number: int) -> InputError:
        return InputError(
            "study-row",
            f"{escaped(self.path.name)} line {number} is no row of a study",
            file=escaped(self.path.name),
            line=number,
            allowed=f"lines written by `tvsbayes study` ({STUDY_FORMAT})",
            remedy="name another file with --rows",
        )

    def of(self, design: str) -> dict[int, StudyRow]:
        """Return rows of one design by index."""
        return {index: row for (key, index), row in self.rows.items() if key == design}

    def append(self, row: StudyRow) -> None:
        """Add a row and wait until it is on disk."""
        document = {"format": STUDY_FORMAT, **row.as_json()}
        line = json.dumps({**document, "sha256": _digest(document)}, allow_nan=False).encode() + b"\n"
        with self._open() as file:
            # If the file size has changed, its last line was not torn but that of a second study.
            if self.torn and self.path.stat().st_size == self._size:
                file.truncate(self._size - self.torn)
            self.torn = 0
            file.write(line)
            file.flush()
            os.fsync(file.fileno())
        self.rows[row.design, row.index] = row


def _digest(document: Mapping[str, object]) -> str:
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()
