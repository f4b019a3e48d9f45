"""Fit, calibration and evidence of a campaign, as the commands make them."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tvsbayes.errors import NotConverged
from tvsbayes.files.disk import output_place
from tvsbayes.instrument.axes import AXES

if TYPE_CHECKING:
    import numpy as np

    from tvsbayes.calibration.pointing import Calibration
    from tvsbayes.estimators.joint_fit import JointFit
    from tvsbayes.instrument.campaign import Campaign
    from tvsbayes.posterior.draws import Posterior
    from tvsbayes.results.estimates import FitSummary


Tell = Callable[[str], None]
"""Shows a line to whoever waits."""
RESIDUALS_LISTED = 4096
"""Stops in `fit.json`, evenly chosen: a long campaign's file stays readable within its cap."""
FITTING_FIRST = (
    "results/ are missing, older than the campaign, or of a fit that did not converge: fitting first "
    "(Laplace approximation) ..."
)


def compile_for(tell: Tell) -> None:
    """Use the compilation cache; whoever waits at a terminal for the first compilation is told so."""
    from tvsbayes.estimators.campaign_arrays import use_compilation_cache

    if use_compilation_cache() and sys.stderr.isatty():
        tell("first run: the model is compiled, half a minute to two minutes; later runs take it from the cache")


def evidence_of(
    fit: JointFit,
    summary: FitSummary,
    posterior: Posterior | None,
    calibration: Calibration | None,
    physical: np.ndarray,
) -> dict[str, object]:
    """What `fit.json` holds for reports besides the estimates; without a calibration residuals alone.

    `physical` are the draws, in the units of the names, that the calibration's inputs were taken from, row by row.
    """
    from tvsbayes.assessment.causes import headline_budget, headline_causes
    from tvsbayes.assessment.residuals import residual_causes, stop_readings, stop_residuals
    from tvsbayes.comparison.gap import explain_gap
    from tvsbayes.metrology.positioning_table import positioning

    stops = stop_residuals(fit)
    listed = stops[:: -(-len(stops) // RESIDUALS_LISTED) or 1]
    gaps, budgets, axes = {}, [], []
    if calibration is not None:
        gaps = explain_gap(fit, posterior)
        causes = headline_causes(fit)
        told = {**{f"effective_deg_per_step.{d}": e for d, e in summary.effective.items()}, **summary.parameters}
        # What a model holds fixed has no uncertainty to split.
        budgets = [headline_budget(causes, q, told[q]).as_json() for q in causes.quantities if told[q].sd > 0]
        readings = {axis: stop_readings(fit, axis) for axis in AXES}
        for axis, own in readings.items():
            contrast = physical[:, fit.names.index(f"ratio_contrast_deg_per_step.{axis}")]
            axes.append(positioning(calibration, axis, readings=own, contrast_deg_per_step=contrast).as_json())
    return {
        "residuals": [asdict(stop) for stop in listed],
        "residual_causes": [asdict(cause) for cause in residual_causes(stops)],
        "gap": {d: None if gap is None else asdict(gap) for d, gap in gaps.items()} if any(gaps.values()) else None,
        "budgets": budgets,
        "positioning": axes,
    }


def calibration_for(folder: Path, tell: Tell) -> Calibration:
    """The calibration in `results/` where its hashes agree with the campaign; else fit first (DESIGN 8)."""
    from tvsbayes.calibration.calibration_file import stored_calibration
    from tvsbayes.instrument.campaign import read_campaign

    campaign = read_campaign(folder)
    found = stored_calibration(campaign)
    if found is not None:
        return found
    tell(FITTING_FIRST)
    result = _converged_fit(campaign, tell)
    from tvsbayes.assessment.fitted_calibration import calibration_of

    return calibration_of(result)


def fit_for(campaign: Campaign, tell: Tell) -> JointFit:
    """The fit in `results/` where its hashes agree with the campaign; else fit first (DESIGN 8)."""
    from tvsbayes.estimators.joint_fit import restored
    from tvsbayes.results.fit_record import stored_mode

    compile_for(tell)
    stored = stored_mode(campaign)
    found = None if stored is None else restored(campaign, stored)
    if found is not None:
        return found
    tell(FITTING_FIRST)
    return _converged_fit(campaign, tell)


def _converged_fit(campaign: Campaign, tell: Tell) -> JointFit:
    """A fit for a command that needs one in passing."""
    from tvsbayes.estimators.joint_fit import fit as fit_joint

    compile_for(tell)
    result = fit_joint(campaign)
    if not result.converged:
        raise NotConverged(
            "not-converged",
            "NOT CONVERGED: " + "; ".join(result.problems),
            remedy="see `tvsbayes fit`; this command needs a fit that has converged",
        )
    return result


def document_for(data: Campaign, folder: Path, tell: Tell) -> dict[str, Any]:
    """`results/fit.json` where it was made from exactly this campaign; else fit first (DESIGN 8)."""
    from tvsbayes.calibration.calibration_file import stored_calibration
    from tvsbayes.instrument.campaign import input_hashes
    from tvsbayes.results.fit_record import read_fit

    path = folder / "results" / "fit.json"
    if stored_calibration(data) is not None and path.exists():
        document = read_fit(path)
        # An old fit.json beside new draws would be the report of other data.
        if "budgets" in document and document["inputs"] == input_hashes(data):
            return document
    tell(FITTING_FIRST)
    result = _converged_fit(data, tell)
    from tvsbayes.assessment.fitted_calibration import calibration_of
    from tvsbayes.assessment.summary import summarise
    from tvsbayes.results.fit_record import write_results

    summary, calibration = summarise(result), calibration_of(result)
    evidence = evidence_of(result, summary, None, calibration, result.draws.physical)
    write_results(result, summary, output_place(folder, "results"), 0, calibration, None, evidence)
    return read_fit(path)
