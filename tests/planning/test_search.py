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
from tvsbayes.planning.looks import CONTRAST_COLUMNS, information_of_looks
from tvsbayes.planning.search import CONTRAST_PRECISION, DesignProblem, Scope
from tvsbayes.planning.target import parse_target, sensitivity
from tvsbayes.statistics.optimal_design import Search, covariance_of

pytestmark = pytest.mark.usefixtures("small_searches")


def test_a_search_after_data_knows_no_home_offset(knowledge, pool, seen):
    """Offsets of the new session are two columns with the variance of homing: eliminated, they leave the exact sum."""
    known = replace(knowledge, after_data=True)
    rows = seen.rows.copy()
    rows[..., CONTRAST_COLUMNS] = 0
    shown, picks = replace(seen, rows=rows), np.arange(6)
    target = parse_target("u(left) <= 1 deg/step")
    at = sensitivity(target, known.z, known.space, known.rig.table, seen.mirror_angles_rad.mean(axis=0))
    wide, precision = shown.rows, DesignProblem(known, pool, shown, target, at).search().precision
    of_coordinates = slice(len(TWO_MIRROR.names))
    whole = covariance_of(precision + np.einsum("mij,mik->jk", wide[picks], wide[picks]))
    whole = whole[of_coordinates, of_coordinates]
    exact = information_of_looks(shown, picks, np.zeros((6, 2)), knowledge.space, known.home_variances_rad2)
    contrasts = np.isin(np.arange(len(TWO_MIRROR.names)), CONTRAST_COLUMNS)
    expected = covariance_of(known.precision + exact + CONTRAST_PRECISION * np.diag(contrasts))
    assert whole == pytest.approx(expected, rel=ROUNDING, abs=ROUNDING * expected.max())
    without = information_of_looks(shown, picks, np.zeros((6, 2)), knowledge.space, None)
    assert np.abs(without - exact).max() > 1e-3 * np.abs(exact).max(), "offsets count, or they could be left out"


@pytest.fixture(scope="module")
def refine(knowledge, pool, seen):
    """(first choice, limit, minutes) -> reported values of that choice, and what became of it."""

    def run(picks, limit, minutes=math.inf):
        target = structs.replace(parse_target("u(left) <= 1 deg/step"), limit=limit)
        family = Family(knowledge, pool, np.asarray(picks), False)
        pose = seen.mirror_angles_rad.mean(axis=0)
        at = sensitivity(target, knowledge.z, knowledge.space, knowledge.rig.table, pose)
        assurance = Assurance(family, target, draw_instruments(knowledge, 10, 3), 3)
        plain = assurance.values([2])[2]
        problem = DesignProblem(knowledge, pool, seen, target, at)
        return plain, search.refine(assurance, problem, 2, Scope(minutes=minutes))

    return run


@pytest.fixture(scope="module")
def poor(pool):
    """Eight looks at one sheet, all at one place: no information on the ratio."""
    return np.full(2 * LOOKS_PER_EXPERIMENT, np.flatnonzero(pool.looks.sheet == 1)[0])


def test_exchanges_are_kept_where_they_raise_assurance_or_lower_the_median(refine, poor):
    plain, refined = refine(poor, 1e-9)
    family, values = refined
    assert np.median(values) < 0.9 * np.median(plain) and not np.array_equal(family.picks, poor)
    between = 0.5 * (np.median(values) + plain.min())
    assert np.mean(plain <= between) < np.mean(values <= between)
    assert np.array_equal(refine(poor, between)[1][1], values)


def test_exchanges_that_cost_assurance_or_time_are_not_kept(refine, poor, monkeypatch):
    _, (better, highest) = refine(poor, 1e-9)
    plain, (late, reported) = refine(poor, 1e-9, minutes=0.0)
    assert np.array_equal(late.picks, poor) and np.array_equal(reported, plain)
    monkeypatch.setattr(Search, "exchange", lambda self, picks: list(poor))
    plain, (kept, reported) = refine(better.picks, 1e-9)
    assert np.array_equal(kept.picks, better.picks)
    assert np.array_equal(reported, plain) and np.array_equal(plain, highest)
