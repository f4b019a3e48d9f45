"""Does anything in a stranger's folder run, hang, fill the memory, write elsewhere or end in a traceback?

    python -m experiments.robustness.hostile folders                    # crafted folders through readers and commands
    python -m experiments.robustness.hostile mutations --n 100000       # seeded mutations of a good folder, in process
    python -m experiments.robustness.hostile table > experiments/robustness/hostile.md

Folders and mutations are those of `tests/support/hostile_folders.py`. A command is a process of its own with a HOME and
a TMPDIR of its own, watched: exit code, traceback, peak resident memory, processor time, and a listing with hashes of
the campaign's folder, its parent, HOME and TMPDIR before and after. Rows go to `experiments/output/robustness/`.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import platform
import resource
import shlex
import shutil
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from html.parser import HTMLParser
from pathlib import Path
from types import ModuleType

from experiments.common.command_line import act, parser
from experiments.common.of_tests import module_of_tests
from experiments.common.rows import append_row, commit, output, read_rows
from experiments.common.watched import CPU_S_MAX, EXIT_CODES, MEMORY_MAX, fine, watched

FOLDERS, MUTATIONS = output(__file__, "hostile-folders.jsonl"), output(__file__, "hostile-mutations.jsonl")
SCRATCH = output(__file__, "hostile-scratch")
SEED = 20261121
CHUNK, PER_CHUNK, TRACED = 2500, 5, 50
"""Mutations in a row; of these through the commands (200 of 100 000); of these with allocations traced."""
MESSAGE_CHARS_MAX = 1200


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


def folders_module() -> ModuleType:
    """`tests/support/hostile_folders.py`: the good folder, what is done to it, and seeded mutations."""
    return module_of_tests("support.hostile_folders")


def build(folder: Path, name: str) -> None:
    """A good folder, spoilt as the crafted one of this name is; without a name whole."""
    folders = folders_module()
    folders.good_folder(folder)
    if name in folders.CRAFTED:
        folders.CRAFTED[name].edit(folder)


@dataclass(frozen=True)
class Case:
    """A command on a folder: its name, the command with @ for the folder, what it is about, the exit codes allowed."""

    name: str
    command: str
    threat: str
    codes: tuple[int, ...]


def cases() -> list[Case]:
    """The good folder first: what compiles is in the cache then, and every command must do its work on it."""
    crafted = folders_module().CRAFTED
    commands = sorted({command for one in crafted.values() for command in one.commands})
    # `doctor` finds no instrument.
    good = [Case("good folder", command, "none", (0, 1, 2, 3, 4, 5)) for command in commands]
    return good + [Case(n, c, one.threat, tuple(sorted(one.codes))) for n, one in crafted.items() for c in one.commands]


def run_case(case: Case, place: Path) -> dict[str, object]:
    """Build the folder in a place of its own, run the command, say how it went."""
    (place / "home").mkdir(parents=True)
    (place / "tmp").mkdir()
    # In a child of its own: a process passes its peak memory on to those that it starts.
    builder = multiprocessing.get_context("fork").Process(target=build, args=(place / "c", case.name))
    builder.start()
    builder.join()
    if builder.exitcode:
        raise RuntimeError(f"{case.name} could not be built")
    row: dict[str, object] = {"name": case.name, "command": case.command, "threat": case.threat}
    row |= watched(shlex.split(case.command.replace("@", str(place / "c"))), place, SCRATCH)
    page = place / "c" / "results" / "report.html"
    row["codes"] = case.codes
    row["live"] = live_nodes(page) if row["exit"] == 0 and "report" in case.command else 0
    row["pwned"] = any("pwned" in path for path in row["elsewhere"])
    shutil.rmtree(place)
    return row


def run_folders(arguments: argparse.Namespace) -> None:
    """Every crafted folder through its commands; rows that are there are not made again."""
    SCRATCH.mkdir(parents=True, exist_ok=True)
    done = {(r["name"], r["command"]) for r in read_rows(FOLDERS)}
    with tempfile.TemporaryDirectory() as scratch:
        for number, case in enumerate(cases()):
            if (case.name, case.command) in done or (arguments.only and arguments.only not in case.name):
                continue
            row = run_case(case, Path(scratch) / str(number))
            append_row(FOLDERS, row)
            print("fine" if fine(row) else "NOT", case.name, case.command, row["exit"], file=sys.stderr)


def forked(arguments: list[str]) -> tuple[int, str, float, int]:
    """Exit code, output, processor seconds and peak memory of a command in a child of this process."""
    from tvsbayes.cli.main import run

    with tempfile.TemporaryFile() as stream:
        child = os.fork()
        if child == 0:
            code = 70
            try:
                os.dup2(stream.fileno(), 1)
                os.dup2(stream.fileno(), 2)
                code = run(arguments)
            except BaseException as error:
                os.write(2, f"Traceback {error!r}".encode())
            finally:
                os._exit(code)
        _, status, usage = os.wait4(child, 0)
        stream.seek(0)
        text = stream.read().decode(errors="replace")
    return os.waitstatus_to_exitcode(status), text, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024


COMMAND_OF = {
    "rig.toml": "check @/rig.toml",
    "plan.csv": "check @/plan.csv",
    "log.jsonl": "check @/journal",
    "log.jsonl, sealed": "check @/journal",
    "camera.yml": "stereo --import @/camera.yml",
    "draws.npz": "steps-for @ --export json",
    "draws.npz, repacked": "steps-for @ --export json",
    "fit.json": "check @",
    "picture header": "detect @",
}


def run_mutations(arguments: argparse.Namespace) -> None:
    """All mutations, a chunk a row: run again to go on."""
    done = {row["first"] for row in read_rows(MUTATIONS)}
    for first in range(0, arguments.n, CHUNK):
        if first in done:
            continue
        row = run_chunk(range(first, min(first + CHUNK, arguments.n)))
        append_row(MUTATIONS, row)
        print(f"to {first + CHUNK}: {len(row['defects'])} defects", *row["defects"][:5], sep="\n", file=sys.stderr)


@dataclass
class Chunk:
    """Mutations in a row of one good folder, and what came of them.

    Attributes:
        module: makes folder and mutations.
        folder: the good one.
        numbers: of the mutations.
        outcomes: by target.
        defects: in words.
        sample: bytes of one mutation of each target and end (whether it was read).
    """

    module: ModuleType
    folder: Path
    numbers: range
    outcomes: dict[str, dict]
    defects: list[str]
    sample: dict[tuple[str, bool], bytes]

    def keep(self, outcome, seconds: float) -> None:
        """One mutation."""
        row = self.outcomes[outcome.target]
        row["slowest_s"] = max(row["slowest_s"], seconds)
        row["read" if outcome.error is None else "refused"] += 1
        if outcome.error is not None:
            row["codes"][outcome.error.code] += 1
            message = outcome.error.message
            if not (message.isprintable() and message.encode() and len(message) < MESSAGE_CHARS_MAX):
                self.defects.append(f"mutation {outcome.number}: message {message[:100]!r}")
        self.sample.setdefault((outcome.target, outcome.error is None), outcome.data)

    def mutate(self) -> None:
        """All mutations in this process, then a few with Python's allocations traced."""
        names = list(self.module.TARGETS)
        following, before = self.numbers.start, time.process_time()
        while following < self.numbers.stop:
            try:
                for outcome in self.module.mutations(self.folder, range(following, self.numbers.stop), SEED):
                    seconds, before = time.process_time() - before, time.process_time()
                    following = outcome.number + 1
                    self.keep(outcome, seconds)
            except Exception as error:  # whatever else comes out is a defect
                self.defects.append(f"mutation {following} ({names[following % len(names)]}): {error!r}"[:300])
                following += 1
        for outcome in self.module.mutations(self.folder, self.numbers[:TRACED], SEED, traced=True):
            row = self.outcomes[outcome.target]
            row["peak_bytes"] = max(row["peak_bytes"], outcome.peak_bytes or 0)

    def through_commands(self) -> dict[str, object]:
        """One kind and end after the other, so that the chunks together bring all of them."""
        codes: Counter = Counter()
        worst_s, worst_bytes = 0.0, 0
        kinds = sorted(self.sample)
        start = self.numbers.start // CHUNK * PER_CHUNK
        for k in range(start, start + min(PER_CHUNK, len(kinds))):
            target, read = kinds[k % len(kinds)]
            path, table_of_spots = self.folder / self.module.TARGETS[target].file, self.folder / "spots.csv"
            kept = {path: path.read_bytes(), table_of_spots: table_of_spots.read_bytes()}
            path.write_bytes(self.sample[target, read])
            command = COMMAND_OF.get(target, "classic @").replace("@", str(self.folder))
            code, text, seconds, peak = forked(shlex.split(command))
            for place, data in kept.items():
                place.write_bytes(data)
            codes[code] += 1
            worst_s, worst_bytes = max(worst_s, seconds), max(worst_bytes, peak)
            if code not in EXIT_CODES or "Traceback" in text or "\x1b" in text:
                self.defects.append(f"command {command.split()[0]} on {target}: exit {code}: {text[-200:]!r}")
        return {"codes": codes, "command_s": worst_s, "command_bytes": worst_bytes}


