"""The joint estimator: all parameters from all spots, with a Laplace covariance.

Newton steps on the full log density from the result of `mode_search`, the inverse Hessian at the mode, draws of the
approximation and diagnoses. All computations use the coordinates of `model.parameter_space` (prior N(0, 1) each);
results have the units of their names: deg, mm, px, rad.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property

import jax
import numpy as np
from jaxtyping import Bool
from scipy import special

from tvsbayes.display import Shown, View
from tvsbayes.errors import MISFIT_REMEDY, NotConverged, NothingToEstimate, require_kind
from tvsbayes.estimators.campaign_arrays import CampaignArrays, in_sight, place_arrays
from tvsbayes.estimators.homing_evidence import WORTH_A_FIT, most_fits, weighed
from tvsbayes.estimators.likelihood import prior_errors_at_places
from tvsbayes.estimators.linear_spots import Linearised, StopInformation, leave_one_out_chi2
from tvsbayes.estimators.mode_search import GATE_PROBABILITY, Problem, held_by, search_stages
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.campaign import Campaign, Move, ordered_spots
from tvsbayes.instrument.homing import Sides, homed, prior_chance, unrecorded
from tvsbayes.instrument.model_choice import AS_STATED, ModelChoice
from tvsbayes.instrument.parameters import HOME_SD_NAMES, TARGETS, ZERO_SHIFT_NAMES
from tvsbayes.instrument.places import line_share, seen_places
from tvsbayes.instrument.rig import RigTable
from tvsbayes.instrument.stops import legs_of
from tvsbayes.model.compiled import placed
from tvsbayes.model.headlines import Derived, SeenLine, derived_quantities
from tvsbayes.model.parameter_space import ParameterSpace
from tvsbayes.progress import Advance, Job, Show
from tvsbayes.results.stored_draws import StoredMode
from tvsbayes.statistics.intervals import NORMAL_95
from tvsbayes.statistics.least_squares import LAPLACE_DRAWS, Mode, laplace_draws

SMALLEST_CAMPAIGN = 8
"""Spots below which no fit is tried: two beams at two depths, seen before and after one move on each axis."""
MISFIT_LIMIT = 20.0
"""Factor on the stated pixel noise above which the mode does not explain the spots: a wrong basin, swapped cameras or
wrong counters, not noise."""


NEWTON, DIAGNOSING = "Newton steps to the mode", "diagnosing the fit"
LAST_SECONDS = {NEWTON: 0.8, DIAGNOSING: 0.3}
"""Seconds of the stages after the search, for the progress display."""
HOMING = "weighing homing hypotheses"
HOMING_SECONDS = 1.5
"""Seconds of the fit under one homing hypothesis."""


def fit_stages(robust: bool, moves: Sequence[Move], table: RigTable) -> dict[str, float]:
    """Return the stages of a fit with their seconds."""
    ways = most_fits(unrecorded(moves, table))
    return search_stages(robust) | LAST_SECONDS | ({HOMING: HOMING_SECONDS * ways} if ways else {})


@dataclass(frozen=True)
class Alternative:
    """A homing hypothesis.

    Attributes:
        sides: side of the homing by axis.
        probability: among all ways, by the evidence of their Laplace approximations.
        fit: the fit under it; None if less probable than `WORTH_A_FIT`.
    """

    sides: Mapping[str, str]
    probability: float
    fit: JointFit | None


@dataclass(frozen=True, repr=False)
class JointFit(Shown):
    """Mode and Laplace approximation of the posterior, the result of `fit`.

    Read it through `summary.summarise` (values, intervals, diagnostics in words), `sampling.sample` (draws of the
    posterior itself) or `fitted_calibration.calibration_of` (coordinates), which use these fields.

    Attributes:
        campaign: the fitted campaign.
        space: priors as arrays.
        arrays: the campaign as arrays, with the weights of the robust option.
        z: mode in prior coordinates, shape (p,).
        covariance: inverse negative Hessian there, shape (p, p); the identity where nothing is estimated.
        log_density: log posterior density at the mode, without `campaign_arrays.spot_constants`.
        linearised: the campaign linearised at the mode, without padding.
        information: leave-one-out quantities per stop.
        chi2: squared standardised innovations of the spots used.
        reference_pose_rad: mean mirror angles (pan, tilt) over the spots used.
        seen_line: counters of the spots, over which the headlines are slopes.
        free: parameters that are estimated, shape (p,).
        draws_z: Laplace draws, shape (draws, p), with mean and covariance exactly those of the approximation.
        draws_places: errors of the gears of these draws in units of `linearised.place_root`, shape (draws, e).
        draws: headlines and parameters of the draws.
        prior_draws: the same under the priors, at the same pose.
        mode: headlines and parameters at the mode (fields without leading axis).
        ends95: parameters at z - 1.96 sd and z + 1.96 sd, shape (2, p): interval ends under monotone maps.
        excluded_spots: ids of spots that the robust option or the caller left out.
        suspect_spots: ids of used spots whose misfit has a probability below `GATE_PROBABILITY`.
        converged: the mode was reached and is a maximum.
        problems: sentences on what failed; empty when converged.
        sides: sides of unrecorded homings by axis, as this fit assumes them.
        alternatives: homing hypotheses considered, this fit's first; empty where the sides were recorded.
    """

    campaign: Campaign
    space: ParameterSpace
    arrays: CampaignArrays
    z: np.ndarray
    covariance: np.ndarray
    log_density: float
    linearised: Linearised
    information: StopInformation
    chi2: float
    reference_pose_rad: np.ndarray
    seen_line: SeenLine
    free: np.ndarray
    draws_z: np.ndarray
    draws_places: np.ndarray
    draws: Derived
    prior_draws: Derived
    mode: Derived
    ends95: np.ndarray
    excluded_spots: tuple[int, ...]
    suspect_spots: tuple[int, ...]
    converged: bool
    problems: tuple[str, ...] = ()
    sides: Mapping[str, str] = field(default_factory=dict)
    alternatives: tuple[Alternative, ...] = ()

    def shown(self) -> View:
        """Show mode and Laplace sd of the headlines."""
        state = "converged" if self.converged else f"NOT CONVERGED: {'; '.join(self.problems)}"
        used = sum(spot.status == "ok" for spot in self.campaign.spots) - len(self.excluded_spots)
        moved = set(legs_of(self.campaign.moves))
        rows = [
            (f"{of.label}, {of.unit}", float(self.mode[of.name]), float(self.draws[of.name].std()))
            for of in TARGETS.values()
            if of.applies(moved)
        ]
        return View(
            f"JointFit of {used} {self.campaign.looks}, {state}; mode and Laplace sd", ("quantity", "mode", "sd"), rows
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Return the public names of the coordinates and of the columns of `draws.physical`."""
        return self.space.mechanism.names

    @cached_property
    def values(self) -> dict[str, float]:
        """Return the values of the parameters at the mode by name, and the constants of the instrument."""
        own = zip(self.names, np.asarray(self.mode.physical, dtype=float).tolist(), strict=True)
        return {**self.space.mechanism.constants, **dict(own)}

    @property
    def table(self) -> RigTable:
        """Return the rig of the campaign with the priors of the fit, which its options may have changed."""
        return table_used(self.campaign.rig, np.asarray(self.space.value), np.asarray(self.space.u))

    @property
    def held(self) -> np.ndarray:
        """Mark the parameters that the linearisation takes as known, shape (p,)."""
        return held_by(self.names, self.free)

    @property
    def home_sd_by_prior(self) -> tuple[str, ...]:
        """Return the axes whose scatter of homings is that of the prior, since the campaign has one segment."""
        columns = self.space.mechanism.columns("home_sd_deg")
        by_prior = ~self.free[columns] & (np.asarray(self.space.u)[columns] > 0)
        return tuple(axis for axis, kept in zip(AXES, by_prior, strict=True) if kept)

    @property
    def stored(self) -> StoredMode:
        """Return the record from which `restored` builds the fit."""
        count = len(self.linearised.residual)
        return StoredMode(
            self.names,
            self.z,
            self.covariance,
            self.log_density,
            np.stack([np.asarray(self.space.value), np.asarray(self.space.u)]),
            valid=np.asarray(self.arrays.spots.valid)[:count],
            weight=np.asarray(self.arrays.spots.weight)[:count],
            sides=tuple(self.sides.get(axis, "") for axis in AXES),
        )

    @property
    def laplace_evidence(self) -> float:
        """Compute the log evidence of this fit and its homing hypothesis, integrated over the estimated coordinates.

        By the Laplace approximation, without `campaign_arrays.spot_constants`.
        """
        mode = Mode(self.z, self.covariance, -self.log_density, ())
        return laplace_evidence(mode, self.free) + float(np.log(prior_chance(self.sides)))

    @property
    def log_evidence(self) -> float:
        """Compute the log evidence of all homing hypotheses together."""
        return self.laplace_evidence - float(np.log(self.mixture[0].probability))

    @property
    def mixture(self) -> tuple[Alternative, ...]:
        """Return the components of the posterior, this fit first: only itself, or the fitted homing hypotheses."""
        counted = tuple(way for way in self.alternatives if way.fit is not None)
        return counted or (Alternative(self.sides, 1.0, self),)

    @property
    def homing_side(self) -> dict[str, dict[str, float]]:
        """Return the probability of each side of unrecorded homings, by axis."""
        sides: dict[str, dict[str, float]] = {}
        for way in self.alternatives:
            for axis, side in way.sides.items():
                of_axis = sides.setdefault(axis, {})
                of_axis[side] = of_axis.get(side, 0.0) + way.probability
        return sides


