"""The digital twin's laws: test vectors of DESIGN 3.2, transmission, stop errors, seeds, protocols.

Degrees, mm and pixels by suffix. Nothing here imports an estimator's model.
"""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from tvsbayes.errors import InputError
from tvsbayes.instrument.axes import DIRECTION_SIGNS, HOME_SD_DEG
from tvsbayes.instrument.parameters import (
    HARMONIC_NAMES,
    RIG_PRIORS,
    STEREO_PARAMETER_NAMES,
    Prior,
)
from tvsbayes.instrument.plan import PlanStep
from tvsbayes.instrument.protocols import PROTOCOLS, four_point_protocol, grid_protocol
from tvsbayes.instrument.rig import Rig, RigTable
from tvsbayes.instrument.stereo_pair import Stereo, rotation_matrix
from tvsbayes.twin.physics import (
    aperture_angle_deg,
    beam_jacobian,
    effective_deg_per_step,
    effective_mirror_offset_mm,
    mirror_chain,
    play,
    project,
    stop_errors,
    to_tvs,
    transmission,
)
from tvsbayes.twin.simulated_campaign import Truth, draw_truth, simulate

NOMINAL = {name: prior.value for name, prior in RIG_PRIORS.items()}
VECTOR = NOMINAL | {
    "mirror_offset_mm": 30.0,
    "mirror1_error_deg": 0.3,
    "mirror2_error_deg": -0.2,
    "laser_tilt_deg.x": 0.25,
    "laser_tilt_deg.y": -0.35,
    "laser_offset_mm.x": 0.2,
    "laser_offset_mm.y": -0.4,
    "tilt_axis_skew_deg": 0.4,
    "tilt_axis_offset_mm.x": 0.5,
    "tilt_axis_offset_mm.z": -0.3,
}
POSE_DEG = (10.0, 5.0)


def make_rig(truth_u: float | None = None) -> Rig:
    """A small rig that looks straight ahead; `truth_u` = 0 fixes every quantity at its value."""
    stereo = Stereo(
        image_width=1280,
        image_height=720,
        M1=np.array([[800.0, 0.0, 640.0], [0.0, 800.0, 360.0], [0.0, 0.0, 1.0]]),
        D1=np.array([-0.3, 0.1, 0.0, 0.0, 0.0]),
        M2=np.array([[800.0, 0.0, 640.0], [0.0, 800.0, 360.0], [0.0, 0.0, 1.0]]),
        D2=np.array([-0.3, 0.1, 0.0, 0.0, 0.0]),
        R=np.eye(3),
        T=np.array([-85.0, 0.0, 0.0]),
        parameter_covariance=np.diag([1.0, 1.0, *[0.25] * 2, *[1e-6] * 5] * 2 + [1e-8] * 3 + [0.0] * 3),
        rms_px=0.2,
    )
    priors = dict(RIG_PRIORS)
    for axis in "xyz":
        priors[f"extrinsics.rotation_rad.{axis}"] = Prior(0.0, 0.02)
        priors[f"extrinsics.translation_mm.{axis}"] = Prior(-20.0 if axis == "y" else 0.0, 5.0)
    truth = {name: replace(p, u=p.u if truth_u is None else truth_u) for name, p in priors.items()}
    return Rig(RigTable(priors), stereo, truth, {"d1": 175.0, "d2": 275.0, "d3": 375.0}, {}, {}, {})


def small_plan() -> tuple[PlanStep, ...]:
    """Pan and tilt moves in turn with a look after each, two sheets, one rehoming."""
    orders = [
        ("home", 0, 0),
        ("place", "d1"),
        ("look",),
        ("move", 50, 0),
        ("look",),
        ("move", 50, 40),
        ("look",),
    ]
    orders += [("look",), ("move", 50, -40), ("look",), ("place", "d2"), ("move", 51, -40), ("look",)]
    orders += [("home", 0, 0), ("look",), ("move", -50, 0), ("look",)]
    steps = []
    for number, (action, *rest) in enumerate(orders):
        if action == "place":
            steps.append(PlanStep(number, action, target=rest[0]))
        else:
            steps.append(PlanStep(number, action, *rest))
    return tuple(steps)


