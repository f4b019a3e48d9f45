"""Are the ranks of truths among posterior draws uniform? PIT values and simultaneous bands of their ECDF.

PIT = (rank + U) / (draws + 1) with seeded U. The band is that of Sailynoja et al., doi 10.1007/s11222-022-10090-6.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import stats

DRAWS = 255
"""Draws of a simulation among which the truth is ranked."""
ALPHA = 0.05
"""Of all quantities of a study together: each has to reach a p of ALPHA / number of quantities."""
FAULT_SIMULATIONS = 50
"""As few simulations as show a planted fault; fewer judge nothing."""
BAND_SEED, BAND_SAMPLES, PIT_SEED = 214, 20_000, 215


class Band:
    """Simultaneous band of the ECDF of n uniforms, at k / n, k = 1 ... n - 1."""

    def __init__(self, n: int):
        self.n, self.points = n, np.arange(1, n) / n
        counts = np.arange(n + 1)[:, None]
        self.tail = np.minimum(stats.binom.cdf(counts, n, self.points), stats.binom.sf(counts - 1, n, self.points))
        uniform = np.random.default_rng(BAND_SEED).uniform(size=(BAND_SAMPLES, n))
        self.null = np.sort([self.statistic(u) for u in uniform])

    def counts(self, pit: np.ndarray) -> np.ndarray:
        """ECDF at the points, times n."""
        return np.searchsorted(np.sort(pit), self.points, side="right")

    def statistic(self, pit: np.ndarray) -> float:
        """The smallest binomial tail probability over all points."""
        return float(np.min(self.tail[self.counts(pit), np.arange(self.n - 1)]))

    def p_value(self, pit: np.ndarray) -> float:
        """Share of uniform samples at least as far out at their worst point, never 0."""
        return (1 + np.searchsorted(self.null, self.statistic(pit), side="right")) / (1 + BAND_SAMPLES)

    def limits(self, alpha: float) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest ECDF inside the band."""
        inside = self.tail >= np.quantile(self.null, alpha)
        return np.argmax(inside, axis=0) / self.n, (self.n - np.argmax(inside[::-1], axis=0)) / self.n


def pit_values(rows: Sequence[dict], key: str) -> dict[str, np.ndarray]:
    """(rank + U) / (draws + 1) by quantity; the ranks of a row stand under `key`."""
    u = np.random.default_rng(PIT_SEED)
    names = list(rows[0][key])
    return {name: (np.array([r[key][name] for r in rows]) + u.uniform(size=len(rows))) / (DRAWS + 1) for name in names}
