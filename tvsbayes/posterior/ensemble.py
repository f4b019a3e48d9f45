"""The ensemble of walkers: its moves, and the run that extends a chain until it has converged.

Coordinates w of `posterior.transport`. The walkers form groups that never use one another, so that R-hat compares
independent chains.
"""

from __future__ import annotations

import time
from pathlib import Path

import emcee
import numpy as np

from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.model.compiled import BATCH
from tvsbayes.posterior.chain import Chain, write_chain
from tvsbayes.posterior.diagnosis import ESS_LIMIT, GROUPS, TAU_LIMIT, diagnose, steps_wanted
from tvsbayes.posterior.draws import Posterior
from tvsbayes.posterior.importance import ImportanceRun
from tvsbayes.posterior.proposal import Independence, Target
from tvsbayes.progress import Advance, OpenEnded
from tvsbayes.results.convergence import Convergence

WALKERS = 64
SHARES = (0.6, 0.35, 0.05)
"""All coordinates anew from the proposal, some of them, differential evolution.

Where the proposal is too thin a walker stays for as many steps as its weight says, and effective draws of the tails are
lost: new values of some coordinates lead out of there. Differential evolution needs no proposal.
"""
FIRST_CHECK = 200
GROWTH_RANGE = 1.1, 1.6
"""Steps at the first look at convergence; least and largest growth of the chain from one look to the next."""
LENGTHENING_RANGE = 1.05, 1.6
"""The same where only autocorrelation times were looked at, which takes little."""
MARGIN = 1.1
"""On the steps that a look says are needed."""
SETTLED = 4
"""Times the effective draws that are wanted, with which a chain that still disagrees will not come to agree."""
BLOCK = 50
CHECKPOINT_SECONDS = 20.0


class GroupEvolution(emcee.moves.DEMove):
    """Differential evolution (ter Braak, Statistics and Computing 16 (2006) 239) within groups of neighbours.

    Both halves of the ensemble, the walkers of even and of odd number, hold the same share of every group: a walker's
    partners are those of its group in the other half.
    """

    def __init__(self):
        # Fewer walkers than twice the dimension let differential evolution explore a subspace only; all other moves
        # leave it.
        super().__init__(randomize_split=False, live_dangerously=True)

    def get_proposal(
        self, s: np.ndarray, c: list[np.ndarray], random: np.random.RandomState
    ) -> tuple[np.ndarray, np.ndarray]:
        """The protocol of `emcee.moves.RedBlueMove`: new places for the half s, given the other."""
        others = np.split(np.concatenate(c), GROUPS)
        moved = [
            super(GroupEvolution, self).get_proposal(own, [other], random)[0]
            for own, other in zip(np.split(s, GROUPS), others, strict=True)
        ]
        return np.concatenate(moved), np.zeros(len(s))


def moves(proposal: Independence) -> list[tuple[emcee.moves.Move, float]]:
    """The moves and their shares; never emcee 3.1.6's snooker or full-covariance Gaussian (both are biased)."""
    independent = (emcee.moves.MHMove(each) for each in (proposal, proposal.renewed))
    return list(zip((*independent, GroupEvolution()), SHARES, strict=True))


