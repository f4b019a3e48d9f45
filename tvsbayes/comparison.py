"""Calibrations compared: classic against joint on angles left out, their gap explained, in millimetres, and over time.

Frame T, mm; counters in steps; ratios in deg/step. In millimetres, the draws of a calibration stand for the rigs that
the data allow: on each of them the beam is followed to a range, the aperture reads it, and every estimator is asked
where the spot is. Nominal and classic users are given what is fair (DESIGN 5): a baseline shortened by the mirror
offset, its middle moved by half of that, and readings in the convention their equations expect.
"""

from __future__ import annotations

import datetime
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tvsbayes.calibration import (
    DIVERGING_SHARE,
    INPUT_NAMES,
    NOISE_NAMES,
    Calibration,
    Ray,
    aperture_angle_deg,
    beam_components,
    direction_of,
    drawn,
    range_components,
    stored_ratios,
)
from tvsbayes.campaign import Campaign
from tvsbayes.certificate import BudgetTable, coordinate_budget
from tvsbayes.classic import DIRECTIONS, ClassicResult, Selection, classic, four_point_ratios, select_experiments
from tvsbayes.files import JSON_BYTES_MAX, Keys, NothingToEstimate, TvsError, parse_json, read_bytes
from tvsbayes.rigs import RIG_PRIORS, Prior

if TYPE_CHECKING:
    from tvsbayes.joint import JointFit
    from tvsbayes.model import ParameterSpace
    from tvsbayes.posterior import Posterior

STOP_HERE, APERTURE_HERE, PLAY_HERE = "stop error here", "aperture noise here", "unknown approach here"
"""Causes that belong to the one look and not to the calibration."""


@dataclass(frozen=True)
class SimpleCalibration:
    """What a user of published equations knows: C = C0 + k n, beta = k n, no backlash (DESIGN 5).

    Attributes:
        deg_per_step: by direction (left, right, up, down): counters above zero were reached left or up.
        baseline_mm: distance from the aperture to where the beam leaves the positioner, a - L.
        origin_y_mm: where it leaves it in frame T, a/2 - L: the middle between both is moved by -L/2.
        pan_zero_emission_deg: C0.
        aperture_zero_deg: what the aperture's readings are corrected by.
    """

    deg_per_step: Mapping[str, float]
    baseline_mm: float
    origin_y_mm: float
    pan_zero_emission_deg: float
    aperture_zero_deg: float


def simple_calibration(
    priors: Mapping[str, Prior] = RIG_PRIORS, classic: ClassicResult | None = None
) -> SimpleCalibration:
    """The nominal calibration of stated priors, or with the classic estimator's ratios.

    Directions that the classic estimator did not measure keep their nominal ratio.
    """
    nominal = {"left": "pan", "right": "pan", "up": "tilt", "down": "tilt"}
    ratios = {direction: priors[f"degrees_per_step.{axis}"].value for direction, axis in nominal.items()}
    if classic is not None:
        measured = {d: r.mean_deg_per_step for d, r in classic.directions.items() if r is not None}
        ratios |= measured
    a, offset = priors["baseline_mm"].value, priors["mirror_offset_mm"].value
    zeros = (priors["pan_zero_emission_deg"].value, priors["aperture_zero_deg"].value)
    return SimpleCalibration(ratios, a - offset, 0.5 * a - offset, *zeros)


def simple_rays(simple: SimpleCalibration, steps: np.ndarray) -> Ray:
    """Beams, fields of shape (3, points), of a simple calibration at counters (points, 2).

    The azimuth C0 + k n and the elevation k n are turned into a direction, so that either convention of the
    aperture's angle meets it as it should.
    """
    steps = np.asarray(steps, dtype=float)
    k = simple.deg_per_step
    pan = np.where(steps[:, 0] >= 0, k["left"], k["right"]) * steps[:, 0] + simple.pan_zero_emission_deg - 90.0
    tilt = np.where(steps[:, 1] >= 0, k["up"], k["down"]) * steps[:, 1]
    direction = direction_of(pan, tilt)
    origin = np.zeros_like(direction)
    origin[1] = simple.origin_y_mm
    return Ray(origin, direction)


@dataclass(frozen=True)
class ErrorMap:
    """Errors over pan, tilt and range; arrays (pan, tilt, range), not a number where nothing can be located.

    Attributes:
        pan_steps, tilt_steps, range_mm: the axes; ranges along the beam.
        rms_mm: root mean square distance from the true point, by estimator.
        bias_mm: mean error vector, by estimator, shape (pan, tilt, range, 3).
        inside: counters within those of the campaign.
        valid: every estimator asked finds a point in all but `coordinates.DIVERGING_SHARE` of the draws.
        distance_mm: 3D errors by estimator, arrays (draws, pan, tilt, range), infinite where there is no point.
    """

    pan_steps: np.ndarray
    tilt_steps: np.ndarray
    range_mm: np.ndarray
    rms_mm: Mapping[str, np.ndarray]
    bias_mm: Mapping[str, np.ndarray]
    inside: np.ndarray
    valid: np.ndarray
    distance_mm: Mapping[str, np.ndarray]


