"""Drawn rigs: what fits will report of them, and the classic estimator's own answer."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from support.coarse_planning import ROUNDING

from tvsbayes.estimators.four_point import classic
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.parameters import INDEX, RIG_NAMES
from tvsbayes.instrument.protocols import four_point_protocol
from tvsbayes.model.headlines import physical_at
from tvsbayes.model.parameter_space import STOP_COLUMNS
from tvsbayes.planning.candidates import Seen
from tvsbayes.planning.expectation import NOISE_COLUMNS, PARAMETERS
from tvsbayes.planning.forecast import (
    PIXEL_COLUMN,
    Assurance,
    ClassicForecast,
    DrawnTruth,
    Family,
    believed,
    classic_answer,
    classic_count,
    classic_forecast,
    truth_in,
    value_of_classic,
)
from tvsbayes.planning.target import DEFAULT_TARGET, parse_target
from tvsbayes.twin.physics import effective_deg_per_step
from tvsbayes.twin.simulated_campaign import Truth, draw_truth, simulate, with_derived

pytestmark = pytest.mark.usefixtures("small_searches")


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
    assurance = Assurance(family, parse_target(DEFAULT_TARGET), 1, 0)
    truth = DrawnTruth(knowledge.z, knowledge.space)
    z = knowledge.z.copy()
    z[[*STOP_COLUMNS.ravel(), PIXEL_COLUMN]] = (0.7, -1.1, 0.4, 1.3, -0.6)
    again = assurance.arrays.at(z, knowledge.space).rows
    quick = assurance.rescaled(assurance.arrays.at(truth.z, truth.space), truth, z).rows
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

    def scales(chosen, noise):
        taken = Seen(*(getattr(seen, n)[chosen] for n in ("rows", "slope", "seen", "mirror_angles_rad")))
        side = found.looks.side[chosen]
        return believed(truth, taken, side, exact, knowledge, np.full(5, noise))[columns]

    assert scales(many, 0.0) == pytest.approx(1.5, abs=0.01)
    assert (np.abs(scales(many[:1], 0.0)) < 1.5).all()
    per_direction = len(many) / 2
    # Stops of 0.18 deg against pixels: what pixels leave open lowers the information by a few per cent.
    assert scales(many, 1.0) - scales(many, 0.0) == pytest.approx(1 / math.sqrt(2 * per_direction), rel=0.1)


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
        low, high = (believed(truth, taken, side, covariance, knowledge, np.full(5, x))[columns] for x in (0.0, 1.0))
        return high - low

    exact = np.zeros((PARAMETERS, PARAMETERS))
    geometry = ~NOISE_COLUMNS & (np.arange(PARAMETERS) < len(RIG_NAMES))
    # Nothing is learned where the covariance is the prior's; a precision of 0 is a coordinate held fixed.
    precision = np.diag(knowledge.precision)
    unknown = np.diag(np.divide(1.0, precision, out=np.zeros(PARAMETERS), where=precision > 0))
    left_over = 1 - np.sum(geometry & (precision > 0)) / (2 * seen.seen[chosen].sum())
    # Scatter is 1 / sqrt(information) but for the prior, which 30 stops of a direction outweigh 50 times.
    assert scatter(exact) / scatter(unknown) == pytest.approx(1 / math.sqrt(left_over), rel=0.03)


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
