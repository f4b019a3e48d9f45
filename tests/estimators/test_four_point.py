"""The paper's estimator: worked example, triangulation, selection of experiments, statistics, GUM.

Frame S in mm, pixels, degrees. Cameras are projected by the twin's own optics, which share nothing with
OpenCV's triangulation.
"""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from support.small_campaign import small_stereo
from support.written_rows import move_row, spot_row

from tvsbayes.errors import NothingToEstimate
from tvsbayes.estimators.four_point import (
    classic,
    four_point_ratios,
    ratio_deg_per_step,
    ratio_slopes,
    select_experiments,
    stereo_variance,
)
from tvsbayes.instrument.campaign import Campaign, Spot
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.parameters import Prior
from tvsbayes.instrument.rig import RigTable
from tvsbayes.instrument.stereo_pair import Stereo, distort, triangulate, undistort
from tvsbayes.twin.physics import project

ROUNDING_MM = 1e-7
"""Rounding of 1e-13 px through the depth gain Z^2/(f B) of 1 to 2 mm/px and the DLT's SVD, times 10^5."""
ROUNDING_DEG = 1e-8
"""The same over 100 mm of depth difference: 1e-7 mm / 100 mm = 6e-8 deg, divided by N = 200, times 30."""
STEREO = replace(small_stereo(), parameter_covariance=np.zeros((24, 24)))
"""A pair with strong barrel distortion, f 800 px, 85 mm apart, known exactly."""
IDEAL = replace(STEREO, D1=np.zeros(5), D2=np.zeros(5), R=np.eye(3), T=np.array([-85.0, 0.0, 0.0]))
"""Parallel cameras without distortion."""


def calibration_covariance() -> np.ndarray:
    """A covariance with correlated fx, fy and free k1, R, T; the rest fixed (zero rows)."""
    sd = np.zeros(24)
    sd[[0, 1, 9, 10]], sd[[4, 13]], sd[18:21], sd[21:24] = 1.2, 0.002, 2e-4, 0.05
    correlation = np.eye(24)
    correlation[0, 1] = correlation[1, 0] = correlation[9, 10] = correlation[10, 9] = 0.95
    return correlation * np.outer(sd, sd)


def four_points(
    theta_i_deg: float, theta_f_deg: float, axis: str, depths_mm: tuple[float, float] = (175.0, 275.0)
) -> np.ndarray:
    """Points 1 to 4 in S of two beams through (0, -60, 0) with the given slopes in the axis' plane."""
    column = {"pan": 1, "tilt": 2}[axis]
    points = np.zeros((4, 3))
    near, far = depths_mm
    points[:, 0] = near, far, far, near
    points[:, 1] = -60.0
    for row, theta in enumerate((theta_i_deg, theta_i_deg, theta_f_deg, theta_f_deg)):
        points[row, column] += points[row, 0] * np.tan(np.radians(theta))
    return points


def make_campaign(
    experiments: list[tuple[str, int, float, float]],
    covariance: np.ndarray | None = None,
    focal_u: float = 0.0,
) -> Campaign:
    """Noise-free campaign of (axis, steps, theta_i, theta_f); each starts at counters 0, 0."""
    stereo = STEREO if covariance is None else replace(STEREO, parameter_covariance=covariance)
    moves = [move_row(0, 0, 0.0, 0, 0, "left", "up")]
    spots: list[Spot] = []
    for number, (axis, steps, theta_i, theta_f) in enumerate(experiments):
        start = len(moves) - 1
        counters = (steps, 0) if axis == "pan" else (0, steps)
        moves.append(move_row(start + 1, 0, float(start), *counters))
        moves.append(move_row(start + 2, 0, float(start), 0, 0))
        pixels = project(four_points(theta_i, theta_f, axis), stereo)
        assert np.isfinite(pixels).all()
        for point, row in enumerate(pixels, 1):
            move, target = start + (point > 2), "d1" if point in (1, 4) else "d2"
            spots.append(spot_row(len(spots), move, target, number, point, *map(float, row), *(0.08,) * 4))
    priors = {**TWO_MIRROR.priors, "focal_scale": Prior(1.0, focal_u)}
    return Campaign(tuple(moves), tuple(spots), stereo, RigTable(priors))


