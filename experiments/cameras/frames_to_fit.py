"""From pictures to the answer: does the truth of rendered campaigns lie inside the intervals?

    python -m experiments.cameras.frames_to_fit run --n 12 --cores 0      # a minute each, resumable
    python -m experiments.cameras.frames_to_fit table > experiments/cameras/frames_to_fit.md

Rig i is drawn from `data/rigs/mounted` with seed i, every prior quantity as `tvsbayes simulate` does, and
measures four-point experiments of |N| = 100 and 200 (64 looks), twice with the same stops and sheets: `centroids` are
drawn by the twin, `frames` are rendered, written, read and detected by the method `fit`. Both are fitted (joint,
Laplace); what differs between the two is what detection adds. Drawn centroids have the stated noise times the drawn
pixel_scale; in frames the truth of pixel_scale is the rms of (found - true) / stated of that campaign.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from experiments.common.against_truth import NOTE, failures, rms, table, tried
from experiments.common.command_line import study
from experiments.common.page import heading, line
from experiments.common.rigs import mounted_rig, pixels_of
from tvsbayes.cameras.detection import detect
from tvsbayes.instrument.campaign import read_campaign
from tvsbayes.instrument.protocols import four_point_protocol
from tvsbayes.twin.frames import write_frames
from tvsbayes.twin.physics import project
from tvsbayes.twin.simulated_campaign import simulate

KEYS, SOURCES = ("source", "seed"), ("centroids", "frames")
COORDINATES = ("u left", "v left", "u right", "v right")


def one_campaign(task: tuple[str, int]) -> dict[str, object]:
    source, seed = task
    run = simulate(mounted_rig(), four_point_protocol(repeats=4, steps=(100, 200)), seed + 1)
    campaign, truth = run.campaign, run.truth
    if source == "frames":
        with TemporaryDirectory() as place:
            folder, twin = Path(place) / "campaign", run.undetected()
            twin.write(folder)
            write_frames(folder, twin, seed + 1)
            # The cameras' sd of every coordinate as a user would have it: from the pictures alone.
            campaign = replace(detect(read_campaign(folder)).campaign, path=None)
    true_px = project(run.light.points_mm, truth.stereo, truth.parameters["focal_scale"])
    good = np.array([spot.status == "ok" for spot in campaign.spots])
    errors, stated = (pixels_of(campaign) - true_px)[good], pixels_of(campaign, "s")[good]
    if source == "frames":
        scale = {"pixel_scale": float(np.sqrt(np.mean((errors / stated) ** 2)))}
        truth = replace(truth, parameters={**truth.parameters, **scale})
    row = {**dict(zip(KEYS, task, strict=True)), "looks": len(campaign.spots), "ok": len(errors)}
    row |= {"median_sd_px": float(np.median(stated)), "mean_px": errors.mean(0).tolist()}
    row |= {"square_px2": (errors**2).mean(0).tolist(), "square_z": ((errors / stated) ** 2).mean(0).tolist()}
    return row | tried(campaign, truth, names=("focal_scale", "pixel_scale"))


def page(rows: list[dict]) -> None:
    of = {source: [row for row in rows if row["source"] == source] for source in SOURCES}
    print(f"# From frames to the fit\n\nWritten by `python -m experiments.cameras.frames_to_fit table`; {NOTE}.\n")
    for source, mine in of.items():
        print(f"- {source}: {sum(r['ok'] for r in mine)} of {sum(r['looks'] for r in mine)} looks found, median stated")
        print(f"  sd {np.median([r['median_sd_px'] for r in mine]):.3f} px")
    print()
    table({source: [row["laplace"] for row in mine if row["answer"] == "fitted"] for source, mine in of.items()})
    failures(rows, KEYS, ("fitted",))
    print(heading("coordinate | found less true centres: rms, px | mean, px | rms z"))
    count = [row["ok"] for row in of["frames"]]
    keys = ("square_px2", "mean_px", "square_z")
    for k, name in enumerate(COORDINATES):
        square, mean, z2 = (np.average([r[key][k] for r in of["frames"]], weights=count) for key in keys)
        print(line(name, f"{rms([square**0.5]):.4f}", f"{mean:+.4f}", f"{z2**0.5:.3f}"))


if __name__ == "__main__":
    study(__file__, __doc__, one_campaign, KEYS, SOURCES, page, 12)
