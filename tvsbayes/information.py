"""What a fit knows: headlines, contraction, weak directions, leverage of stops, causes of its covariance, calibration.

Works on a finished `JointFit`, and on a `Posterior` where there is one; computes no new fit. Units are those of
DESIGN 8.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
from scipy import special, stats

from tvsbayes.calibration import CONTRACTION_LIMIT, INPUT_NAMES, NORMAL_95, Calibration, calibration_of_draws
from tvsbayes.campaign import Move
from tvsbayes.classic import (
    DIRECTIONS,
    SHALLOW,
    four_point_ratios,
    observed_stops,
    select_experiments,
    separation,
)
from tvsbayes.joint import Derived, JointFit, linear_spots
from tvsbayes.likelihood import StopGroup, ordered_spots, standard_deviations_without, stop_information
from tvsbayes.model import INDEX, KINDS, NAMES, NOISE_NAMES, RECEIVER_NAMES, RIG_NAMES
from tvsbayes.posterior import Posterior, ideal_pixels
from tvsbayes.rigs import HARMONIC_PRIORS, STEREO_PARAMETER_NAMES

LEVERAGE_LIMIT = 2.0
"""A stop is named if a headline's sd would grow by more than this factor without it (DESIGN 4.2)."""
EXCHANGE_LIMIT = 0.5
"""Correlation of ratio and backlash above which a quarter of the ratio's variance is exchange with the backlash."""
LOADING_LIMIT = 0.3
WEAK_VARIANCE = 0.5
"""A direction of parameter space is weak if more than this share of its prior variance is left."""
CONFLICT_LIMIT = 4.0
"""Prior standard deviations; of fifty parameters one lies beyond it in 3 of 1000 honest campaigns."""
SENSITIVE_SHIFT = 0.2
"""Change of a headline, in its sds, when a prior is doubled or halved, from which it is listed."""
SENSITIVE_SD = 0.1
"""Relative change of a headline's sd from which it is listed."""
SENSITIVITIES_LISTED = 16
LISTED = 8
CLASSIC_DRAWS = 256
CURVE_POINTS = 7
DRAWS_KEPT = 4096
"""Posterior draws in a calibration, evenly chosen; posterior.nc holds them all."""
VALIDATION_LEVEL = 0.01
"""Probability, all tests together, with which a clean campaign fails its validation; experiments/model_error.md."""
CHANGE_POINTS = 16
"""Places, evenly over the spots, at which cameras may have moved; twice as many for lost steps."""
WAVES = 16
"""Transmission errors looked for per axis: 1/2, 1, 3/2 ... periods over the range that was seen."""
ABSORBED = 1e-3
"""Share of a defect's effect below which the fit has swallowed it: what is left is no more than its curvature."""
KNOWN_DIRECTION = 1e-4
"""Information (in prior sds) from which the fit can move along a direction; below it the spots cannot follow."""


@dataclass(frozen=True)
class Estimate:
    """One estimated quantity; `contraction` = 1 - var_post / var_prior, None where nothing is estimated.

    `value` is the mode of a Laplace approximation or the mean of a posterior; the last three are a sampler's.
    """

    value: float
    sd: float
    interval95: tuple[float, float]
    prior_sd: float | None
    contraction: float | None
    rhat: float | None = None
    ess_bulk: float | None = None
    ess_tail: float | None = None

    def as_json(self) -> dict[str, object]:
        """The sampler's diagnostics are null where nothing was sampled (DESIGN 8)."""
        return {**asdict(self), "interval95": list(self.interval95)}

    @property
    def informed(self) -> bool:
        """Whether the data, not the prior, set the value."""
        return self.contraction is not None and self.contraction >= CONTRACTION_LIMIT


@dataclass(frozen=True)
class WeakDirection:
    """A mixture of parameters that the data leave to the prior; loadings are in prior sds."""

    text: str
    loadings: dict[str, float]


@dataclass(frozen=True)
class Leverage:
    """A stop without which the sd of `quantity` would grow by `factor` (None: beyond all bounds)."""

    move: int
    spots: tuple[int, ...]
    quantity: str
    factor: float | None
    text: str


@dataclass(frozen=True)
class PriorSensitivity:
    """What a headline would do if the u of one prior were multiplied by `factor`.

    `shift_sd` is the change of the value in its present sds, `sd_ratio` the new sd over the present one.
    """

    parameter: str
    quantity: str
    factor: float
    shift_sd: float
    sd_ratio: float


@dataclass(frozen=True)
class ValidationTest:
    """One question to the residuals of a fit: is there a trace of this defect?

    Attributes:
        name: defect.
        where: most suspicious place or period, in words.
        chi2: score statistic there, distributed as chi-square with `dof` if the model holds.
        dof: sizes of the defect that the fit would not swallow.
        places: how many places or periods were asked about.
        p: probability of such a statistic in a clean campaign, any place.
        failed: whether p is too small, all tests taken together.
        shift_sd: most that the defect, in the size seen, would move a ratio or backlash, in their sds.
    """

    name: str
    where: str
    chi2: float
    dof: int
    places: int
    p: float
    failed: bool
    shift_sd: float


@dataclass(frozen=True)
class Validation:
    """Whether the residuals of a fit look as its model says.

    Attributes:
        passed: no test failed.
        level: probability with which a clean campaign does not pass.
        cause: the defect that explains the residuals best, in words; empty where all passed.
        inflation: factor on every standard uncertainty; 1 where all passed.
        tests: every question that the campaign can answer.
    """

    passed: bool
    level: float
    cause: str
    inflation: float
    tests: tuple[ValidationTest, ...]

    def as_json(self) -> dict[str, object]:
        """An optional key of `fit.json`."""
        return {**asdict(self), "tests": [asdict(test) for test in self.tests]}


