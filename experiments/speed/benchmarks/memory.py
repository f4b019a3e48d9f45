"""Peak resident memory per command, each in a process of its own."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from experiments.speed.benchmarks.measure import Bench, Case, Column, command_cost
from experiments.speed.benchmarks.start import PROGRAM

TITLE = "Memory per command"
NAME = "Shipped rigs and twins"
REPEATS = 1
BOARD = ("--board", "9x6", "--pitch-mm", "25", "--out")


def measure(bench: Bench) -> None:
    """In the order in which a user would call them: later commands read what earlier ones wrote."""
    from experiments.common.rigs import mounted_rig, small_plan
    from tvsbayes.files.disk import shipped_data
    from tvsbayes.instrument.plan import write_plan

    data = shipped_data()
    rig, twin = str(data / "rigs" / "mounted" / "rig.toml"), str(data / "twins" / "grid_twin")
    with tempfile.TemporaryDirectory() as place:
        out = Path(place)
        write_plan(small_plan(tuple(mounted_rig().sheets_mm)[:2]), out / "plan.csv")
        frames, results = str(out / "frames"), ["--out", str(out / "results")]
        commands = {
            "--help": ["--help"],
            "check (grid twin)": ["check", twin],
            "simulate --frames (48 looks)": ["simulate", rig, str(out / "plan.csv"), frames, "--frames"],
            "detect (96 frames)": ["detect", frames],
            "stereo (40 board pictures)": ["stereo", str(out / "frames" / "boards"), *BOARD, str(out / "stereo.json")],
            "classic (paper twin)": ["classic", str(data / "twins" / "paper_twin")],
            "fit --no-sample (grid twin)": ["fit", twin, "--no-sample", *results],
            "fit (grid twin, sampled)": ["fit", twin, "--out", str(out / "sampled")],
            "plan": ["plan", rig],
        }
        if not bench.missing(NAME, list(commands), REPEATS):
            return
        # All of them, in order, even where some rows are there: they build on one another.
        for name, arguments in commands.items():
            values = command_cost([*PROGRAM, *arguments], limit_s=900.0)[1]
            if 0 not in bench.there(NAME, name):
                bench.keep(NAME, name, 0, values)
        if 0 not in bench.there(NAME, "floor: import jax"):
            bench.keep(NAME, "floor: import jax", 0, command_cost([sys.executable, "-c", "import jax"])[1])


def cases() -> list[Case]:
    """Tables of the part."""
    columns = (Column("rss_mib", "peak memory, MiB", "{:.0f}"), Column("wall_s", "wall s"), Column("cpu_s", "CPU s"))
    return [Case(NAME, "Compilation cache as the user has it.", columns, ours="")]
