"""Gears, play, mirrors: their laws, their derivatives, their behaviour far from any real rig."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tvsbayes.instrument.mirrors import Optics
from tvsbayes.model.laser_path import (
    UNIFORM_SD,
    Harmonics,
    MoveArrays,
    Transmission,
    beam_angles,
    mirror_angles,
    trace,
)

pytestmark = pytest.mark.usefixtures("x64")

ANGLE_ROUNDING_RAD = 1e-14
"""A hundred additions of angles of order one."""
LENGTH = 32


def optics_of(values) -> Optics:
    """Ten numbers -> Optics: L mm, e1, e2, laser tilt (2) rad, laser offset (2) mm, skew rad, axis offset (2) mm."""
    return Optics(
        mirror_offset_mm=values[0],
        mirror1_error_rad=values[1],
        mirror2_error_rad=values[2],
        laser_tilt_rad=values[3:5],
        laser_offset_mm=values[5:7],
        tilt_axis_skew_rad=values[7],
        tilt_axis_offset_mm=values[8:10],
    )


OPTICS_SD = np.array([5.0, *np.radians([0.5] * 4), 0.5, 0.5, np.radians(0.5), 0.5, 0.5])
NOMINAL = np.array([30.0, *[0.0] * 9])
PINION_RAD = np.pi / 2
GEARS = 15


def transmission_of(values) -> tuple[Transmission, jax.Array]:
    """Fifteen numbers -> Transmission (ratios, contrasts rad/step, backlash rad) and tilt zero, rad; harmonics, rad.

    The pan's error is its pinion's, four periods per turn; the tilt's is its wheel's.
    """
    harmonics = Harmonics(
        jnp.reshape(values[7:], (2, 2, 2)), jnp.array([PINION_RAD, 2 * jnp.pi]), jnp.array([False, True])
    )
    return Transmission(values[0:2], values[2:4], values[4:6], harmonics), values[6]


@pytest.fixture(scope="module")
def gears():
    """Angles and play sds for (values (7 or 15,), steps, first, approach), and the Jacobian of the angles.

    Without harmonics they are 0.
    """

    def one(values, moves):
        result = mirror_angles(*transmission_of(values), moves)
        return result.angle_rad, result.play_sd_rad

    jacobian = jax.jacfwd(lambda v, m: one(v, m)[0])
    compiled = jax.jit(lambda v, m: (*one(v, m), jacobian(v, m)))

    def run(values, steps, first, approach):
        """Moves are padded to one length by repeating the last row."""
        steps, first, approach = (np.asarray(x, dtype=t) for x, t in ((steps, float), (first, bool), (approach, float)))
        pad = LENGTH - len(steps)
        moves = MoveArrays(
            jnp.asarray(np.concatenate([steps, np.repeat(steps[-1:], pad, axis=0)])),
            jnp.asarray(np.concatenate([first, np.zeros(pad, bool)])),
            jnp.asarray(np.concatenate([approach, np.zeros((pad, 2))])),
        )
        with jax.enable_x64(True):
            return [np.asarray(x) for x in compiled(jnp.asarray(np.pad(values, (0, GEARS - len(values)))), moves)]

    return run


def random_gears(rng) -> np.ndarray:
    return np.concatenate(
        [
            np.radians(rng.normal([0.06, 0.07], 0.01)),
            np.radians(rng.normal(0, 1e-3, 2)),
            np.radians(np.abs(rng.normal(0, 0.5, 2))),
            np.radians(rng.normal(0, 2, 1)),
            np.radians(rng.normal(0, 0.1, 8)),
        ]
    )


def test_beams_are_finite_far_from_any_rig():
    """Mirror errors to 30 deg, laser tilts to 30 deg, poses to 60 deg: a solver may stray there."""

    def one(values):
        ray = trace(optics_of(values[:10]), values[10], values[11])
        return jnp.concatenate([ray.origin_mm.stacked(), ray.direction.stacked()])

    rng = np.random.default_rng(3)
    optics = NOMINAL + OPTICS_SD * np.clip(rng.standard_normal((200, 10)), -3, 3)
    optics[:, 1:5] = np.radians(rng.uniform(-30, 30, (200, 4)))
    states = np.hstack([optics, np.radians(rng.uniform(-60, 60, (200, 2)))])
    rays, jacobian = map(np.asarray, jax.jit(jax.vmap(lambda v: (one(v), jax.jacfwd(one)(v))))(states))
    assert np.isfinite(rays).all() and np.isfinite(jacobian).all()
    np.testing.assert_allclose(np.linalg.norm(rays[:, 3:], axis=1), 1.0, atol=ANGLE_ROUNDING_RAD)


def test_angles_are_finite_far_from_any_rig(gears):
    """Of three segments with long, short and one-axis moves."""
    rng = np.random.default_rng(3)
    steps = np.cumsum(rng.choice([-200, -30, -2, 0, 1, 5, 60, 200], (24, 2)), axis=0)
    first = np.isin(np.arange(24), (0, 9, 17))
    approach = np.where(first[:, None], rng.choice([-1, 0, 1], (24, 2)), 0)
    for values in (np.zeros(GEARS), 1e3 * random_gears(rng), -random_gears(rng)):
        assert all(np.isfinite(part).all() for part in gears(values, steps, first, approach))


@pytest.mark.parametrize(("axis", "sign"), [(0, 1), (0, -1), (1, 1), (1, -1)])
def test_contrast_is_positive_minus_negative_ratio(gears, axis, sign):
    """k_left = k + c/2, k_right = k - c/2; up and down likewise; the other axis has no part in it."""
    values = np.array([1.0e-3, 1.2e-3, 1e-4, 3e-4, 0.0, 0.0, 0.0])
    steps = np.zeros((2, 2))
    steps[1, axis] = 100 * sign
    angle = gears(values, steps, [True, False], [[1, 1], [0, 0]])[0][1]
    expected = np.zeros(2)
    expected[axis] = 100 * sign * (values[axis] + sign * values[2 + axis] / 2)
    np.testing.assert_allclose(angle, expected, atol=ANGLE_ROUNDING_RAD)


def test_first_row_of_a_segment_rehomes_with_the_mean_ratio(gears):
    """Whatever happened before: q = k n, not the history's sum; play by its approach."""
    k, c, b = 1e-3, 2e-4, 8e-3
    values = np.array([k, k, c, c, b, b, 0.0])
    before = [[0, 0], [300, -300], [100, 50]]
    steps = [*before, [40, 40], [40, 40]]
    first = [True, False, False, True, False]
    approach = [[1, 1], [0, 0], [0, 0], [1, -1], [0, 0]]
    angle = gears(values, steps, first, approach)[0]
    np.testing.assert_allclose(angle[3], [40 * k - b / 2, 40 * k + b / 2], atol=ANGLE_ROUNDING_RAD)
    np.testing.assert_allclose(angle[4], angle[3], atol=ANGLE_ROUNDING_RAD)
    alone = gears(values, steps[3:], first[3:], approach[3:])[0]
    np.testing.assert_allclose(angle[3:5], alone[:2], atol=ANGLE_ROUNDING_RAD)


