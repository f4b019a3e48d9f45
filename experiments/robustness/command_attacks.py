"""What do kills, two fits at once, programs that do not end and damaged inputs leave behind? A part of `attacks`."""

from __future__ import annotations

import json
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from experiments.common.commands import PROGRAM, measured, said
from experiments.common.rows import ROOT
from tvsbayes.cli.axis_import import FileOptions, import_readings
from tvsbayes.errors import InputError
from tvsbayes.single_axis.axis_campaign import read_axis

RIG = ROOT / "data" / "rigs" / "mounted"
PAIRS, COMMAND_KILLS, EDITED_FILES, LONGEST_S = 6, 4, 300, 1200.0
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


def begun(*words: object, cwd: Path) -> subprocess.Popen[bytes]:
    """A command that runs on; its output goes nowhere."""
    nowhere = subprocess.DEVNULL
    return subprocess.Popen([*PROGRAM, *map(str, words)], stdout=nowhere, stderr=nowhere, cwd=cwd)


def axis_log(rng: random.Random) -> str:
    """Two runs up and down an axis of play 0.1, commands 0 to 100."""
    before, rows = -1, ["command,reading mm,direction"]
    for command in [*range(0, 101, 10), *range(90, -1, -10)] * 2:
        side, before = (1 if command > before else -1), command
        rows.append(f"{command},{0.5 * command - 0.05 * side + rng.gauss(0, 0.002):.4f},{'+-'[side < 0]}")
    return "\n".join(rows) + "\n"


def raced(place: Path) -> str:
    """Two fits of one folder at once."""
    codes, whole = Counter[tuple[int, ...]](), 0
    for pair in range(PAIRS):
        folder = shutil.copytree(place / "axis", place / f"pair{pair}")
        both = [begun("fit", folder, "--no-sample", "--seed", seed, cwd=place) for seed in (1, 2)]
        codes[tuple(sorted(child.wait(LONGEST_S) for child in both))] += 1
        fit = json.loads((folder / "results" / "fit.json").read_text())
        with np.load(folder / "results" / "draws.npz") as draws:
            whole += str(draws["fit_id"]) == fit["fit_id"]
    return f"{PAIRS} pairs of fits at once: exit codes {dict(codes)}; draws and fit.json of one fit in {whole}"


def killed_commands(place: Path, rng: random.Random) -> Iterator[str]:
    """`calibrate`, `detect` and `acquire` killed at random moments; the next commands read and finish the folder."""
    steps = [row.split(",") for row in (RIG / "planned.csv").read_text().splitlines() if row[:1].isdigit()][:8]
    doubled = [row for step in steps for row in ([*step], ["", "place", "", "", "d2", "", ""])]
    rows = [",".join([str(k), *row[1:]]) for k, row in enumerate(doubled)]
    names = "step,action,pan_steps,tilt_steps,target,experiment,point"
    (place / "slow.csv").write_text("\n".join([names, *rows, ""]))
    said("simulate", RIG / "rig.toml", "slow.csv", "frames", "--frames", cwd=place)
    shutil.copytree(place / "axis", place / "calibrated")
    wait = f"{sys.executable} -c 'import time; time.sleep({WAIT_S})'"
    run = ("acquire", RIG / "rig.toml", "slow.csv", "run2", "--simulate", "--centroids", "--place-command", wait)
    commands = {"calibrated": ("calibrate", "calibrated", "--quick"), "frames": ("detect", "frames"), "run2": run}
    for name, words in commands.items():
        hits, checks, resumed = 0, Counter[int](), ()
        for _ in range(COMMAND_KILLS):
            child = begun(*words, *resumed, cwd=place)
            time.sleep(rng.uniform(0.5, 5.0))
            hits += child.poll() is None
            child.kill()
            child.wait()
            resumed = ("--resume",) if name == "run2" and (place / name / "log.jsonl").exists() else ()
            if (place / name).exists():
                checks[said("check", name, cwd=place).returncode] += 1
        last = said(*words, *resumed, cwd=place).returncode
        left = sum(path.name.endswith(".tmp") for path in (place / name).rglob("*"))
        what = f"`{words[0]}`: {hits} of {COMMAND_KILLS} kills hit it; exit codes of `check` after them {dict(checks)}"
        yield f"{what}, of the command again {last}; {left} unfinished files left"


def placed(place: Path) -> Iterator[str]:
    """Place commands that do not end: below a wrapper, and in a flood."""
    alive = place / "alive"
    scripts = {"stub": "trap '' TERM\nsleep 400 & echo $! > {}\nwait; wait", "flood": "yes A & echo $! > {}\nwait"}
    for name, text in scripts.items():
        script = place / f"{name}.sh"
        script.write_text(f"#!/bin/sh\n{text.format(alive)}\n")
        script.chmod(0o755)
        words = ("--simulate", "--centroids", "--place-command", script, "--place-seconds", 2)
        done = said("acquire", RIG / "rig.toml", place / "slow.csv", place / name, *words, cwd=place)
        kept = sum(path.stat().st_size for path in (place / name).rglob("*") if path.is_file())
        state = Path(f"/proc/{alive.read_text().strip()}/stat")
        runs = state.exists() and state.read_text().rpartition(")")[2].split()[0] != "Z"
        said_of = "its process runs on" if runs else "nothing runs on"
        yield f"place command, {name}: exit code {done.returncode}, {said_of}, {kept / 1e3:.0f} kB in the folder"


def read_urdf(place: Path) -> str:
    """Edits of the URDF in head.md."""
    page = (ROOT / "data" / "docs" / "head.md").read_text(encoding="utf-8")
    good, counts = re.search(r"```xml\n(.*?)```", page, re.DOTALL)[1].encode(), Counter[str]()
    for k, (old, new) in enumerate(URDF_EDITS.values()):
        (place / "head.urdf").write_bytes(good.replace(old, new))
        words = ("--urdf", "head.urdf", "--to", f"head{k}", "--steps-per-turn", 6000, "--yes")
        done = said("import", *words, cwd=place)
        counts["TRACEBACK" if "Traceback" in done.stderr else {0: "read", 2: "refused"}[done.returncode]] += 1
    return f"{len(URDF_EDITS)} edits of a URDF: {dict(counts)}"


def bombs(place: Path) -> str:
    """Memory of Klipper's logs that would expand."""
    step = {"first_step_time": 0, "last_step_time": 10, "first_clock": 0, "last_clock": 1000}
    messages = [{"q": "angle:a", "params": {"data": [[0, 1], [1, 2], [2, 3], [3, 4]]}}]
    bomb, used = {"q": "stepq:s", "params": {**step, "data": [[10, 19_999_999, 0]]}}, []
    for count in BOMBS:
        (place / "bomb.json").write_text("\x03".join(map(json.dumps, messages + count * [bomb])))
        words = [*PROGRAM, "import", "bomb.json", "--axis", "--to", "bomb", "--yes"]
        used.append(f"{measured(words, cwd=place, check=False)[1]['rss_mib'] * 1.048576:.0f}")
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


def further(rng: random.Random) -> None:
    """Attacks on results, programs and inputs."""
    with tempfile.TemporaryDirectory() as scratch:
        place = Path(scratch)
        (place / "axis.csv").write_text(axis_log(rng))
        said("import", "axis.csv", "--axis", "--to", "axis", "--yes", cwd=place)
        found = [raced(place), *killed_commands(place, rng), *placed(place)]
        found += [read_urdf(place), bombs(place), edited_tables(place, rng)]
        print(*(f"- {text}" for text in found), sep="\n", flush=True)
