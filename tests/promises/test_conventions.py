"""The signs and frames of formulation 2 and its printed test vectors (formulation 3.2), on the JAX model."""

from __future__ import annotations

from statistics import NormalDist

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.printed_vector import LAST_6, LAST_7, LAST_9, LAST_12, VECTOR

from tvsbayes.estimators.looks import aperture_angle, observe
from tvsbayes.instrument.mirrors import Turn, Vectors
from tvsbayes.instrument.parameters import INDEX, NAMES
from tvsbayes.instrument.rig import RigTable
from tvsbayes.model.geometry import project, rotation_matrix
from tvsbayes.model.laser_path import MoveArrays, Transmission, beam_angles, mirror_angles, trace
from tvsbayes.model.parameter_space import Receiver, model_of, parameter_space
from tvsbayes.statistics.intervals import NORMAL_95, coverage_factor

pytestmark = pytest.mark.usefixtures("x64")

ROUNDING = 1e-12
"""Of a dozen operations on numbers up to 1000 (mm, px)."""
PAN_RAD, TILT_RAD = np.radians([10.0, 5.0])
RANGE_MM, BASELINE_MM, C0_RAD = 250.0, 200.0, np.radians(91.0)


@pytest.fixture(scope="module")
def nominal(mounted_rig) -> np.ndarray:
    """Values of the default priors with the mounted rig's cameras, in the units of NAMES."""
    space = parameter_space(RigTable(), mounted_rig.stereo)
    values = np.concatenate([space.value, space.stereo_mean])
    values[INDEX["extrinsics.translation_mm.y"]] = -100.0
    return values


def with_values(values: np.ndarray, **changes: float) -> np.ndarray:
    values = values.copy()
    for name, value in changes.items():
        values[INDEX[name]] = value
    return values


@pytest.fixture(scope="module")
def looks():
    """(values (65,), poses (n <= 6, 3: pan, tilt rad, range mm)) -> ray origins, directions, observations."""

    def one(values, poses):
        model = model_of(values)
        rays = trace(model.optics, poses[0], poses[1])
        return rays.origin_mm.stacked().T, rays.direction.stacked().T, observe(model, poses, jnp.asarray(False)).T

    compiled = jax.jit(one)

    def run(values, poses):
        padded = np.tile([0.0, 0.0, 250.0], (6, 1))
        padded[: len(poses)] = poses
        with jax.enable_x64(True):
            return [np.asarray(x)[: len(poses)] for x in compiled(jnp.asarray(values), jnp.asarray(padded.T))]

    return run


def test_beam_of_the_test_vector(nominal, looks):
    origin, direction, _ = looks(with_values(nominal, **VECTOR), [[PAN_RAD, TILT_RAD, RANGE_MM]])
    printed = [5.371658918, -29.176887333, -0.940368833]
    # The design is rounded from these digits: half a unit of the last one at most.
    assert np.abs(origin[0] - printed).max() <= LAST_9 * 1.01
    assert np.abs(direction[0] - [0.981182562588, 0.177188586189, 0.076713648059]).max() <= LAST_12 * 1.01


def test_jacobian_of_the_test_vector(nominal):
    model = model_of(jnp.asarray(with_values(nominal, **VECTOR)))
    angles = jax.jit(beam_angles)(model.optics, jnp.asarray(PAN_RAD), jnp.asarray(TILT_RAD))
    printed = [[1.0070677, 0.0038895], [-0.0025873, 0.9977070]]
    assert np.abs(angles.jacobian - np.array(printed)).max() <= LAST_7 * 1.01


@pytest.mark.parametrize(("azimuth", "printed_deg"), [(False, 48.834423), (True, 48.759278)])
def test_tvs_point_and_aperture_of_the_test_vector(nominal, looks, azimuth, printed_deg):
    """250 mm along the beam: p_T = Rz(C0 - 90 deg) p_P + (0, a/2, 0), and B as either convention reads it."""
    origin, direction, _ = looks(with_values(nominal, **VECTOR), [[PAN_RAD, TILT_RAD, RANGE_MM]])
    point_p = Vectors.of(jnp.asarray(origin[0] + RANGE_MM * direction[0]))
    point_t = Turn.by(jnp.asarray(C0_RAD - np.pi / 2), jnp).forward(point_p) + Vectors.of(
        np.array([0.0, BASELINE_MM / 2, 0.0])
    )
    assert np.abs(point_t.stacked() - np.array([250.365237, 119.492704, 18.238043])).max() <= LAST_6 * 1.01
    receiver = Receiver(*map(jnp.asarray, (BASELINE_MM, C0_RAD, 0.0, 1.0)))
    angle_deg = np.degrees(aperture_angle(receiver, point_p, jnp.asarray(azimuth)))
    assert abs(float(angle_deg) - printed_deg) <= LAST_6 * 1.01


