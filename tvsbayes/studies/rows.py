"""Rows of studies: one simulated and fitted campaign each, kept in a file of JSON lines.

Headlines in deg/step, deg and mm, the target in its own unit, seconds of computing. A row belongs to a design, the hash
of everything that decides it, and to the number of its campaign.
"""

from __future__ import annotations

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
"""As every line of every edition does, before what may be torn."""


@dataclass(frozen=True)
class HeadlineRow:
    """How one headline fared in one campaign.

    Attributes:
        truth: true value.
        value: estimate.
        sd: its reported standard deviation.
        interval95: as reported.
        pit: weight of the estimator's draws below the truth.
        predicted_sd: what the planner predicted at that truth.
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
        design: hash of what it belongs to.
        index: number of the campaign.
        seed: of the campaign.
        converged: the fit ended well, and so did its sampling.
        unseen: looks without a spot.
        problems: of the fit, in words.
        seconds: simulation and fit.
        headlines: by name.
        target: reported value of the target, None where the fit has none.
        estimator: "importance" or "laplace", which rows without the word are of.
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
        """Its line in a file of rows, less the format."""
        absent = () if self.headlines else ("headlines", "target")
        return {name: value for name, value in plain(self).items() if name not in absent}

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> StudyRow:
        """The row of a line.

        Raises:
            msgspec.ValidationError: a document of another shape.
        """
        return msgspec.convert(document, cls)


class StudyRows:
    """Rows of studies in a file of JSON lines: appended one by one, each on disk before the next.

    A process that is killed while it writes leaves a torn last line; it is cut off before the next row is added.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        data = read_bytes(self.path, ROWS_BYTES_MAX) if self.path.exists() else b""
        whole = data[: data.rfind(b"\n") + 1]
        rows = (self._row(line, number) for number, line in enumerate(whole.splitlines(), 1))
        self.rows = {(row.design, row.index): row for row in rows}
        self.torn, self._size = len(data) - len(whole), len(data)
        # Of a file without one whole row: else somebody's only line, which never ended, would be cut off as torn.
        if not whole and not (data.startswith(_LINE_BEGINS) or _LINE_BEGINS.startswith(data)):
            raise self._no_row(1)
        self._try()

    def _try(self) -> None:
        """Refuse a file that cannot be written, before the first campaign is fitted; nothing is left of the trial."""
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
        """The file, for whole lines at its end, no matter who else writes there; made where there is none."""
        try:
            with self.path.open("ab") as file:
                yield file
        except OSError as error:
            raise self._unwritable(escaped(error.strerror or str(error))) from error

    def _row(self, line: bytes, number: int) -> StudyRow:
        try:
            document = json.loads(line)
            if document["format"] == STUDY_FORMAT:
                return StudyRow.from_json(document)
        except (ValueError, KeyError, TypeError, RecursionError, msgspec.ValidationError):
            pass
        raise self._no_row(number)

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
        """Rows of one design by index."""
        return {index: row for (key, index), row in self.rows.items() if key == design}

    def append(self, row: StudyRow) -> None:
        """Add a row and wait until the disk has it."""
        line = json.dumps({"format": STUDY_FORMAT, **row.as_json()}, allow_nan=False).encode() + b"\n"
        with self._open() as file:
            # Where the file has another size, its last line was no torn one but that of a second study.
            if self.torn and self.path.stat().st_size == self._size:
                file.truncate(self._size - self.torn)
            self.torn = 0
            file.write(line)
            file.flush()
            os.fsync(file.fileno())
        self.rows[row.design, row.index] = row