# Half a unit of the last digit that DESIGN 3.2 prints.
LAST_9, LAST_12, LAST_7, LAST_6 = 0.5e-9, 0.5e-12, 0.5e-7, 0.5e-6


def test_mirror_chain_vector():
    """Origin and direction of DESIGN 3.2 to the last printed digit."""
    origin, direction = mirror_chain(*np.radians(POSE_DEG), VECTOR)
    assert origin == pytest.approx([5.371658918, -29.176887333, -0.940368833], abs=LAST_9 * 1.01)
    assert direction == pytest.approx([0.981182562588, 0.177188586189, 0.076713648059], abs=LAST_12 * 1.01)


def test_beam_jacobian_vector():
    """d(az, el)/d(psi, beta) of DESIGN 3.2 to the last printed digit."""
    printed = np.array([[1.0070677, 0.0038895], [-0.0025873, 0.9977070]])
    assert np.abs(beam_jacobian(VECTOR, POSE_DEG) - printed).max() <= LAST_7


def test_tvs_and_aperture_vector():
    """p_T and both readings of B of DESIGN 3.2 to the last printed digit."""
    origin, direction = mirror_chain(*np.radians(POSE_DEG), VECTOR)
    point = to_tvs(origin + 250.0 * direction, 200.0, 91.0)
    assert point == pytest.approx([250.365237, 119.492704, 18.238043], abs=LAST_6 * 1.01)
    assert aperture_angle_deg(point, 200.0, "in-plane") == pytest.approx(48.834423, abs=LAST_6)
    assert aperture_angle_deg(point, 200.0, "azimuth") == pytest.approx(48.759278, abs=LAST_6)


def test_aperture_beyond_a_right_angle():
    """A spot outside the aperture's side has B > 90 deg in both conventions."""
    points = np.array([[100.0, -200.0, 30.0]])
    assert aperture_angle_deg(points, 200.0, "in-plane")[0] > 90
    assert aperture_angle_deg(points, 200.0, "azimuth")[0] == pytest.approx(135.0)


def test_nominal_chain_is_a_periscope():
    """Nominal beam: origin (0, -L, 0), along +x; pan and tilt positive to the left and up."""
    origin, direction = mirror_chain(0.0, 0.0, NOMINAL)
    assert origin == pytest.approx([0.0, -30.0, 0.0], abs=1e-12)
    assert direction == pytest.approx([1.0, 0.0, 0.0], abs=1e-12)
    left = mirror_chain(0.1, 0.0, NOMINAL)[1]
    up = mirror_chain(0.0, 0.1, NOMINAL)[1]
    assert left == pytest.approx([np.cos(0.1), np.sin(0.1), 0.0], abs=1e-12)
    assert up == pytest.approx([np.cos(0.1), 0.0, np.sin(0.1)], abs=1e-12)


def test_mirror_chain_takes_arrays():
    """Arrays of angles give what single angles give."""
    psi, beta = np.radians([[10.0, -3.0], [5.0, 2.0]])
    origins, directions = mirror_chain(psi, beta, VECTOR)
    for i in range(2):
        origin, direction = mirror_chain(psi[i], beta[i], VECTOR)
        assert np.array_equal(origins[i], origin) and np.array_equal(directions[i], direction)


def test_effective_ratios_and_offset_of_the_nominal_rig():
    """Nominal: the beam turns as the mirrors do and passes the pan axis at +L, at any pose."""
    parameters = NOMINAL | {"degrees_per_step.left": 0.0601, "degrees_per_step.right": 0.0599}
    parameters |= {"degrees_per_step.up": 0.0701, "degrees_per_step.down": 0.0699}
    effective = effective_deg_per_step(parameters, (12.0, 7.0))
    # Differences of angles of order 0.1 rad over 2e-5 rad: rounding 1e-16 / 2e-5 = 1e-11, times ten.
    assert effective == pytest.approx({"left": 0.0601, "right": 0.0599, "up": 0.0701, "down": 0.0699}, rel=1e-10)
    assert effective_mirror_offset_mm(parameters, (12.0, 7.0)) == pytest.approx(30.0, abs=1e-10)
    tilted = parameters | {"laser_tilt_deg.x": 1.0}
    slope = effective_deg_per_step(tilted, (12.0, 7.0))["left"] / 0.0601
    assert 0.001 < abs(slope - 1) < 0.02, "a laser tilt changes the local slope by up to 1.7 % (DESIGN 3.2)"


