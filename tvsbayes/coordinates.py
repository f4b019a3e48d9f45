"""TVS coordinates: where beam and aperture reading meet, in mm, and how sure that is (paper eq. 1-3; DESIGN 5).

Frame T: origin mid-baseline, x depth, y along the baseline towards the positioner at +a/2, z up; the aperture stands
at (0, -a/2, 0). mm and rad inside; degrees where a name says `_deg`. The emission angle C and the aperture angle B are
interior angles of the triangle whose third corner is the spot.

Uncertainty is propagated by the law (GUM 5), by distributions (JCGM 101, 102), and the one is validated by the other;
these functions know no frame and take any unit. The law is written for JAX so that thousands of points share one
compiled function; distributions are arrays of draws, from any generator or from a posterior.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from tvsbayes.calibration import (
    AXES,
    DIVERGING_SHARE,
    INPUT_NAMES,
    NOISE_NAMES,
    NOISES,
    NORMAL_95,
    ROUNDING,
    Calibration,
    drawn,
    sides_of,
)
from tvsbayes.files import InputError
from tvsbayes.model import (
    FULL_TURN_DEG,
    INDEX,
    NAMES,
    Beam,
    Model,
    Scalar,
    along_batch,
    beam,
    dot,
    model_of,
    rotate_about_z,
)

BLOCKS = 10
"""Parts of the draws whose scatter gives the Monte Carlo error of an interval's end."""
BELIEVED = 4.0
"""Monte Carlo errors from which on a departure of the inputs from normality counts. Ten blocks give the error, and two
ends are looked at: at 2 errors, one exactly linear model in five would be called not validated, at 4 one in sixty."""


class Linear(eqx.Module):
    """The law of propagation of uncertainty: y = f(x), J = df/dx, U_y = J U_x J^T (GUM 5.2.2, JCGM 102 6.2)."""

    value: Float[Array, "*batch outputs"]
    jacobian: Float[Array, "*batch outputs inputs"]
    covariance: Float[Array, "*batch outputs outputs"]


def linear(
    function: Callable[[Float[Array, " inputs"]], Float[Array, "*batch outputs"]],
    estimates: Float[Array, " inputs"],
    covariance: Float[Array, "inputs inputs"],
) -> Linear:
    """Propagate estimates and their covariance to first order; differentiable, to be jitted or mapped by the caller.

    Args:
        function: the measurement model, written for JAX; it may return many quantities of the same inputs at once.
        estimates: of the input quantities.
        covariance: of the input quantities.

    Returns:
        Estimate, sensitivities and covariance of the output quantities.
    """
    # One trace of the function for value and derivatives; `linearize` takes twice the time to compile.
    values, columns = jax.vmap(lambda e: jax.jvp(function, (estimates,), (e,)), out_axes=(None, -1))(
        jnp.eye(estimates.size)
    )
    return Linear(values, columns, columns @ covariance @ jnp.swapaxes(columns, -1, -2))


def symmetric_interval(draws: np.ndarray, probability: float = 0.95) -> np.ndarray:
    """Probabilistically symmetric coverage interval over the first axis (JCGM 101 7.7): first axis (low, high)."""
    tail = 0.5 * (1 - probability)
    return np.quantile(draws, (tail, 1 - tail), axis=0)


def shortest_interval(draws: np.ndarray, probability: float = 0.95) -> np.ndarray:
    """Shortest coverage interval of scalar draws (n,), shape (2,) (JCGM 101 5.3.4 and 7.7.4)."""
    ordered = np.sort(np.asarray(draws, dtype=float))
    inside = min(len(ordered) - 1, max(1, round(probability * len(ordered))))
    width = ordered[inside:] - ordered[: len(ordered) - inside]
    first = int(np.argmin(width))
    return ordered[[first, first + inside]]


