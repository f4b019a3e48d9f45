"""Importance sampling of a fit, by the map of `posterior.transport`, mixed over unrecorded ways of homing."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import jax
import numpy as np

from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.inference.density import Points
from tvsbayes.inference.importance import K_MAX, ROUND, ImportanceRun, Pool, Weighing, uncertain, weighted_run
from tvsbayes.inference.summaries import monte_carlo_errors
from tvsbayes.instrument.homing import prior_chance
from tvsbayes.posterior.draws import Posterior
from tvsbayes.posterior.target import Target
from tvsbayes.posterior.transport import Mapped, transport, transport_beside
from tvsbayes.progress import Advance, unshown
from tvsbayes.results.convergence import Reweighted
from tvsbayes.statistics.streams import Stream, random_stream
from tvsbayes.statistics.weighted_draws import weighted_summary

MAPPED_SHARE = 0.25
"""Share of the time for the map to nearly normal coordinates, for the progress display."""
ALONE_ROUNDS_LEAST, BESIDE_ROUNDS_MAX = 2, 12
"""Least and largest number of rounds of a way of homing with draws of its own."""


def importance_run(
    fit: JointFit,
    seed: int,
    advance: Advance = unshown,
    rounds_max: int | None = None,
) -> ImportanceRun[Target]:
    """Run `weighted_run` for a converged fit."""
    began, path = time.monotonic(), transport(fit)
    advance(MAPPED_SHARE)

    def drawing(share: float, detail: str = "") -> None:
        advance(MAPPED_SHARE + (1 - MAPPED_SHARE) * share)

    run = weighted_run(Target(fit, path), seed, drawing, rounds_max)
    return replace(run, sample=replace(run.sample, seconds=time.monotonic() - began))


def run_beside(fit: JointFit, run: ImportanceRun[Target], seed: int) -> Posterior:
    """Compute the posterior under another way of homing, by reweighting the draws of the most probable one.

    Both posteriors usually overlap. Where they do not, the other one has draws of its own, by its own map and the
    proposal fitted for the most probable one. The number of draws in either case depends on the error of the mixture.

    Args:
        fit: the fit under the other way.
        run: the run of the most probable way.
        seed: seed of draws of the errors at places.
    """
    began = time.monotonic()
    first = run.sample.convergence
    assert isinstance(first, Reweighted)
    odds = float(np.log(prior_chance(fit.sides) / prior_chance(run.density.fit.sides)))

    def known(weighed: Weighing) -> bool:
        error = max(e.rounds_factor for e in weighed.monte_carlo_error.values())
        share = np.exp(weighed.log_evidence - first.importance.log_evidence + odds)
        # The error of a part enters the mixture by the share of the part.
        return weighed.importance.pareto_k < K_MAX and bool(error * share**2 <= 1)

    weighed = _weighed_anew(fit, run, known, seed)
    if not known(weighed):
        weighed = _weighing_alone(fit, run, known, seed)
    density = weighed.density
    assert isinstance(density, Target)
    return density.posterior(weighed.sample(time.monotonic() - began), seed)


def _weighing_alone(
    fit: JointFit, run: ImportanceRun[Target], known: Callable[[Weighing], bool], seed: int
) -> Weighing:
    """Draw from another way of homing until its error is small enough or the rounds are used up."""
    target = Target(fit, transport_beside(fit, run.density.path))
    pool, generator = Pool.empty(run.pool.proposals[-1]), np.random.RandomState(seed)
    for count in range(1, BESIDE_ROUNDS_MAX + 1):
        pool = pool.extended(target, generator, fitted=False)
        weighed = Weighing(target, pool)
        if count >= ALONE_ROUNDS_LEAST and known(weighed):
            break
    return weighed


def _weighed_anew(fit: JointFit, run: ImportanceRun[Target], known: Callable[[Weighing], bool], seed: int) -> Weighing:
    """Reweight the draws of a run under another way of homing, round by round until its error is small enough."""
    target, drawn, parts = Target(fit, run.density.path), run.pool.drawn, []
    normal = target.place_normals(len(drawn), random_stream(seed, Stream.OTHER_HOMING))
    for begin in range(0, len(drawn), ROUND):
        some = slice(begin, begin + ROUND)
        subset = drawn.taken(some)
        parts.append(target.at(subset.w, Mapped(subset.parts["z"], subset.parts["log_jacobian"]), normal[some]))
        points = Points.joined(parts)
        weighed = Weighing(target, replace(run.pool, points=points, counts=(len(points),), invalid=target.invalid))
        if known(weighed):
            break
    return weighed


def mixed(parts: Sequence[Posterior]) -> Posterior:
    """Mix the posteriors under several ways of homing by their evidence and prior probabilities.

    Args:
        parts: posteriors by importance sampling, in the order of `JointFit.mixture`.
    """
    first = parts[0]
    evidence = np.array([part.convergence.importance.log_evidence for part in parts])
    evidence += np.log([prior_chance(part.fit.sides) for part in parts])
    chance = np.exp(evidence - evidence.max())
    chance /= chance.sum()
    ways = tuple(
        replace(way, probability=float(p))
        for way, p in zip([way for way in first.fit.mixture if way.fit is not None], chance, strict=True)
    )
    return replace(
        first,
        fit=replace(first.fit, alternatives=ways),
        z=np.concatenate([part.z for part in parts], axis=1),
        log_density=np.concatenate([part.log_density for part in parts], axis=1),
        draws=jax.tree.map(lambda *each: np.concatenate(each, axis=1), *(part.draws for part in parts)),
        weights=np.concatenate([p * part.weights for p, part in zip(chance, parts, strict=True)], axis=1),
        convergence=_joined(parts, chance),
        way=np.concatenate([np.full(part.weights.shape, k) for k, part in enumerate(parts)], axis=1),
        seconds=sum(part.seconds for part in parts),
    )


def _joined(parts: Sequence[Posterior], chance: np.ndarray) -> Reweighted:
    """Build the diagnosis of a mixture: that of its first part, with the Monte Carlo errors of the mixture.

    Parts may share draws; the weights of a shared draw are added.
    """
    first = parts[0]
    diagnosis = first.convergence
    assert isinstance(diagnosis, Reweighted)
    names = list(diagnosis.monte_carlo_error)
    if not names:
        return diagnosis
    weights, rows = [chance[0] * first.weights[0]], [np.stack([first.by_name[name] for name in names], axis=1)]
    for p, part in zip(chance[1:], parts[1:], strict=True):
        count = part.weights.size
        if np.array_equal(part.z[0], first.z[0, :count]):
            weights[0][:count] += p * part.weights[0]
        else:
            weights.append(p * part.weights[0])
            rows.append(np.stack([part.by_name[name] for name in names], axis=1))
    errors = monte_carlo_errors(names, weighted_summary(np.concatenate(rows), np.concatenate(weights)))
    unknown, known = uncertain(errors), diagnosis.importance
    if unknown and known.accepted:
        rough = all(error.roughly_known for error in errors.values())
        known = replace(known, accepted=False, missing=unknown, answer="rough" if rough else "laplace")
    return replace(diagnosis, importance=known, monte_carlo_error=errors)
