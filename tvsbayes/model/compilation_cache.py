"""The cache folder of compiled functions and their traces, and a test whether it works.

Later processes run the code stored there, so only the user may be able to write to the folder.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import warnings
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax._src import compilation_cache as internals
from jax._src.compilation_cache_interface import CacheInterface
from jaxtyping import Array, Float
from platformdirs import user_cache_path

from tvsbayes.files.own_folder import OwnFolder
from tvsbayes.model.compiled import Traces, compiled

VARIABLE = "TVSBAYES_CACHE"
TRIAL_SECONDS_MAX = 120.0
"""Time limit of a process that compiles one small function."""
COMPILED = "compiled"
"""Folder of compiled functions in the cache folder, beside that of their traces."""
FILE_BYTES_MAX, BYTES_MAX = 2**28, 2**30
"""Largest size of a compiled function, and of all; those used longest ago are removed."""
REJECTED = "Machine type used for XLA:CPU compilation doesn't match"
"""XLA's log message when it refuses its own code on the machine that compiled it."""


def cache_folder() -> Path:
    """Return the user's cache folder, or `TVSBAYES_CACHE`."""
    return Path(os.environ.get(VARIABLE) or user_cache_path("tvsbayes") / "jax")


def own_cache_folder() -> OwnFolder:
    """Return `cache_folder`, created for this user alone where missing; the caller checks its `fault`."""
    folder = OwnFolder(cache_folder())
    if not os.environ.get(VARIABLE):
        # The mode of the default folder is set; a folder that the user has named keeps its mode.
        with suppress(OSError):
            folder.path.chmod(0o700)
    folder.make()
    return folder


class SealedCache(CacheInterface):
    """Compiled functions in sealed files.

    JAX's own cache runs whatever lies under a function's name: code of another function, if files are exchanged. A
    damaged file it never replaces.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder
        self.folder = OwnFolder(folder, FILE_BYTES_MAX, BYTES_MAX)

    def get(self, key: str) -> bytes | None:
        """Return what was stored under this key, None where that is missing or damaged."""
        return self.folder.read(key)

    def put(self, key: str, value: bytes) -> None:
        """Store a compiled function; where that fails, the next process compiles again."""
        self.folder.write(key, value)

    @property
    def empty(self) -> bool:
        """Whether nothing is stored."""
        return not self._path.is_dir() or next(self._path.iterdir(), None) is None


def use_compilation_cache() -> bool:
    """Keep traces and compiled functions in `cache_folder`, unless others may write into it.

    It changes a global setting of JAX, so only commands and worker processes call it.

    Returns:
        Whether the cache is empty or unusable: the model must be compiled first, half a minute to two minutes.
    """
    folder = own_cache_folder()
    if folder.fault():
        return True
    cache = SealedCache(folder.path / COMPILED)
    cache.folder.make()
    jax.config.update("jax_compilation_cache_dir", str(cache.folder.path))
    # Small functions are cached too: a command compiles some dozens, which takes seconds in all.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    # What cannot be loaded after all, as of another library, is compiled again; it is no concern of the user.
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache entry")
    # JAX has no public way to give it another cache than its own (0.10 to 0.12).
    internals.reset_cache()
    internals._cache, internals._cache_initialized = cache, True
    Traces.used = Traces(folder.path / "traced")
    return cache.empty


@dataclass(frozen=True)
class CacheState:
    """Result of the cache test: whether it is used, what was found, and the remedy ("" where it works)."""

    used: bool
    found: str
    remedy: str = ""


@compiled(jax.Array)
def _trial(values: Float[Array, " n"]) -> Float[Array, " n"]:
    """Evaluate a small function that is compiled to code of its own."""
    return jnp.cumsum(jnp.sin(values)) / jnp.exp(values)


def trial() -> None:
    """Run one small function as commands do, and print traces and cache hits, for `cache_state`."""
    events: list[str] = []
    jax.monitoring.register_event_listener(lambda event, **_: events.append(event.rsplit("/")[-1]))
    use_compilation_cache()
    _trial(np.linspace(0.0, 1.0, 64)).block_until_ready()
    print(json.dumps({"traces": _trial.traces, "hits": events.count("cache_hits")}))


def _tried() -> subprocess.CompletedProcess[str]:
    """Run `trial` in a process of its own, with XLA's messages."""
    code = f"from {__name__} import trial; trial()"
    return subprocess.run(
        # Without -P a file json.py in the working directory, perhaps somebody else's campaign, would be run.
        [sys.executable, "-P", "-c", code],
        check=True,
        capture_output=True,
        text=True,
        timeout=TRIAL_SECONDS_MAX,
        env={**os.environ, "TF_CPP_MIN_LOG_LEVEL": "0"},
    )


def cache_state() -> CacheState:
    """Test whether a second process reads from the folder what a first one has written; two seconds."""
    folder = own_cache_folder()
    place = folder.path
    if fault := folder.fault():
        remedy = f"take write permission from others (chmod go-w), or name a folder of your own in {VARIABLE}"
        return CacheState(False, f"not used, every run compiles again: {place}: {fault}", remedy)
    try:
        first, second = _tried(), _tried()
        answer = json.loads(second.stdout)
    except (OSError, subprocess.SubprocessError, ValueError) as error:
        return CacheState(False, f"could not be tried: {type(error).__name__}", "run a fit and see what it says")
    if REJECTED in first.stderr + second.stderr or not answer["hits"]:
        state = f"rejected, every run compiles again: what is written to {place} is refused when it is read"
        remedy = "free space there; else try another version of jaxlib (github.com/jax-ml/jax/issues/38445)"
        return CacheState(False, state, remedy)
    if answer["traces"]:
        remedy = f"pip install flatbuffers; remove {place / 'traced'} if it is not yours"
        return CacheState(False, f"compiled functions are used, their traces not: {place}", remedy)
    entries = list((place / COMPILED).glob("*"))
    size = sum(entry.stat().st_size for entry in entries) / 1e6
    return CacheState(True, f"used: {len(entries)} functions, {size:.0f} MB in {place}")
