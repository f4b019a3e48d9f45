"""The map to coordinates in which the posterior is nearly normal, so that proposals need not follow its ridges.

It has three layers: z, the prior-normal coordinates of the model; y, whitened by the Laplace covariance; w, in which
draws are made. Mean and covariance of other parameters depend on the noise scales (as of ratio and backlash on a stop
sd) and on the time constant of a creep. In w all others are therefore relative to their conditional mean and covariance
given these scales, by the linearised campaign. The ridges of narrow directions (extrinsics, ratios) are curved along
wide ones (laser tilt, lens distortion). For every draw of the noise scales and wide coordinates, Gauss-Newton steps
from the model's residuals centre the narrow ones. NumPy outside the compiled functions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import jax
import numpy as np
from scipy import linalg

from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.estimators.likelihood import residuals
from tvsbayes.estimators.linear_spots import linear_spots
from tvsbayes.instrument.mechanisms import RATIO_COLUMNS, Mechanism
from tvsbayes.instrument.parameters import BLOCKS, KINDS, NOISE_NAMES, names_of
from tvsbayes.model.compiled import in_batches
from tvsbayes.model.gear_kriging import scales_at
from tvsbayes.model.gear_processes import BlockRoot, column_blocks
from tvsbayes.model.parameter_space import FARTHEST_SD, half_normal, half_normal_slope
from tvsbayes.posterior.linear_campaign import Conditional, Creep, LinearCampaign
from tvsbayes.posterior.look_noise import LookNoise
from tvsbayes.posterior.plays import Cut, HalfNormal
from tvsbayes.posterior.stop_states import Elimination, StopStates, stop_states

GEAR_SCALES = (
    "transmission_error_deg",
    "transmission_error_length_deg",
    "play_variation_deg",
    "harmonic_amplitude_deg",
)
"""Blocks of parameters on which the covariance of the errors at places depends."""
WALK_STEPS = 128
"""Largest number of steps of a drift between two homings; it is linear within each."""
WALK_INFORMATION = 1.0
"""Least information of the spots on a term of a drift whose sd is one sd larger than at the mode, in prior precisions
of the term. If an informed term is left out, other coordinates of the map absorb it, such as a creep."""
LEAST_SCALE = 1e-6
"""Least ratio of a noise scale to that at the mode: smaller ones have no effect."""
FAR_ABOVE = 1e200
"""Last diagonal element that makes a matrix positive definite for any last row; its root is not used."""
FAR_SD, FAR_PIXELS = 4.0, 4.0
"""Limits of the map for the scatter of looks: sds of its prior, and pixel variance at the mode over that of a draw."""
BLOCK_ROWS = 64
"""Points mapped together: their matrices fit into the processor's cache."""
CENTRINGS = 1
"""Gauss-Newton steps of the narrow coordinates at every draw: a second one does not improve the weights."""
BEND_STEP = 2.0
"""Step of second differences in posterior sds: they should hold over +-2 sd, not only at the mode. A move as long as
the play makes a kink in the residuals, whose second difference grows as the step gets shorter."""
SCALE_NAMES = (*NOISE_NAMES, *BLOCKS["creep_minutes"])
"""Coordinates on which all others are conditioned: noise scales, and the time constant of a creep, in which the spots
are strongly nonlinear."""
HEAVY_NAMES = (*SCALE_NAMES, *BLOCKS["backlash_deg"], "extrinsics.rotation_rad.y")
"""Coordinates whose tails are heavier than normal: those that few stops determine (a walker did not move for 155 steps
at 3.7 sd of a stop sd), and the tilt of the frames with the mirrors' offset. Each is always proposed from a table and a
t of its own."""


