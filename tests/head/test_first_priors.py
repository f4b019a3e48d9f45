"""First priors of a head: ratios and zeros by a line through its sightings, or by its encoders."""

from __future__ import annotations

import numpy as np
import pytest

from tvsbayes.head.first_priors import falls, first_priors, line_of
from tvsbayes.importing.sightings import STEP_DEG
from tvsbayes.instrument.campaign import Move
from tvsbayes.instrument.sightings import Sighting

STEPS = [(-9000, 100), (0, 2000), (9000, 4000), (25000, 6000), (41000, 8000)]
"""Of ratios 0.01 and 0.005 deg: azimuth passes 360 deg on the way."""


def priors(zero_deg=0.0, sign=1, encoders=frozenset()):
    rows = enumerate(STEPS)
    fields = [{"move": k, "time_s": float(k), "pan_steps": sign * pan, "tilt_steps": t} for k, (pan, t) in rows]
    moves = [Move(segment=0, **row) for row in fields]
    sightings = [
        Sighting(sighting=k, move=k, azimuth_deg=(0.01 * pan + zero_deg) % 360, elevation_deg=0.005 * tilt, u_deg=0.01)
        for k, (pan, tilt) in enumerate(STEPS)
    ]
    assumed = []
    return first_priors(moves, sightings, encoders, assumed), " ".join(assumed), falls(moves, sightings, "pan")


@pytest.mark.parametrize(("azimuth_deg", "zeros"), [(0.0, {}), (170.0, {"azimuth_zero_deg": 170.0})])
def test_a_zero_far_from_the_default_is_stated(azimuth_deg, zeros):
    """On any turn of the azimuth; a near one lies within the default prior."""
    found, assumed, _ = priors(azimuth_deg)
    assert {name: prior.value for name, prior in found.items() if "zero" in name} == pytest.approx(zeros)
    assert ("azimuth_zero_deg" in assumed) == bool(zeros)
    assert found["degrees_per_step.pan"].value == pytest.approx(0.01)
    assert found["degrees_per_step.tilt"].value == pytest.approx(0.005, rel=0.02)


def test_an_encoder_has_the_ratio_of_its_steps():
    assert priors(encoders=frozenset({"pan", "tilt"}))[0]["degrees_per_step.tilt"].value == STEP_DEG


@pytest.mark.parametrize("sign", [1, -1])
def test_a_reversed_counter_is_named(sign):
    _, assumed, is_falling = priors(sign=sign)
    assert ("add --flip pan_steps" in assumed) == is_falling == (sign < 0)


def test_no_ratio_of_angles_that_lie_on_no_line():
    rng = np.random.default_rng(3)
    assert line_of(np.arange(12.0), rng.uniform(0, 360, 12)) is None
    assert line_of(np.array([0.0, 0.0, 5.0]), np.array([1.0, 1.0, 2.0])) is None
