"""Causes of uncertainty: of ratios and backlashes, and of the inputs of a coordinate.

The expected information is in coordinates, each in sds of its prior, so that every prior has precision 1; noise scales
are taken as known. Quantities in the units of their names.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tvsbayes.assessment.headlines import gradients, judged_headlines, moved_directions, sds
from tvsbayes.calibration.pointing import COMPLEX_STEP, input_names
from tvsbayes.calibration.states import ZERO_NAMES, total_shift
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.estimators.linear_spots import linear_spots, stop_information
from tvsbayes.gears.priors import HALF_NORMAL_MEAN, HALF_NORMAL_SD
from tvsbayes.instrument.axes import AXES, DIRECTIONS, SENSES, Axis
from tvsbayes.instrument.parameters import KINDS, unit_of
from tvsbayes.instrument.quantities import Quantity
from tvsbayes.metrology.budget_tables import BudgetTable, Source, budget_table
from tvsbayes.model.parameter_space import named_at, physical_at
from tvsbayes.results.estimates import Estimate, HeadlineCauses
from tvsbayes.statistics.predicted_readings import State

STOP_ERRORS = "stop errors of the campaign"
LOOK_SCATTER = "scatter of the campaign's looks"
TRANSMISSION_ERROR, PLAY_VARIATION = "transmission error", "play variation"
PRIOR_PARTS = (TRANSMISSION_ERROR, PLAY_VARIATION, "stereo calibration")
"""Causes of many coordinates each, with a prior: type B of the GUM, as every single prior."""


@dataclass(frozen=True)
class _SplitInformation:
    """Information J^T C^-1 J of a campaign on coordinates and errors at places, split by noise; all (p + e, p + e).

    With C = 1 + (stop errors), whitened by the noise of looks, it is (C^-1 J)^T (C^-1 J) and a remainder. Of the unit
    noise b S b^T is the scatter of looks, b the slopes by the angles and S their variances.

    Attributes:
        noises: parts by cause: the looks' own noise, then `LOOK_SCATTER`, `STOP_ERRORS`.
        posterior: inverse of the sum of all parts and the priors.
        groups: coordinates and errors by their prior.
    """

    noises: dict[str, np.ndarray]
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
    errors = len(fit.z) + np.arange(len(of_play))
    groups = dict(fit.space.mechanism.prior_groups)
    groups |= {TRANSMISSION_ERROR: errors[~of_play].tolist(), PLAY_VARIATION: errors[of_play].tolist()}
    own = "pixel and aperture noise" if fit.arrays.read.any() else fit.space.mechanism.noise
    return _SplitInformation(
        {own: noise - by_looks, LOOK_SCATTER: by_looks, STOP_ERRORS: information.fisher - noise},
        np.linalg.inv(information.fisher + np.eye(len(noise))),
        {cause: columns for cause, columns in groups.items() if columns},
    )


def causes_of(
    fit: JointFit, by_places: np.ndarray | None = None, states: Mapping[Axis, State] | None = None
) -> dict[str, np.ndarray]:
    """Split the covariance of the inputs of a coordinate by cause (formulation 5).

    An error e of the data shifts an estimate by S J^T C^-1 e, an error of prior j by its sd by S e_j, with S the
    posterior covariance. With C = 1 + (stop errors) the parts S (C^-1 J)^T (C^-1 J) S (pixels, and the scatter of looks
    within it), S (J^T C^-1 J - that) S and S e_j e_j^T S add up to S. The information is the expected one on geometry
    and cameras; noise scales are taken as known.

    Args:
        fit: a converged fit.
        by_places: further inputs, as d(input)/d(errors at places, N(0, 1) a priori), shape (inputs, errors).
        states: by axis, at which the zeros are inputs; None: at the homing.

    Returns:
        Parts (inputs, inputs) by cause, ordered as `input_names`, then further inputs; they add up.
    """
    information = _split_information(fit)
    priors = {cause: np.isin(range(len(information.posterior)), own) for cause, own in information.groups.items()}
    parts = information.noises | {cause: np.diag(own.astype(float)) for cause, own in priors.items()}
    mechanism, at = fit.space.mechanism, physical_at(fit.z, fit.space)
    own_names, slopes = input_names(mechanism), np.asarray(at.slope)
    slope = named_at(at, mechanism, own_names).slope
    moved = np.asarray(at.value) + 1j * COMPLEX_STEP * np.eye(len(slopes))
    for (axis, state), zero in zip((states or {}).items(), mechanism.zeros, strict=bool(states)):
        shift = total_shift({name: moved[:, mechanism.index[name]] for name in ZERO_NAMES}, axis, state)[:, 0]
        slope[own_names.index(zero)] += shift.imag / COMPLEX_STEP @ slopes
    spread = slope @ information.posterior[: len(slopes)]
    if by_places is not None:
        spread = np.concatenate([spread, by_places @ information.posterior[len(slopes) :]])
    covariance = {name: spread @ part @ spread.T for name, part in parts.items()}
    # A fixed prior, or one without effect on any input, is no cause.
    return {name: c for name, c in covariance.items() if np.any(np.diag(c) > 0)}


class _Cause(NamedTuple):
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
    moved = moved_directions(fit)
    quantities = [of for of in judged_headlines(fit) if moved & set(of.sides or DIRECTIONS)]
    if not quantities:
        none = np.zeros((0, 0))
        return HeadlineCauses((), (), none, np.zeros(0), np.zeros(0), (), none)
    information, names = _split_information(fit), tuple(of.name for of in quantities)
    drawn = np.stack([fit.draws[name] for name in names], axis=1)
    spread = gradients(fit, drawn, places=True) @ information.posterior
    causes = [*_noise_causes(fit, information, quantities, spread), *_prior_causes(fit, spread)]
    kept = [cause for cause in causes if np.any(cause.contribution != 0)]
    labels, contribution, dof, distribution, centre, u = zip(*kept, strict=True)
    return HeadlineCauses(
        quantities=names,
        names=labels,
        contribution=np.stack(contribution, axis=1),
        u=np.array(u),
        centre=np.array(centre),
        distribution=distribution,
        dof=np.stack(dof, axis=1),
    )


def _noise_causes(
    fit: JointFit, information: _SplitInformation, quantities: list[Quantity], spread: np.ndarray
) -> Iterator[_Cause]:
    """Compute causes other than single priors: noise of the campaign, errors of the gears, the cameras' calibration."""
    moved, physical = moved_directions(fit), np.asarray(fit.draws.physical)

    def freedom(names: Iterable[str]) -> float:
        logs = [np.log(physical[:, fit.names.index(name)]) for name in names]
        spreads = [float(np.var(x)) for x in logs if np.ptp(x) > 1e-9]
        return min((0.5 / s for s in spreads), default=np.inf)

    def look_freedom(sides: Iterable[str]) -> float:
        # A scale that may be 0 has no logarithm; its relative sd is used.
        drawn = [fit.draws[f"look_scatter_deg.{axis}"] for axis in AXES if set(SENSES[axis]) <= set(sides)]
        known = [0.5 * (float(np.mean(sds)) / float(np.std(sds))) ** 2 for sds in drawn if np.ptp(sds) > 0]
        return min(known, default=np.inf)

    sides = [of.sides or DIRECTIONS for of in quantities]
    dof = (
        [freedom(["pixel_scale"])] * len(sides),
        [look_freedom(each) for each in sides],
        [freedom(f"stop_sd_deg.{d}" for d in each if d in moved) for each in sides],
    )
    for (name, part), of_noise in zip(information.noises.items(), dof, strict=True):
        yield _Cause(name, sds(spread, part), np.array(of_noise))
    for name in PRIOR_PARTS:
        if name in information.groups:
            contribution = np.linalg.norm(spread[:, information.groups[name]], axis=1)
            yield _Cause(name, contribution, np.full(len(sides), np.inf))


