"""Repeated errors of the gears as further coordinates of a plan, at regular counters that plans may use.

A fit integrates these errors out at its counters, which are unknown before a plan. The errors at the regular places are
N(0, 1) each in units of the factor of their covariance at the expected scales (formulation 3.1, 6), transmission errors
first, then plays; errors in between follow by kriging. Counters in steps, angles in rad.
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
from tvsbayes.instrument.parameters import KINDS, TARGETS
from tvsbayes.instrument.places import SPACING_DEG, interpolation
from tvsbayes.instrument.stops import rests_of
from tvsbayes.model.compiled import compiled, placed
from tvsbayes.model.gear_kriging import KnownPlaces, scales_at
from tvsbayes.model.gear_processes import GearScales, Places
from tvsbayes.model.headlines import AtPose, Headlines, SeenLine, headlines, line_deg_per_step, target_values
from tvsbayes.model.laser_path import beam_angles
from tvsbayes.model.parameter_space import ParameterSpace, physical_at

PLACES_MAX = 12
"""Largest number of places of one axis in one window."""
GAP_DEG = 60.0
"""Gap between counters of an axis above which they belong to different windows, such as a full turn away."""


@dataclass(frozen=True)
class GearPlaces(KnownPlaces):
    """Places of both axes, and the lines of which the ratios are the slopes.

    Attributes:
        share: weight of the value at each place in the slope of the line of its axis, steps^-1, shape (c,).
    """

    share: np.ndarray

    def turning(self, steps: np.ndarray, side: np.ndarray) -> np.ndarray:
        """Compute the derivative of the angles (pan, tilt) of looks by the errors, rad, shape (m, 2, 2 c).

        Args:
            steps: counters, shape (m, 2).
            side: +1 reached left or up, -1 right or down, 0 unknown, shape (m, 2).
        """
        derivative = np.zeros((len(steps), 2, self.size))
        if self.size:
            for axis in range(2):
                shares = self.between(steps[:, axis], axis)
                derivative[:, axis] = np.concatenate([shares.error, -0.5 * side[:, axis, None] * shares.play], axis=1)
        return derivative

    def line_through(self, steps: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """Compute the weight of each place in the slope of its axis' line through looks, as in a fit of these looks.

        Args:
            steps: counters of the looks, shape (m, 2).
            weight: number of times each is taken, shape (..., m).

        Returns:
            Shape (..., c); zero for an axis with looks at a single counter.
        """
        shares = np.zeros((*weight.shape[:-1], len(self.steps)))
        for axis in range(2):
            counters = steps[:, axis].astype(float)
            total = np.maximum(weight.sum(axis=-1, keepdims=True), 1)
            deviations = counters - (weight @ counters)[..., None] / total
            squares = np.sum(weight * deviations**2, axis=-1, keepdims=True)
            slope = np.divide(weight * deviations, squares, out=np.zeros_like(deviations), where=squares > 0)
            shares += slope @ self._interpolation(counters, axis)
        return shares

    def _interpolation(self, counters: np.ndarray, axis: int) -> np.ndarray:
        """Compute interpolation weights of the places for counters (m,) of an axis, within windows, shape (m, c)."""
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
        """Compute `turning` of the looks after some of the moves."""
        rests = [[rests[move] for move in looks] for rests in (rests_of(moves, axis) for axis in AXES)]
        steps, side = (
            np.array([[getattr(rest, name) for rest in axis] for axis in rests]).T for name in ("steps", "sign")
        )
        return self.turning(steps, side)

    def headlines(self, z: np.ndarray, space: ParameterSpace, pose_rad: np.ndarray) -> Headlines:
        """Compute headlines at coordinates, with derivatives by coordinates and errors, shape (9, p + 2 c).

        Ratios are slopes of the lines over the places, at the pose without errors of the gears.
        """
        if not self.size:
            return headlines(z, space, pose_rad)
        parts, weights = self.parts(z, space, pose_rad), self.weights(self.share)
        return Headlines(
            placed(np.einsum("qi,iq->q", weights, parts.value)),
            placed(np.einsum("qi,iqp->qp", weights, parts.gradient)),
        )

    def parts(self, z: np.ndarray, space: ParameterSpace, pose_rad: np.ndarray) -> Headlines:
        """Compute headlines for each single place, then for none (leading axis c + 1), to be summed by `weights`."""
        places = Places(placed(self.steps), placed(self.on_tilt), placed(np.ones(len(self.steps), dtype=bool)))
        single_places = np.eye(len(self.steps) + 1, len(self.steps))
        return place_headlines(z, space, placed(pose_rad), places, placed(single_places), placed(self.root))

    def weights(self, share: np.ndarray) -> np.ndarray:
        """Compute weights of `parts` for lines, shape (..., 9, c + 1): a slope is the sum of its places' contributions.

        Args:
            share: weight of each place in the slope of the line of its axis, steps^-1, shape (..., c).
        """
        of_places = np.where(LINE_AXES[:, None] == self.on_tilt, share[..., None, :], 0.0)
        of_none = ~(of_places != 0).any(axis=-1, keepdims=True)
        return np.concatenate([of_places, of_none], axis=-1)


NO_PLACES = GearPlaces(np.zeros(0), np.zeros(0, dtype=bool), np.zeros(2), None, np.zeros(0))
"""Places of perfect gears."""
LINE_AXES = np.array([AXES.index(q.axis) if q.ratio and q.axis else -1 for q in TARGETS.values()])
"""Axis of the line of each of `TARGETS`, -1 for none."""


@compiled(Headlines)
def place_headlines(
    z: Float[Array, " parameters"],
    space: ParameterSpace,
    pose_rad: Float[Array, "2"],
    places: Places,
    shares: Float[Array, "lines places"],
    root: Float[Array, "errors errors"],
) -> Headlines:
    """Compute headlines with ratios along several lines (formulation 3.2); fields have the leading axis `lines`.

    Derivatives are by coordinates and errors at the places.
    """

    def headlines_of(share):
        line = SeenLine(pose_rad, places, share)

        def values(point):
            model = space.model(point[: len(z)])
            mirrors = beam_angles(model.optics, pose_rad[0], pose_rad[1])
            slopes = line_deg_per_step(model, line, root @ point[len(z) :], mirrors)
            return target_values(AtPose(model, mirrors, slopes))

        point = jnp.concatenate([z, jnp.zeros(len(root))])
        return Headlines(values(point), jax.jacfwd(values)(point))

    return jax.vmap(headlines_of)(shares)


def expected_scales(z: np.ndarray, space: ParameterSpace, after_data: bool) -> GearScales:
    """Return scales of the gears' errors at coordinates; before any data, half-normal ones by their root mean square.

    Sampling averages the variance over a scale, E s^2: u^2 for a half-normal.
    """
    physical = np.array(physical_at(z, space).value)
    if not after_data:
        half_normal = np.asarray(space.kind) == KINDS.index("half-normal")
        physical[: len(half_normal)] = np.where(half_normal, np.asarray(space.u), physical[: len(half_normal)])
    return scales_at(physical, np.asarray(space.harmonic_period_deg), space.mechanism)


def windows_of(counters: np.ndarray, deg_per_step: float) -> list[np.ndarray]:
    """Split distinct counters (n,) of an axis at gaps above `GAP_DEG`; largest windows, nearest to 0, first."""
    distinct = np.unique(counters).astype(float)
    gaps = np.flatnonzero(np.diff(distinct) * deg_per_step > GAP_DEG) + 1
    return sorted(np.split(distinct, gaps), key=lambda window: (-len(window), abs(window.mean())))


def regular_places(reached: np.ndarray, ratio_deg_per_step: np.ndarray, scales: GearScales) -> GearPlaces:
    """Build places over the counters of plans; a ratio is the slope of the line over its axis' first window.

    Args:
        reached: counters (pan, tilt), shape (m, 2).
        ratio_deg_per_step: mean ratios, shape (2,).
        scales: expected scales.
    """
    steps, on_tilt, share = [], [], []
    for axis in range(2):
        deg_per_step = abs(float(ratio_deg_per_step[axis]))
        for number, window in enumerate(windows_of(reached[:, axis], deg_per_step)):
            count = math.ceil(np.ptp(window) * deg_per_step / SPACING_DEG) + 1
            nodes = np.linspace(window[0], window[-1], min(max(count, 2), PLACES_MAX)) if len(window) > 1 else window
            deviations = nodes - nodes.mean()
            has_line = number == 0 and len(nodes) > 1
            steps.append(nodes)
            on_tilt.append(np.full(len(nodes), axis == 1))
            share.append(deviations / (deviations @ deviations) if has_line else np.zeros(len(nodes)))
    all_steps, all_on_tilt, all_shares = (np.concatenate(part) for part in (steps, on_tilt, share))
    return GearPlaces(all_steps, all_on_tilt, np.radians(ratio_deg_per_step), scales, all_shares)


@dataclass(frozen=True)
class FittedErrors:
    """Estimate of the errors by a fit at its own places.

    Attributes:
        places: places of the fit.
        covariance: covariance of the coordinates and of the errors at these places, shape (p + e, p + e).
    """

    places: GearPlaces
    covariance: np.ndarray

    def covariance_at(self, places: GearPlaces) -> np.ndarray:
        """Compute the covariance of the coordinates and of the errors at other places."""
        size = len(self.places.steps)
        count = len(self.covariance) - 2 * size
        scales = self.places.scales
        assert scales is not None, "a fit with places has scales"
        # Correlations do not depend on the scale of the errors; a zero scale of the play would divide by zero.
        scaled = replace(scales, play_rad=np.where(scales.play_rad > 0, scales.play_rad, 1.0))
        fitted, target = replace(self.places, scales=scaled), replace(places, scales=scaled)
        roots = np.split(target.root, 2)
        factors = fitted.factors_with(target.steps, target.on_tilt)
        loadings, residual_roots = [], []
        for part, factor in zip((roots[0][:, : len(roots[0])], roots[1][:, len(roots[0]) :]), factors, strict=True):
            loading = linalg.solve_triangular(part, factor[size:], lower=True)
            loadings.append(loading[:, :size])
            residual_roots.append(loading[:, size:])
        transfer = linalg.block_diag(np.eye(count), *loadings)
        residual = linalg.block_diag(np.zeros((count, count)), *(part @ part.T for part in residual_roots))
        return transfer @ self.covariance @ transfer.T + residual
