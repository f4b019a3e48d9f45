"""Path of the laser: counters -> gears, play -> mirror angles -> beam. Differentiable (formulation 3.1 and 3.2).

Lengths in mm, angles in rad. Pan positive = left, tilt positive = up; arrays over axes are ordered (pan, tilt). Frame P
and vectors in components are as in `instrument.mirrors`.
"""

from __future__ import annotations

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from tvsbayes.gears.play import band_begun, band_moved
from tvsbayes.gears.states import crept
from tvsbayes.instrument.chains import Chain
from tvsbayes.instrument.mirrors import Ray
from tvsbayes.instrument.parameters import HARMONIC_ORDERS
from tvsbayes.model.geometry import Scalar, materialise

UNIFORM_SD = 1 / 12**0.5
"""Standard deviation of a uniform distribution of unit width."""
ORDERS = np.array(HARMONIC_ORDERS, dtype=float)
STRETCH = 64
"""Moves computed together: the cost follows the campaign's own moves, not its padded length."""


class Harmonics(eqx.Module):
    """Transmission error of both axes: h(a) = sum_o c_o cos(2 pi o a / P) + s_o sin(2 pi o a / P) (formulation 3.1).

    Attributes:
        amplitude_rad: indices axis, order, (c, s).
        period_rad: P of each axis, angle of the output.
        on_wheel: whether the error is the wheel's, a function of the output behind the play, or the pinion's, a
            function of the input before it.
    """

    amplitude_rad: Float[Array, "2 2 2"]
    period_rad: Float[Array, "2"]
    on_wheel: Bool[Array, "2"]

    def error_rad(self, angle_rad: Float[Array, "*moves 2"]) -> Float[Array, "*moves 2"]:
        """Compute the error at one angle per axis."""
        phase = (2 * jnp.pi) * (angle_rad / self.period_rad)[..., None] * ORDERS
        cosine, sine = self.amplitude_rad[..., 0], self.amplitude_rad[..., 1]
        return jnp.sum(cosine * jnp.cos(phase) + sine * jnp.sin(phase), axis=-1)


def no_harmonics() -> Harmonics:
    """Return perfect gears; a full turn replaces a period that is not stated."""
    return Harmonics(jnp.zeros((2, 2, 2)), jnp.full(2, 2 * jnp.pi), jnp.ones(2, dtype=bool))


class ZeroShift(eqx.Module):
    """Shifts of both zeros: creep c (1 - exp(-t / tau)) of a machine that warms up, and k (T - T_0) (formulation 3.1).

    Attributes:
        creep_rad: c of each axis.
        creep_minutes: tau, of both.
        thermal_rad_per_K: k of each axis.
    """

    creep_rad: Float[Array, "2"]
    creep_minutes: Scalar
    thermal_rad_per_K: Float[Array, "2"]

    def shift_rad(
        self, warm_minutes: Float[Array, " moves"], kelvin: Float[Array, " moves"]
    ) -> Float[Array, "moves 2"]:
        """Compute shifts at times t since the machine was switched on and temperatures T - T_0."""
        share = crept(warm_minutes, self.creep_minutes, jnp)
        return share[:, None] * self.creep_rad + kelvin[:, None] * self.thermal_rad_per_K


class Transmission(eqx.Module):
    """Gears of both axes: mean ratio, left-minus-right (up-minus-down) contrast, play and transmission error.

    `zero_shift` is None where the zeros are constant.
    """

    ratio_rad_per_step: Float[Array, "2"]
    contrast_rad_per_step: Float[Array, "2"]
    backlash_rad: Float[Array, "2"]
    harmonics: Harmonics = eqx.field(default_factory=no_harmonics)
    zero_shift: ZeroShift | None = None


class MoveArrays(eqx.Module):
    """Moves of a campaign, padded; `approach` is +1 left/up, -1 right/down, 0 unknown, read at `first` rows.

    `warm_minutes` is the time since the machine was switched on, `kelvin` the temperature less that of the first move;
    both are None where the zeros are taken as constant.
    """

    steps: Float[Array, "moves 2"]
    first: Bool[Array, " moves"]
    approach: Float[Array, "moves 2"]
    warm_minutes: Float[Array, " moves"] | None = None
    kelvin: Float[Array, " moves"] | None = None


