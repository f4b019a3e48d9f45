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
from dataclasses import dataclass
from pathlib import Path

from experiments.common.command_line import act, parser
from experiments.common.of_tests import module_of_tests
from experiments.common.rows import append_row, commit, output, read_rows
from tvsbayes.positioner import firmware_folder
from tvsbayes.positioner.emulated_board import EMULATOR, core_sources, cross_compile

ROWS = output(__file__, "transcripts.jsonl")
LINES = 10_000
FIRST_SEED, SESSIONS = 1000, 30


@dataclass(frozen=True)
class Mutant:
    """A one-line fault.

    Attributes:
        name: what is wrong.
        file: "core" or "motion".
        old: text that stands once in the file.
        new: what stands there instead.
    """

    name: str
    file: str
    old: str
    new: str


MUTANTS = (
    Mutant("CRC of another polynomial", "core", "^ 0x1021", "^ 0x8005"),
    Mutant("CRC not checked", "core", "if (crc16(request_, body) != stated)", "if (false)"),
    Mutant("stale sequence obeyed", "core", "if (sequence <= last_sequence_)", "if (sequence < last_sequence_)"),
    Mutant("unnumbered laser off refused", "core", "if (count == 3) return", "if (count == 3) return false; return"),
    Mutant("any unnumbered order obeyed", "core", "if (!unnumbered(words, count))", "if (false)"),
    Mutant("refused requests keep the light", "core", "if (sequence != 0 && !refused_)", "if (sequence != 0)"),
    Mutant("refused repeats keep the light", "core", "if (!refused_) heard_us_", "heard_us_"),
    Mutant("light in alarm", "core", "if (on && status_ == kAlarm)", "if (false)"),
    Mutant("light unhomed", "core", "if (on && (status_ == kUnhomed || homing_))", "if (false)"),
    Mutant("longest line one less", "core", "|| size > kRequestMax)", "|| size >= kRequestMax)"),
    Mutant("number beyond 2^31 taken", "core", "negative ? 2147483648u : 2147483647u", "2147483648u"),
    Mutant("setting in motion", "core", 'if (status_ == kMoving) return "busy";\n    settings_', "settings_"),
    Mutant("setting one beyond its range", "core", "value > setting.high", "value > setting.high + 1"),
    Mutant("trigger one us longer", "core", "now_us + width_us", "now_us + width_us + 1"),
    Mutant(
        "switches of the axes swapped", "core", "switches(kPan), switches(kTilt)", "switches(kTilt), switches(kPan)"
    ),
    Mutant("soft limit of tilt open above", "motion", "|| tilt > settings_[kTmax]", ""),
    Mutant("watchdog late by 1 ms", "motion", "(settings_[kWd]) * 1000", "(settings_[kWd] + 1) * 1000"),
    Mutant(
        "overdue steps in a burst", "motion", "axis.due_us = now_us + delay_us(level)", "axis.due_us += delay_us(level)"
    ),
    Mutant("no new ramp after a stall", "motion", "stalled ? 0 : axis.level + 1", "axis.level + 1"),
    Mutant("ramp ends one step late", "motion", "level = remaining - 1;", "level = remaining;"),
    Mutant(
        "limits of the moving axis only",
        "motion",
        "if (limit_open()) return halt(",
        "if (hooks_.limit_switch(index)) return halt(",
    ),
    Mutant("limit at rest not noticed", "motion", "status_ != kIdle || !limit_open()", "true"),
    Mutant("a spike at rest is a limit", "motion", "kLimitOpenUs = 5000", "kLimitOpenUs = 0"),
    Mutant(
        "open limit for the whole homing", "motion", "(!home_limit_ || home_travel_ > kHomeOpenMax)", "!home_limit_"
    ),
    Mutant(
        "homing ends with an open limit",
        "motion",
        'hooks_.limit_switch(kPan)) return halt(kAlarm, "limit")',
        "false) return",
    ),
    Mutant("home switch read once", "motion", "kHomeReads = 4", "kHomeReads = 1"),
    Mutant("one step more beyond the switch", "motion", "kHomeClear = 20,", "kHomeClear = 21,"),
    Mutant(
        "release of a bouncing switch",
        "motion",
        "pressed ? kHomeClear : home_clear_ - 1",
        "pressed ? home_clear_ : home_clear_ - 1",
    ),
    Mutant(
        "deviation of the first homing", "motion", "homed_before_ ? axis.position - home : 0", "axis.position - home"
    ),
    Mutant(
        "laser on while homing",
        "motion",
        "motion_sequence_ = sequence;\n  set_laser(false);",
        "motion_sequence_ = sequence;",
    ),
    Mutant("laser on in alarm", "motion", "error_ = error;\n  set_laser(false);", "error_ = error;"),
    Mutant("a stopped motion counts as done", "motion", "if (stopping_) {", "if (false) {"),
)


def build(program: Path, mutant: Mutant | None) -> bool:
    """The replay for the processor, whole or with a fault; whether it compiles."""
    sources = [firmware_folder() / "native" / "replay.cpp"]
    for path in core_sources():
        text = path.read_text()
        if mutant is not None and path.stem == f"tvs_{mutant.file}":
            assert text.count(mutant.old) == 1, mutant.name
            path = program.with_name(path.name)
            path.write_text(text.replace(mutant.old, mutant.new))
        sources.append(path)
    return cross_compile(program, sources, "--specs=rdimon.specs").returncode == 0


def run(arguments: argparse.Namespace) -> None:
    """Transcripts of the core as it is, then of every fault."""
    tests = module_of_tests("support.firmware_sessions")
    ROWS.unlink(missing_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder) / "replay.elf"
        assert build(program, None)
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
        for mutant in MUTANTS:
            assert build(program, mutant), mutant.name
            session = 0
            for number, (orders, ours) in enumerate(list(sessions.values())[:SESSIONS], 1):
                if tests.replay_on_processor(program, orders) != ours:
                    session = number
                    break
            append_row(ROWS, {"mutant": mutant.name, "seen_in_session": session})
            print(mutant.name, session, flush=True)


def table(arguments: argparse.Namespace) -> None:
    """The page."""
    whole, *mutants = read_rows(ROWS)
    caught = [row for row in mutants if row["seen_in_session"]]
    print("# Transcripts on the processor\n")
    print(f"Commit {whole['commit']}, Python {platform.python_version()}, {EMULATOR}, Cortex-M7, machine mps2-an500.\n")
    print(
        f"{whole['sessions']} sessions, {whole['lines']} lines of transcript: all equal. {whole['processor_s']:.0f} s"
    )
    print(f"on the processor, {whole['s']:.0f} s with the model's, on a computer busy with other work.\n")
    print(f"Faults of the core: {len(caught)} of {len(mutants)} caught by at most {SESSIONS} of these sessions.\n")
    print("What no session shows, `tests/positioner/test_firmware_safety.py` does.\n")
    print("| fault | first line that differs in session |\n|---|---|")
    for row in mutants:
        print(f"| {row['mutant']} | {row['seen_in_session'] or 'none'} |")


def main() -> None:
    """The command line."""
    cli = parser(__doc__)
    cli.add_argument("action", choices=("run", "table"))
    act(cli, run=run, table=table)


if __name__ == "__main__":
    main()
