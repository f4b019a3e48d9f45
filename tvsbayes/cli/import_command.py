"""`import`: a user's table becomes moves and looks, written after its columns were shown.

Reads options, calls the library, prints a table or JSON; heavy imports are inside the command.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tvsbayes.cli.app import Json, check_word, is_interactive, refuse_options
from tvsbayes.cli.begin_commands import stated_globs
from tvsbayes.cli.confirmed_import import Import
from tvsbayes.cli.instruments import INSTRUMENTS, instrument_of, serve
from tvsbayes.errors import InputError, Reason, closest, escaped, typed
from tvsbayes.files.csv_table import CSV_BYTES_MAX, NUMBER
from tvsbayes.files.disk import read_bytes, write_folder
from tvsbayes.instrument.axes import sides_of

if TYPE_CHECKING:
    from tvsbayes.instrument.corrections import Correction

COPY, URDF, POINTING, AXIS, SIGHTINGS, LOOKS = "copy", "urdf", "pointing", "axis", "sightings", "looks"
"""Kinds of files; --format names that of a telescope's table."""
ENCODERS = ("output", "motor", "incremental")
OF_ROWS = {
    **{"coverage": "factor of u", "status_ok": "good status", "no_reading": "none read", "command_turn": "0: none"},
    "deviation_sign": "-1: commanded less actual",
}
"""What --assume may state of the rows of an axis' table."""
ANGLE_UNITS = ("deg", "rad", "mrad", "gon", "arcmin", "arcsec")
KINDS_OF: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("column", "sheet"), (AXIS, SIGHTINGS, LOOKS)),
    **{"pixels_from": (COPY, LOOKS), "angles": (SIGHTINGS, LOOKS), "sd_px": (LOOKS,)},
    **{"axis": (AXIS,), "sightings": (SIGHTINGS,), "kind": (POINTING, AXIS), "encoders": (POINTING, AXIS, SIGHTINGS)},
    **dict.fromkeys(("run", "runs", "unit", "deviations", "counts_per_turn"), (AXIS,)),
    "assume": (AXIS, SIGHTINGS),
    **dict.fromkeys(("flip", "shift_moves"), (COPY, SIGHTINGS, LOOKS)),
    "relative": (COPY, AXIS, SIGHTINGS, LOOKS),
    "swap": (COPY, LOOKS),
    **dict.fromkeys(("pictures", "left", "right"), (LOOKS,)),
    **dict.fromkeys(("pan_approach", "tilt_approach"), (SIGHTINGS, LOOKS)),
    **dict.fromkeys(("urdf", "pan_joint", "tilt_joint", "steps_per_turn"), (URDF,)),
}
"""Kinds of files for which an option is, by the name of its parameter; --to, --yes and --json are for all."""


