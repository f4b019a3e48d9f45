"""The likelihood against dense Gaussians, numerical integration and finite differences (formulation 4.1)."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.dense_likelihood import dense_log_density

from experiments.common.jax_density import log_density, without_padding
from tvsbayes.estimators import likelihood as density
from tvsbayes.estimators.campaign_arrays import campaign_arrays, spot_constants
from tvsbayes.estimators.likelihood import no_draw
from tvsbayes.estimators.mode_search import Problem
from tvsbayes.gears.priors import half_normal_coordinate
from tvsbayes.instrument.campaign import ordered_spots
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.parameters import HOME_SD_NAMES, LOOK_SCATTER_NAMES
from tvsbayes.instrument.stereo_pair import rotation_matrix
from tvsbayes.model.compiled import BATCH
from tvsbayes.model.parameter_space import parameter_space
from tvsbayes.twin.physics import aperture_angle_deg, mirror_chain, project, to_tvs

pytestmark = pytest.mark.usefixtures("x64")

LOG_UNIT = 1.0
"""One unit of log density; exact algebra on a dozen spots leaves 1e-8 of it."""
FINE_UNIT = 1e-8 * LOG_UNIT
value_and_gradient = jax.jit(jax.value_and_grad(log_density))


def random_points(dozen, count: int, scale: float) -> np.ndarray:
    """Coordinates about the true rig; `scale` in prior standard deviations."""
    return dozen.z + scale * np.random.default_rng(31).standard_normal((count, len(TWO_MIRROR.names)))


def astray(dozen) -> np.ndarray:
    """The true rig seen through extrinsics that are off by 0.3 rad and 60 mm in prior units of 0.03 and 5."""
    z = dozen.z.copy()
    for name, offset in (("rotation_rad.x", 10), ("rotation_rad.z", -10), ("translation_mm.y", 12)):
        z[TWO_MIRROR.index[f"extrinsics.{name}"]] += offset
    return z


@pytest.mark.parametrize("offset_sds", [0.0, 0.3, 1.0])
def test_filter_equals_dense_gaussian(dozen, evaluate, offset_sds):
    z = random_points(dozen, 1, offset_sds)[0]
    evaluated = evaluate(z, dozen.space, dozen.arrays)
    dense = dense_log_density(dozen.campaign, evaluated)
    # Rounding of a chi2 of 1e6 at one prior sd is 1e-10 per operation.
    assert evaluated.log_likelihood == pytest.approx(dense, abs=FINE_UNIT, rel=1e-12)


@pytest.mark.parametrize(
    "homings",
    [
        (("pan",), ()),
        (("pan", "tilt"), ()),
        ((), (1.5, -4.0)),
        (("tilt",), (-4.0, 0.0)),
    ],
)
def test_homings_shift_the_zeros_by_their_scatter(dozen, evaluate, homings):
    """None sets that of an absolute encoder, which walks on; play, stops and the other axis are as they were."""
    absolute, coordinates = homings
    campaign = replace(dozen.campaign, rig=replace(dozen.campaign.rig, absolute=absolute))
    arrays, z = jax.tree.map(jnp.asarray, campaign_arrays(campaign)), random_points(dozen, 1, 0.3)[0]
    if coordinates:
        z[[TWO_MIRROR.index[name] for name in HOME_SD_NAMES]] = coordinates
    evaluated = evaluate(z, dozen.space, arrays)
    dense = dense_log_density(campaign, evaluated)
    assert evaluated.log_likelihood == pytest.approx(dense, abs=FINE_UNIT, rel=1e-12)
    z[[TWO_MIRROR.index[name] for name in HOME_SD_NAMES]] = 0.0
    plain = evaluate(z, dozen.space, dozen.arrays).log_likelihood
    assert abs(plain - dense) > LOG_UNIT, "it changes nothing here"


@pytest.mark.parametrize("coordinates", [(1.0, -0.5), (3.0, -8.0), (-8.0, 6.0)])
def test_looks_that_scatter_equal_a_dense_gaussian(dozen, evaluate, coordinates):
    """Of either axis, of both, and of one alone."""
    z = random_points(dozen, 1, 0.3)[0]
    z[[TWO_MIRROR.index[name] for name in LOOK_SCATTER_NAMES]] = coordinates
    evaluated = evaluate(z, dozen.space, dozen.arrays)
    dense = dense_log_density(dozen.campaign, evaluated)
    assert evaluated.log_likelihood == pytest.approx(dense, abs=FINE_UNIT, rel=1e-12)
    without = evaluate(np.where(np.isin(TWO_MIRROR.names, LOOK_SCATTER_NAMES), -36.0, z), dozen.space, dozen.arrays)
    assert abs(without.log_likelihood - dense) > LOG_UNIT, "scatter changes nothing here"


def test_of_stops_looked_at_once_the_sum_of_both_scatters_is_known(dozen, evaluate):
    """Every look with a stop error of its own: only the sum of the variances acts, however it is shared out."""
    shape = dozen.arrays.spots.redraw.shape
    once = eqx.tree_at(
        lambda a: (a.spots.redraw, a.spots.redraw_mix),
        dozen.arrays,
        (np.ones(shape, bool), np.full((*shape, 2), 0.5)),
    )
    index, stops = (
        [TWO_MIRROR.index[name] for name in LOOK_SCATTER_NAMES],
        [TWO_MIRROR.index[n] for n in TWO_MIRROR.names if n.startswith("stop_sd")],
    )
    logs = []
    for scatter_deg in (1e-9, 0.005, 0.02):
        z = dozen.z.copy()
        z[index] = half_normal_coordinate(np.full(2, scatter_deg / 0.01))
        left = np.sqrt(0.03**2 - scatter_deg**2)
        z[stops] = np.log(left / dozen.space.value[jnp.array(stops)]) / dozen.space.u[jnp.array(stops)]
        logs.append(evaluate(z, dozen.space, once).log_likelihood)
    assert logs[1:] == pytest.approx(logs[:1] * 2, abs=FINE_UNIT, rel=1e-12)
    shared = evaluate(z, dozen.space, dozen.arrays).log_likelihood
    assert abs(shared - logs[0]) > LOG_UNIT, "with stops looked at twice the shares are known"


def test_blocks_of_spots_are_one_campaign(dozen, evaluate, monkeypatch):
    """Stop errors, homings and play of the dozen last from one block of four to the next.

    Twenty do not divide the padded number: four do. Another padded number is compiled again.
    """
    whole = evaluate(dozen.z, dozen.space, dozen.arrays).log_likelihood
    monkeypatch.setattr(density, "BLOCK", 20)
    # Run once: optimising it takes longer.
    monkeypatch.setattr(jax, "jit", partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0}))
    arrays = dozen.arrays.of_spots(0, 484)
    cut = density.evaluate(dozen.z[None], no_draw(1, arrays), dozen.space, arrays).log_density[0]
    assert cut + 0.5 * dozen.z @ dozen.z == pytest.approx(whole, abs=FINE_UNIT, rel=1e-12)


@pytest.mark.thorough
def test_padding_changes_nothing(grid_campaign, monkeypatch):
    """Against the length that users have."""
    space = parameter_space(grid_campaign.rig, grid_campaign.stereo)
    short = campaign_arrays(grid_campaign)
    monkeypatch.setattr("tvsbayes.estimators.campaign_arrays.SMALLEST_BUCKET", 4096)
    long = campaign_arrays(grid_campaign)
    assert long.spots.pixels.shape == (4096, 4) and short.spots.pixels.shape == (512, 4)
    z = np.repeat(0.3 * np.random.default_rng(31).standard_normal((1, len(TWO_MIRROR.names))), BATCH, axis=0)
    one, two = (density.evaluate(z, no_draw(BATCH, arrays), space, arrays) for arrays in (short, long))
    assert two.log_density[0] == pytest.approx(float(one.log_density[0]), abs=FINE_UNIT, rel=1e-12)
    assert short.gears.filled and long.gears.filled == short.gears.filled
    np.testing.assert_allclose(two.place_errors_rad, one.place_errors_rad, atol=FINE_UNIT * 1e-3)
    moves = len(grid_campaign.moves)
    assert np.all(long.moves.steps[moves:] == long.moves.steps[moves - 1])


def test_order_of_rows_is_irrelevant(dozen):
    """spots.csv may list its rows in any order; what is not ok is not read."""
    spots = list(dozen.campaign.spots)
    np.random.default_rng(3).shuffle(spots)
    refused = replace(spots[0], spot=999, status="saturated", u_left_px=-1e6, v_right_px=None)
    shuffled = campaign_arrays(replace(dozen.campaign, spots=(refused, *spots)))
    for one, two in zip(jax.tree.leaves(dozen.arrays), jax.tree.leaves(shuffled), strict=True):
        np.testing.assert_array_equal(one, two)


def test_excluded_spot_leaves_no_trace(dozen, evaluate):
    """`valid` 0 equals a campaign without the spot (one that is not the first of its stop)."""
    spots = ordered_spots(dozen.campaign)
    row = next(i for i in range(1, len(spots)) if spots[i].move == spots[i - 1].move)
    arrays = eqx.tree_at(lambda a: a.spots.valid, dozen.arrays, dozen.arrays.spots.valid.at[row].set(0.0))
    kept = tuple(s for s in dozen.campaign.spots if s.spot != spots[row].spot)
    without = jax.tree.map(jnp.asarray, campaign_arrays(replace(dozen.campaign, spots=kept)))
    one, two = (evaluate(dozen.z, dozen.space, a).log_likelihood for a in (arrays, without))
    assert one == pytest.approx(two, abs=FINE_UNIT)


def central_gradient(function, z: np.ndarray, step: float) -> np.ndarray:
    """Fourth-order central differences, of a function of many points."""
    near, far = (function(z + m * step * np.eye(z.size)) - function(z - m * step * np.eye(z.size)) for m in (1, 2))
    return (8 * near - far) / (12 * step)


@pytest.mark.slow
@pytest.mark.parametrize("where", ["0.5 sd away", "prior mean", "astray"])
def test_density_with_gradient_against_the_librarys_and_its_differences(dozen, where):
    """What experiments differentiate is the density that fits and samplers evaluate."""
    z = {
        "0.5 sd away": random_points(dozen, 1, 0.5)[0],
        "prior mean": np.zeros(len(TWO_MIRROR.names)),
        "astray": astray(dozen),
    }[where]
    arrays = without_padding(dozen.arrays, len(dozen.campaign.moves))
    value, gradient = value_and_gradient(jnp.asarray(z), dozen.space, arrays)

    def librarys(points):
        return density.evaluate(points, no_draw(len(points), dozen.arrays), dozen.space, dozen.arrays).log_density

    assert float(value) == pytest.approx(librarys(z[None])[0], abs=FINE_UNIT, rel=1e-12)
    differences = central_gradient(librarys, z, 1e-3)
    # Truncation (1e-3 prior sds)^4, rounding 1e-16 x density / 1e-3: 1e-6 of the steepest coordinate.
    assert np.abs(gradient - differences).max() < 1e-6 * np.abs(gradient).max()


@pytest.fixture(scope="module")
def far_out():
    """Three prior standard deviations in every coordinate at once: behind the cameras, off the image."""
    return 3.0 * np.random.default_rng(41).standard_normal((100, len(TWO_MIRROR.names)))


def test_density_is_finite_everywhere(dozen, far_out):
    values = density.evaluate(far_out, no_draw(len(far_out), dozen.arrays), dozen.space, dozen.arrays)
    assert np.all(np.isfinite(values.log_density))


@pytest.mark.slow
def test_gradient_is_finite_everywhere(dozen, far_out):
    arrays = without_padding(dozen.arrays, len(dozen.campaign.moves))
    for z in far_out:
        value, gradient = value_and_gradient(jnp.asarray(z), dozen.space, arrays)
        assert np.isfinite(float(value)) and np.all(np.isfinite(gradient))


def stated_covariance(spot) -> np.ndarray:
    """Covariance of the four pixels, px^2, from standard deviations and the correlation within each image."""
    sds = np.array([spot.su_left_px, spot.sv_left_px, spot.su_right_px, spot.sv_right_px])
    left, right = spot.ruv_left, spot.ruv_right
    return np.outer(sds, sds) * [[1, left, 0, 0], [left, 1, 0, 0], [0, 0, 1, right], [0, 0, right, 1]]


def integrated_over_range(dozen, evaluated, triangulated_mm: np.ndarray, spot) -> float:
    """Log density of one spot's observation by quadrature over its range, through the twin's own optics.

    The measure is the arc length of the image displacement in stated standard deviations.
    """
    truth = dozen.truth.parameters
    psi, beta = evaluated.angles.angle_rad[spot.move]
    origin, direction = mirror_chain(psi, beta, truth)
    rotation = rotation_matrix(np.array([truth[f"extrinsics.rotation_rad.{a}"] for a in "xyz"]))
    translation = np.array([truth[f"extrinsics.translation_mm.{a}"] for a in "xyz"])
    nearest = rotation.T @ (triangulated_mm - translation) - origin
    # Disparity moves by 0.4 px/mm at 375 mm, 80 mm from camera to beam: 10 mm is 20 sds of range.
    ranges = nearest @ direction + np.linspace(-10.0, 10.0, 8001)
    points_p = origin + ranges[:, None] * direction
    pixels = project(points_p @ rotation.T + translation, dozen.truth.stereo, truth["focal_scale"])
    observed = np.array([spot.u_left_px, spot.v_left_px, spot.u_right_px, spot.v_right_px])
    covariance = stated_covariance(spot)
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))
    s = truth["pixel_scale"]
    exponent = -0.5 * np.sum(((observed - pixels) @ whitening.T / s) ** 2, axis=1)
    constant = -2 * np.log(2 * np.pi) - 4 * np.log(s) - 0.5 * np.linalg.slogdet(covariance)[1]
    if spot.aperture_deg is not None:
        sd = np.radians(truth["aperture_sd_deg"])
        points_t = to_tvs(points_p, truth["baseline_mm"], truth["pan_zero_emission_deg"])
        angle = aperture_angle_deg(points_t, truth["baseline_mm"], dozen.campaign.rig.aperture_convention)
        misfit = np.radians(spot.aperture_deg - truth["aperture_zero_deg"] - angle)
        exponent = exponent - 0.5 * (misfit / sd) ** 2
        constant -= 0.5 * np.log(2 * np.pi) + np.log(sd)
    displacement = np.linalg.norm(np.gradient(pixels @ whitening.T, ranges, axis=0), axis=1)
    peak = exponent.max()
    return float(peak + np.log(np.trapezoid(np.exp(exponent - peak) * displacement, ranges)) + constant)


def near_campaign(dozen, evaluated):
    """The dozen with every observation within a few standard deviations of the model's: stop errors left out.

    Linearisation is exact to second order in the misfit; the dozen's stop errors are up to 60 px sds.
    """
    rng = np.random.default_rng(51)
    sd_rad = np.radians(dozen.truth.parameters["aperture_sd_deg"])
    spots = []
    for row, spot in enumerate(ordered_spots(dozen.campaign)):
        predicted = evaluated.terms.predicted[row]
        pixels = predicted[:4] + np.linalg.cholesky(stated_covariance(spot)) @ rng.standard_normal(4)
        fields = dict(zip(("u_left_px", "v_left_px", "u_right_px", "v_right_px"), map(float, pixels), strict=True))
        if spot.aperture_deg is not None:
            fields["aperture_deg"] = float(np.degrees(predicted[4] + sd_rad * rng.standard_normal()))
        spots.append(replace(spot, **fields))
    return replace(dozen.campaign, spots=tuple(spots))


def test_range_is_flat_in_image_displacement(dozen, evaluate):
    """Each spot alone, with and without aperture reading, against quadrature over its range."""
    campaign = near_campaign(dozen, evaluate(dozen.z, dozen.space, dozen.arrays))
    arrays = jax.tree.map(jnp.asarray, campaign_arrays(campaign))
    evaluated = evaluate(dozen.z, dozen.space, arrays)
    total, kinds = 0.0, set()
    for row, spot in enumerate(ordered_spots(campaign)):
        terms = evaluated.terms
        alone = spot_constants(replace(campaign, spots=(spot,))).sum()
        analytic = terms.log_scale[row] - 0.5 * np.sum(terms.residual[row] ** 2) + alone
        exact = integrated_over_range(dozen, evaluated, np.asarray(arrays.spots.triangulated_mm[row]), spot)
        kinds.add(spot.aperture_deg is None)
        # One level of derivatives: over a few range sds (0.3 mm of 200 mm) the image bends by 1e-3 sd.
        assert analytic == pytest.approx(exact, abs=5e-3 * LOG_UNIT), f"spot {spot.spot}"
        total += alone
    assert kinds == {True, False}
    assert total == pytest.approx(spot_constants(campaign).sum(), abs=FINE_UNIT)


def test_angles_are_compared_on_the_circle(dozen, evaluate):
    """A reading of B + 360 deg is the same reading."""
    turned = eqx.tree_at(lambda a: a.spots.aperture_rad, dozen.arrays, dozen.arrays.spots.aperture_rad + 2 * np.pi)
    one, two = (evaluate(dozen.z, dozen.space, a).log_likelihood for a in (dozen.arrays, turned))
    # 2 pi adds rounding of 1e-15 rad to a reading with an sd of 3e-4 rad.
    assert one == pytest.approx(two, abs=10 * FINE_UNIT)


def test_the_scatter_of_homings_is_estimated_where_several_were_seen(dozen):
    """Of one segment it stays at its median, of an absolute encoder at none."""
    campaign, columns = dozen.campaign, [TWO_MIRROR.index[name] for name in HOME_SD_NAMES]
    first, *others = (replace(move, segment=0) for move in campaign.moves)
    once = first, *(replace(move, pan_approach="", tilt_approach="") for move in others)
    for given, expected in (
        (campaign, [True, True]),
        (replace(campaign, moves=once), [False, False]),
        (replace(campaign, rig=replace(campaign.rig, absolute=("tilt",))), [True, False]),
    ):
        assert Problem(given, given.rig).free[columns].tolist() == expected
