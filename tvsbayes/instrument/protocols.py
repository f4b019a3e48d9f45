"""The standard plans: the paper's four-point experiments, mixtures of them, and grids of poses. Counters in steps.

A start is `reversed` when it is reached by a move against the experiment's direction (the experiment crosses the play),
`cleared` when it is reached by a move along it (play already taken up), and `direct` when it is reached from the axis'
present position.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from tvsbayes.instrument.axes import DIRECTION_SIGNS
from tvsbayes.instrument.plan import PlanBuilder, PlanStep

PAN_RANGE_STEPS = (0, 200)
TILT_RANGE_STEPS = (-100, 100)
RUN_UP_STEPS = 40
"""Distance beyond a start at which an approach begins: 2.4 deg at 0.06 deg/step, more than any play to be measured."""
GRID_PAN_STEPS = (-60, 0, 60, 120, 180, 240)
GRID_TILT_STEPS = (-90, -30, 30, 90)


def four_point_protocol(
    repeats: int = 24,
    steps: Sequence[int] = (200,),
    approaches: Mapping[str, Sequence[str]] | None = None,
    targets: tuple[str, str] = ("d1", "d2"),
    pan_range_steps: tuple[int, int] = PAN_RANGE_STEPS,
    tilt_range_steps: tuple[int, int] = TILT_RANGE_STEPS,
) -> tuple[PlanStep, ...]:
    """The paper's four-point experiments, in its order: point 1 at d1, 2 at d2, move N, 3 at d2, 4 at d1.

    Left and right are at mid tilt, then up and down at mid pan. Positive moves start from the low end of the
    range, negative ones from the high end.

    Args:
        repeats: experiments per direction.
        steps: |N| of the experiments, taken in turn.
        approaches: direction -> "reversed", "cleared" or "direct" of its experiments, taken in turn;
            default: all direct, i.e. plain go and return.
        targets: names of the near and the far sheet.
        pan_range_steps: lowest and highest pan counter.
        tilt_range_steps: lowest and highest tilt counter.
    """
    ranges = {"pan": pan_range_steps, "tilt": tilt_range_steps}
    plan, experiment = PlanBuilder(), 0
    plan.home()
    plan.place(targets[0])
    for direction, (axis, sign) in DIRECTION_SIGNS.items():
        other_axis = "tilt" if axis == "pan" else "pan"
        plan.move(**{other_axis: sum(ranges[other_axis]) // 2})
        start = ranges[axis][0 if sign > 0 else 1]
        kinds = (approaches or {}).get(direction, ("direct",))
        for repeat in range(repeats):
            approach = kinds[repeat % len(kinds)]
            if approach == "direct":
                plan.move(**{axis: start})
            else:
                plan.reach(axis, start, sign if approach == "cleared" else -sign, RUN_UP_STEPS)
            plan.look(experiment, 1)
            plan.place(targets[1])
            plan.look(experiment, 2)
            plan.move(**{axis: start + sign * steps[repeat % len(steps)]})
            plan.look(experiment, 3)
            plan.place(targets[0])
            plan.look(experiment, 4)
            experiment += 1
    return tuple(plan.steps)


def paper_protocol(repeats: int = 24, targets: tuple[str, str] = ("d1", "d2")) -> tuple[PlanStep, ...]:
    """The paper's protocol as published: one |N| = 200, plain go and return.

    Every start is then reversed, but for the first after homing.
    """
    return four_point_protocol(repeats, targets=targets)


def twin_protocol(repeats: int = 24) -> tuple[PlanStep, ...]:
    """The move history for which one backlash per axis gives Table 1: left, down reversed; right, up cleared.

    The paper does not state how its starts were reached: this history is an assumption.
    """
    history = {"left": "reversed", "right": "cleared", "up": "cleared", "down": "reversed"}
    return four_point_protocol(repeats, approaches={name: (kind,) for name, kind in history.items()})


def mixed_protocol(repeats: int = 24, targets: tuple[str, str] = ("d1", "d2")) -> tuple[PlanStep, ...]:
    """The paper's experiments with |N| = 100 and 200 in turn, and two of every six from cleared starts."""
    turns = ("reversed", "reversed", "reversed", "cleared", "cleared", "reversed")
    approaches = dict.fromkeys(DIRECTION_SIGNS, turns)
    return four_point_protocol(repeats, steps=(100, 200), approaches=approaches, targets=targets)


def grid_protocol(
    targets: Sequence[str] = ("d1", "d2", "d3"),
    pan_steps: Sequence[int] = GRID_PAN_STEPS,
    tilt_steps: Sequence[int] = GRID_TILT_STEPS,
) -> tuple[PlanStep, ...]:
    """A grid of poses at every sheet, each pose seen once from either side of both axes.

    Rows of tilt are taken upwards, then downwards, with the play of each axis taken up before the row's first look.
    Rows alternate between left and right; on the way down each takes the opposite sense. One placement per sheet.
    """
    plan = PlanBuilder()
    plan.home()
    for target in targets:
        plan.place(target)
        for tilt_sign in (1, -1):
            for row, tilt in enumerate(sorted(tilt_steps, reverse=tilt_sign < 0)):
                rank = row if tilt_sign > 0 else len(tilt_steps) - 1 - row
                pan_sign = tilt_sign * (1 if rank % 2 == 0 else -1)
                ordered = sorted(pan_steps, reverse=pan_sign < 0)
                run_up = ordered[0] - pan_sign * RUN_UP_STEPS
                if (tilt - plan.at[1]) * tilt_sign <= 0:
                    plan.move(pan=run_up, tilt=tilt - tilt_sign * RUN_UP_STEPS)
                plan.move(pan=run_up, tilt=tilt)
                for pan in ordered:
                    plan.move(pan=pan)
                    plan.look()
    return tuple(plan.steps)


PROTOCOLS = {
    "paper": paper_protocol,
    "mixed": mixed_protocol,
    "grid": grid_protocol,
    "paper_twin": twin_protocol,
}
"""Plans that `experiments/inputs/make_twins.py` ships, by file name."""
UNSTATED_STEPS = {
    "pan": (min(GRID_PAN_STEPS) - RUN_UP_STEPS, max(GRID_PAN_STEPS) + RUN_UP_STEPS),
    "tilt": (min(GRID_TILT_STEPS) - RUN_UP_STEPS, max(GRID_TILT_STEPS) + RUN_UP_STEPS),
}
"""Counters used where `[positioner]` states no limits: the ranges of the grid protocol."""
