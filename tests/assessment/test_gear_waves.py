"""Waves of stated period, given the errors at places: against dense Gaussians and evidence by quadrature."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import halfnorm, multivariate_normal

from tvsbayes.assessment.gear_tables import Process
from tvsbayes.assessment.gear_waves import DRAWS, gear_periods, wave_draws
from tvsbayes.instrument.mechanisms import TWO_MIRROR

PERIOD, SD, LENGTH, SCALE = 25.0, 0.02, 7.0, 0.05
"""deg: of the wave, of the process beside it, of the half-normal prior of the wave's sd."""
ANGLES = np.array([-19.0, -12.5, -9.0, -4.2, 0.0, 1.1, 6.0, 8.5, 13.0, 17.0])
AGREEMENT = 1e-8
"""Relative: a Cholesky factor of condition 1e6."""


def process(amplitudes: np.ndarray) -> Process:
    count = len(amplitudes)
    return Process(np.full(count, SD), np.full(count, LENGTH), amplitudes[:, None], (PERIOD,))


def covariance(amplitude: float) -> np.ndarray:
    """Written out once more (formulation 3.1), with the floor of a place."""
    d = np.abs(ANGLES[:, None] - ANGLES)
    root = np.sqrt(5) * d / LENGTH
    smooth = SD**2 * (1 + root + root**2 / 3) * np.exp(-root)
    floor = 1e-10 * (SD**2 + amplitude**2) * np.eye(len(ANGLES))
    return smooth + amplitude**2 * np.cos(2 * np.pi * d / PERIOD) + floor


def errors(wave: float, seed: int) -> np.ndarray:
    """A wave highest at 40 deg of its turn, and a draw of the process."""
    drawn = np.linalg.cholesky(covariance(0.0)) @ np.random.default_rng(seed).standard_normal(len(ANGLES))
    return drawn + wave * np.cos(2 * np.pi * ANGLES / PERIOD - np.radians(40.0))


def test_parts_of_a_wave_are_normal_given_the_errors():
    """Mean, covariance and evidence ratio are those of the dense joint Gaussian of parts and errors."""
    amplitude, sample = 0.03, errors(0.03, 1)
    phase = 2 * np.pi * ANGLES / PERIOD
    across = amplitude**2 * np.stack([np.cos(phase), np.sin(phase)])
    gain = across @ np.linalg.inv(covariance(amplitude))
    normal = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    tiled = [np.tile(x, (3, 1)) for x in (ANGLES, sample)]
    waves = wave_draws(process(np.full(3, amplitude)), 0, *tiled, normal)
    parts = np.stack([waves.cosine, waves.sine], axis=1)
    np.testing.assert_allclose(parts[0], gain @ sample, atol=AGREEMENT)
    root = (parts[1:] - parts[0]).T
    left = amplitude**2 * np.eye(2) - gain @ across.T
    np.testing.assert_allclose(root @ root.T, left, atol=AGREEMENT * amplitude**2 * 1e2)
    with_wave, without = (multivariate_normal(cov=covariance(a)).logpdf(sample) for a in (amplitude, 0.0))
    np.testing.assert_allclose(waves.log_evidence_ratio, without - with_wave, rtol=1e-6)


@pytest.mark.parametrize(("wave", "likely"), [(0.0, False), (0.02, None), (0.06, True)])
def test_probability_is_that_of_both_evidences(wave, likely):
    """The mean of density ratios over the posterior is the ratio of evidences, by quadrature over the wave's sd."""
    sample = errors(wave, 2)
    quantiles = (np.arange(4000) + 0.5) / 4000
    sds = halfnorm.ppf(quantiles, scale=SCALE)
    logs = np.array([multivariate_normal(cov=covariance(sd)).logpdf(sample) for sd in sds])
    alone = multivariate_normal(cov=covariance(0.0)).logpdf(sample)
    truth = 1 / (1 + np.exp(alone) / np.mean(np.exp(logs)))
    shares = np.cumsum(np.exp(logs - logs.max()))
    drawn = sds[np.searchsorted(shares / shares[-1], (np.arange(DRAWS) + 0.5) / DRAWS)]
    tiled = [np.tile(x, (DRAWS, 1)) for x in (ANGLES, sample)]
    waves = wave_draws(process(drawn), 0, *tiled, np.zeros((DRAWS, 2)))
    # Even draws of a posterior on 4000 nodes: a few of the nodes' share of probability each.
    assert waves.probability == pytest.approx(truth, abs=0.01)
    assert likely is None or (waves.probability > 0.5) == likely


def test_waves_of_a_posterior_by_axis():
    """Amplitude and phase of what stands at the places, by the axis' own angle; none of an axis without a period."""
    ratio, count = -0.07, len(ANGLES)
    steps = np.append(np.round(ANGLES / ratio), [0.0, 5.0])
    on_tilt, valid = np.arange(count + 2) < count, np.arange(count + 2) <= count
    at_places = 0.05 * np.cos(2 * np.pi * ratio * steps[:count] / PERIOD - np.radians(40.0))
    values = np.array(
        [TWO_MIRROR.priors[name].value if name in TWO_MIRROR.priors else 0.0 for name in TWO_MIRROR.names]
    )
    scales = {"transmission_error_deg": 1e-3, "transmission_error_length_deg": LENGTH, "harmonic_amplitude_deg": 0.05}
    for block, value in scales.items():
        values[TWO_MIRROR.index[f"{block}.tilt" + ".1" * block.startswith("harmonic")]] = value
    values[TWO_MIRROR.index["degrees_per_step.tilt"]] = ratio
    drawn = SimpleNamespace(
        physical=np.tile(values, (DRAWS, 1)),
        place_errors_rad=np.radians(np.tile(np.concatenate([at_places, np.zeros(count + 4)]), (DRAWS, 1))),
    )
    places = SimpleNamespace(steps=steps, on_tilt=on_tilt, valid=valid)
    fit = SimpleNamespace(
        space=SimpleNamespace(mechanism=TWO_MIRROR),
        arrays=SimpleNamespace(gears=SimpleNamespace(places=places)),
        campaign=SimpleNamespace(rig=SimpleNamespace(harmonic_period_deg={"tilt": (PERIOD,)})),
    )
    posterior = SimpleNamespace(fit=fit, seed=0, resampled=lambda chains, draws: SimpleNamespace(joined=drawn))
    (row,) = gear_periods(posterior)
    assert (row.axis, row.source, row.period.value) == ("tilt", "stated", PERIOD)
    assert row.amplitude.value == pytest.approx(0.05, abs=2e-3)
    assert row.phase_deg.value == pytest.approx(40.0, abs=2.0)
    assert row.probability > 0.999
