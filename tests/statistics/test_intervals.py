"""Intervals, coverage factors and the validation of the law of propagation.

Against the worked examples of the GUM, JCGM 101 and JCGM 102, and by their own laws.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from scipy import optimize, stats

from tvsbayes.statistics.intervals import (
    NORMAL_95,
    Validation,
    coverage_factor,
    effective_dof,
    grubbs_p,
    numerical_tolerance,
    symmetric_interval,
    validate,
)

DRAWS = 1_000_000
PARTS = 10
HALF_WIDTH = math.sqrt(3.0)
"""Of a rectangular distribution with standard deviation 1."""

# Published values. That of 9.2.4 is from memory; a closed form stands beside it below.
SUMS = {"9.2.2": (2.0, 3.92, 0.1, 0.01), "9.2.3": (2.0, 3.88, 0.1, 0.01), "9.2.4": (10.1, 17.0, 0.1, 0.1)}
"""u, half width of the 95 % interval, units of their last digits."""
MASS_HALF = (1.3395 - 1.1285) / 2, (1.3825 - 1.0834) / 2
"""JCGM 101 9.3: half width of the 95 % interval by the law and by Monte Carlo, mg."""
GAUGE_99 = (745, 932)
"""JCGM 101 9.5: by Monte Carlo, nm."""
READINGS = np.array(
    [
        [5.007, 19.663, 1.0456],
        [4.994, 19.639, 1.0438],
        [5.005, 19.640, 1.0468],
        [4.990, 19.685, 1.0428],
        [4.999, 19.678, 1.0433],
    ]
)
"""GUM table H.2: V, mA, rad. The printed u and r of these are too coarse: from them r(R, X) is -.591."""
IMPEDANCE = {"value": (127.732, 219.847, 254.260), "u": (0.071, 0.295, 0.236), "r": (-0.588, -0.485, 0.993)}


@dataclass(frozen=True)
class Propagated:
    """The law's answer, the Monte Carlo draws, and the same inputs through the linearised model."""

    value: np.ndarray
    covariance: np.ndarray
    draws: np.ndarray
    linearised: np.ndarray

    @property
    def u(self) -> np.ndarray:
        return np.sqrt(np.diag(self.covariance))

    def validate(self, **options) -> Validation:
        return validate(self.draws, self.linearised, self.value, self.u, **options)


def propagate(model: Callable, sensitivities, estimates, covariance, inputs: np.ndarray) -> Propagated:
    """Sensitivities (outputs, inputs) are those of the model at the estimates, worked out by hand."""
    value, slopes = np.array(model(*estimates)), np.atleast_2d(sensitivities)
    linearised = value + (inputs - np.asarray(estimates)) @ slopes.T
    return Propagated(value, slopes @ covariance @ slopes.T, np.stack(model(*inputs.T), axis=-1), linearised)


# Published values are rounded, hence the unit; four standard errors because ten blocks determine one to a quarter only.
def agrees(statistic: Callable, draws: np.ndarray, published, unit: float) -> None:
    error = np.std([statistic(block) for block in np.split(draws, PARTS)], axis=0, ddof=1) / math.sqrt(PARTS)
    allowed = unit + 4 * error
    assert np.all(np.abs(statistic(draws) - np.asarray(published)) <= allowed), (statistic(draws), published, allowed)


def correlated_normal(seed: int, estimates, covariance, n: int = DRAWS) -> np.ndarray:
    normal = np.random.default_rng(seed).standard_normal((n, len(estimates)))
    return np.asarray(estimates) + normal @ np.linalg.cholesky(covariance).T


def stratified_normal(seed: int, n: int = 1000) -> np.ndarray:
    """Normal draws without luck: one in every n-th of the distribution, in random order."""
    return np.random.default_rng(seed).permutation(stats.norm.ppf((np.arange(n) + 0.5) / n))


def judge(draws: np.ndarray, linearised: np.ndarray, value: float, u: float):
    return validate(draws[:, None], linearised[:, None], np.array([value]), np.array([u]))


