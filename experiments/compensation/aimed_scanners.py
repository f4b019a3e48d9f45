"""Does `verify` name what became of a scanner's calibration between `steps-for` and the motors?

    python -m experiments.compensation.aimed_scanners run --n 20 --cores 0   # half a CPU minute a rig, resumable
    python -m experiments.compensation.aimed_scanners table > experiments/compensation/aimed_scanners.md

Rig s is the mounted rig drawn with seed s, measured by 16 four-point experiments of 100 and 200 steps; the calibration
is that of the mode with its Laplace approximation. The scanner is homed again and aimed at six directions from all four
pairs of sides, each seen on two sheets: 12 looks, new in each world. Another machine is the rig of another seed.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from experiments.common.command_line import study
from experiments.common.rigs import mounted_rig
from tvsbayes.calibration.pointing import Calibration
from tvsbayes.compensation.verification import SCENARIOS
from tvsbayes.errors import TvsError
from tvsbayes.instrument.axes import APPROACH_SIGN
from tvsbayes.instrument.campaign import Campaign
from tvsbayes.instrument.plan import PlanBuilder, PlanStep
from tvsbayes.instrument.protocols import four_point_protocol
from tvsbayes.instrument.rig import Rig
from tvsbayes.results.compensation_record import APPLIED, BROKEN, CANNOT_TELL, KEPT, OTHER_MACHINE, WORLDS
from tvsbayes.twin.simulated_campaign import simulate
from tvsbayes.twin.true_rig import Truth

RUN_UP_STEPS = 40
SIDES = (("left", "up"), ("right", "down"), ("left", "down"), ("right", "up"))
AIMS = tuple(
    (pan, tilt, SIDES[k % 4]) for k, (pan, tilt) in enumerate([(p, t) for p in (30, 170) for t in (-60, 0, 60)])
)
"""Six counters, pan and tilt, with the sides that they are reached from."""


def plan_of(
    stops: Sequence[tuple[int, int]], sides: Sequence[tuple[str, str]], targets=("d1", "d2")
) -> tuple[PlanStep, ...]:
    """Every stop from its sides, with a run-up, on each sheet."""
    plan = PlanBuilder()
    plan.home()
    for target in targets:
        plan.place(target)
        for (pan, tilt), (pan_side, tilt_side) in zip(stops, sides, strict=True):
            back = [n - RUN_UP_STEPS * APPROACH_SIGN[side] for n, side in ((pan, pan_side), (tilt, tilt_side))]
            plan.move(pan=back[0], tilt=back[1])
            plan.move(pan=pan, tilt=tilt)
            plan.look()
    return tuple(plan.steps)


def sent(calibration: Calibration, rig: Rig, pan: int, tilt: int, sides: tuple[str, str], factors) -> tuple[int, int]:
    """Counters that the motors get for the commanded ones, where the common part and the play act so many times.

    By the calibration's own aiming: the same direction from the other sides gives the play, nominal ratios the rest.
    """
    direction = calibration.ray(pan, tilt, sides).direction
    azimuth, elevation = np.degrees(np.arctan2(direction[1], direction[0])), np.degrees(np.arcsin(direction[2]))
    turned = tuple({"left": "right", "right": "left", "up": "down", "down": "up"}[side] for side in sides)
    other = calibration.steps_for(azimuth_deg=azimuth, elevation_deg=elevation, approach=turned)
    prior = rig.table.priors
    nominal = (
        (azimuth + 90 - prior["pan_zero_emission_deg"].value) / prior["degrees_per_step.pan"].value,
        elevation / prior["degrees_per_step.tilt"].value,
    )
    steps = []
    for ahead, back, m in zip((pan, tilt), (other.pan_steps, other.tilt_steps), nominal, strict=True):
        middle, half = 0.5 * (ahead + back), 0.5 * (ahead - back)
        steps.append(round(m + factors[0] * (middle - m) + factors[1] * half))
    return steps[0], steps[1]


def aimed(
    rig: Rig, truth: Truth, calibration: Calibration, factors=(1.0, 1.0), *, seed: int = 5, aims=AIMS, **options
) -> Campaign:
    """Looks of a rig whose moves list the commanded counters."""
    counters, sides = [aim[:2] for aim in aims], [aim[2] for aim in aims]
    run = simulate(rig, plan_of([sent(calibration, rig, *aim, factors) for aim in aims], sides, **options), seed, truth)
    named = simulate(rig, plan_of(counters, sides, **options), seed, truth).campaign.moves
    return replace(run.campaign, moves=named)


def one_rig(task: tuple[int]) -> dict[str, object]:
    """Draw, calibrate, aim and verify one rig."""
    from tvsbayes.assessment.fitted_calibration import calibration_of
    from tvsbayes.comparison.verified_looks import verify_looks
    from tvsbayes.estimators.joint_fit import fit
    from tvsbayes.model.compilation_cache import use_compilation_cache

    use_compilation_cache()
    (seed,) = task
    began, rig = time.process_time(), mounted_rig()
    plan = four_point_protocol(repeats=4, steps=(100, 200))
    run, other = (simulate(rig, plan, each) for each in (seed, seed + 100_000))
    row: dict[str, object] = {"seed": seed}
    try:
        joint = fit(run.campaign)
        calibration, verdicts = calibration_of(joint), {}
        for k, world in enumerate(WORLDS):
            elsewhere = world == OTHER_MACHINE
            factors = (1.0, 1.0) if elsewhere else SCENARIOS[world][0]
            truth = other.truth if elsewhere else run.truth
            looks = aimed(rig, truth, calibration, factors, seed=1000 * seed + k)
            test = verify_looks(joint, calibration, looks, seed=seed)
            points = test.millimetres
            assert points is not None
            verdicts[world] = [test.verdict, test.world, test.worlds[test.world], test.p]
            if world == APPLIED:
                row["mm"] = [points.before.rms, points.after.rms, points.promised95]
                row["deg"] = [test.before.rms, test.after.rms, test.promised95]
        row["verify"] = verdicts
    except TvsError as error:
        row["error"] = error.code
    return {**row, "cpu_s": time.process_time() - began}


def table(rows: list[dict]) -> None:
    good = [row for row in rows if "error" not in row]
    print("# Aimed scanners: what became of the calibration\n")
    print(f"By `experiments.compensation.aimed_scanners`: {len(rows)} drawn rigs, {len(rows) - len(good)} refused; 12")
    print("looks in each world.\n")
    print("| world | named, 95 % sure | KEPT | BROKEN | CANNOT TELL |\n|---|---|---|---|---|")
    for world in WORLDS:
        runs = [row["verify"][world] for row in good]
        named = sum(run[1] == world and run[2] >= 0.95 for run in runs)
        counts = " | ".join(str(sum(run[0] == verdict for run in runs)) for verdict in (KEPT, BROKEN, CANNOT_TELL))
        print(f"| {world} | {named} of {len(runs)} | {counts} |")
    print("\nApplied, medians over rigs:\n")
    print("| | RMS before | RMS after | promised, 95 % |\n|---|---|---|---|")
    for key, unit in (("deg", "mirror angles, deg"), ("mm", "points at 1 m, mm")):
        print(f"| {unit} | " + " | ".join(f"{v:.3g}" for v in np.median([row[key] for row in good], axis=0)) + " |")


if __name__ == "__main__":
    study(__file__, __doc__, one_rig, ("seed",), [()], table, 20)
