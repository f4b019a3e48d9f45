"""How fast, how exact and how large is tvsbayes beside its peers?

    taskset -c 0 python -m experiments.speed.benchmarks run --parts spots stereo     # the compared code
    python -m experiments.speed.benchmarks run --parts commands scaling                # as users start them
    python -m experiments.speed.benchmarks table > experiments/speed/benchmarks.md

Contenders of a part take turns, each once per repeat, and who goes first moves on with every repeat: whatever else the
machine does hits all alike. A ratio is taken within a repeat and its median over the repeats is what is printed.
Compared code runs on one thread. Rows that are there are not made again; `--rows` names another file for another state
of the package. The peers come with `pip install -c .ci/constraints.txt -e '.[bench,test]'`.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from experiments.common.clock import timed
from experiments.common.command_line import act, parser
from experiments.common.commands import IMPORTS, PROGRAM, measured
from experiments.common.page import heading, line
from experiments.common.rigs import mounted_rig, small_plan
from experiments.common.rows import append_row, commits_of, cpu_model, read_rows, rows_of, state
from experiments.speed import peers
from experiments.speed.peers import OURS, Work

UNIT = "import jax, optimistix, scipy.stats"


@dataclass(frozen=True)
class Part:
    """Contenders that do the same work.

    Attributes:
        title: of its section.
        about: what is done.
        columns: headings and forms of the values of a row, by their keys.
        contenders: all of them, the one that the others are compared with first.
        prepared: makes their works, in a temporary folder; each gets the number of the repeat and returns a row.
        ratio: key of the value that is also printed relative to that of the first; none if empty.
        repeats: turns of each contender, unless others are asked for.
    """

    title: str
    about: str
    columns: Mapping[str, tuple[str, str]]
    contenders: Sequence[str]
    prepared: Callable[[Path], Mapping[str, Work]]
    ratio: str = ""
    repeats: int = 5


POINT = ("--pan-steps", "169", "--tilt-steps", "46", "--aperture-deg", "63.4")
COMMANDS = {
    "--help": ("--help",),
    "check": ("check", "twin", "--json"),
    "classic": ("classic", "twin", "--json"),
    "fit --no-sample, cache empty": ("fit", "twin", "--no-sample", "--out", "out"),
    "fit --no-sample": ("fit", "twin", "--no-sample", "--out", "out"),
    "fit --quick": ("fit", "twin", "--quick", "--out", "out"),
    "fit": ("fit", "twin"),
    "demo": ("demo", "--json"),
    "plan": ("plan", "rig/rig.toml", "--json"),
    "locate": ("locate", "twin", *POINT, "--json"),
    "report": ("report", "twin", "--json"),
    "simulate --frames (48 looks)": ("simulate", "rig/rig.toml", "plan.csv", "frames", "--frames"),
    "detect (96 frames)": ("detect", "frames"),
}
"""In a folder with the paper twin; in this order, later ones read what earlier ones wrote."""


def commands(folder: Path) -> Mapping[str, Work]:
    from tvsbayes.files.disk import shipped_data
    from tvsbayes.instrument.plan import write_plan

    shutil.copytree(shipped_data() / "twins" / "paper_twin", folder / "twin")
    shutil.copytree(shipped_data() / "rigs" / "mounted", folder / "rig")
    write_plan(small_plan(("d1", "d2")), folder / "plan.csv")

    def work(name: str, _: int = 0) -> Mapping[str, object]:
        if name == UNIT:
            return measured(IMPORTS, cwd=folder)[1]
        with tempfile.TemporaryDirectory() as empty:
            kept = empty if name.endswith("cache empty") else str(folder / "cache")
            if name.startswith("simulate"):
                shutil.rmtree(folder / "frames", ignore_errors=True)
            variables = {"TVSBAYES_CACHE": kept}
            return measured([*PROGRAM, *COMMANDS[name]], cwd=folder, limit_s=1800.0, variables=variables)[1]

    # Fills the compilation cache.
    for name in COMMANDS:
        work(name)
    return {name: partial(work, name) for name in (UNIT, *COMMANDS)}


def scaling(folder: Path) -> Mapping[str, Work]:
    script = "import json, sys; from experiments.speed.benchmarks import one_size; "
    script += "print(json.dumps(one_size(int(sys.argv[1]))))"

    def work(spots: int, _: int) -> Mapping[str, object]:
        text, cost = measured([sys.executable, "-c", script, spots], limit_s=1800.0)
        return {**json.loads(text), "rss_mib": cost["rss_mib"]}

    return {f"{spots} spots": partial(work, spots) for spots in SIZES}


SIZES = (100, 1_000, 10_000)


def one_size(spots: int) -> dict[str, float]:
    """Wall clock of a mixed campaign of about this many spots: read, fitted, fitted again."""
    from tvsbayes.estimators.joint_fit import fit
    from tvsbayes.instrument.campaign import read_campaign, write_campaign
    from tvsbayes.instrument.protocols import mixed_protocol
    from tvsbayes.twin.simulated_campaign import simulate

    # Four spots an experiment, four directions.
    campaign = simulate(mounted_rig(), mixed_protocol(repeats=max(1, spots // 16)), seed=1).campaign
    with tempfile.TemporaryDirectory() as folder:
        write_campaign(campaign, Path(folder) / "c")
        jobs = {"reading": lambda: read_campaign(Path(folder) / "c"), "first": lambda: fit(campaign)}
        jobs["warm"] = jobs["first"]
        return {f"{name}_s": timed(job)[1]["wall_s"] for name, job in jobs.items()}


COST = {"wall_s": ("wall s", ".3g"), "cpu_s": ("CPU s", ".3g"), "rss_mib": ("peak memory, MiB", ".0f")}
PARTS = {
    "commands": Part("From process start", "The paper twin, 384 spots; compilation cache filled where nothing else is "
        "said.", COST, (UNIT, *COMMANDS), commands, "cpu_s"),
    "scaling": Part("The fit against the number of spots", "Mixed campaigns of the mounted rig, a process for each "
        "size; Laplace only. The first fit holds the compilation, which the shape of a campaign decides.",
        {"reading_s": ("read, s", ".3g"), "first_s": ("first fit, s", ".3g"), "warm_s": ("warm fit, s", ".3g"),
         "rss_mib": ("peak memory, MiB", ".0f")}, tuple(f"{n} spots" for n in SIZES), scaling, repeats=1),
    "spots": Part("Spot centres", "Rendered frames of 48 looks, 1280 x 720 px PNG. Error of one coordinate against the "
        "twin's true centre. From file to centre on one thread; ours hold safe reading, learning the noise, a "
        "covariance and the epipolar check. photutils has no finder for one laser spot: it is given our window around "
        "the spot less the median of its border, and for the fits the mask of clipped pixels.",
        {"ms": ("CPU ms per frame", ".3g"), "rms_px": ("rms error, px", ".4f"), "median_px": ("median error, px",
         ".4f"), "max_px": ("largest, px", ".3f"), "ok": ("centres of 96", ".0f")},
        (*peers.DETECT, peers.READ, *peers.PHOTUTILS), peers.spots, "ms"),
    "stereo": Part("Stereo calibration", "12 views of a 9 x 6 board, rendered; every repeat is another rig. From "
        "corners (found once, by `find_views`) to the calibration, compiled. Errors against the true rig: rms of all "
        "24 parameters in our stated standard uncertainties (1 is perfect), rms of the four focal lengths, baseline, "
        "and angle between the cameras. Ours also states the 24 x 24 covariance, which OpenCV does not.",
        {"cpu_s": ("CPU s", ".3g"), "rms_px": ("rms, px", ".4f"), "error_sds": ("error, stated sds", ".2f"),
         "focal_px": ("focal error, px", ".2f"), "baseline_mm": ("baseline error, mm", ".3f"),
         "rotation_mrad": ("rotation error, mrad", ".3f")},
        (OURS, peers.SEPARATE, peers.TOGETHER), peers.stereo, "cpu_s"),
}  # fmt: skip
AS_STARTED = ("commands", "scaling")
"""With as many threads as a user's process has; measured before this one is told to have one."""


