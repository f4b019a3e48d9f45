"""Commands at the bench: stereo, doctor, export."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from tvsbayes.cli.app import Json, finish, finite, missing_options, option_of, refuse_options
from tvsbayes.cli.begin_commands import stated_globs
from tvsbayes.cli.instruments import serve
from tvsbayes.cli.progress_bar import waiting
from tvsbayes.errors import DeviceFault, InputError, escaped, plural, refusal
from tvsbayes.files.csv_table import NUMBER
from tvsbayes.files.disk import make_folder, require_writable, write_atomically
from tvsbayes.instrument.parameters import STEREO_PARAMETER_NAMES

if TYPE_CHECKING:
    from tvsbayes.cameras.assumed_covariance import Provenance
    from tvsbayes.cameras.boards import Board, Finder
    from tvsbayes.cameras.calibration_export import Format
    from tvsbayes.cameras.picture_pairs import Pairing
    from tvsbayes.instrument.stereo_pair import Stereo

IMAGE_SIDE_MAX = 65_535


def stereo(
    folder: Annotated[Path | None, Argument(metavar="FOLDER", help="Folder of checkerboard pictures.")] = None,
    board: Annotated[str | None, Option(help="Inner corners, columns x rows: 9x6.")] = None,
    pitch_mm: Annotated[float | None, Option(help="Side of a square.")] = None,
    pitch_u_mm: Annotated[float | None, Option(help="Its standard uncertainty (mean of all; default 0).")] = None,
    charuco: Annotated[
        str | None, Option(help="Squares of a ChArUco board, columns x rows, instead of --board.")
    ] = None,
    dictionary: Annotated[str | None, Option(help="Of its markers, as in OpenCV: 5X5_100.")] = None,
    marker_mm: Annotated[float | None, Option(help="Side of a marker (default: found from the pictures).")] = None,
    out: Annotated[Path | None, Option("-o", "--out", help="stereo.json to write.")] = None,
    imports: Annotated[
        list[Path] | None,
        Option("--import", help="Calibration of another program, or stereo.json, instead of pictures; repeatable."),
    ] = None,
    export: Annotated[str | None, Option(help="opencv or ros: also for these, beside -o.")] = None,
    finder: Annotated[str | None, Option(help="classic (default) or sector; the other is the fallback.")] = None,
    swap: Annotated[bool, Option("--swap", help="Wide frames hold the left camera's image on the right.")] = False,
    pair: Annotated[str | None, Option(help="name (default) or order: of the names of each camera.")] = None,
    left: Annotated[str | None, Option(help='Pictures of the left camera in FOLDER: "a/*.png".')] = None,
    right: Annotated[str | None, Option(help="Likewise of the right camera.")] = None,
    fix_k3: Annotated[bool, Option("--fix-k3", help="Keep k3 at 0.")] = False,
    robust: Annotated[bool, Option("--robust", help="Leave out outlying views, by name.")] = False,
    image_size: Annotated[str | None, Option(help="1280x720, where imports lack it.")] = None,
    import_unit: Annotated[str | None, Option(help="Unit of an imported T: mm, cm, m, or its mm: 25.")] = None,
    key: Annotated[
        list[str] | None, Option("--key", help="M1=NAME: what holds M1, D1, M2, D2, R (R=NAME.T: transposed), T.")
    ] = None,
    rms_px: Annotated[float | None, Option(help="RMS of an imported calibration, as OpenCV gives it.")] = None,
    views: Annotated[int | None, Option(min=1, help="Views that it was made of.")] = None,
    fixed_intrinsics: Annotated[
        bool | None, Option("--fixed-intrinsics/--joint", help="Each camera by itself, then R and T; or all at once.")
    ] = None,
    u_focal_percent: Annotated[float | None, Option(help="Standard uncertainty of fx, fy of an import.")] = None,
    u_principal_px: Annotated[float | None, Option(help="Of its cx, cy.")] = None,
    u_rotation_mrad: Annotated[float | None, Option(help="Of each turn in its R.")] = None,
    u_baseline_mm: Annotated[float | None, Option(help="Of each component of its T.")] = None,
    as_json: Json = False,
) -> None:
    """Calibrate the camera pair from checkerboard pictures. With the covariance of all 24 parameters; or import one."""
    words = (export, ("opencv", "ros")), (finder, ("classic", "sector")), (pair, ("name", "order"))
    if invalid := [escaped(str(value)) for value, allowed in words if value not in (None, *allowed)]:
        remedy = "--export opencv or ros, --finder classic or sector, --pair name or order"
        raise InputError("usage", f"{', '.join(invalid)}: no option of stereo takes this value", remedy=remedy)
    if (folder is None) == (not imports):
        message = "stereo needs pictures of a board, or a calibration to import"
        message = message if folder is None else "stereo takes pictures or a calibration to import, not both"
        raise InputError("usage", message, remedy="give FOLDER with --board and --pitch-mm, or --import FILE")
    uncertainties = {"u_focal_percent": u_focal_percent, "u_principal_px": u_principal_px}
    uncertainties |= {"u_rotation_mrad": u_rotation_mrad, "u_baseline_mm": u_baseline_mm}
    finite(pitch_mm=pitch_mm, pitch_u_mm=pitch_u_mm, marker_mm=marker_mm, rms_px=rms_px, **uncertainties)
    made_by = {"rms_px": rms_px, "views": views, "fixed_intrinsics": fixed_intrinsics, **uncertainties}
    export_format: Format | None = None if export is None else "ros" if export == "ros" else "opencv"
    places = _output_paths(out, export_format)
    if folder is None:
        options: dict[str, object] = {"finder": finder, "swap": swap, "fix_k3": fix_k3, "robust": robust}
        options |= {"pair": pair, "left": left, "right": right}
        options |= {"charuco": charuco, "dictionary": dictionary, "marker_mm": marker_mm}
        refuse_options("for pictures of a board", "leave out --import", **options)
        _positive(rms_px=rms_px, **uncertainties)
        provenance = _provenance(board, pitch_mm, pitch_u_mm, made_by)
        pair_made = _imported(imports or [], image_size, import_unit, provenance, _keys_by_field(key))
    else:
        given = {"image_size": image_size, "import_unit": import_unit, "joint": fixed_intrinsics is False}
        remedy = "leave it out: it is found from the pictures"
        refuse_options("for --import", remedy, **given, key=bool(key), **made_by)
        if charuco is not None:
            refuse_options("of no use beside --charuco", "leave it out", board=board, finder=finder)
            pattern = _marker_board(charuco, dictionary, pitch_mm, marker_mm, pitch_u_mm or 0.0)
        else:
            refuse_options("for --charuco", "add --charuco 15x10", dictionary=dictionary, marker_mm=marker_mm)
            pattern = _board(board, pitch_mm, pitch_u_mm or 0.0)
        from tvsbayes.cameras.stereo_calibration import calibrate_folder
        from tvsbayes.report.command_text import stereo_calibration_text

        pairing = _pairing(pair, left, right, swap)
        kind: Finder = "sector" if finder == "sector" else "classic"
        with waiting() as progress:
            result = calibrate_folder(
                folder, pattern, finder=kind, pairing=pairing, fix_k3=fix_k3, robust=robust, progress=progress
            )
        document = {"source": "pictures", **result.as_json()}
        pair_made = PrintedPair(result.stereo, stereo_calibration_text(result), document)
    _write_pair(pair_made, places, export_format, as_json)


def _pairing(pair: str | None, left: str | None, right: str | None, swap: bool) -> Pairing:
    """The camera of each picture, by the options."""
    from tvsbayes.cameras.picture_pairs import Pairing

    if globs := stated_globs(left, right, swap):
        return Pairing(swap, globs, in_order=True)
    return Pairing(swap=swap, in_order=pair == "order")


@dataclass(frozen=True)
class PrintedPair:
    """A calibrated pair with its text and document."""

    stereo: Stereo
    text: str
    document: dict[str, object]


def _output_paths(out: Path | None, export: Format | None) -> dict[str, Path]:
    """Output paths of the pair, by kind; checked before pictures are read, which takes minutes."""
    from tvsbayes.cameras.calibration_export import EXPORT_NAMES

    folder = Path() if out is None else out.parent
    places = {} if out is None else {"stereo": out}
    places |= {name: folder / name for name in (() if export is None else EXPORT_NAMES[export])}
    if places:
        require_writable(folder)
    for path in places.values():
        if os.path.lexists(path):
            # Fits refer to a calibration by its hash, so it is not overwritten.
            remedy = "name another file, or move this one away; nothing is overwritten"
            place = escaped(str(path), 200)
            raise refusal("occupied", file=place, found="a file that is there", allowed="a new file", remedy=remedy)
    return places


def _board(board: str | None, pitch_mm: float | None, pitch_u_mm: float) -> Board:
    """The board in the pictures."""
    from tvsbayes.cameras.boards import Board

    if board is None or pitch_mm is None:
        missing = " and ".join(missing_options(board=board, pitch_mm=pitch_mm))
        remedy = f"give {missing}: inner corners, columns x rows, and the side of a square: --board 9x6 --pitch-mm 25"
        raise InputError("usage", f"stereo FOLDER needs {missing}", remedy=remedy)
    return Board.named(board, pitch_mm, pitch_u_mm)


def _marker_board(
    squares: str, dictionary: str | None, pitch_mm: float | None, marker_mm: float | None, pitch_u_mm: float
) -> Board:
    """The ChArUco board in the pictures."""
    from tvsbayes.cameras.boards import Board

    if dictionary is None or pitch_mm is None:
        missing = " and ".join(missing_options(dictionary=dictionary, pitch_mm=pitch_mm))
        remedy = f"give {missing}, for example --charuco 15x10 --dictionary 5X5_100 --pitch-mm 45"
        raise InputError("usage", f"stereo FOLDER --charuco needs {missing}", remedy=remedy)
    return Board.with_markers(squares, dictionary, pitch_mm, marker_mm, pitch_u_mm)


def _positive(**values: float | None) -> None:
    """Refuse options that are 0 or less."""
    for name, value in values.items():
        if value is not None and not value > 0:
            message = f"{option_of(name)} {value:g}: allowed are numbers above 0"
            raise InputError("usage", message, remedy="correct it")


def _provenance(
    board: str | None, pitch_mm: float | None, pitch_u_mm: float | None, made_by: Mapping[str, float | None]
) -> Provenance:
    """The provenance of an imported calibration, by the options."""
    from tvsbayes.cameras.assumed_covariance import USUAL_PITCH_MM, Provenance
    from tvsbayes.cameras.boards import Board

    # The values are checked like a board for pictures.
    pattern = Board.named(board or "9x6", USUAL_PITCH_MM if pitch_mm is None else pitch_mm, pitch_u_mm or 0.0)
    size = None if board is None else (pattern.columns, pattern.rows)
    return Provenance(board=size, pitch_mm=pitch_mm, pitch_u_mm=pitch_u_mm, **made_by)  # type: ignore[arg-type]


def _keys_by_field(keys: list[str] | None) -> dict[str, str]:
    """Names of entries by field, from --key."""
    from tvsbayes.importing.stereo import KEY_FIELDS

    names = {}
    for text in keys or []:
        field, _, name = text.partition("=")
        if field not in KEY_FIELDS or not name:
            remedy = "write --key M1=NAME, with M1, D1, M2, D2, R or T"
            raise InputError("usage", f"--key {escaped(text, 80)}: no such name", remedy=remedy)
        names[field] = name
    return names


def _imported(
    paths: list[Path], image_size: str | None, import_unit: str | None, stated: Provenance, keys: Mapping[str, str]
) -> PrintedPair:
    """A calibration of another program, or a `stereo.json`."""
    from tvsbayes.cameras.imported_calibration import read_calibration
    from tvsbayes.importing.stereo import UNITS_MM
    from tvsbayes.report.command_text import stereo_text

    unit_mm = None if import_unit is None else UNITS_MM.get(import_unit)
    if import_unit is not None and unit_mm is None:
        unit_mm = float(import_unit) if NUMBER.fullmatch(import_unit) else 0.0
        if not 0 < unit_mm <= UNITS_MM["m"]:
            allowed, remedy = "mm, cm, m or a number of mm", "write --import-unit 25 where T counts squares of 25 mm"
            raise InputError("usage", f"--import-unit {escaped(import_unit)}", allowed=allowed, remedy=remedy)
    imported = read_calibration(paths, _image_size(image_size), unit_mm=unit_mm, stated=stated, keys=keys)
    if imported.source == "tvsbayes":
        options = {"image_size": image_size, "import_unit": import_unit, "key": keys or None}
        refuse_options("for files of other programs", "leave it out: it is in this file", **options)
    remarks = [*(f"note: {note}" for note in imported.notes), *(f"warning: {warning}" for warning in imported.warnings)]
    pair = imported.stereo
    sds = [float(variance) ** 0.5 for variance in pair.parameter_covariance.diagonal()]
    values = zip(STEREO_PARAMETER_NAMES, pair.vector.tolist(), sds, strict=True)
    document: dict[str, object] = {
        **{"source": imported.source, "image_width": pair.image_width, "image_height": pair.image_height},
        "parameters": {name: {"value": value, "sd": sd} for name, value, sd in values},
        **{"rms_px": pair.rms_px, "assumed": pair.assumed, "assumed_from": pair.assumed_from},
        **{"warnings": [*imported.notes, *imported.warnings]},
    }
    return PrintedPair(pair, "\n".join([stereo_text(pair), *remarks]), document)


def _write_pair(pair: PrintedPair, places: dict[str, Path], export: Format | None, as_json: bool) -> None:
    """Write a pair to its output paths, and print the result."""
    from tvsbayes.cameras.calibration_export import exported
    from tvsbayes.instrument.stereo_pair import write_stereo

    contents = {} if export is None else exported(pair.stereo, export)
    for folder in {path.parent for path in places.values()}:
        make_folder(folder)
    for name, path in places.items():
        if name == "stereo":
            write_stereo(pair.stereo, path)
        else:
            write_atomically(path, contents[name])
    written = {name: str(path) for name, path in places.items()}
    ending = f"written: {', '.join(written.values())}" if written else "nothing written: give -o stereo.json"
    finish({**pair.document, "files": written}, f"{pair.text}\n{ending}", as_json)


def _image_size(text: str | None) -> tuple[int, int] | None:
    """Width and height from text such as 1280x720."""
    if text is None:
        return None
    width, _, height = text.lower().partition("x")
    sizes = [int(part) if part.isascii() and part.isdecimal() and len(part) < 6 else 0 for part in (width, height)]
    if not all(0 < size <= IMAGE_SIDE_MAX for size in sizes):
        raise InputError("usage", f"--image-size {escaped(text)}", allowed="WIDTHxHEIGHT", remedy="write 1280x720")
    return sizes[0], sizes[1]


def doctor(
    rig: Annotated[Path, Argument(metavar="RIG", help="Rig file.")],
    laser: Annotated[
        bool, Option("--laser", help="LASER ON for one picture, invisible and likely class 3B: goggles on.")
    ] = False,
    contract: Annotated[
        bool, Option("--contract", help="With --laser: MOTORS MOVE, LASER ON; test the contract of the drivers.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Test whether the instrument is ready for a campaign.

    Nothing moves without --contract.
    Checks ports, firmware, cameras, exposure, focus, laser, timing, disk and the compilation cache.
    """
    if contract and not laser:
        message = "--contract moves the motors and switches the laser on"
        raise InputError("usage", message, remedy="goggles on, nothing in the way, then add --laser")
    from tvsbayes.acquisition.doctor import Check, examine
    from tvsbayes.acquisition.doctor import contract as contract_checks
    from tvsbayes.instrument.rig import read_rig
    from tvsbayes.model.compilation_cache import cache_state
    from tvsbayes.results.records import plain

    instrument = read_rig(rig)
    checks = examine(instrument, Path.cwd(), laser=laser)
    if contract and any(check.status == "fault" for check in checks):
        checks.append(Check("contract", "skipped", "needs a bench without faults", "correct the faults above first"))
    elif contract:
        checks += contract_checks(instrument)
    cache = cache_state()
    status = "ok" if cache.used else "warning"
    checks.append(Check("compilation cache", status, escaped(cache.found, 400), escaped(cache.remedy, 400)))
    lines = [f"{c.status:8} {c.name}: {c.found}" + (f"; {c.remedy}" if c.remedy else "") for c in checks]
    faults = [c for c in checks if c.status == "fault"]
    error = None
    if faults:
        message = f"{plural(len(faults), 'fault')}: {', '.join(c.name for c in faults)}"
        error = DeviceFault("doctor", message, remedy=faults[0].remedy)
    finish({"checks": plain(checks)}, "\n".join(lines), as_json, error)


def export(
    folder: Annotated[Path, Argument(metavar="CAMPAIGN", help="Campaign folder.")],
    nexus: Annotated[Path, Option(help="NeXus file (HDF5) to write, such as run.nxs.")],
    as_json: Json = False,
) -> None:
    """A campaign with its journal as one file of another format. Replaces no file."""
    if serve("export", folder, nexus=nexus, as_json=as_json):
        return
    from tvsbayes.acquisition.nexus_file import write_nexus
    from tvsbayes.results.records import plain

    made = write_nexus(folder, nexus)
    text = f"{escaped(str(nexus), 200)}: {made.moves} moves, {made.looks} looks ({made.ok} ok), {made.events} events"
    finish({"nexus": str(nexus), **plain(made)}, text, as_json)
