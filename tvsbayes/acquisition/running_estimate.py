"""The running estimate of an acquisition: fits in another process during the run.

The campaign folder is readable at any time, so a fit reads its present state, one fit at a time. The acquisition
neither waits for the fit nor shares memory with it: a compiler at work must not delay a laser switch. The process stays
for the next fit, so that libraries are imported and functions compiled once per run. The results are the effective
degrees per step of the beam with their standard uncertainty from the Laplace approximation (formulation 3.2 and 4.2),
from the looks at the beginning of the fit.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from tvsbayes.acquisition.recorder import Confirmed
from tvsbayes.display import concise
from tvsbayes.instrument.plan import PlanStep
from tvsbayes.results.estimates import Uncertain

FIRST_LOOKS = 12
"""Three experiments of four points: fewer looks determine almost nothing."""
GROWTH = 1.2
"""Ratio of looks between two fits: all fits together cost as much as a few of the last."""
FIT_MAX_S = 3600.0
"""Longest wait for a fit; a fit takes a minute or less."""
FIT_POLL_S = 0.1
"""Interval at which a run that waits for a fit is asked whether it goes on."""


@dataclass(frozen=True)
class Estimate:
    """Effective degrees per step and their standard uncertainties by direction, from `looks` looks.

    `tier` is the method: "laplace", or "importance" for the sampled posterior.
    """

    looks: int
    deg_per_step: dict[str, float]
    u_deg_per_step: dict[str, float]
    tier: str = "laplace"

    @classmethod
    def of(cls, looks: int, ratios: Mapping[str, Uncertain], tier: str = "laplace") -> Estimate:
        """The estimate with these ratios by direction."""
        return cls(looks, {d: r.value for d, r in ratios.items()}, {d: r.sd for d, r in ratios.items()}, tier)

    @property
    def text(self) -> str:
        """Text for the live line."""
        return ", ".join(f"{name} {concise(v, self.u_deg_per_step[name])}" for name, v in self.deg_per_step.items())

    def as_json(self) -> dict[str, object]:
        """Entries in the document of `acquire`."""
        ratios = {d: {"value": self.deg_per_step[d], "sd": self.u_deg_per_step[d]} for d in self.deg_per_step}
        return {"tier": self.tier, "looks": self.looks, "effective_deg_per_step": ratios}


@dataclass(frozen=True)
class Proposal:
    """The next looks.

    Attributes:
        steps: placements, moves and looks, numbered from 0; the first is a placement.
        after_each: the target's value after each look, deg/step.
        now: its value before them.
        looks: number of looks behind the estimate.
        why: reason, in words.
    """

    steps: tuple[PlanStep, ...]
    after_each: tuple[float, ...]
    now: float
    looks: int
    why: str


@dataclass(frozen=True)
class EstimateOptions:
    """Options of the running estimate, with its target.

    Attributes:
        fit: estimates from a campaign folder and its number of looks; another process must be able to import it.
        target_u_deg_per_step: ends the run once the effective ratios of all directions of its plan reach this u.
        enabled: whether to fit; None: only on hardware, or with a target.
    """

    fit: Callable[[Path, int], Estimate]
    target_u_deg_per_step: float | None = None
    enabled: bool | None = None


class Worker:
    """Calls a function in another process, one call at a time; the first call starts the process.

    Args:
        function: importable by a new process. A call that raises or crashes returns None.

    Attributes:
        busy: whether a call has begun whose result is still to be taken.
    """

    def __init__(self, function: Callable[..., Any]):
        self._function, self.busy = function, False
        self._process: multiprocessing.context.SpawnProcess | None = None
        self._pipe: Connection | None = None

    def begin(self, *arguments: object) -> None:
        """Begin a call, unless no process can be started."""
        try:
            if self._process is None or self._pipe is None:
                context = multiprocessing.get_context("spawn")
                self._pipe, worker_end = context.Pipe()
                with worker_end:
                    self._process = context.Process(target=_work, args=(worker_end, self._function), daemon=True)
                    self._process.start()
            self._pipe.send(arguments)
            self.busy = True
        except OSError:
            self.end()

    def done(self, wait_s: float = 0.0) -> bool:
        """Whether the call has ended, within `wait_s`."""
        return self._pipe is not None and self.busy and self._pipe.poll(wait_s)

    def take(self) -> Any:
        """The result of the call that is `done`; None where it failed."""
        self.busy = False
        try:
            return None if self._pipe is None else self._pipe.recv()
        except (EOFError, OSError):
            # The process has ended: the next call starts another.
            self.end()
            return None

    def end(self) -> None:
        """Kill the process in any state."""
        if self._process is not None and self._process.pid is not None:
            self._process.kill()
            self._process.join()
        if self._pipe is not None:
            self._pipe.close()
        self._process, self._pipe, self.busy = None, None, False


def _work(pipe: Connection, function: Callable[..., Any]) -> None:
    """Runs in the process: answers calls until the other end is closed."""
    if hasattr(os, "setsid"):
        # The Ctrl-C that ends the run after its look must not end the fit.
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
            # A failed fit has no result; the next fit has more looks.
            result = None
        try:
            pipe.send(result)
        except BrokenPipeError:
            return


class RunningEstimate:
    """Fits the folder of a running acquisition repeatedly.

    Args:
        folder: the campaign folder.
        fit: called with `_arguments`; `_read` takes its result.
        target_u_deg_per_step: target u of every direction; None is never met.
        directions: directions that must meet it.
        wait: whether to wait for every fit, as in a simulation, whose time stands still during the fit.

    Attributes:
        latest: the newest estimate.
        minutes: duration allowed for the run, None for that of its plan.
        meanwhile: called repeatedly while waiting for a fit; False ends both.
    """

    minutes: float | None = None

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
        self._proposal: Proposal | None = None
        self._confirmed: Confirmed | None = None

    def __enter__(self) -> RunningEstimate:
        return self

    def __exit__(self, *_: object) -> None:
        self._worker.end()

    @property
    def aim(self) -> dict[str, object]:
        """Directions that must meet the target, and the target u of each, None for no target."""
        return {"directions": sorted(self.directions), "target_u_deg_per_step": self.target}

    @property
    def met(self) -> bool:
        """Whether every direction of the plan meets the target."""
        if self.latest is None or self.target is None:
            return False
        u = self.latest.u_deg_per_step
        return bool(self.directions) and all(u.get(name, float("inf")) <= self.target for name in self.directions)

    def update(self, looks: int) -> bool:
        """Take a finished fit, begin the next where it is due; return whether the target is met."""
        if self._worker.done():
            self._take()
        if not self._worker.busy and looks >= max(FIRST_LOOKS, GROWTH * self._looks):
            self._begin(looks)
            if self._wait:
                self._wait_for_fit()
        return self.met

    def last(self, looks: int) -> bool:
        """Return whether the target is met at the end of the plan."""
        return self.met

    def proposal(self) -> Proposal | None:
        """The newest proposal of looks, once."""
        newest, self._proposal = self._proposal, None
        return newest

    def confirmed(self) -> Confirmed | None:
        """The newest event of a sampled posterior, once."""
        newest, self._confirmed = self._confirmed, None
        return newest

    def _arguments(self, looks: int) -> tuple[object, ...]:
        """Arguments of the fit of `looks` looks."""
        return self.folder, looks

    def _begin(self, looks: int) -> None:
        """Starts a fit; if that fails, the run continues without an estimate."""
        self._looks = looks
        self._worker.begin(*self._arguments(looks))

    def _wait_for_fit(self) -> None:
        """Waits for the fit; a fit that takes too long, or of a run that is to end, is killed."""
        deadline_s = time.monotonic() + FIT_MAX_S
        while self._worker.busy and not self._worker.done(FIT_POLL_S):
            if time.monotonic() > deadline_s or not self.meanwhile():
                self._worker.end()
        if self._worker.busy:
            self._take()

    def _take(self) -> None:
        """Takes the result of a fit; a failed fit has none."""
        result = self._worker.take()
        if result is not None:
            self.latest = self._read(result)

    def _read(self, result: Any) -> Estimate:
        """The estimate in the result of a fit."""
        estimate: Estimate = result
        return estimate
