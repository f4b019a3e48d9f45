"""Forecast of the paper's four-point estimator on drawn rigs, and the number of experiments it needs; deg/step."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import special

from tvsbayes.errors import TvsError
from tvsbayes.estimators.four_point import classic, ratio_slopes, select_experiments
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


def _experiments(
    rig: Rig, sheets: tuple[str, str], physical: np.ndarray
) -> tuple[Campaign, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, float] | None:
    """Simulate two of the paper's experiments in each direction, without noise; None where one lacks the second.

    Returns:
        The campaign; of the second experiment in each of `DIRECTIONS` pixels, steps and axis as in `Selection`, local
        ratios at the mean pose of the looks (deg/step), variance of the angle between spots by stops and scatter of
        looks (deg^2); the noise of a pixel coordinate.
    """
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
    return (
        simulated.campaign,
        *(selection.pixels[second], selection.steps[second], selection.axis[second]),
        np.array([true_ratio[d] for d in DIRECTIONS]),
        # An experiment begins at a stop of the opposite direction.
        stops + stops[[1, 0, 3, 2]] + 2 * factor * scatter,
        rig.spot_sd_px * parameters["pixel_scale"],
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
    drawn = (_experiments(rig, sheets, physical) for physical in instruments.physical[:CLASSIC_DRAWS])
    complete = [experiments for experiments in drawn if experiments is not None]
    if not complete:
        return None
    campaigns, *arrays = zip(*complete, strict=True)
    pixels, steps, axis, true_ratio, angle_variance, spot_sd_px = map(np.array, arrays)
    slopes = ratio_slopes(pixels, steps.ravel(), axis.ravel(), rig.stereo_pair)
    ratio = slopes.ratio.reshape(steps.shape)
    variance = np.sum(slopes.by_pixel**2, axis=(1, 2)).reshape(steps.shape) * spot_sd_px[:, None] ** 2
    variance += angle_variance * (ratio / true_ratio / steps) ** 2
    directions = classic(campaigns[0]).directions.values()
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
    try:
        measured = {} if campaign is None else classic(campaign).directions
    except TvsError:
        # No complete experiments.
        measured = {}
    answers = []
    for index in target.indices:
        result = measured.get(DIRECTIONS[index])
        from_data = result is not None and result.sd_deg_per_step is not None
        low, sd, high = np.quantile(forecast.sd[:, index], [0.025, 0.5, 0.975]).tolist()
        if result is not None and result.sd_deg_per_step is not None:
            sd, dof = result.sd_deg_per_step, result.n - 1
            low, high = (sd * math.sqrt(dof / float(special.chdtri(dof, p))) for p in (0.025, 0.975))
        systematic, *interval = np.quantile(forecast.error[:, index], [0.5, 0.025, 0.975]).tolist()
        least, count, most = (classic_count(s, half_width) for s in (low, sd, high))
        answers.append(
            ClassicAnswer(
                direction=DIRECTIONS[index],
                sd=sd,
                sd_interval95=(low, high),
                half_width=half_width,
                experiments=count,
                experiments_interval95=(least, most),
                stereo_u=float(forecast.stereo_u[index]),
                systematic=systematic,
                systematic_interval95=(interval[0], interval[1]),
                from_data=from_data,
            )
        )
    return max(answers, key=lambda a: a.experiments)


def value_of_classic(forecast: ClassicForecast | None, target: Target, experiments: int) -> float | None:
    """Compute the median over instruments of the expected classic uncertainty: type A and stereo, as in the GUM."""
    per_direction = experiments / len(DIRECTIONS)
    if forecast is None or per_direction < 2 or not target.of_ratios:
        return None
    rows = list(target.indices)
    u = np.sqrt(forecast.sd[:, rows] ** 2 / per_direction + forecast.stereo_u[rows] ** 2)
    return float(target.factor * np.median(u.max(axis=1)))