def test_unknown_play_closes_as_moves_take_it_up(gears):
    """After a move of w from an unknown start the output lies in a band narrower by w, until it closes."""
    b, k = 8e-3, 1e-3
    values = np.array([k, k, 0.0, 0.0, b, b, 0.0])
    steps = [[0, 0], [3, 0], [1, 0], [1, 10]]
    angle, play_sd, _ = gears(values, steps, [True, False, False, False], [[0, 0]] * 4)
    # Anywhere in the play, both axes.
    np.testing.assert_allclose(angle[0], 0.0, atol=ANGLE_ROUNDING_RAD)
    np.testing.assert_allclose(play_sd[0], b / np.sqrt(12), atol=ANGLE_ROUNDING_RAD)
    # q = 3 k pushes outputs below q - b/2 up: the band is [3k - b/2, b/2]; q = k does not touch it.
    for row in (1, 2):
        np.testing.assert_allclose(angle[row, 0], 1.5 * k, atol=ANGLE_ROUNDING_RAD)
        np.testing.assert_allclose(play_sd[row, 0], UNIFORM_SD * (b - 3 * k), atol=ANGLE_ROUNDING_RAD)
    # 10 steps up exceed the play of 8 steps: the tilt is known from then on, the pan as before.
    np.testing.assert_allclose(angle[3], [1.5 * k, 10 * k - b / 2], atol=ANGLE_ROUNDING_RAD)
    np.testing.assert_allclose(play_sd[3], [UNIFORM_SD * (b - 3 * k), 0.0], atol=ANGLE_ROUNDING_RAD)


