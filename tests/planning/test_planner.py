"""Plans: what they will tell is what a fit of them knows; laws of information; targets, limits, when to stop.

Everything runs in the one bucket of 512 looks, so that the expected looks are compiled once.
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from conftest import dozen_plan
from scipy import optimize

from tvsbayes.errors import InputError
from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.axes import AXES, DIRECTION_SIGNS, DIRECTIONS
from tvsbayes.instrument.counter_limits import CounterLimits
from tvsbayes.instrument.parameters import INDEX, RIG_NAMES, Prior
from tvsbayes.instrument.plan import HOME_APPROACH, PlanStep, described, read_plan, run_plan, write_plan
from tvsbayes.instrument.protocols import four_point_protocol, grid_protocol, paper_protocol
from tvsbayes.instrument.rig import Rig
from tvsbayes.instrument.stops import FEW_STOPS, INSEPARABLE, inseparable, separation
from tvsbayes.model.headlines import QUANTITIES, physical_at
from tvsbayes.model.parameter_space import STOP_COLUMNS
from tvsbayes.planning import forecast, planner, search
from tvsbayes.planning.candidates import (
    CONTRAST_COLUMNS,
    LookArrays,
    Looks,
    Seen,
    arrange,
    candidates,
    covariance_of,
    information_of_looks,
)
from tvsbayes.planning.expectation import (
    LOOKS_PER_EXPERIMENT,
    NOISE_COLUMNS,
    PARAMETERS,
    design_arrays,
    information_of,
    plan_minutes,
    prior_knowledge,
)
from tvsbayes.planning.forecast import (
    PIXEL_COLUMN,
    Assurance,
    DrawnTruth,
    Family,
    classic_count,
    truth_in,
)
from tvsbayes.planning.limits import Batch, Limit, limit_of, next_experiments, stop_now
from tvsbayes.planning.plan_check import beyond_limits, check_plan, extended, judge
from tvsbayes.planning.planner import few_looks, plan_from
from tvsbayes.planning.search import CRITERIA, KNOWN, MEAN_WEIGHT, Scope, Search, scores, search_rows
from tvsbayes.planning.target import AT_POINT, DEFAULT_TARGET, Target, parse_target, sensitivity
from tvsbayes.report.command_text import plan_text
from tvsbayes.statistics.intervals import share_error
from tvsbayes.twin.physics import aperture_angle_deg, mirror_chain, to_tvs
from tvsbayes.twin.simulated_campaign import Truth, draw_truth, simulate

ROUNDING = 1e-9
"""Relative; sums of a thousand products in float64, condition numbers up to 1e5."""
WORST = parse_target(DEFAULT_TARGET)


@pytest.fixture(scope="module", autouse=True)
def small_searches():
    """One bucket, few levels: the searches are the same, the grids coarser."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tvsbayes.planning.expectation.SMALLEST_DESIGN", 512)
        for name, value in (("PAN_LEVELS", 4), ("TILT_LEVELS", 3), ("COARSE_PAN", 7), ("COARSE_TILT", 5)):
            patch.setattr(f"tvsbayes.planning.candidates.{name}", value)
        patch.setattr("tvsbayes.planning.candidates.VISIBILITY_DRAWS", 8)
        patch.setattr("tvsbayes.planning.forecast.CLASSIC_DRAWS", 5)
        patch.setitem(planner.plan.__kwdefaults__, "largest", 8)
        yield


@pytest.fixture(scope="module")
def knowledge(mounted_rig):
    return prior_knowledge(mounted_rig)


@pytest.fixture(scope="module")
def found(knowledge):
    return candidates(knowledge)


@pytest.fixture(scope="module")
def seen(knowledge, found):
    return LookArrays(found.looks, knowledge, False).at(knowledge.z, knowledge.space)


def with_priors(rig: Rig, **priors: Prior) -> Rig:
    """A rig with other priors; names with __ for a dot."""
    changed = {name.replace("__", "."): prior for name, prior in priors.items()}
    return replace(
        rig, table=replace(rig.table, priors={**rig.table.priors, **changed}), truth={**rig.truth, **changed}
    )


def u_of(steps, knowledge, z=None) -> np.ndarray:
    """U of every headline after a plan, at the pose of its own looks."""
    information = information_of(steps, knowledge)
    at = [
        sensitivity(
            Target("", q, 1.0, 1.0, ""), knowledge.z, knowledge.space, knowledge.rig.table, information.pose_rad
        )
        for q in QUANTITIES
    ]
    covariance = covariance_of(knowledge.precision + information.fisher)
    return np.array([s.value(covariance) for s in at])


# Information.


def test_a_plans_information_is_the_fits_own(mounted_rig, knowledge, monkeypatch):
    """Same point, same looks: segments with home offsets, shared stops, half-open play (the dozen)."""
    import jax

    from tvsbayes.estimators.linear_spots import stop_information
    from tvsbayes.estimators.mode_search import Problem

    monkeypatch.setattr("tvsbayes.twin.simulated_campaign.SHEET_DEPTH_SD_MM", 0.0)
    monkeypatch.setattr("tvsbayes.twin.simulated_campaign.SHEET_TILT_SD_DEG", 0.0)
    monkeypatch.setattr("tvsbayes.twin.simulated_campaign.HOME_SD_DEG", 0.0)
    # Cameras as stated: a campaign is triangulated with the stated ones, a plan's sheets stand where they stand.
    drawn = draw_truth(mounted_rig, np.random.default_rng(3)).parameters | {"focal_scale": 1.0}
    truth = truth_in(knowledge, drawn, mounted_rig.stereo.vector)
    quiet = {name: 0.0 for name in drawn if name.startswith("stop_sd_deg")} | {"pixel_scale": 0.0}
    run = simulate(mounted_rig, dozen_plan(), 4, Truth({**drawn, **quiet}, mounted_rig.stereo), aperture=True)
    assert all(spot.status == "ok" for spot in run.campaign.spots)
    problem = Problem(run.campaign, mounted_rig.table)
    with jax.enable_x64(True):
        own = stop_information(problem.linear_spots(truth.z)[1]).fisher
    planned = information_of(dozen_plan(), knowledge, aperture=True, z=truth.z).fisher
    scale = np.sqrt(np.diag(own))
    safe = np.where(scale > 0, scale, 1.0)
    # The spots are triangulated from pixels without noise: linear triangulation is exact to 1e-9 of its point.
    assert np.abs(planned / np.outer(safe, safe) - own / np.outer(safe, safe)).max() < 1e-6
    assert (scale[~NOISE_COLUMNS] > 0).sum() > 40


