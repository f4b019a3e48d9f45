"""The last entry of the ledger of speed and coverage is within its bounds, and the bounds can fail."""

from __future__ import annotations

import copy

import pytest

from experiments.common.rows import read_rows
from experiments.speed.ledger import BOUNDS, LEDGER, figures, problems

ENTRIES = read_rows(LEDGER)


def test_the_last_entry_is_within_the_bounds():
    assert set(figures(ENTRIES[-1])) == set(BOUNDS)
    assert problems(ENTRIES[-1]) == []


@pytest.mark.parametrize("name", sorted(ENTRIES[-1]["commands"]))
def test_a_command_of_twice_the_cost_is_named(name):
    worse = copy.deepcopy(ENTRIES[-1])
    worse["commands"][name] *= 2
    assert [problem.split(":")[0] for problem in problems(worse)] == [f"CPU of {name} / imports"]


@pytest.mark.parametrize(("what", "count"), [("axes", "held"), ("benches", "held"), ("benches", "answered")])
def test_intervals_out_of_bounds_are_named(what, count):
    worse = copy.deepcopy(ENTRIES[-1])
    worse["intervals"][what][count] = int(0.7 * worse["intervals"][what][count])
    assert len(problems(worse)) == 1
