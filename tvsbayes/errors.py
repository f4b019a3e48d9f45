"""Errors and warnings for the user: error classes with their exit codes, and text that is safe to quote.

An error states the place, the value found, the allowed values and the remedy; text from files is escaped when shown.
"""

from __future__ import annotations

import difflib
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import NamedTuple


class TvsError(Exception):
    """An error that the user can correct; the command line turns it into an exit code.

    Attributes:
        code: short stable identifier, e.g. "number", "unknown-key".
        exit_code: exit code of the process.
        file: name of the file as the user gave it, or None.
        line: line number, 1-based, or None.
        column: name of the column or dotted key, or None.
        found: the value found, shortened, control characters escaped.
        allowed: the allowed values.
        remedy: what the user can do now.
    """

    exit_code = 1

    def __init__(
        self,
        code: str,
        message: str,
        *,
        file: str | None = None,
        line: int | None = None,
        column: str | None = None,
        found: str | None = None,
        allowed: str | None = None,
        remedy: str | None = None,
    ):
        super().__init__(message)
        self.code = code
        self.message = message
        self.file = file
        self.line = line
        self.column = column
        self.found = found
        self.allowed = allowed
        self.remedy = remedy

    def __reduce__(self):
        # Pickle passes positional arguments alone; a worker process of a pool must return the complete error.
        named = ("file", "line", "column", "found", "allowed", "remedy")
        return partial(type(self), **{name: getattr(self, name) for name in named}), (self.code, self.message)


class Reason(NamedTuple):
    """Why something is refused, and what to do about it, in words."""

    reason: str
    remedy: str


class InputError(TvsError):
    """A file, option or value that cannot be used as it is (exit 2)."""

    exit_code = 2


class Candidate(NamedTuple):
    """An answer to a question: what it says, the options that say it, and first values of the columns it is about."""

    says: str
    options: tuple[str, ...]
    first: Mapping[str, Sequence[str]] = {}


class Question(InputError):
    """Input that can be read in several ways; each candidate's options say which (exit 2).

    Attributes:
        candidates: the answers.
        commands: the complete command line of each, once the command that met the question has stated its own.
    """

    def __init__(self, code: str, message: str, *, candidates: Sequence[Candidate] = (), **place):
        super().__init__(code, message, **place)
        self.candidates = tuple(candidates)
        self.commands: tuple[str, ...] = ()

    def __reduce__(self):
        make, arguments = super().__reduce__()
        return partial(make, candidates=self.candidates), arguments

    def asked_by(self, command: Sequence[str]) -> Question:
        """The question with the command line of each answer; `command` is the one that met it, word by word."""
        lines = [" ".join(map(typed, (*command, *candidate.options))) for candidate in self.candidates]
        answers = [f"{c.says}: `{line}`" for c, line in zip(self.candidates, lines, strict=True)]
        remedy = f"say which; {'; '.join(answers)}"
        place = {name: getattr(self, name) for name in ("file", "line", "column", "found", "allowed")}
        asked = Question(self.code, f"{self.message}; {remedy}", candidates=self.candidates, remedy=remedy, **place)
        asked.commands = tuple(lines)
        return asked


def question(
    *,
    file: str,
    found: str,
    allowed: str,
    candidates: Sequence[Candidate],
    line: int | None = None,
    column: str | None = None,
    code: str = "ambiguous",
) -> Question:
    """Build the `Question` whose message states the place, what was found and what is allowed."""
    where = file + (f" line {line}" if line else "") + (f", {escaped(column)}" if column else "")
    message = f"{where}: found {found}; allowed: {allowed}"
    place = {"file": file, "line": line, "column": column, "found": found, "allowed": allowed}
    return Question(code, message, candidates=candidates, **place)


class NothingToEstimate(TvsError):
    """The data are readable but contain nothing from which to estimate (exit 3)."""

    exit_code = 3


MISFIT_REMEDY = (
    "see what `tvsbayes check` warns of: a camera that was knocked, rows shifted by one, counters; without warnings "
    "check for swapped cameras, or state the extrinsics better in [rig.prior]"
)
"""Remedy where no beam of the model passes the spots."""


class NotConverged(TvsError):
    """An estimator did not reach its convergence criterion (exit 4)."""

    exit_code = 4

    @classmethod
    def of(cls, problems: Iterable[str], remedy: str) -> NotConverged:
        """The error of a fit that ended with these problems, in sentences."""
        return cls("not-converged", "NOT CONVERGED: " + "; ".join(problems), remedy=remedy)


