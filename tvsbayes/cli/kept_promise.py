"""The promise of a scanner's or head's calibration, for the commands that write it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tvsbayes.cli.app import report_line
from tvsbayes.errors import NothingToEstimate, Reason
from tvsbayes.pipeline import StoredOrFitted, inputs_of

if TYPE_CHECKING:
    from tvsbayes.results.compensation_record import AimedPromise


def promise_of(results: StoredOrFitted, target: str, seed: int, unsaid: tuple[str, ...] = ()) -> AimedPromise | None:
    """The promise of a scanner's or head's calibration; None, with the reason on stderr, without an accepted fit."""
    from tvsbayes.compensation.aimed_promise import aimed_promise
    from tvsbayes.inference.stored_posterior import answer_of

    stored = results.stored
    if isinstance(stored, Reason) or answer_of(stored.keys) != "accepted":
        report_line("note: no promise: the fit is not an accepted answer; run `tvsbayes fit` again")
        return None
    try:
        return aimed_promise(results.calibration, results.campaign, target, unsaid, seed=seed)
    except NothingToEstimate as error:
        report_line(f"note: no promise: {error}")
        return None


def promise_document(promise: AimedPromise, results: StoredOrFitted, seed: int) -> dict[str, object]:
    """Content of `results/compensation.json` of a scanner or head."""
    from tvsbayes.results.compensation_record import AIMED_FORMAT
    from tvsbayes.results.fit_record import provenance
    from tvsbayes.results.records import plain

    stored = results.stored
    fit = None if isinstance(stored, Reason) else stored.keys.values.get("fit_id")
    origin = plain(provenance(inputs_of(results.campaign), seed, None if fit is None else str(fit)))
    return {"format": AIMED_FORMAT, **promise.as_json(), **origin}
