"""The joint estimator: every parameter from every spot, with a Laplace covariance (DESIGN 4.2).

Annealed Levenberg-Marquardt for geometry and stereo, alternating with the noise scales; then Newton steps on the
full log density and the inverse Hessian there. Everything happens in the coordinates of `tvsbayes.model`
(prior N(0, 1) each); results are handed out in the units of DESIGN 8: deg, mm, px, rad where a name says so.

First the solvers: least squares through optimistix, Newton steps, Laplace draws. `LevenbergMarquardt` reports success
on wrong answers at loose tolerances (research/statistics.md section 1), so nobody believes its flag: `fit` goes on
with Newton steps on the density and judges the step that is left; `device/stereo` judges its own; whoever has
residuals of another kind calls `solve_least_squares`, which asks for a small scaled gradient and for the same end from
a perturbed start (NIST's certified problems in the tests). Residuals are dimensionless (already divided by their
standard deviations) or in the data's unit, as the caller chose; the covariance follows that choice. float64 throughout.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy import optimize

from tvsbayes.errors import NotConverged, NothingToEstimate
from tvsbayes.estimators.campaign_arrays import CampaignArrays, campaign_arrays, in_sight
from tvsbayes.estimators.likelihood import density_and_gradient, innovations
from tvsbayes.estimators.linear_spots import (
    Linearised,
    LinearSpots,
    StopInformation,
    leave_one_out_chi2,
    linear_spots,
    linearise,
    stop_information,
)
from tvsbayes.instrument.campaign import Campaign, ordered_spots
from tvsbayes.instrument.model_choice import AS_STATED, ModelChoice
from tvsbayes.instrument.parameters import INDEX, NAMES, NOISE_NAMES, RIG_NAMES, Prior
from tvsbayes.instrument.rig import RigTable
from tvsbayes.model.geometry import Scalar
from tvsbayes.model.headlines import Derived, derived_quantities
from tvsbayes.model.parameter_space import ParameterSpace, free_mask, parameter_space
from tvsbayes.results.stored_draws import StoredMode
from tvsbayes.statistics.intervals import NORMAL_95, chi2_quantile
from tvsbayes.statistics.least_squares import NEWTON_STEP, Mode, laplace_draws, levenberg_marquardt, newton_mode

ANNEALING = (60.0, 10.0, 2.0, 1.0)
"""Factors on the pixel noise before it takes its own value: plain Levenberg-Marquardt from the nominal rig goes
astray when the extrinsics are off by 0.3 rad and 60 mm (DESIGN 4.2)."""
STAGE_TOLERANCE = 1e-2
STAGE_STEPS = 12
"""Levenberg-Marquardt only has to reach the basin: its frozen Jacobian (`spot_residuals`) is not exact at the level
of the noise, where it would stall; the Newton steps on the full density finish the work."""
SMALLEST_CAMPAIGN = 8
"""Spots below which no fit is tried: two beams at two depths, seen before and after one move on each axis."""
NOISE_SETTLED = 0.05
"""Change of every noise coordinate (prior sds) below which the alternation stops: half a posterior sd."""
MISFIT_LIMIT = 20.0
"""Factor on the stated pixel noise beyond which the mode explains no spot: a wrong basin, swapped cameras or wrong
counters, not noise."""
GATE_PROBABILITY = 1e-6
"""A clean spot is excluded by the robust option with this probability."""
HUBER_CORE = 0.8214
"""Share of clean spots with full weight: P(|z| < 1.345), the constant of 95 % efficiency (Huber 1964)."""


class Fixed(eqx.Module):
    """What a least-squares stage holds: coordinates kept at a value, and the factor on the noise."""

    held: Bool[Array, " parameters"]
    value: Float[Array, " parameters"]
    inflation: Scalar


def stage_residuals(
    z: Float[Array, " parameters"], args: tuple[ParameterSpace, CampaignArrays, Fixed]
) -> Float[Array, " residuals"]:
    """[standardised innovations; prior residuals] with the noise scales held (DESIGN 4.2)."""
    space, arrays, fixed = args
    full = jnp.where(fixed.held, fixed.value, z)
    errors = innovations(space.model(full), arrays, fixed.inflation, frozen=True).standardised
    return jnp.concatenate([errors.ravel(), jnp.where(fixed.held, z - fixed.value, z)])


@dataclass(frozen=True)
class JointFit:
    """Mode and Laplace approximation of the posterior: what `fit` returns.

    Read it through `information.summarise` (values, intervals, diagnostics in words), `posterior.sample` (draws of the
    posterior itself) or `information.calibration_of` (coordinates); the fields are what those are made of.

    Attributes:
        campaign: what was fitted.
        space: priors as arrays.
        arrays: the campaign as arrays, with the weights of the robust option.
        z: mode in prior coordinates, shape (p,).
        covariance: inverse negative Hessian there, shape (p, p); the identity where nothing is estimated.
        log_density: log posterior density at the mode, without `likelihood.log_constant`.
        linearised: the campaign linearised at the mode, without padding.
        information: leave-one-out quantities per stop.
        chi2: squared standardised innovations of the spots used.
        reference_pose_rad: mean mirror angles (pan, tilt) over the spots used.
        free: parameters that are estimated, shape (p,).
        draws_z: Laplace draws, shape (draws, p), with mean and covariance exactly those of the approximation.
        draws: headlines and parameters of the draws.
        prior_draws: the same under the priors, at the same pose.
        mode: headlines and parameters at the mode (fields without leading axis).
        ends95: parameters at z - 1.96 sd and z + 1.96 sd, shape (2, p): interval ends under monotone maps.
        excluded_spots: ids of spots that the robust option or the caller left out.
        suspect_spots: ids of spots used although a clean spot would look so less often than `GATE_PROBABILITY`.
        converged: the mode was reached and is a maximum.
        problems: sentences on what failed; empty when converged.
    """

    campaign: Campaign
    space: ParameterSpace
    arrays: CampaignArrays
    z: np.ndarray
    covariance: np.ndarray
    log_density: float
    linearised: Linearised
    information: StopInformation
    chi2: float
    reference_pose_rad: np.ndarray
    free: np.ndarray
    draws_z: np.ndarray
    draws: Derived
    prior_draws: Derived
    mode: Derived
    ends95: np.ndarray
    excluded_spots: tuple[int, ...]
    suspect_spots: tuple[int, ...]
    converged: bool
    problems: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Contract names of the coordinates and of the columns of `draws.physical`."""
        return NAMES

    @property
    def stored(self) -> StoredMode:
        """What `restored` needs."""
        count = len(self.linearised.residual)
        return StoredMode(
            self.names,
            self.z,
            self.covariance,
            self.log_density,
            np.stack([np.asarray(self.space.value), np.asarray(self.space.u)]),
            *(np.asarray(x)[:count] for x in (self.arrays.spots.valid, self.arrays.spots.weight)),
        )


