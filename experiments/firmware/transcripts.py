"""Does the C++ core on a Cortex-M7 do what its Python model does, and would the comparison see a bug?

    python -m experiments.firmware.transcripts run      # about 4 minutes; needs QEMU and the cross compiler
    python -m experiments.firmware.transcripts table > experiments/firmware/transcripts.md

Random sessions of `tests/support/firmware_sessions.py`: orders of every kind, damaged lines, lost steps, bounce, broken
wires, stalls. Both write down every byte they send and every change of their lines, with the microsecond. Then one-line
faults of the core: each is compiled for the processor and replays up to `SESSIONS` sessions until a line differs.
"""

from __future__ import annotations

import argparse
import platform
import tempfile
import time
from pathlib import Path

from experiments.common.command_line import act, parser
from experiments.common.of_tests import module_of_tests
from experiments.common.rows import append_row, commit, output, read_rows
from tvsbayes.positioner import firmware_folder

BOARD = module_of_tests("support.emulated_board")
ROWS = output(__file__, "transcripts.jsonl")
LINES = 10_000
FIRST_SEED, SESSIONS = 1000, 30


MUTANTS = (
    ("CRC of another polynomial", "core", "^ 0x1021", "^ 0x8005"),
    ("CRC not checked", "core", "if (crc16(request_, body) != stated)", "if (false)"),
    ("stale sequence obeyed", "core", "if (sequence <= last_sequence_)", "if (sequence < last_sequence_)"),
    ("unnumbered laser off refused", "core", "if (count == 3) return", "if (count == 3) return false; return"),
    ("any unnumbered order obeyed", "core", "if (!unnumbered(words, count))", "if (false)"),
    ("refused requests keep the light", "core", "if (sequence != 0 && !refused_)", "if (sequence != 0)"),
    ("refused repeats keep the light", "core", "if (!refused_) heard_us_", "heard_us_"),
    ("light in alarm", "core", "if (on && status_ == kAlarm)", "if (false)"),
    ("light unhomed", "core", "if (on && (status_ == kUnhomed || homing_))", "if (false)"),
    ("longest line one less", "core", "|| size > kRequestMax)", "|| size >= kRequestMax)"),
    ("number beyond 2^31 taken", "core", "negative ? 2147483648u : 2147483647u", "2147483648u"),
    ("setting in motion", "core", 'if (status_ == kMoving) return "busy";\n    settings_', "settings_"),
    ("setting one beyond its range", "core", "value > setting.high", "value > setting.high + 1"),
    ("trigger one us longer", "core", "now_us + width_us", "now_us + width_us + 1"),
    ("switches of the axes swapped", "core", "switches(kPan), switches(kTilt)", "switches(kTilt), switches(kPan)"),
    ("soft limit of tilt open above", "motion", "|| tilt > settings_[kTmax]", ""),
    ("watchdog late by 1 ms", "motion", "(settings_[kWd]) * 1000", "(settings_[kWd] + 1) * 1000"),
    ("overdue steps in a burst", "motion", "axis.due_us = now_us + delay_us(level)", "axis.due_us += delay_us(level)"),
    ("no new ramp after a stall", "motion", "stalled ? 0 : axis.level + 1", "axis.level + 1"),
    ("ramp ends one step late", "motion", "level = remaining - 1;", "level = remaining;"),
    ("limits of the moving axis only", "motion",
     "if (limit_open()) return halt(", "if (hooks_.limit_switch(index)) return halt("),
    ("limit at rest not noticed", "motion", "status_ != kIdle || !limit_open()", "true"),
    ("a spike at rest is a limit", "motion", "kLimitOpenUs = 5000", "kLimitOpenUs = 0"),
    ("open limit for the whole homing", "motion", "(!home_limit_ || home_travel_ > kHomeOpenMax)", "!home_limit_"),
    ("homing ends with an open limit", "motion",
     'hooks_.limit_switch(kPan)) return halt(kAlarm, "limit")', "false) return"),
    ("home switch read once", "motion", "kHomeReads = 4", "kHomeReads = 1"),
    ("one step more beyond the switch", "motion", "kHomeClear = 20,", "kHomeClear = 21,"),
    ("release of a bouncing switch", "motion",
     "pressed ? kHomeClear : home_clear_ - 1", "pressed ? home_clear_ : home_clear_ - 1"),
    ("deviation of the first homing", "motion", "homed_before_ ? axis.position - home : 0", "axis.position - home"),
    ("laser on while homing", "motion",
     "motion_sequence_ = sequence;\n  set_laser(false);", "motion_sequence_ = sequence;"),
    ("laser on in alarm", "motion", "error_ = error;\n  set_laser(false);", "error_ = error;"),
    ("a stopped motion counts as done", "motion", "if (stopping_) {", "if (false) {"),
)  # fmt: skip
"""One-line faults: what is wrong, file "core" or "motion", text that stands once in it, what stands there instead."""


