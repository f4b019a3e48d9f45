"""The records of a run: the journal, the campaign derived from it, its files, and the outcome.

Seconds where a name says `_s`, since the campaign was created; UTC for people.
"""

from __future__ import annotations

import datetime
from collections.abc import Callable
from dataclasses import dataclass

from msgspec import UNSET

from tvsbayes.acquisition.campaign_files import DERIVED, campaign_of, keep_edited, write_derived
from tvsbayes.acquisition.journal import LOG, Journal, event_of, kind_of
from tvsbayes.acquisition.journal_check import orphans
from tvsbayes.acquisition.journal_events import FRAME_NAME, Created, Event, Homed, Stop, Verified
from tvsbayes.acquisition.recorder import HOME_TOLERANCE_STEPS, Recorder
from tvsbayes.acquisition.running_estimate import Estimate
from tvsbayes.errors import DeviceFault, TvsError
from tvsbayes.files.disk import remove_unfinished
from tvsbayes.instrument.campaign import NAME_ACQUIRED, UNDETECTED, Campaign
from tvsbayes.instrument.rig import Rig
from tvsbayes.positioner.interface import HomeReport
from tvsbayes.results.records import plain


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


DERIVED_EVERY = 100
"""Up to this number of spots the campaign files are written after every look, then at growing intervals: at least 99 %
of the looks are in them at any time, all of them in the journal."""


class RunLog:
    """Keeps journal, recorder and campaign files consistent.

    Args:
        journal: from `begin`; closed by `end`.
        rig: the rig.
        utc: the time of day.

    Attributes:
        recorder: the campaign so far, of all runs.
        behind: why the campaign files lag the journal, "" where they do not.
        warnings: warnings for the user.
    """

    def __init__(self, journal: Journal, rig: Rig, utc: Callable[[], datetime.datetime]):
        self._journal, self._rig, self._utc = journal, rig, utc
        self.recorder = Recorder()
        for record in journal.records:
            self.recorder.add(record)
        self.behind = ""
        self.warnings: list[str] = []
        self._time_s = max((move.time_s for move in self.recorder.moves), default=0.0)

    @property
    def ok_looks(self) -> int:
        """Number of looks that count so far."""
        return sum(spot.status == "ok" for spot in self.recorder.spots)

    def write(self, event: Event) -> None:
        """Appends an event; after a homing the campaign files are rewritten.

        Raises:
            DeviceFault: the disk refuses.
        """
        self.recorder.add(self._journal.append(kind_of(type(event)), **event.entries()))
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
        used = [spot.spot for spot in self.recorder.spots]
        names = orphans(self._journal.folder, tuple(self._journal.records))
        # Other pictures in these folders have no number.
        used += [int(name.split("/")[1][:6]) for name in names if FRAME_NAME.fullmatch(name)]
        return max(used, default=-1) + 1

    def close_segment(self, report: HomeReport) -> None:
        """Logs the result of a homing for the segment that it ends."""
        if not self.recorder.moves:
            return
        comparable = report.known or (report.compared and report.state.boot == self.recorder.state.boot)
        segment, deviation = self.recorder.moves[-1].segment, report.deviation_steps if comparable else None
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
        count = len(self.recorder.spots)
        if not self.recorder.moves or (not always and count > DERIVED_EVERY and count % (count // DERIVED_EVERY)):
            return
        try:
            write_derived(self._campaign(), self._journal.folder, tables_only=not always)
            self.behind = ""
        except TvsError as error:
            # A table may be open in another program. The journal is complete, and the next look tries again, or
            # --resume after the last one.
            self.behind = error.message

    def keep_edited(self) -> None:
        """Copies files with more content than the journal before they are rewritten, and warns of each.

        Unfinished files of killed runs are removed.
        """
        folder, campaign = self._journal.folder, self._campaign()
        remove_unfinished(folder, DERIVED)
        self.warnings += [
            f"{name} had rows that {LOG} lacks, which has lost its end: they are kept in {copy.name}, lost looks are "
            "taken again"
            if copy.stem.rpartition("-")[0].endswith(".longer")
            else f"{name} was edited since: what stood in it is kept in {copy.name}"
            for name, copy in keep_edited(campaign, folder).items()
        ]

    def _campaign(self) -> Campaign:
        """The campaign in the journal so far, after the first homing."""
        created = event_of(self._journal.records[0], Created)
        assert created is not None
        start = datetime.datetime.fromisoformat(created.created).astimezone(datetime.UTC)
        header: dict[str, object] = {"name": NAME_ACQUIRED if created.name is UNSET else created.name, "created": start}
        flags = {"synthetic": created.synthetic, "seed": created.seed}
        header |= {name: value for name, value in flags.items() if value is not UNSET}
        return campaign_of(self.recorder.result(), Campaign((), (), self._rig.stereo, self._rig.table, header))

    def outcome(self, reason: str, retries: int) -> Outcome:
        """The outcome of a run with this reason and number of repeated looks."""
        record = self.recorder.result()
        ok = sum(spot.status == "ok" for spot in record.spots)
        waiting = sum(spot.status == UNDETECTED for spot in record.spots)
        return Outcome(
            reason=reason,
            looks=len(record.spots),
            ok=ok,
            refused=len(record.spots) - ok - waiting,
            references=record.references,
            retries=retries,
            lost_segments=tuple(segment for segment, _ in record.lost),
            warnings=tuple(self.warnings),
        )
