"""Result of the test whether a calibration still holds: verdict, detected changes, power of the looks.

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
type Unit = Annotated[str, Meta(min_length=1, description="deg, mm or %; of an axis the unit of its readings or %")]
type Looks = Annotated[int, Meta(ge=4)]
LOOKS_MAX = 384
"""Largest number of looks in a plan for `watch`; a larger need is reported, not planned."""


class MovedPart(Record, frozen=True):
    """A part that moved: its name, the change, its standard uncertainty, and the unit of both."""

    what: str
    value: float
    u: Positive
    unit: Unit


class SeenChange(Record, frozen=True):
    """Power of the looks for one change, and its test.

    Attributes:
        what: the change.
        size: size that the looks should detect, in `unit`.
        power: probability of detecting it, averaged over all directions that it may have.
        p: p-value of this change's own test.
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
        p: probability of a largest deviation at least this large if nothing has moved, for all changes together.
        false_alarm_rate: probability of `MOVED` if nothing has moved.
        moved: detected changes, the best explanation first; empty unless `MOVED`.
        looks: usable new looks, of an axis stops.
        p_all: probability of residuals this large at the fitted noise; it raises no alarm.
        changes: every change that is tested.
        same_cameras: whether the new looks state the campaign's stereo calibration.
        home_sd_by_prior: axes whose scatter of homings is that of the prior.
    """

    verdict: Verdict
    p: Probability
    false_alarm_rate: Probability
    moved: tuple[MovedPart, ...]
    looks: Looks
    p_all: Probability
    changes: Annotated[tuple[SeenChange, ...], Meta(min_length=1)]
    same_cameras: bool
    home_sd_by_prior: tuple[str, ...] = ()

    def unseen(self, power: float) -> tuple[SeenChange, ...]:
        """Changes that the looks detect with less than this power."""
        return tuple(change for change in self.changes if change.power < power)

    def shown(self) -> View:
        """Show the tests and their results."""
        rows = [(c.what, c.size, c.unit, c.power, c.p) for c in self.changes]
        return View(f"Watch: {self.verdict}, p = {self.p:.3g}", ("change", "size", "unit", "power", "p"), rows)


class PlannedChange(Record, frozen=True):
    """Power of planned looks for one change.

    Attributes:
        what: the change.
        size: size that should be detected, in `unit`.
        power: probability that the plan detects it.
        looks_needed: fewest looks that reach the wanted power, None where no number of looks does.
        homings_needed: homings of these looks.
        minutes_needed: duration of these looks.
        looks_to_add: where no number suffices: looks to add to the campaign, and to take at every watch.
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
        minutes_allowed: largest allowed duration.
        power_wanted: power required for every change.
        false_alarm_rate: rate of all tests together.
        met: whether every change reaches the required power.
        changes: power for each change.
        plan: file of its steps.
        steps: the plan; not part of the document.
        home_sd_by_prior: axes whose scatter of homings is that of the prior.
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
    home_sd_by_prior: tuple[str, ...] = ()
    beside: ClassVar = ("steps",)

    def shown(self) -> View:
        """Show the power for each change."""
        rows = [(c.what, c.size, c.unit, c.power, c.looks_needed) for c in self.changes]
        title = f"WatchPlan: {self.looks} looks, {self.homings} homings, {self.minutes:.1f} minutes"
        return View(title, ("change", "size", "unit", "power", "looks needed"), rows)
