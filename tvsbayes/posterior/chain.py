"""The file of a chain and its start, from which it continues bit for bit.

Coordinates w of `posterior.transport`; arrays of a chain are ordered (step, walker, ...).
"""

from __future__ import annotations

import hashlib
import io
import json
from pathlib import Path

import jax
import numpy as np

from tvsbayes.errors import InputError, escaped
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.files.disk import read_arrays, write_atomically
from tvsbayes.files.packages import version_of
from tvsbayes.inference.chain import Chain
from tvsbayes.inference.density import Points
from tvsbayes.inference.importance import ImportanceRun, Pool, Weighing
from tvsbayes.inference.proposal import Independence
from tvsbayes.inference.tables import Followers, Tables
from tvsbayes.instrument.campaign import input_hashes
from tvsbayes.posterior.target import Target
from tvsbayes.posterior.transport import transport
from tvsbayes.results.records import Tier
from tvsbayes.results.tiers import CHAIN

CHAIN_KIND = "tvsbayes-chain/"
CHAIN_FORMAT = f"{CHAIN_KIND}7"
CHAIN_BYTES_MAX = 2**32
"""Largest chain file read; it is the user's own and fitted into memory when it was written."""


def fingerprint(fit: JointFit, tier: Tier = CHAIN) -> str:
    """Hash all that a chain depends on: data, weights, model options and priors, tier, versions of the packages."""
    digest = hashlib.sha256(json.dumps(input_hashes(fit.campaign), sort_keys=True).encode())
    for array in (*jax.tree.leaves(fit.space), *jax.tree.leaves(fit.arrays), fit.free):
        array = np.asarray(array)
        digest.update(f"{array.dtype} {array.shape}".encode() + np.ascontiguousarray(array).tobytes())
    for package in ("tvsbayes", CHAIN, "jax", "numpy"):
        digest.update(f"{package} {version_of(package)}".encode())
    if tier != CHAIN:
        digest.update(tier.encode())
    return digest.hexdigest()


def _pool_arrays(pool: Pool) -> dict[str, np.ndarray]:
    """Convert a pool to arrays; the next proposal is the last of the proposals."""
    every = [each for each in (*pool.proposals, pool.next_proposal) if isinstance(each, Independence)]
    last = every[-1]
    return {
        "pool_w": pool.drawn.w,
        "pool_log_target": pool.drawn.log_target,
        "pool_place_errors_rad": pool.drawn.parts["place_errors_rad"],
        "pool_counts": np.array(pool.counts),
        "pool_invalid": np.array(pool.invalid),
        "proposal_mean": np.stack([each.mean for each in every]),
        "proposal_sd": np.stack([each.sd for each in every]),
        "proposal_places": last.places,
        "proposal_coupled": last.coupled,
        "proposal_tables": np.stack([each.tables.log_density for each in every]),
        "proposal_leader": last.followers.leader,
        "proposal_follower": last.followers.follower,
        "proposal_followers": np.stack([each.followers.log_density for each in every]),
        "proposal_origin": np.stack([each.origin for each in every]),
        "proposal_turn": np.stack([each.turn for each in every]),
    }


def _pool_of(stored: dict[str, np.ndarray], target: Target) -> Pool:
    """Build the pool from `_pool_arrays`."""
    names = "mean", "sd", "tables", "followers", "origin", "turn"
    rounds = zip(*(stored[f"proposal_{name}"] for name in names), strict=True)
    places, coupled = stored["proposal_places"], stored["proposal_coupled"]
    leads = stored["proposal_leader"], stored["proposal_follower"]
    every = tuple(
        Independence(mean, sd, places, Tables(table), coupled, Followers(*leads, rows), origin, turn)
        for mean, sd, table, rows, origin, turn in rounds
    )
    counts = tuple(stored["pool_counts"].tolist())
    w, log_target, errors_rad = stored["pool_w"], stored["pool_log_target"], stored["pool_place_errors_rad"]
    if len(counts) != len(every) - 1 or {len(each) for each in (w, log_target, errors_rad)} != {sum(counts)}:
        raise ValueError(f"{len(w)} weighted draws with parts of other lengths")
    mapped = target.path.mapped(w)
    parts = {"z": mapped.z, "log_jacobian": mapped.log_jacobian, "place_errors_rad": errors_rad}
    return Pool(Points(w, log_target, parts), every[:-1], counts, every[-1], int(stored["pool_invalid"]))


