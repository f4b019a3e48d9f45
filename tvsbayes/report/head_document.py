"""The document of a pan-tilt head: ratios, terms, stops, weaknesses.

Only the estimate to compare with is computed here: the pointing model of sightings, the classic ratios of spots. deg,
deg/step.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from tvsbayes.display import concise
from tvsbayes.estimators.four_point import classic_of
from tvsbayes.head.pointing_model import PointingModel, pointing_model
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.campaign import Campaign
from tvsbayes.metrology.traceability import traceability
from tvsbayes.report.document import Document, FigureView, Issue, Section, about_table, labelled
from tvsbayes.report.figures import intervals
from tvsbayes.report.fit_text import LAPLACE_SHORT, validation_lines
from tvsbayes.report.page import numbered
from tvsbayes.report.result_tables import headline_table
from tvsbayes.report.scanner_document import answer_table, measured_days, verdict_of
from tvsbayes.report.scanner_sections import stop_views
from tvsbayes.report.tables import TableView, name_in_words, sentence_in_words, sentences, two_digits
from tvsbayes.results.fit_record import FitRecord


def pointing_table(model: PointingModel, joint: Mapping[str, tuple[float, float]] | None = None) -> TableView:
    """The terms of a head by least squares, and those of a fit, if any, with value and sd."""
    rows = []
    for name, value, error in zip(model.names, model.value.tolist(), model.standard_error.tolist(), strict=True):
        row = [name_in_words(name), concise(value, error)]
        if joint is not None:
            row += [concise(*joint[name]), f"{error / joint[name][1]:.2g}" if joint[name][1] > 0 else ""]
        rows.append(row)
    blank = [""] * (0 if joint is None else 2)
    rows += [[name_in_words(name), "not determined", *blank] for name in model.undetermined]
    columns = ["term", "least squares (se)", *(["joint (sd)", "se / sd"] if joint is not None else [])]
    sizes = f"{two_digits(model.rms_deg)} deg = {two_digits(3600 * model.rms_deg)} arcsec"
    caption = f"pointing model without gears, {len(model.residual_deg)} sightings; RMS on the sphere {sizes}"
    return TableView(caption, columns, rows)


def head_document(campaign: Campaign, record: FitRecord, issue: Issue, doubts: Sequence[str] = ()) -> Document:
    """The document with its number.

    Args:
        campaign: campaign of a head.
        record: its `fit.json`.
        issue: laboratory, customer and day.
        doubts: warnings of `check`.
    """
    summary, look = record.summary, campaign.looks_table.required[0]
    tables, classic, source = [headline_table(summary)], None, f"The {look}s are taken as stated."
    if campaign.has_images:
        classic, source = classic_of(campaign), traceability(campaign).statement
    else:
        joint = {name: (estimate.value, estimate.sd) for name, estimate in summary.parameters.items()}
        tables.append(pointing_table(pointing_model(campaign), joint))
    weak = [weak.text for weak in summary.weak_directions] + [entry.text for entry in summary.leverage]
    tests = [] if summary.validation is None else validation_lines(summary.validation)
    stops = () if record.evidence is None else record.evidence.residuals
    noise, scale, method = summary.noise, summary.parameters["pixel_scale"].value, sentences("head_method")
    scatter = (
        f"chi-square {noise.chi2:.1f} for {noise.dof:.1f} degrees of freedom; {look}s scatter by {scale:.2f} times "
        "their stated u."
    )
    ratios = FigureView(intervals(summary), "Ratios with 95 % intervals; values in the table", "Effective ratios.")
    return numbered(
        Document(
            results=record.results_id,
            name=campaign.title,
            about=about_table(campaign.header, measured_days(campaign, issue), issue),
            verdict=verdict_of(summary, (), doubts),
            answer=answer_table(summary, classic, "the line of sight"),
            picture=ratios,
            steps=[f"`tvsbayes compare CAMPAIGN --by positions` says how well the fit predicts {look}s left out."],
            traceable=source,
            warnings=[
                *summary.problems,
                *labelled("Prior conflict", map(sentence_in_words, summary.prior_conflicts)),
                *labelled("`check` warns", map(sentence_in_words, doubts)),
                *([LAPLACE_SHORT] if summary.estimator == "laplace" else []),
            ],
            versions=record.provenance.shown_versions,
            sections=[
                Section("Result", tables=tables, opened=True),
                Section("Stops", text=[scatter], figures=[view for axis in AXES for view in stop_views(stops, axis)]),
                Section(f"What the {look}s do not determine", items=[*map(sentence_in_words, weak)] or ["No remarks."]),
                Section("Signs of model errors", items=tests or ["Not asked."]),
                Section("Method", text=[method["axes"], method["gears"], method[look]]),
            ],
            title="Calibration of a pan-tilt head",
            issue=issue,
        )
    )
