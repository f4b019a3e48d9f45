"""Pointing tables of telescopes: turns of azimuth, poles, broken blocks, and their terms by least squares."""

from __future__ import annotations

import numpy as np
import pytest

from tvsbayes.errors import InputError
from tvsbayes.head.pointing_model import pointing_model
from tvsbayes.head.pointing_table import campaign_of, read_stars
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.campaign import read_campaign, write_campaign
from tvsbayes.instrument.counter_limits import COUNTER_MAX
from tvsbayes.twin.head_physics import head_beam

TERMS = {
    "azimuth_zero_deg": 0.3,
    "elevation_zero_deg": -0.1,
    "azimuth_axis_tilt_deg.north": 0.02,
    "azimuth_axis_tilt_deg.east": -0.01,
    "axes_not_square_deg": 0.015,
    "beam_not_square_deg": -0.02,
    "flexure_deg": 0.01,
}
QUIET = {"tangent_flexure_deg": 0.0, "elevation_axis_offset_mm": 0.0, "beam_offset_mm.y": 0.0, "beam_offset_mm.z": 0.0}
BLOCK = """CAT: {name} 00:00:00.0 +00:00:00.0
RAA: {el:.7f} {az:.7f}
AA: 0 0
ODD: one more column 1 2 3
TAA: {true_el:.7f} {true_az:.7f} {more}
LST: {hours}:{minutes:02d}:00.0
"""


def table(count, turns=1.0, seed=3):
    """Stars at all azimuths and up to 89 deg, azimuth over several turns; encoders are within one."""
    rng = np.random.default_rng(seed)
    pan = rng.uniform(-180 * turns, 180 * turns, count)
    tilt = np.concatenate([[89.0], rng.uniform(15, 85, count - 1)])
    _, beam = head_beam(np.radians(pan), np.radians(tilt + TERMS["elevation_zero_deg"]), {**QUIET, **TERMS})
    azimuth = np.degrees(np.arctan2(beam[:, 1], beam[:, 0]))
    azimuth += 360 * np.round((pan - azimuth) / 360)
    return [
        BLOCK.format(
            name=k,
            el=tilt[k],
            az=(180 - pan[k]) % 360,
            true_el=np.degrees(np.arcsin(beam[k, 2])),
            true_az=180 - azimuth[k],
            more="",
            hours=(22 + k // 20) % 24,
            minutes=3 * (k % 20),
        )
        for k in range(count)
    ]


def test_terms_of_a_table_with_wraps(tmp_path):
    """The sidereal clock passes midnight and azimuth its end; the pole is included."""
    path = tmp_path / "night.dat"
    path.write_text("".join(table(40, turns=1.4)))
    campaign = campaign_of(read_stars(path).stars, "night")
    write_campaign(campaign, tmp_path / "night")
    assert read_campaign(tmp_path / "night").moves == campaign.moves
    assert np.all(np.diff([move.time_s for move in campaign.moves]) > 0)
    model = pointing_model(campaign)
    # Seven decimals of a degree, over the cosine of 89 deg.
    for name, value, error in zip(model.names, model.value, model.standard_error, strict=True):
        assert abs(value - TERMS.get(name, model.known.get(name, 0.0))) < 1e-5 + 5 * error, name
    assert model.rms_deg < 1e-5


def test_encoders_that_are_absolute_are_stated(tmp_path):
    """On the axes without play; before the gears with it."""
    path = tmp_path / "night.dat"
    path.write_text("".join(table(5)))
    stars = read_stars(path).stars
    rigs = {kind: campaign_of(stars, "night", encoders=kind).rig for kind in (None, "incremental", "motor", "output")}
    assert [rig.absolute for rig in rigs.values()] == [(), (), AXES, AXES]
    plays = [rig.priors["backlash_deg.tilt"].u for rig in rigs.values()]
    assert plays[0] == plays[1] == plays[2] > 0 == plays[3]


def test_azimuth_of_a_long_night_stays_within_its_turns(tmp_path):
    """The shorter way from star to star would add many turns over 400 stars."""
    path = tmp_path / "night.dat"
    path.write_text("".join(table(400)))
    steps = [move.pan_steps for move in campaign_of(read_stars(path).stars, "night").moves]
    assert np.ptp(steps) < 360e5 and max(map(abs, steps)) < COUNTER_MAX


def test_broken_blocks_are_left_out_and_malformed_ones_refused(tmp_path):
    path, blocks = tmp_path / "night.dat", table(5)
    path.write_text("".join([*blocks[:3], blocks[3].split("TAA")[0], blocks[4]]))
    catalogue = read_stars(path)
    assert (len(catalogue.stars), catalogue.left_out) == (4, 1)
    path.write_text("".join([*blocks[:2], blocks[2].replace("RAA: ", "RAA: x")]))
    with pytest.raises(InputError) as refused:
        read_stars(path)
    assert refused.value.line == 13
    path.write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="begin with CAT:"):
        read_stars(path)


def test_a_head_without_sightings_has_nothing_to_estimate(ask, tmp_path):
    assert ask("new", tmp_path / "head", "--mechanism", "pan-tilt", "--sightings")[0] == 0
    code, document = ask("classic", tmp_path / "head")
    assert (code, document["error"]["code"]) == (3, "too-few-sightings")