def test_play_vector():
    """The play vector of DESIGN 3.2, through the transmission with its two ratios and by itself."""
    counters = np.cumsum([0, 200, -200, 3, -2, 100])
    first = np.arange(6) == 0
    y = transmission(counters, first, np.full(6, -0.5), np.zeros(6), (0.061, -0.002), 0.3)
    # Exact in decimals: rounding of sums of order 12 only.
    assert y == pytest.approx([-0.15, 11.85, -0.25, -0.25, -0.25, 5.506], abs=1e-13)
    q = np.array([12.0, -0.4, -0.22, -0.344, 5.656])
    assert play(q, -0.15, 0.3) == pytest.approx(y[1:], abs=1e-13)


def test_play_keeps_reversals_and_clears():
    """After a reversal the output lags by b; after a run-up by nothing (classic sees k - b/N and k)."""
    first = np.arange(4) == 0
    y = transmission(np.array([0, -40, 0, 200]), first, np.full(4, 0.5), np.zeros(4), (0.06, 0.0), 0.5)
    assert y[3] - y[2] == pytest.approx(200 * 0.06, abs=1e-12)
    y = transmission(np.array([0, 200, 0, 200]), first, np.full(4, 0.5), np.zeros(4), (0.06, 0.0), 0.5)
    assert y[3] - y[2] == pytest.approx(200 * 0.06 - 0.5, abs=1e-12)


def test_first_rows_of_segments():
    """The gear restarts at q = k n + h with the mean ratio; the approach decides the flank."""
    first = np.array([True, False, True, False])
    home = np.array([0.0, 0.0, 0.03, 0.03])
    y = transmission(np.array([0, 100, 50, 60]), first, np.array([-0.5, 0, 0.5, 0]), home, (0.06, 0.002), 0.2)
    # 100 steps to the left at 0.061 deg, less half the play.
    assert y[:2] == pytest.approx([-0.1, 6.1 - 0.1], abs=1e-12)
    assert y[2] == pytest.approx(50 * 0.06 + 0.03 + 0.1, abs=1e-12)
    # Ten steps of 0.061 deg are 0.61 deg: play 0.2 deg is crossed first.
    assert y[3] == pytest.approx(50 * 0.06 + 0.03 + 0.61 - 0.1, abs=1e-12)


def test_stop_errors_persist_and_are_redrawn():
    """Held while the other axis moves or nothing does; redrawn by this axis' counter and by homing."""
    counters = np.array([0, 5, 5, 5, 4, 4, 4])
    first = np.array([1, 0, 0, 0, 0, 1, 0], bool)
    approach = ["left", "", "", "", "", "unknown", ""]
    draws = np.arange(1.0, 8.0)
    held = stop_errors(counters, first, approach, draws, {"+": 0.1, "-": 0.01})
    both = np.sqrt((0.1**2 + 0.01**2) / 2)
    assert held == pytest.approx([0.1, 0.2, 0.2, 0.2, 0.05, 6 * both, 6 * both], abs=1e-15)


def test_stop_error_is_redrawn_though_play_absorbs_the_move():
    """Move 51 after 50 lies within the play of 2 deg, yet the spot moves by a new stop error."""
    rig = make_rig(truth_u=0.0)
    truth = draw_truth(rig, np.random.default_rng(0))
    truth = replace(truth, parameters=truth.parameters | {"backlash_deg.pan": 2.0})
    result = simulate(rig, small_plan(), 3, truth).truth
    plan_moves = 7  # home, three moves, one step, home, move
    assert len(result.stop_errors_deg) == plan_moves
    pan, tilt = np.array(result.stop_errors_deg).T
    assert pan[1] == pan[2] == pan[3] != pan[4], "pan error held during tilt moves, redrawn by one pan step"
    assert tilt[0] == tilt[1] and len({tilt[1], tilt[2], tilt[3]}) == 3 and tilt[3] == tilt[4]
    psi = np.array(result.mirror_angles_deg)[:, 0] - pan
    assert psi[3] == psi[2] == psi[1] and psi[4] == pytest.approx(psi[3] + 0.06, abs=1e-12)


