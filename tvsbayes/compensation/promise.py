"""A two-sided table from a fit in the terms of a format, and the promise: the bound of errors after applying it.

The promise is a prediction of readings, not of means. It includes error by position, play and its variation, scatter of
stops, homing and drift since then, and the uncertainty of all of them. Limits of the format and rounding by the
controller are included too. Commands in the campaign's counts, all else in its unit. No JAX.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from msgspec import structs

from tvsbayes.compensation.correction import Correction, Cycles, cycles
from tvsbayes.compensation.formats import FORMATS, LINUXCNC_DECIMALS, Format, Origin, Wish, checked, number
from tvsbayes.compensation.periodic_error import drive_compensation, known_waves, strongest_period
from tvsbayes.errors import InputError, NotConverged
from tvsbayes.files.packages import own_version
from tvsbayes.progress import Job, Show
from tvsbayes.results.compensation_record import Compensation, SidePromise, TableRow
from tvsbayes.single_axis.axis_campaign import AxisCampaign, AxisMove, axis_hashes, read_axis
from tvsbayes.single_axis.axis_density import line_weights
from tvsbayes.single_axis.axis_fit import AxisFit
from tvsbayes.single_axis.axis_record import AxisResults, results_for
from tvsbayes.single_axis.axis_rows import HOUR_S, AxisRows, legs_of
from tvsbayes.single_axis.predicted_stops import PredictedStops, predicted_stops
from tvsbayes.statistics.intervals import NORMAL_95, absolute_bound95
from tvsbayes.statistics.predicted_readings import PredictedReadings
from tvsbayes.statistics.streams import Stream, random_stream

NODES_FEW, NODES_MANY = 13, 41
"""Least and largest number of lines of a table: positions read, and midpoints where these are few."""
PERIOD_NODES = 129
"""Nodes of a period's table over the range."""
TRIED = 20
"""Number of commands at which the promise is evaluated, from each side."""
UNIT_COMMANDS = 0.2
"""Largest difference of the ratio from 1 or -1 for commands to count in the unit of readings."""
ONE_SIDED = "every stop was read from one side: the play is not determined; its prior sets the error on the other side"
RUNS_MAX = 20
"""Largest number of runs up and down in a prediction; a longer travel is not predicted."""
SIDES = (("forward", 1), ("backward", -1))


@dataclass(frozen=True)
class _Expected:
    """Readings expected at commands (m,): mean and u by side, (2, m) each, forward first; whether both were read."""

    command: np.ndarray
    mean: np.ndarray
    u: np.ndarray
    both_sides: bool


def _expected(fit: AxisFit, commands: np.ndarray, run_up: float, since: Since, seed: int) -> _Expected:
    """Predict readings at the table's commands, without the noise of a reading."""
    run = since.cycles(commands, run_up)
    mean, covariance = _predicted(fit, run, None, 0.0, seed).pooled()
    order = [np.flatnonzero(run.side == side)[np.argsort(run.index[run.side == side])] for _, side in SIDES]
    u = np.sqrt(np.diag(covariance))
    return _Expected(commands, np.array([mean[o] for o in order]), np.array([u[o] for o in order]), fit.rows.both_sides)


@dataclass(frozen=True)
class Since:
    """Use of a machine between two homings: hours, and commands travelled."""

    hours: float
    travel: float

    @classmethod
    def of(cls, moves: Sequence[AxisMove]) -> Since:
        """Return the largest values over a campaign's segments."""
        legs = legs_of(moves)
        time_s = np.array([move.time_s for move in moves])
        each = [np.flatnonzero(legs.segment == segment) for segment in np.unique(legs.segment)]
        hours = max(float(np.ptp(time_s[members])) for members in each) / HOUR_S
        return cls(hours, max(float(np.abs(legs.step[members]).sum()) for members in each))

    def cycles(self, commands: np.ndarray, run_up: float) -> Cycles:
        """Build as many runs through commands as make up the travel."""
        once = 2.0 * (float(np.ptp(commands)) + 2.0 * run_up)
        return cycles(commands, run_up, self.hours, max(1, min(round(self.travel / once), RUNS_MAX)))


def _predicted(fit: AxisFit, run: Cycles, applied: Correction | None, u: float, seed: int) -> PredictedStops:
    """Predict runs up and down, under a correction."""
    moves = run.moves if applied is None else applied.moved(run.moves)
    return predicted_stops(fit, moves, run.read.tolist(), np.full(len(run.read), u), seed)


def refuse_answer(answer: str, remedy: str = "run `tvsbayes fit` again, without --no-sample or --quick") -> None:
    """Refuse a fit without an accepted answer, since its table would move a machine.

    Args:
        answer: answer of the fit.
        remedy: how to obtain an accepted one.

    Raises:
        NotConverged: the answer is rough, or a Laplace approximation.
    """
    if answer != "accepted":
        what = "a rough answer" if answer == "rough" else "a Laplace approximation"
        message = f"the fit is {what}, not an accepted answer: the promise of a table made of it cannot be trusted"
        raise NotConverged("unaccepted", message, remedy=f"{remedy}, then compensate")


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


