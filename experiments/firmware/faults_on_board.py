"""What does `acquire` say, and what does the laser do, when firmware or bench fail in the middle of a run?

    python -m experiments.firmware.faults_on_board run      # about 40 s a fault; needs QEMU and the cross compiler
    python -m experiments.firmware.faults_on_board table > experiments/firmware/faults_on_board.md

The unchanged sketch runs on QEMU's Cortex-M7, the driver reaches it over a pseudo-terminal, the engine runs a plan of
twelve looks with two homings between them. A fault comes at the fifth look, with the laser on, or in the motion after
it. The laser pin is read from outside the processor; a look is counted wrongly when it counts though the motors stood
elsewhere than at the counters.
"""

from __future__ import annotations

import argparse
import platform
import shutil
import threading
import time
from pathlib import Path
from typing import NamedTuple

from experiments.common.command_line import act, parser
from experiments.common.of_tests import module_of_tests
from experiments.common.page import heading
from experiments.common.rigs import mounted_rig, numbered
from experiments.common.rows import append_row, commit, output, read_rows
from tvsbayes.acquisition.bench import Bench
from tvsbayes.acquisition.engine import Acquisition
from tvsbayes.acquisition.journal import read_journal
from tvsbayes.acquisition.operator import StopKey
from tvsbayes.acquisition.recorder import recorded
from tvsbayes.acquisition.session import begin
from tvsbayes.acquisition.simulated_bench import SIMULATED_START, SimulatedOperator, TwinObserver
from tvsbayes.acquisition.simulated_instrument import Instrument
from tvsbayes.errors import DeviceFault
from tvsbayes.instrument.plan import PlanStep

BOARD = module_of_tests("support.emulated_board")
ROWS, SCRATCH = output(__file__, "faults-on-board.jsonl"), output(__file__, "faults-scratch")
AT_LOOK = 5
SEED = 7
DARK_S = 6.0
"""Longest wait for the pin to go low; the promise is 2 s."""
IN_MOTION_S = 0.15


class Fault(NamedTuple):
    """What fails, by an order in the words of `firmware/emulated/board.cpp`: laser on, or in the next motion."""

    name: str
    order: str
    lit: bool
    expected: str
    """How `acquire` must end."""


FAULTS = (
    Fault("none", "", False, "done"),
    Fault("main loop hangs 0.5 s, laser on", "s 500", True, "done"),
    Fault("main loop hangs 3 s, laser on", "s 3000", True, "reset"),
    Fault("main loop hangs for ever, laser on", "g", True, "reset"),
    Fault("processor faults, laser on", "f", True, "reset"),
    Fault("reset, laser on", "r", True, "reset"),
    Fault("limit circuit opens, laser on", "c 0 1", True, "alarm-limit"),
    Fault("main loop hangs 0.5 s in a motion", "s 500", False, "done"),
    Fault("processor faults in a motion", "f", False, "reset"),
    Fault("reset in a motion", "r", False, "reset"),
    Fault("limit circuit opens in a motion", "c 1 1", False, "alarm-limit"),
    Fault("motor misses 7 steps", "k 0 7", False, "done"),
    Fault("home switch dies before a homing", "e 0 1", False, "alarm-home"),
)


class Observer:
    """The twin's looks, with a fault at one of them, and where the motors stood at each."""

    def __init__(self, instrument: Instrument, sd_px: float, fault: Fault):
        self.instrument, self.fault, self.twin = instrument, fault, TwinObserver(instrument, sd_px)
        # Whether counters and motors agreed, look by look; time from the fault until the pin was low.
        self.true: list[bool] = []
        self.dark_s: float | None = None
        self.timer: threading.Timer | None = None

    def observe(self, positioner, spot):
        """See `observation.Observer`."""
        board, number = self.instrument.board, len(self.true) + 1
        state = positioner.state()
        self.true.append(list(self.instrument.mechanics.true_steps) == [state.pan_steps, state.tilt_steps])
        if number == AT_LOOK and self.fault.lit:
            positioner.laser(True)
            board.order(self.fault.order)
            start = time.monotonic()
            while board.laser_pin() and time.monotonic() - start < DARK_S:
                time.sleep(0.002)
            self.dark_s = time.monotonic() - start
        observation = self.twin.observe(positioner, spot)
        if number == AT_LOOK and self.fault.order and not self.fault.lit:
            self.timer = threading.Timer(IN_MOTION_S, board.order, [self.fault.order])
            self.timer.start()
        return observation


