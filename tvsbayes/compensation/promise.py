"""A two-sided table from a fit in the terms of a format, and the promise: the bound of errors after applying it.

The table is of one state, the campaign's mean, for all positions and both sides. The promise is the 95 % quantile of
single readings over the posterior and over use: time since homing, travel and temperature as in the campaign, the
limits of the format and rounding by the controller included. Where one homing was read, it is of errors less one common
shift (`statistics.predicted_readings.frees_shift`). Commands in the campaign's counts, all else in its unit. No JAX.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from msgspec import structs

from tvsbayes.compensation.correction import Correction
from tvsbayes.compensation.formats import FORMATS, LINUXCNC_DECIMALS, Format, Origin, Wish, checked, number
from tvsbayes.compensation.periodic_error import drive_compensation, known_waves, strongest_period
from tvsbayes.errors import InputError, NotConverged
from tvsbayes.files.packages import own_version
from tvsbayes.progress import Job, Show
from tvsbayes.results.compensation_record import CAUSES, Compensation, SidePromise, TableRow
from tvsbayes.single_axis.axis_campaign import TURNS, AxisCampaign, axis_hashes, read_axis
from tvsbayes.single_axis.axis_density import line_weights
from tvsbayes.single_axis.axis_fit import AxisFit
from tvsbayes.single_axis.axis_record import AxisResults, results_for
from tvsbayes.single_axis.axis_rows import AxisRows
from tvsbayes.single_axis.predicted_stops import PredictedAxis
from tvsbayes.statistics.intervals import NORMAL_95, absolute_bound95
from tvsbayes.statistics.predicted_readings import PredictedMachine, PredictedReadings, frees_shift
from tvsbayes.statistics.streams import Stream, random_stream

NODES_FEW, NODES_MANY = 13, 41
"""Least and largest number of lines of a table: positions read, and midpoints where these are few."""
PERIOD_NODES, PHASE_NODES, PERIODS_MAX = 129, 33, 4
"""Nodes of a pec table over the range, of a table by phase over its period, and most periods averaged for that."""
OF_PHASE = "a table by phase holds both sides of what repeats with its period; ratio and all else stay"
TRIED, STATES = 20, 2
"""Number of commands at which the promise is evaluated, from each side, and of states of use at each."""
TRIED_STOPS = 2 * TRIED * STATES
"""Number of stops of a use at which the promise is evaluated."""
UNIT_COMMANDS = 0.2
"""Largest difference of the ratio from 1 or -1 for commands to count in the unit of readings."""
ONE_SIDED = "every stop was read from one side: the play is not determined; its prior sets the error on the other side"
BY_POSITION = (
    "the axis goes round: the table is by position, for the turns read alone; one by phase, both sides, is "
    "`--to csv --period N` (or header), N the commands of a turn, about {}"
)
SIDES = (("forward", 1), ("backward", -1))


class _Expected(NamedTuple):
    """Readings expected at commands (m,) at the table's state: mean and variance by side, (2, m), forward first."""

    command: np.ndarray
    mean: np.ndarray
    variance: np.ndarray


def _both_sides(machine: PredictedMachine, commands: np.ndarray) -> PredictedReadings:
    """Predict readings at commands (m,) from both sides, (2 m,), forward first."""
    return machine.expected(np.tile(commands, 2), np.repeat([1, -1], len(commands)))


def _expected(machine: PredictedMachine, commands: np.ndarray) -> _Expected:
    mean, covariance = _both_sides(machine, commands).pooled()
    return _Expected(commands, mean.reshape(2, -1), np.diag(covariance).reshape(2, -1))


def run_up_of(machine: PredictedMachine, commands: np.ndarray, fitted: float, resolution: float = 0.0) -> float:
    """Compute the travel, commands, after which an arrival is on one side: the play's upper end, and a margin.

    The margin is a step of the controller where one is known, else the scatter of stops.
    """
    readings = _both_sides(machine, commands)
    apart = np.concatenate([np.eye(len(commands)), -np.eye(len(commands))], axis=1)
    variance = np.diagonal(apart @ readings.covariance @ apart.T, axis1=1, axis2=2)
    gap = np.abs(readings.mean @ apart.T) + NORMAL_95 * np.sqrt(np.maximum(variance, 0.0))
    counts = np.array_equal(commands, np.round(commands)) and abs(abs(fitted) - 1.0) > UNIT_COMMANDS
    step = resolution or float(counts)
    if not step:
        scatter = machine.scatter(np.array([1, -1]), machine.state, 0.0)["stops"]
        step = NORMAL_95 * float(np.sqrt(np.diagonal(scatter, axis1=1, axis2=2).mean(axis=0).max())) / abs(fitted)
    return float(np.quantile(gap, 0.975, axis=0).max()) / abs(fitted) + step


