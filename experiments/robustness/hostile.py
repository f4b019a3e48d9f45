"""Does anything in a stranger's folder run, hang, fill the memory, write elsewhere or end in a traceback?

    python -m experiments.robustness.hostile folders            # crafted folders through commands
    python -m experiments.robustness.hostile edits              # edited files through readers, some through commands
    python -m experiments.robustness.hostile table > experiments/robustness/hostile.md

Folders and edits are those of `tests/support/hostile_folders.py`; the edits are Hypothesis', more of them than in the
tests. A command is a process of its own with a HOME and a TMPDIR of its own, watched: exit code, traceback, peak
resident memory, processor time, and a listing with hashes of the campaign's folder, its parent, HOME and TMPDIR before
and after.
"""

from __future__ import annotations

import argparse
import hashlib
import multiprocessing
import os
import platform
import re
import shlex
import shutil
import stat
import sys
import tempfile
from collections import Counter
from pathlib import Path

from experiments.common.command_line import act, parser
from experiments.common.commands import PROGRAM, measured
from experiments.common.of_tests import module_of_tests
from experiments.common.page import heading, line
from experiments.common.rows import append_row, commit, output, read_rows

FOLDERS, EDITS = output(__file__, "hostile-folders.jsonl"), output(__file__, "hostile-edits.jsonl")
CACHE = output(__file__, "hostile-cache")
TRACED = 50
"""One example of so many has its allocations traced."""
MEMORY_MAX_MB, CPU_S_MAX, WALL_S_MAX = 1000.0, 30.0, 600.0
EXIT_CODES = {0, 2, 3, 4, 5}
OWN = ("spots.csv", "results")
"""What a command may write inside the campaign's folder."""
LIVE = re.compile(r"<(iframe|object|embed)\b|<script(?![^>]*application/json)|<[^>]+\s(on\w+=|(href|src)=.javascript:)")
"""What could run in a page."""


def listing(place: Path) -> dict[str, str]:
    """Kind, target or hash of everything below."""
    state = {}
    for folder, folders, files in os.walk(place):
        for path in (Path(folder) / name for name in (*folders, *files)):
            mode = path.lstat().st_mode
            if stat.S_ISLNK(mode):
                state[str(path)] = f"link to {path.readlink()}"
            elif not stat.S_ISREG(mode):
                state[str(path)] = str(stat.S_IFMT(mode))
            elif path.stat().st_size > 5e7:
                # Sparse giants of the folder itself are identified by their size.
                state[str(path)] = str(path.stat().st_size)
            else:
                state[str(path)] = hashlib.sha256(path.read_bytes()).hexdigest()
    return state


def build(folder: Path, name: str) -> None:
    """A good folder, spoilt as the crafted one of this name is; without a name whole."""
    folders = module_of_tests("support.hostile_folders")
    folders.good_folder(folder)
    if name in folders.CRAFTED:
        folders.CRAFTED[name].spoil(folder)


