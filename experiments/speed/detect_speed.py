"""How many frames a second does `detect` take, against only reading the same files?

    python -m experiments.speed.detect_speed CAMPAIGN > experiments/speed/detect_speed.md

CAMPAIGN is a folder with frames (`tvsbayes simulate RIG PLAN CAMPAIGN --frames`). In one process and one run, with the
same number of threads: `cv2.imread` of every frame, then the whole of `detect` (safe reading, finding, learning the
noise, fitting, epipolar check; no overlay), --turns (3) times in turn.
"""

from __future__ import annotations

import os
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np

from experiments.common.command_line import parser
from tvsbayes.cameras.detection import detect
from tvsbayes.instrument.campaign import read_campaign


def measure(folder: Path, turns: int) -> None:
    """Measure and print the table."""
    campaign = read_campaign(folder)
    paths = sorted(str(path) for path in (folder / "frames").glob("*.png"))
    megabytes = sum(os.path.getsize(path) for path in paths) / 1e6

    def reading(workers: int) -> None:
        with ThreadPoolExecutor(workers) as pool:
            assert all(picture is not None for picture in pool.map(cv2.imread, paths))

    jobs = {
        "cv2.imread": reading,
        "detect": lambda workers: detect(campaign, workers=workers),
    }
    cores, size = os.cpu_count() or 1, f"{campaign.stereo.image_width} x {campaign.stereo.image_height}"
    reading(cores)
    print(
        "# Frames per second of `detect`\n\n`python -m experiments.speed.detect_speed CAMPAIGN`: "
        f"{len(paths)} frames of {size} "
        f"px, {megabytes:.0f} MB of PNG in the file cache, OpenCV {cv2.__version__}, {cores} cores (load average "
        f"{os.getloadavg()[0]:.1f}); medians of {turns} runs in turn.\n"
    )
    print("| threads | what | frames/s (wall) | frames per CPU second |\n|---|---|---|---|")
    for workers in (cores, 1):
        runs: dict[str, list[tuple[float, float]]] = {name: [] for name in jobs}
        for _ in range(turns):
            for name, job in jobs.items():
                wall, cpu = time.perf_counter(), time.process_time()
                job(workers)
                runs[name].append((len(paths) / (time.perf_counter() - wall), len(paths) / (time.process_time() - cpu)))
        rates = {name: np.median(values, axis=0) for name, values in runs.items()}
        for name, (wall, cpu) in rates.items():
            print(f"| {workers} | `{name}` | {wall:.1f} | {cpu:.1f} |")
        share = rates["detect"] / rates["cv2.imread"]
        print(f"| {workers} | detect / imread | {share[0]:.2f} | {share[1]:.2f} |", flush=True)


def main() -> None:
    """Command line."""
    command = parser(__doc__)
    command.add_argument("campaign", type=Path)
    command.add_argument("--turns", type=int, default=3)
    arguments = command.parse_args()
    measure(arguments.campaign, arguments.turns)


if __name__ == "__main__":
    main()
