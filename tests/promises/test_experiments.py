"""Experiments: grouped by question, no work at import, no imports between questions, no name that shadows a package."""

from __future__ import annotations

import ast
import importlib
import importlib.metadata
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
from support.package_imports import imported

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "experiments"
LINES_MAX, FUNCTION_LINES_MAX = 450, 60
WELL_KNOWN = {"coverage", "statistics", "dask", "design", "benchmark", "tables", "hypothesis", "attrs", "tests"}
"""Names of PyPI and of the standard library that a script would like to have, installed here or not."""
MODULES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts): path
    for path in sorted(FOLDER.rglob("*.py"))
    if path.name != "__init__.py" and "output" not in path.relative_to(FOLDER).parts
}
QUESTIONS = sorted({name.split(".")[1] for name in MODULES} - {"common"})
SCRIPTS = [name for name, path in MODULES.items() if 'if __name__ == "__main__":' in path.read_text(encoding="utf-8")]
DRAWS = [name for name, path in MODULES.items() if "page_figure(" in path.read_text(encoding="utf-8")]
DEFINES = (ast.Import, ast.ImportFrom, ast.FunctionDef, ast.ClassDef, ast.Assign, ast.AnnAssign, ast.Expr, ast.If)


@cache
def tree_of(name: str) -> ast.Module:
    """Syntax of a module."""
    return ast.parse(MODULES[name].read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", MODULES)
def test_a_question_imports_only_itself_and_what_is_common(name):
    question = name.split(".")[1]
    questions = {module.split(".")[1] for module in imported(tree_of(name)) if module.startswith("experiments.")}
    assert questions <= {question, "common"}
    assert not {module.split(".")[0] for module in imported(tree_of(name))} & {"tests", "conftest"}


@pytest.mark.parametrize("name", MODULES)
def test_importing_a_module_defines_and_does_nothing(name):
    """At the top: imports, definitions, constants, and the call of main where the module is run."""
    for node in tree_of(name).body:
        assert isinstance(node, DEFINES), ast.unparse(node)
        if isinstance(node, ast.Expr):
            assert isinstance(node.value, ast.Constant), ast.unparse(node)
        if isinstance(node, ast.If):
            assert ast.unparse(node.test) == "__name__ == '__main__'", ast.unparse(node)
    importlib.import_module(name)


def test_no_name_shadows_a_package_when_a_script_is_run_as_a_file():
    """Then its folder comes first on the path: all modules beside it are found before installed ones."""
    installed = set(importlib.metadata.packages_distributions()) | set(sys.stdlib_module_names) | WELL_KNOWN
    names = {part for name in MODULES for part in name.split(".")[1:]} - {"__main__"}
    assert names & installed == set()


def test_modules_and_functions_are_short():
    long = {name: n for name, path in MODULES.items() if (n := len(path.read_text("utf-8").splitlines())) > LINES_MAX}
    assert long == {}
    functions = {
        f"{name}.{node.name}": node.end_lineno - node.lineno + 1
        for name in MODULES
        for node in ast.walk(tree_of(name))
        if isinstance(node, ast.FunctionDef) and node.end_lineno - node.lineno + 1 > FUNCTION_LINES_MAX
    }
    assert functions == {}


def test_the_index_names_every_script_and_only_scripts():
    index = (FOLDER / "README.md").read_text(encoding="utf-8")
    named = set(re.findall(rf"`((?:{'|'.join(QUESTIONS)})\.\w+)", index))
    runnable = {name.removeprefix("experiments.").removesuffix(".__main__") for name in SCRIPTS}
    assert named == runnable


@pytest.mark.parametrize("page", sorted(FOLDER.rglob("*.md")), ids=lambda path: str(path.relative_to(FOLDER)))
def test_commands_on_pages_are_scripts(page):
    """As `python -m experiments.question.script`, with a page beside its script."""
    for name in re.findall(r"python -m (experiments(?:\.\w+)+)", page.read_text(encoding="utf-8")):
        assert name in MODULES or f"{name}.__main__" in MODULES, name


def test_figures_have_one_style():
    modules = {name for name in MODULES if "matplotlib.figure" in imported(tree_of(name))}
    assert modules == {"experiments.common.figures"}


def test_every_picture_is_on_a_page():
    pages = {MODULES[name].with_suffix(".md") for name in DRAWS if name != "experiments.common.figures"}
    pictures = {path for path in FOLDER.rglob("*.png") if "output" not in path.relative_to(FOLDER).parts}
    assert {path.with_suffix(".md") for path in pictures} <= pages


@pytest.mark.parametrize("name", [name for name in DRAWS if name != "experiments.common.figures"])
def test_a_page_begins_with_its_figure(name):
    """Title, figure, then the rest, as its script prints it."""
    page = MODULES[name].with_suffix(".md")
    title, figure = page.read_text(encoding="utf-8").split("\n\n")[:2]
    shown = re.fullmatch(r"!\[(.+)\]\((.+)\)", figure)
    assert title.startswith("# ") and shown, figure
    picture = page.parent / shown[2]
    assert picture.is_file()
    figures = importlib.import_module("experiments.common.figures")
    head = figures.title_and_figure(str(MODULES[name]), title.removeprefix("# "), picture, shown[1])
    assert page.read_text(encoding="utf-8").startswith(head)
    assert title.removeprefix("# ") in MODULES[name].read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.parametrize("name", SCRIPTS)
def test_a_script_starts(name):
    command = [sys.executable, "-m", name.removesuffix(".__main__"), "--help"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.startswith("usage: "), done.stderr
