"""What a plan will tell before it is run: expected information, targets, and the search for looks (DESIGN 6).

The model says what the looks of a plan would show; their Bayesian Fisher information, that of the priors (or of a fit)
plus J^T C^-1 J of all looks, gives the covariance that a fit will report, for any quantity of interest. Frames and
units are those of DESIGN 2 and 8: counters in steps, mm, degrees where a name says so, rad inside. Coordinates z have
prior N(0, 1) each (`tvsbayes.model`).

`information_of` judges any plan, move by move, through the filter of `tvsbayes.likelihood`: shared stops, home offsets
and unknown play as in a fit. `Looks` are plans whose every look is reached anew on both axes from a known side: their
stop errors are independent and information adds up look by look; of the history only the length of the path remains
(it carries the contrast of the two directions). Thousands of candidates are scored by low-rank updates.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from tvsbayes.calibration import INPUT_NAMES, NORMAL_95, Calibration
from tvsbayes.calibration import NOISE_NAMES as CALIBRATION_NOISE
from tvsbayes.campaign import (
    APPROACH_SIGN,
    GRID_PAN_STEPS,
    GRID_TILT_STEPS,
    OVERSHOOT_STEPS,
    Move,
    PlanStep,
    Spot,
)
from tvsbayes.classic import DIRECTIONS
from tvsbayes.coordinates import NOISES, Sources, propagate, settings_of
from tvsbayes.files import InputError, escaped
from tvsbayes.joint import JointFit, linearise
from tvsbayes.likelihood import (
    CampaignArrays,
    SpotArrays,
    redraws,
)
from tvsbayes.model import (
    FULL_TURN_DEG,
    INDEX,
    NAMES,
    NOISE_NAMES,
    MoveArrays,
    ParameterSpace,
    along_batch,
    beam,
    beam_angles,
    materialise,
    mirror_angles,
    parameter_space,
    project,
    rotation_matrix,
    transform,
)
from tvsbayes.rigs import HOME_SD_DEG, Rig, RigTable
from tvsbayes.simulation import (
    HOME_APPROACH,
    PlanLog,
    plan_seconds,
    run_plan,
)

RATIOS = DIRECTIONS
QUANTITIES: tuple[str, ...] = (
    *RATIOS,
    *("contrast.pan", "contrast.tilt", "backlash.pan", "backlash.tilt", "mirror_offset"),
)
"""Headlines in the order of `headlines`: effective deg/step, their differences, lost motion (deg), offset (mm)."""
UNITS = {
    **dict.fromkeys((*RATIOS, "worst", "contrast.pan", "contrast.tilt"), "deg/step"),
    **dict.fromkeys(("backlash.pan", "backlash.tilt"), "deg"),
    **dict.fromkeys(("mirror_offset", "x", "y", "z", "xyz"), "mm"),
}
COORDINATES = {"x": (0,), "y": (1,), "z": (2,), "xyz": (0, 1, 2)}
DEFAULT_TARGET = "u(worst) <= 2e-4 deg/step"
"""0.3 % of the paper's ratios: above the floor that stereo and a focal scale known to 0.2 % leave."""
LOOKS_PER_EXPERIMENT = 4
"""The paper counts four spots as one experiment; so do all curves here, whatever the looks are."""
ASSURED = (0.8, 0.95)
PARAMETERS = len(NAMES)
HOME_VARIANCE_RAD2 = math.radians(HOME_SD_DEG) ** 2
SMALLEST_DESIGN = 128
"""Looks are padded to this size or a power of four above it; moves to twice that."""


def padded_size(count: int) -> int:
    """Padded number of looks."""
    size = SMALLEST_DESIGN
    while size < count:
        size *= 4
    return size


@dataclass(frozen=True)
class Knowledge:
    """What is known of an instrument when a plan is judged.

    Attributes:
        rig: limits, sheets, costs; its table and stereo calibration are those of the data where there are any.
        space: priors as arrays.
        z: most probable coordinates, shape (p,).
        precision: their inverse covariance, shape (p, p).
        after_data: there is a campaign already: a new session begins with an unknown home offset.
    """

    rig: Rig
    space: ParameterSpace
    z: np.ndarray
    precision: np.ndarray
    after_data: bool = False

    @cached_property
    def covariance(self) -> np.ndarray:
        """Shape (p, p)."""
        return np.linalg.inv(self.precision)

    @property
    def sheets(self) -> tuple[str, ...]:
        """Names of the sheets, nearest first."""
        return tuple(sorted(self.rig.sheets_mm, key=self.rig.sheets_mm.get))


