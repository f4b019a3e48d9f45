"""Verification of a table in force by fresh readings: whether its promise is kept, and if not, why.

The hypotheses ("worlds") are the same mechanics under other commands: the table was applied, not applied, applied
twice, or with the wrong sign, or so for the play alone. A further one is another machine, which differs by shift,
ratio, play and scatter of unknown size. Commands in the campaign's counts. No JAX.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tvsbayes.compensation.correction import Correction
from tvsbayes.compensation.formats import is_table_of
from tvsbayes.compensation.promise import bound_of, origin_of, reading_u, refuse_answer
from tvsbayes.errors import InputError, NothingToEstimate, escaped, refusal
from tvsbayes.files.disk import read_bytes
from tvsbayes.files.documents import JSON_BYTES_MAX
from tvsbayes.progress import Job, Show
from tvsbayes.results.compensation_record import (
    APPLIED,
    BROKEN,
    CANNOT_TELL,
    COMPENSATION_FORMAT,
    KEPT,
    NOT_APPLIED,
    OTHER_MACHINE,
    TWICE,
    WORLDS,
    WRONG_SIGN,
    Compensation,
    ErrorSize,
    ShiftFree,
    Verdict,
    Verification,
)
from tvsbayes.results.records import read_record, stored_document
from tvsbayes.single_axis.axis_campaign import AxisCampaign, AxisStop, axis_hashes, read_axis, stops_csv
from tvsbayes.single_axis.axis_fit import AxisFit
from tvsbayes.single_axis.axis_record import results_for
from tvsbayes.single_axis.axis_rows import DIRECTIONS, AxisRows, rows_of
from tvsbayes.single_axis.predicted_stops import PredictedAxis, longest_use
from tvsbayes.statistics.optimal_design import discriminating_visits
from tvsbayes.statistics.predicted_readings import PredictedReadings, State, less_means, log_mean
from tvsbayes.statistics.streams import Stream, random_stream

SURE, UNLIKELY, P_MIN = 0.95, 0.01, 0.003
"""Least probability of a hypothesis for KEPT; probability of `APPLIED`, and p-value of the readings, below which the
verdict is BROKEN. The last two give fewer than one false BROKEN in a hundred."""
REPLICATES = 4000
"""Number of simulated readings for p."""
SCENARIOS = {
    APPLIED: ((1.0, 1.0),),
    NOT_APPLIED: ((0.0, 0.0), (1.0, 0.0)),
    TWICE: ((2.0, 2.0), (1.0, 2.0)),
    WRONG_SIGN: ((-1.0, -1.0), (1.0, -1.0)),
}
"""Factors on the common part of both sides and on their difference."""
SEPARATE = 16.0
"""Squared distance, in standard deviations of the readings, from which a fault of the play alone is a separate case; a
smaller one does not affect the promise."""
IDENTIFIED = 25.0
"""Squared distance of two hypotheses at which readings identify the true one in 95 of 100 cases: half of it less 1.645
times its root exceeds ln(76), the odds of 0.95 against four others."""
OTHERS, OTHER_LEAST = 12, 3.0
"""Number of sizes of another machine's deviation, and the least, in uncertainties of a reading; the largest is half of
the travel. A machine with a smaller deviation keeps the promise."""
BEYOND = 1.5
"""Multiple of the promise's hours or travel above which the readings get a remark that they last longer."""
CANDIDATES, SPREAD, PLANNED_MAX = 17, 3, 40
"""For a plan: commands tried, commands always visited, largest number of stops."""


def _distance(off: np.ndarray, covariance: np.ndarray) -> float:
    """Compute the squared distance in standard deviations."""
    return float(off @ np.linalg.solve(covariance, off))


def other_axis(command: np.ndarray, side: np.ndarray) -> np.ndarray:
    """Compute the relative covariance (r, r) of another axis' deviations at commands (r,) reached from sides (r,).

    It has shift and ratio, and half as large play and scatter.
    """
    centre = command - command.mean()
    span = centre / max(float(np.max(np.abs(centre))), 1e-300)
    shape = np.ones((len(span), len(span))) + np.outer(span, span) + 0.25 * np.outer(side, side)
    return shape + 0.25 * np.eye(len(span))


