"""From files and options to a running acquisition: hardware or simulation, the person at the terminal, the live line.

`acquire` is what the command of that name does. With `simulate` the positioner is the device model on a virtual
clock, and what the cameras see comes from the twin: as centroids, or, with a `renderer`, as pictures through a
virtual MJPEG camera and the same camera code as on the bench.
"""

from __future__ import annotations

import datetime
import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from tvsbayes.acquisition.engine import Acquisition, Outcome
from tvsbayes.acquisition.journal import LOG, Journal, read_journal
from tvsbayes.acquisition.journal_check import repair, verify
from tvsbayes.acquisition.observation import CameraObserver, Detector, Observer, TwinObserver, wait_for_detection
from tvsbayes.acquisition.operator import Progress, SimulatedOperator, StopKey, TerminalOperator, check_hazard
from tvsbayes.acquisition.recorder import plan_sha256, recorded, rig_sha256, write_derived
from tvsbayes.acquisition.running_estimate import RunningEstimate
from tvsbayes.acquisition.simulated_instrument import Instrument, Renderer, reference_pose_deg
from tvsbayes.cameras.capture import StereoImage, VirtualCamera, open_cameras
from tvsbayes.errors import InputError, escaped, refusal
from tvsbayes.files.disk import read_bytes, write_atomically
from tvsbayes.files.documents import TOML_BYTES_MAX, parse_toml
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.campaign import Campaign, parse_header, read_campaign
from tvsbayes.instrument.counter_limits import LIMIT_KEYS
from tvsbayes.instrument.plan import PlanStep, run_plan
from tvsbayes.instrument.rig import Rig, parse_rig_table
from tvsbayes.instrument.stereo_pair import read_stereo
from tvsbayes.instrument.stops import legs_of
from tvsbayes.positioner.driver import LIMITS, Positioner, SerialPositioner, device_settings
from tvsbayes.positioner.protocol import SETTINGS
from tvsbayes.positioner.serial_port import serial_opener
from tvsbayes.twin.simulated_campaign import SPOT_SD_PX


def check_plan(rig: Rig, plan: Sequence[PlanStep]) -> None:
    """Refuses a plan that this rig cannot run, before anything moves.

    Raises:
        InputError: targets without a sheet position, counters outside the limits.
    """
    firmware = {axis: (SETTINGS[LIMITS[low]][2], SETTINGS[LIMITS[high]][2]) for axis, (low, high) in LIMIT_KEYS.items()}
    limits = rig.limits.within(firmware)
    for step in plan:
        if step.action == "place" and step.target not in rig.sheets_mm:
            allowed = ", ".join(rig.sheets_mm) or "a target named in [sheets]"
            remedy = "add its nominal X to [sheets] of the rig file"
            found = f"target {step.target} in step {step.step}"
            raise refusal("unknown-target", file="plan", found=found, allowed=allowed, remedy=remedy, column="target")
        for axis, counter in zip(AXES, (step.pan_steps, step.tilt_steps), strict=True):
            if counter is None:
                continue
            low, high = limits[axis]
            if not low <= counter <= high:
                remedy = f"correct the plan, or {' and '.join(LIMIT_KEYS[axis])} in [positioner]"
                found, allowed = f"{counter} in step {step.step}", f"{low} to {high}, the soft limits"
                column = f"{axis}_steps"
                raise refusal("limit", file="plan", found=found, allowed=allowed, remedy=remedy, column=column)


