"""A drawn axis with its fit and a table, and fresh readings of it in every world of the table."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from tvsbayes.compensation.correction import Correction
from tvsbayes.compensation.formats import Wish
from tvsbayes.compensation.promise import compensation_of
from tvsbayes.results.compensation_record import Compensation
from tvsbayes.single_axis.axis_campaign import AxisCampaign, AxisMove, Reading
from tvsbayes.single_axis.axis_parameters import AxisPrior
from tvsbayes.single_axis.axis_record import AxisResults, results_for
from tvsbayes.twin.simulated_axis import AxisTruth, draw_axis, stops_of

U, PLAY = 0.002, 0.3
STATED = {"home_sd": AxisPrior(0.004, 0.3)}
TRUE = {
    "backlash": AxisPrior(PLAY, 0.0),
    "transmission_error": AxisPrior(0.05, 0.0),
    "play_variation": AxisPrior(0.02, 0.0),
    "stop_sd": AxisPrior(0.004, 0.2),
    "home_sd": AxisPrior(0.004, 0.2),
    "drift_per_root_hour": AxisPrior(0.004, 0.0),
}
"""Errors ten times the scatter of stops, as of an axis that is worth a table."""


@cache
def true_axis(seed: int = 1, ratio: float = 1.002) -> AxisTruth:
    """Its curves stand every 0.1 mm."""
    grid = np.linspace(-30.0, 30.0, 601).tolist()
    return draw_axis(
        grid, {**TRUE, "per_command": AxisPrior(ratio, 0.0)}, ratio, 40.0, np.random.default_rng(seed), unit="mm"
    )


def driven(truth: AxisTruth, planned: tuple[AxisMove, ...], read: list[int], seed: int, **applied) -> AxisCampaign:
    """Readings of moves under a correction: `by` of it, `factors` of its common part and its play."""
    rng = np.random.default_rng([seed, 5])
    by = applied.get("by")
    sent = planned if by is None else by.moved(planned, *applied.get("factors", (1.0, 1.0)))
    moves = (AxisMove(0, 0, 0.0, 0.0, "forward"), *(replace(m, move=m.move + 1, segment=m.segment + 1) for m in sent))
    at = np.unique([m.command for m in moves])
    curves = {name: np.interp(at, truth.command, getattr(truth, name)) for name in ("error", "play_variation")}
    value = stops_of(replace(truth, command=at, **curves), moves, rng)[1:] + U * rng.standard_normal(len(planned))
    readings = tuple(Reading(k, m, float(value[m]), U) for k, m in enumerate(read))
    return AxisCampaign("mm", planned, readings, dict(STATED))


def to_and_fro(places, homings: int = 1) -> tuple[tuple[AxisMove, ...], list[int]]:
    """Up and down beyond both ends after every homing, a move a minute; and which are read."""
    path = [-24.0, *map(float, places), 24.0, *map(float, places[::-1]), -24.0]
    moves = [
        AxisMove(h * len(path) + k, h, 60.0 * (h * len(path) + k), c, "" if k else "backward")
        for h in range(homings)
        for k, c in enumerate(path)
    ]
    return tuple(moves), [m.move for m in moves if abs(m.command) < 24.0]


@cache
def results(ratio: float = 1.002) -> AxisResults:
    """Nine positions from both sides after each of three homings."""
    return results_for(driven(true_axis(1, ratio), *to_and_fro(np.linspace(-20, 20, 9), 3), seed=1))


@cache
def absolute_results() -> AxisResults:
    """Nine positions from both sides, with an absolute encoder that is switched off half way."""
    campaign = driven(true_axis(), *to_and_fro(np.linspace(-20, 20, 9)), seed=1)
    half = len(campaign.moves) // 2
    moves = [
        replace(m, segment=int(m.move >= half), approach="backward" * (m.move in (0, half))) for m in campaign.moves
    ]
    return results_for(replace(campaign, moves=tuple(moves), absolute=True, stated={}))


@cache
def table(target: str = "csv", **wish) -> Compensation:
    """Of that fit."""
    return compensation_of(results(), Wish(target, **wish))


def fresh(seed: int, factors: tuple[float, float] = (1.0, 1.0), places=(-15.0, -7.0, 1.0, 6.0, 12.0, 18.0)):
    """Twelve readings under the table of csv."""
    planned, read = to_and_fro(np.array(places))
    return driven(true_axis(), planned, read, 100 + seed, by=Correction.of(table()), factors=factors)
