"""The certificate of an axis: the line, the play, the test by ISO 230-2, statements of conformity.

Values in the folder's unit, converted where D-SI has none of its name.
"""

from __future__ import annotations

import datetime
import hashlib
import json
from collections.abc import Iterator, Sequence

from tvsbayes.errors import InputError, escaped
from tvsbayes.instrument.campaign import title_of
from tvsbayes.metrology.conformity import Criterion
from tvsbayes.metrology.dcc import (
    COVERAGE,
    Content,
    Embedded,
    Equipment,
    Issue,
    Parties,
    Quantity,
    Real,
    Result,
    Statement,
    certificate_xml,
    check_certifiable,
    dcc_real,
)
from tvsbayes.metrology.traceability import (
    Performance,
    Traceability,
    header_table,
    length_traceability,
    performed,
    plain_text,
)
from tvsbayes.results.estimates import Estimate
from tvsbayes.results.fit_record import provenance
from tvsbayes.single_axis.axis_campaign import AxisCampaign, axis_hashes
from tvsbayes.single_axis.axis_record import AxisResults, AxisSummary
from tvsbayes.single_axis.classic_line import AXIS_TERMS

SI = {
    "m": (1.0, r"\metre"),
    "cm": (1.0, r"\centi\metre"),
    "mm": (1.0, r"\milli\metre"),
    "um": (1.0, r"\micro\metre"),
    "nm": (1.0, r"\nano\metre"),
    "inch": (25.4, r"\milli\metre"),
    "thou": (0.0254, r"\milli\metre"),
    "deg": (1.0, r"\degree"),
    "arcmin": (1.0, r"\arcminute"),
    "arcsec": (1.0, r"\arcsecond"),
    "rad": (1.0, r"\radian"),
    "mrad": (1.0, r"\milli\radian"),
    "urad": (1.0, r"\micro\radian"),
    "gon": (0.9, r"\degree"),
    "turn": (360.0, r"\degree"),
    "counts": (1.0, r"\one"),
}
"""Factor and unit of D-SI by the unit of readings."""
ONE = r"\one"
METHOD = (
    "Joint Bayesian estimate of line, play, errors by position, drift, scatter of stops and of readings; errors that "
    "all readings of the reference share are in every uncertainty. Figures by ISO 230-2 are those of the runs, actual "
    "less target, with the uncertainty of their measurement (GUM, first order), k = 2 for 95 %."
)
EXPIRED = "The certificate of the reference, {}, was valid until {} and does not cover the measurement."
_K = 2.0


def axis_certificate(
    results: AxisResults,
    *,
    issued: datetime.date,
    parties: Parties,
    report: Embedded,
    criteria: Sequence[Criterion] = (),
    signed: bool = False,
) -> bytes:
    """Write DCC-schema XML of an axis: not accredited, traceable only as far as the folder declares.

    Args:
        results: of these data.
        issued: date of issue; the same inputs and date give the same bytes.
        parties: laboratory, customer, countries.
        report: the HTML report to embed.
        criteria: statements of conformity.
        signed: whether a signature will be added.

    Raises:
        InputError: a country is not a code, or D-SI has no such unit.
        NotConverged: the fit has not converged.
    """
    campaign, summary = results.fit.campaign, results.summary
    check_certifiable(parties, own=True, converged=summary.converged)
    if campaign.unit not in SI:
        found, allowed = f"readings in {escaped(campaign.unit)}", ", ".join(SI)
        raise InputError("unit", f"no certificate of {found}: D-SI has no such unit", found=found, allowed=allowed)
    origin, when = provenance(axis_hashes(campaign), results.fit.seed), performed(campaign, issued)
    low, high = summary.range_command
    reference = Equipment("reference", "reference that read the axis", "", certificate_of(campaign), (), normal=True)
    content = Content(
        item="geared axis",
        measured="line, play and positioning by ISO 230-2",
        scope=f"Commands from {low:.10g} to {high:.10g}. {summary.classic.iso230_basis}. {COVERAGE}",
        method=("readings of an axis by a reference", METHOD),
        references=(("norm", "ISO 230-2"), ("norm", "JCGM 100:2008"), ("norm", "JCGM 106:2012")),
        equipment=(reference,),
        results=_results(summary),
        statements=_statements(campaign, criteria),
        traceability=axis_traceability(campaign, when),
        provenance=origin,
    )
    title = title_of(campaign.header, campaign.path)
    besides = [summary.as_json(), origin.inputs, issued.isoformat(), title, parties, report.number]
    digest = hashlib.sha256(json.dumps(besides, sort_keys=True, default=str).encode()).hexdigest()
    number = f"tvsbayes-{digest[:32]}"
    return certificate_xml(content, campaign, title, number, Issue(issued, parties, report, signed))


