"""Advice of `plan` for further measurement, and `results/plan.json`, from which reports show the next experiments.

Values and gains in the unit of the target, times in minutes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from tvsbayes.files.documents import Keys
from tvsbayes.instrument.campaign import Campaign
from tvsbayes.instrument.plan import PlanStep
from tvsbayes.results.records import Record, read_record, stored_document

PLAN_FORMAT = "tvsbayes-plan/1"


@dataclass(frozen=True)
class Batch:
    """A possible next experiment: four looks at one sheet and their expected gain; read back without its actions."""

    actions: tuple[PlanStep, ...]
    minutes: float
    gain: float
    gain_per_minute: float
    text: str


@dataclass(frozen=True)
class Advice:
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
    again = "run `tvsbayes plan --given` again"
    batches = keys.values.get("next")
    if not isinstance(batches, list) or not all(isinstance(batch, dict) for batch in batches):
        raise keys.refuse("next", "list", "a list of tables", again)
    keys.number("now", 0.0, 1e6)
    # Reports show the experiments in words, without their steps.
    shown = {**keys.values, "next": [{**batch, "actions": []} for batch in batches]}
    return read_record(PlanRecord, Keys(shown, keys.file, keys.text), again)
