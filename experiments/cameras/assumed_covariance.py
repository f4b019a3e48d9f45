"""Is the covariance that `stereo --import` makes for a calibration without one the covariance of such calibrations?

    python -m experiments.cameras.assumed_covariance poses --opencv DATA > data/reference/board_poses.csv
    python -m experiments.cameras.assumed_covariance real --opencv DATA     # public sets: halves, own adjustment
    python -m experiments.cameras.assumed_covariance run --n 160            # simulated benches, half a second each
    python -m experiments.cameras.assumed_covariance table > experiments/cameras/assumed_covariance.md

DATA holds left*.jpg and right*.jpg of Debian's opencv-doc (examples/data). `run` draws benches whose truth is known:
f 700 to 1600 px, 80 to 300 mm apart, toed in or not, 15 to 25 views of one of four boards at random poses (not those of
the table), independent corner noise of 0.05 to 0.3 px. OpenCV calibrates them: `joint`, all free from each camera's own
calibration; `fixed`, intrinsics of each camera by itself, CALIB_FIX_INTRINSIC; `no k3`, joint with CALIB_FIX_K3. The
error is whitened by the covariance made from OpenCV's RMS, views, board and way (`all stated`), without the way
(`way unknown`), and from nothing (`nothing stated`). `real` needs no truth: halves of a set against each other.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from experiments.cameras.stereo_coverage import OPENCV_PAIRS
from experiments.common.board_views import chi2
from experiments.common.command_line import study
from experiments.common.opencv_stereo import calibrated
from experiments.common.rows import output
from tvsbayes.cameras.assumed_covariance import (
    CORRELATION_FACTOR,
    GROUPS,
    GUESS_FACTOR,
    USUAL_BOARD,
    USUAL_PITCH_MM,
    USUAL_RMS_PX,
    USUAL_VIEWS,
    Provenance,
    calibration_covariance,
    with_assumed_covariance,
)
from tvsbayes.cameras.boards import Board, Views, find_views
from tvsbayes.cameras.stereo_calibration import StereoCalibration, calibrate_stereo
from tvsbayes.cameras.stereo_start import pose_of
from tvsbayes.instrument.stereo_pair import Stereo, rotation_matrix, rotation_vector

ROWS, REAL = output(__file__, "assumed_covariance.jsonl"), output(__file__, "assumed_covariance_real.json")
BUMBLEBEE = Path("data/real/stereo/bumblebee2")
WAYS = {"joint": 0, "fixed": cv2.CALIB_FIX_INTRINSIC, "no k3": cv2.CALIB_FIX_K3}
BOARDS = (Board(9, 6, 25.0), Board(8, 5, 30.0), Board(11, 8, 20.0), Board(7, 6, 40.0))
SIZES = ((1280, 960), (1280, 720), (1920, 1080), (1440, 1080))
MADE = ("all stated", "way unknown", "nothing stated")
SPLITS = 40
RMS_MAX_PX = 1.0
"""Calibrations that ended in a local minimum are left out."""


@dataclass(frozen=True)
class Bench:
    """A drawn pair with corners of boards: (views, corners, 2) of each camera."""

    true: Stereo
    board: Board
    left: np.ndarray
    right: np.ndarray
    noise_px: float


def drawn_bench(seed: int) -> Bench:
    """A bench of other geometry than the table of poses: boards by distance and tilt, anywhere in both pictures."""
    rng = np.random.default_rng([seed, 45])
    size = SIZES[int(rng.integers(len(SIZES)))]
    focal, baseline = rng.uniform(700, 1600), rng.uniform(80, 300)
    cameras = []
    for _ in range(2):
        fx = focal * (1 + 0.01 * rng.standard_normal())
        middle = np.array(size) / 2 - 0.5 + 0.015 * size[0] * rng.standard_normal(2)
        k1 = rng.uniform(-0.35, 0.1)
        aspect = 1 + 1e-3 * rng.standard_normal()
        cameras.append([fx, aspect * fx, *middle, k1, 0.4 * k1**2, *rng.normal(0, 5e-4, 2), 0.0])
    toe = rng.uniform(0, 0.6) * baseline / 700
    turn = rotation_matrix(rng.normal(0, 0.01, 3)) @ rotation_matrix(np.array([0, toe, 0]))
    # The right camera stands to the right whatever its turn.
    shift = turn @ [-baseline, *rng.normal(0, 2, 2)]
    true = Stereo.of_vector(np.array([*cameras[0], *cameras[1], *rotation_vector(turn), *shift]), size)
    board, count = BOARDS[int(rng.integers(len(BOARDS)))], int(rng.integers(15, 26))
    noise, width = rng.uniform(0.05, 0.3), (board.columns - 1) * board.pitch_mm
    views: list[list[np.ndarray]] = [[], []]
    while len(views[0]) < count:
        depth = focal * width / (size[0] * rng.uniform(0.2, 0.6))
        axis = rng.standard_normal(2)
        tilt = rng.uniform(0, 0.7) * axis / np.linalg.norm(axis)
        turn = rotation_matrix(np.array([*tilt, 0.0])) @ rotation_matrix(np.array([0, 0, rng.normal(0, 0.4)]))
        shift = depth * np.array([*(rng.uniform(-0.5, 0.5, 2) * size / focal), 1.0]) + [baseline / 2, 0, 0]
        left = board.points_mm @ turn.T + shift
        pixels = [
            cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, distortion)[0].reshape(-1, 2)
            for points, matrix, distortion in ((left, true.M1, true.D1), (left @ true.R.T + true.T, true.M2, true.D2))
        ]
        if all(((p > 0) & (p < np.array(size) - 1)).all() for p in pixels):
            for fx, corners in zip(views, pixels, strict=True):
                fx.append(corners + noise * rng.standard_normal(corners.shape))
    return Bench(true, board, np.array(views[0]), np.array(views[1]), noise)


def by_opencv(bench: Bench, way: str) -> tuple[Stereo, float]:
    """OpenCV's calibration of a bench, and its RMS."""
    size, lens = (bench.true.image_width, bench.true.image_height), WAYS[way] & cv2.CALIB_FIX_K3
    flags = WAYS[way] if way == "fixed" else cv2.CALIB_USE_INTRINSIC_GUESS
    sides = (bench.left, bench.right)
    rms, m1, d1, m2, d2, r, t = calibrated(bench.board.points_mm, sides, size, flags, lens=lens, ends=(300, 1e-10))
    inner = [np.r_[m[[0, 1, 0, 1], [0, 1, 2, 2]], np.ravel(d)[:5]] for m, d in ((m1, d1), (m2, d2))]
    return Stereo.of_vector(np.concatenate([*inner, rotation_vector(r), np.ravel(t)]), size), float(rms)


