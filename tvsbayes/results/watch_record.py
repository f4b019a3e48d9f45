"""Whether a calibration still holds, as a result: verdict, what moved and by how much, what the looks can see.

Lengths in mm, angles in deg, ratios in % of themselves.
"""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from msgspec import UNSET, Meta, UnsetType

from tvsbayes.display import Shown, View
from tvsbayes.instrument.plan import PlanStep
from tvsbayes.results.records import FromOne, Positive, Probability, Record

Verdict = Literal["OK", "MOVED", "CANNOT TELL"]
OK: Verdict = "OK"
MOVED: Verdict = "MOVED"
CANNOT_TELL: Verdict = "CANNOT TELL"
type Unit = Annotated[str, Meta(extra_json_schema={"enum": ("deg", "mm", "%")})]
type Looks = Annotated[int, Meta(ge=4)]
LOOKS_MAX = 384
"""Of a plan for `watch`; a need beyond is told, not planned."""


class MovedPart(Record, frozen=True):
    """Something that moved: what, by how much, standard uncertainty and unit of both."""

    what: str
    value: float
    u: Positive
    unit: Unit


class SeenChange(Record, frozen=True):
    """What the looks can see of one change.

    Attributes:
        what: the change.
        size: that the looks should notice, in `unit`.
        power: probability with which they notice it, over all directions that it may have.
        p: of this change's own test.
    """

    what: str
    size: Positive
    unit: Unit
    power: Probability
    p: Probability


class Watch(Shown, Record, frozen=True):
    """New looks against a stored calibration.

    Attributes:
        verdict: `OK`, `MOVED` or `CANNOT_TELL`.
        p: probability of a departure like the largest one if nothing has moved, all changes together.
        false_alarm_rate: probability of `MOVED` if nothing has moved.
        moved: what moved, the best explanation first; empty unless `MOVED`.
        looks: usable new looks.
        p_all: probability of residuals this large at the fitted noise; it raises no alarm.
        changes: every change that is asked about.
        same_cameras: the new looks state the stereo calibration of the campaign.
    """

    verdict: Verdict
    p: Probability
    false_alarm_rate: Probability
    moved: tuple[MovedPart, ...]
    looks: Looks
    p_all: Probability
    changes: Annotated[tuple[SeenChange, ...], Meta(min_length=1)]
    same_cameras: bool

    def unseen(self, power: float) -> tuple[SeenChange, ...]:
        """Changes that the looks notice less often than this."""
        return tuple(change for change in self.changes if change.power < power)

    def shown(self) -> View:
        """What was asked, and what was found."""
        rows = [(c.what, c.size, c.unit, c.power, c.p) for c in self.changes]
        return View(f"Watch: {self.verdict}, p = {self.p:.3g}", ("change", "size", "unit", "power", "p"), rows)


class PlannedChange(Record, frozen=True):
    """What planned looks will see of one change.

    Attributes:
        what: the change.
        size: that should be noticed, in `unit`.
        power: probability with which the plan notices it.
        looks_needed: of the fewest looks that notice it as often as wanted, None where no number of looks does.
        homings_needed: of these.
        minutes_needed: their duration.
        looks_to_add: where no number does: looks to add to the campaign, and to take at every watch.
    """

    what: str
    size: Positive
    unit: Unit
    power: Probability
    looks_needed: FromOne | None
    homings_needed: FromOne | None
    minutes_needed: float | None
    looks_to_add: FromOne | None


class WatchPlan(Shown, Record, frozen=True, kw_only=True):
    """The fewest looks that watch a calibration.

    Attributes:
        looks, homings, minutes: size of the plan.
        minutes_allowed: what it may take.
        power_wanted: of every change.
        false_alarm_rate: of all tests together.
        met: whether every change is noticed as often as wanted.
        changes: what it will notice.
        plan: where its steps were written.
        steps: the plan; no part of the document.
    """

    looks: Looks
    homings: FromOne
    minutes: float
    minutes_allowed: float
    power_wanted: Probability
    false_alarm_rate: Probability
    met: bool
    changes: Annotated[tuple[PlannedChange, ...], Meta(min_length=1)]
    plan: str | UnsetType = UNSET
    steps: tuple[PlanStep, ...]
    beside: ClassVar = ("steps",)

    def shown(self) -> View:
        """What will be noticed."""
        rows = [(c.what, c.size, c.unit, c.power, c.looks_needed) for c in self.changes]
        title = f"WatchPlan: {self.looks} looks, {self.homings} homings, {self.minutes:.1f} minutes"
        return View(title, ("change", "size", "unit", "power", "looks needed"), rows)