class DeviceFault(TvsError):
    """The positioner, a camera or the disk failed while an instrument was in use (exit 5)."""

    exit_code = 5


def fault(code: str, found: str, remedy: str) -> DeviceFault:
    """Build the `DeviceFault` whose message states the fault and the remedy."""
    return DeviceFault(code, f"{found}; {remedy}", found=found, remedy=remedy)


INTEGER = re.compile(r"[+-]?[0-9]{1,18}")
CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]")


def plural(count: int, noun: str) -> str:
    """A count with its noun."""
    return f"{count} {noun}{'s' * (count != 1)}"


def escaped(text: str, limit: int = 60) -> str:
    """Make text from a file fit to print: escape characters that are not printable, cut long text."""
    cut = text if len(text) <= limit else text[:limit] + "..."
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in cut)


def shown(value: object) -> str:
    """Format a value as an error message quotes it."""
    if isinstance(value, str):
        return f'"{escaped(value)}"'
    if isinstance(value, dict):
        return "a table with " + (escaped(", ".join(map(str, value))) or "no keys")
    if isinstance(value, list):
        return f"a list of {len(value)}"
    if isinstance(value, bool):
        return str(value).lower()
    # Python refuses to print an integer beyond its limit of digits.
    huge = isinstance(value, int) and abs(value) >= 10**60
    return "an integer of more than 60 digits" if huge else escaped(str(value))


def refusal(
    code: str, *, file: str, found: str, allowed: str, remedy: str, line: int | None = None, column: str | None = None
) -> InputError:
    """Build the `InputError` whose message states the place, the value found, the allowed values and the remedy."""
    where = file + (f" line {line}" if line else "") + (f", {escaped(column)}" if column else "")
    message = f"{where}: found {found}; allowed: {allowed}; {remedy}"
    return InputError(code, message, file=file, line=line, column=column, found=found, allowed=allowed, remedy=remedy)


def entry_refusal(code: str, table: str, key: str, found: str, allowed: str, remedy: str) -> InputError:
    """Build the `InputError` of an entry in a table of the rig file."""
    message = f"[{table}] {key}: found {found}; allowed: {allowed}; {remedy}"
    return InputError(code, message, column=f"{table}.{key}", found=found, allowed=allowed, remedy=remedy)


def all_of(refused: Sequence[InputError], most: int = 5) -> InputError:
    """Join the errors of several files, so that one run reports them all: the first in full, the others by name."""
    first, others = refused[0], [error.file or error.message for error in refused[1:]]
    if not others:
        return first
    names = ", ".join(escaped(name, 200) for name in others[:most])
    more = f" and {len(others) - most} more" if len(others) > most else ""
    message = f"{first.message}; likewise {names}{more}"
    fields = ("file", "line", "column", "found", "allowed", "remedy")
    return InputError(first.code, message, **{name: getattr(first, name) for name in fields})


def require_kind(given: object, has: str, wanted: str) -> None:
    """Refuse an argument of another type, recognised by a missing attribute, before it fails deep in the code.

    Raises:
        TypeError: the argument lacks the attribute; states its type and the source of the right one.
    """
    if not hasattr(given, has):
        raise TypeError(f"found {type(given).__name__}; wanted {wanted}")


CLOSE = 0.6
"""Similarity (difflib) from which a word counts as a misspelling of another: "comment" and "point" have 0.5."""


def closest(name: str, names: Iterable[str], otherwise: str = "remove it, or correct the spelling") -> str:
    """The remedy for an unknown name: the nearest allowed name, where one is near."""
    near = difflib.get_close_matches(name[:100], list(names), n=1, cutoff=CLOSE)
    return f"did you mean {near[0]}?" if near else otherwise


def typed(word: object, limit: int = 200) -> str:
    """Quote a path or another word for a command that the user is asked to type, where a shell needs it."""
    return shlex.quote(escaped(str(word), limit))


def listed(numbers: Sequence[object], most: int) -> str:
    """List the first numbers, and how many more there are."""
    more = f" and {len(numbers) - most} more" if len(numbers) > most else ""
    return ", ".join(map(str, numbers[:most])) + more


def other_format(found: str, allowed: Iterable[str]) -> str | None:
    """The remedy for a file of another kind or version of this package's formats; None for any other file."""
    kind, _, number = found[:100].rpartition("/")
    known = {name.rpartition("/")[0] for name in allowed}
    if not (kind.startswith("tvsbayes-") and number.isdecimal()):
        return None
    if kind in known:
        return "another version of tvsbayes wrote it: use that one, or make the file again"
    return f"this is a {escaped(kind)} file: name a {' or '.join(sorted(known))} file"
