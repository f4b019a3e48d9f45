"""Stand-ins for fits beside a run, in a module that a process of its own can import."""

from __future__ import annotations

import os
import signal
from pathlib import Path

from tvsbayes.acquisition.replanning import Ahead, Proposal
from tvsbayes.acquisition.running_estimate import Estimate
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.plan import PlanStep


def rows_of(folder: Path) -> int:
    return len((folder / "spots.csv").read_text().splitlines()) - 1


def two_directions(folder: Path, looks: int) -> Estimate:
    """A fit whose u falls as 0.012 / looks; that of 15 looks fails."""
    if looks == 15:
        raise ArithmeticError("not converged")
    u = 0.012 / rows_of(folder)
    return Estimate(looks, {"left": 0.06, "right": 0.06}, {"left": u, "right": u})


def waiting(folder: Path, looks: int) -> Estimate:
    """Ends once the other end of a pipe is opened, without a result."""
    (folder.parent / "go").read_text()
    raise ArithmeticError("not converged")


def killed(folder: Path, looks: int) -> Estimate:
    """The first call ends its process as the kernel does where memory is short."""
    if looks == 12:
        os.kill(os.getpid(), signal.SIGKILL)
    return Estimate(looks, {"left": 0.06}, {"left": float(os.getpid())})


def proposing(
    sheet: str, step: int, ratio: float, accepted: bool, folder: Path, looks: int, target_u: float, count: int,
    confirm_below: float,
) -> Ahead:  # fmt: skip
    """Laplace u falls as 0.012 / looks, the sampled one is `ratio` times that."""
    there, steps = rows_of(folder), [PlanStep(0, "place", target=sheet)]
    for n in range(count):
        steps += [PlanStep(0, "move", step * n + there, -10), PlanStep(0, "look")]
    after = tuple(0.012 / (there + n + 1) for n in range(count))
    u = 0.012 / there
    proposal = Proposal(tuple(steps), after, u, looks, f"{count} looks at {sheet} help most")
    laplace = Estimate(looks, dict.fromkeys(DIRECTIONS, 0.06), dict.fromkeys(DIRECTIONS, u))
    if u > confirm_below:
        return Ahead(laplace, proposal)
    sampled = Estimate(looks, dict.fromkeys(DIRECTIONS, 0.061), dict.fromkeys(DIRECTIONS, ratio * u), "importance")
    return Ahead(laplace, proposal, sampled, accepted)


def given_rig(sheet: str, step: int, ratio: float, accepted: bool, rig: Path, *rest: object, planned: object) -> Ahead:
    """In place of the function of the command, which is given the rig file too."""
    return proposing(sheet, step, ratio, accepted, *rest)
