"""The target of a measurement in words, and its sensitivity to the coordinates.

Ratios in deg/step, backlashes in deg, mirror offset and coordinates of a point (frame T) in mm.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from tvsbayes.calibration.drawn_looks import noise_of_a_look
from tvsbayes.calibration.pointing import APERTURE, STOPS, Calibration, input_names
from tvsbayes.calibration.pointing import NOISE_NAMES as CALIBRATION_NOISE
from tvsbayes.errors import InputError, escaped
from tvsbayes.instrument.axes import APPROACH_SIGN, DIRECTIONS
from tvsbayes.instrument.parameters import LOOK_SCATTER_NAMES, TARGET_ROWS, TARGETS
from tvsbayes.instrument.protocols import RUN_UP_STEPS
from tvsbayes.instrument.rig import RigTable
from tvsbayes.model.parameter_space import ParameterSpace, named_at, physical_at
from tvsbayes.planning.gear_places import NO_PLACES, GearPlaces
from tvsbayes.results.records import Record
from tvsbayes.statistics.intervals import NORMAL_95

UNITS = {
    **{name: quantity.unit for name, quantity in TARGETS.items()},
    **{"worst": "deg/step", "x": "mm", "y": "mm", "z": "mm", "xyz": "mm"},
}
OF_A_LOOK = (*CALIBRATION_NOISE, *LOOK_SCATTER_NAMES)
COORDINATES = {"x": (0,), "y": (1,), "z": (2,), "xyz": (0, 1, 2)}
DEFAULT_TARGET = "u(worst) <= 2e-4 deg/step"
"""The limit is 0.3 % of the paper's ratios: above the floor by stereo and a focal scale known to 0.2 %."""


class Target(Record, frozen=True, rename={"point_mm": "at_mm"}):
    """The target of a measurement: an uncertainty with a limit.

    Attributes:
        text: as written.
        quantity: one of `UNITS`.
        limit: limit in the unit.
        unit: deg/step, deg or mm.
        point_mm: point of a target coordinate, frame T.
        expanded95: whether the uncertainty is U95, not u.
    """

    text: str
    quantity: str
    limit: float
    unit: str
    point_mm: tuple[float, float, float] | None = None
    expanded95: bool = False

    @property
    def factor(self) -> float:
        """Return the ratio to u: 1 for u, 1.96 for U95."""
        return NORMAL_95 if self.expanded95 else 1.0

    @property
    def indices(self) -> tuple[int, ...]:
        """Return the rows of the headlines, or of x, y, z; the target is the worst of them."""
        if self.quantity in COORDINATES:
            return COORDINATES[self.quantity]
        return tuple(range(len(DIRECTIONS))) if self.quantity == "worst" else (TARGET_ROWS[self.quantity],)

    @property
    def of_ratios(self) -> bool:
        """Whether the target is an effective ratio, which the four-point method estimates too."""
        return self.quantity == "worst" or self.quantity in DIRECTIONS


_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_TARGET = re.compile(
    rf"\s*(?P<kind>u|U95)\s*\(\s*(?P<name>[\w.]+)\s*\)"
    rf"(?:\s+at\s+(?P<at>{_NUMBER}\s*,\s*{_NUMBER}\s*,\s*{_NUMBER})\s*mm)?"
    rf"\s*<=\s*(?P<limit>{_NUMBER})\s*(?P<unit>deg/step|deg|mm)\s*",
    re.ASCII,
)
SMALLEST_LIMIT, LARGEST_NUMBER = 1e-12, 1e9
"""Least limit and largest number of a target: numbers beyond these are typing errors, and their squares overflow."""
_NAMED = {
    unit: ", ".join(name for name in dict.fromkeys((*DIRECTIONS, "worst", *TARGETS)) if UNITS[name] == unit)
    for unit in UNITS.values()
}
TARGET_FORMS = (
    "u(NAME) <= NUMBER UNIT or U95(NAME) <= NUMBER UNIT with NAME "
    + ", ".join(f"{names} ({unit})" for unit, names in _NAMED.items())
    + "; or u or U95 of x, y, z or xyz at X,Y,Z mm <= NUMBER mm"
)


def parse_target(text: str) -> Target:
    """Read a target such as `u(left) <= 2e-4 deg/step` or `U95(x) at 1000,0,0 mm <= 60 mm`.

    Raises:
        InputError: the text has another form; the allowed forms are named.
    """

    def refuse(found: str, remedy: str) -> InputError:
        shown = escaped(text, 120)
        message = f"--target {shown!r}: {found}; allowed: {TARGET_FORMS}; {remedy}"
        return InputError("target", message, column="--target", found=shown, allowed=TARGET_FORMS, remedy=remedy)

    match = _TARGET.fullmatch(text) if len(text) <= 200 else None
    if match is None:
        raise refuse("not of that form", f"write for example '{DEFAULT_TARGET}'")
    name, unit, limit = match["name"], match["unit"], float(match["limit"])
    if name not in UNITS:
        raise refuse(f"no quantity {name}", "name one of the quantities")
    if unit != UNITS[name]:
        raise refuse(f"{name} is in {UNITS[name]}, not {unit}", f"state the limit in {UNITS[name]}")
    if not SMALLEST_LIMIT <= limit < LARGEST_NUMBER:
        raise refuse(f"the limit {limit:g}", f"state a limit from {SMALLEST_LIMIT:g} to {LARGEST_NUMBER:g}")
    if (match["at"] is None) == (name in COORDINATES):
        remedy = "name the point: at 1000,0,0 mm" if name in COORDINATES else "leave the point out"
        raise refuse("a coordinate needs a point, and nothing else has one", remedy)
    point = None
    if match["at"] is not None:
        x, y, z = map(float, match["at"].split(","))
        point = x, y, z
    if point is not None and max(map(abs, point)) > LARGEST_NUMBER:
        raise refuse("the point is too far away", f"state its coordinates within {LARGEST_NUMBER:g} mm")
    return Target(" ".join(text.split()), name, limit, unit, point, match["kind"] == "U95")


