"""The expected Fisher information of a plan's looks.

The model predicts the looks; the information of the priors (or of a fit) plus J^T C^-1 J of all looks gives the
covariance that a fit will report. `information_of` evaluates any plan move by move, by the filter of the likelihood:
shared stops, home offsets and unknown play as in a fit. Counters in steps, mm, rad. Coordinates z, and after them
repeated errors of the gears at regular counters, have the prior N(0, 1) each.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from tvsbayes.errors import InputError
from tvsbayes.estimators.campaign_arrays import (
    NOWHERE_MM,
    CampaignArrays,
    SpotArrays,
    bucket,
    move_arrays,
    no_gears,
    padded,
)
from tvsbayes.estimators.joint_fit import JointFit, with_places
from tvsbayes.estimators.kalman_filter import filter_rows, kalman_update, no_belief
from tvsbayes.estimators.linear_spots import linearise
from tvsbayes.estimators.looks import in_frame_s
from tvsbayes.instrument.campaign import Move
from tvsbayes.instrument.mechanisms import RATIO_COLUMNS
from tvsbayes.instrument.mirrors import Ray
from tvsbayes.instrument.parameters import CREEP_NAMES, NOISE_NAMES
from tvsbayes.instrument.places import gears_vary
from tvsbayes.instrument.plan import PlanStep, plan_minutes, run_plan
from tvsbayes.instrument.rig import Rig
from tvsbayes.instrument.stops import counters_made, redraws
from tvsbayes.model.compiled import compiled, placed
from tvsbayes.model.geometry import image, materialise, rotation_matrix, transform
from tvsbayes.model.laser_path import MoveArrays, mirror_angles, trace
from tvsbayes.model.parameter_space import Model, ParameterSpace, parameter_space, physical_at
from tvsbayes.planning.gear_places import (
    NO_PLACES,
    FittedErrors,
    GearPlaces,
    expected_scales,
    regular_places,
)

KEPT_SD_DEG = 1e-7
"""Sd of a homing's shift of a zero that an absolute encoder keeps: next to none, but invertible."""
SMALLEST_DESIGN, DESIGN_GROWTH = 512, 4
"""Looks are padded to this size or a power of four above it; moves to twice that."""


def home_variances_rad2(z: np.ndarray, space: ParameterSpace) -> np.ndarray:
    """Return the variances of the shift of (pan, tilt) by a homing at coordinates (p,), shape (2,)."""
    return np.radians(np.maximum(physical_at(z, space).value[space.mechanism.columns("home_sd_deg")], KEPT_SD_DEG)) ** 2


@dataclass(frozen=True)
class Knowledge:
    """Knowledge of an instrument before the looks of a plan.

    Attributes:
        rig: limits, sheets, costs; table and stereo calibration are those of the data, if any.
        space: priors as arrays.
        z: most probable coordinates, shape (p,).
        precision: inverse covariance of the coordinates and of the errors at `gears`, shape (p + e, p + e).
        after_data: whether there is a campaign; a new session then begins with an unknown home offset.
        gears: counters with coordinates for repeated errors of the gears, see `with_gears`.
        warm_minutes: time since power-on of looks that continue a campaign.
        made: lowest and highest counter by axis that a campaign made; None without one.
        like: knowledge of an instrument of the same build, see `alike`.
        errors_of_fit: estimate of errors by a fit at its own places.
    """

    rig: Rig
    space: ParameterSpace
    z: np.ndarray
    precision: np.ndarray
    after_data: bool = False
    gears: GearPlaces = field(default=NO_PLACES)
    errors_of_fit: FittedErrors | None = None
    warm_minutes: float = 0.0
    made: Mapping[str, tuple[int, int]] | None = None
    like: Knowledge | None = None

    @property
    def size(self) -> int:
        """Return the number of coordinates and errors, p + e."""
        return len(self.precision)

    @property
    def home_variances_rad2(self) -> np.ndarray | None:
        """Return those of the homing that begins a session; None where it is the first."""
        return home_variances_rad2(self.z, self.space) if self.after_data else None

    @cached_property
    def covariance(self) -> np.ndarray:
        """Compute the covariance, shape (p + e, p + e)."""
        return np.linalg.inv(self.precision)

    @property
    def sheets(self) -> tuple[str, ...]:
        """Return the names of the sheets, nearest first."""
        return tuple(sorted(self.rig.depths_mm, key=self.rig.depths_mm.__getitem__))

    @property
    def noise(self) -> np.ndarray:
        """Mark the coordinates that are scales of noise, shape (p,)."""
        return np.isin(self.space.mechanism.names, NOISE_NAMES)

    @property
    def gears_vary(self) -> bool:
        """Whether transmission error or play may differ from place to place."""
        return gears_vary(self.rig.table)

    def with_gears(self, reached: np.ndarray) -> Knowledge:
        """Add errors of gears at regular places over counters (m, 2); perfect gears add none.

        Ratios are then the slopes of lines over these counters.
        """
        if not self.gears_vary:
            return self
        ratio = np.asarray(physical_at(self.z, self.space).value)[RATIO_COLUMNS]
        return self.with_places(regular_places(reached, ratio, expected_scales(self.z, self.space, self.after_data)))

    def with_places(self, gears: GearPlaces) -> Knowledge:
        """Add errors of gears at given places."""
        if self.errors_of_fit is not None:
            return replace(self, precision=np.linalg.inv(self.errors_of_fit.covariance_at(gears)), gears=gears)
        size = len(self.z)
        precision = np.eye(size + gears.size)
        precision[:size, :size] = self.precision[:size, :size]
        return replace(self, precision=precision, gears=gears)


