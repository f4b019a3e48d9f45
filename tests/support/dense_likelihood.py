"""The likelihood of a dozen spots from the covariance of all residuals written out: no filter, nothing shared.

Written from formulation 3.1 and 4.1 alone. Angles deg, or rad where named; axes ordered (pan, tilt).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from types import SimpleNamespace

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from tvsbayes.estimators.campaign_arrays import CampaignArrays
from tvsbayes.instrument.campaign import Campaign, Move, ordered_spots
from tvsbayes.twin.physics import play

SENSES = {"pan": ("left", "right"), "tilt": ("up", "down")}
SAME_PLACE = 1e-10
"""Share of a process' variance that looks at one counter have in common beyond its correlation."""


def physical(evaluated: SimpleNamespace) -> dict[str, float]:
    """Values behind an evaluation that the dense computation needs, by contract name, in deg."""
    model = evaluated.model
    values = {}
    for axis, name in enumerate(SENSES):
        values[f"degrees_per_step.{name}"] = np.degrees(model.transmission.ratio_rad_per_step[axis])
        values[f"ratio_contrast_deg_per_step.{name}"] = np.degrees(model.transmission.contrast_rad_per_step[axis])
        values[f"backlash_deg.{name}"] = np.degrees(model.transmission.backlash_rad[axis])
        values[f"transmission_error_deg.{name}"] = np.degrees(model.gears.error_rad[axis])
        values[f"transmission_error_length_deg.{name}"] = np.degrees(model.gears.length_rad[axis])
        values[f"play_variation_deg.{name}"] = np.degrees(model.gears.play_rad[axis])
        values[f"drift_deg_per_root_hour.{name}"] = np.degrees(model.gears.drift_rad_per_root_hour[axis])
        values[f"home_sd_deg.{name}"] = np.degrees(model.noise.home_sd_rad[axis])
        values[f"look_scatter_deg.{name}"] = np.degrees(model.noise.look_scatter_rad[axis])
        for number in range(3):
            amplitude, period = model.gears.amplitude_rad[axis, number], model.gears.period_rad[axis, number]
            values[f"harmonic_amplitude_deg.{name}.{number + 1}"] = np.degrees(amplitude)
            values[f"period_deg.{name}.{number + 1}"] = np.degrees(period)
    for name, index in (("left", (0, 1)), ("right", (0, 0)), ("up", (1, 1)), ("down", (1, 0))):
        values[f"stop_sd_deg.{name}"] = np.degrees(model.noise.stop_sd_rad[index])
    return values


def stop_labels(moves: Sequence[Move], axis: str) -> list[tuple[int, tuple[str, ...]]]:
    """For each move: which draw of the axis' stop error stands, and from which direction(s) it was drawn."""
    positive, negative = SENSES[axis]
    labels, number, directions = [], -1, ()
    for k, move in enumerate(moves):
        approach, steps = getattr(move, f"{axis}_approach"), getattr(move, f"{axis}_steps")
        if approach:
            number, directions = k, (positive, negative) if approach == "unknown" else (approach,)
        elif steps != getattr(moves[k - 1], f"{axis}_steps"):
            number = k
            directions = (positive,) if steps > getattr(moves[k - 1], f"{axis}_steps") else (negative,)
        labels.append((number, directions))
    return labels


def drawn_at_every_move(campaign: Campaign, arrays: CampaignArrays) -> CampaignArrays:
    """A campaign with new stop errors of both axes at every move, from where each of them came last."""
    spots = ordered_spots(campaign)
    redraw, mix = np.array(arrays.spots.redraw), np.array(arrays.spots.redraw_mix)
    for axis, (name, (positive, negative)) in enumerate(SENSES.items()):
        labels = stop_labels(campaign.moves, name)
        for i, spot in enumerate(spots):
            redraw[i, axis] = i == 0 or spot.move != spots[i - 1].move
            directions = labels[spot.move][1]
            mix[i, axis] = np.array([negative in directions, positive in directions]) / len(directions)
    return eqx.tree_at(lambda a: (a.spots.redraw, a.spots.redraw_mix), arrays, (jnp.asarray(redraw), jnp.asarray(mix)))


def play_band_deg(moves: Sequence[Move], axis: str, values: dict[str, float]) -> np.ndarray:
    """Width of the band in which the output may stand after each move, by playing both ends through."""
    mean, contrast = values[f"degrees_per_step.{axis}"], values[f"ratio_contrast_deg_per_step.{axis}"]
    b = values[f"backlash_deg.{axis}"]
    widths = np.zeros(len(moves))
    starts = [k for k, m in enumerate(moves) if m.pan_approach]
    for begin, end in pairwise([*starts, len(moves)]):
        if getattr(moves[begin], f"{axis}_approach") != "unknown":
            continue
        steps = np.array([getattr(m, f"{axis}_steps") for m in moves[begin:end]], float)
        turned = np.diff(steps)
        q = mean * steps[0] + np.concatenate([[0.0], np.cumsum(turned * (mean + np.sign(turned) * contrast / 2))])
        widths[begin:end] = play(q, q[0] + b / 2, b) - play(q, q[0] - b / 2, b)
    return widths


