"""What no further look improves, what input would, the next looks, and when to stop. Values in the target's unit."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tvsbayes.assessment.causes import PLAY_VARIATION, TRANSMISSION_ERROR
from tvsbayes.instrument.parameters import NAMES, RIG_NAMES
from tvsbayes.instrument.plan import LOOKS_PER_EXPERIMENT, describe_looks
from tvsbayes.instrument.rig import RigTable
from tvsbayes.planning.expectation import Knowledge
from tvsbayes.planning.looks import covariance_of
from tvsbayes.planning.search import DesignProblem
from tvsbayes.planning.target import GEARS_AT_POINT, Sensitivity, Target
from tvsbayes.results.plan_record import Advice, Batch


@dataclass(frozen=True)
class Limit:
    """What is left of the target's variance when looks no longer matter.

    Attributes:
        floor: value that no number of looks goes below, in the target's unit.
        cause: the largest share of the floor.
        shares: share of every cause of the floor's variance; they add up to 1.
        reachable: the target lies above the floor.
        needed: in words, the input uncertainty that would do, None where no input is in the way.
    """

    floor: float
    cause: str
    shares: dict[str, float]
    reachable: bool
    needed: str | None


MANY = 100.0
"""So many times the largest design stand for "no matter how many": a week of looks. Beyond that the spots would be
calibrating the cameras, and a model would be believed to a thousandth of a pixel."""
NEXT_LISTED = 5
STOP_SHARE_PER_MINUTE = 1e-3
"""Measuring is no longer worth while when the best next looks lower the target by less than this share a minute."""


def split_of(knowledge: Knowledge, data: np.ndarray, noise: np.ndarray | None, aim: Sensitivity) -> dict[str, float]:
    """Share of each cause in the worst quantity's variance; see `causes.causes_of`.

    Args:
        knowledge: before the looks.
        data: information of the looks, shape (p + e, p + e).
        noise: its part that pixel noise alone stands for, or None to leave the looks whole.
        aim: the target.
    """
    covariance = covariance_of(knowledge.precision + data)
    worst = int(np.argmax(np.einsum("qi,ij,qj->q", aim.gradient, covariance, aim.gradient) + aim.own_variance))
    pull = covariance @ aim.gradient[worst]
    parts = {}
    if noise is None:
        parts["looks"] = float(pull @ data @ pull)
    else:
        parts["pixel noise"] = float(pull @ noise @ pull)
        parts["stop errors of the looks"] = float(pull @ (data - noise) @ pull)
    if knowledge.after_data:
        # What the campaign taught and its priors cannot be told apart here: `locate --budget` and `fit` do.
        parts["the campaign and its priors"] = float(pull @ knowledge.precision @ pull)
    else:
        for name, columns in knowledge.rig.table.mechanism.prior_groups.items():
            parts[name] = float(np.sum(pull[columns] ** 2))
        errors = np.split(pull[len(NAMES) :], 2)
        parts |= {
            name: float(error @ error) for name, error in zip((TRANSMISSION_ERROR, PLAY_VARIATION), errors, strict=True)
        }
    parts |= {name: float(value[worst]) for name, value in aim.own.items()}
    total = sum(parts.values())
    kept = {name: value / total for name, value in parts.items() if value > 1e-12 * total}
    return dict(sorted(kept.items(), key=lambda item: -item[1]))


def _at_most(value: float) -> str:
    """A positive number to two digits, rounded down: an uncertainty that is enough, stated so that it stays enough."""
    last = 10.0 ** (math.floor(math.log10(value)) - 1)
    # A number that has two digits already may stand an ulp below them.
    return f"{last * math.floor(value / last + 1e-9):.2g}"


def _state(table: RigTable, columns: Sequence[int], share: float) -> str:
    """The stated u of a prior, and what it would have to be."""
    if len(columns) == len(NAMES) - len(RIG_NAMES):
        return f"the stereo calibration to {_at_most(100 * share)} % of its present uncertainty"
    stated = {NAMES[c]: table.priors[NAMES[c]].u for c in columns if table.priors[NAMES[c]].u > 0}
    return " and ".join(f"u({name}) = {_at_most(share * u)} instead of {u:.2g}" for name, u in stated.items())


def _needed_at_point(aim: Sensitivity, target: Target) -> str | None:
    """What would have to be better at the target's point itself, in words; None where no calibration is in its way."""
    total = aim.own_variance
    gears = aim.own.get(GEARS_AT_POINT, np.zeros_like(total))
    # The worst of the quantities, each with its own parts.
    stop, geared, whole = (target.factor * math.sqrt(max(variance)) for variance in (total - gears, gears, total))
    unit = target.unit
    if stop > target.limit:
        short = f"{stop:.3g} {unit} come from the stop and the reading at the point itself"
        return f"{short}: only a smaller stop error or aperture noise would do"
    if whole > target.limit:
        short = f"{whole:.3g} {unit} come from the point itself: {stop:.3g} from the stop and the reading there, "
        short += f"{geared:.3g} from errors of the gears, of which looks elsewhere do not tell"
        return f"{short}; widen the limits in [positioner] until looks reach the point's counters"
    return None


