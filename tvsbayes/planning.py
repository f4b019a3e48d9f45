"""How many looks, which ones, and when to stop; what a plan cannot separate (DESIGN 6 and 8).

`plan` searches the cheapest plan that meets a target (`tvsbayes.design`) and says with which probability it will, over
draws of the instrument; `check_plan` says in words what a plan leaves together. Units are those of DESIGN 8, minutes
by the rig's `[costs]`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import combinations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy import special, stats

from tvsbayes.calibration import AXES, NORMAL_95, SIDES
from tvsbayes.campaign import (
    Campaign,
    Move,
    PlanStep,
    four_point_protocol,
    grid_protocol,
    mixed_protocol,
    paper_protocol,
)
from tvsbayes.classic import DIRECTIONS, classic, four_point_ratios, observed_stops, select_experiments, separation
from tvsbayes.design import (
    ASSURED,
    CONTRAST_COLUMNS,
    HOME_VARIANCE_RAD2,
    LOOKS_PER_EXPERIMENT,
    NOISE_COLUMNS,
    PARAMETERS,
    QUANTITIES,
    Arranged,
    Candidates,
    Expectation,
    Knowledge,
    LookArrays,
    Looks,
    PlanInformation,
    Search,
    Seen,
    Sensitivity,
    Target,
    arrange,
    candidates,
    covariance_of,
    draws_of,
    headlines,
    information_of,
    information_of_looks,
    knowledge_of,
    physical_at,
    plan_minutes,
    prior_knowledge,
    sensitivity,
)
from tvsbayes.files import InputError, NotConverged, TvsError
from tvsbayes.information import CONTRACTION_LIMIT, prior_groups
from tvsbayes.joint import JointFit
from tvsbayes.likelihood import (
    LinearSpots,
    stop_information,
)
from tvsbayes.model import (
    INDEX,
    NAMES,
    RIG_NAMES,
    ParameterSpace,
)
from tvsbayes.rigs import Rig, RigTable
from tvsbayes.simulation import (
    HOME_APPROACH,
    Truth,
    draw_truth,
    effective_deg_per_step,
    simulate,
    with_derived,
)


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
    value, u, kind = (np.asarray(x, dtype=float) for x in (space.value, space.u, space.kind))
    true = np.array([parameters[name] for name in RIG_NAMES])
    safe = np.where(u > 0, u, 1.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        # Inverse of u Phi^-1((1 + Phi(z)) / 2), by the tail that keeps its digits.
        half = -special.ndtri(np.minimum(2 * special.ndtr(-np.maximum(true, 0.0) / safe), 1 - 1e-16))
        log = np.log(np.where(true > 0, true, 1.0) / np.where(value > 0, value, 1.0)) / safe
    z = np.where(kind == 1, half, np.where(kind == 2, log, (true - value) / safe))
    z = np.where(u > 0, np.clip(z, -30.0, 30.0), 0.0)
    # A half-normal with u = 0 is 0 whatever its value; nothing else can be stated for it.
    held = np.where(u > 0, value, true)
    stereo = np.linalg.pinv(np.asarray(space.stereo_root)) @ (stereo_vector - np.asarray(space.stereo_mean))
    with jax.enable_x64(True):
        return DrawnTruth(np.concatenate([z, stereo]), eqx.tree_at(lambda s: s.value, space, jnp.asarray(held)))


def draw_truths(knowledge: Knowledge, count: int, seed: int) -> list[DrawnTruth]:
    """Instruments that may stand there: from `[truth]` of the rig file (the design prior), or from the posterior."""
    generator = np.random.default_rng([seed, 31])
    if knowledge.after_data:
        return [DrawnTruth(z, knowledge.space) for z in draws_of(knowledge, count, generator)]
    drawn = (draw_truth(knowledge.rig, generator) for _ in range(count))
    return [truth_in(knowledge, t.parameters, t.stereo.vector) for t in drawn]


STOP_COLUMNS = np.array([[INDEX[f"stop_sd_deg.{d}"] for d in pair] for pair in (("right", "left"), ("down", "up"))])
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

    def _reported(
        self, truth: DrawnTruth, noise: np.ndarray, seen: Seen, at_truth: Sensitivity, n: int, design: Arranged
    ) -> float:
        knowledge, chosen = self.family.knowledge, self.index[: LOOKS_PER_EXPERIMENT * n]

        def covariance(scene: Seen) -> np.ndarray:
            information = information_of_looks(scene, chosen, design.path, truth.space, knowledge.after_data)
            return covariance_of(knowledge.precision + information)

        taken = Seen(*(getattr(seen, name)[chosen] for name in ("rows", "slope", "seen", "mirror_angles_rad")))
        z = believed(truth, taken, self.looks.side[chosen], covariance(seen), knowledge, noise)
        return at_truth.value(covariance(self._rescaled(seen, truth, z)), self.target.factor)

    def _rescaled(self, seen: Seen, truth: DrawnTruth, z: np.ndarray) -> Seen:
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


PROBE_PX = 0.01
"""Step of the classic estimator's derivatives: far above rounding (1e-9 px), far below curvature (10 px)."""
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
        physical = physical_at(truth.z, truth.space).value
        parameters = dict(zip(NAMES, map(float, physical), strict=True))
        quiet = dict.fromkeys([f"stop_sd_deg.{d}" for d in DIRECTIONS] + ["pixel_scale"], 0.0)
        stereo = rig.stereo.with_vector(physical[len(RIG_NAMES) :])
        run = simulate(rig, plan, 0, Truth(with_derived({**parameters, **quiet}), stereo))
        selection = select_experiments(run.campaign)
        # The second of each direction: its start is reached as all later ones are.
        later = np.flatnonzero(selection.experiments % 2 == 1)
        if len(later) < len(DIRECTIONS):
            continue
        pixels, steps, axis = selection.pixels[later], selection.steps[later], selection.axis[later]
        moved = np.concatenate([pixels[None], pixels + PROBE_PX * np.eye(16).reshape(16, 1, 4, 4)])
        flat = four_point_ratios(moved.reshape(-1, 4, 4), np.tile(steps, 17), np.tile(axis, 17), rig.stereo)
        ratios = flat.reshape(17, 4)
        by_pixel = np.sum(((ratios[1:] - ratios[0]) / PROBE_PX) ** 2, axis=0)
        effective = effective_deg_per_step(with_derived(parameters), run.truth.reference_pose_deg)
        true = np.array([effective[d] for d in DIRECTIONS])
        stops = np.array([parameters[f"stop_sd_deg.{d}"] ** 2 for d in DIRECTIONS])
        pair = stops + stops[[1, 0, 3, 2]]
        spot_sd = rig.cameras["spot_sd_px"] * parameters["pixel_scale"]
        variance = by_pixel * spot_sd**2 + pair * (ratios[0] / true / steps) ** 2
        sds.append(np.sqrt(variance))
        errors.append(ratios[0] - true)
        first = run.campaign if first is None else first
    if first is None:
        return None
    found = classic(first).directions
    stereo_u = np.array([found[d].u_stereo_deg_per_step for d in DIRECTIONS])
    return ClassicForecast(np.array(sds), np.array(errors), stereo_u)


