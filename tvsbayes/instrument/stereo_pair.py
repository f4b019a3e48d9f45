"""The calibrated camera pair: `stereo.json`, its 24 parameters with their covariance, distortion, triangulation.

OpenCV's names and frames: M, D of each camera, x_right = R x_left + T; mm, rad, px with the integer at the centre of a
pixel. Points come out in frame S (X depth, Y left, Z up, origin in the left camera's centre). NumPy.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from tvsbayes.errors import InputError, escaped, refusal, shown
from tvsbayes.files.disk import read_bytes, write_atomically
from tvsbayes.files.documents import JSON_BYTES_MAX, Keys, Kind, is_number, parse_json
from tvsbayes.instrument.parameters import STEREO_PARAMETER_NAMES

STEREO_FORMAT = "tvsbayes-stereo/1"
UNDISTORT_ITERATIONS = 200
UNDISTORT_TOLERANCE_PX = 1e-9
"""Largest error of distorting an undistorted pixel again: 10^4 times the rounding of 1000 px in float64."""


def distort(normalised: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """Apply Brown-Conrady k1 k2 p1 p2 k3 to normalised coordinates (n, 2)."""
    k1, k2, p1, p2, k3 = np.asarray(distortion, float).ravel()
    x, y = normalised.T
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    across = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    down = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.column_stack((across, down))


def undistort(pixels: np.ndarray, camera: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """Normalised coordinates (n, 2) of raw pixels (n, 2), iterated to convergence.

    The result is checked by distorting it again; NaN where it does not return to its pixel within
    `UNDISTORT_TOLERANCE_PX`. OpenCV's default of five iterations would leave tenths of a pixel.
    """
    pixels = np.ascontiguousarray(pixels, float).reshape(-1, 2)
    coefficients = np.asarray(distortion, float).reshape(1, 5)
    points = undistort_unchecked(pixels, camera, coefficients)
    returned = distort(points, coefficients) @ camera[:2, :2].T + camera[:2, 2]
    converged = np.max(np.abs(returned - pixels), axis=1) <= UNDISTORT_TOLERANCE_PX
    return np.where(converged[:, None], points, np.nan)


def undistort_unchecked(pixels: np.ndarray, camera: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """Normalised coordinates (n, 2) of raw pixels (n, 2), iterated by OpenCV, for any of its pinhole models."""
    import cv2

    # OpenCV compares the re-distorted point in px: 1e-12 is the rounding of the coordinate.
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, UNDISTORT_ITERATIONS, 1e-12)
    if hasattr(cv2, "undistortPointsIter"):  # OpenCV 4: undistortPoints takes no criteria in Python
        points = cv2.undistortPointsIter(pixels[:, None], camera, distortion, None, None, criteria)
    else:
        points = cv2.undistortPoints(pixels[:, None], camera, distortion, criteria=criteria)
    return points.reshape(-1, 2)


def triangulate(stereo: Stereo, pixels: np.ndarray, focal_scale: float = 1.0) -> np.ndarray:
    """Triangulate raw pixels (n, 4: u_left, v_left, u_right, v_right) to points (n, 3) in frame S, mm.

    Linear (DLT) triangulation of undistorted normalised coordinates with [I|0] and [R|T], as the paper;
    `focal_scale` multiplies fx and fy of both cameras. NaN rows where undistortion does not converge.
    """
    import cv2

    pixels = np.asarray(pixels, float).reshape(-1, 4)
    if len(pixels) == 0:
        return np.empty((0, 3))
    scale = np.array([[focal_scale, 1.0, 1.0], [1.0, focal_scale, 1.0], [1.0, 1.0, 1.0]])
    left = undistort(pixels[:, :2], stereo.M1 * scale, stereo.D1)
    right = undistort(pixels[:, 2:], stereo.M2 * scale, stereo.D2)
    finite = np.isfinite(left).all(axis=1) & np.isfinite(right).all(axis=1)
    points_S = np.full((len(pixels), 3), np.nan)
    if finite.any():
        first = np.hstack((np.eye(3), np.zeros((3, 1))))
        second = np.hstack((np.asarray(stereo.R, float), np.asarray(stereo.T, float).reshape(3, 1)))
        rays = left[finite].T.copy(), right[finite].T.copy()
        homogeneous = cv2.triangulatePoints(first, second, *rays).reshape(4, -1)
        x, y, z = homogeneous[:3] / homogeneous[3]
        points_S[finite] = np.column_stack((z, -x, -y))
    return points_S


def project_pair(stereo: Stereo, points_S_mm: np.ndarray) -> np.ndarray:
    """Raw pixels (n, 4: u_left, v_left, u_right, v_right) of points (n, 3) in frame S, mm: inverse of `triangulate`."""
    points = np.asarray(points_S_mm, float).reshape(-1, 3)
    left = np.column_stack((-points[:, 1], -points[:, 2], points[:, 0]))
    pixels = []
    for M, D, in_camera in ((stereo.M1, stereo.D1, left), (stereo.M2, stereo.D2, left @ stereo.R.T + stereo.T)):
        pixels.append(distort(in_camera[:, :2] / in_camera[:, 2:], D) @ M[:2, :2].T + M[:2, 2])
    return np.hstack(pixels)


@dataclass(frozen=True)
class Stereo:
    """A stereo calibration in OpenCV's convention, x_right = R x_left + T (formulation 3.3).

    `D1`, `D2` are k1 k2 p1 p2 k3. `parameter_covariance` orders the 24 parameters as
    `STEREO_PARAMETER_NAMES` (rotation as Rodrigues vector, rad; translation in mm).
    Where the covariance is `assumed`, `assumed_from` states its basis. Another size of the right camera's pictures is
    `right_image_size`, width and height; its parameters and pixels are those of pictures scaled to the left one's size.
    """

    image_width: int
    image_height: int
    M1: np.ndarray
    D1: np.ndarray
    M2: np.ndarray
    D2: np.ndarray
    R: np.ndarray
    T: np.ndarray
    parameter_covariance: np.ndarray
    rms_px: float
    assumed: bool = False
    assumed_from: str = ""
    right_image_size: tuple[int, int] | None = None

    @property
    def image_sizes(self) -> dict[str, tuple[int, int]]:
        """Width and height of the pictures of the left and of the right camera, as recorded."""
        size = self.image_width, self.image_height
        return {"left": size, "right": self.right_image_size or size}

    @property
    def vector(self) -> np.ndarray:
        """The 24 parameters, shape (24,), in the order of `STEREO_PARAMETER_NAMES`."""
        cameras = [(*M[[0, 1, 0, 1], [0, 1, 2, 2]], *D) for M, D in ((self.M1, self.D1), (self.M2, self.D2))]
        return np.array([*cameras[0], *cameras[1], *rotation_vector(self.R), *self.T])

    @classmethod
    def of_vector(cls, vector: np.ndarray, size: tuple[int, int], rms_px: float = 0.0) -> Stereo:
        """The pair with these parameters, exactly known.

        Args:
            vector: shape (24,), in the order of `STEREO_PARAMETER_NAMES`.
            size: image width and height, px.
            rms_px: rms over corners, as OpenCV defines it.
        """
        vector = np.asarray(vector, dtype=float)

        def matrix(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
            return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

        return cls(
            *size,
            M1=matrix(*vector[0:4]),
            D1=vector[4:9].copy(),
            M2=matrix(*vector[9:13]),
            D2=vector[13:18].copy(),
            R=rotation_matrix(vector[18:21]),
            T=vector[21:24].copy(),
            parameter_covariance=np.zeros((24, 24)),
            rms_px=rms_px,
        )

    def with_vector(self, vector: np.ndarray) -> Stereo:
        """The same rig with other parameters (24,); image size and covariance stay."""
        pair = Stereo.of_vector(vector, (self.image_width, self.image_height))
        return replace(self, M1=pair.M1, D1=pair.D1, M2=pair.M2, D2=pair.D2, R=pair.R, T=pair.T)


class WithStereo:
    """Base of what has a stereo pair or, of a head with sightings, None."""

    stereo: Stereo | None

    @property
    def has_images(self) -> bool:
        """Whether its looks are spots in images; else directions."""
        return self.stereo is not None

    @property
    def stereo_pair(self) -> Stereo:
        """Its stereo pair.

        Raises:
            InputError: it has none.
        """
        if self.stereo is None:
            raise no_stereo_pair()
        return self.stereo


def no_stereo_pair() -> InputError:
    """The refusal of sightings where spots and cameras are needed."""
    found, allowed = "sightings of a head, without cameras", "spots that a stereo pair sees"
    remedy = "give a campaign with stereo.json and spots.csv; `tvsbayes fit`, then `report`, show this one"
    return refusal("no-stereo", file="sightings.csv", found=found, allowed=allowed, remedy=remedy)


def stereo_parameters(stereo: Stereo | None) -> np.ndarray:
    """The 24 parameters; none of no pair."""
    return np.zeros(0) if stereo is None else stereo.vector


def stereo_covariance(stereo: Stereo | None) -> np.ndarray:
    """The covariance (24, 24) of the 24 parameters; (0, 0) of no pair."""
    return np.zeros((0, 0)) if stereo is None else np.asarray(stereo.parameter_covariance, float)


def rotation_matrix(rotation_vector_rad: np.ndarray) -> np.ndarray:
    """Rodrigues' formula, smooth through zero. `rotation_vector_rad` (3,) -> (3, 3)."""
    x, y, z = rotation_vector_rad
    angle = math.sqrt(x * x + y * y + z * z)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    # np.sinc(t / pi) = sin(t) / t, finite at 0; (1 - cos t) / t^2 = sinc(t / 2)^2 / 2.
    first, second = np.sinc(angle / np.pi), 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    return np.eye(3) + first * cross + second * cross @ cross


