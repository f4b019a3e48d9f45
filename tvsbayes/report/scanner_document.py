"""The document of a scanner: verdict, results of both estimators, errors in mm, warnings, next steps.

Ratios in deg/step, lost motion in deg, distances in mm.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np

from tvsbayes.display import concise
from tvsbayes.errors import typed
from tvsbayes.estimators.four_point import ClassicResult
from tvsbayes.estimators.plausibility import misfit_causes
from tvsbayes.instrument.axes import AXES, SENSES
from tvsbayes.instrument.campaign import Campaign
from tvsbayes.metrology.conformity import Criterion
from tvsbayes.metrology.traceability import performed, traceability
from tvsbayes.report import figures
from tvsbayes.report.compensation_text import verified_section
from tvsbayes.report.document import Document, FigureView, Issue, Number, Verdict, about_table, labelled, sentence
from tvsbayes.report.drawing import ESTIMATOR_STYLE
from tvsbayes.report.evidence import COLOUR, SATISFIED, WORST_FIRST, Evidence, criteria_table
from tvsbayes.report.fit_text import (
    LAPLACE_SHORT,
    assumed_stereo,
    failed,
    next_steps,
    validation_lines,
    verdict_line,
)
from tvsbayes.report.page import numbered
from tvsbayes.report.scanner_sections import fit_sections, uncertainty_sections
from tvsbayes.report.tables import (
    TableView,
    cause_in_words,
    chance_text,
    interval_text,
    sentence_in_words,
    sentences,
    two_digits,
)
from tvsbayes.results.estimates import Estimate, FitSummary

NO_CLASSIC = "not estimated"
ASYMMETRY_MAX = 1.5
"""Largest ratio of the distances of an interval's ends from the value for which half the interval is stated as U."""
CAUSES_LISTED = 3
"""Number of listed causes of a point's uncertainty; the section on budgets has all."""


def report_document(e: Evidence, issue: Issue | None = None) -> Document:
    """The report of a scanner with its number.

    Args:
        e: all data; nothing is computed here.
        issue: laboratory, customer and day; None: today, without names.
    """
    issue = issue or Issue.today()
    verification = [] if e.verified is None else [verified_section(e.verified)]
    return numbered(
        Document(
            results=e.fit.results_id,
            name=e.campaign.title,
            about=about_table(e.campaign.header, measured_days(e.campaign, issue), issue),
            verdict=verdict_of(e.fit.summary, e.criteria, e.doubts),
            numbers=point_errors(e),
            why=[*step_sizes(e), *error_sources(e)],
            answer=answer_table(e.fit.summary, e.classic),
            picture=both_estimators(e),
            steps=_steps(e),
            criteria=criteria_table(e.criteria),
            traceable=traceability(e.campaign).statement,
            warnings=warnings_of(e),
            versions=e.fit.provenance.shown_versions,
            sections=[*fit_sections(e), *verification, *uncertainty_sections(e)],
            issue=issue,
        )
    )


def verdict_of(summary: FitSummary, criteria: Sequence[Criterion], doubts: Sequence[str] = ()) -> Verdict:
    """The verdict of the page: whether its numbers may be used, and whether the limits are met.

    `doubts` are warnings of `check`.
    """
    if not summary.explained:
        return Verdict("NOT CONVERGED: the numbers below must not be used", "not-met")
    validation = failed(summary)
    failure = "" if validation is None else f"{validation_lines(validation)[0]}. "
    if not criteria:
        usable = verdict_line(summary).removeprefix("verdict: ") + "; see the warnings of check" * bool(doubts)
        return Verdict(f"{failure or f'{sentence(usable)} '}No limit was stated", "cannot-tell")
    judgements = []
    for verdict in WORST_FIRST:
        of_verdict = [c for c in criteria if c.verdict == verdict]
        for limit, unit in dict.fromkeys((c.limit, c.unit) for c in of_verdict):
            same_limit = [c for c in of_verdict if (c.limit, c.unit) == (limit, unit)]
            chances = [c.probability or 0.0 for c in same_limit]
            misses = COLOUR[verdict] == "not-met"
            bound = "" if len(same_limit) == 1 else "at most " if misses else "at least "
            worst = chance_text(max(chances) if misses else min(chances), bound)
            names = ", ".join(c.quantity for c in same_limit)
            judgements.append((verdict, f"{verdict}: {names} within {limit:.3g} {unit} (probability {worst})"))
    text, worst_verdict = "; ".join(judgement for _, judgement in judgements), judgements[0][0]
    if validation is not None:
        failure += "With that factor: " if validation.widens else "As fitted: "
    return Verdict(failure + text[0].upper() + text[1:], COLOUR[worst_verdict])


