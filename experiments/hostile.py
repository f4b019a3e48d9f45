"""Does anything in a stranger's folder run, hang, fill the memory, write elsewhere or end in a traceback?

    python experiments/hostile.py folders                    crafted folders through the readers and the commands
    python experiments/hostile.py mutations --n 100000       seeded mutations of a good folder, in process
    python experiments/hostile.py table > experiments/hostile.md

Folders and mutations are those of `tests/support/hostile_folders.py`. A command is a process of its own with a HOME and a
TMPDIR of its own, watched: exit code, traceback, peak resident memory, processor time, and a listing with hashes of
the campaign's folder, its parent, HOME and TMPDIR before and after. Rows go to `experiments/output/`.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import multiprocessing
import os
import platform
import resource
import shlex
import stat
import subprocess
import sys
import tempfile
import time
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
OUTPUT = ROOT / "experiments" / "output"
FOLDERS, MUTATIONS = OUTPUT / "hostile-folders.jsonl", OUTPUT / "hostile-mutations.jsonl"
SEED = 20261121
MEMORY_MAX, CPU_S_MAX = 1e9, 30.0
WALL_S_MAX = 600
CHUNK, PER_CHUNK, TRACED = 2500, 5, 50
"""Mutations in a row; of these through the commands (200 of 100 000); of these with allocations traced."""
MESSAGE_CHARS_MAX = 1200
EXIT_CODES = {0, 2, 3, 4}
OWN = ("spots.csv", "results")
"""What a command may write inside the campaign's folder."""


