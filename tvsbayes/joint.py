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

from collections.abc import Callable, Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, PyTree
from scipy import optimize, stats

from tvsbayes.calibration import NORMAL_95, StoredMode
from tvsbayes.campaign import Campaign
from tvsbayes.files import InputError, NotConverged, NothingToEstimate
from tvsbayes.likelihood import (
    CampaignArrays,
    LinearSpots,
    StopInformation,
    campaign_arrays,
    density_and_gradient,
    in_sight,
    innovations,
    leave_one_out_chi2,
    ordered_spots,
    spot_residuals,
    stop_information,
    stop_variances,
)
from tvsbayes.model import (
    INDEX,
    NAMES,
    NOISE_NAMES,
    RIG_NAMES,
    ParameterSpace,
    Scalar,
    beam_angles,
    free_mask,
    mirror_angles,
    parameter_space,
)
from tvsbayes.rigs import HARMONIC_PRIORS, HOME_SD_DEG, Prior, RigTable

TIGHT = 1e-12
"""Relative and absolute tolerance that solved 44 of 44 StRD fits; 1e-8 still accepted one wrong answer."""
SCALED_GRADIENT_LIMIT = 1e-8
"""Largest |J_j . r| / (|J_j| |r|) of a stationary point."""
POLISHING_STEPS = 5
POLISHABLE_GRADIENT = 1e-6
"""Scaled gradients that Gauss-Newton steps may still reduce; above it the run has not arrived."""
RESTART_PERTURBATION = 1e-3
"""Relative perturbation of the restart."""
RESTART_AGREEMENT_SD = 1e-2
"""A restart that ends within this many standard errors of the first solution has returned to it."""

NEWTON_STEP = 1e-4
"""Finite-difference step of the Hessian in posterior standard deviations: third derivatives are of order one
there, so the error is 1e-4; the gradient's rounding (1e-9) is amplified to 1e-5."""
NEWTON_SETTLED = 1e-8
"""Squared Newton step, in posterior sds, at which the mode is reached."""
HESSIAN_KEPT = 0.1
"""The Hessian is taken anew if the mode moved farther than this many sds since it was computed."""
LAPLACE_DRAWS = 2048

Objective = Callable[[np.ndarray], tuple[float, np.ndarray]]
Residual = Callable[[Float[Array, " parameters"], PyTree], Float[Array, " residuals"]]
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
CONTRASTS = ("ratio_contrast_deg_per_step.pan", "ratio_contrast_deg_per_step.tilt")
BACKLASHES = ("backlash_deg.pan", "backlash_deg.tilt")
HARMONIC_SD_DEG = 0.1
"""Prior standard deviation of every part of a freed transmission error (DESIGN 3.1)."""
MISFIT_LIMIT = 20.0
"""Factor on the stated pixel noise beyond which the mode explains no spot: a wrong basin, swapped cameras or wrong
counters, not noise."""
GATE_PROBABILITY = 1e-6
"""A clean spot is excluded by the robust option with this probability."""
HUBER_CORE = 0.8214
"""Share of clean spots with full weight: P(|z| < 1.345), the constant of 95 % efficiency (Huber 1964)."""


@dataclass(frozen=True)
class LeastSquares:
    """Outcome of a least-squares fit.

    Attributes:
        value: parameters at the solution, shape (p,).
        residuals: residuals there, shape (n,).
        jacobian: d(residuals)/d(parameters) there, shape (n, p).
        scaled_gradient: largest cosine between a column of the Jacobian and the residuals.
        converged: gradient small and, if asked for, the restart returned.
        problems: sentences on what failed; empty when converged.
    """

    value: np.ndarray
    residuals: np.ndarray
    jacobian: np.ndarray
    scaled_gradient: float
    converged: bool
    problems: tuple[str, ...]