def prior_knowledge(rig: Rig) -> Knowledge:
    """Return the knowledge before any data: the priors of the rig file."""
    space = parameter_space(rig.table, rig.stereo)
    return Knowledge(rig, space, np.zeros(space.size), np.eye(space.size))


def knowledge_of(result: JointFit, rig: Rig) -> Knowledge:
    """Return the knowledge after a fit: its mode without creep, its Laplace covariance, and the rig file."""
    data_rig = replace(rig, table=result.campaign.rig, stereo=result.campaign.stereo)
    precision = np.linalg.inv(result.covariance)
    z = np.where(np.isin(result.names, CREEP_NAMES), 0.0, result.z)
    errors, made = fitted_errors(result, result.covariance), counters_made(result.campaign.moves)
    return Knowledge(data_rig, result.space, z, precision, True, errors_of_fit=errors, made=made)


def fitted_errors(result: JointFit, covariance: np.ndarray) -> FittedErrors | None:
    """Return the estimated errors at the places of a fit's looks, without padding; None for perfect gears.

    Args:
        result: the fit.
        covariance: covariance of the coordinates, shape (p, p), on which the errors depend.
    """
    if not len(result.information.place_mean):
        return None
    joint = with_places(result.z, covariance, result.information)
    gears, count = result.arrays.gears.without_padding(), int(np.sum(result.arrays.gears.places.valid))
    # Errors that the priors fix keep their unit variance, as coordinates do.
    size = len(result.z)
    covariance = np.eye(size + 2 * count)
    rows = np.concatenate([np.arange(size), size + gears.place + count * gears.of_play])
    covariance[np.ix_(rows, rows)] = joint.covariance
    return FittedErrors(fit_places(result), covariance)


def fit_places(result: JointFit) -> GearPlaces:
    """Return the places of a fit's looks, with the scales of its mode and its ratios along lines over its looks."""
    places = result.seen_line.places
    valid = np.asarray(places.valid)
    steps, on_tilt, share = (np.asarray(a)[valid] for a in (places.steps, places.on_tilt, result.seen_line.share))
    ratio = np.asarray(result.mode.physical)[RATIO_COLUMNS]
    return GearPlaces(steps, on_tilt, np.radians(ratio), expected_scales(result.z, result.space, True), share)


class Expectation(eqx.Module):
    """Expected looks of a plan at one point of parameter space; first axis: looks.

    `rows` = d(standardised innovations)/d(coordinates, errors of gears, common offset of pan, of tilt in rad): over all
    looks rows^T rows is the Fisher information. `jacobian` is that of the predictions by coordinates and errors. The
    other arrays are those of `linear_spots.LinearSpots`. A look that misses its sheet or an image is not `seen` and its
    rows are zero.
    """

    rows: Float[Array | np.ndarray, "looks 4 columns"]
    jacobian: Float[Array | np.ndarray, "looks 4 unknowns"]
    slope: Float[Array | np.ndarray, "looks 4 2"]
    load: Float[Array | np.ndarray, "looks 4 6"]
    keep: Float[Array | np.ndarray, "looks 6"]
    variance: Float[Array | np.ndarray, "looks 6"]
    seen: Bool[Array | np.ndarray, " looks"]
    mirror_angles_rad: Float[Array | np.ndarray, "looks 2"]


class _SheetPoints(eqx.Module):
    """Points of beams on sheets of given depths X in frame S, and whether they are in both images."""

    points_mm: Float[Array, "3 looks"]
    inside: Bool[Array, " looks"]


