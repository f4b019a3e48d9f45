"""Moves and looks of a foreign table."""

from __future__ import annotations

import math
import time

import pytest
from support.small_campaign import small_campaign

from tvsbayes.errors import InputError
from tvsbayes.files.foreign_table import ForeignTable
from tvsbayes.instrument.campaign import PIXELS, parse_spots, spots_bytes
from tvsbayes.instrument.column_names import map_columns
from tvsbayes.instrument.foreign_looks import Notation, looks_of

HEADER = "Pan Tilt XL YL XR YR Sheet"
LOOKS = ("0 0 641 361 501 360 near", "0 0 651 361 561 360 far", "200 0 701 361 571 360 far", "200 30 1 361 2 360 far")


def looks(*rows: str, header: str = HEADER, notation: Notation | None = None, listed=None):
    """Moves and looks of a table with these cells; - is an empty one."""
    names = header.split()
    cells = list(
        zip(*([cell.replace("-", "") if cell == "-" else cell for cell in row.split()] for row in rows), strict=True)
    )
    table = ForeignTable("t.csv", "drawn", tuple(range(2, 2 + len(rows))), dict(zip(names, cells, strict=True)))
    return looks_of(table, map_columns(names).columns, notation or Notation(), listed)


def test_rows_at_the_same_counters_are_looks_after_one_move():
    result = looks(*LOOKS, notation=Notation(approach=("left", "up")))
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
    result = looks(*rows, "10 0 5 6 7 8 0 5000 2 1", header=header, notation=Notation(pixels_from=1, relative=True))
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
    degrees = looks("0 0 1 1 1 1 1.5", header="Pan Tilt XL YL XR YR B_rad", notation=Notation(angle_unit="deg"))
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
    result = looks_of(table, {name: name for name in cells}, Notation())
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
    moves = looks(*(row.rsplit(" ", 5)[0] for row in LOOKS), header="Pan Tilt").moves
    assert len(moves) == 3
    header = "XL YL XR YR move"
    result = looks("1 2 3 4 2", "5 6 - - 0", header=header, listed=moves)
    assert result.moves is None
    assert [(s.move, s.status) for s in result.spots] == [(2, "ok"), (0, "no centre in the table")]
    assert [s.move for s in looks(*["1 2 3 4"] * 3, header="XL YL XR YR", listed=moves).spots] == [0, 1, 2]


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
        (("0 0 5", "1 0 4"), "Pan Tilt t", "line 3, t: .*do not decrease"),
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
        looks(
            *rows, header=header, listed=looks("0 0", "1 0", header="Pan Tilt").moves if "Pan" not in header else None
        )