def prior_knowledge(rig: Rig) -> Knowledge:
    """Before any data: the priors of the rig file."""
    return Knowledge(rig, parameter_space(rig.table, rig.stereo), np.zeros(PARAMETERS), np.eye(PARAMETERS))


def knowledge_of(result: JointFit, rig: Rig) -> Knowledge:
    """After a fit: its mode and Laplace covariance; sheets, limits and costs of the rig file."""
    of_data = replace(rig, table=result.campaign.rig, stereo=result.campaign.stereo)
    return Knowledge(of_data, result.space, result.z, np.linalg.inv(result.covariance), True)


class Expectation(eqx.Module):
    """The looks of a plan as the model expects them at one point of parameter space; first axis: looks.

    `rows` = d(standardised innovations)/d(coordinates, common offset of pan, of tilt in rad): over all looks
    rows^T rows is the Fisher information. The other arrays are those of `likelihood.LinearSpots`. A look that misses
    its sheet or an image is not `seen` and its rows are zero.
    """

    rows: Float[Array, "looks 4 columns"]
    jacobian: Float[Array, "looks 4 parameters"]
    slope: Float[Array, "looks 4 2"]
    load: Float[Array, "looks 4 6"]
    keep: Float[Array, "looks 6"]
    variance: Float[Array, "looks 6"]
    seen: Bool[Array, " looks"]
    mirror_angles_rad: Float[Array, "looks 2"]


NOISE_COLUMNS = np.isin(NAMES, NOISE_NAMES)


@eqx.filter_jit
def expect(
    z: Float[Array, " parameters"],
    space: ParameterSpace,
    arrays: CampaignArrays,
    depth_mm: Float[Array, " looks"],
    image_px: Float[Array, "4"],
) -> Expectation:
    """Expected looks on sheets at given depths X, linearised and whitened by the filter in time order.

    Args:
        z: coordinates.
        space: priors.
        arrays: moves and looks; pixels and points are not read.
        depth_mm: X of each look's sheet in frame S.
        image_px: largest (u, v, u, v) inside the images.

    Returns:
        Expectation of every look, padding included.
    """
    model = space.model(z)
    spots = arrays.spots
    pan, tilt = mirror_angles(model.transmission, model.tilt_zero_rad, arrays.moves).angle_rad[spots.move_index].T
    ray = beam(model.optics, pan, tilt)
    turn = rotation_matrix(model.extrinsics.rotation_rad)
    origin = materialise(transform(turn, ray.origin_mm) + along_batch(model.extrinsics.translation_mm, pan))
    direction = materialise(transform(turn, ray.direction))
    reach = (depth_mm - origin[0]) / direction[0]
    points = materialise(origin + jnp.where(jnp.isfinite(reach), reach, 0.0) * direction)
    pixels = project(model.cameras, points)
    inside = jnp.all((pixels >= 0) & (pixels <= image_px[:, None]), axis=0)
    seen = (reach > 0) & inside & (spots.valid > 0)
    harmless = jnp.array([500.0, 0.0, 0.0])[:, None]
    arrays = eqx.tree_at(
        lambda a: (a.spots.valid, a.spots.triangulated_mm),
        arrays,
        (jnp.where(seen, 1.0, 0.0), jnp.where(seen, points, harmless).T),
    )
    spots = arrays.spots
    lin = linearise(z, space, arrays)
    jacobian = jnp.where(NOISE_COLUMNS, 0.0, -lin.residual_jacobian)
    count = pan.size
    home = jnp.where(spots.homed, HOME_VARIANCE_RAD2, 0.0)[:, None] * jnp.ones(2)
    segment = jnp.broadcast_to(spots.new_segment[:, None], (count, 2))
    load = jnp.concatenate([lin.slope, lin.slope, lin.slope * lin.play_sd_rad[:, None, :]], axis=2)
    keep = jnp.where(jnp.concatenate([spots.redraw, segment, segment], axis=1), 0.0, 1.0)
    variance = jnp.concatenate([lin.stop_variance, home, jnp.ones((count, 2))], axis=1)

    def step(carry, row):
        mean, covariance = carry
        look, load, keep, variance = row
        mean = mean * keep[:, None]
        covariance = covariance * (keep[:, None] * keep) + jnp.diag(variance * (1 - keep))
        whitened = []
        for component in range(4):
            gain = jnp.sum(covariance * load[component], axis=1)
            ahead = 1 + jnp.sum(load[component] * gain)
            error = look[component] - jnp.sum(load[component][:, None] * mean, axis=0)
            mean = mean + gain[:, None] * (error / ahead)
            covariance = covariance - gain[:, None] * (gain / ahead)
            whitened.append(error / jnp.sqrt(ahead))
        return (mean, covariance), jnp.stack(whitened)

    columns = jnp.concatenate([jacobian, lin.slope], axis=2)
    nothing = (jnp.zeros((6, columns.shape[2])), jnp.zeros((6, 6)))
    _, rows = jax.lax.scan(step, nothing, (columns, load, keep, variance))
    rows = jnp.where(seen[:, None, None], rows, 0.0)
    return Expectation(rows, jacobian, lin.slope, load, keep, variance, seen, lin.mirror_angles_rad)


