"""A simulated device at the end of a pseudo-terminal, where pyserial finds it under a name."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from tvsbayes.acquisition.simulated_instrument import SimulatedDevice

needs_pseudo_terminals = pytest.mark.skipif(not hasattr(os, "openpty"), reason="pseudo-terminals exist on POSIX only")


@contextmanager
def served(device: SimulatedDevice, pause_us: int) -> Iterator[str]:
    """The name of a port that the device answers on.

    Every request finds it `pause_us` later: motions end without anybody waiting.
    """
    master, slave = os.openpty()
    lines: list[bytes] = []
    device.listener = lines.append

    def serve():
        while True:
            try:
                data = os.read(master, 4096)
            except OSError:
                return
            device.clock.now_us += pause_us
            device.model.advance(device.clock.now_us)
            device.model.receive(data, device.clock.now_us)
            while lines:
                os.write(master, lines.pop(0))

    threading.Thread(target=serve, daemon=True).start()
    try:
        yield os.ttyname(slave)
    finally:
        os.close(slave)
        os.close(master)
