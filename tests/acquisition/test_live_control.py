"""Requests carried out by the engine on the device model: acknowledged by the device, in the journal, the laser off."""

from __future__ import annotations

import numpy as np
import pytest
from support.bench_runs import Run, events, raise_error, small_plan
from support.live_runs import scripted_run

from tvsbayes.acquisition.journal import read_journal
from tvsbayes.acquisition.journal_check import verify
from tvsbayes.acquisition.live_control import LightRefused
from tvsbayes.acquisition.live_run import LiveRun
from tvsbayes.acquisition.observation import CameraObserver
from tvsbayes.acquisition.recorder import recorded
from tvsbayes.cameras.capture import StereoImage
from tvsbayes.errors import DeviceFault
from tvsbayes.instrument.campaign import read_campaign

pytestmark = pytest.mark.usefixtures("ctrl_c_works")


def requests(folder) -> list[tuple[str, bool]]:
    """What the journal holds of requests: what, and whether the laser was on then."""
    return [(asked["what"], asked["device"]["laser_on"]) for asked in events(folder, "asked")]


def states(live: LiveRun) -> list[tuple[str, str]]:
    return [(request.what, request.state) for request in live.requests.recent()]


def run_with(rig, folder, live, at, *whats, **options) -> Run:
    """A run in whose look number `at` something is requested, with the laser on."""

    def ask(instrument):
        for what in whats:
            live.ask(what)

    return Run(rig, folder, at=at, then=ask, live=live, **options)


def test_pause_and_resume_lose_nothing(mounted_rig, tmp_path):
    live = scripted_run("resume")
    run = run_with(mounted_rig, tmp_path / "c", live, 3, "pause")
    pauses = []
    wait = live.requests.wait
    live.requests.wait = lambda longest_s: (pauses.append((live.latest.state, live.latest.device.laser_on)), wait(1))
    outcome = run.engine.run()
    assert (outcome.reason, outcome.looks, outcome.ok) == ("done", 8, 8)
    assert pauses == [("paused", False)]
    assert requests(tmp_path / "c") == [("pause", False), ("resume", False)]
    assert states(live) == [("pause", "acknowledged"), ("resume", "acknowledged")]
    assert all("laser off" in request.answer and request.waited_s >= 0 for request in live.requests.recent())
    times = [r.data["time_s"] for r in read_journal(tmp_path / "c").records if "time_s" in r.data]
    assert times == sorted(times) and run.dark() and verify(tmp_path / "c").stopped == "done"


def test_stop_ends_in_good_order_and_the_rest_is_resumed(mounted_rig, tmp_path):
    live = LiveRun()
    run = run_with(mounted_rig, tmp_path / "c", live, 3, "stop")
    outcome = run.engine.run()
    assert (outcome.reason, outcome.looks) == ("interrupted", 3) and run.dark()
    assert requests(tmp_path / "c") == [("stop", False)] and states(live) == [("stop", "acknowledged")]
    assert (live.latest.state, live.latest.reason, live.latest.fault) == ("ended", "interrupted", None)
    again = Run(mounted_rig, tmp_path / "c", resume=True, start=1)
    assert again.engine.run().reason == "done"
    assert len({(s.experiment, s.point) for s in read_campaign(tmp_path / "c").spots if s.experiment is not None}) == 8


def test_laser_off_breaks_off_the_look_which_is_taken_again(mounted_rig, tmp_path):
    live = scripted_run("resume")
    run = run_with(mounted_rig, tmp_path / "c", live, 3, "laser off")
    lit = []
    laser = run.positioner.laser

    def watched(on):
        lit.append((on, [r.what for r in live.requests.recent() if r.state == "requested"]))
        return laser(on)

    run.positioner.laser = watched
    outcome = run.engine.run()
    assert (outcome.reason, outcome.looks, outcome.ok, outcome.retries) == ("done", 8, 8, 0)
    # The first order after the request is the requested one.
    assert [on for on, waiting in lit if "laser off" in waiting] == [False]
    assert requests(tmp_path / "c") == [("laser off", False), ("resume", False)]
    assert run.dark()


def test_laser_off_then_stop(mounted_rig, tmp_path):
    live = scripted_run("stop")
    run = run_with(mounted_rig, tmp_path / "c", live, 3, "laser off")
    outcome = run.engine.run()
    assert (outcome.reason, outcome.looks) == ("interrupted", 2) and run.dark()
    assert [what for what, _ in requests(tmp_path / "c")] == ["laser off", "stop"]


