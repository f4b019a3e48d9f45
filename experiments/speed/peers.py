"""Contenders of the benchmarks that compare code: ours and its peers, ready to take turns on one thread.

A function prepares the works of one part in a temporary folder; a work gets the number of its repeat and returns a row.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np

from experiments.common.against_truth import rms
from experiments.common.clock import timed
from experiments.common.rigs import mounted_rig, pixels_of, small_plan

Work = Callable[[int], Mapping[str, object]]
OURS = "tvsbayes"


BRIGHT = 0.2
PHOTUTILS = {"photutils centroid_com": "com", "photutils, above 20 % of the peak": "bright", "photutils 2dg": "2dg"}
DETECT = {"tvsbayes detect": "fit", "tvsbayes detect, contour": "contour"}
READ = "cv2.imread alone"


def photutils_centre(path: str, kind: str) -> np.ndarray:
    """Centre of the spot of a picture, px, NaN where our window finds none."""
    import cv2
    from photutils import centroids

    from tvsbayes.cameras.spot_window import patch_around

    patch = patch_around(cv2.imread(path))
    if isinstance(patch, str):
        return np.full(2, np.nan)
    grey = patch.grey.astype(float)
    light = grey - np.median(np.concatenate((grey[0], grey[-1], grey[:, 0], grey[:, -1])))
    if kind == "2dg":
        return np.asarray(centroids.centroid_2dg(light, mask=~patch.usable)) + patch.corner
    # What is clipped is brightest: a centre of mass without it would be one of the rim.
    light = np.where(light > BRIGHT * light.max(), light, 0.0) if kind == "bright" else light
    return np.asarray(centroids.centroid_com(light)) + patch.corner


def spots(folder: Path) -> Mapping[str, Work]:
    """48 looks of a drawn rig, rendered; left before right."""
    import cv2

    from tvsbayes.cameras.detection import detect
    from tvsbayes.instrument.campaign import read_campaign
    from tvsbayes.twin.frames import write_frames
    from tvsbayes.twin.physics import project
    from tvsbayes.twin.simulated_campaign import simulate

    twin = simulate(mounted_rig(), small_plan(("d1", "d3")), 4)
    twin.undetected().write(folder / "campaign")
    write_frames(folder / "campaign", twin.undetected(), 4)
    true_px = project(twin.light.points_mm, twin.truth.stereo, twin.truth.parameters["focal_scale"]).reshape(-1, 2)
    campaign, paths = read_campaign(folder / "campaign"), sorted((folder / "campaign" / "frames").glob("*.png"))

    def found(work: Callable[[], object], _: int) -> Mapping[str, object]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            centres, cost = timed(work)
        row = {**cost, "ms": 1000 * cost["cpu_s"] / len(paths), "ok": len(paths)}
        if centres is None:
            return row
        off = np.array(centres).reshape(-1, 2) - true_px
        off = off[np.isfinite(off).all(axis=1)]
        ends = {"median_px": float(np.median(np.abs(off))), "max_px": float(np.abs(off).max())}
        return {**row, "ok": len(off), "rms_px": rms(off), **ends}

    jobs: dict[str, Callable[[], object]] = {
        name: lambda method=method: pixels_of(detect(campaign, method, workers=1).campaign)
        for name, method in DETECT.items()
    }
    jobs[READ] = lambda: [cv2.imread(str(path)) for path in paths] and None
    for name, kind in PHOTUTILS.items():
        jobs[name] = lambda kind=kind: [photutils_centre(str(path), kind) for path in paths]
    works = {name: partial(found, job) for name, job in jobs.items()}
    for work in works.values():
        work(0)
    return works


SEPARATE, TOGETHER = "cv2, cameras one by one, then the pair", "cv2, then all parameters together"


def stereo(_: Path) -> Mapping[str, Work]:
    """Repeat k calibrates drawn rig k, from the same corners of rendered boards."""
    import cv2

    from experiments.common.board_views import BOARD, rendered_views, scenes
    from experiments.common.opencv_stereo import calibrated
    from tvsbayes.cameras.stereo_calibration import calibrate_stereo
    from tvsbayes.instrument.stereo_pair import rotation_vector
    from tvsbayes.model.compilation_cache import use_compilation_cache

    use_compilation_cache()

    @cache
    def rig(seed: int):
        """A true pair, the views that both cameras have, and our stated uncertainties, the scale of errors."""
        drawn = scenes(seed, "rendered")
        views = [v for v in rendered_views(drawn, seed) if v.left is not None and v.right is not None]
        true = drawn[0].stereo
        size = true.image_width, true.image_height
        stated = calibrate_stereo(views, BOARD, size).stereo.parameter_covariance
        return true, views, size, np.sqrt(np.diag(stated))

    def by_opencv(flags: int, views, size, true):
        sides = [[getattr(view, side) for view in views] for side in ("left", "right")]
        # As many steps as it needs: the default of 30 steps or 1e-6 stops in a hurry.
        rms_px, m1, d1, m2, d2, turn, shift = calibrated(BOARD.points_mm, sides, size, flags, ends=(200, 1e-9))
        five = [np.asarray(d, float).ravel()[:5] for d in (d1, d2)]
        return replace(true, M1=m1, D1=five[0], M2=m2, D2=five[1], R=turn, T=np.ravel(shift), rms_px=float(rms_px))

    def work(flags: int | None, seed: int) -> Mapping[str, object]:
        true, views, size, sd = rig(seed)
        if flags is None:
            found, cost = timed(lambda: calibrate_stereo(views, BOARD, size).stereo)
        else:
            found, cost = timed(lambda: by_opencv(flags, views, size, true))
        error = found.vector - true.vector
        row = {**cost, "rms_px": found.rms_px, "error_sds": rms(error / sd), "focal_px": rms(error[[0, 1, 9, 10]])}
        row["baseline_mm"] = float(abs(np.linalg.norm(found.T) - np.linalg.norm(true.T)))
        return row | {"rotation_mrad": float(1000 * np.linalg.norm(rotation_vector(found.R @ true.R.T)))}

    rig(0)
    ways = {OURS: None, SEPARATE: cv2.CALIB_FIX_INTRINSIC, TOGETHER: cv2.CALIB_USE_INTRINSIC_GUESS}
    return {name: partial(work, flags) for name, flags in ways.items()}
