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
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

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
from tvsbayes.model.parameter_space import FARTHEST_SD, half_normal
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
FAR_SD, FAR_PIXELS = 4.0, 4.0
"""Limits of the map for the scatter of looks: sds of its prior, and pixel variance at the mode over that of a draw."""
BLOCK_ROWS = 64
"""Points mapped together: their matrices fit into the processor's cache."""
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


class Mapped(NamedTuple):
    """Points z (n, p) and ln |dy/dw| there (n,)."""

    z: np.ndarray
    log_jacobian: np.ndarray


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
    """

    mechanism: Mechanism
    mode: np.ndarray
    free: np.ndarray
    root: np.ndarray
    noise: int
    narrow: int
    slope: np.ndarray
    half: np.ndarray
    linear: LinearCampaign
    residuals: Residuals
    bend: np.ndarray

    @property
    def dimension(self) -> int:
        """Return the number of sampled coordinates."""
        return len(self.free)

    @cached_property
    def names(self) -> np.ndarray:
        """Return the names of the sampled coordinates, shape (d,)."""
        return np.array(self.mechanism.names)[self.free]

    @property
    def heavy(self) -> np.ndarray:
        """Mark the coordinates of `HEAVY_NAMES`, shape (d,)."""
        return np.isin(self.names, (*HEAVY_NAMES, self.mechanism.optics_names[0]))

    @property
    def coupled(self) -> np.ndarray:
        """Mark the coordinates of the optics, shape (d,).

        They are wide: where several of them are far out together, the proposal fits the target badly.
        """
        return np.isin(self.names, self.mechanism.optics_names)

    @property
    def wide(self) -> int:
        """Return the number of coordinates that are neither noise nor centred."""
        return self.dimension - self.noise - self.narrow

    @cached_property
    def plays(self) -> dict[int, HalfNormal]:
        """Return the backlashes that are not narrow, by their positions in y without noise coordinates."""
        of_play = np.isin(self.names[self.noise :][: self.wide], BLOCKS["backlash_deg"])
        return {k: HalfNormal(float(self.mode[self.free[self.noise + k]])) for k in np.flatnonzero(of_play).tolist()}

    def from_whitened(self, y: np.ndarray) -> np.ndarray:
        """Map y (n, d) to z (n, p): linear, except for a backlash, whose degrees are linear and never negative."""
        step = y @ self.root.T
        for place, play in self.plays.items():
            step[:, self.noise + place] = play.bent(step[:, self.noise + place])
        z = np.repeat(self.mode[None], len(y), axis=0)
        z[:, self.free] += step
        return z

    def to_whitened(self, z: np.ndarray) -> np.ndarray:
        """Map z (n, p) to y (n, d)."""
        step = (z - self.mode)[:, self.free]
        for place, play in self.plays.items():
            step[:, self.noise + place] = play.straight(step[:, self.noise + place])
        return np.linalg.solve(self.root, step.T).T

    def _log_scale(self, noise: np.ndarray) -> np.ndarray:
        """Compute ln of the noise scales over those at the mode, at noise coordinates (n, q)."""
        step = noise @ self.slope.T
        at = self.mode[self.free[: self.noise]]
        z = np.minimum(np.where(self.half, at + step, 0.0), FARTHEST_SD)
        ratio = half_normal(z) / half_normal(np.where(self.half, at, 0.0))
        return np.where(self.half, np.log(np.maximum(ratio, LEAST_SCALE)), step)

    @cached_property
    def _score_at_mode(self) -> np.ndarray:
        """Compute the constant part of the score at the mode: that of the likelihood not through the residuals."""
        given = self.linear.conditional(self._log_scale(np.zeros((1, self.noise))), np.zeros(len(self.linear.prior)))
        score = np.zeros(len(self.linear.prior))
        for place, play in self.plays.items():
            score += play.score * self.root[self.noise + place, self.noise :]
        return given.own[0] @ given.shift[0] - score[::-1]

    def conditional(self, noise: np.ndarray) -> Conditional:
        """Compute the normal density of y at noise coordinates (n, q), with its mean at the mode for the mode's scales.

        That of a backlash is truncated at zero, so its mean differs.
        """
        return self.linear.conditional(self._log_scale(noise), self._score_at_mode)

    def _cut(self, place: int, given: Conditional, y: np.ndarray) -> Cut:
        """Truncate a backlash at zero in its standard normal coordinate, given the wider ones of y (n, g)."""
        row = self.root[self.noise + place, self.noise :]
        least = (self.plays[place].least - y[:, :place] @ row[:place]) / row[place]
        return Cut(given.standard(np.column_stack([y[:, :place], least]))[:, -1])

    @cached_property
    def _still(self) -> np.ndarray:
        """Return the columns of noise scales that move no spot: all but the time constant of a creep."""
        return self.free[: self.noise][~np.isin(self.names[: self.noise], BLOCKS["creep_minutes"])]

    def _centred(self, noise: np.ndarray, wide: np.ndarray, given: Conditional) -> tuple[np.ndarray, ...]:
        """Centre the narrow coordinates given noise coordinates (n, q) and y of the wide ones (n, g - k).

        Returns:
            Their linear mean (n, k), a Gauss-Newton step from it (n, k), and `turn` (n, k, k): in the map they are
            mean + turn^-1 (linear y - mean + step). A second step does not improve the weights.
        """
        mean = given.means(wide)
        y = np.concatenate([wide, mean], axis=1)
        z = self.from_whitened(np.concatenate([noise, y], axis=1))
        z[:, self._still] = self.mode[self._still]
        step = given.centring(given.misfit(self.residuals(z), y), self.narrow)
        return mean, step, np.eye(self.narrow) + np.tensordot(y, self.bend, 1)

    def mapped(self, w: np.ndarray) -> Mapped:
        """Map w (n, d) to z with the Jacobian; noise coordinates are the same in w and y."""
        blocks = [self._mapped(block) for block in np.split(w, range(BLOCK_ROWS, len(w), BLOCK_ROWS))]
        return Mapped(*(np.concatenate(parts) for parts in zip(*blocks, strict=True)))

    def _mapped(self, w: np.ndarray) -> Mapped:
        noise, rest = w[:, : self.noise], w[:, self.noise :].copy()
        given = self.conditional(noise)
        y = given.located(rest)
        log_jacobian = -np.log(np.diagonal(given.own, axis1=1, axis2=2)).sum(axis=1)
        for place in self.plays:
            cut, free = self._cut(place, given, y), rest[:, place].copy()
            rest[:, place] = cut.within(free)
            log_jacobian += cut.log_slope(free, rest[:, place])
            y = given.located(rest)
        if self.narrow:
            mean, step, turn = self._centred(noise, y[:, : self.wide], given)
            away = y[:, self.wide :] - mean + step
            y = np.concatenate([y[:, : self.wide], mean + np.linalg.solve(turn, away[..., None])[..., 0]], axis=1)
            # A draw without density has no turn: NaN says so.
            with np.errstate(invalid="ignore"):
                log_jacobian -= np.linalg.slogdet(turn)[1]
        z = self.from_whitened(np.concatenate([noise, y], axis=1))
        for place, play in self.plays.items():
            log_jacobian += play.log_bend(z[:, self.free[self.noise + place]])
        return Mapped(z, log_jacobian)

    def to_w(self, z: np.ndarray) -> np.ndarray:
        """Map z (n, p) to w (n, d), the inverse of `mapped` on the sampled columns."""
        noise, y = np.split(self.to_whitened(z), [self.noise], axis=1)
        given = self.conditional(noise)
        if self.narrow:
            mean, step, turn = self._centred(noise, y[:, : self.wide], given)
            y[:, self.wide :] = mean + np.einsum("nij,nj->ni", turn, y[:, self.wide :] - mean) - step
        rest = given.standard(y).copy()
        for place in self.plays:
            rest[:, place] = self._cut(place, given, y).without(rest[:, place])
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
        moved[one, one:] = given.centring(-mixed, count)
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


def walks(fit: JointFit, stops: StopStates) -> tuple[np.ndarray, np.ndarray]:
    """Build estimated drifts of the zeros as terms of unit prior variance, separately after every homing.

    A random walk is the sum of its steps from look to look. After rotation to the eigenvectors of the spots'
    information, with stop errors eliminated, few terms are needed.

    Returns:
        d(predicted)/d(term) of a drift of 1 rad h^(-1/2), shape (4 n, terms); 1 at the axis (pan, tilt) whose drift is
        the sd of each term, shape (terms, 2).
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
    return np.concatenate(columns, axis=1), np.concatenate(axes)


