"""A whole run on a foreign board: GRBL behind the engine, from the first homing to a resumed end."""

from __future__ import annotations

import datetime
from dataclasses import replace

import numpy as np
import pytest
from support.bench_runs import events, small_plan
from support.grbl_board import BoardLink, GrblBoard

from tvsbayes.acquisition.bench import Bench
from tvsbayes.acquisition.engine import Acquisition
from tvsbayes.acquisition.journal import read_journal
from tvsbayes.acquisition.observation import DetectedSpot, Observation
from tvsbayes.acquisition.recorder import recorded
from tvsbayes.acquisition.session import begin
from tvsbayes.errors import DeviceFault
from tvsbayes.instrument.campaign import read_campaign
from tvsbayes.instrument.counter_limits import CounterLimits
from tvsbayes.instrument.stereo_pair import Stereo
from tvsbayes.positioner.grbl import GrblPositioner, GrblSettings

pytestmark = pytest.mark.usefixtures("ctrl_c_works")
LIMITS = CounterLimits({"pan": (-100, 300), "tilt": (-100, 100)})
CREATED = datetime.datetime(2026, 1, 1, tzinfo=datetime.UTC)


class Hand:
    """Puts every sheet at its target."""

    target = ""

    def accept(self, hazard):
        return True

    def place(self, target, x_mm, placement, remark):
        self.target = target
        return True


class Eye:
    """Sees the middle of the sheet while the laser is on; something happens at the n-th look."""

    def __init__(self, stereo: Stereo, hand: Hand, sheets_mm, board, at=0, action=lambda board: None):
        self.stereo, self.hand, self.sheets_mm, self.board = stereo, hand, sheets_mm, board
        self.left, self.action = at, action

    def observe(self, positioner, spot):
        self.left -= 1
        if self.left == 0:
            self.action(self.board)
        assert positioner.laser(True).laser_on and self.board.laser_on
        positioner.laser(False)
        depth = self.sheets_mm[self.hand.target]
        u = self.stereo.M1[0, 2], self.stereo.M2[0, 2] - self.stereo.M2[0, 0] * np.linalg.norm(self.stereo.T) / depth
        pixels = u[0], self.stereo.M1[1, 2], u[1], self.stereo.M2[1, 2]
        return Observation(DetectedSpot("ok", tuple(map(float, pixels)), (0.1,) * 4))


def engine(rig, folder, board, resume=False, plan=None, **happening):
    positioner = GrblPositioner(
        lambda: BoardLink(board), GrblSettings(laser="M8", unwatched=True, limits=LIMITS), board.clock
    )
    hand = Hand()
    eye = Eye(rig.stereo, hand, rig.sheets_mm, board, **happening)
    utc = lambda: CREATED + datetime.timedelta(seconds=board.clock.monotonic())  # noqa: E731
    bench = Bench(positioner, eye, hand, board.clock, utc, {"device": dict(positioner.identity)})
    plan = plan or small_plan(2)
    journal = begin(folder, rig, plan, resume, {"name": "grbl", "created": CREATED.isoformat()})
    return Acquisition(rig, plan, journal, bench)


def test_a_run_on_a_grbl_board_that_is_reset_and_resumed(mounted_rig, tmp_path):
    """What GRBL does not report is recorded as unknown: whether steps were lost."""
    rig, board = replace(mounted_rig, positioner={"driver": "grbl", "port": "/dev/ttyUSB0"}), GrblBoard()
    with pytest.raises(DeviceFault) as caught:
        engine(rig, tmp_path / "c", board, at=4, action=lambda board: board.power_on()).run()
    assert caught.value.code == "reset" and not board.laser_on
    outcome = engine(rig, tmp_path / "c", board, resume=True).run()
    assert outcome.reason == "done" and not board.laser_on and not board.lit_in_motion
    campaign, record = read_campaign(tmp_path / "c"), recorded(read_journal(tmp_path / "c").records)
    looked = [(s.experiment, s.point) for s in campaign.spots if s.experiment is not None]
    assert looked == [(n, point) for n in (0, 1) for point in (1, 2, 3, 4)]
    assert {move.segment for move in campaign.moves} == {0, 1} and record.unverified == (0, 1) and not record.lost
    start = events(tmp_path / "c", "start")[0]
    assert start["device"]["fw"] == "Grbl 1.1h" and start["setup"]["positioner.port"] == "/dev/ttyUSB0"