class MirrorAngles(eqx.Module):
    """Mirror angles after each move, without stop error and home offset.

    Where the approach of a segment's first row is unknown, the position in the play is uniform in its band. `angle_rad`
    is then the mean angle and `play_sd_rad` the standard deviation, zero as soon as a move has taken the play up.
    """

    angle_rad: Float[Array, "moves 2"]
    play_sd_rad: Float[Array, "moves 2"]


class Reached(eqx.Module):
    """State at the end of earlier moves: ends of the play's band, counters, and distance since the segment began."""

    low_rad: Float[Array, "2"]
    high_rad: Float[Array, "2"]
    steps: Float[Array, "2"]
    way_steps: Float[Array, "2"]


def nowhere() -> Reached:
    """Return the state before the first move, which begins a segment."""
    return Reached(*(jnp.zeros(2) for _ in range(4)))


def way_steps(moves: MoveArrays, before: Reached) -> Float[Array, "moves 2"]:
    """Count the steps that each axis has gone, forwards and backwards, since its segment began."""
    gone = jnp.abs(jnp.diff(moves.steps, axis=0, prepend=before.steps[None]))
    total = before.way_steps + jnp.cumsum(jnp.where(moves.first[:, None], 0.0, gone), axis=0)
    begun = jnp.where(moves.first[:, None], total, 0.0)
    return total - jax.lax.cummax(begun)


class Stretch(eqx.Module):
    """Result of some moves: their angles, the number of the next move, and the state before it."""

    angles: MirrorAngles
    next: Int[Array, ""]
    reached: Reached


def mirror_angles(transmission: Transmission, tilt_zero_rad: Scalar, moves: MoveArrays) -> MirrorAngles:
    """Compute mirror angles from counters, through gears, play, transmission error and shifts of the zeros in time.

    Over a band of unknown play the wheel's error is taken at the band's middle, as a shift of the whole band. At an
    amplitude of 0.1 deg and a play of 0.5 deg the curvature left out is 1e-6 deg and the slope 0.4 % of the deviation.
    The filter also adds home offsets behind the gears, as if the error had no slope.

    Args:
        transmission: gears of both axes.
        tilt_zero_rad: tilt mirror angle at mid-play and counter zero.
        moves: absolute counters in time order.

    Returns:
        Mirror angles (pan, tilt) after each move.
    """
    return followed(transmission, tilt_zero_rad, moves, jnp.zeros((), dtype=int), nowhere()).angles


def followed(
    transmission: Transmission, tilt_zero_rad: Scalar, moves: MoveArrays, number: Int[Array, ""], before: Reached
) -> Stretch:
    """Compute `mirror_angles` of moves after others; `number` is that of the first of them."""
    half = transmission.backlash_rad / 2
    harmonics = transmission.harmonics
    # k n + c/2 times the distance since the segment began: k + c/2 forwards and k - c/2 backwards.
    way = way_steps(moves, before)
    q = transmission.ratio_rad_per_step * moves.steps + 0.5 * transmission.contrast_rad_per_step * way
    # The errors do not depend on history, so they are computed outside the scan, in one vector operation.
    driven = q + jnp.where(harmonics.on_wheel, 0.0, harmonics.error_rad(q))

    def take_up(band, move):
        q, first, approach = move
        low, high = (
            jnp.where(first, begun, moved)
            for begun, moved in zip(band_begun(q, half, approach, jnp), band_moved(band, q, half, jnp), strict=True)
        )
        return (low, high), (0.5 * (low + high), UNIFORM_SD * (high - low))

    rows = driven, moves.first, moves.approach
    (low, high), (output, play_sd_rad) = jax.lax.scan(take_up, (before.low_rad, before.high_rad), rows)
    output += jnp.where(harmonics.on_wheel, harmonics.error_rad(output), 0.0)
    output += jnp.stack([jnp.zeros(()), tilt_zero_rad])
    if transmission.zero_shift is not None and moves.warm_minutes is not None and moves.kelvin is not None:
        output += transmission.zero_shift.shift_rad(moves.warm_minutes, moves.kelvin)
    reached = Reached(low, high, moves.steps[-1], way[-1])
    return Stretch(MirrorAngles(output, play_sd_rad), number + len(moves.steps), reached)


