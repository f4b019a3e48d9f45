"""From pictures to the answer: does the truth of a rendered paper campaign lie inside the intervals?

    python experiments/frames_to_fit.py FOLDER [mounted] [table1] > experiments/frames_to_fit.md

Renders the paper's protocol (384 looks, 768 frames, 0.6 GB) into FOLDER, or takes the frames that are there; detects by
both methods; classic and joint estimates of both beside the truth. The twins:
`mounted`, drawn with seed 1, and `table1`, the shipped paper twin whose classic answer is the paper's Table 1.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

DIRECTIONS = ("left", "right", "up", "down")


def rendered(folder: Path, twin: str) -> Path:
    """The campaign folder of a twin, rendered where it is not there yet."""
    from studies import mounted_rig, shipped_plan

    from tvsbayes.campaign import read_campaign
    from tvsbayes.device.renderer import write_frames
    from tvsbayes.files import shipped_data
    from tvsbayes.simulation import read_truth, simulate

    place = folder / twin
    if not (place / "truth.json").exists():
        if twin == "mounted":
            made = simulate(mounted_rig(), shipped_plan("paper"), 1)
        else:
            home = shipped_data() / "twins" / "paper_twin"
            campaign = read_campaign(home)
            truth = read_truth(home / "truth.json", campaign.stereo)
            rig = mounted_rig()
            rig = replace(rig, table=campaign.rig, stereo=campaign.stereo)
            made = simulate(rig, shipped_plan("paper_twin"), 1, truth)
        made = made.undetected()
        made.write(place)
        write_frames(place, made, 1, views=0)
    return place


def report(place: Path, twin: str) -> None:
    """Detect, estimate and print."""
    from tvsbayes.campaign import read_campaign
    from tvsbayes.classic import classic
    from tvsbayes.information import summarise
    from tvsbayes.joint import fit
    from tvsbayes.simulation import effective_deg_per_step, effective_mirror_offset_mm, read_truth
    from tvsbayes.spots import detect

    campaign = read_campaign(place)
    truth = read_truth(place / "truth.json", campaign.stereo)
    print(f"\n## {twin}\n")
    for method in ("fit", "contour"):
        found = detect(campaign, method)
        noise = ", ".join(f"{side} {one.speckle_contrast:.2f}" for side, one in found.noise.items())
        print(
            f"`detect --method {method}`: {found.statuses}, median sd {found.median_sd_px:.3f} px, contrast {noise}\n"
        )
        by_hand = classic(found.campaign).directions
        result = fit(found.campaign)
        summary = summarise(result)
        pose = (summary.reference_pose_deg["pan"], summary.reference_pose_deg["tilt"])
        true = effective_deg_per_step(truth.parameters, pose)
        print(
            "| quantity | truth | classic mean (sd) | 95 % type A | joint | 95 % | truth inside | z |\n|" + "---|" * 8
        )
        rows = [(f"effective {d}", true[d], summary.effective[d], by_hand[d]) for d in DIRECTIONS]
        names = ("backlash_deg.pan", "backlash_deg.tilt", "effective_mirror_offset_mm", "pixel_scale", "focal_scale")
        estimates = summary.parameters
        known = {**truth.parameters, "effective_mirror_offset_mm": effective_mirror_offset_mm(truth.parameters, pose)}
        known["pixel_scale"] = None
        rows += [(name, known[name], estimates[name], None) for name in names]
        for name, value, one, hand in rows:
            low, high = one.interval95
            hands = "| | "
            if hand is not None:
                classic_low, classic_high = hand.interval95_type_a
                hands = f"| {hand.mean_deg_per_step:.6f} ({hand.sd_deg_per_step:.6f}) "
                hands += f"| {classic_low:.6f} to {classic_high:.6f} "
            told = "" if value is None else f"{value:.6f}"
            inside = "" if value is None else ("yes" if low <= value <= high else "NO")
            z = "" if value is None else f"{(one.value - value) / one.sd:+.2f}"
            print(f"| {name} | {told} {hands}| {one.value:.6f} | {low:.6f} to {high:.6f} | {inside} | {z} |")
        print(
            f"\nconverged {summary.converged}, chi2 {summary.chi2:.1f} of {summary.dof} degrees of freedom\n",
            flush=True,
        )


def main() -> None:
    """Render, detect, estimate."""
    print(
        "# From frames to the fit\n\n`python experiments/frames_to_fit.py`: both methods, classic and joint (Laplace)."
    )
    for twin in sys.argv[2:] or ("mounted", "table1"):
        report(rendered(Path(sys.argv[1]), twin), twin)


if __name__ == "__main__":
    np.set_printoptions(precision=4)
    main()
