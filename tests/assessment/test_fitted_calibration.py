"""From draws and fits to calibrations."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from support.bent_rig import calibration
from support.linear_fit import fit_of, linear_problem
from support.small_campaign import seen_steps, small_campaign

from tvsbayes.assessment.causes import causes_of
from tvsbayes.assessment.fitted_calibration import calibration_of, calibration_of_draws
from tvsbayes.calibration.pointing import INPUT_NAMES, NOISE_NAMES
from tvsbayes.calibration.states import shifts_at
from tvsbayes.estimators.joint_fit import Alternative
from tvsbayes.instrument.campaign import input_hashes
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.parameters import Prior

ROUNDING = 1e-12
"""Of a hundred operations on numbers of order 1."""


def drawn(campaign, draws=4000):
    """`calibration_of_draws` of normal draws in an order of columns of its own, with names it does not need."""
    bent = calibration(draws=draws)
    names = ("pixel_scale", *reversed((*INPUT_NAMES, *NOISE_NAMES)))
    physical = np.concatenate([bent.inputs, bent.noise], axis=1)[:, ::-1]
    physical = np.column_stack([np.full(draws, 7.0), physical])
    return bent, calibration_of_draws(names, physical, campaign, "laplace", 3, seen_steps(campaign))


def test_calibration_of_draws_takes_its_columns():
    campaign = small_campaign()
    bent, one = drawn(campaign)
    np.testing.assert_array_equal(one.inputs, bent.inputs)
    np.testing.assert_array_equal(one.noise, bent.noise)
    np.testing.assert_allclose(one.mean, bent.inputs.mean(axis=0), rtol=ROUNDING)
    np.testing.assert_allclose(one.covariance, np.cov(bent.inputs.T), atol=ROUNDING)
    # Mean of the squares, not square of the mean: a variance adds up in variances.
    assert one.noise_variance["aperture_sd_deg"] == pytest.approx((bent.noise[:, 4] ** 2).mean(), rel=ROUNDING)
    assert one.azimuth and one.estimator == "laplace" and one.causes == ()
    np.testing.assert_array_equal(one.range_steps, seen_steps(campaign))
    assert one.inputs_sha256 == input_hashes(campaign)
    play_steps = bent.inputs[:, 2] / bent.inputs[:, 0]
    least = one.overshoot_steps["pan"]
    assert (play_steps <= least).mean() >= 0.99 > (play_steps <= least - 1).mean()


def test_a_look_of_a_robot_has_the_errors_of_a_stop_and_of_a_look():
    """Hypotenuse of both, draw by draw, each direction with the scatter of its axis; nothing else changes."""
    campaign, bent = small_campaign(), calibration(draws=50)
    physical = np.concatenate([bent.inputs, bent.noise, np.full((50, 2), (0.03, 0.04))], axis=1)
    names = (*INPUT_NAMES, *NOISE_NAMES, "look_scatter_deg.pan", "look_scatter_deg.tilt")
    one = calibration_of_draws(names, physical, campaign, "laplace", 3, seen_steps(campaign))
    expected = np.hypot(bent.noise, [0.03, 0.03, 0.04, 0.04, 0.0])
    np.testing.assert_allclose(one.noise, expected, rtol=ROUNDING)


def test_the_apertures_noise_takes_its_prior_without_readings():
    """A sampler holds it still; its log-normal prior has E s^2 = m^2 exp(2 u^2)."""
    campaign = small_campaign()
    priors = campaign.rig.priors | {"aperture_sd_deg": Prior(0.02, 0.8, "log-normal")}
    unread = tuple(replace(spot, aperture_deg=None) for spot in campaign.spots)
    one = drawn(replace(campaign, spots=unread, rig=replace(campaign.rig, priors=priors)))[1]
    # 4000 draws of exp(1.6 w): sd of the mean is sqrt(exp(2.56) - 1) / sqrt(4000) = 5.5 % of it.
    assert one.noise_variance["aperture_sd_deg"] == pytest.approx(0.02**2 * np.exp(2 * 0.8**2), rel=4 * 0.055)


def test_what_only_readings_tell_takes_its_prior_without_them():
    campaign = small_campaign()
    silent = replace(campaign, spots=tuple(replace(s, aperture_deg=None) for s in campaign.spots))
    _, one = drawn(silent)
    for name in ("baseline_mm", "pan_zero_emission_deg", "aperture_zero_deg"):
        prior, column = silent.rig.priors[name], one.inputs[:, INPUT_NAMES.index(name)]
        assert prior.u > 0
        assert column.mean() == pytest.approx(prior.value, abs=1e-9)
        assert column.std() == pytest.approx(prior.u, rel=1e-9)
    _, again = drawn(silent)
    np.testing.assert_array_equal(one.inputs, again.inputs)


def test_calibration_of_a_fit_brings_its_causes(mounted_rig):
    fit = fit_of(*linear_problem(), mounted_rig)
    one = calibration_of(fit)
    causes = causes_of(fit, states=one.states)
    assert (one.estimator, one.causes) == ("laplace", tuple(causes))
    np.testing.assert_array_equal(one.cause_covariance, np.stack(list(causes.values())))
    at_homing = fit.draws.physical[:, [TWO_MIRROR.index[name] for name in INPUT_NAMES]]
    shifts = shifts_at(one.zeros, one.states)
    for axis, zero in enumerate(("pan_zero_emission_deg", "tilt_zero_deg")):
        at_homing[:, INPUT_NAMES.index(zero)] += shifts[:, axis]
    np.testing.assert_array_equal(one.inputs, at_homing)


class Drawn(NamedTuple):
    """What a calibration takes of a fit's draws."""

    physical: np.ndarray
    place_errors_rad: np.ndarray


def test_a_calibration_holds_every_way_of_homing_that_counts(mounted_rig):
    """Two ways whose pan ratios differ by far more than either leaves open: mean and variance are of both."""
    first = fit_of(*linear_problem(), mounted_rig)
    physical = first.draws.physical.copy()
    object.__setattr__(first, "draws", Drawn(physical.copy(), first.draws.place_errors_rad))
    physical[:, TWO_MIRROR.index["degrees_per_step.pan"]] += 0.1
    other = copy(first)
    object.__setattr__(other, "draws", Drawn(physical, first.draws.place_errors_rad))
    ways = Alternative({"pan": "left"}, 0.6, first), Alternative({"pan": "right"}, 0.4, other)
    both = copy(first)
    object.__setattr__(both, "alternatives", ways)
    one = calibration_of(both)
    column = one.inputs[:, INPUT_NAMES.index("degrees_per_step.pan")]
    assert len(column) == len(physical)
    # 50 draws of sd 0.001 about either: 30 of the one way, 20 of the other.
    assert column.mean() == pytest.approx(0.5 + 0.4 * 0.1, abs=4 * 0.001 / 50**0.5)
    assert np.sum(column > 0.55) == 20
    np.testing.assert_array_equal(column, calibration_of(both).inputs[:, INPUT_NAMES.index("degrees_per_step.pan")])
    assert np.ptp(np.flatnonzero(column > 0.55)) > 20, "the first draws alone stand for the whole"
