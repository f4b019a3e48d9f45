"""What is said of an axis' waves: period, amplitude, phase, the probability that there is one, and its curve.

Numbers are given that there is a wave; `probability` says whether. Amplitude and phase are those of the first harmonic.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tvsbayes.results.estimates import Measured, PeriodEstimate
from tvsbayes.single_axis.axis_fit import AxisFit
from tvsbayes.single_axis.axis_model import LinearPosterior
from tvsbayes.single_axis.waves import COLUMNS, Wave, WaveRecord, absent_at, wave_columns
from tvsbayes.statistics.intervals import interval95, phases_deg
from tvsbayes.statistics.streams import AxisStream, random_stream
from tvsbayes.statistics.weighted_draws import systematic

WITH_WAVE_MIN, WITH_WAVE = 200, 1000
"""Draws with a wave that its numbers come from; where the posterior has fewer, so many are drawn and weighted."""
ALIKE = 0.02
"""Draws of a period that lie farther apart than this share of it belong to different waves that explain the same."""


@dataclass(frozen=True)
class WaveSample:
    """Draws of one wave, given that there is one.

    Attributes:
        wave: what was asked for.
        period: on the model's clock, shape (n,).
        true_period: with the ratio's uncertainty, shape (n,).
        coefficients: of the wave's columns, shape (n, `COLUMNS`).
        probability: that there is one.
        record: of the readings on the clock of the wave; its middle is where the phase is known best.
    """

    wave: Wave
    period: np.ndarray
    true_period: np.ndarray
    coefficients: np.ndarray
    probability: float
    record: WaveRecord

    def period_unit(self, unit: str) -> str:
        """Of its period, in a folder whose readings have this unit."""
        return "s" if self.wave.clock == "seconds" else unit

    @property
    def amplitude(self) -> np.ndarray:
        """Of the first harmonic, shape (n,)."""
        return np.hypot(self.coefficients[:, 0], self.coefficients[:, 1])

    def phase_deg(self) -> np.ndarray:
        """Phase within half a turn of its circular mean, shape (n,)."""
        return phases_deg(self.coefficients[:, 0], self.coefficients[:, 1])

    @property
    def likeliest(self) -> np.ndarray:
        """Which draws (n,) are of the period that explains the readings best, where several do."""
        groups = separate_periods(self.period)
        low, high = groups[0].between if groups else (0.0, np.inf)
        return (self.period >= low) & (self.period <= high)

    def curve(self, turn: np.ndarray) -> np.ndarray:
        """The wave over one mean period from the middle of the record on, at shares `turn` (t,) of it: shape (n, t)."""
        x = self.record.middle + turn * float(np.mean(self.period))
        return np.einsum("ntc,nc->nt", wave_columns(x, self.period, self.record), self.coefficients)


def _with_wave(fit: AxisFit, k: int, rng: np.random.Generator) -> tuple[np.ndarray, LinearPosterior]:
    """Draws (m, d) of the posterior given that wave k is there, and what is linear at them."""
    model, w = fit.model, fit.w
    there = model.coordinates.wave_draws(w)[k].scale > 0
    if there.sum() >= WITH_WAVE_MIN:
        return w[there], LinearPosterior(fit.linear.mean[there], fit.linear.covariance[there])
    from scipy.special import ndtri

    # The wave is added to draws without it: all else follows what the readings say without it.
    names = model.coordinates.names
    chosen = w[rng.choice(len(w), WITH_WAVE, replace=len(w) < WITH_WAVE)].copy()
    before = chosen.copy()
    wave = model.coordinates.waves[k]
    column = names.index(f"wave_scale.{k + 1}")
    before[:, column] = absent_at(wave)
    chosen[:, column] = ndtri(wave.absent + (1 - wave.absent) * rng.uniform(1e-9, 1 - 1e-9, len(chosen)))
    if not wave.is_fixed:
        place = names.index(f"wave_period.{k + 1}")
        chosen[:, place] = before[:, place] = rng.standard_normal(len(chosen))
    gain = model.log_density(chosen) - model.log_density(before)
    gain += 0.5 * (chosen[:, column] ** 2 - before[:, column] ** 2)
    gain = np.where(np.isfinite(gain), gain, -np.inf)
    if np.any(np.isfinite(gain)):
        weights = np.exp(gain - gain.max())
        chosen = chosen[systematic(weights / weights.sum(), WITH_WAVE, rng.random())]
    return chosen, model.linear(chosen)


def wave_samples(fit: AxisFit) -> tuple[WaveSample, ...]:
    """Every wave of a fit, given that it is there.

    In order: stated ones, the strongest of every range that was asked for, further ones by strength, the encoder's.
    """
    model, rng = fit.model, random_stream(fit.seed, AxisStream.PERIODS)
    samples = []
    for k, wave in enumerate(model.coordinates.waves):
        probability = float(np.mean(model.coordinates.wave_draws(fit.w)[k].scale > 0))
        w, linear = _with_wave(fit, k, rng)
        begins = model.waves_begin + COLUMNS * k
        picked = np.concatenate([np.zeros((COLUMNS, model.columns)), model.head(slope=1.0)[None]])
        picked[range(COLUMNS), range(begins, begins + COLUMNS)] = 1.0
        drawn = linear.drawn(picked, rng)
        coefficients, ratio = drawn[:, :COLUMNS], drawn[:, COLUMNS] / fit.rows.line[1]
        period = np.broadcast_to(model.coordinates.wave_draws(w)[k].period, len(w)).copy()
        # Positions of the model are by the line; the true ratio makes them longer or shorter.
        true_period = period * ratio if wave.clock == "position" else period
        samples.append(WaveSample(wave, period, true_period, coefficients, probability, model.record(wave)))
    given = [each for each in samples if each.wave.known is not None]
    inferred = [each for each in samples if each.wave.known is None]
    further = sorted(inferred, key=lambda each: (each.probability > 0.5, each.amplitude.mean()), reverse=True)
    first = []
    for ends in fit.campaign.periods.between:
        k = next(k for k, each in enumerate(further) if (each.wave.low, each.wave.high) == ends)
        first.append(further.pop(k))
    stated = [each for each in given if each.wave.clock != "encoder"]
    return (*stated, *first, *further, *given[len(stated) :])


def _measured(draws: np.ndarray, likeliest: np.ndarray) -> Measured:
    chosen = draws[likeliest]
    return Measured(float(chosen.mean()), float(chosen.std()), interval95(draws))


def period_estimate(sample: WaveSample) -> PeriodEstimate:
    """One wave in numbers."""
    known, likeliest = sample.wave.known, sample.likeliest
    return PeriodEstimate(
        period=_measured(sample.true_period, likeliest) if known is None else Measured(known, 0.0, (known, known)),
        amplitude=_measured(sample.amplitude, likeliest),
        phase_deg=_measured(sample.phase_deg(), likeliest),
        source="inferred" if known is None else "stated",
        probability=sample.probability,
    )


@dataclass(frozen=True)
class PeriodGroup:
    """Draws of a period that lie together: their mean, their least and greatest, their share of all."""

    mean: float
    between: tuple[float, float]
    share: float


def separate_periods(period: np.ndarray) -> list[PeriodGroup]:
    """Groups of draws (n,) of a period that lie apart, the likeliest first; the rarest are left out."""
    ordered = np.sort(period)
    cut = np.flatnonzero(np.diff(ordered) > ALIKE * ordered[1:]) + 1
    groups = [group for group in np.split(ordered, cut) if len(group) >= ALIKE * len(period)]
    separate = [PeriodGroup(float(g.mean()), (float(g[0]), float(g[-1])), len(g) / len(period)) for g in groups]
    return sorted(separate, key=lambda group: -group.share)


def weak_waves(fit: AxisFit, samples: tuple[WaveSample, ...]) -> list[str]:
    """What the readings leave open about waves, in words, with what would tell."""
    sentences = []
    for sample in samples:
        unit = sample.period_unit(fit.campaign.unit)
        groups = separate_periods(sample.period)
        if sample.probability > 0.5 and len(groups) > 1 and sample.wave.known is None:
            shares = ", ".join(f"{group.mean:.4g} {unit} ({100 * group.share:.0f} %)" for group in groups[:4])
            sentences.append(
                f"the readings cannot tell which period the wave has: {shares}; read a longer run, at places that are "
                "not evenly spaced"
            )
    return sentences + strong_harmonics(samples, fit.campaign.unit) + _one_wave_twice(fit)


def strong_harmonics(samples: tuple[WaveSample, ...], unit: str) -> list[str]:
    """Waves whose second harmonic is stronger than the first: half of the period is the wave that leads."""
    sentences = []
    for sample in samples:
        mine = sample.likeliest
        second = float(np.hypot(*sample.coefficients[mine, 2:4].T).mean())
        if sample.probability > 0.5 and second > float(sample.amplitude[mine].mean()):
            period, of = float(sample.true_period[mine].mean()), sample.period_unit(unit)
            sentences.append(
                f"the wave of {period:.4g} {of} is strongest by its second harmonic: {second:.2g} {unit} every "
                f"{0.5 * period:.4g} {of}; ask for that period in a range of its own to part two wheels"
            )
    return sentences


def waves_at_an_end(samples: tuple[WaveSample, ...], unit: str) -> list[str]:
    """Warnings of periods that lie where the range ends that was asked for: the true one may lie beyond it."""
    sentences = []
    for sample in samples:
        wave = sample.wave
        if wave.known is not None or not sample.probability > 0.5:
            continue
        low, high = interval95(sample.period)
        if low < wave.low * (1 + ALIKE) or high > wave.high * (1 - ALIKE):
            of = sample.period_unit(unit)
            sentences.append(
                f"the period {np.mean(sample.period):.4g} {of} lies at the end of the range that was asked for "
                f"({wave.low:.4g} to {wave.high:.4g} {of}): the true one may lie beyond; widen period_between"
            )
    return sentences


def _one_wave_twice(fit: AxisFit) -> list[str]:
    """Gear and encoder with one period, which their readings hardly part."""
    sentences = []
    model, rows = fit.model, fit.rows
    gears = [wave for wave in model.coordinates.waves if wave.clock == "position"]
    for wave in gears:
        for other in model.coordinates.waves:
            if other.clock != "encoder":
                continue
            span = float(np.ptp(rows.value))
            if abs(1 / wave.peak - 1 / other.peak) * span < 1.0:
                sentences.append(
                    f"gear and encoder both have a wave of about {other.peak:.4g} {fit.campaign.unit}: how it is split "
                    "between them is weak, their sum is not; turn the encoder's shaft against the gear, or read with a "
                    "second instrument"
                )
    return sentences
