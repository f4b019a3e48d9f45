"""The covariance of a stereo calibration whose file states none: from its RMS, views and board, else usual values.

A calibration's covariance is sigma^2 times the inverse of the information of its views. The cameras are those of the
file; board poses are typical ones (`data/reference/board_poses.csv`, measured on public sets). The information of a
view is the average over the poses of a set, with the poses eliminated (Schur complement). Frames of
`bundle_adjustment`: board to left camera in OpenCV's axes, x_right = R x_left + T; mm, rad, px; the parameters in the
order of `STEREO_PARAMETER_NAMES`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tvsbayes.cameras.boards import Board
from tvsbayes.cameras.bundle_adjustment import projected
from tvsbayes.errors import InputError, plural, refusal
from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.stereo_pair import Stereo, rotation_matrix, rotation_vector

CORRELATION_FACTOR = 1.1
"""Factor on the sds that hold for independent corners."""
GUESS_FACTOR = 2.0
"""Uncertainty of all sds together, as a factor. Errors of simulated calibrations are 0.5 to 1.3 times the sds assumed
from RMS, views and board; halves of two public sets differ by 1.0 to 1.7 times these, focal lengths to T
(experiments/cameras/assumed_covariance.md)."""
USUAL_RMS_PX, USUAL_VIEWS, USUAL_BOARD = 0.3, 12, (9, 6)
"""Defaults. The public sets have 0.09 and 0.20 px of 11 and 13 views; corners that scatter by 0.05 to 0.3 px give 0.07
to 0.42 px. Errors are then 0.2 to 0.9 times the assumed sds, differences of halves 0.3 to 0.9."""
USUAL_PITCH_MM, USUAL_PITCH_SHARE = 25.0, 1e-3
"""Side of a square, and its relative standard uncertainty: bumblebee2's baseline differs from its other calibration by
0.13 %."""
POSES_FILE = "board_poses.csv"
POSES_MIN = 8
"""Least number of poses that both cameras see: fewer do not determine all parameters."""
DISTANCE_FACTORS = tuple(sorted(1.15 ** np.arange(-10, 60), key=lambda factor: abs(math.log(factor))))
"""Factors on the distance of a board that is partly outside a picture."""
CENTRING_FACTORS = (1.0, 0.75, 0.5, 0.25, 0.0)
"""Factors on its offset from the middle of the pictures, where no distance helps."""
SINGULAR = 1e-11
"""Least ratio of the smallest to the largest eigenvalue of scaled information that can be inverted accurately."""
GROUPS: dict[str, list[int]] = {
    "focal length": [0, 1, 9, 10],
    "principal point": [2, 3, 11, 12],
    "distortion": [4, 5, 6, 7, 8, 13, 14, 15, 16, 17],
    "rotation": [18, 19, 20],
    "translation": [21, 22, 23],
}
"""The 24 parameters by kind."""


@dataclass(frozen=True)
class Provenance:
    """How a calibration was made, and its uncertainties; None where unknown.

    Attributes:
        rms_px: rms over the corners of both cameras, as OpenCV defines it.
        views: views of the board by both cameras.
        board: inner corners, columns and rows.
        pitch_mm: side of a square.
        pitch_u_mm: its standard uncertainty.
        fixed_intrinsics: whether each camera was calibrated alone, then R and T with fixed cameras (OpenCV's
            CALIB_FIX_INTRINSIC, as ROS does); else all in one adjustment.
        u_focal_percent: relative standard uncertainty of each of fx and fy.
        u_principal_px: standard uncertainty of each of cx and cy.
        u_rotation_mrad: standard uncertainty of each component of R.
        u_baseline_mm: standard uncertainty of each component of T.
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


def with_assumed_covariance(stereo: Stereo, stated: Provenance, of_file: Provenance) -> Stereo:
    """The pair with an assumed covariance, and with a text that names its sources.

    Args:
        stereo: the pair; its own covariance is ignored.
        stated: provenance stated by the user.
        of_file: provenance in the file, used where the user states nothing; usual values where neither states one.

    Raises:
        InputError: impossible values, or cameras without a common view of any board.
    """
    words = []

    def pick[T](text: str, *values: T | None) -> T:
        value, origin = next((v, source) for v, source in zip(values, _SOURCES, strict=True) if v is not None)
        words.append(f"{text.format(value)} ({origin})")
        return value

    rms_px = pick("RMS {:.3g} px", stated.rms_px, of_file.rms_px, USUAL_RMS_PX)
    views = pick("{} views", stated.views, of_file.views, USUAL_VIEWS)
    columns, rows = pick("a board of {0[0]}x{0[1]} corners", stated.board, of_file.board, USUAL_BOARD)
    pitch_mm = pick("squares of {:g} mm", stated.pitch_mm, None, USUAL_PITCH_MM)
    # A stated pitch is exact unless its uncertainty is stated too, as for pictures.
    usual_u_mm = 0.0 if stated.pitch_mm is not None else USUAL_PITCH_SHARE * pitch_mm
    board = Board(columns, rows, pitch_mm, usual_u_mm if stated.pitch_u_mm is None else stated.pitch_u_mm)
    fixed = of_file.fixed_intrinsics if stated.fixed_intrinsics is None else stated.fixed_intrinsics
    words.append(_ADJUSTED[fixed])
    covariance = calibration_covariance(stereo, board, views, rms_px, fixed)
    for name, sds in _stated_sds(stereo, stated).items():
        covariance = with_marginal(covariance, GROUPS[name], sds)
        words.append(f"u of {name} (stated)")
    origin = ", ".join(words)
    return replace(stereo, parameter_covariance=covariance, rms_px=rms_px, assumed=True, assumed_from=origin)


