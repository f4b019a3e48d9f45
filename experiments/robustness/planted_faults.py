"""Does the test suite see a bug? One-line faults planted one at a time in a copy of the tree; a test has to fail.

    python -m experiments.robustness.planted_faults run       # resumable; --only REGEX: of name, file and tests
    python -m experiments.robustness.planted_faults table > experiments/robustness/planted_faults.md
    python -m experiments.robustness.planted_faults check     # every entry still fits the source: under a second

The faults stand in `faults/`. `run` unpacks HEAD into temporary folders, one for each process, and plants a fault
there, never in the checkout. It runs the test that saw the fault last (by rows or page, wherever it stands), then the
tests that are the likeliest to see it, those of its package, all; slow ones take no part. A test that fails has to pass
without the fault. A row is done again once the fault, its module or the test that saw it has changed; `--again` does
all.
"""

from __future__ import annotations

import argparse
import datetime
import hashlib
import multiprocessing
import re
import tempfile
import time
import warnings
from dataclasses import astuple
from pathlib import Path

from experiments.common.command_line import parser
from experiments.common.rows import append_row, commit, git, output, read_rows
from experiments.robustness.faults.fault import Fault
from experiments.robustness.faults.listing import FAULTS, stale
from experiments.robustness.faults.trial import attempt, prepare, unpack

ROWS = output(__file__, "planted_faults.jsonl")
COMPILED = output(__file__, "planted_faults_compiled")
PAGE = Path(__file__).with_suffix(".md")
TIME_OVER = "(time over)"


class State:
    """The files of a commit by their contents: says which rows still hold."""

    def __init__(self, revision: str = "HEAD"):
        lines = git("ls-tree", "-r", "-t", revision).splitlines()
        self.blobs = {path: entry.split()[2] for entry, path in (line.split("\t", 1) for line in lines)}

    def digest(self, fault: Fault) -> str:
        """Of what an outcome hangs on first: the fault, its module, what all tests share."""
        contents = [self.blobs.get(path) for path in (fault.path, "tests/conftest.py")]
        return hashlib.sha256(repr((contents, astuple(fault)[1:4])).encode()).hexdigest()[:16]

    def of_test(self, test: str) -> str:
        """Of the file of a test; of all tests where none saw the fault."""
        return self.blobs.get(test.partition("::")[0], self.blobs.get("tests", ""))

    def rows(self, path: Path) -> dict[str, dict]:
        """Rows that hold, by the fault's name."""
        digests = {fault.name: self.digest(fault) for fault in FAULTS}
        return {
            row["name"]: row
            for row in read_rows(path)
            if digests.get(row["name"]) == row["digest"] and self.of_test(row["first"]) == row["contents"]
        }


def seen_last(rows: Path) -> dict[str, str]:
    """The test that saw a fault, by the fault's name, from the page or a row of whatever state."""
    page = PAGE.read_text(encoding="utf-8") if PAGE.exists() else ""
    found = {line.split(" | ")[0].removeprefix("| "): line for line in page.splitlines() if "::" in line}
    tests = {name: re.search(r"`([^`]+::[^`]+)`", line) for name, line in found.items()}
    return {name: test[1] for name, test in tests.items() if test} | {r["name"]: r["first"] for r in read_rows(rows)}


_tree = Path()
"""Of a worker."""


def _take(trees: multiprocessing.SimpleQueue) -> None:
    global _tree
    _tree = trees.get()


def _row(task: tuple[Fault, str]) -> dict[str, object]:
    """A trial in a worker."""
    fault, seen_by = task
    begun = time.monotonic()
    found = attempt(_tree, fault, seen_by)
    first = found.first or (TIME_OVER if found.failed else "")
    seconds = round(time.monotonic() - begun, 1)
    return {"name": fault.name, "failed": bool(found.failed), "first": first, "seconds": seconds}