def run_command(place: Path, name: str, command: str, codes: list[int], file: str = "", data: bytes = b"") -> dict:
    """Build a folder, put data into one of its files, run a command on it, say how it went.

    Args:
        place: is made, watched, and removed afterwards: the folder `c`, a HOME and a TMPDIR.
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
    before, inside = listing(place), str(place / "c") + os.sep
    own = {"HOME": str(place / "home"), "TMPDIR": str(place / "tmp")}
    own |= {"TVSBAYES_CACHE": str(CACHE), "MPLCONFIGDIR": str(CACHE)}
    words = shlex.split(command.replace("@", str(place / "c")))
    limits = {"cwd": place / "home", "limit_s": WALL_S_MAX, "variables": own, "check": False}
    text, cost = measured([*PROGRAM, *words], **limits)
    row: dict = {"name": name, "command": command, "codes": codes}
    row |= {"hung": cost.pop("late"), "exit": cost.pop("code"), **cost}
    after = listing(place)
    changed = [path for path in {*before, *after} if before.get(path) != after.get(path)]
    row["elsewhere"] = sorted(
        path for path in changed if not (path.startswith(inside) and Path(path[len(inside) :]).parts[0] in OWN)
    )
    row |= {"traceback": "Traceback" in text, "escapes": "\x1b" in text, "said": text.strip()[-300:]}
    page = place / "c" / "results" / "report.html"
    row["live"] = len(LIVE.findall(page.read_text())) if row["exit"] == 0 and "report" in command else 0
    shutil.rmtree(place)
    return row


def fine(row: dict) -> bool:
    """Whether a command did what it should."""
    bad = any(row[key] for key in ("traceback", "escapes", "hung", "elsewhere", "live"))
    cheap = row["cpu_s"] < CPU_S_MAX and row["rss_mib"] * 1.048576 < MEMORY_MAX_MB
    return row["exit"] in row["codes"] and row["exit"] in EXIT_CODES and cheap and not bad


def run_folders(arguments: argparse.Namespace) -> None:
    """Every crafted folder through its commands; rows that are there are not made again."""
    crafted = module_of_tests("support.hostile_folders").CRAFTED
    # The good folder first: what compiles is in the cache then, and every command does its work on it. `doctor` finds
    # no instrument.
    commands = sorted({command for one in crafted.values() for command in one.commands})
    cases = [("good folder", command, EXIT_CODES, "") for command in commands]
    cases += [(name, command, one.codes, one.proves) for name, one in crafted.items() for command in one.commands]
    done = {(row["name"], row["command"]) for row in read_rows(FOLDERS)}
    with tempfile.TemporaryDirectory() as scratch:
        for name, command, codes, proves in cases:
            if (name, command) not in done and (arguments.only or "") in name:
                row = run_command(Path(scratch) / "case", name, command, sorted(codes))
                append_row(FOLDERS, {**row, "proves": proves})
                print("fine" if fine(row) else "NOT", name, command, row["exit"], file=sys.stderr)


def run_target(name: str, count: int) -> dict:
    """Edits of one file through its reader, one of each end (read, or the code of the refusal) through a command."""
    folders = module_of_tests("support.hostile_folders")
    target, sample = folders.TARGETS[name], {}
    row: dict = {"target": name, "n": count, "ends": Counter(), "exits": Counter(), "defects": []}
    row |= {"slowest_s": 0.0, "peak_bytes": 0}

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
    for name in module_of_tests("support.hostile_folders").TARGETS:
        if name not in done and (arguments.only or "") in name:
            row = run_target(name, arguments.n)
            append_row(EDITS, row)
            print(name, f"{len(row['defects'])} defects", *row["defects"], sep="\n", file=sys.stderr)


def table(_: argparse.Namespace) -> None:
    rows = read_rows(FOLDERS)
    crafted, good = ([row for row in rows if bool(row["proves"]) == spoilt] for spoilt in (True, False))
    most, usual = (max(row["rss_mib"] for row in of) * 1.048576 for of in (crafted, good))
    print(f"# Hostile input\n\nCommit {commit()}, Python {platform.python_version()}, {platform.machine()}.\n")
    print(
        f"{len({r['name'] for r in crafted})} crafted folders, {len(crafted)} commands, each a process of its own: "
        f"{sum(map(fine, crafted))} did what they should: the right exit code, no traceback, no escape character, less "
        f"than {MEMORY_MAX_MB:g} MB and {CPU_S_MAX:g} s of processor time, nothing written but `spots.csv` and "
        f"`results/`. Most memory {most:.0f} MB, longest {max(r['cpu_s'] for r in crafted):.1f} s. Live nodes in "
        f"reports: {sum(r['live'] for r in rows)}. The good folder through the same commands: {usual:.0f} MB.\n"
    )
    print(heading("folder | what it proves | command | exit | CPU s | MB | "))
    for row in crafted:
        command, verdict = f"`{row['command'].replace('@', 'F')}`", "" if fine(row) else "NOT as it should"
        figures = f"{row['cpu_s']:.1f}", f"{row['rss_mib'] * 1.048576:.0f}"
        print(line(row["name"], row["proves"], command, row["exit"], *figures, verdict))
    rows = read_rows(EDITS)
    exits = sum((Counter(row["exits"]) for row in rows), Counter())
    listed = ", ".join(f"{code}: {count}" for code, count in sorted(exits.items()))
    defects = [defect for row in rows for defect in row["defects"]]
    print(f"\n## Edits\n\n{sum(row['n'] for row in rows)} edited files, one or two edits each, through their readers:")
    print(f"{len(defects)} defects. One of each end, {exits.total()} in all, through a command, watched like")
    print("those above:")
    print(f"exit codes {listed}.\n\n{heading('file | read | refused | ends | slowest, CPU s | most allocated, MB')}")
    for row in rows:
        ends = Counter(row["ends"])
        read, common = ends.pop("read", 0), ", ".join(f"{code} {count}" for code, count in ends.most_common())
        figures = f"{row['slowest_s']:.2f}", f"{row['peak_bytes'] / 1e6:.1f}"
        print(line(row["target"], read, ends.total(), common, *figures))
    print(*(f"\n- {defect}" for defect in defects), sep="\n")


if __name__ == "__main__":
    command = parser(__doc__, folders=run_folders, edits=run_edits, table=table)
    command.add_argument("--n", type=int, default=3000, help="edits of each file (%(default)s)")
    command.add_argument("--only", help="folders, or files, whose name contains this")
    act(command)