def calibration_covariance(
    stereo: Stereo, board: Board, views: int, rms_px: float, fixed_intrinsics: bool | None = None
) -> np.ndarray:
    """Covariance (24, 24) of a calibration of these cameras from boards at typical poses.

    Args:
        stereo: the cameras; their covariance is not used.
        board: the board; the standard uncertainty of its pitch scales T.
        views: number of views seen by both cameras.
        rms_px: rms over corners, as OpenCV defines it: sqrt(2) sigma sqrt(degrees of freedom / coordinates).
        fixed_intrinsics: see `Provenance`; None: both, with equal probability.

    Raises:
        InputError: fewer corners than unknowns, or no board in both cameras' views.
    """
    coordinates = 4 * board.corners * views
    dof = coordinates - 24 - 6 * views
    if views < 1 or dof < 1:
        found = f"{plural(views, 'view')} of {board.corners} corners"
        remedy = "give --views and --board as they were"
        raise InputError("usage", f"{found} calibrate no pair of cameras", found=found, remedy=remedy)
    sigma_px = rms_px * math.sqrt(coordinates / (2 * dof))
    covariance = (CORRELATION_FACTOR * sigma_px) ** 2 / views * _one_view_covariance(stereo, board, fixed_intrinsics)
    scale = stereo.T * (board.pitch_u_mm / board.pitch_mm)
    covariance[21:, 21:] += np.outer(scale, scale)
    return (covariance + covariance.T) / 2


def with_marginal(covariance: np.ndarray, group: list[int], sds: np.ndarray) -> np.ndarray:
    """The covariance with these sds for the parameters of a group.

    Their correlations and the conditional distribution of the others given them are unchanged (Jeffrey 1965).
    """
    others = np.setdiff1d(np.arange(len(covariance)), group)
    block = covariance[np.ix_(group, group)]
    factor = sds / np.sqrt(np.diag(block))
    rescaled = block * np.outer(factor, factor)
    gain = np.linalg.solve(block, covariance[np.ix_(group, others)]).T
    result = covariance.copy()
    result[np.ix_(group, group)] = rescaled
    result[np.ix_(others, group)] = gain @ rescaled
    result[np.ix_(group, others)] = rescaled @ gain.T
    result[np.ix_(others, others)] += gain @ (rescaled - block) @ gain.T
    return (result + result.T) / 2


def _stated_sds(stereo: Stereo, stated: Provenance) -> dict[str, np.ndarray]:
    """The sds of each group of `GROUPS` with a stated uncertainty."""
    focal = np.abs(stereo.vector[GROUPS["focal length"]])
    units = (
        ("focal length", stated.u_focal_percent, focal / 100),
        ("principal point", stated.u_principal_px, np.ones(4)),
        ("rotation", stated.u_rotation_mrad, np.full(3, 1e-3)),
        ("translation", stated.u_baseline_mm, np.ones(3)),
    )
    return {name: value * unit for name, value, unit in units if value is not None}


def _one_view_covariance(stereo: Stereo, board: Board, fixed_intrinsics: bool | None) -> np.ndarray:
    """Covariance (24, 24) from one view, for corners of 1 px.

    The mean over the sets of the table and over the possible kinds of adjustment: the covariance of a mixture whose
    members have the same mean.
    """
    covariances = []
    for poses in placed_boards(stereo, board).values():
        if len(poses) >= POSES_MIN:
            together, alone = (np.mean(views, axis=0) for views in view_information(stereo, board, poses))
            if fixed_intrinsics is not True:
                covariances.append(_inverse(together))
            if fixed_intrinsics is not False:
                covariances.append(_in_two_steps(together, alone))
    if covariances:
        return np.mean(covariances, axis=0)
    raise _no_common_view()


def _in_two_steps(together: np.ndarray, alone: np.ndarray) -> np.ndarray:
    """Covariance for cameras calibrated alone, then R and T with fixed cameras (OpenCV's CALIB_FIX_INTRINSIC)."""
    inner = _inverse(alone)
    outer = np.linalg.inv(together[18:, 18:])
    gain = -outer @ together[18:, :18]
    across = inner @ gain.T
    return np.block([[inner, across], [across.T, outer + gain @ across]])


