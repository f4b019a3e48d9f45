"""The test of an axis by ISO 230-2 against an independent implementation and published tables."""

from __future__ import annotations

from dataclasses import replace
from statistics import mean, stdev

import numpy as np
import pytest
from support.axes import campaign, runs
from support.published_iso230 import PUBLISHED, vector_runs

from tvsbayes.single_axis.axis_campaign import AxisCampaign, AxisMove, Reading
from tvsbayes.single_axis.axis_rows import AxisRows, rows_of
from tvsbayes.single_axis.classic_line import classic_axis

type Table = dict[float, list[float]]
ROUNDING = 1e-9
"""Of positions of 500 mm and deviations of 0.01 mm: 500 * 2^-52 / 0.01, a few times."""


def by_the_standard(forward: Table, backward: Table) -> dict[str, float]:
    """Figures by the definitions of ISO 230-2, a line each; deviations by target."""
    places = sorted(forward)
    up, down = ({p: mean(side[p]) for p in places} for side in (forward, backward))
    s_up, s_down = ({p: stdev(side[p]) for p in places} for side in (forward, backward))
    b = {p: up[p] - down[p] for p in places}
    both = [(up[p] + down[p]) / 2 for p in places]
    r_both = [max(2 * s_up[p] + 2 * s_down[p] + abs(b[p]), 4 * s_up[p], 4 * s_down[p]) for p in places]
    high_up, low_up = max(up[p] + 2 * s_up[p] for p in places), min(up[p] - 2 * s_up[p] for p in places)
    high_down, low_down = max(down[p] + 2 * s_down[p] for p in places), min(down[p] - 2 * s_down[p] for p in places)
    means = [*up.values(), *down.values()]
    return {
        "reversal": max(map(abs, b.values())),
        "mean_reversal": mean(b.values()),
        "repeatability_forward": 4 * max(s_up.values()),
        "repeatability_backward": 4 * max(s_down.values()),
        "repeatability": max(r_both),
        "systematic_forward": max(up.values()) - min(up.values()),
        "systematic_backward": max(down.values()) - min(down.values()),
        "systematic": max(means) - min(means),
        "mean_systematic": max(both) - min(both),
        "accuracy_forward": high_up - low_up,
        "accuracy_backward": high_down - low_down,
        "accuracy": max(high_up, high_down) - min(low_up, low_down),
    }


def screw(seed: int) -> AxisCampaign:
    """A drawn run in mm: 3 to 12 targets, 2 to 7 cycles, scale, play, scatter, a zero that creeps."""
    rng = np.random.default_rng(seed)
    places = np.cumsum(rng.uniform(5.0, 60.0, rng.integers(3, 13)))
    moves = runs(int(rng.integers(2, 8)), places.round(3).tolist(), beyond=2.0)
    command = np.array([m.command for m in moves])
    side = np.r_[-1.0, np.sign(np.diff(command))]
    value = command * (1 + rng.normal(0, 1e-4)) + 0.003 * np.sin(command / 9) - rng.uniform(0, 0.01) * side / 2
    value += rng.normal(0, 0.002, len(moves)) + np.linspace(0, rng.normal(0, 0.01), len(moves)) + rng.normal(0, 50)
    read = [k for k, c in enumerate(command) if places.min() - 1 < c < places.max() + 1]
    return AxisCampaign("mm", moves, tuple(Reading(n, k, float(value[k])) for n, k in enumerate(read)))


def tables(data: AxisCampaign) -> tuple[Table, Table]:
    """Deviations by target and side, from moves and readings alone."""
    sides: tuple[Table, Table] = ({}, {})
    for reading in data.readings:
        command, before = data.moves[reading.move].command, data.moves[reading.move - 1].command
        sides[command < before].setdefault(command, []).append(reading.value - command)
    return sides


@pytest.mark.parametrize("first", range(0, 100, 10))
def test_figures_are_those_of_the_standard(first):
    """Twelve figures of 100 drawn runs, and the table by position."""
    for seed in range(first, first + 10):
        data = screw(seed)
        classic, (forward, backward) = classic_axis(rows_of(data)), tables(data)
        wanted = by_the_standard(forward, backward)
        assert list(classic.iso230) == list(wanted) == list(classic.symbols)
        np.testing.assert_allclose(list(classic.iso230.values()), list(wanted.values()), rtol=ROUNDING, atol=1e-12)
        for row in classic.iso230_targets:
            up, down = forward[row.position], backward[row.position]
            np.testing.assert_allclose([row.mean_forward, row.s_forward], [mean(up), stdev(up)], rtol=ROUNDING)
            assert row.reversal == pytest.approx(mean(up) - mean(down), rel=1e-6)
            assert (row.runs_forward, row.runs_backward) == (len(up), len(down))


def test_published_figures():
    """Figures that a report prints (ecmccfg, examples/test/fat_sat/report.md): five runs to and fro, readings in mm."""
    up, down = vector_runs()
    places = (-10.0, -4.88, 0.24, 5.36, 10.48)
    moves = runs(5, places, beyond=1.0)
    visits = {(p, s): iter(table[k]) for k, p in enumerate(places) for s, table in ((1.0, up), (-1.0, down))}
    sides = [0.0, *np.sign(np.diff([m.command for m in moves]))]
    readings = [
        Reading(0, m.move, m.command + 1e-6 * float(next(visits[m.command, side])))
        for m, side in zip(moves, sides, strict=True)
        if m.command in places
    ]
    readings = [replace(reading, reading=k) for k, reading in enumerate(readings)]
    classic = classic_axis(rows_of(AxisCampaign("mm", moves, tuple(readings), command_unit="mm")))
    for name, nm in PUBLISHED.items():
        of_axis = name.removesuffix("_deg").replace("_up", "_forward").replace("_down", "_backward")
        # Doubles near 10 mm, and the seven digits of the table.
        assert classic.iso230[of_axis] == pytest.approx(1e-6 * nm, rel=1e-6, abs=2e-14), name


def drifting(slope: float, unit: str | None = None) -> AxisRows:
    moves = runs(3, (0.0, 50.0, 100.0), beyond=5.0)
    values = [slope * m.command for m in moves]
    data = campaign(moves, values)
    return rows_of(AxisCampaign("mm", data.moves, data.readings, command_unit=unit))


@pytest.mark.parametrize(
    ("slope", "unit", "there", "words"),
    [
        (1.01, None, True, "since the slope is 1.01"),
        (1.2, None, False, "a command is 1.2 mm"),
        (1.2, "mm", True, "as campaign.toml states"),
        (1.0, "steps", False, "commands are in steps"),
        (-1.0, "mm", False, "turn their sign round"),
    ],
)
def test_targets_are_known_or_there_are_no_figures(slope, unit, there, words):
    rows = drifting(slope, unit)
    classic = classic_axis(rows)
    assert (classic.iso230 is not None) == there and words in classic.iso230_basis
    # The line's stay.
    assert classic.iso230_about_line["systematic"] == pytest.approx(0.0, abs=1e-9)
    if there:
        # Over the targets, ends beyond included.
        assert classic.iso230["systematic"] == pytest.approx(abs(slope - 1) * 100.0, abs=1e-9)


def figures(commands: list[float], values: list[float]) -> dict[str, float | None]:
    moves = [AxisMove(k, 0, 60.0 * k, c, "" if k else "unknown") for k, c in enumerate(commands)]
    data = campaign(moves, values)
    return classic_axis(rows_of(AxisCampaign("mm", data.moves, data.readings, command_unit="mm"))).iso230
