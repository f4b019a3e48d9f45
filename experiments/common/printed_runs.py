"""Tables of ISO 230-2 runs that others printed, as axis campaigns.

A table has the columns cycle, direction, command_mm, reading_mm in order of time. Times were not recorded: a reading a
minute. Between runs of opposite direction ISO 230-2 goes beyond the end and comes back, which takes up the play: that
move is written down, a twentieth of the range beyond, without a reading.
"""

from __future__ import annotations

import csv
from pathlib import Path

from tvsbayes.single_axis.axis_campaign import AxisCampaign, AxisMove, Reading

READING_S, OVERRUN = 60.0, 0.05


def axis_of(table: Path) -> AxisCampaign:
    """The campaign that a table holds."""
    with open(table, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    commands = [float(row["command_mm"]) for row in rows]
    low, high = min(commands), max(commands)
    beyond = {"backward": high + OVERRUN * (high - low), "forward": low - OVERRUN * (high - low)}
    moves: list[AxisMove] = []
    readings: list[Reading] = []
    for number, row in enumerate(rows):
        time_s, direction = READING_S * number, row["direction"]
        if not moves:
            moves.append(AxisMove(0, 0, time_s, commands[0], "forward" if direction == "forward" else "backward"))
        else:
            if direction != rows[number - 1]["direction"]:
                moves.append(AxisMove(len(moves), 0, time_s - 0.5 * READING_S, beyond[direction]))
            moves.append(AxisMove(len(moves), 0, time_s, commands[number]))
        readings.append(Reading(number, len(moves) - 1, float(row["reading_mm"])))
    return AxisCampaign("mm", tuple(moves), tuple(readings), header={"name": table.stem})


def tables_of(folder: Path) -> list[Path]:
    tables = sorted(folder.glob("*.csv"))
    if not tables:
        raise SystemExit(f"{folder} holds no .csv")
    return tables
