"""A calibration to drive with: rays, coordinates and counters from stored draws, in NumPy alone (DESIGN 5 and 8).

What a robot loads: no JAX, no fit, less than a millisecond a call. The optics are written out in components, so that
the same lines serve one pose in Python floats and many parameter sets in arrays; `tests/test_calibration.py` holds
them to the JAX model. Frame T: origin mid-baseline, x depth, y along the baseline towards the positioner at +a/2,
z up. mm; degrees where a name says `_deg`; counters in steps, absolute, after homing.
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from tvsbayes.campaign import APPROACH_SIGN, Campaign, input_hashes
from tvsbayes.files import InputError, escaped, parse_json, read_arrays, read_bytes, shipped_data
from tvsbayes.rigs import FULL_TURN_DEG, HARMONIC_PRIORS

CALIBRATION_FORMAT = "tvsbayes-calibration/1"
NO_CALIBRATION = "no-calibration"
"""Code of the refusal of results that are whole but hold no calibration."""
INPUT_NAMES: tuple[str, ...] = (
    *("degrees_per_step.pan", "degrees_per_step.tilt", "backlash_deg.pan", "backlash_deg.tilt"),
    *HARMONIC_PRIORS,
    *("tilt_zero_deg", "mirror_offset_mm", "mirror1_error_deg", "mirror2_error_deg"),
    *("laser_tilt_deg.x", "laser_tilt_deg.y", "laser_offset_mm.x", "laser_offset_mm.y"),
    *("tilt_axis_skew_deg", "tilt_axis_offset_mm.x", "tilt_axis_offset_mm.z"),
    *("baseline_mm", "pan_zero_emission_deg", "aperture_zero_deg"),
)
"""What a coordinate depends on. Contrasts do not enter: after homing a counter stands for its mean ratio."""
NOISE_NAMES = (*(f"stop_sd_deg.{d}" for d in ("left", "right", "up", "down")), "aperture_sd_deg")
AXES = ("pan", "tilt")
SIDES = {"pan": ("right", "left"), "tilt": ("down", "up")}
"""Approach sides of an axis, negative first."""
NORMAL_95 = 1.959963984540054
"""Two-sided 95 % quantile of the normal distribution."""
CONTRACTION_LIMIT = 0.1
"""1 - (posterior sd / prior sd)^2 below which a value is called set by the prior (DESIGN 8)."""
CLEARED_PROBABILITY = 0.99
"""With this probability an overshoot takes up all the play."""
AIM_STEPS, AIM_RAD = 40, 1e-11
DIVERGING_SHARE = 1e-3
"""Share of draws without a point above which a point is refused (DESIGN 5)."""
DIVERGING_SDS = 3.0902323061678132
"""Range over its standard deviation below which more than `DIVERGING_SHARE` of a normal 1/range is beyond infinity."""
ROUNDING = 1e-12
"""Of coordinates, relative to the range."""
NOISES = 5
"""Unit noises of a look: stop error and place in the play (pan, tilt), aperture."""
COMPLEX_STEP = 1e-30
"""Imaginary step of derivatives: nothing is subtracted, so it may be as small as it likes (Squire and Trapp, SIAM
Review 40 (1998) 110)."""
RESULTS_BYTES_MAX = 64 * 1024 * 1024
UNPACKED_BYTES_MAX = 2 * RESULTS_BYTES_MAX
NAME_CHARS_MAX = 200
_TO_RAD = math.pi / 180


@dataclass(frozen=True)
class Ray:
    """A beam in frame T: it leaves the positioner at `origin_mm` (3,) along the unit vector `direction` (3,)."""

    origin_mm: np.ndarray
    direction: np.ndarray


@dataclass(frozen=True)
class Located:
    """A point of frame T by linear propagation: estimate (3,), covariance (3, 3) and 95 % half widths (3,)."""

    xyz_mm: np.ndarray
    covariance_mm2: np.ndarray
    u95_mm: np.ndarray


@dataclass(frozen=True)
class Steps:
    """Counters that send the beam where it is wanted.

    Attributes:
        pan_steps, tilt_steps: absolute counters.
        approach: last move of each axis, (left or right, up or down).
        via_pan_steps, via_tilt_steps: go there first: the move on from there takes up all play with a probability of
            `CLEARED_PROBABILITY`.
        ray: the beam at these counters.
        xyz_mm: the point on it that is nearest to the wanted one, or None for a wanted direction.
        aperture_deg: what the aperture should read there, or None.
        rounding_mm, rounding_deg: distance from the wanted point or direction that whole steps leave.
        u95_mm, u95_deg: 95 % half widths of the beam's position at the point (3,), or of its azimuth and elevation.
    """

    pan_steps: int
    tilt_steps: int
    approach: tuple[str, str]
    via_pan_steps: int
    via_tilt_steps: int
    ray: Ray
    xyz_mm: np.ndarray | None
    aperture_deg: float | None
    rounding_mm: float | None
    rounding_deg: float | None
    u95_mm: np.ndarray | None
    u95_deg: np.ndarray | None

    def as_json(self) -> dict[str, object]:
        """The document of `steps-for`."""

        def plain(value):
            return value.tolist() if isinstance(value, np.ndarray) else value

        document = {key: plain(value) for key, value in vars(self).items() if key not in ("ray", "approach")}
        document["approach"] = dict(zip(AXES, self.approach, strict=True))
        document["ray"] = {key: plain(value) for key, value in vars(self.ray).items()}
        return document


def _harmonic(values: Mapping[str, object], axis: str, angle_deg, period_deg: float, m):
    """Transmission error at an angle, degrees (DESIGN 3.1)."""
    total = 0.0
    for order in (1, 2):
        phase = 2 * math.pi * order * angle_deg / period_deg
        total = total + values[f"harmonic_deg.{axis}.{order}.cos"] * m.cos(phase)
        total = total + values[f"harmonic_deg.{axis}.{order}.sin"] * m.sin(phase)
    return total


def output_deg(values: Mapping[str, object], axis: str, steps, side: float, period_deg: float | None, m=np):
    """Mirror angle of an axis after homing: q = k n, play taken up on the approach side (DESIGN 3.1).

    Args:
        values: parameters by name; floats, or arrays of one shape.
        axis: pan or tilt.
        steps: absolute counter.
        side: +1 reached left or up, -1 right or down, 0 somewhere in the play.
        period_deg: period of the transmission error, None without one.
        m: `math` for floats, `numpy` for arrays.
    """
    q = values[f"degrees_per_step.{axis}"] * steps
    if period_deg is not None and period_deg != FULL_TURN_DEG:
        q = q + _harmonic(values, axis, q, period_deg, m)
    output = q - 0.5 * side * values[f"backlash_deg.{axis}"]
    if period_deg == FULL_TURN_DEG:
        output = output + _harmonic(values, axis, output, period_deg, m)
    return output if axis == "pan" else output + values["tilt_zero_deg"]


def beam_components(values: Mapping[str, object], pan_deg, tilt_deg, m=np) -> tuple[tuple, tuple]:
    """Origin (x, y, z) and direction (x, y, z) of the beam in frame T for mirror angles (DESIGN 3.2 and 2).

    The laser is reflected in the turned pan stage and everything turned back at the end. Arguments as in
    `output_deg`.
    """
    sin, cos, tan, sqrt = m.sin, m.cos, m.tan, m.sqrt
    psi, beta = pan_deg * _TO_RAD, tilt_deg * _TO_RAD
    sin_psi, cos_psi = sin(psi), cos(psi)
    tx, ty = tan(values["laser_tilt_deg.x"] * _TO_RAD), tan(values["laser_tilt_deg.y"] * _TO_RAD)
    length = sqrt(1.0 + tx * tx + ty * ty)
    ox, oy = values["laser_offset_mm.x"], values["laser_offset_mm.y"]
    x, y, z = cos_psi * ox + sin_psi * oy, cos_psi * oy - sin_psi * ox, 0.0
    u, v, w = (cos_psi * tx + sin_psi * ty) / length, (cos_psi * ty - sin_psi * tx) / length, -1.0 / length

    first = (45.0 + values["mirror1_error_deg"]) * _TO_RAD
    ny, nz = -sin(first), cos(first)
    along = v * ny + w * nz
    reach = -(y * ny) / along
    x, y, z = x + reach * u, y + reach * v, reach * w
    v, w = v - 2 * along * ny, w - 2 * along * nz

    second, skew = (45.0 + values["mirror2_error_deg"]) * _TO_RAD, values["tilt_axis_skew_deg"] * _TO_RAD
    sin_m, cos_m, sin_s, cos_s = sin(second), cos(second), sin(skew), cos(skew)
    nx, up = sin_m * cos(beta), sin_m * sin(beta)
    ny, nz = cos_m * cos_s - up * sin_s, cos_m * sin_s + up * cos_s
    along = u * nx + v * ny + w * nz
    cx, cy, cz = values["tilt_axis_offset_mm.x"], -values["mirror_offset_mm"], values["tilt_axis_offset_mm.z"]
    reach = ((cx - x) * nx + (cy - y) * ny + (cz - z) * nz) / along
    x, y, z = x + reach * u, y + reach * v, z + reach * w
    u, v, w = u - 2 * along * nx, v - 2 * along * ny, w - 2 * along * nz

    turn = psi + (values["pan_zero_emission_deg"] - 90.0) * _TO_RAD
    sin_t, cos_t = sin(turn), cos(turn)
    origin = cos_t * x - sin_t * y, sin_t * x + cos_t * y + 0.5 * values["baseline_mm"], z
    return origin, (cos_t * u - sin_t * v, sin_t * u + cos_t * v, w)


def range_components(origin: tuple, direction: tuple, baseline_mm, aperture_deg, azimuth: bool, m=np):
    """Range along the beam at which the aperture sees it under angle B, mm (derivation: `coordinates.meeting`).

    Not a number where the beam misses the cone or half-plane of B; zero, negative or minus infinite where only its
    backward extension or the other nappe is met.
    """
    x, y, z = origin
    u, v, w = direction
    y = y + 0.5 * baseline_mm
    sin_b, cos_b = m.sin(aperture_deg * _TO_RAD), m.cos(aperture_deg * _TO_RAD)
    if azimuth:
        closing = u * cos_b - v * sin_b
        if m is math and closing == 0:
            return math.inf
        reach = (y * sin_b - x * cos_b) / closing
        ahead = (x + reach * u) * sin_b + (y + reach * v) * cos_b
        # The other half of B's plane is behind the aperture.
        return (reach if ahead >= 0 else math.nan) if m is math else np.where(ahead >= 0, reach, np.nan)
    mx, my, mz = y * w - z * v, z * u - x * w, x * v - y * u
    inside = (mx * mx + mz * mz) * sin_b * sin_b - my * my * cos_b * cos_b
    if m is math:
        if inside < 0:
            return math.nan
        root = math.sqrt(inside)
    else:
        # A complex step would find a root of a negative number.
        root = np.sqrt(np.where(np.real(inside) < 0, np.nan, inside))
    across = x * u + y * v + z * w
    reach = y * y - cos_b * cos_b * (x * x + y * y + z * z)
    closing = cos_b * root - (y * v - cos_b * cos_b * across)
    if m is math and closing == 0:
        return math.inf
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = reach / closing
        # At B = 90 deg both nappes are one plane, and y is nought but for rounding.
        faces = (y + reach * v) * cos_b >= -ROUNDING * abs(reach * cos_b)
    return (reach if faces else -math.inf) if m is math else np.where(faces | np.isnan(reach), reach, -np.inf)


def aperture_angle_deg(point: tuple, baseline_mm, azimuth: bool, m=np):
    """The angle B of a point (x, y, z) of frame T at the aperture, degrees, without the aperture's zero."""
    x, y, z = point
    lateral = x if azimuth else m.hypot(x, z)
    arc_tangent = math.atan2 if m is math else np.arctan2
    return arc_tangent(lateral, y + 0.5 * baseline_mm) / _TO_RAD


