"""Coordinates with standard normal priors: medians and tails of the parameters."""

from __future__ import annotations

import numpy as np
import pytest

from tvsbayes.single_axis.axis_parameters import AxisCoordinates, AxisPrior, axis_priors, prior_sd


def test_coordinates_have_the_quantiles_of_their_priors():
    priors = axis_priors({"backlash": AxisPrior(0.1, 0.2)}, 40.0, 0.01)
    coordinates = AxisCoordinates.of(priors, frozenset({"home_sd"}))
    assert "home_sd" not in coordinates.names
    # Median, and the 97.7 % point of a normal number.
    values = coordinates.values(np.array([[0.0] * len(coordinates.names), [2.0] * len(coordinates.names)]))
    # A half-normal's: Phi^-1(0.75), and Phi^-1((1 + 0.97725) / 2).
    np.testing.assert_allclose(values["transmission_error"], 0.08 * np.array([0.67449, 2.27760]), rtol=1e-4)
    np.testing.assert_allclose(values["stop_sd.forward"], 0.02 * np.exp([0.0, 3.0]), rtol=1e-12)
    np.testing.assert_allclose(values["backlash"], [0.1, 0.5], rtol=1e-12)
    np.testing.assert_allclose(values["home_sd"], 0.0008, rtol=1e-12)
    assert coordinates.coordinate("stop_sd.forward", 0.02 * np.exp(3.0)) == pytest.approx(2.0)


def test_defaults_grow_with_the_travel():
    small, large = axis_priors({}, 1.0, 0.5), axis_priors({}, 10.0, 0.5)
    for name in small:
        if name not in ("per_command", "ratio_contrast", "reading_scale", "creep_minutes", "seeing_scale", "seeing_s"):
            grown = (large[name].value or large[name].u) / (small[name].value or small[name].u)
            assert grown == pytest.approx(10.0), name
    assert small["per_command"] == AxisPrior(0.5, 0.5)
    assert small["ratio_contrast"] == AxisPrior(0.0, 5e-5)


def test_sds_of_priors():
    draws = np.random.default_rng(1).standard_normal(400_000)
    # Sampling errors of 4e5 draws.
    assert prior_sd("half-normal", AxisPrior(0.0, 2.0)) == pytest.approx(np.abs(2 * draws).std(), rel=0.01)
    assert prior_sd("log-normal", AxisPrior(2.0, 0.5)) == pytest.approx((2 * np.exp(0.5 * draws)).std(), rel=0.02)


def test_an_axis_in_a_length_has_one_ratio_unless_stated():
    assert axis_priors({}, 1.0, 0.5, unit="mm")["ratio_contrast"] == AxisPrior(0.0, 0.0)
    assert axis_priors({}, 1.0, 0.5, unit="arcsec")["ratio_contrast"] == AxisPrior(0.0, 5e-5)
    stated = {"ratio_contrast": AxisPrior(0.0, 1e-3)}
    assert axis_priors(stated, 1.0, 0.5, unit="mm")["ratio_contrast"] == AxisPrior(0.0, 1e-3)
