"""Planned looks against the paper's 96 experiments: minutes and spots to the same u, and what a full turn does.

    python -m experiments.planning.planned_looks > experiments/planning/planned_looks.md

Takes two minutes. On the paper's rig (`data/rigs/mounted`: sheets at 175, 275, 375 mm, costs
1.5 s a move, 1 s a look, 60 s a placement), expected information at the most probable instrument, no simulation. Two
numbers are followed: u of the worst effective ratio, which falls with n, and its floor, what is left where the same
looks are taken a hundred times (stereo, focal scale, priors of the optics). Protocols are repeated; the planned looks
are those of the greedy search without exchange. The full turn is taken after the planned looks, when the ratio is
known: its spot must be found.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from msgspec import structs

from experiments.common.command_line import print_only
from experiments.common.page import heading
from experiments.common.rigs import mounted_rig
from tvsbayes.instrument.plan import PlanStep
from tvsbayes.instrument.protocols import grid_protocol, mixed_protocol, paper_protocol
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.planning.candidates import candidates
from tvsbayes.planning.expectation import Knowledge, PlanInformation, information_of, prior_knowledge
from tvsbayes.planning.limits import MANY_TIMES, limit_of, split_of
from tvsbayes.planning.looks import LookArrays
from tvsbayes.planning.search import LADDER, DesignProblem, Scope, design_family
from tvsbayes.planning.target import DEFAULT_TARGET, Sensitivity, parse_target, sensitivity
from tvsbayes.statistics.optimal_design import covariance_of

REPEATS = (2, 4, 8, 16, 24)
TARGET = parse_target(DEFAULT_TARGET)
UNREACHED = 1e-9
"""A limit that no plan keeps: the search goes on to its largest design."""
TURN = {"pan_min_steps": -100, "pan_max_steps": 7000, "tilt_min_steps": -130, "tilt_max_steps": 130}
"""Limits that allow a full turn of pan: 6000 steps at 0.06 deg/step."""


@dataclass(frozen=True)
class Session:
    """A plan's information, the worst ratio's slopes at its pose, and u of that ratio, deg/step."""

    knowledge: Knowledge
    information: PlanInformation
    at: Sensitivity
    value: float

    @property
    def spots(self) -> int:
        """Looks."""
        return len(self.information.look_moves)

    def row(self, name: str) -> str:
        """A line of the table."""
        limit = limit_of(self.knowledge, self.information.fisher, self.at, TARGET)
        shares = split_of(self.knowledge, self.information.fisher, None, self.at)
        first, floor = (
            ", ".join(f"{cause} {100 * share:.0f} %" for cause, share in list(parts.items())[:count])
            for parts, count in ((shares, 3), (limit.shares, 2))
        )
        numbers = f"{self.spots} | {self.information.minutes:.1f} | {1e4 * self.value:.2f}"
        return f"| {name} | {numbers} | {first} | {1e4 * limit.floor:.2f} | {floor} |"


def session(knowledge: Knowledge, steps: Sequence[PlanStep]) -> Session:
    """Information of a plan before anything is measured."""
    information = information_of(steps, knowledge)
    at = sensitivity(TARGET, knowledge.z, knowledge.space, knowledge.rig.table, information.pose_rad)
    return Session(knowledge, information, at, at.value(covariance_of(knowledge.precision + information.fisher)))


class Point(NamedTuple):
    """A size of a campaign: minutes, u of the worst ratio (deg/step), spots."""

    minutes: float
    value: float
    spots: int


def curves_of(sessions: Mapping[str, Sequence[Session]]) -> dict[str, list[Point]]:
    """Points by campaign; the grid is taken once, twice and four times."""

    def point(one: Session, times: int = 1) -> Point:
        value = one.at.value(covariance_of(one.knowledge.precision + times * one.information.fisher))
        return Point(times * one.information.minutes, value, times * one.spots)

    curves = {name: [point(one) for one in of] for name, of in sessions.items()}
    return curves | {"grid": [point(sessions["grid"][0], times) for times in (1, 2, 4)]}


def rows_of(sessions: Mapping[str, Sequence[Session]]) -> list[str]:
    """Lines of the first table: the largest of each protocol, and some of the planner's."""
    planned = dict(zip(LADDER, sessions["planned"], strict=True))
    whole = [sessions[name][-1].row(name) for name in ("paper", "mixed", "grid")]
    return whole + [planned[n].row(f"planned, {n}") for n in (8, 16, 32, 96)]