SURER = "run `tvsbayes fit` again, without --no-sample or --quick"
"""How an axis gets an accepted answer."""


def refuse_answer(
    answer: str,
    remedy: str = f"{SURER}, then compensate",
    reason: str = "the promise of a table made of it cannot be trusted",
) -> None:
    """Refuse a fit without an accepted answer, since its table would move a machine.

    Args:
        answer: answer of the fit.
        remedy: how to obtain an accepted one, and what then.
        reason: why none will do.

    Raises:
        NotConverged: the answer is rough, or a Laplace approximation.
    """
    if answer != "accepted":
        what = "a rough answer" if answer == "rough" else "a Laplace approximation"
        raise NotConverged("unaccepted", f"the fit is {what}, not an accepted answer: {reason}", remedy=remedy)


def _nominal(campaign: AxisCampaign, fitted: float, wish: Wish) -> float:
    """Return the aimed reading per command."""
    if wish.per_command is not None:
        return wish.per_command
    if "per_command" in campaign.stated:
        return campaign.stated["per_command"].value
    if abs(abs(fitted) - 1.0) < UNIT_COMMANDS:
        return float(np.sign(fitted))
    return fitted


def table_commands(rows: AxisRows) -> np.ndarray:
    """Choose commands of a table: those read, thinned if many, with midpoints if few."""
    commands = rows.positions
    if len(commands) > NODES_MANY:
        commands = commands[np.linspace(0, len(commands) - 1, NODES_MANY).round().astype(int)]
    while len(commands) < NODES_FEW:
        commands = np.sort(np.r_[commands, 0.5 * (commands[1:] + commands[:-1])])
    return commands


type _Shaped = tuple[Correction, dict[str, float]]
"""Errors in the terms of a format: a correction without rounding of commands, the format's numbers."""


def _shaped(form: Format, at: _Expected, nominal: float, wish: Wish, fit: AxisFit, fitted: float) -> _Shaped:
    """Express the errors in the terms of a format, as corrections of commands."""
    command = at.command
    if form.holds == "table":
        offset = _offset(at, nominal)
        forward, backward = _rounded((offset + nominal * command - at.mean) / fitted, nominal, wish.target)
        return Correction(command, forward, backward, wish.resolution), {}
    if form.holds == "period":
        return _folded(at, fitted, float(wish.period or 0.0), wish.resolution)
    # The line of the format, through command 0, up to one shift.
    slope = float(np.polyfit(command, at.mean.mean(axis=0), 1)[0])
    play = float(np.mean(at.mean[1] - at.mean[0])) * float(np.sign(slope))
    factor, taken, settings = nominal / slope, 0.0, {}
    axis, in_force = "XYZABC".index(wish.letter), wish.in_force or 1.0
    if wish.target in ("grbl", "grblhal"):
        settings[f"${100 + axis}"] = round(in_force * factor, 3)
        factor = settings[f"${100 + axis}"] / in_force
    if wish.target == "grblhal" and fit.rows.both_sides:
        taken = settings[f"${160 + axis}"] = max(round(play, 3), 0.0)
    if wish.target == "klipper":
        settings["rotation_distance"] = round(in_force / factor, 6)
        factor = in_force / settings["rotation_distance"]
    if wish.target == "urdf":
        settings = {**_joint(fit), "axis_backlash": play}
    half = 0.5 * taken / abs(slope)
    added = (factor - 1) * command
    return Correction(command, added + half, added - half, wish.resolution), settings