@dataclass(frozen=True)
class Calibration:
    """Estimates and uncertainty of everything that a coordinate depends on.

    Attributes:
        mean: best estimates, shape (inputs,), ordered as `INPUT_NAMES`, units of the names.
        covariance: their covariance, shape (inputs, inputs).
        noise_variance: mean variance of each of `NOISE_NAMES`, deg^2.
        overshoot_steps: by axis, steps that take up all play with a probability of `CLEARED_PROBABILITY`.
        azimuth: the aperture reads the azimuth of the spot, not the angle in the plane of beam and baseline.
        period_deg: period of the transmission error by axis, where there is one.
        estimator: "posterior" or "laplace".
        range_steps: lowest and highest counter per axis in the campaign, shape (2, 2).
        inputs_sha256: hashes of the campaign's data.
        inputs: draws (n, inputs) behind the moments; none where only the moments were kept.
        noise: draws (n, 5) of `NOISE_NAMES`, likewise.
        causes: names of the causes of uncertainty behind `cause_covariance`; empty where unknown.
        cause_covariance: what each contributes to `covariance`, shape (causes, inputs, inputs).
    """

    mean: np.ndarray
    covariance: np.ndarray
    noise_variance: Mapping[str, float]
    overshoot_steps: Mapping[str, int]
    azimuth: bool = False
    period_deg: Mapping[str, float] = field(default_factory=dict)
    estimator: str = "posterior"
    range_steps: np.ndarray = field(default_factory=lambda: np.zeros((2, 2)))
    inputs_sha256: Mapping[str, str] = field(default_factory=dict)
    inputs: np.ndarray = field(default_factory=lambda: np.zeros((0, len(INPUT_NAMES))))
    noise: np.ndarray = field(default_factory=lambda: np.zeros((0, len(NOISE_NAMES))))
    causes: tuple[str, ...] = ()
    cause_covariance: np.ndarray = field(default_factory=lambda: np.zeros((0, len(INPUT_NAMES), len(INPUT_NAMES))))

    @cached_property
    def estimates(self) -> dict[str, float]:
        """Best estimates by name."""
        return dict(zip(INPUT_NAMES, self.mean.tolist(), strict=True))

    @cached_property
    def _moved(self) -> tuple[dict[str, np.ndarray | float], np.ndarray]:
        """Parameters by name and unit noises of a look, each moved by an imaginary step in one of (inputs + NOISES)."""
        count = len(INPUT_NAMES)
        sets = np.concatenate([self.mean, np.zeros(NOISES)]) + 1j * COMPLEX_STEP * np.eye(count + NOISES)
        values = dict(zip(INPUT_NAMES, sets[:, :count].T, strict=True))
        return values | {name: math.sqrt(self.noise_variance[name]) for name in NOISE_NAMES}, sets[:, count:].T

    @cached_property
    def covariance_with_noise(self) -> np.ndarray:
        """Covariance of `INPUT_NAMES` and the unit noises of a look, shape (inputs + NOISES, inputs + NOISES)."""
        count = len(INPUT_NAMES)
        covariance = np.diag([*np.zeros(count), 1, 1, 1 / 12, 1 / 12, 1])
        covariance[:count, :count] = self.covariance
        return covariance

    def covers(self, pan_steps: float, tilt_steps: float) -> bool:
        """Whether the campaign reached these counters."""
        return all(low <= n <= high for n, (low, high) in zip((pan_steps, tilt_steps), self.range_steps, strict=True))

    def angles(self, values: Mapping[str, object], steps: tuple, sides: tuple, m=np) -> tuple:
        """Mirror angles (pan, tilt) of parameters by name at counters and approach sides; `m` as in `output_deg`."""
        return tuple(
            output_deg(values, axis, n, side, self.period_deg.get(axis), m)
            for axis, n, side in zip(AXES, steps, sides, strict=True)
        )

    def ray(self, pan_steps: float, tilt_steps: float, approach: tuple[str, str] = ("left", "up")) -> Ray:
        """The beam at counters that were reached from a side.

        Args:
            pan_steps: absolute counter.
            tilt_steps: absolute counter.
            approach: last move of (pan, tilt): left or right, up or down, or unknown.

        Raises:
            InputError: an approach that does not exist.
        """
        angles = self.angles(self.estimates, (pan_steps, tilt_steps), sides_of(approach), math)
        origin, direction = beam_components(self.estimates, *angles, math)
        return Ray(np.array(origin), np.array(direction))

    def locate(
        self,
        pan_steps: float,
        tilt_steps: float,
        aperture_deg: float,
        approach: tuple[str, str] = ("left", "up"),
    ) -> Located:
        """The point that beam and aperture reading agree on, with its covariance by the law of propagation (GUM 5.2).

        Stop errors, aperture noise and the uncertainty of every parameter are in it. `tvsbayes.locate` carries the
        draws themselves through the geometry instead.

        Args:
            pan_steps: absolute counter.
            tilt_steps: absolute counter.
            aperture_deg: reading B.
            approach: as in `ray`.

        Raises:
            InputError: an approach that does not exist, or beam and line of sight do not meet, or more than 0.1 % of
                what the data allow would not (DESIGN 5).
        """
        sides = sides_of(approach)
        steps = (float(pan_steps), float(tilt_steps))
        if not all(map(math.isfinite, (*steps, aperture_deg))):
            raise self.refusal(pan_steps, tilt_steps, aperture_deg, sides)
        ray, baseline_mm = self.ray(*steps, approach), self.estimates["baseline_mm"]
        beam = tuple(ray.origin_mm.tolist()), tuple(ray.direction.tolist())
        true_deg = aperture_deg - self.estimates["aperture_zero_deg"]
        reach = range_components(*beam, baseline_mm, true_deg, self.azimuth, math)
        if not 0 < reach < math.inf:
            raise self.refusal(pan_steps, tilt_steps, aperture_deg, sides)
        estimate = ray.origin_mm + reach * ray.direction

        jacobian = self.derivatives(*steps, aperture_deg, approach)
        covariance = jacobian @ self.covariance_with_noise @ jacobian.T
        # The inverse of the range is nearly normal: its tail beyond zero is the share of draws that diverge.
        least = DIVERGING_SDS * math.sqrt(max(ray.direction @ covariance @ ray.direction, 0.0))
        if not (np.all(np.isfinite(covariance)) and reach > least):
            raise self.refusal(pan_steps, tilt_steps, aperture_deg, sides)
        return Located(estimate, covariance, NORMAL_95 * np.sqrt(np.diag(covariance)))

    def refusal(
        self, pan_steps: float, tilt_steps: float, aperture_deg: float, sides: tuple[float, float]
    ) -> InputError:
        """Why beam and line of sight of a look have no point in common, or none that can be told: by name.

        "grazing" where the estimated beam passes the aperture's cone without touching it, else "diverging".
        """
        where = f"pan {pan_steps:g}, tilt {tilt_steps:g} steps, aperture {aperture_deg:g} deg"
        given = {"column": "aperture_deg", "found": f"{aperture_deg:g}"}
        if all(map(math.isfinite, (pan_steps, tilt_steps, aperture_deg))) and not self.azimuth:
            values = self.estimates
            origin, direction = beam_components(
                values, *self.angles(values, (pan_steps, tilt_steps), sides, math), math
            )
            true_deg = aperture_deg - values["aperture_zero_deg"]
            if math.isnan(range_components(origin, direction, values["baseline_mm"], true_deg, False, math)):
                return InputError(
                    "grazing",
                    f"{where}: the beam passes the cone of all points seen under this angle without touching it",
                    **given,
                    allowed="readings away from 0 and 180 deg, of a beam in the plane of baseline and spot",
                    remedy="check reading and counters; the beam runs past the baseline, not towards a spot",
                )
        return InputError(
            "diverging",
            f"{where}: beam and line of sight diverge",
            **given,
            allowed="readings B with B + C clearly below 180 deg, C the beam's own angle to the baseline",
            remedy="check reading and counters; such a target is too far, or behind the scanner",
        )

    def noisy_angles(self, values: Mapping[str, object], noise: Sequence, steps: tuple, sides: tuple) -> tuple:
        """Mirror angles (pan, tilt) with stop errors, and somewhere in the play where the side is unknown.

        Args:
            values: by name, of `INPUT_NAMES` and `NOISE_NAMES`; arrays of one shape.
            noise: `NOISES` unit noises, arrays of that shape (`Drawn`).
            steps: counters (pan, tilt).
            sides: approach sides (pan, tilt): +1 left or up, -1 right or down, 0 unknown.
        """
        found = []
        for k, (axis, side) in enumerate(zip(AXES, sides, strict=True)):
            low, high = (values[f"stop_sd_deg.{name}"] for name in SIDES[axis])
            stop_sd = high if side > 0 else low if side < 0 else np.sqrt(0.5 * (low**2 + high**2))
            # Where the side is unknown, the play is taken up by any part of it.
            place = side if side else -2 * noise[2 + k]
            found.append(output_deg(values, axis, steps[k], place, self.period_deg.get(axis)) + stop_sd * noise[k])
        return tuple(found)

    def derivatives(
        self, pan_steps: float, tilt_steps: float, aperture_deg: float, approach: tuple[str, str] = ("left", "up")
    ) -> np.ndarray:
        """Sensitivities of a point to `INPUT_NAMES` (their units) and to the unit noises of the look, mm.

        Noises have the root mean square of their standard deviations.

        Args:
            pan_steps: absolute counter.
            tilt_steps: absolute counter.
            aperture_deg: reading B.
            approach: last move of (pan, tilt): left or right, up or down, or unknown.

        Returns:
            Shape (3, inputs + NOISES).

        Raises:
            InputError: an approach that does not exist, or beam and line of sight do not meet.
        """
        sides = sides_of(approach)
        values, noise = self._moved
        angles = self.noisy_angles(values, noise, (pan_steps, tilt_steps), sides)
        origin, direction = beam_components(values, *angles)
        true_deg = aperture_deg - values["aperture_zero_deg"] - values["aperture_sd_deg"] * noise[4]
        reach = range_components(origin, direction, values["baseline_mm"], true_deg, self.azimuth)
        if not np.all(reach.real > 0):
            raise self.refusal(pan_steps, tilt_steps, aperture_deg, sides)
        return np.array([o + reach * d for o, d in zip(origin, direction, strict=True)]).imag / COMPLEX_STEP

    def steps_for(
        self,
        xyz_mm: tuple[float, float, float] | np.ndarray | None = None,
        *,
        azimuth_deg: float | None = None,
        elevation_deg: float | None = None,
        approach: tuple[str, str] | None = None,
        limits: Mapping[str, tuple[float, float]] | None = None,
    ) -> Steps:
        """Counters that send the beam to a point, or along a direction, of frame T.

        Args:
            xyz_mm: wanted point; or give a wanted direction by
            azimuth_deg: atan2(d_y, d_x), the emission angle C less 90 deg, and
            elevation_deg: asin(d_z).
            approach: side from which each axis arrives; None takes left and up where the limits allow.
            limits: lowest and highest counter by axis ("pan", "tilt").

        Raises:
            InputError: neither or both targets, no mirror angle reaches it, or it lies outside the limits.
        """
        angles_given = (azimuth_deg is not None, elevation_deg is not None)
        if angles_given != ((False, False) if xyz_mm is not None else (True, True)):
            remedy = "give a point, or azimuth and elevation"
            raise InputError("no-target", "steps_for needs one target, a point or a direction", remedy=remedy)
        target = None if xyz_mm is None else np.asarray(xyz_mm, dtype=float)
        angles = self._aim(target, azimuth_deg, elevation_deg)
        chosen, counters, via = [], [], []
        for axis, angle_deg in zip(AXES, angles, strict=True):
            wanted = None if approach is None else approach[AXES.index(axis)]
            side, steps, first = self._counter(axis, angle_deg, wanted, (limits or {}).get(axis))
            chosen.append(side)
            counters.append(steps)
            via.append(first)
        ray = self.ray(*counters, approach=(chosen[0], chosen[1]))
        shared = (*counters, (chosen[0], chosen[1]), *via, ray)
        sides = sides_of((chosen[0], chosen[1]))
        o, d = ray.origin_mm, ray.direction
        if target is None:
            wanted_direction = direction_of(azimuth_deg, elevation_deg)
            rounding = math.degrees(math.atan2(np.linalg.norm(np.cross(d, wanted_direction)), d @ wanted_direction))
            return Steps(*shared, None, None, None, rounding, None, self._ray_u95(counters, sides, None))
        reach = float((target - o) @ d)
        point = o + reach * d
        aperture = self.reading(point)
        u95 = self._ray_u95(counters, sides, reach)
        return Steps(*shared, point, aperture, float(np.linalg.norm(target - point)), None, u95, None)

    def reading(self, point: np.ndarray) -> float:
        """What the aperture reads for a point of frame T, degrees."""
        angle = aperture_angle_deg(tuple(point), self.estimates["baseline_mm"], self.azimuth, math)
        return angle + self.estimates["aperture_zero_deg"]

    def _aim(self, target: np.ndarray | None, azimuth_deg, elevation_deg) -> tuple[float, float]:
        """Mirror angles whose beam passes through a point or along a direction, degrees.

        A mirror angle moves the beam by nearly as much, so that plain correction converges.
        """
        pan_deg = tilt_deg = 0.0
        finite = np.all(np.isfinite((azimuth_deg, elevation_deg) if target is None else target))
        # Behind the baseline there is no triangle for the aperture to close.
        ahead = finite and (abs(azimuth_deg) < 90 if target is None else target[0] > 0)
        for _ in range(AIM_STEPS if ahead else 0):
            o, d = beam_components(self.estimates, pan_deg, tilt_deg, math)
            if target is None:
                goal = (azimuth_deg, elevation_deg)
            else:
                x, y, z = (float(t) - c for t, c in zip(target, o, strict=True))
                goal = (math.degrees(math.atan2(y, x)), math.degrees(math.atan2(z, math.hypot(x, y))))
            azimuth = math.remainder(goal[0] - math.degrees(math.atan2(d[1], d[0])), 360.0)
            elevation = goal[1] - math.degrees(math.atan2(d[2], math.hypot(d[0], d[1])))
            if max(abs(azimuth), abs(elevation)) < math.degrees(AIM_RAD):
                return pan_deg, tilt_deg
            pan_deg, tilt_deg = pan_deg + azimuth, tilt_deg + elevation
            if abs(tilt_deg) > 90:
                break
        raise InputError(
            "out-of-reach",
            "no mirror angles send the beam there",
            allowed="points in front of the scanner and farther from it than the mirrors, elevations below 80 deg",
            remedy="check the target's frame: x depth, y along the baseline towards the positioner, z up, mm",
        )

    def _counter(self, axis: str, angle_deg: float, side: str | None, limits) -> tuple[str, int, int]:
        """Side, counter and the counter to go to first; the other side where limits forbid the preferred one."""
        negative, positive = SIDES[axis]
        low, high = (-math.inf, math.inf) if limits is None else limits
        overshoot = self.overshoot_steps[axis]
        tried = (positive, negative) if side is None else (side,)
        for name in tried:
            if name not in SIDES[axis]:
                raise bad_approach(axis, name, SIDES[axis][::-1])
            sign = APPROACH_SIGN[name]
            steps = self._steps_at(axis, angle_deg, sign)
            ratio_sign = 1 if self.estimates[f"degrees_per_step.{axis}"] > 0 else -1
            first = steps - sign * ratio_sign * overshoot
            if low <= steps <= high and low <= first <= high:
                return name, steps, first
        raise InputError(
            "outside-limits",
            f"{axis}: the target needs counter {steps}, approached from {first}",
            column=axis,
            found=f"{steps} and {first}",
            allowed=f"{low:g} to {high:g}",
            remedy="choose a target inside the limits, or widen them in [positioner] if the machine allows",
        )

    def _steps_at(self, axis: str, angle_deg: float, sign: int) -> int:
        """The counter whose mirror angle is nearest to the wanted one."""
        ratio = self.estimates[f"degrees_per_step.{axis}"]
        steps = 0.0
        for _ in range(AIM_STEPS):
            at = output_deg(self.estimates, axis, steps, sign, self.period_deg.get(axis), math)
            change = (angle_deg - at) / ratio
            steps += change
            if abs(change) < 1e-9:
                break
        return round(steps)

    def _ray_u95(self, steps, sides, reach: float | None) -> np.ndarray:
        """95 % half widths of the beam at a range (3,), mm, or of its azimuth and elevation (2,), degrees."""
        values, noise = self._moved
        origin, direction = beam_components(values, *self.noisy_angles(values, noise, tuple(map(float, steps)), sides))
        if reach is not None:
            found = np.array([o + reach * d for o, d in zip(origin, direction, strict=True)])
        else:
            # Of the azimuth atan2(y, x), whose derivatives those of atan(y / x) are.
            found = np.array([np.arctan(direction[1] / direction[0]), np.arcsin(direction[2])]) / _TO_RAD
        jacobian = found.imag / COMPLEX_STEP
        return NORMAL_95 * np.sqrt(np.diag(jacobian @ self.covariance_with_noise @ jacobian.T))


