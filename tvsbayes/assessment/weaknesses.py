"""Weaknesses of the data: weak directions, stops of high leverage, priors in conflict, directions with few stops.

Directions and gradients are in the coordinates, each in sds of its prior, of the linear model about the mode.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tvsbayes.estimators.joint_fit import JointFit, with_places
from tvsbayes.estimators.linear_spots import standard_deviations_without
from tvsbayes.instrument.axes import AXES, DIRECTIONS, SENSES, Axis
from tvsbayes.instrument.campaign import ordered_spots
from tvsbayes.instrument.parameters import (
    HEADLINES,
    INDEX,
    NAMES,
    NOISE_NAMES,
    QUANTITIES,
    STEREO_PARAMETER_NAMES,
    names_of,
)
from tvsbayes.instrument.places import FEW_COUNTERS, LEAST_ERROR_RAD, SPACING_DEG, too_few_counters
from tvsbayes.instrument.stops import few_stops, inseparable, legs_of, observed_stops, one_sided, separation
from tvsbayes.model.gear_kriging import KnownPlaces, scales_at
from tvsbayes.results.estimates import CONFLICT_LIMIT, Leverage, WeakDirection, conflict_sentence

LEVERAGE_LIMIT = 2.0
"""A stop is named if a headline's sd would grow by more than this factor without it (formulation 4.2)."""
LOADING_LIMIT = 0.3
WEAK_VARIANCE = 0.5
"""A direction of parameter space is weak if more than this share of its prior variance remains."""
LISTED = 8


def moved_directions(fit: JointFit) -> set[str]:
    """Return the directions in which the campaign ever moved."""
    return set(legs_of(fit.campaign.moves))


def _used_moves(fit: JointFit) -> set[int]:
    """Return the moves with a used spot."""
    return {s.move for s in fit.campaign.spots if s.status == "ok" and s.spot not in fit.excluded_spots}


def _backlash_direction(fit: JointFit, axis: str, direction: str) -> WeakDirection | None:
    """Return ratio and backlash of an axis, if they are correlated or the stops cannot separate them."""
    index = INDEX[f"backlash_deg.{axis}"]
    if not fit.free[index]:
        return None
    ratio = fit.draws.effective_deg_per_step[:, DIRECTIONS.index(direction)]
    if np.ptp(ratio) == 0:
        # Fixed by the priors and so uncorrelated with the backlash.
        return None
    correlation = float(np.corrcoef(ratio, fit.draws.physical[:, index])[0, 1])
    stops = observed_stops(fit.campaign.moves, _used_moves(fit), axis)
    if one_sided(stops, axis) is None and not inseparable(correlation):
        return None
    reason = separation(stops, axis) or "the legs differ too little; add a cleared approach or longer legs"
    text = f"{axis} ratio and {axis} backlash move together (correlation {correlation:+.2f}): {reason}"
    return WeakDirection(text, {f"effective.{direction}": 1.0, f"backlash_deg.{axis}": correlation})


def _counters_direction(fit: JointFit, axis: Axis) -> WeakDirection | None:
    """Return gear error and ratio of an axis seen at few counters, if the error between them is set by the prior."""
    steps = {getattr(fit.campaign.moves[move], f"{axis}_steps") for move in _used_moves(fit)}
    counters, count = sorted(steps), len(NAMES)
    if not 2 <= len(counters) <= FEW_COUNTERS or not len(fit.information.place_mean):
        return None
    gears = fit.arrays.gears
    places, errors = gears.places, np.flatnonzero(~gears.of_play)
    valid = np.asarray(places.valid)
    physical = np.asarray(fit.mode.physical)
    ratio = np.radians(physical[[INDEX[f"degrees_per_step.{a}"] for a in AXES]])
    scales = scales_at(physical, np.asarray(fit.space.harmonic_period_deg))
    known = KnownPlaces(np.asarray(places.steps)[valid], np.asarray(places.on_tilt)[valid], ratio, scales)
    joint = with_places(fit.z, fit.covariance, fit.information).covariance
    # Errors that the priors fix have no column.
    covariance = np.eye(int(valid.sum()))
    covariance[np.ix_(gears.place[errors], gears.place[errors])] = joint[np.ix_(count + errors, count + errors)]
    widest = int(np.argmax(np.diff(counters)))
    at = known.between(np.array([counters[widest : widest + 2]]).mean(axis=1), AXES.index(axis))
    share, remainder = at.error[0], at.error_rest[0]
    left, prior = (
        share @ covariance @ share + remainder**2,
        share @ share + remainder**2,
    )
    if left < WEAK_VARIANCE * prior or prior <= LEAST_ERROR_RAD**2:
        return None
    wanted = int(np.clip(np.ceil(np.ptp(counters) * abs(np.degrees(ratio[AXES.index(axis)])) / SPACING_DEG) + 1, 4, 7))
    regular = np.linspace(counters[0], counters[-1], wanted).round().astype(int).tolist()
    room = np.ptp(counters) / (wanted - 1) / 2
    telling = [n for n in regular if np.abs(np.subtract(counters, n)).min() > room]
    names = {f"effective.{SENSES[axis][0]}": 1.0, f"transmission_error_deg.{axis}": 1.0}
    return WeakDirection(too_few_counters(axis, counters, telling), names)


