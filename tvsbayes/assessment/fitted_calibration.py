"""A `Calibration` for robots from a fit or a posterior's draws, with the causes of its covariance.

Columns have the units of their names; counters in steps.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from tvsbayes.assessment.causes import PLAY_VARIATION, TRANSMISSION_ERROR, causes_of
from tvsbayes.assessment.gear_tables import DrawnGears, drawn_gears
from tvsbayes.assessment.summary import equal_laplace_draws, seen_range
from tvsbayes.calibration.drawn_looks import noise_of_a_look
from tvsbayes.calibration.gear_table import NO_GEARS, GearTable
from tvsbayes.calibration.optics import ERROR_AT, PLAY_AT
from tvsbayes.calibration.pointing import INPUT_NAMES, NOISE_NAMES, Calibration, input_names
from tvsbayes.calibration.states import ZERO_NAMES, columns_of, poses_at, poses_of, shifts_at, states_of
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.campaign import Campaign, input_hashes
from tvsbayes.instrument.parameters import RECEIVER_NAMES
from tvsbayes.posterior.draws import Posterior
from tvsbayes.statistics.streams import Stream, random_stream

CLEARED_PROBABILITY = 0.99
"""Probability that an overshoot takes up all the play."""
DRAWS_KEPT = 4096
"""Largest number of posterior draws, of equal weight, in a calibration."""


def calibration_of_draws(
    names: tuple[str, ...],
    physical: np.ndarray,
    campaign: Campaign,
    estimator: str,
    seed: int,
    range_steps: np.ndarray,
    gears: DrawnGears | None = None,
) -> Calibration:
    """Build a calibration from the columns that coordinates depend on.

    Baseline, C0, the aperture's zero and its noise are drawn from their priors without readings, since a sampler holds
    them fixed. Zeros are those at one state (`states_of`), draw by draw.

    Args:
        names: public names of the columns of `physical`.
        physical: draws (n, names) in the units of the names.
        campaign: the fitted campaign.
        estimator: "posterior" or "laplace".
        seed: seed of the draws from priors.
        range_steps: lowest and highest counter of each axis with a look, shape (2, 2).
        gears: errors of the gears by draw; None without repeating errors.
    """
    constants = {name: np.full(len(physical), value) for name, value in campaign.rig.mechanism.constants.items()}
    column = constants | {name: physical[:, i] for i, name in enumerate(names)}
    generator = random_stream(seed, Stream.CALIBRATION_NOISE)

    def standard() -> np.ndarray:
        # Scaled to exactly mean 0 and sd 1, so that moments of the prior have no Monte Carlo error.
        normal = generator.standard_normal(len(physical))
        return (normal - normal.mean()) / normal.std()

    if not campaign.aperture_read:
        for name in (name for name in RECEIVER_NAMES if name in campaign.rig.priors):
            prior, off = campaign.rig.priors[name], standard()
            log = prior.distribution == "log-normal"
            column[name] = prior.value * np.exp(prior.u * off) if log else prior.value + prior.u * off
    named_inputs = input_names(campaign.rig.mechanism)
    inputs = np.stack([column[name] for name in named_inputs], axis=1)
    zeros, extrinsics = columns_of(names, physical, ZERO_NAMES), poses_of(names, physical)
    states = states_of(campaign) if len(zeros) else {}
    if states:
        shifts = shifts_at(zeros, states)
        inputs[:, [named_inputs.index(name) for name in campaign.rig.mechanism.zeros]] += shifts
        extrinsics = poses_at(extrinsics, named_inputs, shifts[:, 0])
    noise = noise_of_a_look(column)
    table = NO_GEARS if gears is None else gears.table
    if gears is not None:
        inputs = np.concatenate([inputs, gears.expected + gears.left_open], axis=1)
    mean = inputs.mean(axis=0)
    # Means of errors without any information are zero except for rounding.
    mean[len(INPUT_NAMES) + np.array([part.stop - 1 for part in table.parts.values()], dtype=int)] = 0.0
    return Calibration(
        mean=mean,
        covariance=np.cov(inputs, rowvar=False),
        # Summed exactly, so that a stated variance is reproduced exactly.
        noise_variance={
            n: math.fsum(v**2 for v in each) / len(each) for n, each in zip(NOISE_NAMES, noise.T.tolist(), strict=True)
        },
        overshoot_steps={axis: _overshoot_steps(column, axis, _widest(table, inputs, axis)) for axis in AXES},
        azimuth=campaign.rig.aperture_convention == "azimuth",
        period_deg=campaign.rig.first_period_deg,
        estimator=estimator,
        range_steps=range_steps,
        inputs_sha256=input_hashes(campaign),
        inputs=inputs,
        noise=noise,
        gears=table,
        extrinsics=extrinsics,
        names=named_inputs,
        states=states,
        zeros=zeros,
    )


def _widest(table: GearTable, inputs: np.ndarray, axis: str) -> np.ndarray | float:
    """Return the largest increase of each draw's play by position, deg."""
    part = table.parts.get(f"{PLAY_AT}.{axis}")
    return 0.0 if part is None else np.maximum(inputs[:, len(INPUT_NAMES) :][:, part].max(axis=1), 0.0)


def _overshoot_steps(column: Mapping[str, np.ndarray], axis: str, widest_deg: np.ndarray | float = 0.0) -> int:
    play_steps = (column[f"backlash_deg.{axis}"] + widest_deg) / np.abs(column[f"degrees_per_step.{axis}"])
    return math.ceil(np.quantile(play_steps, CLEARED_PROBABILITY))


def calibration_of(fit: JointFit, posterior: Posterior | None = None, *, seed: int = 0) -> Calibration:
    """Build the calibration of a fit: from the posterior's draws if converged, else from the Laplace approximation's.

    With several homing hypotheses, the draws are of all of them; causes and the scales of the gears' errors are those
    of the most probable one.

    Args:
        fit: a converged fit.
        posterior: its sample; without one, or if it has not converged, the Laplace draws are used.
        seed: seed of the draws of baseline, C0 and aperture zero without readings.

    Returns:
        A calibration for `locate`, with methods `.ray`, `.locate` and `.steps_for`.
    """
    if posterior is not None and posterior.converged:
        draws, estimator = posterior.thinned(DRAWS_KEPT), "posterior"
    else:
        draws, estimator = equal_laplace_draws(fit), "laplace"
    physical = np.asarray(draws.physical)
    # Laplace draws of the errors at places are at the mode's scales, those of a posterior at their own.
    sampled = estimator == "posterior"
    gears = drawn_gears(fit, physical, np.asarray(draws.place_errors_rad), seed, own_scales=sampled)
    # Looks that the fit excluded do not extend the range.
    counters = seen_range(fit)
    range_steps = np.array([counters[axis] for axis in AXES], dtype=float)
    calibration = calibration_of_draws(fit.names, physical, fit.campaign, estimator, seed, range_steps, gears)
    causes = causes_of(fit, gears.by_places if gears.table.size else None, calibration.states)
    # What the errors of the gears between and beyond the counters seen leave open.
    for name, part in gears.table.parts.items():
        cause = TRANSMISSION_ERROR if name.startswith(ERROR_AT) else PLAY_VARIATION
        place, own = len(INPUT_NAMES) + part.start, np.cov(gears.left_open[:, part], rowvar=False)
        if np.any(own):
            after = len(calibration.mean) - place - len(own)
            causes[cause] = causes.get(cause, 0.0) + np.pad(own, ((place, after),) * 2)
    return replace(calibration, causes=tuple(causes), cause_covariance=np.stack(list(causes.values())))
