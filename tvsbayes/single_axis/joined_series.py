"""Logs with the command and the reading of an axis as two series, each with its own times: EPICS, Klipper.

Values are logged at changes. A reading gets the command at its time: interpolated while the command changes, else
the last one. The result is a table, as that of `read_foreign`.
"""

from __future__ import annotations

import configparser
import datetime
import json
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tvsbayes.errors import InputError, escaped, refusal
from tvsbayes.files.foreign_table import ForeignTable, table_of
from tvsbayes.instrument.column_names import words_of

STANDSTILL_INTERVALS = 5.0
"""An interval of this many typical ones means standstill: the value did not change during it."""
EQUAL_S = 1e-6
"""Times closer than this are equal."""
ROWS_KEPT = 2000
"""Largest number of joined rows, as many as a fit accepts; of more rows, every n-th is used."""
INFLATED_BYTES_MAX = 256 * 2**20
KLIPPER_TURN = 65536
"""Counts per turn of an angle sensor in Klipper (klippy/extras/angle.py, ANGLE_BITS)."""
STEPS_MAX = 20_000_000
_CAMONITOR = re.compile(
    r"(?P<name>\S+)\s+(?:\(\S+\)\s*)?(?P<time>\d{4}-\d\d-\d\d \d\d:\d\d:\d\d(?:\.\d+)?)\s+"
    r"(?P<value>\S+)(?:\s+(?P<rest>\S.*))?"
)
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?")
_READING_WORDS = ("encoder", "enc", "ssi", "biss", "endat", "absolute", "reading", "measured", "interferometer")
_COMMAND_WORDS = ("axis", "motor", "setpoint", "sp", "val", "command", "cmd", "steps", "step", "counter", "demand")


@dataclass(frozen=True)
class Series:
    """Values by time, logged at changes.

    Attributes:
        times_s: ascending, shape (n,).
        values: shape (n,).
    """

    times_s: np.ndarray
    values: np.ndarray

    @property
    def changes(self) -> bool:
        """Whether it has more than one value."""
        return len(np.unique(self.values)) > 1


def is_camonitor(text: str) -> bool:
    """Whether most lines of a text are of EPICS' camonitor."""
    lines = [line for line in text.splitlines()[:50] if line.strip()]
    return bool(lines) and 2 * sum(bool(_CAMONITOR.match(line)) for line in lines) > len(lines)


def is_klipper(data: bytes) -> bool:
    """Whether a file is a log of Klipper's data logger, compressed or not, or a configuration with an angle sensor."""
    head = data[:100000].lstrip()
    # The end of a message, 3, alone says nothing: workbooks and Greek letters in UTF-16 contain that byte, too.
    return (
        data.startswith(b"\x1f\x8b")
        or (head.startswith(b"{") and (b"\x03" in head or b'"params"' in head))
        or _saved_angles(data[: 2**20]) is not None
    )


def camonitor_table(text: str, file: str, stated: Mapping[str, str]) -> ForeignTable:
    """The pair of series of a camonitor log, joined in time.

    Args:
        text: text of the log.
        file: its name, for messages.
        stated: name of a series by `command` or `value`, as the user states it.

    Raises:
        InputError: no unique pair of command and reading, or no time at which both are known.
    """
    by_name: dict[str, list[tuple[float, float]]] = {}
    left_out, start = 0, None
    for line in text.splitlines():
        match = _CAMONITOR.fullmatch(line.strip())
        if match is None:
            left_out += bool(line.strip())
            continue
        rest = (match["rest"] or "").upper()
        if not _NUMBER.fullmatch(match["value"]) or "INVALID" in rest:
            by_name.setdefault(match["name"], [])
            left_out += 1
            continue
        date_time = datetime.datetime.fromisoformat(match["time"])
        start = start or date_time
        by_name.setdefault(match["name"], []).append(((date_time - start).total_seconds(), float(match["value"])))
    series = {name: _series(rows) for name, rows in by_name.items() if rows}
    names = _series_names(series, file, stated)
    kind = f"EPICS camonitor, {len(by_name)} series, {left_out} lines without a number left out"
    return _joined(series, names["command"], names["value"], file, kind)


def _series(rows: Sequence[tuple[float, float]]) -> Series:
    """Rows in time order; only the last of several at one time."""
    ordered = sorted(rows, key=lambda row: row[0])
    times = np.array([time_s for time_s, _ in ordered])
    is_last = np.r_[np.diff(times) > EQUAL_S, True]
    return Series(times[is_last], np.array([value for _, value in ordered])[is_last])


