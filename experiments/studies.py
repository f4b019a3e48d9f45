"""Shared by the simulation studies: resumable rows, pinned workers, a small plan, headlines against the truth."""

from __future__ import annotations

import json
import multiprocessing
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from coverage import SINGLE_THREADED, read_rows

from tvsbayes.estimators.joint_fit import Problem, fit, fit_at
from tvsbayes.model.parameter_space import coordinates_of
from tvsbayes.statistics.least_squares import newton_mode

PAN_SWEEP = (0, 70, 140, 200, 140, 70)
TILT_SWEEP = (-60, -20, 20, 60, 20, -20)
TILT_STEPS = (-60, -36, -12, 12, 36, 60, 36, 12, -12, -36)
CROSSING = 100, -20
"""Tilt while panning is the second number, pan while tilting the first."""


def small_plan(sheets: Sequence[str]):
    """Both axes swept there and back twice, 24 spots and moves per sheet, after one homing.

    Two sheets give twelve stops in every direction.
    """
    from tvsbayes.instrument.plan import PlanStep

    orders = [("home", 0, 0)]
    for sheet in sheets:
        orders.append(("place", None, None, sheet))
        for pan, tilt in [(p, CROSSING[1]) for p in PAN_SWEEP * 2] + [(CROSSING[0], t) for t in TILT_SWEEP * 2]:
            orders += [("move", pan, tilt), ("look",)]
    return tuple(PlanStep(number, *order) for number, order in enumerate(orders))


def dense_plan(sheets: Sequence[str]):
    """30 spots per sheet, both axes driven between any two: every spot tells a stop of each axis; 60 spots for two."""
    from tvsbayes.instrument.plan import PlanStep

    orders = [("home", 0, 0)]
    for sheet in sheets:
        orders.append(("place", None, None, sheet))
        for look in range(30):
            orders += [("move", PAN_SWEEP[look % len(PAN_SWEEP)], TILT_STEPS[look % len(TILT_STEPS)]), ("look",)]
    return tuple(PlanStep(number, *order) for number, order in enumerate(orders))


def mounted_rig():
    """The shipped rig whose extrinsics are known to 0.03 rad and 5 mm."""
    from tvsbayes.files.disk import shipped_data
    from tvsbayes.instrument.rig import read_rig

    return read_rig(shipped_data() / "rigs" / "mounted" / "rig.toml")


def shipped_plan(protocol: str):
    """A plan of the mounted rig."""
    from tvsbayes.files.disk import shipped_data
    from tvsbayes.instrument.plan import read_plan

    return read_plan(shipped_data() / "rigs" / "mounted" / f"{protocol}.csv")


HEADLINES = (
    *(f"effective {direction}" for direction in ("left", "right", "up", "down")),
    *("contrast pan", "contrast tilt", "backlash pan", "backlash tilt", "effective mirror offset"),
)
"""In the order of `tvsbayes.design.QUANTITIES`."""


def headlines(draws) -> dict[str, np.ndarray]:
    """Headline quantities of `tvsbayes.joint.Derived`, whose leading axes are kept."""
    from tvsbayes.instrument.parameters import INDEX

    ratio, physical = np.asarray(draws.effective_deg_per_step), np.asarray(draws.physical)
    each = (
        *np.moveaxis(ratio, -1, 0),
        ratio[..., 0] - ratio[..., 1],
        ratio[..., 2] - ratio[..., 3],
        physical[..., INDEX["backlash_deg.pan"]],
        physical[..., INDEX["backlash_deg.tilt"]],
        np.asarray(draws.effective_mirror_offset_mm),
    )
    return dict(zip(HEADLINES, each, strict=True))


def true_headlines(parameters: Mapping[str, float], pose_rad: np.ndarray) -> dict[str, float]:
    """The same of a true rig, by the twin's formulas, at the pose of the fit."""
    from tvsbayes.studies.study_job import true_headlines as values

    return dict(zip(HEADLINES, values(parameters, pose_rad).tolist(), strict=True))


def judged(draws, centre, prior_draws, parameters: Mapping[str, float], pose_rad: np.ndarray) -> dict[str, dict]:
    """PIT, z and contraction of every headline; `centre` is a `Derived` without leading axes, None the draws' mean."""
    true, prior = true_headlines(parameters, pose_rad), headlines(prior_draws)
    middle = None if centre is None else headlines(centre)
    result = {}
    for name, values in headlines(draws).items():
        values = values.ravel()
        at = float(values.mean() if middle is None else middle[name])
        result[name] = {
            "pit": float(np.mean(values < true[name])),
            "z": float((at - true[name]) / values.std()),
            "contraction": float(1 - values.var() / prior[name].var()),
        }
    return result


def physical_of(truth) -> np.ndarray:
    """A true rig and its cameras in the order of `tvsbayes.model.NAMES`, shape (65,)."""
    from tvsbayes.instrument.parameters import RIG_NAMES

    return np.array([*(truth.parameters[name] for name in RIG_NAMES), *truth.stereo.vector])


def fit_from_truth(campaign, truth):
    """`joint.fit` without its search: Newton steps from the true rig to the mode, a third of the time.

    The mode, its covariance and every diagnosis are those of the ordinary fit, to which it falls back where the steps
    do not settle.
    """
    import jax

    with jax.enable_x64(True):
        problem = Problem(campaign, campaign.rig)
        z = np.where(problem.free, np.clip(coordinates_of(problem.space, physical_of(truth)), -4.0, 4.0), 0.0)
        mode = newton_mode(problem.objective, z, problem.free, problem.curvature(z))
        if not mode.problems:
            return fit_at(campaign, problem, mode, 0)
    return fit(campaign)


def _pin(cores) -> None:
    os.sched_setaffinity(0, {cores.get()})


def run_rows(one: Callable, tasks: Sequence[tuple], rows: Path, keys: Sequence[str], cores: Sequence[int]) -> None:
    """Append `one(task)` as JSON lines until every task is there, one single-threaded worker per core.

    Args:
        one: a module-level function from task to row; the row holds the task's parts under `keys`.
        tasks: in the order in which they are done.
        rows: JSON lines, read first: what is there is not done again.
        keys: names of a task's parts.
        cores: processor numbers.
    """
    rows.parent.mkdir(parents=True, exist_ok=True)
    done = {tuple(r.get(k) for k in keys) for r in read_rows(rows)}
    # Read by XLA and OpenBLAS when a worker starts.
    os.environ.update(SINGLE_THREADED)
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    for core in cores:
        queue.put(core)
    left = [task for task in tasks if tuple(task) not in done]
    with context.Pool(len(cores), initializer=_pin, initargs=(queue,)) as pool, rows.open("a") as file:
        for row in pool.imap_unordered(one, left):
            file.write(json.dumps(row) + "\n")
            file.flush()
