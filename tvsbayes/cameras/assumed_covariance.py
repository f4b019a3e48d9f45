"""The covariance of a stereo calibration whose file states none: from its RMS, views and board, else from usual ones.

A calibration's covariance is sigma^2 times the inverse of the information of its views. The cameras are those of the
file; the boards stand as people place them (`data/reference/board_poses.csv`, measured on public sets). The information
of a view is the average over the poses of a set, poses being nuisances (Schur complement). Frames of
`bundle_adjustment`: board to left camera in OpenCV's axes, x_right = R x_left + T; mm, rad, px; the parameters in the
order of `STEREO_PARAMETER_NAMES`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np

from tvsbayes.cameras.boards import Board
from tvsbayes.errors import InputError, refusal
from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.stereo_pair import Stereo, rotation_matrix, rotation_vector

CORRELATED = 1.1
"""Factor on every sd that independent corners give."""
GUESS_FACTOR = 2.0
"""How well all sds together are known, as a factor: errors of simulated calibrations are 0.5 to 1.3 of what is made up
from RMS, views and board, halves of two public sets differ by 1.0 to 1.7 of it, focal lengths to T
(experiments/cameras/assumed_covariance.md)."""
USUAL_RMS_PX, USUAL_VIEWS, USUAL_BOARD = 0.3, 12, (9, 6)
"""Where nothing is stated. The public sets have 0.09 and 0.20 px of 11 and 13 views; corners that scatter by 0.05 to
0.3 px give 0.07 to 0.42 px. Errors are then 0.2 to 0.9 of what is made up, halves 0.3 to 0.9."""
USUAL_PITCH_MM, USUAL_PITCH_SHARE = 25.0, 1e-3
"""Side of a square, and its relative standard uncertainty: bumblebee2's baseline differs from its other calibration by
0.13 %."""
POSES_FILE = "board_poses.csv"
PLACED_MIN = 8
"""Poses that both cameras must see: fewer leave parameters open."""
NEARER_OR_FARTHER = tuple(sorted(1.15 ** np.arange(-10, 60), key=lambda factor: abs(math.log(factor))))
"""Factors on the distance of a board that both cameras do not see whole."""
TOWARDS_MIDDLE = (1.0, 0.75, 0.5, 0.25, 0.0)
"""Factors on its distance from the middle of the pictures, where no distance helps."""
SINGULAR = 1e-11
"""Smallest eigenvalue of the scaled information, over the largest, with which an inverse still has digits."""
GROUPS: dict[str, list[int]] = {
    "focal length": [0, 1, 9, 10],
    "principal point": [2, 3, 11, 12],
    "distortion": [4, 5, 6, 7, 8, 13, 14, 15, 16, 17],
    "rotation": [18, 19, 20],
    "translation": [21, 22, 23],
}
"""The 24 parameters by kind."""


@dataclass(frozen=True)
class Known:
    """What is known of how a calibration was made, and of its uncertainty; None where it is not.

    Attributes:
        rms_px: over corners of both cameras, as OpenCV defines it.
        views: of the board, by both cameras.
        board: inner corners, columns and rows.
        pitch_mm: side of a square.
        pitch_u_mm: its standard uncertainty.
        fixed_intrinsics: whether each camera was calibrated by itself, then R and T for these (OpenCV's
            CALIB_FIX_INTRINSIC, as ROS does); else all in one adjustment.
        u_focal_percent: standard uncertainty of each of fx and fy, over it.
        u_principal_px: of each of cx and cy.
        u_rotation_mrad: of each component of R.
        u_baseline_mm: of each component of T.
    """

    rms_px: float | None = None
    views: int | None = None
    board: tuple[int, int] | None = None
    pitch_mm: float | None = None
    pitch_u_mm: float | None = None
    fixed_intrinsics: bool | None = None
    u_focal_percent: float | None = None
    u_principal_px: float | None = None
    u_rotation_mrad: float | None = None
    u_baseline_mm: float | None = None


_SOURCES = ("stated", "of the file", "usual")
_ADJUSTED = {False: "all in one adjustment", True: "each camera by itself", None: "in one adjustment or one by one"}


def with_assumed_covariance(stereo: Stereo, stated: Known, of_file: Known) -> Stereo:
    """The pair with the covariance that such a calibration has, `assumed`, and with the words that say from what.

    Args:
        stereo: any covariance of it is ignored.
        stated: by the user.
        of_file: what the file says, used where nothing is stated; what it does not say either is as usual.

    Raises:
        InputError: values that no board or calibration has, or cameras that see no board together.
    """
    words = []

    def of[T](text: str, *values: T | None) -> T:
        value, source = next((v, said) for v, said in zip(values, _SOURCES, strict=True) if v is not None)
        words.append(f"{text.format(value)} ({source})")
        return value

    rms_px = of("RMS {:.3g} px", stated.rms_px, of_file.rms_px, USUAL_RMS_PX)
    views = of("{} views", stated.views, of_file.views, USUAL_VIEWS)
    columns, rows = of("a board of {0[0]}x{0[1]} corners", stated.board, of_file.board, USUAL_BOARD)
    pitch_mm = of("squares of {:g} mm", stated.pitch_mm, None, USUAL_PITCH_MM)
    # A stated pitch is exact unless its uncertainty is stated too, as for pictures.
    usual_u_mm = 0.0 if stated.pitch_mm is not None else USUAL_PITCH_SHARE * pitch_mm
    board = Board(columns, rows, pitch_mm, usual_u_mm if stated.pitch_u_mm is None else stated.pitch_u_mm)
    fixed = of_file.fixed_intrinsics if stated.fixed_intrinsics is None else stated.fixed_intrinsics
    words.append(_ADJUSTED[fixed])
    covariance = calibration_covariance(stereo, board, views, rms_px, fixed)
    for name, group, sds in _stated_sds(stereo, stated):
        covariance = with_marginal(covariance, group, sds)
        words.append(f"u of {name} (stated)")
    origin = ", ".join(words)
    return replace(stereo, parameter_covariance=covariance, rms_px=rms_px, assumed=True, assumed_from=origin)


def calibration_covariance(
    stereo: Stereo, board: Board, views: int, rms_px: float, fixed_intrinsics: bool | None = None
) -> np.ndarray:
    """Covariance (24, 24) of a calibration of these cameras from boards as people place them.

    Args:
        stereo: the cameras; their covariance is not used.
        board: with the standard uncertainty of its pitch, which scales T.
        views: seen by both cameras.
        rms_px: over corners, as OpenCV defines it: sqrt(2) sigma sqrt(degrees of freedom / coordinates).
        fixed_intrinsics: see `Known`; None: either, at even odds.

    Raises:
        InputError: too few corners for so many unknowns, or boards that the cameras do not see together.
    """
    coordinates = 4 * board.corners * views
    dof = coordinates - 24 - 6 * views
    if views < 1 or dof < 1:
        found = f"{views} view{'s' * (views != 1)} of {board.corners} corners"
        remedy = "give --views and --board as they were"
        raise InputError("usage", f"{found} calibrate no pair of cameras", found=found, remedy=remedy)
    sigma_px = rms_px * math.sqrt(coordinates / (2 * dof))
    covariance = (CORRELATED * sigma_px) ** 2 / views * _of_one_view(stereo, board, fixed_intrinsics)
    scale = stereo.T * (board.pitch_u_mm / board.pitch_mm)
    covariance[21:, 21:] += np.outer(scale, scale)
    return (covariance + covariance.T) / 2


def with_marginal(covariance: np.ndarray, group: list[int], sds: np.ndarray) -> np.ndarray:
    """The covariance in which the parameters of a group have these sds.

    Their correlations stay, and so does the conditional distribution of all others given them (Jeffrey 1965).
    """
    others = np.setdiff1d(np.arange(len(covariance)), group)
    block = covariance[np.ix_(group, group)]
    factor = sds / np.sqrt(np.diag(block))
    new = block * np.outer(factor, factor)
    gain = np.linalg.solve(block, covariance[np.ix_(group, others)]).T
    made = covariance.copy()
    made[np.ix_(group, group)] = new
    made[np.ix_(others, group)] = gain @ new
    made[np.ix_(group, others)] = new @ gain.T
    made[np.ix_(others, others)] += gain @ (new - block) @ gain.T
    return (made + made.T) / 2


def _stated_sds(stereo: Stereo, stated: Known) -> list[tuple[str, list[int], np.ndarray]]:
    """Name, parameters and sds of every group whose uncertainty is stated."""
    focal = np.abs(stereo.vector[GROUPS["focal length"]])
    sds = []
    for name, value, unit in (
        ("focal length", stated.u_focal_percent, focal / 100),
        ("principal point", stated.u_principal_px, np.ones(4)),
        ("rotation", stated.u_rotation_mrad, np.full(3, 1e-3)),
        ("translation", stated.u_baseline_mm, np.ones(3)),
    ):
        if value is not None:
            sds.append((name, GROUPS[name], value * unit))
    return sds


def _of_one_view(stereo: Stereo, board: Board, fixed_intrinsics: bool | None) -> np.ndarray:
    """Covariance (24, 24) of one view, corners of 1 px.

    The mean over the sets of the table and over the ways in which people may have adjusted: the covariance of a mixture
    whose members have one mean.
    """
    made = []
    for poses in placed_boards(stereo, board).values():
        views = [view_information(stereo, board, pose) for pose in poses]
        if len(views) >= PLACED_MIN:
            together, alone = (np.mean(parts, axis=0) for parts in zip(*views, strict=True))
            if fixed_intrinsics is not True:
                made.append(_inverse(together))
            if fixed_intrinsics is not False:
                made.append(_in_two_steps(together, alone))
    if made:
        return np.mean(made, axis=0)
    raise _unseen()


def _in_two_steps(together: np.ndarray, alone: np.ndarray) -> np.ndarray:
    """Covariance where each camera was calibrated by itself, then R and T for these (OpenCV's CALIB_FIX_INTRINSIC)."""
    inner = _inverse(alone)
    outer = np.linalg.inv(together[18:, 18:])
    gain = -outer @ together[18:, :18]
    across = inner @ gain.T
    return np.block([[inner, across], [across.T, outer + gain @ across]])


def _inverse(information: np.ndarray) -> np.ndarray:
    """Its inverse, scaled first: px, rad and mm differ by ten powers of ten."""
    scale = np.sqrt(np.diag(information))
    with np.errstate(divide="ignore", invalid="ignore"):
        scaled = information / np.outer(scale, scale)
    if not np.isfinite(scaled).all() or np.linalg.eigvalsh(scaled)[0] < SINGULAR:
        raise _unseen()
    return np.linalg.inv(scaled) / np.outer(scale, scale)


def _unseen() -> InputError:
    return refusal(
        "no-common-view",
        file="the imported calibration",
        found="two cameras that do not see one board together",
        allowed="cameras whose pictures overlap",
        remedy="look at R, T and the image size: is R that of right to left, is the size that of other pictures?",
    )


class ViewInformation(NamedTuple):
    """Information of one view about the cameras, corners of 1 px, its board's pose eliminated, 1/px^2.

    Attributes:
        together: of the pair, (24, 24).
        alone: of each camera from its own picture, its own pose of the board eliminated, (18, 18) in two blocks.
    """

    together: np.ndarray
    alone: np.ndarray


def view_information(stereo: Stereo, board: Board, pose: np.ndarray) -> ViewInformation:
    """What one view of a board tells.

    Args:
        stereo: the cameras.
        board: the board.
        pose: board to left camera, (6,): Rodrigues vector, mm.
    """
    turn, shift = np.asarray(pose[:3], float), np.asarray(pose[3:], float)
    relative, extrinsic = rotation_vector(stereo.R), np.asarray(stereo.T, float).ravel()
    left = cv2.projectPoints(board.points_mm, turn, shift, stereo.M1, stereo.D1)[1]
    # The right camera sees the composed pose; composeRT gives its slopes by both.
    r, t, r_r1, r_t1, r_r2, r_t2, t_r1, t_t1, t_r2, t_t2 = cv2.composeRT(turn, shift, relative, extrinsic)
    right = cv2.projectPoints(board.points_mm, r, t, stereo.M2, stereo.D2)[1]

    def by(slopes: tuple[tuple[np.ndarray, np.ndarray], ...]) -> np.ndarray:
        return np.hstack([right[:, :3] @ a + right[:, 3:6] @ b for a, b in slopes])

    nothing = np.zeros((len(left), 9))
    cameras = np.block(
        [
            [left[:, 6:15], nothing, np.zeros((len(left), 6))],
            [nothing, right[:, 6:15], by(((r_r2, t_r2), (r_t2, t_t2)))],
        ]
    )
    poses = np.vstack([left[:, :6], by(((r_r1, t_r1), (r_t1, t_t1)))])
    alone = np.zeros((18, 18))
    for side, slopes in enumerate((left, right)):
        alone[9 * side : 9 * side + 9, 9 * side : 9 * side + 9] = _reduced(slopes[:, 6:15], slopes[:, :6])
    return ViewInformation(_reduced(cameras, poses), alone)


def _reduced(wanted: np.ndarray, nuisance: np.ndarray) -> np.ndarray:
    """Schur complement of the normal matrix: what is left of some columns once others have followed."""
    q, _ = np.linalg.qr(nuisance)
    kept = wanted - q @ (q.T @ wanted)
    return kept.T @ kept


def placed_boards(stereo: Stereo, board: Board) -> dict[str, list[np.ndarray]]:
    """Poses (6,) of boards before these cameras, as the people of each set placed theirs; those seen whole by both.

    A board keeps its turn, its place in the picture and its share of it, all as a camera halfway between both sees
    them; where a camera does not see it whole it moves away, nearer, or towards the middle.
    """
    path = shipped_data() / "reference" / POSES_FILE
    names = np.loadtxt(path, delimiter=",", skiprows=1, usecols=0, dtype=str)
    table = np.loadtxt(path, delimiter=",", skiprows=1, usecols=range(2, 8))
    half = rotation_matrix(rotation_vector(stereo.R) / 2)
    centre = -stereo.R.T @ stereo.T / 2
    size = np.array([stereo.image_width, stereo.image_height], float)
    focal = float(np.mean([m[k, k] for m in (stereo.M1, stereo.M2) for k in (0, 1)]))
    # From the optical axis to the middle of the pictures, px.
    middle = (size - 1) / 2 - (stereo.M1[:2, 2] + stereo.M2[:2, 2]) / 2
    diagonal = np.hypot(board.columns - 1, board.rows - 1) * board.pitch_mm
    poses: dict[str, list[np.ndarray]] = {name: [] for name in names.tolist()}
    for name, row in zip(names.tolist(), table, strict=True):
        turn = rotation_vector(half.T @ rotation_matrix(row[3:]))
        depth = focal * diagonal / (row[2] * np.hypot(*size))
        for pull in TOWARDS_MIDDLE:
            along = np.append((pull * row[:2] * size + (1 - pull) * middle) / focal, 1.0)
            shifts = (half.T @ (factor * depth * along) + centre for factor in NEARER_OR_FARTHER)
            visible = next((shift for shift in shifts if _sees_whole(stereo, board, turn, shift)), None)
            if visible is not None:
                poses[name].append(np.concatenate([turn, visible]))
                break
    return poses


def _sees_whole(stereo: Stereo, board: Board, turn: np.ndarray, shift: np.ndarray) -> bool:
    """Whether both cameras see every corner of a board."""
    left = board.points_mm @ rotation_matrix(turn).T + shift
    for points, matrix, distortion in (
        (left, stereo.M1, stereo.D1),
        (left @ stereo.R.T + stereo.T, stereo.M2, stereo.D2),
    ):
        if not (points[:, 2] > 0).all():
            return False
        pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, distortion)[0].reshape(-1, 2)
        if not ((pixels > -0.5) & (pixels < [stereo.image_width - 0.5, stereo.image_height - 0.5])).all():
            return False
    return True