def error_map(
    calibration: Calibration,
    pan_steps: Sequence[float] | np.ndarray,
    tilt_steps: Sequence[float] | np.ndarray,
    range_mm: Sequence[float] | np.ndarray,
    *,
    simple: Mapping[str, SimpleCalibration],
    approach: tuple[float, float] = (1.0, 1.0),
    draws: int = 500,
    seed: int = 0,
) -> ErrorMap:
    """Expected errors of the joint calibration and of simple ones, over the rigs that the data allow.

    Args:
        calibration: with draws.
        pan_steps: counters, shape (p,).
        tilt_steps: counters, shape (t,).
        range_mm: ranges along the beam, shape (r,).
        simple: further calibrations by name, such as "nominal" and "classic", from `simple_calibration`.
        approach: sides, +1 left or up, -1 right or down.
        draws: rigs.
        seed: of their stop errors and aperture noise.

    Returns:
        The map; the joint calibration is "joint".
    """
    axes = [np.asarray(x, dtype=float) for x in (pan_steps, tilt_steps, range_mm)]
    pan, tilt, ranges = (x.ravel() for x in np.meshgrid(*axes, indexing="ij"))
    steps = np.stack([pan, tilt], axis=1)
    rigs = drawn(calibration, draws, seed)
    # Axes: draws, points.
    values = dict(zip((*INPUT_NAMES, *NOISE_NAMES), rigs.inputs.T[..., None], strict=True))
    noise = rigs.noise.T[..., None]
    origin, direction = beam_components(values, *calibration.noisy_angles(values, noise, (pan, tilt), approach))
    points = np.array([o + ranges * d for o, d in zip(origin, direction, strict=True)])
    reading = aperture_angle_deg(tuple(points), values["baseline_mm"], calibration.azimuth)
    reading = reading + values["aperture_zero_deg"] + values["aperture_sd_deg"] * noise[4]
    best = calibration.estimates
    beam = beam_components(best, *calibration.angles(best, (pan, tilt), approach))
    looks = {"joint": (*beam, best["baseline_mm"], best["aperture_zero_deg"])}
    for name, one in simple.items():
        ray = simple_rays(one, steps)
        # `range_components` puts the aperture at half the distance it is given; a simple user's stands at origin -
        # baseline.
        aperture = 2 * (one.baseline_mm - one.origin_y_mm), one.aperture_zero_deg
        looks[name] = tuple(ray.origin_mm), tuple(ray.direction), *aperture
    shape = tuple(len(x) for x in axes)
    rms, bias, distance, valid = {}, {}, {}, np.ones(shape, dtype=bool)
    for name, (origin, direction, baseline_mm, zero_deg) in looks.items():
        reach = range_components(origin, direction, baseline_mm, reading - zero_deg, calibration.azimuth)
        meets = np.isfinite(reach) & (reach > 0)
        reach = np.where(meets, reach, 0.0)
        error = np.array([o + reach * d for o, d in zip(origin, direction, strict=True)]) - points
        share = (~meets).mean(axis=0)
        kept = np.where(meets, error, 0.0)
        count = np.maximum(meets.sum(axis=0), 1)
        usable = share <= DIVERGING_SHARE
        square = np.sum(kept**2, axis=(0, 1)) / count
        rms[name] = np.where(usable, np.sqrt(square), np.nan).reshape(shape)
        bias[name] = np.where(usable, kept.sum(axis=1) / count, np.nan).T.reshape(*shape, 3)
        valid &= usable.reshape(shape)
        length = np.where(meets, np.linalg.norm(error, axis=0), np.inf)
        distance[name] = length.reshape(-1, *shape)
    (pan_low, pan_high), (tilt_low, tilt_high) = calibration.range_steps
    within = (pan >= pan_low) & (pan <= pan_high) & (tilt >= tilt_low) & (tilt <= tilt_high)
    inside = within.reshape(shape)
    return ErrorMap(*axes, rms_mm=rms, bias_mm=bias, inside=inside, valid=valid, distance_mm=distance)


MET, NOT_MET = "met", "not met"
MET_PROBABILITY = 0.95


@dataclass(frozen=True)
class Criterion:
    """Whether an error stays within a limit.

    Attributes:
        quantity: whose error.
        limit: largest error allowed, in `unit`.
        unit: of the limit.
        probability: that the error lies within it.
        verdict: "met" from a probability of 0.95 on, "not met" up to 0.05, else "cannot tell".
    """

    quantity: str
    limit: float
    unit: str
    probability: float
    verdict: str


