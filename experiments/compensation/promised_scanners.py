"""Does a scanner point as its calibration promises, after a new homing?

    python -m experiments.compensation.promised_scanners run --n 10 --cores 0   # 20 s a campaign, resumable
    python -m experiments.compensation.promised_scanners table > experiments/compensation/promised_scanners.md

Rig s is the mounted rig drawn with seed s, measured by 16 four-point experiments of 100 and 200 steps after one homing,
or by twice 8 after two; the calibration is that of the mode with its Laplace approximation. The scanner is homed again
and goes to drawn counters from all four pairs of sides: 24 looks, of which those within the promised time and travel
count. An error is the angle that a look shows less that of the calibration's one state, the pixels' noise in it.
"""

from __future__ import annotations

import time
from dataclasses import replace
from itertools import product

import numpy as np

from experiments.common.command_line import study
from experiments.common.rigs import mounted_rig
from tvsbayes.errors import TvsError
from tvsbayes.instrument.axes import AXES, SIDES
from tvsbayes.instrument.campaign import ordered_spots
from tvsbayes.instrument.plan import PlanBuilder, PlanStep
from tvsbayes.instrument.protocols import four_point_protocol
from tvsbayes.twin.simulated_campaign import simulate

RUN_UP_STEPS, LOOKS = 25, 24
HOMINGS = (1, 2)


def plan_of(homings: int) -> tuple[PlanStep, ...]:
    """The four-point experiments after one homing, or half of them after each of two."""
    steps = [*four_point_protocol(repeats=4 // homings, steps=(100, 200))] * homings
    return tuple(replace(step, step=k) for k, step in enumerate(steps))


def fresh_plan(seed: int) -> tuple[PlanStep, ...]:
    """Looks at drawn counters on both sheets."""
    rng, plan = np.random.default_rng(seed), PlanBuilder()
    # The twin draws a homing from the second on: the first sets the zero.
    plan.home()
    plan.move(pan=50, tilt=50)
    plan.home()
    sides = [*product((1, -1), repeat=2)] * (LOOKS // 8)
    for target in ("d1", "d2"):
        plan.place(target)
        for pan_side, tilt_side in sides:
            pan, tilt = int(rng.integers(40, 160)), int(rng.integers(-60, 60))
            plan.reach("pan", pan, pan_side, RUN_UP_STEPS)
            plan.reach("tilt", tilt, tilt_side, RUN_UP_STEPS)
            plan.look()
    return tuple(plan.steps)


def one_campaign(task: tuple[int, int]) -> dict[str, object]:
    """Draw, calibrate, home and look again."""
    from tvsbayes.assessment.fitted_calibration import calibration_of
    from tvsbayes.calibration.states import states_at
    from tvsbayes.comparison.verified_looks import AimedLooks, SeenAngles, shifts_deg, verify_looks
    from tvsbayes.comparison.watched_looks import WatchedLooks
    from tvsbayes.compensation.aimed_promise import aimed_promise
    from tvsbayes.estimators.campaign_arrays import in_sight
    from tvsbayes.estimators.joint_fit import fit
    from tvsbayes.model.compilation_cache import use_compilation_cache

    use_compilation_cache()
    homings, seed = task
    began, rig = time.process_time(), mounted_rig()
    run = simulate(rig, plan_of(homings), seed)
    row: dict[str, object] = {"homings": homings, "seed": seed}
    try:
        joint = fit(run.campaign)
        calibration = calibration_of(joint)
        made = aimed_promise(calibration, joint.campaign, "header", seed=seed)
        looks = simulate(rig, fresh_plan(1000 * seed + homings), 5000 + seed, run.truth).campaign
        test = verify_looks(joint, calibration, looks, seed=seed)
        sides = AimedLooks.of(calibration, looks, in_sight(looks)).sides
        watched = WatchedLooks(joint, looks)
        errors = SeenAngles.of(joint, watched, sides, seed).value + shifts_deg(watched, calibration)
        errors = errors.reshape(-1, 2)
        row["verdict"] = [test.verdict, test.p, test.after.rms, test.promised95]
        for k, axis in enumerate(AXES):
            at = states_at(looks, ordered_spots(looks))[axis]
            inside = (at.travel <= made.travel_steps[axis]) & (at.hours <= made.hours)
            for side, name in zip((-1, 1), SIDES[axis], strict=True):
                promise, rows = made.promise[name], (sides[:, k] == side) & inside
                row[name] = {
                    "homed": errors[rows, k].tolist(),
                    "promised": [promise.error95, promise.shift_free95, promise.error95_with_homing],
                }
    except TvsError as error:
        row["error"] = error.code
    return {**row, "cpu_s": time.process_time() - began}


def errors_of(row: dict, name: str) -> tuple[tuple[np.ndarray, float], tuple[np.ndarray, float]]:
    """Errors of a side and their promise, first less one shift, then with the homing's.

    The shift is the mean of both sides, weighted by the promise: with a dozen looks a side whose stops scatter widely
    would move it by more than the other promises.
    """
    sides = next(SIDES[axis] for axis in AXES if name in SIDES[axis])
    weights = np.concatenate([np.full(len(row[side]["homed"]), row[side]["promised"][1] ** -2) for side in sides])
    shift = np.average(np.concatenate([row[side]["homed"] for side in sides]), weights=weights)
    errors, (_, free, homed) = np.array(row[name]["homed"]), row[name]["promised"]
    return (errors - shift, free), (errors, homed)


def table(rows: list[dict]) -> None:
    good = [row for row in rows if "error" not in row]
    print("# Promised scanners: errors of fresh looks after a new homing\n")
    print(f"By `experiments.compensation.promised_scanners`: {len(rows)} campaigns, {len(rows) - len(good)} refused;")
    print(
        f"{LOOKS} looks each. Share of errors within the promise with its standard error by campaigns, whose looks of a"
    )
    print("side err together; median of promise over RMS of errors.\n")
    print("| homings | side | but for one shift | promise / RMS | with the homing | promise / RMS |")
    print("|---|---|---|---|---|---|")
    for homings in HOMINGS:
        for name in (side for axis in AXES for side in SIDES[axis]):
            own = [errors_of(row, name) for row in good if row["homings"] == homings and row[name]["homed"]]
            cells = []
            for each in zip(*own, strict=True):
                inside = 100 * np.array([np.mean(np.abs(errors) <= promised) for errors, promised in each])
                ratio = [promised / np.sqrt(np.mean(np.square(errors))) for errors, promised in each]
                spread = np.std(inside, ddof=1) / np.sqrt(len(inside))
                cells += [f"{np.mean(inside):.0f} ± {spread:.0f} %", f"{np.median(ratio):.1f}"]
            print(f"| {homings} | {name} | {' | '.join(cells)} |")
    kept = sum(row["verdict"][0] == "KEPT" for row in good)
    broken = sum(row["verdict"][0] == "BROKEN" for row in good)
    print(f"\n`verify`: KEPT {kept}, BROKEN {broken} of {len(good)}.")


if __name__ == "__main__":
    study(__file__, __doc__, one_campaign, ("homings", "seed"), HOMINGS, table, 10)
