"""Is the folder that `import` writes what the table says, and do the commands that its questions print answer them?"""

from __future__ import annotations

import csv
import json
import re
import shlex
import shutil
import tomllib
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from experiments.common.commands import quietly
from experiments.inputs.strangers_tables.kinds import Drawn
from experiments.inputs.strangers_tables.measured import DOMAIN, SCALE, Reading, Truth

SPELLED = {
    "\u00b5m": "um",
    "\u03bcm": "um",
    "in": "inch",
    "mil": "thou",
    "rev": "turn",
    "turns": "turn",
    "counts": "count",
    **{"0.01 mm": "1/100 mm", "0.001 mm": "1/1000 mm", "\u00b0": "deg", "degree": "deg"},
}
"""Units as a folder may spell them."""
ANSWERS_MAX, DEPTH_MAX = 12, 3
"""Of one question, and questions that follow each other."""


class Folder(NamedTuple):
    """What was written: the unit, and readings that count, with the unit as the file has it."""

    unit: str
    readings: tuple[Reading, ...]


class Verdict(NamedTuple):
    """What became of a table."""

    word: str
    """right, guessed, asked, wrong, unanswered, refused, crash."""
    why: str = ""
    question: str = ""


def rows_of(path: Path) -> list[dict[str, str]]:
    """Rows of a CSV file by its names."""
    return list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))


def sided(moves: Sequence[dict[str, str]]) -> Iterator[int]:
    """The side from which each command was reached, by commands and stated approaches."""
    side, before = 0, None
    for row in moves:
        command, approach = float(row["command"]), row["approach"]
        first = before is None or before[0] != row["segment"]
        rises = 0 if first or before is None else (command > before[1]) - (command < before[1])
        if rises:
            side = rises
        elif first or approach:
            side = {"forward": 1, "backward": -1}.get(approach, 0)
        yield side
        before = (row["segment"], command)


def read_axis(folder: Path) -> Folder:
    """An axis folder, without the package's own reader."""
    unit = tomllib.loads((folder / "campaign.toml").read_text(encoding="utf-8"))["unit"]
    moves = rows_of(folder / "moves.csv")
    sides = list(sided(moves))
    readings = []
    for row in rows_of(folder / "readings.csv"):
        if row["status"] == "ok" and row["value"]:
            k = int(row["move"])
            move = moves[k]
            time_s = float(row.get("time_s") or move["time_s"])
            u, segment = float(row["u"] or 0), int(move["segment"])
            readings.append(Reading(float(move["command"]), float(row["value"]), sides[k], u, segment, time_s))
    return Folder(SPELLED.get(unit, unit), tuple(readings))


def folder_difference(out: Path, truth: Truth) -> str:
    """The first thing of a folder that is not as the table says; empty where all is."""
    try:
        folder = read_axis(out)
    except (OSError, KeyError, ValueError) as error:
        return f"folder of another kind: {type(error).__name__}"
    unit = truth.unit or truth.meant
    if truth.unit is not None and DOMAIN.get(folder.unit) != DOMAIN[truth.unit]:
        return f"unit {folder.unit} for {truth.unit}"
    # Of a unit that nobody knows the numbers may be left as they are.
    same = unit is not None and DOMAIN.get(folder.unit) == DOMAIN[unit]
    right = [1.0] * (truth.unit is None) + ([SCALE[folder.unit] / SCALE[unit]] if same else [])
    # Commands may have been turned into the unit of the readings.
    scales = [1.0]
    if truth.command_unit in SCALE and folder.unit in SCALE:
        scales.append(SCALE[folder.unit] / SCALE[truth.command_unit])
    wrongs = [compared(truth, folder, factor, scale) for factor in right for scale in scales]
    if "" in wrongs:
        return ""
    if wrongs[0].startswith("value") and truth.unit not in (None, folder.unit) and not compared(truth, folder, 1, 1):
        return f"unit {folder.unit} for {truth.unit}"
    return wrongs[0]


def compared(truth: Truth, folder: Folder, factor: float, scale: float) -> str:
    """The first difference, where units of the folder are so many of the table, of readings and of commands."""
    told = [r._replace(command=r.command * scale, value=r.value * factor, u=r.u * factor) for r in folder.readings]
    if len(told) != len(truth.readings):
        return f"readings: {'fewer' if len(told) < len(truth.readings) else 'more'} than there are"
    pairs = list(zip(truth.readings, told, strict=True))
    for expected, reading in pairs:
        if wrong := one_difference(truth, expected, reading):
            return wrong
    if not truth.cycles:
        changes = [[b.segment != a.segment for a, b in pairwise(readings)] for readings in (truth.readings, told)]
        if changes[0] != changes[1]:
            return "homings"
    return times(truth, pairs)


