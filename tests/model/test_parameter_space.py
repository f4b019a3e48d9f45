"""Priors as coordinates, and which name drives which quantity of the model (formulation 4.1)."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from support.small_campaign import small_stereo

from tvsbayes.gears.priors import half_normal_sd
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.parameters import (
    AMPLITUDE_NAMES,
    GEAR_ERROR_NAMES,
    HARMONIC_NAMES,
    KINDS,
    NOISE_NAMES,
    RECEIVER_NAMES,
    Prior,
)
from tvsbayes.instrument.rig import RigTable
from tvsbayes.model.parameter_space import (
    coordinates_of,
    free_mask,
    model_of,
    parameter_space,
    physical_at,
)

pytestmark = pytest.mark.usefixtures("x64")

DEG = np.pi / 180
QUANTILE_ROUNDING = 1e-10
"""Relative: JAX's ndtri against scipy's."""


ROWS = 200
"""One batch size for all tests: one compilation."""


def table(**changes: Prior) -> RigTable:
    return RigTable({"aperture_sd_deg": Prior(0.02, 0.3, "log-normal"), **changes})


@pytest.fixture(scope="module")
def physical():
    """(z (n, p), space) -> values (n, p) and the derivative of each rig value by its own coordinate (n, p)."""

    def one(z, space):
        return space.physical(z), jax.jvp(space.physical, (z,), (jnp.ones_like(z),))[1]

    compiled = jax.jit(jax.vmap(one, in_axes=(0, None)))

    def run(z, space):
        padded = np.zeros((ROWS, len(TWO_MIRROR.names)))
        padded[: len(z)] = z
        with jax.enable_x64(True):
            space = jax.tree.map(jnp.asarray, space)
            return [np.asarray(x)[: len(z)] for x in compiled(jnp.asarray(padded), space)]

    return run


def test_physical_values_are_scipys_quantiles(physical):
    """Coordinate z is the prior's quantile at Phi(z), for every kind, out to twelve standard deviations."""
    z = np.linspace(-12.0, 12.0, 97)
    space = parameter_space(table(), small_stereo())
    values, slopes = physical(np.tile(z[:, None], (1, len(TWO_MIRROR.names))), space)
    assert np.isfinite(values).all() and np.isfinite(slopes).all()
    kinds = set()
    for index, name in enumerate(TWO_MIRROR.rig_names):
        prior = table().priors[name]
        kinds.add(prior.distribution)
        if prior.distribution == "half-normal":
            expected = prior.u * stats.halfnorm.isf(stats.norm.sf(z))
            # Below -8 the quantile drowns in the rounding of Phi: 1e-15 of the scale.
            np.testing.assert_allclose(values[:, index], expected, rtol=QUANTILE_ROUNDING, atol=1e-14 * prior.u)
            assert np.all(values[:, index] >= 0) and np.all(slopes[:, index] >= 0)
        elif prior.distribution == "log-normal":
            expected = prior.value * np.exp(prior.u * z)
            np.testing.assert_allclose(values[:, index], expected, rtol=QUANTILE_ROUNDING)
        else:
            expected = prior.value + prior.u * z
            np.testing.assert_allclose(values[:, index], expected, rtol=QUANTILE_ROUNDING, atol=1e-15 * prior.u)
    assert kinds == set(KINDS)


def test_a_stray_coordinate_of_a_half_normal_is_still_a_number(physical):
    """A diverging fit may try values outside every prior; Phi(-40) underflows, and infinities reach the gradient."""
    z = np.zeros((3, len(TWO_MIRROR.names)))
    z[:, TWO_MIRROR.index["backlash_deg.pan"]] = [35.0, 40.0, 1e3]
    values = physical(z, parameter_space(table(), small_stereo()))[0][:, TWO_MIRROR.index["backlash_deg.pan"]]
    assert np.all(np.isfinite(values)) and values[1] == values[2] > values[0] > 17.0