def import_(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="Table of moves and looks: CSV, XLSX; a campaign to correct.")
    ],
    to: Annotated[Path, typer.Option("--to", help="Campaign folder, new or still without these tables.")],
    column: Annotated[
        list[str] | None, typer.Option("--column", help="FIELD=NAME: which column it is, u_left_px=XL; repeatable.")
    ] = None,
    unit: Annotated[
        list[str] | None, typer.Option("--unit", help="Of an axis: FIELD=UNIT, value=um, u=1/100 mm; repeatable.")
    ] = None,
    sheet: Annotated[str | None, typer.Option("--sheet", help="Of a workbook (default: first with cells).")] = None,
    pixels_from: Annotated[
        int, typer.Option("--pixels-from", min=0, max=1, help="Number of the first pixel: 0, or 1 as in MATLAB.")
    ] = 0,
    angles: Annotated[
        str | None, typer.Option("--angles", help="deg, rad ...: of aperture readings, sightings (default: by name).")
    ] = None,
    sd_px: Annotated[
        float | None, typer.Option("--sd-px", min=1e-4, max=100.0, help="Of centroids, where no column has it: 0.1.")
    ] = None,
    axis: Annotated[bool, typer.Option("--axis", help="Of one axis: commands and readings.")] = False,
    sightings: Annotated[
        bool, typer.Option("--sightings", help="Of a head: counters or encoders, and where it was found to point.")
    ] = False,
    kind: Annotated[
        str,
        typer.Option("--format", help="auto, pointing (telescope); of an axis csv, phd2 (KStars), epics, klipper, pe."),
    ] = "auto",
    encoders: Annotated[
        str | None,
        typer.Option(
            "--encoders",
            help="Where commands are angles of encoders: output (absolute, on the axis), motor (absolute, before the "
            "gears), incremental.",
        ),
    ] = None,
    run: Annotated[int | None, typer.Option("--run", min=1, help="Of a guide log: run; without it a list.")] = None,
    runs: Annotated[
        str | None,
        typer.Option("--runs", help="Of runs side by side: forward, alternate, or repeats (readings of one stop)."),
    ] = None,
    deviations: Annotated[
        bool | None,
        typer.Option("--deviations/--positions", help="Of an axis: readings are actual less commanded position."),
    ] = None,
    counts_per_turn: Annotated[
        float | None,
        typer.Option("--counts-per-turn", min=0.0, max=1e12, help="Of an axis: where readings restart; 0: nowhere."),
    ] = None,
    assume: Annotated[
        list[str] | None,
        typer.Option("--assume", help="NAME=NUMBER that a file does not state, as u_deg=0.01; repeatable."),
    ] = None,
    relative: Annotated[
        bool, typer.Option("--relative", help="Counters or commands are the lengths of moves.")
    ] = False,
    flip: Annotated[
        list[str] | None, typer.Option("--flip", help="pan_steps or tilt_steps: write the other sign; repeatable.")
    ] = None,
    shift_moves: Annotated[
        list[str] | None,
        typer.Option("--shift-moves", help="N or N@SPOT: add N to the move of all looks, or from a spot on."),
    ] = None,
    swap: Annotated[bool, typer.Option("--swap", help="Exchange the centres of left and right.")] = False,
    pan_approach: Annotated[
        str, typer.Option("--pan-approach", help="How pan came to the first row: left, right or unknown.")
    ] = "unknown",
    tilt_approach: Annotated[str, typer.Option("--tilt-approach", help="Likewise up, down or unknown.")] = "unknown",
    pictures: Annotated[
        Path | None, typer.Option("--pictures", help="Of a lab book: folder of the pictures that it names.")
    ] = None,
    left: Annotated[
        str | None, typer.Option("--left", help='Of its pictures those of the left camera: "a/*.png".')
    ] = None,
    right: Annotated[str | None, typer.Option("--right", help="Likewise of the right camera.")] = None,
    urdf: Annotated[bool, typer.Option("--urdf", help="FILE is a URDF: nominal geometry of a pan-tilt head.")] = False,
    pan_joint: Annotated[
        str | None, typer.Option("--pan-joint", help="Of a URDF: the joint about the vertical (default: by its name).")
    ] = None,
    tilt_joint: Annotated[str | None, typer.Option("--tilt-joint", help="Of a URDF: the joint on it.")] = None,
    steps_per_turn: Annotated[
        float | None, typer.Option("--steps-per-turn", min=1.0, max=1e9, help="Of a URDF: counts of a motor's turn.")
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Write without asking.")] = False,
    as_json: Json = False,
) -> None:
    """A table of your own into a campaign. Shows what it understood, then asks; overwrites nothing.

    A campaign folder as FILE: a copy, corrected by the options that change its tables.
    """
    options = locals()
    from tvsbayes.importing.cells import Wishes
    from tvsbayes.instrument.corrections import Correction, flipped_axis, shift_of

    o = SimpleNamespace(**options)
    approach = (o.pan_approach, o.tilt_approach)
    check_word("--angles", o.angles, ANGLE_UNITS, "write --angles deg or --angles rad")
    check_word("--encoders", o.encoders, ENCODERS, f"write one of {', '.join(ENCODERS)}")
    sides_of(approach)
    example = "u_left_px=XL; --column target= where the table has none"
    stated = dict(_named("--column", text, example) for text in o.column or ())
    wishes = Wishes(stated, angle_unit=o.angles, relative=o.relative, approach=approach)
    flipped = tuple(dict.fromkeys(map(flipped_axis, o.flip or ())))
    correction = Correction(flipped, tuple(map(shift_of, o.shift_moves or ())), o.swap)
    task: Import | None
    kind_of_file = _kind_of_file(o.file, o.to, options)
    _refuse_others(kind_of_file, options)
    if kind_of_file in (SIGHTINGS, LOOKS):
        from tvsbayes.cli.axis_import import refuse_log

        refuse_log(o.file)
    if kind_of_file == COPY:
        wanted = replace(correction, pixels_from=o.pixels_from, relative=o.relative)
        task = _corrected_campaign(o.file, o.to, wanted, options)
    elif kind_of_file == URDF:
        from tvsbayes.cli.head_commands import import_urdf

        task = import_urdf(o.file, o.to, {"pan": o.pan_joint, "tilt": o.tilt_joint}, o.steps_per_turn)
    elif kind_of_file == POINTING:
        task = _pointing_table(o.file, o.to, o.encoders)
    elif kind_of_file == AXIS:
        from tvsbayes.cli.axis_import import KINDS, FileOptions, import_readings
        from tvsbayes.importing.guide import ASSUMPTIONS
        from tvsbayes.importing.runs import ORDERS

        check_word("--format", o.kind, ("auto", *KINDS), closest(o.kind, KINDS, "leave it out: it is in the file"))
        check_word("--runs", o.runs, ORDERS, f"write one of {', '.join(ORDERS)}")
        assumed = _assumptions(o.assume, {**ASSUMPTIONS, **OF_ROWS}, "declination_deg=45.9")
        units = dict(_named("--unit", text, "value=um") for text in o.unit or ())
        of_axis: dict[str, Any] = {
            "deviations": o.deviations,
            "counts_per_turn": o.counts_per_turn,
            "order": o.runs,
            "units": units,
        }
        of_axis |= {name: number for name, number in assumed.items() if name in OF_ROWS}
        wishes = replace(wishes, **of_axis)
        wish = FileOptions(o.kind, o.run, assumed, o.encoders, wishes)
        task = import_readings(o.file, o.to, o.sheet, wish, yes=o.yes, as_json=o.as_json)
    elif kind_of_file == SIGHTINGS:
        from tvsbayes.cli.head_commands import import_sightings

        u_deg = _assumptions(o.assume, {"u_deg": "standard uncertainty"}, "u_deg=0.005").get("u_deg")
        wishes = replace(wishes, u_deg=u_deg)
        task = import_sightings(o.file, o.to, o.sheet, wishes, correction, o.encoders)
    else:
        from tvsbayes.cli.looks_import import import_looks

        interactive = not (o.yes or o.as_json) and is_interactive()
        sd_px = wishes.sd_px if o.sd_px is None else o.sd_px
        wishes = replace(wishes, pixels_from=o.pixels_from, sd_px=sd_px, pictures=o.pictures is not None)
        globs = stated_globs(o.left, o.right, False)
        if o.pictures is None:
            refuse_options("for pictures", "add --pictures FOLDER, or leave it out", left=o.left, right=o.right)
        task = import_looks(o.file, o.to, o.sheet, wishes, correction, o.pictures, globs, interactive)
    if task is not None:
        task.carry_out(o.to, o.yes, o.as_json)


