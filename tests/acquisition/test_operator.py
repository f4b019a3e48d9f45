"""The keys that stop a run, and the questions it asks."""

from __future__ import annotations

import signal

import pytest
from support.bench_runs import raise_error

from tvsbayes.acquisition.operator import LiveLine, StopKey, Terminal, TerminalOperator, check_hazard
from tvsbayes.errors import InputError

pytestmark = pytest.mark.usefixtures("ctrl_c_works")


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="POSIX only")
def test_nohup_is_respected(monkeypatch):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with StopKey():
            signal.raise_signal(signal.SIGHUP)
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("error", [RuntimeError("reentrant call inside a writer"), BrokenPipeError(32, "Broken pipe")])
def test_stop_key_counts_even_where_its_word_cannot_be_written(error):
    with StopKey(lambda text: raise_error(error)) as stop:
        signal.raise_signal(signal.SIGINT)
    assert stop.requested


def test_questions_go_to_stderr(monkeypatch, capsys):
    """With --json stdout holds one document."""
    monkeypatch.setattr("builtins.input", lambda: "yes")
    assert LiveLine().ask("Type yes [now]: ") == "yes"
    out, err = capsys.readouterr()
    assert out == "" and "Type yes [now]: " in err


def test_without_standard_input_there_is_no_question(monkeypatch, capsys):
    """Python has None for a stream that was closed, as by `tvsbayes acquire ... <&-`."""
    monkeypatch.setattr("sys.stdin", None)
    with pytest.raises(InputError, match="the laser hazard cannot be asked"):
        check_hazard(None, simulate=False)
    lines = []
    operator = TerminalOperator(StopKey(), Terminal(lines.append, ask=LiveLine().ask), laser_class="3B")
    assert operator.place("d1", 175.0, 0, "") is False and operator.stop.requested
    assert lines == ["standard input has ended, the question cannot be asked: go on in a terminal, with --resume"]


def test_stop_key_interrupts_a_question_at_once():
    lines = []

    def ask(question):
        signal.raise_signal(signal.SIGINT)
        return "never"

    with StopKey(lines.append) as stop:
        operator = TerminalOperator(stop, Terminal(lines.append, ask=ask))
        assert operator.accept("line one\nline two") is False and stop.requested
        assert lines == ["line one", "line two"]
        assert operator.place("d1", 175.0, 0, "") is False
    stop = StopKey()
    assert TerminalOperator(stop, Terminal(lines.append, ask=lambda q: " YES ")).accept("x") is True
    assert TerminalOperator(stop, Terminal(lines.append, ask=lambda q: "y")).accept("x") is False
    assert TerminalOperator(stop, Terminal(lines.append), laser_class="3B").accept("x") is True
