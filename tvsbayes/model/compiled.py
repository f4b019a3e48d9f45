"""Functions of arrays that are traced once for all processes.

Tracing a large function takes JAX seconds in every process, and its compilation cache saves none of them. A `compiled`
function is traced once for every shape of its arguments; where a program has asked for a cache folder, what the trace
gave (StableHLO, by `jax.export`) is kept there and run by later processes, which neither trace nor compile. A stored
trace belongs to one state of the sources that it was traced through, one version of the libraries that took part, and
one shape of the arguments; it is code, and read only as `files.own_folder` allows.
"""

from __future__ import annotations

import functools
import hashlib
import re
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from importlib.metadata import version
from pathlib import Path
from typing import Any, cast

import jax
import numpy as np
from jax import export
from jax.typing import ArrayLike

from tvsbayes.files.own_folder import OwnFolder

LIBRARIES = ("jax", "jaxlib", "equinox", "optimistix", "lineax", "numpy")
"""Whose versions decide what a trace gives."""
BATCH = 32
"""Points per call of a function of many: half an ensemble of 64, the calls of a differential-evolution step."""
KEPT_SHARE = 0.1
"""Of the time of a first call, where another process has left trace and code: what progress predicts with."""
PACKAGE = Path(__file__).resolve().parents[1]
LOADED_TIME_S = time.time()
"""When this process read its code, seconds since the epoch: source written later is not what it runs."""


IMPORTS = re.compile(rb"^[ \t]*(?:from|import)[ \t]+(tvsbayes[\w.]*)(?:[ \t]+import[ \t]+(\w+))?", re.MULTILINE)


@functools.cache
def sources_of(module: str, package: Path) -> dict[Path, bytes]:
    """Files of a package, with their contents, that a function of a module may be traced through, sorted.

    Its own and those that it imports, and so on: what else the package says changes no trace. Of a module that is not
    in the package every file.

    Args:
        module: its name.
        package: folder.
    """
    sources: dict[Path, bytes] = {}
    start = _file_of(module, package)
    waiting = [start] if start is not None else [*package.rglob("*.py")]
    while waiting:
        path = waiting.pop()
        if path in sources:
            continue
        sources[path] = path.read_bytes()
        for name, part in IMPORTS.findall(sources[path]):
            files = _file_of(name.decode(), package), _file_of(f"{name.decode()}.{part.decode()}", package)
            waiting += [file for file in files if file is not None]
    return dict(sorted(sources.items()))


def _file_of(module: str, package: Path) -> Path | None:
    parts = module.split(".")
    path = package.joinpath(*parts[1:]).with_suffix(".py")
    return path if parts[0] == package.name and parts[1:] and path.is_file() else None


class Traces:
    """Traces of one state of the code in a cache folder.

    `used` is the folder of this process, None until a program asks for one: who imports the package as a library has
    nothing written.
    """

    used: Traces | None = None

    def __init__(self, folder: Path) -> None:
        self.folder = OwnFolder(folder)

    def code(self, module: str) -> bytes:
        """Hash of the sources that a function of a module is traced through, and of the versions of the libraries."""
        digest = hashlib.sha256(" ".join(version(library) for library in LIBRARIES).encode())
        for path, content in sources_of(module, PACKAGE).items():
            digest.update(f"{path.relative_to(PACKAGE)} {len(content)}\n".encode() + content)
        return digest.digest()

    def name(self, key: str, module: str = "") -> str:
        """The file of a trace; "" where its source has changed since this process read it, or cannot be read."""
        try:
            if any(path.stat().st_mtime > LOADED_TIME_S for path in sources_of(module, PACKAGE)):
                return ""
            return hashlib.sha256(self.code(module) + key.encode()).hexdigest()
        except OSError:
            return ""

    @property
    def empty(self) -> bool:
        """Whether nothing is kept there."""
        try:
            return next(self.folder.path.iterdir(), None) is None
        except OSError:
            return True

    def load(self, name: str) -> export.Exported | None:
        """A stored trace."""
        content = self.folder.read(name)
        if content is None:
            return None
        try:
            return export.deserialize(bytearray(content))
        except Exception:
            # Whatever a reader of a foreign format raises, flatbuffers missing among it: it is traced anew.
            return None

    def store(self, name: str, function: Callable, leaves: Iterable[Any]) -> export.Exported | None:
        """Trace a function of arrays and keep that; None where it cannot be exported."""
        try:
            exported = export.export(jax.jit(function))(*leaves)
            self.folder.write(name, bytes(exported.serialize()))
        except (ImportError, ValueError, NotImplementedError):
            # Without flatbuffers nothing is written, and a call into a library may have no stable form.
            return None
        return exported


@dataclass(frozen=True)
class Kind:
    """Shape and type of one array."""

    shape: tuple[int, ...]
    dtype: np.dtype


def _as_array(leaf: Any) -> np.ndarray | jax.Array:
    """An array of a type of its own, bound to no device.

    Python's numbers, and what JAX took from them, would fit in with any type. Results of a stored trace are bound to
    their device: for them as arguments JAX would compile the same function once more.
    """
    free = isinstance(leaf, jax.Array) and not leaf.weak_type and not leaf.committed
    array = leaf if free else np.asarray(leaf)
    if array.dtype == object or array.dtype.kind in "USV":
        raise TypeError(f"a compiled function takes arrays, not {type(leaf).__name__}")
    return array


