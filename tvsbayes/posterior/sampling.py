"""The posterior sampled until it has converged: the loop, its checkpoint and its diagnosis.

emcee samples in coordinates w in which the posterior is nearly standard normal (`posterior.transport`). Arrays of draws
are ordered (chain, draw, ...); a chain is a walker. Convergence is judged on the stored draws, so that what ArviZ
computes from `posterior.nc` is what was judged.
"""

from __future__ import annotations

import hashlib
import io
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, fields
from importlib.metadata import version
from pathlib import Path

import emcee
import jax
import numpy as np
from arviz_stats.base import array_stats

from tvsbayes.errors import InputError, NotConverged, escaped
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.files.disk import read_arrays, write_atomically
from tvsbayes.instrument.campaign import input_hashes
from tvsbayes.instrument.parameters import NAMES
from tvsbayes.posterior.draws import Draws, Posterior, derived_at
from tvsbayes.posterior.proposal import Independence, Pilot, Target, moves, pilot
from tvsbayes.posterior.ridges import transport
from tvsbayes.posterior.transport import Transport
from tvsbayes.results.convergence import Convergence

CHAIN_FORMAT = "tvsbayes-chain/4"
CHAIN_BYTES_MAX = 2**32
"""A chain is the user's own file: what was in memory when it was written fits there again."""
RHAT_LIMIT = 1.01
ESS_LIMIT = 1000
TAU_LIMIT = 50
"""Limits of formulation 4.3: rank R-hat by walker, bulk and tail effective draws, steps in autocorrelation times."""
STUCK_ACCEPTANCE = 0.25
"""A walker is stuck that accepts less than this share of what the median walker accepts ..."""
STUCK_DEVIATION = 8.0
"""... or whose mean log density lies this many median absolute deviations, and a standard deviation of a single draw,
off the others': the means of long chains spread so little that one rare excursion would fail the first alone."""
FIRST_CHECK = 300
GROWTH = 1.3
"""Steps at the first look at convergence, and growth of the chain from one look to the next."""
BLOCK = 50
CHECKPOINT_SECONDS = 20.0
STORED_DRAWS = 256
"""Draws stored per walker: from this many to twice as many. R-hat by walker needs about 150 effective draws of each."""


@dataclass(frozen=True)
class Progress:
    """What a progress display shows.

    `worst_ess` is None before the first check; seconds since the start, and left until the next check.
    """

    steps: int
    expected_steps: int
    worst_ess: float | None
    seconds: float
    seconds_left: float


@dataclass(frozen=True)
class Chain:
    """Everything a run has done, in w: enough to continue it bit for bit.

    Attributes:
        w: positions, shape (steps, walkers, d); log_density: relative to the mode, shape (steps, walkers).
        accepted: accepted moves by walker.
        random_state: NumPy's legacy generator after the last step.
        invalid: evaluations that gave no number.
        seconds: spent so far.
    """

    w: np.ndarray
    log_density: np.ndarray
    accepted: np.ndarray
    random_state: tuple
    invalid: int
    seconds: float


def fingerprint(fit: JointFit) -> str:
    """Hash of what a chain depends on: data, weights, model options and priors, versions of what computes it."""
    digest = hashlib.sha256(json.dumps(input_hashes(fit.campaign), sort_keys=True).encode())
    for array in (*jax.tree.leaves(fit.space), *jax.tree.leaves(fit.arrays), fit.free):
        array = np.asarray(array)
        digest.update(f"{array.dtype} {array.shape}".encode() + np.ascontiguousarray(array).tobytes())
    for package in ("tvsbayes", "emcee", "jax", "numpy"):
        digest.update(f"{package} {version(package)}".encode())
    return digest.hexdigest()


