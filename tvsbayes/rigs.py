"""The instrument as declared: parameter names and priors, rig files, and the stereo pair with its calibration.

Frames and units: DESIGN section 2. mm, degrees where a name says `_deg`, radians where it says `_rad`, image px with
the integer at the centre of a pixel. Stereo in OpenCV's conventions: camera axes x right, y down, z along the view;
x_right = R x_left + T; Rodrigues vectors (DESIGN 3.3 and 7). No JAX.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path, PureWindowsPath
from typing import Literal

import numpy as np

from tvsbayes.files import (
    JSON_BYTES_MAX,
    TOML_BYTES_MAX,
    InputError,
    Keys,
    closest,
    escaped,
    parse_json,
    parse_toml,
    read_bytes,
    shown,
    toml_line,
    write_atomically,
)

STEREO_PARAMETER_NAMES: tuple[str, ...] = (
    *(f"stereo.left.{p}" for p in ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")),
    *(f"stereo.right.{p}" for p in ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")),
    *(f"stereo.rotation_rad.{a}" for a in "xyz"),
    *(f"stereo.translation_mm.{a}" for a in "xyz"),
)
"""The 24 stereo parameters in the order of `parameter_covariance` (DESIGN 7)."""


@dataclass(frozen=True)
class Stereo:
    """A stereo calibration in OpenCV's convention: x_right = R x_left + T (DESIGN 3.3 and 7).

    `D1`, `D2` are k1 k2 p1 p2 k3. `parameter_covariance` orders the 24 parameters as
    `STEREO_PARAMETER_NAMES` (rotation as Rodrigues vector, rad; translation in mm).
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

    @property
    def vector(self) -> np.ndarray:
        """The 24 parameters, shape (24,), in the order of `STEREO_PARAMETER_NAMES`."""
        cameras = [(*M[[0, 1, 0, 1], [0, 1, 2, 2]], *D) for M, D in ((self.M1, self.D1), (self.M2, self.D2))]
        return np.array([*cameras[0], *cameras[1], *rotation_vector(self.R), *self.T])

    def with_vector(self, vector: np.ndarray) -> Stereo:
        """The same rig with other parameters; image size and covariance stay.

        Args:
            vector: shape (24,), in the order of `STEREO_PARAMETER_NAMES`.
        """
        vector = np.asarray(vector, dtype=float)

        def matrix(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
            return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

        return replace(
            self,
            M1=matrix(*vector[0:4]),
            D1=vector[4:9].copy(),
            M2=matrix(*vector[9:13]),
            D2=vector[13:18].copy(),
            R=rotation_matrix(vector[18:21]),
            T=vector[21:24].copy(),
        )


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

    Through the unit quaternion's largest component, so it is accurate at 0 and at pi alike.
    """
    u, _, vt = np.linalg.svd(np.asarray(matrix, dtype=float))
    r = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    # Rows of 4 q q^T (w, x, y, z): the one with the largest diagonal is far from cancellation.
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


_STEREO_KEYS = (
    *("format", "image_width", "image_height", "M1", "D1", "M2", "D2", "R", "T"),
    *("parameter_covariance", "rms_px", "assumed"),
)
_ENTRY_MAX = 1e12
_ROTATION_TOLERANCE = 1e-6
_EIGENVALUE_TOLERANCE = 1e-8
PRINCIPAL_SHARE_MAX = 0.25
"""Share of the image's width or height by which a principal point may miss its middle before it is worth a word."""
ASPECT_SHARE_MAX = 0.05
"""The same of fx / fy from 1: pixels of today's sensors are square."""


def _array(keys: Keys, key: str, *shapes: tuple[int, ...]) -> np.ndarray:
    """The finite numbers under `key`, in one of `shapes`, returned in the first of them."""
    wanted = " or ".join("x".join(map(str, shape)) for shape in shapes)
    allowed = f"finite numbers in a list of {wanted}"
    value = keys.values.get(key)
    rows = value if isinstance(value, list) else [None]
    nested = bool(rows) and all(isinstance(row, list) for row in rows)
    entries = [entry for row in rows for entry in row] if nested else rows
    for entry in entries:
        if isinstance(entry, bool) or not isinstance(entry, int | float) or not abs(entry) <= _ENTRY_MAX:
            found = shown(entry) if isinstance(value, list) else None
            raise keys.refuse(key, "matrix", allowed, "one list per row, every entry a number", found)
    lengths = {len(row) for row in rows} if nested else {0}
    shape = (len(rows), *lengths) if nested else (len(rows),)
    if len(lengths) != 1 or shape not in shapes:
        found = "rows of different lengths" if len(lengths) != 1 else "x".join(map(str, shape))
        raise keys.refuse(key, "shape", allowed, "write OpenCV's matrix, one list per row", found)
    return np.array(entries, dtype=float).reshape(shapes[0])


def _camera_matrix(keys: Keys, key: str) -> np.ndarray:
    matrix = _array(keys, key, (3, 3))
    pattern_holds = np.array_equal(matrix[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]], [0, 0, 0, 0, 1])
    if not (pattern_holds and matrix[0, 0] > 0 and matrix[1, 1] > 0):
        allowed = "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0, px"
        found = escaped(json.dumps(matrix.tolist()), 120)
        raise keys.refuse(key, "camera-matrix", allowed, "give OpenCV's camera matrix without skew", found)
    return matrix


