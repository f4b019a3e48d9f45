"""TVS coordinates: points where beam and aperture reading meet, in mm, with their uncertainty; NumPy.

Frame T: origin mid-baseline, x depth, y along the baseline towards the positioner at +a/2, z up; the aperture is at (0,
-a/2, 0). Uncertainty is propagated by the law (GUM 5) and by distributions (JCGM 101, 102), and the first is validated
by the second.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, cast

import numpy as np

from tvsbayes.calibration.drawn_looks import Drawn, drawn
from tvsbayes.calibration.located_point import DIVERGING_SHARE
from tvsbayes.calibration.pointing import (
    COMPLEX_STEP,
    INPUT_NAMES,
    NOISES,
    Calibration,
)
from tvsbayes.display import Shown, View
from tvsbayes.errors import InputError, plural, require_kind
from tvsbayes.instrument.axes import HOME_APPROACH, sides_of
from tvsbayes.progress import Job, Show
from tvsbayes.statistics.intervals import NORMAL_95, Validation, symmetric_interval, validate

DRAWS = 1000
"""Default number of draws for a point; formulation 5 requires at least 500."""
BLOCK = 2**15
"""Numbers per array while draws are propagated to points: larger arrays exceed the processor's cache."""


@dataclass(frozen=True, repr=False)
class Locations(Shown):
    """Points of frame T with their uncertainty; arrays over points, NaN where a point is refused.

    Attributes:
        xyz_mm: means of the draws, shape (n, 3).
        covariance_mm2: shape (n, 3, 3).
        interval95_mm: equal-tailed intervals, shape (n, 2, 3).
        u95_mm: their half widths, shape (n, 3).
        diverging_share: share of draws without a point, shape (n,).
        extrapolated: whether the counters are outside those of the campaign's looks, shape (n,).
        unseen: these counters and the range of the looks, in words; "" where not extrapolated.
        linear_xyz_mm, linear_covariance_mm2: results of the law of propagation, shapes (n, 3) and (n, 3, 3).
        validation: validation of the law by the draws (JCGM 101 clause 8), fields of shape (n, 3).
        refused: the refusal of each point, or None.
        estimator: "posterior" or "laplace".
        draws: number of draws.
    """

    xyz_mm: np.ndarray
    covariance_mm2: np.ndarray
    interval95_mm: np.ndarray
    u95_mm: np.ndarray
    diverging_share: np.ndarray
    extrapolated: np.ndarray
    linear_xyz_mm: np.ndarray
    linear_covariance_mm2: np.ndarray
    validation: Validation
    refused: tuple[InputError | None, ...]
    unseen: tuple[str, ...]
    estimator: str
    draws: int

    def shown(self) -> View:
        """Show points with their uncertainty, refused ones with the reason."""
        columns = ("point", *(f"{axis}, mm" for axis in "xyz"), *(f"U95({axis}), mm" for axis in "xyz"))
        rows = []
        for k, error in enumerate(self.refused):
            note = f"refused: {error.code}" if error is not None else "EXTRAPOLATED" if self.extrapolated[k] else ""
            numbers = [None] * 6 if error is not None else [*self.xyz_mm[k].tolist(), *self.u95_mm[k].tolist()]
            rows.append((k, *numbers, note))
        points = f"{plural(len(self.refused), 'point')}"
        title = f"Locations of {points}, frame T, {self.draws} draws ({self.estimator})"
        return View(title, (*columns, "note"), rows)

    @cached_property
    def law_off_mm(self) -> np.ndarray:
        """Return the largest difference of an end of the law's 95 % interval from that of the draws, shape (n,)."""
        return self.validation.deviation.max(axis=1)

    @cached_property
    def digits_held(self) -> np.ndarray:
        """Count the significant digits of u, at most two, to which the law of propagation holds, shape (n, 3)."""
        return self.validation.digits_held(np.sqrt(np.diagonal(self.linear_covariance_mm2, 0, 1, 2)))

    def as_json(self, index: int) -> dict[str, object]:
        """Return the document of one point; null where it is refused."""
        error = self.refused[index]
        if error is not None:
            empty = dict.fromkeys(("xyz_mm", "covariance_mm2", "u95_mm"))
            refused = {"code": error.code, "message": error.message}
            beyond = {"extrapolated": bool(self.extrapolated[index]), "unseen": self.unseen[index]}
            return {**empty, **beyond, "refused": refused}
        u = np.sqrt(np.diag(self.linear_covariance_mm2[index]))
        v = self.validation
        return {
            "xyz_mm": self.xyz_mm[index].tolist(),
            "covariance_mm2": self.covariance_mm2[index].tolist(),
            "u95_mm": self.u95_mm[index].tolist(),
            "interval95_mm": self.interval95_mm[index].T.tolist(),
            "diverging_share": float(self.diverging_share[index]),
            "extrapolated": bool(self.extrapolated[index]),
            "unseen": self.unseen[index],
            "linear": {
                "xyz_mm": self.linear_xyz_mm[index].tolist(),
                "covariance_mm2": self.linear_covariance_mm2[index].tolist(),
                "u95_mm": (NORMAL_95 * u).tolist(),
                "digits": v.digits,
                "validated": bool(v.validated[index].all()),
                "digits_held": int(self.digits_held[index].min()),
                "decided": bool(v.decided[index].all()),
                "deviation_mm": v.deviation[index].tolist(),
                "tolerance_mm": v.tolerance[index].tolist(),
            },
        }


