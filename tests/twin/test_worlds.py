"""Worlds of the robustness experiments: each errs as declared, and in nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from experiments.common.rigs import shipped_plan
from experiments.common.worlds import PERIOD_DEG, STEP_AT_DEG, WARM_UP_HOURS, WORLDS, campaign_of
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.parameters import GEAR_ERROR_NAMES
from tvsbayes.instrument.rig import Rig
from tvsbayes.twin.simulated_campaign import simulate


def perfect(rig: Rig) -> Rig:
    """True rigs with gears that repeat no error."""
    none = {n: replace(rig.truth[n], value=0.0, u=0.0) for n in GEAR_ERROR_NAMES if "length" not in n}
    return replace(rig, truth={**rig.truth, **none})


@pytest.mark.parametrize("world", WORLDS)
def test_a_world_errs_by_its_size_and_leaves_all_else(mounted_rig, world):
    plan = shipped_plan("paper")
    plain, run = simulate(perfect(mounted_rig), plan, 3), campaign_of(mounted_rig, plan, world, 0.1, 3)
    assert run.truth.stop_errors_deg == plain.truth.stop_errors_deg
    assert np.array_equal(run.truth.stereo.vector, plain.truth.stereo.vector)
    assert run.campaign.moves == plain.campaign.moves
    shift = np.subtract(run.truth.mirror_angles_deg, plain.truth.mirror_angles_deg)
    for axis, name in enumerate(AXES):
        place = run.truth.parameters[f"degrees_per_step.{name}"] * np.array(
            [getattr(move, f"{name}_steps") for move in run.campaign.moves], float
        )
        error = shift[:, axis]
        if world == "step":
            assert error == pytest.approx(0.1 * (place > STEP_AT_DEG[name]), abs=1e-12) and np.ptp(error) > 0.09
        elif world == "warm-up":
            hours = np.array([move.time_s for move in run.campaign.moves]) / 3600
            # One segment: the zero is that of the homing at its begin, 0 hours.
            assert error == pytest.approx(0.1 * (1 - np.exp(-hours / WARM_UP_HOURS)), abs=1e-12)
        else:
            wave = np.exp(2j * np.pi * place / PERIOD_DEG[world])
            parts = np.linalg.lstsq(np.column_stack([wave.real, wave.imag]), error, rcond=None)[0]
            assert np.hypot(*parts) == pytest.approx(0.1, abs=1e-9)
            assert error == pytest.approx(parts[0] * wave.real + parts[1] * wave.imag, abs=1e-12)
