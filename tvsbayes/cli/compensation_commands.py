"""compensate and verify: a table for a controller with its promise, and the test of this promise."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, Option

from tvsbayes.cli.app import (
    TARGET_MISSED,
    CampaignFolder,
    Ended,
    Force,
    Json,
    Seed,
    check_output,
    finish,
    keep,
    report_line,
)
from tvsbayes.cli.outcomes import finish_plan, finish_promised, promise_of
from tvsbayes.cli.progress_bar import waiting
from tvsbayes.errors import InputError, NothingToEstimate, escaped
from tvsbayes.files.disk import output_place
from tvsbayes.instrument.mechanisms import MECHANISMS
from tvsbayes.pipeline import StoredOrFitted, inputs_of
from tvsbayes.pipeline import verify as verified

if TYPE_CHECKING:
    from tvsbayes.compensation.formats import AppliedBy
    from tvsbayes.instrument.mechanisms import Mechanism

EXPORTS = {"header": "calibration in C", "json": "calibration"}
"""Kinds of file of an exported calibration, by the option's word."""
LETTERS, APPLIERS = "XYZABC", ("controller", "host")


def _two_axis_mechanism(folder: Path) -> Mechanism | None:
    """The mechanism of a scanner or a head; None for an axis, and where no header can be read."""
    from tvsbayes.instrument.campaign_header import mechanism_key

    return MECHANISMS.get(mechanism_key(folder))


def compensate(
    campaign: CampaignFolder,
    to: Annotated[str, Option(help="csv, linuxcnc, grbl, grblhal, klipper, header (C), urdf (xacro) or pec.")],
    out: Annotated[Path | None, Option("-o", "--out", help="Write the file here, and keep the promise.")] = None,
    applied_by: Annotated[str, Option(help="Who adds it: controller or host.")] = "controller",
    per_command: Annotated[float | None, Option(help="Nominal reading per command that is aimed at.")] = None,
    resolution: Annotated[float, Option(min=0.0, help="Least command that the controller carries out.")] = 0.0,
    in_force: Annotated[float | None, Option(help="Value of $100 or rotation_distance that is set now.")] = None,
    letter: Annotated[str, Option(help="Axis in settings of grbl: X, Y, Z, A, B or C.")] = "X",
    period: Annotated[
        float | None, Option(help="Of a table by phase: pec, csv or header, in commands (pec: strongest wave).")
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
    if (mechanism := _two_axis_mechanism(campaign)) is not None:
        # Counters of two axes follow from the whole calibration, which is the table.
        default = "urdf" if mechanism.all_round else "header"
        if to != default:
            kind = "a pan-tilt head" if mechanism.all_round else "a scanner"
            message = f"compensate --to {escaped(to)} is for an axis, and {escaped(str(campaign), 200)} is {kind}"
            counters = "; `tvsbayes steps-for` gives the counters of a direction" if mechanism.all_round else ""
            remedy = f"its compensation is `tvsbayes compensate CAMPAIGN --to {default}`{counters}"
            raise InputError("usage", message, remedy=remedy)
        if mechanism.all_round:
            from tvsbayes.cli.head_commands import compensate as compensate_head

            compensate_head(campaign, out, force, seed, as_json)
        else:
            check_output(out, kind=EXPORTS[to], force=force)
            export_calibration(campaign, to, out, as_json, promised=True, seed=seed)
        return
    _check_choice("--applied-by", applied_by, APPLIERS)
    _check_choice("--letter", letter, tuple(LETTERS))
    from tvsbayes.cli.axis_commands import make_table
    from tvsbayes.compensation.formats import Wish

    applier: AppliedBy = "host" if applied_by == "host" else "controller"
    make_table(
        campaign, Wish(to, applier, per_command, resolution, in_force, letter, period), out, force, seed, as_json
    )


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
        Path, Argument(metavar="FRESH", help="Fresh readings or looks, with table or calibration in force.")
    ],
    distance_mm: Annotated[
        float | None, Option(min=1.0, help="Of a scanner: errors of points there, mm (1000).")
    ] = None,
    table_file: Annotated[
        Path | None, Option("--table", help="Of an axis: file of the table in force (the last one made).")
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
    from tvsbayes.compensation.verification import stored_compensation
    from tvsbayes.instrument.campaign import read_campaign
    from tvsbayes.report.compensation_text import verification_text
    from tvsbayes.results.compensation_record import CANNOT_TELL, KEPT, VERIFICATION_FORMAT
    from tvsbayes.single_axis.axis_campaign import AxisCampaign, read_axis

    mechanism = _two_axis_mechanism(campaign)
    if mechanism is not _two_axis_mechanism(fresh):
        kind = "an axis" if mechanism is None else "a head" if mechanism.all_round else "a scanner"
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
        made = stored_compensation(known, table_file)
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
    """`plan FOLDER --verify`: the fewest readings that verify a table, or looks that verify a scanner or head.

    Looks are at the target with most looks in the campaign.
    """
    from tvsbayes.comparison.verified_looks import accepted_calibration, plan_looks
    from tvsbayes.instrument.campaign import read_campaign
    from tvsbayes.instrument.plan import write_plan
    from tvsbayes.report.compensation_text import aim_plan_text
    from tvsbayes.results.records import plain

    if folder is None:
        remedy = "write tvsbayes plan FOLDER --verify -o plan.csv"
        raise InputError("usage", "--verify needs a folder with a table or a calibration in force", remedy=remedy)
    if _two_axis_mechanism(folder) is None:
        from tvsbayes.cli.axis_commands import plan_verify as plan_axis

        plan_axis(folder, out, seed, as_json)
        return
    data = read_campaign(folder)
    looks = plan_looks(data, accepted_calibration(data))

    def write(path: Path) -> None:
        target = Counter(spot.target for spot in data.spots).most_common(1)[0][0]
        write_plan(looks.steps(target), path, data.rig.mechanism)

    finish_plan(plain(looks), aim_plan_text(looks), out, write, as_json)
