"""`import` of a table or log into an axis folder: moves and readings, written after the columns were shown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from tvsbayes.cli.app import finish, refuse_options, write_files
from tvsbayes.cli.confirmed_import import Import, occupied
from tvsbayes.errors import InputError, escaped, refusal, typed
from tvsbayes.files.csv_table import CSV_BYTES_MAX
from tvsbayes.files.disk import make_folder, read_bytes, write_folder
from tvsbayes.files.documents import toml_line
from tvsbayes.importing.asking import asked
from tvsbayes.importing.axis import AxisRows, axis_rows
from tvsbayes.importing.cells import Wishes
from tvsbayes.importing.guide import (
    GuideRun,
    is_guide_log,
    is_periodic_error,
    periodic_error_rows,
    read_runs,
    rows_of_run,
    run_rows,
)
from tvsbayes.importing.reader import read_foreign
from tvsbayes.importing.series import epics_table, is_archive, is_camonitor, is_klipper, klipper_table
from tvsbayes.importing.table import WORKBOOKS, ForeignTable
from tvsbayes.importing.text import text_of
from tvsbayes.single_axis.axis_campaign import (
    AXIS_MOVES,
    READINGS,
    AxisMove,
    Reading,
    axis_templates,
    unit_of_folder,
)

LOGS = {
    "phd2": "a guide log of PHD2, KStars or MaxIm",
    "epics": "a log of EPICS",
    "klipper": "a log of Klipper",
    "pe": "a table of times and periodic errors",
}
"""Logs that are always of one axis, by kind."""
KINDS = ("csv", *LOGS)
_TABLES = ("csv", "epics", "klipper")
KINDS_OF = {
    **{"run": ("phd2",), "assume": KINDS, "column": _TABLES, "unit": _TABLES, "deviations": ("csv",)},
    "encoders": _TABLES,
    **{"runs": ("csv",), "relative": ("csv",), "counts_per_turn": _TABLES, "sheet": ("csv", "pe")},
}
"""Kinds for which an option is."""
_NONE = {"value": 0.0, "u": 0.0}
ENCODER_ENTRIES: dict[str, dict[str, Any]] = {
    "motor": {"absolute": True},
    "output": {"absolute": True, "backlash": _NONE, "play_variation": _NONE, "ratio_contrast": _NONE},
}
"""Entries of `[axis]` where commands are angles of an absolute encoder: one on the axis itself sees no play."""
UNIT = "deg"
"""Unit of readings in the template, where no column states one."""


@dataclass(frozen=True)
class FileOptions:
    """Options for the meaning of a file of an axis.

    Attributes:
        kind: "auto" or one of `KINDS`.
        run: number of a run of a guide log.
        assume: numbers that the file does not state, by name.
        encoders: where commands are angles of an encoder, "output", "motor" or "incremental".
        table: what is stated of a table.
    """

    kind: str = "auto"
    run: int | None = None
    assume: Mapping[str, float] = field(default_factory=dict)
    encoders: str | None = None
    table: Wishes = field(default_factory=Wishes)


def log_kind(data: bytes, file: str) -> str:
    """The kind of a file of one axis by its content: one of `LOGS`, else "csv"."""
    packed = data.startswith(WORKBOOKS) or data.startswith(b"\x1f\x8b")
    text = "" if packed or is_klipper(data) else text_of(data, file).text
    recognised = {
        "phd2": is_guide_log(text),
        "epics": is_camonitor(text) or is_archive(text),
        "klipper": is_klipper(data),
    }
    return next((kind for kind, matches in recognised.items() if matches), "csv")


def refuse_log(file: Path) -> None:
    """Refuse a log of one axis where a table of a scanner or a head is meant.

    Raises:
        InputError: the file is one.
    """
    kind = log_kind(read_bytes(file, CSV_BYTES_MAX), escaped(file.name))
    if kind in LOGS:
        message = f"{escaped(file.name)} is {LOGS[kind]}, which is of one axis"
        raise InputError("usage", message, remedy="import it with --axis, and without --sightings")


def import_readings(
    file: Path, to: Path, sheet: str | None, wish: FileOptions, *, yes: bool, as_json: bool
) -> Import | None:
    """Import a table or log of an axis into a folder that is new or has only the tables of the template.

    Returns None where the runs of a log were listed instead.
    """
    data, name, stated = read_bytes(file, CSV_BYTES_MAX), escaped(file.name), wish.table.columns
    kind = log_kind(data, name) if wish.kind == "auto" else wish.kind
    if kind == "phd2":
        _check_options(kind, wish, sheet)
        runs = read_runs(text_of(data, name).text, name, wish.assume.get("ra_axis"))
        if wish.run is None and len(runs) > 1:
            _list_runs(file, to, runs, yes=yes, as_json=as_json)
            return None
        rows, lines, document = _run_of(runs, file, wish)
    else:
        table, text = _table(kind, data, file, sheet, stated)
        if kind == "csv" and not stated and text and is_periodic_error(text, table):
            kind = "pe"
        _check_options(kind, wish, sheet)
        if kind == "pe":
            rows = periodic_error_rows(table, text, wish.assume)
            lines = [f"{table.file}: {table.kind}; {len(table)} rows, {LOGS[kind]}"]
            document = {"file": table.file, "kind": kind, "rows": len(table)}
        else:
            named = (
                dict(zip(("command", "value"), list(table.columns)[1:], strict=True))
                if kind in ("epics", "klipper") and "time_s" in table.columns
                else {}
            )
            rows = axis_rows(table, replace(wish.table, columns={**stated, **named}), unit_of_folder(to))
            rows = replace(rows, axis={**rows.axis, **ENCODER_ENTRIES.get(wish.encoders or "", {})})
            lines, document = list(rows.lines), dict(rows.document)
    _refuse_filled(to)
    return _import_of(rows, lines, document, to)


def _table(
    kind: str, data: bytes, file: Path, sheet: str | None, stated: Mapping[str, str]
) -> tuple[ForeignTable, str]:
    """The table of a file, and its text where it has one."""
    name = escaped(file.name)
    if kind == "klipper":
        return klipper_table(data, name), ""
    if kind == "epics":
        return epics_table(text_of(data, name).text, name, stated), ""
    return read_foreign(file, sheet), "" if data.startswith(WORKBOOKS) else text_of(data, name).text


def _import_of(rows: AxisRows, lines: Sequence[str], document: Mapping[str, Any], to: Path) -> Import:
    """The import of a file that was read."""
    assumed = [*rows.assumed, _unit_line(to, rows.unit), *_axis_lines(rows)]
    lines = [*lines, *rows.notes, *(f"assumed: {text}" for text in assumed)]
    ok = sum(reading["status"] == "ok" for reading in rows.readings)
    times = [reading["time_s"] for reading in rows.readings if "time_s" in reading]
    over = f" over {(times[-1] - times[0]) / 60:.1f} minutes" if times else ""
    lines.append(f"gives: {len(rows.moves)} moves, {len(rows.readings)} readings{over}")
    document = {**document, "notes": list(rows.notes), "assumed": assumed, "moves": len(rows.moves)}
    document |= {"readings": len(rows.readings), "ok": ok, "campaign": str(to)}
    command = f"tvsbayes calibrate {typed(to)}"

    def outcome(written: list[str]) -> dict[str, Any]:
        return {"files": written, "next": command if written else None}

    hint = ", or correct it with --column, --unit"
    return Import(lines, document, lambda: _write(to, rows), f"`{command}`", hint, outcome)


def _check_options(kind: str, opts: FileOptions, sheet: str | None) -> None:
    """Refuse options that a file of this kind would ignore."""
    table = opts.table
    given: dict[str, object] = {"run": opts.run, "column": table.columns or None, "unit": table.units or None}
    given |= {"deviations": table.deviations, "counts_per_turn": table.counts_per_turn, "sheet": sheet}
    given |= {"runs": table.order, "encoders": opts.encoders, "relative": table.relative or None}
    refused = {name: value for name, value in given.items() if kind not in KINDS_OF[name]}
    refuse_options(f"of another kind of file: this one is read as {kind}", "leave it out, or name --format", **refused)


def _list_runs(file: Path, to: Path, runs: Sequence[GuideRun], *, yes: bool, as_json: bool) -> None:
    """Print the runs of a log, one of which can be imported.

    Raises:
        Question: --yes without the number of a run.
    """
    from tvsbayes.report.tables import TableView

    rows = run_rows(runs)
    longest = max(rows, key=lambda row: row["minutes"])["run"]
    if yes:
        longest_first = sorted(rows, key=lambda row: -row["minutes"])
        raise asked("run", escaped(file.name), each=longest_first, count=len(runs))
    command = f"tvsbayes import {typed(file)} --axis --run {longest} --to {typed(to)} --yes"
    cells = [["" if value is None else escaped(str(value), 40) for value in row.values()] for row in rows]
    caption = f"{escaped(file.name)}: guide log of {runs[0].program} with {len(runs)} runs, one campaign each"
    text = f"{TableView(caption, list(rows[0]), cells).text()}\nnothing written\nnext: `{command}`"
    document = {"file": escaped(file.name), "kind": "phd2", "runs": rows, "campaign": str(to), "files": []}
    finish({**document, "next": command}, text, as_json)


def _run_of(runs: Sequence[GuideRun], file: Path, options: FileOptions) -> tuple[AxisRows, list[str], dict[str, Any]]:
    """One run of a guide log, with what is shown of it."""
    number = 1 if options.run is None else options.run
    if not 1 <= number <= len(runs):
        message = f"--run {number}: {escaped(file.name)} holds {len(runs)} runs; allowed: 1 to {len(runs)}"
        remedy = "leave --run and --yes out for the list"
        raise InputError("usage", message, allowed=f"1 to {len(runs)}", remedy=remedy)
    run = runs[number - 1]
    rows = rows_of_run(run, runs, escaped(file.name), options.assume)
    (row,) = run_rows([run])
    mount = escaped(row["mount"])
    lines = [f"{escaped(file.name)}: guide log of {run.program}, run {number} of {len(runs)}, {mount}"]
    lines.append(f"begins {escaped(run.begins)}, {row['minutes']:.1f} minutes")
    document = {"file": escaped(file.name), "kind": "phd2", "run": row, "rows": len(run.rows)}
    return rows, lines, document


def _axis_lines(rows: AxisRows) -> list[str]:
    """Entries of campaign.toml that the file gives, as lines."""
    lines = [f"campaign.toml: {toml_line(name, value)}" for name, value in rows.axis.items()]
    if rows.header.keys() == {"created"}:
        lines.append(f"campaign.toml: {toml_line('created', rows.header['created'])}")
    lines += [f"campaign.toml: [reference] {toml_line(name, value)}" for name, value in rows.reference.items()]
    if "rate" in rows.header and not {"period_between", "periods"} & rows.axis.keys():
        lines.append("too short a run to look for a period; state `periods` in campaign.toml where one is known")
    return lines


def _unit_line(to: Path, unit: str | None) -> str:
    """The unit of the results, as a line, so that a reading in mm is not reported in degrees."""
    has_header = (to / "campaign.toml").is_file()
    if unit and not has_header:
        return f"unit: {unit}, as the file says; it goes into campaign.toml"
    note = f"; the column says {unit}" if unit else ""
    return f"unit: of readings as campaign.toml says{'' if has_header else f', {UNIT} until you change it'}{note}"


def _refuse_filled(to: Path) -> None:
    """Refuse a folder with tables that have rows: nothing is overwritten."""
    if not (to / "campaign.toml").is_file():
        if to.exists():
            make_folder(to, empty=True)
        return
    for name, template in axis_templates().items():
        path = to / name
        if name.endswith(".csv") and path.is_file() and path.read_bytes() != template:
            raise occupied(path)


def _write(to: Path, rows: AxisRows) -> list[str]:
    """Write the tables and last the commented campaign.toml."""
    # Another import may have filled it since the question.
    _refuse_filled(to)
    moves = [AxisMove(**row) for row in rows.moves]
    readings = [Reading(**row) for row in rows.readings]
    contents = {"moves.csv": AXIS_MOVES.content(moves), "readings.csv": READINGS.content(readings)}
    if not (to / "campaign.toml").is_file():
        return write_folder(to, contents | {"campaign.toml": _header(rows)})
    return write_files(to, contents)


def _header(rows: AxisRows) -> bytes:
    """The commented campaign.toml with the entries that the file gives.

    Raises:
        InputError: a unit that is too long to be one.
    """
    unit = rows.unit or UNIT
    if len(unit) > 20:
        raise refusal("unit", file="--unit", found=escaped(unit), allowed="at most 20 characters", remedy="shorten it")
    text = axis_templates()["campaign.toml"].decode()
    text = text.replace(f'\nunit = "{UNIT}"', f"\n{toml_line('unit', unit)}")
    if rows.header:
        name = '\nname = "my axis"\n'
        entries = "\n".join(toml_line(k, v) for k, v in rows.header.items())
        text = text.replace(name, f"\n{entries}\n" if "name" in rows.header else f"{name}{entries}\n")
    if rows.axis:
        text = text.replace(
            "\n[axis]\n", "\n[axis]\n" + "\n".join(toml_line(k, v) for k, v in rows.axis.items()) + "\n"
        )
    if rows.reference:
        entries = "\n".join(toml_line(k, v) for k, v in rows.reference.items())
        text = text.replace("\n# [reference]\n", f"\n[reference]\n{entries}\n")
    return text.encode()
