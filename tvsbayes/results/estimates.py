"""What a fit says and how it was examined: estimates, what they hang on, tests and residuals of its model.

Values in the units of the contract names: deg, deg/step, mm, rad, px; time in s, counters in steps.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from tvsbayes.display import Shown, View
from tvsbayes.instrument.axes import AXES, DIRECTIONS
from tvsbayes.results.convergence import Sampling
from tvsbayes.results.records import plain

CONTRACTION_LIMIT = 0.1
"""1 - (posterior sd / prior sd)^2 below which a value is called set by the prior."""
CONFLICT_LIMIT = 4.0
"""Prior standard deviations; of fifty parameters one lies beyond it in 3 of 1000 honest campaigns."""
CONFLICT_REMEDY = "check the sign of the counters and the unit, or state the prior wider"


def conflict_sentence(quantity: str, distance: float, centre: str = "", remedy: str = CONFLICT_REMEDY) -> str:
    """A prior that the data contradict, in words.

    Args:
        quantity: name and value.
        distance: of the value from the prior's centre, in prior sds; infinite where the prior holds it exactly.
        centre: what the prior says, where it is worth saying.
        remedy: what to do.
    """
    far = f"{distance:.1f} prior sds" if np.isfinite(distance) else "beyond every bound"
    return f"{quantity} lies {far} from its prior's centre{centre and f', {centre}'}: {remedy}"


SUMMARY_KEYS = (
    *("estimator", "tier", "converged", "problems", "effective_deg_per_step", "effective_contrast_deg_per_step"),
    *(
        "local_deg_per_step",
        "range_steps",
        "homing_side",
        "reference_pose_deg",
        "effective_jacobian",
        "parameters",
        "noise",
        "weak_directions",
        "leverage",
    ),
    *("classic_predicted_deg_per_step", "excluded_spots", "suspect_spots", "prior_conflicts", "prior_sensitivity"),
    *("sampling", "curves", "validation", "few_stops"),
)
"""Of a summary in `fit.json`, in order; `noise` gathers what other keys hold."""
KEPT_AS = {
    "effective_deg_per_step": "effective",
    "effective_contrast_deg_per_step": "contrasts",
    "local_deg_per_step": "local",
    "effective_jacobian": "jacobian",
    "classic_predicted_deg_per_step": "classic_predicted",
}
"""Fields of `FitSummary` whose key in `fit.json` is longer."""


@dataclass(frozen=True)
class Estimate:
    """One estimated quantity; `contraction` = 1 - var_post / var_prior, None where nothing is estimated.

    `value` is the mode of a Laplace approximation or the mean of a posterior; the last three are a sampler's.
    """

    value: float
    sd: float
    interval95: tuple[float, float]
    prior_sd: float | None
    contraction: float | None
    rhat: float | None = None
    ess_bulk: float | None = None
    ess_tail: float | None = None

    @property
    def informed(self) -> bool:
        """Whether the data, not the prior, set the value."""
        return self.contraction is not None and self.contraction >= CONTRACTION_LIMIT


@dataclass(frozen=True)
class WeakDirection:
    """A mixture of parameters that the data leave to the prior; loadings are in prior sds."""

    text: str
    loadings: dict[str, float]


@dataclass(frozen=True)
class Leverage:
    """A stop without which the sd of `quantity` would grow by `factor` (None: beyond all bounds)."""

    move: int
    spots: tuple[int, ...]
    quantity: str
    factor: float | None
    text: str


@dataclass(frozen=True)
class PriorSensitivity:
    """What a headline would do if the u of one prior were multiplied by `factor`.

    `shift_sd` is the change of the value in its present sds, `sd_ratio` the new sd over the present one.
    """

    parameter: str
    quantity: str
    factor: float
    shift_sd: float
    sd_ratio: float


@dataclass(frozen=True)
class ValidationTest:
    """One question to the residuals of a fit: is there a trace of this defect?

    Attributes:
        name: defect.
        where: most suspicious place or period, in words.
        chi2: score statistic there, distributed as chi-square with `dof` if the model holds.
        dof: sizes of the defect that the fit would not swallow.
        places: how many places or periods were asked about.
        p: probability of such a statistic in a clean campaign, any place.
        failed: whether p is too small, all tests taken together.
        shift_sd: most that the defect, in the size seen, would move a ratio or backlash, in their sds.
    """

    name: str
    where: str
    chi2: float
    dof: int
    places: int
    p: float
    failed: bool
    shift_sd: float


@dataclass(frozen=True)
class Validation:
    """Whether the residuals of a fit look as its model says.

    Attributes:
        passed: no test failed.
        level: probability with which a clean campaign does not pass.
        cause: the defect that explains the residuals best, in words; empty where all passed.
        inflation: factor on every standard uncertainty; 1 where all passed.
        tests: every question that the campaign can answer.
    """

    passed: bool
    level: float
    cause: str
    inflation: float
    tests: tuple[ValidationTest, ...]

    @property
    def widens(self) -> bool:
        """Whether the factor differs from 1.00: what single spots do to results is in none."""
        return f"{self.inflation:.2f}" != "1.00"


@dataclass(frozen=True)
class RatioAt:
    """A local ratio at one pose, deg/step: mean, standard deviation, equal-tailed 95 % interval."""

    value: float
    sd: float
    interval95: tuple[float, float]


@dataclass(frozen=True)
class CurvePoint:
    """Local ratios of the directions that moved, at one pose of the mirrors."""

    pan_deg: float
    tilt_deg: float
    ratios: dict[str, RatioAt]


@dataclass(frozen=True)
class LostMotion:
    """What a reversal takes from so many steps, deg."""

    steps: int
    value_deg: float
    sd_deg: float
    interval95_deg: tuple[float, float]


@dataclass(frozen=True)
class Curves:
    """What a posterior says of other poses and step counts.

    Attributes:
        ratios: by axis ("pan", "tilt"): local ratios along the angles of that axis that were seen.
        lost_motion: by direction, for the step counts that were used.
    """

    ratios: dict[str, tuple[CurvePoint, ...]]
    lost_motion: dict[str, tuple[LostMotion, ...]]

    def as_json(self) -> dict[str, object]:
        """As `fit.json` has them: the ratios of a pose stand beside its angles."""

        def flat(point: CurvePoint) -> dict[str, object]:
            return {"pan_deg": point.pan_deg, "tilt_deg": point.tilt_deg, **plain(point.ratios)}

        along = {axis: [flat(point) for point in points] for axis, points in self.ratios.items()}
        return {"effective_deg_per_step": along, "lost_motion": plain(self.lost_motion)}


@dataclass(frozen=True, repr=False)
class FitSummary(Shown):
    """A joint fit in the contract's terms.

    Attributes:
        converged: whether the mode was reached.
        problems: sentences on what failed.
        effective: left, right, up, down in deg/step, slopes of the lines through the looks used; None for a direction
            that was never moved.
        contrasts: effective left - right and up - down, deg/step.
        local: gear ratio times the slope of the mirrors at the reference pose, without transmission error; deg/step.
        range_steps: lowest and highest counter of each axis that the looks used saw: where the effective ratios hold.
        homing_side: of an axis whose homing sides nobody recorded: probability of each way of homing.
        reference_pose_deg: mean mirror angles, pan and tilt, of the looks used.
        jacobian: d(azimuth, elevation)/d(pan, tilt) there.
        parameters: every estimated or derived parameter by its name.
        chi2: squared standardised innovations; dof: their number less the parameters they determine.
        weak_directions: what the campaign cannot separate, in words.
        leverage: stops on which a headline hangs.
        classic_predicted: what the classic estimator should report if the model is right, per direction.
        excluded_spots: left out by the robust option.
        suspect_spots: used, but in disagreement with all others.
        prior_conflicts: parameters that the data pull far from what was stated, in words.
        prior_sensitivity: priors that would move a headline if they were twice or half as wide.
        estimator: "posterior" if a converged sample stands behind the numbers, else "laplace".
        tier: what made a posterior's draws, "importance" or "emcee"; None of a Laplace approximation.
        sampling: diagnosis of the draws, None where nothing was sampled.
        curves: local ratios over the range and lost motion against steps; only from a posterior.
        validation: whether the residuals look as the model says; None where nobody asked.
        few_stops: directions in which so few stops were seen that their scatter is poorly known, with the number.
    """

    converged: bool
    problems: tuple[str, ...]
    effective: dict[str, Estimate | None]
    contrasts: dict[str, Estimate | None]
    reference_pose_deg: dict[str, float]
    jacobian: tuple[tuple[float, float], tuple[float, float]]
    parameters: dict[str, Estimate]
    chi2: float
    dof: float
    weak_directions: tuple[WeakDirection, ...]
    leverage: tuple[Leverage, ...]
    classic_predicted: dict[str, Estimate | None]
    excluded_spots: tuple[int, ...]
    suspect_spots: tuple[int, ...]
    prior_conflicts: tuple[str, ...]
    prior_sensitivity: tuple[PriorSensitivity, ...]
    estimator: str = "laplace"
    tier: str | None = None
    sampling: Sampling | None = None
    curves: Curves | None = None
    validation: Validation | None = None
    few_stops: dict[str, int] = field(default_factory=dict)
    local: dict[str, Estimate | None] = field(default_factory=dict)
    range_steps: dict[str, tuple[int, int]] = field(default_factory=dict)
    homing_side: dict[str, dict[str, float]] = field(default_factory=dict)

    def shown(self) -> View:
        """Every estimate but the cameras' parameters."""
        kind = {"laplace": "Laplace approximation", "posterior": "posterior"}[self.estimator]
        title = f"FitSummary, {kind}, {'converged' if self.converged else 'NOT CONVERGED'}"
        if self.validation is not None and not self.validation.passed:
            title += f"; VALIDATION FAILED: {self.validation.cause}"
            title += f", u times {self.validation.inflation:.2f}" * self.validation.widens
        named = {f"effective_deg_per_step.{d}": e for d, e in self.effective.items()} | self.parameters
        rows = [
            (name, e.value, e.sd, *e.interval95, None if e.contraction is None else round(100 * e.contraction, 1))
            for name, e in named.items()
            if e is not None and not name.startswith("stereo.")
        ]
        return View(title, ("quantity", "value", "sd", "2.5 %", "97.5 %", "told by the data, %"), rows)

    @property
    def headline_informed(self) -> bool:
        """Whether the data informed any effective ratio."""
        return any(e is not None and e.informed for e in self.effective.values())

    def as_json(self) -> dict[str, object]:
        """The contract's keys, without those that the caller adds (`files`)."""
        values = plain(replace(self, curves=None))
        noise = {
            "chi2": values.pop("chi2"),
            "dof": values.pop("dof"),
            "pixel_scale": self.parameters["pixel_scale"].value,
            "stop_sd_deg": {d: self.parameters[f"stop_sd_deg.{d}"].value for d in DIRECTIONS},
        }
        names = {axis: f"look_scatter_deg.{axis}" for axis in AXES}
        scatter = {axis: self.parameters[name].value for axis, name in names.items() if name in self.parameters}
        noise |= {"look_scatter_deg": scatter} if scatter else {}
        values |= {"noise": noise, "curves": None if self.curves is None else self.curves.as_json()}
        return {key: values[KEPT_AS.get(key, key)] for key in SUMMARY_KEYS}


