"""The ten defects that a trial from outside had found in acquisition and firmware: is each seen by a test?

    python -m experiments.robustness.defects_seen_red run      # rows of planted_faults; what is there is not run again
    python -m experiments.robustness.defects_seen_red table > experiments/robustness/defects_seen_red.md

Each defect is planted again in a copy of today's tree (`experiments/robustness/faults`), and a test of the default
suite has to fail, which passes without it. The sketch has no processor there; the lack of its watchdog also meets the
slow test on the emulated board.
"""

from __future__ import annotations

import argparse
import re
import tempfile
from dataclasses import dataclass
from pathlib import Path

from experiments.common.command_line import parser
from experiments.common.rows import append_row, commit, output, read_rows
from experiments.robustness import planted_faults
from experiments.robustness.faults.listing import FAULTS
from experiments.robustness.faults.trial import planted, tested, unpack

ON_BOARD = output(__file__, "defects_seen_red.jsonl")
BOARD_TEST = "tests/positioner/test_emulated_board.py::test_sketch_homes_moves_and_goes_dark_after_every_fault"
BOARD_FAULTS = ("sketch: no watchdog of the processor",)


TEXT = """# Ten defects seen red

Written by `python -m experiments.robustness.defects_seen_red`. A trial of acquisition and firmware from outside had
found ten defects in 0.1.0. Each is planted again in today's tree; the first test that fails is named, and passes
without the fault. The faults stand in `experiments/robustness/faults` and are planted again with all the others.
"""
BY_DESIGN = """
Before this page the tests meant for five of them stayed green and were mended: burst and bounce in the core (random
sessions on the emulated processor alone saw them), the start of the sketch's watchdog (the slow test on the board saw
it), its fault vectors and the time of the direction (no default test did).

Of the smaller things two are as they were, by design: the laser may be on in motion, and a host that dies stops the
light, not a motion that has begun."""


@dataclass(frozen=True)
class Defect:
    """What was found, and the faults that plant it again."""

    what: str
    faults: tuple[str, ...]


DEFECTS = (
    Defect(
        "`--resume` refuses the rig file once the port or a camera has another name, and does not name the entry",
        ("resume: another port is another rig", "resume: the entry that changed is not named"),
    ),
    Defect(
        "the laser stays on after a fault of the processor",
        ("sketch: no watchdog of the processor", "sketch: a fault of the processor keeps the pin as it stood"),
    ),
    Defect(
        "an open limit circuit is ignored while homing",
        (
            "core: homing goes on behind an open limit",
            "core: homing ends behind an open limit",
            "device: homing goes on behind an open limit",
        ),
    ),
    Defect(
        "network cameras do not survive pauses",
        ("network camera: only read when somebody asks", "network camera: a dropped stream is not opened again"),
    ),
    Defect(
        "steps after a stall come out in one burst",
        ("core: overdue steps made up in a burst", "device: overdue steps made up in a burst"),
    ),
    Defect(
        '"no answer" for six different causes',
        ("driver: no answer, whatever was heard", "driver: a used-up sequence has no name"),
    ),
    Defect(
        '`check` calls a lost end of the journal "behind"', ("journal: a lost end taken for tables that are behind",)
    ),
    Defect(
        "orders that make safe need a fresh sequence number; any frame feeds the laser's watchdog",
        (
            "core: light off, stop and abort need a number",
            "core: light kept on by refused and unnumbered requests",
            "device: light kept on by refused requests",
            "driver: no laser-off to a device that was not identified",
        ),
    ),
    Defect("the direction is set 1 us before the step", ("sketch: the direction stands no time before the step",)),
    Defect(
        "smaller: files of killed runs; remedy of an empty journal; bounce of the home switch; `l=1` after the guard; "
        "a limit opening at rest; settings of the board in no file",
        (
            "resume: unfinished files of killed runs stay",
            "check: an empty journal is to be resumed",
            "core: one reading makes a home switch",
            "device: one reading makes a home switch",
            "core: replies say light after the guard has darkened it",
            "core: a limit that opens at rest is not seen",
            "rig file: counters at home, ramp and watchdog stay the board's",
        ),
    ),
)


def run(arguments: argparse.Namespace) -> None:
    """Plant every fault and run its tests; those of the sketch on the emulated board too."""
    names = [name for defect in DEFECTS for name in defect.faults]
    arguments.only, arguments.again, arguments.processes = "|".join(map(re.escape, names)), False, 1
    planted_faults.run(arguments)
    done = {row["name"] for row in read_rows(ON_BOARD)}
    with tempfile.TemporaryDirectory(prefix="tvsbayes-defects-") as scratch:
        root = Path(scratch) / "tree"
        unpack(commit(), root)
        for fault in FAULTS:
            if fault.name in BOARD_FAULTS and fault.name not in done:
                with planted(root, fault):
                    failed = tested(root, ("-m", "slow", BOARD_TEST)).failed
                passes = tested(root, ("-m", "slow", BOARD_TEST)).failed is False
                append_row(ON_BOARD, {"name": fault.name, "failed": failed, "passes": passes, "commit": commit()})


def table(arguments: argparse.Namespace) -> None:
    """The page."""
    rows, board = planted_faults.State().rows(arguments.rows), {row["name"]: row for row in read_rows(ON_BOARD)}
    places = {fault.name: fault.path.removeprefix("tvsbayes/") for fault in FAULTS}
    every = [name for defect in DEFECTS for name in defect.faults]
    red = sum(bool(rows.get(name, {}).get("failed")) for name in every)
    print(TEXT)
    print(f"**{red} of {len(every)} red**{', all ten defects' * (red == len(every))}.\n")
    print("| | defect | planted again | in | red |\n|---|---|---|---|---|")
    for number, defect in enumerate(DEFECTS, 1):
        for place, name in enumerate(defect.faults):
            row = rows.get(name)
            seen = (
                "not run"
                if row is None
                else f"`{row['first'].removeprefix('tests/')}`"
                if row["failed"]
                else "**GREEN**"
            )
            if (on_board := board.get(name)) and on_board["failed"] and on_board["passes"]:
                seen += f"; slow: `{BOARD_TEST.removeprefix('tests/')}`"
            first = (str(number), defect.what) if place == 0 else ("", "")
            print(f"| {' | '.join((*first, name.partition(': ')[2], f'`{places[name]}`', seen))} |")
    print(BY_DESIGN)


def main() -> None:
    """The command."""
    made = parser(__doc__)
    made.add_argument("--rows", type=Path, default=planted_faults.ROWS)
    commands = made.add_subparsers(required=True)
    for command in (run, table):
        commands.add_parser(command.__name__, help=command.__doc__).set_defaults(command=command)
    arguments = made.parse_args()
    arguments.command(arguments)


if __name__ == "__main__":
    main()