@dataclass(frozen=True)
class Drawn:
    """Rigs that the data allow, each with the unit noises of one look.

    Attributes:
        inputs: shape (draws, columns), ordered as `INPUT_NAMES`, then `NOISE_NAMES`.
        noise: standard-normal stop errors (pan, tilt), uniform places in the play in [-1/2, 1/2] (pan, tilt), the
            aperture's standard-normal noise, shape (draws, `NOISES`).
    """

    inputs: np.ndarray
    noise: np.ndarray


def drawn(calibration: Calibration, draws: int, seed: int) -> Drawn:
    """Draws of parameters, evenly chosen, with noises of their own; the same for every point of a call.

    Raises:
        InputError: a calibration without draws.
    """
    stored = len(calibration.inputs)
    if stored == 0:
        raise InputError(
            "no-draws",
            "this calibration keeps moments only, as exported for a robot",
            remedy="locate from the campaign folder, or use calibration.locate, which needs no draws",
        )
    generator = np.random.default_rng([seed, 6])
    # Fewer draws than are stored: evenly chosen; more: all, again and again, with new noises.
    chosen = np.arange(draws) % stored if draws > stored else np.linspace(0, stored - 1, draws).astype(int)
    columns = np.concatenate([calibration.inputs, calibration.noise], axis=1)[chosen]
    normal = generator.standard_normal((draws, NOISES))
    noise = np.column_stack([normal[:, :2], generator.uniform(-0.5, 0.5, (draws, 2)), normal[:, 4]])
    return Drawn(columns, noise)


