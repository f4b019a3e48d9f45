"""Commands of an axis folder.

The modules of the commands contain their options; `cli/instruments` calls these functions for an axis folder.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from tvsbayes.cli.app import (
    check_output,
    command_line,
    finish,
    finish_kept,
    keep,
    report_line,
    write_new,
)
from tvsbayes.cli.outcomes import WATCHING, finish_watch, finish_watch_plan, write_kept
from tvsbayes.cli.progress_bar import waiting
from tvsbayes.cli.report_page import DRAWING, Certification, CertifiedPage, Part, print_parts, tolerance_of
from tvsbayes.errors import InputError, NothingToEstimate, escaped
from tvsbayes.files.csv_table import CSV_BYTES_MAX
from tvsbayes.files.disk import output_place, read_bytes, write_atomically
from tvsbayes.pipeline import MAX_MINUTES
from tvsbayes.progress import Job
from tvsbayes.results.records import plain
from tvsbayes.results.store import sole_writer
from tvsbayes.results.tiers import CHAIN, IMPORTANCE
from tvsbayes.single_axis.axis_campaign import AxisCampaign, axis_hashes, axis_templates, parse_axis_moves, read_axis
from tvsbayes.single_axis.axis_rows import rows_of

if TYPE_CHECKING:
    from tvsbayes.compensation.formats import Wish
    from tvsbayes.metrology.conformity import Tolerance
    from tvsbayes.metrology.dcc import Embedded, Parties
    from tvsbayes.report.document import Document, Issue
    from tvsbayes.results.compensation_record import Compensation
    from tvsbayes.results.records import Tier
    from tvsbayes.single_axis.axis_record import AxisResults

FITTING, PLANNING, CHOOSING, MAKING = "fit", "choosing stops", "choosing looks", "compensation"


@contextmanager
def _fitted(data: AxisCampaign, stage: str, seed: int, share: float = 1.0) -> Iterator[tuple[AxisResults, Job]]:
    """The stored fit of an axis, or a new one; the block takes `share` times as long, as `stage` of the job."""
    from tvsbayes.single_axis.axis_record import results_for

    with waiting() as progress, Job({FITTING: 1.0, stage: share}, progress) as job:
        yield results_for(data, progress=job.part(FITTING), seed=seed, notify=report_line), job


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
    place = out or output_place(folder, "results")
    fitted = _fit(read_axis(folder), place, tier, no_sample, max_minutes, seed, details)
    hint = f"\nnext: {command_line('report', folder)}" if fitted.error is None and out is None else ""
    finish(fitted.document or {}, fitted.text + hint, as_json, fitted.error)


def _fit(
    data: AxisCampaign,
    to: Path,
    tier: Tier | None,
    no_sample: bool,
    max_minutes: float,
    seed: int,
    details: bool = False,
) -> Part:
    """Fit an axis and write the results into a folder; options as in `fit`."""
    from tvsbayes.report.axis_document import axis_fit_text
    from tvsbayes.single_axis.axis_fit import fit_axis
    from tvsbayes.single_axis.axis_record import keep_fit, summarise_axis, uninformed

    with sole_writer(to):
        with waiting() as progress:
            result = fit_axis(
                data, tier=tier, sampled=not no_sample, max_minutes=max_minutes, seed=seed, progress=progress
            )
        summary = summarise_axis(result)
        files = keep_fit(result, summary, to)
    document = {**summary.as_json(), "seed": seed, "files": files}
    text = axis_fit_text(summary, details, list(files.values()))
    return Part("fit", document, text, result.error or uninformed(summary))


def calibrate(folder: Path, *, issue: Issue, quick: bool, no_sample: bool, seed: int, pdf: bool, as_json: bool) -> None:
    """Run check, classic, fit and report of an axis in one command."""

    def parts() -> Iterator[Part]:
        from tvsbayes.report.command_text import check_text

        data, check = read_axis(folder), contents(folder)
        yield Part("check", check, check_text(check))
        yield _classic(data)
        yield _fit(data, output_place(folder, "results"), IMPORTANCE if quick else CHAIN, no_sample, MAX_MINUTES, seed)
        page = AxisPage(folder, issue, False, data).written(pdf)
        page.report_removed()
        yield page.part()

    print_parts(parts(), as_json)


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

    known, fresh = read_axis(folder), read_axis(looks)
    with _fitted(known, WATCHING, seed) as (results, job):
        job.begin(WATCHING)
        result = watch_axis(results.fit, fresh, seed=seed)
    finish_watch(result, append, as_json, "stops")


def plan_watch(folder: Path, minutes: float | None, out: Path | None, seed: int, as_json: bool) -> None:
    """`plan AXIS --watch`: the fewest stops by which `watch` notices a change of ratio, play or zero."""
    from tvsbayes.comparison.axis_sessions import plan_watch_axis
    from tvsbayes.compensation.promise import SURER, refuse_answer

    with _fitted(read_axis(folder), CHOOSING, seed) as (results, job):
        refuse_answer(results.summary.answer, SURER, "what a watch would notice cannot be trusted")
        job.begin(CHOOSING)
        plan, stops = plan_watch_axis(results.fit, minutes=minutes, seed=seed)

    def write(path: Path) -> None:
        write_atomically(path, stops.plan_bytes())

    finish_watch_plan(plan, "stops", out, write, as_json)


def plan_verify(folder: Path, out: Path | None, seed: int, as_json: bool) -> None:
    """`plan AXIS --verify`: the fewest readings that verify its table."""
    from tvsbayes.compensation.verification import plan_verification, refuse_drive, stored_compensation
    from tvsbayes.report.compensation_text import verify_plan_text

    data = read_axis(folder)
    compensation = stored_compensation(data)
    refuse_drive(compensation)
    with _fitted(data, PLANNING, seed) as (results, job):
        job.begin(PLANNING)
        stops = plan_verification(results.fit, compensation, seed=seed)
    document, text = plain(stops), verify_plan_text(stops)
    if out is not None:
        write_atomically(out, stops.plan_bytes())
        document["plan"] = str(out)
        text += f"\nwritten: {escaped(str(out), 200)}"
    finish({**document, "seed": seed}, text, as_json)


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

    data = read_axis(folder)
    wish = tolerance_of(tolerance, of, rule, guard, figures_by_name(data.unit))
    AxisPage(folder, issue, quick, data, wish).finish(pdf, out, as_json, certification)


@dataclass
class AxisPage(CertifiedPage):
    """The page of an axis; `results` are there once the document is made."""

    data: AxisCampaign
    tolerance: Tolerance | None = None
    results: AxisResults = field(init=False)
    stages: ClassVar = {FITTING: 3.0, DRAWING: 1.5}

    def document(self, job: Job) -> Document:
        """Make the document; fits first where results are missing."""
        from tvsbayes.report.axis_document import axis_document, criteria_of, curve_commands
        from tvsbayes.single_axis.axis_record import results_for

        commands = rows_of(self.data).command
        curve = curve_commands(float(commands.min()), float(commands.max()))
        self.results = results_for(self.data, curve, job.part(FITTING), notify=report_line, tier=self.tier)
        self.criteria = criteria_of(self.results.summary, self.tolerance)
        job.begin(DRAWING)
        return axis_document(self.results, self.issue, self.criteria)

    def lines(self, number: str, certified: Sequence[str] = ()) -> list[str]:
        """Verdicts on the limits, then the certificate, then the page's number."""
        from tvsbayes.report.evidence import criterion_text

        return [*map(criterion_text, self.criteria), *super().lines(number, certified)]

    def certificate(self, parties: Parties, report: Embedded, signed: bool) -> bytes:
        """DCC-schema XML with the page inside, issued on its day (UTC)."""
        from tvsbayes.single_axis.axis_certificate import axis_certificate

        issued, criteria = self.issue.day, self.criteria
        return axis_certificate(
            self.results, issued=issued, parties=parties, report=report, criteria=criteria, signed=signed
        )


