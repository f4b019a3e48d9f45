"""The engine on the device model and the twin: what a run leaves behind, however it ends."""

from __future__ import annotations

import datetime
import json
import os
import random
import signal
import subprocess
import sys
import threading
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from tvsbayes.acquisition.bench import SIMULATED_START, Bench, Vision
from tvsbayes.acquisition.campaign_files import check_journal, repair_campaign
from tvsbayes.acquisition.engine import ATTEMPTS_PER_LOOK, Acquisition, _approach
from tvsbayes.acquisition.journal import LOG, read_journal
from tvsbayes.acquisition.journal_check import verify
from tvsbayes.acquisition.observation import CameraObserver, Detection, TwinObserver, live_detector, twin_renderer
from tvsbayes.acquisition.operator import LiveLine, SimulatedOperator, StopKey, Terminal, TerminalOperator
from tvsbayes.acquisition.recorder import LOST_STEPS, recorded
from tvsbayes.acquisition.running_estimate import EstimateWish, RunningEstimate
from tvsbayes.acquisition.session import acquire, begin, check_plan
from tvsbayes.acquisition.simulated_instrument import Instrument
from tvsbayes.cameras.capture import StereoImage
from tvsbayes.cameras.virtual_camera import VirtualCamera
from tvsbayes.cli.main import run
from tvsbayes.errors import DeviceFault, InputError
from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.campaign import read_campaign
from tvsbayes.instrument.plan import PlanStep, outline, run_plan, write_plan
from tvsbayes.instrument.rig import read_rig
from tvsbayes.instrument.stops import legs_of
from tvsbayes.positioner.protocol import request
from tvsbayes.twin.physics import project
from tvsbayes.twin.simulated_campaign import draw_truth, read_truth, simulate

RIG_FILE = shipped_data() / "rigs" / "mounted" / "rig.toml"
HEADER = {"name": "test", "created": SIMULATED_START.isoformat(), "synthetic": True, "seed": 5}


@pytest.fixture(scope="module")
def rig():
    return read_rig(RIG_FILE)


@pytest.fixture(scope="module")
def small_rig(rig):
    """The same rig with cameras of a quarter of the pixels per side: pictures that cost a sixteenth."""
    scale = np.ones(24)
    scale[[0, 1, 2, 3, 9, 10, 11, 12]] = 0.25
    stereo = rig.stereo.with_vector(rig.stereo.vector * scale)
    width, height = rig.stereo.image_width // 4, rig.stereo.image_height // 4
    covariance = rig.stereo.parameter_covariance * np.outer(scale, scale)
    stereo = replace(stereo, image_width=width, image_height=height, parameter_covariance=covariance)
    return replace(rig, stereo=stereo)


def small_plan(experiments: int = 2, rehome: bool = False) -> list[PlanStep]:
    """The paper's four points, `experiments` times, of alternating sense; with `rehome` a homing before each."""
    steps: list[tuple] = [("home", 0, 0), ("move", 40, 0), ("move", 0, 0)]
    at = 0
    for number in range(experiments):
        if rehome and number:
            steps += [("home", at, 0)]
        steps += [("place", "d1"), ("look", number, 1), ("place", "d2"), ("look", number, 2)]
        at = 100 - at
        steps += [("move", at, 0), ("look", number, 3), ("place", "d1"), ("look", number, 4)]
    plan = []
    for row, (action, *rest) in enumerate(steps):
        if action == "place":
            plan.append(PlanStep(row, action, target=rest[0]))
        elif action == "look":
            plan.append(PlanStep(row, action, experiment=rest[0], point=rest[1]))
        else:
            plan.append(PlanStep(row, action, *rest))
    return plan


