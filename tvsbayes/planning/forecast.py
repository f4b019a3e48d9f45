"""Drawn rigs: the chance that the joint fit of a design meets the target, and what the classic estimator would do.

An instrument is drawn from `[truth]` of the rig file, or from the posterior of a campaign. Values in the target's unit,
the classic's in deg/step.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from tvsbayes.errors import InputError, TvsError
from tvsbayes.estimators.four_point import classic, ratio_slopes, select_experiments
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.campaign import Campaign
from tvsbayes.instrument.parameters import INDEX, NAMES, RIG_NAMES
from tvsbayes.instrument.protocols import four_point_protocol
from tvsbayes.model.compiled import placed
from tvsbayes.model.headlines import physical_at
from tvsbayes.model.parameter_space import STOP_COLUMNS, ParameterSpace, coordinates_of
from tvsbayes.planning.candidates import (
    Arranged,
    Candidates,
    LookArrays,
    Looks,
    Seen,
    arrange,
    covariance_of,
    draws_of,
    information_of_looks,
)
from tvsbayes.planning.expectation import LOOKS_PER_EXPERIMENT, NOISE_COLUMNS, PARAMETERS, Knowledge
from tvsbayes.planning.target import Sensitivity, Target, sensitivity
from tvsbayes.statistics.intervals import NORMAL_95, coverage_factor
from tvsbayes.twin.physics import effective_deg_per_step
from tvsbayes.twin.simulated_campaign import Truth, draw_truth, simulate, with_derived


@dataclass(frozen=True)
class DrawnTruth:
    """A point of parameter space that may be true, and the space in which it has coordinates."""

    z: np.ndarray
    space: ParameterSpace


def truth_in(knowledge: Knowledge, parameters: Mapping[str, float], stereo_vector: np.ndarray) -> DrawnTruth:
    """Coordinates of a rig under the ANALYSIS priors; what these hold fixed is held at its true value.

    Args:
        knowledge: gives the analysis priors.
        parameters: physical values by contract name.
        stereo_vector: true cameras, shape (24,).
    """
    space = knowledge.space
    true = np.array([parameters[name] for name in RIG_NAMES])
    z = coordinates_of(space, np.concatenate([true, stereo_vector]))
    # A half-normal with u = 0 is 0 whatever its value; nothing else can be stated for it.
    held = np.where(np.asarray(space.u) > 0, np.asarray(space.value), true)
    return DrawnTruth(z, replace(space, value=placed(held)))


def draw_truths(knowledge: Knowledge, count: int, seed: int) -> list[DrawnTruth]:
    """Instruments that may stand there: from `[truth]` of the rig file (the design prior), or from the posterior."""
    generator = np.random.default_rng([seed, 31])
    if knowledge.after_data:
        return [DrawnTruth(z, knowledge.space) for z in draws_of(knowledge, count, generator)]
    drawn = (draw_truth(knowledge.rig, generator) for _ in range(count))
    return [truth_in(knowledge, t.parameters, t.stereo.vector) for t in drawn]


PIXEL_COLUMN = INDEX["pixel_scale"]


def believed(
    truth: DrawnTruth, seen: Seen, side: np.ndarray, covariance: np.ndarray, knowledge: Knowledge, noise: np.ndarray
) -> np.ndarray:
    """Coordinates at which a fit will judge its own uncertainty: the true ones, noise scales as it will estimate them.

    A standard deviation is known from n stops to 1 / sqrt(2 n): the log of each scale has the expected information
    2 sum (s^2 m / (1 + s^2 m))^2 over the stops of its direction, m what the pixels know of one stop, less what the
    geometry takes from them; its estimate lies between prior and truth by the weights of both, and scatters.

    Args:
        truth: the instrument.
        seen: the looks taken.
        side: their sides, shape (m, 2).
        covariance: of the coordinates after the looks, shape (p, p).
        knowledge: before the looks.
        noise: five standard normal numbers: stops by direction (right, left, down, up), pixels.

    Returns:
        Shape (p,).
    """
    z, u = truth.z.copy(), np.asarray(truth.space.u)
    physical = physical_at(z, truth.space).value
    looks = max(int(seen.seen.sum()), 1)
    rig_columns = ~NOISE_COLUMNS & (np.arange(PARAMETERS) < len(RIG_NAMES))
    determined = np.sum(1 - np.diag(covariance)[rig_columns] * np.diag(knowledge.precision)[rig_columns])
    left_over = max(0.0, 1 - determined / (2 * looks))

    def estimated(column: int, information: float, normal: float) -> None:
        information *= u[column] ** 2 * left_over
        before = knowledge.precision[column, column]
        mean = before * knowledge.z[column] + information * z[column] + math.sqrt(information) * normal
        z[column] = mean / (before + information)

    for axis in range(2):
        known = np.sum(seen.slope[..., axis] ** 2, axis=1) * seen.seen
        for which, sign in enumerate((-1, 1)):
            column = STOP_COLUMNS[axis, which]
            share = known * math.radians(physical[column]) ** 2
            share = (share / (1 + share))[side[:, axis] == sign]
            estimated(column, 2 * float(np.sum(share**2)), noise[2 * axis + which])
    estimated(PIXEL_COLUMN, 2.0 * looks, noise[4])
    return z


@dataclass(frozen=True)
class Family:
    """Designs that grow by one look at a time: the first 4 n of `picks` are n experiments."""

    knowledge: Knowledge
    found: Candidates
    picks: np.ndarray
    aperture: bool

    def looks(self, experiments: int) -> Looks:
        """Looks of n experiments."""
        return self.found.looks[self.picks[: LOOKS_PER_EXPERIMENT * experiments]]

    def arranged(self, experiments: int) -> Arranged:
        """Their plan."""
        return arrange(self.looks(experiments), self.knowledge.sheets, self.found.overshoot)

    @property
    def largest(self) -> int:
        """Experiments of the largest design."""
        return len(self.picks) // LOOKS_PER_EXPERIMENT


class Assurance:
    """What fits of the designs of a family will report, over drawn truths; one evaluation of the looks per truth."""

    def __init__(self, family: Family, target: Target, draws: int, seed: int):
        self.family, self.target, self.seed = family, target, seed
        self.truths = draw_truths(family.knowledge, draws, seed)
        self.noise = np.random.default_rng([seed, 37]).standard_normal((draws, 5))
        self.distinct, self.index = np.unique(family.picks, return_inverse=True)
        self.looks = family.found.looks[self.distinct]
        self.arrays = LookArrays(self.looks, family.knowledge, family.aperture)
        self._values: dict[int, np.ndarray] = {}

    def of(self, family: Family) -> Assurance:
        """The same instruments before other designs."""
        return Assurance(family, self.target, len(self.truths), self.seed)

    def values(self, sizes: Sequence[int]) -> dict[int, np.ndarray]:
        """Reported uncertainty of the target at each truth, shape (draws,), by number of experiments."""
        wanted = [n for n in sizes if n not in self._values]
        knowledge, designs = self.family.knowledge, {n: self.family.arranged(n) for n in wanted}
        found = {n: np.full(len(self.truths), np.inf) for n in wanted}
        for row, (truth, noise) in enumerate(zip(self.truths, self.noise, strict=True)):
            if not wanted:
                break
            seen = self.arrays.at(truth.z, truth.space)
            if not seen.seen.any():
                continue
            pose = seen.mirror_angles_rad[self.index].mean(axis=0)
            try:
                at_truth = sensitivity(self.target, truth.z, truth.space, knowledge.rig.table, pose)
            except InputError:
                continue
            for n in wanted:
                found[n][row] = self._reported(truth, noise, seen, at_truth, n, designs[n])
        self._values |= found
        return {n: self._values[n] for n in sizes}

    def met_share(self, experiments: int) -> float:
        """Share of the truths whose fit of n experiments reports the target as met."""
        return float(np.mean(self.values([experiments])[experiments] <= self.target.limit))

    def _reported(
        self, truth: DrawnTruth, noise: np.ndarray, seen: Seen, at_truth: Sensitivity, n: int, design: Arranged
    ) -> float:
        knowledge, chosen = self.family.knowledge, self.index[: LOOKS_PER_EXPERIMENT * n]

        def covariance(scene: Seen) -> np.ndarray:
            information = information_of_looks(scene, chosen, design.path, truth.space, knowledge.after_data)
            return covariance_of(knowledge.precision + information)

        z = believed(truth, seen[chosen], self.looks.side[chosen], covariance(seen), knowledge, noise)
        return at_truth.value(covariance(self.rescaled(seen, truth, z)), self.target.factor)

    def rescaled(self, seen: Seen, truth: DrawnTruth, z: np.ndarray) -> Seen:
        """The same looks whitened with other noise scales: I s^2 + slope S slope^T per look."""
        names = [*STOP_COLUMNS.ravel(), PIXEL_COLUMN]
        u, true = np.asarray(truth.space.u)[names], np.asarray(truth.space.value)[names]
        before, after = (true * np.exp(u * point[names]) for point in (truth.z, z))
        pixel = after[4] / before[4]
        variance = [
            np.radians(scale[:4].reshape(2, 2)[[0, 1], (self.looks.side > 0).astype(int)]) ** 2
            for scale in (before, after)
        ]
        # Both roots are taken in the three dimensions that the residual has; rows are turned, not only scaled.
        old, new = (
            p**2 * np.eye(4) + np.einsum("mia,ma,mja->mij", seen.slope, v, seen.slope)
            for p, v in zip((1.0, pixel), variance, strict=True)
        )
        raw = np.linalg.cholesky(old) @ seen.rows
        return replace(seen, rows=np.linalg.solve(np.linalg.cholesky(new), raw))


@dataclass(frozen=True)
class ClassicForecast:
    """What the four-point estimator will do, arrays over draws of the instrument and `DIRECTIONS`, deg/step.

    Attributes:
        sd: standard deviation of one experiment, shape (draws, 4).
        error: its systematic error, estimate less effective ratio, shape (draws, 4).
        stereo_u: uncertainty by stereo and focal scale at the first of them, common to all experiments, shape (4,).
    """

    sd: np.ndarray
    error: np.ndarray
    stereo_u: np.ndarray


CLASSIC_DRAWS = 100


def classic_forecast(knowledge: Knowledge, truths: Sequence[DrawnTruth]) -> ClassicForecast | None:
    """Run the paper's experiments on drawn instruments without noise; None where the rig has no two sheets.

    Pixels by the twin; noise by first-order propagation of pixel noise and of the two stops of an experiment.
    """
    rig = knowledge.rig
    if len(rig.sheets_mm) < 2:
        return None
    near, far = knowledge.sheets[0], knowledge.sheets[1]
    plan = four_point_protocol(2, targets=(near, far))
    sds, errors = [], []
    first = None
    for truth in truths[:CLASSIC_DRAWS]:
        physical = np.asarray(physical_at(truth.z, truth.space).value)
        parameters = dict(zip(NAMES, map(float, physical), strict=True))
        quiet = dict.fromkeys([f"stop_sd_deg.{d}" for d in DIRECTIONS] + ["pixel_scale"], 0.0)
        stereo = rig.stereo.with_vector(physical[len(RIG_NAMES) :])
        run = simulate(rig, plan, 0, Truth(with_derived({**parameters, **quiet}), stereo))
        selection = select_experiments(run.campaign)
        # The second of each direction: its start is reached as all later ones are.
        later = np.flatnonzero(selection.experiments % 2 == 1)
        pose = run.truth.reference_pose_deg
        if len(later) < len(DIRECTIONS) or pose is None:
            continue
        steps = selection.steps[later]
        found = ratio_slopes(selection.pixels[later], steps, selection.axis[later], rig.stereo)
        effective = effective_deg_per_step(with_derived(parameters), pose)
        true = np.array([effective[d] for d in DIRECTIONS])
        stops = np.array([parameters[f"stop_sd_deg.{d}"] ** 2 for d in DIRECTIONS])
        pair = stops + stops[[1, 0, 3, 2]]
        spot_sd = rig.spot_sd_px * parameters["pixel_scale"]
        variance = np.sum(found.by_pixel**2, axis=(1, 2)) * spot_sd**2 + pair * (found.ratio / true / steps) ** 2
        sds.append(np.sqrt(variance))
        errors.append(found.ratio - true)
        first = run.campaign if first is None else first
    if first is None:
        return None
    # Every direction has its experiments, else the draw was left out.
    stereo_u = np.array([r.u_stereo_deg_per_step for r in classic(first).directions.values() if r is not None])
    return ClassicForecast(np.array(sds), np.array(errors), stereo_u)


def classic_count(sd: float, half_width: float) -> int:
    """Experiments of one direction for a 95 % half width: n = (t s / E)^2, t with n - 1 degrees of freedom."""
    n = 2
    for _ in range(200):
        wanted = max(2, math.ceil((coverage_factor(n - 1) * sd / half_width) ** 2))
        if wanted <= n:
            # t falls with n: from above the first n that suffices is the answer.
            while n > 2 and (coverage_factor(n - 2) * sd / half_width) ** 2 <= n - 1:
                n -= 1
            return n
        n = min(wanted, 2 * n)
    return n


@dataclass(frozen=True)
class ClassicAnswer:
    """The four-point method's own number of experiments: n = (t s / E)^2 in every direction.

    Attributes:
        direction: the one that needs most, or the one asked for.
        sd, sd_interval95: s, deg/step: median and 95 % range, over instruments or (with data) by chi-square.
        half_width: E, deg/step.
        experiments, experiments_interval95: n of one direction, for s and for its interval.
        stereo_u: what is common to all experiments, deg/step; no n lowers it.
        systematic, systematic_interval95: its error for the median instrument and in 95 % of them, deg/step.
        from_data: s was measured.
    """

    direction: str
    sd: float
    sd_interval95: tuple[float, float]
    half_width: float
    experiments: int
    experiments_interval95: tuple[int, int]
    stereo_u: float
    systematic: float
    systematic_interval95: tuple[float, float]
    from_data: bool


def classic_answer(target: Target, forecast: ClassicForecast | None, campaign: Campaign | None) -> ClassicAnswer | None:
    """N = (t s / E)^2 with the uncertainty of s: over instruments, or by chi-square where s was measured."""
    if forecast is None or not target.of_ratios:
        return None
    half_width = target.limit * NORMAL_95 / target.factor
    measured = None if campaign is None else _measured(campaign)
    answers = []
    for index in target.indices:
        direction = DIRECTIONS[index]
        low, sd, high = np.quantile(forecast.sd[:, index], [0.025, 0.5, 0.975])
        if measured is not None and measured.get(direction) is not None:
            sd, n = measured[direction]
            low, high = (sd * math.sqrt((n - 1) / special.chdtri(n - 1, p)) for p in (0.025, 0.975))
        error = np.quantile(forecast.error[:, index], [0.5, 0.025, 0.975])
        counts = [classic_count(float(s), half_width) for s in (low, sd, high)]
        answers.append(
            ClassicAnswer(
                direction=direction,
                sd=float(sd),
                sd_interval95=(float(low), float(high)),
                half_width=half_width,
                experiments=counts[1],
                experiments_interval95=(counts[0], counts[2]),
                stereo_u=float(forecast.stereo_u[index]),
                systematic=float(error[0]),
                systematic_interval95=(float(error[1]), float(error[2])),
                from_data=measured is not None and measured.get(direction) is not None,
            )
        )
    return max(answers, key=lambda a: a.experiments)


def _measured(campaign: Campaign) -> dict[str, tuple[float, int]] | None:
    """S and n of each direction of a campaign with complete experiments."""
    try:
        found = classic(campaign).directions
    except TvsError:
        return None
    return {d: (r.sd_deg_per_step, r.n) for d, r in found.items() if r is not None and r.sd_deg_per_step is not None}


def value_of_classic(forecast: ClassicForecast | None, target: Target, experiments: int) -> float | None:
    """Median over instruments of what the classic estimator should report: type A and stereo, as GUM adds them."""
    each = experiments / len(DIRECTIONS)
    if forecast is None or each < 2 or not target.of_ratios:
        return None
    rows = list(target.indices)
    u = np.sqrt(forecast.sd[:, rows] ** 2 / each + forecast.stereo_u[rows] ** 2)
    return float(target.factor * np.median(u.max(axis=1)))
