"""Do the 95 % regions of located points hold the true points? 1 000 rigs with aperture readings, by the twin's optics.

    python -m experiments.millimetres.located_points run --n 1000 --cores 0 1        # 4 s per rig and core, resumable
    python -m experiments.millimetres.located_points table > experiments/millimetres/located_points.md

Rig i is drawn from the priors of `data/rigs/mounted` with seed i: gears, mirrors, extrinsics, cameras, baseline, C0,
and aperture zero. It runs the mixed protocol with aperture readings and is fitted (Laplace). Then the
machine is homed and sent to random counters, from random sides, once within the counters of the campaign and once up to
half their span outside; the beam, with a stop error of its own, meets a target at 0.25 to 1.2 m, and the aperture reads
it. `locate` is given counters, sides and reading. Counted are the 95 % intervals of x, y and z and the ellipsoid
d^T S^-1 d <= 7.815 (chi-square, 3). Beside it: the error of the nominal and of the classic calibration with a fair
baseline and origin. Within one rig all points share its calibration error, so that their coverage scatters from rig
to rig: 20 more points per rig show that, apart.
"""

from __future__ import annotations

import time

import numpy as np

from experiments.common.against_truth import marked
from experiments.common.command_line import study
from experiments.common.page import heading, line
from experiments.common.rigs import mounted_rig, shipped_plan
from experiments.common.true_looks import ELLIPSOID, ESTIMATORS, looks_around, or_none, squared_distance
from tvsbayes.assessment.fitted_calibration import calibration_of
from tvsbayes.coordinates.location import locate
from tvsbayes.estimators.joint_fit import fit
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.statistics.chances import BOUND, binomial_bounds
from tvsbayes.twin.simulated_campaign import simulate

PROTOCOL = "mixed"
WITHIN = 20
KINDS = "inside", "outside"


def one_rig(task: tuple[int]) -> dict[str, object]:
    """Simulate, fit, look at points, locate them."""
    (seed,) = task
    use_compilation_cache()
    start = time.perf_counter()
    simulated = simulate(mounted_rig(), shipped_plan(PROTOCOL), seed, aperture=True)
    row: dict[str, object] = {"seed": seed, "converged": False}
    try:
        result = fit(simulated.campaign)
        row["converged"] = bool(result.converged)
        calibration = calibration_of(result, seed=seed)
    except Exception as error:
        return {**row, "problem": repr(error)}
    # A look inside the counters of the campaign, one outside, and more inside.
    outside = [k == 1 for k in range(2 + WITHIN)]
    looks = looks_around(simulated, calibration.range_steps, outside, seed)
    counters, points = looks.counters_steps, looks.points_mm
    located = locate(calibration, counters[:, 0], counters[:, 1], looks.readings, looks.sides, seed=seed)
    error = located.xyz_mm - points
    hit = np.abs(points - located.interval95_mm.mean(axis=1)) <= located.u95_mm
    # Points that were refused have no error and no covariance: they lie in no ellipsoid.
    good = np.array([refused is None for refused in located.refused])
    distance2 = squared_distance(error, located.covariance_mm2, good, np.inf)
    z = error / np.sqrt(np.einsum("pii->pi", located.covariance_mm2))
    errors = {"joint": error, **looks.errors_of_others_mm(simulated.campaign)}
    for k, kind in enumerate(KINDS):
        distances = or_none(np.array([np.linalg.norm(e[k]) for e in errors.values()]))
        row[kind] = {
            "refused": located.refused[k] is not None,
            "hit": hit[k].tolist(),
            "z": or_none(z[k]),
            "ellipsoid": bool(distance2[k] <= ELLIPSOID),
            "validated": bool(located.validation.validated[k].all()),
            "u95_mm": or_none(located.u95_mm[k]),
            "error_mm": dict(zip(errors, distances, strict=True)),
        }
    usable = [k for k in range(2, 2 + WITHIN) if located.refused[k] is None]
    row["within"] = {
        "points": len(usable),
        "hits": hit[usable].sum(axis=0).tolist(),
        "ellipsoid": int(np.sum(distance2[usable] <= ELLIPSOID)),
    }
    return {**row, "seconds": time.perf_counter() - start}


def table(rows: list[dict]) -> None:
    good = [r for r in rows if r["converged"]]
    print("# Coverage of located points\n")
    print("Written by `python -m experiments.millimetres.located_points table`; what was done stands in the script.\n")
    print(f"{len(good)} of {len(rows)} rigs converged", end="")
    lost = [str(r["seed"]) for r in rows if not r["converged"]]
    print(f" (left out: seeds {', '.join(lost)})." if lost else ".")
    print(f"Bounds are two-sided at {BOUND:g} for the number of rigs; **!** marks a figure outside them.\n")
    print(heading("counters | rigs | refused | x | y | z | ellipsoid | RMS z x, y, z | law validated at 2 digits"))
    for kind in KINDS:
        chosen = [r[kind] for r in good if not r[kind]["refused"]]
        n = len(chosen)
        low, high = binomial_bounds(n, 0.95)
        shares = [*np.mean([c["hit"] for c in chosen], axis=0), np.mean([c["ellipsoid"] for c in chosen])]
        cells = [marked(f"{100 * s:.1f}", low <= s <= high) for s in shares]
        rms = np.sqrt(np.mean(np.square([c["z"] for c in chosen]), axis=0))
        cells += [" ".join(f"{v:.2f}" for v in rms), f"{100 * np.mean([c['validated'] for c in chosen]):.0f} %"]
        print(f"| {kind} | {n} | {len(good) - n} | {' | '.join(cells)} |")
    low, high = binomial_bounds(len(good), 0.95)
    print(f"\n95 % bounds for {len(good)} rigs: {100 * low:.1f} to {100 * high:.1f}.\n")
    print("## Distance from the true point, mm\n")
    print("| counters | calibration | median | RMS | 95 % | largest |\n|---|---|---|---|---|---|")
    for kind in KINDS:
        for name in ESTIMATORS:
            values = [r[kind]["error_mm"][name] for r in good]
            missing = sum(v is None for v in values)
            e = np.array([v for v in values if v is not None])
            note = f" ({missing} without a point)" if missing else ""
            figures = (f"{value:.1f}" for value in (np.median(e), np.sqrt(np.mean(e**2)), np.quantile(e, 0.95)))
            print(line(kind, name + note, *figures, f"{e.max():.0f}"))
    print("\n## Within one rig\n")
    share = np.array([r["within"]["ellipsoid"] / r["within"]["points"] for r in good if r["within"]["points"]])
    axes = np.array([np.array(r["within"]["hits"]) / r["within"]["points"] for r in good if r["within"]["points"]])
    print(f"{WITHIN} points inside per rig, same calibration: the ellipsoids hold {100 * share.mean():.1f} % of them,")
    held = ", ".join(f"{100 * v:.1f}" for v in axes.mean(axis=0))
    print(f"the intervals {held} % (x, y, z). Rig by rig, an ellipsoid holds at worst {100 * share.min():.0f} % of its")
    low, middle = 100 * np.quantile(share, (0.05, 0.5))
    print(f"points, less than {low:.0f} % in one rig of twenty, less than {middle:.0f} % in one of two.\n")
    seconds = [r["seconds"] for r in good]
    print(f"{sum(seconds) / 60:.0f} core minutes, median {np.median(seconds):.1f} s a rig.")


if __name__ == "__main__":
    study(__file__, __doc__, one_rig, ("seed",), [()], table, 1000)
