"""A command in a process of its own, watched: exit code, output, memory, time, and every file that it changes."""

from __future__ import annotations

import hashlib
import os
import stat
import subprocess
import sys
import time
from pathlib import Path

from experiments.common.rows import ROOT

MEMORY_MAX, CPU_S_MAX = 1e9, 30.0
"""Bytes and seconds of processor that a command on a folder may take."""
WALL_S_MAX = 600
EXIT_CODES = {0, 2, 3, 4, 5}
OWN = ("spots.csv", "results")
"""What a command may write inside the campaign's folder."""


def listing(*places: Path) -> dict[str, str]:
    """Kind, target or hash of everything below."""
    state = {}
    for place in places:
        for folder, folders, files in os.walk(place):
            for name in (*folders, *files):
                path = Path(folder) / name
                mode = path.lstat().st_mode
                if stat.S_ISLNK(mode):
                    state[str(path)] = f"link to {path.readlink()}"
                elif stat.S_ISREG(mode):
                    # Sparse giants of the folder itself are identified by their size.
                    large = path.stat().st_size > 5e7
                    state[str(path)] = str(path.stat().st_size if large else hashlib.sha256(path.read_bytes()).digest())
                else:
                    state[str(path)] = str(stat.S_IFMT(mode))
    return state


def watched(arguments: list[str], place: Path, scratch: Path) -> dict[str, object]:
    """Run a command on `place / "c"` and say how it went.

    Args:
        arguments: of `tvsbayes`.
        place: watched: holds the campaign's folder `c`, a HOME `home` and a TMPDIR `tmp`.
        scratch: not watched: compiled functions and the output of the command.
    """
    home = place / "home"
    environment = {**os.environ, "HOME": str(home), "TMPDIR": str(place / "tmp"), "PYTHONPATH": str(ROOT)}
    environment |= {"TVSBAYES_CACHE": str(scratch / "cache"), "MPLCONFIGDIR": str(scratch / "cache")}
    before = listing(place)
    began = time.monotonic()
    log = scratch / "log.txt"
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
