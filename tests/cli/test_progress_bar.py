"""The progress bar appears at a terminal and nowhere else."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from contextlib import suppress
from dataclasses import dataclass

import pytest
from support.commands import MOUNTED
from support.pseudo_terminal import needs_pseudo_terminals

from tvsbayes.progress import time_left

SCRIPT = """
import sys, threading
from tvsbayes import progress
from tvsbayes.cli import progress_bar
from tvsbayes.progress import Job
progress.SHOWN_AFTER_SECONDS = float(sys.argv[1])
with progress_bar.waiting() as show, Job({"looking": 1.0, "thinking": 3.0}, show) as job:
    for thread in threading.enumerate():
        if isinstance(thread, threading.Timer) and sys.argv[1] == "0":
            thread.join()
    if "silent" not in sys.argv:
        job.begin("thinking")
        job.at(0.5, "2 of 4")
    print("bar" if "rich" in sys.modules else "no bar")
print("result")
"""
RENDERING = """
import sys
from tvsbayes import progress
from tvsbayes.cli import main
from tvsbayes.twin import frames
progress.SHOWN_AFTER_SECONDS = 0.0
frames.BOARD_VIEWS = 1
sys.exit(main.run(sys.argv[1:]))
"""
AT_ONCE, NEVER = "0", "1000"


@dataclass(frozen=True)
class Seen:
    """Result of a process: exit code, standard output, and the text on its terminal."""

    code: int
    stdout: str
    terminal: str


def on_terminal(code: str, *arguments: str) -> Seen:
    """Run Python with standard error on a pseudo-terminal."""
    master, slave = os.openpty()
    command = [sys.executable, "-c", code, *arguments]
    environment = {**os.environ, "TERM": "xterm-256color", "COLUMNS": "120"}
    shown = b""
    with (
        open(master, "rb", buffering=0) as terminal,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=slave, env=environment) as process,
    ):
        os.close(slave)
        # Linux: the other end is closed.
        with suppress(OSError):
            while part := terminal.read(65536):
                shown += part
        stdout = process.stdout.read()
    return Seen(process.returncode, stdout.decode(), shown.decode())


@needs_pseudo_terminals
def test_a_terminal_shows_task_and_share_and_clears_the_line():
    result = on_terminal(SCRIPT, AT_ONCE)
    assert (result.code, result.stdout) == (0, "bar\nresult\n")
    assert "thinking: 2 of 4" in result.terminal and "100%" in result.terminal
    assert result.terminal.endswith("\x1b[2K"), "the line is erased at last"


def test_without_a_terminal_nothing_is_shown_and_rich_is_not_loaded():
    done = subprocess.run([sys.executable, "-c", SCRIPT, AT_ONCE], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "no bar\nresult\n", "")


@needs_pseudo_terminals
def test_the_document_of_a_command_is_separate_from_the_bar(tmp_path):
    plan = tmp_path / "plan.csv"
    plan.write_text(
        "step,action,pan_steps,tilt_steps,target,experiment,point\n0,home,0,0,,,\n1,place,,,d1,,\n2,look,,,,,\n"
    )
    rig = str(MOUNTED / "rig.toml")
    result = on_terminal(RENDERING, "simulate", rig, str(plan), str(tmp_path / "c"), "--frames", "--json")
    document = json.loads(result.stdout)
    assert result.code == 0 and document["pictures"] > 2
    pairs = document["pictures"] // 2
    assert f"rendering: {pairs} of {pairs} pairs" in result.terminal


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(None, ""), (0.2, "0 s left"), (99.4, "99 s left"), (150.0, "2 min left"), (3570.0, "60 min left")],
)
def test_time_left_in_words(seconds, text):
    assert time_left(seconds) == text
