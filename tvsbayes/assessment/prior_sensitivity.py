"""Sensitivity of the headlines to each stated prior: its u doubled and halved.

Draws of a posterior are weighted by the ratio of the priors, which is exact. The normal distribution with the same
moments is changed instead for the Laplace approximation, and where too few draws have weight (a prior of many
coordinates, or a parameter with little information).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tvsbayes.assessment.weaknesses import headline_gradients, judged_headlines
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.gears.priors import half_normal
from tvsbayes.instrument.parameters import HEADLINES, KINDS, NAMES
from tvsbayes.posterior.draws import Posterior
from tvsbayes.results.estimates import PriorSensitivity
from tvsbayes.statistics.weighted_draws import effective_draws, smoothed_weights, weighted_mean

FACTORS = 2.0, 0.5
"""Factors on the u of a prior."""
SENSITIVE_SHIFT = 0.2
"""Shift of a headline, in its sds, from which a prior is listed."""
SENSITIVE_SD = 0.1
"""Relative change of a headline's sd from which it is listed."""
LISTED = 16
"""Largest number of changes listed."""
K_LIMIT, ENOUGH = 0.5, 1000
"""Tail index of the new weights below which they are reliable, and least effective draws: two sds out in a posterior,
where a prior in conflict with the data shifts it, there are few draws."""


@dataclass(frozen=True)
class Change:
    """Change of the headlines: shift in their present sds, and new sd over the present one; shape (quantities,)."""

    shift_sd: np.ndarray
    sd_ratio: np.ndarray


@dataclass(frozen=True)
class NormalModel:
    """A normal approximation of the d free coordinates, with linear headlines.

    Attributes:
        mean: shape (d,).
        precision: precision, including that of the priors (the identity), shape (d, d).
        gradient: gradients of the headlines, shape (quantities, d).
        sd: standard deviations of the headlines, shape (quantities,).
    """

    mean: np.ndarray
    precision: np.ndarray
    gradient: np.ndarray
    sd: np.ndarray

    def changed(self, members: np.ndarray, factor: float) -> Change:
        """Compute the change for a factor on some priors' u, which divides their precision 1 by its square."""
        precision = self.precision.copy()
        precision[members, members] += factor**-2 - 1
        values, vectors = np.linalg.eigh(precision)
        # Data only add to the precision of the priors, even if draws scatter more than these.
        covariance = (vectors / np.maximum(values, min(1.0, factor**-2))) @ vectors.T
        # The data's score at zero does not change.
        mean = covariance @ (self.precision @ self.mean)
        variance = np.einsum("qi,ij,qj->q", self.gradient, covariance, self.gradient)
        before = np.einsum("qi,ij,qj->q", self.gradient, np.linalg.inv(self.precision), self.gradient)
        return Change(self.gradient @ (mean - self.mean) / self.sd, np.sqrt(variance / before))


@dataclass(frozen=True)
class SampledHeadlines:
    """Draws of the free coordinates z (n, d) and of the headlines `labels` (n, quantities), with weights (n,)."""

    z: np.ndarray
    values: np.ndarray
    weights: np.ndarray
    half: np.ndarray
    """Coordinates whose quantity is half-normal a priori, shape (d,)."""
    labels: tuple[str, ...] = ()

    @property
    def normal(self) -> NormalModel:
        """Return the normal approximation with the moments of the draws."""
        mean, centre = weighted_mean(self.z, self.weights), weighted_mean(self.values, self.weights)
        away, off = self.z - mean, self.values - centre
        precision = np.linalg.inv((away * self.weights[:, None]).T @ away)
        gradient = (off * self.weights[:, None]).T @ away @ precision
        return NormalModel(mean, precision, gradient, np.sqrt(self.weights @ off**2))

    def changed(self, members: np.ndarray, factor: float) -> Change | None:
        """Compute the change by the ratio of the priors; None where too few draws have weight."""
        z = self.z[:, members]
        # The prior is in units of the stated u: the value of a half-normal quantity, the coordinate of all others.
        stated = np.where(self.half[members], half_normal(z), z)
        log_ratio = -0.5 * (factor**-2 - 1) * np.sum(stated**2, axis=1)
        weights = smoothed_weights(np.log(np.maximum(self.weights, np.finfo(float).tiny)) + log_ratio)
        if weights.pareto_k >= K_LIMIT or effective_draws(weights.weights) < ENOUGH:
            return None
        mean, centre = weighted_mean(self.values, weights.weights), weighted_mean(self.values, self.weights)
        sd = np.sqrt(self.weights @ (self.values - centre) ** 2)
        return Change((mean - centre) / sd, np.sqrt(weights.weights @ (self.values - mean) ** 2) / sd)


def sampled_headlines(fit: JointFit, moved: set[str], posterior: Posterior) -> SampledHeadlines:
    """Return judged headlines of a posterior's draws."""
    draws, rows = posterior.joined, np.flatnonzero(fit.free)
    columns = {of.label: draws[of.name] for of in HEADLINES if of.judged and of.applies(moved)}
    columns = {name: values for name, values in columns.items() if np.ptp(values) > 1e-12 * np.max(np.abs(values))}
    half = np.zeros(len(NAMES), dtype=bool)
    half[: len(fit.space.kind)] = np.asarray(fit.space.kind) == KINDS.index("half-normal")
    values, weights = np.stack(list(columns.values()), axis=1), posterior.weights.ravel()
    return SampledHeadlines(posterior.joined_z[:, rows], values, weights, half[rows], tuple(columns))


def prior_sensitivity(
    fit: JointFit, moved: set[str], posterior: Posterior | None = None
) -> tuple[PriorSensitivity, ...]:
    """Double and halve the u of each prior in turn; the stereo calibration is one prior of many coordinates.

    Args:
        fit: a joint fit.
        moved: directions in which the campaign ever moved.
        posterior: its sample; without it the Laplace approximation is changed, with a half-normal prior as normal in
            its coordinate.

    Returns:
        Priors that change a headline noticeably, largest first.
    """
    rows = np.flatnonzero(fit.free)
    sampled = None
    if posterior is None:
        headlines = judged_headlines(fit, moved)
        quantities, gradient = tuple(headlines), headline_gradients(fit, headlines)
        covariance = fit.covariance[np.ix_(rows, rows)]
        gradient = gradient[:, rows]
        sd = np.sqrt(np.einsum("qi,ij,qj->q", gradient, covariance, gradient))
        normal = NormalModel(fit.z[rows], np.linalg.inv(covariance), gradient, sd)
    else:
        sampled = sampled_headlines(fit, moved, posterior)
        quantities, normal = sampled.labels, sampled.normal
    names = np.array(fit.names)[rows]
    groups = {name: np.flatnonzero(names == name) for name in names if not name.startswith("stereo.")}
    groups["stereo calibration"] = np.flatnonzero(np.char.startswith(names, "stereo."))
    changes = []
    for parameter, members in groups.items():
        for factor in FACTORS:
            change = None if sampled is None else sampled.changed(members, factor)
            change = normal.changed(members, factor) if change is None else change
            for quantity, shift, ratio in zip(quantities, change.shift_sd, change.sd_ratio, strict=True):
                if abs(shift) > SENSITIVE_SHIFT or abs(np.log(ratio)) > np.log1p(SENSITIVE_SD):
                    changes.append(PriorSensitivity(str(parameter), quantity, factor, float(shift), float(ratio)))
    changes.sort(key=lambda e: -max(abs(e.shift_sd), abs(np.log(e.sd_ratio))))
    return tuple(changes[:LISTED])
