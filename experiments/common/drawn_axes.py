"""Drawn axes: driven anywhere, also by what a table adds, or at constant rate; read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tvsbayes.single_axis.axis_campaign import AxisCampaign, AxisMove, Reading
from tvsbayes.single_axis.axis_parameters import AxisPrior
from tvsbayes.single_axis.waves import WavePeriods
from tvsbayes.twin.simulated_axis import AxisTruth, stops_of

RATE = 15.0
"""Of drives, arcsec per second."""


def drive(seed: int) -> AxisCampaign:
    """A log of 400 readings in 1600 s with seeing, and a period of 60 to 600 s that is looked for."""
    times = np.sort(np.random.default_rng([seed, 99]).uniform(0.0, 1600.0, 400))
    readings = tuple(Reading(k, 0, RATE * float(t), 0.5, "ok", float(t)) for k, t in enumerate(times))
    stated = {"per_command": AxisPrior(1.0, 1e-3), "transmission_error": AxisPrior(0.0, 5.0)}
    stated["reading_scale"] = AxisPrior(1.0, 0.0)
    periods = WavePeriods((), ((60.0, 600.0),), True)
    return AxisCampaign("arcsec", (AxisMove(0, 0, 0.0, 0.0, "forward"),), readings, stated, {"rate": RATE}, periods)


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
