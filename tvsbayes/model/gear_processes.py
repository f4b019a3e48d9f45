"""Errors of gears that repeat by position: transmission error and play as Gaussian processes of the output's angle.

Both are told apart at the counters where looks found the axes; rad. Arrays over axes are ordered (pan, tilt), arrays
over places as `Places` lists them (formulation 3.1).
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from tvsbayes.instrument.parameters import PERIODS_MAX
from tvsbayes.statistics.gaussian_process import JITTER, matern52, repeated

FLOOR_RAD2 = 1e-24
"""Least variance of a place: below every angle that anybody measures, above zero."""


class GearScales(eqx.Module):
    """How large repeating errors are, over what angle they change, and how the zero drifts.

    Fields may have leading axes: many points at once.

    Attributes:
        error_rad: sd of the transmission error's aperiodic part, by axis.
        length_rad: of its correlation and of the play's.
        play_rad: sd of the play over position.
        drift_rad_per_root_hour: of the zero's random walk.
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
    """Counters of both axes, one list, at which the processes have values; padding is not valid."""

    steps: Float[Array, " places"]
    on_tilt: Bool[Array, " places"]
    valid: Bool[Array, " places"]

    def by_axis(self, of_axis: Float[Array, "2"]) -> Float[Array, " places"]:
        """The number of each place's axis."""
        return jnp.where(self.on_tilt, of_axis[1], of_axis[0])


def errors_at(errors: np.ndarray, places: int) -> np.ndarray:
    """Transmission errors, then plays (n, e) at the first places, with those at all (n, 2 places); nothing behind."""
    errors_rad = np.zeros((len(errors), 2, places))
    errors_rad[:, :, : errors.shape[1] // 2] = np.reshape(errors, (len(errors), 2, -1))
    return errors_rad.reshape(len(errors), -1)


def _by_axis(of_axis: Any, on_tilt: Any, functions: ModuleType) -> Any:
    """Numbers (..., 2) of the axes at the places, shape (..., places)."""
    return functions.where(on_tilt, of_axis[..., 1:], of_axis[..., :1])


def place_root(
    scales: GearScales, angle_rad: Any, on_tilt: Any, valid: Any, functions: ModuleType = jnp
) -> Float[Array | np.ndarray, "*batch errors errors"]:
    """Lower triangular factor of the covariance of transmission errors, then plays, at places (formulation 3.1).

    Written for NumPy's and JAX's functions alike.

    Args:
        scales: of the processes, fields with any leading axes.
        angle_rad: k n of the places, shape (..., places).
        on_tilt: as in `Places`.
        valid: likewise.
        functions: jax.numpy or numpy.

    Returns:
        Rad; zero but on the diagonal for padding.
    """
    xp, size = functions, angle_rad.shape[-1]
    distance = angle_rad[..., :, None] - angle_rad[..., None, :]
    together = (on_tilt[:, None] == on_tilt[None, :]) & valid[:, None] & valid[None, :]

    def rows(of_axis: Any) -> Any:
        return _by_axis(of_axis, on_tilt, xp)[..., None]

    numbers = range(PERIODS_MAX)
    amplitudes, periods = ([rows(x[..., k]) for k in numbers] for x in (scales.amplitude_rad, scales.period_rad))
    error, length = rows(scales.error_rad), rows(scales.length_rad)
    covariance = repeated(distance, error, length, zip(amplitudes, periods, strict=True), xp)
    floor = JITTER * sum((amplitude**2 for amplitude in amplitudes), error**2) + FLOOR_RAD2
    error_root = xp.linalg.cholesky(xp.where(together, covariance, error**2 * xp.eye(size)) + floor * xp.eye(size))
    # Scaled after its factor: where there is no play its slope exists all the same.
    near = xp.where(together, matern52(distance, length, xp), xp.eye(size))
    play_root = rows(scales.play_rad) * xp.linalg.cholesky(near + JITTER * xp.eye(size))
    nothing = xp.zeros_like(error_root)
    above = xp.concatenate([error_root, nothing], axis=-1)
    return xp.concatenate([above, xp.concatenate([nothing, play_root], axis=-1)], axis=-2)
