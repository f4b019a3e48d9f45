"""A fit in words: verdict, remarks and next steps, shared by terminal and page; ratios in deg/step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby

from tvsbayes.display import concise
from tvsbayes.errors import NotConverged, listed
from tvsbayes.estimators.findings import Finding
from tvsbayes.estimators.four_point import ClassicResult
from tvsbayes.instrument.axes import AXES, DIRECTIONS
from tvsbayes.instrument.parameters import QUANTITIES, REGISTRY, STEREO_PARAMETER_NAMES
from tvsbayes.instrument.stereo_pair import ASSUMED_REMEDY, Stereo
from tvsbayes.report.document import Part, labelled, sentence, terminal
from tvsbayes.report.result_tables import (
    KEY_PARAMETERS,
    MORE_PARAMETERS,
    classic_table,
    details_table,
    gears_table,
    headline_table,
    outlier_lines,
    range_text,
    rig_waves_table,
)
from tvsbayes.report.tables import TableView, sentence_in_words, sentences
from tvsbayes.results.convergence import Importance, Sampling
from tvsbayes.results.estimates import Estimate, FitSummary, LostMotion, Validation, WeakDirection, varies_beyond
from tvsbayes.results.metrology_tables import BudgetTable
from tvsbayes.results.records import Tier
from tvsbayes.results.tiers import CHAIN

FINE_DEG = 1e-5
"""Size of a step of an encoder in `importing.sightings`; motor steps are much larger."""
SPOTS_LISTED = 20
"""Largest number of listed ids of spots that disagree."""
SHARE_NAMED = 0.05
"""Least share of a variance for naming its cause."""
USUAL_SCALE = (0.5, 2.0)
"""Range of the estimated over the stated pixel noise without a remark."""
LAPLACE_SHORT = "Intervals are those of the Laplace approximation: too short for a backlash seen at few stops."
UNSAMPLED = (
    "usable with care: the posterior could not be sampled; the table is the Laplace approximation, whose intervals are "
    "up to a quarter too short"
)
ROUGH = "usable, but rough: see the Monte Carlo error"
"""On 900 simulated campaigns its 95 % intervals of play contain the truth in 89 %, all others in 92 to 96 %
(experiments/intervals): a normal interval of 89 % is 1.6 sd wide instead of 1.96."""


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
    if (validation := failed(summary)) is not None:
        # Lines above and below the table are visible at both ends of the text.
        tests = validation_lines(validation)
        lines = [tests[0], *lines, *tests[1:], f"what helps: {remedy(validation)}"]
    excluded = ", ".join(map(str, summary.excluded_spots))
    lines += [
        *answer_lines(summary),
        None if summary.sampling is None else agreement_line(summary.sampling, summary.tier),
        few_stops_line(summary.few_stops, summary.estimator) if summary.few_stops else None,
        *homing_lines(summary),
        *labelled("not separated", [weak.text for weak in summary.weak_directions if weak.of_sums]),
        *labelled("prior conflict", summary.prior_conflicts),
        f"excluded {summary.looks}: {excluded}" if excluded else None,
        f"{suspect_line(summary)}; look at them, or fit with --robust" if summary.suspect_spots else None,
        # Where the model fails, the residual scatter is not noise.
        noise_line(summary) if validation is None else None,
        *labelled("doubt", play_lines(summary)),
        encoder_line(summary),
        f"written: {', '.join(written)}" if written else None,
        None if details else more_line(summary),
    ]
    shown = [line for line in lines if line is not None]
    return terminal(*shown, "" if shown else None, headline_table(summary), verdict_line(summary))


def failed(summary: FitSummary) -> Validation | None:
    """The validation if it failed, else None."""
    validation = summary.validation
    return None if validation is None or validation.passed else validation


def remedy(validation: Validation) -> str:
    """The remedy of the defect that explains the residuals best."""
    cause, remedies = validation.tests[0].name if validation.tests else "", sentences("failed_test")
    return next(str(text) for test_name, text in remedies.items() if cause.startswith(test_name))


def factor_text(validation: Validation) -> str:
    """The effect of a failed validation on every u; the factor is 1 where no result would change."""
    if validation.widens:
        return f"multiply every u and half-width by {validation.inflation:.2f}"
    return "no factor on u covers it"


def verdict_line(summary: FitSummary) -> str:
    """Whether the numbers of a fit may be used, in one line."""
    if not summary.explained:
        return "verdict: NOT CONVERGED, use none of these numbers"
    if (validation := failed(summary)) is not None:
        looks = summary.looks
        only_looks = not validation.widens and validation.cause.startswith(f"single {looks} disagree")
        helps = f": look at those {looks}, or fit with --robust" * only_looks
        return f"verdict: VALIDATION FAILED, {factor_text(validation)}{helps}"
    tests = () if summary.validation is None else summary.validation.tests
    if not summary.converged:
        verdict = UNSAMPLED
    elif summary.answer == "rough":
        verdict = ROUGH
    elif not tests:
        verdict = f"usable; too few {summary.looks} to look for model errors"
    else:
        verdict = f"usable; no sign of a model error in {len(tests)} tests (least p {tests[0].p:.2g})"
    unmoved = ", ".join(d for d in DIRECTIONS if (e := summary.effective[d]) is not None and not e.informed)
    return f"verdict: {verdict}" + (f"; the data do not determine {unmoved}" if unmoved else "")


def noise_line(summary: FitSummary) -> str | None:
    """A remark on pixel noise far from the stated one; None where it is close."""
    scale = summary.parameters["pixel_scale"].value
    if USUAL_SCALE[0] <= scale <= USUAL_SCALE[1]:
        return None
    stated = {"spots": "su and sv of spots.csv say", "sightings": "u_deg of sightings.csv says"}[summary.looks]
    return (
        f"the {summary.looks} scatter {scale:.2g} times as much as {stated}; the fit allows for it: state "
        f"{'larger' if scale > 1 else 'smaller'} ones if you know them"
    )


def play_lines(summary: FitSummary) -> list[str]:
    """Remarks on plays that vary by more than themselves."""
    lines = []
    for axis in AXES:
        names = (f"backlash_deg.{axis}", f"play_variation_deg.{axis}")
        play, variation = map(summary.parameters.get, names)
        if play is not None and variation is not None and varies_beyond(variation, play):
            lines.append(
                f"the play of {axis} varies by {concise(variation.value, variation.sd)} deg (sd), more than the play "
                f"itself, {concise(play.value, play.sd)}, and no play is negative: the {summary.looks} have errors "
                "that depend on counter and side, or steps were lost"
            )
    return lines


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


def more_line(summary: FitSummary) -> str | None:
    """Further contents of --details and the report; None where there are none."""
    counts = {
        ("weak direction", "weak directions"): sum(not weak.of_sums for weak in summary.weak_directions),
        ("stop that decides a result", "stops that decide a result"): len(summary.leverage),
        ("prior that matters", "priors that matter"): len({entry.parameter for entry in summary.prior_sensitivity}),
    }
    phrases = [f"{n} {one if n == 1 else several}" for (one, several), n in counts.items() if n]
    return f"--details and the report say more: {', '.join(phrases)}" if phrases else None


def detail_lines(summary: FitSummary) -> list[Part]:
    """Details of a fit: the positioner, the gears, tests, influential priors, weak directions."""
    gears, validation, sampling = gears_table(summary), summary.validation, summary.sampling
    predicted = _values(summary.classic_predicted)
    return [
        details_table(summary),
        rig_waves_table(summary),
        gears,
        *([] if gears is None else gear_lines(summary)),
        f"chi2 {summary.noise.chi2:.1f} for {summary.noise.dof:.1f} degrees of freedom",
        *(validation_lines(validation) if validation is not None and validation.passed else []),
        f"the classic estimator should report, deg/step: {predicted}" if predicted else None,
        sampling_line(sampling) if sampling is not None and sampling.converged else None,
        *([] if summary.curves is None else lost_motion_lines(summary.curves.lost_motion)),
        *(
            f"prior: with {'twice' if entry.factor > 1 else 'half'} the u of {entry.parameter}, {entry.quantity} moves "
            f"{entry.shift_sd:+.2f} sd and its sd changes by a factor {entry.sd_ratio:.2f}"
            for entry in summary.prior_sensitivity
        ),
        *labelled(
            "weak (set by the priors, not by the data)",
            dict.fromkeys(weak.text for weak in summary.weak_directions if not weak.of_sums),
        ),
        *labelled("depends on one stop", [entry.text for entry in summary.leverage]),
    ]


def _values(estimates: Mapping[str, Estimate | None]) -> str:
    return ", ".join(f"{d} {concise(e.value, e.sd)}" for d, e in estimates.items() if e is not None)


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
    local = _values(summary.local)
    return lines + [f"local ratios, without errors of the gears, deg/step: {local}"] * bool(local)


def unconverged_text(summary: FitSummary, causes: Sequence[Finding] = ()) -> str:
    """A fit that did not converge: its last values without uncertainty, and the causes."""
    names = [name for name in (*KEY_PARAMETERS, *MORE_PARAMETERS) if name in summary.parameters]
    rows = [
        [quantity.label, f"{summary.parameters[quantity.name].value:.4g}", quantity.unit_text]
        for quantity in map(QUANTITIES.__getitem__, names)
    ]
    return terminal(
        NotConverged.of(summary.problems, "").message,
        TableView("where the fit stopped: NOT results", ["quantity", "value", "unit"], rows),
        suspect_line(summary) if summary.suspect_spots else None,
        *labelled("cause", [finding.message for finding in causes]),
    )


def suspect_line(summary: FitSummary) -> str:
    """Looks that disagree with the others, at most `SPOTS_LISTED` ids."""
    return f"{summary.looks} that disagree with all others: {listed(summary.suspect_spots, SPOTS_LISTED)}"


def few_stops_line(counts: Mapping[str, int], estimator: str) -> str:
    """The effect of few stops of a direction on its intervals."""
    effect = ", and the Laplace intervals of ratio and backlash are too short; sample the posterior (`tvsbayes fit`), "
    effect += "or add stops"
    if estimator == "posterior":
        effect = "; the intervals include this, more stops would shorten them"
    counts_text = ", ".join(f"{direction} {count}" for direction, count in counts.items())
    return f"few stops ({counts_text}): too few to estimate their scatter{effect}"


def validation_lines(validation: Validation) -> list[str]:
    """Result of the validation: one line where it passed, else the warning and every failed test."""
    tests = validation.tests
    if not tests and validation.passed:
        return ["validation: too few looks to test for model errors"]
    if validation.passed:
        return [
            f"validation: no sign of a model error in {len(tests)} tests, least p {tests[0].p:.2g} ({tests[0].name}); "
            "errors of the same shape as those of gears, mirrors and play are not detected"
        ]
    return [
        f"VALIDATION FAILED: {validation.cause} (p {tests[0].p:.1e}); the table is as fitted, "
        f"{factor_text(validation)}",
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
        return "" if sampling.importance is None else importance_line(sampling.importance)
    return (
        f"{sampling.walkers} walkers, {sampling.steps} steps ({sampling.discarded} left out); worst R-hat "
        f"{rhat.value:.3f} ({rhat.quantity}), least effective draws {ess.value:.0f} ({ess.quantity}) and "
        f"{tail.value:.0f} in the tails ({tail.quantity})"
    )


def answer_lines(summary: FitSummary) -> list[str]:
    """Why an answer is not accepted, and the remedy; none for an accepted one."""
    if summary.sampling is None or not summary.sampling.missing:
        return []
    lines = labelled("rough" if summary.converged else "not sampled", summary.sampling.missing)
    lines.append(sampling_line(summary.sampling))
    if summary.converged and summary.monte_carlo_error:
        name, error = max(summary.monte_carlo_error.items(), key=lambda error: error[1].rounds_factor)
        ends = " and ".join(f"{end:.2f}" for end in error.interval95)
        largest = f"{error.mean:.2f} sd of the mean, {ends} sd of the interval's ends ({name})"
        lines.append(f"Monte Carlo error, largest: {largest}")
    weighted = summary.sampling.steps is None
    return [*lines, f"what helps: fit {'without --quick, or ' * weighted}with --resume and more --max-minutes"]


def importance_line(importance: Importance) -> str:
    """Diagnosis of importance sampling, in one line."""
    least, worst = importance.least_ess, importance.worst_pareto_k
    return (
        f"importance sampling: {importance.draws} draws, {100 * importance.effective_share:.0f} % effective, at least "
        f"{least.value:.0f} for a result ({least.quantity}); Pareto k {importance.pareto_k:.2f}, of results at most "
        f"{worst.value:.2f}"
    )


def agreement_line(sampling: Sampling, tier: Tier | None) -> str | None:
    """Whether chain and importance sampling agree; None without a chain."""
    if sampling.importance is None or (sampling.steps is None and sampling.agreement is None):
        return None
    if sampling.agreement is None:
        return "importance sampling was not accepted: results are those of the chain"
    words = "agree on every result" if sampling.agreement.agrees else "DISAGREE"
    worst = sampling.agreement.worst
    return (
        f"{tier or CHAIN} and importance sampling {words}: the largest difference is {worst.value:.1f} Monte Carlo "
        f"errors ({worst.quantity})"
    )


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
        return "-" if interval is None else "yes" if interval[0] <= true <= interval[1] else "NO"

    rows = []
    for direction in DIRECTIONS:
        c, j = classic_result.directions[direction], summary.effective[direction]
        if c is not None and j is not None:
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


def assumed_stereo(stereo: Stereo | None, budgets: Sequence[BudgetTable]) -> str | None:
    """Shares of an assumed stereo covariance in the results' variances, and its remedy; None for an estimated one."""
    if stereo is None or not stereo.assumed:
        return None
    cause, parts = REGISTRY[STEREO_PARAMETER_NAMES[0]].cause, dict[str, list[str]]()
    for table in budgets:
        quantity = QUANTITIES.get(table.quantity)
        named = quantity is not None and quantity.words
        words, part = (quantity.words, " ".join(quantity.parts)) if quantity and named else (table.quantity, "")
        for row in table.rows:
            if row.quantity == cause and row.share >= SHARE_NAMED:
                parts.setdefault(f"{100 * row.share:.0f} % of the variance of {words}", []).append(part)
    shares = [f"{share} ({', '.join(named)})" if any(named) else share for share, named in parts.items()]
    origin = f" (from {stereo.assumed_from})" if stereo.assumed_from else ""
    text = f"the stereo covariance is assumed, not estimated{origin}"
    if not budgets:
        return text
    if not shares:
        return f"{text}: less than {100 * SHARE_NAMED:.0f} % of the variance of every result comes from it"
    return f"{text}: it makes {', '.join(shares)}; what lowers it: {ASSUMED_REMEDY}"


