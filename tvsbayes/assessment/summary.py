"""Summary of a fit: headlines, parameters, diagnostics, and the predicted result of the classic estimator.

It uses a finished `JointFit`, and a `Posterior` if given; nothing is fitted again. Units as in the names.
"""

from __future__ import annotations

import jax
import numpy as np
from msgspec import structs

from tvsbayes.assessment.gear_waves import gear_periods
from tvsbayes.assessment.headlines import moved_directions
from tvsbayes.assessment.prior_sensitivity import prior_sensitivity
from tvsbayes.assessment.score_tests import validate
from tvsbayes.assessment.weaknesses import (
    leverage,
    poorly_known_stops,
    prior_conflicts,
    sum_directions,
    weak_directions,
)
from tvsbayes.estimators.four_point import experiment_rows, four_point_ratios, ratio_slopes, select_experiments
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.inference.summaries import Propagated
from tvsbayes.instrument.axes import AXES, DIRECTIONS
from tvsbayes.instrument.parameters import (
    GEAR_ERROR_NAMES,
    HARMONIC_NAMES,
    HOME_SD_NAMES,
    LATE_NAMES,
    QUANTITIES,
    RECEIVER_NAMES,
    names_of,
)
from tvsbayes.instrument.stops import legs_of
from tvsbayes.model.headlines import Derived
from tvsbayes.posterior.draws import Posterior, derived_names
from tvsbayes.posterior.predictive import ideal_pixels
from tvsbayes.results.estimates import CurvePoint, Curves, Estimate, FitSummary, LostMotion, Measured, fit_noise
from tvsbayes.statistics.intervals import NORMAL_95, interval95
from tvsbayes.statistics.weighted_draws import TAILS, systematic, weighted_mean, weighted_quantiles

EFFECTIVE = "effective_deg_per_step"
CLASSIC_DRAWS = 256
"""Draws behind the predicted result of the classic estimator."""
SEEN_SHARE = 0.5
"""Least share of draws with a finite ratio for an experiment to count, so that one outlying draw drops none."""
LENGTH_NAMES = names_of("transmission_error_length_deg")
ABSENT_AT_ZERO = tuple(
    name
    for name in (*HARMONIC_NAMES, *GEAR_ERROR_NAMES, *LATE_NAMES)
    if name not in (*LENGTH_NAMES, *names_of("creep_minutes"))
)
"""Parameters that are not reported where they are fixed at 0."""
MIXING_SEED = 11
"""Fixed seed, so that all results of one fit have the same draws row by row."""
CURVE_POINTS, CURVE_DRAWS = 7, 2048
"""Points of a curve; draws of equal weight for them: the error of a mean is 1/45 of its sd, below a line's width."""


def _estimate(value: float, draws: np.ndarray, weights: np.ndarray, prior_draws: np.ndarray) -> Estimate:
    """Build an estimate from weighted draws: equal-tailed interval, standard deviations."""
    # The mean of equal numbers may have a rounding error: a fixed quantity would scatter by 1e-17 of its value.
    prior_sd = float(np.std(prior_draws)) if np.ptp(prior_draws) > 0 else 0.0
    sd = float(np.sqrt(weights @ (draws - weighted_mean(draws, weights)) ** 2))
    contraction = float(1 - (sd / prior_sd) ** 2) if prior_sd > 0 else None
    low, high = weighted_quantiles(draws, weights, TAILS)
    return Estimate(float(value), sd, (float(low), float(high)), prior_sd, contraction)


def draws_of_ways(fit: JointFit) -> tuple[Derived, np.ndarray]:
    """Concatenate the Laplace draws of all fitted homing hypotheses; their weights (n,) of sum 1.

    Those of the fit alone where the sides were recorded.
    """
    parts = [(way.probability, way.fit.draws) for way in fit.mixture if way.fit is not None]
    counts = [len(part.physical) for _, part in parts]
    weights = np.concatenate([np.full(n, p / n) for n, (p, _) in zip(counts, parts, strict=True)])
    return jax.tree.map(lambda *each: np.concatenate(each), *(part for _, part in parts)), weights / weights.sum()


