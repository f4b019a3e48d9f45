"""What is the exact posterior of the two twins? NUTS references, and what a draw costs.

    taskset -c 1 python experiments/nuts_reference.py paper      # 11 CPU minutes
    taskset -c 1 python experiments/nuts_reference.py grid --warmup 300 --draws 720     # 5
    taskset -c 1 python experiments/nuts_reference.py paper --speed --chains 1 --warmup 200 --limit 90

The first two write `data/reference/posterior_{paper,grid}.json`: mean, sd and quantiles of every free parameter and
headline under `tvsbayes.likelihood.log_density`, each with its Monte Carlo standard error. NumPyro's NUTS (four
chains in step, diagonal mass) samples w: a triangular quadratic shear w -> y of volume 1 takes the curvature out of
the stiff directions, and z = mode + C y with C the Cholesky factor of the Laplace covariance. Coordinates change the
cost of a draw, not the posterior. The shear is built here anew: a reference shares no sampling code with
`tvsbayes.posterior`, which it judges. `--speed` measures effective draws per second without the shear, dense mass.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tvsbayes.estimators.likelihood import evaluate, log_density
from tvsbayes.instrument.campaign import ordered_spots

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
from arviz_stats.base import array_stats
from numpyro.infer import NUTS

from tvsbayes.estimators import campaign_arrays
from tvsbayes.estimators.campaign_arrays import use_compilation_cache
from tvsbayes.estimators.joint_fit import JointFit, fit
from tvsbayes.instrument.campaign import input_hashes, read_campaign
from tvsbayes.instrument.parameters import NAMES, NOISE_NAMES
from tvsbayes.model.headlines import derived_quantities

ROOT = Path(__file__).parent.parent
HEADLINES = (
    *(f"effective_deg_per_step.{direction}" for direction in ("left", "right", "up", "down")),
    "effective_mirror_offset_mm",
)
STEP = 0.5
"""Posterior sds (of what the coordinates before leave open) over which second differences are taken."""
STIFF_SD = 0.05
"""Prior sds: a coordinate that the data tell better than this, given those before it, is sheared."""
BATCH = 64
QUANTILES = {"q05": 0.05, "q50": 0.50, "q95": 0.95}


@dataclass(frozen=True)
class Transport:
    """w -> y -> z: y_k = w_k - y^T shear_k y / 2 over earlier coordinates, z[index] = mode[index] + root y."""

    mode: np.ndarray
    index: np.ndarray
    root: np.ndarray
    stiff: tuple[int, ...]
    shear: np.ndarray

    def z_of_y(self, y: jax.Array) -> jax.Array:
        """Laplace-whitened coordinates to prior coordinates."""
        return jnp.asarray(self.mode).at[self.index].add(jnp.asarray(self.root) @ y)

    def y_of_w(self, w: jax.Array) -> jax.Array:
        """The shear; its Jacobian is lower triangular with ones on the diagonal."""
        y = w
        for k in self.stiff:
            y = y.at[k].add(-0.5 * y[:k] @ (jnp.asarray(self.shear[k, :k, :k]) @ y[:k]))
        return y


def pivoted(covariance: np.ndarray) -> np.ndarray:
    """Order of the coordinates by what the earlier ones leave open, widest first."""
    rest, order = covariance.copy(), []
    for _ in range(len(rest)):
        open_variance = np.diag(rest).copy()
        open_variance[order] = -1
        k = int(np.argmax(open_variance))
        order.append(k)
        rest = rest - np.outer(rest[:, k], rest[k]) / rest[k, k]
    return np.array(order)


def build_transport(joint: JointFit) -> Transport:
    """Second differences of the standardised innovations give the shear that keeps them fixed to second order."""
    rows = np.flatnonzero(joint.free)
    index = rows[pivoted(joint.covariance[np.ix_(rows, rows)])]
    root = np.linalg.cholesky(joint.covariance[np.ix_(index, index)])
    size = index.size

    def residuals(y: np.ndarray) -> np.ndarray:
        out = []
        for first in range(0, len(y), BATCH):
            part = y[first : first + BATCH]
            z = np.repeat(joint.z[None], BATCH, axis=0)
            z[: len(part), index] += part @ root.T
            seen = evaluate(jnp.asarray(z), joint.space, joint.arrays).standardised
            out.append(np.asarray(seen)[: len(part)].reshape(len(part), -1))
        return np.concatenate(out)

    geometry = [k for k in range(size) if NAMES[index[k]] not in NOISE_NAMES]
    stiff = [k for k in geometry if root[k, k] < STIFF_SD]
    centre = residuals(np.zeros((1, size)))[0]
    plus, minus = residuals(STEP * np.eye(size)), residuals(-STEP * np.eye(size))
    slope = ((plus - minus) / (2 * STEP))[stiff]
    second = (plus + minus - 2 * centre) / STEP**2
    shear = np.zeros((size, size, size))
    for i in geometry:
        shear[stiff, i, i] = slope @ second[i]
    pairs = [(i, j) for a, i in enumerate(geometry) for j in geometry[:a]]
    for first in range(0, len(pairs), 2 * BATCH):
        some = pairs[first : first + 2 * BATCH]
        y = np.zeros((2, len(some), size))
        for n, pair in enumerate(some):
            y[0, n, list(pair)], y[1, n, list(pair)] = STEP, -STEP
        both = residuals(y.reshape(-1, size)).reshape(2, len(some), -1).sum(axis=0)
        mixed = (both - 2 * centre) / STEP**2
        for n, (i, j) in enumerate(some):
            value = 0.5 * slope @ (mixed[n] - second[i] - second[j])
            shear[stiff, i, j] = shear[stiff, j, i] = value
    k = np.arange(size)
    earlier = (k[:, None, None] > k[None, :, None]) & (k[:, None, None] > k[None, None, :])
    return Transport(joint.z, index, root, tuple(stiff), np.where(earlier, shear, 0.0))


@dataclass(frozen=True)
class Run:
    """Draws (chain, draw, coordinate) and what they took; seconds are the process' CPU time: cores may be shared."""

    draws: np.ndarray
    divergences: int
    leapfrogs: float
    acceptance: float
    compile_s: float
    warmup_s: float
    sampling_s: float


