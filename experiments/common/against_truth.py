"""Quantities of drawn instruments against their truth: rows of fits, and the table with bounds that all studies print.

PIT: share of the draws below the truth; z: (centre - truth) / sd; contraction: 1 - posterior variance / prior variance.
Bounds are two-sided at `tvsbayes.statistics.chances.BOUND`.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from experiments.common.page import heading, line
from experiments.common.rows import commits_of
from tvsbayes.statistics.chances import BOUND, LEVELS, binomial_bounds, rms_bounds

SHRINK = 0.8
"""A table whose sds are multiplied by this has to fail, or its test could not."""
LEAST_CONTRACTION = 0.1
"""Below it, in the median, an interval is the prior's own and is not judged."""
USABLE = ("accepted", "rough")
"""Answers of sampled posteriors whose intervals are judged."""
NOTE = (
    f"**!** marks a figure outside its two-sided bounds at {BOUND:g}; *prior*: the data take away less than a tenth\n"
    f"of the prior's variance, which is not judged. The same table with every sd times {SHRINK:g} has to fail"
)


def against(
    values: np.ndarray, weights: np.ndarray, true: float, prior_variance: float, centre: float | None = None
) -> dict[str, float]:
    """One quantity's weighted draws (n,) against the truth; the centre is their mean where no other is given."""
    mean = weights @ values
    variance = weights @ (values - mean) ** 2
    z = ((mean if centre is None else centre) - true) / np.sqrt(variance)
    contraction = 1 - variance / prior_variance
    return {"pit": float(weights @ (values < true)), "z": float(z), "contraction": float(contraction)}


def scored(draws: np.ndarray, true: float) -> dict[str, float]:
    """Draws (n,) that weigh the same, of a quantity without a prior to compare with."""
    return against(draws, np.full(draws.shape, 1 / draws.size), true, np.inf)


def judged(found: Any, truth: Any, campaign: Any, names: Sequence[str] = ()) -> dict[str, dict[str, float]]:
    """Headlines and named parameters of a fit, its centre the mode, or of a posterior, its centre the mean."""
    from tvsbayes.posterior.draws import Draws, Posterior, headline_names

    sampled = isinstance(found, Posterior)
    fit = found.fit if sampled else found
    draws, prior, mode = (Draws(of, fit.space.mechanism) for of in (found.draws, fit.prior_draws, fit.mode))
    pan_deg, tilt_deg = np.degrees(fit.reference_pose_rad).tolist()
    true = truth.headlines(campaign, (pan_deg, tilt_deg))
    result = {}
    for name in dict.fromkeys((*headline_names(fit), *names)):
        variance = prior[name].var() if name in true and name in draws.names else 0.0
        if variance > 0:
            values = draws[name]
            weights = found.weights.ravel() if sampled else np.full(values.shape, 1 / values.size)
            centre = None if sampled else float(mode[name][0])
            result[name] = against(values, weights, true[name], variance, centre)
    return result


def tried(
    campaign: Any,
    truth: Any,
    tier: str | None = None,
    *,
    names: Sequence[str] = (),
    begin: Callable[..., Any] | None = None,
    seed: int = 0,
    more: Callable[[Any], Mapping[str, object]] | None = None,
    **options: Any,
) -> dict[str, object]:
    """A campaign fitted, and sampled by a tier: part of a row; whatever fails is recorded, never dropped.

    Args:
        campaign: with looks.
        truth: of its rig.
        tier: of `sample`; without one the fit alone is judged, by Laplace.
        names: of quantities that are no headlines.
        begin: in place of `joint_fit.fit`, called with the campaign and `options`.
        seed: of the sampling.
        more: what a study adds to the row, from the posterior, or the fit where nothing is sampled.
        options: of the fit.
    """
    from tvsbayes.estimators.joint_fit import fit
    from tvsbayes.model.compilation_cache import use_compilation_cache
    from tvsbayes.posterior.sampling import sample
    from tvsbayes.results.records import plain

    use_compilation_cache()
    began, row = time.process_time(), {"answer": "failed", "problems": []}
    try:
        found = fit(campaign, **options) if begin is None else begin(campaign, **options)
        row |= {"answer": "fitted" if found.converged else "not converged", "problems": list(found.problems)}
        row |= {"laplace": judged(found, truth, campaign, names), "fit_cpu_s": time.process_time() - began}
        if tier is not None and found.converged:
            found = sample(found, tier=tier, seed=seed, max_minutes=10.0)
            convergence = found.convergence
            row |= {"answer": convergence.answer, "problems": list(convergence.missing)}
            row |= {"sampling": plain(convergence.sampling), "posterior": judged(found, truth, campaign, names)}
        row |= more(found) if more else {}
    except Exception as error:
        row |= {"answer": "failed", "problems": [*row["problems"], repr(error)]}
    return {**row, "cpu_s": time.process_time() - began}


