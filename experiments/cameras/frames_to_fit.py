"""From pictures to the answer: does the truth of rendered campaigns lie inside the intervals?

    python -m experiments.cameras.frames_to_fit run --n 12 --cores 0      # a minute each, resumable
    python -m experiments.cameras.frames_to_fit table > experiments/cameras/frames_to_fit.md
    python -m experiments.cameras.frames_to_fit paper FOLDER mounted table1 >> experiments/cameras/frames_to_fit.md

`run` draws rig i from `data/rigs/mounted` with seed i, every prior quantity as `tvsbayes simulate` does, and
measures four-point experiments of |N| = 100 and 200 (64 looks), twice with the same stops and sheets: `centroids` are
drawn by the twin, `frames` are rendered, written, read and detected by the method `fit`. Both are fitted (joint,
Laplace); what differs between the two is what detection adds. Drawn centroids have the stated noise times the drawn
pixel_scale; in frames the truth of pixel_scale is the rms of (found - true) / stated of that campaign.

`paper` renders the paper's whole protocol (384 looks, 768 frames, 0.6 GB) into FOLDER, or takes the frames that are
there; both methods; classic and joint estimates beside the truth. The twins: `mounted`, drawn with seed 1, and
`table1`, the shipped paper twin whose classic answer is the paper's Table 1. Its protocol has one |N|: no fit can
separate ratio and backlash there beyond the prior.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy import stats

from experiments.common.against_truth import marked
from experiments.common.command_line import by_seed, study
from experiments.common.page import heading, line
from experiments.common.rigs import mounted_rig, pixels_of, shipped_plan, shipped_twin
from tvsbayes.assessment.summary import summarise
from tvsbayes.cameras.detection import detect
from tvsbayes.estimators.four_point import classic
from tvsbayes.estimators.joint_fit import fit
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.campaign import Campaign, read_campaign
from tvsbayes.instrument.protocols import four_point_protocol
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.results.estimates import Estimate, FitSummary
from tvsbayes.statistics.chances import BOUND, rms_bounds
from tvsbayes.twin.frames import write_frames
from tvsbayes.twin.physics import effective_mirror_offset_mm, project
from tvsbayes.twin.simulated_campaign import simulate
from tvsbayes.twin.true_rig import Truth, read_truth

SOURCES = ("centroids", "frames")
COORDINATES = ("u left", "v left", "u right", "v right")


@dataclass(frozen=True)
class Observed:
    """A simulated campaign, its truth, found minus true centres (n, 4: `COORDINATES`) of good spots, their sds."""

    truth: Truth
    campaign: Campaign
    errors_px: np.ndarray
    stated_px: np.ndarray


def observed(source: str, seed: int) -> Observed:
    """Centres drawn by the twin, or found in rendered frames."""
    simulated = simulate(mounted_rig(), four_point_protocol(repeats=4, steps=(100, 200)), seed)
    campaign = simulated.campaign
    if source == "frames":
        with TemporaryDirectory() as place:
            folder = Path(place) / "campaign"
            twin = simulated.undetected()
            twin.write(folder)
            write_frames(folder, twin, seed)
            # The cameras' sd of every coordinate as a user would have it: from the pictures alone.
            campaign = replace(detect(read_campaign(folder)).campaign, path=None)
    true = project(simulated.light.points_mm, simulated.truth.stereo, simulated.truth.parameters["focal_scale"])
    good = np.array([spot.status == "ok" for spot in campaign.spots])
    errors_px = (pixels_of(campaign) - true)[good]
    return Observed(simulated.truth, campaign, errors_px, pixels_of(campaign, "s")[good])


def one_campaign(task: tuple[str, int]) -> dict[str, object]:
    """Observe and fit; whatever fails is recorded, never dropped."""
    use_compilation_cache()
    source, seed = task
    looks = observed(source, seed)
    errors, stated = looks.errors_px, looks.stated_px
    known = known_truth(looks.truth)
    if source == "frames":
        known["pixel_scale"] = float(np.sqrt(np.mean((errors / stated) ** 2)))
    row: dict[str, object] = {"source": source, "seed": seed, "looks": len(looks.campaign.spots), "ok": len(errors)}
    row |= {"median_sd_px": float(np.median(stated)), "mean_px": errors.mean(0).tolist()}
    row |= {
        "rms_px": np.sqrt((errors**2).mean(0)).tolist(),
        "rms_z": np.sqrt(((errors / stated) ** 2).mean(0)).tolist(),
    }
    try:
        summary = summarise(fit(looks.campaign))
    except Exception as error:
        return {**row, "converged": False, "problems": [repr(error)]}
    pose = (summary.reference_pose_deg["pan"], summary.reference_pose_deg["tilt"])
    row["quantities"] = {
        name: [true, one.value, one.sd, *one.interval95]
        for name, true, one in compared(summary, {**known, **at_pose(looks.truth, looks.campaign, pose)})
    }
    return {**row, "converged": summary.converged, "problems": list(summary.problems)}


def known_truth(truth: Truth) -> dict[str, float]:
    """True values of what `compared` lists and the pose does not change."""
    return {k: truth.parameters[k] for k in ("backlash_deg.pan", "backlash_deg.tilt", "focal_scale", "pixel_scale")}


def at_pose(truth: Truth, campaign: Campaign, pose: tuple[float, float]) -> dict[str, float]:
    """True effective ratios over the looks, and mirror offset at the pose of the fit."""
    ratio = truth.effective_deg_per_step(campaign)
    offset = effective_mirror_offset_mm(truth.parameters, pose)
    return {**{f"effective {d}": ratio[d] for d in DIRECTIONS}, "effective_mirror_offset_mm": offset}


def compared(summary: FitSummary, known: Mapping[str, float]) -> Iterator[tuple[str, float, Estimate]]:
    """(name, truth, estimate) of every headline."""
    for direction in DIRECTIONS:
        yield f"effective {direction}", known[f"effective {direction}"], summary.effective[direction]
    for name in ("backlash_deg.pan", "backlash_deg.tilt", "effective_mirror_offset_mm", "focal_scale", "pixel_scale"):
        yield name, known[name], summary.parameters[name]


def table(every: list[dict]) -> None:
    rows = {source: [r for r in every if r["source"] == source] for source in SOURCES}
    good = {source: {r["seed"]: r for r in rows[source] if r["converged"]} for source in SOURCES}
    both = sorted(set(good["centroids"]) & set(good["frames"]))
    n = len(both)
    print("# From frames to the fit\n")
    print("Written by `python -m experiments.cameras.frames_to_fit table`; what was done stands in the script.\n")
    failed = {source: len(rows[source]) - len(good[source]) for source in SOURCES}
    looks = sum(r["looks"] for r in rows["frames"])
    print(f"## {n} campaigns of {looks // len(rows['frames'])} looks, every rig drawn anew\n")
    print(f"Not converged: {failed['centroids']} from centroids, {failed['frames']} from frames.", end=" ")
    print(f"Found of {looks} looks: {sum(r['ok'] for r in rows['frames'])} in the frames, ", end="")
    print(f"{sum(r['ok'] for r in rows['centroids'])} with drawn centroids inside both images.\n")
    # The lower bound alone: the upper one is n.
    least = int(stats.binom.ppf(BOUND, n, 0.95))
    low, high = rms_bounds(n)
    print(f"Bounds at {BOUND:g} for {n} campaigns: {least} or more inside 95 %, rms z {low:.2f} to {high:.2f}.")
    print("Difference: (frames - centroids) over the sd from frames,", end=" ")
    print("rms; sds: from frames over from centroids, median.\n")
    titles = "quantity | centroids: inside 95 % | rms z | frames: inside 95 % | rms z | mean z | difference | sds"
    print(heading(titles))
    for name in good["frames"][both[0]]["quantities"]:
        cells, values = [name], {}
        for source in SOURCES:
            true, value, sd, lower, upper = np.array([good[source][k]["quantities"][name] for k in both]).T
            inside, z = int(((lower <= true) & (true <= upper)).sum()), (value - true) / sd
            rms = float(np.sqrt((z**2).mean()))
            cells += [marked(f"{inside} of {n}", inside >= least), marked(f"{rms:.2f}", low <= rms <= high)]
            values[source] = value, sd
        cells.append(f"{z.mean():+.2f}")
        (drawn, drawn_sd), (frame, seen_sd) = values["centroids"], values["frames"]
        cells += [f"{np.sqrt((((frame - drawn) / seen_sd) ** 2).mean()):.2f}", f"{np.median(seen_sd / drawn_sd):.2f}"]
        print(line(*cells))
    print("\nFound against true centres:\n\n| coordinate | rms, px | mean, px | rms z |\n|---|---|---|---|")
    for k, name in enumerate(COORDINATES):
        count = np.array([r["ok"] for r in rows["frames"]])
        rms, mean, z = (np.array([r[key][k] for r in rows["frames"]]) for key in ("rms_px", "mean_px", "rms_z"))
        rms, z = (np.sqrt(np.average(x**2, weights=count)) for x in (rms, z))
        print(f"| {name} | {rms:.4f} | {np.average(mean, weights=count):+.4f} | {z:.3f} |")
    drawn, frame = (np.median([r["median_sd_px"] for r in rows[source]]) for source in SOURCES)
    print(f"\nMedian stated sd: {frame:.3f} px, centroids {drawn:.3f} px.")


def rendered(folder: Path, twin: str) -> Path:
    """The campaign folder of a twin, rendered where it is not there yet."""
    place = folder / twin
    if not (place / "truth.json").exists():
        if twin == "mounted":
            drawn = simulate(mounted_rig(), shipped_plan("paper"), 1)
        else:
            twin_of_table1 = shipped_twin("paper_twin")
            campaign = twin_of_table1.campaign
            rig = replace(mounted_rig(), table=campaign.rig, stereo=campaign.stereo)
            drawn = simulate(rig, shipped_plan("paper_twin"), 1, twin_of_table1.truth)
        drawn = drawn.undetected()
        drawn.write(place)
        write_frames(place, drawn, 1)
    return place


def report(place: Path, twin: str) -> None:
    """Detect, estimate and print."""
    campaign = read_campaign(place)
    truth = read_truth(place / "truth.json", campaign.stereo)
    print(f"\n## The paper's protocol, {twin}\n")
    for method in ("fit", "contour"):
        result = detect(campaign, method)
        noise = ", ".join(f"{side} {one.speckle_contrast:.2f}" for side, one in result.noise.items())
        print(f"`detect --method {method}`: {result.statuses},", end=" ")
        print(f"median sd {result.median_sd_px:.3f} px, contrast {noise}\n")
        by_hand = classic(result.campaign).directions
        summary = summarise(fit(result.campaign))
        pose = (summary.reference_pose_deg["pan"], summary.reference_pose_deg["tilt"])
        print(heading("quantity | truth | classic mean (sd) | 95 % type A | joint | 95 % | truth inside | z"))
        for name, value, one in compared(summary, {**known_truth(truth), **at_pose(truth, result.campaign, pose)}):
            low, high = one.interval95
            hand, hands = by_hand.get(name.removeprefix("effective ")), "| | "
            if hand is not None:
                classic_low, classic_high = hand.interval95_type_a
                hands = f"| {hand.mean_deg_per_step:.6f} ({hand.sd_deg_per_step:.6f}) "
                hands += f"| {classic_low:.6f} to {classic_high:.6f} "
            if name == "pixel_scale":
                # Not of the twin: the pictures make their own noise.
                print(f"| {name} | {hands}| {one.value:.6f} | {low:.6f} to {high:.6f} | | |")
                continue
            inside, z = ("yes" if low <= value <= high else "NO"), (one.value - value) / one.sd
            print(f"| {name} | {value:.6f} {hands}| {one.value:.6f} | {low:.6f} to {high:.6f} | {inside} | {z:+.2f} |")
        chi2 = f"chi2 {summary.noise.chi2:.1f} of {summary.noise.dof:.1f} degrees of freedom\n"
        print(f"\nconverged {summary.converged}, {chi2}", flush=True)


def paper(arguments: argparse.Namespace) -> None:
    """The paper's whole protocol from frames."""
    for twin in arguments.twins:
        report(rendered(arguments.folder, twin), twin)


def tasks(of: argparse.Namespace) -> list[tuple]:
    """Seeds from 1 on."""
    return by_seed(SOURCES, of.n + 1)[len(SOURCES) :]


if __name__ == "__main__":
    options = {"folder": {"type": Path, "nargs": "?"}, "twins": {"nargs": "*", "default": ["mounted", "table1"]}}
    study(__file__, __doc__, one_campaign, ("source", "seed"), tasks, table, 12, options, paper=paper)