def test_play_of_the_test_vector():
    """B 0.3, k_left 0.060, k_right 0.062, y = -0.15, moves +200, -200, +3, -2, +100."""
    mean, contrast, backlash = np.radians([0.061, -0.002, 0.3])
    transmission = Transmission(*(jnp.full(2, v) for v in (mean, contrast, backlash)))
    counters = np.cumsum([0, 200, -200, 3, -2, 100])
    first = np.arange(6) == 0
    moves = MoveArrays(
        jnp.asarray(np.stack([counters, -counters], axis=1).astype(float)),
        jnp.asarray(first),
        jnp.asarray(first[:, None] * np.array([1.0, -1.0])),
    )
    angles = np.degrees(jax.jit(mirror_angles)(transmission, jnp.zeros(()), moves).angle_rad)
    np.testing.assert_allclose(angles[:, 0], [-0.15, 11.85, -0.25, -0.25, -0.25, 5.506], atol=ROUNDING)
    # The tilt was driven the other way from its other side: 200 steps down by 0.062, up by 0.060.
    np.testing.assert_allclose(angles[:3, 1], [0.15, -12.4 + 0.15, -12.4 + 12.0 - 0.15], atol=ROUNDING)


def test_pan_positive_is_left_and_tilt_positive_is_up(nominal, looks):
    """In P the azimuth grows with the pan and the elevation with the tilt; C grows by the pan angle."""
    poses = np.array([[0.0, 0.0, 250.0], [0.1, 0.0, 250.0], [0.0, 0.1, 250.0]])
    _, direction, pixels = looks(nominal, poses)
    np.testing.assert_allclose(direction[0], [1.0, 0.0, 0.0], atol=ROUNDING)
    np.testing.assert_allclose(direction[1], [np.cos(0.1), np.sin(0.1), 0.0], atol=ROUNDING)
    np.testing.assert_allclose(direction[2], [np.cos(0.1), 0.0, np.sin(0.1)], atol=ROUNDING)
    # With P parallel to S, left in the room is left in both images, up is up (v falls).
    assert np.all(pixels[1, [0, 2]] < pixels[0, [0, 2]] - 1.0)
    assert np.all(pixels[2, [1, 3]] < pixels[0, [1, 3]] - 1.0)
    in_t = Turn.by(jnp.asarray(C0_RAD - np.pi / 2), jnp).forward(Vectors.of(jnp.asarray(direction[1])))
    emission = np.pi / 2 + np.arctan2(in_t.y, in_t.x)
    assert emission == pytest.approx(C0_RAD + 0.1, abs=ROUNDING)


def test_left_and_up_are_growing_counters():
    """A left move turns the pan by k_pan + c_pan / 2 per step; right, up and down accordingly."""
    transmission = Transmission(*(jnp.asarray(v) for v in ([1e-3, 2e-3], [1e-4, 4e-4], [0.0, 0.0])))
    counters = jnp.asarray([[0.0, 0.0], [1.0, 1.0], [0.0, 0.0]])
    moves = MoveArrays(counters, jnp.arange(3) == 0, jnp.zeros((3, 2)))
    turned = np.diff(mirror_angles(transmission, jnp.zeros(()), moves).angle_rad, axis=0)
    np.testing.assert_allclose(turned, [[1.05e-3, 2.2e-3], [-0.95e-3, -1.8e-3]], rtol=4e-15)


