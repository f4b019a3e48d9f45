"""What to measure next: greedy choice among candidates of a linear normal model, of any instrument. NumPy.

A candidate is a group of k observations: its whitened rows are d(observation)/d(column) over the observation's noise.
Measured, it lowers the covariance of quantities, which are linear in the columns, or raises the information on shifts
of the observations, such as another hypothesis predicts. Both change by the same m^T S^-1 m: S is the covariance of the
candidate's residuals, m that of residuals and quantities, or the part of the shifts that the columns do not explain
(Fedorov, Theory of Optimal Experiments, Academic Press 1972, 3; Anderson and Moore, Optimal Filtering, 1979, 3.1).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

CRITERIA = ("c", "D", "A")
MEAN_WEIGHT = 0.05
"""Weight of the mean variance added to the worst, so that looks that improve only other quantities count a little."""
RECOMPUTED_AFTER = 16
"""Number of choices after which prospects are recomputed, as rounding errors of differences accumulate."""
NOISE_SHARE = 1e-12
"""Least variance of a visit's own noise, as a share of its whole variance: that of an exact reading."""


def covariance_of(information: np.ndarray) -> np.ndarray:
    """Invert positive definite matrices (..., p, p) whose diagonals span many orders of magnitude."""
    scale = 1 / np.sqrt(np.diagonal(information, axis1=-2, axis2=-1))
    scales = scale[..., :, None] * scale[..., None, :]
    return np.linalg.inv(information * scales) * scales


def scores(variances: np.ndarray, reference: np.ndarray, criterion: str) -> np.ndarray:
    """Compute scores to minimise from covariances (..., q, q) of the quantities; shape (...).

    "c": the worst variance and `MEAN_WEIGHT` of the mean; "D": log-determinant; "A": mean variance in units of
    `reference` (q,).
    """
    if criterion == "D":
        return np.linalg.slogdet(variances / np.sqrt(np.outer(reference, reference)))[1]
    diagonal = np.diagonal(variances, axis1=-2, axis2=-1)
    if criterion == "A":
        return np.mean(diagonal / reference, axis=-1)
    return diagonal.max(axis=-1) + MEAN_WEIGHT * diagonal.mean(axis=-1)


@dataclass(frozen=True)
class Prospects:
    """Every one of m candidates as the next measurement, after those made; arrays with candidates last are fastest.

    Attributes:
        rows: whitened rows, shape (k, m, P).
        covariance: covariance of the columns before it, shape (P, P).
        inner: covariance of its residuals, noise included, shape (k, k, m).
        moved: covariance of its residuals with the quantities, or shifts less what the columns explain, (k, q, m).
    """

    rows: np.ndarray
    covariance: np.ndarray
    inner: np.ndarray
    moved: np.ndarray

    @classmethod
    def of(cls, rows: np.ndarray, covariance: np.ndarray, gradient: np.ndarray) -> Prospects:
        """Begin with rows (m, k, P) and the covariance of the columns; d(quantity)/d(column) has shape (q, P)."""
        moved = rows.reshape(-1, rows.shape[2]) @ (covariance @ gradient.T)
        return cls.of_shifts(rows, covariance, moved.reshape(*rows.shape[:2], len(gradient)))

    @classmethod
    def of_shifts(cls, rows: np.ndarray, covariance: np.ndarray, shifts: np.ndarray) -> Prospects:
        """Begin with shifts (m, k, q) of the candidates, in units of their noise as the rows are."""
        spread = (rows.reshape(-1, rows.shape[2]) @ covariance).reshape(rows.shape)
        inner = np.ascontiguousarray((spread @ rows.swapaxes(1, 2)).transpose(1, 2, 0))
        inner += np.eye(rows.shape[1])[:, :, None]
        first = np.ascontiguousarray(rows.swapaxes(0, 1))
        return cls(first, covariance, inner, np.ascontiguousarray(shifts.transpose(1, 2, 0)))

    def gains(self) -> np.ndarray:
        """Compute by how much each candidate changes the matrix of the quantities or shifts, shape (m, q, q).

        Elimination runs over all candidates at once; LAPACK calls for each would be slower.
        """
        inner, moved = self.inner.copy(), self.moved.copy()
        gain = np.zeros((moved.shape[1], *moved.shape[1:]))
        for i in range(len(inner)):
            gain += moved[i, :, None] * (moved[i] / inner[i, i])
            factor = inner[i + 1 :, i] / inner[i, i]
            inner[i + 1 :, i + 1 :] -= factor[:, None] * inner[i, i + 1 :]
            moved[i + 1 :] -= factor[:, None] * moved[i]
        return np.moveaxis(gain, -1, 0)

    def measured(self, index: int) -> Prospects:
        """Compute prospects after one more measurement, by a low-rank update."""
        root = np.linalg.cholesky(self.inner[:, :, index])
        update = np.linalg.solve(root, self.rows[:, index] @ self.covariance)
        cross = (update @ self.rows.reshape(-1, self.rows.shape[2]).T).reshape(self.inner.shape)
        slope = np.linalg.solve(root, self.moved[:, :, index])
        inner = self.inner - sum(part[:, None] * part for part in cross)
        moved = self.moved - sum(part[:, None] * row[:, None] for part, row in zip(cross, slope, strict=True))
        covariance = self.covariance - update.T @ update
        return Prospects(self.rows, 0.5 * (covariance + covariance.T), inner, moved)