def test_worked_example_of_the_paper():
    """18.53 deg, 30.41 deg, 200 steps: 0.0594 deg/step as printed, by formula and from four spots."""
    assert round(ratio_deg_per_step(18.53, 30.41, 200), 4) == 0.0594
    result = classic(make_campaign([("pan", 200, 18.53, 30.41)]))
    (experiment,) = result.experiments
    assert experiment.theta_i_deg == pytest.approx(18.53, abs=200 * ROUNDING_DEG)
    assert experiment.theta_f_deg == pytest.approx(30.41, abs=200 * ROUNDING_DEG)
    assert round(experiment.deg_per_step, 4) == 0.0594
    assert experiment.direction == "left"


def test_undistortion_converges_to_the_corners():
    """Re-distorting returns every pixel of the image, corners included."""
    stereo = STEREO
    pixels = np.stack(np.meshgrid(np.linspace(0, 1279, 15), np.linspace(0, 719, 9)), axis=-1).reshape(-1, 2)
    normalised = undistort(pixels, stereo.M1, stereo.D1)
    returned = distort(normalised, stereo.D1) @ stereo.M1[:2, :2].T + stereo.M1[:2, 2]
    assert np.max(np.abs(returned - pixels)) < 1e-9
    five = distort(normalised, stereo.D1 * 0) @ stereo.M1[:2, :2].T + stereo.M1[:2, 2]
    assert np.max(np.abs(five - pixels)) > 100, "the distortion of this test is strong at the corners"


def test_undistortion_reports_a_pixel_without_origin():
    """Beyond the radius where the polynomial turns back there is no answer: NaN, not a guess."""
    camera = np.array([[800.0, 0.0, 640.0], [0.0, 800.0, 360.0], [0.0, 0.0, 1.0]])
    folding = np.array([-0.5, 0.0, 0.0, 0.0, 0.0])  # r (1 - r^2/2) peaks at 0.544
    result = undistort(np.array([[640.0 + 800 * 0.5, 360.0], [640.0 + 800 * 0.6, 360.0]]), camera, folding)
    assert np.isfinite(result[0]).all() and np.isnan(result[1]).all()


@pytest.mark.parametrize("focal_scale", [1.0, 1.004])
def test_triangulation_inverts_projection(focal_scale: float):
    """Points all over the shared field come back, with the same focal scale on both sides."""
    rng = np.random.default_rng(1)
    stereo = STEREO
    points = np.column_stack((rng.uniform(170, 500, 400), rng.uniform(-200, 100, 400), rng.uniform(-120, 120, 400)))
    pixels = project(points, stereo, focal_scale)
    inside = np.isfinite(pixels).all(axis=1)
    assert inside.sum() > 150
    assert np.abs(triangulate(stereo, pixels[inside], focal_scale) - points[inside]).max() < ROUNDING_MM


def test_statistics_of_known_ratios():
    """Mean, sd (n - 1), u = s/sqrt(n) and Student's interval in closed form for three known angles."""
    result = classic(make_campaign([("pan", 200, 10.0, 10.0 + d) for d in (11.8, 12.0, 12.5)]))
    left = result.directions["left"]
    ratios = np.array([11.8, 12.0, 12.5]) / 200
    deviation = ratios - ratios.sum() / 3
    sd = np.sqrt((deviation**2).sum() / 2)
    assert left.n == 3
    assert left.mean_deg_per_step == pytest.approx(ratios.sum() / 3, abs=ROUNDING_DEG)
    assert left.sd_deg_per_step == pytest.approx(sd, abs=ROUNDING_DEG)
    assert left.u_type_a_deg_per_step == pytest.approx(sd / np.sqrt(3), abs=ROUNDING_DEG)
    half = 4.302652729911275 * sd / np.sqrt(3)  # t of 2 degrees of freedom, 0.975: tables
    assert left.interval95_type_a == pytest.approx((ratios.mean() - half, ratios.mean() + half), abs=ROUNDING_DEG * 5)
    # A fixed calibration adds nothing: GUM is type A, with its n - 1 degrees of freedom.
    assert left.u_gum_deg_per_step == pytest.approx(left.u_type_a_deg_per_step, rel=1e-12)
    assert left.effective_dof == pytest.approx(2.0, rel=1e-9)
    assert [result.directions[name] for name in ("right", "up", "down")] == [None, None, None]