def plan(
    folder: Path, *, alone: bool, target: str | None, minutes: float | None, out: Path | None, seed: int, as_json: bool
) -> None:
    """Plan the next readings; `alone` where the folder is given alone, by --given."""
    if not alone:
        message, remedy = "an axis is planned from its folder alone", "give --given FOLDER without RIG"
        raise InputError("usage", message, remedy=remedy)
    from tvsbayes.report.axis_document import axis_plan_text
    from tvsbayes.single_axis.next_stops import TARGETS, plan_next, unit_of

    goal = target or TARGETS[0]
    if goal not in TARGETS:
        message, allowed = f"--target {escaped(goal)}: unknown for an axis", ", ".join(TARGETS)
        raise InputError("target", message, column="--target", allowed=allowed, remedy=f"name one of {allowed}")
    data = read_axis(folder)
    with _fitted(data, PLANNING, seed, 3.0) as (results, job):
        stops = plan_next(results.fit, goal, minutes=minutes, progress=job.part(PLANNING))
    document, text = {**stops.as_json(), "unit": data.unit, "seed": seed}, axis_plan_text(stops, data.unit)
    document["u_unit"] = unit_of(stops.target, data.unit)
    if out is not None and stops.next:
        write_atomically(out, stops.plan_bytes())
        document["plan"] = str(out)
        text += f"\nwritten: {escaped(str(out), 200)}"
    elif out is not None:
        text += f"\nnothing written to {escaped(str(out), 200)}"
    if keep(document, place := output_place(folder, "results") / "plan.json"):
        document["files"] = {"next": str(place)}
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


