"""Sessions with the firmware: a bench for its Python model, scripts for the C++ core, random ones for both."""

from __future__ import annotations

import random
import subprocess
from pathlib import Path

from support.emulated_board import BOARD, core_sources, cross_compile, missing_tools

from tvsbayes.positioner import firmware_folder
from tvsbayes.positioner.firmware_model import DeviceModel, Mechanics
from tvsbayes.positioner.protocol import SETTINGS, Reply, frame, parse_answer, request

FIRMWARE = firmware_folder()
BOOT = 4_000_000_001
LINES = {"laser_on": "l", "trigger_on": "t"}
"""Lines of the board by attribute of `Mechanics`, as replay.cpp names them."""


class Bench:
    """A device model with a time of its own; keeps the transcript in the form of firmware/native/replay.cpp."""

    def __init__(self, home=(-60, -40), limit=900, boot=BOOT):
        self.now_us, self.transcript, self.sent = 0, [], []
        bench = self

        class Board(Mechanics):
            def __setattr__(self, name, value):
                super().__setattr__(name, value)
                if name in LINES and hasattr(bench, "device_started"):
                    bench.transcript.append(f"{LINES[name]} {bench.now_us} {int(value)}")

        self.board = Board(home_steps=home, limit_steps=limit)
        self.device_started = True
        self.device = DeviceModel(self.board, boot, 0, self._write)

    def _write(self, line: bytes) -> None:
        self.transcript.append(f"w {self.now_us} {line.hex()}")
        self.sent.append(line)

    def run(self, orders: list[str]) -> list[str]:
        """Follows a script of replay.cpp; the transcript."""
        for order in orders:
            kind, _, rest = order.partition(" ")
            if kind == "a":
                self.advance(int(rest))
            elif kind == "j":
                self.now_us = int(rest)
                self.device.loop(self.now_us)
            elif kind == "d":
                self.device.darkened()
            elif kind == "x":
                self.device.receive(bytes.fromhex(rest), self.now_us)
            elif kind == "q":
                pan, tilt = self.board.true_steps
                self.transcript.append(f"q {pan} {tilt} {int(self.board.laser_on)}")
            else:
                axis, number = map(int, rest.split())
                self._disturb(kind, axis, number)
        return self.transcript

    def _disturb(self, kind: str, axis: int, number: int) -> None:
        if kind == "k":
            self.board.missing_steps[axis] += number
        elif kind == "b":
            self.board.wrong_reads[axis] += number
        elif kind == "c":
            self.board.limit_cut[axis] = bool(number)
        else:
            self.board.home_dead[axis] = bool(number)

    def advance(self, now_us: int) -> None:
        """As `DeviceModel.advance`, the clock at every moment where something happens."""
        while (due_us := self.device.next_us()) <= now_us:
            self.now_us = due_us
            self.device.loop(due_us)
        self.now_us = now_us
        self.device.loop(now_us)

    def ask(self, sequence: int, *words: object) -> Reply:
        """One request now, and its reply."""
        self.device.receive(request(sequence, *words), self.now_us)
        answer = parse_answer(self.sent[-1][:-1])
        assert isinstance(answer, Reply)
        return answer

    def pass_time(self, seconds: float) -> None:
        self.advance(self.now_us + round(seconds * 1e6))

    def homed(self) -> Bench:
        self.ask(1, "SET", "hp", -60)
        self.ask(2, "SET", "ht", -40)
        self.ask(3, "HOME")
        self.pass_time(20)
        assert self.ask(4, "?").state.status == "idle"
        return self