class Problem:
    """One campaign in front of the compiled functions."""

    def __init__(self, campaign: Campaign, table: RigTable, used: np.ndarray | None = None):
        self.spots = ordered_spots(campaign)
        used = np.ones(len(self.spots), dtype=bool) if used is None else used
        self.space = parameter_space(table, campaign.stereo)
        arrays = campaign_arrays(campaign)
        valid = np.array(arrays.spots.valid)
        valid[: len(used)] *= used
        self.arrays = eqx.tree_at(lambda a: a.spots.valid, arrays, jnp.asarray(valid))
        readings = (spot.aperture_deg is not None for spot, use in zip(self.spots, used, strict=True) if use)
        self.free = free_mask(self.space, any(readings))
        is_noise = np.isin(NAMES, NOISE_NAMES)
        self.noise = np.flatnonzero(is_noise & self.free)
        self.held = is_noise | ~self.free

    def compile_aside(self, executor: ThreadPoolExecutor) -> None:
        """Start the compilations that later steps need while the first stage runs on the other core."""

        def work():
            with jax.enable_x64(True):
                z = jnp.zeros(len(NAMES))
                density_and_gradient(z, self.space, self.arrays)
                linearise(z, self.space, self.arrays)

        executor.submit(work)

    def least_squares(self, z: np.ndarray, inflation: float) -> np.ndarray:
        """Geometry and stereo for given noise scales."""
        fixed = Fixed(jnp.asarray(self.held), jnp.asarray(z), jnp.asarray(inflation))
        args = (self.space, self.arrays, fixed)
        tolerance = jnp.asarray(STAGE_TOLERANCE)
        return np.array(levenberg_marquardt(stage_residuals, jnp.asarray(z), args, tolerance, STAGE_STEPS))

    def objective(self, z: np.ndarray) -> tuple[float, np.ndarray]:
        """Negative log density and its gradient."""
        value, slope = density_and_gradient(jnp.asarray(z), self.space, self.arrays)
        return -float(value), -np.asarray(slope)

    def noise_scales(self, z: np.ndarray) -> np.ndarray:
        """Best noise scales for given geometry, under their priors."""

        def part(values):
            full = z.copy()
            full[self.noise] = values
            value, slope = self.objective(full)
            return value, slope[self.noise]

        result = z.copy()
        if self.noise.size:
            # Eight prior standard deviations: a factor 3000 on a stop sd, 55 on the pixel scale.
            bounds = [(-8.0, 8.0)] * self.noise.size
            result[self.noise] = optimize.minimize(part, z[self.noise], jac=True, method="L-BFGS-B", bounds=bounds).x
        return result

    def alternate(self, z: np.ndarray) -> np.ndarray:
        """Geometry and noise scales in turn until the noise settles (DESIGN 4.2)."""
        for _ in range(6):
            previous = z
            z = self.least_squares(self.noise_scales(z), 1.0)
            if np.max(np.abs(z - previous)[self.noise], initial=0.0) < NOISE_SETTLED:
                break
        return z

    def linear_spots(self, z: np.ndarray) -> tuple[Linearised, LinearSpots]:
        """The campaign linearised at a point, without padding."""
        count = len(self.spots)
        full = linearise(jnp.asarray(z), self.space, self.arrays)
        lin = jax.tree.map(lambda x: np.asarray(x)[:count], full)
        return lin, linear_spots(lin, self.arrays, np.where(self.held, 0.0, -lin.residual_jacobian))

    def curvature(self, z: np.ndarray) -> np.ndarray:
        """Expected information of the coordinates: Fisher's of geometry and stereo, measured for the noise."""
        value = stop_information(self.linear_spots(z)[1]).fisher + np.eye(len(NAMES))
        slope = self.objective(z)[1]
        for index in self.noise:
            nudged = z.copy()
            nudged[index] += NEWTON_STEP
            value[index, index] = max(1.0, (self.objective(nudged)[1] - slope)[index] / NEWTON_STEP)
        return value


