"""Pictures of a checkerboard by the twin's cameras, in visible light.

A board's edges are area-sampled; its corners are at `Camera.project` of their positions. Poses take the board's axes to
the left camera's (x right, y down, z along the view); mm; px with the integer at the centre of a pixel; DN = grey
levels of 8 bits. All random numbers follow from the given seeds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from tvsbayes.errors import refusal
from tvsbayes.instrument.stereo_pair import rotation_matrix
from tvsbayes.twin.physics import Camera, CameraPair
from tvsbayes.twin.spot_pictures import Sensor, ambient_level, expose, random_stream

SUBPIXELS = 8
"""Samples per axis in a pixel that an edge of the board may cross, for levels to 1/64."""
SHADING = 0.15
"""Relative decrease of the light on a board from the upper left to the lower right corner of the picture."""
BORDER_PX = 8.0
"""Least distance of a board's outer squares from the image's border."""
DEPTHS_MM = (280.0, 520.0)
"""Depths of boards for focal lengths up to `LENS` picture heights, in px; for longer ones they are increased."""
LENS = 1.25
"""Focal length over picture height; the shipped rigs have 1.11."""
TILT_MAX_DEG = 40.0


@dataclass(frozen=True)
class Board:
    """A checkerboard by its INNER corners, as OpenCV counts them; corner (0, 0) is the board's origin.

    Inner corner (i, j) is at (i, j, 0) * pitch. Squares extend by one pitch on every side, a white margin by another
    `margin` pitches.
    """

    columns: int = 9
    rows: int = 6
    pitch_mm: float = 25.0
    margin: float = 0.6
    white_dn: float = 190.0
    black_dn: float = 25.0
    surround_dn: float = 70.0

    def corners_mm(self) -> np.ndarray:
        """Return inner corners (rows * columns, 3) in the board's axes, row by row, in OpenCV's order."""
        x, y = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        return np.column_stack((x.ravel(), y.ravel(), np.zeros(x.size))) * self.pitch_mm


@dataclass(frozen=True)
class BoardPose:
    """Pose of a board: `rotation` (3, 3), `translation_mm` (3,) from its axes to the left camera's."""

    rotation: np.ndarray
    translation_mm: np.ndarray


def _fine_levels(x: np.ndarray, y: np.ndarray, board: Board) -> np.ndarray:
    """Return reflectance in DN at board coordinates in units of the pitch."""
    squares = (x >= -1) & (x < board.columns) & (y >= -1) & (y < board.rows)
    dark = (np.floor(x).astype(np.int64) + np.floor(y).astype(np.int64)) % 2 == 0
    m = board.margin
    paper = (x >= -1 - m) & (x < board.columns + m) & (y >= -1 - m) & (y < board.rows + m)
    outside = np.where(paper, board.white_dn, board.surround_dn)
    return np.where(squares, np.where(dark, board.black_dn, board.white_dn), outside)


def _rays(camera: Camera) -> np.ndarray:
    """Return undistorted normalised coordinates (height, width, 2) of every pixel; NaN where there are none."""
    return _rays_of(
        camera.width,
        camera.height,
        tuple(camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()),
        tuple(camera.distortion.tolist()),
    )


@lru_cache(maxsize=4)
def _rays_of(width: int, height: int, pinhole: tuple[float, ...], distortion: tuple[float, ...]) -> np.ndarray:
    fx, fy, cx, cy = pinhole
    k1, k2, p1, p2, k3 = distortion
    u, v = np.meshgrid((np.arange(width) - cx) / fx, (np.arange(height) - cy) / fy)
    x, y = u.copy(), v.copy()
    for _ in range(30):  # Newton with the radial slope alone: the tangential part converges linearly, by 1e-4 a step
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = radial + 2 * r2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))
        miss_u = u - (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x))
        miss_v = v - (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y)
        # Along the radius the map stretches by `slope`, across it by `radial`.
        with np.errstate(divide="ignore", invalid="ignore"):
            along = (x * miss_u + y * miss_v) / np.where(r2 > 0, r2, 1.0) * (1 / slope - 1 / radial)
            step_x, step_y = miss_u / radial + x * along, miss_v / radial + y * along
        x, y = x + step_x, y + step_y
        if np.nanmax(np.abs(miss_u) + np.abs(miss_v)) < 1e-12:
            break
    good = (np.abs(miss_u) + np.abs(miss_v) < 1e-9)[..., None]
    return np.where(good, np.stack((x, y), axis=-1), np.nan)


