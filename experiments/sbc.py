"""Is the sampler's posterior the posterior? Simulation-based calibration on a small rig, by a loop of our own.

    python experiments/sbc.py run --n 200 --cores 0 1        # seconds per rig and core: see sbc.md; resumable
    python experiments/sbc.py run --variants "prior x3" "camera dropped" --n 50 --cores 0 1
    python experiments/sbc.py table > experiments/sbc.md     # also writes experiments/sbc.png

Rows are appended to `experiments/output/sbc.jsonl`; delete that file when the sampler has changed.

Every simulation draws a rig from the priors of `data/rigs/mounted` (seed i), runs the 60 spots of
`studies.dense_plan`, fits, samples, and ranks the truth among 255 draws spread over all walkers (Talts et al.,
arXiv:1804.06788). Ranked are all free parameters, the effective ratios and mirror offset, and the joint log-
likelihood and log-posterior of the true model, which see what single parameters hide (Modrak et al., doi
10.1214/23-BA1404). `table` turns ranks into PIT = (rank + U) / 256 with seeded U and tests their ECDF with the
simultaneous band of Sailynoja et al. (doi 10.1007/s11222-022-10090-6). Quantity by quantity its p must reach 0.05 /
number of quantities. The same test must fail on three planted faults: draws shrunk about their mean by 0.8 in prior
coordinates (from the same chains), the prior of the stereo calibration taken three times too wide, and the right
camera's centres taken as a thousand times worse than they are. `few stops` is clean too: 48 spots, twelve stops in
every direction, where the Laplace interval of the backlash is too short. Test quantities are those of the true model
throughout. Simulations whose fit or sampler did not converge are listed and counted: they have no ranks, so more than
`FAILURES` of them fail the study.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from coverage import read_rows
from scipy import stats
from studies import dense_plan, mounted_rig, physical_of, run_rows, small_plan

OUTPUT = Path(__file__).parent / "output"
ROWS = OUTPUT / "sbc.jsonl"
PICTURE = Path(__file__).with_suffix(".png")
SHEETS = ("d1", "d2")
DRAWS = 255
SHRINK = 0.8
WIDER = 3.0
WORSE = 1000.0
MAX_MINUTES = 8.0
CLEAN, FEW, SHRUNK, PRIOR, CAMERA = "clean", "few stops", f"sd x {SHRINK}", "prior x3", "camera dropped"
VARIANTS = (CLEAN, FEW, PRIOR, CAMERA)
"""Simulated separately; the shrunk draws come with the clean ones."""
FAULT_SIMULATIONS = 50
ALPHA = 0.05
FAILURES = 0.02
"""Largest share of simulations without ranks: the failures of 1 in 50 could move no ECDF out of its band."""
BAND_SEED, BAND_SAMPLES, PIT_SEED = 214, 20_000, 215


def faulty(campaign, variant: str):
    """The campaign that the fit is given."""
    if variant == PRIOR:
        stereo = campaign.stereo
        wide = replace(stereo, parameter_covariance=WIDER**2 * stereo.parameter_covariance)
        return replace(campaign, stereo=wide)
    if variant == CAMERA:
        spots = tuple(
            replace(s, su_right_px=WORSE * s.su_right_px, sv_right_px=WORSE * s.sv_right_px) for s in campaign.spots
        )
        return replace(campaign, spots=spots)
    return campaign


def one_simulation(task: tuple[str, int]) -> dict[str, object]:
    """Simulate, fit, sample, rank; whatever fails is recorded as a failure."""
    variant, seed = task
    from tvsbayes.estimators import campaign_arrays as buckets

    # A small campaign in a small bucket: ordinary ones pad to 512 spots to share a compilation.
    buckets.SMALLEST_BUCKET = 64
    from tvsbayes.estimators.campaign_arrays import use_compilation_cache
    from tvsbayes.estimators.joint_fit import fit
    from tvsbayes.posterior.sampling import sample
    from tvsbayes.twin.simulated_campaign import simulate

    use_compilation_cache()
    simulated = simulate(mounted_rig(), small_plan(SHEETS) if variant == FEW else dense_plan(SHEETS), seed)
    row: dict[str, object] = {"variant": variant, "seed": seed, "converged": False, "problems": []}
    row["unseen"] = sum(s.status != "ok" for s in simulated.campaign.spots)
    start = time.perf_counter()
    try:
        result = fit(faulty(simulated.campaign, variant))
        row["problems"] = list(result.problems)
        posterior = sample(result, seed=seed, max_minutes=MAX_MINUTES)
        row |= {"converged": bool(posterior.converged), "problems": list(posterior.convergence.missing)}
        row["steps"], row["tau"] = posterior.convergence.steps, posterior.convergence.tau_steps
        z = posterior.z
        # The same instants of every walker, as far apart as the chain allows: 4 x 64 draws, one of them too many.
        per_walker = -(-(DRAWS + 1) // len(z))
        instants = np.linspace(0, z.shape[1] - 1, per_walker).round().astype(int)
        chosen = z[:, instants].reshape(-1, z.shape[-1])[:DRAWS]
        row["ranks"] = ranks(simulated, result, chosen)
        if variant == CLEAN:
            mean = z.reshape(-1, z.shape[-1]).mean(axis=0)
            row["ranks_shrunk"] = ranks(simulated, result, mean + SHRINK * (chosen - mean))
    except Exception as error:
        row |= {"converged": False, "problems": [*row["problems"], repr(error)]}
    return {**row, "seconds": time.perf_counter() - start}


def ranks(simulated, result, z: np.ndarray) -> dict[str, int]:
    """Number of draws z (n, 65), coordinates of the fit, below the truth, for every quantity of the true model."""
    import jax

    from tvsbayes.estimators.campaign_arrays import campaign_arrays
    from tvsbayes.estimators.likelihood import evaluate
    from tvsbayes.instrument.parameters import NAMES
    from tvsbayes.model.parameter_space import coordinates_of, parameter_space
    from tvsbayes.posterior.draws import derived_at
    from tvsbayes.posterior.transport import in_batches
    from tvsbayes.twin.physics import effective_deg_per_step, effective_mirror_offset_mm

    truth = simulated.truth
    pose = result.reference_pose_rad
    with jax.enable_x64(True):
        draws = derived_at(result, z[None], pose)
        physical = draws.physical[0]
        true = physical_of(truth)
        space = parameter_space(simulated.campaign.rig, simulated.campaign.stereo)
        arrays = campaign_arrays(simulated.campaign)
        both = coordinates_of(space, np.vstack([true, physical]))
        log_posterior = in_batches(lambda block: evaluate(block, space, arrays).log_density, both)
    log_likelihood = log_posterior + 0.5 * np.sum(both**2, axis=1)
    values = {"log-likelihood": log_likelihood, "log-posterior": log_posterior}
    values |= {NAMES[i]: np.append(true[i], physical[:, i]) for i in np.flatnonzero(result.free)}
    ratio = effective_deg_per_step(truth.parameters, tuple(np.degrees(pose)))
    for k, direction in enumerate(("left", "right", "up", "down")):
        effective = draws.effective_deg_per_step[0, :, k]
        values[f"effective_deg_per_step.{direction}"] = np.append(ratio[direction], effective)
    offset = effective_mirror_offset_mm(truth.parameters, tuple(np.degrees(pose)))
    values["effective_mirror_offset_mm"] = np.append(offset, draws.effective_mirror_offset_mm[0])
    return {name: int(np.sum(v[1:] < v[0])) for name, v in values.items()}


class Band:
    """Simultaneous band of the ECDF of n uniforms, at k / n, k = 1 ... n - 1."""

    def __init__(self, n: int):
        self.n, self.points = n, np.arange(1, n) / n
        counts = np.arange(n + 1)[:, None]
        self.tail = np.minimum(stats.binom.cdf(counts, n, self.points), stats.binom.sf(counts - 1, n, self.points))
        uniform = np.random.default_rng(BAND_SEED).uniform(size=(BAND_SAMPLES, n))
        self.null = np.sort([self.statistic(u) for u in uniform])

    def counts(self, pit: np.ndarray) -> np.ndarray:
        """ECDF at the points, times n."""
        return np.searchsorted(np.sort(pit), self.points, side="right")

    def statistic(self, pit: np.ndarray) -> float:
        """The smallest binomial tail probability over all points."""
        return float(np.min(self.tail[self.counts(pit), np.arange(self.n - 1)]))

    def p_value(self, pit: np.ndarray) -> float:
        """Share of uniform samples at least as far out at their worst point, never 0."""
        return (1 + np.searchsorted(self.null, self.statistic(pit), side="right")) / (1 + BAND_SAMPLES)

    def limits(self, alpha: float) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest ECDF inside the band."""
        inside = self.tail >= np.quantile(self.null, alpha)
        return np.argmax(inside, axis=0) / self.n, (self.n - np.argmax(inside[::-1], axis=0)) / self.n