def run(arguments: argparse.Namespace) -> None:
    """Every contender once per repeat, in turn; a row for each turn that is not there yet."""
    for name in sorted(arguments.parts, key=lambda name: name not in AS_STARTED):
        if name not in AS_STARTED:
            from tvsbayes.studies.executors import SINGLE_THREADED

            os.environ.update(SINGLE_THREADED)
        part, rows = PARTS[name], read_rows(arguments.rows)
        there = {(row["contender"], row["repeat"]) for row in rows if row["part"] == name}
        turns = [(k, n) for k in range(arguments.repeats or part.repeats) for n in range(len(part.contenders))]
        left = [(part.contenders[(k + n) % len(part.contenders)], k) for k, n in turns]
        left = [turn for turn in left if turn not in there]
        with tempfile.TemporaryDirectory() as folder:
            works = part.prepared(Path(folder)) if left else {}
            for contender, repeat in left:
                row = {"part": name, "contender": contender, "repeat": repeat, "commit": state()}
                row |= {"values": dict(works[contender](repeat)), "load": os.getloadavg()[0]}
                append_row(arguments.rows, row)
                print(name, contender, repeat, row["values"], flush=True)


def spread(values: Sequence[object], form: str) -> str:
    """Median, and quartiles in brackets where there is a spread; words as they are."""
    numbers = [value for value in values if isinstance(value, int | float)]
    if not numbers:
        return str(values[0]) if values else ""
    low, middle, high = (f"{value:{form}}" for value in np.quantile(numbers, [0.25, 0.5, 0.75]))
    return middle if low == middle == high else f"{middle} ({low} to {high})"


