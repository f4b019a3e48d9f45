"""Planning with coarse grids: the searches are the same, one bucket of 512 looks, so that looks compile once.

A plugin of tests/conftest.py, so that what needs JAX is imported where it is used: fixtures by name.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from tvsbayes.instrument.parameters import Prior
from tvsbayes.instrument.rig import Rig

if TYPE_CHECKING:
    from tvsbayes.planning.candidates import Candidates
    from tvsbayes.planning.expectation import Knowledge
    from tvsbayes.planning.looks import Seen

ROUNDING = 1e-9
"""Relative; sums of a thousand products in float64, condition numbers up to 1e5."""


@pytest.fixture(scope="module")
def small_searches():
    """One bucket, few levels: the searches are the same, the grids coarser."""
    from tvsbayes.planning import planner

    with pytest.MonkeyPatch.context() as patch:
        for name, value in (("PAN_LEVELS", 4), ("TILT_LEVELS", 3), ("COARSE_PAN", 7), ("COARSE_TILT", 5)):
            patch.setattr(f"tvsbayes.planning.candidates.{name}", value)
        patch.setattr("tvsbayes.planning.candidates.VISIBILITY_DRAWS", 8)
        patch.setattr("tvsbayes.planning.forecast.CLASSIC_DRAWS", 5)
        patch.setattr("tvsbayes.planning.planner.BASELINE_DRAWS", 3)
        patch.setitem(planner.plan.__kwdefaults__, "largest", 8)
        yield


@pytest.fixture(scope="module")
def knowledge(mounted_rig) -> Knowledge:
    """Before any data."""
    from tvsbayes.planning.expectation import prior_knowledge

    return prior_knowledge(mounted_rig)


@pytest.fixture(scope="module")
def pool(knowledge, small_searches) -> Candidates:
    """Candidates of the mounted rig."""
    from tvsbayes.planning.candidates import candidates

    return candidates(knowledge)


@pytest.fixture(scope="module")
def seen(knowledge, pool) -> Seen:
    """What they show at the most probable instrument."""
    from tvsbayes.planning.looks import LookArrays

    return LookArrays(pool.looks, knowledge, False).at(knowledge.z, knowledge.space)


def with_priors(rig: Rig, **priors: Prior) -> Rig:
    """A rig with other priors; names with __ for a dot."""
    changed = {name.replace("__", "."): prior for name, prior in priors.items()}
    return replace(
        rig, table=replace(rig.table, priors={**rig.table.priors, **changed}), truth={**rig.truth, **changed}
    )
