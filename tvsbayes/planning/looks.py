"""Independent looks: the expectation of each, and the information of a design.

Every look has a new approach on both axes from a known side. Stop errors are therefore independent, and information
adds up look by look. Of the history only the length of the path matters (for the contrast of the two directions), and
low-rank updates score thousands of candidates. Counters in steps, angles in rad.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from tvsbayes.estimators.campaign_arrays import CampaignArrays, SpotArrays, no_gears
from tvsbayes.instrument.mechanisms import CONTRAST_COLUMNS
from tvsbayes.instrument.plan import PlanBuilder, PlanStep, action_seconds
from tvsbayes.instrument.rig import Rig
from tvsbayes.model.compiled import compiled, in_batches, placed
from tvsbayes.model.laser_path import MoveArrays
from tvsbayes.model.parameter_space import ParameterSpace
from tvsbayes.planning.expectation import Knowledge, expect, largest_px, sheet_points


@dataclass(frozen=True)
class Looks:
    """Looks, each with a new approach on both axes; arrays over looks.

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
class LookPlan:
    """Looks in the order of a plan: each sheet placed once, every look with a run-up where needed.

    Attributes:
        order: number of the look at each position of the plan, shape (m,).
        sheet: name of the sheet at each position.
        via: counters before the last move: the start of the run-up, or the end of the previous look; (m, 2).
        goal: counters of each position, shape (m, 2).
        home: counters of the homing.
    """

    order: np.ndarray
    sheet: tuple[str, ...]
    via: np.ndarray
    goal: np.ndarray
    home: tuple[int, int]

    @cached_property
    def _legs(self) -> np.ndarray:
        """Compute steps to the start of every run-up and from there to the look, shape (m, 2, 2)."""
        waypoints = np.stack([self.via, self.goal], axis=1).reshape(-1, 2)
        return np.diff(waypoints, axis=0, prepend=[self.home]).reshape(-1, 2, 2)

    @cached_property
    def _counts(self) -> dict[str, np.ndarray]:
        """Count the actions at every position, shape (m,) each."""
        names = np.array(["", *self.sheet])
        moves = self._legs.any(axis=2).sum(axis=1)
        return {"place": (names[1:] != names[:-1]).astype(int), "move": moves, "look": np.ones_like(moves)}

    @property
    def path(self) -> np.ndarray:
        """Compute the steps per axis from the homing to each look (in the caller's order), shape (m, 2)."""
        path = np.empty_like(self.goal)
        path[self.order] = np.cumsum(np.abs(self._legs).sum(axis=1), axis=0)
        return path

    def warm_minutes(self, rig: Rig) -> np.ndarray:
        """Compute minutes (m,) by `[costs]` from homing to the last move before each look, in the caller's order."""
        cost = {name: action_seconds(rig, {name: 1}) for name in ("home", *self._counts)}
        ends = cost["home"] + np.cumsum(sum(count * cost[name] for name, count in self._counts.items()))
        # The time of a row is the start of its move; without a move it is that of the previous row.
        last = np.where(self._counts["move"] > 0, ends - cost["look"] - cost["move"], 0.0)
        minutes = np.empty(len(self.order))
        minutes[self.order] = np.maximum.accumulate(last) / 60
        return minutes

    @property
    def actions(self) -> dict[str, int]:
        """Count the actions of each kind."""
        return {"home": 1, **{name: int(count.sum()) for name, count in self._counts.items()}}

    def minutes(self, rig: Rig) -> float:
        """Compute the duration by `[costs]`, minutes."""
        return action_seconds(rig, self.actions) / 60

    @cached_property
    def steps(self) -> tuple[PlanStep, ...]:
        """Return the plan, from its homing on."""
        plan = PlanBuilder()
        plan.home(*self.home)
        return self._plan(plan)

    @cached_property
    def steps_onwards(self) -> tuple[PlanStep, ...]:
        """Return the plan without homing, where the axes are at `home` already."""
        return self._plan(PlanBuilder(at=self.home))

    def _plan(self, plan: PlanBuilder) -> tuple[PlanStep, ...]:
        placed = self._counts["place"].tolist()
        for sheet, new, via, goal in zip(self.sheet, placed, self.via.tolist(), self.goal.tolist(), strict=True):
            if new:
                plan.place(sheet)
            plan.move(*via)
            plan.move(*goal)
            plan.look()
        return tuple(plan.steps)