class Nodes(HTMLParser):
    """Counts what could run in a page."""

    def __init__(self) -> None:
        super().__init__()
        self.live = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Scripts that are no data, frames, handlers, links to code."""
        given = dict(attrs)
        data = tag == "script" and given.get("type") == "application/json"
        self.live += tag in ("script", "iframe", "object", "embed") and not data
        self.live += sum(name.startswith("on") for name in given)
        self.live += any((given.get(n) or "").strip().lower().startswith("javascript:") for n in ("href", "src"))


def live_nodes(page: Path) -> int:
    """Nodes that could run."""
    parser = Nodes()
    parser.feed(page.read_text())
    return parser.live


def listing(*places: Path) -> dict[str, str]:
    """Kind, target or hash of everything below."""
    found = {}
    for place in places:
        for folder, folders, files in os.walk(place):
            for name in (*folders, *files):
                path = Path(folder) / name
                mode = path.lstat().st_mode
                if stat.S_ISLNK(mode):
                    found[str(path)] = f"link to {path.readlink()}"
                elif stat.S_ISREG(mode):
                    # Sparse giants of the folder itself are told by their size.
                    large = path.stat().st_size > 5e7
                    found[str(path)] = str(path.stat().st_size if large else hashlib.sha256(path.read_bytes()).digest())
                else:
                    found[str(path)] = str(stat.S_IFMT(mode))
    return found


def watched(arguments: list[str], place: Path) -> dict[str, object]:
    """Run a command on `place / "c"` and say how it went."""
    home, scratch = place / "home", place / "tmp"
    environment = {**os.environ, "HOME": str(home), "TMPDIR": str(scratch), "PYTHONPATH": str(ROOT)}
    environment |= {"TVSBAYES_CACHE": str(OUTPUT / "hostile-cache"), "MPLCONFIGDIR": str(OUTPUT / "hostile-cache")}
    before = listing(place)
    began = time.monotonic()
    log = OUTPUT / "hostile-log.txt"
    command = [sys.executable, "-c", "from tvsbayes.cli.main import main; main()", *arguments]
    with log.open("wb") as stream:
        child = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=stream, stderr=subprocess.STDOUT, env=environment, cwd=home
        )
        hung = False
        while True:
            pid, status, usage = os.wait4(child.pid, os.WNOHANG)
            if pid:
                break
            if time.monotonic() - began > WALL_S_MAX:
                hung = True
                child.kill()
            time.sleep(0.05)
    child.returncode = os.waitstatus_to_exitcode(status)
    after = listing(place)
    changed = {k for k in {*before, *after} if before.get(k) != after.get(k)}
    inside = str(place / "c") + os.sep
    elsewhere = [k for k in changed if not (k.startswith(inside) and k.removeprefix(inside).split(os.sep)[0] in OWN)]
    text = log.read_text(errors="replace")
    return {
        "exit": child.returncode,
        "traceback": "Traceback" in text,
        "escapes": "\x1b" in text,
        "hung": hung,
        "cpu_s": usage.ru_utime + usage.ru_stime,
        "wall_s": time.monotonic() - began,
        "peak_bytes": usage.ru_maxrss * 1024,
        "elsewhere": sorted(elsewhere),
        "said": text.strip()[-300:],
    }


def fine(row: dict) -> bool:
    """Whether a command did what it should."""
    return (
        row["exit"] in row["codes"]
        and row["exit"] in EXIT_CODES
        and not (row["traceback"] or row["escapes"] or row["hung"] or row["elsewhere"] or row["live"])
        and row["cpu_s"] < CPU_S_MAX
        and row["peak_bytes"] < MEMORY_MAX
    )


def build(folder: Path, crafted) -> None:
    """A good folder, spoilt as `crafted` says."""
    from hostile_folders import good_folder

    good_folder(folder)
    if crafted is not None:
        crafted.edit(folder)


def run_folders(only: str | None) -> None:
    """Every crafted folder through its commands; rows that are there are not made again."""
    from hostile_folders import CRAFTED

    OUTPUT.mkdir(exist_ok=True)
    done = set()
    if FOLDERS.exists():
        done = {(r["name"], r["command"]) for r in map(json.loads, FOLDERS.read_text().splitlines())}
    with tempfile.TemporaryDirectory() as scratch, FOLDERS.open("a") as rows:
        # The good folder first: what compiles is in the cache then, and every command must do its work on it.
        commands = sorted({c for crafted in CRAFTED.values() for c in crafted.commands})
        cases = [("good folder", command, None) for command in commands]
        cases += [(name, c, crafted) for name, crafted in CRAFTED.items() for c in crafted.commands]
        for number, (name, command, crafted) in enumerate(cases):
            if (name, command) in done or (only and only not in name):
                continue
            place = Path(scratch) / str(number)
            (place / "home").mkdir(parents=True)
            (place / "tmp").mkdir()
            # In a child of its own: a process passes its peak memory on to those that it starts.
            builder = multiprocessing.get_context("fork").Process(target=build, args=(place / "c", crafted))
            builder.start()
            builder.join()
            if builder.exitcode:
                raise RuntimeError(f"{name} could not be built")
            arguments = shlex.split(command.replace("@", str(place / "c")))
            row = {"name": name, "command": command, "threat": crafted.threat if crafted else "none"}
            row |= watched(arguments, place)
            row["codes"] = sorted(crafted.codes if crafted else {0, 1, 2, 3, 4})
            page = place / "c" / "results" / "report.html"
            row["live"] = live_nodes(page) if row["exit"] == 0 and "report" in command else 0
            row["pwned"] = any("pwned" in path for path in row["elsewhere"])
            rows.write(json.dumps(row) + "\n")
            rows.flush()
            print("fine" if fine(row) else "NOT", name, command, row["exit"], file=sys.stderr)
            subprocess.run(["rm", "-rf", str(place)], check=True)


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
        said = stream.read().decode(errors="replace")
    return os.waitstatus_to_exitcode(status), said, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024


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


def run_mutations(n: int) -> None:
    """All mutations, a chunk a row: run again to go on."""
    OUTPUT.mkdir(exist_ok=True)
    done = {json.loads(line)["first"] for line in MUTATIONS.read_text().splitlines()} if MUTATIONS.exists() else set()
    with MUTATIONS.open("a") as rows:
        for first in range(0, n, CHUNK):
            if first in done:
                continue
            row = run_chunk(range(first, min(first + CHUNK, n)))
            rows.write(json.dumps(row) + "\n")
            rows.flush()
            print(f"to {first + CHUNK}: {len(row['defects'])} defects", *row["defects"][:5], sep="\n", file=sys.stderr)


def run_chunk(numbers: range) -> dict[str, object]:
    """Mutations in process, a few with Python's allocations traced, one of each kind and end through the commands."""
    from hostile_folders import TARGETS, good_folder, mutations

    names = list(TARGETS)
    found: dict[str, dict] = {
        name: {"read": 0, "refused": 0, "codes": Counter(), "slowest_s": 0.0, "peak_bytes": 0} for name in TARGETS
    }
    defects: list[str] = []
    sample: dict[tuple[str, bool], bytes] = {}
    with tempfile.TemporaryDirectory() as scratch:
        folder = good_folder(Path(scratch) / "c")
        following, before = numbers.start, time.process_time()
        while following < numbers.stop:
            try:
                for outcome in mutations(folder, range(following, numbers.stop), SEED):
                    seconds, before = time.process_time() - before, time.process_time()
                    following = outcome.number + 1
                    row = found[outcome.target]
                    row["slowest_s"] = max(row["slowest_s"], seconds)
                    row["read" if outcome.error is None else "refused"] += 1
                    if outcome.error is not None:
                        row["codes"][outcome.error.code] += 1
                        message = outcome.error.message
                        if not (message.isprintable() and message.encode() and len(message) < MESSAGE_CHARS_MAX):
                            defects.append(f"mutation {outcome.number}: message {message[:100]!r}")
                    sample.setdefault((outcome.target, outcome.error is None), outcome.data)
            except Exception as error:  # whatever else comes out is a defect
                defects.append(f"mutation {following} ({names[following % len(names)]}): {error!r}"[:300])
                following += 1
        for outcome in mutations(folder, numbers[:TRACED], SEED, traced=True):
            row = found[outcome.target]
            row["peak_bytes"] = max(row["peak_bytes"], outcome.peak_bytes or 0)
        own_peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        codes: Counter = Counter()
        worst_s, worst_bytes = 0.0, 0
        # One kind and end after the other, so that the chunks together bring all of them.
        kinds = sorted(sample)
        start = numbers.start // CHUNK * PER_CHUNK
        for k in range(start, start + min(PER_CHUNK, len(kinds))):
            target, read = kinds[k % len(kinds)]
            path, table_of_spots = folder / TARGETS[target].file, folder / "spots.csv"
            kept = {path: path.read_bytes(), table_of_spots: table_of_spots.read_bytes()}
            path.write_bytes(sample[target, read])
            command = COMMAND_OF.get(target, "classic @").replace("@", str(folder))
            code, said, seconds, peak = forked(shlex.split(command))
            for place, data in kept.items():
                place.write_bytes(data)
            codes[code] += 1
            worst_s, worst_bytes = max(worst_s, seconds), max(worst_bytes, peak)
            if code not in EXIT_CODES or "Traceback" in said or "\x1b" in said:
                defects.append(f"command {command.split()[0]} on {target}: exit {code}: {said[-200:]!r}")
    row = {"first": numbers.start, "n": len(numbers), "seed": SEED, "targets": found, "defects": defects}
    return row | {"own_bytes": own_peak, "codes": codes, "command_s": worst_s, "command_bytes": worst_bytes}


