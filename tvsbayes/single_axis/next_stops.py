"""The next stops to read on an axis: those that most reduce the uncertainty of its ratio, or of positions, per move.

The model is linear and normal given the scales, and averaged over their posterior: a future reading changes only
covariances. The variance due to unknown scales stays constant: the plan begins at the u of the fit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise, product

import numpy as np

from tvsbayes.display import Shown, View
from tvsbayes.errors import InputError, NothingToEstimate
from tvsbayes.progress import Job, Show
from tvsbayes.results.records import plain
from tvsbayes.single_axis.axis_campaign import AxisCampaign, AxisMove, AxisStop, Reading, stops_csv
from tvsbayes.single_axis.axis_density import HEADLINE_DRAWS, deviation_functionals, headline_functionals
from tvsbayes.single_axis.axis_fit import AxisFit
from tvsbayes.single_axis.axis_model import AxisModel
from tvsbayes.single_axis.axis_parameters import AXIS_QUANTITIES
from tvsbayes.single_axis.axis_rows import SIDES, AxisRows, reversal_of, rows_of

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


def _move_seconds(campaign: AxisCampaign) -> float:
    times = [m.time_s for m in campaign.moves]
    gaps = [b - a for a, b in pairwise(times) if b > a]
    return float(np.median(gaps)) if gaps else MOVE_S


def _whole(campaign: AxisCampaign) -> bool:
    """Whether all commands are whole numbers, so that a plan gives such alone."""
    return all(move.command == round(move.command) for move in campaign.moves)


def _run_up_start(campaign: AxisCampaign, command: float, side: int) -> float | None:
    """The command to visit first, so that the last move to `command` is towards `side`; None where it is already."""
    if side * (command - campaign.moves[-1].command) > 0:
        return None
    low, high = campaign.range_allowed
    via = command - side * RUN_UP_SHARE * (high - low)
    return float(np.round(via)) if _whole(campaign) else via


def _with_stop(campaign: AxisCampaign, rows: AxisRows, stop: AxisStop, seconds: float) -> AxisCampaign:
    """The campaign with one more stop.

    Its reading lies on the line with a reversal through the `rows`, and so does not change the line.
    """
    moves, last = list(campaign.moves), campaign.moves[-1]
    for command in (stop.command,) if stop.via is None else (stop.via, stop.command):
        moves.append(AxisMove(len(moves), last.segment, moves[-1].time_s + seconds, command))
    line, play = rows.line, reversal_of(rows).value
    value = line.offset + line.slope * stop.command - 0.5 * float(np.sign(line.slope)) * SIDES[stop.direction] * play
    u = float(np.median([r.u for r in campaign.noisy if r.status == "ok"]))
    number = max(r.reading for r in campaign.readings) + 1
    reading = Reading(number, len(moves) - 1, value, u)
    return replace(campaign, moves=tuple(moves), readings=(*campaign.readings, reading))


def _variance(model: AxisModel, w: np.ndarray, target: str, places: np.ndarray) -> tuple[float, float]:
    """Variance of a target, unit^2: mean of its variances given the scales, draws (n, d), and that of their means."""
    if target == "position":
        functionals = deviation_functionals(model, w, places)
    else:
        functionals = headline_functionals(model, w)[..., [HEADLINE_DRAWS.index(target)], :]
    linear = model.linear(w)
    between = np.var(linear.mean_of(functionals), axis=0)
    return float(np.mean(linear.sd_of(functionals) ** 2)), float(np.mean(between))


class _Aim:
    """A target, and its u after more stops.

    Attributes:
        places: commands of the candidates, shape (n,).
        u_now: present u.

    Raises:
        NothingToEstimate: the target is fixed.
    """

    def __init__(self, fit: AxisFit, target: str, places: np.ndarray):
        self.target, self.places, self._model, w = target, places, fit.model, fit.w
        self._given, self._between = _variance(self._with(fit.campaign), w, target, places)
        if target == "backlash" and fit.model.play_is_sampled:
            # A sampled play has no variance given the scales: that of a linear play replaces it, for which every
            # reversal is longer than the play.
            self._given, self._between = self._given + self._between, 0.0
            names = fit.model.coordinates.names
            linear = replace(fit.model.coordinates, names=tuple(name for name in names if name != "backlash"))
            self._model, w = replace(fit.model, coordinates=linear), np.delete(w, names.index("backlash"), axis=1)
        self._few = w[np.linspace(0, len(w) - 1, DRAWS).astype(int)]
        self._given_few, _ = _variance(self._with(fit.campaign), self._few, target, places)
        if not self._given_few:
            remedy = f"state {target} in [axis] with u above 0, or name another target"
            raise NothingToEstimate("held", f"{target} is held at its value: no reading changes it", remedy=remedy)
        self.u_now = math.sqrt(self._between + self._given)

    def _with(self, campaign: AxisCampaign) -> AxisModel:
        """The model of the readings of a campaign, with the coordinates of the fit."""
        rows = replace(rows_of(campaign), line=self._model.rows.line)
        model = AxisModel.of(rows, self._model.priors, self.places, self._model.coordinates.waves)
        return replace(model, coordinates=self._model.coordinates)

    def u(self, campaign: AxisCampaign) -> float:
        """The u with the readings of a campaign."""
        # With few draws the ratio of variances is more accurate than the variance.
        given, _ = _variance(self._with(campaign), self._few, self.target, self.places)
        return math.sqrt(self._between + self._given * given / self._given_few)


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
    low, high = fit.campaign.range_allowed
    grid = np.unique(np.r_[np.linspace(low, high, CANDIDATES), np.clip(fit.rows.command.min(), low, high)])
    if _whole(fit.campaign):
        grid = np.unique(np.clip(np.round(grid), math.ceil(low), math.floor(high)))
    aim, move_s = _Aim(fit, target, grid), _move_seconds(fit.campaign)
    stops: list[NextStop] = []
    campaign, u_now, spent = fit.campaign, aim.u_now, 0.0
    with Job({"choosing stops": 1.0}, progress) as job:
        while len(stops) < count:
            best: tuple[NextStop, AxisCampaign] | None = None
            for k, (command, direction) in enumerate(product(grid.tolist(), ("forward", "backward"))):
                job.at((len(stops) + k / (2 * len(grid))) / count)
                via = _run_up_start(campaign, command, SIDES[direction])
                needed = (1 + (via is not None)) * move_s / 60.0
                if (via is None or low <= via <= high) and (minutes is None or spent + needed <= minutes):
                    after = _with_stop(campaign, fit.rows, AxisStop(via, command, direction), move_s)
                    u = aim.u(after)
                    stop = NextStop(command, direction, via, u, u_now - u, (u_now - u) / needed)
                    if best is None or stop.gain_per_minute > best[0].gain_per_minute:
                        best = stop, after
            if best is None:
                break
            stops.append(best[0])
            campaign, u_now, spent = best[1], best[0].u, spent + (1 + (best[0].via is not None)) * move_s / 60.0
    return AxisPlan(target, aim.u_now, tuple(stops), spent)
