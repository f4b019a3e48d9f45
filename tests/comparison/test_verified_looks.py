"""Looks that a calibration aimed: every world is named, errors are those of the twin, refusals."""

from __future__ import annotations

from dataclasses import replace

import jsonschema
import numpy as np
import pytest
from support.fit_documents import shipped_schema

from experiments.compensation.aimed_scanners import AIMS, aimed
from tvsbayes.assessment.fitted_calibration import calibration_of
from tvsbayes.comparison.verified_looks import accepted_calibration, plan_looks, verify_looks
from tvsbayes.errors import InputError, NothingToEstimate
from tvsbayes.instrument.stops import counters_made, rests_of
from tvsbayes.report.compensation_text import aim_plan_text, verification_text
from tvsbayes.results.compensation_record import (
    APPLIED,
    BROKEN,
    KEPT,
    NOT_APPLIED,
    OTHER_MACHINE,
    TWICE,
    WRONG_SIGN,
)
from tvsbayes.twin.simulated_campaign import simulate

pytestmark = pytest.mark.thorough


@pytest.fixture(scope="module")
def truth(mixed_run):
    return mixed_run.truth


@pytest.fixture(scope="module")
def calibration(mixed_fit):
    return calibration_of(mixed_fit)


@pytest.mark.parametrize(
    ("factors", "world"),
    [
        ((1.0, 1.0), APPLIED),
        ((0.0, 0.0), NOT_APPLIED),
        ((1.0, 0.0), NOT_APPLIED),
        ((2.0, 2.0), TWICE),
        ((-1.0, -1.0), WRONG_SIGN),
    ],
)
def test_every_world_is_named(mounted_rig, mixed_fit, truth, calibration, factors, world):
    """Also where it acts on the play alone."""
    check = verify_looks(mixed_fit, calibration, aimed(mounted_rig, truth, calibration, factors))
    assert check.world == world and check.worlds[world] > 0.95, check.worlds
    assert check.verdict == (KEPT if world == APPLIED else BROKEN)
    assert check.readings == 2 * len(AIMS) and sum(check.worlds.values()) == pytest.approx(1.0)


def test_errors_are_those_of_the_mirrors(mounted_rig, mixed_fit, truth, calibration):
    """Before: what nominal counters leave. At twice the distance points are off twice as far, but for the origin."""
    looks = aimed(mounted_rig, truth, calibration)
    near, far = (verify_looks(mixed_fit, calibration, looks, distance_mm=d) for d in (1000.0, 2000.0))
    assert near.after.worst < 5 * near.promised95 and near.before.rms > 5 * near.after.rms
    mm = near.millimetres
    assert mm.distance_mm == 1000.0
    # A degree of a mirror is 17.5 mm at 1 m of the beam, of both mirrors together at most 1.42 times the larger.
    assert 0.8 * 17.45 * near.after.rms < mm.after.rms < 1.5 * 17.45 * near.after.rms
    assert far.millimetres.after.rms / mm.after.rms == pytest.approx(2.0, abs=0.15)
    assert far.millimetres.promised95 / mm.promised95 == pytest.approx(2.0, abs=0.15)
    np.testing.assert_allclose(far.after.rms, near.after.rms)
    text = verification_text(near)
    assert text.startswith("KEPT: applied") and "12 looks that the calibration aimed" in text and "at 1000 mm" in text
    jsonschema.validate(near.as_json(), shipped_schema("verification-1"))


def test_another_machine_is_none_of_the_worlds(mounted_rig, mixed_fit, truth, calibration):
    parameters = dict(truth.parameters) | {"degrees_per_step.tilt": 1.05 * truth.parameters["degrees_per_step.tilt"]}
    parameters["degrees_per_step.pan"] *= 0.97
    parameters["tilt_zero_deg"] += 0.7
    check = verify_looks(mixed_fit, calibration, aimed(mounted_rig, replace(truth, parameters=parameters), calibration))
    assert (check.verdict, check.world) == (BROKEN, OTHER_MACHINE), check.worlds


def test_a_plan_reaches_its_stops_from_their_sides_and_tells(mounted_rig, mixed_fit, truth, calibration):
    """Its looks are a plan that runs; under the calibration in force they suffice."""
    planned = plan_looks(mixed_fit.campaign, calibration)
    assert planned.enough and len(planned.stops) >= 6 and planned.distance >= 5
    (low, high), (down, up) = calibration.range_steps
    for pan, tilt, pan_side, tilt_side in planned.stops:
        assert low <= pan <= high and down <= tilt <= up and {abs(pan_side), abs(tilt_side)} == {1}
    assert {stop[2] for stop in planned.stops} == {stop[3] for stop in planned.stops} == {-1, 1}
    made = counters_made(mixed_fit.campaign.moves)
    for step in planned.steps("d1"):
        for axis, counter in (("pan", step.pan_steps), ("tilt", step.tilt_steps)):
            assert counter is None or step.action == "home" or made[axis][0] <= counter <= made[axis][1]
    looks = simulate(mounted_rig, planned.steps("d1"), 8, truth).campaign
    rests = {axis: rests_of(looks.moves, axis) for axis in ("pan", "tilt")}
    for spot, (pan, tilt, pan_side, tilt_side) in zip(looks.spots, planned.stops, strict=True):
        reached = [(rests[axis][spot.move].steps, rests[axis][spot.move].sign) for axis in ("pan", "tilt")]
        assert reached == [(pan, pan_side), (tilt, tilt_side)]
    assert verify_looks(mixed_fit, calibration, looks).verdict == KEPT
    assert "standard deviations" in aim_plan_text(planned)
    with pytest.raises(NothingToEstimate, match="nominal counters"):
        plan_looks(mixed_fit.campaign, nominal_of(calibration, mounted_rig))


def nominal_of(calibration, rig):
    """A calibration of the nominal rig."""
    ratios = {
        f"degrees_per_step.{axis}": rig.table.priors[f"degrees_per_step.{axis}"].value for axis in ("pan", "tilt")
    }
    known = dict.fromkeys(calibration.estimates, 0.0) | MIRRORS | ratios
    return replace(calibration, mean=np.r_[list(known.values()), np.zeros(calibration.gears.size)])


MIRRORS = {"mirror_offset_mm": 30.0, "baseline_mm": 200.0, "pan_zero_emission_deg": 90.0}


def test_what_cannot_be_verified_is_refused(mounted_rig, mixed_fit, truth, calibration, tmp_path):
    looks = aimed(mounted_rig, truth, calibration, aims=AIMS[:3], targets=("d1",))
    with pytest.raises(NothingToEstimate, match="3 fresh looks"):
        verify_looks(mixed_fit, calibration, looks)
    with pytest.raises(InputError, match="no calibration of these data"):
        accepted_calibration(replace(looks, path=tmp_path))
