"""Imports between packages, and what an import may load or change."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from support.package_imports import (
    MODULES,
    ORDER,
    PACKAGE,
    imported,
    imports_of,
    inside,
    reachable,
    room,
    running,
    running_imports_of,
)
from support.tests_of import files_importing

from tvsbayes.instrument import mechanisms
from tvsbayes.model.compiled import sources_of

ROOT = Path(__file__).resolve().parents[2]
HARDWARE = ("positioner", "cameras", "acquisition")
HARDWARE_USERS = {
    "cameras": {"positioner"},
    "acquisition": {"positioner", "cameras"},
    "report": {"cameras"},
    "cli": set(HARDWARE),
}
"""The only packages that may import the hardware side."""
MODEL = {"model", "estimators", "posterior", "assessment", "coordinates", "comparison", "planning", "studies"}
BESIDE_THE_TWIN = {"calibration", "metrology", "results", "inference", *MODEL}
"""What the digital twin shares no formula with, nor with the mirrors of the instrument."""
JAX_FREE_PACKAGES = (
    *("errors", "progress", "display", "files", "gears", "importing", "instrument", "head", "calibration", "metrology"),
    *("results", "inference", "single_axis", "twin", "coordinates", "compensation", "positioner", "acquisition"),
    *("cameras", "report"),
)
JAX_FREE_MODULES = (
    *(
        "statistics.intervals",
        "statistics.optimal_design",
        "estimators.four_point",
        "estimators.spot_pattern",
        "estimators.plausibility",
    ),
    *("estimators.findings", "estimators.counter_pattern"),
    *("comparison.gap", "comparison.changes", "comparison.held_out"),
    *("comparison.departures", "comparison.axis_sessions"),
)
"""Free of JAX until a function that fits is called, in packages that are not."""
JAX_FAMILY = {"jax", "jaxlib", "equinox", "optimistix", "lineax", "jaxtyping"}
OF_ONE_INSTRUMENT = {
    "single_axis": "an axis",
    "head": "a head with sightings",
    "compensation": "tables of an axis",
    "comparison.axis_sessions": "an axis and its later readings",
    "cli": "finds the instrument of a folder, and runs its commands",
    "pipeline": "the same for Python: `read_campaign`, `verify`",
    "instrument.mechanisms": "the table of instruments with two axes",
    "instrument.chains": "its column of chains of the beam",
    "twin.physics": "the twin's own such column",
    "twin.simulated_axis": "the twin of an axis",
    "report.axis_document": "the report of an axis",
    "report.head_document": "the report of a head",
    "view.laser_ways": "draws the mirrors of a scanner",
}
"""Rooms and modules that may know which instrument they serve. Others ask what the instrument has:
images, names, rows of the table."""
IDENTITY = {"key", "word", "path", "sightings"}
"""Fields of a mechanism that tell which it is."""
LINES_MAX = 600
"""Of a module: a longer one has two subjects."""


@pytest.fixture(scope="module")
def inner() -> dict[str, set[str]]:
    """Modules of the package that each module imports, types included."""
    return inside({name: imports_of(name) for name in MODULES})


def in_new_process(code: str) -> str:
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False)
    assert result.returncode == 0, result.stderr
    return result.stdout.strip()


def test_parser_sees_every_way_to_import():
    code = (
        'if TYPE_CHECKING:\n import a\ndef f():\n from tvsbayes import b\n from tvsbayes.c import d\n "tvsbayes.g"\n'
        ' return "import sys, tvsbayes.h.i; tvsbayes.toml"'
    )
    modules = imported(ast.parse(code), frozenset({"b", "g", "h.i"}))
    assert modules == {"a", "tvsbayes.b", "tvsbayes.c", "tvsbayes.h.i"}
    assert imported(running(ast.parse(code)), frozenset({"b", "g", "h.i"})) == modules - {"a"}


def test_tests_of_a_module_are_those_that_import_it():
    files = files_importing("head.urdf", "tests/head")
    assert "tests/head/test_urdf.py" in files and "tests/head/test_pointing_table.py" not in files


def test_every_module_is_in_a_listed_package():
    assert {room(name) for name in MODULES} == set(ORDER)
    assert all(name.count(".") <= 1 for name in MODULES), "packages are of depth two"
    for path in PACKAGE.glob("*/__init__.py"):
        if path.parent.name != "positioner":
            assert path.read_text(encoding="utf-8") == "", f"{path.parent.name}: a package hands no names on"


def test_imports_point_downwards(inner):
    level = {name: number for number, name in enumerate(ORDER)}
    upwards = [
        f"{a} -> {b}"
        for a, others in inner.items()
        for b in others
        if room(a) != room(b) and level[room(b)] > level[room(a)]
    ]
    assert not upwards


def test_no_cycles(inner):
    """Also inside a package, where the order of packages does not forbid them."""
    assert not [name for name in inner if name in reachable(inner, name)]


def test_traces_belong_to_all_that_a_module_imports(inner):
    """For every compiled function: what determines a trace determines its name in the cache."""
    for name in ("estimators.likelihood", "estimators.annealed_stage", "model.headlines", "planning.looks"):
        modules = {
            path.relative_to(PACKAGE).with_suffix("").as_posix().replace("/", ".")
            for path in sources_of(f"tvsbayes.{name}", PACKAGE)
        }
        assert modules == {name} | reachable(inner, name) and len(modules) < len(MODULES) / 2


def test_only_drivers_import_hardware_packages(inner):
    for name, others in inner.items():
        hardware = {room(other) for other in others} & set(HARDWARE) - {room(name)}
        assert hardware <= HARDWARE_USERS.get(room(name), set()), name


def test_without_jax():
    """No module of the JAX-free side imports JAX, neither at the top nor in functions."""
    imports = {name: running_imports_of(name) for name in MODULES}
    graph = inside(imports)
    with_jax = {name for name, others in imports.items() if {other.split(".")[0] for other in others} & JAX_FAMILY}
    for name in MODULES:
        if room(name) in JAX_FREE_PACKAGES:
            assert not {name, *reachable(graph, name)} & with_jax, name


ROWS = {name for name, value in vars(mechanisms).items() if isinstance(value, mechanisms.Mechanism)}
"""Names of the mechanisms in code."""


def parsed(name: str) -> ast.AST:
    return ast.parse(MODULES[name].read_text(encoding="utf-8"))


@cache
def names_of_instruments() -> set[str]:
    """Names in code that stand for one instrument: mechanisms, kinds of looks, chains, classes of its rooms."""
    rooms = [parsed(name) for name in MODULES if room(name) in ("single_axis", "head") or name == "instrument.chains"]
    classes = {node.name for tree in rooms for node in ast.walk(tree) if isinstance(node, ast.ClassDef)}
    return ROWS | classes | {"Optics", "Spot", "Sighting", "mechanism_key"}


@cache
def words_of_instruments() -> set[object]:
    """Words for mechanisms, and names of parameters of the beam's path, which not all of them have."""
    kinds = mechanisms.MECHANISMS.values()
    names = [{parameter.name for parameter in kind.path} for kind in kinds]
    return {kind.word for kind in kinds} | {kind.key for kind in kinds} | set.union(*names) - set.intersection(*names)