def test_u_zero_fixes_every_kind(physical):
    fixed = {name: replace(prior, u=0.0) for name, prior in table().priors.items()}
    stereo = replace(small_stereo(), parameter_covariance=np.zeros((24, 24)))
    space = parameter_space(RigTable(fixed), stereo)
    values, slopes = physical(np.linspace(-12, 12, 9)[:, None] * np.ones(len(TWO_MIRROR.names)), space)
    expected = np.array([*(fixed[name].value for name in TWO_MIRROR.rig_names), *stereo.vector])
    np.testing.assert_allclose(values, np.broadcast_to(expected, values.shape), rtol=0, atol=1e-12)
    assert np.all(slopes == 0)
    assert not free_mask(space, has_aperture=True).any()


def test_free_parameters():
    """Those with u > 0; the receiver's only with readings; zero rows of the stereo covariance never."""
    space = parameter_space(table(), small_stereo())
    unstated = {name for name in GEAR_ERROR_NAMES if TWO_MIRROR.priors[name].u == 0 or name in AMPLITUDE_NAMES}
    fixed = {"stereo.left.k3", "stereo.right.k3", *HARMONIC_NAMES, *unstated}
    for has_aperture in (True, False):
        free = {name for name, yes in zip(TWO_MIRROR.names, free_mask(space, has_aperture), strict=True) if yes}
        assert set(TWO_MIRROR.names) - free == fixed | (set() if has_aperture else set(RECEIVER_NAMES))
    assert set(NOISE_NAMES) <= set(TWO_MIRROR.rig_names)


def test_stereo_root_squares_to_the_covariance():
    """In units of the standard deviations, which span five orders of magnitude; zero rows stay zero."""
    covariance = small_stereo().parameter_covariance
    space = parameter_space(table(), small_stereo())
    sd = np.sqrt(np.diag(covariance))
    scale = np.where(sd > 0, sd, 1.0)
    error = (space.stereo_root @ space.stereo_root.T - covariance) / np.outer(scale, scale)
    assert np.abs(error).max() < 1e-13  # 24 products of order one
    fixed = sd == 0
    assert fixed.sum() == 2
    assert np.all(space.stereo_root[fixed] == 0)
    np.testing.assert_allclose(space.stereo_mean, small_stereo().vector, rtol=0, atol=1e-12)