def criterion(quantity: str, errors: np.ndarray, limit: float, unit: str) -> Criterion:
    """Judge draws of an error (n,) by a limit (decision rule stated beforehand, ISO/IEC 17025 7.8.6)."""
    probability = float(np.mean(np.abs(errors) <= limit))
    verdict = MET if probability >= MET_PROBABILITY else NOT_MET if probability <= 1 - MET_PROBABILITY else CANNOT_TELL
    return Criterion(quantity, limit, unit, probability, verdict)


@dataclass(frozen=True)
class Budget:
    """What the variance of one point consists of, by the law of propagation.

    Attributes:
        causes: pixel noise, stop errors of the campaign, stereo calibration, focal scale, every prior, and what this
            one look adds.
        share: of the total variance (sum over x, y, z), shape (causes,); sums to 1.
        variance_mm2: by cause and coordinate, shape (causes, 3).
        parameters: names of the inputs and of this look's noises.
        contribution_mm: sensitivity times standard uncertainty, shape (parameters, 3).
        correlation: of the parameters, shape (parameters, parameters); their contributions do not add up without it.
        covariance_mm2: of the point, shape (3, 3).
    """

    causes: tuple[str, ...]
    share: np.ndarray
    variance_mm2: np.ndarray
    parameters: tuple[str, ...]
    contribution_mm: np.ndarray
    correlation: np.ndarray
    covariance_mm2: np.ndarray

    def as_json(self) -> dict[str, object]:
        """Causes with share and standard uncertainty, parameters with signed contributions and correlations."""
        u = np.sqrt(self.variance_mm2)
        return {
            "causes": [
                {"cause": name, "share": float(share), "u_mm": row.tolist()}
                for name, share, row in zip(self.causes, self.share, u, strict=True)
            ],
            "parameters": [
                {"name": name, "contribution_mm": row.tolist()}
                for name, row in zip(self.parameters, self.contribution_mm, strict=True)
            ],
            "correlation": self.correlation.tolist(),
        }


def budget(
    calibration: Calibration,
    pan_steps: float,
    tilt_steps: float,
    aperture_deg: float,
    approach: tuple[str, str] = ("left", "up"),
) -> Budget:
    """The uncertainty budget of one point (GUM 7.2.7 asks for it): by cause, and by parameter with correlations.

    Args:
        calibration: with causes, as a fit keeps them.
        pan_steps: absolute counter.
        tilt_steps: absolute counter.
        aperture_deg: reading B.
        approach: last move of (pan, tilt): left or right, up or down, or unknown.

    Raises:
        ValueError: a calibration that does not know its causes.
        InputError: an approach that does not exist, or beam and line of sight do not meet.
    """
    if not calibration.causes:
        raise ValueError("this calibration does not know its causes: fit the campaign again")
    jacobian = calibration.derivatives(pan_steps, tilt_steps, aperture_deg, approach)
    covariance = calibration.covariance_with_noise
    count = len(INPUT_NAMES)
    calibrated, here = jacobian[:, :count], jacobian[:, count:]
    by_cause = [np.einsum("ij,jk,ik->i", calibrated, c, calibrated) for c in calibration.cause_covariance]
    own = here**2 * np.diag(covariance)[count:]
    by_cause += [own[:, :2].sum(axis=1), own[:, 2:4].sum(axis=1), own[:, 4]]
    variance = np.array(by_cause)
    u = np.sqrt(np.diag(covariance))
    # What does not vary correlates with nothing.
    safe = np.where(u > 0, u, 1.0)
    noises = (
        "stop error pan",
        "stop error tilt",
        "place in the play, pan",
        "place in the play, tilt",
        "aperture noise",
    )
    return Budget(
        causes=(*calibration.causes, STOP_HERE, PLAY_HERE, APERTURE_HERE),
        share=variance.sum(axis=1) / variance.sum(),
        variance_mm2=variance,
        parameters=(*INPUT_NAMES, *noises),
        contribution_mm=(jacobian * u).T,
        correlation=covariance / np.outer(safe, safe),
        covariance_mm2=jacobian @ covariance @ jacobian.T,
    )


GAP_DRAWS = 256
OPTICS = tuple(name for name in RIG_PRIORS if name.startswith(("mirror1", "mirror2", "laser_", "tilt_axis_")))
"""What bends the beam's way through the positioner; all zero in the nominal rig."""
BACKLASH, STEREO_SCALE, SKEW, PROJECTION, CHANCE = (
    "backlash over N",
    "stereo scale and focal scale",
    "skew of mirrors, laser and axes",
    "projection and pose",
    "chance",
)
"""Terms of the gap. The last is what the classic's own spots add: stop errors and pixel noise."""


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


def _ideal(space: ParameterSpace, names: Sequence[str]) -> ParameterSpace:
    """The priors with parameters fixed at their ideal values: 0, or 1 for the focal scale; cameras as stated."""
    import jax.numpy as jnp

    from tvsbayes.model import INDEX, RIG_NAMES

    rows = jnp.asarray([INDEX[name] for name in names if name in RIG_NAMES])
    ideal = jnp.asarray([1.0 if name == "focal_scale" else 0.0 for name in names if name in RIG_NAMES])
    space = replace(space, value=space.value.at[rows].set(ideal), u=space.u.at[rows].set(0.0))
    if "focal_scale" in names:
        space = replace(space, stereo_root=jnp.zeros_like(space.stereo_root))
    return space