def _inverse(information: np.ndarray) -> np.ndarray:
    """The inverse of an information matrix, scaled first: px, rad and mm differ by ten powers of ten."""
    scale = np.sqrt(np.diag(information))
    with np.errstate(divide="ignore", invalid="ignore"):
        scaled = information / np.outer(scale, scale)
    if not np.isfinite(scaled).all() or np.linalg.eigvalsh(scaled)[0] < SINGULAR:
        raise _no_common_view()
    return np.linalg.inv(scaled) / np.outer(scale, scale)


def _no_common_view() -> InputError:
    return refusal(
        "no-common-view",
        file="the imported calibration",
        found="two cameras that do not see one board together",
        allowed="cameras whose pictures overlap",
        remedy="look at R, T and the image size: is R that of right to left, is the size that of other pictures?",
    )


def view_information(stereo: Stereo, board: Board, poses: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Information of views about the cameras for corners of 1 px, with each board's pose eliminated, 1/px^2.

    Args:
        stereo: the cameras.
        board: the board.
        poses: board to left camera, (views, 6): Rodrigues vector, mm.

    Returns:
        That of each view on the pair, (views, 24, 24), and on each camera from its own picture with its own eliminated
        pose, (views, 18, 18) in two blocks.
    """
    of_pair = projected(board.points_mm, np.reshape(poses, (-1, 6)), stereo)
    together = _schur_complement(of_pair.by_cameras, of_pair.by_pose)
    alone = np.zeros((len(together), 18, 18))
    for own, picture in ((slice(9), slice(2)), (slice(9, 18), slice(2, 4))):
        # To a camera by itself a board is placed by the same six numbers, whatever its frame.
        alone[:, own, own] = _schur_complement(of_pair.by_cameras[:, picture, :, own], of_pair.by_pose[:, picture])
    return together, alone


def _schur_complement(columns: np.ndarray, nuisance: np.ndarray) -> np.ndarray:
    """Schur complement of each view's normal matrix: information of some columns with the nuisance ones eliminated."""
    columns, nuisance = (part.reshape(len(part), -1, part.shape[-1]) for part in (columns, nuisance))
    q, _ = np.linalg.qr(nuisance)
    rest = columns - q @ (q.transpose(0, 2, 1) @ columns)
    return rest.transpose(0, 2, 1) @ rest


def placed_boards(stereo: Stereo, board: Board) -> dict[str, list[np.ndarray]]:
    """Poses (6,) of boards in front of these cameras, as in each public set; both cameras see the whole board.

    A board keeps its rotation, its position in the picture and its share of it, for a camera halfway between both.
    Where it is partly outside a picture it is moved away, nearer, or towards the middle.
    """
    path = shipped_data() / "reference" / POSES_FILE
    names = np.loadtxt(path, delimiter=",", skiprows=1, usecols=0, dtype=str)
    table = np.loadtxt(path, delimiter=",", skiprows=1, usecols=range(2, 8))
    half_rotation = rotation_matrix(rotation_vector(stereo.R) / 2)
    centre = -stereo.R.T @ stereo.T / 2
    size = np.array([stereo.image_width, stereo.image_height], float)
    focal = float(np.mean([m[k, k] for m in (stereo.M1, stereo.M2) for k in (0, 1)]))
    # Vector from the optical axis to the middle of the pictures, px.
    middle = (size - 1) / 2 - (stereo.M1[:2, 2] + stereo.M2[:2, 2]) / 2
    diagonal = np.hypot(board.columns - 1, board.rows - 1) * board.pitch_mm
    poses: dict[str, list[np.ndarray]] = {name: [] for name in names.tolist()}
    for name, row in zip(names.tolist(), table, strict=True):
        turn = rotation_vector(half_rotation.T @ rotation_matrix(row[3:]))
        depth = focal * diagonal / (row[2] * np.hypot(*size))
        for share in CENTRING_FACTORS:
            ray = np.append((share * row[:2] * size + (1 - share) * middle) / focal, 1.0)
            shifts = (half_rotation.T @ (factor * depth * ray) + centre for factor in DISTANCE_FACTORS)
            visible = next((shift for shift in shifts if _sees_whole(stereo, board, turn, shift)), None)
            if visible is not None:
                poses[name].append(np.concatenate([turn, visible]))
                break
    return poses


def _sees_whole(stereo: Stereo, board: Board, turn: np.ndarray, shift: np.ndarray) -> bool:
    """Whether both cameras see every corner of a board."""
    left = board.points_mm @ rotation_matrix(turn).T + shift
    if (left[:, 2] <= 0).any() or ((left @ stereo.R.T + stereo.T)[:, 2] <= 0).any():
        return False
    u, v = projected(board.points_mm, np.append(turn, shift)[None], stereo).pixels.reshape(2, 2, -1).swapaxes(0, 1)
    inside = (u > -0.5) & (u < stereo.image_width - 0.5) & (v > -0.5) & (v < stereo.image_height - 0.5)
    return bool(inside.all())
