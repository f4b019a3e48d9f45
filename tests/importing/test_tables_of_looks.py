"""Moves and looks of a foreign table, and of a lab book."""

from __future__ import annotations

import datetime
import math
import time
from collections.abc import Sequence
from typing import NamedTuple

import pytest
from support.small_campaign import small_campaign

from tvsbayes.errors import InputError, Question
from tvsbayes.importing.cells import Wishes
from tvsbayes.importing.looks import (
    FIELDS,
    LookRows,
    field_of,
    look_columns,
    look_rows,
)
from tvsbayes.importing.table import ForeignTable
from tvsbayes.instrument.campaign import MOVES, PIXEL_SDS, PIXELS, SPOTS, Move, Spot, parse_spots, spots_bytes

HEADER = "Pan Tilt XL YL XR YR Sheet"
LOOKS = ("0 0 641 361 501 360 near", "0 0 651 361 561 360 far", "200 0 701 361 571 360 far", "200 30 1 361 2 360 far")


class Looks(NamedTuple):
    """Rows of a table as those of a campaign."""

    moves: tuple[Move, ...] | None
    spots: tuple[Spot, ...] | None
    assumed: tuple[str, ...]
    rows: LookRows


def table_of(names: Sequence[str], rows: Sequence[Sequence[str]]) -> ForeignTable:
    cells = list(zip(*rows, strict=True)) or [()] * len(names)
    return ForeignTable("t.csv", "drawn", tuple(range(2, 2 + len(rows))), dict(zip(names, cells, strict=True)))


def read(table: ForeignTable, wishes: Wishes | None = None, listed: int | None = None) -> Looks:
    wishes = wishes or Wishes()
    rows = look_rows(look_columns(table, wishes.columns), wishes, listed)
    moves = None if rows.moves is None else tuple(Move(**row) for row in rows.moves)
    spots = None if rows.looks is None else tuple(Spot(**row) for row in rows.looks)
    return Looks(moves, spots, rows.assumed, rows)


def looks(*rows: str, header: str = HEADER, wishes: Wishes | None = None, listed: int | None = None) -> Looks:
    """Moves and looks of a table with these cells; - is an empty one."""
    cells = [["" if cell == "-" else cell for cell in row.split()] for row in rows]
    return read(table_of(header.split(), cells), wishes, listed)


def test_rows_at_the_same_counters_are_looks_after_one_move():
    result = looks(*LOOKS, wishes=Wishes(approach=("left", "up")))
    assert [(m.move, m.pan_steps, m.tilt_steps, m.pan_approach) for m in result.moves] == [
        (0, 0, 0, "left"),
        (1, 200, 0, ""),
        (2, 200, 30, ""),
    ]
    assert [(s.spot, s.move, s.target, s.status) for s in result.spots] == [
        (0, 0, "near", "ok"),
        (1, 0, "far", "ok"),
        (2, 1, "far", "ok"),
        (3, 2, "far", "ok"),
    ]
    assert (result.spots[0].u_left_px, result.spots[0].v_right_px, result.spots[0].su_left_px) == (641.0, 360.0, 0.1)
    assert any("0.1 px" in text for text in result.assumed) and not any("approach" in text for text in result.assumed)


def test_notations_of_others():
    """Pixels from 1, radians, milliseconds, steps of each move, homings, good looks by 1 and 0."""
    header = "Pan Tilt XL YL XR YR B_rad t_ms home valid"
    rows = ("0 0 641 361 501 360 1.5 1000 1 1", "200 0 1 2 3 4 - 2500 1 0", "-150 5 1 2 3 4 0.5 4000 1 1")
    result = looks(*rows, "10 0 5 6 7 8 0 5000 2 1", header=header, wishes=Wishes(pixels_from=1, relative=True))
    assert [(m.segment, m.pan_steps, m.tilt_steps, m.time_s) for m in result.moves] == [
        (0, 0, 0, 1.0),
        (0, 200, 0, 2.5),
        (0, 50, 5, 4.0),
        (1, 10, 0, 5.0),
    ]
    assert [m.pan_approach for m in result.moves] == ["unknown", "", "", "unknown"]
    assert [s.u_left_px for s in result.spots] == [640.0, None, 0.0, 4.0]
    assert result.spots[1].status == "refused: 0"
    assert result.spots[0].aperture_deg == pytest.approx(math.degrees(1.5), abs=1e-12)
    degrees = looks("0 0 1 1 1 1 1.5", header="Pan Tilt XL YL XR YR B_rad", wishes=Wishes(angle_unit="deg"))
    assert degrees.spots[0].aperture_deg == 1.5


