"""Plans are judged on a rig of perfect gears, unless a test has others: searches depend on its looks alone."""

from __future__ import annotations

from dataclasses import replace

import pytest
from support.varying_gears import perfect_gears

from tvsbayes.instrument.parameters import GEAR_ERROR_NAMES
from tvsbayes.instrument.rig import Rig


@pytest.fixture(scope="session")
def mounted_rig(mounted_rig: Rig) -> Rig:
    """The shipped rig with gears that repeat no error and do not drift."""
    table = perfect_gears(mounted_rig.table)
    truth = {name: table.priors[name] for name in GEAR_ERROR_NAMES}
    return replace(mounted_rig, table=table, truth={**mounted_rig.truth, **truth})
