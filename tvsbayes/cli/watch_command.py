"""Command watch: compares new looks with a stored calibration, and plans the looks."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from tvsbayes.cli.app import CampaignFolder, Json, Seed, refuse_options, report_line
from tvsbayes.cli.instruments import INSTRUMENTS, instrument_of, refuse_mixed, serve
from tvsbayes.cli.outcomes import WATCHING, finish_watch, finish_watch_plan
from tvsbayes.cli.progress_bar import waiting
from tvsbayes.errors import InputError
from tvsbayes.pipeline import FITTING, StoredOrFitted, compile_for
from tvsbayes.progress import Job

PLANNING = "choosing looks"


def watch(
    campaign: CampaignFolder,
    looks: Annotated[Path, Argument(metavar="LOOKS", help="Campaign folder of at least 4 new looks or stops.")],
    append: Annotated[
        Path | None, Option(metavar="TABLE.csv", help="Add a line to this table, for a nightly job.")
    ] = None,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Test whether a calibration still holds: OK, MOVED or CANNOT TELL.

    Exit 0, 1 or 3. What moved (cameras, positioner, zero, ratio, play), by how much, and what the looks can see.
    """
    refuse_mixed(campaign, looks)
    if serve("watch", **locals()):
        return
    from tvsbayes.instrument.campaign import read_campaign
    from tvsbayes.instrument.copies import refuse_same_looks

    known, new = read_campaign(campaign), read_campaign(looks)
    refuse_same_looks(known, new)
    compile_for(report_line)
    with waiting() as progress, Job({FITTING: 1.0, WATCHING: 1.0}, progress) as job:
        fitted = StoredOrFitted(known, report_line, job.part(FITTING)).fit
        job.begin(WATCHING)
        from tvsbayes.comparison.watched_looks import watch as watch_looks

        result = watch_looks(fitted, new, seed=seed)
    if not result.same_cameras:
        report_line("warning: the new looks state other cameras; those of the campaign are used")
    finish_watch(result, append, as_json)


def plan_watch(
    path: Path | None, given: Path | None, *, minutes: float | None, out: Path | None, seed: int, as_json: bool
) -> None:
    """`plan CAMPAIGN --watch`, or `plan RIG --given CAMPAIGN --watch` with limits and costs of the rig file.

    Args:
        path: the campaign, or the rig file where the campaign is given.
        given: the campaign, or None.
        minutes: longest duration of the plan.
        out: file of the plan.
        seed: seed of the search.
        as_json: print the document.
    """
    from tvsbayes.instrument.campaign import read_campaign
    from tvsbayes.instrument.plan import write_plan
    from tvsbayes.instrument.rig import read_rig

    campaign = given or path
    if campaign is None:
        remedy = "write tvsbayes plan CAMPAIGN --watch -o looks.csv"
        raise InputError("usage", "--watch needs a campaign", remedy=remedy)
    if instrument_of(campaign) is INSTRUMENTS["axis"]:
        options: dict[str, object] = {"rig": path if given else None}
        refuse_options("for a scanner or a head", "an axis is planned from its folder alone", **options)
        INSTRUMENTS["axis"].command("plan_watch")(campaign, minutes, out, seed, as_json)
        return
    known, rig = read_campaign(campaign), None if given is None or path is None else read_rig(path)
    compile_for(report_line)
    with waiting() as progress, Job({FITTING: 1.0, PLANNING: 8.0}, progress) as job:
        fitted = StoredOrFitted(known, report_line, job.part(FITTING)).fit
        job.begin(PLANNING)
        from tvsbayes.planning.watch_plan import MINUTES, watch_plan

        looks = watch_plan(fitted, rig, minutes=MINUTES if minutes is None else minutes, seed=seed)

    def write(place: Path) -> None:
        write_plan(looks.steps, place, known.rig.mechanism)

    finish_watch_plan(looks, "looks", out, write, as_json)