def equal_laplace_draws(fit: JointFit) -> Derived:
    """Resample `draws_of_ways` with equal weights, as many as the fit has; its own draws if there is one way."""
    if len(fit.mixture) == 1:
        return fit.draws
    draws, weights = draws_of_ways(fit)
    # Without the permutation the first draws would be of one way only.
    places = np.random.default_rng(MIXING_SEED).permutation(systematic(weights, len(fit.draws.physical), 0.5))
    return jax.tree.map(lambda x: x[places], draws)


class _Source:
    """Source of the estimates: the Laplace approximation, or a posterior and its diagnosis."""

    def __init__(self, fit: JointFit, posterior: Posterior | None):
        self.fit, self.posterior = fit, posterior
        self.prior = fit.prior_draws
        if posterior is None:
            self.centre = fit.mode
            self.draws, self.weights = draws_of_ways(fit)
        else:
            self.centre, self.draws, self.weights = posterior.centre, posterior.joined, posterior.weights.ravel()

    def estimate(self, name: str) -> Estimate:
        """Estimate a quantity that is linear in the fields of `Derived`, with the sampler's diagnosis."""
        plain = _estimate(float(self.centre[name]), self.draws[name], self.weights, self.prior[name])
        if self.posterior is None:
            return plain
        convergence = self.posterior.convergence
        return structs.replace(
            plain,
            rhat=convergence.rhat.get(name),
            ess_bulk=convergence.ess_bulk.get(name),
            ess_tail=convergence.ess_tail.get(name),
        )


def _absent(fit: JointFit) -> set[str]:
    """Return parameters absent from the model: of gear errors, scatter of looks and of homings, shifts of zeros."""
    none = {name for name in ABSENT_AT_ZERO if not fit.free[fit.names.index(name)] and fit.values[name] == 0}
    for axis in AXES:
        if {f"transmission_error_deg.{axis}", f"play_variation_deg.{axis}"} <= none:
            none.add(f"transmission_error_length_deg.{axis}")
    homed = np.asarray(fit.arrays.spots.homed).any(axis=0)
    none |= {name for name, seen in zip(HOME_SD_NAMES, homed, strict=True) if not seen}
    return none | ({"creep_minutes"} if set(names_of("creep_deg")) <= none else set())


def _parameters(source: _Source) -> dict[str, Estimate]:
    """Estimate the parameters; Laplace interval ends are exact images of z -+ 1.96 sd under monotone maps.

    For a mixture of homing hypotheses they are quantiles of its draws, as for a posterior.
    """
    fit = source.fit
    low, high = fit.ends95
    has_readings = bool(np.any(np.asarray(fit.arrays.spots.has_aperture) > 0))
    absent = _absent(fit) | (set() if has_readings else set(RECEIVER_NAMES))
    estimates = {name: source.estimate(name) for name in fit.names if name not in absent}
    if source.posterior is not None or len(fit.mixture) > 1:
        return estimates
    for index, name in enumerate(fit.names):
        if (estimate := estimates.get(name)) is not None:
            # Stereo parameters mix coordinates linearly.
            half = NORMAL_95 * estimate.sd
            exact = (estimate.value - half, estimate.value + half)
            ends = (float(low[index]), float(high[index])) if index < fit.space.rig else exact
            estimates[name] = structs.replace(estimate, interval95=ends)
    return estimates


def _by_part(source: _Source, block: str, moved: set[str]) -> dict[str, Estimate | None]:
    """Estimate quantities of a block, by the last part of their names; None for directions that never moved."""
    quantities = (QUANTITIES[name] for name in QUANTITIES.blocks[block])
    return {of.parts[-1]: source.estimate(of.name) if of.applies(moved) else None for of in quantities}


