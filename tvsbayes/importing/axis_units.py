"""What a user states about a table of an axis; its readings and their standard uncertainties in one unit."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from tvsbayes.errors import Question, escaped
from tvsbayes.files.csv_table import NUMBER
from tvsbayes.importing.asking import refused
from tvsbayes.importing.cells import FieldCells
from tvsbayes.importing.columns import columns_of, line_through
from tvsbayes.importing.table import STATED, ForeignTable
from tvsbayes.importing.words import Unit, name_of, parse_unit, part_of_unit, place_of, plain, words_of

UNIT_SLOPE = 0.05
"""Largest deviation from 1 of the slope of readings over commands, where both are taken to be in one unit."""
PART_DIGITS = 0.02
"""Largest distance of a slope from a power of ten, decades, at which readings may count parts of their unit."""
SLOPE_DECADES = 2.0
"""Largest distance of such a slope from 1, decades: deviations from a scale that is off change by less than 1 %."""
ANGLE_SPAN = 360.0


@dataclass(frozen=True)
class Wishes:
    """What the user states about a table of an axis.

    Attributes:
        columns: column by field, "" for none.
        units: unit by field, as text.
        deviations: whether readings are actual less commanded position.
        counts_per_turn: counts after which readings restart; 0: nowhere.
        order: order of runs beside each other, one of `runs.ORDERS`.
        coverage: coverage factor of the column of uncertainties.
        status_ok: number of a status that means a good row.
        relative: whether commands are the lengths of moves.
        no_reading: number that stands for no reading.
        deviation_sign: -1 where deviations are commanded less actual position.
        command_turn: whole turn of commands that go on through it; 0: nowhere.
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    deviations: bool | None = None
    counts_per_turn: float | None = None
    order: str | None = None
    coverage: float | None = None
    status_ok: float | None = None
    relative: bool = False
    no_reading: float | None = None
    command_turn: float | None = None
    deviation_sign: float | None = None


def stated_unit(cells: FieldCells, name: str, wishes: Wishes) -> Unit | None:
    """The unit of a field that the user states.

    Raises:
        InputError: no unit, or none of its kind.
    """
    text = wishes.units.get(name)
    if text is None:
        return None
    # Volts of a sensor: "0.5 mm" is what one of the numbers stands for.
    scaled = re.fullmatch(r"(\d+\.?\d*(?:e-?\d+)?) ?(\D.*)", text)
    unit = parse_unit(text)
    if unit is None and scaled and float(scaled[1]) and (whole := parse_unit(scaled[2])) is not None:
        return whole._replace(per_number=float(scaled[1]) * whole.per_number)
    if unit is None and name == "value":
        return Unit(text, "own", 1.0)
    if unit is None:
        raise refused("no-unit", f"--unit {name}={escaped(text)}")
    return unit


def units_of(
    cells: FieldCells, written: Mapping[str, Unit | None], wishes: Wishes, assumed: list[str]
) -> dict[str, Unit | None]:
    """Units of command, reading and u: stated, of the cells, or of the names.

    Raises:
        Question: a unit that nobody knows.
    """
    units: dict[str, Unit | None] = {}
    for name in ("command", "value", "u", "time_s"):
        if name not in cells:
            continue
        column = name_of(cells.columns[name])
        unit = stated_unit(cells, name, wishes) or written.get(name) or column.unit
        if unit is None and column.unknown and name != "command":
            known = columns_of(cells.table)
            own = [part_of_unit(column.unknown) or column.unknown] if name == "value" else []
            usual = {"time_s": ("s", "ms", "min")}.get(name, ("mm", "um", "deg", "arcsec", "counts"))
            first = {column.text: known[column.text].first}
            said = {"unit": column.unknown, "column": column.text, "field": name}
            raise cells.table.ask("unknown-unit", each=(*own, *usual), first=first, **said)
        units[name] = unit
    if (unit := units["value"]) is not None and unit.kind == "voltage" and "value" not in wishes.units:
        raise cells.table.ask("volts", unit=unit.name, column=cells.columns["value"])
    for field_ in ("command", "value"):
        if units[field_] is None and (unit := unit_above(cells.table, field_)) is not None:
            units[field_] = unit
            what, how = "unit" if field_ == "value" else field_, "as a line above the names says"
            assumed.append(f"{what}: {unit.name}, {how}; --unit {field_}=mm says another")
    return units


_AT_END = re.compile(r"\b(?:in|en)\s+(?P<text>\S+)\s*$")
"""A unit at the end of a line: "all values in mm"."""