def pit_values(rows: list[dict], key: str) -> dict[str, np.ndarray]:
    """(rank + U) / (draws + 1) by quantity."""
    u = np.random.default_rng(PIT_SEED)
    names = list(rows[0][key])
    return {name: (np.array([r[key][name] for r in rows]) + u.uniform(size=len(rows))) / (DRAWS + 1) for name in names}


def sum_of_squares_p(pit: np.ndarray) -> float:
    """Two-sided p of the sum of squared normal scores against chi-square."""
    total = np.sum(stats.norm.ppf(pit) ** 2)
    return float(2 * min(stats.chi2.cdf(total, len(pit)), stats.chi2.sf(total, len(pit))))


def picture(band: Band, pit: dict[str, np.ndarray], names: list[str], limit: float) -> None:
    """ECDF minus uniform, with the bands at 95 % and at the criterion's level."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(2, 3, figsize=(10, 5.5), sharex=True, sharey=True, layout="constrained")
    for axis, name in zip(axes.flat, names, strict=True):
        for level, colour in ((limit, "0.9"), (ALPHA, "0.78")):
            low, high = band.limits(level)
            axis.fill_between(band.points, low - band.points, high - band.points, color=colour, step="mid", lw=0)
        axis.step(band.points, band.counts(pit[name]) / band.n - band.points, where="mid", color="C0", lw=1.2)
        axis.axhline(0, color="0.4", lw=0.6)
        axis.set_title(f"{name}, p = {band.p_value(pit[name]):.3f}", fontsize=9)
    figure.supxlabel("PIT of the truth")
    figure.supylabel("ECDF - uniform")
    figure.suptitle(f"{band.n} simulations; bands: 95 % (dark), criterion (light), each simultaneous", fontsize=10)
    figure.savefig(PICTURE, dpi=130)


def table() -> None:
    """The study's page and picture."""
    rows = read_rows(ROWS)
    clean = [r for r in rows if r["variant"] == CLEAN]
    few = [r for r in rows if r["variant"] == FEW]
    designs = [
        (CLEAN, clean, "ranks"),
        (FEW, few, "ranks"),
        (SHRUNK, [r for r in clean if r["seed"] < FAULT_SIMULATIONS], "ranks_shrunk"),
    ]
    designs += [(v, [r for r in rows if r["variant"] == v], "ranks") for v in (PRIOR, CAMERA)]
    print("# Simulation-based calibration of the sampler\n")
    print(
        "Written by `python experiments/sbc.py table` after `python experiments/sbc.py run`; rig i has seed i. 60 spots"
    )
    print(
        "of the mounted rig (48 for `few stops`), every prior quantity anew, no aperture readings; two shared cores.\n"
    )
    columns = ("draws", "simulations", "without ranks", "quantities", "criterion p", "least p, of", "p log-likelihood")
    columns += ("p log-posterior", "quantities failing", "verdict", "wanted")
    print("| " + " | ".join(columns) + " |\n|" + "---|" * len(columns))
    seconds = {}
    for title, chosen, key in designs:
        good = [r for r in chosen if r["converged"]]
        if len(good) < 2:
            continue
        seconds[title] = [r["seconds"] for r in chosen]
        band, pit = Band(len(good)), pit_values(good, key)
        p = {name: band.p_value(values) for name, values in pit.items()}
        limit = ALPHA / len(p)
        least = min(p, key=p.get)
        failing = sum(v < limit for v in p.values())
        lost = len(chosen) - len(good)
        # A fault has to be seen in the ranks, not in lost simulations.
        passes = failing == 0 and (title not in (CLEAN, FEW) or lost <= FAILURES * len(chosen))
        cells = (title, len(chosen), lost, len(p), f"{limit:.1e}", f"{p[least]:.1e}, {least}")
        cells += (f"{p['log-likelihood']:.1e}", f"{p['log-posterior']:.1e}", failing)
        verdict = "passes" if passes else "FAILS"
        if len(chosen) < FAULT_SIMULATIONS:
            verdict = "too few to judge"
        cells += (verdict, "passes" if title in (CLEAN, FEW) else "FAILS")
        print("| " + " | ".join(map(str, cells)) + " |")
        if title == CLEAN:
            kept = band, pit, p, limit
    print(f"\np = {1 / (1 + BAND_SAMPLES):.0e} is the smallest that {BAND_SAMPLES} simulated bands can give.\n")
    if not seconds:
        return
    for title, values in seconds.items():
        if title != SHRUNK:
            print(f"- {title}: {sum(values) / 60:.0f} core minutes, median {np.median(values):.0f} s a simulation")
    failures = [r for r in rows if not r["converged"]]
    for r in failures:
        print(f"- no ranks: {r['variant']}, seed {r['seed']}: {'; '.join(r['problems'])}")
    band, pit, p, limit = kept
    first = ["log-likelihood", "log-posterior"]
    order = first + sorted((n for n in p if n not in first), key=p.get)
    picture(band, pit, order[:6], limit)
    print("\n![ECDF differences of the two densities and the four worst quantities](sbc.png)\n")
    print(f"## Clean, all quantities: {band.n} simulations\n")
    print("| quantity | mean PIT | sd of PIT x sqrt 12 | p of the band | p of sum z^2 |\n|---|---|---|---|---|")
    for name in order:
        values = pit[name]
        spread = values.std() * np.sqrt(12)
        print(f"| {name} | {values.mean():.3f} | {spread:.3f} | {p[name]:.3f} | {sum_of_squares_p(values):.3f} |")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=("run", "table"))
    parser.add_argument("--n", type=int, default=200)
    parser.add_argument("--variants", nargs="+", default=[CLEAN], choices=VARIANTS)
    parser.add_argument("--cores", type=int, nargs="+", default=[0])
    arguments = parser.parse_args()
    if arguments.action == "run":
        tasks = [(v, s) for s in range(arguments.n) for v in arguments.variants]
        run_rows(one_simulation, tasks, ROWS, ("variant", "seed"), arguments.cores)
    else:
        table()


if __name__ == "__main__":
    main()