H1C, H1S, H2C, H2S = 0.10, 0.20, 0.03, 0.04
"""An axis' harmonics in the examples by hand, deg."""
WOBBLE_RAD = np.radians([H1C, H1S, H2C, H2S])


def test_pinion_error_enters_before_the_play(gears):
    """By hand: counters of a quarter period, whose phases are 0, 90, 180 and again 90 deg; play of 0.4 deg."""
    values = np.concatenate([np.radians([22.5, 1, 0, 0, 0.4, 0.4, 0]), WOBBLE_RAD, np.zeros(4)])
    steps = np.column_stack([[0, 1, 2, 1], np.zeros(4)])
    angle = np.degrees(gears(values, steps, [True, False, False, False], [[1, 1]] * 4)[0][:4, 0])
    forward, back = -0.2, 0.2
    at_90 = 22.5 + H1S - H2C
    expected = [H1C + H2C + forward, at_90 + forward, 45 - H1C + H2C + forward, at_90 + back]
    np.testing.assert_allclose(angle, expected, atol=100 * ANGLE_ROUNDING_RAD)


def test_wheel_error_enters_behind_the_play(gears):
    """By hand: play of 0.4 deg holds the wheel at 90 deg, where the phase is 90 deg, while the input is elsewhere."""
    values = np.concatenate([np.radians([1, 0.1, 0, 0, 0.4, 0.4, 5]), np.zeros(4), WOBBLE_RAD])
    steps = np.column_stack([np.zeros(3), [902, 900, 897]])
    angle = np.degrees(gears(values, steps, [True, False, False], [[1, 1]] * 3)[0][:3, 1])
    # Inputs of 90.2 and 90.0 leave the wheel at 90; 89.7 drags it to 89.9.
    phase = np.radians(89.9)
    moved = H1C * np.cos(phase) + H1S * np.sin(phase) + H2C * np.cos(2 * phase) + H2S * np.sin(2 * phase)
    expected = [95 + H1S - H2C, 95 + H1S - H2C, 94.9 + moved]
    np.testing.assert_allclose(angle, expected, atol=100 * ANGLE_ROUNDING_RAD)


def test_unknown_play_takes_the_error_at_the_middle_of_its_band(gears):
    """The band stays as wide as the play whatever the error; at mid-play both members have turned by q."""
    values = np.concatenate([np.radians([22.5, 90, 0, 0, 0.4, 0.4, 0]), WOBBLE_RAD, WOBBLE_RAD])
    angle, play_sd, _ = gears(values, [[1, 1]], [True], [[0, 0]])
    expected = np.radians([22.5 + H1S - H2C, 90 + H1S - H2C])
    np.testing.assert_allclose(angle[0], expected, atol=ANGLE_ROUNDING_RAD)
    np.testing.assert_allclose(play_sd[0], UNIFORM_SD * np.radians(0.4), atol=ANGLE_ROUNDING_RAD)


def test_beam_angles_of_the_nominal_chain():
    """Unit Jacobian, azimuth psi, elevation beta, effective mirror offset +L at every pose."""
    compute = jax.jit(jax.vmap(lambda v: beam_angles(optics_of(v[:10]), v[10], v[11])))
    poses = np.radians([[0.0, 0.0], [25.0, 10.0], [-40.0, -20.0]])
    angles = compute(jnp.asarray(np.hstack([np.tile(NOMINAL, (3, 1)), poses])))
    np.testing.assert_allclose(angles.effective_mirror_offset_mm, 30.0, atol=30 * ANGLE_ROUNDING_RAD)
    np.testing.assert_allclose(np.stack([angles.azimuth_rad, angles.elevation_rad], 1), poses, atol=ANGLE_ROUNDING_RAD)
    np.testing.assert_allclose(angles.jacobian, np.broadcast_to(np.eye(2), (3, 2, 2)), atol=ANGLE_ROUNDING_RAD)
