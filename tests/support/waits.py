"""What holds of the news of any wait."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from tvsbayes.progress import Progress

ROUNDING_S = 1e-9
"""Of seconds since a computer was started, up to 10^7 of them with 16 digits."""


def check_forward(waits: Sequence[Progress]) -> None:
    """The share never falls and ends at 1; time left rises by no more than has passed."""
    assert waits[-1].share == 1 and waits[-1].seconds_left == 0
    assert 0 <= waits[0].share and all(state.doing for state in waits)
    for before, after in pairwise(waits):
        passed = after.seconds - before.seconds
        assert after.share >= before.share and passed >= 0, (before, after)
        if before.seconds_left is not None:
            assert after.seconds_left is not None
            assert 0 <= after.seconds_left <= before.seconds_left + passed + ROUNDING_S, (before, after)


def doings(waits: Sequence[Progress]) -> list[str]:
    """What was done, in order, without details."""
    names: list[str] = []
    for state in waits:
        name = state.doing.split(":")[0]
        if not names or names[-1] != name:
            names.append(name)
    return names
