"""How many points a minute, and how long does one `locate` take from process start?

    python -m experiments.speed.locate_speed > experiments/speed/locate_speed.md        (3 minutes on two quiet cores)

The grid twin is fitted once (Laplace). Points lie all over its counters. Peer in the same run: a plain NumPy Monte
Carlo by the twin's own optics, one draw at a time, which is what a careful user would write first. Compilation happens
before the clocks start; the process-start figure includes imports, tracing and the compilation cache.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from experiments.common.clock import seconds
from experiments.common.command_line import print_only
from experiments.common.rigs import twin_campaign
from tvsbayes.assessment.fitted_calibration import calibration_of
from tvsbayes.calibration.optics import GEAR_INPUTS
from tvsbayes.calibration.pointing import INPUT_NAMES, NOISE_NAMES
from tvsbayes.coordinates.location import locate, locate_linear, settings_of
from tvsbayes.estimators.joint_fit import fit
from tvsbayes.instrument.campaign import read_campaign
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.pipeline import calibrate, load_calibration
from tvsbayes.twin.physics import mirror_chain, to_tvs

DRAWS = 500
REPEATS = 10


def points(calibration, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Counters and readings of points at 0.3 to 1 m, all over the counters of the campaign."""
    generator = np.random.default_rng(count)
    low, high = calibration.range_steps.T
    counters = np.round(low + generator.uniform(size=(count, 2)) * (high - low))
    readings = []
    for pan, tilt in counters[: min(count, 512)]:
        ray = calibration.ray(pan, tilt)
        x, y, z = ray.origin_mm + generator.uniform(300, 1000) * ray.direction
        readings.append(np.degrees(np.arctan2(np.hypot(x, z), y + 0.5 * calibration.estimates["baseline_mm"])))
    rows = np.arange(count) % len(readings)
    return counters[rows, 0], counters[rows, 1], np.array(readings)[rows]


def peer(calibration, pan: float, tilt: float, reading: float, seed: int = 0) -> np.ndarray:
    """Points (DRAWS, 3) of one setting by NumPy: the twin's optics, the cone solved as a quadratic."""
    generator = np.random.default_rng(seed)
    rows = np.linspace(0, len(calibration.inputs) - 1, DRAWS).astype(int)
    p = dict(zip(INPUT_NAMES, calibration.inputs[rows, : len(INPUT_NAMES)].T, strict=True))
    gears = dict.fromkeys(GEAR_INPUTS, 0.0)
    gears |= calibration.gears.at(calibration.inputs[rows, len(INPUT_NAMES) :], (pan, tilt))
    p |= dict(zip(NOISE_NAMES, calibration.noise[rows].T, strict=True))
    stop = generator.standard_normal((2, DRAWS))
    psi = p["degrees_per_step.pan"] * pan - 0.5 * p["backlash_deg.pan"] + stop[0] * p["stop_sd_deg.left"]
    beta = p["degrees_per_step.tilt"] * tilt - 0.5 * p["backlash_deg.tilt"] + stop[1] * p["stop_sd_deg.up"]
    psi = psi + gears["transmission_error_at_deg.pan"] - 0.5 * gears["play_variation_at_deg.pan"]
    beta = beta + gears["transmission_error_at_deg.tilt"] - 0.5 * gears["play_variation_at_deg.tilt"]
    out = []
    for k in range(DRAWS):
        # The twin's optics take one geometry at a time.
        one = {name: column[k] for name, column in p.items()}
        origin, direction = mirror_chain(np.radians(psi[k]), np.radians(beta[k] + one["tilt_zero_deg"]), one)
        origin = to_tvs(origin, one["baseline_mm"], one["pan_zero_emission_deg"])
        direction = to_tvs(direction, 0.0, one["pan_zero_emission_deg"])
        b = np.radians(reading - one["aperture_zero_deg"] - one["aperture_sd_deg"] * generator.standard_normal())
        w = origin + np.array([0.0, 0.5 * one["baseline_mm"], 0.0])
        c2 = np.cos(b) ** 2
        roots = np.roots(
            [direction[1] ** 2 - c2, 2 * (w[1] * direction[1] - c2 * (w @ direction)), w[1] ** 2 - c2 * (w @ w)]
        ).real
        good = [r for r in roots if r > 0 and (w[1] + r * direction[1]) * np.cos(b) >= 0]
        out.append(origin + (min(good) if good else np.nan) * direction)
    return np.array(out)


