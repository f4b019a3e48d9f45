"""Does the test suite see a bug? Faults as behaviour, planted one at a time in a copy of the tree; a test must fail.

    python -m experiments.robustness.planted_faults run       # resumable; --only REGEX: of sentence, place and test
    python -m experiments.robustness.planted_faults table > experiments/robustness/planted_faults.md

The faults stand in `faults/listing.py`. `run` unpacks HEAD into temporary folders, one for each process, plants a fault
there, and runs the test that the entry names; all these tests have to pass without a fault first. A row is made again
once the fault, its module or the file of its test has changed; `--again` makes all.
"""

from __future__ import annotations

import argparse
import datetime
import hashlib
import io
import os
import re
import subprocess
import sys
import tarfile
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from queue import SimpleQueue

from experiments.common.command_line import act, parser
from experiments.common.page import heading, line
from experiments.common.rows import ROOT, append_row, commit, commits_of, output, read_rows, rows_of
from experiments.robustness.faults.changes import Sources
from experiments.robustness.faults.listing import FAULTS, Fault, misfits, tests_of

LIMIT_S = 900
"""Tests that take longer count as failed: a loop that never ends is a fault that CI sees."""
COMMAND = ("-m", "pytest", "-q", "-x", "-n", "0", "--tb=no", "-p", "no:cacheprovider", "-rfE", "-m", "not slow")
ENVIRONMENT = {
    # An edited file may keep its size and, within a second, its time: no compiled module may outlive it.
    "PYTHONDONTWRITEBYTECODE": "1",
    "JAX_COMPILATION_CACHE_DIR": str(output(__file__, "planted_faults_compiled")),
}


def unpack(revision: str, root: Path) -> None:
    """A copy of the tree as committed."""
    archive = subprocess.run(["git", "archive", revision], cwd=ROOT, check=True, capture_output=True).stdout
    with tarfile.open(fileobj=io.BytesIO(archive)) as tree:
        tree.extractall(root, filter="data")


@contextmanager
def planted(root: Path, fault: Fault) -> Iterator[None]:
    """A copy of the tree with one fault in it, whole again afterwards."""
    path, text = fault.change.planted(Sources(root), fault.place)
    whole = path.read_text(encoding="utf-8")
    path.write_text(text, encoding="utf-8")
    try:
        yield
    finally:
        path.write_text(whole, encoding="utf-8")


def first_failure(root: Path, tests: Sequence[str]) -> str | None:
    """The first of some tests that fails on a copy; None if all pass.

    Raises:
        RuntimeError: pytest could not run them.
    """
    options = {"cwd": root, "env": {**os.environ, **ENVIRONMENT, "PYTHONPATH": str(root)}, "timeout": LIMIT_S}
    try:
        ended = subprocess.run([sys.executable, *COMMAND, *tests], capture_output=True, text=True, **options)
    except subprocess.TimeoutExpired:
        return "(time over)"
    if ended.returncode == 0:
        return None
    failed = re.search(r"^(?:FAILED|ERROR) (\S+::.*?)(?: - |$)", ended.stdout, re.MULTILINE)
    if failed is None:
        raise RuntimeError(f"pytest ended with {ended.returncode}:\n{ended.stdout[-2000:]}{ended.stderr[-2000:]}")
    return failed[1]


def valid_rows(path: Path, root: Path = ROOT) -> tuple[dict[str, dict], dict[str, str]]:
    """Rows that hold, and digests of what an outcome depends on: the fault in its module, the file of its test."""
    sources, now = Sources(root), {}
    for fault in FAULTS:
        _, text = fault.change.planted(sources, fault.place)
        files = [(root / name.partition("::")[0]).read_text(encoding="utf-8") for name in tests_of(fault.test, root)]
        now[fault.sentence] = hashlib.sha256(repr((text, fault.test, files)).encode()).hexdigest()[:16]
    rows = {row["sentence"]: row for row in read_rows(path) if now.get(row.get("sentence")) == row.get("digest")}
    return rows, now