def test_laser_off_before_a_motion(mounted_rig, tmp_path):
    live = scripted_run("resume")
    run = Run(mounted_rig, tmp_path / "c", live=live)
    move, asks = run.positioner.move_to, iter([True])

    def moving(pan, tilt):
        if next(asks, False):
            live.ask("laser off")
        return move(pan, tilt)

    run.positioner.move_to = moving
    assert run.engine.run().ok == 8
    assert requests(tmp_path / "c") == [("laser off", False), ("resume", False)]


def test_a_pause_without_a_page_ends_with_ctrl_c_only(mounted_rig, tmp_path):
    live = scripted_run()
    run = run_with(mounted_rig, tmp_path / "c", live, 3, "pause")
    wait = live.requests.wait

    def waited(longest_s):
        wait(longest_s)
        if live.requests.waits == 5:
            run.stop.requested = True

    live.requests.wait = waited
    assert run.engine.run().reason == "interrupted" and live.requests.waits == 5 and run.dark()
    names = [record.event for record in read_journal(tmp_path / "c").records]
    assert names[names.index("asked") :] == ["asked", "stop"], "nothing moves"


def test_requests_that_cannot_be_carried_out_are_reported_as_failed(mounted_rig, tmp_path):
    live = LiveRun()

    def gone(instrument):
        live.ask("pause")
        instrument.device.power_on()

    run = Run(mounted_rig, tmp_path / "c", at=3, then=gone, live=live)
    with pytest.raises(DeviceFault):
        run.engine.run()
    assert states(live) == [("pause", "failed")] and requests(tmp_path / "c") == []
    assert live.latest.fault.code == "reset" and "--resume" in live.latest.fault.remedy and run.dark()


def test_device_that_fails_at_the_request_itself(mounted_rig, tmp_path):
    live = LiveRun()
    run = run_with(mounted_rig, tmp_path / "c", live, 3, "stop")
    state = run.positioner.laser

    def broken(on):
        if live.requests.next("stop") and len(run.engine.journal.records) and not on and run.engine._spot == 3:
            raise_error(DeviceFault("no-answer", "nothing answers", remedy="plug it in"))
        return state(on)

    run.positioner.laser = broken
    with pytest.raises(DeviceFault, match="nothing answers"):
        run.engine.run()
    [request] = live.requests.recent()
    assert (request.state, request.answer) == ("failed", "nothing answers") and run.dark()


def test_full_disk_at_a_request_loses_no_look(mounted_rig, tmp_path):
    live = LiveRun()
    run = run_with(mounted_rig, tmp_path / "c", live, 4, "pause")
    disk = run.engine.journal._disk

    class Full(type(disk)):
        def write(self, descriptor, data):
            if b'"asked"' in data:
                raise OSError(28, "No space left on device")
            return super().write(descriptor, data)

    run.engine.journal._disk = Full()
    with pytest.raises(DeviceFault, match="No space left"):
        run.engine.run()
    assert len(recorded(read_journal(tmp_path / "c").records).spots) == 4
    assert states(live) == [("pause", "failed")] and "No space left" in live.latest.fault.message and run.dark()


def test_a_look_broken_off_waits_until_the_spot_is_gone():
    """A lit picture still under way would else be the dark one of the next look."""
    dark, lit = (np.full((4, 4), value, np.uint8) for value in (10, 200))
    grabbed = [dark, lit, lit, lit, dark]

    class Camera:
        def grab(self):
            picture = grabbed.pop(0)
            return StereoImage(picture, picture)

    class Refusing:
        def laser(self, on):
            if on:
                raise LightRefused

    with pytest.raises(LightRefused):
        CameraObserver(Camera()).observe(Refusing(), 0)
    assert grabbed == []


def test_without_requests_the_journal_is_what_it_was(mounted_rig, tmp_path):
    for name in ("a", "b"):
        Run(mounted_rig, tmp_path / name, small_plan(), **({"live": LiveRun()} if name == "b" else {})).engine.run()
    assert (tmp_path / "a" / "log.jsonl").read_bytes() == (tmp_path / "b" / "log.jsonl").read_bytes()