def positive_factor(bordered: np.ndarray) -> np.ndarray:
    """Compute Cholesky factors of precisions with an additional last row, of their lower triangles, shape (n, k, k).

    Far out, the functions that span the noise of looks may leave a precision indefinite, or the stops without a factor
    (NaN). Its diagonal is raised, or it is replaced by 1: any positive definite matrix makes a map, and the weights are
    those of the density itself.
    """
    try:
        return np.linalg.cholesky(bordered)
    except np.linalg.LinAlgError:
        finite = np.isfinite(bordered).all(axis=(1, 2))[:, None, None]
        raised, diagonal = np.where(finite, bordered, np.eye(bordered.shape[1])), np.arange(bordered.shape[1] - 1)
        least = np.linalg.eigvalsh(raised[:, :-1, :-1])[:, 0]
        raised[:, diagonal, diagonal] += np.where(least > 0, 0.0, 1.0 - least)[:, None]
        return np.linalg.cholesky(raised)


@dataclass(frozen=True)
class Mapped:
    """Points z (n, p) and ln |dy/dw| there (n,)."""

    z: np.ndarray
    log_jacobian: np.ndarray

    @classmethod
    def joined(cls, parts: Sequence[Mapped]) -> Mapped:
        """Concatenate parts."""
        return cls(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)))


@dataclass(frozen=True)
class Centred:
    """Narrow coordinates y given the others: y = centre + turn^-1 (linear y - mean).

    The linear y is that of the linearised campaign. Shapes (n, k), (n, k) and (n, k, k).
    """

    mean: np.ndarray
    centre: np.ndarray
    turn: np.ndarray


def by_width(covariance: np.ndarray) -> np.ndarray:
    """Order the coordinates so that each has the largest conditional variance given those before it."""
    rest = covariance.copy()
    order: list[int] = []
    for _ in range(len(covariance)):
        variances = np.diag(rest).copy()
        variances[order] = -np.inf
        widest = int(np.argmax(variances))
        order.append(widest)
        rest = rest - np.outer(rest[:, widest], rest[widest]) / rest[widest, widest]
    return np.array(order, dtype=int)


Residuals = Callable[[np.ndarray], np.ndarray]
"""Observed - predicted at points z (n, p) of the mode's noise scales, in units of the noise there, shape (n, 4 k)."""