@dataclass(frozen=True)
class StopResidual:
    """How far one rest of one axis lay from where the fitted model puts it.

    Attributes:
        axis: "pan" or "tilt".
        spots: ids of the spots that saw it.
        steps: counter.
        direction: of the move that led there; "" where the approach is unknown.
        leg_steps: length of that move, 0 for a homing.
        depth_mm: X of its spots in frame S, by the stated cameras.
        within: per spot, how far it lies from the mean of the rest's spots gone through before it, in standard
            deviations of that difference by pixel noise; None for the first, empty for a single spot. Every second
            rest is gone through backwards, so that no place in a rest is always the one the others are held against.
        time_s: of the move after which it was first seen.
        deviation_deg: observed - fitted mirror angle, stop error included.
        u_deg: its standard deviation as the fitted noise has it (pixel noise and stop error).
    """

    axis: str
    spots: tuple[int, ...]
    steps: int
    direction: str
    leg_steps: int
    depth_mm: tuple[float, ...]
    within: tuple[float | None, ...]
    time_s: float
    deviation_deg: float
    u_deg: float


@dataclass(frozen=True)
class CauseGroup:
    """Stops of one axis that share a value of a cause: mean of deviation / u, and its standard error."""

    label: str
    count: int
    mean: float
    standard_error: float


