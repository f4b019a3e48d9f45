"""Errors of gears over counters: interpolation, what stands beyond, and points that follow them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.bent_rig import BENT, ROUNDING, ROUNDING_MM, calibration
from support.geared_rig import KNOWN, SD_DEG, STEPS, constant, geared

from tvsbayes.calibration.gear_table import COUNTERS_MAX, NO_GEARS, GearTable, regular_counters, table_of
from tvsbayes.calibration.optics import GEAR_INPUTS
from tvsbayes.coordinates.error_map import error_map
from tvsbayes.coordinates.location import locate, locate_linear, settings_of

HALF_STEP_DEG = 0.0363
"""Half of the larger ratio of the bent rig, and 3 % for the slope of the gears' errors."""


def test_interpolation_is_exact_for_cubics_and_at_the_tables_own_counters():
    table = GearTable(STEPS)
    columns = np.zeros(table.size)
    for name, part in table.parts.items():
        nodes = np.array(STEPS[name.endswith("tilt")]) / 500
        columns[part.start : part.stop - 1] = 1 + nodes - 2 * nodes**2 + 0.5 * nodes**3
    counters = np.array([-700.0, -699.0, -0.5, 0.0, 333.3, 700.0])
    values, x = table.at(columns, (counters, counters)), counters / 500
    for name in GEAR_INPUTS:
        np.testing.assert_allclose(values[name], 1 + x - 2 * x**2 + 0.5 * x**3, atol=100 * ROUNDING)
        one = table.at(columns, (float(counters[4]), float(counters[4])))[name]
        assert float(one) == pytest.approx(values[name][4], abs=ROUNDING)
    rng = np.random.default_rng(1)
    any_columns = rng.standard_normal((3, table.size))
    nodes = np.array(STEPS[0])
    part = table.parts["transmission_error_at_deg.pan"]
    np.testing.assert_array_equal(
        table.at(any_columns, (nodes, nodes))["transmission_error_at_deg.pan"], any_columns[:, part][:, :-1]
    )


def test_beyond_the_table_stands_a_column_of_its_own():
    table = GearTable(STEPS)
    columns = np.random.default_rng(2).standard_normal(table.size)
    for pan in (-800.001, 801.0, 1e7):
        values = table.at(columns, (pan, 0.0))
        for kind in ("transmission_error_at_deg", "play_variation_at_deg"):
            assert float(values[f"{kind}.pan"]) == columns[table.parts[f"{kind}.pan"].stop - 1]
    assert table.names[32] == "transmission_error_at_deg.pan.800"
    assert table.names[33] == "transmission_error_at_deg.pan.beyond" and len(set(table.names)) == table.size


def test_covariance_of_a_look_is_that_of_the_interpolated_draws():
    one = geared(calibration(draws=300))
    count, counters = len(one.mean) - one.gears.size, (np.array([37.0, -750.0, 900.0]), np.array([-5.0, 650.0, 0.0]))
    at = one.gears.at(one.inputs[:, count:], counters)
    for k in range(3):
        look = np.column_stack([one.inputs[:, :count], *(at[name][:, k] for name in GEAR_INPUTS)])
        varies = np.diag(one.covariance)[:count] > 0
        kept = np.flatnonzero([*varies, *4 * [True]])
        wanted = np.cov(look, rowvar=False)[np.ix_(kept, kept)]
        covariance = one.gears.look_covariance(one.covariance, counters)[k]
        np.testing.assert_allclose(covariance[np.ix_(kept, kept)], wanted, atol=1e3 * ROUNDING)
        alone = one.gears.look_covariance(one.covariance, (float(counters[0][k]), float(counters[1][k])))
        np.testing.assert_allclose(alone, covariance, atol=ROUNDING)


@pytest.mark.parametrize("approach", [("left", "up"), ("right", "down"), ("left", "unknown")])
def test_a_constant_error_is_a_zero_and_a_constant_change_is_play(approach):
    """Every answer is that for a rig whose zero and play are that much larger."""
    shifts = {"transmission_error_at_deg_tilt": 0.3, "play_variation_at_deg_pan": 0.2}
    one = constant(calibration(), **shifts)
    moved = dict(BENT)
    moved["tilt_zero_deg"] += 0.3
    moved["backlash_deg.pan"] += 0.2
    other = calibration(moved)
    for pan, tilt, reading in ((130.0, 90.0, 66.0), (-60.0, -70.0, 75.0), (-790.0, 5.0, 95.0)):
        a, b = (c.locate(pan, tilt, reading, approach) for c in (one, other))
        np.testing.assert_allclose(a.xyz_mm, b.xyz_mm, atol=ROUNDING_MM)
        np.testing.assert_allclose(a.covariance_mm2, b.covariance_mm2, rtol=1e-7)
    a, b = (locate(c, [130.0, -60.0], [90.0, -70.0], [66.0, 75.0], approach, draws=500) for c in (one, other))
    np.testing.assert_allclose(a.xyz_mm, b.xyz_mm, atol=ROUNDING_MM)
    np.testing.assert_allclose(a.covariance_mm2, b.covariance_mm2, rtol=1e-7)
    if "unknown" not in approach:
        a, b = (c.steps_for((500.0, 40.0, 60.0), approach=approach).as_json() for c in (one, other))
        assert (a["pan_steps"], a["tilt_steps"]) == (b["pan_steps"], b["tilt_steps"])
        assert a["u95_mm"] == pytest.approx(b["u95_mm"], rel=1e-7)


