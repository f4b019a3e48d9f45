"""A run in progress as its readers see it: the engine publishes snapshots, readers take the latest.

Publication is one assignment: slow, many or dead readers cost the engine nothing, and miss unread snapshots. Nothing
returns from a reader to the run. The reader scales pictures down. Snapshots are frozen, and bounded for
a run of any length: the last look with its pictures, the last centres, estimates and remarks. Raw px, counters
in motor steps, degrees per step, seconds where a name says `_s`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from tvsbayes.acquisition.operator import Progress
from tvsbayes.acquisition.recorder import Four
from tvsbayes.acquisition.running_estimate import Estimate
from tvsbayes.files.images import decode_image, small_picture
from tvsbayes.instrument.campaign import CAMERAS, frame_name
from tvsbayes.positioner.protocol import DeviceState

TRAIL_MAX = 60
"""Largest number of centres of earlier looks that are shown."""
ESTIMATES_MAX = 100
REMARKS_MAX = 20
COMING_MAX = 6
"""Number of coming steps of the plan that are shown."""
RUNNING, ENDED = "running", "ended"


@dataclass(frozen=True)
class SeenLook:
    """A look.

    Attributes:
        spot: its number.
        status: "ok", "undetected", or the reason of refusal.
        target: position of the sheet.
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
class Snapshot:
    """A run at one moment.

    Attributes:
        number: grows with every snapshot.
        name: name of the campaign.
        image_px: width and height of the pictures of both cameras.
        simulated: whether the instrument is the twin.
        state: running or ended.
        progress: None before the first step.
        coming: the next steps, in words.
        device: its state after the last motion.
        look: the last look.
        trail: centres of the last looks that count.
        estimates: oldest first.
        aim: directions that the plan measures, and the target u of each, None for no target.
        remarks: events outside the plan, newest last.
        warnings: warnings for the user.
        fault: code, message and remedy of the fault that ended the run.
        reason: reason of the end, "" before.
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
    aim: Mapping[str, object] = field(default_factory=lambda: {"directions": (), "target_u_deg_per_step": None})
    remarks: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    fault: Mapping[str, str] | None = None
    reason: str = ""


@dataclass(frozen=True)
class Temperature:
    """Change of an estimate by its latest looks, relative to its expected size.

    The second fit contains the looks of the first, so their difference has the variance that the new looks removed:
    u_before^2 - u_after^2 (Hausman, Econometrica 46, 1251, 1978). A drift, a moved camera or lost steps appear as
    differences of many such standard deviations.

    Attributes:
        moved: by direction, the difference over that standard deviation; None where the uncertainty did not shrink.
        rms: over these directions, None without any; about 1 for looks that agree with each other.
    """

    moved: dict[str, float | None]
    rms: float | None


def temperature(estimates: Sequence[Estimate]) -> Temperature | None:
    """The temperature of the newest estimate against the last of the same kind with fewer looks; None without one."""
    latest = estimates[-1] if estimates else None
    earlier = [e for e in estimates if latest is not None and e.tier == latest.tier and e.looks < latest.looks]
    if latest is None or not earlier:
        return None
    previous = earlier[-1]
    moved: dict[str, float | None] = {}
    for name, value in latest.deg_per_step.items():
        if name in previous.deg_per_step:
            variance = previous.u_deg_per_step[name] ** 2 - latest.u_deg_per_step[name] ** 2
            moved[name] = (value - previous.deg_per_step[name]) / math.sqrt(variance) if variance > 0 else None
    ratios = [value for value in moved.values() if value is not None]
    return Temperature(moved, math.sqrt(sum(v * v for v in ratios) / len(ratios)) if ratios else None)


KINDS = ("whole", "spot")
"""Kinds of pictures: the whole picture scaled down, or the region around the spot at full resolution."""


class LiveRun:
    """Publishes the snapshots of one run.

    Args:
        begun: called once when the run begins.

    Attributes:
        latest: the newest snapshot; replaced as a whole.
    """

    def __init__(self, begun: Callable[[], None] = lambda: None):
        self.begun = begun
        self.latest = Snapshot()

    def publish(self, **changes: Any) -> None:
        """Replaces fields of the snapshot; only the engine calls it."""
        self.latest = replace(self.latest, number=self.latest.number + 1, **changes)

    def looked(self, look: SeenLook) -> None:
        """Publish a look."""
        counts = look.status == "ok" and look.pixels_px is not None
        trail = (*self.latest.trail, look.pixels_px)[-TRAIL_MAX:] if counts else self.latest.trail
        self.publish(look=look, trail=trail)

    def estimated(self, estimate: Estimate | None) -> None:
        """Publish an estimate; a repeated one is ignored."""
        estimates = self.latest.estimates
        if estimate is not None and (not estimates or estimates[-1] is not estimate):
            self.publish(estimates=(*estimates, estimate)[-ESTIMATES_MAX:])

    def remarked(self, remark: str) -> None:
        """Publish a remark for the user."""
        self.publish(remarks=(*self.latest.remarks, remark)[-REMARKS_MAX:])

    def ended(self, reason: str, error: BaseException | None = None) -> None:
        """Publish the end of the run, with its fault where there was one."""
        fault = None
        if error is not None:
            code, remedy = str(getattr(error, "code", type(error).__name__)), getattr(error, "remedy", None)
            fault = {"code": code, "message": str(error) or code, "remedy": remedy or ""}
        self.publish(state=ENDED, reason=reason, fault=fault)

    def document(self) -> dict[str, Any]:
        """The newest snapshot as a JSON document."""
        snapshot, look = self.latest, None
        if snapshot.look is not None:
            look = asdict(replace(snapshot.look, pictures={}))
            look["pictured"] = [c for c in CAMERAS if frame_name(snapshot.look.spot, c) in snapshot.look.pictures]
        agreement = temperature(snapshot.estimates)
        return {
            **asdict(replace(snapshot, look=None, trail=())),
            "look": look,
            "trail": [list(centre) for centre in snapshot.trail],
            "temperature": None if agreement is None else asdict(agreement),
        }

    def picture(self, spot: int, camera: str, kind: str) -> bytes | None:
        """JPEG of look `spot`, if it is the last one and has pictures."""
        look = self.latest.look
        png = None if look is None else look.pictures.get(frame_name(spot, camera))
        if look is None or png is None or kind not in KINDS or (kind == "spot" and look.pixels_px is None):
            return None
        centre = None
        if kind == "spot" and look.pixels_px is not None:
            u_left, v_left, u_right, v_right = look.pixels_px
            centre = (u_left, v_left) if camera == "left" else (u_right, v_right)
        try:
            return small_picture(decode_image(png, "picture"), centre)
        except ValueError:
            return None