def _kind_of_file(file: Path, to: Path, options: Mapping[str, Any]) -> str:
    """What FILE is, by itself, by the options and by the campaign that it goes to."""
    if file.is_dir():
        return COPY
    if options["urdf"]:
        return URDF
    if options["kind"] == POINTING:
        return POINTING
    if options["axis"] or instrument_of(to) is INSTRUMENTS["axis"]:
        return AXIS
    if options["sightings"] or instrument_of(to) is INSTRUMENTS["pan-tilt-sightings"]:
        return SIGHTINGS
    return LOOKS


def _refuse_others(kind_of_file: str, options: Mapping[str, Any]) -> None:
    """Refuse given options that this kind of file would ignore.

    Raises:
        InputError: such an option differs from its default.
    """
    parameters = inspect.signature(import_).parameters
    refused: dict[Reason, dict[str, object]] = {}
    for name, kinds in KINDS_OF.items():
        if kind_of_file not in kinds and options[name] != parameters[name].default:
            shown = "format" if name == "kind" else name
            refused.setdefault(_why_refused(kind_of_file, name), {})[shown] = options[name]
    for why, given in refused.items():
        refuse_options(why.reason, why.remedy, **given)


def _why_refused(kind_of_file: str, option: str) -> Reason:
    """Why an option that this kind of file would ignore is refused."""
    remedy = "leave it out"
    if kind_of_file == COPY:
        return Reason("for tables of other programs, and FILE is a folder", remedy)
    if KINDS_OF[option] == (URDF,):
        return Reason("for a URDF", "add --urdf, or leave it out")
    if kind_of_file in (URDF, POINTING):
        return Reason("for other tables", remedy)
    if kind_of_file == AXIS:
        machine = "a head" if option == "sightings" else "a scanner"
        return Reason(f"for {machine}, and this is an axis folder", remedy)
    if option == "assume":
        return Reason("for a guide log or sightings", "add --axis or --sightings, or leave it out")
    if AXIS in KINDS_OF[option]:
        return Reason("for files of an axis", "add --axis, or leave it out")
    return Reason("for spots in pictures, and these are sightings", remedy)