def _robust_weights(problem: Problem, z: np.ndarray) -> tuple[CampaignArrays, float]:
    """One round of the robust option: gate and Huber weights from leave-one-out residuals.

    Returns:
        Arrays with new weights, and the largest change of a weight.
    """
    spots = problem.arrays.spots
    count = len(problem.spots)
    valid, weight = np.array(spots.valid[:count]), np.array(spots.weight[:count])
    readings = np.asarray(spots.has_aperture[:count])
    chi2 = leave_one_out_chi2(stop_information(problem.linear_spots(z)[1]), weight)
    used = valid > 0
    # The noise scales were fitted with the outliers in: the median restores the scale of the clean spots.
    scale2 = np.median(chi2[used] / chi2_quantile(readings[used], 0.5))
    chi2 = chi2 / max(scale2, 1e-12)
    over = used & (chi2 > chi2_quantile(readings, GATE_PROBABILITY))
    # A bad spot makes its neighbours look bad: only the worst of each run is blamed in one round.
    for index in np.flatnonzero(over):
        run = slice(max(index - 2, 0), index + 3)
        if chi2[index] >= np.max(np.where(used[run], chi2[run], 0.0)):
            valid[index] = 0.0
    core = chi2_quantile(readings, 1 - HUBER_CORE)
    new_weight = np.where(valid > 0, np.sqrt(np.minimum(1.0, core / np.maximum(chi2, 1e-12))), 1.0)
    change = float(np.max(np.abs(new_weight - weight) + (valid != used)))

    def padded(array, values):
        return jnp.asarray(np.concatenate([values, np.asarray(array)[count:]]))

    arrays = eqx.tree_at(
        lambda a: (a.spots.valid, a.spots.weight),
        problem.arrays,
        (padded(spots.valid, valid), padded(spots.weight, new_weight)),
    )
    return arrays, change


