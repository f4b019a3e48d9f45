"""The running estimate of an acquisition: fits in a process of their own, beside the instrument.

The campaign folder is readable at any time, so a fit takes it as it stands, one fit at a time. The acquisition neither
waits for it nor shares memory with it: a compiler at work must not delay a laser switch. The process stays for the next
fit, so libraries are imported and functions compiled once a run. The figures are the effective degrees per step of the
beam with their standard uncertainty from the Laplace approximation (formulation 3.2 and 4.2), of the looks that were
there when the fit began.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from tvsbayes.display import concise

FIRST_LOOKS = 12
"""Fewer looks than three experiments of four points say next to nothing."""
GROWTH = 1.2
"""The next fit begins when there are so many times more looks than at the last: their sum costs a few fits."""
FIT_MAX_S = 3600.0
"""Longest wait for a fit; one takes a minute or less."""
FIT_POLL_S = 0.1
"""While a fit is waited for: how often what is asked of the run is heeded."""


@dataclass(frozen=True)
class Estimate:
    """Effective degrees per step and their standard uncertainties by direction, from so many looks.

    `tier` is what made them: "laplace", or "importance" for the sampled posterior.
    """

    looks: int
    deg_per_step: dict[str, float]
    u_deg_per_step: dict[str, float]
    tier: str = "laplace"

    @property
    def text(self) -> str:
        """For the live line."""
        return ", ".join(f"{name} {concise(v, self.u_deg_per_step[name])}" for name, v in self.deg_per_step.items())

    def as_json(self) -> dict[str, object]:
        """As part of the document of `acquire`."""
        ratios = {d: {"value": self.deg_per_step[d], "sd": self.u_deg_per_step[d]} for d in self.deg_per_step}
        return {"tier": self.tier, "looks": self.looks, "effective_deg_per_step": ratios}


@dataclass(frozen=True)
class EstimateOptions:
    """Whether a run is fitted beside itself, and to what end.

    Attributes:
        fit: estimates from a campaign folder with so many looks, as a process of its own can import it.
        target_u_deg_per_step: ends the run once the effective ratio of every direction of its plan is known so well.
        enabled: whether to fit; None: on hardware, and for a target.
    """

    fit: Callable[[Path, int], Estimate]
    target_u_deg_per_step: float | None = None
    enabled: bool | None = None

    def holds(self, simulate: bool) -> bool:
        """Whether a run, simulated or not, is to be fitted."""
        return self.target_u_deg_per_step is not None or (not simulate if self.enabled is None else self.enabled)


@dataclass(frozen=True)
class Aim:
    """What the running estimate is for: directions of the plan, and the u wanted of each, None for no target."""

    directions: tuple[str, ...] = ()
    target_u_deg_per_step: float | None = None


class Worker:
    """Calls a function in a process of its own, one call at a time; the first call starts the process.

    Args:
        function: as `multiprocessing` sends it to a new process. What it raises, and what kills it, counts as None.

    Attributes:
        busy: whether a call has begun whose result was not taken.
    """

    def __init__(self, function: Callable[..., Any]):
        self._function, self.busy = function, False
        self._process: multiprocessing.context.SpawnProcess | None = None
        self._pipe: Connection | None = None

    def begin(self, *arguments: object) -> None:
        """Begin a call; where no process can be started there is none."""
        try:
            if self._process is None or self._pipe is None:
                context = multiprocessing.get_context("spawn")
                self._pipe, theirs = context.Pipe()
                with theirs:
                    self._process = context.Process(target=_work, args=(theirs, self._function), daemon=True)
                    self._process.start()
            self._pipe.send(arguments)
            self.busy = True
        except OSError:
            self.end()

    def done(self, wait_s: float = 0.0) -> bool:
        """Whether the call has ended, after so long at most."""
        return self._pipe is not None and self.busy and self._pipe.poll(wait_s)

    def take(self) -> Any:
        """What the call that is `done` returned; None where it failed."""
        self.busy = False
        try:
            return None if self._pipe is None else self._pipe.recv()
        except (EOFError, OSError):
            # Its process is gone: the next call starts another.
            self.end()
            return None

    def end(self) -> None:
        """Kill the process, whatever it does."""
        if self._process is not None and self._process.pid is not None:
            self._process.kill()
            self._process.join()
        if self._pipe is not None:
            self._pipe.close()
        self._process, self._pipe, self.busy = None, None, False


def _work(pipe: Connection, function: Callable[..., Any]) -> None:
    """In the process: answers calls until the other end is closed."""
    if hasattr(os, "setsid"):
        # The Ctrl-C that ends the run after its look is none of the fit's.
        os.setsid()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(nowhere, stream)
    while True:
        try:
            arguments = pipe.recv()
        except EOFError:
            return
        try:
            result = function(*arguments)
        except Exception:
            # A fit that does not work says nothing: the next one has more looks.
            result = None
        try:
            pipe.send(result)
        except BrokenPipeError:
            return


class RunningEstimate:
    """Fits the folder of a running acquisition again and again.

    Args:
        folder: the campaign folder.
        fit: what is called with `_arguments`; `_read` takes what it returns.
        target_u_deg_per_step: the uncertainty wanted of every direction; None wants nothing and is never met.
        directions: those that must meet it.
        wait: whether to wait for every fit: in a simulation time stands still meanwhile.

    Attributes:
        latest: the newest estimate.
        meanwhile: called again and again while a fit is waited for; False ends wait and fit.
    """

    def __init__(
        self,
        folder: Path,
        fit: Callable[..., Any],
        target_u_deg_per_step: float | None,
        directions: Iterable[str],
        *,
        wait: bool = False,
    ):
        self.folder, self.target, self.directions = Path(folder), target_u_deg_per_step, set(directions)
        self.latest: Estimate | None = None
        self.meanwhile: Callable[[], bool] = lambda: True
        self._wait, self._worker, self._looks = wait, Worker(fit), 0

    def __enter__(self) -> RunningEstimate:
        return self

    def __exit__(self, *_: object) -> None:
        self._worker.end()

    @property
    def aim(self) -> Aim:
        """What the fits are for."""
        return Aim(tuple(sorted(self.directions)), self.target)

    @property
    def met(self) -> bool:
        """Whether every direction of the plan is known as well as wanted."""
        if self.latest is None or self.target is None:
            return False
        u = self.latest.u_deg_per_step
        return bool(self.directions) and all(u.get(name, float("inf")) <= self.target for name in self.directions)

    def update(self, looks: int) -> bool:
        """Takes in a finished fit, begins the next one where it pays; whether the target is met."""
        if self._worker.done():
            self._take()
        if not self._worker.busy and looks >= max(FIRST_LOOKS, GROWTH * self._looks):
            self._begin(looks)
            if self._wait:
                self._wait_for_fit()
        return self.met

    def _arguments(self, looks: int) -> tuple[object, ...]:
        """Of the fit of so many looks."""
        return self.folder, looks

    def _begin(self, looks: int) -> None:
        """Starts a fit; where none can be started the run goes on without an estimate."""
        self._looks = looks
        self._worker.begin(*self._arguments(looks))

    def _wait_for_fit(self) -> None:
        """A fit that takes too long is killed, as is that of a run that is to end."""
        until = time.monotonic() + FIT_MAX_S
        while self._worker.busy and not self._worker.done(FIT_POLL_S):
            if time.monotonic() > until or not self.meanwhile():
                self._worker.end()
        if self._worker.busy:
            self._take()

    def _take(self) -> None:
        """A fit that did not work says nothing: the next one has more looks."""
        result = self._worker.take()
        if result is not None:
            self.latest = self._read(result)

    def _read(self, result: Any) -> Estimate:
        """What a fit that worked says."""
        estimate: Estimate = result
        return estimate