@pytest.fixture(autouse=True)
def ctrl_c_works():
    """A shell's background jobs are born with SIGINT ignored; these tests raise it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


class Run:
    """An acquisition whose parts a test can reach."""

    def __init__(self, rig, folder, plan=None, *, resume=False, start=0, operator=None, observer=None, **options):
        self.folder, self.plan = Path(folder), plan or small_plan()
        self.instrument = Instrument(rig, 5, start)
        self.lit_while_moving = []
        moved = self.instrument.mechanics.moved

        def watch(axis, steps):
            self.lit_while_moving.append(self.instrument.mechanics.laser_on)
            moved(axis, steps)

        self.instrument.mechanics.moved = watch
        self.positioner = self.instrument.positioner()
        self.stop = StopKey()
        clock = self.instrument.clock
        offset = 1000.0 * start
        self.engine = Acquisition(
            rig,
            self.plan,
            begin(self.folder, rig, self.plan, resume, HEADER),
            Bench(
                self.positioner,
                observer(self.instrument) if observer else TwinObserver(self.instrument, 0.08),
                operator(self) if operator else SimulatedOperator(self.instrument),
                clock,
                lambda: SIMULATED_START + datetime.timedelta(seconds=offset + clock.monotonic()),
            ),
            stop=self.stop,
            **options,
        )

    def dark(self) -> bool:
        """Whether the laser is off, never was on in motion, and the line is closed."""
        return not self.instrument.mechanics.laser_on and not any(self.lit_while_moving)


def test_a_run_leaves_a_readable_campaign_with_every_look(rig, tmp_path):
    run_ = Run(rig, tmp_path / "c")
    outcome = run_.engine.run()
    assert (outcome.reason, outcome.looks, outcome.ok, outcome.lost_segments) == ("done", 8, 8, ())
    campaign = read_campaign(tmp_path / "c")
    assert [(m.pan_steps, m.tilt_steps) for m in campaign.moves] == [(0, 0), (40, 0), (0, 0), (100, 0), (0, 0)]
    assert (campaign.moves[0].pan_approach, campaign.moves[0].tilt_approach) == ("left", "up")
    looks = [(s.experiment, s.point) for s in run_.plan if s.action == "look"]
    assert [(s.experiment, s.point) for s in campaign.spots] == looks
    assert campaign.header["synthetic"] is True and run_.dark() and len(run_.lit_while_moving) > 8
    found = verify(tmp_path / "c")
    assert found.stopped == "done" and recorded(read_journal(tmp_path / "c").records).unverified == ()
    assert check_journal(tmp_path / "c")["warnings"] == []


def test_same_seed_same_bytes(rig, tmp_path):
    for name in "ab":
        acquire(rig, small_plan(1), tmp_path / name, simulate=True, seed=9)
    for file in ("moves.csv", "spots.csv", "campaign.toml", "truth.json", LOG):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes(), file
    acquire(rig, small_plan(1), tmp_path / "other", simulate=True, seed=10)
    assert (tmp_path / "other" / "spots.csv").read_bytes() != (tmp_path / "a" / "spots.csv").read_bytes()


def test_light_behind_the_device_is_that_of_the_twin(rig, tmp_path, monkeypatch):
    """Without chance the engine on the device model sees what `simulate` computes from the plan."""
    for name in ("SHEET_DEPTH_SD_MM", "SHEET_TILT_SD_DEG", "HOME_SD_DEG"):
        monkeypatch.setattr(f"tvsbayes.twin.simulated_campaign.{name}", 0.0)
    monkeypatch.setattr("tvsbayes.acquisition.simulated_instrument.HOME_SD_DEG", 0.0)
    truth = draw_truth(rig, np.random.default_rng(3))
    still = {name: 0.0 for name in truth.parameters if name.startswith("stop_sd_deg")}
    truth = replace(truth, parameters={**truth.parameters, **still, "pixel_scale": 0.0})
    plan = small_plan(3, rehome=True)
    wanted = simulate(rig, plan, 1, truth).campaign
    instrument = Instrument(rig, 1, truth=truth)
    folder = tmp_path / "c"
    Acquisition(
        rig,
        plan,
        begin(folder, rig, plan, False, HEADER),
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


def test_truth_file_is_that_of_the_run(rig, tmp_path):
    acquire(rig, small_plan(2), tmp_path / "c", simulate=True, seed=4)
    campaign = read_campaign(tmp_path / "c")
    truth = read_truth(tmp_path / "c" / "truth.json", campaign.stereo)
    assert len(truth.mirror_angles_deg) == len(campaign.moves) and truth.reference_pose_deg is not None
    assert truth.parameters == Instrument(rig, 4).truth.parameters
    k = truth.parameters["degrees_per_step.left"]
    turned = np.subtract(truth.mirror_angles_deg, truth.stop_errors_deg)
    assert turned[3][0] - turned[2][0] == pytest.approx(100 * k - truth.parameters["backlash_deg.pan"], abs=1e-9)


def test_campaign_is_readable_after_every_look(rig, tmp_path):
    seen = []

    def show(progress):
        if (tmp_path / "c" / "campaign.toml").exists():
            seen.append(len(read_campaign(tmp_path / "c").spots))
            assert seen[-1] == progress.looks and progress.looks_total == 8
            assert progress.seconds_left >= 0

    Run(rig, tmp_path / "c", show=show).engine.run()
    assert seen[-1] == 7 and len(seen) > 10


class Failing:
    """An observer that does something at its n-th look, with the laser on."""

    def __init__(self, instrument, at, action):
        self.inner, self.left, self.action = TwinObserver(instrument, 0.08), at, action

    def observe(self, positioner, spot):
        self.left -= 1
        if self.left == 0:
            positioner.laser(True)
            self.action(self.inner.instrument)
        return self.inner.observe(positioner, spot)


def _raise(error):
    raise error


EXITS = {
    "Ctrl-C": (lambda i: signal.raise_signal(signal.SIGINT), None),
    "Ctrl-C twice": (lambda i: [signal.raise_signal(signal.SIGINT) for _ in "ab"], KeyboardInterrupt),
    "camera fault": (lambda i: _raise(DeviceFault("no-frame", "gone")), DeviceFault),
    "detector bug": (lambda i: _raise(ZeroDivisionError()), ZeroDivisionError),
    "out of memory": (lambda i: _raise(MemoryError()), MemoryError),
    "device reset": (lambda i: i.device.power_on(), DeviceFault),
    "device aborted": (lambda i: i.device.model.receive(request(4_000_000_000, "ABORT"), i.clock.now_us), DeviceFault),
    "exit": (lambda i: _raise(SystemExit(1)), SystemExit),
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
def test_laser_is_off_at_every_exit(rig, tmp_path, name):
    action, error = EXITS[name]
    run_ = Run(rig, tmp_path / "c", observer=lambda i: Failing(i, 3, action))
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


def test_third_ctrl_c_does_not_keep_the_laser_on(rig, tmp_path):
    """People press it again and again; the one that hits the closing must not break it off."""
    run_ = Run(rig, tmp_path / "c", observer=lambda i: Failing(i, 3, EXITS["Ctrl-C twice"][0]))
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


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="POSIX only")
def test_nohup_is_respected(monkeypatch):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with StopKey():
            signal.raise_signal(signal.SIGHUP)
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("error", [RuntimeError("reentrant call inside a writer"), BrokenPipeError(32, "Broken pipe")])
def test_stop_key_counts_even_where_its_word_cannot_be_written(error):
    with StopKey(lambda text: _raise(error)) as stop:
        signal.raise_signal(signal.SIGINT)
    assert stop.requested


def test_laser_is_off_when_the_disk_fails(rig, tmp_path):
    run_ = Run(rig, tmp_path / "c")
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


@pytest.mark.parametrize("refusals", [3, 10_000])
def test_a_table_that_somebody_has_open_does_not_end_the_run(rig, tmp_path, monkeypatch, refusals):
    """On Windows `os.replace` refuses while a spreadsheet holds spots.csv; the journal has the look already."""
    replace_, left = os.replace, [refusals]

    def held(source, destination):
        if Path(destination).name == "spots.csv" and left[0] > 0:
            left[0] -= 1
            raise PermissionError(13, "The process cannot access the file")
        replace_(source, destination)

    monkeypatch.setattr(os, "replace", held)
    outcome = Run(rig, tmp_path / "c").engine.run()
    assert (outcome.reason, outcome.looks) == ("done", 8)
    assert [text for text in outcome.warnings if "behind the journal" in text] == list(outcome.warnings)
    assert len(outcome.warnings) == (refusals > 8)
    if not outcome.warnings:
        assert len(read_campaign(tmp_path / "c").spots) == 8


@pytest.mark.parametrize("exit_", ["declined", "no sheet"])
def test_laser_is_never_on_when_the_operator_says_no(rig, tmp_path, exit_):
    class Unwilling(SimulatedOperator):
        def accept(self, hazard):
            assert "808 nm is invisible" in hazard
            return exit_ != "declined"

        def place(self, *arguments):
            return False

    run_ = Run(rig, tmp_path / "c", operator=lambda r: Unwilling(r.instrument))
    outcome = run_.engine.run()
    assert outcome.reason == ("declined" if exit_ == "declined" else "interrupted") and outcome.looks == 0
    assert run_.dark()
    if exit_ == "declined":
        assert run_.lit_while_moving == [], "nothing moves either"


def test_laser_left_on_by_another_program_is_switched_off(rig, tmp_path):
    run_ = Run(rig, tmp_path / "c")
    run_.positioner.home()
    run_.positioner.laser(True)
    run_.engine.run()
    assert run_.dark()


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
def test_resumed_after_any_look_every_look_is_there_once(rig, tmp_path, stop_at):
    folder, plan = tmp_path / "c", small_plan()
    first = Run(rig, folder, plan, observer=lambda i: Failing(i, stop_at, lambda i: signal.raise_signal(signal.SIGINT)))
    assert first.engine.run().reason == "interrupted"
    before = read_campaign(folder)
    with pytest.raises(InputError, match="--resume"):
        begin(folder, rig, plan, False, HEADER)
    second = Run(rig, folder, plan, resume=True, start=1)
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
    shifts = [r.data["shift_px"] for r in read_journal(folder).records if r.event == "looked" and "shift_px" in r.data]
    # New stop errors and home offset of 0.1 degrees together, 900 px per rad, at 175 to 275 mm: a few px.
    assert shifts and max(shifts) < 15


def test_run_that_was_interrupted_while_it_resumed_goes_on_where_the_plan_stood(rig, tmp_path):
    """The journal's last motion is then one to a reference look, not the plan's."""
    folder, plan = tmp_path / "c", small_plan()
    Run(rig, folder, plan, observer=lambda i: Failing(i, 3, EXITS["Ctrl-C"][0])).engine.run()
    second = Run(rig, folder, plan, resume=True, start=1, observer=lambda i: Failing(i, 2, EXITS["camera fault"][0]))
    with pytest.raises(DeviceFault):
        second.engine.run()
    assert read_campaign(folder).moves[-1].pan_steps == 0, "of the second reference look; the plan stood at 100"
    assert Run(rig, folder, plan, resume=True, start=2).engine.run().reason == "done"
    assert_looks_as_planned(read_campaign(folder), plan)


@pytest.mark.parametrize(
    ("event", "number", "left", "last_step"),
    [
        *(("homed", 0, 8, None), ("looked", 5, 9, None), ("placed", 4, 9, None), ("verified", 0, 12, None)),
        # Ended by the stop key too, with the sheet elsewhere than where the lost look needs it.
        ("looked", 3, 5, 16),
    ],
)
def test_looks_that_a_repair_lost_are_taken_again(rig, tmp_path, event, number, left, last_step):
    plan = small_plan(3, rehome=True)

    def show(progress):
        if progress.step == last_step:
            signal.raise_signal(signal.SIGINT)

    acquire(rig, plan, tmp_path / "old", simulate=True, seed=4, terminal=Terminal(show=show))
    damaged = [r for r in read_journal(tmp_path / "old").records if r.event == event][number]
    log = tmp_path / "old" / LOG
    lines = log.read_bytes().splitlines(keepends=True)
    lines[damaged.line - 1] = b"#" + lines[damaged.line - 1][1:]
    log.write_bytes(b"".join(lines))
    repair_campaign(tmp_path / "old", tmp_path / "new")
    before = read_campaign(tmp_path / "new")
    assert len(before.spots) == left
    assert any(f"in lines {damaged.line}, and" in w for w in check_journal(tmp_path / "new")["warnings"])
    outcome = acquire(rig, plan, tmp_path / "new", simulate=True, resume=True, seed=4)
    assert outcome.reason == "done"
    campaign = read_campaign(tmp_path / "new")
    assert campaign.spots[: len(before.spots)] == before.spots
    assert_looks_as_planned(campaign, plan)
    truth = read_truth(tmp_path / "new" / "truth.json", campaign.stereo)
    ratio = truth.parameters["degrees_per_step.pan"]
    away = [psi - ratio * m.pan_steps for (psi, _), m in zip(truth.mirror_angles_deg, campaign.moves, strict=True)]
    # Play, stop errors, home offsets and contrast stay within 1.5 degrees; another row would be 6 degrees off.
    assert np.abs(away).max() < 1.5


def test_plan_begins_again_where_a_repair_lost_its_only_homing(rig, tmp_path):
    """Sheets that were placed are in the journal still; without a homing nothing may move and nothing counts."""
    plan = small_plan(1)
    acquire(rig, plan, tmp_path / "old", simulate=True, seed=4)
    log = tmp_path / "old" / LOG
    log.write_bytes(log.read_bytes().replace(b'"event":"homed"', b'"event":"hOmed"'))
    repair_campaign(tmp_path / "old", tmp_path / "new")
    assert acquire(rig, plan, tmp_path / "new", simulate=True, resume=True, seed=4).looks == 4
    assert_looks_as_planned(read_campaign(tmp_path / "new"), plan)


def test_resuming_what_is_done_asks_for_nothing(rig, tmp_path):
    Run(rig, tmp_path / "c").engine.run()

    class Bothered(SimulatedOperator):
        def place(self, *arguments):
            raise AssertionError("there is nothing left to look at")

    again = Run(rig, tmp_path / "c", resume=True, start=1, operator=lambda r: Bothered(r.instrument))
    assert (again.engine.run().reason, len(read_campaign(tmp_path / "c").spots)) == ("done", 8)


def test_what_somebody_changed_since_is_kept_beside(rig, tmp_path):
    """A refused spot, and a prior stated in campaign.toml: resuming writes these files again."""
    Run(rig, tmp_path / "c", observer=lambda i: Failing(i, 3, EXITS["Ctrl-C"][0])).engine.run()
    spots, header = tmp_path / "c" / "spots.csv", tmp_path / "c" / "campaign.toml"
    edited = spots.read_text().replace(",ok", ",dust", 1)
    assert edited != spots.read_text()
    spots.write_text(edited)
    stated = header.read_text() + "\n# mirror looked at on Monday\n"
    header.write_text(stated)
    outcome = Run(rig, tmp_path / "c", resume=True, start=1).engine.run()
    assert (tmp_path / "c" / "spots.edited-1.csv").read_text() == edited
    assert (tmp_path / "c" / "campaign.edited-1.toml").read_text() == stated
    told = [w.split(" was")[0] for w in outcome.warnings if "edited" in w]
    assert sorted(told) == ["campaign.toml", "spots.csv"]
    assert not list((tmp_path / "c").glob("moves.edited*"))
    again = Run(rig, tmp_path / "c", resume=True, start=2).engine.run()
    assert (
        not any("edited" in warning for warning in again.warnings)
        and len(list((tmp_path / "c").glob("*.edited-*"))) == 2
    )


def test_resume_with_another_plan_rig_or_seed_is_refused(rig, tmp_path):
    folder, plan = tmp_path / "c", small_plan()
    Run(rig, folder, plan, observer=lambda i: Failing(i, 2, lambda i: signal.raise_signal(signal.SIGINT))).engine.run()
    size = (folder / LOG).stat().st_size
    other_plan = [*plan[:-1], replace(plan[-1], point=None, experiment=None)]
    other_rig = replace(rig, sheets_mm={**rig.sheets_mm, "d1": 180.0})
    for arguments, word in (
        ((rig, other_plan, True, HEADER), "another plan"),
        ((other_rig, plan, True, HEADER), "another rig"),
        ((rig, plan, True, {**HEADER, "seed": 6}), "seed"),
    ):
        with pytest.raises(InputError, match=word):
            begin(folder, *arguments)
    assert (folder / LOG).stat().st_size == size
    begin(folder, rig, plan, True, HEADER).close()
    with pytest.raises(InputError, match="no journal"):
        acquire(rig, plan, tmp_path / "nowhere", simulate=True, resume=True)


def test_lost_steps_of_an_interrupted_run_are_found_by_the_next(rig, tmp_path):
    """The device stayed on: its counters tell the resumed run's homing what happened before."""
    folder, plan = tmp_path / "c", small_plan()
    first = Run(rig, folder, plan, observer=lambda i: Failing(i, 4, lambda i: signal.raise_signal(signal.SIGINT)))
    first.engine.run()
    second = Run(rig, folder, plan, resume=True, start=1)
    first.instrument.mechanics.true_steps[0] -= 6
    second.engine.bench = replace(second.engine.bench, positioner=first.instrument.positioner())
    assert second.engine.run().lost_segments == (0,)
    assert {s.status for s in read_campaign(folder).spots[:4]} == {LOST_STEPS}


