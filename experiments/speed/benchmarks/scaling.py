"""Time and memory of the fit against the number of spots, by `fit_speed --spots`, a process for each size."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Mapping, Sequence

import numpy as np

from experiments.speed.benchmarks.measure import Bench, Case, Column, command_cost
from experiments.speed.fit_speed import ONE_SIZE

TITLE = "The fit against the number of spots"
NAME = "Mixed campaigns of the mounted rig"


def measure(bench: Bench, sizes: Sequence[int], limit_s: float) -> None:
    """Once per size: one size takes from half a minute to many."""
    for spots in sizes:
        contender = f"{spots} asked"
        if 0 in bench.there(NAME, contender):
            continue
        command = [*ONE_SIZE, str(spots)]
        try:
            text, cost = command_cost(command, limit_s=limit_s)
        except subprocess.TimeoutExpired:
            print(f"scaling | {spots} spots: stopped after {limit_s:g} s", flush=True)
            bench.keep(NAME, contender, 0, {"spots": float(spots), "first_s": f"more than {limit_s:g}"})
            continue
        bench.keep(NAME, contender, 0, {**json.loads(text), "cpu_s": cost["cpu_s"], "rss_mib": cost["rss_mib"]})


def cases(rows: Sequence[Mapping]) -> list[Case]:
    """Tables of the part."""
    columns = (
        Column("spots", "spots", "{:.0f}"),
        Column("reading_s", "read, s"),
        Column("first_s", "first fit, s"),
        Column("warm_s", "warm fit, s"),
        Column("rss_mib", "peak memory, MiB", "{:.0f}"),
        Column("cpu_s", "CPU s of the process"),
    )
    about = (
        "Wall clock, Laplace only; the first fit holds the compilation, which the shape of a campaign "
        "decides. From 10 000 spots on one fit was made, its warm time is the first."
    )
    return [Case(NAME, about, columns, ours="")]


def remarks(rows: Sequence[Mapping]) -> list[str]:
    """Exponents between neighbouring sizes and over all."""
    sized = sorted(
        (r["values"] for r in rows if not isinstance(r["values"].get("first_s"), str)), key=lambda v: v["spots"]
    )
    twice = [v["first_s"] - v["warm_s"] for v in sized if v["warm_s"] < v["first_s"]]
    if len(sized) < 2 or not twice:
        return []
    compiling = float(np.median(twice))
    seconds = [v["warm_s"] if v["warm_s"] < v["first_s"] else v["first_s"] - compiling for v in sized]
    spots, memory = [v["spots"] for v in sized], [v["rss_mib"] for v in sized]

    def exponents(values: Sequence[float]) -> str:
        return ", ".join(f"{p:.2f}" for p in np.diff(np.log(values)) / np.diff(np.log(spots)))

    sizes = ", ".join(f"{n:.0f}" for n in spots)
    extra = np.polyfit(spots, memory, 1)
    return [
        f"Exponent of the fit's time between neighbouring sizes ({sizes} spots): {exponents(seconds)}; where only one "
        f"fit was made its time is taken less {compiling:.0f} s of compilation (median of the others).",
        f"Exponent of the peak memory: {exponents(memory)}; {extra[1]:.0f} MiB and {1024 * extra[0]:.1f} KiB a spot.",
    ]
