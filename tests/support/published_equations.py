"""The coordinates of the paper as printed: an independent reference for the package (Metrology 2025, 5(4), 58)."""

from __future__ import annotations

import numpy as np


def published_point(
    B_deg: float | np.ndarray,
    C_deg: float | np.ndarray,
    beta_deg: float | np.ndarray,
    baseline_mm: float,
    *,
    as_printed: bool = False,
) -> np.ndarray:
    """The paper's equations (1)-(3), B and C in the plane that is tilted by beta about the baseline.

    y = a (1/2 - sin B cos C / sin(B + C)) holds for every B and C. The paper prints a second branch for B > 90 deg,
    y = -a (1/2 + sin B cos C / sin[180 - (B + C)]), which jumps by -a at B = 90 deg: it is returned with
    `as_printed` only.

    Args:
        B_deg: angle at the aperture.
        C_deg: angle at the positioner.
        beta_deg: elevation.
        baseline_mm: a.
        as_printed: the paper's two branches.

    Returns:
        x, y, z in mm, first axis; infinite or behind the baseline where B + C >= 180 deg.
    """
    B, C, beta = (np.radians(np.asarray(angle, dtype=float)) for angle in (B_deg, C_deg, beta_deg))
    with np.errstate(divide="ignore", invalid="ignore"):
        height = baseline_mm * np.sin(B) * np.sin(C) / np.sin(B + C)
        share = np.sin(B) * np.cos(C) / np.sin(B + C)
    y = baseline_mm * (0.5 - share)
    if as_printed:
        y = np.where(np.degrees(B) > 90.0, -baseline_mm * (0.5 + share), y)
    return np.stack(np.broadcast_arrays(height * np.cos(beta), y, height * np.sin(beta)))