def numerical_tolerance(u: np.ndarray, digits: int) -> np.ndarray:
    """Half a unit of the last of `digits` significant digits of a standard uncertainty (JCGM 101 7.9.2)."""
    u = np.asarray(u, dtype=float)
    safe = np.where(u > 0, u, 1.0)
    # Of the rounded u: 0.0996 has the two digits 10, whose last unit is 0.01.
    exponent = np.floor(np.log10(safe)) - (digits - 1)
    exponent += np.round(safe / 10.0**exponent) >= 10**digits
    return np.where(u > 0, 0.5 * 10.0**exponent, 0.0)


@dataclass(frozen=True)
class Validation:
    """Does the law of propagation give the interval that the distribution has (JCGM 101 clause 8)?

    Fields have the shape of the quantity.

    Attributes:
        digits: significant digits of u that are compared.
        tolerance: delta of JCGM 101 8.1.
        deviation: larger distance of the two interval ends, d_low and d_high.
        error: its Monte Carlo standard error; that of a departure of the inputs too small to be seen is not in it.
        validated: the deviation is not larger than the tolerance.
        decided: the deviation differs from the tolerance by more than twice its Monte Carlo error.
    """

    digits: int
    tolerance: np.ndarray
    deviation: np.ndarray
    error: np.ndarray
    validated: np.ndarray
    decided: np.ndarray

    def digits_held(self, u: np.ndarray) -> np.ndarray:
        """Significant digits of u, `digits` at most, to which the law holds; 0 where not even one."""
        held = np.zeros(np.shape(u), dtype=int)
        for digits in range(1, self.digits + 1):
            held = np.where(self.deviation <= numerical_tolerance(u, digits), digits, held)
        return held


def validate(
    draws: np.ndarray,
    linearised: np.ndarray,
    value: np.ndarray,
    u: np.ndarray,
    *,
    digits: int = 2,
    probability: float = 0.95,
    factor: float = NORMAL_95,
) -> Validation:
    """Compare value +- factor u with the interval of the draws.

    A thousand draws know an interval's end to a twentieth of u, far coarser than the tolerance. Therefore the same
    inputs are sent through the linearised model: the difference of the two intervals shows what linearisation does,
    with little noise. What remains, the inputs' departure from the distribution behind `factor`, is the difference
    of the linearised draws from value +- factor u; it counts where it exceeds `BELIEVED` Monte Carlo errors.

    Args:
        draws: of the quantity, shape (n, ...).
        linearised: value + J (input draws - estimates) for the same input draws, shape (n, ...).
        value: estimate by the law of propagation, shape (...).
        u: its standard uncertainty, shape (...).
        digits: significant digits of u to validate.
        probability: of the interval.
        factor: coverage factor that belongs to the probability.

    Returns:
        The verdict for every element of the quantity.
    """
    ends = np.stack([value - factor * u, value + factor * u])
    curved = _with_error(
        lambda a, b: symmetric_interval(a, probability) - symmetric_interval(b, probability), draws, linearised
    )
    other = _with_error(lambda b: symmetric_interval(b, probability) - ends, linearised)
    counts = np.abs(other[0]) > BELIEVED * other[1]
    deviations = np.abs(curved[0] + np.where(counts, other[0], 0.0))
    errors = np.where(counts, np.hypot(curved[1], other[1]), curved[1])
    worse = np.argmax(deviations, axis=0)[None]
    deviation, error = (np.take_along_axis(x, worse, axis=0)[0] for x in (deviations, errors))
    tolerance = numerical_tolerance(u, digits)
    return Validation(
        digits=digits,
        tolerance=tolerance,
        deviation=deviation,
        error=error,
        validated=deviation <= tolerance,
        decided=np.abs(deviation - tolerance) > 2 * error,
    )


