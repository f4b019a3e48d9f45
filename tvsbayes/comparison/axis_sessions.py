"""An axis and its later readings: what changed between two fits, and whether a fit still holds for a few new stops.

Both sessions were homed apart, but for an absolute encoder. Commands as sent to the mechanics: readings with a table in
force are verified instead. Units of the folder. No JAX.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tvsbayes.comparison.changes import compared, days_between
from tvsbayes.comparison.departures import (
    FALSE_ALARM_RATE,
    LOOKS_MIN,
    POWER_MIN,
    Departure,
    DrawnDepartures,
    StatedChange,
    null_distribution,
    powers,
    single_change,
    tested,
)
from tvsbayes.compensation.promise import reading_u, run_up_of, table_commands
from tvsbayes.compensation.verification import (
    VerifyPlan,
    planned_stops,
    reachable_stops,
    spread_stops,
    use_over,
)
from tvsbayes.errors import InputError, NothingToEstimate
from tvsbayes.gears.states import HOUR_S
from tvsbayes.results.comparison_record import Comparison
from tvsbayes.results.watch_record import PlannedChange, Watch, WatchPlan
from tvsbayes.single_axis.axis_campaign import AxisCampaign, refuse_same_readings
from tvsbayes.single_axis.axis_fit import AxisFit
from tvsbayes.single_axis.axis_rows import AxisRows, rows_of
from tvsbayes.single_axis.predicted_stops import PredictedAxis
from tvsbayes.statistics.optimal_design import discriminating_visits
from tvsbayes.statistics.predicted_readings import frees_shift
from tvsbayes.statistics.streams import AxisStream, random_stream

SCATTERS, HOME_SDS = 4.0, 5.0
"""Size of a change that must be detected, in scatters of a stop, at the end of the travel; of the zero also in scatters
of homings, which have the same effect."""
POSITIONS_MAX = 100
"""Largest number of positions of a comparison."""
STOPS_MAX, HOUR_MINUTES = 96, 60.0
"""Largest number of stops of a plan for `watch`."""


def refuse_other_axis(known: AxisCampaign, new: AxisCampaign) -> None:
    """Refuse readings in another unit, and readings of the first folder.

    Raises:
        InputError: they are.
    """
    if new.unit != known.unit:
        message = f"the later readings are in {new.unit[:20]!r}, the first in {known.unit[:20]!r}"
        raise InputError("unit", message, remedy="give readings in the unit of the first folder")
    refuse_same_readings(known, new)


def shared_positions(first: AxisRows, second: AxisRows) -> np.ndarray:
    """Positions of the first session within the range of the second, shape (t,).

    Raises:
        NothingToEstimate: fewer than two, or a drive at constant rate, which has no positions.
    """
    inside = (first.positions >= second.command.min()) & (first.positions <= second.command.max())
    positions = first.positions[inside]
    if first.in_motion or second.in_motion or len(positions) < 2:
        found = "a drive at constant rate" if first.in_motion or second.in_motion else f"{len(positions)} positions"
        message = f"{found}: two axes are compared at positions of A within the range read of B"
        raise NothingToEstimate("too-few-positions", message, remedy="read stops of B over the range of A")
    return positions[np.linspace(0, len(positions) - 1, min(len(positions), POSITIONS_MAX)).round().astype(int)]


def _line_and_play(fit: AxisFit, positions: np.ndarray) -> np.ndarray:
    """Slope of the line through positions (t,) and mean play there, shape (1 + draws, 2): their means, then draws."""
    model, centred = fit.model, positions - positions.mean()
    slope = (centred / (centred @ centred)) @ model.functional(positions, fit.w) + model.line_terms(per_command=1.0)
    play = model.line_terms(backlash=1.0)
    play[model.layout["play"]] = model.places.weights(positions).mean(axis=0)
    functionals = np.stack(np.broadcast_arrays(slope, play), axis=-2)
    drawn = fit.linear.drawn(functionals, random_stream(fit.seed, AxisStream.COMPARISON))
    return np.vstack([drawn.mean(axis=0), drawn])


def compare_axes(first: AxisFit, second: AxisFit) -> Comparison:
    """Test whether the line and the play of an axis have changed.

    Args:
        first: converged fit of A.
        second: converged fit of B, made with `shared_positions` as `more`.

    Raises:
        NothingToEstimate: as `shared_positions`.
    """
    positions, unit = shared_positions(first.rows, second.rows), first.campaign.unit
    quantities = [("effective_per_command", f"{unit} per command"), ("effective_backlash", unit)]
    both = first.rows.both_sides and second.rows.both_sides
    quantities = quantities[: 1 + both]
    before, after = (_line_and_play(fit, positions)[:, : len(quantities)] for fit in (first, second))
    return compared(
        quantities,
        before,
        after,
        range_command=(float(positions[0]), float(positions[-1])),
        days=days_between(first.campaign.header, second.campaign.header),
    )


def _changes(
    machine: PredictedAxis, command: np.ndarray, side: np.ndarray, variance: np.ndarray
) -> tuple[tuple[StatedChange, ...], np.ndarray]:
    """Changes that are tested by stops (r,), and their readings by a unit of each, (r, q).

    They are ratio, play, and the zero where its scatter is known.
    """
    fit = machine.fit
    size = SCATTERS * float(np.sqrt(np.mean(machine.noise(side, variance))))
    changes = [single_change("ratio", "per_command", _rounded(100.0 * size / fit.rows.travel), "%")]
    if len(np.unique(np.sign(side[side != 0]))) == 2:
        changes.append(single_change("play", "backlash", _rounded(size), machine.unit))
    if not frees_shift(machine.homings):
        home = HOME_SDS * float(np.sqrt(np.mean(machine.scales["home_sd"] ** 2)))
        changes.append(single_change("zero", "offset", _rounded(max(size, home)), machine.unit))
    # The play lags on the side of arrival.
    columns = {
        "per_command": 0.01 * fit.rows.line.slope * command,
        "backlash": -0.5 * np.sign(fit.rows.line.slope) * side,
        "offset": np.ones(len(command)),
    }
    return tuple(changes), np.column_stack([columns[change.names[0]] for change in changes])


def _rounded(size: float) -> float:
    return float(f"{size:.1e}")


def watch_axis(fit: AxisFit, campaign: AxisCampaign, *, seed: int = 0) -> Watch:
    """Test whether a fit still holds for new stops.

    Args:
        fit: converged fit of the axis.
        campaign: new readings, from a homing on.
        seed: seed of all draws.

    Raises:
        InputError: the readings are those of the fit, or have another unit.
        NothingToEstimate: fewer than `LOOKS_MIN` stops, or readings of a drive.
    """
    refuse_other_axis(fit.campaign, campaign)
    fresh = rows_of(campaign)
    if fresh.in_motion or len(fresh.value) < LOOKS_MIN:
        message = f"readings.csv: {len(fresh.value)} new stops; an axis is watched with at least {LOOKS_MIN} stops"
        raise NothingToEstimate(
            "too-few-looks", message, file="readings.csv", remedy="read more stops, from both sides"
        )
    machine = PredictedAxis(fit, seed)
    stops = machine.read(campaign)
    changes, shifts = _changes(machine, fresh.command, fresh.side, fresh.variance)

    def departure(mean: np.ndarray, covariance: np.ndarray) -> Departure:
        off = fresh.value - mean
        left = np.linalg.solve(covariance, np.column_stack([off, shifts]))
        score, information = shifts.T @ left[:, 0], shifts.T @ left[:, 1:]
        return Departure(float(off @ left[:, 0]), len(off), score, information, changes)

    drawn = tuple(departure(*each) for each in zip(stops.mean, stops.covariance, strict=True))
    centre = departure(*stops.pooled())
    return tested(DrawnDepartures(centre, drawn, np.full(len(drawn), 1 / len(drawn))), len(fresh.value), True, seed)


def _powers_of(
    changes: tuple[StatedChange, ...], shifts: np.ndarray, common: np.ndarray, repeated: np.ndarray, seed: int
) -> list[float]:
    """Power of the test of each change by stops (r,): readings by a unit of each (r, q), covariance, variances."""
    information = shifts.T @ np.linalg.solve(common + np.diag(repeated), shifts)
    departure = Departure(0.0, len(shifts), np.zeros(len(changes)), information, changes)
    return powers(departure, null_distribution(departure, seed).limit, seed)


def plan_watch_axis(fit: AxisFit, *, minutes: float | None = None, seed: int = 0) -> tuple[WatchPlan, VerifyPlan]:
    """Plan the fewest stops after one homing by which `watch` notices each change, by greedy choice.

    Args:
        fit: converged fit of the axis.
        minutes: longest duration; None for that of the campaign's longest run after a homing.
        seed: seed of all draws.

    Returns:
        The plan with the power for each change, and its stops.

    Raises:
        NothingToEstimate: no run-up fits into the commands that are allowed, or the readings are of a drive.
    """
    from scipy.special import ndtri

    machine = PredictedAxis(fit, seed)
    run_up = run_up_of(machine, fit.rows.positions, fit.rows.line.slope)
    command, side = reachable_stops(fit, table_commands(fit.rows), run_up)
    variance = np.full(len(command), reading_u(fit.campaign) ** 2)
    use, scatter = use_over(machine, machine.use.hours, side, variance)
    covariance = machine.expected(command, side, use).plus(scatter).pooled().covariance
    noise = np.minimum(machine.noise(side, variance), 0.999 * np.diag(covariance))
    changes, shifts = _changes(machine, command, side, variance)
    common, first = covariance - np.diag(noise), spread_stops(command)
    first |= first.sum() < LOOKS_MIN
    allowed = HOUR_MINUTES * machine.use.hours if minutes is None else minutes
    move_minutes = float(np.median(np.diff([move.time_s for move in fit.campaign.moves]))) * HOUR_MINUTES / HOUR_S
    # Of single tests at equal shares of the false alarms.
    wanted = float(ndtri(1 - 0.5 * FALSE_ALARM_RATE / len(changes)) + ndtri(POWER_MIN)) ** 2

    def planned(which: Sequence[int], most: int = STOPS_MAX) -> tuple[VerifyPlan, np.ndarray, float]:
        off = [changes[k].size * shifts[:, k] for k in which]
        visits, reached = discriminating_visits(off, common, noise, first, wanted, most)
        plan = VerifyPlan(planned_stops(command, side, visits), run_up, reached >= wanted, reached)
        return plan, visits, move_minutes * plan.moves

    every = range(len(changes))
    plan, visits, taken = planned(every)
    while taken > allowed and len(plan.stops) > first.sum():
        plan, visits, taken = planned(every, len(plan.stops) - 1)
    used = np.flatnonzero(visits)
    able = _powers_of(changes, shifts[used], common[np.ix_(used, used)], noise[used] / visits[used], seed)
    needs = [
        (len(alone.stops), lasts) if alone.enough else (None, None) for alone, _, lasts in map(planned, zip(every))
    ]
    seen = tuple(
        PlannedChange(each.what, each.size, each.unit, power, count, 1 if count else None, lasts, None)
        for each, power, (count, lasts) in zip(changes, able, needs, strict=True)
    )
    looks = WatchPlan(
        looks=len(plan.stops),
        homings=1,
        minutes=taken,
        minutes_allowed=allowed,
        power_wanted=POWER_MIN,
        false_alarm_rate=FALSE_ALARM_RATE,
        met=min(able) >= POWER_MIN and taken <= allowed,
        changes=seen,
        steps=(),
    )
    return looks, plan
