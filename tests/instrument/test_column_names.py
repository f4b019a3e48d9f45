"""Assignment of the columns of a foreign table to fields."""

from __future__ import annotations

import pytest

from tvsbayes.errors import InputError
from tvsbayes.instrument.campaign import PIXEL_SDS, PIXELS, SPOTS
from tvsbayes.instrument.column_names import (
    COUNTERS,
    DEGREES,
    READING_UNITS,
    SECONDS,
    map_columns,
    missing,
    unit_of_name,
)

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
    """In any order, beside their spreads."""
    spreads = tuple(f"std {name}" for name in names)
    mapping = map_columns([*spreads, *names][::-1])
    assert [mapping.columns[field] for field in PIXELS] == list(names)
    assert [mapping.columns[field] for field in PIXEL_SDS] == list(spreads)
    assert not mapping.unused and not mapping.ambiguous


COUNTER_NAMES = [
    ("Horizontal", "Vertikal"),
    ("Schritte Schwenk", "Schritte Neigung"),
    ("Schwenken [Schritte]", "Neigen [Schritte]"),
    ("Azimut", "H\u00f6he"),
    ("pasos horizontal", "pasos vertical"),
    ("acimut", "elevaci\u00f3n"),
    ("giro", "inclinaci\u00f3n"),
    ("pas horizontale", "pas verticale"),
    ("azimut", "inclinaison"),
]


@pytest.mark.parametrize("names", COUNTER_NAMES, ids=[" ".join(names) for names in COUNTER_NAMES])
def test_counters_in_four_languages(names):
    """A word known for one axis is known for the other one too."""
    assert map_columns(names).columns == dict(zip(COUNTERS, names, strict=True))


@pytest.mark.parametrize("name", ("aperture_deg", "Apertur [\u00b0]", "apertura (grados)", "Blende"))
def test_the_aperture_in_three_languages(name):
    assert map_columns([name]).columns == {"aperture_deg": name}


def test_other_fields_in_four_languages():
    for names in (
        ("Zeit (ms)", "Blende (Grad)", "Schirm", "G\u00fcltig", "Versuch", "Punkt", "Anfahrt horizontal"),
        ("tiempo", "apertura (grados)", "pantalla", "estado", "ensayo", "punto", "lado horizontal"),
        ("temps", "ouverture (degr\u00e9s)", "\u00e9cran", "\u00e9tat", "essai", "point", "c\u00f4t\u00e9 horizontal"),
    ):
        fields = ("time_s", "aperture_deg", "target", "status", "experiment", "point", "pan_approach")
        assert map_columns(names).columns == dict(zip(fields, names, strict=True))


def test_native_names_and_other_words():
    assert map_columns(SPOTS.columns).columns == {name: name for name in SPOTS.columns}
    mapping = map_columns(["steps pan", "TiltCount", "t (ms)", "Blatt", "B (rad)", "pan_approach", "remark"])
    assert mapping.columns == {
        "pan_steps": "steps pan",
        "tilt_steps": "TiltCount",
        "time_s": "t (ms)",
        "target": "Blatt",
        "aperture_deg": "B (rad)",
        "pan_approach": "pan_approach",
    }
    assert mapping.unused == ("remark",)


def test_units_in_names():
    times = (
        "t (ms)",
        "t_us",
        "Zeit [\u00b5s]",
        "t (\u03bcs)",
        "time_h",
        "time (hours)",
        "minutes",
        "t (s)",
        "time_rad",
    )
    assert [unit_of_name(name, SECONDS) for name in times] == ["ms", "us", "us", "us", "h", "h", "min", None, None]
    angles = ("B (rad)", "angle_deg", "aperture_mrad", "B (arcmin)", "B_arcsec", "XL", "B h")
    assert [unit_of_name(name, DEGREES) for name in angles] == ["rad", "deg", "mrad", "arcmin", "arcsec", None, None]
    signs = ("Winkel [\u00b0]", "angle \u00b0", "Temperatur [\u00b0C]", "T [\u00b0 F]", "N\u00b0 de mesure")
    assert [unit_of_name(name, DEGREES) for name in signs] == ["deg", "deg", None, None, None]
    readings = ("Messwert [\u00b5m]", "reading [\u03bcm]", "encoder_um", "x (nm)", "counts", "B [\u00b5rad]", "v")
    assert [unit_of_name(name, READING_UNITS) for name in readings] == ["um", "um", "um", "nm", "counts", "urad", None]


def test_a_field_of_two_columns_is_ambiguous():
    mapping = map_columns(["pan_pos", "pan_goal", "tilt"])
    assert mapping.ambiguous == {"pan_steps": ("pan_pos", "pan_goal")}
    assert "pan_steps" not in mapping.columns
    choice = map_columns(["pan_pos", "pan_goal", "tilt"], {"pan_steps": "pan_goal", "tilt_steps": ""})
    assert choice.columns == {"pan_steps": "pan_goal"}
    assert "pan_pos" in choice.unused
    for stated, match in (({"pan": "tilt"}, "did you mean|allowed: move"), ({"pan_steps": "Pan"}, "no such column")):
        with pytest.raises(InputError, match=match):
            map_columns(["pan_pos", "tilt"], stated)


def test_required_columns_of_a_table():
    assert missing(["u_left_px"], moves_known=True) == list(PIXELS[1:])
    assert missing(["u_left_px"], moves_known=False) == [*PIXELS[1:], *COUNTERS]
    assert missing(["pan_steps"], moves_known=False) == ["tilt_steps"]
    assert missing([], moves_known=True) == list(PIXELS)