@pytest.mark.parametrize(
    ("name", "cell", "seconds"), [("t_h", "2", 7200.0), ("t_us", "2", 2e-6), ("t_min", "2", 120.0), ("t_s", "2", 2.0)]
)
def test_times_are_in_the_unit_of_the_name(name, cell, seconds):
    result = looks(f"0 0 {cell}", header=f"Pan Tilt {name}")
    assert result.moves[0].time_s == pytest.approx(seconds, rel=1e-12)


@pytest.mark.parametrize(("unit", "of_turn"), [("mrad", 2000 * math.pi), ("arcmin", 21600), ("arcsec", 1296000)])
def test_apertures_are_in_the_unit_of_the_name(unit, of_turn):
    result = looks(f"0 0 1 2 3 4 {of_turn / 4}", header=f"Pan Tilt XL YL XR YR B_{unit}")
    assert result.spots[0].aperture_deg == pytest.approx(90.0, rel=1e-12)


@pytest.mark.parametrize(
    ("marks", "segments", "remark"),
    [
        ("1 0 0 0", [0, 0, 0, 0], "0 homings after the first row, by column home at each 1"),
        ("0 1 0 1", [0, 1, 1, 2], "2 homings after the first row, by column home at each 1"),
        ("1 - - 1", [0, 0, 0, 1], "1 homing after the first row, by column home at each 1"),
        ("true false false true", [0, 0, 0, 1], "by column home at each 1"),
        ("0 0 1 1", [0, 0, 1, 1], "1 homing after the first row, by column home where it changes"),
        ("1 1 2 3", [0, 0, 1, 2], "2 homings after the first row, by column home where it changes"),
    ],
)
def test_homings_are_marked_or_numbered(marks, segments, remark):
    rows = [f"{10 * k} 0 {mark}" for k, mark in enumerate(marks.split())]
    result = looks(*rows, header="Pan Tilt home")
    assert [m.segment for m in result.moves] == segments
    assert any(remark in text for text in result.assumed)


def test_rows_without_a_spot_may_state_any_spread():
    result = looks("0 0 1 2 3 4 0.2 1", "5 0 0 0 0 0 0 0", header="Pan Tilt XL YL XR YR std_XL valid")
    assert [s.su_left_px for s in result.spots] == [0.2, None]


def test_rows_without_pixels_are_moves_without_a_look():
    result = looks("0 0 1 2 3 4", "50 0 - - - -", "20 0 1 2 3 4", header="Pan Tilt XL YL XR YR")
    assert [m.pan_steps for m in result.moves] == [0, 50, 20]
    assert [(s.spot, s.move) for s in result.spots] == [(0, 0), (2, 2)]


def test_dates_become_seconds_and_stated_spreads_stay():
    result = looks("0 0 1 2 3 4 0.3 2026-01-02T03:04:05", "9 0 1 2 3 4 0.4 2026-01-02T03:05:07",
                  header="Pan Tilt XL YL XR YR std_XL time")  # fmt: skip
    assert [m.time_s for m in result.moves] == [0.0, 62.0]
    assert [s.su_left_px for s in result.spots] == [0.3, 0.4]
    assert result.spots[0].sv_right_px == 0.1


