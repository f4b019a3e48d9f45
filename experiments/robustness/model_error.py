"""Which model errors does a fit notice, how often does it cry wolf, and is its inflated uncertainty honest?

    python -m experiments.robustness.model_error run --clean 200 --n 20 --cores 0     # 1 s a campaign, resumable
    python -m experiments.robustness.model_error table > experiments/robustness/model_error.md

Rig i of `data/rigs/mounted` is drawn with seed i, every prior quantity, and runs the grid protocol (144 spots, no
aperture readings) clean and with each defect at three sizes. Clean and broken campaigns of a seed share rig, stop
errors and pixel noise. Each is fitted by the Laplace approximation (`fits.fit_from_truth`) and validated
(`score_tests.validate`). Printed are false alarms with Clopper-Pearson bounds, how many broken campaigns were noticed,
which defect was named, and the RMS z of the headlines before and after every u is multiplied by the stated factor.
"""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import replace
from functools import partial

import numpy as np

from experiments.common.against_truth import failures, rms, tried
from experiments.common.command_line import study
from experiments.common.fits import fit_from_truth
from experiments.common.page import heading, line, share
from experiments.common.rigs import PIXELS, mounted_rig, pixels_of, shipped_plan, with_pixels
from experiments.common.worlds import campaign_of
from tvsbayes.assessment.residuals import residual_causes, stop_residuals
from tvsbayes.assessment.score_tests import validate
from tvsbayes.instrument.stereo_pair import rotation_matrix
from tvsbayes.results.records import plain
from tvsbayes.twin.physics import inside_images, mirror_chain, project
from tvsbayes.twin.simulated_campaign import simulate

KEYS = ("defect", "size", "seed")
DEFECTS = {
    "pinion": ((0.02, 0.05, 0.15), "transmission error of both axes, period 36 deg, amplitude in deg"),
    "tooth": ((0.02, 0.05, 0.15), "transmission error of both axes, period 3 deg, amplitude in deg"),
    "knock": ((0.05, 0.15, 0.5), "the cameras turned after 60 % of the spots, in deg, and shifted by 4 mm per deg"),
    "camera drift": ((0.05, 0.15, 0.5), "the same, growing linearly over the whole campaign"),
    "ratio drift": ((0.1, 0.3, 1.0), "both ratios change over the campaign, in % from first to last spot"),
    "lost steps": ((1, 2, 4), "pan loses so many steps in the middle of the campaign"),
    "bent sheet": ((1.0, 3.0, 10.0), "both sheets sag, in mm at 100 mm from their middle"),
}
MM_PER_DEG = 4.0


def broken_campaign(defect: str, size: float, seed: int):
    """A simulated campaign with one defect, and its truth; the twin's own formulas with other angles or points."""
    rig, plan = mounted_rig(), shipped_plan("grid")
    if defect in ("pinion", "tooth"):
        # The line through the looks, the quantity wanted, is that of gears with this error.
        simulated = campaign_of(rig, plan, defect, size, seed)
        return simulated.campaign, simulated.truth
    simulated = simulate(rig, plan, seed)
    campaign, truth, light = simulated.campaign, simulated.truth, simulated.light
    if defect == "clean":
        return campaign, truth
    generator, p, spots = np.random.default_rng([seed, 0x6D65]), truth.parameters, campaign.spots
    along = np.linspace(0.0, 1.0, len(spots))
    angles = np.array(truth.mirror_angles_deg)[[spot.move for spot in spots]]
    counters = np.array([(campaign.moves[s.move].pan_steps, campaign.moves[s.move].tilt_steps) for s in spots])
    ratios = np.array([p["degrees_per_step.pan"], p["degrees_per_step.tilt"]])
    if defect == "ratio drift":
        angles = angles + ratios * counters * (size / 100 * (along - 0.5))[:, None]
    elif defect == "lost steps":
        angles = angles - np.outer(along >= 0.5, [ratios[0] * size, 0.0])
    rotation = rotation_matrix(np.array([p[f"extrinsics.rotation_rad.{a}"] for a in "xyz"]))
    origin, direction = (part @ rotation.T for part in mirror_chain(*np.radians(angles).T, p))
    origin = origin + [p[f"extrinsics.translation_mm.{a}"] for a in "xyz"]
    # Each sheet is the plane through the point that its beam met.
    sag, bent = np.zeros(len(spots)), defect == "bent sheet"
    middle = np.nanmean(light.points_mm[:, 1:], axis=0)
    for _ in range(20 if bent else 1):
        aim = np.sum((light.points_mm - origin) * light.normals, axis=1) + sag
        points = origin + direction * (aim / np.sum(direction * light.normals, axis=1))[:, None]
        sag = bent * size * np.sum((points[:, 1:] - middle) ** 2, axis=1) / 100.0**2
    if defect in ("knock", "camera drift"):
        turn, shift = (v / np.linalg.norm(v) for v in generator.standard_normal((2, 3)))
        part = (along >= 0.6).astype(float) if defect == "knock" else along
        matrices = np.stack([rotation_matrix(np.radians(size) * s * turn) for s in part])
        points = np.einsum("nij,nj->ni", matrices, points) + MM_PER_DEG * size * part[:, None] * shift
    noise = pixels_of(campaign) - project(light.points_mm, truth.stereo, p["focal_scale"])
    pixels = inside_images(project(points, truth.stereo, p["focal_scale"]) + noise, truth.stereo)
    gone = {prefix + name: None for prefix in ("", "s") for name in PIXELS}
    changed = tuple(
        with_pixels(spot, row) if np.isfinite(row).all() else replace(spot, **gone, status="undetected")
        for spot, row in zip(spots, pixels, strict=True)
    )
    return replace(campaign, spots=changed), truth


