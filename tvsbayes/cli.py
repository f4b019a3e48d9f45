"""The command line: reads options, calls the library, prints tables or one JSON document (DESIGN 8).

Heavy modules are imported inside the commands that need them; `tvsbayes --help` loads none of them. Exit codes:
0 done, 1 done but a limit or target is not met, 2 bad input, 3 nothing to estimate, 4 not converged, 5 device fault,
130 interrupted.
"""

from __future__ import annotations

import datetime
import json
import math
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tvsbayes.files import (
    CSV_BYTES_MAX,
    InputError,
    NotConverged,
    NothingToEstimate,
    TvsError,
    escaped,
    make_folder,
    output_place,
    parse_table,
    read_bytes,
    refusal,
    shipped_data,
    write_atomically,
)

if TYPE_CHECKING:
    import numpy as np

    from tvsbayes.calibration import Calibration
    from tvsbayes.campaign import Campaign
    from tvsbayes.information import FitSummary
    from tvsbayes.joint import JointFit
    from tvsbayes.posterior import Posterior, Progress

INTERRUPTED = 130
TARGET_MISSED = 1
"""Done, but a limit or target that the user gave is not met."""
DCC_MESSAGES = 20
"""Of a schema validator, shown at most."""
RESIDUALS_LISTED = 4096
"""Stops in `fit.json`, evenly chosen: a long campaign's file stays readable within its cap."""
FITTING_FIRST = (
    "results/ are missing, older than the campaign, or of a fit that did not converge: fitting first "
    "(Laplace approximation) ..."
)
DEMO_NOTE = "The twin's move history is our assumption, made so that the classic answer is the paper's Table 1."

