"""compensate and verify: a table for a controller with its promise, and the test of this promise."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tvsbayes.cli.app import (
    TARGET_MISSED,
    CampaignFolder,
    Ended,
    Force,
    Json,
    Seed,
    check_output,
    command_line,
    finish,
    keep,
    report_line,
)
from tvsbayes.cli.kept_promise import finish_promised, promise_of, write_kept
from tvsbayes.cli.progress_bar import waiting
from tvsbayes.errors import InputError, NothingToEstimate, escaped
from tvsbayes.files.disk import output_place, write_atomically
from tvsbayes.instrument.mechanisms import MECHANISMS
from tvsbayes.pipeline import StoredOrFitted, inputs_of
from tvsbayes.pipeline import verify as verified
from tvsbayes.progress import Job

if TYPE_CHECKING:
    from tvsbayes.instrument.mechanisms import Mechanism
    from tvsbayes.results.compensation_record import Compensation

FITTING, MAKING = "fit", "compensation"
EXPORTS = {"header": "calibration in C", "json": "calibration"}
"""Kinds of file of an exported calibration, by the option's word."""
LETTERS, APPLIERS = "XYZABC", ("controller", "host")


def _two_axis_mechanism(folder: Path) -> Mechanism | None:
    """The mechanism of a scanner or a head; None for an axis, and where no header can be read."""
    from tvsbayes.instrument.campaign_header import mechanism_key

    return MECHANISMS.get(mechanism_key(folder))


