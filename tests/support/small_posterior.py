"""A fit that samples fast and its map, for the tests of the posterior."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from support.varying_gears import perfect_rig

from tvsbayes.estimators.joint_fit import JointFit, fit
from tvsbayes.inference.importance import Pool
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.protocols import four_point_protocol
from tvsbayes.instrument.rig import read_rig
from tvsbayes.posterior.target import importance_run
from tvsbayes.posterior.transport import Transport, transport
from tvsbayes.twin.simulated_campaign import simulate

SEED = 3
SIGMAS = 5.0
"""Standard errors: a right value lies farther out in 6 of 10 million runs, and the runs are seeded."""
ROUNDING = 2.0**-52
"""Relative spacing of float64."""


def play_priors(path: Transport) -> tuple[np.ndarray, np.ndarray]:
    """Precision (g,) and score (g,) of the prior at the mode, of steps along the line of each quantity.

    Of a backlash that is not narrow: -b^2 / 2 by central differences of SciPy's half-normal law, less the prior of z.
    """
    others = path.free[path.noise :]
    precision, score, step = np.ones(len(others)), np.zeros(len(others)), 1e-4
    wide = np.array(TWO_MIRROR.names)[others[: len(others) - path.narrow]]
    for place in np.flatnonzero(np.char.startswith(wide, "backlash_deg")):
        at = path.mode[others[place]]
        before, value, after = stats.halfnorm.ppf(stats.norm.cdf(at + step * np.array([-1, 0, 1])))
        slope = (after - before) / (2 * step)
        precision[place], score[place] = slope**2, at - slope * value
    return precision, score


@cache
def small_fit() -> tuple[JointFit, Transport]:
    """64 spots seen by cameras that are known exactly, gears without errors: 31 free parameters."""
    rig = perfect_rig(read_rig(Path(__file__).resolve().parents[2] / "data" / "rigs" / "mounted" / "rig.toml"))
    rig = replace(rig, stereo=replace(rig.stereo, parameter_covariance=np.zeros((24, 24))))
    fitted = fit(simulate(rig, four_point_protocol(repeats=4, steps=(100, 200)), seed=21).campaign)
    assert fitted.converged, fitted.problems
    return fitted, transport(fitted)


def mapped_already(patch: pytest.MonkeyPatch) -> None:
    """The map of that fit takes seconds and no random number: it is not made again."""
    patch.setattr("tvsbayes.posterior.target.transport", lambda fit: small_fit()[1])


@cache
def small_run() -> Pool:
    """Importance sampling of that fit."""
    with pytest.MonkeyPatch.context() as patch:
        mapped_already(patch)
        return importance_run(small_fit()[0], SEED)
