"""Under which conditions each move was made: how long the machine had been on, and how warm it was.

Times in s on the clock of `time_s`, whose zero is `created` of campaign.toml; degC. Of scanner and axis. No JAX.
"""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from tvsbayes.files.documents import Keys
from tvsbayes.instrument.parameters import CREEP_NAMES, Prior, names_of

SECONDS_PER_MINUTE = 60.0


class TimedMove(Protocol):
    """A row of `moves.csv`, of a scanner or an axis."""

    @property
    def time_s(self) -> float:
        """Clock of the campaign."""

    @property
    def temperature_degC(self) -> float | None:
        """None where it was not recorded."""


def check_power(keys: Keys, header: Mapping[str, object]) -> None:
    """Refuses a `powered_on` that cannot be set against the clock of the moves.

    Raises:
        InputError: it or `created` is no time, only one has a time zone, or it is the later one.
    """
    if "powered_on" not in header:
        return
    on, created = header["powered_on"], header.get("created")
    allowed = "a time before `created`, which is the time of `time_s` = 0, both with or both without a time zone"
    if not isinstance(on, datetime.datetime) or not isinstance(created, datetime.datetime):
        raise keys.refuse("powered_on", "date", allowed, "write both with date and time, such as 2026-01-15T10:00:00Z")
    if (on.tzinfo is None) != (created.tzinfo is None) or on > created:
        raise keys.refuse("powered_on", "date", allowed, "correct one of them")


def powered_on_s(header: Mapping[str, object]) -> float | None:
    """When the machine was switched on, clock of `time_s`; None where the header of a campaign does not say it."""
    on, created = header.get("powered_on"), header.get("created")
    if not isinstance(on, datetime.datetime) or not isinstance(created, datetime.datetime):
        return None
    return (on - created).total_seconds()


def warm_minutes(moves: Sequence[TimedMove], switched_on_s: float | None = None) -> np.ndarray:
    """Minutes since the machine was switched on, by default since the first move, shape (moves,).

    Zero where the moves have no times, all of them 0 or counted 0, 1, 2 ... as an import does: then nothing is known of
    how long it was on.
    """
    times_s = np.array([move.time_s for move in moves], dtype=float)
    if not np.ptp(times_s) > 0 or np.array_equal(times_s, np.arange(len(moves))):
        return np.zeros(len(moves))
    return (times_s - (times_s[0] if switched_on_s is None else switched_on_s)) / SECONDS_PER_MINUTE


def kelvin(moves: Sequence[TimedMove]) -> np.ndarray:
    """Temperatures less that of the first move, shape (moves,); as `kelvin_at`, zero where it knows none."""
    times_s = np.array([move.time_s for move in moves], dtype=float)
    clock = times_s if np.ptp(times_s) > 0 else np.arange(len(moves), dtype=float)
    temperatures = kelvin_at(moves, clock, clock)
    return np.zeros(len(moves)) if temperatures is None else temperatures


def kelvin_at(moves: Sequence[TimedMove], times: np.ndarray, clock: np.ndarray) -> np.ndarray | None:
    """Temperatures at times (n,) less that of the first move, linear in time between those recorded.

    Before the first and after the last recorded one they stay; None where fewer than two were recorded.

    Args:
        moves: with their temperatures.
        times: shape (n,), on the same clock as the next.
        clock: times of the moves.
    """
    recorded = [(at, move.temperature_degC) for at, move in zip(clock, moves, strict=True)]
    known = [(at, degC) for at, degC in recorded if degC is not None]
    if len(known) < 2:
        return None
    at, degC = np.array(known, dtype=float).T
    temperatures: np.ndarray = np.interp(times, at, degC)
    return temperatures - float(np.interp(clock[0], at, degC))


def interpolated(moves: Sequence[TimedMove]) -> int:
    """How many moves lack the temperature that others have."""
    recorded = sum(move.temperature_degC is not None for move in moves)
    return len(moves) - recorded if recorded else 0


def unseen_shifts(moves: Sequence[TimedMove], priors: Mapping[str, Prior]) -> tuple[str, ...]:
    """Parameters of shifts of a scanner's zeros that its moves can tell nothing of.

    Moves without times tell no creep, those of one temperature no expansion, and zeros that do not creep no time.
    """
    still = all(priors[name].value == 0 == priors[name].u for name in names_of("creep_deg"))
    names = CREEP_NAMES if not warm_minutes(moves).any() else names_of("creep_minutes") if still else ()
    return names if kelvin(moves).any() else (*names, *names_of("thermal_deg_per_K"))
