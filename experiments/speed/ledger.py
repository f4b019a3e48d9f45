"""Does the package get slower, or its intervals worse, from one state to the next?

    python -m experiments.speed.ledger append        # measures this commit on a quiet machine, some 6 minutes
    python -m experiments.speed.ledger table > experiments/speed/ledger.md

An entry of `ledger.jsonl` is one commit: CPU seconds of commands as processes of their own, from warm caches, in units
of importing jax, optimistix and scipy.stats in the same run (least of three each); effective draws of the worst
headline of `fit --quick` per CPU second of that unit; intervals that hold the truth on a fixed small set of drawn
axes and of strangers' benches; lines of Python. `tests/promises/test_ledger.py` holds the last entry against `BOUNDS`.
"""

from __future__ import annotations

import argparse
import datetime
import json
import shutil
import sys
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from experiments.common.command_line import act, parser
from experiments.common.commands import IMPORTS, PROGRAM, measured
from experiments.common.page import heading, line
from experiments.common.rows import ROOT, append_row, cpu_model, read_rows, state

LEDGER = Path(__file__).with_suffix(".jsonl")
REPEATS = 3
AXES, BENCHES = 8, 8
"""Of the fixed sets: so many axes a protocol, so many benches of seed 0."""
COMMANDS: dict[str, tuple[str, float]] = {
    "fit --no-sample": ("fit twin --no-sample --json", 4.8),
    "fit --quick": ("fit twin --quick --json", 13.0),
    "demo": ("demo", 12.5),
    "classic": ("classic twin --json", 0.6),
    "report": ("report twin", 2.5),
    "locate": ("locate twin --pan-steps 100 --tilt-steps 20 --aperture-deg 70 --json", 0.5),
    "check": ("check twin", 0.5),
    "fit --quick, axis": ("fit axis --quick --json", 2.8),
    "--help": ("--help", 0.2),
}
"""In a folder that holds a copy of the paper twin and a simulated axis; in this order, `report` takes up the fit. With
the largest multiple of the imports: some 15 % above the first entry, since repeats of one commit differ by 5 %."""
SHARES = {"answered": ("answered", "drawn"), "95 % intervals that hold": ("held", "intervals")}
BOUNDS: dict[str, tuple[float, float]] = {
    **{f"CPU of {name} / imports": (0.0, most) for name, (_, most) in COMMANDS.items()},
    "effective draws per import": (25.0, float("inf")),
    **{f"{what}: {share}": (0.85, 1.0) for what in ("axes", "benches") for share in SHARES},
}
"""Lowest and highest allowed value of the last entry, by the names of `figures`. Shares are of small fixed sets: eight
benches with nine headlines each, 24 axes with four; one of them failing is allowed."""


def figures(entry: Mapping) -> dict[str, float]:
    """The figures of an entry that have bounds, by name."""
    commands = {f"CPU of {name} / imports": float(value) for name, value in entry["commands"].items()}
    shares = {
        f"{what}: {share}": float(counts[part]) / counts[whole]
        for what, counts in entry["intervals"].items()
        for share, (part, whole) in SHARES.items()
    }
    return {**commands, "effective draws per import": float(entry["effective_draws_per_import"]), **shares}


def least(command: Sequence[object], folder: Path) -> tuple[str, float]:
    """What a command prints last, and its least CPU seconds."""
    costs = [measured(command, cwd=folder) for _ in range(REPEATS)]
    return costs[-1][0], min(cost["cpu_s"] for _, cost in costs)


def write_axis(folder: Path) -> None:
    """A simulated axis of 60 readings, to and fro over twelve positions, as `axis` of an absolute folder."""
    way = [*range(0, 1200, 100), *range(1150, -50, -100)]
    rows = [f"{k},0,{60 * k},{command},{'' if k else 'backward'}" for k, command in enumerate([-50, *(way * 3)[:60]])]
    template = folder / "template"
    template.mkdir()
    (template / "moves.csv").write_text("\n".join(["move,segment,time_s,command,approach", *rows, ""]))
    (template / "readings.csv").write_text("reading,move,value,u,status\n")
    header = ('format = "tvsbayes-axis/1"', 'unit = "deg"', "[axis]", "per_command = { value = 0.01, u = 0.001 }", "")
    (template / "campaign.toml").write_text("\n".join(header))
    measured([*PROGRAM, "simulate", template, folder / "axis", "--seed", 1])


