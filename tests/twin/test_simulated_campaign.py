"""The digital twin's laws: test vectors of formulation 3.2, transmission, stop errors, seeds, protocols.

Degrees, mm and pixels by suffix. Nothing here imports an estimator's model.
"""

from __future__ import annotations

import datetime
from dataclasses import replace

import numpy as np
import pytest
from support.commands import steps

from tvsbayes.errors import InputError
from tvsbayes.instrument.axes import DIRECTION_SIGNS
from tvsbayes.instrument.parameters import (
    names_of,
)
from tvsbayes.instrument.plan import PlanBuilder, PlanStep
from tvsbayes.instrument.protocols import grid_protocol
from tvsbayes.instrument.rig import Rig
from tvsbayes.instrument.stereo_pair import rotation_matrix, triangulate
from tvsbayes.twin.physics import (
    mirror_chain,
    project,
)
from tvsbayes.twin.simulated_campaign import simulate
from tvsbayes.twin.true_rig import draw_truth


@pytest.fixture
def rig(mounted_rig) -> Rig:
    """True rigs are drawn from all priors, scatter of looks and creep too; moves take no time."""
    return replace(mounted_rig, truth=mounted_rig.table.priors, costs_s={})


@pytest.fixture
def fixed(rig) -> Rig:
    """A rig of which every quantity is at its value."""
    return replace(rig, truth={name: replace(prior, u=0.0) for name, prior in rig.truth.items()})


def small_plan() -> tuple[PlanStep, ...]:
    """Pan and tilt moves in turn with a look after each, two sheets, one rehoming."""
    return steps(
        *(("home", 0, 0), ("place", "d1"), ("look",), ("move", 50, 0), ("look",), ("move", 50, 40), ("look",)),
        *(("look",), ("move", 50, -40), ("look",), ("place", "d2"), ("move", 51, -40), ("look",)),
        *(("home", 0, 0), ("look",), ("move", -50, 0), ("look",)),
    )


def test_stop_error_is_redrawn_though_play_absorbs_the_move(fixed):
    """Move 51 after 50 lies within the play of 2 deg, yet the spot moves by a new stop error."""
    truth = draw_truth(fixed, np.random.default_rng(0))
    truth = replace(truth, parameters=truth.parameters | {"backlash_deg.pan": 2.0})
    result = simulate(fixed, small_plan(), 3, truth).truth
    plan_moves = 7  # home, three moves, one step, home, move
    assert len(result.stop_errors_deg) == plan_moves
    pan, tilt = np.array(result.stop_errors_deg).T
    assert pan[1] == pan[2] == pan[3] != pan[4], "pan error held during tilt moves, redrawn by one pan step"
    assert tilt[0] == tilt[1] and len({tilt[1], tilt[2], tilt[3]}) == 3 and tilt[3] == tilt[4]
    psi = np.array(result.mirror_angles_deg)[:, 0] - pan
    assert psi[3] == psi[2] == psi[1] and psi[4] == pytest.approx(psi[3] + 0.06, abs=1e-12)


def test_homings_are_as_the_rig_states(rig):
    """An absolute zero is set by none and drifts on; the other axis' homings scatter as stated."""
    table = replace(rig.table, absolute=("pan",))
    plan = steps(*[("home", 0, 0), ("move", 100, 50)] * 400)
    truth = draw_truth(rig, np.random.default_rng(0)).with_gears()
    drifts = names_of("drift_deg_per_root_hour")
    truth = replace(truth, parameters=truth.parameters | dict.fromkeys(drifts, 0.02) | {"home_sd_deg.tilt": 0.2})
    costs_s = {"move_s": 60.0, "look_s": 0.0, "placement_s": 0.0}
    realised = simulate(replace(rig, table=table, costs_s=costs_s), plan, 1, truth).truth
    offsets, drift = np.array(realised.home_offsets_deg), np.array(realised.drift_deg)
    assert not offsets[:, 0].any()
    assert np.std(offsets[1:, 1]) == pytest.approx(0.2, rel=4 / np.sqrt(2 * 399))
    assert not drift[::2, 1].any() and drift[2::2, 0].all()