def classic_count(sd: float, half_width: float) -> int:
    """Experiments of one direction for a 95 % half width: n = (t s / E)^2, t with n - 1 degrees of freedom."""
    n = 2
    for _ in range(200):
        wanted = max(2, math.ceil((float(special.stdtrit(n - 1, 0.975)) * sd / half_width) ** 2))
        if wanted <= n:
            # t falls with n: from above the first n that suffices is the answer.
            while n > 2 and (float(special.stdtrit(n - 2, 0.975)) * sd / half_width) ** 2 <= n - 1:
                n -= 1
            return n
        n = min(wanted, 2 * n)
    return n


@dataclass(frozen=True)
class CurvePoint:
    """What up to n experiments give: medians over draws of the instrument, in the target's unit.

    `classic` is None where the four-point method does not estimate the quantity or n is too small for it.
    """

    experiments: int
    minutes: float
    classic: float | None
    joint: float
    assurance: float
    assurance_se: float


@dataclass(frozen=True)
class Baseline:
    """A known protocol, or the planned one, judged by the same yardstick at the most probable instrument."""

    name: str
    spots: int
    seen: int
    minutes: float
    joint: float


@dataclass(frozen=True)
class Batch:
    """A possible next experiment: four looks at one sheet and what they bring."""

    actions: tuple[PlanStep, ...]
    minutes: float
    gain: float
    gain_per_minute: float
    text: str


@dataclass(frozen=True)
class Limit:
    """What is left of the target's variance when looks no longer matter.

    Attributes:
        floor: value that no number of looks goes below, in the target's unit.
        cause: the largest share of the floor.
        shares: share of every cause of the floor's variance; they add up to 1.
        reachable: the target lies above the floor.
        needed: in words, the input uncertainty that would do, None where no input is in the way.
    """

    floor: float
    cause: str
    shares: dict[str, float]
    reachable: bool
    needed: str | None


@dataclass(frozen=True)
class Advice:
    """Whether to go on measuring, and the rule."""

    now: bool
    reason: str
    rule: str


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


@dataclass(frozen=True)
class PlanResult:
    """How many, which ones, and when to stop.

    Attributes:
        target: what is wanted.
        steps: the recommended plan; empty where there is nothing left to do.
        experiments, looks, minutes: its size.
        expected: the target's value after it at the most probable instrument; `now`: before it.
        assurance, assurance_se: probability that its fit reports the target as met, and Monte Carlo error; None where
            there is nothing left to do.
        curve: by number of experiments.
        n80, n95: experiments for which the assurance is 80 % and 95 %, None if none.
        limit: what no number of looks removes.
        shares: what the variance of the target consists of after the plan.
        baselines: other protocols beside it.
        next: possible next experiments, best first.
        stop: the stopping rule applied now.
        classic: the four-point method's own answer, None for quantities that it does not estimate.
        met: the target is met already, or the plan meets it with an assurance of 80 %.
        notes: what was left out and why.
        draws, seed, criterion: of the computation.
    """

    target: Target
    steps: tuple[PlanStep, ...]
    experiments: int
    looks: int
    minutes: float
    now: float
    expected: float
    assurance: float | None
    assurance_se: float | None
    curve: tuple[CurvePoint, ...]
    n80: int | None
    n95: int | None
    limit: Limit
    shares: dict[str, float]
    baselines: tuple[Baseline, ...]
    next: tuple[Batch, ...]
    stop: Advice
    classic: ClassicAnswer | None
    met: bool
    notes: tuple[str, ...]
    draws: int
    seed: int
    criterion: str

    def as_json(self) -> dict[str, object]:
        """The document of `plan --json` (DESIGN 8)."""

        def plain(value: object) -> object:
            if isinstance(value, float):
                return value if math.isfinite(value) else None
            if isinstance(value, PlanStep):
                return step_json(value)
            if isinstance(value, Target):
                return value.as_json()
            if isinstance(value, tuple | list):
                return [plain(v) for v in value]
            if isinstance(value, dict):
                return {k: plain(v) for k, v in value.items()}
            return plain(vars(value)) if hasattr(value, "__dataclass_fields__") else value

        document = {key: plain(value) for key, value in vars(self).items() if key not in ("steps", "limit", "shares")}
        document["limited_by"] = plain(self.limit)
        document["variance_shares"] = plain(self.shares)
        return document


LADDER = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96)
"""Experiments at which the curve is drawn; 96 is the paper's."""
MANY = 100.0
"""So many times the largest design stand for "no matter how many": a week of looks. Beyond that the spots would be
calibrating the cameras, and a model would be believed to a thousandth of a pixel."""
NEXT_LISTED = 5
STOP_SHARE_PER_MINUTE = 1e-3
"""Measuring is no longer worth while when the best next looks lower the target by less than this share a minute."""
KNOWN = 1e8
"""Precision of the contrasts during a search: their part in a design is a matter of its path, which comes later."""
PLAN_DRAWS = 200


def _rows_for_search(seen: Seen, knowledge: Knowledge) -> tuple[np.ndarray, np.ndarray]:
    """Rows and precision with the contrasts taken as known; home offsets are two more columns after data."""
    precision = knowledge.precision.copy()
    precision[CONTRAST_COLUMNS, CONTRAST_COLUMNS] += KNOWN
    if not knowledge.after_data:
        return seen.rows[..., :PARAMETERS], precision
    full = np.zeros((PARAMETERS + 2, PARAMETERS + 2))
    full[:PARAMETERS, :PARAMETERS] = precision
    full[range(PARAMETERS, PARAMETERS + 2), range(PARAMETERS, PARAMETERS + 2)] = 1 / HOME_VARIANCE_RAD2
    return seen.rows, full