def study(module: str, number: int) -> list[dict]:
    """Rows of a study in a file of their own: what another state of the package left is not taken up."""
    with tempfile.TemporaryDirectory() as folder:
        rows = Path(folder) / "rows.jsonl"
        words = ("-m", f"experiments.intervals.{module}", "run", "--n", number, "--rows", rows)
        measured((sys.executable, *words), limit_s=3600.0)
        return read_rows(rows)


def counts(rows: Sequence[Mapping], answered: Sequence[Mapping], held: Iterable[bool]) -> dict[str, int]:
    each = list(held)
    return {"drawn": len(rows), "answered": len(answered), "intervals": len(each), "held": sum(each)}


def intervals() -> dict[str, dict[str, int]]:
    """Of drawn axes every parameter's 95 % interval, of strangers' benches every headline's."""
    axes, benches = study("axis_in_time", AXES), study("strangers", BENCHES)
    fitted = [row for row in axes if not row["problems"]]
    usable = [row for row in benches if row["answer"] in ("accepted", "rough")]
    held = (abs(each["pit"] - 0.5) <= 0.475 for row in fitted for each in row["quantities"].values())
    kept = (each["held"] for row in usable for each in row["headlines"].values())
    return {"axes": counts(axes, fitted, held), "benches": counts(benches, usable, kept)}


def lines(folder: Path) -> int:
    return sum(len(path.read_bytes().splitlines()) for path in folder.rglob("*.py"))


def append(_: argparse.Namespace) -> None:
    """Measure this state of the package and write its entry."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        _, unit = least(IMPORTS, folder)
        shutil.copytree(ROOT / "data" / "twins" / "paper_twin", folder / "twin")
        write_axis(folder)
        entry: dict = {"commit": state(), "at": f"{datetime.datetime.now(datetime.UTC):%Y-%m-%d %H:%M}"}
        entry |= {"processor": cpu_model(), "import_cpu_s": round(unit, 2), "commands": {}}
        for name, (words, _) in COMMANDS.items():
            printed, cost = least((*PROGRAM, *words.split()), folder)
            entry["commands"][name] = round(cost / unit, 2)
            if name == "fit --quick":
                draws = float(json.loads(printed)["sampling"]["importance"]["least_ess"]["value"])
                entry["effective_draws_per_import"] = round(draws / cost * unit)
    entry["intervals"] = intervals()
    entry["lines"] = {folder: lines(ROOT / folder) for folder in ("tvsbayes", "tests", "experiments")}
    append_row(LEDGER, entry)
    print(*problems(entry), sep="\n")


def problems(entry: Mapping) -> list[str]:
    """What of an entry is outside its bounds, a sentence each."""
    return [
        f"{name}: {value:.3g}, allowed {BOUNDS[name][0]:.3g} to {BOUNDS[name][1]:.3g}"
        for name, value in figures(entry).items()
        if not BOUNDS[name][0] <= value <= BOUNDS[name][1]
    ]


def table(_: argparse.Namespace) -> None:
    """All entries side by side."""
    entries = read_rows(LEDGER)
    print("# Ledger\n\nA column is a commit, measured by `python -m experiments.speed.ledger append`; what a row means")
    print("stands in the script. Bounds are those of the last entry.\n")
    print(heading("", *(f"{entry['commit']}, {entry['at'][:10]}" for entry in entries), "bounds"))
    print(line("CPU s of the imports", *(entry["import_cpu_s"] for entry in entries), ""))
    for name, (low, high) in BOUNDS.items():
        values = [figures(entry).get(name) for entry in entries]
        cells = ("" if value is None else f"{value:.3g}" for value in values)
        print(line(name, *cells, f"{low:.3g} to {high:.3g}"))
    for folder in entries[-1]["lines"]:
        print(line(f"lines of {folder}/", *(entry["lines"].get(folder, "") for entry in entries), ""))


if __name__ == "__main__":
    act(parser(__doc__, append=append, table=table))
