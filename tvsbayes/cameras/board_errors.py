"""Errors that corners share: those of one picture, and those of an imperfect board, displaced equally in all views.

Printed and glued boards are no perfect grids, by micrometres. All pictures agree, so the residuals of single views do
not show it, but the mean residual of each corner over all views does. The estimate stays that of least squares with a
perfect grid. Its covariance gets the effect of independent displacements of the corners, of the size found in the
residuals. mm, px; z are the whitened coordinates of `bundle_adjustment`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag, null_space

from tvsbayes.cameras.boards import Board
from tvsbayes.cameras.bundle_adjustment import Adjustment, projected
from tvsbayes.instrument.stereo_pair import Stereo

PRIOR_SHARE = 2e-3
"""Scale of the half-normal prior of a corner's displacement, one coordinate, over the pitch; 0.05 mm for 25 mm."""
CORNERS_MAX = 200
"""Largest number of corners, spread evenly over the board, used to estimate the size of all displacements."""
SIZES = np.linspace(0, 5, 501)
"""Grid of displacements, in scales of the prior."""


@dataclass(frozen=True)
class BoardErrors:
    """Deviations of the corners of the board from a grid, and their effect.

    Attributes:
        sd_mm: sd of one coordinate of one corner: root of the posterior mean of its square.
        covariance: (24, 24), its effect on the cameras' parameters.
        correlation_factor: for further common errors of a view, see `correlation_factor`.
    """

    sd_mm: float
    covariance: np.ndarray
    correlation_factor: float


def board_errors(adjustment: Adjustment, poses: np.ndarray, board: Board, stereo: Stereo) -> BoardErrors:
    """Estimate the displacements of the board's corners from residuals, and their effect on the covariance.

    Args:
        adjustment: the adjustment of some views.
        poses: of the board in these views, to left camera, (views, 6).
        board: the board.
        stereo: the adjusted pair.
    """
    visible = np.isfinite(adjustment.residuals_px)
    residuals = np.where(visible, adjustment.residuals_px, 0.0)
    slopes = projected(board.points_mm, poses, stereo).by_corner * visible[..., None]
    # Orthonormal columns: each is a change of z with a sum of squares of 1 px^2.
    free = adjustment.root.shape[1]
    flat = np.linalg.qr(adjustment.jacobian.reshape(-1, free))
    basis = np.reshape(flat.Q, adjustment.jacobian.shape)
    projections = np.einsum("kqcp,kqca->kpca", basis, slopes, optimize=True).reshape(len(poses), free, -1)
    total = projections.sum(axis=0)
    variance = _variance(residuals, slopes, total, board, adjustment)
    by_parameter = adjustment.root @ np.linalg.solve(flat.R, total)
    scores = projections - np.einsum("kqcp,kqcr->kpr", basis, basis, optimize=True) @ total
    factor = correlation_factor(
        basis.reshape(len(poses), -1, free),
        residuals.reshape(len(poses), -1),
        adjustment.noise_sd_px,
        explained=variance * float(np.sum(scores**2)),
    )
    return BoardErrors(float(np.sqrt(variance)), variance * by_parameter @ by_parameter.T, factor)


def correlation_factor(basis: np.ndarray, residuals: np.ndarray, noise_sd: float, explained: float = 0.0) -> float:
    """Ratio of the scores of whole views to those expected for independent corners; at least 1.

    Corner errors of one picture have common causes (light, defocus, a lens that deviates from the model, a bent board):
    they are not independent, and (J^T J)^-1 s^2 is then too small. The score of view i, J_i^T r_i, shows this. In
    coordinates where J^T J = 1, independent errors give the sum of |J_i^T r_i|^2 the expectation
    s^2 (p - sum_i tr (J_i^T J_i)^2), where the second term is due to the fit. The ratio scales the covariance: the
    cluster-robust variance of Liang and Zeger (1986) reduced to one number, since a dozen views cannot determine a
    24 x 24 matrix. Errors common to ALL views are not detected: see `board_errors`.

    Args:
        basis: (views, coordinates, p), J in such coordinates: orthonormal columns over all views; 0 where unseen.
        residuals: (views, coordinates), 0 where unseen.
        noise_sd: s, the standard deviation of one coordinate.
        explained: expectation of the scores' squares due to other known causes.
    """
    score = np.sum(np.einsum("knp,kn->kp", basis, residuals) ** 2)
    lost = np.sum(np.einsum("knp,knr->kpr", basis, basis, optimize=True) ** 2)
    expected = noise_sd**2 * (basis.shape[2] - lost)
    return max(1.0, float((score - explained) / expected)) if expected > 1e-3 * noise_sd**2 else 1.0


def _variance(residuals: np.ndarray, slopes: np.ndarray, total: np.ndarray, board: Board, fit: Adjustment) -> float:
    """Posterior mean of the variance of a corner's displacement, mm^2.

    Along each principal direction, the residuals' inner products with displacements have variance s^2 L + v L^2, L
    being the squared effect of a displacement of 1 mm, px^2. Displacements that move or scale the whole board are left
    out: they belong to poses and pitch.
    """
    chosen = np.unique(np.linspace(0, board.corners - 1, CORNERS_MAX).astype(int))
    slopes, fixed = slopes[:, :, chosen], total.reshape(len(total), -1, 3)[:, chosen].reshape(len(total), -1)
    blocks = np.einsum("kqca,kqcb->cab", slopes, slopes, optimize=True)
    # The projection on the cameras' parameters is subtracted.
    gram = block_diag(*blocks) - fixed.T @ fixed
    products = -np.einsum("kqca,kqc->ca", slopes, residuals[:, :, chosen], optimize=True).ravel()
    points = board.points_mm[chosen]
    motions = [*(np.tile(axis, (len(points), 1)) for axis in np.eye(3)), points]
    motions += [np.cross(axis, points) for axis in np.eye(3)]
    free = null_space(np.reshape(motions, (7, -1)))
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
