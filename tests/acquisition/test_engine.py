"""The engine on the device model and the twin: what a run leaves behind, however it ends."""

from __future__ import annotations

import signal
from dataclasses import replace

import numpy as np
import pytest
from support.bench_runs import HEADER, Run, ctrl_c, events, raise_error, small_plan

from tvsbayes.acquisition.journal import LOG, read_journal
from tvsbayes.acquisition.journal_check import check_journal, repair_campaign, verify
from tvsbayes.acquisition.observation import DetectedSpot, Observation
from tvsbayes.acquisition.operator import Terminal
from tvsbayes.acquisition.recorder import LOST_STEPS, recorded
from tvsbayes.acquisition.session import acquire, begin
from tvsbayes.acquisition.simulated_bench import SimulatedOperator
from tvsbayes.errors import DeviceFault, InputError
from tvsbayes.instrument.campaign import UNDETECTED, read_campaign
from tvsbayes.positioner.protocol import request
from tvsbayes.twin.true_rig import read_truth

pytestmark = pytest.mark.usefixtures("ctrl_c_works")


def test_a_run_leaves_a_readable_campaign_with_every_look(mounted_rig, tmp_path):
    run_ = Run(mounted_rig, tmp_path / "c")
    outcome = run_.engine.run()
    assert (outcome.reason, outcome.looks, outcome.ok, outcome.lost_segments) == ("done", 8, 8, ())
    campaign = read_campaign(tmp_path / "c")
    assert [(m.pan_steps, m.tilt_steps) for m in campaign.moves] == [(0, 0), (40, 0), (0, 0), (100, 0), (0, 0)]
    assert (campaign.moves[0].pan_approach, campaign.moves[0].tilt_approach) == ("left", "up")
    looks = [(s.experiment, s.point) for s in run_.plan if s.action == "look"]
    assert [(s.experiment, s.point) for s in campaign.spots] == looks
    assert campaign.header["synthetic"] is True and run_.dark() and len(run_.lit_while_moving) > 8
    journal = verify(tmp_path / "c")
    assert journal.stopped == "done" and recorded(read_journal(tmp_path / "c").records).unverified == ()
    assert check_journal(tmp_path / "c")["warnings"] == []


EXITS = {
    "Ctrl-C": (ctrl_c, None),
    "Ctrl-C twice": (lambda i: [signal.raise_signal(signal.SIGINT) for _ in "ab"], KeyboardInterrupt),
    "camera fault": (lambda i: raise_error(DeviceFault("no-frame", "gone")), DeviceFault),
    "detector bug": (lambda i: raise_error(ZeroDivisionError()), ZeroDivisionError),
    "out of memory": (lambda i: raise_error(MemoryError()), MemoryError),
    "device reset": (lambda i: i.device.power_on(), DeviceFault),
    "device aborted": (lambda i: i.device.model.receive(request(4_000_000_000, "ABORT"), i.clock.now_us), DeviceFault),
    "exit": (lambda i: raise_error(SystemExit(1)), SystemExit),
    "another program": (
        lambda i: i.device.model.receive(request(4_000_000_000, "L", 1), i.clock.now_us),
        DeviceFault,
    ),
    **{
        name: (lambda i, name=name: signal.raise_signal(getattr(signal, name)), KeyboardInterrupt)
        for name in ("SIGTERM", "SIGHUP", "SIGBREAK")
        if hasattr(signal, name)
    },
}


@pytest.mark.parametrize("name", EXITS)
def test_laser_is_off_at_every_exit(mounted_rig, tmp_path, name):
    action, error = EXITS[name]
    run_ = Run(mounted_rig, tmp_path / "c", at=3, then=action)
    if error is None:
        assert run_.engine.run().reason == "interrupted"
    else:
        with pytest.raises(error):
            run_.engine.run()
    assert run_.dark()
    last = read_journal(tmp_path / "c").records[-1]
    assert last.event == "stop" and (last.data["reason"] != "done")
    assert len(read_campaign(tmp_path / "c").spots) == (3 if name == "Ctrl-C" else 2)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_third_ctrl_c_does_not_keep_the_laser_on(mounted_rig, tmp_path):
    """People press it again and again; the one that hits the closing must not break it off."""
    run_ = Run(mounted_rig, tmp_path / "c", at=3, then=EXITS["Ctrl-C twice"][0])
    exchange = run_.positioner._exchange

    def impatient(*words, **options):
        if words == ("L", 0) and options:
            signal.raise_signal(signal.SIGINT)
        return exchange(*words, **options)

    run_.positioner._exchange = impatient
    with pytest.raises(KeyboardInterrupt):
        run_.engine.run()
    assert run_.dark()
    assert read_journal(tmp_path / "c").records[-1].data["reason"] == "interrupted at once"