def _with_error(statistic: Callable[..., np.ndarray], *draws: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A statistic of draws and its Monte Carlo standard error from interleaved blocks."""
    blocks = [statistic(*(d[k::BLOCKS] for d in draws)) for k in range(BLOCKS)]
    return statistic(*draws), np.std(blocks, axis=0, ddof=1) / math.sqrt(BLOCKS)


DRAWS = 1000
"""Draws carried to a point unless the caller wants others; DESIGN 5 asks for 500 at least."""
POINTS = 256
"""Points per call of the compiled functions."""
INPUT_COLUMNS = np.array([INDEX[name] for name in (*INPUT_NAMES, *NOISE_NAMES)])


def published_point(
    B_deg: float | np.ndarray,
    C_deg: float | np.ndarray,
    beta_deg: float | np.ndarray,
    baseline_mm: float,
    *,
    as_printed: bool = False,
) -> np.ndarray:
    """The paper's equations (1)-(3), B and C in the plane that is tilted by beta about the baseline.

    y = a (1/2 - sin B cos C / sin(B + C)) holds for every B and C. The paper prints a second branch for B > 90 deg,
    y = -a (1/2 + sin B cos C / sin[180 - (B + C)]), which jumps by -a at B = 90 deg: it is returned with
    `as_printed` only.

    Args:
        B_deg: angle at the aperture.
        C_deg: angle at the positioner.
        beta_deg: elevation.
        baseline_mm: a.
        as_printed: the paper's two branches.

    Returns:
        x, y, z in mm, first axis; infinite or behind the baseline where B + C >= 180 deg.
    """
    B, C, beta = (np.radians(np.asarray(angle, dtype=float)) for angle in (B_deg, C_deg, beta_deg))
    with np.errstate(divide="ignore", invalid="ignore"):
        height = baseline_mm * np.sin(B) * np.sin(C) / np.sin(B + C)
        share = np.sin(B) * np.cos(C) / np.sin(B + C)
    y = baseline_mm * (0.5 - share)
    if as_printed:
        y = np.where(np.degrees(B) > 90.0, -baseline_mm * (0.5 + share), y)
    return np.stack(np.broadcast_arrays(height * np.cos(beta), y, height * np.sin(beta)))


class Meeting(eqx.Module):
    """Where beams meet what the aperture saw: points (frame T, mm), ranges along the beams, and whether they do."""

    xyz_mm: Float[Array, "3 *batch"]
    range_mm: Float[Array, "*batch"]
    meets: Bool[Array, "*batch"]


def meeting(
    origin_mm: Float[Array, "3 *batch"],
    direction: Float[Array, "3 *batch"],
    baseline_mm: Scalar,
    aperture_rad: Float[Array, "*batch"],
    azimuth_convention: Bool[Array, ""],
) -> Meeting:
    """Meet beams with the cone, or vertical plane, of an aperture angle (DESIGN 5); closed form, differentiable.

    With w the beam's origin seen from the aperture and c = cos B, the in-plane reading asks for (w + r d)_y =
    c |w + r d|. Squared this is a quadratic in r whose discriminant is c^2 S^2, S^2 = |m|^2 sin^2 B - m_y^2 with the
    moment m = w x d. The root on B's own nappe is r = (w_y^2 - c^2 |w|^2) / (c S - w_y d_y + c^2 w.d), which has no
    0/0 at B = 90 deg, nor where the beam runs parallel to the cone's opposite side; the denominator vanishes where
    beam and line of sight are parallel. On the baseline's plane it is a sin B / sin(B + C). It is the right root for
    beams that start on the positioner's side of the aperture (w_y > 0).

    Args:
        origin_mm: origins of the beams, frame T.
        direction: unit directions.
        baseline_mm: a.
        aperture_rad: true angles B in (0, pi), without the aperture's zero.
        azimuth_convention: B is the azimuth of the spot instead of the angle in the plane of baseline and spot.

    Returns:
        Points; `meets` is False where the beam misses the cone (grazing), only its backward extension meets it
        (diverging), or the point lies on the other nappe.
    """
    w = origin_mm + half_baseline(baseline_mm, origin_mm[0])
    sin_b, cos_b = jnp.sin(aperture_rad), jnp.cos(aperture_rad)
    moment = jnp.stack(
        [
            w[1] * direction[2] - w[2] * direction[1],
            w[2] * direction[0] - w[0] * direction[2],
            w[0] * direction[1] - w[1] * direction[0],
        ]
    )
    inside = (moment[0] ** 2 + moment[2] ** 2) * sin_b**2 - (moment[1] * cos_b) ** 2
    touches = inside > 0
    # The root's derivative is infinite where the beam touches the cone; such beams are refused anyway.
    root = jnp.sqrt(jnp.where(touches, inside, 1.0))
    ahead = cos_b * root - w[1] * direction[1] + cos_b**2 * dot(w, direction)
    cone = (w[1] ** 2 - cos_b**2 * dot(w, w)) / ahead
    plane = (w[1] * sin_b - w[0] * cos_b) / (direction[0] * cos_b - direction[1] * sin_b)
    range_mm = jnp.where(azimuth_convention, plane, cone)
    seen = w + range_mm * direction
    in_sight = jnp.where(azimuth_convention, seen[0] * sin_b, 0.0) + seen[1] * cos_b
    # At B = 90 deg both nappes are one plane, and y is nought but for rounding.
    faces = in_sight >= -ROUNDING * jnp.abs(range_mm * cos_b)
    meets = (azimuth_convention | touches) & (range_mm > 0) & faces & jnp.isfinite(range_mm)
    return Meeting(origin_mm + range_mm * direction, range_mm, meets)


class Settings(eqx.Module):
    """Where the machine stood and what the aperture read: counters, sides (+1 left/up, -1, 0 unknown), reading."""

    steps: Float[Array, "*points 2"]
    side: Float[Array, "*points 2"]
    aperture_rad: Float[Array, "*points"]


def beams_at(model: Model, steps: Array, side: Array, noise: Float[Array, "noises"]) -> Beam:
    """Beams of one rig at many settings, frame T: q = k n after homing, play taken up on the approach side.

    Source: DESIGN 3.1.

    Args:
        model: parameters.
        steps: counters, shape (points, 2).
        side: approach sides, shape (points, 2).
        noise: standard-normal stop errors (pan, tilt), then uniform places in the play in [-1/2, 1/2] (pan, tilt)
            where the side is unknown, then the aperture's noise.
    """
    gears, known = model.transmission, side != 0
    q = gears.ratio_rad_per_step * steps
    driven = q + jnp.where(gears.harmonics.on_wheel, 0.0, gears.harmonics.error_rad(q))
    output = driven - gears.backlash_rad * jnp.where(known, 0.5 * side, -noise[2:4])
    output = output + jnp.where(gears.harmonics.on_wheel, gears.harmonics.error_rad(output), 0.0)
    low, high = model.noise.stop_sd_rad[:, 0], model.noise.stop_sd_rad[:, 1]
    stop_sd = jnp.where(side > 0, high, jnp.where(side < 0, low, jnp.sqrt(0.5 * (low**2 + high**2))))
    angle = output + stop_sd * noise[:2]
    return _in_frame_t(model, angle[..., 0], angle[..., 1] + model.tilt_zero_rad)


def _in_frame_t(model: Model, pan_rad: Array, tilt_rad: Array) -> Beam:
    ray = beam(model.optics, pan_rad, tilt_rad)
    turn = model.receiver.pan_zero_emission_rad - jnp.pi / 2
    origin = rotate_about_z(turn, ray.origin_mm) + half_baseline(model.receiver.baseline_mm, pan_rad)
    return Beam(origin, rotate_about_z(turn, ray.direction))


def half_baseline(baseline_mm: Scalar, like: Float[Array, "*batch"]) -> Float[Array, "3 ..."]:
    """(0, a/2, 0), from the middle of the baseline to the pan axis, for a batch like `like`."""
    return along_batch(jnp.stack([jnp.zeros(()), 0.5 * baseline_mm, jnp.zeros(())]), like)


class Sources(eqx.Module):
    """Estimates, covariance and draws of a calibration as arguments of the compiled functions.

    `mean` and `covariance` are of [inputs, unit noises]; `inputs` are draws of `INPUT_NAMES` and `NOISE_NAMES`.
    """

    mean: Float[Array, " inputs"]
    covariance: Float[Array, "inputs inputs"]
    stop_sd_deg: Float[Array, "5"]
    inputs: Float[Array, "draws columns"]
    noise: Float[Array, "draws 5"]
    period_deg: Float[Array, "2"]
    azimuth_convention: Bool[Array, ""]


def model_from(inputs: Float[Array, " columns"], period_deg: Float[Array, "2"]) -> Model:
    """A model that knows what coordinates depend on; its cameras are empty."""
    return model_of(jnp.zeros(len(NAMES)).at[INPUT_COLUMNS].set(inputs), period_deg)


def sources(calibration: Calibration, draws: int, seed: int) -> Sources:
    """A calibration for the compiled functions, with its draws; arguments and errors as in `calibration.drawn`."""
    found = drawn(calibration, draws, seed)
    with jax.enable_x64(True):
        return Sources(
            mean=jnp.asarray(np.concatenate([calibration.mean, np.zeros(NOISES)])),
            covariance=jnp.asarray(calibration.covariance_with_noise),
            stop_sd_deg=jnp.asarray(np.sqrt([calibration.noise_variance[name] for name in NOISE_NAMES])),
            inputs=jnp.asarray(found.inputs),
            noise=jnp.asarray(found.noise),
            period_deg=jnp.asarray([calibration.period_deg.get(axis, FULL_TURN_DEG) for axis in AXES]),
            azimuth_convention=jnp.asarray(calibration.azimuth),
        )


def _look(inputs: Array, noise: Array, settings: Settings, given: Sources) -> Meeting:
    """Points of one rig at many settings."""
    model = model_from(inputs, given.period_deg)
    rays = beams_at(model, settings.steps, settings.side, noise)
    receiver = model.receiver
    true_rad = settings.aperture_rad - receiver.aperture_zero_rad - receiver.aperture_sd_rad * noise[4]
    return meeting(rays.origin_mm, rays.direction, receiver.baseline_mm, true_rad, given.azimuth_convention)


class Carried(eqx.Module):
    """Draws of the points, shape (draws, 3, points), and whether each exists."""

    xyz_mm: Float[Array, "*draws 3 points"]
    meets: Bool[Array, "*draws points"]


@eqx.filter_jit
def carry(settings: Settings, given: Sources) -> Carried:
    """Every draw through the geometry for every point."""

    def one(inputs, noise):
        found = _look(inputs, noise, settings, given)
        return Carried(found.xyz_mm, found.meets)

    return jax.vmap(one)(given.inputs, given.noise)


@eqx.filter_jit
def propagate(settings: Settings, given: Sources) -> Linear:
    """The law of propagation at every point, not a number where there is none; fields get a leading axis `points`.

    Inputs are `INPUT_NAMES` and the unit noises, whose sds are held at their root mean square.
    """

    def function(values):
        inputs = jnp.concatenate([values[: len(INPUT_NAMES)], given.stop_sd_deg])
        found = _look(inputs, values[len(INPUT_NAMES) :], settings, given)
        return jnp.where(found.meets, found.xyz_mm, jnp.nan).T

    law = linear(function, given.mean, given.covariance)
    lost = jnp.where(jnp.isnan(law.value), jnp.nan, 0.0)[..., None]
    return Linear(law.value, law.jacobian + lost, law.covariance + lost)


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
    approach: tuple[str, str] | Sequence[tuple[str, str]] = ("left", "up"),
) -> Settings:
    """Settings of many points; arguments and errors as in `locate`."""
    numbers = [np.atleast_1d(np.asarray(x, dtype=float)) for x in (pan_steps, tilt_steps, aperture_deg)]
    pan, tilt, reading = np.broadcast_arrays(*numbers)
    pairs = [approach] if len(approach) == 2 and isinstance(approach[0], str) else list(approach)
    known = {pair: sides_of(pair) for pair in set(map(tuple, pairs))}
    side = np.broadcast_to(np.array([known[tuple(pair)] for pair in pairs]), (len(pan), 2))
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
    approach: tuple[str, str] | Sequence[tuple[str, str]] = ("left", "up"),
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
        ValueError: fewer than 500 draws (DESIGN 5), or lists of different lengths.
    """
    if draws < 500:
        raise ValueError(f"{draws} draws; a coordinate's interval needs at least 500 (DESIGN 5)")
    settings = settings_of(pan_steps, tilt_steps, aperture_deg, approach)
    if not len(settings.steps):
        raise ValueError("no points: the lists are empty")
    given = sources(calibration, draws, seed)
    parts = []
    with jax.enable_x64(True):
        for block, n in _blocks(settings):
            carried, law = carry(block, given), propagate(block, given)
            trimmed = jax.tree.map(lambda x, n=n: np.asarray(x)[..., :n], carried)
            parts.append(_statistics(trimmed, jax.tree.map(lambda x, n=n: np.asarray(x)[:n], law), given))
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0] if name != "validation"}
    checks = [part["validation"] for part in parts]
    fields = ("tolerance", "deviation", "error", "validated", "decided")
    together = {name: np.concatenate([getattr(check, name) for check in checks]) for name in fields}
    validation = Validation(checks[0].digits, **together)
    steps, side = np.asarray(settings.steps), np.asarray(settings.side)
    reading = np.degrees(settings.aperture_rad)
    lost = ~(joined["diverging_share"] <= DIVERGING_SHARE)
    refused = tuple(
        calibration.refusal(*steps[i], float(reading[i]), tuple(side[i])) if bad else None for i, bad in enumerate(lost)
    )
    return Locations(**joined, validation=validation, refused=refused, estimator=calibration.estimator, draws=draws)