def _prior_causes(fit: JointFit, spread: np.ndarray) -> Iterator[_Cause]:
    """Compute the causes of all stated priors of the rig that a quantity depends on."""
    stated = (np.asarray(x).tolist() for x in (fit.space.value, fit.space.u, fit.space.kind))
    for column, (name, centre, u, kind) in enumerate(zip(fit.space.mechanism.rig_names, *stated, strict=True)):
        contribution, shape = spread[:, column], KINDS[kind]
        if u == 0 or not np.any(contribution):
            continue
        if shape == "log-normal":
            centre = math.log(centre)
        elif shape == "half-normal":
            centre, u = u * HALF_NORMAL_MEAN, u * HALF_NORMAL_SD
        yield _Cause(name, contribution, np.full(len(spread), np.inf), shape, centre, u)


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
    row, sources = causes.quantities.index(quantity), []
    for k, name in enumerate(causes.names):
        contribution, dof, shape = causes.contribution[row, k], float(causes.dof[row, k]), causes.distribution[k]
        if math.isnan(u := float(causes.u[k])):
            kind = "B" if name in PRIOR_PARTS else "A"
            source = Source(name, unit_of(quantity), None, abs(float(contribution)), kind, shape, dof, 1.0)
        else:
            label, unit = (f"ln {name}", "1") if shape == "log-normal" else (name, unit_of(name))
            values = float(causes.centre[k]), u, "B", shape, dof, float(contribution) / u
            source = Source(f"prior of {label}", unit, *values)
        sources.append(source)
    notes = (
        "inputs are independent; the last row is what the curvature of the density and the spread of the noise scales "
        "add to linear propagation",
    )
    return budget_table(quantity, unit_of(quantity), estimate.value, estimate.sd, sources, notes=notes)