def sheet_points(
    model: Model,
    moves: MoveArrays,
    depth_mm: Float[Array, " looks"],
    image_px: Float[Array, "4"] | None,
    look_moves: Int[Array, " looks"] | slice = slice(None),
) -> _SheetPoints:
    """Compute error-free looks after some of the moves, by default after each, at sheets normal to X.

    Without images points are directions, and all are visible.
    """
    pan, tilt = mirror_angles(model.transmission, model.tilt_zero_rad, moves).angle_rad[look_moves].T
    ray = trace(model.optics, pan, tilt)
    if image_px is None:
        points = materialise(ray.direction).stacked()
        return _SheetPoints(points, jnp.all(jnp.isfinite(points), axis=0))
    turn = rotation_matrix(model.extrinsics.rotation_rad)
    ray = materialise(Ray(in_frame_s(model.extrinsics, ray.origin_mm), transform(turn, ray.direction)))
    distance = (depth_mm - ray.origin_mm.x) / ray.direction.x
    points = materialise(ray.at(jnp.where(jnp.isfinite(distance), distance, 0.0)))
    pixels = jnp.stack(image(model.cameras, points))
    inside = jnp.all((pixels >= 0) & (pixels <= image_px[:, None]), axis=0)
    return _SheetPoints(points.stacked(), (distance > 0) & inside)


@compiled(Expectation)
def expect(
    z: Float[Array, " parameters"],
    space: ParameterSpace,
    arrays: CampaignArrays,
    depth_mm: Float[Array, " looks"],
    image_px: Float[Array, "4"] | None,
    turning: Float[Array, "looks 2 errors"],
) -> Expectation:
    """Compute expected looks on sheets at given depths X, linearised and whitened by the filter in time order.

    Args:
        z: coordinates.
        space: priors.
        arrays: moves and looks; pixels and points are not read.
        depth_mm: X of each look's sheet in frame S.
        image_px: largest (u, v, u, v) inside the images; None without images.
        turning: derivative of (pan, tilt) by errors of the gears, see `GearPlaces.turning`.

    Returns:
        Expectation of every look, padding included.
    """
    spots = arrays.spots
    on_sheet = sheet_points(space.model(z), arrays.moves, depth_mm, image_px, spots.move_index)
    seen = on_sheet.inside & (spots.valid > 0)
    placeholder = jnp.array(NOWHERE_MM)[:, None]
    arrays = eqx.tree_at(
        lambda a: (a.spots.valid, a.spots.triangulated_mm),
        arrays,
        (jnp.where(seen, 1.0, 0.0), jnp.where(seen, on_sheet.points_mm, placeholder).T),
    )
    if image_px is None:
        arrays = eqx.tree_at(lambda a: a.spots.tangents, arrays, tangents_at(arrays.spots.triangulated_mm))
    spots = arrays.spots
    lin = linearise(space.point(z), space, arrays)
    jacobian = jnp.where(np.isin(space.mechanism.names, NOISE_NAMES), 0.0, -lin.residual_jacobian)
    jacobian = jnp.concatenate([jacobian, lin.slope @ turning], axis=2)
    columns = jnp.concatenate([jacobian, lin.slope], axis=2)
    inputs = filter_rows(columns, lin.slope, lin.play_sd_rad, lin.stop_variance, lin.zero_variance, spots)

    def step(belief, row):
        updated = kalman_update(belief.renewed(row), row)
        return updated.belief, updated.standardised

    _, rows = jax.lax.scan(step, no_belief(columns.shape[2]), inputs)
    rows = jnp.where(seen[:, None, None], rows, 0.0)
    noise = inputs.load, inputs.keep, inputs.variance
    return Expectation(rows, jacobian, lin.slope, *noise, seen, lin.mirror_angles_rad)


def tangents_at(direction: Float[Array, "looks 3"]) -> Float[Array, "looks 2 3"]:
    """Compute unit vectors along azimuth and elevation at directions, as `sightings.tangent_frames` for angles."""
    x, y, _ = direction.T
    horizontal = jnp.maximum(jnp.hypot(x, y), 1e-9)
    azimuth_tangent = jnp.stack([-y / horizontal, x / horizontal, jnp.zeros_like(x)], axis=1)
    return jnp.stack([azimuth_tangent, jnp.cross(direction, azimuth_tangent)], axis=1)


