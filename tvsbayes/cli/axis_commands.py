"""Commands for an axis folder: check, fit, calibrate, compare, report, plan, simulate, new.

The modules of the commands contain their options; `cli/instruments` calls these functions for an axis folder.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tvsbayes.cli.app import TARGET_MISSED, Ended, command_line, finish, finish_kept, keep, report_line, write_new
from tvsbayes.cli.progress_bar import waiting
from tvsbayes.cli.report_options import Certification, parties_of, tolerance_of
from tvsbayes.cli.report_page import DRAWING, Part, WrittenPage, print_parts, written_page
from tvsbayes.cli.watched import WATCHING, finish_watch
from tvsbayes.errors import InputError, NothingToEstimate, TvsError, escaped
from tvsbayes.files.csv_table import CSV_BYTES_MAX
from tvsbayes.files.disk import output_place, read_bytes, write_atomically
from tvsbayes.metrology.conformity import CONFORMS, Criterion, Tolerance
from tvsbayes.pipeline import MAX_MINUTES
from tvsbayes.progress import Job
from tvsbayes.results.records import plain
from tvsbayes.results.store import sole_writer
from tvsbayes.results.tiers import CHAIN, IMPORTANCE
from tvsbayes.single_axis.axis_campaign import AxisCampaign, axis_hashes, axis_templates, parse_axis_moves, read_axis
from tvsbayes.single_axis.axis_rows import rows_of

if TYPE_CHECKING:
    from tvsbayes.metrology.dcc import Embedded
    from tvsbayes.report.document import Document, Issue
    from tvsbayes.results.records import Tier
    from tvsbayes.single_axis.axis_record import AxisResults, AxisSummary

FITTING, PLANNING = "fit", "choosing stops"


def new(out: Path, as_json: bool) -> None:
    """Write an empty axis folder, explained in campaign.toml."""
    next_steps = "log moves and readings, then `tvsbayes check` this folder, then `tvsbayes fit`"
    write_new(out, axis_templates(), next_steps, as_json)


def contents(folder: Path) -> dict[str, Any]:
    """The document of `check` for an axis folder."""
    from tvsbayes.single_axis.axis_doubts import axis_warnings

    data = read_axis(folder)
    commands = [m.command for m in data.moves]
    document: dict[str, Any] = {
        "kind": "axis",
        "unit": data.unit,
        "moves": len(data.moves),
        "segments": data.moves[-1].segment + 1,
        "readings": len(data.readings),
        "ok": sum(r.status == "ok" for r in data.readings),
        "range_command": [min(commands), max(commands)],
        "positions": 0,
    }
    try:
        rows = rows_of(data)
    except NothingToEstimate as error:
        return {**document, "warnings": [f"{error.message}: {error.remedy}"]}
    if rows.in_motion:
        # The moves of a drive are only the beginnings of its stretches.
        document["range_command"] = [float(rows.command.min()), float(rows.command.max())]
    return {**document, "positions": len(rows.positions), "warnings": axis_warnings(data, rows)}


def classic(folder: Path, as_json: bool) -> None:
    """Print the least-squares line with one reversal, and ISO 230-2."""
    part = _classic(read_axis(folder))
    finish(part.document or {}, part.text, as_json)


def _classic(data: AxisCampaign) -> Part:
    """The result of `classic`."""
    from tvsbayes.report.axis_document import classic_text
    from tvsbayes.single_axis.classic_line import classic_axis

    line = classic_axis(rows_of(data))
    return Part("classic", {"unit": data.unit, **plain(line)}, classic_text(line, data.unit))


def fit(
    folder: Path,
    *,
    tier: Tier | None,
    no_sample: bool,
    max_minutes: float,
    details: bool,
    out: Path | None,
    seed: int,
    as_json: bool,
) -> None:
    """Fit an axis; write results into its folder or `out`."""
    from tvsbayes.report.axis_document import axis_fit_text

    place = out or output_place(folder, "results")
    stored = _kept_fit(read_axis(folder), place, tier, no_sample, max_minutes, seed)
    text = axis_fit_text(stored.summary, details, list(stored.files.values()))
    if stored.error is None and out is None:
        text += f"\nnext: {command_line('report', folder)}"
    finish(stored.as_json(seed), text, as_json, stored.error)


@dataclass(frozen=True)
class StoredFit:
    """A fit in its folder: summary, files by kind, and the error of a fit that must not be used, else None."""

    summary: AxisSummary
    files: dict[str, str]
    error: TvsError | None

    def as_json(self, seed: int) -> dict[str, Any]:
        """The document of `fit --json`."""
        return {**self.summary.as_json(), "seed": seed, "files": self.files}


def _kept_fit(
    data: AxisCampaign, to: Path, tier: Tier | None, no_sample: bool, max_minutes: float, seed: int
) -> StoredFit:
    """Fit an axis and write the results into a folder; options as in `fit`."""
    from tvsbayes.single_axis.axis_fit import fit_axis
    from tvsbayes.single_axis.axis_record import keep_fit, summarise_axis, uninformed

    with sole_writer(to):
        with waiting() as progress:
            result = fit_axis(
                data,
                tier=tier,
                sampled=not no_sample,
                max_minutes=max_minutes,
                seed=seed,
                progress=progress,
            )
        summary = summarise_axis(result)
        return StoredFit(summary, keep_fit(result, summary, to), result.error or uninformed(summary))


def calibrate(folder: Path, *, issue: Issue, quick: bool, no_sample: bool, seed: int, pdf: bool, as_json: bool) -> None:
    """Run check, classic, fit and report of an axis in one command."""
    print_parts(_parts(folder, issue, quick, no_sample, seed, pdf), as_json)


def _parts(folder: Path, issue: Issue, quick: bool, no_sample: bool, seed: int, pdf: bool) -> Iterator[Part]:
    """The parts of `calibrate`; options as of it."""
    from tvsbayes.report.axis_document import axis_fit_text
    from tvsbayes.report.command_text import check_text

    data = read_axis(folder)
    check = contents(folder)
    yield Part("check", check, check_text(check))
    yield _classic(data)
    tier = IMPORTANCE if quick else CHAIN
    stored = _kept_fit(data, output_place(folder, "results"), tier, no_sample, MAX_MINUTES, seed)
    text = axis_fit_text(stored.summary, written=list(stored.files.values()))
    yield Part("fit", stored.as_json(seed), text, stored.error)
    page = _page(data, folder, issue, pdf).page
    page.report_removed()
    yield page.part()


def compare(folder: Path, *, other: Path | None, by: str | None, seed: int, as_json: bool) -> None:
    """Hold out each position in turn, for the fit and the classic line; with `other`, what has changed since."""
    if other is not None:
        _compare_later(folder, other, seed, as_json)
        return
    from tvsbayes.report.axis_document import axis_hold_out_text
    from tvsbayes.results.comparison_record import hold_out_document
    from tvsbayes.single_axis.held_out_positions import hold_out_positions

    if by not in (None, "positions"):
        message = f"--by {escaped(by)}: an axis leaves out positions"
        raise InputError("usage", message, column="--by", allowed="positions", remedy="write --by positions")
    data = read_axis(folder)
    with waiting() as progress:
        holdout = hold_out_positions(data, seed, progress)
    document = hold_out_document(holdout, data.unit) | {"inputs": axis_hashes(data), "seed": seed}
    place = output_place(folder, "results") / "compare.json"
    finish_kept(document, axis_hold_out_text(holdout, data.unit), place, as_json)


def _compare_later(folder: Path, other: Path, seed: int, as_json: bool) -> None:
    """Print what changed between two campaigns of an axis."""
    from tvsbayes.comparison.axis_sessions import compare_axes, refuse_other_axis, shared_positions
    from tvsbayes.report.command_text import changes_text
    from tvsbayes.single_axis.axis_record import results_for

    first, second = read_axis(folder), read_axis(other)
    refuse_other_axis(first, second)
    positions = shared_positions(rows_of(first), rows_of(second))
    stages = [f"{FITTING} of {escaped(str(each), 60)}" for each in (folder, other)]
    with waiting() as progress, Job(dict.fromkeys(stages, 1.0), progress) as job:
        fits = [
            results_for(data, positions, progress=job.part(stage), seed=seed, notify=report_line).fit
            for data, stage in zip((first, second), stages, strict=True)
        ]
    changes = compare_axes(*fits)
    finish(changes.as_json(), changes_text(changes), as_json)


def watch(folder: Path, *, looks: Path, append: Path | None, seed: int, as_json: bool) -> None:
    """Test whether the fit of an axis still holds for the readings of a second folder."""
    from tvsbayes.comparison.axis_sessions import watch_axis
    from tvsbayes.single_axis.axis_record import results_for

    known, new = read_axis(folder), read_axis(looks)
    with waiting() as progress, Job({FITTING: 1.0, WATCHING: 1.0}, progress) as job:
        results = results_for(known, progress=job.part(FITTING), seed=seed, notify=report_line)
        job.begin(WATCHING)
        result = watch_axis(results.fit, new, seed=seed)
    finish_watch(result, append, as_json, "stops")


def report(
    folder: Path,
    *,
    issue: Issue,
    quick: bool,
    pdf: bool,
    out: Path | None,
    as_json: bool,
    tolerance: str | None = None,
    of: str | None = None,
    rule: str | None = None,
    guard: float | None = None,
    dcc: bool = False,
    dcc_schema: Path | None = None,
    certification: Certification | None = None,
) -> None:
    """Write the page of an axis, and its certificate."""
    from tvsbayes.report.axis_document import figures_by_name
    from tvsbayes.report.evidence import criterion_text

    data = read_axis(folder)
    wish = tolerance_of(tolerance, of, rule, guard, figures_by_name(data.unit))
    made = _page(data, folder, issue, pdf, out, IMPORTANCE if quick else CHAIN, wish)
    page, lines, result, missed = made.page, [*map(criterion_text, made.criteria)], {}, False
    if certification is not None and (dcc or dcc_schema):
        done = certification.written(page, out, partial(made.certificate, certification.countries))
        lines, result, missed = [*lines, *done.lines], done.result, done.missed
    page.report_removed(certificates=True)
    lines += [f"report {page.number}", f"written: {', '.join(page.files.values())}"]
    finish(page.as_json(made.criteria) | result, "\n".join(lines), as_json)
    if missed or any(c.verdict != CONFORMS for c in made.criteria):
        raise Ended(TARGET_MISSED)


@dataclass
class AxisPage:
    """The page of an axis once it is written, with what it shows."""

    page: WrittenPage
    results: AxisResults
    issue: Issue
    criteria: tuple[Criterion, ...]

    def certificate(self, countries: Mapping[str, str], report: Embedded, signed: bool) -> bytes:
        """DCC-schema XML with the page inside, issued on its day (UTC)."""
        from tvsbayes.single_axis.axis_certificate import axis_certificate

        parties, issued = parties_of(self.issue, countries), self.issue.day
        return axis_certificate(
            self.results, issued=issued, parties=parties, report=report, criteria=self.criteria, signed=signed
        )


def _page(
    data: AxisCampaign,
    folder: Path,
    issue: Issue,
    pdf: bool,
    out: Path | None = None,
    tier: Tier = CHAIN,
    wish: Tolerance | None = None,
) -> AxisPage:
    """Write the page of an axis, and print it with `pdf`."""
    from tvsbayes.report.axis_document import axis_document, criteria_of, curve_commands
    from tvsbayes.single_axis.axis_record import results_for

    shown: dict[str, Any] = {}

    def make(job: Job) -> Document:
        commands = rows_of(data).command
        curve = curve_commands(float(commands.min()), float(commands.max()))
        results = results_for(data, curve, job.part(FITTING), notify=report_line, tier=tier)
        criteria = criteria_of(results.summary, wish)
        shown.update(results=results, criteria=criteria)
        job.begin(DRAWING)
        return axis_document(results, issue, criteria)

    page = written_page(folder, out, pdf, {FITTING: 3.0, DRAWING: 1.5}, make)
    return AxisPage(page, issue=issue, **shown)


def plan(
    folder: Path, *, alone: bool, target: str | None, minutes: float | None, out: Path | None, seed: int, as_json: bool
) -> None:
    """Plan the next readings; `alone` where the folder is given alone, by --given."""
    if not alone:
        message, remedy = "an axis is planned from its folder alone", "give --given FOLDER without RIG"
        raise InputError("usage", message, remedy=remedy)
    from tvsbayes.report.axis_document import axis_plan_text
    from tvsbayes.single_axis.axis_record import results_for
    from tvsbayes.single_axis.next_stops import TARGETS, plan_next, unit_of

    goal = target or TARGETS[0]
    if goal not in TARGETS:
        message, allowed = f"--target {escaped(goal)}: unknown for an axis", ", ".join(TARGETS)
        raise InputError("target", message, column="--target", allowed=allowed, remedy=f"name one of {allowed}")
    data = read_axis(folder)
    with waiting() as progress, Job({FITTING: 1.0, PLANNING: 3.0}, progress) as job:
        results = results_for(data, progress=job.part(FITTING), seed=seed, notify=report_line)
        stops = plan_next(results.fit, goal, minutes=minutes, progress=job.part(PLANNING))
    document, text = {**stops.as_json(), "unit": data.unit, "seed": seed}, axis_plan_text(stops, data.unit)
    document["u_unit"] = unit_of(stops.target, data.unit)
    if out is not None and stops.next:
        write_atomically(out, stops.plan_bytes())
        document["plan"] = str(out)
        text += f"\nwritten: {escaped(str(out), 200)}"
    elif out is not None:
        text += f"\nnothing written to {escaped(str(out), 200)}"
    if keep(document, output_place(folder, "results") / "plan.json"):
        document["files"] = {"next": str(output_place(folder, "results") / "plan.json")}
    finish(document, text, as_json)


def simulate(folder: Path, *, moves: Path | None, out: Path, seed: int, as_json: bool) -> None:
    """Simulate a random axis from the priors of a folder, with the listed moves."""
    from tvsbayes.twin.simulated_axis import simulate_axis

    template = read_axis(folder)
    axis_moves = None if moves is None else parse_axis_moves(read_bytes(moves, CSV_BYTES_MAX), escaped(moves.name, 200))
    axis = simulate_axis(template, axis_moves, seed)
    axis.write(out)
    count, read = len(axis.campaign.moves), len(axis.campaign.readings)
    document = {"campaign": str(out), "moves": count, "readings": read, "ok": read, "seed": seed}
    text = f"{escaped(str(out), 200)}: {count} moves, {read} readings; the truth is in truth.json"
    finish(document, text, as_json)