def unit_above(table: ForeignTable, field: str) -> Unit | None:
    """The only unit of length, angle or counts that lines above the names state for a field.

    "Position: mm" is that of commands, "Deviation: um" that of readings, as are a unit or values of no name.
    """
    units = set[Unit]()
    for line in table.above:
        for match in (*STATED.finditer(line), *_AT_END.finditer(plain(line))):
            unit, words = parse_unit(match["text"]), words_of(match.groupdict().get("name", ""))
            of_command, of_reading, of_all = (
                any(place_of(words, name) is not None for name in names)
                for names in (("command", "position"), ("value", "deviation"), ("unit",))
            )
            of_field = of_command and not of_reading if field == "command" else of_reading or not of_command
            is_said = of_command or of_reading or of_all or match.re is _AT_END
            if is_said and of_field and unit and unit.kind in ("length", "angle", "count"):
                units.add(unit)
    return units.pop() if len(units) == 1 else None


def in_one_unit(
    cells: FieldCells,
    commands: Sequence[float],
    values: Sequence[float | None],
    stated_u: Sequence[float],
    units: Mapping[str, Unit | None],
    wishes: Wishes,
    assumed: list[str],
) -> tuple[list[float | None], list[float], str | None]:
    """Readings and their standard u in one unit, with its name."""
    unit, command_unit = units["value"], units["command"]
    if not wishes.deviations and len(set(values)) > 2 and list(values) == list(commands):
        assumed.append("value: equals the command in every row: what was read, or the command again?")
    of_scale = command_unit if command_unit is not None and command_unit.kind in ("length", "angle") else None
    given = unit
    if wishes.deviations:
        factor = _deviation_factor(cells, unit, command_unit) * (wishes.deviation_sign or 1.0)
        values = [None if d is None else rounded(c + factor * d) for c, d in zip(commands, values, strict=True)]
        how = "less" if (wishes.deviation_sign or 1.0) < 0 else "plus"
        assumed.append(f"value: the command {how} the deviation, because --deviations says so")
        given, unit = unit or command_unit, command_unit or unit
    elif unit is not None and unit.per_number != 1.0:
        values = [None if v is None else rounded(unit.per_number * v) for v in values]
        assumed.append(f"value: numbers of {unit.per_number:g} {unit.name}, turned into {unit.name}")
        unit = unit.whole
    elif unit is None and of_scale is not None:
        slope = _slope(commands, values)
        if not abs(slope - 1.0) <= UNIT_SLOPE:
            raise _unit_of_readings(cells, abs(slope) or 1.0, of_scale)
        given = unit = of_scale
        how = "that of the commands, which the readings follow 1 to 1; --unit value=mm says another"
        assumed.append(f"unit: {unit.name}, {how}")
    if unit is not None and command_unit is not None and "value" not in wishes.units and wishes.deviations is None:
        _check_slope(cells, commands, values, unit, command_unit)
    if unit is None and _are_counts(cells.text("value")):
        unit = given = Unit("counts", "count", 1.0)
        assumed.append("unit: whole numbers over more than 360, so counts; --unit value=deg says another")
    return list(values), _standard_u(cells, stated_u, units.get("u"), given, unit, wishes, assumed), unit and unit.name


def _slope(commands: Sequence[float], values: Sequence[float | None]) -> float:
    """Slope of readings over commands by least squares; 0 where there is none."""
    known = np.array([(c, v) for c, v in zip(commands, values, strict=True) if v is not None], float).reshape(-1, 2)
    return line_through(*known.T)[0] if len(np.unique(known[:, 0])) > 1 else 0.0


def _check_slope(
    cells: FieldCells, commands: Sequence[float], values: Sequence[float | None], unit: Unit, command_unit: Unit
) -> None:
    """Ask where lengths do not follow lengths: a gauge in 1/100 mm whose column says mm, deviations called readings."""
    slope = _slope(commands, values) * (unit.in_units_of(command_unit) or 0.0)
    if unit.kind != "length" or command_unit.kind != "length" or not slope:
        return
    decades = float(np.log10(abs(slope)))
    said = {"column": cells.columns["value"], "slope": slope, "unit": unit.name, "of": command_unit.name}
    near = abs(decades - round(decades)) < PART_DIGITS
    parts = [f"{10.0 ** -round(decades):g} {unit.name}"] if near and round(decades) else []
    if decades < -SLOPE_DECADES or (abs(decades) > SLOPE_DECADES and not near):
        raise cells.table.ask("slope", each=parts, **said)
    if parts:
        raise cells.table.ask("parts-of-unit", each=(*parts, unit.name), **said)


