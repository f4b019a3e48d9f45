"""A plan run on the firmware itself, on an emulated processor."""

from __future__ import annotations

import pytest
from support.bench_runs import HEADER, RIG_FILE, SPOT_SD_PX, small_plan
from support.emulated_board import EmulatedBoard
from support.emulated_instrument import EmulatedInstrument
from support.firmware_sessions import NO_EMULATOR

from tvsbayes.acquisition.bench import Bench
from tvsbayes.acquisition.engine import Acquisition
from tvsbayes.acquisition.session import begin
from tvsbayes.acquisition.simulated_bench import SIMULATED_START, SimulatedOperator, TwinObserver
from tvsbayes.acquisition.simulated_instrument import Instrument
from tvsbayes.instrument.campaign import pixels_of, read_campaign
from tvsbayes.instrument.rig import read_rig


def measured(instrument: Instrument, folder):
    """Counters and pixels of a run of four looks."""
    rig, plan = instrument.rig, small_plan(1)
    positioner, observer = instrument.positioner(), TwinObserver(instrument, SPOT_SD_PX)
    bench = Bench(
        positioner,
        observer,
        SimulatedOperator(instrument),
        instrument.clock,
        lambda: SIMULATED_START,
        annotate=lambda: {"twin": instrument.state_deg()},
    )
    outcome = Acquisition(rig, plan, begin(folder, rig, plan, False, HEADER), bench).run()
    assert (outcome.reason, outcome.ok) == ("done", 4)
    campaign = read_campaign(folder)
    return [(move.pan_steps, move.tilt_steps) for move in campaign.moves], pixels_of(campaign.spots)


@pytest.mark.slow
@pytest.mark.skipif(bool(NO_EMULATOR), reason=NO_EMULATOR)
def test_emulated_firmware_measures_what_its_model_measures(tmp_path):
    """Same rig, same stops, same noise; only the drift of the zeros depends on real time."""
    rig = read_rig(RIG_FILE)
    counters, pixels = measured(Instrument(rig, 3), tmp_path / "model")
    with EmulatedBoard() as board:
        same_counters, same_pixels = measured(EmulatedInstrument(rig, 3, 0, board), tmp_path / "board")
    assert same_counters == counters
    # Half of the noise of a pixel coordinate, 0.08 px; a step is worth some 5 px.
    assert same_pixels == pytest.approx(pixels, abs=0.04)
