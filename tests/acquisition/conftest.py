"""What the tests of the journal and of its check share."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.journals import write_looks


@pytest.fixture
def folder(tmp_path) -> Path:
    """A run of three looks that ended by itself."""
    write_looks(tmp_path / "run", 3)
    return tmp_path / "run"