def board_irradiance(camera: Camera, pose: BoardPose, board: Board) -> np.ndarray:
    """Compute the irradiance (height, width) of a checkerboard in DN, area-sampled at its edges, without blur."""
    rotation = camera.rotation @ pose.rotation
    translation = camera.rotation @ pose.translation_mm + camera.translation_mm
    homography = np.column_stack((rotation[:, 0], rotation[:, 1], translation))
    back = np.linalg.inv(homography) / board.pitch_mm
    window = _board_window(camera, pose, board)
    picture = np.full((camera.height, camera.width), board.surround_dn)
    rays = _rays(camera)[window]
    if min(rays.shape[:2]) < 2:
        return picture
    projective = np.dstack((rays, np.ones(rays.shape[:2]))) @ back.T
    with np.errstate(divide="ignore", invalid="ignore"):
        plane = projective[..., :2] / (projective[..., 2:] * board.pitch_mm)
    # Rays that meet the board's plane behind the camera see the surround.
    plane = np.where(np.isfinite(plane) & (projective[..., 2:] > 0), plane, 1e6)
    slope_u, slope_v = np.gradient(plane, axis=1), np.gradient(plane, axis=0)
    reach = np.abs(slope_u) + np.abs(slope_v)
    levels = _fine_levels(plane[..., 0], plane[..., 1], board)
    m = board.margin
    inside = (plane > -1 - m - reach) & (plane < np.array([board.columns, board.rows]) + m + reach)
    edges = np.abs(plane - np.round(plane)) < reach
    rims = (np.abs(plane + 1 + m) < reach) | (np.abs(plane - np.array([board.columns, board.rows]) - m) < reach)
    rows, columns = np.nonzero(inside.all(axis=-1) & (edges | rims).any(axis=-1))
    offsets = (np.arange(SUBPIXELS) + 0.5) / SUBPIXELS - 0.5
    total = np.zeros(len(rows))
    for du in offsets:
        for dv in offsets:
            x, y = (plane[rows, columns] + du * slope_u[rows, columns] + dv * slope_v[rows, columns]).T
            total += _fine_levels(x, y, board)
    levels[rows, columns] = total / SUBPIXELS**2
    picture[window] = levels
    return picture


def _board_window(camera: Camera, pose: BoardPose, board: Board) -> tuple[slice, slice]:
    """Return the rows and columns of the board's paper; the whole image where part of it cannot be projected."""
    m, along = board.margin, np.linspace(0.0, 1.0, 60)
    x, y = (-1 - m + (count + 1 + 2 * m) * along for count in (board.columns, board.rows))
    ends = [np.column_stack((x, np.full(60, edge))) for edge in y[[0, -1]]]
    ends += [np.column_stack((np.full(60, edge), y)) for edge in x[[0, -1]]]
    rim = np.column_stack((np.vstack(ends) * board.pitch_mm, np.zeros(240)))
    pixels = camera.project(rim @ pose.rotation.T + pose.translation_mm)
    size = np.array([camera.width, camera.height])
    if not np.isfinite(pixels).all():
        return slice(0, camera.height), slice(0, camera.width)
    # Between two of the 60 points an edge deviates by less than a pixel; gradients need two more.
    low = np.clip(np.floor(pixels.min(axis=0)) - 4, 0, size).astype(int)
    high = np.clip(np.ceil(pixels.max(axis=0)) + 5, 0, size).astype(int)
    return slice(low[1], high[1]), slice(low[0], high[0])


def render_board(camera: Camera, pose: BoardPose, board: Board, sensor: Sensor, seed: Sequence[int]) -> np.ndarray:
    """Render a picture of a checkerboard; its corners are at `camera.project` of the board's corners.

    Args:
        camera: the camera, in visible light: focal scale 1.
        pose: pose of the board to the left camera.
        board: the board.
        sensor: the sensor; in visible light its three colours respond equally.
        seed: whole numbers that identify view and camera.
    """
    import cv2

    light = board_irradiance(camera, pose, board)
    light *= ambient_level(camera.width, camera.height, 1.0, SHADING)
    light = cv2.GaussianBlur(light, (0, 0), sensor.blur_px) if sensor.blur_px > 0 else light
    return expose(light, replace(sensor, response=(1.0, 1.0, 1.0)), random_stream("board", *seed))


def board_poses(cameras: CameraPair, board: Board, views: int, seed: int) -> list[BoardPose]:
    """Draw poses as a careful user would take them: tilted up to 40 degrees, all over the common field of view.

    Raises:
        InputError: the board rarely fits into both images.
    """
    rng = random_stream("board", seed)
    corners = board.corners_mm()
    middle = corners.mean(axis=0)
    reach = np.array([board.columns, board.rows]) * board.pitch_mm
    rim = np.array([[x, y, 0.0] for x in (-board.pitch_mm, reach[0]) for y in (-board.pitch_mm, reach[1])])
    left, right, poses = cameras.left, cameras.right, []
    further = max(1.0, *(camera.matrix[1, 1] / (LENS * camera.height) for camera in (left, right)))
    for _ in range(200 * views):
        depth = rng.uniform(*DEPTHS_MM) * further
        aim = np.array([rng.uniform(0, left.width), rng.uniform(0, left.height), 1.0])
        tilt, heading, roll = rng.uniform(0, np.radians(TILT_MAX_DEG)), rng.uniform(0, 2 * np.pi), rng.normal(0, 0.15)
        turned = rotation_matrix(tilt * np.array([np.cos(heading), np.sin(heading), 0.0]))
        turned = turned @ rotation_matrix(np.array([0.0, 0.0, roll]))
        pose = BoardPose(turned, depth * np.linalg.solve(left.matrix, aim) - turned @ middle)
        pixels = np.hstack([c.project(rim @ pose.rotation.T + pose.translation_mm) for c in (left, right)])
        last = np.tile([left.width - 1, left.height - 1], 2)
        if np.isfinite(pixels).all() and ((pixels > BORDER_PX) & (pixels < last - BORDER_PX)).all():
            poses.append(pose)
            if len(poses) == views:
                return poses
    far = " to ".join(f"{depth * further:.0f}" for depth in DEPTHS_MM)
    size = f"a board of {reach[0]:g} x {reach[1]:g} mm"
    raise refusal(
        "boards",
        file="stereo.json",
        found=f"cameras that share little of their views: {size} fits into both images {len(poses)} of {views} times",
        allowed=f"cameras that both see the board at {far} mm",
        remedy="correct R and T, or simulate without --frames",
    )