def _joint(fit: AxisFit) -> dict[str, float]:
    """Compute zero and reduction of a joint with their covariance, from draws of the line through the readings."""
    model = fit.model
    slope = model.line_terms(per_command=1.0) + line_weights(model, fit.w)
    level = model.line_terms(offset=1.0) + model.functional(fit.rows.command, fit.w).mean(axis=-2)
    both = np.stack([level - model.middle * slope, slope], axis=-2)
    line = fit.linear.drawn(both, random_stream(fit.seed, Stream.PROMISE))
    joint = np.column_stack([line[:, 0], 1.0 / line[:, 1]])
    covariance = np.cov(joint.T)
    return {
        "axis_zero": float(joint[:, 0].mean()),
        "axis_reduction": float(joint[:, 1].mean()),
        "u_axis_zero": float(np.sqrt(covariance[0, 0])),
        "u_axis_reduction": float(np.sqrt(covariance[1, 1])),
        "covariance_zero_reduction": float(covariance[0, 1]),
    }


def _rounded(added: np.ndarray, nominal: float, target: str) -> np.ndarray:
    """Round corrections (2, m) as in the file: LinuxCNC's are in units, with a fixed number of decimals."""
    if target == "linuxcnc":
        return np.round(added * nominal, LINUXCNC_DECIMALS) / nominal
    return np.array([[float(number(v)) for v in side] for side in added])


def _offset(at: _Expected, nominal: float) -> float:
    """Compute the offset of the aimed line, for which both sides' mean at the command nearest to 0 is correct."""
    nearest = int(np.argmin(np.abs(at.command)))
    return float(at.mean[:, nearest].mean() - nominal * at.command[nearest])


def _folded(at: _Expected, fitted: float, period: float, resolution: float) -> _Shaped:
    """Average both sides' mean error from its line over periods.

    Raises:
        InputError: the range is shorter than a period, or the table too coarse for it.
    """
    low, high = float(at.command[0]), float(at.command[-1])
    _refuse_period(period, float(np.max(np.diff(at.command))), high - low)
    middle = at.mean.mean(axis=0)
    off = middle - np.polyval(np.polyfit(at.command, middle, 1), at.command)
    # The mean over periods is fitted by harmonics.
    amplitudes = np.linalg.lstsq(_harmonics(at.command, period), off, rcond=None)[0]
    command = np.linspace(low, high, PERIOD_NODES)
    added = -_harmonics(command, period) @ amplitudes / fitted
    return Correction(command, added, added, resolution), {"period_command": period}


