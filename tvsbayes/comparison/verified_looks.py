"""Verification of a scanner's or head's pointing by looks at counters that `steps-for` or the header computed.

Every look gives both mirror angles, observed less aimed, with the covariance of `watched_looks`; the aim is of the
calibration's state, the prediction of the look's own. `compensation.verification` judges them as readings of two axes.
"Not applied" means counters by the nominal degrees per step without play; the correction is the difference. Mirror
angles in degrees, points in mm.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np

from tvsbayes.calibration.aiming import Direction, mirror_angles
from tvsbayes.calibration.calibration_file import calibration_of_arrays
from tvsbayes.calibration.optics import beam_components, output_deg
from tvsbayes.calibration.pointing import Calibration
from tvsbayes.calibration.predicted_angles import PredictedAngles
from tvsbayes.calibration.states import homings_of, states_at
from tvsbayes.comparison.departures import LOOKS_MIN
from tvsbayes.comparison.watched_looks import WatchedLooks, usable_looks
from tvsbayes.compensation.promise import refuse_answer
from tvsbayes.compensation.verification import (
    IDENTIFIED,
    PLANNED_MAX,
    SEPARATE,
    Trial,
    VerifyStop,
    other_axis,
    planned_stops,
    size_of,
    verification_of,
)
from tvsbayes.errors import InputError, NothingToEstimate, Reason
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.estimators.noise_scales import noise_draws
from tvsbayes.inference.stored_posterior import answer_of
from tvsbayes.instrument.axes import AXES, FULL_TURN_DEG, SIDES
from tvsbayes.instrument.campaign import Campaign, input_hashes, ordered_spots
from tvsbayes.instrument.homing import scatter_of_prior
from tvsbayes.instrument.mechanisms import mechanism_of
from tvsbayes.instrument.plan import PlanBuilder, PlanStep
from tvsbayes.instrument.stops import counters_made, rests_of
from tvsbayes.model.parameter_space import physical_at
from tvsbayes.results.compensation_record import Millimetres, Verification
from tvsbayes.results.fit_record import FIT_FORMATS
from tvsbayes.results.store import FitFiles, stored_fit
from tvsbayes.statistics.optimal_design import discriminating_visits
from tvsbayes.statistics.predicted_readings import PredictedReadings, frees_shift, less_means
from tvsbayes.statistics.streams import Stream, random_stream
from tvsbayes.statistics.weighted_draws import systematic

NOISE_DRAWS = 32
"""Draws of the noise scales, geometry and cameras integrated out."""
RUN_UP = 2
"""Run-up of a plan as a multiple of the overshoot that takes up the play."""
CANDIDATES = 9
"""Counters tried for each axis, from both sides."""
DISTANCE_MM = 1000.0
"""Default distance at which errors are stated in mm."""
PROMISED_DRAWS = 4000
"""Draws of errors for the bound that 95 % of points do not exceed."""


SURER = (
    "state how the axes came to the first row, if you know it; run `tvsbayes fit` again, without --no-sample or "
    "--quick, or with --perfect-gears where gear errors are below the scatter of looks"
)
"""Remedies that make a rough answer an accepted one."""


def accepted_calibration(campaign: Campaign, stored: FitFiles | Reason | None = None) -> Calibration:
    """Return the calibration in force: that of `results/`, for these data, by an accepted fit.

    Args:
        campaign: the campaign.
        stored: its stored fit, if it was read before.

    Raises:
        InputError: there is none for these data, or it is damaged.
        NotConverged: the fit is not accepted.
    """
    stored = stored_fit(campaign, input_hashes(campaign)) if stored is None else stored
    calibration = None if isinstance(stored, Reason) else calibration_of_arrays(stored.arrays)
    if isinstance(stored, Reason) or calibration is None:
        raise InputError(
            "missing-file",
            "results/ hold no calibration of these data: nothing can have been aimed with it",
            file="results/fit.json",
            remedy="run `tvsbayes fit`, aim by `tvsbayes steps-for` or the header, and look there",
        )
    stored.keys.word("format", *FIT_FORMATS)
    refuse_answer(answer_of(stored.keys), SURER)
    return calibration


@dataclass(frozen=True)
class AimedLooks:
    """Counters and sides of m aimed looks: `steps` and `sides`, each (m, 2), pan and tilt."""

    calibration: Calibration
    steps: np.ndarray
    sides: np.ndarray

    @classmethod
    def of(cls, calibration: Calibration, looks: Campaign, used: np.ndarray) -> AimedLooks:
        """Collect the usable looks of a campaign; `used` is a mask of its ordered spots."""
        rests = {
            axis: dict(zip((m.move for m in looks.moves), rests_of(looks.moves, axis), strict=True)) for axis in AXES
        }
        looked = [spot.move for spot, use in zip(ordered_spots(looks), used, strict=True) if use]
        steps = [[rests[axis][move].steps for axis in AXES] for move in looked]
        sides = [[rests[axis][move].sign for axis in AXES] for move in looked]
        return cls(calibration, np.array(steps, dtype=float), np.array(sides, dtype=float))

    def angles_deg(self, sides: np.ndarray) -> np.ndarray:
        """Compute mirror angles (m, 2) at the counters, reached from sides (m, 2)."""
        angles = []
        for k, axis in enumerate(AXES):
            values = self.calibration.estimates_at((self.steps[:, 0], self.steps[:, 1]))
            period = self.calibration.period_deg.get(axis)
            angles.append(output_deg(values, axis, self.steps[:, k], sides[:, k], period))
        return np.stack(angles, axis=1)

    def nominal_steps(self, nominal: dict[str, float]) -> np.ndarray:
        """Compute counters (m, 2) of the same directions by the nominal degrees per step (formulation 5)."""
        values, (pan, tilt) = self.calibration.estimates, self.angles_deg(self.sides).T
        x, y, z = beam_components(values, pan, tilt).direction
        azimuth, elevation = np.degrees([np.arctan2(y, x), np.arcsin(z)])
        if (mechanism := mechanism_of(values)).all_round:
            aims = [Direction(*map(float, row)) for row in zip(azimuth, elevation, strict=True)]
            angles = np.array([mirror_angles(nominal, aim) for aim in aims]) - [0.0, nominal[mechanism.tilt_zero]]
            # Add the whole turns that bring the angle nearest to the axis.
            angles[:, 0] += FULL_TURN_DEG * np.round((pan - angles[:, 0]) / FULL_TURN_DEG)
        else:
            angles = np.stack([azimuth + 90.0 - nominal["pan_zero_emission_deg"], elevation], axis=1)
        return angles / [nominal[f"degrees_per_step.{axis}"] for axis in AXES]

    @property
    def ratios(self) -> np.ndarray:
        """Return degrees per step (pan, tilt) of the gears."""
        return np.array([self.calibration.estimates[f"degrees_per_step.{axis}"] for axis in AXES])

    def off_deg(self, nominal: np.ndarray, common: float, play: float) -> np.ndarray:
        """Compute the deviation of mirror angles (m, 2) from the aim, if the correction acts by these factors.

        Args:
            nominal: counters without the correction, shape (m, 2).
            common: factor on the part common to both sides of an axis.
            play: factor on their difference.
        """
        # The angle difference of both sides at one counter, converted to counters for one angle.
        half = (self.angles_deg(-self.sides) - self.angles_deg(self.sides)) / (2 * self.ratios)
        middle = self.steps - half
        sent = np.round(nominal + common * (middle - nominal) + play * half)
        return self.ratios * (sent - self.steps)

    def slopes_mm(self, distance_mm: float) -> np.ndarray:
        """Compute derivatives of points at a distance along the beams by the mirror angles, mm/deg, shape (m, 3, 2)."""
        values, angles, step = self.calibration.estimates, self.angles_deg(self.sides), 1e-4
        columns = []
        for off in step * np.eye(2):
            ends = [beam_components(values, *(angles + sign * off).T).at(distance_mm) for sign in (1, -1)]
            columns.append((ends[0] - ends[1]).T / (2 * step))
        return np.stack(columns, axis=2)


@dataclass(frozen=True)
class SeenAngles:
    """Estimates of both mirror angles, pan and tilt of each look in turn.

    Attributes:
        value: observed less predicted, deg, shape (2 m,).
        covariance: covariance of prediction and observation, by draws of the noise scales, deg^2, shape (n, 2 m, 2 m).
        noise: its part that is independent at every visit, deg^2, shape (2 m,).
    """

    value: np.ndarray
    covariance: np.ndarray
    noise: np.ndarray

    @classmethod
    def of(cls, fit: JointFit, watched: WatchedLooks, sides: np.ndarray, seed: int) -> SeenAngles:
        """Estimate the looks' angles by generalised least squares; `sides` (m, 2) are those of their arrivals."""
        noise = noise_draws(fit, NOISE_DRAWS, seed)
        centre = watched.departure(noise.centre, angles=True)
        covariance = np.linalg.inv(centre.information)
        places = systematic(noise.weights, len(noise.z), 0.5)
        each = {k: np.linalg.inv(watched.departure(noise.z[k], angles=True).information) for k in set(places.tolist())}
        spots = watched.linear(noise.centre, angles=True)
        values = physical_at(noise.centre, watched.problem.space).value
        index = watched.problem.space.mechanism.index
        visit = []
        for k, place in enumerate(watched.usable):
            slopes = spots.jacobian[place, :, -2 * watched.looks :][:, 2 * k : 2 * k + 2]
            stops = []
            for axis, side in zip(AXES, sides[k], strict=True):
                ends = [float(values[index[f"stop_sd_deg.{name}"]]) ** 2 for name in SIDES[axis]]
                stops.append(ends[1] if side > 0 else ends[0] if side < 0 else 0.5 * sum(ends))
            visit.append(np.diag(np.linalg.inv(slopes.T @ slopes)) + stops)
        return cls(covariance @ centre.score, np.array([each[k] for k in places.tolist()]), np.ravel(visit))


