"""What a fit knows: headlines, contraction, weak directions, leverage of stops, causes of its covariance, calibration.

Works on a finished `JointFit`, and on a `Posterior` where there is one; computes no new fit. Units are those of
DESIGN 8.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np

from tvsbayes.calibration import INPUT_NAMES, NORMAL_95, Calibration, calibration_of_draws
from tvsbayes.classic import DIRECTIONS, four_point_ratios, observed_stops, select_experiments, separation
from tvsbayes.joint import Derived, JointFit
from tvsbayes.likelihood import ordered_spots, standard_deviations_without
from tvsbayes.model import INDEX, NAMES, RECEIVER_NAMES, RIG_NAMES
from tvsbayes.posterior import Posterior, ideal_pixels
from tvsbayes.rigs import HARMONIC_PRIORS

CONTRACTION_LIMIT = 0.1
"""Below it a value is called set by the prior (DESIGN 8)."""
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
    values = np.stack(list(quantities.values()), axis=1)
    centred = fit.draws_z - fit.draws_z.mean(axis=0)
    # Regression on the moment-matched draws: the gradient of the linear part.
    cross = (values - values.mean(axis=0)).T @ centred / len(centred)
    return list(quantities), np.linalg.solve(fit.covariance, cross.T).T


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
        chosen = selection.direction == direction
        if chosen.any():
            values = draws[:, chosen].mean(axis=1)
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
    )


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
        posterior: its sample.
        seed: of the draws of baseline, C0 and aperture zero where no reading told them.
    """
    usable = posterior is not None and posterior.converged
    draws = posterior.thinned(DRAWS_KEPT).physical if usable else fit.draws.physical
    causes = causes_of(fit)
    name = "posterior" if usable else "laplace"
    return calibration_of_draws(fit.names, np.asarray(draws), fit.campaign, name, seed, causes.names, causes.covariance)
