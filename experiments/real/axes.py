"""Do the intervals hold on real axes, and on simulated ones?

    python -m experiments.real.axes held FOLDER                       # tables as in experiments.common.printed_runs
    python -m experiments.real.axes folders FOLDER OUT                # axis folders from them: OUT/NAME of every table
    python -m experiments.real.axes run --n 100 --cores 0 1           # drawn axes of three protocols, resumable
    python -m experiments.real.axes table > experiments/real/axes.md
    python -m experiments.real.axes figure                            # of what `held` found, for data/docs/real.md

`held` leaves every position of every table out in turn and predicts the mean of its readings in each direction: by the
model with error and play as processes of position, and by the first edition's: offset, scale, play and independent
stops (least squares, as `classic_predicted` of `compare`). `run` draws axes from the default priors and counts how
often the intervals of a fit hold the truth.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from experiments.common.against_truth import NOTE, rms, scored, table
from experiments.common.command_line import study
from experiments.common.figures import page_figure, title_and_figure
from experiments.common.page import heading, line
from experiments.common.printed_runs import axis_of, tables_of
from experiments.common.rows import append_row, output, read_rows
from tvsbayes.report.drawing import BLUE, RED
from tvsbayes.single_axis.axis_campaign import AxisCampaign, AxisMove, write_axis
from tvsbayes.single_axis.axis_fit import fit_axis
from tvsbayes.single_axis.axis_parameters import AxisPrior
from tvsbayes.single_axis.held_out_positions import hold_out_positions
from tvsbayes.twin.simulated_axis import simulate_axis

HELD, FIGURE = output(__file__, "axes_held.jsonl"), Path("data/docs/real_axes.png")
PROTOCOLS = {
    "iso": "9 positions, 5 runs to and fro beyond both ends",
    "few": "5 positions, 3 runs to and fro beyond both ends",
    "walk": "60 stops at random among 12 positions, homed twice, sides unknown",
}
"""Of drawn axes, 0.01 deg per command, 4000 commands of travel, read to 0.001 deg once a minute."""


def template(protocol: str, seed: int) -> AxisCampaign:
    """Moves of a protocol; beyond the ends nothing is read."""
    stated = {"per_command": AxisPrior(0.01, 0.002)}
    if protocol == "walk":
        commands = np.random.default_rng([seed, 99]).choice(np.linspace(-2000, 2000, 12), 60)
        segments, approach = [k // 20 for k in range(60)], "unknown"
    else:
        positions, cycles = (9, 5) if protocol == "iso" else (5, 3)
        places = np.linspace(-2000, 2000, positions)
        commands = [-2200.0, *[*places, 2200.0, *places[::-1], -2200.0] * cycles]
        segments, approach = [0] * len(commands), "backward"
    moves = []
    for k, (command, segment) in enumerate(zip(commands, segments, strict=True)):
        first = k == 0 or segment != segments[k - 1]
        moves.append(AxisMove(k, segment, 60.0 * k, float(command), approach if first else ""))  # type: ignore[arg-type]
    return AxisCampaign("deg", tuple(moves), (), stated)


def one_axis(task: tuple[str, int]) -> dict[str, object]:
    protocol, seed = task
    drawn = simulate_axis(template(protocol, seed), seed=seed)
    campaign = drawn.campaign
    kept = tuple(r for r in campaign.readings if abs(campaign.moves[r.move].command) <= 2000)
    fit = fit_axis(AxisCampaign("deg", campaign.moves, kept, campaign.stated), tier="importance", seed=seed)
    true = drawn.truth.parameters
    quantities = {name: scored(fit.draws[name], true[name]) for name in ("per_command", "backlash")}
    return {"protocol": protocol, "seed": seed, "problems": list(fit.missing), "quantities": quantities}


def folders(arguments: argparse.Namespace) -> None:
    for file in tables_of(arguments.folder):
        write_axis(axis_of(file), arguments.out / file.stem)
        print(arguments.out / file.stem)


def held(arguments: argparse.Namespace) -> None:
    """Rows of held-out positions of every table in a folder."""
    HELD.unlink(missing_ok=True)
    for file in tables_of(arguments.folder):
        found = hold_out_positions(axis_of(file))
        for p in found.positions:
            z, classic_z = (p.mean - p.predicted) / p.u, (p.mean - p.classic_predicted) / p.classic_u
            row = {"axis": file.stem, "position": p.position, "direction": p.direction, "end": p.end}
            append_row(HELD, {**row, "z": z, "classic_z": classic_z, "rows": p.rows, "inside": p.inside})
        print(file.stem, f"{found.rms_z:.2f}", *found.warnings)


def held_line(name: str, rows: list[dict]) -> str:
    inner, ends = [r for r in rows if not r["end"]], [r["z"] for r in rows if r["end"]]
    z = np.array([r["z"] for r in inner])
    inside = sum(r["inside"] for r in inner) / sum(r["rows"] for r in inner)
    within = np.mean(np.abs(z) <= 1.96)
    cells = f"{rms(z):.2f}", f"{np.abs(z).max():.1f}", f"{100 * within:.0f} %", f"{100 * inside:.0f} %"
    first_edition = rms([r["classic_z"] for r in inner])
    return line(name, len(inner), *cells, f"{rms(ends):.2f}" if ends else "", f"{first_edition:.2f}")


HELD_TEXT = f"""Made by `python -m experiments.real.axes`. Axes: figures printed in the test reports of the public
repository anderssandstrom/ecmc_target_muts_logger (commit ee350e4c81): ISO 230-2 runs of stepper-driven screw axes read
by laser triangulation. Every position left out in turn, the axis fitted without it, the mean of its readings in each
direction predicted. z = (mean - predicted) / u; first edition: offset, scale, play, independent stops.