def _series_names(series: Mapping[str, Series], file: str, stated: Mapping[str, str]) -> dict[str, str]:
    """Names of the series of `command` and `value`: as stated, else by words in their names.

    Raises:
        InputError: the names do not determine the pair.
    """
    changing = [name for name, values in series.items() if values.changes]
    listed = ", ".join(f"{escaped(name)} ({len(series[name].times_s)} values)" for name in changing) or "none"
    for field in ("command", "value"):
        if (name := stated.get(field)) and name not in series:
            message = f"--column {field}={escaped(name)}: no such series; allowed: {listed}"
            raise InputError("usage", message, allowed=listed, remedy="name one of them")
    free = [name for name in changing if name not in stated.values()]
    names = {field: name for field in ("command", "value") if (name := stated.get(field))}
    for field, words in (("value", _READING_WORDS), ("command", _COMMAND_WORDS)):
        matching = [name for name in free if set(words_of(name)).intersection(words)]
        if field not in names and len(matching) == 1:
            names[field] = matching[0]
            free.remove(matching[0])
    missing = [field for field in ("command", "value") if field not in names]
    if len(missing) == 1 and len(free) == 1:
        names[missing[0]] = free[0]
    elif missing:
        found, allowed = f"series that change: {listed}", "one that is commanded and one that is read"
        remedy = "say which: --column command=NAME --column value=NAME"
        raise refusal("missing-column", file=file, found=found, allowed=allowed, remedy=remedy)
    return names


def _joined(series: Mapping[str, Series], command: str, value: str, file: str, kind: str) -> ForeignTable:
    """Samples of the reading with the command at their times.

    Raises:
        InputError: the series do not overlap in time.
    """
    log, read = series[command], series[value]
    inside = (read.times_s >= log.times_s[0] - EQUAL_S) & (read.times_s <= log.times_s[-1] + EQUAL_S)
    if not inside.any():
        found, remedy = f"no value of {escaped(value)} between the first and the last of {escaped(command)}", ""
        remedy = "name two series of one time with --column command=NAME --column value=NAME"
        raise refusal("empty", file=file, found=found, allowed="series that overlap in time", remedy=remedy)
    commands, interpolated = command_at(log, read.times_s[inside])
    notes = [kind, f"command {escaped(command)}, reading {escaped(value)}"]
    notes.append(f"{interpolated} commands interpolated in time, {int((~inside).sum())} readings outside left out")
    return _pairs_table(file, notes, Series(read.times_s[inside], commands), read.values[inside], (command, value))