SCATTER_DEG = (0.05, -0.04, 0.01, -0.02, 0.03, -0.05, 0.02, 0.0, -0.01, 0.04)


def test_the_experiment_that_makes_the_sd_is_named_with_its_approach():
    """The first of a homing has no play to lose, the others return and reverse: it stands out, and why is known."""
    angles = [12.0 + 0.9, *(12.0 + d for d in SCATTER_DEG)]
    left = classic(make_campaign([("pan", 200, 10.0, 10.0 + d) for d in angles])).directions["left"]
    assert left.outlier.experiment == 0 and left.outlier.play_alone == "cleared" and left.outlier.p < 1e-4
    rest = np.array(angles[1:]) / 200
    assert left.outlier.sd_without_deg_per_step == pytest.approx(np.std(rest, ddof=1), abs=ROUNDING_DEG)
    assert left.outlier.mean_without_deg_per_step == pytest.approx(np.mean(rest), abs=ROUNDING_DEG)
    # Another one, reversed as most are: named, without a reason.
    moved = [*angles[1:6], angles[0], *angles[6:]]
    left = classic(make_campaign([("pan", 200, 10.0, 10.0 + d) for d in moved])).directions["left"]
    assert left.outlier.experiment == 5 and left.outlier.play_alone is None
    # An ordinary scatter has none.
    even = classic(make_campaign([("pan", 200, 10.0, 22.0 + d) for d in SCATTER_DEG])).directions["left"]
    assert even.outlier is None


def test_one_experiment_has_a_mean_and_no_sd():
    """With n = 1, what needs two experiments is null, never NaN."""
    document = classic(make_campaign([("tilt", 100, 0.0, 7.0)], calibration_covariance())).as_json()
    up = document["directions"]["up"]
    assert up["n"] == 1 and up["mean_deg_per_step"] == pytest.approx(0.07, abs=ROUNDING_DEG)
    assert up["sd_deg_per_step"] is up["u_type_a_deg_per_step"] is up["interval95_gum"] is None
    assert "NaN" not in json.dumps(document)


def test_gum_agrees_with_monte_carlo_over_calibrations():
    """J C J^T against the spread of the mean over 1500 drawn calibrations and focal scales."""
    covariance = calibration_covariance()
    campaign = make_campaign([("pan", 200, 18.5, 30.4), ("pan", 200, 18.6, 30.3)], covariance, focal_u=0.002)
    left = classic(campaign).directions["left"]
    chosen = select_experiments(campaign)
    rng = np.random.default_rng(3)
    vectors = rng.multivariate_normal(campaign.stereo.vector, covariance, size=1500, method="eigh")
    scales = 1 + 0.002 * rng.standard_normal(1500)
    means = [
        four_point_ratios(chosen.pixels, chosen.steps, chosen.axis, campaign.stereo.with_vector(v), f).mean()
        for v, f in zip(vectors, scales, strict=True)
    ]
    # An sd of 1500 draws has a relative sd of 1/sqrt(3000) = 1.8 %; four of them.
    assert left.u_stereo_deg_per_step == pytest.approx(np.std(means, ddof=1), rel=4 * 0.018)
    assert left.u_gum_deg_per_step == pytest.approx(np.hypot(left.u_type_a_deg_per_step, left.u_stereo_deg_per_step))
    assert left.effective_dof == pytest.approx((left.u_gum_deg_per_step / left.u_type_a_deg_per_step) ** 4, rel=1e-9)
    width_a, width_gum = (np.ptp(i) for i in (left.interval95_type_a, left.interval95_gum))
    factor_gum = width_gum / left.u_gum_deg_per_step
    assert factor_gum < width_a / left.u_type_a_deg_per_step, "more degrees of freedom, a smaller factor"


