"""Errors of gears that repeat by position: transmission error and play as Gaussian processes of the output's angle.

Looks determine both at their own counters; rad. Arrays over axes are ordered (pan, tilt), arrays over places as
`Places` lists them (formulation 3.1).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from tvsbayes.instrument.parameters import PERIODS_MAX
from tvsbayes.statistics.gaussian_process import JITTER, matern52, with_waves

FLOOR_RAD2 = 1e-24
"""Variance added at a place: positive, but below every measurable angle."""


class GearScales(eqx.Module):
    """Scales of repeating errors: their sds, the angles over which they change, and the drift of the zero.

    Fields may have leading axes: many points at once.

    Attributes:
        error_rad: sd of the transmission error's aperiodic part, by axis.
        length_rad: correlation length of this part and of the play.
        play_rad: sd of the play over position.
        drift_rad_per_root_hour: sd of the zero's random walk.
        amplitude_rad: sd of the parts of stated period, by axis and number.
        period_rad: their periods, angle of the output.
    """

    error_rad: Float[Array | np.ndarray, "*batch 2"]
    length_rad: Float[Array | np.ndarray, "*batch 2"]
    play_rad: Float[Array | np.ndarray, "*batch 2"]
    drift_rad_per_root_hour: Float[Array | np.ndarray, "*batch 2"]
    amplitude_rad: Float[Array | np.ndarray, "*batch 2 3"]
    period_rad: Float[Array | np.ndarray, "*batch 2 3"]


class Places(eqx.Module):
    """Counters of both axes, in one list, at which the processes are evaluated; padding is not valid."""

    steps: Float[Array, " places"]
    on_tilt: Bool[Array, " places"]
    valid: Bool[Array, " places"]

    def by_axis(self, of_axis: Float[Array, "2"]) -> Float[Array, " places"]:
        """Select for each place the number of its axis."""
        return jnp.where(self.on_tilt, of_axis[1], of_axis[0])


def errors_at(errors: np.ndarray, places: int) -> np.ndarray:
    """Pad transmission errors, then plays (n, e) at the first places to all places (n, 2 places) by zeros."""
    errors_rad = np.zeros((len(errors), 2, places))
    errors_rad[:, :, : errors.shape[1] // 2] = np.reshape(errors, (len(errors), 2, -1))
    return errors_rad.reshape(len(errors), -1)


@dataclass(frozen=True)
class BlockRoot:
    """A block-diagonal lower triangular factor, for many points."""

    blocks: tuple[Float[np.ndarray, "*batch _ _"], ...]

    @property
    def size(self) -> int:
        """Return the number of rows."""
        return sum(block.shape[-1] for block in self.blocks)

    @property
    def spans(self) -> tuple[slice, ...]:
        """Return the rows of each block."""
        ends = np.cumsum([0, *(block.shape[-1] for block in self.blocks)]).tolist()
        return tuple(slice(*pair) for pair in pairwise(ends))

    def times(self, x: np.ndarray) -> np.ndarray:
        """Compute R x for vectors (..., e)."""
        return _joined([(block @ x[..., span, None])[..., 0] for block, span in self._parts], -1)

    def transposed_times(self, x: np.ndarray) -> np.ndarray:
        """Compute R'X for matrices (..., e, c)."""
        return _joined([block.swapaxes(-2, -1) @ x[..., span, :] for block, span in self._parts], -2)

    def congruent(self, x: np.ndarray) -> np.ndarray:
        """Compute R'X R for symmetric matrices (..., e, e)."""
        if len(self.blocks) == 1:
            return self.blocks[0].swapaxes(-2, -1) @ x @ self.blocks[0]
        result = np.empty(np.broadcast_shapes(x.shape, (*self.blocks[0].shape[:-2], 1, 1)))
        for k, (block, rows) in enumerate(self._parts):
            half = block.swapaxes(-2, -1) @ x[..., rows, rows.start :]
            for other, columns in self._parts[k:]:
                whole = half[..., columns.start - rows.start : columns.stop - rows.start] @ other
                result[..., rows, columns], result[..., columns, rows] = whole, whole.swapaxes(-2, -1)
        return result

    @property
    def _parts(self) -> tuple[tuple[np.ndarray, slice], ...]:
        return tuple(zip(self.blocks, self.spans, strict=True))


