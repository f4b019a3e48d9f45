"""Fits of simulated campaigns, begun at the truth instead of searched for."""

from __future__ import annotations

import jax
import numpy as np

from tvsbayes.estimators.joint_fit import JointFit, fit, fit_at
from tvsbayes.estimators.mode_search import Problem
from tvsbayes.instrument.campaign import Campaign
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.model.parameter_space import coordinates_of
from tvsbayes.statistics.least_squares import newton_mode
from tvsbayes.twin.true_rig import Truth


def physical_of(truth: Truth) -> np.ndarray:
    """A true rig and its cameras in the order of `tvsbayes.instrument.parameters.NAMES`, shape (65,)."""
    return np.array([*(truth.parameters[name] for name in TWO_MIRROR.rig_names), *truth.stereo.vector])


def fit_from_truth(campaign: Campaign, truth: Truth) -> JointFit:
    """`joint_fit.fit` without its search: Newton steps from the true rig to the mode, a third of the time.

    The mode, its covariance and every diagnosis are those of the ordinary fit, to which it falls back where the steps
    do not settle.
    """
    with jax.enable_x64(True):
        problem = Problem(campaign, campaign.rig)
        z = np.where(problem.free, np.clip(coordinates_of(problem.space, physical_of(truth)), -4.0, 4.0), 0.0)
        mode = newton_mode(problem.negative_log_density, z, problem.free, problem.curvature(z))
        if not mode.problems:
            return fit_at(campaign, problem, mode, 0)
    return fit(campaign)