def test_stop_errors_have_the_sd_of_their_direction():
    """2000 moves to either side: sample sds within four standard errors of their own sd."""
    counters = np.arange(4001) % 2
    first = np.arange(4001) == 0
    draws = np.random.default_rng(5).standard_normal(4001)
    held = stop_errors(counters, first, ["left"] + [""] * 4000, draws, {"+": 0.15, "-": 0.02})
    four_se = 4 / np.sqrt(2 * 2000)
    assert np.std(held[1::2]) == pytest.approx(0.15, rel=four_se)
    assert np.std(held[2::2]) == pytest.approx(0.02, rel=four_se)


def test_home_offsets():
    """None in the first segment; later ones N(0, HOME_SD_DEG^2)."""
    plan = [PlanStep(i, "home", 0, 0) for i in range(400)]
    offsets = np.array(simulate(make_rig(), plan, 1).truth.home_offsets_deg)
    assert np.array_equal(offsets[0], [0.0, 0.0])
    assert np.std(offsets[1:]) == pytest.approx(HOME_SD_DEG, rel=4 / np.sqrt(2 * 798))


def test_homing_ends_on_the_side_that_it_states():
    """Reached left or up a mirror lags by half the play, reached right or down it leads by as much (DESIGN 3.1)."""
    rig = make_rig(truth_u=0.0)
    truth = draw_truth(rig, np.random.default_rng(0))
    known = {f"stop_sd_deg.{d}": 0.0 for d in DIRECTION_SIGNS}
    known |= {"backlash_deg.pan": 1.0, "backlash_deg.tilt": 0.6, "tilt_zero_deg": 0.25}
    truth = replace(truth, parameters=truth.parameters | known)
    for sides, angles_deg in ((("left", "up"), (-0.5, -0.05)), (("right", "down"), (0.5, 0.55))):
        found = simulate(rig, [PlanStep(0, "home", 0, 0)], 1, truth, home_approach=sides).truth
        assert found.mirror_angles_deg[0] == pytest.approx(angles_deg, abs=1e-12)


def test_unknown_approach_is_uniform_in_the_band():
    """Mirror angles after homing with unknown approach fill the band of width b around mid-play."""
    rig = make_rig(truth_u=0.0)
    truth = draw_truth(rig, np.random.default_rng(0))
    quiet = {f"stop_sd_deg.{d}": 0.0 for d in DIRECTION_SIGNS}
    truth = replace(truth, parameters=truth.parameters | quiet | {"backlash_deg.pan": 1.0})
    plan = [PlanStep(i, "home", 0, 0) for i in range(500)]
    result = simulate(rig, plan, 2, truth, home_approach=("unknown", "up")).truth
    start = np.array(result.mirror_angles_deg)[:, 0] - np.array(result.home_offsets_deg)[:, 0]
    assert start.min() >= -0.5 and start.max() <= 0.5
    # Uniform: variance b^2/12; relative sd of the sample sd is sqrt(0.2/n) = 2 %.
    assert np.std(start) == pytest.approx(1 / np.sqrt(12), rel=4 * 0.02)


def test_truth_is_drawn_around_the_stated_values_never_at_them():
    """Every quantity with u > 0 and every free stereo parameter differs from its value; u = 0 stays."""
    rig = make_rig()
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


def test_draws_follow_their_distributions():
    """600 rigs: means and sds of each kind of distribution, and of fx, within four standard errors."""
    rig, rng, n = make_rig(), np.random.default_rng(11), 600
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
    assert np.mean(fx) == pytest.approx(800.0, abs=four_se) and np.std(fx) == pytest.approx(1.0, rel=four_se)


def test_truth_round_trip():
    """truth.json returns the same truth, with the effective values it implies."""
    rig = make_rig()
    truth = simulate(rig, small_plan(), 4).truth
    document = json.loads(json.dumps(truth.as_json(), allow_nan=False))
    again = Truth.from_json(document, rig.stereo)
    assert again.parameters == truth.parameters and again.mirror_angles_deg == truth.mirror_angles_deg
    # The rotation goes through its matrix once: rounding only.
    assert np.abs(again.stereo.vector - truth.stereo.vector).max() < 1e-12
    assert set(document["stereo"]) == set(STEREO_PARAMETER_NAMES)
    assert document["effective_deg_per_step"] == effective_deg_per_step(truth.parameters, truth.reference_pose_deg)