def certificate_of(campaign: AxisCampaign) -> str:
    """Name of the reference's certificate."""
    declared = header_table(campaign, "traceability").get("reference_certificate", "")
    return plain_text(campaign.reference.certificate or declared)


def axis_traceability(campaign: AxisCampaign, when: Performance) -> Traceability:
    """The statement on the reference of an axis; a certificate that has run out makes nothing traceable."""
    certificate, until = certificate_of(campaign), campaign.reference.valid_until
    if until is not None and until < when.end and not campaign.header.get("synthetic"):
        return Traceability(f"Not traceable. {EXPIRED.format(certificate, until)}", False)
    return length_traceability(campaign, certificate, "the reference", "the reference that read the axis")


def _statements(campaign: AxisCampaign, criteria: Sequence[Criterion]) -> Iterator[Statement]:
    if (until := campaign.reference.valid_until) is not None:
        yield Statement("validity of the reference", f"{certificate_of(campaign)}: valid until {until}.")
    calibrated = header_table(campaign, "traceability").get("reference_calibrated")
    if calibrated is not None:
        yield Statement("calibration of the reference", f"Calibrated {calibrated}, as declared by the user.")
    for c in criteria:
        band = "" if c.guard_band is None else f", guard band {c.guard_band:.3g} {c.unit}"
        risk = "" if c.risk is None else f", specific risk {c.risk:.2g} (JCGM 106)"
        text = f"{c.quantity} {c.verdict} to {c.limit:.6g} {c.unit} by the decision rule {c.rule}{band}{risk}."
        yield Statement("conformity", text)


def _results(summary: AxisSummary) -> Iterator[Result]:
    factor, unit = SI[summary.unit]
    shape = "normal" if summary.estimator == "laplace" else "sampled posterior"

    def real(estimate: Estimate, in_unit: str) -> Real:
        low, high = estimate.interval95
        return dcc_real(in_unit, factor * estimate.value, factor * estimate.sd, (factor * low, factor * high), shape)

    # Targets are commands in the readings' unit: the ratio is a number.
    ratio, lines = unit + r"\per\one" if unit != ONE else ONE, summary.effective_per_command.items()
    sides = [Quantity(f"{summary.unit} per command, {side}", real(estimate, ratio)) for side, estimate in lines]
    yield Result("line through the positions read", sides)
    play, classic = summary.effective_backlash, summary.classic
    yield Result("mean play over the positions read", [Quantity("play", None if play is None else real(play, unit))])
    figures, values = [], [(name, value) for name, value in (classic.iso230 or {}).items() if value is not None]
    for name, size in values:
        u = factor * ((classic.iso230_u or {})[name] or 0.0)
        figures.append(Quantity(f"{classic.symbols[name]}, {AXIS_TERMS[name]}", _figure(unit, factor * size, u)))
    if figures:
        yield Result("positioning by ISO 230-2", figures, classic.iso230_basis)
    targets = []
    for row in classic.iso230_targets:
        means, scatters = (row.mean_forward, row.mean_backward), (row.s_forward, row.s_backward)
        for side, *both in zip(("forward", "backward"), means, scatters, strict=True):
            for name, value in zip(("mean deviation", "s of its runs"), both, strict=True):
                if value is not None:
                    real_value = dcc_real(unit, factor * value, None)
                    targets.append(Quantity(f"{name} at {row.position:.10g}, {side}", real_value))
    if targets:
        yield Result("deviations by position, actual less target", targets)


def _figure(unit: str, value: float, u: float) -> Real:
    """A figure with its expanded uncertainty; without one where u is a rounding error of its derivatives."""
    if u <= 1e-9 * abs(value):
        return dcc_real(unit, value, None)
    return dcc_real(unit, value, u, (value - _K * u, value + _K * u))
