"""Parts of planning that need no search: run-ups, counting, shares, floors, the classic's answer, when to stop."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from tvsbayes.estimators.four_point import classic
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.parameters import INDEX
from tvsbayes.instrument.plan import PlanStep
from tvsbayes.instrument.protocols import four_point_protocol
from tvsbayes.planning.candidates import Positions, sided
from tvsbayes.planning.expectation import PARAMETERS, Knowledge, plan_minutes, prior_knowledge
from tvsbayes.planning.forecast import (
    ClassicForecast,
    classic_answer,
    classic_count,
    classic_forecast,
    truth_in,
    value_of_classic,
)
from tvsbayes.planning.limits import Batch, Limit, limit_of, split_of, stop_now
from tvsbayes.planning.search import smallest_design
from tvsbayes.planning.target import AT_POINT, Sensitivity, Target, parse_target
from tvsbayes.twin.physics import effective_deg_per_step
from tvsbayes.twin.simulated_campaign import Truth, draw_truth, simulate, with_derived

LIMITS = np.array([[0, 100], [-50, 50]])
OVERSHOOT = np.array([10, 20])


@pytest.mark.parametrize(
    ("position", "sides"),
    [
        ((50, 0), {(1, 1), (1, -1), (-1, 1), (-1, -1)}),
        # From the left the run-up begins 10 steps below, from the right 10 above; up 20 below, down 20 above.
        ((5, 0), {(-1, 1), (-1, -1)}),
        ((95, 0), {(1, 1), (1, -1)}),
        ((50, 40), {(1, 1), (-1, 1)}),
        ((50, -40), {(1, -1), (-1, -1)}),
        ((10, -30), {(1, 1), (1, -1), (-1, 1), (-1, -1)}),
        ((9, -31), {(-1, -1)}),
        ((101, 0), set()),
    ],
)
def test_a_side_is_offered_where_its_run_up_stays_inside(position, sides):
    looks = sided(Positions(np.array([position]), np.array([3])), LIMITS, OVERSHOOT)
    assert {tuple(side) for side in looks.side.tolist()} == sides and len(looks) == len(sides)
    assert all(tuple(steps) == position for steps in looks.steps.tolist()) and set(looks.sheet.tolist()) <= {3}


def test_the_smallest_number_that_meets_is_found():
    ladder = (1, 2, 3, 5, 8, 12, 20, 40)
    for answer in range(1, 41):
        assert smallest_design(lambda n, answer=answer: n >= answer, ladder) == answer
    assert smallest_design(lambda n: n >= 41, ladder) is None


def test_minutes_of_a_plan_by_hand(mounted_rig):
    """A homing counts as a move: 2 + 60 + 2 + 3 + 3 = 70 s."""
    rig = replace(mounted_rig, costs_s={"move_s": 2.0, "look_s": 3.0, "placement_s": 60.0})
    steps = [PlanStep(0, "home", 0, 0), PlanStep(1, "place", target="d1"), PlanStep(2, "move", 50, 0)]
    steps += [PlanStep(3, "look"), PlanStep(4, "look")]
    assert plan_minutes(steps, rig) == pytest.approx(70 / 60, rel=1e-12)


# Shares and floors, by hand.

SCALE, STEREO = INDEX["focal_scale"], PARAMETERS - 1


@pytest.fixture(scope="module")
def knowledge(mounted_rig) -> Knowledge:
    return prior_knowledge(mounted_rig)


def at(columns: dict[int, float]) -> np.ndarray:
    """A vector over the coordinates with a few entries, shape (p,)."""
    vector = np.zeros(PARAMETERS)
    vector[list(columns)] = list(columns.values())
    return vector


def test_shares_of_two_parameters_by_hand(knowledge):
    """Data diag(3, 1) on priors of 1: S = diag(1/4, 1/2); g = (2, 3) is pulled by S g = (1/2, 3/2)."""
    data, noise = (np.diag(at({SCALE: scale, STEREO: camera})) for scale, camera in ((3.0, 1.0), (2.0, 0.2)))
    gradient = np.stack([at({SCALE: 0.1}), at({SCALE: 2.0, STEREO: 3.0})])
    own = {AT_POINT[0]: np.array([0.0, 0.5]), AT_POINT[1]: np.array([0.4, 0.0])}
    target = Sensitivity(gradient, own)
    # Prior 1/4 and 9/4; pixels 2/4 + 0.2 * 9/4; the rest of the data 1/4 + 0.8 * 9/4; the point 0.5.
    parts = {"focal scale": 0.25, "stereo calibration": 2.25, AT_POINT[0]: 0.5}
    looks = {"pixel noise": 0.95, "stop errors of the looks": 2.05}
    assert split_of(knowledge, data, noise, target) == pytest.approx({k: v / 6 for k, v in (parts | looks).items()})
    shares = split_of(knowledge, data, None, target)
    assert shares == pytest.approx({k: v / 6 for k, v in (parts | {"looks": 3.0}).items()})
    assert list(shares) == ["looks", "stereo calibration", AT_POINT[0], "focal scale"], "largest first"


def test_after_data_priors_and_campaign_are_one_share(knowledge):
    """Precision 2 of all and data diag(2, 0): S = diag(1/4, 1/2), S g = (1/2, 3/2); 2 (1/4 + 9/4) and 2 / 4."""
    known = replace(knowledge, precision=2 * np.eye(PARAMETERS), after_data=True)
    gradient = at({SCALE: 2.0, STEREO: 3.0})[None]
    shares = split_of(known, np.diag(at({SCALE: 2.0})), None, Sensitivity(gradient))
    assert shares == pytest.approx({"the campaign and its priors": 5.0 / 5.5, "looks": 0.5 / 5.5})


def target_of(limit: float) -> Target:
    return Target("", "left", 1.0, limit, "deg/step")


def test_an_input_has_to_be_known_as_much_better_as_the_floor_is_too_high(knowledge):
    """A value that is one prior's alone goes with its u: a floor 4 / 1.02 times the target asks for u / 4 * 1.02."""
    nothing, only = np.zeros((PARAMETERS, PARAMETERS)), Sensitivity(at({SCALE: 2.0})[None])
    limit = limit_of(knowledge, nothing, only, target_of(0.51))
    assert (limit.floor, limit.cause, limit.reachable) == (2.0, "focal scale", False)
    # 0.255 of 0.002, stated to two digits.
    assert limit.needed == "it would do to know u(focal_scale) = 0.00051 instead of 0.002"
    assert limit_of(knowledge, nothing, only, target_of(2.0)).reachable