def run_up_start(goal: np.ndarray, side: np.ndarray, at: np.ndarray, run_up: np.ndarray) -> np.ndarray:
    """Find where the last move to `goal` begins: `at` where that is a run-up before it, else a run-up before it."""
    return np.where((goal - at) * side < run_up, goal - side * run_up, at)


def arrange(looks: Looks, sheets: Sequence[str], run_up: np.ndarray, home: tuple[int, int] = (0, 0)) -> LookPlan:
    """Order looks into a plan.

    Args:
        looks: looks to arrange.
        sheets: names of the sheets, in the order of `Looks.sheet`.
        run_up: run-up (pan, tilt) in steps that takes up all play, shape (2,).
        home: counters of the homing.
    """
    order = np.lexsort((looks.steps[:, 0] * looks.side[:, 0], looks.side[:, 0], looks.side[:, 1], looks.sheet))
    goal, side = looks.steps[order], looks.side[order]
    previous = np.concatenate([np.array([home]), goal])[:-1]
    via = run_up_start(goal, side, previous, run_up)
    return LookPlan(order, tuple(sheets[number] for number in looks.sheet[order]), via, goal, home)


class Seen(eqx.Module):
    """Expectation of looks, at one point of parameter space or, with a leading axis, at several.

    Fields are as in `expectation.Expectation`: NumPy arrays, and JAX arrays within the compiled function.
    """

    rows: Float[np.ndarray, "*looks 4 columns"]
    slope: Float[np.ndarray, "*looks 4 2"]
    seen: Bool[np.ndarray, "*looks"]
    mirror_angles_rad: Float[np.ndarray, "*looks 2"]

    def __getitem__(self, chosen: int | np.ndarray) -> Seen:
        return jax.tree.map(lambda part: part[chosen], self)


class _Pairs(eqx.Module):
    """Pairs of an instrument and a look: coordinates, the `value` of its space, and the look."""

    z: Float[Array, "pairs parameters"]
    value: Float[Array, "pairs rig"]
    steps: Float[Array, "pairs 2"]
    side: Float[Array, "pairs 2"]
    depth_mm: Float[Array, " pairs"]

    def space(self, common: ParameterSpace) -> ParameterSpace:
        """Return the space of one pair."""
        return eqx.tree_at(lambda s: s.value, common, self.value)

    def moves(self, warm_minutes: Float[Array, ""]) -> MoveArrays:
        """Return the move of one pair: the look's counters, approached from its side as if homed there."""
        steps, side = self.steps[None], self.side[None]
        return MoveArrays(steps, jnp.ones(1, dtype=bool), side, warm_minutes[None], jnp.zeros(1))


class _Observer(eqx.Module):
    """Settings of looks: largest (u, v, u, v) inside the images, noise of a look, aperture, time."""

    image_px: Float[Array, "4"] | None
    look_sd: Float[Array, ""]
    has_aperture: Float[Array, ""]
    azimuth_convention: Bool[Array, ""]
    warm_minutes: Float[Array, ""]


