"""What to read next on an axis: stops that lower the uncertainty of its ratio, or of positions, most per move.

Linear and normal given the scales, averaged over their posterior: a stop that is yet to be read changes covariances
alone. What is left open because the scales are not known is kept as it is: the plan begins at the u of the fit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from tvsbayes.display import Shown, View
from tvsbayes.errors import InputError, NothingToEstimate
from tvsbayes.progress import Job, Show
from tvsbayes.results.records import plain
from tvsbayes.single_axis.axis_campaign import AxisCampaign, AxisMove, Reading, stops_csv
from tvsbayes.single_axis.axis_density import HEADLINE_DRAWS, headline_functionals
from tvsbayes.single_axis.axis_fit import AxisFit
from tvsbayes.single_axis.axis_model import AxisModel
from tvsbayes.single_axis.axis_parameters import AXIS_QUANTITIES
from tvsbayes.single_axis.axis_record import deviation_functionals
from tvsbayes.single_axis.axis_rows import AxisRows, reversal_of, rows_of

TARGETS = (*(name for name, quantity in AXIS_QUANTITIES.items() if quantity.target), "position")
"""What may be made surer; "position" is the mean uncertainty of the error by position over the range."""
CANDIDATES, AT_ONCE, DRAWS = 17, 8, 24
"""Places tried along the range, moves proposed, draws of the scales."""
MOVE_S = 60.0
"""Time of a move where the campaign does not tell."""
OVERRUN = 0.05
"""Of the range: how far beyond a place a move goes that will come back to it."""


def unit_of(target: str, unit: str) -> str:
    """Of a target's uncertainty, in a folder of this unit."""
    return AXIS_QUANTITIES[target].unit.format(unit=unit) if target in AXIS_QUANTITIES else unit


@dataclass(frozen=True)
class NextStop:
    """A stop to be read.

    Attributes:
        command: where.
        direction: from which side, "forward" or "backward".
        via: command to visit first, without reading, so that the side is right; None where it is.
        u: of the target after it, unit; `gain`: what it takes off; `gain_per_minute`.
    """

    command: float
    direction: str
    via: float | None
    u: float
    gain: float
    gain_per_minute: float

    @property
    def actions(self) -> list[str]:
        """What to do, in order."""
        first = [] if self.via is None else [f"move {self.via:.10g}"]
        return [*first, f"move {self.command:.10g}", "read"]


@dataclass(frozen=True, repr=False)
class AxisPlan(Shown):
    """Stops to be read next, each given those before it.

    Attributes:
        target: what they lower.
        u_now: of the target, unit (`unit_of` it).
        next: stops, first things first.
        minutes: of all of them.
    """

    target: str
    u_now: float
    next: tuple[NextStop, ...]
    minutes: float

    def shown(self) -> View:
        """Stops to read next, in order."""
        rows = [(stop.command, stop.direction, stop.via, stop.u, stop.gain_per_minute) for stop in self.next]
        columns = ("command", "direction", "go first to", "u afterwards", "gain a minute")
        return View(f"AxisPlan for {self.target}: {len(rows)} stops in {self.minutes:.0f} minutes", columns, rows)

    def as_json(self) -> dict[str, object]:
        """Plain types; every stop with its actions in words."""
        steps = [{**plain(stop), "actions": stop.actions} for stop in self.next]
        return {**plain(self), "next": steps}

    def plan_bytes(self) -> bytes:
        """`plan.csv`: step, command, direction, read (1 or 0)."""
        return stops_csv((stop.via, stop.command, stop.direction) for stop in self.next)


def _move_seconds(campaign: AxisCampaign) -> float:
    times = [m.time_s for m in campaign.moves]
    gaps = [b - a for a, b in pairwise(times) if b > a]
    return float(np.median(gaps)) if gaps else MOVE_S


def _with_stop(
    campaign: AxisCampaign, read: AxisRows, command: float, direction: str, seconds: float
) -> tuple[AxisCampaign, float | None]:
    """The campaign with one more stop, reached from that side, and the command visited before it, None if none was.

    Its reading lies on the line with a reversal through what was `read`: so neither is moved by it.
    """
    moves, last = list(campaign.moves), campaign.moves[-1]
    commands = [m.command for m in campaign.moves]
    sign = 1 if direction == "forward" else -1
    via = None
    if sign * (command - last.command) <= 0:
        via = command - sign * OVERRUN * (max(commands) - min(commands))
        via = float(np.round(via)) if np.all(np.array(commands) == np.round(commands)) else via
        moves.append(AxisMove(len(moves), last.segment, moves[-1].time_s + seconds, via))
    moves.append(AxisMove(len(moves), last.segment, moves[-1].time_s + seconds, command))
    offset, slope = read.line
    value = offset + slope * command - 0.5 * float(np.sign(slope)) * sign * reversal_of(read)[0]
    u = float(np.median([r.u for r in campaign.readings if r.status == "ok"]))
    number = max(r.reading for r in campaign.readings) + 1
    reading = Reading(number, len(moves) - 1, value, u)
    return replace(campaign, moves=tuple(moves), readings=(*campaign.readings, reading)), via


