"""ISO 230-2 figures: published readings, laws, what is refused."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from support.published_iso230 import PUBLISHED, VECTOR, vector_runs

from tvsbayes.metrology.iso230 import figures_of
from tvsbayes.results.metrology_tables import FIGURES

ROUNDING = 1e-9
"""Relative, of sums of a dozen doubles."""


PRINTED = 5e-7
"""Half a unit of the last digit of the published table, relative to its values of 1 to 100."""


def test_figures_of_the_published_readings():
    table = figures_of(*vector_runs())
    assert set(PUBLISHED) == set(FIGURES)
    for name, value in PUBLISHED.items():
        assert float(getattr(table, name)) == pytest.approx(value, rel=PRINTED), name
    np.testing.assert_allclose(table.reversal_at_deg, VECTOR[:, 4], atol=ROUNDING * 100)
    np.testing.assert_allclose(table.sd_up_deg, VECTOR[:, 2], rtol=PRINTED)
    at_each = np.maximum(
        2 * table.sd_up_deg + 2 * table.sd_down_deg + np.abs(table.reversal_at_deg),
        4 * np.maximum(table.sd_up_deg, table.sd_down_deg),
    )
    np.testing.assert_allclose(at_each, VECTOR[:, 5], rtol=PRINTED)


def test_figures_of_many_tests_are_those_of_each():
    rng = np.random.default_rng(1)
    up, down = rng.normal(size=(3, 4, 5)), rng.normal(size=(3, 4, 6))
    together = figures_of(up, down)
    for k in range(3):
        one = figures_of(up[k], down[k])
        for name in msgspec.structs.asdict(one):
            np.testing.assert_allclose(getattr(together, name)[k], getattr(one, name), rtol=ROUNDING)


def test_laws_of_the_figures():
    rng = np.random.default_rng(2)
    up, down = rng.normal(size=(6, 5)), rng.normal(0.5, 2.0, size=(6, 5))
    table = figures_of(up, down)
    # A common offset changes nothing; exchanging the sides exchanges their figures and turns B_i round.
    shifted, turned = figures_of(up + 7.0, down + 7.0), figures_of(down, up)
    for name in FIGURES:
        partner = name.replace("_up_", "_X_").replace("_down_", "_up_").replace("_X_", "_down_")
        sign = -1 if name == "mean_reversal_deg" else 1
        assert float(getattr(shifted, name)) == pytest.approx(float(getattr(table, name)), rel=1e-12), name
        assert float(getattr(turned, partner)) == pytest.approx(sign * float(getattr(table, name)), rel=1e-12), name
    # What the standard's definitions imply.
    assert table.systematic_deg >= max(table.systematic_up_deg, table.systematic_down_deg, table.mean_systematic_deg)
    assert table.accuracy_deg >= max(table.accuracy_up_deg, table.accuracy_down_deg, table.systematic_deg)
    assert table.repeatability_deg >= max(table.repeatability_up_deg, table.repeatability_down_deg, table.reversal_deg)


def test_runs_that_were_not_made_are_left_out():
    rng = np.random.default_rng(3)
    up, down = rng.normal(size=(2, 3)), rng.normal(size=(2, 4))
    padded = np.full((2, 6), np.nan)
    padded[:, 1:4] = up
    for name, value in msgspec.structs.asdict(figures_of(padded, down)).items():
        np.testing.assert_allclose(value, getattr(figures_of(up, down), name), rtol=ROUNDING)


@pytest.mark.parametrize(
    ("up", "down"),
    [
        (np.zeros((3, 1)), np.zeros((3, 5))),
        (np.zeros((3, 5)), np.zeros((4, 5))),
        (np.zeros(5), np.zeros(5)),
        (np.zeros((0, 5)), np.zeros((0, 5))),
        (np.array([[0.0, np.nan]]), np.zeros((1, 2))),
        (np.array([[0.0, np.inf, 1.0]]), np.zeros((1, 2))),
    ],
)
def test_too_little_for_figures_is_refused(up, down):
    with pytest.raises(ValueError, match="target"):
        figures_of(up, down)