def explain_gap(found: JointFit, posterior: Posterior | None = None, draws: int = GAP_DRAWS) -> dict[str, Gap | None]:
    """The gap between both estimators, term by term (DESIGN 1).

    On every draw the model takes the classic estimator's spots without noise, and again without backlash, then with
    the stated cameras in place of the true ones, then with ideal optics. Each change of the classic mean is one
    term; what then still separates it from the ratio of the ideal optics is projection: the tilt read as
    atan(dZ/dX) off the X axis, the offset of the mirrors, poses other than the reference. Terms depend little on
    their order, and they add up.

    Args:
        found: a converged fit of the campaign.
        posterior: its sample, for its draws in place of the Laplace approximation's.
        draws: that the intervals of the terms rest on, at least two; ratio and gap rest on all.

    Returns:
        By direction; None without complete experiments.
    """
    import jax
    import jax.numpy as jnp

    from tvsbayes.joint import derived_quantities
    from tvsbayes.posterior import looks

    selection = select_experiments(found.campaign)
    result: dict[str, Gap | None] = dict.fromkeys(DIRECTIONS)
    if not len(selection.experiments):
        return result
    if posterior is None:
        z = np.vstack([found.z, found.draws_z[:draws]])
        ratios_of_all = found.draws.effective_deg_per_step
    else:
        every = posterior.z.reshape(-1, posterior.z.shape[-1])
        z = every[np.linspace(0, len(every) - 1, draws).astype(int)]
        ratios_of_all = posterior.draws.effective_deg_per_step.reshape(-1, len(DIRECTIONS))
    pixels_of = _experiment_pixels(found, selection)
    with jax.enable_x64(True):
        spaces = [found.space]
        for names in (("backlash_deg.pan", "backlash_deg.tilt"), ("focal_scale",), OPTICS):
            spaces.append(_ideal(spaces[-1], names))
        pose = jnp.asarray(found.reference_pose_rad)
        full, ideal = (
            np.asarray(derived_quantities(jnp.asarray(z), space, pose).effective_deg_per_step)
            for space in (spaces[0], spaces[-1])
        )
    try:
        measured = classic(found.campaign)
    except NothingToEstimate:
        return result
    quiet = np.zeros((len(z), len(found.arrays.spots.valid), 2))
    ratios = []
    for space in spaces:
        pixels = pixels_of(looks(replace(found, space=space), z, quiet))
        every = [four_point_ratios(p, selection.steps, selection.axis, found.campaign.stereo) for p in pixels]
        ratios.append(np.stack(every))
    # An experiment whose spots lie on one another, or beyond the lens model, has no ratio.
    sound = np.all([np.isfinite(r).all(axis=0) for r in ratios], axis=0)
    for k, direction in enumerate(DIRECTIONS):
        chosen = (selection.direction == direction) & sound
        found_classic = measured.directions[direction]
        if not chosen.any() or found_classic is None:
            continue
        seen = found_classic.mean_deg_per_step
        whole, unplayed, scaled, straight = (r[:, chosen].mean(axis=1) for r in ratios)
        parts = {
            BACKLASH: whole - unplayed,
            STEREO_SCALE: unplayed - scaled,
            SKEW: scaled - straight - (full[:, k] - ideal[:, k]),
            PROJECTION: straight - ideal[:, k],
            CHANCE: seen - whole,
        }

        # The ratio itself as every table states it, from all draws; its mean is a control variate for those of the
        # terms, which then add up to the gap.
        ratio, own = ratios_of_all[:, k], full[:, k]
        centre = own[0] if posterior is None else ratio.mean()

        def term(name: str, values: np.ndarray, own: np.ndarray = own, centre: float = centre) -> GapTerm:
            if posterior is None:
                value, sampled = values[0], values[1:]
            else:
                slope = np.cov(values, own)[0, 1] / own.var(ddof=1) if np.ptp(own) > 0 else 0.0
                value, sampled = values.mean() + slope * (centre - own.mean()), values
            return GapTerm(name, float(value), float(sampled.std()), _middle95(sampled))

        sd = float(ratio.std())
        joint = GapTerm("effective ratio", float(centre), sd, _middle95(ratio))
        total = GapTerm("classic - joint", float(seen - centre), sd, _middle95(seen - ratio))
        result[direction] = Gap(seen, joint, total, tuple(term(name, values) for name, values in parts.items()))
    return result


def _middle95(draws: np.ndarray) -> tuple[float, float]:
    low, high = np.quantile(draws, [0.025, 0.975])
    return float(low), float(high)


