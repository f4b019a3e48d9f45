"""Counters for points and directions: back through the twin's optics, sides, limits, run-up."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from support.bent_rig import (
    AXES,
    ROUNDING_MM,
    twin_angle_deg,
    twin_ray_at,
)
from support.refusals import refusal

from tvsbayes.assessment.fitted_calibration import CLEARED_PROBABILITY, _overshoot_steps
from tvsbayes.calibration.pointing import INPUT_NAMES, Calibration
from tvsbayes.statistics.intervals import NORMAL_95
from tvsbayes.twin import physics

GRID = tuple(product((200.0, 350.0, 700.0, 1500.0), (-200.0, -50.0, 100.0, 200.0), (-150.0, 0.0, 60.0, 150.0)))


def test_steps_for_a_point_come_back_to_it(either):
    for target in GRID:
        steps = either.steps_for(target)
        assert steps.approach == ("left", "up")
        counters = (steps.pan_steps, steps.tilt_steps)
        ray = either.ray(*counters, steps.approach)
        np.testing.assert_array_equal(steps.ray.direction, ray.direction)
        point = either.locate(*counters, steps.aperture_deg, steps.approach).xyz_mm
        # The reading's rounding of 1e-14 of 100 deg, times at most 700 mm per degree at 1.5 m.
        assert np.abs(point - steps.xyz_mm).max() < 1e-6
        across = target - steps.xyz_mm
        assert abs(across @ ray.direction) < ROUNDING_MM * 10
        assert steps.rounding_mm == pytest.approx(np.linalg.norm(across), rel=1e-12)
        # Half a step of each axis in mm across the beam, here; the step's own curvature is 0.0005 rad of it.
        reach = (steps.xyz_mm - ray.origin_mm) @ ray.direction
        half_mm = 0.0
        for axis in range(2):
            corners = [either.ray(*(np.array(counters) + s * 0.5 * np.eye(2)[axis]), steps.approach) for s in (1, -1)]
            moved = [c.origin_mm + reach * c.direction - steps.xyz_mm for c in corners]
            half_mm += max(np.linalg.norm(m - (m @ ray.direction) * ray.direction) for m in moved)
        assert steps.rounding_mm <= half_mm * 1.001
        assert steps.rounding_deg is None and steps.u95_deg is None


def test_half_widths_of_the_beam_are_the_draws(bent):
    """Every draw's beam with its own stop error, by the twin; 95 % of a normal distribution."""
    steps = bent.steps_for((700.0, 30.0, 60.0))
    reach = (steps.xyz_mm - steps.ray.origin_mm) @ steps.ray.direction
    stop = np.random.default_rng(8).standard_normal((len(bent.inputs), 2)) * np.sqrt(
        [bent.noise_variance["stop_sd_deg.left"], bent.noise_variance["stop_sd_deg.up"]]
    )
    points, angles = [], []
    for row, error in zip(bent.inputs, stop, strict=True):
        values = dict(zip(INPUT_NAMES, row, strict=True))
        pan = twin_angle_deg(values, "pan", steps.pan_steps, -0.5) + error[0]
        tilt = twin_angle_deg(values, "tilt", steps.tilt_steps, -0.5) + error[1]
        o, d = twin_ray_at(values, pan, tilt)
        points.append(o + reach * d)
        angles.append(np.degrees([math.atan2(d[1], d[0]), math.asin(d[2])]))
    directions = bent.steps_for(azimuth_deg=angles[0][0], elevation_deg=angles[0][1])
    # Five standard errors sqrt(1 / 2n) of a standard deviation; the angles' u hardly depends on the pose.
    bound = 5 * math.sqrt(0.5 / len(points)) + 0.01
    np.testing.assert_allclose(steps.u95_mm, NORMAL_95 * np.std(points, axis=0), rtol=bound)
    np.testing.assert_allclose(directions.u95_deg, NORMAL_95 * np.std(angles, axis=0), rtol=bound)


