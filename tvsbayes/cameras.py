"""Stereo calibration from checkerboard pictures: corners, Zhang's start, bundle adjustment with its 24 x 24 covariance.

Frames: the board's x runs along its columns, y along its rows, z away from the viewer; poses are board to left camera
(OpenCV's axes: x right, y down, z along the view), x_right = R x_left + T. mm, rad, px with the integer at a pixel's
centre.

Board poses are nuisances. At every trial of the camera parameters each board is moved to its own optimum, and the
derivative of what remains is (1 - P) J, P the projector on the columns of that board's pose (variable projection:
Golub and Pereyra 1973, in Kaufman's form of 1975). Its normal matrix is the Schur complement of the whole bundle
adjustment: the least squares see 24 parameters whatever the number of views, and their covariance is marginal.
"""

from __future__ import annotations

import math
import os
import re
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tvsbayes.files import (
    IMAGE_BYTES_MAX,
    InputError,
    NothingToEstimate,
    NotConverged,
    decode_image,
    escaped,
    image_size,
    read_bytes,
    refusal,
)
from tvsbayes.model import CV_FROM_S, StereoCameras, project, rotation_matrix
from tvsbayes.rigs import STEREO_PARAMETER_NAMES, Stereo, rotation_vector
from tvsbayes.rigs import rotation_matrix as rotation_of
from tvsbayes.solver import least_squares_covariance, linearised, solve_least_squares

SIDES: tuple[Literal["left"], Literal["right"]] = ("left", "right")
Finder = Literal["classic", "sector"]

SUFFIXES = (".png", ".jpg", ".jpeg")
SIDE_BY_SIDE_RATIO = 2.0
"""Width over height from which a picture that is named neither left nor right holds both cameras' images."""
REFINING_SHARE = 0.25
"""Half the window of cornerSubPix over the smallest distance of two corners: the window must hold one corner only,
and a wide one averages more noise. On OpenCV's pairs (22 to 37 px) fixed halves of 3, 5, 7, 9, 11 px leave 0.23,
0.20, 0.18, 0.20, 0.41 px: the best is a quarter of the distance, and from half on neighbours pull."""
REFINING_HALF_MIN, REFINING_HALF_MAX = 2, 11
WORKERS_MAX = 8

VIEWS_MIN = 3
"""Views per camera below which Zhang's method (2000) cannot find a focal length with both principal coordinates."""
START_VIEWS = 30
"""The start needs no more; every further view enters the bundle adjustment alone."""
VIEWS_PER_BUCKET, CORNERS_PER_BUCKET = 16, 32
"""Padding: calibrations of like size share one compilation."""
POSE_STEPS, POSE_TOLERANCE = 40, 1e-20
"""Gauss-Newton steps of a pose, and the squared step, in units of rad and board sizes, at which it is settled."""
RESTART_SD = 3.0
"""The repeated adjustment starts this many standard errors away in every parameter."""
RESTART_AGREEMENT_SD = 1e-2

OUTLIER_Z, OUTLIER_SPREAD_MIN = 4.0, 0.2
"""A view is an outlier if the logarithm of its residual rms lies more than 4 robust standard deviations (1.4826 MAD,
at least 0.2) above the median: never below 2.2 times the median rms. On clean views the logarithm scatters by 0.05."""
VIEWS_ADVISED = 10
"""Zhang (2000), figure 3: the errors have fallen to a floor by about ten views."""
TILT_ADVISED_DEG = 15.0
COVERAGE_ADVISED = 0.6
CORNER_SD_ADVISED_PX = 0.5


@dataclass(frozen=True)
class Board:
    """A checkerboard by its inner corners.

    Attributes:
        columns: inner corners along the board's x.
        rows: inner corners along y.
        pitch_mm: side of a square.
        pitch_u_mm: standard uncertainty of the mean pitch (GUM type B: certificate, ruler, printer).
    """

    columns: int
    rows: int
    pitch_mm: float
    pitch_u_mm: float = 0.0

    def __post_init__(self) -> None:
        if not (3 <= self.columns <= 100 and 3 <= self.rows <= 100):
            found = f"{self.columns} x {self.rows} inner corners"
            raise _bad_option("--board", found, "3 to 100 inner corners each way", "count where four squares meet")
        if not 0.01 <= self.pitch_mm <= 1e4:
            raise _bad_option("--pitch-mm", f"{self.pitch_mm:g} mm", "0.01 to 10000 mm", "give the side of a square")
        if not 0 <= self.pitch_u_mm < 0.1 * self.pitch_mm:
            found = f"{self.pitch_u_mm:g} mm"
            raise _bad_option("--pitch-u-mm", found, "0 to a tenth of the pitch", "give it for one square, not all")

    @classmethod
    def named(cls, size: str, pitch_mm: float, pitch_u_mm: float = 0.0) -> Board:
        """From text such as "9x6".

        Raises:
            InputError: no such text, or impossible values.
        """
        match = re.fullmatch(r"([0-9]{1,3})\s*[xX*]\s*([0-9]{1,3})", size.strip())
        if match is None:
            raise _bad_option("--board", escaped(size), "COLUMNSxROWS of inner corners", "write for example 9x6")
        return cls(int(match[1]), int(match[2]), pitch_mm, pitch_u_mm)

    @property
    def corners(self) -> int:
        """Number of inner corners."""
        return self.columns * self.rows

    @property
    def points_mm(self) -> np.ndarray:
        """Inner corners in the board's frame, shape (corners, 3), row by row, z = 0, origin in the middle."""
        grid = np.mgrid[: self.columns, : self.rows].T.reshape(-1, 2) - [(self.columns - 1) / 2, (self.rows - 1) / 2]
        return np.column_stack([self.pitch_mm * grid, np.zeros(self.corners)])


def _bad_option(option: str, found: str, allowed: str, remedy: str) -> InputError:
    return InputError(
        "usage", f"{option}: found {found}; allowed: {allowed}", column=option, found=found, allowed=allowed, remedy=remedy
    )


