"""The records of a run: the journal, the campaign derived from it, its files, and the outcome.

`moves.csv` and `spots.csv` follow `log.jsonl` and can be derived again; `campaign.toml` and `stereo.json` are written
once a homing is logged. A reader finds a complete campaign at any moment. Seconds where a name says `_s`, since the
campaign was created; UTC for people.
"""

from __future__ import annotations

import datetime
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from msgspec import UNSET

from tvsbayes.acquisition.journal import FRAME_NAME, LOG, Journal, orphans
from tvsbayes.acquisition.recorder import (
    HOME_TOLERANCE_STEPS,
    LOST_STEPS,
    Created,
    Event,
    Homed,
    Recorded,
    Stop,
    Verified,
    event_of,
    recorded,
)
from tvsbayes.acquisition.running_estimate import Estimate
from tvsbayes.errors import DeviceFault, InputError, TvsError
from tvsbayes.files.csv_table import CSV_BYTES_MAX
from tvsbayes.files.disk import read_bytes, remove_unfinished, write_atomically
from tvsbayes.instrument.campaign import (
    NAME_ACQUIRED,
    UNDETECTED,
    Campaign,
    Look,
    Spot,
    campaign_toml,
    moves_bytes,
    parse_moves,
    parse_spots,
    read_campaign,
    spots_bytes,
)
from tvsbayes.instrument.rig import Rig
from tvsbayes.instrument.stereo_pair import stereo_bytes
from tvsbayes.positioner.interface import HomeReport
from tvsbayes.results.records import plain

DERIVED = ("campaign.toml", "stereo.json", "moves.csv", "spots.csv", "truth.json")
DERIVED_EVERY = 100
"""Up to this number of spots the campaign files are written after every look, then at growing intervals: at least 99 %
of the looks are in them at any time, all of them in the journal."""


def campaign_of(record: Recorded, settings: Campaign) -> Campaign:
    """The campaign of a journal with the stereo calibration, rig and header of `settings`."""
    return Campaign(tuple(record.moves), record.spots, settings.stereo, settings.rig, settings.header)


def write_derived(campaign: Campaign, folder: Path, tables_only: bool = False) -> None:
    """Writes the four campaign files, or only the growing tables, so that the folder is readable at any moment.

    Moves are written before spots: a spot never names a missing move. Spots that `detect` has found in pending frames
    keep that result. A file that is up to date is not written again.

    Raises:
        InputError: the folder cannot be written.
    """
    for name, data in _files(campaign, Path(folder), tables_only).items():
        path = Path(folder) / name
        try:
            if path.read_bytes() == data:
                continue
        except OSError:
            pass
        write_atomically(path, data)


def _files(campaign: Campaign, folder: Path, tables_only: bool = False) -> dict[str, bytes]:
    detected = _detected(campaign, folder)
    spots = [detected.get(spot.spot, spot) for spot in campaign.spots]
    moves, table = moves_bytes(campaign.moves), spots_bytes(spots)
    if campaign.moves:
        parse_spots(table, "spots.csv", parse_moves(moves), campaign.stereo_pair)
    files = {"moves.csv": moves, "spots.csv": table}
    if tables_only:
        return files
    return {"stereo.json": stereo_bytes(campaign.stereo_pair), **files, "campaign.toml": campaign_toml(campaign)}


def _detected(campaign: Campaign, folder: Path) -> dict[int, Spot]:
    """Spots that are undetected in the journal and that `detect` has found since, from the present spots.csv."""
    waiting = {spot.spot: spot.move for spot in campaign.spots if spot.status == UNDETECTED}
    if not waiting or not (folder / "spots.csv").is_file():
        return {}
    try:
        data = read_bytes(folder / "spots.csv", CSV_BYTES_MAX, folder)
        present = parse_spots(data, "spots.csv", campaign.moves, campaign.stereo_pair)
    except InputError:
        return {}
    found = (spot for spot in present if spot.status != UNDETECTED)
    return {spot.spot: spot for spot in found if waiting.get(spot.spot) == spot.move}