def _check_covariance(keys: Keys, key: str, covariance: np.ndarray) -> None:
    """Symmetric and positive semi-definite after scaling each row by its standard deviation."""
    allowed = "a symmetric positive semi-definite 24x24 matrix; a zero row fixes a parameter"

    def bad(found: str) -> InputError:
        return keys.refuse(key, "covariance", allowed, "take it from the calibration of M, D, R, T", found)

    variances = np.diag(covariance)
    if (variances < 0).any():
        name = STEREO_PARAMETER_NAMES[int(np.argmin(variances))]
        raise bad(f"the negative variance {variances.min():.6g} of {name}")
    free = variances > 0
    if covariance[~free].any() or covariance[:, ~free].any():
        raise bad("a covariance with a parameter of variance 0")
    sds = np.sqrt(variances[free])
    with np.errstate(over="ignore"):
        correlation = covariance[np.ix_(free, free)] / sds[:, None] / sds[None, :]
    if not (np.abs(correlation) <= 1 + 1e-6).all():
        raise bad(f"a correlation of {np.abs(correlation).max():.6g}")
    if not (np.abs(correlation - correlation.T) <= 1e-9).all():
        raise bad("a matrix that is not symmetric")
    smallest = float(np.linalg.eigvalsh(correlation).min()) if free.any() else 0.0
    if smallest < -_EIGENVALUE_TOLERANCE:
        raise bad(f"a smallest eigenvalue of {smallest:.3g} of the correlation matrix")


def parse_stereo(data: bytes, file: str) -> Stereo:
    """A checked stereo calibration from the bytes of `stereo.json`; see `read_stereo`."""
    keys = parse_json(data, file)
    keys.word("format", ("tvsbayes-stereo/1",))
    keys.only(_STEREO_KEYS)
    width, height = keys.integer("image_width", 1, 65_535), keys.integer("image_height", 1, 65_535)
    rotation = _array(keys, "R", (3, 3))
    deviation = max(np.abs(rotation @ rotation.T - np.eye(3)).max(), abs(np.linalg.det(rotation) - 1.0))
    if deviation > _ROTATION_TOLERANCE:
        allowed = f"R R^T = 1 and det R = +1 to {_ROTATION_TOLERANCE:g}"
        found = f"a matrix that misses it by {deviation:.3g}"
        raise keys.refuse("R", "rotation", allowed, "give R of x_right = R x_left + T, all digits", found)
    translation = _array(keys, "T", (3,), (3, 1))
    if not 0 < np.linalg.norm(translation) <= 1e5:
        allowed = "a translation longer than 0 and at most 100000 mm"
        raise keys.refuse("T", "translation", allowed, "give T in mm", escaped(str(translation.tolist())))
    covariance = _array(keys, "parameter_covariance", (24, 24))
    _check_covariance(keys, "parameter_covariance", covariance)
    return Stereo(
        image_width=width,
        image_height=height,
        M1=_camera_matrix(keys, "M1"),
        D1=_array(keys, "D1", (5,), (1, 5), (5, 1)),
        M2=_camera_matrix(keys, "M2"),
        D2=_array(keys, "D2", (5,), (1, 5), (5, 1)),
        R=rotation,
        T=translation,
        parameter_covariance=covariance,
        rms_px=keys.number("rms_px", 0.0, 1e4),
        assumed="assumed" in keys and keys.flag("assumed"),
    )