def begin(folder: Path, rig: Rig, plan: Sequence[PlanStep], resume: bool, header: Mapping[str, object]) -> Journal:
    """The journal to write: a new one, or the one to go on with.

    Raises:
        InputError: nothing to go on with, another plan or rig than before, or a folder that has a journal.
    """
    hashes = {"plan_sha256": plan_sha256(plan), "rig_sha256": rig_sha256(rig)}
    if not resume:
        if folder.is_dir() and any(folder.iterdir()):
            remedy = "name another folder, or go on with --resume"
            allowed = "a new or empty folder"
            raise refusal(
                "occupied", file=escaped(str(folder), 200), found="a folder with files", allowed=allowed, remedy=remedy
            )
        created = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
        return Journal.create(folder, **{"created": created, **header}, **hashes)
    journal = Journal.open(folder)
    try:
        for name, now in hashes.items():
            before = journal.records[0].data.get(name)
            if before != now:
                what = name.partition("_")[0]
                allowed = f"the {what} that this campaign began with (SHA-256 {before})"
                remedy = f"give the unchanged {what}, or begin a new campaign in another folder"
                raise refusal("changed", file=what, found=f"another {what}", allowed=allowed, remedy=remedy)
        for name in ("synthetic", "seed"):
            if journal.records[0].data.get(name) != header.get(name):
                allowed = f"{name} {journal.records[0].data.get(name)}, as before"
                remedy = "give the options of the first run"
                raise refusal("changed", file=name, found=str(header.get(name)), allowed=allowed, remedy=remedy)
    except BaseException:
        journal.close()
        raise
    return journal


BAUD = 115_200
SIMULATED_START = datetime.datetime(2026, 1, 1, tzinfo=datetime.UTC)
"""Time of day at which every simulated campaign begins: same seed, same bytes."""


@dataclass(frozen=True)
class _Bench:
    """Everything a run needs beside plan and journal."""

    positioner: Positioner
    observer: Observer
    clock: object
    utc: Callable[[], datetime.datetime]
    details: Mapping[str, object]
    annotate: Callable[[], Mapping[str, object]] = dict
    warnings: tuple[str, ...] = ()


def acquire(
    rig: Rig,
    plan: Sequence[PlanStep],
    folder: Path,
    *,
    simulate: bool = False,
    resume: bool = False,
    laser_class: str | None = None,
    seed: int = 0,
    target_u_deg_per_step: float | None = None,
    estimate: bool | None = None,
    detector: Detector = wait_for_detection,
    renderer: Renderer | None = None,
    say: Callable[[str], None] = lambda text: None,
    show: Callable[[Progress], None] = lambda progress: None,
    ask: Callable[[str], str] = input,
) -> Outcome:
    """Runs a plan on the instrument of a rig file, or on its twin, into a campaign folder.

    Args:
        rig: the rig.
        plan: its steps.
        folder: new or empty; with `resume` the folder of the interrupted run.
        simulate: the twin instead of hardware; `truth.json` is written beside the campaign.
        resume: go on with an interrupted run.
        laser_class: states that the hazard is known; without it the operator is asked once.
        seed: of a simulation.
        target_u_deg_per_step: ends the run once the effective ratio of every direction of the plan is known so well.
        estimate: whether the looks so far are fitted beside the run; None: on hardware and for a target. A simulation
            waits for every fit.
        detector: finds spots in pictures; by default they wait as `undetected`.
        renderer: makes the twin's pictures; without one a simulation states centroids.
        say: shows a line to the user.
        show: told about progress.
        ask: shows a question and returns the answer.

    Raises:
        InputError: a plan this rig cannot run, another plan than before, nobody to ask.
        DeviceFault: device, camera or disk failed.
    """
    folder = Path(folder)
    check_plan(rig, plan)
    check_hazard(laser_class, simulate)
    if resume and not (folder / LOG).is_file():
        remedy = "leave --resume out to begin, or name the folder of the interrupted run"
        place = escaped(str(folder / LOG), 200)
        raise refusal("missing-file", file=place, found="no journal", allowed="a journal", remedy=remedy)
    header: dict[str, object] = {"name": str(rig.header.get("name", "acquired campaign"))}
    if simulate:
        header |= {"created": SIMULATED_START.isoformat(), "synthetic": True, "seed": int(seed)}
    starts = recorded(read_journal(folder).records).starts if resume else 0
    stop = StopKey(say)
    with ExitStack() as stack:
        # Device and cameras first: what cannot be opened leaves no folder behind.
        if simulate:
            instrument = Instrument(rig, seed, starts)
            bench = stack.enter_context(_simulated(rig, instrument, detector, renderer, folder, resume))
            operator = SimulatedOperator(instrument)
        else:
            instrument = None
            bench = stack.enter_context(_hardware(rig, detector))
            operator = TerminalOperator(stop, say, ask, laser_class)
        stack.callback(bench.positioner.close)
        for warning in bench.warnings:
            say(f"warning: {warning}")
        journal = begin(folder, rig, plan, resume, header)
        stack.callback(journal.close)
        if journal.torn:
            say(f"{len(journal.torn)} bytes of an unfinished line were cut off and kept in log.torn-*")
        running = None
        if target_u_deg_per_step is not None or (not simulate if estimate is None else estimate):
            running = RunningEstimate(
                folder, target_u_deg_per_step, set(legs_of(run_plan(plan, rig).moves)), wait=simulate
            )
            stack.enter_context(running)
        acquisition = Acquisition(
            rig,
            plan,
            journal,
            bench.positioner,
            bench.observer,
            operator,
            clock=bench.clock,
            utc=bench.utc,
            stop=stop,
            show=show,
            annotate=bench.annotate,
            details=bench.details,
            estimate=running,
        )
        try:
            return acquisition.run()
        finally:
            if instrument is not None:
                write_truth(folder, instrument)


