"""Every defect that new users met: the same command again, what it printed then and what it prints now.

    python -m experiments.first_users.before_after > experiments/first_users/before_after.md

Chromium takes the phone's width; a few minutes, most of them fits and compilation.
"""

from __future__ import annotations

import csv
import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Sequence
from pathlib import Path

from experiments.common.command_line import print_only
from experiments.common.of_tests import module_of_tests
from experiments.common.page import table
from tvsbayes.files.disk import shipped_data

CHARS = 420
SECONDS = 600
HERE = Path(__file__).parent
SEEN = """
import re, sys
page = open(sys.argv[1], encoding="utf-8").read().split("<body>")[1].split("<nav")[0]
about, _, rest = page.partition("</dl>")
kind = r"<d[td]>(.*?)</d[td]>" if sys.argv[2:] else r'<h2>(.*?)</h2>|<th scope="row">(.*?)</th>|<dt>(.*?)</dt>'
print(", ".join("".join(found) for found in re.findall(kind, about if sys.argv[2:] else rest)))
"""
PHONE = """
import json, re, subprocess, sys, pathlib
page, width, *where = sys.argv[1:]
frame = pathlib.Path(page).with_name("frame.html")
script = '''<iframe id="f" src="%s" style="width:%spx;height:900px;border:0"></iframe><script>f.onload = function () {
const d = this.contentDocument, a = d.querySelector("%s .scroll");
document.title = JSON.stringify([d.documentElement.scrollWidth, a.scrollWidth - a.clientWidth]) }</script>'''
frame.write_text(script % (pathlib.Path(page).name, width, (where or [""])[0]))
flags = ["--headless", "--no-sandbox", "--disable-gpu", "--allow-file-access-from-files", "--virtual-time-budget=9000"]
shown = subprocess.run(["chromium", *flags, "--dump-dom", frame.resolve().as_uri()], capture_output=True, text=True)
wide, cut = json.loads(re.search("<title>(.*?)</title>", shown.stdout)[1])
print(f"page {wide} px wide in {width} px, table of the answer cut by {cut} px")
"""
CHAIN = """
import io, numpy as np
rng = np.random.default_rng(1)
kept = np.cumsum(rng.random((512, 64)) < 0.42, axis=0)
drawn = rng.standard_normal((int(kept.max()) + 1, 64, 61))
w = drawn[kept, np.arange(64)]
sizes = []
for save in (np.savez, np.savez_compressed):
    stream = io.BytesIO()
    save(stream, w=w)
    sizes.append(f"{stream.tell() / 1e6:.0f}")
print(f"512 steps of 64 walkers, 42 % of them accepted: {sizes[0]} MB plain, {sizes[1]} MB as it is kept")
"""
TWO_LOOKS = """step,action,pan_steps,tilt_steps,target,experiment,point
0,home,0,0,,,
1,place,,,d1,,
2,look,,,,,
3,move,100,0,,,
4,look,,,,,
"""


class Scratch:
    """A folder in which commands of a new user run."""

    def __init__(self, place: Path):
        self.place = place
        programs = place / "bin"
        programs.mkdir()
        for name, words in (("tvsbayes", "-m tvsbayes"), ("python", "")):
            (programs / name).write_text(f'#!/bin/sh\nexec "{sys.executable}" {words} "$@"\n')
            (programs / name).chmod(0o755)
        root = str(Path(__file__).resolve().parents[2])
        path = os.pathsep.join((root, os.environ.get("PYTHONPATH", "")))
        places = {"PATH": f"{programs}{os.pathsep}{os.environ['PATH']}", "PYTHONPATH": path}
        self.environment = {**os.environ, **places, "NO_COLOR": "1", "COLUMNS": "200"}
        (place / "data").symlink_to(shipped_data())
        (place / "pkg").symlink_to(Path(root) / "tvsbayes")
        for name, text in (("seen.py", SEEN), ("phone.py", PHONE), ("chain.py", CHAIN), ("two.csv", TWO_LOOKS)):
            (place / name).write_text(text)

    def printed(self, command: str) -> str:
        """What a command prints, and its exit code where that is not 0."""
        options = {"capture_output": True, "text": True, "errors": "replace", "timeout": SECONDS, "check": False}
        done = subprocess.run(["bash", "-c", command], cwd=self.place, env=self.environment, **options)
        text = " / ".join(line.strip() for line in (done.stdout + done.stderr).splitlines() if line.strip())
        text = text.replace(f"{self.place}/", "").replace(str(self.place), ".")
        text = text if len(text) <= CHARS else f"{text[: CHARS // 2]} ... {text[-CHARS // 2 :]}"
        return f"{text} (exit {done.returncode})" if done.returncode else text or "(nothing)"


