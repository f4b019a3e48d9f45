"""A simulated axis: true gears drawn from the priors, moved by a list of moves, read with noise.

It is written from the definition (formulation 8.1), stop by stop, and shares no formula with the model. A folder that
states a `rate` is read in motion, at the times of the template's readings or at equal intervals.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from tvsbayes.display import Shown, View
from tvsbayes.errors import InputError, NothingToEstimate
from tvsbayes.files.disk import write_folder
from tvsbayes.single_axis.axis_campaign import AxisCampaign, AxisMove, Reading, axis_bytes
from tvsbayes.single_axis.axis_parameters import AxisPrior, axis_priors, kind_of
from tvsbayes.single_axis.waves import SECOND, WANDER, WavePeriods
from tvsbayes.twin.gear_errors import kelvin_of, zero_shift
from tvsbayes.twin.physics import take_up

READING_SHARE = 5e-5
"""Stated u of simulated readings as a share of the travel, where nothing else is known."""
IN_TIME = ("creep", "creep_minutes", "thermal_per_K", "seeing_scale", "seeing_s")
"""Parameters of shifts in time."""
TRUTH_FORMAT = "tvsbayes-axis-truth/1"
DRIVE_READINGS, DRIVE_S = 1000, 4.0
"""Readings of a drive whose template has none, and the time between them."""


@dataclass(frozen=True)
class TrueWave:
    """A true wave; amplitude 0 where there is none.

    Attributes:
        of: variable of the wave: "position", "seconds" or "encoder".
        period: period in that variable.
        amplitude, phase_deg: first harmonic, highest at the phase; `second`, `second_phase_deg`: second harmonic.
        change, change_phase_deg: wave added to the first harmonic at the end of the record and subtracted at its
            beginning, linearly in between.
        begin, end: ends of the record.
    """

    of: str
    period: float
    amplitude: float
    phase_deg: float
    second: float
    second_phase_deg: float
    change: float
    change_phase_deg: float
    begin: float
    end: float

    def at(self, x: float) -> float:
        """Evaluate the wave at a place."""
        turn = 360.0 * x / self.period
        first = self.amplitude * math.cos(math.radians(turn - self.phase_deg))
        share = (2 * x - self.begin - self.end) / (self.end - self.begin)
        first += share * self.change * math.cos(math.radians(turn - self.change_phase_deg))
        return first + self.second * math.cos(math.radians(2 * turn - self.second_phase_deg))


@dataclass(frozen=True)
class AxisTruth:
    """A true axis.

    Attributes:
        parameters: values by the names of `[axis]`, stop scatter by direction, with `ratio_contrast`.
        command: positions at which both curves are given, ascending, shape (n,).
        error: error of the position; `play_variation`: deviation from the mean play; unit, each (n,).
        waves: waves of the gear and, with `encoder`, of the encoder.
    """

    parameters: dict[str, float]
    command: np.ndarray
    error: np.ndarray
    play_variation: np.ndarray
    waves: tuple[TrueWave, ...] = ()

    def wave(self, of: str, x: float) -> float:
        """Evaluate the sum of the waves of a variable, see `TrueWave.of`."""
        return sum(wave.at(x) for wave in self.waves if wave.of == of)

    def as_json(self) -> dict[str, object]:
        """Return the content of `truth.json`."""
        curves = {"command": self.command, "error": self.error, "play_variation": self.play_variation}
        lists = {name: values.tolist() for name, values in curves.items()}
        waves = [asdict(wave) for wave in self.waves]
        return {"format": TRUTH_FORMAT, "parameters": self.parameters, **lists, **({"waves": waves} if waves else {})}


@dataclass(frozen=True, repr=False)
class SimulatedAxis(Shown):
    """A simulated campaign and its truth."""

    campaign: AxisCampaign
    truth: AxisTruth

    def shown(self) -> View:
        """Show the campaign; the truth is in `truth`."""
        view = self.campaign.shown()
        return replace(view, title=f"Simulated {view.title}; the truth is in .truth")

    def write(self, folder: Path) -> None:
        """Write the campaign folder with `truth.json`."""
        truth = json.dumps(self.truth.as_json(), indent=1, allow_nan=False).encode()
        write_folder(folder, {"truth.json": truth, **axis_bytes(self.campaign)})


def _drawn(name: str, prior: AxisPrior, rng: np.random.Generator) -> float:
    kind = kind_of(name)
    normal = float(rng.standard_normal())
    if kind == "log-normal":
        return prior.value * float(np.exp(prior.u * normal))
    if name in ("ratio_contrast", "creep", "thermal_per_K"):
        return prior.value + prior.u * normal
    # True play is never negative, although a fit may allow it.
    return abs(prior.value + prior.u * normal) if kind == "half-normal" or name == "backlash" else prior.value


def _curve(distance: np.ndarray, length: float, sd: float, rng: np.random.Generator) -> np.ndarray:
    """Draw a smooth curve at points of these mutual distances (n, n)."""
    a = np.sqrt(5.0) * np.abs(distance) / length
    values, vectors = np.linalg.eigh((1 + a + a * a / 3) * np.exp(-a))
    return sd * (vectors @ (np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(len(values))))


def draw_axis(
    commands: Sequence[float],
    stated: Mapping[str, AxisPrior],
    per_command: float,
    travel: float,
    rng: np.random.Generator,
    periods: WavePeriods | None = None,
    between_s: tuple[float, float] = (0.0, 1.0),
    unit: str = "",
) -> AxisTruth:
    """Draw a true axis for a list of commands.

    Args:
        commands: commands of all moves.
        stated: entries of `[axis]`.
        per_command: true unit per command; `[axis]` states only its prior uncertainty.
        travel: range of the readings, unit, to which default scales are proportional.
        rng: source of all random numbers.
        periods: stated periods; half of them have a wave, with the scale of `transmission_error`.
        between_s: least and greatest time of the readings, for waves of time.
        unit: unit of the readings.
    """
    at = np.unique(np.asarray(commands, dtype=float))
    priors = axis_priors(stated, travel, per_command, unit=unit)
    names = [name for name in priors if name not in ("per_command", "ratio_contrast", "stop_sd", *IN_TIME)]
    names += ["stop_sd.forward", "stop_sd.backward"]
    true = {name: _drawn(name, priors[name.split(".")[0]], rng) for name in names}
    # A separate generator, so that a seed always draws the same gears.
    [gear_rng] = rng.spawn(1)
    true |= {name: _drawn(name, priors[name], gear_rng) for name in IN_TIME}
    true["per_command"] = per_command
    true["ratio_contrast"] = _drawn("ratio_contrast", priors["ratio_contrast"], rng)
    distance = abs(per_command) * (at[:, None] - at)
    length = max(true["transmission_error_length"], 1e-9 * travel)
    error = _curve(distance, length, true["transmission_error"], rng)
    play = _curve(distance, length, true["play_variation"], rng)
    ends = (abs(per_command) * float(at[0]), abs(per_command) * float(at[-1]))
    if not periods:
        return AxisTruth(true, at, error, play)
    record = {"position": ends, "encoder": sorted((per_command * at[0], per_command * at[-1])), "seconds": between_s}
    return AxisTruth(true, at, error, play, _drawn_waves(periods, priors, travel, record, gear_rng))


def _drawn_waves(
    stated: WavePeriods,
    priors: Mapping[str, AxisPrior],
    travel: float,
    record: Mapping[str, Sequence[float]],
    rng: np.random.Generator,
) -> tuple[TrueWave, ...]:
    """Draw waves of the stated periods; an unknown period is log-uniform in its range."""
    clock = "seconds" if stated.in_seconds else "position"
    periods = [(clock, period) for period in stated.stated]
    periods += [(clock, float(low * (high / low) ** rng.random())) for low, high in stated.between]
    periods += [("encoder", stated.encoder)] if stated.encoder is not None else []
    unit = priors["transmission_error"].u or priors["transmission_error"].value or 0.002 * travel
    waves = []
    for of, period in periods:
        scale = unit * abs(float(rng.standard_normal())) * float(rng.random() < 0.5)
        drawn = rng.standard_normal((3, 2)) @ np.array([1, 1j])
        size = scale * np.array([1.0, SECOND, WANDER]) * np.abs(drawn)
        parts = np.column_stack([size, np.degrees(np.angle(drawn))]).ravel().tolist()
        waves.append(TrueWave(of, period, *parts, *record[of]))
    return tuple(waves)


def _encoder_reads(truth: AxisTruth, stand: float) -> float:
    """Compute the encoder's reading of a position; its waves are functions of the reading."""
    value = stand
    for _ in range(20):
        value = stand + truth.wave("encoder", value)
    return value


