"""What a plan is worth before anything is measured: u of the effective ratios, its causes, and what no repeat lowers.

Expected information at the most probable instrument. deg/step; counters in steps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from msgspec import structs

from experiments.common.rigs import numbered
from tvsbayes.instrument.plan import PlanStep
from tvsbayes.instrument.protocols import RUN_UP_STEPS
from tvsbayes.planning.assurance import Family
from tvsbayes.planning.candidates import Candidates, candidates
from tvsbayes.planning.expectation import Knowledge, information_of
from tvsbayes.planning.limits import MANY_TIMES, split_of
from tvsbayes.planning.looks import LookArrays, covariance_of
from tvsbayes.planning.search import DesignProblem, Scope, design_family
from tvsbayes.planning.target import DEFAULT_TARGET, parse_target, sensitivity

CAUSES = ("looks", "cameras", "priors")
TURN_STEPS = 6000
"""A full turn of pan at 0.06 deg/step."""
UNREACHED = 1e-9
"""A limit that no plan keeps: the search goes on to its largest design."""


def full_turn_plan(looks: int, turn_steps: int = TURN_STEPS) -> tuple[PlanStep, ...]:
    """`looks` poses near and a turn later on each of two sheets, from either side of both axes."""
    # Neighbours differ in tilt, and in eight looks each axis is reached from either side at either end.
    poses = ((0, -90), (200, 90), (70, 90), (140, -90), (200, -90), (0, 90), (140, 90), (70, -90))
    orders: list[tuple] = [("home", 0, 0)]
    for number, sheet in enumerate(("d1", "d3")):
        orders.append(("place", None, None, sheet))
        for at in (0, turn_steps)[:: 1 if number == 0 else -1]:
            for look in range(looks):
                pan, tilt = poses[look % len(poses)]
                pan_run_up = RUN_UP_STEPS * (1 if look % 2 == 0 else -1)
                tilt_run_up = RUN_UP_STEPS * (1 if look // 2 % 2 == 0 else -1)
                orders += [("move", at + pan - pan_run_up, tilt - tilt_run_up), ("move", at + pan, tilt), ("look",)]
    return numbered(orders)


@dataclass(frozen=True)
class Worth:
    """The worth of a plan for left, right, up, down.

    Attributes:
        spots: looks seen.
        u: standard uncertainties of the four effective ratios, deg/step.
        shares: of the worst one's variance, by `CAUSES`.
        floor: u of the worst after a hundred times the same looks.
    """

    spots: int
    u: np.ndarray
    shares: Mapping[str, float]
    floor: float


def worth_of(
    knowledge: Knowledge, fisher: np.ndarray, pose_rad: np.ndarray, spots: int, quantity: str = "worst"
) -> Worth:
    """Uncertainty and its causes from the information of the looks (p, p)."""
    target = parse_target(f"u({quantity}) <= 2e-4 deg/step")
    at = sensitivity(target, knowledge.z, knowledge.space, knowledge.rig.table, pose_rad)
    covariance = covariance_of(knowledge.precision + fisher)
    u = np.sqrt(np.einsum("qi,ij,qj->q", at.gradient, covariance, at.gradient))
    parts = split_of(knowledge, fisher, None, at)
    cameras = parts.get("stereo calibration", 0.0) + parts.get("focal scale", 0.0)
    looks = parts.get("looks", 0.0)
    floor = at.value(covariance_of(knowledge.precision + MANY_TIMES * fisher))
    return Worth(spots, u, dict(zip(CAUSES, (looks, cameras, 1 - looks - cameras), strict=True)), floor)


def worth_of_plan(
    knowledge: Knowledge, steps: Sequence[PlanStep], times: float = 1.0, quantity: str = "worst"
) -> Worth:
    """The same of a plan, taken `times` times over."""
    information = information_of(steps, knowledge)
    visible = information.expectation.seen
    # A turn later is the same beam: the mean of the counters would be a pose half a turn away, without looks.
    angles = information.expectation.mirror_angles_rad[visible]
    pose = np.array([np.mean((angles[:, 0] + np.pi) % (2 * np.pi) - np.pi), angles[:, 1].mean()])
    return worth_of(knowledge, times * information.fisher, pose, round(times * visible.sum()), quantity)


def searched_family(knowledge: Knowledge, pool: Candidates | None = None, scope: Scope | None = None) -> Family:
    """The planner's order of looks for the worst effective ratio, however small."""
    pool = candidates(knowledge) if pool is None else pool
    looks = LookArrays(pool.looks, knowledge, False).at(knowledge.z, knowledge.space)
    target = structs.replace(parse_target(DEFAULT_TARGET), limit=UNREACHED)
    pose = looks.mirror_angles_rad.mean(axis=0)
    centre = sensitivity(target, knowledge.z, knowledge.space, knowledge.rig.table, pose)
    return design_family(DesignProblem(knowledge, pool, looks, target, centre), scope)