@dataclass(frozen=True)
class FitSummary:
    """A joint fit in the contract's terms (DESIGN 8).

    Attributes:
        converged: whether the mode was reached.
        problems: sentences on what failed.
        effective: left, right, up, down in deg/step; None for a direction that was never moved.
        contrasts: effective left - right and up - down, deg/step.
        reference_pose_deg: pan and tilt at which the effective ratios hold.
        jacobian: d(azimuth, elevation)/d(pan, tilt) there.
        parameters: every estimated or derived parameter by its name.
        chi2: squared standardised innovations; dof: their number less the parameters they determine.
        weak_directions: what the campaign cannot separate, in words.
        leverage: stops on which a headline hangs.
        classic_predicted: what the classic estimator should report if the model is right, per direction.
        excluded_spots: left out by the robust option.
        suspect_spots: used, but in disagreement with all others.
        prior_conflicts: parameters that the data pull far from what was stated, in words.
        prior_sensitivity: priors that would move a headline if they were twice or half as wide.
        estimator: "posterior" if a converged sample stands behind the numbers, else "laplace".
        sampling: diagnosis of the chain, None where nothing was sampled.
        curves: effective ratios over the range and lost motion against steps; only from a posterior.
        validation: whether the residuals look as the model says; None where nobody asked.
        few_stops: directions in which so few stops were seen that their scatter is poorly known, with the number.
    """

    converged: bool
    problems: tuple[str, ...]
    effective: dict[str, Estimate | None]
    contrasts: dict[str, Estimate | None]
    reference_pose_deg: dict[str, float]
    jacobian: tuple[tuple[float, float], tuple[float, float]]
    parameters: dict[str, Estimate]
    chi2: float
    dof: float
    weak_directions: tuple[WeakDirection, ...]
    leverage: tuple[Leverage, ...]
    classic_predicted: dict[str, Estimate | None]
    excluded_spots: tuple[int, ...]
    suspect_spots: tuple[int, ...]
    prior_conflicts: tuple[str, ...]
    prior_sensitivity: tuple[PriorSensitivity, ...]
    estimator: str = "laplace"
    sampling: dict[str, object] | None = None
    curves: dict[str, object] | None = None
    validation: Validation | None = None
    few_stops: dict[str, int] = field(default_factory=dict)

    @property
    def headline_informed(self) -> bool:
        """Whether the data informed any effective ratio."""
        return any(e is not None and e.informed for e in self.effective.values())

    def as_json(self) -> dict[str, object]:
        """The contract's keys, without those that the caller adds (`files`)."""

        def of(estimates):
            return {name: None if e is None else e.as_json() for name, e in estimates.items()}

        parameters = of(self.parameters)
        return {
            "estimator": self.estimator,
            "converged": self.converged,
            "problems": list(self.problems),
            "effective_deg_per_step": of(self.effective),
            "effective_contrast_deg_per_step": of(self.contrasts),
            "reference_pose_deg": self.reference_pose_deg,
            "effective_jacobian": [list(row) for row in self.jacobian],
            "parameters": parameters,
            "noise": {
                "chi2": self.chi2,
                "dof": self.dof,
                "pixel_scale": self.parameters["pixel_scale"].value,
                "stop_sd_deg": {d: self.parameters[f"stop_sd_deg.{d}"].value for d in DIRECTIONS},
            },
            "weak_directions": [asdict(w) for w in self.weak_directions],
            "leverage": [{**asdict(entry), "spots": list(entry.spots)} for entry in self.leverage],
            "classic_predicted_deg_per_step": of(self.classic_predicted),
            "excluded_spots": list(self.excluded_spots),
            "suspect_spots": list(self.suspect_spots),
            "prior_conflicts": list(self.prior_conflicts),
            "prior_sensitivity": [asdict(entry) for entry in self.prior_sensitivity],
            "sampling": self.sampling,
            "curves": self.curves,
            "validation": None if self.validation is None else self.validation.as_json(),
            "few_stops": self.few_stops,
        }


def _estimate(mode: float, draws: np.ndarray, prior_draws: np.ndarray) -> Estimate:
    """From draws: equal-tailed interval, sample standard deviations."""
    # The mean of equal numbers may be off by a rounding: what is fixed would scatter by 1e-17 of itself.
    sd, prior_sd = (float(np.std(x)) if np.ptp(x) > 0 else 0.0 for x in (draws, prior_draws))
    low, high = np.quantile(draws, [0.025, 0.975])
    contraction = float(1 - (sd / prior_sd) ** 2) if prior_sd > 0 else None
    return Estimate(float(mode), sd, (float(low), float(high)), prior_sd, contraction)


class _Source:
    """Where the numbers come from: the Laplace approximation, or a posterior and its diagnosis."""

    def __init__(self, fit: JointFit, posterior: Posterior | None):
        self.fit, self.posterior = fit, posterior
        self.prior = fit.prior_draws
        if posterior is None:
            self.centre, self.draws = fit.mode, fit.draws
        else:
            self.draws = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), posterior.draws)
            self.centre = jax.tree.map(lambda x: x.mean(axis=0), self.draws)

    def estimate(self, name: str, of: Callable[[Derived], np.ndarray]) -> Estimate:
        """A quantity that is linear in the fields of `Derived`, with the sampler's diagnosis of `name`."""
        plain = _estimate(*(of(draws) for draws in (self.centre, self.draws, self.prior)))
        if self.posterior is None:
            return plain
        found = self.posterior.convergence
        return replace(
            plain,
            rhat=found.rhat.get(name),
            ess_bulk=found.ess_bulk.get(name),
            ess_tail=found.ess_tail.get(name),
        )


def _parameters(source: _Source) -> dict[str, Estimate]:
    """Parameters with a coordinate; Laplace interval ends are exact images of z -+ 1.96 sd under monotone maps."""
    fit = source.fit
    low, high = fit.ends95
    has_readings = bool(np.any(np.asarray(fit.arrays.spots.has_aperture) > 0))
    estimates = {}
    for index, name in enumerate(NAMES):
        if name in RECEIVER_NAMES and not has_readings:
            continue
        if name in HARMONIC_PRIORS and not fit.free[index] and fit.mode.physical[index] == 0:
            continue
        estimate = source.estimate(name, lambda d, i=index: d.physical[..., i])
        if source.posterior is not None:
            estimates[name] = estimate
            continue
        if index >= len(RIG_NAMES):
            # Stereo parameters mix coordinates linearly.
            ends = (estimate.value - NORMAL_95 * estimate.sd, estimate.value + NORMAL_95 * estimate.sd)
        else:
            ends = (float(low[index]), float(high[index]))
        estimates[name] = replace(estimate, interval95=ends)
    return estimates


def _derived(source: _Source) -> dict[str, Estimate]:
    """Per-direction gear ratios and the effective mirror offset."""
    estimates = {}
    for axis, positive, negative in (("pan", "left", "right"), ("tilt", "up", "down")):
        ratio, contrast = INDEX[f"degrees_per_step.{axis}"], INDEX[f"ratio_contrast_deg_per_step.{axis}"]
        for direction, sign in ((positive, 0.5), (negative, -0.5)):
            name = f"degrees_per_step.{direction}"
            estimates[name] = source.estimate(
                name, lambda d, r=ratio, c=contrast, s=sign: d.physical[..., r] + s * d.physical[..., c]
            )
    name = "effective_mirror_offset_mm"
    estimates[name] = source.estimate(name, lambda d: d.effective_mirror_offset_mm)
    return estimates


def _moved_directions(fit: JointFit) -> set[str]:
    """Directions in which the campaign ever moved."""
    moved = set()
    moves = fit.campaign.moves
    for previous, move in pairwise(moves):
        if move.pan_approach:
            continue
        pan, tilt = move.pan_steps - previous.pan_steps, move.tilt_steps - previous.tilt_steps
        moved |= {d for d, yes in zip(DIRECTIONS, (pan > 0, pan < 0, tilt > 0, tilt < 0), strict=True) if yes}
    return moved


def _backlash_direction(fit: JointFit, axis: str, direction: str) -> WeakDirection | None:
    """Ratio and backlash of an axis, if they move together or the stops cannot separate them."""
    index = INDEX[f"backlash_deg.{axis}"]
    if not fit.free[index]:
        return None
    ratio = fit.draws.effective_deg_per_step[:, DIRECTIONS.index(direction)]
    if np.ptp(ratio) == 0:
        # Held by the priors: nothing moves with the backlash.
        return None
    correlation = float(np.corrcoef(ratio, fit.draws.physical[:, index])[0, 1])
    used = {s.move for s in fit.campaign.spots if s.status == "ok" and s.spot not in fit.excluded_spots}
    reason = separation(observed_stops(fit.campaign.moves, used, axis), axis)
    if reason is None and abs(correlation) < EXCHANGE_LIMIT:
        return None
    reason = reason or "the legs differ too little; add a cleared approach or longer legs"
    text = f"{axis} ratio and {axis} backlash move together (correlation {correlation:+.2f}): {reason}"
    return WeakDirection(text, {f"effective.{direction}": 1.0, f"backlash_deg.{axis}": correlation})