def damped_solver(tolerance: Float[Array, ""]) -> optx.LevenbergMarquardt:
    """Levenberg-Marquardt whose damping falls tenfold after every step that the linear model predicted well.

    By default optimistix asks for 99 % agreement and divides by 3.5: in directions that only a prior holds, where
    the damping is as large as the curvature, it then creeps.
    """
    solver = optx.LevenbergMarquardt(rtol=tolerance, atol=tolerance, linear_solver=lx.QR())
    search = optx.ClassicalTrustRegion(high_cutoff=0.75, low_cutoff=0.1, high_constant=10.0, low_constant=0.2)
    return eqx.tree_at(lambda s: s.search, solver, search)


def with_dense_jacobian(residual: Residual) -> Residual:
    """The same residual, whose derivative is one matrix.

    A Levenberg-Marquardt step asks its linear model for columns, for products and for transposed products. Left to
    itself JAX compiles (and runs) the residual's tangent code once for each; here it is compiled once, to fill the
    matrix, and everything else is a product with it.
    """

    @eqx.filter_custom_jvp
    def dense(value, *, args):
        return residual(value, args)

    @dense.def_jvp
    def dense_jvp(primals, tangents, *, args):
        (value,), (direction,) = primals, tangents
        residuals, jacobian = jacobian_of(residual, value, args)
        return residuals, jacobian @ direction

    return lambda value, args: dense(value, args=args)


def jacobian_of(
    residual: Residual, value: Float[Array, " parameters"], args: PyTree
) -> tuple[Float[Array, " residuals"], Float[Array, "residuals parameters"]]:
    """Residuals and their Jacobian, the tangents of all parameters pushed forward side by side."""
    residuals, push = jax.linearize(lambda x: residual(x, args), value)
    return residuals, jax.vmap(push, out_axes=1)(jnp.eye(value.size))


residuals_and_jacobian = eqx.filter_jit(jacobian_of)


@eqx.filter_jit
def levenberg_marquardt(
    residual: Residual,
    start: Float[Array, " parameters"],
    args: PyTree,
    tolerance: Float[Array, ""],
    max_steps: int,
) -> Float[Array, " parameters"]:
    """One Levenberg-Marquardt run; tolerances are traced so that every stage of a fit shares the compilation."""
    solver = damped_solver(tolerance)
    solution = optx.least_squares(with_dense_jacobian(residual), solver, start, args, max_steps=max_steps, throw=False)
    return solution.value


@dataclass(frozen=True)
class Mode:
    """Outcome of the Newton steps: `covariance` is the inverse Hessian over all coordinates."""

    z: np.ndarray
    covariance: np.ndarray
    negative_log_density: float
    problems: tuple[str, ...]


