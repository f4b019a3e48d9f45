"""A fit as text for a terminal: its table and all remarks, shared with the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby

from tvsbayes.display import concise
from tvsbayes.errors import NotConverged, listed
from tvsbayes.estimators.findings import Finding
from tvsbayes.estimators.four_point import ClassicResult
from tvsbayes.instrument.axes import AXES, DIRECTIONS
from tvsbayes.instrument.parameters import QUANTITIES
from tvsbayes.report.advice import SPOTS_LISTED, factor_text, failed, noise_line, play_lines, remedy, verdict_line
from tvsbayes.report.document import Part, terminal
from tvsbayes.report.result_tables import (
    KEY_PARAMETERS,
    MORE_PARAMETERS,
    classic_table,
    details_table,
    gears_table,
    headline_table,
    outlier_lines,
    range_text,
    waves_table,
)
from tvsbayes.report.tables import TableView
from tvsbayes.results.convergence import Importance, Sampling
from tvsbayes.results.estimates import FitSummary, LostMotion, Validation
from tvsbayes.results.records import Tier
from tvsbayes.results.tiers import CHAIN

FINE_DEG = 1e-5
"""Size of a step of an encoder in `importing.sightings`; motor steps are much larger."""
PARAMETERS = (*KEY_PARAMETERS, *MORE_PARAMETERS)


def classic_text(result: ClassicResult) -> str:
    """The classic estimator's table, experiments that make an sd, and those that it left out."""
    skipped = [f"experiment {s.name} skipped: {s.reason}" for s in result.skipped]
    return terminal(classic_table(result), *outlier_lines(result), *skipped)


def fit_text(
    summary: FitSummary, details: bool = False, written: Sequence[str] = (), causes: Sequence[Finding] = ()
) -> str:
    """Remarks, the table, and one line of verdict at the end, where it stays visible on a terminal.

    Args:
        summary: the fit.
        details: also show the positioner, the gears, influential priors, weak directions, single stops.
        written: files with all results.
        causes: explanations of a failed fit.
    """
    if not summary.explained:
        return unconverged_text(summary, causes)
    lines: list[Part] = detail_lines(summary) if details else []
    validation = failed(summary)
    if validation is not None:
        # Lines above and below the table are visible at both ends of the text.
        tests = validation_lines(validation)
        lines = [tests[0], *lines, *tests[1:], f"what helps: {remedy(validation)}"]
    lines += answer_lines(summary)
    if summary.sampling is not None and (agreement := agreement_line(summary.sampling, summary.tier)) is not None:
        lines.append(agreement)
    if summary.few_stops:
        lines.append(few_stops_line(summary.few_stops, summary.estimator))
    lines += homing_lines(summary)
    lines += [f"not separated: {weak.text}" for weak in summary.weak_directions if weak.of_sums]
    lines += [f"prior conflict: {text}" for text in summary.prior_conflicts]
    if summary.excluded_spots:
        lines.append(f"excluded {summary.looks}: {', '.join(map(str, summary.excluded_spots))}")
    if summary.suspect_spots:
        lines.append(f"{suspect_line(summary)}; look at them, or fit with --robust")
    # Where the model fails, the residual scatter is not noise.
    if failed(summary) is None and (noise := noise_line(summary)) is not None:
        lines.append(noise)
    lines += [f"doubt: {line}" for line in play_lines(summary)]
    if (encoder := encoder_line(summary)) is not None:
        lines.append(encoder)
    if written:
        lines.append(f"written: {', '.join(written)}")
    if not details and (more := more_line(summary)):
        lines.append(more)
    return terminal(*lines, "" if lines else None, headline_table(summary), verdict_line(summary))


def encoder_line(summary: FitSummary) -> str | None:
    """Ratio per degree of an encoder, whose steps are too small for the table; None for motors."""
    ratios = {axis: summary.parameters.get(f"degrees_per_step.{axis}") for axis in AXES}
    texts = [
        f"{axis} by {concise(ratio.value / FINE_DEG, ratio.sd / FINE_DEG)} deg"
        for axis, ratio in ratios.items()
        if ratio is not None and 0 < abs(ratio.value) < 10 * FINE_DEG
    ]
    counts = f"{1 / FINE_DEG:.0f} counts, 1 deg of angles as `import` takes them,"
    return f"{counts} turn {' and '.join(texts)}" if texts else None


def more_line(summary: FitSummary) -> str:
    """Further contents of --details and the report; "" where there are none."""
    counts = {
        "weak direction": sum(not weak.of_sums for weak in summary.weak_directions),
        "stop that decides a result": len(summary.leverage),
        "prior that matters": len({entry.parameter for entry in summary.prior_sensitivity}),
    }
    plural = {
        "stop that decides a result": "stops that decide a result",
        "prior that matters": "priors that matter",
    }
    phrases = [f"{n} {name if n == 1 else plural.get(name, name + 's')}" for name, n in counts.items() if n]
    return f"--details and the report say more: {', '.join(phrases)}" if phrases else ""


