"""Looks that stand for themselves: what each shows, and what a design of them tells.

Every look is reached anew on both axes from a known side: their stop errors are independent and information adds up
look by look; of the history only the length of the path remains (it carries the contrast of the two directions), and
thousands of candidates are scored by low-rank updates. Counters in steps, angles in rad.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from tvsbayes.estimators.campaign_arrays import CampaignArrays, GearArrays, SpotArrays
from tvsbayes.instrument.parameters import INDEX
from tvsbayes.instrument.plan import PlanBuilder, PlanStep, action_seconds
from tvsbayes.instrument.rig import Rig
from tvsbayes.model.compiled import compiled, placed
from tvsbayes.model.gear_processes import Places
from tvsbayes.model.laser_path import MoveArrays
from tvsbayes.model.parameter_space import ParameterSpace
from tvsbayes.planning.expectation import HOME_VARIANCE_RAD2, Knowledge, expect, largest_px, met_sheet


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
    """Looks in the order of a plan: each sheet placed once, side by side, every look with a run-up where it needs one.

    Attributes:
        order: look at each place of the plan, shape (m,).
        sheet: name of the sheet at each place.
        via: counters from which each place is reached: where its run-up begins, or where the one before ended; (m, 2).
        goal: counters of each place, shape (m, 2).
        home: counters of the homing.
    """

    order: np.ndarray
    sheet: tuple[str, ...]
    via: np.ndarray
    goal: np.ndarray
    home: tuple[int, int]

    @cached_property
    def _legs(self) -> np.ndarray:
        """Steps to the start of every run-up and from there to the look, shape (m, 2, 2)."""
        ends = np.stack([self.via, self.goal], axis=1).reshape(-1, 2)
        return np.diff(ends, axis=0, prepend=[self.home]).reshape(-1, 2, 2)

    @property
    def path(self) -> np.ndarray:
        """Steps travelled per axis since homing when each look (in the caller's order) is taken, shape (m, 2)."""
        path = np.empty_like(self.goal)
        path[self.order] = np.cumsum(np.abs(self._legs).sum(axis=1), axis=0)
        return path

    def warm_minutes(self, rig: Rig) -> np.ndarray:
        """From the homing to the last move before each look (in the caller's order) by `[costs]`, shape (m,)."""
        cost = {name: action_seconds(rig, {name: 1}) for name in ("home", "place", "move", "look")}
        moves = self._legs.any(axis=2).sum(axis=1)
        placed = np.array([now != before for now, before in zip(self.sheet, ("", *self.sheet[:-1]), strict=True)])
        taken = placed * cost["place"] + moves * cost["move"] + cost["look"]
        ends = cost["home"] + np.cumsum(taken)
        # The time of a row is that at which its move begins; without a move the row before holds on.
        last = np.where(moves > 0, ends - cost["look"] - cost["move"], 0.0)
        minutes = np.empty(len(self.order))
        minutes[self.order] = np.maximum.accumulate(last) / 60
        return minutes

    @property
    def actions(self) -> dict[str, int]:
        """How many of each kind the plan has."""
        moves, looks = int(self._legs.any(axis=2).sum()), len(self.order)
        places = sum(now != before for now, before in zip(self.sheet, ("", *self.sheet[:-1]), strict=True))
        return {"home": 1, "place": places, "move": moves, "look": looks}

    def minutes(self, rig: Rig) -> float:
        """Duration by `[costs]`."""
        return action_seconds(rig, self.actions) / 60

    @cached_property
    def steps(self) -> tuple[PlanStep, ...]:
        """The plan, from its homing on."""
        plan = PlanBuilder()
        plan.home(*self.home)
        return self._taken(plan)

    @cached_property
    def steps_onwards(self) -> tuple[PlanStep, ...]:
        """The plan where the axes stand at `home` already."""
        return self._taken(PlanBuilder(at=self.home))

    def _taken(self, plan: PlanBuilder) -> tuple[PlanStep, ...]:
        placed = ""
        for sheet, via, goal in zip(self.sheet, self.via.tolist(), self.goal.tolist(), strict=True):
            if sheet != placed:
                placed = sheet
                plan.place(placed)
            plan.move(*via)
            plan.move(*goal)
            plan.look()
        return tuple(plan.steps)


def arrange(looks: Looks, sheets: Sequence[str], overshoot: np.ndarray, home: tuple[int, int] = (0, 0)) -> Arranged:
    """Order looks into a plan.

    Args:
        looks: what is to be seen.
        sheets: names, as `Looks.sheet` counts them.
        overshoot: run-up (pan, tilt) in steps that takes up all play, shape (2,).
        home: counters of the homing.
    """
    order = np.lexsort((looks.steps[:, 0] * looks.side[:, 0], looks.side[:, 0], looks.side[:, 1], looks.sheet))
    goal, side = looks.steps[order], looks.side[order]
    before = np.concatenate([np.array([home]), goal])[:-1]
    via = np.where((goal - before) * side < overshoot, goal - side * overshoot, before)
    return Arranged(order, tuple(sheets[number] for number in looks.sheet[order]), via, goal, home)


@dataclass(frozen=True)
class Seen:
    """What m looks show, at one point of parameter space or, with a leading axis, at several.

    Attributes:
        rows: shape (m, 4, p + e + 2), see `expectation.Expectation`.
        slope: shape (m, 4, 2).
        seen: whether they are in both images, shape (m,).
        mirror_angles_rad: (pan, tilt), shape (m, 2).
    """

    rows: np.ndarray
    slope: np.ndarray
    seen: np.ndarray
    mirror_angles_rad: np.ndarray

    def __getitem__(self, chosen: int | np.ndarray) -> Seen:
        return Seen(*(getattr(self, part.name)[chosen] for part in fields(Seen)))


class _Shown(eqx.Module):
    """`Seen` of pairs of an instrument and a look."""

    rows: Float[Array, "pairs 4 columns"]
    slope: Float[Array, "pairs 4 2"]
    seen: Bool[Array, " pairs"]
    mirror_angles_rad: Float[Array, "pairs 2"]


class _Pairs(eqx.Module):
    """Instruments, each in front of one look: coordinates, the `value` of its space, and the look."""

    z: Float[Array, "pairs parameters"]
    value: Float[Array, "pairs rig"]
    steps: Float[Array, "pairs 2"]
    side: Float[Array, "pairs 2"]
    depth_mm: Float[Array, " pairs"]

    def space(self, common: ParameterSpace) -> ParameterSpace:
        """Of one pair."""
        return eqx.tree_at(lambda s: s.value, common, self.value)

    def moves(self, warm_minutes: Float[Array, ""]) -> MoveArrays:
        """Of one pair: the look's counters, reached from its side as if homed there."""
        steps, side = self.steps[None], self.side[None]
        return MoveArrays(steps, jnp.ones(1, dtype=bool), side, warm_minutes[None], jnp.zeros(1))


class _Eyes(eqx.Module):
    """What takes the looks: largest (u, v, u, v) inside the images, noise of a look, and the aperture; and when."""

    image_px: Float[Array, "4"] | None
    look_sd: Float[Array, ""]
    has_aperture: Float[Array, ""]
    azimuth_convention: Bool[Array, ""]
    warm_minutes: Float[Array, ""]


@compiled(_Shown)
def _shown(pairs: _Pairs, space: ParameterSpace, eyes: _Eyes) -> _Shown:
    """What every pair's look shows: `expect` of a plan of one look."""

    def one(pair: _Pairs) -> _Shown:
        spot = SpotArrays(
            move_index=jnp.zeros(1, dtype=jnp.int32),
            pixels=jnp.zeros((1, 4)),
            whitening=jnp.eye(4)[None] / eyes.look_sd,
            aperture_rad=jnp.zeros(1),
            has_aperture=eyes.has_aperture[None],
            triangulated_mm=jnp.zeros((1, 3)),
            valid=jnp.ones(1),
            weight=jnp.ones(1),
            redraw=jnp.ones((1, 2), dtype=bool),
            redraw_mix=jnp.where(pair.side[None, :, None] * np.array([-1.0, 1.0]) > 0, 1.0, 0.0),
            new_segment=jnp.ones(1, dtype=bool),
            homed=jnp.zeros(1, dtype=bool),
            hours=jnp.zeros(1),
            tangents=jnp.zeros((1, 2, 3)) if eyes.image_px is None else None,
        )
        none = jnp.zeros(0, dtype=bool)
        gears = GearArrays(Places(jnp.zeros(0), none, none), jnp.zeros((1, 0)), jnp.zeros((1, 0)))
        alone = jnp.ones((), dtype=jnp.int32)
        arrays = CampaignArrays(pair.moves(eyes.warm_minutes), spot, gears, eyes.azimuth_convention, alone)
        # Errors of the gears turn the mirrors as an offset does: their columns follow from its, outside.
        still = jnp.zeros((1, 2, 0))
        expectation = expect(pair.z, pair.space(space), arrays, pair.depth_mm[None], eyes.image_px, still)
        return _Shown(*(getattr(expectation, part.name)[0] for part in fields(_Shown)))

    return jax.vmap(one)(pairs)


LOOKS_COMPILED_SECONDS = 20.0


def looks_wait() -> float:
    """Seconds to expect of the first looks of a process, beyond their work."""
    return _shown.wait(LOOKS_COMPILED_SECONDS)


@compiled(jax.Array)
def _in_images(pairs: _Pairs, space: ParameterSpace, eyes: _Eyes) -> Bool[Array, " pairs"]:
    """Whether every pair's look puts its spot into both images."""

    def one(pair: _Pairs) -> Bool[Array, ""]:
        return met_sheet(
            pair.space(space).model(pair.z), pair.moves(eyes.warm_minutes), pair.depth_mm[None], eyes.image_px
        ).inside[0]

    return jax.vmap(one)(pairs)


class LookArrays:
    """Looks in front of the compiled functions: pairs with instruments, in blocks of one size."""

    SHOWN, IN_IMAGES = 128, 1024
    """Pairs in one call: enough to hide the call, few enough for a processor's cache."""

    def __init__(self, looks: Looks, knowledge: Knowledge, aperture: bool):
        rig, self.looks, self.space = knowledge.rig, looks, knowledge.space
        self.depth_mm = np.array([rig.depths_mm[name] for name in knowledge.sheets])[looks.sheet]
        azimuth = rig.table.aperture_convention == "azimuth"
        self.turning = knowledge.gears.turning(looks.steps, looks.side)
        of_look = placed(rig.look_sd), placed(float(aperture)), placed(azimuth), placed(knowledge.warm_minutes)
        image_px = largest_px(rig)
        self.eyes = _Eyes(None if image_px is None else placed(image_px), *of_look)

    def _blocks(self, z: np.ndarray, value: np.ndarray, size: int) -> list[_Pairs]:
        """Every instrument (n,) with every look (m,), the last block filled up with its last pair."""
        m, total = len(self.looks), len(z) * len(self.looks)
        blocks = []
        for begin in range(0, total, size):
            pair = np.minimum(np.arange(begin, begin + size), total - 1)
            instrument, look = pair // m, pair % m
            steps, side = self.looks.steps[look].astype(float), self.looks.side[look].astype(float)
            parts = z[instrument], value[instrument], steps, side, self.depth_mm[look]
            blocks.append(_Pairs(*map(placed, parts)))
        return blocks

    def at_all(self, z: np.ndarray, value: np.ndarray, turning: np.ndarray | None = None) -> Seen:
        """At several instruments: a leading axis n.

        Args:
            z: coordinates, shape (n, p).
            value: of their spaces, shape (n, rig).
            turning: how errors of their own gears turn the looks, shape (n, m, 2, e); by default as of the knowledge's.
        """
        turning = self.turning if turning is None else turning
        blocks = [
            [np.asarray(part) for part in jax.tree.leaves(_shown(block, self.space, self.eyes))]
            for block in self._blocks(z, value, self.SHOWN)
        ]
        shape = len(z), len(self.looks)
        whole = (np.concatenate(parts)[: shape[0] * shape[1]] for parts in zip(*blocks, strict=True))
        shown = Seen(*(part.reshape(*shape, *part.shape[1:]) for part in whole))
        if not turning.shape[-1]:
            return shown
        own, offset = shown.rows[..., :-2], shown.rows[..., -2:]
        return replace(shown, rows=np.concatenate([own, offset @ turning, offset], axis=-1))

    def at(self, z: np.ndarray, space: ParameterSpace) -> Seen:
        """At one instrument: coordinates (p,) in a space that differs from the knowledge's by `value` at most."""
        return self.at_all(z[None], np.asarray(space.value)[None])[0]

    def in_images(self, z: np.ndarray) -> np.ndarray:
        """Whether instruments at points (n, p) see the looks in both images, shape (n, m)."""
        value = np.broadcast_to(np.asarray(self.space.value), (len(z), len(self.space.value)))
        blocks = [
            np.asarray(_in_images(block, self.space, self.eyes)) for block in self._blocks(z, value, self.IN_IMAGES)
        ]
        return np.concatenate(blocks)[: len(z) * len(self.looks)].reshape(len(z), -1)


CONTRAST_COLUMNS = [INDEX["ratio_contrast_deg_per_step.pan"], INDEX["ratio_contrast_deg_per_step.tilt"]]
CREEP_COLUMNS = [INDEX["creep_deg.pan"], INDEX["creep_deg.tilt"]]


def information_of_looks(
    seen: Seen,
    chosen: np.ndarray,
    path: np.ndarray,
    space: ParameterSpace,
    homed: bool,
    warm_minutes: np.ndarray | None = None,
) -> np.ndarray:
    """Fisher information of chosen looks, shape (..., p + e, p + e); equal to `information_of` of the arranged plan.

    A look that is taken again differs by its path alone: each is multiplied out once, whatever its repeats.

    Args:
        seen: all looks, at one point or with leading axes at several.
        chosen: numbers of those taken, repeats allowed, shape (k,).
        path: steps travelled when each is taken, shape (k, 2).
        space: priors, for the scale of the contrast.
        homed: the session begins with an unknown home offset.
        warm_minutes: since it began when each is taken, shape (k,); None where the zeros' creep stands still meanwhile,
            as `seen` has it.
    """
    looks, place, count = np.unique(chosen, return_inverse=True, return_counts=True)
    # q = sum of k_dir dn = k n + (contrast / 2) x path: the contrast's column is the offset's, times the path.
    far, moved, of_axis = path * (np.asarray(space.u)[CONTRAST_COLUMNS] * np.pi / 360), CONTRAST_COLUMNS, [0, 1]
    if warm_minutes is not None:
        # Likewise the creep's: the offset's times how much of it is over.
        crept = -np.expm1(-warm_minutes / np.asarray(space.value)[INDEX["creep_minutes"]])
        creep = crept[:, None] * (np.asarray(space.u)[CREEP_COLUMNS] * np.pi / 180)
        far, moved, of_axis = np.hstack([far, creep]), [*CONTRAST_COLUMNS, *CREEP_COLUMNS], [0, 1, 0, 1]
    once, twice = np.zeros((len(looks), len(moved))), np.zeros((len(looks), len(moved), len(moved)))
    np.add.at(once, place, far)
    np.add.at(twice, place, far[:, :, None] * far[:, None, :])
    rows = seen.rows[..., looks, :, :]
    rows[..., moved] = 0.0
    *lead, m, components, columns = rows.shape
    flat, offset = rows.reshape(*lead, m * components, columns), rows[..., -2:]
    turned_by = offset[..., of_axis]
    turned = np.swapaxes(flat, -1, -2)
    information = turned @ (flat * np.repeat(count, components)[:, None])
    across = turned @ (turned_by * once[:, None, :]).reshape(*lead, m * components, len(moved))
    information[..., moved] = across
    information[..., moved, :] = np.swapaxes(across, -1, -2)
    information[..., np.array(moved)[:, None], moved] = np.einsum(
        "...mia,...mib,mab->...ab", turned_by, turned_by, twice
    )
    if not homed:
        return information[..., :-2, :-2]
    coupling = information[..., :-2, -2:]
    offsets = information[..., -2:, -2:] + np.eye(2) / HOME_VARIANCE_RAD2
    return information[..., :-2, :-2] - coupling @ np.linalg.solve(offsets, np.swapaxes(coupling, -1, -2))


def covariance_of(information: np.ndarray) -> np.ndarray:
    """Inverse of positive definite matrices (..., p, p) whose diagonals span many orders of magnitude."""
    scale = 1 / np.sqrt(np.diagonal(information, axis1=-2, axis2=-1))
    scales = scale[..., :, None] * scale[..., None, :]
    return np.linalg.inv(information * scales) * scales
