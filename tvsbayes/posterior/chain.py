"""The file of a chain and its start, from which it continues bit for bit.

Coordinates w of `posterior.transport`; arrays of a chain are ordered (step, walker, ...).
"""

from __future__ import annotations

import hashlib
import io
import json
import time
from pathlib import Path

import jax
import numpy as np

from tvsbayes.errors import InputError, escaped
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.files.disk import read_arrays, write_atomically
from tvsbayes.files.packages import version_of
from tvsbayes.inference.chain import Chain
from tvsbayes.inference.density import Points
from tvsbayes.inference.importance import Pool
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


PROPOSAL_PARTS = ("mean", "sd", "origin", "turn")
"""Arrays of every proposal that are stored under their names."""


def _pool_arrays(pool: Pool[Target]) -> dict[str, np.ndarray]:
    """Convert a pool to arrays; the next proposal is the last of the proposals."""
    every = [each for each in (*pool.proposals, pool.next_proposal) if isinstance(each, Independence)]
    last = every[-1]
    return {
        "pool_w": pool.drawn.w,
        "pool_log_target": pool.drawn.log_target,
        "pool_place_errors_rad": pool.drawn.parts["place_errors_rad"],
        "pool_counts": np.array(pool.counts),
        "pool_invalid": np.array(pool.invalid),
        "proposal_places": last.places,
        "proposal_coupled": last.coupled,
        "proposal_tables": np.stack([each.tables.log_density for each in every]),
        "proposal_leader": last.followers.leader,
        "proposal_follower": last.followers.follower,
        "proposal_followers": np.stack([each.followers.tables.log_density for each in every]),
        **{f"proposal_{name}": np.stack([getattr(each, name) for each in every]) for name in PROPOSAL_PARTS},
    }


def _pool_of(stored: dict[str, np.ndarray], target: Target) -> Pool[Target]:
    """Build the pool from `_pool_arrays`."""
    rounds = zip(*(stored[f"proposal_{name}"] for name in ("tables", "followers", *PROPOSAL_PARTS)), strict=True)
    places, coupled = stored["proposal_places"], stored["proposal_coupled"]
    leads = stored["proposal_leader"], stored["proposal_follower"]
    *every, last = (
        Independence(mean, sd, places, Tables(table), coupled, Followers(*leads, Tables(rows)), origin, turn)
        for table, rows, mean, sd, origin, turn in rounds
    )
    counts = tuple(stored["pool_counts"].tolist())
    w, log_target, errors_rad = stored["pool_w"], stored["pool_log_target"], stored["pool_place_errors_rad"]
    if len(counts) != len(every) or {len(each) for each in (w, log_target, errors_rad)} != {sum(counts)}:
        raise ValueError(f"{len(w)} weighted draws with parts of other lengths")
    mapped = target.path.mapped(w)
    parts = {"z": mapped.z, "log_jacobian": mapped.log_jacobian, "place_errors_rad": errors_rad}
    began = time.monotonic() - float(stored["start_seconds"])
    drawn, invalid = Points(w, log_target, parts), int(stored["pool_invalid"])
    return Pool(target, int(stored["seed"]), last, began, drawn, tuple(every), counts, invalid)


def write_chain(path: Path, fit: JointFit, start: Pool[Target], tier: Tier, chain: Chain) -> None:
    """Write a chain and its start, whole or not at all."""
    buffer = io.BytesIO()
    kind, keys, *rest = chain.random_state
    arrays = {name: value for name, value in vars(chain).items() if name != "random_state"}
    arrays |= {"random_kind": kind, "random_keys": keys, "random_rest": np.array(rest)}
    arrays |= {"format": CHAIN_FORMAT, "fingerprint": fingerprint(fit, tier), "seed": start.seed}
    arrays |= {"start_seconds": start.sample.seconds, **_pool_arrays(start)}
    np.savez(buffer, allow_pickle=False, **arrays)
    write_atomically(path, buffer.getvalue())


def stored_chain(path: Path, fit: JointFit, seed: int, tier: Tier = CHAIN) -> tuple[Pool[Target], Chain]:
    """Read a chain; refuse one of other data, model, priors, tier, versions or seed."""
    name, again = escaped(path.name), "run without --resume; the chain starts again"
    if not path.exists():
        raise InputError("no-chain", f"{name}: there is no chain to resume", file=name, remedy="run without --resume")

    def refusal(code: str, what: str, allowed: str = f"format {CHAIN_FORMAT}", remedy: str = again) -> InputError:
        return InputError(code, f"{name} {what}", file=name, allowed=allowed, remedy=remedy)

    try:
        stored = read_arrays(path, CHAIN_BYTES_MAX)
        stored_format = str(stored["format"])[:60]
        if stored_format.startswith(CHAIN_KIND) and stored_format != CHAIN_FORMAT:
            raise refusal("other-chain", f"was written by another version of tvsbayes: {escaped(stored_format)}")
        if stored_format != CHAIN_FORMAT:
            raise ValueError(f"format {stored_format!r}")
        same = str(stored["fingerprint"]) == fingerprint(fit, tier) and int(stored["seed"]) == seed
        pool, chain = _pool_of(stored, Target(fit, transport(fit))), _chain_of(stored)
        if not pool.drawn.w.shape[1] == chain.w.shape[2] == pool.density.dimension:
            raise ValueError(f"weighted draws of {pool.drawn.w.shape[1]} coordinates, walkers of {chain.w.shape[2]}")
    except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
        raise refusal("damaged-chain", f"is not a chain that tvsbayes wrote: {escaped(str(error), 200)}") from error
    if not same:
        raise refusal(
            "other-chain",
            "was sampled from other data, another model, other priors, another seed or other versions",
            "the chain of the same campaign, options and versions",
            "run without --resume, or restore the inputs and options it was started with",
        )
    return pool, chain


def _chain_of(stored: dict[str, np.ndarray]) -> Chain:
    position, has_gauss, gauss = stored["random_rest"]
    state = str(stored["random_kind"]), stored["random_keys"], int(position), int(has_gauss), float(gauss)
    w, log_density, accepted = stored["w"], stored["log_density"], stored["accepted"]
    if log_density.shape != w.shape[:2] or accepted.shape != w.shape[1:2] or w.ndim != 3:
        raise ValueError(f"{len(w)} steps of walkers with parts of other lengths")
    invalid, seconds, goal = int(stored["invalid"]), float(stored["seconds"]), int(stored["goal"])
    return Chain(w, log_density, accepted, state, invalid, seconds, goal)
