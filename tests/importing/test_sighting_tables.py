"""Tables of moves and sightings: names of columns, units, encoders, missing information."""

from __future__ import annotations

import math

import pytest

from tvsbayes.errors import InputError, Question
from tvsbayes.importing.cells import Wishes
from tvsbayes.importing.columns import Column
from tvsbayes.importing.sightings import STEP_DEG, field_of, sighting_rows
from tvsbayes.importing.table import table_of
from tvsbayes.importing.words import name_of

STEPS = [(-9000, 100), (0, 2000), (9000, 4000), (25000, 6000), (41000, 8000)]
"""Of ratios 0.01 and 0.005 deg: azimuth passes 360 deg on the way."""


def understood(columns, **wish):
    table = table_of("log.csv", "CSV", columns, range(2, 2 + len(next(iter(columns.values())))))
    return sighting_rows(table, Wishes(**wish))


@pytest.mark.parametrize(
    ("name", "field"),
    [
        ("Motor Az (Schritte)", "pan_steps"),
        ("enc_el_rad", "tilt_steps"),
        ("commanded azimuth", "pan_steps"),
        ("pan", "pan_steps"),
        ("Az gemessen [rad]", "azimuth_deg"),
        ("ALT", "elevation_deg"),
        ("tilt approach", "tilt_approach"),
        ("sigma (arcsec)", "u_deg"),
        ("Uhrzeit", "time_s"),
        ("stamp_s", "time_s"),
        ("quality", "status"),
        ("remark", None),
    ],
)
def test_names_of_columns(name, field):
    assert field_of(Column(name_of(name), ("1", "2"))) == field


def test_counters_and_radians_with_a_row_that_was_refused():
    azimuth = [math.radians((0.01 * pan + 20) % 360) for pan, _ in STEPS]
    log = understood(
        {
            "pan count": [str(pan) for pan, _ in STEPS],
            "tilt count": [str(tilt) for _, tilt in STEPS],
            "az rad": [f"{value:.9f}" for value in azimuth[:4]] + [""],
            "el": ["0\u00b030'00\"", "10\u00b000'00\"", "20:0:0", "30:0:0", ""],
            "sd (arcmin)": ["3"] * 4 + [""],
            "status": ["ok", "1", "good", "", "clouds"],
        }
    )
    assert [s["status"] for s in log.sightings] == ["ok"] * 4 + ["clouds"]
    first = log.sightings[0]
    assert (first["azimuth_deg"], first["elevation_deg"], first["u_deg"]) == pytest.approx((290.0, 0.5, 0.05), abs=1e-6)
    assert "1 sighting left out" in " ".join(log.assumed)


def test_encoders_in_radians_become_counters():
    """A scale known to a hundredth; whole turns are kept."""
    pan = [-0.5, 0.0, 7.0]
    columns = {"enc az [rad]": pan, "enc el [rad]": [0.1, 0.2, 0.3], "az": [331.0, 0.0, 41.0], "el": [6.0, 11.0, 17.0]}
    log = understood({name: [str(cell) for cell in cells] for name, cells in columns.items()}, u_deg=0.002)
    assert [m["pan_steps"] for m in log.moves] == [round(math.degrees(angle) / STEP_DEG) for angle in pan]
    assert {s["u_deg"] for s in log.sightings} == {0.002}
    assert log.encoders == {"pan", "tilt"}


@pytest.mark.parametrize(
    ("cells", "message"),
    [
        (["95", "10", "10", "10", "10"], "a number from -90 to 90"),
        (["", "10", "10", "10", "10"], "alt: found an empty cell"),
    ],
)
def test_cells_that_are_no_sightings_are_refused(cells, message):
    counters = {"pan": [str(pan) for pan, _ in STEPS], "tilt": [str(tilt) for _, tilt in STEPS]}
    with pytest.raises(InputError, match=message):
        understood({**counters, "az": ["1", "2", "3", "4", "5"], "alt": cells})


@pytest.mark.parametrize(
    ("scale", "answers"), [(math.pi / 180, ("rad", "deg")), (60.0, ("arcmin", "arcsec")), (1.0, None)]
)
def test_angles_without_a_unit_are_asked_for_unless_they_can_be_degrees_alone(scale, answers):
    columns = {"pan_steps": [str(pan) for pan, _ in STEPS], "tilt_steps": [str(tilt) for _, tilt in STEPS]}
    columns |= {"azimuth": [f"{scale * (0.01 * pan + 90):.6f}" for pan, _ in STEPS]}
    columns |= {"elevation": [f"{scale * 0.005 * tilt:.6f}" for _, tilt in STEPS]}
    if answers is None:
        assert any("no unit in column azimuth, so deg" in text for text in understood(columns).assumed)
        return
    with pytest.raises(Question) as asked:
        understood(columns)
    assert tuple(c.options[1] for c in asked.value.candidates)[: len(answers)] == answers
    rows = understood(columns, angle_unit=answers[0]).sightings
    assert [row["azimuth_deg"] for row in rows] == pytest.approx([0.01 * pan + 90 for pan, _ in STEPS], abs=1e-4)