@pytest.mark.parametrize("zone", ["UTC", "Europe/Berlin", "America/Mexico_City"])
@pytest.mark.skipif(not hasattr(time, "tzset"), reason="only POSIX changes its time zone in a process")
def test_dates_without_a_zone_do_not_depend_on_the_local_zone(monkeypatch, zone):
    """On 29 March 2026 clocks in Berlin went from 02:00 to 03:00, and not in Mexico."""
    monkeypatch.setenv("TZ", zone)
    time.tzset()
    try:
        rows = [f"0 {k} 1 1 1 1 2026-03-29T0{h}" for k, h in enumerate(("1:30:00", "2:30:00", "3:00:00"))]
        result = looks(*rows, header="Pan Tilt XL YL XR YR Time")
    finally:
        monkeypatch.undo()
        time.tzset()
    assert [move.time_s for move in result.moves] == [0.0, 3600.0, 5400.0]


def test_texts_are_accepted_by_the_campaign_reader():
    cells = {
        **{name: ("0", "1", "2", "3") for name in ("pan_steps", "tilt_steps")},
        **{name: ("5", "5", "5", "") for name in PIXELS},
        "target": ("-50", "50", "=near", "sheet\u00a0one\nleft"),
        "status": ("\u200b", "-", "@late", "too\tdim\u200b"),
    }
    table = ForeignTable("t.xlsx", "drawn", (2, 3, 4, 5), cells)
    result = read(table)
    assert [spot.target for spot in result.spots] == ["sheet -50", "50", "sheet =near", "sheet one left"]
    assert [spot.status for spot in result.spots] == ["refused", "refused: -", "refused: @late", "too dim"]
    stereo = small_campaign().stereo
    assert parse_spots(spots_bytes(result.spots), "spots.csv", result.moves, stereo) == result.spots


def test_numbers_that_cannot_be_kept_are_reported():
    header = "Pan Tilt XL YL XR YR Spot Exp Point"
    result = looks("0 0 1 1 1 1 7 3 1", "0 0 1 1 1 1 7 3 -", "0 0 1 1 1 1 8 - 2", header=header)
    assert [(s.spot, s.experiment, s.point) for s in result.spots] == [(0, 3, 1), (1, None, None), (2, None, None)]
    remarks = [text for text in result.assumed if text.startswith(("spot", "experiment"))]
    assert remarks == [
        "spot: numbers are missing or repeated, so looks are numbered by their rows",
        "experiment, point: 2 rows with only one of them, which is left out",
    ]
    # A move without a look has no number of a spot.
    whole = looks("0 0 1 1 1 1 7 3 1", "50 0 - - - - - - -", "0 0 1 1 1 1 9 3 2", header=header)
    assert [s.spot for s in whole.spots] == [7, 9]
    assert not [text for text in whole.assumed if text.startswith(("spot", "experiment"))]


def test_points_without_experiments_count_looks():
    """Without four-point experiments numbers above 4 are valid."""
    rows = [f"{10 * k} 0 1 1 1 1 {k}" for k in range(1, 9)]
    result = looks(*rows, header="Pan Tilt XL YL XR YR Point")
    assert {(s.experiment, s.point) for s in result.spots} == {(None, None)} and len(result.spots) == 8
    assert any("column Point is left out" in text for text in result.assumed)


def test_looks_alone_are_assigned_to_listed_moves():
    header = "XL YL XR YR move"
    result = looks("1 2 3 4 2", "5 6 - - 0", header=header, listed=3)
    assert result.moves is None
    assert [(s.move, s.status) for s in result.spots] == [(2, "ok"), (0, "no centre in the table")]
    assert [s.move for s in looks(*["1 2 3 4"] * 3, header="XL YL XR YR", listed=3).spots] == [0, 1, 2]


@pytest.mark.parametrize(
    ("numbers", "remark"),
    [
        ("0 1 2 3", None),
        ("1 2 3 4", "in 4 of 4 rows: Nr 1 is move 0; "),
        ("0 1 3 4", "in 2 of 4 rows: Nr 3 is move 2; "),
        ("0 a - 3", None),
    ],
)
def test_a_log_that_numbers_moves_differently_is_reported(numbers, remark):
    """Pictures named by that log would otherwise be paired with other moves without a message."""
    rows = [f"{number} {100 * k} 0" for k, number in enumerate(numbers.split())]
    remarks = [text for text in looks(*rows, header="Nr Pan Tilt").assumed if text.startswith("move: ")]
    assert len(remarks) == (remark is not None)
    assert remark is None or (remark in remarks[0] and "paired by the move, not by Nr" in remarks[0])
    with_pixels = looks(*(f"{row} 1 2 3 4" for row in rows), header="Nr Pan Tilt XL YL XR YR") if remark else None
    assert with_pixels is None or not [text for text in with_pixels.assumed if text.startswith("move: ")]