STOPS_ADVISED = 6
"""Stops of a direction below which its stop sd is known no better than to 30 % (1 / sqrt(2 n)): Laplace intervals of
that axis are then too short, and the sampler may not converge."""
SUBSETS_MAX = 40


def _sheet_subsets(count: int) -> list[tuple[int, ...]]:
    """Which sheets to place: all choices of one to three, the farthest apart first."""
    found = [s for size in (1, 2, 3) for s in combinations(range(count), size)]
    return sorted(found, key=lambda s: (s[0] - s[-1], len(s)))[:SUBSETS_MAX]


def _search(knowledge: Knowledge, seen: Seen, gradient: np.ndarray, own: np.ndarray, criterion: str) -> Search:
    rows, precision = _rows_for_search(seen, knowledge)
    wide = np.zeros((len(gradient), rows.shape[2]))
    wide[:, :PARAMETERS] = gradient
    return Search(rows, precision, wide, own, criterion)


def design_family(
    knowledge: Knowledge,
    found: Candidates,
    seen: Seen,
    target: Target,
    at_centre: Sensitivity,
    *,
    criterion: str = "c",
    aperture: bool = False,
    largest: int = LADDER[-1],
    minutes: float | None = None,
) -> Family:
    """The choice of sheets and the order of looks that reach the target soonest.

    For every choice of sheets looks are added greedily; the choice that first meets the target, counted in minutes,
    is kept, or the best after `largest` experiments (or `minutes`) if none does.
    """
    if criterion == "c":
        gradient, own = at_centre.gradient, at_centre.own_variance
    else:
        with jax.enable_x64(True):
            pose = jnp.asarray(seen.mirror_angles_rad.mean(axis=0))
            everything = np.asarray(headlines(jnp.asarray(knowledge.z), knowledge.space, pose).gradient)
        gradient = everything[[QUANTITIES.index(q) for q in ("left", "up", "backlash.pan", "backlash.tilt")]]
        own = np.zeros(len(gradient))
    search = _search(knowledge, seen, gradient, own, criterion)
    best: tuple[float, float, list[int]] | None = None
    for subset in _sheet_subsets(len(knowledge.sheets)):
        here = np.isin(found.looks.sheet, subset)
        if not here.any():
            continue
        part = replace(search, rows=np.where(here[:, None, None], search.rows, 0.0))
        picks = part.greedy(LOOKS_PER_EXPERIMENT * largest)
        family = Family(knowledge, found, np.array(picks), aperture)
        reached = (math.inf, math.inf)
        for n in (n for n in LADDER if n <= largest):
            design = family.arranged(n)
            duration = plan_minutes(design.steps, knowledge.rig)
            if minutes is not None and duration > minutes:
                break
            chosen = family.picks[: LOOKS_PER_EXPERIMENT * n]
            information = information_of_looks(seen, chosen, design.path, knowledge.space, knowledge.after_data)
            value = at_centre.value(covariance_of(knowledge.precision + information), target.factor)
            reached = min(reached, (duration, value) if value <= target.limit else (math.inf, value))
        if best is None or reached < best[:2]:
            best = (*reached, picks)
    return Family(knowledge, found, np.array(best[2]), aperture)


def _smallest(meets: Callable[[int], bool], sizes: Sequence[int]) -> int | None:
    """Smallest whole number that meets a monotone condition, bracketed by a ladder first."""
    above = next((n for n in sizes if meets(n)), None)
    if above is None:
        return None
    below = max((n for n in sizes if n < above), default=0)
    while above - below > 1:
        middle = (above + below) // 2
        above, below = (middle, below) if meets(middle) else (above, middle)
    return above


def split_of(knowledge: Knowledge, data: np.ndarray, noise: np.ndarray | None, found: Sensitivity) -> dict[str, float]:
    """Share of each cause in the worst quantity's variance; see `information.causes_of`.

    Args:
        knowledge: before the looks.
        data: information of the looks, shape (p, p).
        noise: its part that pixel noise alone stands for, or None to leave the looks whole.
        found: the target.
    """
    covariance = covariance_of(knowledge.precision + data)
    worst = int(np.argmax(np.einsum("qi,ij,qj->q", found.gradient, covariance, found.gradient) + found.own_variance))
    pull = covariance @ found.gradient[worst]
    parts = {}
    if noise is None:
        parts["looks"] = float(pull @ data @ pull)
    else:
        parts["pixel noise"] = float(pull @ noise @ pull)
        parts["stop errors of the looks"] = float(pull @ (data - noise) @ pull)
    if knowledge.after_data:
        # What the campaign taught and its priors cannot be told apart here: `locate --budget` and `fit` do.
        parts["the campaign and its priors"] = float(pull @ knowledge.precision @ pull)
    else:
        for name, columns in prior_groups().items():
            parts[name] = float(np.sum(pull[columns] ** 2))
    parts |= {name: float(value[worst]) for name, value in found.own.items()}
    total = sum(parts.values())
    kept = {name: value / total for name, value in parts.items() if value > 1e-12 * total}
    return dict(sorted(kept.items(), key=lambda item: -item[1]))


def _at_most(value: float) -> str:
    """A positive number to two digits, rounded down: an uncertainty that is enough, stated so that it stays enough."""
    last = 10.0 ** (math.floor(math.log10(value)) - 1)
    # A number that has two digits already may stand an ulp below them.
    return f"{last * math.floor(value / last + 1e-9):.2g}"


def _state(table: RigTable, columns: Sequence[int], share: float) -> str:
    """The stated u of a prior, and what it would have to be."""
    if len(columns) == len(NAMES) - len(RIG_NAMES):
        return f"the stereo calibration to {_at_most(100 * share)} % of its present uncertainty"
    stated = {NAMES[c]: table.priors[NAMES[c]].u for c in columns if table.priors[NAMES[c]].u > 0}
    return " and ".join(f"u({name}) = {_at_most(share * u)} instead of {u:.2g}" for name, u in stated.items())