def test_segment_that_an_alarm_ended_is_not_taken_for_verified(rig, tmp_path):
    """In alarm the counters are lost; the homing that follows reports no deviation, but there is none to report."""
    folder, plan = tmp_path / "c", small_plan()
    first = Run(rig, folder, plan, observer=lambda i: Failing(i, 4, EXITS["device aborted"][0]))
    with pytest.raises(DeviceFault):
        first.engine.run()
    first.instrument.mechanics.true_steps[0] -= 6
    second = Run(rig, folder, plan, resume=True, start=1)
    second.engine.bench = replace(second.engine.bench, positioner=first.instrument.positioner())
    assert second.engine.run().lost_segments == ()
    assert recorded(read_journal(folder).records).unverified == (0,)


def test_frames_of_an_interrupted_look_are_never_overwritten(rig, tmp_path):
    folder = tmp_path / "c"
    Run(rig, folder, observer=lambda i: Failing(i, 2, lambda i: signal.raise_signal(signal.SIGINT))).engine.run()
    (folder / "frames").mkdir()
    (folder / "frames" / "000002_left.png").write_bytes(b"of a look that a crash cut off")
    (folder / "frames" / "screenshot.png").write_bytes(b"of the operator")
    Run(rig, folder, resume=True, start=1).engine.run()
    assert [s.spot for s in read_campaign(folder).spots][:4] == [0, 1, 3, 4]
    assert verify(folder).orphans == ("frames/000002_left.png", "frames/screenshot.png")