def _longer(campaign: Campaign, folder: Path) -> set[str]:
    """Tables that have all rows of the journal and more.

    The journal records lost steps only at the end of a segment, so that a status may be older or newer.
    """

    def same(row: Look, journal: Look) -> bool:
        if journal.status == UNDETECTED and row.spot == journal.spot:
            return True
        return row == journal or (
            LOST_STEPS in (row.status, journal.status) and replace(row, status=journal.status) == journal
        )

    try:
        present = read_campaign(folder)
    except InputError:
        return set()
    moves, looks = len(campaign.moves), len(campaign.spots)
    is_longer = {
        "moves.csv": len(present.moves) > moves and present.moves[:moves] == campaign.moves,
        "spots.csv": len(present.spots) > looks and all(map(same, present.spots, campaign.spots)),
    }
    return {name for name, longer in is_longer.items() if longer}


@dataclass(frozen=True)
class Outcome:
    """The end of a run.

    Attributes:
        reason: "done", "target met", "time over", "interrupted" or "declined".
        looks: number of looks of this campaign, in all its runs.
        ok: number of looks that count.
        refused: number of looks without a usable spot.
        references: number of `looks` outside the plan: resumed runs repeat looks at earlier spots. They count as
            all others.
        retries: looks repeated in this run.
        lost_segments: segments in which steps were lost.
        warnings: warnings for the user.
        estimate: the last running estimate, None for none.
    """

    reason: str
    looks: int
    ok: int
    refused: int
    references: int
    retries: int
    lost_segments: tuple[int, ...]
    warnings: tuple[str, ...]
    estimate: Estimate | None = None

    def as_json(self) -> dict[str, object]:
        """The document of `tvsbayes acquire`."""
        return {**plain(self), "estimate": None if self.estimate is None else self.estimate.as_json()}