def _pairs_table(
    file: str, notes: Sequence[str], commands: Series, values: np.ndarray, names: tuple[str, str]
) -> ForeignTable:
    """Commands and readings at the same times as a table, every n-th of many; `names` are the names of both."""
    step = -(-len(values) // ROWS_KEPT)
    times = commands.times_s[::step] - commands.times_s[0]
    columns: dict[str, Sequence[object]] = {
        "time_s": [f"{t:.6f}" for t in times],
        names[0]: [repr(float(f"{c:.10g}")) for c in commands.values[::step]],
        names[1]: [f"{v:.12g}" for v in values[::step]],
    }
    thinned = [f"every {step}th reading kept"] * (step > 1)
    return table_of(file, "; ".join([*notes, *thinned]), columns, range(1, len(times) + 1))


INTERVAL_MAX_S = 2.0
"""Longest time between two values of an axis in motion: a command logged once per move is valid until the next."""


class CommandsInTime(NamedTuple):
    """Commands at times (n,), and the number of interpolated ones."""

    commands: np.ndarray
    interpolated: int


def command_at(commands: Series, times_s: np.ndarray) -> CommandsInTime:
    """Commands at times between the first and the last of a series.

    Args:
        commands: commands logged at changes.
        times_s: shape (n,).
    """
    k = np.clip(np.searchsorted(commands.times_s, times_s + EQUAL_S, side="right") - 1, 0, len(commands.times_s) - 1)
    after = np.minimum(k + 1, len(commands.times_s) - 1)
    gap = commands.times_s[after] - commands.times_s[k]
    typical = float(np.median(np.diff(commands.times_s))) if len(commands.times_s) > 1 else 0.0
    fraction = np.where(gap > 0, (times_s - commands.times_s[k]) / np.where(gap > 0, gap, 1.0), 0.0)
    moving = (gap <= min(STANDSTILL_INTERVALS * typical, INTERVAL_MAX_S)) & (fraction * gap > EQUAL_S)
    rise = commands.values[after] - commands.values[k]
    return CommandsInTime(commands.values[k] + np.where(moving, fraction * rise, 0.0), int(moving.sum()))


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
        InputError: no angles, or no steps.
    """
    if (saved := _saved_angles(data)) is not None:
        sensor, numbers = saved
        if len(numbers) < 3:
            found, remedy = f"a calibration of {len(numbers)} angles", "run ANGLE_CALIBRATE and SAVE_CONFIG"
            raise refusal("empty", file=file, found=found, allowed="one for every full step", remedy=remedy)
        kind = f"Klipper, ANGLE_CALIBRATE of {escaped(sensor)}: a mean of both directions "
        kind += "for each full step, so that it holds no play"
        angles = [repr(number * 360.0 / KLIPPER_TURN) for number in numbers]
        columns: dict[str, Sequence[object]] = {"full steps": range(len(numbers)), "angle (deg)": angles}
        return table_of(file, kind, columns, range(1, len(numbers) + 1))
    angles_s: list[tuple[float, float]] = []
    steps: list[Series] = []
    names: dict[str, None] = {}
    for message in _messages(data, file):
        kind_of, _, name = str(message.get("q", "")).partition(":")
        params = message.get("params")
        if not isinstance(params, dict) or kind_of not in ("angle", "stepq"):
            continue
        names[f"{kind_of}:{name}"] = None
        if kind_of == "angle":
            angles_s += [(float(row[0]), float(row[1]) * 360.0 / KLIPPER_TURN) for row in params.get("data", [])]
        else:
            steps.append(_steps(params, file))
    kinds = {name.partition(":")[0] for name in names}
    if len(names) != 2 or kinds != {"angle", "stepq"}:
        found, allowed = f"series {', '.join(map(escaped, names)) or 'none'}", "one angle:NAME and one stepq:NAME"
        remedy = "log one sensor and its stepper with data_logger.py; or name it in a table of your own"
        raise refusal("missing-column", file=file, found=found, allowed=allowed, remedy=remedy)
    times, positions = (np.concatenate([getattr(s, name) for s in steps]) for name in ("times_s", "values"))
    order = np.argsort(times, kind="stable")
    readings, counters = _series(angles_s), Series(times[order], positions[order])
    # Steps are instantaneous commands and are not interpolated.
    latest = np.searchsorted(counters.times_s, readings.times_s, side="right") - 1
    inside = latest >= 0
    if not inside.any():
        remedy = "log both at once, while the stepper moves"
        raise refusal("empty", file=file, found="no angle after a step", allowed="steps and angles", remedy=remedy)
    notes = [f"Klipper, {', '.join(map(escaped, names))}"]
    notes.append(f"{int((~inside).sum())} angles before the first step left out")
    commands = Series(readings.times_s[inside], counters.values[latest[inside]])
    return _pairs_table(file, notes, commands, readings.values[inside], ("steps", "angle (deg)"))


def _messages(data: bytes, file: str) -> Iterator[dict]:
    """JSON objects of a log, compressed or not, each ended by the byte 3 or by a line end."""
    if data.startswith(b"\x1f\x8b"):
        try:
            data = zlib.decompressobj(31).decompress(data, INFLATED_BYTES_MAX)
        except zlib.error as error:
            found, remedy = "a damaged gzip file", "copy it again, or cut it where it ends"
            raise refusal("kind", file=file, found=found, allowed="a log of data_logger.py", remedy=remedy) from error
    for text in re.split(rb"[\x03\n]", data):
        try:
            message = json.loads(text) if text.strip() else None
        except ValueError:
            # A truncated log ends inside a message.
            continue
        if isinstance(message, dict):
            yield message


def _steps(params: Mapping[str, object], file: str) -> Series:
    """Counter after every step of one message of a stepper's queue."""
    try:
        first_s, last_s = float(params["first_step_time"]), float(params["last_step_time"])  # type: ignore[arg-type]
        first_clock, last_clock = int(params["first_clock"]), int(params["last_clock"])  # type: ignore[call-overload]
        blocks = [tuple(int(cell) for cell in row) for row in params["data"]]  # type: ignore[attr-defined]
        position = int(params.get("start_mcu_position", 0))  # type: ignore[call-overload]
    except (KeyError, TypeError, ValueError) as error:
        found, remedy = "a queue of steps of another form", "log it with data_logger.py of this Klipper"
        raise refusal("kind", file=file, found=found, allowed="its fields", remedy=remedy) from error
    if sum(abs(count) for _, count, _ in blocks) > STEPS_MAX:
        raise refusal("size", file=file, found="more steps", allowed=f"{STEPS_MAX}", remedy="log a shorter time")
    per_clock_s = (last_s - first_s) / (last_clock - first_clock) if last_clock > first_clock else 0.0
    clocks, signs, clock = [], [], first_clock - (blocks[0][0] if blocks else 0)
    for interval, count, add in blocks:
        k = np.arange(abs(count))
        # The k-th interval is interval + k add (klippy/chelper/stepcompress.c).
        clocks.append(clock + np.cumsum(interval + k * add))
        signs.append(np.full(len(k), 1 if count > 0 else -1))
        clock = int(clocks[-1][-1]) if len(k) else clock
    if not clocks:
        return Series(np.empty(0), np.empty(0))
    times_s = first_s + (np.concatenate(clocks) - first_clock) * per_clock_s
    return Series(times_s, position + np.cumsum(np.concatenate(signs)))
