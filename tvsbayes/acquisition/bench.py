"""The devices of a run: the bench of a rig file, or its twin on a virtual clock.

A simulated bench draws its true rig from the seed; the twin gives centroids, or, with a
`renderer`, pictures that are searched by the detector of the real bench. Its time continues from the end of the last
run in its journal.
"""

from __future__ import annotations

import datetime
import json
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from msgspec import UNSET

from tvsbayes.acquisition.drivers import cameras_of, connect_trigger, positioner_of
from tvsbayes.acquisition.emulated_instrument import EmulatedInstrument
from tvsbayes.acquisition.journal import LOG, read_journal
from tvsbayes.acquisition.observation import CameraObserver, Detector, Observer, TwinObserver, wait_for_detection
from tvsbayes.acquisition.operator import Operator, SimulatedOperator
from tvsbayes.acquisition.recorder import Homed, Moved, Recorded, event_of, recorded
from tvsbayes.acquisition.simulated_drivers import SimulatedCamera
from tvsbayes.acquisition.simulated_instrument import Instrument, Renderer, reference_pose_deg
from tvsbayes.files.disk import write_atomically
from tvsbayes.instrument.campaign import Campaign
from tvsbayes.instrument.rig import Rig
from tvsbayes.positioner.emulated_board import EmulatedBoard
from tvsbayes.positioner.interface import Clock, Positioner
from tvsbayes.results.records import plain
from tvsbayes.twin.true_rig import pan_and_tilt

SIMULATED_START = datetime.datetime(2026, 1, 1, tzinfo=datetime.UTC)
"""Time of day at which every simulated campaign begins: same seed, same bytes."""


@dataclass(frozen=True)
class Vision:
    """How pictures are made and searched for spots.

    Attributes:
        detector: finds spots in pictures; by default looks stay `undetected`.
        renderer: makes the twin's pictures; without one a simulation states centroids.
    """

    detector: Detector = wait_for_detection
    renderer: Renderer | None = None


@dataclass(frozen=True)
class Bench:
    """The devices and services of a run.

    Attributes:
        positioner: connected.
        observer: takes the looks.
        operator: asked before the laser comes on and for every sheet.
        clock: clock for settling.
        utc: the time of day, for `time_s`.
        details: entries on device and cameras, for the event `start`.
        annotate: returns further entries of every motion's event (the twin's true angles).
        conclude: called with the campaign folder once the run has ended.
        warnings: shown before the run begins.
    """

    positioner: Positioner
    observer: Observer
    operator: Operator
    clock: Clock
    utc: Callable[[], datetime.datetime]
    details: Mapping[str, Any] = field(default_factory=dict)
    annotate: Callable[[], Mapping[str, Any]] = dict
    conclude: Callable[[Path], None] = lambda folder: None
    warnings: tuple[str, ...] = ()


@contextmanager
def hardware(rig: Rig, detector: Detector, operator: Operator) -> Iterator[Bench]:
    """Positioner and cameras of a rig file; closed at the end.

    Raises:
        InputError: the rig file names no device.
        DeviceFault: they cannot be opened or set.
    """
    positioner = positioner_of(rig)
    try:
        camera = cameras_of(rig)
    except BaseException:
        positioner.close()
        raise
    try:
        connect_trigger(positioner, camera)
        settings = camera.settings()
        details = {"device": dict(positioner.identity), "cameras": plain(settings)}
        observer = CameraObserver(camera, detector)
        warnings = (*getattr(positioner, "warnings", ()), *settings.warnings)
        utc = partial(datetime.datetime.now, datetime.UTC)
        yield Bench(positioner, observer, operator, time, utc, details, warnings=warnings)
    finally:
        positioner.close()
        camera.close()


@contextmanager
def simulated(
    rig: Rig, seed: int, record: Recorded, vision: Vision, board: EmulatedBoard | None = None
) -> Iterator[Bench]:
    """The twin on the device model; with a renderer, its cameras take pictures.

    Args:
        rig: the declared rig.
        seed: seed of all random numbers.
        record: earlier runs, from the journal.
        vision: how pictures are made and searched.
        board: runs the firmware itself, in real time, instead of its model.
    """
    starts = record.starts
    instrument = Instrument(rig, seed, starts) if board is None else EmulatedInstrument(rig, seed, starts, board)
    positioner, clock = instrument.positioner(), instrument.clock
    # Virtual time continues from the end of the last run.
    start = SIMULATED_START + datetime.timedelta(seconds=max((move.time_s for move in record.moves), default=0.0))

    def bench(observer: Observer) -> Bench:
        return Bench(
            positioner,
            observer,
            SimulatedOperator(instrument),
            clock,
            utc=lambda: start + datetime.timedelta(seconds=clock.monotonic()),
            details={"device": positioner.identity, "simulated": True},
            annotate=lambda: {"twin": instrument.state_deg()},
            conclude=lambda folder: write_truth(folder, instrument),
        )

    try:
        if vision.renderer is None:
            yield bench(TwinObserver(instrument, rig.spot_sd_px))
            return
        yield bench(CameraObserver(SimulatedCamera(instrument, vision.renderer), vision.detector))
    finally:
        positioner.close()


def write_truth(folder: Path, instrument: Instrument) -> None:
    """Writes `truth.json`: the true rig, and the true angles of the moves in the journal."""
    if not (folder / LOG).is_file():
        return
    records = read_journal(folder).records
    record = recorded(records)
    # As in `recorded`: motions after a gap are not rows of moves.csv.
    counted = [r for r in records if r.line not in set(record.ignored_lines)]
    events = [event for r in counted if (event := event_of(r, Homed) or event_of(r, Moved)) is not None]
    motions = [event.twin for event in events if event.twin is not UNSET]
    looks = [motions[spot.move] for spot in record.spots if spot.status == "ok" and spot.move < len(motions)]
    truth = replace(
        instrument.truth,
        mirror_angles_deg=pan_and_tilt(m.mirror_angles_deg for m in motions),
        stop_errors_deg=pan_and_tilt(m.stop_errors_deg for m in motions),
        reference_pose_deg=reference_pose_deg(looks),
    )
    campaign = Campaign(tuple(record.moves), record.spots, instrument.rig.stereo, instrument.rig.table)
    text = json.dumps(truth.as_json(campaign), indent=1, allow_nan=False) + "\n"
    write_atomically(folder / "truth.json", text.encode())
