"""Which module may import which (DESIGN 9), and what an import may load or change."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "tvsbayes"
LEVELS: tuple[tuple[str, ...], ...] = (
    ("files",),
    ("rigs",),
    ("campaign",),
    ("calibration",),
    ("model", "classic", "simulation"),
    ("likelihood", "plots", "certificate"),
    ("joint",),
    ("posterior",),
    ("information",),
    ("coordinates",),
    ("comparison", "design"),
    ("planning",),
    ("studies",),
    ("report",),
    ("cli",),
)
"""From bottom to top: a module imports only modules of lower levels."""
DEVICE_LEVELS: tuple[tuple[str, ...], ...] = (
    ("protocol", "spots", "boards", "interchange"),
    ("model", "journal", "driver", "estimate"),
    ("virtual", "camera", "record"),
    ("twin",),
    ("observation",),
    ("vision",),
    ("acquisition",),
    ("session",),
    ("doctor",),
)
"""The same inside `device/`, beside the middle: it may import the flat modules below the model, never JAX."""
DEVICE_ABOVE_JOINT = {"stereo": {"boards"}}
"""The adjustment of cameras to pictures stands on the solvers of `joint`: with what it imports from `device/`."""
BELOW_DEVICE = {"files", "rigs", "campaign", "classic", "simulation"}
DEVICE_OPTIONAL = {"renderer"}
"""Modules of `device/` outside that order: they import no other of it."""
WITHOUT_JAX = (
    *("files", "rigs", "campaign", "calibration", "classic", "simulation"),
    *("plots", "certificate", "report"),
)
MODEL = {
    *("model", "likelihood", "joint"),
    "posterior",
    *("information", "classic", "calibration", "coordinates", "comparison"),
    *("design", "planning", "studies"),
}
JAX_FAMILY = {"jax", "jaxlib", "equinox", "optimistix", "lineax", "jaxtyping"}
MODULES_MAX = 20
"""DESIGN 9; `device/` counts apart."""


def imported(tree: ast.AST, package: str = "tvsbayes") -> set[str]:
    """Every module that code imports, at the top or inside functions; not what only type checkers read."""
    found: set[str] = set()

    def visit(node: ast.AST) -> None:
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            for child in node.orelse:
                visit(child)
            return
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(filter(None, [package if node.level else "", node.module or ""]))
            found.add(base)
            # `from tvsbayes import x` imports the module x.
            found.update(f"{base}.{alias.name}" for alias in node.names if base == package)
        for child in ast.iter_child_nodes(node):
            visit(child)

    visit(tree)
    return found


def module_paths() -> dict[str, Path]:
    return {path.stem: path for path in PACKAGE.glob("*.py") if path.stem not in ("__init__", "__main__")}


@pytest.fixture(scope="module")
def imports() -> dict[str, set[str]]:
    return {name: imported(ast.parse(path.read_text())) for name, path in module_paths().items()}


@pytest.fixture(scope="module")
def inner(imports) -> dict[str, set[str]]:
    """Modules of the package that each module imports."""
    return {
        name: {other.split(".")[1] for other in names if other.startswith("tvsbayes.")} & set(imports)
        for name, names in imports.items()
    }


def reachable(graph: dict[str, set[str]], start: str) -> set[str]:
    seen, todo = set(), [start]
    while todo:
        for name in graph[todo.pop()] - seen:
            seen.add(name)
            todo.append(name)
    return seen


def in_new_process(code: str) -> str:
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=PACKAGE.parent, check=False
    )
    assert result.returncode == 0, result.stderr
    return result.stdout.strip()


def test_parser_sees_lazy_imports_and_skips_those_for_type_checkers():
    code = (
        "if TYPE_CHECKING:\n import a\ndef f():\n from tvsbayes import b\n from tvsbayes.c import d\n from . import e"
    )
    assert imported(ast.parse(code)) == {"tvsbayes", "tvsbayes.b", "tvsbayes.c", "tvsbayes.e"}


def test_every_module_has_its_level():
    assert sorted(name for level in LEVELS for name in level) == sorted(module_paths())
    assert len(module_paths()) <= MODULES_MAX


def test_imports_point_downwards(inner):
    level = {name: number for number, names in enumerate(LEVELS) for name in names}
    upwards = [f"{a} -> {b}" for a, others in inner.items() for b in others if level[b] >= level[a]]
    assert not upwards


def test_no_cycles(inner):
    """Implied by the levels, and said on its own: a cycle is worse than a wrong level."""
    assert not [name for name in inner if name in reachable(inner, name)]


def test_device_imports_point_downwards_and_reach_no_model():
    paths = {path.stem: path for path in (PACKAGE / "device").glob("*.py") if path.stem != "__init__"}
    level = {name: number for number, names in enumerate(DEVICE_LEVELS) for name in names}
    assert set(paths) - DEVICE_OPTIONAL - set(DEVICE_ABOVE_JOINT) == set(level)
    for name, path in paths.items():
        found = imported(ast.parse(path.read_text()))
        inside = {other.split(".")[2] for other in found if other.startswith("tvsbayes.device.")}
        flat = {other.split(".")[1] for other in found if other.startswith("tvsbayes.")} - {"device"}
        if name in DEVICE_ABOVE_JOINT:
            assert inside == DEVICE_ABOVE_JOINT[name]
            assert flat <= BELOW_DEVICE | {"model", "joint"}
            continue
        assert not inside & set(DEVICE_ABOVE_JOINT), name
        assert not [other for other in inside & set(level) if level[other] >= level.get(name, 0)], name
        assert flat <= BELOW_DEVICE, name
        assert not {other.split(".")[0] for other in found} & JAX_FAMILY, name


@pytest.mark.parametrize("name", WITHOUT_JAX)
def test_readers_classic_and_twin_reach_no_jax(imports, inner, name):
    for module in {name, *reachable(inner, name)}:
        assert not {other.split(".")[0] for other in imports[module]} & JAX_FAMILY, module


def test_twin_shares_no_formula_with_the_estimators(inner):
    assert not reachable(inner, "simulation") & MODEL


def test_importing_the_estimator_changes_no_jax_setting():
    code = (
        "import jax; before = dict(jax.config.values); import tvsbayes, tvsbayes.joint, tvsbayes.information; "
        "print(jax.config.jax_enable_x64, before == dict(jax.config.values))"
    )
    assert in_new_process(code) == "False True"


def test_command_line_loads_nothing_heavy():
    """`tvsbayes --help` must answer at once: heavy modules are imported by the commands that need them."""
    heavy = ("jax", "arviz", "emcee", "cv2", "matplotlib", "scipy", "equinox", "optimistix")
    code = f"import sys, tvsbayes.cli; print([name for name in {heavy!r} if name in sys.modules])"
    assert in_new_process(code) == "[]"


def test_readers_load_no_jax():
    """Nor does what a report asks: `comparison` loads it where it fits and refits."""
    modules = ", ".join(f"tvsbayes.{name}" for name in (*WITHOUT_JAX, "comparison"))
    assert in_new_process(f"import sys, {modules}; print('jax' in sys.modules)") == "False"
