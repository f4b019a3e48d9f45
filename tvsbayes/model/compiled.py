"""Functions of arrays whose traces are stored and shared by processes.

JAX takes seconds to trace a large function in every process, which its compilation cache does not save. A `compiled`
function is traced once for every shape of its arguments. Where a program has set a cache folder, the trace (StableHLO,
by `jax.export`) is stored there; later processes run it without tracing or compiling. A stored trace is valid for one
state of the sources that it was traced through, one version of the libraries, and one shape of the arguments. It is
code, and read only as `files.own_folder` allows.
"""

from __future__ import annotations

import functools
import hashlib
import re
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, cast

import jax
import numpy as np
from jax import export
from jax.typing import ArrayLike

from tvsbayes.files.own_folder import OwnFolder
from tvsbayes.files.packages import version_of

LIBRARIES = ("jax", "jaxlib", "equinox", "optimistix", "lineax", "numpy")
"""Libraries whose versions determine a trace."""
BATCH = 32
"""Points per call of a function of many points: half an ensemble of 64, as a differential-evolution step calls it."""
KEPT_SHARE = 0.1
"""Share of the time of a first call that remains where another process has stored trace and code; for progress bars."""
PACKAGE = Path(__file__).resolve().parents[1]
LOADED_TIME_S = time.time()
"""Time at which this process read its code, seconds since the epoch; source written later does not match it."""


IMPORTS = re.compile(rb"^[ \t]*(?:from|import)[ \t]+(tvsbayes[\w.]*)(?:[ \t]+import[ \t]+(\w+))?", re.MULTILINE)


@functools.cache
def sources_of(module: str, package: Path) -> dict[Path, bytes]:
    """Collect the files of a package, with contents, that a function of a module may be traced through, sorted.

    These are the module's own file and those of its imports, recursively; for a module outside the package every file.

    Args:
        module: name of the module.
        package: folder of the package.
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

    `used` is the folder of this process, None until a program sets one: importing the package as a library writes
    nothing.
    """

    used: Traces | None = None

    def __init__(self, folder: Path) -> None:
        self.folder = OwnFolder(folder)

    def code(self, module: str) -> bytes:
        """Hash the sources that a function of a module is traced through and the versions of the libraries."""
        digest = hashlib.sha256(" ".join(map(str, map(version_of, LIBRARIES))).encode())
        for path, content in sources_of(module, PACKAGE).items():
            digest.update(f"{path.relative_to(PACKAGE)} {len(content)}\n".encode() + content)
        return digest.digest()

    def name(self, key: str, module: str = "") -> str:
        """Return a trace's file name; "" where its source has changed since this process read it, or is unknown."""
        try:
            if None in map(version_of, LIBRARIES):
                return ""
            if any(path.stat().st_mtime > LOADED_TIME_S for path in sources_of(module, PACKAGE)):
                return ""
            return hashlib.sha256(self.code(module) + key.encode()).hexdigest()
        except OSError:
            return ""

    @property
    def empty(self) -> bool:
        """Whether no trace is stored."""
        try:
            return next(self.folder.path.iterdir(), None) is None
        except OSError:
            return True

    def load(self, name: str) -> export.Exported | None:
        """Load a stored trace, None where there is none that can be read."""
        content = self.folder.read(name)
        if content is None:
            return None
        try:
            return export.deserialize(bytearray(content))
        except Exception:
            # A reader of a foreign format may raise anything, also without flatbuffers; the function is traced again.
            return None

    def store(self, name: str, function: Callable, leaves: Iterable[Any]) -> export.Exported | None:
        """Trace a function of arrays and store the trace; None where it cannot be exported."""
        try:
            exported = export.export(jax.jit(function))(*leaves)
            self.folder.write(name, bytes(exported.serialize()))
        except (ImportError, ValueError, NotImplementedError):
            # Flatbuffers may be missing, and a call into a library may have no stable form.
            return None
        return exported


@dataclass(frozen=True)
class Kind:
    """Shape and type of one array."""

    shape: tuple[int, ...]
    dtype: np.dtype


