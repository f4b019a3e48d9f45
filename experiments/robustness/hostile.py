"""Does anything in a stranger's folder run, hang, fill the memory, write elsewhere or end in a traceback?

    python -m experiments.robustness.hostile folders            # crafted folders through commands
    python -m experiments.robustness.hostile edits              # edited files through readers, some through commands
    python -m experiments.robustness.hostile table > experiments/robustness/hostile.md

Folders and edits are those of `tests/support/hostile_folders.py`; the edits are Hypothesis', more of them than in the
tests. A command is a process of its own with a HOME and a TMPDIR of its own, watched: exit code, traceback, peak
resident memory, processor time, and a listing with hashes of the campaign's folder, its parent, HOME and TMPDIR before
and after. Rows go to `experiments/output/robustness/`.
"""

from __future__ import annotations

import argparse
import multiprocessing
import platform
import shlex
import shutil
import sys
import tempfile
import time
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path

from experiments.common.command_line import act, parser
from experiments.common.of_tests import module_of_tests
from experiments.common.rows import append_row, commit, output, read_rows
from experiments.common.watched import CPU_S_MAX, EXIT_CODES, MEMORY_MAX, fine, watched

FOLDERS, EDITS = output(__file__, "hostile-folders.jsonl"), output(__file__, "hostile-edits.jsonl")
SCRATCH = output(__file__, "hostile-scratch")
TRACED = 50
"""One example of so many has its allocations traced."""


