"""The paper's four-point estimator, exactly as printed, with type A and GUM uncertainties (formulation 4.4).

Two spots before and two after a move of N steps, each triangulated alone; the beam's slope in the plane of the moved
axis; the difference of two arctangents over N. Frame S (X depth, Y left, Z up, mm); degrees; pixels with the integer at
the centre of a pixel. Effects that the method neglects (backlash, the tangent of a tilt off its own azimuth) remain in
its result, for comparison with the joint fit. No JAX.

Source: Lopez-Medina et al., Metrology 2025, 5(4), 58, equations (4) to (8).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from tvsbayes.display import Shown, View
from tvsbayes.errors import NothingToEstimate
from tvsbayes.instrument.axes import AXES, DIRECTIONS, SENSES
from tvsbayes.instrument.campaign import Campaign, Look, Move, ordered_spots, pixels_of
from tvsbayes.instrument.experiments import experiments_of, name_of, rank
from tvsbayes.instrument.stereo_pair import Stereo, triangulate
from tvsbayes.instrument.stops import rests_of
from tvsbayes.results.records import Record
from tvsbayes.statistics.intervals import coverage_factor, effective_dof, grubbs_p

PROBE_PX = 0.01
"""Step of the ratios' derivatives: far above rounding (1e-9 px), far below curvature (10 px)."""
OUTLIER_LEVEL = 0.01
"""Level of the test for an experiment that makes the sd (an outlier of ISO 5725-2, 7.3.4)."""
STEP_HALVINGS = 40
"""Largest number of halvings of a difference quotient's step, until both ends lie in the lens model: 1e-13 sd."""


@dataclass(frozen=True)
class FourPointAngles:
    """Beam slopes before and after the move, equations (4), (6), (8): arrays (...,) in degrees."""

    theta_i_deg: np.ndarray
    theta_f_deg: np.ndarray


@dataclass(frozen=True)
class Experiment:
    """One complete four-point experiment; `steps` is signed (positive = left or up)."""

    experiment: int
    direction: str
    steps: int
    theta_i_deg: float
    theta_f_deg: float
    deg_per_step: float


@dataclass(frozen=True)
class SkippedExperiment:
    """An experiment that could not be used, and why in words; direction None where its move has none."""

    experiment: int
    direction: str | None
    reason: str

    @property
    def name(self) -> str:
        """Number and direction in words."""
        return name_of(self.direction, self.experiment)


class _Unusable(Exception):
    """Why an experiment cannot be used, in words."""


@dataclass(frozen=True)
class Selection:
    """The complete experiments of a campaign, as arrays over e experiments.

    Attributes:
        experiments: (e,) experiment numbers; with `direction` they are keys.
        spot_rows: (e, 4) rows of `campaign.spots` of points 1 to 4.
        pixels: (e, 4, 4) u_left, v_left, u_right, v_right of points 1 to 4, px.
        steps: (e,) signed N.
        axis: (e,) "pan" or "tilt".
        skipped: experiments left out, with reasons.
    """

    experiments: np.ndarray
    spot_rows: np.ndarray
    pixels: np.ndarray
    steps: np.ndarray
    axis: np.ndarray
    skipped: tuple[SkippedExperiment, ...]

    @property
    def direction(self) -> np.ndarray:
        """Return (e,) "left", "right", "up" or "down" by axis and sign of N (formulation 2)."""
        pan, tilt = (np.where(self.steps > 0, *SENSES[axis]) for axis in AXES)
        return np.where(self.axis == "tilt", tilt, pan)


class Outlier(Record, frozen=True):
    """The experiment that makes a direction's sd, `p` by Grubbs' test, and the others' results without it.

    `play_alone` is how its first beam was approached, where all others were approached otherwise: "cleared" (by a
    move in the direction of its steps, which then lose no play), "reversed", "unknown"; None where others were so too.
    """

    experiment: int
    deg_per_step: float
    p: float
    mean_without_deg_per_step: float
    sd_without_deg_per_step: float
    play_alone: str | None


