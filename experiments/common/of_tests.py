"""Modules of `tests/` that a study uses as well: crafted folders, certified problems."""

from __future__ import annotations

import importlib
import sys
from types import ModuleType

from experiments.common.rows import ROOT


def module_of_tests(name: str) -> ModuleType:
    """A module below `tests/`, which is no package: "support.hostile_folders", "statistics/test_least_squares".

    Args:
        name: dotted as the tests import it; what stands before a slash is its folder.
    """
    folder, _, module = name.rpartition("/")
    for place in (ROOT / "tests", ROOT / "tests" / folder):
        if str(place) not in sys.path:
            sys.path.append(str(place))
    return importlib.import_module(module)