def test_unknown_approach_is_uniform_in_the_band(fixed):
    """Mirror angles after homing with unknown approach fill the band of width b around mid-play."""
    truth = draw_truth(fixed, np.random.default_rng(0))
    quiet = {f"stop_sd_deg.{d}": 0.0 for d in DIRECTION_SIGNS}
    truth = replace(truth, parameters=truth.parameters | quiet | {"backlash_deg.pan": 1.0})
    plan = steps(*[("home", 0, 0)] * 500)
    result = simulate(fixed, plan, 2, truth, home_approach=("unknown", "up")).truth
    start = np.array(result.mirror_angles_deg)[:, 0] - np.array(result.home_offsets_deg)[:, 0]
    assert start.min() >= -0.5 and start.max() <= 0.5
    # Uniform: variance b^2/12; relative sd of the sample sd is sqrt(0.2/n) = 2 %.
    assert np.std(start) == pytest.approx(1 / np.sqrt(12), rel=4 * 0.02)


def test_truth_is_drawn_around_the_stated_values_never_at_them(rig):
    """Every quantity with u > 0 and every free stereo parameter differs from its value; u = 0 stays."""
    truth = draw_truth(rig, np.random.default_rng(7))
    for name, prior in rig.truth.items():
        assert (truth.parameters[name] == prior.value) == (prior.u == 0), name
    free = np.diag(rig.stereo.parameter_covariance) > 0
    moved = np.abs(truth.stereo.vector - rig.stereo.vector)
    # The rotation goes through its matrix: fixed parameters return to rounding, free ones move by 1e-4 sd.
    assert (moved[~free] < 1e-12).all() and (
        moved[free] > 1e-4 * np.sqrt(np.diag(rig.stereo.parameter_covariance))[free]
    ).all()
    p = truth.parameters
    assert p["degrees_per_step.left"] - p["degrees_per_step.right"] == pytest.approx(
        p["ratio_contrast_deg_per_step.pan"]
    )
    assert p["degrees_per_step.up"] + p["degrees_per_step.down"] == pytest.approx(2 * p["degrees_per_step.tilt"])


def test_draws_follow_their_distributions(rig):
    """600 rigs: means and sds of each kind of distribution, and of fx, within four standard errors."""
    rng, n = np.random.default_rng(11), 600
    truths = [draw_truth(rig, rng) for _ in range(n)]
    four_se = 4 / np.sqrt(n)
    backlash = np.array([t.parameters["backlash_deg.pan"] for t in truths])
    assert backlash.min() >= 0
    assert np.sqrt(np.mean(backlash**2)) == pytest.approx(0.5, rel=four_se)
    log_stop = np.log([t.parameters["stop_sd_deg.left"] / 0.04 for t in truths])
    assert np.mean(log_stop) == pytest.approx(0.0, abs=four_se) and np.std(log_stop) == pytest.approx(1, rel=four_se)
    focal = np.array([t.parameters["focal_scale"] for t in truths])
    assert np.mean(focal) == pytest.approx(1.0, abs=0.002 * four_se)
    fx = np.array([t.stereo.vector[0] for t in truths])
    value, sd = rig.stereo.vector[0], np.sqrt(rig.stereo.parameter_covariance[0, 0])
    assert np.mean(fx) == pytest.approx(value, abs=four_se * sd) and np.std(fx) == pytest.approx(sd, rel=four_se)


def test_looks_scatter_also_where_an_axis_stands(fixed):
    """Of one beam looked at 400 times, by 0.05 deg of pan alone, then of tilt; nothing else changes."""
    count = 400
    plan = steps(("home", 0, 0), ("place", "d2"), *[("look",)] * count)
    still = draw_truth(fixed, np.random.default_rng(0))
    without = simulate(fixed, plan, 5, still)
    p, (psi, beta) = still.parameters, np.radians(without.truth.mirror_angles_deg[0])
    ahead = [mirror_chain(psi + a, beta + b, p).direction for a, b in ((0.0, 0.0), (1e-6, 0.0), (0.0, 1e-6))]
    for axis, by_angle in zip(("pan", "tilt"), (ahead[1] - ahead[0], ahead[2] - ahead[0]), strict=True):
        shaking = replace(still, parameters={**p, f"look_scatter_deg.{axis}": 0.05})
        shaken = simulate(fixed, plan, 5, shaking)
        assert shaken.truth.mirror_angles_deg == without.truth.mirror_angles_deg
        sideways = np.linalg.norm(shaken.light.directions - without.light.directions, axis=1)
        expected = np.radians(0.05) * np.linalg.norm(by_angle) / 1e-6
        # Of n normal numbers; neighbours are independent: each is another draw.
        assert np.sqrt(np.mean(sideways**2)) == pytest.approx(expected, rel=4 / np.sqrt(2 * count))
        assert len(np.unique(sideways)) == count