def limit_of(knowledge: Knowledge, data: np.ndarray, aim: Sensitivity, target: Target) -> Limit:
    """What no number of looks of this kind removes, and what would.

    Args:
        knowledge: before the looks.
        data: information of the largest design, shape (p + e, p + e).
        aim: the target's sensitivities.
        target: the target.
    """
    many = MANY * data
    floor = aim.value(covariance_of(knowledge.precision + many), target.factor)
    shares = split_of(knowledge, many, None, aim)
    cause = next(iter(shares))
    if floor <= target.limit:
        return Limit(floor, cause, shares, True, None)
    groups = knowledge.rig.table.mechanism.prior_groups
    if (at_point := _needed_at_point(aim, target)) is not None:
        return Limit(floor, cause, shares, False, at_point)

    def with_inputs(scaled: Mapping[str, float]) -> float:
        precision = knowledge.precision.copy()
        for name, share in scaled.items():
            columns = groups[name]
            # The prior's own precision is 1 in its coordinates, whatever the campaign added.
            precision[columns, columns] += share**-2 - 1
        return aim.value(covariance_of(precision + many), target.factor)

    scaled: dict[str, float] = {}
    names = [name for name in shares if name in groups]
    if knowledge.after_data:
        names = sorted(groups, key=lambda name: with_inputs({name: 1e-3}))
    for name in names:
        if with_inputs({**scaled, name: 1e-3}) > target.limit:
            scaled[name] = 0.1
            continue
        low, high = 1e-3, 1.0
        for _ in range(40):
            middle = math.sqrt(low * high)
            low, high = (middle, high) if with_inputs({**scaled, name: middle}) <= target.limit else (low, middle)
        scaled[name] = low
        # Earlier ones that turn out not to matter are left as they are.
        for other in [n for n in scaled if n != name]:
            kept = {n: s for n, s in scaled.items() if n != other}
            if with_inputs(kept) <= target.limit:
                scaled = kept
        stated = "; ".join(_state(knowledge.rig.table, groups[n], s) for n, s in scaled.items())
        return Limit(floor, cause, shares, False, f"it would do to know {stated}")
    return Limit(floor, cause, shares, False, "no single input stands in the way: widen the limits or add sheets")


def next_experiments(problem: DesignProblem) -> tuple[Batch, ...]:
    """Four looks at every sheet, chosen from all candidates and from those a full turn away, by gain per minute."""
    search, candidates, rig, now = problem.search(), problem.candidates, problem.knowledge.rig, problem.now
    batches = []
    for number in range(len(problem.knowledge.sheets)):
        for turned in (False, True):
            allowed = (candidates.looks.sheet == number) & (candidates.turned | (not turned))
            if not allowed.any():
                continue
            best = problem.chosen(search, allowed, LOOKS_PER_EXPERIMENT)
            steps, minutes, gain = best.design.steps, best.design.minutes(rig), max(now - best.value, 0.0)
            text = f"{'a full turn of pan away, ' if turned else ''}{describe_looks(rig, steps)}"
            batches.append(Batch(steps, minutes, gain, gain / max(minutes, 1e-9), text))
    unique = {batch.actions: batch for batch in batches}.values()
    return tuple(sorted(unique, key=lambda b: -b.gain_per_minute)[:NEXT_LISTED])


def stop_now(now: float, target: Target, limit: Limit, batches: Sequence[Batch], after_data: bool) -> Advice:
    """The stopping rule: enough, or no use.

    Args:
        now: the target's value before further looks.
        target: the target.
        limit: its floor.
        batches: possible next experiments, best first.
        after_data: there is a campaign to stop.
    """
    best = batches[0].gain_per_minute if batches else 0.0
    worth = STOP_SHARE_PER_MINUTE * now
    rule = (
        f"stop when {target.text} holds for a fit of all data, or when the best next four looks lower it by less than "
        f"{100 * STOP_SHARE_PER_MINUTE:g} % a minute"
    )
    shown = f"{now:.3g} {target.unit}"
    if after_data and now <= target.limit:
        return Advice(True, f"the target is met: {shown}", rule)
    if not limit.reachable:
        reason = f"no number of looks meets the target: the floor is {limit.floor:.3g} {target.unit}"
        return Advice(after_data, reason if after_data else f"{reason}; measure if that will do", rule)
    if best < worth:
        return Advice(True, f"the best next four looks lower {shown} by only {best:.2g} {target.unit} a minute", rule)
    return Advice(False, f"{shown} now; the best next four looks lower it by {best:.2g} {target.unit} a minute", rule)