def fit(
    campaign: Campaign,
    *,
    model: ModelChoice = AS_STATED,
    without: Collection[int] = (),
    seed: int = 0,
    progress: Show | None = None,
) -> JointFit:
    """Fit the joint model to every usable spot (formulation 4).

    The first call in a process compiles the model, half a minute; what the command prints is
    `assessment.summary.summarise(fit(campaign))`.

    Args:
        campaign: from `read_campaign`.
        model: simpler or richer gears than the rig states, robust against outliers or not.
        without: ids of spots that are held out but can be predicted.
        seed: seed of the Laplace draws.
        progress: called with the share that is done.

    Returns:
        Mode, Laplace approximation and diagnostics; check `converged` before using it.

    Raises:
        TypeError: an argument has the wrong type.
        InputError: if harmonics are wanted and no axis states their period.
        NothingToEstimate: if the campaign has fewer than `SMALLEST_CAMPAIGN` usable spots, or all is fixed.
        NotConverged: if the fit diverged; a fit that ended badly is returned with `converged` False.
    """
    require_kind(campaign, "stereo", "a campaign, as read_campaign(folder) returns it")
    table = model.table(campaign.rig)
    used = _usable(campaign, without)
    diverged = NotConverged(
        "diverged",
        "the fit left the region where the model is finite",
        remedy=MISFIT_REMEDY,
    )
    with (
        jax.enable_x64(True),
        ThreadPoolExecutor(1) as executor,
        Job(fit_stages(model.robust, campaign.moves, table), progress) as job,
    ):
        problem = Problem(campaign, table, used)
        if not problem.free.any():
            raise NothingToEstimate(
                "nothing-free",
                "every parameter is stated as exactly known (u = 0)" + ", the cameras included" * campaign.has_images,
                file="campaign.toml",
                remedy="state a u above 0 for the parameters to be estimated",
            )
        problem.compile_aside(executor)
        try:
            z = problem.searched(model.robust, job)
            if not np.isfinite(problem.negative_log_density(z[None])[0]):
                raise diverged
            job.begin(NEWTON)
            mode = problem.mode(z)
            job.begin(DIAGNOSING)
            result = fit_at(campaign, problem, mode, seed)
            axes = unrecorded(campaign.moves, table)
            if not axes or not result.converged:
                return result
            job.begin(HOMING)
            return _by_homing(result, problem, axes, seed, job.at)
        except np.linalg.LinAlgError as error:
            raise diverged from error


