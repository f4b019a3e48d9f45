"""The folder of compiled functions: the user's own or none, and what the doctor reports of it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest
from support.commands import caching_in

from tvsbayes.model import compilation_cache as subject
from tvsbayes.model.compilation_cache import REJECTED, cache_folder, cache_state, use_compilation_cache
from tvsbayes.model.compiled import Traces
from tvsbayes.pipeline import compile_for

ROOT = Path(__file__).resolve().parents[2]
posix = pytest.mark.skipif(os.name != "posix", reason="Windows keeps the folders of its users apart by itself")


@pytest.fixture
def folder(tmp_path):
    with caching_in(tmp_path / "cache"):
        yield tmp_path / "cache"


def answer(hits: int = 1, traces: int = 0, log: str = "") -> subprocess.CompletedProcess:
    return subprocess.CompletedProcess([], 0, json.dumps({"traces": traces, "hits": hits}), log)


def test_the_folder_is_made_for_its_user_alone(folder):
    assert use_compilation_cache() and cache_folder() == folder
    assert os.name != "posix" or folder.stat().st_mode & 0o777 == 0o700
    assert jax.config.jax_compilation_cache_dir == str(folder / "compiled")
    assert Traces.used.folder.path == folder / "traced"
    (folder / "compiled" / "jit_fit").touch()
    assert not use_compilation_cache()


def test_without_a_name_it_is_the_users_cache_folder(tmp_path, monkeypatch):
    """Whose mode an older version may have left to the umask."""
    with caching_in(""):
        monkeypatch.setattr(subject, "user_cache_path", lambda name: tmp_path / name)
        (tmp_path / "tvsbayes" / "jax").mkdir(parents=True, mode=0o777)
        (tmp_path / "tvsbayes" / "jax").chmod(0o777)
        use_compilation_cache()
        assert Traces.used.folder.path == tmp_path / "tvsbayes" / "jax" / "traced"


@posix
def test_a_folder_into_which_others_write_is_not_used(folder, capsys):
    """Nor JAX's own entries, which are code too; every command reports it."""
    folder.mkdir()
    folder.chmod(0o777)
    before = jax.config.jax_compilation_cache_dir
    assert use_compilation_cache() and Traces.used is None and jax.config.jax_compilation_cache_dir == before
    lines = []
    compile_for(lines.append)
    assert len(lines) == 1 and "others may write into it" in lines[0] and str(folder) in lines[0]
    state = cache_state()
    assert not state.used and "not used" in state.found and "chmod go-w" in state.remedy
    assert not list(folder.iterdir())


def test_a_folder_that_cannot_be_made_is_not_used(folder):
    folder.write_bytes(b"")
    assert use_compilation_cache() and Traces.used is None
    assert not cache_state().used


def test_what_one_process_leaves_the_next_one_takes(folder, monkeypatch, tmp_path):
    """Whatever lies in the folder one works in: nothing there is code."""
    (tmp_path / "platformdirs.py").write_text("raise SystemExit('run')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    state = cache_state()
    assert state.used and state.remedy == "" and str(folder) in state.found
    assert len(list((folder / "compiled").iterdir())) == len(list((folder / "traced").iterdir())) == 1


def values_of(folder: Path) -> tuple[str, str]:
    """What two functions of one signature give in a process with this cache, and what it prints on stderr."""
    code = (
        "import jax, numpy as np\n"
        "from tvsbayes.model.compilation_cache import use_compilation_cache\n"
        "use_compilation_cache()\n"
        "hits = []\n"
        "jax.monitoring.register_event_listener(lambda event, **_: hits.append('cache_hits' in event))\n"
        "x = np.arange(3.0)\n"
        "print(jax.jit(lambda x: x + 1)(x), jax.jit(lambda x: x * 5)(x), jax.jit(lambda x: x[:2])(x), sum(hits))\n"
    )
    environment = {**os.environ, "TVSBAYES_CACHE": str(folder), "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=True)
    return done.stdout.strip(), done.stderr


def test_exchanged_damaged_and_foreign_entries_are_compiled_again(tmp_path):
    """JAX's own cache runs what lies under a function's name: here x * 5 for x + 1, without a word."""
    right = "[1. 2. 3.] [ 0.  5. 10.] [0. 1.]"
    assert values_of(tmp_path)[0] == f"{right} 0"
    places = sorted((tmp_path / "compiled").iterdir())
    whole = [place.read_bytes() for place in places]
    assert len(places) == 3 and values_of(tmp_path) == (f"{right} 3", "")
    for harmed in ([*whole[1:], whole[0]], [data[:-9] for data in whole], [b"", b"PK\x03\x04", whole[2][:-1] + b"\0"]):
        for place, data in zip(places, harmed, strict=True):
            place.write_bytes(data)
        assert values_of(tmp_path) == (f"{right} 0", "")
        # And stored again.
        assert [len(place.read_bytes()) for place in places] == [len(data) for data in whole]


@pytest.mark.parametrize(
    ("outcome", "words"),
    [
        (answer(hits=0), "rejected"),
        (
            answer(log=f"E0000 cpu_aot_loader.cc:195] Loading XLA:CPU AOT result. {REJECTED} the machine type"),
            "rejected",
        ),
        (answer(traces=1), "their traces not"),
        (subprocess.CompletedProcess([], 0, "no document", ""), "could not be tried"),
        (subprocess.TimeoutExpired("python", 1.0), "could not be tried"),
        (FileNotFoundError("python"), "could not be tried"),
    ],
)
def test_what_does_not_work_is_reported_in_words(folder, monkeypatch, outcome, words):
    def run(command, **_):
        assert command[0] == sys.executable
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    monkeypatch.setattr(subprocess, "run", run)
    state = cache_state()
    assert not state.used and words in state.found and state.remedy


def test_the_doctor_says_it_without_hardware(folder, say, monkeypatch):
    """A rig file that names no port yet: its faults, and this computer's state."""
    monkeypatch.setattr(subject, "_tried", answer)
    code, out, _ = say("doctor", ROOT / "data" / "rigs" / "mounted" / "rig.toml")
    assert code == 5
    (line,) = (line for line in out.splitlines() if "compilation cache" in line)
    assert line.startswith("ok") and str(folder) in line
