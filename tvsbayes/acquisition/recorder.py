"""What a journal says happened: the campaign that its events hold, at any time.

A segment begins with a homing and ends with the next one, which tells whether steps were lost in between: then no spot
of the segment counts. After a gap that a repair left, nothing counts until the next homing, because nobody knows which
motion is missing. Counters in motor steps, px and seconds as in moves.csv and spots.csv.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal, cast

from tvsbayes.acquisition.journal import LOG, Record
from tvsbayes.acquisition.journal_events import Homed, Looked, Moved, Placed, Stop, Verified
from tvsbayes.errors import refusal
from tvsbayes.instrument.axes import PanApproach, TiltApproach
from tvsbayes.instrument.campaign import NO_PIXELS, Move, Spot, next_move, with_pixels

HOME_TOLERANCE_STEPS = 2
"""Scatter of a home switch, as homing finds it again; more than that are lost steps."""
LOST_STEPS = "lost-steps"
"""Status of a spot in whose segment steps were lost."""


@dataclass(frozen=True)
class Recorded:
    """The campaign that a journal holds so far.

    Attributes:
        moves: rows of moves.csv; empty before the first homing.
        spots: rows of spots.csv.
        next_step: first step of the plan behind the last one that is done.
        looked_steps: steps of the plan whose looks are there; after a repair some before `next_step` may be missing.
        references: looks beside the plan, with which resumed runs compared what they see with what was seen before.
        target: where the sheet stands, "" before the first placement.
        starts: how often the acquisition was started.
        boot: boot id of the device at its last homing, None before.
        home_steps: counters that the last `home` of the plan asked for.
        lost: segments in which steps were lost, with the deviation found.
        unverified: segments whose closing homing could not tell, or did not take place.
        ignored_lines: lines after a gap that cannot be trusted.
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
        state: the rest of a `Recorded` that follows from the last event; what grows is empty.
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
        """Takes the next event.

        Raises:
            InputError: one that contradicts those before, with its line.
        """
        try:
            self._add(record)
        except (KeyError, TypeError, ValueError, IndexError) as error:
            found, allowed = f"{error!r}"[:80], f"the entries of the event {record.event}"
            remedy = "tvsbayes check FOLDER --repair-to NEW"
            raise refusal("event", file=LOG, line=record.line, found=found, allowed=allowed, remedy=remedy) from error

    def _add(self, record: Record) -> None:
        """Takes an event; the casts say which it is, the conversions behind them whether it holds what it should."""
        data, event, state = record.data, record.event, self.state
        if event in ("moved", "looked") and not self._trusted:
            self._ignored.append(record.line)
            return
        if event == "gap":
            self._trusted = False
        elif event == "start":
            self.state = replace(state, starts=state.starts + 1, ended=None)
        elif event == "stop":
            self.state = replace(state, ended=str(cast("Stop", data)["reason"]))
        elif event == "placed":
            self.state = replace(state, target=str(cast("Placed", data)["target"]))
        elif event == "verified":
            self._verified(cast("Verified", data))
        elif event == "homed":
            self._homed(cast("Homed", data))
        elif event == "moved":
            self._moved(cast("Moved", data), self.moves[-1].segment)
        elif event == "looked":
            self._looks(cast("Looked", data))
        if data.get("step") is not None and event in ("homed", "moved", "placed", "looked"):
            step = int(cast("Moved | Placed | Looked", data)["step"] or 0)
            self.state = replace(self.state, next_step=max(self.state.next_step, step + 1))

    def _verified(self, data: Verified) -> None:
        segment, deviation = int(data["segment"]), data["deviation_steps"]
        if deviation is None:
            # A device that was restarted meanwhile has no counters to compare with.
            return
        self._closed.add(segment)
        if max(map(abs, deviation)) > HOME_TOLERANCE_STEPS:
            self._lost[segment] = (int(deviation[0]), int(deviation[1]))

    def _homed(self, data: Homed) -> None:
        self._trusted = True
        segment = self.moves[-1].segment + 1 if self.moves else 0
        pan, tilt = data["approach"]
        # What sides they are is checked where the tables are written.
        approach = cast("PanApproach", pan), cast("TiltApproach", tilt)
        self._moved(data, segment, approach)
        # Only a homing of the plan states counters; one of a resumed run repeats them.
        counters = int(data["pan_steps"]), int(data["tilt_steps"])
        self.state = replace(self.state, boot=int(data["boot"]), home_steps=counters)

    def _moved(
        self,
        data: Moved,
        segment: int,
        approach: tuple[PanApproach | Literal[""], TiltApproach | Literal[""]] = ("", ""),
    ) -> None:
        steps = int(data["pan_steps"]), int(data["tilt_steps"])
        self.moves.append(next_move(self.moves, segment, float(data["time_s"]), steps, approach))

    def _looks(self, data: Looked) -> None:
        self.spots.append(_spot(data, len(self.moves) - 1))
        if data.get("step") is not None:
            self._looked.add(int(data["step"] or 0))
        else:
            self.state = replace(self.state, references=self.state.references + 1)

    def result(self) -> Recorded:
        """The campaign so far."""
        segment_of = [move.segment for move in self.moves]
        spots = tuple(
            # Refused and undetected ones too: `detect` may yet find them in their frames.
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


def _spot(data: Looked, move: int) -> Spot:
    if move < 0:
        raise ValueError("a look before the first homing")
    row = Spot(
        spot=int(data["spot"]),
        move=move,
        target=str(data["target"]),
        experiment=data["experiment"],
        point=data["point"],
        aperture_deg=data.get("aperture_deg"),
    )
    pixels, sds = data["pixels_px"] or NO_PIXELS, data["sds_px"] or NO_PIXELS
    left, right = map(float, data.get("correlations", (0.0, 0.0)))
    return with_pixels(row, str(data["status"]), pixels, sds, (left, right))
