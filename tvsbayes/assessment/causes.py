"""What the uncertainty of a headline comes from."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from tvsbayes.assessment.weaknesses import gradients, moved_directions
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.parameters import INDEX, KINDS, NAMES, RIG_NAMES, unit_of
from tvsbayes.metrology.budget_tables import BudgetTable, Source, budget_table
from tvsbayes.model.parameter_space import HALF_NORMAL_MEAN, HALF_NORMAL_SD
from tvsbayes.results.estimates import HeadlineCauses

if TYPE_CHECKING:
    from tvsbayes.results.estimates import Estimate


def headline_budget(causes: HeadlineCauses, quantity: str, estimate: Estimate) -> BudgetTable:
    """The budget of an effective ratio or a backlash, by cause.

    Rows are independent of each other: noise of the campaign, the cameras' calibration as one, and every stated prior.
    An estimate moves by c when the centre of a prior moves by one unit.

    Args:
        causes: of `information.headline_causes`.
        quantity: one of its quantities.
        estimate: what is reported of it, Laplace or posterior; its sd is the combined uncertainty.
    """
    row = causes.quantities.index(quantity)
    sources = []
    for k, name in enumerate(causes.names):
        contribution, dof = float(causes.contribution[row, k]), float(causes.dof[row, k])
        if math.isnan(causes.u[k]):
            kind = "B" if name.startswith("stereo") else "A"
            sources.append(
                Source(name, unit_of(quantity), None, abs(contribution), kind, causes.distribution[k], dof, 1.0)
            )
            continue
        log, u = causes.distribution[k] == "log-normal", float(causes.u[k])
        label = f"prior of ln {name}" if log else f"prior of {name}"
        unit = "1" if log else unit_of(name)
        values = (label, unit, float(causes.centre[k]), u, "B", causes.distribution[k], dof, contribution / u)
        sources.append(Source(*values))
    notes = (
        "inputs are independent; the last row is what the curvature of the density and the spread of the noise scales "
        "add to linear propagation",
    )
    return budget_table(quantity, unit_of(quantity), estimate.value, estimate.sd, sources, notes=notes)


def headline_causes(fit: JointFit) -> HeadlineCauses:
    """Split the variance of ratios and backlashes by cause, as `causes_of` does for the inputs of a coordinate.

    Linear part of each headline in the coordinates; expected information, noise scales taken as known. How well the
    noise scales are known gives the degrees of freedom: nu = 1/(2 var(ln s)) (GUM G.4.2, eq. G.3).
    """
    moved = moved_directions(fit)
    columns = {
        f"effective_deg_per_step.{d}": fit.draws.effective_deg_per_step[:, k]
        for k, d in enumerate(DIRECTIONS)
        if d in moved
    }
    for axis, pair in (("pan", DIRECTIONS[:2]), ("tilt", DIRECTIONS[2:])):
        if moved & set(pair):
            columns[f"backlash_deg.{axis}"] = fit.draws.physical[:, INDEX[f"backlash_deg.{axis}"]]
    if not columns:
        none = np.zeros((0, 0))
        return HeadlineCauses((), (), none, np.zeros(0), np.zeros(0), (), none)
    gradient = gradients(fit, np.stack(list(columns.values()), axis=1))
    spread = gradient @ np.linalg.inv(fit.information.fisher + np.eye(len(NAMES)))
    gain = np.concatenate([group.jacobian for group in fit.information.groups])
    noise = gain.T @ gain

    def root(part: np.ndarray) -> np.ndarray:
        return np.sqrt(np.maximum(np.einsum("qi,ij,qj->q", spread, part, spread), 0.0))

    def freedom(names: list[str]) -> float:
        logs = [np.log(fit.draws.physical[:, INDEX[name]]) for name in names]
        spreads = [float(np.var(x)) for x in logs if np.ptp(x) > 1e-9]
        return min((0.5 / s for s in spreads), default=np.inf)

    # The two directions of the axis that a quantity belongs to.
    axes = {name: DIRECTIONS[:2] for name in ("pan", *DIRECTIONS[:2])}
    axes |= {name: DIRECTIONS[2:] for name in ("tilt", *DIRECTIONS[2:])}
    stops = [freedom([f"stop_sd_deg.{d}" for d in axes[q.split(".")[1]] if d in moved]) for q in columns]
    readings = bool(np.any(np.asarray(fit.arrays.spots.has_aperture) * np.asarray(fit.arrays.spots.valid)))
    pixels = "pixel and aperture noise" if readings else "pixel noise"
    every = np.ones(len(columns))
    cameras = np.linalg.norm(spread[:, len(RIG_NAMES) :], axis=1)
    shaken = root(fit.information.fisher - noise)
    # Name, contribution, u, centre, distribution, degrees of freedom.
    rows = [
        (pixels, root(noise), np.nan, np.nan, "normal", freedom(["pixel_scale"]) * every),
        ("stop errors of the campaign", shaken, np.nan, np.nan, "normal", np.array(stops)),
        ("stereo calibration", cameras, np.nan, np.nan, "normal", np.inf * every),
    ]
    space = fit.space
    for name, value, u, kind in zip(
        RIG_NAMES, *(np.asarray(x) for x in (space.value, space.u, space.kind)), strict=True
    ):
        if u == 0 or not np.any(spread[:, INDEX[name]]):
            continue
        shape, centre, width = KINDS[int(kind)], float(value), float(u)
        if shape == "log-normal":
            centre = float(np.log(centre))
        elif shape == "half-normal":
            centre, width = width * HALF_NORMAL_MEAN, width * HALF_NORMAL_SD
        rows.append((name, spread[:, INDEX[name]], width, centre, shape, np.inf * every))
    kept = [row for row in rows if np.any(row[1] != 0)]
    names, contribution, widths, centres, shapes, dof = zip(*kept, strict=True)
    return HeadlineCauses(
        quantities=tuple(columns),
        names=names,
        contribution=np.stack(contribution, axis=1),
        u=np.array(widths, dtype=float),
        centre=np.array(centres, dtype=float),
        distribution=shapes,
        dof=np.stack(dof, axis=1),
    )
