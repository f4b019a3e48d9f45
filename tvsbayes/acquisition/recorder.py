"""What a journal says happened: the campaign that its events hold, at any time.

`moves.csv` and `spots.csv` are derived from `log.jsonl` and can be derived again. A segment begins with a homing and
ends with the next one, which tells whether steps were lost in between: then no spot of the segment counts. After a
gap that a repair left, nothing counts until the next homing, because nobody knows which motion is missing.

Counters in motor steps, px and seconds as in DESIGN 7.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from tvsbayes.acquisition.journal import LOG, Record
from tvsbayes.errors import InputError, refusal
from tvsbayes.files.csv_table import CSV_BYTES_MAX
from tvsbayes.files.disk import read_bytes, write_atomically
from tvsbayes.instrument.campaign import (
    Campaign,
    Move,
    Spot,
    campaign_toml,
    moves_bytes,
    parse_moves,
    parse_spots,
    spots_bytes,
)
from tvsbayes.instrument.plan import PlanStep
from tvsbayes.instrument.rig import Rig, rig_table_toml
from tvsbayes.instrument.stereo_pair import stereo_bytes

HOME_TOLERANCE_STEPS = 2
"""Scatter of a home switch, as homing finds it again; more than that are lost steps."""
LOST_STEPS = "lost-steps"
"""Status of a spot in whose segment steps were lost."""
PIXELS = ("u_left_px", "v_left_px", "u_right_px", "v_right_px")


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
        placements: how often the operator was asked to place it by the plan.
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
    placements: int = 0
    starts: int = 0
    boot: int | None = None
    home_steps: tuple[int, int] = (0, 0)
    lost: tuple[tuple[int, tuple[int, int]], ...] = ()
    unverified: tuple[int, ...] = ()
    ignored_lines: tuple[int, ...] = ()
    ended: str | None = None


def plan_sha256(plan: Sequence[PlanStep]) -> str:
    """What makes a plan the same plan: its steps, not its file."""
    rows = [(s.step, s.action, s.pan_steps, s.tilt_steps, s.target, s.experiment, s.point) for s in plan]
    return hashlib.sha256(json.dumps(rows).encode()).hexdigest()


def rig_sha256(rig: Rig) -> str:
    """What makes a rig the same rig: priors, stereo calibration, sheets, positioner and cameras."""
    tables = json.dumps([rig.sheets_mm, rig.positioner, rig.cameras], sort_keys=True)
    return hashlib.sha256(rig_table_toml(rig.table).encode() + stereo_bytes(rig.stereo) + tables.encode()).hexdigest()


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
            allowed, remedy = f"the entries of the event {record.event}", "tvsbayes check FOLDER --repair-to NEW"
            place = {"file": LOG, "line": record.line}
            raise refusal("event", **place, found=f"{error!r}"[:80], allowed=allowed, remedy=remedy) from error

    def _add(self, record: Record) -> None:
        data, event = record.data, record.event
        if event in ("moved", "looked") and not self._trusted:
            self._ignored.append(record.line)
            return
        if event == "gap":
            self._trusted = False
        elif event == "start":
            self._change(starts=self.state.starts + 1, ended=None)
        elif event == "stop":
            self._change(ended=str(data["reason"]))
        elif event == "placed":
            again = bool(data.get("again", False))
            self._change(target=str(data["target"]), placements=self.state.placements + (not again))
        elif event == "verified":
            segment, deviation = int(data["segment"]), data["deviation_steps"]
            if deviation is None:
                # A device that was restarted meanwhile has no counters to compare with.
                return
            self._closed.add(segment)
            if max(map(abs, deviation)) > HOME_TOLERANCE_STEPS:
                self._lost[segment] = (int(deviation[0]), int(deviation[1]))
        elif event == "homed":
            self._trusted = True
            segment = self.moves[-1].segment + 1 if self.moves else 0
            self.moves.append(Move(len(self.moves), segment, *_head(data), *data["approach"]))
            # Only a homing of the plan states counters; one of a resumed run repeats them.
            self._change(boot=int(data["boot"]), home_steps=(int(data["pan_steps"]), int(data["tilt_steps"])))
        elif event == "moved":
            self.moves.append(Move(len(self.moves), self.moves[-1].segment, *_head(data)))
        elif event == "looked":
            self.spots.append(_spot(data, len(self.moves) - 1))
            if data.get("step") is not None:
                self._looked.add(int(data["step"]))
            else:
                self._change(references=self.state.references + 1)
        if data.get("step") is not None and event in ("homed", "moved", "placed", "looked"):
            self._change(next_step=max(self.state.next_step, int(data["step"]) + 1))

    def _change(self, **changes: object) -> None:
        self.state = replace(self.state, **changes)

    def result(self) -> Recorded:
        """The campaign so far."""
        segment_of = [move.segment for move in self.moves]
        spots = tuple(
            replace(spot, status=LOST_STEPS) if spot.status == "ok" and segment_of[spot.move] in self._lost else spot
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


def _head(data: dict[str, object]) -> tuple[float, int, int]:
    return float(data["time_s"]), int(data["pan_steps"]), int(data["tilt_steps"])


def _spot(data: dict[str, object], move: int) -> Spot:
    if move < 0:
        raise ValueError("a look before the first homing")
    pixels, sds = data["pixels_px"], data["sds_px"]
    correlations = data.get("correlations", [0.0, 0.0])
    return Spot(
        int(data["spot"]),
        move,
        str(data["target"]),
        data["experiment"],
        data["point"],
        *(pixels or [None] * 4),
        *(sds or [None] * 4),
        data.get("aperture_deg"),
        str(data["status"]),
        *map(float, correlations),
    )


def campaign_of(record: Recorded, rig: Rig, header: dict[str, object]) -> Campaign | None:
    """The campaign to write, None before the first homing."""
    if not record.moves:
        return None
    return Campaign(record.moves, record.spots, rig.stereo, rig.table, header)


def write_derived(campaign: Campaign, folder: Path, tables_only: bool = False) -> None:
    """Writes the four campaign files, or the tables that grow, so that the folder is readable at any moment.

    Moves go before spots: a spot never names a move that is not there yet. Spots that `detect` has found since in
    frames that waited keep what it found. A file that is as it should be is not written again.

    Raises:
        InputError: the folder cannot be written.
    """
    folder = Path(folder)
    for name, data in _files(campaign, folder, tables_only).items():
        if not _holds(folder / name, data):
            write_atomically(folder / name, data)


def _holds(path: Path, data: bytes) -> bool:
    try:
        return path.read_bytes() == data
    except OSError:
        return False


def _files(campaign: Campaign, folder: Path, tables_only: bool = False) -> dict[str, bytes]:
    detected = _detected(campaign, folder)
    spots = [
        detected[spot.spot] if spot.status == "undetected" and spot.spot in detected else spot
        for spot in campaign.spots
    ]
    moves, table = moves_bytes(campaign.moves), spots_bytes(spots)
    parse_spots(table, "spots.csv", len(parse_moves(moves)), campaign.stereo)
    files = {"moves.csv": moves, "spots.csv": table}
    if tables_only:
        return files
    return {"stereo.json": stereo_bytes(campaign.stereo), **files, "campaign.toml": campaign_toml(campaign)}


def keep_edited(campaign: Campaign, folder: Path) -> dict[str, Path]:
    """Copies of campaign files that hold what is not in the journal, before they are written again.

    Somebody may have refused spots, written readings, or stated priors since. Tables that only lack the latest rows
    were left so by the run itself.

    Args:
        campaign: what the journal says.
        folder: campaign folder.

    Returns:
        The copies made, `spots.edited-1.csv` and so on, by the name of the file.
    """
    folder, kept = Path(folder), {}
    for name, data in _files(campaign, folder).items():
        path = folder / name
        if not path.is_file():
            continue
        present = read_bytes(path, CSV_BYTES_MAX, folder)
        if not set(present.splitlines()) - set(data.splitlines()):
            continue
        number = 1
        while (copy := path.with_name(f"{path.stem}.edited-{number}{path.suffix}")).exists():
            number += 1
        write_atomically(copy, present)
        kept[name] = copy
    return kept


def _detected(campaign: Campaign, folder: Path) -> dict[int, Spot]:
    """Spots of the present spots.csv that wait in the journal and were found since."""
    if not (folder / "spots.csv").is_file() or all(spot.status != "undetected" for spot in campaign.spots):
        return {}
    waiting = {spot.spot: spot for spot in campaign.spots if spot.status == "undetected"}
    try:
        data = read_bytes(folder / "spots.csv", CSV_BYTES_MAX, folder)
        present = parse_spots(data, "spots.csv", len(campaign.moves), campaign.stereo)
    except InputError:
        return {}
    return {
        spot.spot: spot
        for spot in present
        if spot.spot in waiting and spot.move == waiting[spot.spot].move and spot.status != "undetected"
    }
