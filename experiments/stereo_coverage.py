"""Is the 24 x 24 covariance of `tvsbayes stereo` true? Calibrations of drawn rigs whose truth is known.

    python experiments/stereo_coverage.py run --n 50 --cores 0 1     # half a second each, resumable
    python experiments/stereo_coverage.py halves                     # OpenCV's own pairs, Debian's opencv-doc
    python experiments/stereo_coverage.py table > experiments/stereo_coverage.md

`run` draws rig i near the shipped one with seed i, shows it a 9 x 6 board of 25 mm at 20 random poses through the
twin's optics (which share no code with the adjustment), disturbs the corners and calibrates. Conditions: `white`,
independent normal errors of 0.15 px; `pitch`, the board's true pitch drawn about the stated one with 0.1 %; `shared`,
errors that corners of a picture share over 2.5 squares, as OpenCV's pairs show them; `rendered`, pictures of 12 boards
in a folder, from which `find_views` takes the corners (10 s each). `halves` splits 13 real pairs at random and compares
the two calibrations with the uncertainty that they state: no truth is needed.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from tvsbayes.cameras.boards import Board, View, find_views
from tvsbayes.errors import TvsError
from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.parameters import STEREO_PARAMETER_NAMES
from tvsbayes.instrument.stereo_pair import Stereo, read_stereo, rotation_matrix, rotation_vector
from tvsbayes.twin.physics import project

CONDITIONS = ("white", "pitch", "shared", "rendered")
BOARD = Board(9, 6, 25.0)
PITCH_U = 1e-3
VIEWS, RENDERED_VIEWS = 20, 12
CORNER_SD_PX = 0.15
SHARED_SQUARES = 2.5
TRUTH_SD = np.array([*2 * [8.0, 8.0, 8.0, 8.0, 0.02, 0.02, 5e-4, 5e-4, 0.01], 0.01, 0.01, 0.01, 1.0, 1.0, 1.0])
"""How far true rigs lie from the shipped one: each is another rig."""
ROWS = Path(__file__).parent / "output" / "stereo_coverage.jsonl"
HALVES = Path(__file__).parent / "output" / "stereo_halves.json"
OPENCV_PAIRS = Path("/usr/share/doc/opencv-doc/examples/data")
SPLITS = 20


@dataclass(frozen=True)
class Scene:
    """One view to be: the true cameras, the board as it is, where it stands, what disturbs the corners."""

    stereo: Stereo
    board: Board
    pose: np.ndarray
    condition: str


def true_corners(scene: Scene) -> np.ndarray:
    """Corners (corners, 4: u_left, v_left, u_right, v_right), px; NaN where not seen by both."""
    x, y, z = (scene.board.points_mm @ rotation_matrix(scene.pose[:3]).T + scene.pose[3:]).T
    return project(np.column_stack((z, -x, -y)), scene.stereo)


def corners_of(scene: Scene, name: str, rng: np.random.Generator) -> View:
    """What a corner finder would report of a scene."""
    corners = true_corners(scene)
    noise = rng.standard_normal(corners.shape)
    if scene.condition == "shared":
        grid = scene.board.points_mm[:, :2] / scene.board.pitch_mm
        distance2 = ((grid[:, None] - grid[None]) ** 2).sum(-1)
        correlation = np.exp(-0.5 * distance2 / SHARED_SQUARES**2)
        # Half of the variance is shared.
        root = np.linalg.cholesky(0.5 * correlation + 0.5 * np.eye(len(grid)))
        noise = root @ noise
    seen = corners + CORNER_SD_PX * noise
    return View(name, seen[:, :2], seen[:, 2:])


def scenes(seed: int, condition: str) -> list[Scene]:
    """The views of one drawn rig; every board is wholly seen by both cameras."""
    rng = np.random.default_rng([seed, CONDITIONS.index(condition)])
    nominal = read_stereo(shipped_data() / "rigs" / "mounted" / "stereo.json")
    stereo = nominal.with_vector(nominal.vector + TRUTH_SD * rng.standard_normal(24))
    if condition == "rendered":
        # Finders need the outer squares too: the renderer's own poses leave room for them.
        from tvsbayes.twin.board_pictures import Board, board_poses
        from tvsbayes.twin.physics import cameras_of

        first = BOARD.points_mm[0]
        poses = board_poses(cameras_of(stereo), Board(), RENDERED_VIEWS, seed)
        return [
            Scene(
                stereo,
                BOARD,
                np.concatenate((rotation_vector(p.rotation), p.translation_mm - p.rotation @ first)),
                condition,
            )
            for p in poses
        ]
    pitch_mm = BOARD.pitch_mm * (1 + PITCH_U * rng.standard_normal() * (condition == "pitch"))
    views: list[Scene] = []
    while len(views) < VIEWS:
        rotation = rng.uniform(-0.6, 0.6, 3) * np.array([1.0, 1.0, 0.5])
        depth = rng.uniform(240.0, 600.0)
        middle = depth * np.array([rng.uniform(-0.6, 0.6), rng.uniform(-0.35, 0.35), 1.0]) + [42.5, 0.0, 0.0]
        scene = Scene(stereo, replace(BOARD, pitch_mm=pitch_mm), np.concatenate((rotation, middle)), condition)
        if np.isfinite(true_corners(scene)).all():
            views.append(scene)
    return views


def rendered_views(drawn: Sequence[Scene], seed: int) -> list[View]:
    """Pictures of every scene in a folder, and the corners that `find_views` finds there."""
    import cv2

    from tvsbayes.twin.board_pictures import Board, BoardPose, render_board
    from tvsbayes.twin.physics import cameras_of
    from tvsbayes.twin.spot_pictures import Sensor

    cameras = cameras_of(drawn[0].stereo)
    with TemporaryDirectory() as folder:
        for k, scene in enumerate(drawn):
            rotation = rotation_matrix(scene.pose[:3])
            pose = BoardPose(rotation, scene.pose[3:] + rotation @ scene.board.points_mm[0])
            for side, camera in (("left", cameras.left), ("right", cameras.right)):
                picture = render_board(camera, pose, Board(), Sensor(), (seed, k, side == "right"))
                place = str(Path(folder) / f"{side}{k:02d}.png")
                # Level 1: the files live for seconds.
                assert cv2.imwrite(place, picture, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        return list(find_views(Path(folder), BOARD).views)


def corner_errors(views: Sequence[View], drawn: Sequence[Scene]) -> dict[str, float]:
    """Found minus true corners, px: sd of one coordinate and their mean; a finder may start at either end."""
    errors = []
    for view in views:
        true = true_corners(drawn[int(view.name)])
        for seen, at in ((view.left, true[:, :2]), (view.right, true[:, 2:])):
            if seen is not None:
                errors.append(min((seen - at, seen[::-1] - at), key=lambda e: float((e**2).sum())))
    every = np.concatenate(errors)
    return {
        "corner_sd_px": float(every.std()),
        "corner_mean_u_px": float(every[:, 0].mean()),
        "corner_mean_v_px": float(every[:, 1].mean()),
        "corner_max_px": float(np.abs(every).max()),
    }


def chi2(difference: np.ndarray, covariance: np.ndarray) -> float:
    """d^T C^-1 d, scaled first: px, rad and mm differ by ten powers of ten."""
    sds = np.sqrt(np.diag(covariance))
    return float(difference / sds @ np.linalg.solve(covariance / np.outer(sds, sds), difference / sds))


def calibrate(task: tuple[str, int]) -> dict[str, object]:
    """One rig: chi-square of the true 24 parameters under the stored covariance, z of each, and the rest."""
    from tvsbayes.cameras.stereo_calibration import calibrate_stereo

    condition, seed = task
    drawn = scenes(seed, condition)
    rng = np.random.default_rng([seed, 99])
    if condition == "rendered":
        views = rendered_views(drawn, seed)
    else:
        views = [corners_of(scene, f"{k:02d}", rng) for k, scene in enumerate(drawn)]
    true = drawn[0].stereo
    board = replace(BOARD, pitch_u_mm=PITCH_U * BOARD.pitch_mm * (condition == "pitch"))
    try:
        result = calibrate_stereo(views, board, (true.image_width, true.image_height))
    except TvsError as error:
        return {"condition": condition, "seed": seed, "failed": error.message}
    difference = result.stereo.vector - true.vector
    return {
        "condition": condition,
        "seed": seed,
        "chi2": chi2(difference, result.stereo.parameter_covariance),
        "chi2_independent": chi2(difference, result.covariance_independent + result.covariance_pitch),
        "z": (difference / np.sqrt(np.diag(result.stereo.parameter_covariance))).tolist(),
        "noise_sd_px": result.noise_sd_px,
        "correlation_factor": result.correlation_factor,
        "outliers": len(result.outliers),
        "views": len(result.views),
        **(corner_errors(views, drawn) if condition == "rendered" else {}),
        "seconds": result.seconds["adjustment"],
    }


def halves() -> None:
    """Calibrate random halves of OpenCV's pairs and compare them."""
    from tvsbayes.cameras.stereo_calibration import calibrate_stereo

    found = find_views(OPENCV_PAIRS, BOARD)
    size = (found.image_width, found.image_height)
    rng = np.random.default_rng(0)
    rows = []
    for _ in range(SPLITS):
        order = rng.permutation(len(found.views))
        parts = [[found.views[k] for k in order[a]] for a in (slice(0, 6), slice(6, None))]
        one, two = (calibrate_stereo(part, BOARD, size) for part in parts)
        difference = one.stereo.vector - two.stereo.vector
        rows.append(
            {
                "stored": chi2(difference, one.stereo.parameter_covariance + two.stereo.parameter_covariance),
                "independent": chi2(difference, one.covariance_independent + two.covariance_independent),
            }
        )
    whole = calibrate_stereo(found.views, BOARD, size)
    HALVES.parent.mkdir(exist_ok=True)
    HALVES.write_text(json.dumps({"splits": rows, "factor": whole.correlation_factor, "rms_px": whole.stereo.rms_px}))


