"""Do the intervals hold on real axes, and on simulated ones?

    python -m experiments.real.axes run FOLDER                        # tables as in experiments.common.printed_runs
    python -m experiments.real.axes folders FOLDER OUT                # axis folders from them: OUT/NAME of every table
    python -m experiments.real.axes simulate --n 100 --cores 0 1      # drawn axes of three protocols, resumable
    python -m experiments.real.axes table > experiments/real/axes.md
    python -m experiments.real.axes figure                            # of what `run` found, for data/docs/real.md

`run` leaves every position of every table out in turn and predicts the mean of its readings in each direction: by the
model with error and play as processes of position, and by the first edition's: offset, scale, play and independent
stops (least squares, as `classic_predicted` of `compare`). `simulate` draws axes from the default priors and counts how
often the intervals of a fit hold the truth.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from experiments.common.command_line import act, by_seed, parser
from experiments.common.drawn_axes import rms, scored, scores_line
from experiments.common.figures import page_figure, title_and_figure
from experiments.common.page import line
from experiments.common.printed_runs import axis_of, tables_of
from experiments.common.rows import append_row, output, read_rows, run_rows
from tvsbayes.report.drawing import BLUE, RED
from tvsbayes.single_axis.axis_campaign import AxisCampaign, AxisMove, write_axis
from tvsbayes.single_axis.axis_fit import fit_axis
from tvsbayes.single_axis.axis_parameters import AxisPrior
from tvsbayes.single_axis.held_out_positions import hold_out_positions
from tvsbayes.twin.simulated_axis import simulate_axis

HELD, DRAWN = output(__file__, "axes_held.jsonl"), output(__file__, "axes_drawn.jsonl")
FIGURE = Path("data/docs/real_axes.png")
QUANTITIES = ("per_command", "backlash")
PROTOCOLS = {
    "iso": "9 positions, 5 runs to and fro beyond both ends",
    "few": "5 positions, 3 runs to and fro beyond both ends",
    "walk": "60 stops at random among 12 positions, homed twice, sides unknown",
}
"""Of drawn axes, 0.01 deg per command, 4000 commands of travel, read to 0.001 deg once a minute."""


def runs(positions: int, cycles: int) -> tuple[list[float], set[int]]:
    """Commands of runs to and fro, and which of them are read."""
    places = np.linspace(-2000, 2000, positions)
    commands, read = [-2200.0], set()
    for _ in range(cycles):
        for run, beyond in ((places, 2200.0), (places[::-1], -2200.0)):
            read |= set(range(len(commands), len(commands) + positions))
            commands += [*map(float, run), beyond]
    return commands, read


def template(protocol: str, seed: int) -> tuple[AxisCampaign, set[int]]:
    """Moves of a protocol, and which of them are read."""
    segments: list[int]
    if protocol == "walk":
        rng = np.random.default_rng([seed, 99])
        commands = [float(c) for c in rng.choice(np.linspace(-2000, 2000, 12), 60)]
        segments, read, approach = [k // 20 for k in range(60)], set(range(60)), "unknown"
    else:
        commands, read = runs(*((9, 5) if protocol == "iso" else (5, 3)))
        segments, approach = [0] * len(commands), "backward"
    moves = []
    for k, (command, segment) in enumerate(zip(commands, segments, strict=True)):
        first = k == 0 or segment != segments[k - 1]
        moves.append(AxisMove(k, segment, 60.0 * k, command, approach if first else ""))  # type: ignore[arg-type]
    stated = {"per_command": AxisPrior(0.01, 0.002)}
    return AxisCampaign("deg", tuple(moves), (), stated), read


def one_axis(task: tuple[str, int]) -> dict[str, object]:
    """Draw, read and fit one axis."""
    protocol, seed = task
    moves, read = template(protocol, seed)
    drawn = simulate_axis(moves, seed=seed)
    kept = tuple(r for r in drawn.campaign.readings if r.move in read)
    result = fit_axis(AxisCampaign("deg", drawn.campaign.moves, kept, moves.stated), tier="importance", seed=seed)
    row: dict[str, object] = {"protocol": protocol, "seed": seed, "problems": list(result.missing)}
    return row | {name: scored(result.draws[name], drawn.truth.parameters[name]) for name in QUANTITIES}


def simulate(arguments: argparse.Namespace) -> None:
    """Rows of drawn axes."""
    run_rows(one_axis, by_seed(PROTOCOLS, arguments.n), DRAWN, ("protocol", "seed"), arguments.cores)


def folders(arguments: argparse.Namespace) -> None:
    """Axis folders."""
    for table in tables_of(arguments.folder):
        write_axis(axis_of(table), arguments.out / table.stem)
        print(arguments.out / table.stem)


def run(arguments: argparse.Namespace) -> None:
    """Rows of held-out positions of every table in a folder."""
    HELD.unlink(missing_ok=True)
    for file in tables_of(arguments.folder):
        held = hold_out_positions(axis_of(file))
        for p in held.positions:
            z, classic_z = (p.mean - p.predicted) / p.u, (p.mean - p.classic_predicted) / p.classic_u
            row = {"axis": file.stem, "position": p.position, "direction": p.direction, "end": p.end}
            append_row(HELD, {**row, "z": z, "classic_z": classic_z, "rows": p.rows, "inside": p.inside})
        print(file.stem, f"{held.rms_z:.2f}", *held.warnings)


def _held_lines(name: str, rows: list[dict]) -> str:
    inner, ends = [r for r in rows if not r["end"]], [r for r in rows if r["end"]]
    z = [r["z"] for r in inner]
    inside = sum(r["inside"] for r in inner) / sum(r["rows"] for r in inner)
    within = np.mean(np.abs(z) <= 1.96)
    cells = [name, len(inner), rms(z), f"{np.abs(z).max():.1f}", f"{100 * within:.0f} %", f"{100 * inside:.0f} %"]
    return line(*cells, rms([r["z"] for r in ends]), rms([r["classic_z"] for r in inner]))


HELD_TEXT = """Made by `python -m experiments.real.axes`. Axes: figures printed in the test reports of the public
repository anderssandstrom/ecmc_target_muts_logger (commit ee350e4c81): ISO 230-2 runs of stepper-driven screw axes read
by laser triangulation. Every position left out in turn, the axis fitted without it, the mean of its readings in each
direction predicted. z = (mean - predicted) / u; first edition: offset, scale, play, independent stops.

