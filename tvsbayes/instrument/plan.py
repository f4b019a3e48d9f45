"""A plan: its steps and their file, the moves and looks that it produces, its duration, and its description in words.

This module alone defines the actions. `home` sets the counters, 0 where its cells are empty, and leaves both axes on
the side from which homing ends. `place` asks for a target. `move` goes to absolute counters; an empty cell leaves the
axis unchanged. `look` observes. A plan that does not begin with `home` begins homed at 0, 0. Counters in steps.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from tvsbayes.errors import InputError, escaped
from tvsbayes.files.csv_kind import Column, CsvKind, Values, counted
from tvsbayes.files.csv_table import CSV_BYTES_MAX, Table
from tvsbayes.files.disk import read_bytes, write_atomically
from tvsbayes.instrument.axes import AXES, HOME_APPROACH, Axis, PanApproach, TiltApproach, direction_of
from tvsbayes.instrument.campaign import Move, next_move
from tvsbayes.instrument.counter_limits import COUNTER_MAX
from tvsbayes.instrument.experiments import check_experiments
from tvsbayes.instrument.mechanisms import TWO_MIRROR, Mechanism
from tvsbayes.instrument.rig import Rig
from tvsbayes.instrument.stops import rests_of

LOOKS_PER_EXPERIMENT = 4
"""The paper counts four spots as one experiment; all curves of plans use this number for looks of any kind."""


@dataclass(frozen=True, slots=True)
class PlanStep:
    """A row of `plan.csv`. `home` begins a segment; `place` names a target; `look` observes."""

    step: Annotated[int, Column("0, 1, 2, ...", rule=counted)]
    action: Annotated[
        Literal["home", "place", "move", "look"],
        Column("`home` (the first), `place`, `move` or `look`; which columns it fills, see below"),
    ]
    pan_steps: Annotated[
        int | None, Column("absolute counters, whole numbers, or empty", -COUNTER_MAX, COUNTER_MAX)
    ] = None
    tilt_steps: Annotated[int | None, Column("", -COUNTER_MAX, COUNTER_MAX)] = None
    target: Annotated[str, Column("name of a sheet of the rig file, or empty")] = ""
    experiment: Annotated[int | None, Column("of the four-point method: number, and 1 to 4; both or neither")] = None
    point: Annotated[int | None, Column("", 1, 4)] = None
    made_for: Annotated[
        str, Column("optional, in the first row: the target of the plan; `study` judges by it", group="made_for")
    ] = ""

    def counters(self, start: tuple[int, int]) -> tuple[int, int]:
        """Counters (pan, tilt) after this step, for axes at `start` before it."""
        if self.action not in ("home", "move"):
            return start
        pan, tilt = (0, 0) if self.action == "home" else start
        return pan if self.pan_steps is None else self.pan_steps, tilt if self.tilt_steps is None else self.tilt_steps


PLANS = CsvKind(PlanStep, "plan.csv", no_rows=("at least one step", "begin with step 0, action home"))
# Columns that an action must fill, and columns that it must leave empty; the others are optional.
_PLAN_ACTIONS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "home": ((), ("target", "experiment", "point")),
    "place": (("target",), ("pan_steps", "tilt_steps", "experiment", "point")),
    "move": (("pan_steps", "tilt_steps"), ("target", "experiment", "point")),
    "look": ((), ("pan_steps", "tilt_steps")),
}


def _check_actions(table: Table, values: Values, unplaced: bool) -> None:
    """Refuse an action without its columns or with another's, and a look before a placement unless none is needed."""
    at, counters = (0, 0), []
    for action, *steps in zip(values["action"], values["pan_steps"], values["tilt_steps"], strict=True):
        at = PlanStep(0, action, *steps).counters(at)
        counters.append(at)
    check_experiments(table, values, counters, range(len(table)), [True] * len(table))
    targets, sheet = values["target"], ""
    for row, action in enumerate(values["action"]):
        if action not in (_PLAN_ACTIONS if row else ("home",)):
            allowed = "home, place, move or look" if row else "home, the first action"
            raise table.refuse(row, "action", "action", allowed, "begin with home; one action per row")
        if row and values["made_for"][row]:
            raise table.refuse(row, "made_for", "action", "a target in the first row only", "empty the cell")
        filled, empty = _PLAN_ACTIONS[action]
        for column in (*filled, *empty):
            if bool(table.columns[column][row]) != (column in filled):
                allowed = f"{'a value' if column in filled else 'an empty cell'} with the action {action}"
                raise table.refuse(row, column, "action", allowed, "give each action its own columns only")
        if action == "place":
            sheet = targets[row]
        elif action == "look" and not unplaced and (not sheet or targets[row] not in ("", sheet)):
            allowed = f"an empty cell or {sheet}, placed last" if sheet else "a place before the look"
            raise table.refuse(row, "target", "target", allowed, "place the target first")