def detail_lines(summary: FitSummary) -> list[Part]:
    """Details of a fit: the positioner, the gears, tests, influential priors, weak directions."""
    details = details_table(summary)
    # A head with sightings has no camera frame.
    lines: list[Part] = [details] if details.rows else []
    if (waves := waves_table(summary)) is not None:
        lines.append(waves)
    if (gears := gears_table(summary)) is not None:
        lines += [gears, *gear_lines(summary)]
    lines.append(f"chi2 {summary.noise.chi2:.1f} for {summary.noise.dof:.1f} degrees of freedom")
    if summary.validation is not None and summary.validation.passed:
        lines += validation_lines(summary.validation)
    classic_texts = [f"{d} {concise(e.value, e.sd)}" for d, e in summary.classic_predicted.items() if e is not None]
    if classic_texts:
        lines.append(f"the classic estimator should report, deg/step: {', '.join(classic_texts)}")
    if summary.sampling is not None and summary.sampling.converged:
        lines.append(sampling_line(summary.sampling))
    if summary.curves is not None:
        lines += lost_motion_lines(summary.curves.lost_motion)
    for entry in summary.prior_sensitivity:
        word = "twice" if entry.factor > 1 else "half"
        lines.append(
            f"prior: with {word} the u of {entry.parameter}, {entry.quantity} moves {entry.shift_sd:+.2f} sd and its "
            f"sd changes by a factor {entry.sd_ratio:.2f}"
        )
    weak_texts = dict.fromkeys(weak.text for weak in summary.weak_directions if not weak.of_sums)
    lines += [f"weak (set by the priors, not by the data): {text}" for text in weak_texts]
    lines += [f"depends on one stop: {entry.text}" for entry in summary.leverage]
    return lines


def homing_lines(summary: FitSummary) -> list[str]:
    """Probabilities of unrecorded homing sides."""
    lines = []
    for axis, chances in summary.homing_side.items():
        ordered = sorted(chances.items(), key=lambda item: -item[1])
        sides = ", ".join(f"{side} {100 * chance:.1f} %" for side, chance in ordered)
        lines.append(f"{axis} homing side, not recorded: {sides}")
    return lines


def gear_lines(summary: FitSummary) -> list[str]:
    """Range of effective ratios, which include errors of the gears, and the local ratios without them."""
    lines = [f"effective ratios are slopes of lines through the looks, {range_text(summary)}; elsewhere errors differ"]
    local = [f"{d} {concise(e.value, e.sd)}" for d, e in summary.local.items() if e is not None]
    return lines + [f"local ratios, without errors of the gears, deg/step: {', '.join(local)}"] * bool(local)


def unconverged_text(summary: FitSummary, causes: Sequence[Finding] = ()) -> str:
    """A fit that did not converge: its last values without uncertainty, and the causes."""
    quantities = (QUANTITIES[name] for name in PARAMETERS if name in summary.parameters)
    rows = [[q.label, f"{summary.parameters[q.name].value:.4g}", q.unit_text] for q in quantities]
    table = TableView("where the fit stopped: NOT results", ["quantity", "value", "unit"], rows)
    suspects = suspect_line(summary) if summary.suspect_spots else None
    message = NotConverged.of(summary.problems, "").message
    return terminal(message, table, suspects, *(f"cause: {finding.message}" for finding in causes))


def suspect_line(summary: FitSummary) -> str:
    """Looks that disagree with the others, at most `SPOTS_LISTED` ids."""
    return f"{summary.looks} that disagree with all others: {listed(summary.suspect_spots, SPOTS_LISTED)}"


def few_stops_line(counts: Mapping[str, int], estimator: str) -> str:
    """The effect of few stops of a direction on its intervals."""
    counts_text = ", ".join(f"{direction} {count}" for direction, count in counts.items())
    sentence = f"few stops ({counts_text}): too few to estimate their scatter"
    if estimator == "posterior":
        return f"{sentence}; the intervals include this, more stops would shorten them"
    sentence += ", and the Laplace intervals of ratio and backlash are too short"
    return f"{sentence}; sample the posterior (`tvsbayes fit`), or add stops"


def validation_lines(validation: Validation) -> list[str]:
    """Result of the validation: one line where it passed, else the warning and every failed test."""
    tests = validation.tests
    if validation.passed:
        if not tests:
            return ["validation: too few looks to test for model errors"]
        least = f"least p {tests[0].p:.2g} ({tests[0].name})"
        return [
            f"validation: no sign of a model error in {len(tests)} tests, {least}; errors of the same shape as "
            "those of gears, mirrors and play are not detected"
        ]
    warning = f"VALIDATION FAILED: {validation.cause} (p {tests[0].p:.1e}); the table is as fitted, "
    warning += factor_text(validation)
    return [
        warning,
        *(
            f"validation: {t.name}, {t.where}: chi2 {t.chi2:.1f} for {t.dof}, p {t.p:.1e}; would move a result by "
            f"{t.shift_sd:.1f} of its u"
            for t in tests
            if t.failed
        ),
    ]