def table() -> None:
    """Markdown on stdout."""
    from coverage import read_rows
    from scipy import stats

    rows = read_rows(ROWS)
    print("# Is the covariance of a stereo calibration true?\n")
    print("Made by `experiments/stereo_coverage.py`; see there. chi2/24 of the true parameters should be 1; its bounds")
    print("are those of a true covariance at 1e-4. `plain`: the same, had corners been taken as independent.\n")
    titles = ("corner errors", "rigs", "failed", "mean chi2/24", "bounds", "plain chi2/24", "worst z rms")
    titles += ("inside 95 %", "correlation factor, median", "s each, median")
    print(f"| {' | '.join(titles)} |\n|{'---|' * len(titles)}")
    for condition in CONDITIONS:
        every = [row for row in rows if row["condition"] == condition]
        some = [row for row in every if "failed" not in row]
        if not some:
            continue
        n, z = len(some), np.array([row["z"] for row in some])
        low, high = stats.chi2(24 * n).ppf([5e-5, 1 - 5e-5]) / (24 * n)
        spread = np.sqrt((z**2).mean(0))
        worst = int(np.argmax(np.abs(np.log(spread))))
        names = ("chi2", "chi2_independent", "correlation_factor", "seconds")
        stored, plain, factor, seconds = (np.array([row[name] for row in some]) for name in names)
        cells = [condition, str(n), str(len(every) - n), f"{stored.mean() / 24:.2f}", f"{low:.2f} to {high:.2f}"]
        cells += [f"{plain.mean() / 24:.2f}", f"{spread[worst]:.2f} ({STEREO_PARAMETER_NAMES[worst]})"]
        cells += [f"{100 * (np.abs(z) < 1.96).mean():.1f} %", f"{np.median(factor):.2f}", f"{np.median(seconds):.1f}"]
        print(f"| {' | '.join(cells)} |")
    some = [row for row in rows if row["condition"] == "rendered" and "failed" not in row]
    if some:
        keys = ("corner_sd_px", "corner_mean_u_px", "corner_mean_v_px", "corner_max_px")
        sd, u, v, largest = (np.array([row[key] for row in some]) for key in keys)
        print(
            f"\n`rendered`: found less true corners have sd {np.median(sd):.3f} px (median of the rigs), mean error u"
        )
        print(
            f"{u.mean():+.4f}, v {v.mean():+.4f} px, largest {largest.max():.2f} px; outlying views, all kept: ", end=""
        )
        print(f"{sum(row['outliers'] for row in some)} of {sum(row['views'] for row in some)}.")
    if HALVES.exists():
        found = json.loads(HALVES.read_text())
        stored, plain = (np.array([s[k] for s in found["splits"]]) / 24 for k in ("stored", "independent"))
        words = (
            f"OpenCV's 13 real pairs (640 x 480): rms {found['rms_px']:.3f} px, factor {found['factor']:.1f}. Split at "
        )
        words += f"random {len(stored)} times into 6 and 7 views, the two calibrations differ by\nchi2/24 = "
        words += f"{stored.mean():.2f} on average (median {np.median(stored):.2f}) under the stored covariances, by "
        words += f"{plain.mean():.2f} (median {np.median(plain):.2f}) had corners been taken\nas independent."
        print(f"\n{words}")


def main() -> None:
    """Command line of the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("run", "halves", "table"))
    parser.add_argument("--n", type=int, default=50)
    parser.add_argument("--conditions", nargs="+", choices=CONDITIONS, default=CONDITIONS)
    parser.add_argument("--cores", type=int, nargs="+", default=[0])
    options = parser.parse_args()
    if options.what == "run":
        from studies import run_rows

        tasks = [(condition, seed) for seed in range(options.n) for condition in options.conditions]
        run_rows(calibrate, tasks, ROWS, ("condition", "seed"), options.cores)
    elif options.what == "halves":
        halves()
    else:
        table()


if __name__ == "__main__":
    main()
