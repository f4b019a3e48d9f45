"""What a calibration is worth in millimetres at 0.3, 1, 2 and 5 m: nominal, classic and joint against the truth.

    python -m experiments.millimetres.ranges run --n 20 --cores 0         # 4 minutes, resumable
    python -m experiments.millimetres.ranges table > experiments/millimetres/ranges.md

The shipped twins, whose truth is known, and drawn rigs (`data/rigs/mounted`, seed i), each under the mixed steps with
aperture readings and under the paper's protocol without. After the campaign the machine is homed and sent to 5 x 5
counters within the campaign's, from random sides; the true beam with a stop error of its own meets a target at each
range along it, the aperture reads it, and every calibration locates the point. Nominal and classic are the fair
comparators of formulation 5 (`tvsbayes.coordinates.simple_calibration`). Error: distance from the true point;
stated: the root of the trace of the joint's covariance (Laplace, law of propagation), and its 95 % intervals for x, y,
z and ellipsoid. Coverage over 1000 rigs stands in located_points.md.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from experiments.common.command_line import by_seed, study
from experiments.common.page import heading
from experiments.common.rigs import TWINS, mounted_rig, shipped_plan, shipped_twin
from experiments.common.true_looks import ELLIPSOID, ESTIMATORS, TrueLooks, or_none, squared_distance
from tvsbayes.assessment.fitted_calibration import calibration_of
from tvsbayes.coordinates.location import locate_linear, settings_of
from tvsbayes.estimators.joint_fit import fit
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.statistics.chances import binomial_bounds
from tvsbayes.twin.simulated_campaign import simulate

RANGES_MM = 300.0, 1000.0, 2000.0, 5000.0
PROTOCOLS = ("paper", "mixed")
CELLS = 5


def one_row(task: tuple[str, int]) -> dict[str, object]:
    """Fit a shipped twin (seed -1) or a drawn rig's campaign; errors at all counters and ranges."""
    use_compilation_cache()
    name, seed = task
    start = time.process_time()
    if name in TWINS:
        simulated = shipped_twin(name)
    else:
        simulated = simulate(mounted_rig(), shipped_plan(name), seed, aperture=name == "mixed")
    row: dict[str, object] = {"name": name, "seed": seed, "converged": False}
    try:
        result = fit(simulated.campaign)
        calibration = calibration_of(result, seed=max(seed, 0))
    except Exception as error:
        return {**row, "problem": repr(error)}
    row["converged"] = bool(result.converged)
    generator = np.random.default_rng([seed + 1, 9])
    looks = TrueLooks(simulated.truth, simulated.campaign.rig.aperture_convention, generator)
    pans, tilts = (np.linspace(*ends, CELLS).round() for ends in calibration.range_steps)
    for pan in pans:
        for tilt in tilts:
            for reach in RANGES_MM:
                looks.add((pan, tilt), reach)
    counters = looks.counters_steps
    law = locate_linear(calibration, settings_of(counters[:, 0], counters[:, 1], looks.readings, looks.sides))
    xyz, covariance = law.value, law.covariance
    error = {"joint": xyz - looks.points_mm, **looks.errors_of_others_mm(simulated.campaign)}
    sd = np.sqrt(np.einsum("pii->pi", covariance))
    usable = np.isfinite(xyz).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
    far = squared_distance(error["joint"], covariance, usable, np.nan)

    def by_range(values):
        return [or_none(values[k :: len(RANGES_MM)]) for k in range(len(RANGES_MM))]

    row["error_mm"] = {n: by_range(np.linalg.norm(e, axis=1)) for n, e in error.items()}
    row["stated_mm"] = by_range(np.where(usable, np.sqrt(np.einsum("pii->p", covariance)), np.nan))
    row["inside"] = by_range(np.where(usable, (np.abs(error["joint"]) <= 1.96 * sd).mean(axis=1), np.nan))
    row["ellipsoid"] = by_range(np.where(usable, far <= ELLIPSOID, np.nan))
    return {**row, "cpu_s": time.process_time() - start}