class DirectionResult(Record, frozen=True):
    """Mean of one direction's experiments, deg/step, with type A and GUM uncertainty.

    Fields that need two experiments (`sd`, `u`, intervals, degrees of freedom) are None for n = 1.
    `u_stereo_deg_per_step` is sqrt(J C J^T) of stereo parameters and focal scale alone. `effective_dof` is by
    Welch-Satterthwaite, with infinite degrees of freedom for that type B part; None where it is infinite.
    """

    n: int
    mean_deg_per_step: float
    sd_deg_per_step: float | None
    u_type_a_deg_per_step: float | None
    interval95_type_a: tuple[float, float] | None
    u_gum_deg_per_step: float | None
    interval95_gum: tuple[float, float] | None
    u_stereo_deg_per_step: float
    effective_dof: float | None
    outlier: Outlier | None = None


class ClassicResult(Shown, Record, frozen=True):
    """The paper's estimate for a campaign; a direction without experiments is None."""

    directions: dict[str, DirectionResult | None]
    experiments: tuple[Experiment, ...]
    skipped: tuple[SkippedExperiment, ...]

    def shown(self) -> View:
        """Show mean, scatter and uncertainty by direction."""
        columns = ("direction", "n", "mean, deg/step", "sd", "u type A", "u GUM", "2.5 % (GUM)", "97.5 % (GUM)")
        rows = []
        for name, r in self.directions.items():
            if r is not None:
                ends = r.interval95_gum or (None, None)
                spread = (r.sd_deg_per_step, r.u_type_a_deg_per_step, r.u_gum_deg_per_step)
                rows.append((name, r.n, r.mean_deg_per_step, *spread, *ends))
        left_out = f", {len(self.skipped)} left out" if self.skipped else ""
        return View(f"ClassicResult of {len(self.experiments)} experiments{left_out}", columns, rows)


def ratio_deg_per_step(
    theta_i_deg: float | np.ndarray, theta_f_deg: float | np.ndarray, steps: int | np.ndarray
) -> float | np.ndarray:
    """Compute equation (5): (theta_f - theta_i) / N with signed N, so that a correct rig has a positive ratio."""
    return (theta_f_deg - theta_i_deg) / steps