def build(program: Path, file: str = "", old: str = "", new: str = "") -> bool:
    """The replay for the processor, whole or with a fault; whether it compiles."""
    sources = [firmware_folder() / "native" / "replay.cpp"]
    for path in BOARD.core_sources():
        text = path.read_text()
        if path.stem == f"tvs_{file}":
            assert text.count(old) == 1, old
            path = program.with_name(path.name)
            path.write_text(text.replace(old, new))
        sources.append(path)
    return BOARD.cross_compile(program, sources, "--specs=rdimon.specs").returncode == 0


def run(arguments: argparse.Namespace) -> None:
    """Transcripts of the core as it is, then of every fault."""
    tests = module_of_tests("support.firmware_sessions")
    ROWS.unlink(missing_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder) / "replay.elf"
        assert build(program)
        lines, sessions, start, theirs_s = 0, {}, time.monotonic(), 0.0
        for seed in range(FIRST_SEED, FIRST_SEED + 1000):
            orders = tests.random_orders(seed)
            ours, before = tests.Bench().run(orders), time.monotonic()
            theirs = tests.replay_on_processor(program, orders)
            theirs_s += time.monotonic() - before
            assert theirs == ours, f"seed {seed}"
            lines, sessions[seed] = lines + len(ours), (orders, ours)
            if lines >= LINES:
                break
        whole = {"sessions": len(sessions), "lines": lines, "processor_s": theirs_s, "s": time.monotonic() - start}
        append_row(ROWS, {"commit": commit(), **whole})
        print(whole, flush=True)
        for name, *fault in MUTANTS:
            assert build(program, *fault), name
            numbered = enumerate(list(sessions.values())[:SESSIONS], 1)
            seen = (k for k, (orders, ours) in numbered if tests.replay_on_processor(program, orders) != ours)
            append_row(ROWS, {"mutant": name, "seen_in_session": (session := next(seen, 0))})
            print(name, session, flush=True)


def table(arguments: argparse.Namespace) -> None:
    whole, *mutants = read_rows(ROWS)
    caught = [row for row in mutants if row["seen_in_session"]]
    print("# Transcripts on the processor\n")
    machine = f"{BOARD.EMULATOR}, Cortex-M7, machine mps2-an500"
    print(f"Commit {whole['commit']}, Python {platform.python_version()}, {machine}.\n")
    print(f"{whole['sessions']} sessions, {whole['lines']} lines of transcript: all equal.", end=" ")
    print(f"{whole['processor_s']:.0f} s")
    print(f"on the processor, {whole['s']:.0f} s with the model's, on a computer busy with other work.\n")
    print(f"Faults of the core: {len(caught)} of {len(mutants)} caught by at most {SESSIONS} of these sessions.\n")
    print("What no session shows, `tests/positioner/test_firmware_safety.py` does.\n")
    print("| fault | first line that differs in session |\n|---|---|")
    for row in mutants:
        print(f"| {row['mutant']} | {row['seen_in_session'] or 'none'} |")


if __name__ == "__main__":
    act(parser(__doc__, run=run, table=table))
