"""Which changes of the mathematics does no test see? mutmut's mutants of a module, run on the tests of that module.

    pip install "mutmut>=3.8,<4"       # in a copy of the project's environment: no test needs it
    python -m experiments.robustness.mutations run MODULE [--tests PATH ...]
    python -m experiments.robustness.mutations table > experiments/robustness/mutations.md

A module is a path such as tvsbayes/statistics/weighted_draws.py; its tests are tests/PACKAGE/test_MODULE.py where no
others are named. `run` unpacks HEAD into a temporary folder, writes mutmut's settings there, and appends a row.

mutmut runs pytest several times in one process, which jaxtyping's import hook refuses: the project's options of pytest
are left out, and shapes are not checked. It forks for every mutant: a module that JAX compiles is traced and
compiled again each time, and a fork that hangs counts as seen by mutmut's time limit. It reads the syntax of Python
3.13.
"""

from __future__ import annotations

import argparse
import datetime
import os
import re
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

from experiments.common.command_line import act, parser
from experiments.common.page import heading, line
from experiments.common.rows import ROOT, append_row, commit, read_rows, rows_of
from experiments.robustness.planted_faults import unpack

SETTINGS = """[mutmut]
source_paths=tvsbayes
only_mutate={module}
also_copy=
    data
    experiments
pytest_add_cli_args=
    -o
    addopts=
    -m
    not slow
    -p
    no:cacheprovider
pytest_add_cli_args_test_selection=
    {tests}
use_git_change_detection=false
"""
SEEN = ("killed", "timeout", "segfault", "suspicious")


def mutmut(root: Path, *words: str) -> str:
    """What mutmut prints in a tree.

    Raises:
        RuntimeError: it failed.
    """
    environment = {**os.environ, "PYTHONPATH": "", "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "mutmut", *words]
    ended = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True)
    if ended.returncode:
        printed = ended.stdout[-3000:] + ended.stderr
        raise RuntimeError(f"mutmut {' '.join(words)} ended with {ended.returncode}:\n{printed}")
    return ended.stdout


def mutated(root: Path, name: str) -> dict[str, str]:
    """A mutant: the function, the line before and after."""
    lines = mutmut(root, "show", name).splitlines()
    old, new = (
        " ".join(text[1:].strip() for text in lines if text.startswith(sign) and not text.startswith(3 * sign))
        for sign in "-+"
    )
    function = name.rpartition(".")[2].rpartition("__mutmut_")[0]
    return {"function": re.sub(r"^x_?", "", function.replace("ǁ", ".")).lstrip("."), "old": old, "new": new}


def run(arguments: argparse.Namespace) -> None:
    """Append a row of a module."""
    module, revision = arguments.module, commit()
    package, _, name = module.removeprefix("tvsbayes/").rpartition("/")
    tests = arguments.tests or [f"tests/{package}/test_{name}"]
    if missing := [path for path in (module, *tests) if not (ROOT / path).exists()]:
        raise SystemExit(f"no such file: {', '.join(missing)}")
    with tempfile.TemporaryDirectory(prefix="tvsbayes-mutations-") as scratch:
        root = Path(scratch) / "tree"
        unpack(revision, root)
        (root / "setup.cfg").write_text(SETTINGS.format(module=module, tests="\n    ".join(tests)))
        mutmut(root, "run", "--max-children", str(arguments.processes))
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        outcomes = dict(re.findall(r"^\s*(\S+): (.+)$", mutmut(root, "results", "--all", "true"), re.MULTILINE))
        survivors = [mutated(root, key) for key, outcome in outcomes.items() if outcome == "survived"]
    row = {"module": module, "tests": tests, "mutants": len(outcomes), "survivors": survivors, "commit": revision}
    row["seen"] = sum(outcome in SEEN for outcome in outcomes.values())
    row["untested"] = sum(outcome == "no tests" for outcome in outcomes.values())
    row |= {"cpu_s": round(used.ru_utime + used.ru_stime, 1), "date": str(datetime.date.today())}
    append_row(arguments.rows, row)
    print(f"{module}: {row['seen']} of {row['mutants']} seen, {len(survivors)} survive, {row['untested']} untested")


TEXT = f"""# Mutants that no test sees

Written by `python -m experiments.robustness.mutations table`: the latest run of each module. mutmut changes one
operator, number, argument or word at a time, and runs the tests that reach the function.

Survivors of these sorts are left: an order of equal numbers (`kind="stable"`), a bound met with probability zero
(`>` for `>=`), a type or a default that NumPy has anyway, a constant that cancels, a guard against rounding.

{heading("module | tests | mutants | seen | survive | reached by none | CPU s | of")}"""


def table(arguments: argparse.Namespace) -> None:
    """Counts of every module, then what survives."""
    rows = {row["module"].removeprefix("tvsbayes/"): row for row in read_rows(arguments.rows)}
    print(TEXT)
    for module, row in sorted(rows.items()):
        tests = ", ".join(f"`{test.removeprefix('tests/')}`" for test in row["tests"])
        counts = (row["mutants"], row["seen"], len(row["survivors"]), row["untested"], f"{row['cpu_s']:.0f}")
        print(line(f"`{module}`", tests, *counts, row["commit"]))
    for module, row in sorted(rows.items()):
        print(f"\n## {module}\n\n{heading('in | before | after')}")
        for one in row["survivors"]:
            print(line(one["function"], *(f"`{one[part]}`".replace("|", "\\|") for part in ("old", "new"))))


if __name__ == "__main__":
    cli = parser(__doc__, run=run, table=table)
    cli.add_argument("module", nargs="?", help="path from the root")
    cli.add_argument("--tests", nargs="+", help="paths from the root")
    cli.add_argument("--processes", type=int, default=2, help="mutants at a time (%(default)s)")
    cli.add_argument("--rows", type=Path, default=rows_of(__file__))
    act(cli)