def creep(fit: JointFit, by_y: np.ndarray, errors: int, looks: LookNoise, noise: np.ndarray) -> Creep | None:
    """Build the creep of the zeros where its time constant is estimated, else None.

    Args:
        fit: converged.
        by_y: d(z)/dy of the total creep of each zero, shape (2, g).
        errors: number of columns of errors at places and drifts, before those of y.
        looks: noise of all looks.
        noise: columns of z of the noise scales, shape (q,).
    """
    column, creeps = fit.space.mechanism.index["creep_minutes"], fit.space.mechanism.columns("creep_deg")
    if not fit.free[column]:
        return None
    physical, moves = np.asarray(fit.mode.physical), np.asarray(fit.arrays.spots.move_index)[: len(looks.load)]
    unit_rad = np.radians(np.asarray(fit.space.u)[creeps])
    rows = [np.zeros((2, errors)), unit_rad[:, None] * by_y[:, ::-1], -np.radians(physical[creeps])]
    warm, minutes = np.asarray(fit.arrays.moves.warm_minutes)[moves], float(physical[column])
    return Creep(warm, minutes, at_columns([column], noise)[0], looks, np.column_stack(rows) / looks.unit_rad[:, None])


def at_columns(columns: Sequence[int] | np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Mark with 1 the noise coordinate that is each of some columns (k,) of z, shape (k, q)."""
    return (np.asarray(columns)[:, None] == noise).astype(float)


def place_roots(fit: JointFit, noise: np.ndarray, drift_axis: np.ndarray) -> Callable[[np.ndarray], BlockRoot]:
    """Build `LinearCampaign.place_root` of errors at places, then of the terms of the drifts (`walks`)."""
    physical, gears = np.asarray(fit.mode.physical), fit.arrays.gears.without_padding()
    on_tilt, period_deg = np.asarray(gears.on_tilt), np.asarray(fit.space.harmonic_period_deg)
    angle_rad = np.asarray(gears.places.steps)[gears.place] * np.radians(physical[RATIO_COLUMNS])[on_tilt.astype(int)]
    mechanism = fit.space.mechanism
    scales, drifts = mechanism.columns(*GEAR_SCALES), mechanism.columns("drift_deg_per_root_hour")
    of_scales, of_drifts = at_columns(scales, noise), at_columns(drifts, noise)

    def root(log_scale: np.ndarray) -> BlockRoot:
        values = np.zeros((len(log_scale), len(physical)))
        values[:, scales] = physical[scales] * np.exp(log_scale @ of_scales.T)
        errors = column_blocks(scales_at(values, period_deg, mechanism), angle_rad, on_tilt, gears.of_play)
        drift = np.radians(physical[drifts]) * np.exp(log_scale @ of_drifts.T)
        return BlockRoot((*errors.blocks, (drift @ drift_axis.T)[..., None] * np.eye(len(drift_axis))))

    return root


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
    others = np.flatnonzero(fit.free & ~np.isin(fit.names, SCALE_NAMES))
    covariance = _covariance(fit, others)
    order = by_width(covariance)
    straight = uncentred(fit, others[order], covariance[np.ix_(order, order)])
    moved = curvatures(straight)
    plain = np.setdiff1d(np.arange(len(others)), list(straight.plays))
    narrow = centred_count(moved[np.ix_(plain, plain, plain)])
    # A play is never centred, as it is linear in degrees.
    last = plain[len(plain) - narrow :]
    turned = np.concatenate([np.setdiff1d(np.arange(len(others)), last), last])
    order = order[turned]
    path = uncentred(fit, others[order], covariance[np.ix_(order, order)])
    old, new = (each.root[each.noise :, each.noise :] for each in (straight, path))
    before = np.linalg.solve(old, new[np.argsort(turned)])
    after, wide = np.linalg.inv(before), len(others) - narrow
    bend = np.einsum("abc,ai,bp,kc->ikp", moved, before, before[:, wide:], after[wide:], optimize=True)
    return replace(path, narrow=narrow, bend=bend)


def transport_beside(fit: JointFit, path: Transport) -> Transport:
    """Build the map of another homing hypothesis, with order, centring and curvature of a known map.

    A proposal fitted in w there is valid here, and no second differences are needed.
    """
    others = path.free[path.noise :]
    return replace(uncentred(fit, others, _covariance(fit, others)), narrow=path.narrow, bend=path.bend)


def _covariance(fit: JointFit, others: np.ndarray) -> np.ndarray:
    """Compute the Laplace covariance of some coordinates of z at the mode's scales."""
    return np.linalg.inv(np.eye(len(others)) + fit.information.fisher[np.ix_(others, others)])


def uncentred(fit: JointFit, others: np.ndarray, covariance: np.ndarray) -> Transport:
    """Build the map at the mode of a converged fit, with no coordinate centred.

    Args:
        fit: converged.
        others: sampled coordinates of z except noise scales, in the order of y, shape (g,).
        covariance: of these, shape (g, g).
    """
    wide = np.linalg.cholesky(covariance)
    linear = linear_spots(fit.linearised, fit.arrays, -np.asarray(fit.linearised.residual_jacobian))
    mechanism, names, free = fit.space.mechanism, np.array(fit.names), np.flatnonzero(fit.free)
    noise = free[np.isin(names[free], SCALE_NAMES)]
    # The scatter of looks comes first: given it, the other scales are nearly independent.
    noise = noise[np.argsort(~np.isin(names[noise], names_of("look_scatter_deg")), kind="stable")]
    of_noise = np.linalg.cholesky(fit.covariance[np.ix_(noise, noise)])
    stops, looks = stop_states(fit, linear), look_noise(fit)
    drifts, drift_axis = walks(fit, stops)
    by_noise = np.append(mechanism.stop_columns, mechanism.columns("home_sd_deg"))[:, None] == noise
    errors = fit.arrays.gears.without_padding().columns
    columns = np.asarray(fit.linearised.place_columns).reshape(linear.residual.size, errors)
    creeps = others == mechanism.columns("creep_deg")[:, None]
    half = np.asarray(fit.space.kind)[noise] == KINDS.index("half-normal")

    def misfit(z: np.ndarray) -> np.ndarray:
        return in_batches(lambda at: residuals(at, fit.space, fit.arrays), z).reshape(len(z), -1)

    precision = np.ones(len(others))
    for place in np.flatnonzero(np.isin(names[others], BLOCKS["backlash_deg"])):
        precision[place] = HalfNormal(float(fit.z[others[place]])).precision
    return Transport(
        mechanism=mechanism,
        mode=fit.z,
        free=np.concatenate([noise, others]),
        root=linalg.block_diag(of_noise, wide),
        noise=len(noise),
        narrow=0,
        slope=np.where(half, 1.0, np.asarray(fit.space.u)[noise])[:, None] * of_noise,
        half=half,
        linear=LinearCampaign(
            residual=linear.residual.ravel(),
            along=(linear.jacobian[..., others] @ wide).reshape(linear.residual.size, len(others)),
            states=stops,
            by_noise=stops.variance @ by_noise,
            # Stops and homings whose sd is not estimated keep their variance.
            constant=stops.constant + stops.variance @ ~by_noise.any(axis=1),
            places=np.column_stack([columns, drifts]),
            place_root=place_roots(fit, noise, drift_axis),
            prior=(wide.T * precision) @ wide,
            looks=looks,
            pixels=at_columns(mechanism.columns("pixel_scale"), noise)[0],
            scatter=at_columns(mechanism.columns("look_scatter_deg"), noise),
            creep=creep(fit, creeps @ wide, errors + drifts.shape[1], looks, noise),
        ),
        residuals=misfit,
        bend=np.zeros((len(others), 0, 0)),
    )