def second_session(first: Session) -> None:
    """When the ratio is known: near looks against a full turn, eight to 64 looks each."""
    rig, knowledge = first.knowledge.rig, first.knowledge
    precision = knowledge.precision + first.information.fisher
    sharp = replace(knowledge, rig=replace(rig, positioner=TURN), precision=precision, after_data=True)
    wide = candidates(sharp)
    shown = LookArrays(wide.looks, sharp, False).at(sharp.z, sharp.space)
    away = wide.looks.steps[:, 0] > 3000
    print("\n## A second session after 16 planned experiments\n")
    print("| looks added | experiments | spots in all | a turn away | minutes in all | u worst | floor | u of k pan |")
    print("|---|---|---|---|---|---|---|---|")
    for label, allowed in (("more of the same range", ~away), ("with the beams a full turn away", np.ones_like(away))):
        part = replace(shown, rows=np.where(allowed[:, None, None], shown.rows, 0.0))
        problem = DesignProblem(sharp, wide, part, structs.replace(TARGET, limit=UNREACHED), first.at)
        more = design_family(problem, Scope(largest=16))
        for n in (2, 4, 8, 16):
            after = information_of(more.arranged(n).steps, sharp)
            covariance = covariance_of(sharp.precision + after.fisher)
            floor = first.at.value(covariance_of(sharp.precision + MANY_TIMES * after.fisher))
            picked = int(away[more.picks[: 4 * n]].sum())
            minutes = first.information.minutes + after.minutes
            ratio = covariance[0, 0] ** 0.5 * rig.table.priors["degrees_per_step.pan"].u
            numbers = f"{1e4 * first.at.value(covariance):.2f} | {1e4 * floor:.2f} | {1e4 * ratio:.2f}"
            print(f"| {label} | {n} | {first.spots + 4 * n} | {picked} | {minutes:.1f} | {numbers} |")


def main() -> None:
    print_only(__doc__)
    use_compilation_cache()
    knowledge = prior_knowledge(mounted_rig())
    pool = candidates(knowledge)
    looks = LookArrays(pool.looks, knowledge, False).at(knowledge.z, knowledge.space)
    target, pose = structs.replace(TARGET, limit=UNREACHED), looks.mirror_angles_rad.mean(axis=0)
    at = sensitivity(target, knowledge.z, knowledge.space, knowledge.rig.table, pose)
    family = design_family(DesignProblem(knowledge, pool, looks, target, at))
    plans = {"paper": [paper_protocol(n) for n in REPEATS], "mixed": [mixed_protocol(n) for n in REPEATS]}
    plans |= {"grid": [grid_protocol()], "planned": [family.arranged(n).steps for n in LADDER]}
    sessions = {name: [session(knowledge, steps) for steps in of] for name, of in plans.items()}
    curves = curves_of(sessions)
    print("# Planned looks against the paper's 96 experiments\n")
    print("Written by `python -m experiments.planning.planned_looks`; u of the worst effective ratio, 1e-4 deg/step.\n")
    print("| plan | spots | minutes | u | what it consists of | floor | what sets it |\n|---|---|---|---|---|---|---|")
    print("\n".join(rows_of(sessions)))
    print("\n## To the uncertainty of a protocol\n")
    print(heading("as good as | u | spots | minutes | planned: spots | planned: minutes | times faster"))
    for name in ("paper", "mixed", "grid"):
        one = curves[name][-1 if name != "grid" else 0]
        enough = next((p for p in curves["planned"] if p.value <= one.value), None)
        cells = "- | - | -"
        if enough is not None:
            cells = f"{enough.spots} | {enough.minutes:.1f} | {one.minutes / enough.minutes:.0f}"
        print(f"| {name} | {1e4 * one.value:.2f} | {one.spots} | {one.minutes:.1f} | {cells} |")
    second_session(sessions["planned"][LADDER.index(16)])


if __name__ == "__main__":
    main()
