"""Kinds of CSV files: one declaration for reader, writer and documentation."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import pytest

from tvsbayes.coordinates.looks_file import LOOKS
from tvsbayes.errors import InputError
from tvsbayes.files.csv_kind import Column, CsvKind, counted, filled_where_ok, first_of_segment
from tvsbayes.instrument.campaign import MOVES, SPOTS, campaign_templates
from tvsbayes.instrument.plan import PLANS
from tvsbayes.single_axis.axis_campaign import AXIS_MOVES, READINGS, axis_templates

PAGE = Path(__file__).resolve().parents[2] / "data" / "docs" / "campaign-files.md"
ALL = (MOVES, SPOTS, AXIS_MOVES, READINGS, PLANS, LOOKS)


@dataclass(frozen=True, kw_only=True)
class Weight:
    """A row of an invented file."""

    row: Annotated[int, Column("0, 1, 2, ...", rule=counted)]
    segment: Annotated[int, Column("any")]
    side: Annotated[Literal["left", "right", ""], Column("where from", rule=first_of_segment)] = ""
    mass_g: Annotated[float | None, Column("g", -1.0, 5.0, rule=filled_where_ok("weigh it"))] = None
    status: Annotated[str, Column("`ok`, or why not", filled=True)] = "ok"
    low_g: Annotated[float, Column("limits", 0.0, 9.0, group="limits")] = 1.0
    high_g: Annotated[float, Column("", 0.0, 9.0, group="limits")] = 2.0
    air_degC: Annotated[float | None, Column("of the air", -50.0, 60.0, group="air")] = None


WEIGHTS = CsvKind(Weight, "weights.csv", "a row for every weight", ("at least one row", "weigh something"))
HEADER = "row,segment,side,mass_g,status"


def refused(rows: str) -> InputError:
    with pytest.raises(InputError) as caught:
        WEIGHTS.parse(f"{HEADER}\n{rows}".encode(), "weights.csv")
    return caught.value


def test_a_csv_file_round_trips():
    """Groups of optional columns are written only where one is not at its default."""
    plain = [Weight(row=0, segment=0, side="left", mass_g=0.1), Weight(row=1, segment=0, status="lost")]
    assert WEIGHTS.content(plain).decode() == f"{HEADER}\n0,0,left,0.1,ok\n1,0,,,lost\n"
    limited = [plain[0], Weight(row=1, segment=1, side="right", mass_g=3.0, high_g=2.5)]
    data = WEIGHTS.content(limited)
    assert data.decode().splitlines()[0] == f"{HEADER},low_g,high_g"
    for rows in (plain, limited):
        assert WEIGHTS.parse(WEIGHTS.content(rows), "weights.csv") == tuple(rows)
    emptied = data.replace(b",1.0,2.0", b",,")
    assert WEIGHTS.parse(emptied, "weights.csv") == tuple(limited), "an empty cell is the default"


def test_errors_are_refused_at_their_cell():
    for rows, line, column, code in (
        ("", 1, None, "empty"),
        ("1,0,left,1,ok", 2, "row", "order"),
        ("0,0,up,1,ok", 2, "side", "approach"),
        ("0,0,left,1,ok\n1,0,right,1,ok", 3, "side", "approach"),
        ("0,0,left,,ok", 2, "mass_g", "missing"),
        ("0,0,left,6,ok", 2, "mass_g", "number"),
        ("0,,left,1,ok", 2, "segment", "integer"),
        ("0,0,left,1,", 2, "status", "missing"),
    ):
        error = refused(rows)
        assert (error.line, error.column, error.code) == (line, column, code), rows


def test_the_page_has_the_tables_of_the_declarations():
    page = PAGE.read_text(encoding="utf-8")
    assert WEIGHTS.markdown().splitlines()[-2:] == ["| `low_g`, `high_g` | limits |", "| `air_degC` | of the air |"]
    for kind in ALL:
        assert kind.markdown() in page, f"print({type(kind).__name__}.markdown()) of {kind.file} belongs there"


def test_templates_explain_every_column():
    for files, kinds in ((campaign_templates(), (MOVES, SPOTS)), (axis_templates(), (AXIS_MOVES, READINGS))):
        text = files["campaign.toml"].decode()
        assert "{" + kinds[0].file not in text and max(map(len, text.splitlines())) <= 120
        for kind in kinds:
            assert kind.comment() in text and all(name in kind.comment() for name in kind.columns)
            assert files[kind.file] == kind.content(kind.template)