def test_draws_and_the_law_of_propagation_agree_over_varying_gears():
    """Means within five Monte Carlo errors, and sds of 1000 draws to 12 %, five of theirs."""
    one = geared(calibration(spread=0.1))
    pan, tilt = np.array([37.0, -380.0, -700.0, -850.0]), np.array([-5.0, 250.0, -400.0, 30.0])
    reading = np.array([60.0, 75.0, 95.0, 100.0])
    point = locate(one, pan, tilt, reading, draws=1000)
    law = locate_linear(one, settings_of(pan, tilt, reading))
    kept = [error is None for error in point.refused]
    assert all(kept)
    u = np.sqrt(np.diagonal(law.covariance, 0, 1, 2))
    assert np.all(np.abs(point.xyz_mm - law.value)[kept] < 5 * u[kept] / np.sqrt(1000) + 0.02 * u[kept])
    np.testing.assert_allclose(np.sqrt(np.diagonal(point.covariance_mm2, 0, 1, 2))[kept], u[kept], rtol=0.12)
    for k in np.flatnonzero(kept):
        alone = one.locate(pan[k], tilt[k], reading[k])
        np.testing.assert_allclose(alone.xyz_mm, law.value[k], atol=ROUNDING_MM)
        np.testing.assert_allclose(alone.covariance_mm2, law.covariance[k], rtol=1e-9)
        assert alone.extrapolated == point.extrapolated[k] == bool(point.as_json(k)["extrapolated"])


def test_outside_the_counters_seen_uncertainty_grows_and_everybody_says_so():
    one = geared(calibration(sd={}, noise_deg=dict.fromkeys(calibration().noise_variance, 0.0)))
    inside, outside = one.beam_u95_deg((0.0, 0.0), (1.0, 1.0)), one.beam_u95_deg((790.0, 0.0), (1.0, 1.0))
    half_play = 0.5 * SD_DEG["play_variation_at_deg.pan"]
    # 1.96 sds of error and half the play; the draws' own sd is known to 3 %, the optics' slope is 1 to 2 %.
    wide = 1.96 * np.hypot(SD_DEG["transmission_error_at_deg.pan"], half_play)
    assert outside[0] == pytest.approx(wide, rel=0.1) and inside[0] == pytest.approx(KNOWN * wide, rel=0.1)
    assert one.beam_u95_deg((5000.0, 0.0), (1.0, 1.0))[0] == pytest.approx(wide, rel=0.1)
    for pan, tilt, extrapolated in ((400.0, -300.0, False), (401.0, 0.0, True), (0.0, -301.0, True)):
        assert one.ray(pan, tilt).extrapolated is extrapolated
        assert bool(locate(one, pan, tilt, 70.0).extrapolated[0]) is extrapolated
    near, far = one.steps_for(azimuth_deg=3.0, elevation_deg=2.0), one.steps_for(azimuth_deg=40.0, elevation_deg=2.0)
    assert not near.extrapolated and far.extrapolated and far.as_json()["extrapolated"] is True
    assert "extrapolated" not in far.as_json()["ray"]


def test_steps_take_the_gears_errors_back():
    one = geared(calibration())
    for azimuth, elevation in ((3.0, 2.0), (-14.0, 9.0), (25.0, -12.0)):
        steps = one.steps_for(azimuth_deg=azimuth, elevation_deg=elevation)
        # Half a step of both axes.
        assert steps.rounding_deg < np.sqrt(2) * HALF_STEP_DEG
        plain = replace(one, gears=NO_GEARS, mean=one.mean[: -one.gears.size])
        assert plain.beam_at((steps.pan_steps, steps.tilt_steps), (1.0, 1.0)) != one.beam_at(
            (steps.pan_steps, steps.tilt_steps), (1.0, 1.0)
        )


def test_error_maps_know_the_gears():
    """A rig whose gears vary errs more where no look reached."""
    one = geared(calibration(spread=0.01, noise_deg=dict.fromkeys(calibration().noise_variance, 1e-4)))
    pan = np.array([-750.0, 0.0, 750.0])
    rms = error_map(one, pan, [0.0], [600.0], simple={}, draws=500).rms_mm["joint"][:, 0, 0]
    np.testing.assert_array_equal(one.covers(pan, np.zeros(3)), [False, True, False])
    assert min(rms[0], rms[2]) > 2 * rms[1]


def test_tables_of_files_are_regular():
    assert table_of({"pan": [], "tilt": []}) == NO_GEARS and NO_GEARS.size == 0 and NO_GEARS.inputs == ()
    good = {"pan": [0.0, 1.0, 2.0, 3.0], "tilt": [0.0, 1.5, 3.0, 4.5, 6.0]}
    assert table_of(good).steps == ((0.0, 1.0, 2.0, 3.0), (0.0, 1.5, 3.0, 4.5, 6.0))
    for bad in ([0, 1, 2], [0, 1, 3, 4], [3, 2, 1, 0], [0, 1, 2, np.inf], [[0, 1, 2, 3]], [], list(range(1000))):
        with pytest.raises(ValueError, match="table"):
            table_of(good | {"pan": bad})
    assert len(regular_counters(0.0, 1e6, 1.0)) == COUNTERS_MAX and len(regular_counters(0.0, 1.0, 9.0)) == 4