@dataclass(frozen=True)
class Transport:
    """The map w -> z; its Jacobian is |det root| exp(`Mapped.log_jacobian`).

    Attributes:
        mechanism: the instrument.
        mode: z at w = 0, shape (p,).
        physical: values of the parameters there, in the units of their names, shape (p,).
        free: sampled columns of z, (d,): noise scales, then all others, the widest conditional sd first.
        root: lower-triangular factor of their covariance in that order, separately for noise coordinates and others,
            whose mean at other scales follows from the residuals, shape (d, d).
        noise: number q of noise coordinates.
        narrow: number of the last coordinates, which are centred at every draw.
        slope: derivative of ln of the noise scales by w of the noise coordinates, shape (q, q); of half-normal scales,
            whose logarithm is not linear, the step of z instead.
        half: which noise scales are half-normal, shape (q,).
        linear: the campaign linearised at the mode.
        residuals: residuals of the model, for centring.
        bend: change of the slopes of the narrow coordinates with all others, `turn` = 1 + bend' y, shape (g, narrow,
            narrow).
        angle_rad, on_tilt, of_play: arguments of `gear_processes.column_blocks` for the first of the e errors, which
            are followed by the terms of the drifts.
        drift_axis: 1 at the axis (pan, tilt) whose drift is the sd of each of those terms, shape (terms, 2).
        period_deg: periods of the gears' errors, shape (2, 3).
    """

    mechanism: Mechanism
    mode: np.ndarray
    physical: np.ndarray
    free: np.ndarray
    root: np.ndarray
    noise: int
    narrow: int
    slope: np.ndarray
    half: np.ndarray
    linear: LinearCampaign
    residuals: Residuals
    bend: np.ndarray
    angle_rad: np.ndarray
    on_tilt: np.ndarray
    of_play: np.ndarray
    drift_axis: np.ndarray
    period_deg: np.ndarray

    @property
    def dimension(self) -> int:
        """Return the number of sampled coordinates."""
        return len(self.free)

    @property
    def heavy(self) -> np.ndarray:
        """Mark the coordinates of `HEAVY_NAMES`, shape (d,)."""
        return np.isin(np.array(self.mechanism.names)[self.free], (*HEAVY_NAMES, self.mechanism.optics_names[0]))

    @property
    def coupled(self) -> np.ndarray:
        """Mark the coordinates of the optics, shape (d,).

        They are wide: where several of them are far out together, the proposal fits the target badly.
        """
        return np.isin(np.array(self.mechanism.names)[self.free], self.mechanism.optics_names)

    def noise_of(self, *columns: int) -> np.ndarray:
        """Mark with 1 the noise coordinate that is each of some columns (k,) of z, shape (k, q)."""
        return (np.array(columns)[:, None] == self.free[: self.noise]).astype(float)

    @cached_property
    def pixels(self) -> np.ndarray:
        """Mark with 1 the noise coordinate that scales all pixels, shape (q,)."""
        return self.noise_of(self.mechanism.index["pixel_scale"])[0]

    @cached_property
    def creep_noise(self) -> np.ndarray:
        """Mark with 1 the noise coordinate that is the time constant of a creep, shape (q,)."""
        return self.noise_of(self.mechanism.index["creep_minutes"])[0]

    @cached_property
    def plays(self) -> tuple[int, ...]:
        """Return the positions in y, without noise coordinates, of backlashes that are not narrow."""
        wide = np.array(self.mechanism.names)[self.free[self.noise : self.dimension - self.narrow]]
        return tuple(np.flatnonzero(np.isin(wide, BLOCKS["backlash_deg"])))

    def _play_at_mode(self, place: int) -> HalfNormal:
        return HalfNormal(float(self.mode[self.free[self.noise + place]]))

    def from_whitened(self, y: np.ndarray) -> np.ndarray:
        """Map y (n, d) to z (n, p): linear, except for a backlash, whose degrees are linear and never negative."""
        step = y @ self.root.T
        for place in self.plays:
            column = self.noise + place
            step[:, column] = self._play_at_mode(place).bent(step[:, column])
        z = np.repeat(self.mode[None], len(y), axis=0)
        z[:, self.free] += step
        return z

    def to_whitened(self, z: np.ndarray) -> np.ndarray:
        """Map z (n, p) to y (n, d)."""
        step = (z - self.mode)[:, self.free]
        for place in self.plays:
            column = self.noise + place
            step[:, column] = self._play_at_mode(place).straight(step[:, column])
        return np.linalg.solve(self.root, step.T).T

    def _log_bend(self, z: np.ndarray) -> np.ndarray:
        """Compute ln |dz/dy| at z (n, p), relative to the mode, shape (n,)."""
        columns = self.free[self.noise + np.array(self.plays, dtype=int)]
        return np.log(half_normal_slope(self.mode[columns]) / half_normal_slope(z[:, columns])).sum(axis=1)

    def _bounds(self, place: int, given: Conditional, y: np.ndarray) -> np.ndarray:
        """Compute the bound at zero backlash, in its coordinate w less the mean's shift, given the wider y (n, g)."""
        row = self.root[self.noise + place, self.noise :]
        least = (self._play_at_mode(place).least - y[:, :place] @ row[:place]) / row[place]
        factor = given.own[:, ::-1, ::-1][:, :, place]
        others = np.einsum("nj,nj->n", y[:, :place], factor[:, :place])
        return others + least * factor[:, place] - given.shift[:, ::-1][:, place]

    def _log_scale(self, noise: np.ndarray) -> np.ndarray:
        """Compute ln of the noise scales over those at the mode, at noise coordinates (n, q)."""
        step = noise @ self.slope.T
        at = self.mode[self.free[: self.noise]]
        z = np.minimum(np.where(self.half, at + step, 0.0), FARTHEST_SD)
        ratio = half_normal(z) / half_normal(np.where(self.half, at, 0.0))
        return np.where(self.half, np.log(np.maximum(ratio, LEAST_SCALE)), step)

    def _place_roots(self, log_scale: np.ndarray) -> BlockRoot:
        """Compute factors of the covariance of errors at places, then of drift terms, at ln of noise scales (n, q)."""
        mechanism, values = self.mechanism, np.zeros((len(log_scale), len(self.physical)))
        scales, drifts = mechanism.columns(*GEAR_SCALES), mechanism.columns("drift_deg_per_root_hour")
        values[:, scales] = self.physical[scales] * np.exp(log_scale @ self.noise_of(*scales).T)
        gears = scales_at(values, self.period_deg, mechanism)
        errors = column_blocks(gears, self.angle_rad, self.on_tilt, self.of_play)
        drift = np.radians(self.physical[drifts]) * np.exp(log_scale @ self.noise_of(*drifts).T)
        terms = (drift @ self.drift_axis.T)[..., None] * np.eye(len(self.drift_axis))
        return BlockRoot((*errors.blocks, terms))

    def _conditional(self, noise: np.ndarray, score_at_mode: np.ndarray) -> Conditional:
        """Compute the distribution of y given noise coordinates (n, q), by the linearised campaign and the prior.

        The precision of errors at places and y has the slope as an additional last row. The parts of y in its factor
        are the required factor and forward solution, the errors integrated out (Schur complement).
        """
        linear, log_scale = self.linear, self._log_scale(noise)
        weight = np.exp(-2 * log_scale @ self.pixels)
        places, count = linear.places.shape[1], linear.columns.shape[1]
        later = None if linear.creep is None else linear.creep.later(log_scale @ self.creep_noise)
        scatter = self.noise_of(*self.mechanism.columns("look_scatter_deg"))
        inner = linear.looks.inner(weight[:, None] * np.exp(2 * log_scale @ scatter.T))
        products = linear.at(inner, later)
        variance = linear.constant + np.exp(2 * log_scale) @ linear.by_noise.T
        elimination = Elimination.of(linear.states, np.sqrt(weight[:, None] * variance), products.of_states)
        white = elimination.whitened(products.by_states)
        whole = weight[:, None, None] * (products.gram - np.swapaxes(white, 1, 2) @ white)
        root = self._place_roots(log_scale)
        # Errors at places are in units of their prior sds, since their covariance may be nearly singular.
        whole[:, places:, :places] = np.swapaxes(root.transposed_times(whole[:, :places, places:]), 1, 2)
        whole[:, :places, :places] = root.congruent(whole[:, :places, :places])
        diagonal = np.arange(places)
        whole[:, diagonal, diagonal] += 1.0
        whole[:, places:-1, places:-1] += linear.prior[::-1, ::-1]
        whole[:, -1, places:-1] -= score_at_mode
        whole[:, -1, -1] = FAR_ABOVE
        factor = positive_factor(whole)
        last = count - 1
        leading, shift = factor[:, :last, :last], factor[:, last, places:last]
        return Conditional(weight, inner, elimination, white, root, leading, shift, later)

    @cached_property
    def _score_at_mode(self) -> np.ndarray:
        """Compute the constant part of the score at the mode: that of the likelihood not through the residuals."""
        given = self._conditional(np.zeros((1, self.noise)), np.zeros(len(self.linear.prior)))
        score = np.zeros(len(self.linear.prior))
        for place in self.plays:
            score += self._play_at_mode(place).score * self.root[self.noise + place, self.noise :]
        return given.own[0] @ given.shift[0] - score[::-1]

    def conditional(self, noise: np.ndarray) -> Conditional:
        """Compute the normal density of y at noise coordinates (n, q), with its mean at the mode for the mode's scales.

        That of a backlash is truncated at zero, so its mean differs.
        """
        return self._conditional(noise, self._score_at_mode)

    def _centred(self, noise: np.ndarray, wide: np.ndarray, given: Conditional) -> Centred:
        """Centre the narrow coordinates given noise coordinates (n, q) and y of the wide ones (n, g - k)."""
        mean, linear = given.means(wide[:, ::-1])[:, ::-1], self.linear
        centre, still = mean, self.free[: self.noise][self.creep_noise == 0]
        for _ in range(CENTRINGS):
            y = np.concatenate([noise, wide, centre], axis=1)
            y_own, z = y[:, self.noise :], self.from_whitened(y)
            z[:, still] = self.mode[still]
            beyond = self.residuals(z) - linear.residual + y_own @ linear.along.T
            if linear.creep is not None and given.later is not None:
                places, rows = linear.places.shape[1], linear.creep.rows
                beyond += linear.creep.more(given.later, y_own[:, ::-1] @ rows[:, places:-1].T - rows[:, -1])
            step = given.centring(linear, np.nan_to_num(beyond), self.narrow)[:, ::-1]
            turn = np.eye(self.narrow) + np.tensordot(y_own, self.bend, 1)
            centre = centre + np.linalg.solve(turn, (mean + step - centre)[..., None])[..., 0]
        return Centred(mean, centre, turn)

    def mapped(self, w: np.ndarray) -> Mapped:
        """Map w (n, d) to z with the Jacobian; noise coordinates are the same in w and y."""
        return Mapped.joined([self._mapped(block) for block in np.split(w, range(BLOCK_ROWS, len(w), BLOCK_ROWS))])

    def _mapped(self, w: np.ndarray) -> Mapped:
        noise, y, w = w[:, : self.noise], w.copy(), w.copy()
        rest = w[:, self.noise :]
        given = self.conditional(noise)
        y[:, self.noise :] = given.solved(rest[:, ::-1] + given.shift)[:, ::-1]
        log_jacobian = -np.log(np.diagonal(given.own, axis1=1, axis2=2)).sum(axis=1)
        for place in self.plays:
            cut = Cut(self._bounds(place, given, y[:, self.noise :]))
            within = cut.within(rest[:, place])
            log_jacobian += cut.log_slope(rest[:, place], within)
            rest[:, place] = within
            y[:, self.noise :] = given.solved(rest[:, ::-1] + given.shift)[:, ::-1]
        if self.narrow:
            narrow = self.dimension - self.narrow
            about = self._centred(noise, y[:, self.noise : narrow], given)
            y[:, narrow:] = about.centre + np.linalg.solve(about.turn, (y[:, narrow:] - about.mean)[..., None])[..., 0]
            # A draw without density has no turn: NaN says so.
            with np.errstate(invalid="ignore"):
                log_jacobian -= np.linalg.slogdet(about.turn)[1]
        z = self.from_whitened(y)
        return Mapped(z, log_jacobian + self._log_bend(z))

    def to_w(self, z: np.ndarray) -> np.ndarray:
        """Map z (n, p) to w (n, d), the inverse of `mapped` on the sampled columns."""
        y = self.to_whitened(z)
        noise, narrow = y[:, : self.noise], self.dimension - self.narrow
        given = self.conditional(noise)
        if self.narrow:
            about = self._centred(noise, y[:, self.noise : narrow], given)
            y[:, narrow:] = about.mean + np.einsum("nij,nj->ni", about.turn, y[:, narrow:] - about.centre)
        rest = (np.einsum("nij,ni->nj", given.own, y[:, self.noise :][:, ::-1]) - given.shift)[:, ::-1].copy()
        for place in self.plays:
            rest[:, place] = Cut(self._bounds(place, given, y[:, self.noise :])).without(rest[:, place])
        return np.concatenate([noise, rest], axis=1)


