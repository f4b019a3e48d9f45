"""Seconds of calls in this process."""

from __future__ import annotations

import time
from collections.abc import Callable


def timed[Result](work: Callable[[], Result]) -> tuple[Result, dict[str, float]]:
    """What `work` returns, and its wall and CPU seconds as a row holds them."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = work()
    return result, {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}
