"""The search for the basin of the mode, before the Newton steps on the full density.

It alternates annealed Levenberg-Marquardt for geometry and stereo with the noise scales, and sets the robust option's
weights. All computations use the coordinates of `model.parameter_space` (prior N(0, 1) each).
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool
from scipy import optimize, special

from tvsbayes.estimators.annealed_stage import Fixed, linear_part, linearised_at, stage
from tvsbayes.estimators.campaign_arrays import GearArrays, campaign_arrays
from tvsbayes.estimators.likelihood import evaluate, no_draw, roots_at
from tvsbayes.estimators.linear_spots import (
    Linearised,
    StopInformation,
    leave_one_out_chi2,
    linear_spots,
    stop_information,
)
from tvsbayes.instrument.campaign import Campaign, ordered_spots
from tvsbayes.instrument.conditions import unseen_shifts
from tvsbayes.instrument.mechanisms import RATIO_COLUMNS
from tvsbayes.instrument.parameters import GEAR_ERROR_NAMES, HOME_SD_NAMES, NOISE_NAMES
from tvsbayes.instrument.rig import RigTable
from tvsbayes.model.parameter_space import ParameterSpace, free_mask, parameter_space, physical_at
from tvsbayes.progress import Job
from tvsbayes.statistics.least_squares import Mode, Objective, neighbouring_mode, newton_mode

ANNEALING = (60.0, 10.0, 2.0, 1.0)
"""Successive factors on the noise of pixels and readings: plain Levenberg-Marquardt from the nominal rig ends in a
wrong minimum when the extrinsics are off by 0.3 rad and 60 mm (formulation 4.2)."""
NOISE_STEP = 1e-3
"""Step of differences along noise coordinates, in prior sds: a hundredth of a posterior sd."""
SCALE_STEP = 0.3
"""Step of second differences along scales of repeating errors, whose log density is not parabolic, in prior sds."""
NOISE_SETTLED = 0.05
"""Largest change of a noise coordinate (prior sds) at which the alternation stops: half a posterior sd."""
HOPELESS = 20.0
"""Loss of log density beyond which a homing hypothesis is negligible and needs no more accurate mode."""
GATE_PROBABILITY = 1e-6
"""Probability that the robust option excludes a clean spot."""
HUBER_CORE = 0.8214
"""Share of clean spots with full weight: P(|z| < 1.345), the constant of 95 % efficiency (Huber 1964)."""
ROUNDS_MAX, WEIGHTS_SETTLED = 20, 0.02
"""Rounds of the robust option, and the largest change of a weight at which they end."""
ALTERNATIONS_MAX, ROUNDS_EXPECTED = 6, 6
"""Largest number of alternations of geometry and noise; rounds of the robust option that progress assumes."""
COMPILING, SEARCHING = "compiling the model", "searching the mode"
COMPILED_SECONDS, SEARCHED_SECONDS = 40.0, 1.0
"""Seconds of the stages, for the progress display."""


def search_stages(robust: bool) -> dict[str, float]:
    """Return the stages of a search with their seconds."""
    return {COMPILING: linear_part.wait(COMPILED_SECONDS), SEARCHING: SEARCHED_SECONDS * (2 if robust else 1)}


@dataclass(frozen=True)
class LogVolume:
    """Log volume of geometry and cameras at given scales of repeating errors, up to a constant.

    Attributes:
        space: priors.
        products: products of the columns of coordinates, then errors of the gears (rad), by the inverse covariance of
            all other terms, shape (p + e, p + e).
        gears: columns of the campaign, without padding.
        ratio: mean ratios.
    """

    space: ParameterSpace
    products: np.ndarray
    gears: GearArrays
    ratio: np.ndarray

    def __call__(self, z: np.ndarray) -> np.ndarray:
        """Evaluate at points (n, p), of which the scales are used, shape (n,)."""
        size = self.space.size
        free, rest = slice(size), slice(size, None)
        if not self.products[rest].size:
            return np.zeros(len(z))
        values = self.space.values(z)
        values[:, RATIO_COLUMNS] = self.ratio
        root = roots_at(values, self.space, self.gears)
        inner = np.eye(root.size) + root.congruent(self.products[rest, rest])
        load = root.transposed_times(self.products[rest, free])
        information = self.products[free, free] - np.swapaxes(load, 1, 2) @ np.linalg.solve(inner, load)
        return -0.5 * np.linalg.slogdet(np.eye(size) + information)[1]


def held_by(names: Sequence[str], free: Bool[np.ndarray, " parameters"]) -> Bool[np.ndarray, " parameters"]:
    """Mark the parameters that a linearisation takes as known: noise scales and those not estimated."""
    return np.isin(names, NOISE_NAMES) | ~free


def _curvatures(objective: Objective, z: np.ndarray, columns: np.ndarray, step: float) -> np.ndarray:
    """Compute second differences of an objective at z (p,) along some coordinates (k,), shape (k,)."""
    steps = step * np.eye(len(z))[columns]
    centre, *nudged = objective(np.concatenate([z[None], z + steps, z - steps]))
    return (np.sum(np.reshape(nudged, (2, -1)), axis=0) - 2 * centre) / step**2


class Problem:
    """One campaign with its priors, as arguments of the compiled functions.

    Args of the constructor: the campaign, its priors, which spots are used, and the weights of the first spots (default
    of both: 1).
    """

    def __init__(
        self,
        campaign: Campaign,
        table: RigTable,
        used: np.ndarray | None = None,
        weight: np.ndarray | None = None,
    ):
        self.spots, self.table = ordered_spots(campaign), table
        used = np.ones(len(self.spots), dtype=bool) if used is None else used
        self.space = parameter_space(table, campaign.stereo)
        arrays = campaign_arrays(campaign, table)
        self.arrays = arrays.weighed(arrays.used * used, np.ones(0) if weight is None else weight)
        readings = (spot.aperture_deg is not None for spot, use in zip(self.spots, used, strict=True) if use)
        homed = np.asarray(self.arrays.spots.homed)[: len(self.spots)][self.arrays.used].any(axis=0)
        unseen = unseen_shifts(campaign.moves, table.priors)
        # A single segment says nothing on the scatter of homings, which stays at its median.
        unseen += tuple(name for name, seen in zip(HOME_SD_NAMES, homed, strict=True) if not seen)
        self.free = free_mask(self.space, any(readings), unseen)
        names = table.mechanism.names
        self.noise = np.flatnonzero(np.isin(names, NOISE_NAMES) & self.free)
        self.held = held_by(names, self.free)
        self.repeated = np.isin(names, GEAR_ERROR_NAMES) & self.free

    @property
    def dof(self) -> np.ndarray:
        """Count each spot's residuals: those of a look, and a reading of the aperture."""
        return self.table.mechanism.residuals + np.asarray(self.arrays.spots.has_aperture)[: len(self.spots)]

    def compile_aside(self, executor: ThreadPoolExecutor) -> None:
        """Start the compilation for later steps in another thread, while the first stage runs."""

        def work():
            self.negative_log_density(np.zeros((1, self.space.size)))

        executor.submit(work)

    def least_squares(self, z: np.ndarray, inflation: float) -> np.ndarray:
        """Fit geometry and stereo for given noise scales."""
        return np.array(stage(z, self.space, self.arrays, Fixed(self.held, z, np.array(inflation))).z)

    def negative_log_density(self, z: np.ndarray) -> np.ndarray:
        """Evaluate many points (n, p); infinite where the model has no value."""
        still = no_draw(len(z), self.arrays)
        log_density = evaluate(z, still, self.space, self.arrays).log_density
        return np.where(np.isfinite(log_density), -log_density, np.inf)

    def noise_scales(self, z: np.ndarray) -> np.ndarray:
        """Optimise the noise scales for given geometry, under their priors.

        Scales of errors that repeat maximise the density with geometry and cameras integrated out. The volume of these
        grows with the errors; at the joint mode the scales would be far too small.
        """
        count = self.noise.size
        if not count:
            return z
        volume = self.log_volume(z)
        steps = np.concatenate([np.zeros((1, count)), np.eye(count), -np.eye(count)]) * NOISE_STEP

        def about(values: np.ndarray) -> list[np.ndarray]:
            """Evaluate the function to minimise at noise scales (s,), then one step ahead and one behind in each."""
            points = np.repeat(z[None], len(steps), axis=0)
            points[:, self.noise] = values + steps
            return np.split(self.negative_log_density(points) - volume(points), [1, 1 + count])

        # Scaled by the curvature of the density at the start, a quasi-Newton method has a suitable first step.
        centre, ahead, behind = about(z[self.noise])
        curvature = (ahead + behind - 2 * centre) / NOISE_STEP**2
        unit = 1 / np.sqrt(np.where(np.isfinite(curvature), np.clip(curvature, 1.0, None), 1.0))

        def value_and_slope(values: np.ndarray) -> tuple[float, np.ndarray]:
            centre, ahead, behind = about(values * unit)
            return float(centre[0]), (ahead - behind) / (2 * NOISE_STEP) * unit

        # Eight prior standard deviations: a factor 3000 on a stop sd, 55 on the pixel scale.
        bounds = list(zip(-8.0 / unit, 8.0 / unit, strict=True))
        settled = {"ftol": 1e-8, "gtol": 1e-2}
        optimum = optimize.minimize(
            value_and_slope, z[self.noise] / unit, jac=True, method="L-BFGS-B", bounds=bounds, options=settled
        )
        result = z.copy()
        result[self.noise] = optimum.x * unit
        return result

    def log_volume(self, z: np.ndarray) -> LogVolume:
        """Return the volume of geometry and cameras by scales of repeating errors, linearised at z."""
        gears, ratio = self.arrays.gears.without_padding(), physical_at(z, self.space).value[RATIO_COLUMNS]
        if not gears.columns:
            return LogVolume(self.space, np.zeros((self.space.size, self.space.size)), gears, ratio)
        lin = self.linearised(z)
        linear = linear_spots(lin, self.arrays, lin.by_coordinates(self.held))
        information = stop_information(linear.spelled_out(np.asarray(lin.place_columns)))
        return LogVolume(self.space, information.fisher, gears, ratio)

    def alternate(self, z: np.ndarray) -> np.ndarray:
        """Alternate geometry and noise scales until the noise settles (formulation 4.2)."""
        for _ in range(ALTERNATIONS_MAX):
            previous = z
            z = self.least_squares(self.noise_scales(z), 1.0)
            if np.max(np.abs(z - previous)[self.noise], initial=0.0) < NOISE_SETTLED:
                break
        return z

    def searched(self, robust: bool, job: Job) -> np.ndarray:
        """Find the start of the Newton steps: a point in the basin of the mode, weights settled if `robust`.

        `job` must have the stages of `search_stages`.
        """
        z, passes = np.zeros(self.space.size), len(ANNEALING) + 1 + (ROUNDS_EXPECTED if robust else 0)
        job.begin(COMPILING)
        for number, inflation in enumerate(ANNEALING, 1):
            z = self.least_squares(z, inflation)
            job.begin(SEARCHING)
            job.at(number / passes)
        z = self.alternate(z)
        for number in range(ROUNDS_MAX if robust else 0):
            job.at((len(ANNEALING) + 1 + number) / passes)
            if self.reweighted(z) < WEIGHTS_SETTLED:
                break
            z = self.alternate(z)
        return z

    def linearised(self, z: np.ndarray) -> Linearised:
        """Linearise the campaign at a point, without padding."""
        return linearised_at(z, self.space, self.arrays)

    def information(self, lin: Linearised) -> StopInformation:
        """Compute the stops' information on geometry and stereo at fixed noise scales."""
        return stop_information(linear_spots(lin, self.arrays, lin.by_coordinates(self.held)))

    def mode(self, z: np.ndarray) -> Mode:
        """Find the mode by Newton steps from z at fixed scales of repeating errors, and the variance of these scales.

        Their variance is that of the density with geometry and cameras integrated out, at most the prior's.
        """
        optimum = newton_mode(self.negative_log_density, z, self.free & ~self.repeated, self.curvature(z))
        repeated = np.flatnonzero(self.repeated)
        if not repeated.size:
            return optimum
        volume, covariance = self.log_volume(optimum.z), optimum.covariance.copy()
        bent = _curvatures(lambda z: self.negative_log_density(z) - volume(z), optimum.z, repeated, SCALE_STEP)
        covariance[repeated, repeated] = 1 / np.clip(bent, 1.0, None)
        return replace(optimum, covariance=covariance)

    def mode_beside(self, known: Mode) -> Mode:
        """Find the mode from that of another homing hypothesis, usually near, at fixed scales of repeating errors."""
        optimum = neighbouring_mode(self.negative_log_density, known, self.free & ~self.repeated)
        if optimum is not None:
            return optimum
        z = self.alternate(known.z.copy())
        value = float(self.negative_log_density(z[None])[0])
        # With so low a density the last Newton steps do not matter: the homing hypothesis has no weight.
        if not value < known.negative_log_density + HOPELESS:
            return Mode(z, known.covariance, value, ())
        return self.mode(z)

    def curvature(self, z: np.ndarray) -> np.ndarray:
        """Compute the information on the coordinates: Fisher's, and for the noise by differences."""
        value = self.information(self.linearised(z)).fisher + np.eye(len(z))
        bent = _curvatures(self.negative_log_density, z, self.noise, NOISE_STEP)
        value[self.noise, self.noise] = np.maximum(1.0, bent)
        return value

    def reweighted(self, z: np.ndarray) -> float:
        """Run one round of the robust option: gate and Huber weights from leave-one-out residuals.

        Returns:
            The largest change of a weight.
        """
        spots = self.arrays.spots
        count = len(self.spots)
        valid, weight = np.array(spots.valid)[:count], np.array(spots.weight)[:count]
        chi2 = leave_one_out_chi2(self.information(self.linearised(z)), weight)
        used = valid > 0
        # The noise scales were fitted with the outliers in: the median restores the scale of the clean spots.
        scale2 = np.median(chi2[used] / special.chdtri(self.dof[used], 0.5))
        chi2 = chi2 / max(scale2, 1e-12)
        over = used & (chi2 > special.chdtri(self.dof, GATE_PROBABILITY))
        # A bad spot also increases its neighbours' distances: only the worst of each run is excluded in one round.
        for index in np.flatnonzero(over):
            run = slice(max(index - 2, 0), index + 3)
            if chi2[index] >= np.max(np.where(used[run], chi2[run], 0.0)):
                valid[index] = 0.0
        core = special.chdtri(self.dof, 1 - HUBER_CORE)
        new_weight = np.where(valid > 0, np.sqrt(np.minimum(1.0, core / np.maximum(chi2, 1e-12))), 1.0)
        self.arrays = self.arrays.weighed(valid, new_weight)
        return float(np.max(np.abs(new_weight - weight) + (valid != used)))