class Search:
    """Greedy choice and exchange of measurements that lower the variances of quantities.

    A quantity fixed by the priors has no variance and is omitted.

    Args:
        rows: whitened rows of all candidates, shape (m, k, P); an excluded candidate has zero rows.
        precision: precision before any measurement, shape (P, P).
        gradient: d(quantity)/d(column), shape (q, P).
        variance: additional variance of the quantities, shape (q,).
        criterion: see `scores`.
        numbers: numbers of the candidates, ascending, shape (m,); by default their indices in `rows`.
    """

    def __init__(
        self,
        rows: np.ndarray,
        precision: np.ndarray,
        gradient: np.ndarray,
        variance: np.ndarray,
        criterion: str = "c",
        numbers: np.ndarray | None = None,
    ):
        self.rows, self.precision, self.criterion = rows, precision, criterion
        self.numbers = np.arange(len(rows)) if numbers is None else numbers
        self.covariance = covariance_of(precision)
        uncertain = np.einsum("qi,ij,qj->q", gradient, self.covariance, gradient) + variance > 0
        self.gradient, self.variance = gradient[uncertain], variance[uncertain]
        self.reference = np.diag(self._quantities(self.covariance)).copy()

    def among(self, allowed: np.ndarray) -> Search:
        """Restrict the search to some candidates, mask of shape (m,)."""
        quantities = self.gradient, self.variance
        return Search(self.rows[allowed], self.precision, *quantities, self.criterion, self.numbers[allowed])

    def _quantities(self, covariance: np.ndarray) -> np.ndarray:
        return self.gradient @ covariance @ self.gradient.T + np.diag(self.variance)

    def _prospects(self, covariance: np.ndarray) -> Prospects:
        return Prospects.of(self.rows, covariance, self.gradient)

    def _scores(self, prospects: Prospects) -> np.ndarray:
        return scores(self._quantities(prospects.covariance) - prospects.gains(), self.reference, self.criterion)

    def after_one_more(self, covariance: np.ndarray) -> np.ndarray:
        """Compute the score after adding each candidate to those that left a covariance of the columns, shape (m,)."""
        return self._scores(self._prospects(covariance))

    def greedy(self, count: int) -> list[int]:
        """Choose the best candidate, then the best addition, and so on; empty where there is no candidate."""
        prospects, places = self._prospects(self.covariance), []
        for number in range(1, count + 1 if len(self.rows) else 1):
            places.append(int(np.argmin(self._scores(prospects))))
            prospects = prospects.measured(places[-1])
            if number % RECOMPUTED_AFTER == 0:
                prospects = self._prospects(prospects.covariance)
        return self.numbers[places].tolist()

    def _after(self, places: Sequence[int]) -> np.ndarray:
        """Compute the covariance of the columns after a design."""
        rows = self.rows[list(places)].reshape(-1, self.rows.shape[2])
        return covariance_of(self.precision + rows.T @ rows)

    def value(self, picks: Sequence[int]) -> float:
        """Compute the score of a design."""
        covariance = self._after(np.searchsorted(self.numbers, picks).tolist())
        return float(scores(self._quantities(covariance), self.reference, self.criterion))

    def exchange(self, picks: Sequence[int], passes: int = 2, worth: float = 1e-3) -> list[int]:
        """Replace choices one by one while this lowers the score by more than a share `worth` (Fedorov's exchange)."""
        places = np.searchsorted(self.numbers, picks).tolist()
        for _ in range(passes):
            changed = False
            for number, place in enumerate(places):
                scores_with = self.after_one_more(self._after(places[:number] + places[number + 1 :]))
                best = int(np.argmin(scores_with))
                if scores_with[place] - scores_with[best] > worth * abs(scores_with[place]):
                    places[number], changed = best, True
            if not changed:
                break
        return self.numbers[places].tolist()


def discriminating_visits(
    off: Sequence[np.ndarray], common: np.ndarray, noise: np.ndarray, first: np.ndarray, wanted: float, most: int
) -> tuple[np.ndarray, float]:
    """Choose the fewest visits that discriminate hypotheses, each alone, from the one that holds.

    Args:
        off: deviation of each other hypothesis at the candidates, shape (m,) each.
        common: covariance (m, m) of errors common to all visits.
        noise: variances of the noise drawn at each visit, shape (m,).
        first: mask of candidates that are always visited; all where it holds none.
        wanted: squared distance, in standard deviations of the readings, of the nearest hypothesis that is enough.
        most: largest number of visits.

    Returns:
        Number of visits to each candidate, shape (m,), and the squared distance of the nearest hypothesis by them.
    """
    sd = np.sqrt(np.maximum(noise, NOISE_SHARE * (noise + np.diag(common))))
    shifts = (np.array(off) / sd).T[:, None]
    prospects = Prospects.of_shifts((np.eye(len(sd)) / sd[:, None])[:, None], common, shifts)
    visits, distance = np.zeros(len(sd)), np.zeros(len(off))
    always = np.flatnonzero(first if first.any() else ~first).tolist()
    while always or (distance.min() < wanted and visits.sum() < most):
        each = distance + np.diagonal(prospects.gains(), axis1=1, axis2=2)
        best = always.pop(0) if always else int(np.argmax(each.min(axis=1)))
        prospects, distance = prospects.measured(best), each[best]
        visits[best] += 1
    return visits, float(distance.min())


def smallest_design(meets: Callable[[int], bool], sizes: Sequence[int]) -> int | None:
    """Find the smallest whole number that meets a monotone condition, bracketed by `sizes` first."""
    above = next((n for n in sizes if meets(n)), None)
    if above is None:
        return None
    below = max((n for n in sizes if n < above), default=0)
    while above - below > 1:
        middle = (above + below) // 2
        above, below = (middle, below) if meets(middle) else (above, middle)
    return above
