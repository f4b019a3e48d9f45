"""Plausibility of a campaign before any fit: readable numbers that no rig can have measured are named."""

from __future__ import annotations

import datetime
import json
from dataclasses import replace

import numpy as np
import pytest

from experiments.robustness.mistakes import MISTAKES
from tvsbayes.cli.main import run
from tvsbayes.estimators.plausibility import check_campaign, implausible, misfit_causes
from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.campaign import PIXEL_SDS, PIXELS, Campaign, read_campaign, write_campaign
from tvsbayes.instrument.protocols import PROTOCOLS
from tvsbayes.instrument.stereo_pair import project_pair, rotation_matrix
from tvsbayes.twin.simulated_campaign import simulate


@pytest.fixture(scope="module")
def paper_twin() -> Campaign:
    return read_campaign(shipped_data() / "twins" / "paper_twin")


def warnings_of(campaign: Campaign) -> str:
    return "\n".join(check_campaign(campaign).warnings)


@pytest.mark.parametrize(("name", "experiments", "readings"), [("paper_twin", 96, 0), ("grid_twin", 0, 144)])
def test_shipped_twins_have_no_warning(name, experiments, readings):
    check = check_campaign(read_campaign(shipped_data() / "twins" / name))
    assert check.warnings == ()
    assert (check.experiments, check.aperture_readings, check.refused) == (experiments, readings, {})
    assert check.ok_spots == check.spots


def test_the_papers_protocol_is_warned_of_on_both_axes(mounted_rig):
    text = warnings_of(simulate(mounted_rig, PROTOCOLS["paper"](), seed=2).campaign)
    # Not "only one": between pan and tilt experiments each axis goes to its middle once.
    for axis in ("pan", "tilt"):
        reason = "nearly every leg has |N| = 200 and reverses"
        assert f"{axis} ratio and {axis} backlash are poorly separated: {reason}" in text


def test_lengths_in_metres_and_angles_in_radians_are_suspected(paper_twin):
    metres = replace(paper_twin.stereo, T=paper_twin.stereo.T / 1000)
    assert "is it in metres?" in warnings_of(replace(paper_twin, stereo=metres))
    reversed_pair = replace(paper_twin.stereo, T=-paper_twin.stereo.T)
    assert "second camera" in warnings_of(replace(paper_twin, stereo=reversed_pair))
    grid = read_campaign(shipped_data() / "twins" / "grid_twin")
    for change, words in (
        (np.radians, "are they in radians?"),
        (lambda reading: -reading, "outside 0 to 180 deg"),
        (lambda reading: 180.0 + reading, "outside 0 to 180 deg"),
    ):
        spots = tuple(replace(s, aperture_deg=float(change(s.aperture_deg))) for s in grid.spots)
        assert words in warnings_of(replace(grid, spots=spots))


def test_a_status_that_misses_its_word_is_named(paper_twin):
    first, second, *rest = paper_twin.spots
    spots = (replace(first, status="OK"), replace(second, status="undetected"), *rest)
    text = warnings_of(replace(paper_twin, spots=spots))
    assert "spots 0 are left out: their status is not spelt ok" in text
    assert "spots 1 are undetected and have pixels" in text


def test_commands_that_estimate_repeat_what_no_rig_can_have_measured(paper_twin, tmp_path, capfd):
    """Nothing makes a user run `check` first; stdout stays the document."""
    write_campaign(MISTAKES["cameras swapped"][0](paper_twin, None), tmp_path / "swapped")
    run(["classic", str(tmp_path / "swapped"), "--json"])
    printed = capfd.readouterr()
    assert "warning: spots 0, 1" in printed.err and "swapped" in printed.err
    json.loads(printed.out)


