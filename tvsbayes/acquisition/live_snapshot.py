"""What there is to see of a run at one moment: frozen, so that a page may read it while the engine goes on.

Bounded whatever the length of a run: the last look with its pictures, the last centres, estimates and remarks. Raw px,
counters in motor steps, degrees per step, seconds where a name says `_s`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from tvsbayes.acquisition.journal_events import Four
from tvsbayes.acquisition.operator import Progress
from tvsbayes.acquisition.running_estimate import Aim, Estimate
from tvsbayes.positioner.protocol import DeviceState

TRAIL_MAX = 60
"""Centres of earlier looks that are still shown."""
ESTIMATES_MAX = 100
REMARKS_MAX = 20
COMING_MAX = 6
"""Steps of the plan that are announced."""
RUNNING, PAUSED, ENDED = "running", "paused", "ended"


@dataclass(frozen=True)
class SeenLook:
    """A look.

    Attributes:
        spot: its number.
        status: "ok", "undetected", or the reason of refusal.
        target: where the sheet stood.
        pixels_px: u_left, v_left, u_right, v_right; None where no spot was found.
        sds_px: their standard uncertainties.
        pictures: PNG by name, with the laser on; empty where none were made.
    """

    spot: int
    status: str
    target: str
    pixels_px: Four | None
    sds_px: Four | None
    pictures: Mapping[str, bytes] = field(default_factory=dict, repr=False)


@dataclass(frozen=True)
class Fault:
    """What has ended a run: a code, the message, and what to do."""

    code: str
    message: str
    remedy: str


@dataclass(frozen=True)
class Snapshot:
    """A run at one moment.

    Attributes:
        number: grows with every snapshot.
        name: of the campaign.
        image_px: width and height of both cameras.
        simulated: whether it is the twin.
        state: running, paused or ended.
        progress: None before the first step.
        coming: the next steps, in words.
        device: what it said last.
        look: the last one.
        trail: centres of the last looks that count.
        estimates: one after the other.
        aim: what they are for.
        remarks: what happened beside the plan, newest last.
        warnings: what the user should know.
        fault: what ended the run.
        reason: why it ended, "" before.
    """

    number: int = 0
    name: str = ""
    image_px: tuple[int, int] = (0, 0)
    simulated: bool = False
    state: str = RUNNING
    progress: Progress | None = None
    coming: tuple[str, ...] = ()
    device: DeviceState | None = None
    look: SeenLook | None = None
    trail: tuple[Four, ...] = ()
    estimates: tuple[Estimate, ...] = ()
    aim: Aim = field(default_factory=Aim)
    remarks: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    fault: Fault | None = None
    reason: str = ""


@dataclass(frozen=True)
class Temperature:
    """How far an estimate has moved by its latest looks, measured by how far they should move it.

    The second fit holds the looks of the first, so their difference has the variance that the new looks took away:
    u_before^2 - u_after^2 (Hausman, Econometrica 46, 1251, 1978). A drift, a knocked camera or lost steps show as
    differences of many of these.

    Attributes:
        moved: by direction, the difference over that standard deviation; None where the uncertainty did not shrink.
        rms: over the directions that have one, None for none; about 1 for looks that agree with each other.
    """

    moved: dict[str, float | None]
    rms: float | None


def temperature(estimates: Sequence[Estimate]) -> Temperature | None:
    """Of the newest estimate against the last one of fewer looks and the same kind; None where there is none."""
    after = estimates[-1] if estimates else None
    earlier = [e for e in estimates if after is not None and e.tier == after.tier and e.looks < after.looks]
    if after is None or not earlier:
        return None
    before = earlier[-1]
    moved: dict[str, float | None] = {}
    for name, value in after.deg_per_step.items():
        if name in before.deg_per_step:
            spare = before.u_deg_per_step[name] ** 2 - after.u_deg_per_step[name] ** 2
            moved[name] = (value - before.deg_per_step[name]) / math.sqrt(spare) if spare > 0 else None
    known = [value for value in moved.values() if value is not None]
    return Temperature(moved, math.sqrt(sum(v * v for v in known) / len(known)) if known else None)
