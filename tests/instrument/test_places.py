"""Places of repeating errors: their number, the shares of looks, and the line through them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.varying_gears import perfect_gears, varying_gears
from support.written_rows import move_row

from tvsbayes.instrument.campaign import Move
from tvsbayes.instrument.parameters import Prior
from tvsbayes.instrument.places import (
    OWN_PLACES_MAX,
    PLACES_MAX,
    SPACING_DEG,
    SeenPlaces,
    gears_vary,
    interpolation,
    line_share,
    places_of,
    seen_places,
)
from tvsbayes.instrument.rig import RigTable
from tvsbayes.statistics.gaussian_process import matern52


@pytest.mark.parametrize(
    ("degrees", "count"), [(5.0, OWN_PLACES_MAX), (16 * SPACING_DEG - 0.01, 17), (400.0, PLACES_MAX)]
)
def test_many_counters_have_regular_places(degrees, count):
    deg_per_step = 0.05
    counters = np.linspace(-100, -100 + degrees / deg_per_step, 5 * OWN_PLACES_MAX)
    places = places_of(counters, deg_per_step)
    assert len(places) == count and places[0] == counters.min() and places[-1] == counters.max()
    np.testing.assert_allclose(np.diff(places), np.ptp(counters) / (count - 1), rtol=1e-12)


def test_regular_places_resolve_an_error_of_length_eight_degrees():
    """Within 4 % of its sd, by the process' own covariance: interpolation from the four nearest against the error."""
    nodes = np.arange(0.0, 40.0, SPACING_DEG)
    inside = np.linspace(nodes[3], nodes[-4], 200)
    share = interpolation(inside, nodes)

    def covariance(one, other):
        return matern52(one[:, None] - other, 8.0)

    cross = np.sum(share * covariance(inside, nodes), axis=1)
    missed = 1 - 2 * cross + np.einsum("ij,jk,ik->i", share, covariance(nodes, nodes), share)
    assert 0.02 < np.sqrt(missed.max()) < 0.04 and missed.mean() < 1e-3


def moves() -> list[Move]:
    """Moves of both axes; the first side of pan is known, that of tilt is not."""
    counters = [(0, 0), (60, 0), (60, 40), (20, 40), (20, -40), (60, -40)]
    first, *others = [move_row(k, 0, 10.0 * k, *steps) for k, steps in enumerate(counters)]
    return [replace(first, pan_approach="right", tilt_approach="unknown"), *others]


def test_looks_have_the_error_of_their_counter_and_half_the_play_of_their_side():
    looks = [0, 1, 2, 3, 4, 4, 5]
    places = seen_places(moves(), looks, RigTable())
    np.testing.assert_array_equal(places.steps, [0, 20, 60, -40, 0, 40])
    np.testing.assert_array_equal(places.on_tilt, [False] * 3 + [True] * 3)
    where = np.array([(0, 4), (2, 4), (2, 5), (1, 5), (1, 3), (1, 3), (2, 3)])
    # Pan: homed from the right, left, held, right, held, left; tilt: unknown, held, up, held, down, held.
    side = np.array([(-1, 0), (1, 0), (1, 1), (-1, 1), (-1, -1), (-1, -1), (1, -1)])
    error, play = np.zeros((7, 6)), np.zeros((7, 6))
    for row in range(7):
        error[row, where[row]] = 1.0
        play[row, where[row]] = -side[row] / 2
    np.testing.assert_array_equal(places.error_share, error)
    np.testing.assert_array_equal(places.play_share, play)


def test_the_line_is_the_least_squares_line_of_the_looks_used():
    rng = np.random.default_rng(2)
    counters = [rng.integers(-300, 300, 30), rng.permutation([-20, 0, 0, 50, 50, 50, 80] * 5)[:30]]
    grids = [places_of(each, 0.07) for each in counters]
    shares = [interpolation(each.astype(float), nodes) for each, nodes in zip(counters, grids, strict=True)]
    assert len(grids[0]) < 30 and len(grids[1]) == 4, "one axis is interpolated, the other is not"
    on_tilt = np.repeat([False, True], [len(nodes) for nodes in grids])
    places = SeenPlaces(np.concatenate(grids), on_tilt, np.concatenate(shares, axis=1), np.zeros((30, len(on_tilt))))
    used = rng.uniform(size=30) < 0.7
    values = rng.standard_normal(len(on_tilt))
    share = line_share(places, used)
    for axis in (0, 1):
        columns = on_tilt == bool(axis)
        expected = np.polyfit(counters[axis][used], (shares[axis] @ values[columns])[used], 1)[0]
        assert share[columns] @ values[columns] == pytest.approx(expected, rel=1e-9)
        assert share[columns] @ places.steps[columns] == pytest.approx(1.0, rel=1e-12)


def test_through_one_counter_there_is_no_line():
    places = seen_places(moves()[:2], [0, 1], RigTable())
    np.testing.assert_allclose(line_share(places, np.array([True, True])), [-1 / 60, 1 / 60, 0.0], rtol=1e-12)
    assert not line_share(places, np.array([True, False])).any()


def test_gears_vary_where_a_scale_may_be_above_zero():
    still = perfect_gears(RigTable())
    assert not gears_vary(still) and gears_vary(varying_gears(RigTable(), periods=False))
    for name in ("transmission_error_deg.tilt", "play_variation_deg.pan", "harmonic_amplitude_deg.tilt.1"):
        for prior in (Prior(0.0, 0.01, "half-normal"), Prior(0.02, 0.0, "half-normal")):
            priors = {**still.priors, name: prior}
            assert gears_vary(replace(still, priors=priors, harmonic_period_deg={"tilt": (30.0,)}))
    drifting = {**still.priors, "drift_deg_per_root_hour.pan": Prior(0.0, 0.05, "half-normal")}
    assert not gears_vary(replace(still, priors=drifting)), "drift repeats nothing"
