"""What a page shows, without a browser: from the fit, or from what is stated."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from support.viewed_twin import UNDETECTED

from tvsbayes.errors import InputError
from tvsbayes.instrument.campaign import ordered_spots, read_campaign, with_pixels
from tvsbayes.instrument.parameters import names_of
from tvsbayes.view.page import document
from tvsbayes.view.scene import NOT_FITTED, NOT_OF_THESE, Looked, look_at, scene, stored_campaign


@pytest.fixture(scope="module")
def stored(viewed):
    return stored_campaign(viewed.folder)


@pytest.fixture(scope="module")
def shown(stored):
    return scene(stored.campaign, stored.fitted)


def test_spots_expected_are_those_of_the_fit(stored, shown):
    from tvsbayes.posterior.predictive import looks, turned_by

    fit = stored.fitted.fit
    turned = turned_by(fit.arrays, np.asarray(fit.mode.place_errors_rad)[None])
    expected = looks(fit, fit.z[None], turned)[0]
    numbers = [spot.spot for spot in ordered_spots(stored.campaign)]
    rows = [shown.looks.spot.tolist().index(spot) for spot in numbers]
    # Rounding of pixels of a thousand.
    np.testing.assert_allclose(shown.looks.predicted_px[rows], expected, atol=1e-8)
    assert shown.fitted and shown.notes == ()


def test_beams_leave_by_the_law_of_reflection(shown):
    looks = shown.looks
    used = np.isfinite(looks.end_mm).all(axis=1)

    def unit(way):
        return way / np.linalg.norm(way, axis=1, keepdims=True)

    first, second = looks.mirrors_mm[:, 0], looks.mirrors_mm[:, 1]
    between, leaving = unit(second - first), unit(looks.end_mm - second)
    normal = looks.normals[:, 1]
    reflected = between - 2 * np.sum(between * normal, axis=1, keepdims=True) * normal
    np.testing.assert_allclose(reflected[used], leaving[used], atol=1e-9)
    # Stops of 0.1 deg, seen at 0.3 m: the spot lies within millimetres of the beam's end.
    assert np.linalg.norm(looks.end_mm - looks.point_mm, axis=1)[used].max() < 5
    assert np.linalg.norm(first[used] - shown.origin_mm, axis=1).max() < 20


def test_look_without_a_spot_is_there_without_numbers(shown):
    looks = shown.looks
    (row,) = np.flatnonzero(looks.spot == UNDETECTED)
    assert looks.status[row] == "undetected"
    for column in (looks.pixels_px, looks.predicted_px, looks.point_mm, looks.end_mm, looks.sd_px):
        assert np.isnan(column[row]).all()
        assert np.isfinite(np.delete(column, row, axis=0)).all()


def test_stops_stand_at_their_looks(stored, shown):
    looks = shown.looks
    assert len(stored.fitted.stops) > 17
    for stop in stored.fitted.stops[::17]:
        column = ("pan", "tilt").index(stop.axis)
        rows = np.isin(looks.spot, stop.spots)
        assert set(looks.deviation_deg[rows, column]) == {stop.deviation_deg}
        assert set(looks.steps[rows, column]) == {stop.steps}
        assert {looks.direction[row][column] for row in np.flatnonzero(rows)} == {stop.direction}


def test_folder_without_results_shows_the_stated_rig(viewed):
    looked = look_at(viewed.bare)
    (shown,) = looked.scenes
    assert not shown.fitted and shown.notes == (NOT_FITTED,) and looked.changes is None
    assert np.isnan(shown.looks.predicted_px).all() and np.isnan(shown.looks.deviation_deg).all()
    priors = read_campaign(viewed.bare).rig.priors
    stated = [priors[name].value for name in names_of("extrinsics.translation_mm")]
    np.testing.assert_allclose(shown.origin_mm, stated)
    assert {row.name for row in shown.parameters} >= set(priors)
    # The stated rig is not turned and its laser not tilted: straight down onto the first mirror, then to the second.
    looks, down = shown.looks, np.array([0.0, 0.0, -1.0])
    used = np.isfinite(looks.end_mm).all(axis=1)
    between = (looks.mirrors_mm[:, 1] - looks.mirrors_mm[:, 0])[used]
    reflected = down - 2 * (looks.normals[used, 0] @ down)[:, None] * looks.normals[used, 0]
    np.testing.assert_allclose(reflected, between / np.linalg.norm(between, axis=1, keepdims=True), atol=1e-9)
    assert np.isfinite(shown.looks.end_mm).all(axis=1).sum() == len(shown.looks.spot) - 1


def test_results_of_other_data_are_not_used(viewed, tmp_path):
    folder = tmp_path / "changed"
    shutil.copytree(viewed.folder, folder)
    table = (folder / "spots.csv").read_text()
    (folder / "spots.csv").write_text(table.replace(",ok", ",blurred", 1))
    assert stored_campaign(folder).note == NOT_OF_THESE
    (folder / "results" / "fit.json").write_text("{")
    shutil.copyfile(viewed.folder / "spots.csv", folder / "spots.csv")
    with pytest.raises(InputError, match=r"fit\.json"):
        stored_campaign(folder)


def test_campaign_without_a_usable_spot(viewed):
    campaign = read_campaign(viewed.bare)
    blind = replace(campaign, spots=tuple(with_pixels(spot, "undetected") for spot in campaign.spots))
    shown = scene(blind)
    assert np.isnan(shown.origin_mm).all() and shown.sheets == () and len(shown.cameras) == 2
    page = json.loads(document(Looked((shown,))))
    assert page["scenes"][0]["rig"]["origin_mm"] is None


@pytest.mark.thorough
def test_two_campaigns_with_what_has_changed(viewed):
    looked = look_at(viewed.folder, viewed.folder)
    assert len(looked.scenes) == 2 and looked.changes.verdict == "no significant change"
    page = json.loads(document(looked))
    assert [change["significant"] for change in page["changes"]["changes"]] == [False] * 6
    assert look_at(viewed.folder, viewed.bare).changes is None