def _other(aimed: AimedLooks) -> np.ndarray:
    """Compute the additional covariance (2 m, 2 m) if it is another scanner: two other axes."""
    count = len(aimed.steps)
    covariance = np.zeros((2 * count, 2 * count))
    for k in range(2):
        covariance[k::2, k::2] = other_axis(aimed.ratios[k] * aimed.steps[:, k], aimed.sides[:, k])
    return covariance


def _millimetres(aimed: AimedLooks, trial: Trial, distance_mm: float, seed: int) -> Millimetres:
    """Compute errors of points at a distance, and the promised bound of 95 % of them, from those of mirror angles."""
    slopes, kept = aimed.slopes_mm(distance_mm), less_means(trial.free)

    def lengths(angles: np.ndarray) -> np.ndarray:
        return np.linalg.norm(np.einsum("mxa,...ma->...mx", slopes, angles.reshape(*angles.shape[:-1], -1, 2)), axis=-1)

    promised = trial.at(1.0, 1.0).less(trial.free)
    drawn = lengths(promised.drawn(PROMISED_DRAWS, random_stream(seed, Stream.PROMISED_LENGTHS)))
    return Millimetres(
        distance_mm=distance_mm,
        before=size_of(lengths(kept @ trial.at(0.0, 0.0).pooled().mean)),
        after=size_of(lengths(kept @ trial.value)),
        promised95=float(np.quantile(drawn, 0.95)),
    )