def random_orders(seed: int) -> list[str]:
    """A session with damage: commands of every kind, flips, losses, doubles, merges, noise, pauses, lost steps."""
    rng = random.Random(seed)
    now_us, sequence, orders = 0, 0, []
    sent = b""
    words = [f"SET hp {-60}", f"SET ht {-40}", "HOME"]
    for turn in range(140):
        if turn >= 3:
            words = [
                rng.choice(
                    [
                        f"MA {rng.randint(-300, 1100)} {rng.randint(-300, 520)}",
                        f"MA {rng.randint(-40, 40)} {rng.randint(-30, 30)}",
                        f"TRIG {rng.choice([9, 10, 5000, 10**6, 10**6 + 1, -1])}",
                        *("HOME", "HOME", "HOME", "?", "L 1", "L 0", "STOP", "ABORT", "ID", "L 2"),
                        *("MA 1", "MA +1 01", "MA -0 0"),
                        f"SET {rng.choice([*SETTINGS, 'xx'])} {rng.choice([-(10**9), -300, 10, 150, 900, 2**31])}",
                        *(f"SET {name} {SETTINGS[name][1] + 1}" for name in rng.sample(sorted(SETTINGS), 2)),
                        f"MA {rng.choice([2**31 - 1, 2**31])} {rng.choice([0, -(2**31)])}",
                        f"GET {rng.choice([*SETTINGS, 'xx'])}",
                        *("MA 1 2 3", "", "ID 1", "MA  1 2", "?" + "x" * rng.randint(0, 120)),
                    ]
                )
            ]
        for word in words[:1]:
            if turn < 3 or rng.random() < 0.9:
                sequence += 1
            number = sequence if rng.random() < 0.95 or turn < 3 else rng.choice([0, max(sequence - 1, 0), "x", "01"])
            line = frame(f">{number} {word}")
            if turn >= 3:
                kind = rng.random()
                place = rng.randrange(len(line))
                if kind < 0.08:
                    line = line[:place] + bytes([line[place] ^ (1 << rng.randrange(8))]) + line[place + 1 :]
                elif kind < 0.14:
                    line = line[:place] + line[place + 1 :]
                elif kind < 0.2:
                    line = line[:place] + line[place : place + 1] + line[place:]
                elif kind < 0.25:
                    line += line
                elif kind < 0.3:
                    line = sent + line
                elif kind < 0.34:
                    line = rng.randbytes(rng.randint(1, 300)) + b"\n" + line
                elif kind < 0.38:
                    line = line[:-1] + b"\r\n"
            sent = line
            orders.append(f"x {line.hex()}")
        words = words[1:]
        if turn >= 3:
            orders += _disturbances(rng)
        now_us += rng.choice([0, 137, 20_000, 150_000, 900_000, 2_500_000, 14_000_000])
        orders += [f"{'j' if rng.random() < 0.1 and turn >= 3 else 'a'} {now_us}", "q"]
    return orders


def _disturbances(rng: random.Random) -> list[str]:
    """What may happen to a bench: lost steps, bounce, wires cut and mended, a guard that darkens."""
    axis, kind = rng.randrange(2), rng.random()
    if kind < 0.05:
        return [f"k {axis} {rng.randint(1, 9)}"]
    if kind < 0.1:
        return [f"b {axis} {rng.choice([1, 2, 5, 30])}"]
    if kind < 0.16:
        return [f"c {axis} {int(kind < 0.105)}"]
    if kind < 0.22:
        return [f"e {axis} {int(kind < 0.165)}"]
    return ["d"] if kind < 0.25 else []


def build(folder: Path, *options: str) -> Path | None:
    """The native core, or None where the compiler refuses the options."""
    program = folder / "replay"
    sources = [FIRMWARE / "native" / "replay.cpp", *core_sources()]
    command = ["g++", "-std=c++11", "-Wall", "-Wextra", "-Werror", *options, f"-I{FIRMWARE / 'tvs_positioner'}"]
    result = subprocess.run([*command, *map(str, sources), "-o", str(program)], capture_output=True, check=False)
    return program if result.returncode == 0 else None


def replay(program: Path, orders: list[str], *, boot=BOOT, home=(-60, -40), limit=900) -> list[str]:
    arguments = [str(program), str(boot), *map(str, home), str(limit)]
    script = "\n".join(orders) + "\n"
    result = subprocess.run(arguments, input=script, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    return result.stdout.splitlines()


NO_EMULATOR = f"not installed: {', '.join(missing_tools())}" if missing_tools() else ""
"""Why tests on the emulated processor are skipped; empty where they are not."""


def build_replay(program: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """replay.cpp for the emulated processor; input and output go through newlib's semihosting."""
    sources = [FIRMWARE / "native" / "replay.cpp", *core_sources()]
    return cross_compile(program, sources, "--specs=rdimon.specs", *options)


def replay_on_processor(program: Path, orders: list[str], *, boot=BOOT, home=(-60, -40), limit=900) -> list[str]:
    """As `replay`, on the emulated Cortex-M7."""
    words = ",".join(f"arg={word}" for word in ("replay", boot, *home, limit))
    hosted = ("-serial", "none", "-semihosting-config", f"enable=on,target=native,{words}")
    script = "\n".join(orders) + "\n"
    command = [*BOARD, *hosted, "-kernel", str(program)]
    result = subprocess.run(command, input=script, capture_output=True, text=True, check=False, timeout=120)
    assert result.returncode == 0, result.stderr
    return result.stdout.splitlines()
