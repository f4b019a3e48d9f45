"""Instruments drawn from their priors, fitted and sampled by importance: rows against the truth, and tables of them."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from experiments.common.headlines import LEAST_CONTRACTION, marked, rms_limits
from experiments.common.rows import commit, commits_of
from tvsbayes.errors import TvsError
from tvsbayes.estimators.joint_fit import JointFit, fit
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.posterior.draws import Posterior
from tvsbayes.posterior.sampling import sample
from tvsbayes.statistics.chances import binomial_bounds, rms_bounds
from tvsbayes.twin.simulated_campaign import SimulatedCampaign

LEVEL = 0.95
FAR = 4.0
"""Standard uncertainties beyond which an instrument is named."""
USABLE = ("accepted", "rough")
"""Answers whose intervals are judged."""


def scored(
    task: tuple[str, int],
    simulated: SimulatedCampaign,
    names: Sequence[str],
    more: Callable[[Posterior, SimulatedCampaign], dict[str, object]] | None = None,
) -> dict[str, object]:
    """Headlines and parameters of a simulated campaign against their truth; a fit that fails is a row without them.

    Args:
        task: kind and seed.
        simulated: the campaign and its truth.
        names: of the parameters.
        more: parts of the row that a study adds.
    """
    kind, seed = task
    use_compilation_cache()
    campaign, began = simulated.campaign, time.process_time()
    row: dict[str, object] = {"kind": kind, "seed": seed, "commit": commit(), "answer": "none", "problems": []}
    try:
        estimate = fit(campaign)
        row["problems"] = list(estimate.problems)
        if estimate.converged:
            posterior = sample(estimate, "importance")
            quantities = _quantities(estimate, posterior, simulated, names)
            row |= {"answer": posterior.convergence.answer, "quantities": quantities}
            row |= more(posterior, simulated) if more else {}
    except TvsError as error:
        row["problems"] = [error.message]
    return {**row, "cpu_s": round(time.process_time() - began, 1)}


def _quantities(
    estimate: JointFit, posterior: Posterior, simulated: SimulatedCampaign, names: Sequence[str]
) -> dict[str, dict[str, float]]:
    """Of each: z of the truth, share of the draws below it, share of the prior's variance that the data take away."""
    draws, weights = posterior.by_name, posterior.weights.ravel()
    true = dict(simulated.truth.parameters)
    headline = simulated.truth.effective_deg_per_step(simulated.campaign) or {}
    true |= {f"effective_deg_per_step.{direction}": value for direction, value in headline.items()}
    for axis, (one, other) in {"pan": ("left", "right"), "tilt": ("up", "down")}.items():
        true[f"effective_contrast_deg_per_step.{axis}"] = headline[one] - headline[other]
    prior = {name: np.asarray(estimate.prior_draws.physical)[:, k].var() for k, name in enumerate(estimate.names)}
    result = {}
    for name in draws:
        if name not in true or not (name in names or name.startswith("effective_")) or prior.get(name) == 0:
            continue
        values = draws[name]
        mean = weights @ values
        variance = weights @ (values - mean) ** 2
        figures = {
            "z": (mean - true[name]) / np.sqrt(variance),
            "pit": weights @ (values < true[name]),
            "taken": 1 - variance / prior[name] if name in prior else 1.0,
        }
        result[name] = {key: round(float(value), 3) for key, value in figures.items()}
    return result


def tables(drawn: Sequence[dict], text: str, titles: Mapping[str, str], what: str) -> None:
    """Text, and a table for each kind that has rows; `what`: a word for what is drawn."""
    print(text)
    for kind, title in titles.items():
        rows = [row for row in drawn if row["kind"] == kind]
        good = [row for row in rows if row["answer"] in USABLE]
        if not good:
            continue
        answers = Counter(row["answer"] for row in rows)
        counts = ", ".join(f"{count} {word}" for word, count in answers.most_common())
        cpu = np.median([row["cpu_s"] for row in rows])
        low, high = (100 * share for share in binomial_bounds(len(good), LEVEL))
        least, most = rms_bounds(len(good))
        print(f"\n## {title}\n\n{len(rows)} {what}s: {counts}; median {cpu:.0f} CPU s. ", end="")
        print(f"Commit {commits_of(rows)}. Bounds {low:.0f} to {high:.0f} % and {rms_limits(len(good))}.\n")
        print("| quantity | 95 % interval holds | RMS z | prior's variance taken away |\n|---|---|---|---|")
        every = []
        for name in good[0]["quantities"]:
            scores = [row["quantities"][name] for row in good]
            taken = float(np.median([score["taken"] for score in scores]))
            inside = np.array([abs(score["pit"] - 0.5) < LEVEL / 2 for score in scores])
            rms = float(np.sqrt(np.mean([score["z"] ** 2 for score in scores])))
            share = marked(f"{100 * inside.mean():.1f} %", low <= 100 * inside.mean() <= high)
            spread = marked(f"{rms:.2f}", least <= rms <= most)
            every += inside.tolist() if taken >= LEAST_CONTRACTION else []
            cells = (share, spread) if taken >= LEAST_CONTRACTION else ("*prior*", "")
            print(f"| `{name}` | {cells[0]} | {cells[1]} | {100 * taken:.0f} % |")
        print(f"| all judged | {100 * np.mean(every):.1f} % of {len(every)} | | |")
        for row in good:
            if far := [f"`{name}` {q['z']:+.1f}" for name, q in row["quantities"].items() if abs(q["z"]) > FAR]:
                print(f"\n{what.capitalize()} {row['seed']} lies beyond {FAR:g} u: {', '.join(far)}.")