def test_true_transmission_error_needs_its_period(rig):
    truth = draw_truth(rig, np.random.default_rng(1))
    wobbling = replace(truth, parameters={**truth.parameters, "harmonic_deg.pan.1.sin": 0.1})
    with pytest.raises(InputError, match=r"harmonic_deg\.pan\.1\.sin has no period"):
        simulate(rig, small_plan(), 8, wobbling)


def test_spots_lie_on_beam_and_sheet(fixed):
    """Without noise, triangulated spots lie on the beam and within five sds of the nominal sheet."""
    quiet = draw_truth(fixed, np.random.default_rng(0))
    simulated = simulate(fixed, small_plan(), 5, quiet, spot_sd_px=1e-9)
    truth, p = simulated.truth, simulated.truth.parameters
    rotation = rotation_matrix(np.array([p[f"extrinsics.rotation_rad.{a}"] for a in "xyz"]))
    translation = np.array([p[f"extrinsics.translation_mm.{a}"] for a in "xyz"])
    usable = [spot for spot in simulated.campaign.spots if spot.status == "ok"]
    assert len(usable) == len(simulated.campaign.spots)
    for spot in usable:
        pixels = np.array([spot.u_left_px, spot.v_left_px, spot.u_right_px, spot.v_right_px])
        point = triangulate(truth.stereo, pixels, p["focal_scale"])[0]
        origin, direction = mirror_chain(*np.radians(truth.mirror_angles_deg[spot.move]), p)
        origin, direction = rotation @ origin + translation, rotation @ direction
        # 1e-9 px times a depth gain of 2 mm/px, times 50.
        assert np.linalg.norm(np.cross(point - origin, direction)) < 1e-7
        # Depth sd 1 mm and 0.5 deg over 150 mm off axis: 1.9 mm together.
        assert abs(point[0] - fixed.sheets_mm[spot.target]) < 5 * 1.9


@pytest.mark.parametrize("convention", ["in-plane", "azimuth"])
def test_aperture_reads_the_spot_with_its_zero(fixed, convention: str):
    """Read B = angle of the spot in T, seen from (0, -a/2, 0), plus zero, plus noise of the stated sd."""
    fixed = replace(fixed, table=replace(fixed.table, aperture_convention=convention))
    changed = {
        "aperture_zero_deg": 1.5,
        "baseline_mm": 201.0,
        "pan_zero_emission_deg": 92.0,
        "aperture_sd_deg": 0.02,
    }
    truth = draw_truth(fixed, np.random.default_rng(0))
    truth = replace(truth, parameters=truth.parameters | changed)
    plan = grid_protocol(("d1", "d2"), pan_steps=(-60, 0, 60), tilt_steps=(-60, 0, 60))
    simulated = simulate(fixed, plan, 5, truth, spot_sd_px=1e-9, aperture=True)
    p, spots = simulated.truth.parameters, simulated.campaign.spots
    pixels = np.array([[s.u_left_px, s.v_left_px, s.u_right_px, s.v_right_px] for s in spots])
    points_S = triangulate(truth.stereo, pixels, p["focal_scale"])
    rotation = rotation_matrix(np.array([p[f"extrinsics.rotation_rad.{a}"] for a in "xyz"]))
    points_P = (points_S - [p[f"extrinsics.translation_mm.{a}"] for a in "xyz"]) @ rotation
    turned = np.radians(2.0)
    x = np.cos(turned) * points_P[:, 0] - np.sin(turned) * points_P[:, 1]
    y = np.sin(turned) * points_P[:, 0] + np.cos(turned) * points_P[:, 1] + 201.0
    z = points_P[:, 2]
    cone = np.degrees(np.arccos(y / np.sqrt(x**2 + y**2 + z**2)))
    plane = np.degrees(np.arccos(y / np.hypot(x, y)))
    error = np.array([s.aperture_deg for s in spots]) - (cone if convention == "in-plane" else plane) - 1.5
    # 36 readings: mean within four standard errors, sd within four of its own (1/sqrt(70) = 12 %).
    assert np.mean(error) == pytest.approx(0.0, abs=4 * 0.02 / 6)
    assert np.std(error, ddof=1) == pytest.approx(0.02, rel=4 * 0.12)


