"""One fault planted in a copy of the tree, and the tests run on it until one fails.

Every process has a copy of its own and forks a child for every run of pytest: what all tests import is loaded once.
"""

from __future__ import annotations

import importlib
import io
import json
import os
import re
import signal
import subprocess
import sys
import tarfile
import time
import traceback
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from experiments.common.rows import ROOT
from experiments.robustness.faults.fault import Fault

LIMIT_S = 900
"""A run of tests that takes longer counts as failed: a loop that never ends is a fault that CI sees."""
WHOLE_LIMIT_S = 3600
"""The same of all tests, one after the other."""
ENVIRONMENT = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    # An edited file may keep its size and, within a second, its time: no compiled module may outlive it.
    "PYTHONDONTWRITEBYTECODE": "1",
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.2",
}
SHARED = (
    *("pytest", "numpy", "scipy.stats", "scipy.optimize", "scipy.special", "cv2", "xarray", "emcee", "beartype"),
    *("jax", "jax.numpy", "jax.scipy.special", "jaxtyping", "equinox", "lineax", "optimistix", "arviz_stats.base"),
)
"""What most test files import."""
COMMAND = ("-q", "-x", "-n", "0", "--tb=no", "-p", "no:cacheprovider")
FITS = "tests/promises/test_planted_faults.py::test_every_fault_still_fits_its_file"
"""Fails for whatever is planted: it sees the entry, not the fault."""
WHOLE = ("tests", "--deselect", FITS)


@dataclass(frozen=True)
class Outcome:
    """Of a run of tests.

    Attributes:
        failed: whether one did; None where there is no such test.
        first: the first that did.
    """

    failed: bool | None
    first: str = ""


class FirstFailure:
    """A plugin of pytest that keeps the first test that failed."""

    def __init__(self) -> None:
        self.first = ""

    def pytest_runtest_logreport(self, report) -> None:
        """A test."""
        self.keep(report)

    def pytest_collectreport(self, report) -> None:
        """A file that could not be read."""
        self.keep(report)

    def keep(self, report) -> None:
        """The first counts."""
        if report.failed and not self.first:
            self.first = report.nodeid


@contextmanager
def planted(root: Path, fault: Fault) -> Iterator[None]:
    """A copy of the tree with one fault in it, whole again afterwards.

    Raises:
        ValueError: the entry does not fit the file.
    """
    path = root / fault.path
    text = path.read_text(encoding="utf-8")
    if text.count(fault.old) != 1:
        raise ValueError(f"{fault.name}: its text stands {text.count(fault.old)} times in {fault.path}")
    path.write_text(text.replace(fault.old, fault.new), encoding="utf-8")
    try:
        yield
    finally:
        path.write_text(text, encoding="utf-8")


def prepare(compiled: Path) -> None:
    """Load what every test file imports, for the children to share: most of a cheap test's time. Never the package.

    Args:
        compiled: folder of what JAX compiles; what no fault touches is compiled once.
    """
    os.environ |= {**ENVIRONMENT, "JAX_COMPILATION_CACHE_DIR": str(compiled)}
    sys.dont_write_bytecode = True
    for name in SHARED:
        importlib.import_module(name)
    assert "tvsbayes" not in sys.modules


def unpack(commit: str, root: Path) -> None:
    """A copy of the tree as committed."""
    archive = subprocess.run(["git", "archive", commit], cwd=ROOT, check=True, capture_output=True).stdout
    with tarfile.open(fileobj=io.BytesIO(archive)) as tree:
        tree.extractall(root, filter="data")


def _child(root: Path, selection: Sequence[str], said: Path) -> None:
    """Run pytest in this process, which ends with it."""
    with said.with_suffix(".txt").open("wb") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    os.setsid()
    os.chdir(root)
    os.environ["PYTHONPATH"] = str(root)
    sys.path.insert(0, str(root))
    for name in [name for name in sys.modules if name.partition(".")[0] == "experiments"]:
        # Those of the checkout: tests import the copy's.
        del sys.modules[name]
    code = 3
    try:
        import pytest

        seen = FirstFailure()
        # Pytest's plugins are among what is shared, their own assertions are not looked at here.
        ignored = ["-W", "ignore::pytest.PytestAssertRewriteWarning"]
        code = int(pytest.main([*COMMAND, *ignored, *selection], plugins=[seen]))
        said.write_text(json.dumps(seen.first))
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        sys.stdout.flush()
        os._exit(code)


def tested(root: Path, selection: Sequence[str]) -> Outcome:
    """Run tests on a copy in a child of this process.

    Raises:
        RuntimeError: pytest itself failed.
    """
    begun, said = time.monotonic(), root.parent / f"{root.name}.json"
    with warnings.catch_warnings():
        # JAX warns of forks; nothing has been computed in this process, and no thread of its runs.
        warnings.simplefilter("ignore")
        child = os.fork()
    if child == 0:
        _child(root, selection, said)
    done, status, limit_s = 0, 0, WHOLE_LIMIT_S if tuple(selection) == WHOLE else LIMIT_S
    while done == 0:
        time.sleep(0.05)
        done, status = os.waitpid(child, os.WNOHANG)
        if done == 0 and time.monotonic() - begun > limit_s:
            os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return Outcome(True)
    code = os.waitstatus_to_exitcode(status)
    # 4: no such test, 5: none was collected.
    if code in (4, 5):
        return Outcome(None)
    if code in (0, 1):
        return Outcome(code == 1, json.loads(said.read_text()))
    raise RuntimeError(f"pytest ended with {code}:\n{said.with_suffix('.txt').read_text(errors='replace')[-2000:]}")


def homes_of_tests(root: Path) -> dict[str, list[str]]:
    """Files of every test function by its name."""
    found: dict[str, list[str]] = {}
    for path in sorted((root / "tests").rglob("test_*.py")):
        for name in re.findall(r"^def (test_\w+)", path.read_text(encoding="utf-8"), re.MULTILINE):
            found.setdefault(name, []).append(str(path.relative_to(root)))
    return found


def stages(root: Path, fault: Fault, seen_by: str) -> Iterator[tuple[str, ...]]:
    """What is run until something fails: the test that saw the fault last, its likely tests, its package's, all.

    Args:
        root: of the copy.
        fault: which.
        seen_by: a test, in whatever file it stood then.
    """
    name = seen_by.partition("::")[2].partition("[")[0]
    if homes := homes_of_tests(root).get(name):
        yield tuple(f"{home}::{name}" for home in homes)
    yield fault.selection
    if (root / "tests" / fault.package).is_dir():
        yield (f"tests/{fault.package}",)
    yield WHOLE


def attempt(root: Path, fault: Fault, seen_by: str = "") -> Outcome:
    """Plant a fault, and run tests until one fails; that one has to pass without it.

    Raises:
        RuntimeError: it does not, or pytest itself failed.
    """
    outcome = Outcome(None)
    with planted(root, fault):
        for selection in stages(root, fault, seen_by):
            outcome = tested(root, selection)
            if outcome.failed:
                break
    if outcome.first and tested(root, (outcome.first,)).failed is not False:
        raise RuntimeError(f"{outcome.first} does not pass without any fault")
    return outcome
