"""Which looks are one experiment: numbers of each direction, numbers of a campaign, what is refused."""

from __future__ import annotations

import dataclasses

import pytest
from support.small_campaign import small_campaign
from support.written_rows import spot_row

from tvsbayes.errors import InputError
from tvsbayes.instrument.campaign import next_move, read_campaign, write_campaign
from tvsbayes.instrument.experiments import experiments_of
from tvsbayes.instrument.plan import PlanBuilder, parse_plan, write_plan

TARGETS = ("near", "far", "far", "near")


def booked(*experiments: tuple[int, int, int], status: str = "ok"):
    """A campaign of experiments (number, steps of pan, steps of tilt), one after the other, four looks each."""
    campaign = small_campaign()
    moves = [next_move([], 0, 0.0, (0, 0), ("left", "up"))]
    spots = []
    for number, *steps in experiments:
        for point, target in enumerate(TARGETS, start=1):
            if point == 3:
                at = moves[-1].pan_steps + steps[0], moves[-1].tilt_steps + steps[1]
                moves.append(next_move(moves, 0, float(len(moves)), at))
            pixels = (640.0 + len(spots), 360.0, 600.0, 360.0)
            spots.append(
                spot_row(len(spots), len(moves) - 1, target, number, point, *pixels, *(0.1,) * 4, status=status)
            )
        moves.append(next_move(moves, 0, float(len(moves)), (0, 0)))
    return dataclasses.replace(campaign, moves=tuple(moves), spots=tuple(spots))


def keys_of(campaign):
    looks = campaign.spots
    at = [(campaign.moves[look.move].pan_steps, campaign.moves[look.move].tilt_steps) for look in looks]
    found = experiments_of([s.experiment for s in looks], [s.point for s in looks], at, range(len(looks)))
    return [(key, [looks[row].spot for row in rows]) for key, rows in found]


FOUR = ((1, 200, 0), (2, 200, 0), (1, -200, 0), (2, -200, 0), (1, 0, 150), (2, 0, 150), (1, 0, -150), (2, 0, -150))


def test_numbers_that_begin_anew_in_each_direction_are_read(tmp_path):
    campaign = booked(*FOUR)
    write_campaign(campaign, tmp_path / "c")
    again = read_campaign(tmp_path / "c")
    assert again.spots == campaign.spots
    directions = ("left", "right", "up", "down")
    assert [key for key, _ in keys_of(again)] == [(d, 1) for d in directions] + [(d, 2) for d in directions]
    assert dict(keys_of(again))["right", 1] == [8, 9, 10, 11]


def test_unique_numbers_are_one_experiment_in_any_order():
    """Points 1 of all experiments first, as a plan that saves placements may see them."""
    campaign = booked((7, 200, 0), (9, -200, 0))
    shuffled = sorted(range(8), key=lambda row: (campaign.spots[row].point, row))
    at = [(campaign.moves[s.move].pan_steps, 0) for s in campaign.spots]
    numbers, points = [s.experiment for s in campaign.spots], [s.point for s in campaign.spots]
    assert experiments_of(numbers, points, at, shuffled) == [
        (("left", 7), [0, 1, 2, 3]),
        (("right", 9), [4, 5, 6, 7]),
    ]


def test_a_restarted_book_never_joins_halves_of_two_experiments():
    """Number 1 has points 1, 2 on the way left and 3, 4 on the way right; 2 says that the book begins anew."""
    campaign = booked((1, 200, 0), (2, 200, 0), (1, -200, 0), (2, -200, 0))
    kept = [s for s in campaign.spots if s.spot not in (2, 3, 8, 9)]
    found = keys_of(dataclasses.replace(campaign, spots=tuple(kept)))
    assert [(key[1], rows) for key, rows in found if key[1] == 1] == [(1, [0, 1]), (1, [10, 11])]
    assert {key[0] for key, _ in found if key[1] == 1} == {None}


@pytest.mark.parametrize(
    ("experiments", "line", "column", "words"),
    [
        (((1, 200, 0), (1, -200, 0)), 6, "point", "again .first on line 2.*one after the other"),
        (((1, 200, 0), (2, 200, 0), (1, 100, 0)), 10, "experiment", "once among the experiments that move left"),
    ],
)
def test_one_key_twice_is_refused(tmp_path, experiments, line, column, words):
    with pytest.raises(InputError, match=words) as caught:
        write_campaign(booked(*experiments), tmp_path / "c")
    assert (caught.value.line, caught.value.column) == (line, column)


def test_a_plan_keeps_the_numbers_of_each_direction(tmp_path):
    plan = PlanBuilder()
    plan.home()
    plan.place("d1")
    for number, steps in ((1, 200), (2, 200), (1, -200), (2, -200)):
        plan.move(pan=0)
        for point in (1, 2, 3, 4):
            if point == 3:
                plan.move(pan=steps)
            plan.look(number, point)
    write_plan(plan.steps, tmp_path / "plan.csv")
    assert [s.experiment for s in parse_plan((tmp_path / "plan.csv").read_bytes()) if s.point == 1] == [1, 2, 1, 2]
    twice = [dataclasses.replace(s, experiment=1) if s.experiment == 2 else s for s in plan.steps]
    with pytest.raises(InputError, match="every point of an experiment once"):
        write_plan(twice, tmp_path / "twice.csv")