def test_clock_that_goes_back_leaves_the_times_in_order(rig, tmp_path):
    run_ = Run(rig, tmp_path / "c")
    times = iter([50.0, 40.0, 60.0, 10.0] + [70.0 + k for k in range(200)])
    run_.engine._log._utc = lambda: SIMULATED_START + datetime.timedelta(seconds=next(times))
    run_.engine.run()
    moves = read_campaign(tmp_path / "c").moves
    assert all(a.time_s <= b.time_s for a, b in pairwise(moves))


def test_lost_steps_void_their_segment_and_no_other(rig, tmp_path):
    plan = small_plan(3, rehome=True)

    def slip(instrument):
        instrument.mechanics.missing_steps = [5, 0]

    run_ = Run(rig, tmp_path / "c", plan, observer=lambda i: Failing(i, 5, slip))
    outcome = run_.engine.run()
    assert outcome.lost_segments == (1,) and "5" in outcome.warnings[0]
    campaign = read_campaign(tmp_path / "c")
    by_segment = {}
    for spot in campaign.spots:
        by_segment.setdefault(campaign.moves[spot.move].segment, set()).add(spot.status)
    assert by_segment == {0: {"ok"}, 1: {LOST_STEPS}, 2: {"ok"}}
    assert any("steps were lost" in w for w in check_journal(tmp_path / "c")["warnings"])


def test_forgotten_sheet_is_noticed_by_its_spot(rig, tmp_path):
    asked = []

    class Forgetful(SimulatedOperator):
        def place(self, target, x_mm, placement, remark):
            asked.append((target, remark))
            if target == "d2" and not remark and sum(t == "d2" for t, _ in asked) == 1:
                return True
            return super().place(target, x_mm, placement, remark)

    run_ = Run(rig, tmp_path / "c", operator=lambda r: Forgetful(r.instrument))
    assert run_.engine.run().ok == 8
    assert [t for t, remark in asked if remark] == ["d2"]
    assert "spot lies at X = 17" in next(remark for _, remark in asked if remark)
    campaign = read_campaign(tmp_path / "c")
    plain = Run(rig, tmp_path / "plain")
    plain.engine.run()
    assert [s.target for s in campaign.spots] == [s.target for s in read_campaign(tmp_path / "plain").spots]


def test_sheet_that_never_comes_ends_the_run(rig, tmp_path):
    class Absent(SimulatedOperator):
        def place(self, target, x_mm, placement, remark):
            return super().place("d1", x_mm, placement, remark)

    run_ = Run(rig, tmp_path / "c", operator=lambda r: Absent(r.instrument))
    with pytest.raises(DeviceFault) as caught:
        run_.engine.run()
    assert caught.value.code == "placement" and run_.dark()


