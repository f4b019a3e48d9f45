"""Simulated test cycles, by hand and against the twin."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from support.bent_rig import BENT, WOBBLE
from support.known_calibration import known_calibration

from tvsbayes.metrology.simulated_cycles import simulated_runs, target_steps
from tvsbayes.twin.physics import harmonics_deg, mirror_chain, transmission


def test_unequal_ratios_carry_every_run_on():
    """K up = k + c/2, k down = k - c/2 (formulation 3.1): a cycle over travel L gains c L; by hand, step for step."""
    c, targets, runs = 1e-4, (0, 100, 200), 3
    up, down = simulated_runs(
        known_calibration(), "pan", targets, 0.06, runs=runs, tests=1, contrast_deg_per_step=np.full(50, c)
    )
    q = 0.06 * targets[0]
    for run in range(runs):
        for k, n in enumerate(targets):
            q += (0.06 + c / 2) * (n - targets[k - 1]) if k else 0.0
            assert up[0, k, run] == pytest.approx(q - 0.06 * n, abs=1e-9)
        for k in range(len(targets) - 1, -1, -1):
            step = targets[k] - targets[k + 1] if k + 1 < len(targets) else 0
            q += (0.06 - c / 2) * step
            assert down[0, k, run] == pytest.approx(q - 0.06 * targets[k], abs=1e-9)


@pytest.mark.parametrize("period_deg", [360.0, 9.0])
def test_a_run_on_a_bent_rig_is_the_twins(period_deg):
    """Gears, play, transmission error and mirrors against the twin's own, along the counters of a test."""
    rig = {**BENT, **WOBBLE}
    one = replace(
        known_calibration(**rig),
        period_deg={"pan": period_deg, "tilt": period_deg},
        range_steps=np.array([[-80.0, 280.0], [-40.0, 60.0]]),
    )
    targets, beyond = (-60, 20, 90, 160, 250), 40
    for axis, name in enumerate(("pan", "tilt")):
        up, down = simulated_runs(one, name, targets, 0.06, runs=2, tests=1)
        path = [-60 - beyond, *(2 * [*targets, 250 + beyond, *targets[::-1], -60 - beyond])]
        first = np.arange(len(path)) == 0
        # The other axis: its counters' middle, in mid-play.
        other = ("tilt", "pan")[axis]
        middle = one.range_steps[1 - axis].mean()
        angles = {}
        for a, counters, homed, start in ((name, path, first, -0.5), (other, [middle], np.array([True]), 0.0)):
            ratio, harmonics = (rig[f"degrees_per_step.{a}"], 0.0), harmonics_deg(rig, a)
            zeros = np.zeros(len(counters))
            play = rig[f"backlash_deg.{a}"]
            angles[a] = transmission(
                np.array(counters), homed, zeros + start, zeros, ratio, play, harmonics, period_deg
            )
        psi, beta = np.radians(angles["pan"]), np.radians(angles["tilt"] + rig["tilt_zero_deg"])
        beam = mirror_chain(psi, beta, rig).direction
        angle = np.degrees(np.arctan2(beam[:, 1], beam[:, 0]) if name == "pan" else np.arcsin(beam[:, 2]))
        deviation = angle - 0.06 * np.array(path)
        runs = deviation[1:].reshape(2, 12)
        # 1e-9 deg: rounding of angles up to 20 deg through two reflections.
        np.testing.assert_allclose(up[0].T, runs[:, :5], atol=1e-9)
        np.testing.assert_allclose(down[0].T, runs[:, 6:11][:, ::-1], atol=1e-9)


def test_stop_errors_scatter_runs_by_side():
    sds = {"stop_sd_deg.left": 0.2, "stop_sd_deg.right": 0.05}
    up, down = simulated_runs(known_calibration(**sds), "pan", (0, 50, 100, 200), 0.06, runs=5, tests=500)
    count = up.size
    # 1e-4 bounds of the standard deviation of `count` normal numbers; the chain is 1:1.
    for values, sd in ((up, 0.2), (down, 0.05)):
        assert values.std() == pytest.approx(sd, rel=4 / np.sqrt(2 * count))
    assert abs(np.corrcoef(up.ravel(), down.ravel())[0, 1]) < 4 / np.sqrt(count)


def test_targets_avoid_the_turn_round_points_and_repeat():
    steps = target_steps(-100, 300, 0.06)
    assert steps == target_steps(-100, 300, 0.06) and len(steps) == 5
    assert -100 < steps[0] and steps[-1] < 300 and list(steps) == sorted(set(steps))
    assert len({b - a for a, b in pairwise(steps)}) > 1
    assert target_steps(0, 2, 0.06) == ()
