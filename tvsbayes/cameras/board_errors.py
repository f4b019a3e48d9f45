"""What a board that is no perfect grid does to a calibration: corners off by micrometres, in all pictures alike.

Printed and glued boards are; every picture shows it, so no picture contradicts the others, and the residuals of views
alone do not tell. The mean residual of each corner over all views does. The estimate stays what least squares over a
perfect grid give; its covariance gets what independent displacements of the corners, of the size that the residuals
show, make of it. mm, px; z are the whitened coordinates of `bundle_adjustment`.
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
"""Of the pitch: scale of the half-normal prior of a corner's displacement, one coordinate; 0.05 mm for 25 mm."""
CORNERS_MAX = 200
"""So many corners, spread evenly over the board, tell the size of all displacements."""
STEP_SHARE = 1e-3
"""Of the pitch: step of the differences; projections are smooth over whole squares."""
SIZES = np.linspace(0, 5, 501)
"""Displacements that are tried, in scales of the prior."""


@dataclass(frozen=True)
class BoardErrors:
    """How far the corners of the board are off a grid, and what that does.

    Attributes:
        sd_mm: of one coordinate of one corner: posterior mean of its square, root.
        covariance: (24, 24) of the cameras' parameters from it.
        correlation_factor: what views by themselves share beyond it, see `bundle_adjustment.correlation_factor`.
    """

    sd_mm: float
    covariance: np.ndarray
    correlation_factor: float


def board_errors(done: Adjustment, views: Sequence[View], board: Board, stereo: Stereo) -> BoardErrors:
    """The displacements of the board's corners that residuals show, and their part in the covariance.

    Args:
        done: the adjustment of `views`.
        views: in its order.
        board: whose corners they hold.
        stereo: the pair that it found.
    """
    visible = np.isfinite(done.residuals_px)
    residuals = np.where(visible, done.residuals_px, 0.0)
    by_corner = np.stack([_by_corner(view, board, stereo) for view in views]) * visible[..., None]
    # Orthonormal columns: a change of z that costs a squared pixel each.
    free = done.root.shape[1]
    flat = np.linalg.qr(done.jacobian.reshape(-1, free))
    basis = np.reshape(flat.Q, done.jacobian.shape)
    taken = np.einsum("kqcp,kqca->kpca", basis, by_corner, optimize=True)
    everywhere = taken.sum(axis=0).reshape(free, -1)
    variance = _variance(residuals, by_corner, everywhere, board, done)
    by_z = np.linalg.solve(flat.R, everywhere)
    by_parameter = done.root @ by_z
    share = np.einsum("kqcp,kqcr->kpr", basis, basis, optimize=True)
    scores = taken.reshape(len(views), free, -1) - share @ everywhere
    kept = visible.ravel()
    factor = correlation_factor(
        done.jacobian.reshape(-1, free)[kept],
        residuals.ravel()[kept],
        np.repeat(np.arange(len(visible)), visible[0].size)[kept],
        done.noise_sd_px,
        explained=variance * float(np.sum(scores**2)),
    )
    return BoardErrors(float(np.sqrt(variance)), variance * by_parameter @ by_parameter.T, factor)


def _by_corner(view: View, board: Board, stereo: Stereo) -> np.ndarray:
    """Derivative (4, corners, 3) of a view's pixels by the places of the corners on the board, px/mm."""
    pose = pose_of(view, board, stereo)
    turn, shift = rotation_matrix(pose[:3]), pose[3:]
    step = STEP_SHARE * board.pitch_mm
    slopes = np.zeros((4, board.corners, 3))
    for side, (matrix, distortion) in enumerate(((stereo.M1, stereo.D1), (stereo.M2, stereo.D2))):
        rotation, move = (stereo.R @ turn, stereo.R @ shift + stereo.T) if side else (turn, shift)
        for axis in range(3):
            ends = (
                cv2.projectPoints(board.points_mm + sign * step * np.eye(3)[axis], rotation, move, matrix, distortion)[
                    0
                ]
                for sign in (1, -1)
            )
            slopes[2 * side : 2 * side + 2, :, axis] = np.reshape(next(ends) - next(ends), (-1, 2)).T / (2 * step)
    return slopes


def _variance(
    residuals: np.ndarray, by_corner: np.ndarray, everywhere: np.ndarray, board: Board, done: Adjustment
) -> float:
    """Posterior mean of the variance of a corner's displacement, mm^2.

    The residuals' inner products with displacements have variance s^2 L + v L^2 along each principal direction, L the
    square of what a displacement of 1 mm moves in px. Displacements that are a motion or another scale of the whole
    board are poses and pitch.
    """
    chosen = np.unique(np.linspace(0, board.corners - 1, CORNERS_MAX).astype(int))
    count = 3 * len(chosen)
    some, fixed = by_corner[:, :, chosen], everywhere.reshape(len(everywhere), -1, 3)[:, chosen].reshape(-1, count)
    blocks = np.einsum("kqca,kqcb->cab", some, some, optimize=True)
    gram = np.zeros((len(chosen), 3, len(chosen), 3))
    gram[np.arange(len(chosen)), :, np.arange(len(chosen)), :] = blocks
    # Without what the cameras' parameters take up.
    gram = gram.reshape(count, count) - fixed.T @ fixed
    products = -np.einsum("kqca,kqc->ca", some, residuals[:, :, chosen], optimize=True).ravel()
    points = board.points_mm[chosen]
    wholes = [np.tile(axis, (len(chosen), 1)) for axis in np.eye(3)]
    wholes += [np.cross(axis, points) for axis in np.eye(3)] + [points]
    free = np.linalg.svd(np.stack([whole.ravel() for whole in wholes]))[2][7:].T
    light, directions = np.linalg.eigh(free.T @ gram @ free)
    kept = light > 1e-6 * light[-1]
    light, along = light[kept], ((products @ free) @ directions[:, kept]) ** 2 / light[kept]
    scale = PRIOR_SHARE * board.pitch_mm
    sizes = (scale * SIZES) ** 2
    # The residuals' variance holds both; a tenth of it is noise at least.
    noise = np.maximum(done.noise_sd_px**2 - sizes * light.sum() / done.dof, 0.1 * done.noise_sd_px**2)
    expected = noise[:, None] + sizes[:, None] * light
    logs = -np.sum(np.log(expected) + along / expected, axis=1) / 2 - SIZES**2 / 2
    weights = np.exp(logs - logs.max())
    return float(weights @ sizes / weights.sum())
