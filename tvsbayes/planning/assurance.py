"""Assurance of a design: the probability over drawn instruments that its fit reports the target as met.

An instrument is drawn from `[truth]` of the rig file, or from the posterior of a campaign. Values in the target's unit.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from tvsbayes.errors import InputError
from tvsbayes.instrument.mechanisms import RATIO_COLUMNS, Mechanism
from tvsbayes.instrument.plan import LOOKS_PER_EXPERIMENT
from tvsbayes.model.gear_kriging import scales_at
from tvsbayes.model.parameter_space import ParameterSpace
from tvsbayes.planning.candidates import Candidates
from tvsbayes.planning.drawn_rigs import Instruments
from tvsbayes.planning.expectation import Knowledge
from tvsbayes.planning.gear_places import GearPlaces
from tvsbayes.planning.looks import LookArrays, LookPlan, Looks, Seen, arrange, information_of_looks
from tvsbayes.planning.target import Sensitivity, Target, sensitivity
from tvsbayes.progress import Advance, unshown
from tvsbayes.statistics.optimal_design import covariance_of
from tvsbayes.statistics.streams import Stream, random_stream

STOPS, PIXEL = slice(0, 4), 4
"""Indices of `scales_of` by kind."""


def scales_of(mechanism: Mechanism) -> np.ndarray:
    """Return the coordinates of the noise scales: stops by direction (right, left, down, up), pixels."""
    return np.append(mechanism.stop_columns, mechanism.index["pixel_scale"])


def judged_z(
    instruments: Instruments,
    seen: Seen,
    side: np.ndarray,
    picks: np.ndarray,
    covariance: np.ndarray,
    knowledge: Knowledge,
    noise: np.ndarray,
) -> np.ndarray:
    """Compute the coordinates at which fits evaluate their uncertainty: the true ones, with estimated noise scales.

    n stops determine a standard deviation to 1 / sqrt(2 n). The log of each scale has the expected information 2 sum
    (s^2 m / (1 + s^2 m))^2 over the stops of its direction, less the share used by the geometry; m is the information
    of the pixels on one stop. The estimated scale is the weighted mean of prior and truth, with scatter. A sampled fit
    averages its variance over the scale: E s^2 of a log-normal, not s^2 of its median.

    Args:
        instruments: n true instruments.
        seen: expectation of m looks for each instrument, shapes (n, m, ...).
        side: sides of these looks, shape (m, 2).
        picks: numbers of the looks taken, repeats allowed, shape (k,).
        covariance: covariance of coordinates and errors of gears after the looks, shape (n, p + e, p + e).
        knowledge: before the looks.
        noise: standard normal numbers in the order of `scales_of`, shape (n, 5).

    Returns:
        Shape (n, p).
    """
    z, u = instruments.z.copy(), np.asarray(knowledge.space.u)
    scales = scales_of(knowledge.space.mechanism)
    # A fit of the next instrument of a build has the priors of the rig file, wherever the plan expects it.
    centre = knowledge.z if knowledge.after_data else np.zeros_like(knowledge.z)
    times_seen = seen.seen * np.bincount(picks, minlength=len(side))
    looks = np.maximum(times_seen.sum(axis=1), 1)
    rig_columns = np.ones(knowledge.size, dtype=bool)
    rig_columns[: len(knowledge.z)] = ~knowledge.noise & (np.arange(len(knowledge.z)) < knowledge.space.rig)
    precision = np.diag(knowledge.precision)
    variance = np.diagonal(covariance, axis1=-2, axis2=-1)
    determined = np.sum(1 - variance[:, rig_columns] * precision[rig_columns], axis=1)
    residual_share = np.maximum(0.0, 1 - determined / (2 * looks))

    def estimate(column: int, information: np.ndarray, normal: np.ndarray) -> None:
        information = information * u[column] ** 2 * residual_share
        prior_precision = precision[column]
        mean = prior_precision * centre[column] + information * z[:, column] + np.sqrt(information) * normal
        # ln s = u z: the root of E s^2 lies u^2 times the variance of z above the median.
        z[:, column] = (mean + u[column]) / (prior_precision + information)

    for axis in range(2):
        known = np.sum(seen.slope[..., axis] ** 2, axis=2)
        for index, sign in enumerate((-1, 1)):
            column = int(scales[STOPS][2 * axis + index])
            share = known * np.radians(instruments.physical[:, column, None]) ** 2
            share = share / (1 + share)
            stops = times_seen * (side[:, axis] == sign)
            estimate(column, 2 * np.sum(stops * share**2, axis=1), noise[:, STOPS][:, 2 * axis + index])
    estimate(int(scales[PIXEL]), 2.0 * looks, noise[:, PIXEL])
    return z


def instrument_gears(knowledge: Knowledge, physical: np.ndarray) -> GearPlaces:
    """Return the places of the gears of an instrument; before any data they have its own scales of errors.

    A fit averages its variance over the scales; on average over instruments it reports the same as with known scales.
    After data the scales count as known.

    Args:
        knowledge: before the looks.
        physical: the instrument's values in the units of their names, shape (p,).
    """
    gears = knowledge.gears
    if knowledge.after_data or not gears.size:
        return gears
    scales = scales_at(physical, np.asarray(knowledge.space.harmonic_period_deg), knowledge.space.mechanism)
    return replace(gears, ratio_rad_per_step=np.radians(physical[RATIO_COLUMNS]), scales=scales)


@dataclass(frozen=True)
class Family:
    """Designs of increasing size: the first 4 n of `picks` are n experiments."""

    knowledge: Knowledge
    candidates: Candidates
    picks: np.ndarray
    aperture: bool

    def looks(self, experiments: int) -> Looks:
        """Return the looks of n experiments."""
        return self.candidates.looks[self.picks[: LOOKS_PER_EXPERIMENT * experiments]]

    def arranged(self, experiments: int) -> LookPlan:
        """Arrange these looks as a plan."""
        return arrange(self.looks(experiments), self.knowledge.sheets, self.candidates.run_up)

    @property
    def largest(self) -> int:
        """Return the number of experiments of the largest design."""
        return len(self.picks) // LOOKS_PER_EXPERIMENT


class _Block(NamedTuple):
    """The n instruments of a block that can make looks of a family and reach the target's point.

    `rows` are their numbers, `seen` their expectations (n, looks, ...), `gradient` that of the target by parts (n,
    parts, q, p + e): for lines a part for each place and one for none, else a single part.
    """

    rows: np.ndarray
    instruments: Instruments
    seen: Seen
    gradient: np.ndarray
    own_variance: np.ndarray


class Assurance:
    """Uncertainties that fits of the designs of a family will report, over drawn truths."""

    PAIRS, CACHED = 4096, 16
    """Pairs of instrument and look in a block, and number of cached blocks: 10 MB each."""

    def __init__(self, family: Family, target: Target, instruments: Instruments, seed: int):
        self.family, self.target, self.instruments, self.seed = family, target, instruments, seed
        # After data a fit's line goes through earlier and new looks, which the errors at places do not separate.
        before_data = not family.knowledge.after_data
        self._of_lines = before_data and target.point_mm is None and family.knowledge.gears.size > 0
        self.noise = random_stream(seed, Stream.INSTRUMENT_SCALES).standard_normal((len(instruments), PIXEL + 1))
        self.distinct, self.index = np.unique(family.picks, return_inverse=True)
        self.looks = family.candidates.looks[self.distinct]
        self.arrays = LookArrays(self.looks, family.knowledge, family.aperture)
        self._block = lru_cache(maxsize=self.CACHED)(self._evaluate)
        self._values: dict[int, np.ndarray] = {}

    def of(self, family: Family) -> Assurance:
        """Return the assurance of other designs for the same instruments."""
        return Assurance(family, self.target, self.instruments, self.seed)

    def values(self, sizes: Sequence[int], advance: Advance = unshown) -> dict[int, np.ndarray]:
        """Compute the reported uncertainty of the target at each truth, shape (draws,), by number of experiments."""
        draws, block_size = len(self.instruments), max(1, self.PAIRS // len(self.looks))
        designs = {n: self.family.arranged(n) for n in sizes if n not in self._values}
        values_by_size = {n: np.full(draws, np.inf) for n in designs}
        for first in range(0, draws, block_size) if designs else ():
            block = self._block(first, min(first + block_size, draws))
            for n, design in designs.items():
                values_by_size[n][block.rows] = self._reported_values(block, n, design)
            advance((first + block_size) / draws)
        self._values |= values_by_size
        return {n: self._values[n] for n in sizes}

    def met_share(self, experiments: int) -> float:
        """Compute the share of truths whose fit of n experiments reports the target as met."""
        return float(np.mean(self.values([experiments])[experiments] <= self.target.limit))

    def _evaluate(self, first: int, end: int) -> _Block:
        drawn, knowledge = self.instruments[np.arange(first, end)], self.family.knowledge
        gears = [instrument_gears(knowledge, physical) for physical in drawn.physical]
        turning = np.array([places.turning(self.looks.steps, self.looks.side) for places in gears])
        seen = self.arrays.at_all(drawn.z, drawn.value, turning)
        poses = seen.mirror_angles_rad[:, self.index].mean(axis=1)
        at: dict[int, Sensitivity] = {}
        for row in np.flatnonzero(seen.seen.any(axis=1)).tolist():
            # No beam of an instrument may reach the target's point.
            with suppress(InputError):
                at[row] = self._target_at(drawn.z[row], drawn.space_of(row), poses[row], gears[row])
        rows = np.array(list(at), dtype=int)
        shape = len(at), knowledge.gears.size // 2 + 1 if self._of_lines else 1, len(self.target.indices)
        gradient = np.array([s.gradient for s in at.values()]).reshape(*shape, knowledge.size)
        own_variance = np.array([s.own_variance for s in at.values()]).reshape(shape).sum(axis=1)
        return _Block(first + rows, drawn[rows], seen[rows], gradient, own_variance)

    def _target_at(self, z: np.ndarray, space: ParameterSpace, pose_rad: np.ndarray, gears: GearPlaces) -> Sensitivity:
        """Compute the sensitivity of the target at an instrument; for lines by place (leading axis c + 1).

        Raises:
            InputError: no beam reaches the target's point.
        """
        if self._of_lines:
            return Sensitivity(np.asarray(gears.parts(z, space, pose_rad).gradient)[:, list(self.target.indices)])
        return sensitivity(self.target, z, space, self.family.knowledge.rig.table, pose_rad, gears)

    def _reported_values(self, block: _Block, experiments: int, design: LookPlan) -> np.ndarray:
        """Compute the reported uncertainty for the instruments of a block, shape (n,)."""
        knowledge, picks = self.family.knowledge, self.index[: LOOKS_PER_EXPERIMENT * experiments]
        context = design.path, knowledge.space, knowledge.home_variances_rad2, design.warm_minutes(knowledge.rig)

        def covariance(seen: Seen) -> np.ndarray:
            return covariance_of(knowledge.precision + information_of_looks(seen, picks, *context))

        instruments, first = block.instruments, covariance(block.seen)
        z = judged_z(instruments, block.seen, self.looks.side, picks, first, knowledge, self.noise[block.rows])
        weights = np.ones((len(block.rows), len(self.target.indices), 1))
        if self._of_lines:
            # Ratios along the lines through the visible looks.
            times_seen = block.seen.seen * np.bincount(picks, minlength=len(self.looks))
            lines = knowledge.gears.line_through(self.looks.steps, times_seen)
            weights = knowledge.gears.weights(lines)[:, list(self.target.indices)]
        gradient = np.einsum("nqi,niqp->nqp", weights, block.gradient)
        at = Sensitivity(gradient, {"at the point": block.own_variance})
        return at.values(covariance(self.rescaled(block.seen, instruments, z)), self.target.factor)

    def rescaled(self, seen: Seen, instruments: Instruments, z: np.ndarray) -> Seen:
        """Whiten looks (n, m) again with the noise scales of other coordinates (n, p) and the same scatter of looks.

        Rows and slope J are in units of pixel noise plus scatter of looks D: the scatter's part of I is J D J^T, the
        rest scales with the pixel scale s. With stop errors S the covariance is s^2 (I - J D J^T) + J (D + S) J^T.
        """
        scales = scales_of(instruments.common.mechanism)
        u, true = np.asarray(self.family.knowledge.space.u)[scales], instruments.value[:, scales]
        old_sd, new_sd = (true * np.exp(u * point[:, scales]) for point in (instruments.z, z))
        pixel = new_sd[:, PIXEL] / old_sd[:, PIXEL]
        sides = (self.looks.side > 0).astype(int)

        def of_angles(sd_deg: np.ndarray) -> np.ndarray:
            return (seen.slope * np.radians(sd_deg)[:, :, None] ** 2) @ np.swapaxes(seen.slope, -1, -2)

        scatter = of_angles(instruments.physical[:, None, instruments.common.mechanism.columns("look_scatter_deg")])
        # The transform also rotates the rows; it is not only a scale.
        old_root, new_root = (
            p[:, None, None, None] ** 2 * (np.eye(4) - scatter)
            + scatter
            + of_angles(scale[:, STOPS].reshape(-1, 2, 2)[:, [0, 1], sides])
            for p, scale in ((np.ones(len(pixel)), old_sd), (pixel, new_sd))
        )
        transform = np.linalg.solve(np.linalg.cholesky(new_root), np.linalg.cholesky(old_root))
        return replace(seen, rows=transform @ seen.rows)
