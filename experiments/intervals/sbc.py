"""Is the sampled posterior the posterior? Simulation-based calibration on small rigs, by a loop of our own.

    python -m experiments.intervals.sbc run --n 1000 --cores 0 1       # CPU seconds a rig: see sbc.md; resumable
    python -m experiments.intervals.sbc run --variants "few stops" "prior x3" "camera dropped" --n 50 --cores 0 1
    python -m experiments.intervals.sbc table > experiments/intervals/sbc.md     # also writes sbc.png

Every simulation draws a rig from the priors of `data/rigs/mounted` (seed i), runs the 60 spots of
`rigs.dense_plan`, fits, samples by importance, and ranks the truth among 255 draws resampled by their weights
(Talts et al., arXiv:1804.06788). Ranked are all free parameters, the effective ratios
and mirror offset, and the joint log-likelihood and log-posterior of the true model, which see what single parameters
hide (Modrak et al., doi 10.1214/23-BA1404). `table` turns ranks into PIT = (rank + U) / 256 with seeded U and tests
their ECDF with the simultaneous band of Sailynoja et al. (doi 10.1007/s11222-022-10090-6). Quantity by quantity its p
must reach 0.05 / number of quantities. The same test must fail on four planted faults: draws shrunk about their mean
by 0.8 in prior coordinates (from the draws of the first clean simulations), weights without the Jacobian of the map in
which draws are proposed (from those of `few stops`, where noise scales are least known), the prior of the stereo
calibration taken three times too wide, and the right camera's centres taken as a thousand times worse than they are.
`few stops` is clean too: 48 spots, twelve stops in every direction, where the Laplace interval of the backlash is too
short. Whether draws are accepted depends on the data and not on the truth behind them, so the ranks of the others must
be uniform all the same; more than `FAILURES` refused ones fail the study.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
from scipy import stats

from experiments.common.against_truth import SHRINK
from experiments.common.command_line import by_seed, study
from experiments.common.figures import page_figure, title_and_figure
from experiments.common.fits import physical_of
from experiments.common.page import heading, line
from experiments.common.rigs import creeping_rig, dense_plan, small_plan
from tvsbayes.estimators.campaign_arrays import campaign_arrays
from tvsbayes.estimators.joint_fit import fit
from tvsbayes.estimators.likelihood import evaluate, no_draw
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.model.parameter_space import coordinates_of, parameter_space
from tvsbayes.posterior.draws import Posterior, derived_of
from tvsbayes.posterior.sampling import TIERS, sample
from tvsbayes.posterior.transport import transport
from tvsbayes.report.drawing import BLUE
from tvsbayes.twin.physics import effective_mirror_offset_mm
from tvsbayes.twin.simulated_campaign import simulate

KEYS, PICTURE = ("variant", "seed"), Path(__file__).with_suffix(".png")
SHEETS, WIDER, WORSE, MAX_MINUTES = ("d1", "d2"), 3.0, 1000.0, 8.0
CLEAN, FEW, PRIOR, CAMERA = "clean", "few stops", "prior x3", "camera dropped"
SHRUNK, JACOBIAN = f"sd x {SHRINK}", "Jacobian dropped"
VARIANTS = (CLEAN, FEW, PRIOR, CAMERA)
"""Simulated separately; the two other faults come with the first two."""
DRAWS = 255
"""Draws of a simulation among which the truth is ranked."""
ALPHA = 0.05
"""Of all quantities of a study together: each has to reach a p of ALPHA / number of quantities."""
FAULT_SIMULATIONS = 50
"""As few simulations as show a planted fault; fewer judge nothing."""
BAND_SEED, BAND_SAMPLES, PIT_SEED = 214, 20_000, 215
FAILURES = 0.05
"""Largest share of simulations that are not judged."""
DENSITIES = ("log-likelihood", "log-posterior")


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
    use_compilation_cache()
    simulated = simulate(creeping_rig(), small_plan(SHEETS) if variant == FEW else dense_plan(SHEETS), seed)
    row: dict = {**dict(zip(KEYS, task, strict=True)), "converged": False, "problems": []}
    start = time.process_time()
    try:
        result = fit(faulty(simulated.campaign, variant))
        row["problems"] = list(result.problems)
        posterior = sample(result, tier=TIERS[0], seed=seed, max_minutes=MAX_MINUTES)
        row |= {"converged": bool(posterior.converged), "problems": list(posterior.convergence.missing)}
        run = posterior.convergence.importance
        row |= {"cpu_s": time.process_time() - start, "draws": run.draws, "effective_share": run.effective_share}
        row |= {"pareto_k": run.pareto_k, "worst_pareto_k": run.worst_pareto_k.value, "ess": run.least_ess.value}
        chosen, errors_rad = posterior.coordinates(DRAWS), posterior.thinned(DRAWS).place_errors_rad
        row[variant] = ranks(simulated, result, chosen, errors_rad)
        if variant == CLEAN and seed < FAULT_SIMULATIONS:
            mean, centre_rad = np.tensordot(posterior.weights, posterior.z, axes=2), posterior.centre.place_errors_rad
            nearer_rad = centre_rad + SHRINK * (errors_rad - centre_rad)
            row[SHRUNK] = ranks(simulated, result, mean + SHRINK * (chosen - mean), nearer_rad)
        if variant == FEW:
            wrong = without_jacobian(posterior)
            row[JACOBIAN] = ranks(simulated, result, wrong.coordinates(DRAWS), wrong.thinned(DRAWS).place_errors_rad)
    except Exception as error:
        row |= {"converged": False, "problems": [*row["problems"], repr(error)]}
    return row


def without_jacobian(posterior: Posterior) -> Posterior:
    """Weighted draws whose density was taken for that of the coordinates in which they are proposed."""
    with jax.enable_x64(True):
        path = transport(posterior.fit)
    with np.errstate(divide="ignore"):
        log_weights = np.log(posterior.weights[0]) - path.mapped(path.to_w(posterior.z[0])).log_jacobian
    weights = np.exp(log_weights - log_weights.max())
    return replace(posterior, weights=weights[None] / weights.sum())


def ranks(simulated, result, z: np.ndarray, place_errors_rad: np.ndarray) -> dict[str, int]:
    """How many draws lie below the truth, for every quantity of the true model.

    Args:
        simulated: with its truth.
        result: the fit.
        z: its coordinates, shape (n, p).
        place_errors_rad: what the gears repeat, shape (n, e).
    """
    truth = simulated.truth
    pose = result.reference_pose_rad
    with jax.enable_x64(True):
        draws = derived_of(result, z[None], place_errors_rad[None])
        physical = draws.physical[0]
        true = physical_of(truth)
        space = parameter_space(simulated.campaign.rig, simulated.campaign.stereo)
        arrays = campaign_arrays(simulated.campaign)
        both = coordinates_of(space, np.vstack([true, physical]))
        # What the fit does not estimate, without readings the aperture's, has one value in all draws.
        both[0, ~result.free] = both[1, ~result.free]
        still = no_draw(len(both), arrays)
        log_posterior = evaluate(both, still, space, arrays).log_density
    log_likelihood = log_posterior + 0.5 * np.sum(both**2, axis=1)
    values = {"log-likelihood": log_likelihood, "log-posterior": log_posterior}
    values |= {TWO_MIRROR.names[i]: np.append(true[i], physical[:, i]) for i in np.flatnonzero(result.free)}
    ratio = truth.effective_deg_per_step(simulated.campaign)
    for k, direction in enumerate(DIRECTIONS):
        effective = draws.effective_deg_per_step[0, :, k]
        values[f"effective_deg_per_step.{direction}"] = np.append(ratio[direction], effective)
    offset = effective_mirror_offset_mm(truth.parameters, tuple(np.degrees(pose)))
    values["effective_mirror_offset_mm"] = np.append(offset, draws["effective_mirror_offset_mm"][0])
    return {name: int(np.sum(v[1:] < v[0])) for name, v in values.items()}


def picture(band: Band, pit: dict[str, np.ndarray], names: list[str], limit: float) -> None:
    """ECDF minus uniform, with the bands at 95 % and at the criterion's level."""
    with page_figure(PICTURE, 5.5, width_in=10.0) as figure:
        axes = figure.subplots(2, 3, sharex=True, sharey=True)
        for axis, name in zip(axes.flat, names, strict=True):
            for level, colour in ((limit, "0.9"), (ALPHA, "0.78")):
                low, high = band.limits(level)
                axis.fill_between(band.points, low - band.points, high - band.points, color=colour, step="mid", lw=0)
            axis.step(band.points, band.counts(pit[name]) / band.n - band.points, where="mid", color=BLUE, lw=1.2)
            axis.axhline(0, color="0.4", lw=0.6)
            axis.set_title(f"{name}, p = {band.p_value(pit[name]):.3f}")
        figure.supxlabel("PIT of the truth")
        figure.supylabel("ECDF - uniform")
        figure.suptitle(f"{band.n} simulations; bands: 95 % (dark), criterion (light), each simultaneous")