def _by_homing(first: JointFit, problem: Problem, axes: tuple[str, ...], seed: int, advance: Advance) -> JointFit:
    """Fit under each homing hypothesis; return the most probable fit with all alternatives.

    Args:
        first: fit under "anywhere" for every axis.
        problem: problem of that fit.
        axes: whose sides nobody recorded.
        seed: seed of the Laplace draws.
        advance: receives the progress.
    """
    start, weight = Mode(first.z, first.covariance, -first.log_density, ()), np.asarray(problem.arrays.spots.weight)
    modes: dict[tuple[tuple[str, str], ...], tuple[Problem, Mode]] = {}

    def mode_under(sides: Sides) -> tuple[Problem, Mode]:
        key = tuple(sorted(sides.items()))
        if key not in modes:
            under = Problem(homed(first.campaign, sides), problem.table, first.arrays.used, weight)
            modes[key] = under, under.mode_beside(start)
            advance(len(modes) / most_fits(axes))
        return modes[key]

    def evidence(sides: Sides) -> float:
        mode = mode_under(sides)[1]
        return laplace_evidence(mode, problem.free) + float(np.log(prior_chance(sides)))

    def fit_under(sides: Sides, prior_draws: Derived | None = None) -> JointFit:
        return replace(fit_at(first.campaign, *mode_under(sides), seed, prior_draws), sides=dict(sides))

    weighed_ways = weighed(axes, evidence)
    best = fit_under(weighed_ways[0].sides)
    others = (
        fit_under(way.sides, best.prior_draws) if way.probability > WORTH_A_FIT else None for way in weighed_ways[1:]
    )
    alternatives = tuple(
        Alternative(way.sides, way.probability, fitted)
        for way, fitted in zip(weighed_ways, (best, *others), strict=True)
    )
    return replace(best, alternatives=alternatives)


