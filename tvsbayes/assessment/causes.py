"""Causes of uncertainty: of ratios and backlashes, and of the inputs of a coordinate.

The expected information is in coordinates, each in sds of its prior, so that every prior has precision 1; noise scales
are taken as known. Quantities in the units of their names.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from tvsbayes.assessment.weaknesses import moved_directions, whole_gradients
from tvsbayes.calibration.pointing import COMPLEX_STEP, INPUT_NAMES
from tvsbayes.calibration.states import ZERO_NAMES, total_shift
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.estimators.linear_spots import linear_spots, stop_information
from tvsbayes.gears.priors import HALF_NORMAL_MEAN, HALF_NORMAL_SD
from tvsbayes.instrument.axes import AXES, DIRECTIONS, SENSES, Axis
from tvsbayes.instrument.parameters import HEADLINES, INDEX, KINDS, NAMES, QUANTITIES, unit_of
from tvsbayes.metrology.budget_tables import BudgetTable, Source, budget_table
from tvsbayes.model.parameter_space import physical_at
from tvsbayes.results.estimates import Estimate, HeadlineCauses
from tvsbayes.statistics.predicted_readings import State

STOP_ERRORS = "stop errors of the campaign"
LOOK_SCATTER = "scatter of the campaign's looks"
TRANSMISSION_ERROR, PLAY_VARIATION = "transmission error", "play variation"
PRIOR_PARTS = (TRANSMISSION_ERROR, PLAY_VARIATION, "stereo calibration")
"""Causes of many coordinates each, with a prior: type B of the GUM, as every single prior."""


@dataclass(frozen=True)
class _SplitInformation:
    """Information J^T C^-1 J of a campaign on coordinates and errors at places, split by noise.

    With C = 1 + (stop errors), whitened by the noise of looks, it is (C^-1 J)^T (C^-1 J) and a remainder; matrices (p +
    e, p + e). Of the unit noise b S b^T is the scatter of looks, b the slopes by the angles and S their variances.

    Attributes:
        pixels: name of the noise of the first part.
        by_pixels, by_looks, by_stops: the parts.
        posterior: inverse of the sum of all parts and the priors.
        groups: coordinates and errors by their prior.
    """

    pixels: str
    by_pixels: np.ndarray
    by_looks: np.ndarray
    by_stops: np.ndarray
    posterior: np.ndarray
    groups: dict[str, list[int]]


def _split_information(fit: JointFit) -> _SplitInformation:
    linear = linear_spots(fit.linearised, fit.arrays, fit.linearised.by_coordinates(fit.held))
    information = stop_information(linear.spelled_out(linear.places))
    gain = np.concatenate([group.jacobian for group in information.groups])
    noise, of_play = gain.T @ gain, fit.arrays.gears.of_play
    scattered = np.einsum("nia,nip->nap", fit.linearised.slope, gain.reshape(-1, 4, gain.shape[1]))
    scattered *= np.sqrt(fit.linearised.scatter_variance)[:, :, None]
    by_looks = np.einsum("nap,naq->pq", scattered, scattered)
    error_columns = len(NAMES) + np.arange(len(of_play))
    groups = dict(fit.space.mechanism.prior_groups)
    groups |= {TRANSMISSION_ERROR: error_columns[~of_play].tolist(), PLAY_VARIATION: error_columns[of_play].tolist()}
    return _SplitInformation(
        "pixel and aperture noise" if fit.arrays.read.any() else fit.space.mechanism.noise,
        noise - by_looks,
        by_looks,
        information.fisher - noise,
        np.linalg.inv(information.fisher + np.eye(len(noise))),
        {cause: columns for cause, columns in groups.items() if columns},
    )


@dataclass(frozen=True)
class Causes:
    """Covariance of the inputs of a coordinate by cause.

    Attributes:
        names: causes.
        covariance: their parts, shape (causes, inputs, inputs), ordered as `INPUT_NAMES`, then further inputs; they add
            up.
    """

    names: tuple[str, ...]
    covariance: np.ndarray


def causes_of(fit: JointFit, by_places: np.ndarray | None = None, states: Mapping[Axis, State] | None = None) -> Causes:
    """Split the covariance of a fit by cause (formulation 5).

    An error e of the data shifts an estimate by S J^T C^-1 e, an error of prior j by its sd by S e_j, with S the
    posterior covariance. With C = 1 + (stop errors) the parts S (C^-1 J)^T (C^-1 J) S (pixels, and the scatter of looks
    within it), S (J^T C^-1 J - that) S and S e_j e_j^T S add up to S. The information is the expected one on geometry
    and cameras; noise scales are taken as known.

    Args:
        fit: a converged fit.
        by_places: further inputs, as d(input)/d(errors at places, N(0, 1) a priori), shape (inputs, errors).
        states: by axis, at which the zeros are inputs; None: at the homing.
    """
    information = _split_information(fit)
    parts = {
        information.pixels: information.by_pixels,
        LOOK_SCATTER: information.by_looks,
        STOP_ERRORS: information.by_stops,
    }
    for stem, columns in information.groups.items():
        share = np.zeros_like(information.posterior)
        share[columns, columns] = 1.0
        parts[stem] = share
    inputs = [INDEX[name] for name in INPUT_NAMES]
    at = physical_at(fit.z, fit.space)
    slopes = np.asarray(at.slope)
    slope, own_names = slopes[inputs], fit.space.mechanism.named(INPUT_NAMES)
    moved = np.asarray(at.value) + 1j * COMPLEX_STEP * np.eye(len(NAMES))
    for (axis, state), zero in zip((states or {}).items(), fit.space.mechanism.zeros, strict=bool(states)):
        shift = total_shift({name: moved[:, INDEX[name]] for name in ZERO_NAMES}, axis, state)[:, 0]
        slope[own_names.index(zero)] += shift.imag / COMPLEX_STEP @ slopes
    spread = slope @ information.posterior[: len(NAMES)]
    if by_places is not None:
        spread = np.concatenate([spread, by_places @ information.posterior[len(NAMES) :]])
    covariance = {name: spread @ part @ spread.T for name, part in parts.items()}
    # A fixed prior, or one without effect on any input, is no cause.
    kept = {name: c for name, c in covariance.items() if np.any(np.diag(c) > 0)}
    return Causes(tuple(kept), np.stack(list(kept.values())))


@dataclass(frozen=True)
class _Cause:
    """One column of `HeadlineCauses`; contribution and dof of shape (quantities,)."""

    name: str
    contribution: np.ndarray
    dof: np.ndarray
    distribution: str = "normal"
    centre: float = math.nan
    u: float = math.nan


def headline_causes(fit: JointFit) -> HeadlineCauses:
    """Split the variance of ratios and backlashes by cause, as `causes_of` does for the inputs of a coordinate.

    It uses the linear part of each headline in the coordinates and the expected information at known noise scales. The
    uncertainty of the noise scales gives the degrees of freedom: nu = 1/(2 var(ln s)) (GUM G.4.2, eq. G.3).
    """
    columns = _headline_draws(fit)
    if not columns:
        none = np.zeros((0, 0))
        return HeadlineCauses((), (), none, np.zeros(0), np.zeros(0), (), none)
    information = _split_information(fit)
    spread = whole_gradients(fit, np.stack(list(columns.values()), axis=1)) @ information.posterior
    causes = [*_noise_causes(fit, information, tuple(columns), spread), *_prior_causes(fit, spread)]
    kept = [cause for cause in causes if np.any(cause.contribution != 0)]
    return HeadlineCauses(
        quantities=tuple(columns),
        names=tuple(cause.name for cause in kept),
        contribution=np.stack([cause.contribution for cause in kept], axis=1),
        u=np.array([cause.u for cause in kept]),
        centre=np.array([cause.centre for cause in kept]),
        distribution=tuple(cause.distribution for cause in kept),
        dof=np.stack([cause.dof for cause in kept], axis=1),
    )


def _headline_draws(fit: JointFit) -> dict[str, np.ndarray]:
    """Return draws of judged headlines whose directions moved, by name."""
    moved = moved_directions(fit)
    names = [of.name for of in HEADLINES if of.judged and of.applies(moved) and moved & set(of.sides or DIRECTIONS)]
    return {name: fit.draws[name] for name in names}


def _noise_causes(
    fit: JointFit, information: _SplitInformation, quantities: tuple[str, ...], spread: np.ndarray
) -> list[_Cause]:
    """Compute causes other than single priors: noise of the campaign, errors of the gears, the cameras' calibration."""
    moved, every = moved_directions(fit), np.ones(len(quantities))
    physical = np.asarray(fit.draws.physical)

    def root(part: np.ndarray) -> np.ndarray:
        return np.sqrt(np.maximum(np.einsum("qi,ij,qj->q", spread, part, spread), 0.0))

    def freedom(names: Iterable[str]) -> float:
        logs = [np.log(physical[:, INDEX[name]]) for name in names]
        spreads = [float(np.var(x)) for x in logs if np.ptp(x) > 1e-9]
        return min((0.5 / s for s in spreads), default=np.inf)

    def sides(quantity: str) -> tuple[str, ...]:
        return QUANTITIES[quantity].sides or DIRECTIONS

    def stop_freedom(quantity: str) -> float:
        return freedom(f"stop_sd_deg.{d}" for d in sides(quantity) if d in moved)

    def look_freedom(quantity: str) -> float:
        # A scale that may be 0 has no logarithm; its relative sd is used.
        drawn = [fit.draws[f"look_scatter_deg.{axis}"] for axis in AXES if set(SENSES[axis]) <= set(sides(quantity))]
        known = [0.5 * (float(np.mean(sds)) / float(np.std(sds))) ** 2 for sds in drawn if np.ptp(sds) > 0]
        return min(known, default=np.inf)

    return [
        _Cause(information.pixels, root(information.by_pixels), freedom(["pixel_scale"]) * every),
        _Cause(LOOK_SCATTER, root(information.by_looks), np.array([look_freedom(q) for q in quantities])),
        _Cause(STOP_ERRORS, root(information.by_stops), np.array([stop_freedom(q) for q in quantities])),
        *(
            _Cause(name, np.linalg.norm(spread[:, information.groups[name]], axis=1), np.inf * every)
            for name in PRIOR_PARTS
            if name in information.groups
        ),
    ]