def read_stereo(path: Path, folder: Path | None = None) -> Stereo:
    """Reads `stereo.json` (format tvsbayes-stereo/1, DESIGN 7).

    Args:
        path: the file.
        folder: where given, the file must lie inside it after following links.

    Raises:
        InputError: unreadable, wrong shapes, no rotation, a covariance that is none, unknown keys.
    """
    return parse_stereo(read_bytes(path, JSON_BYTES_MAX, folder), escaped(Path(path).name))


def stereo_bytes(stereo: Stereo) -> bytes:
    """The content of `stereo.json`, one matrix row per line, every digit kept.

    Raises:
        InputError: `stereo` holds what `read_stereo` would refuse.
    """
    lines = []
    for key in _STEREO_KEYS:
        value = "tvsbayes-stereo/1" if key == "format" else getattr(stereo, key)
        if isinstance(value, np.ndarray) and value.ndim == 2:
            rows = ",\n  ".join(json.dumps(row) for row in value.tolist())
            lines.append(f' "{key}": [\n  {rows}]')
        else:
            plain = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
            lines.append(f' "{key}": {json.dumps(plain)}')
    data = ("{\n" + ",\n".join(lines) + "\n}\n").encode()
    parse_stereo(data, "stereo.json")
    return data


def pair_doubts(stereo: Stereo) -> tuple[str, ...]:
    """What contradicts two cameras beside each other that look at one scene, in words; empty where nothing does.

    No refusal: mirrors, cropped images and lenses off their axes exist. Seen are cameras exchanged, an image size that
    belongs to other pictures, pixels far from square.
    """
    doubts = []
    # Where the second camera stands, in axes of the first: x to the right, as columns of a picture grow.
    right_mm = -float(stereo.R[:, 0] @ stereo.T)
    if right_mm < 0:
        doubts.append(
            f"the second camera stands {-right_mm:.4g} mm to the left of the first (x_right = R x_left + T with T_x = "
            f"{stereo.T[0]:+.4g} mm): are left and right swapped?"
        )
    size_px = stereo.image_width, stereo.image_height
    for side, matrix in (("left", stereo.M1), ("right", stereo.M2)):
        centre_px = float(matrix[0, 2]), float(matrix[1, 2])
        point = f"the {side} principal point ({centre_px[0]:.0f}, {centre_px[1]:.0f}) px"
        # Integer = centre of a pixel: the image reaches from -0.5 to its size - 0.5.
        if not all(-0.5 <= c <= n - 0.5 for c, n in zip(centre_px, size_px, strict=True)):
            doubts.append(f"{point} lies outside the image of {size_px[0]} x {size_px[1]} px: is that its size?")
        elif any(abs(c - (n - 1) / 2) > PRINCIPAL_SHARE_MAX * n for c, n in zip(centre_px, size_px, strict=True)):
            doubts.append(
                f"{point} is far from the middle of the image of {size_px[0]} x {size_px[1]} px: is that its size?"
            )
        fx, fy = float(matrix[0, 0]), float(matrix[1, 1])
        if abs(fx / fy - 1) > ASPECT_SHARE_MAX:
            doubts.append(f"the {side} fx and fy differ by {100 * abs(fx / fy - 1):.0f} %: pixels are seldom so oblong")
    return tuple(doubts)


