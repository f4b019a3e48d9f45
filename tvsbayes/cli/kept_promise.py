"""Tables and calibrations for controllers: the one writer of their files and of the promise kept with them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from tvsbayes.cli.app import command_line, finish, keep, report_line
from tvsbayes.errors import NothingToEstimate, Reason, escaped
from tvsbayes.files.disk import output_place, write_atomically
from tvsbayes.pipeline import StoredOrFitted, inputs_of

if TYPE_CHECKING:
    from tvsbayes.results.compensation_record import AimedPromise

USE = {"header": "aim with it", "urdf": "load it in place of the old model"}
"""What to do with the file of a calibration, before `verify`."""
type Contents = Mapping[str, tuple[Path | None, str | bytes]]
"""Files by name: place, None to write none, and content."""


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