def test_looks_without_a_spot_are_repeated_and_then_refused(rig, tmp_path):
    class Blind:
        def __init__(self, instrument):
            self.inner, self.calls = TwinObserver(instrument, 0.08), 0

        def observe(self, positioner, spot):
            self.calls += 1
            found = self.inner.observe(positioner, spot)
            blind = spot == 2 or (spot == 4 and self.calls % 2 == 0)
            return replace(found, detection=Detection("no-spot")) if blind else found

    run_ = Run(rig, tmp_path / "c", observer=Blind)
    outcome = run_.engine.run()
    assert (outcome.ok, outcome.refused) == (7, 1) and outcome.retries >= ATTEMPTS_PER_LOOK - 1
    spot = read_campaign(tmp_path / "c").spots[2]
    assert spot.status == "no-spot" and spot.u_left_px is None


def test_plans_that_the_rig_cannot_run_are_refused_before_anything_moves(rig):
    plan = small_plan(1)
    with pytest.raises(InputError, match="target d9 in step 3"):
        check_plan(rig, [*plan[:3], replace(plan[3], target="d9"), *plan[4:]])
    with pytest.raises(InputError, match="4000 in step 1"):
        check_plan(rig, [plan[0], replace(plan[1], pan_steps=4000)])
    narrow = replace(rig, positioner={"pan_max_steps": 90})
    with pytest.raises(InputError, match="100 in step 7"):
        check_plan(narrow, plan)
    assert outline(rig, plan)[7] == "7: go to pan 100, tilt 0 (by +100, +0)"


FIT = """
import json, sys
from pathlib import Path
looks = len((Path(sys.argv[1]) / "spots.csv").read_text().splitlines()) - 1
entry = {"value": 0.06, "sd": 0.012 / looks}
print(json.dumps({"converged": looks != 15, "effective_deg_per_step": {"left": entry, "right": entry, "up": None}}))
"""


def test_run_ends_when_the_running_estimate_meets_its_target(rig, tmp_path):
    """A stand-in whose u falls as 0.012 / looks: 5e-4 is met at 24 looks; fits at 12, 15 (fails), 18, 22, 27."""
    plan, texts = small_plan(20), []
    directions = set(legs_of(run_plan(plan, rig).moves))
    assert directions == {"left", "right"}
    command = [sys.executable, "-c", FIT]
    with RunningEstimate(tmp_path / "c", command, 5e-4, directions, wait=True) as estimate:
        run_ = Run(rig, tmp_path / "c", plan, estimate=estimate, show=lambda p: texts.append(p.estimate))
        outcome = run_.engine.run()
    assert (outcome.reason, outcome.looks, estimate.latest.looks) == ("target met", 27, 27) and run_.dark()
    assert texts[0] == "" and texts[-1].startswith("left 0.060000 u 5.")
    assert recorded(read_journal(tmp_path / "c").records).unverified == (), "the closing homing took place"
    for needed in ({"left", "up"}, set()):
        with RunningEstimate(tmp_path / "c", command, 1.0, needed, wait=True) as estimate:
            assert not estimate.update(27) and estimate.latest is not None, "a direction without a figure is not met"


@pytest.mark.parametrize(("asked", "shown"), [(None, False), (True, True), (False, False)])
def test_estimate_is_shown_without_a_target(rig, tmp_path, asked, shown):
    """What is known so far belongs into the live line whether or not it ends the run; simulations must ask for it."""
    wish = EstimateWish((sys.executable, "-c", FIT), asked=asked)
    texts = []

    def show(progress):
        texts.append(progress.estimate)

    outcome = acquire(
        rig, small_plan(4), tmp_path / "c", simulate=True, seed=4, estimate=wish, terminal=Terminal(show=show)
    )
    assert (outcome.reason, outcome.looks) == ("done", 16)
    assert texts[-1] == ("left 0.060000 u 1.0e-03, right 0.060000 u 1.0e-03" if shown else "")


def test_running_estimate_does_not_hold_up_the_run_and_dies_with_it(rig, tmp_path):
    command = [sys.executable, "-c", "import threading; threading.Event().wait()"]
    with RunningEstimate(tmp_path / "c", command, 1.0, {"left"}) as estimate:
        assert Run(rig, tmp_path / "c", small_plan(5), estimate=estimate).engine.run().reason == "done"
        child = estimate._process
        assert child.poll() is None and estimate.latest is None
    assert child.poll() is not None


def test_estimate_that_cannot_start_does_not_end_the_run(tmp_path):
    for wait in (True, False):
        with RunningEstimate(tmp_path, [str(tmp_path / "nothing")], 1.0, {"left"}, wait=wait) as estimate:
            assert not estimate.update(12) and estimate.latest is None


def test_questions_go_to_stderr(monkeypatch, capsys):
    """With --json stdout holds one document."""
    monkeypatch.setattr("builtins.input", lambda: "yes")
    assert LiveLine().ask("Type yes [now]: ") == "yes"
    out, err = capsys.readouterr()
    assert out == "" and "Type yes [now]: " in err


def test_camera_that_looks_on_does_not_change_the_motion(rig):
    """The way from the home switch follows the mean ratio (DESIGN 3.1), whatever a camera's thread asks meanwhile."""
    ends = []
    for watched in (False, True):
        instrument = Instrument(rig, 5)
        positioner = instrument.positioner()
        positioner.home()
        if watched:
            instrument.light()
        positioner.move_to(0, 0)
        ends.append(instrument.state_deg())
    assert ends[0] == ends[1]
    p = instrument.truth.parameters
    assert abs(p["degrees_per_step.left"] - p["degrees_per_step.pan"]) > 1e-6, "else nothing is shown"


@pytest.mark.parametrize(
    ("steps", "name"), [(1200, "left"), (20, "left"), (19, "unknown"), (0, "right"), (-3, "right"), (-500, "right")]
)
def test_approach_after_homing(steps, name):
    assert _approach(steps, ("left", "right")) == name