def judged(difference: np.ndarray, covariance: np.ndarray) -> dict[str, float]:
    """Chi-square per parameter of each group, and of all 24."""
    groups = {**GROUPS, "all 24": list(range(24))}
    return {name: chi2(difference[g], covariance[np.ix_(g, g)]) / len(g) for name, g in groups.items()}


def whiten(task: tuple[str, int]) -> dict[str, object]:
    """One bench calibrated one way: chi-square of its error under each of the covariances of `MADE`."""
    way, seed = task
    bench = drawn_bench(seed)
    stereo, rms = by_opencv(bench, way)
    difference = stereo.vector - bench.true.vector
    known = Provenance(rms, len(bench.left), (bench.board.columns, bench.board.rows), bench.board.pitch_mm)
    whole = replace(known, fixed_intrinsics=way == "fixed")
    none = Provenance()
    covariances = (with_assumed_covariance(stereo, one, none).parameter_covariance for one in (whole, known, none))
    judgements = {name: judged(difference, one) for name, one in zip(MADE, covariances, strict=True)}
    return {"way": way, "seed": seed, "rms_px": rms, **judgements}


def sets(opencv: Path) -> dict[str, tuple[Board, Views, StereoCalibration]]:
    """The public sets with this project's adjustment of each."""
    pairs = {}
    for name, folder, board in (("bumblebee2", BUMBLEBEE, Board(4, 6, 30.0)), ("opencv", opencv, Board(9, 6, 25.0))):
        views = find_views(folder, board)
        pairs[name] = board, views, calibrate_stereo(views.views, board, (views.image_width, views.image_height))
    return pairs


def poses(arguments: argparse.Namespace) -> None:
    print("set,view,centre_x_share,centre_y_share,size_share,rotation_x_rad,rotation_y_rad,rotation_z_rad")
    for name, (board, views, done) in sets(arguments.opencv).items():
        stereo = done.stereo
        half, centre = rotation_matrix(rotation_vector(stereo.R) / 2), -stereo.R.T @ stereo.T / 2
        focal = np.mean([m[k, k] for m in (stereo.M1, stereo.M2) for k in (0, 1)])
        size = np.array([stereo.image_width, stereo.image_height])
        diagonal = np.hypot(board.columns - 1, board.rows - 1) * board.pitch_mm
        for view in views.views:
            pose = pose_of(view, board, stereo)
            x = half @ (pose[3:] - centre)
            turn = rotation_vector(half @ rotation_matrix(pose[:3]))
            row = [*(x[:2] / x[2] * focal / size), focal * diagonal / x[2] / np.hypot(*size), *turn]
            print(f"{name},{view.name},{','.join(f'{value:.3f}' for value in row)}")


