"""The end of `watch`, of any instrument: its text, the nightly table, the exit code."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from tvsbayes.cli.app import TARGET_MISSED, Ended, finish
from tvsbayes.errors import InputError, NothingToEstimate
from tvsbayes.files.csv_table import append_line

if TYPE_CHECKING:
    from tvsbayes.results.watch_record import Watch

WATCHING = "looking at the new looks"
TABLE_COLUMNS = ("time", "verdict", "p", "looks", "moved")


def finish_watch(result: Watch, append: Path | None, as_json: bool, looks: str = "looks") -> None:
    """Print the result, add it to a table, and end with its exit code; `looks` is what the new data are."""
    from tvsbayes.comparison.departures import POWER_MIN
    from tvsbayes.report.command_text import watch_text
    from tvsbayes.results.watch_record import CANNOT_TELL, OK

    error = None if append is None else _append(append, result)
    finish(result.as_json(), watch_text(result, POWER_MIN, looks), as_json, error)
    if result.verdict != OK:
        raise Ended(NothingToEstimate.exit_code if result.verdict == CANNOT_TELL else TARGET_MISSED)


def _append(table: Path, result: Watch) -> InputError | None:
    """Append the current line (time in UTC); returns the error of a failure, so that the result is still printed."""
    from tvsbayes.report.command_text import moved_text

    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    moved = "; ".join(map(moved_text, result.moved))
    try:
        append_line(table, TABLE_COLUMNS, (now, result.verdict, float(f"{result.p:.3g}"), result.looks, moved))
    except InputError as error:
        return error
    return None
