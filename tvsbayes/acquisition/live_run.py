"""A run as it is looked at while it goes on: the engine publishes, whoever looks reads the latest and may ask.

Publication goes one way and is one assignment: a reader that is slow, many or dead costs the engine nothing, and
misses what it did not read. The only way back is the queue of `live_requests`. Pictures are made small by the reader.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any

from tvsbayes.acquisition.live_requests import CONTROL_PASSED, REQUESTS, Requests
from tvsbayes.acquisition.live_snapshot import (
    ENDED,
    ESTIMATES_MAX,
    REMARKS_MAX,
    TRAIL_MAX,
    Fault,
    SeenLook,
    Snapshot,
    temperature,
)
from tvsbayes.acquisition.running_estimate import Estimate
from tvsbayes.files.images import decode_image, small_picture
from tvsbayes.instrument.campaign import CAMERAS, frame_name

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

    def told(self) -> dict[str, Any]:
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
            "requests": [asdict(request) for request in self.requests.told()],
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
