"""What a joint's state since its homing adds to its positions, and what scatters about them. NumPy, `crept` also JAX.

Formulation 3.1, 8.1 and 8.2. Positions and their errors share one unit; times in hours or minutes as named.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np

HOUR_S, HOUR_MINUTES = 3600.0, 60.0


def travelled(position: np.ndarray, segment: np.ndarray) -> np.ndarray:
    """Compute the distance that an axis has gone, to and fro, since its segment began, for every move (moves,)."""
    first = np.searchsorted(segment, segment)
    steps = np.abs(np.diff(position, prepend=position[:1]))
    total = np.cumsum(np.where(first == np.arange(len(first)), 0.0, steps))
    return total - total[first]


def crept(minutes: Any, creep_minutes: Any, xp: ModuleType = np) -> Any:
    """Compute the share 1 - exp(-t / tau) of its creep that a zero has crept after so many minutes of warming up."""
    return -xp.expm1(-minutes / creep_minutes)


def scatter_covariances(
    scales: tuple[np.ndarray, np.ndarray],
    stop_variance: np.ndarray,
    reading_variance: np.ndarray,
    hours: np.ndarray,
    zero: np.ndarray,
    stop: np.ndarray,
) -> dict[str, np.ndarray]:
    """Compute covariances (n, r, r) of readings by cause of what does not repeat, for n draws.

    Args:
        scales: sds of homings and of the drift in a root hour, each (n,).
        stop_variance: of the errors of stops, (n, r).
        reading_variance: of the noise of readings, (n, r).
        hours: time since the homing, (r,).
        zero: numbers of the homings, (r,).
        stop: numbers of the stops, (r,); readings at one stop share its error.
    """
    (home_sd, drift), one_zero = scales, np.equal.outer(zero, zero)
    at_stop = np.sqrt(stop_variance[:, :, None] * stop_variance[:, None, :])
    return {
        "homing": home_sd[:, None, None] ** 2 * one_zero,
        "drift": drift[:, None, None] ** 2 * np.minimum.outer(hours, hours) * one_zero,
        "stops": at_stop * np.equal.outer(stop, stop),
        "readings": reading_variance[:, :, None] * np.eye(len(hours)),
    }
