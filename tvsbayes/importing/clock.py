"""Times of a table: seconds, epochs, dates, times of day; clocks that pass midnight or step back."""

from __future__ import annotations

import datetime
import re
from collections.abc import Sequence
from itertools import accumulate, pairwise

import numpy as np

from tvsbayes.files.csv_table import NUMBER
from tvsbayes.importing.cells import FieldCells
from tvsbayes.importing.words import Unit, name_of

DAY_S = 86400.0
SUMMER_TIME_S = 3600.0
EPOCH_SCALES = {1e17: 1e-9, 1e14: 1e-6, 1e11: 1e-3}
"""Seconds per unit by the least number that counts this unit since 1970; smaller numbers are seconds."""
TIME_MAX = 1e20
"""Largest number of a time: nanoseconds of 3000 years."""
TIMES = "seconds, or a date and time such as 2026-01-15T10:00:00 or 15.01.2026 10:00:00"
TIMES_REMEDY = "correct the cell, or write --column time_s="
_CLOCK = re.compile(r"[0-9]{1,2}:[0-9]{2}:[0-9]{2}(?:\.[0-9]{1,9})?(?: ?[AaPp][Mm])?|[0-9]{1,2}:[0-9]{2}")
_DOTTED_DATE = re.compile(r"([0-9]{1,2})\.([0-9]{1,2})\.([0-9]{4})(?:[ ,T]+|$)")
"""Day, month and year: the only order written with dots."""
_SLASHED_DATE = re.compile(r"([0-9]{4})/([0-9]{1,2})/([0-9]{1,2})(?:[ ,T]+|$)")
_ZONE = re.compile(r"(?:Z|[+-]\d\d:?\d\d)$")
_FORMS = ("", "%Y-%m-%dT%I:%M:%S %p", "%d-%b-%Y %H:%M:%S", "%b %d, %Y %H:%M:%S")
"""Of dates; "" is ISO 8601."""


def date_time(text: str) -> datetime.datetime | None:
    """A date with or without a time; None for other texts. Without a zone it is UTC, not this computer's."""
    dotted = _DOTTED_DATE.sub(lambda m: f"{m[3]}-{m[2]:0>2}-{m[1]:0>2}T", text.strip(), count=1)
    text = _SLASHED_DATE.sub(r"\1-\2-\3T", dotted, count=1).rstrip("T")
    for form in _FORMS:
        try:
            at = datetime.datetime.strptime(text, form) if form else datetime.datetime.fromisoformat(text)
        except ValueError:
            continue
        return at if at.tzinfo else at.replace(tzinfo=datetime.UTC)
    return None


def time_of_day(text: str) -> float | None:
    """Seconds since midnight of "9:05:12.25", "9:05" or "9:05:12 PM"; None for other texts."""
    if not _CLOCK.fullmatch(text):
        return None
    hours, minutes, *rest = text.rstrip("AaPpMm ").split(":")
    hour, half = int(hours), text[-2:].lower()
    if half in ("am", "pm"):
        hour = hour % 12 + 12 * (half == "pm")
    seconds = float(rest[0]) if rest else 0.0
    return hour * 3600.0 + int(minutes) * 60.0 + seconds if hour < 24 and int(minutes) < 60 and seconds < 61 else None


def over_midnight(clocks_s: Sequence[float]) -> list[float]:
    """Times of day in order: a step back by more than half a day is midnight."""
    days = accumulate((b < a - DAY_S / 2 for a, b in pairwise(clocks_s)), initial=0)
    return [clock_s + DAY_S * day for clock_s, day in zip(clocks_s, days, strict=True)]


def is_clock(cells: Sequence[str]) -> bool:
    """Whether all filled cells are dates or times of day."""
    filled = [cell for cell in cells if cell]
    return bool(filled) and all(time_of_day(cell) is not None or date_time(cell) is not None for cell in filled)


def stamp_of(cell: str) -> datetime.datetime | None:
    """The date and time of a cell, with a zone where it states one; None without a date."""
    at = None if NUMBER.fullmatch(cell) or time_of_day(cell) is not None else date_time(cell)
    return at if at is None or _ZONE.search(cell.strip()) else at.replace(tzinfo=None)


