"""All planted faults, and whether they still fit the source and the tests."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

from experiments.common.rows import ROOT
from experiments.robustness.faults import (
    axis,
    bench,
    certification,
    declaration,
    doubts,
    estimation,
    imports,
    instrument,
    light,
    planning,
    pointing,
    presentation,
    sampling,
)
from experiments.robustness.faults.fault import Fault

FAULTS: tuple[Fault, ...] = (
    *declaration.FAULTS,
    *estimation.FAULTS,
    *sampling.FAULTS,
    *pointing.FAULTS,
    *certification.FAULTS,
    *planning.FAULTS,
    *instrument.FAULTS,
    *bench.FAULTS,
    *axis.FAULTS,
    *presentation.FAULTS,
    *imports.FAULTS,
    *light.FAULTS,
    *doubts.FAULTS,
)


def misfit(fault: Fault, text: str, parse: bool) -> str:
    """What is wrong with a fault in the text of its file; empty if nothing is."""
    if text.count(fault.old) != 1:
        return f"its text stands {text.count(fault.old)} times in {fault.path}"
    if fault.new == fault.old:
        return "changes nothing"
    if parse and fault.path.endswith(".py"):
        try:
            compile(text.replace(fault.old, fault.new), fault.path, "exec")
        except SyntaxError as error:
            return f"not Python any more: {error}"
    return ""


def stale(root: Path = ROOT, *, parse: bool = True) -> list[str]:
    """What is wrong with the list: texts that do not stand exactly once, changes that are none, no such tests.

    Args:
        root: of the tree.
        parse: also see that every fault of a Python module leaves one, which takes seconds.
    """

    @cache
    def text_of(path: str) -> str:
        return (root / path).read_text(encoding="utf-8") if (root / path).is_file() else ""

    problems, names = [], set()
    for fault in FAULTS:
        wrong = [misfit(fault, text_of(fault.path), parse), "twice" if fault.name in names else ""]
        names.add(fault.name)
        for test in fault.selection:
            path, _, single = test.partition("::")
            there = re.search(rf"^def {re.escape(single)}\b", text_of(path), re.MULTILINE) if single else text_of(path)
            wrong.append("" if there else f"no {test}")
        problems += [f"{fault.name}: {what}" for what in wrong if what]
    return problems
