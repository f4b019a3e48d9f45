"""Does `fit --quick` answer on benches that share nothing with the package, and do its intervals hold the truth?

    python -m experiments.intervals.strangers run --n 300 --jobs 2              # half a CPU minute each, resumable
    python -m experiments.intervals.strangers run --folder DIR                  # benches somebody else made
    python -m experiments.intervals.strangers page > experiments/intervals/strangers.md

`run` draws bench i of a seed (`strange_bench`: other optics, cameras, lenses, gears and noise; a stereo calibration
that OpenCV made of noisy corners), writes its files and does what their owner would: `import` of the table, `stereo
--import` of the calibration (or, for a third of the benches, `tvsbayes`' own calibration of the same corners, with its
covariance), `fit --quick`. A folder holds benches as folders with `looks.csv`, `rig_stereo.yml` and `truth.json`; one
whose truth states no `approach` came from the left and from below.

`page` prints the share that was answered (sampled: accepted or rough) and accepted by importance sampling, coverage of
the 95 % intervals and RMS z of every headline with two-sided bounds at 1e-4 for that number of benches, and CPU seconds
over those of importing jax, optimistix and scipy.stats in the same run. z is the standard normal quantile of the
posterior probability above the truth (probability integral transform: Gneiting et al., J. R. Stat. Soc. B 69 (2007)
243): normal for right posteriors of any shape, which (mean - truth) / sd of a play near zero is not. The truth:
least-squares slopes of the true azimuth and elevation of the beam on the counters of the looks seen; contrasts are 0.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy import special

from experiments.common.command_line import act, parser
from experiments.common.headlines import SHRINK, marked
from experiments.common.page import heading, line
from experiments.common.rows import commit, read_rows, rows_of, run_rows
from experiments.intervals.strange_bench import AXES, SIDES, Bench, Calibration, bench
from tvsbayes.statistics.chances import BOUND, binomial_bounds, rms_bounds

KEYS = ("seed", "folder", "bench")
APPROACH = {"pan": "left", "tilt": "up"}
RATIO, CONTRAST = "effective_deg_per_step", "effective_contrast_deg_per_step"
HEADLINES = (
    *(f"{RATIO}.{side}" for axis in AXES for side in SIDES[axis].values()),
    *(f"{CONTRAST}.{axis}" for axis in AXES),
    *(f"backlash_deg.{axis}" for axis in AXES),
    "effective_mirror_offset_mm",
)
IMPORTS = "import jax, optimistix, scipy.stats"
ANSWERED = ("accepted", "rough")
ANSWERS = (*ANSWERED, "laplace", "not converged", "refused")
FEW = 60
"""Looks below which a bench counts as small."""
Row = dict
CLASSES: dict[str, Callable[[Row], bool]] = {
    "all": lambda row: True,
    "covariance": lambda row: row["covariance"],
    "no covariance": lambda row: not row["covariance"],
    "homing recorded": lambda row: row["homing_recorded"],
    "homing not recorded": lambda row: not row["homing_recorded"],
    "look scatter": lambda row: row["look_scatter"],
    "no look scatter": lambda row: not row["look_scatter"],
    f"fewer than {FEW} looks": lambda row: row["looks"] < FEW,
    f"{FEW} looks and more": lambda row: row["looks"] >= FEW,
}


def cpu_s() -> float:
    """CPU seconds of this process and of those it waited for."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


@cache
def import_cpu_s() -> float:
    """CPU seconds of importing JAX, optimistix and scipy.stats in a process of their own, least of two."""
    spent = []
    for _ in range(2):
        start = cpu_s()
        subprocess.run([sys.executable, "-c", IMPORTS], check=True)
        spent.append(cpu_s() - start)
    return min(spent)


def tvsbayes(*words: object) -> dict:
    """The JSON document of a command, with its exit code under "exit"."""
    # Here: it brings typer, which the page does without.
    from experiments.common.console import quietly

    code, out, _ = quietly(*map(str, words), "--json")
    return {**json.loads(out), "exit": code}


def write_calibration(data: Calibration, size: tuple[int, int], file: Path) -> None:
    """`stereo.json` with the covariance that the package's own calibration of the corners states."""
    from tvsbayes.cameras.boards import Board, View
    from tvsbayes.cameras.stereo_calibration import calibrate_stereo
    from tvsbayes.instrument.stereo_pair import stereo_bytes

    views = [View(f"{i:02d}", left, right) for i, (left, right) in enumerate(zip(*data.corners, strict=True))]
    file.write_bytes(stereo_bytes(calibrate_stereo(views, Board(*data.board), size, fix_k3=data.fix_k3).stereo))


