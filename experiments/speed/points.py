"""How many points a minute, one by one, together and as a cloud, and how long does one `locate` take?

    python -m experiments.speed.points > experiments/speed/points.md        (6 minutes on two quiet cores)

The grid twin is fitted once (Laplace). Points lie all over its counters. Peer in the same run: a plain NumPy Monte
Carlo by the twin's own optics, one draw at a time, which is what a careful user would write first. Compilation happens
before the clocks start. `locate --cloud` runs in a process of its own, from start to end; its memory is the largest
resident set.
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import numpy as np

from experiments.common.clock import seconds, timed
from experiments.common.command_line import print_only
from experiments.common.commands import PROGRAM, measured
from experiments.common.page import heading, line
from tvsbayes.calibration.optics import GEAR_INPUTS
from tvsbayes.calibration.pointing import INPUT_NAMES, NOISE_NAMES
from tvsbayes.coordinates.location import locate, locate_linear, settings_of
from tvsbayes.coordinates.looks_file import LOOKS
from tvsbayes.files.disk import shipped_data
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.pipeline import load_calibration
from tvsbayes.twin.physics import mirror_chain, to_tvs

DRAWS, REPEATS, SINGLE = 500, 10, 2_000
SIZES, CLOUDS = (1, 10, 100, 1000, 10_000, 100_000), (1_000, 100_000, 1_000_000)


def looks(calibration, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
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
    angles = []
    for axis, side, counter in (("pan", "left", pan), ("tilt", "up", tilt)):
        play = p[f"backlash_deg.{axis}"] + gears[f"play_variation_at_deg.{axis}"]
        stop = generator.standard_normal(DRAWS) * p[f"stop_sd_deg.{side}"]
        ratio = p[f"degrees_per_step.{axis}"]
        angles.append(ratio * counter + gears[f"transmission_error_at_deg.{axis}"] - 0.5 * play + stop)
    points = []
    for k in range(DRAWS):
        # The twin's optics take one geometry at a time.
        one = {name: column[k] for name, column in p.items()}
        origin, direction = mirror_chain(*np.radians([angles[0][k], angles[1][k] + one["tilt_zero_deg"]]), one)
        origin = to_tvs(origin, one["baseline_mm"], one["pan_zero_emission_deg"])
        direction = to_tvs(direction, 0.0, one["pan_zero_emission_deg"])
        b = np.radians(reading - one["aperture_zero_deg"] - one["aperture_sd_deg"] * generator.standard_normal())
        w, c2 = origin + np.array([0.0, 0.5 * one["baseline_mm"], 0.0]), np.cos(b) ** 2
        quadratic = [direction[1] ** 2 - c2, 2 * (w[1] * direction[1] - c2 * (w @ direction)), w[1] ** 2 - c2 * (w @ w)]
        reach = [r for r in np.roots(quadratic).real if r > 0 and (w[1] + r * direction[1]) * np.cos(b) >= 0]
        points.append(origin + (min(reach) if reach else np.nan) * direction)
    return np.array(points)


def rates(calibration) -> None:
    print(heading("points | linear, s | linear, points/min | 500 draws, s | 500 draws, points/min"))
    for count in SIZES:
        pan, tilt, reading = looks(calibration, count)
        settings = settings_of(pan, tilt, reading)
        jobs = [lambda s=settings: locate_linear(calibration, s)]
        if count <= 10_000:
            jobs.append(lambda p=pan, t=tilt, b=reading: locate(calibration, p, t, b, draws=DRAWS))
        cells = []
        for job in jobs:
            job()
            taken = seconds(job, 3 if count < 5000 else 1)
            cells += [f"{taken:.4f}", f"{60 * count / taken:.3g}"]
        print(line(count, *cells, *["-"] * (4 - len(cells))), flush=True)


def beside_peer(calibration) -> None:
    setting = [float(each[0]) for each in looks(calibration, 3)]
    taken = seconds(lambda: peer(calibration, *setting), 3)
    means = np.array([peer(calibration, *setting, seed).mean(axis=0) for seed in range(REPEATS)])
    own = np.array([locate(calibration, *setting, draws=DRAWS, seed=seed).xyz_mm[0] for seed in range(REPEATS)])
    error = np.sqrt((means.var(axis=0, ddof=1) + own.var(axis=0, ddof=1)) / REPEATS)
    gap = np.max(np.abs(means.mean(axis=0) - own.mean(axis=0)) / error)
    print(f"\nPeer, NumPy one draw at a time: {60 / taken:.3g} points/min at {DRAWS} draws. Over {REPEATS} seeds the")
    print(f"means of both differ by {gap:.1f} Monte Carlo errors in the worst coordinate.\n")
    calls = {
        "ray": lambda: calibration.ray(*setting[:2]),
        "locate": lambda: calibration.locate(*setting),
        "steps_for": lambda: calibration.steps_for((700.0, 20.0, 20.0)),
    }
    for name, call in calls.items():
        times = sorted(seconds(call) for _ in range(500))
        print(f"- `load_calibration(...).{name}`: median {1e3 * times[250]:.3f} ms, 99 % {1e3 * times[495]:.3f} ms")


def clouds(calibration, campaign: Path) -> None:
    print("\n## A million points with error bars\n")
    print(heading("points | file | CPU s of the whole command | points a CPU second | peak memory, MB"))
    for count in CLOUDS:
        generator, place = np.random.default_rng(count), campaign.with_name(f"looks{count}.csv")
        with open(place, "w") as stream:
            stream.write(",".join(LOOKS.required) + "\n")
            for pan, tilt, reading in zip(*looks(calibration, count), strict=True):
                one, other = generator.integers(0, 2, 2)
                stream.write(f"{pan:.0f},{tilt:.0f},{('left', 'right')[one]},{('up', 'down')[other]},{reading:.4f}\n")
        for ending in ("ply", "csv"):
            words = ("locate", campaign, "--points", place, "--cloud", campaign.with_name(f"cloud.{ending}"))
            _, cost = measured([*PROGRAM, *words])
            rate = f"{count / cost['cpu_s']:.0f}"
            print(line(count, ending, f"{cost['cpu_s']:.1f}", rate, f"{cost['rss_mib'] * 1.048576:.0f}"), flush=True)
    settings = list(zip(*looks(calibration, SINGLE), strict=True))
    _, cost = timed(lambda: [calibration.locate(*setting) for setting in settings])
    print(f"\nOne call a point, `load_calibration(...).locate`: {SINGLE / cost['cpu_s']:.0f} points a CPU second.")


def main() -> None:
    print_only(__doc__)
    use_compilation_cache()
    print("# Speed of located points\n")
    print("Written by `python -m experiments.speed.points`; grid twin, two shared cores.\n")
    with tempfile.TemporaryDirectory() as place:
        campaign = shutil.copytree(shipped_data() / "twins" / "grid_twin", Path(place) / "campaign")
        measured([*PROGRAM, "fit", campaign, "--no-sample"])
        calibration = load_calibration(campaign)
        rates(calibration)
        beside_peer(calibration)
        print(f"- `load_calibration`: {1e3 * seconds(lambda: load_calibration(campaign)):.0f} ms")
        words = ["locate", campaign, "--pan-steps", 100, "--tilt-steps", 20, "--aperture-deg", 70, "--json"]
        taken = min(measured([*PROGRAM, *words])[1]["wall_s"] for _ in range(6))
        print(f"- `tvsbayes locate` of one point from process start, compilation cached: {taken:.2f} s")
        clouds(calibration, campaign)


if __name__ == "__main__":
    main()
