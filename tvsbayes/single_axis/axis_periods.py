"""Results for an axis' waves: period, amplitude, phase, the probability of existence, and the curve.

Numbers are conditional on the existence of the wave; `probability` is that of existence. Amplitude and phase are
those of the first harmonic.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np

from tvsbayes.results.estimates import Measured, PeriodEstimate
from tvsbayes.single_axis.axis_fit import AxisFit
from tvsbayes.single_axis.waves import COLUMNS, Wave, WaveRecord, absent_coord, wave_columns
from tvsbayes.statistics.intervals import interval95, phases_deg
from tvsbayes.statistics.linear_posterior import LinearPosterior
from tvsbayes.statistics.streams import AxisStream, random_stream
from tvsbayes.statistics.weighted_draws import systematic

WITH_WAVE_MIN, WITH_WAVE = 200, 1000
"""Least number of draws with a wave for its results; number of weighted draws where the posterior has fewer."""
SAME_SHARE = 0.02
"""Draws of a period farther apart than this share of it belong to different explanations."""


@dataclass(frozen=True)
class WaveSample:
    """Draws of one wave, given that it exists.

    Attributes:
        wave: the wave of the model.
        period: on the model's clock, shape (n,).
        true_period: period with the ratio's uncertainty, shape (n,).
        coefficients: coefficients of the wave's columns, shape (n, `COLUMNS`).
        probability: probability that the wave exists.
        record: range of the readings on the clock of the wave; the phase is known best at its middle.
    """

    wave: Wave
    period: np.ndarray
    true_period: np.ndarray
    coefficients: np.ndarray
    probability: float
    record: WaveRecord

    def period_unit(self, unit: str) -> str:
        """Unit of its period, in a folder whose readings have this unit."""
        return "s" if self.wave.clock == "seconds" else unit

    @property
    def amplitude(self) -> np.ndarray:
        """Amplitude of the first harmonic, shape (n,)."""
        return np.hypot(self.coefficients[:, 0], self.coefficients[:, 1])

    def phase_deg(self) -> np.ndarray:
        """Phase within half a turn of its circular mean, shape (n,)."""
        return phases_deg(self.coefficients[:, 0], self.coefficients[:, 1])

    @property
    def likeliest(self) -> np.ndarray:
        """Mask of draws (n,) in the most probable group of periods."""
        groups = separate_periods(self.period)
        low, high = groups[0].between if groups else (0.0, np.inf)
        return (self.period >= low) & (self.period <= high)

    def curve(self, turn: np.ndarray) -> np.ndarray:
        """The wave over one mean period from the middle of the record, at shares `turn` (t,) of it: shape (n, t)."""
        x = self.record.middle + turn * float(np.mean(self.period))
        return np.einsum("ntc,nc->nt", wave_columns(x, self.period, self.record), self.coefficients)


def _with_wave(fit: AxisFit, k: int, rng: np.random.Generator) -> tuple[np.ndarray, LinearPosterior]:
    """Draws (m, d) of the posterior given that wave k exists, with the linear quantities."""
    model, w = fit.model, fit.w
    present = model.coordinates.wave_draws(w)[k].scale > 0
    if present.sum() >= WITH_WAVE_MIN:
        return w[present], LinearPosterior(fit.linear.mean[present], fit.linear.covariance[present])
    from scipy.special import ndtri

    # The wave is added to draws without it; all other coordinates keep their values.
    names = model.coordinates.names
    draws = w[rng.choice(len(w), WITH_WAVE, replace=len(w) < WITH_WAVE)].copy()
    without = draws.copy()
    wave = model.coordinates.waves[k]
    scale_column = names.index(f"wave_scale.{k + 1}")
    without[:, scale_column] = absent_coord(wave)
    draws[:, scale_column] = ndtri(wave.absent + (1 - wave.absent) * rng.uniform(1e-9, 1 - 1e-9, len(draws)))
    if not wave.is_fixed:
        period_column = names.index(f"wave_period.{k + 1}")
        draws[:, period_column] = without[:, period_column] = rng.standard_normal(len(draws))
    log_ratio = model.log_density(draws) - model.log_density(without)
    log_ratio += 0.5 * (draws[:, scale_column] ** 2 - without[:, scale_column] ** 2)
    log_ratio = np.where(np.isfinite(log_ratio), log_ratio, -np.inf)
    if np.any(np.isfinite(log_ratio)):
        weights = np.exp(log_ratio - log_ratio.max())
        draws = draws[systematic(weights / weights.sum(), WITH_WAVE, rng.random())]
    return draws, model.linear(draws)


def wave_samples(fit: AxisFit) -> tuple[WaveSample, ...]:
    """Every wave of a fit, given that it exists.

    Order: stated waves, the strongest of every stated range, further waves by strength, the encoder's.
    """
    model, rng = fit.model, random_stream(fit.seed, AxisStream.PERIODS)
    samples = []
    for k, wave in enumerate(model.coordinates.waves):
        probability = float(np.mean(model.coordinates.wave_draws(fit.w)[k].scale > 0))
        w, linear = _with_wave(fit, k, rng)
        functionals = np.concatenate([np.zeros((COLUMNS, model.columns)), model.line_terms(per_command=1.0)[None]])
        functionals[:COLUMNS, model.of_wave(k)] = np.eye(COLUMNS)
        draws = linear.drawn(functionals, rng)
        coefficients, ratio = draws[:, :COLUMNS], draws[:, COLUMNS] / fit.rows.line.slope
        period = np.broadcast_to(model.coordinates.wave_draws(w)[k].period, len(w)).copy()
        # Positions in the model follow the line's ratio; the true ratio scales them.
        true_period = period * ratio if wave.clock == "position" else period
        samples.append(WaveSample(wave, period, true_period, coefficients, probability, model.record(wave)))
    stated_samples = [sample for sample in samples if sample.wave.known is not None]
    inferred = [sample for sample in samples if sample.wave.known is None]
    ordered = sorted(inferred, key=lambda sample: (sample.probability > 0.5, sample.amplitude.mean()), reverse=True)
    range_samples = []
    for ends in fit.campaign.periods.between:
        k = next(k for k, sample in enumerate(ordered) if (sample.wave.low, sample.wave.high) == ends)
        range_samples.append(ordered.pop(k))
    stated = [sample for sample in stated_samples if sample.wave.clock != "encoder"]
    return (*stated, *range_samples, *ordered, *stated_samples[len(stated) :])


def _measured(draws: np.ndarray, likeliest: np.ndarray) -> Measured:
    chosen = draws[likeliest]
    return Measured(float(chosen.mean()), float(chosen.std()), interval95(draws))


def period_estimate(sample: WaveSample) -> PeriodEstimate:
    """The estimate of one wave."""
    known, likeliest = sample.wave.known, sample.likeliest
    return PeriodEstimate(
        period=_measured(sample.true_period, likeliest) if known is None else Measured(known, 0.0, (known, known)),
        amplitude=_measured(sample.amplitude, likeliest),
        phase_deg=_measured(sample.phase_deg(), likeliest),
        source="inferred" if known is None else "stated",
        probability=sample.probability,
    )


class PeriodGroup(NamedTuple):
    """Neighbouring draws of a period: their mean, minimum and maximum, and their share of all."""

    mean: float
    between: tuple[float, float]
    share: float


def separate_periods(period: np.ndarray) -> list[PeriodGroup]:
    """Separate groups of draws (n,) of a period, the most probable first; rare groups are omitted."""
    ordered = np.sort(period)
    cut = np.flatnonzero(np.diff(ordered) > SAME_SHARE * ordered[1:]) + 1
    groups = [group for group in np.split(ordered, cut) if len(group) >= SAME_SHARE * len(period)]
    period_groups = [PeriodGroup(float(g.mean()), (float(g[0]), float(g[-1])), len(g) / len(period)) for g in groups]
    return sorted(period_groups, key=lambda group: -group.share)


def weak_waves(fit: AxisFit, samples: tuple[WaveSample, ...]) -> list[str]:
    """Weaknesses of the readings about waves, in words, with remedies."""
    sentences = []
    for sample in samples:
        groups = separate_periods(sample.period)
        if sample.probability > 0.5 and len(groups) > 1 and sample.wave.known is None:
            unit = sample.period_unit(fit.campaign.unit)
            shares = ", ".join(f"{group.mean:.4g} {unit} ({100 * group.share:.0f} %)" for group in groups[:4])
            sentences.append(
                f"the readings do not determine the period of the wave: {shares}; read a longer run, at places that "
                "are not evenly spaced"
            )
    return sentences + strong_harmonics(samples, fit.campaign.unit) + _one_wave_twice(fit)


def strong_harmonics(samples: tuple[WaveSample, ...], unit: str) -> list[str]:
    """Waves whose second harmonic is stronger than the first: the dominant wave has half the period."""
    sentences = []
    for sample in samples:
        likeliest = sample.likeliest
        second = float(np.hypot(*sample.coefficients[likeliest, 2:4].T).mean())
        if sample.probability > 0.5 and second > float(sample.amplitude[likeliest].mean()):
            period, of = float(sample.true_period[likeliest].mean()), sample.period_unit(unit)
            sentences.append(
                f"the wave of {period:.4g} {of} is strongest by its second harmonic: {second:.2g} {unit} every "
                f"{0.5 * period:.4g} {of}; ask for that period in a range of its own to part two wheels"
            )
    return sentences


def waves_at_an_end(samples: tuple[WaveSample, ...], unit: str) -> list[str]:
    """Warnings of periods at the end of the stated range: the true one may lie beyond it."""
    sentences = []
    for sample in samples:
        wave, (low, high) = sample.wave, interval95(sample.period)
        at_an_end = low < wave.low * (1 + SAME_SHARE) or high > wave.high * (1 - SAME_SHARE)
        if wave.known is None and sample.probability > 0.5 and at_an_end:
            of = sample.period_unit(unit)
            sentences.append(
                f"the period {np.mean(sample.period):.4g} {of} lies at the end of the range that was asked for "
                f"({wave.low:.4g} to {wave.high:.4g} {of}): the true one may lie beyond; widen period_between"
            )
    return sentences


def _one_wave_twice(fit: AxisFit) -> list[str]:
    """Gear and encoder with one period, which their readings hardly separate."""
    waves, span = fit.model.coordinates.waves, float(np.ptp(fit.rows.value))
    return [
        f"gear and encoder both have a wave of about {other.peak:.4g} {fit.campaign.unit}: their sum is determined, "
        "its division is not; turn the encoder's shaft against the gear, or read with a second instrument"
        for wave, other in product(waves, waves)
        if (wave.clock, other.clock) == ("position", "encoder") and abs(1 / wave.peak - 1 / other.peak) * span < 1.0
    ]
