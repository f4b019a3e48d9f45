"""The running estimate of an acquisition: a fit in a process of its own, beside the instrument.

The campaign folder is readable at any time, so `tvsbayes fit --no-sample` runs on it as it stands, one fit at a time.
The acquisition neither waits for it nor shares memory with it: a compiler at work must not delay a laser switch. The
figures are the effective degrees per step of the beam with their standard uncertainty from the Laplace approximation
(formulation 3.2 and 4.2), of the looks that were there when the fit began.
"""

from __future__ import annotations

import json
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

FIRST_LOOKS = 12
"""Fewer looks than three experiments of four points say next to nothing."""
GROWTH = 1.2
"""The next fit begins when there are so many times more looks than at the last: their sum costs a few fits."""
FIT_MAX_S = 3600.0
"""Longest wait for a fit; one takes a minute or less."""
FIT_POLL_S = 0.1
"""While a fit is waited for: how often what is asked of the run is heeded."""


@dataclass(frozen=True)
class EstimateWish:
    """Whether a run is fitted beside itself, and to what end.

    Attributes:
        command: `tvsbayes fit`, as a process is started.
        target_u_deg_per_step: ends the run once the effective ratio of every direction of its plan is known so well.
        asked: whether to fit; None: on hardware, and for a target.
    """

    command: tuple[str, ...]
    target_u_deg_per_step: float | None = None
    asked: bool | None = None

    def holds(self, simulate: bool) -> bool:
        """Whether a run, simulated or not, is to be fitted."""
        return self.target_u_deg_per_step is not None or (not simulate if self.asked is None else self.asked)


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
        parts = (
            f"{name} {self.deg_per_step[name]:.6f} u {self.u_deg_per_step[name]:.1e}" for name in self.deg_per_step
        )
        return ", ".join(parts)

    def as_json(self) -> dict[str, object]:
        """As part of the document of `acquire`."""
        ratios = {d: {"value": self.deg_per_step[d], "sd": self.u_deg_per_step[d]} for d in self.deg_per_step}
        return {"tier": self.tier, "looks": self.looks, "effective_deg_per_step": ratios}


@dataclass(frozen=True)
class Aim:
    """What the running estimate is for: directions of the plan, and the u wanted of each, None for no target."""

    directions: tuple[str, ...] = ()
    target_u_deg_per_step: float | None = None


class RunningEstimate:
    """Fits the folder of a running acquisition again and again.

    Args:
        folder: the campaign folder.
        command: `tvsbayes fit`; the folder, `--no-sample --json` and a place for results are appended.
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
        command: Sequence[str],
        target_u_deg_per_step: float | None,
        directions: Iterable[str],
        *,
        wait: bool = False,
    ):
        self.folder, self.target, self.directions = Path(folder), target_u_deg_per_step, set(directions)
        self.latest: Estimate | None = None
        self.meanwhile: Callable[[], bool] = lambda: True
        self._wait = wait
        self._command = tuple(command)
        self._scratch = tempfile.TemporaryDirectory(prefix="tvsbayes-estimate-")
        self._process: subprocess.Popen[bytes] | None = None
        self._looks = 0

    def __enter__(self) -> RunningEstimate:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()
        self._scratch.cleanup()

    def _end(self) -> None:
        """Kills a fit that goes on."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

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
        if self._process is not None and self._process.poll() is not None:
            self._take()
        if self._process is None and looks >= max(FIRST_LOOKS, GROWTH * self._looks):
            self._begin(looks)
            if self._wait:
                self._wait_for_fit()
        return self.met

    def _arguments(self, looks: int) -> list[str]:
        """The command line of the fit of so many looks."""
        results = Path(self._scratch.name) / "results"
        return [*self._command, str(self.folder), "--no-sample", "--json", "--out", str(results)]

    def _begin(self, looks: int) -> None:
        """Starts a fit; where no process can be started the run goes on without an estimate."""
        self._looks = looks
        arguments = self._arguments(looks)
        nothing = subprocess.DEVNULL
        try:
            with open(Path(self._scratch.name) / "fit.json", "wb") as stream:
                self._process = subprocess.Popen(
                    arguments, stdout=stream, stderr=nothing, stdin=nothing, start_new_session=True
                )
        except OSError:
            self._process = None

    def _wait_for_fit(self) -> None:
        """A fit that takes too long is killed, as is that of a run that is to end."""
        if self._process is None:
            return
        until = time.monotonic() + FIT_MAX_S
        while self.meanwhile():
            try:
                self._process.wait(FIT_POLL_S)
                break
            except subprocess.TimeoutExpired:
                if time.monotonic() > until:
                    self._process.kill()
        else:
            self._end()
            return
        self._take()

    def _take(self) -> None:
        """A fit that did not work says nothing: the next one has more looks."""
        self._process = None
        try:
            document = json.loads((Path(self._scratch.name) / "fit.json").read_bytes())
            if "error" in document:
                return
            self.latest = self._read(document)
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return

    def _read(self, document: Mapping[str, Any]) -> Estimate:
        """What a document of the command says.

        Raises:
            ValueError: not converged, or no document of this command; KeyError, TypeError, AttributeError likewise.
        """
        if not document["converged"]:
            raise ValueError("not converged")
        return self._estimate(document["effective_deg_per_step"])

    def _estimate(self, ratios: Mapping[str, Any], tier: str = "laplace") -> Estimate:
        """From the entries of directions; what did not move is None."""
        found = {name: entry for name, entry in ratios.items() if entry is not None}
        values = {name: float(entry["value"]) for name, entry in found.items()}
        return Estimate(self._looks, values, {name: float(entry["sd"]) for name, entry in found.items()}, tier)