@pytest.mark.parametrize(
    ("rows", "header", "message"),
    [
        (("0.5 0",), "Pan Tilt", "line 2, Pan: .*angles are what the fit finds"),
        (("0 x",), "Pan Tilt", "line 2, Tilt: "),
        (("0 0 5", "1 0 4"), "Pan Tilt t", "line 3, t: found times that step back by 1 s"),
        (("0 0 yesterday",), "Pan Tilt t", "2026-01-15T10:00:00"),
        (("0 0 3", "5 0 3"), "Pan Tilt move", "line 3, Pan: .*counters of its move"),
        (("0 0 up",), "Pan Tilt pan_approach", "left, right, unknown"),
        (("0 0 1 2 3 - ok",), "Pan Tilt XL YL XR YR status", "line 2, YR: found an empty cell"),
        (("1 2 3 4",), "XL YL XR YR", "column move=NAME"),
        (("1 2 3 4 7",), "XL YL XR YR move", "line 2, move: "),
        (("0 0 1 2 3 4 1 0",), "Pan Tilt XL YL XR YR exp pt", "line 2, pt: .* from 1 to 4"),
        (("0 0 1 2 3 4 -1 1",), "Pan Tilt XL YL XR YR exp pt", "line 2, exp: .* from 0 to"),
        (("0 0 1 2 3 4 -1",), "Pan Tilt XL YL XR YR spot", "line 2, spot: .* from 0 to"),
        (("0 0 1 2 3 4 500",), "Pan Tilt XL YL XR YR B", "line 2, B: .* from -360 to 360"),
        (("0 0 1 2 3 4 0",), "Pan Tilt XL YL XR YR std_XL", "line 2, std_XL: .* from 0.0001 to 100"),
        (("0 0 1 2 3 4 -",), "Pan Tilt XL YL XR YR std_XL", "line 2, std_XL: .*--sd-px"),
    ],
)
def test_cells_that_are_no_value_are_refused_with_their_place(rows, header, message):
    with pytest.raises(InputError, match=message):
        looks(*rows, header=header, listed=None if "Pan" in header else 2)


# --- columns -----------------------------------------------------------------------------------------------------
PIXEL_NAMES = [
    ("XL", "YL", "XR", "YR"),
    ("uL", "vL", "uR", "vR"),
    ("x_left", "y_left", "x_right", "y_right"),
    ("xLeft (px)", "yLeft (px)", "xRight (px)", "yRight (px)"),
    ("left_x", "left_y", "right_x", "right_y"),
    ("x1", "y1", "x2", "y2"),
    ("Bild links x", "Bild links y", "Bild rechts x", "Bild rechts y"),
    ("col izquierda", "fila izquierda", "col derecha", "fila derecha"),
    ("colonne gauche", "ligne gauche", "colonne droite", "ligne droite"),
]


@pytest.mark.parametrize("names", PIXEL_NAMES, ids=[names[0] for names in PIXEL_NAMES])
def test_pixels_by_any_name(names):
    """Beside their spreads."""
    assert [field_of(name) for name in names] == list(PIXELS)
    assert [field_of(f"std {name}") for name in names] == list(PIXEL_SDS)


@pytest.mark.parametrize(
    ("pan", "tilt"),
    [
        *(("Horizontal", "Vertikal"), ("Schritte Schwenk", "Schritte Neigung"), ("Azimut", "H\u00f6he")),
        *(("Schwenken [Schritte]", "Neigen [Schritte]"), ("pasos horizontal", "pasos vertical")),
        *(("acimut", "elevaci\u00f3n"), ("giro", "inclinaci\u00f3n"), ("pas horizontale", "pas verticale")),
        *(("azimut", "inclinaison"), ("steps pan", "TiltCount")),
    ],
)
def test_counters_in_four_languages(pan, tilt):
    """A word known for one axis is known for the other one too."""
    assert (field_of(pan), field_of(tilt)) == ("pan_steps", "tilt_steps")