def _flat(rows, field: str, k: int, name: str | None = None) -> np.ndarray:
    """Values of a field at a range over all rows, not a number where there is no point."""
    parts = [(r[field] if name is None else r[field][name])[k] for r in rows]
    return np.array([np.nan if v is None else v for part in parts for v in part])


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def twins_table(good: Sequence[dict]) -> None:
    """Errors of the shipped twins."""
    print("## The shipped twins\n")
    print("RMS over 25 poses; one rig each: a calibration's error is common to all its points.\n")
    print(heading("twin | range, m | nominal | classic | joint | joint, stated | inside 95 %: x, y, z | ellipsoid"))
    for twin in TWINS:
        chosen = [r for r in good if r["name"] == twin]
        for k, reach in enumerate(RANGES_MM if chosen else ()):
            cells = []
            for errors in (_flat(chosen, "error_mm", k, n) for n in ESTIMATORS):
                missing = int(np.isnan(errors).sum())
                without = f" ({missing} without)" if missing else ""
                cells.append("-" if missing == len(errors) else f"{_rms(errors):.1f}{without}")
            held, within = np.nanmean(_flat(chosen, "inside", k)), np.nanmean(_flat(chosen, "ellipsoid", k))
            stated = _rms(_flat(chosen, "stated_mm", k))
            name = twin.replace("_", " ")
            print(f"| {name} | {reach / 1000:g} | {' | '.join(cells)} | {stated:.1f} ", end="")
            print(f"| {100 * held:.0f} % | {100 * within:.0f} % |")
    print("\nThe grid holds no four-point experiment: a classic user keeps the nominal ratios there.")


def drawn_table(protocol: str, every: Sequence[dict]) -> None:
    """Errors of the drawn rigs of a protocol."""
    chosen = [r for r in every if r["converged"]]
    if not chosen:
        return
    what = "the paper's protocol" if protocol == "paper" else "mixed steps with aperture readings"
    print(f"\n## Drawn rigs, {what}: {len(every)}, {len(chosen)} converged\n")
    print("Median over the rigs of each rig's RMS over its 25 poses (least to largest rig). Intervals: one pose of")
    print("each rig (the middle), since the poses of one rig share its error.\n")
    print(heading("range, m | nominal | classic | joint | joint, stated | classic / joint | middle pose held"))
    low, high = binomial_bounds(len(chosen), 0.95)
    for k, reach in enumerate(RANGES_MM):
        per_rig = {n: np.array([_rms(_flat([r], "error_mm", k, n)) for r in chosen]) for n in ESTIMATORS}
        cells = [f"{np.median(v):.1f} ({v.min():.1f} to {v.max():.1f})" for v in per_rig.values()]
        stated = np.median([_rms(_flat([r], "stated_mm", k)) for r in chosen])
        times = np.median(per_rig["classic"] / per_rig["joint"])
        middle = [r["ellipsoid"][k][CELLS**2 // 2] for r in chosen]
        n = len(middle)
        held = f"{sum(bool(m) for m in middle)} of {n} (bounds {low * n:.0f} to {high * n:.0f})"
        print(f"| {reach / 1000:g} | {' | '.join(cells)} | {stated:.1f} | {times:.1f} | {held} |")


def table(rows: list[dict]) -> None:
    good = [r for r in rows if r["converged"]]
    print("# Millimetres: nominal, classic and joint against the truth\n")
    print("Written by `python -m experiments.millimetres.ranges table`;", end=" ")
    print("mm of 3D distance; what was done stands there.\n")
    twins_table(good)
    for protocol in PROTOCOLS:
        drawn_table(protocol, [r for r in rows if r["name"] == protocol])


if __name__ == "__main__":
    twins = [(twin, -1) for twin in TWINS]
    study(__file__, __doc__, one_row, ("name", "seed"), lambda of: twins + by_seed(PROTOCOLS, of.n), table, 20)