@pytest.mark.parametrize("moves", [256, 257])
def test_arrays_hold_every_move_of_a_plan(mounted_rig, moves):
    """One move more than twice the smallest number of looks: a homing and two moves per look, 128 times."""
    steps = [PlanStep(0, "home", 0, 0), PlanStep(1, "place", target="d1")]
    steps += [PlanStep(n, "move", n, 0) for n in range(2, moves + 1)]
    log = run_plan([*steps, PlanStep(moves + 1, "look")], mounted_rig, ("left", "up"))
    arrays = design_arrays(log.moves, [moves - 1], mounted_rig, homed_from=1, aperture=False)
    assert len(log.moves) == moves and np.array_equal(arrays.moves.steps[:moves, 0], [m.pan_steps for m in log.moves])


def test_more_looks_never_raise_a_variance(knowledge):
    """At a fixed point every added step of a plan adds a positive semi-definite matrix."""
    steps = paper_protocol(2)
    looks = [k for k, step in enumerate(steps) if step.action == "look"]
    previous = np.diag(knowledge.covariance)
    for count in (2, 5, 9, 16, 32):
        information = information_of(steps[: looks[count - 1] + 1], knowledge).fisher
        variance = np.diag(covariance_of(knowledge.precision + information))
        assert np.all(variance <= previous * (1 + ROUNDING)), count
        previous = variance
    assert previous[INDEX["degrees_per_step.pan"]] < 0.01


def test_looks_add_up_to_the_plan_they_make(knowledge, found, seen):
    """The fast sum equals the filter's pass over the arranged plan, with and without an unknown home offset."""
    picks = np.random.default_rng(5).integers(0, len(found.looks), 24)
    arranged = arrange(found.looks[picks], knowledge.sheets, found.overshoot)
    for after_data in (False, True):
        known = replace(knowledge, after_data=after_data)
        exact = information_of(arranged.steps, known).fisher
        quick = information_of_looks(seen, picks, arranged.path, knowledge.space, after_data)
        assert np.abs(quick - exact).max() < ROUNDING * np.abs(exact).max()


def test_order_of_experiments_does_not_matter(knowledge, found, seen):
    generator = np.random.default_rng(6)
    picks = generator.permutation(len(found.looks))[:16]
    at = sensitivity(WORST, knowledge.z, knowledge.space, knowledge.rig.table, seen.mirror_angles_rad.mean(axis=0))
    values = []
    for order in (picks, generator.permutation(picks)):
        path = arrange(found.looks[order], knowledge.sheets, found.overshoot).path
        information = information_of_looks(seen, order, path, knowledge.space, False)
        values.append(at.value(covariance_of(knowledge.precision + information)))
    assert values[1] == pytest.approx(values[0], rel=ROUNDING)


def test_mirroring_a_counter_swaps_names(mounted_rig, knowledge):
    """A motor that counts the other way: the same beams, left and right exchanged."""
    steps = tuple(s for s in four_point_protocol(3, approaches={"left": ("reversed",)}))
    assert steps[2].action != "look"
    mirrored = tuple(
        replace(s, pan_steps=-s.pan_steps) if s.action in ("move", "home") and s.pan_steps is not None else s
        for s in steps
    )
    turned = prior_knowledge(with_priors(mounted_rig, degrees_per_step__pan=Prior(-0.06, 0.01)))
    u, v = u_of(steps, knowledge), u_of(mirrored, turned)
    names = list(QUANTITIES)
    swapped = {"left": "right", "right": "left"}
    expected = [u[names.index(swapped.get(name, name))] for name in names]
    assert v == pytest.approx(expected, rel=1e-6)
    assert abs(u[0] / u[1] - 1) > 1e-4, "left and right differ, or the law would be empty"


def test_looks_that_miss_an_image_tell_nothing(knowledge):
    """1000 steps turn the beam by 60 degrees, out of the images."""
    steps = list(paper_protocol(1))
    more = (*steps, PlanStep(len(steps), "move", 1000, 0), PlanStep(len(steps) + 1, "look"))
    information = information_of(more, knowledge)
    assert not information.expectation.seen[-1]
    assert information.expectation.seen[:-1].all()
    assert information.fisher == pytest.approx(information_of(steps, knowledge).fisher, rel=ROUNDING)


def test_truths_have_coordinates(mounted_rig, knowledge):
    drawn = draw_truth(mounted_rig, np.random.default_rng(8))
    truth = truth_in(knowledge, drawn.parameters, drawn.stereo.vector)
    physical = physical_at(truth.z, truth.space).value
    for name, index in INDEX.items():
        true = drawn.parameters.get(name)
        if true is not None:
            assert physical[index] == pytest.approx(true, rel=ROUNDING, abs=ROUNDING), name
    assert physical[-24:] == pytest.approx(drawn.stereo.vector, rel=ROUNDING, abs=1e-6)


def test_other_noise_scales_need_no_new_look(knowledge, found, seen):
    """Looks whitened anew for other stop errors and pixels carry the information that looking again would give."""
    family = Family(knowledge, found, np.arange(len(found.looks)), False)
    assurance = Assurance(family, WORST, 1, 0)
    truth = DrawnTruth(knowledge.z, knowledge.space)
    z = knowledge.z.copy()
    z[[*STOP_COLUMNS.ravel(), PIXEL_COLUMN]] = (0.7, -1.1, 0.4, 1.3, -0.6)
    again = assurance.arrays.at(z, knowledge.space).rows
    quick = assurance._rescaled(assurance.arrays.at(truth.z, truth.space), truth, z).rows
    one, other = (np.einsum("mij,mik->jk", rows, rows) for rows in (again, quick))
    assert np.abs(one - other).max() < ROUNDING * np.abs(one).max()
    before = np.einsum("mij,mik->jk", seen.rows, seen.rows)
    assert np.abs(one - before).max() > 0.1 * np.abs(one).max(), "the scales matter, or the law would be empty"


def test_a_noise_scale_is_believed_by_the_weight_of_the_stops(knowledge, found, seen):
    """Thousands of stops tell the true sd; none leave the prior's median; the scatter is 1 / sqrt(2 n)."""
    true = knowledge.z.copy()
    columns = STOP_COLUMNS.ravel()
    true[columns] = 1.5
    truth, exact = DrawnTruth(true, knowledge.space), np.zeros((PARAMETERS, PARAMETERS))
    many = np.tile(np.arange(len(found.looks)), 40)

    def believed(chosen, noise):
        taken = Seen(*(getattr(seen, n)[chosen] for n in ("rows", "slope", "seen", "mirror_angles_rad")))
        side = found.looks.side[chosen]
        return forecast.believed(truth, taken, side, exact, knowledge, np.full(5, noise))[columns]

    assert believed(many, 0.0) == pytest.approx(1.5, abs=0.01)
    assert (np.abs(believed(many[:1], 0.0)) < 1.5).all()
    per_direction = len(many) / 2
    # Stops of 0.18 deg against pixels: what pixels leave open lowers the information by a few per cent.
    assert believed(many, 1.0) - believed(many, 0.0) == pytest.approx(1 / math.sqrt(2 * per_direction), rel=0.1)


