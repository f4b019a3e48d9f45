"""Moves and sightings from a foreign table of a head: counters or encoder angles, and the observed directions.

One row is a move, a sighting, or both. Encoder angles become counters of `STEP_DEG`. Assumptions about what the table
does not state are listed in words. Degrees; u are standard uncertainties.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tvsbayes.files.csv_table import NUMBER
from tvsbayes.files.foreign_table import ForeignTable
from tvsbayes.instrument.axes import AXES, Axis
from tvsbayes.instrument.campaign import MOVES, SPOTS, Move
from tvsbayes.instrument.column_names import COUNTERS, DEGREES, SPREAD, field_by_word, unit_of_name, words_of
from tvsbayes.instrument.corrections import Correction, corrected
from tvsbayes.instrument.foreign_cells import FieldCells, left_out, plain_column, status_of
from tvsbayes.instrument.foreign_looks import Notation, moves_of_rows
from tvsbayes.instrument.parameters import Prior
from tvsbayes.instrument.sightings import SIGHTINGS, Sighting, sightings_of

STEP_DEG = 1e-5
"""Size of a counter step: encoders are read in degrees, and 0.04 arcsec is far below telescopes' pointing errors."""
U_DEG = 0.01
"""Standard uncertainty of a sighting where a table states none; the fit estimates its scale."""
ENCODER_U, LINE_U, CONTRAST_U = 0.01, 0.1, 0.003
"""Relative u of a ratio from an encoder's scale, from a line through the table, and of a contrast of directions."""
ZERO_U_DEG, FAR_ZERO_DEG = 10.0, 20.0
"""u of the angle at counter 0 by that line, and the least stated angle: smaller ones are within the default prior."""
OFF_LINE_DEG = 10.0
"""Median distance of sightings from the line over their counters, above which the line gives no ratio."""
BY_LINE = "by a line through the table; correct it in [rig.prior]"
ANGLES = ("azimuth_deg", "elevation_deg")
SIGHTING_FIELDS = (*MOVES.columns, *ANGLES, "u_deg", "status")
"""All fields that a table of sightings can have."""
NEEDED = (*COUNTERS, *ANGLES)
_AXIS_WORDS = (
    {"azimuth", "az", "azm", "azi", "azimut", "acimut", "pan", "yaw", "horizontal", "horiz", "hor", "schwenk"},
    {"elevation", "el", "elev", "alt", "altitude", "tilt", "pitch", "vertical", "vert", "hohe", "hoehe", "elevacion"}
    | {"neigung", "altura", "hauteur", "inclinacion"},
)
_OF_COUNTERS = {
    *("pan", "tilt", "yaw", "pitch", "step", "steps", "count", "counts", "counter", "ticks", "encoder", "enc", "joint"),
    *("motor", "axis", "raw", "command", "commanded", "cmd", "demand", "schritte", "zahler", "achse", "pasos", "pas"),
}
"""Words that distinguish commanded or encoder angles of an axis from observed directions."""
_OTHERS = [*(MOVES[name] for name in ("move", "segment", "time_s", "temperature_degC")), SPOTS["status"]]


def sighting_field(name: str) -> str | None:
    """The field to which a column belongs by its name."""
    listed = words_of(name)
    words = set(listed)
    # "s" stands for seconds here.
    of_axis = [k for k, spellings in enumerate(_AXIS_WORDS) if words & spellings]
    if words & (SPREAD - {"s"}) or words == {"u"} or (words & {"u"} and len(of_axis) != 1):
        return "u_deg"
    if len(of_axis) != 1:
        return field_by_word(listed, _OTHERS)
    if "approach" in words:
        return f"{AXES[of_axis[0]]}_approach"
    return COUNTERS[of_axis[0]] if words & _OF_COUNTERS else ANGLES[of_axis[0]]


