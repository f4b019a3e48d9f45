"""A million points with error bars: points per second and peak memory of `locate --cloud`, beside one call a point.

    python -m experiments.speed.cloud_speed > experiments/speed/cloud_speed.md        (3 minutes)

The paper twin is fitted once by `fit --no-sample`. Drawn looks lie all over its counters. The command runs in a process
of its own, from start to end; its memory is the largest resident set. Peer: `load_calibration(...).locate`, one look at
a time, which gives the law of propagation without the other calibrations and without a file.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from experiments.common.command_line import print_only
from experiments.common.page import heading
from experiments.speed.benchmarks.measure import command_cost
from tvsbayes.coordinates.looks_file import LOOKS
from tvsbayes.files.disk import shipped_data
from tvsbayes.pipeline import load_calibration

SIZES = 1_000, 100_000, 1_000_000
SINGLE = 2_000
READINGS_DEG = 60.0, 85.0


def command(*words: object) -> list[str]:
    """The program in a process of its own."""
    return [sys.executable, "-m", "tvsbayes", *map(str, words)]


def write_looks(place: Path, calibration, count: int) -> None:
    """Counters within those seen, from either side."""
    generator = np.random.default_rng(count)
    low, high = calibration.range_steps.T
    with open(place, "w") as stream:
        stream.write(",".join(LOOKS.required) + "\n")
        for begin in range(0, count, 100_000):
            size = min(100_000, count - begin)
            pan, tilt = np.round(low + generator.uniform(size=(size, 2)) * (high - low)).T
            sides = generator.integers(0, 2, (size, 2))
            readings = generator.uniform(*READINGS_DEG, size)
            for n, m, (one, other), b in zip(pan, tilt, sides, readings, strict=True):
                stream.write(f"{n:.0f},{m:.0f},{('left', 'right')[one]},{('up', 'down')[other]},{b:.4f}\n")


def main() -> None:
    """Print the page."""
    print_only(__doc__)
    with tempfile.TemporaryDirectory() as folder:
        campaign = shutil.copytree(shipped_data() / "twins" / "paper_twin", Path(folder) / "campaign")
        command_cost(command("fit", campaign, "--no-sample"))
        calibration = load_calibration(campaign)
        print("# A million points with error bars\n")
        print("Written by `python -m experiments.speed.cloud_speed`; paper twin, two cores.\n")
        print(heading("points | file | CPU s of the whole command | points a CPU second | peak memory, MB"))
        for count in SIZES:
            looks = Path(folder) / f"looks{count}.csv"
            write_looks(looks, calibration, count)
            for ending in ("ply", "csv"):
                out = Path(folder) / f"cloud.{ending}"
                _, cost = command_cost(command("locate", campaign, "--points", looks, "--cloud", out))
                cpu_s, rss_mib = cost["cpu_s"], cost["rss_mib"]
                print(f"| {count} | {ending} | {cpu_s:.1f} | {count / cpu_s:.0f} | {rss_mib:.0f} |", flush=True)
                out.unlink()
        generator = np.random.default_rng(1)
        low, high = calibration.range_steps.T
        steps = np.round(low + generator.uniform(size=(SINGLE, 2)) * (high - low)).tolist()
        began = time.process_time()
        for pan, tilt in steps:
            calibration.locate(pan, tilt, 70.0)
        single_s = time.process_time() - began
        print(f"\nOne call a point, `load_calibration(...).locate`: {SINGLE / single_s:.0f} points a CPU second.")


if __name__ == "__main__":
    main()