@dataclass(frozen=True)
class _Shaped:
    """Errors in the terms of a format: a correction without rounding, and the format's numbers."""

    correction: Correction
    settings: dict[str, float] = field(default_factory=dict)


def _shaped(form: Format, at: _Expected, nominal: float, fitted: float, wish: Wish, line: np.ndarray) -> _Shaped:
    """Express the errors in the terms of a format, as corrections of commands."""
    command = at.command
    if form.holds == "table":
        offset = _offset(at, nominal)
        forward, backward = _rounded((offset + nominal * command - at.mean) / fitted, nominal, wish.target)
        return _Shaped(Correction(command, forward, backward, wish.resolution))
    middle = at.mean.mean(axis=0)
    if form.holds == "period":
        return _folded(at, fitted, float(wish.period or 0.0), wish.resolution)
    # The line of the format, through command 0, up to one shift.
    slope = float(np.polyfit(command, middle, 1)[0])
    play = float(np.mean(at.mean[1] - at.mean[0])) * float(np.sign(slope))
    factor, taken, settings = nominal / slope, 0.0, {}
    axis, in_force = "XYZABC".index(wish.letter), wish.in_force or 1.0
    if wish.target in ("grbl", "grblhal"):
        settings[f"${100 + axis}"] = round(in_force * factor, 3)
        factor = settings[f"${100 + axis}"] / in_force
    if wish.target == "grblhal" and at.both_sides:
        taken = settings[f"${160 + axis}"] = max(round(play, 3), 0.0)
    if wish.target == "klipper":
        settings["rotation_distance"] = round(in_force / factor, 6)
        factor = in_force / settings["rotation_distance"]
    if wish.target == "urdf":
        settings = {**_joint(line), "axis_backlash": play}
    half = 0.5 * taken / abs(slope)
    added = (factor - 1) * command
    return _Shaped(Correction(command, added + half, added - half, wish.resolution), settings)


def _line_draws(fit: AxisFit) -> np.ndarray:
    """Draw zero at command 0 and slope of the line through the readings, (draws, 2)."""
    model = fit.model
    slope = model.line_terms(per_command=1.0) + line_weights(model, fit.w)
    level = model.line_terms(offset=1.0) + model.functional(fit.rows.command, fit.w).mean(axis=-2)
    both = np.stack([level - model.middle * slope, slope], axis=-2)
    return fit.linear.drawn(both, random_stream(fit.seed, Stream.PROMISE))


def _joint(line: np.ndarray) -> dict[str, float]:
    """Compute zero and reduction of a joint with their covariance, from draws (n, 2) of zero and unit per command."""
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
    spacing = float(np.max(np.diff(at.command)))
    if not 8 * spacing <= period <= high - low:
        message = f"--period {period:g}: positions every {spacing:g} commands over {high - low:g}"
        allowed = "at least eight positions in a period, and a whole period in the range"
        remedy = f"state a period from {8 * spacing:g} to {high - low:g} commands, or read more positions"
        raise InputError("usage", message, allowed=allowed, remedy=remedy)
    middle = at.mean.mean(axis=0)
    off = middle - np.polyval(np.polyfit(at.command, middle, 1), at.command)

    def waves(command: np.ndarray) -> np.ndarray:
        # The mean over periods is fitted by four harmonics.
        phase = 2 * np.pi * command / period
        return np.column_stack([f(k * phase) for k in range(1, 5) for f in (np.cos, np.sin)])

    amplitudes = np.linalg.lstsq(waves(at.command), off, rcond=None)[0]
    command = np.linspace(low, high, PERIOD_NODES)
    added = -waves(command) @ amplitudes / fitted
    return _Shaped(Correction(command, added, added, resolution), {"period_command": period})


def bound_of(stops: PredictedReadings, aim: np.ndarray, members: np.ndarray, shift: bool = False) -> float:
    """Compute the bound of 95 % of the errors of some stops.

    Args:
        stops: predicted stops.
        aim: aimed readings, shape (r,).
        members: numbers of the stops.
        shift: whether one shift common to all stops is removed.
    """
    mean, covariance = stops.mean - aim, stops.covariance
    if shift:
        centre = np.eye(mean.shape[1]) - 1.0 / mean.shape[1]
        mean, covariance = mean @ centre, centre @ covariance @ centre
    variance = np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0)
    return absolute_bound95(mean[:, members].ravel(), np.sqrt(variance[:, members]).ravel())