def _time_shift(truth: AxisTruth, warm_s: float, kelvin: float, time_s: float) -> float:
    """Compute the shift of the zero by creep, temperature and waves of time."""
    true = truth.parameters
    shift = zero_shift(true["creep"], true["creep_minutes"], warm_s / 60.0, true["thermal_per_K"], kelvin)
    return float(shift) + truth.wave("seconds", time_s)


def stops_of(
    truth: AxisTruth,
    moves: Sequence[AxisMove],
    rng: np.random.Generator,
    powered_on_s: float | None = None,
    absolute: bool = False,
) -> np.ndarray:
    """Compute the output after every move, unit, (moves,), warming since `powered_on_s` or the first move.

    The zero of an `absolute` encoder is not set by homings: it walks on.
    """
    true = truth.parameters
    ratio, contrast, backlash = true["per_command"], true["ratio_contrast"], true["backlash"]
    stops = np.empty(len(moves))
    wheel = stand = zero = stop = 0.0
    side = 0
    last: AxisMove | None = None
    since = moves[0].time_s if powered_on_s is None else powered_on_s
    kelvin = kelvin_of(moves)
    for row, move in enumerate(moves):
        homed = last is None or move.segment != last.segment
        if last is not None and (absolute or not homed):
            hours = (move.time_s - last.time_s) / 3600.0
            zero += true["drift_per_root_hour"] * np.sqrt(hours) * float(rng.standard_normal())
        if last is None or homed:
            home = 0.0 if last is None or absolute else true["home_sd"] * float(rng.standard_normal())
            wheel, zero = ratio * move.command + home, zero if absolute else 0.0
            side = {"forward": 1, "backward": -1}.get(move.approach, 0)
            turned = side * np.sign(ratio)
            share = -turned if side else rng.uniform(-1.0, 1.0)
            stand = wheel + 0.5 * share * backlash
            fresh = True
        else:
            step = move.command - last.command
            wheel += (ratio + 0.5 * contrast * np.sign(step)) * step
            stand = take_up(stand, wheel, backlash)
            side = int(np.sign(step)) or side
            fresh = step != 0
        if fresh:
            sd = true["stop_sd.backward"] if side < 0 else true["stop_sd.forward"]
            stop = sd * float(rng.standard_normal())
        place = int(np.searchsorted(truth.command, move.command))
        share = 2 * (stand - wheel) / backlash if backlash else -side * np.sign(ratio)
        stops[row] = stand + truth.error[place] + 0.5 * share * truth.play_variation[place] + zero + stop
        stops[row] += truth.wave("position", abs(ratio) * move.command)
        stops[row] += _time_shift(truth, move.time_s - since, kelvin[row], move.time_s)
        last = move
    return stops


