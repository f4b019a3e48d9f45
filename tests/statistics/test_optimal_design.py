"""The choice of what to measure next: greedy, exchanges, criteria, hypotheses, and the smallest number that meets."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.coarse_planning import ROUNDING

from tvsbayes.statistics.optimal_design import (
    CRITERIA,
    MEAN_WEIGHT,
    Search,
    discriminating_visits,
    scores,
    smallest_design,
)


def test_greedy_takes_the_best_look_and_exchange_never_worsens():
    generator = np.random.default_rng(9)
    rows, gradient = generator.normal(size=(12, 4, 6)), generator.normal(size=(2, 6))
    search = Search(rows, np.diag([1.0, 2, 3, 4, 5, 6]), gradient, np.zeros(2))
    one = [search.value([k]) for k in range(12)]
    picks = search.greedy(4)
    assert picks[0] == int(np.argmin(one))
    assert search.after_one_more(search.covariance) == pytest.approx(one, rel=ROUNDING)
    every = min(search.value([a, b, c]) for a in range(12) for b in range(a, 12) for c in range(b, 12))
    exchanged = search.exchange(picks[:3])
    assert every * (1 - ROUNDING) <= search.value(exchanged) <= search.value(picks[:3])
    assert search.value(exchanged) < 1.05 * every
    worst = 3 * [int(np.argmax(one))]
    assert search.value(search.exchange(worst)) < 1.05 * every < 0.9 * search.value(worst)


@pytest.mark.parametrize("criterion", CRITERIA)
@pytest.mark.parametrize("share", [1.0, 0.4])
def test_greedy_choices_are_those_of_inverted_covariances(criterion, share):
    """Every candidate beside everything chosen before it, by a whole inverse each; prior sds from 1 to 1000."""
    generator = np.random.default_rng(11)
    rows, gradient = generator.normal(size=(30, 4, 7)), generator.normal(size=(3, 7))
    precision, noise = np.diag(np.logspace(0, -6, 7)), np.array([0.0, 1e-3, 0.0])
    allowed = generator.uniform(size=30) < share
    search = Search(rows, precision, gradient, noise, criterion)
    reference = np.diag(gradient @ np.linalg.inv(precision) @ gradient.T) + noise
    expected, known = [], precision
    for _ in range(40):
        score_of = {}
        for k in np.flatnonzero(allowed).tolist():
            covariance = gradient @ np.linalg.inv(known + rows[k].T @ rows[k]) @ gradient.T + np.diag(noise)
            score_of[k] = float(scores(covariance, reference, criterion))
        expected.append(min(score_of, key=score_of.__getitem__))
        known = known + rows[expected[-1]].T @ rows[expected[-1]]
    # Scores of the best two differ by 1e-6 of themselves or more: rounding decides nothing.
    assert search.among(allowed).greedy(40) == expected
    assert search.among(allowed).value(expected) == pytest.approx(search.value(expected), rel=1e-12)
    assert search.among(np.zeros(30, dtype=bool)).greedy(3) == []


@pytest.mark.parametrize("criterion", CRITERIA)
def test_a_quantity_without_variance_does_not_steer_a_search(criterion):
    generator = np.random.default_rng(10)
    rows, gradient = generator.normal(size=(12, 4, 6)), generator.normal(size=(3, 6))
    gradient[1] = 0
    with_fixed, without = (
        Search(rows, np.eye(6), g, np.zeros(len(g)), criterion) for g in (gradient, gradient[[0, 2]])
    )
    assert with_fixed.greedy(4) == without.greedy(4)
    assert math.isfinite(with_fixed.value([0, 1]))


def test_criteria_are_what_they_say():
    covariance, reference = np.array([[4.0, 1.0], [1.0, 2.0]]), np.array([8.0, 2.0])
    assert scores(covariance, reference, "c") == pytest.approx(4.0 + MEAN_WEIGHT * 3.0)
    assert scores(covariance, reference, "A") == pytest.approx((4 / 8 + 2 / 2) / 2)
    assert scores(covariance, reference, "D") == pytest.approx(math.log(7.0 / 16.0))


@pytest.mark.parametrize("noise", [0.5, 0.0])
def test_visits_are_those_of_inverted_covariances(noise):
    """Every stop once more beside all before, by a whole inverse each; exact readings are not read twice."""
    generator, places = np.random.default_rng(12), np.linspace(0, 1, 9)
    common, first = 0.2 + 0.3 * np.exp(-3 * np.abs(places[:, None] - places)), np.isin(np.arange(9), [0, 4, 8])
    off, variances = [generator.normal(size=9), 0.6 * generator.normal(size=9)], np.full(9, noise)

    def nearest(visits: np.ndarray) -> float:
        used = np.flatnonzero(visits)
        whole = common[np.ix_(used, used)] + np.diag(variances[used] / visits[used])
        return min(each[used] @ np.linalg.solve(whole, each[used]) for each in off)

    expected = first.astype(float)
    while nearest(expected) < 60 and expected.sum() < (20 if noise else 7):
        expected += max(np.eye(9), key=lambda one: nearest(expected + one))
    visits, distance = discriminating_visits(off, common, variances, first, 60.0, 20 if noise else 7)
    assert visits.tolist() == expected.tolist() and (noise == 0.0 or visits.max() > 1)
    assert distance == pytest.approx(nearest(expected), rel=1e-6)
    every, _ = discriminating_visits(off, common, variances, ~first & first, 0.0, 20)
    assert every.tolist() == [1.0] * 9


def test_the_smallest_number_that_meets_is_found():
    ladder = (1, 2, 3, 5, 8, 12, 20, 40)
    for answer in range(1, 41):
        assert smallest_design(lambda n, answer=answer: n >= answer, ladder) == answer
    assert smallest_design(lambda n: n >= 41, ladder) is None