def shifts_deg(watched: WatchedLooks, calibration: Calibration) -> np.ndarray:
    """Compute what the states of looks add to their angles, expected, off the calibration's state: (2 m,)."""
    looks = [watched.problem.spots[k] for k in watched.usable]
    shifts = np.zeros((len(looks), len(AXES)))
    if calibration.states:
        for k, (axis, states) in enumerate(states_at(watched.joined, looks).items()):
            machine = PredictedAngles(calibration, watched.fit.campaign, axis, 0.0)
            shifts[:, k] += sum(each.pooled().mean for each in machine.shifts(states, machine.state).values())
    return shifts.ravel()


def verify_looks(
    fit: JointFit, calibration: Calibration, looks: Campaign, *, distance_mm: float = DISTANCE_MM, seed: int = 0
) -> Verification:
    """Verify a scanner that was aimed with its calibration by fresh looks.

    Args:
        fit: fit of the calibration.
        calibration: calibration in force.
        looks: a campaign with all its moves, whose counters `steps-for` or the header computed.
        distance_mm: distance along the beams at which errors are stated in mm.
        seed: seed of all draws.

    Raises:
        NothingToEstimate: fewer than `LOOKS_MIN` usable looks.
    """
    remedy = "aim at more points; `tvsbayes plan CAMPAIGN --verify` names them"
    used = usable_looks(looks, "fresh looks can be used; verify takes at least", remedy)
    aimed = AimedLooks.of(calibration, looks, used)
    nominal = aimed.nominal_steps(fit.campaign.rig.values)
    watched = WatchedLooks(fit, looks)
    angles, shifts = SeenAngles.of(fit, watched, aimed.sides, seed), shifts_deg(watched, calibration)
    error = angles.value + shifts

    @cache
    def at(common: float, play: float) -> PredictedReadings:
        off = shifts + aimed.off_deg(nominal, common, play).ravel()
        return PredictedReadings(np.tile(off, (len(angles.covariance), 1)), angles.covariance)

    aim = np.zeros(len(error))
    travel = float(np.max(np.ptp(aimed.ratios * aimed.steps, axis=0)))
    # Axes whose scatter of homings was not read: one shift common to all of each does not count.
    homings = homings_of(fit.campaign)
    free = [frees_shift(homings[axis]) for axis in AXES]
    trial = Trial(at, error, aim, _other(aimed), travel, np.tile(np.diag(free), len(aimed.steps)), angles.noise)
    return verification_of(
        trial,
        len(aimed.steps),
        homing=any(free),
        seed=seed,
        together=2,
        # Directions have no lengths.
        millimetres=_millimetres(aimed, trial, distance_mm, seed) if looks.has_images else None,
        unit="deg",
        looks=True,
        remarks=_remarks(fit, looks, aimed),
    )


