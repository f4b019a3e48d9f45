"""Importance sampling of a fit, by the map of `posterior.transport`."""

from __future__ import annotations

import time
from dataclasses import replace

from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.inference.importance import ImportanceRun, weighted_run
from tvsbayes.posterior.target import Target
from tvsbayes.posterior.transport import transport
from tvsbayes.progress import Advance, unshown

MAPPED_SHARE = 0.25
"""Share of the time for the map to nearly normal coordinates, for the progress display."""


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