def _as_array(leaf: Any) -> np.ndarray | jax.Array:
    """Convert to an array of fixed type, bound to no device.

    Python's numbers, and arrays that JAX made of them, have weak types. Results of a stored trace are bound to their
    device: with them as arguments JAX would compile the same function again.
    """
    free = isinstance(leaf, jax.Array) and not leaf.weak_type and not leaf.committed
    array = leaf if free else np.asarray(leaf)
    if array.dtype == object or array.dtype.kind in "USV":
        raise TypeError(f"a compiled function takes arrays, not {type(leaf).__name__}")
    return array


class Compiled[**P, Result]:
    """A function of arrays, or of trees of arrays, whose result is one array or a flat `eqx.Module` of arrays.

    Inside another function that JAX traces, it acts as the plain function. Otherwise arguments and results are float64,
    whatever the process has set, and it is traced for new shapes only. It is thread-safe.

    Attributes:
        plain: the undecorated function.
        traces: number of times that this process traced it.
    """

    def __init__(self, plain: Callable[P, Result], result: type[Result]) -> None:
        self.plain, self._result = plain, result
        self.traces = 0
        self._ready: dict[Any, Callable] = {}
        self._lock = threading.Lock()
        functools.update_wrapper(self, plain)

    def wait(self, seconds: float) -> float:
        """Predict the overhead of the next call, where tracing and compiling take `seconds`; 0 once ready."""
        if self._ready:
            return 0.0
        return seconds if Traces.used is None or Traces.used.empty else KEPT_SHARE * seconds

    def __call__(self, *args: Any, **kwargs: Any) -> Result:
        """Run the function on arrays of JAX or NumPy or on numbers; raise `TypeError` for anything else."""
        leaves, structure = jax.tree.flatten((args, kwargs))
        if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
            return self.plain(*args, **kwargs)
        with jax.enable_x64(True):
            arrays = [leaf if type(leaf) is np.ndarray else _as_array(leaf) for leaf in leaves]
            key = structure, *((array.shape, array.dtype) for array in arrays)
            run = self._ready.get(key)
            return self._whole(self._first(key, structure, arrays) if run is None else run(*arrays))

    def _first(self, key: Any, structure: Any, arrays: list) -> Any:
        """Make the function for these shapes and run it; other threads wait instead of compiling the same."""
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
        """Whether a stored trace has these arguments and this kind of result."""
        taken = [Kind(aval.shape, np.dtype(aval.dtype)) for aval in exported.in_avals]
        return taken == kinds and len(exported.out_avals) == len(self._fields()) and backend in exported.platforms

    def _fields(self) -> tuple:
        """Return the fields of the result; a single array is its only field."""
        return (self._result,) if self._result is jax.Array else fields(cast(Any, self._result))

    @functools.cached_property
    def _structure(self) -> Any:
        """Return a result's structure, made without its constructor: that takes one point, a result may hold many."""
        blank = object.__new__(self._result)
        for field in self._fields():
            object.__setattr__(blank, field.name, 0.0)
        return jax.tree.structure(blank)

    def _whole(self, parts: tuple) -> Result:
        return parts[0] if self._result is jax.Array else jax.tree.unflatten(self._structure, parts)


def compiled[**P, Result](result: type[Result]) -> Callable[[Callable[P, Result]], Compiled[P, Result]]:
    """Decorate a function that returns `result`: one array (`jax.Array`) or a flat `eqx.Module`; see `Compiled`."""
    return lambda plain: Compiled(plain, result)


def in_batches[Result](function: Callable[..., Result], *points: np.ndarray, size: int = BATCH) -> Result:
    """Call a compiled function on blocks of one size of each of `points` and join the results along the first axis.

    The last block is filled with its last row, so that no other size is compiled.
    """
    blocks, total = [], len(points[0])
    for start in range(0, total, size):
        rows = np.minimum(np.arange(start, start + size), total - 1)
        result = function(*(x[rows] for x in points))
        blocks.append(jax.tree.map(lambda x, n=total - start: np.asarray(x)[:n], result))
    return jax.tree.map(lambda *parts: np.concatenate(parts), *blocks)


def placed(values: ArrayLike) -> jax.Array:
    """Convert a NumPy array to JAX in its own precision, without `jnp.asarray`, which compiles for every shape."""
    with jax.enable_x64(True):
        return jax.device_put(np.asarray(values), may_alias=False)
