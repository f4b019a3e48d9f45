"""Does `fit --quick` answer on benches that share nothing with the package, and do its intervals hold the truth?

    python -m experiments.intervals.strangers run --n 300 --cores 0 1           # half a CPU minute each, resumable
    python -m experiments.intervals.strangers run --folder DIR                  # benches somebody else made
    python -m experiments.intervals.strangers table > experiments/intervals/strangers.md

`run` draws bench i of a seed (`strange_bench`: other optics, cameras, lenses, gears and noise; a stereo calibration
that OpenCV made of noisy corners), writes its files and does what their owner would: `import` of the table, `stereo
--import` of the calibration (or, for a third of the benches, `tvsbayes`' own calibration of the same corners, with its
covariance), `fit --quick`. A folder holds benches as folders with `looks.csv`, `rig_stereo.yml` and `truth.json`; one
whose truth states no `approach` came from the left and from below.

CPU is in imports: over that of importing jax, optimistix and scipy.stats in the same run. z is the standard normal
quantile of the posterior probability above the truth (probability integral transform: Gneiting et al., J. R. Stat.
Soc. B 69 (2007) 243): normal for right posteriors of any shape, which (mean - truth) / sd of a play near zero is not.
The truth: least-squares slopes of the true azimuth and elevation of the beam on the counters of the looks seen;
contrasts are 0.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy import special

from experiments.common.against_truth import NOTE, USABLE, failures, rms, table
from experiments.common.command_line import study
from experiments.common.commands import document_of, import_cpu_s
from experiments.common.page import heading, line
from experiments.common.rows import commit
from experiments.intervals.strange_bench import AXES, SIDES, Bench, Calibration, bench

KEYS = ("seed", "folder", "bench")
APPROACH = {"pan": "left", "tilt": "up"}
RATIO, CONTRAST = "effective_deg_per_step", "effective_contrast_deg_per_step"
ANSWERS = (*USABLE, "laplace", "not converged", "refused")
FEW = 60
"""Looks below which a bench counts as small."""
CLASSES: dict[str, Callable[[dict], bool]] = {
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
    made = [document_of("import", files / "looks.csv", "--to", campaign, "--yes", *sides)]
    if drawn is not None and drawn.traits.covariance:
        write_calibration(drawn.calibration, drawn.rig.left.size, campaign / "stereo.json")
    else:
        made.append(document_of("stereo", "--import", files / "rig_stereo.yml", "-o", campaign / "stereo.json"))
    for document in made:
        if document["exit"]:
            raise RuntimeError(json.dumps(document.get("error")))


def one_bench(task: tuple[int | None, str | None, str]) -> dict:
    """One bench, from its files to its headlines; whatever fails is recorded as a failure."""
    seed, folder, name = task
    row = {**dict(zip(KEYS, task, strict=True)), "commit": commit(), "answer": "refused", "problems": []}
    with TemporaryDirectory() as place:
        drawn = None if seed is None else bench(seed, int(name))
        files = Path(place) / "bench" if folder is None else Path(folder) / name
        row |= {"covariance": False} if drawn is None else asdict(drawn.traits)
        if drawn is not None:
            drawn.write(files)
        truth = json.loads((files / "truth.json").read_text())
        approach, looks = truth.get("approach", APPROACH), looks_seen(files / "looks.csv")
        row |= {"homing_recorded": "unknown" not in approach.values(), "look_scatter": truth["look_scatter"]}
        try:
            campaign_of(files, drawn, approach, Path(place) / "campaign")
            row |= {"looks": looks, "import_cpu_s": import_cpu_s()}
            began = os.times()
            document = document_of("fit", Path(place) / "campaign", "--quick")
            row |= {"cpu_s": sum(os.times()[:4]) - sum(began[:4]), **answer_of(document)}
            row["headlines"] = headlines_of(document, truth, Path(place) / "campaign")
        except Exception as error:
            row |= {"looks": looks, "problems": [*row["problems"], repr(error)]}
    return row


def looks_seen(table: Path) -> int:
    """Rows with centroids in both images."""
    return sum(all(row.split(",")[-4:]) for row in table.read_text().splitlines()[1:])


def answer_of(document: dict) -> dict:
    """A fit's answer, and the diagnostics of importance sampling."""
    importance, error = (document.get("sampling") or {}).get("importance") or {}, document.get("error") or {}
    answer = document.get("answer") if "estimator" in document else "refused"
    if answer in USABLE and not document["converged"]:
        answer = "not converged"
    row = {"answer": answer, "tier": document.get("tier"), "pareto_k": importance.get("pareto_k")}
    row["effective"] = importance["effective_share"] * importance["draws"] if importance else None
    said = [error["message"]] if error else []
    return row | {"problems": importance.get("missing") or document.get("problems") or said}