def walkers_for(dimension: int) -> int:
    """Ensemble size: at least half as many walkers as dimensions, whole batches and whole groups in each half."""
    return max(WALKERS, 2 * BATCH * -(-dimension // (4 * BATCH)))


def lengthening(found: Convergence) -> float:
    """How many times longer a chain must be to have the autocorrelation times and effective draws that are wanted."""
    wanted = TAU_LIMIT * found.tau_steps / (found.steps - found.discarded)
    for ess in (found.ess_bulk, found.ess_tail):
        wanted = max(wanted, ESS_LIMIT / min(ess.values()))
    return max(wanted, *(error.rounds_factor for error in found.monte_carlo_error.values()), 0.0)


def next_look(chain: Chain, found: Convergence) -> int:
    """Steps at which a chain that has not converged is worth another look; depends on the chain alone."""
    wanted = lengthening(found)
    # Where length is not what it lacks, a little more will not help either.
    growth = np.clip(MARGIN * wanted if 1 < wanted < np.inf else np.inf, *GROWTH_RANGE)
    return int(np.ceil(len(chain.w) * growth))


class Run:
    """One call of `sampling.sample`: emcee in blocks, looks on a schedule that depends on the chain alone."""

    def __init__(
        self,
        fit: JointFit,
        start: ImportanceRun,
        chain: Chain | None,
        checkpoint: Path | None,
        advance: Advance,
        began: float,
    ):
        self.fit, self.start = fit, start
        self.checkpoint, self.told, self.began = checkpoint, advance, began
        self.positions = start.starts(walkers_for(start.path.dimension))
        walkers, dimension = self.positions.shape
        if chain is None:
            state = np.random.RandomState(start.posterior.seed).get_state()
            empty = np.zeros((0, walkers, dimension))
            chain = Chain(empty, np.zeros((0, walkers)), np.zeros(walkers), state, 0, 0.0, FIRST_CHECK)
        self.before, self.goal, self.saved_at = chain, chain.goal, began
        self.target = Target(fit, start.path)
        self.sampler = emcee.EnsembleSampler(
            walkers, dimension, self.target, moves=moves(start.proposal), vectorize=True
        )
        # emcee's wrapper prints the walkers and a traceback for every exception, Ctrl-C among them.
        self.sampler.log_prob_fn = self.target

    def chain(self) -> Chain:
        """All steps so far, earlier runs included."""
        seconds = self.before.seconds + time.monotonic() - self.began
        if self.sampler.iteration == 0:
            return Chain(**{**vars(self.before), "goal": self.goal})
        backend = self.sampler.backend
        return Chain(
            np.concatenate([self.before.w, backend.get_chain()]),
            np.concatenate([self.before.log_density, backend.get_log_prob()]),
            self.before.accepted + backend.accepted,
            backend.random_state,
            self.before.invalid + self.target.invalid,
            seconds,
            self.goal,
        )

    def save(self) -> None:
        """Write the checkpoint, if one is kept."""
        if self.checkpoint is not None:
            write_chain(self.checkpoint, self.fit, self.start, self.chain())
        self.saved_at = time.monotonic()

    def advance(self, steps: int) -> None:
        """Continue from the last whole step; the generator goes on where it stood."""
        if self.sampler.iteration:
            state = self.sampler.get_last_sample()
        elif len(self.before.w):
            state = emcee.State(
                self.before.w[-1], log_prob=self.before.log_density[-1], random_state=self.before.random_state
            )
        else:
            state = emcee.State(self.positions, random_state=self.before.random_state)
        for _ in self.sampler.sample(state, iterations=steps, skip_initial_state_check=True):
            pass

    def look(self) -> tuple[Posterior, bool]:
        """The posterior so far, and whether it is the last word; else the next look is set."""
        chain = self.chain()
        posterior = diagnose(self.fit, self.start, chain)
        found = posterior.convergence
        assert isinstance(found, Convergence)
        if not found.missing or hopeless(found):
            return posterior, True
        if len(chain.w) >= self.goal:
            self.goal = next_look(chain, found)
        return posterior, False

    def too_short(self) -> bool:
        """Whether autocorrelation times alone ask for more steps; then the next look is set."""
        chain = self.chain()
        growth = steps_wanted(chain) / len(chain.w)
        if growth <= 1:
            return False
        self.goal = int(np.ceil(len(chain.w) * np.clip(growth, *LENGTHENING_RANGE)))
        return True

    def until_converged(self, seconds: float) -> Posterior:
        """Extend, look, extend."""
        done, towards = len(self.before.w), OpenEnded()
        # An interrupted chain is first brought to its next look: it ends where an unbroken run ends.
        if done >= self.goal and not self.too_short():
            posterior, ended = self.look()
            if ended:
                return posterior
        try:
            while True:
                steps = min(BLOCK, self.goal - done)
                self.advance(steps)
                done += steps
                elapsed = time.monotonic() - self.began
                over = elapsed > seconds
                if over or (done >= self.goal and not self.too_short()):
                    posterior, ended = self.look()
                    if ended or over:
                        self.save()
                        return posterior
                elif time.monotonic() - self.saved_at > CHECKPOINT_SECONDS:
                    self.save()
                self.told(max(towards.share(done, self.goal), elapsed / seconds))
        except KeyboardInterrupt:
            self.save()
            raise


def hopeless(found: Convergence) -> bool:
    """Whether nothing but the agreement with importance sampling is missing of a chain far longer than wanted."""
    disagrees = found.agreement is not None and not found.agreement.agrees
    return disagrees and len(found.missing) == 1 and SETTLED * lengthening(found) <= 1
