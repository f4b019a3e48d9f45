"""Coordinates with standard normal priors: medians and tails of the parameters."""

from __future__ import annotations

import numpy as np
import pytest

from tvsbayes.single_axis.axis_parameters import AxisCoordinates, AxisPrior, axis_priors


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