def no_moves(moves: MoveArrays) -> Stretch:
    """Return an empty stretch before the first move."""
    none = jnp.zeros((stretch_size(moves), 2))
    return Stretch(MirrorAngles(none, none), jnp.zeros((), dtype=int), nowhere())


def stretch_size(moves: MoveArrays) -> int:
    """Return the number of moves computed together: `STRETCH`, or a divisor of the padded number."""
    count = len(moves.steps)
    return count if count <= STRETCH else math.gcd(count, STRETCH)


class AnglesAt(eqx.Module):
    """Mirror angles at the requested moves, and the last stretch computed for them."""

    angles: MirrorAngles
    stretch: Stretch


def angles_at(
    transmission: Transmission,
    tilt_zero_rad: Scalar,
    moves: MoveArrays,
    index: Int[Array, " looks"],
    so_far: Stretch,
) -> AnglesAt:
    """Compute `mirror_angles` at the moves before looks, following only the moves up to the last look.

    Args:
        transmission: gears of both axes.
        tilt_zero_rad: tilt mirror angle at mid-play and counter zero.
        moves: absolute counters in time order.
        index: moves of the looks, ascending; none lies before `so_far`.
        so_far: `no_moves`, or the stretch of earlier looks.
    """
    size = stretch_size(moves)

    def known(stretch: Stretch, before: MirrorAngles) -> MirrorAngles:
        row = index - (stretch.next - size)
        there, row = ((row >= 0) & (row < size))[:, None], jnp.clip(row, 0, size - 1)
        return jax.tree.map(lambda own, old: jnp.where(there, own[row], old), stretch.angles, before)

    def further(state: AnglesAt) -> AnglesAt:
        start = state.stretch.next
        rows = jax.tree.map(lambda array: jax.lax.dynamic_slice_in_dim(array, start, size), moves)
        stretch = followed(transmission, tilt_zero_rad, rows, start, state.stretch.reached)
        return AnglesAt(known(stretch, state.angles), stretch)

    none = jnp.zeros((len(index), 2))
    begin = AnglesAt(known(so_far, MirrorAngles(none, none)), so_far)
    return jax.lax.while_loop(lambda state: state.stretch.next <= index[-1], further, begin)


def trace(optics: Chain, pan_rad: Float[Array, "*batch"], tilt_rad: Float[Array, "*batch"]) -> Ray:
    """Trace the beam to where it leaves the instrument (formulation 3.2; the signs are part of the contract).

    Args:
        optics: chain of the beam.
        pan_rad: angles psi of the pan stage.
        tilt_rad: angles beta of the tilt stage.

    Returns:
        The rays in frame P.
    """
    return optics.leaving(pan_rad, tilt_rad, jnp, materialise)


class BeamAngles(eqx.Module):
    """Azimuth atan2(d_y, d_x) and elevation asin(d_z) of the beam in frame P with their Jacobian.

    `jacobian[i, j]` is d(azimuth, elevation)_i / d(pan, tilt)_j. `effective_mirror_offset_mm` is the signed
    distance of the beam line from the pan axis: the horizontal moment d_y o_x - d_x o_y over |d_xy|, +L for
    the nominal chain.
    """

    azimuth_rad: Scalar
    elevation_rad: Scalar
    jacobian: Float[Array, "2 2"]
    effective_mirror_offset_mm: Scalar


def beam_angles(optics: Chain, pan_rad: Scalar, tilt_rad: Scalar) -> BeamAngles:
    """Compute the beam's direction and its slope by the mirror angles at one pose (formulation 3.2)."""

    def azimuth_elevation(angles):
        d = trace(optics, angles[0], angles[1]).direction
        return jnp.stack([jnp.arctan2(d.y, d.x), jnp.arctan2(d.z, jnp.hypot(d.x, d.y))])

    pose = jnp.stack([pan_rad, tilt_rad])
    azimuth, elevation = azimuth_elevation(pose)
    ray = trace(optics, pan_rad, tilt_rad)
    o, d = ray.origin_mm, ray.direction
    offset = (d.y * o.x - d.x * o.y) / jnp.hypot(d.x, d.y)
    return BeamAngles(azimuth, elevation, jax.jacfwd(azimuth_elevation)(pose), offset)
