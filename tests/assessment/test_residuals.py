"""Stops as readings of an axis, deviations of a real fit, and the causes that are blamed for them."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import numpy as np
import pytest
from msgspec.structs import replace as renewed
from scipy import stats
from support.drawn_residuals import drawn_residual
from support.imagined_stops import STOPS, linearised, stops_of

from tvsbayes.assessment.residuals import CAUSE_LIMIT, residual_causes, stop_readings, stop_residuals
from tvsbayes.estimators.linear_spots import linear_spots, stop_information
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.campaign import ordered_spots
from tvsbayes.results.estimates import StopResidual
from tvsbayes.statistics.chances import recursive_residuals


def test_stops_are_read_as_they_were():
    offsets = np.random.default_rng(4).normal(0.0, 0.1, STOPS)
    fit = stops_of(offsets)
    readings = stop_readings(fit, "pan")
    # All but 102 and 104, where the play may not be taken up; the other axis' errors leave no trace.
    assert readings.play_left_out == 2
    assert readings.steps.tolist() == [*(4 * [0, 100, 200, 300, 200, 100]), 106]
    expected = readings.steps * 0.06 - 0.15 * readings.side + offsets[[*range(24), 26]]
    np.testing.assert_allclose(readings.mirror_deg, expected, atol=1e-9)
    np.testing.assert_array_equal(readings.side, np.sign(np.diff([-100, *readings.steps])))


def test_reading_uncertainty_is_what_noise_does():
    errors = []
    for seed in range(40):
        fit = stops_of(np.zeros(STOPS), noise=1.0)
        rng = np.random.default_rng(seed)
        residual = rng.normal(size=fit.linearised.residual.shape)
        fit.linearised = linearised(residual, fit.linearised.slope, fit.linearised.mirror_angles_rad)
        readings = stop_readings(fit, "pan")
        errors.append((readings.mirror_deg - readings.steps * 0.06 + 0.15 * readings.side) / readings.u_deg)
    z = np.concatenate(errors)
    # 1000 standard normal numbers: 1e-4 bounds of their rms.
    assert np.sqrt(np.mean(z**2)) == pytest.approx(1.0, abs=4 / np.sqrt(2 * z.size))


def test_a_rest_whose_first_spot_is_left_out_keeps_its_stop_error(paper_fit):
    """The stop's variance belongs to the rest, not to whichever spot of it is used first."""
    whole = {stop.spots: stop for stop in stop_residuals(paper_fit)}
    spots = max(whole, key=len)
    row = [spot.spot for spot in ordered_spots(paper_fit.campaign)].index(spots[0])
    valid = np.array(paper_fit.arrays.spots.valid)
    valid[row] = 0.0
    without = replace(paper_fit, arrays=eqx.tree_at(lambda a: a.spots.valid, paper_fit.arrays, valid))
    left = {stop.spots: stop for stop in stop_residuals(without)}
    # A spot less adds pixel noise only.
    assert whole[spots].u_deg <= left[spots[1:]].u_deg < 1.1 * whole[spots].u_deg


def test_residuals_of_a_clean_campaign_scatter_as_stated(paper_fit):
    residuals = stop_residuals(paper_fit)
    spots = [spot for r in residuals if r.axis == "pan" for spot in r.spots]
    assert sorted(spots) == sorted(s.spot for s in paper_fit.campaign.spots if s.status == "ok")
    scaled = np.array([r.deviation_deg / r.u_deg for r in residuals])
    n, determined = len(scaled), len(scaled) // 8
    # A little is lost to the fit: fewer degrees of freedom below, none above; 1e-4 on either side.
    low, high = stats.chi2.ppf([1e-4, 1 - 1e-4], [n - determined, n])
    assert low <= np.sum(scaled**2) <= high
    assert not any(cause.suspicious for cause in residual_causes(residuals))
    assert {r.direction for r in residuals} == set(DIRECTIONS)


def test_a_zero_that_creeps_is_no_deviation_of_the_stops(mixed_fit):
    """Of 100 campaigns whose zeros walk farther than stops scatter at most 1 % raise an alarm, at 1e-4."""
    plain = mixed_fit.linearised
    creeping = eqx.tree_at(
        lambda lin: (lin.stop_variance, lin.zero_variance),
        plain,
        (0.25 * plain.stop_variance, 100.0 * plain.zero_variance),
    )
    walked, stopped = (np.sqrt(v.sum(axis=0)) for v in (creeping.zero_variance, creeping.stop_variance[:1]))
    assert np.all(walked > stopped)
    columns = np.zeros((len(plain.residual), 4, 0))
    alarms, squares = 0, []
    for seed in range(100):
        residual = drawn_residual(linear_spots(creeping, mixed_fit.arrays, columns), seed)
        lin = replace(creeping, residual=residual)
        information = stop_information(linear_spots(lin, mixed_fit.arrays, columns))
        residuals = stop_residuals(replace(mixed_fit, linearised=lin, information=information))
        alarms += any(cause.suspicious for cause in residual_causes(residuals))
        squares.append(np.mean([(stop.deviation_deg / stop.u_deg) ** 2 for stop in residuals]))
    assert alarms <= stats.binom.ppf(1 - 1e-4, 100, CAUSE_LIMIT)
    # What follows zeros and gears follows the stops' own errors a little: some is taken, never more left than stated.
    assert 0.25 < np.mean(squares) < 1.0


