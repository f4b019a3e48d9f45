"""Whether a calibration still holds, as a result: verdict, what moved and by how much, what the looks can see.

Lengths in mm, angles in deg, ratios in % of themselves.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from tvsbayes.display import Shown, View
from tvsbayes.instrument.plan import PlanStep

Verdict = Literal["OK", "MOVED", "CANNOT TELL"]
OK: Verdict = "OK"
MOVED: Verdict = "MOVED"
CANNOT_TELL: Verdict = "CANNOT TELL"
LOOKS_MAX = 384
"""Of a plan for `watch`; a need beyond is told, not planned."""


@dataclass(frozen=True)
class MovedPart:
    """Something that moved: what, by how much, standard uncertainty and unit of both."""

    what: str
    value: float
    u: float
    unit: str


@dataclass(frozen=True)
class SeenChange:
    """What the looks can see of one change.

    Attributes:
        what: the change.
        size: that the looks should notice, in `unit`.
        power: probability with which they notice it, over all directions that it may have.
        p: of this change's own test.
    """

    what: str
    size: float
    unit: str
    power: float
    p: float


@dataclass(frozen=True, repr=False)
class Watch(Shown):
    """New looks against a stored calibration.

    Attributes:
        verdict: `OK`, `MOVED` or `CANNOT_TELL`.
        p: probability of a departure like the largest one if nothing has moved, all changes together.
        false_alarm_rate: probability of `MOVED` if nothing has moved.
        p_all: probability of residuals this large at the fitted noise; it raises no alarm.
        moved: what moved, the best explanation first.
        changes: every change that is asked about.
        looks: usable new looks.
        same_cameras: the new looks state the stereo calibration of the campaign.
    """

    verdict: Verdict
    p: float
    false_alarm_rate: float
    p_all: float
    moved: tuple[MovedPart, ...]
    changes: tuple[SeenChange, ...]
    looks: int
    same_cameras: bool

    def unseen(self, power: float) -> tuple[SeenChange, ...]:
        """Changes that the looks notice less often than this."""
        return tuple(change for change in self.changes if change.power < power)

    def shown(self) -> View:
        """What was asked, and what was found."""
        rows = [(c.what, c.size, c.unit, c.power, c.p) for c in self.changes]
        return View(f"Watch: {self.verdict}, p = {self.p:.3g}", ("change", "size", "unit", "power", "p"), rows)

    def as_json(self) -> dict[str, Any]:
        """The document of `watch --json`."""
        return {
            "verdict": self.verdict,
            "p": self.p,
            "false_alarm_rate": self.false_alarm_rate,
            "moved": [{"what": m.what, "value": m.value, "u": m.u, "unit": m.unit} for m in self.moved],
            "looks": self.looks,
            "p_all": self.p_all,
            "changes": [
                {"what": c.what, "size": c.size, "unit": c.unit, "power": c.power, "p": c.p} for c in self.changes
            ],
            "same_cameras": self.same_cameras,
        }


@dataclass(frozen=True)
class PlannedChange:
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
    size: float
    unit: str
    power: float
    looks_needed: int | None
    homings_needed: int | None
    minutes_needed: float | None
    looks_to_add: int | None


@dataclass(frozen=True, repr=False)
class WatchPlan(Shown):
    """The fewest looks that watch a calibration.

    Attributes:
        steps: the plan.
        looks, homings, minutes: its size.
        minutes_allowed: what it may take.
        power_wanted: of every change.
        false_alarm_rate: of all tests together.
        changes: what it will notice.
    """

    steps: tuple[PlanStep, ...]
    looks: int
    homings: int
    minutes: float
    minutes_allowed: float
    power_wanted: float
    false_alarm_rate: float
    changes: tuple[PlannedChange, ...]

    @property
    def met(self) -> bool:
        """Whether every change is noticed as often as wanted."""
        return all(change.power >= self.power_wanted for change in self.changes)

    def shown(self) -> View:
        """What will be noticed."""
        rows = [(c.what, c.size, c.unit, c.power, c.looks_needed) for c in self.changes]
        title = f"WatchPlan: {self.looks} looks, {self.homings} homings, {self.minutes:.1f} minutes"
        return View(title, ("change", "size", "unit", "power", "looks needed"), rows)

    def as_json(self) -> dict[str, Any]:
        """The document of `plan --watch --json`."""
        keys = ("looks", "homings", "minutes", "minutes_allowed", "power_wanted", "false_alarm_rate", "met")
        return {**{key: getattr(self, key) for key in keys}, "changes": [vars(change) for change in self.changes]}
