"""Predictive looks scatter as the rig does: stop errors by direction, home offsets by segment, play."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import equinox as eqx
import numpy as np
import pytest
from support.drawn_quantities import drawn_quantities
from support.small_campaign import small_campaign

from tvsbayes.estimators.campaign_arrays import campaign_arrays
from tvsbayes.estimators.joint_fit import Alternative
from tvsbayes.estimators.likelihood import no_draw
from tvsbayes.instrument.campaign import Campaign, ordered_spots
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.parameters import names_of
from tvsbayes.posterior import predictive
from tvsbayes.posterior.draws import Posterior
from tvsbayes.posterior.homing_mixture import mixed
from tvsbayes.posterior.predictive import ideal_pixels, looks_again, move_log_likelihood, predictive_pixels
from tvsbayes.results.convergence import Importance, NamedValue, Reweighted

DRAWS = 2000
SDS_DEG = {"left": 0.16, "right": 0.02, "up": 0.08, "down": 0.04}
PLAY_SD_DEG = 0.11
HOME_SD_DEG = 0.05


def variances_by_hand(moves, spot) -> tuple[float, float]:
    """Variance of both mirror angles at a spot, deg^2: the last move that turned the axis, and the segment's homing."""
    result = []
    for axis, (positive, negative) in (("pan", ("left", "right")), ("tilt", ("up", "down"))):
        number = spot.move
        while not moves[number].pan_approach and getattr(moves[number], f"{axis}_steps") == getattr(
            moves[number - 1], f"{axis}_steps"
        ):
            number -= 1
        move, home = moves[number], HOME_SD_DEG**2 * (moves[spot.move].segment > 0)
        if move.pan_approach:
            side = getattr(move, f"{axis}_approach")
            stop = SDS_DEG[side] ** 2 if side in SDS_DEG else (SDS_DEG[positive] ** 2 + SDS_DEG[negative] ** 2) / 2
        else:
            forward = getattr(move, f"{axis}_steps") > getattr(moves[number - 1], f"{axis}_steps")
            stop = SDS_DEG[positive if forward else negative] ** 2
        result.append(stop + home)
    return result[0], result[1]


def taken_again_deg(dozen, physical: np.ndarray, play_deg: np.ndarray, seed: int) -> np.ndarray:
    """Angles that looks taken again are off by, shape (draws, spots, 2), at plays of these sds (spots, 2)."""
    caught = []

    def looks(fit, z, error_rad):
        caught.append(np.degrees(error_rad[:, : len(play_deg)]))
        return np.zeros((len(z), len(play_deg), 4))

    linearised = SimpleNamespace(play_sd_rad=np.radians(play_deg))
    fit = SimpleNamespace(campaign=dozen.campaign, space=dozen.space, arrays=dozen.arrays, linearised=linearised)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tvsbayes.posterior.predictive.looks", looks)
        generator = np.random.default_rng(seed)
        # Pixels that err by nothing.
        assert not looks_again(fit, np.zeros((DRAWS, 1)), physical, no_draw(DRAWS, dozen.arrays), generator).any()
    return caught[0]


@pytest.fixture(scope="module")
def errors_deg(dozen):
    """Of stops, homings and play, and the play's sd at each spot."""
    play_deg = np.zeros((len(ordered_spots(dozen.campaign)), 2))
    # Two spots of one segment: where the play stands is one place for both.
    play_deg[[4, 5], 1] = PLAY_SD_DEG
    physical = np.ones((DRAWS, len(TWO_MIRROR.names)))
    for name, sd in SDS_DEG.items():
        physical[:, TWO_MIRROR.index[f"stop_sd_deg.{name}"]] = sd
    physical[:, [TWO_MIRROR.index[name] for name in names_of("home_sd_deg")]] = HOME_SD_DEG
    for name in ("pixel_scale", *names_of("drift_deg_per_root_hour", "look_scatter_deg")):
        physical[:, TWO_MIRROR.index[name]] = 0.0
    return taken_again_deg(dozen, physical, play_deg, 4), play_deg


def test_every_look_scatters_by_its_direction_its_homing_and_its_play(dozen, errors_deg):
    errors, play_deg = errors_deg
    spots = ordered_spots(dozen.campaign)
    expected = np.array([variances_by_hand(dozen.campaign.moves, spot) for spot in spots]) + play_deg**2
    assert len(np.unique(expected.round(9))) > 5, "the campaign does not tell the directions apart"
    # A variance from n normal numbers has the relative standard error sqrt(2 / n); five of them.
    np.testing.assert_allclose(errors.var(axis=0), expected, rtol=5 * np.sqrt(2 / DRAWS))
    assert np.abs(errors.mean(axis=0)).max() < 5 * np.sqrt(expected.max() / DRAWS)


def test_an_error_is_held_while_its_axis_stands(dozen, errors_deg):
    errors, _ = errors_deg
    spots, moves = ordered_spots(dozen.campaign), dozen.campaign.moves
    held = 0
    for row in range(1, len(spots)):
        between = moves[spots[row - 1].move : spots[row].move + 1]
        for axis, name in enumerate(("pan_steps", "tilt_steps")):
            same = len({getattr(m, name) for m in between}) == 1 and not any(m.pan_approach for m in between[1:])
            change = np.abs(errors[:, row, axis] - errors[:, row - 1, axis]).max()
            if same and row not in (4, 6):
                assert change < 1e-12
                held += 1
            elif not same:
                assert change > 0
    assert held >= 5