def test_the_stereo_covariance_counts_with_its_correlations():
    """J C J^T of a linear function by hand, the focal scale with its own variance; what is fixed adds nothing."""
    rng = np.random.default_rng(4)
    root = 1e-4 * rng.standard_normal((24, 3))
    root[5] = 0.0
    covariance, slopes = root @ root.T, rng.standard_normal(24)

    def function(stereo: Stereo, focal_scale: float) -> float:
        return float(slopes @ stereo.vector) + 3.0 * focal_scale

    variance = stereo_variance(function, replace(STEREO, parameter_covariance=covariance), 0.002)
    # Differences of numbers of order 1000 over steps of 1e-5.
    assert variance == pytest.approx(slopes @ covariance @ slopes + (3.0 * 0.002) ** 2, rel=1e-6)
    assert slopes @ covariance @ slopes != pytest.approx(slopes**2 @ np.diag(covariance), rel=0.2)


def test_focal_error_shifts_the_ratio_as_no_repeat_can_show():
    """Ideal parallel cameras: a focal length 0.5 % too large divides every tangent by 1.005."""
    pixels = project(four_points(18.5, 30.4, "pan"), IDEAL).reshape(1, 4, 4)
    ratio = four_point_ratios(pixels, np.array([200]), "pan", IDEAL, 1.005)[0]
    angles = np.degrees(np.arctan(np.tan(np.radians([18.5, 30.4])) / 1.005))
    # The near and far points share the intercept, which scales with depth and leaves the slope alone.
    assert ratio == pytest.approx((angles[1] - angles[0]) / 200, abs=ROUNDING_DEG)
    assert ratio / 0.0595 - 1 == pytest.approx(-0.0033, abs=0.00005)  # two digits


def test_slopes_by_pixels_are_those_of_the_closed_form():
    """Ideal parallel cameras: depth and width by the disparity in one row, differentiated by the complex step.

    Vertical pixels count for nothing in a pan; the DLT agrees with the closed form in them, where both rows are equal,
    to first order.
    """
    pixels = project(four_points(18.5, 30.4, "pan"), IDEAL).reshape(4, 4)

    def ratio(spots: np.ndarray) -> complex:
        left, right = ((spots[:, k] - m[0, 2]) / m[0, 0] for k, m in ((0, IDEAL.M1), (2, IDEAL.M2)))
        depth = 85.0 / (left - right)
        across = -left * depth
        after, before = ((across[j] - across[i]) / (depth[j] - depth[i]) for i, j in ((3, 2), (0, 1)))
        return np.degrees(1) * (np.arctan(after) - np.arctan(before)) / 200

    step = 1e-30
    expected = [
        [ratio(pixels + 1j * step * np.eye(16)[4 * p + k].reshape(4, 4)).imag / step for k in (0, 2)] for p in range(4)
    ]
    slopes = ratio_slopes(pixels, np.array([200]), "pan", IDEAL)
    assert slopes.ratio[0] == pytest.approx(ratio(pixels).real, abs=ROUNDING_DEG)
    # A difference quotient over 0.01 px of what bends within 10 px: 1e-3 at most.
    assert slopes.by_pixel[0][:, [0, 2]] == pytest.approx(np.array(expected), rel=1e-3)


def test_a_step_out_of_the_lens_model_is_shortened():
    """sqrt(1 - x) at x = 0.99 with sd 1: a tenth of it leads beyond 1; the slope is -1 / (2 sqrt(0.01)) = -5."""
    start = STEREO.vector[0]

    def function(stereo: Stereo, focal_scale: float) -> float:
        with np.errstate(invalid="ignore"):
            return float(np.sqrt(0.01 - (stereo.vector[0] - start) - 100 * (focal_scale - 1)))

    covariance = np.zeros((24, 24))
    covariance[0, 0] = 1.0
    # 0.1 halved four times is the first step below the distance 0.01: its difference quotient by hand, 6 % off.
    step = 0.1 / 16
    slope = (np.sqrt(0.01 - step) - np.sqrt(0.01 + step)) / (2 * step)
    assert slope == pytest.approx(-5.0, rel=0.06)
    stated = replace(STEREO, parameter_covariance=covariance)
    for variance in (stereo_variance(function, stated, 0.0), stereo_variance(function, STEREO, 0.01)):
        assert variance == pytest.approx(slope**2, rel=1e-9)


