"""What does `stereo` say of pictures that others took, beside OpenCV's joint calibration, and is its covariance true?

    python -m experiments.real.stereo_pairs > experiments/real/stereo_pairs.md

The shipped pairs. No truth is needed: cv2.stereoCalibrate from the same corners with the same
coefficients, all free; halves of the pairs against each other by the covariance that both state; then the same pairs
spoiled in known ways: left k with right k + 1, corners turned by half a turn, boards missing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from scipy import stats

from experiments.common.board_views import chi2
from experiments.common.command_line import print_only
from experiments.common.figures import page_figure, title_and_figure
from experiments.common.opencv_stereo import calibrated
from tvsbayes.cameras.boards import Board, View, corner_orders, find_views
from tvsbayes.cameras.stereo_calibration import StereoCalibration, calibrate_stereo
from tvsbayes.errors import TvsError
from tvsbayes.report.drawing import BLACK, BLUE, RED

PAIRS, FIGURE = Path("data/real/stereo/bumblebee2"), Path("data/docs/real_stereo.png")
SHIPPED_BASELINE_MM = 120.05
"""|T| of `stereo.yaml`, which came with the pairs: another program, other coefficients, no uncertainty."""
SPLITS = 60


@dataclass(frozen=True)
class Joint:
    """What cv2.stereoCalibrate finds with everything free: rms over corners, px, and |T|, mm."""

    rms_px: float
    baseline_mm: float


@dataclass(frozen=True)
class Halves:
    """Two calibrations against each other by what both state: chi-square per parameter, z of every one."""

    chi2: float
    z: np.ndarray


def pairs_of(views: Sequence[View]) -> list[View]:
    """Views that both cameras saw."""
    return [view for view in views if view.left is not None and view.right is not None]


def opencv_joint(views: Sequence[View], board: Board, size: tuple[int, int]) -> Joint:
    """OpenCV's calibration from the same corners."""
    sides = [[getattr(view, side) for view in views] for side in ("left", "right")]
    flags = cv2.CALIB_USE_INTRINSIC_GUESS
    rms, *_, shift = calibrated(board.points_mm, sides, size, flags, ends=(300, 1e-12))
    return Joint(float(rms), float(np.linalg.norm(shift)))


def against(one: StereoCalibration, other: StereoCalibration) -> Halves:
    """The difference of two calibrations in what they state."""
    covariance = one.stereo.parameter_covariance + other.stereo.parameter_covariance
    free = np.diag(covariance) > 0
    difference, covariance = (one.stereo.vector - other.stereo.vector)[free], covariance[np.ix_(free, free)]
    return Halves(chi2(difference, covariance) / len(difference), difference / np.sqrt(np.diag(covariance)))


def split(views: Sequence[View], first: Sequence[int], board: Board, size: tuple[int, int]) -> Halves:
    """Calibrations of some views and of the others."""
    parts = [[view for k, view in enumerate(views) if (k in set(first)) == which] for which in (True, False)]
    one, two = (calibrate_stereo(part, board, size) for part in parts)
    return against(one, two)


def spoiled(views: Sequence[View], board: Board) -> dict[str, list[View]]:
    """The pairs with mistakes that must be refused or corrected."""
    after = [*views[1:], views[0]]
    shifted = [replace(view, right=later.right) for view, later in zip(views, after, strict=True)]
    turned = [replace(view, right=view.right[corner_orders(board)[1]]) for view in views if view.right is not None]
    half = len(views) // 2
    return {
        "as they are": list(views),
        "every left k with right k + 1": shifted,
        "the first pair so": [shifted[0], *views[1:]],
        "the first three so": [*shifted[:3], *views[3:]],
        "more than half so": [*shifted[: half + 1], *views[half + 1 :]],
        "right corners of one pair turned by half a turn": [turned[0], *views[1:]],
        "of all pairs": turned,
        "board unseen by the right camera twice": [replace(view, right=None) for view in views[:2]] + list(views[2:]),
        "four pairs only": list(views[:4]),
    }


def row_of(views: Sequence[View], board: Board, size: tuple[int, int]) -> str:
    """A row: what comes of views."""
    try:
        calibration = calibrate_stereo(views, board, size)
    except TvsError as error:
        return f"| refused: {error.message} | | | |"
    names = [", ".join(part) or "none" for part in (calibration.excluded, calibration.reordered)]
    baseline = f"{np.linalg.norm(calibration.stereo.T):.2f} ({calibration.baseline_sd_mm:.2f})"
    return f"| {calibration.stereo.rms_px:.3f} | {baseline} | {names[0]} | {names[1]} |"


