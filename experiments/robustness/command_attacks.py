"""What do kills, two fits at once, programs that do not end and damaged inputs leave behind? A part of `attacks`."""

from __future__ import annotations

import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

from experiments.common.rows import ROOT, commit
from tvsbayes.cli.axis_import import FileOptions, import_readings
from tvsbayes.errors import InputError
from tvsbayes.single_axis.axis_campaign import read_axis

RIG = ROOT / "data" / "rigs" / "mounted"
COMMAND = (sys.executable, "-c", "from tvsbayes.cli.main import main; main()")
SEED, LONGEST_S = 20261126, 1200.0
PAIRS, COMMAND_KILLS, EDITED_FILES = 6, 4, 300
WAIT_S = 0.3
"""Of each placement, so that the twin does not end within a second."""
BOMBS = (1, 2, 4)
"""Messages of 20 million steps in a log of Klipper."""
NUMBER = re.compile(rb"-?\d+\.?\d*")
WORDS = (b"nan", b"inf", b"-1", b"0", b"1e308", b"1e400", b"9" * 400, b"", b"null", b"0x10", b"1:2:3", b"\x00")
URDF_EDITS = {
    "a character by number": (b'lower="-1.2"', b'lower="-1&#46;2"'),
    "a comment in a number": (b'lower="-1.2"', b'lower="-1<!-- -->.2"'),
    "lower above upper": (b'lower="-1.2"', b'lower="3"'),
    "two joints of one name": (b"tilt_joint", b"pan_joint"),
    "an entity": (b"<robot", b'<!DOCTYPE r [<!ENTITY a "b">]><robot'),
    **{f"axis {word}": (b'xyz="0 1 0"', f'xyz="0 {word} 0"'.encode()) for word in ("nan", "inf", "1e308", "0", "one")},
}


def said(*words: object, folder: Path, timeout_s: float = LONGEST_S) -> subprocess.CompletedProcess[str]:
    """A command that ends by itself, in a folder."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [*COMMAND, *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, cwd=folder, env=environment)


def begun(*words: object, folder: Path) -> subprocess.Popen[bytes]:
    """A command that runs on; its output goes nowhere."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    nowhere = subprocess.DEVNULL
    return subprocess.Popen([*COMMAND, *map(str, words)], stdout=nowhere, stderr=nowhere, cwd=folder, env=environment)


def axis_log(rng: random.Random) -> str:
    """Two runs up and down an axis of play 0.1, commands 0 to 100."""
    runs = [*range(0, 101, 10), *range(90, -1, -10)] * 2
    before, rows = -1, ["command,reading mm,direction"]
    for command in runs:
        side, before = (1 if command > before else -1), command
        rows.append(f"{command},{0.5 * command - 0.05 * side + rng.gauss(0, 0.002):.4f},{'+-'[side < 0]}")
    return "\n".join(rows) + "\n"


def raced(place: Path) -> str:
    """Two fits of one folder at once."""
    codes, whole = Counter[tuple[int, ...]](), 0
    for pair in range(PAIRS):
        folder = shutil.copytree(place / "axis", place / f"pair{pair}")
        both = [begun("fit", folder, "--no-sample", "--seed", seed, folder=place) for seed in (1, 2)]
        codes[tuple(sorted(child.wait(LONGEST_S) for child in both))] += 1
        fit = json.loads((folder / "results" / "fit.json").read_text())
        with np.load(folder / "results" / "draws.npz") as draws:
            whole += str(draws["fit_id"]) == fit["fit_id"]
    return f"{PAIRS} pairs of fits at once: exit codes {dict(codes)}; draws and fit.json of one fit in {whole}"


