"""The release before this one, checked out beside this tree."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from experiments.common.rows import git

BEFORE, NAME_BEFORE = "0b6041ba", "0.2.0"
"""Its commit and version."""


@contextmanager
def tree_before(folder: Path) -> Iterator[Path]:
    """A checkout of it in a new `folder`, removed in the end."""
    git("worktree", "add", "--detach", str(folder), BEFORE)
    try:
        yield folder
    finally:
        git("worktree", "remove", "--force", str(folder))


def environment_of(tree: Path, cache: Path) -> dict[str, str]:
    """Variables under which `python -m tvsbayes` is that of a tree, with a compilation cache of its own."""
    return {**os.environ, "PYTHONPATH": str(tree), "TVSBAYES_CACHE": str(cache)}