def _pointing_table(file: Path, to: Path, encoders: str | None) -> Import:
    """Import a pointing table of a telescope as a campaign of sightings."""
    from tvsbayes.cli.head_commands import INCREMENTAL
    from tvsbayes.head.pointing_table import U_ARCSEC, campaign_of, read_stars
    from tvsbayes.importing.sightings import STEP_DEG
    from tvsbayes.instrument.campaign import write_campaign

    table = read_stars(file)
    campaign = campaign_of(table.stars, file.stem, encoders=encoders)
    moves, sightings = len(campaign.moves), len(campaign.spots)
    assumed = [
        f"counters are the encoders' degrees in steps of {STEP_DEG:g} deg, whose scale is known to 1e-6",
        "the azimuth axis is on the turn of the star's azimuth, and came to the first from an unknown side",
        f"a star's place is known to {U_ARCSEC:g} arcsec; refraction is as the table has it",
        "no transmission error and no play of more than arcseconds: state another scale in [rig.prior]",
    ]
    if encoders is None:
        assumed.append(INCREMENTAL)
    if table.left_out:
        assumed.append(f"{table.left_out} blocks without RAA:, TAA: or LST: are no pointings")
    lines = [f"gives: {moves} moves, {sightings} sightings", *(f"assumed: {text}" for text in assumed)]
    document = {"campaign": str(to), "moves": moves, "sightings": sightings, "assumed": assumed}

    def write() -> list[str]:
        write_campaign(campaign, to)
        return [escaped(str(to), 200)]

    next_step = f"`tvsbayes check {typed(to)}`"
    return Import(lines, document, write, next_step, outcome=lambda written: {"written": bool(written)})


def _named(option: str, text: str, example: str) -> tuple[str, str]:
    """Split FIELD=NAME."""
    name, sign, value = text.partition("=")
    if not sign:
        remedy = f"write {option} {example}"
        raise InputError("usage", f"{option} {escaped(text)}: no =", allowed="FIELD=NAME", remedy=remedy)
    return name.strip(), value.strip()


def _assumptions(texts: list[str] | None, known: Mapping[str, str], example: str) -> dict[str, float]:
    """The values of --assume NAME=NUMBER; `known` holds the names with their meanings."""
    assumed = {}
    for text in texts or ():
        name, _, number = (part.strip() for part in text.partition("="))
        if name not in known or not NUMBER.fullmatch(number):
            allowed = ", ".join(f"{key}=NUMBER ({meaning})" for key, meaning in known.items())
            message, remedy = f"--assume {escaped(text)}; allowed: {allowed}", f"write --assume {example}"
            raise InputError("usage", message, allowed=allowed, remedy=remedy)
        assumed[name] = float(number)
    return assumed


def _corrected_campaign(folder: Path, to: Path, correction: Correction, options: Mapping[str, Any]) -> Import:
    """Write a copy of a campaign with corrected tables; other files of its folder are not copied."""
    from tvsbayes.cli.head_commands import HEAD_URDF
    from tvsbayes.instrument.campaign import looks_bytes, moves_bytes, read_campaign
    from tvsbayes.instrument.corrections import Correction, corrected

    serve("import", folder)
    if correction == Correction():
        remedy = "say what to correct: --flip, --shift-moves, --swap, --pixels-from 1, --relative"
        raise InputError("usage", f"{escaped(str(folder), 200)} is a campaign already", remedy=remedy)
    campaign = read_campaign(folder)
    if campaign.rig.mechanism.sightings:
        _refuse_others(SIGHTINGS, options)
    changed = corrected(campaign.moves, campaign.spots, correction)
    moves, spots = changed.moves or (), changed.spots or ()
    campaign = replace(campaign, moves=moves, spots=spots)
    ok = sum(spot.status == "ok" for spot in spots)
    lines = [f"corrected: {text}" for text in changed.changes]
    lines.append(f"gives: {len(moves)} moves, {len(spots)} looks, {ok} of use")
    document = {"assumed": list(changed.changes), "moves": len(moves), "spots": len(spots), "ok": ok}

    def write() -> list[str]:
        copied = [name for name in ("campaign.toml", "stereo.json", HEAD_URDF) if (folder / name).is_file()]
        contents = {name: read_bytes(folder / name, CSV_BYTES_MAX, folder) for name in copied}
        contents |= {"moves.csv": moves_bytes(moves), campaign.looks_table.file: looks_bytes(campaign)}
        return write_folder(to, contents)

    return Import(lines, document | {"campaign": str(to)}, write, f"`tvsbayes check {typed(to)}`")