def test_what_is_needed_is_never_rounded_up(knowledge):
    """0.2578 of 0.002 is 0.000516 and 0.2598 of it 0.0005196: two digits that are enough are 0.00051 for both."""
    nothing, only = np.zeros((PARAMETERS, PARAMETERS)), Sensitivity(at({SCALE: 1.0})[None])
    for share in (0.2578, 0.2598):
        needed = limit_of(knowledge, nothing, only, target_of(share)).needed
        assert needed == "it would do to know u(focal_scale) = 0.00051 instead of 0.002"


def test_two_inputs_are_asked_for_where_one_is_not_enough(knowledge):
    """4^2 + 3^2 with a target of 2: the larger to a tenth of its u, the smaller to sqrt(4 - 0.4^2) / 3 = 0.653."""
    nothing, both = np.zeros((PARAMETERS, PARAMETERS)), Sensitivity(at({STEREO: 4.0, SCALE: 3.0})[None])
    limit = limit_of(knowledge, nothing, both, target_of(2.0))
    assert limit.shares == pytest.approx({"stereo calibration": 16 / 25, "focal scale": 9 / 25})
    stereo = "the stereo calibration to 10 % of its present uncertainty"
    assert limit.needed == f"it would do to know {stereo}; u(focal_scale) = 0.0013 instead of 0.002"


# The classic's answer.


def test_the_classics_forecast_is_what_its_experiments_do(mounted_rig, knowledge):
    """Scatter, systematic error and stereo part of 400 experiments a direction on a known rig.

    No contrast: by go and return the sums of steps would drift, and with them the pose.
    """
    drawn = draw_truth(mounted_rig, np.random.default_rng(3))
    quiet = {"ratio_contrast_deg_per_step.pan": 0.0, "ratio_contrast_deg_per_step.tilt": 0.0, "pixel_scale": 1.5}
    stops = {f"stop_sd_deg.{d}": sd for d, sd in zip(DIRECTIONS, (0.05, 0.02, 0.06, 0.02), strict=True)}
    parameters = with_derived({**drawn.parameters, **quiet, **stops})
    forecast = classic_forecast(knowledge, [truth_in(knowledge, parameters, drawn.stereo.vector)])
    count, standard_errors = 400, 4.0
    run = simulate(mounted_rig, four_point_protocol(count), 6, Truth(parameters, drawn.stereo))
    effective = effective_deg_per_step(parameters, run.truth.reference_pose_deg)
    for index, (name, found) in enumerate(classic(run.campaign).directions.items()):
        assert found.n == count and DIRECTIONS[index] == name
        sd = found.sd_deg_per_step
        assert forecast.sd[0, index] == pytest.approx(sd, rel=standard_errors / math.sqrt(2 * count)), name
        error = found.mean_deg_per_step - effective[name]
        assert forecast.error[0, index] == pytest.approx(error, abs=standard_errors * sd / math.sqrt(count)), name
        assert abs(error) > 10 * sd / math.sqrt(count), "the error shows, or its sign would be free"
        # Scatter moves pixels and so the derivatives: by its share of the ratio, 1 %, over sqrt(400).
        assert forecast.stereo_u[index] == pytest.approx(found.u_stereo_deg_per_step, rel=0.02), name


