"""Series of command and reading that EPICS or Klipper logged, joined in time into a table.

EPICS: lines of `camonitor`, JSON of the archiver appliance. Klipper: messages of its data logger, the table that
ANGLE_CALIBRATE saves. Sizes are limited by what the messages hold, not by what they would expand to.
"""

from __future__ import annotations

import configparser
import datetime
import json
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice, permutations
from typing import Any, NamedTuple

import numpy as np

from tvsbayes.errors import Candidate, InputError, escaped
from tvsbayes.importing.asking import asked, refused
from tvsbayes.importing.clock import SUMMER_TIME_S
from tvsbayes.importing.columns import line_through
from tvsbayes.importing.table import ForeignTable, table_of
from tvsbayes.importing.words import place_of, words_of

STANDSTILL_INTERVALS = 3.0
"""Typical intervals of a series after which a value that did not change is held, not interpolated."""
INTERVAL_MAX_S = 2.0
"""Longest time between two values of an axis in motion: a command logged once per move is valid until the next."""
EQUAL_S = 1e-6
"""Times closer than this are equal."""
ROWS_KEPT = 2000
"""Largest number of joined rows, as many as a fit accepts; of more rows, every n-th is used."""
INFLATED_BYTES_MAX, MESSAGE_BYTES_MAX = 64 * 2**20, 2**20
KLIPPER_TURN = 65536
"""Counts per turn of an angle sensor in Klipper (klippy/extras/angle.py, ANGLE_BITS)."""
PAIRS_MAX = 20
"""Largest number of pairs of series that are asked about."""
INVALID = 3
"""Severity of a value that is none (EPICS, alarm.h)."""
_CAMONITOR = re.compile(
    r"(?P<name>(?=\S*[A-Za-z])\S+)\s+(?:\(\S+\)\s*)?(?P<time>\d{4}-\d\d-\d\d \d\d:\d\d:\d\d(?:\.\d+)?)\s+"
    r"(?P<value>\S+)(?:\s+(?P<rest>\S.*))?"
)
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?")


class Series(NamedTuple):
    """Values by ascending time, logged at changes, shapes (n,)."""

    times_s: np.ndarray
    values: np.ndarray

    @property
    def changes(self) -> bool:
        """Whether it has more than one value."""
        return len(np.unique(self.values)) > 1


# --- EPICS -----------------------------------------------------------------------------------------------------------
def is_camonitor(text: str) -> bool:
    """Whether most lines of a text are of EPICS' camonitor."""
    lines = [line for line in text.splitlines()[:50] if line.strip()]
    return bool(lines) and 2 * sum(bool(_CAMONITOR.match(line)) for line in lines) > len(lines)


def is_archive(text: str) -> bool:
    """Whether a text is JSON of EPICS' archiver appliance."""
    return re.match(r'\s*\[\s*\{\s*"meta"\s*:\s*\{', text) is not None


def epics_table(text: str, file: str, stated: Mapping[str, str]) -> ForeignTable:
    """The pair of series of an EPICS log, joined in time.

    Args:
        text: text of the log.
        file: its name, for messages.
        stated: name of a series by `command` or `value`, as the user states it.

    Raises:
        Question: several pairs could be command and reading.
        InputError: no such pair, or no time at which both are known.
    """
    series, notes = _archived(text, file) if is_archive(text) else _monitored(text)
    command, value = _pair(series, file, stated)
    log, read = series[command], series[value]
    inside = (read.times_s >= log.times_s[0] - EQUAL_S) & (read.times_s <= log.times_s[-1] + EQUAL_S)
    if not inside.any():
        raise refused("apart", file, command=command, value=value)
    commands, interpolated = _command_at(log, read.times_s[inside])
    held = log.values[np.searchsorted(log.times_s, read.times_s[inside] + EQUAL_S, side="right") - 1]
    # A command that is logged once a move jumps; between two such rows no axis was halfway.
    if interpolated and _scatter(held, read.values[inside]) <= _scatter(commands, read.values[inside]):
        commands, interpolated = held, 0
    notes += [f"command {escaped(command)}, reading {escaped(value)}"]
    notes += [f"{interpolated} commands interpolated in time, {int((~inside).sum())} readings outside left out"]
    return _joined(file, notes, read.times_s[inside], commands, read.values[inside], (command, value))


