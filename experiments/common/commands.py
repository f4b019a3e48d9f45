"""Commands of the package: called in this process, shown on pages, or in a process of their own with what it cost."""

from __future__ import annotations

import io
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import chdir, redirect_stderr, redirect_stdout
from functools import cache
from pathlib import Path
from typing import Any

from experiments.common.command_line import parser
from experiments.common.rows import ROOT

PROGRAM = (sys.executable, "-m", "tvsbayes")
IMPORTS = (sys.executable, "-c", "import jax, optimistix, scipy.stats")
"""What every command that fits needs: its CPU seconds are the unit of theirs."""
LAUNCHER = """
import json, os, sys, time
place, limit_s, *command = sys.argv[1:]
start, late = time.perf_counter(), False
child = os.posix_spawnp(command[0], command, os.environ)
while True:
    pid, status, usage = os.wait4(child, os.WNOHANG)
    wall_s = time.perf_counter() - start
    if pid:
        break
    if wall_s > float(limit_s) and not late:
        late = not os.kill(child, 9)
    time.sleep(0.002 if wall_s < 5 else 0.05)
cost = {"wall_s": wall_s, "cpu_s": usage.ru_utime + usage.ru_stime, "rss_mib": usage.ru_maxrss / 1024}
json.dump({"late": late, "code": os.waitstatus_to_exitcode(status), **cost}, open(place, "w"))
"""
"""Starts a command: Linux counts into its peak memory what its parent held when it was forked."""


def quietly(*line: str) -> tuple[int, str, str]:
    """Exit code of a command in this process, what it prints, and what it warns of."""
    from tvsbayes.cli.main import run

    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        code = run(list(line))
    return code, out.getvalue(), err.getvalue()


def document_of(*words: object) -> dict[str, Any]:
    """The JSON document of a command, with its exit code under "exit"."""
    code, out, _ = quietly(*map(str, words), "--json")
    return {**json.loads(out), "exit": code}


BLOCK = re.compile(r"```(text|console)\n(.*?)```\n", re.DOTALL)
SHOWN = re.compile(r"\$ tvsbayes (.*?)(?: \| (head|tail) -(\d+))?\n")


def renewed(page: str, files: Iterable[str] = (), before: Mapping[str, Callable[[], object]] | None = None) -> str:
    """A page whose blocks show what files hold and commands print now, in the working directory; of refusals the words.

    Args:
        page: in Markdown; a `text` block that ends with dots shows the beginning of its file.
        files: of its `text` blocks, in order.
        before: what is done before commands that begin so.
    """
    left = iter(files)

    def anew(block: re.Match[str]) -> str:
        kind, text = block.groups()
        if kind == "text":
            lines = Path(next(left)).read_text(encoding="utf-8").splitlines()
            if text.endswith("...\n"):
                lines = [*(line[:110] for line in lines[: text.count("\n") - 1]), "..."]
        else:
            words, end, count = SHOWN.match(text).groups()
            for beginning, work in (before or {}).items():
                if words.startswith(beginning):
                    work()
            code, out, err = quietly(*words.split())
            lines = [line.rstrip() for line in (out if code < 2 else err).splitlines()]
            lines = lines[: int(count)] if end == "head" else lines[-int(count) :] if end else lines
            lines = [text.partition("\n")[0], *lines]
        return "\n".join([f"```{kind}", *lines, "```", ""])

    return BLOCK.sub(anew, page)


def renew_page(doc: str | None, page: Path, renew: Callable[[str], str]) -> None:
    """The command line of a script whose page is its own source: the page is printed, or written."""
    cli = parser(doc)
    cli.add_argument("--write", action="store_true", help=f"into {page.relative_to(ROOT)} instead of printing it")
    write, text = cli.parse_args().write, page.read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as place, chdir(place):
        text = renew(text)
    if write:
        page.write_text(text, encoding="utf-8")
    else:
        print(text, end="")


def said(*words: object, cwd: Path = ROOT, limit_s: float = 1200.0) -> subprocess.CompletedProcess[str]:
    """A command of this tree in a process of its own, in a folder."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [*PROGRAM, *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=limit_s, cwd=cwd, env=environment)


def measured(
    command: Sequence[object],
    cwd: Path = ROOT,
    limit_s: float = 600.0,
    variables: Mapping[str, str] | None = None,
    check: bool = True,
) -> tuple[str, dict[str, Any]]:
    """What a process prints, its wall and CPU seconds and its peak resident memory, MiB.

    Unchecked it may fail: `code` and `late` say how it ended.

    Raises:
        subprocess.CalledProcessError: it failed.
        subprocess.TimeoutExpired: it ran longer than `limit_s` and was killed.
    """
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **(variables or {})}
    with tempfile.TemporaryDirectory() as place:
        report = Path(place) / "cost.json"
        line = [sys.executable, "-S", "-c", LAUNCHER, str(report), str(limit_s), *map(str, command)]
        done = subprocess.run(line, env=environment, cwd=cwd, capture_output=True, text=True, errors="replace")
        cost = json.loads(report.read_text())
    if not check:
        return done.stdout, cost
    if cost.pop("late"):
        raise subprocess.TimeoutExpired(line, limit_s)
    if code := cost.pop("code"):
        raise subprocess.CalledProcessError(code, line, done.stdout, done.stderr[-2000:])
    return done.stdout, cost


@cache
def import_cpu_s() -> float:
    """CPU seconds of `IMPORTS` in a process of its own, least of two."""
    return min(measured(IMPORTS)[1]["cpu_s"] for _ in range(2))
