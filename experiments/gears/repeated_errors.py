"""Gears that repeat their errors: do intervals hold, of headlines and of points, and what do perfect gears say?

    python -m experiments.gears.repeated_errors run --n 40 --cores 0 1      # 6 to 15 CPU s a rig, resumable
    python -m experiments.gears.repeated_errors table > experiments/gears/repeated_errors.md

Rig s of a protocol ("planned" is what `tvsbayes plan` writes for it) is drawn from `data/rigs/mounted` with seed s:
geometry, cameras, and a transmission error, a varying play and a drift by the default priors ("priors"), or in a world
that no prior holds (`experiments.common.worlds`). It is fitted as the package does, with tier 1 (at most `ROUNDS`
rounds; accepted by Pareto k alone); seeds below `BESIDE` with perfect gears too, the model without repeating errors.
`WITHIN` looks inside the counters seen and as many outside them (up to half the range beyond) are located, stop errors
and play of the true gears in them. RMS z and coverage of 95 % intervals, each model's on the rigs where it is accepted;
**!** marks a figure outside its two-sided bounds at 1e-4. With errors by the priors everything has to lie within; in
other worlds an RMS z of 1.3 is what is aimed at.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from experiments.common.command_line import study
from experiments.common.headlines import HEADLINES, JUDGED, judged, limits, verdict
from experiments.common.page import heading, line
from experiments.common.rigs import mounted_rig, shipped_plan
from experiments.common.true_looks import TrueLooks, looks_around
from experiments.common.worlds import campaign_of
from tvsbayes.assessment.fitted_calibration import calibration_of
from tvsbayes.assessment.weaknesses import moved_directions, weak_directions
from tvsbayes.coordinates.location import locate
from tvsbayes.estimators.joint_fit import fit
from tvsbayes.inference import importance
from tvsbayes.inference.importance import K_MAX
from tvsbayes.instrument.model_choice import ModelChoice
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.posterior.sampling import sample
from tvsbayes.twin.simulated_campaign import SimulatedCampaign, simulate

PROTOCOLS = ("paper", "mixed", "grid", "planned")
WORLDS = (("pinion", 0.05), ("pinion", 0.1), ("pinion", 0.2), ("tooth", 0.05), ("step", 0.1), ("warm-up", 0.1))
ROUNDS = 8
WITHIN = 8
OUTSIDE = [False] * WITHIN + [True] * WITHIN
PLACES = "inside", "outside"
MODELS = {"repeating": ModelChoice(), "perfect": ModelChoice(perfect_gears=True)}
BESIDE = 60


def simulated_in(world: str, size_deg: float, protocol: str, seed: int) -> SimulatedCampaign:
    """A campaign on a rig drawn by the priors, or in another world."""
    rig, plan = mounted_rig(), shipped_plan(protocol)
    if world == "priors":
        return simulate(rig, plan, seed, aperture=True)
    return campaign_of(rig, plan, world, size_deg, seed)


def located(calibration, looks: TrueLooks, seed: int) -> dict[str, object]:
    """Errors of located points in their sds, and how many coordinates lie in their 95 % intervals."""
    counters = looks.counters_steps
    points = locate(calibration, counters[:, 0], counters[:, 1], looks.readings, looks.sides, seed=seed)
    z = (points.xyz_mm - looks.points_mm) / np.sqrt(np.einsum("pii->pi", points.covariance_mm2))
    held = np.abs(looks.points_mm - points.interval95_mm.mean(axis=1)) <= points.u95_mm
    result = {}
    for k, place in enumerate(PLACES):
        part = slice(k * WITHIN, (k + 1) * WITHIN)
        good = np.array([refused is None for refused in points.refused])[part]
        result[place] = {
            "points": int(good.sum()),
            "z2": float(np.sum(z[part][good] ** 2)),
            "held": int(np.sum(held[part][good])),
            "u95_mm": float(np.median(points.u95_mm[part][good])) if good.any() else None,
        }
    return result


def one_rig(task: tuple[str, float, str, int]) -> dict[str, object]:
    """Simulate, fit the models, judge headlines and points."""
    world, size_deg, protocol, seed = task
    use_compilation_cache()
    importance.ROUNDS_MAX = ROUNDS
    simulated = simulated_in(world, size_deg, protocol, seed)
    row: dict[str, object] = {"world": world, "size_deg": size_deg, "protocol": protocol, "seed": seed}
    for name, choice in MODELS.items():
        if name == "perfect" and seed >= BESIDE:
            continue
        start = time.process_time()
        try:
            result = fit(simulated.campaign, model=choice)
            posterior = sample(result, "importance", seed=seed)
            weights = posterior.convergence.importance
            calibration = calibration_of(result, posterior if posterior.converged else None, seed=seed)
            row[name] = {
                "converged": bool(result.converged),
                "accepted": bool(weights.pareto_k < K_MAX),
                "pareto_k": weights.pareto_k,
                "least_ess": weights.least_ess.value,
                "shift_named": any("zero" in w.text for w in weak_directions(result, moved_directions(result))),
                "headlines": judged(posterior, simulated.truth, simulated.campaign),
                "points": located(calibration, looks_around(simulated, calibration.range_steps, OUTSIDE, seed), seed),
                "cpu_s": time.process_time() - start,
            }
        except Exception as error:
            row[name] = {"converged": False, "accepted": False, "problem": repr(error)}
    return row


def accepted(rows: list[dict], name: str) -> list[dict]:
    """Results of a model for the rigs that it was fitted to and accepted by."""
    return [row[name] for row in rows if name in row and row[name]["converged"] and row[name]["accepted"]]


def _headlines(entries_of: dict[str, list[dict]]) -> None:
    """Both models' headlines."""
    print(heading("quantity | gears", JUDGED))
    for name, entries in entries_of.items():
        print(f"| bounds at 1e-4, N = {len(entries)} | {name} | {limits(len(entries))} | |")
    for quantity in HEADLINES:
        for name, entries in entries_of.items():
            print(line(quantity, name, verdict([entry["headlines"][quantity] for entry in entries]).cells))
    print()