def measured_days(campaign: Campaign, issue: Issue) -> str:
    """The first and last day of a campaign; "" where unstated."""
    when = performed(campaign, issue.day)
    days = dict.fromkeys((when.begin.isoformat(), when.end.isoformat()))
    return " to ".join(days) if when.recorded else ""


def answer_table(summary: FitSummary, classic: ClassicResult | None, object_name: str = "the beam") -> TableView:
    """Ratios of the beam or sight, contrasts and both backlashes, with the classic ones where there are experiments.

    Ratios of both directions that are equal as printed share a row.
    """
    rows, extra = [], [NO_CLASSIC] if classic is not None else []
    for pair in SENSES.values():
        cells = [_cells(summary.effective[direction]) for direction in pair]
        if classic is None and cells[0] == cells[1]:
            rows.append([f"{' and '.join(pair)}, deg/step", *cells[0]])
            continue
        for direction, of_direction in zip(pair, cells, strict=True):
            four_point = None if classic is None else classic.directions[direction]
            classic_cell = "no experiment"
            if four_point is not None:
                mean = concise(four_point.mean_deg_per_step, four_point.u_gum_deg_per_step or 0.0)
                classic_cell = f"{mean}, n = {four_point.n}"
            rows.append([f"{direction}, deg/step", *of_direction, *[classic_cell] * len(extra)])
    for axis, pair in SENSES.items():
        if (contrast := summary.contrasts[axis]) is not None:
            rows.append([f"{' - '.join(pair)}, \u00b5deg/step", *_cells(scaled(contrast, 1e6)), *[""] * len(extra)])
    for axis in AXES:
        rows.append([f"backlash {axis}, deg", *_cells(summary.parameters[f"backlash_deg.{axis}"]), *extra])
    pose = summary.reference_pose_deg
    pose_text = f"pan {pose['pan']:.2f} deg, tilt {pose['tilt']:.2f} deg"
    caption = f"Degrees of {object_name} per motor step at {pose_text}, and play; U: half the 95 % interval"
    columns = ["", "joint value(u)", "95 % interval", "U, 95 %", *["classic value(u)"] * len(extra)]
    return TableView(caption, columns, rows)


def scaled(estimate: Estimate, factor: float) -> Estimate:
    """An estimate in another unit."""
    low, high = estimate.interval95
    return msgspec.structs.replace(
        estimate, value=factor * estimate.value, sd=factor * estimate.sd, interval95=(factor * low, factor * high)
    )


def _cells(estimate: Estimate | None) -> list[str]:
    """Value, interval and half of it; no half where the interval is asymmetric about the value."""
    if estimate is None:
        return ["never moved", "", ""]
    low, high = estimate.interval95
    near, far = sorted((estimate.value - low, high - estimate.value))
    half = two_digits(0.5 * (high - low)) if far <= ASYMMETRY_MAX * near or far == near else ""
    return [concise(estimate.value, estimate.sd), interval_text(low, high, estimate.sd), half]


def both_estimators(e: Evidence) -> FigureView:
    """Ratios of both estimators with their intervals; without experiments only the joint ones."""
    whose, caption = "both estimators", "Effective ratios, joint (circles) and classic (triangles)."
    if e.classic is None:
        whose = ""
        caption = "Effective ratios. The classic method needs four-point experiments: the campaign has none."
    alt = f"Ratios {f'of {whose} ' * bool(whose)}with 95 % intervals; values in the table beside it"
    return FigureView(figures.intervals(e.fit.summary, e.classic), alt, caption)


def point_errors(e: Evidence) -> list[Number]:
    """Errors of 3D points at the stated range, by estimator."""
    limits = {name: float(np.quantile(v, 0.95)) for name, v in e.distances_mm.items()}
    note = f"95 % of 3D errors {e.range_mm:g} mm away stay below this"
    return [Number(f"{name} calibration", _mm(limits[name]), note) for name in ESTIMATOR_STYLE if name in limits]


