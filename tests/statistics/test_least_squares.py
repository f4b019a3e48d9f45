"""The least squares of `stereo` and of the fit, and their covariance: NIST's certified problems, and small ones."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import optimize
from support.certified_problems import MODELS, least_squares_covariance, score

from tvsbayes.statistics.least_squares import KINK_FALL, newton_mode

PARAMETER_DIGITS, ERROR_DIGITS = 6.0, 5.0
"""Digits required of every parameter and of every standard error."""
HIGHER = {"MGH09", "Thurber", "BoxBOD", "Rat42", "MGH10", "Eckerle4", "Rat43", "Bennett5"}
"""NIST's level of difficulty: where solvers fail. Every case takes a compilation."""
LONG = {"Bennett5", "Thurber"}
"""Of these the ones that take seconds from either start."""
CASES = [
    pytest.param(name, start, id=f"{name}-start{start + 1}", marks=mark if name in HIGHER else pytest.mark.slow)
    for name in MODELS
    for start, mark in enumerate((pytest.mark.thorough, pytest.mark.thorough if name in LONG else ()))
]


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize(("name", "start"), CASES)
def test_strd(name, start):
    result = score(name, start)
    assert result.parameters >= PARAMETER_DIGITS
    assert result.errors >= ERROR_DIGITS


def test_covariance_is_the_inverse_of_the_normal_matrix():
    """For columns of very different size; in units of the resulting standard deviations."""
    jacobian = np.random.default_rng(3).standard_normal((30, 4)) * np.array([1e-6, 1.0, 1e4, 1e9])
    covariance = least_squares_covariance(jacobian)
    scale = np.linalg.norm(jacobian, axis=0)
    exact = np.linalg.inv((jacobian / scale).T @ (jacobian / scale)) / np.outer(scale, scale)
    sd = np.sqrt(np.diag(exact))
    assert np.abs((covariance - exact) / np.outer(sd, sd)).max() < 1e-13  # a condition number of order one


def test_no_covariance_without_full_rank():
    jacobian = np.random.default_rng(4).standard_normal((30, 3))
    with pytest.raises(np.linalg.LinAlgError, match="no influence"):
        least_squares_covariance(jacobian * np.array([1.0, 0.0, 1.0]))
    jacobian[:, 2] = jacobian[:, 0] + jacobian[:, 1]
    with pytest.raises(np.linalg.LinAlgError, match="condition number"):
        least_squares_covariance(jacobian)


def test_a_mode_on_a_kink_is_reached():
    """|x| pulls to 0, the parabola to 0.15: at 0 the slope by differences is not 0, and no step leads down."""

    def objective(points):
        return 0.5 * (points[:, 0] - 0.15) ** 2 + 0.5 * points[:, 1] ** 2 + 0.3 * np.abs(points[:, 0])

    free = np.ones(2, dtype=bool)
    mode = newton_mode(objective, np.array([0.4, -0.3]), free, np.eye(2))
    assert mode.problems == ()
    # A kink is found to the step of differences.
    np.testing.assert_allclose(mode.z, 0.0, atol=0.05)


@pytest.mark.parametrize("seed", [29, 31, 32, 34])
def test_steps_to_and_fro_about_two_kinks_end(seed):
    """A density of some thousand is rounded so that steps across a kink seem to lead down for ever."""
    generator = np.random.default_rng(seed)
    along, at = 0.5 * generator.standard_normal((2, 8)), 0.05 * generator.normal(size=2)
    jump = 10 ** generator.uniform(-2, 0.3)

    def objective(points):
        return 2400 + 0.5 * np.sum(points**2, axis=1) + jump * np.abs(points @ along.T - at).sum(axis=1)

    mode = newton_mode(objective, 0.5 * generator.normal(size=8), np.ones(8, dtype=bool), np.eye(8))
    assert mode.problems == ()
    # Its dual: the pull of each kink is at most its jump.
    pull = optimize.minimize(
        lambda u: 0.5 * np.sum((u @ along) ** 2) + u @ at, np.zeros(2), bounds=[(-jump, jump)] * 2, tol=1e-12
    ).x
    # Falls below `KINK_FALL` are left.
    np.testing.assert_allclose(mode.z, -pull @ along, atol=2 * np.sqrt(2 * KINK_FALL))
    sd = np.sqrt(np.diag(mode.covariance))
    assert np.all((sd > 0.5) & (sd < 1.1)), "second differences straddle a kink"
