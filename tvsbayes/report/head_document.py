"""The document of a head with sightings: ratios, terms, stops, weaknesses.

Only the pointing model is computed here, for comparison with the fit. deg, deg/step.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from tvsbayes.display import concise
from tvsbayes.head.pointing_model import PointingModel, pointing_model
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.campaign import Campaign
from tvsbayes.report.advice import LAPLACE_SHORT
from tvsbayes.report.document import Document, FigureView, Issue, Section, about_table
from tvsbayes.report.figures import intervals
from tvsbayes.report.fit_sections import stop_views
from tvsbayes.report.fit_text import validation_lines
from tvsbayes.report.page import numbered
from tvsbayes.report.parameter_words import name_in_words, sentence_in_words
from tvsbayes.report.result_tables import headline_table
from tvsbayes.report.scanner_document import answer_table, measured_days, verdict_of
from tvsbayes.report.tables import TableView, two_digits
from tvsbayes.results.fit_record import FitRecord

METHOD = (
    "The line of sight is that of two geared axes by exact rotations: the azimuth axis leans, the elevation axis is "
    "not square to it, nor the line of sight to the elevation axis, and it sags. To first order these are TPOINT's "
    "terms.",
    "Counters drive gears with a ratio, a difference of both directions, play, errors that repeat by position, a zero "
    "that drifts; every stop has an error of its own. Each sighting gives two residuals on the sphere.",
    "Refraction is as the table of sightings has it.",
)


def pointing_table(model: PointingModel, joint: Mapping[str, tuple[float, float]] | None = None) -> TableView:
    """The terms of a head by least squares, and those of a fit, if any, with value and sd."""
    rows = []
    for name, value, error in zip(model.names, model.value.tolist(), model.standard_error.tolist(), strict=True):
        row = [name_in_words(name), concise(value, error)]
        if joint is not None:
            row += [concise(*joint[name]), f"{error / joint[name][1]:.2g}" if joint[name][1] > 0 else ""]
        rows.append(row)
    columns = ["term", "least squares (se)", *(["joint (sd)", "se / sd"] if joint is not None else [])]
    sizes = f"{two_digits(model.rms_deg)} deg = {two_digits(3600 * model.rms_deg)} arcsec"
    caption = f"pointing model without gears, {len(model.residual_deg)} sightings; RMS on the sphere {sizes}"
    return TableView(caption, columns, rows)


def head_document(campaign: Campaign, record: FitRecord, issue: Issue, doubts: Sequence[str] = ()) -> Document:
    """The document with its number.

    Args:
        campaign: campaign of a head, with sightings.
        record: its `fit.json`.
        issue: laboratory, customer and day.
        doubts: warnings of `check`.
    """
    summary = record.summary
    weaknesses = [weak.text for weak in summary.weak_directions] + [entry.text for entry in summary.leverage]
    warnings = [*summary.problems, *(f"Prior conflict: {sentence_in_words(text)}" for text in summary.prior_conflicts)]
    warnings += [f"`check` warns: {sentence_in_words(text)}" for text in doubts]
    if summary.estimator == "laplace":
        warnings.append(LAPLACE_SHORT)
    validation = [] if summary.validation is None else validation_lines(summary.validation)
    stops = () if record.evidence is None else record.evidence.residuals
    joint = {name: (estimate.value, estimate.sd) for name, estimate in summary.parameters.items()}
    tables = [headline_table(summary), pointing_table(pointing_model(campaign), joint)]
    noise, scale = summary.noise, summary.parameters["pixel_scale"].value
    scatter = f"chi-square {noise.chi2:.1f} for {noise.dof:.1f} degrees of freedom; "
    scatter += f"sightings scatter by {scale:.2f} times their stated u."
    sections = [
        Section("Result", tables=tables, opened=True),
        Section("Stops", text=[scatter], figures=[view for axis in AXES for view in stop_views(stops, axis)]),
        Section(
            "What the sightings do not determine",
            items=[sentence_in_words(text) for text in weaknesses] or ["No remarks."],
        ),
        Section("Signs of model errors", items=validation or ["Not asked."]),
        Section("Method", text=METHOD),
    ]
    return numbered(
        Document(
            results=record.results_id,
            name=campaign.title,
            about=about_table(campaign.header, measured_days(campaign, issue), issue),
            verdict=verdict_of(summary, (), doubts),
            answer=answer_table(summary, None, "the line of sight"),
            picture=FigureView(
                intervals(summary), "Ratios with 95 % intervals; values in the table", "Effective ratios."
            ),
            steps=["`tvsbayes compare CAMPAIGN --by positions` says how well the fit predicts sightings left out."],
            traceable="The sightings are taken as stated.",
            warnings=warnings,
            versions=record.provenance.versions,
            sections=sections,
            title="Calibration of a pan-tilt head",
            issue=issue,
        )
    )