def stops(generator: np.random.Generator, count: int = 60) -> list[StopResidual]:
    """Stops of one axis whose deviations depend on nothing."""
    rows = []
    for k in range(count):
        noise, looks = generator.standard_normal(), generator.standard_normal(2)
        within = recursive_residuals(looks, np.ones(2), backwards=k % 2 == 1)
        direction = ("left", "right")[k % 2]
        places = (175.0 + 0.1 * generator.random(), 275.0 + 0.1 * generator.random())
        leg = int(generator.choice([50, 100, 200]))
        rows.append(
            StopResidual("pan", (2 * k, 2 * k + 1), k, direction, leg, places, within, 10.0 * k, 0.03 * noise, 0.03)
        )
    return rows


PLANTED = {
    "depth": lambda r: renewed(r, within=tuple(w and w + s for w, s in zip(r.within, (-1.0, 1.0), strict=True))),
    "direction": lambda r: renewed(r, deviation_deg=r.deviation_deg + (0.03 if r.direction == "left" else -0.03)),
    "N": lambda r: renewed(r, deviation_deg=r.deviation_deg + (0.06 if r.leg_steps == 200 else 0.0)),
    "step phase": lambda r: renewed(r, deviation_deg=r.deviation_deg + 0.045 * np.cos(np.pi * r.steps / 2)),
    "time": lambda r: renewed(r, deviation_deg=r.deviation_deg + 2e-4 * (r.time_s - 300)),
}


@pytest.mark.parametrize("name", PLANTED)
def test_a_planted_cause_is_found_and_no_other_named_alone(name):
    causes = residual_causes([PLANTED[name](r) for r in stops(np.random.default_rng(6), 120)])
    assert {c.name for c in causes if c.suspicious} >= {name}
    # Counters alternate with directions here: a phase of two steps is a direction as well.
    related = {"step phase": {"direction"}, "direction": {"step phase"}}.get(name, set())
    assert {c.name for c in causes if c.suspicious} <= {name} | related


def test_false_alarms_of_causes_stay_rare():
    """500 clean campaigns; at most as many alarms as 1 % allows at 1e-4, and every p as common as any other."""
    chances, alarms = {}, 0
    for seed in range(500):
        causes = residual_causes(stops(np.random.default_rng([1, seed])))
        alarms += any(c.suspicious for c in causes)
        for cause in causes:
            chances.setdefault(cause.name, []).append(cause.p)
    assert alarms <= stats.binom.ppf(1 - 1e-4, 500, CAUSE_LIMIT)
    for name, p in chances.items():
        if None not in p:
            assert stats.kstest(p, "uniform").pvalue > 1e-4, name


def test_depths_are_not_sorted_by_the_noise_that_they_share():
    """Triangulated depth and deviation come from the same pixels: inside a placement they are correlated."""
    generator = np.random.default_rng(12)
    noise = generator.standard_normal(120)
    sheets_mm = np.repeat([175.0, 275.0, 375.0], 40)
    rows = [
        StopResidual("pan", (k,), k, "left", 100, (depth + 0.5 * e,), (), 10.0 * k, 0.03 * e, 0.03)
        for k, (depth, e) in enumerate(zip(sheets_mm, noise, strict=True))
    ]
    (depth,) = (c for c in residual_causes(rows) if (c.name, c.axis) == ("depth", "pan"))
    assert [g.count for g in depth.groups] == [40, 40, 40] and not depth.suspicious
    # One placement is not tested; an oblique sheet that reaches far is, in bins far wider than the noise.
    (near,) = (c for c in residual_causes(rows[:40]) if (c.name, c.axis) == ("depth", "pan"))
    assert len(near.groups) == 1 and near.p is None
    oblique = [renewed(r, depth_mm=(200.0 + r.steps,)) for r in rows]
    (far,) = (c for c in residual_causes(oblique) if (c.name, c.axis) == ("depth", "pan"))
    assert len(far.groups) == 6 and far.p is not None
