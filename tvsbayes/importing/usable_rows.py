"""Rows of a table of an axis that count: of a good status, with a reading, at rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from tvsbayes.errors import escaped
from tvsbayes.files.csv_table import NUMBER
from tvsbayes.importing.cells import FieldCells, without_status
from tvsbayes.importing.columns import columns_of, fill_values, first_values, line_through
from tvsbayes.importing.prepared import continued
from tvsbayes.importing.words import means, name_of

ROWS_MIN = 4
"""Rows of one command, in the median of all commands, from which a table is telemetry."""
TAIL_SHARE = 1 / 3
"""Last share of the rows of a command, in which the axis should rest."""
QUIET_SHARE = 0.8
"""Share of the commands, the quieter ones, whose last rows give the noise at rest."""
MOVING_SHARE = 0.3
"""Least share of commands with rows in motion: with fewer, rows of a command are readings of one stop."""
PLATEAU_ROWS = 3
"""Least number of rows that rest elsewhere."""
NOISE_SDS, DIGITS, FLICKER_DIGITS = 5.0, 1.5, 3.0
"""Largest distance from rest of a row at rest: standard deviations of last rows, and digits of the readings; more of
these, up to the last number, where the last rows of the command differ by them."""
STEP_SHARE = 0.02
"""Least distance of the first row of a command from rest, as a share of its step, at which the axis was under way."""
PAIRS = 'lines of "name: value"'
"""Kind of a table in which a line may be lost between a command and its reading."""
STRAY_MIN, STRAY_MADS, STRAY_SHARE = 8, 20.0, 0.1
"""Fewest rows, least distance from the line in median distances, and largest share of such readings."""
RAMP_ROWS = 6
"""Least number of rows of a stop, between which commands are passed."""
STATUS_SHARE = 0.5
"""Share of rows from which a status of numbers leaves out too many without a question."""


def good_rows(cells: FieldCells) -> FieldCells:
    """The rows with a status that can be one: it leaves some readings, and its 0 and 1 say which is good."""
    if "status" not in cells:
        return cells
    wishes, texts = cells.wishes, cells.text("status")
    numbers = [float(text) if NUMBER.fullmatch(text) else None for text in texts]
    if wishes.status_ok is not None:
        pairs = zip(numbers, texts, strict=True)
        good = ["ok" if number == wishes.status_ok else text and f"status {text}" for number, text in pairs]
        return cells.with_texts("status", good)
    bad = [bool(text.strip()) and not means(text, "good") for text in texts]
    codes = {number for number in numbers if number is not None}
    if "status" in wishes.columns or not any(bad):
        return cells
    if all(bad) and len(codes) < 2:
        return without_status(cells, "reading")
    coded = all(number is not None or not text for number, text in zip(numbers, texts, strict=True))
    if coded and sum(bad) >= STATUS_SHARE * len(texts):
        name = cells.columns["status"]
        said = {"column": name, "bad": sum(bad), "rows": len(texts)}
        raise cells.table.ask("status", each=sorted(codes), first={name: first_values(texts)}, **said)
    return cells


def without_fills(cells: FieldCells) -> FieldCells:
    """The rows without numbers that stand for no reading; asks where some may."""
    value, fill = cells.values("value"), cells.wishes.no_reading
    if fill is not None:
        how = f"{sum(value == fill)} cells of {fill:g} are empty, because --assume no_reading says so"
        cells.assumed.append(f"value: {how}")
        pairs = zip(value, cells.text("value"), strict=True)
        return cells.with_texts("value", ["" if number == fill else text for number, text in pairs])
    if "value" not in cells.wishes.columns:
        good = [not text.strip() or means(text, "good") for text in cells.text("status")]
        for fill in fill_values(cells.values("command"), np.where(good, value, np.nan)):
            rows = [cells.table.lines[k] for k in np.flatnonzero(value == fill)]
            raise cells.table.ask("no-reading", fill=fill, column=cells.columns["value"], rows=rows)
    return cells


def without_strays(cells: FieldCells) -> FieldCells:
    """The rows without readings of lines in pairs that are far from their own command, on the way to the next one.

    Two lines were lost in a row: a reading and the command after it.
    """
    command, value = cells.values("command"), cells.values("value")
    if not cells.table.kind.startswith(PAIRS) or len(value) < STRAY_MIN or not np.isfinite([command, value]).all():
        return cells
    slope, off = line_through(command, value)
    off = off - np.median(off)
    noise = float(np.median(np.abs(off)))
    ahead = slope * (np.r_[command[1:], command[-1:]] - command)
    step = abs(slope) * float(np.median(np.abs(np.diff(command))))
    of_next = ((off * ahead > 0) & (np.abs(off) < np.abs(ahead))) | (np.abs(np.abs(off) - step) < 0.1 * step)
    strays = np.flatnonzero((np.abs(off) > STRAY_MADS * noise) & of_next)
    if not len(strays) or len(strays) > STRAY_SHARE * len(value):
        return cells
    lines = ", ".join(str(cells.table.lines[row]) for row in strays)
    cells.assumed.append(f"value: left out in line {lines}, where a reading is that of a later command: lines lost")
    return cells.with_texts("value", ["" if k in strays else text for k, text in enumerate(cells.text("value"))])


def resting_rows(cells: FieldCells) -> FieldCells:
    """The rows at which the axis rests: by a column that says so, else by the readings of each command."""
    table, columns = cells.table, dict(cells.columns)
    if cells.wishes.columns.get("moving") == "":
        return cells
    if "moving" in columns:
        name = columns.pop("moving")
        is_resting, is_speed = (name_of(name).has(concept) for concept in ("resting", "speed"))
        says_yes = [means(text, "good") for text in table.columns[name]]
        rests = (cells.values("moving") != 0 if is_speed else np.array(says_yes)) == is_resting
        how = f"column {escaped(name)}"
    else:
        # Where no side is stated that before goes on.
        told = [next((w for w in ("forward", "backward") if means(text, w)), "") for text in cells.text("approach")]
        known = columns_of(table).values()
        runs = [column.cells for column in known if column.name.has("repeat") and column.whole]
        rests = at_rest(cells.values("command"), cells.values("value"), [continued(told), *runs])
        how = "the readings of each command"
    cells = replace(cells, columns=columns)
    if rests.all() or not rests.any():
        return cells
    moved = f"{int((~rests).sum())} of {len(rests)} rows left out, where the axis still moved"
    cells.assumed.append(f"rest: {moved} by {how}; --column moving= keeps them")
    keep = np.flatnonzero(rests)
    texts = {name: tuple(column[k] for k in keep) for name, column in table.columns.items()}
    return replace(cells, table=replace(table, columns=texts, lines=tuple(table.lines[k] for k in keep)))


# --- rest ------------------------------------------------------------------------------------------------------------
def at_rest(command: np.ndarray, value: np.ndarray, parts: Sequence[Sequence[str]] = ()) -> np.ndarray:
    """Whether the axis rests at each row, by the readings of each command, shape (rows,).

    The first rows of a command are left out while they differ from the last ones by more than the noise of these; all
    rows of a command, where the last ones still differ. A table with few rows a command rests everywhere, as does one
    whose first rows rest elsewhere, neither where the axis came from nor where it ends: they are of another stop.

    Args:
        command: commands in time order, nan where missing, shape (rows,).
        value: readings, nan where missing.
        parts: cells of columns that state a side or count runs: where one changes another stop begins.
    """
    rests = np.ones(len(command), bool)
    begins = np.r_[True, command[1:] != command[:-1]][: len(command)]
    for cells in parts:
        begins[1:] |= np.array([a != b for a, b in pairwise(cells)], bool)
    starts = np.flatnonzero(begins)
    blocks = [np.arange(a, b) for a, b in zip(starts, [*starts[1:], len(command)], strict=True)]
    passed = _passed(command, blocks)
    rests[[row for block in passed for row in block]] = False
    blocks = [block[np.isfinite(value[block])] for block in blocks if not any(block is ramp for ramp in passed)]
    if len(blocks) < 2 or np.median([len(block) for block in blocks]) < ROWS_MIN:
        return rests
    tails = [block[-max(3, round(TAIL_SHARE * len(block))) :] for block in blocks]
    levels = [float(np.median(value[tail])) if len(tail) else np.nan for tail in tails]
    variances = sorted(float(np.var(value[tail], ddof=1)) for tail in tails if len(tail) > 1)
    # An axis that never came to rest adds nothing to the noise at rest.
    noise = np.sqrt(np.mean(variances[: max(1, round(QUIET_SHARE * len(variances)))]))
    steps = np.diff(np.unique(value[np.isfinite(value)]))
    resolution = float(steps.min()) if len(steps) else 0.0
    least = max(NOISE_SDS * float(noise), DIGITS * resolution)
    elsewhere = set[int]()
    for k, (block, level) in enumerate(zip(blocks, levels, strict=True)):
        if len(block) < 2:
            continue
        tolerance = max(least, min(float(np.ptp(value[tails[k]])), FLICKER_DIGITS * resolution))
        off = np.abs(value[block] - level) > tolerance
        before = levels[k - 1] if k else np.nan
        way = abs(level - before) if np.isfinite(before) else np.inf
        if off[0] and (k == 0 or abs(value[block[0]] - level) > STEP_SHARE * way):
            settled = int(np.argmax(~off)) if (~off).any() else len(block)
            last = np.flatnonzero(off)
            # Beyond a single outlier the axis came back: only the rows on its way count.
            run = last[: np.argmax(np.diff(np.r_[last, len(block) + 1]) > 1) + 1]
            out = block[: max(settled, int(run[-1]) + 1)]
            rests[out] = False
            stays = len(out) >= PLATEAU_ROWS and np.ptp(value[out]) <= 2 * tolerance
            if stays and not abs(float(np.median(value[out])) - before) <= tolerance:
                elsewhere.add(k)
        if len(block) >= ROWS_MIN and abs(value[block[-1]] - value[block[-2]]) > tolerance and off.mean() > 0.5:
            rests[block] = False
    under_way = np.mean([k not in elsewhere and not rests[block].all() for k, block in enumerate(blocks)][1:])
    kept = np.ones(len(command), bool)
    kept[[row for block in passed for row in block]] = False
    return rests if under_way >= MOVING_SHARE else kept


def _passed(command: np.ndarray, blocks: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Blocks of a command that the axis passed: short ones, on the way from one long stop to the next."""
    long = [k for k, block in enumerate(blocks) if len(block) >= RAMP_ROWS]
    short = [k for k in range(len(blocks)) if long and long[0] < k < long[-1] and len(blocks[k]) <= 2]
    at = [float(command[block[0]]) for block in blocks]
    for a, b in pairwise(long):
        steps = np.diff(at[a : b + 1])
        if b > a + 1 and not (np.all(steps > 0) or np.all(steps < 0)):
            return []
    whole = len(short) + len(long) == len(blocks) and 2 * sum(len(blocks[k]) for k in long) > len(command)
    return [blocks[k] for k in short] if whole and len(short) >= len(long) >= 3 else []