@compiled(Seen)
def _pair_expectation(pairs: _Pairs, space: ParameterSpace, observer: _Observer) -> Seen:
    """Compute the expectation of every pair's look: `expect` of a plan of one look."""

    def expectation_of(pair: _Pairs) -> Seen:
        spot = SpotArrays(
            move_index=jnp.zeros(1, dtype=jnp.int32),
            pixels=jnp.zeros((1, 4)),
            whitening=jnp.eye(4)[None] / observer.look_sd,
            aperture_rad=jnp.zeros(1),
            has_aperture=observer.has_aperture[None],
            triangulated_mm=jnp.zeros((1, 3)),
            valid=jnp.ones(1),
            weight=jnp.ones(1),
            redraw=jnp.ones((1, 2), dtype=bool),
            redraw_mix=jnp.where(pair.side[None, :, None] * np.array([-1.0, 1.0]) > 0, 1.0, 0.0),
            new_segment=jnp.ones(1, dtype=bool),
            new_zero=jnp.ones((1, 2), dtype=bool),
            homed=jnp.zeros((1, 2)),
            hours=jnp.zeros((1, 2)),
            tangents=jnp.zeros((1, 2, 3)) if observer.image_px is None else None,
        )
        count, moves = jnp.ones((), dtype=jnp.int32), pair.moves(observer.warm_minutes)
        arrays = CampaignArrays(moves, spot, no_gears(1), observer.azimuth_convention, count)
        # Errors of the gears act as an offset, so their columns follow from the offset's, see `at_all`.
        no_turning = jnp.zeros((1, 2, 0))
        expectation = expect(pair.z, pair.space(space), arrays, pair.depth_mm[None], observer.image_px, no_turning)
        return Seen(*(getattr(expectation, part.name)[0] for part in fields(Seen)))

    return jax.vmap(expectation_of)(pairs)


LOOKS_COMPILED_SECONDS = 20.0


def looks_wait() -> float:
    """Predict the compilation time of the first looks of a process, s."""
    return _pair_expectation.wait(LOOKS_COMPILED_SECONDS)


@compiled(jax.Array)
def _in_images(pairs: _Pairs, space: ParameterSpace, observer: _Observer) -> Bool[Array, " pairs"]:
    """Whether every pair's look puts its spot into both images."""

    def is_visible(pair: _Pairs) -> Bool[Array, ""]:
        return sheet_points(
            pair.space(space).model(pair.z), pair.moves(observer.warm_minutes), pair.depth_mm[None], observer.image_px
        ).inside[0]

    return jax.vmap(is_visible)(pairs)


class LookArrays:
    """Looks as input of the compiled functions: pairs with instruments, in blocks of one size."""

    SHOWN, IN_IMAGES = 128, 1024
    """Pairs in one call: enough to hide its overhead, few enough for a processor's cache."""

    def __init__(self, looks: Looks, knowledge: Knowledge, aperture: bool):
        rig, self.looks, self.space = knowledge.rig, looks, knowledge.space
        self.depth_mm = np.array([rig.depths_mm[name] for name in knowledge.sheets])[looks.sheet]
        azimuth = rig.table.aperture_convention == "azimuth"
        self.turning = knowledge.gears.turning(looks.steps, looks.side)
        settings = placed(rig.look_sd), placed(float(aperture)), placed(azimuth), placed(knowledge.warm_minutes)
        image_px = largest_px(rig)
        self.observer = _Observer(None if image_px is None else placed(image_px), *settings)

    def _at_pairs[Result](self, function: Callable[..., Result], z: np.ndarray, value: np.ndarray, size: int) -> Result:
        """Evaluate a compiled function for every look (m,) at every instrument (n,), with leading axes (n, m)."""
        steps, side = self.looks.steps.astype(float), self.looks.side.astype(float)
        shape = len(z), len(self.looks)

        def block(pair: np.ndarray) -> Result:
            instrument, look = np.unravel_index(pair, shape)
            parts = z[instrument], value[instrument], steps[look], side[look], self.depth_mm[look]
            return function(_Pairs(*map(placed, parts)), self.space, self.observer)

        pairs = in_batches(block, np.arange(shape[0] * shape[1]), size=size)
        return jax.tree.map(lambda part: part.reshape(*shape, *part.shape[1:]), pairs)

    def at_all(self, z: np.ndarray, value: np.ndarray, turning: np.ndarray | None = None) -> Seen:
        """Compute the expectation at several instruments, with a leading axis n.

        Args:
            z: coordinates, shape (n, p).
            value: `value` of their spaces, shape (n, rig).
            turning: derivatives by errors of their own gears, shape (n, m, 2, e); by default those of the knowledge.
        """
        turning = self.turning if turning is None else turning
        seen = self._at_pairs(_pair_expectation, z, value, self.SHOWN)
        if not turning.shape[-1]:
            return seen
        columns, offset = seen.rows[..., :-2], seen.rows[..., -2:]
        return replace(seen, rows=np.concatenate([columns, offset @ turning, offset], axis=-1))

    def at(self, z: np.ndarray, space: ParameterSpace) -> Seen:
        """Compute the expectation at one instrument, coordinates (p,); its space may have another `value`."""
        return self.at_all(z[None], np.asarray(space.value)[None])[0]

    def in_images(self, z: np.ndarray) -> np.ndarray:
        """Whether instruments at points (n, p) see the looks in both images, shape (n, m)."""
        value = np.broadcast_to(np.asarray(self.space.value), (len(z), len(self.space.value)))
        return np.asarray(self._at_pairs(_in_images, z, value, self.IN_IMAGES))