def make_table(folder: Path, wish: Wish, out: Path | None, force: bool, seed: int, as_json: bool) -> None:
    """Make the table of a controller with its promise, and write both where a file is named: `compensate`."""
    from tvsbayes.compensation.formats import checked
    from tvsbayes.compensation.promise import compensation_of, file_beside, file_text
    from tvsbayes.compensation.verification import compensation_in, table_in
    from tvsbayes.report.compensation_text import compensation_text
    from tvsbayes.results.compensation_record import COMPENSATION_FORMAT
    from tvsbayes.results.fit_record import provenance

    form = checked(wish)
    second = out.with_name(f"{out.name}.yaml") if out is not None and form.beside is not None else None
    check_output(out, kind="compensation", force=force)
    check_output(second, kind="compensation", force=force and second is not None)
    data = read_axis(folder)
    before = compensation_in(data)
    replaced = table_in(data, out) if out is not None and out.is_file() else None
    with _fitted(data, MAKING, seed) as (results, job):
        compensation = compensation_of(results, wish, seed=seed, progress=job.part(MAKING))
    origin = plain(provenance(axis_hashes(data), seed, results.fit_id))
    document = {"format": COMPENSATION_FORMAT, **compensation.as_json(), **origin}
    content = file_text(compensation, data)
    record_path = output_place(folder, "results") / "compensation.json"
    held = record_path.read_bytes() if out is not None and before is not None else b""
    contents = {wish.target: (out, content), "yaml": (second, file_beside(compensation, data) or "")}
    files = write_kept(folder, document, contents)
    if "compensation" in files:
        _name_other_promises(compensation, before, replaced, record_path.parent, held)
    text = compensation_text(compensation, list(files.values()))
    if out is None:
        text += f"\nnothing written: give -o FILE; it would hold:\n\n{content}".rstrip("\n")
    else:
        next_step = compensation.shown_by if compensation.in_motion else command_line("verify", folder, "FRESH")
        text += f"\nnext: apply it, then {next_step}"
    finish({**document, "files": files}, text, as_json)


def _name_other_promises(
    made: Compensation, before: Compensation | None, replaced: Compensation | None, results: Path, held: bytes
) -> None:
    """Say which promise ends, since its file was replaced, and keep that of the table made before, `held`, beside."""
    from tvsbayes.compensation.verification import kept_name

    if replaced is not None and replaced.digest != made.digest:
        (results / kept_name(replaced)).unlink(missing_ok=True)
        table = f"the table made before (--to {replaced.target}, {replaced.table_id})"
        report_line(f"note: the promise of {table} ends: its file is replaced")
    if before is not None and before.digest not in (made.digest, getattr(replaced, "digest", "")):
        write_atomically(results / kept_name(before), held)
        table = f"the table made before (--to {before.target}, {before.table_id})"
        report_line(f"note: the promise of {table} stays: `verify --table FILE` tests it, `verify` alone this one")