def sampling_line(sampling: Sampling) -> str:
    """Diagnosis of a posterior's draws, in one line."""
    rhat, ess, tail = sampling.worst_rhat, sampling.least_ess_bulk, sampling.least_ess_tail
    if rhat is None:
        text = "" if sampling.importance is None else importance_line(sampling.importance)
    else:
        text = f"{sampling.walkers} walkers, {sampling.steps} steps ({sampling.discarded} left out); worst R-hat "
        text += f"{rhat.value:.3f} ({rhat.quantity}), least effective draws {ess.value:.0f} "
        text += f"({ess.quantity}) and {tail.value:.0f} in the tails ({tail.quantity})"
    return text


def answer_lines(summary: FitSummary) -> list[str]:
    """Why an answer is not accepted, and the remedy; none for an accepted one."""
    if summary.sampling is None or not summary.sampling.missing:
        return []
    lines = [f"{'rough' if summary.converged else 'not sampled'}: {text}" for text in summary.sampling.missing]
    lines.append(sampling_line(summary.sampling))
    if summary.converged and summary.monte_carlo_error:
        worst = max(summary.monte_carlo_error.items(), key=lambda error: error[1].rounds_factor)
        ends = " and ".join(f"{error:.2f}" for error in worst[1].interval95)
        largest = f"{worst[1].mean:.2f} sd of the mean, {ends} sd of the interval's ends ({worst[0]})"
        lines.append(f"Monte Carlo error, largest: {largest}")
    weighted = summary.sampling.steps is None
    return [*lines, f"what helps: fit {'without --quick, or ' * weighted}with --resume and more --max-minutes"]


def importance_line(importance: Importance) -> str:
    """Diagnosis of importance sampling, in one line."""
    least, worst = importance.least_ess, importance.worst_pareto_k
    text = f"importance sampling: {importance.draws} draws, {100 * importance.effective_share:.0f} % effective, "
    text += f"at least {least.value:.0f} for a result ({least.quantity}); "
    return f"{text}Pareto k {importance.pareto_k:.2f}, of results at most {worst.value:.2f}"


def agreement_line(sampling: Sampling, tier: Tier | None) -> str | None:
    """Whether chain and importance sampling agree; None without a chain."""
    if sampling.importance is None or (sampling.steps is None and sampling.agreement is None):
        return None
    if sampling.agreement is None:
        return "importance sampling was not accepted: results are those of the chain"
    words = "agree on every result" if sampling.agreement.agrees else "DISAGREE"
    worst = sampling.agreement.worst
    text = f"{tier or CHAIN} and importance sampling {words}: the largest difference is"
    return f"{text} {worst.value:.1f} Monte Carlo errors ({worst.quantity})"


def first_text(summary: FitSummary, tier: Tier) -> str:
    """Results of importance sampling while the chain of a tier runs."""
    sampling = summary.sampling
    if sampling is None or sampling.importance is None:
        return ""
    if not sampling.converged:
        return f"importance sampling has no answer: {'; '.join(sampling.missing)}; {tier} goes on ..."
    return terminal(headline_table(summary), f"{importance_line(sampling.importance)}; {tier} goes on ...")


def lost_motion_lines(motions: Mapping[str, Sequence[LostMotion]]) -> list[str]:
    """Lost motion after a reversal, for the step counts of the campaign."""
    lines = []
    for direction, entries in motions.items():
        parts = []
        for text, group in groupby(entries, lambda e: concise(e.value_deg, e.sd_deg)):
            steps = [e.steps for e in group]
            parts.append(f"{steps[0]} {f'to {steps[-1]} ' * (len(steps) > 1)}steps {text}")
        lines.append(f"lost motion {direction}, deg: {', '.join(parts)}")
    return lines


def demo_text(classic_result: ClassicResult, summary: FitSummary, truth: dict[str, float]) -> str:
    """Both estimators compared with the truth of a simulated campaign."""

    def holds(interval: tuple[float, float] | None, true: float) -> str:
        return "-" if interval is None else ("yes" if interval[0] <= true <= interval[1] else "NO")

    rows = []
    for direction in DIRECTIONS:
        c, j = classic_result.directions[direction], summary.effective[direction]
        if c is None or j is None:
            continue
        true = truth[direction]
        classic_cell = concise(c.mean_deg_per_step, c.u_type_a_deg_per_step or 0.0)
        cells = [direction, classic_cell, holds(c.interval95_type_a, true), concise(j.value, j.sd)]
        rows.append([*cells, holds(j.interval95, true), f"{true:.6f}"])
    columns = ["deg/step", "classic, type A", "holds truth", "joint", "holds truth", "truth"]
    ratios = TableView("degrees of beam per motor step, value(u)", columns, rows)
    rows = []
    for q in (QUANTITIES[name] for name in KEY_PARAMETERS if name in truth):
        e, true = summary.parameters[q.name], truth[q.name]
        cells = [concise(e.value, e.sd), holds(e.interval95, true), f"{true:.4f}"]
        rows.append([f"{q.label}, {q.unit_text}", *cells])
    others = TableView("what the classic estimator cannot see", ["", "joint", "holds truth", "truth"], rows)
    return terminal(ratios, "", others)
