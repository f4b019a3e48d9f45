"""Tables that a metrologist signs under, as `fit.json` and certificates hold them: GUM budgets, ISO 230-2 figures.

Angles in deg, counters in steps; a budget names its own unit. `metrology` fills them. GUM = JCGM 100:2008; clause
numbers of ISO 230-2:2006 stand where its figures are computed.
"""

from __future__ import annotations

import numpy as np

from tvsbayes.results.records import AxisName, ClosedRecord, EstimatorName, NotNegative


class BudgetRow(ClosedRecord, frozen=True):
    """A line of a budget; fields as in `Source`, None where a line sums up several or is the correlation row.

    Attributes:
        dof: degrees of freedom; None of what was stated, whose are infinite (GUM G.4.3).
        contribution: sensitivity times u, signed, in the unit of the result.
        share: of the combined variance; negative where correlations take variance away.
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
        quantity, unit: of the result.
        estimate: the result.
        rows: largest contribution first; the last one is `CORRELATIONS`, so that the shares sum to 1.
        u: combined standard uncertainty (GUM 5.1.2, 5.2.2).
        dof: effective degrees of freedom (GUM eq. G.2b); None where no input's are finite.
        coverage_factor: k = t_p(dof) (GUM G.4.1).
        probability: coverage probability p.
        expanded: U = k u.
        notes: what the reader must know.
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
"""Fields of `Positioning` that are one number per test: symbol and term of ISO 230-2."""


class Positioning(ClosedRecord, frozen=True):
    """ISO 230-2 figures of one axis. Any leading axes (...) are tests; m targets.

    Attributes:
        mean_up_deg, mean_down_deg: mean deviation per target and side, shape (..., m).
        sd_up_deg, sd_down_deg: their standard deviations (n - 1), shape (..., m).
        reversal_at_deg: B_i, up minus down, signed, shape (..., m).
        reversal_deg: B = max |B_i|, shape (...), as all that follow.
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


class Predicted(ClosedRecord, frozen=True):
    """Median and equal-tailed 95 % interval of a figure over simulated tests."""

    median: float
    interval95: tuple[float, float]


class AxisPositioning(ClosedRecord, frozen=True):
    """ISO 230-2-style table of one axis.

    Attributes:
        axis: pan or tilt.
        deg_per_step: targets are this times the counter.
        predicted: field of `FIGURES` -> median and interval over tests simulated from the draws; None if the axis
            never moved.
        target_steps: targets of the simulated tests.
        runs: simulated runs per target and side.
        estimator: "posterior" or "laplace": where the draws come from.
        plug_in: figures of the campaign's own stops, no leading axis; None where `missing` says why.
        plug_in_steps: counters of its targets.
        plug_in_runs: runs (up, down) at each of them.
        reading_u_deg: root mean square standard uncertainty of one reading from pixel noise, which is in every s.
        missing: why there is no plug-in table.
        notes: that it is indirect, what it rests on and what it does not cover.
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
