"""Advice of `plan` for further measurement, and `results/plan.json`, from which reports show the next experiments.

Values and gains in the unit of the target, times in minutes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Literal

from msgspec import structs

from tvsbayes.instrument.campaign import Campaign
from tvsbayes.instrument.plan import PlanStep
from tvsbayes.results.records import Record, read_record, stored_document

PLAN_FORMAT = "tvsbayes-plan/1"


class Action(Record, frozen=True, omit_defaults=True):
    """An action of a plan, with the counters and the sheet that it names."""

    action: Literal["home", "place", "move", "look"]
    pan_steps: int | None = None
    tilt_steps: int | None = None
    target: str = ""


def actions_of(steps: Iterable[PlanStep]) -> tuple[Action, ...]:
    """The actions of a plan."""
    return tuple(Action(step.action, step.pan_steps, step.tilt_steps, step.target) for step in steps)


def steps_of(actions: Iterable[Action], first: int = 0) -> tuple[PlanStep, ...]:
    """Actions as steps of a plan, numbered from `first`."""
    return tuple(PlanStep(number, *structs.astuple(action)) for number, action in enumerate(actions, first))


class Batch(Record, frozen=True):
    """A possible next experiment: four looks at one sheet and their expected gain."""

    actions: tuple[Action, ...]
    minutes: float
    gain: float
    gain_per_minute: float
    text: str


class Advice(Record, frozen=True):
    """Whether to stop measuring, with the rule."""

    now: bool
    reason: str
    rule: str


class StatedTarget(Record, frozen=True):
    """The target, in words, with the unit of its value."""

    text: str
    unit: str


class Obstacle(Record, frozen=True):
    """The input uncertainty that would make the target attainable, in words; None where no input limits it."""

    needed: str | None = None


class PlanRecord(Record, frozen=True):
    """A plan that continues a campaign, as reports show it.

    Attributes:
        target: the target.
        now: its value from the campaign alone.
        stop: whether to stop measuring.
        limited_by: the input that limits the target.
        next: possible next experiments, best first.
    """

    target: StatedTarget
    now: float
    stop: Advice
    limited_by: Obstacle
    next: tuple[Batch, ...]


def plan_document(plan: Mapping[str, object], inputs: Mapping[str, str]) -> dict[str, object]:
    """The content of `results/plan.json`: the document of `plan --json` with the hashes of the campaign's inputs."""
    return {"format": PLAN_FORMAT, "inputs": dict(inputs), **plan}


def stored_plan(campaign: Campaign, inputs: Mapping[str, str]) -> PlanRecord | None:
    """The plan of `plan --given` in `results/`, if it was made from the data and priors with these hashes.

    Raises:
        InputError: the file is damaged or of another version, with the key.
    """
    keys = stored_document(campaign, "plan.json", (PLAN_FORMAT,), inputs)
    if keys is None:
        return None
    keys.number("now", 0.0, 1e6)
    return read_record(PlanRecord, keys, "run `tvsbayes plan --given` again")