def laplace_evidence(mode: Mode, free: Bool[np.ndarray, " parameters"]) -> float:
    """Compute the log of the integral of a density over the estimated coordinates by its Laplace approximation.

    The coordinates have N(0, 1) priors, whose (2 pi)^(-p/2) cancels with that of the Gaussian integral.
    """
    rows = np.flatnonzero(free)
    return 0.5 * float(np.linalg.slogdet(mode.covariance[np.ix_(rows, rows)])[1]) - mode.negative_log_density


def _usable(campaign: Campaign, without: Collection[int]) -> Bool[np.ndarray, " spots"]:
    """Mark the ordered spots that the fit uses; one that the lens model cannot undistort has no line of sight."""
    used = np.array([spot.spot not in without for spot in ordered_spots(campaign)], dtype=bool) & in_sight(campaign)
    if used.sum() < SMALLEST_CAMPAIGN:
        file, looks = campaign.looks_table.file, campaign.looks
        raise NothingToEstimate(
            f"too-few-{looks}",
            f"{file}: {used.sum()} {looks} can be used; the joint fit needs at least {SMALLEST_CAMPAIGN}",
            file=file,
            remedy=campaign.look_again,
        )
    return used


def table_used(rig: RigTable, value: np.ndarray, u: np.ndarray) -> RigTable:
    """Return a rig with these values and u of its priors, in their order."""
    changed = zip(rig.priors.items(), value.tolist(), u.tolist(), strict=True)
    return replace(rig, priors={name: replace(prior, value=v, u=w) for (name, prior), v, w in changed})


def restored(campaign: Campaign, stored: StoredMode) -> JointFit | None:
    """Restore a converged fit from its stored mode, without fitting: its model, weights and Laplace draws.

    Args:
        campaign: the campaign that was fitted.
        stored: from `stored_draws.mode_of`.

    Returns:
        The fit, with the Laplace draws of `fit` at its default seed; None where another version of tvsbayes used other
        parameter names.
    """
    mechanism = campaign.rig.mechanism
    if (own := stored.of(mechanism.names, mechanism.rig_names)) is None:
        return None
    table = table_used(campaign.rig, *own.prior)
    with jax.enable_x64(True):
        sides: dict[str, str] = {axis: side for axis, side in zip(AXES, own.sides, strict=True) if side}
        problem = Problem(homed(campaign, sides), table, own.valid > 0, own.weight)
        mode = Mode(own.z, own.covariance, -own.log_density, ())
        return replace(fit_at(campaign, problem, mode, 0), sides=sides)


@dataclass(frozen=True)
class Gaussian:
    """A normal distribution of n numbers: mean (n,) and covariance (n, n)."""

    mean: np.ndarray
    covariance: np.ndarray


def with_places(z: np.ndarray, covariance: np.ndarray, information: StopInformation) -> Gaussian:
    """Extend the Laplace approximation of the coordinates by the errors at places, which are N(0, 1) a priori.

    At the noise scales of the mode the errors follow the coordinates linearly.

    Args:
        z: the mode of the coordinates, shape (p,).
        covariance: covariance of the coordinates, shape (p, p).
        information: leave-one-out quantities at the mode.
    """
    slope, own = information.place_slope, covariance
    follows = slope @ own
    lower = follows @ slope.T + information.place_covariance
    return Gaussian(np.append(z, information.place_mean), np.block([[own, follows.T], [follows, lower]]))


def _drawn(joint: Gaussian, problem: Problem, seed: int) -> np.ndarray:
    """Draw coordinates, then errors at places, shape (draws, p + e).

    Shifts of the zeros and scatters of homings that are not estimated keep their mean: the draws of the others then do
    not depend on them.
    """
    drawn = np.ones(len(joint.mean), dtype=bool)
    kept = np.isin(problem.table.mechanism.names, (*ZERO_SHIFT_NAMES, *HOME_SD_NAMES)) & ~problem.free
    drawn[: len(kept)] = ~kept
    both = np.tile(joint.mean, (LAPLACE_DRAWS, 1))
    both[:, drawn] = laplace_draws(joint.mean[drawn], joint.covariance[np.ix_(drawn, drawn)], seed)
    return both