def _weak_directions(fit: JointFit, moved: set[str]) -> tuple[WeakDirection, ...]:
    found = []
    for axis, pair in (("pan", ("left", "right")), ("tilt", ("up", "down"))):
        if not moved & set(pair):
            text = f"the {axis} axis was never moved: its ratio and backlash are the prior's; add moves on that axis"
            found.append(WeakDirection(text, {f"degrees_per_step.{axis}": 1.0}))
            continue
        weak = _backlash_direction(fit, axis, pair[0] if pair[0] in moved else pair[1])
        if weak is not None:
            found.append(weak)
    noise = {"pixel_scale", *(n for n in NAMES if n.startswith(("stop_sd", "stereo")))}
    rows = np.array([i for i, name in enumerate(NAMES) if fit.free[i] and name not in noise])
    if rows.size == 0:
        return tuple(found)
    eigenvalues, vectors = np.linalg.eigh(fit.covariance[np.ix_(rows, rows)])
    for value, vector in list(zip(eigenvalues, vectors.T, strict=True))[::-1]:
        if value < WEAK_VARIANCE or len(found) >= LISTED:
            break
        order = np.argsort(-np.abs(vector))
        loadings = {NAMES[rows[i]]: float(vector[i]) for i in order if abs(vector[i]) > LOADING_LIMIT}
        if not loadings:
            loadings = {NAMES[rows[order[0]]]: float(vector[order[0]])}
        names = list(loadings)
        # Rounding may leave a hair more than the prior's variance: more than 100 % is not a finding.
        left = f"{min(100.0, 100 * value):.0f} % of"
        if len(names) == 1:
            text = f"{names[0]} is set by the prior: {left} its variance is left; state it better or accept it"
        else:
            listed = ", ".join(names[:-1]) + " and " + names[-1]
            text = f"{listed} move together, set by the prior: {left} that direction's variance is left; "
            text += "state one of them better or accept it"
        found.append(WeakDirection(text, loadings))
    return tuple(found)


def _headline_gradients(fit: JointFit, moved: set[str]) -> tuple[list[str], np.ndarray]:
    """Effective ratios and backlashes with d(quantity)/d(coordinates), shape (q, p)."""
    quantities = {
        f"effective {d}": fit.draws.effective_deg_per_step[:, k] for k, d in enumerate(DIRECTIONS) if d in moved
    }
    for axis in ("pan", "tilt"):
        # In coordinates, where the backlash is Gaussian.
        quantities[f"backlash {axis}"] = fit.draws_z[:, INDEX[f"backlash_deg.{axis}"]]
    # What the priors hold fixed scatters by roundings, which nothing may be measured by.
    quantities = {name: v for name, v in quantities.items() if np.ptp(v) > 1e-12 * np.max(np.abs(v))}
    return list(quantities), gradients(fit, np.stack(list(quantities.values()), axis=1))


def gradients(fit: JointFit, values: np.ndarray) -> np.ndarray:
    """d(quantity)/d(coordinates), shape (q, p), of quantities with values (draws, q) on the Laplace draws.

    Regression on the moment-matched draws gives the gradient of the linear part, averaged over the posterior.
    """
    centred = fit.draws_z - fit.draws_z.mean(axis=0)
    cross = (values - values.mean(axis=0)).T @ centred / len(centred)
    return np.linalg.solve(fit.covariance, cross.T).T


def _prior_sensitivity(fit: JointFit, moved: set[str]) -> tuple[PriorSensitivity, ...]:
    """Each prior in turn doubled and halved in u, to first order about the mode (a refit of the linear model).

    Twice the u divides the prior's precision 1 of a coordinate by four. The stereo calibration is one prior: all its
    coordinates are scaled together. A half-normal is treated as normal in its coordinate.
    """
    quantities, gradients = _headline_gradients(fit, moved)
    rows = np.flatnonzero(fit.free)
    hessian = np.linalg.inv(fit.covariance[np.ix_(rows, rows)])
    gradients = gradients[:, rows]
    sd = np.sqrt(np.einsum("qi,ij,qj->q", gradients, fit.covariance[np.ix_(rows, rows)], gradients))
    pull = hessian @ fit.z[rows]
    names = np.array(NAMES)[rows]
    groups = {name: np.flatnonzero(names == name) for name in names if not name.startswith("stereo.")}
    groups["stereo calibration"] = np.flatnonzero(np.char.startswith(names, "stereo."))
    found = []
    for parameter, members in groups.items():
        for factor in (2.0, 0.5):
            changed = hessian.copy()
            changed[members, members] += factor**-2 - 1
            values, vectors = np.linalg.eigh(changed)
            inverse = (vectors / np.maximum(values, 1e-6)) @ vectors.T
            shift = gradients @ (inverse @ pull - fit.z[rows]) / sd
            ratio = np.sqrt(np.einsum("qi,ij,qj->q", gradients, inverse, gradients)) / sd
            for k, quantity in enumerate(quantities):
                if abs(shift[k]) > SENSITIVE_SHIFT or abs(np.log(ratio[k])) > np.log1p(SENSITIVE_SD):
                    found.append(PriorSensitivity(str(parameter), quantity, factor, float(shift[k]), float(ratio[k])))
    found.sort(key=lambda e: -max(abs(e.shift_sd), abs(np.log(e.sd_ratio))))
    return tuple(found[:SENSITIVITIES_LISTED])


def _leverage(fit: JointFit, moved: set[str]) -> tuple[Leverage, ...]:
    """Stops without which a headline's sd would more than double."""
    quantities, gradients = _headline_gradients(fit, moved)
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


def _classic_predicted(source: _Source) -> dict[str, Estimate | None]:
    """Mean of each direction as the classic estimator would compute it from ideal spots of the fitted model.

    Under the Laplace approximation pixels follow the parameters linearly from the mode, under a posterior they are
    those of each draw; the classic's stereo calibration stays the stated one.
    """
    fit = source.fit
    selection = select_experiments(fit.campaign)
    result: dict[str, Estimate | None] = dict.fromkeys(DIRECTIONS)
    if not len(selection.experiments):
        return result
    ordered = ordered_spots(fit.campaign)
    row_of = {spot.spot: row for row, spot in enumerate(ordered)}
    ids = np.array([s.spot for s in fit.campaign.spots])
    rows = np.vectorize(row_of.get)(ids[selection.spot_rows])

    def ratios(pixels):
        return four_point_ratios(pixels, selection.steps, selection.axis, fit.campaign.stereo)

    if source.posterior is None:
        pixels = fit.linearised.predicted[rows][..., :4]
        push = fit.linearised.predicted_jacobian[rows][..., :4, :]
        centre = ratios(pixels)
        draws = np.stack([ratios(pixels + push @ dz) for dz in fit.draws_z[:CLASSIC_DRAWS] - fit.z])
    else:
        draws = np.stack([ratios(pixels[rows]) for pixels in ideal_pixels(source.posterior, CLASSIC_DRAWS)])
        centre = draws.mean(axis=0)
    for direction in DIRECTIONS:
        # Pixels far from the image, of a fit that went astray, cannot be undistorted: there is no ratio then.
        chosen = (selection.direction == direction) & np.isfinite(centre)
        values = draws[:, chosen].mean(axis=1) if chosen.any() else np.zeros(0)
        values = values[np.isfinite(values)]
        if len(values):
            sd = float(values.std())
            low, high = np.quantile(values, [0.025, 0.975])
            result[direction] = Estimate(float(centre[chosen].mean()), sd, (float(low), float(high)), None, None)
    return result


def _prior_conflicts(fit: JointFit) -> tuple[str, ...]:
    """Parameters whose mode lies where their prior hardly allows: a wrong sign or unit, or a prior stated too tight."""
    found = []
    for index in np.flatnonzero(fit.free & (np.abs(fit.z) > CONFLICT_LIMIT)):
        value, distance = fit.mode.physical[index], abs(fit.z[index])
        found.append(
            f"{NAMES[index]} = {value:.4g} lies {distance:.1f} prior sds from its prior's centre: check the sign of "
            "the counters and the unit, or state the prior wider"
        )
    return tuple(found)


