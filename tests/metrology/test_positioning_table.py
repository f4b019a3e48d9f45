"""The table of an axis: what play, ratio and bent optics do to its figures; the campaign's own stops."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from support.imagined_stops import STOPS, stops_of
from support.known_calibration import known_calibration

from tvsbayes.assessment.residuals import stop_readings
from tvsbayes.calibration.optics import beam_deg_per_step
from tvsbayes.calibration.pointing import INPUT_NAMES
from tvsbayes.metrology.iso230 import figures_of
from tvsbayes.metrology.positioning_table import INDIRECT, positioning
from tvsbayes.metrology.simulated_cycles import simulated_runs
from tvsbayes.results.metrology_tables import FIGURES
from tvsbayes.results.records import plain


def test_an_ideal_axis_has_no_error_and_play_is_its_reversal():
    ideal = positioning(known_calibration(), "pan", tests=20)
    assert ideal.deg_per_step == pytest.approx(0.06, rel=1e-9)
    assert all(abs(p.median) < 1e-9 for p in ideal.predicted.values())
    # Reached left (up) the mirror lags by b/2, reached right (down) it leads by b/2 (formulation 3.1): B_i = -b.
    played = positioning(known_calibration(**{"backlash_deg.pan": 0.3}), "pan", tests=20).predicted
    for name in ("reversal_deg", "repeatability_deg", "systematic_deg", "accuracy_deg"):
        assert played[name].median == pytest.approx(0.3, abs=1e-9), name
    assert played["mean_reversal_deg"].median == pytest.approx(-0.3, abs=1e-9)
    assert played["mean_systematic_deg"].median == pytest.approx(0.0, abs=1e-9)


def test_a_wrong_ratio_is_a_systematic_deviation_over_the_targets():
    predicted = positioning(known_calibration(), "tilt", tests=10, deg_per_step=0.069, targets=(-50, 0, 50)).predicted
    for name in ("systematic_deg", "mean_systematic_deg", "accuracy_deg", "systematic_up_deg"):
        assert predicted[name].median == pytest.approx(0.001 * 100, abs=1e-9), name
    assert predicted["reversal_deg"].median == pytest.approx(0.0, abs=1e-9)


def test_the_predicted_interval_holds_a_test_on_the_true_rig():
    """Coverage: the figure of one more test on a rig from the same distribution lies inside in 95 of 100 cases."""
    rng = np.random.default_rng(5)
    rigs = 300
    base = known_calibration(rigs, **{"stop_sd_deg.left": 0.1, "stop_sd_deg.right": 0.05})
    inputs = base.inputs.copy()
    inputs[:, INPUT_NAMES.index("backlash_deg.pan")] = np.abs(rng.normal(0.3, 0.05, rigs))
    table = positioning(replace(base, inputs=inputs), "pan", targets=(0, 50, 100, 150), deg_per_step=0.06, tests=3000)
    interval = table.predicted["reversal_deg"].interval95
    fresh = inputs.copy()
    fresh[:, INPUT_NAMES.index("backlash_deg.pan")] = np.abs(rng.normal(0.3, 0.05, rigs))
    up, down = simulated_runs(replace(base, inputs=fresh), "pan", (0, 50, 100, 150), 0.06, tests=rigs, seed=9)
    values = figures_of(up, down).reversal_deg
    held = np.count_nonzero((values >= interval[0]) & (values <= interval[1]))
    # Binomial(300, 0.95) at 1e-4 either side, widened by the interval's own error of 0.4 % in probability.
    assert 265 <= held <= 298
    assert interval[0] < table.predicted["reversal_deg"].median < interval[1]


def test_bent_optics_bend_the_beam_not_the_counters():
    """A laser tilt makes the azimuth a curve of the mirror angle: E and M grow, the reversal stays the play."""
    straight = positioning(known_calibration(**{"backlash_deg.pan": 0.2}), "pan", tests=5).predicted
    bent = positioning(known_calibration(**{"backlash_deg.pan": 0.2, "laser_tilt_deg.x": 1.0}), "pan", tests=5)
    assert straight["mean_systematic_deg"].median == pytest.approx(0.0, abs=1e-9)
    assert bent.predicted["mean_systematic_deg"].median > 0.01
    # 1 deg of laser tilt changes the slope by 1.7 % at most (formulation 3.2).
    assert bent.predicted["mean_reversal_deg"].median == pytest.approx(-0.2, rel=0.017)
    # Unasked, targets follow the slope at the middle of the counters: pan 100, tilt 0.
    values = known_calibration(**{"laser_tilt_deg.x": 1.0}).estimates
    assert bent.deg_per_step == pytest.approx(beam_deg_per_step(values, "pan", (6.0, 0.0)), rel=1e-9)
    assert bent.deg_per_step != pytest.approx(beam_deg_per_step(values, "pan", (0.0, 6.0)), rel=1e-6)


def test_whole_turns_are_kept():
    turned = known_calibration()
    turned = replace(turned, range_steps=np.array([[-6000.0, 6000.0], [-10.0, 10.0]]))
    table = positioning(turned, "pan", tests=3)
    assert len(table.target_steps) == 8
    assert table.predicted["accuracy_deg"].median == pytest.approx(0.0, abs=1e-8)


def test_an_axis_that_never_moved_has_no_prediction():
    still = replace(known_calibration(), range_steps=np.array([[-100.0, 300.0], [0.0, 0.0]]))
    table = positioning(still, "tilt")
    assert table.predicted is None and table.target_steps == ()
    assert any("never moved" in note for note in table.notes)
    with pytest.raises(ValueError, match="no draws"):
        positioning(replace(still, inputs=np.zeros((0, len(INPUT_NAMES)))), "pan")


def test_plug_in_figures_are_those_of_the_stops():
    offsets = np.random.default_rng(6).normal(0.0, 0.05, STOPS)
    fit = stops_of(offsets)
    table = positioning(known_calibration(**{"backlash_deg.pan": 0.3}), "pan", readings=stop_readings(fit, "pan"))
    assert table.missing is None
    # 100 and 200 are reached from either side; 0 and 300 are turn-round points.
    assert table.plug_in_steps == (0, 100, 200)[1:] and table.plug_in_runs == ((4, 4), (4, 4))
    order = [n for _ in range(4) for n in (0, 100, 200, 300, 200, 100)]
    up = np.array([[offsets[k] for k in range(24) if order[k] == n and k % 6 < 3] for n in (100, 200)])
    down = np.array([[offsets[k] for k in range(24) if order[k] == n and k % 6 > 3] for n in (100, 200)])
    expected = figures_of(up - 0.15, down + 0.15)
    for name in FIGURES:
        assert float(getattr(table.plug_in, name)) == pytest.approx(float(getattr(expected, name)), abs=1e-9), name
    assert any("2 targets, at least 4 runs" in note for note in table.notes)
    assert table.notes[0] == INDIRECT and any(note.startswith("not covered") for note in table.notes)
    json.dumps(plain(table), allow_nan=False)


def test_too_few_stops_give_a_reason_and_no_table():
    fit = stops_of(np.zeros(STOPS))
    kept = tuple(s for s in fit.campaign.spots if s.move <= 6)
    fit.campaign = replace(fit.campaign, spots=kept)
    table = positioning(known_calibration(), "pan", readings=stop_readings(fit, "pan"), tests=5)
    assert table.plug_in is None and table.plug_in_runs == ()
    assert table.missing.startswith("0 counters of the pan axis with at least 2 stops from either side")
    assert table.predicted is not None


def test_an_axis_of_long_travel_needs_more_targets():
    """More than 180 deg of travel need eight targets, in the words as in the tests."""
    fit = stops_of(np.zeros(STOPS))
    calibration = known_calibration()
    far = replace(calibration, range_steps=np.array([[0, 4000], calibration.range_steps[1]]))
    table = positioning(far, "pan", readings=stop_readings(fit, "pan"), tests=5)
    assert len(table.target_steps) == 8
    assert any("ISO 230-2 asks for 8 targets" in note for note in table.notes)