def parse_plan(data: bytes, file: str = PLANS.file, mechanism: Mechanism = TWO_MIRROR) -> tuple[PlanStep, ...]:
    """The checked rows of `plan.csv`; see `read_plan`."""
    steps = PLANS.parse(data, file, partial(_check_actions, unplaced=mechanism.sightings))
    return tuple(
        replace(step, pan_steps=step.pan_steps or 0, tilt_steps=step.tilt_steps or 0) if step.action == "home" else step
        for step in steps
    )


def read_plan(path: Path, mechanism: Mechanism = TWO_MIRROR) -> tuple[PlanStep, ...]:
    """Read `plan.csv`: home (counters default to 0), place, move and look steps in order.

    Args:
        path: the file.
        mechanism: the plan's; a head with sightings looks without placed sheets.

    Raises:
        InputError: wrong order, an action without its columns or with another's, a look before a placement.
    """
    return parse_plan(read_bytes(path, CSV_BYTES_MAX), escaped(Path(path).name), mechanism)


def write_plan(steps: Sequence[PlanStep], path: Path, mechanism: Mechanism = TWO_MIRROR) -> None:
    """Write `plan.csv` atomically; refuse steps that `read_plan` would refuse."""
    data = PLANS.content(steps)
    parse_plan(data, escaped(Path(path).name), mechanism)
    write_atomically(path, data)


def counters_planned(plan: Sequence[PlanStep]) -> dict[str, tuple[int, int]]:
    """Return the lowest and highest counter of a plan by axis."""
    ranges: dict[str, tuple[int, int]] = {}
    for axis in AXES:
        counters = [counter for step in plan if (counter := getattr(step, f"{axis}_steps")) is not None]
        ranges[axis] = min(counters), max(counters)
    return ranges


@dataclass
class PlanBuilder:
    """Plan steps under construction, and the counters (pan, tilt) after them."""

    steps: list[PlanStep] = field(default_factory=list)
    at: tuple[int, int] = (0, 0)

    def home(self, pan: int = 0, tilt: int = 0) -> None:
        """Begin a segment at these counters."""
        self.at = (pan, tilt)
        self.steps.append(PlanStep(len(self.steps), "home", pan, tilt))

    def place(self, target: str) -> None:
        """Ask for a target; a target without a name needs no placement."""
        if target:
            self.steps.append(PlanStep(len(self.steps), "place", target=target))

    def move(self, pan: int | None = None, tilt: int | None = None) -> None:
        """Move to absolute counters; adds no step where the axes are there already."""
        previous, self.at = self.at, PlanStep(0, "move", pan, tilt).counters(self.at)
        if self.at != previous:
            self.steps.append(PlanStep(len(self.steps), "move", *self.at))

    def look(self, experiment: int | None = None, point: int | None = None) -> None:
        """Observe, as a point of an experiment or not."""
        self.steps.append(PlanStep(len(self.steps), "look", experiment=experiment, point=point))

    def reach(self, axis: Axis, counter: int, sign: int, run_up: int) -> None:
        """Arrive at a counter by a move of the given sign, with a run-up first where needed."""
        if (counter - self.at[AXES.index(axis)]) * sign <= 0:
            self.move(**{axis: counter - sign * run_up})
        self.move(**{axis: counter})


COST_KEYS = {"home": "move_s", "place": "placement_s", "move": "move_s", "look": "look_s"}
"""Entry of `[costs]` for each action of a plan; a homing counts as a move."""


def action_seconds(rig: Rig, actions: Mapping[str, int]) -> float:
    """Duration by `[costs]` of the given numbers of actions, s; an action without entry takes no time."""
    return sum(count * float(rig.costs_s.get(COST_KEYS[action], 0.0)) for action, count in actions.items())