@dataclass(frozen=True)
class View:
    """Corners of the board at one pose: `left` and `right` of shape (corners, 2), px, row by row; None where unseen."""

    name: str
    left: np.ndarray | None
    right: np.ndarray | None


@dataclass(frozen=True)
class Views:
    """What a folder of pictures holds.

    Attributes:
        views: with the board in at least one picture, in the order of their names.
        image_width: of one camera, px.
        image_height: px.
        unpaired: pictures of one camera without their counterpart; where they show the board, they are in `views`.
        without_board: pictures in which no board was found.
        other_size: pictures of another size than most; not used.
        by_fallback: pictures whose board only the other finder found.
        reordered: views whose right corners were turned to agree with the left ones.
    """

    views: tuple[View, ...]
    image_width: int
    image_height: int
    unpaired: tuple[str, ...] = ()
    without_board: tuple[str, ...] = ()
    other_size: tuple[str, ...] = ()
    by_fallback: tuple[str, ...] = ()
    reordered: tuple[str, ...] = ()


def find_corners(grey: np.ndarray, board: Board, finder: Finder = "classic") -> tuple[np.ndarray, bool] | None:
    """Inner corners of a board in one picture.

    `classic` is findChessboardCorners refined by cornerSubPix, `sector` findChessboardCornersSB (Duda and Frese
    2018, sector based; slower). Where one fails, the other is tried.

    Args:
        grey: (height, width) uint8.
        board: what to look for.
        finder: which to try first.

    Returns:
        Corners (corners, 2), px, right-handed (x, then y, turn towards the image's own x, y), and whether the
        fallback found them; None where neither did.
    """
    for attempt in (finder, "sector" if finder == "classic" else "classic"):
        corners = _find_classic(grey, board) if attempt == "classic" else _find_sector(grey, board)
        if corners is None or not np.isfinite(corners).all():
            continue
        grid = corners.reshape(board.rows, board.columns, 2)
        along, across = (grid[:, -1] - grid[:, 0]).mean(0), (grid[-1] - grid[0]).mean(0)
        # A board is not transparent: seen from the front, rows turn the same way in every picture.
        if along[0] * across[1] - along[1] * across[0] < 0:
            grid = grid[:, ::-1]
        return grid.reshape(-1, 2), attempt != finder
    return None


def _find_classic(grey: np.ndarray, board: Board) -> np.ndarray | None:
    found, corners = cv2.findChessboardCorners(grey, (board.columns, board.rows))
    if not found or corners is None or np.size(corners) != 2 * board.corners:
        return None
    corners = np.asarray(corners, np.float32).reshape(-1, 2)
    grid = corners.reshape(board.rows, board.columns, 2)
    nearest = min(np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1))
    half = int(np.clip(round(REFINING_SHARE * nearest), REFINING_HALF_MIN, REFINING_HALF_MAX))
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-4)
    refined = cv2.cornerSubPix(grey, corners.reshape(-1, 1, 2).copy(), (half, half), (-1, -1), criteria)
    return np.asarray(refined, float).reshape(-1, 2)


def _find_sector(grey: np.ndarray, board: Board) -> np.ndarray | None:
    flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    found, corners = cv2.findChessboardCornersSB(grey, (board.columns, board.rows), flags=flags)
    if not found or corners is None or np.size(corners) != 2 * board.corners:
        return None
    return np.asarray(corners, float).reshape(-1, 2)


def _turns(board: Board) -> list[np.ndarray]:
    """Corner orders that a finder may give to one picture of the board: half turns, for square ones quarter turns."""
    index = np.arange(board.corners).reshape(board.rows, board.columns)
    quarters = (0, 1, 2, 3) if board.rows == board.columns else (0, 2)
    return [np.rot90(index, quarter).ravel() for quarter in quarters]


def _first_colour(grey: np.ndarray, corners: np.ndarray, board: Board) -> bool:
    """Whether the square behind the first corner is brighter than its neighbours, by all squares."""
    grid = corners.reshape(board.rows, board.columns, 2)
    middles = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    u, v = np.clip(np.rint(middles).astype(int), 0, np.array(grey.shape[::-1]) - 1).transpose(2, 0, 1)
    signs = 1 - 2 * (np.add.outer(np.arange(board.rows - 1), np.arange(board.columns - 1)) % 2)
    values = grey[v, u].astype(float)
    return bool(np.sum(signs * (values - values.mean())) > 0)


@dataclass(frozen=True)
class _Detection:
    """Corners of one picture; `colours[k]` is the first square's under the k-th order of `_turns`."""

    corners: np.ndarray
    colours: tuple[bool, ...]
    by_fallback: bool


def _agreeing(left: _Detection, right: _Detection, board: Board) -> tuple[np.ndarray, bool]:
    """Right corners in the order of the left ones, and whether they were turned.

    The colours decide where the board's turned image differs from it (one of columns and rows odd, one even).
    Otherwise the two cameras are taken to be turned by less than half of the board's symmetry against each other.
    """
    grids = [right.corners[turn].reshape(board.rows, board.columns, 2) for turn in _turns(board)]
    kept = [k for k, colour in enumerate(right.colours) if colour == left.colours[0]] or list(range(len(grids)))
    grid = left.corners.reshape(board.rows, board.columns, 2)
    along = (grid[:, -1] - grid[:, 0]).mean(0)
    best = max(kept, key=lambda k: float(along @ _unit((grids[k][:, -1] - grids[k][:, 0]).mean(0))))
    return grids[best].reshape(-1, 2), best != 0


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)


