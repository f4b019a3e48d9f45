"""A dozen spots in three segments with everything a campaign may hold, and the coordinates of true rigs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from support.commands import steps

from tvsbayes.instrument.campaign import Campaign
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.plan import PlanStep
from tvsbayes.instrument.rig import Rig
from tvsbayes.twin.simulated_campaign import SimulatedCampaign, simulate
from tvsbayes.twin.true_rig import Truth


@dataclass(frozen=True)
class Dozen:
    """A dozen spots in three segments, with everything a campaign may hold.

    Attributes:
        campaign: known, unknown and half-known approaches, spots that share a stop while the other axis moves,
            two looks per stop, aperture readings at some spots, correlated pixels at others.
        truth: the rig it was simulated on.
        z: coordinates of the true rig.
        space: its priors as JAX arrays.
        arrays: the campaign as JAX arrays.
    """

    campaign: Campaign
    truth: Truth
    z: np.ndarray
    space: Any
    arrays: Any


def dozen_plan() -> tuple[PlanStep, ...]:
    """Moves of one axis between looks, single steps that leave play half taken up, two rehomings."""
    return steps(
        *(("home", 0, 0), ("place", "d1"), ("look",), ("move", 60, 0), ("look",), ("move", 60, 40), ("look",)),
        *(("place", "d2"), ("look",), ("move", 60, -40), ("look",), ("move", 61, -40), ("look",)),
        *(("home", 0, 0), ("look",), ("move", 2, 0), ("look",), ("move", 2, -3), ("look",), ("move", 90, 30)),
        *(("move", 90, 50), ("look",), ("place", "d1"), ("look",)),
        *(("home", 20, 10), ("look",), ("move", 20, 12), ("look",), ("move", -30, 12), ("look",)),
    )


def dozen_campaign(rig: Rig) -> SimulatedCampaign:
    """Simulate the dozen; approaches, readings and correlations are then edited in."""
    simulated = simulate(rig, dozen_plan(), seed=11, aperture=True)
    campaign = simulated.campaign
    homes = [move.move for move in campaign.moves if move.pan_approach]
    moves = list(campaign.moves)
    moves[homes[1]] = replace(moves[homes[1]], pan_approach="unknown", tilt_approach="unknown")
    moves[homes[2]] = replace(moves[homes[2]], tilt_approach="unknown")
    spots = [
        replace(
            spot,
            aperture_deg=None if i % 3 == 0 else spot.aperture_deg,
            su_left_px=0.06 + 0.01 * (i % 4),
            sv_right_px=0.11,
            ruv_left=0.4 if i % 2 else 0.0,
            ruv_right=-0.3 if i % 4 == 1 else 0.0,
        )
        for i, spot in enumerate(campaign.spots)
    ]
    edited = replace(campaign, moves=tuple(moves), spots=tuple(spots))
    return SimulatedCampaign(edited, simulated.truth, simulated.light)


def coordinates(space: Any, truth: Truth) -> np.ndarray:
    """Coordinates z of a true rig."""
    from tvsbayes.model.parameter_space import coordinates_of

    # Older truths do not name the harmonics, which are zero then.
    physical = [*(truth.parameters.get(name, 0.0) for name in TWO_MIRROR.rig_names), *truth.stereo.vector]
    return coordinates_of(space, np.array(physical))


@pytest.fixture(scope="session")
def dozen(mounted_rig: Rig) -> Dozen:
    """The campaign that the tests of likelihood and stops share."""
    import jax
    import jax.numpy as jnp

    from tvsbayes.estimators.campaign_arrays import campaign_arrays
    from tvsbayes.model.parameter_space import parameter_space

    simulated = dozen_campaign(mounted_rig)
    campaign = simulated.campaign
    assert all(spot.status == "ok" for spot in campaign.spots)
    space = parameter_space(campaign.rig, campaign.stereo)
    with jax.enable_x64(True):
        return Dozen(
            campaign,
            simulated.truth,
            coordinates(space, simulated.truth),
            jax.tree.map(jnp.asarray, space),
            jax.tree.map(jnp.asarray, campaign_arrays(campaign)),
        )
