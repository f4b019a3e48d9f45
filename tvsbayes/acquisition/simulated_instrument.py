"""The digital twin as a device: gears, mirrors, sheet and laser behind a simulated controller.

The firmware model drives `Mechanics`; every stretch of its motion, including homing, passes through ratio, play and
stop error of a true rig. The light therefore follows the motors, not the plan: lost steps, resets and repeated moves
appear in the pictures as on the bench. The physics is that of `tvsbayes.twin`, not an estimator's formula. Frame S, mm;
degrees where a name says `_deg`; the time of a virtual clock.

The seed determines all random numbers: sheets by the number of their placement, stops by the number of the start, so
that a resumed run has the same rig and sheet, and new stop errors.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from tvsbayes.acquisition.recorder import TrueAngles
from tvsbayes.instrument.axes import AXES, FULL_TURN_DEG, SIDES
from tvsbayes.instrument.mechanisms import mechanism_of
from tvsbayes.instrument.rig import Rig
from tvsbayes.positioner.driver import SerialPositioner
from tvsbayes.positioner.firmware_model import DeviceModel, Mechanics
from tvsbayes.positioner.protocol import SETTINGS, device_settings
from tvsbayes.twin.gear_errors import PERFECT, SECONDS_PER_HOUR, draw_gear_errors, zero_shift_deg
from tvsbayes.twin.physics import Light, Sheet, harmonics_deg, light_on_sheet, project, take_up, wobble_deg
from tvsbayes.twin.simulated_campaign import look_scatter_deg, placed_sheet
from tvsbayes.twin.true_rig import Truth, draw_truth

_STREAMS = {"truth": 0, "stops": 1, "homes": 2, "sheets": 3, "pixels": 4, "gears": 5, "drift": 6, "looks": 7}
LATENCY_US = 300
"""Latency of a request or an answer over USB; a round trip measured on a pseudo-terminal took 0.64 ms."""


class VirtualClock:
    """Time that passes only in `sleep`."""

    def __init__(self) -> None:
        self.now_us = 0

    def monotonic(self) -> float:
        """Seconds since the clock was made."""
        return self.now_us / 1e6

    def sleep(self, seconds: float) -> None:
        """Advance the time at once, by at least a microsecond, so that waiting always ends."""
        self.now_us += max(round(seconds * 1e6), 1)


class SimulatedDevice:
    """A device that can be power-cycled: the mechanics stay, the firmware restarts.

    Attributes:
        clock: its time.
        mechanics: motors, switches and laser.
        model: the running firmware.
        starts: number of starts; the boot id counts from `first_boot`.
    """

    def __init__(self, clock: VirtualClock, mechanics: Mechanics, first_boot: int = 1):
        self.clock, self.mechanics = clock, mechanics
        self.first_boot, self.starts = first_boot, 0
        self.listener: Callable[[bytes], None] | None = None
        self.power_on()

    def power_on(self) -> None:
        """Start the device, also during a motion: counters, homing and settings are lost, the laser is switched off."""
        self.mechanics.flush_all()
        self.starts += 1
        self.model = DeviceModel(self.mechanics, self.first_boot + self.starts - 1, self.clock.now_us, self._send)

    def _send(self, line: bytes) -> None:
        # Without a host the line is dropped, as in the firmware.
        if self.listener is not None:
            self.listener(line)


class ModelLink:
    """A `Link` to a simulated device; subclasses change bytes in `to_device` and `to_host`.

    Bytes arrive at the device at their due time, however the clock advances.
    """

    def __init__(self, device: SimulatedDevice):
        self.device, self.clock = device, device.clock
        self._queue: list[tuple[int, int, bool, bytes]] = []
        self._number = 0
        self._arrived = bytearray()
        device.listener = self.to_host

    def write(self, data: bytes) -> None:
        """See `driver.Link`."""
        self.to_device(data)
        self.settle()

    def read(self, timeout_s: float) -> bytes:
        """See `driver.Link`."""
        deadline_us = self.clock.now_us + max(round(timeout_s * 1e6), 1)
        self.settle()
        while not self._arrived and self.clock.now_us < deadline_us:
            ahead_us = self._queue[0][0] if self._queue else deadline_us
            self.clock.now_us = max(min(ahead_us, deadline_us), self.clock.now_us)
            self.settle()
        data = bytes(self._arrived)
        self._arrived.clear()
        return data

    def close(self) -> None:
        """See `driver.Link`."""
        self.device.listener = None

    def to_device(self, data: bytes) -> None:
        """Receive bytes written by the host."""
        self.deliver(data, True, LATENCY_US)

    def to_host(self, data: bytes) -> None:
        """Receive bytes written by the device."""
        self.deliver(data, False, LATENCY_US)

    def deliver(self, data: bytes, device: bool, delay_us: int) -> None:
        """Queue bytes; they arrive in order of time, then in order of sending."""
        self._number += 1
        heapq.heappush(self._queue, (self.clock.now_us + delay_us, self._number, device, data))

    def settle(self) -> None:
        """Process everything that is due by now."""
        now_us = self.clock.now_us
        while self._queue and self._queue[0][0] <= now_us:
            due_us, _, device, data = heapq.heappop(self._queue)
            if device:
                self.device.model.advance(due_us)
                # The device answers at the time of the bytes, which may be earlier than the clock's.
                self.clock.now_us = due_us
                self.device.model.receive(data, due_us)
                self.clock.now_us = now_us
            else:
                self._arrived += data
        self.device.model.advance(now_us)


class _Gear:
    """The true gear of one axis, and where it stands: degrees of the output (formulation 3.1).

    `period_deg` is the period of its first harmonics, `start_share` its first position in the play, -1/2 to 1/2.
    """

    def __init__(self, axis: str, truth: Truth, period_deg: float, start_share: float):
        self._axis, self._p, self._period_deg = axis, truth.parameters, period_deg
        self._errors = (truth.gear_errors or PERFECT)[axis]
        self._backlash_deg = truth.parameters[f"backlash_deg.{axis}"]
        # Before the play, and behind it.
        self._driving_deg, self._output_deg = 0.0, self._backlash_deg * start_share
        # Mean ratio x counter without lost steps: the position of repeatable errors.
        self._place_deg = 0.0
        self._drift_deg, self._drifted_us = 0.0, 0
        self.stop_error_deg = 0.0
        self.from_switch = False
        """Whether the next motion is that from the home switch to the first row of a segment."""

    def move(self, steps: int, normal: float) -> None:
        """Apply a stretch of motion: ratio of its sense, play, a new stop error by a standard normal number."""
        sense = SIDES[self._axis][steps > 0]
        # The first row of a segment is at mean ratio x counters.
        ratio = self._axis if self.from_switch else sense
        self.from_switch = False
        self._driving_deg += steps * self._p[f"degrees_per_step.{ratio}"]
        self._place_deg += steps * self._p[f"degrees_per_step.{self._axis}"]
        self._take_up()
        self.stop_error_deg = self._p[f"stop_sd_deg.{sense}"] * normal

    def set_home(self, steps: int, offset_deg: float, keeps_zero: bool) -> None:
        """Set the counter at the home switch: from here on the angle is ratio x counter + offset.

        Without drift, unless the encoder `keeps_zero`.
        """
        angle = self._p[f"degrees_per_step.{self._axis}"] * steps + offset_deg
        self._output_deg += angle - self._driving_deg
        self._driving_deg, self._place_deg = angle, angle - offset_deg
        self._drift_deg, self.from_switch = self._drift_deg if keeps_zero else 0.0, True
        self._take_up()

    def drift(self, now_us: int, normal: float) -> None:
        """Apply the drift of the zero since the last call by a standard normal number; cameras must not call it."""
        hours = np.array([self._drifted_us, now_us]) / (1e6 * SECONDS_PER_HOUR)
        self._drifted_us = now_us
        step = self._p.get(f"drift_deg_per_root_hour.{self._axis}", 0.0) * np.sqrt(hours[1] - hours[0]) * normal
        self._drift_deg += float(step + np.diff(self._errors.warming_deg(hours))[0])

    def angle_deg(self, now_us: int) -> float:
        """Compute the angle of the output, with its errors, the drift and the creep of the zero."""
        crept = float(zero_shift_deg(self._p, self._axis, np.array(now_us / 60e6)))
        repeated = float(self._errors.error_deg(np.array(self._place_deg))) + self._drift_deg + crept
        return self._output_deg + self._wobble_deg(self._output_deg, wheel=True) + repeated + self.stop_error_deg

    def _take_up(self) -> None:
        driving = self._driving_deg + self._wobble_deg(self._driving_deg, wheel=False)
        width = self._errors.play_at(self._backlash_deg, np.array(self._place_deg))
        self._output_deg = take_up(self._output_deg, driving, float(width))

    def _wobble_deg(self, angle_deg: float, wheel: bool) -> float:
        """Compute the transmission error of the wheel (behind the play) or of the pinion (before it)."""
        if (self._period_deg == FULL_TURN_DEG) != wheel:
            return 0.0
        return float(wobble_deg(angle_deg, harmonics_deg(self._p, self._axis), self._period_deg))


class Instrument:
    """A true rig behind a simulated device.

    Args:
        rig: the declared rig; the true one is drawn from its `truth`.
        seed: seed of all random numbers.
        start: number of earlier starts of this campaign; stop errors differ between starts.
        truth: the true rig; None draws one, the same for every start of a seed.
    """

    def __init__(self, rig: Rig, seed: int, start: int = 0, truth: Truth | None = None):
        self.rig, self.seed, self._start = rig, int(seed), start
        truth = draw_truth(rig, self._stream("truth")) if truth is None else truth
        if truth.gear_errors is None:
            period_deg, stream = rig.table.harmonic_period_deg, self._stream("gears")
            truth = replace(truth, gear_errors=draw_gear_errors(truth.parameters, period_deg, stream))
        self.truth, self.clock = truth, VirtualClock()
        self._stops, self._homes = self._stream("stops", start), self._stream("homes", start)
        self._pixels, self._drifts = self._stream("pixels", start), self._stream("drift", start)
        first = rig.table.first_period_deg
        self._gears = [
            _Gear(axis, truth, first.get(axis, FULL_TURN_DEG), self._stops.uniform(-0.5, 0.5)) for axis in AXES
        ]
        # Axes whose first homing is that of the campaign.
        self._unhomed = {0, 1} if start == 0 else set[int]()
        settings = device_settings(rig.positioner)
        home = settings.get("hp", SETTINGS["hp"][2]), settings.get("ht", SETTINGS["ht"][2])
        self.mechanics = Mechanics(home_steps=home, moved=self._moved, found_home=self._found_home)
        # Every start has its own boot id: a simulated device ends with its process.
        self.device = SimulatedDevice(self.clock, self.mechanics, first_boot=1 + 1000 * start)
        self.motions = 0
        """Number of stretches of motion so far; between two of them the scene is at rest."""
        self._sheet = Sheet(np.array(np.nan), np.array([1.0, 0.0, 0.0]))

    def _stream(self, name: str, *numbers: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence([self.seed, _STREAMS[name], *numbers]))

    def positioner(self) -> SerialPositioner:
        """The driver on this device, with the limits and the speed of the rig file."""
        return SerialPositioner(lambda: ModelLink(self.device), device_settings(self.rig.positioner), self.clock)

    def place(self, target: str, placement: int) -> None:
        """Put the sheet at a target; the same placement number gives the same position again."""
        draws = self._stream("sheets", placement).standard_normal(3)
        self._sheet = placed_sheet(self.rig.sheets_mm[target], draws)

    def _moved(self, axis: int, steps: int) -> None:
        self.motions += 1
        gear = self._gears[axis]
        gear.drift(self.clock.now_us, self._drifts.standard_normal())
        gear.move(steps, self._stops.standard_normal())

    def _found_home(self, axis: int) -> None:
        """Set the counter of an axis, with a new home offset, 0 in the first segment."""
        keeps_zero = AXES[axis] in self.rig.table.absolute
        sd_deg = 0.0 if keeps_zero else self.truth.parameters[f"home_sd_deg.{AXES[axis]}"]
        offset = 0.0 if axis in self._unhomed else sd_deg * self._homes.standard_normal()
        self._unhomed.discard(axis)
        gear = self._gears[axis]
        gear.drift(self.clock.now_us, self._drifts.standard_normal())
        gear.set_home(self.mechanics.home_steps[axis], offset, keeps_zero)

    def state_deg(self) -> TrueAngles:
        """Return the true angles for a row of moves.csv.

        Ends the motion from the home switch: the engine calls it once per motion.
        """
        for gear in self._gears:
            gear.from_switch = False
        pan, tilt = (gear.stop_error_deg for gear in self._gears)
        return TrueAngles(self._mirror_angles_deg(), (pan, tilt))

    def _mirror_angles_deg(self) -> tuple[float, float]:
        psi, beta = (gear.angle_deg(self.clock.now_us) for gear in self._gears)
        return psi, beta + self.truth.parameters[mechanism_of(self.truth.parameters).tilt_zero]

    def light(self) -> Light:
        """The light at this moment; changes nothing, so that a camera's thread may call it at any time.

        A look lasts from laser on to laser off: its scatter is drawn by its number.
        """
        normal = self._stream("looks", self._start, self.mechanics.lit).standard_normal(2)
        psi, beta = np.radians(self._mirror_angles_deg() + look_scatter_deg(self.truth.parameters, normal))
        light = light_on_sheet(psi, beta, self.truth.parameters, self._sheet)
        return light if self.mechanics.laser_on else replace(light, points_mm=np.full(3, np.nan))

    def centroid_px(self) -> np.ndarray:
        """(4,) u_left, v_left, u_right, v_right of the spot without noise; NaN where it is not seen."""
        return project(self.light().points_mm[None], self.truth.stereo_pair, self.truth.parameters["focal_scale"])[0]

    def noisy_centroid_px(self, sd_px: float) -> np.ndarray:
        """The centroid of a detector that states `sd_px`: its noise is pixel scale x sd_px."""
        noise = self.truth.parameters["pixel_scale"] * sd_px * self._pixels.standard_normal(4)
        return self.centroid_px() + noise


def reference_pose_deg(looks: Sequence[TrueAngles]) -> tuple[float, float] | None:
    """Mean mirror angles without stop errors over `state_deg` of the looks used (formulation 3.2); None if none."""
    if not looks:
        return None
    resting = np.array([np.subtract(look.mirror_angles_deg, look.stop_errors_deg) for look in looks])
    pan, tilt = resting.mean(axis=0)
    return float(pan), float(tilt)
