"""What fits of a design will report, over drawn instruments: the chance that they meet the target.

An instrument is drawn from `[truth]` of the rig file, or from the posterior of a campaign. Values in the target's unit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from tvsbayes.errors import InputError
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.parameters import INDEX, RIG_NAMES
from tvsbayes.instrument.plan import LOOKS_PER_EXPERIMENT
from tvsbayes.model.gear_kriging import scales_at
from tvsbayes.model.parameter_space import SCATTER_COLUMNS, STOP_COLUMNS, ParameterSpace
from tvsbayes.planning.candidates import Candidates
from tvsbayes.planning.drawn_rigs import Instruments
from tvsbayes.planning.expectation import NOISE_COLUMNS, PARAMETERS, Knowledge
from tvsbayes.planning.gear_places import GearPlaces
from tvsbayes.planning.looks import Arranged, LookArrays, Looks, Seen, arrange, covariance_of, information_of_looks
from tvsbayes.planning.target import Sensitivity, Target, sensitivity
from tvsbayes.progress import Advance, unshown
from tvsbayes.statistics.streams import Stream, random_stream

PIXEL_COLUMN = INDEX["pixel_scale"]
SCALES = [*STOP_COLUMNS.ravel(), PIXEL_COLUMN]
"""Columns of the noise scales: stops by direction (right, left, down, up), pixels."""


def believed(
    instruments: Instruments,
    seen: Seen,
    side: np.ndarray,
    chosen: np.ndarray,
    covariance: np.ndarray,
    knowledge: Knowledge,
    noise: np.ndarray,
) -> np.ndarray:
    """Coordinates at which fits will judge their uncertainty: the true ones, noise scales as they will estimate them.

    A standard deviation is known from n stops to 1 / sqrt(2 n): the log of each scale has the expected information
    2 sum (s^2 m / (1 + s^2 m))^2 over the stops of its direction, m what the pixels know of one stop, less what the
    geometry takes from them; its estimate lies between prior and truth by the weights of both, and scatters. A sampled
    fit takes its variance over all that the scale may be: E s^2 of a log-normal, not s^2 of its middle.

    Args:
        instruments: the true ones, n of them.
        seen: what they see of m looks, shapes (n, m, ...).
        side: sides of these, shape (m, 2).
        chosen: numbers of those taken, repeats allowed, shape (k,).
        covariance: of coordinates and errors of gears after the looks, shape (n, p + e, p + e).
        knowledge: before the looks.
        noise: standard normal numbers in the order of `SCALES`, shape (n, 5).

    Returns:
        Shape (n, p).
    """
    z, u = instruments.z.copy(), np.asarray(knowledge.space.u)
    taken = seen.seen * np.bincount(chosen, minlength=len(side))
    looks = np.maximum(taken.sum(axis=1), 1)
    rig_columns = np.ones(knowledge.size, dtype=bool)
    rig_columns[:PARAMETERS] = ~NOISE_COLUMNS & (np.arange(PARAMETERS) < len(RIG_NAMES))
    precision = np.diag(knowledge.precision)
    variance = np.diagonal(covariance, axis1=-2, axis2=-1)
    determined = np.sum(1 - variance[:, rig_columns] * precision[rig_columns], axis=1)
    left_over = np.maximum(0.0, 1 - determined / (2 * looks))

    def estimate(column: int, information: np.ndarray, normal: np.ndarray) -> None:
        information = information * u[column] ** 2 * left_over
        before = precision[column]
        mean = before * knowledge.z[column] + information * z[:, column] + np.sqrt(information) * normal
        # ln s = u z: the root of E s^2 lies u^2 times the variance of z above the middle.
        z[:, column] = (mean + u[column]) / (before + information)

    for axis in range(2):
        known = np.sum(seen.slope[..., axis] ** 2, axis=2)
        for which, sign in enumerate((-1, 1)):
            column = STOP_COLUMNS[axis, which]
            share = known * np.radians(instruments.physical[:, column, None]) ** 2
            share = share / (1 + share)
            stops = taken * (side[:, axis] == sign)
            estimate(column, 2 * np.sum(stops * share**2, axis=1), noise[:, 2 * axis + which])
    estimate(PIXEL_COLUMN, 2.0 * looks, noise[:, 4])
    return z


def own_gears(knowledge: Knowledge, physical: np.ndarray) -> GearPlaces:
    """The places of the gears of an instrument: before any data it repeats errors of its own scales.

    On the average over instruments a fit, which takes its variance over all that the scales may be, reports what it
    would if it knew them. After data they are as good as known.

    Args:
        knowledge: before the looks.
        physical: the instrument's values in the units of `NAMES`, shape (p,).
    """
    gears = knowledge.gears
    if knowledge.after_data or not gears.size:
        return gears
    ratio = np.radians([physical[INDEX[f"degrees_per_step.{axis}"]] for axis in AXES])
    return replace(
        gears, ratio_rad_per_step=ratio, scales=scales_at(physical, np.asarray(knowledge.space.harmonic_period_deg))
    )


@dataclass(frozen=True)
class Family:
    """Designs that grow by one look at a time: the first 4 n of `picks` are n experiments."""

    knowledge: Knowledge
    candidates: Candidates
    picks: np.ndarray
    aperture: bool

    def looks(self, experiments: int) -> Looks:
        """Looks of n experiments."""
        return self.candidates.looks[self.picks[: LOOKS_PER_EXPERIMENT * experiments]]

    def arranged(self, experiments: int) -> Arranged:
        """Their plan."""
        return arrange(self.looks(experiments), self.knowledge.sheets, self.candidates.overshoot)

    @property
    def largest(self) -> int:
        """Experiments of the largest design."""
        return len(self.picks) // LOOKS_PER_EXPERIMENT


@dataclass(frozen=True)
class _Scene:
    """Some of the instruments, what they see of a family's looks, and the target there.

    Attributes:
        rows: numbers of those that see any look and reach the target's point, n of them.
        instruments: these.
        seen: shapes (n, looks, ...).
        gradient: of the target, shape (n, q, p + e); of lines by each place, which designs sum, (n, c + 1, q, p + e).
        own_variance: of the target beside it, shape (n, q).
    """

    rows: np.ndarray
    instruments: Instruments
    seen: Seen
    gradient: np.ndarray
    own_variance: np.ndarray


class Assurance:
    """What fits of the designs of a family will report, over drawn truths."""

    PAIRS, KEPT = 4096, 16
    """Looks of all instruments that are evaluated together, and how often so many are kept: 10 MB each."""

    def __init__(self, family: Family, target: Target, instruments: Instruments, seed: int):
        self.family, self.target, self.instruments, self.seed = family, target, instruments, seed
        # After data a fit's line goes through the looks of both, of which the places know the sum alone.
        before = not family.knowledge.after_data
        self._of_lines = before and target.point_mm is None and family.knowledge.gears.size > 0
        self.noise = random_stream(seed, Stream.INSTRUMENT_SCALES).standard_normal((len(instruments), len(SCALES)))
        self.distinct, self.index = np.unique(family.picks, return_inverse=True)
        self.looks = family.candidates.looks[self.distinct]
        self.arrays = LookArrays(self.looks, family.knowledge, family.aperture)
        self._scene = lru_cache(maxsize=self.KEPT)(self._evaluated)
        self._values: dict[int, np.ndarray] = {}

    def of(self, family: Family) -> Assurance:
        """The same instruments before other designs."""
        return Assurance(family, self.target, self.instruments, self.seed)

    def values(self, sizes: Sequence[int], advance: Advance = unshown) -> dict[int, np.ndarray]:
        """Reported uncertainty of the target at each truth, shape (draws,), by number of experiments."""
        draws, together = len(self.instruments), max(1, self.PAIRS // len(self.looks))
        wanted = {n: self.family.arranged(n) for n in sizes if n not in self._values}
        values_by_size = {n: np.full(draws, np.inf) for n in wanted}
        for first in range(0, draws, together) if wanted else ():
            scene = self._scene(first, min(first + together, draws))
            for n, design in wanted.items():
                values_by_size[n][scene.rows] = self._reported(scene, n, design)
            advance((first + together) / draws)
        self._values |= values_by_size
        return {n: self._values[n] for n in sizes}

    def met_share(self, experiments: int) -> float:
        """Share of the truths whose fit of n experiments reports the target as met."""
        return float(np.mean(self.values([experiments])[experiments] <= self.target.limit))

    def _evaluated(self, first: int, end: int) -> _Scene:
        every, knowledge = self.instruments[np.arange(first, end)], self.family.knowledge
        gears = [own_gears(knowledge, physical) for physical in every.physical]
        turning = np.array([places.turning(self.looks.steps, self.looks.side) for places in gears])
        shown = self.arrays.at_all(every.z, every.value, turning)
        poses = shown.mirror_angles_rad[:, self.index].mean(axis=1)
        rows, aimed = [], []
        for row in np.flatnonzero(shown.seen.any(axis=1)).tolist():
            try:
                aimed.append(self._aimed(every.z[row], every.space_of(row), poses[row], gears[row]))
            except InputError:
                continue
            rows.append(row)
        chosen, wanted = np.array(rows, dtype=int), len(self.target.indices)
        parts = (knowledge.gears.size // 2 + 1,) if self._of_lines else ()
        gradient = np.array([one.gradient for one in aimed]).reshape(len(rows), *parts, wanted, knowledge.size)
        own_variance = np.array([one.own_variance for one in aimed]).reshape(len(rows), *parts, wanted)
        return _Scene(first + chosen, every[chosen], shown[chosen], gradient, own_variance)

    def _aimed(self, z: np.ndarray, space: ParameterSpace, pose_rad: np.ndarray, gears: GearPlaces) -> Sensitivity:
        """How the target depends on the coordinates of an instrument; of lines, by place (leading axis c + 1).

        Raises:
            InputError: no beam reaches the target's point.
        """
        if self._of_lines:
            return Sensitivity(np.asarray(gears.parts(z, space, pose_rad).gradient)[:, list(self.target.indices)])
        return sensitivity(self.target, z, space, self.family.knowledge.rig.table, pose_rad, gears)

    def _reported(self, scene: _Scene, experiments: int, design: Arranged) -> np.ndarray:
        """Of the instruments of a scene, shape (n,)."""
        knowledge, chosen = self.family.knowledge, self.index[: LOOKS_PER_EXPERIMENT * experiments]
        way = design.path, knowledge.space, knowledge.after_data, design.warm_minutes(knowledge.rig)

        def covariance(seen: Seen) -> np.ndarray:
            information = information_of_looks(seen, chosen, *way)
            return covariance_of(knowledge.precision + information)

        first = covariance(scene.seen)
        noise = self.noise[scene.rows]
        z = believed(scene.instruments, scene.seen, self.looks.side, chosen, first, knowledge, noise)
        judged = covariance(self.rescaled(scene.seen, scene.instruments, z))
        return self._hangs(scene, chosen).values(judged, self.target.factor)

    def _hangs(self, scene: _Scene, chosen: np.ndarray) -> Sensitivity:
        """How what is wanted depends on the coordinates: ratios along the lines through the looks that are seen."""
        if not self._of_lines:
            return Sensitivity(scene.gradient, {"at the point": scene.own_variance})
        gears, rows = self.family.knowledge.gears, list(self.target.indices)
        taken = scene.seen.seen * np.bincount(chosen, minlength=len(self.looks))
        weights = gears.weights(gears.line_through(self.looks.steps, taken))[:, rows]
        return Sensitivity(np.einsum("nqi,niqp->nqp", weights, scene.gradient))

    def rescaled(self, seen: Seen, instruments: Instruments, z: np.ndarray) -> Seen:
        """The same looks (n, m) whitened with noise scales of other coordinates (n, p), the scatter of looks as it is.

        Rows and slope J are in units of pixels and scatter of looks D together: J D J^T of I is the scatter's, the rest
        goes with the pixel scale s. With stop errors S the covariance is s^2 (I - J D J^T) + J (D + S) J^T.
        """
        u, true = np.asarray(self.family.knowledge.space.u)[SCALES], instruments.value[:, SCALES]
        before, after = (true * np.exp(u * point[:, SCALES]) for point in (instruments.z, z))
        pixel = after[:, 4] / before[:, 4]
        sides = (self.looks.side > 0).astype(int)

        def of_angles(sd_deg: np.ndarray) -> np.ndarray:
            return (seen.slope * np.radians(sd_deg)[:, :, None] ** 2) @ np.swapaxes(seen.slope, -1, -2)

        by_looks = of_angles(instruments.physical[:, None, SCATTER_COLUMNS])
        # Both roots are taken in the three dimensions that the residual has; rows are turned, not only scaled.
        old, new = (
            p[:, None, None, None] ** 2 * (np.eye(4) - by_looks)
            + by_looks
            + of_angles(scale[:, :4].reshape(-1, 2, 2)[:, [0, 1], sides])
            for p, scale in ((np.ones(len(pixel)), before), (pixel, after))
        )
        turn = np.linalg.solve(np.linalg.cholesky(new), np.linalg.cholesky(old))
        return replace(seen, rows=turn @ seen.rows)