def fit(
    campaign: Campaign, *, model: ModelChoice = AS_STATED, without: Collection[int] = (), seed: int = 0
) -> JointFit:
    """Fit the joint model to every usable spot (DESIGN 4).

    The first call in a process compiles the model, half a minute; `tvsbayes.information.summarise(fit(campaign))` is
    the table that the command prints.

    Args:
        campaign: from `read_campaign`.
        model: simpler or richer gears than the rig states, robust against outliers or not.
        without: ids of spots that teach the fit nothing but can be predicted by it.
        seed: seed of the Laplace draws.

    Returns:
        Mode, Laplace approximation and diagnostics; look at `converged` before using it.

    Raises:
        InputError: if harmonics are wanted and no axis states their period.
        NothingToEstimate: if the campaign has fewer than `SMALLEST_CAMPAIGN` usable spots, or all is fixed.
        NotConverged: if the fit diverged; a fit that ended badly is returned with `converged` False.
    """
    table = model.table(campaign.rig)
    spots = ordered_spots(campaign)
    # A spot beyond what the lens model can undistort is in nobody's sight line.
    used = np.array([spot.spot not in without for spot in spots], dtype=bool) & in_sight(campaign)
    if used.sum() < SMALLEST_CAMPAIGN:
        raise NothingToEstimate(
            "too-few-spots",
            f"spots.csv: {used.sum()} spots can be used; the joint fit needs at least {SMALLEST_CAMPAIGN}",
            file="spots.csv",
            remedy="observe more stops, or detect the refused spots again",
        )
    diverged = NotConverged(
        "diverged",
        "the fit left the region where the model is finite",
        remedy="check for swapped cameras or wrong counters, or state the extrinsics better in [rig.prior]",
    )
    with jax.enable_x64(True), ThreadPoolExecutor(1) as executor:
        problem = Problem(campaign, table, used)
        if not problem.free.any():
            raise NothingToEstimate(
                "nothing-free",
                "every parameter is stated as exactly known (u = 0), the cameras included",
                file="campaign.toml",
                remedy="state a u above 0 for what the campaign is to teach",
            )
        problem.compile_aside(executor)
        z = np.zeros(len(NAMES))
        try:
            for inflation in ANNEALING:
                z = problem.least_squares(z, inflation)
            z = problem.alternate(z)
            if model.robust:
                for _ in range(20):
                    problem.arrays, change = _robust_weights(problem, z)
                    if change < 0.02:
                        break
                    z = problem.alternate(z)
            if not np.all(np.isfinite(problem.objective(z)[1])):
                raise diverged
            mode = newton_mode(problem.objective, z, problem.free, problem.curvature(z))
            return fit_at(campaign, problem, mode, seed)
        except np.linalg.LinAlgError as error:
            raise diverged from error


def priors_used(stated: Mapping[str, Prior], value: np.ndarray, u: np.ndarray) -> dict[str, Prior]:
    """The priors of a fit, which its options may have changed from the stated ones; columns in order of `RIG_NAMES`."""
    return {
        name: replace(prior, value=float(value[INDEX[name]]), u=float(u[INDEX[name]])) for name, prior in stated.items()
    }


