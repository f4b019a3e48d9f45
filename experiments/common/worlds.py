"""Worlds that no prior holds: true rigs whose gears err otherwise than the model assumes, and campaigns on them.

Errors of both axes, in degrees of the output: `pinion`, a wave of the pinion's turn; `tooth`, one of its teeth;
`step`, a jump at one place, as of a damaged tooth or of a wheel joined of two halves; `warm-up`, a zero that creeps
after switching on and settles. `size_deg` is the amplitude of a wave, the height of a step, the whole way of a zero.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from experiments.common.rigs import drawn_truth
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.plan import PlanStep
from tvsbayes.instrument.rig import Rig
from tvsbayes.twin.gear_errors import AxisErrors, Waves
from tvsbayes.twin.simulated_campaign import SimulatedCampaign, simulate
from tvsbayes.twin.true_rig import Truth

World = Literal["pinion", "tooth", "step", "warm-up"]
WORLDS: tuple[World, ...] = get_args(World)
PERIOD_DEG = {"pinion": 36.0, "tooth": 3.0}
"""A wheel of 120 teeth driven by a pinion of twelve."""
STEP_AT_DEG = {"pan": 6.0, "tilt": 0.0}
"""Middle of the counters of the paper's protocol at the nominal ratios."""
WARM_UP_HOURS = 0.5
"""Time constant: some motors and their drivers reach their temperature in an hour."""


@dataclass(frozen=True)
class Step:
    """An error that is 0 up to a place and `height_deg` beyond it."""

    at_deg: float
    height_deg: float

    def __call__(self, angle_deg: np.ndarray) -> np.ndarray:
        """The error at angles, their shape."""
        return self.height_deg * (np.asarray(angle_deg) > self.at_deg)


@dataclass(frozen=True)
class WarmUp:
    """A zero that creeps by `way_deg` in all, e-fold slower every `hours`."""

    way_deg: float
    hours: float = WARM_UP_HOURS

    def __call__(self, hours: np.ndarray) -> np.ndarray:
        """How far it has gone, hours after switching on."""
        return self.way_deg * (1 - np.exp(-np.asarray(hours) / self.hours))


def gear_errors_of(world: World, size_deg: float, seed: int) -> dict[str, AxisErrors]:
    """Errors of both axes; the phase of a wave follows from the seed."""
    phases = np.random.default_rng([seed, WORLDS.index(world)]).uniform(0.0, 2 * np.pi, len(AXES))
    errors: dict[str, AxisErrors] = {}
    for axis, phase in zip(AXES, phases, strict=True):
        if world == "step":
            errors[axis] = AxisErrors(error_deg=Step(STEP_AT_DEG[axis], size_deg))
        elif world == "warm-up":
            errors[axis] = AxisErrors(warming_deg=WarmUp(size_deg))
        else:
            rate = np.array([2 * np.pi / PERIOD_DEG[world]])
            wave = Waves(rate, np.array([size_deg * np.cos(phase)]), np.array([size_deg * np.sin(phase)]))
            errors[axis] = AxisErrors(error_deg=wave)
    return errors


def truth_of(rig: Rig, world: World, size_deg: float, seed: int) -> Truth:
    """The rig that `simulate` draws from the seed, with these errors in place of any that its gears would repeat."""
    return drawn_truth(rig, seed).with_gears(gear_errors_of(world, size_deg, seed))


def campaign_of(rig: Rig, plan: Iterable[PlanStep], world: World, size_deg: float, seed: int) -> SimulatedCampaign:
    """A campaign in a world; everything but the errors of its gears is that of `simulate(rig, plan, seed)`."""
    return simulate(rig, plan, seed, truth_of(rig, world, size_deg, seed))
