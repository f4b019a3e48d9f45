"""Is the covariance that `stereo --import` makes for a calibration without one the covariance of such calibrations?

    python -m experiments.cameras.assumed_covariance poses --opencv DATA > data/reference/board_poses.csv
    python -m experiments.cameras.assumed_covariance real --opencv DATA     # public sets: halves, own adjustment
    python -m experiments.cameras.assumed_covariance run --n 200            # simulated benches, half a second each
    python -m experiments.cameras.assumed_covariance table > experiments/cameras/assumed_covariance.md

DATA holds left*.jpg and right*.jpg of Debian's opencv-doc (examples/data). `run` draws benches whose truth is known:
f 700 to 1600 px, 80 to 300 mm apart, toed in or not, 15 to 25 views of one of four boards at random poses (not those of
the table), independent corner noise of 0.05 to 0.3 px. OpenCV calibrates them: `joint`, all free from each camera's own
calibration; `fixed`, intrinsics of each camera by itself, CALIB_FIX_INTRINSIC; `no k3`, joint with CALIB_FIX_K3. The
error is whitened by the covariance made from OpenCV's RMS, the number of views and the board (`stated`), and from
nothing (`usual`).
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from experiments.cameras.stereo_coverage import chi2
from experiments.common.command_line import act, study_parser
from experiments.common.rows import output, read_rows, run_rows
from tvsbayes.cameras.assumed_covariance import (
    CORRELATED,
    GROUPS,
    GUESS_FACTOR,
    Known,
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
SPLITS = 40


@dataclass(frozen=True)
class Bench:
    """A drawn pair with corners of boards: (views, corners, 2) of each camera."""

    true: Stereo
    board: Board
    left: np.ndarray
    right: np.ndarray
    noise_px: float


def pair(size: tuple[int, int], vector: np.ndarray) -> Stereo:
    """A pair of these 24 parameters, without a covariance."""
    return Stereo(*size, *(np.zeros(1),) * 6, np.zeros((24, 24)), 0.0).with_vector(vector)


def drawn_bench(seed: int) -> Bench:
    """A bench of other geometry than the table of poses: boards by distance and tilt, anywhere in both pictures."""
    rng = np.random.default_rng([seed, 45])
    size = SIZES[int(rng.integers(len(SIZES)))]
    focal, baseline = rng.uniform(700, 1600), rng.uniform(80, 300)
    cameras = []
    for _ in range(2):
        own = focal * (1 + 0.01 * rng.standard_normal())
        middle = np.array(size) / 2 - 0.5 + 0.015 * size[0] * rng.standard_normal(2)
        k1 = rng.uniform(-0.35, 0.1)
        cameras.append([own, own * (1 + 1e-3 * rng.standard_normal()), *middle, k1, 0.4 * k1**2, *rng.normal(0, 5e-4, 2), 0.0])
    toe = rng.uniform(0, 0.6) * baseline / 700
    turn = rotation_vector(rotation_matrix(rng.normal(0, 0.01, 3)) @ rotation_matrix(np.array([0, toe, 0])))
    true = pair(size, np.array([*cameras[0], *cameras[1], *turn, *(-baseline * np.array([1, 0, 0]) + rng.normal(0, 2, 3))]))
    # The right camera toes in about the left one's baseline: it stands to the right whatever its turn.
    true = true.with_vector(np.r_[true.vector[:21], true.R @ [-baseline, *rng.normal(0, 2, 2)]])
    board, count = BOARDS[int(rng.integers(len(BOARDS)))], int(rng.integers(15, 26))
    noise, width = rng.uniform(0.05, 0.3), (board.columns - 1) * board.pitch_mm
    seen: list[list[np.ndarray]] = [[], []]
    while len(seen[0]) < count:
        depth = focal * width / (size[0] * rng.uniform(0.2, 0.6))
        axis = rng.standard_normal(2)
        tilt = rng.uniform(0, 0.7) * axis / np.linalg.norm(axis)
        turn = rotation_vector(rotation_matrix(np.array([*tilt, 0.0])) @ rotation_matrix(np.array([0, 0, rng.normal(0, 0.4)])))
        shift = depth * np.array([*(rng.uniform(-0.5, 0.5, 2) * size / focal), 1.0]) + [baseline / 2, 0, 0]
        left = board.points_mm @ rotation_matrix(turn).T + shift
        pixels = [
            cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, distortion)[0].reshape(-1, 2)
            for points, matrix, distortion in ((left, true.M1, true.D1), (left @ true.R.T + true.T, true.M2, true.D2))
        ]
        if all(((p > 0) & (p < np.array(size) - 1)).all() for p in pixels):
            for own, found in zip(seen, pixels, strict=True):
                own.append(found + noise * rng.standard_normal(found.shape))
    return Bench(true, board, np.array(seen[0]), np.array(seen[1]), noise)


def by_opencv(bench: Bench, way: str) -> tuple[Stereo, float]:
    """OpenCV's calibration of a bench, and its RMS."""
    size = bench.true.image_width, bench.true.image_height
    points = [bench.board.points_mm.astype(np.float32)] * len(bench.left)
    sides = [[np.asarray(view, np.float32) for view in side] for side in (bench.left, bench.right)]
    own = WAYS[way] & cv2.CALIB_FIX_K3
    alone = [cv2.calibrateCamera(points, side, size, None, None, flags=own)[1:3] for side in sides]
    flags = WAYS[way] | (0 if way == "fixed" else cv2.CALIB_USE_INTRINSIC_GUESS)
    ends = cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 300, 1e-10
    rms, m1, d1, m2, d2, r, t, *_ = cv2.stereoCalibrate(
        points, *sides, *alone[0], *alone[1], size, flags=flags, criteria=ends
    )
    inner = [np.r_[m[[0, 1, 0, 1], [0, 1, 2, 2]], np.ravel(d)[:5]] for m, d in ((m1, d1), (m2, d2))]
    return pair(size, np.concatenate([*inner, rotation_vector(r), np.ravel(t)])), float(rms)


