"""Commands of commands.md that run on shipped data print the output on the page."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from support.commands import caching_in
from support.printed_pages import Shown, follow, shown

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "data" / "docs" / "commands.md"
STEPS = shown(PAGE.read_text(encoding="utf-8"))
QUICK = ("new", "simulate", "check", "acquire", "export", "classic")
"""Without a fit: they run by default."""
FITTING = ("fit", "calibrate", "report", "view", "compare", "locate", "steps-for", "plan", "demo")
"""In the order in which they find what they need."""
OTHERS = {"import", "detect", "stereo", "doctor", "watch", "compensate", "verify", "study"}
"""Of pictures, tables and boards of the reader's own, or of many minutes."""


def folder_of(place: Path) -> Path:
    """The folder of the page: the rig file of the mounted rig with its grid, the twin of the paper as `mine`."""
    rig = ROOT / "data" / "rigs" / "mounted"
    for name in ("rig.toml", "stereo.json", "grid.csv"):
        shutil.copy(rig / name, place)
    shutil.copytree(ROOT / "data" / "twins" / "paper_twin", place / "mine")
    return place


def of(*names: str) -> list[Shown]:
    return [step for name in names for step in STEPS if step.arguments[0] == name and step.printed]


def test_every_command_of_the_page_is_run_or_named_here():
    assert {step.arguments[0] for step in STEPS} == {*QUICK, *FITTING, *OTHERS}


@pytest.mark.parametrize("name", QUICK)
def test_commands_without_a_fit_print_the_output_of_commands_md(name, tmp_path, monkeypatch, capsys):
    place = tmp_path if name == "new" else folder_of(tmp_path)
    follow(of(name), place, monkeypatch, capsys, errors_too=True)


@pytest.mark.slow
def test_commands_that_fit_print_the_output_of_commands_md(tmp_path, monkeypatch, capsys):
    with caching_in(tmp_path / "cache"):
        follow(of(*FITTING), folder_of(tmp_path), monkeypatch, capsys, errors_too=True)
