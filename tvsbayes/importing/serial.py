"""Logs of serial monitors: lines of "name: value" pairs, a row on one line or over several."""

from __future__ import annotations

import re
from collections import Counter
from itertools import pairwise
from typing import NamedTuple

from tvsbayes.importing.table import Row, Rows

PAIRED_SHARE = 0.6
"""Least share of "name: value" lines in a file of pairs; the others are messages at a program's start."""
VALUES_MIN = 20
"""Least number of values of a name by whose decimals one can be seen to be cut."""
USUAL_SHARE = 0.97
"""Share of a name's values with one number of decimals, from which a value with fewer was cut."""
REPEATED_SHARE = 0.1
"""Largest share of lines equal to the line before, below which such a line was sent twice."""
DAY_S = 86400.0
NAMED_MAX = 6
_PAIR = re.compile(
    r"(?P<name>[^\W\d][^:=,;|\t]*?)\s*[:=]\s*(?P<value>[+-]?(?:\d+[.,]\d+|\d+\.?|\.\d+)(?:[eE][+-]?\d+)?)"
    r"(?:\s*(?P<unit>\u00b0|mm|um|\u00b5m|deg|rad|counts|steps|ms|us|s)(?![\w:]))?\s*(?:[,;|\t]\s*|\s+|$)"
)
"""One pair of "Step: 200, Angle: 12.5 deg"."""
_CLOCK = re.compile(r"\[?(\d{1,2}):(\d{2}):(\d{2}(?:\.\d+)?)\]?\s*(?:->|>)?\s*")
"""Time of day that a serial monitor puts before a line."""


class _Pair(NamedTuple):
    """A value of a line, with the time of day before the line."""

    line: int
    name: str
    value: str
    clock_s: float | None


def paired_rows(text: str, file: str) -> Rows | None:
    """Rows of a file whose lines are "name: value" pairs; None for any other file.

    The names of a row follow each other in the usual order. A value without its place in that order, after a line that
    was lost, repeated or cut, is left out and its line is named.
    """
    lines = [(n, line.strip()) for n, line in enumerate(text.splitlines(), start=1) if line.strip()]
    pairs_of = {n: found for n, line in lines if (found := _pairs(n, line))}
    if len(pairs_of) < PAIRED_SHARE * len(lines) or len(pairs_of) < 2:
        return None
    if any(len({pair.name for pair in found}) < len(found) for found in pairs_of.values()):
        return None
    damaged = _repeated_lines(lines, pairs_of)
    stream = [pair for n, found in pairs_of.items() if n not in damaged for pair in found]
    damaged |= (cut := _cut_lines(stream))
    stream = [pair for pair in stream if pair.line not in cut]
    counts = Counter(pair.name for pair in stream)
    usual = [name for name, count in counts.items() if 2 * count > max(counts.values())]
    rows, orphans = _blocks(stream, usual)
    if len(usual) < 2 or len(rows) < 2:
        return None
    damaged |= orphans
    names = [*usual, *(name for name in counts if name not in usual)]
    times = _times([row[usual[0]].clock_s for row in rows])
    head = ["time (s)"] * (timed := times is not None and "time (s)" not in names) + names
    body = []
    for k, row in enumerate(rows):
        cells = [row[name].value if name in row else "" for name in names]
        first = min(pair.line for pair in row.values())
        body.append(Row(first, [f"{times[k]:.6f}", *cells] if timed and times is not None else cells))
    notes = ['lines of "name: value"']
    others = [n for n, _ in lines if n not in pairs_of]
    between = [n for n in others if body[0].line < n]
    damaged |= set(between)
    if n := len(others) - len(between):
        notes.append(f"{n} line{'s' * (n > 1)} before the first row left out")
    if damaged:
        named = ", ".join(map(str, sorted(damaged)[:NAMED_MAX])) + " ..." * (len(damaged) > NAMED_MAX)
        one = len(damaged) == 1
        notes.append(
            f"line{'' if one else 's'} {named} left out: lost, repeated or cut beside {'it' if one else 'them'}"
        )
    return Rows([Row(body[0].line, head), *body], notes)


