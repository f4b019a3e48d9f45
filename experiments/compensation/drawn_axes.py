"""Drawn axes that are driven anywhere, also by what a table adds: their moves, where they stand, what is read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tvsbayes.single_axis.axis_campaign import AxisCampaign, AxisMove, Reading
from tvsbayes.twin.simulated_axis import AxisTruth, stops_of


def up_and_down(travel: float, positions: int, homings: int) -> tuple[tuple[AxisMove, ...], list[int]]:
    """Up and down through positions, beyond both ends, after every homing; and which moves are read."""
    places = np.linspace(-0.5 * travel, 0.5 * travel, positions)
    beyond = 0.6 * travel
    path = [-beyond, *places, beyond, *places[::-1], -beyond]
    moves: list[AxisMove] = []
    for homing in range(homings):
        for k, command in enumerate(path):
            moves.append(AxisMove(len(moves), homing, 60.0 * len(moves), float(command), "" if k else "backward"))
    return tuple(moves), [m.move for m in moves if abs(m.command) < beyond]


def fresh_moves(count: int, travel: float, rng: np.random.Generator) -> tuple[tuple[AxisMove, ...], list[int]]:
    """Stops at random commands, half of them on a way up, then half on a way down; and which moves are read."""
    up, down = (np.sort(rng.uniform(-0.5 * travel, 0.5 * travel, count // 2)) for _ in range(2))
    path = [-0.6 * travel, *up, 0.6 * travel, *down[::-1]]
    moves = tuple(AxisMove(k, 0, 30.0 * k, float(c), "" if k else "backward") for k, c in enumerate(path))
    return moves, [k for k in range(1, len(path)) if k != count // 2 + 1]


def stands(truth: AxisTruth, moves: Sequence[AxisMove], rng: np.random.Generator) -> np.ndarray:
    """Where an axis stands after every move, whatever the commands; its curves are linear between its own."""
    at = np.unique([m.command for m in moves])
    curves = {name: np.interp(at, truth.command, getattr(truth, name)) for name in ("error", "play_variation")}
    return stops_of(replace(truth, command=at, **curves), moves, rng)


def read(
    moves: Sequence[AxisMove], value: np.ndarray, which: Sequence[int], rng: np.random.Generator, *, u: float
) -> AxisCampaign:
    """A campaign with readings of some moves."""
    noisy = value + u * rng.standard_normal(len(value))
    readings = tuple(Reading(k, m, float(noisy[m]), u) for k, m in enumerate(which))
    return AxisCampaign("mm", tuple(moves), readings)
