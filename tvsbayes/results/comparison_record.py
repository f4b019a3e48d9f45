"""Results of comparing classic with joint and one date with another; reads and writes `results/compare.json`.

Ratios and their gaps in deg/step, angles in deg.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

from msgspec import UNSET, Meta, UnsetType

from tvsbayes.display import Shown, View
from tvsbayes.instrument.campaign import Campaign
from tvsbayes.results.records import (
    ByDirection,
    ClosedRecord,
    NotNegative,
    Probability,
    Record,
    read_record,
    stored_document,
)

COMPARISON_FORMAT = "tvsbayes-compare/1"
BETTER_CLASSIC, BETTER_JOINT, CANNOT_TELL = "classic predicts better", "joint predicts better", "cannot tell"


class GapTerm(ClosedRecord, frozen=True):
    """A term of (classic mean - effective ratio), deg/step: mean or mode, standard deviation, 95 % interval."""

    name: str
    value: float
    sd: NotNegative
    interval95: tuple[float, float]


class Gap(ClosedRecord, frozen=True):
    """Why the classic mean of one direction differs from the effective ratio; all in deg/step.

    Attributes:
        classic: the classic estimator's mean.
        joint: effective ratio.
        total: classic - joint.
        terms: its terms, which sum to `total`.
    """

    classic: float
    joint: GapTerm
    total: GapTerm
    terms: tuple[GapTerm, ...]


class Prediction(Record, frozen=True):
    """The four-point angle of one experiment, predicted from other experiments, deg.

    `classic_u_deg` is estimated from the scatter of few experiments, with `classic_dof` degrees of freedom;
    `joint_u_deg` is the spread of many predictive draws.
    """

    experiment: int
    fold: str
    direction: str
    steps: int
    angle_deg: float
    classic_deg: float
    classic_u_deg: float
    classic_dof: int
    joint_deg: float
    joint_u_deg: float


class Score(Record, frozen=True):
    """Accuracy of one estimator's predicted angles.

    Attributes:
        rms_deg: root mean square error.
        rms_block_deg: root mean square of the mean errors of blocks (fold and direction), which repeats do not average.
        coverage: share of angles inside the 95 % predictive intervals: Student's t for the classic, whose scatter is
            estimated from few experiments (GUM G.3.2), normal for the joint.
        log_density: mean log predictive density of the same distributions, per deg.
    """

    rms_deg: Annotated[float, Meta(ge=0, le=1e6)]
    rms_block_deg: Annotated[float, Meta(ge=0, le=1e6)]
    coverage: Probability
    log_density: float


class HoldOut(Shown, Record, frozen=True):
    """Classic against joint on held-out experiments.

    Attributes:
        by: "steps" (a whole |N| left out) or "regions" (a part of the range of start counters).
        predictions: one for every experiment that both could predict.
        classic: score of the classic estimator.
        joint: score of the joint estimate.
        ratio: rms_block_deg of the classic / that of the joint.
        interval95: interval of the ratio, for correlated errors (Pitman, Biometrika 31 (1939) 9; Morgan, ibid. 13;
            about zero, blocks as independent normal pairs); None with fewer than `BLOCKS_MIN` blocks.
        verdict: which estimator predicts better, or "cannot tell".
        reason: reason for the verdict.
        unseen: standard uncertainty of each ratio common to all experiments, and therefore in no residual: stereo
            calibration and focal scale, deg/step.
    """

    by: str
    predictions: tuple[Prediction, ...]
    classic: Score | None
    joint: Score | None
    ratio: float | None
    interval95: tuple[float, float] | None
    verdict: str
    reason: str
    unseen: ByDirection[Annotated[float, Meta(ge=0, le=1e6)]]

    def shown(self) -> View:
        """Scores of both estimators."""
        named = {"classic": self.classic, "joint": self.joint}
        rows = [
            (name, s.rms_deg, s.rms_block_deg, 100 * s.coverage, s.log_density)
            for name, s in named.items()
            if s is not None
        ]
        columns = ("estimator", "rms, deg", "rms of block means, deg", "inside 95 %, %", "log density")
        return View(f"HoldOut by {self.by}: {self.verdict}: {self.reason}", columns, rows)


class HeldOutPosition(Record, frozen=True, kw_only=True):
    """One position from one side, predicted from all others: mirror angles in deg for two axes, else the axis' unit.

    Attributes:
        position: command, or counter in steps of two axes.
        direction: direction of the preceding move, such as "left", "forward" or "unknown".
        n: number of looks or readings in the mean.
        mean: mean of the observed values.
        predicted, u: prediction of that mean; u includes stop errors and noise of its looks or readings.
    """

    position: float
    direction: str
    n: int
    mean: float
    predicted: float
    u: float

    @property
    def z(self) -> float:
        """Deviation of the mean from its prediction, in u."""
        return (self.mean - self.predicted) / self.u


class HeldOutCounter(HeldOutPosition, frozen=True, kw_only=True):
    """A counter of one of two axes, "pan" or "tilt"."""

    axis: str


class HeldOutReadings(HeldOutPosition, frozen=True, kw_only=True):
    """A position of one axis.

    Attributes:
        rows, inside: number of moves, and of their readings within the predicted 95 % intervals.
        classic_predicted, classic_u: from the least-squares line with one reversal and independent stops.
        end: whether it is the first or last position read.
    """

    rows: int
    inside: int
    classic_predicted: float
    classic_u: float
    end: bool

    @property
    def classic_z(self) -> float:
        """Deviation of the mean from the classic prediction, in its u."""
        return (self.mean - self.classic_predicted) / max(self.classic_u, 1e-300)


class PositionHoldOut(Record, frozen=True, kw_only=True):
    """Hold-out of all positions.

    Attributes:
        by: "positions".
        positions: every position from each side.
        rms_z: root mean square of (mean - predicted) / u; None where nothing could be predicted.
        warnings: sentences on positions that could not be predicted.
    """

    by: str = "positions"
    positions: tuple[HeldOutCounter, ...]
    rms_z: float | None
    warnings: tuple[str, ...]


class AxisHoldOut(Shown, Record, frozen=True, kw_only=True):
    """Hold-out of all positions of one axis, as for two axes, with the classic predictions.

    Attributes:
        classic_rms_z: `rms_z` of the classic line; 0 where nothing could be predicted.
        inside_share: share of held-out readings within their 95 % intervals.
    """

    by: str = "positions"
    positions: tuple[HeldOutReadings, ...]
    rms_z: float
    classic_rms_z: float
    inside_share: float
    warnings: tuple[str, ...]

    def shown(self) -> View:
        """Every position with its prediction."""
        names = ("position", "direction", "n", "mean", "predicted", "u", "classic_predicted", "classic_u")
        rows = [tuple(getattr(position, name) for name in names) for position in self.positions]
        title = f"AxisHoldOut: RMS z {self.rms_z:.2f}, classic {self.classic_rms_z:.2f}"
        return View(title, tuple(name.replace("_", " ") for name in names), rows)


def hold_out_document(held: PositionHoldOut | AxisHoldOut, unit: str) -> dict[str, object]:
    """The document of `compare --by positions --json`, without the key that the caller adds (`files`)."""
    return {"kind": "positions left out", "unit": unit, "hold_out": held.as_json()}


class Change(Record, frozen=True):
    """One quantity of two calibrations.

    Attributes:
        quantity: its key in JSON; an effective ratio there is the local ratio at the pose of the comparison.
        unit: unit of the values.
        first, second: estimates of A and B.
        difference: second - first.
        u: its standard uncertainty; errors that both calibrations share are not in it.
        normalised: difference / u; None where both calibrations hold the quantity fixed.
        significant: |normalised| beyond the limit that chance alone exceeds in 1 of 20 comparisons (all
            quantities together, Sidak).
    """

    quantity: str
    unit: str
    first: float
    second: float
    difference: float
    u: float
    normalised: float | None
    significant: bool

    @property
    def label(self) -> str:
        """The documented name of the quantity."""
        return self.quantity.replace("effective_deg_per_step", "local_deg_per_step")


class Comparison(Shown, Record, frozen=True, kw_only=True, tag_field="kind", tag="two calibrations"):
    """Two calibrations of one instrument.

    Attributes:
        reference_pose_deg: of two axes, pose (pan, tilt) of A at which both are compared.
        range_command: of one axis, first and last of the positions of A at which both are compared.
        changes: changes of the ratios there and of the backlashes.
        shared_cameras: of two axes, whether both campaigns state the same stereo calibration; its error is common.
        days: time from A to B where both state their date.
        limit: limit of |normalised|.
        verdict: conclusion, in words.
    """

    reference_pose_deg: tuple[float, float] | UnsetType = UNSET
    range_command: tuple[float, float] | UnsetType = UNSET
    changes: tuple[Change, ...]
    shared_cameras: bool | UnsetType = UNSET
    days: float | None
    limit: float
    verdict: str

    def shown(self) -> View:
        """Show the changes."""
        columns = ("quantity", "unit", "A", "B", "B - A", "u", "normalised", "significant")
        rows = [
            (c.label, c.unit, c.first, c.second, c.difference, c.u, c.normalised, c.significant) for c in self.changes
        ]
        return View(f"Comparison: {self.verdict}", columns, rows)


class ComparisonRecord(Shown, Record, frozen=True, kw_only=True, tag_field="kind", tag="classic against joint"):
    """Classic against joint, the content of `results/compare.json`.

    Attributes:
        estimator: estimator of the joint model.
        directions: why both differ, by direction; None without complete experiments.
        held_out: predictions of held-out experiments by both.
        inputs: hashes of the inputs of the campaign's estimates.
        seed: seed of the predictive draws.
    """

    format: str = COMPARISON_FORMAT
    estimator: str = "laplace"
    directions: dict[str, Gap | None]
    held_out: HoldOut
    inputs: dict[str, str]
    seed: int

    def shown(self) -> View:
        """Show how both estimators predict held-out experiments."""
        return self.held_out.shown()


def stored_hold_out(campaign: Campaign, inputs: Mapping[str, str]) -> HoldOut | None:
    """The stored hold-out of `compare`, if it was made from the data and priors with these hashes.

    Raises:
        InputError: the file is damaged or of another version, with the key.
    """
    keys = stored_document(campaign, "compare.json", (COMPARISON_FORMAT,), inputs)
    if keys is None:
        return None
    again = "run `tvsbayes compare` again"
    table = keys.table("held_out")
    record = read_record(HoldOut, table, again)
    if (record.classic is None) != (record.joint is None):
        lacking = "classic" if record.classic is None else "joint"
        raise table.refuse(lacking, "table", "scores of both estimators or of none", again)
    return record
