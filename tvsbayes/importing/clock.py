"""Times of a table: seconds, epochs, dates, times of day; clocks that pass midnight or step back."""

from __future__ import annotations

import datetime
import re
from collections import defaultdict, deque
from collections.abc import Hashable, Iterable, Iterator, Sequence
from decimal import Decimal
from itertools import accumulate, pairwise, repeat
from statistics import median
from typing import NamedTuple

import numpy as np

from tvsbayes.files.csv_table import NUMBER
from tvsbayes.importing.cells import FieldCells
from tvsbayes.importing.words import Unit, name_of, place_of

DAY_S = 86400.0
SUMMER_TIME_S = 3600.0
EPOCH_SCALES = {1e17: 1e-9, 1e14: 1e-6, 1e11: 1e-3}
"""Seconds per unit by the least number that counts this unit since 1970; smaller numbers are seconds."""
SPREADSHEET_DAYS, SHORTEST_S = (36526.0, 73050.0), 0.02
"""Days since 1900 from 2000 to 2100, and a time in seconds shorter than moves of a machine."""
TIME_MAX = 1e20
"""Largest number of a time: nanoseconds of 3000 years."""
STEPS_USUAL = 50
"""Number of times before a step back that give the usual step."""
_OF_DAY = re.compile(r"([0-9]{1,2}):([0-9]{2})(?::([0-9]{2}(?:[.,][0-9]{1,9})?))?(?: ?([AaPp])[Mm])?")
_SLASHED = re.compile(r"([0-9]{1,2})/([0-9]{1,2})/([0-9]{4})(?:[ ,T]+(.*))?")
_SHORT = re.compile(r"[0-9]{1,3}:[0-9]{2}")
_ZONE = re.compile(r"(?:Z|[+-]\d\d:?\d\d)$")
_FORMS = ("", "%Y-%m-%dT%I:%M:%S %p", "%d-%b-%Y %H:%M:%S", "%b %d, %Y %H:%M:%S", "%Y-%m-%dT%I:%M %p")
"""Of dates; "" is ISO 8601."""


def date_time(text: str) -> datetime.datetime | None:
    """A date with or without a time; None for other texts. Without a zone it is UTC, not this computer's."""
    text = text.strip()
    day, *rest = re.split("[ ,T]+", text, maxsplit=1)
    # Day, month and year is the only order written with dots.
    parts = day.split("/") if "/" in day else day.split(".")[::-1]
    if len(parts) == 3 and len(parts[0]) == 4:
        text = "T".join(filter(None, ["{}-{:0>2}-{:0>2}".format(*parts), *rest]))
    for form in _FORMS:
        try:
            at = datetime.datetime.strptime(text, form) if form else datetime.datetime.fromisoformat(text)
        except ValueError:
            continue
        return at if at.tzinfo else at.replace(tzinfo=datetime.UTC)
    return None


def dates_in_order(cells: Sequence[str]) -> tuple[list[str], str] | None:
    """Dates such as 3/14/2026 with the year first, and how they were read; of one day that both orders allow its times.

    None for other cells, and where days may be months.
    """
    matches = [_SLASHED.fullmatch(cell) for cell in cells if cell]
    found = [match for match in matches if match]
    if not found or len(found) < len(matches):
        return None
    firsts, seconds = ({int(match[k]) for match in found} for k in (1, 2))
    month_first, day_first = max(firsts) <= 12 < max(seconds), max(seconds) <= 12 < max(firsts)
    if month_first or day_first:
        form = r"\3/\1/\2 \4" if month_first else r"\3/\2/\1 \4"
        said = "dates as month/day/year" if month_first else "dates as day/month/year"
    elif len({match.group(1, 2, 3) for match in found}) == 1 and all(match[4] for match in found):
        form, said = r"\4", f"times alone, as {found[0][1]}/{found[0][2]} may be of two months,"
    else:
        return None
    return [_SLASHED.sub(form, cell).strip() for cell in cells], said


def time_of_day(text: str) -> float | None:
    """Seconds since midnight of "9:05:12.25", "9:05" or "9:05:12 PM"; None for other texts."""
    if (match := _OF_DAY.fullmatch(text)) is None:
        return None
    hour, minute, second = int(match[1]), int(match[2]), float((match[3] or "0").replace(",", "."))
    hour = hour % 12 + 12 * (match[4] in "Pp") if match[4] else hour
    return hour * 3600.0 + minute * 60.0 + second if hour < 24 and minute < 60 and second < 61 else None


