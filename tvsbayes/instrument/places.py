"""Places of the gears: counters at which errors that repeat by position are estimated. NumPy.

With a few counters, each is exactly a place of its own. With many, the processes are defined at regular places over the
observed range, and each counter has shares in the four nearest (cubic interpolation). Places 2.7 deg apart represent an
error of correlation length 8 deg within 4 % of its sd, a thousandth of its variance.
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
"""Largest number of counters of an axis that are places of their own; for more counters, the number of regular places
is at least this, ..."""
SPACING_DEG, PLACES_MAX = 2.7, 24
"""... or one per this angle of the output, up to this maximum."""
NEAREST = 4
LEAST_ERROR_RAD = 1e-9
"""A smaller transmission error cannot be measured: floor of the covariance."""
FEW_COUNTERS = 3
"""With this number of observed counters or fewer, transmission error and ratio of an axis are hardly separable."""


def vary_by_position(table: RigTable) -> np.ndarray:
    """Whether transmission error, then play, may differ from place to place, of (pan, tilt), shape (2, 2)."""
    kinds = (("transmission_error_deg", "harmonic_amplitude_deg"), ("play_variation_deg",))
    names = [[[n for n in names_of(*kind) if n.split(".")[1] == axis] for axis in AXES] for kind in kinds]
    priors = table.priors
    return np.array([[any(priors[n].u > 0 or priors[n].value > 0 for n in own) for own in kind] for kind in names])


def gears_vary(table: RigTable) -> bool:
    """Whether transmission error or play of an axis may differ from place to place."""
    return bool(vary_by_position(table).any())


@dataclass(frozen=True)
class SeenPlaces:
    """Places of both axes, pan's first, and the shares of the looks in these places.

    Attributes:
        steps: counters, shape (c,).
        on_tilt: places of the tilt axis, shape (c,).
        error_share: share of each look in the transmission error at each place, shape (looks, c).
        play_share: likewise in the play: half of it, with the sign opposite to the side of approach.
    """

    steps: np.ndarray
    on_tilt: np.ndarray
    error_share: np.ndarray
    play_share: np.ndarray

    @property
    def none(self) -> SeenPlaces:
        """The same looks without any place."""
        return SeenPlaces(self.steps[:0], self.on_tilt[:0], self.error_share[:, :0], self.play_share[:, :0])


def interpolation(counters: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Share of each counter (n,) in regular or fewer nodes (m,), ascending: Lagrange polynomials, shape (n, m)."""
    count = min(NEAREST, len(nodes))
    first = np.clip(np.searchsorted(nodes, counters, side="right") - count // 2, 0, len(nodes) - count)
    indices = first[:, None] + np.arange(count)
    near_nodes = nodes[indices]
    share = np.ones(indices.shape)
    for k in range(count):
        for other in range(count):
            if other != k:
                share[:, k] *= (counters - near_nodes[:, other]) / (near_nodes[:, k] - near_nodes[:, other])
    weights = np.zeros((len(counters), len(nodes)))
    np.put_along_axis(weights, indices, share, axis=1)
    return weights


def places_of(counters: np.ndarray, deg_per_step: float) -> np.ndarray:
    """Places of the counters of an axis whose output turns by `deg_per_step`, ascending."""
    distinct = np.unique(counters).astype(float)
    if len(distinct) <= OWN_PLACES_MAX:
        return distinct
    count = np.ceil(np.ptp(distinct) * deg_per_step / SPACING_DEG) + 1
    return np.linspace(distinct[0], distinct[-1], int(np.clip(count, OWN_PLACES_MAX, PLACES_MAX)))


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


def too_few_counters(axis: str, counters: Sequence[int], suggested: Sequence[int]) -> str:
    """A note that an axis is observed at few counters: the consequence elsewhere, and looks that would help.

    Args:
        axis: pan or tilt.
        counters: observed ones.
        suggested: counters of further looks.
    """
    listed = ", ".join(map(str, counters))
    text = (
        f"{axis} is seen at {len(counters)} counters only ({listed}), which do not separate gear error from ratio: "
        "the ratio holds between them, elsewhere the gear error of the prior is added"
    )
    return f"{text}; looks at {axis} {', '.join(map(str, suggested))} would separate them" if suggested else text


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
        deviations = counters - counters.mean()
        sum_of_squares = deviations @ deviations
        if np.ptp(counters) > 0:
            shares[of_axis] = (deviations / sum_of_squares) @ share
    return shares