{heading("axis | inner means | RMS z | worst | in 1.96 u | readings in 95 % | ends: RMS z | first edition: RMS z")}"""


def page(drawn: list[dict]) -> None:
    left_out = read_rows(HELD)
    words = "Left-out means less those predicted, in u, by axis and model"
    print(title_and_figure(__file__, "Real axes, positions left out", FIGURE, words))
    print(HELD_TEXT)
    for axis in dict.fromkeys(row["axis"] for row in left_out):
        print(held_line(axis, [row for row in left_out if row["axis"] == axis]))
    print(held_line("**all**", left_out))
    print(f"\n## Drawn axes\n\nDrawn from the default priors and fitted by `fit --quick`; {NOTE}.\n")
    for protocol, what in PROTOCOLS.items():
        refused = sum(bool(row["problems"]) for row in drawn if row["protocol"] == protocol)
        print(f"- {protocol}: {what}; {refused} not accepted")
    print()
    table({name: [row["quantities"] for row in drawn if row["protocol"] == name] for name in PROTOCOLS})


def figure(_: argparse.Namespace) -> None:
    """Z of every inner position that was left out, by axis, for both models."""
    rows = [row for row in read_rows(HELD) if not row["end"]]
    names = list(dict.fromkeys(row["axis"] for row in rows))
    looks = ((-0.12, "z", BLUE, "processes of position"), (0.12, "classic_z", RED, "line, play, independent stops"))
    with page_figure(FIGURE, 3.0, width_in=7.2) as picture:
        axes = picture.subplots()
        axes.axhspan(-1.96, 1.96, color=BLUE, alpha=0.15, linewidth=0)
        for shift, key, colour, label in looks:
            place = [names.index(row["axis"]) + shift for row in rows]
            axes.plot(place, [row[key] for row in rows], "o", markersize=3, color=colour, alpha=0.7, label=label)
        counts = [sum(row["axis"] == name for row in rows) for name in names]
        ticks = [f"{name.replace('_', ' ')}\nn = {n}" for name, n in zip(names, counts, strict=True)]
        axes.set_xticks(range(len(names)), ticks)
        axes.set_ylabel("(mean - predicted) / u")
        axes.legend()


if __name__ == "__main__":
    options = {"folder": {"type": Path, "nargs": "?", "help": "of tables, for held and folders"}}
    options["out"] = {"type": Path, "nargs": "?", "help": "for folders"}
    actions = {"held": held, "folders": folders, "figure": figure}
    study(__file__, __doc__, one_axis, ("protocol", "seed"), PROTOCOLS, page, 100, options, **actions)