def test_same_seed_same_campaign_other_seed_another():
    """Seeds reproduce every byte of spots and truth."""
    rig, plan = make_rig(), small_plan()
    one, two, other = (simulate(rig, plan, seed, aperture=True) for seed in (8, 8, 9))
    assert one.campaign.spots == two.campaign.spots and one.truth.parameters == two.truth.parameters
    assert one.campaign.spots != other.campaign.spots


def test_transmission_error_leaves_every_other_draw_as_it_was():
    """The same rig, stop errors, sheets and noise, whose mirrors stand off by the error of the wheel."""
    rig, plan = make_rig(), small_plan()
    names = [name for name in HARMONIC_NAMES if ".tilt." in name]
    wobbling = replace(
        rig,
        table=replace(rig.table, harmonic_period_deg={"tilt": 360.0}),
        truth={**rig.truth, **dict.fromkeys(names, Prior(0.0, 0.1))},
    )
    plain, error = simulate(rig, plan, 8).truth, simulate(wobbling, plan, 8).truth
    assert {n for n in plain.parameters if plain.parameters[n] != error.parameters[n]} == set(names)
    assert np.array_equal(plain.stereo.vector, error.stereo.vector)
    assert plain.stop_errors_deg == error.stop_errors_deg and plain.home_offsets_deg == error.home_offsets_deg
    shift = np.subtract(error.mirror_angles_deg, plain.mirror_angles_deg)
    resting = np.subtract(plain.mirror_angles_deg, plain.stop_errors_deg)[:, 1]
    wheel = np.radians(resting - plain.parameters["tilt_zero_deg"])
    c1, s1, c2, s2 = (error.parameters[name] for name in names)
    expected = c1 * np.cos(wheel) + s1 * np.sin(wheel) + c2 * np.cos(2 * wheel) + s2 * np.sin(2 * wheel)
    assert shift[:, 1] == pytest.approx(expected, abs=1e-12) and np.abs(shift[:, 1]).max() > 0.01
    assert not shift[:, 0].any()


def test_true_transmission_error_needs_its_period():
    rig = make_rig()
    truth = draw_truth(rig, np.random.default_rng(1))
    wobbling = replace(truth, parameters={**truth.parameters, "harmonic_deg.pan.1.sin": 0.1})
    with pytest.raises(InputError, match=r"harmonic_deg\.pan\.1\.sin has no period"):
        simulate(rig, small_plan(), 8, wobbling)


def test_streams_are_independent():
    """Aperture readings change no pixel; a truth given changes no other draw; nor does the spot noise."""
    rig, plan = make_rig(truth_u=0.0), small_plan()
    rig = replace(rig, stereo=replace(rig.stereo, parameter_covariance=np.zeros((24, 24))))
    without, with_readings = simulate(rig, plan, 8), simulate(rig, plan, 8, aperture=True)
    stripped = tuple(replace(spot, aperture_deg=None) for spot in with_readings.campaign.spots)
    assert stripped == without.campaign.spots
    assert all(spot.aperture_deg is not None for spot in with_readings.campaign.spots if spot.status == "ok")
    given = draw_truth(rig, np.random.default_rng(1))
    assert simulate(rig, plan, 8, given).campaign.spots == without.campaign.spots, "u = 0: any draw is the same rig"
    noisier = simulate(rig, plan, 8, given, spot_sd_px=0.16)
    assert noisier.truth.stop_errors_deg == without.truth.stop_errors_deg