def test_laser_is_off_when_the_disk_fails(mounted_rig, tmp_path):
    run_ = Run(mounted_rig, tmp_path / "c")
    store = run_.engine.journal._disk

    class Full(type(store)):
        calls = 0

        def fsync(self, descriptor):
            Full.calls += 1
            if Full.calls > 16:
                raise OSError(28, "No space left on device")
            super().fsync(descriptor)

    run_.engine.journal._disk = Full()
    with pytest.raises(DeviceFault, match="No space left"):
        run_.engine.run()
    assert run_.dark()
    records = read_journal(tmp_path / "c").records
    assert len(recorded(records).spots) >= 1


@pytest.mark.parametrize("exit_", ["declined", "no sheet"])
def test_laser_is_never_on_when_the_operator_says_no(mounted_rig, tmp_path, exit_):
    class Unwilling(SimulatedOperator):
        def accept(self, hazard):
            assert "808 nm is invisible" in hazard
            return exit_ != "declined"

        def place(self, *arguments):
            return False

    run_ = Run(mounted_rig, tmp_path / "c", operator=lambda r: Unwilling(r.instrument))
    outcome = run_.engine.run()
    assert outcome.reason == ("declined" if exit_ == "declined" else "interrupted") and outcome.looks == 0
    assert run_.dark()
    if exit_ == "declined":
        assert run_.lit_while_moving == [], "nothing moves either"


def assert_looks_as_planned(campaign, plan):
    """Every look of the plan once, with the positioner and the sheet where the plan has them."""
    looks = {(s.experiment, s.point): s for s in plan if s.action == "look"}
    spots = [s for s in campaign.spots if s.point is not None]
    assert sorted((s.experiment, s.point) for s in spots) == sorted(looks)
    for spot in spots:
        row = plan[: looks[spot.experiment, spot.point].step]
        wanted = next(s for s in reversed(row) if s.action in ("home", "move"))
        assert campaign.moves[spot.move].pan_steps == wanted.pan_steps
        assert spot.target == next(s.target for s in reversed(row) if s.action == "place")


@pytest.mark.parametrize("stop_at", range(1, 8))
def test_resumed_after_any_look_every_look_is_there_once(mounted_rig, tmp_path, stop_at):
    folder, plan = tmp_path / "c", small_plan()
    first = Run(mounted_rig, folder, plan, at=stop_at, then=ctrl_c)
    assert first.engine.run().reason == "interrupted"
    before = read_campaign(folder)
    with pytest.raises(InputError, match="--resume"):
        begin(folder, mounted_rig, plan, False, HEADER)
    second = Run(mounted_rig, folder, plan, resume=True, start=1)
    outcome = second.engine.run()
    assert outcome.reason == "done" and second.dark()
    campaign = read_campaign(folder)
    assert campaign.spots[: len(before.spots)] == before.spots, "what was taken stays as it was"
    assert campaign.moves[: len(before.moves)] == before.moves
    points = [(s.experiment, s.point) for s in campaign.spots if s.experiment is not None]
    assert points == [(s.experiment, s.point) for s in plan if s.action == "look"]
    assert recorded(read_journal(folder).records).unverified == (0,), "another device start: nothing to compare with"
    assert "segment 0 is not known" in check_journal(folder)["warnings"][0]
    references = [s for s in campaign.spots if s.experiment is None]
    assert outcome.references == len(references) == outcome.looks - 8
    on_target = {before.moves[s.move].pan_steps for s in before.spots if s.target == before.spots[-1].target}
    assert len(references) == len(on_target) and {m.segment for m in campaign.moves} == {0, 1}
    assert_looks_as_planned(campaign, plan)
    shifts = [look["shift_px"] for look in events(folder, "looked") if "shift_px" in look]
    # New stop errors and home offset of 0.1 degrees together, 900 px per rad, at 175 to 275 mm: a few px.
    assert shifts and max(shifts) < 15


@pytest.mark.parametrize(
    ("event", "number", "left", "last_step"),
    [
        # A lost look or placement is no motion: what follows it stays.
        *(("homed", 0, 8, None), ("looked", 5, 11, None), ("placed", 4, 12, None), ("verified", 0, 12, None)),
        # Ended by the stop key too, with the sheet elsewhere than where the lost look needs it.
        ("looked", 3, 5, 16),
    ],
)
def test_looks_that_a_repair_lost_are_taken_again(mounted_rig, tmp_path, event, number, left, last_step):
    plan = small_plan(3, rehome=True)

    def show(progress):
        if progress.step == last_step:
            signal.raise_signal(signal.SIGINT)

    acquire(mounted_rig, plan, tmp_path / "old", simulate=True, seed=4, terminal=Terminal(show=show))
    damaged = [r for r in read_journal(tmp_path / "old").records if r.event == event][number]
    log = tmp_path / "old" / LOG
    lines = log.read_bytes().splitlines(keepends=True)
    lines[damaged.line - 1] = b"#" + lines[damaged.line - 1][1:]
    log.write_bytes(b"".join(lines))
    repair_campaign(tmp_path / "old", tmp_path / "new")
    before = read_campaign(tmp_path / "new")
    assert len(before.spots) == left
    assert any(f"in lines {damaged.line}, and" in w for w in check_journal(tmp_path / "new")["warnings"])
    outcome = acquire(mounted_rig, plan, tmp_path / "new", simulate=True, resume=True, seed=4)
    assert outcome.reason == "done"
    campaign = read_campaign(tmp_path / "new")
    assert campaign.spots[: len(before.spots)] == before.spots
    assert_looks_as_planned(campaign, plan)
    truth = read_truth(tmp_path / "new" / "truth.json", campaign.stereo)
    ratio = truth.parameters["degrees_per_step.pan"]
    away = [psi - ratio * m.pan_steps for (psi, _), m in zip(truth.mirror_angles_deg, campaign.moves, strict=True)]
    # Play, stop errors, home offsets and contrast stay within 1.5 degrees; another row would be 6 degrees off.
    assert np.abs(away).max() < 1.5