def direction_of(azimuth_deg: float | np.ndarray, elevation_deg: float | np.ndarray) -> np.ndarray:
    """Unit vectors of directions in frame T, first axis x, y, z."""
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])


def bad_approach(axis: str, name: object, allowed: tuple[str, ...]) -> InputError:
    """The refusal of an approach that is not allowed for the axis."""
    return InputError(
        "approach",
        f"{axis} approach {escaped(str(name))!r}; allowed: {', '.join(allowed)}",
        column=f"{axis}_approach",
        found=escaped(str(name)),
        allowed=", ".join(allowed),
        remedy="name the direction of the last move of the axis",
    )


def sides_of(approach: tuple[str, str]) -> tuple[float, float]:
    """+1, -1 or 0 for the approach of (pan, tilt)."""
    for axis, name in zip(AXES, approach, strict=True):
        allowed = (*SIDES[axis][::-1], "unknown")
        if name not in allowed:
            raise bad_approach(axis, name, allowed)
    return float(APPROACH_SIGN[approach[0]]), float(APPROACH_SIGN[approach[1]])


def receiver_priors(campaign: Campaign) -> dict[str, tuple[float, float]]:
    """Value and u of what only aperture readings could tell, where the campaign has none."""
    if any(s.aperture_deg is not None for s in campaign.spots if s.status == "ok"):
        return {}
    names = ("baseline_mm", "pan_zero_emission_deg", "aperture_zero_deg")
    return {name: (campaign.rig.priors[name].value, campaign.rig.priors[name].u) for name in names}