def newton_mode(objective: Objective, start: np.ndarray, free: np.ndarray, curvature: np.ndarray) -> Mode:
    """Newton steps to the minimum of a negative log density, with its Hessian by differences of the gradient.

    The differences are taken in coordinates whitened by `curvature`: the Hessian is near the identity there, and
    directions that differ by eight orders of magnitude in stiffness are equally well resolved.

    Args:
        objective: negative log density and its gradient.
        start: near the mode, shape (p,).
        free: coordinates that move; the others keep their place and unit variance.
        curvature: positive definite guess of the Hessian, shape (p, p).

    Returns:
        The mode and its covariance.
    """
    rows = np.flatnonzero(free)
    z = start
    value, slope = objective(z)
    root = np.linalg.inv(np.linalg.cholesky(curvature[np.ix_(rows, rows)])).T
    problems: list[str] = []
    for _ in range(6):
        begin = z
        columns = []
        for column in root.T:
            nudged = z.copy()
            nudged[rows] += NEWTON_STEP * column
            columns.append((objective(nudged)[1] - slope)[rows] / NEWTON_STEP)
        hessian = root.T @ np.stack(columns, axis=1)
        eigenvalues, vectors = np.linalg.eigh(0.5 * (hessian + hessian.T))
        # Far from the mode the density may be flat or convex along a direction: step by the expected scale.
        inverse = (vectors / np.maximum(np.abs(eigenvalues), 0.1)) @ vectors.T
        settled = False
        for _ in range(12):
            step = -inverse @ (root.T @ slope[rows])
            if step @ step < NEWTON_SETTLED:
                settled = True
                break
            for halving in range(12):
                trial = z.copy()
                trial[rows] += root @ step / 2**halving
                trial_value, trial_slope = objective(trial)
                if np.isfinite(trial_value) and trial_value < value + 1e-9 * abs(value):
                    break
            else:
                break
            z, value, slope = trial, trial_value, trial_slope
        root_inverse_move = np.linalg.solve(root, (z - begin)[rows])
        if settled and np.linalg.norm(root_inverse_move) < HESSIAN_KEPT:
            break
        root = root @ (vectors / np.sqrt(np.maximum(np.abs(eigenvalues), 0.1))) @ vectors.T
    else:
        problems.append("the Newton steps on the full density did not settle")
    if eigenvalues[0] <= 0:
        problems.append("the density has no maximum here: its Hessian is not negative definite")
    whitened = (vectors / np.maximum(eigenvalues, 1e-3)) @ vectors.T
    covariance = np.eye(z.size)
    covariance[np.ix_(rows, rows)] = root @ whitened @ root.T
    return Mode(z, covariance, value, tuple(problems))


