"""What commands end with: the promise of a calibration and its files, verdicts of `watch`, plans."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec import structs

from tvsbayes.cli.app import TARGET_MISSED, Ended, command_line, finish, keep, report_line
from tvsbayes.errors import InputError, NothingToEstimate, Reason, escaped
from tvsbayes.files.csv_table import append_line
from tvsbayes.files.disk import output_place, write_atomically
from tvsbayes.pipeline import StoredOrFitted, inputs_of

if TYPE_CHECKING:
    from tvsbayes.results.compensation_record import AimedPromise
    from tvsbayes.results.watch_record import Watch, WatchPlan

WATCHING = "looking at the new looks"
TABLE_COLUMNS = ("time", "verdict", "p", "looks", "moved")
USE = {"header": "aim with it", "urdf": "load it in place of the old model"}
"""What to do with the file of a calibration, before `verify`."""
type Contents = Mapping[str, tuple[Path | None, str | bytes]]
"""Files by name: place, None to write none, and content."""


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


def finish_plan(
    document: Mapping[str, object], text: str, out: Path | None, write: Callable[[Path], None], as_json: bool
) -> None:
    """Write a plan where a file is named, and print it."""
    if out is not None:
        write(out)
        document, text = {**document, "plan": str(out)}, f"{text}\nwritten: {escaped(str(out), 200)}"
    finish(document, text, as_json)


def finish_watch_plan(
    plan: WatchPlan, looks: str, out: Path | None, write: Callable[[Path], None], as_json: bool
) -> None:
    """The same for a plan of `watch`; `looks` is what it takes."""
    from tvsbayes.report.command_text import watch_plan_text

    stated = plan if out is None else structs.replace(plan, plan=str(out))
    finish_plan(stated.as_json(), watch_plan_text(plan, looks), out, write, as_json)


def promise_of(
    results: StoredOrFitted, target: str, seed: int, unsaid: tuple[str, ...] = ()
) -> tuple[AimedPromise | None, dict[str, object]]:
    """The promise of a scanner's or head's calibration, and `results/compensation.json`; none, said, without one."""
    from tvsbayes.compensation.aimed_promise import aimed_promise
    from tvsbayes.inference.stored_posterior import answer_of
    from tvsbayes.results.compensation_record import AIMED_FORMAT
    from tvsbayes.results.fit_record import provenance
    from tvsbayes.results.records import plain

    stored, why = results.stored, "the fit is not an accepted answer; run `tvsbayes fit` again"
    if not isinstance(stored, Reason) and answer_of(stored.keys) == "accepted":
        try:
            promise = aimed_promise(results.calibration, results.campaign, target, unsaid, seed=seed)
            fit = stored.keys.values.get("fit_id")
            origin = plain(provenance(inputs_of(results.campaign), seed, None if fit is None else str(fit)))
            return promise, {"format": AIMED_FORMAT, **promise.as_json(), **origin}
        except NothingToEstimate as error:
            why = str(error)
    report_line(f"note: no promise: {why}")
    return None, {}


def write_kept(folder: Path, kept: Mapping[str, object], contents: Contents) -> dict[str, str]:
    """Write the files that have a place, then the promise of what they hold, if any; returns the paths by name."""
    files = {name: str(place) for name, (place, _) in contents.items() if place is not None}
    for place, text in contents.values():
        if place is not None:
            write_atomically(place, text if isinstance(text, bytes) else text.encode())
    if files and kept and keep(kept, record := output_place(folder, "results") / "compensation.json"):
        files["compensation"] = str(record)
    return files


def finish_promised(
    folder: Path, kept: dict[str, object], document: dict[str, object], text: str, contents: Contents, as_json: bool
) -> None:
    """Write the files of a calibration and its promise, and print both with what comes next."""
    if files := write_kept(folder, kept, contents):
        text = f"{text}\nwritten: {escaped(', '.join(files.values()), 600)}".lstrip()
    if "compensation" in files:
        text += f"\nnext: {USE[next(iter(files))]}, then {command_line('verify', folder, 'FRESH')}"
    finish({**kept, **document, "files": files}, text, as_json)
