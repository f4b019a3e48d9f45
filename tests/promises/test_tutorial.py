"""The tutorial shows the output of the commands."""

from __future__ import annotations

import doctest
import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from support.commands import caching_in
from support.printed_pages import follow, shown

from tvsbayes.cli.main import run

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "data" / "tutorial" / "README.md"
TEXT = PAGE.read_text(encoding="utf-8")
QUICK = ("simulate", "check", "classic", "new")
"""Commands without a fit: they run by default."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Working folder of the page's commands: a folder with `data/`, as the root of a clone."""
    clone = tmp_path_factory.mktemp("clone")
    (clone / "data").symlink_to(ROOT / "data")
    return clone


def test_commands_without_a_fit_print_the_output_of_the_tutorial(folder, monkeypatch, capsys):
    steps = [step for step in shown(TEXT) if step.arguments[0] in QUICK]
    assert {step.arguments[0] for step in steps} == set(QUICK)
    follow(steps, folder, monkeypatch, capsys)


def test_python_examples_print_the_output_of_the_tutorial(folder, monkeypatch):
    monkeypatch.chdir(folder)
    code = "\n".join(re.findall(r"```pycon\n(.*?)```", TEXT, flags=re.DOTALL))
    example = doctest.DocTestParser().get_doctest(code, {}, "tutorial", "README.md", 0)
    report: list[str] = []
    results = doctest.DocTestRunner(verbose=False).run(example, out=report.append)
    assert results.attempted >= 3
    assert not results.failed, "".join(report)


@pytest.mark.slow
def test_all_commands_print_the_output_of_the_tutorial(tmp_path, monkeypatch, capsys):
    (tmp_path / "data").symlink_to(ROOT / "data")
    steps = shown(TEXT)
    wanted = {"fit", "compare", "steps-for", "locate", "plan", "report"}
    assert wanted <= {step.arguments[0] for step in steps}
    with caching_in(tmp_path / "cache"):
        follow(steps, tmp_path, monkeypatch, capsys)
    assert (tmp_path / "trial" / "results" / "report.html").stat().st_size > 100_000


@pytest.mark.slow
def test_the_steps_without_an_instrument_end_with_the_numbers_of_the_page(tmp_path, monkeypatch, capsys):
    """Six commands of instrument.md, then the sentence below them: looks, minutes, ratio, interval, truth."""
    page = (ROOT / "data" / "docs" / "instrument.md").read_text(encoding="utf-8")
    block, sentence = re.search(r"```sh\n(tvsbayes plan .*?)```\s+(The plan holds .*?)\n\n", page, re.DOTALL).groups()
    (tmp_path / "data").symlink_to(ROOT / "data")
    monkeypatch.chdir(tmp_path)
    with caching_in(tmp_path / "cache"):
        for line in block.splitlines():
            assert run(shlex.split(line)[1:]) == 0, line
    printed = capsys.readouterr().out
    left = json.loads((tmp_path / "run/results/fit.json").read_text())["effective_deg_per_step"]["left"]
    truth = json.loads((tmp_path / "run/truth.json").read_text())["effective_deg_per_step"]["left"]
    looks, minutes, *values = map(float, re.findall(r"\d+\.?\d*", sentence))
    shown = (float(re.search(rf"^{name} +([\d.]+)$", printed, re.M)[1]) for name in ("looks", "minutes"))
    assert [looks, minutes] == [round(value, 1) for value in shown]
    # To the digits that the page shows.
    np.testing.assert_allclose([left["value"], *left["interval95"], truth], values, rtol=0, atol=5.1e-5)
