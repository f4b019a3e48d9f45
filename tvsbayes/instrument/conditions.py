"""Conditions of each move: time since the machine was switched on, and its temperature.

Times in s on the clock of `time_s`, whose zero is `created` of campaign.toml; degC. For scanner and axis. No JAX.
"""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from tvsbayes.errors import listed
from tvsbayes.files.documents import Keys
from tvsbayes.instrument.parameters import CREEP_NAMES, Prior, names_of

SECONDS_PER_MINUTE = 60.0
SENSOR_CODES = {85.0: "after power-on, before it has measured", -127.0: "where it is disconnected"}
"""degC that a DS18B20 (data sheet, and its Arduino library) gives when it did not measure."""
FAR_K = 20.0
"""Difference to the temperatures before and after from which such a value was not measured."""


class TimedMove(Protocol):
    """A row of `moves.csv`, of a scanner or an axis."""

    @property
    def time_s(self) -> float:
        """Clock of the campaign."""

    @property
    def temperature_degC(self) -> float | None:
        """None where it was not recorded."""


def check_power(keys: Keys, header: Mapping[str, object]) -> None:
    """Refuse a `powered_on` that cannot be placed on the clock of the moves.

    Raises:
        InputError: `powered_on` or `created` is not a time, only one has a time zone, or `created` is earlier.
    """
    if "powered_on" not in header:
        return
    switched_on, created = header["powered_on"], header.get("created")
    allowed = "a time before `created`, which is the time of `time_s` = 0, both with or both without a time zone"
    if not isinstance(switched_on, datetime.datetime) or not isinstance(created, datetime.datetime):
        raise keys.refuse("powered_on", "date", allowed, "write both with date and time, such as 2026-01-15T10:00:00Z")
    if (switched_on.tzinfo is None) != (created.tzinfo is None) or switched_on > created:
        raise keys.refuse("powered_on", "date", allowed, "correct one of them")


def powered_on_s(header: Mapping[str, object]) -> float | None:
    """When the machine was switched on, clock of `time_s`; None where the header of a campaign does not state it."""
    switched_on, created = header.get("powered_on"), header.get("created")
    if not isinstance(switched_on, datetime.datetime) or not isinstance(created, datetime.datetime):
        return None
    return (switched_on - created).total_seconds()


def warm_minutes(moves: Sequence[TimedMove], switched_on_s: float | None = None) -> np.ndarray:
    """Minutes since the machine was switched on, by default since the first move, shape (moves,).

    Zero where the moves have no times (all 0, or counted 0, 1, 2 ... by an import): then the time is unknown.
    """
    times_s = np.array([move.time_s for move in moves], dtype=float)
    if not np.ptp(times_s) > 0 or np.array_equal(times_s, np.arange(len(moves))):
        return np.zeros(len(moves))
    return (times_s - (times_s[0] if switched_on_s is None else switched_on_s)) / SECONDS_PER_MINUTE


def kelvin(moves: Sequence[TimedMove]) -> np.ndarray:
    """Temperatures minus that of the first move, shape (moves,), as in `kelvin_at`; zero where none are known."""
    times_s = np.array([move.time_s for move in moves], dtype=float)
    clock = times_s if np.ptp(times_s) > 0 else np.arange(len(moves), dtype=float)
    temperatures = kelvin_at(moves, clock, clock)
    return np.zeros(len(moves)) if temperatures is None else temperatures


def degC_at(moves: Sequence[TimedMove], times: np.ndarray, clock: np.ndarray) -> np.ndarray | None:
    """Temperatures at times (n,), linear in time between those recorded; None where none was.

    Constant before the first and after the last recorded one.

    Args:
        moves: moves with their temperatures.
        times: shape (n,), on the same clock as `clock`.
        clock: times of the moves.
    """
    readings = [(recorded_at, move.temperature_degC) for recorded_at, move in zip(clock, moves, strict=True)]
    known = [(recorded_at, degC) for recorded_at, degC in readings if degC is not None]
    return np.interp(times, *np.array(known, dtype=float).T) if known else None


def kelvin_at(moves: Sequence[TimedMove], times: np.ndarray, clock: np.ndarray) -> np.ndarray | None:
    """Temperatures as in `degC_at` minus that of the first move; None where fewer than two were recorded."""
    if sum(move.temperature_degC is not None for move in moves) < 2:
        return None
    degC, first = degC_at(moves, times, clock), degC_at(moves, clock[:1], clock)
    return None if degC is None or first is None else degC - first


def interpolated(moves: Sequence[TimedMove]) -> int:
    """Number of moves without a temperature where others have one."""
    recorded = sum(move.temperature_degC is not None for move in moves)
    return len(moves) - recorded if recorded else 0


def temperature_doubts(moves: Sequence[TimedMove]) -> list[str]:
    """Temperatures that are codes of a sensor: the nearest others before and after are far, or there are none."""
    known = [(row, move.temperature_degC) for row, move in enumerate(moves) if move.temperature_degC is not None]
    rows = np.array([row for row, degC in known if degC not in SENSOR_CODES], dtype=int)
    measured = np.array([degC for _, degC in known if degC not in SENSOR_CODES], dtype=float)
    sentences = []
    for code, when in SENSOR_CODES.items():
        doubted = []
        for row in (row for row, degC in known if degC == code):
            after = int(np.searchsorted(rows, row))
            if np.all(np.abs(measured[max(after - 1, 0) : after + 1] - code) > FAR_K):
                doubted.append(row)
        if doubted:
            others = f"; others are {measured.min():g} to {measured.max():g}" if len(measured) else ""
            sentences.append(
                f"temperature_degC of moves {listed(doubted, 5)} is {code:g}, what a DS18B20 gives {when}{others}: "
                "empty these cells, which are then interpolated in time"
            )
    return sentences


def pause_s(before: Mapping[str, object], after: Mapping[str, object], last_s: float) -> float:
    """Seconds from the last move of a campaign to the first of a later one, by `created` of both headers; else 0.

    Args:
        before: header of the first.
        after: header of the later one.
        last_s: `time_s` of the last move of the first.
    """
    times = [header.get("created") for header in (before, after)]
    one, other = (time if isinstance(time, datetime.datetime) else None for time in times)
    if one is None or other is None or (one.tzinfo is None) != (other.tzinfo is None):
        return 0.0
    return max((other - one).total_seconds() - last_s, 0.0)


def unseen_shifts(moves: Sequence[TimedMove], priors: Mapping[str, Prior]) -> tuple[str, ...]:
    """Parameters of the shifts of a scanner's zeros that its moves cannot determine.

    Moves without times do not determine the creep, moves at one temperature do not determine the thermal shift, and
    zeros without creep do not determine the time constant.
    """
    no_creep = all(priors[name].value == 0 == priors[name].u for name in names_of("creep_deg"))
    names = CREEP_NAMES if not warm_minutes(moves).any() else names_of("creep_minutes") if no_creep else ()
    return names if kelvin(moves).any() else (*names, *names_of("thermal_deg_per_K"))
