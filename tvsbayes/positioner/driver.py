"""Host side of the positioner: one request at a time, safe repeats, resynchronisation, reconnection.

`move_to` and `home` return only after the device has reported, in a frame with a good CRC, that this motion reached its
target, at the ordered counters, without a reset in between (same boot id). Everything else ends in a `DeviceFault`
within a bounded time. After a time-out the same line is sent again; that is safe, because the device executes a
sequence number once. A device that was reset has lost its counters: that is a `PositionLost`, never a silent
continuation.

Counters are absolute motor steps (pan, tilt); seconds where a name says `_s`. Time comes from a `Clock`, bytes from
a `Link`: tests drive both without hardware and without waiting.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import partial

from tvsbayes.errors import DeviceFault, escaped
from tvsbayes.positioner.interface import Clock, HomeReport, Link, PositionLost, fault, opened, reason
from tvsbayes.positioner.protocol import (
    REPLY_CHARS_MAX,
    SEQUENCE_MAX,
    SETTINGS,
    START_SPEED,
    VERSION,
    DeviceState,
    FrameError,
    Reply,
    parse_answer,
    request,
    unsigned,
)
from tvsbayes.positioner.silence import HEARD_BYTES_MAX, explained

ATTEMPTS = 6
"""Number of attempts at a request before the device counts as dead."""
CLOSING_ATTEMPTS = 3
"""Number of attempts while closing."""
REPLY_S = 0.5
"""Silence after which a request is sent again. A clean round trip takes about 1 ms on USB, 0.2 s at 9600 baud."""
NAK_S = 0.05
"""Silence after a negative acknowledgement after which a request is sent again."""
REPLY_MAX_S = 3.0
"""Longest wait for one answer while bytes keep arriving: a slow line, or noise."""
DRAIN_S, DRAIN_MAX_S = 0.05, 1.0
"""Silence that ends the draining of a line just opened, and the longest draining."""
POLL_S = 0.05
"""Time between two status requests during a motion; far below the laser watchdog of the device."""
TRIGGER_PULSE_US = 1_000
"""Long enough for every camera's input, including opto-coupled inputs."""
HOME_S = 300.0
"""Longest duration of a homing: 20 000 steps per axis at 200 steps/s are 200 s."""
RECONNECT_S = 10.0
"""Longest wait for an unplugged device."""
_REFUSALS = {
    "limit": "the target lies outside the soft limits: correct the plan or [positioner] in the rig file",
    "unhomed": "home first",
    "busy": "another program drives the device: close it",
    "seq": "another program drives the device: close it",
}
_ALARMS = {
    "limit": "a limit switch opened: clear the way, check the limits in the rig file, then home; "
    "if homing also ends like this, turn the axis back by hand and check the wire of the limit switches",
    "home": "a home switch was not found: check its wiring, then home",
    "abort": "the motion was aborted: make sure that it is safe, then home",
}


