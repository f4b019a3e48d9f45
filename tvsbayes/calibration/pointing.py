"""What a robot loads: counters to rays and points, points to counters."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from tvsbayes.calibration.optics import TO_RAD, aperture_angle_deg, beam_components, output_deg, range_components
from tvsbayes.errors import InputError
from tvsbayes.instrument.axes import APPROACH_SIGN, AXES, SIDES, bad_approach, sides_of
from tvsbayes.instrument.parameters import HARMONIC_PRIORS
from tvsbayes.statistics.intervals import NORMAL_95

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
AIM_STEPS, AIM_RAD = 40, 1e-11
DIVERGING_SHARE = 1e-3
"""Share of draws without a point above which a point is refused (DESIGN 5)."""
DIVERGING_SDS = 3.0902323061678132
"""Range over its standard deviation below which more than `DIVERGING_SHARE` of a normal 1/range is beyond infinity."""
NOISES = 5
"""Unit noises of a look: stop error and place in the play (pan, tilt), aperture."""
COMPLEX_STEP = 1e-30
"""Imaginary step of derivatives: nothing is subtracted, so it may be as small as it likes (Squire and Trapp, SIAM
Review 40 (1998) 110)."""


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
            found = np.array([np.arctan(direction[1] / direction[0]), np.arcsin(direction[2])]) / TO_RAD
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
