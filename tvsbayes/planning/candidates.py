"""Looks that the rig can make, and what each adds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import jax
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
            with jax.enable_x64(True):
                # Each look stands for itself: no home offsets.
                arrays = design_arrays(moves, range(len(moves)), self.rig, homed_from=len(moves), aperture=aperture)
            self.blocks.append((arrays, depth[part]))

    def at(self, z: np.ndarray, space: ParameterSpace) -> Seen:
        """Evaluate at a point."""
        with jax.enable_x64(True):
            found = [expected_information(arrays, depth, self.rig, z, space) for arrays, depth in self.blocks]
        names = ("rows", "slope", "seen", "mirror_angles_rad")
        return Seen(*(np.concatenate([getattr(part, name) for part in found]) for name in names))


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


def _sided(positions: np.ndarray, sheets: np.ndarray, limits: np.ndarray, overshoot: np.ndarray) -> Looks:
    """Positions (m, 2) on sheets (m,) from all four sides whose run-up stays inside the limits."""
    found = []
    for side in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        start = positions - np.array(side) * overshoot
        both = np.stack([positions, start])
        good = np.all((both >= limits[:, 0]) & (both <= limits[:, 1]), axis=(0, 2))
        found.append((positions[good], np.broadcast_to(side, (good.sum(), 2)), sheets[good]))
    return Looks(*(np.concatenate(parts) for parts in zip(*found, strict=True)))


def _allowed(stated: CounterLimits) -> tuple[np.ndarray, list[str]]:
    limits = stated.within(UNSTATED_STEPS)
    notes = []
    if stated.unstated:
        ranges = ", ".join(f"{axis} {low} to {high}" for axis, (low, high) in limits.items())
        notes.append(
            f"[positioner] does not state {', '.join(stated.unstated)}: counters stay within {ranges}; wider limits "
            "would allow longer travel, and full turns"
        )
    return np.array([limits[axis] for axis in AXES]), notes


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
    limits, notes = _allowed(rig.limits)
    physical = physical_at(knowledge.z, knowledge.space).value
    overshoot = overshoot_steps(knowledge)
    ratio = physical[[INDEX["degrees_per_step.pan"], INDEX["degrees_per_step.tilt"]]]
    reach = REACH_DEG / np.abs(ratio)
    window = np.stack([np.maximum(limits[:, 0], -reach), np.minimum(limits[:, 1], reach)], axis=1)
    sheets = np.arange(len(rig.sheets_mm))

    def grid(pan: np.ndarray, tilt: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pan, tilt, sheet = np.meshgrid(pan, tilt, sheets, indexing="ij")
        return np.stack([pan.ravel(), tilt.ravel()], 1).astype(int), sheet.ravel()

    def levels_of(axis: int, count: int, window: np.ndarray = window) -> np.ndarray:
        return np.unique(np.linspace(*window[axis], count).round().astype(int))

    def visible(positions: np.ndarray, sheet: np.ndarray, points: np.ndarray) -> np.ndarray:
        arrays = LookArrays(Looks(positions, np.ones_like(positions), sheet), knowledge, False)
        return np.mean([arrays.at(z, knowledge.space).seen for z in points], axis=0)

    coarse, sheet = grid(levels_of(0, COARSE_PAN), levels_of(1, COARSE_TILT))
    at_centre = visible(coarse, sheet, knowledge.z[None]) > 0
    if not at_centre.any():
        raise InputError(
            "out-of-view",
            "no counters within the limits put the spot into both images on any sheet",
            file="rig.toml",
            column="rig.prior",
            remedy="check the extrinsics in [rig.prior], the sheets' X and the limits in [positioner]",
        )
    box = np.stack([coarse[at_centre].min(axis=0), coarse[at_centre].max(axis=0)], axis=1)
    positions, sheet = grid(*(levels_of(axis, count, box) for axis, count in enumerate((PAN_LEVELS, TILT_LEVELS))))
    turn = round(FULL_TURN_DEG / abs(ratio[0]))
    turned = [
        (positions + np.array([sign * turn, 0]), sheet)
        for sign in (1, -1)
        if limits[0, 0] <= box[0, 1] + sign * turn and box[0, 0] + sign * turn <= limits[0, 1]
    ]
    positions, sheet = (np.concatenate(x) for x in zip((positions, sheet), *turned, strict=True))
    share = visible(positions, sheet, draws_of(knowledge, VISIBILITY_DRAWS, np.random.default_rng(23)))
    good = share >= VISIBLE_SHARE
    near = np.abs(positions[:, 0] - box[0].mean()) < 0.5 * turn
    if turned and not (good & ~near).any():
        notes.append(
            "a full turn is allowed, but the ratio is not yet known well enough to find the spot after it: measure "
            "first, then plan with --given"
        )
    if (good & near).sum() < 2 * LOOKS_PER_EXPERIMENT:
        good = near & (visible(positions, sheet, knowledge.z[None]) > 0)
        notes.append(
            "where the positioner stands is stated so loosely that looks may miss the images (as few as "
            f"{100 * share[good].min(initial=1.0):.0f} % of drawn instruments see one): state the extrinsics, or "
            "measure little and plan with --given"
        )
    looks = _sided(positions[good], sheet[good], limits, overshoot)
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
    return Candidates(looks, overshoot, limits, away, tuple(notes))