def _joined(parts: list[np.ndarray], axis: int) -> np.ndarray:
    return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=axis)


def _distances(angle_rad: np.ndarray) -> np.ndarray:
    return angle_rad[..., :, None] - angle_rad[..., None, :]


def _error_root(
    scales: GearScales, rows: Callable[[Any], np.ndarray], angle_rad: np.ndarray, together: np.ndarray | bool
) -> np.ndarray:
    """Compute a factor of the covariance of transmission errors; `rows` spreads an axis' number over its places."""
    size, distance = angle_rad.shape[-1], _distances(angle_rad)
    amplitudes, periods = (
        [rows(x[..., k]) for k in range(PERIODS_MAX)] for x in (scales.amplitude_rad, scales.period_rad)
    )
    waves = [pair for pair in zip(amplitudes, periods, strict=True) if np.any(pair[0])]
    error = rows(scales.error_rad)
    covariance = with_waves(error**2 * matern52(distance, rows(scales.length_rad)), distance, waves)
    floor = JITTER * sum((amplitude**2 for amplitude, _ in waves), error**2) + FLOOR_RAD2
    return np.linalg.cholesky(np.where(together, covariance, error**2 * np.eye(size)) + floor * np.eye(size))


def _play_root(
    scales: GearScales, rows: Callable[[Any], np.ndarray], angle_rad: np.ndarray, together: np.ndarray | bool
) -> np.ndarray:
    """Compute a factor of the covariance of plays; their sd scales it afterwards, as it may be zero."""
    near = matern52(_distances(angle_rad), rows(scales.length_rad))
    near = np.where(together, near, np.eye(angle_rad.shape[-1]))
    return rows(scales.play_rad) * np.linalg.cholesky(near + JITTER * np.eye(angle_rad.shape[-1]))


def column_blocks(scales: GearScales, angle_rad: np.ndarray, on_tilt: np.ndarray, of_play: np.ndarray) -> BlockRoot:
    """Compute the factor of the covariance of some errors in independent blocks: one for each axis and process.

    Args:
        scales: scales of the processes, fields with any leading axes.
        angle_rad: k n of the errors' places, shape (..., c).
        on_tilt: axis of each error, shape (c,).
        of_play: whether it is a play, shape (c,): transmission errors of pan, of tilt, plays of pan, of tilt.
    """
    kinds = 2 * of_play.astype(int) + on_tilt
    if np.any(np.diff(kinds) < 0):
        raise ValueError("errors are those of pan, then of tilt, then plays of pan and of tilt")

    def root(kind: int) -> np.ndarray:
        def rows(of_axis: Any) -> np.ndarray:
            return of_axis[..., kind % 2, None, None]

        return (_error_root, _play_root)[kind // 2](scales, rows, angle_rad[..., kinds == kind], True)

    blocks = tuple(root(kind) for kind in np.unique(kinds).tolist())
    return BlockRoot(blocks or (np.zeros((*scales.error_rad.shape[:-1], 0, 0)),))


def place_root(
    scales: GearScales, angle_rad: np.ndarray, on_tilt: np.ndarray, valid: np.ndarray
) -> Float[np.ndarray, "*batch errors errors"]:
    """Compute the lower triangular factor of the covariance of transmission errors, then plays (formulation 3.1).

    Args:
        scales: scales of the processes, fields of NumPy with any leading axes.
        angle_rad: k n of the places, shape (..., places).
        on_tilt: as in `Places`.
        valid: as in `Places`.

    Returns:
        Factor at the places, rad; diagonal for padding.
    """
    together = (on_tilt[:, None] == on_tilt[None, :]) & valid[:, None] & valid[None, :]

    def rows(of_axis: Any) -> np.ndarray:
        return np.where(on_tilt, of_axis[..., 1:], of_axis[..., :1])[..., None]

    error_root, play_root = (of(scales, rows, angle_rad, together) for of in (_error_root, _play_root))
    nothing = np.zeros_like(error_root)
    return np.block([[error_root, nothing], [nothing, play_root]])