def plan() -> tuple[PlanStep, ...]:
    """Twelve looks at one sheet, moves of both axes, homed again before the eighth and the eleventh."""
    orders: list[tuple] = [("home", 0, 0), ("move", 40, 0), ("move", 0, 0), ("place", None, None, "d1")]
    for number in range(12):
        orders += [("home", 0, 0)] * (number in (7, 10))
        orders.append(("move", 60 if number % 2 else -60, 20 * (number % 3)))
        orders.append(("look", None, None, "", number // 4, number % 4 + 1))
    return numbered(orders)


def run_one(fault: Fault, folder: Path) -> dict:
    """A run with a fault, and what became of it."""
    rig, steps = mounted_rig(), plan()
    header = {"name": "faults", "created": SIMULATED_START.isoformat(), "synthetic": True, "seed": SEED}
    with BOARD.EmulatedBoard() as board:
        instrument = module_of_tests("support.emulated_instrument").EmulatedInstrument(rig, SEED, 0, board)
        positioner = instrument.positioner()
        observer = Observer(instrument, rig.spot_sd_px, fault)
        operator, journal = SimulatedOperator(instrument), begin(folder, rig, steps, False, header)
        bench = Bench(positioner, observer, operator, instrument.clock, lambda: SIMULATED_START)
        reason, message = "", ""
        try:
            reason = Acquisition(rig, steps, journal, bench, stop=StopKey()).run().reason
        except DeviceFault as error:
            reason, message = error.code, str(error)
        finally:
            positioner.close()
            journal.close()
        if observer.timer is not None:
            observer.timer.join()
        pin = board.laser_pin()
    spots = recorded(read_journal(folder).records).spots
    wrong = sum(spot.status == "ok" and not true for spot, true in zip(spots, observer.true, strict=False))
    statuses = [spot.status for spot in spots]
    counts = {status: statuses.count(status) for status in dict.fromkeys(statuses)}
    row = {"said": reason, "message": message, "dark_s": observer.dark_s}
    return row | {"pin_at_end": pin, "wrong": wrong, "looks": counts}


def run(arguments: argparse.Namespace) -> None:
    """Every fault once."""
    ROWS.unlink(missing_ok=True)
    shutil.rmtree(SCRATCH, ignore_errors=True)
    for number, fault in enumerate(FAULTS):
        SCRATCH.mkdir(parents=True, exist_ok=True)
        row = {"fault": fault.name, "expected": fault.expected, "commit": commit()}
        row |= run_one(fault, SCRATCH / str(number))
        append_row(ROWS, row)
        print({key: row[key] for key in ("fault", "said", "dark_s", "pin_at_end", "wrong", "looks")}, flush=True)


def table(arguments: argparse.Namespace) -> None:
    rows = read_rows(ROWS)
    good = [row for row in rows if row["said"] == row["expected"] and not row["pin_at_end"] and not row["wrong"]]
    print("# Faults of firmware and bench in the middle of a run\n")
    print(f"Commit {rows[0]['commit']}, Python {platform.python_version()}, {BOARD.EMULATOR}, machine mps2-an500.\n")
    print(f"{len(good)} of {len(rows)} runs end as they must, dark, with no look counted wrongly.", end=" ")
    print("The laser pin is read\nfrom outside the processor.", end=" ")
    print("Seconds are those of a busy computer: the board falls behind and catches up.\n")
    print(heading("fault | `acquire` said | pin low after | pin at the end | looks | counted wrongly"))
    for row in rows:
        dark = "-" if row["dark_s"] is None else f"{row['dark_s']:.2f} s"
        looks = ", ".join(f"{count} {status}" for status, count in row["looks"].items())
        pin = "high" if row["pin_at_end"] else "low"
        print(f"| {row['fault']} | {row['said']} | {dark} | {pin} | {looks} | {row['wrong']} |")


if __name__ == "__main__":
    act(parser(__doc__, run=run, table=table))