def rounded(number: float) -> float:
    """A number without the last digits of its floating point."""
    return float(f"{number:.13g}")


def _deviation_factor(cells: FieldCells, unit: Unit | None, command_unit: Unit | None) -> float:
    """Units of the command per unit of a deviation."""
    if unit is None and command_unit is None:
        return 1.0
    table = cells.table
    if command_unit is None or unit is None:
        name, other = ("command", unit) if command_unit is None else ("value", command_unit)
        usual = dict.fromkeys((other.name, *(("mm", "um") if other.kind == "length" else ("deg", "arcsec"))))  # type: ignore[union-attr]
        column = cells.columns[name]
        raise table.ask("unit-beside", each=usual, column=column, other=other.name, field=name)  # type: ignore[union-attr]
    factor = unit.in_units_of(command_unit)
    if factor is None:
        raise refused("two-kinds", table.file, line=table.first_line, unit=unit.name, other=command_unit.name)
    return factor


def _unit_of_readings(cells: FieldCells, slope: float, command_unit: Unit) -> Question:
    """The question of the unit of readings that do not follow commands of a length or an angle 1 to 1."""
    usual = {
        "length": ("nm", "um", "1/1000 mm", "1/100 mm", "1/10 mm", "mm", "cm", "thou", "inch", "deg"),
        "angle": ("arcsec", "arcmin", "mrad", "rad", "deg", "gon", "turn", "mm"),
    }[command_unit.kind]
    scales = {
        text: factor for text in usual if (unit := parse_unit(text)) and (factor := unit.in_units_of(command_unit))
    }
    # Those in which the readings follow the commands come first.
    near = sorted(usual, key=lambda text: abs(np.log(slope * scales[text])) if text in scales and slope else np.inf)
    said = {"column": cells.columns["value"], "slope": slope, "unit": command_unit.name}
    return cells.table.ask("unit-of-readings", each=(*near[:3], "counts"), **said)


def _are_counts(cells: Sequence[str]) -> bool:
    numbers = [float(cell) for cell in cells if NUMBER.fullmatch(cell)]
    return bool(numbers) and all(n.is_integer() for n in numbers) and max(numbers) - min(numbers) > ANGLE_SPAN


def _standard_u(
    cells: FieldCells,
    stated: Sequence[float],
    unit: Unit | None,
    reading: Unit | None,
    result: Unit | None,
    wishes: Wishes,
    assumed: list[str],
) -> list[float]:
    """Standard uncertainties in the readings' unit.

    Args:
        cells: cells of the table.
        stated: the numbers of the column.
        unit: the column's unit.
        reading: unit of the numbers that were read, which is that of u where its column states none.
        result: unit of the readings written.
        wishes: what the user states.
        assumed: sentences, to which what was done is added.
    """
    if "u" not in cells:
        return list(stated)
    name, table = cells.columns["u"], cells.table
    unit = unit or reading
    factor = 1.0 if unit is None else None if result is None else unit.in_units_of(result)
    if unit is not None and factor is None:
        usual = {"length": ("mm", "um"), "angle": ("deg", "arcsec")}.get(unit.kind, ())
        names = dict.fromkeys((unit.name, *usual)) if result is None else ()
        of = result.name if result else "an unnamed unit"
        raise table.ask("unit-of-u", each=names, unit=unit.name, column=name, of=of)
    if unit is not None and result is not None and factor != 1.0:
        assumed.append(f"u: column {escaped(name)} in {unit.name}, turned into {result.name}")
    coverage = wishes.coverage or name_of(name).coverage
    if is_expanded(cells, wishes):
        what = f"{coverage:g} standard deviations, taken as" if name_of(name).is_spread else "is"
        how = f"over {coverage:g}; --assume coverage=NUMBER says another"
        assumed.append(f"u: column {escaped(name)} {what} an expanded uncertainty, {how}")
    return [rounded(u * (factor or 1.0) / (coverage or 1.0)) for u in stated]


def is_expanded(cells: FieldCells, wishes: Wishes) -> bool:
    """Whether the column of u holds expanded uncertainties."""
    return "u" in cells and (wishes.coverage or name_of(cells.columns["u"]).coverage) not in (None, 1.0)


def shown_units(units: Mapping[str, Unit | None], unit: str | None, cells: FieldCells) -> dict[str, str]:
    """Units by field, as they are shown."""
    shown = {name: u.name for name, u in units.items() if u is not None}
    shown |= {"value": unit} if unit else {}
    return shown | ({"time_s": shown.get("time_s", "s")} if "time_s" in cells else {})