def test_the_classics_value_adds_stereo_to_the_mean_of_its_experiments():
    """16 experiments are 4 of a direction: hypot(6e-4 / 2, 4e-4) = 5e-4; the worse direction, its median instrument."""
    sd = np.array([[6e-4, 1e-4, 0, 0], [6e-4, 1e-4, 0, 0], [60e-4, 1e-4, 0, 0]])
    forecast = ClassicForecast(sd, np.zeros((3, 4)), np.array([4e-4, 1e-4, 0, 0]))
    worst, left = (parse_target(f"u({name}) <= 1e-4 deg/step") for name in ("worst", "left"))
    assert value_of_classic(forecast, worst, 16) == pytest.approx(5e-4, rel=1e-12)
    assert value_of_classic(forecast, replace(left, factor=1.96), 16) == pytest.approx(1.96 * 5e-4, rel=1e-12)
    for other in (parse_target("u(backlash.pan) <= 1 deg"), parse_target("u(x) at 1000,0,0 mm <= 1 mm")):
        assert value_of_classic(forecast, other, 16) is None
    assert value_of_classic(forecast, worst, 7) is None, "one experiment has no scatter"


@pytest.fixture(scope="module")
def forecast() -> ClassicForecast:
    """41 instruments: quantiles at 2.5, 50 and 97.5 % are rows 1, 20 and 39."""
    rows = np.arange(41.0)[::-1, None]
    sd, error = 1e-4 * (1 + rows * np.array([0.1, 0.05, 0, 0])), 1e-5 * (rows + np.array([0, 100, 0, 0]))
    return ClassicForecast(sd, error, np.array([3e-5, 4e-5, 0, 0]))


def test_the_classics_answer_before_data(forecast):
    """S of the instruments, E = 1.96 u or U95; of `worst` the direction that needs most."""
    answer = classic_answer(parse_target("u(worst) <= 1e-4 deg/step"), forecast, None)
    assert answer.direction == "left" and not answer.from_data
    assert answer.half_width == pytest.approx(1.96e-4, rel=1e-4)
    assert (*answer.sd_interval95, answer.sd) == pytest.approx((1.1e-4, 4.9e-4, 3e-4), rel=1e-12)
    counts = tuple(classic_count(sd, answer.half_width) for sd in (1.1e-4, 4.9e-4, 3e-4))
    assert (*answer.experiments_interval95, answer.experiments) == counts
    assert (*answer.systematic_interval95, answer.systematic) == pytest.approx((1e-5, 39e-5, 20e-5), rel=1e-12)
    expanded = classic_answer(parse_target("U95(right) <= 1e-4 deg/step"), forecast, None)
    assert expanded.half_width == pytest.approx(1e-4, rel=1e-12) and expanded.stereo_u == 4e-5
    assert expanded.systematic == pytest.approx(120e-5, rel=1e-12)


def test_the_classics_answer_after_data_has_the_interval_of_chi_square(mounted_rig, forecast):
    """(n - 1) s^2 / sigma^2 exceeds its 2.5 % quantile at the upper end and its 97.5 % quantile at the lower."""
    campaign = simulate(mounted_rig, four_point_protocol(5), 1).campaign
    measured = classic(campaign).directions["left"]
    answer = classic_answer(parse_target("u(left) <= 1e-4 deg/step"), forecast, campaign)
    assert answer.from_data and answer.sd == measured.sd_deg_per_step and measured.n == 5
    low, high = answer.sd_interval95
    tails = [stats.chi2.cdf(4 * (answer.sd / sigma) ** 2, 4) for sigma in (high, low)]
    assert tails == pytest.approx([0.025, 0.975], rel=1e-9)
    counts = tuple(classic_count(sd, answer.half_width) for sd in (low, high))
    assert answer.experiments_interval95 == counts and counts[0] < answer.experiments < counts[1]


# When to stop.


@pytest.mark.parametrize(("gain_per_minute", "stop"), [(0.98e-3, True), (1.02e-3, False)])
def test_measuring_stops_below_a_thousandth_of_the_value_a_minute(gain_per_minute, stop):
    """The rule that is printed: less than 0.1 % of what is known now, with and without data."""
    now, target = 3e-4, parse_target("u(left) <= 2e-4 deg/step")
    best = Batch((), 2.0, 2 * gain_per_minute * now, gain_per_minute * now, "")
    idle = replace(best, gain_per_minute=0.0)
    for after_data in (False, True):
        advice = stop_now(now, target, Limit(1e-5, "focal scale", {}, True, None), (best, idle), after_data)
        assert advice.now is stop
        assert "less than 0.1 % a minute" in advice.rule


@pytest.mark.parametrize(("now", "stop"), [(2e-4, True), (2.01e-4, False)])
def test_measuring_stops_where_the_target_is_met(now, stop):
    good = Batch((), 1.0, 0.1 * now, 0.1 * now, "")
    target = parse_target("u(left) <= 2e-4 deg/step")
    assert stop_now(now, target, Limit(1e-5, "focal scale", {}, True, None), (good,), True).now is stop
