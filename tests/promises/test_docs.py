"""Documents: links, tables of commands and parameters, map of rooms, examples, the site."""

from __future__ import annotations

import doctest
import importlib.util
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer
from support.package_imports import MODULES, ORDER
from support.printed_pages import first_difference

import tvsbayes
from tvsbayes.cli.app import INTERRUPTED, TARGET_MISSED
from tvsbayes.cli.main import app, run
from tvsbayes.errors import TvsError
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.parameters import unit_of
from tvsbayes.model.compilation_cache import CacheState

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "data" / "docs"
GROUP = typer.main.get_command(app)
OUTPUT_OPTIONS = {"--json", "--help", "-h", "--seed"}
"""What every command has, or every one that draws: said once for all."""
PAGES = [
    *("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "experiments/README.md"),
    *("data/twins/README.md", "data/tutorial/README.md"),
    *sorted(path.relative_to(ROOT).as_posix() for path in DOCS.glob("*.md")),
]


def read(page: str) -> str:
    return (ROOT / page).read_text(encoding="utf-8")


def section(text: str, title: str, level: int = 2) -> str:
    """Text between a heading and the next of its level or above."""
    mark = "#" * level
    body = text.split(f"\n{mark} {title}\n")[1]
    return re.split(rf"^#{{1,{level}}} ", body, flags=re.MULTILINE)[0]


def first_column(text: str) -> list[str]:
    return re.findall(r"^\| `([\w-]+)", text, flags=re.MULTILINE)


COMMANDS = read("data/docs/commands.md")
DOCUMENTS = read("data/docs/json.md")
NAMES = [command.name or command.callback.__name__ for command in app.registered_commands]


def slugs(text: str) -> set[str]:
    """Anchors that the headings of a page make."""
    prose = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    headings = re.findall(r"^#+ (.*)$", prose, flags=re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


def links(page: str) -> Iterator[tuple[str, str]]:
    """Targets in the repository and their anchors; code is no link."""
    prose = re.sub(r"^```.*?^```", "", read(page), flags=re.DOTALL | re.MULTILINE)
    for target in re.findall(r"\]\(([^)\s]+)\)", prose):
        if not target.startswith("https://"):
            path, _, anchor = target.partition("#")
            yield path, anchor


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_to_a_file_and_a_heading(page):
    for target, anchor in links(page):
        there = ((ROOT / page).parent / target).resolve() if target else ROOT / page
        # Tables of experiments are written by the command in their own row.
        is_output = any(f"> experiments/{target}" in line for line in read(page).splitlines())
        assert is_output or there.exists(), target
        if anchor:
            assert anchor in slugs(there.read_text(encoding="utf-8")), (target, anchor)


def test_every_document_is_reached_from_the_readme():
    linked = {target for target, _ in links("README.md")}
    assert {page for page in PAGES if page.startswith("data/docs/")} <= linked
    assert {"CONTRIBUTING.md", "CHANGELOG.md", "data/tutorial/README.md", "data/twins/README.md"} <= linked
    assert sum(bool(anchor) for page in PAGES for _, anchor in links(page)) > 10


def test_commands_are_those_that_exist():
    assert first_column(section(COMMANDS, "Commands")) == NAMES
    assert re.findall(r"^### (.*)$", section(COMMANDS, "Command by command"), flags=re.MULTILINE) == NAMES
    assert re.findall(r"^### (.*)$", section(DOCUMENTS, "Of scanners"), flags=re.MULTILINE) == NAMES


def options_of(name: str) -> set[str]:
    parameters = [p for p in GROUP.commands[name].params if not getattr(p, "hidden", False)]
    return {option for parameter in parameters for option in (*parameter.opts, *parameter.secondary_opts)}


def test_options_named_in_the_table_of_commands_exist():
    """Every command's help fits a terminal of 80 columns, and its summary is complete in the list."""
    rows = re.findall(r"^\| `([\w-]+)(.*)$", section(COMMANDS, "Commands"), flags=re.MULTILINE)
    named = 0
    for name, row in rows:
        wanted = set(re.findall(r"(?<![\w`])--[a-z][\w-]*|(?<=`)--[a-z][\w-]*", row))
        # Options behind the backquoted name of another command belong to that one.
        assert wanted <= options_of(name), (name, wanted - options_of(name))
        named += len(wanted)
    assert named > 10
    for name, command in GROUP.commands.items():
        assert not command.get_short_help_str(65).endswith("..."), name
        text = command.get_help(command.context_class(command, info_name=f"tvsbayes {name}", terminal_width=80))
        assert max(map(len, text.splitlines())) <= 80, name


@pytest.mark.parametrize("name", NAMES)
def test_every_option_of_a_command_is_explained(name):
    part = section(section(f"\n{COMMANDS}", "Command by command"), name, 3)
    rows = re.findall(r"^\| (`-.*?`) \|", part, flags=re.MULTILINE)
    explained = set(re.findall(r"--?[a-z][\w-]*", " ".join(rows)))
    options = {option for option in options_of(name) if option.startswith("-")} - OUTPUT_OPTIONS
    assert explained - OUTPUT_OPTIONS == options


def test_exit_codes_are_those_of_the_errors():
    codes = [int(code) for code in re.findall(r"^\| (\d+) \|", section(COMMANDS, "Exit codes"), flags=re.MULTILINE)]

    def codes_of(error: type[TvsError]) -> set[int]:
        return {error.exit_code}.union(*map(codes_of, error.__subclasses__()))

    assert codes == [0, *sorted({TARGET_MISSED, *codes_of(TvsError), INTERRUPTED})]


QUICK = {
    "new": ["new", "OUT"],
    "simulate": ["simulate", "data/rigs/mounted/rig.toml", "data/rigs/mounted/grid.csv", "OUT"],
    "check": ["check", "data/twins/grid_twin"],
    "classic": ["classic", "data/twins/paper_twin"],
    "doctor": ["doctor", "data/rigs/nominal/rig.toml"],
}
"""Commands that answer within a second or two."""


@pytest.mark.parametrize("name", QUICK)
def test_keys_of_documents_are_explained(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    # Two processes try it, which takes seconds: model/test_compilation_cache.py.
    monkeypatch.setattr("tvsbayes.model.compilation_cache.cache_state", lambda: CacheState(True, "tried elsewhere"))
    run([*(str(tmp_path / "out") if word == "OUT" else word for word in QUICK[name]), "--json"])
    document = json.loads(capsys.readouterr().out)
    part = section(section(DOCUMENTS, "Of scanners"), name, 3)
    named = set(re.findall(r"`([\w ]+)`", part)) | {"kind", "error"}
    assert set(document) <= named


def test_keys_of_a_fit_are_explained():
    """Those of the schema: `fit --json` lacks some, which the section lists beside the table."""
    schema = json.loads(read("data/schemas/fit-1.schema.json"))
    part = section(section(DOCUMENTS, "Of scanners"), "fit", 3)
    assert set(schema["properties"]) <= set(re.findall(r"`(\w+)`", part))


def number(text: str) -> list[float]:
    return [float(digits) for digits in re.findall(r"-?\d+(?:\.\d+)?", text)]


def expanded(cell: str) -> list[str]:
    """`backlash_deg.pan`, `.tilt` -> both names; harmonics by their pattern."""
    if "(" in cell:
        stem = re.match(r"`(\w+)\.", cell)[1]
        return [name for name in TWO_MIRROR.priors if name.startswith(stem)]
    words = re.findall(r"`([\w.]+)`", cell)
    return [words[0], *(words[0].rpartition(".")[0] + word for word in words[1:])]


def test_table_of_parameters_is_the_registry():
    table = section(read("data/docs/conventions.md"), "Parameters").split("\n\n")[1]
    all_names = []
    for row in table.splitlines()[2:]:
        names, unit, prior, _ = (cell.strip() for cell in row.strip("|").split("|"))
        for name in expanded(names):
            stated = TWO_MIRROR.priors[name]
            assert unit_of(name) == unit, name
            values = [stated.u] if stated.distribution == "half-normal" else [stated.value, stated.u]
            assert number(prior) == values, name
            assert (stated.distribution == "normal") != prior.startswith(stated.distribution), name
            all_names.append(name)
    assert sorted(all_names) == sorted(TWO_MIRROR.priors)


def test_map_lists_the_rooms_in_the_order_of_imports():
    text = section(read("data/docs/architecture.md"), "Rooms")
    assert re.findall(r"^\| `(\w+)` \|", text, flags=re.MULTILINE) == list(ORDER)


def test_modules_named_elsewhere_in_the_map_exist():
    text = section(read("data/docs/architecture.md"), "Where is ...?")
    named = set(re.findall(r"`([a-z]+/[a-z_0-9]+)`", text))
    assert len(named) > 15
    assert {name.replace("/", ".") for name in named} <= set(MODULES)


def test_sections_that_comments_point_to_exist():
    """A comment says "formulation 3.2"; the page has a section of that number."""
    pages = "".join(read(f"data/docs/{page}.md") for page in ("formulation", "axis", "planning", "watching"))
    numbers = set(re.findall(r"^#+ (\d+(?:\.\d+)?)", pages, flags=re.MULTILINE))
    paths = [path for folder in ("tvsbayes", "tests", "experiments") for path in (ROOT / folder).rglob("*.py")]
    for path in paths:
        text = path.read_text(encoding="utf-8")
        for reference in re.findall(r"\bformulation (\d+(?:\.\d+)?(?:(?:, | and )\d+(?:\.\d+)?)*)", text):
            assert set(re.findall(r"\d+(?:\.\d+)?", reference)) <= numbers, (path, reference)


OUTSIDE = re.compile(r"\bDESIGN\b|\bresearch/|\bpaper\.txt|newcomer|\.\./shared|\b[Ii]ssue'?s? (?:#?\d|bound|asks)")
"""Words that point to a text which no reader of the repository has."""


def test_nothing_points_outside_the_repository():
    folders = ("tvsbayes", "tests", "experiments", "data")
    paths = [
        path for folder in folders for path in (ROOT / folder).rglob("*") if path.suffix in (".py", ".md", ".toml")
    ]
    paths = [path for path in paths if path != Path(__file__) and "output" not in path.parts]
    lines = [
        (path.relative_to(ROOT).as_posix(), line.strip())
        for path in [*paths, ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
        for line in path.read_text(encoding="utf-8").splitlines()
        if OUTSIDE.search(line)
    ]
    assert not lines


def examples(page: str, language: str) -> str:
    return "\n".join(re.findall(rf"^```{language}\n(.*?)^```", read(page), flags=re.DOTALL | re.MULTILINE))


@pytest.fixture(scope="module")
def followed() -> dict[str, object]:
    """Names defined by the page's examples, and the number of examples with other output than printed."""
    fit, fitted = tvsbayes.fit, []
    cwd = Path.cwd()
    os.chdir(ROOT)
    patch = pytest.MonkeyPatch()
    patch.setattr(tvsbayes, "fit", lambda *args, **options: fitted.append(fit(*args, **options)) or fitted[-1])
    # `calibrate` takes the page's first fit, which is of the same campaign.
    patch.setattr("tvsbayes.estimators.joint_fit.fit", lambda *_, **__: fitted[0])
    try:
        example = doctest.DocTestParser().get_doctest(examples("data/docs/python.md", "pycon"), {}, "python.md", "", 0)
        report: list[str] = []
        results = doctest.DocTestRunner(verbose=False).run(example, out=report.append, clear_globs=False)
    finally:
        os.chdir(cwd)
        patch.undo()
    return {"globals": example.globs, "results": results, "report": "".join(report)}


@pytest.mark.thorough
def test_python_examples_give_the_printed_output(followed):
    assert followed["results"].attempted >= 20
    assert not followed["results"].failed, followed["report"]


@pytest.mark.slow
def test_longer_python_examples_run(followed, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    code = examples("data/docs/python.md", "python")
    assert "sample" in code
    exec(compile(code, "python.md", "exec"), followed["globals"])
    assert capsys.readouterr().out
    assert {path.name for path in tmp_path.glob("*.svg")} == {"figure12.svg", "figure13.svg", "both.svg"}


@pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("mkdocs", "material", "mkdocstrings", "latex2mathml")),
    reason="the extra docs is not installed: pip install -c .ci/constraints.txt -e '.[docs]'",
)
def test_site_is_built_without_a_warning(tmp_path):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-f", "data/docs/site/mkdocs.yml", "-d", tmp_path]
    done = subprocess.run([*map(str, command)], cwd=ROOT, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    formulation = (tmp_path / "docs" / "formulation.html").read_text(encoding="utf-8")
    assert "<math" in formulation and "arithmatex" not in formulation
    assert "read_campaign" in (tmp_path / "reference" / "instrument.html").read_text(encoding="utf-8")
    # Nothing is fetched from elsewhere when a page is shown.
    for page in tmp_path.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        assert not re.findall(r'(?:src|<link[^>]*href)="https?://', text), page


@pytest.mark.slow
@pytest.mark.parametrize(
    ("page", "script"),
    [
        ("data/docs/you-have.md", "experiments.inputs.you_have"),
        ("data/docs/compensation.md", "experiments.compensation.ten_minutes"),
    ],
)
def test_a_page_printed_by_a_script_is_current(page, script):
    """The whole page, fits included; last digits may differ with the processor."""
    done = subprocess.run([sys.executable, "-m", script], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (difference := first_difference(done.stdout, read(page))) is None, difference
