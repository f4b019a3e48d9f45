"""Units of a table of an axis: its readings and their standard uncertainties in one."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

from tvsbayes.errors import Question, escaped
from tvsbayes.files.csv_table import NUMBER
from tvsbayes.importing.asking import refused
from tvsbayes.importing.cells import FieldCells
from tvsbayes.importing.columns import first_values, line_through
from tvsbayes.importing.table import STATED, ForeignTable
from tvsbayes.importing.words import Unit, name_of, parse_unit, part_of_unit, place_of, plain, words_of

UNIT_SLOPE = 0.05
"""Largest deviation from 1 of the slope of readings over commands, where both are taken to be in one unit."""
PART_DIGITS = 0.02
"""Largest distance of a slope from a power of ten, decades, at which readings may count parts of their unit."""
SLOPE_DECADES = 2.0
"""Largest distance of such a slope from 1, decades: deviations from a scale that is off change by less than 1 %."""
ANGLE_SPAN = 360.0
NUMBER_MAX = 1e12
"""Largest absolute command or reading."""


def stated_unit(cells: FieldCells, name: str) -> Unit | None:
    """The unit of a field that the user states.

    Raises:
        InputError: no unit, or none of its kind.
    """
    text = cells.wishes.units.get(name)
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


def units_of(cells: FieldCells, written: Mapping[str, Unit | None]) -> dict[str, Unit | None]:
    """Units of command, reading, u and time: stated, of the cells, of the names, or of lines above them.

    Raises:
        Question: a unit that nobody knows.
    """
    units: dict[str, Unit | None] = {}
    for name in (n for n in ("command", "value", "u", "time_s") if n in cells):
        column = name_of(cells.columns[name])
        unit = stated_unit(cells, name) or written.get(name) or column.unit
        if unit is None and column.unknown and name != "command":
            own = [part_of_unit(column.unknown) or column.unknown] if name == "value" else []
            usual = {"time_s": ("s", "ms", "min")}.get(name, ("mm", "um", "deg", "arcsec", "counts"))
            first = {column.text: first_values(cells.text(name))}
            said = {"unit": column.unknown, "column": column.text, "field": name}
            raise cells.table.ask("unknown-unit", each=(*own, *usual), first=first, **said)
        units[name] = unit
    if (unit := units["value"]) is not None and unit.kind == "voltage" and "value" not in cells.wishes.units:
        raise cells.table.ask("volts", unit=unit.name, column=cells.columns["value"])
    for name, what in (("command", "command"), ("value", "unit")):
        if units[name] is None and (unit := unit_above(cells.table, name)) is not None:
            units[name] = unit
            cells.assumed.append(f"{what}: {unit.name}, as a line above the names says; --unit {name}=mm says another")
    return units


_SAID = (
    STATED,
    re.compile(r"(?P<name>[^,;:=()\[\]]*)[(\[](?P<text>[^()\[\]]+)[)\]]"),
    re.compile(r"(?P<name>[^,;:=]*?)\b(?:in|en)\s+(?P<text>[^\s,;]+)"),
    re.compile(r"(?P<name>[^,;:=]*\b(?:units?|einheit(?:en)?|unidad(?:es)?|unites?))\s+(?P<text>\S+)\s*$"),
)
"""Units that a line states: "Unit: mm", "Position [mm]", "readings in um, positions in mm", "Error units mm"."""
_UNIT_FIRST = re.compile(
    r"(?<!\bin )(?<!\ben )(?<![^\s,;:=])(?P<text>[a-z]+)\s+(?P<name>[a-z]+)(?![^\s,;]|\s*[:=]|\s+(?:in|en)\b)"
)
"""A unit before what is in it: "um deviations"."""


def unit_above(table: ForeignTable, field: str) -> Unit | None:
    """The only unit of length, angle or counts that lines above the names state for a field, else for all values.

    "Position: mm" is that of commands, "Deviation: um" that of readings.
    """
    units: dict[str, set[Unit]] = {"command": set(), "value": set(), "": set()}

    def of_field(words: list[str]) -> str:
        names = {"value": ("value", "deviation"), "command": ("command", "position")}
        return next((of for of, own in names.items() if any(place_of(words, n) is not None for n in own)), "")

    for line in table.above:
        rest = line
        for match in _UNIT_FIRST.finditer(plain(line)):
            unit, of = parse_unit(match["text"]), of_field(words_of(match["name"]))
            if of and unit and unit.kind in ("length", "angle", "count"):
                units[of].add(unit)
                rest = plain(rest).replace(match[0], ",")
        for form in _SAID:
            for match in form.finditer(rest if form is STATED else plain(rest)):
                unit, words = parse_unit(match["text"]), words_of(match["name"])
                of = of_field(words)
                stated = of or place_of(words, "unit") is not None or form is not STATED
                if stated and unit and unit.kind in ("length", "angle", "count"):
                    units[of].add(unit)
    found = units[field] or (units[""] if field == "value" else set())
    return found.pop() if len(found) == 1 else None


def in_one_unit(
    cells: FieldCells,
    commands: Sequence[float],
    values: Sequence[float | None],
    units: Mapping[str, Unit | None],
) -> tuple[list[float | None], list[float], str | None]:
    """Readings and their standard u in one unit, with its name."""
    wishes, unit, command_unit = cells.wishes, units["value"], units["command"]
    if not wishes.deviations and len(set(values)) > 2 and list(values) == list(commands):
        cells.assumed.append("value: equals the command in every row: what was read, or the command again?")
    of_scale = command_unit if command_unit is not None and command_unit.kind in ("length", "angle") else None
    given = unit
    if wishes.deviations:
        sign = wishes.deviation_sign or 1.0
        factor = sign * _deviation_factor(cells, unit, command_unit)
        values = [None if d is None else rounded(c + factor * d) for c, d in zip(commands, values, strict=True)]
        how = "less" if sign < 0 else "plus"
        cells.assumed.append(f"value: the command {how} the deviation, because --deviations says so")
        given, unit = unit or command_unit, command_unit or unit
    elif unit is not None and unit.per_number != 1.0:
        values = [None if v is None else rounded(unit.per_number * v) for v in values]
        cells.assumed.append(f"value: numbers of {unit.per_number:g} {unit.name}, turned into {unit.name}")
        unit = unit.whole
    elif unit is None and of_scale is not None:
        slope = abs(_slope(commands, values))
        if not abs(slope - 1.0) <= UNIT_SLOPE:
            raise _unit_of_readings(cells, slope or 1.0, of_scale)
        given = unit = of_scale
        how = "that of the commands, which the readings follow 1 to 1; --unit value=mm says another"
        cells.assumed.append(f"unit: {unit.name}, {how}")
    if unit is not None and command_unit is not None and "value" not in wishes.units and wishes.deviations is None:
        _check_slope(cells, commands, values, unit, command_unit)
    if unit is None and _are_counts(cells.text("value")):
        unit = given = Unit("counts", "count", 1.0)
        cells.assumed.append("unit: whole numbers over more than 360, so counts; --unit value=deg says another")
    return list(values), _standard_u(cells, units.get("u") or given, unit), unit and unit.name


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
    for name, own, other in (("command", command_unit, unit), ("value", unit, command_unit)):
        if own is None and other is not None:
            usual = dict.fromkeys((other.name, *(("mm", "um") if other.kind == "length" else ("deg", "arcsec"))))
            said = {"column": cells.columns[name], "other": other.name, "field": name}
            raise cells.table.ask("unit-beside", each=usual, **said)
    if unit is None or command_unit is None:
        cells.assumed.append(
            "unit: of deviations that of the commands, as neither states one; --unit value=um says another"
        )
        return 1.0
    if (factor := unit.in_units_of(command_unit)) is None:
        table, said = cells.table, {"unit": unit.name, "other": command_unit.name}
        raise refused("two-kinds", table.file, line=table.first_line, **said)
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


def _standard_u(cells: FieldCells, unit: Unit | None, result: Unit | None) -> list[float]:
    """Standard uncertainties, written in a unit, in the readings' one."""
    stated = [u or 0.0 for u in cells.numbers("u", 0.0, NUMBER_MAX, optional=True)]
    if "u" not in cells:
        return stated
    name, factor = cells.shown("u"), 1.0
    if unit is not None:
        of = unit.in_units_of(result) if result else None
        if of is None:
            usual = {"length": ("mm", "um"), "angle": ("deg", "arcsec")}.get(unit.kind, ())
            said = {"column": cells.columns["u"], "of": result.name if result else "an unnamed unit"}
            each = dict.fromkeys((unit.name, *usual)) if result is None else ()
            raise cells.table.ask("unit-of-u", each=each, unit=unit.name, **said)
        factor = of
        if result and factor != 1.0:
            cells.assumed.append(f"u: column {name} in {unit.name}, turned into {result.name}")
    coverage = cells.wishes.coverage or name_of(cells.columns["u"]).coverage
    if is_expanded(cells):
        is_spread = name_of(cells.columns["u"]).is_spread
        what = f"{coverage:g} standard deviations, taken as" if is_spread else "is"
        how = f"over {coverage:g}; --assume coverage=NUMBER says another"
        cells.assumed.append(f"u: column {name} {what} an expanded uncertainty, {how}")
    return [rounded(u * factor / (coverage or 1.0)) for u in stated]


def is_expanded(cells: FieldCells) -> bool:
    """Whether the column of u holds expanded uncertainties."""
    return "u" in cells and (cells.wishes.coverage or name_of(cells.columns["u"]).coverage) not in (None, 1.0)


def shown_units(units: Mapping[str, Unit | None], unit: str | None, cells: FieldCells) -> dict[str, str]:
    """Units by field, as they are shown."""
    shown = {name: u.name for name, u in units.items() if u is not None}
    shown |= {"value": unit} if unit else {}
    return shown | ({"time_s": shown.get("time_s", "s")} if "time_s" in cells else {})
