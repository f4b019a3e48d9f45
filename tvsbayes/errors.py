"""What a user did wrong or must know: error classes with their exit codes, and text that is safe to quote.

An error says where, what was found, what is allowed and what to do; text from files is escaped before it is shown.
"""

from __future__ import annotations

import difflib
import re
import shlex
from collections.abc import Iterable, Sequence
from functools import partial


class TvsError(Exception):
    """An error that a user can act on; the command line turns it into an exit code.

    Attributes:
        code: short stable identifier, e.g. "number", "unknown-key".
        exit_code: what the process returns.
        file: name of the file as the user knows it, or None.
        line: line number, 1-based, or None.
        column: name of the column or dotted key, or None.
        found: what stood there, shortened, control characters escaped.
        allowed: what may stand there.
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
        # Exceptions are pickled by their positional arguments alone; a worker process of a pool has to tell ours whole.
        named = ("file", "line", "column", "found", "allowed", "remedy")
        return partial(type(self), **{name: getattr(self, name) for name in named}), (self.code, self.message)


class InputError(TvsError):
    """A file, option or value that cannot be used as it is (exit 2)."""

    exit_code = 2


class NothingToEstimate(TvsError):
    """The data are readable but hold nothing to estimate from (exit 3)."""

    exit_code = 3


MISFIT_REMEDY = (
    "see what `tvsbayes check` warns of: a camera that was knocked, rows shifted by one, counters; without warnings "
    "check for swapped cameras, or state the extrinsics better in [rig.prior]"
)
"""Where no beam of the model passes the spots."""


class NotConverged(TvsError):
    """An estimator did not reach its convergence criterion (exit 4)."""

    exit_code = 4

    @classmethod
    def of(cls, problems: Iterable[str], remedy: str) -> NotConverged:
        """Of a fit that ended with these problems, in sentences."""
        return cls("not-converged", "NOT CONVERGED: " + "; ".join(problems), remedy=remedy)


class DeviceFault(TvsError):
    """The positioner, a camera or the disk failed while an instrument was in use (exit 5)."""

    exit_code = 5


def fault(code: str, found: str, remedy: str) -> DeviceFault:
    """The `DeviceFault` whose message says what was found and what to do."""
    return DeviceFault(code, f"{found}; {remedy}", found=found, remedy=remedy)


INTEGER = re.compile(r"[+-]?[0-9]{1,18}")
CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]")


def escaped(text: str, limit: int = 60) -> str:
    """Text from a file made fit to print: what is not printable is escaped, what is long is cut."""
    cut = text if len(text) <= limit else text[:limit] + "..."
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in cut)


def shown(value: object) -> str:
    """A value as an error message quotes it."""
    if isinstance(value, str):
        return f'"{escaped(value)}"'
    if isinstance(value, dict):
        return "a table with " + (escaped(", ".join(map(str, value))) or "no keys")
    if isinstance(value, list):
        return f"a list of {len(value)}"
    if isinstance(value, bool):
        return str(value).lower()
    # An integer beyond Python's limit of digits cannot be printed at all.
    huge = isinstance(value, int) and abs(value) >= 10**60
    return "an integer of more than 60 digits" if huge else escaped(str(value))


def refusal(
    code: str, *, file: str, found: str, allowed: str, remedy: str, line: int | None = None, column: str | None = None
) -> InputError:
    """Builds the `InputError` whose message says where, what was found, what is allowed and what to do."""
    where = file + (f" line {line}" if line else "") + (f", {escaped(column)}" if column else "")
    message = f"{where}: found {found}; allowed: {allowed}; {remedy}"
    return InputError(code, message, file=file, line=line, column=column, found=found, allowed=allowed, remedy=remedy)


def entry_refusal(code: str, table: str, key: str, found: str, allowed: str, remedy: str) -> InputError:
    """The same of an entry in a table of the rig file."""
    message = f"[{table}] {key}: found {found}; allowed: {allowed}; {remedy}"
    return InputError(code, message, column=f"{table}.{key}", found=found, allowed=allowed, remedy=remedy)


def all_of(refused: Sequence[InputError], most: int = 5) -> InputError:
    """One refusal for several files, so that nobody meets one a run: the first whole, the others by name."""
    first, others = refused[0], [error.file or error.message for error in refused[1:]]
    if not others:
        return first
    names = ", ".join(escaped(name, 200) for name in others[:most])
    more = f" and {len(others) - most} more" if len(others) > most else ""
    message = f"{first.message}; likewise {names}{more}"
    fields = ("file", "line", "column", "found", "allowed", "remedy")
    return InputError(first.code, message, **{name: getattr(first, name) for name in fields})


def require_kind(given: object, has: str, wanted: str) -> None:
    """Refuse an argument of another kind, which lacks an attribute, before it fails somewhere inside.

    Raises:
        TypeError: it does, with what was found and where the right one comes from.
    """
    if not hasattr(given, has):
        raise TypeError(f"found {type(given).__name__}; wanted {wanted}")


CLOSE = 0.6
"""Similarity (difflib) from which a word may be another one misspelt: "comment" and "point" have 0.5."""


def closest(name: str, names: Iterable[str], otherwise: str = "remove it, or correct the spelling") -> str:
    """The remedy for an unknown name: the nearest allowed one, where any is near."""
    near = difflib.get_close_matches(name[:100], list(names), n=1, cutoff=CLOSE)
    return f"did you mean {near[0]}?" if near else otherwise


def typed(word: object, limit: int = 200) -> str:
    """A path or another word as it stands in a command that somebody is told to type: quoted where a shell needs it."""
    return shlex.quote(escaped(str(word), limit))


def listed(numbers: Sequence[object], most: int) -> str:
    """The first of them, and how many more there are."""
    more = f" and {len(numbers) - most} more" if len(numbers) > most else ""
    return ", ".join(map(str, numbers[:most])) + more


def other_format(found: str, allowed: Iterable[str]) -> str | None:
    """The remedy for a file of another kind or version of ours; None where it is neither."""
    kind, _, number = found[:100].rpartition("/")
    known = {name.rpartition("/")[0] for name in allowed}
    if not (kind.startswith("tvsbayes-") and number.isdecimal()):
        return None
    if kind in known:
        return "another version of tvsbayes wrote it: use that one, or make the file again"
    return f"this is a {escaped(kind)} file: name a {' or '.join(sorted(known))} file"