def restored(campaign: Campaign, stored: StoredMode, seed: int = 0) -> JointFit | None:
    """The converged fit that ended at a stored mode, without fitting: its model, weights and Laplace draws.

    Args:
        campaign: the one it was made from.
        stored: from `calibration.stored_mode`.
        seed: of the Laplace draws; those of `fit` with the same seed.

    Returns:
        The fit; None where another version of tvsbayes named its parameters otherwise.
    """
    if stored.names != NAMES or stored.prior.shape[1] != len(RIG_NAMES):
        return None
    table = replace(campaign.rig, priors=priors_used(campaign.rig.priors, *stored.prior))
    valid = stored.valid > 0
    with jax.enable_x64(True):
        problem = Problem(campaign, table, valid)
        weight = np.array(problem.arrays.spots.weight)
        weight[: len(valid)] = stored.weight
        problem.arrays = eqx.tree_at(lambda a: a.spots.weight, problem.arrays, jnp.asarray(weight))
        mode = Mode(stored.z, stored.covariance, -stored.log_density, ())
        return fit_at(campaign, problem, mode, seed)


def fit_at(campaign: Campaign, problem: Problem, mode: Mode, seed: int) -> JointFit:
    """The fit that ends at a mode: residuals, information, Laplace draws and diagnoses there.

    Args:
        campaign: that `problem` was made from.
        problem: model, priors and the weights of the spots.
        mode: converged, or with the problems that `JointFit.problems` then states.
        seed: of the Laplace draws.
    """
    used = np.asarray(problem.arrays.spots.valid[: len(problem.spots)]) > 0
    lin, linear = problem.linear_spots(mode.z)
    information = stop_information(linear)
    chi2_spots = leave_one_out_chi2(information, np.asarray(problem.arrays.spots.weight[: len(problem.spots)]))
    readings = np.asarray(problem.arrays.spots.has_aperture[: len(problem.spots)])
    suspect = used & (chi2_spots > chi2_quantile(readings, GATE_PROBABILITY))
    pose = lin.mirror_angles_rad[used].mean(axis=0)
    draws_z = laplace_draws(mode.z, mode.covariance, seed)
    identity = np.eye(len(NAMES))
    prior_z = laplace_draws(np.zeros(len(NAMES)), identity, seed + 1)
    at_mode_and_draws = derived_quantities(jnp.asarray(np.vstack([mode.z, draws_z])), problem.space, jnp.asarray(pose))
    prior = derived_quantities(jnp.asarray(np.vstack([mode.z, prior_z])), problem.space, jnp.asarray(pose))
    reach = NORMAL_95 * np.sqrt(np.diag(mode.covariance))
    ends = derived_quantities(
        jnp.asarray(np.vstack([mode.z - reach, mode.z + reach, prior_z[1:]])),
        problem.space,
        jnp.asarray(pose),
    )
    ids = np.array([s.spot for s in problem.spots])
    problems = mode.problems
    chi2 = sum(float(linear.residual[g.rows].ravel() @ g.residual) for g in information.groups)
    # Where the scale is fixed the misfit stays in chi-square.
    looks = max(float(np.sum(used * (3 + readings))), 1.0)
    misfit = float(at_mode_and_draws.physical[0, INDEX["pixel_scale"]]) * max(1.0, np.sqrt(chi2 / looks))
    if misfit > MISFIT_LIMIT:
        problems += (f"the spots miss the fitted beams by {misfit:.0f} times their stated uncertainty",)
    return JointFit(
        campaign=campaign,
        space=problem.space,
        arrays=problem.arrays,
        z=mode.z,
        covariance=mode.covariance,
        log_density=-mode.negative_log_density,
        linearised=lin,
        information=information,
        chi2=chi2,
        reference_pose_rad=pose,
        free=problem.free,
        draws_z=draws_z,
        draws=jax.tree.map(lambda x: np.asarray(x)[1:], at_mode_and_draws),
        prior_draws=jax.tree.map(lambda x: np.asarray(x)[1:], prior),
        mode=jax.tree.map(lambda x: np.asarray(x)[0], at_mode_and_draws),
        ends95=np.asarray(ends.physical)[:2],
        excluded_spots=tuple(int(i) for i in ids[~used]),
        suspect_spots=tuple(int(i) for i in ids[suspect]),
        converged=not problems,
        problems=problems,
    )