def _experiment_pixels(found: JointFit, selection: Selection) -> Callable[[np.ndarray], np.ndarray]:
    """Picks the four looks of each experiment, (draws, e, 4, 4), from those of all spots in the filter's order."""
    from tvsbayes.likelihood import ordered_spots

    row_of = {spot.spot: row for row, spot in enumerate(ordered_spots(found.campaign))}
    ids = [[row_of[found.campaign.spots[r].spot] for r in four] for four in selection.spot_rows]
    rows = np.array(ids, dtype=int).reshape(-1, 4)
    return lambda pixels: pixels[:, rows]


HOLD_OUT_DRAWS = 256
REGIONS = 4
BLOCKS_MIN = 3
"""Fewest blocks whose scatter is worth an interval."""
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


def folds_of(campaign: Campaign, selection: Selection, by: str) -> dict[str, np.ndarray]:
    """Masks (e,) of the experiments that are left out together.

    Raises:
        ValueError: another scheme.
    """
    if by == "steps":
        lengths = np.abs(selection.steps)
        return {f"|N| = {n}": lengths == n for n in np.unique(lengths)}
    if by != "regions":
        raise ValueError(f'folds by "steps" or "regions", not {by!r}')
    moves = {move.move: move for move in campaign.moves}
    starts = [moves[campaign.spots[four[0]].move] for four in selection.spot_rows]
    moved = np.array([m.pan_steps if a == "pan" else m.tilt_steps for m, a in zip(starts, selection.axis, strict=True)])
    folds = {}
    for axis in ("pan", "tilt"):
        mine = selection.axis == axis
        counters = np.unique(moved[mine])
        if not len(counters):
            continue
        for part in np.array_split(counters, min(REGIONS, len(counters))):
            name = f"{axis} from {part[0]}" + (f" to {part[-1]}" if len(part) > 1 else "")
            folds[name] = mine & np.isin(moved, part)
    return folds


def hold_out(fit_of_all: JointFit, by: str = "steps", seed: int = 0) -> HoldOut:
    """Leave experiments out, fold by fold, refit, and ask both estimators for their four-point angles.

    The classic foretells N times its mean of the direction; its uncertainty is the scatter of angles about N times
    the mean, and that of the mean. The joint foretells what the classic chain would measure on its beams, with
    stop errors and pixel noise drawn anew: the same quantity for both. Noise common to all experiments (the cameras)
    moves both predictions and the measured angle alike and is reported beside.

    Args:
        fit_of_all: a converged fit; its campaign and model are used.
        by: "steps" or "regions", see `folds_of`.
        seed: of the predictive draws.
    """
    from tvsbayes.posterior import looks_again

    campaign = fit_of_all.campaign
    selection = select_experiments(campaign)
    unseen = dict(zip(DIRECTIONS, _camera_u(fit_of_all).tolist(), strict=True))
    lengths = np.unique(np.abs(selection.steps))

    def undecided(reason: str) -> HoldOut:
        return HoldOut(by, (), None, None, None, None, CANNOT_TELL, reason, unseen)

    if not len(selection.experiments):
        return undecided("there is no complete experiment")
    folds = folds_of(campaign, selection, by)
    if len(folds) < 2:
        what = f"all experiments have |N| = {lengths[0]}" if by == "steps" else "all experiments start at one counter"
        return undecided(f"{what}: a constant lost motion looks like a ratio there; measure a second |N|")
    angle = four_point_ratios(selection.pixels, selection.steps, selection.axis, campaign.stereo) * selection.steps
    predictions: list[Prediction] = []
    for index, (name, out) in enumerate(folds.items()):
        foretold = _foretell_classic(angle, selection, out)
        if not foretold:
            continue
        ids = frozenset(campaign.spots[r].spot for r in selection.spot_rows[out].ravel())
        without = f"without the experiments {name}"
        try:
            taught = _refit(fit_of_all, ids)
        except TvsError as error:
            return undecided(f"{without} there is no fit: {error.message}")
        if not taught.converged:
            return undecided(f"{without} the fit does not converge: {'; '.join(taught.problems)}")
        generator = np.random.default_rng([seed, index])
        z = taught.draws_z[:HOLD_OUT_DRAWS]
        pixels = looks_again(taught, z, taught.draws.physical[:HOLD_OUT_DRAWS], generator)
        pixels = _experiment_pixels(taught, selection)(pixels)[:, out]
        chosen = {"steps": selection.steps[out], "axis": selection.axis[out]}
        draws = np.stack([four_point_ratios(p, stereo=campaign.stereo, **chosen) for p in pixels]) * chosen["steps"]
        for k, e in enumerate(np.flatnonzero(out)):
            # Draws beyond the cameras' lens model tell no angle.
            told = draws[np.isfinite(draws[:, k]), k]
            if e in foretold and len(told) > 1:
                predictions.append(
                    Prediction(
                        int(selection.experiments[e]),
                        name,
                        str(selection.direction[e]),
                        int(selection.steps[e]),
                        float(angle[e]),
                        *foretold[e],
                        float(told.mean()),
                        float(told.std(ddof=1)),
                    )
                )
    if not predictions:
        return undecided("no direction has two experiments outside of every fold")
    return _judge(by, predictions, lengths, unseen)


