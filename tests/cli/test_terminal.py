"""Colours only on a terminal; help with examples, completion, one spelling of --out."""

from __future__ import annotations

import pytest

from tvsbayes.cli.examples import EXAMPLES
from tvsbayes.cli.main import COMMANDS, run
from tvsbayes.cli.terminal import styled


class Terminal:
    def __init__(self, tty: bool):
        self.isatty = lambda: tty


@pytest.mark.parametrize(("tty", "environment"), [(False, {}), (True, {"NO_COLOR": "1"}), (True, {"TERM": "dumb"})])
def test_files_pipes_and_no_color_get_plain_text(monkeypatch, tty, environment):
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm")
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert styled("error: no such file", Terminal(tty)) == "error: no such file"


def test_a_terminal_wraps_sentences_between_words_and_not_tables(monkeypatch):
    monkeypatch.setenv("NO_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "30")
    sentence, row = "one sentence of more words than fit", "a row of a table      1.25     2.50"
    assert styled(f"{sentence}\n{row}", Terminal(True)) == f"one sentence of more words\n  than fit\n{row}"
    assert styled(sentence, Terminal(False)) == sentence
    monkeypatch.setenv("COLUMNS", "40")
    message = 'fault    port: no such port as this; write port = "..." there'
    assert styled(message, Terminal(True)) == (
        'fault    port: no such port as this;\n         write port = "..." there'
    ), "a sentence behind cells goes on below itself"
    monkeypatch.setenv("COLUMNS", "60")
    values = f"{'azimuth_deg':15}{'azimuth_deg':15}{'deg':9}61.352086886..., 61.065125695..., -46.2548"
    folded = styled(values, Terminal(True)).split("\n")
    assert [line.strip() for line in folded[1:]] == ["61.065125695...,", "-46.2548"], "as does a list of values"
    assert {len(line) - len(line.lstrip()) for line in folded[1:]} == {39}


def test_a_terminal_gets_verdicts_in_colour_line_by_line(monkeypatch):
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm")
    plain, good, bad = "a table", "verdict: usable", "verdict: VALIDATION FAILED, multiply"
    lines = styled(f"{plain}\n{good}\n{bad}", Terminal(True)).split("\n")
    assert lines[0] == plain
    assert lines[1] == f"\x1b[32m\x1b[1m{good}\x1b[0m" and lines[2] == f"\x1b[31m\x1b[1m{bad}\x1b[0m"


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.__name__)
def test_every_command_has_its_help_with_examples_that_parse(capsys, command):
    name = command.__name__.rstrip("_").replace("_", "-")
    assert run([name, "-h"]) == 0
    shown = capsys.readouterr().out
    for example in EXAMPLES[name]:
        assert f"    {example}\n" in shown and example.startswith(f"tvsbayes {name}")
        for option in (word.split("=")[0] for word in example.split() if word.startswith("--")):
            assert f"{option} " in shown.split("Examples:")[0], option
