"""watch: a few new looks against a stored calibration, and the table that a nightly job keeps of it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tvsbayes.cli import axis_commands
from tvsbayes.cli.app import TARGET_MISSED, CampaignFolder, Ended, Json, Seed, finish, report_line
from tvsbayes.cli.progress_bar import waiting
from tvsbayes.errors import InputError, NothingToEstimate
from tvsbayes.pipeline import FITTING, compile_for, fit_for
from tvsbayes.progress import Job

if TYPE_CHECKING:
    from tvsbayes.results.watch_record import Watch

WATCHING = "looking at the new looks"
TABLE_COLUMNS = ("time", "verdict", "p", "looks", "moved")


def watch(
    campaign: CampaignFolder,
    looks: Annotated[Path, typer.Argument(metavar="LOOKS", help="Campaign folder of at least 4 new looks.")],
    append: Annotated[
        Path | None, typer.Option("--append", metavar="TABLE.csv", help="Add a line to this table, for a nightly job.")
    ] = None,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Whether a calibration still holds: OK, MOVED or CANNOT TELL.

    Exit 0, 1 or 3. What moved (cameras, positioner, ratio, play), by how much, and what the looks can see.
    """
    from tvsbayes.instrument.campaign import read_campaign

    if axis_commands.is_axis(campaign) or axis_commands.is_axis(looks):
        raise InputError(
            "usage", "watch compares looks of a scanner, not of an axis", remedy="use compare --by positions"
        )
    known, new = read_campaign(campaign), read_campaign(looks)
    compile_for(report_line)
    with waiting() as progress, Job({FITTING: 1.0, WATCHING: 1.0}, progress) as job:
        fitted = fit_for(known, report_line, job.part(FITTING))
        job.begin(WATCHING)
        from tvsbayes.comparison.watched_looks import POWER_MIN
        from tvsbayes.comparison.watched_looks import watch as watch_looks

        found = watch_looks(fitted, new, seed=seed)
    if not found.same_cameras:
        report_line("warning: the new looks state other cameras; those of the campaign are used")
    from tvsbayes.report.watch_text import watch_text
    from tvsbayes.results.watch_record import CANNOT_TELL, OK

    finish(found.as_json(), watch_text(found, POWER_MIN), as_json)
    if append is not None:
        _append(append, found)
    if found.verdict != OK:
        raise Ended(NothingToEstimate.exit_code if found.verdict == CANNOT_TELL else TARGET_MISSED)


def _append(table: Path, found: Watch) -> None:
    """The line of now, UTC."""
    import datetime

    from tvsbayes.files.growing_table import append_line
    from tvsbayes.report.watch_text import moved_words

    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    moved = "; ".join(map(moved_words, found.moved))
    append_line(table, TABLE_COLUMNS, (now, found.verdict, found.p, found.looks, moved))