def sum_directions(free: np.ndarray, physical: np.ndarray, weights: np.ndarray) -> tuple[WeakDirection, ...]:
    """Name the scales of noise of which the data determine only sums of variances; none or one direction.

    A scale is one of them if its rank correlations with the others explain most of its variance.

    Args:
        free: whether a parameter is estimated, shape (p,).
        physical: draws of the parameters, shape (n, p).
        weights: their weights, shape (n,).
    """
    scales = [name for name in names_of("stop_sd_deg", "look_scatter_deg", "pixel_scale") if free[INDEX[name]]]
    scales = [name for name in scales if np.ptp(physical[:, INDEX[name]]) > 0]
    if len(scales) < 2:
        return ()
    ranks = np.argsort(np.argsort(physical[:, [INDEX[name] for name in scales]], axis=0), axis=0)
    covariance = np.cov(ranks, rowvar=False, aweights=weights)
    correlation = covariance / np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    own_share = 1 / np.diag(np.linalg.inv(correlation))
    shared = np.flatnonzero(own_share < WEAK_VARIANCE).tolist()
    columns = sorted({*shared, *(int(np.argmin(correlation[k])) for k in shared)})
    if not columns:
        return ()
    labels, least = [QUANTITIES[scales[k]].label for k in columns], correlation[np.ix_(columns, columns)].min()
    listed = f"{', '.join(labels[:-1])} and {labels[-1]}"
    plural, verb, them = ("", "is", "it") if len(columns) == 2 else ("s", "are", "them")
    text = f"only the sum{plural} of the variances of {listed} {verb} known (correlation {least:+.2f}): "
    text += f"the priors divide {them}"
    if any(scales[k].startswith("stop_sd_deg") for k in columns):
        text += "; look twice at some stops"
    return (WeakDirection(text, {scales[k]: float(correlation[columns[0], k]) for k in columns}),)


SHIFTS = {
    "creep_deg": (
        "a creep of the zero",
        "alternate the directions, come back to the first stop, wait until it is warm",
    ),
    "thermal_deg_per_K": ("a shift with the temperature", "come back to the first stop at another temperature"),
}
"""Shifts of a zero in time: in words, and what separates them from the gears."""


def _shift_directions(fit: JointFit, axis: Axis) -> list[WeakDirection]:
    """Return gear parameters of an axis that cannot be separated from a shift of its zero."""
    negative, positive = (fit.draws.effective_deg_per_step[:, DIRECTIONS.index(d)] for d in SENSES[axis])
    backlash = fit.draws.physical[:, INDEX[f"backlash_deg.{axis}"]]
    contrast = f"the contrast of {SENSES[axis][0]} and {SENSES[axis][1]}"
    quantities = {
        contrast: (negative - positive, f"ratio_contrast_deg_per_step.{axis}"),
        f"the {axis} ratio": (0.5 * (negative + positive), f"degrees_per_step.{axis}"),
        f"the {axis} backlash": (backlash, f"backlash_deg.{axis}"),
    }
    directions = []
    for block, (words, remedy) in SHIFTS.items():
        shift = f"{block}.{axis}"
        if not fit.free[INDEX[shift]]:
            continue
        draws = fit.draws.physical[:, INDEX[shift]]
        for what, (values, name) in quantities.items():
            if np.ptp(values) > 1e-12 * np.max(np.abs(values)):
                correlation = float(np.corrcoef(values, draws)[0, 1])
                if inseparable(correlation):
                    text = f"{what} and {words} are poorly separated (correlation {correlation:+.2f}): {remedy}"
                    directions.append(WeakDirection(text, {name: 1.0, shift: correlation}))
    return directions