def limit_of(knowledge: Knowledge, data: np.ndarray, found: Sensitivity, target: Target) -> Limit:
    """What no number of looks of this kind removes, and what would.

    Args:
        knowledge: before the looks.
        data: information of the largest design, shape (p, p).
        found: the target's sensitivities.
        target: the target.
    """
    many = MANY * data
    floor = found.value(covariance_of(knowledge.precision + many), target.factor)
    shares = split_of(knowledge, many, None, found)
    cause = next(iter(shares))
    if floor <= target.limit:
        return Limit(floor, cause, shares, True, None)
    groups = prior_groups()
    at_point = math.sqrt(max(found.own_variance)) * target.factor
    if at_point > target.limit:
        short = f"{at_point:.3g} {target.unit} come from the stop and the reading at the point itself"
        return Limit(floor, cause, shares, False, f"{short}: only a smaller stop error or aperture noise would do")

    def with_inputs(scaled: Mapping[str, float]) -> float:
        precision = knowledge.precision.copy()
        for name, share in scaled.items():
            columns = groups[name]
            # The prior's own precision is 1 in its coordinates, whatever the campaign added.
            precision[columns, columns] += share**-2 - 1
        return found.value(covariance_of(precision + many), target.factor)

    scaled: dict[str, float] = {}
    names = [name for name in shares if name in groups]
    if knowledge.after_data:
        names = sorted(groups, key=lambda name: with_inputs({name: 1e-3}))
    for name in names:
        if with_inputs({**scaled, name: 1e-3}) > target.limit:
            scaled[name] = 0.1
            continue
        low, high = 1e-3, 1.0
        for _ in range(40):
            middle = math.sqrt(low * high)
            low, high = (middle, high) if with_inputs({**scaled, name: middle}) <= target.limit else (low, middle)
        scaled[name] = low
        # Earlier ones that turn out not to matter are left as they are.
        for other in [n for n in scaled if n != name]:
            kept = {n: s for n, s in scaled.items() if n != other}
            if with_inputs(kept) <= target.limit:
                scaled = kept
        stated = "; ".join(_state(knowledge.rig.table, groups[n], s) for n, s in scaled.items())
        return Limit(floor, cause, shares, False, f"it would do to know {stated}")
    return Limit(floor, cause, shares, False, "no single input stands in the way: widen the limits or add sheets")


def _baselines(knowledge: Knowledge, target: Target, aperture: bool, pose_rad: np.ndarray | None) -> list[Baseline]:
    """The paper's protocol, its mixture of step counts and starts, and the grid, on this rig's sheets."""
    sheets = knowledge.sheets
    plans: dict[str, tuple[PlanStep, ...]] = {}
    if len(sheets) > 1:
        plans["paper"] = paper_protocol(targets=sheets[:2])
        plans["mixed"] = mixed_protocol(targets=sheets[:2])
    plans["grid"] = grid_protocol(targets=sheets[:3])
    return [judged(name, steps, knowledge, target, aperture, pose_rad) for name, steps in plans.items()]


def judged(
    name: str,
    steps: Sequence[PlanStep],
    knowledge: Knowledge,
    target: Target,
    aperture: bool,
    pose_rad: np.ndarray | None = None,
) -> Baseline:
    """One plan at the most probable instrument; ratios hold at `pose_rad`, by default the plan's own, as in a fit."""
    found = information_of(steps, knowledge, aperture=aperture)
    pose = found.pose_rad if pose_rad is None else pose_rad
    at = sensitivity(target, knowledge.z, knowledge.space, knowledge.rig.table, pose)
    value = at.value(covariance_of(knowledge.precision + found.fisher), target.factor)
    seen = int(found.expectation.seen.sum())
    return Baseline(name, len(found.look_moves), seen, found.minutes, value)


@dataclass(frozen=True)
class _Standing:
    """Where a plan has come to: the sheet that stands, counters (pan, tilt), and the direction each axis came in."""

    sheet: str = ""
    at: tuple[int, int] = (0, 0)
    came: tuple[str, str] = HOME_APPROACH

    def after(self, step: PlanStep) -> _Standing:
        """As `simulation.run_plan` takes a step: a move's empty counters keep the axis where it is."""
        if step.action == "place":
            return replace(self, sheet=step.target)
        if step.action == "home":
            return replace(self, at=(step.pan_steps or 0, step.tilt_steps or 0), came=HOME_APPROACH)
        if step.action != "move":
            return self
        ordered = (step.pan_steps, step.tilt_steps)
        at = tuple(old if new is None else new for old, new in zip(self.at, ordered, strict=True))
        came = tuple(
            way if new == old else SIDES[axis][int(new > old)]
            for axis, old, new, way in zip(AXES, self.at, at, self.came, strict=True)
        )
        return replace(self, at=at, came=came)


def _standing(steps: Sequence[PlanStep]) -> _Standing:
    """Where a plan ends."""
    return reduce(_Standing.after, steps, _Standing())


def described(steps: Sequence[PlanStep], before: Sequence[PlanStep] = ()) -> str:
    """Looks of a short plan on one sheet in words, after another plan."""
    now, words = _standing(before), []
    for step in steps:
        now = now.after(step)
        if step.action == "look":
            words.append(f"({now.at[0]}, {now.at[1]}) by {now.came[0]}, {now.came[1]}")
    return f"{now.sheet}: " + "; ".join(words)


def _next(
    knowledge: Knowledge,
    found: Candidates,
    seen: Seen,
    target: Target,
    at_centre: Sensitivity,
    now: float,
) -> tuple[Batch, ...]:
    """Four looks at every sheet, chosen from all candidates and from those a full turn away, by gain per minute."""
    search = _search(knowledge, seen, at_centre.gradient, at_centre.own_variance, "c")
    batches = []
    for number in range(len(knowledge.sheets)):
        for turned in (False, True):
            here = (found.looks.sheet == number) & (found.turned | (not turned))
            if not here.any():
                continue
            part = replace(search, rows=np.where(here[:, None, None], search.rows, 0.0))
            picks = np.array(part.greedy(LOOKS_PER_EXPERIMENT))
            design = arrange(found.looks[picks], knowledge.sheets, found.overshoot)
            information = information_of_looks(seen, picks, design.path, knowledge.space, knowledge.after_data)
            after = at_centre.value(covariance_of(knowledge.precision + information), target.factor)
            minutes = plan_minutes(design.steps, knowledge.rig)
            text = f"{'a full turn of pan away, ' if turned else ''}{described(design.steps)}"
            gain = max(now - after, 0.0)
            batches.append(Batch(design.steps, minutes, gain, gain / max(minutes, 1e-9), text))
    unique = {batch.actions: batch for batch in batches}.values()
    return tuple(sorted(unique, key=lambda b: -b.gain_per_minute)[:NEXT_LISTED])


