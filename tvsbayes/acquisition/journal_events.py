"""The events of a run's journal, the JSON objects in `log.jsonl`: structs, distinguished by the key `event`.

`created` opens a journal. An `intent` precedes every motion of the plan, and every completed order has an event:
`homed`, `placed`, `moved`, `looked`. `place_command` is a run of a program that places the sheet. `adapted` changes the
plan, `confirmed` states whether the posterior meets the target, `asked` (to 0.3.0) is a request of a page, `verified`
closes a segment, `start` and `stop` enclose a run, `gap` replaces lines lost in a repair. Counters in motor steps, raw
px, degrees and seconds by suffix; `utc` and `created` are ISO 8601. Fields have the order in which they are written;
fields that are UNSET by default may be missing.

A checksum detects accidents, not forgery: `journal.event_of` checks the entries of an event against its declaration.
"""

from __future__ import annotations

import re
from typing import Annotated, Any

from msgspec import UNSET, Meta, Struct, UnsetType, to_builtins

from tvsbayes.results.records import ClosedRecord

Four = tuple[float, float, float, float]
"""u_left, v_left, u_right, v_right."""


class Event(Struct, frozen=True, kw_only=True, tag_field="event", tag=str.lower):
    """Base of the events; unknown keys are ignored."""

    def entries(self) -> dict[str, Any]:
        """The entries of its JSON object but for its kind."""
        content = to_builtins(self, enc_hook=float)
        del content["event"]
        return content


class Created(Event, frozen=True):
    """The first event: it identifies a plan by its SHA-256, a rig by the entries that may not change.

    Earlier journals identify the rig by a SHA-256 too.
    """

    format: str
    created: str
    name: str | UnsetType = UNSET
    synthetic: bool | UnsetType = UNSET
    seed: int | UnsetType = UNSET
    plan_sha256: str | UnsetType = UNSET
    rig: dict[str, Any] | UnsetType = UNSET
    rig_sha256: str | UnsetType = UNSET
    repaired: bool | UnsetType = UNSET


class Start(Event, frozen=True):
    """A run begins, for the first time or again: settings that may differ between runs, device and cameras."""

    utc: str = ""
    setup: dict[str, Any] | UnsetType = UNSET
    device: dict[str, Any] | UnsetType = UNSET
    cameras: dict[str, Any] | UnsetType = UNSET
    simulated: bool | UnsetType = UNSET


class Placed(Event, frozen=True):
    """The sheet stands at a target; `again` where the plan did not ask for it."""

    step: int | None
    target: str
    again: bool | UnsetType = UNSET
    utc: str = ""


class PlaceCommanded(Event, frozen=True, kw_only=True, tag="place_command"):
    """A program has placed the sheet (`exit_code` 0) or failed; None where it had to be ended.

    `words`: the end of its output of `output_bytes`; `left_running`: it left something running, which was ended.
    `placement` counts the placements of the plan from 0. `placed` follows after success.
    """

    time_s: float | UnsetType = UNSET
    target: str
    x_mm: float
    placement: int
    command: list[str]
    exit_code: int | None
    seconds: float
    limit_s: float
    words: str
    output_bytes: int | UnsetType = UNSET
    left_running: bool | UnsetType = UNSET


class TrueAngles(Struct, frozen=True):
    """Mirror angles (psi, beta) of a simulated rig at rest, and the stop errors (pan, tilt) in them, degrees."""

    mirror_angles_deg: tuple[float, float]
    stop_errors_deg: tuple[float, float]


class Motion(Event, frozen=True):
    """A motion has ended at these counters, `time_s` after the campaign was created.

    `step` is the step of the plan, None for motions of a resumed run.
    """

    step: int | None
    time_s: float
    pan_steps: int
    tilt_steps: int


class Moved(Motion, frozen=True):
    """A move is completed; `twin` holds the true mirror angles of a simulation."""

    reference: bool | UnsetType = UNSET
    twin: TrueAngles | UnsetType = UNSET


class Homed(Motion, frozen=True):
    """A homing and the motion to its counters: boot id of the device, side of arrival of pan and tilt."""

    boot: int
    approach: tuple[str, str]
    twin: TrueAngles | UnsetType = UNSET


class Verified(Event, frozen=True):
    """Result of a homing for the segment before: (pan, tilt) switches minus counters; None where it is unknown."""

    segment: int
    deviation_steps: tuple[int, int] | None


FRAME_NAME = re.compile(r"(?:frames|dark)/[0-9]{6}_(?:left|right)\.png")
"""Names made by `instrument.campaign.frame_name`."""


class Frame(ClosedRecord, frozen=True, rename={"size": "bytes"}):
    """A stored picture: name relative to the folder, SHA-256 of the file, its size in bytes."""

    name: Annotated[str, Meta(pattern=rf"\A{FRAME_NAME.pattern}\Z")]
    sha256: str
    size: int


class Looked(Event, frozen=True):
    """A look and the detector's result.

    `reference_of` is the spot with which a look of a resumed run is compared, `shift_px` the largest change.
    """

    step: int | None
    spot: int
    target: str
    experiment: int | None
    point: int | None
    status: str
    pixels_px: Four | None
    sds_px: Four | None
    correlations: tuple[float, float] = (0.0, 0.0)
    frames: tuple[Frame, ...] = ()
    time_s: float | UnsetType = UNSET
    reference_of: int | UnsetType = UNSET
    shift_px: float | UnsetType | None = UNSET
    aperture_deg: float | UnsetType | None = UNSET


class Adapted(Event, frozen=True):
    """A change of plan: the new steps from row `row` on, and the reason for them.

    Each look has the expected target value before and after it; `looks` is the number behind the estimate.
    """

    row: int
    looks: int
    why: str
    steps: tuple[dict[str, Any], ...]


class Confirmed(Event, frozen=True):
    """Whether the posterior, sampled where the Laplace approximation met the target, meets it too.

    From `looks` looks; worst u of the directions by both, deg/step; `accepted`: whether the weighted draws may be used.
    """

    looks: int
    target_u_deg_per_step: float
    laplace_u_deg_per_step: float
    importance_u_deg_per_step: float
    accepted: bool
    reached: bool


class AskedDevice(Struct, frozen=True):
    """A device's answer to a request: status, laser, boot id and counters."""

    status: str
    laser_on: bool
    boot: int
    pan_steps: int
    tilt_steps: int


class Asked(Event, frozen=True, kw_only=True):
    """A request of a page to a run, as journals of releases up to 0.3.0 hold it; nothing follows from it."""

    time_s: float | UnsetType = UNSET
    number: int
    what: str
    device: AskedDevice


class Stop(Event, frozen=True):
    """The end of a run."""

    reason: str
    exit_code: int | UnsetType = UNSET
    utc: str = ""


class Gap(Event, frozen=True):
    """Lines were lost before a line of the journal that was repaired.

    `motion_lost` is false where the missing lines contained no motion: later events then count.
    """

    before_line: int
    motion_lost: bool = True