def judged(difference: np.ndarray, covariance: np.ndarray) -> dict[str, float]:
    """Chi-square per parameter of each group, of all but the distortion, and of all 24."""
    groups = {**GROUPS, "all but distortion": sum((g for n, g in GROUPS.items() if n != "distortion"), []), "all": list(range(24))}
    return {name: chi2(difference[g], covariance[np.ix_(g, g)]) / len(g) for name, g in groups.items()}


def whiten(task: tuple[str, int]) -> dict[str, object]:
    """One bench calibrated one way: chi-square of its error under what is made from what is stated, and from nothing."""
    way, seed = task
    bench = drawn_bench(seed)
    found, rms = by_opencv(bench, way)
    difference = found.vector - bench.true.vector
    known = Known(rms, len(bench.left), (bench.board.columns, bench.board.rows), bench.board.pitch_mm)
    made = {"stated": known, "with way": replace(known, fixed_intrinsics=way == "fixed"), "usual": Known()}
    return {
        "way": way,
        "seed": seed,
        "rms_px": rms,
        **{k: judged(difference, with_assumed_covariance(found, v, Known()).parameter_covariance) for k, v in made.items()},
    }


def sets(opencv: Path) -> dict[str, tuple[Board, Views, StereoCalibration]]:
    """The public sets with this project's adjustment of each."""
    found = {}
    for name, folder, board in (("bumblebee2", BUMBLEBEE, Board(4, 6, 30.0)), ("opencv", opencv, Board(9, 6, 25.0))):
        views = find_views(folder, board)
        found[name] = board, views, calibrate_stereo(views.views, board, (views.image_width, views.image_height))
    return found


def poses(arguments: argparse.Namespace) -> None:
    """The table of measured poses on stdout, as a camera halfway between both sees the boards."""
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


def real(arguments: argparse.Namespace) -> None:
    """Of each public set: sds of its own adjustment over those made up, and halves against each other."""
    rows = {}
    for name, (board, views, done) in sets(arguments.opencv).items():
        known = Known(done.stereo.rms_px, len(views.views), (board.columns, board.rows), board.pitch_mm, 0.0, False)
        size = views.image_width, views.image_height
        rng, halves = np.random.default_rng(0), []
        for _ in range(SPLITS):
            order = rng.permutation(len(views.views))
            parts = [[views.views[k] for k in order[at]] for at in (slice(0, len(order) // 2), slice(len(order) // 2, None))]
            one, two = (calibrate_stereo(part, board, size) for part in parts)
            made = sum(calibration_covariance(done.stereo, board, len(part), done.stereo.rms_px, False) for part in parts)
            difference = one.stereo.vector - two.stereo.vector
            halves.append({"made": judged(difference, made), "independent": judged(difference, one.covariance_independent + two.covariance_independent), "own": judged(difference, one.stereo.parameter_covariance + two.stereo.parameter_covariance)})
        sds = {"own": done.stereo.parameter_covariance, "independent": done.covariance_independent}
        sds["stated"] = with_assumed_covariance(done.stereo, known, Known()).parameter_covariance
        sds["usual"] = with_assumed_covariance(done.stereo, Known(), Known()).parameter_covariance
        rows[name] = {
            "views": len(views.views), "rms_px": done.stereo.rms_px, "noise_px": done.noise_sd_px, "factor": done.correlation_factor, "board_error_mm": done.board_error_mm,
            "sd": {k: np.sqrt(np.diag(v)).tolist() for k, v in sds.items()},
            "halves": halves,
        }
    REAL.parent.mkdir(parents=True, exist_ok=True)
    REAL.write_text(json.dumps(rows))


def run(arguments: argparse.Namespace) -> None:
    """Append rows until every bench is calibrated in every way."""
    run_rows(whiten, [(way, seed) for seed in range(arguments.n) for way in WAYS], arguments.rows, ("way", "seed"), arguments.cores)


def table(arguments: argparse.Namespace) -> None:
    """Markdown on stdout."""
    rows = read_rows(arguments.rows)
    for way in WAYS:
        for made in ("with way", "stated", "usual"):
            some = [row[made] for row in rows if row["way"] == way]
            print(way, made, len(some), {k: round(float(np.sqrt(np.mean([s[k] for s in some]))), 2) for k in some[0]}, flush=True)
    for name, row in json.loads(REAL.read_text()).items():
        print(name, row["views"], row["rms_px"], row["factor"])
        for kind in row["halves"][0]:
            print("  ", kind, {k: round(float(np.sqrt(np.mean([h[kind][k] for h in row["halves"]]))), 2) for k in row["halves"][0][kind]})
        for group, places in GROUPS.items():
            print("  ", group, {k: np.array(v)[places].round(5).tolist() for k, v in row["sd"].items()})


def main() -> None:
    """Command line of the study."""
    command = study_parser(__doc__, ROWS, n=200, actions=("poses", "real", "run", "table"))
    command.add_argument("--opencv", type=Path, default=Path("/usr/share/doc/opencv-doc/examples/data"), help="opencv-doc's pictures")
    act(command, poses=poses, real=real, run=run, table=table)


if __name__ == "__main__":
    main()
