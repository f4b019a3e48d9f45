"""The map that makes the posterior nearly normal, so that proposals need no knowledge of its ridges.

Three layers: z, the prior-normal coordinates of the model; y, whitened by the Laplace covariance; w, in which walkers
live. Wide directions (laser tilt, mirror errors) bend the ridges on which the narrow ones (extrinsics, ratios) lie: a
shear moves each narrow coordinate by a quadratic form of the wider ones. Noise scales widen and turn what they limit (a
stop sd its ratio, the backlash and their sums): in w everything else is measured from the mean and by the covariance
that the linearised campaign has at the noise scales of the walker. NumPy outside the compiled density.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
from scipy.linalg import lapack

from tvsbayes.instrument.parameters import BLOCKS, INDEX, NAMES, NOISE_NAMES, OPTICS_NAMES, names_of
from tvsbayes.model.gear_kriging import scales_at
from tvsbayes.model.gear_processes import place_root
from tvsbayes.model.parameter_space import FARTHEST_SD, half_normal, half_normal_slope

GEAR_SCALES = np.array(
    [
        INDEX[name]
        for name in names_of(
            *("transmission_error_deg", "transmission_error_length_deg", "play_variation_deg", "harmonic_amplitude_deg")
        )
    ]
)
"""Coordinates of what the covariance of the errors at places depends on."""
LEAST_SCALE = 1e-6
"""Of a noise scale over that at the mode: what is smaller moves nothing."""
FAR_ABOVE = 1e200
"""A last diagonal element that keeps a matrix positive definite whatever stands in its row; nothing reads its root."""
BLOCK_ROWS = 256
"""Points that are mapped at a time: their matrices take 64 MB at most."""
STRETCH_NODES = (-2.0, 0.0, 2.0, 4.0, 6.0)
"""Of the table of widths, evenly spaced, in w of a noise coordinate. Below the first nothing gets narrower: other stops
limit it then."""
HEAVY_NAMES = (*NOISE_NAMES, *BLOCKS["backlash_deg"], "extrinsics.rotation_rad.y", "mirror_offset_mm")
"""Coordinates whose tails are heavier than normal: those that few stops tell (a walker stood still for 155 steps at 3.7
sd of a stop sd), and the tilt of the frames with the mirrors' offset, along whose ridge a quadratic shear falls short
(one stood at 7.7 sd). Each of them is always proposed from a t of its own."""


@dataclass(frozen=True)
class Conditional:
    """Geometry and cameras at given noise scales: w = factor' y - shift is standard normal.

    The factor (n, g, g) of the precision of y is lower triangular; shift (n, g) = factor' x the mean of y.
    """

    factor: np.ndarray
    shift: np.ndarray

    def solved(self, right: np.ndarray) -> np.ndarray:
        """Back substitution for y in factor' y = right, shape (n, g): NumPy's solver would factorise anew."""
        pairs = zip(self.factor, right, strict=True)
        return np.array([lapack.dtrtrs(factor.T, each)[0] for factor, each in pairs]).reshape(right.shape)


@dataclass(frozen=True)
class Mapped:
    """Points z (n, p) and ln |dy/dw| there (n,)."""

    z: np.ndarray
    log_jacobian: np.ndarray

    @classmethod
    def joined(cls, parts: Sequence[Mapped]) -> Mapped:
        """One after the other."""
        return cls(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)))


@dataclass(frozen=True)
class Transport:
    """The map w -> z; its Jacobian is |det root| exp(`Mapped.log_jacobian`).

    With stop errors e of variance S, errors at places of covariance K and pixels in units of their noise, the
    linearised residuals are r - J y - G e: the precision of y is then prior + J'J - J'G ((S, K)^-1 + G'G)^-1 G'J
    (Woodbury), at any noise scales from the same products. Beyond `ridges.STATES_MAX` stop errors (m = 0 here) those
    stay in the covariance by which the products are taken, and widths alone follow their scales, from a table.

    Attributes:
        mode: z at w = 0, shape (p,).
        free: columns of z that are sampled, (d,): widest conditional sd first; with states, noise coordinates before
            all others.
        root: lower-triangular factor of their covariance in that order, shape (d, d); with states, of noise
            coordinates and others apart, whose mean at other scales follows from r.
        noise: places in `free` of the noise coordinates, shape (q,).
        narrow: places in `free` that the shear moves, ascending, shape (k,).
        bend: its quadratic forms, nonzero only among places before the narrow one, shape (k, d, d).
        stretch: if m is 0, log of the factor on every place at `STRETCH_NODES` of each noise coordinate, (q, nodes, d).
        slope: ln of the noise scales over those at the mode, by w of the noise coordinates, shape (q, q); of
            half-normal scales, whose logarithm is no linear function, the step of z instead.
        half: which noise scales are half-normal, shape (q,).
        pixels: 1 at the noise coordinate that scales all pixels, shape (q,).
        variance: of every stop error at the mode, by the noise coordinate that scales it, shape (m, q).
        constant: what scales with none, shape (m,).
        prior: precision of y of the g other coordinates without data, shape (g, g).
        known: J'J, what the data add if no stop errs, shape (g, g).
        load: J'G, shape (g, m + e), the errors at places last.
        states: G'G, shape (m + e, m + e).
        score, state_score: J'r, shape (g,), and G'r, shape (m + e,).
        place_angle_rad, place_on_tilt, place_valid: of the e / 2 places, as `gear_processes.place_root` takes them.
        gear_scale: values of `GEAR_SCALES` at the mode, in the units of their names, shape (12,).
        gear_noise: which noise coordinate each of them is, shape (12, q).
        period_deg: of the gears, shape (2, 3).
    """

    mode: np.ndarray
    free: np.ndarray
    root: np.ndarray
    noise: np.ndarray
    narrow: np.ndarray
    bend: np.ndarray
    stretch: np.ndarray
    slope: np.ndarray
    half: np.ndarray
    pixels: np.ndarray
    variance: np.ndarray
    constant: np.ndarray
    prior: np.ndarray
    known: np.ndarray
    load: np.ndarray
    states: np.ndarray
    score: np.ndarray
    state_score: np.ndarray
    place_angle_rad: np.ndarray
    place_on_tilt: np.ndarray
    place_valid: np.ndarray
    gear_scale: np.ndarray
    gear_noise: np.ndarray
    period_deg: np.ndarray

    @property
    def dimension(self) -> int:
        """Number of sampled coordinates."""
        return len(self.free)

    @property
    def geometry(self) -> np.ndarray:
        """Places in `free` of all coordinates but those of noise, ascending."""
        return np.setdiff1d(np.arange(self.dimension), self.noise)

    @property
    def heavy(self) -> np.ndarray:
        """Coordinates of `HEAVY_NAMES`, shape (d,)."""
        return np.isin(np.array(NAMES)[self.free], HEAVY_NAMES)

    @property
    def coupled(self) -> np.ndarray:
        """Coordinates of what bends the beam's way through the positioner, shape (d,).

        They are wide, and coupled to third order, which the quadratic shear does not follow: where several of them
        are far out together the target lies beside the proposal.
        """
        return np.isin(np.array(NAMES)[self.free], OPTICS_NAMES)

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Leader and follower of scales that explain the same scatter: play's variation, then transmission error."""
        names = [NAMES[column] for column in self.free]
        wanted = zip(names_of("play_variation_deg"), names_of("transmission_error_deg"), strict=True)
        return [(names.index(one), names.index(other)) for one, other in wanted if {one, other} <= set(names)]

    def straight(self) -> Transport:
        """The same without shear, and with the covariance of the mode everywhere: the Laplace approximation."""
        return replace(
            self,
            narrow=self.narrow[:0],
            bend=self.bend[:0],
            stretch=np.zeros_like(self.stretch),
            variance=self.variance[:0],
            constant=self.constant[:0],
            load=self.load[:, :0],
            states=self.states[:0, :0],
            state_score=self.state_score[:0],
            place_angle_rad=self.place_angle_rad[:0],
            place_on_tilt=self.place_on_tilt[:0],
            place_valid=self.place_valid[:0],
        )

    @cached_property
    def curved(self) -> np.ndarray:
        """Places in `free` of coordinates whose physical value is no linear function of z over a posterior's width."""
        return np.flatnonzero(np.isin(np.array(NAMES)[self.free], BLOCKS["backlash_deg"]))

    def _beyond_linear(self, place: int, step: np.ndarray) -> np.ndarray:
        """What steps of the z at a place (n,) move its physical value beyond the line at the mode, in units of z."""
        at = self.mode[self.free[place]]
        # Where no value is distinguished any more, the line goes on.
        near = np.clip(at + step, -FARTHEST_SD, FARTHEST_SD) - at
        return (half_normal(at + near) - half_normal(at)) / half_normal_slope(at) - near

    def _follow(self, place: int) -> np.ndarray:
        """How far the places behind one follow a unit step of its z, shape (d - place - 1,)."""
        return self.root[place + 1 :, place] / self.root[place, place]

    def from_whitened(self, y: np.ndarray) -> np.ndarray:
        """From y (n, d) to z (n, p).

        What follows a backlash follows its degrees, not its z: along a ridge as wide as the prior the line in z is
        wrong by more than a ratio's width. Each place moves later ones only: no volume changes.
        """
        step = y @ self.root.T
        for place in self.curved:
            step[:, place + 1 :] += self._beyond_linear(place, step[:, place])[:, None] * self._follow(place)
        z = np.repeat(self.mode[None], len(y), axis=0)
        z[:, self.free] += step
        return z

    def _log_scale(self, noise: np.ndarray) -> np.ndarray:
        """Ln of the noise scales over those at the mode, at noise coordinates (n, q)."""
        step = noise @ self.slope.T
        at = self.mode[self.free[self.noise]]
        z = np.minimum(np.where(self.half, at + step, 0.0), FARTHEST_SD)
        ratio = half_normal(z) / half_normal(np.where(self.half, at, 0.0))
        return np.where(self.half, np.log(np.maximum(ratio, LEAST_SCALE)), step)

    def _place_roots(self, log_scale: np.ndarray) -> np.ndarray:
        """Factors of the covariance of the errors at places, shape (n, e, e), at logs of the noise scales (n, q)."""
        values = np.zeros((len(log_scale), len(NAMES)))
        values[:, GEAR_SCALES] = self.gear_scale * np.exp(log_scale @ self.gear_noise.T)
        scales = scales_at(values, self.period_deg)
        return np.asarray(place_root(scales, self.place_angle_rad, self.place_on_tilt, self.place_valid, np))

    def _conditional(self, noise: np.ndarray, score_at_mode: np.ndarray) -> Conditional:
        """What the linearised campaign and the prior say of y at noise coordinates (n, q), slopes from one at the mode.

        One factor of the precision of states and y together, with the slope as a last row: its parts of y are the
        factor and the forward solution that are wanted, the states integrated out (Schur complement).
        """
        log_scale = self._log_scale(noise)
        weight = np.exp(-2 * log_scale @ self.pixels)[:, None, None]
        stops, states, last = len(self.constant), len(self.states), len(self.states) + len(self.known)
        # Errors at places in units of their prior sds: their covariance may be as good as singular.
        turn = np.zeros((len(noise), states, states))
        own = np.arange(stops)
        turn[:, own, own] = 1.0
        turn[:, stops:, stops:] = self._place_roots(log_scale)
        back = weight * np.swapaxes(turn, 1, 2)
        whole = np.zeros((len(noise), last + 1, last + 1))
        # Below the diagonal alone: nothing above it is read.
        whole[:, :states, :states] = back @ self.states @ turn
        whole[:, own, own] += 1 / (np.exp(2 * log_scale) @ self.variance.T + self.constant)
        places = np.arange(stops, states)
        whole[:, places, places] += 1.0
        whole[:, states:last, :states] = np.swapaxes(back @ self.load.T, 1, 2)
        whole[:, states:last, states:last] = self.prior + weight * self.known
        whole[:, last, :states] = back @ self.state_score
        whole[:, last, states:last] = weight[:, 0] * self.score - score_at_mode
        whole[:, last, last] = FAR_ABOVE
        root = np.linalg.cholesky(whole)
        return Conditional(root[:, states:last, states:last], root[:, last, states:last])

    def _log_width(self, noise: np.ndarray) -> np.ndarray:
        """From the table, at noise coordinates (n, q), shape (n, d): lines between the nodes and above the last."""
        first, second = STRETCH_NODES[:2]
        at = (np.maximum(noise, first) - first) / (second - first)
        node = np.minimum(at.astype(int), len(STRETCH_NODES) - 2)
        which = np.arange(len(self.noise))
        low, high = self.stretch[which, node], self.stretch[which, node + 1]
        return np.sum(low + (at - node)[..., None] * (high - low), axis=-2)

    @cached_property
    def _score_at_mode(self) -> np.ndarray:
        found = self._conditional(np.zeros((1, len(self.noise))), np.zeros(len(self.known)))
        return found.factor[0] @ found.shift[0]

    def conditional(self, noise: np.ndarray) -> Conditional:
        """The normal density of y at noise coordinates (n, q), its mean at the mode where the scales are those.

        Without stop errors there is none: see `stretch`.
        """
        return self._conditional(noise, self._score_at_mode)

    def mapped(self, w: np.ndarray) -> Mapped:
        """From w (n, d) to z with the Jacobian; noise coordinates are the same in w and y, the shear keeps volumes."""
        return Mapped.joined([self._mapped(block) for block in np.split(w, range(BLOCK_ROWS, len(w), BLOCK_ROWS))])

    def _mapped(self, w: np.ndarray) -> Mapped:
        count = len(self.noise)
        noise = w[:, self.noise]
        log_width = self._log_width(noise)
        y, log_jacobian = w * np.exp(log_width), log_width.sum(axis=1)
        if len(self.states):
            found = self.conditional(noise)
            y[:, count:] = found.solved(y[:, count:] + found.shift)
            log_jacobian -= np.log(np.diagonal(found.factor, axis1=1, axis2=2)).sum(axis=1)
        for place, form in zip(self.narrow, self.bend, strict=True):
            before = y[:, :place]
            y[:, place] -= 0.5 * np.einsum("ni,ni->n", before @ form[:place, :place], before)
        return Mapped(self.from_whitened(y), log_jacobian)

    def to_w(self, z: np.ndarray) -> np.ndarray:
        """From z (n, p) to w (n, d); the inverse of `mapped` on the sampled columns."""
        step = (z - self.mode)[:, self.free]
        linear = step.copy()
        for place in self.curved:
            linear[:, place + 1 :] -= self._beyond_linear(place, step[:, place])[:, None] * self._follow(place)
        y = np.linalg.solve(self.root, linear.T).T
        straight = y.copy()
        for place, form in zip(self.narrow, self.bend, strict=True):
            before = y[:, :place]
            straight[:, place] += 0.5 * np.einsum("ni,ni->n", before @ form[:place, :place], before)
        # Noise coordinates are neither bent nor turned nor stretched: they are known before anything is undone.
        count = len(self.noise)
        noise = straight[:, self.noise]
        if len(self.states):
            found = self.conditional(noise)
            turned = np.swapaxes(found.factor, 1, 2) @ straight[:, count:, None]
            straight[:, count:] = turned[..., 0] - found.shift
        return straight * np.exp(-self._log_width(noise))
