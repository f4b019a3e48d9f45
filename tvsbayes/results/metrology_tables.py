"""Tables of `fit.json` and certificates that a metrologist signs: GUM budgets, ISO 230-2 figures.

Angles in deg, counters in steps; a budget names its own unit. `metrology` fills them. GUM = JCGM 100:2008; clause
numbers of ISO 230-2:2006 are given where its figures are computed.
"""

from __future__ import annotations

import numpy as np

from tvsbayes.results.records import AxisName, ClosedRecord, Count, EstimatorName, NotNegative, Record


class BudgetRow(ClosedRecord, frozen=True):
    """A line of a budget; fields as in `Source`, None where a line sums up several or is the correlation row.

    Attributes:
        dof: degrees of freedom; None for stated values, which have infinitely many (GUM G.4.3).
        contribution: sensitivity times u, signed, in the unit of the result.
        share: share of the combined variance; negative where correlations reduce it.
    """

    quantity: str
    unit: str
    estimate: float | None
    u: float | None
    kind: str
    distribution: str
    dof: float | None
    sensitivity: float | None
    contribution: float | None
    share: float


class BudgetTable(ClosedRecord, frozen=True):
    """A GUM uncertainty budget.

    Attributes:
        quantity, unit: name and unit of the result.
        estimate: the result.
        rows: largest contribution first; the last one is `CORRELATIONS`, so that the shares sum to 1.
        u: combined standard uncertainty (GUM 5.1.2, 5.2.2).
        dof: effective degrees of freedom (GUM eq. G.2b); None where those of all inputs are infinite.
        coverage_factor: k = t_p(dof) (GUM G.4.1).
        probability: coverage probability p.
        expanded: U = k u.
        notes: remarks for the reader.
    """

    quantity: str
    unit: str
    estimate: float
    rows: tuple[BudgetRow, ...]
    u: NotNegative
    dof: float | None
    coverage_factor: float
    probability: float
    expanded: NotNegative
    notes: tuple[str, ...]


FIGURES: dict[str, tuple[str, str]] = {
    "reversal_deg": ("B", "reversal error of the axis"),
    "mean_reversal_deg": ("mean B", "mean reversal error"),
    "repeatability_up_deg": ("R up", "unidirectional repeatability, up"),
    "repeatability_down_deg": ("R down", "unidirectional repeatability, down"),
    "repeatability_deg": ("R", "bidirectional repeatability"),
    "systematic_up_deg": ("E up", "unidirectional systematic deviation, up"),
    "systematic_down_deg": ("E down", "unidirectional systematic deviation, down"),
    "systematic_deg": ("E", "bidirectional systematic deviation"),
    "mean_systematic_deg": ("M", "mean bidirectional deviation"),
    "accuracy_up_deg": ("A up", "unidirectional accuracy, up"),
    "accuracy_down_deg": ("A down", "unidirectional accuracy, down"),
    "accuracy_deg": ("A", "bidirectional accuracy"),
}
"""Fields of `Positioning` with one number per test: symbol and term of ISO 230-2."""


class Positioning(ClosedRecord, frozen=True):
    """ISO 230-2 figures of one axis. Leading array axes (...) are tests; m is the number of targets.

    Attributes:
        mean_up_deg, mean_down_deg: mean deviation per target and side, shape (..., m).
        sd_up_deg, sd_down_deg: their standard deviations (n - 1), shape (..., m).
        reversal_at_deg: B_i, up minus down, signed, shape (..., m).
        reversal_deg: B = max |B_i|, shape (...), as for all fields below.
        mean_reversal_deg: mean of B_i, signed.
        repeatability_deg: R.
        repeatability_up_deg, repeatability_down_deg: R of one side.
        systematic_deg: E.
        systematic_up_deg, systematic_down_deg: E of one side.
        mean_systematic_deg: M.
        accuracy_deg: A.
        accuracy_up_deg, accuracy_down_deg: A of one side.
    """

    mean_up_deg: np.ndarray
    mean_down_deg: np.ndarray
    sd_up_deg: np.ndarray
    sd_down_deg: np.ndarray
    reversal_at_deg: np.ndarray
    reversal_deg: np.ndarray
    mean_reversal_deg: np.ndarray
    repeatability_up_deg: np.ndarray
    repeatability_down_deg: np.ndarray
    repeatability_deg: np.ndarray
    systematic_up_deg: np.ndarray
    systematic_down_deg: np.ndarray
    systematic_deg: np.ndarray
    mean_systematic_deg: np.ndarray
    accuracy_up_deg: np.ndarray
    accuracy_down_deg: np.ndarray
    accuracy_deg: np.ndarray


class IsoTarget(Record, frozen=True):
    """A position of a test by ISO 230-2; null where its runs do not give a number.

    Attributes:
        position: the target, a command.
        mean_forward, mean_backward: mean deviation of the runs from one side, actual less target.
        s_forward, s_backward: its standard deviation (n - 1).
        reversal: B_i, forward less backward, signed.
        runs_forward, runs_backward: number of runs.
    """

    position: float
    mean_forward: float | None
    s_forward: float | None
    mean_backward: float | None
    s_backward: float | None
    reversal: float | None
    runs_forward: Count
    runs_backward: Count


class Predicted(ClosedRecord, frozen=True):
    """Median and equal-tailed 95 % interval of a figure over simulated tests."""

    median: float
    interval95: tuple[float, float]


class AxisPositioning(ClosedRecord, frozen=True):
    """ISO 230-2-style table of one axis.

    Attributes:
        axis: pan or tilt.
        deg_per_step: target angle per counter step.
        predicted: field of `FIGURES` -> median and interval over tests simulated from the draws; None if the axis has
            no moves.
        target_steps: targets of the simulated tests.
        runs: simulated runs per target and side.
        estimator: "posterior" or "laplace": source of the draws.
        plug_in: figures of the campaign's own stops, no leading axis; None for the reason in `missing`.
        plug_in_steps: counters of its targets.
        plug_in_runs: runs (up, down) at each of them.
        reading_u_deg: root mean square standard uncertainty of one reading from pixel noise, which is in every s.
        missing: why there is no plug-in table.
        notes: remarks: the test is indirect, its assumptions, and effects that it does not cover.
    """

    axis: AxisName
    deg_per_step: float
    target_steps: tuple[int, ...]
    runs: int
    estimator: EstimatorName
    plug_in_steps: tuple[int, ...]
    plug_in_runs: tuple[tuple[int, int], ...]
    reading_u_deg: float | None
    missing: str | None
    notes: tuple[str, ...]
    predicted: dict[str, Predicted] | None
    plug_in: Positioning | None