@dataclass(frozen=True)
class Cause:
    """Whether the deviations of one axis depend on one thing.

    `p` is the probability of group means as different as these if nothing depends on it (one-way analysis of
    variance), None with fewer than two groups of two.
    """

    name: str
    axis: str
    groups: tuple[CauseGroup, ...]
    p: float | None
    suspicious: bool


@dataclass(frozen=True)
class HeadlineCauses:
    """What the uncertainty of each headline consists of: rows of a GUM budget.

    Attributes:
        quantities: contract names: `effective_deg_per_step.left` ... of directions that moved, `backlash_deg.pan|tilt`.
        names: causes: pixel noise, stop errors, the stereo calibration, and every prior by its parameter's name.
        contribution: shape (quantities, causes), deg/step or deg. Of a prior: what one u of its centre does, signed;
            of the others: the root of their part of the variance.
        u: of the priors in the unit of the parameter (of a log-normal: of the logarithm), shape (causes,); NaN for the
            others, which are no single quantity.
        centre: mean of the prior (of a log-normal: of the logarithm), shape (causes,); NaN likewise.
        distribution: of each cause.
        dof: degrees of freedom behind u, shape (quantities, causes); infinite for what was stated (GUM G.4.3).
    """

    quantities: tuple[str, ...]
    names: tuple[str, ...]
    contribution: np.ndarray
    u: np.ndarray
    centre: np.ndarray
    distribution: tuple[str, ...]
    dof: np.ndarray