@dataclass(frozen=True)
class ForeignSightings:
    """Moves and sightings of a table.

    Attributes:
        moves: rows of `moves.csv`.
        sightings: rows of `sightings.csv`.
        priors: priors of ratios and zeros by their names, from encoders or a line through the table.
        encoders: axes whose counters are angles of an encoder.
        assumed: assumptions about what the table does not state, in words.
    """

    moves: tuple[Move, ...]
    sightings: tuple[Sighting, ...]
    priors: dict[str, Prior]
    encoders: frozenset[Axis]
    assumed: tuple[str, ...]


def sightings_of_table(
    table: ForeignTable,
    columns: dict[str, str],
    notation: Notation,
    correction: Correction,
    u_deg: float | None = None,
    falling: Collection[Axis] = (),
) -> ForeignSightings:
    """Derive moves and sightings from a table.

    Args:
        table: the foreign table.
        columns: its columns by field, `NEEDED` among them.
        notation: conventions of its numbers; `angle_unit` applies where column names state none.
        correction: applied to moves and sightings.
        u_deg: standard uncertainty of a sighting where no column states it.
        falling: axes whose joint angle decreases where azimuth or elevation grows; such angles are joint angles.

    Raises:
        InputError: a cell is not a value of its field, or the table has no row.
    """
    table.require_rows()
    assumed: list[str] = []
    plain = _plain_numbers(table, columns, notation, assumed)
    table, units = plain.table, plain.units
    cells_of = FieldCells(table, columns)
    listing = moves_of_rows(cells_of, notation, assumed)
    angles: dict[str, list[float | None]] = {}
    for field in (name for name in (*ANGLES, "u_deg") if name in columns):
        scale, column = DEGREES[units[field]], SIGHTINGS[field]
        read = cells_of.read(column, column.low / scale, column.high / scale, optional=True)
        angles[field] = [None if value is None else scale * value for value in read]
    if "u_deg" not in columns:
        u = U_DEG if u_deg is None else u_deg
        angles["u_deg"] = [u] * len(table)
        how = "; --assume u_deg=NUMBER states another, and the fit finds the scale"
        assumed.append(f"standard uncertainty of a sighting: {u:g} deg{how}")
    statuses, sightings = cells_of.text("status"), []
    for row in range(len(table)):
        values = {field: column[row] for field, column in angles.items()}
        if not statuses[row] and all(values[field] is None for field in ANGLES):
            continue
        sightings.append(
            Sighting(
                sighting=row,
                move=listing.move_of_row[row],
                **values,
                status=status_of(cells_of, row, values, "sighting"),
            )
        )
    assumed += left_out(cells_of, statuses, "sighting")
    changed = corrected(listing.moves, sightings, correction)
    moves, sightings = changed.moves or (), sightings_of(changed.spots or ())
    encoders = frozenset(axis for axis, field in zip(AXES, COUNTERS, strict=True) if field in units)
    if turned := tuple(axis for axis in AXES if axis in encoders & set(falling) and _falls(moves, sightings, axis)):
        assumed += [f"{axis}_steps: angles of the joint of the URDF, which falls there" for axis in turned]
        of_joint = corrected(moves, None, Correction(flipped=turned))
        moves, assumed = of_joint.moves or (), [*assumed, *of_joint.changes]
    priors = _priors(moves, sightings, encoders, assumed)
    return ForeignSightings(moves, tuple(sightings), priors, encoders, (*assumed, *changed.changes))


@dataclass(frozen=True)
class _PlainTable:
    """A table of plain numbers, and the units of its angles by field; whole counters have none."""

    table: ForeignTable
    units: dict[str, str]