@dataclass(frozen=True)
class Sensitivity:
    """Sensitivity of a target to the coordinates, at one point of parameter space, or several by a leading axis.

    Attributes:
        gradient: d(quantity)/d(coordinates, errors of gears) of each quantity of the target, shape (q, p + e).
        own: variance by cause that no calibration lowers, shapes (q,): the stop and the reading at the point itself,
            and gear errors at its counters independent of those at the places.
    """

    gradient: np.ndarray
    own: Mapping[str, np.ndarray] = field(default_factory=dict)

    @property
    def own_variance(self) -> np.ndarray:
        """Sum the own variances, shape (q,)."""
        return sum(self.own.values(), np.zeros(self.gradient.shape[:-1]))

    def values(self, covariance: np.ndarray, factor: float = 1.0) -> np.ndarray:
        """Compute the target's values under covariances (..., p + e, p + e) of coordinates and errors."""
        variance = np.sum((self.gradient @ covariance) * self.gradient, axis=-1) + self.own_variance
        return factor * np.sqrt(variance.max(axis=-1))

    def value(self, covariance: np.ndarray, factor: float = 1.0) -> float:
        """Compute the target's value under a covariance (p + e, p + e), at one point."""
        return float(self.values(covariance, factor))


STOP_AT_POINT, NOISE_AT_POINT = "stop error at the point", "aperture noise at the point"
GEARS_AT_POINT = "gear errors between the places"


def sensitivity(
    target: Target,
    z: np.ndarray,
    space: ParameterSpace,
    table: RigTable,
    pose_rad: np.ndarray,
    gears: GearPlaces = NO_PLACES,
) -> Sensitivity:
    """Linearise a target at a point of parameter space.

    Args:
        target: the target.
        z: coordinates, shape (p,).
        space: priors.
        table: aperture's convention and periods.
        pose_rad: pose of effective ratios, shape (2,).
        gears: places of the gears' errors as further coordinates; ratios are then slopes of lines over these places.

    Raises:
        InputError: no beam reaches the target's point.
    """
    rows = list(target.indices)
    if target.point_mm is None:
        return Sensitivity(np.asarray(gears.headlines(z, space, pose_rad).gradient)[rows])
    names, at = input_names(space.mechanism), physical_at(z, space)
    inputs, noise = (named_at(at, space.mechanism, wanted) for wanted in (names, OF_A_LOOK))
    stop_sd = noise_of_a_look(dict(zip(OF_A_LOOK, noise.value, strict=True)))
    azimuth = table.aperture_convention == "azimuth"
    calibration = Calibration(
        mean=inputs.value,
        covariance=inputs.slope @ inputs.slope.T,
        noise_variance=dict(zip(CALIBRATION_NOISE, stop_sd**2, strict=True)),
        overshoot_steps={"pan": RUN_UP_STEPS, "tilt": RUN_UP_STEPS},
        azimuth=azimuth,
        period_deg=table.first_period_deg,
        names=names,
    )
    goal = calibration.steps_for(target.point_mm)
    assert goal.aperture_deg is not None, "a point has a reading"
    count = len(names)
    jacobian = calibration.derivatives(goal.pan_steps, goal.tilt_steps, goal.aperture_deg, goal.approach)[rows]
    variances = jacobian[:, count:] ** 2
    by_source = {STOP_AT_POINT: variances[:, STOPS].sum(axis=1), NOISE_AT_POINT: variances[:, APERTURE]}
    gradient = jacobian[:, :count] @ inputs.slope
    if not gears.size:
        return Sensitivity(gradient, by_source)
    # Derivatives per rad of both mirrors, from those by standardised stop errors.
    stop_columns = [CALIBRATION_NOISE.index(f"stop_sd_deg.{name}") for name in goal.approach]
    by_angle = jacobian[:, count : count + 2] / np.radians(stop_sd[stop_columns])
    kriged = [gears.between(np.array([steps]), axis) for axis, steps in enumerate((goal.pan_steps, goal.tilt_steps))]
    signs = [APPROACH_SIGN[name] for name in goal.approach]
    turning = np.stack([np.append(one.error[0], -0.5 * s * one.play[0]) for one, s in zip(kriged, signs, strict=True)])
    residual_variance = np.array([one.error_rest[0] ** 2 + 0.25 * one.play_rest[0] ** 2 for one in kriged])
    by_source[GEARS_AT_POINT] = by_angle**2 @ residual_variance
    return Sensitivity(np.concatenate([gradient, by_angle @ turning], axis=1), by_source)