def decisions(tree: ast.AST) -> Iterator[ast.AST]:
    """Conditions, comparisons and tests of a type."""
    for node in ast.walk(tree):
        if isinstance(node, ast.If | ast.IfExp | ast.While | ast.Assert):
            yield node.test
        elif isinstance(node, ast.comprehension):
            yield from node.ifs
        elif isinstance(node, ast.Match):
            yield from (node.subject, *(case.pattern for case in node.cases))
        elif isinstance(node, ast.Compare | ast.BoolOp) or isinstance(getattr(node, "op", None), ast.Not):
            yield node
        elif isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("isinstance", "issubclass"):
            yield node


def decides_on_instrument(tree: ast.AST) -> set[str]:
    """Decisions that name an instrument; a module may name the classes that it defines."""
    names = names_of_instruments() - {node.name for node in ast.walk(tree) if isinstance(node, ast.ClassDef)}
    found = set[str]()
    for decision in decisions(tree):
        for node in ast.walk(decision):
            name, of = (getattr(part, "id", getattr(part, "attr", "")) for part in (node, getattr(node, "value", None)))
            word = node.value if isinstance(node, ast.Constant) else None
            if name in names or word in words_of_instruments() or (name in IDENTITY and of in ("mechanism", "kind")):
                found.add(ast.unparse(decision))
    return found