def design_arrays(
    moves: Sequence[Move], look_moves: Sequence[int], rig: Rig, *, homed_from: int, aperture: bool
) -> CampaignArrays:
    """Pack moves and looks without pixels; segments from `homed_from` on have an unknown home offset."""
    # Half the moves, rounded up: arrays of moves have twice the size of those of looks.
    count = len(look_moves)
    size = bucket(max(count, (len(moves) + 1) // 2), SMALLEST_DESIGN, DESIGN_GROWTH)
    redraw_arrays = redraws(moves, look_moves, homed_from, rig.table.absolute)
    return CampaignArrays(
        move_arrays(moves, 2 * size),
        SpotArrays(
            move_index=padded(look_moves, size, look_moves[-1], np.int32),
            pixels=padded(np.zeros((count, 4)), size),
            whitening=padded(np.tile(np.eye(4) / rig.look_sd, (count, 1, 1)), size, np.eye(4)),
            aperture_rad=padded(np.zeros(count), size),
            has_aperture=padded([float(aperture)] * count, size),
            triangulated_mm=padded(np.zeros((count, 3)), size),
            valid=padded([1.0] * count, size),
            weight=padded([1.0] * count, size, 1.0),
            redraw=padded(redraw_arrays.redraw, size, False, bool),
            redraw_mix=padded(redraw_arrays.redraw_mix, size),
            new_segment=padded(redraw_arrays.new_segment, size, False, bool),
            new_zero=padded(redraw_arrays.new_zero, size, False, bool),
            homed=padded(redraw_arrays.homed, size),
            hours=padded(redraw_arrays.hours, size),
            tangents=None if rig.has_images else padded(np.zeros((count, 2, 3)), size),
        ),
        no_gears(size),
        placed(rig.table.aperture_convention == "azimuth"),
        placed(np.int32(count)),
    )


def largest_px(rig: Rig) -> np.ndarray | None:
    """Return the largest (u, v, u, v) inside the images of a rig, shape (4,); None without images."""
    if not rig.has_images:
        return None
    return np.tile([rig.stereo_pair.image_width - 1.0, rig.stereo_pair.image_height - 1.0], 2)


@dataclass(frozen=True)
class PlanInformation:
    """Expected information of a plan.

    Attributes:
        fisher: J^T C^-1 J of all its looks, shape (p + e, p + e), without that of priors or earlier data.
        expectation: expectation of its looks, shape (looks, ...).
        moves: its moves.
        look_moves: move of each look.
        minutes: duration by the rig's costs.
        pose_rad: mean mirror angles (pan, tilt) over the visible looks, the pose of the headlines, shape (2,).
    """

    fisher: np.ndarray
    expectation: Expectation
    moves: tuple[Move, ...]
    look_moves: tuple[int, ...]
    minutes: float
    pose_rad: np.ndarray

    @property
    def seen_moves(self) -> set[int]:
        """Return the moves after which a look is in both images."""
        return {move for move, seen in zip(self.look_moves, self.expectation.seen, strict=True) if seen}


def information_of(
    steps: Sequence[PlanStep],
    knowledge: Knowledge,
    *,
    aperture: bool = False,
    z: np.ndarray | None = None,
    space: ParameterSpace | None = None,
) -> PlanInformation:
    """Compute the expected Fisher information of a plan, move by move as in a fit.

    Args:
        steps: the plan; every target is a sheet of the rig.
        knowledge: knowledge of the instrument before the plan.
        aperture: looks also read the aperture.
        z: another point of evaluation (a drawn truth), shape (p,).
        space: priors of that point, where they differ.

    Raises:
        InputError: the plan has no look or places an unknown sheet.
    """
    rig = knowledge.rig
    log = run_plan(steps, rig)
    if not log.looks:
        remedy = "add `look` steps to the plan"
        raise InputError("no-look", "the plan looks at nothing", file="plan.csv", column="action", remedy=remedy)
    look_moves = tuple(look.move for look in log.looks)
    depth = np.array([rig.depths_mm[log.targets[look.placement]] for look in log.looks])
    arrays = design_arrays(log.moves, look_moves, rig, homed_from=0 if knowledge.after_data else 1, aperture=aperture)
    size = len(arrays.spots.valid)
    turning = padded(knowledge.gears.turning_after(log.moves, look_moves), size)
    point = knowledge.z if z is None else z, space or knowledge.space
    views = expect(*point, arrays, padded(depth, size, depth[-1]), largest_px(rig), turning)
    views = jax.tree.map(lambda part: np.asarray(part)[: len(depth)], views)
    rows = np.asarray(views.rows)[..., : knowledge.size].reshape(-1, knowledge.size)
    seen = np.asarray(views.seen) if views.seen.any() else np.ones(len(depth), dtype=bool)
    pose = np.asarray(views.mirror_angles_rad)[seen].mean(axis=0)
    return PlanInformation(rows.T @ rows, views, tuple(log.moves), look_moves, plan_minutes(rig, steps), pose)
