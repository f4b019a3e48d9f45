"""Forecast of the paper's four-point estimator on drawn rigs, and the number of experiments it needs; deg/step."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import special

from tvsbayes.errors import TvsError
from tvsbayes.estimators.four_point import DirectionResult, classic, ratio_slopes, select_experiments
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.campaign import Campaign
from tvsbayes.instrument.parameters import LOOK_SCATTER_NAMES, names_of
from tvsbayes.instrument.protocols import four_point_protocol
from tvsbayes.instrument.rig import Rig
from tvsbayes.planning.drawn_rigs import Instruments
from tvsbayes.planning.expectation import Knowledge
from tvsbayes.planning.target import Target
from tvsbayes.results.records import Record
from tvsbayes.statistics.intervals import NORMAL_95, coverage_factor
from tvsbayes.twin.physics import local_deg_per_step
from tvsbayes.twin.simulated_campaign import simulate
from tvsbayes.twin.true_rig import Truth, with_derived


@dataclass(frozen=True)
class ClassicForecast:
    """Forecast of the four-point estimator, arrays over draws of the instrument and `DIRECTIONS`, deg/step.

    Attributes:
        sd: standard deviation of one experiment, shape (draws, 4).
        error: its systematic error, estimate less local ratio at the mean pose of the looks, shape (draws, 4).
        stereo_u: uncertainty by stereo and focal scale at the first draw, common to all experiments, shape (4,).
    """

    sd: np.ndarray
    error: np.ndarray
    stereo_u: np.ndarray


CLASSIC_DRAWS = 100


@dataclass(frozen=True)
class _Experiments:
    """The second experiment in each of `DIRECTIONS` on a drawn instrument without noise; arrays over these four.

    Attributes:
        campaign: campaign of all experiments.
        pixels, steps, axis: as in `Selection`.
        true_ratio: local ratios at the mean pose of the looks, deg/step.
        angle_variance: variance of the angle between spots by stops and scatter of looks, deg^2.
        spot_sd_px: noise of a pixel coordinate.
    """

    campaign: Campaign
    pixels: np.ndarray
    steps: np.ndarray
    axis: np.ndarray
    true_ratio: np.ndarray
    angle_variance: np.ndarray
    spot_sd_px: float


def _experiments(rig: Rig, sheets: tuple[str, str], physical: np.ndarray) -> _Experiments | None:
    """Simulate two of the paper's experiments in each direction; None where a direction lacks the second."""
    parameters = dict(zip(rig.table.mechanism.names, map(float, physical), strict=True))
    noise_free = dict.fromkeys([*names_of("stop_sd_deg", "look_scatter_deg"), "pixel_scale"], 0.0)
    stereo = rig.stereo_pair.with_vector(physical[len(rig.table.mechanism.rig_names) :])
    truth = Truth(with_derived({**parameters, **noise_free}), stereo)
    simulated = simulate(rig, four_point_protocol(2, targets=sheets), 0, truth)
    selection, pose = select_experiments(simulated.campaign), simulated.truth.reference_pose_deg
    # The second experiment of each direction starts like all later ones, unlike the first.
    second = np.flatnonzero(selection.experiments % 2 == 1)
    if len(second) < len(DIRECTIONS) or pose is None:
        return None
    true_ratio = local_deg_per_step(with_derived(parameters), pose)
    near_mm, far_mm = (rig.sheets_mm[sheet] for sheet in sheets)
    # Error of a beam through two spots with angle errors e1, e2: (far e2 - near e1) / (far - near).
    factor = (near_mm**2 + far_mm**2) / (far_mm - near_mm) ** 2
    stops = np.array([parameters[f"stop_sd_deg.{d}"] ** 2 for d in DIRECTIONS])
    scatter = np.repeat([parameters[name] ** 2 for name in LOOK_SCATTER_NAMES], 2)
    return _Experiments(
        campaign=simulated.campaign,
        pixels=selection.pixels[second],
        steps=selection.steps[second],
        axis=selection.axis[second],
        true_ratio=np.array([true_ratio[d] for d in DIRECTIONS]),
        # An experiment begins at a stop of the opposite direction.
        angle_variance=stops + stops[[1, 0, 3, 2]] + 2 * factor * scatter,
        spot_sd_px=rig.spot_sd_px * parameters["pixel_scale"],
    )