def _checkpoint(path: Path, fit: JointFit, route: Transport, start: Pilot, chain: Chain, seed: int) -> None:
    buffer = io.BytesIO()
    kind, keys, position, has_gauss, gauss = chain.random_state
    np.savez(
        buffer,
        format=CHAIN_FORMAT,
        fingerprint=fingerprint(fit),
        seed=seed,
        **{f"transport_{f.name}": getattr(route, f.name) for f in fields(Transport)},
        proposal_mean=start.proposal.mean,
        proposal_sd=start.proposal.sd,
        start=start.start,
        log_weights=start.log_weights,
        w=chain.w,
        log_density=chain.log_density,
        accepted=chain.accepted,
        invalid=chain.invalid,
        seconds=chain.seconds,
        random_kind=kind,
        random_keys=keys,
        random_rest=np.array([position, has_gauss, gauss]),
    )
    write_atomically(path, buffer.getvalue())


def stored_chain(path: Path, fit: JointFit, seed: int) -> tuple[Transport, Pilot, Chain]:
    """Read a checkpoint; refuse one of other data, model, priors, versions or seed."""
    name = escaped(path.name)
    if not path.exists():
        raise InputError("no-chain", f"{name}: there is no chain to resume", file=name, remedy="run without --resume")
    try:
        stored = read_arrays(path, CHAIN_BYTES_MAX, CHAIN_BYTES_MAX)
        if str(stored["format"]) != CHAIN_FORMAT:
            raise ValueError(f"format {str(stored['format'])[:60]!r}")
        same = str(stored["fingerprint"]) == fingerprint(fit) and int(stored["seed"]) == seed
        position, has_gauss, gauss = stored["random_rest"]
        random_state = (str(stored["random_kind"]), stored["random_keys"], int(position), int(has_gauss), float(gauss))
        route = Transport(**{f.name: stored[f"transport_{f.name}"] for f in fields(Transport)})
        proposal = Independence(stored["proposal_mean"], stored["proposal_sd"], route.heavy)
        chain = Chain(
            stored["w"],
            stored["log_density"],
            stored["accepted"],
            random_state,
            int(stored["invalid"]),
            float(stored["seconds"]),
        )
        pilot = Pilot(proposal, stored["start"], stored["log_weights"])
        steps, walkers, width = chain.w.shape
        if chain.log_density.shape != (steps, walkers) or pilot.start.shape[1:] != (width,):
            raise ValueError(f"{steps} steps of {walkers} walkers with parts of other lengths")
    except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
        raise InputError(
            "damaged-chain",
            f"{name} is not a chain that tvsbayes wrote: {escaped(str(error), 200)}",
            file=name,
            allowed=f"format {CHAIN_FORMAT}",
            remedy="run without --resume; the chain starts anew",
        ) from error
    if not same:
        raise InputError(
            "other-chain",
            f"{name} was sampled from other data, another model, other priors, another seed or other versions",
            file=name,
            allowed="the chain of the same campaign, options and versions",
            remedy="run without --resume, or restore the inputs and options it was started with",
        )
    return route, pilot, chain


def _tau(w: np.ndarray) -> float:
    """Longest integrated autocorrelation time of positions (steps, walkers, d), steps; infinite if none moved.

    A walker that never moved has no autocorrelation; it is found by its acceptance.
    """
    moved = np.ptp(w[:, :, 0], axis=0) > 0
    if not moved.any():
        return float("inf")
    return float(np.max(emcee.autocorr.integrated_time(w[:, moved], tol=0, quiet=True)))


