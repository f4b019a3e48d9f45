"""The floor of a target, the inputs that determine it, the next looks, and the stopping rule, in the target's unit."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from tvsbayes.assessment.causes import PLAY_VARIATION, TRANSMISSION_ERROR
from tvsbayes.instrument.plan import LOOKS_PER_EXPERIMENT, describe_looks
from tvsbayes.instrument.rig import Rig, RigTable
from tvsbayes.planning.expectation import Knowledge
from tvsbayes.planning.search import DesignProblem
from tvsbayes.planning.target import GEARS_AT_POINT, Sensitivity, Target
from tvsbayes.results.plan_record import Advice, Batch, actions_of
from tvsbayes.results.records import Record
from tvsbayes.statistics.optimal_design import covariance_of


class Limit(Record, frozen=True):
    """The uncertainty of the target that remains after very many looks.

    Attributes:
        floor: lowest value for any number of looks, in the target's unit.
        cause: the cause with the largest share of the floor.
        shares: share of every cause of the floor's variance; they add up to 1.
        reachable: whether the target is above the floor.
        needed: the sufficient input uncertainty, in words; None where no input prevents the target.
    """

    floor: float
    cause: str
    shares: dict[str, float]
    reachable: bool
    needed: str | None


MANY_TIMES = 100.0
"""Multiple of the largest design that represents any number of looks: a week. With more, the spots would calibrate the
cameras, if the model held to a thousandth of a pixel."""
NEXT_LISTED = 5
STOP_SHARE_PER_MINUTE = 1e-3
"""Measuring stops when the best next looks lower the target by less than this share a minute."""


def split_of(knowledge: Knowledge, data: np.ndarray, noise: np.ndarray | None, aim: Sensitivity) -> dict[str, float]:
    """Compute the share of each cause in the worst quantity's variance; see `causes.causes_of`.

    Args:
        knowledge: before the looks.
        data: information of the looks, shape (p + e, p + e).
        noise: part of it by pixel noise alone, or None not to split the looks.
        aim: the target.
    """
    covariance = covariance_of(knowledge.precision + data)
    worst = int(np.argmax(np.einsum("qi,ij,qj->q", aim.gradient, covariance, aim.gradient) + aim.own_variance))
    loading = covariance @ aim.gradient[worst]
    parts = {}
    if noise is None:
        parts["looks"] = float(loading @ data @ loading)
    else:
        parts["pixel noise"] = float(loading @ noise @ loading)
        parts["stop errors of the looks"] = float(loading @ (data - noise) @ loading)
    if knowledge.after_data:
        # Campaign and priors are not separated here: `locate --budget` and `fit` do it.
        parts["the campaign and its priors"] = float(loading @ knowledge.precision @ loading)
    else:
        for name, columns in knowledge.rig.table.mechanism.prior_groups.items():
            parts[name] = float(np.sum(loading[columns] ** 2))
        errors = np.split(loading[len(knowledge.z) :], 2)
        parts |= {
            name: float(error @ error) for name, error in zip((TRANSMISSION_ERROR, PLAY_VARIATION), errors, strict=True)
        }
    parts |= {name: float(value[worst]) for name, value in aim.own.items()}
    total = sum(parts.values())
    shares = {name: value / total for name, value in parts.items() if value > 1e-12 * total}
    return dict(sorted(shares.items(), key=lambda item: -item[1]))


def _rounded_down(value: float) -> str:
    """Format a positive number to two digits, rounded down, so that a sufficient uncertainty stays sufficient."""
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    # A number with two digits may be an ulp below them.
    return f"{unit * math.floor(value / unit + 1e-9):.2g}"


def _requirement(table: RigTable, columns: Sequence[int], share: float) -> str:
    """Write the stated u of a prior and the required one in words."""
    names, rig = table.mechanism.names, len(table.mechanism.rig_names)
    if len(columns) == len(names) - rig:
        return f"the stereo calibration to {_rounded_down(100 * share)} % of its present uncertainty"
    prior_u = {names[c]: table.priors[names[c]].u for c in columns if table.priors[names[c]].u > 0}
    return " and ".join(f"u({name}) = {_rounded_down(share * u)} instead of {u:.2g}" for name, u in prior_u.items())


def _needed_at_point(aim: Sensitivity, target: Target) -> str | None:
    """Write the required improvement at the target's point itself; None where its variance permits the target."""
    gears = aim.own.get(GEARS_AT_POINT, np.zeros_like(aim.own_variance))
    # The worst quantity is taken for each part.
    parts = (aim.own_variance - gears, gears, aim.own_variance)
    stop, gear, worst = (target.factor * math.sqrt(max(variance)) for variance in parts)
    if stop > target.limit:
        return (
            f"{stop:.3g} {target.unit} come from the stop and the reading at the point itself: only a smaller stop "
            "error or aperture noise would help"
        )
    if worst > target.limit:
        return (
            f"{worst:.3g} {target.unit} come from the point itself: {stop:.3g} from the stop and the reading there, "
            f"{gear:.3g} from errors of the gears, which looks at other counters do not determine; widen the limits in "
            "[positioner] until looks reach the point's counters"
        )
    return None