def _natural(name: str) -> list[tuple[int, str]]:
    """Sorts 2 before 10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"([0-9]{1,18})", name)]


@dataclass(frozen=True)
class _Picture:
    """A file and whose images its equal parts, from left to right, are."""

    view: str
    path: Path
    sides: tuple[str, ...]


def _pictures(folder: Path, swap: bool) -> list[_Picture]:
    """The pictures of a folder: `left*` and `right*`, or where there are none, wide frames of both cameras."""
    try:
        names = sorted((entry.name for entry in os.scandir(folder)), key=_natural)
    except OSError as error:
        place, remedy = escaped(str(folder), 200), "name the folder of the checkerboard pictures"
        found, allowed = escaped(error.strerror or str(error)), "a readable folder"
        raise refusal("unreadable", file=place, found=found, allowed=allowed, remedy=remedy) from error
    images = [Path(folder) / name for name in names if name.lower().endswith(SUFFIXES) and not name.startswith(".")]
    sided = [
        _Picture(path.stem[len(side) :], path, (side,))
        for path in images
        for side in SIDES
        if path.stem.lower().startswith(side)
    ]
    twice = [key for key, count in Counter((p.view, p.sides) for p in sided).items() if count > 1]
    if twice:
        (view, (side,)), remedy = twice[0], "keep one file per camera and view"
        found = f"two pictures {escaped(side + view)}"
        raise refusal("duplicate", file=escaped(str(folder), 200), found=found, allowed="one", remedy=remedy)
    if sided:
        return sided
    return [_Picture(path.stem, path, SIDES[::-1] if swap else SIDES) for path in images]


def find_views(folder: Path, board: Board, *, finder: Finder = "classic", swap: bool = False) -> Views:
    """Finds the board in all pictures of a folder.

    `left*` and `right*` (PNG, JPEG) are paired by the rest of the name without its suffix. Where no file has such a
    name, pictures at least twice as wide as high are split in the middle. Other files are ignored.

    Args:
        folder: of the pictures.
        board: what to look for.
        finder: see `find_corners`.
        swap: the left camera's image is the right half of a wide frame.

    Raises:
        InputError: no folder, an unreadable picture, or two for one camera and view.
        NothingToEstimate: no picture of a camera.
    """
    folder = Path(folder)
    contents = {picture: read_bytes(picture.path, IMAGE_BYTES_MAX, folder) for picture in _pictures(folder, swap)}
    sizes = {p: image_size(data, escaped(p.path.name)) for p, data in contents.items()}
    sizes = {p: s for p, s in sizes.items() if len(p.sides) == 1 or (s[0] >= SIDE_BY_SIDE_RATIO * s[1])}
    if not sizes:
        raise NothingToEstimate(
            "no-pictures",
            f"{escaped(str(folder), 200)}: no checkerboard picture",
            allowed="left*.png with right*.png (or .jpg), or frames of both cameras side by side",
            remedy="name the pictures left01.png, right01.png, left02.png ...",
        )
    counted = Counter((width // len(p.sides), height) for p, (width, height) in sizes.items())
    size = max(counted, key=lambda s: (counted[s], s))
    used = [p for p, (width, height) in sizes.items() if (width // len(p.sides), height) == size]

    def detect(picture: _Picture) -> dict[str, _Detection | None]:
        image = decode_image(contents[picture], escaped(picture.path.name))
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        parts = (grey[:, k * size[0] : (k + 1) * size[0]] for k in range(len(picture.sides)))
        return {side: _detection(np.ascontiguousarray(part), board, finder) for side, part in zip(picture.sides, parts, strict=True)}

    found: dict[str, dict[str, _Detection]] = {}
    names: dict[tuple[str, str], str] = {}
    without, fallback = [], []
    with ThreadPoolExecutor(min(WORKERS_MAX, os.cpu_count() or 1)) as pool:
        for picture, detections in zip(used, pool.map(detect, used), strict=True):
            for side, detection in detections.items():
                name = picture.path.name + (f" ({side})" if len(picture.sides) > 1 else "")
                names[picture.view, side] = name
                if detection is None:
                    without.append(name)
                    continue
                found.setdefault(picture.view, {})[side] = detection
                if detection.by_fallback:
                    fallback.append(name)
    views, reordered = [], []
    for name in sorted(found, key=_natural):
        left, right = (found[name].get(side) for side in SIDES)
        corners = None if right is None else right.corners
        if left is not None and right is not None:
            corners, turned = _agreeing(left, right, board)
            reordered += [name] * turned
        views.append(View(name, None if left is None else left.corners, corners))
    unpaired = [n for (view, side), n in names.items() if (view, SIDES[side == "left"]) not in names]
    other_size = [p.path.name for p in sizes if p not in used]
    return Views(tuple(views), *size, *(tuple(x) for x in (unpaired, without, other_size, fallback, reordered)))


def _detection(grey: np.ndarray, board: Board, finder: Finder) -> _Detection | None:
    result = find_corners(grey, board, finder)
    if result is None:
        return None
    corners, by_fallback = result
    colours = tuple(_first_colour(grey, corners[turn], board) for turn in _turns(board))
    return _Detection(corners, colours, by_fallback)


class BoardArrays(eqx.Module):
    """Corners of all views, padded, and the coordinates of the adjustment: parameters = origin + root z.

    Attributes:
        points_mm: corners in the board's frame, first axis x, y, z.
        corners_px: (u_left, v_left, u_right, v_right) of every view and corner.
        weight: 1 where a corner was seen, else 0.
        poses: start of every board's rotation vector and translation (board to left camera).
        origin: the 24 parameters at z = 0.
        root: d(parameters)/dz; a fixed parameter has a zero row.
    """

    points_mm: Float[Array, "3 corners"]
    corners_px: Float[Array, "views 4 corners"]
    weight: Float[Array, "views 4 corners"]
    poses: Float[Array, "views 6"]
    origin: Float[Array, "24"]
    root: Float[Array, "24 free"]


def _cameras(parameters: Float[Array, "24"]) -> StereoCameras:
    intrinsics = parameters[:18].reshape(2, 9)
    return StereoCameras(
        focal_px=intrinsics[:, 0:2],
        centre_px=intrinsics[:, 2:4],
        radial=intrinsics[:, jnp.array([4, 5, 8])],
        tangential=intrinsics[:, 6:8],
        rotation_rad=parameters[18:21],
        translation_mm=parameters[21:24],
        focal_scale=jnp.ones(()),
    )


def _view_residuals(
    pose: Float[Array, "6"],
    parameters: Float[Array, "24"],
    corners_px: Float[Array, "4 corners"],
    weight: Float[Array, "4 corners"],
    points_mm: Float[Array, "3 corners"],
) -> Float[Array, " residuals"]:
    """Projected minus found corners of one view, px; 0 where none was seen."""
    left = rotation_matrix(pose[:3]) @ points_mm + pose[3:, None]
    return (weight * (project(_cameras(parameters), CV_FROM_S.T @ left) - corners_px)).ravel()


def _pose_gain(pose, parameters, corners_px, weight, points_mm):
    """Jacobian by the pose and its pseudo-inverse; zero for padding."""
    by_pose = jax.jacfwd(_view_residuals)(pose, parameters, corners_px, weight, points_mm)
    # Rotation in rad and translation in board sizes change corners alike; the ridge only serves padding.
    size = jnp.max(jnp.abs(points_mm))
    scale = jnp.concatenate([jnp.ones(3), size * jnp.ones(3)])
    scaled = by_pose * scale
    normal = scaled.T @ scaled
    ridge = jnp.where(jnp.max(weight) > 0, 0.0, 1.0)
    return by_pose, scale[:, None] * jnp.linalg.solve(normal + ridge * jnp.eye(6), scaled.T), scale


def _settled_pose(pose, parameters, corners_px, weight, points_mm):
    """The pose of least squares for given cameras, by Gauss-Newton steps from a pose nearby."""

    def unsettled(state):
        _, step2, steps = state
        return (step2 > POSE_TOLERANCE) & (steps < POSE_STEPS)

    def step(state):
        pose, _, steps = state
        _, gain, scale = _pose_gain(pose, parameters, corners_px, weight, points_mm)
        change = gain @ _view_residuals(pose, parameters, corners_px, weight, points_mm)
        return pose - change, jnp.sum((change / scale) ** 2), steps + 1

    return jax.lax.while_loop(unsettled, step, (pose, jnp.asarray(jnp.inf), 0))[0]


def _over_views(function):
    return jax.vmap(function, in_axes=(0, None, 0, 0, None))


@eqx.filter_jit
def settled_poses(z: Float[Array, " free"], arrays: BoardArrays) -> Float[Array, "views 6"]:
    """Every board's pose at its own optimum for the cameras at z."""
    parameters = arrays.origin + arrays.root @ z
    return _over_views(_settled_pose)(arrays.poses, parameters, arrays.corners_px, arrays.weight, arrays.points_mm)