def step_sizes(e: Evidence) -> list[str]:
    """What one step moves the spot by at the stated range, across the beam; empty without a fit."""
    sizes = []
    for axis in AXES if e.fit.summary.explained else ():
        ratios = [ratio for side in SENSES[axis] if (ratio := e.fit.summary.effective[side]) is not None]
        if ratios:
            mm = e.range_mm * math.radians(sum(abs(ratio.value) for ratio in ratios) / len(ratios))
            u_mm = e.range_mm * math.radians(max(ratio.sd for ratio in ratios))
            sizes.append(f"{concise(mm, u_mm)} mm in {axis}")
    about = f"At {e.range_mm:g} mm one step moves the spot by about {' and '.join(sizes)}, across the beam."
    return [about] if sizes else []


def error_sources(e: Evidence) -> list[str]:
    """What errors in mm rest on; causes of the joint calibration's error, and of the last simple calibration's."""
    order = np.argsort(-e.budget.share)[:CAUSES_LISTED]
    causes = ", ".join(f"{cause_in_words(e.budget.causes[k])} {100 * e.budget.share[k]:.0f} %" for k in order)
    return [
        *([] if e.campaign.aperture_read else [sentences("sections")["no_aperture"]]),
        f"Causes of the remaining error of the joint one, as shares of the variance: {causes}.",
        *(
            f"Error of {name} there: its beam points {error.azimuth_deg:+.2f} deg in azimuth and "
            f"{error.elevation_deg:+.2f} deg in elevation from the joint one (ratios, lost motion, mirrors), which "
            f"alone makes {_mm(error.by_direction_mm)}; where it takes beam and aperture to stand, and the aperture's "
            f"zero, alone make {_mm(error.by_place_mm)}."
            for name, error in list(e.simple_errors.items())[-1:]
        ),
    ]


def _mm(value: float) -> str:
    if not np.isfinite(value):
        return "no point at all"
    return f"{two_digits(value)} mm" if value < 100 else f"{value:.0f} mm"


def warnings_of(e: Evidence) -> list[str]:
    """Warnings for the user of the numbers, besides the verdict and the next steps."""
    summary, assumed = e.fit.summary, assumed_stereo(e.campaign.stereo, e.shown.budgets)
    synthetic = "The campaign is synthetic: made by the digital twin, not measured."
    return [
        *summary.problems,
        *([LAPLACE_SHORT] if summary.estimator == "laplace" else []),
        *([synthetic] if e.campaign.header.get("synthetic") else []),
        *([] if assumed is None else [sentence(assumed)]),
        *labelled("Prior conflict", map(sentence_in_words, summary.prior_conflicts)),
        *labelled("`check` warns", map(sentence_in_words, e.doubts)),
    ]


def _steps(e: Evidence) -> list[str]:
    """Next steps: those of the fit, then the best of a plan; the plan's own section has all."""
    folder = "CAMPAIGN" if e.campaign.path is None else typed(e.campaign.path.resolve().name)
    summary = e.fit.summary
    causes = () if summary.explained else misfit_causes(e.campaign, summary.parameters["pixel_scale"].value)
    steps = next_steps(summary, folder, causes)
    if e.planned is not None and not e.planned.stop.now and e.planned.next:
        best = e.planned.next[0]
        steps.append(f"Look at {best.text} ({best.minutes:.1f} min): the best next four looks of the plan.")
    unmet = next((c for c in e.criteria if c.verdict not in SATISFIED), None)
    if unmet is not None and e.planned is None and summary.explained:
        limit = f"{unmet.limit:g} {unmet.unit}"
        goal = f"U95(worst) <= {limit}" if unmet.unit != "mm" else f"U95(x) at {e.range_mm:g},0,0 mm <= {limit}"
        has_rig = e.campaign.path is not None and (e.campaign.path / "rig.toml").is_file()
        command = f"`tvsbayes plan {f'{folder}/rig.toml' if has_rig else 'RIG'} --given {folder} --target '{goal}'`"
        steps.append(f"Add looks until the limit is met; the fewest: {command}.")
    if not steps:
        steps.append("Nothing: use the calibration, and repeat it when the instrument was moved, opened or dropped.")
    if not e.criteria and summary.converged:
        limit = f"`tvsbayes report {folder} --limit-mm 5`, or `--limit-deg-per-step 0.0005`"
        steps.append(f"State the largest permissible error; the page then says whether it is met: {limit}.")
    return steps