def seconds_of(cells: FieldCells, assumed: list[str], unit: Unit | None = None) -> list[float] | None:
    """Seconds of every row: numbers in the unit of the column's name or the given one, dates with times, times of day.

    Raises:
        Question: the times step back.
        InputError: a cell is no time.
    """
    if "time_s" not in cells:
        return None
    texts, is_local = cells.text("time_s"), False
    if all(NUMBER.fullmatch(cell) for cell in texts):
        if (far := next((row for row, cell in enumerate(texts) if not abs(float(cell)) <= TIME_MAX), None)) is not None:
            raise cells.refuse(far, "time_s", TIMES, TIMES_REMEDY)
        unit = unit or name_of(cells.columns["time_s"]).unit
        scale = unit.scale if unit is not None and unit.kind == "time" else 1.0
        # Epochs in ns need more digits than a float has.
        start = int(texts[0]) if texts and texts[0].isdigit() else float(texts[0] or 0.0)
        epoch_scale = next((s for least, s in EPOCH_SCALES.items() if start >= least), None)
        if unit is None and epoch_scale is not None:
            seconds = [epoch_scale * ((int(cell) if cell.isdigit() else float(cell)) - start) for cell in texts]
            assumed.append(f"time_s: counted in {epoch_scale:g} s since 1970, so seconds since the first row")
        else:
            seconds = [scale * float(cell) for cell in texts]
    else:
        seconds, is_local = _written_times(cells, texts), not any(map(_ZONE.search, texts))
        assumed.append("time_s: seconds since the first row")
    return _in_order(cells, seconds, is_local, assumed)


def _written_times(cells: FieldCells, texts: Sequence[str]) -> list[float]:
    """Seconds since the first row of dates and times of day; these are of the day of the row before."""
    seconds: list[float] = []
    for row, cell in enumerate(texts):
        of_day, at = time_of_day(cell), date_time(cell)
        if of_day is not None:
            day = DAY_S * (seconds[-1] // DAY_S if seconds else 0)
            of_day += day + DAY_S * bool(seconds and day + of_day < seconds[-1] - DAY_S / 2)
        elif at is None:
            raise cells.refuse(row, "time_s", TIMES, TIMES_REMEDY)
        seconds.append(at.timestamp() if at is not None else of_day or 0.0)
    return [value - seconds[0] for value in seconds]


def _in_order(cells: FieldCells, seconds: list[float], is_local: bool, assumed: list[str]) -> list[float]:
    """Times that do not decrease; a clock set back from summer time is set forward again, once."""
    moved = 0.0
    for row in range(1, len(seconds)):
        seconds[row] += moved
        step = seconds[row] - seconds[row - 1]
        if is_local and not moved and -SUMMER_TIME_S <= step < -0.25 * SUMMER_TIME_S:
            moved, seconds[row] = SUMMER_TIME_S, seconds[row] + SUMMER_TIME_S
            line = cells.table.lines[row]
            assumed.append(
                f"time_s: the clock steps back in line {line}, as at the end of summer time: an hour added from there"
            )
        elif step < 0:
            raise cells.ask("clock-back", row, "time_s", back=-step)
    return seconds


# --- two clocks ------------------------------------------------------------------------------------------------------
def relative_times(cells: Sequence[str], values: np.ndarray, unit: Unit | None) -> np.ndarray | None:
    """Seconds or numbers since the first row, scaled by the unit; None for dates without times of day."""
    if np.isfinite(values).all():
        return (unit.scale if unit and unit.kind == "time" else 1.0) * (values - values[0])
    if not is_clock(cells) or all(len(cell) <= 10 and time_of_day(cell) is None for cell in cells):
        return None
    seconds = [
        of_day if (of_day := time_of_day(c)) is not None else (at.timestamp() if (at := date_time(c)) else np.nan)
        for c in cells
    ]
    return np.array(seconds) - seconds[0]


def equal_clocks(times: np.ndarray, others: np.ndarray) -> bool:
    """Whether two clocks agree but for their unit, to a second or a hundredth."""
    span, other_span = np.ptp(times), np.ptp(others)
    scale = next(
        (s for s in (1.0, 1e3, 1e-3, 1e6, 1e-6, 1e9, 1e-9) if span and abs(other_span / s / span - 1) < 0.01), 1.0
    )
    return bool(np.all(np.abs(others / scale - times) <= 1.0 + 0.01 * span))


def joined_clock(days: Sequence[str], hours: Sequence[str]) -> tuple[str, ...]:
    """A column of dates and one of times of day as one."""
    midnights = [
        at.replace(hour=0, minute=0, second=0, microsecond=0, tzinfo=None) for at in map(date_time, days) if at
    ]
    steps = [datetime.timedelta(seconds=time_of_day(hour) or 0.0) for hour in hours]
    return tuple((a + b).isoformat(timespec="microseconds") for a, b in zip(midnights, steps, strict=True))