def reduced_residuals(z: Float[Array, " free"], arrays: BoardArrays) -> Float[Array, " residuals"]:
    """All residuals with every board at its optimum, px, as a function of the cameras alone.

    Its derivative is (1 - P) J of the full problem: what a change of the cameras leaves after the boards have
    followed.
    """
    parameters = arrays.origin + arrays.root @ z
    seen = (arrays.corners_px, arrays.weight, arrays.points_mm)
    fixed = jax.lax.stop_gradient(parameters)
    poses = jax.lax.stop_gradient(_over_views(_settled_pose)(arrays.poses, fixed, *seen))
    by_pose, gain, _ = jax.lax.stop_gradient(_over_views(_pose_gain)(poses, fixed, *seen))
    residuals = _over_views(_view_residuals)(poses, parameters, *seen)
    return (residuals - jnp.einsum("vrp,vps,vs->vr", by_pose, gain, residuals)).ravel()


@dataclass(frozen=True)
class Adjustment:
    """Least squares over all views, poses eliminated.

    Attributes:
        vector: the 24 parameters in the order of `STEREO_PARAMETER_NAMES`.
        covariance: (24, 24), type A, under `noise_sd_px` alone: independent corners.
        poses: boards to left camera, shape (views, 6).
        residuals_px: projected minus found, shape (views, 4, corners), NaN where no corner was seen.
        noise_sd_px: standard deviation of one corner coordinate, from the residuals.
        dof: degrees of freedom behind it: coordinates - camera parameters - 6 per view.
        correlation_factor: see `correlation_factor`.
    """

    vector: np.ndarray
    covariance: np.ndarray
    poses: np.ndarray
    residuals_px: np.ndarray
    noise_sd_px: float
    dof: int
    correlation_factor: float


def correlation_factor(jacobian: np.ndarray, residuals: np.ndarray, views: np.ndarray, noise_sd: float) -> float:
    """How much larger the scores of whole views are than independent corners would make them; at least 1.

    Corner errors of one picture have common causes (light, defocus, a lens that is not quite the model, a bent
    board): they are not independent, and (J^T J)^-1 s^2 is then too small. The score of view i, J_i^T r_i, shows
    it: independent errors give the sum of |J_i^T r_i|^2 in coordinates where J^T J = 1 the expectation
    s^2 (p - sum_i tr (J_i^T J_i)^2), the second term for the residuals having been fitted. The ratio scales the
    covariance: the cluster-robust variance of Liang and Zeger (1986) reduced to one number, since a dozen views
    cannot support a 24 x 24 matrix of them. Errors common to ALL views stay unseen.

    Args:
        jacobian: (residuals, p), of full rank.
        residuals: (residuals,).
        views: (residuals,), which view each belongs to, numbered from 0.
        noise_sd: s.
    """
    q, _ = np.linalg.qr(jacobian / np.linalg.norm(jacobian, axis=0))
    count = int(views.max()) + 1
    score, lost = 0.0, 0.0
    for view in range(count):
        rows = q[views == view]
        score += float(np.sum((rows.T @ residuals[views == view]) ** 2))
        lost += float(np.sum((rows.T @ rows) ** 2))
    expected = noise_sd**2 * (q.shape[1] - lost)
    return max(1.0, score / expected) if expected > 1e-3 * noise_sd**2 else 1.0