def campaign_of(files: Path, drawn: Bench | None, approach: dict[str, str], campaign: Path) -> None:
    """The campaign that the owner of a bench makes of its files."""
    sides = [word for axis in AXES for word in (f"--{axis}-approach", approach[axis])]
    _demand(tvsbayes("import", files / "looks.csv", "--to", campaign, "--yes", *sides))
    if drawn is not None and drawn.traits.covariance:
        write_calibration(drawn.calibration, drawn.rig.left.size, campaign / "stereo.json")
    else:
        _demand(tvsbayes("stereo", "--import", files / "rig_stereo.yml", "-o", campaign / "stereo.json"))


def _demand(document: dict) -> None:
    if document["exit"]:
        raise RuntimeError(json.dumps(document.get("error")))


def one_bench(task: tuple[int | None, str | None, str]) -> Row:
    """One bench, from its files to its headlines; whatever fails is recorded as a failure."""
    seed, folder, name = task
    row: Row = dict(zip(KEYS, task, strict=True)) | {"commit": commit(), "answer": "refused"}
    with TemporaryDirectory() as place:
        drawn = None if seed is None else bench(seed, int(name))
        files = Path(place) / "bench" if folder is None else Path(folder) / name
        if drawn is None:
            row |= {"covariance": False}
        else:
            drawn.write(files)
            row |= asdict(drawn.traits)
        truth = json.loads((files / "truth.json").read_text())
        approach = truth.get("approach", APPROACH)
        row |= {"homing_recorded": "unknown" not in approach.values(), "look_scatter": truth["look_scatter"]}
        row |= {"looks": _looks_seen(files / "looks.csv")}
        try:
            campaign_of(files, drawn, approach, Path(place) / "campaign")
            row["import_cpu_s"], start = import_cpu_s(), cpu_s()
            document = tvsbayes("fit", Path(place) / "campaign", "--quick")
            row |= {"cpu_s": cpu_s() - start, "exit": document["exit"]}
            row |= answer_of(document) | {"headlines": headlines_of(document, truth)}
            for name, below in chances_below(Path(place) / "campaign", row["headlines"]).items():
                row["headlines"][name]["below_truth"] = below
        except Exception as error:
            row["problems"] = [repr(error)]
    return row


def _looks_seen(table: Path) -> int:
    """Rows with centroids in both images."""
    return sum(all(line.split(",")[-4:]) for line in table.read_text().splitlines()[1:])


def answer_of(document: dict) -> Row:
    """A fit's answer, and the diagnostics of importance sampling."""
    sampling = document.get("sampling") or {}
    error = document.get("error") or {}
    importance = sampling.get("importance") or {}
    answer = document.get("answer")
    if "estimator" not in document:
        answer = "refused"
    elif answer is None:
        # Releases before 0.3 state no answer.
        posterior = document["estimator"] == "posterior"
        answer = "accepted" if posterior else "laplace" if sampling else "not converged"
    elif not document["converged"] and answer in ANSWERED:
        answer = "not converged"
    row = {"answer": answer, "tier": document.get("tier"), "converged": document.get("converged")}
    row |= {key: importance.get(key) for key in ("pareto_k", "draws", "heaviest_share")}
    row["effective"] = importance["effective_share"] * importance["draws"] if importance else None
    row["least_ess"] = (importance.get("least_ess") or {}).get("value")
    said = [error["message"]] if error else []
    return row | {"problems": importance.get("missing") or document.get("problems") or said}


def headlines_of(document: dict, truth: dict) -> dict[str, dict[str, float | None]]:
    """Value, sd, ends of the 95 % interval, contraction and truth of every headline that the fit states."""
    true: dict[str, float] = {f"{RATIO}.{s}": truth[RATIO][axis] for axis in AXES for s in SIDES[axis].values()}
    true |= {f"{CONTRAST}.{axis}": 0.0 for axis in AXES}
    true |= {f"backlash_deg.{axis}": truth["backlash_deg"][axis] for axis in AXES}
    true["effective_mirror_offset_mm"] = truth["mirror_offset_mm"]
    lines = {}
    for name in HEADLINES:
        block, _, part = name.partition(".")
        place = document.get(block, {}).get(part) if block in (RATIO, CONTRAST) else document["parameters"].get(name)
        if place is not None:
            low, high = place["interval95"]
            stated = {key: place[key] for key in ("value", "sd", "contraction")}
            lines[name] = stated | {"low": low, "high": high, "truth": true[name]}
    return lines


