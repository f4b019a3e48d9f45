"""Weaknesses of the data: weak directions, stops of high leverage, priors in conflict, directions with few stops.

Directions and gradients are in the coordinates, each in sds of its prior, of the linear model about the mode.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice

import numpy as np
from numpy.typing import ArrayLike

from tvsbayes.assessment.headlines import linear_headlines, moved_directions, scatters
from tvsbayes.estimators.joint_fit import JointFit, with_places
from tvsbayes.estimators.linear_spots import standard_deviations_without
from tvsbayes.instrument.axes import AXES, DIRECTIONS, SENSES, Axis
from tvsbayes.instrument.campaign import ordered_spots
from tvsbayes.instrument.mechanisms import RATIO_COLUMNS
from tvsbayes.instrument.parameters import NOISE_NAMES, QUANTITIES, STEREO_PARAMETER_NAMES, names_of
from tvsbayes.instrument.places import FEW_COUNTERS, LEAST_ERROR_RAD, SPACING_DEG, too_few_counters
from tvsbayes.instrument.stops import few_stops, inseparable, observed_stops, one_sided, separation
from tvsbayes.model.gear_kriging import KnownPlaces, scales_at
from tvsbayes.results.estimates import CONFLICT_LIMIT, Leverage, WeakDirection, conflict_sentence

LEVERAGE_LIMIT = 2.0
"""A stop is named if a headline's sd would grow by more than this factor without it (formulation 4.2)."""
LOADING_LIMIT = 0.3
WEAK_VARIANCE = 0.5
"""A direction of parameter space is weak if more than this share of its prior variance remains."""
LISTED = 8
SUM_KNOWN = "only the sum of the variances of {} is known (correlation {:+.2f}): the priors divide it"
SUMS_KNOWN = "only the sums of the variances of {} are known (correlation {:+.2f}): the priors divide them"
SET_BY_PRIOR = "{} is set by the prior: {:.0f} % of its variance is left; state it better or accept it"
MOVE_TOGETHER = (
    "{} move together, set by the prior: {:.0f} % of that direction's variance is left; state one of them better or "
    "accept it"
)


def _used_moves(fit: JointFit) -> set[int]:
    """Return the moves with a used spot."""
    return {s.move for s in fit.campaign.spots if s.status == "ok" and s.spot not in fit.excluded_spots}


def _correlation(a: ArrayLike, b: ArrayLike) -> float:
    return float(np.corrcoef(np.asarray(a), np.asarray(b))[0, 1])


def _backlash_direction(fit: JointFit, axis: str, direction: str) -> Iterator[WeakDirection]:
    """Ratio and backlash of an axis, if they are correlated or the stops cannot separate them."""
    index = fit.names.index(f"backlash_deg.{axis}")
    ratio = fit.draws.effective_deg_per_step[:, DIRECTIONS.index(direction)]
    # A ratio fixed by the priors is uncorrelated with the backlash.
    if not fit.free[index] or np.ptp(ratio) == 0:
        return
    correlation = _correlation(ratio, fit.draws.physical[:, index])
    stops = observed_stops(fit.campaign.moves, _used_moves(fit), axis)
    if one_sided(stops, axis) is not None or inseparable(correlation):
        reason = separation(stops, axis) or "the legs differ too little; add a cleared approach or longer legs"
        text = f"{axis} ratio and {axis} backlash move together (correlation {correlation:+.2f}): {reason}"
        yield WeakDirection(text, {f"effective.{direction}": 1.0, f"backlash_deg.{axis}": correlation})


