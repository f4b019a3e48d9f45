"""`acquire --adapt`: the remaining looks are replanned from the running estimate, until target or time is reached.

The result of `plan --given --next` is computed in another process, as is the running estimate: one process fits the
campaign on the disk and proposes the next looks. A proposal outside the rig's limits is ignored. Where the Laplace
approximation meets the target, the same process samples the posterior, and only that ends the run. With few looks the
scales of the noise are uncertain, and Laplace's sds too small. Every change of plan is an event of the journal, so that
a resumed run has the same plan as the interrupted one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from tvsbayes.acquisition.journal import Record
from tvsbayes.acquisition.recorder import Adapted, AdaptedStep, Confirmed, event_of
from tvsbayes.acquisition.running_estimate import Estimate, Proposal, RunningEstimate
from tvsbayes.errors import refusal
from tvsbayes.instrument.axes import AXES, DIRECTIONS
from tvsbayes.instrument.counter_limits import LIMIT_KEYS
from tvsbayes.instrument.plan import PlanStep
from tvsbayes.instrument.rig import Rig
from tvsbayes.positioner.protocol import LIMIT_SETTINGS, SETTINGS

NEXT_SHARE, NEXT_LEAST, NEXT_MOST = 0.3, 8, 80
"""Looks of a proposal: a share of the looks so far, which suffices until the next fit, with its minimum and maximum.

More would not fit into a line of the journal (120 to 160 bytes a look); where they are used up before the next fit, the
run waits for it.
"""


def looks_next(looks: int) -> int:
    """Number of looks to propose after `looks`."""
    return min(NEXT_MOST, max(NEXT_LEAST, math.ceil(NEXT_SHARE * looks)))


def check_plan(rig: Rig, plan: Sequence[PlanStep]) -> None:
    """Refuses a plan that this rig cannot run, before any motion.

    Raises:
        InputError: targets without a sheet position, counters outside the limits.
    """
    firmware = {axis: (SETTINGS[low][2], SETTINGS[high][2]) for axis, (low, high) in LIMIT_SETTINGS.items()}
    limits = rig.limits.within(firmware)
    for step in plan:
        if step.action == "place" and step.target not in rig.sheets_mm:
            allowed = ", ".join(rig.sheets_mm) or "a target named in [sheets]"
            remedy = "add its nominal X to [sheets] of the rig file"
            found = f"target {step.target} in step {step.step}"
            raise refusal("unknown-target", file="plan", found=found, allowed=allowed, remedy=remedy, column="target")
        for axis, counter in zip(AXES, (step.pan_steps, step.tilt_steps), strict=True):
            low, high = limits[axis]
            if counter is not None and not low <= counter <= high:
                remedy = f"correct the plan, or {' and '.join(LIMIT_KEYS[axis])} in [positioner]"
                found, allowed = f"{counter} in step {step.step}", f"{low} to {high}, the soft limits"
                column = f"{axis}_steps"
                raise refusal("limit", file="plan", found=found, allowed=allowed, remedy=remedy, column=column)


@dataclass(frozen=True)
class Ahead:
    """Result of a fit during the run: its estimate, the sampled posterior's where there is one, and the next looks.

    `accepted` states whether the weighted draws behind `sampled` may be used.
    """

    laplace: Estimate
    proposal: Proposal
    sampled: Estimate | None = None
    accepted: bool = False


@dataclass(frozen=True)
class AdaptOptions:
    """Options of a run whose looks are chosen while it runs.

    Attributes:
        ahead: computes an `Ahead` from a campaign folder, its number of looks, the target u, the number of looks to
            propose and the Laplace u at which to sample; another process must be able to import it.
        minutes: duration allowed for the whole run, by `[costs]`; None: that of its plan.
    """

    ahead: Callable[[Path, int, float, int, float], Ahead]
    minutes: float | None = None


class Replanning(RunningEstimate):
    """The running estimate that also proposes the next looks.

    Args:
        folder: the campaign folder.
        ahead: as in `AdaptOptions`.
        target_u_deg_per_step: target u of the effective ratios of all directions.
        minutes: duration allowed for the run.
        wait: whether to wait for every proposal.
    """

    def __init__(
        self,
        folder: Path,
        ahead: Callable[[Path, int, float, int, float], Ahead],
        target_u_deg_per_step: float,
        minutes: float,
        *,
        wait: bool = False,
    ):
        super().__init__(folder, ahead, target_u_deg_per_step, DIRECTIONS, wait=wait)
        self.minutes, self._target_u, self._ratio = minutes, target_u_deg_per_step, 1.0

    @property
    def met(self) -> bool:
        """Return whether the sampled posterior meets the target in every direction."""
        return self.latest is not None and self.latest.tier == "importance" and super().met

    def last(self, looks: int) -> bool:
        """Waits at the end of the plan for one more estimate, from all looks; returns whether the target is met."""
        self._wait_for_fit()
        if self._proposal is None and looks > self._looks:
            self._begin(looks)
            self._wait_for_fit()
        return self.met

    def _arguments(self, looks: int) -> tuple[object, ...]:
        # The worst Laplace u at which sampling may confirm the target, by the last ratio of the two.
        return self.folder, looks, self.target, looks_next(looks), self._target_u / self._ratio

    def _read(self, result: Ahead) -> Estimate:
        """The estimate of the sampled posterior where it can be used, else Laplace's; the event has both."""
        self._proposal, laplace, sampled = result.proposal, result.laplace, result.sampled
        if sampled is None:
            return laplace
        laplace_u, sampled_u = (max(estimate.u_deg_per_step.values()) for estimate in (laplace, sampled))
        if result.accepted:
            self._ratio = max(1.0, sampled_u / laplace_u)
        self._confirmed = Confirmed(
            looks=laplace.looks,
            target_u_deg_per_step=self._target_u,
            laplace_u_deg_per_step=laplace_u,
            importance_u_deg_per_step=sampled_u,
            accepted=result.accepted,
            reached=result.accepted and sampled_u <= self._target_u,
        )
        return sampled if result.accepted else laplace


def adapted_entries(proposal: Proposal, row: int, steps: Sequence[PlanStep]) -> Adapted:
    """The event of a change of plan: from which row on, the steps, and why each look was chosen."""
    # The gain of a look, given the looks before it.
    gains = pairwise((proposal.now, *proposal.after_each))
    entries = (
        AdaptedStep(s.action, s.pan_steps, s.tilt_steps, s.target, *(next(gains) if s.action == "look" else ()))
        for s in steps
    )
    return Adapted(row=row, looks=proposal.looks, why=proposal.why, steps=tuple(entries))


def adapted_plan(plan: Sequence[PlanStep], records: Iterable[Record]) -> tuple[PlanStep, ...]:
    """The plan with the changes in a journal.

    Raises:
        InputError: an event with invalid entries.
    """
    steps = tuple(plan)
    for record in records:
        event = event_of(record, Adapted)
        if event is None:
            continue
        for s in event.steps:
            stated = {"place": s.target, "move": None not in (s.pan_steps, s.tilt_steps), "look": True}
            if not stated.get(s.action):
                raise record.refused(f"no action of a continued plan: {s.action}")
        changed = (
            PlanStep(row, s.action, s.pan_steps, s.tilt_steps, s.target) for row, s in enumerate(event.steps, event.row)
        )
        steps = (*steps[: event.row], *changed)
    return steps
