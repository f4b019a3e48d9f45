"""The run of a chain: extended by steps of its walkers until it has converged."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import ClassVar

import numpy as np

from tvsbayes.inference.chain import Chain
from tvsbayes.inference.density import Density, Proposal
from tvsbayes.inference.diagnosis import ESS_LIMIT, TAU_LIMIT, diagnose, steps_wanted
from tvsbayes.inference.importance import ImportanceRun, Sample
from tvsbayes.inference.walkers import Walkers
from tvsbayes.progress import Advance, OpenEnded
from tvsbayes.results.convergence import Convergence
from tvsbayes.results.records import Tier
from tvsbayes.results.tiers import CHAIN

FIRST_CHECK = 200
GROWTH_RANGE = 1.1, 1.6
"""Steps at the first test of convergence; least and largest growth of the chain from one test to the next."""
LENGTHENING_RANGE = 1.05, 1.6
"""Growth where only autocorrelation times were computed, which takes little time."""
MARGIN = 1.1
"""Factor on the steps that a test of convergence predicts to be needed."""
SETTLED = 4
"""A chain with this many times the required effective draws that still disagrees will not come to agree."""
BLOCK, CHECKPOINT_SECONDS = 50, 20.0
"""Largest number of steps between two looks at the clock; least time between two checkpoints."""


def lengthening(convergence: Convergence) -> float:
    """Estimate the factor in length by which a chain meets the limits of autocorrelation times and effective draws."""
    wanted = TAU_LIMIT * convergence.tau_steps / (convergence.steps - convergence.discarded)
    for ess in (convergence.ess_bulk, convergence.ess_tail):
        wanted = max(wanted, ESS_LIMIT / min(ess.values()))
    return max(wanted, *(error.rounds_factor for error in convergence.monte_carlo_error.values()), 0.0)


def next_look(chain: Chain, convergence: Convergence) -> int:
    """Choose the number of steps at which to test convergence again; it depends on the chain alone."""
    wanted = lengthening(convergence)
    # Where the chain is long enough but fails otherwise, a little more length will not help.
    growth = np.clip(MARGIN * wanted if 1 < wanted < np.inf else np.inf, *GROWTH_RANGE)
    return int(np.ceil(len(chain.w) * growth))


class Run[D: Density]:
    """One call of a sampler: steps in blocks, tests of convergence on a schedule that depends on the chain alone.

    A chain of another tier states its name in `tier` and the steps of its walkers in `proposal`.
    """

    tier: ClassVar[Tier] = CHAIN

    def __init__(
        self,
        start: ImportanceRun[D],
        chain: Chain | None,
        keep: Callable[[Chain], None] | None,
        advance: Advance,
        began: float,
    ):
        self.start, self.keep, self.advance, self.began = start, keep, advance, began
        density = start.density
        positions = start.starts(density.walkers)
        walkers, dimension = positions.shape
        if chain is None:
            state = np.random.RandomState(start.seed).get_state()
            empty = np.zeros((0, walkers, dimension))
            chain = Chain(empty, np.zeros((0, walkers)), np.zeros(walkers), state, 0, 0.0, FIRST_CHECK)
        self.before, self.goal, self.saved_at, self.ended = chain, chain.goal, began, False
        self.invalid = density.invalid
        self.walkers = Walkers(density, self.proposal, positions, chain)

    @property
    def proposal(self) -> Proposal:
        """Return the proposal whose steps the walkers take."""
        return self.start.proposal

    def chain(self) -> Chain:
        """Return all steps so far, earlier runs included."""
        chain = replace(self.walkers.chain, goal=self.goal)
        if len(chain.w) == len(self.before.w):
            return chain
        seconds = self.before.seconds + time.monotonic() - self.began
        return replace(chain, invalid=self.before.invalid + self.start.density.invalid - self.invalid, seconds=seconds)

    def save(self) -> None:
        """Write the checkpoint, if one is kept."""
        if self.keep is not None:
            self.keep(self.chain())
        self.saved_at = time.monotonic()

    def look(self) -> Sample:
        """Diagnose the sample so far, and set whether the run has ended, or else the next test."""
        chain = self.chain()
        sample = diagnose(self.start, chain, self.tier)
        convergence = sample.convergence
        assert isinstance(convergence, Convergence)
        self.ended = not convergence.missing or hopeless(convergence)
        if not self.ended and len(chain.w) >= self.goal:
            self.goal = next_look(chain, convergence)
        return sample

    def too_short(self) -> bool:
        """Whether autocorrelation times alone require more steps; then the next test is set."""
        chain = self.chain()
        growth = steps_wanted(chain) / len(chain.w)
        if growth <= 1:
            return False
        self.goal = int(np.ceil(len(chain.w) * np.clip(growth, *LENGTHENING_RANGE)))
        return True

    def until_converged(self, seconds: float) -> Sample:
        """Extend the chain and test its convergence, until it has converged or the time is over."""
        done, towards = len(self.before.w), OpenEnded()
        # An interrupted chain is first extended to its next test, so that it ends where an uninterrupted run ends.
        if done >= self.goal and not self.too_short():
            sample = self.look()
            if self.ended:
                return sample
        try:
            while True:
                steps = min(BLOCK, self.goal - done)
                self.walkers.advance(steps)
                done += steps
                elapsed = time.monotonic() - self.began
                over = elapsed > seconds
                if over or (done >= self.goal and not self.too_short()):
                    sample = self.look()
                    if self.ended or over:
                        self.save()
                        return sample
                elif time.monotonic() - self.saved_at > CHECKPOINT_SECONDS:
                    self.save()
                self.advance(max(towards.share(done, self.goal), elapsed / seconds))
        except KeyboardInterrupt:
            self.save()
            raise


def hopeless(convergence: Convergence) -> bool:
    """Whether a chain far longer than required fails by its disagreement with importance sampling alone."""
    disagrees = convergence.agreement is not None and not convergence.agreement.agrees
    return disagrees and len(convergence.missing) == 1 and SETTLED * lengthening(convergence) <= 1