app = typer.Typer(
    name="tvsbayes",
    help="What one motor step of a geared laser positioner does to the beam, and how sure that is.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        _print(f"tvsbayes {version('tvsbayes')}")
        raise typer.Exit


@app.callback()
def _options(
    _version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    pass


Json = Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout.")]
Seed = Annotated[int, typer.Option("--seed", min=0, help="Seed of everything random.")]
CampaignFolder = Annotated[Path, typer.Argument(metavar="CAMPAIGN", help="Campaign folder.")]


class _Ended(Exception):
    """Ends a command whose document is out with an exit code other than 0."""

    def __init__(self, exit_code: int):
        super().__init__(exit_code)
        self.exit_code = exit_code


def report_line(text: str) -> None:
    """A line for people, on stderr; text from files may hold control characters."""
    try:
        typer.echo("".join(c if c.isprintable() else "?" for c in text), err=True)
    except OSError:
        # Ctrl-C ends the `tee` behind us too: nobody is left to be told, and the work goes on.
        pass


def _use_compilation_cache() -> None:
    """`model.use_compilation_cache`, and a word to whoever waits for the first compilation."""
    from tvsbayes.model import use_compilation_cache

    if use_compilation_cache() and sys.stderr.isatty():
        report_line("first run: the model is compiled, half a minute to two minutes; later runs take it from the cache")


class _OutputFailed(Exception):
    """Standard output took no more, as on a full disk."""


def _print(text: str) -> None:
    try:
        typer.echo(text)
    except OSError as error:
        # What is still in its buffer must not fail again while Python ends.
        sys.stdout = open(os.devnull, "w", encoding="utf-8")
        if isinstance(error, BrokenPipeError):
            # Whoever read has gone, like `head`; the work is done, and its exit code stands.
            return
        raise _OutputFailed(error.strerror or str(error)) from error


def print_json(document: dict[str, Any]) -> None:
    """The one document on stdout; NaN is a bug, not a value."""
    _print(json.dumps(document, indent=1, allow_nan=False, ensure_ascii=True))


def _error_document(error: TvsError) -> dict[str, Any]:
    fields = {"code": error.code, "file": error.file, "line": error.line, "column": error.column}
    fields |= {"message": error.message, "found": error.found, "allowed": error.allowed, "remedy": error.remedy}
    return {"error": fields}


def _report_error(error: TvsError) -> None:
    report_line(f"error: {error.message}")
    if error.remedy and error.remedy not in error.message:
        report_line(f"what to do: {error.remedy}")


def _finish(document: dict[str, Any], text: str, as_json: bool, error: TvsError | None = None) -> None:
    """Print a result in the wanted form; one that must not be used carries its error and its exit code."""
    if as_json:
        print_json(document if error is None else {**document, **_error_document(error)})
    else:
        _print(text)
    if error is not None:
        if not as_json:
            _report_error(error)
        raise _Ended(error.exit_code)


def _unusable(summary: FitSummary) -> TvsError | None:
    """Why a fit that ran to its end must not be used: not converged (4) or nothing learned (3)."""
    if not summary.converged and summary.sampling is not None and not summary.sampling["converged"]:
        return NotConverged(
            "unconverged",
            "UNCONVERGED: " + "; ".join(summary.sampling["missing"]) + ". The table is the Laplace approximation",
            remedy="run again with --resume and more --max-minutes",
        )
    if not summary.converged:
        return NotConverged(
            "not-converged",
            "NOT CONVERGED: " + "; ".join(summary.problems),
            remedy="check for swapped cameras or wrong counters, or state the extrinsics better in [rig.prior]",
        )
    if not summary.headline_informed:
        return NothingToEstimate(
            "uninformed",
            "the spots tell no more about any effective ratio than the priors do (contraction below 0.1 everywhere)",
            remedy="observe stops before and after moves of both axes",
        )
    return None


@app.command()
def demo(
    out: Annotated[Path | None, typer.Argument(metavar="OUT", help="Folder to keep the campaign in.")] = None,
    as_json: Json = False,
) -> None:
    """Both estimators on the shipped paper twin, beside its truth."""
    import tempfile

    source = shipped_data() / "twins" / "paper_twin"
    with tempfile.TemporaryDirectory(prefix="tvsbayes-demo-") as scratch:
        folder = Path(scratch) / "paper_twin" if out is None else out
        make_folder(folder, empty=True)
        for part in sorted(source.iterdir()):
            write_atomically(folder / part.name, part.read_bytes())
        report_line("paper twin: 96 four-point experiments of a simulated rig with known truth; fitting ...")
        from tvsbayes.campaign import read_campaign
        from tvsbayes.classic import classic as estimate_classic
        from tvsbayes.information import calibration_of, summarise
        from tvsbayes.joint import fit as fit_joint
        from tvsbayes.report import demo_text, write_results
        from tvsbayes.simulation import effective_deg_per_step, effective_mirror_offset_mm, read_truth

        _use_compilation_cache()
        campaign = read_campaign(folder)
        true = read_truth(folder / "truth.json", campaign.stereo).parameters
        classic_result = estimate_classic(campaign)
        result = fit_joint(campaign)
        summary = summarise(result)
        if out is not None:
            calibration = calibration_of(result) if result.converged else None
            write_results(result, summary, folder / "results", 0, calibration)
    pose = (summary.reference_pose_deg["pan"], summary.reference_pose_deg["tilt"])
    truth = {
        **effective_deg_per_step(true, pose),
        "backlash_deg.pan": true["backlash_deg.pan"],
        "backlash_deg.tilt": true["backlash_deg.tilt"],
        "effective_mirror_offset_mm": effective_mirror_offset_mm(true, pose),
    }
    document = {"classic": classic_result.as_json(), "fit": summary.as_json(), "truth": truth}
    _finish(document, f"{demo_text(classic_result, summary, truth)}\n\n{DEMO_NOTE}", as_json, _unusable(summary))


@app.command()
def new(out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder to create.")], as_json: Json = False) -> None:
    """An empty campaign, explained in campaign.toml, and a rig file. Fill them, or plan and simulate with the rig."""
    make_folder(out, empty=True)
    templates = sorted((shipped_data() / "templates").iterdir())
    for template in templates:
        write_atomically(out / template.name, template.read_bytes())
    names = [template.name for template in templates]
    text = f"{escaped(str(out), 200)}: {', '.join(names)}\n"
    text += "next: put stereo.json beside them, log moves and spots, then `tvsbayes check` this folder"
    _finish({"campaign": str(out), "files": names}, text, as_json)


@app.command()
def simulate(
    rig: Annotated[Path, typer.Argument(metavar="RIG", help="Rig file.")],
    plan: Annotated[Path, typer.Argument(metavar="PLAN", help="plan.csv.")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Campaign folder to write.")],
    aperture: Annotated[bool, typer.Option("--aperture/--no-aperture", help="Looks also read the aperture.")] = False,
    frames: Annotated[
        bool,
        typer.Option("--frames", help="Pictures for `detect` and `stereo`, no centroids."),
    ] = False,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """The digital twin runs a plan on a true rig that it draws. Writes the campaign and truth.json."""
    from tvsbayes.campaign import read_plan
    from tvsbayes.rigs import read_rig
    from tvsbayes.simulation import simulate as run_plan

    result = run_plan(read_rig(rig), read_plan(plan), seed, aperture=aperture)
    moves, spots = len(result.campaign.moves), result.campaign.spots
    seen = sum(spot.status == "ok" for spot in spots)
    document = {"campaign": str(out), "moves": moves, "spots": len(spots), "ok": seen, "seed": seed}
    text = f"{escaped(str(out), 200)}: {moves} moves, {seen} of {len(spots)} spots seen; the truth is in truth.json"
    if frames:
        from tvsbayes.device.renderer import write_frames

        result = result.undetected()
        result.write(out)
        with _counting("rendering") as show:
            pictures = write_frames(out, result, seed, done=show)
        document |= {"ok": 0, "in_view": seen, "pictures": pictures}
        text += f"\n{pictures} pictures in frames/ and boards/; spots.csv waits for `tvsbayes detect`"
    else:
        result.write(out)
    _finish(document, text, as_json)


@app.command()
def detect(
    campaign: CampaignFolder,
    method: Annotated[str, typer.Option("--method", help="fit, or contour (the paper's).")] = "fit",
    speckle_contrast: Annotated[
        float | None,
        typer.Option("--speckle-contrast", min=0.0, max=2.0, help="Per pixel (default: learned; contour: 0.4)."),
    ] = None,
    overlay: Annotated[bool, typer.Option("--overlay", help="Pictures of every spot in results/overlay.")] = False,
    as_json: Json = False,
) -> None:
    """Find the laser spots in a campaign's frames. Writes centres and uncertainties into spots.csv, in place."""
    _finite(speckle_contrast=speckle_contrast)
    from tvsbayes.campaign import read_campaign, spots_bytes
    from tvsbayes.device.spots import detect as find
    from tvsbayes.report import detection_text

    pictures = output_place(campaign, "results", "overlay") if overlay else None
    data = read_campaign(campaign)
    with _counting("detecting") as show:
        found = find(data, method, speckle_contrast=speckle_contrast, overlay=pictures, done=show)
    write_atomically(campaign / "spots.csv", spots_bytes(found.campaign.spots))
    document = {"campaign": str(campaign), **found.as_json()}
    text = detection_text(found) + f"\nwritten: {escaped(str(campaign / 'spots.csv'), 200)}"
    if overlay:
        document["overlay"] = str(pictures)
        text += f", {escaped(str(pictures), 200)}"
    _finish(document, text, as_json)


IMAGE_SIDE_MAX = 65_535


@app.command()
def stereo(
    folder: Annotated[Path | None, typer.Argument(metavar="FOLDER", help="Folder of checkerboard pictures.")] = None,
    board: Annotated[str | None, typer.Option("--board", help="Inner corners, columns x rows: 9x6.")] = None,
    pitch_mm: Annotated[float | None, typer.Option("--pitch-mm", help="Side of a square.")] = None,
    pitch_u_mm: Annotated[float, typer.Option("--pitch-u-mm", help="Its standard uncertainty (mean of all).")] = 0.0,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="stereo.json to write.")] = None,
    imports: Annotated[
        list[Path] | None,
        typer.Option(
            "--import", help="File of OpenCV, ROS or Kalibr, or stereo.json, instead of pictures; repeatable."
        ),
    ] = None,
    export: Annotated[str | None, typer.Option("--export", help="opencv or ros: also for these, beside -o.")] = None,
    finder: Annotated[str, typer.Option("--finder", help="classic or sector; the other is the fallback.")] = "classic",
    swap: Annotated[
        bool, typer.Option("--swap", help="Wide frames hold the left camera's image on the right.")
    ] = False,
    fix_k3: Annotated[bool, typer.Option("--fix-k3", help="Keep k3 at 0.")] = False,
    robust: Annotated[bool, typer.Option("--robust", help="Leave out outlying views, by name.")] = False,
    image_size: Annotated[str | None, typer.Option("--image-size", help="1280x720, where imports lack it.")] = None,
    import_unit: Annotated[str, typer.Option("--import-unit", help="mm or m: unit of an imported OpenCV T.")] = "mm",
    as_json: Json = False,
) -> None:
    """Calibrate the camera pair from checkerboard pictures. With the covariance of all 24 parameters; or import one."""
    if export not in (None, "opencv", "ros") or finder not in ("classic", "sector") or import_unit not in ("mm", "m"):
        remedy = "--export opencv or ros, --finder classic or sector, --import-unit mm or m"
        raise InputError("usage", "an option has a value that it does not know", remedy=remedy)
    if (folder is None) == (not imports):
        found = "stereo needs pictures of a board, or a calibration to import"
        found = found if folder is None else "stereo takes pictures or a calibration to import, not both"
        raise InputError("usage", found, remedy="give FOLDER with --board and --pitch-mm, or --import FILE")
    lacking = {"--board": board is None, "--pitch-mm": pitch_mm is None}
    missing = " and ".join(name for name, absent in lacking.items() if absent)
    if folder is not None and missing:
        remedy = f"give {missing}: inner corners, columns x rows, and the side of a square: --board 9x6 --pitch-mm 25"
        raise InputError("usage", f"stereo FOLDER needs {missing}", remedy=remedy)
    _finite(pitch_mm=pitch_mm, pitch_u_mm=pitch_u_mm)
    from tvsbayes.device.interchange import EXPORT_NAMES, exported, read_calibration
    from tvsbayes.report import stereo_calibration_text, stereo_text
    from tvsbayes.rigs import STEREO_PARAMETER_NAMES, stereo_bytes

    beside = Path() if out is None else out.parent
    for path in [*([] if out is None else [out]), *(beside / name for name in EXPORT_NAMES.get(export or "", ()))]:
        if os.path.lexists(path):
            # Asked before the pictures are read, which takes minutes. Fits stand on a calibration by its hash.
            remedy = "name another file, or move this one away; nothing is overwritten"
            place = escaped(str(path), 200)
            raise refusal("occupied", file=place, found="a file that is there", allowed="a new file", remedy=remedy)
    if imports:
        unit_mm = {"mm": 1.0, "m": 1000.0}[import_unit]
        found = read_calibration(imports, _image_size(image_size), unit_mm=unit_mm)
        remarks = [*(f"note: {note}" for note in found.notes), *(f"warning: {warning}" for warning in found.warnings)]
        pair, text = found.stereo, "\n".join([stereo_text(found.stereo), *remarks])
        sds = [float(variance) ** 0.5 for variance in pair.parameter_covariance.diagonal()]
        values = zip(STEREO_PARAMETER_NAMES, pair.vector.tolist(), sds, strict=True)
        document: dict[str, Any] = {
            **{"source": found.source, "image_width": pair.image_width, "image_height": pair.image_height},
            "parameters": {name: {"value": value, "sd": sd} for name, value, sd in values},
            **{"rms_px": pair.rms_px, "assumed": pair.assumed, "warnings": [*found.notes, *found.warnings]},
        }
    else:
        from tvsbayes.device.boards import Board
        from tvsbayes.device.stereo import calibrate_folder

        _use_compilation_cache()
        pattern = Board.named(board, pitch_mm, pitch_u_mm)
        result = calibrate_folder(folder, pattern, finder=finder, swap=swap, fix_k3=fix_k3, robust=robust)
        pair, text = result.stereo, stereo_calibration_text(result)
        document = {"source": "pictures", **result.as_json()}
    files = {} if out is None else {"stereo": (out, stereo_bytes(pair))}
    if export:
        files |= {name: (beside / name, data) for name, data in exported(pair, export).items()}
    for path, data in files.values():
        write_atomically(path, data)
    written = {name: str(path) for name, (path, _) in files.items()}
    text += f"\nwritten: {', '.join(written.values())}" if written else "\nnothing written: give -o stereo.json"
    _finish({**document, "files": written}, text, as_json)


def _image_size(text: str | None) -> tuple[int, int] | None:
    """Width and height from text such as 1280x720."""
    if text is None:
        return None
    width, _, height = text.lower().partition("x")
    sizes = [int(part) if part.isascii() and part.isdecimal() and len(part) < 6 else 0 for part in (width, height)]
    if not all(0 < size <= IMAGE_SIDE_MAX for size in sizes):
        raise InputError("usage", f"--image-size {escaped(text)}", allowed="WIDTHxHEIGHT", remedy="write 1280x720")
    return sizes[0], sizes[1]


@app.command()
def check(
    path: Annotated[Path, typer.Argument(metavar="PATH", help="Campaign folder, rig file or plan.")],
    plan_file: Annotated[
        Path | None, typer.Argument(metavar="PLAN", help="With a rig file: what can this plan not separate?")
    ] = None,
    repair_to: Annotated[
        Path | None, typer.Option("--repair-to", help="New folder for what is whole of a damaged journal.")
    ] = None,
    as_json: Json = False,
) -> None:
    """What a campaign, rig, plan or journal holds and cannot tell. Reads strictly, changes nothing."""
    from tvsbayes.campaign import read_campaign, read_plan
    from tvsbayes.classic import check_campaign
    from tvsbayes.rigs import read_rig

    if repair_to is not None:
        from tvsbayes.device.session import repair_campaign

        document = repair_campaign(path, repair_to)
        lines = [f"{key}: {value}" for key, value in document.items()]
        _finish(document, "\n".join([*lines, f"{escaped(str(repair_to), 200)}: written"]), as_json)
        return
    if plan_file is not None and path.suffix != ".toml":
        remedy = "give the rig file first, then the plan"
        raise InputError("usage", "a plan is checked together with a rig file", allowed="RIG PLAN", remedy=remedy)
    if plan_file is not None:
        rig, steps = read_rig(path), read_plan(plan_file)
        from tvsbayes.planning import check_plan

        _use_compilation_cache()
        document: dict[str, Any] = check_plan(rig, steps).as_json()
    elif path.suffix == ".csv" and not path.is_dir():
        steps = read_plan(path)
        actions = {action: sum(s.action == action for s in steps) for action in ("home", "place", "move", "look")}
        document = {"kind": "plan", "steps": len(steps), **actions, "warnings": []}
    elif path.suffix == ".toml" and not path.is_dir():
        rig = read_rig(path)
        document = {"kind": "rig", "sheets_mm": rig.sheets_mm, "costs_s": rig.costs_s, "warnings": []}
    else:
        journal = None
        if (path / "log.jsonl").is_file():
            from tvsbayes.device.session import check_journal

            journal = check_journal(path)
        if journal is not None and not journal["moves"]:
            document = {"kind": "journal", **journal}
        else:
            document = check_campaign(read_campaign(path)).as_json()
            if journal is not None:
                document["warnings"] = [*journal.pop("warnings"), *document["warnings"]]
                document["journal"] = journal
    warnings = document["warnings"]
    lines = [f"{key}: {value}" for key, value in document.items() if key not in ("warnings", "faults")]
    lines += [f"warning: {warning}" for warning in warnings]
    lines.append(f"{escaped(str(path), 200)}: readable, {len(warnings)} warning{'s' * (len(warnings) != 1)}")
    _finish(document, "\n".join(lines), as_json)


@app.command()
def acquire(
    rig: Annotated[Path, typer.Argument(metavar="RIG", help="Rig file.")],
    plan: Annotated[Path, typer.Argument(metavar="PLAN", help="plan.csv.")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Campaign folder to write.")],
    simulate: Annotated[bool, typer.Option("--simulate", help="The digital twin instead of hardware.")] = False,
    centroids: Annotated[
        bool, typer.Option("--centroids", help="With --simulate: the twin states centroids, no pictures are made.")
    ] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with an interrupted run.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="List what would happen; nothing moves.")] = False,
    laser_class: Annotated[
        str | None, typer.Option("--laser-class", help="Class on the laser's label: states the hazard is known.")
    ] = None,
    target_u: Annotated[
        float | None,
        typer.Option("--target-u", min=0.0, help="Stop when every effective ratio is known to this u, deg/step."),
    ] = None,
    estimate: Annotated[
        bool | None,
        typer.Option(
            "--estimate/--no-estimate",
            help="Fit the looks so far beside the run (default: on hardware only; a simulation waits for each fit).",
        ),
    ] = None,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Drive positioner and cameras through a plan into a campaign. Nothing is lost, whatever ends it.

    LASER: 808 nm is invisible and likely class 3B. Goggles on, beam path shut in.
    """
    from tvsbayes.campaign import read_plan
    from tvsbayes.rigs import read_rig

    instrument, steps = read_rig(rig), read_plan(plan)
    from tvsbayes.device.acquisition import check_plan, outline
    from tvsbayes.device.session import LiveLine
    from tvsbayes.device.session import acquire as run_plan
    from tvsbayes.simulation import plan_seconds

    if dry_run:
        check_plan(instrument, steps)
        lines, minutes = outline(instrument, steps), plan_seconds(instrument, steps) / 60
        document: dict[str, Any] = {"steps": lines, "minutes": minutes}
        _finish(document, "\n".join([*lines, f"{len(lines)} steps, about {minutes:.0f} min"]), as_json)
        return
    with LiveLine() as line:
        options: dict[str, Any] = {"simulate": simulate, "resume": resume, "laser_class": laser_class, "seed": seed}
        options |= {"target_u_deg_per_step": target_u, "estimate": estimate}
        if not centroids:
            from tvsbayes.device.vision import live_detector, twin_renderer

            options["detector"] = live_detector(instrument.stereo)
            options["renderer"] = twin_renderer(instrument, seed) if simulate else None
        outcome = run_plan(instrument, steps, out, **options, say=report_line, show=line.show, ask=line.ask)
    document = {"campaign": str(out), **outcome.as_json()}
    text = f"{escaped(str(out), 200)}: {outcome.reason}, {outcome.ok} of {outcome.looks} looks count"
    if outcome.references:
        planned = outcome.looks - outcome.references
        text += f" ({planned} of the plan, {outcome.references} reference looks of resumed runs)"
    _finish(document, "\n".join([text, *(f"warning: {warning}" for warning in outcome.warnings)]), as_json)
    if outcome.reason in ("interrupted", "declined"):
        report_line(f"{outcome.reason}; go on with --resume")
        raise _Ended(INTERRUPTED)
    if target_u is not None and outcome.reason != "target met":
        report_line("the plan is done and the target is not met: plan more with tvsbayes plan --given")
        raise _Ended(1)


@app.command()
def doctor(
    rig: Annotated[Path, typer.Argument(metavar="RIG", help="Rig file.")],
    laser: Annotated[
        bool, typer.Option("--laser", help="LASER ON for one picture, invisible and likely class 3B: goggles on.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Is the instrument fit for a campaign? Nothing moves.

    Checks ports, firmware, cameras, exposure, focus, laser, timing and disk.
    """
    from tvsbayes.device.doctor import examine
    from tvsbayes.files import DeviceFault
    from tvsbayes.rigs import read_rig

    checks = examine(read_rig(rig), Path.cwd(), laser=laser)
    lines = [f"{c.status:8} {c.name}: {c.found}" + (f"; {c.remedy}" if c.remedy else "") for c in checks]
    faults = [c for c in checks if c.status == "fault"]
    error = None
    if faults:
        message = f"{len(faults)} fault{'s' * (len(faults) > 1)}: {', '.join(c.name for c in faults)}"
        error = DeviceFault("doctor", message, remedy=faults[0].remedy)
    _finish({"checks": [c.as_json() for c in checks]}, "\n".join(lines), as_json, error)


def _warn_of(campaign: Campaign) -> None:
    """What `check` says of data that no rig can have measured, for whoever did not ask it first."""
    from tvsbayes.classic import implausible

    for sentence in implausible(campaign):
        report_line(f"warning: {sentence}")


@app.command()
def classic(campaign: CampaignFolder, as_json: Json = False) -> None:
    """The paper's four-point estimator. Mean, sd, type A and GUM uncertainty per direction."""
    from tvsbayes.campaign import read_campaign
    from tvsbayes.classic import classic as estimate
    from tvsbayes.report import classic_text

    data = read_campaign(campaign)
    _warn_of(data)
    result = estimate(data)
    skipped = [f"experiment {s.experiment} skipped: {s.reason}" for s in result.skipped]
    _finish(result.as_json(), "\n".join([classic_text(result), *skipped]), as_json)


@app.command()
def fit(
    campaign: CampaignFolder,
    no_sample: Annotated[bool, typer.Option("--no-sample", help="Laplace approximation only.")] = False,
    max_minutes: Annotated[
        float, typer.Option("--max-minutes", min=0.01, help="Time for sampling; unconverged by then: exit 4.")
    ] = 10.0,
    resume: Annotated[bool, typer.Option("--resume", help="Continue the chain of an earlier run.")] = False,
    robust: Annotated[bool, typer.Option("--robust", help="Downweight and exclude outlying spots, by name.")] = False,
    per_axis: Annotated[bool, typer.Option("--per-axis", help="One ratio per axis: contrasts fixed at 0.")] = False,
    harmonics: Annotated[bool, typer.Option("--harmonics", help="Free transmission errors of known period.")] = False,
    no_backlash: Annotated[bool, typer.Option("--no-backlash", help="No play: backlash fixed at 0.")] = False,
    out: Annotated[Path | None, typer.Option("--out", help="Folder for results (default CAMPAIGN/results).")] = None,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Fit the joint model to every spot and sample its posterior. Ratios, backlash, mirror offset, extrinsics."""
    from tvsbayes.campaign import read_campaign

    if resume and no_sample:
        raise InputError("usage", "--resume continues a chain and --no-sample makes none", remedy="give one of them")
    data = read_campaign(campaign)
    _warn_of(data)
    from tvsbayes.information import DRAWS_KEPT, calibration_of, summarise
    from tvsbayes.joint import fit as fit_joint
    from tvsbayes.report import fit_text, write_results

    _use_compilation_cache()
    folder = out or output_place(campaign, "results")
    model = {"per_axis": per_axis, "harmonics": harmonics, "no_backlash": no_backlash}
    result = fit_joint(data, robust=robust, **model, seed=seed)
    summary, posterior, more = summarise(result), None, {}
    # A sample of what must not be used anyway would only take the user's time.
    if not no_sample and _unusable(summary) is None:
        from tvsbayes.posterior import sample, write_posterior

        make_folder(folder)
        with _sampling_progress() as progress:
            posterior = sample(
                result,
                max_minutes=max_minutes,
                seed=seed,
                checkpoint=folder / "chain.npz",
                resume=resume,
                progress=progress,
            )
        summary = summarise(result, posterior)
        if posterior.converged:
            report_line("computing log likelihoods and predictions for posterior.nc ...")
            write_posterior(posterior, folder / "posterior.nc")
            more = {"posterior": str(folder / "posterior.nc")}
        more["chain"] = str(folder / "chain.npz")
    stale = folder / "posterior.nc"
    if "posterior" not in more and stale.exists():
        stale.unlink()
        report_line("posterior.nc of an earlier fit is removed: it would not be that of fit.json")
    calibration = calibration_of(result, posterior, seed=seed) if result.converged else None
    draws = posterior.thinned(DRAWS_KEPT) if summary.estimator == "posterior" else None
    usable = posterior if summary.estimator == "posterior" else None
    physical = (result.draws if draws is None else draws).physical
    files = {
        **write_results(
            result, summary, folder, seed, calibration, draws, _evidence(result, summary, usable, calibration, physical)
        ),
        **more,
    }
    document = {**summary.as_json(), "seed": seed, "files": files}
    _finish(document, f"{fit_text(summary)}\nwritten: {', '.join(files.values())}", as_json, _unusable(summary))


def _evidence(
    fit: JointFit,
    summary: FitSummary,
    posterior: Posterior | None,
    calibration: Calibration | None,
    physical: np.ndarray,
) -> dict[str, object]:
    """What `fit.json` holds for reports besides the estimates; without a calibration residuals alone.

    `physical` are the draws, in the units of the names, that the calibration's inputs were taken from, row by row.
    """
    from tvsbayes.certificate import headline_budget, positioning, stop_readings
    from tvsbayes.comparison import explain_gap
    from tvsbayes.information import headline_causes, residual_causes, stop_residuals

    stops = stop_residuals(fit)
    listed = stops[:: -(-len(stops) // RESIDUALS_LISTED) or 1]
    gaps, budgets, axes = {}, [], []
    if calibration is not None:
        gaps = explain_gap(fit, posterior)
        causes = headline_causes(fit)
        told = {**{f"effective_deg_per_step.{d}": e for d, e in summary.effective.items()}, **summary.parameters}
        # What a model holds fixed has no uncertainty to split.
        budgets = [headline_budget(causes, q, told[q]).as_json() for q in causes.quantities if told[q].sd > 0]
        readings = {axis: stop_readings(fit, axis) for axis in ("pan", "tilt")}
        for axis, own in readings.items():
            contrast = physical[:, fit.names.index(f"ratio_contrast_deg_per_step.{axis}")]
            axes.append(positioning(calibration, axis, readings=own, contrast_deg_per_step=contrast).as_json())
    return {
        "residuals": [asdict(stop) for stop in listed],
        "residual_causes": [asdict(cause) for cause in residual_causes(stops)],
        "gap": {d: None if gap is None else asdict(gap) for d, gap in gaps.items()} if any(gaps.values()) else None,
        "budgets": budgets,
        "positioning": axes,
    }


def _calibration(folder: Path) -> Calibration:
    """The calibration in `results/` where its hashes agree with the campaign; else fit first (DESIGN 8)."""
    from tvsbayes.calibration import stored_calibration
    from tvsbayes.campaign import read_campaign

    campaign = read_campaign(folder)
    found = stored_calibration(campaign)
    if found is not None:
        return found
    report_line(FITTING_FIRST)
    result = _converged_fit(campaign)
    from tvsbayes.information import calibration_of

    return calibration_of(result)


def _fit_of(campaign: Campaign) -> JointFit:
    """The fit in `results/` where its hashes agree with the campaign; else fit first (DESIGN 8)."""
    from tvsbayes.calibration import stored_mode
    from tvsbayes.joint import restored

    _use_compilation_cache()
    stored = stored_mode(campaign)
    found = None if stored is None else restored(campaign, stored)
    if found is not None:
        return found
    report_line(FITTING_FIRST)
    return _converged_fit(campaign)


def _converged_fit(campaign: Campaign) -> JointFit:
    """A fit for a command that needs one in passing."""
    from tvsbayes.joint import fit as fit_joint

    _use_compilation_cache()
    result = fit_joint(campaign)
    if not result.converged:
        raise NotConverged(
            "not-converged",
            "NOT CONVERGED: " + "; ".join(result.problems),
            remedy="see `tvsbayes fit`; this command needs a fit that has converged",
        )
    return result


@app.command()
def report(
    campaign: CampaignFolder,
    limit_deg_per_step: Annotated[
        float | None,
        typer.Option("--limit-deg-per-step", min=0, help="Largest error allowed of any ratio: for a verdict."),
    ] = None,
    limit_mm: Annotated[float | None, typer.Option("--limit-mm", min=0, help="Largest 3D error allowed.")] = None,
    range_mm: Annotated[float, typer.Option("--range-mm", min=1, help="Range at which millimetres are stated.")] = 1e3,
    pdf: Annotated[bool, typer.Option("--pdf", help="Also print to PDF with an installed Chromium.")] = False,
    dcc: Annotated[bool, typer.Option("--dcc", help="Also write DCC-schema XML (unsigned, not accredited).")] = False,
    laboratory: Annotated[str, typer.Option("--laboratory", help="Who measured, for --dcc.")] = "not stated",
    customer: Annotated[str, typer.Option("--customer", help="For whom, for --dcc.")] = "not stated",
    country: Annotated[str, typer.Option("--country", help="ISO 3166-1 code of the place, for --dcc.")] = "ZZ",
    dcc_schema: Annotated[
        Path | None, typer.Option("--dcc-schema", help="PTB's dcc.xsd on this machine: validate the XML against it.")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", help="File (default CAMPAIGN/results/report.html).")] = None,
    as_json: Json = False,
) -> None:
    """The calibration report as one HTML page. Verdict, results, residuals, error maps, budgets, provenance."""
    from tvsbayes.calibration import load_calibration
    from tvsbayes.campaign import read_campaign

    data = read_campaign(campaign)
    results = output_place(campaign, "results")
    from tvsbayes.report import find_browser, print_to_pdf, report_html, validation_lines

    if pdf:
        find_browser()
    document = _fit_document(data, campaign)
    from tvsbayes.certificate import check_dcc, dcc_bytes
    from tvsbayes.comparison import gather

    limits = {"limit_deg_per_step": limit_deg_per_step, "limit_mm": limit_mm}
    evidence = gather(data, document, load_calibration(campaign), range_mm=range_mm, **limits)
    path = out or results / "report.html"
    write_atomically(path, report_html(evidence))
    files = {"report": str(path)}
    if pdf:
        files["pdf"] = str(print_to_pdf(path))
    if dcc or dcc_schema:
        certificate = results / "dcc.xml"
        places = {"laboratory": laboratory, "customer": customer, "country": country}
        today = datetime.datetime.now(datetime.UTC).date()
        content = dcc_bytes(data, document, issued=today, report=path.read_bytes(), **places)
        write_atomically(certificate, content)
        files["dcc"] = str(certificate)
    checked = check_dcc(content, dcc_schema) if dcc_schema else None
    lines = [
        f"{c.quantity} within {c.limit:g} {c.unit}: {c.verdict} (P = {c.probability:.3f})" for c in evidence.criteria
    ]
    result: dict[str, Any] = {"criteria": [asdict(c) for c in evidence.criteria], "files": files}
    if checked is not None:
        verdict = {True: "valid", False: "NOT VALID", None: "could not be checked"}[checked.valid]
        lines += [f"DCC by {checked.tool} against {dcc_schema}: {verdict}", *checked.messages[:DCC_MESSAGES]]
        result["dcc_schema"] = asdict(checked)
    validation = document.get("validation")
    if validation is not None and not validation["passed"]:
        lines.insert(0, validation_lines(validation)[0])
    text = "\n".join([*lines, f"written: {', '.join(files.values())}"])
    _finish(result, text, as_json)
    if any(c.verdict != "met" for c in evidence.criteria) or (checked is not None and not checked.valid):
        raise _Ended(TARGET_MISSED)


def _fit_document(data: Campaign, folder: Path) -> dict[str, Any]:
    """`results/fit.json` where it was made from exactly this campaign; else fit first (DESIGN 8)."""
    from tvsbayes.calibration import stored_calibration
    from tvsbayes.campaign import input_hashes
    from tvsbayes.certificate import read_fit

    path = folder / "results" / "fit.json"
    if stored_calibration(data) is not None and path.exists():
        document = read_fit(path)
        # An old fit.json beside new draws would be the report of other data.
        if "budgets" in document and document["inputs"] == input_hashes(data):
            return document
    report_line(FITTING_FIRST)
    result = _converged_fit(data)
    from tvsbayes.information import calibration_of, summarise
    from tvsbayes.report import write_results

    summary, calibration = summarise(result), calibration_of(result)
    evidence = _evidence(result, summary, None, calibration, result.draws.physical)
    write_results(result, summary, output_place(folder, "results"), 0, calibration, None, evidence)
    return read_fit(path)


@app.command()
def compare(
    campaign: CampaignFolder,
    other: Annotated[Path | None, typer.Argument(metavar="B", help="Later campaign of the same instrument.")] = None,
    by: Annotated[str, typer.Option("--by", help="Left out together: steps or regions.")] = "steps",
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Classic against joint on experiments that were left out.

    The gap between the two estimators term by term; with a later campaign B, what has changed since.
    """
    from tvsbayes.campaign import input_hashes, read_campaign

    if by not in ("steps", "regions"):
        raise InputError("usage", f"--by {escaped(by)}: allowed are steps and regions", remedy="choose one of them")
    data = [read_campaign(folder) for folder in (campaign, *([other] if other is not None else ()))]
    results = output_place(campaign, "results")
    from tvsbayes.report import changes_text, gap_text, hold_out_text

    fits = [_fit_of(each) for each in data]
    from tvsbayes.comparison import compare as compare_fits
    from tvsbayes.comparison import explain_gap, hold_out

    if other is not None:
        changes = compare_fits(*fits)
        _finish(changes.as_json(), changes_text(changes), as_json)
        return
    gaps = explain_gap(fits[0])
    if not any(gaps.values()):
        raise NothingToEstimate(
            "no-experiments",
            "the campaign has no complete four-point experiment: there is no classic estimate to compare with",
            file="spots.csv",
            remedy="number the looks in the columns experiment and point, or use `tvsbayes fit`",
        )
    held = hold_out(fits[0], by, seed)
    document = {
        "kind": "classic against joint",
        "format": "tvsbayes-compare/1",
        "estimator": "laplace",
        "directions": {name: None if gap is None else asdict(gap) for name, gap in gaps.items()},
        "held_out": held.as_json(),
        "inputs": input_hashes(data[0]),
        "seed": seed,
    }
    files, text = {}, f"{gap_text(gaps)}\n\n{hold_out_text(held)}"
    if _keep(document, path := results / "compare.json"):
        files, text = {"compare": str(path)}, f"{text}\nwritten: {path}"
    _finish({**document, "files": files}, text, as_json)


def _keep(document: dict[str, Any], path: Path) -> bool:
    """Write what a later report will show; a folder that cannot be written costs nobody the result."""
    try:
        make_folder(path.parent)
        write_atomically(path, json.dumps(document, indent=1, allow_nan=False).encode())
    except InputError as error:
        report_line(f"warning: not kept for the report: {error.message}")
        return False
    return True


POINT_COLUMNS = ("pan_steps", "tilt_steps", "pan_approach", "tilt_approach", "aperture_deg")
STEPS_MAX, ANGLE_MAX_DEG = 1e8, 360.0


def _read_points(path: Path) -> tuple[list[float], list[float], list[float], list[tuple[str, str]]]:
    """Counters, readings and approaches of a CSV of points."""
    from tvsbayes.calibration import SIDES

    table = parse_table(read_bytes(path, CSV_BYTES_MAX), escaped(path.name), POINT_COLUMNS)
    if not len(table):
        raise InputError("empty", f"{escaped(path.name)}: no points", file=escaped(path.name), remedy="add rows")
    for axis in ("pan", "tilt"):
        allowed = (*SIDES[axis][::-1], "unknown")
        for row, word in enumerate(table.columns[f"{axis}_approach"]):
            if word not in allowed:
                remedy = "name the direction of the last move of the axis"
                raise table.refuse(row, f"{axis}_approach", "approach", ", ".join(allowed), remedy)
    counters = [table.numbers(name, -STEPS_MAX, STEPS_MAX) for name in ("pan_steps", "tilt_steps")]
    readings = table.numbers("aperture_deg", -ANGLE_MAX_DEG, ANGLE_MAX_DEG)
    pairs = list(zip(table.columns["pan_approach"], table.columns["tilt_approach"], strict=True))
    return *counters, readings, pairs


def _finite(**values: float | None) -> None:
    """Refuse NaN and infinity, which option parsing lets through."""
    for name, value in values.items():
        if value is not None and not math.isfinite(value):
            option = "--" + name.replace("_", "-")
            allowed, remedy = "a finite number", "write a decimal number"
            raise InputError("number", f"{option} is {value}", column=option, allowed=allowed, remedy=remedy)


@app.command()
def locate(
    campaign: CampaignFolder,
    pan_steps: Annotated[float | None, typer.Option("--pan-steps", help="Absolute counter.")] = None,
    tilt_steps: Annotated[float | None, typer.Option("--tilt-steps", help="Absolute counter.")] = None,
    pan_approach: Annotated[str, typer.Option("--pan-approach", help="left, right or unknown.")] = "left",
    tilt_approach: Annotated[str, typer.Option("--tilt-approach", help="up, down or unknown.")] = "up",
    aperture_deg: Annotated[float | None, typer.Option("--aperture-deg", help="Reading B of the aperture.")] = None,
    points: Annotated[
        Path | None,
        typer.Option(
            "--points", help="CSV with columns pan_steps, tilt_steps, pan_approach, tilt_approach, aperture_deg."
        ),
    ] = None,
    draws: Annotated[int, typer.Option("--draws", min=500, max=100_000, help="Draws per point.")] = 1000,
    budget: Annotated[
        bool, typer.Option("--budget", help="Also what the uncertainty of the point consists of.")
    ] = False,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Where the scanner points, in millimetres. Frame T, with covariance and 95 % half widths."""
    single = (pan_steps, tilt_steps, aperture_deg)
    if (points is None) == any(value is None for value in single):
        remedy = "give --pan-steps, --tilt-steps and --aperture-deg, or --points FILE.csv"
        raise InputError("usage", "locate needs one point or a file of points", remedy=remedy)
    if budget and points is not None:
        raise InputError("usage", "--budget is for one point", remedy="leave out --points")
    _finite(pan_steps=pan_steps, tilt_steps=tilt_steps, aperture_deg=aperture_deg)
    where = (*single, (pan_approach, tilt_approach)) if points is None else _read_points(points)
    from tvsbayes.calibration import sides_of

    if points is None:
        sides_of((pan_approach, tilt_approach))
    calibration = _calibration(campaign)
    from tvsbayes.coordinates import locate as locate_points
    from tvsbayes.report import locations_text

    _use_compilation_cache()
    found = locate_points(calibration, *where, draws=draws, seed=seed)
    if points is not None:
        entries = [found.as_json(k) for k in range(len(found.refused))]
        document = {"estimator": found.estimator, "draws": found.draws, "points": entries}
        _finish(document, locations_text(found), as_json)
        return
    if found.refused[0] is not None:
        raise found.refused[0]
    document = {"estimator": found.estimator, "draws": found.draws, **found.as_json(0)}
    text = locations_text(found)
    if budget:
        from tvsbayes.comparison import budget as point_budget
        from tvsbayes.report import budget_text

        parts = point_budget(calibration, *where)
        document["budget"] = parts.as_json()
        text += f"\n\n{budget_text(parts)}"
    _finish(document, text, as_json)


@app.command("steps-for")
def steps_for(
    campaign: CampaignFolder,
    x_mm: Annotated[float | None, typer.Option("--x-mm", help="Wanted point, frame T: depth.")] = None,
    y_mm: Annotated[float | None, typer.Option("--y-mm", help="Along the baseline, towards the positioner.")] = None,
    z_mm: Annotated[float | None, typer.Option("--z-mm", help="Up.")] = None,
    azimuth_deg: Annotated[float | None, typer.Option("--azimuth-deg", help="Wanted direction: C - 90 deg.")] = None,
    elevation_deg: Annotated[float | None, typer.Option("--elevation-deg", help="Above the horizontal.")] = None,
    pan_approach: Annotated[str | None, typer.Option("--pan-approach", help="left or right (default: left).")] = None,
    tilt_approach: Annotated[str | None, typer.Option("--tilt-approach", help="up or down (default: up).")] = None,
    rig: Annotated[Path | None, typer.Option("--rig", help="Rig file whose [positioner] limits are kept.")] = None,
    export: Annotated[str | None, typer.Option("--export", help="header or json: the calibration itself.")] = None,
    as_json: Json = False,
) -> None:
    """Counters that send the beam to a point or along a direction. With the approach that removes backlash."""
    _finite(x_mm=x_mm, y_mm=y_mm, z_mm=z_mm, azimuth_deg=azimuth_deg, elevation_deg=elevation_deg)
    point = None if None in (x_mm, y_mm, z_mm) else (x_mm, y_mm, z_mm)
    direction = None if None in (azimuth_deg, elevation_deg) else (azimuth_deg, elevation_deg)
    given = sum(value is not None for value in (x_mm, y_mm, z_mm, azimuth_deg, elevation_deg))
    if export not in (None, "header", "json"):
        raise InputError("usage", f"--export {escaped(export)}", allowed="header, json", remedy="name one of them")
    if given != (0 if export else 3 if point else 2 if direction else -1):
        remedy = "give --x-mm --y-mm --z-mm, or --azimuth-deg --elevation-deg, or --export alone"
        raise InputError("usage", "steps-for needs one target", remedy=remedy)
    limits = None if rig is None else _limits(rig)
    calibration = _calibration(campaign)
    from tvsbayes.calibration import calibration_header, calibration_json

    if export:
        document = calibration_json(calibration)
        text = calibration_header(calibration) if export == "header" else json.dumps(document, indent=1)
        _finish({"header": text} if as_json and export == "header" else document, text.rstrip("\n"), as_json)
        return
    from tvsbayes.report import steps_text

    azimuth, elevation = direction or (None, None)
    sides = None if pan_approach is tilt_approach is None else (pan_approach or "left", tilt_approach or "up")
    found = calibration.steps_for(point, azimuth_deg=azimuth, elevation_deg=elevation, approach=sides, limits=limits)
    if not calibration.covers(found.pan_steps, found.tilt_steps):
        report_line("warning: these counters lie outside those of the campaign: the calibration extrapolates")
    document = {"estimator": calibration.estimator, **found.as_json()}
    _finish(document, steps_text(found), as_json)


TargetText = Annotated[
    str | None,
    typer.Option("--target", help="As 'u(worst) <= 2e-4 deg/step' or 'U95(x) at 1000,0,0 mm <= 60 mm'."),
]


@app.command()
def plan(
    rig: Annotated[Path, typer.Argument(metavar="RIG", help="Rig file.")],
    given: Annotated[Path | None, typer.Option("--given", help="Campaign measured already: what next?")] = None,
    target: TargetText = None,
    minutes: Annotated[float | None, typer.Option("--minutes", min=0.1, help="Longest plan.")] = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Write the plan here (plan.csv).")] = None,
    criterion: Annotated[str, typer.Option("--criterion", help="c (the target), D or A (all headlines).")] = "c",
    aperture: Annotated[bool, typer.Option("--aperture/--no-aperture", help="Looks also read the aperture.")] = False,
    draws: Annotated[int, typer.Option("--draws", min=20, max=10_000, help="Instruments for the assurance.")] = 200,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """How many experiments, which ones, and when to stop. With --given: what next."""
    from tvsbayes.campaign import input_hashes, read_campaign, write_plan
    from tvsbayes.rigs import read_rig

    instrument, data = read_rig(rig), None if given is None else read_campaign(given)
    from tvsbayes.design import CRITERIA, DEFAULT_TARGET, parse_target
    from tvsbayes.planning import plan as find_plan
    from tvsbayes.planning import plan_text

    wanted = parse_target(target or DEFAULT_TARGET)
    if criterion not in CRITERIA:
        message, allowed = f"--criterion {escaped(criterion)}", ", ".join(CRITERIA)
        raise InputError("criterion", message, column="--criterion", allowed=allowed, remedy="name one of them")
    _use_compilation_cache()
    fitted = None if data is None else _fit_of(data)
    options = {"criterion": criterion, "aperture": aperture, "draws": draws, "seed": seed}
    result = find_plan(instrument, wanted, given=fitted, minutes=minutes, **options)
    text, document = plan_text(result), result.as_json()
    if output is not None and result.steps:
        write_plan(result.steps, output)
        document["plan"] = str(output)
        text += f"\nwritten: {escaped(str(output), 200)}"
    elif output is not None:
        text += f"\nnothing written to {escaped(str(output), 200)}: there is nothing more to measure"
    if data is not None:
        # Where the report looks for what to measure next.
        stored = {"format": "tvsbayes-plan/1", "inputs": input_hashes(data), **document}
        _keep(stored, output_place(data.path, "results") / "plan.json")
    _finish(document, text, as_json)
    if target is not None and not result.met:
        raise _Ended(TvsError.exit_code)


@app.command()
def study(
    rig: Annotated[Path, typer.Argument(metavar="RIG", help="Rig file.")],
    plan_file: Annotated[Path, typer.Argument(metavar="PLAN", help="plan.csv.")],
    n: Annotated[int, typer.Option("--n", min=1, max=1_000_000, help="Simulated campaigns.")] = 100,
    engine: Annotated[str, typer.Option("--engine", help="serial, processes or dask.")] = "serial",
    workers: Annotated[int, typer.Option("--workers", min=1, max=1024, help="Worker processes.")] = 2,
    scheduler: Annotated[str | None, typer.Option("--scheduler", help="Address of a Dask scheduler.")] = None,
    rows: Annotated[Path | None, typer.Option("--rows", help="File of rows (default: PLAN with .study.jsonl).")] = None,
    target: TargetText = None,
    aperture: Annotated[bool, typer.Option("--aperture/--no-aperture", help="Looks also read the aperture.")] = False,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Simulate a plan many times and fit every campaign. Coverage, power, assurance; run again to go on."""
    from tvsbayes.campaign import read_plan
    from tvsbayes.rigs import read_rig

    instrument, steps = read_rig(rig), read_plan(plan_file)
    from tvsbayes.design import ASSURED, DEFAULT_TARGET, parse_target
    from tvsbayes.studies import StudyJob, StudyRows, study_text
    from tvsbayes.studies import study as run_study

    _use_compilation_cache()
    job = StudyJob(instrument, steps, parse_target(target or DEFAULT_TARGET), seed, aperture)
    kept = StudyRows(rows or plan_file.with_suffix(".study.jsonl"))
    missing = n - sum(index < n for index in kept.of(job))
    report_line(f"{n} campaigns, {missing} to go on engine {escaped(engine)}; rows in {escaped(str(kept.path), 200)}")

    def progress(done: int, wanted: int) -> None:
        if sys.stderr.isatty():
            report_line(f"{done} of {wanted}")

    options = {"engine": engine, "workers": workers, "address": scheduler}
    result = run_study(job, n, kept, progress=progress, **options)
    document = {**result.as_json(), "rows": str(kept.path), "engine": engine, "seed": seed}
    _finish(document, study_text(result), as_json)
    if target is not None and result.assurance < ASSURED[0]:
        raise _Ended(TvsError.exit_code)


def _limits(path: Path) -> dict[str, tuple[float, float]]:
    """Counter limits by axis from [positioner] of a rig file."""
    from tvsbayes.rigs import read_rig

    stated = read_rig(path).positioner
    return {
        axis: (stated.get(f"{axis}_min_steps", -math.inf), stated.get(f"{axis}_max_steps", math.inf))
        for axis in ("pan", "tilt")
    }


@contextmanager
def _counting(what: str) -> Iterator[Callable[[int, int], None]]:
    """A bar for work of known length on a terminal, nothing elsewhere."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    console = Console(stderr=True)
    columns = TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Bar(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(what, total=None)
        yield lambda count, total: bar.update(task, completed=count, total=total)


@contextmanager
def _sampling_progress() -> Iterator[Callable[[Progress], None]]:
    """A bar on a terminal, nothing elsewhere; Ctrl-C says how to go on."""
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    console, kept = Console(stderr=True), False
    columns = TextColumn("sampling"), BarColumn(), TextColumn("{task.fields[note]}"), TimeElapsedColumn()
    try:
        with Bar(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
            task = bar.add_task("sampling", total=None, note="preparing")

            def show(state: Progress) -> None:
                nonlocal kept
                kept = True
                ess = "" if state.worst_ess is None else f", least effective draws {state.worst_ess:.0f}"
                note = f"step {state.steps}{ess}, next look in {max(state.seconds_left, 0):.0f} s"
                bar.update(task, completed=state.steps, total=state.expected_steps, note=note)

            yield show
    except KeyboardInterrupt:
        # Before the first block of steps there is no chain to keep.
        if kept:
            report_line("the chain so far is kept in chain.npz; go on with --resume")
        raise


def run(arguments: list[str]) -> int:
    """Run one command and return its exit code; no traceback reaches a user."""
    try:
        return _run(arguments)
    except _OutputFailed as error:
        report_line(f"error: the result cannot be written to standard output: {error}")
        return InputError.exit_code


def _run(arguments: list[str]) -> int:
    wants_json = "--json" in arguments
    try:
        # Typer returns the code of its own Exit, into which it also turns Ctrl-C; commands return None.
        code = app(arguments, prog_name="tvsbayes", standalone_mode=False) or 0
    except TvsError as error:
        if wants_json:
            print_json(_error_document(error))
        else:
            _report_error(error)
        return error.exit_code
    except _Ended as ending:
        return ending.exit_code
    except typer.Exit as ending:
        return ending.exit_code
    except (KeyboardInterrupt, typer.Abort):
        code = INTERRUPTED
    except Exception as error:
        # Wrong options are bad input like any other; typer's own classes carry the text to show.
        if not hasattr(error, "format_message"):
            raise
        if wants_json:
            print_json(_error_document(InputError("usage", error.format_message(), remedy="see tvsbayes --help")))
        else:
            error.show()
        return InputError.exit_code
    if code == INTERRUPTED:
        if wants_json:
            print_json(_error_document(TvsError("interrupted", "interrupted", remedy="run it again")))
        report_line("interrupted")
    return code


def main() -> None:
    """Entry point of the `tvsbayes` script."""
    # Read when NumPy is first imported. The matrices here are small: OpenBLAS' second thread only waits, and its
    # busy waiting takes the time of XLA's threads, tenfold where two fits share two cores.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # XLA calls a compilation of more than two minutes, as on a small computer, an error to be filed with its authors.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    sys.exit(run(sys.argv[1:]))