class Nodes(HTMLParser):
    """Counts what could run in a page."""

    def __init__(self) -> None:
        super().__init__()
        self.live = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Scripts that are no data, frames, handlers, links to code."""
        attributes = dict(attrs)
        data = tag == "script" and attributes.get("type") == "application/json"
        self.live += tag in ("script", "iframe", "object", "embed") and not data
        self.live += sum(name.startswith("on") for name in attributes)
        self.live += any((attributes.get(n) or "").strip().lower().startswith("javascript:") for n in ("href", "src"))


def live_nodes(page: Path) -> int:
    """Nodes that could run."""
    parser = Nodes()
    parser.feed(page.read_text())
    return parser.live


def build(folder: Path, name: str) -> None:
    """A good folder, spoilt as the crafted one of this name is; without a name whole."""
    folders = module_of_tests("support.hostile_folders")
    folders.good_folder(folder)
    if name in folders.CRAFTED:
        folders.CRAFTED[name].spoil(folder)


def run_command(place: Path, name: str, command: str, codes: list[int], file: str = "", data: bytes = b"") -> dict:
    """Build a folder, put data into one of its files, run a command, say how it went.

    Args:
        place: is made, and removed afterwards.
        name: of a crafted folder; any other stands for a good one.
        command: with `@` for the folder.
        codes: exit codes allowed.
        file: whose content is replaced, if any.
        data: the content.
    """
    for inner in ("home", "tmp"):
        (place / inner).mkdir(parents=True)
    # In a child of its own: a process passes its peak memory on to those that it starts.
    builder = multiprocessing.get_context("fork").Process(target=build, args=(place / "c", name))
    builder.start()
    builder.join()
    if builder.exitcode:
        raise RuntimeError(f"{name} could not be built")
    if file:
        (place / "c" / file).write_bytes(data)
    row: dict = {"name": name, "command": command, "codes": codes}
    row |= watched(shlex.split(command.replace("@", str(place / "c"))), place, SCRATCH)
    page = place / "c" / "results" / "report.html"
    row["live"] = live_nodes(page) if row["exit"] == 0 and "report" in command else 0
    shutil.rmtree(place)
    return row


def run_folders(arguments: argparse.Namespace) -> None:
    """Every crafted folder through its commands; rows that are there are not made again."""
    crafted = module_of_tests("support.hostile_folders").CRAFTED
    # The good folder first: what compiles is in the cache then, and every command does its work on it. `doctor` finds
    # no instrument.
    commands = sorted({command for one in crafted.values() for command in one.commands})
    cases = [("good folder", command, EXIT_CODES, "") for command in commands]
    cases += [(name, command, one.codes, one.proves) for name, one in crafted.items() for command in one.commands]
    done = {(row["name"], row["command"]) for row in read_rows(FOLDERS)}
    SCRATCH.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        for name, command, codes, proves in cases:
            if (name, command) not in done and (arguments.only or "") in name:
                row = run_command(Path(scratch) / "case", name, command, sorted(codes))
                append_row(FOLDERS, {**row, "proves": proves})
                print("fine" if fine(row) else "NOT", name, command, row["exit"], file=sys.stderr)


def run_target(name: str, count: int) -> dict:
    """Edits of one file through its reader, one of each end (read, or the code of the refusal) through a command."""
    folders = module_of_tests("support.hostile_folders")
    target = folders.TARGETS[name]
    row: dict = {"target": name, "n": count, "ends": Counter(), "exits": Counter(), "defects": []}
    row |= {"slowest_s": 0.0, "peak_bytes": 0}
    sample: dict[str, bytes] = {}

    def seen(outcome) -> None:
        row["ends"][outcome.code] += not outcome.peak_bytes
        row["slowest_s"] = max(row["slowest_s"], 0.0 if outcome.peak_bytes else outcome.cpu_s)
        row["peak_bytes"] = max(row["peak_bytes"], outcome.peak_bytes)
        sample.setdefault(outcome.code, outcome.data)

    with tempfile.TemporaryDirectory() as scratch:
        folder = folders.good_folder(Path(scratch) / "c")
        for examples, traced in ((count, False), (count // TRACED, True)):
            try:
                folders.edited_files(folder, target, examples, seen, traced)
            except Exception as error:  # whatever comes out is a defect
                row["defects"].append(" ".join([repr(error)[:300], *getattr(error, "__notes__", ())[:2]]))
        for end, data in sample.items():
            run = run_command(Path(scratch) / "case", name, target.command, sorted(EXIT_CODES), target.file, data)
            row["exits"][run["exit"]] += 1
            if not fine(run):
                row["defects"].append(f"{target.command} where {name} ends in {end}: {run}"[:600])
    return row


def run_edits(arguments: argparse.Namespace) -> None:
    """File after file; rows that are there are not made again."""
    done = {row["target"] for row in read_rows(EDITS)}
    SCRATCH.mkdir(parents=True, exist_ok=True)
    for name in module_of_tests("support.hostile_folders").TARGETS:
        if name not in done and (arguments.only or "") in name:
            row = run_target(name, arguments.n)
            append_row(EDITS, row)
            print(name, f"{len(row['defects'])} defects", *row["defects"], sep="\n", file=sys.stderr)


def table(arguments: argparse.Namespace) -> None:
    """Markdown of both."""
    rows = read_rows(FOLDERS)
    crafted = [row for row in rows if row["proves"]]
    good = max(row["peak_bytes"] for row in rows if not row["proves"])
    print("# Hostile input\n")
    print(
        f"{time.strftime('%Y-%m-%d')}, commit {commit()}, Python {platform.python_version()}, {platform.machine()}.\n"
    )
    print(
        f"{len({r['name'] for r in crafted})} crafted folders, {len(crafted)} commands, each a process of its own: "
        f"{sum(map(fine, crafted))} did what they should: the right exit code of 0, 2, 3, 4, no traceback, no escape "
        f"character, less than {MEMORY_MAX / 1e9:g} GB and {CPU_S_MAX:g} s of processor time, nothing written but "
        f"`spots.csv` and `results/`. Most memory {max(r['peak_bytes'] for r in crafted) / 1e6:.0f} MB, longest "
        f"{max(r['cpu_s'] for r in crafted):.1f} s. Live nodes in reports: {sum(r['live'] for r in rows)}. The good "
        f"folder through the same commands: most memory {good / 1e6:.0f} MB.\n"
    )
    print("| folder | what it proves | command | exit | CPU s | MB | |\n|---|---|---|---|---|---|---|")
    for r in crafted:
        cells = (r["name"], r["proves"], f"`{r['command'].replace('@', 'F')}`", r["exit"], f"{r['cpu_s']:.1f}")
        verdict = "" if fine(r) else "NOT as it should"
        print(f"| {' | '.join(map(str, cells))} | {r['peak_bytes'] / 1e6:.0f} | {verdict} |")
    rows = read_rows(EDITS)
    exits = sum((Counter(row["exits"]) for row in rows), Counter())
    listed = ", ".join(f"{code}: {count}" for code, count in sorted(exits.items()))
    defects = [defect for row in rows for defect in row["defects"]]
    print(
        f"\n## Edits\n\n{sum(row['n'] for row in rows)} edited files, one or two edits each, through their readers: "
        f"{len(defects)} defects. One of each end, {exits.total()} in all, through a command, watched like those "
        f"above: exit codes {listed}.\n"
    )
    print("| file | read | refused | ends | slowest, CPU s | most allocated, MB |\n|---|---|---|---|---|---|")
    for row in rows:
        ends = Counter(row["ends"])
        read = ends.pop("read", 0)
        common = ", ".join(f"{code} {count}" for code, count in ends.most_common())
        figures = f"{row['slowest_s']:.2f} | {row['peak_bytes'] / 1e6:.1f}"
        print(f"| {row['target']} | {read} | {ends.total()} | {common} | {figures} |")
    for defect in defects:
        print(f"\n- {defect}")


def main() -> None:
    """See the module."""
    command = parser(__doc__, folders=run_folders, edits=run_edits, table=table)
    command.add_argument("--n", type=int, default=3000, help="edits of each file (%(default)s)")
    command.add_argument("--only", help="folders, or files, whose name contains this")
    act(command)


if __name__ == "__main__":
    main()
