"""What does 0.3.0 have, cost and hold beside 0.2.0?

    python -m experiments.speed.releases measure     # both in the same minutes, a quiet machine, some 8 minutes
    python -m experiments.speed.releases table > experiments/speed/releases.md

Both trees run the same commands in turn, as processes from warm caches, in the environment of this tree: least CPU
seconds of three. Lines, modules and tests are counted in both trees; coverage is that of the ledger's last
entry, a fixed small set, and that of the pages.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

from experiments.common.command_line import act, parser
from experiments.common.releases import BEFORE, NAME_BEFORE, environment_of, tree_before
from experiments.common.rows import OUTPUT, ROOT
from experiments.speed import ledger
from experiments.speed.benchmarks.measure import command_cost, cpu_model, state

MEASURED = OUTPUT / "releases.json"
FEATURES = (
    ("answers", "accepted or NOT CONVERGED", "accepted, rough or laplace, by the Monte Carlo error of every headline"),
    ("zeros in time", "random walk", "creep, temperature, scatter of looks"),
    (
        "waves of gears",
        "scanner: stated periods",
        "axis and scanner: amplitude, phase, probability; axis: unknown periods",
    ),
    ("controllers", "C header", "LinuxCNC, GRBL, grblHAL, Klipper, CSV, URDF, PEC with a promise; `verify`"),
    ("mechanisms", "scanner, one axis", "also pan-tilt heads and mounts"),
    (
        "foreign files",
        "OpenCV, ROS, Kalibr",
        "also EuRoC, ORB-SLAM3, MATLAB, TOML, makers of cameras; ChArUco; PHD2, EPICS, Klipper",
    ),
    ("stereo without a covariance", "1 % and 10 mrad, independent", "the covariance of such a calibration"),
    ("mistakes in tables", "warned of", "those that are certain stop `fit` and name the command that mends them"),
    ("view", "a server", "one HTML file"),
)
"""Of both versions, in words."""


def _counted(tree: Path) -> dict[str, int]:
    """Lines of Python and modules of a tree, and how many tests run by default."""
    counted = {f"lines of {folder}/": ledger.lines(tree / folder) for folder in ("tvsbayes", "tests", "experiments")}
    counted["modules of tvsbayes/"] = sum(path.name != "__init__.py" for path in (tree / "tvsbayes").rglob("*.py"))
    words = (sys.executable, "-m", "pytest", "--collect-only", "-q", "-n0")
    environment = {**os.environ, "PYTHONPATH": str(tree)}
    done = subprocess.run(words, cwd=tree, env=environment, capture_output=True, text=True, check=True)
    counted["default tests"] = int(re.findall(r"^(\d+)(?:/\d+)? tests", done.stdout, flags=re.MULTILINE)[-1])
    return counted


def measure(_: argparse.Namespace) -> None:
    """Both trees in turn."""
    with tempfile.TemporaryDirectory() as place, tree_before(Path(place) / "before") as before:
        folder, trees = Path(place), {NAME_BEFORE: before, state(): ROOT}
        shutil.copytree(ROOT / "data" / "twins" / "paper_twin", folder / "twin")
        ledger.write_axis(folder)
        costs: dict[str, dict[str, list[float]]] = {name: {} for name in trees}
        for _repeat in range(ledger.REPEATS + 1):
            for name, tree in trees.items():
                environment = environment_of(tree, folder / f"cache {tree.name}")
                for command, words in ledger.COMMANDS.items():
                    line = ("/usr/bin/env", "-C", str(folder), sys.executable, "-m", "tvsbayes", *words)
                    cost = command_cost(line, environment)[1]["cpu_s"]
                    costs[name].setdefault(command, []).append(cost)
        # The first run of each fills its cache.
        least = {name: {command: min(each[1:]) for command, each in of.items()} for name, of in costs.items()}
        counted = {name: _counted(tree) for name, tree in trees.items()}
    MEASURED.parent.mkdir(parents=True, exist_ok=True)
    MEASURED.write_text(json.dumps({"processor": cpu_model(), "cpu_s": least, "counted": counted}, indent=1))


def _compared(what: Mapping[str, Mapping[str, float]], form: str) -> None:
    before, after = what.values()
    for name, value in before.items():
        print(f"| {name} | {value:{form}} | {after[name]:{form}} |")


def table(_: argparse.Namespace) -> None:
    """The page."""
    measured = json.loads(MEASURED.read_text())
    after = list(measured["cpu_s"])[1]
    entry = ledger.read_rows(ledger.LEDGER)[-1]
    print("# 0.2.0 beside 0.3.0\n\n`python -m experiments.speed.releases measure`, then `table`; 0.2.0 is commit")
    print(f"{BEFORE}, 0.3.0 commit {after}; {measured['processor']}. More:")
    print("[changes](../../CHANGELOG.md), [experiments](../README.md).\n")
    print("| | 0.2.0 | 0.3.0 |\n|---|---|---|")
    for row in FEATURES:
        print(f"| {' | '.join(row)} |")
    print("\nLeast CPU seconds of three, paper twin and a simulated axis of 60 readings:\n")
    print("| command | 0.2.0 | 0.3.0 |\n|---|---|---|")
    _compared(measured["cpu_s"], ".2f")
    print("\n| size | 0.2.0 | 0.3.0 |\n|---|---|---|")
    _compared(measured["counted"], "d")
    print(f"\nCoverage on the ledger's fixed small set ({entry['commit']}), answered, and 95 % intervals that hold:\n")
    for name, counts in entry["intervals"].items():
        print("- {answered} of {drawn} {name}, {held} of {intervals} intervals;".format(name=name, **counts))
    print("- more: [strangers](../intervals/strangers.md), [posterior](../intervals/posterior_coverage.md).")


if __name__ == "__main__":
    act(parser(__doc__, measure=measure, table=table))
