"""Tables of moves and sightings: names of columns, units, encoders, missing information."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tvsbayes.errors import InputError
from tvsbayes.files.foreign_table import table_of
from tvsbayes.head.foreign_sightings import (
    SIGHTING_FIELDS,
    STEP_DEG,
    line_of,
    sighting_field,
    sightings_of_table,
)
from tvsbayes.instrument.column_names import map_columns
from tvsbayes.instrument.corrections import Correction
from tvsbayes.instrument.foreign_looks import Notation

STEPS = [(-9000, 100), (0, 2000), (9000, 4000), (25000, 6000), (41000, 8000)]
"""Of ratios 0.01 and 0.005 deg: azimuth passes 360 deg on the way."""


def understood(columns, notation=Notation(), correction=Correction(), **wish):  # noqa: B008
    table = table_of("log.csv", "CSV", columns, range(2, 2 + len(next(iter(columns.values())))))
    known = map_columns(columns, None, SIGHTING_FIELDS, sighting_field)
    assert not known.ambiguous
    return sightings_of_table(table, known.columns, notation, correction, **wish)


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
    assert sighting_field(name) == field


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
    assert [s.status for s in log.sightings] == ["ok"] * 4 + ["clouds"]
    first = log.sightings[0]
    assert (first.azimuth_deg, first.elevation_deg, first.u_deg) == pytest.approx((290.0, 0.5, 0.05), abs=1e-6)
    assert log.priors["degrees_per_step.pan"].value == pytest.approx(0.01)
    assert log.priors["degrees_per_step.tilt"].value == pytest.approx(0.005, rel=0.02)
    assert "1 sighting left out" in " ".join(log.assumed)


@pytest.mark.parametrize(("azimuth_deg", "zeros"), [(0.0, {}), (170.0, {"azimuth_zero_deg": 170.0})])
def test_a_zero_far_from_the_default_is_stated(azimuth_deg, zeros):
    """On any turn of the azimuth; a near one lies within the default prior."""
    columns = {
        "pan_steps": [str(pan) for pan, _ in STEPS],
        "tilt_steps": [str(tilt) for _, tilt in STEPS],
        "azimuth": [str((0.01 * pan + azimuth_deg) % 360) for pan, _ in STEPS],
        "elevation": [str(0.005 * tilt) for _, tilt in STEPS],
    }
    log = understood(columns)
    assert {name: prior.value for name, prior in log.priors.items() if "zero" in name} == pytest.approx(zeros)
    assert ("azimuth_zero_deg" in " ".join(log.assumed)) == bool(zeros)


def test_encoders_in_radians_become_counters():
    """A scale known to a hundredth; whole turns are kept."""
    pan = [-0.5, 0.0, 7.0]
    columns = {"enc az [rad]": pan, "enc el [rad]": [0.1, 0.2, 0.3], "az": [331.0, 0.0, 41.0], "el": [6.0, 11.0, 17.0]}
    log = understood({name: [str(cell) for cell in cells] for name, cells in columns.items()}, u_deg=0.002)
    assert [m.pan_steps for m in log.moves] == [round(math.degrees(angle) / STEP_DEG) for angle in pan]
    assert {s.u_deg for s in log.sightings} == {0.002}
    assert log.priors["degrees_per_step.tilt"].value == STEP_DEG


def test_a_reversed_counter_is_named_and_negated():
    columns = {
        "pan_steps": [str(-pan) for pan, _ in STEPS],
        "tilt_steps": [str(tilt) for _, tilt in STEPS],
        "azimuth": [str((0.01 * pan) % 360) for pan, _ in STEPS],
        "elevation": [str(0.005 * tilt) for _, tilt in STEPS],
    }
    assert "add --flip pan_steps" in " ".join(understood(columns).assumed)
    turned = understood(columns, correction=Correction(flipped=("pan",)))
    assert [move.pan_steps for move in turned.moves] == [pan for pan, _ in STEPS]
    assert "--flip" not in " ".join(turned.assumed)


def test_angles_of_a_downward_joint_are_negated():
    """As on most robots: a tilt joint about +y looks down where its angle grows."""
    columns = {
        "pan cmd [rad]": ["-0.5", "0.0", "0.7", "1.0"],
        "tilt cmd [rad]": ["0.3", "-0.1", "-0.4", "-0.5"],
        "az": ["331", "0", "41", "57"],
        "el": ["-17", "6", "23", "29"],
    }
    both = understood(columns, falling=("tilt", "pan"))
    for axis, sign in (("pan", 1), ("tilt", -1)):
        counters = [round(sign * math.degrees(float(a)) / STEP_DEG) for a in columns[f"{axis} cmd [rad]"]]
        assert [getattr(move, f"{axis}_steps") for move in both.moves] == counters
    assert "--flip" not in " ".join(both.assumed)
    assert "add --flip tilt_steps" in " ".join(understood(columns).assumed)


def test_no_ratio_of_angles_that_lie_on_no_line():
    rng = np.random.default_rng(3)
    assert line_of(np.arange(12.0), rng.uniform(0, 360, 12)) is None
    assert line_of(np.array([0.0, 0.0, 5.0]), np.array([1.0, 1.0, 2.0])) is None


@pytest.mark.parametrize(
    ("cells", "message"),
    [(["95", "1", "1", "1", "1"], "a number from -90 to 90"), (["", "1", "1", "1", "1"], "alt: found an empty cell")],
)
def test_cells_that_are_no_sightings_are_refused(cells, message):
    counters = {"pan": [str(pan) for pan, _ in STEPS], "tilt": [str(tilt) for _, tilt in STEPS]}
    with pytest.raises(InputError, match=message):
        understood({**counters, "az": ["1", "2", "3", "4", "5"], "alt": cells})