def next_steps(summary: FitSummary, folder: str, causes: Sequence[Finding] = ()) -> list[str]:
    """The next steps, most urgent first, for the page of the campaign in `folder`.

    `causes` explain a failed fit.
    """
    if not summary.explained:
        return [f"Use none of the numbers: {finding.sentence}." for finding in causes] or [
            "Use none of the numbers. See what `tvsbayes check` warns of, look for swapped cameras, wrong counters "
            "and pictures of another size, then fit again.",
        ]
    steps, validation = [], failed(summary)
    if validation is not None:
        steps.append(f"{validation.cause}: {remedy(validation)}.")
    if summary.suspect_spots and (validation is None or f"single {summary.looks}" not in validation.cause):
        ids = listed(summary.suspect_spots, SPOTS_LISTED)
        steps.append(
            f"Look at {summary.looks} {ids}, which disagree with all others, or fit with --robust, which leaves them "
            "out."
        )
    if summary.few_stops:
        directions = ", ".join(f"{direction} ({count})" for direction, count in summary.few_stops.items())
        steps.append(f"Add stops reached by moving {directions}: too few to estimate their scatter.")
    if summary.estimator == "laplace":
        steps.append(f"Sample the posterior, which takes minutes: `tvsbayes fit {folder}`, then make the report again.")
    texts = [weak.text for weak in summary.weak_directions if asks_for_looks(weak)]
    return steps + [sentence(sentence_in_words(text)) for text in texts]


def asks_for_looks(weak: WeakDirection) -> bool:
    """Whether a weak direction recommends looks: these are among the next steps."""
    return "looks at" in weak.text