class SerialPositioner:
    """The driver of the firmware shipped with this package.

    Args:
        open_link: opens the line, also after an unplugging; raises OSError while there is none.
        settings: device settings by protocol name (`protocol.SETTINGS`), set and read back.
        clock: source of time.

    Raises:
        DeviceFault: nothing answers, or another firmware answers.
    """

    def __init__(
        self,
        open_link: Callable[[], Link],
        settings: Mapping[str, int] | None = None,
        clock: Clock = time,
    ):
        self._open_link, self._clock = open_link, clock
        self._settings = dict(settings or {})
        self._link: Link | None = None
        self._buffer, self._dropping = bytearray(), False
        self._sequence, self._boot = 0, -1
        self._homed_here, self._device_homed, self._lit = False, False, False
        self.repeats = 0
        """Number of requests sent again so far: a measure of the line's quality."""
        self._received = bytearray()
        self._link = opened(open_link)
        try:
            self._drain()
            identity = self._identify()
            self._boot, self._device_homed = identity.state.boot, identity.state.status == "idle"
            self.identity = dict(identity.extra)
            for key, value in self._settings.items():
                self._set(key, value)
            self._limits = {key: self._get(key) for key in ("vmax", "amax")}
        except BaseException:
            self.close()
            raise

    def home(self) -> HomeReport:
        """See `Positioner.home`."""
        known, compared = self._homed_here, self._device_homed
        # An aborted homing leaves no counters for a comparison.
        self._homed_here = self._device_homed = False
        state = self._wait_for_motion(self._command("HOME"), HOME_S)
        self._homed_here = self._device_homed = True
        if state.laser_on:
            raise fault("laser", "the laser is on after homing", "cut the laser's supply and check the firmware")
        self._lit = False
        deviation = state.pan_home_deviation_steps, state.tilt_home_deviation_steps
        return HomeReport(state, deviation, known, compared, ends_negative=True)

    def move_to(self, pan_steps: int, tilt_steps: int) -> DeviceState:
        """See `Positioner.move_to`.

        Raises:
            DeviceFault: refused, stopped, in alarm, too late, or at other counters than ordered.
        """
        if self._lit:
            self.laser(False)
        target = (int(pan_steps), int(tilt_steps))
        reply = self._command("MA", *target)
        start = reply.state
        distance_steps = max(abs(target[0] - start.pan_steps), abs(target[1] - start.tilt_steps))
        # Twice the whole distance at the starting speed, and two full ramps; 5 s for the line.
        speed, acceleration = self._limits["vmax"], self._limits["amax"]
        timeout_s = 5.0 + 2.0 * (distance_steps / min(speed, START_SPEED) + 2.0 * speed / acceleration)
        state = self._wait_for_motion(reply, timeout_s)
        reached = (state.pan_steps, state.tilt_steps)
        if reached != target or (state.pan_target_steps, state.tilt_target_steps) != target:
            found = f"the device reports {reached}, ordered was {target}"
            raise fault("position", found, "home again; if it happens twice, flash the firmware again")
        return state

    def laser(self, on: bool) -> DeviceState:
        """See `Positioner.laser`."""
        # Set before the order: after an interruption it is unknown whether the order arrived.
        self._lit = self._lit or on
        state = self._command("L", int(on)).state
        if state.laser_on != on:
            state = self.state()
        if state.laser_on != on:
            found = f"the laser line stayed {'off' if on else 'on'} ({state.last_error})"
            raise fault("laser", found, "cut the laser's supply and check its wiring")
        self._lit = on
        return state

    def trigger(self) -> None:
        """See `interface.Triggering`."""
        self._command("TRIG", TRIGGER_PULSE_US)

    def state(self) -> DeviceState:
        """See `Positioner.state`."""
        return self._command("?").state

    def close(self) -> None:
        """See `Positioner.close`."""
        if self._link is None:
            return
        exchange = partial(self._exchange, attempts=CLOSING_ATTEMPTS, reconnect=False)
        try:
            if self._boot < 0:
                # The device is not identified yet, but an earlier run may have left its laser on.
                self._link.write(b"\n" + request(0, "L", 0))
                self._link.read(NAK_S)
            # Unnumbered, so that it is accepted even if another program has used later numbers.
            elif exchange("L", 0, sequence=0).state.status == "moving":
                # Interrupted in a motion: a blocked axis must not be driven on unattended. Numbered, so that the motion
                # of another program continues.
                exchange("STOP")
        except (DeviceFault, OSError):
            # The device's watchdog switches the laser off when requests stop.
            pass
        finally:
            self._link.close()
            self._link = None

    def _drain(self) -> None:
        """Discard bytes that an earlier program left on the line."""
        deadline = self._clock.monotonic() + DRAIN_MAX_S
        try:
            while self._link is not None and (data := self._link.read(DRAIN_S)) and self._clock.monotonic() < deadline:
                self._keep_received(data)
        except OSError:
            # The first request meets the same error and reconnects.
            pass

    def _set(self, key: str, value: int) -> None:
        low, high, _ = SETTINGS[key]
        reply = self._exchange("SET", key, value)
        if reply.error is not None or reply.extra.get("v") != str(value):
            found = f"setting {key} = {value} was answered {reply.error or reply.extra.get('v')}"
            raise fault("setting", found, f"allowed: {low} to {high}, at rest; flash the shipped firmware")

    def _get(self, key: str) -> int:
        text = self._exchange("GET", key).extra.get("v", "")
        if not text.isdigit() or not text.isascii() or int(text) == 0:
            raise fault("setting", f"{key} was answered {escaped(text)!r}", "flash the shipped firmware")
        return int(text)

    def _identify(self) -> Reply:
        """The device's identity; numbers continue from its last sequence."""
        reply = self._exchange("ID", sequence=0)
        version, firmware = reply.extra.get("proto"), escaped(reply.extra.get("fw", "unknown"))
        if version != str(VERSION):
            found = f"firmware {firmware} speaks protocol {escaped(str(version))}, this program speaks {VERSION}"
            remedy = "flash the firmware shipped with tvsbayes: see README.md in its positioner/firmware folder"
            raise fault("firmware", found, remedy)
        last_sequence = unsigned(reply.extra.get("q", ""))
        if last_sequence is None:
            raise fault("firmware", f"firmware {firmware} names no last sequence", "flash the shipped firmware")
        self._sequence = max(self._sequence, last_sequence)
        return reply

    def _command(self, *words: object) -> Reply:
        """A request whose refusal is a fault."""
        reply = self._exchange(*words)
        self._check(reply.state)
        if reply.error is not None:
            found = f"{' '.join(map(str, words))} was refused: {reply.error}"
            raise fault(f"refused-{reply.error}", found, _REFUSALS.get(reply.error, "home and try again"))
        return reply

    def _check(self, state: DeviceState) -> None:
        if state.boot != self._boot:
            self._homed_here = self._device_homed = False
            raise PositionLost(
                "reset",
                "positioner: the device was reset, its counters are lost",
                remedy="check its supply and cable, then go on with --resume: it homes again",
            )
        if state.status == "alarm":
            self._homed_here = self._device_homed = False
            remedy = _ALARMS.get(state.last_error, "home again")
            raise fault(f"alarm-{state.last_error}", f"the device is in alarm: {state.last_error}", remedy)

    def _wait_for_motion(self, reply: Reply, timeout_s: float) -> DeviceState:
        """The state once the motion that `reply` accepted is done."""
        deadline = self._clock.monotonic() + timeout_s
        state = reply.state
        while not (state.status == "idle" and state.done_sequence == reply.sequence):
            if state.status != "moving":
                # The cached answer to a repeated request may be older than the motion's end.
                state = self._command("?").state
                if state.status == "idle" and state.done_sequence == reply.sequence:
                    break
                if state.status != "moving":
                    found = f"the motion ended without reaching its target ({state.status}, {state.last_error})"
                    raise fault("stopped", found, "home again")
            if self._clock.monotonic() > deadline:
                self._exchange("STOP")
                found = f"the motion is not done after {timeout_s:.0f} s"
                raise fault("stall", found, "look for a blocked axis or a missing home switch; then home again")
            self._clock.sleep(POLL_S)
            state = self._command("?").state
        return state

    def _exchange(
        self, *words: object, sequence: int | None = None, attempts: int = ATTEMPTS, reconnect: bool = True
    ) -> Reply:
        """Send one request until it is answered, and reconnect when the line is lost."""
        if sequence is None:
            if self._sequence == SEQUENCE_MAX:
                found = f"the device has used up its sequence numbers (the last one was {SEQUENCE_MAX})"
                remedy = "unplug it and plug it in again: they restart with a reset; then home"
                raise fault("sequence", found, remedy)
            self._sequence += 1
            sequence = self._sequence
        line = request(sequence, *map(str, words))
        for attempt in range(attempts):
            try:
                if self._link is None:
                    raise OSError("the line is closed")
                if attempt:
                    self.repeats += 1
                    # Ends a partial line in the device's buffer.
                    self._link.write(b"\n")
                self._link.write(line)
                reply = self._wait_for_reply(sequence)
            except OSError as error:
                if not reconnect:
                    raise
                self._reconnect(error)
                continue
            if reply is not None:
                self._received.clear()
                return reply
        report = explained(bytes(self._received))
        found = f"no answer to {' '.join(map(str, words))} after {attempts} attempts: {report.found}"
        # A device that has answered before has the right speed and firmware.
        remedy = "check cable and supply; unplug it and plug it in again, then go on with --resume"
        raise fault("no-answer", found, remedy if self._boot >= 0 else report.remedy)

    def _wait_for_reply(self, sequence: int) -> Reply | None:
        """The answer to `sequence`; None for silence, at once after a negative acknowledgement."""
        start = self._clock.monotonic()
        deadline = start + REPLY_S
        while True:
            while (line := self._next_line()) is not None:
                try:
                    answer = parse_answer(line)
                except FrameError:
                    continue
                if isinstance(answer, Reply):
                    if answer.sequence == sequence:
                        return answer
                elif answer.kind == "nak":
                    # Noise may cause many of them, and the answer may still follow.
                    deadline = min(deadline, self._clock.monotonic() + NAK_S)
            left_s = deadline - self._clock.monotonic()
            if left_s <= 0 or self._link is None:
                return None
            data = self._link.read(left_s)
            if data:
                deadline = min(self._clock.monotonic() + REPLY_S, start + REPLY_MAX_S)
                self._buffer += data
                self._keep_received(data)

    def _keep_received(self, data: bytes) -> None:
        """Keep the first bytes received before an answer: they show why the answer is missing."""
        self._received += data[: max(HEARD_BYTES_MAX - len(self._received), 0)]

    def _next_line(self) -> bytes | None:
        """A complete line from the buffer; a line too long for an answer is dropped."""
        while (end := self._buffer.find(b"\n")) >= 0:
            line = bytes(self._buffer[:end])
            del self._buffer[: end + 1]
            dropped, self._dropping = self._dropping, False
            if not dropped and len(line) <= REPLY_CHARS_MAX:
                return line
        if len(self._buffer) > REPLY_CHARS_MAX:
            self._buffer.clear()
            self._dropping = True
        return None

    def _reconnect(self, cause: OSError) -> None:
        """Wait until the device is connected again; check that it is the same device and was not reset."""
        if self._link is not None:
            self._link.close()
            self._link = None
        deadline = self._clock.monotonic() + RECONNECT_S
        while self._link is None:
            try:
                self._link = self._open_link()
            except OSError:
                if self._clock.monotonic() > deadline:
                    found = f"the device is gone: {reason(cause)}"
                    raise fault("unplugged", found, "plug it in, then go on with --resume") from cause
                self._clock.sleep(POLL_S)
        self._buffer.clear()
        self._dropping = False
        if self._boot < 0:
            return
        sequence = self._sequence
        try:
            self._link.write(b"\n")
            self._link.write(request(0, "ID"))
            reply = self._wait_for_reply(0)
        except OSError:
            # Unplugged again: the caller's next attempt reconnects.
            return
        if reply is None:
            return
        self._check(reply.state)
        last_sequence = reply.extra.get("q", "")
        if not (last_sequence.isdigit() and last_sequence.isascii() and int(last_sequence) <= sequence):
            raise PositionLost(
                "foreign",
                "positioner: another program has driven the device meanwhile",
                remedy="close it, then go on with --resume: the device homes again",
            )