def calibration_of_draws(
    names: tuple[str, ...],
    physical: np.ndarray,
    campaign: Campaign,
    estimator: str,
    seed: int,
    causes: tuple[str, ...] = (),
    cause_covariance: np.ndarray | None = None,
) -> Calibration:
    """Choose the columns that coordinates depend on.

    Baseline, C0, the aperture's zero and its noise take their priors where no reading told them: a sampler holds them
    still.

    Args:
        names: contract names of the columns of `physical`.
        physical: draws (n, names) in the units of the names.
        campaign: what was fitted.
        estimator: "posterior" or "laplace".
        seed: of the draws from priors.
        causes: as in `Calibration`.
        cause_covariance: as in `Calibration`.
    """
    column = {name: physical[:, i] for i, name in enumerate(names)}
    generator = np.random.default_rng([seed, 5])

    def standard() -> np.ndarray:
        # Exactly mean 0 and sd 1: the prior is known, its few draws need not be noise.
        found = generator.standard_normal(len(physical))
        return (found - found.mean()) / found.std()

    if untold := receiver_priors(campaign):
        column |= {name: value + u * standard() for name, (value, u) in untold.items()}
        prior = campaign.rig.priors["aperture_sd_deg"]
        column["aperture_sd_deg"] = prior.value * np.exp(prior.u * standard())
    inputs = np.stack([column[name] for name in INPUT_NAMES], axis=1)
    noise = np.stack([column[name] for name in NOISE_NAMES], axis=1)
    counters = np.array([(m.pan_steps, m.tilt_steps) for m in campaign.moves], dtype=float)
    return Calibration(
        mean=inputs.mean(axis=0),
        covariance=np.cov(inputs, rowvar=False),
        noise_variance=dict(zip(NOISE_NAMES, (noise**2).mean(axis=0).tolist(), strict=True)),
        overshoot_steps={axis: _overshoot_steps(column, axis) for axis in AXES},
        azimuth=campaign.rig.aperture_convention == "azimuth",
        period_deg=dict(campaign.rig.harmonic_period_deg),
        estimator=estimator,
        range_steps=np.stack([counters.min(axis=0), counters.max(axis=0)], axis=1),
        inputs_sha256=input_hashes(campaign),
        inputs=inputs,
        noise=noise,
        **({} if cause_covariance is None else {"causes": causes, "cause_covariance": cause_covariance}),
    )


