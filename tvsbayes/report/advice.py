"""Advice on a fit: its verdict in one line, causes and remedies of a failed validation, next steps.

Shared by the terminal and the page; ratios in deg/step.
"""

from __future__ import annotations

from collections.abc import Sequence

from tvsbayes.display import concise
from tvsbayes.errors import listed
from tvsbayes.estimators.findings import Finding
from tvsbayes.instrument.axes import AXES, DIRECTIONS
from tvsbayes.instrument.parameters import QUANTITIES, REGISTRY, STEREO_PARAMETER_NAMES
from tvsbayes.instrument.stereo_pair import ASSUMED_REMEDY, Stereo
from tvsbayes.report.document import sentence
from tvsbayes.report.parameter_words import sentence_in_words
from tvsbayes.results.estimates import FitSummary, Validation, WeakDirection, varies_beyond
from tvsbayes.results.metrology_tables import BudgetTable

LOOKS = ("spots", "sightings")
"""What looks are called, by instrument."""
SPOTS_REMEDY = "look at those {looks}, or fit with --robust"
"""Remedy for single spots that disagree, which no factor on u covers."""
REMEDIES = {
    "the cameras moved": "fix the cameras and measure again, or fit the looks before and after as two campaigns",
    "the cameras drifted": "let cameras and mount warm up for half an hour and measure again in less time",
    "one camera moved": "fix the cameras to one stiff bar, calibrate the pair again (`tvsbayes stereo`), measure again",
    "a ratio drifted": "look for a slipping belt or coupling and for motors that grow warm; measure again",
    "steps were lost": "drive slower or with more current, home more often, and measure again",
    "the gears have a transmission error": "state its period in [rig] and fit with --harmonics, or visit more counters",
    "stops depend on the step phase": "use full steps, or more current: microsteps are not even",
    "stops depend on the length": "let the axis settle longer before each look, or arrive by moves of one length",
    "the sheets disagree": "check that every sheet is flat, stands still and has the right name in spots.csv",
    **{
        f"single {looks} disagree": f"{SPOTS_REMEDY.format(looks=looks)}, which leaves them out by name"
        for looks in LOOKS
    },
}
"""Remedies by the beginning of the failed test's name."""
ANY_REMEDY = "find the cause in the section Validation of the report, correct it and measure again"
SPOTS_LISTED = 20
"""Largest number of listed ids of spots that disagree."""
SHARE_NAMED = 0.05
"""Least share of a variance for naming its cause."""
USUAL_SCALE = (0.5, 2.0)
"""Range of the estimated over the stated pixel noise without a remark."""


def remedy(validation: Validation) -> str:
    """The remedy of the defect that explains the residuals best."""
    cause = validation.tests[0].name if validation.tests else ""
    return next((text for test_name, text in REMEDIES.items() if cause.startswith(test_name)), ANY_REMEDY)


def factor_text(validation: Validation) -> str:
    """The effect of a failed validation on every u; the factor is 1 where no result would change."""
    if validation.widens:
        return f"multiply every u and half-width by {validation.inflation:.2f}"
    return "no factor on u covers it"


LAPLACE_SHORT = "Intervals are those of the Laplace approximation: too short for a backlash seen at few stops."
LAPLACE_WORTH = "the table is the Laplace approximation, whose intervals are up to a quarter too short"
UNSAMPLED = f"usable with care: the posterior could not be sampled; {LAPLACE_WORTH}"
ROUGH = "usable, but rough: see the Monte Carlo error"
"""On 900 simulated campaigns its 95 % intervals of play contain the truth in 89 %, all others in 92 to 96 %
(experiments/intervals): a normal interval of 89 % is 1.6 sd wide instead of 1.96."""


def failed(summary: FitSummary) -> Validation | None:
    """The validation if it failed, else None."""
    validation = summary.validation
    return None if validation is None or validation.passed else validation