def made_up(stereo: Stereo, board: Board, views: int, rms_px: float) -> dict[str, np.ndarray]:
    """The covariances of `MADE` for a calibration from so many views."""
    usual = Board(*USUAL_BOARD, USUAL_PITCH_MM)
    return {
        "all stated": calibration_covariance(stereo, board, views, rms_px, False),
        "way unknown": calibration_covariance(stereo, board, views, rms_px),
        "nothing stated": calibration_covariance(stereo, usual, min(views, USUAL_VIEWS), USUAL_RMS_PX),
    }


def real(arguments: argparse.Namespace) -> None:
    """Of each public set: sds of its own adjustment and of what is made up, and halves against each other."""
    rows = {}
    for name, (board, views, done) in sets(arguments.opencv).items():
        count, rms, size = len(views.views), done.stereo.rms_px, (views.image_width, views.image_height)
        rng, halves = np.random.default_rng(0), []
        for _ in range(SPLITS):
            order = rng.permutation(count)
            halved = order[: count // 2], order[count // 2 :]
            one, two = (calibrate_stereo([views.views[k] for k in half], board, size) for half in halved)
            difference = one.stereo.vector - two.stereo.vector
            sums = {
                "independent corners": one.covariance_independent + two.covariance_independent,
                "own": one.stereo.parameter_covariance + two.stereo.parameter_covariance,
            }
            first, second = (made_up(done.stereo, board, len(half), rms) for half in halved)
            sums |= {kind: first[kind] + second[kind] for kind in MADE}
            halves.append({kind: judged(difference, covariance) for kind, covariance in sums.items()})
        whole = {"independent corners": done.covariance_independent, "own": done.stereo.parameter_covariance}
        whole |= made_up(done.stereo, board, count, rms)
        sds = {kind: np.sqrt(np.diag(covariance)).tolist() for kind, covariance in whole.items()}
        rows[name] = {"views": count, "rms_px": rms, "sd": sds, "halves": halves}
    REAL.parent.mkdir(parents=True, exist_ok=True)
    REAL.write_text(json.dumps(rows))


def table(rows: list[dict]) -> None:
    """Markdown on stdout."""
    kept = [row for row in rows if row["rms_px"] <= RMS_MAX_PX]
    groups = [*GROUPS, "all 24"]

    def cells(judgements: list[dict[str, float]]) -> str:
        return " | ".join(f"{np.sqrt(np.mean([one[group] for one in judgements])):.2f}" for group in groups)

    head = f"| {' | '.join(groups)} |\n|{'---|' * (len(groups) + 2)}"
    print("# The covariance of a stereo calibration that came without one\n")
    print("Written by `python -m experiments.cameras.assumed_covariance table`.\n")
    print("RMS of the error against truth, whitened by what is made up: 1 where the covariance is true, less where it")
    print("is too wide. OpenCV calibrates simulated benches from corners with independent errors.\n")
    print(f"| calibrated | covariance from {head}")
    for way in (*WAYS, "joint or fixed"):
        some = [row for row in kept if row["way"] in way.split(" or ")]
        for which in MADE:
            if way in WAYS or which != "all stated":
                print(f"| {way}, {len(some)} | {which} | {cells([row[which] for row in some])} |")
    print(f"\nLeft out, for an RMS above {RMS_MAX_PX:g} px (a local minimum):", end=" ")
    print(f"{len(rows) - len(kept)} of {len(rows)}.\n")
    real = json.loads(REAL.read_text())
    print("Halves of the public sets: RMS of the difference of both calibrations, whitened. `own`: this project's")
    print("adjustment, with shared errors of corners and of the board.\n")
    print(f"| set | covariance {head}")
    for name, row in real.items():
        for kind in row["halves"][0]:
            print(f"| {name} | {kind} | {cells([half[kind] for half in row['halves']])} |")
    print("\nSds of the whole sets over those of their own adjustment (geometric mean over the group).\n")
    print(f"| set | covariance | {' | '.join(GROUPS)} |\n|{'---|' * (len(GROUPS) + 2)}")
    for name, row in real.items():
        first = np.array(row["sd"]["own"])
        for kind in ("independent corners", *MADE):
            ratio = np.log(np.array(row["sd"][kind]) / first)
            print(f"| {name} | {kind} | {' | '.join(f'{np.exp(ratio[g].mean()):.2f}' for g in GROUPS.values())} |")
    guess = f"the sds of a guess are taken as good to a factor of {GUESS_FACTOR:g}"
    print(f"\n`CORRELATION_FACTOR` is {CORRELATION_FACTOR:g}; {guess}.")
    print("Where nothing is stated, RMS and views are those of a careless calibration.")


if __name__ == "__main__":
    options = {"--opencv": {"type": Path, "default": OPENCV_PAIRS, "help": "opencv-doc's pictures (%(default)s)"}}
    study(__file__, __doc__, whiten, ("way", "seed"), WAYS, table, 160, options, poses=poses, real=real)