def _overshoot_steps(column: Mapping[str, np.ndarray], axis: str) -> int:
    play_steps = column[f"backlash_deg.{axis}"] / np.abs(column[f"degrees_per_step.{axis}"])
    return math.ceil(np.quantile(play_steps, CLEARED_PROBABILITY))


_ARRAYS = ("mean", "covariance", "range_steps", "inputs", "noise", "cause_covariance")


def calibration_bytes(calibration: Calibration, **more: np.ndarray) -> bytes:
    """The content of `draws.npz`: a calibration and further arrays."""
    texts = {name: getattr(calibration, name) for name in ("noise_variance", "overshoot_steps", "period_deg")}
    texts |= {"inputs_sha256": calibration.inputs_sha256, "causes": list(calibration.causes)}
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        format=CALIBRATION_FORMAT,
        input_names=np.array(INPUT_NAMES),
        noise_names=np.array(NOISE_NAMES),
        estimator=calibration.estimator,
        azimuth=calibration.azimuth,
        tables=json.dumps(texts),
        **{name: getattr(calibration, name) for name in _ARRAYS},
        **more,
    )
    return buffer.getvalue()


def calibration_json(calibration: Calibration) -> dict[str, object]:
    """A calibration without its draws, for a ROS node or another language; `load_calibration` reads it."""
    return {
        "format": CALIBRATION_FORMAT,
        "estimator": calibration.estimator,
        "aperture_convention": "azimuth" if calibration.azimuth else "in-plane",
        "harmonic_period_deg": dict(calibration.period_deg),
        "estimates": calibration.estimates,
        "covariance": {"names": list(INPUT_NAMES), "matrix": calibration.covariance.tolist()},
        "noise_variance_deg2": dict(calibration.noise_variance),
        "overshoot_steps": dict(calibration.overshoot_steps),
        "range_steps": dict(zip(AXES, calibration.range_steps.tolist(), strict=True)),
        "inputs": dict(calibration.inputs_sha256),
        "expected_error": expected_error(calibration),
    }