def test_decisions_on_the_instrument_are_found():
    """Each way to ask which instrument it is, and what may be asked."""
    asks = ("x = 1 if rig.mechanism.sightings else 2", "if kind is HEAD: pass", "[x for x in y if isinstance(x, Spot)]")
    asks += ('x = "azimuth_zero_deg" in values', "x = not mechanism.path", "match look:\n case Spot(): pass")
    assert all(decides_on_instrument(ast.parse(code)) for code in asks)
    may = ("if rig.has_images: pass", "if not mechanism.all_round: pass", "x = CHAINS[mechanism.word]")
    may += ("class Spot: pass\nx = isinstance(y, Spot)", "x = name in mechanism.parameters")
    assert not any(decides_on_instrument(ast.parse(code)) for code in may)


def test_only_listed_modules_know_which_instrument_they_serve(inner):
    """The scanner's mechanism may be imported: it is that of files which state none."""
    listed, found = set(OF_ONE_INSTRUMENT), dict[str, set[str]]()
    for name in MODULES:
        tree = parsed(name)
        imports = {other for other in inner[name] if room(other) in ("head", "single_axis")}
        imports |= {node.name for node in ast.walk(tree) if isinstance(node, ast.alias)} & ROWS - {"TWO_MIRROR"}
        if reasons := imports | decides_on_instrument(tree):
            found[name] = reasons
    assert not {name: reasons for name, reasons in found.items() if not {name, room(name)} & listed}
    assert listed <= {*found, *map(room, found)}, "the list names what is no longer needed"


def test_twin_shares_no_formula_with_the_estimators(inner):
    for name in MODULES:
        if room(name) == "twin":
            reached = reachable(inner, name)
            assert not {room(other) for other in reached} & BESIDE_THE_TWIN, name
            borrowed = {"instrument.mirrors", "instrument.chains", "single_axis.axis_model", "single_axis.axis_rows"}
            borrowed |= {"gears.play", "gears.kalman", "gears.places", "gears.states"}
            assert not reached & borrowed, name


def test_modules_stay_readable():
    long = {name: count for name, path in MODULES.items() if (count := len(path.read_text().splitlines())) > LINES_MAX}
    assert not long


def test_no_test_module_imports_another():
    by_module = re.compile(r"^ *(?:from [\w.]*\btest_|import [\w.]*\btest_|from tests[\w.]* import .*\btest_)", re.M)
    for path in (ROOT / "tests").rglob("*.py"):
        assert not by_module.search(path.read_text(encoding="utf-8")), path


def test_importing_the_estimator_changes_no_jax_setting():
    code = (
        "import jax; before = dict(jax.config.values); "
        "import tvsbayes, tvsbayes.estimators.joint_fit, tvsbayes.assessment.summary; "
        "print(jax.config.jax_enable_x64, before == dict(jax.config.values))"
    )
    assert in_new_process(code) == "False True"


def test_readers_load_no_jax():
    """A report does not either: comparisons load it where they fit."""
    modules = [name for name in MODULES if room(name) in JAX_FREE_PACKAGES or name in JAX_FREE_MODULES]
    assert set(JAX_FREE_MODULES) <= set(modules)
    listed = ", ".join(f"tvsbayes.{name}" for name in modules)
    assert in_new_process(f"import sys, {listed}; print('jax' in sys.modules)") == "False"