def test_spots_lie_on_beam_and_sheet():
    """Without noise, triangulated spots lie on the beam and within five sds of the nominal sheet."""
    from tvsbayes.instrument.stereo_pair import triangulate

    rig = make_rig(truth_u=0.0)
    quiet = draw_truth(rig, np.random.default_rng(0))
    simulated = simulate(rig, small_plan(), 5, quiet, spot_sd_px=1e-9)
    truth, p = simulated.truth, simulated.truth.parameters
    rotation = rotation_matrix(np.array([p[f"extrinsics.rotation_rad.{a}"] for a in "xyz"]))
    translation = np.array([p[f"extrinsics.translation_mm.{a}"] for a in "xyz"])
    seen = [spot for spot in simulated.campaign.spots if spot.status == "ok"]
    assert len(seen) == len(simulated.campaign.spots)
    for spot in seen:
        pixels = np.array([spot.u_left_px, spot.v_left_px, spot.u_right_px, spot.v_right_px])
        point = triangulate(truth.stereo, pixels, p["focal_scale"])[0]
        origin, direction = mirror_chain(*np.radians(truth.mirror_angles_deg[spot.move]), p)
        origin, direction = rotation @ origin + translation, rotation @ direction
        # 1e-9 px times a depth gain of 2 mm/px, times 50.
        assert np.linalg.norm(np.cross(point - origin, direction)) < 1e-7
        # Depth sd 1 mm and 0.5 deg over 150 mm off axis: 1.9 mm together.
        assert abs(point[0] - rig.sheets_mm[spot.target]) < 5 * 1.9


@pytest.mark.parametrize("convention", ["in-plane", "azimuth"])
def test_aperture_reads_the_spot_with_its_zero(convention: str):
    """Read B = angle of the spot in T, seen from (0, -a/2, 0), plus zero, plus noise of the stated sd."""
    from tvsbayes.instrument.stereo_pair import triangulate

    rig = make_rig(truth_u=0.0)
    rig = replace(rig, table=replace(rig.table, aperture_convention=convention))
    given = {
        "aperture_zero_deg": 1.5,
        "baseline_mm": 201.0,
        "pan_zero_emission_deg": 92.0,
        "aperture_sd_deg": 0.02,
    }
    truth = draw_truth(rig, np.random.default_rng(0))
    truth = replace(truth, parameters=truth.parameters | given)
    plan = grid_protocol(("d1", "d2"), pan_steps=(-60, 0, 60), tilt_steps=(-60, 0, 60))
    simulated = simulate(rig, plan, 5, truth, spot_sd_px=1e-9, aperture=True)
    p, seen = simulated.truth.parameters, simulated.campaign.spots
    pixels = np.array([[s.u_left_px, s.v_left_px, s.u_right_px, s.v_right_px] for s in seen])
    points_S = triangulate(truth.stereo, pixels, p["focal_scale"])
    rotation = rotation_matrix(np.array([p[f"extrinsics.rotation_rad.{a}"] for a in "xyz"]))
    points_P = (points_S - [p[f"extrinsics.translation_mm.{a}"] for a in "xyz"]) @ rotation
    turned = np.radians(2.0)
    x = np.cos(turned) * points_P[:, 0] - np.sin(turned) * points_P[:, 1]
    y = np.sin(turned) * points_P[:, 0] + np.cos(turned) * points_P[:, 1] + 201.0
    z = points_P[:, 2]
    cone = np.degrees(np.arccos(y / np.sqrt(x**2 + y**2 + z**2)))
    plane = np.degrees(np.arccos(y / np.hypot(x, y)))
    error = np.array([s.aperture_deg for s in seen]) - (cone if convention == "in-plane" else plane) - 1.5
    # 36 readings: mean within four standard errors, sd within four of its own (1/sqrt(70) = 12 %).
    assert np.mean(error) == pytest.approx(0.0, abs=4 * 0.02 / 6)
    assert np.std(error, ddof=1) == pytest.approx(0.02, rel=4 * 0.12)


def test_every_placement_stands_anew():
    """The same target placed twice is not at the same depth."""
    rig = make_rig(truth_u=0.0)
    orders = [("home",), ("place", "d1"), ("look",), ("look",), ("place", "d1"), ("look",)]
    plan = [
        PlanStep(i, a, 0 if a == "home" else None, 0 if a == "home" else None, *t) for i, (a, *t) in enumerate(orders)
    ]
    spots = simulate(rig, plan, 6, spot_sd_px=1e-9).campaign.spots
    disparity = [spot.u_left_px - spot.u_right_px for spot in spots]
    # 1 mm of depth at 175 mm is f B / Z^2 = 2.2 px of disparity; noise is 1e-9 px.
    assert abs(disparity[0] - disparity[1]) < 1e-7 and abs(disparity[2] - disparity[0]) > 0.01