def _refit(fit_of_all: JointFit, without: frozenset[int]) -> JointFit:
    """The same model on fewer spots; its harmonics, contrasts and backlash are free where they were."""
    from tvsbayes.joint import fit, priors_used

    rig, space = fit_of_all.campaign.rig, fit_of_all.space
    priors = priors_used(rig.priors, np.asarray(space.value), np.asarray(space.u))
    held = replace(fit_of_all.campaign, rig=replace(rig, priors=priors))
    return fit(held, without=without | set(fit_of_all.excluded_spots))


def _foretell_classic(angle: np.ndarray, selection: Selection, out: np.ndarray) -> dict[int, tuple[float, float, int]]:
    """Angle, standard uncertainty and its dof of each left-out experiment whose direction has two others, by row.

    Experiments without a finite angle (pixels beyond the lens model) neither teach nor are asked.
    """
    found = {}
    seen = np.isfinite(angle)
    for direction in DIRECTIONS:
        mine = seen & (selection.direction == direction)
        taught, asked = np.flatnonzero(mine & ~out), np.flatnonzero(mine & out)
        if len(taught) < 2:
            continue
        ratios = angle[taught] / selection.steps[taught]
        mean, sd = ratios.mean(), ratios.std(ddof=1)
        noise = np.sum((angle[taught] - mean * selection.steps[taught]) ** 2) / (len(taught) - 1)
        for e in asked:
            steps = float(selection.steps[e])
            u = float(np.sqrt(noise + (steps * sd) ** 2 / len(taught)))
            found[int(e)] = float(mean * steps), u, len(taught) - 1
    return found


def _judge(by: str, predictions: list[Prediction], lengths: np.ndarray, unseen: dict[str, float]) -> HoldOut:
    """Scores of both, and whether the difference is more than chance."""
    from scipy import stats

    angle, blocks = np.array([p.angle_deg for p in predictions]), [(p.fold, p.direction) for p in predictions]
    of_block = {b: np.array([x == b for x in blocks]) for b in dict.fromkeys(blocks)}
    scores, means = {}, {}
    dof = {"classic": np.array([p.classic_dof for p in predictions]), "joint": np.inf}
    for name in ("classic", "joint"):
        told = np.array([getattr(p, f"{name}_deg") for p in predictions])
        u = np.array([getattr(p, f"{name}_u_deg") for p in predictions])
        error = angle - told
        means[name] = np.array([error[rows].mean() for rows in of_block.values()])
        scores[name] = Score(
            rms_deg=float(np.sqrt(np.mean(error**2))),
            rms_block_deg=float(np.sqrt(np.mean(means[name] ** 2))),
            coverage=float(np.mean(np.abs(error) <= stats.t.ppf(0.975, dof[name]) * u)),
            log_density=float(np.mean(stats.t.logpdf(error, dof[name], scale=u))),
        )
    blocks_seen = len(of_block)
    ratio = scores["classic"].rms_block_deg / scores["joint"].rms_block_deg
    interval, verdict = None, CANNOT_TELL
    if len(lengths) == 1:
        reason = f"all experiments have |N| = {lengths[0]}: a constant lost motion looks like a ratio in all of them"
    elif blocks_seen < BLOCKS_MIN:
        reason = f"{blocks_seen} blocks (fold and direction) tell nothing of their scatter"
    else:
        interval = _ratio_interval(means["classic"], means["joint"])
        if interval[0] > 1:
            verdict = BETTER_JOINT
        elif interval[1] < 1:
            verdict = BETTER_CLASSIC
        reason = f"over {blocks_seen} blocks (fold and direction) the classic errs {ratio:.2g} times as much as the "
        reason += f"joint, 95 % interval {interval[0]:.2g} to {interval[1]:.2g}"
    return HoldOut(
        by,
        tuple(predictions),
        scores["classic"],
        scores["joint"],
        float(ratio),
        interval,
        verdict,
        reason,
        unseen,
    )


def _ratio_interval(first: np.ndarray, second: np.ndarray) -> tuple[float, float]:
    """95 % interval of rms(first) / rms(second) for pairs of errors with mean 0 and any correlation.

    First and c second have equal mean squares if their sum and difference are uncorrelated: those c for which the
    t test of that correlation (n - 1 degrees of freedom, means known to be 0) does not reject are the interval.
    """
    from scipy import stats

    n = len(first)
    ratio = np.sqrt(np.sum(first**2) / np.sum(second**2))
    correlation = first @ second / np.sqrt(np.sum(first**2) * np.sum(second**2))
    # Of proportional errors the correlation may exceed 1 by rounding.
    k = 1 + 2 * max(0.0, 1 - correlation**2) * stats.t.ppf(0.975, n - 1) ** 2 / (n - 1)
    root = np.sqrt(k**2 - 1)
    return float(ratio * np.sqrt(k - root)), float(ratio * np.sqrt(k + root))


