"""The paper's four-point estimator, exactly as printed, with type A and GUM uncertainties (DESIGN 4.4).

Two spots before and two after a move of N steps, each triangulated alone; the beam's slope in the plane
of the moved axis; the difference of two arctangents over N. Frame S (X depth, Y left, Z up, mm); degrees;
pixels with the integer at the centre of a pixel. What the estimator cannot know (backlash, the tangent
of a tilt read off its own azimuth) stays in its answer: that is what it is here for. No JAX.

Also what can be said of a campaign before any fit: which stops its spots tell of, what they cannot separate.

Source: Lopez-Medina et al., Metrology 2025, 5(4), 58, equations (4) to (8).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import pairwise
from operator import attrgetter

import numpy as np

from tvsbayes.campaign import APPROACH_SIGN, Campaign, Move, Spot
from tvsbayes.files import NothingToEstimate, listed
from tvsbayes.rigs import Stereo, pair_doubts

DIRECTIONS = ("left", "right", "up", "down")
PIXELS = attrgetter("u_left_px", "v_left_px", "u_right_px", "v_right_px")
NEAREST_SHEET_MM, FARTHEST_SHEET_MM = 20.0, 100_000.0
"""Depths between which a sheet can stand: nearer than a lens barrel, or beyond a hall, is a mismatched pair."""
SHORTEST_BASELINE_MM = 2.0
"""Two lenses cannot stand closer; the longest baseline in metres that anybody calls a stereo pair is shorter."""
SPOTS_LISTED = 10
INSEPARABLE, INSEPARABLE_ONE_LENGTH = 0.9, 0.7
"""Correlation of ratio and backlash above which four fifths (half, where every leg has one length) of the ratio's
variance is exchange with the backlash. Equal numbers of cleared and reversed legs of one length give 0.55."""
SHALLOW = 1.2
"""Ratio of the largest to the smallest depth below which the sheet stood at one place (the paper's: 1.6)."""
STEP_HALVINGS = 40
"""Of a difference quotient's step, until both ends lie in the lens model: a 10^-13th of a standard deviation."""
UNDISTORT_ITERATIONS = 200
UNDISTORT_TOLERANCE_PX = 1e-9
"""Largest error of re-distorting an undistorted pixel: 10^4 times the rounding of 1000 px in float64."""


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
    """An experiment that could not be used, and why in words."""

    experiment: int
    reason: str


@dataclass(frozen=True)
class Selection:
    """The complete experiments of a campaign, as arrays over e experiments.

    Attributes:
        experiments: (e,) experiment numbers.
        spot_rows: (e, 4) rows of `campaign.spots` of points 1 to 4.
        pixels: (e, 4, 4) u_left, v_left, u_right, v_right of points 1 to 4, px.
        steps: (e,) signed N.
        axis: (e,) "pan" or "tilt".
        skipped: what was left out, with reasons.
    """

    experiments: np.ndarray
    spot_rows: np.ndarray
    pixels: np.ndarray
    steps: np.ndarray
    axis: np.ndarray
    skipped: tuple[SkippedExperiment, ...]

    @property
    def direction(self) -> np.ndarray:
        """(e,) "left", "right", "up" or "down" by axis and sign of N (DESIGN 2)."""
        tilt, positive = self.axis == "tilt", self.steps > 0
        return np.where(tilt, np.where(positive, "up", "down"), np.where(positive, "left", "right"))


@dataclass(frozen=True)
class DirectionResult:
    """Mean of one direction's experiments, deg/step, with type A and GUM uncertainty.

    What needs two experiments (`sd`, `u`, intervals, degrees of freedom) is None for n = 1.
    `u_stereo_deg_per_step` is sqrt(J C J^T) of stereo parameters and focal scale alone;
    `effective_dof` is Welch-Satterthwaite's, with infinitely many for that type B part.
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

    def as_json(self) -> dict[str, object]:
        """The direction's object of `classic --json` (DESIGN 8); infinite dof becomes null."""
        document = asdict(self)
        for name in ("interval95_type_a", "interval95_gum"):
            document[name] = None if document[name] is None else list(document[name])
        if self.effective_dof is not None and not np.isfinite(self.effective_dof):
            document["effective_dof"] = None
        return document


@dataclass(frozen=True)
class ClassicResult:
    """What the paper's method says of a campaign; a direction without experiments is None."""

    directions: dict[str, DirectionResult | None]
    experiments: tuple[Experiment, ...]
    skipped: tuple[SkippedExperiment, ...]

    def as_json(self) -> dict[str, object]:
        """The document of `tvsbayes classic --json` (DESIGN 8)."""
        results = self.directions.items()
        return {
            "directions": {name: None if result is None else result.as_json() for name, result in results},
            "experiments": [asdict(experiment) for experiment in self.experiments],
            "skipped": [asdict(skipped) for skipped in self.skipped],
        }


def ratio_deg_per_step(
    theta_i_deg: float | np.ndarray, theta_f_deg: float | np.ndarray, steps: int | np.ndarray
) -> float | np.ndarray:
    """Equation (5): (theta_f - theta_i) / N with signed N, so that a sane rig gives a positive ratio."""
    return (theta_f_deg - theta_i_deg) / steps


def distort(normalised: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """Apply Brown-Conrady k1 k2 p1 p2 k3 to normalised coordinates (n, 2)."""
    k1, k2, p1, p2, k3 = np.asarray(distortion, float).ravel()
    x, y = normalised.T
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    across = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    down = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.column_stack((across, down))


def undistort(pixels: np.ndarray, camera: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """Normalised coordinates (n, 2) of raw pixels (n, 2), iterated to convergence.

    The result is checked by distorting it again; NaN where it does not return to its pixel within
    `UNDISTORT_TOLERANCE_PX`. OpenCV's default of five iterations would leave tenths of a pixel.
    """
    import cv2

    pixels = np.ascontiguousarray(pixels, float).reshape(-1, 2)
    # OpenCV compares the re-distorted point in px: 1e-12 is rounding of the coordinate itself.
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, UNDISTORT_ITERATIONS, 1e-12)
    coefficients = np.asarray(distortion, float).reshape(1, 5)
    if hasattr(cv2, "undistortPointsIter"):  # OpenCV 4: undistortPoints takes no criteria in Python
        points = cv2.undistortPointsIter(pixels[:, None], camera, coefficients, None, None, criteria)
    else:
        points = cv2.undistortPoints(pixels[:, None], camera, coefficients, criteria=criteria)
    points = points.reshape(-1, 2)
    returned = distort(points, coefficients) @ camera[:2, :2].T + camera[:2, 2]
    good = np.max(np.abs(returned - pixels), axis=1) <= UNDISTORT_TOLERANCE_PX
    return np.where(good[:, None], points, np.nan)


def triangulate(stereo: Stereo, pixels: np.ndarray, focal_scale: float = 1.0) -> np.ndarray:
    """Triangulate raw pixels (n, 4: u_left, v_left, u_right, v_right) to points (n, 3) in frame S, mm.

    Linear (DLT) triangulation of undistorted normalised coordinates with [I|0] and [R|T], as the paper;
    `focal_scale` multiplies fx and fy of both cameras. NaN rows where undistortion does not converge.
    """
    import cv2

    pixels = np.asarray(pixels, float).reshape(-1, 4)
    if len(pixels) == 0:
        return np.empty((0, 3))
    scale = np.array([[focal_scale, 1.0, 1.0], [1.0, focal_scale, 1.0], [1.0, 1.0, 1.0]])
    left = undistort(pixels[:, :2], stereo.M1 * scale, stereo.D1)
    right = undistort(pixels[:, 2:], stereo.M2 * scale, stereo.D2)
    good = np.isfinite(left).all(axis=1) & np.isfinite(right).all(axis=1)
    points_S = np.full((len(pixels), 3), np.nan)
    if good.any():
        first = np.hstack((np.eye(3), np.zeros((3, 1))))
        second = np.hstack((np.asarray(stereo.R, float), np.asarray(stereo.T, float).reshape(3, 1)))
        rays = left[good].T.copy(), right[good].T.copy()
        homogeneous = cv2.triangulatePoints(first, second, *rays).reshape(4, -1)
        x, y, z = homogeneous[:3] / homogeneous[3]
        points_S[good] = np.column_stack((z, -x, -y))
    return points_S


def four_point_angle_deg(points_S_mm: np.ndarray, axis: str | np.ndarray) -> FourPointAngles:
    """Slopes of points 1-2 and 4-3 in the plane of the moved axis, equations (4), (6) and (8).

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
    """Degrees per step (e,) of many experiments at once, through the paper's whole chain.

    Args:
        pixels: (e, 4, 4) raw pixels (u_left, v_left, u_right, v_right) of points 1 to 4.
        steps: (e,) signed N.
        axis: "pan" or "tilt", one or (e,).
        stereo: the calibration to triangulate with.
        focal_scale: common factor on fx, fy of both cameras.
    """
    pixels = np.asarray(pixels, float).reshape(-1, 4, 4)
    points = triangulate(stereo, pixels.reshape(-1, 4), focal_scale).reshape(-1, 4, 3)
    angles = four_point_angle_deg(points, axis)
    return np.asarray(ratio_deg_per_step(angles.theta_i_deg, angles.theta_f_deg, np.asarray(steps)))


def select_experiments(campaign: Campaign) -> Selection:
    """Collect the complete four-point experiments; the others are listed with a reason.

    Complete: one ok spot for each point 1 to 4, points 1 and 2 at the same counters, 3 and 4 at the same,
    exactly one axis moved between, no homing in between.
    """
    moves = {move.move: move for move in campaign.moves}
    rows: dict[int, list[int]] = {}
    for row, spot in enumerate(campaign.spots):
        if spot.experiment is not None:
            rows.setdefault(spot.experiment, []).append(row)
    kept: list[tuple[int, list[int], str, int]] = []
    skipped: list[SkippedExperiment] = []
    for number in sorted(rows):
        by_point, reason = _by_point(campaign.spots, rows[number])
        if reason is None:
            at = [moves[campaign.spots[row].move] for row in by_point]
            axis, steps, reason = _commanded(at)
        if reason is None:
            kept.append((number, by_point, axis, steps))
        else:
            skipped.append(SkippedExperiment(number, reason))
    spot_rows = np.array([k[1] for k in kept], dtype=int).reshape(-1, 4)
    pixels = np.array([[PIXELS(campaign.spots[r]) for r in four] for four in spot_rows], float)
    return Selection(
        experiments=np.array([k[0] for k in kept], dtype=int),
        spot_rows=spot_rows,
        pixels=pixels.reshape(-1, 4, 4),
        steps=np.array([k[3] for k in kept], dtype=int),
        axis=np.array([k[2] for k in kept], dtype="U4"),
        skipped=tuple(skipped),
    )


def _by_point(spots: Sequence[Spot], rows: list[int]) -> tuple[list[int], str | None]:
    """Rows of points 1 to 4 in order, or the reason why there are not exactly four."""
    found: dict[int | None, list[int]] = {}
    for row in rows:
        found.setdefault(spots[row].point, []).append(row)
    ordered = []
    for point in (1, 2, 3, 4):
        here = found.get(point, [])
        if not here:
            return [], f"point {point} is missing"
        ok = [row for row in here if spots[row].status == "ok"]
        if not ok:
            return [], f"point {point} is not usable: status {spots[here[0]].status}"
        if len(ok) > 1:
            return [], f"point {point} is present {len(ok)} times"
        ordered.append(ok[0])
    return ordered, None


def _commanded(at: list[Move]) -> tuple[str, int, str | None]:
    """Moved axis and signed N of the moves under points 1 to 4, or the reason why there is none."""
    one, two, three, four = ((m.segment, m.pan_steps, m.tilt_steps) for m in at)
    if len({m.segment for m in at}) > 1:
        return "", 0, "the positioner was homed within the experiment"
    if one != two:
        return "", 0, "points 1 and 2 were seen at different counters"
    if three != four:
        return "", 0, "points 3 and 4 were seen at different counters"
    pan, tilt = three[1] - two[1], three[2] - two[2]
    if pan and tilt:
        return "", 0, f"both axes moved between points 2 and 3 (pan {pan:+d}, tilt {tilt:+d} steps)"
    if not pan and not tilt:
        return "", 0, "no axis moved between points 2 and 3"
    return ("pan", pan, None) if pan else ("tilt", tilt, None)


def classic(campaign: Campaign) -> ClassicResult:
    """The paper's result for a campaign: every experiment, and each direction's mean and uncertainty.

    Raises:
        NothingToEstimate: no experiment is complete.
    """
    selection = select_experiments(campaign)
    points = triangulate(campaign.stereo, selection.pixels.reshape(-1, 4)).reshape(-1, 4, 3)
    angles = four_point_angle_deg(points, selection.axis)
    ratios = np.asarray(ratio_deg_per_step(angles.theta_i_deg, angles.theta_f_deg, selection.steps))
    finite = np.isfinite(ratios)
    skipped = list(selection.skipped)
    for number in selection.experiments[~finite]:
        skipped.append(SkippedExperiment(int(number), "a pixel cannot be undistorted or triangulated"))
    skipped.sort(key=lambda one: one.experiment)
    if not finite.any():
        first = f"; the first: experiment {skipped[0].experiment}, {skipped[0].reason}" if skipped else ""
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
    columns = selection.experiments, selection.direction, selection.steps
    columns = (*columns, angles.theta_i_deg, angles.theta_f_deg, ratios)
    experiments = tuple(Experiment(*row) for row in zip(*(c[finite].tolist() for c in columns), strict=True))
    return ClassicResult(directions, experiments, tuple(skipped))


def _direction(campaign: Campaign, selection: Selection, rows: np.ndarray, ratios: np.ndarray) -> DirectionResult:
    """Statistics of one direction; `rows` index the selection, `ratios` (n,) are its results."""

    def mean(stereo: Stereo, focal_scale: float) -> float:
        chosen = selection.pixels[rows], selection.steps[rows], selection.axis[rows]
        return float(np.mean(four_point_ratios(*chosen, stereo, focal_scale)))

    n = len(ratios)
    average = float(np.mean(ratios))
    focal_u = campaign.rig.priors["focal_scale"].u
    type_b = float(np.sqrt(stereo_variance(mean, campaign.stereo, focal_u)))
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
        effective_dof=dof,
    )


def coverage_factor(dof: float, probability: float = 0.95) -> float:
    """Student's t_p for two-sided coverage (GUM G.3, G.4.1); fractional degrees of freedom are kept."""
    # Loading it takes a twentieth of the time of a `locate`, which does not need it.
    from scipy.special import ndtri, stdtrit

    upper = 0.5 * (1 + probability)
    return float(stdtrit(dof, upper) if dof < 1e9 else ndtri(upper))


def effective_dof(u: float, contributions: Sequence[float], dof: Sequence[float]) -> float:
    """Effective degrees of freedom of a combined uncertainty, Welch-Satterthwaite (GUM G.4.1, eq. G.2b).

    Args:
        u: combined standard uncertainty of the result.
        contributions: standard uncertainties of the result by each input.
        dof: theirs, infinite where exactly known.
    """
    total = sum(c**4 / nu for c, nu in zip(contributions, dof, strict=True))
    return float(u**4 / total) if total > 0 else math.inf


def _interval(mean: float, u: float, dof: float) -> tuple[float, float]:
    """Two-sided 95 % interval with Student's t."""
    factor = coverage_factor(dof)
    return (float(mean - factor * u), float(mean + factor * u))


def stereo_variance(function: Callable[[Stereo, float], float], stereo: Stereo, focal_scale_u: float) -> float:
    """J C J^T of a scalar `function(stereo, focal_scale)` for the stereo covariance and the focal scale.

    Central differences with steps of one tenth of each parameter's standard deviation: small enough that
    the third derivative does not show, large enough against rounding. Fixed parameters (zero variance)
    are skipped. A step that takes a pixel out of the lens model is halved until it does not.
    """

    def slope(of: Callable[[float], float], step: float) -> float:
        for _ in range(STEP_HALVINGS):
            found = (of(step) - of(-step)) / (2 * step)
            if np.isfinite(found):
                break
            step /= 2
        return found

    def moved(index: int, step: float) -> float:
        vector = stereo.vector.copy()
        vector[index] += step
        return function(stereo.with_vector(vector), 1.0)

    covariance = np.asarray(stereo.parameter_covariance, float)
    gradient = np.zeros(len(covariance))
    for index in np.flatnonzero(np.diag(covariance) > 0):
        gradient[index] = slope(partial(moved, index), 0.1 * np.sqrt(covariance[index, index]))
    variance = float(gradient @ covariance @ gradient)
    if focal_scale_u > 0:
        variance += (slope(lambda step: function(stereo, 1 + step), 0.1 * focal_scale_u) * focal_scale_u) ** 2
    return max(variance, 0.0)


@dataclass(frozen=True)
class Stop:
    """A rest of one axis at which a usable spot was seen; `sign` is the sense of the move that led there."""

    segment: int
    steps: int
    sign: int


def observed_stops(moves: Sequence[Move], observed: Collection[int], axis: str) -> tuple[Stop, ...]:
    """Rests of one axis, in order, that the spots tell of.

    Args:
        moves: all moves in order.
        observed: numbers of the moves after which a usable spot was seen.
        axis: "pan" or "tilt".
    """
    stops: list[Stop] = []
    current, seen, previous = Stop(0, 0, 0), False, 0
    for move in moves:
        steps = move.pan_steps if axis == "pan" else move.tilt_steps
        approach = move.pan_approach if axis == "pan" else move.tilt_approach
        if approach:
            current, seen = Stop(move.segment, steps, APPROACH_SIGN[approach]), False
        elif steps != previous:
            current, seen = Stop(move.segment, steps, 1 if steps > previous else -1), False
        if move.move in observed and not seen:
            stops.append(current)
            seen = True
        previous = steps
    return tuple(stops)


def separation(stops: Sequence[Stop], axis: str) -> str | None:
    """Why a ratio and its backlash cannot be told apart well, and the smallest cure.

    With equal errors at every stop the angle is zero(segment) + k n - b sign / 2: the correlation of k and b in
    this straight line tells before any fit whether the stops separate them.

    Returns:
        A sentence, or None if nothing stands in the way.
    """
    steps = np.array([stop.steps for stop in stops], dtype=float)
    signs = np.array([stop.sign for stop in stops], dtype=float)
    if len({stop.steps for stop in stops}) < 2:
        return f"the {axis} axis was seen at one counter only; look before and after moves of that axis"
    if not (np.any(signs > 0) and np.any(signs < 0)):
        return f"every stop of the {axis} axis was reached from one side; reach some from the other"
    segments = np.array([stop.segment for stop in stops])
    zeros = (segments[:, None] == np.unique(segments)).astype(float)
    design = np.column_stack([steps / np.ptp(steps), -signs / 2, zeros])
    information = design.T @ design
    if np.linalg.matrix_rank(information) < len(information):
        correlation = 1.0
    else:
        covariance = np.linalg.inv(information)
        correlation = abs(covariance[0, 1]) / np.sqrt(covariance[0, 0] * covariance[1, 1])
    # No leg leads from one segment to the next: the counter was set by homing.
    legs = [(a, b) for a, b in pairwise(stops) if a.segment == b.segment and a.steps != b.steps]
    lengths = Counter(abs(b.steps - a.steps) for a, b in legs)
    if not lengths:
        return f"no leg of the {axis} axis was seen at both ends; look before and after moves of that axis"
    if correlation < (INSEPARABLE_ONE_LENGTH if len(lengths) == 1 else INSEPARABLE):
        return None
    common = lengths.most_common(1)[0][0]
    only = f"only one |N| = {common}" if len(lengths) == 1 else f"nearly every leg has |N| = {common} and reverses"
    return f"{only}; add N = {max(common // 2, 1)} or a cleared approach"


@dataclass(frozen=True)
class CampaignCheck:
    """What `check` says of a readable campaign: counts, and warnings in words."""

    moves: int
    segments: int
    spots: int
    ok_spots: int
    refused: dict[str, int]
    aperture_readings: int
    experiments: int
    warnings: tuple[str, ...]

    def as_json(self) -> dict[str, object]:
        """The document of `check --json`."""
        return {"kind": "campaign", **asdict(self), "warnings": list(self.warnings)}


def _depths_mm(campaign: Campaign) -> np.ndarray:
    """X of the usable spots, frame S; not a number where no undistorted point is seen."""
    pixels = np.array([PIXELS(spot) for spot in campaign.spots if spot.status == "ok"], dtype=float)
    return triangulate(campaign.stereo, pixels.reshape(-1, 4))[:, 0]


def _can_stand(depths_mm: np.ndarray) -> np.ndarray:
    return (depths_mm > NEAREST_SHEET_MM) & (depths_mm < FARTHEST_SHEET_MM)


def implausible(campaign: Campaign, depths_mm: np.ndarray | None = None) -> tuple[str, ...]:
    """What no rig can have measured: wrong units, swapped cameras, words that miss their spelling.

    Args:
        campaign: a campaign that its reader accepted.
        depths_mm: of its usable spots, where they are known already.
    """
    depths_mm = _depths_mm(campaign) if depths_mm is None else depths_mm
    few = partial(listed, most=SPOTS_LISTED)
    ok = [spot for spot in campaign.spots if spot.status == "ok"]
    found = []
    misspelt = [s.spot for s in campaign.spots if s.status != "ok" and s.status.strip().lower() == "ok"]
    if misspelt:
        found.append(f"spots {few(misspelt)} are left out: their status is not spelt ok, in small letters")
    stray = [s.spot for s in campaign.spots if s.status == "undetected" and s.u_left_px is not None]
    if stray:
        found.append(f"spots {few(stray)} are undetected and have pixels, which nothing uses: ok, or refused?")
    if not ok:
        return tuple(found)
    found += pair_doubts(campaign.stereo)
    baseline_mm = float(np.linalg.norm(campaign.stereo.T))
    if baseline_mm < SHORTEST_BASELINE_MM:
        found.append(f"T of stereo.json is {baseline_mm:.3g} mm long: is it in metres? Lengths are mm")
    odd = [spot.spot for spot, can in zip(ok, _can_stand(depths_mm), strict=True) if not can]
    if odd:
        limits = f"{NEAREST_SHEET_MM:g} to {FARTHEST_SHEET_MM:g} mm"
        question = "are left and right swapped, or mismatched?"
        found.append(f"spots {few(odd)} triangulate outside {limits}: {question}")
    readings = {s.spot: s.aperture_deg for s in ok if s.aperture_deg is not None}
    beyond = [spot for spot, reading in readings.items() if not 0 < reading < 180]
    if beyond:
        found.append(f"aperture readings of spots {few(beyond)} lie outside 0 to 180 deg from the baseline")
    elif readings and max(readings.values()) < np.pi:
        found.append(f"all aperture readings lie below {np.pi:.2f}: are they in radians? aperture_deg is in degrees")
    return tuple(found)


def check_campaign(campaign: Campaign) -> CampaignCheck:
    """Plausibility and identifiability of a campaign before any fit.

    Args:
        campaign: a campaign that its reader accepted.

    Returns:
        Counts and warnings; an empty tuple means that nothing stands in the way of a fit.
    """
    ok = [spot for spot in campaign.spots if spot.status == "ok"]
    refused = Counter(spot.status for spot in campaign.spots if spot.status != "ok")
    selection = select_experiments(campaign)
    warnings = [f"experiment {s.experiment} is not complete: {s.reason}" for s in selection.skipped]
    if not ok:
        warnings.append("no spot has status ok: there is nothing to estimate from")
    observed = {spot.move for spot in ok}
    for axis in ("pan", "tilt") if ok else ():
        reason = separation(observed_stops(campaign.moves, observed, axis), axis)
        if reason is not None:
            warnings.append(f"{axis} ratio and {axis} backlash are hard to tell apart: {reason}")
    for move in campaign.moves:
        if "unknown" in (move.pan_approach, move.tilt_approach):
            warnings.append(f"segment {move.segment} begins with an unknown approach: its first reversal tells less")
    depths_mm = _depths_mm(campaign)
    warnings += implausible(campaign, depths_mm)
    if ok and np.all(_can_stand(depths_mm)) and depths_mm.max() < SHALLOW * depths_mm.min():
        warnings.append("all spots lie at one depth: a second sheet position sharpens ratios threefold")
    if campaign.stereo.assumed:
        warnings.append("the stereo covariance is assumed, not estimated: uncertainties are only as good as it is")
    if not np.any(campaign.stereo.parameter_covariance):
        warnings.append(
            "the stereo covariance is zero: its error (0.3 to 0.5 % of a ratio) is missing from every interval"
        )
    return CampaignCheck(
        moves=len(campaign.moves),
        segments=1 + campaign.moves[-1].segment,
        spots=len(campaign.spots),
        ok_spots=len(ok),
        refused=dict(refused),
        aperture_readings=sum(spot.aperture_deg is not None for spot in ok),
        experiments=len(selection.experiments),
        warnings=tuple(warnings),
    )
