"""A plan: steps, file, cost, what following it visits; the standard plans."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from pathlib import Path
from typing import Literal

import numpy as np

from tvsbayes.errors import InputError, escaped, refusal
from tvsbayes.files.csv_table import CSV_BYTES_MAX, csv_bytes, parse_table
from tvsbayes.files.disk import read_bytes, write_atomically
from tvsbayes.instrument.axes import AXES, DIRECTION_SIGNS, SIDES
from tvsbayes.instrument.campaign import COUNTER_MAX, ID_MAX, Move, check_experiments
from tvsbayes.instrument.rig import Rig


@dataclass(frozen=True, slots=True)
class PlanStep:
    """A row of `plan.csv`. `home` begins a segment; `place` names a target; `look` observes."""

    step: int
    action: Literal["home", "place", "move", "look"]
    pan_steps: int | None = None
    tilt_steps: int | None = None
    target: str = ""
    experiment: int | None = None
    point: int | None = None


_PLAN_COLUMNS = ("step", "action", "pan_steps", "tilt_steps", "target", "experiment", "point")
# Columns that an action must fill, and those it must leave empty; the others are optional.
_PLAN_ACTIONS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "home": ((), ("target", "experiment", "point")),
    "place": (("target",), ("pan_steps", "tilt_steps", "experiment", "point")),
    "move": (("pan_steps", "tilt_steps"), ("target", "experiment", "point")),
    "look": ((), ("pan_steps", "tilt_steps")),
}


def parse_plan(data: bytes, file: str = "plan.csv") -> tuple[PlanStep, ...]:
    """The checked rows of `plan.csv` (DESIGN 7); see `read_plan`."""
    table = parse_table(data, file, _PLAN_COLUMNS)
    if not len(table):
        allowed, remedy = "at least one step", "begin with step 0, action home"
        raise refusal("empty", file=file, line=1, found="no rows", allowed=allowed, remedy=remedy)
    steps = table.integers("step", 0, ID_MAX)
    table.check_counting("step", steps)
    actions, targets = table.columns["action"], table.texts("target")
    pan = table.integers("pan_steps", -COUNTER_MAX, COUNTER_MAX, empty=True)
    tilt = table.integers("tilt_steps", -COUNTER_MAX, COUNTER_MAX, empty=True)
    experiments, points = table.integers("experiment", 0, ID_MAX, True), table.integers("point", 1, 4, True)
    check_experiments(table, experiments, points, [True] * len(table))
    placed = ""
    for row, action in enumerate(actions):
        if action not in (_PLAN_ACTIONS if row else ("home",)):
            allowed = "home, place, move or look" if row else "home, the first action"
            raise table.refuse(row, "action", "action", allowed, "begin with home; one action per row")
        filled, empty = _PLAN_ACTIONS[action]
        for column in (*filled, *empty):
            if bool(table.columns[column][row]) != (column in filled):
                allowed = f"{'a value' if column in filled else 'an empty cell'} with the action {action}"
                raise table.refuse(row, column, "action", allowed, "give each action its own columns only")
        if action == "place":
            placed = targets[row]
        elif action == "look" and (not placed or targets[row] not in ("", placed)):
            allowed = f"an empty cell or {placed}, placed last" if placed else "a place before the look"
            raise table.refuse(row, "target", "target", allowed, "place the target first")
    pan, tilt = (
        [0 if action == "home" and n is None else n for action, n in zip(actions, counters, strict=True)]
        for counters in (pan, tilt)
    )
    return tuple(map(PlanStep, steps, actions, pan, tilt, targets, experiments, points))


def read_plan(path: Path) -> tuple[PlanStep, ...]:
    """Reads `plan.csv`: home (counters default to 0), place, move and look steps in order.

    Raises:
        InputError: wrong order, an action without its columns or with another's, a look before a place.
    """
    return parse_plan(read_bytes(path, CSV_BYTES_MAX), escaped(Path(path).name))


def write_plan(steps: Sequence[PlanStep], path: Path) -> None:
    """Writes `plan.csv` atomically; refuses what `read_plan` would refuse."""
    data = csv_bytes(_PLAN_COLUMNS, ([getattr(s, c) for c in _PLAN_COLUMNS] for s in steps))
    parse_plan(data, escaped(Path(path).name))
    write_atomically(path, data)


PAN_RANGE_STEPS = (0, 200)
TILT_RANGE_STEPS = (-100, 100)
OVERSHOOT_STEPS = 40
"""How far beyond a start an approach begins: 2.4 deg at 0.06 deg/step, beyond any play worth measuring."""
GRID_PAN_STEPS = (-60, 0, 60, 120, 180, 240)
GRID_TILT_STEPS = (-90, -30, 30, 90)


@dataclass
class _Plan:
    """Plan steps under construction and the counters they lead to."""

    steps: list[PlanStep] = field(default_factory=list)
    counters: dict[str, int] = field(default_factory=lambda: {"pan": 0, "tilt": 0})

    def home(self) -> None:
        self.counters = {"pan": 0, "tilt": 0}
        self.steps.append(PlanStep(len(self.steps), "home", 0, 0))

    def place(self, target: str) -> None:
        self.steps.append(PlanStep(len(self.steps), "place", target=target))

    def move(self, **counters: int) -> None:
        """Move to absolute counters; nothing is ordered where they are reached already."""
        if any(self.counters[axis] != value for axis, value in counters.items()):
            self.counters.update(counters)
            self.steps.append(PlanStep(len(self.steps), "move", self.counters["pan"], self.counters["tilt"]))

    def look(self, experiment: int | None = None, point: int | None = None) -> None:
        self.steps.append(PlanStep(len(self.steps), "look", experiment=experiment, point=point))

    def reach(self, axis: str, counter: int, sign: int, overshoot: int) -> None:
        """Arrive at a counter by a move of the given sign, by way of an overshoot where needed."""
        if (counter - self.counters[axis]) * sign <= 0:
            self.move(**{axis: counter - sign * overshoot})
        self.move(**{axis: counter})


def four_point_protocol(
    repeats: int = 24,
    steps: Sequence[int] = (200,),
    approaches: Mapping[str, Sequence[str]] | None = None,
    targets: tuple[str, str] = ("d1", "d2"),
    pan_range_steps: tuple[int, int] = PAN_RANGE_STEPS,
    tilt_range_steps: tuple[int, int] = TILT_RANGE_STEPS,
    overshoot_steps: int = OVERSHOOT_STEPS,
) -> tuple[PlanStep, ...]:
    """The paper's four-point experiments, in its order: point 1 at d1, 2 at d2, move N, 3 at d2, 4 at d1.

    Left and right at mid tilt, then up and down at mid pan. Positive moves start from the low end of the
    range, negative ones from the high end.

    Args:
        repeats: experiments per direction.
        steps: |N| of the experiments, taken in turn.
        approaches: direction -> "reversed", "cleared" or "direct" of its experiments, taken in turn;
            default: all direct, which is plain go and return.
        targets: names of the near and the far sheet.
        pan_range_steps: lowest and highest pan counter.
        tilt_range_steps: lowest and highest tilt counter.
        overshoot_steps: run-up where a start must be reached from the other side.
    """
    ranges = {"pan": pan_range_steps, "tilt": tilt_range_steps}
    plan, experiment = _Plan(), 0
    plan.home()
    plan.place(targets[0])
    for direction, (axis, sign) in DIRECTION_SIGNS.items():
        other = "tilt" if axis == "pan" else "pan"
        plan.move(**{other: sum(ranges[other]) // 2})
        start = ranges[axis][0 if sign > 0 else 1]
        turns = (approaches or {}).get(direction, ("direct",))
        for repeat in range(repeats):
            approach = turns[repeat % len(turns)]
            if approach == "direct":
                plan.move(**{axis: start})
            else:
                plan.reach(axis, start, sign if approach == "cleared" else -sign, overshoot_steps)
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
    """The paper's protocol as it reads: one |N| = 200, plain go and return.

    Every start but the first, where the homing stands, is then reversed.
    """
    return four_point_protocol(repeats, targets=targets)


def twin_protocol(repeats: int = 24) -> tuple[PlanStep, ...]:
    """The history under which one backlash per axis gives Table 1: left, down reversed; right, up cleared.

    The paper does not record how its starts were reached: this is our assumption.
    """
    history = {"left": "reversed", "right": "cleared", "up": "cleared", "down": "reversed"}
    return four_point_protocol(repeats, approaches={name: (how,) for name, how in history.items()})


def mixed_protocol(repeats: int = 24, targets: tuple[str, str] = ("d1", "d2")) -> tuple[PlanStep, ...]:
    """The paper's experiments with |N| = 100 and 200 in turn, and two in six from cleared starts."""
    turns = ("reversed", "reversed", "reversed", "cleared", "cleared", "reversed")
    approaches = dict.fromkeys(DIRECTION_SIGNS, turns)
    return four_point_protocol(repeats, steps=(100, 200), approaches=approaches, targets=targets)