# Where each name must arrive: path in Model, index there, contract unit -> model unit. Written out by hand.
FIELDS: dict[str, tuple[str, tuple[int, ...], float]] = {
    "degrees_per_step.pan": ("transmission.ratio_rad_per_step", (0,), DEG),
    "degrees_per_step.tilt": ("transmission.ratio_rad_per_step", (1,), DEG),
    "ratio_contrast_deg_per_step.pan": ("transmission.contrast_rad_per_step", (0,), DEG),
    "ratio_contrast_deg_per_step.tilt": ("transmission.contrast_rad_per_step", (1,), DEG),
    "backlash_deg.pan": ("transmission.backlash_rad", (0,), DEG),
    "backlash_deg.tilt": ("transmission.backlash_rad", (1,), DEG),
    "tilt_zero_deg": ("tilt_zero_rad", (), DEG),
    "mirror_offset_mm": ("optics.mirror_offset_mm", (), 1.0),
    "mirror1_error_deg": ("optics.mirror1_error_rad", (), DEG),
    "mirror2_error_deg": ("optics.mirror2_error_rad", (), DEG),
    "laser_tilt_deg.x": ("optics.laser_tilt_rad", (0,), DEG),
    "laser_tilt_deg.y": ("optics.laser_tilt_rad", (1,), DEG),
    "laser_offset_mm.x": ("optics.laser_offset_mm", (0,), 1.0),
    "laser_offset_mm.y": ("optics.laser_offset_mm", (1,), 1.0),
    "tilt_axis_skew_deg": ("optics.tilt_axis_skew_rad", (), DEG),
    "tilt_axis_offset_mm.x": ("optics.tilt_axis_offset_mm", (0,), 1.0),
    "tilt_axis_offset_mm.z": ("optics.tilt_axis_offset_mm", (1,), 1.0),
    **{f"extrinsics.rotation_rad.{a}": ("extrinsics.rotation_rad", (i,), 1.0) for i, a in enumerate("xyz")},
    **{f"extrinsics.translation_mm.{a}": ("extrinsics.translation_mm", (i,), 1.0) for i, a in enumerate("xyz")},
    "stop_sd_deg.left": ("noise.stop_sd_rad", (0, 1), DEG),
    "stop_sd_deg.right": ("noise.stop_sd_rad", (0, 0), DEG),
    "stop_sd_deg.up": ("noise.stop_sd_rad", (1, 1), DEG),
    "stop_sd_deg.down": ("noise.stop_sd_rad", (1, 0), DEG),
    **{f"look_scatter_deg.{axis}": ("noise.look_scatter_rad", (i,), DEG) for i, axis in enumerate(("pan", "tilt"))},
    **{
        f"{block}.{axis}": (f"transmission.zero_shift.{field}", (i,), DEG)
        for i, axis in enumerate(("pan", "tilt"))
        for block, field in (("creep_deg", "creep_rad"), ("thermal_deg_per_K", "thermal_rad_per_K"))
    },
    **{f"home_sd_deg.{axis}": ("noise.home_sd_rad", (i,), DEG) for i, axis in enumerate(("pan", "tilt"))},
    "creep_minutes": ("transmission.zero_shift.creep_minutes", (), 1.0),
    "pixel_scale": ("noise.pixel_scale", (), 1.0),
    "focal_scale": ("cameras.focal_scale", (), 1.0),
    "baseline_mm": ("receiver.baseline_mm", (), 1.0),
    "pan_zero_emission_deg": ("receiver.pan_zero_emission_rad", (), DEG),
    "aperture_zero_deg": ("receiver.aperture_zero_rad", (), DEG),
    "aperture_sd_deg": ("receiver.aperture_sd_rad", (), DEG),
    **{
        f"stereo.{side}.{name}": (f"cameras.{field}", (camera, column), 1.0)
        for camera, side in enumerate(("left", "right"))
        for field, names in (
            ("focal_px", ("fx", "fy")),
            ("centre_px", ("cx", "cy")),
            ("radial", ("k1", "k2", "k3")),
            ("tangential", ("p1", "p2")),
        )
        for column, name in enumerate(names)
    },
    **{
        f"harmonic_deg.{axis}.{order}.{part}": ("transmission.harmonics.amplitude_rad", (i, order - 1, j), DEG)
        for i, axis in enumerate(("pan", "tilt"))
        for order in (1, 2)
        for j, part in enumerate(("cos", "sin"))
    },
    **{
        f"{name}.{axis}": (f"gears.{field}", (i,), DEG)
        for name, field in (
            ("transmission_error_deg", "error_rad"),
            ("transmission_error_length_deg", "length_rad"),
            ("play_variation_deg", "play_rad"),
            ("drift_deg_per_root_hour", "drift_rad_per_root_hour"),
        )
        for i, axis in enumerate(("pan", "tilt"))
    },
    **{
        f"harmonic_amplitude_deg.{axis}.{number}": ("gears.amplitude_rad", (i, number - 1), DEG)
        for i, axis in enumerate(("pan", "tilt"))
        for number in (1, 2, 3)
    },
    **{f"stereo.rotation_rad.{a}": ("cameras.rotation_rad", (i,), 1.0) for i, a in enumerate("xyz")},
    **{f"stereo.translation_mm.{a}": ("cameras.translation_mm", (i,), 1.0) for i, a in enumerate("xyz")},
}


def leaves(model) -> dict[str, np.ndarray]:
    """Every array of a Model by its dotted path."""
    flat = jax.tree_util.tree_flatten_with_path(model)[0]
    return {"".join(map(str, path)).lstrip("."): np.asarray(leaf) for path, leaf in flat}


def test_every_name_drives_its_field_and_nothing_else():
    assert set(FIELDS) == set(TWO_MIRROR.names)
    base = 10.0 + np.arange(len(TWO_MIRROR.names))
    rows = np.vstack([base, base + np.eye(len(TWO_MIRROR.names))])
    models = leaves(eqx.filter_jit(jax.vmap(model_of))(jnp.asarray(rows)))
    for known in ("transmission.harmonics.period_rad", "transmission.harmonics.on_wheel", "gears.period_rad"):
        models.pop(known)
    assert sum(leaf[0].size for leaf in models.values()) == len(TWO_MIRROR.names)
    for row, name in enumerate(TWO_MIRROR.names, start=1):
        path, index, unit = FIELDS[name]
        for field, values in models.items():
            change = values[row] - values[0]
            expected = np.zeros_like(change)
            if field == path:
                expected[index] = unit
                assert values[0][index] == pytest.approx(base[row - 1] * unit, rel=1e-15)
            np.testing.assert_allclose(change, expected, atol=1e-13, err_msg=f"{name} -> {field}")