def nuts(
    potential: Callable[[jax.Array], jax.Array], size: int, setting: argparse.Namespace, dense: bool = False
) -> Run:
    """Sample exp(-potential), all chains in step; drawing ends early after `setting.limit` (wall clock)."""
    kernel = NUTS(potential_fn=potential, dense_mass=dense, target_accept_prob=0.8)
    key, start = jax.random.split(jax.random.PRNGKey(setting.seed))
    started = time.process_time()
    state = kernel.init(
        jax.random.split(key, setting.chains),
        setting.warmup,
        0.1**0.5 * jax.random.normal(start, (setting.chains, size)),
        model_args=(),
        model_kwargs={},
    )
    advance = jax.jit(lambda state: kernel.sample(state, (), {})).lower(state).compile()
    compile_s = time.process_time() - started

    def several(state, count: int, limit_s: float, label: str):
        started = said = time.perf_counter()
        cpu = time.process_time()
        seen = []
        while len(seen) < count and time.perf_counter() - started < limit_s:
            state = advance(state)
            seen.append([np.asarray(x) for x in (state.z, state.diverging, state.num_steps, state.accept_prob)])
            if time.perf_counter() - said > 20:
                said = time.perf_counter()
                print(f"{label}: {len(seen)} in {said - started:.0f} s, leapfrogs {seen[-1][2]}", flush=True)
        return state, [np.stack(x) for x in zip(*seen, strict=True)], time.process_time() - cpu

    state, _, warmup_s = several(state, setting.warmup, np.inf, "warm-up")
    _, (z, diverging, leapfrogs, acceptance), sampling_s = several(state, setting.draws, setting.limit, "draws")
    return Run(
        draws=np.swapaxes(z, 0, 1),
        divergences=int(diverging.sum()),
        leapfrogs=float(leapfrogs.mean()),
        acceptance=float(acceptance.mean()),
        compile_s=compile_s,
        warmup_s=warmup_s,
        sampling_s=sampling_s,
    )


def quantities(joint: JointFit, z_of: Callable[[jax.Array], jax.Array], draws: np.ndarray) -> dict[str, np.ndarray]:
    """Free parameters and headlines by contract name, each (chain, draw)."""
    z = jax.jit(jax.vmap(z_of))(draws.reshape(-1, draws.shape[-1]))
    derived = derived_quantities(z, joint.space, jnp.asarray(joint.reference_pose_rad))
    shape = draws.shape[:2]
    physical = np.asarray(derived.physical)
    named = {NAMES[k]: physical[:, k].reshape(shape) for k in np.flatnonzero(joint.free)}
    effective = np.asarray(derived.effective_deg_per_step)
    named |= {name: effective[:, k].reshape(shape) for k, name in enumerate(HEADLINES[:4])}
    return named | {HEADLINES[4]: np.asarray(derived.effective_mirror_offset_mm).reshape(shape)}