def test_the_approach_is_obeyed_or_the_other_side_is_taken(bent):
    target = (600.0, 40.0, 50.0)
    free = bent.steps_for(target)
    for approach in product(("left", "right"), ("up", "down")):
        steps = bent.steps_for(target, approach=approach)
        assert steps.approach == approach
        signs = [-1 if side in ("left", "up") else 1 for side in approach]
        assert steps.via_pan_steps == steps.pan_steps + signs[0] * bent.overshoot_steps["pan"]
        assert steps.via_tilt_steps == steps.tilt_steps + signs[1] * bent.overshoot_steps["tilt"]
        # The other side's counter stands b / k steps lower: the same beam within the rounding of both.
        play_steps = bent.estimates["backlash_deg.pan"] / bent.estimates["degrees_per_step.pan"]
        assert abs(free.pan_steps - steps.pan_steps - play_steps * (approach[0] == "right")) <= 1.0
    # From the left the pan would start below `low`.
    low = free.pan_steps - bent.overshoot_steps["pan"] + 1
    other = bent.steps_for(target, limits={"pan": (low, 1000)})
    assert other.approach == ("right", "up")
    assert other.pan_steps >= low and other.via_pan_steps > other.pan_steps
    edge = bent.steps_for(target, limits={"pan": (low - 1, 1000)})
    assert edge.approach == ("left", "up"), "a limit itself may be reached"
    error = refusal(lambda: bent.steps_for(target, limits={"pan": (low, 1000)}, approach=("left", "up")))
    assert (error.code, error.column) == ("outside-limits", "pan")
    assert error.found == f"{free.pan_steps} and {low - 1}" and error.allowed == f"{low} to 1000"


def test_targets_out_of_limits_or_reach_are_refused(bent):
    error = refusal(lambda: bent.steps_for((600.0, 40.0, 200.0), limits={"tilt": (-50, 50)}))
    assert (error.code, error.column, error.allowed) == ("outside-limits", "tilt", "-50 to 50") and error.remedy
    for target in ((0.0, 100.0, 0.0), (math.nan, 0.0, 0.0), (5.0, 80.0, 900.0), (-400.0, 50.0, 10.0)):
        error = refusal(lambda target=target: bent.steps_for(target))
        assert error.code == "out-of-reach" and error.allowed and error.remedy
    for azimuth, elevation in ((0.0, 95.0), (math.inf, 0.0), (95.0, 0.0)):
        wanted = {"azimuth_deg": azimuth, "elevation_deg": elevation}
        assert refusal(lambda wanted=wanted: bent.steps_for(**wanted)).code == "out-of-reach"
    point = {"xyz_mm": (600.0, 40.0, 0.0)}
    both = {"azimuth_deg": 1.0, "elevation_deg": 1.0}
    for wanted in (
        {},
        {"azimuth_deg": 1.0},
        point | both,
        point | {"azimuth_deg": 40.0},
        point | {"elevation_deg": 1.0},
    ):
        assert refusal(lambda wanted=wanted: bent.steps_for(**wanted)).code == "no-target"


def play_gone(one: Calibration, axis: str, start: int, end: int, sign: int) -> float:
    """Share of the draws in which a move takes up all play, from its worst state, by the twin's gear."""
    gone = []
    for row in one.inputs:
        values = dict(zip(INPUT_NAMES, row, strict=True))
        ratio, play = values[f"degrees_per_step.{axis}"], values[f"backlash_deg.{axis}"]
        output = physics.play([ratio * start, ratio * end], ratio * start + sign * play / 2, play)[-1]
        gone.append(abs(output - (ratio * end - sign * play / 2)) < 1e-9)
    return float(np.mean(gone))


@pytest.mark.parametrize("approach", [("left", "up"), ("right", "down")])
def test_the_way_over_via_takes_up_all_play(bent, approach):
    assert CLEARED_PROBABILITY == 0.99
    column = {name: bent.inputs[:, i] for i, name in enumerate(INPUT_NAMES)}
    one = replace(bent, overshoot_steps={axis: _overshoot_steps(column, axis) for axis in AXES})
    steps = one.steps_for((600.0, 40.0, 50.0), approach=approach)
    for axis, side in zip(AXES, approach, strict=True):
        sign = 1 if side in ("left", "up") else -1
        via, end = (getattr(steps, f"{way}{axis}_steps") for way in ("via_", ""))
        assert play_gone(one, axis, via, end, sign) >= CLEARED_PROBABILITY
        assert play_gone(one, axis, via + sign, end, sign) < CLEARED_PROBABILITY


def test_steps_as_json_are_plain(bent):
    document = bent.steps_for((600.0, 40.0, 50.0)).as_json()
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    assert document["approach"] == {"pan": "left", "tilt": "up"}
    assert set(document["ray"]) == {"origin_mm", "direction"}