def _curves(posterior: Posterior, moved: set[str]) -> dict[str, object]:
    """Effective ratios along both axes over the range that was seen, and lost motion at the step counts used."""
    fit = posterior.fit
    angles = np.degrees(fit.linearised.mirror_angles_rad)
    middle = np.degrees(fit.reference_pose_rad)
    along = {}
    for axis, name in enumerate(("pan", "tilt")):
        rows = []
        for angle in np.linspace(angles[:, axis].min(), angles[:, axis].max(), CURVE_POINTS):
            pose = middle.copy()
            pose[axis] = angle
            found = posterior.effective_deg_per_step(*map(float, pose))
            entry = {"pan_deg": float(pose[0]), "tilt_deg": float(pose[1])}
            for k, direction in enumerate(DIRECTIONS):
                if direction in moved:
                    entry[direction] = {
                        "value": float(found.mean[k]),
                        "sd": float(found.sd[k]),
                        "interval95": found.interval95[:, k].tolist(),
                    }
            rows.append(entry)
        along[name] = rows
    used: dict[str, set[int]] = {d: set() for d in DIRECTIONS}
    for previous, move in pairwise(fit.campaign.moves):
        if not move.pan_approach:
            deltas = (move.pan_steps - previous.pan_steps, move.tilt_steps - previous.tilt_steps)
            for delta, (positive, negative) in zip(deltas, (("left", "right"), ("up", "down")), strict=True):
                if delta:
                    used[positive if delta > 0 else negative].add(abs(delta))
    lost = {}
    for direction in sorted(moved, key=DIRECTIONS.index):
        steps = sorted(used[direction])
        steps = [steps[i] for i in np.unique(np.linspace(0, len(steps) - 1, min(CURVE_POINTS, len(steps))).astype(int))]
        found = posterior.lost_motion_deg(direction, np.array(steps))
        lost[direction] = [
            {
                "steps": int(n),
                "value_deg": float(found.mean[k]),
                "sd_deg": float(found.sd[k]),
                "interval95_deg": found.interval95[:, k].tolist(),
            }
            for k, n in enumerate(steps)
        ]
    return {"effective_deg_per_step": along, "lost_motion": lost}


def summarise(fit: JointFit, posterior: Posterior | None = None) -> FitSummary:
    """Put a fit into the contract's terms.

    Args:
        fit: a joint fit, converged or not.
        posterior: its sample. One that has not converged lends no number: what is returned is then the Laplace
            approximation, labelled so, and not converged.

    Returns:
        Headlines, parameters and diagnostics.
    """
    moved = _moved_directions(fit)
    usable = posterior if posterior is not None and posterior.converged else None
    source = _Source(fit, usable)
    effective = {
        d: source.estimate(f"effective_deg_per_step.{d}", lambda x, k=k: x.effective_deg_per_step[..., k])
        if d in moved
        else None
        for k, d in enumerate(DIRECTIONS)
    }
    contrasts = {}
    for axis, first in (("pan", 0), ("tilt", 2)):
        both = {DIRECTIONS[first], DIRECTIONS[first + 1]} <= moved
        difference = source.estimate(
            f"effective_contrast_deg_per_step.{axis}",
            lambda x, k=first: x.effective_deg_per_step[..., k] - x.effective_deg_per_step[..., k + 1],
        )
        contrasts[axis] = difference if both else None
    readings = np.asarray(fit.arrays.spots.has_aperture * fit.arrays.spots.valid).sum()
    observations = 3 * float(np.asarray(fit.arrays.spots.valid).sum()) + float(readings)
    determined = float(np.trace(fit.information.fisher @ fit.covariance))
    pan, tilt = np.degrees(fit.reference_pose_rad)
    problems = fit.problems
    if posterior is not None:
        problems += tuple(f"UNCONVERGED: {sentence}" for sentence in posterior.convergence.missing)
    return FitSummary(
        converged=fit.converged and (posterior is None or posterior.converged),
        problems=problems,
        effective=effective,
        contrasts=contrasts,
        reference_pose_deg={"pan": float(pan), "tilt": float(tilt)},
        jacobian=tuple(tuple(float(x) for x in row) for row in source.centre.jacobian),
        parameters={**_parameters(source), **_derived(source)},
        chi2=fit.chi2,
        dof=observations - determined,
        weak_directions=_weak_directions(fit, moved),
        leverage=_leverage(fit, moved),
        classic_predicted=_classic_predicted(source),
        excluded_spots=fit.excluded_spots,
        suspect_spots=fit.suspect_spots,
        prior_conflicts=_prior_conflicts(fit),
        prior_sensitivity=_prior_sensitivity(fit, moved),
        estimator="laplace" if usable is None else "posterior",
        sampling=None if posterior is None else posterior.convergence.as_json(),
        curves=None if usable is None else _curves(usable, moved),
        validation=validate(fit),
        few_stops=_few_stops(fit, moved),
    )


FEW_STOPS = 12
"""Fewer tell their own scatter so poorly that 1.96 standard deviations of it hold less than 93 % (Student's t)."""


def _few_stops(fit: JointFit, moved: set[str]) -> dict[str, int]:
    """Directions that the campaign moved in and saw fewer than `FEW_STOPS` stops after, with their number."""
    used = {s.move for s in fit.campaign.spots if s.status == "ok" and s.spot not in fit.excluded_spots}
    found = {}
    for axis, directions in (("pan", ("left", "right")), ("tilt", ("up", "down"))):
        stops = observed_stops(fit.campaign.moves, used, axis)
        for direction, sign in zip(directions, (1, -1), strict=True):
            count = sum(stop.sign == sign for stop in stops)
            free = fit.free[INDEX[f"stop_sd_deg.{direction}"]]
            if direction in moved and free and count < FEW_STOPS:
                found[direction] = count
    return found


@dataclass(frozen=True)
class Causes:
    """What the covariance of the inputs of a coordinate comes from.

    Attributes:
        names: causes.
        covariance: their parts, shape (causes, inputs, inputs), ordered as `calibration.INPUT_NAMES`; they add up.
    """

    names: tuple[str, ...]
    covariance: np.ndarray


def prior_groups() -> dict[str, list[int]]:
    """Coordinates of every prior that can be a cause of uncertainty; the stereo calibration is one of them."""
    groups: dict[str, list[int]] = {"stereo calibration": list(range(len(RIG_NAMES), len(NAMES)))}
    for name in RIG_NAMES:
        stem = "focal scale" if name == "focal_scale" else f"prior of {name.split('.')[0]}"
        groups.setdefault(stem, []).append(INDEX[name])
    return groups


def causes_of(fit: JointFit) -> Causes:
    """Split the covariance of a fit by cause (DESIGN 5).

    An estimate moves by S J^T C^-1 e when the data err by e, and by S e_j when prior j is off by its sd, S the
    posterior covariance. With C = 1 + (stop errors) the parts S (C^-1 J)^T (C^-1 J) S, S (J^T C^-1 J - that) S and
    S e_j e_j^T S add up to S. Expected information about geometry and cameras; noise scales are taken as known.
    """
    fisher = fit.information.fisher
    posterior = np.linalg.inv(fisher + np.eye(len(NAMES)))
    gain = np.concatenate([group.jacobian for group in fit.information.groups])
    noise = gain.T @ gain
    readings = bool(np.any(np.asarray(fit.arrays.spots.has_aperture) * np.asarray(fit.arrays.spots.valid)))
    parts = {
        "pixel and aperture noise" if readings else "pixel noise": noise,
        "stop errors of the campaign": fisher - noise,
    }
    for stem, columns in prior_groups().items():
        share = np.zeros_like(fisher)
        share[columns, columns] = 1.0
        parts[stem] = share
    inputs = [INDEX[name] for name in INPUT_NAMES]
    with jax.enable_x64(True):
        slope = np.asarray(jax.jacfwd(fit.space.physical)(jnp.asarray(fit.z)))[inputs]
    spread = slope @ posterior
    covariance = {name: spread @ part @ spread.T for name, part in parts.items()}
    # A prior that was fixed, or that no coordinate hangs on, is no cause.
    kept = {name: c for name, c in covariance.items() if np.any(np.diag(c) > 0)}
    return Causes(tuple(kept), np.stack(list(kept.values())))


