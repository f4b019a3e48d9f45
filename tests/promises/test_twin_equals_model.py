"""The digital twin (NumPy, own formulas) and the estimators' model (JAX) are the same physics.

A hundred true rigs drawn from all priors of the shipped mounted rig, with transmission errors.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tvsbayes.estimators.annealed_stage import Fixed, linear_campaign
from tvsbayes.estimators.campaign_arrays import campaign_arrays
from tvsbayes.estimators.looks import aperture_angle
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.mirrors import Vectors
from tvsbayes.instrument.parameters import HARMONIC_NAMES, Prior, names_of
from tvsbayes.instrument.places import line_share, seen_places
from tvsbayes.instrument.protocols import grid_protocol
from tvsbayes.model.gear_processes import Places
from tvsbayes.model.geometry import project
from tvsbayes.model.headlines import SeenLine, derived_quantities
from tvsbayes.model.headlines import effective_deg_per_step as effective_of_model
from tvsbayes.model.laser_path import MoveArrays, beam_angles, mirror_angles, trace
from tvsbayes.model.parameter_space import coordinates_of, model_of, parameter_space
from tvsbayes.twin import physics
from tvsbayes.twin.gear_errors import zero_shift_deg
from tvsbayes.twin.physics import (
    aperture_angle_deg,
    beam_jacobian,
    effective_mirror_offset_mm,
    harmonics_deg,
    local_deg_per_step,
    mirror_chain,
    to_tvs,
    transmission,
)
from tvsbayes.twin.simulated_campaign import simulate
from tvsbayes.twin.true_rig import draw_truth

pytestmark = pytest.mark.usefixtures("x64")

RIGS, POSES, MOVES = 100, 8, 40
LENGTH_MM = 1e-9
"""1e-12 of a metre, a thousand times rounding."""
PIXEL_PX = 1e-9
GEAR_ERRORS = "transmission_error_deg", "play_variation_deg"
ANGLE_RAD = LENGTH_MM / 1000.0
"""What moves a spot at 1 m by that length."""


@pytest.fixture(scope="module")
def truths(mounted_rig):
    rng = np.random.default_rng(77)
    large = dict.fromkeys((*HARMONIC_NAMES, *names_of("creep_deg")), Prior(0.0, 0.1))
    wobbling = replace(mounted_rig, truth={**mounted_rig.truth, **large})
    return [draw_truth(wobbling, rng) for _ in range(RIGS)]


@pytest.fixture(scope="module")
def values(truths) -> np.ndarray:
    """(rigs, 65) in the units of NAMES."""
    return np.array([[*(t.parameters[n] for n in TWO_MIRROR.rig_names), *t.stereo.vector] for t in truths])


@pytest.fixture(scope="module")
def poses_rad() -> np.ndarray:
    """(rigs, poses, 2): pan and tilt over the whole field."""
    return np.radians(np.random.default_rng(78).uniform([-40.0, -25.0], [40.0, 25.0], (RIGS, POSES, 2)))


def batched(function, *arrays):
    """Compile and map over the rigs, in float64."""
    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, jax.jit(jax.vmap(function))(*map(jnp.asarray, arrays)))


def test_mirror_chain(truths, values, poses_rad):
    rays = batched(lambda v, p: trace(model_of(v).optics, p[:, 0], p[:, 1]), values, poses_rad)
    for rig, truth in enumerate(truths):
        origin, direction = mirror_chain(*poses_rad[rig].T, truth.parameters)
        for vector, expected, tolerance in (
            (rays.origin_mm, origin, LENGTH_MM),
            (rays.direction, direction, ANGLE_RAD),
        ):
            array = np.stack([vector.x[rig], vector.y[rig], vector.z[rig]], axis=1)
            assert np.abs(array - expected).max() < tolerance


def test_cameras(truths, values):
    """Random points of the sheets' volume; the twin sees all of them that stand in both images."""
    points = np.random.default_rng(79).uniform([160.0, -60.0, -50.0], [400.0, 40.0, 50.0], (RIGS, 20, 3))
    pixels = batched(lambda v, p: project(model_of(v).cameras, p.T).T, values, points)
    count = 0
    for rig, truth in enumerate(truths):
        expected = physics.project(points[rig], truth.stereo, truth.parameters["focal_scale"])
        in_view = np.isfinite(expected).all(axis=1)
        assert np.abs(pixels[rig] - expected)[in_view].max() < PIXEL_PX
        count += in_view.sum()
    assert count > 0.9 * RIGS * 20