class AimedStop(NamedTuple):
    """A look to make: its counters, and the sides (1 or -1) from which they are reached."""

    pan: int
    tilt: int
    pan_side: int
    tilt_side: int


@dataclass(frozen=True)
class AimPlan:
    """Looks to make with the calibration in force, in this order.

    Attributes:
        stops: the looks.
        run_up: run-up of pan and tilt before a counter, steps.
        enough: whether they discriminate the hypotheses in 95 of 100 cases, by the more informative axis.
        distance: distance of the nearest two hypotheses, standard deviations.
    """

    stops: tuple[AimedStop, ...]
    run_up: tuple[int, int]
    enough: bool
    distance: float

    def steps(self, target: str) -> tuple[PlanStep, ...]:
        """Return the plan, for looks at one target."""
        plan = PlanBuilder()
        plan.home()
        plan.place(target)
        for pan, tilt, pan_side, tilt_side in self.stops:
            plan.move(pan=pan - pan_side * self.run_up[0], tilt=tilt - tilt_side * self.run_up[1])
            plan.move(pan=pan, tilt=tilt)
            plan.look()
        return tuple(plan.steps)


def plan_looks(campaign: Campaign, calibration: Calibration) -> AimPlan:
    """Plan the fewest looks that verify a calibration: greedy choice of stops for each axis, visited together.

    Raises:
        NothingToEstimate: the nominal counters are those of the calibration, or no axis ever moved: there is nothing to
            verify.
    """
    # An axis that the campaign never moved stays where it is.
    moved = np.ptp(calibration.range_steps, axis=1) > 0
    run_up = tuple(
        RUN_UP * max(calibration.overshoot_steps[axis], 1) * int(m) for axis, m in zip(AXES, moved, strict=True)
    )
    if not moved.any():
        what = "no axis was seen at two counters: nothing can have been aimed by the calibration"
        raise NothingToEstimate("no-correction", what, remedy="look before and after moves, then fit again")
    still = [VerifyStop(float(steps), 1) for steps in calibration.range_steps[:, 0]]
    planned = [_axis_stops(campaign, calibration, k, run_up[k]) if moved[k] else ([still[k]], 0.0) for k in range(2)]
    count = max(LOOKS_MIN, *(len(stops) for stops, _ in planned))
    # The axis that needs fewer stops repeats them: every look measures both axes.
    pan, tilt = ([stops[i % len(stops)] for i in range(count)] for stops, _ in planned)
    stops = tuple(AimedStop(int(p.command), int(t.command), p.side, t.side) for p, t in zip(pan, tilt, strict=True))
    reached = max(distance for _, distance in planned)
    return AimPlan(stops, (run_up[0], run_up[1]), reached >= IDENTIFIED, float(np.sqrt(reached)))


