"""Real axes: the table of all visits but one, applied to the one left out.

    python -m experiments.compensation.real_visits AXES ROTARY > experiments/compensation/real_visits.md

AXES holds tables of ISO 230-2 runs as in `experiments.common.printed_runs`; a visit is a cycle. ROTARY is a table
of a geared axis with an encoder (`place_deg`, `side`, `repeat`, `time_s`, `encoder_counts`); a visit is a repeat. Of
every reading left out the error is counted: as it is, from the nominal line through the others (offset alone); after
taking off one constant play; the mean of the others at its command and side; what the table of `compensate` expects
there, which is for a machine that was homed again; the same with the zero of the others, as the constant play has it,
since nothing was homed here; and what the fit expects at its own time, the walk of the zero followed. `home_sd` is 0; a
zero that warms up is no matter of a table. The places of the rotary axis were read one after the other, so that place,
time and travel are one to the data. Its last row states what is known of a train of gears in a steady room: teeth keep
step (`ratio_contrast` 0, u 0), and the zero does not creep (`creep` 0, u 0).
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from experiments.common import page
from experiments.common.command_line import parser
from experiments.common.printed_runs import axis_of, tables_of
from tvsbayes.compensation.formats import Wish
from tvsbayes.compensation.promise import compensation_of
from tvsbayes.single_axis.axis_campaign import AxisCampaign, AxisMove, Reading
from tvsbayes.single_axis.axis_fit import AxisFit
from tvsbayes.single_axis.axis_model import AxisModel
from tvsbayes.single_axis.axis_parameters import AxisPrior
from tvsbayes.single_axis.axis_record import results_for
from tvsbayes.single_axis.axis_rows import legs_of, rows_of
from tvsbayes.single_axis.predicted_stops import DRAWS, transferred_scales

COUNTS_PER_DEG = -22466.7
"""Of the encoder by the least-squares line through all stops: readings in degrees of the axis."""
STEADY = {name: AxisPrior(0.0, 0.0) for name in ("ratio_contrast", "creep")}
"""Of gears whose teeth keep step, in a steady room."""
END = "its zero that of the others | at its time | promised | inside"
REVERSAL_DEG = 0.45
"""How far beyond a place the axis went before it came back to it."""


def rotary_axis(table: Path) -> tuple[AxisCampaign, list[int]]:
    """The campaign of the rotary axis, and the visit of each reading."""
    with open(table, newline="", encoding="utf-8") as file:
        rows = sorted(csv.DictReader(file), key=lambda row: float(row["time_s"]))
    moves: list[AxisMove] = []
    readings: list[Reading] = []
    for row in rows:
        place, time_s, side = float(row["place_deg"]), float(row["time_s"]), 1 if row["side"] == "below" else -1
        before = place - side * REVERSAL_DEG
        if not moves or moves[-1].command != before:
            approach = "" if moves else "unknown"
            moves.append(AxisMove(len(moves), 0, time_s - 5.0, before, approach))  # type: ignore[arg-type]
        moves.append(AxisMove(len(moves), 0, time_s, place))
        readings.append(Reading(len(readings), len(moves) - 1, float(row["encoder_counts"]) / COUNTS_PER_DEG))
    return AxisCampaign("deg", tuple(moves), tuple(readings)), [int(row["repeat"]) for row in rows]


def linear_axis(table: Path) -> tuple[AxisCampaign, list[int]]:
    """The campaign of a table of runs, and the cycle of each reading."""
    with open(table, newline="", encoding="utf-8") as file:
        return axis_of(table), [int(row["cycle"]) for row in csv.DictReader(file)]


def left_out(campaign: AxisCampaign, visits: Sequence[int], visit: int) -> tuple[np.ndarray, ...]:
    """Errors of the readings of one visit, in the order of the page's columns, and the promise of each."""
    legs = legs_of(campaign.moves)
    at = np.array([r.move for r in campaign.readings])
    command, side = legs.command[at], legs.side[at]
    value = np.array([float(r.value or 0.0) for r in campaign.readings])
    out = np.array(visits) == visit
    others = tuple(r for r, gone in zip(campaign.readings, out, strict=True) if not gone)
    known = replace(campaign, readings=others, stated={**campaign.stated, "home_sd": AxisPrior(0.0, 0.0)})
    results = results_for(known)
    compensation = compensation_of(results, Wish(per_command=1.0))
    error = value - command
    line = np.column_stack([np.ones(len(error)), side])
    solved = np.linalg.lstsq(line[~out], error[~out], rcond=None)[0]
    columns = np.array([(row.command, row.forward, row.backward) for row in compensation.table]).T
    expected = np.where(side > 0, *(np.interp(command, columns[0], column) for column in columns[1:]))
    names = ("forward", "backward")
    promised = np.where(side > 0, *(compensation.promise[name].error95_with_homing or 0.0 for name in names))
    means = [error[(command == c) & (side == s) & ~out].mean() for c, s in zip(command[out], side[out], strict=True)]
    left, followed = value - expected, value[out] - _followed(results.fit, campaign, at[out])
    simple = (error - error[~out].mean())[out], (error - line @ solved)[out], error[out] - means
    return (*simple, left[out], left[out] - left[~out].mean(), followed, promised[out])


def _followed(fit: AxisFit, campaign: AxisCampaign, moves: np.ndarray) -> np.ndarray:
    """Readings of moves of the campaign, predicted by a fit without them, at their own times."""
    model = AxisModel.of(
        replace(rows_of(campaign), line=fit.rows.line), fit.model.priors, None, fit.model.coordinates.waves
    )
    drawn = fit.w[np.linspace(0, len(fit.w) - 1, DRAWS).astype(int)]
    w = transferred_scales(fit.model, drawn, model, np.random.default_rng(1))
    return model.left_out(w, np.flatnonzero(np.isin(model.rows.move, moves))).mean.mean(axis=0)


def row_of(name: str, unit: str, campaign: AxisCampaign, visits: Sequence[int]) -> str:
    """A line of the table: all visits left out in turn."""
    each = [left_out(campaign, visits, visit) for visit in sorted(set(visits))]
    *errors, promised = (np.concatenate(parts) for parts in zip(*each, strict=True))
    table = errors[3]
    inside = float(np.mean(np.abs(table) <= promised))
    sizes = [f"{1000 * np.sqrt(np.mean(part**2)):.2f}" for part in errors]
    ends = [f"{1000 * np.median(promised):.2f}", f"{100 * inside:.0f} % of {len(table)}"]
    return page.line(name, unit, *sizes, *ends)


TEXT = f"""# Real axes: the table of the others, applied to the visit left out

By `experiments.compensation.real_visits`. RMS of the errors of readings left out; promised: 95 %, median.

{page.heading("axis | unit | before | one constant play | means of others | table", END)}"""


def main() -> None:
    cli = parser(__doc__)
    cli.add_argument("axes", type=Path)
    cli.add_argument("rotary", type=Path)
    arguments = cli.parse_args()
    print(TEXT)
    for table in tables_of(arguments.axes):
        print(row_of(table.stem, "um", *linear_axis(table)), flush=True)
    rotary, visits = rotary_axis(arguments.rotary)
    print(row_of("rotary", "mdeg", rotary, visits), flush=True)
    steady = replace(rotary, stated={**rotary.stated, **STEADY})
    print(row_of("rotary, steady", "mdeg", steady, visits), flush=True)


if __name__ == "__main__":
    main()
