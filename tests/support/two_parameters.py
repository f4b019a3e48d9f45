"""A posterior of two parameters whose map, density and headlines are known by hand: no fit, nothing compiled."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from support.partial_arrays import no_gears, partial_arrays

from tvsbayes.estimators.campaign_arrays import CampaignArrays
from tvsbayes.instrument.parameters import INDEX, NAMES, PERIODS_MAX
from tvsbayes.posterior.transport import GEAR_SCALES, STRETCH_NODES, Transport

RATIO, BACKLASH = INDEX["degrees_per_step.pan"], INDEX["backlash_deg.pan"]
STRETCH = 0.3
"""Log of the factor on the second coordinate per unit of the first, which counts from -2 on."""
AT_MODE = 7.0


def route() -> Transport:
    """The map z_1 = w_1, z_2 = w_2 exp(0.3 max(w_1, -2)) at two of the parameters."""
    empty = {"variance": (0, 1), "constant": (0,), "load": (1, 0), "states": (0, 0), "state_score": (0,)}
    empty |= {"place_angle_rad": (0,), "place_on_tilt": (0,), "place_valid": (0,), "period_deg": (2, PERIODS_MAX)}
    empty |= {"gear_scale": (len(GEAR_SCALES),), "gear_noise": (len(GEAR_SCALES), 1)}
    return Transport(
        mode=np.zeros(len(NAMES)),
        free=np.array([BACKLASH, RATIO]),
        root=np.eye(2),
        noise=np.array([0]),
        narrow=np.zeros(0, int),
        bend=np.zeros((0, 2, 2)),
        slope=np.zeros((1, 1)),
        half=np.zeros(1, bool),
        pixels=np.zeros(1),
        prior=np.zeros((1, 1)),
        known=np.ones((1, 1)),
        score=np.zeros(1),
        stretch=STRETCH * np.array([[[0.0, node] for node in STRETCH_NODES]]),
        **{name: np.zeros(shape) for name, shape in empty.items()},
    )


def fit() -> SimpleNamespace:
    """What a diagnosis reads of a fit."""
    free = np.isin(np.arange(len(NAMES)), [RATIO, BACKLASH])
    return SimpleNamespace(
        free=free, log_density=AT_MODE, reference_pose_rad=np.zeros(2), space=None, arrays=no_places()
    )


def no_places() -> CampaignArrays:
    """Of a campaign's arrays what a posterior reads besides its density: gears that do not vary."""
    return partial_arrays(gears=no_gears(0))


def autoregressive(steps: int, walkers: int, memory: float) -> np.ndarray:
    """Standard normal with autocorrelation `memory`^lag along the first axis, shape (steps, walkers, 2)."""
    fresh = np.random.default_rng(2).standard_normal((steps, walkers, 2))
    values = [fresh[0]]
    for one in fresh[1:]:
        values.append(memory * values[-1] + np.sqrt(1 - memory**2) * one)
    return np.array(values)