def main() -> None:
    """Print the page."""
    print_only(__doc__)
    use_compilation_cache()
    campaign = twin_campaign("grid_twin")
    calibration = calibration_of(fit(campaign))
    print("# Speed of located points\n")
    print("Written by `python -m experiments.speed.locate_speed`; grid twin, two shared cores.\n")
    print("| points | linear, s | linear, points/min | 500 draws, s | 500 draws, points/min |\n|---|---|---|---|---|")
    for count in (1, 10, 100, 1000, 10_000, 100_000):
        pan, tilt, reading = points(calibration, count)
        settings = settings_of(pan, tilt, reading)
        locate_linear(calibration, settings)
        linear = seconds(lambda s=settings: locate_linear(calibration, s), 3)
        cells = [f"{linear:.4f}", f"{60 * count / linear:.3g}"]
        if count <= 10_000:
            locate(calibration, pan, tilt, reading, draws=DRAWS)
            drawn = seconds(
                lambda p=pan, t=tilt, b=reading: locate(calibration, p, t, b, draws=DRAWS), 1 + (count < 5000)
            )
            cells += [f"{drawn:.3f}", f"{60 * count / drawn:.3g}"]
        else:
            cells += ["-", "-"]
        print(f"| {count} | {' | '.join(cells)} |", flush=True)
    pan, tilt, reading = points(calibration, 3)
    whole = seconds(lambda: peer(calibration, pan[0], tilt[0], reading[0]), 3)
    means = np.array([peer(calibration, pan[0], tilt[0], reading[0], seed).mean(axis=0) for seed in range(REPEATS)])
    located = [locate(calibration, pan[0], tilt[0], reading[0], draws=DRAWS, seed=seed) for seed in range(REPEATS)]
    alone = np.array([f.xyz_mm[0] for f in located])
    error = np.sqrt((means.var(axis=0, ddof=1) + alone.var(axis=0, ddof=1)) / REPEATS)
    gap = np.max(np.abs(means.mean(axis=0) - alone.mean(axis=0)) / error)
    print(f"\nPeer, NumPy one draw at a time: {60 / whole:.3g} points/min at {DRAWS} draws. Over {REPEATS} seeds the")
    print(f"means of both differ by {gap:.1f} Monte Carlo errors in the worst coordinate.\n")
    for name, call in {
        "ray": lambda: calibration.ray(pan[0], tilt[0]),
        "locate": lambda: calibration.locate(pan[0], tilt[0], reading[0]),
        "steps_for": lambda: calibration.steps_for((700.0, 20.0, 20.0)),
    }.items():
        times = sorted(seconds(call) for _ in range(500))
        print(f"- `load_calibration(...).{name}`: median {1e3 * times[250]:.3f} ms, 99 % {1e3 * times[495]:.3f} ms")
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "campaign"
        shutil.copytree(campaign.path, folder)
        calibrate(read_campaign(folder), folder / "results", sampled=False)
        print(f"- `load_calibration`: {1e3 * seconds(lambda: load_calibration(folder)):.0f} ms")
        arguments = ["locate", folder, "--pan-steps", 100, "--tilt-steps", 20, "--aperture-deg", 70, "--json"]
        command = [str(Path(sys.executable).parent / "tvsbayes"), *map(str, arguments)]
        subprocess.run(command, check=True, capture_output=True)
        whole = seconds(lambda: subprocess.run(command, check=True, capture_output=True), 5)
        print(f"- `tvsbayes locate` of one point from process start, compilation cached: {whole:.2f} s")


if __name__ == "__main__":
    main()
