"""Where looks found the gears: the counters at which errors that repeat by position are told apart. NumPy.

A few counters are their own places, exactly. Of many, regular places over the range that was seen carry the processes,
and each counter has a share in the four nearest (cubic interpolation): an error that changes over 8 deg is met within
4 % of its sd by places 2.7 deg apart, a thousandth of its variance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.campaign import Move
from tvsbayes.instrument.parameters import names_of
from tvsbayes.instrument.rig import RigTable
from tvsbayes.instrument.stops import rests_of

OWN_PLACES_MAX = 12
"""Counters of an axis that are places of their own; of more, regular ones take their part: as many, or ..."""
SPACING_DEG, PLACES_MAX = 2.7, 24
"""... one on so many degrees of the output, but no more than this."""
NEAREST = 4
LEAST_ERROR_RAD = 1e-9
"""Transmission errors below nobody measures: the floor of their covariance is not worth a word."""
FEW_COUNTERS = 3
"""An axis seen at so many counters or fewer tells its transmission error and its ratio apart hardly or not at all."""


def gears_vary(table: RigTable) -> bool:
    """Whether transmission error or play may differ from place to place."""
    names = names_of("transmission_error_deg", "play_variation_deg", "harmonic_amplitude_deg")
    return any(table.priors[name].u > 0 or table.priors[name].value > 0 for name in names)


@dataclass(frozen=True)
class SeenPlaces:
    """Places of both axes, pan's first, and what the looks have of them.

    Attributes:
        steps: counters, shape (c,).
        on_tilt: places of the tilt axis, shape (c,).
        error_share: how much of the transmission error at each place each look has, shape (looks, c).
        play_share: likewise of the play: half of it with the sign against the side from which the axis came.
    """

    steps: np.ndarray
    on_tilt: np.ndarray
    error_share: np.ndarray
    play_share: np.ndarray

    @property
    def none(self) -> SeenPlaces:
        """No place, of the same looks."""
        return SeenPlaces(self.steps[:0], self.on_tilt[:0], self.error_share[:, :0], self.play_share[:, :0])


def interpolation(counters: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Share of each counter (n,) in regular or fewer nodes (m,), ascending: Lagrange polynomials, shape (n, m)."""
    count = min(NEAREST, len(nodes))
    begin = np.clip(np.searchsorted(nodes, counters, side="right") - count // 2, 0, len(nodes) - count)
    near = begin[:, None] + np.arange(count)
    at = nodes[near]
    share = np.ones(near.shape)
    for k in range(count):
        for other in range(count):
            if other != k:
                share[:, k] *= (counters - at[:, other]) / (at[:, k] - at[:, other])
    weights = np.zeros((len(counters), len(nodes)))
    np.put_along_axis(weights, near, share, axis=1)
    return weights


def places_of(counters: np.ndarray, deg_per_step: float) -> np.ndarray:
    """Places that stand for the counters of an axis whose output turns by so much a step, ascending."""
    different = np.unique(counters).astype(float)
    if len(different) <= OWN_PLACES_MAX:
        return different
    wanted = np.ceil(np.ptp(different) * deg_per_step / SPACING_DEG) + 1
    return np.linspace(different[0], different[-1], int(np.clip(wanted, OWN_PLACES_MAX, PLACES_MAX)))


def seen_places(moves: Sequence[Move], looks: Sequence[int], table: RigTable) -> SeenPlaces:
    """Places of looks.

    Args:
        moves: all moves in order.
        looks: number of the move before each look.
        table: priors of the gears.
    """
    steps, on_tilt, error_share, play_share = [], [], [], []
    for axis in AXES:
        rests = rests_of(moves, axis)
        counters = np.array([rests[move].steps for move in looks], dtype=float)
        sign = np.array([rests[move].sign for move in looks], dtype=float)
        nodes = places_of(counters, abs(table.priors[f"degrees_per_step.{axis}"].value))
        share = interpolation(counters, nodes)
        steps.append(nodes)
        on_tilt.append(np.full(len(nodes), axis == AXES[1]))
        error_share.append(share)
        play_share.append(-0.5 * sign[:, None] * share)
    return SeenPlaces(
        np.concatenate(steps),
        np.concatenate(on_tilt),
        np.concatenate(error_share, axis=1),
        np.concatenate(play_share, axis=1),
    )


def too_few_counters(axis: str, counters: Sequence[int], telling: Sequence[int]) -> str:
    """That an axis is seen at few counters: what that means for its use elsewhere, and which looks would tell.

    Args:
        axis: pan or tilt.
        counters: at which it is seen.
        telling: others.
    """
    listed = ", ".join(map(str, counters))
    text = (
        f"{axis} is seen at {len(counters)} counters only ({listed}), which cannot tell gear error from ratio: "
        "the ratio holds between them, elsewhere the gear error of the prior is added"
    )
    return f"{text}; looks at {axis} {', '.join(map(str, telling))} would tell" if telling else text


def line_share(places: SeenPlaces, used: np.ndarray) -> np.ndarray:
    """Share of the value at each place in the slope of the least-squares line through the looks used, steps^-1.

    Args:
        places: those of all looks.
        used: looks, shape (looks,), boolean.

    Returns:
        Shape (c,); zero for an axis that was seen at one counter alone.
    """
    shares = np.zeros(len(places.steps))
    for axis in (False, True):
        of_axis = places.on_tilt == axis
        share = places.error_share[np.ix_(used, of_axis)]
        counters = share @ places.steps[of_axis]
        off = counters - counters.mean()
        square = off @ off
        if np.ptp(counters) > 0:
            shares[of_axis] = (off / square) @ share
    return shares
