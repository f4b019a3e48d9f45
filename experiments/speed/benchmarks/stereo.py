"""Stereo calibration: ours against OpenCV's, from the same corners of rendered checkerboards whose truth is known."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import cv2
import numpy as np

from experiments.common.board_views import BOARD, rendered_views, scenes
from experiments.common.clock import timed
from experiments.common.opencv_stereo import calibrated
from experiments.speed.benchmarks.measure import Bench, Case, Column, Work
from tvsbayes.cameras.boards import View
from tvsbayes.cameras.stereo_calibration import calibrate_stereo
from tvsbayes.instrument.stereo_pair import Stereo, rotation_vector
from tvsbayes.model.compilation_cache import use_compilation_cache

TITLE = "Stereo calibration"
NAME = "12 views of a 9 x 6 board, rendered; every repeat is another rig"
OURS, SEPARATE, TOGETHER = "tvsbayes", "cv2, cameras one by one, then the pair", "cv2, then all parameters together"


@dataclass(frozen=True)
class DrawnRig:
    """A true pair, the views of a board that both cameras see, and our stated uncertainties, the scale of errors."""

    true: Stereo
    views: list[View]
    sd: np.ndarray

    @property
    def size(self) -> tuple[int, int]:
        """Of a picture, px."""
        return self.true.image_width, self.true.image_height

    def judged(self, stereo: Stereo, rms_px: float, cost: dict[str, float]) -> dict[str, object]:
        """A row of a calibration."""
        error = stereo.vector - self.true.vector
        return {
            **cost,
            "views": len(self.views),
            "rms_px": float(rms_px),
            "error_sds": float(np.sqrt(np.mean((error / self.sd) ** 2))),
            "focal_px": float(np.sqrt(np.mean(error[[0, 1, 9, 10]] ** 2))),
            "baseline_mm": float(abs(np.linalg.norm(stereo.T) - np.linalg.norm(self.true.T))),
            "rotation_mrad": float(1000 * np.linalg.norm(rotation_vector(stereo.R @ self.true.R.T))),
        }


@lru_cache(maxsize=1)
def rig(seed: int) -> DrawnRig:
    """Drawn and rendered once for all contenders of a turn."""
    drawn = scenes(seed, "rendered")
    views = [v for v in rendered_views(drawn, seed) if v.left is not None and v.right is not None]
    true = drawn[0].stereo
    stated = calibrate_stereo(views, BOARD, (true.image_width, true.image_height)).stereo.parameter_covariance
    return DrawnRig(true, views, np.sqrt(np.diag(stated)))


def ours(seed: int) -> dict[str, object]:
    """`tvsbayes stereo`."""
    drawn = rig(seed)
    calibration, cost = timed(lambda: calibrate_stereo(drawn.views, BOARD, drawn.size))
    return drawn.judged(calibration.stereo, calibration.stereo.rms_px, cost)


def opencv(together: bool) -> Work:
    """OpenCV's cameras one by one, then the pair, or then all parameters together."""
    flags = cv2.CALIB_USE_INTRINSIC_GUESS if together else cv2.CALIB_FIX_INTRINSIC

    def row(seed: int) -> dict[str, object]:
        drawn = rig(seed)
        sides = [[getattr(view, side) for view in drawn.views] for side in ("left", "right")]
        # As many steps as it needs: the default of 30 steps or 1e-6 stops in a hurry.
        work = partial(calibrated, BOARD.points_mm, sides, drawn.size, flags, ends=(200, 1e-9))
        (rms, m1, d1, m2, d2, turn, shift), cost = timed(work)
        five = [np.asarray(d, float).ravel()[:5] for d in (d1, d2)]
        stereo = replace(drawn.true, M1=m1, D1=five[0], M2=m2, D2=five[1], R=turn, T=np.asarray(shift).ravel())
        return drawn.judged(stereo, rms, cost)

    return row


def measure(bench: Bench) -> None:
    """Repeat k calibrates drawn rig k by all three."""
    if not bench.missing(NAME, (OURS, SEPARATE, TOGETHER)):
        return
    use_compilation_cache()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        rig(0)
        bench.interleaved(NAME, {OURS: ours, SEPARATE: opencv(False), TOGETHER: opencv(True)})


def cases() -> list[Case]:
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