def _influence(found: JointFit, slopes: np.ndarray) -> np.ndarray:
    """Shift (q, p) of quantities with gradients (q, p) if the prior of coordinate j is off by its sd: (S e_j)."""
    fisher = found.information.fisher
    return slopes @ np.linalg.inv(fisher + np.eye(len(fisher)))


def _camera_influence(found: JointFit, values: np.ndarray) -> np.ndarray:
    """That of the stereo calibration's priors and the focal scale's on quantities whose draws are (n, q)."""
    from tvsbayes.information import gradients
    from tvsbayes.model import INDEX, NAMES, RIG_NAMES

    cameras = [INDEX["focal_scale"], *range(len(RIG_NAMES), len(NAMES))]
    return _influence(found, gradients(found, values))[:, cameras]


def _camera_u(found: JointFit) -> np.ndarray:
    """Standard uncertainty (4,) of the effective ratios that stereo calibration and focal scale alone cause."""
    shift = _camera_influence(found, found.draws.effective_deg_per_step)
    return np.sqrt(np.sum(shift**2, axis=1))


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


def compare(first: JointFit, second: JointFit) -> Comparison:
    """Whether an instrument has changed between two campaigns (normalised differences; ISO 13528 9.7 has the idea).

    The u of a difference leaves out what both campaigns share: with the same stereo calibration, its error and that
    of the focal scale move both estimates alike, by influences known from the fits. Everything else is taken as
    independent.

    Args:
        first: converged fit of A.
        second: converged fit of B.
    """
    import jax
    import jax.numpy as jnp
    from scipy import stats

    from tvsbayes.joint import derived_quantities
    from tvsbayes.model import INDEX

    pose = first.reference_pose_rad
    cameras = first.campaign.stereo, second.campaign.stereo
    shared = bool(
        np.array_equal(cameras[0].vector, cameras[1].vector)
        and np.array_equal(cameras[0].parameter_covariance, cameras[1].parameter_covariance)
    )
    values, influence = [], []
    for found in (first, second):
        with jax.enable_x64(True):
            at_pose = derived_quantities(
                jnp.asarray(np.vstack([found.z, found.draws_z])), found.space, jnp.asarray(pose)
            )
        backlash = np.asarray(at_pose.physical)[:, [INDEX["backlash_deg.pan"], INDEX["backlash_deg.tilt"]]]
        rows = np.concatenate([np.asarray(at_pose.effective_deg_per_step), backlash], axis=1)
        values.append(rows)
        influence.append(_camera_influence(found, rows[1:]))
    names = [*(f"effective_deg_per_step.{d}" for d in DIRECTIONS), "backlash_deg.pan", "backlash_deg.tilt"]
    units = ["deg/step"] * 4 + ["deg"] * 2
    limit = float(stats.norm.isf(0.5 * (1 - 0.95 ** (1 / len(names)))))
    variance = sum(v[1:].var(axis=0, ddof=1) for v in values)
    if shared:
        variance = variance - 2 * np.sum(influence[0] * influence[1], axis=1)
    changes = []
    for k, name in enumerate(names):
        a, b = (float(v[0, k]) for v in values)
        # What both hold fixed has changed if the statements differ; its variance is zero but for rounding.
        fixed = all(np.ptp(v[1:, k]) == 0 for v in values)
        u = 0.0 if fixed else float(np.sqrt(max(variance[k], 0.0)))
        ratio = (b - a) / u if u > 0 else None
        significant = a != b if ratio is None else abs(ratio) > limit
        changes.append(Change(name, units[k], a, b, b - a, u, ratio, significant))
    moved = [c for c in changes if c.significant]
    listed = ", ".join(
        f"{c.quantity} by {c.difference:+.3g} {c.unit} "
        + ("(held fixed)" if c.normalised is None else f"({c.normalised:+.1f} u)")
        for c in moved
    )
    verdict = f"changed: {listed}" if moved else "no significant change"
    days = _days_between(first.campaign, second.campaign)
    pan, tilt = np.degrees(pose)
    return Comparison((float(pan), float(tilt)), tuple(changes), shared, days, limit, verdict)


def _days_between(first: Campaign, second: Campaign) -> float | None:
    """Days between two campaigns that both say when they were made; dates count from midnight, UTC."""
    made = []
    for campaign in (first, second):
        when = campaign.header.get("created")
        if not isinstance(when, datetime.date):
            return None
        if not isinstance(when, datetime.datetime):
            when = datetime.datetime.combine(when, datetime.time())
        made.append(when if when.tzinfo else when.replace(tzinfo=datetime.UTC))
    return (made[1] - made[0]).total_seconds() / 86400


