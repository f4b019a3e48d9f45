"""What the classic estimator does on drawn rigs, and its own number of experiments."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from tvsbayes.estimators.four_point import classic
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.protocols import four_point_protocol
from tvsbayes.planning.drawn_rigs import instruments_in
from tvsbayes.planning.forecast import (
    ClassicForecast,
    classic_answer,
    classic_count,
    classic_forecast,
)
from tvsbayes.planning.target import parse_target
from tvsbayes.twin.physics import local_deg_per_step
from tvsbayes.twin.simulated_campaign import simulate
from tvsbayes.twin.true_rig import Truth, draw_truth, with_derived

pytestmark = pytest.mark.usefixtures("small_searches")


@pytest.mark.parametrize(
    ("sd", "half_width"),
    [(1.0, 1.0), (1.0, 0.53), (1.0, 0.82), (1.0, 1.45), (1.0, 0.42), (1.0, 3.0), (5e-4, 2e-4), (1.0, 0.02)],
)
def test_the_classics_count_is_the_first_that_suffices(sd, half_width):
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
    looks = {"look_scatter_deg.pan": 0.02, "look_scatter_deg.tilt": 0.01}
    parameters = with_derived({**drawn.parameters, **quiet, **stops, **looks})
    forecast = classic_forecast(knowledge, instruments_in(knowledge, [Truth(parameters, drawn.stereo)]))
    count, standard_errors = 400, 4.0
    run = simulate(mounted_rig, four_point_protocol(count), 6, Truth(parameters, drawn.stereo))
    effective = local_deg_per_step(parameters, run.truth.reference_pose_deg)
    for index, (name, result) in enumerate(classic(run.campaign).directions.items()):
        assert result.n == count and DIRECTIONS[index] == name
        sd = result.sd_deg_per_step
        assert forecast.sd[0, index] == pytest.approx(sd, rel=standard_errors / math.sqrt(2 * count)), name
        error = result.mean_deg_per_step - effective[name]
        assert forecast.error[0, index] == pytest.approx(error, abs=standard_errors * sd / math.sqrt(count)), name
        assert abs(error) > 10 * sd / math.sqrt(count), "the error shows, or its sign would be free"
        # Scatter moves pixels and so the derivatives: by its share of the ratio, 1 %, over sqrt(400).
        assert forecast.stereo_u[index] == pytest.approx(result.u_stereo_deg_per_step, rel=0.02), name


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
