"""Of a campaign's arrays only what a test needs."""

from __future__ import annotations

from typing import Any

import numpy as np

from tvsbayes.estimators.campaign_arrays import CampaignArrays, GearArrays
from tvsbayes.model.compiled import placed
from tvsbayes.model.gear_processes import Places


def partial_arrays(**parts: Any) -> CampaignArrays:
    """A campaign of which nothing but these parts is there."""
    arrays = object.__new__(CampaignArrays)
    for name, part in parts.items():
        object.__setattr__(arrays, name, part)
    return arrays


def no_gears(spots: int) -> GearArrays:
    """Gears that repeat no error."""
    none = placed(np.zeros(0, bool))
    places = Places(placed(np.zeros(0)), none, none)
    return GearArrays(places, placed(np.zeros((spots, 0))), placed(np.zeros(0, np.int32)), none, none)