def table(arguments: argparse.Namespace) -> None:
    rows = read_rows(arguments.rows)
    print("# Benchmarks\n\nWritten by `python -m experiments.speed.benchmarks table` (`--help` says how).")
    print(f"{cpu_model()}, {os.cpu_count()} cores; commit {commits_of(rows)}; load average beside the rows", end=" ")
    print(f"{spread([row['load'] for row in rows], '.1f')}. Medians with quartiles; ratios are taken within a repeat.")
    for name, part in PARTS.items():
        of = {c: {} for c in part.contenders}
        for row in rows:
            if row["part"] == name:
                of[row["contender"]][row["repeat"]] = row["values"]
        if not any(of.values()):
            continue
        ours, relative = of[part.contenders[0]], f"{part.columns[part.ratio][0]}, relative" if part.ratio else ""
        print(f"\n## {part.title}\n\n{part.about}\n")
        print(heading("", *(title for title, _ in part.columns.values()), *[relative] * bool(part.ratio), "n"))
        for contender, turns in of.items():
            values = {key: [v[key] for v in turns.values() if key in v] for key in part.columns}
            cells = [spread(values[key], form) for key, (_, form) in part.columns.items()]
            if part.ratio:
                ratios = [turns[k][part.ratio] / ours[k][part.ratio] for k in turns if k in ours]
                cells.append(spread(ratios, ".3g") if contender != part.contenders[0] else "")
            print(line(contender, *cells, len(turns)))


if __name__ == "__main__":
    cli = parser(__doc__, run=run, table=table)
    cli.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS), help="default: all")
    cli.add_argument("--repeats", type=int, help="turns of each contender (5; 1 or 3 of costly parts)")
    cli.add_argument("--rows", type=Path, default=rows_of(__file__))
    act(cli)