def _utc_now() -> datetime.datetime:
    return datetime.datetime.now(datetime.UTC)


@contextmanager
def _hardware(rig: Rig, detector: Detector) -> Iterator[_Bench]:
    """Positioner and cameras of a rig file."""
    port = rig.positioner.get("port")
    if rig.positioner.get("driver", "serial") != "serial" or not port:
        remedy = 'write driver = "serial" and port = "/dev/ttyACM0" (or "COM3") into [positioner]; see tvsbayes doctor'
        raise InputError("positioner", "[positioner] of the rig file names no serial port", remedy=remedy)
    opener = serial_opener(str(port), int(rig.positioner.get("baud", BAUD)))
    positioner = SerialPositioner(opener, device_settings(rig.positioner))
    try:
        camera = open_cameras(rig.cameras, rig.stereo.image_width, rig.stereo.image_height)
    except BaseException:
        positioner.close()
        raise
    try:
        settings = camera.settings()
        details = {"device": positioner.identity, "cameras": settings.as_json()}
        observer = CameraObserver(camera, detector)
        yield _Bench(positioner, observer, time, _utc_now, details, warnings=settings.warnings)
    finally:
        positioner.close()
        camera.close()


@contextmanager
def _simulated(
    rig: Rig, instrument: Instrument, detector: Detector, renderer: Renderer | None, folder: Path, resume: bool
) -> Iterator[_Bench]:
    """The twin on the device model; with a renderer, seen through a virtual camera."""
    positioner = instrument.positioner()
    offset_s = 0.0
    if resume:
        # Virtual time goes on where the last run stood.
        offset_s = max((m.time_s for m in recorded(read_journal(folder).records).moves), default=0.0)
    clock = instrument.clock

    def utc() -> datetime.datetime:
        return SIMULATED_START + datetime.timedelta(seconds=offset_s + clock.monotonic())

    def annotate() -> Mapping[str, object]:
        return {"twin": {name: list(pair) for name, pair in instrument.state_deg().items()}}

    details = {"device": positioner.identity, "simulated": True}
    if renderer is None:
        sd_px = float(rig.cameras.get("spot_sd_px", SPOT_SD_PX))
        yield _Bench(positioner, TwinObserver(instrument, sd_px), clock, utc, details, annotate)
        return
    frame = [0]

    def render() -> StereoImage:
        frame[0] += 1
        return renderer(instrument.light(), instrument.motions, frame[0])

    with VirtualCamera(render) as virtual:
        camera = open_cameras({"source": virtual.address}, rig.stereo.image_width, rig.stereo.image_height)
        try:
            yield _Bench(positioner, CameraObserver(camera, detector), clock, utc, details, annotate)
        finally:
            camera.close()


