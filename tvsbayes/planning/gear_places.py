"""What gears repeat, as further coordinates of a plan: their errors at regular counters that plans may use.

In a fit these errors are integrated out at the counters seen; before one nobody knows which those will be. Of the
regular places each is N(0, 1) in units of the factor of their covariance at the believed scales (formulation 3.1, 6),
transmission errors first, then plays; what lies between follows from them (kriging). Counters in steps, angles in rad.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import linalg

from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.campaign import Move
from tvsbayes.instrument.parameters import KINDS, NAMES, TARGETS
from tvsbayes.instrument.places import SPACING_DEG, interpolation
from tvsbayes.instrument.stops import rests_of
from tvsbayes.model.compiled import compiled, placed
from tvsbayes.model.gear_kriging import KnownPlaces, scales_at
from tvsbayes.model.gear_processes import GearScales, Places
from tvsbayes.model.headlines import AtPose, Headlines, SeenLine, headlines, line_deg_per_step, target_values
from tvsbayes.model.laser_path import beam_angles
from tvsbayes.model.parameter_space import ParameterSpace, physical_at

PLACES_MAX = 12
"""Of one axis in one window."""
GAP_DEG = 60.0
"""Counters of an axis that lie farther apart are windows of their own: a full turn away, for instance."""


@dataclass(frozen=True)
class GearPlaces(KnownPlaces):
    """Places of both axes, and the lines that ratios are.

    Attributes:
        share: of the value at each place in the slope of the line of its axis, steps^-1, shape (c,).
    """

    share: np.ndarray

    def turning(self, steps: np.ndarray, side: np.ndarray) -> np.ndarray:
        """How the errors turn (pan, tilt) of looks, d(angle)/d(errors), rad, shape (m, 2, 2 c).

        Args:
            steps: counters, shape (m, 2).
            side: +1 reached left or up, -1 right or down, 0 unknown, shape (m, 2).
        """
        turns = np.zeros((len(steps), 2, self.size))
        if self.size:
            for axis in range(2):
                at = self.between(steps[:, axis], axis)
                turns[:, axis] = np.concatenate([at.error, -0.5 * side[:, axis, None] * at.play], axis=1)
        return turns

    def line_through(self, steps: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """Share of each place in the slope of the line of its axis through looks, as a fit of these looks has it.

        Args:
            steps: counters of the looks, shape (m, 2).
            weight: how often each is taken, shape (..., m).

        Returns:
            Shape (..., c); zero for an axis that is seen at one counter alone.
        """
        shares = np.zeros((*weight.shape[:-1], len(self.steps)))
        for axis in range(2):
            counters = steps[:, axis].astype(float)
            total = np.maximum(weight.sum(axis=-1, keepdims=True), 1)
            off = counters - (weight @ counters)[..., None] / total
            square = np.sum(weight * off**2, axis=-1, keepdims=True)
            slope = np.divide(weight * off, square, out=np.zeros_like(off), where=square > 0)
            shares += slope @ self._interpolation(counters, axis)
        return shares

    def _interpolation(self, counters: np.ndarray, axis: int) -> np.ndarray:
        """Share of the places in the counters (m,) of an axis, each from those of its window, shape (m, c)."""
        weights = np.zeros((len(counters), len(self.steps)))
        of_axis = self.on_tilt == (axis == 1)
        windows = windows_of(self.steps[of_axis], abs(float(np.degrees(self.ratio_rad_per_step[axis]))))
        nearest = np.argmin([np.abs(counters - nodes[:, None]).min(axis=0) for nodes in windows], axis=0)
        for number, nodes in enumerate(windows):
            rows, places = np.flatnonzero(nearest == number), np.flatnonzero(of_axis & np.isin(self.steps, nodes))
            places = places[np.argsort(self.steps[places])]
            weights[np.ix_(rows, places)] = interpolation(counters[rows], nodes)
        return weights

    def turning_after(self, moves: Sequence[Move], looks: Sequence[int]) -> np.ndarray:
        """`turning` of the looks after some of the moves."""
        rests = [[rests[move] for move in looks] for rests in (rests_of(moves, axis) for axis in AXES)]
        steps, side = (
            np.array([[getattr(rest, name) for rest in axis] for axis in rests]).T for name in ("steps", "sign")
        )
        return self.turning(steps, side)

    def headlines(self, z: np.ndarray, space: ParameterSpace, pose_rad: np.ndarray) -> Headlines:
        """Headlines at coordinates, with derivatives by coordinates and errors, shape (9, p + 2 c).

        Ratios are slopes of the lines over the places, at a pose where gears repeat no error.
        """
        if not self.size:
            return headlines(z, space, pose_rad)
        parts, weights = self.parts(z, space, pose_rad), self.weights(self.share)
        return Headlines(
            placed(np.einsum("qi,iq->q", weights, parts.value)),
            placed(np.einsum("qi,iqp->qp", weights, parts.gradient)),
        )

    def parts(self, z: np.ndarray, space: ParameterSpace, pose_rad: np.ndarray) -> Headlines:
        """Headlines by each place alone, and last by none, which `weights` sum: arrays with a leading axis c + 1."""
        places = Places(placed(self.steps), placed(self.on_tilt), placed(np.ones(len(self.steps), dtype=bool)))
        alone = np.eye(len(self.steps) + 1, len(self.steps))
        return place_headlines(z, space, placed(pose_rad), places, placed(alone), placed(self.root))

    def weights(self, share: np.ndarray) -> np.ndarray:
        """How lines sum `parts`, shape (..., 9, c + 1): a slope over places is the sum of what each has in it.

        Args:
            share: of each place in the slope of the line of its axis, steps^-1, shape (..., c).
        """
        of_places = np.where(LINED_AXIS[:, None] == self.on_tilt, share[..., None, :], 0.0)
        of_none = ~(of_places != 0).any(axis=-1, keepdims=True)
        return np.concatenate([of_places, of_none], axis=-1)


NO_PLACES = GearPlaces(np.zeros(0), np.zeros(0, dtype=bool), np.zeros(2), None, np.zeros(0))
"""Of gears that repeat no error."""
LINED_AXIS = np.array([AXES.index(of.axis) if of.ratio and of.axis else -1 for of in TARGETS.values()])
"""The axis over whose places each of `TARGETS` is a line, -1 for none."""


@compiled(Headlines)
def place_headlines(
    z: Float[Array, " parameters"],
    space: ParameterSpace,
    pose_rad: Float[Array, "2"],
    places: Places,
    shares: Float[Array, "lines places"],
    root: Float[Array, "errors errors"],
) -> Headlines:
    """Headlines with ratios along lines (formulation 3.2), several at once: every field has the leading axis `lines`.

    Derivatives are by coordinates and errors at the places.
    """

    def along(share):
        line = SeenLine(pose_rad, places, share)

        def values(point):
            model = space.model(point[: len(NAMES)])
            mirrors = beam_angles(model.optics, pose_rad[0], pose_rad[1])
            slopes = line_deg_per_step(model, line, root @ point[len(NAMES) :], mirrors)
            return target_values(AtPose(model, mirrors, slopes))

        point = jnp.concatenate([z, jnp.zeros(len(root))])
        return Headlines(values(point), jax.jacfwd(values)(point))

    return jax.vmap(along)(shares)


def believed_scales(z: np.ndarray, space: ParameterSpace, after_data: bool) -> GearScales:
    """Scales of the gears' errors at coordinates; before any data root mean squares of those that may be zero.

    What sampling reports is a variance over all that a scale may be, E s^2: of a half-normal u^2.
    """
    physical = np.array(physical_at(z, space).value)
    if not after_data:
        half_normal = np.asarray(space.kind) == KINDS.index("half-normal")
        physical[: len(half_normal)] = np.where(half_normal, np.asarray(space.u), physical[: len(half_normal)])
    return scales_at(physical, np.asarray(space.harmonic_period_deg))


def windows_of(counters: np.ndarray, deg_per_step: float) -> list[np.ndarray]:
    """Different counters (n,) of an axis, apart where nothing lies within `GAP_DEG`; best filled, nearest 0 first."""
    different = np.unique(counters).astype(float)
    apart = np.flatnonzero(np.diff(different) * deg_per_step > GAP_DEG) + 1
    return sorted(np.split(different, apart), key=lambda window: (-len(window), abs(window.mean())))


def regular_places(reached: np.ndarray, ratio_deg_per_step: np.ndarray, scales: GearScales) -> GearPlaces:
    """Places over the counters that plans may use; a ratio is the line over those of its axis' first window.

    Args:
        reached: counters (pan, tilt), shape (m, 2).
        ratio_deg_per_step: mean ratios, shape (2,).
        scales: believed.
    """
    steps, on_tilt, share = [], [], []
    for axis in range(2):
        deg_per_step = abs(float(ratio_deg_per_step[axis]))
        for number, chain in enumerate(windows_of(reached[:, axis], deg_per_step)):
            wanted = math.ceil(np.ptp(chain) * deg_per_step / SPACING_DEG) + 1
            nodes = np.linspace(chain[0], chain[-1], min(max(wanted, 2), PLACES_MAX)) if len(chain) > 1 else chain
            off = nodes - nodes.mean()
            lined = number == 0 and len(nodes) > 1
            steps.append(nodes)
            on_tilt.append(np.full(len(nodes), axis == 1))
            share.append(off / (off @ off) if lined else np.zeros(len(nodes)))
    at, axis_of, line = (np.concatenate(part) for part in (steps, on_tilt, share))
    return GearPlaces(at, axis_of, np.radians(ratio_deg_per_step), scales, line)


@dataclass(frozen=True)
class TaughtErrors:
    """What a fit says of the errors at its own places.

    Attributes:
        places: its places.
        covariance: of the coordinates and of the errors at these places, shape (p + e, p + e).
    """

    places: GearPlaces
    covariance: np.ndarray

    def carried(self, places: GearPlaces) -> np.ndarray:
        """The same covariance of the coordinates and of the errors at other places."""
        size, count = len(self.places.steps), len(NAMES)
        scales = self.places.scales
        assert scales is not None, "a fit with places has scales"
        # In their units errors hang together whatever their size; no play would leave nothing to divide by.
        sized = replace(scales, play_rad=np.where(scales.play_rad > 0, scales.play_rad, 1.0))
        taught, wanted = replace(self.places, scales=sized), replace(places, scales=sized)
        roots = np.split(wanted.root, 2)
        factors = taught.factors_with(wanted.steps, wanted.on_tilt)
        follows, rest = [], []
        for part, factor in zip((roots[0][:, : len(roots[0])], roots[1][:, len(roots[0]) :]), factors, strict=True):
            turned = linalg.solve_triangular(part, factor[size:], lower=True)
            follows.append(turned[:, :size])
            rest.append(turned[:, size:])
        move = linalg.block_diag(np.eye(count), *follows)
        left = linalg.block_diag(np.zeros((count, count)), *(part @ part.T for part in rest))
        return move @ self.covariance @ move.T + left
