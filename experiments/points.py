"""Do the 95 % regions of located points hold the true points? 1 000 rigs with aperture readings, by the twin's optics.

    python experiments/points.py run --n 1000 --cores 0 1        # 4 s per rig and core, resumable
    python experiments/points.py table > experiments/points.md

Rig i is drawn from the priors of `data/rigs/mounted` with seed i: gears, mirrors, extrinsics, cameras, baseline, C0,
aperture zero, everything anew. It runs the mixed protocol with aperture readings and is fitted (Laplace). Then the
machine is homed and sent to random counters, from random sides, once within the counters of the campaign and once up to
half their span outside; the beam, with a stop error of its own, meets a target at 0.25 to 1.2 m, and the aperture reads
it. `locate` is given counters, sides and reading. Counted are the 95 % intervals of x, y and z and the ellipsoid
d^T S^-1 d <= 7.815 (chi-square, 3). Beside it: the error of the nominal and of the classic calibration with a fair
baseline and origin. Within one rig all points share its calibration error, so that their coverage scatters from rig
to rig: 20 more points per rig show that, apart.
"""

from __future__ import annotations

import argparse
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
from coverage import BOUND, bounds, read_rows
from scipy import stats
from studies import mounted_rig, run_rows, shipped_plan

ROWS = Path(__file__).parent / "output" / "points.jsonl"
PROTOCOL = "mixed"
RANGE_MM = 250.0, 1200.0
WITHIN = 20
ELLIPSOID = stats.chi2.isf(0.05, 3)
KINDS = "inside", "outside"


def true_look(truth, table, steps, sides, range_mm, generator):
    """True point (3,) of frame T and aperture reading of one look after homing, by the twin's optics."""
    from tvsbayes.twin.physics import aperture_angle_deg, mirror_chain, to_tvs

    p = truth.parameters
    angles = []
    for k, (axis, names) in enumerate((("pan", ("right", "left")), ("tilt", ("down", "up")))):
        rest = p[f"degrees_per_step.{axis}"] * steps[k] - 0.5 * sides[k] * p[f"backlash_deg.{axis}"]
        angles.append(rest + generator.standard_normal() * p[f"stop_sd_deg.{names[int(sides[k] > 0)]}"])
    origin, direction = mirror_chain(np.radians(angles[0]), np.radians(angles[1] + p["tilt_zero_deg"]), p)
    point = to_tvs(origin + range_mm * direction, p["baseline_mm"], p["pan_zero_emission_deg"])
    angle = aperture_angle_deg(point, p["baseline_mm"], table.aperture_convention)
    return point, float(angle + p["aperture_zero_deg"] + p["aperture_sd_deg"] * generator.standard_normal())


def one_rig(task: tuple[int]) -> dict[str, object]:
    """Simulate, fit, look at points, locate them."""
    (seed,) = task
    from tvsbayes.estimators import campaign_arrays

    # As in coverage.py: ordinary fits pad to 512 spots, here every campaign is alike.
    campaign_arrays.SMALLEST_BUCKET = 96
    from tvsbayes.assessment.fitted_calibration import calibration_of
    from tvsbayes.coordinates.location import locate
    from tvsbayes.estimators.campaign_arrays import use_compilation_cache
    from tvsbayes.estimators.joint_fit import fit
    from tvsbayes.twin.simulated_campaign import simulate

    use_compilation_cache()
    start = time.perf_counter()
    rig = mounted_rig()
    simulated = simulate(rig, shipped_plan(PROTOCOL), seed, aperture=True)
    row: dict[str, object] = {"seed": seed, "converged": False}
    try:
        result = fit(simulated.campaign)
        row["converged"] = bool(result.converged)
        calibration = calibration_of(result, seed=seed)
    except Exception as error:
        return {**row, "problem": repr(error)}
    generator = np.random.default_rng([seed, 7])
    low, high = calibration.range_steps.T
    span = high - low
    counters, sides, points, readings = [], [], [], []
    for k in range(2 + WITHIN):
        place = generator.uniform(0, 1, 2)
        if k == 1:
            # Beyond one end or the other of both axes.
            place = np.where(generator.uniform(size=2) < 0.5, -0.5 * place, 1 + 0.5 * place)
        steps = np.round(low + place * span)
        side = generator.choice([-1, 1], 2)
        point, reading = true_look(simulated.truth, rig.table, steps, side, generator.uniform(*RANGE_MM), generator)
        counters.append(steps)
        sides.append((("right", "left")[int(side[0] > 0)], ("down", "up")[int(side[1] > 0)]))
        points.append(point)
        readings.append(reading)
    counters, points = np.array(counters), np.array(points)
    found = locate(calibration, counters[:, 0], counters[:, 1], readings, sides, seed=seed)
    error = found.xyz_mm - points
    hit = np.abs(points - found.interval95_mm.mean(axis=1)) <= found.u95_mm
    # Points that were refused have no error and no covariance: they lie in no ellipsoid.
    distance2 = np.full(len(error), np.inf)
    good = np.array([refused is None for refused in found.refused])
    distance2[good] = np.einsum("pi,pij,pj->p", error[good], np.linalg.inv(found.covariance_mm2[good]), error[good])
    z = error / np.sqrt(np.einsum("pii->pi", found.covariance_mm2))
    others = others_error(simulated.campaign, counters, readings, points)
    for k, kind in enumerate(KINDS):
        row[kind] = {
            "refused": found.refused[k] is not None,
            "hit": hit[k].tolist(),
            "z": [None if np.isnan(v) else float(v) for v in z[k]],
            "ellipsoid": bool(distance2[k] <= ELLIPSOID),
            "validated": bool(found.validation.validated[k].all()),
            "u95_mm": [None if np.isnan(v) else float(v) for v in found.u95_mm[k]],
            "error_mm": {name: float(np.linalg.norm(e[k])) for name, e in {"joint": error, **others}.items()},
        }
        row[kind]["error_mm"] = {n: None if np.isnan(v) else v for n, v in row[kind]["error_mm"].items()}
    usable = [k for k in range(2, 2 + WITHIN) if found.refused[k] is None]
    row["within"] = {
        "points": len(usable),
        "hits": hit[usable].sum(axis=0).tolist(),
        "ellipsoid": int(np.sum(distance2[usable] <= ELLIPSOID)),
    }
    return {**row, "seconds": time.perf_counter() - start}


