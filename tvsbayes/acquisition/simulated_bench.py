"""The twin's bench: a run on the simulated instrument, with centroids or pictures, and the twin as drivers.

A simulated bench draws its true rig from the seed; the twin gives centroids, or pictures that are searched by the
detector of the real bench. Its virtual time continues from the end of the last run in its journal.

As drivers (`driver = "simulated"` in `[positioner]` and `[cameras]` of a rig file) the twin serves `doctor`, tests of
code that drives an instrument, and as an example for other drivers. Positioner and cameras of one rig file and seed
(`options.seed`) share one twin, with the first sheet of `[sheets]` in front of its cameras.
"""

from __future__ import annotations

import datetime
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from weakref import WeakValueDictionary

import numpy as np
from msgspec import UNSET

from tvsbayes.acquisition.bench import Bench
from tvsbayes.acquisition.journal import LOG, read_journal
from tvsbayes.acquisition.observation import CameraObserver, DetectedSpot, Detector, Observation, Observer
from tvsbayes.acquisition.recorder import Homed, Moved, Recorded, event_of, recorded
from tvsbayes.acquisition.simulated_instrument import Instrument, reference_pose_deg
from tvsbayes.cameras.capture import CameraSettings, StereoImage
from tvsbayes.errors import entry_refusal
from tvsbayes.files.disk import write_atomically
from tvsbayes.instrument.campaign import Campaign
from tvsbayes.instrument.rig import Rig, Setting
from tvsbayes.positioner.driver import SerialPositioner
from tvsbayes.positioner.interface import Positioner
from tvsbayes.twin.physics import cameras_of
from tvsbayes.twin.spot_pictures import Scene, Sensor, render_spots
from tvsbayes.twin.true_rig import pan_and_tilt

SIMULATED_START = datetime.datetime(2026, 1, 1, tzinfo=datetime.UTC)
"""Time of day at which every simulated campaign begins: same seed, same bytes."""
_TWINS: WeakValueDictionary[tuple[str, int], Instrument] = WeakValueDictionary()
"""Twins in use, by rig file and seed."""


@dataclass
class SimulatedOperator:
    """Puts the twin's sheet at the target."""

    instrument: Instrument

    def accept(self, hazard: str) -> bool:
        """Accept: a simulated laser is no hazard."""
        return True

    def place(self, target: str, x_mm: float, placement: int, remark: str) -> bool:
        """See `Operator.place`."""
        self.instrument.place(target, placement)
        return True


@dataclass
class TwinObserver:
    """Takes looks of the digital twin without pictures: the centroids of a detector, with noise.

    Attributes:
        instrument: the simulated instrument.
        sd_px: standard uncertainty stated for every coordinate.
    """

    instrument: Instrument
    sd_px: float

    def observe(self, positioner: Positioner, spot: int) -> Observation:
        """See `Observer.observe`."""
        try:
            positioner.laser(True)
            pixels = self.instrument.noisy_centroid_px(self.sd_px)
        finally:
            positioner.laser(False)
        if not np.isfinite(pixels).all():
            return Observation(DetectedSpot("no-spot"))
        u_left, v_left, u_right, v_right = map(float, pixels)
        return Observation(DetectedSpot("ok", (u_left, v_left, u_right, v_right), (self.sd_px,) * 4))


class SimulatedCamera:
    """See `StereoCamera`: a new exposure of the twin's true cameras for every pair."""

    def __init__(self, instrument: Instrument):
        truth = instrument.truth
        self._instrument, self._frame = instrument, 0
        self._cameras = cameras_of(truth.stereo_pair, truth.parameters["focal_scale"])

    def grab(self) -> StereoImage:
        """See `StereoCamera.grab`; between two motions the speckle stays, and every frame has new noise."""
        self._frame += 1
        light, seed, look = self._instrument.light(), self._instrument.seed, self._instrument.motions
        rendered = render_spots(self._cameras, light, Scene(), Sensor(), seed, look, self._frame)
        return StereoImage(rendered.left, rendered.right)

    def settings(self) -> CameraSettings:
        """See `StereoCamera.settings`."""
        return CameraSettings({})

    def close(self) -> None:
        """See `StereoCamera.close`."""


@contextmanager
def simulated(rig: Rig, seed: int, record: Recorded, detector: Detector | None) -> Iterator[Bench]:
    """The twin on the device model; with a detector, its cameras take pictures.

    Args:
        rig: the declared rig.
        seed: seed of all random numbers.
        record: earlier runs, from the journal.
        detector: finds the spots in pictures; None: the twin states centroids.
    """
    instrument = Instrument(rig, seed, record.starts)
    positioner, clock = instrument.positioner(), instrument.clock
    # Virtual time continues from the end of the last run.
    start = SIMULATED_START + datetime.timedelta(seconds=max((move.time_s for move in record.moves), default=0.0))

    observer: Observer = TwinObserver(instrument, rig.spot_sd_px)
    if detector is not None:
        observer = CameraObserver(SimulatedCamera(instrument), detector)
    try:
        yield Bench(
            positioner,
            observer,
            SimulatedOperator(instrument),
            clock,
            utc=lambda: start + datetime.timedelta(seconds=clock.monotonic()),
            details={"device": positioner.identity, "simulated": True},
            annotate=lambda: {"twin": instrument.state_deg()},
            conclude=lambda folder: write_truth(folder, instrument),
        )
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


def simulated_positioner(rig: Rig) -> SerialPositioner:
    """The package's driver on the device model, with its own virtual clock: homing takes no real time."""
    return _twin(rig, rig.positioner, "positioner").positioner()


def simulated_cameras(rig: Rig) -> SimulatedCamera:
    """The twin's cameras."""
    return SimulatedCamera(_twin(rig, rig.cameras, "cameras"))


def _twin(rig: Rig, table: dict[str, Setting], name: str) -> Instrument:
    unknown = [key for key in table if key.startswith("options.") and key != "options.seed"]
    seed = table.get("options.seed", 0)
    if unknown or not isinstance(seed, int) or seed < 0:
        remedy = "leave out what a simulated instrument does not have"
        found, allowed = ", ".join(unknown) or f"seed {seed}", "options.seed, a whole number from 0"
        raise entry_refusal("options", name, "options", found, allowed, remedy)
    key = str(rig.path), seed
    twin = _TWINS.get(key)
    if twin is None:
        twin = _TWINS[key] = Instrument(rig, seed)
        if rig.sheets_mm:
            twin.place(next(iter(rig.sheets_mm)), 0)
    return twin