def laplace_draws(z: np.ndarray, covariance: np.ndarray, seed: int) -> np.ndarray:
    """Normal draws whose sample mean and covariance are exactly the given ones.

    Antithetic pairs fix the mean, a Cholesky factor of the sample covariance fixes the rest: standard deviations of
    linear quantities then carry no Monte Carlo error.
    """
    half = np.random.default_rng(seed).standard_normal((LAPLACE_DRAWS // 2, z.size))
    normal = np.concatenate([half, -half])
    normal = normal @ np.linalg.inv(np.linalg.cholesky(normal.T @ normal / len(normal))).T
    return z + normal @ np.linalg.cholesky(covariance).T


def scaled_gradient(jacobian: np.ndarray, residuals: np.ndarray) -> float:
    """Largest |J_j . r| / (|J_j| |r|); 0 where residuals or a column vanish."""
    norms = np.linalg.norm(jacobian, axis=0) * np.linalg.norm(residuals)
    products = np.abs(jacobian.T @ residuals)
    return float(np.max(np.divide(products, norms, out=np.zeros_like(products), where=norms > 0)))


def least_squares_covariance(jacobian: np.ndarray) -> np.ndarray:
    """(J^T J)^-1 by a singular value decomposition of the column-scaled Jacobian.

    Args:
        jacobian: shape (n, p), of full column rank.

    Returns:
        Covariance for residuals of unit variance, shape (p, p).

    Raises:
        np.linalg.LinAlgError: if the scaled condition number exceeds 1e13; no covariance exists then.
    """
    scale = np.linalg.norm(jacobian, axis=0)
    if not np.all(scale > 0):
        raise np.linalg.LinAlgError("a parameter has no influence on any residual")
    _, singular, vt = np.linalg.svd(jacobian / scale, full_matrices=False)
    if singular[-1] < 1e-13 * singular[0]:
        raise np.linalg.LinAlgError(f"scaled condition number {singular[0] / max(singular[-1], 1e-300):.1e}")
    root = vt.T / singular / scale[:, None]
    return root @ root.T


def solve_least_squares(
    residual: Residual, start: np.ndarray, args: PyTree = None, *, max_steps: int = 10_000, restart: bool = True
) -> LeastSquares:
    """Fit and check (research/statistics.md section 1).

    Args:
        residual: function (parameters, args) -> residuals; pass the same function object to reuse its compilation.
        start: starting parameters, shape (p,).
        args: whatever the residual needs, as arrays.
        max_steps: budget of Levenberg-Marquardt steps.
        restart: repeat from a point perturbed by `RESTART_PERTURBATION` and demand that it returns.

    Returns:
        The better of both solutions with its checks.
    """
    with jax.enable_x64(True):
        tolerance = jnp.asarray(TIGHT)
        value = np.asarray(levenberg_marquardt(residual, jnp.asarray(start, float), args, tolerance, max_steps))
        residuals, jacobian = (np.asarray(x) for x in residuals_and_jacobian(residual, jnp.asarray(value), args))
        problems = []
        if restart:
            signs = np.where(np.arange(value.size) % 2 == 0, 1.0, -1.0)
            moved = value * (1 + RESTART_PERTURBATION * signs)
            again = np.asarray(levenberg_marquardt(residual, jnp.asarray(moved), args, tolerance, max_steps))
            residuals2, jacobian2 = (np.asarray(x) for x in residuals_and_jacobian(residual, jnp.asarray(again), args))
            try:
                dof = max(residuals.size - value.size, 1)
                sd = np.sqrt(np.diag(least_squares_covariance(jacobian)) * (residuals @ residuals) / dof)
                if np.any(np.abs(again - value) > RESTART_AGREEMENT_SD * sd + 1e-9 * np.abs(value)):
                    problems.append("a restart from a slightly perturbed point ended elsewhere")
            except np.linalg.LinAlgError as error:
                problems.append(f"the Jacobian is singular: {error}")
            if residuals2 @ residuals2 < residuals @ residuals:
                value, residuals, jacobian = again, residuals2, jacobian2
        gradient = scaled_gradient(jacobian, residuals)
        # The sum of squares is flat to rounding within 1e-8 of its minimum; Gauss-Newton steps see the gradient.
        for _ in range(POLISHING_STEPS):
            if not SCALED_GRADIENT_LIMIT < gradient < POLISHABLE_GRADIENT:
                break
            trial = value - np.linalg.lstsq(jacobian, residuals, rcond=None)[0]
            residuals2, jacobian2 = (np.asarray(x) for x in residuals_and_jacobian(residual, jnp.asarray(trial), args))
            if not scaled_gradient(jacobian2, residuals2) < gradient:
                break
            value, residuals, jacobian = trial, residuals2, jacobian2
            gradient = scaled_gradient(jacobian, residuals)
        if not np.all(np.isfinite(residuals)):
            problems.append("residuals are not finite")
        # At a perfect fit the residuals are rounding errors and their direction means nothing.
        elif gradient > SCALED_GRADIENT_LIMIT and np.linalg.norm(residuals) > 1e-12 * np.linalg.norm(jacobian @ value):
            problems.append(f"scaled gradient {gradient:.1e} above {SCALED_GRADIENT_LIMIT:.0e}")
    return LeastSquares(value, residuals, jacobian, gradient, not problems, tuple(problems))


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


class Linearised(eqx.Module):
    """The campaign linearised at a point; first axis of the Jacobians is the spot."""

    residual: Float[Array, "spots 4"]
    slope: Float[Array, "spots 4 2"]
    play_sd_rad: Float[Array, "spots 2"]
    mirror_angles_rad: Float[Array, "spots 2"]
    predicted: Float[Array, "spots 5"]
    stop_variance: Float[Array, "spots 2"]
    residual_jacobian: Float[Array, "spots 4 parameters"]
    predicted_jacobian: Float[Array, "spots 5 parameters"]

    def spot_deviations(self) -> SpotDeviations:
        """Least squares of the whitened residuals, spot by spot; covariance 0 where a spot tells neither angle."""
        slope = np.asarray(self.slope)
        with np.errstate(all="ignore"):
            covariance = np.linalg.pinv(np.einsum("nia,nib->nab", slope, slope))
        return SpotDeviations(np.einsum("nab,nib,ni->na", covariance, slope, np.asarray(self.residual)), covariance)


@dataclass(frozen=True)
class SpotDeviations:
    """Mirror angles (pan, tilt), seen minus predicted, every spot by itself, its range projected out.

    Attributes:
        deviation_rad: shape (spots, 2).
        covariance_rad2: of the pixel noise, shape (spots, 2, 2).
    """

    deviation_rad: np.ndarray
    covariance_rad2: np.ndarray


@eqx.filter_jit
def linearise(z: Float[Array, " parameters"], space: ParameterSpace, arrays: CampaignArrays) -> Linearised:
    """Residuals, ideal observations at the observed ranges, and d/d(coordinates) of both."""

    def forward(z):
        model = space.model(z)
        angles = mirror_angles(model.transmission, model.tilt_zero_rad, arrays.moves)
        terms = spot_residuals(model, angles, arrays, jnp.ones(()), frozen=True)
        return (terms.residual, terms.predicted), (terms, angles)

    (residual, predicted), push, (terms, angles) = jax.linearize(forward, z, has_aux=True)
    residual_jacobian, predicted_jacobian = jax.vmap(push, out_axes=-1)(jnp.eye(z.size))
    index = arrays.spots.move_index
    stop_sd_rad = space.model(z).noise.stop_sd_rad
    return Linearised(
        residual=residual,
        slope=terms.slope,
        play_sd_rad=angles.play_sd_rad[index],
        mirror_angles_rad=angles.angle_rad[index],
        predicted=predicted,
        stop_variance=stop_variances(stop_sd_rad, arrays.spots),
        residual_jacobian=residual_jacobian,
        predicted_jacobian=predicted_jacobian,
    )


class Derived(eqx.Module):
    """Headlines at one pose for one point of parameter space, in the units of DESIGN 8.

    `effective_deg_per_step` is ordered left, right, up, down: gear ratio times the slope of the mirrors, the mean over
    a period of the transmission error, without its local slope. `jacobian` is d(azimuth, elevation)/d(pan, tilt).
    """

    physical: Float[Array, " parameters"]
    effective_deg_per_step: Float[Array, "4"]
    jacobian: Float[Array, "2 2"]
    effective_mirror_offset_mm: Scalar


@eqx.filter_jit
def derived_quantities(
    z: Float[Array, "draws parameters"], space: ParameterSpace, reference_pose_rad: Float[Array, "2"]
) -> Derived:
    """Headlines of many points at once (DESIGN 3.2); every field has the leading axis `draws`."""

    def one(z):
        physical = space.physical(z)
        model = space.model(z)
        angles = beam_angles(model.optics, reference_pose_rad[0], reference_pose_rad[1])
        ratio = model.transmission.ratio_rad_per_step
        half = 0.5 * model.transmission.contrast_rad_per_step
        slope = jnp.diagonal(angles.jacobian)
        effective = jnp.stack([(ratio + half) * slope, (ratio - half) * slope], axis=1).ravel() * (180 / jnp.pi)
        return Derived(physical, effective, angles.jacobian, angles.effective_mirror_offset_mm)

    return jax.vmap(one)(z)


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


def linear_spots(lin: Linearised, arrays: CampaignArrays, jacobian: np.ndarray) -> LinearSpots:
    """A linearised campaign as the smoother reads it.

    Args:
        lin: without padding.
        arrays: the campaign it comes from.
        jacobian: d(prediction)/d(whatever is asked about), shape (spots, 4, columns).
    """
    count = len(lin.residual)
    spots = jax.tree.map(lambda x: np.asarray(x)[:count], arrays.spots)
    home_variance = np.where(spots.homed, np.radians(HOME_SD_DEG) ** 2, 0.0)[:, None] * np.ones(2)
    segment = spots.new_segment[:, None] & np.ones(2, dtype=bool)
    return LinearSpots(
        residual=lin.residual,
        load=np.concatenate([lin.slope, lin.slope, lin.slope * lin.play_sd_rad[:, None, :]], axis=2),
        renewed=np.concatenate([spots.redraw, segment, segment], axis=1),
        variance=np.concatenate([lin.stop_variance, home_variance, np.ones((count, 2))], axis=1),
        jacobian=jacobian,
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


def _chi2_quantile(readings: np.ndarray, probability: float) -> np.ndarray:
    return stats.chi2.isf(probability, 3 + readings)


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
    scale2 = np.median(chi2[used] / _chi2_quantile(readings[used], 0.5))
    chi2 = chi2 / max(scale2, 1e-12)
    over = used & (chi2 > _chi2_quantile(readings, GATE_PROBABILITY))
    # A bad spot makes its neighbours look bad: only the worst of each run is blamed in one round.
    for index in np.flatnonzero(over):
        run = slice(max(index - 2, 0), index + 3)
        if chi2[index] >= np.max(np.where(used[run], chi2[run], 0.0)):
            valid[index] = 0.0
    core = _chi2_quantile(readings, 1 - HUBER_CORE)
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


def model_choice(table: RigTable, *, per_axis: bool, harmonics: bool, no_backlash: bool) -> RigTable:
    """The priors of a simpler or richer model of the gears; options as in `fit`.

    Raises:
        InputError: harmonics are wanted and no axis states the period of its error.
    """
    changed: dict[str, Prior] = {}
    if per_axis:
        changed |= dict.fromkeys(CONTRASTS, Prior(0.0, 0.0))
    if no_backlash:
        changed |= dict.fromkeys(BACKLASHES, Prior(0.0, 0.0, "half-normal"))
    if harmonics:
        if not table.harmonic_period_deg:
            raise InputError(
                "missing-period",
                "no axis states the period of its transmission error",
                file="campaign.toml",
                column="rig.harmonic_period_deg",
                allowed="a period in degrees of the output, 360 for the wheel, less for the pinion",
                remedy='add "harmonic_period_deg.pan" = { value = 360.0, u = 0.0 } (or tilt) to [rig]',
            )
        for name, unasked in HARMONIC_PRIORS.items():
            if name.split(".")[1] in table.harmonic_period_deg and table.priors[name] == unasked:
                changed[name] = Prior(0.0, HARMONIC_SD_DEG)
    return replace(table, priors={**table.priors, **changed})


def fit(
    campaign: Campaign,
    *,
    robust: bool = False,
    per_axis: bool = False,
    harmonics: bool = False,
    no_backlash: bool = False,
    without: Collection[int] = (),
    seed: int = 0,
) -> JointFit:
    """Fit the joint model to every usable spot (DESIGN 4).

    The first call in a process compiles the model, half a minute; `tvsbayes.information.summarise(fit(campaign))` is
    the table that the command prints.

    Args:
        campaign: from `read_campaign`.
        robust: downweight and exclude spots that disagree with all others (Huber weights and a gate on
            leave-one-out residuals).
        per_axis: one ratio per axis, the contrasts fixed at 0 (DESIGN 3.1).
        harmonics: free the transmission error of every axis with a stated period, N(0, 0.1 deg) each, where
            `[rig.prior]` says nothing else; a harmonic stated as exactly 0 counts as nothing said.
        no_backlash: gears without play, both backlashes fixed at 0.
        without: ids of spots that teach the fit nothing but can be predicted by it.
        seed: seed of the Laplace draws.

    Returns:
        Mode, Laplace approximation and diagnostics; look at `converged` before using it.

    Raises:
        InputError: if harmonics are wanted and no axis states their period.
        NothingToEstimate: if the campaign has fewer than `SMALLEST_CAMPAIGN` usable spots, or all is fixed.
        NotConverged: if the fit diverged; a fit that ended badly is returned with `converged` False.
    """
    table = model_choice(campaign.rig, per_axis=per_axis, harmonics=harmonics, no_backlash=no_backlash)
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
            if robust:
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
    suspect = used & (chi2_spots > _chi2_quantile(readings, GATE_PROBABILITY))
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
