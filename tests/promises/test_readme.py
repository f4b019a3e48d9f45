"""The README's promises that a machine can check: example, printed answer, commands, modules, set-up."""

from __future__ import annotations

import doctest
import re
import tomllib
from pathlib import Path

import pytest
import typer

from tvsbayes.cli.main import app

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def section(title: str) -> str:
    """Text between a heading of the second level and the next."""
    return README.split(f"\n## {title}\n")[1].split("\n## ")[0]


def first_column(text: str) -> list[str]:
    return re.findall(r"^\| `([\w-]+)", text, flags=re.MULTILINE)


def test_python_example_does_what_it_says(monkeypatch):
    monkeypatch.chdir(ROOT)
    code = re.search(r"```pycon\n(.*?)```", README, flags=re.DOTALL).group(1)
    example = doctest.DocTestParser().get_doctest(code, {}, "README.md", "README.md", 0)
    report: list[str] = []
    results = doctest.DocTestRunner(verbose=False).run(example, out=report.append)
    assert results.attempted >= 5
    assert not results.failed, "".join(report)


def test_first_screen_has_two_set_up_commands_and_the_printed_answer():
    commands = re.findall(r"```sh\n(.*?)\n```", README.split("\n## ")[0], flags=re.DOTALL)
    assert [command.count("\n") for command in commands] == [0, 0]
    assert all(command.startswith("python3 -m venv .venv && .venv/bin/pip install ") for command in commands)
    assert commands[0].endswith("tvsbayes demo")
    assert "-c .ci/constraints.txt" in commands[1]
    assert "joint  holds truth     truth" in README.split("\n## ")[0]


def test_commands_are_those_that_exist():
    names = [command.name or command.callback.__name__ for command in app.registered_commands]
    assert first_column(section("Commands")) == names


def test_options_named_in_the_table_of_commands_exist():
    """And every command's help fits a terminal of 80 columns, with a summary that is not cut off in the list."""
    group = typer.main.get_command(app)
    rows = re.findall(r"^\| `([\w-]+)(.*)$", section("Commands"), flags=re.MULTILINE)
    named = 0
    for name, row in rows:
        options = {option for parameter in group.commands[name].params for option in parameter.opts}
        wanted = set(re.findall(r"(?<![\w`])--[a-z][\w-]*|(?<=`)--[a-z][\w-]*", row))
        # What stands behind a backquoted name of another command belongs to that one.
        assert wanted <= options, (name, wanted - options)
        named += len(wanted)
    assert named > 60
    for name, command in group.commands.items():
        assert not command.get_short_help_str(65).endswith("..."), name
        text = command.get_help(command.context_class(command, info_name=f"tvsbayes {name}", terminal_width=80))
        assert max(map(len, text.splitlines())) <= 80, name


def slugs(text: str) -> set[str]:
    """Anchors that the headings of a page make."""
    headings = re.findall(r"^#+ (.*)$", text, flags=re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", ["README.md", "data/tutorial/README.md"])
def test_links_to_headings_lead_to_one(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    links = re.findall(r"\]\(([^)#]*)#([\w-]+)\)", text)
    assert links
    for target, anchor in links:
        there = (ROOT / page).parent / target if target else ROOT / page
        assert anchor in slugs(there.read_text(encoding="utf-8")), (target, anchor)


PAGES = ["README.md", "experiments/README.md", "data/twins/README.md", "data/tutorial/README.md"]


@pytest.mark.parametrize("page", PAGES)
def test_local_links_and_named_scripts_exist(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#]+)\)", text):
        if target.startswith("https://"):
            continue
        # Tables of experiments are written by the command in their own row.
        made = any(f"> experiments/{target}" in line for line in text.splitlines())
        assert made or (ROOT / page).parent.joinpath(target).exists(), target
    for script in re.findall(r"experiments/[\w/]+\.py|tests/[\w/]+\.py", text):
        assert (ROOT / script).is_file(), script


def test_constraints_pin_every_direct_dependency():
    """A missing pin would test whatever the day brings."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = (ROOT / ".ci" / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = dict(line.split("==") for line in lines if not line.startswith("#"))
    wanted = project["dependencies"] + project["optional-dependencies"]["test"]
    names = [re.match(r"[\w-]+", requirement).group() for requirement in wanted]
    assert [name for name in names if name not in pins] == []