def information_of_looks(
    seen: Seen,
    picks: np.ndarray,
    path: np.ndarray,
    space: ParameterSpace,
    home_variances_rad2: np.ndarray | None,
    warm_minutes: np.ndarray | None = None,
) -> np.ndarray:
    """Compute the Fisher information of chosen looks, shape (..., p + e, p + e), as `information_of` their plan.

    Repeats of a look differ only in their path, so the product of each look is computed once.

    Args:
        seen: all looks, at one point or with leading axes at several.
        picks: numbers of the looks taken, repeats allowed, shape (k,).
        path: steps travelled at each look, shape (k, 2).
        space: priors, for the scale of the contrast.
        home_variances_rad2: of the home offsets with which the session begins; None where they are known.
        warm_minutes: time since the session's start at each look, shape (k,); None for the constant creep of `seen`.
    """
    looks, index, count = np.unique(picks, return_inverse=True, return_counts=True)
    # q = sum of k_dir dn = k n + (contrast / 2) x path: the contrast's column is the offset's, times the path.
    factors, linked = path * (np.asarray(space.u)[CONTRAST_COLUMNS] * np.pi / 360), [*CONTRAST_COLUMNS]
    axes = [0, 1]
    if warm_minutes is not None:
        # Likewise the creep's column: the offset's times the completed share of the creep.
        creep_share = -np.expm1(-warm_minutes / np.asarray(space.value)[space.mechanism.index["creep_minutes"]])
        creeps = space.mechanism.columns("creep_deg")
        creep = creep_share[:, None] * (np.asarray(space.u)[creeps] * np.pi / 180)
        factors, linked, axes = np.hstack([factors, creep]), [*CONTRAST_COLUMNS, *creeps], [0, 1, 0, 1]
    sums, squares = np.zeros((len(looks), len(linked))), np.zeros((len(looks), len(linked), len(linked)))
    np.add.at(sums, index, factors)
    np.add.at(squares, index, factors[:, :, None] * factors[:, None, :])
    rows = seen.rows[..., looks, :, :]
    rows[..., linked] = 0.0
    *lead, m, components, columns = rows.shape
    flat, offset = rows.reshape(*lead, m * components, columns), rows[..., -2:]
    offsets_of = offset[..., axes]
    transposed = np.swapaxes(flat, -1, -2)
    information = transposed @ (flat * np.repeat(count, components)[:, None])
    cross = transposed @ (offsets_of * sums[:, None, :]).reshape(*lead, m * components, len(linked))
    information[..., linked] = cross
    information[..., linked, :] = np.swapaxes(cross, -1, -2)
    information[..., np.array(linked)[:, None], linked] = np.einsum(
        "...mia,...mib,mab->...ab", offsets_of, offsets_of, squares
    )
    if home_variances_rad2 is None:
        return information[..., :-2, :-2]
    coupling = information[..., :-2, -2:]
    offsets = information[..., -2:, -2:] + np.diag(1 / home_variances_rad2)
    return information[..., :-2, :-2] - coupling @ np.linalg.solve(offsets, np.swapaxes(coupling, -1, -2))