def test_pixel_noise_is_stated_sd_times_pixel_scale(fixed):
    """400 looks at one resting spot: the spread in each coordinate, in four standard errors."""
    truth = draw_truth(fixed, np.random.default_rng(0))
    truth = replace(truth, parameters=truth.parameters | {"pixel_scale": 1.7})
    plan = steps(("home", 0, 0), ("place", "d1"), *[("look",)] * 400)
    campaign = simulate(fixed, plan, 6, truth, spot_sd_px=0.1).campaign
    u = np.array([[s.u_left_px, s.v_left_px, s.u_right_px, s.v_right_px] for s in campaign.spots])
    assert np.std(u, axis=0, ddof=1) == pytest.approx(0.17, rel=4 / np.sqrt(800))
    assert campaign.spots[0].su_left_px == 0.1


def test_a_spot_out_of_view_is_undetected(fixed):
    """Outside an image, behind a camera or beyond the lens: empty pixels, no reading, undetected."""
    there = (order for pan in (800, 2500, 0) for order in (("move", pan, 0), ("look",)))
    plan = steps(("home", 0, 0), ("place", "d1"), *there)
    spots = simulate(fixed, plan, 1, aperture=True).campaign.spots
    assert [spot.status for spot in spots] == ["undetected", "undetected", "ok"]
    assert spots[0].u_left_px is spots[0].su_right_px is spots[1].aperture_deg is None
    points = np.array([[-175.0, 0.0, 0.0], [175.0, 0.0, 0.0], [175.0, -500.0, 0.0]])
    assert np.isfinite(project(points, fixed.stereo)).all(axis=1).tolist() == [False, True, False]
    folding = replace(fixed.stereo, D1=np.array([-0.5, 0.0, 0.0, 0.0, 0.0]), D2=np.array([-0.5, 0.0, 0.0, 0.0, 0.0]))
    # r = 1.4 is beyond the turn at 0.82, where the polynomial leads back to r = 0.03.
    assert np.isnan(project(np.array([[100.0, -140.0, 0.0]]), folding)).all()


def test_plan_errors_teach(rig):
    """An unknown sheet and a look without a sheet are refused with a remedy."""
    with pytest.raises(InputError, match="d9") as caught:
        simulate(rig, steps(("home", 0, 0), ("place", "d9")), 1)
    assert caught.value.allowed == "d1, d2, d3"
    with pytest.raises(InputError, match="before a target"):
        simulate(rig, steps(("home", 0, 0), ("look",)), 1)


ROUNDING_DEG = 1e-12
"""Sums and differences of angles of some degrees."""


def test_zeros_creep_from_switching_on_and_shift_with_the_temperature(fixed):
    """Angles of every move, homings between them, against c (1 - exp(-t / tau)) + k (T - T at the first move)."""
    plan = PlanBuilder()
    plan.home(0, 0)
    plan.place("d2")
    for turn in range(6):
        plan.move(20 * turn + 10, 5)
        plan.look()
        if turn == 3:
            plan.home(0, 0)
    still = draw_truth(fixed, np.random.default_rng(0))
    shifts = {"creep_deg.pan": 0.1, "creep_deg.tilt": -0.03, "creep_minutes": 5.0, "thermal_deg_per_K.pan": 0.02}
    moving = replace(still, parameters={**still.parameters, **shifts})
    created = datetime.datetime(2026, 1, 15, 10, tzinfo=datetime.UTC)
    early = {"created": created, "powered_on": created - datetime.timedelta(minutes=3)}
    costly = replace(fixed, costs_s={"move_s": 60.0, "look_s": 1.0})

    def angles(truth, header=None, temperature=None):
        run = simulate(costly, plan.steps, 5, truth, header=header, temperature_degC=temperature)
        times_s = np.array([move.time_s for move in run.campaign.moves])
        return np.array(run.truth.mirror_angles_deg), times_s, run.campaign

    plain, times_s, _ = angles(still)
    for header, minutes in ((None, times_s / 60), (early, times_s / 60 + 3)):
        crept_deg, _, _ = angles(moving, header)
        crept = (1 - np.exp(-minutes / 5))[:, None] * [0.1, -0.03]
        np.testing.assert_allclose(crept_deg - plain, crept, atol=ROUNDING_DEG)
    warmed, _, campaign = angles(moving, temperature=lambda t: 20 + t / 100)
    crept = (1 - np.exp(-times_s / 300))[:, None] * [0.1, -0.03]
    np.testing.assert_allclose(warmed - plain - crept, np.outer(times_s / 100, [0.02, 0.0]), atol=ROUNDING_DEG)
    assert [move.temperature_degC for move in campaign.moves] == pytest.approx(20 + times_s / 100)
