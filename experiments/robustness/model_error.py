"""Which model errors does a fit notice, how often does it cry wolf, and is its inflated uncertainty honest?

    python -m experiments.robustness.model_error run --clean 200 --n 20 --cores 0     # 1 s a campaign, resumable
    python -m experiments.robustness.model_error table > experiments/robustness/model_error.md

`run` draws rig i of `data/rigs/mounted` with seed i, every prior quantity, and simulates the grid protocol (144
spots, no aperture readings) clean and with each defect at three sizes: gears whose transmission error is a wave, a
camera pair that was knocked or that drifts, gears whose ratio drifts, lost steps, a bent sheet. Clean and broken
campaigns of a seed share rig, stop errors and pixel noise. Each is fitted by the Laplace approximation
(`fits.fit_from_truth`) and validated (`score_tests.validate`). `table` prints false alarms with Clopper-Pearson
bounds, how many broken campaigns were noticed, which defect was named, and the RMS z of the four effective ratios and
both backlashes before and after every u is multiplied by the stated factor.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from dataclasses import replace

import numpy as np

from experiments.common.command_line import study
from experiments.common.fits import fit_from_truth
from experiments.common.headlines import judged
from experiments.common.page import heading, line, share
from experiments.common.rigs import PIXELS, mounted_rig, pixels_of, shipped_plan, unseen, with_pixels
from experiments.common.worlds import campaign_of
from tvsbayes.assessment.residuals import residual_causes, stop_residuals
from tvsbayes.assessment.score_tests import validate
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.stereo_pair import rotation_matrix
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.results.records import plain
from tvsbayes.twin.physics import inside_images, mirror_chain, project
from tvsbayes.twin.simulated_campaign import simulate

SIZES = {
    "pinion": (0.02, 0.05, 0.15),
    "tooth": (0.02, 0.05, 0.15),
    "knock": (0.05, 0.15, 0.5),
    "camera drift": (0.05, 0.15, 0.5),
    "ratio drift": (0.1, 0.3, 1.0),
    "lost steps": (1, 2, 4),
    "bent sheet": (1.0, 3.0, 10.0),
}
MEANING = {
    "clean": "nothing broken",
    "pinion": "transmission error of both axes, period 36 deg, amplitude in deg",
    "tooth": "transmission error of both axes, period 3 deg, amplitude in deg",
    "knock": "the camera pair turned after 60 % of the spots, in deg, and was shifted by 4 mm per deg",
    "camera drift": "the same, growing linearly over the whole campaign",
    "ratio drift": "both ratios change over the campaign, in % from first to last spot",
    "lost steps": "pan loses so many steps in the middle of the campaign",
    "bent sheet": "both sheets sag, in mm at 100 mm from their middle",
}
MM_PER_DEG = 4.0
JUDGED = (*(f"effective {direction}" for direction in DIRECTIONS), "backlash pan", "backlash tilt")


def broken_campaign(defect: str, size: float, seed: int):
    """A simulated campaign with one defect, and its truth; the twin's own formulas with other angles or points."""
    rig, plan = mounted_rig(), shipped_plan("grid")
    if defect == "pinion" or defect == "tooth":
        # The line through the looks, the quantity wanted, is that of gears with this error.
        simulated = campaign_of(rig, plan, defect, size, seed)
        return simulated.campaign, simulated.truth
    simulated = simulate(rig, plan, seed)
    campaign, truth, light = simulated.campaign, simulated.truth, simulated.light
    if defect == "clean":
        return campaign, truth
    generator = np.random.default_rng([seed, 0x6D65])
    p = truth.parameters
    spots = campaign.spots
    count = len(spots)
    along = np.arange(count) / (count - 1)
    angles = np.array(truth.mirror_angles_deg)[[spot.move for spot in spots]]
    counters = np.array([(campaign.moves[s.move].pan_steps, campaign.moves[s.move].tilt_steps) for s in spots])
    ratios = np.array([p["degrees_per_step.pan"], p["degrees_per_step.tilt"]])
    if defect == "ratio drift":
        angles = angles + ratios * counters * (size / 100 * (along - 0.5))[:, None]
    elif defect == "lost steps":
        angles = angles - np.outer(along >= 0.5, [ratios[0] * size, 0.0])
    rotation = rotation_matrix(np.array([p[f"extrinsics.rotation_rad.{a}"] for a in "xyz"]))
    translation = np.array([p[f"extrinsics.translation_mm.{a}"] for a in "xyz"])
    origin, direction = (part @ rotation.T for part in mirror_chain(*np.radians(angles).T, p))
    origin = origin + translation
    # Each sheet is the plane through the point that its beam met.
    sag = np.zeros(count)
    for _ in range(20 if defect == "bent sheet" else 1):
        aim = np.sum((light.points_mm - origin) * light.normals, axis=1) + sag
        points = origin + direction * (aim / np.sum(direction * light.normals, axis=1))[:, None]
        if defect == "bent sheet":
            middle = np.nanmean(light.points_mm[:, 1:], axis=0)
            sag = size * np.sum((points[:, 1:] - middle) ** 2, axis=1) / 100.0**2
    if defect in ("knock", "camera drift"):
        turn, shift = (v / np.linalg.norm(v) for v in generator.standard_normal((2, 3)))
        share = (along >= 0.6).astype(float) if defect == "knock" else along
        matrices = np.stack([rotation_matrix(np.radians(size) * s * turn) for s in share])
        points = np.einsum("nij,nj->ni", matrices, points) + MM_PER_DEG * size * share[:, None] * shift
    noise = pixels_of(campaign) - project(light.points_mm, truth.stereo, p["focal_scale"])
    pixels = inside_images(project(points, truth.stereo, p["focal_scale"]) + noise, truth.stereo)
    gone = {prefix + name: None for prefix in ("", "s") for name in PIXELS}
    changed = tuple(
        with_pixels(spot, row) if np.isfinite(row).all() else replace(spot, **gone, status="undetected")
        for spot, row in zip(spots, pixels, strict=True)
    )
    return replace(campaign, spots=changed), truth


