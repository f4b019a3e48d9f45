"""The promise of a scanner's calibration: of one state, by axis and side, kept by its twin, wider for a URDF."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs

from tvsbayes.assessment.fitted_calibration import calibration_of
from tvsbayes.calibration.pointing import INPUT_NAMES
from tvsbayes.calibration.predicted_angles import PredictedAngles
from tvsbayes.calibration.states import ZERO_NAMES, uses_of, zero_shifts
from tvsbayes.compensation.aimed_promise import aimed_promise
from tvsbayes.errors import NothingToEstimate
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.report.compensation_text import aimed_text, aimed_words
from tvsbayes.statistics.predicted_readings import State

pytestmark = pytest.mark.thorough
COUNTERS, UP = np.array([-60.0, 0.0, 60.0]), np.ones(3)


@pytest.fixture(scope="module")
def calibration(mixed_fit):
    return calibration_of(mixed_fit)


@pytest.fixture(scope="module")
def campaign(mixed_fit):
    return mixed_fit.campaign


@pytest.fixture(scope="module")
def made(calibration, campaign):
    return aimed_promise(calibration, campaign, "header")


def test_a_calibration_is_of_one_state(mixed_fit, calibration, campaign):
    """Its zeros are those at the homing and the shifts since then, draw by draw."""
    looked = {spot.move for spot in campaign.spots}
    hours = np.array([m.time_s for m in campaign.moves if m.move in looked]) / 3600
    state = calibration.states["tilt"]
    assert hours.min() < state.hours < hours.max() and state.travel == 0
    at_homing = mixed_fit.draws["tilt_zero_deg"]
    draws = {name: mixed_fit.draws[name] for name in ZERO_NAMES}
    shift = draws["creep_deg.tilt"] * (1 - np.exp(-60 * state.warm_hours / draws["creep_minutes"]))
    np.testing.assert_allclose(calibration.inputs[:, INPUT_NAMES.index("tilt_zero_deg")], at_homing + shift, atol=1e-12)


def test_predicted_angles_are_the_calibrations_own_at_its_state(calibration, campaign):
    """At another state they differ by the shifts, by cause."""
    machine = PredictedAngles(calibration, campaign, "tilt", 100.0)
    own = machine.expected(COUNTERS, UP)
    drive = calibration.drive("tilt")
    for counter, angle in zip(COUNTERS, own.mean.mean(axis=0), strict=True):
        assert drive.position(float(angle), 1) == pytest.approx(counter, abs=1e-6)
    later = State(2.0, machine.state.travel + 5000.0, machine.state.warm_hours + 1.0, 0.0)
    added = machine.expected(COUNTERS, UP, later).mean - own.mean
    shifts = machine.shifts(later, machine.state)
    np.testing.assert_allclose(added, sum(each.mean for each in shifts.values()) + np.zeros(3), atol=1e-12)
    assert set(shifts) == {"creep", "travel"}


def test_the_zero_is_known_as_the_looks_tell_it_not_as_its_parameter(calibration, campaign):
    """Tilt zero, mirrors and pose trade with each other by half a degree; the beam does not."""
    u_zero = np.sqrt(calibration.covariance[INPUT_NAMES.index("tilt_zero_deg")].max())
    u_beam = PredictedAngles(calibration, campaign, "tilt", 100.0).expected(COUNTERS, UP).mean.std(axis=0)
    assert u_zero > 0.4 and u_beam.max() < 0.15


def test_promise_by_side_with_its_causes(made, campaign):
    assert set(made.promise) == set(DIRECTIONS) and made.homings == {"pan": 1, "tilt": 1}
    for each in made.promise.values():
        assert each.error95 == each.shift_free95 < each.error95_with_homing
        assert each.causes["homing"] == pytest.approx(1.96 * campaign.rig.priors["home_sd_deg.pan"].value, rel=0.01)
        assert 0 < each.causes["format"] < 0.5 * 0.08
    assert made.hours == pytest.approx(campaign.moves[-1].time_s / 3600)
    assert "home_sd_deg in [rig.prior]" in aimed_text(made) and "right" in aimed_words(made)
    assert made.free_axes == ("pan", "tilt")


def test_a_contrast_of_the_directions_is_in_the_promise_by_travel(calibration, campaign, made):
    contrast = ZERO_NAMES.index("ratio_contrast_deg_per_step.tilt")
    equal = calibration.zeros.copy()
    equal[:, contrast] = 0.0
    without = aimed_promise(replace(calibration, zeros=equal), campaign, "header").promise["up"]
    assert without.causes["travel"] == 0 < made.promise["up"].causes["travel"]
    assert without.error95 < made.promise["up"].error95


def test_a_urdf_leaves_the_play(calibration, campaign, made):
    """Half of a play of 0.8 deg either way: pan is off by 0.4 deg on each side, less one shift common to all."""
    left = aimed_promise(calibration, campaign, "urdf", ("no play",))
    assert left.unsaid == ("no play",)
    for side in ("left", "right"):
        play = calibration.estimates["backlash_deg.pan"]
        assert left.promise[side].causes["format"] > 0.4 * play
        assert left.promise[side].error95 > made.promise[side].error95 + 0.2 * play


def test_two_homings_leave_no_shift_free(calibration, campaign):
    again = [m for m in campaign.moves if m.move >= len(campaign.moves) // 2]
    moves = tuple(replace(m, segment=int(m in again)) for m in campaign.moves)
    twice = aimed_promise(calibration, replace(campaign, moves=moves), "header")
    assert twice.homings == {"pan": 2, "tilt": 2} and twice.free_axes == ()
    assert all(each.error95 == each.error95_with_homing > each.shift_free95 for each in twice.promise.values())
    assert "but for one shift" not in aimed_text(twice)
    longest = max(uses_of(replace(campaign, moves=moves))["pan"].hours, 0)
    assert twice.hours == longest < campaign.moves[-1].time_s / 3600


def test_absolute_encoders_have_no_homing(calibration, campaign):
    table = replace(campaign.rig, absolute=("pan", "tilt"))
    kept = aimed_promise(calibration, replace(campaign, rig=table), "header")
    assert kept.homings == {"pan": 0, "tilt": 0} and kept.free_axes == ()
    assert all(each.error95 > each.shift_free95 for each in kept.promise.values())
    assert all(each.causes["homing"] == 0 for each in kept.promise.values())


def test_results_without_draws_of_the_zeros_promise_nothing(calibration, campaign):
    with pytest.raises(NothingToEstimate, match="no draws of the shifts"):
        aimed_promise(replace(calibration, zeros=np.zeros((0, len(ZERO_NAMES)))), campaign, "header")


def test_shifts_grow_as_formulated():
    zeros = {name: np.array([0.0]) for name in ZERO_NAMES} | {"creep_minutes": np.array([30.0])}
    zeros |= {"creep_deg.pan": np.array([0.1]), "thermal_deg_per_K.pan": np.array([0.02])}
    zeros["ratio_contrast_deg_per_step.pan"] = np.array([1e-4])
    shift = zero_shifts(zeros, "pan", State(0.0, np.array([0.0, 1000.0]), 0.5, np.array([0.0, 3.0])))
    assert shift["creep"][0, 0] == pytest.approx(0.1 * (1 - np.exp(-1)))
    np.testing.assert_allclose(shift["temperature"], [[0.0, 0.06]])
    np.testing.assert_allclose(shift["travel"], [[0.0, 0.05]])


def test_the_document_is_read_again(made):
    assert structs.asdict(made)["promise"] and made.as_json()["table"] == made.table
