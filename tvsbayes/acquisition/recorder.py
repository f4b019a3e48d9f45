"""The events of a journal, and the campaign in them at any time.

`created` opens a journal. An `intent` precedes every motion of the plan, and every completed order has an event. Other
events, such as `asked` of releases up to 0.3.0, are kept and mean nothing. Counters in motor steps, raw px, degrees and
seconds by suffix; `utc` and `created` are ISO 8601; `time_s` counts from the first start and never decreases. Fields
have the order in which they are written; those that are UNSET by default may be missing.

A segment begins with a homing and ends with the next one, which shows whether steps were lost in between: then no spot
of the segment counts. After a gap that may have lost a motion, nothing counts until the next homing.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any, cast

import msgspec
from msgspec import UNSET, Struct, UnsetType

from tvsbayes.acquisition.journal import Frame, Record
from tvsbayes.instrument.axes import PanApproach, TiltApproach
from tvsbayes.instrument.campaign import NO_PIXELS, Move, Spot, next_move, with_pixels
from tvsbayes.results.plan_record import Action

HOME_TOLERANCE_STEPS = 2
"""Scatter of a home switch between homings; larger deviations mean lost steps."""
LOST_STEPS = "lost-steps"
"""Status of a spot in whose segment steps were lost."""
Four = tuple[float, float, float, float]
"""u_left, v_left, u_right, v_right."""


class Event(Struct, frozen=True, kw_only=True, tag_field="event", tag=str.lower):
    """Base of the events; unknown keys are ignored."""

    def entries(self) -> dict[str, Any]:
        """The entries of its JSON object, with its kind."""
        return cast("dict[str, Any]", msgspec.to_builtins(self, enc_hook=float))


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


class Moved(Event, frozen=True):
    """A move is completed, at these counters; `step` is the step of the plan, None for motions of a resumed run.

    `twin` holds the true mirror angles of a simulation.
    """

    step: int | None
    time_s: float
    pan_steps: int
    tilt_steps: int
    reference: bool | UnsetType = UNSET
    twin: TrueAngles | UnsetType = UNSET


class Homed(Event, frozen=True):
    """A homing and the motion to its counters: boot id of the device, side of arrival of pan and tilt."""

    step: int | None
    time_s: float
    pan_steps: int
    tilt_steps: int
    boot: int
    approach: tuple[str, str]
    twin: TrueAngles | UnsetType = UNSET


class Verified(Event, frozen=True):
    """Result of a homing for the segment before: (pan, tilt) switches minus counters; None where it is unknown."""

    segment: int
    deviation_steps: tuple[int, int] | None


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


class AdaptedStep(Action, frozen=True):
    """A step of a changed plan; a look has the expected target value before and after it."""

    u_before_deg_per_step: float | None = None
    u_after_deg_per_step: float | None = None


class Adapted(Event, frozen=True):
    """A change of plan: the new steps from row `row` on, from an estimate of `looks` looks, and the reason for them."""

    row: int
    looks: int
    why: str
    steps: tuple[AdaptedStep, ...]


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


def event_of[E: Event](record: Record, *kinds: type[E]) -> E | None:
    """An event of one of these kinds, its entries checked by type; None for every other kind.

    Raises:
        InputError: an entry is missing or of another type, with the line of the journal.
    """
    for kind in kinds:
        if kind.__struct_config__.tag == record.event:
            try:
                return msgspec.convert({"event": record.event, **record.data}, kind)
            except (msgspec.ValidationError, UnicodeEncodeError) as error:
                raise record.refused(error) from error
    return None


@dataclass
class Recorded:
    """The campaign in a journal so far, followed event by event.

    Attributes:
        moves: rows of moves.csv; empty before the first homing.
        looks: rows of spots.csv, before it is known whether steps were lost.
        next_step: first step of the plan after the last completed one.
        looked_steps: completed looks of the plan; after a repair some before `next_step` may be missing.
        references: looks outside the plan, by which resumed runs checked earlier spots.
        target: position of the sheet, "" before the first placement.
        starts: number of starts of the acquisition.
        boot: boot id of the device at its last homing, None before.
        home_steps: counters that the last `home` of the plan asked for.
        lost: segments in which steps were lost, with the deviation found.
        ignored_lines: lines after a gap that do not count.
        ended: the reason of the last `stop`, None while running or after a crash.
    """

    moves: list[Move] = field(default_factory=list)
    looks: list[Spot] = field(default_factory=list)
    next_step: int = 0
    looked_steps: set[int] = field(default_factory=set)
    references: int = 0
    target: str = ""
    starts: int = 0
    boot: int | None = None
    home_steps: tuple[int, int] = (0, 0)
    lost: dict[int, tuple[int, int]] = field(default_factory=dict)
    ignored_lines: list[int] = field(default_factory=list)
    ended: str | None = None
    _verified: set[int] = field(default_factory=set)
    _trusted: bool = True

    @property
    def spots(self) -> tuple[Spot, ...]:
        """Rows of spots.csv; none counts in whose segment steps were lost."""
        # Refused and undetected spots too: `detect` may still find them in their frames.
        return tuple(
            replace(spot, status=LOST_STEPS) if self.moves[spot.move].segment in self.lost else spot
            for spot in self.looks
        )

    @property
    def unverified(self) -> tuple[int, ...]:
        """Segments whose closing homing had no result, or did not take place."""
        return tuple(sorted({move.segment for move in self.moves} - self._verified))

    def add(self, record: Record) -> None:
        """Adds the next event.

        Raises:
            InputError: the event contradicts earlier events, with its line.
        """
        event = event_of(record, Gap, Start, Stop, Placed, Verified, Homed, Moved, Looked)
        if isinstance(event, Moved | Looked):
            if not self._trusted:
                self.ignored_lines.append(record.line)
                return
            if not self.moves:
                raise record.refused("it stands before the first homing")
        match event:
            case Gap():
                self._trusted &= not event.motion_lost
            case Start():
                self.starts, self.ended = self.starts + 1, None
            case Stop():
                self.ended = event.reason
            case Verified(deviation_steps=(pan, tilt)):
                # A device that was restarted has no counters for a comparison.
                self._verified.add(event.segment)
                if max(abs(pan), abs(tilt)) > HOME_TOLERANCE_STEPS:
                    self.lost[event.segment] = pan, tilt
            case Homed() | Moved():
                self._reach(event)
            case Looked():
                self._look(event)
        if isinstance(event, Placed | Looked):
            # A look knows the target even if the line of the placement is lost.
            self.target = event.target
        if isinstance(event, Homed | Moved | Placed | Looked) and event.step is not None:
            self.next_step = max(self.next_step, event.step + 1)

    def _reach(self, event: Homed | Moved) -> None:
        steps = event.pan_steps, event.tilt_steps
        segment = self.moves[-1].segment if self.moves else -1
        if isinstance(event, Moved):
            self.moves.append(next_move(self.moves, segment, event.time_s, steps))
            return
        # The words are checked when the tables are written.
        approach = cast("tuple[PanApproach, TiltApproach]", event.approach)
        self.moves.append(next_move(self.moves, segment + 1, event.time_s, steps, approach))
        # Only a homing of the plan states counters; one of a resumed run repeats them.
        self._trusted, self.boot, self.home_steps = True, event.boot, steps

    def _look(self, event: Looked) -> None:
        row = Spot(
            spot=event.spot,
            move=len(self.moves) - 1,
            target=event.target,
            experiment=event.experiment,
            point=event.point,
            aperture_deg=None if event.aperture_deg is UNSET else event.aperture_deg,
        )
        pixels, sds = event.pixels_px or NO_PIXELS, event.sds_px or NO_PIXELS
        self.looks.append(with_pixels(row, event.status, pixels, sds, event.correlations))
        if event.step is None:
            self.references += 1
        else:
            self.looked_steps.add(event.step)


def recorded(records: Iterable[Record]) -> Recorded:
    """The campaign in the events of a journal.

    Raises:
        InputError: events that contradict each other, with their line.
    """
    record = Recorded()
    for line in records:
        record.add(line)
    return record
