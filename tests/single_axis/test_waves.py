"""Waves: coordinates with the prior's density, order within a range, columns; drives against dense matrices."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.axes import drawn, runs

from tvsbayes.single_axis import axis_density
from tvsbayes.single_axis.axis_campaign import AxisCampaign, AxisMove, Reading
from tvsbayes.single_axis.axis_density import find_mode
from tvsbayes.single_axis.axis_fit import fit_axis, model_of
from tvsbayes.single_axis.axis_parameters import AxisPrior
from tvsbayes.single_axis.axis_periods import WaveSample, strong_harmonics
from tvsbayes.single_axis.axis_record import summarise_axis
from tvsbayes.single_axis.period_search import APART_MIN, period_grid
from tvsbayes.single_axis.waves import (
    SECOND,
    WANDER,
    TabulatedDensity,
    Wave,
    WavePeriods,
    WaveRecord,
    log_order,
    wave_columns,
    wave_draws,
)

RATE, PERIOD, AMPLITUDE = 15.0, 240.0, 3.0


def drive(seed: int, amplitude: float, periods: WavePeriods, count: int = 160, span: float = 1600.0) -> AxisCampaign:
    """A drive with readings of noise sd 1 and a wave."""
    rng = np.random.default_rng(seed)
    times = np.sort(rng.uniform(0.0, span, count))
    values = RATE * times + amplitude * np.cos(2 * np.pi * times / PERIOD - 1.0) + rng.standard_normal(count)
    readings = tuple(
        Reading(k, 0, float(v), 1.0, "ok", float(t)) for k, (t, v) in enumerate(zip(times, values, strict=True))
    )
    stated = {"per_command": AxisPrior(1.0, 1e-3), "transmission_error": AxisPrior(0.0, 10.0)}
    return AxisCampaign("arcsec", (AxisMove(0, 0, 0.0, 0.0, "forward"),), readings, stated, {"rate": RATE}, periods)


def a_table(seed: int = 0) -> TabulatedDensity:
    rng = np.random.default_rng(seed)
    return TabulatedDensity.of(np.sort(rng.uniform(0.0, 2.0, 30)), 3 * rng.standard_normal(30), 0.05)


def test_quantiles_of_a_table_invert_its_integral():
    table = a_table()
    share = np.linspace(0.001, 0.999, 300)
    x = table.quantile(share)
    # Rounding of the sums.
    np.testing.assert_allclose([table.share(float(each)) for each in x], share, atol=1e-12)
    # By differences: the density is the slope of the share, to the square of the step.
    step = 1e-6
    slope = [(table.share(float(each) + step) - table.share(float(each) - step)) / (2 * step) for each in x]
    np.testing.assert_allclose(np.exp(table.log_density(x)), slope, rtol=1e-3)


def test_the_prior_of_a_wave_does_not_depend_on_its_tables():
    """Drawn by the tables and weighted: half have no wave, s is half-normal, the period log-uniform."""
    low, high = 2.0, 2.0 * np.exp(2.0)
    table = TabulatedDensity(a_table().at + np.log(low), a_table().density)
    table = TabulatedDensity.of(np.concatenate([[np.log(low)], table.at[1:-1], [np.log(high)]]), np.zeros(30), 0.3)
    wave = replace(Wave.fixed("position", low, 0.4), high=high, log_period=table, absent=0.2)
    count = 200_000
    w = np.random.default_rng(1).standard_normal((2, count))
    draws = wave_draws(wave, *w)
    weights = np.exp(draws.log_prior) / count
    error = 4 * np.sqrt(np.sum(weights**2))
    there = draws.scale > 0
    assert np.sum(weights) == pytest.approx(1.0, abs=error)
    assert np.sum(weights[there]) == pytest.approx(0.5, abs=error)
    assert np.sum((weights * (draws.scale < 0.4 * 0.67449))[there]) == pytest.approx(0.25, abs=error)
    assert np.sum((weights * (np.log(draws.period) < np.log(low) + 0.6))[there]) == pytest.approx(0.15, abs=error)


def test_waves_that_share_a_range_are_counted_once():
    """Over all states the prior adds up to that of distinguishable waves."""
    wave = replace(Wave.fixed("seconds", 2.0, 1.0), high=20.0, log_period=a_table())
    pair = [replace(wave, peak=4.0), replace(wave, peak=11.0)]
    rng = np.random.default_rng(2)
    period = np.exp(rng.uniform(np.log(2.0), np.log(20.0), (2, 100_000)))
    there = rng.random((2, 100_000)) < 0.5
    none = np.zeros(100_000)
    pairs = zip(there, period, strict=True)
    order = log_order(pair, [replace(wave_draws(wave, none, none), scale=s, period=p) for s, p in pairs])
    # Of two waves half of the orders are allowed, each for two; of one wave it is the first.
    assert np.exp(order).mean() == pytest.approx(1.0, abs=4 / np.sqrt(100_000))
    assert set(np.round(np.exp(order), 12)) == {0.0, 1.0, 2.0}


def test_columns_are_averages_over_their_width():
    # A record so long that a wave does not change within the width.
    period, width, still = np.array([3.0]), 1.2, WaveRecord(0.0, 1e9)
    x = np.array([0.3, 5.0, 8.8])
    # Midpoints of 2000 parts: to the square of their length.
    over = (np.arange(2000) + 0.5) / 2000 * width - 0.5 * width
    fine = np.mean([wave_columns(x + each, period, still)[0] for each in over], axis=0)
    np.testing.assert_allclose(wave_columns(x, period, still, np.full(3, width))[0], fine, atol=1e-6)


def test_a_drive_is_the_dense_gaussian():
    """Drift, seeing between readings, noise, offset, ratio, creep, one wave: term by term."""
    axis = drive(3, 2.0, WavePeriods((PERIOD,), (), True), 40)
    model = model_of(axis)
    rng = np.random.default_rng(5)
    w = 0.3 * rng.standard_normal((3, len(model.coordinates.names))) + 0.4
    rows, density = model.rows, model.log_likelihood(w)
    values, [wave] = model.coordinates.values(w), model.coordinates.wave_draws(w)
    t = rows.time_s
    apart = np.abs(t[:, None] - t)
    for k in range(3):
        at = {name: float(v[k]) for name, v in values.items()}
        hours = np.minimum(t[:, None], t) / 3600
        total = at["drift_per_root_hour"] ** 2 * hours + np.exp(-apart / at["seeing_s"]) * at["seeing_scale"] ** 2
        total += at["reading_scale"] ** 2 * np.eye(len(t)) + (1e-7 * rows.travel) ** 2 * np.eye(len(t))
        g = rows.command - model.middle
        total += rows.travel**2 + model.priors["per_command"].u ** 2 * np.outer(g, g)
        total += (1e-4 * rows.line.slope) ** 2 * np.outer(rows.path, rows.path) / 4
        total += model.priors["backlash"].u ** 2 / 4
        warmed = 1 - np.exp(-t / 60 / at["creep_minutes"])
        total += model.priors["creep"].u ** 2 * np.outer(warmed, warmed)
        for harmonic, share in ((1, 1.0), (2, SECOND)):
            wave_of = np.cos(2 * np.pi * harmonic * (t[:, None] - t) / PERIOD)
            total += (share * wave.scale[k]) ** 2 * wave_of
        along = (t - 0.5 * (t[0] + t[-1])) / (0.5 * np.ptp(t))
        changed = (WANDER * wave.scale[k]) ** 2 * np.outer(along, along)
        total += changed * np.cos(2 * np.pi * (t[:, None] - t) / PERIOD)
        residual = rows.value - rows.line.offset - rows.line.slope * model.middle - g
        _, log_det = np.linalg.slogdet(2 * np.pi * total)
        wanted = -0.5 * (log_det + residual @ np.linalg.solve(total, residual))
        # 40 rows of condition 1e10: the two solutions differ by rounding.
        assert density[k] == pytest.approx(wanted, rel=1e-6, abs=1e-3)


@pytest.mark.thorough
def test_readings_in_motion_are_averaged_without_losing_the_wave():
    """4000 readings become few rows, with the expected uncertainties of period and amplitude."""
    axis = drive(4, AMPLITUDE, WavePeriods((), ((100.0, 800.0),), True), 4000, 4000.0)
    summary = summarise_axis(fit_axis(axis, tier="importance"))
    assert not summary.problems
    assert summary.readings == 4000 and summary.moves < 250
    [estimate] = summary.periods
    assert estimate.source == "inferred" and estimate.probability > 0.99
    # Least squares: sd of the period sqrt(6 / n) s P^2 / (pi A span), of the amplitude s sqrt(2 / n); besides, a phase
    # that may wander by a tenth of s at both ends, and s is 2 / 3 of the amplitude or so.
    sd_period = (np.sqrt(6 / 4000) / AMPLITUDE + WANDER) * PERIOD**2 / (np.pi * 4000)
    assert abs(estimate.period.value - PERIOD) < 5 * sd_period and estimate.period.sd < 3 * sd_period
    assert abs(estimate.amplitude.value - AMPLITUDE) < 5 * np.sqrt(2 / 4000)


@pytest.mark.thorough
def test_noise_gives_no_wave():
    fit = fit_axis(drive(6, 0.0, WavePeriods((), ((100.0, 800.0),), True)), tier="importance")
    [estimate] = summarise_axis(fit).periods
    assert not fit.missing and estimate.probability < 0.5


@pytest.mark.thorough
def test_a_range_holds_more_waves_than_were_asked_for():
    """Three waves, two in one range: the strongest of every range first, in the order of the ranges, then the third."""
    axis, waves = drive(4, AMPLITUDE, WavePeriods((), ((60.0, 120.0), (120.0, 700.0)), True), 400, 4000.0), {97.0: 1.0}
    waves |= {PERIOD: AMPLITUDE, 410.0: 2.0}
    values = [
        r.value + sum(waves[period] * np.cos(2 * np.pi * r.time_s / period + 0.4) for period in (97.0, 410.0))
        for r in axis.readings
    ]
    readings = tuple(replace(r, value=float(v)) for r, v in zip(axis.readings, values, strict=True))
    fit = fit_axis(replace(axis, readings=readings), tier="importance")
    periods = summarise_axis(fit).periods
    assert not fit.missing
    for estimate, (period, amplitude) in zip(periods, waves.items(), strict=True):
        assert estimate.probability > 0.95
        assert abs(estimate.period.value - period) < 4 * estimate.period.sd
        assert abs(estimate.amplitude.value - amplitude) < 4 * estimate.amplitude.sd


@pytest.mark.thorough
def test_a_stated_period_of_position():
    """A wave of 8 deg on an axis with play, from both sides, at places that are not even."""
    rng = np.random.default_rng(3)
    places = tuple(np.sort(rng.uniform(-2000, 2000, 24)).round())
    axis = drawn(7, runs(1, places)).campaign
    command = {m.move: m.command for m in axis.moves}
    wave = {move: 0.12 * np.cos(2 * np.pi * 0.01 * c / 8.0 - 2.0) for move, c in command.items()}
    readings = tuple(replace(r, value=float(r.value or 0.0) + wave[r.move]) for r in axis.readings)
    fit = fit_axis(replace(axis, readings=readings, periods=WavePeriods((8.0,))), tier="importance")
    [estimate] = summarise_axis(fit).periods
    assert not fit.missing and estimate.source == "stated" and estimate.probability > 0.95
    assert estimate.period.value == 8.0 and estimate.period.sd == 0.0
    assert estimate.amplitude.interval95[0] < 0.12 < estimate.amplitude.interval95[1]
    assert estimate.phase_deg.interval95[0] < np.degrees(2.0) < estimate.phase_deg.interval95[1]


def test_periods_of_the_grid_differ_by_more_than_rounding():
    rng = np.random.default_rng(7)
    for low, factor, span in zip(
        rng.uniform(1.0, 500.0, 200), rng.uniform(1.05, 10.0, 200), rng.uniform(1, 9, 200), strict=True
    ):
        at = period_grid(replace(Wave.fixed("seconds", low, 1.0), high=low * factor), low * factor * span)
        assert (np.diff(at) > APART_MIN).all()
        assert (at[0], at[-1]) == (np.log(low), np.log(low * factor))


def test_a_second_harmonic_that_is_stronger_than_the_first_is_named():
    wave = replace(Wave.fixed("seconds", 2 * PERIOD, 1.0), low=100.0, high=700.0)
    coefficients = np.tile([1.0, 0.0, 0.0, 2.0, 0.0, 0.0], (10, 1))
    sample = WaveSample(wave, np.full(10, 480.0), np.full(10, 480.0), coefficients, 1.0, WaveRecord(0.0, 1.0))
    [text] = strong_harmonics((sample,), "arcsec")
    assert "240 s" in text and "2 arcsec" in text
    assert not strong_harmonics((replace(sample, coefficients=coefficients[:, [3, 1, 2, 0, 4, 5]]),), "arcsec")


@pytest.mark.thorough
def test_a_period_at_the_end_of_its_range_is_doubted():
    """A wave of 240 s with a range below 228 s is reported at the end of the range; one inside has no remark."""
    for high, doubted in ((0.95 * PERIOD, True), (700.0, False)):
        periods = WavePeriods(between=((60.0, high),), in_seconds=True)
        summary = summarise_axis(fit_axis(drive(4, 5.0, periods), tier="importance"))
        assert any("lies at the end of the range" in t for t in summary.warnings) == doubted, (high, summary.periods)


def test_a_search_that_diverges_restarts_within_bounds(monkeypatch):
    """A long record with narrow waves makes a search diverge, as forced here; the bounded one finds the mode."""
    model = model_of(drive(4, AMPLITUDE, WavePeriods((PERIOD,), (), True)))
    there, search = find_mode(model), axis_density._search

    def lost(*arguments, bounded=False):
        mode = search(*arguments, bounded=bounded)
        return mode if bounded else replace(mode, missing=("lost",), log_density=-1e9)

    monkeypatch.setattr(axis_density, "_search", lost)
    mode = find_mode(model)
    # Both end where the slope is small: within a tenth of a sd.
    assert not there.missing and not mode.missing and mode.log_density == pytest.approx(there.log_density, abs=0.01)