modelled = jax.jit(lambda space: space.model(jnp.zeros(len(TWO_MIRROR.names))))
"""At the middle of all priors, compiled once."""


@pytest.mark.parametrize(
    ("stated", "period_deg", "on_wheel"),
    [
        ({}, [360.0, 360.0], [True, True]),
        ({"tilt": (22.5,)}, [360.0, 22.5], [True, False]),
        ({"pan": (12.0, 0.5), "tilt": (360.0, 12.0)}, [12.0, 360.0], [False, True]),
    ],
)
def test_a_full_turn_is_the_wheels_period_and_less_the_pinions(stated, period_deg, on_wheel):
    space = parameter_space(RigTable(harmonic_period_deg=stated), small_stereo())
    model = modelled(jax.tree.map(jnp.asarray, space))
    harmonics, periods = model.transmission.harmonics, model.gears.period_rad
    np.testing.assert_allclose(harmonics.period_rad, np.radians(period_deg), rtol=1e-15)
    # Those of amplitudes: as many as are stated, in their order.
    for axis, name in enumerate(("pan", "tilt")):
        degrees = stated.get(name, ())
        np.testing.assert_allclose(periods[axis, : len(degrees)], np.radians(degrees), rtol=1e-15)
    assert harmonics.on_wheel.tolist() == on_wheel


def test_coordinates_are_the_inverse(physical):
    """Out to five standard deviations, for every kind, and where a prior fixes a value."""
    z = np.random.default_rng(3).uniform(-5.0, 5.0, (200, len(TWO_MIRROR.names)))
    space = parameter_space(table(), small_stereo())
    values, _ = physical(z, space)
    back = coordinates_of(space, values)
    fixed = np.concatenate([np.asarray(space.u) == 0, np.zeros(24, dtype=bool)])
    assert np.all(back[:, fixed] == 0)
    # A large half-normal is the tail of a probability near 0, a small one near 1: rounding 1e-16 / phi(5).
    rig = ~fixed[: len(TWO_MIRROR.rig_names)]
    np.testing.assert_allclose(
        back[:, : len(TWO_MIRROR.rig_names)][:, rig], z[:, : len(TWO_MIRROR.rig_names)][:, rig], atol=1e-9
    )
    again, _ = physical(back, space)
    np.testing.assert_allclose(again, values, rtol=1e-10, atol=1e-9)
    np.testing.assert_allclose(coordinates_of(space, values[3]), back[3], rtol=1e-12, atol=1e-12)


def test_the_spread_of_a_half_normal_is_that_of_its_draws():
    """Against draws: 40000 determine an sd to 0.4 %, three times that is allowed; far from zero the slope is enough."""
    draws = np.random.default_rng(5).standard_normal(40_000)
    for mean, sd in ((-2.0, 1.0), (0.0, 0.5), (1.0, 0.1)):
        values = stats.halfnorm.isf(stats.norm.sf(mean + sd * draws))
        assert half_normal_sd(mean, sd) == pytest.approx(values.std(), rel=0.012)
    assert half_normal_sd(6.0, 0.01) == pytest.approx(0.01, rel=0.02)


def test_one_point_in_numpy_is_that_of_jax(physical):
    """Values and slopes of every kind of prior, in the bulk, in the tails and beyond the range of a half-normal."""
    space = parameter_space(table(), small_stereo())
    rng = np.random.default_rng(6)
    for scale in (1.0, 4.0, 60.0):
        z = scale * rng.standard_normal(len(TWO_MIRROR.names))
        point, (values, slopes) = physical_at(z, space), physical(z[None], space)
        # The tails of both inverses of Phi agree to some hundred roundings.
        np.testing.assert_allclose(point.value, values[0], rtol=1e-12, atol=1e-300)
        # Along all coordinates at once: those of the rig have their own alone, the root of the cameras is tested above.
        np.testing.assert_allclose(point.slope.sum(axis=1), slopes[0], rtol=1e-11, atol=1e-300)
        rig = point.slope[: len(TWO_MIRROR.rig_names)]
        np.testing.assert_array_equal(rig, np.eye(*rig.shape) * rig)
