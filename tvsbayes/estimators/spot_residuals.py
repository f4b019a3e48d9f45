"""Residuals of spots in units of their noise, ranges projected out, rotated to the directions of the mirror angles.

Each spot gives four pixels and perhaps an aperture angle. Its range along the beam is unknown and flat in image
displacement: the part of the residual along d(pixels)/d(range) is projected out (formulation 4.1), by reflections,
which keep the noise independent.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tvsbayes.estimators.campaign_arrays import SpotArrays
from tvsbayes.estimators.looks import Looks, Numbers
from tvsbayes.instrument.sightings import SIGHTED
from tvsbayes.model.geometry import materialise
from tvsbayes.model.parameter_space import Model


class NoiseScales(eqx.Module):
    """Factors from stated standard deviations to units of the noise: pixels and aperture of every spot."""

    pixels: Float[Array, " spots"]
    aperture: Float[Array, " spots"]

    def whitened(self, numbers: Numbers, spots: SpotArrays) -> Numbers:
        """Whiten differences of observations; the noise of each camera's two pixels may be correlated."""
        u_left, v_left, u_right, v_right, reading = numbers
        w = spots.whitening
        return (
            self.pixels * (w[:, 0, 0] * u_left),
            self.pixels * (w[:, 1, 0] * u_left + w[:, 1, 1] * v_left),
            self.pixels * (w[:, 2, 2] * u_right),
            self.pixels * (w[:, 3, 2] * u_right + w[:, 3, 3] * v_right),
            self.aperture * reading,
        )


def noise_scales(model: Model, spots: SpotArrays, inflation: Float[Array | np.ndarray, ""] | float) -> NoiseScales:
    """Compute the scales of every spot's noise; robust weights enlarge it, padding has infinite noise."""
    root_weight = jnp.sqrt(spots.weight) * spots.valid
    return NoiseScales(
        root_weight / (model.noise.pixel_scale * inflation),
        root_weight * spots.has_aperture / (model.receiver.aperture_sd_rad * inflation),
    )


def _dot(first: Numbers, second: Numbers) -> Float[Array, "..."]:
    """Compute the scalar product of components."""
    return jnp.asarray(sum(a * b for a, b in zip(first, second, strict=True)))


class Reflection(eqx.Module):
    """Householder reflections that map one direction per spot to the first axis.

    `first` is the reflected direction's first component: its length, with the sign that avoids cancellation. Without a
    direction (padding) the first axis replaces it, and the length is 0.
    """

    mirror: Numbers
    half: Float[Array, " spots"]
    first: Float[Array, " spots"]

    @classmethod
    def of(cls, direction: Numbers) -> Reflection:
        """Build the reflection of a direction given by its components."""
        length2 = _dot(direction, direction)
        there = length2 > 0
        length = jnp.sqrt(jnp.where(there, length2, 1.0))
        unit = [number / length for number in direction]
        unit[0] = jnp.where(there, unit[0], 1.0)
        sign = jnp.where(unit[0] < 0, -1.0, 1.0)
        mirror = materialise((unit[0] + sign, *unit[1:]))
        return cls(mirror, 0.5 * _dot(mirror, mirror), -sign * jnp.where(there, length, 0.0))

    def of_many(self, numbers: Numbers) -> Numbers:
        """Reflect components; an axis of columns may precede the spots."""
        share = _dot(self.mirror, numbers) / self.half
        return tuple(number - share * m for m, number in zip(self.mirror, numbers, strict=True))


class SpotResiduals(eqx.Module):
    """All spots after their ranges are projected out, in units of their noise (stated sd x pixel scale).

    `residual` = observed - predicted; `by_pan`, `by_tilt` = d(predicted)/d(pan, tilt): four components each.
    `log_scale` holds each spot's -3 log(pixel_scale) and, with an aperture reading, the term of the fifth observation;
    zero for padding. `range_out` projects the range out of whitened numbers: the first component after reflection.
    """

    residual: Numbers
    by_pan: Numbers
    by_tilt: Numbers
    log_scale: Float[Array, " spots"]
    range_out: Reflection


def spot_residuals(looks: Looks, noise: NoiseScales, model: Model, spots: SpotArrays) -> SpotResiduals:
    """Compare looks with the observations, and project their ranges out (formulation 4.1)."""
    *pixels, reading = looks.predicted
    off = spots.aperture_rad - reading
    # Angles are compared on the circle.
    off = off - jnp.round(off / (2 * jnp.pi)) * (2 * jnp.pi)
    misfit = (*(measured - pixel for measured, pixel in zip(spots.pixels.T, pixels, strict=True)), off)
    misfit, by_pan, by_tilt, by_range = materialise(
        tuple(noise.whitened(numbers, spots) for numbers in (misfit, looks.by_pan, looks.by_tilt, looks.by_range))
    )
    range_out = Reflection.of(by_range)
    residual, by_pan, by_tilt = (range_out.of_many(numbers)[1:] for numbers in (misfit, by_pan, by_tilt))
    if spots.tangents is not None:
        log_scale = -len(SIGHTED) * jnp.log(model.noise.pixel_scale) * spots.valid
        return SpotResiduals(residual, by_pan, by_tilt, log_scale, range_out)
    # Four pixels give s^-4, their range integral s; the aperture's noise also enters that integral.
    pixel_part = _dot(by_range[:4], by_range[:4])
    log_scale = -3 * jnp.log(model.noise.pixel_scale) - 0.5 * jnp.log1p(
        by_range[4] ** 2 / jnp.where(spots.valid > 0, pixel_part, 1.0)
    )
    log_scale -= spots.has_aperture * jnp.log(model.receiver.aperture_sd_rad)
    return SpotResiduals(residual, by_pan, by_tilt, log_scale * spots.valid, range_out)