def headlines_of(document: dict, truth: dict, campaign: Path) -> dict[str, dict[str, float]]:
    """PIT, z, contraction and whether the 95 % interval holds the truth, of every headline that the fit states."""
    from tvsbayes.pipeline import load_posterior

    draws, found = load_posterior(campaign, anyway=True), {}
    true = {f"{RATIO}.{side}": truth[RATIO][axis] for axis in AXES for side in SIDES[axis].values()}
    true |= {f"{CONTRAST}.{axis}": 0.0 for axis in AXES}
    true |= {f"backlash_deg.{axis}": truth["backlash_deg"][axis] for axis in AXES}
    for name, value in {**true, "effective_mirror_offset_mm": truth["mirror_offset_mm"]}.items():
        block, _, part = name.partition(".")
        place = document.get(block, {}).get(part) if block in (RATIO, CONTRAST) else document["parameters"].get(name)
        if place is not None and place["sd"] > 0:
            # Never zero or one: a draw more on each side.
            count, share = len(draws.weights), draws.weights @ (draws.by_name[name] < value)
            pit = float((count * share + 1) / (count + 2))
            held = place["interval95"][0] <= value <= place["interval95"][1]
            of = {"pit": pit, "z": -float(special.ndtri(pit)), "contraction": place["contraction"] or 0.0}
            found[name] = {**of, "held": bool(held)}
    return found


def spread(values: Sequence[float | None], form: str, worst: Callable = max) -> str:
    """Median and worst."""
    known = [value for value in values if value is not None]
    return f"{np.median(known):{form}}, {worst(known):{form}}" if known else ""


def classes(rows: Sequence[dict]) -> None:
    """How many were answered, how, and at what cost, by class."""
    print("Median and worst; CPU in imports. Coverage and RMS z: all headlines together, of those answered.\n")
    print(heading("class | benches | answered, %", *ANSWERS, "Pareto k | effective draws | CPU | 95 %, % | RMS z"))
    for name, chosen in CLASSES.items():
        if some := [row for row in rows if chosen(row)]:
            answered = [row for row in some if row["answer"] in USABLE]
            every = [each for row in answered for each in row["headlines"].values()]
            cells = [f"{100 * len(answered) / len(some):.1f}"]
            cells += [str(sum(row["answer"] == answer for row in some)) for answer in ANSWERS]
            cells += [spread([row.get("pareto_k") for row in some], ".2f")]
            cells += [spread([row.get("effective") for row in some], ".0f", min)]
            cells += [spread([row["cpu_s"] / row["import_cpu_s"] for row in some if "cpu_s" in row], ".1f")]
            cells += [f"{100 * np.mean([each['held'] for each in every]):.1f}"] if every else [""]
            print(line(name, len(some), *cells, f"{rms([each['z'] for each in every]):.2f}" if every else ""))
    print()


def tasks(of: argparse.Namespace) -> list[tuple]:
    """Drawn benches, or those of a folder."""
    if of.folder is None:
        return [(of.seed, None, str(number)) for number in range(of.n)]
    place = of.folder.resolve()
    return [(None, str(place), file.parent.name) for file in sorted(place.glob("*/truth.json"))]


def page(rows: list[dict]) -> None:
    print("# Benches that share nothing with the package\n")
    print(f"Written by `python -m experiments.intervals.strangers table`. {NOTE}.\n")
    for folder in dict.fromkeys(row["folder"] for row in rows):
        mine = [row for row in rows if row["folder"] == folder]
        print(f"## {len(mine)} {'drawn benches' if folder is None else f'benches of {Path(folder).name}'}\n")
        classes(mine)
        if folder is None and len(mine) > FEW:
            print("These benches differ from what the prior expects: both directions have one ratio, so that the true")
            print("contrast is 0, and a play varies by at most 0.02 deg. Where the prior decides, intervals are wider")
            print("than they need.\n")
        stated = [row for row in mine if "headlines" in row]
        answered = [row["headlines"] for row in stated if row["answer"] in USABLE]
        table({"answered": answered, "all that state numbers": [row["headlines"] for row in stated]})
        failures(mine, KEYS, ("accepted",))


if __name__ == "__main__":
    options = {"--seed": {"type": int, "default": 0, "help": "of the benches (%(default)s)"}}
    options["--folder"] = {"type": Path, "help": "benches of somebody else, instead of drawn ones"}
    study(__file__, __doc__, one_bench, KEYS, tasks, page, 300, options)