def marked(text: str, inside: bool) -> str:
    """A figure of a table, marked where it is outside its bounds."""
    return text + ("" if inside else " **!**")


def rms(z: Sequence[float]) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(z))))


def verdict(entries: Sequence[Mapping[str, float]]) -> tuple[list[str], str, bool]:
    """Cells of a quantity: RMS z, shares by level; a word; whether sds times `SHRINK` would be seen."""
    pit, spread = np.array([entry["pit"] for entry in entries]), rms([entry["z"] for entry in entries])
    low, high = rms_bounds(len(entries))
    inside = [low <= spread <= high]
    cells = [marked(f"{spread:.2f}", inside[0])]
    for level in LEVELS:
        share, (least, most) = float(np.mean(np.abs(pit - 0.5) <= level / 2)), binomial_bounds(len(entries), level)
        inside.append(least <= share <= most)
        cells.append(marked(f"{100 * share:.1f}", inside[-1]))
    if np.median([entry["contraction"] for entry in entries]) < LEAST_CONTRACTION:
        return cells, "*prior*", False
    return cells, "within" if all(inside) else "OUTSIDE", not low <= spread / SHRINK <= high


def bounds(count: int) -> list[str]:
    """Bounds of the cells of a `verdict`."""
    shares = (f"{100 * low:.0f}-{100 * high:.0f}" for low, high in (binomial_bounds(count, level) for level in LEVELS))
    return ["{:.2f}-{:.2f}".format(*rms_bounds(count)), *shares]


def table(groups: Mapping[str, Sequence[Mapping[str, Mapping[str, float]]]]) -> None:
    """Every quantity of every group of instruments; those without instruments are left out."""
    groups = {name: of for name, of in groups.items() if of}
    levels = " | ".join(f"{100 * level:.0f} %" for level in LEVELS)
    print(heading(f"quantity | of | n | contraction | RMS z | {levels} | verdict | seen if sd x {SHRINK:g}"))
    for name, of in groups.items():
        print(line("bounds", name, len(of), "", *bounds(len(of)), "", ""))
    for quantity in dict.fromkeys(name for of in groups.values() for each in of for name in each):
        for name, of in groups.items():
            if entries := [each[quantity] for each in of if quantity in each]:
                cells, word, seen = verdict(entries)
                contraction = f"{np.median([entry['contraction'] for entry in entries]):.3f}"
                shrunk = "" if word == "*prior*" else "yes" if seen else "no"
                print(line(f"`{quantity}`", name, len(entries), contraction, *cells, word, shrunk))
    print()


def answers(rows: Sequence[Mapping[str, Any]], what: str) -> str:
    """How many instruments were drawn, their answers, the median cost, and the commits."""
    counts = Counter(row["answer"] for row in rows)
    shown = ", ".join(f"{count} {answer}" for answer, count in counts.most_common())
    cpu_s = np.median([row["cpu_s"] for row in rows])
    return f"{len(rows)} {what}s: {shown}; median {cpu_s:.1f} CPU s. Commit {commits_of(rows)}.\n"


def failures(rows: Sequence[Mapping[str, Any]], keys: Sequence[str], good: Sequence[str] = USABLE) -> None:
    """List what has another answer."""
    for row in rows:
        if row["answer"] not in good:
            task = " ".join(str(row[key]) for key in keys)
            print(f"- {row['answer']}: {task}: {'; '.join(row['problems'])}")