def _points(entries_of: dict[str, list[dict]]) -> None:
    """Both models' points."""
    print("| counters | gears | points | RMS z | 95 % interval holds, % | median U95, mm |\n|---|---|---|---|---|---|")
    for place in PLACES:
        for name, entries in entries_of.items():
            parts = [entry["points"][place] for entry in entries]
            count = sum(part["points"] for part in parts)
            if not count:
                continue
            rms = np.sqrt(sum(part["z2"] for part in parts) / (3 * count))
            held = 100 * sum(part["held"] for part in parts) / (3 * count)
            u95 = np.median([part["u95_mm"] for part in parts if part["u95_mm"] is not None])
            print(f"| {place} | {name} | {count} | {rms:.2f} | {held:.1f} | {u95:.2f} |")
    print()


def _effort(entries_of: dict[str, list[dict]]) -> None:
    """Processor time and Pareto k."""
    for name, entries in entries_of.items():
        cpu, k = ([entry[key] for entry in entries] for key in ("cpu_s", "pareto_k"))
        named = np.mean([entry.get("shift_named", False) for entry in entries])
        print(
            f"- {name}: median {np.median(cpu):.1f} CPU s, median Pareto k {np.median(k):.2f}; "
            f"a shift of the zero that hides in the gears is named in {100 * named:.0f} %"
        )
    print()


def cases(rows: list[dict]) -> dict[str, dict[str, list[dict]]]:
    """Results of each model in every world and protocol that has rigs, by title."""
    by_case = {}
    for world, size_deg in (("priors", 0.0), *WORLDS):
        for protocol in PROTOCOLS:
            chosen = [r for r in rows if (r["world"], r["size_deg"], r["protocol"]) == (world, size_deg, protocol)]
            size = f", {size_deg:g} deg" if size_deg else ""
            for name in MODELS:
                if entries := accepted(chosen, name):
                    tried = sum(name in row for row in chosen)
                    case = by_case.setdefault(f"{world}{size}; {protocol}", {})
                    case[name] = entries
                    case.setdefault("tried", []).append(f"{len(entries)} of {tried} accepted with {name} gears")
    return by_case


def _overview(by_case: dict[str, dict[str, list[dict]]]) -> None:
    """A line a case: the headline whose errors are farthest from their sds, and the points."""
    titles = "headlines farthest from RMS z 1", "outside the bounds", "points inside", "points outside"
    print(f"| world; protocol | gears | rigs | {' | '.join(titles)} |\n|" + "---|" * 7)
    for title, case in by_case.items():
        for name in MODELS:
            if name not in case:
                continue
            found = {q: verdict([entry["headlines"][q] for entry in case[name]]) for q in HEADLINES}
            rms = {q: float(np.sqrt(np.mean([e["headlines"][q]["z"] ** 2 for e in case[name]]))) for q in HEADLINES}
            worst = max(rms, key=lambda q: abs(np.log(rms[q])))
            outside = ", ".join(q for q, v in found.items() if not (v.prior or v.within)) or "none"
            points = [np.array([[e["points"][p]["z2"], e["points"][p]["points"]] for e in case[name]]) for p in PLACES]
            of_points = (f"{np.sqrt(z2 / (3 * n)):.2f}" for z2, n in (part.sum(axis=0) for part in points))
            cells = f"{rms[worst]:.2f} ({worst}) | {outside} | {' | '.join(of_points)}"
            print(f"| {title} | {name} | {len(case[name])} | {cells} |")
    print()


def table(rows: list[dict]) -> None:
    """The study's page."""
    by_case = cases(rows)
    print("# Gears that repeat their errors\n")
    print("Written by `python -m experiments.gears.repeated_errors table`; what was done stands in the script.\n")
    _overview(by_case)
    for title, case in by_case.items():
        print(f"## {title}: {', '.join(case.pop('tried'))}\n")
        _headlines(case)
        _points(case)
        _effort(case)


def tasks(of: argparse.Namespace) -> list[tuple[str, float, str, int]]:
    """Rigs by the priors, then those of other worlds."""
    every = [("priors", 0.0, p, s) for s in range(of.n) for p in PROTOCOLS]
    return every + [(w, size, "mixed", s) for s in range(of.worlds) for w, size in WORLDS]


if __name__ == "__main__":
    options = {"--worlds": {"type": int, "default": 40, "help": "rigs of each world that no prior holds"}}
    study(__file__, __doc__, one_rig, ("world", "size_deg", "protocol", "seed"), tasks, table, 300, options)
