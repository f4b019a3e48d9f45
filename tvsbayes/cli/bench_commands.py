"""Stereo, acquire, doctor."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from tvsbayes.cli.app import INTERRUPTED, Ended, Json, Seed, finish, finite, report_line
from tvsbayes.errors import InputError, escaped, refusal
from tvsbayes.files.disk import write_atomically
from tvsbayes.pipeline import compile_for

IMAGE_SIDE_MAX = 65_535
FIT_COMMAND = (sys.executable, "-m", "tvsbayes", "fit")
"""`tvsbayes fit` in a process of its own."""


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
    finite(pitch_mm=pitch_mm, pitch_u_mm=pitch_u_mm)
    from tvsbayes.cameras.calibration_formats import EXPORT_NAMES, exported, read_calibration
    from tvsbayes.instrument.parameters import STEREO_PARAMETER_NAMES
    from tvsbayes.instrument.stereo_pair import stereo_bytes
    from tvsbayes.report.command_text import stereo_calibration_text, stereo_text

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
        from tvsbayes.cameras.boards import Board
        from tvsbayes.cameras.stereo_calibration import calibrate_folder

        compile_for(report_line)
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
    finish({**document, "files": written}, text, as_json)


def _image_size(text: str | None) -> tuple[int, int] | None:
    """Width and height from text such as 1280x720."""
    if text is None:
        return None
    width, _, height = text.lower().partition("x")
    sizes = [int(part) if part.isascii() and part.isdecimal() and len(part) < 6 else 0 for part in (width, height)]
    if not all(0 < size <= IMAGE_SIDE_MAX for size in sizes):
        raise InputError("usage", f"--image-size {escaped(text)}", allowed="WIDTHxHEIGHT", remedy="write 1280x720")
    return sizes[0], sizes[1]


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
    from tvsbayes.instrument.plan import read_plan
    from tvsbayes.instrument.rig import read_rig

    instrument, steps = read_rig(rig), read_plan(plan)
    from tvsbayes.acquisition.bench import Vision
    from tvsbayes.acquisition.operator import LiveLine, Terminal
    from tvsbayes.acquisition.running_estimate import EstimateWish
    from tvsbayes.acquisition.session import acquire as run_plan
    from tvsbayes.acquisition.session import check_plan
    from tvsbayes.instrument.plan import outline, plan_seconds

    if dry_run:
        check_plan(instrument, steps)
        lines, minutes = outline(instrument, steps), plan_seconds(instrument, steps) / 60
        document: dict[str, Any] = {"steps": lines, "minutes": minutes}
        finish(document, "\n".join([*lines, f"{len(lines)} steps, about {minutes:.0f} min"]), as_json)
        return
    vision = Vision()
    if not centroids:
        from tvsbayes.acquisition.observation import live_detector, twin_renderer

        vision = Vision(live_detector(instrument.stereo), twin_renderer(instrument, seed) if simulate else None)
    with LiveLine() as line:
        outcome = run_plan(
            instrument,
            steps,
            out,
            simulate=simulate,
            resume=resume,
            laser_class=laser_class,
            seed=seed,
            estimate=EstimateWish(FIT_COMMAND, target_u, estimate),
            vision=vision,
            terminal=Terminal(report_line, line.show, line.ask),
        )
    document = {"campaign": str(out), **outcome.as_json()}
    text = f"{escaped(str(out), 200)}: {outcome.reason}, {outcome.ok} of {outcome.looks} looks count"
    if outcome.references:
        planned = outcome.looks - outcome.references
        text += f" ({planned} of the plan, {outcome.references} reference looks of resumed runs)"
    finish(document, "\n".join([text, *(f"warning: {warning}" for warning in outcome.warnings)]), as_json)
    if outcome.reason in ("interrupted", "declined"):
        report_line(f"{outcome.reason}; go on with --resume")
        raise Ended(INTERRUPTED)
    if target_u is not None and outcome.reason != "target met":
        report_line("the plan is done and the target is not met: plan more with tvsbayes plan --given")
        raise Ended(1)


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
    from tvsbayes.acquisition.doctor import examine
    from tvsbayes.errors import DeviceFault
    from tvsbayes.instrument.rig import read_rig

    checks = examine(read_rig(rig), Path.cwd(), laser=laser)
    lines = [f"{c.status:8} {c.name}: {c.found}" + (f"; {c.remedy}" if c.remedy else "") for c in checks]
    faults = [c for c in checks if c.status == "fault"]
    error = None
    if faults:
        message = f"{len(faults)} fault{'s' * (len(faults) > 1)}: {', '.join(c.name for c in faults)}"
        error = DeviceFault("doctor", message, remedy=faults[0].remedy)
    finish({"checks": [c.as_json() for c in checks]}, "\n".join(lines), as_json, error)