def chances_below(campaign: Path, headlines: dict[str, dict]) -> dict[str, float]:
    """Share of the posterior below the truth of every headline, never zero or one: a draw more on each side."""
    from tvsbayes.pipeline import load_posterior

    draws = load_posterior(campaign, anyway=True)
    count = len(draws.weights)
    below = {name: draws.weights @ (draws.by_name[name] < entry["truth"]) for name, entry in headlines.items()}
    return {name: float((count * share + 1) / (count + 2)) for name, share in below.items()}


def judged(rows: Sequence[Row], name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """z, whether the interval holds the truth, and contraction, each (benches that state the headline,)."""
    each = [row["headlines"][name] for row in rows if name in row.get("headlines", {})]
    z = -special.ndtri([e["below_truth"] for e in each if e["sd"] > 0])
    held = np.array([e["low"] <= e["truth"] <= e["high"] for e in each if e["sd"] > 0], float)
    return z, held, np.array([e["contraction"] or 0.0 for e in each if e["sd"] > 0])


def coverage(rows: Sequence[Row]) -> None:
    """RMS z and coverage of every headline."""
    print(heading("headline | benches | RMS z | bounds | 95 %, % | bounds | median contraction"))
    shrunk_out = 0
    for name in HEADLINES:
        z, held, contraction = judged(rows, name)
        if not len(z):
            continue
        (low, high), (least, most) = rms_bounds(len(z)), binomial_bounds(len(z), 0.95)
        rms, share = float(np.sqrt(np.mean(z**2))), float(held.mean())
        shrunk_out += not low <= rms / SHRINK <= high
        cells = [name, str(len(z)), marked(f"{rms:.2f}", low <= rms <= high), f"{low:.2f}-{high:.2f}"]
        cells += [marked(f"{100 * share:.1f}", least <= share <= most), f"{100 * least:.0f}-{100 * most:.0f}"]
        print(f"| {' | '.join(cells)} | {np.median(contraction):.2f} |")
    print(f"\nWith sds multiplied by {SHRINK}, RMS z of {shrunk_out} of {len(HEADLINES)} headlines is outside.\n")


def _of(rows: Sequence[Row], key: str) -> np.ndarray:
    """The values of a key where a row has one."""
    return np.array([row[key] for row in rows if row.get(key) is not None], float)


def _cell(values: np.ndarray, form: str, worst: Callable = np.max) -> str:
    """Median and worst."""
    return f"{np.median(values):{form}}, {worst(values):{form}}" if len(values) else ""


def classes(rows: Sequence[Row]) -> None:
    """How many were answered, how, and at what cost, by class."""
    print("Median and worst; CPU in seconds and over those of the imports. Coverage and RMS z: all headlines together,")
    print("of the benches that were answered.\n")
    counted = ("class | benches | answered, % | accepted by tier 1, %", *ANSWERS, "Pareto k | effective draws")
    print(heading(*counted, "CPU s | CPU / imports | 95 %, % | RMS z"))
    for name, chosen in CLASSES.items():
        some = [row for row in rows if chosen(row)]
        if not some:
            continue
        counts = [sum(row["answer"] == answer for row in some) for answer in ANSWERS]
        first = sum(row["answer"] == "accepted" and row["tier"] == "importance" for row in some)
        cells = [name, str(len(some)), f"{100 * sum(counts[:2]) / len(some):.1f}", f"{100 * first / len(some):.1f}"]
        cells += [*map(str, counts), _cell(_of(some, "pareto_k"), ".2f"), _cell(_of(some, "effective"), ".0f", np.min)]
        timed = [row for row in some if "cpu_s" in row]
        multiples = np.array([row["cpu_s"] / row["import_cpu_s"] for row in timed])
        cells += [_cell(_of(timed, "cpu_s"), ".1f"), _cell(multiples, ".1f")]
        parts = [judged([row for row in some if row["answer"] in ANSWERED], headline)[:2] for headline in HEADLINES]
        z, held = (np.concatenate(part) for part in zip(*parts, strict=True))
        cells += [f"{100 * held.mean():.1f}", f"{np.sqrt(np.mean(z**2)):.2f}"] if len(z) else ["", ""]
        print(line(*cells))
    print()


def cost_of_unrecorded_homings(rows: Sequence[Row]) -> None:
    """CPU time without recorded homings over that with them, at equal numbers of looks."""
    timed = [row for row in rows if "cpu_s" in row]
    unrecorded = np.array([not row["homing_recorded"] for row in timed], float)
    looks = np.log(_of(timed, "looks"))
    design = np.stack([np.ones(len(timed)), looks - looks.mean(), unrecorded], axis=1)
    y = np.log(_of(timed, "cpu_s"))
    solution, (square,), *_ = np.linalg.lstsq(design, y)
    sd = np.sqrt(np.linalg.inv(design.T @ design)[2, 2] * square / (len(timed) - 3))
    low, middle, high = np.exp(solution[2] + np.array([-2, 0, 2]) * sd)
    print("Benches without recorded homings have other numbers of looks. Least squares of ln CPU on ln looks and on")
    print(f"whether homings were recorded: without, {middle:.2f} times the CPU time ({low:.2f} to {high:.2f}, 2 sd).\n")


def listed(rows: Sequence[Row]) -> None:
    """Benches one by one: answer, draws, cost, and the headline furthest from its truth."""
    titles = "bench | looks | answer | Pareto k | effective of draws | heaviest, % | CPU s | furthest headline | z"
    print(heading(titles, "problems"))
    for row in rows:
        z = {name: (e["value"] - e["truth"]) / e["sd"] for name, e in row.get("headlines", {}).items() if e["sd"]}
        furthest = max(z, key=lambda name: abs(z[name]), default="")
        sampled = row.get("draws") is not None
        cells = [row["bench"], str(row["looks"]), row["answer"], f"{row['pareto_k']:.2f}" if sampled else ""]
        cells += [f"{row['effective']:.0f} of {row['draws']}", f"{100 * row['heaviest_share']:.1f}"] * sampled
        cells += ["", ""] * (not sampled)
        cells += [f"{row['cpu_s']:.1f}" if "cpu_s" in row else "", furthest, f"{z[furthest]:+.1f}" if z else ""]
        print(f"| {' | '.join(cells)} | {'; '.join(row.get('problems', []))} |".replace("\n", " "))
    print()


def run(arguments: argparse.Namespace) -> None:
    """Drawn benches, or those of a folder."""
    if arguments.folder is None:
        tasks = [(arguments.seed, None, str(i)) for i in range(arguments.n)]
    else:
        place = arguments.folder.resolve()
        tasks = [(None, str(place), file.parent.name) for file in sorted(place.glob("*/truth.json"))]
    run_rows(one_bench, tasks, arguments.rows, KEYS, range(arguments.jobs))


def page(arguments: argparse.Namespace) -> None:
    """The page."""
    rows = read_rows(arguments.rows)
    drawn, other = ([row for row in rows if (row["folder"] is None) == part] for part in (True, False))
    print("# Benches that share nothing with the package\n")
    print("Written by `python -m experiments.intervals.strangers page`; what is in it and how it was made stands in")
    print(f"the script. **!** marks a figure outside its two-sided bounds at {BOUND:.0e} for that number of benches.\n")
    if drawn:
        print(f"## {len(drawn)} drawn benches\n")
        classes(drawn)
        cost_of_unrecorded_homings(drawn)
        answered = [row for row in drawn if row["answer"] in ANSWERED]
        print(f"### Headlines of the {len(answered)} that were answered\n")
        coverage(answered)
        print("These benches differ from what the prior expects: both directions have one ratio, so that the true")
        print("contrast is 0, and a play varies by at most 0.02 deg. Where the prior decides, intervals are wider than")
        print("they need.\n")
        print("### Headlines of all that state numbers, Laplace approximations among them\n")
        coverage(drawn)
        print("### Not accepted\n")
        listed([row for row in drawn if row["answer"] != "accepted"])
    for folder in dict.fromkeys(row["folder"] for row in other):
        part = [row for row in other if row["folder"] == folder]
        print(f"## {len(part)} benches of a folder, {Path(folder).name}\n")
        listed(part)
        coverage(part)


if __name__ == "__main__":
    cli = parser(__doc__, run=run, page=page)
    cli.add_argument("--n", type=int, default=300, help="how many (%(default)s)")
    cli.add_argument("--seed", type=int, default=0, help="of the benches (%(default)s)")
    cli.add_argument("--jobs", type=int, default=1, help="processes, each pinned to a core (%(default)s)")
    cli.add_argument("--folder", type=Path, help="benches of somebody else, instead of drawn ones")
    cli.add_argument("--rows", type=Path, default=rows_of(__file__), help="file of rows (%(default)s)")
    act(cli)