def calibration_of(fit: JointFit, posterior: Posterior | None = None, *, seed: int = 0) -> Calibration:
    """What coordinates need of a fit: the posterior's draws where one has converged, else the Laplace approximation's.

    Args:
        fit: a converged fit.
        posterior: its sample; left out, or unconverged, the Laplace draws are taken.
        seed: of the draws of baseline, C0 and aperture zero where no reading told them.

    Returns:
        A calibration for `locate`, with `.ray`, `.locate` and `.steps_for` of its own.
    """
    usable = posterior is not None and posterior.converged
    draws = posterior.thinned(DRAWS_KEPT).physical if usable else fit.draws.physical
    causes = causes_of(fit)
    name = "posterior" if usable else "laplace"
    return calibration_of_draws(fit.names, np.asarray(draws), fit.campaign, name, seed, causes.names, causes.covariance)


CAUSE_BINS = 6
PLACEMENT_GAP = 1.03
"""Ratio of two neighbouring depths that belong to different placements: ten times the noise of a depth of 0.3 %."""
CAUSE_LIMIT = 0.01
"""Probability, all tests of a campaign together, with which clean residuals are called dependent on a cause."""
STEP_PHASES = 4
"""Full steps per electrical period of a two-phase stepper: what its currents repeat with."""


@dataclass(frozen=True)
class StopResidual:
    """How far one rest of one axis lay from where the fitted model puts it.

    Attributes:
        axis: "pan" or "tilt".
        spots: ids of the spots that saw it.
        steps: counter.
        direction: of the move that led there; "" where the approach is unknown.
        leg_steps: length of that move, 0 for a homing.
        depth_mm: X of its spots in frame S, by the stated cameras.
        within: per spot, how far it lies from the mean of the rest's spots gone through before it, in standard
            deviations of that difference by pixel noise; None for the first, empty for a single spot. Every second
            rest is gone through backwards, so that no place in a rest is always the one the others are held against.
        time_s: of the move after which it was first seen.
        deviation_deg: observed - fitted mirror angle, stop error included.
        u_deg: its standard deviation as the fitted noise has it (pixel noise and stop error).
    """

    axis: str
    spots: tuple[int, ...]
    steps: int
    direction: str
    leg_steps: int
    depth_mm: tuple[float, ...]
    within: tuple[float | None, ...]
    time_s: float
    deviation_deg: float
    u_deg: float


def stop_residuals(fit: JointFit) -> tuple[StopResidual, ...]:
    """Deviations of all stops from the fitted model, both axes, in order.

    At each spot the residual, range projected out, is explained by two angles (least squares); the spots of one rest
    of an axis are averaged with the weights of their pixel noise. The common part of the calibration is in none of
    them, and each deviation has lost a little to the fit: they scatter by slightly less than `u_deg`.
    """
    spots = ordered_spots(fit.campaign)
    moves = fit.campaign.moves
    rows = jax.tree.map(lambda x: np.asarray(x)[: len(spots)], fit.arrays.spots)
    seen = fit.linearised.spot_deviations()
    found = []
    for index, (axis, directions) in enumerate((("pan", ("left", "right")), ("tilt", ("up", "down")))):
        rest = np.cumsum(rows.redraw[:, index] | rows.new_segment)
        for number in np.unique(rest):
            chosen = np.flatnonzero((rest == number) & (rows.valid > 0))
            if not len(chosen):
                continue
            first = spots[chosen[0]].move
            # Walk back to the move of this axis, or to the homing, that began the rest.
            begun = first
            while not moves[begun].pan_approach and _steps(moves[begun], axis) == _steps(moves[begun - 1], axis):
                begun -= 1
            approach = getattr(moves[begun], f"{axis}_approach")
            leg = 0 if approach else _steps(moves[begun], axis) - _steps(moves[begun - 1], axis)
            direction = approach.replace("unknown", "") if approach else directions[leg < 0]
            mine, noise = seen.deviation_rad[chosen, index], seen.covariance_rad2[chosen, index, index]
            weight = 1 / noise
            mean = mine @ weight / weight.sum()
            # The row that drew the stop error has its variance, whether that spot is used or not.
            drawn = np.flatnonzero(rest == number)[0]
            variance = 1 / weight.sum() + fit.linearised.stop_variance[drawn, index]
            within = recursive_residuals(mine, noise, backwards=len(found) % 2 == 1)
            found.append(
                StopResidual(
                    axis=axis,
                    spots=tuple(spots[i].spot for i in chosen),
                    steps=_steps(moves[begun], axis),
                    direction=direction,
                    leg_steps=abs(leg),
                    depth_mm=tuple(map(float, rows.triangulated_mm[chosen, 0])),
                    within=within,
                    time_s=moves[first].time_s,
                    deviation_deg=float(np.degrees(mean)),
                    u_deg=float(np.degrees(np.sqrt(variance))),
                )
            )
    return tuple(found)


def recursive_residuals(values: np.ndarray, variances: np.ndarray, *, backwards: bool) -> tuple[float | None, ...]:
    """Each value against the weighted mean of those before it, standardised.

    Of independent values with one mean these are independent and N(0, 1) (Brown, Durbin and Evans, J. R. Stat. Soc. B
    37, 1975, 149); distances from the mean of all are not: those of a pair are opposite.

    Args:
        values: shape (n,).
        variances: of their noise, shape (n,).
        backwards: begin with the last.

    Returns:
        n of them in the order of the values, None where there is nothing before; empty for fewer than two.
    """
    if len(values) < 2:
        return ()
    order = np.arange(len(values))[::-1] if backwards else np.arange(len(values))
    found: list[float | None] = [None] * len(values)
    total = weight = 0.0
    for i in order:
        if weight:
            found[i] = float((values[i] - total / weight) / np.sqrt(variances[i] + 1 / weight))
        total += values[i] / variances[i]
        weight += 1 / variances[i]
    return tuple(found)


def _steps(move: Move, axis: str) -> int:
    return move.pan_steps if axis == "pan" else move.tilt_steps


@dataclass(frozen=True)
class CauseGroup:
    """Stops of one axis that share a value of a cause: mean of deviation / u, and its standard error."""

    label: str
    count: int
    mean: float
    standard_error: float


@dataclass(frozen=True)
class Cause:
    """Whether the deviations of one axis depend on one thing.

    `p` is the probability of group means as different as these if nothing depends on it (one-way analysis of
    variance), None with fewer than two groups of two.
    """

    name: str
    axis: str
    groups: tuple[CauseGroup, ...]
    p: float | None
    suspicious: bool


