"""Rows of a study: where they lie, how pinned workers make them, which commit they are of.

A row is a line of JSON, written as soon as it is there: a study that was interrupted goes on where it stood.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import subprocess
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
OUTPUT = ROOT / "experiments" / "output"
"""What studies leave, a folder for each question; git ignores it."""


def output(script: str, name: str) -> Path:
    """Where a script keeps something: `output/QUESTION/NAME`.

    Args:
        script: the script's `__file__`.
        name: of the file.
    """
    return OUTPUT / Path(script).resolve().parent.relative_to(ROOT / "experiments") / name


def rows_of(script: str) -> Path:
    """Where a script keeps its rows: `output/QUESTION/SCRIPT.jsonl`."""
    return output(script, Path(script).with_suffix(".jsonl").name)


def read_rows(path: Path) -> list[dict]:
    """All complete rows; a torn last line is ignored."""
    rows = []
    for line in path.read_text().splitlines() if path.exists() else ():
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return rows


def append_row(path: Path, row: dict) -> None:
    """Write one row behind the others."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        file.write(json.dumps(row) + "\n")


def _pin(cores: multiprocessing.Queue) -> None:
    os.sched_setaffinity(0, {cores.get()})


def run_rows(one: Callable, tasks: Sequence[tuple], rows: Path, keys: Sequence[str], cores: Sequence[int]) -> None:
    """Append `one(task)` until every task is there, one single-threaded worker per core.

    Args:
        one: a module-level function from task to row; the row holds the task's parts under `keys`.
        tasks: in the order in which they are done.
        rows: read first: what is there is not done again.
        keys: names of a task's parts.
        cores: processor numbers.
    """
    # Here: JAX, which it brings, has no business in scripts that only read rows.
    from tvsbayes.studies.executors import SINGLE_THREADED

    done = {tuple(r.get(k) for k in keys) for r in read_rows(rows)}
    # Read by XLA and OpenBLAS when a worker starts.
    os.environ.update(SINGLE_THREADED)
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    for core in cores:
        queue.put(core)
    left = [task for task in tasks if tuple(task) not in done]
    with context.Pool(len(cores), initializer=_pin, initargs=(queue,)) as pool:
        for row in pool.imap_unordered(one, left):
            append_row(rows, row)


def git(*words: str) -> str:
    """Output of git in the checkout, empty where it fails."""
    return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=False).stdout.strip()


def commit(revision: str = "HEAD") -> str:
    """Short name of a commit; ? outside git."""
    return git("rev-parse", "--short", revision) or "?"


def state() -> str:
    """Short commit of the working tree, with + where tracked files of the package differ from it; ? outside git."""
    return commit() + "+" * bool(git("diff", "--name-only", "HEAD", "--", "tvsbayes"))


def cpu_model() -> str:
    """The processor's own name (Linux)."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    return next((row.split(":", 1)[1].strip() for row in lines if row.startswith("model name")), "unknown processor")


def commits_of(rows: Iterable[Mapping[str, object]]) -> str:
    """The commits at which rows were made, in their order; ? for a row that names none."""
    return ", ".join(dict.fromkeys(str(row.get("commit", "?")) for row in rows))