def _monitored(text: str) -> tuple[dict[str, Series], list[str]]:
    """Series of a camonitor log; a clock that steps back goes on."""
    rows: dict[str, list[tuple[float, float]]] = {}
    left_out, start, moved, notes = 0, None, 0.0, list[str]()
    for number, line in enumerate(text.splitlines(), start=1):
        match = _CAMONITOR.fullmatch(line.strip())
        if match is None:
            left_out += bool(line.strip())
            continue
        series = rows.setdefault(match["name"], [])
        try:
            at = datetime.datetime.fromisoformat(match["time"])
        except ValueError:
            at = None
        if at is None or not _NUMBER.fullmatch(match["value"]) or "INVALID" in (match["rest"] or "").upper():
            left_out += 1
            continue
        start = start or at
        time_s = (at - start).total_seconds() + moved
        if series and time_s < series[-1][0] - EQUAL_S:
            back_s = series[-1][0] - time_s
            steps = np.diff([time for time, _ in series[-50:]])
            usual_s = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
            is_summer = 0.25 * SUMMER_TIME_S < back_s <= SUMMER_TIME_S
            step_s = SUMMER_TIME_S if is_summer else back_s + usual_s
            moved, time_s = moved + step_s, time_s + step_s
            why = ", as at the end of summer time" if is_summer else ""
            notes.append(
                f"the clock steps back by {back_s:.6g} s in line {number}{why}: {step_s:.6g} s added from there"
            )
        series.append((time_s, float(match["value"])))
    named = {name: _series(values) for name, values in rows.items() if values}
    return named, [f"EPICS camonitor, {len(rows)} series, {left_out} lines without a number left out", *notes]


def _archived(text: str, file: str) -> tuple[dict[str, Series], list[str]]:
    """Series of the archiver appliance (its "Customizing data retrieval"), with their units in brackets."""
    try:
        content = json.loads(text)
        series, left_out = {}, 0
        for entry in content:
            meta, data = entry["meta"], entry["data"]
            name, unit = str(meta["name"]), str(meta.get("EGU", ""))
            usable = [
                row for row in data if row.get("severity", 0) < INVALID and isinstance(row.get("val"), int | float)
            ]
            left_out += len(data) - len(usable)
            rows = [(float(row["secs"]) + 1e-9 * float(row.get("nanos", 0)), float(row["val"])) for row in usable]
            series[f"{name} ({unit})" if unit else name] = _series(rows)
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise refused("archive", file, error=escaped(str(error), 60)) from error
    series = {name: values for name, values in series.items() if len(values.times_s)}
    return series, [f"EPICS archiver, {len(content)} series, {left_out} values that are invalid or no numbers left out"]


def _series(rows: Sequence[tuple[float, float]]) -> Series:
    """Rows in time order; only the last of several at one time."""
    if not rows:
        return Series(np.empty(0), np.empty(0))
    ordered = sorted(rows, key=lambda row: row[0])
    times = np.array([time_s for time_s, _ in ordered])
    is_last = np.r_[np.diff(times) > EQUAL_S, True]
    return Series(times[is_last], np.array([value for _, value in ordered])[is_last])


def _pair(series: Mapping[str, Series], file: str, stated: Mapping[str, str]) -> tuple[str, str]:
    """Names of the series of command and reading: as stated, else by words in their names."""
    changing = [name for name, values in series.items() if values.changes]
    listed = ", ".join(f"{escaped(name)} ({len(series[name].times_s)} values)" for name in changing) or "none"
    by_name = {name: name for name in series} | {re.sub(r" \([^()]*\)$", "", name): name for name in series}
    names = {field: by_name.get(stated[field], stated[field]) for field in ("command", "value") if stated.get(field)}
    for field, name in names.items():
        if name not in series:
            message = f"--column {field}={escaped(name)}: no such series; allowed: {listed}"
            raise InputError("usage", message, allowed=listed, remedy="name one of them")
    free = [name for name in changing if name not in names.values()]
    concepts = (("value", "logged-reading"), ("value", "logged-readback"), ("command", "logged-command"))
    for field, concept in concepts:
        matching = [name for name in free if place_of(words_of(name), concept) is not None]
        if field not in names and len(matching) == 1:
            names[field] = matching[0]
            free.remove(matching[0])
    missing = [field for field in ("command", "value") if field not in names]
    if len(free) < len(missing):
        raise refused("few-series", file, series=listed)
    pairs = [
        {**names, **dict(zip(missing, chosen, strict=True))}
        for chosen in islice(permutations(free, len(missing)), PAIRS_MAX)
    ]
    if len(pairs) == 1:
        return pairs[0]["command"], pairs[0]["value"]
    candidates = [
        Candidate(
            f"command {escaped(p['command'])}, reading {escaped(p['value'])}",
            ("--column", f"command={p['command']}", "--column", f"value={p['value']}"),
            {name: [f"{x:g}" for x in series[name].values[:3]] for name in p.values()},
        )
        for p in pairs
    ]
    raise asked("series", file, answers=candidates, series=listed)


