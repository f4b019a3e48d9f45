"""Axes made by hand or drawn, small enough for quick fits."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tvsbayes.single_axis.axis_campaign import AxisCampaign, AxisMove, Reading
from tvsbayes.single_axis.axis_parameters import AxisPrior
from tvsbayes.twin.simulated_axis import SimulatedAxis, simulate_axis

PLACES = (-2000.0, -1200.0, -500.0, 0.0, 700.0, 1300.0, 2000.0)
OFF = AxisPrior(0.0, 0.0)
FIRST_EDITION = {
    **dict.fromkeys(("transmission_error", "play_variation", "drift_per_root_hour", "creep"), OFF),
    "stop_sd": AxisPrior(0.004, 0.0),
    "reading_scale": AxisPrior(1.0, 0.0),
}
"""Offset, scale, play and independent stops of known scatter."""


def runs(cycles: int = 3, places: Sequence[float] = PLACES, beyond: float = 300.0) -> tuple[AxisMove, ...]:
    """To and fro beyond both ends, a move a minute."""
    commands = [places[0] - beyond]
    for _ in range(cycles):
        commands += [*places, places[-1] + beyond, *reversed(places), places[0] - beyond]
    return tuple(AxisMove(k, 0, 60.0 * k, c, "" if k else "backward") for k, c in enumerate(commands))


def campaign(moves: Sequence[AxisMove], values: Sequence[float], u: float = 0.0, **stated: AxisPrior) -> AxisCampaign:
    """A reading after every move."""
    readings = tuple(Reading(k, m.move, float(v), u) for k, (m, v) in enumerate(zip(moves, values, strict=True)))
    return AxisCampaign("deg", tuple(moves), readings, stated)


def drawn(seed: int, moves: Sequence[AxisMove] | None = None, **stated: AxisPrior) -> SimulatedAxis:
    """A drawn axis of 0.01 deg per command."""
    known = {"per_command": AxisPrior(0.01, 0.002), **stated}
    return simulate_axis(AxisCampaign("deg", tuple(moves or runs()), (), known), seed=seed)


def random_moves(seed: int, count: int = 30, segments: int = 2) -> tuple[AxisMove, ...]:
    """Stops at random among few positions, some repeated at once, homed in between."""
    rng = np.random.default_rng(seed)
    moves = []
    for k in range(count):
        segment = k * segments // count
        first = k == 0 or moves[-1].segment != segment
        again = not first and rng.random() < 0.2
        command = moves[-1].command if again else float(rng.choice(PLACES))
        moves.append(AxisMove(k, segment, 30.0 * k, command, "forward" if first else ""))
    return tuple(moves)
