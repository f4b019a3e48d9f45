"""The chain of a pan-tilt head: to first order TPOINT's terms, in full the twin's rotation matrices."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tvsbayes.calibration.optics import beam_components
from tvsbayes.instrument.chains import HeadOptics, chain_of
from tvsbayes.instrument.mechanisms import HEAD, SIGHTING_HEAD
from tvsbayes.instrument.parameters import BLOCKS, TERMS, Prior, names_of
from tvsbayes.instrument.places import line_share, seen_places
from tvsbayes.instrument.plan import PlanBuilder
from tvsbayes.instrument.rig import Rig, RigTable
from tvsbayes.model.gear_processes import Places
from tvsbayes.model.headlines import SeenLine, line_deg_per_step
from tvsbayes.model.laser_path import beam_angles, trace
from tvsbayes.model.parameter_space import model_of
from tvsbayes.twin.physics import mirror_chain
from tvsbayes.twin.simulated_campaign import simulate
from tvsbayes.twin.true_rig import draw_truth

SMALL_RAD = np.radians(10 / 3600)
"""Ten arcseconds: its square is 5e-4 arcsec."""
AZIMUTH, ELEVATION = np.radians(np.meshgrid([-160.0, -50.0, 0.0, 35.0, 120.0], [15.0, 40.0, 65.0])).reshape(2, -1)
SQUARES = 3.0
"""Second-order terms have factors up to tan(65 deg)^2 / 2."""
POINTING = {
    "azimuth_zero_deg": lambda a, e: (1.0, 0.0),
    "azimuth_axis_tilt_deg.north": lambda a, e: (-np.sin(a) * np.tan(e), -np.cos(a)),
    "azimuth_axis_tilt_deg.east": lambda a, e: (np.cos(a) * np.tan(e), -np.sin(a)),
    "axes_not_square_deg": lambda a, e: (-np.tan(e), 0.0),
    "beam_not_square_deg": lambda a, e: (-1 / np.cos(e), 0.0),
    "flexure_deg": lambda a, e: (0.0, -np.cos(e)),
    "tangent_flexure_deg": lambda a, e: (0.0, -1 / np.tan(e)),
}
"""TPOINT's -IA, AN, -AW, NPAE, CA, TF, TX: what they add to azimuth and elevation."""
TERM_DEG = 0.3
EVERY_TERM = replace(HEAD, key="every-term", constants={})
"""A head that lacks nothing."""
ROUNDING = 1e-11
"""Of unit vectors; mm of origins are a hundred times longer."""


def optics_of(values: dict[str, float]) -> HeadOptics:
    """A head of terms in rad and mm; those that are not named are 0."""

    def block(name: str) -> float | list[float]:
        parts = [values.get(part, 0.0) for part in BLOCKS[name]]
        return parts if len(parts) > 1 else parts[0]

    return chain_of(HEAD, block)


@pytest.mark.parametrize("name", POINTING)
def test_first_order_is_tpoint(name):
    direction = optics_of({name: SMALL_RAD}).leaving(AZIMUTH, ELEVATION, np).direction
    turned = np.angle(np.exp(1j * (np.arctan2(direction.y, direction.x) - AZIMUTH)))
    raised = np.arctan2(direction.z, np.hypot(direction.x, direction.y)) - ELEVATION
    by_azimuth, by_elevation = POINTING[name](AZIMUTH, ELEVATION)
    # Near the horizon the cotangent is bounded, a change of 1e-5 at 15 deg.
    held = 2e-5 * SMALL_RAD / np.tan(ELEVATION) if name.startswith("tangent") else 0.0
    allowed = SQUARES * (SMALL_RAD / np.cos(ELEVATION)) ** 2 + held
    assert np.all(np.abs(turned - SMALL_RAD * by_azimuth) <= allowed)
    assert np.all(np.abs(raised - SMALL_RAD * by_elevation) <= allowed)


@pytest.fixture(scope="module")
def truths():
    """Heads with terms of degrees and offsets of centimetres."""
    wide = {term.name: Prior(0.0, 15.0 if term.unit == "mm" else 3.0) for term in TERMS}
    table = RigTable(mechanism=SIGHTING_HEAD)
    rig = Rig(table, None, {**table.priors, **wide}, {}, {}, {}, {})
    rng = np.random.default_rng(50)
    drawn = [draw_truth(rig, rng) for _ in range(40)]
    # The twin's cotangent is not bounded at the horizon.
    return [replace(truth, parameters={**truth.parameters, "tangent_flexure_deg": 0.0}) for truth in drawn]