def design_row(title: str, chosen: Sequence[dict], judged: int, p: Mapping[str, float]) -> str:
    """The line of a design from the p of its quantities."""
    limit, least, clean = ALPHA / len(p), min(p, key=p.__getitem__), title in (CLEAN, FEW)
    failing, lost = sum(v < limit for v in p.values()), len(chosen) - judged
    # A fault has to be seen in the ranks, not in lost simulations.
    passes = failing == 0 and not (clean and lost > FAILURES * len(chosen))
    word = "too few to judge" if len(chosen) < FAULT_SIMULATIONS else "passes" if passes else "FAILS"
    cells = (title, len(chosen), lost, len(p), f"{limit:.1e}", f"{p[least]:.1e}, {least}")
    cells += (*(f"{p[name]:.1e}" for name in DENSITIES), failing)
    return line(*cells, word, "passes" if clean else "FAILS")


def clean_part(band: Band, pit: Mapping[str, np.ndarray], p: Mapping[str, float]) -> None:
    """Every quantity of the clean simulations, the two densities first, then by p."""
    print(f"## Clean, all quantities: {band.n} simulations\n")
    print(heading("quantity | mean PIT | sd of PIT x sqrt 12 | p of the band | p of sum z^2"))
    for name in [*DENSITIES, *sorted((n for n in p if n not in DENSITIES), key=p.__getitem__)]:
        total = stats.chi2(band.n).cdf(np.sum(stats.norm.ppf(pit[name]) ** 2))
        figures = (pit[name].mean(), pit[name].std() * np.sqrt(12), p[name], 2 * min(total, 1 - total))
        print(line(name, *(f"{figure:.3f}" for figure in figures)))
    print()


