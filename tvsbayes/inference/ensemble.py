"""The run of a chain: emcee's ensemble with moves of its own, extended until it has converged.

The walkers form groups that never use one another, so that R-hat compares independent chains.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import ClassVar

import emcee
import numpy as np

from tvsbayes.inference.chain import GROUPS, Chain
from tvsbayes.inference.density import Density, Proposal
from tvsbayes.inference.diagnosis import ESS_LIMIT, TAU_LIMIT, diagnose, steps_wanted
from tvsbayes.inference.importance import Pool, Sample
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


class GroupEvolution(emcee.moves.DEMove):
    """Differential evolution (ter Braak, Statistics and Computing 16 (2006) 239) within groups of neighbours.

    Both halves of the ensemble, the walkers of even and of odd number, hold the same share of every group: a walker's
    partners are those of its group in the other half.
    """

    def __init__(self):
        # With fewer walkers than twice the dimension, differential evolution explores a subspace only; all other moves
        # leave it.
        super().__init__(randomize_split=False, live_dangerously=True)

    def get_proposal(
        self, s: np.ndarray, c: list[np.ndarray], random: np.random.RandomState
    ) -> tuple[np.ndarray, np.ndarray]:
        """Propose new positions for the half s, given the other, as `emcee.moves.RedBlueMove` requires."""
        others = np.split(np.concatenate(c), GROUPS)
        moved = [
            super(GroupEvolution, self).get_proposal(half, [other], random)[0]
            for half, other in zip(np.split(s, GROUPS), others, strict=True)
        ]
        return np.concatenate(moved), np.zeros(len(s))


def moves(proposal: Proposal) -> list[tuple[emcee.moves.Move, float]]:
    """Return the proposal's steps and, for the remaining share, differential evolution, which needs no proposal.

    Never emcee 3.1.6's snooker or full-covariance Gaussian: both are biased.
    """
    steps = [(emcee.moves.MHMove(step), share) for step, share in proposal.steps]
    rest = 1 - sum(share for _, share in steps)
    return [*steps, (GroupEvolution(), rest)] if rest > 0 else steps


class Run[D: Density]:
    """One call of a sampler: steps in blocks, tests of convergence on a schedule that depends on the chain alone.

    A chain of another tier states its name in `tier` and the steps of its walkers in `proposal`.
    """

    tier: ClassVar[Tier] = CHAIN

    def __init__(
        self,
        start: Pool[D],
        chain: Chain | None,
        keep: Callable[[Chain], None] | None,
        advance: Advance,
        began: float,
    ):
        self.start, self.keep, self.advance, self.began = start, keep, advance, began
        density = start.density
        positions = start.starts(density.walkers)
        if chain is None:
            walkers, state = len(positions), np.random.RandomState(start.seed).get_state()
            chain = Chain(
                np.zeros((0, *positions.shape)), np.zeros((0, walkers)), np.zeros(walkers), state, 0, 0.0, FIRST_CHECK
            )
        self.before, self.goal, self.saved_at, self.ended = chain, chain.goal, began, False
        self.invalid = density.invalid
        self.sampler = emcee.EnsembleSampler(*positions.shape, density, moves=moves(self.proposal), vectorize=True)
        # emcee's wrapper prints the walkers and a traceback for every exception, Ctrl-C among them.
        self.sampler.log_prob_fn = density
        ended = (chain.w[-1], chain.log_density[-1]) if len(chain.w) else (positions,)
        self.state = emcee.State(*ended, random_state=chain.random_state)

    @property
    def proposal(self) -> Proposal:
        """Return the proposal whose steps the walkers take."""
        return self.start.proposal

    def walk(self, steps: int) -> None:
        """Continue from the last whole step, with the generator's state there."""
        state = self.sampler.get_last_sample() if self.sampler.iteration else self.state
        for _ in self.sampler.sample(state, iterations=steps, skip_initial_state_check=True):
            pass

    def chain(self) -> Chain:
        """Return all steps so far, earlier runs included."""
        before, backend = self.before, self.sampler.backend
        if backend.iteration == 0:
            return replace(before, goal=self.goal)
        return Chain(
            w=np.concatenate([before.w, backend.get_chain()]),
            log_density=np.concatenate([before.log_density, backend.get_log_prob()]),
            accepted=before.accepted + backend.accepted,
            random_state=backend.random_state,
            invalid=before.invalid + self.start.density.invalid - self.invalid,
            seconds=before.seconds + time.monotonic() - self.began,
            goal=self.goal,
        )

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
                self.walk(steps)
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
