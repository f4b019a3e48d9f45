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

from tvsbayes.campaign import (
    Campaign,
    Move,
    PlanStep,
    Spot,
    campaign_toml,
    moves_bytes,
    parse_moves,
    parse_spots,
    spots_bytes,
)
from tvsbayes.device.journal import LOG, Record
from tvsbayes.files import CSV_BYTES_MAX, InputError, read_bytes, refusal, write_atomically
from tvsbayes.rigs import Rig, rig_table_toml, stereo_bytes

HOME_TOLERANCE_STEPS = 2
"""Scatter of a home switch, as homing finds it again; more than that are lost steps."""
LOST_STEPS = "lost-steps"
"""Status of a spot in whose segment steps were lost."""
PIXELS = ("u_left_px", "v_left_px", "u_right_px", "v_right_px")
PIXEL_SDS = ("su_left_px", "sv_left_px", "su_right_px", "sv_right_px")


@dataclass(frozen=True)
class Recorded:
    """The campaign that a journal holds so far.

    Attributes:
        moves: rows of moves.csv; empty before the first homing.
        spots: rows of spots.csv.
        next_step: first step of the plan that is not done.
        target: where the sheet stands, "" before the first placement.
        placements: how often the operator was asked to place it by the plan.
        starts: how often the acquisition was started.
        boot: boot id of the device at its last homing, None before.
        home_steps: counters that the last `home` of the plan asked for.
        lost: segments in which steps were lost, with the deviation found.
        unverified: segments that no homing closed.
        ignored_lines: lines after a gap that cannot be trusted.
        ended: the reason of the last `stop`, None while running or after a crash.
    """

    moves: tuple[Move, ...] = ()
    spots: tuple[Spot, ...] = ()
    next_step: int = 0
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


def recorded(records: Iterable[Record]) -> Recorded:
    """The campaign in the events of a journal.

    Raises:
        InputError: events that contradict each other, with their line.
    """
    moves: list[Move] = []
    spots: list[Spot] = []
    lost: dict[int, tuple[int, int]] = {}
    closed: set[int] = set()
    ignored: list[int] = []
    state = Recorded()
    trusted = True
    for record in records:
        data = record.data
        try:
            if record.event == "gap":
                trusted = False
            elif record.event == "start":
                state = replace(state, starts=state.starts + 1, ended=None)
            elif record.event == "stop":
                state = replace(state, ended=str(data["reason"]))
            elif record.event in ("placed",):
                again = bool(data.get("again", False))
                state = replace(state, target=str(data["target"]), placements=state.placements + (0 if again else 1))
            elif record.event == "verified":
                segment, deviation = int(data["segment"]), data["deviation_steps"]
                closed.add(segment)
                if deviation is not None and max(map(abs, deviation)) > HOME_TOLERANCE_STEPS:
                    lost[segment] = (int(deviation[0]), int(deviation[1]))
            elif record.event == "homed":
                trusted = True
                row = Move(len(moves), moves[-1].segment + 1 if moves else 0, *_head(data), *data["approach"])
                moves.append(row)
                home = (int(data["pan_steps"]), int(data["tilt_steps"]))
                state = replace(state, boot=int(data["boot"]), home_steps=home)
            elif not trusted and record.event in ("moved", "looked"):
                ignored.append(record.line)
                continue
            elif record.event == "moved":
                moves.append(Move(len(moves), moves[-1].segment, *_head(data)))
            elif record.event == "looked":
                spots.append(_spot(data, len(moves) - 1))
            if data.get("step") is not None and record.event in ("homed", "moved", "placed", "looked"):
                state = replace(state, next_step=max(state.next_step, int(data["step"]) + 1))
        except (KeyError, TypeError, ValueError, IndexError) as error:
            allowed, remedy = f"the entries of the event {record.event}", "tvsbayes check FOLDER --repair-to NEW"
            place = {"file": LOG, "line": record.line}
            raise refusal("event", **place, found=f"{error!r}"[:80], allowed=allowed, remedy=remedy) from error
    segment_of = [move.segment for move in moves]
    final = tuple(
        replace(spot, status=LOST_STEPS) if spot.status == "ok" and segment_of[spot.move] in lost else spot
        for spot in spots
    )
    unverified = tuple(s for s in sorted(set(segment_of)) if s not in closed)
    return replace(
        state,
        moves=tuple(moves),
        spots=final,
        lost=tuple(sorted(lost.items())),
        unverified=unverified,
        ignored_lines=tuple(ignored),
    )


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


def write_derived(campaign: Campaign, folder: Path) -> None:
    """Writes the four campaign files so that the folder is readable at any moment in between.

    Moves go before spots: a spot never names a move that is not there yet. Spots that `detect` has found since in
    frames that waited keep what it found. A file that is as it should be is not written again.

    Raises:
        InputError: the folder cannot be written.
    """
    folder = Path(folder)
    detected = _detected(campaign, folder)
    spots = [
        detected[spot.spot] if spot.status == "undetected" and spot.spot in detected else spot
        for spot in campaign.spots
    ]
    moves, table = moves_bytes(campaign.moves), spots_bytes(spots)
    parse_spots(table, "spots.csv", len(parse_moves(moves)), campaign.stereo)
    files = {
        "stereo.json": stereo_bytes(campaign.stereo),
        "moves.csv": moves,
        "spots.csv": table,
        "campaign.toml": campaign_toml(campaign),
    }
    for name, data in files.items():
        path = folder / name
        if not path.is_file() or path.read_bytes() != data:
            write_atomically(path, data)


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