def one_difference(truth: Truth, expected: Reading, reading: Reading) -> str:
    """The difference between two readings."""
    if abs(reading.command - expected.command) > 1e-9 * max(1.0, abs(expected.command)):
        return f"command{power(reading.command, expected.command)}"
    if abs(reading.value - expected.value) > 0.6 * truth.digit + 1e-9 * abs(expected.value):
        return f"value{power(reading.value, expected.value)}"
    if abs(reading.u - expected.u) > 0.03 * expected.u:
        return f"u{power(reading.u, expected.u)}"
    # A homing forgets the side.
    unknown = reading.side == 0 and (truth.answer == "either" or truth.cycles)
    return "side" if expected.side and reading.side != expected.side and not unknown else ""


def power(found: float, expected: float) -> str:
    """By how much it is off, if by a factor that names a unit."""
    if not found or not expected:
        return " for none" if found else " lost"
    known = {1000: "x 1000", 100: "x 100", 10: "x 10", 0.001: "/ 1000", 2: "x 2", 3600: "x 3600", 25.4: "x 25.4"}
    return next((f" {text}" for value, text in known.items() if abs(found / expected / value - 1) < 0.03), "")


def times(truth: Truth, pairs: Sequence[tuple[Reading, Reading]]) -> str:
    """Times as the table states them, or none: then 0, 1, 2 ... are written. A stop has one time."""
    if not truth.clock:
        return ""
    first = [p for k, p in enumerate(pairs) if k == 0 or p[0].command != pairs[k - 1][0].command]
    stated, found = ([(p[k].time_s or 0.0) - (first[0][k].time_s or 0.0) for p in first] for k in (0, 1))
    if all(abs(t - s) <= truth.clock for t, s in zip(found, stated, strict=True)):
        return ""
    return "" if all(t == round(t) and 0 <= t <= 2 * len(pairs) for t in found) else "times"


def walk(document: Any) -> Iterator[str]:
    """Command lines in a refusal: by themselves, or in backticks of its sentences."""
    if isinstance(document, dict | list):
        for value in document.values() if isinstance(document, dict) else document:
            yield from walk(value)
    elif isinstance(document, str):
        yield from [document] if document.startswith("tvsbayes ") else re.findall(r"`(tvsbayes [^`]+)`", document)


def answers(error: dict[str, Any]) -> list[list[str]]:
    """Command lines that answer a question, as they are printed."""
    found = []
    for text in dict.fromkeys(walk(error)):
        try:
            words = shlex.split(text)[1:]
        except ValueError:
            continue
        if words[:1] == ["import"]:
            found.append([*words, *(word for word in ("--yes", "--json") if word not in words)])
    return [list(words) for words in dict.fromkeys(map(tuple, found))][:ANSWERS_MAX]


def carried_out(line: Sequence[str], out: Path) -> tuple[str, dict[str, Any]]:
    """Run a command: "written", "refused" or "crash", with its document; a folder before it is gone."""
    shutil.rmtree(out, ignore_errors=True)
    try:
        code, text, _ = quietly(*line)
        document = json.loads(text)
    except Exception as error:
        return "crash", {"error": {"message": f"{type(error).__name__}: {error}"}}
    if code == 0 and (out / "moves.csv").is_file():
        return "written", document
    return ("refused" if code in (2, 3) else "crash"), document


def answered(error: dict[str, Any], out: Path, truth: Truth, depth: int = 0) -> tuple[bool, bool]:
    """Is there an answer, and does one lead to the right folder?"""
    lines = answers(error)
    for answer in lines:
        state, document = carried_out(answer, out)
        if state == "written" and not folder_difference(out, truth):
            return True, True
        if state == "refused" and depth < DEPTH_MAX and answered(document.get("error", {}), out, truth, depth + 1)[1]:
            return True, True
    return bool(lines), False


def judge(drawn: Drawn, folder: Path) -> Verdict:
    """Import a drawn table without an option, and compare; answer what is asked."""
    path, out = folder / drawn.file.name, folder / "out"
    path.write_bytes(drawn.file.data)
    line = ["import", str(path), "--axis", "--to", str(out), "--yes", "--json"]
    state, document = carried_out(line, out)
    if state == "crash":
        return Verdict("crash", document.get("error", {}).get("message", "")[:200])
    if state == "written":
        why = folder_difference(out, drawn.truth)
        if why:
            return Verdict("wrong", why)
        if drawn.truth.meant:
            return Verdict("wrong", "a unit that nobody knows is replaced in silence")
        return Verdict("guessed" if drawn.truth.answer == "ask" else "right")
    error = document.get("error", {})
    has, right = answered(error, out, drawn.truth)
    return Verdict("asked" if right else "unanswered" if has else "refused", question=str(error.get("code")))