def cell(text: str) -> str:
    """Text that a table of Markdown holds."""
    return text.replace("|", "\\|").replace("<", "&lt;").replace("\n", " ")


def code(text: str) -> str:
    """A command as code, whatever it holds."""
    fence = "``" if "`" in text else "`"
    return f"{fence}{text.replace('|', chr(92) + '|')}{fence}"


def of_trial(scratch: Scratch, defects: Sequence[dict]) -> str:
    """The table of one trial in `defects.toml`; `before` is what was printed or seen when the defect was found."""
    rows = (
        (d["number"], d["what"], code(d["command"]), cell(d["before"]), cell(scratch.printed(d["command"])))
        for d in defects
    )
    return table(("", "defect", "command", "before", "now"), rows)


def of_wrong_inputs(scratch: Scratch) -> str:
    """The mistakes of new users in one good campaign, made again."""
    spoilt = module_of_tests("support.wrong_inputs").SPOILT
    with open(HERE / "before_wrong_inputs.csv", encoding="utf-8") as stream:
        before = {row["mistake"]: row["before"] for row in csv.DictReader(stream)}
    rows = []
    for name, wrong in spoilt.items():
        shutil.rmtree(scratch.place / "mine", ignore_errors=True)
        shutil.copytree(shipped_data() / "twins" / "paper_twin", scratch.place / "mine")
        wrong.spoil(scratch.place / "mine")
        command = "tvsbayes " + wrong.command.replace("CAMPAIGN", "mine").replace("DATA", "data")
        now = scratch.printed(f"{command} 2>&1 | grep -a 'error\\|warning\\|what to do\\|written\\|next' | head -3")
        rows.append((name, code(command), cell(before.get(name, "as now")), cell(now)))
    return table(("mistake", "command", "before", "now"), rows)


def prepared(scratch: Scratch) -> None:
    """A fitted campaign with its report, and two looks as pictures."""
    shutil.copytree(shipped_data() / "twins" / "paper_twin", scratch.place / "trial")
    for command in (
        "tvsbayes fit trial --no-sample",
        "tvsbayes report trial --pdf",
        "tvsbayes simulate data/rigs/mounted/rig.toml two.csv seen --frames",
    ):
        scratch.printed(command)
    (scratch.place / "pairs").mkdir()
    for picture in sorted((scratch.place / "seen" / "frames").iterdir()):
        number, side = picture.stem.split("_")
        shutil.copy(picture, scratch.place / "pairs" / f"{side}{int(number):02d}{picture.suffix}")


def main() -> None:
    """Print the page."""
    print_only(__doc__)
    listed = tomllib.loads((HERE / "defects.toml").read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory(prefix="tvsbayes-users-") as place:
        scratch = Scratch(Path(place))
        prepared(scratch)
        print("# What new users met, before and now\n")
        print("`python -m experiments.first_users.before_after`. Commands run in a folder with a fitted `trial`.\n")
        print("## The last trial\n")
        print(of_trial(scratch, listed["last"]))
        print("\n## The first trial\n")
        print(of_trial(scratch, listed["first"]))
        print("\n## Mistakes in one good campaign\n")
        print(of_wrong_inputs(scratch))


if __name__ == "__main__":
    main()