@dataclass(frozen=True)
class Settings:
    """Counters, approaches and aperture readings of looks.

    Attributes:
        steps: counters (pan, tilt), shape (n, 2).
        side: approach sides, +1 left or up, -1 right or down, 0 unknown, shape (n, 2).
        aperture_deg: readings, shape (n,).
        lines: their lines in a file, from 1, shape (n,); else their numbers.
    """

    steps: np.ndarray
    side: np.ndarray
    aperture_deg: np.ndarray
    lines: np.ndarray

    def __len__(self) -> int:
        return len(self.steps)

    def __getitem__(self, chosen: slice) -> Settings:
        return Settings(*(each[chosen] for each in vars(self).values()))

    def of_one_approach(self) -> Iterator[np.ndarray]:
        """Group the rows of points by their sides."""
        _, kind = np.unique(self.side, axis=0, return_inverse=True)
        for number in range(kind.max() + 1):
            yield np.flatnonzero(kind == number)


@dataclass(frozen=True)
class Linear:
    """The law of propagation of uncertainty: y = f(x), J = df/dx, U_y = J U_x J^T (GUM 5.2.2, JCGM 102 6.2).

    Attributes:
        value: points, shape (n, 3), NaN where there is none.
        jacobian: derivatives by the calibration's `look_inputs` and the unit noises, shape (n, 3, inputs + NOISES).
        covariance: shape (n, 3, 3).
    """

    value: np.ndarray
    jacobian: np.ndarray
    covariance: np.ndarray


def settings_of(
    pan_steps: float | Sequence[float] | np.ndarray,
    tilt_steps: float | Sequence[float] | np.ndarray,
    aperture_deg: float | Sequence[float] | np.ndarray,
    approach: tuple[str, str] | Sequence[tuple[str, str]] = HOME_APPROACH,
    lines: Sequence[int] | None = None,
) -> Settings:
    """Build the settings of many points; arguments and errors as in `locate`, `lines` in their file."""
    numbers = [np.atleast_1d(np.asarray(x, dtype=float)) for x in (pan_steps, tilt_steps, aperture_deg)]
    pan, tilt, reading = np.broadcast_arrays(*numbers)
    single = len(approach) == 2 and isinstance(approach[0], str)
    pairs = cast("Sequence[tuple[str, str]]", [approach] if single else approach)
    known = {(pan_side, tilt_side): sides_of((pan_side, tilt_side)) for pan_side, tilt_side in pairs}
    side = np.broadcast_to(np.array([known[pan_side, tilt_side] for pan_side, tilt_side in pairs]), (len(pan), 2))
    numbered = np.arange(len(pan)) if lines is None else np.asarray(lines)
    return Settings(np.stack([pan, tilt], axis=1), side, np.array(reading), numbered)