def test_pixel_noise_is_stated_sd_times_pixel_scale():
    """400 looks at one resting spot: the spread in each coordinate, in four standard errors."""
    rig = make_rig(truth_u=0.0)
    truth = draw_truth(rig, np.random.default_rng(0))
    truth = replace(truth, parameters=truth.parameters | {"pixel_scale": 1.7})
    plan = [PlanStep(0, "home", 0, 0), PlanStep(1, "place", target="d1")]
    plan += [PlanStep(2 + i, "look") for i in range(400)]
    campaign = simulate(rig, plan, 6, truth, spot_sd_px=0.1).campaign
    u = np.array([[s.u_left_px, s.v_left_px, s.u_right_px, s.v_right_px] for s in campaign.spots])
    assert np.std(u, axis=0, ddof=1) == pytest.approx(0.17, rel=4 / np.sqrt(800))
    assert campaign.spots[0].su_left_px == 0.1


def test_a_spot_out_of_view_is_undetected():
    """Outside an image, behind a camera or beyond the lens: empty pixels, no reading, undetected."""
    rig = make_rig(truth_u=0.0)
    plan = [
        PlanStep(0, "home", 0, 0),
        PlanStep(1, "place", target="d1"),
        PlanStep(2, "move", 800, 0),
        PlanStep(3, "look"),
    ]
    plan += [
        PlanStep(4, "move", 2500, 0),
        PlanStep(5, "look"),
        PlanStep(6, "move", 0, 0),
        PlanStep(7, "look"),
    ]
    spots = simulate(rig, plan, 1, aperture=True).campaign.spots
    assert [spot.status for spot in spots] == ["undetected", "undetected", "ok"]
    assert spots[0].u_left_px is spots[0].su_right_px is spots[1].aperture_deg is None
    points = np.array([[-175.0, 0.0, 0.0], [175.0, 0.0, 0.0], [175.0, -500.0, 0.0]])
    assert np.isfinite(project(points, rig.stereo)).all(axis=1).tolist() == [False, True, False]
    folding = replace(rig.stereo, D1=np.array([-0.5, 0.0, 0.0, 0.0, 0.0]), D2=np.array([-0.5, 0.0, 0.0, 0.0, 0.0]))
    # r = 1.4 is beyond the turn at 0.82, where the polynomial leads back to r = 0.03.
    assert np.isnan(project(np.array([[100.0, -140.0, 0.0]]), folding)).all()


def test_plan_errors_teach():
    """An unknown sheet and a look without a sheet are refused with a remedy."""
    rig = make_rig()
    with pytest.raises(InputError, match="d9") as caught:
        simulate(rig, [PlanStep(0, "home", 0, 0), PlanStep(1, "place", target="d9")], 1)
    assert caught.value.allowed == "d1, d2, d3"
    with pytest.raises(InputError, match="before a target"):
        simulate(rig, [PlanStep(0, "home", 0, 0), PlanStep(1, "look")], 1)


def test_time_advances_by_the_rigs_costs():
    """time_s is the sum of the costs of what came before."""
    rig = replace(make_rig(), costs_s={"placement_s": 11.0, "move_s": 2.0, "look_s": 3.0})
    times = [move.time_s for move in simulate(rig, small_plan(), 1).campaign.moves]
    # home place look | move look | move look look | move look place | move look | home look | move
    assert times == [0.0, 16.0, 21.0, 29.0, 45.0, 50.0, 55.0]


