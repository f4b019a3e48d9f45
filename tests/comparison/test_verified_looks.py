"""Looks that a calibration aimed: every world is named, errors are those of the twin, refusals."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from support.aimed_looks import AIMS, aimed

from tvsbayes.assessment.fitted_calibration import calibration_of
from tvsbayes.comparison.verified_looks import accepted_calibration, verify_looks
from tvsbayes.errors import InputError, NothingToEstimate
from tvsbayes.instrument.protocols import four_point_protocol
from tvsbayes.report.compensation_text import verification_text
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

SCHEMAS = Path(__file__).resolve().parents[2] / "data" / "schemas"


@pytest.fixture(scope="module")
def truth(mounted_rig):
    """Of the rig that `mixed_fit` was made from."""
    return simulate(mounted_rig, four_point_protocol(repeats=4, steps=(100, 200)), seed=3).truth


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
    """Also where it befell the play alone."""
    found = verify_looks(mixed_fit, calibration, aimed(mounted_rig, truth, calibration, factors))
    assert found.world == world and found.worlds[world] > 0.95, found.worlds
    assert found.verdict == (KEPT if world == APPLIED else BROKEN)
    assert found.readings == 2 * len(AIMS) and sum(found.worlds.values()) == pytest.approx(1.0)


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
    jsonschema.validate(near.as_json(), json.loads((SCHEMAS / "verification-1.schema.json").read_text()))


def test_another_machine_is_none_of_the_worlds(mounted_rig, mixed_fit, truth, calibration):
    parameters = dict(truth.parameters) | {"degrees_per_step.tilt": 1.05 * truth.parameters["degrees_per_step.tilt"]}
    parameters["degrees_per_step.pan"] *= 0.97
    parameters["tilt_zero_deg"] += 0.7
    found = verify_looks(mixed_fit, calibration, aimed(mounted_rig, replace(truth, parameters=parameters), calibration))
    assert (found.verdict, found.world) == (BROKEN, OTHER_MACHINE), found.worlds


def test_what_cannot_be_verified_is_refused(mounted_rig, mixed_fit, truth, calibration, tmp_path):
    looks = aimed(mounted_rig, truth, calibration, aims=AIMS[:3], targets=("d1",))
    with pytest.raises(NothingToEstimate, match="3 fresh looks"):
        verify_looks(mixed_fit, calibration, looks)
    with pytest.raises(InputError, match="no calibration of these data"):
        accepted_calibration(replace(looks, path=tmp_path))