def curvatures(path: Transport) -> np.ndarray:
    """Compute Gauss-Newton steps of the residuals' second differences along all pairs of coordinates, shape (g, g, g).

    The second difference along two coordinates is a residual. Its Gauss-Newton step is the shift of the optimum of all
    coordinates, per product of the two.
    """
    count, whole = len(path.linear.prior), np.zeros((1, path.noise))
    steps = BEND_STEP * np.eye(count)
    # A play is linear in degrees, and cannot be negative.
    steps[list(path.plays)] = 0.0

    def curvature(y: np.ndarray) -> np.ndarray:
        both = np.concatenate([np.zeros((1, count)), y, -y])
        misfit = path.residuals(path.from_whitened(np.concatenate([np.repeat(whole, len(both), axis=0), both], axis=1)))
        centre, ahead, behind = np.split(np.nan_to_num(misfit), [1, 1 + len(y)])
        return (ahead + behind - 2 * centre) / BEND_STEP**2

    bend, given = curvature(steps), path.conditional(whole)
    moved = np.empty((count, count, count))
    for one in range(count):
        mixed = 0.5 * (curvature(steps[one:] + steps[one]) - bend[one:] - bend[one])
        moved[one, one:] = given.centring(path.linear, -mixed, count)[:, ::-1]
        moved[one:, one] = moved[one, one:]
    return moved