def _axis_stops(campaign: Campaign, calibration: Calibration, k: int, run_up: int) -> tuple[list[VerifyStop], float]:
    """Choose the stops of one axis, the other in the middle of its range, and the squared distance by them."""
    low, high = calibration.range_steps[k]
    least, most = counters_made(campaign.moves)[AXES[k]]
    if high - low > 4 * run_up:
        low, high = max(low, least + run_up), min(high, most - run_up)
    counters = np.linspace(low, high, CANDIDATES).round()
    steps = np.tile(calibration.range_steps.mean(axis=1).round(), (2 * CANDIDATES, 1))
    steps[:, k] = np.repeat(counters, 2)
    sides = np.ones_like(steps)
    sides[1::2, k] = -1.0
    aimed = AimedLooks(calibration, steps, sides)
    nominal = aimed.nominal_steps(campaign.rig.values)
    off = [aimed.off_deg(nominal, *factors)[:, k] for factors in ((0.0, 0.0), (1.0, 0.0))]
    if not np.any(off[0]):
        what = f"the nominal counters of {AXES[k]} are those of the calibration: there is no correction to verify"
        raise NothingToEstimate("no-correction", what, remedy="verify that nothing moved with `tvsbayes watch`")
    noise = np.array([calibration.noise_variance[f"stop_sd_deg.{SIDES[AXES[k]][int(s > 0)]}"] for s in sides[:, k]])
    machine = PredictedAngles(calibration, campaign, AXES[k], steps[:, 1 - k])
    common = machine.expected(steps[:, k], sides[:, k]).pooled().covariance
    common += machine.scatter(sides[:, k], machine.state, 0.0)["homing"].mean(axis=0)
    # A play smaller than the uncertainty of a look cannot be distinguished from none, and does not affect the promise.
    visible = np.max(np.abs(off[1])) > np.sqrt(SEPARATE * np.max(np.diag(common) + noise))
    worlds = off if visible else off[:1]
    spread = np.isin(np.arange(CANDIDATES), [0, CANDIDATES // 2, CANDIDATES - 1])
    starts = steps[:, k] - sides[:, k] * run_up
    reach = np.flatnonzero((starts >= least) & (starts <= most))
    if not len(reach):
        message = f"{AXES[k]}: no look has room for a run-up of {run_up} steps within the counters {least} to {most}"
        raise NothingToEstimate("limits", message, remedy="drive further in a campaign, and fit it")
    first, off = np.repeat(spread, 2)[reach], [world[reach] for world in worlds]
    shared = common[np.ix_(reach, reach)]
    visits, reached = discriminating_visits(off, shared, noise[reach], first, IDENTIFIED, PLANNED_MAX)
    return list(planned_stops(steps[reach, k], sides[reach, k], visits)), reached


def _remarks(fit: JointFit, looks: Campaign, aimed: AimedLooks) -> tuple[str, ...]:
    """Return further remarks for the user."""
    campaign, remarks = fit.campaign, []
    if fit.home_sd_by_prior:
        remarks.append(scatter_of_prior(fit.home_sd_by_prior))
    outside = sum(not aimed.calibration.covers(*steps) for steps in aimed.steps.tolist())
    if outside:
        remarks.append(
            f"{outside} of {len(aimed.steps)} looks lie outside the counters of the campaign: "
            "the promise is weaker there"
        )
    if input_hashes(campaign)["stereo"] != input_hashes(looks)["stereo"]:
        remarks.append("the fresh looks state other cameras; those of the campaign are used")
    named = looks.header.get("serial") or looks.header.get("instrument")
    known = campaign.header.get("serial") or campaign.header.get("instrument")
    if named and known and named != known:
        remarks.append("the fresh looks name another machine than the campaign: is it the right one?")
    return tuple(remarks)