def test_plan_begins_again_where_a_repair_lost_its_only_homing(mounted_rig, tmp_path):
    """Sheets that were placed are in the journal still; without a homing nothing may move and nothing counts."""
    plan = small_plan(1)
    acquire(mounted_rig, plan, tmp_path / "old", simulate=True, seed=4)
    log = tmp_path / "old" / LOG
    log.write_bytes(log.read_bytes().replace(b'"event":"homed"', b'"event":"hOmed"'))
    repair_campaign(tmp_path / "old", tmp_path / "new")
    assert acquire(mounted_rig, plan, tmp_path / "new", simulate=True, resume=True, seed=4).looks == 4
    assert_looks_as_planned(read_campaign(tmp_path / "new"), plan)


def test_lost_steps_of_an_interrupted_run_are_found_by_the_next(mounted_rig, tmp_path):
    """The device stayed on: its counters pass the history to the resumed run's homing."""
    folder, plan = tmp_path / "c", small_plan()
    first = Run(mounted_rig, folder, plan, at=4, then=ctrl_c)
    first.engine.run()
    second = Run(mounted_rig, folder, plan, resume=True, start=1)
    first.instrument.mechanics.true_steps[0] -= 6
    second.engine.bench = replace(second.engine.bench, positioner=first.instrument.positioner())
    assert second.engine.run().lost_segments == (0,)
    assert {s.status for s in read_campaign(folder).spots[:4]} == {LOST_STEPS}


def test_frames_of_an_interrupted_look_are_never_overwritten(mounted_rig, tmp_path):
    folder = tmp_path / "c"
    Run(mounted_rig, folder, at=2, then=ctrl_c).engine.run()
    (folder / "frames").mkdir()
    (folder / "frames" / "000002_left.png").write_bytes(b"of a look that a crash cut off")
    (folder / "frames" / "screenshot.png").write_bytes(b"of the operator")
    Run(mounted_rig, folder, resume=True, start=1).engine.run()
    assert [s.spot for s in read_campaign(folder).spots][:4] == [0, 1, 3, 4]
    assert verify(folder).orphans == ("frames/000002_left.png", "frames/screenshot.png")


def test_lost_steps_void_their_segment_and_no_other(mounted_rig, tmp_path):
    plan = small_plan(3, rehome=True)

    def slip(instrument):
        instrument.mechanics.missing_steps = [5, 0]

    run_ = Run(mounted_rig, tmp_path / "c", plan, at=5, then=slip)
    outcome = run_.engine.run()
    assert outcome.lost_segments == (1,) and "5" in outcome.warnings[0]
    campaign = read_campaign(tmp_path / "c")
    by_segment = {}
    for spot in campaign.spots:
        by_segment.setdefault(campaign.moves[spot.move].segment, set()).add(spot.status)
    assert by_segment == {0: {"ok"}, 1: {LOST_STEPS}, 2: {"ok"}}
    assert any("steps were lost" in w for w in check_journal(tmp_path / "c")["warnings"])


class Undetected:
    """An observer whose pictures wait for `detect`; steps are lost before its n-th look."""

    def __init__(self, instrument, at):
        self.instrument, self.left = instrument, at

    def observe(self, positioner, spot):
        self.left -= 1
        if self.left == 0:
            self.instrument.mechanics.missing_steps = [5, 0]
        return Observation(DetectedSpot(UNDETECTED))


def test_pictures_of_a_segment_with_lost_steps_no_longer_wait_for_detection(mounted_rig, tmp_path):
    """`detect` would make spots of them that count, at counters where the mirrors were not."""
    Run(mounted_rig, tmp_path / "c", small_plan(2, rehome=True), observer=lambda i: Undetected(i, 5)).engine.run()
    assert [spot.status for spot in read_campaign(tmp_path / "c").spots] == [UNDETECTED] * 4 + [LOST_STEPS] * 4


def test_sheet_that_never_comes_ends_the_run(mounted_rig, tmp_path):
    class Absent(SimulatedOperator):
        def place(self, target, x_mm, placement, remark):
            return super().place("d1", x_mm, placement, remark)

    run_ = Run(mounted_rig, tmp_path / "c", operator=lambda r: Absent(r.instrument))
    with pytest.raises(DeviceFault) as caught:
        run_.engine.run()
    assert caught.value.code == "placement" and run_.dark()
