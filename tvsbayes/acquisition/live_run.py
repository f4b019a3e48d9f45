"""A run as it is looked at while it goes on: the engine publishes, anyone who looks reads the latest and may ask.

Publication goes one way and is one assignment: a reader that is slow, many or dead costs the engine nothing, and
misses what it did not read. The only way back is the queue of `live_control`. Pictures are made small by the reader.
What is published is frozen, and bounded whatever the length of a run: the last look with its pictures, the last
centres, estimates and remarks. Raw px, counters in motor steps, degrees per step, seconds where a name says `_s`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from tvsbayes.acquisition.journal_events import Four
from tvsbayes.acquisition.live_control import CONTROL_PASSED, REQUESTS, Requests
from tvsbayes.acquisition.operator import Progress
from tvsbayes.acquisition.running_estimate import Aim, Estimate
from tvsbayes.files.images import decode_image, small_picture
from tvsbayes.instrument.campaign import CAMERAS, frame_name
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


KINDS = ("whole", "spot")
"""Of pictures: all of it, small; the surroundings of the spot as they are."""


class LiveRun:
    """One run: snapshots out, requests in.

    Args:
        begun: called once when the run begins.

    Attributes:
        requests: what is asked of the run.
        latest: the newest snapshot; replaced as a whole.
    """

    def __init__(self, begun: Callable[[], None] = lambda: None):
        self.begun = begun
        self.requests = Requests()
        self.latest = Snapshot()

    def publish(self, **changes: Any) -> None:
        """Fields of `Snapshot` that have changed. The engine's alone."""
        self.latest = replace(self.latest, number=self.latest.number + 1, **changes)

    def looked(self, look: SeenLook) -> None:
        """A look was taken."""
        counts = look.status == "ok" and look.pixels_px is not None
        trail = (*self.latest.trail, look.pixels_px)[-TRAIL_MAX:] if counts else self.latest.trail
        self.publish(look=look, trail=trail)

    def estimated(self, estimate: Estimate | None) -> None:
        """The latest estimate, which may be known already."""
        before = self.latest.estimates
        if estimate is not None and (not before or before[-1] is not estimate):
            self.publish(estimates=(*before, estimate)[-ESTIMATES_MAX:])

    def remarked(self, remark: str) -> None:
        """Something that the user should know."""
        self.publish(remarks=(*self.latest.remarks, remark)[-REMARKS_MAX:])

    def ended(self, reason: str, error: BaseException | None = None) -> None:
        """The run is over, after a fault where there was one."""
        fault, answer = None, "the run has ended, its last order was laser off"
        if error is not None:
            # Nor does anybody know whether that order has arrived.
            answer = "the run has ended in a fault: cut the laser's supply, it may be on"
            code, remedy = getattr(error, "code", type(error).__name__), getattr(error, "remedy", None)
            fault = Fault(str(code), str(error) or str(code), remedy or "")
        self.requests.close(answer)
        self.publish(state=ENDED, reason=reason, fault=fault)

    def ask(self, what: str) -> bool:
        """Puts a request in the queue; False once the run has ended.

        Raises:
            ValueError: nothing that can be asked for.
        """
        if what not in REQUESTS:
            raise ValueError(what)
        return self.requests.ask(what) is not None

    def control_passed(self) -> None:
        """Another browser controls from now on: written down by the engine, as what was asked for is."""
        self.requests.ask(CONTROL_PASSED)

    def document(self) -> dict[str, Any]:
        """The newest snapshot and the requests, as JSON holds them."""
        now = self.latest
        fields = asdict(replace(now, look=None, trail=()))
        look = None
        if now.look is not None:
            look = asdict(replace(now.look, pictures={}))
            look["pictured"] = [c for c in CAMERAS if frame_name(now.look.spot, c) in now.look.pictures]
        moved = temperature(now.estimates)
        return {
            **fields,
            "look": look,
            "trail": [list(centre) for centre in now.trail],
            "temperature": None if moved is None else asdict(moved),
            "requests": [asdict(request) for request in self.requests.recent()],
        }

    def picture(self, spot: int, camera: str, kind: str) -> bytes | None:
        """JPEG of the last look, if it is this one and has pictures."""
        look = self.latest.look
        if look is None or look.spot != spot or camera not in CAMERAS or kind not in KINDS:
            return None
        png = look.pictures.get(frame_name(spot, camera))
        if png is None or (kind == "spot" and look.pixels_px is None):
            return None
        first = 2 * CAMERAS.index(camera)
        centre = None
        if look.pixels_px is not None and kind == "spot":
            centre = look.pixels_px[first], look.pixels_px[first + 1]
        try:
            return small_picture(decode_image(png, "picture"), centre)
        except ValueError:
            return None
