"""Traces kept between processes: used where they are whole, the user's own and of this code; else made again."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

from tvsbayes.model import compiled as subject
from tvsbayes.model.compiled import Compiled, Traces, compiled

ROOT = Path(__file__).resolve().parents[2]


class Sums(eqx.Module):
    total: Float[Array, ""]
    double: Float[Array, " n"]


class Pair(eqx.Module):
    first: Float[Array, " n"]
    scale: Float[Array, ""]


def sums(pair: Pair, offset: Float[Array, ""]) -> Sums:
    shifted = pair.scale * jnp.sin(pair.first) + offset
    return Sums(jnp.sum(shifted), 2 * shifted)


def pair(count: int = 3) -> Pair:
    return Pair(np.linspace(0.0, 1.0, count), np.array(3.0))


@pytest.fixture
def traces(tmp_path, monkeypatch) -> Traces:
    """A folder of traces for this test; by the clock no source is newer."""
    counted = Traces(tmp_path / "traced")
    monkeypatch.setattr(Traces, "used", counted)
    monkeypatch.setattr(subject, "LOADED_TIME_S", 1e12)
    return counted


def same(one: Sums, other: Sums) -> bool:
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return all(np.array_equal(a, b) and a.dtype == b.dtype for a, b in pairs)


def stored(traces: Traces) -> list[Path]:
    return sorted(traces.folder.path.iterdir()) if traces.folder.path.exists() else []


def plainly(*args) -> Sums:
    with jax.enable_x64(True):
        return jax.jit(sums)(*args)


def test_results_are_those_of_the_plain_function(traces):
    first = Compiled(sums, Sums)
    expected = plainly(pair(), 1.0)
    assert same(first(pair(), 1.0), expected) and first.traces == 1 and len(stored(traces)) == 1
    second = Compiled(sums, Sums)
    assert same(second(pair(), 1.0), expected) and second.traces == 0
    assert isinstance(second(pair(), 1.0), Sums) and second(pair(), offset=1.0).total == expected.total


def test_double_precision_and_any_kind_of_number(traces):
    """In a process that has set nothing: the same float64 from lists' floats, NumPy and JAX, with one trace."""
    assert not jax.config.jax_enable_x64
    function = compiled(Sums)(sums)
    with jax.enable_x64(True):
        of_jax = jax.tree.map(jnp.asarray, pair())
        weak = jnp.asarray(1.0) * 1.0
    results = [function(pair(), 1.0), function(of_jax, weak), function(pair(), np.float64(1.0)), function(of_jax, 1.0)]
    assert all(same(result, results[0]) for result in results) and results[0].double.dtype == np.float64
    assert function.traces == 1


def test_every_shape_is_traced_once(traces):
    function = Compiled(sums, Sums)
    for count in (3, 4, 3, 4):
        assert function(pair(count), 0.0).double.shape == (count,)
    assert function.traces == 2 and len(stored(traces)) == 2


def test_its_own_results_as_arguments_are_compiled_for_once(traces):
    """A filter's belief goes from call to call: results of a stored trace must not differ from other arrays."""
    compilations = []

    def listen(event: str, seconds: float, **_) -> None:
        compilations.extend([seconds] if event.endswith("backend_compile_duration") else [])

    function = compiled(Sums)(sums)
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        result = function(Pair(np.linspace(0.0, 1.0, 5), np.array(3.0)), 1.0)
        function(Pair(result.double, result.total), 1.0)
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert len(compilations) == 1


def test_without_a_folder_nothing_is_written(tmp_path, monkeypatch):
    monkeypatch.setattr(Traces, "used", None)
    monkeypatch.setenv("TVSBAYES_CACHE", str(tmp_path / "cache"))
    function = Compiled(sums, Sums)
    assert same(function(pair(), 1.0), plainly(pair(), 1.0)) and function.traces == 1
    assert not list(tmp_path.iterdir())


def test_inside_other_functions_it_is_the_plain_one(traces):
    """Under jit, vmap and grad."""
    function = Compiled(sums, Sums)
    with jax.enable_x64(True):
        slope = jax.grad(lambda x: function(Pair(x, jnp.array(3.0)), 1.0).total)(jnp.arange(3.0))
        np.testing.assert_allclose(slope, 3 * np.cos(np.arange(3.0)), rtol=1e-15)
        many = jax.vmap(lambda x: function(pair(), x).total)(jnp.arange(4.0))
        np.testing.assert_allclose(np.diff(many), 3.0, rtol=1e-15)
        assert same(jax.jit(lambda x: function(pair(), x))(1.0), function(pair(), 1.0))
    assert function.plain is sums and function.traces == 1


