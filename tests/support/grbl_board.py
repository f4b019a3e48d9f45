"""A GRBL 1.1 board in software, written from its documented protocol, on a virtual clock.

It answers line by line; `?`, `!` and Ctrl-X are taken out of the stream at once. Motions take as long as their rate
says.
"""

from __future__ import annotations

import re

from tvsbayes.acquisition.simulated_instrument import VirtualClock

GREETING = "\r\nGrbl 1.1h ['$' for help]\r\n"
SETTINGS = {
    **{1: 255, 10: 1, 13: 0, 20: 0, 21: 1, 22: 1, 27: 1.0, 30: 1000, 32: 0},
    **{100: 80.0, 101: 80.0, 110: 6000.0, 111: 6000.0, 120: 100.0, 121: 100.0},
}
_WORD = re.compile(r"([A-Z])(-?[0-9.]+)")


class GrblBoard:
    """Board, motors and laser.

    Attributes:
        settings: `$n`.
        steps: where the motors stand.
        laser_on: whether spindle or coolant is on.
        lit_in_motion: whether it was while the motors ran.
        orders: lines received.
        home_fails: whether the switch is out of reach.
        blocked: whether the motors go on for ever without arriving.
        limit_steps: pan beyond which a limit switch trips.
        silent: whether it no longer answers.
        missing_steps: by how much motions of pan end too early.
    """

    def __init__(self, settings=None):
        self.clock = VirtualClock()
        self.settings = {**SETTINGS, **(settings or {})}
        self.steps, self.laser_on, self.lit_in_motion = [400, 250], False, False
        self.orders: list[str] = []
        self.home_fails = self.blocked = self.silent = False
        self.limit_steps, self.missing_steps = 10**9, 0
        self.out = bytearray()
        self._line, self._waiting = bytearray(), []
        self.state, self.modes, self._motion, self._dwell_until = "Idle", {"G0", "G90", "G21", "M5", "M9"}, None, 0.0
        self.power_on()

    def power_on(self, state: str | None = None) -> None:
        """A start; locked until homed, as with $22=1."""
        self._reset()
        self.state = state or ("Alarm" if int(self.settings[22]) & 1 else "Idle")
        if self.state == "Alarm":
            self._say("[MSG:'$H'|'$X' to unlock]")

    def _reset(self) -> None:
        if self._motion is not None:
            self._finish(self.clock.monotonic())
            self._say("ALARM:3")
            self.state, self._motion = "Alarm", None
        self._line.clear()
        self._waiting.clear()
        self._set_laser(False)
        self.modes, self._dwell_until = {"G0", "G90", "G21", "M5", "M9"}, 0.0
        self.out += GREETING.encode()

    def _say(self, line: str) -> None:
        if not self.silent:
            self.out += line.encode() + b"\r\n"

    def _set_laser(self, on: bool) -> None:
        self.laser_on = on

    def receive(self, data: bytes) -> None:
        for byte in data:
            char = bytes([byte])
            if char == b"?":
                self.advance()
                self._say(self._report())
            elif char == b"\x18":
                if not self.silent:
                    self._reset()
            elif char == b"!":
                self.state = "Hold" if self._motion is not None else self.state
            elif char == b"\n":
                self._waiting.append(self._line.decode().strip())
                self._line.clear()
            else:
                self._line += char
        self.advance()

    def _report(self) -> str:
        x, y = (n / self.settings[100 + i] for i, n in enumerate(self.steps))
        pins = "|Pn:X" if self.steps[0] <= 0 else ""
        return f"<{self.state}|MPos:{x:.3f},{y:.3f},0.000|FS:0,0{pins}>"

    def next_event_s(self) -> float:
        """When something happens by itself."""
        if self._motion is not None:
            return self._motion[3]
        return self._dwell_until or 1e12

    def advance(self) -> None:
        """Everything that is due."""
        now = self.clock.monotonic()
        if self._motion is not None:
            self._finish(now)
        while self._waiting and self._motion is None and now >= self._dwell_until:
            line = self._waiting[0]
            if self._dwell_until:
                self._dwell_until = 0.0
            elif line.startswith("G4"):
                self._dwell_until = now + max(float(_WORD.findall(line)[1][1]), 1e-3)
                return
            self._waiting.pop(0)
            self.orders.append(line)
            if not line.startswith("G4"):
                self._execute(line, now)
            else:
                self._say("ok")

    def _finish(self, now: float) -> None:
        start, end, began, due, _ = self._motion
        share = min((now - began) / (due - began), 1.0)
        self.steps = [round(a + share * (b - a)) for a, b in zip(start, end, strict=True)]
        self.lit_in_motion |= self.laser_on
        if abs(self.steps[0]) > self.limit_steps:
            self._motion, self.state = None, "Alarm"
            self._waiting.clear()
            self._set_laser(False)
            self._say("ALARM:1")
        elif share == 1.0 and not self.blocked:
            homing = self._motion[4]
            self._motion, self.state = None, "Idle"
            if homing:
                self._say("ok")

    def _execute(self, line: str, now: float) -> None:
        if line == "$H":
            self._home(now)
        elif line == "$G":
            self._say("[GC:" + " ".join(sorted(self.modes)) + " T0 F0 S0]")
            self._say("ok")
        elif line == "$$":
            for number, value in self.settings.items():
                self._say(f"${number}={value:.3f}" if isinstance(value, float) else f"${number}={value}")
            self._say("ok")
        elif self.state == "Alarm":
            self._say("error:9")
        elif line.startswith("M"):
            self._accessory(line.split()[0])
            self._say("ok")
        elif line.startswith("G53"):
            words = dict(_WORD.findall(line.removeprefix("G53 ")))
            if words["G"] == "1" and float(words.get("F", 0)) <= 0:
                self._say("error:22")
                return
            self._move([float(words["X"]), float(words["Y"])], float(words.get("F", 0)), now)
            self._say("ok")
        elif line.startswith("G21"):
            self._say("ok")
        else:
            self._say("error:20")

    def _accessory(self, order: str) -> None:
        if order in ("M3", "M4", "M5"):
            self.modes = (self.modes - {"M3", "M4", "M5"}) | {order}
        else:
            self.modes = (self.modes - {"M7", "M8", "M9"}) | {order}
        self._set_laser(bool({"M3", "M4", "M7", "M8"} & self.modes))

    def _move(self, position_mm: list[float], feed: float, now: float) -> None:
        k = [self.settings[100], self.settings[101]]
        end = [round(p * n) for p, n in zip(position_mm, k, strict=True)]
        end[0] -= self.missing_steps
        steps = [abs(b - a) for a, b in zip(self.steps, end, strict=True)]
        seconds = max(n / (self.settings[110 + i] * k[i] / 60) for i, n in enumerate(steps))
        if feed:
            seconds = max(seconds, 60 * sum((n / q) ** 2 for n, q in zip(steps, k, strict=True)) ** 0.5 / feed)
        if max(steps):
            self._motion, self.state = (list(self.steps), end, now, now + seconds, False), "Run"

    def _home(self, now: float) -> None:
        if not int(self.settings[22]) & 1:
            self._say("error:5")
        elif self.home_fails:
            self.state = "Alarm"
            self._say("ALARM:9")
        else:
            pull_off = [round(-self.settings[27] * self.settings[100 + i]) for i in (0, 1)]
            self._motion, self.state = (list(self.steps), pull_off, now, now + 8.0, True), "Home"


class BoardLink:
    """A `Link` to the board on its clock."""

    def __init__(self, board: GrblBoard):
        self.board, self.closed, self.gone = board, False, False

    def write(self, data: bytes) -> None:
        if self.gone:
            raise OSError(5, "Input/output error")
        self.board.clock.sleep(0.0005)
        self.board.receive(data)

    def read(self, timeout_s: float) -> bytes:
        board = self.board
        if self.gone:
            raise OSError(5, "Input/output error")
        deadline = board.clock.monotonic() + timeout_s
        board.advance()
        while not board.out and board.clock.monotonic() < deadline:
            ahead = min(board.next_event_s(), deadline) - board.clock.monotonic()
            board.clock.sleep(max(ahead, 1e-6) if ahead > 0 else deadline - board.clock.monotonic())
            board.advance()
        data = bytes(board.out)
        board.out.clear()
        return data

    def close(self) -> None:
        self.closed = True