def draw(splits: Sequence[Halves], named: Halves) -> None:
    """Z of all parameters of all splits beside the normal one, and chi-square by split."""
    with page_figure(FIGURE, 3.2, width_in=8.0) as figure:
        left, right = figure.subplots(1, 2)
        z, x = np.concatenate([one.z for one in splits]), np.linspace(-4, 4, 161)
        left.hist(z, np.arange(-4.25, 4.5, 0.5), density=True, color=BLUE, alpha=0.6, label="halves")
        left.plot(x, stats.norm.pdf(x), color=BLACK, linewidth=1, label="stated")
        left.set_xlabel("difference of two halves / stated sd, 24 parameters")
        left.set_ylabel("probability density")
        left.legend()
        parameters = len(splits[0].z)
        chi2 = np.sort([one.chi2 for one in splits])
        share = (np.arange(len(chi2)) + 0.5) / len(chi2)
        right.plot(stats.chi2(parameters).ppf(share) / parameters, chi2, ".", color=BLUE, label="random halves")
        right.axhline(named.chi2, color=RED, linewidth=0.8, label="odd against even")
        right.plot([0.3, 2.2], [0.3, 2.2], color=BLACK, linewidth=0.8)
        right.set_xlabel("chi-square per parameter, expected")
        right.set_ylabel("chi-square per parameter, observed")
        right.legend()


def main() -> None:
    print_only(__doc__)
    board = Board(4, 6, 30.0)
    boards = find_views(PAIRS, board)
    size = (boards.image_width, boards.image_height)
    views = pairs_of(boards.views)
    ours, theirs = calibrate_stereo(views, board, size), opencv_joint(views, board, size)
    baseline = float(np.linalg.norm(ours.stereo.T))
    words = "Differences of halves of the pairs in stated standard uncertainties"
    print(title_and_figure(__file__, "Real stereo pairs", FIGURE, words))
    print(f"Written by `python -m experiments.real.stereo_pairs`: {len(views)} pairs of `{PAIRS}`,", end=" ")
    print(
        f"{size[0]} x {size[1]} px,\nboard {board.columns} x {board.rows}, squares of {board.pitch_mm:g} mm.", end=" "
    )
    print(f"Found in one picture only: {len(boards.views) - len(views)};", end=" ")
    print(f"no board: {', '.join(boards.without_board) or 'none'}.\n")
    print("| | rms px | baseline mm |\n|---|---|---|")
    print(f"| `stereo` | {ours.stereo.rms_px:.5f} | {baseline:.3f}, u {ours.baseline_sd_mm:.3f} |")
    print(f"| cv2.stereoCalibrate {cv2.__version__} | {theirs.rms_px:.5f} | {theirs.baseline_mm:.3f} |")
    print(f"| ours / theirs | {ours.stereo.rms_px / theirs.rms_px:.6f} | {baseline / theirs.baseline_mm:.6f} |\n")
    away = (baseline - SHIPPED_BASELINE_MM) / ours.baseline_sd_mm
    print(f"The calibration that came with them has {SHIPPED_BASELINE_MM} mm: {away:+.1f} stated sds from ours.\n")
    print(f"Corners of the board off a grid by {ours.board_error_mm:.3f} mm (sd of a coordinate), variances of what is")
    print(f"left {ours.correlation_factor:.1f} times those of independent corners.\n")
    rng, half = np.random.default_rng(1), len(views) // 2
    named = split(views, range(0, len(views), 2), board, size)
    splits = [split(views, rng.permutation(len(views))[:half], board, size) for _ in range(SPLITS)]
    chi2s, z = np.array([one.chi2 for one in splits]), np.concatenate([one.z for one in splits])
    print(f"Halves, chi-square per parameter: {chi2s.mean():.2f} on average of {SPLITS} random splits", end=" ")
    print(f"(median {np.median(chi2s):.2f}, largest {chi2s.max():.2f}), RMS z {np.sqrt(np.mean(z**2)):.2f};", end=" ")
    print(f"odd against even {named.chi2:.2f}.\n")
    draw(splits, named)
    print("| pairs | rms px | baseline mm (u) | left out | put into another order |\n|---|---|---|---|---|")
    for what, changed in spoiled(views, board).items():
        print(f"| {what} {row_of(changed, board, size)}")


if __name__ == "__main__":
    main()