def grid_protocol(
    targets: Sequence[str] = ("d1", "d2", "d3"),
    pan_steps: Sequence[int] = GRID_PAN_STEPS,
    tilt_steps: Sequence[int] = GRID_TILT_STEPS,
    overshoot_steps: int = OVERSHOOT_STEPS,
) -> tuple[PlanStep, ...]:
    """A grid of poses at every sheet, each pose seen once from either side of both axes.

    Rows of tilt upwards, then downwards, each axis taken up before the row's first look; rows alternate
    between left and right, and the way down takes each row the other way. One placement per sheet.
    """
    plan = _Plan()
    plan.home()
    for target in targets:
        plan.place(target)
        for tilt_sign in (1, -1):
            for row, tilt in enumerate(sorted(tilt_steps, reverse=tilt_sign < 0)):
                rank = row if tilt_sign > 0 else len(tilt_steps) - 1 - row
                pan_sign = tilt_sign * (1 if rank % 2 == 0 else -1)
                ordered = sorted(pan_steps, reverse=pan_sign < 0)
                run_up = ordered[0] - pan_sign * overshoot_steps
                if (tilt - plan.counters["tilt"]) * tilt_sign <= 0:
                    plan.move(pan=run_up, tilt=tilt - tilt_sign * overshoot_steps)
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
"""Plans that `experiments/make_twins.py` ships, by file name."""
UNSTATED_STEPS = {
    "pan": (min(GRID_PAN_STEPS) - OVERSHOOT_STEPS, max(GRID_PAN_STEPS) + OVERSHOOT_STEPS),
    "tilt": (min(GRID_TILT_STEPS) - OVERSHOOT_STEPS, max(GRID_TILT_STEPS) + OVERSHOOT_STEPS),
}
"""Counters used where `[positioner]` states no limits: those of the grid protocol, not one step more."""