def test_stop_key_interrupts_a_question_at_once():
    said = []

    def ask(question):
        signal.raise_signal(signal.SIGINT)
        return "never"

    with StopKey(said.append) as stop:
        operator = TerminalOperator(stop, Terminal(said.append, ask=ask))
        assert operator.accept("line one\nline two") is False and stop.requested
        assert said == ["line one", "line two"]
        assert operator.place("d1", 175.0, 0, "") is False
    stop = StopKey()
    assert TerminalOperator(stop, Terminal(said.append, ask=lambda q: " YES ")).accept("x") is True
    assert TerminalOperator(stop, Terminal(said.append, ask=lambda q: "y")).accept("x") is False
    assert TerminalOperator(stop, Terminal(said.append), laser_class="3B").accept("x") is True


def blob(shape, u, v, peak):
    """A plain Gaussian spot of 2 px: enough for the camera path, whose pictures are tested elsewhere."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    spot = peak * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * 2.0**2)) if np.isfinite(u) else np.zeros(shape)
    return np.repeat(np.clip(20 + spot, 0, 255)[..., None], 3, axis=2)


def centroids(lit: StereoImage, dark: StereoImage) -> Detection:
    pixels = []
    for side in ("left", "right"):
        light = np.clip(getattr(lit, side).astype(float) - getattr(dark, side), 12, None).mean(axis=2) - 12
        if light.max() < 50:
            return Detection("no-spot")
        y, x = np.mgrid[: light.shape[0], : light.shape[1]]
        pixels += [float((light * x).sum() / light.sum()), float((light * y).sum() / light.sum())]
    return Detection("ok", tuple(pixels), (0.1,) * 4)


def centroids_of_the_twin(rig, truth: dict, move: int) -> np.ndarray:
    """Where the true cameras see the spot of sheet d1 after a move, without noise: (4,) px."""
    k, p = np.radians(truth["mirror_angles_deg"][move]), truth["parameters"]
    still = Instrument(rig, 7)
    still._y, still._eta = list(np.degrees(k) - [0.0, p["tilt_zero_deg"]]), [0.0, 0.0]
    still.place("d1", 0)
    still.mechanics.laser_on = True
    return still.centroid_px()


TWO_LOOKS = (
    *(PlanStep(0, "home", 0, 0), PlanStep(1, "place", target="d1"), PlanStep(2, "look")),
    *(PlanStep(3, "move", 60, 10), PlanStep(4, "look")),
)


def test_pictures_through_the_virtual_camera(small_rig, tmp_path):
    """Renderer, MJPEG server, OpenCV, background, detection, journal: spots where the twin has them."""
    instrument = Instrument(small_rig, 7)
    rng = np.random.default_rng(0)
    size = (small_rig.stereo.image_height, small_rig.stereo.image_width)

    def renderer(light, look, frame):
        pixels = project(light.points_mm[None], instrument.truth.stereo, instrument.truth.parameters["focal_scale"])[0]
        pair = [blob(size, pixels[k], pixels[k + 1], 180.0) + rng.normal(0, 1, (*size, 1)) for k in (0, 2)]
        return StereoImage(*(np.clip(p, 0, 255).astype(np.uint8) for p in pair))

    folder = tmp_path / "c"
    outcome = acquire(small_rig, TWO_LOOKS, folder, simulate=True, seed=7, vision=Vision(centroids, renderer))
    assert (outcome.ok, outcome.refused) == (2, 0)
    assert verify(folder).frames == 8
    names = sorted(p.name for p in (folder / "frames").iterdir())
    assert names == ["000000_left.png", "000000_right.png", "000001_left.png", "000001_right.png"]
    campaign, truth = read_campaign(folder), json.loads((folder / "truth.json").read_text())
    for spot in campaign.spots:
        pixels = (spot.u_left_px, spot.v_left_px, spot.u_right_px, spot.v_right_px)
        # JPEG and the threshold move a centroid of a 2 px spot by less than 0.1 px.
        assert np.abs(centroids_of_the_twin(small_rig, truth, spot.move) - pixels).max() < 0.1


def test_rendered_pictures_are_detected_while_the_plan_runs(small_rig, tmp_path):
    """What `acquire --simulate` does: the twin's cameras rendered, spots fitted with their uncertainty."""
    folder = tmp_path / "c"
    vision = Vision(live_detector(small_rig.stereo), twin_renderer(small_rig, 7))
    outcome = acquire(small_rig, TWO_LOOKS, folder, simulate=True, seed=7, vision=vision)
    assert (outcome.ok, outcome.refused) == (2, 0)
    truth = json.loads((folder / "truth.json").read_text())
    for spot in read_campaign(folder).spots:
        pixels = np.array([spot.u_left_px, spot.v_left_px, spot.u_right_px, spot.v_right_px])
        sds = np.array([spot.su_left_px, spot.sv_left_px, spot.su_right_px, spot.sv_right_px])
        assert 0.01 < sds.min() and sds.max() < 0.2
        # Eight coordinates in all, five sds each: JPEG's blocks add to the noise that is stated.
        assert np.all(np.abs(centroids_of_the_twin(small_rig, truth, spot.move) - pixels) < 5 * sds)