def write_stereo(stereo: Stereo, path: Path) -> None:
    """Writes `stereo.json` atomically; `read_stereo` gives back the same numbers."""
    write_atomically(path, stereo_bytes(stereo))


Distribution = Literal["normal", "half-normal", "log-normal"]


@dataclass(frozen=True, slots=True)
class Prior:
    """One parameter's state of knowledge before the spots (DESIGN 3.2 and 7).

    `value` and `u` mean: normal: mean and standard uncertainty; half-normal: 0 and scale;
    log-normal: median and standard deviation of the logarithm. `u = 0` fixes the parameter.
    """

    value: float
    u: float
    distribution: Distribution = "normal"


DEFAULT_PRIORS: dict[str, Prior] = {
    "degrees_per_step.pan": Prior(0.06, 0.01),
    "degrees_per_step.tilt": Prior(0.07, 0.01),
    "ratio_contrast_deg_per_step.pan": Prior(0.0, 2e-4),
    "ratio_contrast_deg_per_step.tilt": Prior(0.0, 2e-4),
    "backlash_deg.pan": Prior(0.0, 0.5, "half-normal"),
    "backlash_deg.tilt": Prior(0.0, 0.5, "half-normal"),
    "tilt_zero_deg": Prior(0.0, 2.0),
    "mirror_offset_mm": Prior(30.0, 5.0),
    "mirror1_error_deg": Prior(0.0, 0.5),
    "mirror2_error_deg": Prior(0.0, 0.5),
    "laser_tilt_deg.x": Prior(0.0, 0.5),
    "laser_tilt_deg.y": Prior(0.0, 0.5),
    "laser_offset_mm.x": Prior(0.0, 0.5),
    "laser_offset_mm.y": Prior(0.0, 0.5),
    "tilt_axis_skew_deg": Prior(0.0, 0.5),
    "tilt_axis_offset_mm.x": Prior(0.0, 0.5),
    "tilt_axis_offset_mm.z": Prior(0.0, 0.5),
    "extrinsics.rotation_rad.x": Prior(0.0, 0.5),
    "extrinsics.rotation_rad.y": Prior(0.0, 0.5),
    "extrinsics.rotation_rad.z": Prior(0.0, 0.5),
    "extrinsics.translation_mm.x": Prior(0.0, 100.0),
    "extrinsics.translation_mm.y": Prior(0.0, 100.0),
    "extrinsics.translation_mm.z": Prior(0.0, 100.0),
    "stop_sd_deg.left": Prior(0.04, 1.0, "log-normal"),
    "stop_sd_deg.right": Prior(0.04, 1.0, "log-normal"),
    "stop_sd_deg.up": Prior(0.04, 1.0, "log-normal"),
    "stop_sd_deg.down": Prior(0.04, 1.0, "log-normal"),
    "pixel_scale": Prior(1.0, 0.5, "log-normal"),
}
"""Priors that `[rig.prior]` may replace, in the order of the parameter vector (DESIGN 3.2)."""

DECLARED_PRIORS: dict[str, Prior] = {
    "focal_scale": Prior(1.0, 0.002),
    "baseline_mm": Prior(200.0, 0.1),
    "pan_zero_emission_deg": Prior(90.0, 0.2),
    "aperture_zero_deg": Prior(0.0, 0.1),
    "aperture_sd_deg": Prior(0.02, 0.0, "log-normal"),
}
"""Entries of `[rig]` itself, with the defaults of DESIGN 7."""

HARMONIC_ORDERS = (1, 2)
HARMONIC_PRIORS: dict[str, Prior] = {
    f"harmonic_deg.{axis}.{order}.{part}": Prior(0.0, 0.0)
    for axis in ("pan", "tilt")
    for order in HARMONIC_ORDERS
    for part in ("cos", "sin")
}
"""Transmission error by axis, order and phase, part of `[rig.prior]` (DESIGN 3.1); none unless asked for."""

RIG_PRIORS: dict[str, Prior] = {**DEFAULT_PRIORS, **DECLARED_PRIORS, **HARMONIC_PRIORS}
"""Every prior of a rig with its default, in the order of the parameter vector."""