def _classic_predicted(source: _Source) -> dict[str, Estimate | None]:
    """Predict each direction's classic mean from ideal spots of the fitted model.

    Under the Laplace approximation it is linear in the parameters about the mode, as the pixels are: over their
    uncertainty the nonlinearity is less than 1/100 of its standard deviation. Under a posterior the pixels are computed
    for each draw. The classic's stereo calibration is the stated one.
    """
    fit = source.fit
    selection = select_experiments(fit.campaign)
    result: dict[str, Estimate | None] = dict.fromkeys(DIRECTIONS)
    if not len(selection.experiments):
        return result
    rows = experiment_rows(fit.campaign, selection)
    experiment = selection.steps, selection.axis, fit.campaign.stereo_pair
    if source.posterior is None:
        slopes = ratio_slopes(np.asarray(fit.linearised.predicted)[rows][..., :4], *experiment)
        push = np.asarray(fit.linearised.predicted_jacobian)[rows][..., :4, :]
        centre, slope = slopes.ratio, np.einsum("epq,epqz->ez", slopes.by_pixel, push)
        draws = centre + (fit.draws_z[:CLASSIC_DRAWS] - fit.z) @ slope.T
    else:
        draws = four_point_ratios(ideal_pixels(source.posterior, CLASSIC_DRAWS)[:, rows], *experiment)
        centre = np.where(np.isfinite(draws), draws, 0.0).sum(axis=0) / np.maximum(np.isfinite(draws).sum(axis=0), 1)
    finite = np.isfinite(draws).mean(axis=0) > SEEN_SHARE
    for direction in DIRECTIONS:
        # Pixels far outside the image, of an outlying fit or draw, cannot be undistorted: there is no ratio then.
        chosen = (selection.direction == direction) & finite
        values = draws[:, chosen].mean(axis=1) if chosen.any() else np.zeros(0)
        values = values[np.isfinite(values)]
        if len(values):
            sd = float(values.std())
            result[direction] = Estimate(float(centre[chosen].mean()), sd, interval95(values), None, None)
    return result


def _curves(posterior: Posterior, moved: set[str]) -> Curves:
    """Compute local ratios along both axes over the range seen, and lost motion at the step counts used."""
    lost = {direction: _lost_motion(posterior, direction) for direction in DIRECTIONS if direction in moved}
    some = posterior.resampled(1, CURVE_DRAWS)
    along: dict[str, tuple[CurvePoint, ...]] = {axis: _along(some, index, moved) for index, axis in enumerate(AXES)}
    return Curves(along, lost)


def _along(posterior: Posterior, axis: int, moved: set[str]) -> tuple[CurvePoint, ...]:
    """Compute local ratios at angles of one axis, the other at the reference pose."""
    angles = np.degrees(posterior.fit.linearised.mirror_angles_rad)[:, axis]
    points = []
    for angle in np.linspace(angles.min(), angles.max(), CURVE_POINTS):
        pose = np.degrees(posterior.fit.reference_pose_rad)
        pose[axis] = angle
        pan, tilt = pose.tolist()
        ratios = zip(DIRECTIONS, _measured(posterior.local_deg_per_step(pan, tilt)), strict=True)
        moving = {direction: Measured(*ratio) for direction, ratio in ratios if direction in moved}
        points.append(CurvePoint(pan, tilt, **moving))
    return tuple(points)


def _measured(estimates: Propagated) -> list[tuple[float, float, tuple[float, float]]]:
    """Mean, sd and interval of each quantity."""
    rows = np.column_stack([estimates.mean, estimates.sd, *estimates.interval95]).tolist()
    return [(mean, sd, (low, high)) for mean, sd, low, high in rows]


def _lost_motion(posterior: Posterior, direction: str) -> tuple[LostMotion, ...]:
    """Compute the mirror angle lost by a reversal, at a few of the move lengths of the campaign."""
    used = sorted(set(legs_of(posterior.fit.campaign.moves)[direction]))
    chosen = np.unique(np.linspace(0, len(used) - 1, min(CURVE_POINTS, len(used))).astype(int))
    steps = [used[i] for i in chosen]
    motion = _measured(posterior.lost_motion_deg(direction, np.array(steps)))
    return tuple(LostMotion(n, *each) for n, each in zip(steps, motion, strict=True))


