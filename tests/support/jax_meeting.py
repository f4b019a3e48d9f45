"""Points of beams and readings in JAX, from the model's own beams: the reference for the calibration's NumPy.

Frame T: origin mid-baseline, x depth, y along the baseline towards the positioner at +a/2, z up; the aperture stands
at (0, -a/2, 0). mm and rad; degrees where a name says `_deg`. The emission angle C and the aperture angle B are
interior angles of the triangle whose third corner is the spot. The law of propagation has no frame and takes any unit.
"""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from tvsbayes.calibration.drawn_looks import Drawn
from tvsbayes.calibration.optics import ROUNDING
from tvsbayes.calibration.pointing import INPUT_NAMES, NOISE_NAMES, NOISES, Calibration
from tvsbayes.coordinates.location import Settings
from tvsbayes.instrument.axes import AXES, FULL_TURN_DEG
from tvsbayes.instrument.mirrors import Ray, Turn, Vectors
from tvsbayes.instrument.parameters import INDEX, NAMES
from tvsbayes.model.geometry import Scalar
from tvsbayes.model.laser_path import trace
from tvsbayes.model.parameter_space import Model, model_of


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


INPUT_COLUMNS = np.array([INDEX[name] for name in (*INPUT_NAMES, *NOISE_NAMES)])


class Case(eqx.Module):
    """Settings of a calibrated rig, one a point, and what its coordinates depend on beside its parameters."""

    steps: Float[Array, "points 2"]
    side: Float[Array, "points 2"]
    reading_rad: Float[Array, " points"]
    period_deg: Float[Array, "2"]
    azimuth: Bool[Array, ""]


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
    """Meet beams with the cone, or vertical plane, of an aperture angle; derivation in `optics.range_components`.

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
    rays = Ray(Vectors.of(origin_mm), Vectors.of(direction))
    w, d = rays.origin_mm + half_baseline(baseline_mm), rays.direction
    sin_b, cos_b = jnp.sin(aperture_rad), jnp.cos(aperture_rad)
    moment = w.cross(d)
    inside = (moment.x**2 + moment.z**2) * sin_b**2 - (moment.y * cos_b) ** 2
    touches = inside > 0
    # The root's derivative is infinite where the beam touches the cone; such beams are refused anyway.
    root = jnp.sqrt(jnp.where(touches, inside, 1.0))
    ahead = cos_b * root - w.y * d.y + cos_b**2 * w.dot(d)
    cone = (w.y**2 - cos_b**2 * w.dot(w)) / ahead
    plane = (w.y * sin_b - w.x * cos_b) / (d.x * cos_b - d.y * sin_b)
    range_mm = jnp.where(azimuth_convention, plane, cone)
    spot = w + d * range_mm
    in_sight = jnp.where(azimuth_convention, spot.x * sin_b, 0.0) + spot.y * cos_b
    # At B = 90 deg both nappes are one plane, and y is zero but for rounding.
    faces = in_sight >= -ROUNDING * jnp.abs(range_mm * cos_b)
    points = rays.at(range_mm)
    # Behind the baseline there is no triangle for the aperture to close.
    meets = (azimuth_convention | touches) & (range_mm > 0) & faces & jnp.isfinite(range_mm) & (points.x > 0)
    return Meeting(points.stacked(), range_mm, meets)


def beams_at(model: Model, steps: Array, side: Array, noise: Float[Array, "noises"]) -> Ray:
    """Beams of one rig at many settings, frame T: q = k n after homing, play taken up on the approach side.

    Source: formulation 3.1.

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


def _in_frame_t(model: Model, pan_rad: Array, tilt_rad: Array) -> Ray:
    ray = trace(model.optics, pan_rad, tilt_rad)
    turn = Turn.by(model.receiver.pan_zero_emission_rad - jnp.pi / 2, jnp)
    return Ray(turn.forward(ray.origin_mm) + half_baseline(model.receiver.baseline_mm), turn.forward(ray.direction))


def half_baseline(baseline_mm: Scalar) -> Vectors:
    """(0, a/2, 0), from the middle of the baseline to the pan axis."""
    none = jnp.zeros(())
    return Vectors(none, 0.5 * baseline_mm, none)


def model_from(inputs: Float[Array, " columns"], period_deg: Float[Array, "2"]) -> Model:
    """A model with what coordinates depend on; its cameras are empty."""
    return model_of(jnp.zeros(len(NAMES)).at[INPUT_COLUMNS].set(inputs), jnp.tile(period_deg[:, None], 3))


def look(case: Case, inputs: Array, noise: Array) -> Meeting:
    """Points of one rig at many settings."""
    model = model_from(inputs, case.period_deg)
    rays = beams_at(model, case.steps, case.side, noise)
    receiver = model.receiver
    true_rad = case.reading_rad - receiver.aperture_zero_rad - receiver.aperture_sd_rad * noise[4]
    return meeting(rays.origin_mm.stacked(), rays.direction.stacked(), receiver.baseline_mm, true_rad, case.azimuth)


def case_of(calibration: Calibration, settings: Settings) -> Case:
    """As arrays: calibrations and settings of one number share what is compiled."""
    period_deg = [float(calibration.period_deg.get(axis, FULL_TURN_DEG)) for axis in AXES]
    arrays = settings.steps, settings.side, np.radians(settings.aperture_deg), np.array(period_deg)
    return Case(*map(jnp.asarray, arrays), jnp.asarray(calibration.azimuth))


@jax.jit
def _carried(case: Case, inputs: Array, noise: Array) -> Array:
    def one(inputs, noise):
        met = look(case, inputs, noise)
        return jnp.where(met.meets, met.xyz_mm, jnp.nan).T

    return jax.vmap(one)(inputs, noise)


@jax.jit
def _law(case: Case, mean: Array, stop_sd_deg: Array, covariance: Array) -> Linear:
    def function(values):
        inputs = jnp.concatenate([values[: len(INPUT_NAMES)], stop_sd_deg])
        met = look(case, inputs, values[len(INPUT_NAMES) :])
        return jnp.where(met.meets, met.xyz_mm, jnp.nan).T

    return linear(function, mean, covariance)


def jax_carry(calibration: Calibration, drawn: Drawn, settings: Settings) -> np.ndarray:
    """Every draw through the geometry: (draws, points, 3), not a number where there is no point."""
    with jax.enable_x64(True):
        return np.asarray(_carried(case_of(calibration, settings), jnp.asarray(drawn.inputs), jnp.asarray(drawn.noise)))


def jax_law(calibration: Calibration, settings: Settings) -> Linear:
    """The law of propagation at every point, not a number where there is none; first axis of the fields: points.

    Inputs are `INPUT_NAMES` and the unit noises, whose sds are held at their root mean square.
    """
    mean = np.concatenate([calibration.mean, np.zeros(NOISES)])
    stop_sd_deg = np.sqrt([calibration.noise_variance[name] for name in NOISE_NAMES])
    with jax.enable_x64(True):
        moments = map(jnp.asarray, (mean, stop_sd_deg, calibration.covariance_with_noise))
        law = _law(case_of(calibration, settings), *moments)
    lost = np.where(np.isnan(law.value), np.nan, 0.0)[..., None]
    return Linear(law.value, np.asarray(law.jacobian) + lost, np.asarray(law.covariance) + lost)
