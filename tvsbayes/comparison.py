"""What a calibration is worth in millimetres: error maps of three estimators, and what the uncertainty consists of.

Frame T, mm; counters in steps. The draws of a calibration stand for the rigs that the data allow: on each of them the
beam is followed to a range, the aperture reads it, and every estimator is asked where the spot is. Nominal and classic
users are given what is fair (DESIGN 5): a baseline shortened by the mirror offset, its middle moved by half of that,
and readings in the convention their equations expect.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from tvsbayes.calibration import INPUT_NAMES, Calibration, direction_of
from tvsbayes.classic import ClassicResult
from tvsbayes.coordinates import (
    DIVERGING_SHARE,
    NOISES,
    Settings,
    Sources,
    beams_at,
    half_baseline,
    meeting,
    model_from,
    propagate,
    sources,
)
from tvsbayes.likelihood import aperture_angle
from tvsbayes.model import Beam
from tvsbayes.rigs import RIG_PRIORS, Prior

STOP_HERE, APERTURE_HERE, PLAY_HERE = "stop error here", "aperture noise here", "unknown approach here"
"""Causes that belong to the one look and not to the calibration."""


@dataclass(frozen=True)
class SimpleCalibration:
    """What a user of published equations knows: C = C0 + k n, beta = k n, no backlash (DESIGN 5).

    Attributes:
        deg_per_step: by direction (left, right, up, down): counters above zero were reached left or up.
        baseline_mm: distance from the aperture to where the beam leaves the positioner, a - L.
        origin_y_mm: where it leaves it in frame T, a/2 - L: the middle between both is moved by -L/2.
        pan_zero_emission_deg: C0.
    """

    deg_per_step: Mapping[str, float]
    baseline_mm: float
    origin_y_mm: float
    pan_zero_emission_deg: float


def simple_calibration(
    priors: Mapping[str, Prior] = RIG_PRIORS, classic: ClassicResult | None = None
) -> SimpleCalibration:
    """The nominal calibration of stated priors, or with the classic estimator's ratios.

    Directions that the classic estimator did not measure keep their nominal ratio.
    """
    nominal = {"left": "pan", "right": "pan", "up": "tilt", "down": "tilt"}
    ratios = {direction: priors[f"degrees_per_step.{axis}"].value for direction, axis in nominal.items()}
    if classic is not None:
        measured = {d: r.mean_deg_per_step for d, r in classic.directions.items() if r is not None}
        ratios |= measured
    a, offset = priors["baseline_mm"].value, priors["mirror_offset_mm"].value
    return SimpleCalibration(ratios, a - offset, 0.5 * a - offset, priors["pan_zero_emission_deg"].value)


def simple_rays(simple: SimpleCalibration, steps: np.ndarray) -> Beam:
    """Beams (points) of a simple calibration at counters (points, 2).

    The azimuth C0 + k n and the elevation k n are turned into a direction, so that either convention of the
    aperture's angle meets it as it should.
    """
    steps = np.asarray(steps, dtype=float)
    k = simple.deg_per_step
    pan = np.where(steps[:, 0] >= 0, k["left"], k["right"]) * steps[:, 0] + simple.pan_zero_emission_deg - 90.0
    tilt = np.where(steps[:, 1] >= 0, k["up"], k["down"]) * steps[:, 1]
    direction = direction_of(pan, tilt)
    origin = np.zeros_like(direction)
    origin[1] = simple.origin_y_mm
    return Beam(jnp.asarray(origin), jnp.asarray(direction))


@dataclass(frozen=True)
class ErrorMap:
    """Errors over pan, tilt and range; arrays (pan, tilt, range), not a number where nothing can be located.

    Attributes:
        pan_steps, tilt_steps, range_mm: the axes; ranges along the beam.
        rms_mm: root mean square distance from the true point, by estimator.
        bias_mm: mean error vector, by estimator, shape (pan, tilt, range, 3).
        inside: counters within those of the campaign.
        valid: every estimator asked finds a point in all but `coordinates.DIVERGING_SHARE` of the draws.
    """

    pan_steps: np.ndarray
    tilt_steps: np.ndarray
    range_mm: np.ndarray
    rms_mm: Mapping[str, np.ndarray]
    bias_mm: Mapping[str, np.ndarray]
    inside: np.ndarray
    valid: np.ndarray


class _Errors(eqx.Module):
    error_mm: Float[Array, "estimators draws 3 points"]
    meets: Bool[Array, "estimators draws points"]


@eqx.filter_jit
def _errors(settings: Settings, range_mm: Array, known: tuple[Beam, ...], a_mm: Array, given: Sources) -> _Errors:
    """Errors of beams that are taken as known, on every draw of the rig."""

    def one(inputs, noise):
        model = model_from(inputs, given.period_deg)
        true = beams_at(model, settings.steps, settings.side, noise)
        points = true.origin_mm + range_mm * true.direction
        receiver = model.receiver
        # `aperture_angle` works in frame P; a rig whose frames coincide takes points of frame T moved to the pan axis.
        aligned = eqx.tree_at(lambda r: r.pan_zero_emission_rad, receiver, jnp.asarray(jnp.pi / 2))
        moved = points - half_baseline(receiver.baseline_mm, range_mm)
        angle = aperture_angle(aligned, moved, given.azimuth_convention)
        reading = angle + receiver.aperture_zero_rad + receiver.aperture_sd_rad * noise[4]
        found = [
            meeting(rays.origin_mm, rays.direction, a, reading - zero, given.azimuth_convention)
            for rays, a, zero in zip(known, a_mm[0], a_mm[1], strict=True)
        ]
        return jnp.stack([f.xyz_mm - points for f in found]), jnp.stack([f.meets for f in found])

    error, meets = jax.vmap(one)(given.inputs, given.noise)
    return _Errors(error.transpose(1, 0, 2, 3), meets.transpose(1, 0, 2))


def error_map(
    calibration: Calibration,
    pan_steps: Sequence[float] | np.ndarray,
    tilt_steps: Sequence[float] | np.ndarray,
    range_mm: Sequence[float] | np.ndarray,
    *,
    simple: Mapping[str, SimpleCalibration],
    approach: tuple[float, float] = (1.0, 1.0),
    draws: int = 500,
    seed: int = 0,
) -> ErrorMap:
    """Expected errors of the joint calibration and of simple ones, over the rigs that the data allow.

    Args:
        calibration: with draws.
        pan_steps: counters, shape (p,).
        tilt_steps: counters, shape (t,).
        range_mm: ranges along the beam, shape (r,).
        simple: further calibrations by name, such as "nominal" and "classic", from `simple_calibration`.
        approach: sides, +1 left or up, -1 right or down.
        draws: rigs.
        seed: of their stop errors and aperture noise.

    Returns:
        The map; the joint calibration is "joint".
    """
    axes = [np.asarray(x, dtype=float) for x in (pan_steps, tilt_steps, range_mm)]
    pan, tilt, ranges = (x.ravel() for x in np.meshgrid(*axes, indexing="ij"))
    given = sources(calibration, draws, seed)
    steps = np.stack([pan, tilt], axis=1)
    with jax.enable_x64(True):
        settings = Settings(
            jnp.asarray(steps), jnp.tile(jnp.asarray(approach, dtype=float), (len(pan), 1)), jnp.zeros(len(pan))
        )
        best = jnp.concatenate([given.mean[: len(INPUT_NAMES)], given.stop_sd_deg])
        estimate = model_from(best, given.period_deg)
        joint = beams_at(estimate, settings.steps, settings.side, jnp.zeros(NOISES))
        names = ("joint", *simple)
        known = (joint, *(simple_rays(s, steps) for s in simple.values()))
        a = calibration.estimates["baseline_mm"]
        # `meeting` puts the aperture at half the distance it is given; a simple user's stands at origin - baseline.
        bases = [a, *(2 * (s.baseline_mm - s.origin_y_mm) for s in simple.values())]
        zeros = [np.radians(calibration.estimates["aperture_zero_deg"]), *(0.0 for _ in simple)]
        found = _errors(settings, jnp.asarray(ranges), known, jnp.asarray([bases, zeros]), given)
    shape = tuple(len(x) for x in axes)
    rms, bias, valid = {}, {}, np.ones(shape, dtype=bool)
    for name, error, meets in zip(names, np.asarray(found.error_mm), np.asarray(found.meets), strict=True):
        share = (~meets).mean(axis=0)
        kept = np.where(meets[:, None], error, 0.0)
        count = np.maximum(meets.sum(axis=0), 1)
        usable = share <= DIVERGING_SHARE
        square = np.sum(kept**2, axis=(0, 1)) / count
        rms[name] = np.where(usable, np.sqrt(square), np.nan).reshape(shape)
        bias[name] = np.where(usable, kept.sum(axis=0) / count, np.nan).T.reshape(*shape, 3)
        valid &= usable.reshape(shape)
    (pan_low, pan_high), (tilt_low, tilt_high) = calibration.range_steps
    within = (pan >= pan_low) & (pan <= pan_high) & (tilt >= tilt_low) & (tilt <= tilt_high)
    return ErrorMap(*axes, rms_mm=rms, bias_mm=bias, inside=within.reshape(shape), valid=valid)


@dataclass(frozen=True)
class Budget:
    """What the variance of one point consists of, by the law of propagation.

    Attributes:
        causes: pixel noise, stop errors of the campaign, stereo calibration, focal scale, every prior, and what this
            one look adds.
        share: of the total variance (sum over x, y, z), shape (causes,); sums to 1.
        variance_mm2: by cause and coordinate, shape (causes, 3).
        parameters: names of the inputs and of this look's noises.
        contribution_mm: sensitivity times standard uncertainty, shape (parameters, 3).
        correlation: of the parameters, shape (parameters, parameters); their contributions do not add up without it.
        covariance_mm2: of the point, shape (3, 3).
    """

    causes: tuple[str, ...]
    share: np.ndarray
    variance_mm2: np.ndarray
    parameters: tuple[str, ...]
    contribution_mm: np.ndarray
    correlation: np.ndarray
    covariance_mm2: np.ndarray

    def as_json(self) -> dict[str, object]:
        """Causes with share and standard uncertainty, parameters with signed contributions and correlations."""
        u = np.sqrt(self.variance_mm2)
        return {
            "causes": [
                {"cause": name, "share": float(share), "u_mm": row.tolist()}
                for name, share, row in zip(self.causes, self.share, u, strict=True)
            ],
            "parameters": [
                {"name": name, "contribution_mm": row.tolist()}
                for name, row in zip(self.parameters, self.contribution_mm, strict=True)
            ],
            "correlation": self.correlation.tolist(),
        }


def budget(calibration: Calibration, settings: Settings) -> Budget:
    """The uncertainty budget of one point (GUM 7.2.7 asks for it): by cause, and by parameter with correlations.

    Args:
        calibration: with causes, as a fit keeps them.
        settings: of one point.

    Raises:
        ValueError: more than one point, or a calibration that does not know its causes.
    """
    if len(settings.aperture_rad) != 1:
        raise ValueError("a budget is for one point")
    if not calibration.causes:
        raise ValueError("this calibration does not know its causes: fit the campaign again")
    given = sources(calibration, 1, 0)
    with jax.enable_x64(True):
        law = jax.tree.map(lambda x: np.asarray(x)[0], propagate(settings, given))
    count = len(INPUT_NAMES)
    calibrated, here = law.jacobian[:, :count], law.jacobian[:, count:]
    by_cause = [np.einsum("ij,jk,ik->i", calibrated, c, calibrated) for c in calibration.cause_covariance]
    variances = np.diag(np.asarray(given.covariance))[count:]
    own = here**2 * variances
    by_cause += [own[:, :2].sum(axis=1), own[:, 2:4].sum(axis=1), own[:, 4]]
    variance = np.array(by_cause)
    u = np.sqrt(np.diag(np.asarray(given.covariance)))
    # What does not vary correlates with nothing.
    safe = np.where(u > 0, u, 1.0)
    noises = (
        "stop error pan",
        "stop error tilt",
        "place in the play, pan",
        "place in the play, tilt",
        "aperture noise",
    )
    return Budget(
        causes=(*calibration.causes, STOP_HERE, PLAY_HERE, APERTURE_HERE),
        share=variance.sum(axis=1) / variance.sum(),
        variance_mm2=variance,
        parameters=(*INPUT_NAMES, *noises),
        contribution_mm=(law.jacobian * u).T,
        correlation=np.asarray(given.covariance) / np.outer(safe, safe),
        covariance_mm2=law.covariance,
    )
