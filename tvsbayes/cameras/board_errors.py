"""The effect of an imperfect board on a calibration: corners displaced by micrometres, equally in all views.

Printed and glued boards have such errors. All pictures agree, so the residuals of single views do not show them, but
the mean residual of each corner over all views does. The estimate stays that of least squares with a perfect grid. Its
covariance gets the effect of independent displacements of the corners, of the size found in the residuals. mm, px; z
are the whitened coordinates of `bundle_adjustment`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from tvsbayes.cameras.boards import Board, View
from tvsbayes.cameras.bundle_adjustment import Adjustment, correlation_factor
from tvsbayes.cameras.stereo_start import pose_of
from tvsbayes.instrument.stereo_pair import Stereo, rotation_matrix

PRIOR_SHARE = 2e-3
"""Scale of the half-normal prior of a corner's displacement, one coordinate, over the pitch; 0.05 mm for 25 mm."""
CORNERS_MAX = 200
"""Largest number of corners, spread evenly over the board, used to estimate the size of all displacements."""
STEP_SHARE = 1e-3
"""Step of the differences over the pitch; projections are smooth over whole squares."""
SIZES = np.linspace(0, 5, 501)
"""Grid of displacements, in scales of the prior."""


@dataclass(frozen=True)
class BoardErrors:
    """Deviations of the corners of the board from a grid, and their effect.

    Attributes:
        sd_mm: sd of one coordinate of one corner: root of the posterior mean of its square.
        covariance: (24, 24), its effect on the cameras' parameters.
        correlation_factor: for further common errors of a view, see `bundle_adjustment.correlation_factor`.
    """

    sd_mm: float
    covariance: np.ndarray
    correlation_factor: float


def board_errors(adjustment: Adjustment, views: Sequence[View], board: Board, stereo: Stereo) -> BoardErrors:
    """Estimate the displacements of the board's corners from residuals, and their effect on the covariance.

    Args:
        adjustment: the adjustment of `views`.
        views: the views, in its order.
        board: the board in the views.
        stereo: the adjusted pair.
    """
    visible = np.isfinite(adjustment.residuals_px)
    residuals = np.where(visible, adjustment.residuals_px, 0.0)
    slopes = np.stack([_corner_slopes(view, board, stereo) for view in views]) * visible[..., None]
    # Orthonormal columns: each is a change of z with a sum of squares of 1 px^2.
    free = adjustment.root.shape[1]
    flat = np.linalg.qr(adjustment.jacobian.reshape(-1, free))
    basis = np.reshape(flat.Q, adjustment.jacobian.shape)
    projections = np.einsum("kqcp,kqca->kpca", basis, slopes, optimize=True)
    total = projections.sum(axis=0).reshape(free, -1)
    variance = _variance(residuals, slopes, total, board, adjustment)
    by_z = np.linalg.solve(flat.R, total)
    by_parameter = adjustment.root @ by_z
    share = np.einsum("kqcp,kqcr->kpr", basis, basis, optimize=True)
    scores = projections.reshape(len(views), free, -1) - share @ total
    seen = visible.ravel()
    factor = correlation_factor(
        adjustment.jacobian.reshape(-1, free)[seen],
        residuals.ravel()[seen],
        np.repeat(np.arange(len(visible)), visible[0].size)[seen],
        adjustment.noise_sd_px,
        explained=variance * float(np.sum(scores**2)),
    )
    return BoardErrors(float(np.sqrt(variance)), variance * by_parameter @ by_parameter.T, factor)


def _corner_slopes(view: View, board: Board, stereo: Stereo) -> np.ndarray:
    """Derivative (4, corners, 3) of a view's pixels by the positions of the corners on the board, px/mm."""
    pose = pose_of(view, board, stereo)
    r_left, t_left = rotation_matrix(pose[:3]), pose[3:]
    step = STEP_SHARE * board.pitch_mm
    slopes = np.zeros((4, board.corners, 3))
    for side, (matrix, distortion) in enumerate(((stereo.M1, stereo.D1), (stereo.M2, stereo.D2))):
        r, t = (stereo.R @ r_left, stereo.R @ t_left + stereo.T) if side else (r_left, t_left)
        for axis in range(3):
            pixels = (
                cv2.projectPoints(board.points_mm + sign * step * np.eye(3)[axis], r, t, matrix, distortion)[0]
                for sign in (1, -1)
            )
            slopes[2 * side : 2 * side + 2, :, axis] = np.reshape(next(pixels) - next(pixels), (-1, 2)).T / (2 * step)
    return slopes


def _variance(residuals: np.ndarray, slopes: np.ndarray, total: np.ndarray, board: Board, fit: Adjustment) -> float:
    """Posterior mean of the variance of a corner's displacement, mm^2.

    Along each principal direction, the residuals' inner products with displacements have variance s^2 L + v L^2, L
    being the squared effect of a displacement of 1 mm, px^2. Displacements that move or scale the whole board are left
    out: they belong to poses and pitch.
    """
    chosen = np.unique(np.linspace(0, board.corners - 1, CORNERS_MAX).astype(int))
    count = 3 * len(chosen)
    chosen_slopes, fixed = slopes[:, :, chosen], total.reshape(len(total), -1, 3)[:, chosen].reshape(-1, count)
    blocks = np.einsum("kqca,kqcb->cab", chosen_slopes, chosen_slopes, optimize=True)
    gram = np.zeros((len(chosen), 3, len(chosen), 3))
    gram[np.arange(len(chosen)), :, np.arange(len(chosen)), :] = blocks
    # The projection on the cameras' parameters is subtracted.
    gram = gram.reshape(count, count) - fixed.T @ fixed
    products = -np.einsum("kqca,kqc->ca", chosen_slopes, residuals[:, :, chosen], optimize=True).ravel()
    points = board.points_mm[chosen]
    motions = [np.tile(axis, (len(chosen), 1)) for axis in np.eye(3)]
    motions += [np.cross(axis, points) for axis in np.eye(3)] + [points]
    free = np.linalg.svd(np.stack([motion.ravel() for motion in motions]))[2][7:].T
    gains, directions = np.linalg.eigh(free.T @ gram @ free)
    visible = gains > 1e-6 * gains[-1]
    gains, energy = gains[visible], ((products @ free) @ directions[:, visible]) ** 2 / gains[visible]
    scale = PRIOR_SHARE * board.pitch_mm
    sizes = (scale * SIZES) ** 2
    # The residuals' variance contains both; at least a tenth of it is noise.
    noise = np.maximum(fit.noise_sd_px**2 - sizes * gains.sum() / fit.dof, 0.1 * fit.noise_sd_px**2)
    expected = noise[:, None] + sizes[:, None] * gains
    logs = -np.sum(np.log(expected) + energy / expected, axis=1) / 2 - SIZES**2 / 2
    weights = np.exp(logs - logs.max())
    return float(weights @ sizes / weights.sum())
