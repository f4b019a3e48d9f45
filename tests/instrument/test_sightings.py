"""Campaigns of a head with measured directions: files, refusals, findings of `check`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tvsbayes.errors import InputError
from tvsbayes.estimators.plausibility import check_campaign, misfit_causes
from tvsbayes.instrument.campaign import read_campaign, write_campaign
from tvsbayes.instrument.mechanisms import SIGHTING_HEAD, TWO_MIRROR
from tvsbayes.instrument.plan import PlanBuilder
from tvsbayes.instrument.rig import Rig, RigTable
from tvsbayes.instrument.sightings import tangent_frames
from tvsbayes.report import figures as plots
from tvsbayes.twin.simulated_campaign import simulate
from tvsbayes.twin.true_rig import read_truth

PLACES = [(-900, 200), (-400, 900), (100, 500), (600, 1200), (1100, 300), (-1300, 700), (300, 1000), (900, 600)]


def head_rig() -> Rig:
    """A head with gears of 0.05 deg a step and axes some degrees from their nominal direction."""
    table = RigTable(mechanism=SIGHTING_HEAD)
    return Rig(table, None, dict(table.priors), {}, {}, {}, {"move_s": 1.0, "look_s": 1.0})


@pytest.fixture(scope="module")
def simulated():
    plan = PlanBuilder()
    plan.home(0, 0)
    for pan, tilt in PLACES:
        plan.move(pan, tilt)
        plan.look()
    return simulate(head_rig(), plan.steps, 7)


def test_folder_of_sightings_round_trips(simulated, tmp_path):
    simulated.write(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "campaign.toml",
        "moves.csv",
        "sightings.csv",
        "truth.json",
    ]
    campaign = read_campaign(tmp_path)
    assert campaign.spots == simulated.campaign.spots
    assert campaign.rig == simulated.campaign.rig
    text = (tmp_path / "campaign.toml").read_text() + (tmp_path / "truth.json").read_text()
    scanners = set(TWO_MIRROR.names) - set(SIGHTING_HEAD.names)
    assert not [name for name in scanners if f'"{name}"' in text]
    truth = read_truth(tmp_path / "truth.json", campaign.stereo)
    assert truth.parameters["azimuth_zero_deg"] == simulated.truth.parameters["azimuth_zero_deg"]
    assert not check_campaign(campaign).findings


@pytest.mark.parametrize(
    "of_spots", [plots.points_3d, plots.setup, plots.coverage, lambda campaign: campaign.stereo_pair]
)
def test_functions_of_spots_refuse_sightings(simulated, of_spots):
    with pytest.raises(InputError, match=r"found sightings of a head.*; allowed: spots that a stereo pair sees; give"):
        of_spots(simulated.campaign)


def test_causes_of_a_failed_fit_need_no_spots(simulated):
    assert misfit_causes(simulated.campaign, 3.0) == ()


def test_two_tables_of_looks_are_refused(simulated, tmp_path):
    write_campaign(simulated.campaign, tmp_path)
    (tmp_path / "spots.csv").write_text("spot\n")
    with pytest.raises(InputError, match="one of them"):
        read_campaign(tmp_path)


def test_sightings_of_a_scanner_are_refused(simulated, tmp_path):
    write_campaign(simulated.campaign, tmp_path)
    (tmp_path / "campaign.toml").write_text('format = "tvsbayes-campaign/1"\n[rig]\n')
    with pytest.raises(InputError, match='mechanism = "pan-tilt"'):
        read_campaign(tmp_path)


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (lambda s: replace(s, azimuth_deg=-s.azimuth_deg), "counter-sign"),
        (lambda s: replace(s, azimuth_deg=s.elevation_deg, elevation_deg=s.azimuth_deg), "exchanged"),
    ],
)
def test_wrong_tables_are_named(simulated, change, code):
    wrong = tuple(map(change, simulated.campaign.spots))
    campaign = type(simulated.campaign)(simulated.campaign.moves, wrong, None, simulated.campaign.rig)
    findings = check_campaign(campaign).findings
    assert next(f.code for f in findings if f.certain) == code


def test_tangent_frames_are_orthonormal_at_the_pole():
    frames = tangent_frames(np.array([[0.0, 0.0], [400.0, 89.9999], [-30.0, 90.0], [10.0, -90.0]]))
    assert np.allclose(frames @ np.swapaxes(frames, 1, 2), np.eye(3), atol=1e-15)
    assert np.allclose(frames[0], [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
