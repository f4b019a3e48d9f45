"""`import` of a table or log into an axis folder: moves and readings, written after the columns were shown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from tvsbayes.cli.app import finish, refuse_options, write_files
from tvsbayes.cli.confirmed_import import Import, occupied
from tvsbayes.cli.understood_columns import CORRECT_HINT, column_refusal, table_document, table_lines
from tvsbayes.errors import InputError, escaped, refusal, typed
from tvsbayes.files.csv_table import CSV_BYTES_MAX, NUMBER
from tvsbayes.files.disk import make_folder, read_bytes
from tvsbayes.files.documents import toml_line
from tvsbayes.files.foreign_table import ForeignTable, read_foreign, text_of
from tvsbayes.instrument.column_names import READING_UNITS, SECONDS, unit_of_name
from tvsbayes.single_axis.axis_campaign import axis_moves_bytes, axis_templates, readings_bytes, unit_of_folder
from tvsbayes.single_axis.foreign_columns import deviation_columns, long_table, refuse_small
from tvsbayes.single_axis.foreign_readings import (
    AXIS_FIELDS,
    ForeignReadings,
    LoggedDrive,
    map_axis_columns,
    readings_of,
    unwrapped,
)
from tvsbayes.single_axis.guide_log import GuideRun, is_guide_log, read_runs, readings_of_run, run_rows
from tvsbayes.single_axis.joined_series import camonitor_table, is_camonitor, is_klipper, klipper_table

KINDS = ("csv", "phd2", "epics", "klipper")
"""Kinds of files of an axis: tables, guide logs, series logged by camonitor or Klipper."""
_LOG, _TABLES = ("phd2",), ("csv", "epics", "klipper")
KINDS_OF = {
    **{"run": _LOG, "assume": _LOG, "column": _TABLES, "deviations": _TABLES, "counts_per_turn": _TABLES},
    "sheet": ("csv",),
}
"""Kinds for which an option is."""
NEEDED = ("command", "value")
UNIT = "deg"
"""Unit of readings in the template, where no column states one."""


@dataclass(frozen=True)
class FileOptions:
    """Options for the meaning of a file of an axis.

    Attributes:
        kind: "auto" or one of `KINDS`.
        run: number of a run of a guide log.
        deviations: whether readings are actual minus commanded position.
        counts_per_turn: counts after which readings restart.
        assume: numbers that a guide log does not state, by name.
    """

    kind: str = "auto"
    run: int | None = None
    deviations: bool = False
    counts_per_turn: float | None = None
    assume: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class _ReadFile:
    """The contents of a file: lines for people, a document for programs, readings and their unit."""

    lines: list[str]
    document: dict[str, Any]
    readings: ForeignReadings
    unit: str | None


LOGS = {"phd2": "a guide log of PHD2", "epics": "a log of camonitor", "klipper": "a log of Klipper"}
"""Logs that are always of one axis, by kind."""


def log_kind(data: bytes) -> str:
    """The kind of a file of one axis: one of `LOGS`, else "csv"."""
    packed = data.startswith((b"PK\x03\x04", b"\xd0\xcf\x11\xe0", b"\x1f\x8b"))
    text = "" if packed else data.decode("utf-8-sig", errors="replace")
    recognised = {"phd2": is_guide_log(text), "epics": is_camonitor(text), "klipper": is_klipper(data)}
    return next((kind for kind, matches in recognised.items() if matches), "csv")


def refuse_log(file: Path) -> None:
    """Refuse a log of one axis where a table of a scanner or a head is meant.

    Raises:
        InputError: the file is one.
    """
    kind = log_kind(read_bytes(file, CSV_BYTES_MAX))
    if kind in LOGS:
        message = f"{escaped(file.name)} is {LOGS[kind]}, which is of one axis"
        raise InputError("usage", message, remedy="import it with --axis, and without --sightings")


def import_readings(
    file: Path, to: Path, stated: Mapping[str, str], sheet: str | None, wish: FileOptions, *, yes: bool, as_json: bool
) -> Import | None:
    """Import a table or log of an axis into a folder that is new or has only the tables of the template.

    Returns None where the runs of a log were listed instead.
    """
    data, name = read_bytes(file, CSV_BYTES_MAX), escaped(file.name)
    kind = log_kind(data) if wish.kind == "auto" else wish.kind
    _check_options(kind, wish, stated, sheet)
    if kind == "phd2":
        runs = read_runs(text_of(data, name).text, name)
        if wish.run is None and len(runs) > 1:
            _list_runs(file, to, runs, yes=yes, as_json=as_json)
            return None
        contents = _read_run(runs, file, wish)
    else:
        if kind == "epics":
            table = camonitor_table(text_of(data, name).text, name, stated)
            stated = {**stated, "time_s": "time_s", **dict(zip(NEEDED, list(table.columns)[1:], strict=True))}
        elif kind == "klipper":
            table = klipper_table(data, name)
        else:
            table = read_foreign(file, sheet)
        contents = _read_table(table, stated, wish, to)
    _refuse_filled(to)
    return _import_of(contents, to)


def _import_of(contents: _ReadFile, to: Path) -> Import:
    """The import of a file that was read."""
    table, unit = contents.readings, contents.unit
    assumed = [*table.assumed, _unit_line(to, unit), *_drive_lines(table)]
    lines = [*contents.lines, *table.notes, *(f"assumed: {text}" for text in assumed)]
    ok = sum(reading.status == "ok" for reading in table.readings)
    lines.append(f"gives: {len(table.moves)} moves, {len(table.readings)} readings{_minutes(table)}")
    document = {**contents.document, "notes": list(table.notes), "assumed": assumed, "moves": len(table.moves)}
    document |= {"readings": len(table.readings), "ok": ok, "campaign": str(to)}
    command = f"tvsbayes calibrate {typed(to)}"

    def outcome(written: list[str]) -> dict[str, Any]:
        return {"files": written, "next": command if written else None}

    return Import(lines, document, lambda: _write(to, table, unit), f"`{command}`", CORRECT_HINT, outcome)


def _minutes(readings: ForeignReadings) -> str:
    """The duration of a log, as text."""
    times = [reading.time_s for reading in readings.readings if reading.time_s is not None]
    return f" over {(times[-1] - times[0]) / 60:.1f} minutes" if times else ""


def _check_options(kind: str, opts: FileOptions, stated: Mapping[str, str], sheet: str | None) -> None:
    """Refuse options that a file of this kind would ignore."""
    given: dict[str, object] = {"run": opts.run, "assume": opts.assume or None, "column": stated or None}
    given |= {"deviations": opts.deviations, "counts_per_turn": opts.counts_per_turn, "sheet": sheet}
    refused = {name: value for name, value in given.items() if kind not in KINDS_OF[name]}
    refuse_options(f"of another kind of file: this one is read as {kind}", "leave it out, or name --format", **refused)


def _list_runs(file: Path, to: Path, runs: Sequence[GuideRun], *, yes: bool, as_json: bool) -> None:
    """Print the runs of a log, one of which can be imported.

    Raises:
        InputError: --yes without the number of a run.
    """
    from tvsbayes.report.tables import TableView

    rows = run_rows(runs)
    longest = max(rows, key=lambda row: row["minutes"])["run"]  # type: ignore[arg-type, return-value]
    command = f"tvsbayes import {typed(file)} --axis --run {longest} --to {typed(to)} --yes"
    if yes:
        found, allowed = f"{len(runs)} runs", "one run a campaign"
        remedy = f"name one: `{command}` takes the longest"
        raise refusal("usage", file=escaped(file.name), found=found, allowed=allowed, remedy=remedy)
    cells = [["" if value is None else escaped(str(value), 40) for value in row.values()] for row in rows]
    caption = f"{escaped(file.name)}: guide log of PHD2 with {len(runs)} runs, one campaign each"
    text = f"{TableView(caption, list(rows[0]), cells).text()}\nnothing written\nnext: `{command}`"
    document = {"file": escaped(file.name), "kind": "phd2", "runs": rows, "campaign": str(to), "files": []}
    finish({**document, "next": command}, text, as_json)


def _read_run(runs: Sequence[GuideRun], file: Path, options: FileOptions) -> _ReadFile:
    """One run of a guide log."""
    number = 1 if options.run is None else options.run
    if not 1 <= number <= len(runs):
        message = f"--run {number}: {escaped(file.name)} holds {len(runs)} runs; allowed: 1 to {len(runs)}"
        remedy = "leave --run and --yes out for the list"
        raise InputError("usage", message, allowed=f"1 to {len(runs)}", remedy=remedy)
    run = runs[number - 1]
    readings = readings_of_run(run, escaped(file.name), options.assume)
    (row,) = run_rows([run])
    lines = [f"{escaped(file.name)}: guide log of PHD2, run {number} of {len(runs)}, {escaped(run.mount)}"]
    lines.append(f"begins {escaped(run.begins)}, {run.minutes:.1f} minutes")
    document = {"file": escaped(file.name), "kind": "phd2", "run": row, "rows": len(run.frames) + len(run.dropped_s)}
    return _ReadFile(lines, document, readings, readings.unit)


def _read_table(table: ForeignTable, stated: Mapping[str, str], options: FileOptions, to: Path) -> _ReadFile:
    """The contents of a table, by the names of its columns and by its cells.

    Raises:
        InputError: missing or ambiguous columns, or cells that are not valid.
    """
    rows = long_table(table, stated)
    table, stated, remarks = rows.table, rows.stated, rows.remarks
    known = map_axis_columns(table.columns, stated)
    missing = [field for field in NEEDED if field not in known.columns]
    if missing or known.ambiguous:
        besides = "; or is a column actual less commanded position: --column value=NAME --deviations"
        raise column_refusal(table, known, missing, AXIS_FIELDS, NEEDED, besides * ("value" in missing))
    if not options.deviations and "value" not in stated:
        refuse_small(table, known.columns)
    deviations = {} if options.deviations else deviation_columns(table, known.columns)
    for name, text in deviations.items():
        remarks.append(f"column {escaped(name)} is {text} in every row: a deviation, no uncertainty; set aside")
    columns = {field: name for field, name in known.columns.items() if name not in deviations or field in stated}
    known = replace(known, columns=columns, unused=tuple(dict.fromkeys((*known.unused, *deviations))))
    readings = readings_of(table, known.columns, options.deviations)
    unit = readings.unit or unit_of_name(known.columns["value"], READING_UNITS)
    cells = [cell for cell in table.columns[known.columns["value"]] if cell]
    numbers = [float(cell) for cell in cells if NUMBER.fullmatch(cell)]
    if unit is None and numbers and all(n.is_integer() for n in numbers) and max(numbers) - min(numbers) > 360:
        unit = "counts"
        remarks.append("unit: whole numbers over more than 360, so counts; `unit` in campaign.toml says another")
    readings = unwrapped(readings, unit_of_folder(to) or unit or UNIT, options.counts_per_turn)
    readings = replace(readings, assumed=(*remarks, *readings.assumed))

    def unit_shown(field: str, name: str) -> str:
        return unit_of_name(name, SECONDS) or "s" if field == "time_s" else ""

    return _ReadFile(table_lines(table, known, AXIS_FIELDS, unit_shown), table_document(table, known), readings, unit)


def _drive_lines(readings: ForeignReadings) -> list[str]:
    """Entries of campaign.toml for a drive at constant rate, as lines."""
    drive = readings.drive
    if drive is None:
        return []
    lines = [f"campaign.toml: {name} = {{ value = {v:g}, u = {u:g} }}" for name, (v, u) in drive.priors.items()]
    if drive.period_between is None:
        return [*lines, "too short a run to look for a period; state `periods` in campaign.toml where one is known"]
    low, high = drive.period_between
    lines.append(
        f"campaign.toml: period_between = [{low:g}, {high:g}] s, a minute to a third of the run; change it there"
    )
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


def _write(to: Path, rows: ForeignReadings, unit: str | None) -> list[str]:
    """Write the tables and last the commented campaign.toml; `unit` is that of the column."""
    contents = {"moves.csv": axis_moves_bytes(rows.moves), "readings.csv": readings_bytes(rows.readings)}
    if not (to / "campaign.toml").is_file():
        make_folder(to, empty=True)
        template = axis_templates()["campaign.toml"]
        stated = unit or UNIT
        template = template.replace(f'\nunit = "{UNIT}"'.encode(), f'\nunit = "{stated}"'.encode())
        contents["campaign.toml"] = template if rows.drive is None else _with_drive(template, rows.drive)
    return write_files(to, contents)


def _with_drive(template: bytes, drive: LoggedDrive) -> bytes:
    """The commented campaign.toml of a drive at constant rate."""
    header = "\n".join(toml_line(key, value) for key, value in {"rate": drive.rate, **drive.header}.items())
    priors = {name: {"value": value, "u": u} for name, (value, u) in drive.priors.items()}
    axis = [toml_line(name, entry) for name, entry in priors.items()]
    if drive.period_between is not None:
        axis += [toml_line("periods_in", "seconds"), toml_line("period_between", list(drive.period_between))]
    text = template.decode().replace('\nname = "my axis"\n', f"\n{header}\n")
    return text.replace("\n[axis]\n", "\n[axis]\n" + "\n".join(axis) + "\n").encode()
