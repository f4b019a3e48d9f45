"""Ways of homing by the evidence of fits under them."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from tvsbayes.estimators.homing_evidence import WORTH_A_FIT, most_fits, weighed
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.homing import ANYWHERE, every_way

OF = {"left": 0.0, "right": -2.0, "up": -9.0, "down": 1.0, ANYWHERE: -1.0}
"""Log evidence of a way of one axis; axes are independent."""


def independent(sides) -> float:
    return sum(OF[side] for side in sides.values())


@pytest.mark.parametrize("axes", [AXES[:1], AXES[1:], AXES])
def test_probabilities_are_evidence_over_their_sum_most_probable_first(axes):
    ways = weighed(axes, independent)
    every = {tuple(sorted(sides.items())): np.exp(independent(sides)) for sides in every_way(axes)}
    total = sum(every.values())
    for way in ways:
        # Ways below one in a thousand are left out of the sum: nine of them at most.
        assert way.probability == pytest.approx(every[tuple(sorted(way.sides.items()))] / total, rel=9 * WORTH_A_FIT)
    chances = [way.probability for way in ways]
    assert chances == sorted(chances, reverse=True) and sum(chances) == pytest.approx(1.0)


def test_no_way_is_fitted_that_cannot_matter_and_few_where_one_axis_was_recorded():
    fits: Counter[tuple[tuple[str, str], ...]] = Counter()

    def evidence(sides) -> float:
        fits[tuple(sorted(sides.items()))] += 1
        return independent(sides)

    ways = weighed(AXES, evidence)
    # "up" is e^10 less probable than "down": it is fitted alone, never with a side of the other axis.
    together = [dict(key) for key in fits if ANYWHERE not in dict(key).values()]
    assert together and all("up" not in sides.values() for sides in together)
    assert len(fits) < most_fits(AXES) and most_fits(AXES[:1]) == 3 and most_fits(()) == 0
    assert {tuple(way.sides.values()) for way in ways} >= {("left", "down"), ("right", "down")}