def four_point_angle_deg(points_S_mm: np.ndarray, axis: str | np.ndarray) -> FourPointAngles:
    """Compute slopes of points 1-2 and 4-3 in the plane of the moved axis, equations (4), (6) and (8).

    Args:
        points_S_mm: (..., 4, 3) points 1 to 4 in frame S.
        axis: "pan" (X-Y plane) or "tilt" (X-Z plane), one or an array (...,).
    """
    points = np.asarray(points_S_mm, float)
    tilt = np.asarray(axis) == "tilt"
    depth = points[..., 0]
    across = np.where(tilt[..., None], points[..., 2], points[..., 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        before = (across[..., 1] - across[..., 0]) / (depth[..., 1] - depth[..., 0])
        after = (across[..., 2] - across[..., 3]) / (depth[..., 2] - depth[..., 3])
    return FourPointAngles(np.degrees(np.arctan(before)), np.degrees(np.arctan(after)))


def four_point_ratios(
    pixels: np.ndarray, steps: np.ndarray, axis: str | np.ndarray, stereo: Stereo, focal_scale: float = 1.0
) -> np.ndarray:
    """Compute degrees per step (..., e) of many experiments through the paper's whole chain.

    Args:
        pixels: (..., e, 4, 4) raw pixels (u_left, v_left, u_right, v_right) of points 1 to 4.
        steps: (e,) signed N.
        axis: "pan" or "tilt", one or (e,).
        stereo: the calibration to triangulate with.
        focal_scale: common factor on fx, fy of both cameras.
    """
    pixels = np.asarray(pixels, float)
    points = triangulate(stereo, pixels.reshape(-1, 4), focal_scale).reshape(*pixels.shape[:-1], 3)
    angles = four_point_angle_deg(points, axis)
    return np.asarray(ratio_deg_per_step(angles.theta_i_deg, angles.theta_f_deg, np.asarray(steps)))


@dataclass(frozen=True)
class RatioSlopes:
    """Ratios of experiments and their derivatives by the pixels, for first-order propagation.

    Attributes:
        ratio: (e,) deg/step.
        by_pixel: (e, 4, 4) its derivative by the pixels (u_left, v_left, u_right, v_right) of points 1 to 4,
            deg/step/px.
    """

    ratio: np.ndarray
    by_pixel: np.ndarray


def ratio_slopes(pixels: np.ndarray, steps: np.ndarray, axis: str | np.ndarray, stereo: Stereo) -> RatioSlopes:
    """Compute `four_point_ratios` and their difference quotients; NaN where a pixel gives no ratio."""
    pixels = np.asarray(pixels, float).reshape(-1, 4, 4)
    ratio = four_point_ratios(pixels, steps, axis, stereo)
    by_pixel = np.empty(pixels.shape)
    for entry in np.ndindex(4, 4):
        moved = pixels.copy()
        moved[:, *entry] += PROBE_PX
        by_pixel[:, *entry] = (four_point_ratios(moved, steps, axis, stereo) - ratio) / PROBE_PX
    return RatioSlopes(ratio, by_pixel)


def select_experiments(campaign: Campaign) -> Selection:
    """Collect the complete four-point experiments; the others are listed with a reason.

    A complete experiment has one ok spot for each point 1 to 4, points 1 and 2 at the same counters, as are 3 and 4.
    Between them exactly one axis has moved, without homing.
    """
    moves = {move.move: move for move in campaign.moves}
    looks = campaign.spots
    order = sorted(range(len(looks)), key=lambda row: (looks[row].move, looks[row].spot))
    at = [(moves[look.move].pan_steps, moves[look.move].tilt_steps) for look in looks]
    numbered = [look.experiment for look in looks], [look.point for look in looks]
    kept: list[int] = []
    spot_rows_kept: list[list[int]] = []
    moved: list[tuple[int, int]] = []
    skipped: list[SkippedExperiment] = []
    for (direction, number), rows in experiments_of(*numbered, at, order):
        try:
            by_point = _by_point(looks, rows)
            moved.append(_moved([moves[looks[row].move] for row in by_point]))
            spot_rows_kept.append(by_point)
            kept.append(number)
        except _Unusable as reason:
            skipped.append(SkippedExperiment(number, direction, str(reason)))
    spot_rows = np.array(spot_rows_kept, dtype=int).reshape(-1, 4)
    pan, tilt = np.array(moved, dtype=int).reshape(-1, 2).T
    return Selection(
        experiments=np.array(kept, dtype=int),
        spot_rows=spot_rows,
        pixels=pixels_of(campaign.spots[row] for row in spot_rows.ravel()).reshape(-1, 4, 4),
        steps=pan + tilt,
        axis=np.where(pan != 0, "pan", "tilt"),
        skipped=tuple(skipped),
    )


def experiment_rows(campaign: Campaign, selection: Selection) -> np.ndarray:
    """Find the rows (e, 4) of the selected looks among `ordered_spots`, the order of spots in a fit."""
    row_of = {spot.spot: row for row, spot in enumerate(ordered_spots(campaign))}
    rows = [[row_of[campaign.spots[row].spot] for row in four] for four in selection.spot_rows]
    return np.array(rows, dtype=int).reshape(-1, 4)


def _by_point(spots: Sequence[Look], rows: list[int]) -> list[int]:
    """Find the rows of points 1 to 4 in order; raise `_Unusable` where there are not exactly four."""
    by_point: dict[int | None, list[int]] = {}
    for row in rows:
        by_point.setdefault(spots[row].point, []).append(row)
    ordered = []
    for point in (1, 2, 3, 4):
        members = by_point.get(point, [])
        if not members:
            raise _Unusable(f"point {point} is missing")
        ok = [row for row in members if spots[row].status == "ok"]
        if not ok:
            raise _Unusable(f"point {point} is not usable: status {spots[members[0]].status}")
        if len(ok) > 1:
            raise _Unusable(f"point {point} is present {len(ok)} times")
        ordered.append(ok[0])
    return ordered


def _moved(at: list[Move]) -> tuple[int, int]:
    """Signed N of (pan, tilt) between points 2 and 3 of 4, 0 for one axis; raise `_Unusable` for other moves."""
    one, two, three, four = ((m.segment, m.pan_steps, m.tilt_steps) for m in at)
    if len({m.segment for m in at}) > 1:
        raise _Unusable("the positioner was homed within the experiment")
    if one != two:
        raise _Unusable("points 1 and 2 were seen at different counters")
    if three != four:
        raise _Unusable("points 3 and 4 were seen at different counters")
    pan, tilt = three[1] - two[1], three[2] - two[2]
    if pan and tilt:
        raise _Unusable(f"both axes moved between points 2 and 3 (pan {pan:+d}, tilt {tilt:+d} steps)")
    if not pan and not tilt:
        raise _Unusable("no axis moved between points 2 and 3")
    return pan, tilt


def classic(campaign: Campaign) -> ClassicResult:
    """Estimate a campaign by the paper's method: every experiment, and each direction's mean and uncertainty.

    Raises:
        NothingToEstimate: no experiment is complete.
    """
    selection = select_experiments(campaign)
    points = campaign.points_mm[selection.spot_rows]
    angles = four_point_angle_deg(points, selection.axis)
    ratios = np.asarray(ratio_deg_per_step(angles.theta_i_deg, angles.theta_f_deg, selection.steps))
    finite = np.isfinite(ratios)
    skipped = list(selection.skipped)
    for row in np.flatnonzero(~finite):
        lost = not np.isfinite(points[row]).all()
        reason = "a pixel cannot be undistorted or triangulated" if lost else "both points of a beam are the same"
        skipped.append(SkippedExperiment(int(selection.experiments[row]), str(selection.direction[row]), reason))
    skipped.sort(key=lambda one: rank((one.direction, one.experiment)))
    if not finite.any():
        first = f"; the first: experiment {skipped[0].name}, {skipped[0].reason}" if skipped else ""
        raise NothingToEstimate(
            "no-experiment",
            f"no complete four-point experiment among the {len(skipped)} named in spots.csv{first}",
            file="spots.csv",
            column="experiment",
            allowed="points 1 to 4 of one experiment, one axis moved between points 2 and 3",
            remedy="name experiment and point in spots.csv, or use `fit`, which needs neither",
        )
    directions: dict[str, DirectionResult | None] = {}
    for name in DIRECTIONS:
        rows = np.flatnonzero(finite & (selection.direction == name))
        directions[name] = _direction(campaign, selection, rows, ratios[rows]) if len(rows) else None
    commanded = selection.experiments, selection.direction, selection.steps
    columns = (*commanded, angles.theta_i_deg, angles.theta_f_deg, ratios)
    experiments = tuple(Experiment(*row) for row in zip(*(c[finite].tolist() for c in columns), strict=True))
    return ClassicResult(directions, experiments, tuple(skipped))


def _direction(campaign: Campaign, selection: Selection, rows: np.ndarray, ratios: np.ndarray) -> DirectionResult:
    """Compute the statistics of one direction; `rows` index the selection, `ratios` (n,) are its results."""

    def mean(stereo: Stereo, focal_scale: float) -> float:
        chosen = selection.pixels[rows], selection.steps[rows], selection.axis[rows]
        return float(np.mean(four_point_ratios(*chosen, stereo, focal_scale)))

    n = len(ratios)
    average = float(np.mean(ratios))
    focal_u = campaign.rig.priors["focal_scale"].u
    type_b = float(np.sqrt(stereo_variance(mean, campaign.stereo_pair, focal_u)))
    if n == 1:
        return DirectionResult(1, average, None, None, None, None, None, type_b, None)
    sd = float(np.std(ratios, ddof=1))
    type_a = sd / np.sqrt(n)
    gum = float(np.hypot(type_a, type_b))
    dof = effective_dof(gum, (type_a, type_b), (n - 1, math.inf))
    return DirectionResult(
        n=n,
        mean_deg_per_step=average,
        sd_deg_per_step=sd,
        u_type_a_deg_per_step=float(type_a),
        interval95_type_a=_interval(average, type_a, n - 1),
        u_gum_deg_per_step=gum,
        interval95_gum=_interval(average, gum, dof),
        u_stereo_deg_per_step=type_b,
        effective_dof=dof if math.isfinite(dof) else None,
        outlier=_outlier(campaign, selection, rows, ratios),
    )


def _outlier(campaign: Campaign, selection: Selection, rows: np.ndarray, ratios: np.ndarray) -> Outlier | None:
    far = int(np.argmax(np.abs(ratios - np.mean(ratios))))
    p = grubbs_p(ratios)
    if p >= OUTLIER_LEVEL:
        return None
    others = np.delete(ratios, far)
    play = _play_before(campaign, selection, rows)
    return Outlier(
        experiment=int(selection.experiments[rows[far]]),
        deg_per_step=float(ratios[far]),
        p=p,
        mean_without_deg_per_step=float(np.mean(others)),
        sd_without_deg_per_step=float(np.std(others, ddof=1)),
        play_alone=play[far] if play.count(play[far]) == 1 else None,
    )


def _play_before(campaign: Campaign, selection: Selection, rows: np.ndarray) -> list[str]:
    """How the moved axis approached the first beam of each experiment, as against its steps."""
    rests = {axis: rests_of(campaign.moves, axis) for axis in AXES}
    row_of = {move.move: row for row, move in enumerate(campaign.moves)}
    names = {1: "cleared", -1: "reversed", 0: "unknown"}
    looks = [campaign.spots[selection.spot_rows[row][1]] for row in rows]
    signs = [rests[selection.axis[row]][row_of[look.move]].sign for row, look in zip(rows, looks, strict=True)]
    return [names[int(sign * np.sign(selection.steps[row]))] for row, sign in zip(rows, signs, strict=True)]


def _interval(mean: float, u: float, dof: float) -> tuple[float, float]:
    """Compute the two-sided 95 % interval with Student's t."""
    factor = coverage_factor(dof)
    return (float(mean - factor * u), float(mean + factor * u))


def stereo_variance(function: Callable[[Stereo, float], float], stereo: Stereo, focal_scale_u: float) -> float:
    """Compute J C J^T of a scalar `function(stereo, focal_scale)` for the stereo covariance and the focal scale.

    Central differences with steps of one tenth of each parameter's standard deviation: small enough for the third
    derivative to be negligible, large enough against rounding. Fixed parameters (zero variance) are skipped. A step
    that takes a pixel out of the lens model is halved until it does not.
    """

    def slope(of: Callable[[float], float], step: float) -> float:
        for _ in range(STEP_HALVINGS):
            difference = (of(step) - of(-step)) / (2 * step)
            if np.isfinite(difference):
                break
            step /= 2
        return difference

    def moved(index: int, step: float) -> float:
        vector = stereo.vector.copy()
        vector[index] += step
        return function(stereo.with_vector(vector), 1.0)

    covariance = np.asarray(stereo.parameter_covariance, float)
    gradient = np.zeros(len(covariance))
    for index in np.flatnonzero(np.diag(covariance) > 0).tolist():
        gradient[index] = slope(partial(moved, index), 0.1 * np.sqrt(covariance[index, index]))
    variance = float(gradient @ covariance @ gradient)
    if focal_scale_u > 0:
        variance += (slope(lambda step: function(stereo, 1 + step), 0.1 * focal_scale_u) * focal_scale_u) ** 2
    return max(variance, 0.0)


def classic_of(campaign: Campaign) -> ClassicResult | None:
    """Return `classic`, None where no experiment is complete."""
    try:
        return classic(campaign)
    except NothingToEstimate:
        return None