def centred_count(moved: np.ndarray) -> int:
    """Choose the number of last coordinates to centre at every draw, so that the least remains of `curvatures`.

    Centring removes the effect of the others on a coordinate, alone or in a product with it. Effects of centred
    coordinates on each other remain, and so do all on wide ones. A coordinate along which the ridge of narrower ones is
    curved is therefore better wide, however well it is determined: the others are then centred given it.

    Args:
        moved: from `curvatures`, shape (g, g, g).

    Returns:
        The number with the least sum of remaining variances, in posterior variances.
    """
    count = len(moved)
    # A product of two standard normal numbers has the variance 1, half a square 1/2.
    pairs = np.triu(np.ones((count, count)), 1) + 0.5 * np.eye(count)
    variance = pairs[..., None] * moved**2
    left = [variance[..., :wide].sum() + variance[wide:, wide:, wide:].sum() for wide in range(count, -1, -1)]
    return int(np.argmin(left))


@dataclass(frozen=True)
class Walks:
    """Drifts of the zeros as terms of unit prior variance.

    Attributes:
        columns: d(predicted)/d(term) of a drift of 1 rad h^(-1/2), shape (4 n, terms).
        axis: as `drift_axis` in `Transport`.
    """

    columns: np.ndarray
    axis: np.ndarray