def test_other_fields_in_four_languages():
    fields = (
        "time_s",
        "aperture_deg",
        "target",
        "status",
        "experiment",
        "point",
        "pan_approach",
        "picture_left",
        "direction",
    )
    for names in (
        "Zeit (ms)|Blende (Grad)|Schirm|G\u00fcltig|Versuch|Punkt|Anfahrt horizontal|Bild links|Richtung",
        "tiempo|apertura (grados)|pantalla|estado|ensayo|punto|lado horizontal|Imagen izq|Sentido",
        "temps|ouverture (degr\u00e9s)|\u00e9cran|\u00e9tat|essai|point|c\u00f4t\u00e9 horizontal|photo gauche|sens",
    ):
        assert tuple(map(field_of, names.split("|"))) == fields
    assert (
        field_of("remark") is None and field_of("Apertur [\u00b0]") == "aperture_deg" and field_of("File") == "picture"
    )


def test_fields_are_the_columns_of_a_campaign():
    """Every column of moves.csv and spots.csv can be imported under its own name, but the importer's own mark."""
    columns = {**MOVES.columns, **SPOTS.columns}
    del columns["assumed"]
    assert set(columns) == set(FIELDS) - {
        "picture",
        "picture_left",
        "picture_right",
        "direction",
    }
    names = [name for name in FIELDS if name in columns]
    assert look_columns(table_of(names, []), {}).taken == {name: name for name in names}


def test_a_field_of_two_columns_is_asked():
    """The answers are complete; where another column is missing too, the refusal names both."""
    table = table_of(["pan_pos", "pan_goal", "tilt"], [["0", "1", "2"]])
    with pytest.raises(Question, match="2 columns that could be pan_steps") as caught:
        read(table)
    assert [c.options for c in caught.value.candidates] == [
        ("--column", "pan_steps=pan_pos"),
        ("--column", "pan_steps=pan_goal"),
    ]
    assert read(table, Wishes({"pan_steps": "pan_goal"})).moves[0].pan_steps == 1
    with pytest.raises(InputError, match=r"tilt_steps, pan_steps \(pan_pos or pan_goal\); understood so far: nothing"):
        read(table, Wishes({"tilt_steps": ""}))
    for stated, match in (({"pan": "tilt"}, "did you mean|allowed: move"), ({"pan_steps": "Pan"}, "no such column")):
        with pytest.raises(InputError, match=match):
            read(table, Wishes(stated))


@pytest.mark.parametrize(
    ("names", "listed", "missing"),
    [
        ("XL", True, "v_left_px, u_right_px, v_right_px;"),
        ("XL", False, "v_left_px, u_right_px, v_right_px, pan_steps, tilt_steps;"),
        ("Pan", False, "tilt_steps;"),
        ("remark", True, "u_left_px, v_left_px, u_right_px, v_right_px;"),
    ],
)
def test_required_columns_of_a_table(names, listed, missing):
    with pytest.raises(InputError, match=f"surely {missing}"):
        read(table_of([names], [["1"]]), listed=1 if listed else None)


def test_a_reference_that_changes_with_every_row_counts_no_homings():
    result = looks("0 0 17", "1 0 18", "2 0 25", "3 0 31", header="Pan Tilt Reference")
    assert {move.segment for move in result.moves} == {0} and result.rows.understood.unused == ("Reference",)


# --- lab books ---------------------------------------------------------------------------------------------------
BOOK = "Time Experiment Point Plane Pan Tilt Picture Remark"
BOOKED = (
    "2025-07-24T09:00:00 - - - 0 0 - -",
    "2025-07-24T09:01:00 1 P1 d1 10 0 left/exp01_P1_L.png -",
    "2025-07-24T09:01:30 exp01 P2 d2 0 0 left/exp01_P2_L.png -",
    "2025-07-24T09:02:00 1 3 d2 200 0 left/exp01_P3_L.png shiny",
    "2025-07-24T09:02:30 1 4 d1 0 0 - -",
    "2025-07-24T09:03:00 - - - -200 0 - back",
)