def test_what_the_geometry_takes_from_the_stops_is_not_left_for_their_scatter(knowledge, found, seen):
    """Less p for n: with every geometric coordinate determined by L looks, 1 - p / (2 L) of the information is left."""
    columns = STOP_COLUMNS.ravel()
    true = knowledge.z.copy()
    true[columns] = 1.5
    truth = DrawnTruth(true, knowledge.space)
    chosen = np.resize(np.arange(len(found.looks)), 60)
    taken = Seen(*(getattr(seen, n)[chosen] for n in ("rows", "slope", "seen", "mirror_angles_rad")))
    side = found.looks.side[chosen]

    def scatter(covariance):
        low, high = (
            forecast.believed(truth, taken, side, covariance, knowledge, np.full(5, x))[columns] for x in (0.0, 1.0)
        )
        return high - low

    exact = np.zeros((PARAMETERS, PARAMETERS))
    geometry = ~NOISE_COLUMNS & (np.arange(PARAMETERS) < len(RIG_NAMES))
    # Nothing is learned where the covariance is the prior's; a precision of 0 is a coordinate held fixed.
    precision = np.diag(knowledge.precision)
    unknown = np.diag(np.divide(1.0, precision, out=np.zeros(PARAMETERS), where=precision > 0))
    left_over = 1 - np.sum(geometry & (precision > 0)) / (2 * seen.seen[chosen].sum())
    # Scatter is 1 / sqrt(information) but for the prior, which 30 stops of a direction outweigh 50 times.
    assert scatter(exact) / scatter(unknown) == pytest.approx(1 / math.sqrt(left_over), rel=0.03)


# Targets.


def test_targets_are_read():
    assert parse_target("u(left) <= 2e-4 deg/step") == Target("u(left) <= 2e-4 deg/step", "left", 1.0, 2e-4, "deg/step")
    point = parse_target("  U95(x)  at 1000, 0,-2.5 mm <= 60 mm ")
    assert (point.quantity, point.point_mm, point.limit) == ("x", (1000.0, 0.0, -2.5), 60.0)
    assert point.factor == pytest.approx(1.96, abs=1e-3)
    assert parse_target("u(backlash.tilt)<=.05deg").unit == "deg"


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("left <= 2e-4", "not of that form"),
        ("u(left) < 2e-4 deg/step", "not of that form"),
        ("u(left) <= 2e-4 mm", "in deg/step, not mm"),
        ("u(leftt) <= 2e-4 deg/step", "no quantity leftt"),
        ("u(left) <= 0 deg/step", "the limit 0"),
        ("u(left) <= -1 deg/step", "the limit -1"),
        ("u(left) <= 1e999 deg/step", "the limit inf"),
        ("u(left) <= 1e-300 deg/step", "the limit 1e-300"),
        ("U95(x) at 1e999,0,0 mm <= 60 mm", "too far away"),
        ("U95(x) at 0,0,-2e9 mm <= 60 mm", "too far away"),
        ("U95(x) <= 60 mm", "name the point"),
        ("u(left) at 1,2,3 mm <= 2e-4 deg/step", "leave the point out"),
        ("u(left) <= nan deg/step", "not of that form"),
        ("u(left) <= \u0661 deg/step", "not of that form"),
        ("u(left) <= 1 deg/step" + " " * 500, "not of that form"),
        ("", "not of that form"),
    ],
)
def test_other_targets_are_refused_with_what_is_allowed(text, word):
    with pytest.raises(InputError) as refused:
        parse_target(text)
    assert word in refused.value.message
    assert "U95(NAME) <= NUMBER UNIT" in refused.value.allowed


def test_a_point_has_its_own_uncertainty(knowledge):
    """A perfect calibration keeps stop and reading: dx = d^2 / b times their angles, b = a - L between the lines."""
    target = parse_target("u(x) at 1000,0,0 mm <= 60 mm")
    at = sensitivity(target, knowledge.z, knowledge.space, knowledge.rig.table, np.zeros(2))
    base_mm, stop_rad, reading_rad = 200.0 - 30.0, math.radians(0.04), math.radians(0.02)
    from_beam_mm2, from_aperture_mm2 = 1000.0**2 + 70.0**2, 1000.0**2 + 100.0**2
    expected_mm = math.hypot(stop_rad * from_beam_mm2, reading_rad * from_aperture_mm2) / base_mm
    # The tilt's stop enters x to second order; small angles of the triangle are left out: (b / d)^2 = 3 %.
    assert at.value(np.zeros((PARAMETERS, PARAMETERS))) == pytest.approx(expected_mm, rel=0.03)
    assert at.value(knowledge.covariance) > 10 * expected_mm