@dataclass(frozen=True)
class CounterLimits:
    """Lowest and highest counter of (pan, tilt), shape (2, 2), and a note where the rig states none."""

    steps: np.ndarray
    notes: tuple[str, ...]


def counter_limits(rig: Rig) -> CounterLimits:
    """Limits of the rig file, or else those of the grid protocol."""
    limits, missing = [], []
    for axis in ("pan", "tilt"):
        keys = f"{axis}_min_steps", f"{axis}_max_steps"
        stated = [rig.positioner.get(key) for key in keys]
        missing += [key for key, value in zip(keys, stated, strict=True) if value is None]
        limits.append([d if s is None else s for s, d in zip(stated, UNSTATED_STEPS[axis], strict=True)])
    if not missing:
        return CounterLimits(np.array(limits), ())
    note = (
        f"[positioner] does not state {', '.join(missing)}: counters stay within pan "
        f"{limits[0][0]} to {limits[0][1]}, tilt {limits[1][0]} to {limits[1][1]}; wider limits would allow longer "
        "travel, and full turns"
    )
    return CounterLimits(np.array(limits), (note,))


def outline(rig: Rig, plan: Sequence[PlanStep]) -> list[str]:
    """What a run would do, in words: the listing of `--dry-run`."""
    lines, counters = [], (0, 0)
    for step in plan:
        if step.action in ("home", "move"):
            after = (int(step.pan_steps or 0), int(step.tilt_steps or 0))
            verb = "home, then go to" if step.action == "home" else "go to"
            by = "" if step.action == "home" else f" (by {after[0] - counters[0]:+d}, {after[1] - counters[1]:+d})"
            lines.append(f"{step.step}: {verb} pan {after[0]}, tilt {after[1]}{by}")
            counters = after
        elif step.action == "place":
            lines.append(f"{step.step}: ask for the sheet at {step.target}, X = {rig.sheets_mm[step.target]:g} mm")
        else:
            name = "" if step.experiment is None else f", experiment {step.experiment} point {step.point}"
            lines.append(f"{step.step}: look{name}")
    return lines


def directions_of(plan: Iterable[PlanStep]) -> set[str]:
    """The directions in which a plan moves."""
    found, before = set(), (0, 0)
    for step in plan:
        if step.action in ("home", "move"):
            after = (int(step.pan_steps or 0), int(step.tilt_steps or 0))
            if step.action == "move":
                for change, names in zip(
                    (after[0] - before[0], after[1] - before[1]), (("left", "right"), ("up", "down")), strict=True
                ):
                    found |= {names[0]} if change > 0 else {names[1]} if change < 0 else set()
            before = after
    return found


HOME_APPROACH = ("left", "up")
"""Side from which homing ends, per axis, where the caller names none."""