class RunLog:
    """Keeps journal, recorded campaign and campaign files consistent.

    Args:
        journal: from `begin`; closed by `end`.
        rig: the rig.
        utc: the time of day.

    Attributes:
        record: the campaign so far, of all runs.
        behind: why the campaign files lag the journal, "" where they do not.
        warnings: warnings for the user.
    """

    def __init__(self, journal: Journal, rig: Rig, utc: Callable[[], datetime.datetime]):
        self._journal, self._rig, self._utc = journal, rig, utc
        self.record = recorded(journal.records)
        self.behind = ""
        self.warnings: list[str] = []
        self._time_s = max((move.time_s for move in self.record.moves), default=0.0)

    @property
    def ok_looks(self) -> int:
        """Number of looks that count so far."""
        return sum(spot.status == "ok" for spot in self.record.looks)

    def write(self, event: Event) -> None:
        """Appends an event; after a homing the campaign files are rewritten.

        Raises:
            DeviceFault: the disk refuses.
        """
        entries = event.entries()
        self.record.add(self._journal.append(entries.pop("event"), **entries))
        if isinstance(event, Homed | Verified):
            self.derive(always=True)

    def now_s(self) -> float:
        """Seconds since the campaign was created, never decreasing, even if the computer's clock is set back."""
        start = datetime.datetime.fromisoformat(str(self._journal.records[0].data.get("created")))
        self._time_s = max(self._time_s, round((self._utc() - start).total_seconds(), 3))
        return self._time_s

    def utc_text(self) -> str:
        """The time of day."""
        return self._utc().isoformat(timespec="milliseconds")

    def next_spot(self) -> int:
        """The first number used neither by an event nor by a frame of an interrupted look."""
        names = orphans(self._journal.folder, self._journal.records)
        # Other pictures in these folders have no number.
        used = [int(name.split("/")[1][:6]) for name in names if FRAME_NAME.fullmatch(name)]
        return max([*used, *(spot.spot for spot in self.record.looks)], default=-1) + 1

    def close_segment(self, report: HomeReport) -> None:
        """Logs the result of a homing for the segment that it ends."""
        if not self.record.moves:
            return
        comparable = report.known or (report.compared and report.state.boot == self.record.boot)
        segment, deviation = self.record.moves[-1].segment, report.deviation_steps if comparable else None
        self.write(Verified(segment=segment, deviation_steps=deviation))
        if deviation is not None and max(map(abs, deviation)) > HOME_TOLERANCE_STEPS:
            self.warnings.append(
                f"segment {segment}: the home switches were found {deviation[0]} and {deviation[1]} steps off: steps "
                "were lost, its spots do not count; lower the speed or free the mechanism"
            )

    def end(self, reason: str, exit_code: int) -> None:
        """Logs the end, as far as the disk allows, closes the journal and writes the campaign files."""
        try:
            self.write(Stop(reason=reason, exit_code=exit_code, utc=self.utc_text()))
        except DeviceFault:
            # A disk fault ended the run, and is reported already.
            pass
        finally:
            self._journal.close()
        self.derive(always=True)
        if self.behind:
            self.warnings.append(f"the campaign files are behind the journal: {self.behind}")

    def derive(self, always: bool = False) -> None:
        """Rewrites the campaign files where they are due (see `DERIVED_EVERY`)."""
        count = len(self.record.looks)
        if not self.record.moves or (not always and count > DERIVED_EVERY and count % (count // DERIVED_EVERY)):
            return
        try:
            write_derived(self._campaign(), self._journal.folder, tables_only=not always)
            self.behind = ""
        except TvsError as error:
            # A table may be open in another program. The journal is complete, and the next look tries again, or
            # --resume after the last one.
            self.behind = error.message

    def keep_edited(self) -> None:
        """Copies campaign files with more content than the journal before they are rewritten, and warns of each.

        A user may have refused spots or added readings or priors; a journal may have lost its end. Tables that only
        lack the latest rows are not copied: a run leaves them in this state. Unfinished files of killed runs are
        removed.
        """
        folder, campaign = self._journal.folder, self._campaign()
        remove_unfinished(folder, DERIVED)
        longer = _longer(campaign, folder)
        for name, data in _files(campaign, folder).items():
            path = folder / name
            if not path.is_file():
                continue
            present = read_bytes(path, CSV_BYTES_MAX, folder)
            if not set(present.splitlines()) - set(data.splitlines()):
                continue
            kind, number = "longer" if name in longer else "edited", 1
            while (copy := path.with_name(f"{path.stem}.{kind}-{number}{path.suffix}")).exists():
                number += 1
            write_atomically(copy, present)
            self.warnings.append(
                f"{name} had rows that {LOG} lacks, which has lost its end: they are kept in {copy.name}, lost looks "
                "are taken again"
                if name in longer
                else f"{name} was edited since: what stood in it is kept in {copy.name}"
            )

    def _campaign(self) -> Campaign:
        """The campaign in the journal so far, after the first homing."""
        created = event_of(self._journal.records[0], Created)
        assert created is not None
        start = datetime.datetime.fromisoformat(created.created).astimezone(datetime.UTC)
        header: dict[str, object] = {"name": NAME_ACQUIRED if created.name is UNSET else created.name, "created": start}
        flags = {"synthetic": created.synthetic, "seed": created.seed}
        header |= {name: value for name, value in flags.items() if value is not UNSET}
        return campaign_of(self.record, Campaign((), (), self._rig.stereo, self._rig.table, header))

    def outcome(self, reason: str, retries: int, estimate: Estimate | None) -> Outcome:
        """The outcome of a run with this reason, number of repeated looks and last estimate."""
        statuses = [spot.status for spot in self.record.spots]
        ok, waiting = statuses.count("ok"), statuses.count(UNDETECTED)
        return Outcome(
            reason=reason,
            looks=len(statuses),
            ok=ok,
            refused=len(statuses) - ok - waiting,
            references=self.record.references,
            retries=retries,
            lost_segments=tuple(sorted(self.record.lost)),
            warnings=tuple(self.warnings),
            estimate=estimate,
        )
