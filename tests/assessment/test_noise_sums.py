"""Scales of noise of which the data determine only sums of variances are named, others are not."""

from __future__ import annotations

import numpy as np
import pytest

from tvsbayes.assessment.weaknesses import sum_directions
from tvsbayes.instrument.mechanisms import TWO_MIRROR

DRAWS = 4000
FREE, EVEN = np.ones(len(TWO_MIRROR.names), dtype=bool), np.full(DRAWS, 1 / DRAWS)
LEFT, LOOK, NOISE = "stop_sd_deg.left", "look_scatter_deg.pan", "pixel_scale"


def independent() -> np.ndarray:
    """Independent draws of all parameters, shape (DRAWS, p)."""
    return np.random.default_rng(5).lognormal(0.0, 0.3, (DRAWS, len(TWO_MIRROR.names)))


def known_sum_of(*parts: str) -> np.ndarray:
    """The same, with the sum of the squares of `parts` known to 5 %, and anything of its division."""
    draws, rng = independent(), np.random.default_rng(6)
    total = 1 + 0.05 * rng.standard_normal((DRAWS, 1))
    draws[:, [TWO_MIRROR.index[name] for name in parts]] = np.sqrt(total * rng.dirichlet(np.ones(len(parts)), DRAWS))
    return draws


@pytest.mark.parametrize(
    ("parts", "text"),
    [
        ((LEFT, LOOK), "only the sum of the variances of stop scatter left and look scatter pan is known ("),
        (
            (LEFT, LOOK, NOISE),
            "the sums of the variances of stop scatter left, look scatter pan and noise, estimated / stated are",
        ),
    ],
)
def test_what_is_known_in_a_sum_alone_is_named(parts, text):
    """Two parts of a known sum correlate with -1, three with -0.5: together the others explain each."""
    (weak,) = sum_directions(TWO_MIRROR.names, FREE, known_sum_of(*parts), EVEN)
    assert weak.of_sums and text in weak.text and weak.text.endswith("; look twice at some stops")
    assert weak.loadings.pop(LEFT) == pytest.approx(1.0)
    assert set(weak.loadings) == {*parts} - {LEFT} and all(-1 <= value < -0.4 for value in weak.loadings.values())


def test_what_is_separated_or_fixed_is_not_named():
    assert sum_directions(TWO_MIRROR.names, FREE, independent(), EVEN) == ()
    assert sum_directions(TWO_MIRROR.names, ~FREE, independent(), EVEN) == ()
    shared, fixed = known_sum_of(LEFT, LOOK), FREE.copy()
    fixed[TWO_MIRROR.index[LOOK]] = False
    assert sum_directions(TWO_MIRROR.names, fixed, shared, EVEN) == ()
    shared[:, TWO_MIRROR.index[LOOK]] = 0.01
    assert sum_directions(TWO_MIRROR.names, FREE, shared, EVEN) == ()


def test_draws_count_with_their_weights():
    mixed, weights = np.concatenate([known_sum_of(LEFT, LOOK), independent()]), np.repeat([1 / DRAWS, 0.0], DRAWS)
    assert sum_directions(TWO_MIRROR.names, FREE, mixed, weights)
    assert sum_directions(TWO_MIRROR.names, FREE, mixed, weights[::-1]) == ()
