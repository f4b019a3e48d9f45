"""Placements by a program: in the journal before they count, with the laser off, ended where they take too long."""

from __future__ import annotations

import os
import re
import select
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.bench_runs import Run, events, small_plan
from support.emulated_board import EmulatedBoard
from support.firmware_sessions import NO_EMULATOR

from tvsbayes.acquisition import place_command
from tvsbayes.acquisition.journal_check import verify
from tvsbayes.acquisition.operator import StopKey, Terminal, TerminalOperator
from tvsbayes.acquisition.place_command import OUTPUT_BYTES_MAX, PlaceCommand
from tvsbayes.errors import DeviceFault, InputError
from tvsbayes.instrument.campaign import read_campaign

pytestmark = pytest.mark.usefixtures("ctrl_c_works")
SAYS = "import sys; print('moved to', *sys.argv[1:])"
WAITS = "import threading; print('on my way', flush=True); threading.Event().wait()"


MOVES_ON = """
import signal, sys, threading
signal.signal(signal.SIGTERM, signal.SIG_IGN)
with open(sys.argv[1], "w") as alive:
    print("moving", file=alive, flush=True)
    threading.Event().wait()
"""
"""A mover below a wrapper, which holds a pipe open for as long as it runs and takes no SIGTERM."""
WRAPPER = f"""
import subprocess, sys, threading
subprocess.Popen([sys.executable, "-c", {MOVES_ON!r}, sys.argv[1]])
print("started the mover", flush=True)
open(sys.argv[1] + ".go").read() if sys.argv[2] == "leaves" else threading.Event().wait()
"""


