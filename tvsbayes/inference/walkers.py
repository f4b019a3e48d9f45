"""The walkers of a chain: emcee's ensemble with its moves, and the autocorrelation time.

No other module imports emcee. The walkers form groups that never use one another, so that R-hat compares independent
chains.
"""

from __future__ import annotations

from dataclasses import replace

import emcee
import numpy as np

from tvsbayes.inference.chain import GROUPS, Chain
from tvsbayes.inference.density import Density, Proposal


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


class Walkers:
    """The ensemble, started at the end of a chain, or at positions (walkers, d) where the chain has no steps."""

    def __init__(self, density: Density, proposal: Proposal, positions: np.ndarray, before: Chain):
        self.before = before
        self.sampler = emcee.EnsembleSampler(*positions.shape, density, moves=moves(proposal), vectorize=True)
        # emcee's wrapper prints the walkers and a traceback for every exception, Ctrl-C among them.
        self.sampler.log_prob_fn = density
        ended = (before.w[-1], before.log_density[-1]) if len(before.w) else (positions,)
        self.state = emcee.State(*ended, random_state=before.random_state)

    def advance(self, steps: int) -> None:
        """Continue from the last whole step, with the generator's state there."""
        state = self.sampler.get_last_sample() if self.sampler.iteration else self.state
        for _ in self.sampler.sample(state, iterations=steps, skip_initial_state_check=True):
            pass

    @property
    def chain(self) -> Chain:
        """Return the chain with all steps, earlier runs included."""
        before, backend = self.before, self.sampler.backend
        if backend.iteration == 0:
            return before
        return replace(
            before,
            w=np.concatenate([before.w, backend.get_chain()]),
            log_density=np.concatenate([before.log_density, backend.get_log_prob()]),
            accepted=before.accepted + backend.accepted,
            random_state=backend.random_state,
        )


def autocorrelation_time(x: np.ndarray) -> float:
    """Compute the integrated autocorrelation time of a coordinate (steps, walkers), steps."""
    return float(emcee.autocorr.integrated_time(x[:, :, None], tol=0, quiet=True)[0])