def drive_of(
    truth: AxisTruth, move: AxisMove, rate: float, times_s: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Compute the output of a drive at constant rate at ascending times (n,) after a move; shape (n,)."""
    true = truth.parameters
    positions = np.empty(len(times_s))
    seeing, zero, last = 0.0, 0.0, None
    for k, time_s in enumerate(times_s):
        command = move.command + rate * (time_s - move.time_s)
        gap = time_s - (move.time_s if last is None else last)
        zero += true["drift_per_root_hour"] * math.sqrt(gap / 3600.0) * float(rng.standard_normal())
        keep = 0.0 if last is None else math.exp(-gap / true["seeing_s"])
        seeing = keep * seeing + true["seeing_scale"] * math.sqrt(1.0 - keep**2) * float(rng.standard_normal())
        positions[k] = true["per_command"] * command + zero + _time_shift(truth, time_s - move.time_s, 0.0, time_s)
        positions[k] += truth.wave("position", abs(true["per_command"]) * command)
        positions[k] += seeing * true["reading_u"]
        last = time_s
    return positions


def simulate_axis(template: AxisCampaign, moves: Sequence[AxisMove] | None = None, seed: int = 0) -> SimulatedAxis:
    """Simulate an axis with the priors of a folder, moved as listed and read after every move.

    Args:
        template: unit, `[axis]`; its readings, if any, give the unit per command and the u of readings.
        moves: moves to make; None for those of the template, read where it has readings (everywhere if it has none).
        seed: seed of the true axis, its stops and the noise.

    Raises:
        InputError: neither `[axis]` nor readings determine the unit per command.
        NothingToEstimate: the readings do not determine it.
    """
    rng, rate, per_command = np.random.default_rng([seed, 11]), template.rate, _per_command(template)
    used = {r.move for r in template.readings} if moves is None else set()
    # A drive at constant rate has one segment.
    moves = template.moves[:1] if rate is not None else template.moves if moves is None else tuple(moves)
    commands = [m.command for m in moves]
    if rate is None:
        read = [row for row, move in enumerate(moves) if not used or move.move in used]
        travel = float(np.ptp([commands[row] for row in read])) * abs(per_command)
        if not travel > 0:
            raise NothingToEstimate("too-few-positions", "all moves are to one position", remedy="list more positions")
        between_s = moves[0].time_s, moves[-1].time_s
    else:
        # Read at the template's times.
        known = sorted(r.time_s for r in template.readings if r.time_s is not None and r.status == "ok")
        times = np.array(known) if known else moves[0].time_s + DRIVE_S * np.arange(1, DRIVE_READINGS + 1)
        travel, between_s = abs(rate * per_command) * float(np.ptp(times)), (float(times[0]), float(times[-1]))
    truth = draw_axis(commands, template.stated, per_command, travel, rng, template.periods, between_s, template.unit)
    stated_u = [r.u for r in template.readings if r.u > 0]
    u = float(np.median(stated_u)) if stated_u else READING_SHARE * travel
    if rate is None:
        stands = stops_of(truth, moves, rng, template.powered_on_s, template.absolute)[read]
        places: list[tuple[int, float | None]] = [(moves[row].move, None) for row in read]
    else:
        truth.parameters["reading_u"] = u
        stands = drive_of(truth, moves[0], rate, times, rng)
        places = [(0, time_s) for time_s in times.tolist()]
    noise = truth.parameters["reading_scale"] * u * rng.standard_normal(len(stands))
    readings = tuple(
        Reading(k, move, _encoder_reads(truth, stand) + off, u, "ok", time_s)
        for k, (stand, off, (move, time_s)) in enumerate(zip(stands.tolist(), noise.tolist(), places, strict=True))
    )
    header = {**template.header, "synthetic": True, "seed": seed}
    return SimulatedAxis(replace(template, moves=moves, readings=readings, header=header, path=None), truth)


def _per_command(template: AxisCampaign) -> float:
    if "per_command" in template.stated:
        return template.stated["per_command"].value
    usable = (r for r in template.readings if r.status == "ok" and r.value is not None)
    used = [(template.moves[r.move].command, r.value) for r in usable]
    if len({command for command, _ in used}) < 2:
        raise InputError(
            "unstated",
            "campaign.toml: nothing says what one command does",
            file="campaign.toml",
            column="axis.per_command",
            remedy="add per_command = { value = ..., u = ... } to [axis]",
        )
    command, value = np.array(used, dtype=float).T
    slope = float(np.polyfit(command, value, 1)[0])
    if slope == 0:
        raise NothingToEstimate("no-motion", "the readings do not move with the command", remedy="state per_command")
    return slope
