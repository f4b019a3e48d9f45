"""The point of one look as a robot gets it: estimate, covariance, and whether its counters were ever looked at; mm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tvsbayes.display import Shown, View


@dataclass(frozen=True, repr=False)
class Located(Shown):
    """A point of frame T by linear propagation: estimate (3,), covariance (3, 3) and 95 % half widths (3,).

    `extrapolated` tells that no look of the campaign reached its counters, `unseen` which ones, in words.
    """

    xyz_mm: np.ndarray
    covariance_mm2: np.ndarray
    u95_mm: np.ndarray
    extrapolated: bool = False
    unseen: str = ""

    def shown(self) -> View:
        """Coordinates with their uncertainty."""
        u = np.sqrt(np.diag(self.covariance_mm2)).tolist()
        rows = list(zip("xyz", self.xyz_mm.tolist(), u, self.u95_mm.tolist(), strict=True))
        told = "Located point, frame T" + f", EXTRAPOLATED: {self.unseen}, where looks were" * self.extrapolated
        return View(told, ("axis", "mm", "u", "U95"), rows)
