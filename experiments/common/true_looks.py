"""Looks at points whose truth is known, by the twin's optics, and what nominal and classic calibrations say of them.

The machine is homed and sent to counters from given sides; the beam, with a stop error of its own, meets a target at a
range, and the aperture reads it. Points in mm of the frame T, readings in degrees.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import stats

from tvsbayes.coordinates.simple_calibration import assumed_geometry, simple_calibrations
from tvsbayes.estimators.four_point import classic_of
from tvsbayes.instrument.axes import AXES, SIDES
from tvsbayes.instrument.campaign import Campaign
from tvsbayes.twin.gear_errors import PERFECT
from tvsbayes.twin.physics import aperture_angle_deg, mirror_chain, to_tvs
from tvsbayes.twin.simulated_campaign import SimulatedCampaign
from tvsbayes.twin.true_rig import Truth

ELLIPSOID = stats.chi2.isf(0.05, 3)
"""d^T S^-1 d of the border of a 95 % ellipsoid."""
RANGE_MM = 250.0, 1200.0
ESTIMATORS = ("nominal", "classic", "joint")


@dataclass
class TrueLooks:
    """Looks of one true rig and its aperture's convention: counters, sides, points, readings of each, in order."""

    truth: Truth
    convention: str
    generator: np.random.Generator
    counters: list[np.ndarray] = field(default_factory=list)
    sides: list[tuple[str, str]] = field(default_factory=list)
    points: list[np.ndarray] = field(default_factory=list)
    readings: list[float] = field(default_factory=list)

    @property
    def counters_steps(self) -> np.ndarray:
        """Counters (looks, 2) of pan and tilt."""
        return np.array(self.counters)

    @property
    def points_mm(self) -> np.ndarray:
        """True points (looks, 3)."""
        return np.array(self.points)

    def add(self, counters: np.ndarray, range_mm: float | None = None, span_mm: tuple[float, float] = (0, 0)) -> None:
        """One look from random sides, at a range or at a random one within `span_mm`."""
        signs = self.generator.choice([-1, 1], 2)
        reach = self.generator.uniform(*span_mm) if range_mm is None else range_mm
        p, angles, names = self.truth.parameters, [], []
        for k, axis in enumerate(AXES):
            names.append(SIDES[axis][int(signs[k] > 0)])
            place = np.array([p[f"degrees_per_step.{axis}"] * counters[k]])
            repeated = (self.truth.gear_errors or PERFECT)[axis]
            play_deg = repeated.play_at(p[f"backlash_deg.{axis}"], place)[0]
            rest = place[0] + repeated.error_deg(place)[0] - 0.5 * signs[k] * play_deg
            angles.append(rest + self.generator.standard_normal() * p[f"stop_sd_deg.{names[k]}"])
        origin, direction = mirror_chain(np.radians(angles[0]), np.radians(angles[1] + p["tilt_zero_deg"]), p)
        point = to_tvs(origin + reach * direction, p["baseline_mm"], p["pan_zero_emission_deg"])
        angle = aperture_angle_deg(point, p["baseline_mm"], self.convention) + p["aperture_zero_deg"]
        self.readings.append(float(angle + p["aperture_sd_deg"] * self.generator.standard_normal()))
        self.counters.append(np.asarray(counters))
        self.sides.append((names[0], names[1]))
        self.points.append(point)

    def errors_of_others_mm(self, campaign: Campaign) -> dict[str, np.ndarray]:
        """Errors (looks, 3) of the nominal and the classic calibration; NaN without complete experiments."""
        result = {"classic": np.full_like(self.points_mm, np.nan)}
        azimuth = campaign.rig.aperture_convention == "azimuth"
        for name, simple in simple_calibrations(campaign.rig.priors, classic_of(campaign)).items():
            points = assumed_geometry(simple, *self.counters_steps.T).points(np.array(self.readings), azimuth)
            result[name] = points.T - self.points_mm
        return result


def looks_around(
    simulated: SimulatedCampaign, range_steps: np.ndarray, outside: Sequence[bool], seed: int
) -> TrueLooks:
    """A look for every entry: inside the counters (2, 2) of a campaign, or up to half their span beyond their ends."""
    generator = np.random.default_rng([seed, 7])
    looks = TrueLooks(simulated.truth, simulated.campaign.rig.aperture_convention, generator)
    low, high = range_steps.T
    for beyond in outside:
        place = generator.uniform(0, 1, 2)
        if beyond:
            place = np.where(generator.uniform(size=2) < 0.5, -0.5 * place, 1 + 0.5 * place)
        looks.add(np.round(low + place * (high - low)), span_mm=RANGE_MM)
    return looks


def squared_distance(error: np.ndarray, covariance: np.ndarray, usable: np.ndarray, otherwise: float) -> np.ndarray:
    """d^T S^-1 d (points,) of errors (points, 3) under covariances (points, 3, 3); `otherwise` where unusable."""
    distance = np.full(len(error), otherwise)
    inverse = np.linalg.inv(covariance[usable])
    distance[usable] = np.einsum("pi,pij,pj->p", error[usable], inverse, error[usable])
    return distance


def or_none(values: np.ndarray) -> list[float | None]:
    """Numbers for a row: None for what is not a number."""
    return [None if np.isnan(v) else float(v) for v in values]
