"""Stereo calibration: ours against OpenCV's, from the same corners of rendered checkerboards whose truth is known."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from .measure import Bench, Case, Column, timed

TITLE = "Stereo calibration"
NAME = "12 views of a 9 x 6 board, rendered; every repeat is another rig"
OURS, SEPARATE, TOGETHER = "tvsbayes", "cv2, cameras one by one, then the pair", "cv2, then all parameters together"


def measure(bench: Bench) -> None:
    """Repeat k calibrates drawn rig k by all three."""
    if not bench.missing(NAME, (OURS, SEPARATE, TOGETHER)):
        return
    import cv2
    import stereo_coverage as rendered

    from tvsbayes.cameras.stereo_calibration import calibrate_stereo
    from tvsbayes.estimators.campaign_arrays import use_compilation_cache
    from tvsbayes.instrument.stereo_pair import rotation_vector

    use_compilation_cache()
    kept: dict[int, tuple] = {}

    def rig(seed: int):
        if seed not in kept:
            kept.clear()
            drawn = rendered.scenes(seed, "rendered")
            views = [v for v in rendered.rendered_views(drawn, seed) if v.left is not None and v.right is not None]
            true = drawn[0].stereo
            size = (true.image_width, true.image_height)
            # The scale of every error: our stated standard uncertainty on this rig.
            sd = np.sqrt(np.diag(calibrate_stereo(views, rendered.BOARD, size).stereo.parameter_covariance))
            kept[seed] = views, true, size, sd
        return kept[seed]

    def judged(stereo, rms: float, seed: int, cost: dict[str, float]) -> dict[str, object]:
        views, true, _, sd = rig(seed)
        error = stereo.vector - true.vector
        return {
            **cost,
            "views": len(views),
            "rms_px": float(rms),
            "error_sds": float(np.sqrt(np.mean((error / sd) ** 2))),
            "focal_px": float(np.sqrt(np.mean(error[[0, 1, 9, 10]] ** 2))),
            "baseline_mm": float(abs(np.linalg.norm(stereo.T) - np.linalg.norm(true.T))),
            "rotation_mrad": float(1000 * np.linalg.norm(rotation_vector(stereo.R @ true.R.T))),
        }

    def ours(seed: int) -> dict[str, object]:
        views, _, size, _ = rig(seed)
        found, cost = timed(lambda: calibrate_stereo(views, rendered.BOARD, size))
        return judged(found.stereo, found.stereo.rms_px, seed, cost)

    def opencv(together: bool):
        def row(seed: int) -> dict[str, object]:
            views, true, size, _ = rig(seed)
            board = [rendered.BOARD.points_mm.astype(np.float32)] * len(views)
            left, right = ([np.ascontiguousarray(getattr(v, s), np.float32) for v in views] for s in ("left", "right"))

            def work():
                _, m1, d1, *_ = cv2.calibrateCamera(board, left, size, None, None)
                _, m2, d2, *_ = cv2.calibrateCamera(board, right, size, None, None)
                flags = cv2.CALIB_USE_INTRINSIC_GUESS if together else cv2.CALIB_FIX_INTRINSIC
                return cv2.stereoCalibrate(board, left, right, m1, d1, m2, d2, size, flags=flags, criteria=criteria)[:7]

            # As many steps as it wants: the default of 30 steps or 1e-6 stops in a hurry.
            criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 200, 1e-9)
            (rms, m1, d1, m2, d2, turn, shift), cost = timed(work)
            five = [np.asarray(d, float).ravel()[:5] for d in (d1, d2)]
            stereo = replace(true, M1=m1, D1=five[0], M2=m2, D2=five[1], R=turn, T=np.asarray(shift).ravel())
            return judged(stereo, rms, seed, cost)

        return row

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        rig(0)
        bench.interleaved(NAME, {OURS: ours, SEPARATE: opencv(False), TOGETHER: opencv(True)})


def cases(rows: Sequence[Mapping]) -> list[Case]:
    """Tables of the part."""
    about = (
        "From corners (found once, by `find_views`) to the calibration, compiled. Errors against the true rig: rms of "
        "all 24 parameters in units of our stated standard uncertainties (1 is perfect), rms of the four focal "
        "lengths, baseline, and angle between the cameras. Ours also states the 24 x 24 covariance, which OpenCV "
        "does not."
    )
    columns = (
        Column("cpu_s", "CPU s"),
        Column("rms_px", "rms, px", "{:.4f}"),
        Column("error_sds", "error, stated sds", "{:.2f}"),
        Column("focal_px", "focal error, px", "{:.2f}"),
        Column("baseline_mm", "baseline error, mm", "{:.3f}"),
        Column("rotation_mrad", "rotation error, mrad", "{:.3f}"),
    )
    return [Case(NAME, about, columns, "cpu_s")]


def remarks(rows: Sequence[Mapping]) -> list[str]:
    """None."""
    return []