@functools.cache
def summed(clause: str) -> Propagated:
    """JCGM 101 9.2: four normal numbers, four rectangles, four of which one is ten times as wide."""
    rng = np.random.default_rng(92)
    scale = np.array([1.0, 1.0, 1.0, 10.0 if clause == "9.2.4" else 1.0])
    if clause == "9.2.2":
        inputs = rng.standard_normal((DRAWS, 4))
    else:
        inputs = rng.uniform(-HALF_WIDTH, HALF_WIDTH, (DRAWS, 4)) * scale
    return propagate(lambda *x: [sum(x)], np.ones(4), np.zeros(4), np.diag(scale**2), inputs)


@functools.cache
def weighed() -> Propagated:
    """JCGM 101 9.3: buoyancy has no first-order effect at all; masses in mg, densities in kg/m^3."""

    def model(reference, difference, air, weight, standard):
        return [(reference + difference) * (1 + (air - 1.2) * (1 / weight - 1 / standard)) - 1e5]

    rng = np.random.default_rng(93)
    low, high = np.array([1.1, 7000.0, 7950.0]), np.array([1.3, 9000.0, 8050.0])
    normal = np.array([1e5, 1.234]) + rng.standard_normal((DRAWS, 2)) * np.array([0.05, 0.02])
    inputs = np.hstack([normal, rng.uniform(low, high, (DRAWS, 3))])
    variances = np.concatenate([[0.05**2, 0.02**2], (high - low) ** 2 / 12])
    return propagate(model, [1.0, 1.0, 0.0, 0.0, 0.0], [1e5, 1.234, *(low + high) / 2], np.diag(variances), inputs)


def lost(r: float, x1: float) -> Propagated:
    """JCGM 101 9.4, comparison loss: squares of two correlated numbers, the second of which is about 0."""
    covariance = 0.005**2 * np.array([[1.0, r], [r, 1.0]])
    inputs = correlated_normal(94, [x1, 0.0], covariance)
    return propagate(lambda x, y: [x**2 + y**2], [2 * x1, 0.0], [x1, 0.0], covariance, inputs)


def curved_trapezoid(rng, low: float, high: float, doubt: float) -> np.ndarray:
    """JCGM 101 6.4.3: a rectangle whose ends are known to +-doubt, with a common centre."""
    start = low - doubt + 2 * doubt * rng.random(DRAWS)
    return start + (low + high - 2 * start) * rng.random(DRAWS)


@functools.cache
def gauged() -> Propagated:
    """GUM H.1 and JCGM 101 9.5: ls, D, d1, d2 (nm); alpha_s (1/K); theta0, Delta (K); d_alpha (1/K); d_theta (K)."""
    estimates = np.array([50_000_623.0, 215.0, 0.0, 0.0, 11.5e-6, -0.1, 0.0, 0.0, 0.0])
    u = np.array([25.0, 5.8, 3.9, 6.7, 1.2e-6, 0.2, 0.35, 0.58e-6, 0.029])
    slopes = [1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.1 * estimates[0], -estimates[0] * estimates[4]]

    def model(length, comparator, random, systematic, expansion, mean_t, cyclic_t, d_expansion, d_t):
        correction = d_expansion * (mean_t + cyclic_t) + expansion * d_t
        return [length + comparator + random + systematic - length * correction - 50e6]

    rng = np.random.default_rng(95)
    inputs = np.stack(
        [
            50_000_623 + 25 * rng.standard_t(18, DRAWS),
            215 + 6 * rng.standard_t(24, DRAWS),
            4 * rng.standard_t(5, DRAWS),
            7 * rng.standard_t(8, DRAWS),
            rng.uniform(9.5e-6, 13.5e-6, DRAWS),
            -0.1 + 0.2 * rng.standard_normal(DRAWS),
            0.5 * np.cos(np.pi * rng.random(DRAWS)),
            curved_trapezoid(rng, -1e-6, 1e-6, 1e-7),
            curved_trapezoid(rng, -0.05, 0.05, 0.025),
        ],
        axis=-1,
    )
    return propagate(model, slopes, estimates, np.diag(u**2), inputs)


