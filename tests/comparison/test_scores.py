"""Scores of predictions by hand; the interval of a ratio of errors covers."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from tvsbayes.comparison.held_out import judge, ratio_interval
from tvsbayes.results.comparison_record import BETTER_CLASSIC, BETTER_JOINT, CANNOT_TELL, Prediction


def test_scores_of_predictions_by_hand():
    """Two folds of two: errors of the classic 3, 1, -2, -4 (3 degrees of freedom), of the joint a tenth; all u = 1."""
    predictions = []
    for e, (fold, direction, error) in enumerate(
        (("a", "left", 3), ("a", "left", 1), ("b", "up", -2), ("b", "up", -4))
    ):
        predictions.append(Prediction(e, fold, direction, 100, 6.0 + error, 6.0, 1.0, 3, 6.0 + 0.9 * error, 1.0))
    held = judge("steps", predictions, np.array([100, 200]), {})
    assert held.classic.rms_deg == pytest.approx(np.sqrt(30 / 4)) and held.joint.rms_deg == pytest.approx(
        np.sqrt(0.075)
    )
    # Means of the blocks: 2 and -3, a tenth of them for the joint.
    assert held.classic.rms_block_deg == pytest.approx(np.sqrt(6.5)) and held.ratio == pytest.approx(10.0)
    # t(0.975, 3) = 3.18.
    assert (held.classic.coverage, held.joint.coverage) == (0.75, 1.0)
    # Student's density with 3 degrees of freedom is 6 sqrt 3 / (pi (3 + x^2)^2).
    student = [6 * np.sqrt(3) / np.pi / (3 + x * x) ** 2 for x in (3, 1, -2, -4)]
    normal = [np.exp(-0.5 * x * x) / np.sqrt(2 * np.pi) for x in (0.3, 0.1, -0.2, -0.4)]
    for score, density in ((held.classic, student), (held.joint, normal)):
        assert score.log_density == pytest.approx(np.mean(np.log(density)))
    assert held.verdict == CANNOT_TELL and "2 blocks" in held.reason


@pytest.mark.parametrize("verdict", [BETTER_JOINT, BETTER_CLASSIC])
def test_the_better_predictor_is_named(verdict):
    """Eight blocks; the joint's errors are a tenth of the classic's, or the reverse."""
    errors = np.random.default_rng(1).normal(size=8)
    near, far = 6.0 + 0.9 * errors, np.full(8, 6.0)
    if verdict == BETTER_CLASSIC:
        near, far = far, near
    predictions = [
        Prediction(e, f"fold {e}", "left", 100, 6.0 + error, float(far[e]), 1.0, 3, float(near[e]), 1.0)
        for e, error in enumerate(errors)
    ]
    held = judge("steps", predictions, np.array([100, 200]), {})
    assert held.verdict == verdict
    assert held.ratio == pytest.approx(10.0 if verdict == BETTER_JOINT else 0.1)
    # Proportional errors leave no doubt about their ratio; the correlation is 1 but for rounding.
    assert held.interval95 == pytest.approx((held.ratio, held.ratio), rel=1e-6)


@pytest.mark.parametrize(("correlation", "true"), [(0.0, 1.0), (0.7, 1.0), (0.6, 3.0)])
def test_interval_of_the_ratio_of_errors_covers(correlation, true):
    """Exact for normal pairs with mean 0: 4000 seeded sets of 8 blocks, binomial bounds at 1e-4."""
    sets = 4000
    generator = np.random.default_rng([8, round(10 * correlation)])
    first = generator.standard_normal((sets, 8))
    second = correlation * first + np.sqrt(1 - correlation**2) * generator.standard_normal((sets, 8))
    inside = 0
    for a, b in zip(true * first, second, strict=True):
        low, high = ratio_interval(a, b)
        inside += low <= true <= high
    low, high = stats.binom.ppf([1e-4, 1 - 1e-4], sets, 0.95)
    assert low <= inside <= high