def run(arguments: argparse.Namespace) -> None:
    """Append a row for every fault that has none; exit code 1 where a selected one survives."""
    if problems := misfits():
        raise SystemExit("\n".join(["the list does not fit the tree:", *problems]))
    # One commit from beginning to end, whatever is committed meanwhile.
    revision = commit()
    chosen = [f for f in FAULTS if re.search(arguments.only, f"{f.sentence} {f.place} {f.test}")]
    with tempfile.TemporaryDirectory(prefix="tvsbayes-faults-") as scratch:
        trees: SimpleQueue[Path] = SimpleQueue()
        for number in range(arguments.processes):
            unpack(revision, Path(scratch) / f"tree{number}")
            trees.put(Path(scratch) / f"tree{number}")
        first_tree = Path(scratch) / "tree0"
        rows, now = valid_rows(arguments.rows, first_tree)
        rows = {} if arguments.again else rows

        def one(fault: Fault) -> dict[str, object]:
            root, begun = trees.get(), time.monotonic()
            try:
                with planted(root, fault):
                    first = first_failure(root, tests_of(fault.test, root))
            finally:
                trees.put(root)
            row = {"sentence": fault.sentence, "failed": first is not None, "first": first or ""}
            seconds = round(time.monotonic() - begun, 1)
            return {**row, "seconds": seconds, "digest": now[fault.sentence], "commit": revision}

        left = [fault for fault in chosen if fault.sentence not in rows]
        tests = sorted({test for fault in left for test in tests_of(fault.test, first_tree)})
        if tests and (failed := first_failure(first_tree, tests)) is not None:
            raise SystemExit(f"{failed} does not pass without any fault")
        with ThreadPoolExecutor(arguments.processes) as pool:
            for row in pool.map(one, left):
                word = f"seen by {row['first']}" if row["failed"] else "SURVIVED"
                print(f"{row['sentence']}: {word} ({row['seconds']:.0f} s)", flush=True)
                rows[row["sentence"]] = row
                append_row(arguments.rows, row)
    caught = sum(rows[fault.sentence]["failed"] for fault in chosen)
    print(f"{caught} of {len(chosen)} seen")
    raise SystemExit(caught < len(chosen))


def table(arguments: argparse.Namespace) -> None:
    """What was run at the present state of the package and its tests."""
    rows, _ = valid_rows(arguments.rows)
    done = [rows[fault.sentence] for fault in FAULTS if fault.sentence in rows]
    caught, minutes = sum(row["failed"] for row in done), sum(row["seconds"] for row in done) / 60
    print("# Planted faults\n\nWritten by `python -m experiments.robustness.planted_faults table` on", end=" ")
    print(f"{datetime.date.today()} from runs at commit {commits_of(done)}.\n")
    print(f"**{caught} of {len(FAULTS)} faults seen** by the default test that the list names,", end=" ")
    print(f"{len(done) - caught} survive, {len(FAULTS) - len(done)} not run; {minutes:.0f} minutes of one process. A")
    print("fault is planted by name: what a definition returns, takes, reads or checks is changed in its")
    print("syntax tree.\n")
    print(heading("fault | place | change | test that fails | s"))
    for fault in FAULTS:
        verdict, seconds = "not run", ""
        if row := rows.get(fault.sentence):
            verdict = f"`{row['first'].removeprefix('tests/')}`" if row["failed"] else "**SURVIVED**"
            seconds = f"{row['seconds']:.0f}"
        print(line(fault.sentence, f"`{fault.place}`", f"`{fault.change!r}`", verdict, seconds))


if __name__ == "__main__":
    cli = parser(__doc__, run=run, table=table)
    cli.add_argument("--rows", type=Path, default=rows_of(__file__))
    cli.add_argument("--only", default="", help="regular expression found in sentence, place or test")
    cli.add_argument("--again", action="store_true", help="rows that are there count for nothing")
    cli.add_argument("--processes", type=int, default=2, help="each with a copy of the tree (%(default)s)")
    act(cli)
