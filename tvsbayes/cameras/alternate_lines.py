"""Tests whether the even and the odd rows (columns) of a spot have the same centre.

Interlaced and two-tap readouts take alternate lines at another moment or with another gain. A constant gain moves no
centre: it changes only the height of each half. A beam that moved in between, or a gain that changes along the spot,
moves a centre; on a Gaussian both look the same. For white pixel noise the difference of the halves' centres has four
times the covariance C of the whole's (each half has 2 C). Where a difference d is significant, all positions between
both are equally probable: d d'/12 is added to C (JCGM 100:2008, 4.3.7: limits d apart, uniform).

Demosaicing mixes lines: colour pictures show about a quarter of d, and less noise, so that a larger d is needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tvsbayes.cameras.spot_window import Patch, block_means

LINES = ("rows", "columns")
SIGNIFICANCE = 1e-5
"""Significance level for one spot, or for all spots of a camera together. A campaign of 1000 looks makes 4000 such
tests."""
EXCESS_MIN = 4.0
"""Least mean of chi-square per coordinate over a camera's spots: stated noise may be wrong by some tens of per cent."""
_HIGH_PASS = np.array([-0.25, 0.5, -0.25], np.float32)
"""Gain 1 for values that alternate from line to line, 0 for values that are linear over three lines."""
_IDENTITY = np.ones(1, np.float32)


@dataclass(frozen=True)
class AlternateLines:
    """A difference between even and odd lines in the centres of a camera's spots.

    Attributes:
        lines: "rows" or "columns".
        spots: number of spots with an increased covariance.
        apart_px: median distance of the two centres over these spots.
    """

    lines: str
    spots: int
    apart_px: float


@dataclass(frozen=True)
class Widening:
    """Terms added to the covariances of a camera's centres (n, 2, 2), px^2, and the disagreeing lines."""

    added_px2: np.ndarray
    lines: tuple[AlternateLines, ...]


def shift_of_lines(patch: Patch, jacobian: np.ndarray, weights: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Centre of the odd minus that of the even rows, then of columns: (2, 2) of u and v, px.

    The centres of both halves have the weights of the whole, to first order: the alternating part of the picture is the
    right-hand side of the fit's own normal equations.

    Args:
        patch: the pixels; lines are counted from the picture's border.
        jacobian: derivatives (9, n) of the fit, over the patch's cells; rows 1 and 2 belong to the centre.
        weights: weights of the cells (n,), 0 for unusable cells.
        residual: grey minus fitted (n,), DN.
    """
    weighted = jacobian * weights
    alternating = np.empty((2, residual.size))
    for axis in (0, 1):
        numbers = np.arange(patch.raw.shape[axis]) + patch.corner[1 - axis]
        # Odd minus even light is twice the part that alternates about the mean of both.
        sign = np.where(numbers % 2, np.float32(2), np.float32(-2))
        signs = sign[:, None] if axis == 0 else sign
        if patch.block == 1:
            alternating[axis] = (residual.reshape(patch.raw.shape) * signs).ravel()
        else:
            alternating[axis] = block_means(_high_pass(patch.raw, axis) * signs, patch.block).ravel()
    return np.linalg.solve(weighted @ jacobian.T, weighted @ alternating.T)[1:3].T


def widening(shifts_px: Sequence[np.ndarray], covariances_px2: Sequence[np.ndarray]) -> Widening:
    """Additional covariance of the centres of one camera from the differences of alternate lines.

    A significant difference increases the covariance of its spot. Where the other differences are significant together,
    and `EXCESS_MIN` times as large in mean square as stated, the covariances of all spots increase.

    Args:
        shifts_px: (2, 2) of each spot, as returned by `shift_of_lines`.
        covariances_px2: (2, 2) of each spot's centre.
    """
    from scipy.special import chdtri

    added, disagreeing = np.zeros((len(shifts_px), 2, 2)), []
    if not len(shifts_px):
        return Widening(added, ())
    shifts = np.array(shifts_px)
    inverse = np.linalg.inv(4 * np.array(covariances_px2))
    chi2 = np.einsum("nki,nij,nkj->nk", shifts, inverse, shifts)
    for number, lines in enumerate(LINES):
        significant = chi2[:, number] > chdtri(2, SIGNIFICANCE)
        rest = chi2[~significant, number]
        if rest.size and rest.sum() > max(chdtri(2 * rest.size, SIGNIFICANCE), 2 * EXCESS_MIN * rest.size):
            significant[:] = True
        if significant.any():
            gaps = shifts[significant, number]
            added[significant] += np.einsum("ni,nj->nij", gaps, gaps) / 12
            disagreeing.append(AlternateLines(lines, int(significant.sum()), float(np.median(np.hypot(*gaps.T)))))
    return Widening(added, tuple(disagreeing))


def _high_pass(raw: np.ndarray, axis: int) -> np.ndarray:
    """Difference from the mean of the lines before and after."""
    import cv2

    kernels = (_IDENTITY, _HIGH_PASS) if axis == 0 else (_HIGH_PASS, _IDENTITY)
    return cv2.sepFilter2D(raw, cv2.CV_32F, *kernels)
