"""Lowest and highest counter of the axes, steps, as `[positioner]` of a rig file states them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from tvsbayes.instrument.axes import AXES

COUNTER_MAX = 10**8
"""Largest absolute counter of a plan, a campaign or a limit."""
LIMIT_KEYS = {axis: (f"{axis}_min_steps", f"{axis}_max_steps") for axis in AXES}
"""Entries of `[positioner]`, lowest first."""
HOME_KEYS = {axis: f"{axis}_home_steps" for axis in AXES}
"""Entries of `[positioner]` that give the counter at the home switch."""


def unseen(counters: Sequence[float], ranges: Iterable[Sequence[float]]) -> str:
    """Which counters (pan, tilt) lie outside the lowest and highest ones seen, in words; "" if none."""
    outside = [
        f"{axis} {counter:g} lies outside {low:g} to {high:g}"
        for axis, counter, (low, high) in zip(AXES, counters, ranges, strict=True)
        if not low <= counter <= high
    ]
    return " and ".join(outside)


@dataclass(frozen=True)
class CounterLimits:
    """Lowest and highest counter by axis; None where the rig file does not state it."""

    steps: Mapping[str, tuple[int | None, int | None]]

    @classmethod
    def of(cls, positioner: Mapping[str, object]) -> CounterLimits:
        """The limits among the entries of `[positioner]`, which the reader has checked."""
        limits = {key: value for key, value in positioner.items() if isinstance(value, int)}
        return cls({axis: (limits.get(low), limits.get(high)) for axis, (low, high) in LIMIT_KEYS.items()})

    @property
    def unstated(self) -> tuple[str, ...]:
        """Entries of `[positioner]` that are missing."""
        return tuple(
            key
            for axis, keys in LIMIT_KEYS.items()
            for key, value in zip(keys, self.steps[axis], strict=True)
            if value is None
        )

    def within[Number: (int, float)](
        self, widest: Mapping[str, tuple[Number, Number]]
    ) -> dict[str, tuple[int | Number, int | Number]]:
        """Lowest and highest counter by axis, the limits of `widest` where none are stated."""
        return {
            axis: (widest[axis][0] if low is None else low, widest[axis][1] if high is None else high)
            for axis, (low, high) in self.steps.items()
        }

    def allow(self, axis: str, counter: int) -> bool:
        """Whether a counter lies within the stated limits."""
        low, high = self.steps[axis]
        return (low is None or counter >= low) and (high is None or counter <= high)

    def words(self, axis: str) -> str:
        """The stated limits of an axis, in words."""
        low, high = self.steps[axis]
        return (
            f"{low} to {high}"
            if low is not None and high is not None
            else (f"up to {high}" if low is None else f"{low} and more")
        )