def residual_causes(residuals: Sequence[StopResidual]) -> tuple[Cause, ...]:
    """Deviations of the stops grouped by depth, direction, N, step phase and time, pan and tilt apart.

    Spots of one rest share its stop error: for depth they are held against each other, not against the model.
    A cause is suspicious where its p is below `CAUSE_LIMIT` shared out among all tests (Bonferroni).
    """
    keys: dict[str, Callable[[StopResidual], float | str]] = {
        "direction": lambda r: r.direction or "unknown",
        "N": lambda r: r.leg_steps,
        "step phase": lambda r: f"n mod {STEP_PHASES} = {r.steps % STEP_PHASES}",
        "time": lambda r: r.time_s,
    }
    units = {"N": " steps", "time": " s"}
    found = []
    for axis in ("pan", "tilt"):
        mine = [r for r in residuals if r.axis == axis]
        scaled = np.array([r.deviation_deg / r.u_deg for r in mine])
        looks = [
            (depth, value)
            for r in mine
            for depth, value in zip(r.depth_mm, r.within or (r.deviation_deg / r.u_deg,), strict=True)
            if value is not None
        ]
        tested = {"depth": ([depth for depth, _ in looks], np.array([value for _, value in looks]))}
        tested |= {name: ([key(r) for r in mine], scaled) for name, key in keys.items()}
        for name, (values, measured) in tested.items():
            groups, members = [], []
            for label, rows in _placed(values) if name == "depth" else _binned(values, units.get(name, "")):
                part = measured[rows]
                spread = float(part.std(ddof=1)) if len(part) > 1 else 1.0
                groups.append(CauseGroup(label, len(part), float(part.mean()), spread / np.sqrt(len(part))))
                members.append(part)
            testable = [part for part in members if len(part) > 1 and np.ptp(part) > 0]
            p = float(stats.f_oneway(*testable).pvalue) if len(testable) > 1 else None
            found.append(Cause(name, axis, tuple(groups), p, False))
    tests = sum(cause.p is not None for cause in found)
    return tuple(replace(c, suspicious=c.p is not None and c.p * tests < CAUSE_LIMIT) for c in found)


def _placed(depths_mm: Sequence[float]) -> list[tuple[str, np.ndarray]]:
    """Groups of depths that pixel noise cannot mix: placements of the sheet, or bins of depths that reach far.

    A depth is triangulated from the pixels that also give the deviation: groups inside one placement would sort the
    stops by their own noise.
    """
    array = np.array(depths_mm)
    order = np.argsort(array, kind="stable")
    gaps = np.flatnonzero(array[order][1:] > PLACEMENT_GAP * array[order][:-1]) + 1
    if len(gaps) >= CAUSE_BINS or (not len(gaps) and array.max(initial=0.0) > SHALLOW * array.min(initial=np.inf)):
        return _binned(depths_mm, " mm")
    groups = [rows for rows in np.split(order, gaps) if len(rows)]
    return [(f"{array[rows].min():.4g} to {array[rows].max():.4g} mm", np.sort(rows)) for rows in groups]


def _binned(values: Sequence[float | str], unit: str) -> list[tuple[str, np.ndarray]]:
    """Groups of equal values; more than `CAUSE_BINS` numbers go into bins of about equal counts."""
    array = np.array(values)
    distinct = np.unique(array)
    if len(distinct) <= CAUSE_BINS or array.dtype.kind not in "if":
        return [(f"{v:.6g}{unit}" if unit else str(v), np.flatnonzero(array == v)) for v in distinct]
    bins = []
    for rows in np.array_split(np.argsort(array, kind="stable"), CAUSE_BINS):
        if len(rows):
            bins.append((f"{array[rows].min():.4g} to {array[rows].max():.4g}{unit}", rows))
    return bins


_POSE = tuple(f"extrinsics.{kind}.{axis}" for kind in ("rotation_rad", "translation_mm") for axis in "xyz")


@dataclass(frozen=True)
class _Defect:
    """Columns d(prediction)/d(size of the defect), shape (spots, 4, q), for each of its `places`."""

    name: str
    places: tuple[str, ...]
    columns: tuple[np.ndarray, ...]


def _times(columns: np.ndarray, pattern: np.ndarray) -> np.ndarray:
    """Columns (spots, 4, q) at spots where a pattern (spots,) says how much of the defect there is."""
    return columns * pattern[:, None, None]


@dataclass(frozen=True)
class _Axis:
    """One axis as the spots saw it: effect of its angle (spots, 4, 1), angle, counter, last move."""

    name: str
    push: np.ndarray
    angle_deg: np.ndarray
    counter: np.ndarray
    leg_steps: np.ndarray


def _axes(fit: JointFit) -> tuple[_Axis, _Axis]:
    moves, lin = fit.campaign.moves, fit.linearised
    legs = np.zeros((len(moves), 2), dtype=int)
    for row, (previous, move) in enumerate(pairwise(moves), start=1):
        delta = np.array([move.pan_steps - previous.pan_steps, move.tilt_steps - previous.tilt_steps])
        legs[row] = 0 if move.pan_approach else np.where(delta != 0, delta, legs[row - 1])
    at = [spot.move for spot in ordered_spots(fit.campaign)]
    angle = np.degrees(lin.mirror_angles_rad)
    counters = np.array([(moves[m].pan_steps, moves[m].tilt_steps) for m in at])
    return tuple(
        _Axis(name, lin.slope[:, :, i : i + 1], angle[:, i], counters[:, i], legs[at, i])
        for i, name in enumerate(("pan", "tilt"))
    )


def _epipolar(fit: JointFit) -> np.ndarray:
    """Rows of one camera against those of the other: a shift, and its gradients over the picture, shape (n, 4, 3).

    The part of a residual that neither a mirror angle nor a range explains: no model of the beam is in it.
    """
    lin = fit.linearised
    readings = -lin.residual_jacobian[:, :, INDEX["aperture_zero_deg"]]
    # Without a reading the last of the four components is empty.
    readings = np.where(np.any(readings, axis=1, keepdims=True), readings, np.eye(4)[3])
    taken = np.concatenate([lin.slope.transpose(0, 2, 1), readings[:, None]], axis=1)
    normal = np.linalg.svd(taken)[2][:, -1]
    row = np.linalg.pinv(np.asarray(fit.space.stereo_root))[:, STEREO_PARAMETER_NAMES.index("stereo.right.cy")]
    shift = -lin.residual_jacobian[:, :, len(RIG_NAMES) :] @ row
    shift = normal * np.sum(normal * shift, axis=1, keepdims=True)
    place = lin.predicted[:, :2]
    spread = place.std(axis=0)
    place = (place - place.mean(axis=0)) / np.where(spread > 0, spread, 1.0)
    return shift[:, :, None] * np.concatenate([np.ones((len(place), 1)), place], axis=1)[:, None, :]


def _defects_in_time(fit: JointFit, axes: Sequence[_Axis]) -> list[_Defect]:
    """What moves, drifts or slips while the campaign runs."""
    spots, moves = ordered_spots(fit.campaign), fit.campaign.moves
    order = np.arange(len(spots))
    time = np.array([moves[spot.move].time_s for spot in spots])
    # Without a clock the order stands for the time.
    time = order if np.ptp(time) == 0 else time
    drift = (time - time.mean()) / max(np.ptp(time), 1)
    segment = np.array([moves[spot.move].segment for spot in spots])
    cameras = -fit.linearised.residual_jacobian[:, :, [INDEX[name] for name in _POSE]]
    warmed = -fit.linearised.residual_jacobian[:, :, [*(INDEX[name] for name in _POSE), INDEX["focal_scale"]]]
    apart = _epipolar(fit)

    def rows(count: int) -> np.ndarray:
        found = np.unique(np.linspace(0, len(spots), count + 2)[1:-1].astype(int))
        return found[found > 0]

    def since(row: int) -> np.ndarray:
        return (order >= row).astype(float)

    def place(row: int) -> str:
        return f"from spot {spots[row].spot} on (move {spots[row].move})"

    few, many = rows(CHANGE_POINTS), rows(2 * CHANGE_POINTS)
    places = tuple(map(place, few))
    slips = tuple((axis, row) for axis in axes for row in many)
    return [
        _Defect("the cameras moved", places, tuple(_times(cameras, since(row)) for row in few)),
        _Defect("the cameras drifted (pose or focal length)", ("with time",), (_times(warmed, drift),)),
        _Defect(
            "one camera moved against the other (epipolar)",
            ("with time", *places),
            (_times(apart, drift), *(_times(apart, since(row)) for row in few)),
        ),
        _Defect(
            "a ratio drifted",
            tuple(f"{axis.name}, with time" for axis in axes),
            tuple(_times(axis.push, drift * (axis.angle_deg - axis.angle_deg.mean())) for axis in axes),
        ),
        _Defect(
            "steps were lost, or a joint slipped",
            tuple(f"{axis.name} {place(row)}" for axis, row in slips),
            # A homing finds the zero again.
            tuple(_times(axis.push, since(row) * (segment == segment[row])) for axis, row in slips),
        ),
    ]


