"""Results of a fit: estimates, their dependence on data and priors, tests and residuals of the model.

Values in the units of the names: deg, deg/step, mm, rad, px; time in s, counters in steps.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import msgspec
import numpy as np
from msgspec import UNSET, Meta, UnsetType

from tvsbayes.display import Shown, View
from tvsbayes.instrument.axes import AXES, DIRECTIONS
from tvsbayes.instrument.homing import ANYWHERE
from tvsbayes.instrument.parameters import NOISE_NAMES
from tvsbayes.results.convergence import MonteCarloError, Sampling
from tvsbayes.results.records import (
    AllDirections,
    AnswerKind,
    AxisName,
    BothAxes,
    ByAxis,
    ByDirection,
    ClosedRecord,
    Count,
    EstimatorName,
    FromOne,
    NotNegative,
    Positive,
    Probability,
    Record,
    Tier,
)

CONTRACTION_LIMIT = 0.1
"""1 - (posterior sd / prior sd)^2 below which a value counts as set by the prior."""
CONFLICT_LIMIT = 4.0
"""Limit in prior sds; in 3 of 1000 campaigns with correct priors one of fifty parameters exceeds it."""
CONFLICT_REMEDY = "check the sign of the counters and the unit, or state the prior wider"


def conflict_sentence(quantity: str, distance: float, centre: str = "", remedy: str = CONFLICT_REMEDY) -> str:
    """Describe a prior that the data contradict.

    Args:
        quantity: name and value.
        distance: distance of the value from the prior's centre, in prior sds; infinite where the prior fixes it.
        centre: centre of the prior, where it should be stated.
        remedy: the remedy.
    """
    far = f"{distance:.1f} prior sds" if np.isfinite(distance) else "beyond every bound"
    return f"{quantity} lies {far} from its prior's centre{centre and f', {centre}'}: {remedy}"


type Contraction = Annotated[float, Meta(le=1)]
type HomingSide = Annotated[str, Meta(extra_json_schema={"enum": (*DIRECTIONS, ANYWHERE)})]
type ParameterName = Annotated[str, Meta(pattern=r"^[a-z0-9_]+(\.[a-z0-9_]+)*$")]
ALWAYS_ESTIMATED = (
    *("degrees_per_step.pan", "degrees_per_step.tilt", "backlash_deg.pan", "backlash_deg.tilt"),
    "pixel_scale",
)
"""Parameters that every `fit.json` contains."""


class Uncertain(Record, frozen=True):
    """A quantity with its standard uncertainty."""

    value: float
    sd: NotNegative


class Measured(Uncertain, frozen=True):
    """Summary of a quantity's draws.

    Attributes:
        value, sd, interval95: mean, standard uncertainty, central interval.
    """

    interval95: tuple[float, float]


class Estimate(Measured, frozen=True, forbid_unknown_fields=True):
    """One estimated quantity.

    Attributes:
        value: mode of a Laplace approximation, or mean of a posterior.
        sd: standard deviation.
        interval95: equal-tailed.
        prior_sd: standard deviation of the prior; None where nothing is estimated.
        contraction: 1 - var_post / var_prior; None where nothing is estimated.
        rhat, ess_bulk, ess_tail: diagnosis of a sampler; None where none ran.
    """

    prior_sd: NotNegative | None
    contraction: Contraction | None
    rhat: float | None = None
    ess_bulk: float | None = None
    ess_tail: float | None = None
    always: ClassVar = ("rhat", "ess_bulk", "ess_tail")

    @property
    def informed(self) -> bool:
        """Whether the data, not the prior, set the value."""
        return self.contraction is not None and self.contraction >= CONTRACTION_LIMIT


def estimates_view(title: str, named: Mapping[str, Estimate]) -> View:
    """Estimates by name, each with the share of its prior variance that the data removed."""
    rows = [
        (name, e.value, e.sd, *e.interval95, None if e.contraction is None else round(100 * e.contraction, 1))
        for name, e in named.items()
    ]
    return View(title, ("quantity", "value", "sd", "2.5 %", "97.5 %", "set by the data, %"), rows)


def varies_beyond(variation: Estimate | None, play: Estimate | None) -> bool:
    """Whether a play that is there varies by more than itself, so that it would be negative at some positions.

    Args:
        variation: sd of its variation by position; None where there is none.
        play: its mean; None where none was seen.
    """
    if variation is None or play is None or not variation.informed or not play.interval95[0] > 0:
        return False
    return variation.value > play.value and variation.interval95[0] > 0.5 * play.value


class WeakDirection(ClosedRecord, frozen=True):
    """A combination of parameters that the data do not constrain beyond the prior; loadings are in prior sds."""

    text: str
    loadings: dict[str, float]

    @property
    def of_sums(self) -> bool:
        """Whether it names scales of noise of which the data determine only sums of variances."""
        return self.loadings.keys() <= set(NOISE_NAMES)


class Leverage(ClosedRecord, frozen=True):
    """A stop without which the sd of `quantity` would grow by `factor` (None: without bound)."""

    move: Count
    spots: tuple[Count, ...]
    quantity: str
    factor: float | None
    text: str


class PriorSensitivity(ClosedRecord, frozen=True):
    """Change of a headline if the u of one prior were multiplied by `factor`.

    Attributes:
        shift_sd: change of the value in its present sds.
        sd_ratio: new sd over the present one.
    """

    parameter: str
    quantity: str
    factor: Positive
    shift_sd: float
    sd_ratio: NotNegative


class ValidationTest(ClosedRecord, frozen=True):
    """One test of a fit's residuals for a defect.

    Attributes:
        name: the defect.
        where: most suspicious place or period, in words.
        chi2: score statistic there, distributed as chi-square with `dof` if the model holds.
        dof: number of independent amplitudes of the defect that the fit's parameters do not absorb.
        places: number of places or periods tested.
        p: probability of a statistic this large in a campaign without defects, at any place.
        failed: whether p is too small, all tests taken together.
        shift_sd: largest shift of a ratio or backlash by the defect at its estimated size, in their sds.
    """

    name: str
    where: str
    chi2: NotNegative
    dof: FromOne
    places: FromOne
    p: Probability
    failed: bool
    shift_sd: NotNegative


class Validation(ClosedRecord, frozen=True):
    """Whether the residuals of a fit agree with its model.

    Attributes:
        passed: no test failed.
        level: probability that a campaign without defects does not pass.
        cause: the defect that explains the residuals best, in words; empty where all passed.
        inflation: factor on every standard uncertainty; 1 where all passed.
        tests: every test that the campaign allows.
    """

    passed: bool
    level: Probability
    cause: str
    inflation: Annotated[float, Meta(ge=1)]
    tests: tuple[ValidationTest, ...]

    @property
    def widens(self) -> bool:
        """Whether the factor differs from 1.00; it covers no effects of single spots."""
        return f"{self.inflation:.2f}" != "1.00"


class CurvePoint(ClosedRecord, frozen=True):
    """Local ratios at one pose of the mirrors, deg/step; directions without moves are left out."""

    pan_deg: float
    tilt_deg: float
    left: Measured | UnsetType = UNSET
    right: Measured | UnsetType = UNSET
    up: Measured | UnsetType = UNSET
    down: Measured | UnsetType = UNSET

    @property
    def ratios(self) -> dict[str, Measured]:
        """Local ratios of the directions with moves."""
        values = {direction: getattr(self, direction) for direction in DIRECTIONS}
        return {direction: ratio for direction, ratio in values.items() if ratio is not UNSET}


class LostMotion(ClosedRecord, frozen=True):
    """Lost motion of a reversal over a number of steps, deg."""

    steps: Count
    value_deg: NotNegative
    sd_deg: NotNegative
    interval95_deg: tuple[float, float]


class Curves(ClosedRecord, frozen=True, rename={"ratios": "effective_deg_per_step"}):
    """Predictions of a posterior for other poses and step counts.

    Attributes:
        ratios: local ratios along the observed angles of each axis.
        lost_motion: by direction, for the step counts used.
    """

    ratios: BothAxes[tuple[CurvePoint, ...]]
    lost_motion: ByDirection[tuple[LostMotion, ...]]


class PeriodEstimate(Record, frozen=True):
    """One wave. Where several periods explain the data, value and sd are those of the most likely, intervals of all.

    Attributes:
        period: for an axis in the unit of the readings, or s; for a scanner in deg of the output.
        amplitude: amplitude of the first harmonic, in the unit of the output; half the difference from crest to trough.
        phase_deg: the wave is highest where 360 x / period is the phase; x is |unit per command| x command, `time_s`,
            or the reading for a wave of the encoder. About its circular mean: intervals may leave -180 to 180.
        source: whether the period was stated or inferred.
        probability: probability that the wave exists.
    """

    period: Measured
    amplitude: Measured
    phase_deg: Measured
    source: Literal["stated", "inferred"]
    probability: Probability


class GearPeriod(PeriodEstimate, frozen=True):
    """A wave in the gears of one axis of a scanner."""

    axis: AxisName


class FitNoise(ClosedRecord, frozen=True):
    """Goodness of fit, and the estimated noise.

    Attributes:
        chi2: sum of squared standardised innovations.
        dof: their number minus the parameters that they determine.
        pixel_scale: estimated pixel noise over the stated one.
        stop_sd_deg: standard deviation of the stops, by direction of arrival.
        look_scatter_deg: standard deviation of single looks, by axis; absent from results of 0.2.0 and before.
    """

    chi2: NotNegative
    dof: float
    pixel_scale: NotNegative
    stop_sd_deg: AllDirections[NotNegative]
    look_scatter_deg: BothAxes[NotNegative] | UnsetType = UNSET


def fit_noise(chi2: float, dof: float, parameters: Mapping[str, Estimate]) -> FitNoise:
    """The noise of a fit with these estimates."""
    stops = {direction: parameters[f"stop_sd_deg.{direction}"].value for direction in DIRECTIONS}
    # The parameter is absent where a rig states that looks do not scatter.
    scatters = {axis: parameters.get(f"look_scatter_deg.{axis}") for axis in AXES}
    looks: dict[str, float] = {axis: 0.0 if scatter is None else scatter.value for axis, scatter in scatters.items()}
    return FitNoise(chi2, dof, parameters["pixel_scale"].value, stops, looks)


_LONG_KEYS = {
    "effective": "effective_deg_per_step",
    "contrasts": "effective_contrast_deg_per_step",
    "local": "local_deg_per_step",
    "jacobian": "effective_jacobian",
    "classic_predicted": "classic_predicted_deg_per_step",
}


class FitSummary(Shown, Record, frozen=True, kw_only=True, rename=_LONG_KEYS):
    """Summary of a joint fit, with the documented names.

    Attributes:
        estimator: "posterior" if the numbers come from a converged sample, else "laplace".
        tier: method of a posterior's draws, weighted draws or a chain; None for a Laplace approximation.
        converged: the mode was reached and explains the data, and sampling, if any, gave an answer.
        answer: "accepted" or "rough" for a posterior, "laplace" for the approximation at the mode; None in results of
            0.2.0 and before.
        monte_carlo_error: errors of every headline of a sampled posterior.
        problems: sentences on failures.
        effective: left, right, up, down in deg/step, slopes of the lines through the looks used; None for a direction
            without moves.
        contrasts: effective left - right and up - down, deg/step.
        local: gear ratio times the slope of the mirrors at the reference pose, without transmission error; deg/step.
        range_steps: lowest and highest counter of each axis in the looks used: the range of the effective ratios.
        homing_side: probability of each homing hypothesis, for an axis without recorded homing sides.
        reference_pose_deg: mean mirror angles, pan and tilt, of the looks used.
        jacobian: d(azimuth, elevation)/d(pan, tilt) at that pose.
        parameters: every estimated or derived parameter by its name.
        noise: goodness of fit, and the estimated noise.
        weak_directions: combinations that the campaign cannot separate, in words.
        leverage: stops on which a headline depends strongly.
        classic_predicted: the classic estimate that the model predicts, per direction.
        excluded_spots: left out by the robust option.
        suspect_spots: used, but inconsistent with all others.
        prior_conflicts: parameters that the data move far from the stated value, in words.
        prior_sensitivity: priors that would move a headline if they were twice or half as wide.
        sampling: diagnosis of the draws, None where nothing was sampled.
        curves: local ratios over the range and lost motion against steps; only from a posterior.
        validation: whether the residuals agree with the model; None where it was not tested.
        few_stops: directions with so few observed stops that their scatter is poorly known, with the number.
        periods: waves of the periods that the rig states, given that they exist; only from a posterior.
    """

    estimator: EstimatorName
    tier: Tier | None = None
    converged: bool
    answer: AnswerKind | None = None
    monte_carlo_error: dict[str, MonteCarloError] = msgspec.field(default_factory=dict)
    problems: tuple[str, ...]
    effective: AllDirections[Estimate | None]
    contrasts: BothAxes[Estimate | None]
    local: ByDirection[Estimate | None] = msgspec.field(default_factory=dict)
    range_steps: ByAxis[tuple[int, int]] = msgspec.field(default_factory=dict)
    homing_side: ByAxis[dict[HomingSide, float]] = msgspec.field(default_factory=dict)
    reference_pose_deg: BothAxes[float]
    jacobian: tuple[tuple[float, float], tuple[float, float]]
    parameters: Annotated[dict[ParameterName, Estimate], Meta(extra_json_schema={"required": ALWAYS_ESTIMATED})]
    noise: FitNoise
    weak_directions: tuple[WeakDirection, ...]
    leverage: tuple[Leverage, ...]
    classic_predicted: AllDirections[Estimate | None]
    excluded_spots: tuple[Count, ...]
    suspect_spots: tuple[Count, ...]
    prior_conflicts: tuple[str, ...]
    prior_sensitivity: tuple[PriorSensitivity, ...]
    sampling: Sampling | None
    curves: Curves | None
    validation: Validation | None = None
    few_stops: ByDirection[Count] = msgspec.field(default_factory=dict)
    periods: tuple[GearPeriod, ...] = ()

    def shown(self) -> View:
        """Show every estimate but the cameras' parameters."""
        kind = {"laplace": "Laplace approximation", "posterior": "posterior"}[self.estimator]
        title = f"FitSummary, {kind}, {'converged' if self.converged else 'NOT CONVERGED'}"
        if self.validation is not None and not self.validation.passed:
            title += f"; VALIDATION FAILED: {self.validation.cause}"
            title += f", u times {self.validation.inflation:.2f}" * self.validation.widens
        return estimates_view(title, {name: e for name, e in self.named.items() if not name.startswith("stereo.")})

    @property
    def named(self) -> dict[str, Estimate]:
        """Effective ratios of directions with moves, then parameters, by name."""
        ratios = {f"effective_deg_per_step.{d}": e for d, e in self.effective.items() if e is not None}
        return ratios | self.parameters

    @property
    def explained(self) -> bool:
        """Whether a mode explains the data; only then is the posterior sampled."""
        return self.converged or self.sampling is not None

    @property
    def looks(self) -> str:
        """What the looks of the campaign are called: cameras that see spots stand somewhere, sightings have none."""
        return "spots" if "extrinsics.translation_mm.x" in self.parameters else "sightings"

    @property
    def headline_informed(self) -> bool:
        """Whether the data informed any effective ratio."""
        return any(e is not None and e.informed for e in self.effective.values())


