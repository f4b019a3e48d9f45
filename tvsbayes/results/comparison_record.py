"""Gap, held-out scores, changes; compare.json and plan.json read back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass

from tvsbayes.files.disk import read_bytes
from tvsbayes.files.documents import JSON_BYTES_MAX, Keys, parse_json
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.campaign import Campaign


@dataclass(frozen=True)
class GapTerm:
    """A part of (classic mean - effective ratio), deg/step: mean or mode, standard deviation, 95 % interval."""

    name: str
    value: float
    sd: float
    interval95: tuple[float, float]


@dataclass(frozen=True)
class Gap:
    """Why the classic mean of one direction is not the effective ratio; all in deg/step.

    Attributes:
        classic: the classic estimator's mean.
        joint: effective ratio at the reference pose.
        total: classic - joint.
        terms: its parts, which add up to `total`.
    """

    classic: float
    joint: GapTerm
    total: GapTerm
    terms: tuple[GapTerm, ...]


BETTER_CLASSIC, BETTER_JOINT, CANNOT_TELL = "classic predicts better", "joint predicts better", "cannot tell"


@dataclass(frozen=True)
class Prediction:
    """The four-point angle of one experiment as others foretold it, deg.

    `classic_u_deg` rests on the scatter of few experiments and has `classic_dof` degrees of freedom; `joint_u_deg` is
    the spread of many predictive draws.
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


@dataclass(frozen=True)
class Score:
    """How well one estimator foretold the angles.

    Attributes:
        rms_deg: root mean square error.
        rms_block_deg: of the mean errors of the blocks (fold and direction): the part that repeats do not average.
        coverage: share of angles inside the 95 % predictive intervals: Student's t for the classic, whose scatter is
            estimated from few experiments (GUM G.3.2), normal for the joint.
        log_density: mean log predictive density of the same distributions, per deg.
    """

    rms_deg: float
    rms_block_deg: float
    coverage: float
    log_density: float


@dataclass(frozen=True)
class HoldOut:
    """Classic against joint on experiments that neither had seen.

    Attributes:
        by: "steps" (a whole |N| left out) or "regions" (a part of the range of start counters).
        predictions: of every experiment that could be foretold by both.
        classic: score.
        joint: score.
        ratio: rms_block_deg of the classic / that of the joint.
        interval95: of the ratio, for errors that go together (Pitman, Biometrika 31 (1939) 9; Morgan, ibid. 13;
            about zero, blocks as independent normal pairs); None with fewer than `BLOCKS_MIN` blocks.
        verdict: who predicts better, or "cannot tell".
        reason: of the verdict.
        unseen: standard uncertainty of each ratio that is common to all experiments, and so in no residual: stereo
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
    unseen: dict[str, float]

    def as_json(self) -> dict[str, object]:
        """Plain types."""
        return asdict(self)


@dataclass(frozen=True)
class Change:
    """One quantity of two calibrations.

    Attributes:
        quantity: contract name.
        unit: of the values.
        first, second: estimates of A and B.
        difference: second - first.
        u: its standard uncertainty; what both calibrations share is not in it.
        normalised: difference / u; None where both calibrations hold the quantity fixed.
        significant: |normalised| beyond the limit at which chance alone passes in 1 of 20 comparisons (all
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


@dataclass(frozen=True)
class Comparison:
    """Two calibrations of one instrument at one pose.

    Attributes:
        reference_pose_deg: (pan, tilt) of A, at which both are compared.
        changes: of the effective ratios and the backlashes.
        shared_cameras: both campaigns state the same stereo calibration; its error is common.
        days: from A to B where both state when they were made.
        limit: of |normalised|.
        verdict: in words.
    """

    reference_pose_deg: tuple[float, float]
    changes: tuple[Change, ...]
    shared_cameras: bool
    days: float | None
    limit: float
    verdict: str

    def as_json(self) -> dict[str, object]:
        """Plain types."""
        return {"kind": "two calibrations", **asdict(self)}


def _stored(campaign: Campaign, fit: Mapping[str, object], name: str) -> Keys | None:
    """A document in `results/`, where it was made from the data and priors of this fit."""
    path = campaign.path / "results" / name
    if not path.exists():
        return None
    keys = parse_json(read_bytes(path, JSON_BYTES_MAX), f"results/{name}")
    return keys if keys.values.get("inputs") == fit["inputs"] else None


def stored_hold_out(campaign: Campaign, fit: Mapping[str, object]) -> dict[str, object] | None:
    """The document of `compare`; what reports show of it is checked."""
    keys = _stored(campaign, fit, "compare.json")
    if keys is None:
        return None
    held = keys.table("held_out")
    held.text_value("verdict")
    held.text_value("reason", 2000)
    for name in ("classic", "joint"):
        if held.values.get(name, "") is not None:
            score = held.table(name)
            for figure in ("rms_deg", "rms_block_deg"):
                score.number(figure, 0.0, 1e6)
            score.number("coverage", 0.0, 1.0)
        elif held.values.get("classic") is not held.values.get("joint"):
            raise held.refuse(name, "table", "scores of both estimators or of none", "run `tvsbayes compare` again")
    for direction in held.table("unseen").values:
        if direction not in DIRECTIONS:
            raise held.refuse("unseen", "word", ", ".join(DIRECTIONS), "run `tvsbayes compare` again")
        held.table("unseen").number(direction, 0.0, 1e6)
    return keys.values


def stored_plan(campaign: Campaign, fit: Mapping[str, object]) -> dict[str, object] | None:
    """The document of `plan --given`; what reports show of it is checked."""
    keys = _stored(campaign, fit, "plan.json")
    if keys is None:
        return None
    again = "run `tvsbayes plan --given` again"
    for name in ("text", "unit"):
        keys.table("target").text_value(name)
    keys.number("now", 0.0, 1e6)
    stop = keys.table("stop")
    stop.flag("now")
    stop.text_value("reason", 2000)
    stop.text_value("rule", 2000)
    if keys.table("limited_by").values.get("needed") is not None:
        keys.table("limited_by").text_value("needed", 2000)
    batches = keys.values.get("next")
    if not isinstance(batches, list) or not all(isinstance(batch, dict) for batch in batches):
        raise keys.refuse("next", "list", "a list of tables", again)
    for batch in batches:
        entry = Keys(batch, keys.file, keys.text, ("next",))
        entry.text_value("text", 2000)
        for name in ("minutes", "gain", "gain_per_minute"):
            entry.number(name, -1e6, 1e6)
    return keys.values