def _defects_in_place(fit: JointFit, axes: Sequence[_Axis]) -> list[_Defect]:
    """What depends on where the axes stand, how they got there, and on the sheet."""
    targets = np.array([spot.target for spot in ordered_spots(fit.campaign)])
    places, waves = [], []
    for axis in axes:
        stops = len(np.unique(axis.counter))
        # Fewer stops than this fit any wave.
        periods = 2 * np.ptp(axis.angle_deg) / np.arange(1, min(WAVES, 2 * stops) + 1) if stops > 3 else ()
        for period in [*periods, *filter(None, [fit.campaign.rig.harmonic_period_deg.get(axis.name)])]:
            phase = 2 * np.pi * axis.angle_deg / period
            waves.append(np.concatenate([_times(axis.push, np.cos(phase)), _times(axis.push, np.sin(phase))], axis=2))
            places.append(f"{axis.name}, period near {period:.3g} deg")

    def by_group(name: str, groups: Sequence[np.ndarray]) -> _Defect:
        columns = [
            np.concatenate([_times(axis.push, (group == value).astype(float)) for value in np.unique(group)], axis=2)
            for axis, group in zip(axes, groups, strict=True)
        ]
        return _Defect(name, tuple(axis.name for axis in axes), tuple(columns))

    edges = [np.unique(np.quantile(axis.leg_steps, np.linspace(0, 1, CAUSE_BINS + 1)[1:-1])) for axis in axes]
    return [
        _Defect("the gears have a transmission error", tuple(places), tuple(waves)),
        by_group(f"stops depend on the step phase (n mod {STEP_PHASES})", [a.counter % STEP_PHASES for a in axes]),
        by_group(
            "stops depend on the length of the move",
            [np.digitize(axis.leg_steps, edge) for axis, edge in zip(axes, edges, strict=True)],
        ),
        by_group("the sheets disagree", [targets, targets]),
    ]


def validate(fit: JointFit) -> Validation:
    """Look for defects that the model does not have, by score tests at the mode.

    For columns D = d(prediction)/d(size of a defect) the score is g = D'^T C^-1 r, C the covariance of pixel noise,
    stop errors and home offsets, D' = D less what the fit can follow. If the model holds, g ~ N(0, D'^T C^-1 D') and
    g^T (D'^T C^-1 D')^-1 g is chi-square wherever the true rig lies (Rao, Proc. Cambridge Phil. Soc. 44 (1948) 50).
    Nothing is refitted. The places of one defect share its level (Bonferroni), all tests share `VALIDATION_LEVEL`
    (Holm, Scand. J. Statist. 6 (1979) 65). Noise scales are the fitted ones, which a defect has already widened.

    A defect of size s = (D'^T C^-1 D')^-1 g, left out of the model, moves the mode by S J^T C^-1 D s. That is a
    systematic effect without correction: its square joins the squared u (GUM F.2.4.5, as an uncorrected effect).
    `inflation` is sqrt(1 + (largest move of a headline in its sds)^2), over the tests that failed.

    Args:
        fit: a joint fit.

    Returns:
        What was asked and found; a question that the fit can follow entirely is not asked.
    """
    axes = _axes(fit)
    defects = [*_defects_in_time(fit, axes), *_defects_in_place(fit, axes)]
    held = np.isin(NAMES, NOISE_NAMES) | ~fit.free
    own = np.where(held, 0.0, -fit.linearised.residual_jacobian)
    asked = np.concatenate([own, *(columns for defect in defects for columns in defect.columns)], axis=2)
    information = stop_information(linear_spots(fit.linearised, fit.arrays, asked))
    errors = np.concatenate([group.residual for group in information.groups])
    score = asked.reshape(-1, asked.shape[2]).T @ errors
    p = own.shape[2]
    fisher, cross = information.fisher[:p, :p], information.fisher[:p, p:]
    values, vectors = np.linalg.eigh(fisher)
    kept = values > KNOWN_DIRECTION
    inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T
    followed = inverse @ cross
    whole = np.diag(information.fisher)[p:]
    scale = 1 / np.sqrt(np.where(whole > 0, whole, 1.0))
    found = [_single_spots(fit, information.groups, inverse, inverse @ score[:p])]
    score = (score[p:] - followed.T @ score[:p]) * scale
    variance = (information.fisher[p:, p:] - cross.T @ followed) * np.outer(scale, scale)
    _, gradient = _headline_gradients(fit, _moved_directions(fit))
    sd = np.sqrt(np.einsum("qi,ij,qj->q", gradient, fit.covariance, gradient))
    moved_by = gradient @ fit.covariance @ cross * scale / sd[:, None]

    start = 0
    for defect in defects:
        answers = []
        for place, columns in zip(defect.places, defect.columns, strict=True):
            rows = slice(start, start + columns.shape[2])
            start = rows.stop
            values, vectors = np.linalg.eigh(variance[rows, rows])
            kept = values > ABSORBED
            if kept.any():
                along = vectors[:, kept].T @ score[rows]
                chi2, dof = float(np.sum(along**2 / values[kept])), int(kept.sum())
                size = (vectors[:, kept] / values[kept]) @ along
                shift = float(np.max(np.abs(moved_by[:, rows] @ size)))
                answers.append(_Answer(float(log_chance(chi2, dof)), defect.name, place, chi2, dof, shift))
        if answers:
            worst = min(answers, key=lambda a: a.log_p)
            found.append(replace(worst, log_p=worst.log_p + np.log(len(answers)), places=len(answers)))
    return _holm(found)


def log_chance(chi2: np.ndarray | float, dof: np.ndarray | float) -> np.ndarray:
    """Log probability of a chi-square of at least this size, also where the probability itself underflows.

    Far out Q(a, x) = Gamma(a, x) / Gamma(a) with Gamma(a, x) = e^-x U(1 - a, 1 - a, x) (DLMF 8.5.3): two gross
    defects must not tie at minus infinity, the worse one is the cause.
    """
    with np.errstate(divide="ignore"):
        plain = stats.chi2.logsf(chi2, dof)
    a, x = 0.5 * np.asarray(dof, dtype=float), 0.5 * np.asarray(chi2, dtype=float)
    far = -x + np.log(special.hyperu(1 - a, 1 - a, x)) - special.gammaln(a)
    return np.where(np.isfinite(plain), plain, far)


@dataclass(frozen=True)
class _Answer:
    """A test before it is judged; `log_p` because chi-squares of hundreds have no p in double precision."""

    log_p: float
    name: str
    where: str
    chi2: float
    dof: int
    shift_sd: float
    places: int = 1


