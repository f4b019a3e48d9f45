"""Gears that repeat their errors, in planning: what places say of counters, and what plans do about it."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from support.coarse_planning import ROUNDING, with_priors
from support.commands import steps

from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.parameters import CREEP_NAMES, Prior, names_of
from tvsbayes.instrument.protocols import grid_protocol, paper_protocol
from tvsbayes.model.compiled import placed
from tvsbayes.model.gear_kriging import scales_at
from tvsbayes.model.gear_processes import Places
from tvsbayes.model.headlines import SeenLine, line_deg_per_step
from tvsbayes.model.laser_path import beam_angles
from tvsbayes.planning.assurance import Assurance, Family, instrument_gears, judged_z
from tvsbayes.planning.candidates import candidates
from tvsbayes.planning.drawn_rigs import Instruments, draw_instruments
from tvsbayes.planning.expectation import information_of, prior_knowledge
from tvsbayes.planning.gear_places import FittedErrors, GearPlaces, regular_places, windows_of
from tvsbayes.planning.limits import split_of
from tvsbayes.planning.looks import CONTRAST_COLUMNS, LookArrays, arrange, information_of_looks
from tvsbayes.planning.plan_check import check_plan
from tvsbayes.planning.planner import baseline_of
from tvsbayes.planning.search import DesignProblem
from tvsbayes.planning.target import GEARS_AT_POINT, STOP_AT_POINT, parse_target, sensitivity
from tvsbayes.statistics.gaussian_process import matern52
from tvsbayes.statistics.optimal_design import covariance_of

pytestmark = pytest.mark.usefixtures("small_searches")
LENGTH_DEG, PAN, TILT = 8.0, 0.06, 0.07
MIRRORS = names_of(
    *("mirror1_error_deg", "mirror2_error_deg", "laser_tilt_deg", "laser_offset_mm"),
    *("tilt_axis_skew_deg", "tilt_axis_offset_mm"),
)
ERRORS = [TWO_MIRROR.index[f"transmission_error_deg.{axis}"] for axis in ("pan", "tilt")]
WORST = parse_target("u(worst) <= 2e-4 deg/step")


@pytest.fixture(scope="module")
def real_rig(mounted_rig):
    """Gears with a transmission error of some 0.04 deg and a play that varies."""
    scales = {f"transmission_error_deg__{axis}": Prior(0.0, 0.05, "half-normal") for axis in ("pan", "tilt")}
    scales |= {f"play_variation_deg__{axis}": Prior(0.0, 0.02, "half-normal") for axis in ("pan", "tilt")}
    return with_priors(mounted_rig, **scales)


@pytest.fixture(scope="module")
def real(real_rig, small_searches):
    """Before any data, and the candidates over which its places lie."""
    bare = prior_knowledge(real_rig)
    pool = candidates(bare)
    return bare.with_gears(pool.looks.steps), pool


def some_places(error_deg=0.04, play_deg=0.02) -> GearPlaces:
    physical = np.zeros(len(TWO_MIRROR.names))
    for index, name in enumerate(TWO_MIRROR.names):
        block = name.split(".")[0]
        values = {"transmission_error_deg": error_deg, "play_variation_deg": play_deg}
        physical[index] = {**values, "transmission_error_length_deg": LENGTH_DEG}.get(block, 0.0)
    scales = scales_at(physical, np.full((2, 3), 360.0), TWO_MIRROR)
    reached = np.column_stack([np.linspace(0, 240, 9), np.linspace(-90, 90, 9)])
    return regular_places(reached, np.array([PAN, TILT]), scales)


def test_counters_between_places_are_the_process_itself():
    """Places no farther apart than a third of the length leave 5 % of the sd open; at a place nothing."""
    gears, counters = some_places(), np.array([0.0, 37.0, 120.0, 240.0])
    at = gears.between(counters, 0)
    correlation = matern52(np.subtract.outer(counters, counters) * PAN, LENGTH_DEG)
    known = at.error @ at.error.T
    assert known == pytest.approx(np.radians(0.04) ** 2 * correlation, abs=np.radians(0.04) ** 2 * 0.05**2)
    assert at.error_rest[[0, 3]] == pytest.approx(0, abs=1e-4 * np.radians(0.04))
    far = gears.between(np.array([6000.0]), 0)
    assert far.error_rest == pytest.approx(np.radians([0.04])) and far.play_rest == pytest.approx(np.radians([0.02]))
    turning = gears.turning(np.array([[37, -20]]), np.array([[1, -1]]))
    half = len(gears.steps)
    assert turning[0, 0, :half] == pytest.approx(at.error[1]) and turning[0, 0, half:] == pytest.approx(-at.play[1] / 2)
    assert np.all(turning[0, 0, np.tile(gears.on_tilt, 2)] == 0)


def test_a_full_turn_away_is_a_window_of_its_own_and_no_part_of_the_line():
    windows = windows_of(np.array([0, 100, 200, 6000, 6100, -6000]), PAN)
    assert [window.tolist() for window in windows] == [[0, 100, 200], [6000, 6100], [-6000]]
    gears = some_places()
    for axis, range_steps in ((False, 240), (True, 180)):
        mask = gears.on_tilt == axis
        assert np.ptp(gears.steps[mask]) == range_steps
        assert gears.share[mask] @ gears.steps[mask] == pytest.approx(1) and gears.share[mask].sum() == pytest.approx(0)


def test_a_line_through_looks_is_the_least_squares_line_of_what_places_carry():
    """Of any cubic over the counters of the first turn, which four places carry exactly; of lines over all turns."""
    reached = np.column_stack([np.append(np.linspace(0, 240, 9), [6000, 6120, 6240]), np.linspace(-90, 90, 12)])
    gears = regular_places(reached, np.array([PAN, TILT]), some_places().scales)
    generator = np.random.default_rng(11)
    steps = np.column_stack([generator.integers(0, 241, 20), generator.integers(-90, 91, 20)])
    weight = generator.integers(0, 3, (2, 20))
    turned = steps + np.array([6000, 0]) * (np.arange(20)[:, None] % 4 == 0)
    for row, taken in zip(gears.line_through(steps, weight), weight, strict=True):
        for axis, on_axis in ((0, ~gears.on_tilt), (1, gears.on_tilt)):
            cubic = np.poly1d(generator.standard_normal(4) / [1e6, 1e4, 1e2, 1])
            wanted = np.polyfit(steps[:, axis], cubic(steps[:, axis]), 1, w=np.sqrt(taken))[0]
            assert row[on_axis] @ cubic(gears.steps[on_axis]) == pytest.approx(wanted, rel=1e-9)
    far = gears.line_through(turned, weight[0])
    assert far[~gears.on_tilt] @ gears.steps[~gears.on_tilt] == pytest.approx(1)
    assert far[(gears.steps > 5000) & ~gears.on_tilt].any() and far.sum() == pytest.approx(0, abs=1e-12)
    still = gears.line_through(np.tile(steps[:1], (20, 1)), weight[0])
    assert not still.any(), "one counter has no line"


@pytest.mark.thorough
def test_a_ratio_is_the_sum_of_what_each_place_has_in_it(real):
    """The slope and its derivatives along any line, at one instrument: by the formula of fits itself, by differences.

    An axis without a line has the slope of its mirrors at the pose.
    """
    known, _ = real
    gears, pose = known.gears, np.radians([7.0, 3.0])
    z = known.z + 0.3 * np.random.default_rng(2).standard_normal(len(TWO_MIRROR.names))
    share = gears.line_through(np.array([[0, -60], [60, 20], [200, 75]]), np.ones(3))
    places = Places(placed(gears.steps), placed(gears.on_tilt), placed(np.ones(len(gears.steps), dtype=bool)))

    @jax.jit
    def traced(z, errors_rad, share):
        model = known.space.model(z)
        mirrors = beam_angles(model.optics, *jnp.asarray(pose))
        return line_deg_per_step(model, SeenLine(jnp.asarray(pose), places, share), errors_rad, mirrors)

    def slopes(z, errors, share):
        with jax.enable_x64(True):
            return np.asarray(traced(z, gears.root @ errors, share))

    nothing = np.zeros(gears.size)
    for one in (share, np.where(gears.on_tilt, 0.0, share), gears.share):
        headlines = replace(gears, share=one).headlines(z, known.space, pose)
        np.testing.assert_allclose(np.asarray(headlines.value)[:4], slopes(z, nothing, one), rtol=1e-12)
        step = np.random.default_rng(3).standard_normal(known.size)
        ends = [
            slopes(z + h * step[: len(TWO_MIRROR.names)], h * step[len(TWO_MIRROR.names) :], one) for h in (1e-5, -1e-5)
        ]
        wanted = (ends[0] - ends[1]) / 2e-5
        # Central differences of angles near 1 rad in float64: 1e-16 / 1e-5 in 100 steps, some 1e-11 deg/step.
        np.testing.assert_allclose(np.asarray(headlines.gradient)[:4] @ step, wanted, atol=1e-9)


@pytest.mark.thorough
def test_what_is_reported_of_real_gears_is_along_the_looks_by_the_instruments_own_scales(real):
    """Assurance of designs equals the plan judged move by move, on gears whose errors are as large as drawn.

    Neither the line over all candidates, nor over looks that the cameras miss, nor the prior scales would
    do: all give another u.
    """
    known, pool = real
    family = Family(known, pool, np.random.default_rng(4).integers(0, len(pool.looks), 24), False)
    drawn = draw_instruments(known, 3, 5)
    drawn.z[:, CONTRAST_COLUMNS] = 0.0
    # Looks count without creep, by the median of its time constant.
    drawn.z[:, [TWO_MIRROR.index[name] for name in CREEP_NAMES]] = 0.0
    # Cameras turned away from an eighth of the looks.
    drawn.z[2, TWO_MIRROR.index["extrinsics.rotation_rad.y"]] = 10.0
    assurance = Assurance(family, WORST, Instruments.at(drawn.z, drawn.value, drawn.common), 5)
    reported, steps = assurance.values([6])[6], family.arranged(6).steps
    for row in range(3):
        one, z, space = assurance.instruments[np.array([row])], drawn.z[row], drawn.space_of(row)
        mine = instrument_gears(known, one.physical[0])
        local = known.with_places(mine)
        assert local.gears.scales.error_rad == pytest.approx(np.radians(one.physical[0][ERRORS]))
        seen = LookArrays(assurance.looks, local, False).at(z, space)
        exact = information_of(steps, local, z=z, space=space)
        first = covariance_of(local.precision + exact.fisher)[None]
        at = judged_z(one, seen[None], assurance.looks.side, assurance.index, first, local, assurance.noise[None, row])[
            0
        ]
        baseline_of = covariance_of(local.precision + information_of(steps, local, z=at, space=space).fisher)
        pose = seen.mirror_angles_rad[assurance.index].mean(axis=0)
        planned = np.bincount(assurance.index)
        assert (planned * seen.seen).sum() < planned.sum() if row == 2 else seen.seen.all()

        def u(gears, covariance, z=z, space=space, pose=pose):
            return sensitivity(WORST, z, space, known.rig.table, pose, gears).value(covariance)

        lined = replace(mine, share=mine.line_through(assurance.looks.steps, planned * seen.seen))
        assert reported[row] == pytest.approx(u(lined, baseline_of), rel=ROUNDING)
        assert abs(u(mine, baseline_of) / reported[row] - 1) > 1e-3, "the line over all candidates is another"
        if row == 2:
            every = replace(mine, share=mine.line_through(assurance.looks.steps, planned))
            assert abs(u(every, baseline_of) / reported[row] - 1) > 1e-3, "so is that over looks which are missed"
        prior = covariance_of(known.precision + information_of(steps, known, z=at, space=space).fisher)
        common = replace(known.gears, share=lined.share)
        assert abs(u(common, prior) / reported[row] - 1) > 1e-3, "so are the scales believed beforehand"


def test_what_a_fit_says_at_its_places_is_carried_to_others():
    """Nothing taught leaves the prior; errors known at the fit's counters are known at those of the plan between."""
    gears = some_places(play_deg=0.0)
    old = replace(gears, steps=gears.steps * 0.9, share=gears.share / 0.9)
    nothing = np.eye(len(TWO_MIRROR.names) + old.size)
    assert FittedErrors(old, nothing).covariance_at(gears) == pytest.approx(
        np.eye(len(TWO_MIRROR.names) + gears.size), abs=1e-6
    )
    known = nothing.copy()
    known[len(TWO_MIRROR.names) :, len(TWO_MIRROR.names) :] *= 1e-6
    known[0, len(TWO_MIRROR.names)] = known[len(TWO_MIRROR.names), 0] = 1e-4
    left = (
        gears.root
        @ FittedErrors(old, known).covariance_at(gears)[len(TWO_MIRROR.names) :, len(TWO_MIRROR.names) :]
        @ gears.root.T
    )
    inside = np.abs(gears.steps) < 80
    count = len(gears.steps)
    assert np.sqrt(np.diag(left)[:count][inside]).max() < 0.1 * np.radians(0.04)
    follows = FittedErrors(old, known).covariance_at(gears)[0, len(TWO_MIRROR.names) :]
    assert follows[:count] @ gears.root[:count, :count].T @ np.ones(count) != 0