def one_campaign(task: tuple[str, float, int]) -> dict[str, object]:
    campaign, truth = broken_campaign(*task)

    def validated(fit) -> dict[str, object]:
        grouped = sorted({c.name for c in residual_causes(stop_residuals(fit)) if c.suspicious})
        return {"validation": plain(validate(fit)), "grouped": grouped, "suspects": len(fit.suspect_spots)}

    row = dict(zip(KEYS, task, strict=True))
    begin = partial(fit_from_truth, truth=truth)
    return row | tried(campaign, truth, begin=begin, more=validated)


def tasks(of: argparse.Namespace) -> list[tuple[str, float, int]]:
    """Turn by turn, so that an interrupted run is balanced."""
    every, turn = [], -(-of.clean // of.n)
    for seed in range(of.n):
        every += [("clean", 0.0, s) for s in range(seed * turn, min((seed + 1) * turn, of.clean))]
        every += [(defect, size, seed) for defect, (sizes, _) in DEFECTS.items() for size in sizes]
    return every


def rms_z(rows: list[dict]) -> list[str]:
    """RMS of z over rows and headlines, as stated, and inflated."""
    z = [np.array([each["z"] for each in row["laplace"].values()]) for row in rows]
    inflated = [each / row["validation"]["inflation"] for each, row in zip(z, rows, strict=True)]
    return [f"{rms(np.concatenate(each)):.2f}" for each in (z, inflated)]


def table(rows: list[dict]) -> None:
    good = [row for row in rows if row["answer"] == "fitted"]
    clean = [row for row in good if row["defect"] == "clean"]
    failed, (before, after) = sum(not row["validation"]["passed"] for row in clean), rms_z(clean)
    print("# Which model errors does a fit notice?\n")
    print("Written by `python -m experiments.robustness.model_error table`.\n")
    print(f"## Clean campaigns\n\n{len(clean)} campaigns: {failed} failed their validation,")
    print(f"{share(failed, len(clean))}; the stated level is {100 * clean[0]['validation']['level']:g} %. RMS z of the")
    print(f"headlines {before}, after inflation {after}.\n\n{heading('test | asked in | p below 5 % | failed')}")
    tests = [test for row in clean for test in row["validation"]["tests"]]
    for name in dict.fromkeys(test["name"] for test in tests):
        mine = [test for test in tests if test["name"] == name]
        below = f"{100 * np.mean([test['p'] < 0.05 for test in mine]):.1f} %"
        print(line(name, len(mine), below, sum(test["failed"] for test in mine)))
    grouped, suspect = (share(sum(bool(row[key]) for row in clean), len(clean)) for key in ("grouped", "suspects"))
    print(f"\nFor comparison: grouped residuals (`residual_causes`) called a cause suspicious in {grouped}, the gate")
    print(f"named a spot in {suspect}.\n\n## Defects\n")
    print(*(f"- {defect}: {meaning}" for defect, (_, meaning) in DEFECTS.items()), sep="\n")
    print("\nF: median factor of the campaigns that failed. Named: the defect whose test had the least")
    print("p.\n")
    titles = "defect | size | campaigns | detected | named most often | other tests | F | RMS z | after | grouped"
    print(heading(titles))
    for defect, (sizes, _) in DEFECTS.items():
        for size in sizes:
            if mine := [row for row in good if (row["defect"], row["size"]) == (defect, size)]:
                alarmed = [row["validation"] for row in mine if not row["validation"]["passed"]]
                named = Counter(each["cause"].split(":")[0] for each in alarmed)
                others = Counter(t["name"] for each in alarmed for t in each["tests"] if t["failed"])
                best = "; ".join(f"{name} {n}" for name, n in named.most_common(2)) or "-"
                also = "; ".join(f"{name} {n}" for name, n in others.most_common(3) if name not in best) or "-"
                factor = f"{np.median([each['inflation'] for each in alarmed]):.1f}" if alarmed else "-"
                cells = (len(mine), len(alarmed), best, also, factor, *rms_z(mine))
                print(line(defect, f"{size:g}", *cells, sum(bool(row["grouped"]) for row in mine)))
    print(f"\n{len(rows)} fits, {len(rows) - len(good)} not converged.")
    failures(rows, KEYS, ("fitted",))


if __name__ == "__main__":
    options = {"--clean": {"type": int, "default": 200, "help": "campaigns without a defect (%(default)s)"}}
    study(__file__, __doc__, one_campaign, KEYS, tasks, table, 20, options)