def compensate(
    campaign: CampaignFolder,
    to: Annotated[
        str, typer.Option("--to", help="csv, linuxcnc, grbl, grblhal, klipper, header (C), urdf (xacro) or pec.")
    ],
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Write the file here, and keep the promise.")] = None,
    applied_by: Annotated[str, typer.Option("--applied-by", help="Who adds it: controller or host.")] = "controller",
    per_command: Annotated[
        float | None, typer.Option("--per-command", help="Nominal reading per command that is aimed at.")
    ] = None,
    resolution: Annotated[
        float, typer.Option("--resolution", min=0.0, help="Least command that the controller carries out.")
    ] = 0.0,
    in_force: Annotated[
        float | None, typer.Option("--in-force", help="Value of $100 or rotation_distance that is set now.")
    ] = None,
    letter: Annotated[str, typer.Option("--letter", help="Axis in settings of grbl: X, Y, Z, A, B or C.")] = "X",
    period: Annotated[
        float | None,
        typer.Option("--period", help="Of a table by phase: pec, csv or header, in commands (pec: strongest wave)."),
    ] = None,
    force: Force = False,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Correction table of a controller, with a bound on its errors.

    Nothing is applied. With -o that bound, the promise, is kept in results/compensation.json, for `verify`. Of a
    scanner `--to header` gives its calibration for a microcontroller. Of a pan-tilt head `--to urdf` gives its model:
    zeros, axes and reductions of the joints, and YAML with their covariance.
    """
    from tvsbayes.compensation.formats import Wish, checked
    from tvsbayes.compensation.promise import compensation_of, file_beside, file_text
    from tvsbayes.compensation.verification import compensation_in, table_in
    from tvsbayes.report.compensation_text import compensation_text
    from tvsbayes.results.compensation_record import COMPENSATION_FORMAT
    from tvsbayes.results.fit_record import provenance
    from tvsbayes.results.records import plain
    from tvsbayes.single_axis.axis_campaign import axis_hashes, read_axis
    from tvsbayes.single_axis.axis_record import results_for

    if (mechanism := _two_axis_mechanism(campaign)) is not None:
        # Counters of two axes follow from the whole calibration, which is the table.
        default = "urdf" if mechanism.terms else "header"
        if to != default:
            kind = "a pan-tilt head" if mechanism.terms else "a scanner"
            message = f"compensate --to {escaped(to)} is for an axis, and {escaped(str(campaign), 200)} is {kind}"
            counters = "; `tvsbayes steps-for` gives the counters of a direction" if mechanism.terms else ""
            remedy = f"its compensation is `tvsbayes compensate CAMPAIGN --to {default}`{counters}"
            raise InputError("usage", message, remedy=remedy)
        if mechanism.terms:
            from tvsbayes.cli.head_commands import compensate as compensate_head

            compensate_head(campaign, out, force, seed, as_json)
        else:
            check_output(out, kind=EXPORTS[to], force=force)
            export_calibration(campaign, to, out, as_json, promised=True, seed=seed)
        return
    _check_choice("--applied-by", applied_by, APPLIERS)
    _check_choice("--letter", letter, tuple(LETTERS))
    wish = Wish(to, "host" if applied_by == "host" else "controller", per_command, resolution, in_force, letter, period)
    form = checked(wish)
    second = out.with_name(f"{out.name}.yaml") if out is not None and form.beside is not None else None
    check_output(out, kind="compensation", force=force)
    check_output(second, kind="compensation", force=force and second is not None)
    data = read_axis(campaign)
    before = compensation_in(data)
    replaced = table_in(data, out) if out is not None and out.is_file() else None
    with waiting() as progress, Job({FITTING: 1.0, MAKING: 1.0}, progress) as job:
        results = results_for(data, progress=job.part(FITTING), seed=seed, notify=report_line)
        compensation = compensation_of(results, wish, seed=seed, progress=job.part(MAKING))
    origin = plain(provenance(axis_hashes(data), seed, results.fit_id))
    document = {"format": COMPENSATION_FORMAT, **compensation.as_json(), **origin}
    content = file_text(compensation, data)
    contents = {to: (out, content), "yaml": (second, file_beside(compensation, data) or "")}
    record_path = output_place(campaign, "results") / "compensation.json"
    held = record_path.read_bytes() if out is not None and before is not None else b""
    files = write_kept(campaign, document, contents)
    if "compensation" in files:
        _name_other_promises(compensation, before, replaced, record_path.parent, held)
    text = compensation_text(compensation, list(files.values()))
    if out is None:
        text += f"\nnothing written: give -o FILE; it would hold:\n\n{content}".rstrip("\n")
    else:
        next_step = compensation.shown_by if compensation.in_motion else command_line("verify", campaign, "FRESH")
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


def export_calibration(
    campaign: Path, kind: str, out: Path | None, as_json: bool, *, promised: bool = False, seed: int = 0
) -> None:
    """Print the calibration for another language, or write it into a file; where `promised`, keep its promise."""
    from tvsbayes.calibration.c_header import calibration_header
    from tvsbayes.calibration.calibration_file import Origin, calibration_json
    from tvsbayes.instrument.campaign import read_campaign
    from tvsbayes.report.compensation_text import aimed_text, aimed_words

    data = read_campaign(campaign)
    with waiting() as progress:
        results = StoredOrFitted(data, report_line, progress)
        calibration, origin = results.calibration, Origin.of(data)
    promise, kept = promise_of(results, kind, seed) if kind == "header" else (None, {})
    document: dict[str, Any] = dict(calibration_json(calibration, origin))
    text = json.dumps(document, indent=1)
    if kind == "header":
        text = calibration_header(calibration, origin, "" if promise is None else aimed_words(promise))
        document = {"header": text}
    kept = kept if promised else {}
    if out is None:
        finish({**document, **kept}, text.rstrip("\n"), as_json)
        return
    said = aimed_text(promise) if promise is not None and promised else ""
    finish_promised(campaign, kept, {}, said, {kind: (out, f"{text.rstrip()}\n")}, as_json)


def _check_choice(option: str, given: str, allowed: tuple[str, ...]) -> None:
    """Refuse a word that is not allowed."""
    if given not in allowed:
        names = ", ".join(allowed)
        raise InputError("usage", f"{option} {escaped(given)}", allowed=names, remedy=f"name one of {names}")


def verify(
    campaign: CampaignFolder,
    fresh: Annotated[
        Path, typer.Argument(metavar="FRESH", help="Fresh readings or looks, with table or calibration in force.")
    ],
    distance_mm: Annotated[
        float | None, typer.Option("--distance-mm", min=1.0, help="Of a scanner: errors of points there, mm (1000).")
    ] = None,
    table_file: Annotated[
        Path | None, typer.Option("--table", help="Of an axis: file of the table in force (the last one made).")
    ] = None,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Test a table or calibration in force against its promise.

    KEPT, BROKEN or CANNOT TELL: exit 0, 1 or 3. Of an axis FRESH lists the commands that were asked for, before the
    correction; of a scanner or head the counters that steps-for or the header gave, and the looks there. The
    most probable of: applied, not applied, applied twice, wrong sign, another machine.
    """
    from tvsbayes.calibration.calibration_file import calibration_json, content_sha256
    from tvsbayes.comparison.verified_looks import accepted_calibration
    from tvsbayes.compensation.verification import compensation_of_file, stored_compensation
    from tvsbayes.instrument.campaign import read_campaign
    from tvsbayes.report.compensation_text import verification_text
    from tvsbayes.results.compensation_record import CANNOT_TELL, KEPT, VERIFICATION_FORMAT
    from tvsbayes.single_axis.axis_campaign import AxisCampaign, read_axis

    mechanism = _two_axis_mechanism(campaign)
    if mechanism is not _two_axis_mechanism(fresh):
        kind = "an axis" if mechanism is None else "a head" if mechanism.terms else "a scanner"
        message = f"{escaped(str(campaign), 200)} is of {kind}, {escaped(str(fresh), 200)} is not"
        raise InputError("usage", message, remedy="give fresh readings or looks of the same kind of machine")
    if distance_mm is not None and (mechanism is None or mechanism.sightings):
        message = "--distance-mm is not for an axis, nor for a head that says where it points"
        raise InputError("usage", message, remedy="leave it out")
    if table_file is not None and mechanism is not None:
        message = "--table is for an axis; a scanner or head is aimed with its calibration"
        raise InputError("usage", message, remedy="leave it out")
    known = read_axis(campaign) if mechanism is None else read_campaign(campaign)
    made = None
    if isinstance(known, AxisCampaign):
        made = stored_compensation(known) if table_file is None else compensation_of_file(known, table_file)
    with waiting() as progress:
        new, distance = fresh if made is None else read_axis(fresh), distance_mm or 1000.0
        result = verified(known, new, made=made, distance_mm=distance, seed=seed, tell=report_line, progress=progress)
    if made is not None:
        table = made.digest
    elif not isinstance(known, AxisCampaign):
        table = content_sha256(calibration_json(accepted_calibration(known)))
    document = {"format": VERIFICATION_FORMAT, "inputs": inputs_of(known), "table": table, **result.as_json()}
    keep(document, output_place(campaign, "results") / "verification.json")
    for remark in result.remarks if as_json else ():
        report_line(f"warning: {remark}")
    finish(result.as_json(), verification_text(result), as_json)
    if result.verdict != KEPT:
        raise Ended(NothingToEstimate.exit_code if result.verdict == CANNOT_TELL else TARGET_MISSED)


def plan_verify(folder: Path | None, *, out: Path | None, seed: int, as_json: bool) -> None:
    """`plan FOLDER --verify`: plan the fewest readings that verify a table."""
    from tvsbayes.compensation.verification import plan_verification, refuse_drive, stored_compensation
    from tvsbayes.report.compensation_text import verify_plan_text
    from tvsbayes.results.records import plain
    from tvsbayes.single_axis.axis_campaign import read_axis
    from tvsbayes.single_axis.axis_record import results_for

    if folder is None:
        remedy = "write tvsbayes plan FOLDER --verify -o plan.csv"
        raise InputError("usage", "--verify needs a folder with a table or a calibration in force", remedy=remedy)
    if _two_axis_mechanism(folder) is not None:
        _plan_looks(folder, out, as_json)
        return
    data = read_axis(folder)
    compensation = stored_compensation(data)
    refuse_drive(compensation)
    with waiting() as progress, Job({FITTING: 1.0, "choosing stops": 1.0}, progress) as job:
        results = results_for(data, progress=job.part(FITTING), seed=seed, notify=report_line)
        job.begin("choosing stops")
        stops = plan_verification(results.fit, compensation, seed=seed)
    document, text = plain(stops), verify_plan_text(stops)
    if out is not None:
        write_atomically(out, stops.plan_bytes())
        document["plan"] = str(out)
        text += f"\nwritten: {escaped(str(out), 200)}"
    finish({**document, "seed": seed}, text, as_json)


def _plan_looks(folder: Path, out: Path | None, as_json: bool) -> None:
    """Plan the fewest looks that verify a scanner or head, at the target with most looks in the campaign."""
    from tvsbayes.comparison.verified_looks import accepted_calibration, plan_looks
    from tvsbayes.instrument.campaign import read_campaign
    from tvsbayes.instrument.plan import write_plan
    from tvsbayes.report.compensation_text import aim_plan_text
    from tvsbayes.results.records import plain

    data = read_campaign(folder)
    looks = plan_looks(data, accepted_calibration(data))
    document, text = plain(looks), aim_plan_text(looks)
    if out is not None:
        target = Counter(spot.target for spot in data.spots).most_common(1)[0][0]
        write_plan(looks.steps(target), out, data.rig.mechanism)
        document["plan"] = str(out)
        text += f"\nwritten: {escaped(str(out), 200)}"
    finish(document, text, as_json)