def check_journal(folder: Path) -> dict[str, object]:
    """Verifies the journal of a campaign folder and compares the campaign files with it.

    `moves` and `looks` of the document count what the journal holds; without a move there is no campaign yet.

    Raises:
        InputError: damage, with line number.
    """
    document = verify(folder).as_json()
    reading = read_journal(folder)
    record = recorded(reading.records)
    warnings = [*document["warnings"]]
    gaps = [r.line for r in reading.records if r.event == "gap"]
    if gaps:
        warnings.append(
            f"a repair left gaps in lines {', '.join(map(str, gaps[:5]))}{', ...' * (len(gaps) > 5)}, and "
            f"{len(record.ignored_lines)} events after them do not count: acquire --resume takes lost looks again"
        )
    for segment, deviation in record.lost:
        warnings.append(f"segment {segment}: {deviation[0]} and {deviation[1]} steps were lost; its spots do not count")
    if record.unverified:
        names = ", ".join(map(str, record.unverified))
        warnings.append(
            f"whether steps were lost in segment {names} is not known: the run or the device was interrupted"
        )
    if record.moves:
        present = read_campaign(folder)
        behind = len(record.moves) - len(present.moves), len(record.spots) - len(present.spots)
        if behind != (0, 0):
            warnings.append(
                f"moves.csv and spots.csv are {behind[0]} moves and {behind[1]} looks behind the journal: "
                "acquire --resume writes them again"
            )
    else:
        warnings.append("no homing has been logged: there is no campaign yet")
    return {**document, "moves": len(record.moves), "looks": len(record.spots), "warnings": warnings}


def repair_campaign(folder: Path, to: Path) -> dict[str, object]:
    """Copies what is whole of a journal, and writes the campaign that it holds, into a new folder.

    Raises:
        InputError: no journal, nothing whole, a folder that holds something, or campaign files that are damaged too.
    """
    if not (folder / LOG).is_file():
        remedy = "only folders written by `tvsbayes acquire` have a journal to repair"
        place = escaped(str(folder / LOG), 200)
        raise refusal("missing-file", file=place, found="no journal", allowed="a journal", remedy=remedy)
    # Rig, stereo and header stand in files of their own, written once and not touched since.
    before = _settings_of(folder)
    done = repair(folder, to)
    record = recorded(read_journal(to).records)
    if record.moves:
        write_derived(Campaign(record.moves, record.spots, before.stereo, before.rig, before.header), to)
    return {**done.as_json(), "moves": len(record.moves), "looks": len(record.spots)}


def _settings_of(folder: Path) -> Campaign:
    """Stereo calibration, rig and header of a campaign whose tables may be damaged."""
    keys = parse_toml(read_bytes(folder / "campaign.toml", TOML_BYTES_MAX, folder), "campaign.toml")
    stereo = read_stereo(folder / "stereo.json", folder=folder)
    return Campaign((), (), stereo, parse_rig_table(keys.table("rig")), parse_header(keys))


def write_truth(folder: Path, instrument: Instrument) -> None:
    """Writes `truth.json`: the true rig, and the true angles of the moves that the journal holds."""
    if not (folder / LOG).is_file():
        return
    reading = read_journal(folder)
    record = recorded(reading.records)
    # As in `recorded`: motions after a gap are no rows of moves.csv.
    counted = [r for r in reading.records if r.line not in set(record.ignored_lines)]
    motions = [r.data["twin"] for r in counted if r.event in ("homed", "moved") and "twin" in r.data]
    seen = [motions[spot.move] for spot in record.spots if spot.status == "ok" and spot.move < len(motions)]
    truth = replace(
        instrument.truth,
        mirror_angles_deg=tuple(tuple(m["mirror_angles_deg"]) for m in motions),
        stop_errors_deg=tuple(tuple(m["stop_errors_deg"]) for m in motions),
        reference_pose_deg=reference_pose_deg(seen),
    )
    text = json.dumps(truth.as_json(), indent=1, allow_nan=False) + "\n"
    write_atomically(folder / "truth.json", text.encode())