FULL_TURN_DEG = 360.0
"""Period of the wheel (the output member); a shorter one is the pinion's."""

HOME_SD_DEG = 0.05
"""Standard deviation of the home offset of every segment after the first (DESIGN 3.2, fixed)."""


@dataclass(frozen=True)
class RigTable:
    """The `[rig]` table of a campaign or rig file: every prior the estimators use.

    `priors` maps every name of `RIG_PRIORS` to its `Prior`; names left out take the default.
    `harmonic_period_deg` maps "pan" and "tilt", where declared, to the period of the transmission error in
    degrees of the output: `FULL_TURN_DEG` for the wheel, less for the pinion.

    Raises:
        InputError: harmonics of an axis without a period.
    """

    priors: dict[str, Prior] = field(default_factory=dict)
    aperture_convention: Literal["in-plane", "azimuth"] = "in-plane"
    harmonic_period_deg: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "priors", {**RIG_PRIORS, **self.priors})
        require_periods(self.priors, self.harmonic_period_deg)


@dataclass(frozen=True)
class Rig:
    """A rig file: the declared rig, its stereo calibration and how it is driven (DESIGN 7).

    `truth` is the distribution from which `simulate` and `study` draw true rigs (complete: names absent
    from `[truth]` take the prior). `sheets_mm` gives the nominal X of each named target in frame S.
    `positioner`, `cameras`, `costs_s` are the remaining tables, checked but otherwise as written (defaults
    filled in for `cameras["spot_sd_px"]`, the standard uncertainty stated for simulated spots, and for the
    costs). `header` holds name and notes.
    """

    table: RigTable
    stereo: Stereo
    truth: dict[str, Prior]
    sheets_mm: dict[str, float]
    positioner: dict[str, object]
    cameras: dict[str, object]
    costs_s: dict[str, float]
    path: Path | None = None
    header: dict[str, str] = field(default_factory=dict)


# Lowest and highest value and highest standard uncertainty by the first part of a name. Wide: they catch
# a wrong unit or a slipped key, not an unusual instrument.
_RANGES: dict[str, tuple[float, float, float]] = {
    "degrees_per_step": (1e-6, 10.0, 10.0),
    "ratio_contrast_deg_per_step": (-1.0, 1.0, 1.0),
    "backlash_deg": (0.0, 0.0, 45.0),
    "tilt_zero_deg": (-90.0, 90.0, 180.0),
    "mirror_offset_mm": (-1000.0, 1000.0, 1000.0),
    "mirror1_error_deg": (-30.0, 30.0, 30.0),
    "mirror2_error_deg": (-30.0, 30.0, 30.0),
    "laser_tilt_deg": (-30.0, 30.0, 30.0),
    "laser_offset_mm": (-100.0, 100.0, 100.0),
    "tilt_axis_skew_deg": (-30.0, 30.0, 30.0),
    "tilt_axis_offset_mm": (-100.0, 100.0, 100.0),
    "extrinsics": (-1e5, 1e5, 1e5),
    "stop_sd_deg": (1e-6, 10.0, 5.0),
    "pixel_scale": (1e-3, 1e3, 5.0),
    "focal_scale": (0.5, 2.0, 0.5),
    "baseline_mm": (1.0, 1e5, 1e4),
    "pan_zero_emission_deg": (0.0, 180.0, 180.0),
    "aperture_zero_deg": (-180.0, 180.0, 180.0),
    "aperture_sd_deg": (1e-6, 10.0, 5.0),
    "harmonic_deg": (-10.0, 10.0, 10.0),
}
_PRIOR_NAMES = (*DEFAULT_PRIORS, *HARMONIC_PRIORS)
_PERIOD_NAMES = {f"harmonic_period_deg.{axis}": axis for axis in ("pan", "tilt")}
_PERIOD_MIN_DEG = 1e-6
_GROUPS = {name.rsplit(".", n)[0] for name in (*RIG_PRIORS, *_PERIOD_NAMES, *STEREO_PARAMETER_NAMES) for n in (1, 2, 3)}


