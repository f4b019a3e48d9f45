"""The reference that reads an axis: uncertainties common to all its readings, as `[reference]` states them.

A reading of the reference errs by u, by u_per_unit times the reading, by an error of its expansion times reading and
temperature less 20 degC, and with `u_is = "common"` by its stated u, each times one normal number for the folder
(formulation 8.6). The unit is that of the readings; degC.
"""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np

from tvsbayes.files.documents import Keys, StatedValue, toml_line
from tvsbayes.instrument.conditions import TimedMove, degC_at

TABLE = "reference"
STANDARD_DEGC = 20.0
"""Temperature at which lengths are stated (ISO 1)."""
COMMON = "common"
U_MAX, EXPANSION_MAX = 1e12, 1e-2
"""Largest uncertainty, unit or relative; largest expansion, 1/K."""
CERTIFICATE_CHARS_MAX = 200


NO_EXPANSION = StatedValue(0.0, 0.0)


@dataclass(frozen=True)
class Reference:
    """What `[reference]` states.

    Attributes:
        u: standard uncertainty of an offset of all readings, unit.
        u_per_unit: standard uncertainty of the scale, relative.
        expansion_per_K: relative expansion of the reference: a reading r at T means r (1 + expansion (T - 20 degC)).
        common: whether the u of readings.csv is one error of all readings, not noise of each.
        certificate: name of its certificate, "" where not stated.
        valid_until: last day of its validity.
    """

    u: float = 0.0
    u_per_unit: float = 0.0
    expansion_per_K: StatedValue = NO_EXPANSION
    common: bool = False
    certificate: str = ""
    valid_until: datetime.date | None = None

    @property
    def expands(self) -> bool:
        """Whether its readings depend on the temperature."""
        return self.expansion_per_K != NO_EXPANSION

    def lines(self, *, estimate: bool = False) -> list[str]:
        """The entries of `[reference]`; with `estimate` those on which an estimate depends."""
        entries: dict[str, object] = {"u": self.u or None, "u_per_unit": self.u_per_unit or None}
        entries["expansion_per_K"] = self.expansion_per_K._asdict() if self.expands else None
        entries["u_is"] = COMMON if self.common else None
        if not estimate:
            entries |= {"certificate": self.certificate or None, "valid_until": self.valid_until}
        return [toml_line(name, value) for name, value in entries.items() if value is not None]


def parse_reference(keys: Keys, moves: Sequence[TimedMove]) -> Reference:
    """Check `[reference]` of a folder with these moves."""
    keys.only(("u", "u_per_unit", "expansion_per_K", "u_is", "certificate", "valid_until"))
    numbers = {name: keys.number(name, 0.0, U_MAX) for name in ("u", "u_per_unit") if name in keys}
    expansion = NO_EXPANSION
    if "expansion_per_K" in keys:
        stated = keys.values["expansion_per_K"]
        ends = -EXPANSION_MAX, EXPANSION_MAX
        number = isinstance(stated, int | float)
        expansion = (
            StatedValue(keys.number("expansion_per_K", *ends), 0.0)
            if number
            else keys.quantity("expansion_per_K", *ends, EXPANSION_MAX)
        )
        if not any(move.temperature_degC is not None for move in moves):
            remedy = "add the column temperature_degC to moves.csv, or leave the expansion out"
            raise keys.refuse("expansion_per_K", "temperature", "an expansion where temperatures are recorded", remedy)
    certificate = keys.text_value("certificate", CERTIFICATE_CHARS_MAX) if "certificate" in keys else ""
    common = "u_is" in keys and keys.word("u_is", (COMMON, "independent")) == COMMON
    until = keys.values.get("valid_until")
    if until is not None and (not isinstance(until, datetime.date) or isinstance(until, datetime.datetime)):
        raise keys.refuse("valid_until", "date", "a date such as 2027-01-15", "write it without quotes")
    return Reference(**numbers, expansion_per_K=expansion, common=common, certificate=certificate, valid_until=until)


class Loadings(NamedTuple):
    """Errors of readings (r,) per standard normal number of each cause: names, and an array (r, causes)."""

    names: tuple[str, ...]
    columns: np.ndarray


class ReadValue(Protocol):
    """A reading of an axis that counts."""

    @property
    def move(self) -> int:
        """Number of its move."""

    @property
    def value(self) -> float | None:
        """What was read."""

    @property
    def u(self) -> float:
        """Its stated uncertainty."""

    @property
    def time_s(self) -> float | None:
        """Its own time, of a drive."""


def corrected[R: ReadValue](reference: Reference, moves: Sequence[TimedMove], readings: list[R]) -> list[R]:
    """Readings less the stated expansion of the reference."""
    if not reference.expands:
        return readings
    time_s = np.array([moves[r.move].time_s if r.time_s is None else r.time_s for r in readings], dtype=float)
    value = np.array([r.value for r in readings], dtype=float)
    true = value * (1.0 + reference.expansion_per_K.value * _kelvin(reference, moves, time_s))
    return [replace(reading, value=v) for reading, v in zip(readings, true.tolist(), strict=True)]  # type: ignore[type-var]


def loadings(
    reference: Reference,
    moves: Sequence[TimedMove],
    readings: Sequence[ReadValue],
    row_moves: np.ndarray,
    time_s: np.ndarray,
    value: np.ndarray,
) -> Loadings:
    """Loadings of rows, with their moves, times and values, each (r,); a common u is the mean of a row's readings."""
    stated: dict[int, list[float]] = {}
    for reading in readings if reference.common else ():
        stated.setdefault(reading.move, []).append(reading.u)
    columns = {
        "u": np.full(len(value), reference.u),
        "u_per_unit": reference.u_per_unit * value,
        "expansion_per_K": reference.expansion_per_K.u * value * _kelvin(reference, moves, time_s),
        "u of readings": np.array([np.mean(stated.get(int(move), [0.0])) for move in row_moves]),
    }
    there = {name: column for name, column in columns.items() if np.any(column != 0)}
    return Loadings(tuple(there), np.column_stack(list(there.values())) if there else np.zeros((len(value), 0)))


def _kelvin(reference: Reference, moves: Sequence[TimedMove], time_s: np.ndarray) -> np.ndarray:
    """Temperatures less 20 degC, (r,)."""
    if not reference.expands:
        return np.zeros(len(time_s))
    degC = degC_at(moves, time_s, np.array([move.time_s for move in moves], dtype=float))
    return np.zeros(len(time_s)) if degC is None else degC - STANDARD_DEGC
