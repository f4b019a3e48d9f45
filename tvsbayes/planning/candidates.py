"""Looks that the rig can make: within its limits, on its sheets, visible in both images. Counters in steps."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tvsbayes.errors import InputError
from tvsbayes.instrument.axes import AXES, FULL_TURN_DEG
from tvsbayes.instrument.counter_limits import CounterLimits
from tvsbayes.instrument.mechanisms import BACKLASH_COLUMNS, RATIO_COLUMNS, Mechanism
from tvsbayes.instrument.plan import LOOKS_PER_EXPERIMENT
from tvsbayes.instrument.protocols import UNSTATED_STEPS
from tvsbayes.model.parameter_space import physical_at
from tvsbayes.planning.drawn_rigs import draws_of
from tvsbayes.planning.expectation import Knowledge
from tvsbayes.planning.looks import LookArrays, Looks

PAN_LEVELS, TILT_LEVELS = 9, 5
COARSE_PAN, COARSE_TILT = 31, 17
VISIBILITY_DRAWS = 24
VISIBLE_SHARE = 0.95
"""Share of draws of the instrument in which a candidate must be in both images."""
REACH_DEG = 60.0
"""Largest mirror angle of candidates: beyond it the beam meets a sheet at grazing incidence."""


@dataclass(frozen=True)
class Candidates:
    """All looks that a search may choose from.

    Attributes:
        looks: the candidates.
        run_up: run-up (pan, tilt), steps.
        turned: whether a look lies a full turn of pan away, shape (m,).
        notes: sentences on excluded looks and the reasons.
    """

    looks: Looks
    run_up: np.ndarray
    turned: np.ndarray
    notes: tuple[str, ...]


def sheet_choices[Sheet](sheets: Sequence[Sheet], most: int) -> list[tuple[Sheet, ...]]:
    """List all choices of one sheet up to `most`."""
    return [choice for size in range(1, most + 1) for choice in itertools.combinations(sheets, size)]


RUN_UP_STOPS = 4.0
"""Sds of a stop added to the play: the stop before the run-up deviates by more once in 30 000 runs."""
RUN_UP_MARGIN = 1.5
"""Factor for the uncertainty of play and scatter: a longer run-up costs seconds, remaining play a look."""


def run_up_steps(physical: np.ndarray, mechanism: Mechanism, play_axes_deg: np.ndarray) -> np.ndarray:
    """Compute the run-up (pan, tilt) that takes up a play and a few stop errors, with a margin.

    Args:
        physical: parameters in the units of their names, shape (p,): ratios and scatter of stops.
        mechanism: whose parameters they are.
        play_axes_deg: play of (pan, tilt) to be taken up.
    """
    reach_deg = play_axes_deg + RUN_UP_STOPS * physical[mechanism.stop_columns].max(axis=1)
    return np.ceil(RUN_UP_MARGIN * reach_deg / np.abs(physical[RATIO_COLUMNS])).astype(int)


def expected_run_up(knowledge: Knowledge) -> np.ndarray:
    """Compute the run-up (pan, tilt) that takes up the play in 99 % of expected instruments."""
    draws = draws_of(knowledge, 200, np.random.default_rng(17))
    physical = np.stack([physical_at(z, knowledge.space).value for z in draws])
    play_deg = np.quantile(physical[:, BACKLASH_COLUMNS], 0.99, axis=0)
    return run_up_steps(np.median(physical, axis=0), knowledge.space.mechanism, play_deg)


def look_grid(window: np.ndarray, counts: tuple[int, int], sheets: int, turns: Sequence[int] = ()) -> Looks:
    """Build a grid of (pan, tilt) over a window (2, 2) of counters, on every sheet, and again turns of pan away."""
    levels = [np.unique(np.linspace(low, high, n).round()) for (low, high), n in zip(window, counts, strict=True)]
    pan, tilt, sheet = (axis.ravel() for axis in np.meshgrid(*levels, np.arange(sheets), indexing="ij"))
    here = np.stack([pan, tilt], axis=1).astype(int)
    steps = np.concatenate([here + np.array([turn, 0]) for turn in (0, *turns)])
    return Looks(steps, np.ones_like(steps), np.tile(sheet, 1 + len(turns)))


def have_room(steps: np.ndarray, side: np.ndarray, limits: np.ndarray, run_up: np.ndarray) -> np.ndarray:
    """Whether looks (..., 2) and the starts of their run-ups from a side are inside the limits (2, 2), shape (...)."""
    end_points = np.stack([steps, steps - side * run_up])
    return np.all((end_points >= limits[:, 0]) & (end_points <= limits[:, 1]), axis=(0, -1))


def from_all_sides(some: Looks, limits: np.ndarray, run_up: np.ndarray) -> Looks:
    """Build the looks at the same counters from all four sides whose run-up is inside the limits (2, 2)."""
    sides = np.repeat(list(itertools.product((1, -1), repeat=2)), len(some), axis=0)
    looks = Looks(np.tile(some.steps, (4, 1)), sides, np.tile(some.sheet, 4))
    return looks[have_room(looks.steps, looks.side, limits, run_up)]


def counter_range(stated: CounterLimits, widest: Mapping[str, tuple[int, int]]) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the limits (2, 2) of the rig file, else `widest`, and notes where the rig file states none."""
    by_axis = stated.within(widest)
    steps = np.array([by_axis[axis] for axis in AXES])
    if not stated.unstated:
        return steps, ()
    ranges = ", ".join(f"{axis} {low} to {high}" for axis, (low, high) in by_axis.items())
    note = (
        f"[positioner] does not state {', '.join(stated.unstated)}: counters stay within {ranges}; wider limits would "
        "allow longer travel, and full turns"
    )
    return steps, (note,)


