"""The gap between the classic and joint estimates term by term, and the cameras' uncertainty, common to both.

Ratios in deg/step. The classic estimator is applied to the model's own spots while the rig is made ideal step by step.
JAX is loaded by the computation, not by the import.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tvsbayes.estimators.four_point import classic_of, experiment_rows, four_point_ratios, select_experiments
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.parameters import OPTICS_NAMES
from tvsbayes.results.comparison_record import Gap, GapTerm
from tvsbayes.statistics.intervals import interval95
from tvsbayes.statistics.weighted_draws import TAILS, weighted_mean, weighted_quantiles

if TYPE_CHECKING:
    from tvsbayes.estimators.joint_fit import JointFit
    from tvsbayes.model.parameter_space import ParameterSpace
    from tvsbayes.posterior.draws import Posterior
    from tvsbayes.posterior.predictive import OneWay


GAP_DRAWS = 128
"""Number of draws: it gives the sds of terms to 6 %; each draw takes four classic estimates of every experiment."""
OPTICS = OPTICS_NAMES[1:]
"""Parameters of the optics that are zero in the nominal rig."""
BACKLASH, STEREO_SCALE, SKEW, PROJECTION, CHANCE = (
    "backlash over N",
    "stereo scale and focal scale",
    "skew of mirrors, laser and axes",
    "projection and pose",
    "chance",
)
"""Terms of the gap. The last is due to the classic's own spots: stop errors and pixel noise."""


def _ideal(space: ParameterSpace, names: Sequence[str]) -> ParameterSpace:
    """Fix parameters at their ideal values: 0, or 1 for the focal scale; cameras as stated."""
    from tvsbayes.model.compiled import placed

    value, u = np.array(space.value), np.array(space.u)
    index = {name: number for number, name in enumerate(space.mechanism.rig_names)}
    for name in names:
        if name in index:
            value[index[name]], u[index[name]] = float(name == "focal_scale"), 0.0
    space = replace(space, value=placed(value), u=placed(u))
    if "focal_scale" in names:
        space = replace(space, stereo_root=placed(np.zeros(space.stereo_root.shape)))
    return space