def stop_now(now: float, target: Target, limit: Limit, batches: Sequence[Batch], after_data: bool) -> Advice:
    """The stopping rule: enough, or no use.

    Args:
        now: the target's value before further looks.
        target: the target.
        limit: its floor.
        batches: possible next experiments, best first.
        after_data: there is a campaign to stop.
    """
    best = batches[0].gain_per_minute if batches else 0.0
    worth = STOP_SHARE_PER_MINUTE * now
    rule = (
        f"stop when {target.text} holds for a fit of all data, or when the best next experiment lowers it by less than "
        f"{100 * STOP_SHARE_PER_MINUTE:g} % a minute"
    )
    shown = f"{now:.3g} {target.unit}"
    if after_data and now <= target.limit:
        return Advice(True, f"the target is met: {shown}", rule)
    if not limit.reachable:
        reason = f"no number of looks meets the target: the floor is {limit.floor:.3g} {target.unit}"
        return Advice(after_data, reason if after_data else f"{reason}; measure if that will do", rule)
    if best < worth:
        return Advice(True, f"the best next experiment lowers {shown} by only {best:.2g} {target.unit} a minute", rule)
    return Advice(False, f"{shown} now; the best next experiment lowers it by {best:.2g} {target.unit} a minute", rule)


def _classic_answer(
    target: Target, forecast: ClassicForecast | None, campaign: Campaign | None
) -> ClassicAnswer | None:
    """N = (t s / E)^2 with the uncertainty of s: over instruments, or by chi-square where s was measured."""
    if forecast is None or not set(target.indices) <= {0, 1, 2, 3} or target.point_mm is not None:
        return None
    half_width = target.limit * NORMAL_95 / target.factor
    measured = None if campaign is None else _measured(campaign)
    answers = []
    for index in target.indices:
        direction = DIRECTIONS[index]
        low, sd, high = np.quantile(forecast.sd[:, index], [0.025, 0.5, 0.975])
        if measured is not None and measured.get(direction) is not None:
            sd, n = measured[direction]
            low, high = (sd * math.sqrt((n - 1) / stats.chi2.ppf(p, n - 1)) for p in (0.975, 0.025))
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


def _classic_value(forecast: ClassicForecast | None, target: Target, experiments: int) -> float | None:
    """Median over instruments of what the classic estimator should report: type A and stereo, as GUM adds them."""
    each = experiments / len(DIRECTIONS)
    if forecast is None or each < 2 or target.point_mm is not None or not set(target.indices) <= {0, 1, 2, 3}:
        return None
    rows = list(target.indices)
    u = np.sqrt(forecast.sd[:, rows] ** 2 / each + forecast.stereo_u[rows] ** 2)
    return float(target.factor * np.median(u.max(axis=1)))


@dataclass(frozen=True)
class _Refined:
    """A design, and the uncertainty of the target that its fits report over the truths, shape (draws,)."""

    family: Family
    reported: np.ndarray


def _refined(
    family: Family,
    seen: Seen,
    target: Target,
    at_centre: Sensitivity,
    experiments: int,
    criterion: str,
    minutes: float | None,
    assurance: Assurance,
) -> _Refined:
    """The design of n experiments after exchanges.

    Exchanges suit the most probable instrument; they are kept only where they do not cost assurance or time.
    """
    knowledge, found = family.knowledge, family.found
    picks = family.picks[: LOOKS_PER_EXPERIMENT * experiments]
    plain = _Refined(replace(family, picks=picks), assurance.values([experiments])[experiments])
    if criterion != "c":
        return plain
    search = _search(knowledge, seen, at_centre.gradient, at_centre.own_variance, criterion)
    here = np.isin(found.looks.sheet, found.looks.sheet[picks])
    part = replace(search, rows=np.where(here[:, None, None], search.rows, 0.0))
    exchanged = replace(family, picks=np.array(part.exchange(picks)))
    if minutes is not None and plan_minutes(exchanged.arranged(experiments).steps, knowledge.rig) > minutes:
        return plain
    other = _Refined(exchanged, assurance.of(exchanged).values([experiments])[experiments])

    def merit(of: _Refined) -> tuple[float, float]:
        return float(np.mean(of.reported <= target.limit)), -float(np.median(of.reported))

    return other if merit(other) > merit(plain) else plain


def plan(
    rig: Rig,
    target: Target,
    *,
    given: JointFit | None = None,
    minutes: float | None = None,
    criterion: str = "c",
    aperture: bool = False,
    draws: int = PLAN_DRAWS,
    largest: int = LADDER[-1],
    seed: int = 0,
) -> PlanResult:
    """Find the cheapest plan that meets a target, and say what it will give, or why none can (DESIGN 6).

    Args:
        rig: sheets, limits, costs; its priors where there is no campaign.
        target: what is wanted.
        given: a fit of what was measured already.
        minutes: the plan must not take longer.
        criterion: what the search lowers: "c" the target, "D" or "A" ratios and backlashes together.
        aperture: looks also read the aperture.
        draws: instruments over which the assurance is taken.
        largest: experiments (of four looks) beyond which no plan is sought.
        seed: of the draws.

    Returns:
        The plan, its curve and the advice.

    Raises:
        InputError: no sheet to look at, nothing in view, a point out of reach, too few minutes for one experiment.
        NotConverged: `given` did not converge.
    """
    if given is not None and not given.converged:
        raise NotConverged("not-converged", "NOT CONVERGED: " + "; ".join(given.problems), remedy="see `tvsbayes fit`")
    knowledge = prior_knowledge(rig) if given is None else knowledge_of(given, rig)
    options = {"criterion": criterion, "aperture": aperture, "largest": largest, "minutes": minutes}
    campaign, pose = (None, None) if given is None else (given.campaign, given.reference_pose_rad)
    return plan_from(knowledge, target, campaign, pose, draws=draws, seed=seed, **options)


def share_error(share: float, draws: int) -> float:
    """Monte Carlo standard error of a share: binomial, and where all draws agree that of Beta(1/2, draws + 1/2).

    No number of draws makes 0 or 1 certain, as sqrt(p (1 - p) / n) would have it there; the Beta distribution is the
    posterior under Jeffreys' prior.
    """
    if 0 < share < 1:
        return math.sqrt(share * (1 - share) / draws)
    return math.sqrt(0.5 * (draws + 0.5) / (draws + 2)) / (draws + 1)


