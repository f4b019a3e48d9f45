"""Spot centres: ours against photutils on the same pictures, and against only decoding them."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from .measure import Bench, Case, Column, timed

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


def measure(bench: Bench) -> None:
    """All frames once per turn, on one thread, from the files to centres."""
    if not bench.missing(NAME, (OURS, CONTOUR, READ, *PEERS)):
        return
    import cv2
    from photutils import centroids
    from studies import mounted_rig, small_plan

    from tvsbayes.cameras import detection, spot_fit
    from tvsbayes.instrument.campaign import read_campaign
    from tvsbayes.twin.frames import write_frames
    from tvsbayes.twin.physics import project
    from tvsbayes.twin.simulated_campaign import simulate

    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "campaign"
        twin = simulate(mounted_rig(), small_plan(("d1", "d3")), SEED)
        made = twin.undetected()
        made.write(folder)
        write_frames(folder, made, SEED, views=0)
        true = project(twin.light.points_mm, twin.truth.stereo, twin.truth.parameters["focal_scale"])
        campaign = read_campaign(folder)
        sides = ("left", "right")
        paths = [
            (str(folder / "frames" / f"{spot.spot:06d}_{side}.png"), true[row, 2 * k : 2 * k + 2])
            for row, spot in enumerate(campaign.spots)
            for k, side in enumerate(sides)
        ]

        def judged(centres: Sequence[np.ndarray], cost: dict[str, float]) -> dict[str, object]:
            errors = np.array(centres) - np.array([at for _, at in paths])
            seen = np.isfinite(errors).all(axis=1)
            errors = errors[seen]
            return {
                **cost,
                "ms": 1000 * cost["cpu_s"] / len(paths),
                "ok": int(seen.sum()),
                "rms_px": float(np.sqrt(np.mean(errors**2))),
                "median_px": float(np.median(np.abs(errors))),
                "max_px": float(np.abs(errors).max()),
            }

        def ours(method: str):
            def row(_: int) -> dict[str, object]:
                found, cost = timed(lambda: detection.detect(campaign, method, workers=1))
                centres = [
                    [getattr(spot, f"{c}_{side}_px") if spot.status == "ok" else np.nan for c in "uv"]
                    for spot in found.campaign.spots
                    for side in sides
                ]
                return judged(np.array(centres, dtype=float), cost)

            return row

        def reading(_: int) -> dict[str, object]:
            _, cost = timed(lambda: [cv2.imread(path) for path, _ in paths])
            return {**cost, "ms": 1000 * cost["cpu_s"] / len(paths), "ok": len(paths)}

        functions = {
            "com": centroids.centroid_com,
            "bright": centroids.centroid_com,
            "2dg": centroids.centroid_2dg,
        }

        def peer(kind: str):
            def centre(path: str) -> np.ndarray:
                patch = spot_fit.patch_around(cv2.imread(path))
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
                return np.asarray(functions[kind](light, mask=unusable)) + patch.corner

            def row(_: int) -> dict[str, object]:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    found, cost = timed(lambda: [centre(path) for path, _ in paths])
                return judged(found, cost)

            return row

        works = {OURS: ours("fit"), CONTOUR: ours("contour"), READ: reading}
        works |= {name: peer(kind) for name, kind in PEERS.items()}
        # The file cache and lazy imports.
        reading(0), peer("2dg")(0), ours("fit")(0)
        bench.interleaved(NAME, works)


def cases(rows: Sequence[Mapping]) -> list[Case]:
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


def remarks(rows: Sequence[Mapping]) -> list[str]:
    """None."""
    return []
