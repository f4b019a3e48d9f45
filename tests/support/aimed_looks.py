"""A scanner sent to counters of `steps-for`, under whatever became of its calibration on the way to the motors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tvsbayes.calibration.pointing import Calibration
from tvsbayes.instrument.axes import APPROACH_SIGN
from tvsbayes.instrument.campaign import Campaign
from tvsbayes.instrument.plan import PlanBuilder, PlanStep
from tvsbayes.instrument.rig import Rig
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
    """Counters that the motors get for those asked, where the common part and the play act so many times.

    By the calibration's own aiming: the same direction from the other sides tells the play, nominal ratios the rest.
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
    found = []
    for asked, back, m in zip((pan, tilt), (other.pan_steps, other.tilt_steps), nominal, strict=True):
        middle, half = 0.5 * (asked + back), 0.5 * (asked - back)
        found.append(round(m + factors[0] * (middle - m) + factors[1] * half))
    return found[0], found[1]


def aimed(
    rig: Rig, truth: Truth, calibration: Calibration, factors=(1.0, 1.0), *, seed: int = 5, aims=AIMS, **options
) -> Campaign:
    """Looks of a rig whose moves say what was asked for."""
    asked, sides = [aim[:2] for aim in aims], [aim[2] for aim in aims]
    run = simulate(rig, plan_of([sent(calibration, rig, *aim, factors) for aim in aims], sides, **options), seed, truth)
    named = simulate(rig, plan_of(asked, sides, **options), seed, truth).campaign.moves
    return replace(run.campaign, moves=named)
