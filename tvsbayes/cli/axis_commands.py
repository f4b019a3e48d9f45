"""What commands do with an axis folder: check, fit, compare, report, plan, simulate, new.

The commands themselves stand with their groups; they come here where `campaign.toml` says `tvsbayes-axis/1`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tvsbayes.cli.app import finish, keep, report_line
from tvsbayes.cli.progress_bar import waiting
from tvsbayes.errors import InputError, NothingToEstimate, escaped
from tvsbayes.files.disk import make_folder, output_place, shipped_data, write_atomically
from tvsbayes.progress import Job

STORED = "results/ are missing or older than the axis folder: fitting first (weighted draws) ..."
NOT_OF_AN_AXIS = "for a scanner, and this is an axis folder"
FITTING, PLANNING, PRINTING = "fit", "choosing stops", "printing to PDF"


def is_axis(folder: Path | None) -> bool:
    """Whether this is an axis folder."""
    from tvsbayes.single_axis.axis_campaign import is_axis_folder

    return folder is not None and (folder / "campaign.toml").is_file() and is_axis_folder(folder)


def new_axis(out: Path, as_json: bool) -> None:
    """An empty axis folder, explained in campaign.toml."""
    make_folder(out, empty=True)
    templates = sorted((shipped_data() / "axis_templates").iterdir())
    for template in templates:
        write_atomically(out / template.name, template.read_bytes())
    names = [template.name for template in templates]
    text = f"{escaped(str(out), 200)}: {', '.join(names)}\n"
    text += "next: log moves and readings, then `tvsbayes check` this folder, then `tvsbayes fit`"
    finish({"campaign": str(out), "files": names}, text, as_json)


def axis_held(folder: Path) -> dict[str, Any]:
    """What `check` says of an axis folder."""
    from tvsbayes.single_axis.axis_campaign import read_axis
    from tvsbayes.single_axis.axis_record import axis_warnings
    from tvsbayes.single_axis.axis_rows import rows_of

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
    return {**document, "positions": len(rows.positions), "warnings": axis_warnings(data, rows)}


def classic(folder: Path, as_json: bool) -> None:
    """The least-squares line with one reversal, and ISO 230-2."""
    from tvsbayes.report.axis_text import classic_text
    from tvsbayes.results.records import plain
    from tvsbayes.single_axis.axis_campaign import read_axis
    from tvsbayes.single_axis.axis_rows import rows_of
    from tvsbayes.single_axis.classic_line import classic_axis

    data = read_axis(folder)
    found = classic_axis(rows_of(data))
    finish({"unit": data.unit, **plain(found)}, classic_text(found, data.unit), as_json)


def fit(
    folder: Path,
    *,
    quick: bool,
    no_sample: bool,
    max_minutes: float,
    out: Path | None,
    seed: int,
    as_json: bool,
) -> None:
    """Fit an axis; results into its folder or `out`."""
    from tvsbayes.report.axis_text import axis_fit_text
    from tvsbayes.single_axis.axis_campaign import read_axis
    from tvsbayes.single_axis.axis_fit import fit_axis
    from tvsbayes.single_axis.axis_record import keep_fit, summarise_axis, uninformed

    data = read_axis(folder)
    place = out or output_place(folder, "results")
    with waiting() as progress:
        found = fit_axis(
            data,
            tier="importance" if quick else "emcee",
            sampled=not no_sample,
            max_minutes=max_minutes,
            seed=seed,
            progress=progress,
        )
    summary = summarise_axis(found)
    files = keep_fit(found, summary, place)
    document = {**summary.as_json(), "seed": seed, "files": files}
    text = f"{axis_fit_text(summary)}\nwritten: {', '.join(files.values())}"
    finish(document, text, as_json, found.error or uninformed(summary))


def compare(folder: Path, *, by: str | None, seed: int, as_json: bool) -> None:
    """Every position left out in turn, beside the classic."""
    from tvsbayes.report.axis_text import axis_hold_out_text
    from tvsbayes.single_axis.axis_campaign import axis_hashes, read_axis
    from tvsbayes.single_axis.held_out_positions import hold_out_positions

    if by not in (None, "positions"):
        message = f"--by {escaped(by)}: an axis leaves out positions"
        raise InputError("usage", message, column="--by", allowed="positions", remedy="write --by positions")
    data = read_axis(folder)
    with waiting() as progress:
        found = hold_out_positions(data, seed, progress)
    document: dict[str, Any] = {"kind": "positions left out", "unit": data.unit, "hold_out": found.as_json()}
    document |= {"inputs": axis_hashes(data), "seed": seed}
    files, text = {}, axis_hold_out_text(found, data.unit)
    if keep(document, path := output_place(folder, "results") / "compare.json"):
        files, text = {"compare": str(path)}, f"{text}\nwritten: {path}"
    finish({**document, "files": files}, text, as_json)


def report(folder: Path, *, pdf: bool, out: Path | None, as_json: bool) -> None:
    """The page of an axis."""
    from tvsbayes.single_axis.axis_campaign import read_axis

    data = read_axis(folder)
    from tvsbayes.report.axis_page import axis_html, curve_commands
    from tvsbayes.report.page import find_browser, print_to_pdf
    from tvsbayes.single_axis.axis_record import results_for
    from tvsbayes.single_axis.axis_rows import rows_of

    if pdf:
        find_browser()
    path = out or output_place(folder, "results") / "report.html"
    files = {"report": str(path)}
    read = rows_of(data).command
    stages = {FITTING: 3.0, "drawing the page": 1.5, PRINTING: 3.0 if pdf else 0.0}
    with waiting() as progress, Job(stages, progress) as job:
        results = results_for(data, curve_commands(float(read.min()), float(read.max())), job.part(FITTING))
        if not results.stored:
            report_line(STORED)
        job.begin("drawing the page")
        write_atomically(path, axis_html(results))
        if pdf:
            job.begin(PRINTING)
            files["pdf"] = str(print_to_pdf(path))
    finish({"criteria": [], "files": files}, f"written: {', '.join(files.values())}", as_json)


def plan(
    folder: Path, *, target: str | None, minutes: float | None, output: Path | None, seed: int, as_json: bool
) -> None:
    """What to read next."""
    from tvsbayes.report.axis_text import axis_plan_text
    from tvsbayes.single_axis.axis_campaign import read_axis
    from tvsbayes.single_axis.axis_record import results_for
    from tvsbayes.single_axis.next_stops import TARGETS, plan_next

    wanted = target or TARGETS[0]
    if wanted not in TARGETS:
        message, allowed = f"--target {escaped(wanted)}: unknown for an axis", ", ".join(TARGETS)
        raise InputError("target", message, column="--target", allowed=allowed, remedy=f"name one of {allowed}")
    data = read_axis(folder)
    with waiting() as progress, Job({FITTING: 1.0, PLANNING: 3.0}, progress) as job:
        results = results_for(data, progress=job.part(FITTING), seed=seed)
        if not results.stored:
            report_line(STORED)
        found = plan_next(results.fit, wanted, minutes=minutes, progress=job.part(PLANNING))
    document, text = {**found.as_json(), "unit": data.unit, "seed": seed}, axis_plan_text(found, data.unit)
    if output is not None and found.next:
        write_atomically(output, found.plan_bytes())
        document["plan"] = str(output)
        text += f"\nwritten: {escaped(str(output), 200)}"
    if keep(document, output_place(folder, "results") / "plan.json"):
        document["files"] = {"next": str(output_place(folder, "results") / "plan.json")}
    finish(document, text, as_json)


def simulate(folder: Path, moves: Path | None, out: Path, *, seed: int, as_json: bool) -> None:
    """A drawn axis with the priors of a folder, moved as listed."""
    from tvsbayes.files.csv_table import CSV_BYTES_MAX
    from tvsbayes.files.disk import read_bytes
    from tvsbayes.single_axis.axis_campaign import parse_axis_moves, read_axis
    from tvsbayes.single_axis.simulated_axis import simulate_axis

    template = read_axis(folder)
    listed = None if moves is None else parse_axis_moves(read_bytes(moves, CSV_BYTES_MAX), escaped(moves.name, 200))
    drawn = simulate_axis(template, listed, seed)
    drawn.write(out)
    count, read = len(drawn.campaign.moves), len(drawn.campaign.readings)
    document = {"campaign": str(out), "moves": count, "readings": read, "ok": read, "seed": seed}
    text = f"{escaped(str(out), 200)}: {count} moves, {read} readings; the truth is in truth.json"
    finish(document, text, as_json)