def test_aperture_reads_the_angle_from_plus_y():
    """A spot straight ahead of the aperture, in the plane z = 0: 90 deg; towards the positioner: less."""
    receiver = Receiver(*map(jnp.asarray, (BASELINE_MM, np.pi / 2, 0.0, 1.0)))
    points_p = jnp.asarray([[300.0, 300.0, 300.0], [-200.0, -100.0, 0.0], [0.0, 0.0, 0.0]])
    angles = np.asarray(aperture_angle(receiver, Vectors.of(points_p), jnp.asarray(False)))
    np.testing.assert_allclose(angles, [np.pi / 2, np.arctan2(300, 100), np.arctan2(300, 200)], atol=ROUNDING)


@pytest.mark.parametrize("azimuth", [False, True])
def test_aperture_angle_has_a_derivative_on_the_baseline(azimuth):
    """A spot on the line between both instruments has no lateral direction; the gradient stays finite."""
    receiver = Receiver(*map(jnp.asarray, (BASELINE_MM, np.pi / 2, 0.0, 1.0)))
    gradient = jax.grad(lambda p: aperture_angle(receiver, Vectors.of(p), jnp.asarray(azimuth)))
    for y_mm in (-50.0, 0.0, -250.0):
        assert np.isfinite(gradient(jnp.asarray([0.0, y_mm, 0.0]))).all()


def test_observation_is_the_chain_of_transforms(nominal, looks):
    """p_S = R_SP p_P + t_SP, as T_AC = T_AB T_BC says; the aperture's zero is added to what it reads."""
    values = with_values(
        nominal,
        **VECTOR,
        **{f"extrinsics.rotation_rad.{a}": r for a, r in zip("xyz", (0.1, -0.2, 0.3), strict=True)},
        **{f"extrinsics.translation_mm.{a}": t for a, t in zip("xyz", (5.0, -90.0, 7.0), strict=True)},
        aperture_zero_deg=0.7,
    )
    origin, direction, look = looks(values, [[PAN_RAD, TILT_RAD, RANGE_MM]])
    point_p = origin[0] + RANGE_MM * direction[0]
    rotation = np.asarray(rotation_matrix(jnp.asarray([0.1, -0.2, 0.3])))
    point_s = rotation @ point_p + [5.0, -90.0, 7.0]
    model = model_of(jnp.asarray(values))
    np.testing.assert_allclose(
        look[0, :4], np.asarray(project(model.cameras, jnp.asarray(point_s)[:, None]))[:, 0], atol=1e3 * ROUNDING
    )
    angle = aperture_angle(model.receiver, Vectors.of(jnp.asarray(point_p)), jnp.asarray(False))
    assert look[0, 4] == pytest.approx(float(angle) + np.radians(0.7), abs=ROUNDING)


def test_frame_s_looks_along_x(mounted_rig):
    """Depth X hits the left camera's centre; left (Y) lowers u, up (Z) lowers v; the right camera sees by R, T."""
    stereo = mounted_rig.stereo
    space = parameter_space(RigTable(), stereo)
    model = model_of(jnp.asarray(np.concatenate([space.value, space.stereo_mean])))
    points = jnp.asarray([[500.0, 500.0, 500.0], [0.0, 10.0, 0.0], [0.0, 0.0, 10.0]])
    ahead, left, up = np.asarray(project(model.cameras, points)).T
    np.testing.assert_allclose(ahead[:2], stereo.M1[:2, 2], atol=ROUNDING * 1e3)
    assert left[0] < ahead[0] - 10 and abs(left[1] - ahead[1]) < 1  # 16 px against distortion's share
    assert up[1] < ahead[1] - 10 and abs(up[0] - ahead[0]) < 1
    assert ahead[2] < ahead[0], "the right camera stands to the right: disparity is positive"


def test_every_name_has_its_unit():
    """A float of a module's interface has its unit in its name; ratios and scales have none."""
    units = ("_deg", "_mm", "_rad", "_minutes", "deg_per_step", "degrees_per_step")
    without = [n for n in NAMES if not any(u in n for u in units)]
    assert [n for n in without if not n.startswith("stereo.")] == ["pixel_scale", "focal_scale"]


def test_95_percent_are_two_sided_and_normal():
    """GUM 6.2 and table G.1: k = 1.96. Quantiles of the standard library, whatever the package takes them from."""
    exact = NormalDist().inv_cdf(0.975)
    assert NORMAL_95 == pytest.approx(exact, rel=1e-9)
    assert coverage_factor(np.inf) == pytest.approx(exact, rel=1e-9)