MAP_CELLS = 5
"""Per axis; odd, so that one lies in the middle."""
MAP_DRAWS = 1000
"""Rigs of the maps: a probability near 0.95 is then known to 0.007."""
MAP_RANGES_MM = (300.0, 2000.0)
"""Ranges mapped besides the stated one: the scanner's near and far ends."""


@dataclass(frozen=True)
class Evidence:
    """Everything a report shows.

    Attributes:
        campaign: what was measured.
        fit: the document of `results/fit.json`.
        classic: the paper's estimator; None without complete experiments.
        held_out: the document of `results/compare.json`, None where `compare` was not run on these data.
        planned: the document of `results/plan.json`, None where `plan --given` was not run on these data.
        criteria: what was asked of the calibration, judged.
        distances_mm: draws of the 3D error by estimator at `range_mm` and the middle of the counters.
        range_mm: stated range.
        maps: error maps.
        budget: of a point at that range.
        point: the same for its least certain coordinate, by parameter.
    """

    campaign: Campaign
    fit: Mapping[str, object]
    classic: ClassicResult | None
    held_out: Mapping[str, object] | None
    planned: Mapping[str, object] | None
    criteria: Sequence[Criterion]
    distances_mm: Mapping[str, np.ndarray]
    range_mm: float
    maps: ErrorMap
    budget: Budget | None
    point: BudgetTable | None


def _stored(campaign: Campaign, fit: Mapping[str, object], name: str) -> Keys | None:
    """A document in `results/`, where it was made from the data and priors of this fit."""
    path = campaign.path / "results" / name
    if not path.exists():
        return None
    keys = parse_json(read_bytes(path, JSON_BYTES_MAX), f"results/{name}")
    return keys if keys.values.get("inputs") == fit["inputs"] else None


def _stored_hold_out(campaign: Campaign, fit: Mapping[str, object]) -> dict[str, object] | None:
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


def _stored_plan(campaign: Campaign, fit: Mapping[str, object]) -> dict[str, object] | None:
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


def gather(
    campaign: Campaign,
    fit: Mapping[str, object],
    calibration: Calibration,
    *,
    range_mm: float,
    limit_deg_per_step: float | None = None,
    limit_mm: float | None = None,
) -> Evidence:
    """Ask the library for everything a report shows.

    Args:
        campaign: what was measured.
        fit: its `fit.json`.
        calibration: its draws.
        range_mm: at which millimetres are stated.
        limit_deg_per_step: largest error allowed of every effective ratio.
        limit_mm: largest 3D error allowed at that range, pan and tilt in the middle of the counters seen.
    """
    try:
        classic_result = classic(campaign)
    except NothingToEstimate:
        classic_result = None
    simple = {"nominal": simple_calibration(campaign.rig.priors)}
    if classic_result is not None:
        simple["classic"] = simple_calibration(campaign.rig.priors, classic_result)
    (pan_low, pan_high), (tilt_low, tilt_high) = calibration.range_steps
    middle = 0.5 * (pan_low + pan_high), 0.5 * (tilt_low + tilt_high)
    ranges = sorted({*MAP_RANGES_MM, range_mm})
    pan, tilt = np.linspace(pan_low, pan_high, MAP_CELLS), np.linspace(tilt_low, tilt_high, MAP_CELLS)
    maps = error_map(calibration, pan, tilt, ranges, simple=simple, draws=MAP_DRAWS)
    # The middle cell of an odd number is the middle of the counters.
    cell = MAP_CELLS // 2, MAP_CELLS // 2, ranges.index(range_mm)
    found = {name: distance[:, *cell] for name, distance in maps.distance_mm.items()}
    criteria = []
    # Limits are judged with the uncertainty that a failed validation leaves (`information.Validation`).
    inflation = float((fit.get("validation") or {}).get("inflation", 1.0))
    if limit_deg_per_step is not None:
        draws = stored_ratios(campaign)
        for k, direction in enumerate(DIRECTIONS):
            estimate = fit["effective_deg_per_step"].get(direction)
            if estimate is not None:
                errors = inflation * (draws[:, k] - estimate["value"])
                criteria.append(criterion(f"ratio {direction}", errors, limit_deg_per_step, "deg/step"))
    if limit_mm is not None:
        criteria.append(criterion(f"3D point at {range_mm:g} mm", inflation * found["joint"], limit_mm, "mm"))
    ray = calibration.ray(*middle, ("left", "up"))
    point = np.asarray(ray.origin_mm) + range_mm * np.asarray(ray.direction)
    reading = calibration.reading(point)
    found_budget = budget(calibration, *middle, reading)
    least = "xyz"[int(np.argmax(np.diag(found_budget.covariance_mm2)))]
    return Evidence(
        campaign=campaign,
        fit=fit,
        classic=classic_result,
        held_out=_stored_hold_out(campaign, fit),
        planned=_stored_plan(campaign, fit),
        criteria=criteria,
        distances_mm=found,
        range_mm=range_mm,
        maps=maps,
        budget=found_budget,
        point=coordinate_budget(found_budget, calibration, point, least),
    )