def designs(rows: Sequence[dict]) -> None:
    """Every design with two simulations or more that have ranks."""
    titles = "draws | simulations | not accepted | quantities | criterion p | least p, of | p log-likelihood"
    print(heading(titles, "p log-posterior | quantities failing | verdict | wanted"))
    of, clean = {v: [r for r in rows if r["variant"] == v] for v in VARIANTS}, None
    first = [row for row in of[CLEAN] if row["seed"] < FAULT_SIMULATIONS]
    for design, chosen in {CLEAN: of[CLEAN], FEW: of[FEW], SHRUNK: first, JACOBIAN: of[FEW], **of}.items():
        good = [row[design] for row in chosen if row["converged"] and design in row]
        if len(good) < 2:
            continue
        band, u = Band(len(good)), np.random.default_rng(PIT_SEED)
        pit = {n: (np.array([r[n] for r in good]) + u.uniform(size=len(good))) / (DRAWS + 1) for n in good[0]}
        p = {name: band.p_value(values) for name, values in pit.items()}
        print(design_row(design, chosen, len(good), p))
        clean = (band, pit, p) if design == CLEAN else clean
    print(f"\np = {1 / (1 + BAND_SAMPLES):.0e} is the smallest that {BAND_SAMPLES} simulated bands can give.\n")
    keys = ("pareto_k", "worst_pareto_k", "draws", "effective_share", "ess", "cpu_s")
    for variant, chosen in of.items():
        if done := [row for row in chosen if "draws" in row]:
            medians = (
                "Pareto k {:.2f}, worst of a headline {:.2f}, {:.0f} draws of share {:.2f}, {:.0f} effective of the "
            )
            medians += "worst headline, {:.1f} CPU s for fit and draws"
            print(f"- {variant}: medians:", medians.format(*(np.median([row[key] for row in done]) for key in keys)))
    for row in rows:
        if not row["converged"]:
            print(f"- not accepted: {row['variant']}, seed {row['seed']}: {'; '.join(row['problems'])}")
    print()
    if clean:
        band, pit, p = clean
        worst = sorted((n for n in p if n not in DENSITIES), key=p.__getitem__)[:4]
        picture(band, pit, [*DENSITIES, *worst], ALPHA / len(p))
        clean_part(band, pit, p)


def table(rows: list[dict]) -> None:
    title = "Simulation-based calibration of the posterior"
    words = "ECDF differences of the two densities and the four worst quantities"
    print(title_and_figure(__file__, title, PICTURE, words))
    print("Written by `python -m experiments.intervals.sbc table` after `run`; rig i has seed i. 60 spots of the")
    print("mounted rig (48 for `few stops`), every prior quantity anew, no aperture readings; two shared cores.\n")
    designs(rows)


if __name__ == "__main__":
    options = {"--variants": {"nargs": "+", "default": [CLEAN], "choices": VARIANTS}}
    study(__file__, __doc__, one_simulation, KEYS, lambda of: by_seed(of.variants, of.n), table, 1000, options)