@functools.cache
def impedance() -> Propagated:
    """GUM H.2: three correlated inputs, three correlated outputs."""

    def model(voltage, current, phase):
        z = 1000 * voltage / current
        return [z * np.cos(phase), z * np.sin(phase), z]

    estimates, covariance = READINGS.mean(axis=0), np.cov(READINGS.T) / len(READINGS)
    (voltage, current, _), (real, imaginary, z) = estimates, model(*estimates)
    slopes = [[x / voltage, -x / current, by] for x, by in ((real, -imaginary), (imaginary, real), (z, 0.0))]
    return propagate(model, slopes, estimates, covariance, correlated_normal(2, estimates, covariance, DRAWS // 4))


def polar(r: float, x1: float) -> Propagated:
    """JCGM 102 9.3, near the origin: by the law a phase of 10 rad, which cannot have more than pi / sqrt 3."""
    covariance = 0.01**2 * np.array([[1.0, r], [r, 1.0]])
    inputs = correlated_normal(102, [x1, 0.0], covariance)
    slopes = [[1.0, 0.0], [0.0, 1 / x1]]
    return propagate(lambda x, y: [np.hypot(x, y), np.arctan2(y, x)], slopes, [x1, 0.0], covariance, inputs)


def logarithm() -> Propagated:
    """NPL DEM-ES-011, 9.2: ln X, X rectangular from 0.1 to 1.1."""
    inputs = np.random.default_rng(11).uniform(0.1, 1.1, (DRAWS, 1))
    return propagate(lambda x: [np.log(x)], [1 / 0.6], [0.6], np.array([[1 / 12]]), inputs)


@pytest.mark.parametrize(
    ("example", "validated"),
    [
        (functools.partial(summed, "9.2.2"), True),
        (functools.partial(summed, "9.2.4"), False),
        *((functools.partial(lost, r, x1), False) for r in (0.0, 0.9) for x1 in (0.0, 0.01, 0.05)),
        (impedance, True),
        *((functools.partial(polar, r, x1), False) for r, x1 in ((0.0, 0.001), (0.9, 0.001), (0.9, 0.01))),
        (logarithm, False),
    ],
)
def test_the_law_is_validated_where_the_guides_find_it_so(example, validated):
    """Every output by itself, to two digits of u."""
    verdict = example().validate()
    assert np.all(verdict.validated == validated) and np.all(verdict.decided)


@pytest.mark.parametrize("clause", SUMS)
def test_sum_of_four_quantities(clause):
    u, half, unit_u, unit_half = SUMS[clause]
    result = summed(clause)
    assert abs(result.u[0] - u) <= unit_u
    agrees(symmetric_interval, result.draws[:, 0], (-half, half), unit_half)


def test_law_is_validated_for_a_sum_of_rectangles_but_narrowly():
    """JCGM 101 9.2.3: 3.92 - 3.88 against 0.05; a million draws determine an end to 0.005, so this stays undecided."""
    result = summed("9.2.3")
    verdict = result.validate()
    exact = 2 * HALF_WIDTH * (stats.irwinhall.ppf(0.975, 4) - 2)
    agrees(symmetric_interval, result.draws[:, 0], (-exact, exact), 0.0)
    assert verdict.tolerance[0] == pytest.approx(0.05)
    assert verdict.deviation[0] == pytest.approx(2 * NORMAL_95 - exact, abs=4 * verdict.error[0])
    assert 0.003 < verdict.error[0] < 0.01
    assert verdict.validated[0]
    assert bool(verdict.decided[0]) is bool(0.05 - verdict.deviation[0] > 2 * verdict.error[0])


def test_the_deviation_is_that_of_the_published_intervals():
    """JCGM 101 9.2.4: +-19.9 by the law, +-17.0 by Monte Carlo; 9.3, of which one digit is compared."""
    dominated, mass = summed("9.2.4").validate(), weighed().validate(digits=1)
    assert NORMAL_95 * summed("9.2.4").u[0] == pytest.approx(19.9, abs=0.1)
    assert dominated.deviation[0] == pytest.approx(19.9 - 17.0, abs=0.1 + 4 * dominated.error[0])
    assert dominated.tolerance[0] == pytest.approx(0.5)
    assert weighed().u[0] == pytest.approx(math.hypot(0.05, 0.02), rel=1e-9)
    assert NORMAL_95 * weighed().u[0] == pytest.approx(MASS_HALF[0], abs=1e-4)
    # The published interval is the shortest: of 1e6 draws its ends are known to 1e-3.
    assert mass.deviation[0] == pytest.approx(MASS_HALF[1] - MASS_HALF[0], abs=1e-3 + 4 * mass.error[0])
    assert mass.tolerance[0] == pytest.approx(0.005)
    assert not mass.validated[0] and mass.decided[0]


def test_gauge_block_by_monte_carlo():
    """JCGM 101 9.5: u grows by the interactions and the t distributions, the 99 % interval hardly."""
    result = gauged()
    assert result.u[0] == pytest.approx(32, abs=1) and result.value[0] == pytest.approx(838, abs=1e-6)
    agrees(lambda d: symmetric_interval(d, 0.99), result.draws[:, 0], GAUGE_99, 1.0)
    # GUM H.1: 16 effective degrees of freedom.
    verdict = result.validate(digits=1, probability=0.99, factor=coverage_factor(16.0, 0.99))
    assert verdict.tolerance[0] == pytest.approx(5.0)
    assert verdict.deviation[0] <= 2 + 4 * verdict.error[0]
    assert verdict.validated[0]
    assert not result.validate(digits=1, probability=0.99, factor=coverage_factor(math.inf, 0.99)).validated[0]


def test_simultaneous_resistance_and_reactance():
    """GUM H.2, to the last printed digit."""
    result = impedance()
    np.testing.assert_allclose(result.value, IMPEDANCE["value"], atol=1e-3)
    np.testing.assert_allclose(result.u, IMPEDANCE["u"], atol=1e-3)
    correlation = result.covariance / np.outer(result.u, result.u)
    np.testing.assert_allclose(correlation[[0, 0, 1], [1, 2, 2]], IMPEDANCE["r"], atol=1e-3)


@pytest.mark.parametrize(
    ("u", "digits", "expected"),
    [
        (0.00035, 2, 0.5e-5),
        (2.0, 1, 0.5),
        (0.0994, 2, 0.0005),
        (0.0995001, 2, 0.005),
        (0.0996, 2, 0.005),
        (9.94, 2, 0.05),
        (9.96, 2, 0.5),
        (9.96, 3, 0.005),
        (0.96, 1, 0.5),
        (0.94, 1, 0.05),
        (0.0, 2, 0.0),
    ],
)
def test_numerical_tolerance_is_half_a_unit_of_the_last_digit_of_the_rounded_u(u, digits, expected):
    assert float(numerical_tolerance(np.array(u), digits)) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(
    ("contributions", "dof", "expected"),
    [
        ((0.57, 0.25), (9.0, math.inf), pytest.approx(12.8, abs=0.1)),
        ((3.0,), (7.0,), pytest.approx(7.0)),
        ((0.2,) * 4, (5.0,) * 4, pytest.approx(20.0)),
        ((1.0, 2.0), (math.inf, math.inf), math.inf),
        ((0.0, 2.0), (3.0, math.inf), math.inf),
    ],
)
def test_effective_dof_of_independent_contributions(contributions, dof, expected):
    assert effective_dof(math.hypot(*contributions), contributions, dof) == expected


def test_coverage_factor_of_infinitely_many_dof_is_normal():
    assert coverage_factor(math.inf) == pytest.approx(NORMAL_95, rel=1e-12)
    assert coverage_factor(math.inf) == pytest.approx(coverage_factor(1e8), rel=1e-6)
    # GUM table G.2.
    assert [round(coverage_factor(n), 2) for n in (1.0, 5.0, 10.0, 50.0)] == [12.71, 2.57, 2.23, 2.01]
    assert [round(coverage_factor(n, 0.99), 2) for n in (1.0, 5.0, 10.0, 50.0)] == [63.66, 4.03, 3.17, 2.68]


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("share", [0.3, 1.0, 3.0])
def test_verdict_and_decision_about_a_curvature_at_a_share_of_the_tolerance(share, sign):
    """The curvature whose deviation equals the tolerance cannot be decided; a third and the threefold can."""
    x = stratified_normal(4)

    def verdict(curvature):
        return judge(x + sign * curvature * (x**2 - 1), x, 0.0, 1.0)

    critical = optimize.brentq(lambda c: (verdict(c).deviation - verdict(c).tolerance).item(), 1e-4, 0.1)
    result = verdict(share * critical)
    assert result.error > 0
    assert result.deviation == pytest.approx(0.05 * share, rel=0.2)
    assert bool(result.decided) is (share != 1)
    if share != 1:
        assert bool(result.validated) is (share < 1)


def test_verdicts_are_per_element():
    x = stratified_normal(10)
    linearised = np.stack([x, 10 * x], axis=-1)[:, None, :]
    draws = linearised + np.stack([np.zeros_like(x), 5 * x**2], axis=-1)[:, None, :]
    verdict = validate(draws, linearised, np.zeros((1, 2)), np.array([[1.0, 10.0]]), digits=2)
    np.testing.assert_array_equal(verdict.validated, [[True, False]])
    np.testing.assert_allclose(verdict.tolerance, [[0.05, 0.5]])
    assert verdict.deviation.shape == verdict.error.shape == verdict.decided.shape == (1, 2)
    assert verdict.digits == 2


@pytest.mark.parametrize("sign", [1, -1])
def test_one_wrong_end_is_enough(sign):
    x = stratified_normal(12)
    verdict = judge(x + sign * 0.3 * (sign * x > 1.0), x, 0.0, 1.0)
    assert verdict.deviation == pytest.approx(0.3)
    assert not verdict.validated


def test_digits_held_are_the_most_whose_tolerance_holds_the_deviation():
    """Half a unit of the second digit of u = 0.5 is 0.005, of the first 0.05."""
    x = stratified_normal(4)
    ends = {}
    for shift in (0.0, 0.0049, 0.0051, 0.049, 0.051):
        verdict = judge(0.5 * x + shift, 0.5 * x, 0.0, 0.5)
        ends[shift] = int(verdict.digits_held(np.array([0.5]))[0])
    assert ends == {0.0: 2, 0.0049: 2, 0.0051: 1, 0.049: 1, 0.051: 0}


@pytest.mark.parametrize(("n", "critical"), [(5, 1.764), (10, 2.482), (24, 3.112)])
def test_grubbs_p_at_the_published_critical_values(n, critical):
    """ISO 5725-2, table 5, one outlying value at 1 %: digits of the table are 2e-4 of p."""
    rest = np.linspace(-1.0, 1.0, n - 1)

    def values(far):
        return np.append(rest, far)

    def excess(far):
        all_values = values(far)
        return np.max(np.abs(all_values - all_values.mean())) / np.std(all_values, ddof=1) - critical

    assert grubbs_p(values(optimize.brentq(excess, 1.0, 1e3))) == pytest.approx(0.01, abs=2e-4)
    assert grubbs_p(np.ones(4)) == grubbs_p(np.array([1.0, 2.0])) == 1.0
    assert grubbs_p(np.array([1.0, 1.0, 1.0, 2.0])) < 1e-6, "equal but for one"