def _counters_direction(fit: JointFit, axis: Axis) -> Iterator[WeakDirection]:
    """Gear error and ratio of an axis seen at few counters, if the error between them is set by the prior."""
    counters = sorted({getattr(fit.campaign.moves[move], f"{axis}_steps") for move in _used_moves(fit)})
    if not 2 <= len(counters) <= FEW_COUNTERS or not len(fit.information.place_mean):
        return
    gears, count, physical = fit.arrays.gears, len(fit.z), np.asarray(fit.mode.physical)
    places, errors, valid = gears.places, np.flatnonzero(~gears.of_play), np.asarray(gears.places.valid)
    ratio = np.radians(physical[RATIO_COLUMNS])
    scales = scales_at(physical, np.asarray(fit.space.harmonic_period_deg), fit.space.mechanism)
    known = KnownPlaces(np.asarray(places.steps)[valid], np.asarray(places.on_tilt)[valid], ratio, scales)
    joint = with_places(fit.z, fit.covariance, fit.information).covariance
    # Errors that the priors fix have no column.
    covariance = np.eye(int(valid.sum()))
    covariance[np.ix_(gears.place[errors], gears.place[errors])] = joint[np.ix_(count + errors, count + errors)]
    widest = int(np.argmax(np.diff(counters)))
    at = known.between(np.array([counters[widest : widest + 2]]).mean(axis=1), AXES.index(axis))
    share, remainder = at.error[0], at.error_rest[0]
    left, prior = (share @ matrix @ share + remainder**2 for matrix in (covariance, np.eye(len(share))))
    if left < WEAK_VARIANCE * prior or prior <= LEAST_ERROR_RAD**2:
        return
    wanted = int(np.clip(np.ceil(np.ptp(counters) * abs(np.degrees(ratio[AXES.index(axis)])) / SPACING_DEG) + 1, 4, 7))
    regular = np.linspace(counters[0], counters[-1], wanted).round().astype(int).tolist()
    room = np.ptp(counters) / (wanted - 1) / 2
    telling = [n for n in regular if np.abs(np.subtract(counters, n)).min() > room]
    names = {f"effective.{SENSES[axis][0]}": 1.0, f"transmission_error_deg.{axis}": 1.0}
    yield WeakDirection(too_few_counters(axis, counters, telling), names)


def sum_directions(
    names: Sequence[str], free: np.ndarray, physical: np.ndarray, weights: np.ndarray
) -> tuple[WeakDirection, ...]:
    """Name the scales of noise of which the data determine only sums of variances; none or one direction.

    A scale is one of them if its rank correlations with the others explain most of its variance.

    Args:
        names: names of the parameters.
        free: whether a parameter is estimated, shape (p,).
        physical: draws of the parameters, shape (n, p).
        weights: their weights, shape (n,).
    """
    index = {name: names.index(name) for name in names_of("stop_sd_deg", "look_scatter_deg", "pixel_scale")}
    scales = [name for name, at in index.items() if free[at] and np.ptp(physical[:, at]) > 0]
    if len(scales) < 2:
        return ()
    ranks = np.argsort(np.argsort(physical[:, [index[name] for name in scales]], axis=0), axis=0)
    covariance = np.cov(ranks, rowvar=False, aweights=weights)
    correlation = covariance / np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    own_share = 1 / np.diag(np.linalg.inv(correlation))
    shared = np.flatnonzero(own_share < WEAK_VARIANCE).tolist()
    columns = sorted({*shared, *(int(np.argmin(correlation[k])) for k in shared)})
    if not columns:
        return ()
    labels, least = [QUANTITIES[scales[k]].label for k in columns], correlation[np.ix_(columns, columns)].min()
    text = (SUMS_KNOWN if len(columns) > 2 else SUM_KNOWN).format(_listed(labels), least)
    twice = "; look twice at some stops" if any(scales[k].startswith("stop_sd_deg") for k in columns) else ""
    return (WeakDirection(text + twice, {scales[k]: float(correlation[columns[0], k]) for k in columns}),)


def _listed(words: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(words[:-1]), words[-1])))


SHIFTS = {
    "creep_deg": (
        "a creep of the zero",
        "alternate the directions, come back to the first stop, wait until it is warm",
    ),
    "thermal_deg_per_K": ("a shift with the temperature", "come back to the first stop at another temperature"),
}
"""Shifts of a zero in time: in words, and what separates them from the gears."""


def _shift_directions(fit: JointFit, axis: Axis) -> Iterator[WeakDirection]:
    """Gear parameters of an axis that cannot be separated from a shift of its zero."""
    senses = SENSES[axis]
    negative, positive = (np.asarray(fit.draws.effective_deg_per_step)[:, DIRECTIONS.index(d)] for d in senses)
    quantities = (
        (f"the contrast of {' and '.join(senses)}", negative - positive, f"ratio_contrast_deg_per_step.{axis}"),
        (f"the {axis} ratio", 0.5 * (negative + positive), f"degrees_per_step.{axis}"),
        (f"the {axis} backlash", fit.draws[f"backlash_deg.{axis}"], f"backlash_deg.{axis}"),
    )
    for block, (words, remedy) in SHIFTS.items():
        shift = f"{block}.{axis}"
        for what, values, name in quantities if fit.free[fit.names.index(shift)] else ():
            if scatters(values) and inseparable(together := _correlation(values, fit.draws[shift])):
                text = f"{what} and {words} are poorly separated (correlation {together:+.2f}): {remedy}"
                yield WeakDirection(text, {name: 1.0, shift: together})


