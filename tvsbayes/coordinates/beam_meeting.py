"""Where beam and aperture reading meet, written for JAX so that thousands of points share one compiled function.

Frame T: origin mid-baseline, x depth, y along the baseline towards the positioner at +a/2, z up; the aperture stands
at (0, -a/2, 0). mm and rad; degrees where a name says `_deg`. The emission angle C and the aperture angle B are
interior angles of the triangle whose third corner is the spot. The law of propagation knows no frame, takes any unit.
"""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from tvsbayes.calibration.optics import ROUNDING
from tvsbayes.calibration.pointing import INPUT_NAMES, NOISE_NAMES, NOISES, Calibration, drawn
from tvsbayes.instrument.axes import AXES, FULL_TURN_DEG
from tvsbayes.instrument.parameters import INDEX, NAMES
from tvsbayes.model.compiled import compiled
from tvsbayes.model.geometry import Scalar, Turn, Vectors
from tvsbayes.model.laser_path import Ray, trace
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


class Meeting(eqx.Module):
    """Where beams meet what the aperture saw: points (frame T, mm), ranges along the beams, and whether they do."""

    xyz_mm: Float[Array, "3 *batch"]
    range_mm: Float[Array, "*batch"]
    meets: Bool[Array, "*batch"]


def meeting(
    rays: Ray,
    baseline_mm: Scalar,
    aperture_rad: Float[Array, "*batch"],
    azimuth_convention: Bool[Array, ""],
) -> Meeting:
    """Meet beams with the cone, or vertical plane, of an aperture angle (formulation 5); closed form, differentiable.

    With w the beam's origin seen from the aperture and c = cos B, the in-plane reading asks for (w + r d)_y =
    c |w + r d|. Squared this is a quadratic in r whose discriminant is c^2 S^2, S^2 = |m|^2 sin^2 B - m_y^2 with the
    moment m = w x d. The root on B's own nappe is r = (w_y^2 - c^2 |w|^2) / (c S - w_y d_y + c^2 w.d), which has no
    0/0 at B = 90 deg, nor where the beam runs parallel to the cone's opposite side; the denominator vanishes where
    beam and line of sight are parallel. On the baseline's plane it is a sin B / sin(B + C). It is the right root for
    beams that start on the positioner's side of the aperture (w_y > 0).

    Args:
        rays: the beams, frame T.
        baseline_mm: a.
        aperture_rad: true angles B in (0, pi), without the aperture's zero.
        azimuth_convention: B is the azimuth of the spot instead of the angle in the plane of baseline and spot.

    Returns:
        Points; `meets` is False where the beam misses the cone (grazing), only its backward extension meets it
        (diverging), or the point lies on the other nappe.
    """
    w, direction = rays.origin_mm + half_baseline(baseline_mm), rays.direction
    sin_b, cos_b = jnp.sin(aperture_rad), jnp.cos(aperture_rad)
    moment = w.cross(direction)
    inside = (moment.x**2 + moment.z**2) * sin_b**2 - (moment.y * cos_b) ** 2
    touches = inside > 0
    # The root's derivative is infinite where the beam touches the cone; such beams are refused anyway.
    root = jnp.sqrt(jnp.where(touches, inside, 1.0))
    ahead = cos_b * root - w.y * direction.y + cos_b**2 * w.dot(direction)
    cone = (w.y**2 - cos_b**2 * w.dot(w)) / ahead
    plane = (w.y * sin_b - w.x * cos_b) / (direction.x * cos_b - direction.y * sin_b)
    range_mm = jnp.where(azimuth_convention, plane, cone)
    seen = w + direction * range_mm
    in_sight = jnp.where(azimuth_convention, seen.x * sin_b, 0.0) + seen.y * cos_b
    # At B = 90 deg both nappes are one plane, and y is nought but for rounding.
    faces = in_sight >= -ROUNDING * jnp.abs(range_mm * cos_b)
    meets = (azimuth_convention | touches) & (range_mm > 0) & faces & jnp.isfinite(range_mm)
    return Meeting(rays.at(range_mm).stacked(), range_mm, meets)


class Settings(eqx.Module):
    """Where the machine stood and what the aperture read: counters, sides (+1 left/up, -1, 0 unknown), reading."""

    steps: Float[Array, "*points 2"]
    side: Float[Array, "*points 2"]
    aperture_rad: Float[Array, "*points"]


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
    turn = Turn.by(model.receiver.pan_zero_emission_rad - jnp.pi / 2)
    origin = turn.forward(ray.origin_mm) + half_baseline(model.receiver.baseline_mm)
    return Ray(origin, turn.forward(ray.direction))


def half_baseline(baseline_mm: Scalar) -> Vectors:
    """(0, a/2, 0), from the middle of the baseline to the pan axis."""
    none = jnp.zeros(())
    return Vectors(none, 0.5 * baseline_mm, none)


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
    """A calibration for the compiled functions, with its draws; arguments and errors as in `pointing.drawn`."""
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
    return meeting(rays, receiver.baseline_mm, true_rad, given.azimuth_convention)


class Carried(eqx.Module):
    """Draws of the points, shape (draws, 3, points), and whether each exists."""

    xyz_mm: Float[Array, "*draws 3 points"]
    meets: Bool[Array, "*draws points"]


@compiled(Carried)
def carry(settings: Settings, given: Sources) -> Carried:
    """Every draw through the geometry for every point."""

    def one(inputs, noise):
        found = _look(inputs, noise, settings, given)
        return Carried(found.xyz_mm, found.meets)

    return jax.vmap(one)(given.inputs, given.noise)


@compiled(Linear)
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