@dataclass(frozen=True)
class Trial:
    """Fresh readings and their predictions by each hypothesis, of one axis or of both of a scanner.

    Attributes:
        at: cached function: readings predicted for factors on the common part and the play of the correction.
        value, aim: readings, and aimed readings, shape (r,).
        other: relative covariance (r, r) of another machine's deviations.
        travel: range of the readings.
        free: masks (g, r) of readings whose errors count but for one shift common to them; disjoint, g may be 0.
        noise: variances of the noise drawn at each visit, shape (r,).
    """

    at: Callable[[float, float], PredictedReadings]
    value: np.ndarray
    aim: np.ndarray
    other: np.ndarray
    travel: float
    free: np.ndarray
    noise: np.ndarray

    @property
    def shift(self) -> np.ndarray:
        """Covariance (r, r) of the free shifts, which may be as large as the travel."""
        return self.travel**2 * (self.free.T.astype(float) @ self.free)


def _log_densities(trial: Trial) -> dict[str, float]:
    """Compute the log density of the readings by hypothesis."""
    promised = trial.at(1.0, 1.0)
    mean, covariance = promised.pooled()
    play_matters = _distance(trial.at(1.0, 0.0).pooled().mean - mean, covariance + trial.shift) > SEPARATE
    log_densities = {}
    for world, factors in SCENARIOS.items():
        possible = [f for f in factors if f[0] == f[1] or play_matters]
        log_densities[world] = log_mean([trial.at(*f).log_density(trial.value, trial.shift) for f in possible])
    least = OTHER_LEAST * float(np.sqrt(np.median(np.diag(covariance))))
    sizes = np.geomspace(least, max(0.5 * trial.travel, 2 * least), OTHERS)
    others = [promised.log_density(trial.value, trial.shift + size**2 * trial.other) for size in sizes]
    return log_densities | {OTHER_MACHINE: log_mean(others)}


def _p_value(promised: PredictedReadings, value: np.ndarray, shift: np.ndarray, seed: int) -> float:
    """Compute the p-value of the readings' squared distance, from readings drawn from the prediction."""
    mean, covariance = promised.pooled()
    inverse = np.linalg.inv(covariance + shift)
    drawn = promised.drawn(REPLICATES, random_stream(seed, Stream.WORLDS))

    def squares(values: np.ndarray) -> np.ndarray:
        off = np.atleast_2d(values) - mean
        return np.einsum("ni,ij,nj->n", off, inverse, off)

    return float((1 + np.sum(squares(drawn) >= squares(value)[0])) / (REPLICATES + 1))


def size_of(error: np.ndarray) -> ErrorSize:
    """Compute the size of errors (r,)."""
    return ErrorSize(float(np.sqrt(np.mean(error**2))), float(np.max(np.abs(error))))