def expected_error(calibration: Calibration) -> dict[str, object]:
    """95 % half widths that remain with this calibration, at the middle of the counters it was made with.

    Of the beam's direction, and of its position at 1 m; every approach from left and up.
    """
    middle = [round(float(value)) for value in calibration.range_steps.mean(axis=1)]
    angles = calibration._ray_u95(middle, (1.0, 1.0), None)
    at_1_m = calibration._ray_u95(middle, (1.0, 1.0), 1000.0)
    return {
        "pan_steps": middle[0],
        "tilt_steps": middle[1],
        "u95_azimuth_deg": float(angles[0]),
        "u95_elevation_deg": float(angles[1]),
        "u95_at_1_m_mm": at_1_m.tolist(),
    }


def calibration_header(calibration: Calibration) -> str:
    """A C header with the estimates and the beam as a function of the counters, for a Teensy and its like."""
    template = (shipped_data() / "export" / "tvs_calibration.h").read_text()
    error = expected_error(calibration)
    macro = {name: "TVS_" + name.replace(".", "_").upper() for name in INPUT_NAMES}
    lines = [f"#define {macro[name]} {value!r}" for name, value in calibration.estimates.items()]
    for axis in AXES:
        lines.append(f"#define TVS_PERIOD_{axis.upper()}_DEG {float(calibration.period_deg.get(axis, 0.0))!r}")
        lines.append(f"#define TVS_OVERSHOOT_{axis.upper()}_STEPS {calibration.overshoot_steps[axis]}")
    lines.append(f"#define TVS_AZIMUTH_CONVENTION {int(calibration.azimuth)}")
    stated = (
        f"Expected error ({calibration.estimator}, 95 %) at pan {error['pan_steps']}, tilt {error['tilt_steps']} "
        f"steps: azimuth {error['u95_azimuth_deg']:.3f} deg, elevation {error['u95_elevation_deg']:.3f} deg; "
        f"at 1 m {max(error['u95_at_1_m_mm']):.2f} mm."
    )
    return template.replace("@EXPECTED_ERROR@", stated).replace("@VALUES@", "\n".join(lines))


def load_calibration(path: Path | str) -> Calibration:
    """Load what a robot needs, with NumPy alone.

    Args:
        path: a campaign folder with `results/`, its `results` folder, a `draws.npz`, or the JSON that
            `tvsbayes steps-for CAMPAIGN --export json` prints.

    Returns:
        A calibration: `.ray(pan_steps, tilt_steps)` is the beam, `.locate(..., aperture_deg)` the point in mm with
        its covariance, `.steps_for(xyz_mm)` the counters to go to; from JSON without the draws that
        `tvsbayes.locate` needs.

    Raises:
        InputError: there is no such file, or it is not what tvsbayes wrote.
    """
    path = Path(path)
    if path.is_dir():
        inner = path / "results" / "draws.npz"
        path = inner if inner.exists() or not (path / "draws.npz").exists() else path / "draws.npz"
    if path.suffix == ".json":
        return _from_json(path)
    return read_draws(path)


def _damaged(path: Path, reason: object) -> InputError:
    return InputError(
        "damaged-results",
        f"{escaped(path.name)} is not a calibration that tvsbayes wrote: {escaped(str(reason), 200)}",
        file=escaped(path.name),
        allowed=f"format {CALIBRATION_FORMAT}",
        remedy="run `tvsbayes fit` on the campaign again",
    )


def _shaped(calibration: Calibration) -> Calibration:
    """Refuse arrays of other shapes or with values that are not finite."""
    n, count = len(calibration.inputs), len(INPUT_NAMES)
    shapes = {"mean": (count,), "covariance": (count, count), "range_steps": (2, 2), "inputs": (n, count)}
    shapes |= {"noise": (n, len(NOISE_NAMES)), "cause_covariance": (len(calibration.causes), count, count)}
    for name, shape in shapes.items():
        array = getattr(calibration, name)
        if array.shape != shape or array.dtype != np.float64 or not np.all(np.isfinite(array)):
            raise ValueError(f"{name} has shape {array.shape}, wanted {shape} of finite numbers")
    for text in (calibration.estimator, *calibration.causes):
        # They are printed: on terminals, in reports.
        if not (isinstance(text, str) and len(text) <= NAME_CHARS_MAX and text.isprintable()):
            raise ValueError("a name of an estimator or cause is no plain text")
    if not set(NOISE_NAMES) <= set(calibration.noise_variance) or not set(AXES) <= set(calibration.overshoot_steps):
        raise ValueError("a noise variance or an overshoot is missing")
    if not all(math.isfinite(variance) and variance >= 0 for variance in calibration.noise_variance.values()):
        raise ValueError("a noise variance is no variance")
    if not all(isinstance(steps, int) and steps >= 0 for steps in calibration.overshoot_steps.values()):
        raise ValueError("an overshoot is no number of steps")
    if not all(math.isfinite(period) and period > 0 for period in calibration.period_deg.values()):
        raise ValueError("a period of a transmission error is not positive")
    return calibration


