"""The true headlines of a simulated campaign: the line through its looks (formulation 3.2).

Degrees of the beam per step are the slope of the least-squares line of the beam's azimuth (elevation) on the pan (tilt)
counter over the looks used. Each look counts once, with mirrors and transmission error, without play, stop error and
drift, the other axis at its mean. The estimators have their own formulas.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tvsbayes.instrument.axes import AXES, FULL_TURN_DEG, SENSES
from tvsbayes.instrument.campaign import Campaign
from tvsbayes.instrument.mechanisms import mechanism_of
from tvsbayes.twin.gear_errors import GearErrors
from tvsbayes.twin.physics import harmonics_deg, mirror_chain, wobble_deg

SLOPE_STEP_RAD = 1e-5
"""Step of central differences of the mirrors: truncation 1e-10, rounding 1e-11."""


def looks_steps(campaign: Campaign) -> np.ndarray:
    """Return counters (n, 2) of pan and tilt at the looks that every estimator uses, those with status ok."""
    at = {move.move: (move.pan_steps, move.tilt_steps) for move in campaign.moves}
    return np.array([at[spot.move] for spot in campaign.spots if spot.status == "ok"], float).reshape(-1, 2)


def effective_deg_per_step(
    parameters: Mapping[str, float],
    errors: GearErrors,
    campaign: Campaign,
    pose_deg: tuple[float, float] | None = None,
) -> dict[str, float] | None:
    """Compute the true headline of every direction over the looks of a campaign; None without looks.

    It is the line's slope, plus or minus half the contrast times the mean slope of the mirrors over the looks. For an
    axis at one counter in all looks the mirrors' slope times the mean ratio replaces the line's.

    Args:
        parameters: parameters of the true rig, by contract name.
        errors: errors of its gears.
        campaign: campaign of the looks; its rig states the period of `harmonic_deg`.
        pose_deg: mean angles of (pan, tilt), at which either axis is for the line of the other; by default those by the
            mean ratio.
    """
    steps = looks_steps(campaign)
    if not len(steps):
        return None
    counters = tuple(steps.T)
    mirrors = [
        _mirror_deg(parameters, errors, axis, counters[i], campaign.rig.first_period_deg.get(axis, FULL_TURN_DEG))
        for i, axis in enumerate(AXES)
    ]
    ratios: dict[str, float] = {}
    for i, axis in enumerate(AXES):
        angle_deg = mirrors[i]
        others_deg = float(np.mean(mirrors[1 - i])) if pose_deg is None else pose_deg[1 - i]
        slope = float(np.mean(_mirror_slope(parameters, i, angle_deg, others_deg)))
        offset = counters[i] - counters[i].mean()
        if offset.any():
            line = float(offset @ _beam_deg(parameters, i, angle_deg, others_deg) / (offset @ offset))
        else:
            line = parameters[f"degrees_per_step.{axis}"] * slope
        half = 0.5 * parameters[f"ratio_contrast_deg_per_step.{axis}"] * slope
        ratios |= dict(zip(SENSES[axis], (line + half, line - half), strict=True))
    return ratios


def _mirror_deg(
    parameters: Mapping[str, float], errors: GearErrors, axis: str, counters: np.ndarray, period_deg: float
) -> np.ndarray:
    """Compute the mirror angle (n,) of an axis by mean ratio and transmission error alone."""
    angle_deg = parameters[f"degrees_per_step.{axis}"] * counters
    error_deg = errors[axis].error_deg(angle_deg) + wobble_deg(angle_deg, harmonics_deg(parameters, axis), period_deg)
    return angle_deg + error_deg + (parameters[mechanism_of(parameters).tilt_zero] if axis == "tilt" else 0.0)


def _beam_deg(parameters: Mapping[str, float], axis: int, angle_deg: np.ndarray, others_deg: float) -> np.ndarray:
    """Compute azimuth or elevation (n,) of the beam for mirror angles of an axis, continued over turns and zenith."""
    moving, other = np.radians(angle_deg), np.full(len(angle_deg), np.radians(others_deg))
    psi, beta = (moving, other) if axis == 0 else (other, moving)
    direction = mirror_chain(psi, beta, parameters).direction
    beam = np.arctan2(direction[:, 1], direction[:, 0])
    if axis == 1:
        beam = np.arcsin(direction[:, 2])
        folded = np.abs(np.angle(np.exp(1j * (np.pi - beam - moving)))) < np.abs(np.angle(np.exp(1j * (beam - moving))))
        beam[folded] = np.pi - beam[folded]
    # The beam follows its mirror to some degrees, except for a constant such as a head's azimuth zero.
    ahead = np.exp(1j * (beam - moving))
    constant = np.angle(ahead.mean())
    return np.degrees(moving + constant + np.angle(ahead * np.exp(-1j * constant)))


def _mirror_slope(parameters: Mapping[str, float], axis: int, angle_deg: np.ndarray, others_deg: float) -> np.ndarray:
    """Compute d(azimuth)/d(psi) or d(elevation)/d(beta) (n,) at mirror angles of that axis."""
    step = np.degrees(SLOPE_STEP_RAD)
    ahead, behind = (_beam_deg(parameters, axis, angle_deg + sign * step, others_deg) for sign in (1, -1))
    return (ahead - behind) / (2 * step)