def explain_gap(fit: JointFit, posterior: Posterior | None = None, draws: int = GAP_DRAWS) -> dict[str, Gap | None]:
    """Split the gap between both estimators term by term (formulation 1).

    For every draw the model predicts the classic estimator's spots without noise, then without backlash, then with the
    stated cameras, then with ideal optics. Each change of the classic mean is one term. The remaining difference from
    the ratio of the ideal optics is projection: the tilt computed as atan(dZ/dX) off the X axis, the offset of the
    mirrors, poses other than the reference. Terms depend little on their order, and they add up to the gap.

    Args:
        fit: a converged fit of the campaign.
        posterior: its sample, for draws instead of those of the Laplace approximation.
        draws: number of draws for the intervals of the terms, at least two; ratio and gap use all.

    Returns:
        By direction; None without complete experiments.
    """
    from tvsbayes.posterior.draws import derived_of
    from tvsbayes.posterior.predictive import by_way, looks, turned_by

    selection = select_experiments(fit.campaign)
    result: dict[str, Gap | None] = dict.fromkeys(DIRECTIONS)
    # Sightings of a head have no experiments, and no points that classic could take.
    if not len(selection.experiments) or (measured := classic_of(fit.campaign)) is None:
        return result
    chosen = _chosen_draws(fit, posterior, draws)
    z, errors_rad, rows = chosen.z, chosen.place_errors_rad, experiment_rows(fit.campaign, selection)
    # Without play there is no variation of play either.
    straight_rad = np.where(np.arange(errors_rad.shape[1]) < errors_rad.shape[1] // 2, errors_rad, 0.0)
    spaces = [fit.space]
    for names in (("backlash_deg.pan", "backlash_deg.tilt"), ("focal_scale",), OPTICS):
        spaces.append(_ideal(spaces[-1], names))
    ratios = []
    for space in spaces:
        repeating_rad = errors_rad if space is spaces[0] else straight_rad

        def of_way(way: JointFit, values: np.ndarray, space=space, repeating_rad=repeating_rad) -> np.ndarray:
            return looks(replace(way, space=space), z[values], turned_by(way.arrays, repeating_rad[values]))[:, rows]

        pixels = by_way(chosen.ways, of_way)
        ratios.append(four_point_ratios(pixels, selection.steps, selection.axis, fit.campaign.stereo_pair))
    full, ideal = (
        np.asarray(derived_of(replace(fit, space=space), z[None], errors_rad[None]).effective_deg_per_step)[0]
        for space in (spaces[0], spaces[-1])
    )
    # An experiment with coincident spots, or spots outside the lens model, has no ratio.
    sound = np.all([np.isfinite(each).all(axis=0) for each in ratios], axis=0)
    for k, direction in enumerate(DIRECTIONS):
        mine, classic = (selection.direction == direction) & sound, measured.directions[direction]
        if mine.any() and classic is not None:
            means = [each[:, mine].mean(axis=1) for each in ratios]
            result[direction] = _gap(classic.mean_deg_per_step, chosen, means, full[:, k], ideal[:, k], k)
    return result


class _Chosen(NamedTuple):
    """Draws used for the terms.

    Attributes:
        z: coordinates (n, p); for the Laplace approximation the mode, then draws.
        place_errors_rad: repeating errors of the gears, shape (n, e).
        mode_first: whether the first row is the mode; else the estimate is the mean of the draws.
        ratios: effective ratios of all draws, shape (N, 4), deg/step.
        weights: weights of all draws, sum 1, shape (N,).
        ways: homing hypotheses of the draws, several where it was not recorded.
    """

    z: np.ndarray
    place_errors_rad: np.ndarray
    mode_first: bool
    ratios: np.ndarray
    weights: np.ndarray
    ways: tuple[OneWay, ...]


def _chosen_draws(fit: JointFit, posterior: Posterior | None, draws: int) -> _Chosen:
    from tvsbayes.posterior.predictive import OneWay, ways_of

    if posterior is None:
        z = np.vstack([fit.z, fit.draws_z[:draws]])
        errors_rad = np.vstack([fit.mode.place_errors_rad, fit.draws.place_errors_rad[:draws]])
        ratios = np.asarray(fit.draws.effective_deg_per_step)
        alone = (OneWay(fit, np.arange(len(z))),)
        return _Chosen(z, errors_rad, True, ratios, np.full(len(ratios), 1 / len(ratios)), alone)
    errors_rad = np.asarray(posterior.thinned(draws).place_errors_rad)
    ratios = np.asarray(posterior.joined.effective_deg_per_step)
    ways = ways_of(posterior, posterior.chosen(draws))
    return _Chosen(posterior.coordinates(draws), errors_rad, False, ratios, posterior.weights.ravel(), ways)


def _gap(
    reported: float, chosen: _Chosen, classic: Sequence[np.ndarray], full: np.ndarray, ideal: np.ndarray, k: int
) -> Gap:
    """Compute the gap of direction k from the reported classic mean.

    Args:
        reported: that mean.
        chosen: draws.
        classic: the classic mean (n,) on the model's own spots, each: as estimated, without backlash, with the stated
            cameras, with ideal optics.
        full: effective ratio (n,) of the estimated rig.
        ideal: effective ratio (n,) of the ideal optics.
        k: number of the direction.
    """
    whole, unplayed, scaled, straight = classic
    parts = {
        BACKLASH: whole - unplayed,
        STEREO_SCALE: unplayed - scaled,
        SKEW: scaled - straight - (full - ideal),
        PROJECTION: straight - ideal,
        CHANCE: reported - whole,
    }
    # The ratio is computed from all draws, as in every table. Its mean is a control variate for the means of the terms,
    # which then add up to the gap.
    ratio, weights = chosen.ratios[:, k], chosen.weights
    mean = weighted_mean(ratio, weights)
    centre = float(full[0] if chosen.mode_first else mean)

    def term(name: str, values: np.ndarray) -> GapTerm:
        if chosen.mode_first:
            value, sampled = values[0], values[1:]
        else:
            slope = np.cov(values, full)[0, 1] / full.var(ddof=1) if np.ptp(full) > 0 else 0.0
            value, sampled = values.mean() + slope * (centre - full.mean()), values
        return GapTerm(name, float(value), float(sampled.std()), interval95(sampled))

    sd = float(np.sqrt(weights @ (ratio - mean) ** 2))
    low, high = weighted_quantiles(ratio, weights, TAILS).tolist()
    joint = GapTerm("effective ratio", centre, sd, (low, high))
    total = GapTerm("classic - joint", float(reported - centre), sd, (reported - high, reported - low))
    return Gap(reported, joint, total, tuple(term(name, values) for name, values in parts.items()))


def camera_influence(fit: JointFit, values: np.ndarray) -> np.ndarray:
    """Compute shifts (q, cameras) of quantities with draws (n, q) by one prior sd of each camera parameter.

    The parameters are the focal scale and the stereo coordinates; the prior of coordinate j shifts the mode by S e_j.
    """
    from tvsbayes.assessment.headlines import gradients

    fisher = fit.information.fisher
    cameras = [fit.names.index("focal_scale"), *range(fit.space.rig, len(fit.names))]
    return (gradients(fit, values) @ np.linalg.inv(fisher + np.eye(len(fisher))))[:, cameras]


def camera_u(fit: JointFit) -> np.ndarray:
    """Compute the standard uncertainty (4,) of the effective ratios due to stereo calibration and focal scale alone."""
    shift = camera_influence(fit, np.asarray(fit.draws.effective_deg_per_step))
    return np.sqrt(np.sum(shift**2, axis=1))
