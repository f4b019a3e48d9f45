"""The next stops to read on an axis: those that most reduce the uncertainty of its ratio, or of positions, per move.

The model is linear and normal given the scales, and averaged over their posterior: a future reading changes only
covariances. The variance due to unknown scales stays constant: the plan begins at the u of the fit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from tvsbayes.display import Shown, View
from tvsbayes.errors import InputError, NothingToEstimate
from tvsbayes.gears.states import HOUR_S, travelled
from tvsbayes.instrument.conditions import kelvin_at
from tvsbayes.progress import Job, Show
from tvsbayes.results.records import plain
from tvsbayes.single_axis.axis_campaign import AxisStop, stops_csv
from tvsbayes.single_axis.axis_density import HEADLINE_DRAWS, deviation_functionals, headline_functionals
from tvsbayes.single_axis.axis_fit import AxisFit
from tvsbayes.single_axis.axis_model import AxisModel, reading_variance, stop_variance
from tvsbayes.single_axis.axis_parameters import AXIS_QUANTITIES
from tvsbayes.single_axis.axis_rows import DIRECTIONS, PlayPlaces, reference_errors, reversal_of, warm_from
from tvsbayes.single_axis.waves import wave_columns
from tvsbayes.statistics.optimal_design import Prospects

TARGETS = (*(name for name, quantity in AXIS_QUANTITIES.items() if quantity.target), "position")
"""Targets of a plan; "position" is the mean uncertainty of the error by position over the range."""
CANDIDATES, STOPS_DEFAULT, DRAWS = 17, 8, 24
"""Candidate positions along the range, default number of stops, draws of the scales."""
MOVE_S = 60.0
"""Time of a move where the campaign has no times."""
RUN_UP_SHARE = 0.05
"""Run-up before the move back to a position, as a share of the commands that are allowed."""


def unit_of(target: str, unit: str) -> str:
    """Unit of a target's uncertainty, in a folder of this unit."""
    return AXIS_QUANTITIES[target].unit.format(unit=unit) if target in AXIS_QUANTITIES else unit


@dataclass(frozen=True)
class NextStop:
    """A stop to be read.

    Attributes:
        command: command of the stop.
        direction: direction of approach, "forward" or "backward".
        via: command to visit first, without reading, for this direction; None where not needed.
        u: u of the target after the stop, unit; `gain`: its reduction; `gain_per_minute`.
    """

    command: float
    direction: str
    via: float | None
    u: float
    gain: float
    gain_per_minute: float

    @property
    def actions(self) -> list[str]:
        """Actions in order, in words."""
        first = [] if self.via is None else [f"move {self.via:.10g}"]
        return [*first, f"move {self.command:.10g}", "read"]


@dataclass(frozen=True, repr=False)
class AxisPlan(Shown):
    """Stops to be read next, each given those before it.

    Attributes:
        target: name in `TARGETS`.
        u_now: present u of the target, in the unit of `unit_of`.
        next: stops in order.
        minutes: time of all stops.
    """

    target: str
    u_now: float
    next: tuple[NextStop, ...]
    minutes: float

    def shown(self) -> View:
        """Show the stops to read next, in order."""
        rows = [(stop.command, stop.direction, stop.via, stop.u, stop.gain_per_minute) for stop in self.next]
        columns = ("command", "direction", "go first to", "u afterwards", "gain a minute")
        return View(f"AxisPlan for {self.target}: {len(rows)} stops in {self.minutes:.0f} minutes", columns, rows)

    def as_json(self) -> dict[str, object]:
        """The document in plain types; every stop has its actions in words."""
        steps = [{**plain(stop), "actions": stop.actions} for stop in self.next]
        return {**plain(self), "next": steps}

    def plan_bytes(self) -> bytes:
        """`plan.csv`: step, command, direction, read (1 or 0)."""
        return stops_csv(AxisStop(stop.via, stop.command, stop.direction) for stop in self.next)


class _Options(NamedTuple):
    """Stops that may be read next, arrays (m,); at n draws of the scales.

    Attributes:
        command, side: of the stops; `via`: command to visit first, NaN where not needed.
        moves: number of moves; `path`: commands travelled since the homing, after them.
        drift: variance of the drift of the zero then, shape (n, m).
        scatter: variance of the reading, drift included, shape (n, m).
        innovations: columns less what the drift so far explains, shape (n, m, columns).
    """

    command: np.ndarray
    side: np.ndarray
    via: np.ndarray
    moves: np.ndarray
    path: np.ndarray
    drift: np.ndarray
    scatter: np.ndarray
    innovations: np.ndarray