def _harmonic_without_period(priors: Mapping[str, Prior], period_deg: Mapping[str, float]) -> str | None:
    """The first harmonic that is not fixed at 0 on an axis whose period nobody stated."""
    for name in HARMONIC_PRIORS:
        prior = priors.get(name)
        if prior is not None and (prior.value != 0 or prior.u != 0) and name.split(".")[1] not in period_deg:
            return name
    return None


def _period_remedy(name: str) -> str:
    axis = name.split(".")[1]
    return (
        f'add "harmonic_period_deg.{axis}" = {{ value = P, u = 0.0 }} to [rig]: degrees of the output per turn of the '
        f"faulty member, {FULL_TURN_DEG:g} for the wheel, {FULL_TURN_DEG:g} x teeth of the pinion / teeth of the wheel "
        "for the pinion"
    )


def require_periods(priors: Mapping[str, Prior], period_deg: Mapping[str, float]) -> None:
    """Refuse harmonics whose period is unknown: they would be an error at no known angle.

    Raises:
        InputError: a harmonic with a value or u other than 0 on an axis without a period.
    """
    name = _harmonic_without_period(priors, period_deg)
    if name is not None:
        message = f"{name} has no period"
        raise InputError("missing-period", message, column=name, remedy=_period_remedy(name))


def _explanation(name: str, allowed: tuple[str, ...]) -> str:
    """What to do about a name that may not stand where it does."""
    stem, _, last = name.partition(".")
    if name in _PERIOD_NAMES:
        return "it belongs into [rig] itself: tooth counts fix it, so it has no prior and no other truth"
    if name in _PRIOR_NAMES:
        return "it belongs into [rig.prior]"
    if stem == "degrees_per_step" and last in ("left", "right", "up", "down"):
        axis = "pan" if last in ("left", "right") else "tilt"
        return f"it is derived: state degrees_per_step.{axis} and ratio_contrast_deg_per_step.{axis}"
    if stem == "effective_mirror_offset_mm":
        return "it is derived: state mirror_offset_mm"
    if stem == "stereo":
        return "stereo parameters and their covariance come from stereo.json"
    return closest(name, allowed)


def _entries(table: Keys, prefix: str = "") -> Iterator[tuple[Keys, str, str]]:
    """Every entry as (its table, its key there, its full name), quoted or dotted keys alike."""
    for key, value in table.values.items():
        name = prefix + key
        if isinstance(value, dict) and value and name in _GROUPS and not {"value", "u"} & set(value):
            yield from _entries(table.table(key), name + ".")
        else:
            yield table, key, name


def _parse_priors(table: Keys, allowed: tuple[str, ...]) -> dict[str, Prior]:
    """The priors of one table, checked; `allowed` lists the names that may stand in it."""
    priors: dict[str, Prior] = {}
    for keys, key, name in _entries(table):
        if name not in allowed:
            # Keys of [rig] itself that are no priors are read before.
            more = () if "rig" not in table.path or "prior" in table.path else ("aperture_convention", "prior")
            names = "only " + ", ".join((*allowed, *more))
            found = f"the name {escaped(name)}"
            raise keys.refuse(key, "unknown-key", names, _explanation(name, allowed), found)
        if name in priors:
            raise keys.refuse(key, "duplicate-key", "every name once", "remove one", f"{name} twice")
        if name in _PERIOD_NAMES:
            priors[name] = Prior(_parse_period(keys, key), 0.0)
            continue
        distribution = RIG_PRIORS[name].distribution
        low, high, u_max = _RANGES[name.partition(".")[0]]
        if name.startswith("extrinsics.rotation_rad"):
            low, high, u_max = -3.15, 3.15, 3.15
        value, u = keys.quantity(key, low, high, u_max)
        priors[name] = Prior(value, u, distribution)
    return priors


def _parse_period(keys: Keys, key: str) -> float:
    """A period in degrees of the output; exact, since it follows from tooth counts."""
    period_deg, u = keys.quantity(key, _PERIOD_MIN_DEG, FULL_TURN_DEG, FULL_TURN_DEG)
    if u != 0:
        remedy = "write u = 0.0: tooth counts give the period exactly (the wheel's is 360)"
        raise keys.refuse(key, "period-uncertain", "a period with u = 0", remedy)
    return period_deg


