"""Do the intervals hold the truth? Simulated rigs, every prior quantity drawn anew, refitted by both estimators.

    python experiments/coverage.py run --n 300 --processes 2     # 2 to 3 s per rig and core, resumable
    python experiments/coverage.py table > experiments/coverage.md

`run` draws rig i of each protocol (paper, mixed, grid) from `data/rigs/mounted` with seed i, simulates the protocol,
fits, and appends one JSON line per rig. `table` compares coverage of 50/68/90/95 % intervals with binomial bounds
and the RMS of z = (estimate - truth) / sd with chi-square bounds, both two-sided at 1e-4 for that number of rigs, and
shows that the same table with every sd times 0.8 fails. A quantity whose median contraction is below 0.1 is printed
as "prior" and not judged: its interval is the prior's own.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import time
from pathlib import Path

import numpy as np
from scipy import stats

PROTOCOLS = ("paper", "mixed", "grid")
LEVELS = (0.50, 0.68, 0.90, 0.95)
BOUND = 1e-4
SHRINK = 0.8
ROWS = Path(__file__).parent / "output" / "coverage.jsonl"
SINGLE_THREADED = {
    "NPROC": "1",
    "PJRT_NPROC": "1",
    "JAX_CPU_ENABLE_ASYNC_DISPATCH": "false",
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
}
HEADLINES = (
    "effective left",
    "effective right",
    "effective up",
    "effective down",
    "contrast pan",
    "contrast tilt",
    "backlash pan",
    "backlash tilt",
    "effective mirror offset",
)


def one_rig(task: tuple[str, int]) -> dict[str, object]:
    """Simulate and refit one rig; whatever fails is recorded as a failure, never dropped."""
    protocol, seed = task
    # One core each; `run` has set one thread for XLA and BLAS, whose waiting threads would take each other's time.
    cores = sorted(os.sched_getaffinity(0))
    if len(cores) > 1:
        os.sched_setaffinity(0, {cores[os.getpid() % len(cores)]})
    from tvsbayes.estimators import campaign_arrays

    # Ordinary fits pad to 512 spots so that campaigns share a compilation; here every campaign is alike.
    campaign_arrays.SMALLEST_BUCKET = 96
    from tvsbayes.estimators.campaign_arrays import use_compilation_cache
    from tvsbayes.estimators.four_point import classic
    from tvsbayes.estimators.joint_fit import fit
    from tvsbayes.files.disk import shipped_data
    from tvsbayes.instrument.plan import read_plan
    from tvsbayes.instrument.rig import read_rig
    from tvsbayes.twin.physics import effective_deg_per_step, effective_mirror_offset_mm
    from tvsbayes.twin.simulated_campaign import simulate

    use_compilation_cache()
    folder = shipped_data() / "rigs" / "mounted"
    rig, plan = read_rig(folder / "rig.toml"), read_plan(folder / f"{protocol}.csv")
    simulated = simulate(rig, plan, seed, aperture=protocol == "grid")
    truth = simulated.truth.parameters
    row: dict[str, object] = {"protocol": protocol, "seed": seed}
    row["unseen"] = sum(s.status != "ok" for s in simulated.campaign.spots)
    start = time.perf_counter()
    try:
        result = fit(simulated.campaign)
    except Exception as error:
        return {**row, "converged": False, "problems": [repr(error)]}
    row["seconds"] = time.perf_counter() - start
    row["converged"], row["problems"] = result.converged, list(result.problems)
    pose = tuple(np.degrees(result.reference_pose_rad))
    true_ratio = effective_deg_per_step(truth, pose)
    values = {}

    def judge(name, true, of):
        draws, mode, prior = of(result.draws), float(of(result.mode)), of(result.prior_draws)
        shrunk = mode + SHRINK * (draws - mode)
        values[name] = {
            "pit": float(np.mean(draws < true)),
            "pit_shrunk": float(np.mean(shrunk < true)),
            "z": float((mode - true) / draws.std()),
            "contraction": float(1 - draws.var() / prior.var()),
        }

    from tvsbayes.instrument.parameters import INDEX

    for k, direction in enumerate(("left", "right", "up", "down")):
        judge(f"effective {direction}", true_ratio[direction], lambda d, k=k: d.effective_deg_per_step[..., k])
    for axis, k, (plus, minus) in (("pan", 0, ("left", "right")), ("tilt", 2, ("up", "down"))):
        judge(
            f"contrast {axis}",
            true_ratio[plus] - true_ratio[minus],
            lambda d, k=k: d.effective_deg_per_step[..., k] - d.effective_deg_per_step[..., k + 1],
        )
        name = f"backlash_deg.{axis}"
        judge(f"backlash {axis}", truth[name], lambda d, i=INDEX[name]: d.physical[..., i])
    judge(
        "effective mirror offset",
        effective_mirror_offset_mm(truth, pose),
        lambda d: d.effective_mirror_offset_mm,
    )
    row["joint"] = values
    if protocol != "grid":
        row["classic"] = {
            direction: {
                "true": true_ratio[direction],
                "mean": r.mean_deg_per_step,
                "type_a": r.interval95_type_a,
                "gum": r.interval95_gum,
            }
            for direction, r in classic(simulated.campaign).directions.items()
            if r is not None
        }
    return row


def run(arguments: argparse.Namespace) -> None:
    """Append rows until every (protocol, seed) is there."""
    arguments.rows.parent.mkdir(parents=True, exist_ok=True)
    done = {(r["protocol"], r["seed"]) for r in read_rows(arguments.rows)}
    # Read by XLA and OpenBLAS when a worker starts.
    os.environ.update(SINGLE_THREADED)
    # Seeds in the outer loop: an interrupted run leaves balanced protocols.
    tasks = [(p, s) for s in range(arguments.n) for p in arguments.protocols if (p, s) not in done]
    with (
        multiprocessing.get_context("spawn").Pool(arguments.processes) as pool,
        arguments.rows.open("a") as file,
    ):
        for row in pool.imap_unordered(one_rig, tasks):
            file.write(json.dumps(row) + "\n")
            file.flush()


def read_rows(path: Path) -> list[dict]:
    """All complete rows; a torn last line is ignored."""
    if not path.exists():
        return []
    rows = []
    for line in path.read_text().splitlines():
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return rows


def bounds(n: int, level: float) -> tuple[float, float]:
    """Coverage that a true interval misses with probability `BOUND`, two-sided."""
    return stats.binom.ppf(BOUND / 2, n, level) / n, stats.binom.isf(BOUND / 2, n, level) / n


def verdict(pit: np.ndarray, z: np.ndarray) -> tuple[list[str], bool]:
    """Cells of a table row, and whether all of them lie within bounds."""
    n, cells, good = len(pit), [], True
    low, high = np.sqrt(stats.chi2.ppf([BOUND / 2, 1 - BOUND / 2], n) / n)
    rms = float(np.sqrt(np.mean(z**2)))
    inside = low <= rms <= high
    cells.append(f"{rms:.2f}" + ("" if inside else " **!**"))
    good &= bool(inside)
    for level in LEVELS:
        share = float(np.mean(np.abs(pit - 0.5) < level / 2))
        lo, hi = bounds(n, level)
        inside = lo <= share <= hi
        good &= inside
        cells.append(f"{100 * share:.1f}" + ("" if inside else " **!**"))
    return cells, good


def table(arguments: argparse.Namespace) -> None:
    """Markdown tables of everything that came out."""
    rows = read_rows(arguments.rows)
    print("# Coverage of the joint and the classic estimator\n")
    print("Written by `python experiments/coverage.py table`; **!** marks a figure outside its bounds at 1e-4.\n")
    for protocol in PROTOCOLS:
        chosen = [r for r in rows if r["protocol"] == protocol]
        if not chosen:
            continue
        good = [r for r in chosen if r["converged"]]
        seconds = np.median([r["seconds"] for r in good])
        print(f"## {protocol}: {len(chosen)} rigs, {len(good)} converged ({100 * len(good) / len(chosen):.1f} %)\n")
        print(f"{sum(r['unseen'] > 0 for r in chosen)} rigs lost a spot out of view; median fit {seconds:.1f} s.\n")
        n = len(good)
        limits = [bounds(n, level) for level in LEVELS]
        low, high = np.sqrt(stats.chi2.ppf([BOUND / 2, 1 - BOUND / 2], n) / n)
        columns = " | ".join(f"{100 * level:.0f} %" for level in LEVELS)
        print(f"| quantity | contraction | RMS z | {columns} | verdict | with sd x {SHRINK} |")
        print("|" + "---|" * (len(LEVELS) + 5))
        cells = " | ".join(f"{100 * a:.0f}-{100 * b:.0f}" for a, b in limits)
        print(f"| bounds at 1e-4 | | {low:.2f}-{high:.2f} | {cells} | | |")
        for name in HEADLINES:
            entries = [r["joint"][name] for r in good]
            contraction = float(np.median([e["contraction"] for e in entries]))
            z = np.array([e["z"] for e in entries])
            shown, within = verdict(np.array([e["pit"] for e in entries]), z)
            _, shrunk = verdict(np.array([e["pit_shrunk"] for e in entries]), z / SHRINK)
            judged = "prior" if contraction < 0.1 else ("within" if within else "OUTSIDE")
            failed = "prior" if contraction < 0.1 else ("passes" if shrunk else "fails")
            print(f"| {name} | {contraction:.4f} | {' | '.join(shown)} | {judged} | {failed} |")
        print()
        with_classic = [r["classic"] for r in chosen if "classic" in r]
        if with_classic:
            print(
                "| classic, 95 % interval | type A holds truth | GUM holds truth | median error, % |\n|---|---|---|---|"
            )
            for direction in ("left", "right", "up", "down"):
                e = [c[direction] for c in with_classic if direction in c]
                type_a = np.mean([x["type_a"][0] <= x["true"] <= x["type_a"][1] for x in e])
                gum = np.mean([x["gum"][0] <= x["true"] <= x["gum"][1] for x in e])
                error = np.median([x["mean"] / x["true"] - 1 for x in e])
                print(f"| {direction} | {100 * type_a:.1f} % | {100 * gum:.1f} % | {100 * error:+.2f} |")
            print()
    failures = [r for r in rows if not r["converged"]]
    if failures:
        print("## Not converged\n")
        for r in failures:
            print(f"- {r['protocol']} seed {r['seed']}: {'; '.join(r['problems'])}")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=("run", "table"))
    parser.add_argument("--n", type=int, default=300)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--protocols", nargs="+", default=PROTOCOLS, choices=PROTOCOLS)
    parser.add_argument("--rows", type=Path, default=ROWS)
    arguments = parser.parse_args()
    (run if arguments.action == "run" else table)(arguments)


if __name__ == "__main__":
    main()