class Compiled[**P, Result]:
    """A function of arrays, or of trees of arrays, whose result is one array or a flat `eqx.Module` of arrays.

    Called inside another function that JAX traces it is that plain function; else its arguments and results are
    float64 whatever the process has set, and it is traced for every new shape only. Threads may call it.

    Attributes:
        plain: the function as it was written.
        traces: how often this process had to trace it.
    """

    def __init__(self, plain: Callable[P, Result], result: type[Result]) -> None:
        self.plain, self._result = plain, result
        self.traces = 0
        self._ready: dict[Any, Callable] = {}
        self._lock = threading.Lock()
        functools.update_wrapper(self, plain)

    def wait(self, seconds: float) -> float:
        """What to expect of the next call beyond its work, where tracing and compiling take `seconds`; 0 once ready."""
        if self._ready:
            return 0.0
        return seconds if Traces.used is None or Traces.used.empty else KEPT_SHARE * seconds

    def __call__(self, *args: Any, **kwargs: Any) -> Result:
        """Run it on arrays of JAX or NumPy or numbers; `TypeError` for anything else."""
        leaves, structure = jax.tree.flatten((args, kwargs))
        if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
            return self.plain(*args, **kwargs)
        with jax.enable_x64(True):
            arrays = [leaf if type(leaf) is np.ndarray else _as_array(leaf) for leaf in leaves]
            key = structure, *((array.shape, array.dtype) for array in arrays)
            run = self._ready.get(key)
            return self._whole(self._first(key, structure, arrays) if run is None else run(*arrays))

    def _first(self, key: Any, structure: Any, arrays: list) -> Any:
        """Make what runs these shapes, and run it: another thread waits instead of compiling the same."""
        with self._lock:
            run = self._ready.get(key)
            run = self._made(structure, arrays) if run is None else run
            results = run(*arrays)
            self._ready[key] = run
            return results

    def _made(self, structure: Any, arrays: list) -> Callable:
        def flat(*leaves):
            self.traces += 1
            args, kwargs = jax.tree.unflatten(structure, leaves)
            result = self.plain(*args, **kwargs)
            parts = jax.tree.leaves(result)
            if not isinstance(result, self._result) or len(parts) != len(self._fields()):
                raise TypeError(f"{self.plain.__name__} must return a flat {self._result.__name__}")
            return tuple(parts)

        flat.__name__ = self.plain.__name__
        traces = Traces.used
        kinds = [Kind(array.shape, array.dtype) for array in arrays]
        backend = jax.default_backend()
        key = repr((self.plain.__module__, self.plain.__qualname__, str(structure), kinds, backend))
        name = traces.name(key, self.plain.__module__) if traces is not None else ""
        if traces is None or not name:
            return jax.jit(flat)
        exported = traces.load(name)
        if exported is None or not self._fits(exported, kinds, backend):
            exported = traces.store(name, flat, arrays)
        return jax.jit(flat if exported is None else exported.call)

    def _fits(self, exported: export.Exported, kinds: list[Kind], backend: str) -> bool:
        """Whether a stored trace takes these arguments and gives such a result."""
        taken = [Kind(aval.shape, np.dtype(aval.dtype)) for aval in exported.in_avals]
        return taken == kinds and len(exported.out_avals) == len(self._fields()) and backend in exported.platforms

    def _fields(self) -> tuple:
        """Of the result; one array is its own only field."""
        return (self._result,) if self._result is jax.Array else fields(cast(Any, self._result))

    @functools.cached_property
    def _structure(self) -> Any:
        """Of a result; made without its constructor, which is for one point where a result may hold many."""
        blank = object.__new__(self._result)
        for field in self._fields():
            object.__setattr__(blank, field.name, 0.0)
        return jax.tree.structure(blank)

    def _whole(self, parts: tuple) -> Result:
        return parts[0] if self._result is jax.Array else jax.tree.unflatten(self._structure, parts)


def compiled[**P, Result](result: type[Result]) -> Callable[[Callable[P, Result]], Compiled[P, Result]]:
    """Decorator of a function that returns `result`: one array (`jax.Array`) or a flat `eqx.Module`; see `Compiled`."""
    return lambda plain: Compiled(plain, result)


def in_batches[Result](function: Callable[..., Result], *points: np.ndarray, size: int = BATCH) -> Result:
    """Call a compiled function on blocks of one size of each of `points` and join the results along the first axis.

    The last block is filled up with its last row, so that nothing is compiled for a rest.
    """
    blocks, total = [], len(points[0])
    for start in range(0, total, size):
        rows = np.minimum(np.arange(start, start + size), total - 1)
        result = function(*(x[rows] for x in points))
        blocks.append(jax.tree.map(lambda x, n=total - start: np.asarray(x)[:n], result))
    return jax.tree.map(lambda *parts: np.concatenate(parts), *blocks)


def placed(values: ArrayLike) -> jax.Array:
    """A NumPy array as JAX's, in its own precision: without `jnp.asarray`, which compiles anew for every shape."""
    with jax.enable_x64(True):
        return jax.device_put(np.asarray(values), may_alias=False)
