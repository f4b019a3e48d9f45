"""The firmware on QEMU's Cortex-M7: no compiler warning, the Python model's transcripts, faults of the processor."""

from __future__ import annotations

import time

import pytest
from support import emulated_board
from support.emulated_board import EmulatedBoard, build_sketch
from support.firmware_sessions import (
    FIRMWARE,
    NO_EMULATOR,
    Bench,
    build_replay,
    random_orders,
    replay_on_processor,
)

from tvsbayes.positioner.driver import SerialPositioner
from tvsbayes.positioner.interface import PositionLost
from tvsbayes.positioner.serial_port import serial_opener

on_board = pytest.mark.skipif(bool(NO_EMULATOR), reason=NO_EMULATOR)


@pytest.fixture(scope="module")
def on_processor(tmp_path_factory):
    program = tmp_path_factory.mktemp("processor") / "replay.elf"
    built = build_replay(program)
    assert (built.returncode, built.stderr) == (0, ""), "no warning"
    return program


@on_board
def test_sketch_and_core_compile_for_the_processor_without_a_warning(tmp_path):
    built = build_sketch(tmp_path / "sketch.elf")
    assert (built.returncode, built.stderr) == (0, "")


@on_board
@pytest.mark.parametrize("seed", range(3))
def test_processor_and_model_do_the_same_with_the_same_bytes(on_processor, seed):
    orders = random_orders(seed)
    assert replay_on_processor(on_processor, orders) == Bench().run(orders)


@on_board
@pytest.mark.slow
def test_ten_thousand_lines_are_equal(on_processor):
    lines = 0
    for seed in range(1000, 1100):
        orders = random_orders(seed)
        ours = Bench().run(orders)
        assert replay_on_processor(on_processor, orders) == ours
        lines += len(ours)
        if lines >= 10_000:
            break
    print(f"\n{seed - 999} sessions, {lines} lines equal")
    assert lines >= 10_000


@on_board
def test_a_mutant_is_seen(tmp_path):
    motion = FIRMWARE / "tvs_positioner" / "tvs_motion.cpp"
    text = motion.read_text()
    assert text.count("kHomeClear = 20,") == 1
    mutant = tmp_path / "tvs_motion.cpp"
    mutant.write_text(text.replace("kHomeClear = 20,", "kHomeClear = 21,"))
    sources = [FIRMWARE / "native" / "replay.cpp", FIRMWARE / "tvs_positioner" / "tvs_core.cpp", mutant]
    program = tmp_path / "mutant.elf"
    assert emulated_board.cross_compile(program, sources, "--specs=rdimon.specs").returncode == 0
    orders = random_orders(0)
    assert replay_on_processor(program, orders) != Bench().run(orders)


def dark_within(board: EmulatedBoard, seconds: float) -> bool:
    """Whether the laser pin, read from outside, goes low in that time."""
    deadline = time.monotonic() + seconds
    while board.laser_pin():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.005)
    return True


@on_board
@pytest.mark.slow
def test_sketch_homes_moves_and_goes_dark_after_every_fault():
    """Seconds of this computer, which may be busy: the promise is 2 s."""
    steps, lines = [0, 0], []

    def on_step(axis: int, sense: int) -> None:
        steps[axis] += sense

    with EmulatedBoard(on_step, lines.append) as board:
        opener = serial_opener(board.port, 115_200)
        positioner = SerialPositioner(opener)
        assert positioner.home().state.home_pressed == (True, True)
        state = positioner.move_to(200, -100)
        board.drain()
        assert steps == [200, -100] and not any(state.limit_open)
        positioner.laser(True)
        assert board.laser_pin()
        board.order("s 500")
        assert dark_within(board, 2.0)
        state = positioner.state()
        assert (state.laser_on, state.last_error) == (False, "stall")
        for fault in ("f", "g", "r"):
            positioner.laser(True)
            board.order(fault)
            assert dark_within(board, 2.0), fault
            with pytest.raises(PositionLost):
                for _ in range(8):
                    positioner.state()
            positioner.close()
            positioner = SerialPositioner(opener)
            positioner.home()
        positioner.close()
        board.drain()
    assert board.starts == 4 and steps == [-1200, -700]
