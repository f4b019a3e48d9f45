"""Time and memory of the fit against the number of spots, a process for each size."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from experiments.speed.benchmarks.measure import Bench, Case, Column, command_cost

TITLE = "The fit against the number of spots"
NAME = "Mixed campaigns of the mounted rig"


def one_size(spots: int) -> dict[str, float]:
    """Fit a mixed campaign of about this many spots."""
    from experiments.common.clock import seconds
    from experiments.common.rigs import mounted_rig
    from tvsbayes.estimators.joint_fit import fit
    from tvsbayes.instrument.campaign import read_campaign, write_campaign
    from tvsbayes.instrument.protocols import mixed_protocol
    from tvsbayes.twin.simulated_campaign import simulate

    # Four spots an experiment, four directions.
    campaign = simulate(mounted_rig(), mixed_protocol(repeats=max(1, spots // 16)), seed=1).campaign
    with tempfile.TemporaryDirectory() as folder:
        write_campaign(campaign, Path(folder) / "c")
        reading = seconds(lambda: read_campaign(Path(folder) / "c"))
    # The largest is fitted once: its compilation, which the smaller rows show, is small beside its run time.
    first = seconds(lambda: fit(campaign))
    warm = seconds(lambda: fit(campaign)) if spots < 10_000 else first
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"spots": len(campaign.spots), "reading_s": reading, "first_s": first, "warm_s": warm, "memory_mib": memory}


def measure(bench: Bench, sizes: Sequence[int], limit_s: float) -> None:
    """Once per size: one size takes from half a minute to many."""
    for spots in sizes:
        contender = f"{spots} asked"
        if 0 in bench.there(NAME, contender):
            continue
        command = (sys.executable, "-m", "experiments.speed.benchmarks", "--spots", str(spots))
        try:
            text, cost = command_cost(command, limit_s=limit_s)
        except subprocess.TimeoutExpired:
            print(f"scaling | {spots} spots: stopped after {limit_s:g} s", flush=True)
            bench.keep(NAME, contender, 0, {"spots": float(spots), "first_s": f"more than {limit_s:g}"})
            continue
        bench.keep(NAME, contender, 0, {**json.loads(text), "cpu_s": cost["cpu_s"], "rss_mib": cost["rss_mib"]})


def cases() -> list[Case]:
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