def _unit(direction: Numbers) -> tuple[Numbers, Float[Array, " spots"]]:
    """Normalise directions; return them and their lengths, zero where there is no direction (padding)."""
    length2 = _dot(direction, direction)
    there = length2 > 0
    length = jnp.sqrt(jnp.where(there, length2, 1.0))
    return materialise(tuple(number / length for number in direction)), jnp.where(there, length, 0.0)


class ToStates(eqx.Module):
    """The two directions in which looks depend on mirror angles: the first on pan and tilt, the second on tilt.

    Four components with independent unit noise become one along each direction, with the same noise, and a remainder:
    the filter then processes two instead of four. Everything is smooth in the slopes (Gram-Schmidt directions; a
    reflection would change its sign).

    Where the beam's angles scatter from look to look, the noise of the two has the covariance R = 1 + slope
    diag(variances) slope^T = U U^T, U upper triangular: they are multiplied by U^-1, so that they have unit noise and
    the second does not depend on pan. `spread` holds U11, U12 and U22, which are 1, 0 and 1 without scatter.
    """

    first: Numbers
    second: Numbers
    pan_load: Float[Array, " spots"]
    tilt_load: Float[Array, " spots"]
    tilt_rest: Float[Array, " spots"]
    spread: Numbers

    @classmethod
    def of(cls, by_pan: Numbers, by_tilt: Numbers, scatter_variance: Float[Array, "spots 2"] | None = None) -> ToStates:
        """Compute the directions from derivatives by pan and tilt and the variances of scattering angles (rad^2)."""
        first, pan_load = _unit(by_pan)
        tilt_load = _dot(first, by_tilt)
        second, tilt_rest = _unit(tuple(b - tilt_load * a for a, b in zip(first, by_tilt, strict=True)))
        one, none = jnp.ones_like(tilt_load), jnp.zeros_like(tilt_load)
        if scatter_variance is None:
            return cls(first, second, pan_load, tilt_load, tilt_rest, (one, none, one))
        by_pan_2, by_tilt_2 = scatter_variance.T
        # Schur's complement, in sums of positive terms: no cancellation at large scatter.
        last2 = 1 + by_tilt_2 * tilt_rest**2
        last, across = jnp.sqrt(last2), tilt_load * by_tilt_2 * tilt_rest
        scale = jnp.sqrt(1 + by_pan_2 * pan_load**2 + by_tilt_2 * tilt_load**2 / last2)
        across = across / last
        loads = pan_load / scale, (tilt_load - across * (tilt_rest / last)) / scale, tilt_rest / last
        return cls(first, second, *loads, (scale, across, last))

    @property
    def log_scale(self) -> Float[Array, " spots"]:
        """Compute the term of the looks' scatter in the log density: -ln det U."""
        scale, _, last = self.spread
        return -jnp.log(scale) - jnp.log(last)

    @property
    def slope(self) -> Float[Array, "spots 2 2"]:
        """Return d(predicted)/d(pan, tilt) of the two components."""
        none = jnp.zeros_like(self.tilt_load)
        first = jnp.stack([self.pan_load, self.tilt_load], axis=1)
        return jnp.stack([first, jnp.stack([none, self.tilt_rest], axis=1)], axis=1)

    def of_many(self, numbers: Numbers) -> Numbers:
        """Compute the components along both directions, and the four remaining; columns may precede the spots."""
        one, two = _dot(self.first, numbers), _dot(self.second, numbers)
        left = (n - p * one - q * two for p, q, n in zip(self.first, self.second, numbers, strict=True))
        return (*self._unit_noise(one, two), *left)

    def in_place(self, numbers: Numbers) -> Numbers:
        """Whiten four components in place, the scatter of looks included."""
        one, two = _dot(self.first, numbers), _dot(self.second, numbers)
        by_one, by_two = (new - old for new, old in zip(self._unit_noise(one, two), (one, two), strict=True))
        return tuple(n + p * by_one + q * by_two for p, q, n in zip(self.first, self.second, numbers, strict=True))

    def _unit_noise(self, one: Array, two: Array) -> tuple[Array, Array]:
        scale, across, last = self.spread
        two = two / last
        return (one - across * two) / scale, two
