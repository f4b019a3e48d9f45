"""Judged headlines of a fit, and their linear parts in the coordinates, each in sds of its prior."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tvsbayes.estimators.joint_fit import JointFit, with_places
from tvsbayes.instrument.parameters import HEADLINES
from tvsbayes.instrument.quantities import Quantity
from tvsbayes.instrument.stops import legs_of


def moved_directions(fit: JointFit) -> set[str]:
    """Return the directions in which the campaign ever moved."""
    return set(legs_of(fit.campaign.moves))


def judged_headlines(fit: JointFit) -> list[Quantity]:
    """Return the judged headlines that the campaign has."""
    moved = moved_directions(fit)
    return [of for of in HEADLINES if of.judged and of.applies(moved)]


def scatters(draws: np.ndarray) -> bool:
    """Whether draws differ by more than rounding, as those of a quantity fixed by the priors do not."""
    return bool(np.ptp(draws) > 1e-12 * np.max(np.abs(draws)))


def sds(gradients: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Standard deviations (q,) of quantities with gradients (q, p)."""
    return np.sqrt(np.maximum(np.einsum("qi,ij,qj->q", gradients, covariance, gradients), 0.0))


def gradients(fit: JointFit, values: np.ndarray, *, places: bool = False) -> np.ndarray:
    """Compute d(quantity)/d(coordinates), shape (q, p), of quantities with values (draws, q) on the Laplace draws.

    Regression on the moment-matched draws gives the gradient of the linear part, averaged over the posterior. With
    `places` the errors there are further columns.
    """
    draws, covariance = fit.draws_z, fit.covariance
    if places:
        draws = np.concatenate([draws, fit.draws_places], axis=1)
        covariance = with_places(fit.z, covariance, fit.information).covariance
    cross = (values - values.mean(axis=0)).T @ (draws - draws.mean(axis=0)) / len(draws)
    return np.linalg.solve(covariance, cross.T).T


class LinearHeadlines(NamedTuple):
    """Judged headlines that scatter: labels (q,), gradients (q, p), standard deviations (q,)."""

    labels: tuple[str, ...]
    gradients: np.ndarray
    sd: np.ndarray


def linear_headlines(fit: JointFit) -> LinearHeadlines:
    """Linearise the judged headlines of a fit."""
    index = fit.space.mechanism.index
    # Parameters in coordinates, where a backlash is Gaussian.
    drawn = {
        of.label: fit.draws_z[:, index[of.name]] if of.name in index else fit.draws[of.name]
        for of in judged_headlines(fit)
    }
    drawn = {label: draws for label, draws in drawn.items() if scatters(draws)}
    slopes = gradients(fit, np.stack(list(drawn.values()), axis=1))
    return LinearHeadlines(tuple(drawn), slopes, sds(slopes, fit.covariance))