def others_error(campaign, counters, readings, points) -> dict[str, np.ndarray]:
    """Errors (points, 3) of the nominal and the classic calibration, mm; no numbers without complete experiments."""
    import jax
    import jax.numpy as jnp

    from tvsbayes.coordinates.beam_meeting import meeting
    from tvsbayes.coordinates.error_map import simple_calibration, simple_rays
    from tvsbayes.errors import NothingToEstimate
    from tvsbayes.estimators.four_point import classic

    estimates, result = {"nominal": None}, {"classic": np.full_like(points, np.nan)}
    with suppress(NothingToEstimate):
        estimates["classic"] = classic(campaign)
    for name, estimate in estimates.items():
        simple = simple_calibration(campaign.rig.priors, estimate)
        with jax.enable_x64(True):
            rays = simple_rays(simple, counters)
            base = jnp.asarray(2 * (simple.baseline_mm - simple.origin_y_mm))
            azimuth = jnp.asarray(campaign.rig.aperture_convention == "azimuth")
            met = meeting(rays.origin_mm, rays.direction, base, jnp.radians(jnp.asarray(readings)), azimuth)
        result[name] = np.where(np.asarray(met.meets)[:, None], np.asarray(met.xyz_mm).T, np.nan) - points
    return result


def table() -> None:
    """The study's page."""
    rows = read_rows(ROWS)
    good = [r for r in rows if r["converged"]]
    print("# Coverage of located points\n")
    print("Written by `python experiments/points.py table` after `run`; what was done stands in the script.\n")
    print(f"{len(good)} of {len(rows)} rigs converged", end="")
    lost = [str(r["seed"]) for r in rows if not r["converged"]]
    print(f" (left out: seeds {', '.join(lost)})." if lost else ".")
    print(f"Bounds are two-sided at {BOUND:g} for the number of rigs; **!** marks a figure outside them.\n")
    print("| counters | rigs | refused | x | y | z | ellipsoid | RMS z x, y, z | law validated at 2 digits |")
    print("|---|---|---|---|---|---|---|---|---|")
    for kind in KINDS:
        chosen = [r[kind] for r in good if not r[kind]["refused"]]
        n = len(chosen)
        low, high = bounds(n, 0.95)
        shares = [*np.mean([c["hit"] for c in chosen], axis=0), np.mean([c["ellipsoid"] for c in chosen])]
        cells = [f"{100 * s:.1f}{'' if low <= s <= high else ' **!**'}" for s in shares]
        rms = np.sqrt(np.mean(np.square([c["z"] for c in chosen]), axis=0))
        cells += [" ".join(f"{v:.2f}" for v in rms), f"{100 * np.mean([c['validated'] for c in chosen]):.0f} %"]
        print(f"| {kind} | {n} | {len(good) - n} | {' | '.join(cells)} |")
    low, high = bounds(len(good), 0.95)
    print(f"\n95 % bounds for {len(good)} rigs: {100 * low:.1f} to {100 * high:.1f}.\n")
    print("## Distance from the true point, mm\n")
    print("| counters | calibration | median | RMS | 95 % | largest |\n|---|---|---|---|---|---|")
    for kind in KINDS:
        for name in ("nominal", "classic", "joint"):
            values = [r[kind]["error_mm"][name] for r in good]
            missing = sum(v is None for v in values)
            e = np.array([v for v in values if v is not None])
            note = f" ({missing} without a point)" if missing else ""
            quantiles = (
                f"{np.median(e):.1f} | {np.sqrt(np.mean(e**2)):.1f} | {np.quantile(e, 0.95):.1f} | {e.max():.0f}"
            )
            print(f"| {kind} | {name}{note} | {quantiles} |")
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


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=("run", "table"))
    parser.add_argument("--n", type=int, default=1000)
    parser.add_argument("--cores", type=int, nargs="+", default=[0])
    arguments = parser.parse_args()
    if arguments.action == "run":
        run_rows(one_rig, [(seed,) for seed in range(arguments.n)], ROWS, ("seed",), arguments.cores)
    else:
        table()


if __name__ == "__main__":
    main()