def _promise(
    after: PredictedStops, before: PredictedStops, run: Cycles, aim: np.ndarray, u: float, shift: bool
) -> dict[str, SidePromise]:
    """Compute the remaining errors by side, and those due to each cause alone."""
    sides = {}
    scales = after.scales
    pooled, covariance = after.pooled()
    hours = np.array([run.moves[k].time_s for k in run.read]) / HOUR_S
    for name, side in SIDES:
        mine = np.flatnonzero(run.side == side)
        n = len(mine)
        stops = scales[f"stop_sd.{name}"][:, None] * np.ones(n)
        home = scales["home_sd"][:, None] * np.ones(n)
        drift = scales["drift_per_root_hour"][:, None] * np.sqrt(hours[mine])
        reading = scales["reading_scale"][:, None] * u * np.ones(n)
        variance = np.diagonal(after.covariance, axis1=1, axis2=2)[:, mine]
        rest = np.sqrt(np.maximum(variance - stops**2 - home**2 - drift**2 - reading**2, 0.0))
        zero = np.zeros_like(rest)
        causes = {
            "table": absolute_bound95((after.mean - pooled)[:, mine].ravel(), rest.ravel()),
            "format": float(NORMAL_95 * np.sqrt(np.mean((pooled - aim)[mine] ** 2))),
            **{
                cause: absolute_bound95(zero.ravel(), sd.ravel())
                for cause, sd in (("stops", stops), ("homing", home), ("drift", drift), ("readings", reading))
            },
        }
        sides[name] = SidePromise(
            error95=bound_of(after, aim, mine, shift),
            rms=float(np.sqrt(np.mean((pooled - aim)[mine] ** 2 + np.diag(covariance)[mine]))),
            without95=bound_of(before, aim, mine, shift),
            causes=causes,
            shift_free95=bound_of(after, aim, mine, shift=True),
        )
    return sides


def reading_u(campaign: AxisCampaign) -> float:
    """Return the median u of the campaign's readings."""
    return float(np.median([r.u for r in campaign.readings if r.status == "ok"]))


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
    rows, since = fit.rows, Since.of(campaign.moves)
    draws = fit.draws["effective_per_command"]
    fitted = float(draws.mean())
    form = checked(wish)
    if form.holds == "period" and wish.period is None:
        wish = replace(wish, period=strongest_period(rows, known_waves(fit)))
    if wish.per_command is not None and not (np.isfinite(wish.per_command) and wish.per_command * fitted > 0):
        message = f"--per-command {wish.per_command:g}: the readings change by {fitted:.6g} per command"
        raise InputError("usage", message, remedy="give the nominal ratio with the sign of the readings")
    nominal = _nominal(campaign, fitted, wish)
    low, high = float(rows.positions[0]), float(rows.positions[-1])
    with Job({"table": 1.0, "promise": 2.0}, progress) as job:
        job.begin("table")
        far = 0.05 * (high - low) + 2.0 * abs(float(fit.draws["backlash"].mean()) / fitted)
        at = _expected(fit, table_commands(rows), far, since, seed)
        gap = np.abs(at.mean[0] - at.mean[1]) + NORMAL_95 * np.hypot(*at.u)
        run_up = float(np.max(gap)) / abs(fitted)
        shaped = _shaped(form, at, nominal, fitted, wish, _line_draws(fit))
        job.begin("promise")
        u = reading_u(campaign)
        # Commands between the lines of the table are tested too.
        tried = low + (high - low) * (np.arange(TRIED) + 0.5) / TRIED
        run = since.cycles(tried, max(far, run_up))
        after = _predicted(fit, run, shaped.correction, u, seed)
        job.at(0.5)
        before = _predicted(fit, run, None, u, seed)
        tried_aim = nominal * tried[run.index]
        offset = _offset(at, nominal) if form.holds == "table" else float((after.pooled().mean - tried_aim).mean())
        promise = _promise(after, before, run, offset + tried_aim, u, form.zero_free)
    table = _table(at, shaped.correction)
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
        hours=since.hours,
        travel_command=since.travel,
        homings=len(np.unique(rows.segment)),
        table=table,
        settings=shaped.settings,
        promise=promise,
        unsaid=(*form.unsaid, *(() if rows.both_sides else (ONE_SIDED,)), *_unreachable(campaign, low, high, run_up)),
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
    u = [np.interp(correction.command, at.command, side) for side in at.u]
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


def _origin(campaign: AxisCampaign) -> Origin:
    digest = hashlib.sha256("".join(sorted(axis_hashes(campaign).values())).encode()).hexdigest()
    name = campaign.path.name if campaign.path else "a campaign"
    return Origin(f"tvsbayes {own_version()} of {name}", digest)


def file_text(made: Compensation, campaign: AxisCampaign) -> str:
    """Return the content of the file."""
    return FORMATS[made.target].write(made, _origin(campaign))


def file_beside(made: Compensation, campaign: AxisCampaign) -> str | None:
    """Return the content of the second file, YAML; None where the format has none."""
    beside = FORMATS[made.target].beside
    return None if beside is None else beside(made, _origin(campaign))
