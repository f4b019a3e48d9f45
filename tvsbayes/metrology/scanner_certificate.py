"""The certificate of a scanner: effective degrees per step, backlash, predicted figures by ISO 230-2.

Ratios in degrees per step, backlash in degrees, lengths in mm.
"""

from __future__ import annotations

import datetime
from collections.abc import Iterator

from tvsbayes.instrument.axes import AXES, SIDES
from tvsbayes.instrument.campaign import Campaign, input_hashes
from tvsbayes.metrology.dcc import (
    COVERAGE,
    NO_PARTIES,
    Content,
    Embedded,
    Equipment,
    Issue,
    Parties,
    Quantity,
    Result,
    Statement,
    certificate_xml,
    check_certifiable,
    dcc_real,
    stated,
)
from tvsbayes.metrology.traceability import NOT_STATED, header_table, traceability
from tvsbayes.results.estimates import Estimate
from tvsbayes.results.fit_record import FitRecord
from tvsbayes.results.metrology_tables import FIGURES
from tvsbayes.statistics.intervals import NORMAL_95

METHOD = (
    "Joint Bayesian estimate of gear ratios, backlash, mirror geometry and camera pose from the pixels of laser spots "
    "seen by a calibrated stereo pair at several depths; angles are inferred through cameras and model, no angle "
    "standard measured them. Effective degrees of the beam per motor step hold at the stated pose of the mirrors. "
    "U is half the 95 % interval, k = U/u."
)
REFERENCES = (
    ("norm", "JCGM 100:2008"),
    ("norm", "JCGM 101:2008"),
    ("reference", "doi:10.3390/metrology5040058"),
)
DEG_PER_STEP, DEG, MM = r"\degree\per\one", r"\degree", r"\milli\metre"
"""Units in the notation of D-SI, which has no unit of a count: steps are `\\one`."""


def _statements(fit: FitRecord) -> Iterator[Statement]:
    validation = fit.summary.validation
    if validation is not None and not validation.passed:
        text = f"VALIDATION FAILED: {validation.cause}. Uncertainties are stated as fitted; multiply every one of "
        yield Statement("validation", f"{text}them by {validation.inflation:.2f}.")


def _cameras(campaign: Campaign) -> str:
    """Describe the camera pair in words."""
    declared, stereo = header_table(campaign, "traceability"), campaign.stereo_pair
    text = f"2 x {stereo.image_width} x {stereo.image_height} px, calibration residual {stereo.rms_px:.3g} px rms"
    if stereo.assumed:
        text += "; covariance of the calibration assumed, not estimated"
    if "stereo_calibrated" in declared:
        text += f"; calibrated {declared['stereo_calibrated']}"
    return text


def _results(fit: FitRecord) -> Iterator[Result]:
    """List ratios, backlash, and the predicted ISO 230-2-style figures."""
    summary = fit.summary
    shape = "normal" if summary.estimator == "laplace" else "sampled posterior"

    def quantity(name: str, estimate: Estimate | None, unit: str) -> Quantity:
        if estimate is None:
            return Quantity(name, None)
        return Quantity(name, dcc_real(unit, estimate.value, estimate.sd, estimate.interval95, shape))

    ratios = summary.effective.items()
    listed = [quantity(f"effective degrees per step, {direction}", entry, DEG_PER_STEP) for direction, entry in ratios]
    yield Result("effective degrees of beam per motor step", listed)
    plays = []
    for axis in AXES:
        moved = any(summary.effective[d] is not None for d in SIDES[axis])
        play = summary.parameters[f"backlash_deg.{axis}"] if moved else None
        plays.append(quantity(f"backlash of the {axis} axis", play, DEG))
    yield Result("backlash", plays)
    for table in () if fit.evidence is None else fit.evidence.positioning:
        figures = []
        for name, (symbol, term) in FIGURES.items() if table.predicted else ():
            figure = (table.predicted or {})[name]
            # Medians and intervals of a simulation: u is the half width over 1.96.
            u = (figure.interval95[1] - figure.interval95[0]) / (2 * NORMAL_95)
            real = dcc_real(DEG, figure.median, u, figure.interval95, "simulated tests")
            figures.append(Quantity(f"{symbol}, {term}", real))
        if figures:
            title = f"ISO 230-2-style figures of the {table.axis} axis, posterior predictive"
            yield Result(title, figures, "; ".join(table.notes))


def dcc_bytes(
    campaign: Campaign,
    fit: FitRecord,
    *,
    issued: datetime.date,
    identifier: str | None = None,
    parties: Parties = NO_PARTIES,
    report: Embedded | None = None,
    signed: bool = False,
) -> bytes:
    """Write DCC-schema XML of a fit: not accredited, traceable only as far as the campaign declares.

    Args:
        campaign: the fitted campaign; names are used as given, as text.
        fit: content of its `results/fit.json`.
        issued: date of issue; the same inputs and date give the same bytes.
        identifier: unique identifier; None makes one from results, name, date, parties and report.
        parties: laboratory, customer, countries.
        report: the HTML report to embed; its number is part of the core data.
        signed: whether a signature will be added.

    Returns:
        UTF-8 XML, DCC 3.3.0.

    Raises:
        InputError: a country is not a code, or the results belong to other data or priors.
        NotConverged: the fit of the results has not converged.
    """
    check_certifiable(parties, own=fit.provenance.inputs == input_hashes(campaign), converged=fit.summary.converged)
    summary = fit.summary
    pose = summary.reference_pose_deg
    kind = "posterior draws" if summary.estimator == "posterior" else "the Laplace approximation of the posterior"
    where = f"at mirror angles pan {pose['pan']:.2f} deg, tilt {pose['tilt']:.2f} deg"
    board = str(header_table(campaign, "traceability").get("board_certificate", NOT_STATED))
    pitch = stated(campaign, "traceability", "pitch_mm", MM)
    pitches = [] if pitch is None else [Quantity("pitch", pitch)]
    content = Content(
        item="stepper-driven two-mirror laser positioner",
        measured="degrees of beam per motor step, and backlash",
        scope=f"Effective ratios hold {where}. Values and intervals from {kind}. {COVERAGE}",
        method=("joint estimate from stereo spots", METHOD),
        references=REFERENCES,
        equipment=(
            Equipment("cameras", "stereo camera pair", _cameras(campaign)),
            Equipment("board", "calibration board (length standard)", "", board, pitches, normal=True),
        ),
        results=_results(fit),
        statements=_statements(fit),
        traceability=traceability(campaign),
        provenance=fit.provenance,
    )
    besides = [campaign.title, *parties, None if report is None else report.number]
    number = identifier or fit.certificate_id(issued, besides)
    return certificate_xml(content, campaign, campaign.title, number, Issue(issued, parties, report, signed))
