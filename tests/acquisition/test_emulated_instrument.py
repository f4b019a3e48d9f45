"""A plan rehearsed against the firmware itself, on an emulated processor."""

from __future__ import annotations

import pytest
from support.bench_runs import RIG_FILE, small_plan
from support.firmware_sessions import NO_EMULATOR

from tvsbayes.acquisition.session import acquire
from tvsbayes.errors import InputError
from tvsbayes.instrument.campaign import read_campaign
from tvsbayes.instrument.rig import read_rig


def test_without_an_emulator_nothing_is_begun(tmp_path, monkeypatch):
    monkeypatch.setattr("shutil.which", lambda name: None)
    with pytest.raises(InputError, match="qemu-system-arm: not found") as caught:
        acquire(read_rig(RIG_FILE), small_plan(), tmp_path / "run", simulate=True, emulate=True)
    assert "--simulate alone" in caught.value.remedy and not (tmp_path / "run").exists()


@pytest.mark.slow
@pytest.mark.skipif(bool(NO_EMULATOR), reason=NO_EMULATOR)
def test_emulated_firmware_measures_what_its_model_measures(tmp_path):
    """Same rig, same stops, same noise; only the drift of the zeros depends on real time."""
    rig, measured = read_rig(RIG_FILE), {}
    for emulate in (False, True):
        outcome = acquire(rig, small_plan(1), tmp_path / str(emulate), simulate=True, emulate=emulate, seed=3)
        assert (outcome.reason, outcome.ok) == ("done", 4)
        campaign = read_campaign(tmp_path / str(emulate))
        counters = [(move.pan_steps, move.tilt_steps) for move in campaign.moves]
        pixels = ("u_left_px", "v_left_px", "u_right_px", "v_right_px")
        measured[emulate] = counters, [[getattr(spot, name) for name in pixels] for spot in campaign.spots]
    assert measured[True][0] == measured[False][0]
    for ours, model in zip(measured[True][1], measured[False][1], strict=True):
        # Half of the noise of a pixel coordinate, 0.08 px; a step is worth some 5 px.
        assert ours == pytest.approx(model, abs=0.04)