def _statistics(carried: Carried, law: Linear, given: Sources) -> dict[str, object]:
    """Moments, intervals and validation of one block of points."""
    meets = carried.meets
    lost = (~meets).mean(axis=0)
    count = len(meets)
    # The few draws without a point take the point's median place: at most one in a thousand, or the point is refused.
    xyz = carried.xyz_mm
    for point in np.flatnonzero(~meets.all(axis=0) & meets.any(axis=0)):
        seen = meets[:, point]
        xyz = xyz.copy() if xyz is carried.xyz_mm else xyz
        xyz[~seen, :, point] = np.median(xyz[seen, :, point], axis=0)
    mean = xyz.mean(axis=0)
    centred = xyz - mean
    covariance = np.einsum("dip,djp->pij", centred, centred) / (count - 1)
    inputs = np.concatenate([np.asarray(given.inputs)[:, : len(INPUT_NAMES)], np.asarray(given.noise)], axis=1)
    u = np.sqrt(np.einsum("pii->pi", law.covariance))
    linearised = law.value + np.einsum("pik,dk->dpi", law.jacobian, inputs - np.asarray(given.mean))
    draws = np.ascontiguousarray(xyz.transpose(0, 2, 1))
    interval = symmetric_interval(draws)
    empty = np.where(lost <= DIVERGING_SHARE, 0.0, np.nan)
    return {
        "xyz_mm": mean.T + empty[:, None],
        "covariance_mm2": covariance + empty[:, None, None],
        "interval95_mm": interval.transpose(1, 0, 2) + empty[:, None, None],
        "u95_mm": 0.5 * (interval[1] - interval[0]) + empty[:, None],
        "diverging_share": lost,
        "linear_xyz_mm": law.value + empty[:, None],
        "linear_covariance_mm2": law.covariance + empty[:, None, None],
        "validation": validate(draws, linearised, law.value, u),
    }
