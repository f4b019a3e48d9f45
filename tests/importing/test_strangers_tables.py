"""Drawn tables of strangers (`experiments/inputs`): their truths agree with their axes, and their judge can fail."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from experiments.inputs.strangers_tables.__main__ import drawn_table, judged
from experiments.inputs.strangers_tables.judge import folder_difference
from experiments.inputs.strangers_tables.kinds import DRAWS, Drawn
from experiments.inputs.strangers_tables.measured import Reading, Truth


@pytest.fixture(scope="module")
def drawn() -> list[Drawn]:
    """Some tables of every kind."""
    tables = [drawn_table(seed) for seed in range(20_000, 20_160)]
    assert len({table.kind for table in tables}) > len(DRAWS)
    return tables


def axes(tables: Sequence[Drawn]) -> list[Truth]:
    """Truths of axes; that of a compensated one has no play beyond its scatter."""
    return [t.truth for t in tables if t.kind != "a compensated axis"]


def written(truth: Truth, folder: Path, change: Callable[[list[Reading]], list[Reading]] = lambda r: r) -> Path:
    """A folder that holds a truth, or what became of it."""
    folder.mkdir()
    (folder / "campaign.toml").write_text(f'unit = "{truth.unit or "deg"}"\n', encoding="utf-8")
    moves, readings, before, side = [], [], None, 0
    for k, r in enumerate(change(list(truth.readings))):
        first = before is None or before.segment != r.segment
        rises = 0 if first else (r.command > before.command) - (r.command < before.command)
        if r.side and not first and (rises or side) != r.side:
            # From beyond.
            beyond = r.command - r.side * 1e-3 * (1 + abs(r.command))
            moves.append((r.segment, k, beyond, ""))
        side = r.side or rises
        approach = {0: "unknown", 1: "forward", -1: "backward"}[r.side] if first else ""
        time_s = k if r.time_s is None else r.time_s
        readings.append((len(moves), repr(r.value), repr(r.u), "ok"))
        moves.append((r.segment, time_s, r.command, approach))
        before = r
    for name, head, rows in (
        ("moves.csv", "segment,time_s,command,approach", moves),
        ("readings.csv", "move,value,u,status", readings),
    ):
        with open(folder / name, "w", encoding="utf-8", newline="") as file:
            csv.writer(file).writerows([head.split(","), *rows])
    return folder


FAULTS: dict[str, Callable[[list[Reading]], list[Reading]]] = {
    "value": lambda readings: [*readings[:3], readings[3]._replace(value=1.01 * readings[3].value + 1), *readings[4:]],
    "value x 1000": lambda readings: [r._replace(value=1000 * r.value) for r in readings],
    "command": lambda readings: [readings[0]._replace(command=readings[0].command + 1.5), *readings[1:]],
    "side": lambda readings: [r._replace(side=-r.side) for r in readings],
    "u for none": lambda readings: [r._replace(u=0.5) for r in readings],
    "readings: fewer": lambda readings: readings[:-1],
    "readings: more": lambda readings: [*readings, readings[-1]._replace(command=1e6)],
    "homings": lambda readings: [*readings[:4], *(r._replace(segment=r.segment + 1) for r in readings[4:])],
    "times": lambda readings: [r._replace(time_s=1e5 * k + 0.5) for k, r in enumerate(readings)],
}


@pytest.mark.parametrize("reason", FAULTS)
def test_every_fault_of_a_folder_is_named(reason, drawn, tmp_path):
    """Of tables that state all of it."""
    seen = 0
    for number, truth in enumerate(axes(drawn)):
        if (
            not truth.unit
            or truth.cycles
            or any(r.u for r in truth.readings)
            or len({r.side for r in truth.readings}) < 2
        ):
            continue
        if reason == "times":
            truth = replace(
                truth, clock=1.1, readings=tuple(r._replace(time_s=1.0 * k) for k, r in enumerate(truth.readings))
            )
        found = folder_difference(written(truth, tmp_path / str(number), FAULTS[reason]), truth)
        assert found.startswith(reason.split(" x ")[0]) or (reason, found) == ("side", "command"), (
            reason,
            found,
            truth,
        )
        seen += 1
        if seen == 20:
            return
    pytest.fail(f"{seen} tables")


def test_forty_tables_are_read_rightly_or_asked_about():
    """None is wrong in silence; of those that state all, most need no option (nine tenths of thousands: the page)."""
    tables = {seed: judged(seed) for seed in range(40)}
    wrong = {
        seed: (table.kind, verdict) for seed, (table, verdict) in tables.items() if verdict.word in ("wrong", "crash")
    }
    assert wrong == {}
    clear = [verdict.word for table, verdict in tables.values() if table.truth.answer == "right"]
    assert len(clear) > 20 and clear.count("right") >= 0.8 * len(clear)
    asked = [verdict.word for table, verdict in tables.values() if table.truth.answer == "ask"]
    assert "asked" in asked and not {"right"} & set(asked)
