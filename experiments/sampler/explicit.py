"""Is it right to integrate stop errors and ranges out? On a dozen spots NUTS samples every one of them.

    python -m experiments.sampler.explicit > experiments/sampler/explicit.md     # 10 minutes; needs the extra `bench`

A dozen spots of the mounted rig, six stops at two sheets, both axes with cleared and reversed moves. Optics, cameras
and extrinsics are held, so that a dozen spots determine the rest: mean ratios, contrasts, backlashes, tilt zero, stop
sds, pixel scale. NumPyro's NUTS samples these, every stop error and every range; a range is flat in image
displacement, so the density carries |d(pixels)/d(range)|. NUTS moves in coordinates whitened at the mode
of the marginal density; with a mass matrix of its own finding it spent 1000 gradients on every draw. It shares
`observe` and the gears with the likelihood, not the filter, the projection, nor the linearisation about the
triangulated point. `tvsbayes.sample` samples the marginal density.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from arviz_stats.base import array_stats

from experiments.common.command_line import print_only
from experiments.common.page import heading, line
from experiments.common.reference_samplers import AXES
from experiments.common.rigs import mounted_rig, swept
from tvsbayes.estimators.campaign_arrays import campaign_arrays
from tvsbayes.estimators.joint_fit import JointFit, fit
from tvsbayes.estimators.likelihood import stop_variances
from tvsbayes.estimators.looks import nearest_range, observe
from tvsbayes.instrument.campaign import Campaign
from tvsbayes.instrument.mirrors import Vectors
from tvsbayes.instrument.parameters import NAMES, Prior
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.model.laser_path import mirror_angles, trace
from tvsbayes.model.parameter_space import parameter_space
from tvsbayes.posterior.sampling import sample
from tvsbayes.results.tiers import CHAIN
from tvsbayes.twin.simulated_campaign import simulate

KEPT = ("degrees_per_step", "ratio_contrast", "backlash", "tilt_zero", "stop_sd", "pixel_scale")
STOPS = ((60, 40), (160, -60), (60, 20), (200, 80), (100, -30), (0, 0))
SEED, CHAINS, WARMUP, DRAWS = 11, 4, 700, 2500
NEWTON_STEPS = 100
QUANTILES = {"5 %": 0.05, "50 %": 0.5, "95 %": 0.95}


def dozen() -> Campaign:
    """The campaign: its truth is at the declared values of everything that is held."""
    rig = mounted_rig()
    held = {n: Prior(p.value, 0.0, p.distribution) for n, p in rig.table.priors.items() if not n.startswith(KEPT)}
    stereo = replace(rig.stereo, parameter_covariance=np.zeros((24, 24)))
    table = replace(rig.table, priors={**rig.table.priors, **held})
    truth = {**rig.truth, **held}
    rig = replace(rig, table=table, stereo=stereo, truth=truth)
    return simulate(rig, swept(("d1", "d3"), STOPS), SEED).campaign


def explicit_density(campaign: Campaign, joint: JointFit):
    """Log density of one vector (z of the free parameters, stop errors in sds of the mode, ranges) and its parts."""
    arrays, space = campaign_arrays(campaign), parameter_space(campaign.rig, campaign.stereo)
    count = sum(s.status == "ok" for s in campaign.spots)
    spots = jax.tree.map(lambda x: x[:count], arrays.spots)
    redraw = np.asarray(spots.redraw)
    # Stop error of an axis at a spot: the last one drawn.
    drawn_at = [np.flatnonzero(redraw[:, axis]) for axis in range(2)]
    place = [np.cumsum(redraw[:, axis]) - 1 for axis in range(2)]
    free = np.flatnonzero(joint.free)
    mode = joint.space.model(jnp.asarray(joint.z))
    at_mode = mirror_angles(mode.transmission, mode.tilt_zero_rad, arrays.moves).angle_rad[spots.move_index].T
    triangulated = Vectors.of(spots.triangulated_mm.T)
    middle = nearest_range(mode.extrinsics, trace(mode.optics, *at_mode), triangulated)

    variance_at_mode = stop_variances(mode.noise.stop_sd_rad, spots)
    sizes = {"z": len(free), "pan": len(drawn_at[0]), "tilt": len(drawn_at[1]), "range_mm": count}
    ends = np.cumsum([0, *sizes.values()])
    parts = {name: slice(a, b) for name, a, b in zip(sizes, ends[:-1], ends[1:], strict=True)}

    def density(vector):
        theta = {name: vector[part] for name, part in parts.items()}
        z = jnp.asarray(joint.z).at[free].set(theta["z"])
        model = space.model(z)
        angles = mirror_angles(model.transmission, model.tilt_zero_rad, arrays.moves).angle_rad[spots.move_index].T
        variance = stop_variances(model.noise.stop_sd_rad, spots)
        errors, log_prior = [], -0.5 * jnp.sum(theta["z"] ** 2)
        for axis, name in enumerate(("pan", "tilt")):
            drawn = theta[name] * jnp.sqrt(variance_at_mode[drawn_at[axis], axis])
            spread = variance[drawn_at[axis], axis]
            log_prior -= 0.5 * jnp.sum(drawn**2 / spread + jnp.log(spread))
            errors.append(drawn[place[axis]])
        pose = jnp.stack([angles[0] + errors[0], angles[1] + errors[1], middle + theta["range_mm"]])
        towards = jnp.zeros_like(pose).at[2].set(1.0)
        predicted, slope = jax.jvp(lambda p: observe(model, p, arrays.azimuth_convention)[:4], (pose,), (towards,))
        residual, slope = (jnp.einsum("sij,js->si", spots.whitening, v) for v in (spots.pixels.T - predicted, slope))
        s = model.noise.pixel_scale
        value = -0.5 * jnp.sum(residual**2) / s**2 - 4 * count * jnp.log(s)
        value += 0.5 * jnp.sum(jnp.log(jnp.sum(slope**2, axis=1)))
        return value + log_prior

    return density, parts


def whitening(density, z: np.ndarray, covariance: np.ndarray, latent: int):
    """Centre and root of coordinates in which the density is nearly standard normal.

    At the mode of the marginal density, where stop errors and ranges have a mode of their own: the mode of all
    together has stop sds of zero, as that of every hierarchy has.
    """
    known = len(z)
    climb, curve = jax.jit(jax.value_and_grad(density)), jax.jit(jax.hessian(density))
    at = jnp.asarray(np.concatenate([z, np.zeros(latent)]))
    for _ in range(NEWTON_STEPS):
        value, gradient = climb(at)
        values, vectors = np.linalg.eigh(-np.asarray(curve(at))[known:, known:])
        gain = vectors.T @ np.asarray(gradient)[known:]
        step = np.concatenate([np.zeros(known), vectors @ (gain / np.maximum(np.abs(values), 1e-6 * values.max()))])
        size = 1.0
        while not climb(at + size * step)[0] >= value and size > 1e-10:
            size *= 0.5
        at = at + size * step
        if np.abs(step).max() < 1e-8:
            break
    information = -np.asarray(curve(at))
    values, vectors = np.linalg.eigh(information[known:, known:])
    assert values.min() > 0, "no maximum"
    axes, root = vectors / np.sqrt(values), np.linalg.cholesky(covariance)
    follow = -axes @ (axes.T @ information[known:, :known])
    return np.asarray(at), np.block([[root, np.zeros((known, latent))], [follow @ root, axes]])


def main() -> None:
    """Sample both, print the comparison."""
    print_only(__doc__)
    from numpyro.infer import MCMC, NUTS

    use_compilation_cache()
    campaign = dozen()
    joint = fit(campaign)
    posterior = sample(joint, CHAIN, seed=0)
    free = np.flatnonzero(joint.free)
    with jax.enable_x64(True):
        density, parts = explicit_density(campaign, joint)
        latent = parts["range_mm"].stop - len(free)
        linear = whitening(density, joint.z[free], joint.covariance[np.ix_(free, free)], latent)
        centre, root = (jnp.asarray(x) for x in linear)
        options = {"adapt_mass_matrix": False, "target_accept_prob": 0.97}
        kernel = NUTS(potential_fn=lambda e: -density(centre + root @ e), **options)
        counts = {"num_warmup": WARMUP, "num_samples": DRAWS, "num_chains": CHAINS}
        chains = MCMC(kernel, **counts, chain_method="sequential", progress_bar=False)
        generator = np.random.default_rng(1)
        begin = jnp.asarray(generator.standard_normal((CHAINS, len(root))))
        chains.run(jax.random.key(2), init_params=begin, extra_fields=("diverging",))
        draws = np.asarray(chains.get_samples(group_by_chain=True))
        z = (linear[0] + draws @ linear[1].T)[..., parts["z"]]
    sizes = {name: part.stop - part.start for name, part in parts.items()}
    divergences = int(np.sum(chains.get_extra_fields()["diverging"]))
    ours = posterior.z[..., free]
    rhat = array_stats.rhat(z, method="rank", **AXES)
    ess = array_stats.ess(z, method="bulk", **AXES)
    print("# Stop errors and ranges: sampled one by one, or integrated out\n")
    print("Written by `python -m experiments.sampler.explicit`; what was done stands in the script.\n")
    print(f"{sizes['range_mm']} spots, {sizes['pan']} + {sizes['tilt']} stop errors, {sizes['range_mm']} ranges,")
    print(f"{sizes['z']} parameters. NUTS: {CHAINS} x {DRAWS} draws, R-hat at most {rhat.max():.4f}, least bulk ESS")
    print(f"{ess.min():.0f}, {divergences} divergences. tvsbayes: converged {posterior.converged},")
    print(f"{posterior.convergence.steps} steps.\n")
    ends = " | ".join(QUANTILES)
    print(heading("parameter (prior-normal coordinate) | mean, sds | sd, %", f"{ends} (Monte Carlo errors)"))
    for k, index in enumerate(free):
        a, b = ours[..., k], z[..., k]
        cells = [f"{(a.mean() - b.mean()) / b.std():+.3f}", f"{100 * (a.std() / b.std() - 1):+.1f}"]
        for probability in QUANTILES.values():
            error = np.hypot(*(float(array_stats.mcse(x, method="quantile", prob=probability, **AXES)) for x in (a, b)))
            cells.append(f"{(np.quantile(a, probability) - np.quantile(b, probability)) / error:+.2f}")
        print(line(NAMES[index], *cells))


if __name__ == "__main__":
    main()