def read_draws(path: Path) -> Calibration:
    """Read `draws.npz`; errors as in `load_calibration`."""
    try:
        file = read_arrays(path, RESULTS_BYTES_MAX, UNPACKED_BYTES_MAX)
        if "format" not in file and "physical" in file:
            raise InputError(
                NO_CALIBRATION,
                f"{escaped(path.name)} holds draws and no calibration: the fit behind it did not converge, or an "
                "older tvsbayes made it",
                file=escaped(path.name),
                remedy="run `tvsbayes fit` on the campaign again",
            )
        columns = (file["input_names"].tolist(), file["noise_names"].tolist())
        if str(file["format"]) != CALIBRATION_FORMAT or columns != (list(INPUT_NAMES), list(NOISE_NAMES)):
            raise ValueError(f"format {str(file['format'])[:60]!r} or other columns")
        tables = _tables(str(file["tables"]), path)
        return _shaped(
            Calibration(
                **{name: file[name] for name in _ARRAYS},
                **{name: tables[name] for name in ("noise_variance", "overshoot_steps", "period_deg")},
                azimuth=bool(file["azimuth"]),
                estimator=str(file["estimator"]),
                inputs_sha256=tables["inputs_sha256"],
                causes=tuple(tables["causes"]),
            )
        )
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise _damaged(path, error) from error


def _tables(text: str, path: Path) -> dict[str, object]:
    try:
        return parse_json(text.encode(), escaped(path.name)).values
    except InputError as error:
        raise _damaged(path, f"its tables are no JSON of tvsbayes: {error.found}") from error


def _from_json(path: Path) -> Calibration:
    keys = parse_json(read_bytes(path, RESULTS_BYTES_MAX), escaped(path.name))
    keys.word("format", (CALIBRATION_FORMAT,))
    convention = keys.word("aperture_convention", ("in-plane", "azimuth"))
    try:
        d = keys.values
        if tuple(d["covariance"]["names"]) != INPUT_NAMES:
            raise ValueError("the covariance names other inputs")
        return _shaped(
            Calibration(
                mean=np.array([d["estimates"][name] for name in INPUT_NAMES], dtype=float),
                covariance=np.array(d["covariance"]["matrix"], dtype=float),
                noise_variance={name: float(value) for name, value in d["noise_variance_deg2"].items()},
                overshoot_steps={axis: int(value) for axis, value in d["overshoot_steps"].items()},
                azimuth=convention == "azimuth",
                period_deg={axis: float(value) for axis, value in d["harmonic_period_deg"].items()},
                estimator=str(d["estimator"]),
                range_steps=np.array([d["range_steps"][axis] for axis in AXES], dtype=float),
                inputs_sha256=dict(d["inputs"]),
            )
        )
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise _damaged(path, error) from error


def stored_calibration(campaign: Campaign) -> Calibration | None:
    """The calibration in `results/` of a campaign folder, if it was made from exactly these data and priors.

    None also where the results hold no calibration (`NO_CALIBRATION`).

    Raises:
        InputError: there are results, but damaged.
    """
    path = None if campaign.path is None else campaign.path / "results" / "draws.npz"
    if path is None or not path.exists():
        return None
    try:
        calibration = read_draws(path)
    except InputError as error:
        if error.code == NO_CALIBRATION:
            return None
        raise
    return calibration if calibration.inputs_sha256 == input_hashes(campaign) else None


def stored_ratios(campaign: Campaign) -> np.ndarray:
    """Draws (n, 4) of the effective ratios left, right, up, down in `results/`, deg/step.

    Raises:
        InputError: missing or damaged.
    """
    path = campaign.path / "results" / "draws.npz"
    try:
        file = read_arrays(path, RESULTS_BYTES_MAX, UNPACKED_BYTES_MAX)
        draws = np.array(file["effective_deg_per_step"], dtype=float)
    except (KeyError, TypeError, ValueError) as error:
        raise _damaged(path, error) from error
    if draws.ndim != 2 or draws.shape[1] != 4 or not np.all(np.isfinite(draws)):
        raise _damaged(path, ValueError("effective_deg_per_step"))
    return draws


@dataclass(frozen=True)
class StoredMode:
    """Where a fit ended, as `draws.npz` keeps it: enough to go on without fitting again.

    Attributes:
        names: parameters, in the order of the coordinates.
        z, covariance: mode and Laplace covariance in prior coordinates, shapes (p,) and (p, p).
        log_density: at the mode.
        prior: value and u of every parameter of the rig that the fit used, shape (2, r).
        valid, weight: whether each spot, in the order of the fit, was used, and its weight; shape (spots,).
    """

    names: tuple[str, ...]
    z: np.ndarray
    covariance: np.ndarray
    log_density: float
    prior: np.ndarray
    valid: np.ndarray
    weight: np.ndarray


_MODE_ARRAYS = ("z", "covariance", "prior", "valid", "weight")


def mode_arrays(mode: StoredMode) -> dict[str, np.ndarray]:
    """The arrays of `draws.npz` that `stored_mode` reads back; the names stand there already."""
    return {f"mode_{name}": getattr(mode, name) for name in _MODE_ARRAYS} | {
        "mode_log_density": np.array(mode.log_density)
    }


def stored_mode(campaign: Campaign) -> StoredMode | None:
    """Where the fit in `results/` ended, if it was made from exactly these data and priors, and converged.

    Raises:
        InputError: there are results, but damaged.
    """
    if stored_calibration(campaign) is None:
        return None
    path = campaign.path / "results" / "draws.npz"
    try:
        file = read_arrays(path, RESULTS_BYTES_MAX, UNPACKED_BYTES_MAX)
        if "mode_z" not in file:
            return None
        found = {name: np.array(file[f"mode_{name}"], dtype=float) for name in (*_MODE_ARRAYS, "log_density")}
        names = tuple(file["names"].tolist())
        count, spots = len(names), sum(spot.status == "ok" for spot in campaign.spots)
        shapes = {"z": (count,), "covariance": (count, count), "valid": (spots,), "weight": (spots,), "log_density": ()}
        if any(found[name].shape != shape for name, shape in shapes.items()) or found["prior"].shape[:1] != (2,):
            raise ValueError("a mode of another shape")
        if not all(np.isfinite(array).all() for array in found.values()):
            raise ValueError("a mode that is not finite")
        return StoredMode(names, **(found | {"log_density": float(found["log_density"])}))
    except (KeyError, TypeError, ValueError) as error:
        raise _damaged(path, error) from error
