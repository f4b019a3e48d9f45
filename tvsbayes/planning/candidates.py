"""Looks that the rig can make, and what each adds to what is known.

`Looks` are plans whose every look is reached anew on both axes from a known side: their stop errors are independent and
information adds up look by look; of the history only the length of the path remains (it carries the contrast of the two
directions), and thousands of candidates are scored by low-rank updates. Counters in steps, angles in rad.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from tvsbayes.errors import InputError
from tvsbayes.instrument.axes import AXES, FULL_TURN_DEG, SENSES, direction_of
from tvsbayes.instrument.campaign import Move
from tvsbayes.instrument.counter_limits import CounterLimits
from tvsbayes.instrument.parameters import INDEX
from tvsbayes.instrument.plan import PlanBuilder, PlanStep
from tvsbayes.instrument.protocols import UNSTATED_STEPS
from tvsbayes.model.headlines import physical_at
from tvsbayes.model.parameter_space import ParameterSpace
from tvsbayes.planning.expectation import (
    HOME_VARIANCE_RAD2,
    LOOKS_PER_EXPERIMENT,
    PARAMETERS,
    Knowledge,
    design_arrays,
    expected_information,
)


@dataclass(frozen=True)
class Looks:
    """Looks that are each reached anew on both axes, arrays over looks.

    Attributes:
        steps: counters (pan, tilt), shape (m, 2).
        side: +1 reached left or up, -1 right or down, shape (m, 2).
        sheet: number of the sheet in the knowledge's order, shape (m,).
    """

    steps: np.ndarray
    side: np.ndarray
    sheet: np.ndarray

    def __len__(self) -> int:
        return len(self.sheet)

    def __getitem__(self, chosen: np.ndarray) -> Looks:
        return Looks(self.steps[chosen], self.side[chosen], self.sheet[chosen])


@dataclass(frozen=True)
class Arranged:
    """Looks in the order of a plan.

    Attributes:
        steps: the plan.
        order: look at each place of the plan, shape (m,).
        path: steps travelled per axis since homing when each look (in the caller's order) is taken, shape (m, 2).
    """

    steps: tuple[PlanStep, ...]
    order: np.ndarray
    path: np.ndarray


def arrange(looks: Looks, sheets: Sequence[str], overshoot: np.ndarray, home: tuple[int, int] = (0, 0)) -> Arranged:
    """Order looks into a plan: each sheet placed once, side by side, every look with a run-up where it needs one.

    Args:
        looks: what is to be seen.
        sheets: names, as `Looks.sheet` counts them.
        overshoot: run-up (pan, tilt) in steps that takes up all play, shape (2,).
        home: counters of the homing.
    """
    plan = PlanBuilder()
    plan.home(*home)
    order = np.lexsort((looks.steps[:, 0] * looks.side[:, 0], looks.side[:, 0], looks.side[:, 1], looks.sheet))
    path = np.zeros((len(looks), 2), dtype=int)
    placed = -1
    for look in order:
        if looks.sheet[look] != placed:
            placed = int(looks.sheet[look])
            plan.place(sheets[placed])
        goal, side = looks.steps[look], looks.side[look]
        run_up = (goal - plan.at) * side < overshoot
        plan.move(*np.where(run_up, goal - side * overshoot, plan.at).tolist())
        plan.move(*goal.tolist())
        path[look] = plan.travelled
        plan.look()
    return Arranged(tuple(plan.steps), order, path)


@dataclass(frozen=True)
class Seen:
    """What looks show at one point of parameter space: rows (m, 4, p + 2), slopes (m, 4, 2), and whether they do."""

    rows: np.ndarray
    slope: np.ndarray
    seen: np.ndarray
    mirror_angles_rad: np.ndarray

    def __getitem__(self, chosen: np.ndarray) -> Seen:
        return Seen(*(getattr(self, part.name)[chosen] for part in fields(Seen)))


class LookArrays:
    """Looks in front of the compiled function, in blocks of one size."""

    BLOCK = 512

    def __init__(self, looks: Looks, knowledge: Knowledge, aperture: bool):
        self.rig, self.knowledge, self.blocks = knowledge.rig, knowledge, []
        depth = np.array([knowledge.rig.sheets_mm[name] for name in knowledge.sheets])[looks.sheet]
        for begin in range(0, len(looks), self.BLOCK):
            part = slice(begin, begin + self.BLOCK)
            moves = [
                Move(i, i, 0.0, *steps, *map(direction_of, AXES, side))
                for i, (steps, side) in enumerate(zip(looks.steps[part].tolist(), looks.side[part], strict=True))
            ]
            # Each look stands for itself: no home offsets.
            arrays = design_arrays(moves, range(len(moves)), self.rig, homed_from=len(moves), aperture=aperture)
            self.blocks.append((arrays, depth[part]))

    def at(self, z: np.ndarray, space: ParameterSpace) -> Seen:
        """Evaluate at a point."""
        found = [expected_information(arrays, depth, self.rig, z, space) for arrays, depth in self.blocks]
        return Seen(*(np.concatenate([getattr(block, part.name) for block in found]) for part in fields(Seen)))


CONTRAST_COLUMNS = [INDEX["ratio_contrast_deg_per_step.pan"], INDEX["ratio_contrast_deg_per_step.tilt"]]


def information_of_looks(
    seen: Seen, chosen: np.ndarray, path: np.ndarray, space: ParameterSpace, homed: bool
) -> np.ndarray:
    """Fisher information of chosen looks, shape (p, p); equal to `information_of` of the arranged plan.

    Args:
        seen: all looks at one point.
        chosen: numbers of those taken, repeats allowed, shape (k,).
        path: steps travelled when each is taken, shape (k, 2).
        space: priors, for the scale of the contrast.
        homed: the session begins with an unknown home offset.
    """
    rows = seen.rows[chosen].copy()
    # q = sum of k_dir dn = k n + (contrast / 2) x path.
    scale = np.asarray(space.u)[CONTRAST_COLUMNS] * np.pi / 360
    rows[..., CONTRAST_COLUMNS] = rows[..., PARAMETERS:] * (path * scale)[:, None, :]
    flat = rows.reshape(-1, rows.shape[2])
    information = flat.T @ flat
    if not homed:
        return information[:PARAMETERS, :PARAMETERS]
    coupling = information[:PARAMETERS, PARAMETERS:]
    offsets = information[PARAMETERS:, PARAMETERS:] + np.eye(2) / HOME_VARIANCE_RAD2
    return information[:PARAMETERS, :PARAMETERS] - coupling @ np.linalg.solve(offsets, coupling.T)


def covariance_of(information: np.ndarray) -> np.ndarray:
    """Inverse of a positive definite matrix whose diagonal spans many orders of magnitude."""
    scale = 1 / np.sqrt(np.diag(information))
    return np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)


PAN_LEVELS, TILT_LEVELS = 9, 5
COARSE_PAN, COARSE_TILT = 31, 17
VISIBILITY_DRAWS = 24
VISIBLE_SHARE = 0.95
"""Share of draws of the instrument in which a candidate must be in both images."""
REACH_DEG = 60.0
"""Mirror angles beyond this are no candidates: a sheet is seen at grazing incidence there."""


@dataclass(frozen=True)
class Candidates:
    """Everything that a search may choose from.

    Attributes:
        looks: candidates.
        overshoot: run-up (pan, tilt), steps.
        limits: lowest and highest counter of (pan, tilt), shape (2, 2).
        turned: whether each of them lies a full turn of pan away, shape (m,).
        notes: sentences on what was left out and why.
    """

    looks: Looks
    overshoot: np.ndarray
    limits: np.ndarray
    turned: np.ndarray
    notes: tuple[str, ...]


def draws_of(knowledge: Knowledge, count: int, generator: np.random.Generator) -> np.ndarray:
    """Coordinates of instruments that may stand there, shape (count, p)."""
    root = np.linalg.cholesky(knowledge.covariance)
    return knowledge.z + generator.standard_normal((count, PARAMETERS)) @ root.T


def overshoot_steps(knowledge: Knowledge) -> np.ndarray:
    """Run-up (pan, tilt) that takes up the play in 99 % of instruments, and four stop errors, with half again."""
    draws = draws_of(knowledge, 200, np.random.default_rng(17))
    physical = np.stack([physical_at(z, knowledge.space).value for z in draws])
    result = []
    for axis, sides in SENSES.items():
        lost = np.quantile(physical[:, INDEX[f"backlash_deg.{axis}"]], 0.99)
        scatter = max(np.median(physical[:, INDEX[f"stop_sd_deg.{side}"]]) for side in sides)
        ratio = abs(np.median(physical[:, INDEX[f"degrees_per_step.{axis}"]]))
        result.append(math.ceil(1.5 * (lost + 4 * scatter) / ratio))
    return np.array(result)


@dataclass(frozen=True)
class Positions:
    """Counters (pan, tilt), shape (m, 2), each on a sheet, shape (m,)."""

    steps: np.ndarray
    sheet: np.ndarray

    @classmethod
    def grid(cls, window: np.ndarray, counts: tuple[int, int], sheets: int) -> Positions:
        """Even levels of (pan, tilt) over a window (2, 2) of lowest and highest counters, on every sheet."""
        levels = [np.unique(np.linspace(low, high, n).round()) for (low, high), n in zip(window, counts, strict=True)]
        pan, tilt, sheet = np.meshgrid(*levels, np.arange(sheets), indexing="ij")
        return cls(np.stack([pan.ravel(), tilt.ravel()], 1).astype(int), sheet.ravel())

    def __getitem__(self, chosen: np.ndarray) -> Positions:
        return Positions(self.steps[chosen], self.sheet[chosen])

    def also(self, pan_turns: Sequence[int]) -> Positions:
        """These, and the same so many steps of pan away."""
        moved = [self.steps, *(self.steps + np.array([turn, 0]) for turn in pan_turns)]
        return Positions(np.concatenate(moved), np.tile(self.sheet, len(moved)))

    def visible(self, knowledge: Knowledge, points: np.ndarray) -> np.ndarray:
        """Share of instruments at points (n, p) whose images both show the spot, shape (m,)."""
        arrays = LookArrays(Looks(self.steps, np.ones_like(self.steps), self.sheet), knowledge, False)
        return np.mean([arrays.at(z, knowledge.space).seen for z in points], axis=0)


def sided(positions: Positions, limits: np.ndarray, overshoot: np.ndarray) -> Looks:
    """Positions from all four sides whose run-up stays inside the limits (2, 2)."""
    found = []
    for side in itertools.product((1, -1), repeat=2):
        start = positions.steps - np.array(side) * overshoot
        both = np.stack([positions.steps, start])
        good = np.all((both >= limits[:, 0]) & (both <= limits[:, 1]), axis=(0, 2))
        sides = np.tile(np.array(side), (int(good.sum()), 1))
        found.append(Looks(positions.steps[good], sides, positions.sheet[good]))
    return Looks(*(np.concatenate([getattr(some, part.name) for some in found]) for part in fields(Looks)))


@dataclass(frozen=True)
class Allowed:
    """Lowest and highest counter of (pan, tilt), shape (2, 2), and notes where the rig file states none."""

    limits: np.ndarray
    notes: tuple[str, ...]


def allowed(stated: CounterLimits) -> Allowed:
    """What the rig file states, else the limits of the grid protocol."""
    limits = stated.within(UNSTATED_STEPS)
    steps = np.array([limits[axis] for axis in AXES])
    if not stated.unstated:
        return Allowed(steps, ())
    ranges = ", ".join(f"{axis} {low} to {high}" for axis, (low, high) in limits.items())
    note = (
        f"[positioner] does not state {', '.join(stated.unstated)}: counters stay within {ranges}; wider limits would "
        "allow longer travel, and full turns"
    )
    return Allowed(steps, (note,))


def _box_in_view(knowledge: Knowledge, limits: np.ndarray, ratio: np.ndarray) -> np.ndarray:
    """Lowest and highest counter of (pan, tilt) that both cameras see at the most probable instrument, shape (2, 2)."""
    reach = REACH_DEG / np.abs(ratio)
    window = np.stack([np.maximum(limits[:, 0], -reach), np.minimum(limits[:, 1], reach)], axis=1)
    coarse = Positions.grid(window, (COARSE_PAN, COARSE_TILT), len(knowledge.sheets))
    seen = coarse.steps[coarse.visible(knowledge, knowledge.z[None]) > 0]
    if not len(seen):
        raise InputError(
            "out-of-view",
            "no counters within the limits put the spot into both images on any sheet",
            file="rig.toml",
            column="rig.prior",
            remedy="check the extrinsics in [rig.prior], the sheets' X and the limits in [positioner]",
        )
    return np.stack([seen.min(axis=0), seen.max(axis=0)], axis=1)


@dataclass(frozen=True)
class _InView:
    """Positions that drawn instruments see, and notes on those that were left out."""

    positions: Positions
    notes: tuple[str, ...]


def _in_view(knowledge: Knowledge, box: np.ndarray, turns: Sequence[int], half_turn: float) -> _InView:
    """Positions of a box (2, 2) and full turns away from it that `VISIBLE_SHARE` of drawn instruments see."""
    positions = Positions.grid(box, (PAN_LEVELS, TILT_LEVELS), len(knowledge.sheets)).also(turns)
    share = positions.visible(knowledge, draws_of(knowledge, VISIBILITY_DRAWS, np.random.default_rng(23)))
    good = share >= VISIBLE_SHARE
    near = np.abs(positions.steps[:, 0] - box[0].mean()) < half_turn
    notes = []
    if turns and not (good & ~near).any():
        notes.append(
            "a full turn is allowed, but the ratio is not yet known well enough to find the spot after it: measure "
            "first, then plan with --given"
        )
    if (good & near).sum() < 2 * LOOKS_PER_EXPERIMENT:
        good = near & (positions.visible(knowledge, knowledge.z[None]) > 0)
        notes.append(
            "where the positioner stands is stated so loosely that looks may miss the images (as few as "
            f"{100 * share[good].min(initial=1.0):.0f} % of drawn instruments see one): state the extrinsics, or "
            "measure little and plan with --given"
        )
    return _InView(positions[good], tuple(notes))


def candidates(knowledge: Knowledge) -> Candidates:
    """Looks on a grid over what images and motor limits allow, on every sheet, from both sides of both axes.

    Where the limits allow, the same beams a full turn of pan away are candidates as well; counters never wrap. A
    candidate must be in both images in `VISIBLE_SHARE` of drawn instruments: a full turn only once the ratio is known.

    Raises:
        InputError: no sheets, nothing that both cameras see, or limits too narrow for a run-up.
    """
    rig = knowledge.rig
    if not rig.sheets_mm:
        remedy = "name the sheets and their X in mm in [sheets] of the rig file"
        raise InputError(
            "no-sheet", "the rig has no sheets to look at", file="rig.toml", column="sheets", remedy=remedy
        )
    counters = allowed(rig.limits)
    limits = counters.limits
    physical = np.asarray(physical_at(knowledge.z, knowledge.space).value)
    ratio = physical[[INDEX[f"degrees_per_step.{axis}"] for axis in AXES]]
    overshoot = overshoot_steps(knowledge)
    box = _box_in_view(knowledge, limits, ratio)
    turn = round(FULL_TURN_DEG / abs(float(ratio[0])))
    turns = [n for n in (turn, -turn) if limits[0, 0] <= box[0, 1] + n and box[0, 0] + n <= limits[0, 1]]
    view = _in_view(knowledge, box, turns, 0.5 * turn)
    looks = sided(view.positions, limits, overshoot)
    if not len(looks):
        raise InputError(
            "limits",
            f"no look has room for a run-up of {overshoot[0]} pan and {overshoot[1]} tilt steps, which takes up the "
            f"play, within pan {limits[0, 0]} to {limits[0, 1]} and tilt {limits[1, 0]} to {limits[1, 1]}",
            file="rig.toml",
            column="positioner",
            remedy="widen the limits in [positioner], or state backlash and ratio more closely in [rig.prior]",
        )
    away = np.abs(looks.steps[:, 0] - box[0].mean()) >= 0.5 * turn
    return Candidates(looks, overshoot, limits, away, (*counters.notes, *view.notes))