class StopResidual(ClosedRecord, frozen=True):
    """Deviation of one rest of one axis from the fitted model.

    Attributes:
        axis: "pan" or "tilt".
        spots: ids of the spots observed during it.
        steps: counter.
        direction: direction of the preceding move; "" where the approach is unknown.
        leg_steps: length of that move, 0 for a homing.
        depth_mm: X of its spots in frame S, by the stated cameras.
        within: for each spot, its deviation from the mean of the rest's preceding spots, in standard deviations of that
            difference by pixel noise; None for the first, empty for a single spot. Every second rest is taken in
            reverse order, so that no position within a rest is always the reference.
        time_s: time of the move after which it was first observed.
        deviation_deg: observed - fitted mirror angle, stop error included.
        u_deg: its standard deviation by the fitted noise (pixel noise and stop error).
    """

    axis: AxisName
    spots: tuple[Count, ...]
    steps: int
    direction: Annotated[str, Meta(extra_json_schema={"enum": (*DIRECTIONS, "")})]
    leg_steps: Count
    depth_mm: tuple[float, ...]
    within: tuple[float | None, ...]
    time_s: float
    deviation_deg: float
    u_deg: NotNegative


class CauseGroup(ClosedRecord, frozen=True):
    """Stops of one axis that share a value of a cause: mean of deviation / u, and its standard error."""

    label: str
    count: Count
    mean: float
    standard_error: NotNegative