def summary(values: np.ndarray) -> dict[str, float]:
    """Moments and quantiles of one quantity (chain, draw), each with its Monte Carlo standard error."""
    axes = {"chain_axis": 0, "draw_axis": 1}
    row = {"mean": values.mean(), "mean_mcse": array_stats.mcse(values, method="mean", **axes)}
    row |= {"sd": values.std(ddof=1), "sd_mcse": array_stats.mcse(values, method="sd", **axes)}
    for name, level in QUANTILES.items():
        row[name] = np.quantile(values, level)
        row[f"{name}_mcse"] = array_stats.mcse(values, method="quantile", prob=level, **axes)
    row["ess_bulk"] = array_stats.ess(values, method="bulk", **axes)
    row["rhat"] = array_stats.rhat(values, **axes)
    digits = {"ess_bulk": 5, "rhat": 5}
    return {
        name: float(f"{float(x):.{3 if name.endswith('mcse') else digits.get(name, 8)}g}") for name, x in row.items()
    }


def content_hash(reference: dict[str, object]) -> str:
    """SHA-256 of a reference without its own hash, as canonical JSON."""
    rest = {key: value for key, value in reference.items() if key != "sha256"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def main() -> None:
    """Write one reference, or measure speed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("twin", choices=("paper", "grid"))
    parser.add_argument("--speed", action="store_true", help="the same without the shear, dense mass; writes nothing")
    parser.add_argument("--chains", type=int, default=4)
    parser.add_argument("--warmup", type=int, default=500)
    parser.add_argument("--draws", type=int, default=1500, help="per chain")
    parser.add_argument("--limit", type=float, default=np.inf, help="seconds after which drawing ends")
    parser.add_argument("--seed", type=int, default=20261121)
    options = parser.parse_args()

    jax.config.update("jax_enable_x64", True)
    use_compilation_cache()
    campaign = read_campaign(ROOT / "data" / "twins" / f"{options.twin}_twin")
    longest = max(len(ordered_spots(campaign)), len(campaign.moves))
    campaign_arrays.SMALLEST_BUCKET = 8 * -(-longest // 8)
    joint = fit(campaign)
    started = time.perf_counter()
    transport = build_transport(joint)
    transport_s = time.perf_counter() - started
    size = transport.index.size
    print(f"{size} free coordinates, {len(transport.stiff)} sheared, transport {transport_s:.1f} s")
    rng = np.random.default_rng(options.seed)
    for w in rng.standard_normal((3, size)):
        sign, log_volume = np.linalg.slogdet(np.asarray(jax.jacfwd(transport.y_of_w)(jnp.asarray(w))))
        print(f"log |dy/dw| = {log_volume:.1e}, sign {sign:.0f}")

    def z_of(w: jax.Array) -> jax.Array:
        return transport.z_of_y(w if options.speed else transport.y_of_w(w))

    def potential(w: jax.Array) -> jax.Array:
        return joint.log_density - log_density(z_of(w), joint.space, joint.arrays)

    run = nuts(potential, size, options, dense=options.speed)
    rows = {name: summary(values) for name, values in quantities(joint, z_of, run.draws).items()}
    worst = min(rows, key=lambda name: rows[name]["ess_bulk"])
    rhat = max(row["rhat"] for row in rows.values())
    ess = rows[worst]["ess_bulk"]
    print(
        f"| {options.twin} | {'no shear, dense mass' if options.speed else 'shear'} | "
        f"{options.chains} x ({options.warmup} + {run.draws.shape[1]}) | {run.leapfrogs:.1f} | {run.divergences} | "
        f"{run.compile_s:.0f} | {run.warmup_s:.0f} | {run.sampling_s:.0f} | {rhat:.4f} | {ess:.0f} ({worst}) | "
        f"{ess / run.sampling_s:.2f} | {ess / (run.sampling_s + run.warmup_s):.2f} | acceptance {run.acceptance:.3f}",
        flush=True,
    )
    if not options.speed:
        reference = {
            "twin": f"{options.twin}_twin",
            "target": "tvsbayes.likelihood.log_density, options of fit() at their defaults",
            "sampler": "NUTS in sheared coordinates, experiments/nuts_reference.py",
            "versions": {"numpyro": numpyro.__version__, "jax": jax.__version__, "numpy": np.__version__},
            "seed": options.seed,
            "chains": options.chains,
            "warmup_per_chain": options.warmup,
            "draws_per_chain": run.draws.shape[1],
            "divergences": run.divergences,
            "largest_rhat": rhat,
            "smallest_ess_bulk": ess,
            "input_sha256": input_hashes(campaign),
            "quantities": rows,
        }
        reference["sha256"] = content_hash(reference)
        lines = json.dumps({**reference, "quantities": None}, indent=1).replace(
            '"quantities": null',
            '"quantities": {\n  '
            + ",\n  ".join(f"{json.dumps(name)}: {json.dumps(row)}" for name, row in rows.items())
            + "\n }",
        )
        (ROOT / "data" / "reference" / f"posterior_{options.twin}.json").write_text(lines + "\n")


if __name__ == "__main__":
    main()