def _plain_numbers(table: ForeignTable, columns: dict[str, str], notation: Notation, assumed: list[str]) -> _PlainTable:
    """Convert a table to plain numbers, with encoder angles as counters."""
    units: dict[str, str] = {}
    for field in (name for name in (*NEEDED, "u_deg") if name in columns):
        plain = plain_column(columns[field], table.columns[columns[field]])
        assumed += [plain.remark] * bool(plain.remark)
        unit = plain.unit or unit_of_name(columns[field], DEGREES)
        if field in COUNTERS and unit is None and any(not _is_whole(cell) for cell in plain.cells):
            unit = notation.angle_unit or "deg"
        elif field not in COUNTERS:
            unit = unit or (units["azimuth_deg"] if field == "u_deg" else notation.angle_unit) or "deg"
        if unit is not None:
            units[field] = unit
        cells = plain.cells
        if field in COUNTERS and unit is not None:
            per_unit = DEGREES[unit] / STEP_DEG
            cells = tuple(str(round(per_unit * float(cell))) if NUMBER.fullmatch(cell) else cell for cell in cells)
            assumed.append(
                f"{field}: angles in {unit} as they stand, without whole turns, in steps of {STEP_DEG:g} deg"
            )
        table = replace(table, columns={**table.columns, columns[field]: cells})
    return _PlainTable(table, units)


def _priors(
    moves: Sequence[Move], sightings: Sequence[Sighting], encoders: frozenset[Axis], assumed: list[str]
) -> dict[str, Prior]:
    """Priors of ratios and contrasts from encoders' steps, or from a line through the sightings; zeros far from 0."""
    priors: dict[str, Prior] = {}
    for axis, field, angle in zip(AXES, COUNTERS, ANGLES, strict=True):
        line = _line(moves, sightings, axis)
        if line is not None and line.slope_deg < 0:
            remedy = f"add --flip {field}, or exchange two columns by --column"
            assumed.append(f"{field}: falls where {angle} grows; {remedy}")
        elif line is not None and abs(line.zero_deg) > FAR_ZERO_DEG:
            name = angle.replace("_deg", "_zero_deg")
            priors[name] = Prior(line.zero_deg, ZERO_U_DEG)
            assumed.append(f"{name}: {line.zero_deg:.3g}, u {ZERO_U_DEG:g}, {BY_LINE}")
        ratio, u = STEP_DEG, ENCODER_U
        if axis not in encoders:
            if line is None:
                continue
            ratio, u = abs(line.slope_deg), LINE_U
            assumed.append(f"degrees_per_step.{axis}: {ratio:.3g} deg, u {LINE_U:.0%}, {BY_LINE}")
        priors[f"degrees_per_step.{axis}"] = Prior(ratio, u * ratio)
        priors[f"ratio_contrast_deg_per_step.{axis}"] = Prior(0.0, CONTRAST_U * ratio)
    return priors


def _line(moves: Sequence[Move], sightings: Sequence[Sighting], axis: Axis) -> Line | None:
    """`line_of` the sighted angles over the counters of an axis."""
    field, angle = COUNTERS[AXES.index(axis)], ANGLES[AXES.index(axis)]
    ok = [s for s in sightings if s.status == "ok"]
    counters = np.array([getattr(moves[s.move], field) for s in ok], float)
    return line_of(counters, np.array([getattr(s, angle) for s in ok], float))


def _falls(moves: Sequence[Move], sightings: Sequence[Sighting], axis: Axis) -> bool:
    """Whether counters clearly decrease where the angle grows."""
    line = _line(moves, sightings, axis)
    return line is not None and line.slope_deg < 0


def _is_whole(cell: str) -> bool:
    """Whether a cell is empty, no number, or a whole number."""
    return NUMBER.fullmatch(cell) is None or float(cell).is_integer()


@dataclass(frozen=True)
class Line:
    """A line of angles over counters: degrees per step, and the angle at counter 0, -180 to 180."""

    slope_deg: float
    zero_deg: float


def line_of(counters: np.ndarray, angles_deg: np.ndarray) -> Line | None:
    """Fit a line to angles known up to full turns, shape (n,) each; None where no line fits."""
    order = np.argsort(counters, kind="stable")
    steps, angles = counters[order], np.unwrap(angles_deg[order], period=360.0)
    if len(np.unique(steps)) < 3:
        return None
    slope, level = np.polyfit(steps, angles, 1).tolist()
    off = float(np.median(np.abs(angles - slope * steps - level)))
    return Line(slope, math.remainder(level, 360.0)) if off < OFF_LINE_DEG and slope != 0.0 else None