def rotation_vector(matrix: np.ndarray) -> np.ndarray:
    """The Rodrigues vector, rad, shape (3,), norm at most pi, of the rotation nearest to `matrix` (3, 3).

    Computed from the unit quaternion's largest component, which is accurate near 0 and near pi.
    """
    u, _, vt = np.linalg.svd(np.asarray(matrix, dtype=float))
    r = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    # Rows of 4 q q^T (w, x, y, z): the row with the largest diagonal avoids cancellation.
    products = np.array(
        [
            [1 + r[0, 0] + r[1, 1] + r[2, 2], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], 1 + r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
            [r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], 1 - r[0, 0] + r[1, 1] - r[2, 2], r[1, 2] + r[2, 1]],
            [r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], 1 - r[0, 0] - r[1, 1] + r[2, 2]],
        ]
    )
    q = products[np.argmax(np.diag(products))]
    q = q / np.linalg.norm(q) * (1.0 if q[0] >= 0 else -1.0)
    length = float(np.linalg.norm(q[1:]))
    return 2.0 * q[1:] if length < 1e-12 else q[1:] * (2.0 * math.atan2(length, q[0]) / length)


ASSUMED_REMEDY = (
    "calibrate from pictures (`tvsbayes stereo FOLDER`), or import again with --rms-px, --views, --board, --pitch-mm, "
    "--joint or --fixed-intrinsics, or with --u-focal-percent, --u-principal-px, --u-rotation-mrad, --u-baseline-mm"
)
"""Remedy for a pair whose covariance is assumed."""
_ENTRY_MAX = 1e12
_ROTATION_TOLERANCE = 1e-6
_EIGENVALUE_TOLERANCE = 1e-8
BESIDE_SHARE = 0.5
"""Least share of the baseline of two cameras side by side that lies along the columns of the first."""
PRINCIPAL_SHARE_MAX = 0.25
"""Largest distance of a principal point from the image centre without a remark, as a share of width or height."""
ASPECT_SHARE_MAX = 0.05
"""Largest deviation of fx / fy from 1 without a remark: pixels of present sensors are square."""
VIEW_DEG_MIN, VIEW_DEG_MAX, TURN_DEG_MAX = 2.0, 150.0, 20.0
"""Field of view of a lens described by five coefficients; largest angle between two cameras of one scene."""
SHAPE_SHARE_MAX = 0.005
"""Largest relative difference of the aspect ratios of two picture sizes: rounding to whole pixels."""
FOLD_MIN = 1e-12
"""Least coefficient of a radial distortion that can fold in a picture."""
FOCAL_TIMES_MAX = 1.5
"""Largest ratio of the focal lengths of two cameras of one kind."""
TANGENTIAL_MAX = 0.01
"""Largest p1 and p2: decentring of real lenses is about 1e-3."""
SHORTEST_BASELINE_MM, LONGEST_BASELINE_MM = 2.0, 10_000.0
"""Least and largest baseline. Two lenses cannot be closer, nor cameras on one rig farther apart. The longest baseline
in m is a smaller number than the least, and the shortest baseline in mm, read as m, is longer than the largest."""


