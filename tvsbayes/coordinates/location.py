"""TVS coordinates: points where beam and aperture reading meet, in mm, and how sure that is.

Frame T: origin mid-baseline, x depth, y along the baseline towards the positioner at +a/2, z up; the aperture stands
at (0, -a/2, 0). Uncertainty is propagated by the law (GUM 5) and by distributions (JCGM 101, 102), and the one is
validated by the other.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from tvsbayes.calibration.pointing import DIVERGING_SHARE, INPUT_NAMES, Calibration
from tvsbayes.coordinates.beam_meeting import Carried, Linear, Settings, Sources, carry, propagate, sources
from tvsbayes.errors import InputError
from tvsbayes.instrument.axes import HOME_APPROACH, sides_of
from tvsbayes.statistics.intervals import NORMAL_95, Validation, symmetric_interval, validate

DRAWS = 1000
"""Draws carried to a point unless the caller wants others; formulation 5 asks for 500 at least."""
POINTS = 256
"""Points per call of the compiled functions."""


@dataclass(frozen=True)
class Locations:
    """Points of frame T with their uncertainty; arrays over points, not a number where a point is refused.

    Attributes:
        xyz_mm: means of the draws, shape (n, 3).
        covariance_mm2: shape (n, 3, 3).
        interval95_mm: equal-tailed intervals, shape (n, 2, 3).
        u95_mm: their half widths, shape (n, 3).
        diverging_share: share of draws without a point, shape (n,).
        linear_xyz_mm, linear_covariance_mm2: by the law of propagation, shapes (n, 3) and (n, 3, 3).
        validation: of the law of propagation by the draws (JCGM 101 clause 8), fields of shape (n, 3).
        refused: the refusal of each point, or None.
        estimator: "posterior" or "laplace".
        draws: number of draws.
    """

    xyz_mm: np.ndarray
    covariance_mm2: np.ndarray
    interval95_mm: np.ndarray
    u95_mm: np.ndarray
    diverging_share: np.ndarray
    linear_xyz_mm: np.ndarray
    linear_covariance_mm2: np.ndarray
    validation: Validation
    refused: tuple[InputError | None, ...]
    estimator: str
    draws: int

    @cached_property
    def digits_held(self) -> np.ndarray:
        """Significant digits of u, two at most, to which the law of propagation holds, shape (n, 3)."""
        return self.validation.digits_held(np.sqrt(np.diagonal(self.linear_covariance_mm2, 0, 1, 2)))

    def as_json(self, index: int) -> dict[str, object]:
        """One point; null where it is refused."""
        error = self.refused[index]
        if error is not None:
            empty = dict.fromkeys(("xyz_mm", "covariance_mm2", "u95_mm"))
            return {**empty, "refused": {"code": error.code, "message": error.message}}
        u = np.sqrt(np.diag(self.linear_covariance_mm2[index]))
        v = self.validation
        return {
            "xyz_mm": self.xyz_mm[index].tolist(),
            "covariance_mm2": self.covariance_mm2[index].tolist(),
            "u95_mm": self.u95_mm[index].tolist(),
            "interval95_mm": self.interval95_mm[index].T.tolist(),
            "diverging_share": float(self.diverging_share[index]),
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


def settings_of(
    pan_steps: float | Sequence[float] | np.ndarray,
    tilt_steps: float | Sequence[float] | np.ndarray,
    aperture_deg: float | Sequence[float] | np.ndarray,
    approach: tuple[str, str] | Sequence[tuple[str, str]] = HOME_APPROACH,
) -> Settings:
    """Settings of many points; arguments and errors as in `locate`."""
    numbers = [np.atleast_1d(np.asarray(x, dtype=float)) for x in (pan_steps, tilt_steps, aperture_deg)]
    pan, tilt, reading = np.broadcast_arrays(*numbers)
    single = len(approach) == 2 and isinstance(approach[0], str)
    pairs = cast("Sequence[tuple[str, str]]", [approach] if single else approach)
    known = {(pan_side, tilt_side): sides_of((pan_side, tilt_side)) for pan_side, tilt_side in pairs}
    side = np.broadcast_to(np.array([known[pan_side, tilt_side] for pan_side, tilt_side in pairs]), (len(pan), 2))
    with jax.enable_x64(True):
        return Settings(
            steps=jnp.asarray(np.stack([pan, tilt], axis=1)),
            side=jnp.asarray(side),
            aperture_rad=jnp.asarray(np.radians(reading)),
        )


def _blocks(settings: Settings) -> Iterator[tuple[Settings, int]]:
    """Equal blocks of settings, the last one filled up with its last point, and how many points of each count."""
    count = len(settings.aperture_rad)
    size = min(POINTS, 1 << max(count - 1, 0).bit_length())
    for begin in range(0, count, size):
        chosen = np.minimum(np.arange(begin, begin + size), count - 1)
        yield jax.tree.map(lambda x, chosen=chosen: x[chosen], settings), min(size, count - begin)


def locate_linear(calibration: Calibration, settings: Settings) -> Linear:
    """The law of propagation alone: fields with a leading axis of points, not a number where there is no point.

    No draws: a million points a minute. Validate some of them with `locate`.
    """
    given = sources(calibration, 1, 0)
    with jax.enable_x64(True):
        found = [
            jax.tree.map(lambda x, n=n: np.asarray(x)[:n], propagate(block, given)) for block, n in _blocks(settings)
        ]
    return jax.tree.map(lambda *parts: np.concatenate(parts), *found)


def locate(
    calibration: Calibration,
    pan_steps: float | Sequence[float] | np.ndarray,
    tilt_steps: float | Sequence[float] | np.ndarray,
    aperture_deg: float | Sequence[float] | np.ndarray,
    approach: tuple[str, str] | Sequence[tuple[str, str]] = HOME_APPROACH,
    *,
    draws: int = DRAWS,
    seed: int = 0,
) -> Locations:
    """Where the scanner points: a calibration carried into frame T, draw by draw and by the law of propagation.

    Frame T: origin half way between positioner and aperture, x depth, y towards the positioner, z up. Aperture noise
    and the scatter of the stop are in the uncertainty, besides that of every parameter.

    Args:
        calibration: from `load_calibration` or `calibration_of`.
        pan_steps: absolute counters, one or n.
        tilt_steps: absolute counters, one or n.
        aperture_deg: readings B of the aperture, deg, one or n.
        approach: last move of (pan, tilt): left, right or unknown; up, down or unknown; one pair or n pairs.
        draws: number of draws, at least 500; 1000 give a 95 % half width to about 3 %.
        seed: of stop errors and aperture noise; they are the same for every point, so that a point does not depend
            on its neighbours in the list.

    Returns:
        Points with covariance and intervals; look at `refused`.

    Raises:
        InputError: a calibration without draws, or an approach that does not exist.
        ValueError: fewer than 500 draws (formulation 5), or lists of different lengths.
    """
    if draws < 500:
        raise ValueError(f"{draws} draws; a coordinate's interval needs at least 500")
    settings = settings_of(pan_steps, tilt_steps, aperture_deg, approach)
    if not len(settings.steps):
        raise ValueError("no points: the lists are empty")
    given = sources(calibration, draws, seed)
    parts = []
    with jax.enable_x64(True):
        for block, n in _blocks(settings):
            carried, law = carry(block, given), propagate(block, given)
            trimmed = jax.tree.map(lambda x, n=n: np.asarray(x)[..., :n], carried)
            law = jax.tree.map(lambda x, n=n: np.asarray(x)[:n], law)
            parts.append(_statistics(trimmed, law, given, calibration.estimator))
    found = _together(parts)
    asked = zip(
        settings.steps.tolist(), np.degrees(settings.aperture_rad).tolist(), settings.side.tolist(), strict=True
    )
    refused = tuple(
        None if share <= DIVERGING_SHARE else calibration.refusal(pan, tilt, deg, (pan_side, tilt_side))
        for share, ((pan, tilt), deg, (pan_side, tilt_side)) in zip(found.diverging_share.tolist(), asked, strict=True)
    )
    return replace(found, refused=refused)


def _together[T: (Locations, Validation)](parts: Sequence[T]) -> T:
    """Blocks of points as one: arrays follow each other, all else is the same in every block."""

    def joined(values: list[Any]) -> Any:
        if isinstance(values[0], Validation):
            return _together(values)
        return np.concatenate(values) if isinstance(values[0], np.ndarray) else values[0]

    names = [field.name for field in fields(parts[0])]
    return replace(parts[0], **{name: joined([getattr(part, name) for part in parts]) for name in names})


def _statistics(carried: Carried, law: Linear, given: Sources, estimator: str) -> Locations:
    """Moments, intervals and validation of one block of points; none of them is refused by name yet."""
    meets, xyz = np.asarray(carried.meets), np.array(carried.xyz_mm)
    value, law_covariance = np.asarray(law.value), np.asarray(law.covariance)
    lost = (~meets).mean(axis=0)
    count = len(meets)
    # The few draws without a point take the point's median place: at most one in a thousand, or the point is refused.
    for point in np.flatnonzero(~meets.all(axis=0) & meets.any(axis=0)):
        seen = meets[:, point]
        xyz[~seen, :, point] = np.median(xyz[seen, :, point], axis=0)
    mean = xyz.mean(axis=0)
    centred = xyz - mean
    covariance = np.einsum("dip,djp->pij", centred, centred) / (count - 1)
    inputs = np.concatenate([np.asarray(given.inputs)[:, : len(INPUT_NAMES)], np.asarray(given.noise)], axis=1)
    u = np.sqrt(np.einsum("pii->pi", law_covariance))
    linearised = value + np.einsum("pik,dk->dpi", law.jacobian, inputs - np.asarray(given.mean))
    draws = np.ascontiguousarray(xyz.transpose(0, 2, 1))
    interval = symmetric_interval(draws)
    empty = np.where(lost <= DIVERGING_SHARE, 0.0, np.nan)
    return Locations(
        xyz_mm=mean.T + empty[:, None],
        covariance_mm2=covariance + empty[:, None, None],
        interval95_mm=interval.transpose(1, 0, 2) + empty[:, None, None],
        u95_mm=0.5 * (interval[1] - interval[0]) + empty[:, None],
        diverging_share=lost,
        linear_xyz_mm=value + empty[:, None],
        linear_covariance_mm2=law_covariance + empty[:, None, None],
        validation=validate(draws, linearised, value, u),
        refused=(),
        estimator=estimator,
        draws=count,
    )