def test_an_absolute_zero_walks_on_over_homings(dozen):
    """From the first move on; that of the other axis is set by its homings and walks from there."""
    campaign = replace(dozen.campaign, rig=replace(dozen.campaign.rig, absolute=("pan",)))
    spots, moves = ordered_spots(campaign), campaign.moves
    physical = np.zeros((DRAWS, len(TWO_MIRROR.names)))
    physical[:, [TWO_MIRROR.index[name] for name in names_of("drift_deg_per_root_hour")]] = 2.0
    physical[:, [TWO_MIRROR.index[name] for name in names_of("home_sd_deg")]] = HOME_SD_DEG
    of_pan = replace(dozen, campaign=campaign, arrays=campaign_arrays(campaign))
    errors = taken_again_deg(of_pan, physical, np.zeros((len(spots), 2)), 6)
    begun = {m.segment: m.time_s for m in reversed(moves)}
    hours = np.array([[moves[s.move].time_s - begun[k] for k in (0, moves[s.move].segment)] for s in spots]) / 3600
    expected = 4.0 * hours + [[0.0, HOME_SD_DEG**2 * (moves[s.move].segment > 0)] for s in spots]
    np.testing.assert_allclose(errors.var(axis=0), expected, rtol=5 * np.sqrt(2 / DRAWS))


def test_looks_taken_again_scatter_about_their_stops(dozen):
    """By 0.2 deg of pan and 0.1 of tilt, at every look another; stops, homings and play that err by nothing."""
    count = len(ordered_spots(dozen.campaign))
    none = np.zeros(dozen.arrays.spots.homed.shape)
    dozen = replace(dozen, arrays=eqx.tree_at(lambda a: a.spots.homed, dozen.arrays, none))
    physical = np.zeros((DRAWS, len(TWO_MIRROR.names)))
    physical[:, [TWO_MIRROR.index[name] for name in names_of("look_scatter_deg")]] = 0.2, 0.1
    errors = taken_again_deg(dozen, physical, np.zeros((count, 2)), 5)
    tolerance = 5 * np.sqrt(2 / DRAWS)
    np.testing.assert_allclose(errors.var(axis=0), np.full((count, 2), (0.04, 0.01)), rtol=tolerance)
    between = np.corrcoef(errors[..., 0].T)[np.triu_indices(count, 1)]
    assert np.abs(between).max() < 5 / np.sqrt(DRAWS)


@dataclass(frozen=True)
class FitOfOneWay:
    """What the predictions read of a fit; its arrays are a number that identifies it."""

    campaign: Campaign
    arrays: SimpleNamespace
    sides: dict[str, str]
    alternatives: tuple[Alternative, ...] = ()
    space: None = None

    @property
    def mixture(self) -> tuple[Alternative, ...]:
        return self.alternatives


def posterior_of_two_ways() -> Posterior:
    """Two homing hypotheses, as probable: of the first the coordinate of every draw is 0, of the second 1."""
    campaign, count = small_campaign(), 50
    used = np.ones(len(ordered_spots(campaign)), dtype=bool)
    one, other = (
        FitOfOneWay(campaign, SimpleNamespace(used=used, number=float(k)), {"pan": side})
        for k, side in enumerate(("left", "right"))
    )
    ways = tuple(Alternative(each.sides, 0.5, each) for each in (one, other))
    worst = NamedValue("none", 500.0)
    reweighted = Reweighted(Importance(True, (), 1, count, 1.0, worst, 0.1, worst, 0.02, 0.0, 0.0, 0), {}, {}, {})
    parts = []
    for number, fit in enumerate((replace(one, alternatives=ways), other)):
        z = np.full((1, count, 1), float(number))
        draws = drawn_quantities(1, count)
        weights = np.full((1, count), 1 / count)
        parts.append(Posterior(fit, z, z[..., 0], draws, weights, reweighted, 0, 0.0))
    return mixed(parts, np.array([0.5, 0.5]))


def test_every_draw_speaks_of_looks_by_its_own_way_of_homing(monkeypatch):
    """Under the other way its backlash would lie on the wrong side: also where the draws were shuffled."""

    def off(z, fit_number):
        return np.abs(z[:, :1] - fit_number)

    spots = len(ordered_spots(small_campaign()))
    monkeypatch.setattr(predictive, "spot_constants", lambda campaign: np.zeros(spots))
    monkeypatch.setattr(predictive, "turned_by", lambda arrays, errors: errors)
    monkeypatch.setattr(
        predictive, "move_log_density", lambda z, e, space, arrays: np.repeat(off(z, arrays.number), spots, axis=1)
    )

    def looks(fit, z, *_):
        return np.repeat(off(z, fit.arrays.number)[:, :, None], spots, axis=1) * np.ones(4)

    monkeypatch.setattr(predictive, "looks", looks)
    monkeypatch.setattr(predictive, "looks_again", looks)
    both = posterior_of_two_ways()
    shuffled = both.resampled(4, 25)
    assert 0.3 < shuffled.z[0].mean() < 0.7
    for posterior in (both, shuffled):
        assert not move_log_likelihood(posterior).values.any()
        assert not predictive_pixels(posterior).values.any()
        assert not ideal_pixels(posterior, 40).any()
    alone = replace(both, way=None)
    assert move_log_likelihood(alone).values.any(), "both ways say the same of every draw"