def _curve(
    assurance: Assurance, forecast: ClassicForecast | None, durations: Mapping[int, float], sizes: Sequence[int]
) -> tuple[CurvePoint, ...]:
    """What up to n experiments give, for each size.

    Noise scales estimated from few stops make single draws jump; a row states the best of all sizes up to its own,
    so that more experiments never look worse. A best of estimates leans towards the hopeful side.
    """
    target, draws = assurance.target, len(assurance.truths)
    rows, best, surest = [], math.inf, 0.0
    for n in sorted(set(sizes)):
        reported = assurance.values([n])[n]
        best = min(best, float(np.median(reported)))
        surest = max(surest, float(np.mean(reported <= target.limit)))
        classic_value = _classic_value(forecast, target, n)
        rows.append(CurvePoint(n, durations[n], classic_value, best, surest, share_error(surest, draws)))
    return tuple(rows)


def few_stops(looks: Looks) -> list[str]:
    """Directions that a design reaches so rarely that a fit can say little about them, as notes."""
    notes = []
    for axis, sides in ((0, ("left", "right")), (1, ("up", "down"))):
        for side, direction in zip((1, -1), sides, strict=True):
            stops = int(np.sum(looks.side[:, axis] == side))
            if stops < STOPS_ADVISED:
                reached = f"{stops} stop{'s' * (stops != 1)} {direction}"
                notes.append(
                    f"only {reached}: this plan is for its target alone; for reliable intervals of {direction} plan "
                    "u(worst), which asks for every direction"
                )
    return notes


def plan_from(
    knowledge: Knowledge,
    target: Target,
    campaign: Campaign | None = None,
    pose_rad: np.ndarray | None = None,
    *,
    criterion: str,
    aperture: bool,
    largest: int,
    minutes: float | None,
    draws: int,
    seed: int,
) -> PlanResult:
    """`plan` from what is known; effective ratios hold at `pose_rad`, by default in the middle of the candidates."""
    rig, after_data = knowledge.rig, knowledge.after_data
    found = candidates(knowledge)
    seen = LookArrays(found.looks, knowledge, aperture).at(knowledge.z, knowledge.space)
    pose = seen.mirror_angles_rad.mean(axis=0) if pose_rad is None else pose_rad
    at_centre = sensitivity(target, knowledge.z, knowledge.space, knowledge.rig.table, pose)
    now = at_centre.value(knowledge.covariance, target.factor)
    if now == 0:
        raise InputError(
            "target",
            f"{target.quantity} is held fixed by the rig (u = 0): its uncertainty is 0 whatever is measured",
            column="--target",
            found=target.text,
            allowed="a quantity that is to be estimated",
            remedy="state u > 0 for it in [rig.prior], or another target",
        )
    options = {"criterion": criterion, "aperture": aperture, "largest": largest, "minutes": minutes}
    family = design_family(knowledge, found, seen, target, at_centre, **options)
    durations = {n: plan_minutes(family.arranged(n).steps, rig) for n in range(1, largest + 1)}
    allowed = [n for n in durations if minutes is None or durations[n] <= minutes]
    if not allowed:
        raise InputError(
            "minutes",
            f"one experiment of four looks takes {durations[1]:.1f} minutes",
            column="--minutes",
            allowed=f"at least {durations[1]:.1f}",
            remedy="allow more minutes, or lower [costs] if the machine is faster",
        )
    sizes = sorted({n for n in LADDER if n <= allowed[-1]} | {allowed[-1]})
    assurance = Assurance(family, target, draws, seed)

    def met_share(n: int) -> float:
        return float(np.mean(assurance.values([n])[n] <= target.limit))

    assurance.values(sizes)
    n80, n95 = (_smallest(lambda n, level=level: met_share(n) >= level, sizes) for level in ASSURED)
    experiments = n95 or n80 or allowed[-1]
    forecast = classic_forecast(knowledge, assurance.truths)
    curve = _curve(assurance, forecast, durations, [*sizes, *(n for n in (n80, n95) if n)])
    refined = _refined(family, seen, target, at_centre, experiments, criterion, minutes, assurance)
    final = refined.family
    design = final.arranged(experiments)
    exact = information_of(design.steps, knowledge, aperture=aperture)
    chosen = judged("planned", design.steps, knowledge, target, aperture, pose_rad)
    share = float(np.mean(refined.reported <= target.limit))
    largest_design = family.arranged(family.largest)
    largest_information = information_of_looks(
        seen, family.picks, largest_design.path, knowledge.space, knowledge.after_data
    )
    limit = limit_of(knowledge, largest_information, at_centre, target)
    noise = _pixel_part(exact.expectation)
    batches = _next(knowledge, found, seen, target, at_centre, now)
    stop = stop_now(now, target, limit, batches, after_data)
    done = after_data and now <= target.limit
    return PlanResult(
        target=target,
        steps=() if done else design.steps,
        experiments=0 if done else experiments,
        looks=0 if done else len(final.picks),
        minutes=0.0 if done else exact.minutes,
        now=now,
        expected=now if done else chosen.joint,
        assurance=None if done else share,
        assurance_se=None if done else share_error(share, draws),
        curve=curve,
        n80=n80,
        n95=n95,
        limit=limit,
        shares=split_of(knowledge, exact.fisher, noise, at_centre),
        baselines=(chosen, *_baselines(knowledge, target, aperture, pose_rad)),
        next=batches,
        stop=stop,
        classic=_classic_answer(target, forecast, campaign),
        met=done or share >= ASSURED[0],
        notes=(*found.notes, *([] if done else few_stops(final.looks(experiments)))),
        draws=draws,
        seed=seed,
        criterion=criterion,
    )


def _linear_spots(found: Expectation) -> LinearSpots:
    """Expected looks as the smoother takes them."""
    return LinearSpots(
        residual=np.zeros(found.jacobian.shape[:2]),
        load=found.load,
        renewed=found.keep == 0,
        variance=found.variance,
        jacobian=found.jacobian,
    )


def _pixel_part(found: Expectation) -> np.ndarray:
    """What pixel noise alone contributes to the information, (C^-1 J)^T (C^-1 J), shape (p, p)."""
    groups = stop_information(_linear_spots(found)).groups
    gain = np.concatenate([group.jacobian for group in groups])
    return gain.T @ gain


