"""The twin behind the device model against the twin that follows a plan."""

from __future__ import annotations

import datetime
from dataclasses import replace

import numpy as np
from support.bench_runs import HEADER, small_plan

from tvsbayes.acquisition.bench import SIMULATED_START, Bench
from tvsbayes.acquisition.engine import Acquisition
from tvsbayes.acquisition.observation import TwinObserver
from tvsbayes.acquisition.operator import SimulatedOperator
from tvsbayes.acquisition.session import begin
from tvsbayes.acquisition.simulated_instrument import Instrument
from tvsbayes.instrument.campaign import read_campaign
from tvsbayes.twin.simulated_campaign import simulate
from tvsbayes.twin.true_rig import draw_truth


def test_light_behind_the_device_is_that_of_the_twin(mounted_rig, tmp_path, monkeypatch):
    """Without chance the engine on the device model sees what `simulate` computes from the plan."""
    for name in ("SHEET_DEPTH_SD_MM", "SHEET_TILT_SD_DEG", "HOME_SD_DEG"):
        monkeypatch.setattr(f"tvsbayes.twin.simulated_campaign.{name}", 0.0)
    monkeypatch.setattr("tvsbayes.acquisition.simulated_instrument.HOME_SD_DEG", 0.0)
    truth = draw_truth(mounted_rig, np.random.default_rng(3))
    still = {name: 0.0 for name in truth.parameters if name.startswith("stop_sd_deg")}
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
    found = read_campaign(folder)
    assert [(m.segment, m.pan_steps, m.pan_approach) for m in found.moves] == [
        (m.segment, m.pan_steps, m.pan_approach) for m in wanted.moves
    ]
    names = ("u_left_px", "v_left_px", "u_right_px", "v_right_px")
    ours, theirs = ([[getattr(s, n) for n in names] for s in c.spots] for c in (found, wanted))
    # Motion by motion against commanded counters: the same angles to rounding, 1e-12 rad x 1000 px.
    assert np.abs(np.subtract(ours, theirs)).max() < 1e-8


def test_camera_that_looks_on_does_not_change_the_motion(mounted_rig):
    """The way from the home switch follows the mean ratio, whatever a camera's thread asks meanwhile."""
    ends = []
    for watched in (False, True):
        instrument = Instrument(mounted_rig, 5)
        positioner = instrument.positioner()
        positioner.home()
        if watched:
            instrument.light()
        positioner.move_to(0, 0)
        ends.append(instrument.state_deg())
    assert ends[0] == ends[1]
    p = instrument.truth.parameters
    assert abs(p["degrees_per_step.left"] - p["degrees_per_step.pan"]) > 1e-6, "else nothing is shown"
