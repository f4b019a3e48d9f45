"""Measuring protocols: the paper's experiments and grids of poses as plans, and what a sequence of moves can tell.

Counters in steps, mm where a name says so. No JAX.

A start is `reversed` when it is reached by a move against the experiment's direction (play opens within the
experiment), `cleared` when it is reached by a move along it (play already taken up), and `direct` when it is
reached from wherever the axis stands.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import pairwise

import numpy as np

from tvsbayes.campaign import APPROACH_SIGN, Campaign, Move, PlanStep
from tvsbayes.classic import select_experiments, triangulate

DIRECTION_SIGNS = {"left": ("pan", 1), "right": ("pan", -1), "up": ("tilt", 1), "down": ("tilt", -1)}
PAN_RANGE_STEPS = (0, 200)
TILT_RANGE_STEPS = (-100, 100)
NEAREST_SHEET_MM, FARTHEST_SHEET_MM = 20.0, 100_000.0
"""Depths between which a sheet can stand: nearer than a lens barrel, or beyond a hall, is a mismatched pair."""
INSEPARABLE, INSEPARABLE_ONE_LENGTH = 0.9, 0.7
"""Correlation of ratio and backlash above which four fifths (half, where every leg has one length) of the ratio's
variance is exchange with the backlash. Equal numbers of cleared and reversed legs of one length give 0.55."""
SHALLOW = 1.2
"""Ratio of the largest to the smallest depth below which the sheet stood at one place (the paper's: 1.6)."""
OVERSHOOT_STEPS = 40
"""How far beyond a start an approach begins: 2.4 deg at 0.06 deg/step, beyond any play worth measuring."""
GRID_PAN_STEPS = (-60, 0, 60, 120, 180, 240)
GRID_TILT_STEPS = (-90, -30, 30, 90)


@dataclass
class _Plan:
    """Plan steps under construction and the counters they lead to."""

    steps: list[PlanStep] = field(default_factory=list)
    counters: dict[str, int] = field(default_factory=lambda: {"pan": 0, "tilt": 0})

    def home(self) -> None:
        self.counters = {"pan": 0, "tilt": 0}
        self.steps.append(PlanStep(len(self.steps), "home", 0, 0))

    def place(self, target: str) -> None:
        self.steps.append(PlanStep(len(self.steps), "place", target=target))

    def move(self, **counters: int) -> None:
        """Move to absolute counters; nothing is ordered where they are reached already."""
        if any(self.counters[axis] != value for axis, value in counters.items()):
            self.counters.update(counters)
            self.steps.append(PlanStep(len(self.steps), "move", self.counters["pan"], self.counters["tilt"]))

    def look(self, experiment: int | None = None, point: int | None = None) -> None:
        self.steps.append(PlanStep(len(self.steps), "look", experiment=experiment, point=point))

    def reach(self, axis: str, counter: int, sign: int, overshoot: int) -> None:
        """Arrive at a counter by a move of the given sign, by way of an overshoot where needed."""
        if (counter - self.counters[axis]) * sign <= 0:
            self.move(**{axis: counter - sign * overshoot})
        self.move(**{axis: counter})


def four_point_protocol(
    repeats: int = 24,
    steps: Sequence[int] = (200,),
    approaches: Mapping[str, Sequence[str]] | None = None,
    targets: tuple[str, str] = ("d1", "d2"),
    pan_range_steps: tuple[int, int] = PAN_RANGE_STEPS,
    tilt_range_steps: tuple[int, int] = TILT_RANGE_STEPS,
    overshoot_steps: int = OVERSHOOT_STEPS,
) -> tuple[PlanStep, ...]:
    """The paper's four-point experiments, in its order: point 1 at d1, 2 at d2, move N, 3 at d2, 4 at d1.

    Left and right at mid tilt, then up and down at mid pan. Positive moves start from the low end of the
    range, negative ones from the high end.

    Args:
        repeats: experiments per direction.
        steps: |N| of the experiments, taken in turn.
        approaches: direction -> "reversed", "cleared" or "direct" of its experiments, taken in turn;
            default: all direct, which is plain go and return.
        targets: names of the near and the far sheet.
        pan_range_steps: lowest and highest pan counter.
        tilt_range_steps: lowest and highest tilt counter.
        overshoot_steps: run-up where a start must be reached from the other side.
    """
    ranges = {"pan": pan_range_steps, "tilt": tilt_range_steps}
    plan, experiment = _Plan(), 0
    plan.home()
    plan.place(targets[0])
    for direction, (axis, sign) in DIRECTION_SIGNS.items():
        other = "tilt" if axis == "pan" else "pan"
        plan.move(**{other: sum(ranges[other]) // 2})
        start = ranges[axis][0 if sign > 0 else 1]
        turns = (approaches or {}).get(direction, ("direct",))
        for repeat in range(repeats):
            approach = turns[repeat % len(turns)]
            if approach == "direct":
                plan.move(**{axis: start})
            else:
                plan.reach(axis, start, sign if approach == "cleared" else -sign, overshoot_steps)
            plan.look(experiment, 1)
            plan.place(targets[1])
            plan.look(experiment, 2)
            plan.move(**{axis: start + sign * steps[repeat % len(steps)]})
            plan.look(experiment, 3)
            plan.place(targets[0])
            plan.look(experiment, 4)
            experiment += 1
    return tuple(plan.steps)


def paper_protocol(repeats: int = 24) -> tuple[PlanStep, ...]:
    """The paper's protocol as it reads: one |N| = 200, plain go and return.

    Every start but the first, where the homing stands, is then reversed.
    """
    return four_point_protocol(repeats)


def twin_protocol(repeats: int = 24) -> tuple[PlanStep, ...]:
    """The history under which one backlash per axis gives Table 1: left, down reversed; right, up cleared.

    The paper does not record how its starts were reached: this is our assumption.
    """
    history = {"left": "reversed", "right": "cleared", "up": "cleared", "down": "reversed"}
    return four_point_protocol(repeats, approaches={name: (how,) for name, how in history.items()})


def mixed_protocol(repeats: int = 24) -> tuple[PlanStep, ...]:
    """The paper's experiments with |N| = 100 and 200 in turn, and two in six from cleared starts."""
    turns = ("reversed", "reversed", "reversed", "cleared", "cleared", "reversed")
    return four_point_protocol(repeats, steps=(100, 200), approaches=dict.fromkeys(DIRECTION_SIGNS, turns))


def grid_protocol(
    targets: Sequence[str] = ("d1", "d2", "d3"),
    pan_steps: Sequence[int] = GRID_PAN_STEPS,
    tilt_steps: Sequence[int] = GRID_TILT_STEPS,
    overshoot_steps: int = OVERSHOOT_STEPS,
) -> tuple[PlanStep, ...]:
    """A grid of poses at every sheet, each pose seen once from either side of both axes.

    Rows of tilt upwards, then downwards, each axis taken up before the row's first look; rows alternate
    between left and right, and the way down takes each row the other way. One placement per sheet.
    """
    plan = _Plan()
    plan.home()
    for target in targets:
        plan.place(target)
        for tilt_sign in (1, -1):
            for row, tilt in enumerate(sorted(tilt_steps, reverse=tilt_sign < 0)):
                rank = row if tilt_sign > 0 else len(tilt_steps) - 1 - row
                pan_sign = tilt_sign * (1 if rank % 2 == 0 else -1)
                ordered = sorted(pan_steps, reverse=pan_sign < 0)
                run_up = ordered[0] - pan_sign * overshoot_steps
                if (tilt - plan.counters["tilt"]) * tilt_sign <= 0:
                    plan.move(pan=run_up, tilt=tilt - tilt_sign * overshoot_steps)
                plan.move(pan=run_up, tilt=tilt)
                for pan in ordered:
                    plan.move(pan=pan)
                    plan.look()
    return tuple(plan.steps)


PROTOCOLS = {
    "paper": paper_protocol,
    "mixed": mixed_protocol,
    "grid": grid_protocol,
    "paper_twin": twin_protocol,
}
"""Plans that `experiments/make_twins.py` ships, by file name."""


@dataclass(frozen=True)
class Stop:
    """A rest of one axis at which a usable spot was seen; `sign` is the sense of the move that led there."""

    segment: int
    steps: int
    sign: int


def observed_stops(moves: Sequence[Move], observed: Collection[int], axis: str) -> tuple[Stop, ...]:
    """Rests of one axis, in order, that the spots tell of.

    Args:
        moves: all moves in order.
        observed: numbers of the moves after which a usable spot was seen.
        axis: "pan" or "tilt".
    """
    stops: list[Stop] = []
    current, seen, previous = Stop(0, 0, 0), False, 0
    for move in moves:
        steps = move.pan_steps if axis == "pan" else move.tilt_steps
        approach = move.pan_approach if axis == "pan" else move.tilt_approach
        if approach:
            current, seen = Stop(move.segment, steps, APPROACH_SIGN[approach]), False
        elif steps != previous:
            current, seen = Stop(move.segment, steps, 1 if steps > previous else -1), False
        if move.move in observed and not seen:
            stops.append(current)
            seen = True
        previous = steps
    return tuple(stops)


def separation(stops: Sequence[Stop], axis: str) -> str | None:
    """Why a ratio and its backlash cannot be told apart well, and the smallest cure.

    With equal errors at every stop the angle is zero(segment) + k n - b sign / 2: the correlation of k and b in
    this straight line tells before any fit whether the stops separate them.

    Returns:
        A sentence, or None if nothing stands in the way.
    """
    steps = np.array([stop.steps for stop in stops], dtype=float)
    signs = np.array([stop.sign for stop in stops], dtype=float)
    if len({stop.steps for stop in stops}) < 2:
        return f"the {axis} axis was seen at one counter only; look before and after moves of that axis"
    if not (np.any(signs > 0) and np.any(signs < 0)):
        return f"every stop of the {axis} axis was reached from one side; reach some from the other"
    segments = np.array([stop.segment for stop in stops])
    zeros = (segments[:, None] == np.unique(segments)).astype(float)
    design = np.column_stack([steps / np.ptp(steps), -signs / 2, zeros])
    information = design.T @ design
    if np.linalg.matrix_rank(information) < len(information):
        correlation = 1.0
    else:
        covariance = np.linalg.inv(information)
        correlation = abs(covariance[0, 1]) / np.sqrt(covariance[0, 0] * covariance[1, 1])
    lengths = Counter(abs(b.steps - a.steps) for a, b in pairwise(stops) if a.steps != b.steps)
    if correlation < (INSEPARABLE_ONE_LENGTH if len(lengths) == 1 else INSEPARABLE):
        return None
    common = lengths.most_common(1)[0][0]
    only = f"only one |N| = {common}" if len(lengths) == 1 else f"nearly every leg has |N| = {common} and reverses"
    return f"{only}; add N = {max(common // 2, 1)} or a cleared approach"


@dataclass(frozen=True)
class CampaignCheck:
    """What `check` says of a readable campaign: counts, and warnings in words."""

    moves: int
    segments: int
    spots: int
    ok_spots: int
    refused: dict[str, int]
    aperture_readings: int
    experiments: int
    warnings: tuple[str, ...]

    def as_json(self) -> dict[str, object]:
        """The document of `check --json`."""
        return {"kind": "campaign", **asdict(self), "warnings": list(self.warnings)}


def check_campaign(campaign: Campaign) -> CampaignCheck:
    """Plausibility and identifiability of a campaign before any fit.

    Args:
        campaign: a campaign that its reader accepted.

    Returns:
        Counts and warnings; an empty tuple means that nothing stands in the way of a fit.
    """
    ok = [spot for spot in campaign.spots if spot.status == "ok"]
    refused = Counter(spot.status for spot in campaign.spots if spot.status != "ok")
    selection = select_experiments(campaign)
    warnings = [f"experiment {s.experiment} is not complete: {s.reason}" for s in selection.skipped]
    if not ok:
        warnings.append("no spot has status ok: there is nothing to estimate from")
    observed = {spot.move for spot in ok}
    for axis in ("pan", "tilt") if ok else ():
        reason = separation(observed_stops(campaign.moves, observed, axis), axis)
        if reason is not None:
            warnings.append(f"{axis} ratio and {axis} backlash are hard to tell apart: {reason}")
    for move in campaign.moves:
        if "unknown" in (move.pan_approach, move.tilt_approach):
            warnings.append(f"segment {move.segment} begins with an unknown approach: its first reversal tells less")
    if ok:
        pixels = np.array([(s.u_left_px, s.v_left_px, s.u_right_px, s.v_right_px) for s in ok])
        depth_mm = triangulate(campaign.stereo, pixels)[:, 0]
        # Not-a-number (no undistorted point) is implausible as well.
        odd = [s.spot for s, x in zip(ok, depth_mm, strict=True) if not NEAREST_SHEET_MM < x < FARTHEST_SHEET_MM]
        if odd:
            listed = ", ".join(map(str, odd[:10]))
            limits = f"{NEAREST_SHEET_MM:g} to {FARTHEST_SHEET_MM:g} mm"
            warnings.append(f"spots {listed} triangulate outside {limits}: are left and right swapped, or mismatched?")
        elif depth_mm.max() < SHALLOW * depth_mm.min():
            warnings.append("all spots lie at one depth: a second sheet position sharpens ratios threefold")
    if campaign.stereo.assumed:
        warnings.append("the stereo covariance is assumed, not estimated: uncertainties are only as good as it is")
    if not np.any(campaign.stereo.parameter_covariance):
        warnings.append(
            "the stereo covariance is zero: its error (0.3 to 0.5 % of a ratio) is missing from every interval"
        )
    return CampaignCheck(
        moves=len(campaign.moves),
        segments=1 + campaign.moves[-1].segment,
        spots=len(campaign.spots),
        ok_spots=len(ok),
        refused=dict(refused),
        aperture_readings=sum(spot.aperture_deg is not None for spot in ok),
        experiments=len(selection.experiments),
        warnings=tuple(warnings),
    )
