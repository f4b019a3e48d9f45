"""The twin behind the device model against the twin that follows a plan."""

from __future__ import annotations

import datetime
from dataclasses import replace

import numpy as np
import pytest
from support.bench_runs import HEADER, small_plan

from tvsbayes.acquisition.bench import Bench
from tvsbayes.acquisition.engine import Acquisition
from tvsbayes.acquisition.session import begin
from tvsbayes.acquisition.simulated_bench import SIMULATED_START, SimulatedOperator, TwinObserver
from tvsbayes.acquisition.simulated_instrument import Instrument
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.campaign import read_campaign
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.parameters import Prior
from tvsbayes.twin.physics import mirror_chain
from tvsbayes.twin.simulated_campaign import simulate
from tvsbayes.twin.true_rig import draw_truth


def test_light_behind_the_device_is_that_of_the_twin(mounted_rig, tmp_path, monkeypatch):
    """Without chance the engine on the device model sees what `simulate` computes from the plan."""
    for name in ("SHEET_DEPTH_SD_MM", "SHEET_TILT_SD_DEG"):
        monkeypatch.setattr(f"tvsbayes.twin.simulated_campaign.{name}", 0.0)
    # Gears that repeat their errors; drift goes with the time, and the engine's clock is not the plan's.
    scales = {"transmission_error_deg": 0.05, "play_variation_deg": 0.02}
    geared = {f"{name}.{axis}": Prior(scale, 0.0) for name, scale in scales.items() for axis in AXES}
    truth = draw_truth(replace(mounted_rig, truth={**mounted_rig.truth, **geared}), np.random.default_rng(3))
    still = {name: 0.0 for name in truth.parameters if name.startswith(("stop_sd_deg", "drift", "home_sd"))}
    truth = replace(truth, parameters={**truth.parameters, **still, "pixel_scale": 0.0})
    plan = small_plan(3, rehome=True)
    wanted = simulate(mounted_rig, plan, 1, truth).campaign
    instrument = Instrument(mounted_rig, 1, truth=truth)
    folder = tmp_path / "c"
    Acquisition(
        mounted_rig,
        plan,
        begin(folder, mounted_rig, plan, False, HEADER),
        Bench(
            instrument.positioner(),
            TwinObserver(instrument, 0.08),
            SimulatedOperator(instrument),
            instrument.clock,
            lambda: SIMULATED_START + datetime.timedelta(seconds=instrument.clock.monotonic()),
        ),
    ).run()
    campaign = read_campaign(folder)
    assert [(m.segment, m.pan_steps, m.pan_approach) for m in campaign.moves] == [
        (m.segment, m.pan_steps, m.pan_approach) for m in wanted.moves
    ]
    names = ("u_left_px", "v_left_px", "u_right_px", "v_right_px")
    ours, theirs = ([[getattr(s, n) for n in names] for s in c.spots] for c in (campaign, wanted))
    # Motion by motion against commanded counters: the same angles to rounding, 1e-12 rad x 1000 px.
    assert np.abs(np.subtract(ours, theirs)).max() < 1e-8


def at_rest(rig, **parameters: float):
    """An instrument of a drawn rig with some parameters stated, and its positioner, homed and moved to 0, 0."""
    truth = draw_truth(rig, np.random.default_rng(4))
    instrument = Instrument(rig, 6, truth=replace(truth, parameters={**truth.parameters, **parameters}))
    positioner = instrument.positioner()
    positioner.home()
    positioner.move_to(0, 0)
    return instrument, positioner


def test_a_look_lasts_from_laser_on_to_laser_off(mounted_rig):
    """All frames of a look see one beam, the next look at the same stop another: by 0.05 deg of pan, over 200 looks."""
    instrument, positioner = at_rest(mounted_rig, **{"look_scatter_deg.pan": 0.05})
    directions = []
    for _ in range(200):
        positioner.laser(True)
        first, second = instrument.light().directions, instrument.light().directions
        assert np.array_equal(first, second)
        directions.append(first)
        positioner.laser(False)
    psi, beta = np.radians(instrument.state_deg().mirror_angles_deg)
    one, two = (mirror_chain(psi + step, beta, instrument.truth.parameters).direction for step in (0.0, 1e-6))
    expected = np.radians(0.05) * np.linalg.norm(two - one) / 1e-6
    off = np.linalg.norm(np.array(directions) - np.mean(directions, axis=0), axis=1)
    # Four standard errors of an sd of 200.
    assert np.sqrt(np.mean(off**2)) == pytest.approx(expected, rel=4 / np.sqrt(400))


def test_zero_drifts_with_the_clock_and_a_homing_finds_it(mounted_rig):
    """Scale x root of the hours between two motions, over 200 of them; nothing moves while a camera looks on."""
    still = {name: 0.0 for name in TWO_MIRROR.rig_names if name.startswith(("stop_sd_deg", "backlash_deg"))}
    instrument, positioner = at_rest(mounted_rig, **still, **{"drift_deg_per_root_hour.pan": 0.3})
    changes, angle_deg = [], instrument.state_deg().mirror_angles_deg[0]
    for number in range(200):
        instrument.clock.sleep(3600.0)
        instrument.light()
        assert instrument.state_deg().mirror_angles_deg[0] == angle_deg
        positioner.move_to(0 if number % 2 else 1, 0)
        now_deg = instrument.state_deg().mirror_angles_deg[0]
        changes.append(now_deg - angle_deg)
        angle_deg = now_deg
    p = instrument.truth.parameters
    driven = np.where(np.arange(200) % 2, -p["degrees_per_step.right"], p["degrees_per_step.left"])
    # Four standard errors of an sd of 200.
    assert np.std(np.array(changes) - driven) == pytest.approx(0.3, rel=4 / np.sqrt(400))
    positioner.home()
    positioner.move_to(0, 0)
    # What is left is the home offset.
    assert abs(instrument.state_deg().mirror_angles_deg[0]) < 5 * p["home_sd_deg.pan"]