def walks(fit: JointFit, stops: StopStates) -> Walks:
    """Build the terms of estimated drifts, separately after every homing.

    A random walk is the sum of its steps from look to look. After rotation to the eigenvectors of the spots'
    information, with stop errors eliminated, few terms are needed.
    """
    slope = np.asarray(fit.linearised.slope)
    spots = jax.tree.map(lambda x: np.asarray(x)[: len(slope)], fit.arrays.spots)
    sd = np.sqrt(stops.variance.sum(axis=1) + stops.constant)[None]
    of_stops = Elimination.of(stops, sd, stops.gram[stops.overlapping][None])
    drifts = fit.space.mechanism.columns("drift_deg_per_root_hour")
    above = fit.z[drifts] + np.sqrt(np.diag(fit.covariance)[drifts])
    scale = np.radians(half_normal(above) * np.asarray(fit.space.u)[drifts])
    columns, axes = [np.empty((slope.size // 2, 0))], [np.empty((0, 2))]
    for axis in np.flatnonzero(fit.free[drifts]):
        begins = np.flatnonzero(spots.new_zero[:, axis])
        for begin, end in zip(begins, [*begins[1:], len(slope)], strict=True):
            hours = np.cumsum(spots.hours[begin:end, axis])
            knots = np.unique([0.0, *hours])
            knots = knots[np.linspace(0, len(knots) - 1, min(len(knots), WALK_STEPS + 1)).round().astype(int)]
            steps = np.diff(knots)
            walked = np.sqrt(steps) * np.clip((hours[:, None] - knots[:-1]) / steps, 0, 1)
            column = np.zeros((*slope.shape[:2], len(steps)))
            column[begin:end] = slope[begin:end, :, axis, None] * walked[:, None]
            flat = column.reshape(-1, len(steps))
            by_stops = of_stops.whitened(stops.load.T @ flat)[0]
            information, turn = np.linalg.eigh(flat.T @ flat - by_stops.T @ by_stops)
            columns.append(flat @ turn[:, scale[axis] ** 2 * information > WALK_INFORMATION])
            axes.append(np.tile(np.arange(2) == axis, (columns[-1].shape[1], 1)))
    return Walks(np.concatenate(columns, axis=1), np.concatenate(axes))


def creep(fit: JointFit, by_y: np.ndarray, errors: int, looks: LookNoise) -> Creep | None:
    """Build the creep of the zeros where its time constant is estimated, else None.

    Args:
        fit: converged.
        by_y: d(z)/dy of the total creep of each zero, shape (2, g).
        errors: number of columns of errors at places and drifts, before those of y.
        looks: noise of all looks.
    """
    minutes, creeps = fit.space.mechanism.index["creep_minutes"], fit.space.mechanism.columns("creep_deg")
    if not fit.free[minutes]:
        return None
    physical, moves = np.asarray(fit.mode.physical), np.asarray(fit.arrays.spots.move_index)[: len(looks.load)]
    unit_rad = np.radians(np.asarray(fit.space.u)[creeps])
    at_mode = -np.radians(physical[creeps])
    rows = np.column_stack([np.zeros((2, errors)), unit_rad[:, None] * by_y[:, ::-1], at_mode])
    rows /= looks.unit_rad[:, None]
    return Creep(np.asarray(fit.arrays.moves.warm_minutes)[moves], float(physical[minutes]), looks, rows)


def look_noise(fit: JointFit) -> LookNoise:
    """Build the noise of a fit's looks, up to a scatter that its prior allows."""
    columns = fit.space.mechanism.columns("look_scatter_deg")
    slope, held = np.asarray(fit.linearised.slope), ~fit.free[columns]
    variance_rad2 = np.radians(np.asarray(fit.mode.physical)[columns]) ** 2
    at = np.where(held, FAR_SD, fit.z[columns])
    most = FAR_PIXELS * (half_normal(np.array(FAR_SD)) / half_normal(at)) ** 2
    return LookNoise.of(slope, np.asarray(fit.arrays.spots.weight)[: len(slope)], variance_rad2, most)


def transport(fit: JointFit) -> Transport:
    """Build the map at the mode of a converged fit."""
    by_noise = np.isin(fit.names, SCALE_NAMES)
    others = np.flatnonzero(fit.free & ~by_noise)
    covariance = np.linalg.inv(np.eye(len(others)) + fit.information.fisher[np.ix_(others, others)])
    order = by_width(covariance)
    straight = uncentred(fit, others[order], np.linalg.cholesky(covariance[np.ix_(order, order)]))
    moved = curvatures(straight)
    plain = np.setdiff1d(np.arange(len(others)), straight.plays)
    narrow = centred_count(moved[np.ix_(plain, plain, plain)])
    # A play is never centred, as it is linear in degrees.
    last = plain[len(plain) - narrow :]
    turned = np.concatenate([np.setdiff1d(np.arange(len(others)), last), last])
    order = order[turned]
    path = uncentred(fit, others[order], np.linalg.cholesky(covariance[np.ix_(order, order)]))
    beside_noise, wide = slice(path.noise, None), len(others) - narrow
    before = np.linalg.solve(
        straight.root[beside_noise, beside_noise], path.root[beside_noise, beside_noise][np.argsort(turned)]
    )
    after = np.linalg.inv(before)[wide:]
    bend = np.einsum("abc,ai,bp,kc->ikp", moved, before, before[:, wide:], after, optimize=True)
    return replace(path, narrow=narrow, bend=bend)


def transport_beside(fit: JointFit, path: Transport) -> Transport:
    """Build the map of another homing hypothesis, with order, centring and curvature of a known map.

    A proposal fitted in w there is valid here, and no second differences are needed.
    """
    others = path.free[path.noise :]
    covariance = np.linalg.inv(np.eye(len(others)) + fit.information.fisher[np.ix_(others, others)])
    return replace(uncentred(fit, others, np.linalg.cholesky(covariance)), narrow=path.narrow, bend=path.bend)


def uncentred(fit: JointFit, others: np.ndarray, wide: np.ndarray) -> Transport:
    """Build the map at the mode of a converged fit, with no coordinate centred.

    Args:
        fit: converged.
        others: sampled coordinates of z except noise scales, in the order of y, shape (g,).
        wide: lower triangular factor of their covariance, shape (g, g).
    """
    linear = linear_spots(fit.linearised, fit.arrays, -np.asarray(fit.linearised.residual_jacobian))
    mechanism, physical = fit.space.mechanism, np.asarray(fit.mode.physical)
    names = np.array(fit.names)
    free = np.flatnonzero(fit.free)
    scales = np.isin(names[free], SCALE_NAMES)
    # The scatter of looks comes first: given it, the other scales are nearly independent.
    noise = free[scales]
    noise = noise[np.argsort(~np.isin(names[noise], names_of("look_scatter_deg")), kind="stable")]
    of_noise = np.linalg.cholesky(fit.covariance[np.ix_(noise, noise)])
    stops, looks = stop_states(fit, linear), look_noise(fit)
    drifts = walks(fit, stops)
    by_noise = np.append(mechanism.stop_columns, mechanism.columns("home_sd_deg"))[:, None] == noise
    gears = fit.arrays.gears.without_padding()
    columns = np.asarray(fit.linearised.place_columns).reshape(linear.residual.size, gears.columns)
    half = np.asarray(fit.space.kind)[noise] == KINDS.index("half-normal")
    ratio = np.radians(physical[RATIO_COLUMNS])
    creeps = others == mechanism.columns("creep_deg")[:, None]
    spots = len(linear.residual)

    def misfit(z: np.ndarray) -> np.ndarray:
        return in_batches(lambda at: residuals(at, fit.space, fit.arrays), z).reshape(len(z), -1)

    precision = np.ones(len(others))
    for place in np.flatnonzero(np.isin(names[others], BLOCKS["backlash_deg"])):
        precision[place] = HalfNormal(float(fit.z[others[place]])).precision
    return Transport(
        mechanism=mechanism,
        mode=fit.z,
        physical=physical,
        free=np.concatenate([noise, others]),
        root=linalg.block_diag(of_noise, wide),
        noise=len(noise),
        narrow=0,
        slope=np.where(half, 1.0, np.asarray(fit.space.u)[noise])[:, None] * of_noise,
        half=half,
        linear=LinearCampaign(
            residual=linear.residual.ravel(),
            along=(linear.jacobian[..., others] @ wide).reshape(4 * spots, -1),
            states=stops,
            by_noise=stops.variance @ by_noise,
            # Stops and homings whose sd is not estimated keep their variance.
            constant=stops.constant + stops.variance @ ~by_noise.any(axis=1),
            places=np.column_stack([columns, drifts.columns]),
            prior=(wide.T * precision) @ wide,
            looks=looks,
            creep=creep(fit, creeps @ wide, gears.columns + len(drifts.axis), looks),
        ),
        residuals=misfit,
        bend=np.zeros((len(others), 0, 0)),
        angle_rad=np.asarray(gears.places.steps)[gears.place] * ratio[np.asarray(gears.on_tilt).astype(int)],
        on_tilt=np.asarray(gears.on_tilt),
        of_play=gears.of_play,
        drift_axis=drifts.axis,
        period_deg=np.asarray(fit.space.harmonic_period_deg),
    )