class Mover:
    """The mover of a wrapper, watched by the pipe that it holds open."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, ending: str = "waits") -> None:
        monkeypatch.setattr(place_command, "GRACE_S", 0.2)
        self.path = folder / "alive"
        os.mkfifo(self.path)
        os.mkfifo(f"{self.path}.go")
        self.pipe, self.ending = os.open(self.path, os.O_RDONLY | os.O_NONBLOCK), ending
        self.command = PlaceCommand((sys.executable, "-c", WRAPPER, str(self.path), ending), 60.0)

    def moves(self) -> bool:
        """Whether it has begun; lets a wrapper that leaves it go."""
        begun = bool(select.select([self.pipe], [], [], 0)[0]) and os.read(self.pipe, 100) == b"moving\n"
        if begun and self.ending == "leaves":
            Path(f"{self.path}.go").write_text("go")
        return begun

    def gone(self) -> bool:
        """Whether nothing holds the pipe any more, at the latest in a minute."""
        return bool(select.select([self.pipe], [], [], 60)[0]) and os.read(self.pipe, 100) == b""


@pytest.fixture
def mover(tmp_path, monkeypatch) -> Iterator[Mover]:
    watched = Mover(tmp_path, monkeypatch)
    yield watched
    os.close(watched.pipe)


def program(code: str, limit_s: float = 60.0) -> PlaceCommand:
    return PlaceCommand((sys.executable, "-c", code), limit_s)


def test_every_placement_is_made_by_the_program_in_the_dark(mounted_rig, tmp_path, monkeypatch):
    ordinary, light = PlaceCommand.run, []
    run_ = Run(mounted_rig, tmp_path / "c", place_command=program(SAYS))

    def recorded(self, *arguments):
        light.append(run_.instrument.mechanics.laser_on)
        return ordinary(self, *arguments)

    monkeypatch.setattr(PlaceCommand, "run", recorded)
    outcome = run_.engine.run()
    assert (outcome.reason, outcome.ok) == ("done", 8) and run_.dark()
    done, placed = events(tmp_path / "c", "place_command"), events(tmp_path / "c", "placed")
    assert [one["target"] for one in done] == [one["target"] for one in placed] and light == [False] * len(done)
    for number, one in enumerate(done):
        x_mm = mounted_rig.sheets_mm[one["target"]]
        assert one["words"].strip() == f"moved to {one['target']} {x_mm:.3f} {number}"
        assert (one["exit_code"], one["placement"], one["x_mm"], one["limit_s"]) == (0, number, x_mm, 60.0)
    assert verify(tmp_path / "c").stopped == "done" and len(read_campaign(tmp_path / "c").spots) == 8


@pytest.mark.slow
@pytest.mark.skipif(bool(NO_EMULATOR), reason=NO_EMULATOR)
def test_the_stage_of_the_page_stands_at_every_target(mounted_rig, tmp_path, monkeypatch):
    """The program of instrument.md, on an emulated board of its own: 10 steps a mm from 225 mm."""
    page = Path(__file__).parents[2] / "data" / "docs" / "instrument.md"
    (code,) = re.findall(r"```python\n(# stage\.py.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    (tmp_path / "stage.py").write_text(code)
    at, stood = [0, 0], []

    def on_step(axis: int, sense: int) -> None:
        at[axis] += sense

    ordinary = PlaceCommand.run
    with EmulatedBoard(on_step) as board:

        def recorded(self, *arguments):
            done = ordinary(self, *arguments)
            board.drain()
            stood.append((arguments[1], at[0]))
            return done

        monkeypatch.setattr(PlaceCommand, "run", recorded)
        command = PlaceCommand((sys.executable, str(tmp_path / "stage.py"), board.port))
        assert Run(mounted_rig, tmp_path / "c", place_command=command).engine.run().reason == "done"
    assert len(stood) > 1 and stood == [(x_mm, round(10 * (x_mm - 225))) for x_mm, _ in stood]


def test_a_program_that_fails_ends_the_run_and_resume_goes_on(mounted_rig, tmp_path):
    fails = program("import sys; print('no air pressure'); sys.exit(3)")
    with pytest.raises(DeviceFault) as fault:
        Run(mounted_rig, tmp_path / "c", place_command=fails).engine.run()
    assert fault.value.code == "place-command" and "code 3" in str(fault.value)
    assert "no air pressure" in str(fault.value) and "--resume" in fault.value.remedy
    (event,) = events(tmp_path / "c", "place_command")
    assert event["exit_code"] == 3 and events(tmp_path / "c", "placed") == []
    again = Run(mounted_rig, tmp_path / "c", resume=True, start=1, place_command=program(SAYS))
    assert again.engine.run().reason == "done" and len(events(tmp_path / "c", "place_command")) >= 2


def test_a_program_that_takes_too_long_is_ended(mounted_rig, tmp_path):
    with pytest.raises(DeviceFault, match="was ended after"):
        Run(mounted_rig, tmp_path / "c", place_command=program(WAITS, 0.5)).engine.run()
    (event,) = events(tmp_path / "c", "place_command")
    assert event["exit_code"] is None and event["limit_s"] == 0.5


def test_stop_ends_the_program_too(mounted_rig, tmp_path, monkeypatch):
    run_ = Run(mounted_rig, tmp_path / "c", small_plan(), place_command=program(WAITS))
    monkeypatch.setattr(run_.stop, "requested", False)
    goes_on = run_.engine._goes_on

    def stopped() -> bool:
        run_.stop.requested = True
        return goes_on()

    monkeypatch.setattr(run_.engine, "_goes_on", stopped)
    assert run_.engine.run().reason == "interrupted"
    assert [one["exit_code"] for one in events(tmp_path / "c", "place_command")] == [None]


def test_the_program_below_a_wrapper_is_ended_with_it(mover):
    done = mover.command.run("d1", 175.0, 0, lambda: not mover.moves())
    assert done.exit_code is None and done.words == "started the mover\n" and mover.gone()


def test_ctrl_c_at_once_ends_the_program_below_a_wrapper(mover):
    def interrupted() -> bool:
        if mover.moves():
            signal.raise_signal(signal.SIGINT)
        return True

    with pytest.raises(KeyboardInterrupt):
        mover.command.run("d1", 175.0, 0, interrupted)
    assert mover.gone()


def test_what_a_program_leaves_running_is_ended_and_said(tmp_path, monkeypatch):
    mover = Mover(tmp_path, monkeypatch, "leaves")
    done = mover.command.run("d1", 175.0, 0, lambda: mover.moves() or True)
    assert (done.exit_code, done.left_running) == (0, True) and mover.gone()
    os.close(mover.pipe)


def test_a_flood_is_read_and_never_more_than_64_kb_of_it_held(monkeypatch):
    """A program that waits for its reader writes 4 MB, none of which meets a disk."""
    held, ordinary = [], place_command.os.read

    def watched(*arguments):
        held.append(len(output.kept))
        return ordinary(*arguments)

    output = place_command._Output()
    monkeypatch.setattr(place_command, "_Output", lambda: output)
    monkeypatch.setattr(place_command.os, "read", watched)
    done = program("import os\nfor _ in range(64): os.write(1, b'A' * 65535 + b'\\n')").run("d1", 1.0, 0, lambda: True)
    assert (done.exit_code, done.output_bytes) == (0, 64 * 65536) and max(held) == OUTPUT_BYTES_MAX == 65536


@pytest.mark.parametrize("line", ["", "'", "no-such-program-anywhere --fast"])
def test_no_program_is_refused_before_the_run(line):
    with pytest.raises(InputError) as refused:
        PlaceCommand.parsed(line, None)
    assert refused.value.column == "--place-command"


def test_the_sheet_needs_no_question():
    def ask(question: str) -> str:
        raise AssertionError(question)

    assert TerminalOperator(StopKey(), Terminal(ask=ask), "2", places=False).place("d1", 175.0, 0, "")