def diagnose(fit: JointFit, route: Transport, start: Pilot, chain: Chain, seed: int) -> Posterior:
    """Leave out the warm-up, thin, and judge what is left."""
    steps = len(chain.w)
    discarded = int(min(steps // 4, max(20.0, 5 * _tau(chain.w))))
    kept = chain.w[discarded:]
    thin = max(1, len(kept) // STORED_DRAWS)
    stored = kept[::thin].transpose(1, 0, 2)
    walkers, draws, dimension = stored.shape
    found = route.mapped(stored.reshape(-1, dimension))
    z = found.z.reshape(walkers, draws, -1)
    log_density = chain.log_density[discarded:][::thin].T + fit.log_density - found.log_jacobian.reshape(walkers, draws)
    derived = derived_at(fit, z, fit.reference_pose_rad)
    columns = {**Draws(derived), "log_density": log_density.ravel()}
    fixed = {NAMES[i] for i in np.flatnonzero(~fit.free)}
    names = [name for name, column in columns.items() if name not in fixed and np.ptp(column) > 0]
    values = np.stack([columns[name].reshape(walkers, draws) for name in names], axis=2)
    axes = {"chain_axis": 0, "draw_axis": 1}
    rhat = array_stats.rhat(values, method="rank", **axes)
    ess_bulk = array_stats.ess(values, method="bulk", **axes)
    ess_tail = array_stats.ess(values, method="tail", prob=(0.05, 0.95), **axes)
    tau = _tau(kept)
    acceptance = chain.accepted / steps
    means = chain.log_density[discarded:].mean(axis=0)
    deviation = np.abs(means - np.median(means))
    stuck = acceptance < STUCK_ACCEPTANCE * np.median(acceptance)
    single_draw = float(np.median(chain.log_density[discarded:].std(axis=0)))
    stuck |= deviation > max(STUCK_DEVIATION * float(np.median(deviation)), single_draw)
    missing = []
    if not np.max(rhat) <= RHAT_LIMIT:
        missing.append(f"R-hat of {names[int(np.nanargmax(rhat))]} is {np.max(rhat):.4f}, wanted {RHAT_LIMIT}")
    for kind, ess in (("bulk", ess_bulk), ("tail", ess_tail)):
        if not np.min(ess) >= ESS_LIMIT:
            least = int(np.nanargmin(ess))
            missing.append(f"{names[least]} has {ess[least]:.0f} {kind} effective draws, wanted {ESS_LIMIT}")
    if not len(kept) >= TAU_LIMIT * tau:
        missing.append(f"{len(kept)} steps are {len(kept) / tau:.0f} autocorrelation times, wanted {TAU_LIMIT}")
    if stuck.any():
        missing.append(f"stuck walkers: {', '.join(map(str, np.flatnonzero(stuck)))}")
    # ArviZ takes the negative of the log weights, as `loo` hands them over.
    finite = start.log_weights[np.isfinite(start.log_weights)]
    convergence = Convergence(
        steps=steps,
        discarded=discarded,
        thin=thin,
        tau_steps=tau,
        rhat=dict(zip(names, map(float, rhat), strict=True)),
        ess_bulk=dict(zip(names, map(float, ess_bulk), strict=True)),
        ess_tail=dict(zip(names, map(float, ess_tail), strict=True)),
        acceptance=acceptance,
        stuck_walkers=tuple(int(i) for i in np.flatnonzero(stuck)),
        invalid=chain.invalid,
        pareto_k=float(array_stats.psislw(-finite)[1]),
        missing=tuple(missing),
    )
    return Posterior(fit, z, log_density, derived, convergence, seed, chain.seconds)


def sample(
    fit: JointFit,
    *,
    max_minutes: float = 10.0,
    seed: int = 0,
    checkpoint: Path | None = None,
    resume: bool = False,
    progress: Callable[[Progress], None] | None = None,
) -> Posterior:
    """Sample the posterior of a fit until it has converged or the time is over (formulation 4.3).

    Args:
        fit: a converged fit.
        max_minutes: time for this call; the chain is extended until all limits are met.
        seed: of everything random. The same fit, seed and versions give the same chain bit for bit.
        checkpoint: file in which the chain is kept as it grows (written whole or not at all), also on Ctrl-C.
        resume: continue the chain of `checkpoint`.
        progress: called after every block of steps.

    Returns:
        The posterior: `.propagate` for any quantity, `.by_name` for the draws; with `converged` False its intervals
        must not be used. `write_posterior` makes a file for ArviZ of it.

    Raises:
        NotConverged: the fit has not converged, or its density is not finite around the mode.
        InputError: `resume` without a usable chain.
        ValueError: max_minutes is not positive.
    """
    if not fit.converged:
        raise NotConverged.of(fit.problems, "a posterior needs a mode to start from")
    if not max_minutes > 0:
        raise ValueError(f"max_minutes is {max_minutes}; it must be positive")
    began = time.monotonic()
    with jax.enable_x64(True):
        if resume:
            if checkpoint is None:
                raise ValueError("resume needs the checkpoint to continue")
            route, start, chain = stored_chain(checkpoint, fit, seed)
        else:
            route = transport(fit)
            try:
                start = pilot(Target(fit, route), seed)
            except FloatingPointError as error:
                raise NotConverged("no-density", str(error), remedy="see the weak directions of --no-sample") from error
            walkers = len(start.start)
            state = np.random.RandomState(seed).get_state()
            empty = np.zeros((0, walkers, route.dimension))
            chain = Chain(empty, np.zeros((0, walkers)), np.zeros(walkers), state, 0, 0.0)
        run = _Run(fit, route, start, chain, seed, checkpoint, progress, began)
        return run.until_converged(60 * max_minutes)


class _Run:
    """One call of `sample`: emcee in blocks, checks on a schedule that depends on the chain alone."""

    def __init__(self, fit, route, start, chain, seed, checkpoint, progress, began):
        self.fit, self.route, self.start, self.seed = fit, route, start, seed
        self.checkpoint, self.progress, self.began = checkpoint, progress, began
        self.before, self.saved_at = chain, began
        self.target = Target(fit, route)
        walkers, dimension = start.start.shape
        self.sampler = emcee.EnsembleSampler(
            walkers, dimension, self.target, moves=moves(start.proposal), vectorize=True
        )
        # emcee's wrapper prints the walkers and a traceback for every exception, Ctrl-C among them.
        self.sampler.log_prob_fn = self.target

    def chain(self) -> Chain:
        """All steps so far, earlier runs included."""
        done = self.sampler.iteration
        seconds = self.before.seconds + time.monotonic() - self.began
        if done == 0:
            return self.before
        backend = self.sampler.backend
        return Chain(
            np.concatenate([self.before.w, backend.get_chain()]),
            np.concatenate([self.before.log_density, backend.get_log_prob()]),
            self.before.accepted + backend.accepted,
            backend.random_state,
            self.before.invalid + self.target.invalid,
            seconds,
        )

    def save(self) -> None:
        """Write the checkpoint, if one is kept."""
        if self.checkpoint is not None:
            _checkpoint(self.checkpoint, self.fit, self.route, self.start, self.chain(), self.seed)
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
            state = emcee.State(self.start.start, random_state=self.before.random_state)
        for _ in self.sampler.sample(state, iterations=steps, skip_initial_state_check=True):
            pass

    def until_converged(self, seconds: float) -> Posterior:
        """Extend, look, extend."""
        goal, worst_ess = FIRST_CHECK, None
        done = len(self.before.w)
        while goal < done:
            goal = int(goal * GROWTH)
        # A chain interrupted between two looks is first brought to the next: it ends where an unbroken run ends.
        if goal == done:
            goal = int(goal * GROWTH)
            posterior = diagnose(self.fit, self.route, self.start, self.before, self.seed)
            if posterior.converged:
                return posterior
        try:
            while True:
                steps = min(BLOCK, goal - done)
                self.advance(steps)
                done += steps
                elapsed = time.monotonic() - self.began
                over = elapsed > seconds
                if done >= goal or over:
                    posterior = diagnose(self.fit, self.route, self.start, self.chain(), self.seed)
                    worst_ess = min(posterior.convergence.ess_bulk.values())
                    if posterior.converged or over:
                        self.save()
                        return posterior
                    goal = int(goal * GROWTH)
                elif time.monotonic() - self.saved_at > CHECKPOINT_SECONDS:
                    self.save()
                if self.progress is not None:
                    left = (goal - done) * elapsed / max(done - len(self.before.w), 1)
                    self.progress(Progress(done, goal, worst_ess, elapsed, min(left, seconds - elapsed)))
        except KeyboardInterrupt:
            self.save()
            raise
