"""Series of command and reading that EPICS or Klipper logged, joined in time into a table.

EPICS: lines of `camonitor`, JSON of the archiver appliance. Klipper: messages of its data logger, the table that
ANGLE_CALIBRATE saves. Sizes are limited by what the messages hold, not by what they would expand to.
"""

from __future__ import annotations

import json
import math
import re
import zlib
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice, permutations
from typing import Any

import numpy as np

from tvsbayes.errors import Candidate, InputError, escaped
from tvsbayes.files.csv_table import NUMBER
from tvsbayes.importing.asking import ANSWERS_MAX, asked, refused
from tvsbayes.importing.clock import date_time, forward
from tvsbayes.importing.columns import line_through
from tvsbayes.importing.table import ForeignTable, table_of
from tvsbayes.importing.usable_rows import MOVING_SHARE, ROWS_MIN
from tvsbayes.importing.words import place_of, words_of

STANDSTILL_INTERVALS = 3.0
"""Typical intervals of a series after which a value that did not change is held, not interpolated."""
PASSED_SHARE = 0.05
"""Least share of the way of a move between two values on the way."""
USUAL_SHARE = 0.9
"""Least time after the last command, as a share of the usual one, of a last reading that may still be under way."""
INTERVAL_MAX_S = 2.0
"""Longest time between two values of an axis in motion: a command logged once per move is valid until the next."""
EQUAL_S = 1e-6
"""Times closer than this are equal."""
ROWS_KEPT = 2000
"""Largest number of joined rows, as many as a fit accepts; of more rows, every n-th is used."""
INFLATED_BYTES_MAX, MESSAGE_BYTES_MAX = 64 * 2**20, 2**20
KLIPPER_TURN = 65536
"""Counts per turn of an angle sensor in Klipper (klippy/extras/angle.py, ANGLE_BITS)."""
INVALID = 3
"""Severity of a value that is none (EPICS, alarm.h)."""
_CAMONITOR = re.compile(
    r"(?P<name>(?=\S*[A-Za-z])\S+)\s+(?:\(\S+\)\s*)?(?P<time>\d{4}-\d\d-\d\d \d\d:\d\d:\d\d(?:\.\d+)?)\s+"
    r"(?P<value>\S+)(?:\s+(?P<rest>\S.*))?"
)
_TABLE = r"^calibrate\s*[=:](.*(?:\n[ \t].*)*)"
"""In the section of a sensor."""
_CONCEPTS = (("value", "logged-reading"), ("value", "logged-readback"), ("command", "logged-command"))
"""Words of a series by what it is, the surest first."""


def _series(rows: Iterable[tuple[str, float, float]]) -> dict[str, np.ndarray]:
    """Times and values by name, shape (2, n), in time order; only the last of several at one time."""
    of_name = defaultdict[str, list[tuple[float, float]]](list)
    for name, time_s, value in rows:
        of_name[name].append((time_s, value))
    series = {name: np.array(sorted(own, key=lambda row: row[0]), dtype=float).T for name, own in of_name.items()}
    return {name: both[:, np.append(np.diff(both[0]) > EQUAL_S, True)] for name, both in series.items()}


