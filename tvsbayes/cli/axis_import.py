"""`import` of a table into an axis folder: moves and readings, after what was understood has been shown."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from tvsbayes.cli.app import finish, somebody_there
from tvsbayes.cli.understood_columns import not_sure, table_document, table_lines
from tvsbayes.errors import escaped, refusal, typed
from tvsbayes.files.disk import make_folder, write_atomically

if TYPE_CHECKING:
    from tvsbayes.single_axis.foreign_readings import ForeignReadings

NEEDED = ("command", "value")
UNIT = "deg"
"""Of readings in the template, where no column names one."""


def import_readings(
    file: Path, to: Path, stated: Mapping[str, str], sheet: str | None, *, yes: bool, as_json: bool
) -> None:
    """A table of an axis into its folder, new or still with the tables of the template."""
    from tvsbayes.files.foreign_table import read_foreign
    from tvsbayes.instrument.column_names import READING_UNITS, SECONDS, unit_of_name
    from tvsbayes.single_axis.axis_campaign import unit_of_folder
    from tvsbayes.single_axis.foreign_readings import AXIS_FIELDS, readings_of, understand_axis, unwrapped

    table = read_foreign(file, sheet)
    known = understand_axis(table.columns, stated)
    missing = [field for field in NEEDED if field not in known.columns]
    if missing or known.claimed:
        raise not_sure(table, known, [*missing, *(f for f in known.claimed if f not in missing)], AXIS_FIELDS, NEEDED)
    _refuse_filled(to)
    named = unit_of_name(known.columns["value"], READING_UNITS)
    found = unwrapped(readings_of(table, known.columns), unit_of_folder(to) or named or UNIT)

    def unit(field: str, name: str) -> str:
        return unit_of_name(name, SECONDS) or "s" if field == "time_s" else ""

    told = _unit_told(to, named)
    lines = table_lines(table, known, AXIS_FIELDS, unit)
    lines += [f"assumed: {text}" for text in (*found.assumed, told)]
    shown = "\n".join([*lines, f"gives: {len(found.moves)} moves, {len(found.readings)} readings"])
    if not (yes or as_json) and somebody_there():
        typer.echo(shown)
        yes = typer.confirm(f"write this into {escaped(str(to), 200)}?", default=False)
        shown = ""
    written = _write(to, found, named) if yes else []
    document = {**table_document(table, known), "assumed": [*found.assumed, told], "moves": len(found.moves)}
    ok = sum(reading.status == "ok" for reading in found.readings)
    document |= {"readings": len(found.readings), "ok": ok, "campaign": str(to), "files": written}
    said = f"written: {', '.join(written)}" if written else "nothing written: add --yes, or correct it with --column"
    place = escaped(str(to), 200)
    after = f"\nnext: `unit` and `[axis]` in {place}/campaign.toml, then `tvsbayes check {typed(to)}`" * bool(written)
    finish(document, f"{shown}\n{said}{after}".lstrip("\n"), as_json)


def _unit_told(to: Path, named: str | None) -> str:
    """Which unit results will have: a reading in mm must not be reported in degrees."""
    kept = (to / "campaign.toml").is_file()
    if named and not kept:
        return f"unit: {named}, as the column says; it goes into campaign.toml"
    says = f"; the column says {named}" if named else ""
    return f"unit: of readings as campaign.toml says{'' if kept else f', {UNIT} until you change it'}{says}"


def _refuse_filled(to: Path) -> None:
    """Nothing is overwritten: a table goes only where none is."""
    from tvsbayes.single_axis.axis_campaign import axis_templates

    if not (to / "campaign.toml").is_file():
        if to.exists():
            make_folder(to, empty=True)
        return
    for name, template in axis_templates().items():
        place = to / name
        if name.endswith(".csv") and place.is_file() and place.read_bytes() != template:
            allowed, remedy = "no rows yet", "name another folder with --to; nothing is overwritten"
            raise refusal("occupied", file=escaped(str(place), 200), found="rows", allowed=allowed, remedy=remedy)


def _write(to: Path, found: ForeignReadings, unit: str | None) -> list[str]:
    """The tables, in a folder with the explained campaign.toml, which comes last; `unit` as the column says."""
    from tvsbayes.single_axis.axis_campaign import axis_moves_bytes, axis_templates, readings_bytes

    contents = {"moves.csv": axis_moves_bytes(found.moves), "readings.csv": readings_bytes(found.readings)}
    if not (to / "campaign.toml").is_file():
        make_folder(to, empty=True)
        template = axis_templates()["campaign.toml"]
        own = unit or UNIT
        contents["campaign.toml"] = template.replace(f'\nunit = "{UNIT}"'.encode(), f'\nunit = "{own}"'.encode())
    for name, data in contents.items():
        write_atomically(to / name, data)
    return [str(to / name) for name in contents]