def verification_of(
    trial: Trial, readings: int, *, homing: bool, seed: int, together: int = 1, **said: Any
) -> Verification:
    """Decide by the probabilities of the hypotheses and the distance of the readings from the prediction.

    Args:
        trial: readings and predictions.
        readings: number of readings as users count them.
        homing: whether errors with the free shifts are stated as well, those of a homing.
        seed: seed of all draws.
        together: number of values of one reading.
        said: further fields of `Verification`.
    """
    promised, without = trial.at(1.0, 1.0), trial.at(0.0, 0.0)
    logs = _log_densities(trial)
    total = float(np.logaddexp.reduce(list(logs.values())))
    worlds = {name: float(np.exp(logs[name] - total)) for name in WORLDS}
    p = _p_value(promised, trial.value, trial.shift, seed)
    needed: int | None = 0
    verdict: Verdict = KEPT if worlds[APPLIED] >= SURE else CANNOT_TELL
    if p < P_MIN or worlds[APPLIED] < UNLIKELY:
        verdict = BROKEN
    if verdict == CANNOT_TELL:
        needed = needed_readings(promised, promised.pooled().mean - without.pooled().mean, trial.noise)
    kept, error, every = less_means(trial.free), trial.value - trial.aim, np.arange(len(trial.aim))
    first = size_of(kept @ error), bound_of(promised.less(trial.free), kept @ trial.aim, every)
    return Verification(
        verdict=verdict,
        p=p,
        worlds=worlds,
        before=size_of(kept @ (without.pooled().mean - trial.aim)),
        after=first[0],
        promised95=first[1],
        readings=readings,
        needed=None if needed is None else -(-needed // together),
        shift_free=ShiftFree(*first) if homing else None,
        after_with_homing=size_of(error) if homing else None,
        promised95_with_homing=bound_of(promised, trial.aim, every) if homing else None,
        **said,
    )


def needed_readings(promised: PredictedReadings, off: np.ndarray, noise: np.ndarray) -> int | None:
    """Compute the number of repeated readings that discriminates two hypotheses; None where none does.

    Args:
        promised: prediction of r stops, if the table is applied.
        off: deviation of the other hypothesis at these stops, shape (r,).
        noise: variances of the noise drawn at each visit, shape (r,).
    """
    covariance = promised.pooled().covariance
    kept = covariance - np.diag(0.999 * np.minimum(noise, np.diag(covariance)))
    for times in (1, 2, 3, 4, 6, 8, 12, 16, 24, 32):
        if _distance(off, kept + np.diag(noise) / times) >= IDENTIFIED:
            return times * len(off)
    return None


def _remarks(made: Compensation, fresh: AxisRows, campaign: AxisCampaign) -> tuple[str, ...]:
    """Return further remarks for the user."""
    low, high = made.range_command
    outside = int(np.sum((fresh.command < low) | (fresh.command > high)))
    remarks = []
    if outside:
        remarks.append(
            f"{outside} of {len(fresh.command)} stops lie outside {low:.10g} to {high:.10g}: the promise does not hold "
            "there; larger errors are expected of them"
        )
    hours, travel = longest_use(campaign.moves)
    if hours > BEYOND * made.hours or travel > BEYOND * made.travel_command:
        remarks.append(
            f"the fresh readings go on for {hours:.3g} h and {travel:.4g} commands of travel after a "
            f"homing, the promise for {made.hours:.3g} h and {made.travel_command:.4g}: larger errors are expected"
        )
    named = campaign.header.get("serial") or campaign.header.get("name")
    if named and made.machine and named != made.machine:
        remarks.append("the fresh readings name another machine or campaign than the table: is it the right one?")
    return tuple(remarks)


def verify_readings(
    fit: AxisFit, made: Compensation, campaign: AxisCampaign, *, seed: int = 0, progress: Show | None = None
) -> Verification:
    """Verify a table in force by fresh readings.

    Args:
        fit: fit of the table.
        made: the table and its promise.
        campaign: fresh readings; commands before the correction.
        seed: seed of all draws.
        progress: receives the progress.

    Raises:
        InputError: the readings have another unit.
        NothingToEstimate: they are too few.
    """
    if campaign.unit != made.unit:
        message = f"the fresh readings are in {campaign.unit[:20]!r}, the table is in {made.unit[:20]!r}"
        raise InputError("unit", message, remedy="give readings in the unit of the table")
    fresh, applied = rows_of(campaign), Correction.of(made)
    aim, machine = made.offset + made.per_command * fresh.command, PredictedAxis(fit, seed)

    @cache
    def at(common: float, play: float) -> PredictedReadings:
        return machine.read(replace(campaign, moves=tuple(applied.moved(campaign.moves, common, play))))

    with Job({"worlds": 1.0}, progress) as job:
        job.begin("worlds")
        trial = Trial(
            at=at,
            value=fresh.value,
            aim=aim,
            other=other_axis(fresh.command, fresh.side),
            travel=fit.rows.travel,
            free=np.ones((int(made.shift_free), len(aim)), dtype=bool),
            noise=machine.noise(fresh.side, fresh.variance),
        )
        remarks, homing = _remarks(made, fresh, campaign), made.shift_matters
        readings = len(fresh.value)
        return verification_of(trial, readings, homing=homing, seed=seed, unit=campaign.unit, remarks=remarks)


AGAIN = "run `tvsbayes compensate` on this folder, and apply what it writes"


def compensation_in(campaign: AxisCampaign) -> Compensation | None:
    """Read the compensation in a folder's `results/`, if it belongs to these data.

    Raises:
        InputError: it is damaged.
    """
    keys = stored_document(campaign, "compensation.json", (COMPENSATION_FORMAT,), axis_hashes(campaign))
    return None if keys is None else read_record(Compensation, keys, AGAIN)


def kept_name(made: Compensation) -> str:
    """Name in `results/` of a promise whose table stays in force beside a later one."""
    return f"compensation-{made.table_id}.json"


def table_in(campaign: AxisCampaign, path: Path) -> Compensation | None:
    """Find the compensation of a folder's data whose table a file holds.

    Raises:
        InputError: the file, or a promise in `results/`, cannot be read.
    """
    text, inputs = read_bytes(path, JSON_BYTES_MAX).decode(errors="replace"), axis_hashes(campaign)
    data = origin_of(campaign).data_sha256
    folder = None if campaign.path is None else campaign.path / "results"
    for name in [] if folder is None else sorted(each.name for each in folder.glob("compensation*.json")):
        keys = stored_document(campaign, name, (COMPENSATION_FORMAT,), inputs)
        if keys is not None and is_table_of(text, made := read_record(Compensation, keys, AGAIN), data):
            return made
    return None


def stored_compensation(campaign: AxisCampaign, file: Path | None = None) -> Compensation:
    """Read the compensation in `results/`, or the one whose table a file holds; it must exist.

    Raises:
        InputError: there is none, it belongs to other data, or it is damaged, or the file cannot be read.
    """
    made = compensation_in(campaign) if file is None else table_in(campaign, file)
    if made is None:
        found, allowed = "no compensation of these data", "the one whose table is in force"
        code, name = "missing-file", "results/compensation.json"
        if file is not None:
            found, allowed = "no table whose promise is kept", "a table that `compensate -o` made of these data"
            code, name = "other-table", escaped(str(file), 200)
        raise refusal(code, file=name, found=found, allowed=allowed, remedy=AGAIN)
    return made


def verify_axis(
    folder: AxisCampaign | Path | str,
    fresh: AxisCampaign | Path | str,
    *,
    made: Compensation | None = None,
    seed: int = 0,
    tell: Callable[[str], None] = lambda _: None,
    progress: Show | None = None,
) -> Verification:
    """Verify that an axis keeps the promise of its table.

    Args:
        folder: folder of the table.
        fresh: readings with the table in force; commands before the correction.
        made: the table; None for the one in `results/compensation.json`.
        seed: seed of all draws.
        tell: receives the reason where a fit runs first.
        progress: receives the progress.

    Raises:
        InputError: a folder cannot be used, or there is no table.
        NotConverged: the fit is not accepted.
        NothingToEstimate: there are too few fresh readings, or the table is that of a drive at constant rate.
    """
    known = folder if isinstance(folder, AxisCampaign) else read_axis(folder)
    new = fresh if isinstance(fresh, AxisCampaign) else read_axis(fresh)
    table = stored_compensation(known) if made is None else made
    refuse_drive(table)
    with Job({"fit": 1.0, "verification": 1.0}, progress) as job:
        results = results_for(known, progress=job.part("fit"), seed=seed, notify=tell)
        refuse_answer(results.summary.answer)
        return verify_readings(results.fit, table, new, seed=seed, progress=job.part("verification"))


class VerifyStop(NamedTuple):
    """A stop to read: its command, and the side of arrival, 1 or -1."""

    command: float
    side: int


@dataclass(frozen=True)
class VerifyPlan:
    """Stops to read with the table in force, in this order.

    Attributes:
        stops: the stops.
        run_up: distance by which the axis moves beyond a command before it returns to it.
        enough: whether they discriminate the hypotheses in 95 of 100 cases.
        distance: distance of the nearest two hypotheses, standard deviations.
    """

    stops: tuple[VerifyStop, ...]
    run_up: float
    enough: bool
    distance: float

    @property
    def arrivals(self) -> list[AxisStop]:
        """The stops with the commands visited before, where a run-up needs one."""
        at, planned = math.nan, []
        for command, side in self.stops:
            # The first stop gets a run-up, wherever the axis is.
            arrives = side * (command - at) >= self.run_up
            via = None if arrives else command - side * self.run_up
            planned.append(AxisStop(via, command, DIRECTIONS[side]))
            at = command
        return planned

    @property
    def moves(self) -> int:
        """Number of moves that it takes."""
        return sum(1 + (stop.via is not None) for stop in self.arrivals)

    def plan_bytes(self) -> bytes:
        """Return `plan.csv`: step, command, direction, read (1 or 0)."""
        return stops_csv(self.arrivals)


def refuse_drive(made: Compensation) -> None:
    """Refuse the table of a drive at constant rate, whose readings contain no stops.

    Raises:
        NothingToEstimate: it is one; with what shows the remaining error instead.
    """
    if not made.in_motion:
        return
    period = made.settings.get("period_s")
    key = f"; `periods = [{period:.6g}]` for `period_between` in its campaign.toml asks for it alone" if period else ""
    raise NothingToEstimate(
        "in-motion",
        "a table of a drive at constant rate is not verified by stops: the drive makes none",
        allowed="tables of axes that stop",
        remedy="log again with the table in force, import and `tvsbayes fit` the log: what is left is the wave of the "
        f"table's period{key}",
    )


def reachable_stops(fit: AxisFit, nodes: np.ndarray, run_up: float) -> tuple[np.ndarray, np.ndarray]:
    """Choose commands and sides (m,) of stops that a plan may have, those of the rising side first.

    Raises:
        NothingToEstimate: no run-up fits into the commands that are allowed.
    """
    low, high = fit.campaign.range_allowed
    nodes = nodes[(nodes >= low) & (nodes <= high) & ((nodes - run_up >= low) | (nodes + run_up <= high))]
    # Commands whose both sides can be reached, if there are enough.
    inside = nodes[(nodes - run_up >= low) & (nodes + run_up <= high)]
    nodes = inside if len(inside) >= SPREAD else nodes
    if not len(nodes):
        message = f"no stop has room for a run-up of {run_up:.6g} within the commands {low:.10g} to {high:.10g}"
        remedy = "state `limits` in [axis] if the machine may go further"
        raise NothingToEstimate("limits", message, file="campaign.toml", remedy=remedy)
    nodes = nodes[np.linspace(0, len(nodes) - 1, min(len(nodes), CANDIDATES)).round().astype(int)]
    command, side = np.r_[nodes, nodes[::-1]], np.repeat([1, -1], len(nodes))
    starts = command - side * run_up
    reached = (starts >= low) & (starts <= high)
    return command[reached], side[reached]


def use_over(machine: PredictedAxis, hours: float, side: np.ndarray, variance: np.ndarray) -> tuple[State, np.ndarray]:
    """States of stops (r,) one after the other over the hours since a homing, and what does not repeat there."""
    use = machine.state._replace(hours=np.linspace(0.0, hours, len(side)))
    return use, np.asarray(sum(machine.scatter(side, use, np.sqrt(variance)).values()))


def spread_stops(command: np.ndarray) -> np.ndarray:
    """Mask of stops over the whole range, which come first: a fault in a part of it shows only there."""
    nodes = np.unique(command)
    return np.isin(command, nodes[np.linspace(0, len(nodes) - 1, SPREAD).round().astype(int)])


def planned_stops(command: np.ndarray, side: np.ndarray, visits: np.ndarray) -> tuple[VerifyStop, ...]:
    """List each stop as often as it is visited."""
    order = np.repeat(np.arange(len(command)), visits.astype(int))
    return tuple(VerifyStop(float(command[k]), int(side[k])) for k in order)


def plan_verification(fit: AxisFit, made: Compensation, *, seed: int = 0) -> VerifyPlan:
    """Plan the fewest stops that discriminate the hypotheses, by greedy choice among the table's commands.

    Raises:
        NothingToEstimate: the table corrects nothing, or no run-up fits into the commands that are allowed.
    """
    applied, run_up = Correction.of(made), made.reversal_command
    command, side = reachable_stops(fit, np.array([row.command for row in made.table]), run_up)
    machine, variance = PredictedAxis(fit, seed), np.full(len(command), reading_u(fit.campaign) ** 2)
    use, scatter = use_over(machine, made.hours, side, variance)

    def at(common: float, play: float) -> PredictedReadings:
        return machine.expected(applied.sent(command, side, common, play), side, use).plus(scatter)

    mean, covariance = at(1.0, 1.0).pooled()
    shift = fit.rows.travel**2 * float(made.shift_free)
    noise = np.minimum(machine.noise(side, variance), 0.999 * np.diag(covariance))
    off = [at(0.0, 0.0).pooled().mean - mean]
    play = at(1.0, 0.0).pooled().mean - mean
    if _distance(play, covariance + shift) > SEPARATE:
        off.append(play)
    if not np.any(off[0]):
        raise NothingToEstimate("no-correction", "the table corrects nothing", remedy="nothing is to be verified")
    common = covariance - np.diag(noise) + shift
    visits, reached = discriminating_visits(off, common, noise, spread_stops(command), IDENTIFIED, PLANNED_MAX)
    return VerifyPlan(planned_stops(command, side, visits), run_up, reached >= IDENTIFIED, float(np.sqrt(reached)))