def verdict_line(summary: FitSummary) -> str:
    """Whether the numbers of a fit may be used, in one line."""
    if not summary.explained:
        return "verdict: NOT CONVERGED, use none of these numbers"
    if (validation := failed(summary)) is not None:
        looks = summary.looks
        only_looks = not validation.widens and validation.cause.startswith(f"single {looks} disagree")
        helps = f": {SPOTS_REMEDY.format(looks=looks)}" * only_looks
        return f"verdict: VALIDATION FAILED, {factor_text(validation)}{helps}"
    unmoved = [d for d in DIRECTIONS if (e := summary.effective[d]) is not None and not e.informed]
    validation = summary.validation
    if not summary.converged:
        verdict = UNSAMPLED
    elif summary.answer == "rough":
        verdict = ROUGH
    elif validation is None or not validation.tests:
        verdict = f"usable; too few {summary.looks} to look for model errors"
    else:
        verdict = (
            f"usable; no sign of a model error in {len(validation.tests)} tests (least p {validation.tests[0].p:.2g})"
        )
    if unmoved:
        verdict += f"; the data do not determine {', '.join(unmoved)}"
    return f"verdict: {verdict}"


def noise_line(summary: FitSummary) -> str | None:
    """A remark on pixel noise far from the stated one; None where it is close."""
    scale = summary.parameters["pixel_scale"].value
    if USUAL_SCALE[0] <= scale <= USUAL_SCALE[1]:
        return None
    worse = "larger" if scale > 1 else "smaller"
    stated = {"spots": "su and sv of spots.csv say", "sightings": "u_deg of sightings.csv says"}[summary.looks]
    said = f"the {summary.looks} scatter {scale:.2g} times as much as {stated}"
    return f"{said}; the fit allows for it: state {worse} ones if you know them"


def play_lines(summary: FitSummary) -> list[str]:
    """Remarks on plays that vary by more than themselves."""
    lines = []
    for axis in AXES:
        names = (f"backlash_deg.{axis}", f"play_variation_deg.{axis}")
        play, variation = map(summary.parameters.get, names)
        if play is not None and variation is not None and varies_beyond(variation, play):
            told, itself = (concise(each.value, each.sd) for each in (variation, play))
            said = f"the play of {axis} varies by {told} deg (sd), more than the play itself, {itself}, and no play is "
            said += "negative: "
            lines.append(f"{said}the {summary.looks} have errors that depend on counter and side, or steps were lost")
    return lines


def assumed_stereo(stereo: Stereo | None, budgets: Sequence[BudgetTable]) -> str | None:
    """Shares of an assumed stereo covariance in the results' variances, and its remedy; None for an estimated one."""
    if stereo is None or not stereo.assumed:
        return None
    cause = REGISTRY[STEREO_PARAMETER_NAMES[0]].cause
    parts: dict[str, list[str]] = {}
    for table in budgets:
        for row in table.rows:
            if row.quantity == cause and row.share >= SHARE_NAMED:
                quantity = QUANTITIES.get(table.quantity)
                words, part = (
                    (quantity.words, " ".join(quantity.parts)) if quantity and quantity.words else (table.quantity, "")
                )
                parts.setdefault(f"{100 * row.share:.0f} % of the variance of {words}", []).append(part)
    shares = [f"{share} ({', '.join(named)})" if any(named) else share for share, named in parts.items()]
    text = "the stereo covariance is assumed, not estimated"
    origin = f" (from {stereo.assumed_from})" if stereo.assumed_from else ""
    if not budgets:
        return f"{text}{origin}"
    if not shares:
        return f"{text}{origin}: less than {100 * SHARE_NAMED:.0f} % of the variance of every result comes from it"
    return f"{text}{origin}: it makes {', '.join(shares)}; what lowers it: {ASSUMED_REMEDY}"


def next_steps(summary: FitSummary, folder: str, causes: Sequence[Finding] = ()) -> list[str]:
    """The next steps, most urgent first, for the page of the campaign in `folder`.

    `causes` explain a failed fit.
    """
    steps = []
    if not summary.explained and causes:
        return [f"Use none of the numbers: {finding.sentence}." for finding in causes]
    if not summary.explained:
        return [
            "Use none of the numbers. See what `tvsbayes check` warns of, look for swapped cameras, wrong counters "
            "and pictures of another size, then fit again.",
        ]
    if (validation := failed(summary)) is not None:
        action = remedy(validation)
        steps.append(f"{validation.cause}: {action}.")
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
