"""The signs and frames of formulation 2 on the JAX model.

Its printed test vectors are in `twin/test_physics.py`; `test_twin_equals_model.py` carries them over to the model.
"""

from __future__ import annotations

from statistics import NormalDist

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.printed_vector import VECTOR

from tvsbayes.estimators.looks import aperture_angle, observe
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.mirrors import Turn, Vectors
from tvsbayes.instrument.rig import RigTable
from tvsbayes.model.geometry import project, rotation_matrix
from tvsbayes.model.laser_path import trace
from tvsbayes.model.parameter_space import Receiver, model_of, parameter_space
from tvsbayes.statistics.intervals import NORMAL_95, coverage_factor

pytestmark = pytest.mark.usefixtures("x64")

ROUNDING = 1e-12
"""Of a dozen operations on numbers up to 1000 (mm, px)."""
PAN_RAD, TILT_RAD = np.radians([10.0, 5.0])
RANGE_MM, BASELINE_MM, C0_RAD = 250.0, 200.0, np.radians(91.0)


@pytest.fixture(scope="module")
def nominal(mounted_rig) -> np.ndarray:
    """Values of the default priors with the mounted rig's cameras, in the units of TWO_MIRROR.names."""
    space = parameter_space(RigTable(), mounted_rig.stereo)
    values = np.concatenate([space.value, space.stereo_mean])
    values[TWO_MIRROR.index["extrinsics.translation_mm.y"]] = -100.0
    return values


def with_values(values: np.ndarray, **changes: float) -> np.ndarray:
    values = values.copy()
    for name, value in changes.items():
        values[TWO_MIRROR.index[name]] = value
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
    without = [n for n in TWO_MIRROR.names if not any(u in n for u in units)]
    assert [n for n in without if not n.startswith("stereo.")] == ["pixel_scale", "focal_scale"]


def test_95_percent_are_two_sided_and_normal():
    """GUM 6.2 and table G.1: k = 1.96. Quantiles of the standard library, whatever the package takes them from."""
    exact = NormalDist().inv_cdf(0.975)
    assert NORMAL_95 == pytest.approx(exact, rel=1e-9)
    assert coverage_factor(np.inf) == pytest.approx(exact, rel=1e-9)
