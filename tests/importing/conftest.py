"""What the tests of calibrations share."""

from __future__ import annotations

import pytest

from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.stereo_pair import Stereo, read_stereo


@pytest.fixture(scope="session")
def mounted() -> Stereo:
    """The shipped pair."""
    return read_stereo(shipped_data() / "rigs" / "mounted" / "stereo.json")