@pytest.mark.parametrize("harm", ["a byte", "cut", "foreign", "others write the file", "others write the folder"])
def test_a_trace_that_may_be_wrong_is_made_again(traces, harm):
    Compiled(sums, Sums)(pair(), 1.0)
    (path,) = stored(traces)
    data = path.read_bytes()
    if harm == "a byte":
        path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    elif harm == "cut":
        path.write_bytes(data[: len(data) // 2])
    elif harm == "foreign":
        traces.folder.write(path.name, b"another format")
    elif os.name != "posix":
        pytest.skip("Windows keeps the folders of its users apart by itself")
    elif harm == "others write the file":
        path.chmod(0o666)
    else:
        path.parent.chmod(0o777)
    function = Compiled(sums, Sums)
    assert same(function(pair(), 1.0), plainly(pair(), 1.0)) and function.traces == 1
    if harm != "others write the folder":
        assert path.stat().st_mode & 0o777 == 0o600 or os.name != "posix"
        again = Compiled(sums, Sums)
        assert again(pair(), 1.0).total == function(pair(), 1.0).total and again.traces == 0, "it was replaced"


def test_a_trace_of_other_shapes_or_results_is_not_run(traces):
    """Whole and the user's own, but under a name that is not its own."""
    Compiled(sums, Sums)(pair(4), 1.0)
    (other,) = stored(traces)
    wrong = other.read_bytes()
    Compiled(sums, Sums)(pair(3), 1.0)
    (path,) = set(stored(traces)) - {other}
    path.write_bytes(wrong)
    function = Compiled(sums, Sums)
    assert same(function(pair(3), 1.0), plainly(pair(3), 1.0)) and function.traces == 1
    single = Compiled(lambda pair, offset: sums(pair, offset).total, jax.Array)
    single.plain.__module__, single.plain.__qualname__ = sums.__module__, sums.__qualname__
    assert single(pair(3), 1.0).shape == () and single.traces == 1


def test_other_code_has_other_traces(traces, tmp_path, monkeypatch):
    name = traces.name("key")
    assert len(name) == 64 and Traces(tmp_path).name("key") == name != traces.name("other key")
    package = tmp_path / "package"
    package.mkdir()
    (package / "one.py").write_text("x = 1\n")
    monkeypatch.setattr(subject, "PACKAGE", package)
    first = Traces(tmp_path).name("key")
    (package / "one.py").write_text("x = 2\n")
    subject.sources_of.cache_clear()
    second = Traces(tmp_path).name("key")
    monkeypatch.setattr(subject, "version_of", lambda library: "0")
    assert len({name, first, second, Traces(tmp_path).name("key")}) == 4


def test_code_is_what_a_module_imports(tmp_path):
    """In every form; what is not imported from there is other code."""
    package = tmp_path / "tvsbayes"
    texts = {"a/one": "from tvsbayes.b.two import (\n    x,\n)\n", "b/two": "def f():\n    import tvsbayes.b.three\n"}
    texts |= {"b/three": "from tvsbayes.b import four\n", "b/four": "", "b/five": "from tvsbayes.a.one import y\n"}
    for name, text in texts.items():
        path = (package / name).with_suffix(".py")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    def sources(module: str) -> set[str]:
        paths = subject.sources_of(module, package)
        return {path.relative_to(package).with_suffix("").as_posix() for path in paths}

    assert sources("tvsbayes.a.one") == {"a/one", "b/two", "b/three", "b/four"}
    assert sources("tvsbayes.b.four") == {"b/four"} and sources("elsewhere") == set(texts)


def test_source_written_since_the_start_is_not_what_runs(traces, tmp_path, monkeypatch):
    package = tmp_path / "package"
    package.mkdir()
    (package / "one.py").write_text("x = 1\n")
    os.utime(package / "one.py", (1000.0, 1000.0))
    monkeypatch.setattr(subject, "PACKAGE", package)
    monkeypatch.setattr(subject, "LOADED_TIME_S", 1000.0)
    assert traces.name("key")
    os.utime(package / "one.py", (1001.0, 1001.0))
    assert traces.name("key") == ""
    function = Compiled(sums, Sums)
    assert function(pair(), 1.0).double.shape == (3,) and not stored(traces)


def test_without_flatbuffers_it_is_traced_in_every_process(traces, monkeypatch):
    def missing(*_, **__):
        raise ModuleNotFoundError("No module named 'flatbuffers'")

    monkeypatch.setattr(subject.export.Exported, "serialize", missing)
    function = Compiled(sums, Sums)
    assert same(function(pair(), 1.0), plainly(pair(), 1.0)) and not stored(traces)


def test_what_cannot_be_exported_is_compiled_as_ever(traces):
    def called_back(x):
        return jax.pure_callback(np.sin, jax.ShapeDtypeStruct(x.shape, x.dtype), x)

    function = Compiled(called_back, jax.Array)
    np.testing.assert_array_equal(function(np.arange(3.0)), np.sin(np.arange(3.0)))
    assert not stored(traces)


def test_threads_trace_once(traces):
    function = Compiled(sums, Sums)
    threads = [threading.Thread(target=function, args=(pair(), 1.0)) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert function.traces == 1


CHILD = """
import json, sys
import jax, numpy as np
from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.rig import read_rig
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.model.headlines import headlines
from tvsbayes.model.parameter_space import parameter_space

seen = []
jax.monitoring.register_event_listener(lambda event, **_: seen.append(event.rsplit("/")[-1]))
empty = use_compilation_cache()
rig = read_rig(shipped_data() / "rigs" / "mounted" / "rig.toml")
space = parameter_space(rig.table, rig.stereo)
seen.clear()
found = headlines(np.full(len(TWO_MIRROR.names), 0.1), space, np.array([0.1, 0.2]))
print(json.dumps({"empty": empty, "traces": headlines.traces, "hits": seen.count("cache_hits"),
    "misses": seen.count("cache_misses"), "value": np.asarray(found.value).tolist()}))
"""


def child(folder: Path) -> dict:
    environment = {**os.environ, "TVSBAYES_CACHE": str(folder), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", CHILD]
    result = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


@pytest.mark.slow
def test_a_second_process_neither_traces_nor_compiles(tmp_path):
    """Of a function of the model; of a small one `test_compilation_cache` sees the same in every run."""
    first, second = child(tmp_path / "cache"), child(tmp_path / "cache")
    assert (first["empty"], first["traces"], first["misses"]) == (True, 1, 1)
    assert (second["empty"], second["traces"], second["misses"], second["hits"]) == (False, 0, 0, 1)
    assert second["value"] == first["value"], "to the last bit"