def _seen_line(campaign: Campaign, problem: Problem, pose_rad: np.ndarray) -> SeenLine:
    """Build the line of the headlines from the used spots, at this mean pose (2,)."""
    seen = seen_places(campaign.moves, [spot.move for spot in problem.spots], campaign.rig)
    places = place_arrays(seen)
    share = np.pad(line_share(seen, problem.arrays.used), (0, len(places.steps) - len(seen.steps)))
    return SeenLine(pose_rad, places, placed(share))


def fit_at(campaign: Campaign, problem: Problem, mode: Mode, seed: int, prior_draws: Derived | None = None) -> JointFit:
    """Build the fit at a mode: residuals, information, Laplace draws and diagnoses.

    Args:
        campaign: campaign of `problem`.
        problem: model, priors and the weights of the spots.
        mode: converged, or with the problems that `JointFit.problems` then states.
        seed: seed of the Laplace draws.
        prior_draws: those of a fit of the same campaign and seed; by default they are drawn.
    """
    used = problem.arrays.used
    lin = problem.linearised(mode.z)
    information = problem.information(lin)
    chi2_spots = leave_one_out_chi2(information, np.asarray(problem.arrays.spots.weight)[: len(problem.spots)])
    suspect = used & (chi2_spots > special.chdtri(problem.dof, GATE_PROBABILITY))
    pose = np.asarray(lin.mirror_angles_rad[used].mean(axis=0))
    line, joint = _seen_line(campaign, problem, pose), with_places(mode.z, mode.covariance, information)
    draws_z, draws_places = np.split(_drawn(joint, problem, seed), [len(mode.z)], axis=1)
    gears = problem.arrays.gears

    def with_mode(z: np.ndarray, errors_rad: np.ndarray) -> Derived:
        """Compute derived quantities at the mode, then of draws."""
        centre_rad = gears.at_places(np.asarray(lin.place_root) @ information.place_mean)
        z, errors = np.concatenate([mode.z[None], z]), np.concatenate([centre_rad[None], errors_rad])
        return jax.tree.map(np.asarray, derived_quantities(z, errors, problem.space, line))

    at_mode_and_draws = with_mode(draws_z, gears.at_places(draws_places @ np.asarray(lin.place_root).T))
    if prior_draws is None:
        size = len(mode.z) + 2 * gears.filled
        prior = Gaussian(np.zeros(size), np.eye(size))
        prior_z, normal = np.split(_drawn(prior, problem, seed + 1), [len(mode.z)], axis=1)
        prior_rad = np.asarray(prior_errors_at_places(prior_z, normal, problem.space, problem.arrays))
        prior_draws = jax.tree.map(lambda x: x[1:], with_mode(prior_z, prior_rad))
    reach = NORMAL_95 * np.sqrt(np.diag(mode.covariance))
    ids = np.array([s.spot for s in problem.spots])
    problems = mode.problems
    chi2 = sum(float(np.asarray(lin.residual)[g.rows].ravel() @ g.residual) for g in information.groups)
    # Where the pixel scale is fixed, chi-square contains the misfit.
    looks = max(float(np.sum(used * problem.dof)), 1.0)
    misfit = float(at_mode_and_draws["pixel_scale"][0]) * max(1.0, np.sqrt(chi2 / looks))
    if misfit > MISFIT_LIMIT:
        problems += (f"the {campaign.looks} miss the fitted beams by {misfit:.0f} times their stated uncertainty",)
    return JointFit(
        campaign=campaign,
        space=problem.space,
        arrays=problem.arrays,
        z=mode.z,
        covariance=mode.covariance,
        log_density=-mode.negative_log_density,
        linearised=lin,
        information=information,
        chi2=chi2,
        reference_pose_rad=pose,
        seen_line=line,
        free=problem.free,
        draws_z=draws_z,
        draws_places=draws_places,
        draws=jax.tree.map(lambda x: x[1:], at_mode_and_draws),
        prior_draws=prior_draws,
        mode=jax.tree.map(lambda x: x[0], at_mode_and_draws),
        ends95=problem.space.values(np.stack([mode.z - reach, mode.z + reach])),
        excluded_spots=tuple(int(i) for i in ids[~used]),
        suspect_spots=tuple(int(i) for i in ids[suspect]),
        converged=not problems,
        problems=problems,
    )