class _Onward:
    """An axis that goes on from its last move, with a target, at a few draws w (n, d) of the scales.

    A stop is read with its play taken up; its error is new, and the drift of the zero goes on: one more step of the
    filter of the readings.

    Attributes:
        places: commands that may be read.
        u_now: u of the target after the stops so far.
        move_s: time of a move.

    Raises:
        NothingToEstimate: the target is fixed.
    """

    def __init__(self, fit: AxisFit, target: str):
        self.campaign, self.target, moves = fit.campaign, target, fit.campaign.moves
        gaps = [gap for a, b in pairwise(moves) if (gap := b.time_s - a.time_s) > 0]
        self.move_s = float(np.median(gaps)) if gaps else MOVE_S
        (low, high), self.whole = fit.campaign.range_allowed, all(m.command == round(m.command) for m in moves)
        self.places = np.unique(np.r_[np.linspace(low, high, CANDIDATES), np.clip(fit.rows.command.min(), low, high)])
        if self.whole:
            self.places = np.unique(np.clip(np.round(self.places), math.ceil(low), math.floor(high)))
        known, w = fit.model.coordinates, fit.w
        model = AxisModel.of(fit.rows, fit.model.priors, self.places, known.waves)
        self.model = replace(model, coordinates=known)
        linear, functionals = self.model.linear(w), self._functionals(w, fit.rows.command)
        self._given = float(np.mean(linear.sd_of(functionals) ** 2))
        self._between = float(np.mean(np.var(linear.mean_of(functionals), axis=0)))
        if target == "backlash" and self.model.play_is_sampled:
            # A sampled play has no variance given the scales: that of a linear play replaces it.
            self._given, self._between = self._given + self._between, 0.0
            names = tuple(name for name in known.names if name != "backlash")
            w = np.delete(w, known.names.index("backlash"), axis=1)
            self.model = replace(self.model, coordinates=replace(known, names=names))
        self.w = w[np.linspace(0, len(w) - 1, DRAWS).astype(int)]
        linear, functionals = self.model.linear(self.w), self._functionals(self.w, fit.rows.command)
        self._given_few, self._covariance = float(np.mean(linear.sd_of(functionals) ** 2)), linear.covariance
        if not self._given_few:
            remedy = f"state {target} in [axis] with u above 0, or name another target"
            raise NothingToEstimate("held", f"{target} is held at its value: no reading changes it", remedy=remedy)
        self.u_now, self._scales = math.sqrt(self._between + self._given), self.model.coordinates.values(self.w)
        self._drift, self._drift_variance = self.model.drift(self.w)
        self._read, self._read_s, self._time_s = fit.rows.command, fit.rows.time_s[-1], moves[-1].time_s
        self._zero, segment = fit.rows.zero[-1], moves[-1].segment
        if segment != moves[fit.rows.move[-1]].segment and not fit.campaign.absolute:
            # Homed since the last reading: no row has this zero, a homing draws it.
            self._zero, self._read_s = np.nan, next(m.time_s for m in moves if m.segment == segment)
            self._drift = np.zeros_like(self._drift)
            self._drift_variance = self._scales["home_sd"] ** 2
        self._at, self._path = moves[-1].command, travelled(fit.rows.legs.command, fit.rows.legs.segment)[-1]

    def _functionals(self, w: np.ndarray, read: np.ndarray) -> np.ndarray:
        """Functionals (t, columns) of the target where commands are `read`, or (n, t, columns) by draws w (n, d)."""
        if self.target == "position":
            return deviation_functionals(self.model, w, self.places, read)
        return headline_functionals(self.model, w, read)[..., [HEADLINE_DRAWS.index(self.target)], :]

    def options(self) -> _Options:
        """Stops at all places from both sides, with a run-up where needed, as far as it stays in reach."""
        low, high = self.campaign.range_allowed
        command, side = np.repeat(self.places, 2), np.tile([1, -1], len(self.places))
        via = command - side * RUN_UP_SHARE * (high - low)
        via = np.where(side * (command - self._at) > 0, np.nan, np.round(via) if self.whole else via)
        inside = np.isnan(via) | ((via >= low) & (via <= high))
        command, side, via = command[inside], side[inside], via[inside]
        first, moves = np.where(np.isnan(via), self._at, via), 1 + ~np.isnan(via)
        path = self._path + np.abs(first - self._at) + np.abs(command - first)
        time_s, rows = self._time_s + moves * self.move_s, self.model.rows
        hours = np.maximum(time_s - self._read_s, 0.0) / HOUR_S
        drift = self._drift_variance[:, None] + np.outer(self._scales["drift_per_root_hour"] ** 2, hours)
        of_one = np.full(len(command), np.median(rows.variance * rows.count))
        scatter = drift + stop_variance(self._scales, side) + reading_variance(self._scales, of_one, rows)
        if not self.model.places.exact:
            scatter = scatter + self.model.between_nodes(self._scales)[:, None]
        innovations = self._columns(command, side, time_s, path) - self._drift[:, None]
        return _Options(command, side, via, moves, path, drift, scatter, innovations)

    def _columns(self, command: np.ndarray, side: np.ndarray, time_s: np.ndarray, path: np.ndarray) -> np.ndarray:
        """Columns (n, m, columns) of stops read at times (m,) after a path (m,) since the homing."""
        model, rows, campaign = self.model, self.model.rows, self.campaign
        out = -np.sign(rows.line.slope) * side[None]
        value = rows.line.offset + rows.line.slope * command + 0.5 * out[0] * reversal_of(rows).value
        clock = np.array([move.time_s for move in campaign.moves], dtype=float)
        warm_s, kelvin = time_s - warm_from(campaign), kelvin_at(campaign.moves, time_s, clock)
        waves = [
            wave_columns(model.clock(wave, command, time_s, value), draws.period, model.record(wave))
            for wave, draws in zip(model.coordinates.waves, model.coordinates.wave_draws(self.w), strict=True)
        ]
        columns = np.zeros((len(self.w), len(command), model.columns))
        play = PlayPlaces(command[None], path[None], out, out, np.zeros_like(out))
        model.fill(columns, command, play, model.in_time(self._scales["creep_minutes"], warm_s, kelvin), waves)
        columns[..., model.layout["homed"]] = model.homed == self._zero
        u = np.full(len(command), np.median([r.u for r in campaign.readings if r.status == "ok"]))
        errors = reference_errors(campaign, value, time_s, u * campaign.reference.common)
        for column, cause in enumerate(rows.reference_causes, start=model.layout["reference"].start):
            columns[..., column] = errors[cause]
        return columns

    def u_after(self, options: _Options) -> np.ndarray:
        """U of the target (m,) after each of the stops; a line over the commands read goes over this one too."""
        each = [self._functionals(self.w, np.r_[self._read, command]) for command in options.command]
        wanted = np.stack([np.broadcast_to(one, (len(self.w), *one.shape[-2:])) for one in each], axis=1)
        rows = (options.innovations / np.sqrt(options.scatter)[..., None])[:, :, None]
        given, self._prospects = [], []
        for row, covariance, functionals in zip(rows, self._covariance, wanted, strict=True):
            moved = functionals @ covariance
            self._prospects.append(Prospects.of_shifts(row, covariance, row @ moved.swapaxes(1, 2)))
            gains = np.diagonal(self._prospects[-1].gains(), axis1=1, axis2=2)
            given.append(np.mean(np.sum(moved * functionals, axis=2) - gains, axis=1))
        # With few draws the ratio of variances is more accurate than the variance.
        return np.sqrt(self._between + self._given * np.mean(given, axis=0) / self._given_few)

    def read(self, options: _Options, k: int, u: float) -> None:
        """Go to one of the stops and read it."""
        gain = options.drift[:, k] / options.scatter[:, k]
        self._drift = self._drift + gain[:, None] * options.innovations[:, k]
        self._drift_variance = options.drift[:, k] * (1.0 - gain)
        self._covariance = np.array([each.measured(k).covariance for each in self._prospects])
        self._at, self._path, self._read = options.command[k], options.path[k], np.r_[self._read, options.command[k]]
        self._time_s = self._read_s = self._time_s + options.moves[k] * self.move_s
        self.u_now = u


