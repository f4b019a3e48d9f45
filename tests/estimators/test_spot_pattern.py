"""Mistakes in tables that the spots reveal, each named; good campaigns have no finding."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from experiments.robustness.mistakes import MISTAKES
from tvsbayes.estimators.plausibility import implausible
from tvsbayes.estimators.spot_pattern import mismatch_px, mismatch_spread_px, pattern_of
from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.campaign import pixels_of, read_campaign
from tvsbayes.instrument.stereo_pair import project_pair, triangulate

TWINS = ("paper_twin", "grid_twin")
SEEN = [name for name in MISTAKES if name not in ("none", "pan and tilt exchanged", "pixels counted from 1")]
"""Those that every campaign shows (experiments/robustness/mistakes.md)."""


@pytest.fixture(scope="module")
def twins():
    return {name: read_campaign(shipped_data() / "twins" / name) for name in TWINS}


@pytest.mark.parametrize("twin", TWINS)
@pytest.mark.parametrize("mistake", SEEN)
def test_a_mistake_is_called_by_its_name(twins, twin, mistake):
    """Nothing else has this finding."""
    change, words = MISTAKES[mistake]
    sentences = [finding.sentence for finding in implausible(change(twins[twin], np.random.default_rng(2)))]
    assert sentences and all(any(word in text for word in words.split("|")) for text in sentences), sentences


def test_columns_exchanged(twins):
    rng = np.random.default_rng(1)
    assert "columns exchanged" in implausible(MISTAKES["pan and tilt exchanged"][0](twins["grid_twin"], rng))[0].message


@pytest.mark.parametrize(
    ("lag", "begin", "side"), [(-1, 0, "after"), (1, 0, "before"), (1, 60, "before"), (-1, 91, "after")]
)
def test_rows_that_are_one_apart_are_named_from_where_they_are(twins, lag, begin, side):
    """A log that counts from 1 shifts all pictures, a missing row all behind it."""
    campaign = twins["grid_twin"]
    last = len(campaign.moves) - 1
    spots = [replace(s, move=min(max(s.move + lag * (s.spot >= begin), 0), last)) for s in campaign.spots]
    (message,) = (finding.message for finding in implausible(replace(campaign, spots=tuple(spots))))
    assert f"spots follow the counters of the move {side} theirs" in message
    assert message.startswith("spots follow" if begin == 0 else f"from spot {begin} on")


def test_counters_that_nothing_follows_are_not_those_of_the_row_beside(twins):
    campaign = twins["grid_twin"]
    order = np.random.default_rng(3).permutation(len(campaign.moves))
    moves = [
        replace(m, pan_steps=campaign.moves[k].pan_steps, tilt_steps=campaign.moves[k].tilt_steps)
        for m, k in zip(campaign.moves, order, strict=True)
    ]
    findings = implausible(replace(campaign, moves=tuple(moves)))
    assert len(findings) == 2 and all("do not follow" in each.message for each in findings)


def test_centres_scatter_as_left_and_right_say(twins):
    """The twin's noise is pixel_scale times 0.1 px; the median of 144 estimates a spread to 10 %, here three."""
    campaign = twins["grid_twin"]
    rng = np.random.default_rng(6)
    pixels = pixels_of(campaign.spots) + 0.7 * rng.standard_normal((len(campaign.spots), 4))
    pattern = pattern_of(campaign, campaign.spots, triangulate(campaign.stereo, pixels))
    pattern = replace(pattern, pixels=pixels, mismatch_px=mismatch_px(campaign.stereo, pixels, pattern.points_mm))
    assert mismatch_spread_px(pattern) == pytest.approx(0.7, rel=0.3)


def test_points_return_to_their_pixels(twins):
    """Through both lenses, to the 1e-6 px of undistortion; a spot off its epipolar line keeps half of the offset."""
    stereo = twins["grid_twin"].stereo
    points = np.array([[200.0, -30.0, 10.0], [400.0, 60.0, -20.0]])
    pixels = project_pair(stereo, points)
    np.testing.assert_allclose(triangulate(stereo, pixels), points, rtol=0, atol=1e-5)
    assert np.all(mismatch_px(stereo, pixels, points) < 1e-9)
    moved = pixels + np.array([0.0, 2.0, 0.0, 0.0])
    # Least squares share the offset of one camera between both: 2 / sqrt(2), to the tilt of the epipolar lines.
    np.testing.assert_allclose(mismatch_px(stereo, moved, triangulate(stereo, moved)), 2**0.5, rtol=0.1)