def killed_commands(place: Path, rng: random.Random) -> list[str]:
    """`calibrate`, `detect` and `acquire` killed at random moments; the next commands read and finish the folder."""
    steps = [row.split(",") for row in (RIG / "planned.csv").read_text().splitlines() if row[:1].isdigit()][:8]
    doubled = [row for step in steps for row in ([*step], ["", "place", "", "", "d2", "", ""])]
    rows = [",".join([str(k), *row[1:]]) for k, row in enumerate(doubled)]
    names = "step,action,pan_steps,tilt_steps,target,experiment,point"
    (place / "slow.csv").write_text("\n".join([names, *rows, ""]))
    rig = RIG / "rig.toml"
    said("simulate", rig, place / "slow.csv", place / "frames", "--frames", folder=place)
    shutil.copytree(place / "axis", place / "calibrated")
    wait = f"{sys.executable} -c 'import time; time.sleep({WAIT_S})'"
    run = ("acquire", rig, place / "slow.csv", place / "run2", "--simulate", "--centroids", "--place-command", wait)
    commands = {"calibrated": ("calibrate", "calibrated", "--quick"), "frames": ("detect", "frames"), "run2": run}
    lines = []
    for name, words in commands.items():
        hits, checks, resumed = 0, Counter[int](), ()
        for _ in range(COMMAND_KILLS):
            child = begun(*words, *resumed, folder=place)
            time.sleep(rng.uniform(0.5, 5.0))
            hits += child.poll() is None
            child.kill()
            child.wait()
            resumed = ("--resume",) if name == "run2" and (place / name / "log.jsonl").exists() else ()
            if (place / name).exists():
                checks[said("check", name, folder=place).returncode] += 1
        last = said(*words, *resumed, folder=place).returncode
        left = sum(path.name.endswith(".tmp") for path in (place / name).rglob("*"))
        what = f"`{words[0]}`: {hits} of {COMMAND_KILLS} kills hit it; exit codes of `check` after them {dict(checks)}"
        lines.append(f"{what}, of the command again {last}; {left} unfinished files left")
    return lines


def placed(place: Path) -> list[str]:
    """Place commands that do not end: below a wrapper, and in a flood."""
    plan, alive = place / "slow.csv", place / "alive"
    (place / "stub.sh").write_text(f"#!/bin/sh\ntrap '' TERM\nsleep 400 & echo $! > {alive}\nwait; wait\n")
    (place / "flood.sh").write_text(f"#!/bin/sh\nyes AAAAAAAA & echo $! > {alive}\nwait\n")
    lines = []
    for name in ("stub", "flood"):
        (place / f"{name}.sh").chmod(0o755)
        words = ("--simulate", "--centroids", "--place-command", place / f"{name}.sh", "--place-seconds", 2)
        done = said("acquire", RIG / "rig.toml", plan, place / name, *words, folder=place)
        kept = sum(path.stat().st_size for path in (place / name).rglob("*") if path.is_file())
        words_of = "its process runs on" if runs(int(alive.read_text())) else "nothing runs on"
        size = f"{kept / 1e3:.0f} kB in the folder"
        lines.append(f"place command, {name}: exit code {done.returncode}, {words_of}, {size}")
    return lines


def runs(pid: int) -> bool:
    """Whether a process runs (Linux)."""
    state = Path(f"/proc/{pid}/stat")
    return state.exists() and state.read_text().rpartition(")")[2].split()[0] != "Z"


def planned(place: Path) -> str:
    """Plans of what to read next."""
    at = []
    for seed in range(3):
        done = said("plan", "--given", "axis", "--seed", seed, "--json", folder=place)
        at += [float(n) for n in re.findall(r'"(?:command|via)": (-?[\d.]+)', done.stdout)]
    return f"`plan --given` of commands 0 to 100, 3 seeds: {len(at)} commands and run-ups, {min(at):g} to {max(at):g}"


def seeded(place: Path) -> str:
    """Fits by their seeds."""
    ids = []
    for k, seed in enumerate((1, 1, 2)):
        said("fit", "axis", "--quick", "--seed", seed, "--out", place / f"seed{k}", folder=place)
        with np.load(place / f"seed{k}" / "draws.npz") as draws:
            ids.append({name: draws[name].tobytes() for name in draws if name not in ("fit_id", "inputs_sha256")})
    other = sum(ids[0][name] != ids[2].get(name) for name in ids[0])
    same = "equal" if ids[0] == ids[1] else "DIFFERENT"
    return f"draws of one seed twice: {same}; of another: {other} of {len(ids[0])} arrays differ"