def _check_periods(table: Keys, priors: Mapping[str, Prior], period_deg: Mapping[str, float]) -> None:
    """`require_periods` with the place in the file."""
    name = _harmonic_without_period(priors, period_deg)
    if name is not None:
        allowed = "harmonics of an axis whose period is stated"
        raise table.refuse(name, "missing-period", allowed, _period_remedy(name), "a harmonic without a period")


def parse_rig_table(table: Keys) -> RigTable:
    """The `[rig]` table with its `[rig.prior]`; absent entries take their defaults.

    Raises:
        InputError: unknown or misplaced names, entries that are not { value, u }, values out of range,
            a half-normal with a value other than 0, harmonics without a period, a period with u > 0.
    """
    own = {k: v for k, v in table.values.items() if k not in ("aperture_convention", "prior")}
    own_keys = Keys(own, table.file, table.text, table.path)
    declared = _parse_priors(own_keys, (*DECLARED_PRIORS, *_PERIOD_NAMES))
    period_deg = {axis: declared.pop(name).value for name, axis in _PERIOD_NAMES.items() if name in declared}
    # Any parameter may stand in [rig.prior] (DESIGN 7), also one that has its place in [rig].
    prior = _parse_priors(table.table("prior"), (*_PRIOR_NAMES, *DECLARED_PRIORS))
    for name in declared:
        if name in prior:
            found = f"{name} in [rig] and in [rig.prior]"
            raise table.table("prior").refuse(name, "duplicate-key", "every name once", "remove one", found)
    _check_periods(table.table("prior"), prior, period_deg)
    key = "aperture_convention"
    azimuth = key in table and table.word(key, ("in-plane", "azimuth")) == "azimuth"
    return RigTable({**prior, **declared}, "azimuth" if azimuth else "in-plane", period_deg)


def rig_table_toml(table: RigTable) -> str:
    """`[rig]` and `[rig.prior]` with every entry, also those at their defaults, so that a file says all.

    Harmonics stand only where they mean something: on an axis with a period.
    """

    def entry(name: str) -> str:
        prior = table.priors[name]
        return toml_line(name, {"value": float(prior.value), "u": float(prior.u)})

    convention = toml_line("aperture_convention", table.aperture_convention)
    periods = [
        toml_line(name, {"value": float(table.harmonic_period_deg[axis]), "u": 0.0})
        for name, axis in _PERIOD_NAMES.items()
        if axis in table.harmonic_period_deg
    ]
    harmonics = [entry(name) for name in HARMONIC_PRIORS if name.split(".")[1] in table.harmonic_period_deg]
    declared, priors = map(entry, DECLARED_PRIORS), map(entry, DEFAULT_PRIORS)
    return "\n".join(["[rig]", *declared, *periods, convention, "[rig.prior]", *priors, *harmonics]) + "\n"


_COSTS_S = {"move_s": 1.5, "look_s": 1.0, "placement_s": 60.0}
_COUNTER_MAX = 10**8


def _parse_positioner(table: Keys) -> dict[str, object]:
    """`[positioner]`: driver, port, limits and speeds."""
    limits = ("pan_min_steps", "pan_max_steps", "tilt_min_steps", "tilt_max_steps")
    table.only(("driver", "port", "baud", *limits, "speed_steps_per_s", "settle_s"))
    values: dict[str, object] = {key: table.text_value(key) for key in ("driver", "port") if key in table}
    # Serial libraries read an address as instructions: one of them writes a file of the address' choice.
    if "://" in str(values.get("port", "")):
        remedy = "give a port's name, such as /dev/ttyACM0 or COM3; `tvsbayes doctor` lists those there are"
        raise table.refuse("port", "port", "the name of a serial port, no address", remedy)
    if "baud" in table:
        values["baud"] = table.integer("baud", 300, 10_000_000)
    steps = {key: table.integer(key, -_COUNTER_MAX, _COUNTER_MAX) for key in limits if key in table}
    for axis in ("pan", "tilt"):
        low, high = steps.get(f"{axis}_min_steps"), steps.get(f"{axis}_max_steps")
        if low is not None and high is not None and low > high:
            key = f"{axis}_max_steps"
            raise table.refuse(key, "limits", f"at least {axis}_min_steps = {low}", "swap the two limits")
    for key, low_s, high_s in (("speed_steps_per_s", 1e-3, 1e7), ("settle_s", 0.0, 3600.0)):
        if key in table:
            values[key] = table.number(key, low_s, high_s)
    return {**values, **steps}