def seen_range(fit: JointFit) -> dict[str, tuple[int, int]]:
    """Return the lowest and highest counter of each axis with a used look."""
    used = fit.arrays.used
    moves = np.unique(np.asarray(fit.arrays.spots.move_index)[: len(used)][used])
    steps = {axis: [getattr(fit.campaign.moves[move], f"{axis}_steps") for move in moves] for axis in AXES}
    return {axis: (min(counters), max(counters)) for axis, counters in steps.items()}


def worth_sampling(fit: JointFit) -> bool:
    """Whether a fit has converged and its data informed any effective ratio."""
    if not fit.converged:
        return False
    effective = _by_part(_Source(fit, None), EFFECTIVE, moved_directions(fit))
    return any(e is not None and e.informed for e in effective.values())


def summarise(fit: JointFit, posterior: Posterior | None = None) -> FitSummary:
    """Summarise a fit in the terms of `fit.json`.

    Args:
        fit: a joint fit, converged or not.
        posterior: its sample. If it has no answer, the Laplace approximation is returned, labelled so, and not
            converged.

    Returns:
        Headlines, parameters and diagnostics.
    """
    moved = moved_directions(fit)
    usable = posterior if posterior is not None and posterior.converged else None
    source = _Source(fit, usable)
    observations = float(fit.campaign.rig.mechanism.residuals * fit.arrays.used.sum() + fit.arrays.read.sum())
    determined = float(np.trace(fit.information.fisher @ fit.covariance))
    pan, tilt = np.degrees(fit.reference_pose_rad).tolist()
    (a, b), (c, d) = np.asarray(source.centre.jacobian).tolist()
    problems = fit.problems
    if posterior is not None:
        lacks = {"accepted": "", "rough": "ROUGH", "laplace": "LAPLACE"}[posterior.convergence.answer]
        problems += tuple(f"{lacks}: {sentence}" for sentence in posterior.convergence.missing)
    # Quantities by direction have their own fields in `fit.json`.
    others = [name for name in derived_names(fit.space.mechanism) if not QUANTITIES[name].ratio]
    parameters = {**_parameters(source), **{name: source.estimate(name) for name in others}}
    return FitSummary(
        converged=fit.converged and (posterior is None or posterior.converged),
        answer="laplace" if posterior is None else posterior.convergence.answer,
        monte_carlo_error={} if posterior is None else posterior.convergence.monte_carlo_error,
        problems=problems,
        effective=_by_part(source, EFFECTIVE, moved),
        contrasts=_by_part(source, "effective_contrast_deg_per_step", moved),
        reference_pose_deg={"pan": pan, "tilt": tilt},
        jacobian=((a, b), (c, d)),
        parameters=parameters,
        noise=fit_noise(fit.chi2, observations - determined, parameters),
        weak_directions=(
            *weak_directions(fit),
            *sum_directions(fit.names, fit.free, np.asarray(source.draws.physical), source.weights),
        ),
        leverage=leverage(fit),
        classic_predicted=_classic_predicted(source),
        excluded_spots=fit.excluded_spots,
        suspect_spots=fit.suspect_spots,
        prior_conflicts=prior_conflicts(fit),
        prior_sensitivity=prior_sensitivity(fit, usable),
        estimator="laplace" if usable is None else "posterior",
        tier=None if usable is None else usable.tier,
        sampling=None if posterior is None else posterior.convergence.sampling,
        curves=None if usable is None else _curves(usable, moved),
        validation=validate(fit),
        few_stops=poorly_known_stops(fit),
        local=_by_part(source, "local_deg_per_step", moved),
        range_steps=seen_range(fit),
        homing_side=fit.homing_side,
        periods=() if usable is None else gear_periods(usable),
    )