def plan_text(result: PlanResult) -> str:
    """A result for people."""
    unit = result.target.unit
    lines = [f"target: {result.target.text}; now {result.now:.3g} {unit}", ""]
    lines.append("experiments  minutes     classic       joint  assurance")
    for p in result.curve:
        classic_value = "-" if p.classic is None else f"{p.classic:.3g}"
        lines.append(
            f"{p.experiments:11d}  {p.minutes:7.1f}  {classic_value:>10}  {p.joint:>10.3g}  "
            f"{100 * p.assurance:5.0f} +- {100 * p.assurance_se:.1f} %"
        )
    lines.append(f"(four looks each; medians over {result.draws} drawn instruments, {unit})")
    none = f"not reached with up to {result.curve[-1].experiments} experiments"
    for level, n in zip(ASSURED, (result.n80, result.n95), strict=True):
        lines.append(f"assurance {100 * level:.0f} %: {none if n is None else f'n = {n}'}")
    if result.assurance is None:
        lines.append("the target is met already: nothing is left to do")
    else:
        lines.append(
            f"the plan: n = {result.experiments}, {result.looks} looks in {result.minutes:.1f} minutes; assurance "
            f"{100 * result.assurance:.0f} +- {100 * result.assurance_se:.1f} %"
        )
    lines += ["", f"{'plan':10}  spots  in view  minutes  expected {unit}"]
    lines += [f"{b.name:10}  {b.spots:5d}  {b.seen:7d}  {b.minutes:7.1f}  {b.joint:.3g}" for b in result.baselines]
    shares = ", ".join(f"{name} {100 * s:.0f} %" for name, s in list(result.shares.items())[:5])
    lines += ["", f"after the plan the variance consists of: {shares}"]
    verdict = "lies below the target" if result.limit.reachable else "NO NUMBER OF LOOKS MEETS THE TARGET"
    lines.append(f"floor {result.limit.floor:.3g} {unit}, set by {result.limit.cause}: {verdict}")
    if result.limit.needed:
        lines.append(result.limit.needed)
    if result.classic is not None:
        c = result.classic
        low, high = c.experiments_interval95
        source = "measured" if c.from_data else "predicted"
        lines.append(
            f"classic, {c.direction}: n = (t s / E)^2 = {c.experiments} per direction ({low} to {high}) for s = "
            f"{c.sd:.2g} deg/step ({source}), E = {c.half_width:.2g}; its systematic error {c.systematic:+.2g} "
            f"({c.systematic_interval95[0]:+.2g} to {c.systematic_interval95[1]:+.2g}) stays whatever n"
        )
    if result.next:
        lines.append("next:")
        lines += [f"  {b.gain_per_minute:.2g} {unit} a minute ({b.minutes:.1f} min): {b.text}" for b in result.next[:3]]
    lines.append(f"{'STOP' if result.stop.now else 'go on'}: {result.stop.reason}; {result.stop.rule}")
    lines += [f"note: {note}" for note in result.notes]
    return "\n".join(lines)


EXCHANGE_SHARE = 0.5
"""A ratio and a backlash are hard to tell apart where more than this share of the ratio's variance is exchange with
the backlash: knowing the backlash would then lower u of the ratio by 30 % and more."""
CURE_LOOKS = 12
"""Looks beyond which an addition is no small cure."""


@dataclass(frozen=True)
class PlanFault:
    """Something that a plan leaves to the priors, and the smallest addition that cures it.

    Attributes:
        axis: pan, tilt, or "depth".
        text: in words.
        addition: steps to append to the plan, empty where none was found.
        before, after: u of the worst effective ratio of the axis without and with it, deg/step.
    """

    axis: str
    text: str
    addition: tuple[PlanStep, ...]
    before: float
    after: float | None


@dataclass(frozen=True)
class PlanCheck:
    """What `check RIG PLAN` says.

    Attributes:
        looks, seen: looks ordered, and in both images at the most probable instrument.
        minutes: by `[costs]`.
        expected: u of every headline after the plan, in its unit.
        contraction: 1 - var_post / var_prior of every headline, None where the priors hold it fixed.
        faults: what the plan cannot separate.
        warnings: the same and more, as sentences.
    """

    looks: int
    seen: int
    minutes: float
    expected: dict[str, float]
    contraction: dict[str, float | None]
    faults: tuple[PlanFault, ...]
    warnings: tuple[str, ...]

    def as_json(self) -> dict[str, object]:
        """The document of `check --json` for a rig with a plan."""
        named = ("looks", "seen", "minutes", "expected", "contraction")
        faults = [
            {"axis": f.axis, "text": f.text, "addition": [step_json(s) for s in f.addition], "u_deg_per_step": f.after}
            for f in self.faults
        ]
        listed = {name: getattr(self, name) for name in named}
        return {"kind": "rig with plan", **listed, "faults": faults, "warnings": list(self.warnings)}


def step_json(step: PlanStep) -> dict[str, object]:
    """An action of a plan in a document."""
    filled = {"pan_steps": step.pan_steps, "tilt_steps": step.tilt_steps, "target": step.target or None}
    return {"action": step.action, **{k: v for k, v in filled.items() if v is not None}}


@dataclass(frozen=True)
class _Judged:
    """Covariance of the headlines after a plan, shape (9, 9), and what separates ratio and backlash of each axis."""

    information: PlanInformation
    covariance: np.ndarray
    gradient: np.ndarray
    prior: np.ndarray

    def rows(self, axis: str) -> list[int]:
        """Rows of the ratio and of the backlash of an axis."""
        return [QUANTITIES.index("left" if axis == "pan" else "up"), QUANTITIES.index(f"backlash.{axis}")]

    def exchange(self, axis: str) -> float:
        """Share of the ratio's variance that knowing the backlash would remove."""
        ratio, lost = self.rows(axis)
        c = self.covariance
        if self.prior[lost] == 0:
            return 0.0
        return float(c[ratio, lost] ** 2 / (c[ratio, ratio] * c[lost, lost]))

    def u(self, axis: str) -> float:
        """Of the worse effective ratio of an axis, deg/step."""
        rows = [0, 1] if axis == "pan" else [2, 3]
        return float(np.sqrt(np.diag(self.covariance)[rows].max()))

    def contraction(self) -> np.ndarray:
        """Of every headline, shape (9,); NaN where its prior holds it fixed."""
        left = np.diag(self.covariance)
        return 1 - np.divide(left, self.prior, out=np.full(len(left), np.nan), where=self.prior > 0)

    def faulty(self, axis: str) -> bool:
        """The axis' ratio or backlash is the prior's, or they exchange."""
        return bool(
            (self.contraction()[self.rows(axis)] < CONTRACTION_LIMIT).any() or self.exchange(axis) > EXCHANGE_SHARE
        )


