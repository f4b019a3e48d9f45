"""Requests of a run made at chosen moments, without a second thread."""

from __future__ import annotations

from tvsbayes.acquisition.live_control import Requests
from tvsbayes.acquisition.live_run import LiveRun


class Scripted(Requests):
    """Requests of which one is made each time that a pause waits for the next."""

    def __init__(self, *then: str):
        super().__init__()
        self.then, self.waits = list(then), 0

    def wait(self, longest_s: float) -> None:
        self.waits += 1
        if self.then:
            self.ask(self.then.pop(0))


def scripted_run(*then: str) -> LiveRun:
    """A run whose pauses hear these requests one after the other."""
    live = LiveRun()
    live.requests = Scripted(*then)
    return live
