"""The posterior of a fit: weighted draws, and a chain on request or where they are not accepted.

The chain starts from the weighted draws and must agree with them.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax

from tvsbayes.errors import NotConverged, require_kind
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.inference.chain import better, run_of
from tvsbayes.posterior.chain import stored_chain, write_chain
from tvsbayes.posterior.draws import Posterior
from tvsbayes.posterior.homing_mixture import homing_mixture
from tvsbayes.posterior.target import importance_run
from tvsbayes.progress import Job, Show
from tvsbayes.results.convergence import Convergence, Reweighted
from tvsbayes.results.records import Tier
from tvsbayes.results.tiers import CHAIN, IMPORTANCE, TIERS

DRAWING = "drawing weighted samples"
DRAWN_SECONDS, WALKED_SECONDS = 3.0, 8.0
"""Seconds of the stages, for the progress display."""


def sampling_stages(tier: Tier | None) -> dict[str, float]:
    """Return the stages of sampling with their seconds; a chain that only a refusal brings is not expected."""
    return {DRAWING: DRAWN_SECONDS, walking(tier or CHAIN): 0.0 if tier in (None, IMPORTANCE) else WALKED_SECONDS}


def walking(tier: Tier) -> str:
    """Return the name of the stage of a chain."""
    return f"sampling with {tier}"


def sample(
    fit: JointFit,
    tier: Tier | None = None,
    *,
    max_minutes: float = 10.0,
    seed: int = 0,
    checkpoint: Path | None = None,
    resume: bool = False,
    progress: Show | None = None,
    first: Callable[[Posterior], None] | None = None,
) -> Posterior:
    """Sample the posterior of a fit (formulation 4.3).

    Args:
        fit: a converged fit.
        tier: None draws weighted independent draws, and runs a chain only where they are not accepted; "importance"
            never runs one; "emcee" always does. A chain starts from the weighted draws, is extended until it has
            converged, and must agree with them.
        max_minutes: time for this call; a chain that has not converged by then is returned as it is.
        seed: seed of all random numbers. The same fit, seed and versions give the same draws bit for bit.
        checkpoint: file in which the chain is kept as it grows (written whole or not at all), also on Ctrl-C.
        resume: continue the chain of `checkpoint`, whatever the answer of the weighted draws.
        progress: called with the share that is done: rounds of draws towards the effective draws required, steps of the
            chain towards its next test.
        first: called with the posterior of importance sampling before the chain starts.

    Returns:
        The posterior: `.propagate` for any quantity, `.by_name` for the draws. `convergence.answer` says whether its
        intervals are accepted or rough; with `converged` False they must not be used. `data_tree` of
        `posterior.arviz_tree` is the tree for ArviZ.

    Raises:
        TypeError: an argument has the wrong type.
        NotConverged: the fit has not converged, or its density is not finite around the mode.
        InputError: `resume` without a usable chain.
        ValueError: no such tier, max_minutes is not positive, or a chain's option without a chain.
    """
    require_kind(fit, "converged", "a fit, as fit(campaign) returns it")
    if not fit.converged:
        raise NotConverged.of(fit.problems, "a posterior needs a mode to start from")
    if tier not in (None, *TIERS):
        raise ValueError(f"tier {tier!r}; allowed: {', '.join(TIERS)}")
    if not max_minutes > 0:
        raise ValueError(f"max_minutes is {max_minutes}; it must be positive")
    if resume and checkpoint is None:
        raise ValueError("resume needs the checkpoint to continue")
    if tier == IMPORTANCE and checkpoint is not None:
        raise ValueError("importance sampling has no chain to keep or to resume")
    began = time.monotonic()
    with jax.enable_x64(True), Job(sampling_stages(tier), progress) as job:
        if resume and checkpoint is not None:
            start, chain = stored_chain(checkpoint, fit, seed, tier or CHAIN)
        else:
            job.begin(DRAWING)
            start, chain = importance_run(fit, seed, job.at), None
        early = homing_mixture(start)
        accepted = early.convergence.answer == "accepted" and not resume
        if tier == IMPORTANCE or (tier is None and accepted):
            return early
        if first is not None:
            first(early)
        sampler = tier or CHAIN
        run = run_of(sampler)
        job.begin(walking(sampler))
        keep = None if checkpoint is None else partial(write_chain, checkpoint, fit, start, sampler)
        walked = start.density.posterior(run(start, chain, keep, job.at, began).until_converged(60 * max_minutes), seed)
        convergence = walked.convergence
        assert isinstance(convergence, Convergence)
        agreement = convergence.agreement
        # A chain has one homing hypothesis only; where others have weight, the weighted draws of all are the result.
        mixed = len(early.fit.mixture) > 1 and walked.converged and (agreement is None or agreement.agrees)
        result = early if mixed else better(early, walked)
        if isinstance(result.convergence, Reweighted):
            return replace(result, convergence=replace(result.convergence, agreement=agreement))
        return result