@pytest.mark.usefixtures("x64")
def test_twin_and_model_are_the_same_optics(truths):
    rng = np.random.default_rng(51)
    poses = rng.uniform([-np.pi, -0.5], [np.pi, 1.7], (len(truths), 6, 2))
    values = np.array([[*(t.parameters[n] for n in EVERY_TERM.rig_names), *np.zeros(24)] for t in truths])

    def rays(v, p):
        return trace(model_of(v, mechanism=EVERY_TERM).optics, p[:, 0], p[:, 1])

    with jax.enable_x64(True):
        model_rays = jax.jit(jax.vmap(rays))(jnp.asarray(values), jnp.asarray(poses))
    for k, truth in enumerate(truths):
        expected = mirror_chain(*poses[k].T, truth.parameters)
        # The NumPy side of a robot, frame T of a head being frame P.
        robot = beam_components(truth.parameters, *np.degrees(poses[k]).T)
        for ray, beam, wanted in zip(model_rays, robot, expected, strict=True):
            assert np.abs(np.stack([x[k] for x in ray], axis=1) - wanted).max() < 100 * ROUNDING
            assert np.abs(np.stack(np.broadcast_arrays(*beam), axis=1) - wanted).max() < 100 * ROUNDING


@pytest.mark.thorough
@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("azimuth_zero_deg", [0.0, 180.0])
def test_headlines_are_continuous_around_the_circle_and_through_the_zenith(azimuth_zero_deg):
    """Pan over 300 deg, tilt from 20 to 130: model and twin have the line over all of it, that of the gears."""
    rng, plan = np.random.default_rng(52), PlanBuilder()
    plan.home()
    for pan, tilt in zip(rng.permutation(range(-3000, 3001, 600)), rng.permutation(range(400, 2601, 220)), strict=True):
        plan.move(int(pan), int(tilt))
        plan.look()
    still = names_of("transmission_error_deg", "play_variation_deg", "creep_deg")
    table = RigTable(dict.fromkeys(names_of("degrees_per_step"), Prior(0.05, 0.0005)), mechanism=SIGHTING_HEAD)
    terms = dict.fromkeys((term.name for term in TERMS if term.name in table.priors), Prior(0.0, TERM_DEG))
    true = {**table.priors, **terms, **dict.fromkeys(still, Prior(0.0, 0.0))}
    true |= {"azimuth_zero_deg": Prior(azimuth_zero_deg, 0.1), "tangent_flexure_deg": Prior(0.0, 0.0)}
    rig = Rig(table, None, true, {}, {}, {"sighting_sd_deg": 0.005}, {"move_s": 1.0, "look_s": 1.0})
    for seed in range(4):
        run = simulate(rig, tuple(plan.steps), seed)
        p, spots = run.truth.parameters, run.campaign.spots
        at = seen_places(run.campaign.moves, [spot.move for spot in spots], table)
        with jax.enable_x64(True):
            model = model_of(jnp.array([*(p[n] for n in EVERY_TERM.rig_names), *np.zeros(24)]), mechanism=EVERY_TERM)
            places = Places(*map(jnp.asarray, (at.steps, at.on_tilt, np.ones(len(at.steps), bool))))
            pose_rad = np.radians(run.truth.reference_pose_deg)
            line = SeenLine(pose_rad, places, line_share(at, np.ones(len(spots), bool)))
            none, mirrors = jnp.zeros(2 * len(at.steps)), beam_angles(model.optics, *jnp.asarray(pose_rad))
            means = np.asarray(line_deg_per_step(model, line, none, mirrors)).reshape(2, 2).mean(axis=1)
        expected = np.array(list(run.truth.effective_deg_per_step(run.campaign).values()))
        both = expected.reshape(2, 2).mean(axis=1)
        assert np.abs(means - both).max() < 1e-9 * 0.05
        ratios = np.array([p["degrees_per_step.pan"], p["degrees_per_step.tilt"]])
        # Terms move a direction by some of them, more by the tangent of the elevation, over at least 110 deg.
        assert np.abs(both / ratios - 1).max() < 6 * TERM_DEG / 110


def test_offsets_by_hand():
    """Axis 20 mm ahead, beam 3 mm aside and 5 mm over it, azimuth 90, elevation 90 deg: over has become backwards."""
    optics = optics_of({"elevation_axis_offset_mm": 20.0, "beam_offset_mm.y": 3.0, "beam_offset_mm.z": 5.0})
    ray = optics.leaving(np.pi / 2, np.pi / 2, np)
    assert np.allclose([*ray.origin_mm, *ray.direction], [-3.0, 15.0, 0.0, 0.0, 0.0, 1.0], atol=100 * ROUNDING)