def _changed(campaign: Campaign, row: int, **changes) -> Campaign:
    """The campaign with one spot changed."""
    spots = list(campaign.spots)
    spots[row] = replace(spots[row], **changes)
    return replace(campaign, spots=tuple(spots))


def test_incomplete_experiments_are_skipped_with_a_reason():
    """Each kind of incomplete experiment names its own reason; the good ones stay."""
    campaign = make_campaign([("pan", 200, 10.0, 22.0)] * 9)
    none = dict.fromkeys(("u_left_px", "v_left_px", "u_right_px", "v_right_px"))
    campaign = _changed(campaign, 4 * 1 + 2, status="undetected", **none)
    campaign = _changed(campaign, 4 * 2 + 3, experiment=None)
    campaign = _changed(campaign, 4 * 3 + 0, point=2)
    campaign = _changed(campaign, 4 * 4 + 1, move=1)
    campaign = _changed(campaign, 4 * 5 + 2, move=0)
    moves = list(campaign.moves)
    moves[13] = replace(moves[13], tilt_steps=5)
    moves[15] = replace(moves[15], pan_steps=0)
    moves[17:] = [replace(move, segment=1) for move in moves[17:]]
    campaign = replace(campaign, moves=tuple(moves))
    result = classic(campaign)
    reasons = {skipped.experiment: skipped.reason for skipped in result.skipped}
    assert [e.experiment for e in result.experiments] == [0]
    assert reasons == {
        1: "point 3 is not usable: status undetected",
        2: "point 4 is missing",
        3: "point 1 is missing",
        4: "points 1 and 2 were seen at different counters",
        5: "points 3 and 4 were seen at different counters",
        6: "both axes moved between points 2 and 3 (pan +200, tilt +5 steps)",
        7: "no axis moved between points 2 and 3",
        8: "the positioner was homed within the experiment",
    }
    assert len(result.as_json()["skipped"]) == 8


def test_a_look_written_down_twice_is_no_fault_of_the_lens():
    """Points 1 and 2 have the same pixels: no line goes through one point."""
    campaign = make_campaign([("pan", 200, 10.0, 22.0)] * 2)
    names = ("u_left_px", "v_left_px", "u_right_px", "v_right_px")
    same = {name: getattr(campaign.spots[4], name) for name in names}
    (skipped,) = classic(_changed(campaign, 5, **same)).skipped
    assert (skipped.experiment, skipped.reason) == (1, "both points of a beam are the same")
    (skipped,) = classic(_changed(campaign, 5, u_left_px=1e6)).skipped
    assert (skipped.experiment, skipped.reason) == (1, "a pixel cannot be undistorted or triangulated")


def test_nothing_to_estimate():
    """No complete experiment: an error with exit code 3 that names the first reason."""
    campaign = make_campaign([("pan", 200, 10.0, 22.0)])
    with pytest.raises(NothingToEstimate, match="point 4 is missing") as caught:
        classic(_changed(campaign, 3, experiment=None))
    assert caught.value.exit_code == 3
    with pytest.raises(NothingToEstimate):
        classic(replace(campaign, spots=()))


def test_each_direction_counts_from_one():
    """The paper's Table 1 from a book that begins anew in each direction; a skipped one is named with its direction."""
    ways = {"left": ("pan", 200), "right": ("pan", -200), "up": ("tilt", 100), "down": ("tilt", -100)}
    rows = [(*way, 10.0, 10.0 + 0.06 * way[1] + 0.3 * k) for way in ways.values() for k in range(3)]
    campaign = make_campaign(rows)
    unique = classic(campaign)
    restarted = tuple(replace(spot, experiment=1 + spot.experiment % 3) for spot in campaign.spots)
    result = classic(replace(campaign, spots=restarted))
    assert result.directions == unique.directions and {r.n for r in result.directions.values()} == {3}
    assert {(e.direction, e.experiment) for e in result.experiments} == {(d, n) for d in ways for n in (1, 2, 3)}
    lost = replace(restarted[4 * 4], status="too dim")
    (skipped,) = classic(replace(campaign, spots=(*restarted[:16], lost, *restarted[17:]))).skipped
    assert (skipped.direction, skipped.experiment, skipped.name) == ("right", 2, "2 (right)")
