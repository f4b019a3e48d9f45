"""The calibration for robots: estimates and covariance, from counters to rays and points, and from points to counters.

No JAX, no fit, under a millisecond a call. Frame T: origin mid-baseline, x depth, y along the baseline towards the
positioner at +a/2, z up. mm; degrees where a name says `_deg`; counters in steps, absolute, after homing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tvsbayes.calibration.aiming import Direction, Drive, Point, Steps, mirror_angles
from tvsbayes.calibration.frames import EXTRINSICS_NAMES, NO_POSE, P_INPUTS, camera_slopes, in_cameras, refuse_frame
from tvsbayes.calibration.gear_table import NO_GEARS, GearTable
from tvsbayes.calibration.located_point import Located, meets
from tvsbayes.calibration.optics import (
    TO_RAD,
    Components,
    Number,
    Ray,
    Values,
    ahead,
    aperture_angle_deg,
    beam_components,
    output_deg,
    range_components,
    unit_vector,
)
from tvsbayes.calibration.states import ZERO_NAMES
from tvsbayes.display import Shown, View
from tvsbayes.errors import InputError
from tvsbayes.instrument.axes import AXES, HOME_APPROACH, SIDES, Axis, sides_of
from tvsbayes.instrument.counter_limits import unseen
from tvsbayes.instrument.mechanisms import TWO_MIRROR, Mechanism, mechanism_of
from tvsbayes.instrument.parameters import names_of
from tvsbayes.statistics.intervals import NORMAL_95
from tvsbayes.statistics.predicted_readings import State


def input_names(mechanism: Mechanism) -> tuple[str, ...]:
    """Names of the inputs of a coordinate, constants of the instrument included.

    Contrasts are not among them: they act by the travel, which is part of the state.
    """
    return (
        *names_of("degrees_per_step", "backlash_deg", "harmonic_deg"),
        *(parameter.name for parameter in mechanism.path),
        *names_of("baseline_mm", "pan_zero_emission_deg", "aperture_zero_deg"),
    )


INPUT_NAMES = input_names(TWO_MIRROR)
"""Inputs of a scanner; a head has as many."""
NO_INPUTS: Values = {}
NOISE_NAMES = names_of("stop_sd_deg", "aperture_sd_deg")
"""Noises of a look; those of stops include the scatter of the look, see `drawn_looks.noise_of_a_look`."""
UNIT_NOISES: dict[str, float] = {
    **{f"stop error {axis}": 1.0 for axis in AXES},
    **{f"place in the play, {axis}": 1 / 12 for axis in AXES},
    "aperture noise": 1.0,
}
"""Noises of a look in units of their scale, with variances; a position in the play is uniform."""
NOISES = len(UNIT_NOISES)
STOPS, PLACES, APERTURE = slice(0, 2), slice(2, 4), 4
"""Indices of `UNIT_NOISES` by kind."""
COMPLEX_STEP = 1e-30
"""Imaginary step of derivatives: nothing is subtracted, so it may be arbitrarily small (Squire and Trapp, SIAM Review
40 (1998) 110)."""
type Counters = tuple[Number, Number]
"""Absolute counters (pan, tilt), steps."""
type Sides = tuple[float, float]
"""Approach sides (pan, tilt): +1 left or up, -1 right or down, 0 unknown."""


@dataclass(frozen=True)
class _Moved:
    """Parameters by name, gear errors and unit noises, each changed by an imaginary step.

    Each set changes one of `Calibration.look_inputs` or of the noises; `gears` has the changes alone, by name.
    """

    values: Values
    gears: Values
    noise: np.ndarray


@dataclass(frozen=True, repr=False)
class Calibration(Shown):
    """Estimates and uncertainty of all inputs of a coordinate.

    Attributes:
        mean: best estimates, shape (inputs,), ordered as `INPUT_NAMES`, then the columns of `gears`; units of the
            names.
        covariance: their covariance, shape (inputs, inputs).
        noise_variance: mean variance of each of `NOISE_NAMES`, deg^2.
        overshoot_steps: steps by axis that take up all play with a probability of `CLEARED_PROBABILITY`.
        azimuth: whether the aperture reads the azimuth of the spot, not the angle in the plane of beam and baseline.
        period_deg: period of the transmission error by axis, where there is one.
        estimator: "posterior" or "laplace".
        range_steps: lowest and highest counter per axis at which the campaign looked, shape (2, 2).
        inputs_sha256: hashes of the campaign's data.
        inputs: draws (n, inputs) of the moments; none where only the moments were stored.
        noise: draws (n, 5) of `NOISE_NAMES`, likewise.
        causes: names of the causes of uncertainty in `cause_covariance`; empty where unknown.
        cause_covariance: contribution of each to `covariance`, shape (causes, inputs, inputs).
        gears: counters at which errors of the gears are tabulated; none without repeating errors.
        extrinsics: draws (n, 6) of `EXTRINSICS_NAMES`, row by row with `inputs`; none where only the moments were kept.
        names: names of the inputs: `INPUT_NAMES`, or those of a head in their places.
        states: state by axis at which `mean` and `inputs` hold (`states_of`); empty in results of 0.3: at the homing,
            switched on just then.
        zeros: draws (n, k) of `ZERO_NAMES`, row by row with `inputs`; none where only the moments were kept.
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
    gears: GearTable = NO_GEARS
    extrinsics: np.ndarray = field(default_factory=NO_POSE.copy)
    names: tuple[str, ...] = INPUT_NAMES
    states: Mapping[Axis, State] = field(default_factory=dict)
    zeros: np.ndarray = field(default_factory=lambda: np.zeros((0, len(ZERO_NAMES))))

    def shown(self) -> View:
        """Show estimates with their standard uncertainties, and the range of the looks' counters."""
        (left, right), (low, high) = self.range_steps.tolist()
        title = f"Calibration ({self.estimator}), seen at pan {left:g} to {right:g}, tilt {low:g} to {high:g} steps"
        u = np.sqrt(np.maximum(np.diag(self.covariance), 0.0)).tolist()
        rows = [(name, value, u[k]) for k, (name, value) in enumerate(self.estimates.items())]
        return View(title, ("input", "value", "u"), rows)

    @cached_property
    def estimates(self) -> dict[str, float]:
        """Return best estimates by name, without the errors of the gears."""
        return dict(zip(self.names, self.mean[: len(INPUT_NAMES)].tolist(), strict=True))

    @property
    def look_inputs(self) -> tuple[str, ...]:
        """Return the inputs of one look besides its noises: `INPUT_NAMES`, then the gears' errors there."""
        return (*self.names, *self.gears.inputs)

    def estimates_at(self, steps: Counters) -> dict[str, Any]:
        """Return best estimates by name of `look_inputs`: floats, or for arrays of counters arrays of their shape."""
        pan, tilt = steps
        columns = self.mean[len(INPUT_NAMES) :]
        if isinstance(pan, np.ndarray) or isinstance(tilt, np.ndarray):
            return self.estimates | self.gears.at(columns, steps)
        return self.estimates | self.gears.estimates_at(columns, (pan, tilt))

    @cached_property
    def _moved(self) -> _Moved:
        count = len(self.look_inputs)
        centre = np.zeros(count + NOISES)
        centre[: len(INPUT_NAMES)] = self.mean[: len(INPUT_NAMES)]
        sets = centre + 1j * COMPLEX_STEP * np.eye(count + NOISES)
        values: dict[str, Number] = dict(zip(self.look_inputs, sets[:, :count].T, strict=True))
        gears = {name: values.pop(name) for name in self.gears.inputs}
        values |= {name: math.sqrt(self.noise_variance[name]) for name in NOISE_NAMES}
        return _Moved(values, gears, sets[:, count:].T)

    @cached_property
    def covariance_with_noise(self) -> np.ndarray:
        """Return the covariance of `mean` and the unit noises of a look, shape (inputs + NOISES, inputs + NOISES)."""
        count = len(self.mean)
        covariance = np.diag([*np.zeros(count), *UNIT_NOISES.values()])
        covariance[:count, :count] = self.covariance
        return covariance

    def look_covariance(self, steps: Counters) -> np.ndarray:
        """Compute the covariance of `look_inputs` and unit noises at counters, numbers or arrays (n,): (..., k, k)."""
        if not self.gears.size:
            return self.covariance_with_noise
        looks = self.gears.look_covariance(self.covariance, steps)
        count = looks.shape[-1]
        whole = np.zeros((*looks.shape[:-2], count + NOISES, count + NOISES))
        whole[..., :count, :count] = looks
        whole[..., np.arange(count, count + NOISES), np.arange(count, count + NOISES)] = [*UNIT_NOISES.values()]
        return whole

    def covers(self, pan_steps: Number, tilt_steps: Number) -> bool | np.ndarray:
        """Whether counters, or arrays of one shape, are within those of the campaign's looks."""
        (pan_low, pan_high), (tilt_low, tilt_high) = self.range_steps.tolist()
        inside = (pan_low <= pan_steps) & (pan_steps <= pan_high)
        return inside & (tilt_low <= tilt_steps) & (tilt_steps <= tilt_high)

    @property
    def seen_steps(self) -> dict[Axis, list[float]]:
        """Return the lowest and highest counter of the campaign's looks, by axis."""
        return dict(zip(AXES, self.range_steps.tolist(), strict=True))

    def unseen(self, pan_steps: float, tilt_steps: float) -> str:
        """Say which of these counters are outside those of the looks; "" where none is."""
        return unseen((pan_steps, tilt_steps), self.range_steps)

    def beam_at(
        self, steps: Counters, sides: tuple[Number, Number], m: ModuleType = np, frame: Values = NO_INPUTS
    ) -> Components:
        """Compute the beam of the best estimates at counters and approach sides; `m` as in `output_deg`.

        It is in frame T, or with `P_INPUTS` as `frame` in P.
        """
        values = self.estimates_at(steps)
        pan_deg, tilt_deg = (
            output_deg(values, axis, n, side, self.period_deg.get(axis), m)
            for axis, n, side in zip(AXES, steps, sides, strict=True)
        )
        return beam_components({**self.estimates, **frame}, pan_deg, tilt_deg, m)

    def ray(
        self,
        pan_steps: float,
        tilt_steps: float,
        approach: tuple[str, str] = HOME_APPROACH,
        *,
        frame: str = "T",
        covariance: bool = False,
    ) -> Ray:
        """Compute the beam at counters reached from a side.

        Args:
            pan_steps: absolute counter.
            tilt_steps: absolute counter.
            approach: last move of (pan, tilt): left or right, up or down, or unknown.
            frame: "T", "P", "S", or "camera" for OpenCV's axes of the left camera. S and camera are related to P by the
                extrinsics of the fit.
            covariance: also compute the covariance of origin and direction, by the law of propagation (GUM 5.2), from
                all parameters, stop errors, and for the cameras' frames the extrinsics.

        Raises:
            InputError: there is no such approach or frame, or the calibration has no extrinsics.
        """
        refuse_frame(frame, self.extrinsics)
        steps, sides = (pan_steps, tilt_steps), sides_of(approach)
        beam = self.beam_at(steps, sides, math, NO_INPUTS if frame == "T" else P_INPUTS)
        ray, at = np.array([*beam.origin, *beam.direction]), (float(pan_steps), float(tilt_steps))
        ray_covariance = self._ray_covariance(ray, at, sides, frame) if covariance else None
        if frame in ("S", "camera"):
            ray = in_cameras(ray, self._pose, frame)
        return Ray(ray[:3], ray[3:], not self.covers(pan_steps, tilt_steps), frame, ray_covariance)

    @cached_property
    def _pose(self) -> np.ndarray:
        """Return the best estimates of the extrinsics, shape (6,)."""
        return self.extrinsics.mean(axis=0)

    @cached_property
    def _covariance_with_pose(self) -> np.ndarray:
        """Compute the covariance of `INPUT_NAMES`, the extrinsics, and the columns of the gears."""
        first, pose = len(INPUT_NAMES), len(EXTRINSICS_NAMES)
        drawn = np.column_stack([self.inputs[:, :first], self.extrinsics, self.inputs[:, first:]])
        drawn_covariance = np.cov(drawn, rowvar=False)
        kept = np.r_[0:first, first + pose : len(drawn_covariance)]
        drawn_covariance[np.ix_(kept, kept)] = self.covariance
        return drawn_covariance

    def _ray_covariance(self, ray: np.ndarray, steps: Counters, sides: Sides, frame: str) -> np.ndarray:
        """Compute the covariance (6, 6) of a ray (6,), given in T for frame T, else in P."""
        moved = self._moved_beam(steps, sides, NO_INPUTS if frame == "T" else P_INPUTS)
        slopes = np.array([*moved.origin, *moved.direction]).imag / COMPLEX_STEP
        if frame in ("T", "P"):
            return slopes @ self.look_covariance(steps) @ slopes.T
        first, pose = len(INPUT_NAMES), len(EXTRINSICS_NAMES)
        at = self._covariance_with_pose
        at = self.gears.look_covariance(at, steps) if self.gears.size else at
        looks = np.r_[0:first, first + pose : len(at)]
        by_ray, by_pose = np.split(camera_slopes(ray, self._pose, frame), 2, axis=1)
        whole = np.zeros((6, len(at)))
        whole[:, looks] = by_ray @ slopes[:, : len(looks)]
        whole[:, first : first + pose] = by_pose
        scatter = by_ray @ slopes[:, len(looks) :]
        return whole @ at @ whole.T + scatter @ np.diag([*UNIT_NOISES.values()]) @ scatter.T

    def locate(
        self, pan_steps: float, tilt_steps: float, aperture_deg: float, approach: tuple[str, str] = HOME_APPROACH
    ) -> Located:
        """Locate the point of beam and aperture reading, with covariance by the law of propagation (GUM 5.2).

        The covariance includes stop errors, aperture noise and all parameters. `tvsbayes.locate` propagates the draws
        through the geometry instead.

        Args:
            pan_steps: absolute counter.
            tilt_steps: absolute counter.
            aperture_deg: reading B.
            approach: as in `ray`.

        Raises:
            InputError: there is no such approach, or beam and line of sight do not meet, or do not with a probability
                above 0.1 % (formulation 5).
        """
        sides = sides_of(approach)
        steps = (float(pan_steps), float(tilt_steps))
        if not all(map(math.isfinite, (*steps, aperture_deg))):
            raise self.refusal(pan_steps, tilt_steps, aperture_deg, sides)
        beam = self.beam_at(steps, sides, math)
        true_deg = aperture_deg - self.estimates["aperture_zero_deg"]
        reach = range_components(*beam, self.estimates["baseline_mm"], true_deg, self.azimuth, math)
        if not (0 < reach < math.inf and ahead(beam.at(reach)[0])):
            raise self.refusal(pan_steps, tilt_steps, aperture_deg, sides)
        jacobian = self.derivatives(*steps, aperture_deg, approach)
        covariance = jacobian @ self.look_covariance(steps) @ jacobian.T
        if not meets(reach, np.array(beam.direction), covariance):
            raise self.refusal(pan_steps, tilt_steps, aperture_deg, sides)
        point, u95 = beam.at(reach), NORMAL_95 * np.sqrt(np.diag(covariance))
        return Located(point, covariance, u95, not self.covers(*steps), self.unseen(*steps))

    def refusal(self, pan_steps: float, tilt_steps: float, aperture_deg: float, sides: Sides) -> InputError:
        """Explain why beam and line of sight of a look have no common point, or none of finite uncertainty.

        The code is "grazing" where the estimated beam misses the aperture's cone, "behind" where it meets the reading
        behind the baseline, else "diverging".
        """
        where = f"pan {pan_steps:g}, tilt {tilt_steps:g} steps, aperture {aperture_deg:g} deg"
        refused, meet_mm = partial(InputError, column="aperture_deg", found=f"{aperture_deg:g}"), math.nan
        if all(map(math.isfinite, (pan_steps, tilt_steps, aperture_deg))):
            beam = self.beam_at((pan_steps, tilt_steps), sides, math)
            true_deg = aperture_deg - self.estimates["aperture_zero_deg"]
            reach = range_components(*beam, self.estimates["baseline_mm"], true_deg, self.azimuth, math)
            meet_mm = float(reach)
            if 0 < reach < math.inf and not ahead(beam.at(reach)[0]):
                return refused(
                    "behind",
                    f"{where}: the point ({', '.join(f'{x:.0f}' for x in beam.at(reach))}) mm lies behind the scanner",
                    allowed="points before the baseline: x above 0",
                    remedy="check the counters: they are absolute, after homing, and turn the beam to the back",
                )
            if math.isnan(reach) and not self.azimuth:
                return refused(
                    "grazing",
                    f"{where}: the beam passes the cone of all points seen under this angle without touching it",
                    allowed="readings away from 0 and 180 deg, of a beam in the plane of baseline and spot",
                    remedy="check reading and counters; the beam runs past the baseline, not towards a spot",
                )
        meet = 0 < meet_mm < math.inf
        return refused(
            "diverging",
            f"{where}: beam and line of sight "
            + (f"would meet {meet_mm / 1000:.3g} m away, but within what is known may diverge" if meet else "diverge"),
            allowed="readings B with B + C clearly below 180 deg, C the beam's own angle to the baseline",
            remedy="check reading and counters; such a target is too far, or behind the scanner",
        )

    def noisy_beam(self, values: Values, noise: np.ndarray, steps: Counters, sides: Sides) -> Components:
        """Compute the beam with stop errors, and with a random position in the play where the side is unknown.

        Args:
            values: `look_inputs` at these counters and `NOISE_NAMES`, by name; arrays of one shape.
            noise: `NOISES` unit noises, first axis, arrays of that shape (`Drawn`).
            steps: counters.
            sides: approach sides.
        """
        angles = []
        for k, (axis, side) in enumerate(zip(AXES, sides, strict=True)):
            low, high = (values[f"stop_sd_deg.{name}"] for name in SIDES[axis])
            stop_sd = high if side > 0 else low if side < 0 else np.sqrt(0.5 * (low**2 + high**2))
            # If the side is unknown, the position in the play is uniform.
            place = side if side else -2 * noise[PLACES][k]
            angles.append(output_deg(values, axis, steps[k], place, self.period_deg.get(axis)) + stop_sd * noise[k])
        return beam_components(values, angles[0], angles[1])

    def derivatives(
        self, pan_steps: float, tilt_steps: float, aperture_deg: float, approach: tuple[str, str] = HOME_APPROACH
    ) -> np.ndarray:
        """Compute sensitivities of a point to `look_inputs` (their units) and to the unit noises of the look, mm.

        Noises have the root mean square of their standard deviations.

        Args:
            pan_steps: absolute counter.
            tilt_steps: absolute counter.
            aperture_deg: reading B.
            approach: last move of (pan, tilt): left or right, up or down, or unknown.

        Returns:
            Shape (3, look inputs + NOISES).

        Raises:
            InputError: an approach that does not exist, or beam and line of sight do not meet.
        """
        sides = sides_of(approach)
        moved = self.moved_points((np.array([pan_steps]), np.array([tilt_steps])), sides, np.array([aperture_deg]))
        if not np.all(np.isfinite(moved)):
            raise self.refusal(pan_steps, tilt_steps, aperture_deg, sides)
        return moved[..., 0].imag / COMPLEX_STEP

    def points(
        self, values: Values, noise: np.ndarray, steps: Counters, sides: Sides, aperture_deg: np.ndarray
    ) -> np.ndarray:
        """Compute points where beams meet the aperture's readings, first axis x, y, z; NaN where they do not.

        Args:
            values: as for `noisy_beam`, as are the next three.
            noise: unit noises.
            steps: counters; they and the readings broadcast with the values.
            sides: approach sides.
            aperture_deg: readings B.
        """
        beam = self.noisy_beam(values, noise, steps, sides)
        true_deg = aperture_deg - values["aperture_zero_deg"] - values["aperture_sd_deg"] * noise[APERTURE]
        reach = np.asarray(range_components(*beam, values["baseline_mm"], true_deg, self.azimuth))
        return beam.met(reach)

    def moved_points(self, steps: Counters, sides: Sides, aperture_deg: np.ndarray) -> np.ndarray:
        """Compute points of many looks of one approach, complex, shape (3, look inputs + NOISES, n).

        The real part is the point, equal along the second axis, NaN where there is none. The imaginary part over
        `COMPLEX_STEP` is its derivative by that input or unit noise.

        Args:
            steps: counters (pan, tilt), each (n,).
            sides: approach sides of all.
            aperture_deg: readings B, shape (n,).
        """
        values = {k: v[:, None] if isinstance(v, np.ndarray) else v for k, v in self._moved.values.items()}
        values |= self._moved_gears(steps)
        return self.points(values, self._moved.noise[..., None], steps, sides, aperture_deg)

    def _moved_gears(self, steps: Counters) -> dict[str, np.ndarray]:
        """Return changed gear errors at counters, numbers or arrays (n,); shape (look inputs + NOISES, ...)."""
        estimates = self.estimates_at(steps) if self.gears.size else {}
        return {name: np.add.outer(self._moved.gears[name], estimates[name]) for name in self.gears.inputs}

    def steps_for(
        self,
        xyz_mm: ArrayLike | None = None,
        *,
        azimuth_deg: float | None = None,
        elevation_deg: float | None = None,
        approach: tuple[str, str] | None = None,
        limits: Mapping[str, tuple[float, float]] | None = None,
    ) -> Steps:
        """Compute counters that aim the beam at a point, or along a direction, of frame T.

        Args:
            xyz_mm: target point; or give a direction by
            azimuth_deg: atan2(d_y, d_x), the emission angle C less 90 deg, and
            elevation_deg: asin(d_z).
            approach: side from which each axis arrives; None takes left and up where the limits allow.
            limits: lowest and highest counter by axis ("pan", "tilt").

        Raises:
            InputError: neither or both targets are given, no mirror angle reaches it, or it is outside the limits.
        """
        target = self._target(xyz_mm, azimuth_deg, elevation_deg)
        arrivals = []
        for index, (axis, angle_deg) in enumerate(zip(AXES, mirror_angles(self.estimates, target), strict=True)):
            wanted = None if approach is None else approach[index]
            arrivals.append(self.drive(axis).arrival(angle_deg, wanted, (limits or {}).get(axis)))
        pan, tilt = arrivals
        reached = pan.side, tilt.side
        ray = self.ray(pan.steps, tilt.steps, reached)
        steps = Steps(
            *(pan.steps, tilt.steps, reached, pan.via_steps, tilt.via_steps, ray),
            extrapolated=ray.extrapolated,
            unseen=self.unseen(pan.steps, tilt.steps),
        )
        counters, sides = (float(pan.steps), float(tilt.steps)), sides_of(reached)
        o, d = ray.origin_mm, ray.direction
        if isinstance(target, Direction):
            goal = unit_vector(target.azimuth_deg, target.elevation_deg)
            rounding = math.degrees(math.atan2(np.linalg.norm(np.cross(d, goal)), d @ goal))
            return replace(steps, rounding_deg=rounding, u95_deg=self.beam_u95_deg(counters, sides))
        reach = float((target.xyz_mm - o) @ d)
        point = o + reach * d
        return replace(
            steps,
            xyz_mm=point,
            aperture_deg=self.reading(point) if mechanism_of(self.estimates).has_receiver else None,
            rounding_mm=float(np.linalg.norm(target.xyz_mm - point)),
            u95_mm=self.beam_u95_mm(counters, sides, reach),
        )

    def drive(self, axis: Axis) -> Drive:
        """Return the conversion between counters and mirror angles of an axis."""

        def values_at(counter: float) -> dict[str, Any]:
            return self.estimates_at((counter, 0.0) if axis == AXES[0] else (0.0, counter))

        return Drive(axis, values_at, self.period_deg.get(axis), self.overshoot_steps[axis])

    @staticmethod
    def _target(xyz_mm: ArrayLike | None, azimuth_deg: float | None, elevation_deg: float | None) -> Point | Direction:
        """Return the target of `steps_for`."""
        if xyz_mm is not None and azimuth_deg is None and elevation_deg is None:
            return Point(np.asarray(xyz_mm, dtype=float))
        if xyz_mm is None and azimuth_deg is not None and elevation_deg is not None:
            return Direction(azimuth_deg, elevation_deg)
        remedy = "give a point, or azimuth and elevation"
        raise InputError("no-target", "steps_for needs one target, a point or a direction", remedy=remedy)

    def reading(self, point: np.ndarray) -> float:
        """Compute the aperture's reading for a point of frame T, degrees."""
        x, y, z = point.tolist()
        angle = aperture_angle_deg((x, y, z), self.estimates["baseline_mm"], self.azimuth, math)
        return float(angle) + self.estimates["aperture_zero_deg"]

    def beam_u95_deg(self, steps: Counters, sides: Sides) -> np.ndarray:
        """Compute 95 % half widths of the beam's azimuth and elevation (2,), degrees."""
        _, (u, v, w) = self._moved_beam(steps, sides)
        # The derivatives of the azimuth atan2(y, x) are those of atan(y / x).
        return self._u95(np.array([np.arctan(v / u), np.arcsin(w)]) / TO_RAD, steps)

    def beam_u95_mm(self, steps: Counters, sides: Sides, range_mm: float) -> np.ndarray:
        """Compute 95 % half widths of the beam's position at a range (3,), mm."""
        return self._u95(self._moved_beam(steps, sides).at(range_mm), steps)

    def _moved_beam(self, steps: Counters, sides: Sides, frame: Values = NO_INPUTS) -> Components:
        values = {**self._moved.values, **self._moved_gears(steps), **frame}
        return self.noisy_beam(values, self._moved.noise, steps, sides)

    def _u95(self, moved: np.ndarray, steps: Counters) -> np.ndarray:
        """Compute half widths (q,) of quantities (q, look inputs + NOISES) of the changed parameters."""
        jacobian = moved.imag / COMPLEX_STEP
        return NORMAL_95 * np.sqrt(np.diag(jacobian @ self.look_covariance(steps) @ jacobian.T))
