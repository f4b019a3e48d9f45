"""Sensitivity of the headlines to each stated prior: its u doubled and halved.

Draws of a posterior are weighted by the ratio of the priors, which is exact. The normal distribution with the same
moments is changed instead for the Laplace approximation, and where too few draws have weight (a prior of many
coordinates, or a parameter with little information).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tvsbayes.assessment.headlines import judged_headlines, linear_headlines, scatters, sds
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.gears.priors import half_normal
from tvsbayes.instrument.parameters import KINDS
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


class Change(NamedTuple):
    """Change of the headlines: shift in their present sds, and new sd over the present one; shape (quantities,)."""

    shift_sd: np.ndarray
    sd_ratio: np.ndarray


class NormalModel(NamedTuple):
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
        before = sds(self.gradient, np.linalg.inv(self.precision))
        return Change(self.gradient @ (mean - self.mean) / self.sd, sds(self.gradient, covariance) / before)


class SampledHeadlines(NamedTuple):
    """Draws of the free coordinates z (n, d) and of headlines (n, quantities), with weights (n,)."""

    z: np.ndarray
    values: np.ndarray
    weights: np.ndarray
    half: np.ndarray
    """Coordinates whose quantity is half-normal a priori, shape (d,)."""

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


def prior_sensitivity(fit: JointFit, posterior: Posterior | None = None) -> tuple[PriorSensitivity, ...]:
    """Double and halve the u of each prior in turn; the stereo calibration is one prior of many coordinates.

    Args:
        fit: a joint fit.
        posterior: its sample; without it the Laplace approximation is changed, with a half-normal prior as normal in
            its coordinate.

    Returns:
        Priors that change a headline noticeably, largest first.
    """
    rows, names = np.flatnonzero(fit.free), np.array(fit.names)[fit.free]
    sampled = None
    if posterior is None:
        labels, gradients, _ = linear_headlines(fit)
        free, covariance = gradients[:, rows], fit.covariance[np.ix_(rows, rows)]
        normal = NormalModel(fit.z[rows], np.linalg.inv(covariance), free, sds(free, covariance))
    else:
        drawn = {of.label: posterior.joined[of.name] for of in judged_headlines(fit)}
        drawn = {label: draws for label, draws in drawn.items() if scatters(draws)}
        kinds = np.append(fit.space.kind, np.zeros(len(fit.names) - len(fit.space.kind)))
        half, values = kinds[rows] == KINDS.index("half-normal"), np.stack(list(drawn.values()), axis=1)
        sampled = SampledHeadlines(posterior.joined_z[:, rows], values, posterior.weights.ravel(), half)
        labels, normal = tuple(drawn), sampled.normal
    groups = {str(name): np.flatnonzero(names == name) for name in names if not name.startswith("stereo.")}
    groups["stereo calibration"] = np.flatnonzero(np.char.startswith(names, "stereo."))
    changes = []
    for parameter, members in groups.items():
        for factor in FACTORS:
            change = None if sampled is None else sampled.changed(members, factor)
            shifts, ratios = normal.changed(members, factor) if change is None else change
            for label, shift, ratio in zip(labels, shifts.tolist(), ratios.tolist(), strict=True):
                if abs(shift) > SENSITIVE_SHIFT or abs(np.log(ratio)) > np.log1p(SENSITIVE_SD):
                    changes.append(PriorSensitivity(parameter, label, factor, shift, ratio))
    changes.sort(key=lambda e: -max(abs(e.shift_sd), abs(np.log(e.sd_ratio))))
    return tuple(changes[:LISTED])