| axis | inner means | RMS z | worst | in 1.96 u | readings in 95 % | ends: RMS z | first edition: RMS z |
|---|---|---|---|---|---|---|---|"""
DRAWN_TEXT = """
## Drawn axes

Axes drawn from the default priors and fitted by `fit --quick`: share of truths in central intervals, RMS of
z = (mean - truth) / sd. Bounds are two-sided at 1e-4 for so many axes.

| protocol | quantity | axes | in 50 % | bounds | in 95 % | bounds | RMS z | bounds | not accepted |
|---|---|---|---|---|---|---|---|---|---|"""


def table(_: argparse.Namespace) -> None:
    """Both tables."""
    held, drawn = read_rows(HELD), read_rows(DRAWN)
    words = "Left-out means less those predicted, in u, by axis and model"
    print(title_and_figure(__file__, "Real axes, positions left out", FIGURE, words))
    print(HELD_TEXT)
    for axis in dict.fromkeys(r["axis"] for r in held):
        print(_held_lines(axis, [r for r in held if r["axis"] == axis]))
    print(_held_lines("**all**", held))
    print(DRAWN_TEXT)
    for protocol, what in PROTOCOLS.items():
        rows = [r for r in drawn if r["protocol"] == protocol]
        refused = str(sum(bool(r["problems"]) for r in rows))
        for name in QUANTITIES if rows else ():
            print(scores_line(f"{protocol}: {what}", name, [r[name] for r in rows], refused))


def figure(_: argparse.Namespace) -> None:
    """Z of every inner position that was left out, by axis, for both models."""
    rows = [row for row in read_rows(HELD) if not row["end"]]
    names = list(dict.fromkeys(row["axis"] for row in rows))
    with page_figure(FIGURE, 3.0, width_in=7.2) as page:
        axes = page.subplots()
        axes.axhspan(-1.96, 1.96, color=BLUE, alpha=0.15, linewidth=0)
        for shift, key, colour, label in (
            (-0.12, "z", BLUE, "processes of position"),
            (0.12, "classic_z", RED, "line, play, independent stops"),
        ):
            place = [names.index(row["axis"]) + shift for row in rows]
            axes.plot(place, [row[key] for row in rows], "o", markersize=3, color=colour, alpha=0.7, label=label)
        counts = [sum(row["axis"] == name for row in rows) for name in names]
        ticks = [f"{name.replace('_', ' ')}\nn = {n}" for name, n in zip(names, counts, strict=True)]
        axes.set_xticks(range(len(names)), ticks)
        axes.set_ylabel("(mean - predicted) / u")
        axes.legend()


if __name__ == "__main__":
    cli = parser(__doc__, run=run, folders=folders, simulate=simulate, table=table, figure=figure)
    cli.add_argument("folder", type=Path, nargs="?", help="of tables, for run and folders")
    cli.add_argument("out", type=Path, nargs="?", help="for folders")
    cli.add_argument("--n", type=int, default=100, help="drawn axes of each protocol (%(default)s)")
    cli.add_argument("--cores", type=int, nargs="+", default=[0], metavar="CORE")
    act(cli)
