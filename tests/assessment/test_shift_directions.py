"""A shift of a zero that cannot be separated from gear errors is a weak direction in words."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from tvsbayes.assessment.weaknesses import _shift_directions
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.model.headlines import MODELLED, Derived

DRAWS = 4000


def fit_with(correlation: float, shift: str, *, free: bool = True) -> SimpleNamespace:
    """A fit whose contrast of pan goes with a shift of the zero; everything else is independent."""
    rng = np.random.default_rng(3)
    physical = rng.standard_normal((DRAWS, len(TWO_MIRROR.names)))
    ratios = 0.06 + 1e-5 * rng.standard_normal((DRAWS, len(DIRECTIONS)))
    column = physical[:, TWO_MIRROR.index[shift]]
    apart = correlation * column + np.sqrt(1 - correlation**2) * rng.standard_normal(DRAWS)
    left, right = DIRECTIONS.index("left"), DIRECTIONS.index("right")
    mean = 0.5 * (ratios[:, left] + ratios[:, right])
    ratios[:, left], ratios[:, right] = mean + 1e-4 * apart, mean - 1e-4 * apart
    none = np.zeros((DRAWS, len(MODELLED))), np.zeros((DRAWS, 2, 2)), np.zeros((DRAWS, 0))
    draws = Derived(physical, *none, TWO_MIRROR.key)
    draws.modelled[:, [MODELLED[f"effective_deg_per_step.{direction}"] for direction in DIRECTIONS]] = ratios
    return SimpleNamespace(draws=draws, names=TWO_MIRROR.names, free=np.full(len(TWO_MIRROR.names), free))


@pytest.mark.parametrize(
    ("shift", "word"), [("creep_deg.pan", "alternate the directions"), ("thermal_deg_per_K.pan", "another temperature")]
)
def test_a_contrast_that_goes_with_a_shift_is_named_with_its_remedy(shift, word):
    (weak,) = _shift_directions(fit_with(0.8, shift), "pan")
    assert weak.text.startswith("the contrast of left and right and a ") and word in weak.text
    assert set(weak.loadings) == {"ratio_contrast_deg_per_step.pan", shift}
    assert weak.loadings[shift] == pytest.approx(0.8, abs=4 / np.sqrt(DRAWS))


def test_what_is_separated_or_not_estimated_is_not_named():
    assert not list(_shift_directions(fit_with(0.3, "creep_deg.pan"), "pan"))
    assert not list(_shift_directions(fit_with(0.8, "creep_deg.pan"), "tilt"))
    assert not list(_shift_directions(fit_with(0.8, "creep_deg.pan", free=False), "pan"))