def test_one_depth_is_named_and_two_are_not(paper_twin):
    near = tuple(replace(s, experiment=None, point=None) for s in paper_twin.spots if s.target == "d1")
    assert "all spots lie at one depth" in warnings_of(replace(paper_twin, spots=near))
    assert "depth" not in warnings_of(paper_twin)
    # Another warning does not hide it.
    misspelt = (replace(near[0], status="OK"), *near[1:])
    assert "all spots lie at one depth" in warnings_of(replace(paper_twin, spots=misspelt))


def test_zero_and_assumed_stereo_covariance_are_named(paper_twin):
    zero = replace(paper_twin.stereo, parameter_covariance=np.zeros((24, 24)))
    assert "stereo covariance is zero" in warnings_of(replace(paper_twin, stereo=zero))
    assumed = replace(paper_twin.stereo, assumed=True)
    assert "stereo covariance is assumed" in warnings_of(replace(paper_twin, stereo=assumed))


@pytest.mark.parametrize(
    ("created", "calibrated", "doubtful"),
    [
        (datetime.datetime(2026, 1, 15, 10, tzinfo=datetime.UTC), datetime.date(2026, 1, 16), True),
        (datetime.datetime(2026, 1, 15, 10, tzinfo=datetime.UTC), datetime.datetime(2026, 1, 15, 18), False),
        (datetime.date(2026, 1, 15), datetime.date(2026, 1, 3), False),
        (None, datetime.date(2026, 1, 16), False),
    ],
)
def test_cameras_calibrated_after_the_campaign_are_named(paper_twin, created, calibrated, doubtful):
    header = {"created": created, "traceability": {"stereo_calibrated": calibrated}}
    text = warnings_of(replace(paper_twin, header={key: value for key, value in header.items() if value}))
    assert ("stereo_calibrated 2026-01-16 is later than created 2026-01-15" in text) is doubtful


def test_unknown_approach_is_named_with_its_segment(paper_twin):
    first = replace(paper_twin.moves[0], tilt_approach="unknown")
    moves = (first, *paper_twin.moves[1:])
    assert "segment 0 begins with an unknown approach" in warnings_of(replace(paper_twin, moves=moves))


def test_incomplete_experiments_and_refused_spots_are_counted(paper_twin):
    spots = list(paper_twin.spots)
    spots[5] = replace(spots[5], status="saturated")
    check = check_campaign(replace(paper_twin, spots=tuple(spots)))
    assert check.refused == {"saturated": 1}
    assert (check.ok_spots, check.experiments) == (383, 95)
    assert [w for w in check.warnings if w.startswith("experiment 1 (left) is not complete")]


def test_swapped_cameras_and_wrong_units_are_certain(paper_twin):
    """Where exchanged pictures put all spots on sheets; where no lens, no pair and no sheet can be meant."""
    swapped = MISTAKES["cameras swapped"][0](paper_twin, None)
    (finding,) = implausible(swapped)
    assert (finding.code, finding.certain, finding.line) == ("cameras-swapped", True, 2) and "--swap" in finding.remedy
    assert "spots 0, 1, 2, 3, 4, 5, 6, 7, 8, 9 and 374 more triangulate outside" in warnings_of(swapped)
    metres = replace(paper_twin.stereo, T=paper_twin.stereo.T / 1000)
    grid = read_campaign(shipped_data() / "twins" / "grid_twin")
    radians = tuple(replace(s, aperture_deg=float(np.radians(s.aperture_deg))) for s in grid.spots)
    for campaign, file in (
        (MISTAKES["centres in millimetres"][0](paper_twin, None), "spots.csv"),
        (replace(paper_twin, stereo=metres), "stereo.json"),
        (replace(grid, spots=radians), "spots.csv"),
    ):
        first = implausible(campaign)[0]
        assert (first.code, first.certain, first.file) == ("units", True, file)
    # A mirror may sit 0.4 mm off: a doubt.
    assert not any(f.certain for f in implausible(MISTAKES["mirror offset in metres"][0](paper_twin, None)))