def write_chain(path: Path, fit: JointFit, start: ImportanceRun[Target], tier: Tier, chain: Chain) -> None:
    """Write a chain and its start, whole or not at all."""
    buffer = io.BytesIO()
    kind, keys, position, has_gauss, gauss = chain.random_state
    np.savez(
        buffer,
        allow_pickle=False,
        format=CHAIN_FORMAT,
        fingerprint=fingerprint(fit, tier),
        seed=start.seed,
        **_pool_arrays(start.pool),
        start_seconds=start.sample.seconds,
        w=chain.w,
        log_density=chain.log_density,
        accepted=chain.accepted,
        invalid=chain.invalid,
        seconds=chain.seconds,
        goal=chain.goal,
        random_kind=kind,
        random_keys=keys,
        random_rest=np.array([position, has_gauss, gauss]),
    )
    write_atomically(path, buffer.getvalue())


def stored_chain(path: Path, fit: JointFit, seed: int, tier: Tier = CHAIN) -> tuple[ImportanceRun[Target], Chain]:
    """Read a chain; refuse one of other data, model, priors, tier, versions or seed."""
    name = escaped(path.name)
    if not path.exists():
        raise InputError("no-chain", f"{name}: there is no chain to resume", file=name, remedy="run without --resume")
    try:
        stored = read_arrays(path, CHAIN_BYTES_MAX)
        stored_format = str(stored["format"])[:60]
        if stored_format.startswith(CHAIN_KIND) and stored_format != CHAIN_FORMAT:
            raise InputError(
                "other-chain",
                f"{name} was written by another version of tvsbayes: {escaped(stored_format)}",
                file=name,
                allowed=f"format {CHAIN_FORMAT}",
                remedy="run without --resume; the chain starts again",
            )
        if stored_format != CHAIN_FORMAT:
            raise ValueError(f"format {stored_format!r}")
        same = str(stored["fingerprint"]) == fingerprint(fit, tier) and int(stored["seed"]) == seed
        target = Target(fit, transport(fit))
        pool, chain, spent = _pool_of(stored, target), _chain_of(stored), float(stored["start_seconds"])
        if not pool.drawn.w.shape[1] == chain.w.shape[2] == target.dimension:
            raise ValueError(f"weighted draws of {pool.drawn.w.shape[1]} coordinates, walkers of {chain.w.shape[2]}")
    except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
        raise InputError(
            "damaged-chain",
            f"{name} is not a chain that tvsbayes wrote: {escaped(str(error), 200)}",
            file=name,
            allowed=f"format {CHAIN_FORMAT}",
            remedy="run without --resume; the chain starts again",
        ) from error
    if not same:
        raise InputError(
            "other-chain",
            f"{name} was sampled from other data, another model, other priors, another seed or other versions",
            file=name,
            allowed="the chain of the same campaign, options and versions",
            remedy="run without --resume, or restore the inputs and options it was started with",
        )
    return ImportanceRun(target, pool, Weighing(target, pool).sample(spent), seed), chain


def _chain_of(stored: dict[str, np.ndarray]) -> Chain:
    position, has_gauss, gauss = stored["random_rest"]
    chain = Chain(
        stored["w"],
        stored["log_density"],
        stored["accepted"],
        (str(stored["random_kind"]), stored["random_keys"], int(position), int(has_gauss), float(gauss)),
        int(stored["invalid"]),
        float(stored["seconds"]),
        int(stored["goal"]),
    )
    steps, walkers, _ = chain.w.shape
    if chain.log_density.shape != (steps, walkers) or chain.accepted.shape != (walkers,):
        raise ValueError(f"{steps} steps of {walkers} walkers with parts of other lengths")
    return chain