def test_pictures_that_are_no_pair_are_refused(small_rig):
    dark = np.zeros((small_rig.stereo.image_height, small_rig.stereo.image_width, 3), np.uint8)
    light = Instrument(small_rig, 7)
    light.place("d1", 0)
    light.mechanics.laser_on = True
    made = twin_renderer(small_rig, 7)(light.light(), 0, 0)
    detector = live_detector(small_rig.stereo)
    assert detector(made, made).status == "ok"
    assert detector(StereoImage(dark, dark), made).status == "no-spot both"
    assert detector(StereoImage(made.left, dark), made).status == "no-spot right"
    lifted = np.roll(made.right, 20, axis=0)
    assert detector(StereoImage(made.left, lifted), made).status == "epipolar"


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="pseudo-terminals exist on POSIX only")
def test_hardware_path_from_rig_file_to_campaign(small_rig, tmp_path):
    """Pyserial on a pseudo-terminal, OpenCV on a stream, questions on a terminal: all as on the bench."""
    size = (small_rig.stereo.image_height, small_rig.stereo.image_width)
    instrument = Instrument(small_rig, 7)
    rng, lit_in_motion = np.random.default_rng(0), []
    moved = instrument.mechanics.moved
    instrument.mechanics.moved = lambda *a: (lit_in_motion.append(instrument.mechanics.laser_on), moved(*a))
    noise = rng.integers(0, 9, (*size, 3)).astype(np.uint8)
    frame = [0]

    def render():
        frame[0] += 1
        pixels, pair = instrument.centroid_px(), []
        for k in (0, 2):
            # Never the same picture twice in a look, however many frames a busy computer needs: that would be a fault.
            picture = 20 + np.roll(noise, frame[0], axis=k // 2)
            if np.isfinite(pixels[k]):
                u, v = map(round, pixels[k : k + 2])
                picture[v - 5 : v + 6, u - 5 : u + 6] += blob((11, 11), 5, 5, 180).astype(np.uint8)
            pair.append(picture)
        return StereoImage(*pair)

    master, slave = os.openpty()
    lines: list[bytes] = []
    instrument.device.listener = lines.append

    def serve():
        while True:
            try:
                data = os.read(master, 4096)
            except OSError:
                return
            # Every request finds the device 1 s later: motions end without anybody waiting.
            instrument.clock.now_us += 1_000_000
            instrument.device.model.advance(instrument.clock.now_us)
            instrument.device.model.receive(data, instrument.clock.now_us)
            while lines:
                os.write(master, lines.pop(0))

    threading.Thread(target=serve, daemon=True).start()
    asked = []

    def ask(question):
        asked.append(question)
        instrument.place("d1" if "d1" in question else "d2", len(asked))
        return ""

    plan = [PlanStep(0, "home", 0, 0), PlanStep(1, "place", target="d1"), PlanStep(2, "look")]
    plan += [PlanStep(3, "move", 60, 10), PlanStep(4, "look"), PlanStep(5, "place", target="d2"), PlanStep(6, "look")]
    with VirtualCamera(render, frames_per_s=30) as virtual:
        table = {"driver": "serial", "port": os.ttyname(slave), "settle_s": 0.0}
        real = replace(small_rig, positioner=table, cameras={"source": virtual.address, "spot_sd_px": 0.08})
        said = []
        outcome = acquire(
            real,
            plan,
            tmp_path / "c",
            laser_class="3B",
            vision=Vision(centroids),
            terminal=Terminal(said.append, ask=ask),
        )
    os.close(slave)
    os.close(master)
    assert (outcome.reason, outcome.ok, len(asked)) == ("done", 3, 2), said
    assert any("808 nm is invisible" in line for line in said)
    assert not instrument.mechanics.laser_on and lit_in_motion and not any(lit_in_motion)
    assert verify(tmp_path / "c").frames == 12 and len(read_campaign(tmp_path / "c").spots) == 3
    assert "synthetic" not in read_campaign(tmp_path / "c").header
    start = next(r for r in read_journal(tmp_path / "c").records if r.event == "start")
    assert start.data["device"]["fw"] == "1.0.0" and "cameras" in start.data


class Scripted:
    """A camera whose n-th pair is `level(n)` grey all over, after `seconds` of exposure."""

    def __init__(self, clock, level, seconds=0.1):
        self.clock, self.level, self.seconds, self.count = clock, level, seconds, 0

    def grab(self):
        self.clock.sleep(self.seconds)
        self.count += 1
        picture = np.full((4, 4, 3), self.level(self.count), np.uint8)
        return StereoImage(picture, picture)


@pytest.mark.parametrize(
    ("level", "seconds", "code"),
    [
        (lambda n: 7, 0.1, "frozen"),
        (lambda n: n % 30, 2.5, "watchdog"),
        (lambda n: 0 if n == 1 else 100, 0.1, "light"),
    ],
)
def test_camera_that_lies_is_a_fault_and_the_laser_is_off(rig, level, seconds, code):
    instrument = Instrument(rig, 1)
    positioner = instrument.positioner()
    positioner.home()
    with pytest.raises(DeviceFault) as caught:
        CameraObserver(Scripted(instrument.clock, level, seconds)).observe(positioner, 0)
    assert caught.value.code == code and not instrument.mechanics.laser_on


def test_pictures_without_a_visible_spot_wait_for_detection(rig):
    instrument = Instrument(rig, 1)
    positioner = instrument.positioner()
    positioner.home()
    camera = Scripted(instrument.clock, lambda n: n % 30)
    found = CameraObserver(camera).observe(positioner, 3)
    assert found.detection.status == "undetected" and camera.count == 22
    assert sorted(found.pictures)[0] == "dark/000003_left.png" and len(found.pictures) == 4


def test_changed_background_is_refused(rig):
    instrument = Instrument(rig, 1)
    positioner = instrument.positioner()
    positioner.home()
    camera = Scripted(instrument.clock, lambda n: 90 if n == 1 else n % 30)
    assert CameraObserver(camera).observe(positioner, 3).detection.status == "unsteady"


@pytest.mark.parametrize("depth", range(0, 12))
def test_old_frames_never_become_a_spot_whatever_the_buffer(rig, depth):
    """A camera without any flushing, with a buffer `depth` frames deep: light alone keeps the spots true."""
    instrument = Instrument(rig, 1)
    positioner = instrument.positioner()
    positioner.home()
    rng = np.random.default_rng(depth)
    queue, moved_to = [], [0]

    def expose():
        picture = rng.integers(0, 6, (3, 40, 3)).astype(np.uint8)
        if instrument.mechanics.laser_on:
            picture[1, moved_to[0]] = 200
        queue.append(picture)

    class Camera:
        def grab(self):
            expose()
            while len(queue) <= depth:
                expose()
            picture = queue.pop(0)
            return StereoImage(picture, picture)

    def detector(lit, dark):
        light = lit.left[1].astype(int).sum(axis=1) - dark.left[1].astype(int).sum(axis=1)
        u = float(light.argmax())
        return Detection("ok", (u,) * 4, (0.1,) * 4) if light.max() > 300 else Detection("no-spot")

    observer, found = CameraObserver(Camera(), detector, keep_pictures=False), []
    for step in range(12):
        positioner.move_to(3 * step, 0)
        # The spot is where the positioner is.
        moved_to[0] = 3 * step
        for _ in range(ATTEMPTS_PER_LOOK):
            seen = observer.observe(positioner, step).detection
            if seen.status == "ok":
                found.append(seen.pixels_px[0])
                assert seen.pixels_px[0] == 3 * step
                break
    assert found == [3.0 * step for step in range(12)]


def test_folder_without_a_homing_is_told_so(rig, tmp_path, capsys):
    begin(tmp_path / "c", rig, small_plan(), False, HEADER).close()
    assert run(["check", str(tmp_path / "c"), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["kind"] == "journal" and "no homing" in document["warnings"][-1]


def test_commands(rig, tmp_path, capsys):
    write_plan(small_plan(1), tmp_path / "plan.csv")
    arguments = [str(RIG_FILE), str(tmp_path / "plan.csv"), str(tmp_path / "c")]
    assert run(["acquire", *arguments, "--dry-run", "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["steps"]) == 11 and not (tmp_path / "c").exists()
    assert run(["acquire", *arguments, "--simulate", "--centroids", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["ok"] == 4
    files = {"campaign.toml", "moves.csv", "spots.csv", "stereo.json"} | {LOG, "truth.json"}
    assert {path.name for path in (tmp_path / "c").iterdir()} == files, "no empty folders for pictures"
    assert run(["acquire", *arguments, "--simulate", "--centroids", "--json"]) == 2
    assert json.loads(capsys.readouterr().out)["error"]["code"] == "occupied"
    assert run(["acquire", *arguments[:2], str(tmp_path / "d"), "--json"]) == 2
    assert json.loads(capsys.readouterr().out)["error"]["code"] == "usage" and not (tmp_path / "d").exists()
    assert run(["acquire", *arguments[:2], str(tmp_path / "d"), "--laser-class", "3B", "--json"]) == 2
    assert json.loads(capsys.readouterr().out)["error"]["code"] == "positioner"
    assert run(["check", str(tmp_path / "c"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["journal"]["stopped"] == "done"
    log = tmp_path / "c" / LOG
    lines = log.read_bytes().splitlines(keepends=True)
    log.write_bytes(b"".join([*lines[:9], lines[9].replace(b"0", b"1", 1), *lines[10:]]))
    assert run(["check", str(tmp_path / "c"), "--json"]) == 2
    assert json.loads(capsys.readouterr().out)["error"]["line"] == 10
    assert run(["check", str(tmp_path / "c"), "--repair-to", str(tmp_path / "fixed"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["lost_lines"] == [10]
    assert run(["check", str(tmp_path / "fixed"), "--json"]) == 0
    assert len(read_campaign(tmp_path / "fixed").moves) >= 1
    capsys.readouterr()
    assert run(["check", str(RIG_FILE.parent), "--repair-to", str(tmp_path / "x"), "--json"]) == 2
    assert "acquire" in json.loads(capsys.readouterr().out)["error"]["message"]


def test_command_tells_reference_looks_from_those_of_the_plan(rig, tmp_path, capsys):
    plan, folder = small_plan(), tmp_path / "c"
    write_plan(plan, tmp_path / "plan.csv")
    Run(rig, folder, plan, observer=lambda i: Failing(i, 5, lambda i: signal.raise_signal(signal.SIGINT))).engine.run()
    arguments = ["acquire", str(RIG_FILE), str(tmp_path / "plan.csv"), str(folder), "--simulate", "--centroids"]
    assert run([*arguments, "--resume", "--seed", "5"]) == 0
    first = capsys.readouterr().out.splitlines()[0]
    assert first.endswith("done, 10 of 10 looks count (8 of the plan, 2 reference looks of resumed runs)"), first
    assert run([*arguments[:3], str(tmp_path / "whole"), *arguments[4:]]) == 0
    assert capsys.readouterr().out.splitlines()[0].endswith("done, 8 of 8 looks count")


KILLED = """
import os, signal, sys

calls, left = sys.argv[1].split(","), int(sys.argv[2])

def mortal(name, call):
    def called(*arguments):
        global left
        left -= 1
        if left == 0:
            if name == "write":
                call(arguments[0], arguments[1][: len(arguments[1]) // 2])
            os.kill(os.getpid(), signal.SIGKILL)
        return call(*arguments)
    return called

for name in calls:
    setattr(os, name, mortal(name, getattr(os, name)))

from tvsbayes.cli.main import run

sys.exit(run(sys.argv[3:]))
"""
"""A command that is killed at the n-th of some calls of `os`, in the middle of a write; 0: never.

By itself, since a clock would kill another call in every run, or none.
"""
CALLS_PER_LOOK = 2
"""At least: the lines of a placement or a motion and of the look are written one by one, and flushed."""


def killed_runs(tmp_path: Path, kills: int, seed: int, experiments: int) -> int:
    """Kill `acquire --simulate` again and again, resuming each time, then let it finish: looks of the plan."""
    rng = random.Random(seed)
    calls_max = 4 * experiments * CALLS_PER_LOOK // max(kills, 1)
    plan = small_plan(experiments)
    write_plan(plan, tmp_path / "plan.csv")
    folder = tmp_path / "c"
    command = ["acquire", str(RIG_FILE), str(tmp_path / "plan.csv"), str(folder)]
    before = 0
    for number in range(kills + 1):
        resume = ["--resume"] if number else []
        # Without a whole first line there is nothing to go on with.
        call = rng.randint(2, calls_max) if number < kills else 0
        calls = "fsync,replace" if number % 2 else "write"
        process = subprocess.run(
            [sys.executable, "-c", KILLED, calls, str(call), *command, "--simulate", "--centroids", *resume],
            capture_output=True,
            cwd=Path(__file__).parents[2],
            check=False,
        )
        assert process.returncode == (-signal.SIGKILL if call else 0), (call, process.stderr.decode())
        reading = read_journal(folder)
        # Centroids: all that a run writes through a descriptor are lines of its log.
        assert bool(reading.torn) == (call > 0 and calls == "write")
        record = recorded(reading.records)
        assert len(record.spots) >= before, "a look is gone"
        before = len(record.spots)
        verify(folder)
        if record.moves and (folder / "campaign.toml").exists():
            assert len(read_campaign(folder).spots) >= 0.99 * len(record.spots) - 1
    campaign = read_campaign(folder)
    points = [(s.experiment, s.point) for s in campaign.spots if s.experiment is not None]
    assert points == [(s.experiment, s.point) for s in plan if s.action == "look"]
    return len(points)


def test_killed_acquisition_is_resumed_without_a_loss(tmp_path):
    assert killed_runs(tmp_path, 3, seed=1, experiments=15) == 60


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_twenty_killed_acquisitions(tmp_path, seed):
    """Four campaigns, each killed five times."""
    assert killed_runs(tmp_path, 5, seed=100 + seed, experiments=60) == 240
