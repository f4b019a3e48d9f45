"""What `fit.json` says of an axis: the records and their schema. All lengths in the folder's unit."""

from __future__ import annotations

from functools import cache
from typing import Annotated, Any, Literal

from msgspec import Meta, field

from tvsbayes.display import Shown, View
from tvsbayes.results.convergence import MonteCarloError
from tvsbayes.results.estimates import Estimate, PeriodEstimate, estimates_view
from tvsbayes.results.fit_record import Provenance, Sha256
from tvsbayes.results.metrology_tables import BudgetTable
from tvsbayes.results.records import AnswerKind, Count, EstimatorName, NotNegative, Record, Tier, schema_of
from tvsbayes.single_axis.classic_line import ClassicAxis

AXIS_FIT_FORMAT = "tvsbayes-axis-fit/1"
type PeriodClock = Literal["unit", "seconds"]
type BothSides[T] = Annotated[dict[str, T], Meta(extra_json_schema={"required": ("forward", "backward")})]


class AxisDoubt(Record, frozen=True):
    """A doubt about a fit.

    Attributes:
        name: what is doubted.
        text: a sentence.
        usable: whether the numbers may be used all the same.
    """

    name: str
    text: str
    usable: bool


class PositionDeviation(Record, frozen=True):
    """Deviation of the axis at a position from the line through the stops: the repeated error without drift and play.

    Attributes:
        position: a command.
        value, sd, interval95: in the folder's unit.
    """

    position: float
    value: float
    sd: NotNegative
    interval95: tuple[float, float]


class AxisSummary(Shown, Record, frozen=True):
    """A fit in the terms of `fit.json`.

    Attributes:
        unit: unit of all values but commands, hours and shares.
        estimator: "laplace" or "posterior".
        tier: method of the posterior's draws, weighted draws or a chain; None for a Laplace approximation.
        converged: whether there is a mode, and an accepted or rough answer of the sampler, where it ran.
        problems: why the answer is not accepted.
        per_command: ratio by direction, "forward" and "backward"; valid beyond the range read.
        effective_per_command: slope of the least-squares line through the positions read, by direction.
        range_command: least and largest command read; `effective_per_command` refers to this range.
        parameters: estimates by name.
        periods: waves of the gear, stated ones first.
        encoder_periods: waves of the encoder.
        periods_in: unit of the gear's periods: "unit", that of the readings, or "seconds".
        deviations: deviations from that line, by position read.
        classic: the classic estimate.
        moves, readings, positions: numbers used.
        weak_directions, warnings: as sentences.
        sampling: diagnosis of the draws.
        prior_conflicts: priors that the readings contradict, in words.
        answer: source of the intervals: an accepted sample, a rough one, or the Laplace approximation.
        monte_carlo_error: errors of every headline, in its sd.
        effective_backlash: mean of the play over the positions read; `backlash` is the mean of all positions, read or
            not; None where no play was read.
        doubts: results that physics excludes or that rest on the priors.
        budgets: GUM budgets of `effective_per_command` (mean of both directions), `effective_backlash`, and of E and A
            of ISO 230-2 where their u is known.
    """

    unit: str
    estimator: EstimatorName
    tier: Tier | None
    converged: bool
    problems: tuple[str, ...]
    per_command: BothSides[Estimate]
    effective_per_command: BothSides[Estimate]
    range_command: tuple[float, float]
    parameters: dict[str, Estimate]
    deviations: tuple[PositionDeviation, ...]
    classic: ClassicAxis
    moves: Count
    readings: Count
    positions: Count
    weak_directions: tuple[str, ...]
    warnings: tuple[str, ...]
    sampling: dict[str, float | int | None]
    prior_conflicts: tuple[str, ...] = ()
    answer: AnswerKind = "laplace"
    monte_carlo_error: dict[str, MonteCarloError] = field(default_factory=dict)
    periods: tuple[PeriodEstimate, ...] = ()
    encoder_periods: tuple[PeriodEstimate, ...] = ()
    periods_in: PeriodClock = "unit"
    effective_backlash: Estimate | None = None
    doubts: tuple[AxisDoubt, ...] = ()
    budgets: tuple[BudgetTable, ...] = ()

    @property
    def explained(self) -> bool:
        """Whether there is a mode, which sampling needs."""
        return self.converged or bool(self.sampling)

    def shown(self) -> View:
        """Show ratios by direction, then every parameter."""
        estimates = {f"per_command.{side}": e for side, e in self.per_command.items()}
        estimates |= {f"effective_per_command.{side}": e for side, e in self.effective_per_command.items()}
        estimates |= {name: e for name, e in self.parameters.items() if name != "per_command"}
        state = "converged" if self.converged else "NOT CONVERGED"
        return estimates_view(f"AxisSummary in {self.unit}, {self.estimator}, {state}", estimates)


class AxisInputs(Record, frozen=True):
    """SHA-256 of the inputs of a fit."""

    moves: Sha256
    readings: Sha256
    axis: Sha256


@cache
def axis_fit_schema() -> dict[str, Any]:
    """The JSON schema of `results/fit.json` in an axis folder."""
    return schema_of(AxisSummary, Provenance, format={"const": AXIS_FIT_FORMAT}, inputs=AxisInputs)
