"""The campaign in the events of a journal, at any time.

A segment begins with a homing and ends with the next one, which shows whether steps were lost in between: then no spot
of the segment counts. After a gap that may have lost a motion, nothing counts until the next homing. Counters in motor
steps, px and seconds as in moves.csv and spots.csv.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal, cast

from msgspec import UNSET

from tvsbayes.acquisition.journal import Record, event_of, refused
from tvsbayes.acquisition.journal_events import Gap, Homed, Looked, Moved, Placed, Start, Stop, Verified
from tvsbayes.instrument.axes import PanApproach, TiltApproach
from tvsbayes.instrument.campaign import NO_PIXELS, Move, Spot, next_move, with_pixels

HOME_TOLERANCE_STEPS = 2
"""Scatter of a home switch between homings; larger deviations mean lost steps."""
LOST_STEPS = "lost-steps"
"""Status of a spot in whose segment steps were lost."""


@dataclass(frozen=True)
class Recorded:
    """The campaign in a journal so far.

    Attributes:
        moves: rows of moves.csv; empty before the first homing.
        spots: rows of spots.csv.
        next_step: first step of the plan after the last completed one.
        looked_steps: completed looks of the plan; after a repair some before `next_step` may be missing.
        references: looks outside the plan, by which resumed runs checked earlier spots.
        target: position of the sheet, "" before the first placement.
        starts: number of starts of the acquisition.
        boot: boot id of the device at its last homing, None before.
        home_steps: counters that the last `home` of the plan asked for.
        lost: segments in which steps were lost, with the deviation found.
        unverified: segments whose closing homing had no result, or did not take place.
        ignored_lines: lines after a gap that do not count.
        ended: the reason of the last `stop`, None while running or after a crash.
    """

    moves: tuple[Move, ...] = ()
    spots: tuple[Spot, ...] = ()
    next_step: int = 0
    looked_steps: frozenset[int] = frozenset()
    references: int = 0
    target: str = ""
    starts: int = 0
    boot: int | None = None
    home_steps: tuple[int, int] = (0, 0)
    lost: tuple[tuple[int, tuple[int, int]], ...] = ()
    unverified: tuple[int, ...] = ()
    ignored_lines: tuple[int, ...] = ()
    ended: str | None = None


class Recorder:
    """Follows a journal event by event.

    Attributes:
        moves: rows of moves.csv so far.
        spots: rows of spots.csv so far, before it is known whether steps were lost.
        state: the fields of `Recorded` that the last event determines; the growing fields are empty.
    """

    def __init__(self) -> None:
        self.moves: list[Move] = []
        self.spots: list[Spot] = []
        self.state = Recorded()
        self._lost: dict[int, tuple[int, int]] = {}
        self._closed: set[int] = set()
        self._ignored: list[int] = []
        self._looked: set[int] = set()
        self._trusted = True

    def add(self, record: Record) -> None:
        """Adds the next event.

        Raises:
            InputError: the event contradicts earlier events, with its line.
        """
        event = event_of(record, Gap, Start, Stop, Placed, Verified, Homed, Moved, Looked)
        if isinstance(event, Moved | Looked):
            if not self._trusted:
                self._ignored.append(record.line)
                return
            if not self.moves:
                raise refused(record, "it stands before the first homing")
        match event:
            case Gap():
                self._trusted &= not event.motion_lost
            case Start():
                self.state = replace(self.state, starts=self.state.starts + 1, ended=None)
            case Stop():
                self.state = replace(self.state, ended=event.reason)
            case Placed():
                self.state = replace(self.state, target=event.target)
            case Verified():
                self._verified(event)
            case Homed():
                self._homed(event)
            case Moved():
                self._moved(event, self.moves[-1].segment)
            case Looked():
                self._looks(event)
                # The target is known even if the line of the placement is lost.
                self.state = replace(self.state, target=event.target)
        if isinstance(event, Homed | Moved | Placed | Looked) and event.step is not None:
            self.state = replace(self.state, next_step=max(self.state.next_step, event.step + 1))

    def _verified(self, event: Verified) -> None:
        if event.deviation_steps is None:
            # A device that was restarted has no counters for a comparison.
            return
        self._closed.add(event.segment)
        if max(map(abs, event.deviation_steps)) > HOME_TOLERANCE_STEPS:
            self._lost[event.segment] = event.deviation_steps

    def _homed(self, event: Homed) -> None:
        self._trusted = True
        segment = self.moves[-1].segment + 1 if self.moves else 0
        pan, tilt = event.approach
        # The words are checked when the tables are written.
        approach = cast("PanApproach", pan), cast("TiltApproach", tilt)
        self._moved(event, segment, approach)
        # Only a homing of the plan states counters; one of a resumed run repeats them.
        self.state = replace(self.state, boot=event.boot, home_steps=(event.pan_steps, event.tilt_steps))

    def _moved(
        self,
        event: Moved | Homed,
        segment: int,
        approach: tuple[PanApproach | Literal[""], TiltApproach | Literal[""]] = ("", ""),
    ) -> None:
        steps = event.pan_steps, event.tilt_steps
        self.moves.append(next_move(self.moves, segment, event.time_s, steps, approach))

    def _looks(self, event: Looked) -> None:
        self.spots.append(_spot(event, len(self.moves) - 1))
        if event.step is not None:
            self._looked.add(event.step)
        else:
            self.state = replace(self.state, references=self.state.references + 1)

    def result(self) -> Recorded:
        """The campaign so far."""
        segment_of = [move.segment for move in self.moves]
        spots = tuple(
            # Refused and undetected spots too: `detect` may still find them in their frames.
            replace(spot, status=LOST_STEPS) if segment_of[spot.move] in self._lost else spot
            for spot in self.spots
        )
        return replace(
            self.state,
            moves=tuple(self.moves),
            spots=spots,
            looked_steps=frozenset(self._looked),
            lost=tuple(sorted(self._lost.items())),
            unverified=tuple(s for s in sorted(set(segment_of)) if s not in self._closed),
            ignored_lines=tuple(self._ignored),
        )


def recorded(records: Iterable[Record]) -> Recorded:
    """The campaign in the events of a journal.

    Raises:
        InputError: events that contradict each other, with their line.
    """
    recorder = Recorder()
    for record in records:
        recorder.add(record)
    return recorder.result()


def _spot(event: Looked, move: int) -> Spot:
    row = Spot(
        spot=event.spot,
        move=move,
        target=event.target,
        experiment=event.experiment,
        point=event.point,
        aperture_deg=None if event.aperture_deg is UNSET else event.aperture_deg,
    )
    pixels, sds = event.pixels_px or NO_PIXELS, event.sds_px or NO_PIXELS
    return with_pixels(row, event.status, pixels, sds, event.correlations)