def _joined(
    file: str, notes: Sequence[str], read: np.ndarray, commands: np.ndarray, names: tuple[str, str]
) -> ForeignTable:
    """Commands and readings at the same times as a table, every n-th of many."""
    step = -(-len(commands) // ROWS_KEPT)
    times, values = read[:, ::step]
    columns = {
        "time_s": [f"{t:.6f}" for t in times - times[0]],
        names[0]: [repr(float(f"{c:.10g}")) for c in commands[::step]],
        names[1]: [f"{v:.12g}" for v in values],
    }
    thinned = [f"every {step}th reading kept"] * (step > 1)
    return table_of(file, "; ".join([*notes, *thinned]), columns, range(1, len(times) + 1))


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
    (log_s, logged), read = series[command], series[value]
    steps_s = np.diff(log_s)
    # The last command stays as long as any before it.
    inside = (read[0] >= log_s[0] - EQUAL_S) & (read[0] <= log_s[-1] + max(steps_s, default=0.0) + EQUAL_S)
    if not inside.any():
        raise refused("apart", file, command=command, value=value)
    times_s, values = read = read[:, inside]
    before = np.maximum(np.searchsorted(log_s, times_s + EQUAL_S, side="right") - 1, 0)
    after = np.minimum(before + 1, len(log_s) - 1)
    gap_s, since_s, held = log_s[after] - log_s[before], times_s - log_s[before], logged[before]
    usual_s = float(np.median(steps_s)) if len(steps_s) else 0.0
    moving = (gap_s <= min(STANDSTILL_INTERVALS * usual_s, INTERVAL_MAX_S)) & (since_s > EQUAL_S) & (gap_s > 0)
    share = np.divide(since_s, gap_s, out=np.zeros(len(held)), where=moving)
    commands = held + share * (logged[after] - held)
    early, rests = times_s <= log_s[-1] + EQUAL_S, np.ones(len(held), dtype=bool)
    # A command that is logged once a move jumps; between two such rows no axis was halfway.
    if _scatter(held[early], values[early]) <= _scatter(commands[early], values[early]):
        commands, moving = held, np.zeros(1)
    elif moving.any():
        rests = early
    outside = int((~inside).sum() + (~rests).sum())
    notes += [f"command {escaped(command)}, reading {escaped(value)}"]
    notes += [f"{int(moving.sum())} commands interpolated in time, {outside} readings outside left out"]
    counts = np.unique(before, return_counts=True)[1]
    if not moving.any() and np.median(counts) < ROWS_MIN and np.mean(counts > 1) >= MOVING_SHARE:
        # A value that is logged at its change, and soon after another one, is of an axis under way.
        rests[:-1] = (np.diff(times_s) > INTERVAL_MAX_S) | (np.diff(before) > 0)
    elif not moving.any():
        # Of many values on the way those that are followed by a good part of the way.
        way = np.abs(line_through(held, values)[0] * (logged - np.r_[logged[:1], logged[:-1]]))[before]
        rests[:-1] = (np.abs(np.diff(values)) <= PASSED_SHARE * way[:-1]) | (np.diff(before) > 0) | (way[:-1] == 0)
    ends = np.flatnonzero(np.diff(before) > 0)
    if not moving.any() and len(ends):
        # The log may end on the way.
        steady = abs(values[-1] - values[-2]) <= PASSED_SHARE * abs(values[-1] - values[ends[-1]])
        rests[-1] = steady or since_s[-1] >= USUAL_SHARE * np.median(since_s[ends])
    if not moving.any():
        notes += [f"{int((~rests).sum())} readings under way left out"] * (not rests.all())
    return _joined(file, notes, read[:, rests], commands[rests], (command, value))


def _scatter(commands: np.ndarray, values: np.ndarray) -> float:
    """Scatter of readings about a line over their commands; infinite where these are one."""
    return float(np.std(line_through(commands, values)[1])) if len(np.unique(commands)) > 1 else np.inf


def _monitored(text: str) -> tuple[dict[str, np.ndarray], list[str]]:
    """Series of a camonitor log; a clock that steps back goes on."""
    rows, names, left_out = [], set[str](), 0
    for number, line in enumerate(text.splitlines(), start=1):
        if (match := _CAMONITOR.fullmatch(line.strip())) is not None:
            names.add(match["name"])
            at = date_time(match["time"])
            value = float(match["value"]) if NUMBER.fullmatch(match["value"]) else math.nan
            if at and math.isfinite(value) and "INVALID" not in (match["rest"] or "").upper():
                rows.append((number, match["name"], at, value))
                continue
        left_out += bool(line.strip())
    numbers, of, stamps, values = zip(*rows, strict=True) if rows else ((), (), (), ())
    times_s, backs = forward(((at - stamps[0]).total_seconds() for at in stamps), of)
    notes = [f"EPICS camonitor, {len(names)} series, {left_out} lines without a number left out"]
    return _series(zip(of, times_s, values, strict=True)), [*notes, *(back.text(numbers[back.row]) for back in backs)]


def _archived(text: str, file: str) -> tuple[dict[str, np.ndarray], list[str]]:
    """Series of the archiver appliance (its "Customizing data retrieval"), with their units in brackets."""
    rows, left_out = list[tuple[str, float, float]](), 0
    try:
        content = json.loads(text)
        for entry in content:
            meta, data = entry["meta"], entry["data"]
            name = str(meta["name"]) + (f" ({meta['EGU']})" if meta.get("EGU", "") else "")
            usable = [r for r in data if r.get("severity", 0) < INVALID and isinstance(r.get("val"), int | float)]
            usable = [r for r in usable if math.isfinite(r["val"])]
            left_out += len(data) - len(usable)
            rows += [(name, float(r["secs"]) + 1e-9 * float(r.get("nanos", 0)), float(r["val"])) for r in usable]
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise refused("archive", file, error=escaped(str(error), 60)) from error
    notes = [f"EPICS archiver, {len(content)} series, {left_out} values that are invalid or no numbers left out"]
    return _series(rows), notes


def _pair(series: Mapping[str, np.ndarray], file: str, stated: Mapping[str, str]) -> tuple[str, str]:
    """Names of the series of command and reading: as stated, else by words in their names."""
    changing = [name for name, (_, values) in series.items() if len(np.unique(values)) > 1]
    listed = ", ".join(f"{escaped(name)} ({series[name].shape[1]} values)" for name in changing) or "none"
    by_name = {name: name for name in series} | {re.sub(r" \([^()]*\)$", "", name): name for name in series}
    names = {field: by_name.get(stated[field], stated[field]) for field in ("command", "value") if stated.get(field)}
    for field, name in names.items():
        if name not in series:
            message = f"--column {field}={escaped(name)}: no such series; allowed: {listed}"
            raise InputError("usage", message, allowed=listed, remedy="name one of them")
    for field, concept in _CONCEPTS:
        free = [name for name in changing if name not in names.values()]
        matching = [name for name in free if place_of(words_of(name), concept) is not None]
        if field not in names and len(matching) == 1:
            names[field] = matching[0]
    free = [name for name in changing if name not in names.values()]
    missing = [field for field in ("command", "value") if field not in names]
    ways = islice(permutations(free, len(missing)), ANSWERS_MAX)
    pairs = [{**names, **dict(zip(missing, chosen, strict=True))} for chosen in ways]
    if not pairs:
        raise refused("few-series", file, series=listed)
    if len(pairs) == 1:
        return pairs[0]["command"], pairs[0]["value"]
    answers = [
        Candidate(
            f"command {escaped(pair['command'])}, reading {escaped(pair['value'])}",
            ("--column", f"command={pair['command']}", "--column", f"value={pair['value']}"),
            {name: [f"{x:g}" for x in series[name][1, :3]] for name in pair.values()},
        )
        for pair in pairs
    ]
    raise asked("series", file, answers=answers, series=listed)


# --- Klipper ---------------------------------------------------------------------------------------------------------
def is_klipper(data: bytes) -> bool:
    """Whether a file is a log of Klipper's data logger, compressed or not, or a configuration with an angle sensor."""
    head = data[:100000].lstrip()
    # The end of a message, 3, alone says nothing: workbooks and Greek letters in UTF-16 contain that byte, too.
    is_log = head.startswith(b"{") and (b"\x03" in head or b'"params"' in head)
    return is_log or data.startswith(b"\x1f\x8b") or _saved_angles(data[: 2**20]) is not None


def _saved_angles(data: bytes) -> tuple[str, list[str]] | None:
    """The sensor and the table that SAVE_CONFIG wrote below "#*#" into a configuration; None if there is none."""
    lines = data.decode(errors="replace").splitlines() if b"[angle" in data else []
    text = "\n".join(line.removeprefix("#*#").removeprefix(" ") for line in lines)
    sections = re.findall(r"^\[angle ([^\]\n]+)\].*((?:\n(?!\[).*)*)", text, re.MULTILINE)
    tables = [(name, re.findall(_TABLE, body, re.MULTILINE)) for name, body in sections]
    numbers = [(name, NUMBER.findall(" ".join(table))) for name, table in tables]
    is_configuration = b"#*#" in data or b"sensor_type" in data or any(table for _, table in tables)
    return max(numbers, key=lambda sensor: len(sensor[1])) if numbers and is_configuration else None


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
        angles = [repr(float(number) * 360.0 / KLIPPER_TURN) for number in numbers]
        columns: dict[str, Sequence[object]] = {"full steps": range(len(angles)), "angle (deg)": angles}
        return table_of(file, kind, columns, range(1, len(angles) + 1))
    rows = defaultdict[str, list[np.ndarray]](list)
    for message in _messages(data, file):
        kind, params = str(message.get("q", "")).partition(":")[0], message.get("params")
        if isinstance(params, dict) and kind in ("angle", "stepq"):
            rows[message["q"]].append(_checked(params, kind, file))
    if sorted(name.partition(":")[0] for name in rows) != ["angle", "stepq"]:
        raise refused("klipper-series", file, series=list(rows) or "none")
    angles_at, queue = (np.concatenate(rows[name]) for name in sorted(rows))
    read = _series(("", *row) for row in angles_at).get("", np.empty((2, 0)))
    counters = _counters_at(queue, read[0])
    inside = np.isfinite(counters)
    if not inside.any():
        raise refused("klipper-apart", file)
    notes = [f"Klipper, {', '.join(map(escaped, rows))}"]
    notes.append(f"{int((~inside).sum())} angles before the first step left out")
    read[1] *= 360.0 / KLIPPER_TURN
    return _joined(file, notes, read[:, inside], counters[inside], ("steps", "angle (deg)"))


def _messages(data: bytes, file: str) -> Iterator[dict[str, Any]]:
    """JSON objects of a log, compressed or not, each ended by the byte 3 or by a line end."""
    packed, data = (data, b"") if data.startswith(b"\x1f\x8b") else (b"", data)
    while packed and len(data) <= INFLATED_BYTES_MAX:
        try:
            part = zlib.decompressobj(31)
            data += part.decompress(packed, INFLATED_BYTES_MAX + 1 - len(data))
        except zlib.error as error:
            raise refused("gzip", file) from error
        packed = part.unused_data
    if len(data) > INFLATED_BYTES_MAX:
        raise refused("gzip-size", file, most=INFLATED_BYTES_MAX // 2**20)
    for match in re.finditer(rb"[^\x03\n]+", data):
        if len(match[0]) > MESSAGE_BYTES_MAX:
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
            width = 2 if kind == "angle" else 3
            rows = np.array([row[:width] for row in params["data"]], dtype=float).reshape(-1, width)
            rows = rows if kind == "angle" else _queue(params, *rows.T)
        if not np.isfinite(rows).all() or np.abs(rows).max(initial=0.0) > 2.0**60:
            raise ValueError("numbers out of range")
        return rows
    except (KeyError, IndexError, TypeError, ValueError, OverflowError, FloatingPointError) as error:
        raise refused("klipper-message", file, error=escaped(str(error), 60)) from error


def _queue(params: Mapping[str, Any], interval: np.ndarray, count: np.ndarray, add: np.ndarray) -> np.ndarray:
    """Blocks of steps, shape (blocks, 6): start in s, s per clock, interval and its growth, count, position before."""
    names = ("first_step_time", "last_step_time", "first_clock", "last_clock")
    first_s, last_s, first_clock, last_clock = (float(params[name]) for name in names)
    per_clock_s = (last_s - first_s) / (last_clock - first_clock) if last_clock > first_clock else 0.0
    steps = np.abs(count)
    # The k-th interval is interval + k add (klippy/chelper/stepcompress.c).
    clocks = np.cumsum(steps * interval + add * steps * (steps - 1) / 2)
    start_s = first_s + per_clock_s * (np.r_[0.0, clocks[:-1]][: len(steps)] - interval[:1])
    position = float(params.get("start_mcu_position", 0)) + np.cumsum(count) - count
    return np.column_stack([start_s, np.full(len(steps), per_clock_s), interval, add, count, position])


def _counters_at(queue: np.ndarray, times_s: np.ndarray) -> np.ndarray:
    """Counter at each time: that after the last step before it; nan before the first step."""
    if not len(queue):
        return np.full(len(times_s), np.nan)
    first_step_s = float(np.min(queue[:, 0] + queue[:, 1] * queue[:, 2]))
    queue = queue[np.argsort(queue[:, 0], kind="stable")]
    latest = np.searchsorted(queue[:, 0], times_s, side="right") - 1
    start_s, per_clock_s, interval, add, count, position = queue[np.maximum(latest, 0)].T
    with np.errstate(divide="ignore", invalid="ignore"):
        # Times are rounded to a fraction of a clock. The last step k has k interval + add k (k - 1) / 2 <= clocks.
        clocks = np.where(per_clock_s > 0, (times_s - start_s) / per_clock_s, np.inf) + 0.5
        first = interval - add / 2
        steps = 2 * clocks / (first + np.sqrt(np.maximum(first * first + 2 * add * clocks, 0.0)))
    steps = np.floor(np.clip(np.nan_to_num(steps, nan=np.inf), 0, np.abs(count)))
    is_known = (latest >= 0) & (times_s >= first_step_s - EQUAL_S)
    return np.where(is_known, position + np.sign(count) * steps, np.nan)