def plan_seconds(rig: Rig, plan: Iterable[PlanStep]) -> float:
    """Duration of a plan by `[costs]`, s."""
    return action_seconds(rig, Counter(step.action for step in plan))


def plan_minutes(rig: Rig, plan: Iterable[PlanStep]) -> float:
    """Duration of a plan by `[costs]`, minutes."""
    return plan_seconds(rig, plan) / 60


@dataclass(frozen=True)
class PlannedLook:
    """A look of a plan: its step, the number of the preceding move, and the number of the observed placement."""

    step: PlanStep
    move: int
    placement: int


@dataclass
class PlanLog:
    """The moves of a plan with their times by `[costs]`, its looks, and the targets placed, in order."""

    moves: list[Move] = field(default_factory=list)
    looks: list[PlannedLook] = field(default_factory=list)
    targets: list[str] = field(default_factory=list)

    @property
    def at(self) -> tuple[int, int]:
        """Counters (pan, tilt) at the end of the plan."""
        return (self.moves[-1].pan_steps, self.moves[-1].tilt_steps) if self.moves else (0, 0)

    @property
    def sheet(self) -> str:
        """The target placed last, "" if none was placed."""
        return self.targets[-1] if self.targets else ""


def run_plan(
    plan: Iterable[PlanStep], rig: Rig, home_approach: tuple[PanApproach, TiltApproach] = HOME_APPROACH
) -> PlanLog:
    """Convert plan steps to moves, placements and looks.

    Raises:
        InputError: a look before a target is placed, or a target that the rig does not have.
    """
    log, time_s, segment = PlanLog(), 0.0, -1
    # A target without a name needs no placement.
    log.targets += [name for name in rig.depths_mm if not name]
    for step in plan:
        if step.action == "home" or (not log.moves and step.action in ("move", "look")):
            segment += 1
            counters = step.counters((0, 0)) if step.action == "home" else (0, 0)
            log.moves.append(next_move(log.moves, segment, time_s, counters, home_approach))
        if step.action == "move":
            log.moves.append(next_move(log.moves, segment, time_s, step.counters(log.at)))
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
        time_s += action_seconds(rig, {step.action: 1})
    return log


def continued(steps: Sequence[PlanStep], row: int, sheet: str) -> tuple[PlanStep, ...]:
    """Steps as rows of a plan from `row` on, without a first placement of the sheet that is in place."""
    in_place = bool(steps) and steps[0].action == "place" and steps[0].target == sheet
    return tuple(replace(step, step=row + number) for number, step in enumerate(steps[in_place:]))


def outline(rig: Rig, plan: Sequence[PlanStep]) -> list[str]:
    """The steps of a run in words: the listing of `--dry-run`."""
    lines, counters = [], (0, 0)
    for step in plan:
        previous, counters = counters, step.counters(counters)
        if step.action == "home":
            lines.append(f"{step.step}: home, then go to pan {counters[0]}, tilt {counters[1]}")
        elif step.action == "move":
            change = f"(by {counters[0] - previous[0]:+d}, {counters[1] - previous[1]:+d})"
            lines.append(f"{step.step}: go to pan {counters[0]}, tilt {counters[1]} {change}")
        elif step.action == "place":
            lines.append(f"{step.step}: ask for the sheet at {step.target}, X = {rig.sheets_mm[step.target]:g} mm")
        else:
            name = "" if step.experiment is None else f", experiment {step.experiment} point {step.point}"
            lines.append(f"{step.step}: look{name}")
    return lines


def describe_looks(rig: Rig, steps: Sequence[PlanStep], previous: Sequence[PlanStep] = ()) -> str:
    """Looks of a short plan on one sheet in words, after another plan."""
    log = run_plan((*previous, *steps), rig)
    pan, tilt = (rests_of(log.moves, axis) for axis in AXES)
    phrases = []
    for look in log.looks[sum(step.action == "look" for step in previous) :]:
        stops = pan[look.move], tilt[look.move]
        directions = ", ".join(direction_of(axis, stop.sign) for axis, stop in zip(AXES, stops, strict=True))
        phrases.append(f"({stops[0].steps}, {stops[1].steps}) by {directions}")
    return f"{log.sheet}: ".removeprefix(": ") + "; ".join(phrases)
