"""Is the 24 x 24 covariance of `tvsbayes stereo` true? Calibrations of drawn rigs whose truth is known.

    python -m experiments.cameras.stereo_coverage run --n 50 --cores 0 1     # half a second each, resumable
    python -m experiments.cameras.stereo_coverage halves                     # OpenCV's own pairs, Debian's opencv-doc
    python -m experiments.cameras.stereo_coverage table > experiments/cameras/stereo_coverage.md

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
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy import stats

from experiments.common import board_views
from experiments.common.board_views import BOARD, CONDITIONS, PITCH_U, Scene, chi2, true_corners
from experiments.common.command_line import study
from experiments.common.page import heading, line
from experiments.common.rows import output
from tvsbayes.cameras.boards import View, find_views
from tvsbayes.cameras.stereo_calibration import calibrate_stereo
from tvsbayes.errors import TvsError
from tvsbayes.instrument.parameters import STEREO_PARAMETER_NAMES
from tvsbayes.statistics.chances import BOUND

ROWS, HALVES = output(__file__, "stereo_coverage.jsonl"), output(__file__, "stereo_halves.json")
OPENCV_PAIRS = Path("/usr/share/doc/opencv-doc/examples/data")
SPLITS = 20
END = "correlation factor, median | s each, median"


def corner_errors(views: Sequence[View], drawn: Sequence[Scene]) -> dict[str, float]:
    """Found minus true corners, px: sd of one coordinate and their mean; a finder may start at either end."""
    errors = []
    for view in views:
        true = true_corners(drawn[int(view.name)])
        for corners, at in ((view.left, true[:, :2]), (view.right, true[:, 2:])):
            if corners is not None:
                errors.append(min((corners - at, corners[::-1] - at), key=lambda e: float((e**2).sum())))
    every = np.concatenate(errors)
    return {
        "corner_sd_px": float(every.std()),
        "corner_mean_u_px": float(every[:, 0].mean()),
        "corner_mean_v_px": float(every[:, 1].mean()),
        "corner_max_px": float(np.abs(every).max()),
    }


def calibrate(task: tuple[str, int], count: int = board_views.VIEWS) -> dict[str, object]:
    """One rig: chi-square of the true 24 parameters under the stored covariance, z of each, and the rest."""
    condition, seed = task
    drawn = board_views.scenes(seed, condition, count)
    rng = np.random.default_rng([seed, 99])
    if condition == "rendered":
        views = board_views.rendered_views(drawn, seed)
    else:
        views = [board_views.corners_of(scene, f"{k:02d}", rng) for k, scene in enumerate(drawn)]
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


def halves(arguments: argparse.Namespace) -> None:
    """Calibrate random halves of OpenCV's pairs and compare them."""
    views = find_views(OPENCV_PAIRS, BOARD)
    size = (views.image_width, views.image_height)
    rng = np.random.default_rng(0)
    rows = []
    for _ in range(SPLITS):
        order = rng.permutation(len(views.views))
        parts = [[views.views[k] for k in order[a]] for a in (slice(0, 6), slice(6, None))]
        one, two = (calibrate_stereo(part, BOARD, size) for part in parts)
        difference = one.stereo.vector - two.stereo.vector
        stored = chi2(difference, one.stereo.parameter_covariance + two.stereo.parameter_covariance)
        plain = chi2(difference, one.covariance_independent + two.covariance_independent)
        rows.append({"stored": stored, "independent": plain})
    whole = calibrate_stereo(views.views, BOARD, size)
    HALVES.parent.mkdir(parents=True, exist_ok=True)
    HALVES.write_text(json.dumps({"splits": rows, "factor": whole.correlation_factor, "rms_px": whole.stereo.rms_px}))


TEXT = f"""# Is the covariance of a stereo calibration true?

Written by `python -m experiments.cameras.stereo_coverage table`. chi2/24 of the true parameters should be 1;
its bounds are those of a true covariance at 1e-4. `plain`: the same, had corners been taken as independent.

{heading("corner errors | rigs | failed | mean chi2/24 | bounds | plain chi2/24 | worst z rms", "inside 95 %", END)}"""


def table(rows: list[dict]) -> None:
    """Markdown on stdout."""
    print(TEXT)
    for condition in CONDITIONS:
        every = [row for row in rows if row["condition"] == condition]
        some = [row for row in every if "failed" not in row]
        if not some:
            continue
        n, z = len(some), np.array([row["z"] for row in some])
        low, high = stats.chi2(24 * n).ppf([BOUND / 2, 1 - BOUND / 2]) / (24 * n)
        spread = np.sqrt((z**2).mean(0))
        worst = int(np.argmax(np.abs(np.log(spread))))
        names = ("chi2", "chi2_independent", "correlation_factor", "seconds")
        stored, plain, factor, seconds = (np.array([row[name] for row in some]) for name in names)
        cells = [condition, str(n), str(len(every) - n), f"{stored.mean() / 24:.2f}", f"{low:.2f} to {high:.2f}"]
        cells += [f"{plain.mean() / 24:.2f}", f"{spread[worst]:.2f} ({STEREO_PARAMETER_NAMES[worst]})"]
        cells += [f"{100 * (np.abs(z) < 1.96).mean():.1f} %", f"{np.median(factor):.2f}", f"{np.median(seconds):.1f}"]
        print(line(*cells))
    some = [row for row in rows if row["condition"] == "rendered" and "failed" not in row]
    if some:
        keys = ("corner_sd_px", "corner_mean_u_px", "corner_mean_v_px", "corner_max_px")
        sd, u, v, largest = (np.array([row[key] for row in some]) for key in keys)
        print(f"\n`rendered`: found less true corners have sd {np.median(sd):.3f} px (median of the rigs),", end=" ")
        print(f"mean error u\n{u.mean():+.4f}, v {v.mean():+.4f} px, largest {largest.max():.2f} px;", end=" ")
        print("outlying views, all kept:", end=" ")
        print(f"{sum(row['outliers'] for row in some)} of {sum(row['views'] for row in some)}.")
    if HALVES.exists():
        pairs = json.loads(HALVES.read_text())
        stored, plain = (np.array([s[k] for s in pairs["splits"]]) / 24 for k in ("stored", "independent"))
        words = f"OpenCV's 13 real pairs (640 x 480): rms {pairs['rms_px']:.3f} px, factor {pairs['factor']:.1f}. "
        words += f"Split at random {len(stored)} times into 6 and 7 views, the two calibrations differ by\nchi2/24 = "
        words += f"{stored.mean():.2f} on average (median {np.median(stored):.2f}) under the stored covariances, by "
        words += f"{plain.mean():.2f} (median {np.median(plain):.2f}) had corners been taken\nas independent."
        print(f"\n{words}")


if __name__ == "__main__":
    study(__file__, __doc__, calibrate, ("condition", "seed"), CONDITIONS, table, 50, halves=halves)