def _parse_cameras(table: Keys, stereo: Stereo) -> dict[str, object]:
    """`[cameras]`: source, devices, size (that of the calibration), exposure, spot uncertainty."""
    table.only(("source", "left", "right", "width", "height", "exposure", "spot_sd_px"))
    values: dict[str, object] = {"spot_sd_px": 0.08}
    for key in ("source", "left", "right"):
        if key in table:
            device = isinstance(table.values[key], str)
            values[key] = table.text_value(key) if device else table.integer(key, 0, 1000)
    for key, calibrated in (("width", stereo.image_width), ("height", stereo.image_height)):
        if key in table:
            values[key] = table.integer(key, 1, 65_535)
            if values[key] != calibrated:
                remedy = "calibrate and observe at one image size"
                raise table.refuse(key, "image-size", f"{calibrated} px, as in the stereo file", remedy)
    for key, low, high in (("exposure", -100.0, 1e9), ("spot_sd_px", 1e-4, 100.0)):
        if key in table:
            values[key] = table.number(key, low, high)
    return values


def _beside(keys: Keys, key: str, folder: Path) -> Path:
    """The file that `key` names, which must lie in the folder of the rig file or below."""
    name = keys.text_value(key)
    windows = PureWindowsPath(name)
    if not name or Path(name).is_absolute() or windows.drive or windows.root or ".." in windows.parts:
        allowed = "a file name relative to the rig file, inside its folder"
        raise keys.refuse(key, "path", allowed, "put the file beside the rig file and give its name")
    return folder / name


def read_rig(path: Path) -> Rig:
    """Reads a rig file (format tvsbayes-rig/1, DESIGN 7) and the stereo file it names.

    Raises:
        InputError: either file unreadable, unknown keys, values out of range, a stereo path that leaves
            the folder.
    """
    path = Path(path)
    keys = parse_toml(read_bytes(path, TOML_BYTES_MAX), escaped(path.name))
    keys.word("format", ("tvsbayes-rig/1",))
    tables = ("rig", "truth", "sheets", "positioner", "cameras", "costs")
    keys.only(("format", "name", "notes", "stereo", *tables))
    header = {key: keys.text_value(key, cap) for key, cap in (("name", 200), ("notes", 2000)) if key in keys}
    stereo = read_stereo(_beside(keys, "stereo", path.parent), folder=path.parent)
    table = parse_rig_table(keys.table("rig"))
    sheets = keys.table("sheets")
    for name in sheets.values:
        if not (name.isprintable() and 0 < len(name) <= 100):
            raise sheets.refuse(name, "text", "a printable name of 1 to 100 characters", "rename the sheet")
    costs = keys.table("costs")
    costs.only(_COSTS_S)
    truth = {**table.priors, **_parse_priors(keys.table("truth"), tuple(RIG_PRIORS))}
    _check_periods(keys.table("truth"), truth, table.harmonic_period_deg)
    return Rig(
        table=table,
        stereo=stereo,
        truth=truth,
        sheets_mm={name: sheets.number(name, 50.0, 100_000.0) for name in sheets.values},
        positioner=_parse_positioner(keys.table("positioner")),
        cameras=_parse_cameras(keys.table("cameras"), stereo),
        costs_s={k: costs.number(k, 0.0, 1e6) if k in costs else v for k, v in _COSTS_S.items()},
        path=path,
        header=header,
    )