def plan_next(
    fit: AxisFit,
    target: str = "per_command",
    *,
    minutes: float | None = None,
    count: int = STOPS_DEFAULT,
    progress: Show | None = None,
) -> AxisPlan:
    """Greedy choice of the next stops to be read.

    Args:
        fit: fit of the present readings.
        target: one of `TARGETS`.
        minutes: largest time of all moves; None for `count` stops.
        count: largest number of stops.
        progress: shows the progress.

    Raises:
        InputError: an unknown target.
        NothingToEstimate: the drive never stops, or the target is fixed.
    """
    if fit.rows.in_motion:
        raise NothingToEstimate(
            "in-motion",
            "a drive at constant rate has no stops to choose",
            file="campaign.toml",
            remedy="drive on: a run of N periods gives a period to about period / (2 N) times noise over amplitude",
        )
    if target not in TARGETS:
        allowed = ", ".join(TARGETS)
        raise InputError("target", f"--target {target[:60]!r}", allowed=allowed, remedy="name one of them")
    axis, stops, spent, most = _Onward(fit, target), list[NextStop](), 0.0, math.inf if minutes is None else minutes
    u_now = axis.u_now
    with Job({"choosing stops": 1.0}, progress) as job:
        while len(stops) < count:
            job.at(len(stops) / count)
            options = axis.options()
            needed, after = options.moves * axis.move_s / 60.0, axis.u_after(options)
            gains = np.where(spent + needed <= most, (axis.u_now - after) / needed, -math.inf)
            k = int(np.argmax(gains)) if len(gains) else 0
            if not len(gains) or gains[k] == -math.inf:
                break
            via, u = None if math.isnan(options.via[k]) else float(options.via[k]), float(after[k])
            direction = DIRECTIONS[int(options.side[k])]
            gain = float(axis.u_now - u), float(gains[k])
            stops.append(NextStop(float(options.command[k]), direction, via, u, *gain))
            spent += float(needed[k])
            axis.read(options, k, u)
    return AxisPlan(target, u_now, tuple(stops), spent)