def _pairs(number: int, line: str) -> list[_Pair]:
    """The pairs of a line, [] where it holds anything else."""
    clock = _CLOCK.match(line)
    content = line[clock.end() if clock else 0 :]
    found = list(_PAIR.finditer(content))
    if not found or "".join(match.group() for match in found) != content:
        return []
    clock_s = int(clock[1]) * 3600 + int(clock[2]) * 60 + float(clock[3]) if clock else None
    return [
        _Pair(
            number, m["name"].strip() + (f" ({m['unit']})" if m["unit"] else ""), m["value"].replace(",", "."), clock_s
        )
        for m in found
    ]


def _repeated_lines(lines: list[tuple[int, str]], pairs_of: dict[int, list[_Pair]]) -> set[int]:
    """Lines sent twice: equal to the line before, where lines seldom are."""
    repeated = {n for (_, before), (n, line) in pairwise(lines) if line == before and n in pairs_of}
    return repeated if len(repeated) <= REPEATED_SHARE * len(lines) else set()


def _cut_lines(stream: list[_Pair]) -> set[int]:
    """Lines with a value of fewer decimals than nearly all others of its name."""
    decimals = {pair: len(pair.value.partition(".")[2]) for pair in stream}
    by_name: dict[str, Counter[int]] = {}
    for pair, places in decimals.items():
        by_name.setdefault(pair.name, Counter())[places] += 1
    usual = {name: counts.most_common(1)[0] for name, counts in by_name.items()}
    return {
        pair.line
        for pair, places in decimals.items()
        if places < usual[pair.name][0]
        and by_name[pair.name].total() >= VALUES_MIN
        and usual[pair.name][1] >= USUAL_SHARE * (by_name[pair.name].total() - 1)
    }


def _blocks(stream: list[_Pair], usual: list[str]) -> tuple[list[dict[str, _Pair]], set[int]]:
    """Rows of the usual names, and the lines of values without a place in one.

    Where several values of the last names follow one of the first, each makes a row with it.
    """
    signatures = Counter(tuple(names) for names in _split(stream, usual))
    signature = signatures.most_common(1)[0][0] if signatures else ()
    rows: list[dict[str, _Pair]] = []
    orphans: set[int] = set()
    block: list[_Pair] = []
    extras: dict[str, _Pair] = {}

    def end() -> None:
        names = [pair.name for pair in block]
        heads = {pair.name: pair for pair in block if signature.count(pair.name) == 1}
        repeats = [name for name in dict.fromkeys(signature) if signature.count(name) > 1]
        if not block or names[0] != signature[0]:
            orphans.update(pair.line for pair in block)
        elif len(heads) < len(set(signature) - set(repeats)):
            # A move whose reading was lost is a move.
            rows.append({**heads, **extras})
        elif not repeats:
            rows.append({**heads, **extras})
        else:
            values = [[pair for pair in block if pair.name == name] for name in repeats]
            rows.extend(
                {**heads, **extras, **dict(zip(repeats, parts, strict=True))} for parts in zip(*values, strict=False)
            )
        block.clear()
        extras.clear()

    for pair in stream:
        if pair.name not in usual:
            extras[pair.name] = pair
            continue
        if pair.name == (signature[0] if signature else "") and block:
            end()
        place = len(block)
        if place < len(signature) and pair.name == signature[place]:
            block.append(pair)
        elif pair.name in signature[place:] and not block:
            orphans.add(pair.line)
        else:
            orphans.add(pair.line)
    end()
    return rows, orphans


def _split(stream: list[_Pair], usual: list[str]) -> list[list[str]]:
    """Names of the usual values, from one first name to the next."""
    blocks: list[list[str]] = []
    for pair in stream:
        if pair.name in usual:
            if pair.name == usual[0] or not blocks:
                blocks.append([])
            blocks[-1].append(pair.name)
    return blocks


def _times(clocks_s: list[float | None]) -> list[float] | None:
    """Seconds since the first row; a step back by more than half a day is midnight."""
    if any(clock is None for clock in clocks_s):
        return None
    times, days = [], 0.0
    for k, clock_s in enumerate(clocks_s):
        if k and clock_s < clocks_s[k - 1] - DAY_S / 2:  # type: ignore[operator]
            days += DAY_S
        times.append(clock_s + days)  # type: ignore[operator]
    return [time_s - times[0] for time_s in times]