def test_looks_of_real_gears_add_up_to_the_plan_they_make(real):
    """The fast sum equals the filter's pass over the arranged plan: errors are columns of both."""
    known, pool = real
    seen = LookArrays(pool.looks, known, False).at(known.z, known.space)
    picks = np.random.default_rng(5).integers(0, len(pool.looks), 24)
    arranged = arrange(pool.looks[picks], known.sheets, pool.run_up)
    exact = information_of(arranged.steps, known).fisher
    quick = information_of_looks(seen, picks, arranged.path, known.space, None, arranged.warm_minutes(known.rig))
    assert exact.shape == (known.size, known.size) and known.gears.size > 20
    assert np.abs(quick - exact).max() < ROUNDING * np.abs(exact).max()


@pytest.mark.thorough
@pytest.mark.parametrize(("ratio", "axis"), [("left", 0), ("up", 1)])
def test_a_plan_for_real_gears_looks_from_more_counters(mounted_rig, monkeypatch, ratio, axis):
    """Where mirrors are known and stops precise: a line along errors of 0.08 deg needs more counters than a gear's.

    At stop errors of 0.04 deg and unknown mirrors both plans look from all over: the mirrors ask for as much.
    """
    monkeypatch.setattr("tvsbayes.planning.candidates.PAN_LEVELS", 9)
    monkeypatch.setattr("tvsbayes.planning.candidates.TILT_LEVELS", 5)
    stops = {f"stop_sd_deg__{d}": Prior(0.01, 0.5, "log-normal") for d in DIRECTIONS}
    mirrors = {name.replace(".", "__"): replace(mounted_rig.table.priors[name], u=0.0) for name in MIRRORS}
    counts = []
    for scale in (0.0, 0.1):
        errors = {f"transmission_error_deg__{a}": Prior(0.0, scale, "half-normal") for a in ("pan", "tilt")}
        bare = prior_knowledge(with_priors(mounted_rig, **stops, **mirrors, **errors))
        offered = candidates(bare)
        known = bare.with_gears(offered.looks.steps)
        seen = LookArrays(offered.looks, known, False).at(known.z, known.space)
        pose = seen.mirror_angles_rad.mean(axis=0)
        target = parse_target(f"u({ratio}) <= 2e-4 deg/step")
        at = sensitivity(target, known.z, known.space, known.rig.table, pose, known.gears)
        steps = offered.looks.steps[DesignProblem(known, offered, seen, target, at).search().greedy(24), axis]
        counts.append((len(np.unique(steps)), int(np.sum((steps > steps.min()) & (steps < steps.max())))))
    assert counts[1][0] > counts[0][0] and counts[1][1] > counts[0][1], counts


