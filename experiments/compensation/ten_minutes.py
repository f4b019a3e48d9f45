"""From a log to a table to a verified machine: a page of the documentation, with what its commands print now.

    python -m experiments.compensation.ten_minutes [--write]

The page, data/docs/compensation.md, has the words and the commands. A stage is drawn (play 0.3 mm, errors by position
of 0.05 mm, on 40 mm), read three times to and fro into `log.csv`, and driven with the table into `fresh.csv`, and once
with its sign turned into `turned.csv`: what a controller would do.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from experiments.common.commands import quietly, renew_page, renewed
from experiments.common.drawn_axes import fresh_moves, read, stands, up_and_down
from experiments.common.rows import ROOT
from tvsbayes.compensation.correction import Correction
from tvsbayes.compensation.verification import stored_compensation
from tvsbayes.single_axis.axis_campaign import AxisCampaign, AxisMove, read_axis
from tvsbayes.single_axis.axis_parameters import AxisPrior
from tvsbayes.twin.simulated_axis import draw_axis

PAGE = ROOT / "data" / "docs" / "compensation.md"
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


def driven(stage: Stage) -> None:
    """Fresh readings under the table, and with its sign turned."""
    by = Correction.of(stored_compensation(read_axis(Path("stage"))))
    moves, which = fresh_moves(12, TRAVEL, stage.rng)
    Path("fresh.csv").write_bytes(stage.log(moves, which, by))
    Path("turned.csv").write_bytes(stage.log(moves, which, by, -1.0))
    quietly("import", "turned.csv", "--axis", "--to", "turned", "--yes")


def every(page: str) -> str:
    """The page, of one stage."""
    stage = Stage()
    Path("log.csv").write_bytes(stage.log(*up_and_down(TRAVEL, 9, 3)))
    return renewed(page, ("log.csv", "stage.comp"), {"import fresh.csv": lambda: driven(stage)})


if __name__ == "__main__":
    renew_page(__doc__, PAGE, every)