def _prior_directions(fit: JointFit) -> Iterator[WeakDirection]:
    """Directions of the coordinates of which the prior's variance is left, the largest first."""
    noise = {*NOISE_NAMES, *STEREO_PARAMETER_NAMES, *names_of("creep_minutes")}
    rows = np.array([i for i, name in enumerate(fit.names) if fit.free[i] and name not in noise], dtype=int)
    values, vectors = np.linalg.eigh(fit.covariance[np.ix_(rows, rows)])
    for value, vector in zip(values[::-1], vectors.T[::-1], strict=True):
        if value < WEAK_VARIANCE:
            return
        order = np.argsort(-np.abs(vector))
        named = [i for i in order if abs(vector[i]) > LOADING_LIMIT] or order[:1]
        loadings = {fit.names[rows[i]]: float(vector[i]) for i in named}
        sentence = MOVE_TOGETHER if len(loadings) > 1 else SET_BY_PRIOR
        # Rounding may give slightly more than the prior's variance; more than 100 % is not reported.
        yield WeakDirection(sentence.format(_listed(list(loadings)), min(100.0, 100 * value)), loadings)


def weak_directions(fit: JointFit) -> tuple[WeakDirection, ...]:
    """Describe parameter combinations that data and priors do not determine: axes never moved, play, priors alone."""
    directions, moved = list[WeakDirection](), moved_directions(fit)
    for axis, pair in SENSES.items():
        if not moved & set(pair):
            stated = "its ratio and backlash are those of the prior"
            text = f"the {axis} axis was never moved: {stated}; add moves on that axis"
            directions.append(WeakDirection(text, {f"degrees_per_step.{axis}": 1.0}))
            continue
        directions += _backlash_direction(fit, axis, pair[0] if pair[0] in moved else pair[1])
        directions += [*_counters_direction(fit, axis), *_shift_directions(fit, axis)]
    return (*directions, *islice(_prior_directions(fit), max(LISTED - len(directions), 0)))


def leverage(fit: JointFit) -> tuple[Leverage, ...]:
    """Find stops without which a headline's sd would more than double."""
    headlines, ordered, entries = linear_headlines(fit), ordered_spots(fit.campaign), []
    for group in fit.information.groups:
        members = [s for s in ordered[group.rows] if s.spot not in fit.excluded_spots]
        if not members:
            continue
        factors = standard_deviations_without(group, fit.covariance, headlines.gradients) / headlines.sd
        move = fit.campaign.moves[members[0].move]
        recorded = f" and its recorded approach ({move.pan_approach}, {move.tilt_approach})"
        without = f"without move {move.move}{recorded if move.pan_approach else ''} the sd of {{}} would grow {{}}"
        for label, factor in zip(headlines.labels, factors.tolist(), strict=True):
            bounded = np.isfinite(factor)
            if factor > LEVERAGE_LIMIT or not bounded:
                text = without.format(label, f"{factor:.1f} times" if bounded else "beyond all bounds")
                spots = tuple(s.spot for s in members)
                entries.append(Leverage(move.move, spots, label, factor if bounded else None, text))
    entries.sort(key=lambda e: -(e.factor if e.factor is not None else np.inf))
    return tuple(entries[:LISTED])


def prior_conflicts(fit: JointFit) -> tuple[str, ...]:
    """Find parameters whose mode is far out in their prior: a wrong sign or unit, or a prior stated too narrow."""
    conflicts = []
    for index in np.flatnonzero(fit.free & (np.abs(fit.z) > CONFLICT_LIMIT)):
        value, distance = fit.mode.physical[index], abs(fit.z[index])
        conflicts.append(conflict_sentence(f"{fit.names[index]} = {value:.4g}", distance))
    return tuple(conflicts)


def poorly_known_stops(fit: JointFit) -> dict[str, int]:
    """Return directions whose stop sd is estimated from `few_stops`, with their number."""
    few, free = few_stops(fit.campaign.moves, _used_moves(fit)), dict(zip(fit.names, fit.free, strict=True))
    return {direction: count for direction, count in few.items() if free[f"stop_sd_deg.{direction}"]}
