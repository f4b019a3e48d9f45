"""A calibration from a fit, with the causes of its covariance."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from tvsbayes.calibration.pointing import INPUT_NAMES, NOISE_NAMES, Calibration
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.campaign import Campaign, input_hashes
from tvsbayes.instrument.parameters import INDEX, NAMES, PRIOR_GROUPS
from tvsbayes.posterior.draws import Posterior

CLEARED_PROBABILITY = 0.99
"""With this probability an overshoot takes up all the play."""


def receiver_priors(campaign: Campaign) -> dict[str, tuple[float, float]]:
    """Value and u of what only aperture readings could tell, where the campaign has none."""
    if any(s.aperture_deg is not None for s in campaign.spots if s.status == "ok"):
        return {}
    names = ("baseline_mm", "pan_zero_emission_deg", "aperture_zero_deg")
    return {name: (campaign.rig.priors[name].value, campaign.rig.priors[name].u) for name in names}


def calibration_of_draws(
    names: tuple[str, ...],
    physical: np.ndarray,
    campaign: Campaign,
    estimator: str,
    seed: int,
    causes: tuple[str, ...] = (),
    cause_covariance: np.ndarray | None = None,
) -> Calibration:
    """Choose the columns that coordinates depend on.

    Baseline, C0, the aperture's zero and its noise take their priors where no reading told them: a sampler holds them
    still.

    Args:
        names: contract names of the columns of `physical`.
        physical: draws (n, names) in the units of the names.
        campaign: what was fitted.
        estimator: "posterior" or "laplace".
        seed: of the draws from priors.
        causes: as in `Calibration`.
        cause_covariance: as in `Calibration`.
    """
    column = {name: physical[:, i] for i, name in enumerate(names)}
    generator = np.random.default_rng([seed, 5])

    def standard() -> np.ndarray:
        # Exactly mean 0 and sd 1: the prior is known, its few draws need not be noise.
        found = generator.standard_normal(len(physical))
        return (found - found.mean()) / found.std()

    if untold := receiver_priors(campaign):
        column |= {name: value + u * standard() for name, (value, u) in untold.items()}
        prior = campaign.rig.priors["aperture_sd_deg"]
        column["aperture_sd_deg"] = prior.value * np.exp(prior.u * standard())
    inputs = np.stack([column[name] for name in INPUT_NAMES], axis=1)
    noise = np.stack([column[name] for name in NOISE_NAMES], axis=1)
    counters = np.array([(m.pan_steps, m.tilt_steps) for m in campaign.moves], dtype=float)
    return Calibration(
        mean=inputs.mean(axis=0),
        covariance=np.cov(inputs, rowvar=False),
        noise_variance=dict(zip(NOISE_NAMES, (noise**2).mean(axis=0).tolist(), strict=True)),
        overshoot_steps={axis: _overshoot_steps(column, axis) for axis in AXES},
        azimuth=campaign.rig.aperture_convention == "azimuth",
        period_deg=dict(campaign.rig.harmonic_period_deg),
        estimator=estimator,
        range_steps=np.stack([counters.min(axis=0), counters.max(axis=0)], axis=1),
        inputs_sha256=input_hashes(campaign),
        inputs=inputs,
        noise=noise,
        **({} if cause_covariance is None else {"causes": causes, "cause_covariance": cause_covariance}),
    )


def _overshoot_steps(column: Mapping[str, np.ndarray], axis: str) -> int:
    play_steps = column[f"backlash_deg.{axis}"] / np.abs(column[f"degrees_per_step.{axis}"])
    return math.ceil(np.quantile(play_steps, CLEARED_PROBABILITY))


DRAWS_KEPT = 4096
"""Posterior draws in a calibration, evenly chosen; posterior.nc holds them all."""


@dataclass(frozen=True)
class Causes:
    """What the covariance of the inputs of a coordinate comes from.

    Attributes:
        names: causes.
        covariance: their parts, shape (causes, inputs, inputs), ordered as `calibration.INPUT_NAMES`; they add up.
    """

    names: tuple[str, ...]
    covariance: np.ndarray


def causes_of(fit: JointFit) -> Causes:
    """Split the covariance of a fit by cause (DESIGN 5).

    An estimate moves by S J^T C^-1 e when the data err by e, and by S e_j when prior j is off by its sd, S the
    posterior covariance. With C = 1 + (stop errors) the parts S (C^-1 J)^T (C^-1 J) S, S (J^T C^-1 J - that) S and
    S e_j e_j^T S add up to S. Expected information about geometry and cameras; noise scales are taken as known.
    """
    fisher = fit.information.fisher
    posterior = np.linalg.inv(fisher + np.eye(len(NAMES)))
    gain = np.concatenate([group.jacobian for group in fit.information.groups])
    noise = gain.T @ gain
    readings = bool(np.any(np.asarray(fit.arrays.spots.has_aperture) * np.asarray(fit.arrays.spots.valid)))
    parts = {
        "pixel and aperture noise" if readings else "pixel noise": noise,
        "stop errors of the campaign": fisher - noise,
    }
    for stem, columns in PRIOR_GROUPS.items():
        share = np.zeros_like(fisher)
        share[columns, columns] = 1.0
        parts[stem] = share
    inputs = [INDEX[name] for name in INPUT_NAMES]
    with jax.enable_x64(True):
        slope = np.asarray(jax.jacfwd(fit.space.physical)(jnp.asarray(fit.z)))[inputs]
    spread = slope @ posterior
    covariance = {name: spread @ part @ spread.T for name, part in parts.items()}
    # A prior that was fixed, or that no coordinate hangs on, is no cause.
    kept = {name: c for name, c in covariance.items() if np.any(np.diag(c) > 0)}
    return Causes(tuple(kept), np.stack(list(kept.values())))


def calibration_of(fit: JointFit, posterior: Posterior | None = None, *, seed: int = 0) -> Calibration:
    """What coordinates need of a fit: the posterior's draws where one has converged, else the Laplace approximation's.

    Args:
        fit: a converged fit.
        posterior: its sample; left out, or unconverged, the Laplace draws are taken.
        seed: of the draws of baseline, C0 and aperture zero where no reading told them.

    Returns:
        A calibration for `locate`, with `.ray`, `.locate` and `.steps_for` of its own.
    """
    usable = posterior is not None and posterior.converged
    draws = posterior.thinned(DRAWS_KEPT).physical if usable else fit.draws.physical
    causes = causes_of(fit)
    name = "posterior" if usable else "laplace"
    return calibration_of_draws(fit.names, np.asarray(draws), fit.campaign, name, seed, causes.names, causes.covariance)
