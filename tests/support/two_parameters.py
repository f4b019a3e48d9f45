"""A posterior of two parameters whose map, density and headlines are known by hand: no fit, nothing compiled."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
from scipy import optimize, stats
from support.partial_arrays import no_gears, partial_arrays

from tvsbayes.estimators.campaign_arrays import CampaignArrays
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.model.gear_processes import BlockRoot
from tvsbayes.posterior.linear_campaign import LinearCampaign
from tvsbayes.posterior.look_noise import LookNoise
from tvsbayes.posterior.stop_states import StopStates
from tvsbayes.posterior.transport import Transport, curvatures

RATIO, BACKLASH = TWO_MIRROR.index["degrees_per_step.pan"], TWO_MIRROR.index["backlash_deg.pan"]
STRETCH = 0.3
"""Log of the factor on the second coordinate per unit of the first."""
AT_MODE = 7.0
ROWS = 4
"""Components of the one spot: the first alone sees anything."""


def no_states() -> StopStates:
    """Of axes that stop exactly."""
    return StopStates(np.zeros((ROWS, 0)), np.zeros((0, 6)), np.zeros(0))


def linear_campaign(along: np.ndarray, prior: np.ndarray, noise: int) -> LinearCampaign:
    """Of one spot at its predicted place, whose first component sees coordinates y by `along` (g,)."""
    column = np.zeros((ROWS, len(along)))
    column[0] = along
    nothing = np.zeros(0)
    looks = LookNoise.of(np.zeros((1, ROWS, 2)), np.ones(1), np.zeros(2), np.ones(2))
    of_states = np.zeros((0, noise)), nothing
    of_places = np.zeros((ROWS, 0)), lambda log_scale: BlockRoot((np.zeros((len(log_scale), 0, 0)),))
    # The noise coordinate, where there is one, scales the datum as one of all pixels does.
    scales = np.ones(noise), np.zeros((2, noise))
    return LinearCampaign(np.zeros(ROWS), column, no_states(), *of_states, *of_places, prior, looks, *scales)


def route() -> Transport:
    """The map z_1 = w_1, z_2 = w_2 exp(0.3 w_1) at two of the parameters.

    The first scales the noise of the one datum of the second, which has no prior.
    """
    return Transport(
        mechanism=TWO_MIRROR,
        mode=np.zeros(len(TWO_MIRROR.names)),
        free=np.array([BACKLASH, RATIO]),
        root=np.eye(2),
        noise=1,
        narrow=0,
        slope=np.array([[STRETCH]]),
        half=np.zeros(1, bool),
        linear=linear_campaign(np.ones(1), np.zeros((1, 1)), 1),
        residuals=lambda z: np.zeros((len(z), ROWS)),
        bend=np.zeros((1, 0, 0)),
    )


NARROW_SD, CURVE, TURN = 0.02, 0.4, 0.15
"""Of the ridge below: its width, how it bends, how its slope along the second coordinate changes with the first."""
WIDE = TWO_MIRROR.index["tilt_zero_deg"]


def ridge_residual(z: np.ndarray) -> np.ndarray:
    """Of one datum, in units of its noise: z_2 (1 + 0.15 z_1) = 0.4 z_1^2 +- 0.02; shape (n, 4)."""
    wide, narrow = z[:, WIDE], z[:, RATIO]
    residual = np.zeros((len(z), ROWS))
    residual[:, 0] = -(narrow * (1 + TURN * wide) - CURVE * wide**2) / NARROW_SD
    return residual


def ridge_density(z: np.ndarray) -> np.ndarray:
    """Log posterior density, standard normal priors; 0 at the mode, the origin."""
    return -0.5 * (np.sum(ridge_residual(z) ** 2, axis=1) + z[:, WIDE] ** 2 + z[:, RATIO] ** 2)


def ridge() -> Transport:
    """The map of a wide coordinate and a narrow one that follows it along a parabola; no noise scale."""
    sd = 1 / np.hypot(1 / NARROW_SD, 1.0)
    straight = replace(
        route(),
        free=np.array([WIDE, RATIO]),
        root=np.diag([1.0, sd]),
        noise=0,
        narrow=1,
        slope=np.zeros((0, 0)),
        half=np.zeros(0, bool),
        linear=linear_campaign(np.array([0.0, sd / NARROW_SD]), np.diag([1.0, sd**2]), 0),
        residuals=ridge_residual,
        bend=np.zeros((2, 1, 1)),
    )
    return replace(straight, bend=curvatures(straight)[:, 1:, 1:])


PLAY, PLAY_SD, FOLLOW, RATIO_SD = -0.04, 0.08, -0.6, 0.3
"""Of the play below: measured value and its sd in prior scales, and the ratio that the data see: ratio - 0.6 play = 0
+- 0.3."""


def play_residual(z: np.ndarray) -> np.ndarray:
    """Of a play that was measured below zero and a ratio that follows it, by SciPy's own half-normal; shape (n, 4)."""
    play = stats.halfnorm.ppf(stats.norm.cdf(z[:, BACKLASH]))
    residual = np.zeros((len(z), ROWS))
    residual[:, 0], residual[:, 1] = (PLAY - play) / PLAY_SD, (FOLLOW * play - z[:, RATIO]) / RATIO_SD
    return residual


def play_density(z: np.ndarray) -> np.ndarray:
    """Log posterior density, standard normal priors of both coordinates."""
    return -0.5 * (np.sum(play_residual(z) ** 2, axis=1) + z[:, BACKLASH] ** 2 + z[:, RATIO] ** 2)


def play_near_zero() -> Transport:
    """The map of these two at the mode of their density."""
    mode = np.zeros(len(TWO_MIRROR.names))
    free = np.array([BACKLASH, RATIO])

    def of_two(z: np.ndarray) -> np.ndarray:
        whole = np.zeros((1, len(TWO_MIRROR.names)))
        whole[0, free] = z
        return whole

    mode[free] = optimize.minimize(lambda z: -play_density(of_two(z))[0], [-1.0, 0.0], tol=1e-14).x
    at, step = mode[BACKLASH], 1e-5
    slope = np.diff(stats.halfnorm.ppf(stats.norm.cdf([at - step, at + step])))[0] / (2 * step)
    root = np.array([[0.7, 0.0], [-0.2, 0.25]])
    jacobian = np.array([[slope / PLAY_SD, 0.0], [-FOLLOW * slope / RATIO_SD, 1 / RATIO_SD], [0, 0], [0, 0]])
    linear = replace(
        linear_campaign(np.zeros(2), (root.T * [slope**2, 1.0]) @ root, 0),
        residual=play_residual(mode[None])[0],
        along=jacobian @ root,
    )
    return replace(ridge(), mode=mode, free=free, root=root, narrow=0, linear=linear, bend=np.zeros((2, 0, 0)))


def fit() -> SimpleNamespace:
    """What a diagnosis reads of a fit."""
    free = np.isin(np.arange(len(TWO_MIRROR.names)), [RATIO, BACKLASH])
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
