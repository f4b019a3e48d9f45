"""What is read of every table of `tables.py`, asked about it or refused: snapshots, to be read as diffs."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping

import pytest
from importing.tables import CASES, Case

from tvsbayes.errors import InputError, Question
from tvsbayes.importing.axis import axis_rows
from tvsbayes.importing.looks import look_columns, look_rows
from tvsbayes.importing.reader import read_foreign
from tvsbayes.importing.sightings import sighting_rows

ROUTINE = ("time_s: no column", "u: none, so", "approach: unknown at", "sd: 0.1 px")
"""What is assumed of most tables."""
READ = ("value", "azimuth_deg", "elevation_deg", "u_left_px", "v_left_px", "u_right_px", "v_right_px", "aperture_deg")


def of_move(move: Mapping[str, object], clock: bool) -> str:
    """Command or counters; + for a move that is assumed, the side from which it came, its time where there are any."""
    where = [f"{move[name]:g}" for name in ("command", "pan_steps", "tilt_steps") if name in move]
    sides = [str(move[name]) for name in ("approach", "pan_approach", "tilt_approach") if move.get(name)]
    time = [f"at {move['time_s']:.9g}"] if clock else []
    warm = [f"{move['temperature_degC']:g} degC"] if move.get("temperature_degC") is not None else []
    return " ".join([",".join(where) + "+" * bool(move.get("assumed")), *sides, *time, *warm])


def of_row(row: Mapping[str, object]) -> str:
    """The move, what was read or seen after it, and whatever else the row says."""
    left_out = {"move", "reading", "sighting", "spot", "status", *READ}
    numbers = [f"{row[name]:.9g}" for name in READ if row.get(name) is not None]
    more = [
        f"{name} {value}" for name, value in row.items() if value not in ("", None, 0, 0.1) and name not in left_out
    ]
    status = [] if row["status"] == "ok" else [str(row["status"])]
    return f"{row['move']}: " + " ".join([",".join(numbers), *status, *more])


def found(kind: str, case: Case, path) -> Iterator[str]:
    """Lines on what is read."""
    foreign = case.content
    if isinstance(foreign, str):
        path.write_text(foreign, encoding="utf-8")
        foreign = read_foreign(path)
    if kind == "table":
        yield foreign.kind
        yield from (f"{name}: {' | '.join(column)}" for name, column in foreign.columns.items())
        yield f"lines {foreign.lines}"
        return
    if kind == "axis":
        rows = axis_rows(foreign, case.wishes)
        read = rows.readings
        yield f"unit {rows.unit}, {rows.axis}"
    elif kind == "head":
        rows = sighting_rows(foreign, case.wishes)
        read = rows.sightings
        yield f"encoders {sorted(rows.encoders)}"
    else:
        rows = look_rows(look_columns(foreign, case.wishes.columns), case.wishes, case.listed)
        read = rows.looks or []
        yield f"created {rows.created}, pictures {rows.pictures}, unused {rows.understood.unused}"
    yield from (f"assumed: {text}" for text in rows.assumed if not text.startswith(ROUTINE))
    moves = rows.moves or []
    clock = [move["time_s"] for move in moves] != [*range(len(moves))]
    for segment in sorted({move["segment"] for move in moves}):
        places = [of_move(move, clock) for move in moves if move["segment"] == segment]
        yield from textwrap.wrap(f"moves of {segment}: {' / '.join(places)}", 120)
    yield from textwrap.wrap(" / ".join(map(of_row, read)), 120)


@pytest.mark.parametrize("key", CASES)
def test_what_is_read_of_a_table(key, tmp_path, snapshot):
    seen = []
    try:
        seen += found(key.partition(",")[0], CASES[key], tmp_path / "t.csv")
    except Question as question:
        seen += [f"asks: {question.message}", *(" ".join(candidate.options) for candidate in question.candidates)]
    except InputError as error:
        seen += [f"line {error.line}, {error.column}: {error.message}", error.remedy]
    assert "\n".join(seen).replace(str(tmp_path), "") == snapshot