def read_urdf(place: Path) -> list[str]:
    """Edits of the URDF in head.md."""
    page = (ROOT / "data" / "docs" / "head.md").read_text(encoding="utf-8")
    good, lines = re.search(r"```xml\n(.*?)```", page, re.DOTALL)[1].encode(), Counter[str]()
    for k, (old, new) in enumerate(URDF_EDITS.values()):
        (place / "head.urdf").write_bytes(good.replace(old, new))
        words = ("--urdf", "head.urdf", "--to", f"head{k}", "--steps-per-turn", 6000, "--yes")
        done = said("import", *words, folder=place)
        lines["TRACEBACK" if "Traceback" in done.stderr else {0: "read", 2: "refused"}[done.returncode]] += 1
    return [f"{len(URDF_EDITS)} edits of a URDF: {dict(lines)}"]


def bombs(place: Path) -> str:
    """Memory of Klipper's logs that would expand."""
    step = {"first_step_time": 0, "last_step_time": 10, "first_clock": 0, "last_clock": 1000}
    messages = [{"q": "angle:a", "params": {"data": [[0, 1], [1, 2], [2, 3], [3, 4]]}}]
    bomb = {"q": "stepq:s", "params": {**step, "data": [[10, 19_999_999, 0]]}}
    used = []
    for count in BOMBS:
        (place / "bomb.json").write_text("\x03".join(map(json.dumps, messages + count * [bomb])))
        measured = (
            "import resource, subprocess, sys\nsubprocess.run(sys.argv[1:], capture_output=True)\n"
            "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)"
        )
        words = [*COMMAND, "import", "bomb.json", "--axis", "--to", "bomb", "--yes"]
        child = [sys.executable, "-c", measured, *words]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        done = subprocess.run(child, capture_output=True, text=True, cwd=place, env=environment)
        used.append(f"{int(done.stdout) * 1024 / 1e6:.0f}")
    return f"Klipper, {', '.join(map(str, BOMBS))} messages of 20 million steps: {', '.join(used)} MB"


def edited_tables(place: Path, rng: random.Random) -> str:
    """Random edits of a table of readings, imported in this process; what is read is written and read again."""
    good, outcomes = axis_log(rng).encode(), Counter[str]()
    for k in range(EDITED_FILES):
        data = good
        for _ in range(rng.randint(1, 3)):
            number = rng.choice([*NUMBER.finditer(data)])
            data = data[: number.start()] + rng.choice(WORDS) + data[number.end() :]
        (place / "edited.csv").write_bytes(data)
        out = place / "edited" / str(k)
        try:
            found = import_readings(place / "edited.csv", out, None, FileOptions(), yes=True, as_json=True)
            found.write()
            read_axis(out)
            outcomes["read"] += 1
        except InputError:
            outcomes["refused after it was written" if out.exists() else "refused"] += 1
        except Exception as error:
            outcomes[f"TRACEBACK {type(error).__name__}"] += 1
    return f"{EDITED_FILES} edits of numbers in a table of an axis: {dict(outcomes)}"


def further() -> None:
    """Attacks on results, programs and inputs."""
    rng = random.Random(SEED)
    print(f"\n## Results, programs and inputs\n\n{time.strftime('%Y-%m-%d')}, commit {commit()}.\n")
    with tempfile.TemporaryDirectory() as scratch:
        place = Path(scratch)
        (place / "axis.csv").write_text(axis_log(rng))
        said("import", "axis.csv", "--axis", "--to", "axis", "--yes", folder=place)
        parts = (raced, lambda at: killed_commands(at, rng), placed, planned, seeded, read_urdf, bombs)
        for part in (*parts, lambda at: edited_tables(at, rng)):
            found = part(place)
            print(*(f"- {line}" for line in ([found] if isinstance(found, str) else found)), sep="\n", flush=True)