def _box_in_view(knowledge: Knowledge, limits: np.ndarray, ratio: np.ndarray) -> np.ndarray:
    """Find the range of counters (pan, tilt) in view of both cameras at the most probable instrument, (2, 2)."""
    reach = REACH_DEG / np.abs(ratio)
    window = np.stack([np.maximum(limits[:, 0], -reach), np.minimum(limits[:, 1], reach)], axis=1)
    coarse = look_grid(window, (COARSE_PAN, COARSE_TILT), len(knowledge.sheets))
    steps = coarse.steps[LookArrays(coarse, knowledge, False).in_images(knowledge.z[None])[0]]
    if not len(steps):
        raise InputError(
            "out-of-view",
            "no counters within the limits put the spot into both images on any sheet",
            file="rig.toml",
            column="rig.prior",
            remedy="check the extrinsics in [rig.prior], the sheets' X and the limits in [positioner]",
        )
    return np.stack([steps.min(axis=0), steps.max(axis=0)], axis=1)


def _visible_looks(
    knowledge: Knowledge, box: np.ndarray, turns: Sequence[int], half_turn: float
) -> tuple[Looks, tuple[str, ...]]:
    """Find looks in a box (2, 2) and full turns away visible to `VISIBLE_SHARE` of drawn instruments; notes."""
    looks = look_grid(box, (PAN_LEVELS, TILT_LEVELS), len(knowledge.sheets), turns)
    arrays = LookArrays(looks, knowledge, False)
    share = arrays.in_images(draws_of(knowledge, VISIBILITY_DRAWS, np.random.default_rng(23))).mean(axis=0)
    visible = share >= VISIBLE_SHARE
    in_box = np.abs(looks.steps[:, 0] - box[0].mean()) < half_turn
    notes = []
    if turns and not (visible & ~in_box).any():
        notes.append(
            "a full turn is allowed, but the ratio is not yet known well enough to find the spot after it: measure "
            "first, then plan with --given"
        )
    if (visible & in_box).sum() < 2 * LOOKS_PER_EXPERIMENT:
        visible = in_box & arrays.in_images(knowledge.z[None])[0]
        notes.append(
            "the pose of the positioner is stated with so large a u that looks may miss the images (as few as "
            f"{100 * share[visible].min(initial=1.0):.0f} % of drawn instruments see one): state all six extrinsics in "
            "[rig.prior], to some 0.03 rad and 5 mm, or measure little and plan with --given"
        )
    return looks[visible], tuple(notes)


def candidates(knowledge: Knowledge) -> Candidates:
    """Build looks on a grid within images and motor limits, on every sheet, from both sides of both axes.

    Where the limits allow, the same beams a full turn of pan away are candidates too; counters never wrap. A candidate
    must be in both images in `VISIBLE_SHARE` of drawn instruments: a full turn only once the ratio is known.

    Raises:
        InputError: no sheets, nothing in view of both cameras, or limits too narrow for a run-up.
    """
    rig = knowledge.rig
    if not rig.depths_mm:
        remedy = "name the sheets and their X in mm in [sheets] of the rig file"
        raise InputError(
            "no-sheet", "the rig has no sheets to look at", file="rig.toml", column="sheets", remedy=remedy
        )
    ratio = np.asarray(physical_at(knowledge.z, knowledge.space).value)[RATIO_COLUMNS]
    widest: Mapping[str, tuple[int, int]] = UNSTATED_STEPS
    if knowledge.made is not None:
        widest = knowledge.made
    elif not rig.has_images:
        reach = {axis: int(REACH_DEG / abs(r)) for axis, r in zip(AXES, ratio.tolist(), strict=True)}
        widest = {axis: (-steps, steps) for axis, steps in reach.items()}
    limits, range_notes = counter_range(rig.limits, widest)
    run_up, box = expected_run_up(knowledge), _box_in_view(knowledge, limits, ratio)
    turn = round(FULL_TURN_DEG / abs(float(ratio[0])))
    turns = [n for n in (turn, -turn) if limits[0, 0] <= box[0, 1] + n and box[0, 0] + n <= limits[0, 1]]
    visible, view_notes = _visible_looks(knowledge, box, turns, 0.5 * turn)
    looks = from_all_sides(visible, limits, run_up)
    if not len(looks):
        raise InputError(
            "limits",
            f"no look has room for a run-up of {run_up[0]} pan and {run_up[1]} tilt steps, which takes up the "
            f"play, within pan {limits[0, 0]} to {limits[0, 1]} and tilt {limits[1, 0]} to {limits[1, 1]}",
            file="rig.toml",
            column="positioner",
            remedy="widen the limits in [positioner], or state backlash and ratio more closely in [rig.prior]",
        )
    turned = np.abs(looks.steps[:, 0] - box[0].mean()) >= 0.5 * turn
    return Candidates(looks, run_up, turned, (*range_notes, *view_notes))