def _written(cells: Iterable[str]) -> Iterator[float | None]:
    """Seconds of dates and times of day, else None; a time of day is of the day of the row before, or the next."""
    before = 0.0
    for cell in cells:
        of_day, at = time_of_day(cell), date_time(cell)
        if of_day is not None:
            of_day += DAY_S * (before // DAY_S)
            of_day += DAY_S * (of_day < before - DAY_S / 2)
        time_s = of_day if at is None else at.timestamp()
        before = before if time_s is None else time_s
        yield time_s


def is_clock(cells: Sequence[str]) -> bool:
    """Whether all filled cells are dates or times of day."""
    filled = [cell for cell in cells if cell]
    return bool(filled) and None not in _written(filled)


def stamp_of(cell: str) -> datetime.datetime | None:
    """The date and time of a cell, with a zone where it states one; None without a date."""
    at = None if NUMBER.fullmatch(cell) else date_time(cell)
    return at if at is None or _ZONE.search(cell.strip()) else at.replace(tzinfo=None)


# --- order -----------------------------------------------------------------------------------------------------------
class SetBack(NamedTuple):
    """A clock that was set back: the row, by how much, and what is added from there."""

    row: int
    back_s: float
    added_s: float

    def text(self, line: int) -> str:
        """What is said of it."""
        why = ", as at the end of summer time" * (self.added_s == SUMMER_TIME_S)
        return f"the clock steps back by {self.back_s:.6g} s in line {line}{why}: {self.added_s:.6g} s added from there"


def over_midnight(clocks_s: Sequence[float]) -> list[float]:
    """Times of day in order: a step back by more than half a day is midnight."""
    days = accumulate((b < a - DAY_S / 2 for a, b in pairwise(clocks_s)), initial=0)
    return [clock_s + DAY_S * day for clock_s, day in zip(clocks_s, days, strict=False)]


def forward(times_s: Iterable[float], series: Iterable[Hashable]) -> tuple[list[float], list[SetBack]]:
    """Times that do not decrease in any series of a log: one clock, set forward again by what it lost.

    That is an hour at the end of summer time, else the step and the usual time between two rows of its series.
    """
    past_s = defaultdict[Hashable, deque[float]](lambda: deque(maxlen=STEPS_USUAL))
    forward_s, backs, moved = list[float](), list[SetBack](), 0.0
    for row, (time_s, name) in enumerate(zip(times_s, series, strict=False)):
        past = past_s[name]
        if past and (back_s := past[-1] - time_s - moved) > 0:
            steps_s = [b - a for a, b in pairwise(past) if b > a] or [0.0]
            # Less than an hour by the time between the two rows, which is as between others.
            is_summer = max(0.25 * SUMMER_TIME_S, SUMMER_TIME_S - 2 * max(steps_s)) <= back_s <= SUMMER_TIME_S
            backs.append(SetBack(row, back_s, SUMMER_TIME_S if is_summer else back_s + median(steps_s)))
            moved += backs[-1].added_s
        past.append(time_s + moved)
        forward_s.append(time_s + moved)
    return forward_s, backs


def _are_days(times: np.ndarray) -> bool:
    """Whether numbers are days since 1900: of recent years, and in steps that no move takes in seconds."""
    low, high = SPREADSHEET_DAYS
    steps = np.abs(np.diff(times))
    return len(steps) > 0 and bool(np.all((low <= times) & (times <= high))) and 0 < np.median(steps) < SHORTEST_S


def seconds_of(cells: FieldCells, unit: Unit | None = None) -> list[float] | None:
    """Seconds of every row: numbers in the unit of the column's name or the given one, dates with times, times of day.

    A clock set back from summer time, as one with a zone is not, is set forward again, once.

    Raises:
        Question: the times step back.
        InputError: a cell is no time.
    """
    if "time_s" not in cells:
        return None
    texts, unit = cells.text("time_s"), unit or name_of(cells.columns["time_s"]).unit
    words = name_of(cells.columns["time_s"]).words
    is_elapsed = all(map(_SHORT.fullmatch, texts)) and place_of(words, "elapsed") is not None
    if is_elapsed and unit is None:
        raise cells.ask("elapsed", 0, "time_s")
    numbers = [float(cell) if NUMBER.fullmatch(cell) else None for cell in texts]
    is_number = 2 * numbers.count(None) <= len(texts)
    written = numbers if is_number else [*_written(texts)]
    if is_elapsed and unit is not None:
        written = [unit.scale * (float(a) + float(b) / 60) for a, b in (text.split(":") for text in texts)]
    for row, time in enumerate(written):
        if time is None or not abs(time) <= TIME_MAX:
            allowed = "seconds, or a date and time such as 2026-01-15T10:00:00 or 15.01.2026 10:00:00"
            raise cells.refuse(row, "time_s", allowed, "correct the cell, or write --column time_s=")
    times = np.array(written, dtype=float)
    is_day = is_number and unit is None and (place_of(words, "day-number") is not None or _are_days(times))
    is_day |= is_number and unit is not None and unit.scale == DAY_S and min(times) > SPREADSHEET_DAYS[0]
    of_epoch = [scale for least, scale in EPOCH_SCALES.items() if times.max(initial=0.0) >= least]
    if is_day:
        times_s = DAY_S * (times - times[0])
        cells.assumed.append("time_s: days, as of a Julian date or a spreadsheet, so seconds since the first row")
    elif not is_number:
        times_s = times - times[0]
        of_minutes = "hours and minutes, so " * all(len(cell) <= 5 for cell in texts)
        cells.assumed.append(f"time_s: {of_minutes}seconds since the first row")
    elif unit is None and of_epoch:
        # Epochs in ns need more digits than a float has.
        times_s = [of_epoch[0] * float(Decimal(cell) - Decimal(texts[0])) for cell in texts]
        cells.assumed.append(f"time_s: counted in {of_epoch[0]:g} s since 1970, so seconds since the first row")
    else:
        times_s = times * (unit.scale if unit is not None and unit.kind == "time" else 1.0)
        if unit is None and len(times) and SPREADSHEET_DAYS[0] <= times.min() and times.max() <= SPREADSHEET_DAYS[1]:
            said = "time_s: in s, though spreadsheets count days by such numbers; a column of days is named Time (d)"
            cells.assumed.append(said)
    seconds, backs = forward(map(float, times_s), repeat("time_s"))
    for back in backs:
        is_dated = not is_number and not any(map(_ZONE.search, texts)) and date_time(texts[0]) is not None
        if not is_dated or back.added_s != SUMMER_TIME_S or len(backs) > 1:
            raise cells.ask("clock-back", back.row, "time_s", back=back.back_s)
        cells.assumed.append(f"time_s: {back.text(cells.table.lines[back.row])}")
    return seconds


# --- two clocks ------------------------------------------------------------------------------------------------------
def relative_times(cells: Sequence[str], values: np.ndarray, unit: Unit | None) -> np.ndarray | None:
    """Seconds or numbers since the first row, scaled by the unit; None for dates without times of day."""
    if np.isfinite(values).all():
        return (unit.scale if unit and unit.kind == "time" else 1.0) * (values - values[0])
    if not is_clock(cells) or all(len(cell) <= 10 and time_of_day(cell) is None for cell in cells):
        return None
    times_s = np.array([*_written(cells)], dtype=float)
    return times_s - times_s[0]


def equal_clocks(times: np.ndarray, others: np.ndarray) -> bool:
    """Whether two clocks agree but for their unit, to a second or a hundredth."""
    span, other_span = np.ptp(times), np.ptp(others)
    scale = 1000.0 ** np.round(np.log10(other_span / span) / 3) if min(span, other_span) > 0 else 1.0
    return bool(np.all(np.abs(others / scale - times) <= 1.0 + 0.01 * span))


def joined_clock(days: Sequence[str], hours: Sequence[str]) -> tuple[str, ...]:
    """A column of dates and one of times of day as one."""
    midnights = [datetime.datetime.combine(at, datetime.time()) for at in map(date_time, days) if at]
    steps = [datetime.timedelta(seconds=time_of_day(hour) or 0.0) for hour in hours]
    return tuple((a + b).isoformat(timespec="microseconds") for a, b in zip(midnights, steps, strict=True))