def run(arguments: argparse.Namespace) -> int:
    """Append a row for every fault that has none; the number of survivors among those asked for."""
    if problems := stale():
        raise SystemExit("\n".join(["the list is stale:", *problems]))
    # One commit from beginning to end, whatever is committed meanwhile.
    revision = commit()
    state = State(revision)
    chosen = [f for f in FAULTS if re.search(arguments.only, " ".join((f.name, f.file, *f.selection)))]
    rows = {} if arguments.again else state.rows(arguments.rows)
    seen = seen_last(arguments.rows)
    left = [(fault, seen.get(fault.name, "")) for fault in chosen if fault.name not in rows]
    faults = {fault.name: fault for fault in chosen}
    prepare(COMPILED)
    context = multiprocessing.get_context("fork")
    with tempfile.TemporaryDirectory(prefix="tvsbayes-faults-") as scratch, warnings.catch_warnings():
        # JAX warns of forks; nothing has been computed in this process, and no thread of its runs.
        warnings.simplefilter("ignore")
        trees = context.SimpleQueue()
        for number in range(arguments.processes):
            unpack(revision, Path(scratch) / f"tree{number}")
            trees.put(Path(scratch) / f"tree{number}")
        with context.Pool(arguments.processes, initializer=_take, initargs=(trees,)) as pool:
            for row in pool.imap_unordered(_row, left):
                word = f"caught by {row['first']}" if row["failed"] else "SURVIVED"
                print(f"{row['name']}: {word} ({row['seconds']:.0f} s)", flush=True)
                row |= {"digest": state.digest(faults[row["name"]]), "contents": state.of_test(row["first"])}
                rows[row["name"]] = {**row, "commit": revision}
                append_row(arguments.rows, rows[row["name"]])
    caught = sum(rows[fault.name]["failed"] for fault in chosen)
    print(f"{caught} of {len(chosen)} caught")
    return len(chosen) - caught


def table(arguments: argparse.Namespace) -> int:
    """The Markdown table of what was run at the present state of the package and its tests."""
    found = State().rows(arguments.rows)
    done = [found[fault.name] for fault in FAULTS if fault.name in found]
    caught = sum(row["failed"] for row in done)
    minutes = sum(row["seconds"] for row in done) / 60
    at_first = sum(bool(f.survived) for f in FAULTS)
    print("# Planted faults\n")
    print(f"Written by `python -m experiments.robustness.planted_faults table` on {datetime.date.today()}", end=" ")
    print(f"from runs at commit {', '.join(sorted({row['commit'] for row in done}))}.\n")
    print(f"**{caught} of {len(FAULTS)} faults caught**", end="")
    print(f", {len(done) - caught} survive, {len(FAULTS) - len(done)} not run;", end=" ")
    print(f"{minutes:.0f} minutes of one process, the failing tests without the faults included.", end=" ")
    print(f"{at_first} of the faults got past the tests likely to see them, in a run or by reading:", end=" ")
    print("listed below; each has a test now.\n")
    print("| fault | file | harm | first failing test | s |\n|---|---|---|---|---|")
    for fault in FAULTS:
        verdict, seconds = "not run", ""
        if row := found.get(fault.name):
            verdict = f"`{row['first'].removeprefix('tests/')}`" if row["failed"] else "**SURVIVED**"
            seconds = f"{row['seconds']:.0f}"
        print(f"| {fault.name} | `{fault.file}` | {fault.harm} | {verdict} | {seconds} |")
    if at_first:
        print("\n## Survivors at first\n")
        for fault in FAULTS:
            if fault.survived:
                print(f"- {fault.name}: {fault.survived}")
    return len(FAULTS) - caught


def check(arguments: argparse.Namespace) -> int:
    """Say what of the list no longer fits the source."""
    problems = stale()
    print("\n".join(problems) or f"{len(FAULTS)} faults fit the source")
    return len(problems)


def main() -> None:
    """The command; exit code 1 where a fault survives or the list is stale."""
    made = parser(__doc__)
    made.add_argument("--rows", type=Path, default=ROWS)
    commands = made.add_subparsers(required=True)
    for command in (run, table, check):
        one = commands.add_parser(command.__name__, help=command.__doc__.splitlines()[0])
        one.set_defaults(command=command)
        if command is run:
            one.add_argument("--only", default="", help="regular expression found in name, file or tests")
            one.add_argument("--again", action="store_true", help="rows that are there count for nothing")
            one.add_argument("--processes", type=int, default=2, help="each with a copy of the tree (%(default)s)")
    arguments = made.parse_args()
    raise SystemExit(bool(arguments.command(arguments)))


if __name__ == "__main__":
    main()