def same_shape(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether pictures of two sizes, width and height, have the same aspect ratio."""
    return min(other) > 0 and abs(size[0] * other[1] / (size[1] * other[0]) - 1.0) <= SHAPE_SHARE_MAX


def scaled_px(pixels: np.ndarray, size: tuple[int, int], to: tuple[int, int]) -> np.ndarray:
    """Convert pixels (..., 2) of pictures of one size to pixels of the same pictures scaled to another size.

    The integer is at the centre of a pixel, so pictures begin at -1/2.
    """
    return (pixels + 0.5) * (to[0] / size[0]) - 0.5


def _matrix(keys: Keys, key: str, *shapes: tuple[int, ...]) -> np.ndarray:
    """The finite numbers under `key`, in one of `shapes`, returned in the first of them."""
    allowed = f"finite numbers in a list of {' or '.join('x'.join(map(str, shape)) for shape in shapes)}"
    value = keys.values.get(key)
    rows: list[Any] = value if isinstance(value, list) else [None]
    nested = bool(rows) and all(isinstance(row, list) for row in rows)
    entries = list(chain(*rows)) if nested else rows
    for entry in entries:
        if not (is_number(entry) and abs(entry) <= _ENTRY_MAX):
            found = shown(entry) if isinstance(value, list) else None
            raise keys.refuse(key, "matrix", allowed, "one list per row, every entry a number", found)
    lengths = {len(row) for row in rows} if nested else {0}
    shape = (len(rows), *lengths) if nested else (len(rows),)
    if shape not in shapes:
        found = "rows of different lengths" if len(lengths) != 1 else "x".join(map(str, shape))
        raise keys.refuse(key, "shape", allowed, "write OpenCV's matrix, one list per row", found)
    return np.array(entries, dtype=float).reshape(shapes[0])


def _camera_matrix(keys: Keys, key: str) -> np.ndarray:
    matrix = _matrix(keys, key, (3, 3))
    pattern_holds = np.array_equal(matrix[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]], [0, 0, 0, 0, 1])
    if not (pattern_holds and matrix[0, 0] > 0 and matrix[1, 1] > 0):
        allowed, found = "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0, px", json.dumps(matrix.tolist())
        remedy = "give OpenCV's camera matrix without skew"
        raise keys.refuse(key, "camera-matrix", allowed, remedy, escaped(found, 120))
    return matrix


def _rotation(keys: Keys, key: str) -> np.ndarray:
    rotation = _matrix(keys, key, (3, 3))
    deviation = max(np.abs(rotation @ rotation.T - np.eye(3)).max(), abs(np.linalg.det(rotation) - 1.0))
    if deviation > _ROTATION_TOLERANCE:
        allowed = f"R R^T = 1 and det R = +1 to {_ROTATION_TOLERANCE:g}"
        found = f"a matrix that misses it by {deviation:.3g}"
        raise keys.refuse(key, "rotation", allowed, "give R of x_right = R x_left + T, all digits", found)
    return rotation


def _translation(keys: Keys, key: str) -> np.ndarray:
    translation = _matrix(keys, key, (3,), (3, 1))
    if not 0 < np.linalg.norm(translation) <= 1e5:
        allowed = "a translation longer than 0 and at most 100000 mm"
        raise keys.refuse(key, "translation", allowed, "give T in mm", escaped(str(translation.tolist())))
    return translation


def _covariance(keys: Keys, key: str) -> np.ndarray:
    """A matrix that is symmetric and positive semi-definite once each row is scaled by its standard deviation."""

    def refusal(found: str) -> InputError:
        allowed = "a symmetric positive semi-definite 24x24 matrix; a zero row fixes a parameter"
        return keys.refuse(key, "covariance", allowed, "take it from the calibration of M, D, R, T", found)

    covariance = _matrix(keys, key, (24, 24))
    variances = np.diag(covariance)
    if (variances < 0).any():
        name = STEREO_PARAMETER_NAMES[int(np.argmin(variances))]
        raise refusal(f"the negative variance {variances.min():.6g} of {name}")
    free = variances > 0
    if covariance[~free].any() or covariance[:, ~free].any():
        raise refusal("a covariance with a parameter of variance 0")
    sds = np.sqrt(variances[free])
    with np.errstate(over="ignore"):
        correlation = covariance[np.ix_(free, free)] / sds[:, None] / sds[None, :]
    if not (np.abs(correlation) <= 1 + 1e-6).all():
        raise refusal(f"a correlation of {np.abs(correlation).max():.6g}")
    if not (np.abs(correlation - correlation.T) <= 1e-9).all():
        raise refusal("a matrix that is not symmetric")
    smallest = float(np.linalg.eigvalsh(correlation).min()) if free.any() else 0.0
    if smallest < -_EIGENVALUE_TOLERANCE:
        raise refusal(f"a smallest eigenvalue of {smallest:.3g} of the correlation matrix")
    return covariance


_DISTORTION = _matrix, (5,), (1, 5), (5, 1)
_KEYS: dict[str, Kind] = {
    **dict.fromkeys(("image_width", "image_height"), (Keys.integer, 1, 65_535)),
    **{"M1": _camera_matrix, "D1": _DISTORTION, "M2": _camera_matrix, "D2": _DISTORTION},
    **{"R": _rotation, "T": _translation, "parameter_covariance": _covariance, "rms_px": (Keys.number, 0.0, 1e4)},
    **{"assumed": Keys.flag, "assumed_from": (Keys.text, 400), "right_image_size": (_matrix, (2,))},
}
"""Keys of `stereo.json`, the fields of `Stereo`."""
_OPTIONAL = ("assumed", "assumed_from", "right_image_size")


def parse_stereo(data: bytes, file: str) -> Stereo:
    """A checked stereo calibration from the bytes of `stereo.json`; see `read_stereo`."""
    keys = parse_json(data, file)
    entries = keys.document(STEREO_FORMAT, _KEYS, (key for key in _KEYS if key not in _OPTIONAL))
    size = entries["image_width"], entries["image_height"]
    if "right_image_size" in entries:
        entries["right_image_size"] = right_size = tuple(entries["right_image_size"].astype(int).tolist())
        if not same_shape(size, right_size):
            allowed = f"width and height in the proportion of {size[0]} to {size[1]} px"
            raise keys.refuse("right_image_size", "image-size", allowed, "calibrate at sizes of one proportion")
    return Stereo(**entries)


def read_stereo(path: Path, folder: Path | None = None) -> Stereo:
    """Read `stereo.json` (format tvsbayes-stereo/1).

    Args:
        path: the file.
        folder: where given, the file must lie inside it after following links.

    Raises:
        InputError: unreadable, wrong shapes, R is no rotation, an invalid covariance, unknown keys.
    """
    return parse_stereo(read_bytes(path, JSON_BYTES_MAX, folder), escaped(Path(path).name))


def stereo_bytes(stereo: Stereo) -> bytes:
    """The content of `stereo.json`, one matrix row per line, every digit kept.

    Raises:
        InputError: `read_stereo` would refuse the pair.
    """
    lines = [f' "format": {json.dumps(STEREO_FORMAT)}']
    for key in _KEYS:
        value = getattr(stereo, key)
        if key in ("assumed_from", "right_image_size") and not value:
            continue
        plain = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
        rows = ",\n  ".join(map(json.dumps, plain)) if np.ndim(value) == 2 else ""
        lines.append(f' "{key}": ' + (f"[\n  {rows}]" if rows else json.dumps(plain)))
    data = ("{\n" + ",\n".join(lines) + "\n}\n").encode()
    parse_stereo(data, "stereo.json")
    return data


def write_stereo(stereo: Stereo, path: Path) -> None:
    """Write `stereo.json` atomically; `read_stereo` returns the same numbers."""
    write_atomically(path, stereo_bytes(stereo))


def baseline_doubt(stereo: Stereo, place: str = "T of stereo.json") -> str | None:
    """The doubt that T (`place`, in words) is in another unit; None where its length in mm is possible for a pair."""
    baseline_mm = float(np.linalg.norm(stereo.T))
    if baseline_mm < SHORTEST_BASELINE_MM:
        return f"{place} is {baseline_mm:.3g} mm long: is it in metres? Lengths are mm"
    if baseline_mm > LONGEST_BASELINE_MM:
        length = f"{place} is {baseline_mm / 1000:.3g} m long"
        return f"{length}: was it in mm before it was taken for metres? Lengths are mm"
    return None


def fold_radius(distortion: np.ndarray) -> float:
    """Tangent of the angle off the axis from which the radial distortion is not monotonic; infinite if it is.

    Smallest positive root of d/dr of r (1 + k1 r^2 + k2 r^4 + k3 r^6).
    """
    k1, k2, _, _, k3 = np.asarray(distortion, float).ravel()
    # Smaller coefficients would fold at 1e4 and beyond, and overflow.
    roots = np.roots(np.where(np.abs(series := np.array([7 * k3, 5 * k2, 3 * k1, 1.0])) < FOLD_MIN, 0.0, series))
    real = [root.real for root in roots if abs(root.imag) < 1e-9 * abs(root) and root.real > 0]
    return math.sqrt(min(real)) if real else math.inf


def _lens_doubts(
    matrix: np.ndarray, distortion: np.ndarray, size_px: tuple[int, int], side: str, matrix_place: str, place: str
) -> list[str]:
    """Doubts about a camera whose numbers do not fit any usual lens; `place` is that of the distortion."""
    (fx, fy), centre_px = matrix[[0, 1], [0, 1]], matrix[:2, 2]
    k1, k2, p1, p2, k3 = np.asarray(distortion, float).ravel()
    off_px, size = np.abs(centre_px - (np.array(size_px) - 1) / 2), f"{size_px[0]} x {size_px[1]} px"
    # Integer = centre of a pixel: the image extends from -0.5 to its size - 0.5.
    is_outside, is_far = (bool((off_px > share * np.array(size_px)).any()) for share in (0.5, PRINCIPAL_SHARE_MAX))
    point = f"the {side} principal point ({centre_px[0]:.0f}, {centre_px[1]:.0f}) px"
    view_deg = 2 * math.degrees(math.atan(size_px[0] / 2 / fx))
    corners = np.array([[x, y] for x in (0, size_px[0] - 1) for y in (0, size_px[1] - 1)], float)
    corner = float(np.linalg.norm((corners - centre_px) / (fx, fy), axis=1).max())
    fold = fold_radius(distortion)
    folds = fold < math.inf and fold * (1 + k1 * fold**2 + k2 * fold**4 + k3 * fold**6) < corner
    doubts = {
        f"{point} lies outside the image of {size}: is that its size?": is_outside,
        f"{point} is far from the middle of the image of {size}: is that its size?": is_far and not is_outside,
        f"the {side} fx and fy differ by {100 * abs(fx / fy - 1):.0f} %: pixels are nearly square": (
            abs(fx / fy - 1) > ASPECT_SHARE_MAX
        ),
        f"fx in {matrix_place} is {fx:.4g} px: a view of {view_deg:.0f} deg, which no such lens has": (
            view_deg > VIEW_DEG_MAX
        ),
        f"fx in {matrix_place} is {fx:.4g} px: a view of {view_deg:.2g} deg: is it in px?": view_deg < VIEW_DEG_MIN,
        f"{place} (k1 {k1:.3g}, k2 {k2:.3g}, k3 {k3:.3g}) folds inside the picture, at r = {fold:.2f} "
        f"({math.degrees(math.atan(fold)):.0f} deg off the axis; the corner is at r = {corner:.2f}): pixels beyond "
        "belong to no ray or to two; calibrate again with boards up to the corners, or with --fix-k3": folds,
        f"{place} has p1 {p1:.3g}, p2 {p2:.3g}: is it a fisheye (equidistant) model under another name?": (
            max(abs(p1), abs(p2)) > TANGENTIAL_MAX
        ),
    }
    return [sentence for sentence, holds in doubts.items() if holds]


def pair_doubts(stereo: Stereo, places: Mapping[str, str] | None = None) -> tuple[str, ...]:
    """Contradictions to two cameras side by side with one scene, in words; empty if none.

    They are doubts, not errors: mirrors, cropped images and lenses off their axes exist. Detected are exchanged
    cameras, a wrong image size, pixels far from square, views near 180 deg, distortion that folds, T in another unit.

    Args:
        stereo: the pair.
        places: file and key of M1, D1, M2, D2, R, T, in words; where absent, those of `stereo.json`.
    """
    place = {name: f"{name} of stereo.json" for name in ("M1", "D1", "M2", "D2", "R", "T")} | dict(places or {})
    turn_deg = math.degrees(float(np.linalg.norm(rotation_vector(stereo.R))))
    # Position of the second camera in axes of the first: x to the right, as picture columns increase.
    right_mm, below_mm, before_mm = (-stereo.R.T @ stereo.T).tolist()
    short_px, long_px = sorted((float(stereo.M1[0, 0]), float(stereo.M2[0, 0])))
    doubts = {
        f"{place['R']} turns by {turn_deg:.0f} deg: do both cameras look at one scene?": turn_deg > TURN_DEG_MAX,
        f"the second camera stands {-right_mm:.4g} mm to the left of the first (x_right = R x_left + T with T_x = "
        f"{stereo.T[0]:+.4g} mm): are left and right swapped?": right_mm < 0,
        f"{place['T']} puts the second camera {below_mm:+.4g} mm below and {before_mm:+.4g} mm before the first, and "
        f"only {right_mm:+.4g} mm to the right: is it in axes of another frame, or the inverse of a pose?": (
            abs(right_mm) < BESIDE_SHARE * float(np.linalg.norm(stereo.T))
        ),
        f"fx of the two cameras are {short_px:.4g} and {long_px:.4g} px ({place['M1']}, {place['M2']}): are they of "
        "pictures of two sizes?": long_px > FOCAL_TIMES_MAX * short_px,
    }
    pair = (sentence for sentence, holds in doubts.items() if holds)
    size_px = stereo.image_width, stereo.image_height
    left = _lens_doubts(stereo.M1, stereo.D1, size_px, "left", place["M1"], place["D1"])
    right = _lens_doubts(stereo.M2, stereo.D2, size_px, "right", place["M2"], place["D2"])
    return (*filter(None, [baseline_doubt(stereo, place["T"])]), *pair, *left, *right)