def test_mismatched_pictures_are_not_called_swapped(paper_twin):
    """Spots behind the cameras that exchanged pictures bring nowhere either."""
    rng = np.random.default_rng(5)
    order = rng.permutation(len(paper_twin.spots))
    names = ("u_right_px", "v_right_px")
    mixed = tuple(
        replace(s, **{n: getattr(paper_twin.spots[k], n) for n in names})
        for s, k in zip(paper_twin.spots, order, strict=True)
    )
    assert not any(f.certain for f in implausible(replace(paper_twin, spots=mixed)))


def test_a_transposed_rotation_is_named(paper_twin):
    """Of cameras that stand half a degree apart; the spots are those that the pair with R itself sees."""
    turned = replace(paper_twin.stereo, R=rotation_matrix(np.array([0.01, 0.004, 0.0])))
    pixels = project_pair(turned, paper_twin.usable_points_mm).tolist()
    ok = [spot for spot in paper_twin.spots if spot.status == "ok"]
    spots = tuple(replace(s, **dict(zip(PIXELS, row, strict=True))) for s, row in zip(ok, pixels, strict=True))
    assert "pictures" not in {f.code for f in implausible(replace(paper_twin, spots=spots, stereo=turned))}
    wrong = replace(paper_twin, spots=spots, stereo=replace(turned, R=turned.R.T))
    assert any("R of stereo.json looks transposed" in f.sentence for f in implausible(wrong))


def test_swapped_pictures_that_contradict_each_other_are_a_doubt(paper_twin):
    """Rows 30 px apart fit no pair, exchanged or not."""
    swapped = MISTAKES["cameras swapped"][0](paper_twin, None)
    apart = tuple(replace(s, v_right_px=s.v_right_px + 30) for s in swapped.spots)
    (finding,) = implausible(replace(paper_twin, spots=apart))
    assert (finding.code, finding.certain) == ("cameras-swapped", False)


def test_pixels_that_count_from_one_show_at_the_edge(paper_twin):
    """(0.5, size + 0.5) is where they lie: one beyond the picture may be a spot that the edge cuts, two are none."""
    edge = paper_twin.stereo.image_width - 0.5
    spots = paper_twin.spots

    def moved(count: int, by_px: float):
        return replace(paper_twin, spots=(*(replace(s, u_left_px=edge + by_px) for s in spots[:count]), *spots[count:]))

    def certain(campaign):
        return [f.certain for f in implausible(campaign) if f.code == "pixels-from-one"]

    assert certain(moved(2, 0.4)) == [True] and certain(moved(1, 0.4)) == [False]
    assert certain(moved(2, -0.1)) == [] and certain(moved(2, 1.1)) == []
    near_zero = moved(2, 0.4)
    assert certain(replace(near_zero, spots=(*near_zero.spots[:-1], replace(spots[-1], v_right_px=0.2)))) == []


@pytest.mark.parametrize(
    ("su_px", "scale", "code"), [(0.08, 1.0, None), (0.004, 20.0, "pixel-noise"), (0.08, 9.0, "beam-scatter")]
)
def test_what_explains_a_failed_fit(paper_twin, su_px, scale, code):
    """Left and right scatter by what the twin was drawn with, 0.08 px to a factor of 1.6; su and sv say another."""
    spots = tuple(replace(s, **dict.fromkeys(PIXEL_SDS, su_px)) for s in paper_twin.spots)
    campaign = replace(paper_twin, spots=spots)
    assert implausible(campaign) == ()
    assert [f.code for f in misfit_causes(campaign, scale)] == ([code] if code else [])
    turned_round = MISTAKES["pan sign"][0](campaign, None)
    assert misfit_causes(turned_round)[0].code == "counter-sign"


def test_a_campaign_without_usable_spots_is_reported_once(paper_twin):
    spots = tuple(replace(s, status="too dim", experiment=None, point=None) for s in paper_twin.spots)
    check = check_campaign(replace(paper_twin, spots=spots))
    assert check.ok_spots == 0
    assert check.warnings == ("no spot has status ok: there is nothing to estimate from",)