def _prior_causes(fit: JointFit, spread: np.ndarray) -> list[_Cause]:
    """Compute the causes of all stated priors of the rig that a quantity depends on."""
    causes = []
    stated = (np.asarray(x).tolist() for x in (fit.space.value, fit.space.u, fit.space.kind))
    for column, (name, centre, u, kind) in enumerate(zip(fit.space.mechanism.rig_names, *stated, strict=True)):
        contribution, shape = spread[:, column], KINDS[kind]
        if u == 0 or not np.any(contribution):
            continue
        if shape == "log-normal":
            centre = math.log(centre)
        elif shape == "half-normal":
            centre, u = u * HALF_NORMAL_MEAN, u * HALF_NORMAL_SD
        causes.append(_Cause(name, contribution, np.full(len(spread), np.inf), shape, centre, u))
    return causes


def headline_budget(causes: HeadlineCauses, quantity: str, estimate: Estimate) -> BudgetTable:
    """Build the budget of an effective ratio or a backlash, by cause.

    Rows are independent of each other: noise of the campaign (type A); repeating errors of the gears, the cameras'
    calibration as a whole, and every stated prior (type B). The sensitivity c is the shift of the estimate when the
    centre of a prior shifts by one unit.

    Args:
        causes: from `headline_causes`.
        quantity: one of its quantities.
        estimate: its reported estimate, Laplace or posterior; its sd is the combined uncertainty.
    """
    row = causes.quantities.index(quantity)
    sources = []
    for k, name in enumerate(causes.names):
        contribution, dof = float(causes.contribution[row, k]), float(causes.dof[row, k])
        if math.isnan(causes.u[k]):
            kind = "B" if name in PRIOR_PARTS else "A"
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