def one_campaign(task: tuple[str, float, int]) -> dict[str, object]:
    """Break, fit, validate."""
    defect, size, seed = task
    use_compilation_cache()
    campaign, truth = broken_campaign(defect, size, seed)
    row: dict[str, object] = {"defect": defect, "size": size, "seed": seed, "unseen": unseen(campaign)}
    start = time.process_time()
    try:
        fit = fit_from_truth(campaign, truth)
        row |= {"converged": fit.converged, "problems": list(fit.problems), "suspects": len(fit.suspect_spots)}
        row["fit_s"] = time.process_time() - start
        start = time.process_time()
        validation = validate(fit)
        row["validate_s"] = time.process_time() - start
        row["validation"] = plain(validation)
        row["grouped"] = sorted({c.name for c in residual_causes(stop_residuals(fit)) if c.suspicious})
        row["values"] = judged(fit, truth, campaign)
    except Exception as error:
        row |= {"converged": False, "problems": [repr(error)]}
    return row


def tasks(of: argparse.Namespace) -> list[tuple[str, float, int]]:
    """Turn by turn, so that an interrupted run is balanced."""
    every: list[tuple[str, float, int]] = []
    turn = -(-of.clean // of.n)
    for seed in range(of.n):
        every += [("clean", 0.0, s) for s in range(seed * turn, min((seed + 1) * turn, of.clean))]
        every += [(defect, size, seed) for defect, sizes in SIZES.items() for size in sizes]
    return every


def rms_z(rows: list[dict], inflated: bool) -> float:
    """RMS of z over rows and quantities."""
    factor = [r["validation"]["inflation"] if inflated else 1.0 for r in rows]
    z = [[r["values"][name]["z"] / f for name in JUDGED] for r, f in zip(rows, factor, strict=True)]
    return float(np.sqrt(np.mean(np.square(z))))


TEXT = """# Which model errors does a fit notice?

Written by `python -m experiments.robustness.model_error table`; campaigns and defects stand in the script.

## Clean campaigns
"""
DEFECTS_TEXT = f"""
RMS z over the four effective ratios and both backlashes; 1 is honest. F: median factor of the campaigns \
that failed. Named: the defect whose test had the least p.

{heading("defect | size | campaigns | detected | named most often | other tests | F | RMS z | after | grouped")}"""


def table(rows: list[dict]) -> None:
    """Markdown of everything that came out."""
    good = [r for r in rows if "validation" in r and r["converged"]]
    clean = [r for r in good if r["defect"] == "clean"]
    level = clean[0]["validation"]["level"]
    print(TEXT)
    failed = sum(not r["validation"]["passed"] for r in clean)
    print(
        f"{len(clean)} campaigns: {failed} failed their validation, {share(failed, len(clean))}; the stated "
        f"level is {100 * level:g} %. RMS z of the ratios and backlashes {rms_z(clean, False):.2f}, after inflation "
        f"{rms_z(clean, True):.2f}. A validation takes {np.median([r['validate_s'] for r in clean]):.2f} s of CPU time."
        "\n"
    )
    names = Counter(t["name"] for r in clean for t in r["validation"]["tests"])
    print("| test | asked in | p below 5 % | failed |\n|---|---|---|---|")
    for name, count in names.items():
        mine = [t for r in clean for t in r["validation"]["tests"] if t["name"] == name]
        below = f"{100 * np.mean([t['p'] < 0.05 for t in mine]):.1f} %"
        print(line(name, count, below, sum(t["failed"] for t in mine)))
    grouped = sum(bool(r["grouped"]) for r in clean)
    suspect = sum(r["suspects"] > 0 for r in clean)
    print(
        f"\nFor comparison, on the same campaigns: grouped residuals (`residual_causes`) called a cause suspicious in "
        f"{share(grouped, len(clean))}, the gate named a spot in {share(suspect, len(clean))}.\n"
    )
    print("## Defects\n")
    for defect in SIZES:
        print(f"- {defect}: {MEANING[defect]}")
    print(DEFECTS_TEXT)
    for defect, sizes in SIZES.items():
        for size in sizes:
            mine = [r for r in good if r["defect"] == defect and r["size"] == size]
            if not mine:
                continue
            alarmed = [r for r in mine if not r["validation"]["passed"]]
            named = Counter(r["validation"]["cause"].split(":")[0] for r in alarmed)
            others = Counter(t["name"] for r in alarmed for t in r["validation"]["tests"] if t["failed"])
            best = "; ".join(f"{name} {n}" for name, n in named.most_common(2)) or "-"
            also = "; ".join(f"{name} {n}" for name, n in others.most_common(3) if name not in best) or "-"
            factor = f"{np.median([r['validation']['inflation'] for r in alarmed]):.1f}" if alarmed else "-"
            z = (f"{rms_z(mine, inflated):.2f}" for inflated in (False, True))
            cells = (defect, f"{size:g}", len(mine), len(alarmed), best, also, factor, *z)
            print(line(*cells, sum(bool(r["grouped"]) for r in mine)))
    bad = [r for r in rows if not ("validation" in r and r["converged"])]
    print(f"\n{len(rows)} fits, {len(bad)} not converged" + (":" if bad else "."))
    for r in bad:
        print(f"- {r['defect']} {r['size']:g}, seed {r['seed']}: {'; '.join(r['problems'])}")


if __name__ == "__main__":
    options = {"--clean": {"type": int, "default": 200, "help": "campaigns without a defect (%(default)s)"}}
    study(__file__, __doc__, one_campaign, ("defect", "size", "seed"), tasks, table, 20, options)
