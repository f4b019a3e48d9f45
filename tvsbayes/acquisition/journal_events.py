"""The events of a run's journal, as their JSON objects stand in `log.jsonl`.

`created` opens a journal. Every motion of the plan is an `intent` before, and an order has an event of its own once it
is done: `homed`, `placed`, `moved`, `looked`. `place_command` is a program that was to place the sheet. `adapted`
changes the plan, `confirmed` says whether the posterior meets the target, `asked` is what somebody asked for on the
live page, `verified` closes a segment, `start` and `stop` enclose a run, `gap` stands where a repair lost lines.
Counters in motor steps, raw px, degrees and seconds by suffix; `utc` and `created` are ISO 8601.

A checksum finds accidents, not forgery: who reads an event converts what its entries hold, and refuses what does not
convert.
"""

from __future__ import annotations

from typing import NotRequired, TypedDict

Four = tuple[float, float, float, float]
"""u_left, v_left, u_right, v_right."""


class Created(TypedDict):
    """The first event: whose journal it is; a plan is known by its SHA-256, a rig by the entries that may not change.

    Earlier journals know the rig by a SHA-256 too.
    """

    format: str
    created: str
    name: NotRequired[str]
    synthetic: NotRequired[bool]
    seed: NotRequired[int]
    plan_sha256: NotRequired[str]
    rig: NotRequired[dict[str, object]]
    rig_sha256: NotRequired[str]
    repaired: NotRequired[bool]


class Placed(TypedDict):
    """The sheet stands at a target; `again` where the plan did not ask for it."""

    step: int | None
    target: str
    again: NotRequired[bool]
    utc: str


class PlaceCommanded(TypedDict):
    """A program has placed the sheet (`exit_code` 0) or failed to; None where it had to be ended. `words`: its output.

    `placement` counts the placements of the plan from 0. `placed` follows where it has worked.
    """

    time_s: NotRequired[float]
    target: str
    x_mm: float
    placement: int
    command: list[str]
    exit_code: int | None
    seconds: float
    limit_s: float
    words: str


class Moved(TypedDict):
    """A motion has ended at these counters, since the campaign was created `time_s` ago.

    `step` is that of the plan, None for motions of a resumed run; `twin` is what a simulation knows of the mirrors.
    """

    step: int | None
    time_s: float
    pan_steps: int
    tilt_steps: int
    reference: NotRequired[bool]
    twin: NotRequired[TrueAngles]


class Homed(Moved):
    """A homing and the way to its counters: boot id of the device, the side of arrival of pan and tilt."""

    boot: int
    approach: list[str]


class TrueAngles(TypedDict):
    """Mirror angles (psi, beta) of a simulated rig at rest, and the stop errors (pan, tilt) in them, degrees."""

    mirror_angles_deg: tuple[float, float]
    stop_errors_deg: tuple[float, float]


class Verified(TypedDict):
    """What a homing found of the segment before: (pan, tilt) switches minus counters; None where it cannot tell."""

    segment: int
    deviation_steps: list[int] | None


class Frame(TypedDict):
    """A stored picture: name relative to the folder, SHA-256 and size of the file."""

    name: str
    sha256: str
    bytes: int


class Looked(TypedDict):
    """A look and what a detector found in it.

    `reference_of` names the spot that a look of a resumed run compares itself with, `shift_px` the largest change.
    """

    step: int | None
    spot: int
    target: str
    experiment: int | None
    point: int | None
    status: str
    pixels_px: Four | None
    sds_px: Four | None
    correlations: NotRequired[tuple[float, float]]
    frames: list[Frame]
    time_s: float
    aperture_deg: NotRequired[float | None]
    reference_of: NotRequired[int]
    shift_px: NotRequired[float | None]


class Adapted(TypedDict):
    """A change of plan: the steps that stand from row `row` on, and why they were chosen.

    Each look says what the target was expected to be before it and after; `looks` are those of the estimate behind it.
    """

    row: int
    looks: int
    why: str
    steps: list[dict[str, object]]


class Confirmed(TypedDict):
    """Whether the posterior, sampled where the Laplace approximation met the target, meets it too.

    Of so many `looks`; worst u of the directions by both, deg/step; `accepted`: whether the weighted draws may be used.
    """

    looks: int
    target_u_deg_per_step: float
    laplace_u_deg_per_step: float
    importance_u_deg_per_step: float
    accepted: bool
    reached: bool


class AskedDevice(TypedDict):
    """What the device answered: status, laser, boot id and counters."""

    status: str
    laser_on: bool
    boot: int
    pan_steps: int
    tilt_steps: int


class Asked(TypedDict):
    """What somebody asked of a run while it went on (pause, resume, stop, laser off), once the device had answered.

    `control passed on`: another browser controls, because the one before had not asked for a while.

    `number` counts the requests of a run from 1; `time_s` since the campaign was created, when the device had answered.
    """

    time_s: NotRequired[float]
    number: int
    what: str
    device: AskedDevice


class Stop(TypedDict):
    """The end of a run."""

    reason: str
    exit_code: int
    utc: str
