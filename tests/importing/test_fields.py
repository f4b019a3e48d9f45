"""Fields of looks and sightings by the names of their columns; texts and dates of a table of looks."""

from __future__ import annotations

import time

import numpy as np
import pytest
from importing.tables import cells
from support.small_campaign import small_campaign

from tvsbayes.importing import columns
from tvsbayes.importing.cells import Wishes
from tvsbayes.importing.columns import Column, fill_values, line_through
from tvsbayes.importing.looks import FIELDS, field_of, look_columns, look_rows
from tvsbayes.importing.sightings import field_of as field_of_sighting
from tvsbayes.importing.table import ForeignTable
from tvsbayes.importing.words import name_of
from tvsbayes.instrument.campaign import MOVES, PIXEL_SDS, PIXELS, SPOTS, Move, Spot, parse_spots, spots_bytes

NAMES = {
    ("pan_steps", "tilt_steps"): (
        "Horizontal|Vertikal, Schritte Schwenk|Schritte Neigung, Azimut|H\u00f6he, "
        "Schwenken [Schritte]|Neigen [Schritte], pasos horizontal|pasos vertical, "
        "acimut|elevaci\u00f3n, giro|inclinaci\u00f3n, pas horizontale|pas verticale, "
        "azimut|inclinaison, steps pan|TiltCount"
    ),
    tuple(PIXELS): (
        "XL|YL|XR|YR, uL|vL|uR|vR, x_left|y_left|x_right|y_right, xLeft (px)|yLeft (px)|xRight (px)|yRight (px), "
        "left_x|left_y|right_x|right_y, x1|y1|x2|y2, Bild links x|Bild links y|Bild rechts x|Bild rechts y, "
        "col izquierda|fila izquierda|col derecha|fila derecha, colonne gauche|ligne gauche|colonne droite|ligne droite"
    ),
    (
        "time_s",
        "aperture_deg",
        "target",
        "status",
        "experiment",
        "point",
        "pan_approach",
        "picture_left",
        "direction",
    ): (
        "Zeit (ms)|Blende (Grad)|Schirm|G\u00fcltig|Versuch|Punkt|Anfahrt horizontal|Bild links|Richtung, "
        "tiempo|apertura (grados)|pantalla|estado|ensayo|punto|lado horizontal|Imagen izq|Sentido, "
        "temps|ouverture (degr\u00e9s)|\u00e9cran|\u00e9tat|essai|point|c\u00f4t\u00e9 horizontal|photo gauche|sens"
    ),
    (None, "aperture_deg", "picture"): "remark|Apertur [\u00b0]|File",
}
"""A word known for one axis is known for the other one too."""


@pytest.mark.parametrize("fields", NAMES)
def test_names_in_four_languages(fields):
    for names in NAMES[fields].split(", "):
        assert tuple(map(field_of, names.split("|"))) == fields
        if fields == tuple(PIXELS):
            assert tuple(field_of(f"std {name}") for name in names.split("|")) == tuple(PIXEL_SDS)


def test_names_of_sightings():
    names = {
        "pan_steps": ("Motor Az (Schritte)", "commanded azimuth", "pan"),
        **{"tilt_steps": ("enc_el_rad",), "azimuth_deg": ("Az gemessen [rad]",), "elevation_deg": ("ALT",)},
        **{"tilt_approach": ("tilt approach",), "u_deg": ("sigma (arcsec)",), "time_s": ("Uhrzeit", "stamp_s")},
        **{"status": ("quality",), None: ("remark",)},
    }
    for field, columns_ in names.items():
        assert {field_of_sighting(Column(name_of(name), ("1", "2"))) for name in columns_} == {field}


def test_fields_are_the_columns_of_a_campaign():
    """Every column of moves.csv and spots.csv can be imported under its own name, but the importer's own mark."""
    columns = {*MOVES.columns, *SPOTS.columns} - {"assumed"}
    assert columns == set(FIELDS) - {"picture", "picture_left", "picture_right", "direction"}
    names = [name for name in FIELDS if name in columns]
    table = ForeignTable("t.csv", "drawn", (), dict.fromkeys(names, ()))
    assert look_columns(table, {}).taken == {name: name for name in names}


@pytest.mark.parametrize("zone", ["UTC", "Europe/Berlin", "America/Mexico_City"])
@pytest.mark.skipif(not hasattr(time, "tzset"), reason="only POSIX changes its time zone in a process")
def test_dates_without_a_zone_do_not_depend_on_the_local_zone(monkeypatch, zone):
    """On 29 March 2026 clocks in Berlin went from 02:00 to 03:00, and not in Mexico."""
    monkeypatch.setenv("TZ", zone)
    time.tzset()
    try:
        rows = [f"0 {k} 2026-03-29T0{h}" for k, h in enumerate(("1:30:00", "2:30:00", "3:00:00"))]
        result = look_rows(look_columns(cells("Pan Tilt Time", *rows), {}), Wishes())
    finally:
        monkeypatch.undo()
        time.tzset()
    assert [move["time_s"] for move in result.moves] == [0.0, 3600.0, 5400.0]


def test_texts_are_accepted_by_the_campaign_reader():
    texts = {
        **{name: ("0", "1", "2", "3") for name in ("pan_steps", "tilt_steps")},
        **{name: ("5", "5", "5", "") for name in PIXELS},
        "target": ("-50", "50", "=near", "sheet\u00a0one\nleft"),
        "status": ("\u200b", "-", "@late", "too\tdim\u200b"),
    }
    result = look_rows(look_columns(ForeignTable("t.xlsx", "drawn", (2, 3, 4, 5), texts), {}), Wishes())
    spots = tuple(Spot(**row) for row in result.looks)
    assert [spot.target for spot in spots] == ["sheet -50", "50", "sheet =near", "sheet one left"]
    assert [spot.status for spot in spots] == ["refused", "refused: -", "refused: @late", "too dim"]
    moves = tuple(Move(**row) for row in result.moves)
    assert parse_spots(spots_bytes(spots), "spots.csv", moves, small_campaign().stereo) == spots


def test_numbers_for_no_reading_are_sought_among_few(monkeypatch):
    """A log of many different readings costs no line for each of them."""
    fits = []
    monkeypatch.setattr(columns, "line_through", lambda *xy: fits.append(1) or line_through(*xy))
    x = np.arange(5000.0)
    y = x + 0.01 * np.sin(x)
    y[1234] = -9999.0
    assert fill_values(x, y) == [-9999.0] and len(fits) <= columns.FILLS_TRIED + 1