def _judge(steps: Sequence[PlanStep], knowledge: Knowledge) -> _Judged:
    found = information_of(steps, knowledge)
    with jax.enable_x64(True):
        at = headlines(jnp.asarray(knowledge.z), knowledge.space, jnp.asarray(found.pose_rad))
    gradient = np.asarray(at.gradient)
    covariance = gradient @ covariance_of(knowledge.precision + found.fisher) @ gradient.T
    prior = np.einsum("qi,ij,qj->q", gradient, knowledge.covariance, gradient)
    return _Judged(found, covariance, gradient, prior)


def _extended(
    steps: Sequence[PlanStep], looks: Looks, sheets: Sequence[str], overshoot: np.ndarray
) -> tuple[PlanStep, ...]:
    """Steps that append looks to a plan: no homing in between, a placement only where another sheet is needed."""
    end = _standing(steps)
    more = [s for s in arrange(looks, sheets, overshoot, end.at).steps if s.action != "home"]
    if more and more[0].action == "place" and more[0].target == end.sheet:
        more = more[1:]
    return tuple(replace(s, step=len(steps) + k) for k, s in enumerate(more))


def _fault_text(plan: _Judged, axis: str) -> str:
    """What a faulty axis leaves open."""
    ratio, lost = plan.contraction()[plan.rows(axis)]
    if ratio < CONTRACTION_LIMIT:
        return f"the plan tells nothing of the {axis} ratio"
    if lost < CONTRACTION_LIMIT:
        return f"the plan tells nothing of the {axis} backlash"
    share = 100 * plan.exchange(axis)
    return f"{axis} ratio and {axis} backlash cannot be told apart well ({share:.0f} % of the variance is common)"


@dataclass(frozen=True)
class _Cure:
    """Steps to append to a plan, and what it is then."""

    addition: tuple[PlanStep, ...]
    after: _Judged


def _cure(
    steps: Sequence[PlanStep], knowledge: Knowledge, found: Candidates, axis: str, before: _Judged
) -> _Cure | None:
    """Fewest looks after which the axis is no longer faulty, on the sheet that stands; None if there are none."""
    seen = LookArrays(found.looks, knowledge, False).at(knowledge.z, knowledge.space)
    rows = before.rows(axis)
    own = np.zeros(len(rows))
    precision = knowledge.precision + before.information.fisher
    search = Search(seen.rows[..., :PARAMETERS], precision, before.gradient[rows], own, "A")
    placed = _standing(steps).sheet
    here = found.looks.sheet == (knowledge.sheets.index(placed) if placed in knowledge.sheets else 0)
    part = replace(search, rows=np.where(here[:, None, None], search.rows, 0.0))
    picks = np.array(part.greedy(CURE_LOOKS))
    for count in range(1, CURE_LOOKS + 1):
        addition = _extended(steps, found.looks[picks[:count]], knowledge.sheets, found.overshoot)
        after = _judge((*steps, *addition), knowledge)
        if not after.faulty(axis):
            return _Cure(addition, after)
    return None


def _beyond_limits(rig: Rig, moves: Sequence[Move]) -> list[str]:
    """Axes that leave the limits which `[positioner]` states, as sentences."""
    found = []
    for axis in AXES:
        counters = [getattr(move, f"{axis}_steps") for move in moves]
        least, most = (rig.positioner.get(f"{axis}_{end}_steps") for end in ("min", "max"))
        if (least is None or min(counters) >= least) and (most is None or max(counters) <= most):
            continue
        allowed = f"{least} to {most}"
        if least is None or most is None:
            allowed = f"up to {most}" if least is None else f"{least} and more"
        found.append(f"{axis} moves from {min(counters)} to {max(counters)} steps; [positioner] allows {allowed}")
    return found


def check_plan(rig: Rig, steps: Sequence[PlanStep]) -> PlanCheck:
    """What a plan on a rig cannot tell apart, in words, and the smallest addition that would (DESIGN 6).

    Args:
        rig: priors, sheets, limits.
        steps: the plan.

    Raises:
        InputError: a plan that looks at nothing or places an unknown sheet.
    """
    knowledge = prior_knowledge(rig)
    judged_plan = _judge(steps, knowledge)
    information = judged_plan.information
    contraction = judged_plan.contraction()
    observed = {move for move, seen in zip(information.look_moves, information.expectation.seen, strict=True) if seen}
    warnings, faults = [], []
    missed = int((~information.expectation.seen).sum())
    if missed:
        warnings.append(
            f"{missed} of {len(information.look_moves)} looks miss an image at the most probable instrument"
        )
    warnings += _beyond_limits(rig, information.moves)
    faulty = [axis for axis in AXES if judged_plan.faulty(axis)]
    found = None
    if faulty:
        try:
            found = candidates(knowledge)
        except InputError as error:
            warnings.append(f"no cure can be sought on this rig: {error.message}")
    for axis in faulty:
        reason = separation(observed_stops(information.moves, observed, axis), axis)
        text = _fault_text(judged_plan, axis) + (f": {reason}" if reason else "")
        cure = None if found is None else _cure(steps, knowledge, found, axis, judged_plan)
        before = judged_plan.u(axis)
        if cure is not None:
            looks, after = sum(s.action == "look" for s in cure.addition), cure.after.u(axis)
            text += (
                f"; smallest cure: {looks} more look{'s' * (looks != 1)}, {described(cure.addition, steps)}: u of the "
                f"{axis} ratio {before:.2g} -> {after:.2g} deg/step"
            )
            faults.append(PlanFault(axis, text, cure.addition, before, after))
        else:
            text += f"; no {CURE_LOOKS} looks cure it on this rig" if found is not None else ""
            faults.append(PlanFault(axis, text, (), before, None))
        warnings.append(text)
    depths = {s.target for s in steps if s.action == "place"}
    if len({rig.sheets_mm[name] for name in depths}) == 1 and len(rig.sheets_mm) > 1:
        warnings.append(
            "all looks are at one depth: a second sheet position sharpens ratios; place "
            + ", ".join(name for name in knowledge.sheets if name not in depths)
        )
    u = np.sqrt(np.diag(judged_plan.covariance))
    return PlanCheck(
        looks=len(information.look_moves),
        seen=len(information.look_moves) - missed,
        minutes=information.minutes,
        expected=dict(zip(QUANTITIES, map(float, u), strict=True)),
        contraction={
            name: None if math.isnan(share) else float(share)
            for name, share in zip(QUANTITIES, contraction, strict=True)
        },
        faults=tuple(faults),
        warnings=tuple(warnings),
    )
