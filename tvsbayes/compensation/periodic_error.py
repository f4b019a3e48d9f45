"""Compensation of a drive at constant rate: a table of errors that repeat with one period, and the remaining errors.

A tracking drive never stops or reverses; its controller can correct errors that repeat with a turn of its worm. The
table is the expected wave over one period in the middle of the record, where its phase is best determined. The promise
bounds errors from the drive's own line, up to one shift, within a period of its slowest wave. Commands in the
campaign's counts, all else in its unit. No JAX.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tvsbayes.compensation.correction import Correction
from tvsbayes.compensation.formats import FORMATS, Wish
from tvsbayes.errors import InputError, NothingToEstimate
from tvsbayes.gears.states import HOUR_S, crept
from tvsbayes.results.compensation_record import CAUSES, Compensation, SidePromise, TableRow
from tvsbayes.single_axis.axis_fit import AxisFit
from tvsbayes.single_axis.axis_periods import WaveSample, wave_samples
from tvsbayes.single_axis.axis_rows import AxisRows
from tvsbayes.single_axis.waves import wave_columns
from tvsbayes.statistics.intervals import NORMAL_95, absolute_bound95

NODES = 129
"""Number of nodes of the table, both ends of the period included."""
DRAWS, TRIED, TRIED_MAX = 200, 24, 4000
"""Draws for the promise, commands evaluated per period, and the largest number over the record."""
HARMONICS = 8
"""Harmonics of a period in a table: waves of P, P/2 ... P/8."""
SLIP_TURNS = 0.25
"""Largest phase difference in turns between wave and table over the record for a wave to be in the table."""
LIKELY = 0.95
"""Probability above which a wave is corrected."""


def known_waves(fit: AxisFit) -> list[WaveSample]:
    """Return the probable waves of the gear, the strongest first."""
    likely = (each for each in wave_samples(fit) if each.probability >= LIKELY and each.wave.clock != "encoder")
    return sorted(likely, key=lambda each: -float(each.amplitude.mean()))


def commands_of(rows: AxisRows, sample: WaveSample) -> float:
    """Compute the mean period of a wave in commands."""
    period = float(np.mean(sample.period[sample.likeliest]))
    return period * abs(rows.rate or 0.0) if sample.wave.clock == "seconds" else period / abs(rows.line.slope)


def strongest_period(rows: AxisRows, waves: Sequence[WaveSample]) -> float:
    """Return the period of the strongest wave by command, in commands; `waves` are from `known_waves`.

    Raises:
        InputError: there is none.
    """
    for sample in waves:
        if rows.in_motion or sample.wave.clock == "position":
            return commands_of(rows, sample)
    message = "--to pec needs a period, and the fit has no wave of the gear"
    remedy = "add --period, in commands; or ask for one by `periods` or `period_between` in [axis], and fit again"
    raise InputError("usage", message, remedy=remedy)


def _waves(fit: AxisFit, samples: Sequence[WaveSample], command: np.ndarray) -> np.ndarray:
    """Compute the sum of waves at commands (m,), by draws: shape (`DRAWS`, m)."""
    rows = fit.rows
    order = np.argsort(rows.command)
    time_s = np.interp(command, rows.command[order], rows.time_s[order])
    total = np.zeros((DRAWS, len(command)))
    for sample in samples:
        drawn = np.linspace(0, len(sample.period) - 1, DRAWS).astype(int)
        at = fit.model.clock(sample.wave, command, time_s, command)
        columns = wave_columns(at, sample.period[drawn], sample.record)
        total += np.einsum("ntc,nc->nt", columns, sample.coefficients[drawn])
    return total


def _creep(fit: AxisFit, values: dict[str, np.ndarray], drawn: np.ndarray, command: np.ndarray) -> np.ndarray:
    """Compute the creep of the zero during warm-up at commands (m,): shape (`DRAWS`, m), zero without creep."""
    if "creep" not in fit.draws:
        return np.zeros((DRAWS, len(command)))
    rows = fit.rows
    order = np.argsort(rows.command)
    minutes = np.interp(command, rows.command[order], rows.warm_s[order]) / 60.0
    return fit.draws["creep"][drawn, None] * crept(minutes, values["creep_minutes"][:, None])


def _off_their_mean(errors: np.ndarray, spans: int) -> np.ndarray:
    """Subtract from errors (n, m) the mean of each span, since a shift is not an error of the table."""
    each = errors.reshape(len(errors), spans, -1)
    return (each - each.mean(axis=-1, keepdims=True)).reshape(errors.shape)


def _span(period: float, record: float, waves: Sequence[float]) -> float:
    """Return the range of the promise in commands: whole periods as long as the slowest wave, within the record."""
    count = max(1, round(max(waves) / period + 0.25))
    return period * min(count, int(record / period))


def drive_compensation(fit: AxisFit, wish: Wish) -> Compensation:
    """Build the table of one period and its promise.

    Raises:
        InputError: the format has no period, a ratio is given, no wave is known, or the period exceeds the record.
        NothingToEstimate: no known wave repeats with the period.
    """
    form = FORMATS[wish.target]
    if form.holds != "period":
        message = f"--to {wish.target}: the readings are of a drive at constant rate, which never stops nor turns back"
        raise InputError("usage", message, allowed="--to pec", remedy="read stops from both sides for other formats")
    if wish.per_command is not None:
        message = f"--per-command {wish.per_command:g}: a table of a drive holds its waves, not its rate"
        raise InputError("usage", message, remedy="leave it out; correct the rate in the controller")
    rows, campaign = fit.rows, fit.campaign
    every = known_waves(fit)
    period = strongest_period(rows, every) if wish.period is None else wish.period
    low, high = float(rows.command.min()), float(rows.command.max())
    if not 0 < period <= high - low:
        message = f"--period {period:g}: the record is {high - low:g} commands long"
        raise InputError("usage", message, allowed="a whole period in the record", remedy="log a longer run")
    turns = (high - low) / period
    kept, lengths = [], [commands_of(rows, sample) for sample in every]
    for sample, length in zip(every, lengths, strict=True):
        ratio = period / length
        if 1 <= round(ratio) <= HARMONICS and abs(ratio - round(ratio)) * turns <= SLIP_TURNS:
            kept.append(sample)
    if not kept:
        raise NothingToEstimate(
            "no-wave",
            f"no wave of the fit has a period of {period:.6g} commands",
            file="campaign.toml",
            remedy="give another --period, or none; `periods` in [axis] asks for one by name, then fit again",
        )
    begins = 0.5 * (low + high - period)
    command = begins + period * np.linspace(0.0, 1.0, NODES)
    offset, slope = rows.line
    wave = _waves(fit, kept, command)
    added = -wave.mean(axis=0) / slope
    correction = Correction(command, added, added, wish.resolution)
    drawn = np.linspace(0, len(fit.w) - 1, DRAWS).astype(int)
    values = fit.model.coordinates.values(fit.w[drawn])
    span = _span(period, high - low, lengths)
    spans = int((high - low) / span)
    each = max(4, min(TRIED * round(span / period), TRIED_MAX // spans))
    tried = low + span * np.arange(spans).repeat(each) + span * np.tile((np.arange(each) + 0.5) / each, spans)
    phase = begins + (tried - begins) % period
    sent = slope * (correction.sent(phase, np.zeros(len(phase))) - phase)
    without = _waves(fit, every, tried) + _creep(fit, values, drawn, tried)
    before, after = (_off_their_mean(errors, spans) for errors in (without, without + sent))
    hours = span / abs(rows.rate or 1.0) / HOUR_S
    # A random walk of variance s^2 t has the variance s^2 T / 6 about its own mean within T.
    drift = values["drift_per_root_hour"] * np.sqrt(hours / 6.0)
    reading = np.hypot(values["reading_scale"], values["seeing_scale"]) * rows.reading_u
    promise = _promise(before, after, drift, reading)
    expected = offset + slope * command + wave.mean(axis=0)
    u = np.sqrt(wave.var(axis=0) + np.mean(drift**2 + reading**2))
    columns = (command, expected, expected, u, u, added, added)
    return Compensation(
        target=wish.target,
        machine=str(campaign.header.get("serial") or campaign.header.get("name") or ""),
        unit=campaign.unit,
        applied_by=wish.applied_by,
        per_command=slope,
        offset=offset,
        zero_free=True,
        range_command=(low, high),
        resolution=wish.resolution,
        reversal_command=0.0,
        hours=hours,
        travel_command=span,
        homings=len(np.unique(rows.segment)),
        table=tuple(TableRow(*map(float, row)) for row in zip(*columns, strict=True)),
        settings={"period_command": period, **_seconds(rows, period)},
        promise={"forward": promise, "backward": promise},
        unsaid=form.unsaid,
    )


def _seconds(rows: AxisRows, period: float) -> dict[str, float]:
    """Compute the period in seconds, and the time of command 0 on the clock of the campaign, from the rate."""
    if not rows.rate:
        return {}
    command, time_s = float(rows.command[0]), float(rows.time_s[0])
    return {"period_s": period / abs(rows.rate), "phase_0_s": time_s - command / rows.rate}


def _promise(before: np.ndarray, after: np.ndarray, drift: np.ndarray, reading: np.ndarray) -> SidePromise:
    """Compute the promise from draws of waves (n, m), drift (n,) and reading (n,), equal for both sides."""
    noise = np.sqrt(drift**2 + reading**2)[:, None] * np.ones(after.shape[1])
    mean, zero = after.mean(axis=0), np.zeros_like(after)
    alone = {
        "table": absolute_bound95((after - mean).ravel(), zero.ravel()),
        "format": float(NORMAL_95 * np.sqrt(np.mean(mean**2))),
        "drift": absolute_bound95(np.zeros_like(drift), drift),
        "readings": absolute_bound95(np.zeros_like(reading), reading),
    }
    error95 = absolute_bound95(after.ravel(), noise.ravel())
    return SidePromise(
        error95=error95,
        rms=float(np.sqrt(np.mean(after**2 + noise**2))),
        without95=absolute_bound95(before.ravel(), noise.ravel()),
        causes={cause: alone.get(cause, 0.0) for cause in CAUSES},
        shift_free95=error95,
    )
