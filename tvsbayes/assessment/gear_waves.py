"""Waves of stated period in the gears of a scanner: amplitude, phase, and the probability that there is one.

A wave is a cos(2 pi x / P) + b sin(2 pi x / P) of the output's angle x = k n; a and b are normal with sd A, which is
half-normal (formulation 3.1). Given the errors at the places, a and b are normal too. deg.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tvsbayes.assessment.gear_tables import BLOCK, Process, process_of, seen_places
from tvsbayes.calibration.optics import ERROR_AT
from tvsbayes.instrument.axes import AXES
from tvsbayes.model.headlines import DEGREES
from tvsbayes.posterior.draws import Posterior
from tvsbayes.results.estimates import GearPeriod, Measured
from tvsbayes.statistics.intervals import interval95, phases_deg
from tvsbayes.statistics.streams import Stream, random_stream

DRAWS = 2048
"""Draws of equal weight: the error of a mean is 1/45 of its sd, that of a probability at most 0.011."""


@dataclass(frozen=True)
class WaveDraws:
    """One wave, a row for every draw of the posterior.

    Attributes:
        cosine, sine: its parts, deg, shape (draws,).
        log_evidence_ratio: log density ratio of the errors at the places, without the wave to with it, shape (draws,).
    """

    cosine: np.ndarray
    sine: np.ndarray
    log_evidence_ratio: np.ndarray

    @property
    def probability(self) -> float:
        """Compute the probability of a wave, for prior odds of one.

        The posterior mean of p(errors | no wave) / p(errors | wave) is the ratio of both evidences, since looks depend
        on the wave through the errors alone.
        """
        none = float(np.mean(np.exp(self.log_evidence_ratio)))
        return 1 / (1 + none)

    @property
    def amplitude(self) -> np.ndarray:
        """Compute the amplitude, half of crest to trough, deg, shape (draws,)."""
        return np.hypot(self.cosine, self.sine)

    @property
    def phase_deg(self) -> np.ndarray:
        """Compute phases within half a turn of their circular mean, shape (draws,)."""
        return phases_deg(self.cosine, self.sine)


def wave_draws(
    process: Process, number: int, angle_deg: np.ndarray, errors_deg: np.ndarray, normal: np.ndarray
) -> WaveDraws:
    """Draw the wave of one stated period, given the errors at places.

    Args:
        process: scales by draw.
        number: index of the period in `process.periods`.
        angle_deg: angles of the places, shape (draws, p).
        errors_deg: transmission errors at the places, shape (draws, p).
        normal: standard normal numbers, shape (draws, 2).
    """
    parts, ratio = np.empty((len(errors_deg), 2)), np.empty(len(errors_deg))
    for begin in range(0, len(errors_deg), BLOCK):
        rows = slice(begin, begin + BLOCK)
        angle, error, whole = angle_deg[rows], errors_deg[rows], process[rows]
        variance = whole.amplitudes[:, number] ** 2
        phase = 2 * np.pi * angle / process.periods[number]
        wave = np.stack([np.cos(phase), np.sin(phase)], axis=-1)
        root = np.linalg.cholesky(whole.covariance(angle))
        # a, b | errors: gain V W^T C^-1 e, covariance V (1 - V W^T C^-1 W), whose 2 x 2 root is taken by eigenvalues:
        # rounding may make one negative where the errors determine the wave.
        scaled, white = np.linalg.solve(root, wave), np.linalg.solve(root, error[..., None])
        mean = variance[:, None] * (scaled.swapaxes(1, 2) @ white)[..., 0]
        left = np.eye(2) - variance[:, None, None] * (scaled.swapaxes(1, 2) @ scaled)
        share, vectors = np.linalg.eigh(left)
        sd = np.sqrt(np.maximum(share, 0.0) * variance[:, None])
        parts[rows] = mean + (vectors @ (sd * normal[rows])[..., None])[..., 0]
        plain = np.linalg.cholesky(whole.without(number).covariance(angle))
        alone = np.linalg.solve(plain, error[..., None])
        ratio[rows] = 0.5 * (np.sum(white**2, axis=(1, 2)) - np.sum(alone**2, axis=(1, 2))) + _log_root(root)
        ratio[rows] -= _log_root(plain)
    return WaveDraws(parts[:, 0], parts[:, 1], ratio)


def _log_root(root: np.ndarray) -> np.ndarray:
    """Compute half the log determinant of covariances from their factors (n, p, p)."""
    return np.sum(np.log(np.diagonal(root, axis1=1, axis2=2)), axis=1)


def _measured(draws: np.ndarray) -> Measured:
    return Measured(float(draws.mean()), float(draws.std()), interval95(draws))


def gear_periods(posterior: Posterior) -> tuple[GearPeriod, ...]:
    """Estimate all waves of periods stated in `[rig]` with amplitudes not fixed at 0, given that they exist."""
    fit, rng = posterior.fit, random_stream(posterior.seed, Stream.WAVES)
    drawn = posterior.resampled(1, DRAWS).joined
    physical, errors_deg = np.asarray(drawn.physical), np.asarray(drawn.place_errors_rad) * DEGREES
    periods: list[GearPeriod] = []
    if not errors_deg.shape[1]:
        return ()
    places = seen_places(fit)
    for axis in AXES:
        process = process_of(fit, physical, ERROR_AT, axis)
        at, steps = places[axis], np.asarray(fit.arrays.gears.places.steps)[places[axis]]
        angle_deg = physical[:, fit.space.mechanism.index[f"degrees_per_step.{axis}"], None] * steps
        for number, period in enumerate(process.periods):
            if np.any(process.amplitudes[:, number] > 0) and len(at):
                one = wave_draws(process, number, angle_deg, errors_deg[:, at], rng.standard_normal((DRAWS, 2)))
                stated = Measured(period, 0.0, (period, period))
                amplitude, phase = _measured(one.amplitude), _measured(one.phase_deg)
                periods.append(GearPeriod(stated, amplitude, phase, "stated", one.probability, axis))
    return tuple(periods)
