"""Does a fit come out as the plan predicts? Predicted sd against RMS error, and predicted assurance against a count.

    python -m experiments.planning.prediction designs              # searches the planned designs, two minutes
    python -m experiments.planning.prediction run --n 1000 --cores 0 1     # 7 s per campaign and core, resumable
    python -m experiments.planning.prediction table > experiments/planning/prediction.md

Four designs on the mounted rig: the paper's 96 experiments, the grid, and what `tvsbayes plan` recommends for its
default target with an assurance of 80 % (`n80`) and of 95 % (`n95`). Campaign i of a design is drawn with a seed of its
own, every prior quantity, simulated by the twin, fitted and sampled (as `tvsbayes study` does). Compared are: the
error of the estimate with the sd that the planner predicts AT that truth before any data (RMS of z, chi-square bounds
at 1e-4); with the sd that the fit reports; and the share of fits that report the target as met with the assurance that
the planner stated from its own draws (binomial bounds around the stated value, which has a Monte Carlo error itself).
The last column repeats the first comparison with the predicted sd times 0.8: it must fail, or the test could not.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from scipy import stats

from experiments.common.against_truth import SHRINK
from experiments.common.command_line import by_seed, study
from experiments.common.page import heading, line
from experiments.common.rigs import mounted_rig, shipped_plan
from experiments.common.rows import output
from tvsbayes.instrument.parameters import TARGETS
from tvsbayes.instrument.plan import read_plan, write_plan
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.planning.planner import plan
from tvsbayes.planning.target import DEFAULT_TARGET, parse_target
from tvsbayes.statistics.chances import binomial_bounds, rms_bounds, share_interval95
from tvsbayes.studies.rows import StudyRow
from tvsbayes.studies.study import StudyResult, study_result
from tvsbayes.studies.study_job import StudyJob, study_row

ROWS, DESIGNS = output(__file__, "prediction.jsonl"), output(__file__, "designs.json")
NAMES = ("paper", "grid", "n80", "n95")
KEYS = ("name", "index")
SEED = 2025
"""Of the campaigns; the planner's own draws have seed 0."""
DRAWS, END = 400, "bounds of the stated | verdict"


def design_file(name: str) -> Path:
    """The plan of a searched design."""
    return output(__file__, f"design_{name}.csv")


def designs(arguments: argparse.Namespace) -> None:
    """Search both planned designs and keep them with their stated assurance."""
    use_compilation_cache()
    DESIGNS.parent.mkdir(parents=True, exist_ok=True)
    target, rig, kept = parse_target(DEFAULT_TARGET), mounted_rig(), {}
    both = plan(rig, target, draws=DRAWS)
    for name, result in (("n95", both), ("n80", plan(rig, target, draws=DRAWS, largest=both.n80))):
        write_plan(result.steps, design_file(name))
        fields = ("experiments", "looks", "minutes", "assurance", "assurance_se", "expected")
        kept[name] = {field: getattr(result, field) for field in fields}
    DESIGNS.write_text(json.dumps(kept, indent=1) + "\n")
    print(json.dumps(kept, indent=1))


def job_of(name: str) -> StudyJob:
    """The study behind the rows of a design."""
    steps = shipped_plan(name) if name in ("paper", "grid") else read_plan(design_file(name))
    return StudyJob(mounted_rig(), steps, parse_target(DEFAULT_TARGET), SEED)


def one_row(task: tuple[str, int]) -> dict[str, object]:
    """A row of `tvsbayes study` with the design's name."""
    use_compilation_cache()
    name, index = task
    return {"name": name, **study_row(job_of(name), index).as_json()}


def headlines_table(name: str, job: StudyJob, result: StudyResult) -> None:
    """Errors of the headlines of a design over what was predicted and reported."""
    low, high = rms_bounds(result.converged)
    looks = sum(step.action == "look" for step in job.steps)
    print(f"## {name}: {looks} spots, {result.campaigns} campaigns, {result.converged} fits converged\n")
    titles = f"headline | RMS z, predicted sd ({low:.2f}-{high:.2f}) | RMS z, reported sd | predicted / RMS error"
    print(heading(titles, f"95 % interval holds truth | verdict | with sd x {SHRINK}"))
    for quantity in TARGETS:
        h = result.headlines[quantity]
        verdict = "within" if low <= h.rms_predicted <= high else "OUTSIDE"
        shrunk = "fails" if not low <= h.rms_predicted / SHRINK <= high else "passes"
        cells = (f"{value:.3f}" for value in (h.rms_predicted, h.rms_z, h.predicted_over_rms))
        print(line(quantity, *cells, f"{100 * h.coverage['95']:.1f} %", verdict, shrunk))
    print()


def assurance_line(name: str, stated: dict, result: StudyResult) -> str:
    """The counted assurance of a design beside the stated one."""
    n, a, se = result.campaigns, stated["assurance"], stated["assurance_se"]
    ends = share_interval95(round(result.assurance * n), n)
    # The stated value is an estimate from draws: its error widens the bounds.
    exact, wide = binomial_bounds(n, a), stats.norm.isf(0.5e-4) * se
    bounds = max(0.0, exact[0] - wide), min(1.0, exact[1] + wide)
    verdict = "within" if bounds[0] <= result.assurance <= bounds[1] else "OUTSIDE"
    shares = (f"{100 * low:.0f}-{100 * high:.0f} %" for low, high in (ends, bounds))
    cells = (stated["experiments"], stated["looks"], f"{stated['minutes']:.1f}", f"{100 * a:.1f} +- {100 * se:.1f} %")
    return line(name, *cells, f"{100 * result.assurance:.1f} % of {n}", *shares, verdict)


def table(rows: list[dict]) -> None:
    kept, results = json.loads(DESIGNS.read_text()), {}
    print("# Predicted and actual uncertainty of plans\n")
    print("Written by `python -m experiments.planning.prediction table`; bounds at 1e-4.\n")
    for name in NAMES:
        job = job_of(name)
        chosen = [StudyRow.from_json(r) for r in rows if r["name"] == name and r["design"] == job.key]
        if chosen:
            results[name] = study_result(job, chosen)
            headlines_table(name, job, results[name])
    print("## Assurance\n")
    print(heading("design | experiments | spots | minutes | stated | counted | 95 % interval", END))
    for name in ("n80", "n95"):
        if name in results:
            print(assurance_line(name, kept[name], results[name]))
    failed = [r for r in rows if not r["converged"]]
    seconds = np.median([r["seconds"] for r in rows])
    print(f"\n{len(rows)} rows, median {seconds:.1f} s; {len(failed)} fits failed.")
    for row in failed[:10]:
        print(f"- {row['name']} {row['index']}: {'; '.join(row['problems'])}")


if __name__ == "__main__":
    more = {"--designs": {"nargs": "+", "default": NAMES, "choices": NAMES}}
    study(__file__, __doc__, one_row, KEYS, lambda of: by_seed(of.designs, of.n), table, 1000, more, designs=designs)
