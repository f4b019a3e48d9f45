"""Uncertainty budget of one located point: by cause, and by parameter with correlations.

Frame T, mm; law of propagation of uncertainty (GUM 5.1, 5.2, 7.2.7).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tvsbayes.calibration.pointing import APERTURE, PLACES, STOPS, UNIT_NOISES, Calibration
from tvsbayes.instrument.axes import HOME_APPROACH
from tvsbayes.instrument.parameters import unit_of
from tvsbayes.metrology.budget_tables import BudgetTable, Source, budget_table

STOP_HERE, APERTURE_HERE, PLAY_HERE = "stop error here", "aperture noise here", "unknown approach here"
"""Causes that belong to the look and not to the calibration."""


@dataclass(frozen=True)
class Budget:
    """Parts of the variance of one point.

    Attributes:
        causes: those of the calibration, then the noises of this look.
        share: of the total variance (sum over x, y, z), shape (causes,); sum 1.
        variance_mm2: by cause and coordinate, shape (causes, 3).
        parameters: names of the calibration's `look_inputs` and of this look's noises.
        contribution_mm: sensitivity times standard uncertainty, shape (parameters, 3).
        correlation: of the parameters, needed to add up contributions, shape (parameters, parameters).
        covariance_mm2: of the point, shape (3, 3).
        steps: counters (pan, tilt) of the look.
    """

    causes: tuple[str, ...]
    share: np.ndarray
    variance_mm2: np.ndarray
    parameters: tuple[str, ...]
    contribution_mm: np.ndarray
    correlation: np.ndarray
    covariance_mm2: np.ndarray
    steps: tuple[float, float]

    def as_json(self) -> dict[str, object]:
        """Return causes with share and u, and parameters with signed contributions and correlations."""
        causes = zip(self.causes, self.share.tolist(), np.sqrt(self.variance_mm2).tolist(), strict=True)
        parameters = zip(self.parameters, self.contribution_mm.tolist(), strict=True)
        return {
            "causes": [{"cause": name, "share": share, "u_mm": u} for name, share, u in causes],
            "parameters": [{"name": name, "contribution_mm": row} for name, row in parameters],
            "correlation": self.correlation.tolist(),
        }


def budget(
    calibration: Calibration,
    pan_steps: float,
    tilt_steps: float,
    aperture_deg: float,
    approach: tuple[str, str] = HOME_APPROACH,
) -> Budget:
    """Compute the uncertainty budget of one look: counters, reading B of the aperture, last move of (pan, tilt).

    Raises:
        ValueError: the calibration has no causes, as of an older fit.
        InputError: there is no such approach, or beam and line of sight do not meet.
    """
    if not calibration.causes:
        raise ValueError("this calibration has no causes of uncertainty: fit the campaign again")
    steps, count = (float(pan_steps), float(tilt_steps)), len(calibration.look_inputs)
    jacobian = calibration.derivatives(pan_steps, tilt_steps, aperture_deg, approach)
    covariance, parts = calibration.look_covariance(steps), calibration.cause_covariance
    if calibration.gears.size:
        parts = calibration.gears.look_covariance(parts, steps)
    calibrated, noise = jacobian[:, :count], jacobian[:, count:] ** 2 * np.diag(covariance)[count:]
    here = [noise[:, kind].sum(axis=1) for kind in (STOPS, PLACES)] + [noise[:, APERTURE]]
    variance = np.array([*(np.einsum("ij,jk,ik->i", calibrated, part, calibrated) for part in parts), *here])
    u = np.sqrt(np.diag(covariance))
    # Constants have correlation 0.
    safe = np.where(u > 0, u, 1.0)
    return Budget(
        causes=(*calibration.causes, STOP_HERE, PLAY_HERE, APERTURE_HERE),
        share=variance.sum(axis=1) / variance.sum(),
        variance_mm2=variance,
        parameters=(*calibration.look_inputs, *UNIT_NOISES),
        contribution_mm=(jacobian * u).T,
        correlation=covariance / np.outer(safe, safe),
        covariance_mm2=jacobian @ covariance @ jacobian.T,
        steps=steps,
    )


_KINDS = {"stop": ("A", "normal"), "place": ("B", "uniform"), "aperture": ("B", "normal")}
"""Kind of evaluation (GUM 4.2, 4.3) and distribution of the unit noises, by the first word of their names."""


def coordinate_budget(budget: Budget, calibration: Calibration, xyz_mm: Sequence[float], component: str) -> BudgetTable:
    """Build the budget of "x", "y" or "z" of a located point by parameter of the calibration and noise of the look."""
    if component not in ("x", "y", "z"):
        raise ValueError(f"component {component!r}; allowed: x, y, z")
    index, estimates = "xyz".index(component), calibration.estimates_at(budget.steps)
    sd = np.sqrt(np.diag(calibration.look_covariance(budget.steps))).tolist()
    sources = []
    for name, width, moved in zip(budget.parameters, sd, budget.contribution_mm[:, index].tolist(), strict=True):
        if width:
            fitted = name not in UNIT_NOISES
            unit, value = (unit_of(name), estimates[name]) if fitted else ("1", 0.0)
            kind = ("A, B", "normal") if fitted else _KINDS[name.split()[0]]
            sources.append(Source(name, unit, value, width, *kind, math.inf, moved / width))
    u = math.sqrt(float(budget.covariance_mm2[index, index]))
    notes = ("by parameter; parameters fitted together are correlated (GUM 5.2.2)",)
    return budget_table(f"{component} of the point", "mm", float(xyz_mm[index]), u, sources, notes=notes)
