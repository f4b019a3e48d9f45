"""The firmware core built natively, once a session."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from support.firmware_sessions import build


@pytest.fixture(scope="session")
def native(tmp_path_factory) -> Path:
    """The C++ core on a native board."""
    if shutil.which("g++") is None:
        pytest.skip("no g++ to build the firmware core with")
    folder = tmp_path_factory.mktemp("native")
    program = build(folder, "-fsanitize=address,undefined", "-fno-sanitize-recover=all") or build(folder)
    assert program is not None, "the firmware core does not compile without warnings"
    return program