def classic_forecast(knowledge: Knowledge, instruments: Instruments) -> ClassicForecast | None:
    """Simulate the paper's experiments on drawn instruments without noise; None with fewer than two sheets.

    The twin computes pixels. Noise of pixels, of the two stops of an experiment and of the scatter of its looks is
    propagated to first order.
    """
    rig = knowledge.rig
    if len(rig.sheets_mm) < 2:
        return None
    sheets = knowledge.sheets[0], knowledge.sheets[1]
    drawn = [_experiments(rig, sheets, physical) for physical in instruments.physical[:CLASSIC_DRAWS]]
    complete = [experiments for experiments in drawn if experiments is not None]
    if not complete:
        return None

    def of_all(name: str) -> np.ndarray:
        return np.array([getattr(experiments, name) for experiments in complete])

    steps, true_ratio = of_all("steps"), of_all("true_ratio")
    slopes = ratio_slopes(of_all("pixels"), steps.ravel(), of_all("axis").ravel(), rig.stereo_pair)
    ratio = slopes.ratio.reshape(steps.shape)
    by_pixel = np.sum(slopes.by_pixel**2, axis=(1, 2)).reshape(steps.shape)
    variance = by_pixel * of_all("spot_sd_px")[:, None] ** 2
    variance += of_all("angle_variance") * (ratio / true_ratio / steps) ** 2
    directions = classic(complete[0].campaign).directions.values()
    stereo_u = np.array([r.u_stereo_deg_per_step for r in directions if r is not None])
    return ClassicForecast(np.sqrt(variance), ratio - true_ratio, stereo_u)


def classic_count(sd: float, half_width: float) -> int:
    """Compute the experiments of one direction for a 95 % half width E: n = (t s / E)^2, t for n - 1 dof."""
    n = 2
    for _ in range(200):
        needed = max(2, math.ceil((coverage_factor(n - 1) * sd / half_width) ** 2))
        if needed <= n:
            # t decreases with n: from above, the first sufficient n is the answer.
            while n > 2 and (coverage_factor(n - 2) * sd / half_width) ** 2 <= n - 1:
                n -= 1
            return n
        n = min(needed, 2 * n)
    return n


class ClassicAnswer(Record, frozen=True):
    """The four-point method's own number of experiments: n = (t s / E)^2 in every direction.

    Attributes:
        direction: direction with the largest number, or that of the target.
        sd, sd_interval95: s, deg/step: median and 95 % range, over instruments or (with data) by chi-square.
        half_width: E, deg/step.
        experiments, experiments_interval95: n of the direction, for s and for its interval.
        stereo_u: uncertainty common to all experiments, deg/step; no n lowers it.
        systematic, systematic_interval95: its error for the median instrument and in 95 % of them, deg/step.
        from_data: whether s was measured.
    """

    direction: str
    sd: float
    sd_interval95: tuple[float, float]
    half_width: float
    experiments: int
    experiments_interval95: tuple[int, int]
    stereo_u: float
    systematic: float
    systematic_interval95: tuple[float, float]
    from_data: bool


def classic_answer(target: Target, forecast: ClassicForecast | None, campaign: Campaign | None) -> ClassicAnswer | None:
    """Compute n = (t s / E)^2 with the uncertainty of s: over instruments, or by chi-square where s was measured."""
    if forecast is None or not target.of_ratios:
        return None
    half_width = target.limit * NORMAL_95 / target.factor
    measured = {} if campaign is None else _measured(campaign)
    answers = []
    for index in target.indices:
        direction = DIRECTIONS[index]
        low, sd, high = np.quantile(forecast.sd[:, index], [0.025, 0.5, 0.975])
        result = measured.get(direction)
        if result is not None and result.sd_deg_per_step is not None:
            sd, n = result.sd_deg_per_step, result.n
            low, high = (sd * math.sqrt((n - 1) / special.chdtri(n - 1, p)) for p in (0.025, 0.975))
        error = np.quantile(forecast.error[:, index], [0.5, 0.025, 0.975])
        counts = [classic_count(float(s), half_width) for s in (low, sd, high)]
        answers.append(
            ClassicAnswer(
                direction=direction,
                sd=float(sd),
                sd_interval95=(float(low), float(high)),
                half_width=half_width,
                experiments=counts[1],
                experiments_interval95=(counts[0], counts[2]),
                stereo_u=float(forecast.stereo_u[index]),
                systematic=float(error[0]),
                systematic_interval95=(float(error[1]), float(error[2])),
                from_data=result is not None and result.sd_deg_per_step is not None,
            )
        )
    return max(answers, key=lambda a: a.experiments)


def _measured(campaign: Campaign) -> Mapping[str, DirectionResult | None]:
    """Return the classic results by direction; empty without complete experiments."""
    try:
        return classic(campaign).directions
    except TvsError:
        return {}


def value_of_classic(forecast: ClassicForecast | None, target: Target, experiments: int) -> float | None:
    """Compute the median over instruments of the expected classic uncertainty: type A and stereo, as in the GUM."""
    per_direction = experiments / len(DIRECTIONS)
    if forecast is None or per_direction < 2 or not target.of_ratios:
        return None
    rows = list(target.indices)
    u = np.sqrt(forecast.sd[:, rows] ** 2 / per_direction + forecast.stereo_u[rows] ** 2)
    return float(target.factor * np.median(u.max(axis=1)))