def _functionals(fit: AxisFit, target: str, places: np.ndarray) -> np.ndarray:
    """What is to be made surer, as functionals (t, columns) of the fit's model."""
    if target == "position":
        return deviation_functionals(fit, places)
    return headline_functionals(fit.model, fit.w)[..., [HEADLINE_DRAWS.index(target)], :]


@dataclass(frozen=True)
class _Known:
    """What is known of a target, unit^2, by the law of total variance over draws of the scales.

    Attributes:
        given: mean of its variances given the scales.
        between: variance of its means.
    """

    given: float
    between: float


def _known(fit: AxisFit, campaign: AxisCampaign, target: str, places: np.ndarray, w: np.ndarray) -> _Known:
    """With the rows of a campaign, at draws w (n, d)."""
    rows = replace(rows_of(campaign), line=fit.rows.line)
    model = AxisModel.of(rows, fit.model.priors, places, fit.model.coordinates.waves)
    model = replace(model, coordinates=fit.model.coordinates)
    mean, sd = model.linear(w).of(_functionals(replace(fit, rows=rows, model=model, w=w), target, places))
    return _Known(float(np.mean(sd**2)), float(np.mean(np.var(mean, axis=0))))


def _with_linear_play(fit: AxisFit) -> AxisFit:
    """The fit as if every reversal were longer than the play, which then is linear in the readings."""
    names = fit.model.coordinates.names
    left = tuple(name for name in names if name != "backlash")
    model = replace(fit.model, coordinates=replace(fit.model.coordinates, names=left))
    return replace(fit, model=model, w=np.delete(fit.w, names.index("backlash"), axis=1))


def plan_next(
    fit: AxisFit,
    target: str = "per_command",
    *,
    minutes: float | None = None,
    count: int = AT_ONCE,
    progress: Show | None = None,
) -> AxisPlan:
    """Greedy choice of the next stops to be read.

    Args:
        fit: of what was read so far.
        target: one of `TARGETS`.
        minutes: for all moves at most; None for `count` stops.
        count: stops at most.
        progress: told how far it is.

    Raises:
        InputError: an unknown target.
        NothingToEstimate: the folder is of a drive that never stops, or the target is held at its value.
    """
    if fit.rows.in_motion:
        raise NothingToEstimate(
            "in-motion",
            "a drive at constant rate has no stops to choose",
            file="campaign.toml",
            remedy="drive on: a run of N periods tells a period to about period / (2 N) times noise over amplitude",
        )
    if target not in TARGETS:
        allowed = ", ".join(TARGETS)
        raise InputError("target", f"--target {target[:60]!r}", allowed=allowed, remedy="name one of them")
    commands = np.array([m.command for m in fit.campaign.moves])
    low, high = float(commands.min()), float(commands.max())
    grid = np.unique(np.concatenate([np.linspace(low, high, CANDIDATES), [fit.rows.command.min()]]))
    if np.all(commands == np.round(commands)):
        grid = np.unique(np.round(grid))
    w = fit.w[np.linspace(0, len(fit.w) - 1, DRAWS).astype(int)]
    seconds = _move_seconds(fit.campaign)
    campaign, chosen, spent = fit.campaign, [], 0.0
    known = _known(fit, campaign, target, grid, fit.w)
    if target == "backlash" and fit.model.play_is_sampled:
        # Given the scales there is no uncertainty of a play that is one of them: that of a linear play shrinks alike.
        known, fit = _Known(known.given + known.between, 0.0), _with_linear_play(fit)
        w = fit.w[np.linspace(0, len(fit.w) - 1, DRAWS).astype(int)]
    few = _known(fit, campaign, target, grid, w)
    if not few.given:
        remedy = f"state {target} in [axis] with u above 0, or name another target"
        raise NothingToEstimate("held", f"{target} is held at its value: no reading changes it", remedy=remedy)

    def u_of(read: AxisCampaign) -> float:
        # Of a few draws the ratio is surer than the value.
        return float(np.sqrt(known.between + known.given * _known(fit, read, target, grid, w).given / few.given))

    u_now = now = float(np.sqrt(known.between + known.given))
    with Job({"choosing stops": 1.0}, progress) as job:
        for number in range(count):
            best: tuple[float, NextStop, AxisCampaign] | None = None
            for k, command in enumerate(grid):
                job.at((number + k / len(grid)) / count)
                for direction in ("forward", "backward"):
                    longer, via = _with_stop(campaign, fit.rows, float(command), direction, seconds)
                    if via is not None and not low <= via <= high:
                        continue
                    took = (1 + (via is not None)) * seconds / 60.0
                    if minutes is not None and spent + took > minutes:
                        continue
                    u = u_of(longer)
                    rate = (now - u) / took
                    if best is None or rate > best[0]:
                        stop = NextStop(float(command), direction, via, u, now - u, rate)
                        best = rate, stop, longer
            if best is None:
                break
            _, stop, campaign = best
            chosen.append(stop)
            spent += (1 + (stop.via is not None)) * seconds / 60.0
            now = stop.u
    return AxisPlan(target, u_now, tuple(chosen), spent)