def _single_spots(fit: JointFit, groups: Sequence[StopGroup], followed: np.ndarray, shift: np.ndarray) -> _Answer:
    """The spot that all others foretell worst; how far it moves a headline is not asked (`--robust` drops it).

    As `likelihood.leave_one_out_chi2`, less what the fit can follow.

    Args:
        fit: the fit.
        groups: its stops; the first columns of their Jacobians belong to the coordinates.
        followed: inverse information of the directions that the fit can follow, shape (p, p).
        shift: step along them that the residuals still ask for, shape (p,).
    """
    spots = ordered_spots(fit.campaign)
    p = len(shift)
    errors = np.concatenate([(g.residual - g.jacobian[:, :p] @ shift).reshape(-1, 4) for g in groups])
    blocks = []
    for group in groups:
        own = group.jacobian[:, :p]
        left = group.precision - own @ followed @ own.T
        blocks += [left[k : k + 4, k : k + 4] for k in range(0, len(left), 4)]
    values, vectors = np.linalg.eigh(np.stack(blocks))
    kept = values > ABSORBED
    along = np.einsum("nij,ni->nj", vectors, errors)
    distances = np.sum(np.where(kept, along**2 / np.where(kept, values, 1.0), 0.0), axis=1)
    readings = np.asarray(fit.arrays.spots.has_aperture * fit.arrays.spots.valid)[: len(spots)]
    # Without a reading the fourth component is empty.
    dof = np.maximum(kept.sum(axis=1) - (readings == 0), 1)
    chances = log_chance(distances, dof)
    worst = int(np.argmin(chances))
    return _Answer(
        log_p=float(chances[worst] + np.log(len(spots))),
        name="single spots disagree with all others",
        where=f"most of all spot {spots[worst].spot}",
        chi2=float(distances[worst]),
        dof=int(dof[worst]),
        shift_sd=0.0,
        places=len(spots),
    )


def _holm(found: Sequence[_Answer]) -> Validation:
    """All tests together at `VALIDATION_LEVEL`; the defect with the least p is named as the cause."""
    found = sorted(found, key=lambda a: a.log_p)
    bad = 0
    while bad < len(found) and found[bad].log_p <= np.log(VALIDATION_LEVEL / (len(found) - bad)):
        bad += 1
    tests = tuple(
        ValidationTest(
            name=a.name,
            where=a.where,
            chi2=a.chi2,
            dof=a.dof,
            places=a.places,
            p=float(min(1.0, np.exp(a.log_p))),
            failed=rank < bad,
            shift_sd=a.shift_sd,
        )
        for rank, a in enumerate(found)
    )
    cause = f"{tests[0].name}: {tests[0].where}" if bad else ""
    inflation = float(np.hypot(1.0, max((t.shift_sd for t in tests[:bad]), default=0.0)))
    return Validation(bad == 0, VALIDATION_LEVEL, cause, inflation, tests)


@dataclass(frozen=True)
class HeadlineCauses:
    """What the uncertainty of each headline consists of: rows of a GUM budget.

    Attributes:
        quantities: contract names: `effective_deg_per_step.left` ... of directions that moved, `backlash_deg.pan|tilt`.
        names: causes: pixel noise, stop errors, the stereo calibration, and every prior by its parameter's name.
        contribution: shape (quantities, causes), deg/step or deg. Of a prior: what one u of its centre does, signed;
            of the others: the root of their part of the variance.
        u: of the priors in the unit of the parameter (of a log-normal: of the logarithm), shape (causes,); NaN for the
            others, which are no single quantity.
        centre: mean of the prior (of a log-normal: of the logarithm), shape (causes,); NaN likewise.
        distribution: of each cause.
        dof: degrees of freedom behind u, shape (quantities, causes); infinite for what was stated (GUM G.4.3).
    """

    quantities: tuple[str, ...]
    names: tuple[str, ...]
    contribution: np.ndarray
    u: np.ndarray
    centre: np.ndarray
    distribution: tuple[str, ...]
    dof: np.ndarray


def headline_causes(fit: JointFit) -> HeadlineCauses:
    """Split the variance of ratios and backlashes by cause, as `causes_of` does for the inputs of a coordinate.

    Linear part of each headline in the coordinates; expected information, noise scales taken as known. How well the
    noise scales are known gives the degrees of freedom: nu = 1/(2 var(ln s)) (GUM G.4.2, eq. G.3).
    """
    moved = _moved_directions(fit)
    columns = {
        f"effective_deg_per_step.{d}": fit.draws.effective_deg_per_step[:, k]
        for k, d in enumerate(DIRECTIONS)
        if d in moved
    }
    for axis, pair in (("pan", DIRECTIONS[:2]), ("tilt", DIRECTIONS[2:])):
        if moved & set(pair):
            columns[f"backlash_deg.{axis}"] = fit.draws.physical[:, INDEX[f"backlash_deg.{axis}"]]
    if not columns:
        none = np.zeros((0, 0))
        return HeadlineCauses((), (), none, np.zeros(0), np.zeros(0), (), none)
    gradient = gradients(fit, np.stack(list(columns.values()), axis=1))
    spread = gradient @ np.linalg.inv(fit.information.fisher + np.eye(len(NAMES)))
    gain = np.concatenate([group.jacobian for group in fit.information.groups])
    noise = gain.T @ gain

    def root(part: np.ndarray) -> np.ndarray:
        return np.sqrt(np.maximum(np.einsum("qi,ij,qj->q", spread, part, spread), 0.0))

    def freedom(names: list[str]) -> float:
        logs = [np.log(fit.draws.physical[:, INDEX[name]]) for name in names]
        spreads = [float(np.var(x)) for x in logs if np.ptp(x) > 1e-9]
        return min((0.5 / s for s in spreads), default=np.inf)

    # The two directions of the axis that a quantity belongs to.
    axes = {name: DIRECTIONS[:2] for name in ("pan", *DIRECTIONS[:2])}
    axes |= {name: DIRECTIONS[2:] for name in ("tilt", *DIRECTIONS[2:])}
    stops = [freedom([f"stop_sd_deg.{d}" for d in axes[q.split(".")[1]] if d in moved]) for q in columns]
    readings = bool(np.any(np.asarray(fit.arrays.spots.has_aperture) * np.asarray(fit.arrays.spots.valid)))
    pixels = "pixel and aperture noise" if readings else "pixel noise"
    every = np.ones(len(columns))
    cameras = np.linalg.norm(spread[:, len(RIG_NAMES) :], axis=1)
    shaken = root(fit.information.fisher - noise)
    # Name, contribution, u, centre, distribution, degrees of freedom.
    rows = [
        (pixels, root(noise), np.nan, np.nan, "normal", freedom(["pixel_scale"]) * every),
        ("stop errors of the campaign", shaken, np.nan, np.nan, "normal", np.array(stops)),
        ("stereo calibration", cameras, np.nan, np.nan, "normal", np.inf * every),
    ]
    space = fit.space
    for name, value, u, kind in zip(
        RIG_NAMES, *(np.asarray(x) for x in (space.value, space.u, space.kind)), strict=True
    ):
        if u == 0 or not np.any(spread[:, INDEX[name]]):
            continue
        shape, centre, width = KINDS[int(kind)], float(value), float(u)
        if shape == "log-normal":
            centre = float(np.log(centre))
        elif shape == "half-normal":
            # Mean and standard deviation of |x|, x ~ N(0, u^2).
            centre, width = width * float(np.sqrt(2 / np.pi)), width * float(np.sqrt(1 - 2 / np.pi))
        rows.append((name, spread[:, INDEX[name]], width, centre, shape, np.inf * every))
    kept = [row for row in rows if np.any(row[1] != 0)]
    names, contribution, widths, centres, shapes, dof = zip(*kept, strict=True)
    return HeadlineCauses(
        quantities=tuple(columns),
        names=names,
        contribution=np.stack(contribution, axis=1),
        u=np.array(widths, dtype=float),
        centre=np.array(centres, dtype=float),
        distribution=shapes,
        dof=np.stack(dof, axis=1),
    )