def table() -> None:
    """Markdown of both."""
    commit = subprocess.run(
        ["git", "-C", str(ROOT), "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True
    ).stdout.strip()
    rows = [json.loads(line) for line in FOLDERS.read_text().splitlines()]
    crafted = [r for r in rows if r["threat"] != "none"]
    plain = [r for r in rows if r["threat"] == "none"]
    print("# Hostile input\n")
    print(f"{time.strftime('%Y-%m-%d')}, commit {commit}, Python {platform.python_version()}, {platform.machine()}.\n")
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
    chunks = [json.loads(line) for line in MUTATIONS.read_text().splitlines()]
    defects = [defect for chunk in chunks for defect in chunk["defects"]]
    codes: Counter = sum((Counter(chunk["codes"]) for chunk in chunks), Counter())
    own, through = (max(chunk[k] for chunk in chunks) / 1e6 for k in ("own_bytes", "command_bytes"))
    listed = ", ".join(f"{code}: {count}" for code, count in sorted(codes.items()))
    print(
        f"\n## Mutations\n\n{sum(c['n'] for c in chunks)} seeded mutations (seed {SEED}) in process: {len(defects)} "
        f"defects; most memory of the process {own:.0f} MB. {codes.total()} of them through the commands, in processes "
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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("folders", "mutations", "table"))
    parser.add_argument("--n", type=int, default=100_000)
    parser.add_argument("--only", help="folders whose name contains this")
    arguments = parser.parse_args()
    if arguments.what == "folders":
        run_folders(arguments.only)
    elif arguments.what == "mutations":
        run_mutations(arguments.n)
    else:
        table()


if __name__ == "__main__":
    main()
