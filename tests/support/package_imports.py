"""Who imports whom in the package: its modules by name, and what the code of each imports."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[2] / "tvsbayes"
ORDER = (
    *("errors", "progress", "display", "files", "statistics", "gears", "importing", "instrument"),
    *("head", "calibration", "results", "inference", "metrology", "single_axis", "twin", "model"),
    *("estimators", "posterior", "assessment", "coordinates", "compensation", "comparison", "planning", "studies"),
    *("positioner", "cameras", "acquisition"),
    *("pipeline", "report", "view", "cli"),
)
"""From bottom to top: packages and single modules; each imports only what stands before it."""
MODULE = re.compile(r"\btvsbayes(?:\.\w+)+")


def modules_of(folder: Path) -> dict[str, Path]:
    """Every module of the package by its name below it, the packages' empty faces left out."""
    return {
        ".".join(path.relative_to(folder).with_suffix("").parts): path
        for path in sorted(folder.rglob("*.py"))
        if path.name not in ("__init__.py", "__main__.py")
    }


MODULES = modules_of(PACKAGE)


def strings(tree: ast.AST) -> Iterator[str]:
    """String constants that are no docstrings: code handed to a new process, dotted names to be imported."""
    prose = {
        id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in prose:
            yield node.value


def running(tree: ast.AST) -> ast.AST:
    """The code without what only type checkers read."""

    class Runs(ast.NodeTransformer):
        def visit_If(self, node: ast.If) -> ast.AST | list[ast.stmt]:
            self.generic_visit(node)
            name = node.test.attr if isinstance(node.test, ast.Attribute) else getattr(node.test, "id", "")
            return node.orelse if name == "TYPE_CHECKING" else node

    return Runs().visit(tree)


def imported(tree: ast.AST, modules: frozenset[str] | None = None) -> set[str]:
    """Modules that code imports: at the top, inside functions, for type checkers, or named in a string of code."""
    known = frozenset(MODULES) if modules is None else modules
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, "relative imports hide what a module needs"
            base = node.module or ""
            inside = {f"{base}.{alias.name}" for alias in node.names}
            submodules = {name for name in inside if name.removeprefix("tvsbayes.") in known}
            names.update(submodules or {base})
    for text in strings(tree):
        names.update(name for name in MODULE.findall(text) if name.removeprefix("tvsbayes.") in known)
    return names


@cache
def imports_of(name: str) -> set[str]:
    """Of a module of the package, types included."""
    return imported(ast.parse(MODULES[name].read_text(encoding="utf-8")))


def running_imports_of(name: str) -> set[str]:
    """Of a module of the package when it runs."""
    text = MODULES[name].read_text(encoding="utf-8")
    return imported(running(ast.parse(text))) if "TYPE_CHECKING" in text else imports_of(name)


def inside(imports: dict[str, set[str]]) -> dict[str, set[str]]:
    """Modules of the package that each module imports."""
    return {
        name: {other.removeprefix("tvsbayes.") for other in names} & set(imports) for name, names in imports.items()
    }


def room(name: str) -> str:
    return name.split(".")[0]


def reachable(graph: dict[str, set[str]], start: str) -> set[str]:
    reached, todo = set(), [start]
    while todo:
        for name in graph[todo.pop()] - reached:
            reached.add(name)
            todo.append(name)
    return reached
