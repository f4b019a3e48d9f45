"""Spot centres: ours against photutils on the same pictures, and against only decoding them."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from experiments.common.clock import timed
from experiments.common.rigs import mounted_rig, pixels_of, small_plan
from experiments.speed.benchmarks.measure import Bench, Case, Column, Work
from tvsbayes.cameras import detection, spot_window
from tvsbayes.instrument.campaign import Campaign, read_campaign
from tvsbayes.twin.frames import write_frames
from tvsbayes.twin.physics import project
from tvsbayes.twin.simulated_campaign import simulate

TITLE = "Spot centres"
NAME = "Rendered frames of 48 looks, 1280 x 720 px PNG"
SEED = 4
BRIGHT = 0.2
OURS, CONTOUR, READ = "tvsbayes detect", "tvsbayes detect, contour", "cv2.imread alone"
PEERS = {
    "photutils centroid_com": "com",
    f"photutils centroid_com, above {BRIGHT:.0%} of the peak": "bright",
    "photutils centroid_2dg": "2dg",
}


@dataclass(frozen=True)
class Frames:
    """Rendered pictures of a campaign: its folder as read, their paths, left before right, and the true centres."""

    campaign: Campaign
    paths: list[str]
    true_px: np.ndarray

    def judged(self, centres_px: np.ndarray, cost: dict[str, float]) -> dict[str, object]:
        """A row of found centres (pictures, 2), NaN where none was found."""
        errors = centres_px - self.true_px
        detected = np.isfinite(errors).all(axis=1)
        errors = errors[detected]
        return {
            **self.per_frame(cost),
            "ok": int(detected.sum()),
            "rms_px": float(np.sqrt(np.mean(errors**2))),
            "median_px": float(np.median(np.abs(errors))),
            "max_px": float(np.abs(errors).max()),
        }

    def per_frame(self, cost: dict[str, float]) -> dict[str, float]:
        """Milliseconds of processor as well."""
        return {**cost, "ms": 1000 * cost["cpu_s"] / len(self.paths)}

    def ours(self, method: str) -> Work:
        """`tvsbayes detect` on one thread."""

        def row(_: int) -> dict[str, object]:
            detected, cost = timed(lambda: detection.detect(self.campaign, method, workers=1))
            return self.judged(pixels_of(detected.campaign).reshape(-1, 2), cost)

        return row

    def reading(self, _: int) -> dict[str, object]:
        """Only decoding."""
        _, cost = timed(lambda: [cv2.imread(path) for path in self.paths])
        return {**self.per_frame(cost), "ok": len(self.paths)}

    def peer(self, kind: str) -> Work:
        """Photutils."""

        def row(_: int) -> dict[str, object]:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                centres, cost = timed(lambda: [photutils_centre(path, kind) for path in self.paths])
            return self.judged(np.array(centres), cost)

        return row


def photutils_centre(path: str, kind: str) -> np.ndarray:
    """Centre of the spot of a picture by photutils, px, NaN where our window finds none."""
    from photutils import centroids

    function: Callable = centroids.centroid_2dg if kind == "2dg" else centroids.centroid_com
    patch = spot_window.patch_around(cv2.imread(path))
    if isinstance(patch, str):
        return np.full(2, np.nan)
    grey = patch.grey.astype(float)
    border = np.concatenate((grey[0], grey[-1], grey[:, 0], grey[:, -1]))
    light, unusable = grey - np.median(border), ~patch.usable
    if kind == "bright":
        # What is clipped is brightest: a centre of mass without it would be one of the rim.
        light, unusable = np.where(light > BRIGHT * light.max(), light, 0.0), None
    elif kind == "com":
        unusable = None
    return np.asarray(function(light, mask=unusable)) + patch.corner


def rendered(folder: Path) -> Frames:
    """48 looks of a drawn rig."""
    twin = simulate(mounted_rig(), small_plan(("d1", "d3")), SEED)
    frames = twin.undetected()
    frames.write(folder)
    write_frames(folder, frames, SEED)
    true = project(twin.light.points_mm, twin.truth.stereo, twin.truth.parameters["focal_scale"])
    campaign = read_campaign(folder)
    names = [f"{spot.spot:06d}_{side}.png" for spot in campaign.spots for side in ("left", "right")]
    return Frames(campaign, [str(folder / "frames" / name) for name in names], true.reshape(-1, 2))


def measure(bench: Bench) -> None:
    """All frames once per turn, on one thread, from the files to centres."""
    if not bench.missing(NAME, (OURS, CONTOUR, READ, *PEERS)):
        return
    with tempfile.TemporaryDirectory() as place:
        frames = rendered(Path(place) / "campaign")
        works = {OURS: frames.ours("fit"), CONTOUR: frames.ours("contour"), READ: frames.reading}
        works |= {name: frames.peer(kind) for name, kind in PEERS.items()}
        # The file cache and lazy imports.
        for work in (frames.reading, frames.peer("2dg"), frames.ours("fit")):
            work(0)
        bench.interleaved(NAME, works)


def cases() -> list[Case]:
    """Tables of the part."""
    about = (
        "Error of one coordinate against the twin's true centre. Seconds from file to centre on one thread; ours hold "
        "safe reading, learning the noise, a covariance and the epipolar check. photutils has no finder for one laser "
        "spot: it is given our window around the spot less the median of the window's border, and for the fits the "
        "mask of clipped pixels. Speckle and exposure are the renderer's defaults."
    )
    columns = (
        Column("ms", "CPU ms per frame"),
        Column("rms_px", "rms error, px", "{:.4f}"),
        Column("median_px", "median error, px", "{:.4f}"),
        Column("max_px", "largest, px", "{:.3f}"),
        Column("ok", "centres of 96", "{:.0f}"),
    )
    return [Case(NAME, about, columns, "ms", OURS)]
