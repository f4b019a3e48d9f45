"""Unknowns fitted and tested in a linear model: as the same model solved as a whole."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from tvsbayes.statistics.score import Directions, Score

RNG = np.random.default_rng(4)
COLUMNS, RESIDUAL = RNG.standard_normal((30, 5)), RNG.standard_normal(30)
WHOLE = Score(COLUMNS.T @ RESIDUAL, COLUMNS.T @ COLUMNS)
ROUNDING = 1e-10


def test_what_is_left_beside_fitted_unknowns_is_that_of_the_whole_model():
    """The estimate of the others and its information are those of one solution for all (block elimination)."""
    fitted = slice(0, 3)
    left = WHOLE.given(fitted, np.linalg.inv(WHOLE.information[fitted, fitted])).at(slice(3, None))
    whole = np.linalg.lstsq(COLUMNS, RESIDUAL, rcond=None)[0]
    np.testing.assert_allclose(np.linalg.solve(left.information, left.value), whole[3:], rtol=ROUNDING)
    np.testing.assert_allclose(np.linalg.inv(left.information), np.linalg.inv(WHOLE.information)[3:, 3:], rtol=ROUNDING)


def test_a_direction_without_information_is_no_direction():
    """A column that stands twice: one degree of freedom less, the same chi-square, whatever the units."""
    doubled = np.column_stack([COLUMNS, 1e6 * COLUMNS[:, 0]])
    information, score = doubled.T @ doubled, doubled.T @ RESIDUAL
    known = Directions.of(information, 1e-6, np.sqrt(np.diag(information)))
    assert len(known.values) == 5
    chi2 = WHOLE.value @ np.linalg.solve(WHOLE.information, WHOLE.value)
    assert known.chi2(score) == pytest.approx(chi2, rel=1e-8)
    assert known.log_chances(score) == pytest.approx(stats.chi2.logsf(chi2, 5), rel=1e-8)
    np.testing.assert_allclose(
        doubled @ known.inverse @ score, COLUMNS @ np.linalg.lstsq(COLUMNS, RESIDUAL)[0], rtol=1e-6
    )


def test_nothing_known_raises_no_alarm():
    assert Directions.of(np.zeros((2, 2)), 1e-6).log_chances(np.ones((3, 2))).tolist() == [0.0, 0.0, 0.0]