class Cause(ClosedRecord, frozen=True):
    """Whether the deviations of one axis depend on one cause.

    `p` is the probability of group means as different as these if they do not depend on it (one-way analysis of
    variance), None with fewer than two groups of two.
    """

    name: str
    axis: AxisName
    groups: tuple[CauseGroup, ...]
    p: Probability | None
    suspicious: bool


@dataclass(frozen=True)
class HeadlineCauses:
    """Components of the uncertainty of each headline: rows of a GUM budget.

    Attributes:
        quantities: names: `effective_deg_per_step.left` ... of directions with moves, `backlash_deg.pan|tilt`.
        names: causes: pixel noise, stop errors, the stereo calibration, and every prior by its parameter's name.
        contribution: shape (quantities, causes), deg/step or deg. For a prior: signed effect of one u of its centre;
            for other causes: the root of their part of the variance.
        u: u of the priors in the unit of the parameter (log-normal: of the logarithm), shape (causes,); NaN for other
            causes, which are no single quantity.
        centre: mean of the prior (log-normal: of the logarithm), shape (causes,); NaN likewise.
        distribution: kind of distribution of each cause.
        dof: degrees of freedom behind u, shape (quantities, causes); infinite for stated values (GUM G.4.3).
    """

    quantities: tuple[str, ...]
    names: tuple[str, ...]
    contribution: np.ndarray
    u: np.ndarray
    centre: np.ndarray
    distribution: tuple[str, ...]
    dof: np.ndarray