@pytest.mark.thorough
def test_the_papers_two_counters_are_worse_off_elsewhere_and_named(real, real_rig):
    known, _ = real
    paper = baseline_of("paper", information_of(paper_protocol(12), known), known, WORST)
    grid = grid_protocol(pan_steps=(0, 60, 120, 180, 240), tilt_steps=(-90, -45, 0, 45, 90))
    assert baseline_of("grid", information_of(grid, known), known, WORST).joint < 0.8 * paper.joint
    warnings = check_plan(real_rig, paper_protocol(12)).warnings
    named = [text for text in warnings if "do not separate gear error from ratio" in text]
    assert [text.split()[0] for text in named] == ["pan", "tilt"]
    assert "would separate them" in named[0] and "elsewhere" in named[0]
    assert not [text for text in check_plan(real_rig, grid).warnings if "gear error" in text]


@pytest.mark.thorough
def test_a_point_between_the_places_has_what_they_leave_open(real):
    known, _ = real
    pose = np.zeros(2)
    left_open = {}
    for y_mm in (0.0, 900.0):
        target = parse_target(f"U95(y) at 1000,{y_mm},0 mm <= 5 mm")
        at = sensitivity(target, known.z, known.space, known.rig.table, pose, known.gears)
        assert at.gradient.shape == (1, known.size)
        left_open[y_mm] = float(at.own[GEARS_AT_POINT][0])
        errors = float(np.sum(at.gradient[0, len(TWO_MIRROR.names) :] ** 2)) + left_open[y_mm]
        # Errors of 0.05 and half the play's 0.02 deg, root mean squares of half-normals. A look there meets a stop
        # error of 0.04 deg and the scatter of looks, both as most probable: the median of a half-normal of 0.01 deg.
        of_a_look = np.hypot(0.04, 0.01 * stats.halfnorm.median())
        assert np.sqrt(errors / at.own[STOP_AT_POINT][0]) == pytest.approx(np.hypot(0.05, 0.01) / of_a_look, rel=1e-3)
    assert left_open[0.0] < 0.1 * left_open[900.0]


@pytest.mark.thorough
def test_limits_name_the_transmission_error(real):
    known, _ = real
    looks = [order for pan, tilt in [(0, -90), (240, 90)] * 6 for order in (("move", pan, tilt), ("look",))]
    information = information_of(steps(("home", 0, 0), ("place", "d1"), *looks), known)
    at = sensitivity(WORST, known.z, known.space, known.rig.table, information.pose_rad, known.gears)
    shares = split_of(known, information.fisher, None, at)
    assert "transmission error" in shares and sum(shares.values()) == pytest.approx(1)