def _by_phase(
    machine: PredictedMachine, rows: AxisRows, fitted: float, period: float, resolution: float
) -> tuple[_Expected, Correction, float]:
    """Average each side's errors from one line over periods: readings of the first one, correction, line's slope.

    The line's slope is that beside four harmonics of the period, where more than one period was read.

    Raises:
        InputError: the range is shorter than a period, or its phases are read too coarsely.
    """
    low, high = float(rows.positions[0]), float(rows.positions[-1])
    phases = np.sort(np.mod(rows.positions - low, period)) if period > 0 else np.zeros(1)
    gap = float(np.max(np.diff(phases, append=phases[0] + period)))
    _refuse_period(period, gap, high - low)
    nodes = low + period * np.linspace(0.0, 1.0, PHASE_NODES)
    periods = np.linspace(0, (high - low) // period - 1, PERIODS_MAX).round()
    each = [_expected(machine, nodes + k * period) for k in np.unique(periods)]
    command, mean, variance = map(np.array, zip(*each, strict=True))
    at_once, middle = command.ravel(), mean.mean(axis=1).ravel()
    waves = _harmonics(at_once, period) if len(each) > 1 else np.zeros((len(at_once), 0))
    line = np.linalg.lstsq(np.column_stack([at_once, np.ones_like(at_once), waves]), middle, rcond=None)[0][:2]
    off = (mean - np.polyval(line, command)[:, None]).mean(axis=0)
    off[:, [0, -1]] = off[:, [0, -1]].mean(axis=1, keepdims=True)
    forward, backward = _rounded(-off / fitted, 1.0, "csv")
    correction = Correction(nodes, forward, backward, resolution, period)
    return _Expected(nodes, np.polyval(line, nodes) + off, variance.mean(axis=0)), correction, float(line[0])


def _harmonics(command: np.ndarray, period: float) -> np.ndarray:
    """Cosines and sines of the first four harmonics of a period at commands (m,), shape (m, 8)."""
    phase = 2 * np.pi * command / period
    return np.column_stack([f(k * phase) for k in range(1, 5) for f in (np.cos, np.sin)])


def _refuse_period(period: float, spacing: float, length: float) -> None:
    """Refuse a period that the positions read do not resolve, or that exceeds their range."""
    if not 8 * spacing <= period <= length:
        message = f"--period {period:g}: positions every {spacing:g} commands over {length:g}"
        allowed = "at least eight positions in a period, and a whole period in the range"
        remedy = f"state a period from {8 * spacing:g} to {length:g} commands, or read more positions"
        raise InputError("usage", message, allowed=allowed, remedy=remedy)


def bound_of(stops: PredictedReadings, aim: np.ndarray, members: np.ndarray, shift: bool = False) -> float:
    """Compute the bound of 95 % of the errors of some stops.

    Args:
        stops: predicted stops.
        aim: aimed readings, shape (r,).
        members: numbers of the stops.
        shift: whether one shift common to all stops is removed.
    """
    errors = PredictedReadings(stops.mean - aim, stops.covariance)
    errors = errors.centred() if shift else errors
    variance = np.maximum(np.diagonal(errors.covariance, axis1=1, axis2=2), 0.0)
    return absolute_bound95(errors.mean[:, members].ravel(), np.sqrt(variance[:, members]).ravel())


@dataclass(frozen=True)
class TriedUse:
    """Stops of a use at which the promise is evaluated.

    Attributes:
        side: side of arrival, shape (r,).
        after, before: repeatable part with the table and without it, at the states of the use.
        table: the same with the table, at the table's state.
        shifts: what the states add, by cause.
        scatter: covariances of what does not repeat, by cause.
        aim: aimed readings, shape (r,).
    """

    side: np.ndarray
    after: PredictedReadings
    before: PredictedReadings
    table: PredictedReadings
    shifts: dict[str, PredictedReadings]
    scatter: dict[str, np.ndarray]
    aim: np.ndarray

    def homed(self, stops: PredictedReadings) -> PredictedReadings:
        """Single readings after a homing."""
        return stops.plus(sum(self.scatter.values()))

    def added_variance(self, shift: bool) -> np.ndarray:
        """Variance (r,) of a single arrival beyond that of the table; without the homing where a shift is free."""
        left_out = {"readings", "homing"} if shift else {"readings"}
        parts = [each for cause, each in self.scatter.items() if cause not in left_out]
        used, table = (stops.centred() if shift else stops for stops in (self.after, self.table))
        centre = table.mean.mean(axis=0)
        used_square, table_square = (
            np.mean(np.diagonal(stops.covariance, axis1=1, axis2=2) + (stops.mean - centre) ** 2)
            for stops in (used, table)
        )
        scatter: np.ndarray = np.diagonal(sum(parts), axis1=1, axis2=2).mean(axis=0)
        return scatter + max(float(used_square - table_square), 0.0)


def promised_sides(tried: TriedUse, shift: bool, zero_free: bool) -> dict[str, SidePromise]:
    """Compute the remaining errors, forward and backward, and those due to each cause alone.

    Args:
        tried: stops of a use.
        shift: whether the first figure is of errors less one common shift.
        zero_free: whether every figure is.
    """
    after, before = tried.homed(tried.after), tried.homed(tried.before)
    none = np.zeros_like(tried.aim)
    pooled = tried.table.pooled().mean
    left = pooled - tried.aim - (np.mean(pooled - tried.aim) if shift else 0.0)
    alone = {"table": PredictedReadings(tried.table.mean - pooled, tried.table.covariance), **tried.shifts}
    alone |= {c: PredictedReadings(np.zeros_like(tried.table.mean), v) for c, v in tried.scatter.items()}
    used = PredictedReadings(after.mean - tried.aim, after.covariance)
    used = used.centred() if shift else used
    sides = {}
    for name, side in SIDES:
        mine = np.flatnonzero(tried.side == side)
        causes = {c: bound_of(each, none, mine, shift and c != "homing") for c, each in alone.items()}
        causes["format"] = float(NORMAL_95 * np.sqrt(np.mean(left[mine] ** 2)))
        variance = np.diagonal(used.covariance, axis1=1, axis2=2)
        sides[name] = SidePromise(
            error95=bound_of(after, tried.aim, mine, shift),
            rms=float(np.sqrt(np.mean((used.mean**2 + variance)[:, mine]))),
            without95=bound_of(before, tried.aim, mine, shift),
            causes={cause: causes.get(cause, 0.0) for cause in CAUSES},
            shift_free95=bound_of(after, tried.aim, mine, True),
            error95_with_homing=bound_of(after, tried.aim, mine, zero_free),
        )
    return sides


def reading_u(campaign: AxisCampaign) -> float:
    """Return the median u of the campaign's readings."""
    return float(np.median([r.u for r in campaign.noisy if r.status == "ok"]))


def compensation_of(results: AxisResults, wish: Wish, *, seed: int = 0, progress: Show | None = None) -> Compensation:
    """Build the table and its promise.

    Args:
        results: results of an accepted fit.
        wish: options of the compensation.
        seed: seed of all draws.
        progress: receives the progress.

    Raises:
        InputError: the format is unknown, or a number is missing.
        NotConverged: the fit is not accepted.
    """
    refuse_answer(results.summary.answer)
    fit, campaign = results.fit, results.fit.campaign
    if fit.rows.in_motion:
        checked(wish)
        return drive_compensation(fit, wish)
    rows, machine = fit.rows, PredictedAxis(fit, seed)
    fitted = float(fit.draws["effective_per_command"].mean())
    form = checked(wish)
    if form.holds == "period" and wish.period is None:
        wish = replace(wish, period=strongest_period(rows, known_waves(fit)))
    if wish.per_command is not None and not (np.isfinite(wish.per_command) and wish.per_command * fitted > 0):
        message = f"--per-command {wish.per_command:g}: the readings change by {fitted:.6g} per command"
        raise InputError("usage", message, remedy="give the nominal ratio with the sign of the readings")
    nominal = _nominal(campaign, fitted, wish)
    low, high = float(rows.positions[0]), float(rows.positions[-1])
    shift = form.zero_free or frees_shift(machine.homings)
    with Job({"table": 1.0, "promise": 2.0}, progress) as job:
        job.begin("table")
        by_phase = form.holds == "table" and wish.period is not None
        if by_phase:
            period = float(wish.period or 0.0)
            at, correction, slope = _by_phase(machine, rows, fitted, period, wish.resolution)
            nominal, settings, aim = _nominal(campaign, slope, wish), {"period_command": period}, None
        else:
            at = _expected(machine, table_commands(rows))
            correction, settings = _shaped(form, at, nominal, wish, fit, fitted)
            aim = _offset(at, nominal) if form.holds == "table" else None
        job.begin("promise")
        offset, tried = tried_use(machine, correction, (low, high), (aim, nominal), reading_u(campaign), seed)
        promise = promised_sides(tried, shift, form.zero_free)
        run_up = run_up_of(machine, rows.positions, fitted, wish.resolution)
    added = tried.added_variance(shift)
    by_side = np.array([added[tried.side == side].mean() for _, side in SIDES])
    use, turn = machine.use, TURNS.get(campaign.unit, 0.0) / abs(fitted)
    goes_round = form.holds == "table" and not by_phase and campaign.unit in TURNS and high - low >= turn
    return Compensation(
        target=wish.target,
        machine=str(campaign.header.get("serial") or campaign.header.get("name") or ""),
        unit=campaign.unit,
        applied_by=wish.applied_by,
        per_command=nominal,
        offset=offset,
        zero_free=form.zero_free,
        range_command=(low, high),
        resolution=wish.resolution,
        reversal_command=run_up,
        hours=use.hours,
        travel_command=use.travel,
        homings=machine.homings,
        table=_table(at._replace(variance=at.variance + by_side[:, None]), correction),
        settings=settings,
        promise=promise,
        unsaid=(
            *form.unsaid,
            *((OF_PHASE,) if by_phase else ()),
            *((BY_POSITION.format(number(turn, 4)),) if goes_round else ()),
            *(() if rows.both_sides else (ONE_SIDED,)),
            *_unreachable(campaign, low, high, run_up),
        ),
        state={name: float(value) for name, value in machine.state._asdict().items()},
        kelvin=use.kelvin if rows.kelvin is not None else None,
    )


def tried_use(
    machine: PredictedMachine,
    correction: Correction,
    between: tuple[float, float],
    aimed: tuple[float | None, float],
    u: float,
    seed: int,
) -> tuple[float, TriedUse]:
    """Predict a use; offset and stops. `aimed` is the line of the aim; without its offset errors have the mean 0."""
    low, high = between
    # Commands between the lines of the table are tested too.
    places = low + (high - low) * (np.arange(TRIED) + 0.5) / TRIED
    command, side = np.tile(np.repeat(places, 2), STATES), np.tile([1, -1], TRIED * STATES)
    sent = correction.sent(command, side)
    table = machine.expected(sent, side)
    offset, nominal = aimed
    if offset is None:
        offset = float((table.pooled().mean - nominal * command).mean())
    states = machine.use.states(len(table.mean), len(command), random_stream(seed, Stream.PROMISE, 1))
    return offset, TriedUse(
        side=side,
        after=machine.expected(sent, side, states),
        before=machine.expected(command, side, states),
        table=table,
        shifts=machine.shifts(states, machine.state),
        scatter=machine.scatter(side, states, u),
        aim=offset + nominal * command,
    )


def _unreachable(campaign: AxisCampaign, low: float, high: float, run_up: float) -> tuple[str, ...]:
    """Say where the table's range leaves no room for a run-up."""
    least, most = campaign.range_allowed
    ends = [f"arriving forward below {number(least + run_up, 6)}"] if low - run_up < least else []
    ends += [f"arriving backward above {number(most - run_up, 6)}"] if high + run_up > most else []
    if not ends:
        return ()
    where = "`limits` of [axis]" if campaign.limits else "the commands that were made"
    return (f"{' and '.join(ends)} needs a run-up beyond {where}: the promise is for arrivals with one",)


def _table(at: _Expected, correction: Correction) -> tuple[TableRow, ...]:
    """Build the lines of the table at the commands of the correction."""
    mean = [np.interp(correction.command, at.command, side) for side in at.mean]
    u = [np.interp(correction.command, at.command, np.sqrt(side)) for side in at.variance]
    columns = (correction.command, *mean, *u, correction.forward, correction.backward)
    return tuple(TableRow(*map(float, values)) for values in zip(*columns, strict=True))


def compensate(
    folder: AxisCampaign | Path | str, to: str = "csv", *, seed: int = 0, progress: Show | None = None, **wish: object
) -> Compensation:
    """Compensate an axis folder: its table, the promise, and in `text` the file for a controller.

    Args:
        folder: folder of an axis, or the result of `read_axis`; its `results/` are used if they belong to its data.
        to: "csv", "linuxcnc", "grbl", "grblhal", "klipper", "header", "urdf" or "pec".
        seed: seed of all draws.
        progress: receives the progress.
        wish: further fields of `Wish`.

    Raises:
        InputError: the folder or an option cannot be used.
        NotConverged: the fit is not accepted.
        NothingToEstimate: the folder has too few readings.
    """
    campaign = folder if isinstance(folder, AxisCampaign) else read_axis(folder)
    wanted = Wish(target=to, **wish)  # type: ignore[arg-type]
    checked(wanted)
    with Job({"fit": 1.0, "compensation": 1.0}, progress) as job:
        results = results_for(campaign, progress=job.part("fit"), seed=seed)
        made = compensation_of(results, wanted, seed=seed, progress=job.part("compensation"))
    return structs.replace(made, text=file_text(made, campaign))


def origin_of(campaign: AxisCampaign) -> Origin:
    """Program, folder and data of a table's file."""
    digest = hashlib.sha256("".join(sorted(axis_hashes(campaign).values())).encode()).hexdigest()
    name = campaign.path.name if campaign.path else "a campaign"
    return Origin(f"tvsbayes {own_version()} of {name}", digest)


def file_text(made: Compensation, campaign: AxisCampaign) -> str:
    """Return the content of the file."""
    return FORMATS[made.target].write(made, origin_of(campaign))


def file_beside(made: Compensation, campaign: AxisCampaign) -> str | None:
    """Return the content of the second file, YAML; None where the format has none."""
    beside = FORMATS[made.target].beside
    return None if beside is None else beside(made, origin_of(campaign))