def _joined(
    file: str,
    notes: Sequence[str],
    times_s: np.ndarray,
    commands: np.ndarray,
    values: np.ndarray,
    names: tuple[str, str],
) -> ForeignTable:
    """Commands and readings at the same times as a table, every n-th of many."""
    step = -(-len(values) // ROWS_KEPT)
    times = times_s[::step] - times_s[0]
    columns: dict[str, Sequence[object]] = {
        "time_s": [f"{t:.6f}" for t in times],
        names[0]: [repr(float(f"{c:.10g}")) for c in commands[::step]],
        names[1]: [f"{v:.12g}" for v in values[::step]],
    }
    thinned = [f"every {step}th reading kept"] * (step > 1)
    return table_of(file, "; ".join([*notes, *thinned]), columns, range(1, len(times) + 1))


def _command_at(commands: Series, times_s: np.ndarray) -> tuple[np.ndarray, int]:
    """Commands at times between the first and the last of a series, and the number of interpolated ones."""
    k = np.clip(np.searchsorted(commands.times_s, times_s + EQUAL_S, side="right") - 1, 0, len(commands.times_s) - 1)
    after = np.minimum(k + 1, len(commands.times_s) - 1)
    gap = commands.times_s[after] - commands.times_s[k]
    typical = float(np.median(np.diff(commands.times_s))) if len(commands.times_s) > 1 else 0.0
    fraction = np.where(gap > 0, (times_s - commands.times_s[k]) / np.where(gap > 0, gap, 1.0), 0.0)
    moving = (gap <= min(STANDSTILL_INTERVALS * typical, INTERVAL_MAX_S)) & (fraction * gap > EQUAL_S)
    rise = commands.values[after] - commands.values[k]
    return commands.values[k] + np.where(moving, fraction * rise, 0.0), int(moving.sum())


def _scatter(commands: np.ndarray, values: np.ndarray) -> float:
    """Scatter of readings about a line over their commands; infinite where these are one."""
    return float(np.std(line_through(commands, values)[1])) if len(np.unique(commands)) > 1 else np.inf


# --- Klipper ---------------------------------------------------------------------------------------------------------
def is_klipper(data: bytes) -> bool:
    """Whether a file is a log of Klipper's data logger, compressed or not, or a configuration with an angle sensor."""
    head = data[:100000].lstrip()
    # The end of a message, 3, alone says nothing: workbooks and Greek letters in UTF-16 contain that byte, too.
    return (
        data.startswith(b"\x1f\x8b")
        or (head.startswith(b"{") and (b"\x03" in head or b'"params"' in head))
        or _saved_angles(data[: 2**20]) is not None
    )


def _saved_angles(data: bytes) -> tuple[str, list[float]] | None:
    """The sensor and the table that SAVE_CONFIG wrote below "#*#" into a configuration; None if there is none."""
    if b"[angle" not in data:
        return None
    lines = [line.removeprefix("#*#").removeprefix(" ") for line in data.decode(errors="replace").splitlines()]
    parser = configparser.ConfigParser(interpolation=None, allow_no_value=True, strict=False)
    try:
        parser.read_string("\n".join(["[top]", *lines]))
    except configparser.Error:
        return None
    tables = {name: parser[name].get("calibrate") or "" for name in parser.sections() if name.startswith("angle ")}
    if not tables:
        return None
    name = max(tables, key=lambda section: len(tables[section]))
    return name.removeprefix("angle "), [float(number) for number in _NUMBER.findall(tables[name])]


def klipper_table(data: bytes, file: str) -> ForeignTable:
    """Angles of a motor's shaft by Klipper: a log of its data logger, or the table that ANGLE_CALIBRATE saves.

    Args:
        data: content of the file; a log of the data logger may be compressed.
        file: its name, for messages.

    Raises:
        InputError: no angles, no steps, or messages of another form.
    """
    if (saved := _saved_angles(data)) is not None:
        sensor, numbers = saved
        if len(numbers) < 3:
            raise refused("klipper-table", file, count=len(numbers))
        kind = f"Klipper, ANGLE_CALIBRATE of {escaped(sensor)}: a mean of both directions "
        kind += "for each full step, so that it holds no play"
        angles = [repr(number * 360.0 / KLIPPER_TURN) for number in numbers]
        columns: dict[str, Sequence[object]] = {"full steps": range(len(numbers)), "angle (deg)": angles}
        return table_of(file, kind, columns, range(1, len(numbers) + 1))
    names: dict[str, None] = {}
    angles_s, queues = list[np.ndarray](), list[np.ndarray]()
    for message in _messages(data, file):
        kind_of, _, name = str(message.get("q", "")).partition(":")
        params = message.get("params")
        if not isinstance(params, dict) or kind_of not in ("angle", "stepq"):
            continue
        names[f"{kind_of}:{name}"] = None
        (angles_s if kind_of == "angle" else queues).append(_checked(params, kind_of, file))
    kinds = {name.partition(":")[0] for name in names}
    if len(names) != 2 or kinds != {"angle", "stepq"}:
        raise refused("klipper-series", file, series=list(names) or "none")
    rows = np.concatenate(angles_s)
    readings = _series([(float(t), float(v)) for t, v in rows])
    counters = _counters_at(np.concatenate(queues), readings.times_s)
    inside = np.isfinite(counters)
    if not inside.any():
        raise refused("klipper-apart", file)
    notes = [f"Klipper, {', '.join(map(escaped, names))}"]
    notes.append(f"{int((~inside).sum())} angles before the first step left out")
    angles_deg = readings.values * 360.0 / KLIPPER_TURN
    return _joined(
        file, notes, readings.times_s[inside], counters[inside], angles_deg[inside], ("steps", "angle (deg)")
    )


def _messages(data: bytes, file: str) -> Iterator[dict[str, Any]]:
    """JSON objects of a log, compressed or not, each ended by the byte 3 or by a line end."""
    if data.startswith(b"\x1f\x8b"):
        try:
            data = zlib.decompressobj(31).decompress(data, INFLATED_BYTES_MAX)
        except zlib.error as error:
            raise refused("gzip", file) from error
    for match in re.finditer(rb"[^\x03\n]+", data):
        if match.end() - match.start() > MESSAGE_BYTES_MAX:
            raise refused("klipper-size", file, most=MESSAGE_BYTES_MAX)
        try:
            message = json.loads(match[0])
        except (ValueError, RecursionError):
            # A truncated log ends inside a message.
            continue
        if isinstance(message, dict):
            yield message


def _checked(params: Mapping[str, Any], kind: str, file: str) -> np.ndarray:
    """Rows of one message: of angles time and counts; of a queue of steps, see `_queue`."""
    try:
        with np.errstate(all="raise"):
            rows = (
                _queue(params)
                if kind == "stepq"
                else np.array([row[:2] for row in params["data"]], float).reshape(-1, 2)
            )
        if not np.isfinite(rows).all() or np.abs(rows).max(initial=0.0) > 2.0**60:
            raise ValueError("numbers out of range")
        return rows
    except (KeyError, IndexError, TypeError, ValueError, OverflowError, FloatingPointError) as error:
        raise refused("klipper-message", file, error=escaped(str(error), 60)) from error


def _queue(params: Mapping[str, Any]) -> np.ndarray:
    """Blocks of steps, shape (blocks, 6): start in s, s per clock, interval and its growth, count, position before."""
    first_s, last_s = float(params["first_step_time"]), float(params["last_step_time"])
    first_clock, last_clock = float(params["first_clock"]), float(params["last_clock"])
    blocks = np.array([row[:3] for row in params["data"]], float).reshape(-1, 3)
    per_clock_s = (last_s - first_s) / (last_clock - first_clock) if last_clock > first_clock else 0.0
    interval, count, add = blocks.T
    n = np.abs(count)
    # The k-th interval is interval + k add (klippy/chelper/stepcompress.c).
    clocks = n * interval + add * n * (n - 1) / 2
    start = np.cumsum(np.r_[-interval[:1] if len(interval) else 0.0, clocks[:-1]])[: len(n)]
    position = float(params.get("start_mcu_position", 0)) + np.cumsum(np.r_[0.0, count])[:-1]
    return np.column_stack(
        [first_s + start * per_clock_s, np.full(len(n), per_clock_s), interval, add, count, position]
    )


def _counters_at(queue: np.ndarray, times_s: np.ndarray) -> np.ndarray:
    """Counter at each time: that after the last step before it; nan before the first step."""
    if not len(queue):
        return np.full(len(times_s), np.nan)
    queue = queue[np.argsort(queue[:, 0], kind="stable")]
    latest = np.searchsorted(queue[:, 0], times_s, side="right") - 1
    start_s, per_clock_s, interval, add, count, position = queue[np.maximum(latest, 0)].T
    with np.errstate(divide="ignore", invalid="ignore"):
        clocks = np.where(per_clock_s > 0, (times_s - start_s) / per_clock_s, np.inf)
        b = interval - add / 2
        root = np.sqrt(np.maximum(b * b + 2 * add * clocks, 0.0))
        steps = np.where(add == 0, clocks / np.where(interval == 0, np.nan, interval), 2 * clocks / (b + root))
    steps = np.floor(np.clip(np.nan_to_num(steps, nan=np.inf), 0, np.abs(count)))

    def clock_of(k: np.ndarray) -> np.ndarray:
        return k * interval + add * k * (k - 1) / 2

    # The times have rounding errors of a fraction of a clock.
    steps -= (clock_of(steps) > clocks + 0.5) & (steps > 0)
    steps += (clock_of(steps + 1) <= clocks + 0.5) & (steps < np.abs(count))
    first_step_s = float(np.min(queue[:, 0] + queue[:, 1] * queue[:, 2]))
    return np.where((latest >= 0) & (times_s >= first_step_s - EQUAL_S), position + np.sign(count) * steps, np.nan)