@pytest.mark.parametrize("name", ["paper", "mixed", "paper_twin"])
def test_four_point_plans(name: str):
    """96 experiments of four looks in the paper's order: d1, d2, move, d2, d1; 24 per direction."""
    plan = PROTOCOLS[name]()
    looks, counters, target = {}, (0, 0), ""
    for step in plan:
        if step.action == "place":
            target = step.target
        elif step.action in ("home", "move"):
            counters = (step.pan_steps, step.tilt_steps)
        else:
            looks.setdefault(step.experiment, []).append((step.point, target, counters))
    assert len(looks) == 96 and [step.step for step in plan] == list(range(len(plan)))
    seen = []
    for four in looks.values():
        assert [look[:2] for look in four] == [(1, "d1"), (2, "d2"), (3, "d2"), (4, "d1")]
        assert four[0][2] == four[1][2] and four[2][2] == four[3][2]
        seen.append(tuple(np.subtract(four[2][2], four[1][2])))
    sizes = {(200,), (100, 200)}
    for direction, (axis, sign) in DIRECTION_SIGNS.items():
        mine = [s[axis == "tilt"] for s in seen if np.sign(s[axis == "tilt"]) == sign and s[axis == "pan"] == 0]
        assert len(mine) == 24, direction
        assert tuple(sorted({abs(s) for s in mine})) in sizes


def _approach_signs(plan: tuple[PlanStep, ...]) -> dict[str, set[bool]]:
    """Direction -> whether its starts were reached along the experiment (cleared), as the set of cases."""
    history: list[tuple[int, int]] = []
    arrived: dict[int, int] = {}
    cases: dict[str, set[bool]] = {}
    for step in plan:
        if step.action in ("home", "move"):
            history.append((step.pan_steps, step.tilt_steps))
        elif step.action == "look" and step.point == 1:
            arrived[step.experiment] = len(history) - 1
        elif step.action == "look" and step.point == 3:
            start = arrived[step.experiment]
            delta = np.subtract(history[start + 1], history[start])
            axis = int(np.flatnonzero(delta)[0])
            before = next(h for h in reversed(history[:start]) if h[axis] != history[start][axis])
            direction = [["right", "left"], ["down", "up"]][axis][int(delta[axis] > 0)]
            cases.setdefault(direction, set()).add((history[start][axis] - before[axis]) * delta[axis] > 0)
    return cases


def test_approaches_of_the_protocols():
    """Reversed where asked; right and up cleared in the twin's; both kinds in the mixed."""
    asked = four_point_protocol(repeats=3, approaches={name: ("reversed",) for name in DIRECTION_SIGNS})
    assert _approach_signs(asked) == {name: {False} for name in DIRECTION_SIGNS}
    twin = _approach_signs(PROTOCOLS["paper_twin"]())
    assert twin == {"left": {False}, "right": {True}, "up": {True}, "down": {False}}
    assert _approach_signs(PROTOCOLS["mixed"]()) == {name: {True, False} for name in DIRECTION_SIGNS}


def test_the_papers_protocol_is_plain_go_and_return():
    """Pan 0, 200, 0, ... from the homing on, without overshoot; tilt likewise."""
    counters = [(s.pan_steps, s.tilt_steps) for s in PROTOCOLS["paper"]() if s.action in ("home", "move")]
    assert counters[:4] == [(0, 0), (200, 0), (0, 0), (200, 0)]
    assert {pan for pan, _ in counters} == {0, 100, 200} and {tilt for _, tilt in counters} == {-100, 0, 100}
    # Left: 24 out, 23 back; right the same; to mid pan and the low start; up and down likewise.
    assert len(counters) == 1 + 47 + 47 + 2 + 47 + 47


def test_grid_sees_every_pose_from_both_sides():
    """At each of three sheets each pose once per side of pan and of tilt, with one placement per sheet."""
    plan = grid_protocol()
    assert sum(step.action == "place" for step in plan) == 3
    approach, counters, target = [0, 0], [0, 0], ""
    seen: dict[tuple, set] = {}
    for step in plan:
        if step.action == "place":
            target = step.target
        elif step.action in ("home", "move"):
            for axis, value in enumerate((step.pan_steps, step.tilt_steps)):
                if value != counters[axis]:
                    approach[axis], counters[axis] = int(np.sign(value - counters[axis])), value
        else:
            seen.setdefault((target, *counters), set()).add(tuple(approach))
    assert len(seen) == 3 * 24
    for pose, sides in seen.items():
        assert {pan for pan, _ in sides} == {-1, 1} and {tilt for _, tilt in sides} == {-1, 1}, pose


def test_the_twin_needs_no_jax():
    """Simulating and the classic estimator never import JAX (DESIGN 9)."""
    modules = "tvsbayes.twin.simulated_campaign, tvsbayes.estimators.four_point"
    code = f"import sys, {modules}; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
