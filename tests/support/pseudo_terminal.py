"""A simulated device at the end of a pseudo-terminal, where pyserial finds it under a name."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from tvsbayes.acquisition.simulated_instrument import SimulatedDevice

needs_pseudo_terminals = pytest.mark.skipif(not hasattr(os, "openpty"), reason="pseudo-terminals exist on POSIX only")


@contextmanager
def answered(answer: Callable[[bytes], bytes]) -> Iterator[str]:
    """The name of a port on which every request gets an answer."""
    master, slave = os.openpty()

    def serve():
        while True:
            try:
                data = os.read(master, 4096)
            except OSError:
                return
            os.write(master, answer(data))

    threading.Thread(target=serve, daemon=True).start()
    try:
        yield os.ttyname(slave)
    finally:
        os.close(slave)
        os.close(master)


@contextmanager
def served(device: SimulatedDevice, pause_us: int) -> Iterator[str]:
    """The name of a port that the device answers on.

    Every request finds it `pause_us` later: motions end without anybody waiting.
    """
    lines: list[bytes] = []
    device.listener = lines.append

    def answer(data: bytes) -> bytes:
        device.clock.now_us += pause_us
        device.model.advance(device.clock.now_us)
        device.model.receive(data, device.clock.now_us)
        sent = b"".join(lines)
        lines.clear()
        return sent

    with answered(answer) as port:
        yield port
