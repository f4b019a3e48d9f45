"""The search for looks: greedy, exchanges, criteria, and the smallest number that meets."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs
from support.coarse_planning import ROUNDING

from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.plan import LOOKS_PER_EXPERIMENT
from tvsbayes.planning import search
from tvsbayes.planning.assurance import Assurance, Family
from tvsbayes.planning.drawn_rigs import draw_instruments
from tvsbayes.planning.looks import CONTRAST_COLUMNS, covariance_of, information_of_looks
from tvsbayes.planning.search import (
    CONTRAST_PRECISION,
    CRITERIA,
    MEAN_WEIGHT,
    DesignProblem,
    Scope,
    Search,
    scores,
    search_precision,
    smallest_design,
)
from tvsbayes.planning.target import parse_target, sensitivity

pytestmark = pytest.mark.usefixtures("small_searches")


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


def test_a_search_after_data_knows_no_home_offset(knowledge, seen):
    """Offsets of the new session are two columns with the variance of homing: eliminated, they leave the exact sum."""
    known = replace(knowledge, after_data=True)
    rows = seen.rows.copy()
    rows[..., CONTRAST_COLUMNS] = 0
    shown, picks = replace(seen, rows=rows), np.arange(6)
    wide, precision = shown.rows, search_precision(known)
    whole = covariance_of(precision + np.einsum("mij,mik->jk", wide[picks], wide[picks]))[
        : len(TWO_MIRROR.names), : len(TWO_MIRROR.names)
    ]
    exact = information_of_looks(shown, picks, np.zeros((6, 2)), knowledge.space, known.home_variances_rad2)
    contrasts = np.isin(np.arange(len(TWO_MIRROR.names)), CONTRAST_COLUMNS)
    expected = covariance_of(known.precision + exact + CONTRAST_PRECISION * np.diag(contrasts))
    assert whole == pytest.approx(expected, rel=ROUNDING, abs=ROUNDING * expected.max())
    without = information_of_looks(shown, picks, np.zeros((6, 2)), knowledge.space, None)
    assert np.abs(without - exact).max() > 1e-3 * np.abs(exact).max(), "offsets count, or they could be left out"


@pytest.fixture(scope="module")
def refine(knowledge, pool, seen):
    """(first choice, limit, minutes) -> reported values of that choice, and what became of it."""

    def run(picks, limit, minutes=None):
        target = structs.replace(parse_target("u(left) <= 1 deg/step"), limit=limit)
        family = Family(knowledge, pool, np.asarray(picks), False)
        pose = seen.mirror_angles_rad.mean(axis=0)
        at = sensitivity(target, knowledge.z, knowledge.space, knowledge.rig.table, pose)
        assurance = Assurance(family, target, draw_instruments(knowledge, 10, 3), 3)
        plain = assurance.values([2])[2]
        problem = DesignProblem(knowledge, pool, seen, target, at)
        return plain, search.refine(family, problem, 2, Scope(minutes=minutes), assurance)

    return run


@pytest.fixture(scope="module")
def poor(pool):
    """Eight looks at one sheet, all at one place: no information on the ratio."""
    return np.full(2 * LOOKS_PER_EXPERIMENT, np.flatnonzero(pool.looks.sheet == 1)[0])


def test_exchanges_are_kept_where_they_raise_assurance_or_lower_the_median(refine, poor):
    plain, refined = refine(poor, 1e-9)
    values = refined.reported
    assert np.median(values) < 0.9 * np.median(plain) and not np.array_equal(refined.family.picks, poor)
    between = 0.5 * (np.median(values) + plain.min())
    assert np.mean(plain <= between) < np.mean(values <= between)
    assert np.array_equal(refine(poor, between)[1].reported, values)


def test_exchanges_that_cost_assurance_or_time_are_not_kept(refine, poor, monkeypatch):
    better = refine(poor, 1e-9)[1]
    plain, late = refine(poor, 1e-9, minutes=0.0)
    assert np.array_equal(late.family.picks, poor) and np.array_equal(late.reported, plain)
    monkeypatch.setattr(Search, "exchange", lambda self, picks: list(poor))
    plain, kept = refine(better.family.picks, 1e-9)
    assert np.array_equal(kept.family.picks, better.family.picks)
    assert np.array_equal(kept.reported, plain) and np.array_equal(plain, better.reported)


def test_the_smallest_number_that_meets_is_found():
    ladder = (1, 2, 3, 5, 8, 12, 20, 40)
    for answer in range(1, 41):
        assert smallest_design(lambda n, answer=answer: n >= answer, ladder) == answer
    assert smallest_design(lambda n: n >= 41, ladder) is None
