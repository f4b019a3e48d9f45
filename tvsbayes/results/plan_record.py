"""What `plan` says of going on, and `results/plan.json`, from which a report shows what to measure next.

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
    """A possible next experiment: four looks at one sheet and what they bring; read back without its actions."""

    actions: tuple[PlanStep, ...]
    minutes: float
    gain: float
    gain_per_minute: float
    text: str


@dataclass(frozen=True)
class Advice:
    """Whether to stop measuring, and the rule."""

    now: bool
    reason: str
    rule: str


class StatedTarget(Record, frozen=True):
    """What was wanted, in words, and the unit of its value."""

    text: str
    unit: str


class Obstacle(Record, frozen=True):
    """In words, the input uncertainty that would bring the target into reach; None where no input is in the way."""

    needed: str | None = None


class PlanRecord(Record, frozen=True):
    """What reports show of a plan that goes on from a campaign.

    Attributes:
        target: what was wanted.
        now: its value by the campaign alone.
        stop: whether to go on.
        limited_by: what stands in the way.
        next: possible next experiments, best first.
    """

    target: StatedTarget
    now: float
    stop: Advice
    limited_by: Obstacle
    next: tuple[Batch, ...]


def plan_document(plan: Mapping[str, object], inputs: Mapping[str, str]) -> dict[str, object]:
    """The content of `results/plan.json`: the document of `plan --json` and the hashes of what it goes on from."""
    return {"format": PLAN_FORMAT, "inputs": dict(inputs), **plan}


def stored_plan(campaign: Campaign, inputs: Mapping[str, str]) -> PlanRecord | None:
    """What `plan --given` left in `results/`, if it was made from the data and priors with these hashes.

    Raises:
        InputError: it is damaged or of another version, with the key.
    """
    keys = stored_document(campaign, "plan.json", (PLAN_FORMAT,), inputs)
    if keys is None:
        return None
    again = "run `tvsbayes plan --given` again"
    batches = keys.values.get("next")
    if not isinstance(batches, list) or not all(isinstance(batch, dict) for batch in batches):
        raise keys.refuse("next", "list", "a list of tables", again)
    keys.number("now", 0.0, 1e6)
    # Steps of the experiments are for who runs them; reports show their words.
    shown = {**keys.values, "next": [{**batch, "actions": []} for batch in batches]}
    return read_record(PlanRecord, Keys(shown, keys.file, keys.text), again)