def matern(distance_deg: float, length_deg: float) -> float:
    """Correlation of smoothness 5/2: (1 + x + x^2 / 3) e^-x, x = sqrt(5) distance / length."""
    x = np.sqrt(5) * abs(distance_deg) / length_deg
    return (1 + x + x * x / 3) * np.exp(-x)


@dataclass(frozen=True)
class RepeatedCovariances:
    """Covariances of transmission error and play, deg^2, at two counters of one axis."""

    values: dict[str, float]
    axis: str

    def _of(self, name: str) -> float:
        return self.values[f"{name}.{self.axis}"]

    def _distance_deg(self, one: int, other: int) -> float:
        return self._of("degrees_per_step") * (one - other)

    def error(self, one: int, other: int) -> float:
        """Of the transmission error e: Matern, and a cosine of random phase for each stated period."""
        distance = self._distance_deg(one, other)
        value = self._of("transmission_error_deg") ** 2 * matern(distance, self._of("transmission_error_length_deg"))
        variance = self._of("transmission_error_deg") ** 2
        for number in (1, 2, 3):
            amplitude = self.values[f"harmonic_amplitude_deg.{self.axis}.{number}"]
            value += amplitude**2 * np.cos(2 * np.pi * distance / self.values[f"period_deg.{self.axis}.{number}"])
            variance += amplitude**2
        return value + SAME_PLACE * variance * (one == other)

    def play(self, one: int, other: int) -> float:
        """Of what the play is wider by than its mean."""
        correlation = matern(self._distance_deg(one, other), self._of("transmission_error_length_deg"))
        return self._of("play_variation_deg") ** 2 * (correlation + SAME_PLACE * (one == other))


def side(directions: tuple[str, ...]) -> int:
    """+1 where a stop was reached left or up, -1 right or down, 0 where unknown."""
    return 0 if len(directions) > 1 else 1 if directions[0] in ("left", "up") else -1


def angle_covariances(campaign: Campaign, values: dict[str, float], *, persistent: bool = True) -> np.ndarray:
    """Covariance of what the angles (pan, tilt) of all ordered spots are off by, rad^2, shape (2, n, n)."""
    moves, spots = campaign.moves, ordered_spots(campaign)
    homing_h = {m.segment: m.time_s / 3600 for m in reversed(moves)}
    covariances = np.zeros((2, len(spots), len(spots)))
    for axis, name in enumerate(SENSES):
        labels, repeated = stop_labels(moves, name), RepeatedCovariances(values, name)
        band_sd = play_band_deg(moves, name, values) / np.sqrt(12)
        for i, first in enumerate(spots):
            for j, second in enumerate(spots):
                one, other = moves[first.move], moves[second.move]
                (number, directions), (number_there, directions_there) = labels[first.move], labels[second.move]
                shared = 0.0
                if number == number_there and (persistent or first.move == second.move):
                    shared += np.mean([values[f"stop_sd_deg.{d}"] ** 2 for d in directions])
                # The zero of an absolute encoder is one for all segments, and walks from the first move on.
                absolute, hours = name in campaign.rig.absolute, min(one.time_s, other.time_s) / 3600
                if one.segment == other.segment:
                    shared += values[f"home_sd_deg.{name}"] ** 2 * (one.segment > 0 and not absolute)
                    shared += band_sd[first.move] * band_sd[second.move]
                if one.segment == other.segment or absolute:
                    hours -= homing_h[0 if absolute else one.segment]
                    shared += values[f"drift_deg_per_root_hour.{name}"] ** 2 * hours
                at, there = getattr(one, f"{name}_steps"), getattr(other, f"{name}_steps")
                shared += values[f"look_scatter_deg.{name}"] ** 2 * (i == j)
                shared += repeated.error(at, there)
                shared += side(directions) * side(directions_there) / 4 * repeated.play(at, there)
                covariances[axis, i, j] = np.radians(np.radians(shared))
    return covariances


def residual_covariance(covariance_rad2: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Of all residuals (4 n, 4 n): unit noise, and what the angles are off by, through slopes (n, 4, 2)."""
    size = 4 * len(slope)
    return np.eye(size) + np.einsum("aij,iua,jva->iujv", covariance_rad2, slope, slope).reshape(size, size)


def dense_log_density(
    campaign: Campaign,
    evaluated: SimpleNamespace,
    values: dict[str, float] | None = None,
    *,
    persistent: bool = True,
) -> float:
    """Log likelihood from the covariance of all residuals written out, without any filter.

    `values` are those behind the evaluation unless they are given.
    """
    n = len(ordered_spots(campaign))
    residual, slope = evaluated.terms.residual[:n].ravel(), evaluated.terms.slope[:n]
    errors = angle_covariances(campaign, values or physical(evaluated), persistent=persistent)
    covariance = residual_covariance(errors, slope)
    chi2 = residual @ np.linalg.solve(covariance, residual)
    return float(evaluated.terms.log_scale[:n].sum() - 0.5 * np.linalg.slogdet(covariance)[1] - 0.5 * chi2)