@pytest.mark.parametrize("period_deg", [(30.0, 360.0), (360.0, 12.5)])
def test_gears_and_play(truths, values, period_deg):
    """Random moves in two segments, known approaches, the pinion's error on one axis and the wheel's on the other.

    The twin's home offset is the filter's, not the model's.
    """
    rng = np.random.default_rng(80)
    jumps = rng.choice([-200, -60, -3, -1, 0, 1, 2, 7, 100, 200], (RIGS, MOVES, 2))
    counters = np.cumsum(jumps, axis=1).astype(float)
    first = np.zeros((RIGS, MOVES), bool)
    first[:, [0, MOVES // 2]] = True
    approach = np.where(first[..., None], rng.choice([-1.0, 1.0], (RIGS, MOVES, 2)), 0.0)

    def angles(v, steps, first, approach):
        model = model_of(v, np.tile(np.array(period_deg)[:, None], 3))
        return mirror_angles(model.transmission, model.tilt_zero_rad, MoveArrays(steps, first, approach))

    result = batched(angles, values, counters, first, approach)
    assert np.all(result.play_sd_rad == 0)
    for rig, truth in enumerate(truths):
        p = truth.parameters
        for axis, name in enumerate(("pan", "tilt")):
            ratios = p[f"degrees_per_step.{name}"], p[f"ratio_contrast_deg_per_step.{name}"]
            start = -0.5 * approach[rig, :, axis]
            args = counters[rig, :, axis], first[rig], start, np.zeros(MOVES), ratios, p[f"backlash_deg.{name}"]
            wobble = harmonics_deg(p, name), period_deg[axis]
            expected = np.radians(transmission(*args, *wobble) + (p["tilt_zero_deg"] if axis else 0.0))
            assert np.abs(result.angle_rad[rig, :, axis] - expected).max() < ANGLE_RAD


def test_zeros_in_time(truths, values):
    """Creep and temperature, at random times and temperatures."""
    rng = np.random.default_rng(83)
    minutes, kelvin = rng.uniform(0, 100, (RIGS, MOVES)), rng.uniform(-5, 5, (RIGS, MOVES))
    shifts = batched(lambda v, t, k: model_of(v).transmission.zero_shift.shift_rad(t, k), values, minutes, kelvin)
    for rig, truth in enumerate(truths):
        for axis, name in enumerate(AXES):
            expected = np.radians(zero_shift_deg(truth.parameters, name, minutes[rig], kelvin[rig]))
            assert np.abs(shifts[rig, :, axis] - expected).max() < ANGLE_RAD


@pytest.mark.parametrize("convention", ["in-plane", "azimuth"])
def test_aperture_angle(truths, values, convention):
    points = np.random.default_rng(81).uniform([150.0, -250.0, -80.0], [1000.0, 100.0, 80.0], (RIGS, 20, 3))

    def angle(v, p):
        return aperture_angle(model_of(v).receiver, Vectors.of(p.T), jnp.asarray(convention == "azimuth"))

    angles = batched(angle, values, points)
    for rig, truth in enumerate(truths):
        baseline_mm = truth.parameters["baseline_mm"]
        in_t = to_tvs(points[rig], baseline_mm, truth.parameters["pan_zero_emission_deg"])
        expected = np.radians(aperture_angle_deg(in_t, baseline_mm, convention))
        assert np.abs(angles[rig] - expected).max() < ANGLE_RAD


def test_headlines_of_a_fit(mounted_rig):
    """The headlines of a fit at any point of parameter space are the twin's for the rig of that point."""
    errors = {f"{name}.{axis}": Prior(0.0, 0.1, "half-normal") for name in GEAR_ERRORS for axis in AXES}
    rig = replace(mounted_rig, truth={**mounted_rig.truth, **errors})
    plan = grid_protocol(targets=("d1",), pan_steps=range(-60, 241, 60), tilt_steps=(-60, 0, 70))
    for seed in range(8):
        run = simulate(rig, plan, seed)
        campaign, truth, p = run.campaign, run.truth, run.truth.parameters
        at = seen_places(campaign.moves, [spot.move for spot in campaign.spots], mounted_rig.table)
        ratios = np.array([p[f"degrees_per_step.{axis}"] for axis in AXES])
        places_deg = at.steps * ratios[at.on_tilt.astype(int)]
        error_deg, play_deg = (
            np.concatenate([getattr(truth.gear_errors[a], n)(places_deg[at.on_tilt == k]) for k, a in enumerate(AXES)])
            for n in ("error_deg", "play_deg")
        )
        turned = places_deg + error_deg + np.where(at.on_tilt, p["tilt_zero_deg"], 0.0)
        pose_deg = tuple((at.error_share[:, at.on_tilt == k] @ turned[at.on_tilt == k]).mean() for k in (0, 1))
        used = np.ones(len(campaign.spots), bool)
        with jax.enable_x64(True):
            space = parameter_space(mounted_rig.table, mounted_rig.stereo)
            places = Places(*map(jnp.asarray, (at.steps, at.on_tilt, np.ones(len(at.steps), bool))))
            seen_line = SeenLine(np.radians(pose_deg), places, line_share(at, used))
            true = np.array([*(p[name] for name in TWO_MIRROR.rig_names), *truth.stereo.vector])
            # Fixed parameters have their prior value, as in the rig of the point.
            z = coordinates_of(space, true)[None]
            repeated = np.radians(np.concatenate([error_deg, play_deg]))[None]
            headlines = jax.tree.map(lambda x: np.asarray(x)[0], derived_quantities(z, repeated, space, seen_line))
        local = local_deg_per_step(p, pose_deg)
        assert np.abs(headlines.local_deg_per_step - list(local.values())).max() < 1e-9 * 0.1
        assert abs(headlines["effective_mirror_offset_mm"] - effective_mirror_offset_mm(p, pose_deg)) < LENGTH_MM
        line = np.array(list(truth.effective_deg_per_step(campaign).values()))
        pairs = headlines.effective_deg_per_step.reshape(2, 2)
        assert np.abs(pairs.mean(axis=1) - line.reshape(2, 2).mean(axis=1)).max() < 1e-9 * 0.1
        # The twin's half contrast turns the mirrors' mean slope, the model's that of the line: 2 % of one, errors being
        # 0.1 deg over some 8.
        contrast = [abs(p[f"ratio_contrast_deg_per_step.{axis}"]) for axis in AXES]
        assert np.all(np.abs(pairs - line.reshape(2, 2)) < 0.02 * 0.5 * np.array(contrast)[:, None] + 1e-9 * 0.1)


def test_headlines(truths, values, poses_rad):
    """Effective degrees per step and effective mirror offset at a pose per rig."""

    def headlines(v, pose):
        model = model_of(v)
        angles = beam_angles(model.optics, pose[0], pose[1])
        ratios = effective_of_model(model.transmission, angles)
        return ratios, angles.effective_mirror_offset_mm, angles.jacobian

    ratios, offset_mm, jacobian = batched(headlines, values, poses_rad[:, 0])
    for rig, truth in enumerate(truths):
        pose_deg = tuple(np.degrees(poses_rad[rig, 0]))
        expected = local_deg_per_step(truth.parameters, pose_deg)
        # The twin differences its own chain: 1e-9 of a slope, hence of 0.07 deg per step.
        assert np.abs(ratios[rig] - list(expected.values())).max() < 1e-9 * 0.1
        assert np.abs(jacobian[rig] - beam_jacobian(truth.parameters, pose_deg)).max() < 1e-9
        assert list(expected) == ["left", "right", "up", "down"]
        assert abs(offset_mm[rig] - effective_mirror_offset_mm(truth.parameters, pose_deg)) < LENGTH_MM


def test_errors_that_repeat_drift_and_scatter(mounted_rig):
    """Chi-square of six campaigns at their truths: repeated errors, drifting zeros, scattered looks as the twin's.

    The estimators integrate them out; without their scales chi-square is far beyond chance.
    """
    scales = {"transmission_error_deg": 0.05, "play_variation_deg": 0.05, "drift_deg_per_root_hour": 0.05}
    scales |= {"look_scatter_deg": 0.05}
    priors = {f"{name}.{axis}": Prior(0.0, u, "half-normal") for name, u in scales.items() for axis in AXES}
    priors |= {f"harmonic_amplitude_deg.{axis}.1": Prior(0.0, 0.05, "half-normal") for axis in AXES}
    priors |= {f"transmission_error_length_deg.{axis}": Prior(8.0, 0.7, "log-normal") for axis in AXES}
    table = replace(
        mounted_rig.table,
        priors={**mounted_rig.table.priors, **priors},
        harmonic_period_deg=dict.fromkeys(AXES, (36.0,)),
    )
    rig = replace(mounted_rig, table=table, truth={**table.priors})
    plan = grid_protocol(targets=("d1", "d2", "d3"))
    squares, count = [], 0
    for seed in range(6):
        run = simulate(rig, plan, seed)
        with jax.enable_x64(True):
            space, arrays = parameter_space(table, rig.stereo), campaign_arrays(run.campaign)
            true = np.array([*(run.truth.parameters[name] for name in TWO_MIRROR.rig_names), *run.truth.stereo.vector])
            z = coordinates_of(space, true)
            # With all coordinates held, the squares of a stage's residuals are the quadratic form of the campaign.
            terms = linear_campaign(z, space, arrays, Fixed(np.ones(len(z), dtype=bool), z, np.array(1.0)))
        squares.append(terms.value @ terms.value)
        # Four pixels of a spot less its range.
        count += 3 * sum(spot.status == "ok" for spot in run.campaign.spots)
    assert np.sum(squares) / count == pytest.approx(1.0, abs=4 * np.sqrt(2 / count))