def weak_directions(fit: JointFit, moved: set[str]) -> tuple[WeakDirection, ...]:
    """Describe parameter combinations that data and priors do not determine: axes never moved, play, priors alone."""
    directions = []
    for axis, pair in SENSES.items():
        if not moved & set(pair):
            stated = "its ratio and backlash are those of the prior"
            text = f"the {axis} axis was never moved: {stated}; add moves on that axis"
            directions.append(WeakDirection(text, {f"degrees_per_step.{axis}": 1.0}))
            continue
        weak = _backlash_direction(fit, axis, pair[0] if pair[0] in moved else pair[1])
        of_axis = weak, _counters_direction(fit, axis), *_shift_directions(fit, axis)
        directions += [one for one in of_axis if one is not None]
    noise = {*NOISE_NAMES, *STEREO_PARAMETER_NAMES, *names_of("creep_minutes")}
    rows = np.array([i for i, name in enumerate(fit.names) if fit.free[i] and name not in noise])
    if rows.size == 0:
        return tuple(directions)
    eigenvalues, vectors = np.linalg.eigh(fit.covariance[np.ix_(rows, rows)])
    for value, vector in list(zip(eigenvalues, vectors.T, strict=True))[::-1]:
        if value < WEAK_VARIANCE or len(directions) >= LISTED:
            break
        order = np.argsort(-np.abs(vector))
        loadings = {fit.names[rows[i]]: float(vector[i]) for i in order if abs(vector[i]) > LOADING_LIMIT}
        if not loadings:
            loadings = {fit.names[rows[order[0]]]: float(vector[order[0]])}
        names = list(loadings)
        # Rounding may give slightly more than the prior's variance; more than 100 % is not reported.
        left = f"{min(100.0, 100 * value):.0f} % of"
        if len(names) == 1:
            text = f"{names[0]} is set by the prior: {left} its variance is left; state it better or accept it"
        else:
            listed = ", ".join(names[:-1]) + " and " + names[-1]
            text = f"{listed} move together, set by the prior: {left} that direction's variance is left; "
            text += "state one of them better or accept it"
        directions.append(WeakDirection(text, loadings))
    return tuple(directions)


def judged_headlines(fit: JointFit, moved: set[str]) -> dict[str, np.ndarray]:
    """Return the Laplace draws (draws,) of judged headlines, by label."""
    # Parameters in coordinates, where a backlash is Gaussian.
    quantities = {
        of.label: fit.draws_z[:, INDEX[of.name]] if of.name in INDEX else fit.draws[of.name]
        for of in HEADLINES
        if of.judged and of.applies(moved)
    }
    # Quantities fixed by the priors scatter by rounding only and are left out.
    return {name: v for name, v in quantities.items() if np.ptp(v) > 1e-12 * np.max(np.abs(v))}


def headline_gradients(fit: JointFit, headlines: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return d(quantity)/d(coordinates), shape (q, p), of `judged_headlines`."""
    return gradients(fit, np.stack(list(headlines.values()), axis=1))


def gradients(fit: JointFit, values: np.ndarray) -> np.ndarray:
    """Compute d(quantity)/d(coordinates), shape (q, p), of quantities with values (draws, q) on the Laplace draws.

    Regression on the moment-matched draws gives the gradient of the linear part, averaged over the posterior.
    """
    centred = fit.draws_z - fit.draws_z.mean(axis=0)
    cross = (values - values.mean(axis=0)).T @ centred / len(centred)
    return np.linalg.solve(fit.covariance, cross.T).T


def whole_gradients(fit: JointFit, values: np.ndarray) -> np.ndarray:
    """Compute d(quantity)/d(coordinates, then errors at places), shape (q, p + e), as `gradients` does."""
    draws = np.concatenate([fit.draws_z, fit.draws_places], axis=1)
    centred = draws - draws.mean(axis=0)
    cross = (values - values.mean(axis=0)).T @ centred / len(centred)
    return np.linalg.solve(with_places(fit.z, fit.covariance, fit.information).covariance, cross.T).T


def leverage(fit: JointFit, moved: set[str]) -> tuple[Leverage, ...]:
    """Find stops without which a headline's sd would more than double."""
    quantities = judged_headlines(fit, moved)
    gradients = headline_gradients(fit, quantities)
    sd = np.sqrt(np.einsum("qi,ij,qj->q", gradients, fit.covariance, gradients))
    ordered = ordered_spots(fit.campaign)
    entries = []
    for group in fit.information.groups:
        members = [s for s in ordered[group.rows] if s.spot not in fit.excluded_spots]
        if not members:
            continue
        factors = standard_deviations_without(group, fit.covariance, gradients) / sd
        for name, factor in zip(quantities, factors, strict=True):
            if factor > LEVERAGE_LIMIT or not np.isfinite(factor):
                move = fit.campaign.moves[members[0].move]
                approach = ""
                if move.pan_approach:
                    approach = f" and its recorded approach ({move.pan_approach}, {move.tilt_approach})"
                size = f"{factor:.1f} times" if np.isfinite(factor) else "beyond all bounds"
                text = f"without move {move.move}{approach} the sd of {name} would grow {size}"
                spots = tuple(s.spot for s in members)
                entries.append(Leverage(move.move, spots, name, float(factor) if np.isfinite(factor) else None, text))
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
    few = few_stops(fit.campaign.moves, _used_moves(fit))
    return {direction: count for direction, count in few.items() if fit.free[INDEX[f"stop_sd_deg.{direction}"]]}