@pytest.mark.parametrize("convention", ["in-plane", "azimuth"])
def test_stops_and_reading_at_a_point_are_those_of_the_twins_optics(mounted_rig, convention):
    """Beam and aperture of the twin, each angle moved by its sd: x, y and z by finite differences, axis by axis."""
    point_mm = (900.0, 50.0, 250.0)
    stops = {f"stop_sd_deg.{d}": Prior(sd, 1.0, "log-normal") for d, sd in zip(DIRECTIONS, (3, 5, 4, 7), strict=True)}
    rig = with_priors(mounted_rig, **{name: replace(p, value=0.01 * p.value) for name, p in stops.items()})
    table = replace(rig.table, aperture_convention=convention)
    known = prior_knowledge(replace(rig, table=table))
    values = {name: prior.value for name, prior in table.priors.items()}
    base_mm, reading_deg = values["baseline_mm"], float(aperture_angle_deg(point_mm, 200.0, convention))

    def ray(angles_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        origin, direction = mirror_chain(*angles_rad, values)
        ends = to_tvs(np.stack([origin, origin + direction]), base_mm, values["pan_zero_emission_deg"])
        return ends[0], ends[1] - ends[0]

    def passes(angles_rad: np.ndarray) -> np.ndarray:
        origin, direction = ray(angles_rad)
        return np.cross(direction, np.array(point_mm) - origin)[1:]

    aimed = optimize.fsolve(passes, np.radians([0.0, 10.0]), xtol=1e-13)

    def seen_at(pan_deg: float, tilt_deg: float, aperture_deg: float) -> np.ndarray:
        """Where beam and reading meet, frame T, mm."""
        origin, direction = ray(aimed + np.radians([pan_deg, tilt_deg]))

        def excess_deg(reach_mm: float) -> float:
            found = aperture_angle_deg(origin + reach_mm * direction, base_mm, convention)
            return float(found) - reading_deg - aperture_deg

        return origin + optimize.brentq(excess_deg, 500.0, 2000.0, xtol=1e-10) * direction

    assert seen_at(0, 0, 0) == pytest.approx(point_mm, abs=1e-6)
    # Central differences: the step moves the point by 3e-4 of its distance, the third derivative by its square.
    step_deg = 0.01
    moved = np.array([(seen_at(*step) - seen_at(*-step)) / (2 * step_deg) for step in step_deg * np.eye(3)])
    # By default a point is reached left and up.
    stop_mm2 = (moved[0] * 0.03) ** 2 + (moved[1] * 0.04) ** 2
    reading_mm2 = (moved[2] * values["aperture_sd_deg"]) ** 2
    target = parse_target("u(xyz) at 900,50,250 mm <= 1 mm")
    at = sensitivity(target, known.z, known.space, table, np.zeros(2))
    # The machine stands at whole counters, up to half a step beside the point.
    half_step_rad = math.radians(values["degrees_per_step.tilt"]) / 2
    for cause, variance_mm2 in zip(AT_POINT, (stop_mm2, reading_mm2), strict=True):
        assert at.own[cause] == pytest.approx(variance_mm2, abs=half_step_rad * variance_mm2.max()), cause
    assert (moved[1] * 0.04)[2] ** 2 > 0.1 * stop_mm2[2], "tilt counts, or it could be left out"


# Search.


def test_greedy_takes_the_best_look_and_exchange_never_worsens():
    generator = np.random.default_rng(9)
    rows, gradient = generator.normal(size=(12, 4, 6)), generator.normal(size=(2, 6))
    search = Search(rows, np.diag([1.0, 2, 3, 4, 5, 6]), gradient, np.zeros(2))
    one = [search.value([k]) for k in range(12)]
    picks = search.greedy(4)
    assert picks[0] == int(np.argmin(one))
    assert search.after_one_more(search.covariance) == pytest.approx(one, rel=ROUNDING)
    every = min(search.value([a, b, c]) for a in range(12) for b in range(a, 12) for c in range(b, 12))
    exchanged = search.exchange(picks[:3])
    assert every * (1 - ROUNDING) <= search.value(exchanged) <= search.value(picks[:3])
    assert search.value(exchanged) < 1.05 * every
    worst = 3 * [int(np.argmax(one))]
    assert search.value(search.exchange(worst)) < 1.05 * every < 0.9 * search.value(worst)


@pytest.mark.parametrize("criterion", CRITERIA)
def test_a_quantity_without_variance_does_not_steer_a_search(criterion):
    generator = np.random.default_rng(10)
    rows, gradient = generator.normal(size=(12, 4, 6)), generator.normal(size=(3, 6))
    gradient[1] = 0
    with_fixed, without = (
        Search(rows, np.eye(6), g, np.zeros(len(g)), criterion) for g in (gradient, gradient[[0, 2]])
    )
    assert with_fixed.greedy(4) == without.greedy(4)
    assert math.isfinite(with_fixed.value([0, 1]))


def test_criteria_are_what_they_say():
    covariance, reference = np.array([[4.0, 1.0], [1.0, 2.0]]), np.array([8.0, 2.0])
    assert scores(covariance, reference, "c") == pytest.approx(4.0 + MEAN_WEIGHT * 3.0)
    assert scores(covariance, reference, "A") == pytest.approx((4 / 8 + 2 / 2) / 2)
    assert scores(covariance, reference, "D") == pytest.approx(math.log(7.0 / 16.0))


def test_limits_are_kept(mounted_rig, found):
    """Stated limits bind every counter of a plan, run-ups included; without them the grid's own range does."""
    tight = {"pan_min_steps": 0, "pan_max_steps": 150, "tilt_min_steps": -70, "tilt_max_steps": 90}
    known = prior_knowledge(replace(mounted_rig, positioner=tight))
    inside = candidates(known)
    arranged = arrange(inside.looks, known.sheets, inside.overshoot)
    moves = np.array([(s.pan_steps, s.tilt_steps) for s in arranged.steps if s.action == "move"])
    low, high = np.array([0, -70]), np.array([150, 90])
    # The images reach beyond these limits: the outermost looks stand on them, and no run-up goes past.
    for counters in (moves, inside.looks.steps):
        assert (counters.min(axis=0) == low).all() and (counters.max(axis=0) == high).all()
    assert not inside.notes
    assert "pan_min_steps" in found.notes[0] and "pan -100 to 280" in found.notes[0]
    assert np.abs(found.looks.steps).max() <= 280


def test_every_look_is_reached_from_its_side(found, knowledge):
    arranged = arrange(found.looks, knowledge.sheets, found.overshoot)
    assert [s.target for s in arranged.steps if s.action == "place"] == list(knowledge.sheets)
    counters, last, row = np.zeros(2, dtype=int), np.zeros(2, dtype=int), 0
    for step in arranged.steps:
        if step.action == "move":
            last = np.array([step.pan_steps, step.tilt_steps]) - counters
            counters = counters + last
        elif step.action == "look":
            look = arranged.order[row]
            assert (counters == found.looks.steps[look]).all()
            assert (last * found.looks.side[look] >= found.overshoot).all()
            row += 1
    assert row == len(found.looks)


@pytest.fixture(scope="module")
def wide(mounted_rig):
    """A rig that can look at everything again a full turn away, and knows its ratio well enough to find it."""
    limits = {"pan_min_steps": -200, "pan_max_steps": 6400, "tilt_min_steps": -130, "tilt_max_steps": 130}
    return with_priors(replace(mounted_rig, positioner=limits), degrees_per_step__pan=Prior(0.06, 1e-5))


def test_next_looks_are_worth_what_they_say_here_and_a_full_turn_away(wide):
    """As many looks a turn away as here: 6000 steps of 0.06 deg. Gains are those of the plan judged move by move."""
    known = prior_knowledge(wide)
    found = candidates(known)
    seen = LookArrays(found.looks, known, False).at(known.z, known.space)
    target = parse_target("u(left) <= 1e-5 deg/step")
    pose = seen.mirror_angles_rad.mean(axis=0)
    at = sensitivity(target, known.z, known.space, wide.table, pose)
    now = at.value(known.covariance)
    batches = next_experiments(known, found, seen, target, at, now)
    turned = [batch for batch in batches if batch.text.startswith("a full turn of pan away, ")]
    assert turned and len(turned) < len(batches)
    for batch in batches:
        log = run_plan(batch.actions, wide, HOME_APPROACH)
        pan = [log.moves[look.move].pan_steps for look in log.looks]
        assert len(pan) == LOOKS_PER_EXPERIMENT
        assert min(pan) > 3000 or batch not in turned
        # The text names the looks' own counters.
        assert all(f"({steps}, " in batch.text for steps in pan)
        judged = planner.judged("", information_of(batch.actions, known), known, target, pose)
        assert batch.gain == pytest.approx(now - judged.joint, rel=1e-6)
        assert batch.minutes == judged.minutes and batch.gain_per_minute == batch.gain / batch.minutes


def test_a_full_turn_waits_until_the_ratio_is_known(mounted_rig):
    """Two stops over 360 deg hold k to a stop error over 6000 steps, whatever the cameras; once the spot is found."""
    limits = {"pan_min_steps": -100, "pan_max_steps": 6100, "tilt_min_steps": -130, "tilt_max_steps": 130}
    wide = replace(mounted_rig, positioner=limits)
    unknown = candidates(prior_knowledge(wide))
    assert not unknown.turned.any()
    assert "not yet known well enough" in " ".join(unknown.notes)
    sharp = prior_knowledge(with_priors(wide, degrees_per_step__pan=Prior(0.06, 1e-5)))
    turned = candidates(sharp)
    assert np.array_equal(turned.turned, turned.looks.steps[:, 0] > 3000)
    assert turned.turned.any() and turned.looks.steps.max() <= 6100
    vague = prior_knowledge(with_priors(wide, degrees_per_step__pan=Prior(0.06, 1e-3)))
    away = np.flatnonzero(turned.looks.steps[:, 0] > 3000)[:2]
    twins = turned.looks.steps[away] - np.array([6000, 0])
    looks = Looks(
        np.concatenate([turned.looks.steps[away], twins]),
        np.tile(turned.looks.side[away], (2, 1)),
        np.tile(turned.looks.sheet[away], 2),
    )
    steps = arrange(looks, vague.sheets, turned.overshoot).steps
    ratio = parse_target("u(left) <= 1e-5 deg/step")
    information = information_of(steps, vague)
    covariance = covariance_of(vague.precision + information.fisher)
    # The whole way out went left: it is k_left = k + c / 2 that the turn measures.
    left = np.zeros(PARAMETERS)
    left[[INDEX["degrees_per_step.pan"], INDEX["ratio_contrast_deg_per_step.pan"]]] = 1e-3, 1e-4
    k = math.sqrt(left @ covariance @ left)
    stop_deg = 0.04
    assert k < 2 * stop_deg / 6000
    at = sensitivity(ratio, vague.z, vague.space, vague.rig.table, information.pose_rad)
    assert at.value(covariance) > 10 * k, "the slope of the beam still hangs on the mirrors"


def test_a_search_after_data_knows_no_home_offset(knowledge, found, seen):
    """Offsets of the new session are two columns with the variance of homing: eliminated, they leave the exact sum."""
    known = replace(knowledge, after_data=True)
    rows = seen.rows.copy()
    rows[..., CONTRAST_COLUMNS] = 0
    shown, picks = replace(seen, rows=rows), np.arange(6)
    wide, precision = search_rows(shown, known)
    whole = covariance_of(precision + np.einsum("mij,mik->jk", wide[picks], wide[picks]))[:PARAMETERS, :PARAMETERS]
    exact = information_of_looks(shown, picks, np.zeros((6, 2)), knowledge.space, True)
    contrasts = np.isin(np.arange(PARAMETERS), CONTRAST_COLUMNS)
    expected = covariance_of(known.precision + exact + KNOWN * np.diag(contrasts))
    assert whole == pytest.approx(expected, rel=ROUNDING, abs=ROUNDING * expected.max())
    without = information_of_looks(shown, picks, np.zeros((6, 2)), knowledge.space, False)
    assert np.abs(without - exact).max() > 1e-3 * np.abs(exact).max(), "offsets count, or they could be left out"


@pytest.fixture(scope="module")
def refine(knowledge, found, seen):
    """(first choice, limit, minutes) -> reported values of that choice, and what became of it."""

    def run(picks, limit, minutes=None):
        target = replace(parse_target("u(left) <= 1 deg/step"), limit=limit)
        family = Family(knowledge, found, np.asarray(picks), False)
        pose = seen.mirror_angles_rad.mean(axis=0)
        at = sensitivity(target, knowledge.z, knowledge.space, knowledge.rig.table, pose)
        assurance = Assurance(family, target, 10, 3)
        plain = assurance.values([2])[2]
        return plain, search.refine(family, seen, target, at, 2, Scope(minutes=minutes), assurance)

    return run


@pytest.fixture(scope="module")
def poor(found):
    """Eight looks at one sheet, all at one place: they tell nothing of the ratio."""
    return np.full(2 * LOOKS_PER_EXPERIMENT, np.flatnonzero(found.looks.sheet == 1)[0])


def test_exchanges_are_kept_where_they_raise_assurance_or_lower_the_median(refine, poor):
    plain, refined = refine(poor, 1e-9)
    values = refined.reported
    assert np.median(values) < 0.9 * np.median(plain) and not np.array_equal(refined.family.picks, poor)
    between = 0.5 * (np.median(values) + plain.min())
    assert np.mean(plain <= between) < np.mean(values <= between)
    assert np.array_equal(refine(poor, between)[1].reported, values)


def test_exchanges_that_cost_assurance_or_time_are_not_kept(refine, poor, monkeypatch):
    better = refine(poor, 1e-9)[1]
    plain, late = refine(poor, 1e-9, minutes=0.0)
    assert np.array_equal(late.family.picks, poor) and np.array_equal(late.reported, plain)
    monkeypatch.setattr(Search, "exchange", lambda self, picks: list(poor))
    plain, kept = refine(better.family.picks, 1e-9)
    assert np.array_equal(kept.family.picks, better.family.picks)
    assert np.array_equal(kept.reported, plain) and np.array_equal(plain, better.reported)


# The plan.


@pytest.fixture(scope="module")
def result(knowledge):
    target = parse_target("u(worst) <= 5e-4 deg/step")
    scope = Scope(largest=12)
    return plan_from(knowledge, target, scope=scope, draws=20, seed=1)


def test_the_curve_is_monotone(result):
    curve = result.curve
    assert [p.experiments for p in curve] == sorted({p.experiments for p in curve})
    for before, after in pairwise(curve):
        assert after.minutes > before.minutes
        assert after.joint <= before.joint
        assert after.assurance >= before.assurance
        assert before.classic is None or after.classic < before.classic
    assert curve[-1].classic is not None
    assert all(p.assurance_se == share_error(p.assurance, 20) for p in curve)
    assert result.n80 <= result.n95 <= 12
    reached = {p.experiments: p.assurance for p in curve}
    assert reached[result.n80] >= 0.8 and reached[result.n95] >= 0.95


def test_the_plan_runs_through_the_twin(result, mounted_rig, tmp_path):
    write_plan(result.steps, tmp_path / "plan.csv")
    steps = read_plan(tmp_path / "plan.csv")
    assert steps == result.steps
    assert sum(s.action == "look" for s in steps) == result.looks == 4 * result.experiments
    assert result.minutes == pytest.approx(plan_minutes(steps, mounted_rig))
    run = simulate(mounted_rig, steps, 3)
    assert sum(s.status == "ok" for s in run.campaign.spots) >= 0.9 * result.looks


def test_the_plan_beats_the_baselines(result):
    by_name = {b.name: b for b in result.baselines}
    assert set(by_name) == {"planned", "paper", "mixed", "grid"}
    assert by_name["planned"].minutes < 0.1 * by_name["paper"].minutes
    assert by_name["planned"].joint < by_name["paper"].joint
    assert by_name["planned"].joint == result.expected <= result.target.limit
    assert result.met and result.assurance >= 0.8


def test_the_document_has_the_contracts_keys(result):
    document = json.loads(json.dumps(result.as_json(), allow_nan=False))
    assert {"target", "curve", "n80", "n95", "limited_by", "next", "stop"} <= set(document)
    assert set(document["curve"][0]) == {"experiments", "minutes", "classic", "joint", "assurance", "assurance_se"}
    assert {"actions", "gain_per_minute"} <= set(document["next"][0])
    assert {a["action"] for a in document["next"][0]["actions"]} == {"home", "place", "move", "look"}
    assert sum(document["variance_shares"].values()) == pytest.approx(1.0, abs=1e-6)
    assert "floor" in plan_text(result)


def test_the_text_names_the_plan_and_what_was_not_reached(result):
    text = plan_text(result)
    assert f"the plan: n = {result.experiments}, {result.looks} looks" in text
    last = result.curve[-1].experiments
    assert f"assurance 95 %: not reached with up to {last} experiments" in plan_text(replace(result, n95=None))


def test_no_number_of_draws_makes_an_assurance_certain():
    """At 0 and 1 the standard deviation of Beta(1/2, n + 1/2); between them the binomial's."""
    from scipy import stats

    for draws in (20, 200):
        assert share_error(1.0, draws) == share_error(0.0, draws)
        assert share_error(0.0, draws) == pytest.approx(stats.beta(0.5, draws + 0.5).std(), rel=1e-12)
        assert share_error(0.8, draws) == pytest.approx(stats.binom(draws, 0.8).std() / draws, rel=1e-12)


def test_gain_per_minute_falls_in_order(result):
    gains = [batch.gain_per_minute for batch in result.next]
    assert gains == sorted(gains, reverse=True) and gains[0] > 0
    assert all(b.gain_per_minute == pytest.approx(b.gain / b.minutes) for b in result.next)


def test_a_target_below_the_floor_names_the_term_and_what_would_do(mounted_rig):
    """Exact cameras of unknown focal scale, known mechanics, one depth: the scale limits, and its cure is enough.

    4 degrees of pan, seen to a pixel, are too few to tell the scale from the ratio.
    """
    free = ("degrees_per_step", "backlash", "stop_sd", "pixel_scale", "focal_scale")
    priors = mounted_rig.table.priors
    held = {name: replace(prior, u=0.0) for name, prior in priors.items() if not name.startswith(free)}
    exact = replace(mounted_rig.stereo, parameter_covariance=np.zeros_like(mounted_rig.stereo.parameter_covariance))
    small = {f"backlash_deg.{axis}": Prior(0.0, 0.05, "half-normal") for axis in ("pan", "tilt")}
    rig = replace(
        with_priors(mounted_rig, **held, **small),
        stereo=exact,
        sheets_mm={"d2": 275.0},
        positioner={"pan_min_steps": 270, "pan_max_steps": 330, "tilt_min_steps": -50, "tilt_max_steps": 50},
        cameras={**mounted_rig.cameras, "spot_sd_px": 1.0},
    )
    looks = candidates(prior_knowledge(rig)).looks
    once = np.linspace(0, len(looks) - 1, 2 * LOOKS_PER_EXPERIMENT).astype(int)

    def limit(focal_scale_u: float, limit: float) -> Limit:
        known = prior_knowledge(with_priors(rig, focal_scale=Prior(1.0, focal_scale_u)))
        shown = LookArrays(looks, known, False).at(known.z, known.space)
        path = np.zeros((len(once), 2))
        information = information_of_looks(shown, once, path, known.space, False)
        target = replace(parse_target("u(left) <= 1 deg/step"), limit=limit)
        at = sensitivity(target, known.z, known.space, known.rig.table, shown.mirror_angles_rad.mean(axis=0))
        return limit_of(known, information, at, target)

    reachable = limit(0.002, 1.0)
    assert reachable.reachable and reachable.needed is None
    assert sum(reachable.shares.values()) == pytest.approx(1.0, abs=1e-6)
    wanted = 0.8 * reachable.floor
    short = limit(0.002, wanted)
    assert not short.reachable and short.cause == "focal scale" and short.floor == reachable.floor
    needed = re.fullmatch(r"it would do to know u\(focal_scale\) = (\S+) instead of 0\.002", short.needed)
    assert limit(float(needed[1]), wanted).floor <= wanted
    # Two digits rounded down: the next number is too large.
    last = 10.0 ** (math.floor(math.log10(float(needed[1]))) - 1)
    assert not limit(float(needed[1]) + last, wanted).reachable


def test_no_calibration_removes_the_stop_at_the_point(knowledge, seen, found):
    target = parse_target("U95(x) at 1000,0,0 mm <= 0.5 mm")
    at = sensitivity(target, knowledge.z, knowledge.space, knowledge.rig.table, np.zeros(2))
    path = arrange(found.looks, knowledge.sheets, found.overshoot).path
    information = information_of_looks(seen, np.arange(len(found.looks)), path, knowledge.space, False)
    limit = limit_of(knowledge, information, at, target)
    assert not limit.reachable and "at the point itself" in limit.needed


def test_a_plan_for_one_ratio_says_what_it_leaves_open():
    side = np.array([[1, 1]] * FEW_STOPS + [[-1, 1]] * (FEW_STOPS - 1))
    notes = few_looks(
        Looks(np.zeros_like(side), side, np.zeros(len(side), dtype=int)), parse_target("u(left) <= 1 deg/step")
    )
    assert [note.split(":")[0] for note in notes] == [f"only {FEW_STOPS - 1} stops right", "only 0 stops down"]


def test_when_to_stop():
    target, open_end = parse_target("u(left) <= 2e-4 deg/step"), Limit(1e-5, "focal scale", {}, True, None)
    good, poor = (Batch((), 1.0, g, g, "") for g in (1e-5, 1e-8))
    assert stop_now(1e-4, target, open_end, (good,), True).now
    assert not stop_now(1e-4, target, open_end, (good,), False).now, "nothing was measured yet"
    assert not stop_now(3e-4, target, open_end, (good,), True).now
    assert stop_now(3e-4, target, open_end, (poor,), True).now
    floor = replace(open_end, floor=2.5e-4, reachable=False)
    assert stop_now(3e-4, target, floor, (good,), True).now
    assert "floor" in stop_now(3e-4, target, floor, (good,), False).reason


def test_after_data_the_next_session_starts_from_what_is_known(knowledge):
    """A campaign of the paper's kind leaves the tilt: the next looks help most, and more than the first would again."""
    taught = information_of(paper_protocol(4), knowledge)
    known = replace(knowledge, precision=knowledge.precision + taught.fisher, after_data=True)
    target = parse_target("u(worst) <= 2e-4 deg/step")
    scope = Scope(largest=4, minutes=6.0)
    result = plan_from(known, target, None, taught.pose_rad, scope=scope, draws=20, seed=2)
    assert result.now > target.limit and not result.stop.now
    assert result.expected < 0.7 * result.now
    assert result.minutes <= 6.0
    assert "the campaign and its priors" in result.shares
    assert result.steps[0].action == "home"
    enough = plan_from(known, replace(target, limit=1.0), None, taught.pose_rad, scope=scope, draws=20, seed=2)
    assert enough.stop.now and enough.met and enough.steps == ()
    assert enough.assurance is None and "nothing is left to do" in plan_text(enough)


def test_too_few_minutes_are_refused(knowledge):
    scope = Scope(largest=2, minutes=0.5)
    with pytest.raises(InputError, match="one experiment of four looks takes"):
        plan_from(knowledge, WORST, scope=scope, draws=20, seed=0)


@pytest.mark.parametrize(
    ("sd", "half_width"),
    [(1.0, 1.0), (1.0, 0.53), (1.0, 0.82), (1.0, 1.45), (1.0, 0.42), (1.0, 3.0), (5e-4, 2e-4), (1.0, 0.02)],
)
def test_the_classics_count_is_the_first_that_suffices(sd, half_width):
    from scipy import stats

    def suffices(n: int) -> bool:
        return stats.t.ppf(0.975, n - 1) * sd / math.sqrt(n) <= half_width

    n = classic_count(sd, half_width)
    assert suffices(n)
    assert n == 2 or not suffices(n - 1)


def test_a_quantity_held_fixed_is_no_target(mounted_rig):
    known = prior_knowledge(with_priors(mounted_rig, backlash_deg__pan=Prior(0.0, 0.0, "half-normal")))
    with pytest.raises(InputError, match=r"backlash.pan is held fixed"):
        plan_from(known, parse_target("u(backlash.pan) <= 0.1 deg"), scope=Scope(largest=1), draws=20, seed=0)


def test_limits_too_narrow_for_a_run_up_are_refused_with_its_length(mounted_rig):
    narrow = {"pan_min_steps": 0, "pan_max_steps": 20, "tilt_min_steps": -10, "tilt_max_steps": 10}
    rig = replace(mounted_rig, positioner=narrow)
    with pytest.raises(InputError, match="no look has room for a run-up of") as refused:
        candidates(prior_knowledge(rig))
    assert "[positioner]" in refused.value.remedy
    check = check_plan(rig, (PlanStep(0, "place", target="d1"), PlanStep(1, "look")))
    assert [f.addition for f in check.faults] == [(), ()]
    assert any("no cure can be sought on this rig" in w for w in check.warnings)


# What a plan leaves together.


def test_where_a_plan_stands_follows_the_twin(mounted_rig):
    """Empty counters keep an axis, homing ends left and up, and an axis that rests keeps its side."""
    steps = (
        *(PlanStep(0, "home", 0, 0), PlanStep(1, "place", target="d1"), PlanStep(2, "look")),
        *(PlanStep(3, "move", 100, 40), PlanStep(4, "move", 50, None), PlanStep(5, "look")),
    )
    assert described(mounted_rig, steps) == "d1: (0, 0) by left, up; (50, 40) by right, up"
    looks = Looks(np.array([[50, 60]]), np.array([[1, 1]]), np.array([0]))
    addition = extended(steps, looks, prior_knowledge(mounted_rig), np.array([30, 10]))
    # Tilt stands at 40: 20 steps up take up its play without a run-up; pan stands at its goal and needs one.
    assert [(s.action, s.pan_steps, s.tilt_steps) for s in addition[:-1]] == [("move", 20, 40), ("move", 50, 60)]
    assert described(mounted_rig, addition, steps) == "d1: (50, 60) by left, up"
    moves = run_plan((*steps, *addition), mounted_rig, ("left", "up")).moves
    assert [(m.pan_steps, m.tilt_steps) for m in moves] == [(0, 0), (100, 40), (50, 40), (20, 40), (50, 60)]


@pytest.mark.parametrize("fixed", ["ratio_contrast_deg_per_step", "backlash_deg"])
def test_what_the_rig_holds_fixed_has_no_contraction(mounted_rig, fixed):
    """The model with one ratio per axis (DESIGN 3.1) is such a rig."""
    given = mounted_rig.table.priors
    rig = with_priors(mounted_rig, **{f"{fixed}__{a}": replace(given[f"{fixed}.{a}"], u=0.0) for a in ("pan", "tilt")})
    check = check_plan(rig, grid_protocol(pan_steps=(0, 120, 240), tilt_steps=(-90, 0, 90)))
    name = "contrast" if fixed.startswith("ratio") else "backlash"
    document = json.loads(json.dumps(check.as_json(), allow_nan=False))
    assert {k for k, share in document["contraction"].items() if share is None} == {f"{name}.pan", f"{name}.tilt"}
    assert document["expected"][f"{name}.pan"] == 0 and not check.faults


def test_the_papers_protocol_leaves_ratio_and_backlash_together_and_is_cured(mounted_rig, monkeypatch):
    # Of three levels of tilt only the middle one leaves room for a run-up.
    monkeypatch.setattr("tvsbayes.planning.candidates.TILT_LEVELS", 5)
    steps = paper_protocol(12)
    check = check_plan(mounted_rig, steps)
    assert {fault.axis for fault in check.faults} == {"pan", "tilt"}
    for fault in check.faults:
        assert "add N = 100 or a cleared approach" in fault.text
        assert fault.addition and fault.after < 0.9 * fault.before
        again = check_plan(mounted_rig, (*steps, *fault.addition))
        assert fault.axis not in {f.axis for f in again.faults}
    json.dumps(check.as_json(), allow_nan=False)


def test_a_grid_is_not_blamed(mounted_rig):
    check = check_plan(mounted_rig, grid_protocol(pan_steps=(0, 120, 240), tilt_steps=(-90, -30, 30, 90)))
    assert check.faults == () and check.warnings == ()


def test_one_depth_and_one_side_are_named(mounted_rig):
    orders = [("home", 0, 0), ("place", None, None, "d1")]
    for pan in (40, 80, 120, 160, 200):
        orders += [("move", pan, pan // 2 - 60), ("look",)]
    steps = tuple(PlanStep(number, *order) for number, order in enumerate(orders))
    text = "\n".join(check_plan(mounted_rig, steps).warnings)
    assert "reached from one side" in text
    assert "one depth" in text and "place d2, d3" in text


def test_a_plan_beyond_the_limits_is_named(mounted_rig):
    rig = replace(mounted_rig, positioner={"pan_min_steps": 0, "pan_max_steps": 150})
    text = "\n".join(check_plan(rig, grid_protocol(pan_steps=(0, 240), tilt_steps=(-90, 90))).warnings)
    assert "[positioner] allows 0 to 150" in text


def test_limits_of_each_axis_and_end_count_where_they_are_stated(mounted_rig):
    plan = grid_protocol(pan_steps=(0, 240), tilt_steps=(-190, 190))
    moves = run_plan(plan, mounted_rig, ("left", "up")).moves

    def warned(**positioner) -> list[str]:
        return beyond_limits(CounterLimits.of(positioner), moves)

    assert warned() == []
    assert warned(pan_min_steps=-1000, pan_max_steps=1000) == [], "tilt is not limited"
    (tilt,) = warned(tilt_min_steps=-30, tilt_max_steps=30)
    assert tilt.startswith("tilt moves from ") and tilt.endswith("[positioner] allows -30 to 30")
    (pan,) = warned(pan_max_steps=100, tilt_min_steps=-1000)
    assert pan.endswith("[positioner] allows up to 100")


def test_a_plan_without_a_look_is_refused(mounted_rig):
    with pytest.raises(InputError, match="looks at nothing"):
        check_plan(mounted_rig, (PlanStep(0, "home", 0, 0),))


def test_a_rig_without_sheets_is_refused(mounted_rig):
    with pytest.raises(InputError, match="no sheets"):
        candidates(prior_knowledge(replace(mounted_rig, sheets_mm={})))


def test_moves_of_a_plan_are_those_the_twin_makes_of_it(mounted_rig, knowledge):
    log = run_plan(paper_protocol(1), mounted_rig, ("left", "up"))
    information = information_of(paper_protocol(1), knowledge)
    assert information.moves == tuple(log.moves)
    assert information.look_moves == tuple(look.move for look in log.looks)


# Commands.


@pytest.fixture
def ask(capsys, monkeypatch):
    """Run a command with --json without touching JAX's settings: exit code and document."""
    from tvsbayes.cli.main import run

    monkeypatch.setattr("tvsbayes.estimators.campaign_arrays.use_compilation_cache", lambda: False)
    monkeypatch.setattr("tvsbayes.studies.executors.use_compilation_cache", lambda: False)

    def command(*arguments) -> tuple[int, dict]:
        code = run([*map(str, arguments), "--json"])
        return code, json.loads(capsys.readouterr().out)

    return command


MOUNTED = shipped_data() / "rigs" / "mounted"


def test_plan_writes_a_plan_and_says_by_its_exit_code_whether_the_users_target_is_met(ask, tmp_path):
    small = ("--draws", 20, "--minutes", 3, "-o", tmp_path / "plan.csv")
    code, document = ask("plan", MOUNTED / "rig.toml", "--target", "u(left) <= 1e-7 deg/step", *small)
    assert code == 1 and not document["met"] and document["n80"] is None
    assert document["limited_by"]["reachable"] is False and document["limited_by"]["needed"]
    assert sum(s.action == "look" for s in read_plan(tmp_path / "plan.csv")) == document["looks"]
    assert document["minutes"] <= 3
    code, document = ask("plan", MOUNTED / "rig.toml", *small)
    assert code == 0 and not document["met"], "the default target is nobody's demand"
    code, document = ask("plan", MOUNTED / "rig.toml", "--target", "u(left) <= 5e-3 deg/step", *small)
    assert code == 0 and document["met"]


def test_a_plan_with_nothing_left_to_measure_says_that_it_wrote_none(capsys, tmp_path, monkeypatch):
    from tvsbayes.cli.main import run

    whole = planner.plan
    monkeypatch.setattr("tvsbayes.estimators.campaign_arrays.use_compilation_cache", lambda: False)
    monkeypatch.setattr("tvsbayes.studies.executors.use_compilation_cache", lambda: False)
    monkeypatch.setattr(
        "tvsbayes.planning.planner.plan", lambda *given, **options: replace(whole(*given, **options), steps=())
    )
    place = tmp_path / "plan.csv"
    code = run([*map(str, ("plan", MOUNTED / "rig.toml", "--draws", 20, "--minutes", 3, "-o", place))])
    assert code == 0 and not place.exists()
    assert f"nothing written to {place}" in capsys.readouterr().out


@pytest.mark.parametrize("options", [("--target", "u(left) <= 1 mm"), ("--criterion", "E"), ("--minutes", "0.2")])
def test_bad_options_of_plan_are_refused(ask, options):
    code, document = ask("plan", MOUNTED / "rig.toml", "--draws", 20, *options)
    assert code == 2
    assert document["error"]["column"] == options[0]
    assert document["error"]["allowed"] and document["error"]["remedy"]


def test_check_takes_a_rig_with_a_plan(ask):
    code, document = ask("check", MOUNTED / "rig.toml", MOUNTED / "grid.csv")
    assert code == 0 and document["kind"] == "rig with plan" and document["warnings"] == []
    assert set(document["expected"]) == set(QUANTITIES)
    code, document = ask("check", MOUNTED / "grid.csv", MOUNTED / "grid.csv")
    assert code == 2 and document["error"]["code"] == "usage"


def test_study_counts_and_answers_for_the_users_target(ask, tmp_path, monkeypatch):
    from studies.test_study import invented

    monkeypatch.setattr("tvsbayes.studies.study_job.study_row", invented)
    monkeypatch.setattr("tvsbayes.studies.executors.study_row", invented)
    rows = ("--n", 8, "--rows", tmp_path / "rows.jsonl")
    target = ("--target", "u(worst) <= 1e-3 deg/step")
    code, document = ask("study", MOUNTED / "rig.toml", MOUNTED / "grid.csv", *rows, *target)
    assert code == 1 and document["assurance"] == 0.75, "three of four invented fits meet it, 80 % are asked"
    assert document["campaigns"] == 8 and (tmp_path / "rows.jsonl").read_bytes().count(b"\n") == 8
    code, _ = ask("study", MOUNTED / "rig.toml", MOUNTED / "grid.csv", *rows)
    assert code == 0
    code, document = ask("study", MOUNTED / "rig.toml", MOUNTED / "grid.csv", "--engine", "cloud")
    assert code == 2 and document["error"]["column"] == "--engine"


def partly_cleared(repeats: int, cleared: int) -> tuple[PlanStep, ...]:
    """One |N| = 200; so many of every twelve starts are cleared, the others reversed."""
    turns = tuple("cleared" if 5 * turn % 12 < cleared else "reversed" for turn in range(12))
    return four_point_protocol(repeats, approaches=dict.fromkeys(DIRECTION_SIGNS, turns))


def test_plan_and_fit_judge_by_one_rule(mounted_rig):
    """At the edge: what is said of a plan is what a fit of its expected correlation says, and moves alone say no more.

    With 2 of 12 starts cleared the ratio and the backlash of both axes correlate by 0.51 to 0.56, with 4 by 0.37 to
    0.44. A fit at the very instrument of the plan, whose covariance is the plan's, judges the same numbers.
    """
    from tvsbayes.assessment import weaknesses

    for plan, together in ((partly_cleared(24, 2), True), (partly_cleared(24, 4), False)):
        judged, check = judge(plan, prior_knowledge(mounted_rig)), check_plan(mounted_rig, plan)
        assert {fault.axis for fault in check.faults} == ({"pan", "tilt"} if together else set())
        for axis in AXES:
            correlation = judged.exchange(axis)
            assert inseparable(correlation) == together and abs(correlation - INSEPARABLE) < 0.2
            if separation(judged.stops(axis), axis) is not None:
                assert together
    assert weaknesses.inseparable is inseparable
