"""What a fit says and how it was examined: typed, JAX-free."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field

import numpy as np

from tvsbayes.instrument.axes import DIRECTIONS

CONTRACTION_LIMIT = 0.1
"""1 - (posterior sd / prior sd)^2 below which a value is called set by the prior (DESIGN 8)."""


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

    def as_json(self) -> dict[str, object]:
        """The sampler's diagnostics are null where nothing was sampled (DESIGN 8)."""
        return {**asdict(self), "interval95": list(self.interval95)}

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

    def as_json(self) -> dict[str, object]:
        """An optional key of `fit.json`."""
        return {**asdict(self), "tests": [asdict(test) for test in self.tests]}


@dataclass(frozen=True)
class FitSummary:
    """A joint fit in the contract's terms (DESIGN 8).

    Attributes:
        converged: whether the mode was reached.
        problems: sentences on what failed.
        effective: left, right, up, down in deg/step; None for a direction that was never moved.
        contrasts: effective left - right and up - down, deg/step.
        reference_pose_deg: pan and tilt at which the effective ratios hold.
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
        sampling: diagnosis of the chain, None where nothing was sampled.
        curves: effective ratios over the range and lost motion against steps; only from a posterior.
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
    sampling: dict[str, object] | None = None
    curves: dict[str, object] | None = None
    validation: Validation | None = None
    few_stops: dict[str, int] = field(default_factory=dict)

    @property
    def headline_informed(self) -> bool:
        """Whether the data informed any effective ratio."""
        return any(e is not None and e.informed for e in self.effective.values())

    def as_json(self) -> dict[str, object]:
        """The contract's keys, without those that the caller adds (`files`)."""

        def of(estimates):
            return {name: None if e is None else e.as_json() for name, e in estimates.items()}

        parameters = of(self.parameters)
        return {
            "estimator": self.estimator,
            "converged": self.converged,
            "problems": list(self.problems),
            "effective_deg_per_step": of(self.effective),
            "effective_contrast_deg_per_step": of(self.contrasts),
            "reference_pose_deg": self.reference_pose_deg,
            "effective_jacobian": [list(row) for row in self.jacobian],
            "parameters": parameters,
            "noise": {
                "chi2": self.chi2,
                "dof": self.dof,
                "pixel_scale": self.parameters["pixel_scale"].value,
                "stop_sd_deg": {d: self.parameters[f"stop_sd_deg.{d}"].value for d in DIRECTIONS},
            },
            "weak_directions": [asdict(w) for w in self.weak_directions],
            "leverage": [{**asdict(entry), "spots": list(entry.spots)} for entry in self.leverage],
            "classic_predicted_deg_per_step": of(self.classic_predicted),
            "excluded_spots": list(self.excluded_spots),
            "suspect_spots": list(self.suspect_spots),
            "prior_conflicts": list(self.prior_conflicts),
            "prior_sensitivity": [asdict(entry) for entry in self.prior_sensitivity],
            "sampling": self.sampling,
            "curves": self.curves,
            "validation": None if self.validation is None else self.validation.as_json(),
            "few_stops": self.few_stops,
        }


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


@dataclass(frozen=True)
class Convergence:
    """Whether a chain may be used, and why not.

    Attributes:
        steps: length of the chain; discarded: first steps left out; thin: one in so many is stored.
        tau_steps: longest integrated autocorrelation time.
        rhat, ess_bulk, ess_tail: by contract name, of every sampled or derived quantity.
        acceptance: share of accepted moves by walker.
        stuck_walkers: walkers that hardly moved or live at another density.
        invalid: evaluations that gave no number.
        pareto_k: tail index of target / proposal in the last pilot draws; above 0.7 the proposal is a poor guide.
        missing: sentences on what is not reached; empty when converged.
    """

    steps: int
    discarded: int
    thin: int
    tau_steps: float
    rhat: dict[str, float]
    ess_bulk: dict[str, float]
    ess_tail: dict[str, float]
    acceptance: np.ndarray
    stuck_walkers: tuple[int, ...]
    invalid: int
    pareto_k: float
    missing: tuple[str, ...]

    @property
    def converged(self) -> bool:
        """All limits of DESIGN 4.3 are met."""
        return not self.missing

    def as_json(self) -> dict[str, object]:
        """For fit.json, key `sampling`."""
        worst = max(self.rhat, key=self.rhat.get)
        fewest = min(self.ess_bulk, key=self.ess_bulk.get)
        tail = min(self.ess_tail, key=self.ess_tail.get)
        return {
            "converged": self.converged,
            "missing": list(self.missing),
            "walkers": len(self.acceptance),
            "steps": self.steps,
            "discarded": self.discarded,
            "thin": self.thin,
            "tau_steps": self.tau_steps,
            "worst_rhat": {"quantity": worst, "value": self.rhat[worst]},
            "least_ess_bulk": {"quantity": fewest, "value": self.ess_bulk[fewest]},
            "least_ess_tail": {"quantity": tail, "value": self.ess_tail[tail]},
            "acceptance": float(self.acceptance.mean()),
            "least_acceptance": float(self.acceptance.min()),
            "stuck_walkers": list(self.stuck_walkers),
            "invalid_evaluations": self.invalid,
            "proposal_pareto_k": self.pareto_k,
        }