def run_chunk(numbers: range) -> dict[str, object]:
    """Mutations in process, and one of each kind and end through the commands."""
    folders = folders_module()
    nothing = {"read": 0, "refused": 0, "slowest_s": 0.0, "peak_bytes": 0}
    with tempfile.TemporaryDirectory() as scratch:
        outcomes = {name: {**nothing, "codes": Counter()} for name in folders.TARGETS}
        chunk = Chunk(folders, folders.good_folder(Path(scratch) / "c"), numbers, outcomes, [], {})
        chunk.mutate()
        own_peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        commands = chunk.through_commands()
    row = {"first": numbers.start, "n": len(numbers), "seed": SEED, "targets": outcomes, "defects": chunk.defects}
    return {**row, "own_bytes": own_peak, **commands}


def table(arguments: argparse.Namespace) -> None:
    """Markdown of both."""
    rows = read_rows(FOLDERS)
    crafted = [r for r in rows if r["threat"] != "none"]
    plain = [r for r in rows if r["threat"] == "none"]
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
        f"folder through the same commands: most memory {max(r['peak_bytes'] for r in plain) / 1e6:.0f} MB.\n"
    )
    print("| threat | folder | command | exit | CPU s | MB | |\n|---|---|---|---|---|---|---|")
    for r in rows:
        verdict = "" if fine(r) or r["threat"] == "none" else "NOT as it should"
        command = r["command"].replace("@", "F")
        cells = f"{r['threat']} | {r['name']} | `{command}` | {r['exit']} | {r['cpu_s']:.1f}"
        print(f"| {cells} | {r['peak_bytes'] / 1e6:.0f} | {verdict} |")
    chunks = read_rows(MUTATIONS)
    defects = [defect for chunk in chunks for defect in chunk["defects"]]
    codes: Counter = sum((Counter(chunk["codes"]) for chunk in chunks), Counter())
    mem, through = (max(chunk[k] for chunk in chunks) / 1e6 for k in ("own_bytes", "command_bytes"))
    listed = ", ".join(f"{code}: {count}" for code, count in sorted(codes.items()))
    print(
        f"\n## Mutations\n\n{sum(c['n'] for c in chunks)} seeded mutations (seed {SEED}) in process: {len(defects)} "
        f"defects; most memory of the process {mem:.0f} MB. {codes.total()} of them through the commands, in processes "
        f"forked from one: exit codes {listed}; at most {max(c['command_s'] for c in chunks):.1f} s and "
        f"{through:.0f} MB.\n"
    )
    print("| file | read | refused | commonest | slowest, CPU s | most allocated, MB |\n|---|---|---|---|---|---|")
    for name in chunks[0]["targets"]:
        parts = [chunk["targets"][name] for chunk in chunks]
        common = sum((Counter(part["codes"]) for part in parts), Counter()).most_common(4)
        counts = (sum(part[k] for part in parts) for k in ("read", "refused"))
        slowest, most = (max(part[k] for part in parts) for k in ("slowest_s", "peak_bytes"))
        texts = (name, *map(str, counts), ", ".join(f"{code} {count}" for code, count in common))
        print(f"| {' | '.join(texts)} | {slowest:.2f} | {most / 1e6:.1f} |")
    for defect in defects:
        print(f"\n- {defect}")


def main() -> None:
    """See the module."""
    command = parser(__doc__, folders=run_folders, mutations=run_mutations, table=table)
    command.add_argument("--n", type=int, default=100_000, help="mutations (%(default)s)")
    command.add_argument("--only", help="folders whose name contains this")
    act(command)


if __name__ == "__main__":
    main()