def test_rows_of_a_lab_book_are_moves_and_looks_that_wait():
    result = looks(*BOOKED, header=BOOK, wishes=Wishes(relative=True, pictures=True))
    assert [(m.pan_steps, m.time_s) for m in result.moves] == [(0, 0.0), (10, 60.0), (210, 120.0), (10, 180.0)]
    assert [(s.spot, s.move, s.target, s.experiment, s.point, s.status) for s in result.spots] == [
        (1, 1, "d1", 1, 1, "undetected"),
        (2, 1, "d2", 1, 2, "undetected"),
        (3, 2, "d2", 1, 3, "undetected"),
        (4, 2, "d1", 1, 4, "undetected"),
    ]
    assert result.rows.pictures == [("left/exp01_P1_L.png",), ("left/exp01_P2_L.png",), ("left/exp01_P3_L.png",), ("",)]
    assert result.rows.created == datetime.datetime(2025, 7, 24, 9) and result.rows.lines == [3, 4, 5, 6]
    assert result.rows.understood.unused == ("Remark",)


def test_merged_cells_and_distances_of_a_spreadsheet():
    """The number stands in the first row of an experiment; the sheet is named by its distance."""
    rows = ("0 0 7 P1 17.5", "0 0 - P2 27.5", "200 0 - P3 27.5", "200 0 - P4 17.5", "0 0 - - -", "5 0 - P1 17.5")
    result = looks(*rows, header="Pan Tilt Exp Point Distance_cm")
    assert [(s.experiment, s.point, s.target) for s in result.spots] == [
        *((7, 1, "17.5"), (7, 2, "27.5"), (7, 3, "27.5"), (7, 4, "17.5")),
    ]
    assert "experiment: 3 rows with a point alone are of the experiment above them" in result.assumed
    assert "experiment, point: 1 row with only one of them, which is left out" in result.assumed
    assert any("every value of Distance_cm is one placement" in text for text in result.assumed)


def test_looks_are_kept_without_their_pictures():
    """Without --pictures the looks wait, and how pictures come is said; a refused look keeps its reason."""
    result = looks("0 0 1 1 a.png ok", "0 0 1 2 b.png bad", header="Pan Tilt Exp Pt File State")
    assert [spot.status for spot in result.spots] == ["undetected", "refused: bad"]
    assert any("--pictures FOLDER brings them" in text for text in result.assumed)
    assert "status: 1 look left out by column State: bad 1" in result.assumed
    # A log of moves that names pictures lists no looks: `new --pictures` does.
    assert looks("0 0 a.png", "5 0 b.png", header="Pan Tilt File").spots is None
    alone = looks("0 0 a.png", "5 0 -", header="Pan Tilt File", wishes=Wishes(pictures=True))
    assert [(s.move, s.experiment) for s in alone.spots] == [(0, None)]


@pytest.mark.parametrize(
    ("names", "cells"),
    [(("Date", "Time"), ("24.07.2025", "09:00:01")), (("Uhrzeit", "Datum"), ("09:00:01", "2025-07-24"))],
)
def test_a_date_and_a_time_of_day_in_two_columns_are_one_clock(names, cells):
    rows = [[*cells, "0", "0"], [*(cell.replace(":01", ":31") for cell in cells), "5", "0"]]
    result = read(table_of([*names, "Pan", "Tilt"], rows))
    assert [move.time_s for move in result.moves] == [0.0, 30.0]
    assert result.rows.created == datetime.datetime(2025, 7, 24, 9, 0, 1)


@pytest.mark.parametrize(
    ("cell", "created"),
    [
        ("2025-07-24T09:00:00Z", datetime.datetime(2025, 7, 24, 9, tzinfo=datetime.UTC)),
        ("09:00:00", None),
        ("20250724", None),
        ("12.5", None),
    ],
)
def test_the_day_of_a_book_is_taken_where_it_is_stated(cell, created):
    assert looks(f"0 0 {cell}", header="Pan Tilt time").rows.created == created
