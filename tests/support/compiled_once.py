"""Functions that both processes of a test run need, traced and compiled by one of them."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tvsbayes.model.compiled import Compiled, Traces


@contextmanager
def locked(place: Path) -> Iterator[None]:
    """One process at a time; where the system knows no such locks (Windows), all at once."""
    if os.name != "posix":
        yield
        return
    import fcntl

    with open(place, "w") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        yield


@contextmanager
def sharing(folder: Path) -> Iterator[None]:
    """Traces lie in `folder`/traced; what a process is compiling others wait for, and then load."""
    # For this user alone, or commands would not use it.
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    locks = folder / "locks"
    locks.mkdir(exist_ok=True)
    first = Compiled._first

    def alone(self, key, structure, arrays):
        name = repr((self.plain.__module__, self.plain.__qualname__, [array.shape for array in arrays]))
        with locked(locks / hashlib.sha256(name.encode()).hexdigest()):
            return first(self, key, structure, arrays)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Traces, "used", Traces(folder / "traced"))
        patch.setattr(Compiled, "_first", alone)
        yield
