"""The point of one look for robots: estimate, covariance, and whether its counters are extrapolated; mm.

Also the rule when a look has no point of finite uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tvsbayes.calibration.optics import Number
from tvsbayes.display import Shown, View

DIVERGING_SHARE = 1e-3
"""Share of draws without a point above which a point is refused (formulation 5)."""
DIVERGING_SDS = 3.0902323061678132
"""Range over its standard deviation below which more than `DIVERGING_SHARE` of a normal 1/range is negative."""


def meets(reach_mm: Number, direction: np.ndarray, covariance_mm2: np.ndarray) -> bool | np.ndarray:
    """Whether at most `DIVERGING_SHARE` of the distribution has no point, by the law of propagation (formulation 5).

    The inverse of the range is nearly normal: its tail beyond zero is the share of draws that diverge.

    Args:
        reach_mm: range of the estimated point, of any shape.
        direction: unit vector of the beam, shape (..., 3).
        covariance_mm2: covariance of the point, shape (..., 3, 3); the result is False where it is not finite.
    """
    variance = np.einsum("...i,...ij,...j->...", direction, covariance_mm2, direction)
    finite = np.isfinite(covariance_mm2).all(axis=(-2, -1))
    return finite & (reach_mm > DIVERGING_SDS * np.sqrt(np.maximum(variance, 0.0)))


@dataclass(frozen=True, repr=False)
class Located(Shown):
    """A point of frame T by linear propagation: estimate (3,), covariance (3, 3) and 95 % half widths (3,).

    `extrapolated` is whether its counters are outside those of the campaign's looks, `unseen` which ones, in words.
    """

    xyz_mm: np.ndarray
    covariance_mm2: np.ndarray
    u95_mm: np.ndarray
    extrapolated: bool = False
    unseen: str = ""

    def shown(self) -> View:
        """Show the coordinates with their uncertainty."""
        u = np.sqrt(np.diag(self.covariance_mm2)).tolist()
        rows = list(zip("xyz", self.xyz_mm.tolist(), u, self.u95_mm.tolist(), strict=True))
        title = "Located point, frame T" + f", EXTRAPOLATED: {self.unseen}, where looks were" * self.extrapolated
        return View(title, ("axis", "mm", "u", "U95"), rows)