def _design_arrays(
    moves: Sequence[Move], look_moves: Sequence[int], rig: Rig, *, homed_from: int, aperture: bool
) -> CampaignArrays:
    """Moves and looks without pixels; segments from `homed_from` on have an unknown home offset."""
    # Half the moves rounded up: there are twice as many places for them as for looks.
    size, count = padded_size(max(len(look_moves), (len(moves) + 1) // 2)), len(look_moves)

    def padded(rows, shape, fill, dtype=float, length=size):
        array = np.full((length, *shape), fill, dtype=dtype)
        array[: len(rows)] = rows
        return jnp.asarray(array)

    spots = [_unseen(number, move) for number, move in enumerate(look_moves)]
    new = redraws(tuple(replace(m, segment=0) for m in moves), spots)
    homed = new.new_segment & (np.array([moves[m].segment for m in look_moves]) >= homed_from)
    steps = [(m.pan_steps, m.tilt_steps) for m in moves]
    sides = [(APPROACH_SIGN.get(m.pan_approach, 0), APPROACH_SIGN.get(m.tilt_approach, 0)) for m in moves]
    long = 2 * size
    return CampaignArrays(
        MoveArrays(
            padded(steps, (2,), steps[-1], length=long),
            padded([bool(m.pan_approach) for m in moves], (), False, bool, long),
            padded(sides, (2,), 0.0, length=long),
        ),
        SpotArrays(
            move_index=padded(look_moves, (), look_moves[-1], np.int32),
            pixels=jnp.zeros((size, 4)),
            whitening=jnp.asarray(np.tile(np.eye(4) / float(rig.cameras["spot_sd_px"]), (size, 1, 1))),
            aperture_rad=jnp.zeros(size),
            has_aperture=padded([float(aperture)] * count, (), 0.0),
            triangulated_mm=jnp.zeros((size, 3)),
            valid=padded([1.0] * count, (), 0.0),
            weight=jnp.ones(size),
            redraw=padded(new.redraw, (2,), False, bool),
            redraw_mix=padded(new.redraw_mix, (2, 2), 0.0),
            new_segment=padded(new.new_segment, (), False, bool),
            homed=padded(homed, (), False, bool),
        ),
        jnp.asarray(rig.table.aperture_convention == "azimuth"),
    )


def _unseen(number: int, move: int) -> Spot:
    return Spot(number, move, "", None, None, *(None,) * 8)


def _expected(
    arrays: CampaignArrays, depth_mm: np.ndarray, rig: Rig, z: np.ndarray, space: ParameterSpace
) -> Expectation:
    """`expect` without padding, as NumPy arrays."""
    count = len(depth_mm)
    last = np.tile([rig.stereo.image_width - 1.0, rig.stereo.image_height - 1.0], 2)
    padded = np.full(arrays.spots.valid.shape, depth_mm[-1])
    padded[:count] = depth_mm
    found = expect(jnp.asarray(z), space, arrays, jnp.asarray(padded), jnp.asarray(last))
    return jax.tree.map(lambda x: np.asarray(x)[:count], found)


@dataclass(frozen=True)
class PlanInformation:
    """What a plan will tell.

    Attributes:
        fisher: J^T C^-1 J of all its looks, shape (p, p), without that of priors or earlier data.
        expectation: of its looks, shape (looks, ...).
        moves: its moves.
        look_moves: move of each look.
        minutes: duration by the rig's costs.
        pose_rad: mean mirror angles (pan, tilt) over the looks seen, at which the headlines hold, shape (2,).
    """

    fisher: np.ndarray
    expectation: Expectation
    moves: tuple[Move, ...]
    look_moves: tuple[int, ...]
    minutes: float
    pose_rad: np.ndarray


def plan_minutes(steps: Sequence[PlanStep], rig: Rig) -> float:
    """Duration of a plan by `[costs]`, minutes."""
    return plan_seconds(rig, steps) / 60


def _logged(steps: Sequence[PlanStep], rig: Rig) -> PlanLog:
    log = run_plan(steps, rig, HOME_APPROACH)
    if not log.looks:
        remedy = "add `look` steps to the plan"
        raise InputError("no-look", "the plan looks at nothing", file="plan.csv", column="action", remedy=remedy)
    return log


def information_of(
    steps: Sequence[PlanStep],
    knowledge: Knowledge,
    *,
    aperture: bool = False,
    z: np.ndarray | None = None,
    space: ParameterSpace | None = None,
) -> PlanInformation:
    """Expected Fisher information of a plan, move by move as in a fit.

    Args:
        steps: the plan; every target is a sheet of the rig.
        knowledge: where the instrument is believed to be.
        aperture: looks also read the aperture.
        z: another point to look from (a drawn truth), shape (p,).
        space: its priors, where they differ.

    Raises:
        InputError: a plan that looks at nothing or places an unknown sheet.
    """
    rig = knowledge.rig
    log = _logged(steps, rig)
    look_moves = tuple(look.move for look in log.looks)
    depth = np.array([rig.sheets_mm[log.targets[look.placement]] for look in log.looks])
    with jax.enable_x64(True):
        arrays = _design_arrays(
            log.moves, look_moves, rig, homed_from=0 if knowledge.after_data else 1, aperture=aperture
        )
        found = _expected(arrays, depth, rig, knowledge.z if z is None else z, space or knowledge.space)
    rows = found.rows[..., :PARAMETERS].reshape(-1, PARAMETERS)
    seen = found.seen if found.seen.any() else np.ones(len(depth), dtype=bool)
    pose = found.mirror_angles_rad[seen].mean(axis=0)
    return PlanInformation(rows.T @ rows, found, tuple(log.moves), look_moves, plan_minutes(steps, rig), pose)


@dataclass(frozen=True)
class Target:
    """What the measurement is for: an uncertainty that shall not exceed a limit.

    Attributes:
        text: as written.
        quantity: one of `UNITS`.
        factor: 1 for u, 1.96 for U95.
        limit: in the unit.
        unit: deg/step, deg or mm.
        point_mm: where a coordinate is wanted, frame T.
    """

    text: str
    quantity: str
    factor: float
    limit: float
    unit: str
    point_mm: tuple[float, float, float] | None = None

    @property
    def indices(self) -> tuple[int, ...]:
        """Rows of the headlines, or of x, y, z, whose worst is meant."""
        if self.quantity in COORDINATES:
            return COORDINATES[self.quantity]
        return (0, 1, 2, 3) if self.quantity == "worst" else (QUANTITIES.index(self.quantity),)

    def as_json(self) -> dict[str, object]:
        """Part of the documents of `plan` and `study`."""
        point = None if self.point_mm is None else list(self.point_mm)
        return {
            "text": self.text,
            "quantity": self.quantity,
            "limit": self.limit,
            "unit": self.unit,
            "at_mm": point,
            "expanded95": self.factor != 1.0,
        }


_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_TARGET = re.compile(
    rf"\s*(?P<kind>u|U95)\s*\(\s*(?P<name>[\w.]+)\s*\)"
    rf"(?:\s+at\s+(?P<at>{_NUMBER}\s*,\s*{_NUMBER}\s*,\s*{_NUMBER})\s*mm)?"
    rf"\s*<=\s*(?P<limit>{_NUMBER})\s*(?P<unit>deg/step|deg|mm)\s*",
    re.ASCII,
)
SMALLEST_LIMIT, LARGEST_NUMBER = 1e-12, 1e9
"""Limits and coordinates of a target: beyond these a number is a slip of the pen, and squares of it overflow."""
TARGET_FORMS = (
    "u(NAME) <= NUMBER UNIT or U95(NAME) <= NUMBER UNIT with NAME left, right, up, down, worst, contrast.pan, "
    "contrast.tilt (deg/step), backlash.pan, backlash.tilt (deg), mirror_offset (mm); or u or U95 of x, y, z or xyz "
    "at X,Y,Z mm <= NUMBER mm"
)


def parse_target(text: str) -> Target:
    """Read a target such as `u(left) <= 2e-4 deg/step` or `U95(x) at 1000,0,0 mm <= 60 mm`.

    Raises:
        InputError: anything else, with what is allowed.
    """

    def refuse(found: str, remedy: str) -> InputError:
        shown = escaped(text, 120)
        message = f"--target {shown!r}: {found}; allowed: {TARGET_FORMS}; {remedy}"
        return InputError("target", message, column="--target", found=shown, allowed=TARGET_FORMS, remedy=remedy)

    match = _TARGET.fullmatch(text) if len(text) <= 200 else None
    if match is None:
        raise refuse("not of that form", f"write for example '{DEFAULT_TARGET}'")
    name, unit, limit = match["name"], match["unit"], float(match["limit"])
    if name not in UNITS:
        raise refuse(f"no quantity {name}", "name one of the quantities")
    if unit != UNITS[name]:
        raise refuse(f"{name} is in {UNITS[name]}, not {unit}", f"state the limit in {UNITS[name]}")
    if not SMALLEST_LIMIT <= limit < LARGEST_NUMBER:
        raise refuse(f"the limit {limit:g}", f"state a limit from {SMALLEST_LIMIT:g} to {LARGEST_NUMBER:g}")
    if (match["at"] is None) == (name in COORDINATES):
        remedy = "name the point: at 1000,0,0 mm" if name in COORDINATES else "leave the point out"
        raise refuse("a coordinate needs a point, and nothing else has one", remedy)
    point = None if match["at"] is None else tuple(float(x) for x in match["at"].split(","))
    if point is not None and max(map(abs, point)) > LARGEST_NUMBER:
        raise refuse("the point is too far away", f"state its coordinates within {LARGEST_NUMBER:g} mm")
    return Target(" ".join(text.split()), name, 1.0 if match["kind"] == "u" else NORMAL_95, limit, unit, point)


class Headlines(eqx.Module):
    """Values of `QUANTITIES` and d/d(coordinates)."""

    value: Float[Array, " quantities"]
    gradient: Float[Array, "quantities parameters"]


@eqx.filter_jit
def headlines(z: Float[Array, " parameters"], space: ParameterSpace, pose_rad: Float[Array, "2"]) -> Headlines:
    """Headlines at one pose (DESIGN 3.2) with their derivatives."""

    def values(z):
        model = space.model(z)
        angles = beam_angles(model.optics, pose_rad[0], pose_rad[1])
        gears, slope = model.transmission, jnp.diagonal(angles.jacobian)
        half = 0.5 * gears.contrast_rad_per_step
        ratio = gears.ratio_rad_per_step
        degrees = 180 / jnp.pi
        effective = jnp.stack([(ratio + half) * slope, (ratio - half) * slope], axis=1).ravel() * degrees
        contrast = 2 * half * slope * degrees
        lost = gears.backlash_rad * degrees
        return jnp.concatenate([effective, contrast, lost, angles.effective_mirror_offset_mm[None]])

    return Headlines(values(z), jax.jacfwd(values)(z))


class Physical(eqx.Module):
    """Values in the units of `NAMES` and d/d(coordinates)."""

    value: Float[Array, " parameters"]
    slope: Float[Array, "parameters parameters"]


@eqx.filter_jit
def _physical(z: Float[Array, " parameters"], space: ParameterSpace) -> Physical:
    return Physical(space.physical(z), jax.jacfwd(space.physical)(z))


def physical_at(z: np.ndarray, space: ParameterSpace) -> Physical:
    """Values and slopes at a point, NumPy arrays."""
    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, _physical(jnp.asarray(z), space))


@dataclass(frozen=True)
class Sensitivity:
    """How a target hangs on the coordinates.

    Attributes:
        gradient: d(quantity)/d(coordinates) of each quantity whose worst is meant, shape (q, p).
        own: variance that no calibration lowers, by cause, shapes (q,): the stop and the reading at the point itself.
    """

    gradient: np.ndarray
    own: Mapping[str, np.ndarray] = field(default_factory=dict)

    @property
    def own_variance(self) -> np.ndarray:
        """Shape (q,)."""
        return sum(self.own.values(), np.zeros(len(self.gradient)))

    def value(self, covariance: np.ndarray, factor: float = 1.0) -> float:
        """The target's value under a covariance (p, p) of the coordinates."""
        variance = np.einsum("qi,ij,qj->q", self.gradient, covariance, self.gradient) + self.own_variance
        return float(factor * np.sqrt(variance.max()))


AT_POINT = ("stop error at the point", "aperture noise at the point")


def sensitivity(
    target: Target, z: np.ndarray, space: ParameterSpace, table: RigTable, pose_rad: np.ndarray
) -> Sensitivity:
    """Linearise a target at a point of parameter space.

    Args:
        target: what is wanted.
        z: coordinates, shape (p,).
        space: priors.
        table: gives the aperture's convention and the periods.
        pose_rad: where effective ratios hold, shape (2,).

    Raises:
        InputError: no beam reaches the target's point.
    """
    rows = list(target.indices)
    with jax.enable_x64(True):
        if target.point_mm is None:
            found = headlines(jnp.asarray(z), space, jnp.asarray(pose_rad))
            return Sensitivity(np.asarray(found.gradient)[rows])
    at = physical_at(z, space)
    physical, slope = at.value, at.slope
    inputs = [INDEX[name] for name in INPUT_NAMES]
    stop_sd = physical[[INDEX[name] for name in CALIBRATION_NOISE]]
    azimuth = table.aperture_convention == "azimuth"
    machine = Calibration(
        mean=physical[inputs],
        covariance=slope[inputs] @ slope[inputs].T,
        noise_variance=dict(zip(CALIBRATION_NOISE, stop_sd**2, strict=True)),
        overshoot_steps={"pan": OVERSHOOT_STEPS, "tilt": OVERSHOOT_STEPS},
        azimuth=azimuth,
        period_deg=table.harmonic_period_deg,
    )
    goal = machine.steps_for(target.point_mm)
    settings = settings_of(float(goal.pan_steps), float(goal.tilt_steps), goal.aperture_deg, goal.approach)
    count = len(inputs)
    with jax.enable_x64(True):
        law = propagate(
            settings,
            Sources(
                mean=jnp.asarray(np.concatenate([physical[inputs], np.zeros(NOISES)])),
                covariance=jnp.zeros((count + NOISES, count + NOISES)),
                stop_sd_deg=jnp.asarray(stop_sd),
                inputs=jnp.zeros((1, count + len(stop_sd))),
                noise=jnp.zeros((1, NOISES)),
                period_deg=space.harmonic_period_deg,
                azimuth_convention=jnp.asarray(azimuth),
            ),
        )
    jacobian = np.asarray(law.jacobian)[0][rows]
    own = jacobian[:, count:] ** 2
    here = {AT_POINT[0]: own[:, :2].sum(axis=1), AT_POINT[1]: own[:, 4]}
    return Sensitivity(jacobian[:, :count] @ slope[inputs], here)


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
    steps = [PlanStep(0, "home", *home)]
    at, travelled = np.array(home), np.zeros(2, dtype=int)
    order = np.lexsort((looks.steps[:, 0] * looks.side[:, 0], looks.side[:, 0], looks.side[:, 1], looks.sheet))
    path = np.zeros((len(looks), 2), dtype=int)
    placed = -1

    def go(counters: np.ndarray) -> None:
        nonlocal at
        travelled[:] += np.abs(counters - at)
        at = counters
        steps.append(PlanStep(len(steps), "move", int(counters[0]), int(counters[1])))

    for look in order:
        if looks.sheet[look] != placed:
            placed = int(looks.sheet[look])
            steps.append(PlanStep(len(steps), "place", target=sheets[placed]))
        goal, side = looks.steps[look], looks.side[look]
        run_up = (goal - at) * side < overshoot
        if run_up.any():
            go(np.where(run_up, goal - side * overshoot, at))
        go(goal)
        path[look] = travelled
        steps.append(PlanStep(len(steps), "look"))
    return Arranged(tuple(steps), order, path)


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
        words = np.array([("right", "left"), ("down", "up")])
        for begin in range(0, len(looks), self.BLOCK):
            part = slice(begin, begin + self.BLOCK)
            moves = [
                Move(i, i, 0.0, int(pan), int(tilt), words[0, int(left > 0)], words[1, int(up > 0)])
                for i, ((pan, tilt), (left, up)) in enumerate(zip(looks.steps[part], looks.side[part], strict=True))
            ]
            with jax.enable_x64(True):
                # Each look stands for itself: no home offsets.
                arrays = _design_arrays(moves, range(len(moves)), self.rig, homed_from=len(moves), aperture=aperture)
            self.blocks.append((arrays, depth[part]))

    def at(self, z: np.ndarray, space: ParameterSpace) -> Seen:
        """Evaluate at a point."""
        with jax.enable_x64(True):
            found = [_expected(arrays, depth, self.rig, z, space) for arrays, depth in self.blocks]
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


CRITERIA = ("c", "D", "A")
MEAN_WEIGHT = 0.05
"""Of the mean variance beside the worst: looks that help only the others still count a little."""


def scores(variances: np.ndarray, reference: np.ndarray, criterion: str) -> np.ndarray:
    """What a search lowers, from covariances (..., q, q) of the quantities; shape (...).

    "c": the worst variance and `MEAN_WEIGHT` of the mean; "D": log-determinant; "A": mean variance in units of
    `reference` (q,).
    """
    if criterion == "D":
        return np.linalg.slogdet(variances / np.sqrt(np.outer(reference, reference)))[1]
    diagonal = np.diagonal(variances, axis1=-2, axis2=-1)
    if criterion == "A":
        return np.mean(diagonal / reference, axis=-1)
    return diagonal.max(axis=-1) + MEAN_WEIGHT * diagonal.mean(axis=-1)


@dataclass
class Search:
    """Greedy choice and exchange of looks by low-rank updates of one covariance.

    Attributes:
        rows: of all candidates, shape (m, 4, P); a candidate that is not to be chosen has zero rows.
        precision: before any look, shape (P, P).
        gradient: d(quantity)/d(column), shape (q, P).
        own: variance beside it, shape (q,).
        criterion: see `scores`.

    A quantity that the priors hold fixed has no variance to lower and is left out.
    """

    rows: np.ndarray
    precision: np.ndarray
    gradient: np.ndarray
    own: np.ndarray
    criterion: str = "c"

    def __post_init__(self) -> None:
        self.covariance = covariance_of(self.precision)
        uncertain = np.diag(self._quantities(self.covariance)) > 0
        self.gradient, self.own = self.gradient[uncertain], self.own[uncertain]
        self.reference = np.diag(self._quantities(self.covariance)).copy()

    def _quantities(self, covariance: np.ndarray) -> np.ndarray:
        return self.gradient @ covariance @ self.gradient.T + np.diag(self.own)

    def after_one_more(self, covariance: np.ndarray) -> np.ndarray:
        """Score of every candidate if it were added, shape (m,): C - B^T K^-1 B, one 4 x 4 solve each."""
        count, _, columns = self.rows.shape
        spread = (self.rows.reshape(-1, columns) @ covariance).reshape(count, 4, columns)
        inner = spread @ self.rows.transpose(0, 2, 1) + np.eye(4)
        moved = spread @ self.gradient.T
        gain = np.swapaxes(moved, 1, 2) @ np.linalg.solve(inner, moved)
        return scores(self._quantities(covariance) - gain, self.reference, self.criterion)

    def _with(self, covariance: np.ndarray, look: int) -> np.ndarray:
        """Covariance with one look more."""
        row = self.rows[look]
        spread = row @ covariance
        updated = covariance - spread.T @ np.linalg.solve(np.eye(4) + spread @ row.T, spread)
        return 0.5 * (updated + updated.T)

    def greedy(self, count: int) -> list[int]:
        """The best look, then the best beside it, and so on."""
        covariance, picks = self.covariance, []
        for _ in range(count):
            picks.append(int(np.argmin(self.after_one_more(covariance))))
            covariance = self._with(covariance, picks[-1])
        return picks

    def value(self, picks: Sequence[int]) -> float:
        """Score of a design."""
        rows = self.rows[list(picks)].reshape(-1, self.rows.shape[2])
        covariance = covariance_of(self.precision + rows.T @ rows)
        return float(scores(self._quantities(covariance), self.reference, self.criterion))

    def exchange(self, picks: Sequence[int], passes: int = 2, worth: float = 1e-3) -> list[int]:
        """Replace looks one by one while that lowers the score by more than `worth` of it (Fedorov's exchange)."""
        picks = list(picks)
        for _ in range(passes):
            changed = False
            for place, look in enumerate(picks):
                rows = self.rows[picks[:place] + picks[place + 1 :]].reshape(-1, self.rows.shape[2])
                without = covariance_of(self.precision + rows.T @ rows)
                found = self.after_one_more(without)
                best = int(np.argmin(found))
                if found[look] - found[best] > worth * abs(found[look]):
                    picks[place], changed = best, True
            if not changed:
                break
        return picks


PAN_LEVELS, TILT_LEVELS = 9, 5
COARSE_PAN, COARSE_TILT = 31, 17
VISIBILITY_DRAWS = 24
VISIBLE_SHARE = 0.95
"""Share of draws of the instrument in which a candidate must be in both images."""
REACH_DEG = 60.0
"""Mirror angles beyond this are no candidates: a sheet is seen at grazing incidence there."""
UNSTATED_STEPS = {
    "pan": (min(GRID_PAN_STEPS) - OVERSHOOT_STEPS, max(GRID_PAN_STEPS) + OVERSHOOT_STEPS),
    "tilt": (min(GRID_TILT_STEPS) - OVERSHOOT_STEPS, max(GRID_TILT_STEPS) + OVERSHOOT_STEPS),
}
"""Counters used where `[positioner]` states no limits: those of the grid protocol, not one step more."""


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


@dataclass(frozen=True)
class CounterLimits:
    """Lowest and highest counter of (pan, tilt), shape (2, 2), and a note where the rig states none."""

    steps: np.ndarray
    notes: tuple[str, ...]


def counter_limits(rig: Rig) -> CounterLimits:
    """Limits of the rig file, or else those of the grid protocol."""
    limits, missing = [], []
    for axis in ("pan", "tilt"):
        keys = f"{axis}_min_steps", f"{axis}_max_steps"
        stated = [rig.positioner.get(key) for key in keys]
        missing += [key for key, value in zip(keys, stated, strict=True) if value is None]
        limits.append([d if s is None else s for s, d in zip(stated, UNSTATED_STEPS[axis], strict=True)])
    if not missing:
        return CounterLimits(np.array(limits), ())
    note = (
        f"[positioner] does not state {', '.join(missing)}: counters stay within pan "
        f"{limits[0][0]} to {limits[0][1]}, tilt {limits[1][0]} to {limits[1][1]}; wider limits would allow longer "
        "travel, and full turns"
    )
    return CounterLimits(np.array(limits), (note,))


def draws_of(knowledge: Knowledge, count: int, generator: np.random.Generator) -> np.ndarray:
    """Coordinates of instruments that may stand there, shape (count, p)."""
    root = np.linalg.cholesky(knowledge.covariance)
    return knowledge.z + generator.standard_normal((count, PARAMETERS)) @ root.T


def overshoot_steps(knowledge: Knowledge) -> np.ndarray:
    """Run-up (pan, tilt) that takes up the play in 99 % of instruments, and four stop errors, with half again."""
    draws = draws_of(knowledge, 200, np.random.default_rng(17))
    physical = np.stack([physical_at(z, knowledge.space).value for z in draws])
    result = []
    for axis, sides in (("pan", ("left", "right")), ("tilt", ("up", "down"))):
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
    stated = counter_limits(rig)
    limits, notes = stated.steps, list(stated.notes)
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