@dataclass(frozen=True)
class _Standing:
    """Where a plan has come to: the sheet that stands, counters (pan, tilt), and the direction each axis came in."""

    sheet: str = ""
    at: tuple[int, int] = (0, 0)
    came: tuple[str, str] = HOME_APPROACH

    def after(self, step: PlanStep) -> _Standing:
        """As `simulation.run_plan` takes a step: a move's empty counters keep the axis where it is."""
        if step.action == "place":
            return replace(self, sheet=step.target)
        if step.action == "home":
            return replace(self, at=(step.pan_steps or 0, step.tilt_steps or 0), came=HOME_APPROACH)
        if step.action != "move":
            return self
        ordered = (step.pan_steps, step.tilt_steps)
        at = tuple(old if new is None else new for old, new in zip(self.at, ordered, strict=True))
        came = tuple(
            way if new == old else SIDES[axis][int(new > old)]
            for axis, old, new, way in zip(AXES, self.at, at, self.came, strict=True)
        )
        return replace(self, at=at, came=came)


def standing(steps: Sequence[PlanStep]) -> _Standing:
    """Where a plan ends."""
    return reduce(_Standing.after, steps, _Standing())


def described(steps: Sequence[PlanStep], before: Sequence[PlanStep] = ()) -> str:
    """Looks of a short plan on one sheet in words, after another plan."""
    now, words = standing(before), []
    for step in steps:
        now = now.after(step)
        if step.action == "look":
            words.append(f"({now.at[0]}, {now.at[1]}) by {now.came[0]}, {now.came[1]}")
    return f"{now.sheet}: " + "; ".join(words)


def step_json(step: PlanStep) -> dict[str, object]:
    """An action of a plan in a document."""
    filled = {"pan_steps": step.pan_steps, "tilt_steps": step.tilt_steps, "target": step.target or None}
    return {"action": step.action, **{k: v for k, v in filled.items() if v is not None}}


COST_KEYS = {"home": "move_s", "place": "placement_s", "move": "move_s", "look": "look_s"}
"""Entry of `[costs]` that each action of a plan takes; a homing counts as a move."""


def plan_seconds(rig: Rig, plan: Iterable[PlanStep]) -> float:
    """Duration of a plan by `[costs]`, s; what a rig that no file describes leaves unstated costs nothing."""
    return sum(float(rig.costs_s.get(COST_KEYS[step.action], 0.0)) for step in plan)


@dataclass(frozen=True)
class PlannedLook:
    """A look of a plan: its step, the number of the move it follows, and the number of the placement it looks at."""

    step: PlanStep
    move: int
    placement: int


@dataclass
class PlanLog:
    """What the plan did, in time order, while it is being read."""

    moves: list[Move] = field(default_factory=list)
    looks: list[PlannedLook] = field(default_factory=list)
    targets: list[str] = field(default_factory=list)


def run_plan(plan: Iterable[PlanStep], rig: Rig, home_approach: tuple[str, str]) -> PlanLog:
    """Turn plan steps into moves, placements and looks.

    A plan that does not begin with `home` is taken as homed at counters 0, 0. Empty counters of a move
    keep the axis where it is.
    """
    log, time_s, segment = PlanLog(), 0.0, -1
    for step in plan:
        if step.action == "home" or (not log.moves and step.action in ("move", "look")):
            segment += 1
            counters = (step.pan_steps or 0, step.tilt_steps or 0) if step.action == "home" else (0, 0)
            log.moves.append(Move(len(log.moves), segment, time_s, *counters, *home_approach))
        if step.action == "move":
            last = log.moves[-1]
            pan = last.pan_steps if step.pan_steps is None else step.pan_steps
            tilt = last.tilt_steps if step.tilt_steps is None else step.tilt_steps
            log.moves.append(Move(len(log.moves), segment, time_s, pan, tilt))
        elif step.action == "place":
            if step.target not in rig.sheets_mm:
                raise InputError(
                    "unknown-target",
                    f"plan step {step.step} places target {step.target!r}, which the rig does not have",
                    column="target",
                    found=step.target,
                    allowed=", ".join(rig.sheets_mm) or "a target named in [sheets]",
                    remedy="add the target's nominal X to [sheets] of the rig file",
                )
            log.targets.append(step.target)
        elif step.action == "look":
            if not log.targets:
                raise InputError(
                    "no-target",
                    f"plan step {step.step} looks before a target is placed",
                    column="action",
                    remedy="put a `place` step before the first `look`",
                )
            log.looks.append(PlannedLook(step, len(log.moves) - 1, len(log.targets) - 1))
        time_s += plan_seconds(rig, (step,))
    return log