def carry(calibration: Calibration, rigs: Drawn, settings: Settings) -> np.ndarray:
    """Propagate every draw through the geometry for every point: (draws, points, 3), NaN where nothing meets."""
    noise = rigs.noise.T[:, :, None]
    xyz = np.empty((len(rigs.inputs), len(settings), 3))
    for rows in settings.of_one_approach():
        steps, side = settings.steps[rows].T, settings.side[rows[0]]
        values = rigs.values_at(calibration, (steps[0], steps[1]))
        points = calibration.points(values, noise, (steps[0], steps[1]), (*side,), settings.aperture_deg[rows])
        xyz[:, rows] = points.transpose(1, 2, 0)
    return xyz


def locate_linear(calibration: Calibration, settings: Settings) -> Linear:
    """Apply the law of propagation alone: fields with a leading axis of points, NaN where there is no point.

    Without draws it computes a million points a minute. Validate some of them with `locate`.
    """
    count, inputs = len(settings), len(calibration.look_inputs) + NOISES
    value, jacobian = np.empty((count, 3)), np.empty((count, 3, inputs))
    covariance = np.empty((count, 3, 3))
    for rows in settings.of_one_approach():
        for part in np.array_split(rows, -(-len(rows) * inputs // BLOCK)):
            steps, side = settings.steps[part].T, settings.side[part[0]]
            moved = calibration.moved_points((steps[0], steps[1]), (*side,), settings.aperture_deg[part])
            value[part] = moved[:, 0].real.T
            slope = (moved.imag / COMPLEX_STEP).transpose(2, 0, 1)
            jacobian[part] = slope
            covariance[part] = slope @ calibration.look_covariance((steps[0], steps[1])) @ slope.transpose(0, 2, 1)
    return Linear(value, jacobian, covariance)


def locate(
    calibration: Calibration,
    pan_steps: float | Sequence[float] | np.ndarray,
    tilt_steps: float | Sequence[float] | np.ndarray,
    aperture_deg: float | Sequence[float] | np.ndarray,
    approach: tuple[str, str] | Sequence[tuple[str, str]] = HOME_APPROACH,
    *,
    draws: int = DRAWS,
    seed: int = 0,
    progress: Show | None = None,
) -> Locations:
    """Locate points of looks in frame T, by the draws of a calibration and by the law of propagation.

    Frame T: origin half way between positioner and aperture, x depth, y towards the positioner, z up. The uncertainty
    includes aperture noise and the scatter of the stop, besides that of every parameter.

    Args:
        calibration: from `load_calibration` or `calibration_of`.
        pan_steps: absolute counters, one or n.
        tilt_steps: absolute counters, one or n.
        aperture_deg: readings B of the aperture, deg, one or n.
        approach: last move of (pan, tilt): left, right or unknown; up, down or unknown; one pair or n pairs.
        draws: number of draws, at least 500; 1000 determine a 95 % half width to about 3 %.
        seed: seed of stop errors and aperture noise, which are the same for every point, so that a point does not
            depend on its neighbours in the list.
        progress: called with the share that is done.

    Returns:
        Points with covariance and intervals; check `refused`.

    Raises:
        TypeError: an argument has the wrong type.
        InputError: the calibration has no draws, or there is no such approach.
        ValueError: there are fewer than 500 draws (formulation 5), or lists differ in length.
    """
    require_kind(calibration, "moved_points", "a calibration, of calibration_of(posterior) or load_calibration(folder)")
    settings = settings_of(pan_steps, tilt_steps, aperture_deg, approach)
    return locate_settings(calibration, settings, draws=draws, seed=seed, progress=progress)


def locate_settings(
    calibration: Calibration, settings: Settings, *, draws: int = DRAWS, seed: int = 0, progress: Show | None = None
) -> Locations:
    """Locate points of looks; arguments and errors as in `locate`."""
    if draws < 500:
        raise ValueError(f"{draws} draws; a coordinate's interval needs at least 500")
    if not len(settings):
        raise ValueError("no points: the lists are empty")
    given = drawn(calibration, draws, seed)
    size, parts = max(BLOCK // draws, 1), []
    with Job({"locating": 1.0}, progress) as job:
        for begin in range(0, len(settings), size):
            block = settings[begin : begin + size]
            points = carry(calibration, given, block), locate_linear(calibration, block)
            parts.append(_statistics(block, *points, given, calibration))
            done = begin + len(block)
            job.at(done / len(settings), f"{done} of {len(settings)} points")
        located = joined(parts)
    requests = zip(settings.steps.tolist(), settings.aperture_deg.tolist(), settings.side.tolist(), strict=True)
    refused = tuple(
        None if share <= DIVERGING_SHARE else calibration.refusal(pan, tilt, deg, (pan_side, tilt_side))
        for share, ((pan, tilt), deg, (pan_side, tilt_side)) in zip(
            located.diverging_share.tolist(), requests, strict=True
        )
    )
    unseen = tuple(calibration.unseen(pan, tilt) for pan, tilt in settings.steps.tolist())
    return replace(located, refused=refused, unseen=unseen, extrapolated=np.array([bool(words) for words in unseen]))


def joined[T: (Locations, Settings, Validation)](parts: Sequence[T]) -> T:
    """Join blocks of points: arrays are concatenated, other fields are the same in every block."""

    def together(values: list[Any]) -> Any:
        if isinstance(values[0], Validation):
            return joined(values)
        return np.concatenate(values) if isinstance(values[0], np.ndarray) else values[0]

    names = [field.name for field in fields(parts[0])]
    return replace(parts[0], **{name: together([getattr(part, name) for part in parts]) for name in names})


def _statistics(settings: Settings, xyz: np.ndarray, law: Linear, given: Drawn, calibration: Calibration) -> Locations:
    """Compute moments, intervals and validation of one block of points, without the reasons of refusals."""
    meets = np.isfinite(xyz).all(axis=-1)
    lost = (~meets).mean(axis=0)
    count = len(meets)
    # The few draws without a point get the median position: at most one in a thousand, or the point is refused.
    for point in np.flatnonzero(~meets.all(axis=0) & meets.any(axis=0)):
        valid = meets[:, point]
        xyz[~valid, point] = np.median(xyz[valid, point], axis=0)
    mean = xyz.mean(axis=0)
    centred = xyz - mean
    covariance = np.einsum("dpi,dpj->pij", centred, centred) / (count - 1)
    named, inputs = len(INPUT_NAMES), len(calibration.look_inputs)
    away = np.concatenate([given.inputs[:, :named] - calibration.mean[:named], given.noise], axis=1)
    fixed = np.delete(law.jacobian, np.arange(named, inputs), axis=2)
    u = np.sqrt(np.einsum("pii->pi", law.covariance))
    linearised = law.value + np.einsum("pik,dk->dpi", fixed, away)
    pan, tilt = settings.steps.T
    off = calibration.gears.at(given.gears - calibration.mean[named:], (pan, tilt))
    for place, name in enumerate(calibration.gears.inputs, named):
        linearised += law.jacobian[:, :, place] * off[name][..., None]
    interval = symmetric_interval(xyz)
    empty = np.where(lost <= DIVERGING_SHARE, 0.0, np.nan)
    return Locations(
        xyz_mm=mean + empty[:, None],
        covariance_mm2=covariance + empty[:, None, None],
        interval95_mm=interval.transpose(1, 0, 2) + empty[:, None, None],
        u95_mm=0.5 * (interval[1] - interval[0]) + empty[:, None],
        diverging_share=lost,
        extrapolated=np.zeros(len(pan), dtype=bool),
        linear_xyz_mm=law.value + empty[:, None],
        linear_covariance_mm2=law.covariance + empty[:, None, None],
        validation=validate(xyz, linearised, law.value, u),
        refused=(),
        unseen=(),
        estimator=calibration.estimator,
        draws=count,
    )