def _needed_inputs(
    value_with: Callable[[Mapping[str, float]], float], names: Sequence[str], rig: Rig, limit: float
) -> str:
    """Write the sufficient uncertainties of inputs, in their order: as many as needed, each to a tenth but the last.

    Args:
        value_with: value of the target with uncertainties of inputs scaled by shares.
        names: names of the inputs.
        rig: its priors.
        limit: the value must not exceed it.
    """
    scaled: dict[str, float] = {}
    for name in names:
        if value_with({**scaled, name: 1e-3}) > limit:
            scaled[name] = 0.1
            continue
        low, high = 1e-3, 1.0
        for _ in range(40):
            middle = math.sqrt(low * high)
            low, high = (middle, high) if value_with({**scaled, name: middle}) <= limit else (low, middle)
        scaled[name] = low
        # Earlier inputs that need no improvement keep their uncertainty.
        for other in [n for n in scaled if n != name]:
            others = {n: share for n, share in scaled.items() if n != other}
            scaled = others if value_with(others) <= limit else scaled
        groups = rig.table.mechanism.prior_groups
        stated = "; ".join(_requirement(rig.table, groups[n], share) for n, share in scaled.items())
        return f"it suffices to know {stated}"
    return "no single input is the limit: widen the limits or add sheets"


def limit_of(knowledge: Knowledge, data: np.ndarray, aim: Sensitivity, target: Target) -> Limit:
    """Compute the floor of the target for looks of this kind, and the input that would lower it.

    Args:
        knowledge: before the looks.
        data: information of the largest design, shape (p + e, p + e).
        aim: sensitivity of the target.
        target: the target.
    """
    groups, many_looks = knowledge.rig.table.mechanism.prior_groups, MANY_TIMES * data

    def value_with(scaled: Mapping[str, float]) -> float:
        precision = knowledge.precision.copy()
        for name, share in scaled.items():
            # The prior's precision is 1 in its coordinates; that of the campaign is added.
            precision[groups[name], groups[name]] += share**-2 - 1
        return aim.value(covariance_of(precision + many_looks), target.factor)

    floor, shares = value_with({}), split_of(knowledge, many_looks, None, aim)
    needed = None
    if floor > target.limit:
        names = [name for name in shares if name in groups]
        if knowledge.after_data:
            names = sorted(groups, key=lambda name: value_with({name: 1e-3}))
        needed = _needed_at_point(aim, target) or _needed_inputs(value_with, names, knowledge.rig, target.limit)
    return Limit(floor, next(iter(shares)), shares, needed is None, needed)


def next_experiments(problem: DesignProblem) -> tuple[Batch, ...]:
    """Choose four looks on every sheet from all candidates and from those a full turn away, by gain per minute."""
    candidates, rig = problem.candidates, problem.knowledge.rig
    sheets = [candidates.looks.sheet == number for number in range(len(problem.knowledge.sheets))]
    subsets = [subset for sheet in sheets for subset in (sheet, sheet & candidates.turned)]
    batches = {}
    for best in problem.choices(LOOKS_PER_EXPERIMENT, subsets):
        away = "a full turn of pan away, " if candidates.turned[best.picks].all() else ""
        text = f"{away}{describe_looks(rig, best.steps)}"
        batches[best.steps] = Batch(actions_of(best.steps), best.minutes, best.gain, best.gain_per_minute, text)
    return tuple(sorted(batches.values(), key=lambda batch: -batch.gain_per_minute)[:NEXT_LISTED])


def stop_now(now: float, target: Target, limit: Limit, batches: Sequence[Batch], after_data: bool) -> Advice:
    """Apply the stopping rule: target met, or no useful looks.

    Args:
        now: the target's value before further looks.
        target: the target.
        limit: its floor.
        batches: possible next experiments, best first.
        after_data: whether there is a campaign to stop.
    """
    best = batches[0].gain_per_minute if batches else 0.0
    least_gain = STOP_SHARE_PER_MINUTE * now
    rule = (
        f"stop when {target.text} holds for a fit of all data, or when the best next four looks lower it by less than "
        f"{100 * STOP_SHARE_PER_MINUTE:g} % a minute"
    )
    value = f"{now:.3g} {target.unit}"
    if after_data and now <= target.limit:
        return Advice(True, f"the target is met: {value}", rule)
    if not limit.reachable:
        reason = f"no number of looks meets the target: the floor is {limit.floor:.3g} {target.unit}"
        return Advice(after_data, reason if after_data else f"{reason}; measure if that suffices", rule)
    if not after_data:
        return Advice(False, f"nothing is measured yet; {value} by the priors", rule)
    if best < least_gain:
        return Advice(True, f"the best next four looks lower {value} by only {best:.2g} {target.unit} a minute", rule)
    return Advice(False, f"{value} now; the best next four looks lower it by {best:.2g} {target.unit} a minute", rule)