def bundle_adjustment(
    views: Sequence[View], board: Board, start: np.ndarray, poses: np.ndarray, free: np.ndarray
) -> Adjustment:
    """Least squares of all corners over cameras and board poses, with the checks of `solve_least_squares`.

    Args:
        views: at least one.
        board: whose corners they hold.
        start: the 24 parameters.
        poses: (views, 6), board to left camera.
        free: (24,) of bool; the others keep their start.

    Raises:
        NothingToEstimate: the views leave a combination of parameters open.
        NotConverged: no minimum was found.
    """
    count = -(-len(views) // VIEWS_PER_BUCKET) * VIEWS_PER_BUCKET
    corners = -(-board.corners // CORNERS_PER_BUCKET) * CORNERS_PER_BUCKET
    seen, weight = np.zeros((count, 4, corners)), np.zeros((count, 4, corners))
    start_poses, points = np.zeros((count, 6)), np.zeros((3, corners))
    start_poses[:, 5] = 1.0
    start_poses[: len(views)] = poses
    points[:, : board.corners] = board.points_mm.T
    for k, view in enumerate(views):
        for side, found in enumerate((view.left, view.right)):
            if found is not None:
                seen[k, 2 * side : 2 * side + 2, : board.corners] = found.T
                weight[k, 2 * side : 2 * side + 2, : board.corners] = 1.0
    kept = (weight > 0).ravel()
    view_of = np.repeat(np.arange(count), 4 * corners)[kept]
    dof = int(kept.sum()) - int(free.sum()) - 6 * len(views)
    if dof < 1:
        raise _undetermined("fewer corner coordinates than unknowns")
    with jax.enable_x64(True):
        unit = np.eye(24)[:, free]
        # Without cameras' steps in their own standard errors, a focal length and a k3 would share one damping.
        arrays = BoardArrays(points, seen, weight, start_poses, np.asarray(start, float), unit)
        zero = np.zeros(int(free.sum()))
        jacobian = np.asarray(linearised(reduced_residuals, jnp.asarray(zero), arrays)[1])
        arrays = replace(arrays, root=unit @ _whitening(jacobian, np.flatnonzero(free)))
        # Scaled to px of noise, a unit of z is about one standard error.
        first = solve_least_squares(reduced_residuals, zero, arrays, max_steps=200, restart=False)
        noise_sd = math.sqrt(float(first.residuals @ first.residuals) / dof)
        # Alternating signs, so that no parameter's shift can be taken up by another's.
        shift = RESTART_SD * noise_sd * np.where(np.arange(zero.size) % 2, -1.0, 1.0)
        second = solve_least_squares(reduced_residuals, first.value + shift, arrays, max_steps=200, restart=False)
        problems = list(first.problems)
        if np.abs(second.value - first.value).max() > RESTART_AGREEMENT_SD * noise_sd + 1e-9:
            problems.append("a second adjustment from a start nearby ended elsewhere")
        if problems:
            raise NotConverged(
                "not-converged",
                "the bundle adjustment did not converge: " + "; ".join(problems),
                remedy="look at the pictures for wrong boards, a wrong --board, or add tilted views",
            )
        try:
            z_covariance = least_squares_covariance(first.jacobian[kept])
        except np.linalg.LinAlgError as error:
            raise _undetermined(str(error)) from error
        found_poses = np.asarray(settled_poses(first.value, arrays))[: len(views)]
    residuals = np.where(weight > 0, first.residuals.reshape(weight.shape), np.nan)[: len(views), :, : board.corners]
    root = np.asarray(arrays.root)
    factor = correlation_factor(first.jacobian[kept], first.residuals[kept], view_of, noise_sd)
    return Adjustment(
        vector=start + root @ first.value,
        covariance=noise_sd**2 * root @ z_covariance @ root.T,
        poses=found_poses,
        residuals_px=residuals,
        noise_sd_px=noise_sd,
        dof=dof,
        correlation_factor=factor,
    )


def _undetermined(reason: str) -> NothingToEstimate:
    return NothingToEstimate(
        "undetermined",
        f"the views do not determine the cameras: {reason}",
        remedy="add views: board tilted by 30 to 45 degrees about both axes, near and far, in every corner of the image",
    )


def _whitening(jacobian: np.ndarray, free: np.ndarray) -> np.ndarray:
    """W with (J W)^T (J W) = 1."""
    scale = np.linalg.norm(jacobian, axis=0)
    if not np.isfinite(jacobian).all() or not (scale > 0).all():
        raise _undetermined(f"nothing depends on {STEREO_PARAMETER_NAMES[free[int(np.argmin(scale))]]}")
    _, singular, vt = np.linalg.svd(jacobian / scale, full_matrices=False)
    if singular[-1] < 1e-9 * singular[0]:
        names = [STEREO_PARAMETER_NAMES[free[k]] for k in np.argsort(-np.abs(vt[-1]))[:3]]
        raise _undetermined(f"{', '.join(names)} can change together without moving a corner")
    return (vt.T / singular) / scale[:, None]


@dataclass(frozen=True)
class ViewReport:
    """One view: residual rms per camera as OpenCV defines it (over corners, px; None where unseen), pose in words."""

    name: str
    left_rms_px: float | None
    right_rms_px: float | None
    distance_mm: float
    tilt_deg: float
    outlier: bool


@dataclass(frozen=True)
class StereoCalibration:
    """A stereo calibration with everything behind it.

    Attributes:
        stereo: parameters and their full covariance (type A with `correlation_factor`, plus the pitch).
        board: as given.
        views: every view used, with its residuals.
        left_rms_px, right_rms_px: rms over corners as OpenCV defines it; of both cameras in `stereo.rms_px`.
        noise_sd_px: standard deviation of one corner coordinate.
        dof: degrees of freedom behind it.
        correlation_factor: factor on the covariance for errors that the corners of a picture share.
        covariance_independent: (24, 24), type A for independent corners: what OpenCV and most tools report.
        covariance_pitch: (24, 24), type B, from the pitch: scales T.
        coverage: share of the image inside the boards, by camera.
        triangulated_pitch_mm: mean and standard deviation of all sides of squares, triangulated.
        found: what the folder held; None where corners were given.
        excluded: names of outlying views that were left out (`robust`).
        warnings: plausibility in words.
        seconds: wall time by stage.
    """

    stereo: Stereo
    board: Board
    views: tuple[ViewReport, ...]
    left_rms_px: float
    right_rms_px: float
    noise_sd_px: float
    dof: int
    correlation_factor: float
    covariance_independent: np.ndarray
    covariance_pitch: np.ndarray
    coverage: dict[str, float]
    triangulated_pitch_mm: tuple[float, float]
    found: Views | None
    excluded: tuple[str, ...]
    warnings: tuple[str, ...]
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def outliers(self) -> tuple[str, ...]:
        """Names of the outlying views among those used."""
        return tuple(view.name for view in self.views if view.outlier)

    @property
    def pairs(self) -> int:
        """Views that both cameras saw."""
        return sum(view.left_rms_px is not None and view.right_rms_px is not None for view in self.views)

    def as_json(self) -> dict[str, object]:
        """The document of `tvsbayes stereo --json`, without the paths of what was written."""
        total = np.sqrt(np.diag(self.stereo.parameter_covariance))
        parts = {
            "sd": total,
            "sd_independent_corners": np.sqrt(np.diag(self.covariance_independent)),
            "sd_pitch": np.sqrt(np.diag(self.covariance_pitch)),
        }
        vector = self.stereo.vector
        found = self.found
        lists = ("unpaired", "without_board", "other_size", "by_fallback", "reordered")
        return {
            "image_width": self.stereo.image_width,
            "image_height": self.stereo.image_height,
            "board": {
                "columns": self.board.columns,
                "rows": self.board.rows,
                "pitch_mm": self.board.pitch_mm,
                "pitch_u_mm": self.board.pitch_u_mm,
            },
            "pairs": self.pairs,
            "single_views": len(self.views) - self.pairs,
            "rms_px": self.stereo.rms_px,
            "left_rms_px": self.left_rms_px,
            "right_rms_px": self.right_rms_px,
            "noise": {"sd_px": self.noise_sd_px, "dof": self.dof, "correlation_factor": self.correlation_factor},
            "parameters": {
                name: {"value": float(vector[k]), **{key: float(sds[k]) for key, sds in parts.items()}}
                for k, name in enumerate(STEREO_PARAMETER_NAMES)
            },
            "baseline_mm": {"value": float(np.linalg.norm(self.stereo.T)), "sd": self.baseline_sd_mm},
            "triangulated_pitch_mm": {"mean": self.triangulated_pitch_mm[0], "sd": self.triangulated_pitch_mm[1]},
            "coverage": self.coverage,
            "views": [vars(view) for view in self.views],
            "outliers": list(self.outliers),
            "excluded": list(self.excluded),
            **{key: list(getattr(found, key)) if found is not None else [] for key in lists},
            "warnings": list(self.warnings),
            "assumed": self.stereo.assumed,
            "seconds": self.seconds,
        }

    @property
    def baseline_sd_mm(self) -> float:
        """Standard uncertainty of |T|."""
        along = self.stereo.T / np.linalg.norm(self.stereo.T)
        return float(np.sqrt(along @ self.stereo.parameter_covariance[21:, 21:] @ along))


@dataclass(frozen=True)
class CameraCalibration:
    """One camera alone: fx fy cx cy k1 k2 p1 p2 k3 and their covariance for independent corners (9, 9)."""

    vector: np.ndarray
    covariance: np.ndarray
    rms_px: float
    noise_sd_px: float
    dof: int
    correlation_factor: float


@dataclass(frozen=True)
class _CameraStart:
    """Zhang's solution for one camera: matrix, distortion, and a pose (6,) for every view that it saw."""

    matrix: np.ndarray
    distortion: np.ndarray
    poses: dict[int, np.ndarray]

    @property
    def vector(self) -> np.ndarray:
        return np.array([*self.matrix[[0, 1, 0, 1], [0, 1, 2, 2]], *self.distortion])


def _camera_start(
    corners: dict[int, np.ndarray], board: Board, size: tuple[int, int], side: str, fix_k3: bool
) -> _CameraStart:
    """Zhang's method (cv2.calibrateCamera) on some views, then a pose for each by IPPE (Collins and Bartoli 2014)."""
    if len(corners) < VIEWS_MIN:
        raise NothingToEstimate(
            "few-views",
            f"the board was found in {len(corners)} pictures of the {side} camera; {VIEWS_MIN} are the least",
            remedy="check --board (inner corners: where four squares meet), sharpness and light; take 15 to 25 views",
        )
    keys = sorted(corners)
    chosen = [keys[k] for k in np.unique(np.linspace(0, len(keys) - 1, START_VIEWS).astype(int))]
    points = board.points_mm.astype(np.float32)
    flags = cv2.CALIB_FIX_K3 if fix_k3 else 0
    try:
        found = [corners[k].astype(np.float32) for k in chosen]
        _, matrix, distortion, *_ = cv2.calibrateCamera([points] * len(found), found, size, None, None, flags=flags)
        distortion = np.asarray(distortion, float).ravel()[:5]
        poses = {}
        for k in keys:
            done, turn, shift = cv2.solvePnP(
                board.points_mm, corners[k], matrix, distortion, flags=cv2.SOLVEPNP_IPPE
            )
            poses[k] = np.concatenate([np.ravel(turn), np.ravel(shift)]) if done else np.array([0, 0, 0, 0, 0, 1e3])
    except cv2.error as error:
        raise _undetermined(f"OpenCV found no start for the {side} camera ({escaped(str(error.err), 100)})") from error
    start = _CameraStart(np.asarray(matrix, float), distortion, poses)
    if not (np.isfinite(start.vector).all() and np.isfinite([*poses.values()]).all()):
        raise _undetermined(f"OpenCV found no finite start for the {side} camera")
    return start


def _relative(start: Sequence[_CameraStart]) -> tuple[np.ndarray, np.ndarray]:
    """R and T as the median over pairs: one wrong pair does not move them."""
    rotations, translations = [], []
    for k in sorted(set(start[0].poses) & set(start[1].poses)):
        left, right = (s.poses[k] for s in start)
        turn = rotation_of(right[:3]) @ rotation_of(left[:3]).T
        rotations.append(turn)
        translations.append(right[3:] - turn @ left[3:])
    if not rotations:
        raise NothingToEstimate(
            "no-pairs",
            "no view shows the board to both cameras",
            remedy="name the pictures of one moment alike: left01.png and right01.png",
        )
    return rotation_vector(np.median(rotations, axis=0)), np.median(translations, axis=0)


def calibrate_camera(
    corners: Sequence[np.ndarray], board: Board, size: tuple[int, int], *, fix_k3: bool = False
) -> CameraCalibration:
    """One camera by itself, through the same adjustment as a pair.

    Args:
        corners: per view (corners, 2), px.
        board: whose corners they are.
        size: image width and height, px.
        fix_k3: keep k3 at 0.

    Raises:
        NothingToEstimate: too few views, or they do not determine the camera.
        NotConverged: no minimum was found.
    """
    start = _camera_start(dict(enumerate(corners)), board, size, "only", fix_k3)
    free = np.arange(24) < 9
    free[8] = not fix_k3
    vector = np.concatenate([start.vector, start.vector, np.zeros(6)])
    views = [View(str(k), c, None) for k, c in enumerate(corners)]
    done = bundle_adjustment(views, board, vector, np.array([start.poses[k] for k in range(len(corners))]), free)
    rms = math.sqrt(float(np.nansum(done.residuals_px**2)) / (len(corners) * board.corners))
    noise = done.noise_sd_px, done.dof, done.correlation_factor
    return CameraCalibration(done.vector[:9], done.covariance[:9, :9], rms, *noise)


def calibrate_stereo(
    views: Sequence[View],
    board: Board,
    size: tuple[int, int],
    *,
    fix_k3: bool = False,
    robust: bool = False,
    found: Views | None = None,
) -> StereoCalibration:
    """Calibrates a stereo pair from corners.

    Args:
        views: corners by view; those of one camera alone inform that camera.
        board: whose corners they are.
        size: image width and height, px.
        fix_k3: keep both k3 at 0.
        robust: leave out outlying views and adjust again, once.
        found: what the folder held, for the report.

    Raises:
        NothingToEstimate: fewer than `VIEWS_MIN` views of a camera, no pair, or views that leave parameters open.
        NotConverged: no minimum was found.
    """
    began = time.perf_counter()
    views = [view for view in views if view.left is not None or view.right is not None]
    free = np.ones(24, bool)
    free[[8, 17]] = not fix_k3
    done = _adjusted(views, board, size, free)
    outliers = _outliers(done)
    excluded: tuple[str, ...] = ()
    if robust and outliers.any():
        excluded = tuple(view.name for view, out in zip(views, outliers, strict=True) if out)
        views = [view for view, out in zip(views, outliers, strict=True) if not out]
        done = _adjusted(views, board, size, free)
        outliers = _outliers(done)
    pitch = np.zeros((24, 24))
    # The pixels know angles only: all lengths, T among them, are proportional to the pitch.
    shift = done.vector[21:] * (board.pitch_u_mm / board.pitch_mm)
    pitch[21:, 21:] = np.outer(shift, shift)
    covariance = done.correlation_factor * done.covariance + pitch
    empty = Stereo(*size, *(np.zeros(1) for _ in range(6)), 0.5 * (covariance + covariance.T), _rms(done.residuals_px))
    stereo = empty.with_vector(done.vector)
    reports = tuple(_view_reports(views, done, outliers))
    result = StereoCalibration(
        stereo=stereo,
        board=board,
        views=reports,
        left_rms_px=_rms(done.residuals_px[:, :2]),
        right_rms_px=_rms(done.residuals_px[:, 2:]),
        noise_sd_px=done.noise_sd_px,
        dof=done.dof,
        correlation_factor=done.correlation_factor,
        covariance_independent=done.covariance,
        covariance_pitch=pitch,
        coverage={side: _coverage([getattr(v, side) for v in views], board, size) for side in SIDES},
        triangulated_pitch_mm=_triangulated_pitch(views, board, stereo),
        found=found,
        excluded=excluded,
        warnings=(),
        seconds={"adjustment": time.perf_counter() - began},
    )
    return replace(result, warnings=tuple(_plausibility(result, done.poses)))


def calibrate_folder(
    folder: Path,
    board: Board,
    *,
    finder: Finder = "classic",
    swap: bool = False,
    fix_k3: bool = False,
    robust: bool = False,
) -> StereoCalibration:
    """`find_views`, then `calibrate_stereo`; their arguments and errors."""
    began = time.perf_counter()
    found = find_views(folder, board, finder=finder, swap=swap)
    seconds = {"corners": time.perf_counter() - began}
    size = (found.image_width, found.image_height)
    result = calibrate_stereo(found.views, board, size, fix_k3=fix_k3, robust=robust, found=found)
    return replace(result, seconds=seconds | result.seconds)


def _adjusted(views: Sequence[View], board: Board, size: tuple[int, int], free: np.ndarray) -> Adjustment:
    starts = [
        _camera_start(
            {k: getattr(v, side) for k, v in enumerate(views) if getattr(v, side) is not None},
            board,
            size,
            side,
            not free[8],
        )
        for side in SIDES
    ]
    turn, shift = _relative(starts)
    poses = []
    for k in range(len(views)):
        if k in starts[0].poses:
            poses.append(starts[0].poses[k])
            continue
        seen, back = starts[1].poses[k], rotation_of(turn).T
        poses.append(np.concatenate([rotation_vector(back @ rotation_of(seen[:3])), back @ (seen[3:] - shift)]))
    vector = np.concatenate([starts[0].vector, starts[1].vector, turn, shift])
    return bundle_adjustment(views, board, vector, np.array(poses), free)


def _rms(residuals_px: np.ndarray) -> float:
    """Root of the mean squared distance of a corner, as OpenCV defines it; residuals (views, 2 or 4, corners)."""
    return math.sqrt(2 * float(np.nanmean(residuals_px**2)))


def _outliers(done: Adjustment) -> np.ndarray:
    """Which views lie above the rule of `OUTLIER_Z`, shape (views,)."""
    logs = np.log([max(_rms(r), 1e-12) for r in done.residuals_px])
    middle = np.median(logs)
    spread = max(1.4826 * float(np.median(np.abs(logs - middle))), OUTLIER_SPREAD_MIN)
    return logs > middle + OUTLIER_Z * spread


def _normal(pose: np.ndarray) -> np.ndarray:
    return rotation_of(pose[:3])[:, 2]


def _view_reports(views: Sequence[View], done: Adjustment, outliers: np.ndarray):
    for view, residuals, pose, outlier in zip(views, done.residuals_px, done.poses, outliers, strict=True):
        rms = [
            None if seen is None else _rms(residuals[rows])
            for seen, rows in ((view.left, slice(0, 2)), (view.right, slice(2, 4)))
        ]
        tilt = math.degrees(math.acos(min(1.0, abs(float(_normal(pose)[2])))))
        yield ViewReport(view.name, *rms, float(np.linalg.norm(pose[3:])), tilt, bool(outlier))


def _coverage(corners: Sequence[np.ndarray | None], board: Board, size: tuple[int, int]) -> float:
    """Share of the image inside the outline of a board in at least one view."""
    scale = 256 / max(size)
    mask = np.zeros([max(1, round(s * scale)) for s in size[::-1]], np.uint8)
    for seen in corners:
        if seen is not None:
            outline = cv2.convexHull(np.rint(seen * scale).astype(np.int32).reshape(-1, 1, 2))
            cv2.fillConvexPoly(mask, outline, 1)
    return float(mask.mean())


def _triangulated_pitch(views: Sequence[View], board: Board, stereo: Stereo) -> tuple[float, float]:
    """Mean and standard deviation of the sides of all squares, triangulated from both images, mm."""
    sides = []
    right = np.hstack([stereo.R, stereo.T[:, None]])
    for view in views:
        if view.left is None or view.right is None:
            continue
        rays = [
            cv2.undistortPoints(seen.reshape(-1, 1, 2), M, D).reshape(-1, 2).T
            for seen, M, D in ((view.left, stereo.M1, stereo.D1), (view.right, stereo.M2, stereo.D2))
        ]
        points = np.asarray(cv2.triangulatePoints(np.eye(3, 4), right, *rays))
        grid = (points[:3] / points[3]).T.reshape(board.rows, board.columns, 3)
        sides += [np.linalg.norm(np.diff(grid, axis=axis), axis=2).ravel() for axis in (0, 1)]
    lengths = np.concatenate(sides)
    return float(lengths.mean()), float(lengths.std(ddof=1))


def _plausibility(result: StereoCalibration, poses: np.ndarray) -> list[str]:
    """What a careful reader would ask about the views, in words."""
    warnings = []
    if result.pairs < VIEWS_ADVISED:
        warnings.append(f"few views: {result.pairs} pairs; errors fall until about {VIEWS_ADVISED}, take 15 to 25")
    normals = np.array([_normal(pose) for pose in poses])
    spread = math.degrees(math.acos(min(1.0, float(np.abs(normals @ normals.T).min()))))
    if spread < TILT_ADVISED_DEG:
        warnings.append(
            f"all boards are nearly parallel (within {spread:.0f} deg): focal length and distance cannot be told "
            "apart; tilt the board by 30 to 45 deg about both axes"
        )
    elif max(view.tilt_deg for view in result.views) < TILT_ADVISED_DEG:
        warnings.append("no tilt: no board leans more than 15 deg; tilt it by 30 to 45 deg about both axes")
    for side, share in result.coverage.items():
        if share < COVERAGE_ADVISED:
            warnings.append(
                f"poor coverage: boards fill {100 * share:.0f} % of the {side} image; outside, the distortion is "
                "extrapolated: hold the board into every corner of the image"
            )
    if result.noise_sd_px > CORNER_SD_ADVISED_PX:
        warnings.append(
            f"corners miss by {result.noise_sd_px:.2f} px (one coordinate); 0.1 to 0.2 is usual: look for blur, "
            "pictures not of one moment, a bent board, or a lens that five coefficients do not describe"
        )
    size, vector = (result.stereo.image_width, result.stereo.image_height), result.stereo.vector
    for side, (fx, fy, cx, cy) in zip(SIDES, (vector[0:4], vector[9:13]), strict=True):
        if not (0.2 * size[0] < cx < 0.8 * size[0] and 0.2 * size[1] < cy < 0.8 * size[1]):
            warnings.append(f"the {side} principal point ({cx:.0f}, {cy:.0f}) px lies far from the middle of the image")
        if abs(fx / fy - 1) > 0.05:
            warnings.append(f"the {side} fx and fy differ by {100 * abs(fx / fy - 1):.0f} %: pixels are seldom so oblong")
    if result.stereo.T[0] > 0:
        warnings.append("the right camera stands to the left of the left one: are the pictures swapped?")
    mean, sd = result.triangulated_pitch_mm
    if abs(mean / result.board.pitch_mm - 1) > 0.01:
        warnings.append(f"triangulated squares measure {mean:.3f} mm (sd {sd:.3f}), not {result.board.pitch_mm:g}")
    if result.board.pitch_u_mm == 0:
        warnings.append("the pitch is taken as exact: state its standard uncertainty with --pitch-u-mm")
    if result.outliers:
        warnings.append(
            f"outlying views: {escaped(', '.join(result.outliers), 400)}; look at their pictures, or leave them out "
            "with --robust"
        )
    return warnings
