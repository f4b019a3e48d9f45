"""From files and options to a running acquisition: hardware or simulation, the person at the terminal, the live line.

`acquire` is what the command of that name does. With `simulate` the positioner is the device model on a virtual
clock, and what the cameras see comes from the twin: as centroids, or, with a `renderer`, as pictures through a
virtual MJPEG camera and the same camera code as on the bench.
"""

from __future__ import annotations

import datetime
import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from tvsbayes.campaign import Campaign, PlanStep, parse_header, read_campaign
from tvsbayes.device.acquisition import (
    Acquisition,
    Outcome,
    Progress,
    StopKey,
    begin,
    check_plan,
)
from tvsbayes.device.camera import StereoImage, VirtualCamera, open_cameras
from tvsbayes.device.driver import Positioner, SerialPositioner, device_settings, serial_opener
from tvsbayes.device.estimate import RunningEstimate, directions_of
from tvsbayes.device.journal import LOG, read_journal, repair, verify
from tvsbayes.device.observation import CameraObserver, Detector, Observer, TwinObserver, wait_for_detection
from tvsbayes.device.record import recorded, write_derived
from tvsbayes.device.twin import Instrument, Renderer, reference_pose_deg
from tvsbayes.files import (
    TOML_BYTES_MAX,
    InputError,
    escaped,
    parse_toml,
    read_bytes,
    refusal,
    write_atomically,
)
from tvsbayes.rigs import Rig, parse_rig_table, read_stereo
from tvsbayes.simulation import SPOT_SD_PX

LASER_CLASSES = ("1", "1M", "2", "2M", "3R", "3B", "4")
"""IEC 60825-1, the classes that a user may state instead of being asked."""
BAUD = 115_200
SIMULATED_START = datetime.datetime(2026, 1, 1, tzinfo=datetime.UTC)
"""Time of day at which every simulated campaign begins: same seed, same bytes."""


@dataclass
class TerminalOperator:
    """Asks on the terminal.

    Attributes:
        stop: the stop key, which may interrupt a question.
        say: shows a line.
        ask: shows a question and returns the answer.
        laser_class: stated on the command line: the hazard is shown, nobody is asked.
    """

    stop: StopKey
    say: Callable[[str], None]
    ask: Callable[[str], str] = input
    laser_class: str | None = None

    def accept(self, hazard: str) -> bool:
        """See `Operator.accept`."""
        for line in hazard.splitlines():
            self.say(line)
        if self.laser_class is not None:
            self.say(f"laser class {self.laser_class} stated on the command line: not asked")
            return True
        return self._answer("Type yes to go on: ") == "yes"

    def place(self, target: str, x_mm: float, placement: int, remark: str) -> bool:
        """See `Operator.place`."""
        if remark:
            self.say(f"note: {remark}")
        answer = self._answer(f"Put the sheet at {target} (X = {x_mm:g} mm), then press Enter; q stops: ")
        return answer != "q"

    def _answer(self, question: str) -> str:
        self.stop.at_prompt = True
        try:
            return self.ask(question).strip().lower()
        except (EOFError, KeyboardInterrupt):
            self.stop.requested = True
            return "q"
        finally:
            self.stop.at_prompt = False


@dataclass
class SimulatedOperator:
    """Puts the twin's sheet where it is asked for."""

    instrument: Instrument

    def accept(self, hazard: str) -> bool:
        """A simulated laser hurts nobody."""
        return True

    def place(self, target: str, x_mm: float, placement: int, remark: str) -> bool:
        """See `Operator.place`."""
        self.instrument.place(target, placement)
        return True


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
    _check_hazard(laser_class, simulate)
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
            running = RunningEstimate(folder, target_u_deg_per_step, directions_of(plan), wait=simulate)
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


def _check_hazard(laser_class: str | None, simulate: bool) -> None:
    """Refuses a laser class that there is none of, and a real laser of which nobody can be told."""
    if laser_class is not None and laser_class.upper() not in LASER_CLASSES:
        remedy = "read it off the laser's label"
        raise InputError(
            "usage", f"laser class {escaped(laser_class)}", allowed=", ".join(LASER_CLASSES), remedy=remedy
        )
    if not simulate and laser_class is None and not sys.stdin.isatty():
        remedy = "run it in a terminal, or state --laser-class"
        raise InputError("usage", "nobody can be asked about the laser hazard", remedy=remedy)


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


class LiveLine:
    """A line that shows progress on a terminal, plain lines every tenth of the way elsewhere; a context manager."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, TextColumn
        from rich.progress import Progress as Bar

        self._console = Console(stderr=True)
        columns = TextColumn("{task.fields[doing]}"), BarColumn(), TextColumn("{task.fields[note]}")
        self._bar = Bar(*columns, console=self._console, transient=True, disable=not self._console.is_terminal)
        self._task = self._bar.add_task("acquire", total=None, doing="", note="")
        self._tenths = 0

    def __enter__(self) -> LiveLine:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def show(self, state: Progress) -> None:
        """Takes the news."""
        note = f"look {state.looks} of {state.looks_total}, {state.refused} refused, {state.retries} repeated, "
        note += f"{state.seconds_left / 60:.0f} min left"
        if state.estimate:
            note += f"; deg/step {state.estimate}"
        self._bar.update(self._task, total=state.steps, completed=state.step, doing=state.doing, note=note)
        tenths = 10 * state.step // max(state.steps, 1)
        if not self._console.is_terminal and tenths > self._tenths:
            self._tenths = tenths
            self._console.print(f"{10 * tenths} %: {note}", highlight=False)

    def ask(self, question: str) -> str:
        """`input` without the line running over the question, which goes to stderr: stdout is for the result."""
        self._bar.stop()
        try:
            self._console.print(question, end="", markup=False, highlight=False)
            return input()
        finally:
            self._bar.start()
