"""From a log to a table to a verified machine: the page of the documentation, with what the commands print.

    python -m experiments.compensation.ten_minutes > data/docs/compensation.md

A stage is drawn (play 0.3 mm, errors by position of 0.05 mm, on 40 mm), read three times to and fro into `log.csv`, and
driven with the table into `fresh.csv`, and once with its sign turned into `turned.csv`: what a controller would do.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import numpy as np

from experiments.common.command_line import print_only
from experiments.common.commands import console, quietly
from experiments.common.drawn_axes import fresh_moves, read, stands, up_and_down
from tvsbayes.compensation.correction import Correction
from tvsbayes.compensation.verification import stored_compensation
from tvsbayes.single_axis.axis_campaign import AxisCampaign, AxisMove, read_axis
from tvsbayes.single_axis.axis_parameters import AxisPrior
from tvsbayes.twin.simulated_axis import draw_axis

TRAVEL, SEED, U = 40.0, 11, 0.002
TRUE = {
    "backlash": AxisPrior(0.3, 0.0),
    "transmission_error": AxisPrior(0.05, 0.0),
    "stop_sd": AxisPrior(0.004, 0.2),
    "home_sd": AxisPrior(0.004, 0.2),
    "drift_per_root_hour": AxisPrior(0.004, 0.0),
}


def log_bytes(campaign: AxisCampaign) -> bytes:
    """A log as a user keeps it: time, homing, command, reading; moves that are not read have no reading."""
    value = {r.move: f"{r.value:.4f}" for r in campaign.readings}
    rows = ["time_s,segment,approach,command,value_mm,u"]
    for m in campaign.moves:
        ends = f"{value[m.move]},{U}" if m.move in value else ","
        rows.append(f"{m.time_s:g},{m.segment},{m.approach},{m.command:.4f},{ends}")
    return ("\n".join(rows) + "\n").encode()


class Stage:
    """The drawn stage."""

    def __init__(self) -> None:
        self.rng = np.random.default_rng([SEED, 1])
        grid = np.linspace(-0.75 * TRAVEL, 0.75 * TRAVEL, 601).tolist()
        self.truth = draw_axis(grid, TRUE, 1.001, TRAVEL, self.rng, unit="mm")

    def log(
        self, moves: tuple[AxisMove, ...], which: list[int], by: Correction | None = None, sign: float = 1.0
    ) -> bytes:
        """What is logged of moves under a table."""
        sent = moves if by is None else by.moved(moves, sign, sign)
        return log_bytes(read(moves, stands(self.truth, tuple(sent), self.rng), which, self.rng, u=U))


def main() -> None:
    print_only(__doc__)
    stage = Stage()
    with tempfile.TemporaryDirectory() as place:
        os.chdir(place)
        Path("log.csv").write_bytes(stage.log(*up_and_down(TRAVEL, 9, 3)))
        print(BEGIN)
        print("```text\n" + "\n".join(Path("log.csv").read_text().splitlines()[:6]) + "\n...\n```\n")
        print(console("import", "log.csv", "--axis", "--to", "stage", "--yes"))
        print(console("fit", "stage", "--quick"))
        print(TABLE)
        print(console("compensate", "stage", "--to", "linuxcnc", "-o", "stage.comp"))
        print(FILE)
        print("```text\n" + Path("stage.comp").read_text() + "```\n")
        print(FRESH)
        print(console("plan", "stage", "--verify", "-o", "plan.csv"))
        by = Correction.of(stored_compensation(read_axis(Path("stage"))))
        moves, which = fresh_moves(12, TRAVEL, stage.rng)
        Path("fresh.csv").write_bytes(stage.log(moves, which, by))
        Path("turned.csv").write_bytes(stage.log(moves, which, by, -1.0))
        print(VERIFY)
        print(console("import", "fresh.csv", "--axis", "--to", "fresh", "--yes"))
        print(console("verify", "stage", "fresh"))
        print(TURNED)
        quietly("import", "turned.csv", "--axis", "--to", "turned", "--yes")
        print(console("verify", "stage", "turned"))
        print(END)


BEGIN = """# From a log to a table to a verified machine

Ten minutes, for one axis that is driven open loop and read by something better: an encoder, a laser triangulation
sensor, a dial gauge. The stage of this page is drawn, not measured (`experiments.compensation.ten_minutes` prints the
page again); the commands are those for a real one.

## A log

Drive the axis up and down through its range, beyond both ends, several times, and home it in between: the error of a
homing is part of every promise, and one homing alone does not determine it. A line for every move; where nothing is
read, `value_mm` is empty. Commands here count in mm, with a nominal ratio of 1.
"""
TABLE = """## A table, and what it promises

The table is of one state, the mean time, travel and temperature of the campaign, for all commands. The promise is a
prediction of single readings, by side: what 95 % of them do not exceed after the table is applied, in a use as long as
the campaign's, and what each cause would leave alone. It holds between the commands that were read. Nothing is applied
yet.
"""
FILE = """The file says of what it is and what is promised. LinuxCNC takes it by `COMP_FILE = stage.comp` and
`COMP_FILE_TYPE = 0`; [others](commands.md#compensate) get theirs by `--to`.
"""
FRESH = """## Fresh readings

Apply the file, once, in one place. Then take fresh readings, from a homing on. The most informative ones:
"""
VERIFY = """Twelve readings at commands of one's own do as well. `fresh.csv` lists the commands that were asked for: the
controller adds its corrections by itself.
"""
TURNED = """Had the sign been turned:
"""
END = """`tvsbayes report stage` shows table, promise and verdict beside the calibration. A nightly job may run
`verify`: it exits with 0 where the promise is kept, 1 where it is broken, 3 where the readings do not decide.

## A mount that tracks

A drive at constant rate, of a guide log for instance, never stops and never turns back. Its controller can take out
what repeats with a turn of the worm:

```sh
tvsbayes import PHD2_GuideLog.txt --axis --run 2 --to mount --yes
tvsbayes fit mount
tvsbayes compensate mount --to pec -o worm.csv
```

The table holds the strongest wave and those of a half, a third ... an eighth of its period, over one period in the
middle of the log; `--period` takes another. `compensate` says its period in seconds and its size, peak to peak. What it
adds turns the axis ahead, in arcsec. Its phase counts from command 0, which is the beginning of a guide log: shift it
to the index of the worm. The promise is of errors off the drive's own line within a period of its slowest wave; walk
and creep of the zero are in it.

Did it get better? `verify` needs stops, which a drive does not make. Log again with the table in force, and import that
log into another folder: `fit` says which waves are left. With `periods = [478.7]`, the table's period in seconds, in
place of `period_between` in its `campaign.toml`, the amplitude of that wave is given even where there is none.
"""

if __name__ == "__main__":
    main()
