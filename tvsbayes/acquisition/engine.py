"""The engine that runs a plan on an instrument: home, place, move, look, each recorded on the disk before the next.

However a run ends (the plan's end, Ctrl-C, a fault of device, camera or disk), the laser is switched off and the end is
recorded. The folder is a readable campaign as soon as the first homing is logged. `recorded` derives the completed
steps from the journal. A resumed run homes into a new segment, asks for the sheet, repeats reference looks and
continues with the first step that is not done.

Counters in motor steps, seconds where a name says `_s`, raw px.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from msgspec import structs

from tvsbayes.acquisition.bench import Bench
from tvsbayes.acquisition.journal import Journal
from tvsbayes.acquisition.live_run import COMING_MAX, REMARKS_MAX, LiveRun, SeenLook
from tvsbayes.acquisition.observation import Observation
from tvsbayes.acquisition.operator import HAZARD, Progress, StopKey
from tvsbayes.acquisition.place_command import PlaceCommand, require_placed
from tvsbayes.acquisition.recorder import Four, Homed, Looked, Moved, Placed, Recorded, Start, recorded
from tvsbayes.acquisition.replanning import adapted_entries, check_plan
from tvsbayes.acquisition.run_identity import setup_entries
from tvsbayes.acquisition.run_log import Outcome, RunLog
from tvsbayes.acquisition.running_estimate import RunningEstimate
from tvsbayes.errors import InputError, TvsError, fault
from tvsbayes.instrument.axes import AXES, direction_of
from tvsbayes.instrument.campaign import UNDETECTED, Spot, pixels_of
from tvsbayes.instrument.plan import PlanLog, PlanStep, continued, plan_minutes, plan_seconds, run_plan
from tvsbayes.instrument.rig import Rig
from tvsbayes.instrument.stereo_pair import triangulate
from tvsbayes.positioner.protocol import DeviceState

ATTEMPTS_PER_LOOK = 3
PLACEMENTS_MAX = 3
"""Number of requests to place the same sheet before the run stops."""
REFERENCE_LOOKS = 3
REFERENCE_SHIFT_MAX_PX = 20.0
"""Change of a reference spot after a resume above which the run warns. A stop error and a home offset of 0.1 degrees
together move it by 2 px, a sheet replaced within 1 mm moves it as much (f 700 px, 85 mm baseline, 175 mm)."""
SETTLE_S = 0.3
"""Rest between motion and picture where the rig file states none: a light mechanism vibrates for about 0.1 s."""
CLEARED_STEPS = 20
"""Fewer steps after homing may leave play, so that the approach is unknown. 20 steps are 1.2 degrees at 0.06
degrees per step, against 0.5 degrees of lost motion in the paper."""
DEPTH_SHARE = 0.25
"""Share of the distance to the next target beyond which the error of a sheet's position counts as misplaced."""


class _Stopped(Exception):
    """Ends the plan early, in an orderly way."""


class Acquisition:
    """One run of a plan, from its first step or from the end of an earlier run.

    Args:
        rig: the rig.
        plan: checked by `check_plan`.
        journal: from `begin`; closed at the end.
        bench: the devices; its positioner is closed at the end.
        stop: the stop key, active while `run` runs.
        show: called with the progress.
        estimate: the running estimate; a run that meets its target ends.
        live: publishes the run; by default it is not shown.
        place_command: a program that places the sheet before the operator is asked; by default there is none.
    """

    def __init__(
        self,
        rig: Rig,
        plan: Sequence[PlanStep],
        journal: Journal,
        bench: Bench,
        *,
        stop: StopKey | None = None,
        show: Callable[[Progress], None] = lambda progress: None,
        estimate: RunningEstimate | None = None,
        live: LiveRun | None = None,
        place_command: PlaceCommand | None = None,
    ):
        self.rig, self.plan, self.journal, self.bench = rig, tuple(plan), journal, bench
        self._stop, self._show, self._estimate = stop or StopKey(), show, estimate
        self._live, self._place_command = live or LiveRun(), place_command
        self._settle_s = float(rig.positioner.get("settle_s", SETTLE_S))
        self._retries, self._check_depth, self._placement = 0, False, -1
        self._log = RunLog(journal, rig, bench.utc)
        self._spot = self._log.next_spot()
        if estimate is not None:
            estimate.meanwhile = self._goes_on

    @property
    def _target(self) -> str:
        """Where the sheet is."""
        return self._log.record.target

    def run(self) -> Outcome:
        """Runs the plan to its end, or to the stop key.

        Raises:
            DeviceFault: device, camera or disk failed; the journal records it.
            KeyboardInterrupt: interrupted twice, or ended from outside; laser off, journal closed.
        """
        # Recorded in the journal where an error of the program itself ends the run.
        reason, exit_code, fault = "crashed", 1, None
        with self._stop:
            try:
                self._begin_live()
                reason = self._run()
                exit_code = 130 if reason == "interrupted" else 0
            except _Stopped:
                reason, exit_code = "interrupted", 130
            except KeyboardInterrupt:
                reason, exit_code = "interrupted at once", 130
                raise
            except BaseException as error:
                fault = error
                if isinstance(error, TvsError):
                    reason, exit_code = error.code, error.exit_code
                raise
            finally:
                # An assignment, not a call: no signal handler runs before it takes effect.
                self._stop.closing = True
                # The positioner is closed first: switching the laser off has priority over the log.
                try:
                    self.bench.positioner.close()
                finally:
                    self._log.end(reason, exit_code)
                    self._live.ended(reason, fault)
        return self._log.outcome(reason, self._retries, None if self._estimate is None else self._estimate.latest)

    def _run(self) -> str:
        if not self.bench.operator.accept(HAZARD):
            return "declined"
        setup = setup_entries(self.rig, bool(self.journal.records[0].data.get("synthetic")))
        self._log.write(Start(utc=self._log.utc_text(), setup=setup, **self.bench.details))
        before = recorded(self.journal.records)
        # Events before the first homing do not count, including placements.
        row = before.next_step if before.moves else 0
        self._log.keep_edited()
        self._restore(before, row)
        reason = self._follow_plan(row)
        if reason != "interrupted" and self._log.record.moves:
            self._log.close_segment(self.bench.positioner.home())
        return reason

    def _follow_plan(self, row: int) -> str:
        """Follows the plan from a row on, with its changes; returns why it ended."""
        while row < len(self.plan):
            step, minutes = self.plan[row], None if self._estimate is None else self._estimate.minutes
            row += 1
            if self._stop.requested:
                return "interrupted"
            if minutes is not None and plan_minutes(self.rig, self.plan[:row]) > minutes:
                return "time over"
            self._report(step)
            self._do(step)
            if step.action == "look" and self._estimate is not None and self._update_estimate(row, self._estimate):
                return "target met"
        return "done"

    def _update_estimate(self, row: int, estimate: RunningEstimate) -> bool:
        """Take the result of the fits after the look before `row`; return whether the target is met.

        If not, proposed looks replace the remaining ones; the journal records the change before it takes effect.
        """
        met = estimate.update(self._log.ok_looks)
        if not met and row == len(self.plan):
            met = estimate.last(self._log.ok_looks)
        self._live.estimated(estimate.latest)
        if confirmed := estimate.confirmed():
            self._log.write(confirmed)
        proposal = None if met else estimate.proposal()
        if proposal is None:
            return met
        steps = continued(proposal.steps, row, self._target)
        try:
            check_plan(self.rig, steps)
        except InputError as error:
            self._log.warnings.append(f"proposed looks were not followed: {error}")
        else:
            self._log.write(adapted_entries(proposal, row, steps))
            self.plan = (*self.plan[:row], *steps)
        return met

    def _do(self, step: PlanStep) -> None:
        if step.action == "home":
            self._home(step.step, step.counters((0, 0)))
        elif step.action == "place":
            self._place(step.target, len(self._before(step.step).targets), "", step.step)
        elif step.action == "move":
            self._move(step.counters(self._before(step.step).at), step.step)
        else:
            self._look(step.step, step.experiment, step.point)

    def _before(self, row: int) -> PlanLog:
        """Sheet and counters at the beginning of the step in this row, from the plan."""
        return run_plan(self.plan[:row], self.rig)

    def _home(self, step: int | None, counters: tuple[int, int]) -> None:
        self.journal.append("intent", step=step, action="home")
        report = self.bench.positioner.home()
        self._log.close_segment(report)
        state, entries = self._reach(counters)
        legs = zip(AXES, counters, (report.state.pan_steps, report.state.tilt_steps), strict=True)
        pan, tilt = (_approach(axis, target - start, report.ends_negative) for axis, target, start in legs)
        self._log.write(Homed(step=step, boot=state.boot, approach=(pan, tilt), **entries))

    def _move(self, counters: tuple[int, int], step: int | None, **entries: Any) -> None:
        pan, tilt = counters
        self.journal.append("intent", step=step, action="move", pan_steps=pan, tilt_steps=tilt)
        self._log.write(Moved(step=step, **self._reach(counters)[1], **entries))

    def _reach(self, counters: tuple[int, int]) -> tuple[DeviceState, dict[str, Any]]:
        """Move and settle; returns the device's state and the entries of the motion's event."""
        state = self.bench.positioner.move_to(*counters)
        self._live.publish(device=state)
        self.bench.clock.sleep(self._settle_s)
        entries = {"time_s": self._log.now_s(), "pan_steps": state.pan_steps, "tilt_steps": state.tilt_steps}
        return state, {**entries, **self.bench.annotate()}

    def _place(self, target: str, placement: int, remark: str, step: int | None) -> None:
        x_mm = self.rig.sheets_mm[target]
        if self._place_command is not None:
            self.bench.positioner.laser(False)
            event = self._place_command.run(target, x_mm, placement, self._goes_on)
            self._log.write(structs.replace(event, time_s=self._log.now_s()))
            self._require_going()
            require_placed(event)
        if not self.bench.operator.place(target, x_mm, placement, remark):
            raise _Stopped
        self._log.write(Placed(step=step, target=target, again=step is None, utc=self._log.utc_text()))
        self._placement, self._check_depth = placement, True

    def _look(self, step: int | None, experiment: int | None, point: int | None, reference: Spot | None = None) -> None:
        for _ in range(PLACEMENTS_MAX):
            observation = self._observe()
            misplacement = self._misplaced(observation)
            if misplacement is None:
                break
            self._place(self._target, self._placement, misplacement, None)
        else:
            remedy = "check the sheet and [sheets] of the rig file, then go on with --resume"
            raise fault("placement", f"the sheet is not where it should be: {misplacement}", remedy)
        frames = tuple(self.journal.store(name, data) for name, data in observation.pictures.items())
        spot = observation.spot
        event = Looked(
            step=step,
            spot=self._spot,
            target=self._target,
            experiment=experiment,
            point=point,
            status=spot.status,
            pixels_px=spot.pixels_px,
            sds_px=spot.sds_px,
            correlations=spot.correlations,
            frames=frames,
            time_s=self._log.now_s(),
            **({} if reference is None else self._compared(reference, spot.pixels_px)),
        )
        self._log.write(event)
        pictures = {name: data for name, data in observation.pictures.items() if name.startswith("frames/")}
        self._live.looked(SeenLook(self._spot, spot.status, self._target, spot.pixels_px, spot.sds_px, pictures))
        self._spot += 1
        self._log.derive()

    def _compared(self, reference: Spot, pixels_px: Four | None) -> dict[str, Any]:
        """The largest change of a reference spot, for the event of the look; a large one is a warning."""
        shift_px = None
        if pixels_px is not None:
            pairs = zip(pixels_of([reference])[0], pixels_px, strict=True)
            shift_px = round(max(abs(float(a) - b) for a, b in pairs), 3)
        if shift_px is None or shift_px > REFERENCE_SHIFT_MAX_PX:
            change = "is not seen" if shift_px is None else f"has moved by {shift_px:.0f} px"
            self._log.warnings.append(f"the reference spot {reference.spot} {change}: have camera or sheet been moved?")
        return {"reference_of": reference.spot, "shift_px": shift_px}

    def _observe(self) -> Observation:
        """Take a look, repeated while no spot is found; the last one counts."""
        for attempt in range(1, ATTEMPTS_PER_LOOK + 1):
            observation = self.bench.observer.observe(self.bench.positioner, self._spot)
            status = observation.spot.status
            if status in ("ok", UNDETECTED) or self._stop.requested or attempt == ATTEMPTS_PER_LOOK:
                break
            self._retries += 1
            self._live.remarked(f"look {self._spot}: {status}; taken again")
        return observation

    def _misplaced(self, observation: Observation) -> str | None:
        """Why the sheet seems misplaced, judged by the first spot after its placement; None if it does not."""
        pixels, target = observation.spot.pixels_px, self._target
        if not self._check_depth or observation.spot.status != "ok" or pixels is None:
            return None
        depth_mm = float(triangulate(self.rig.stereo_pair, np.array([pixels]))[0, 0])
        nominal_mm = self.rig.sheets_mm[target]
        distances_mm = [abs(x - nominal_mm) for x in self.rig.sheets_mm.values() if x != nominal_mm]
        if abs(depth_mm - nominal_mm) > DEPTH_SHARE * min([*distances_mm, nominal_mm]):
            return f"its spot lies at X = {depth_mm:.0f} mm, {target} is at {nominal_mm:.0f} mm"
        self._check_depth = False
        return None

    def _restore(self, record: Recorded, row: int) -> None:
        """Restores the state of the plan: the sheet, a new segment with reference looks, and looks that a repair lost.

        The plan gives that state: the last event of the journal may belong to an interrupted reference look.
        """
        remaining, before = self.plan[row:], self._before(row)
        lost = [s for s in self.plan[:row] if s.action == "look" and s.step not in record.looked_steps]
        if not (remaining or lost):
            return
        if before.sheet:
            self._place(before.sheet, len(before.targets) - 1, "as before the interruption", None)
        homes_next = bool(remaining) and remaining[0].action == "home"
        if not record.moves or (homes_next and not lost):
            return
        self._home(None, record.home_steps)
        self._look_at_references(record)
        for step in lost:
            self._retake(step)
        if lost and remaining and remaining[0].action != "place":
            self._put_sheet(before, "as before the looks that were taken again")
        if remaining and not homes_next:
            self._move(before.at, None)

    def _look_at_references(self, record: Recorded) -> None:
        """Looks again at the last spots on the present sheet."""
        candidates: dict[tuple[int, int], Spot] = {}
        for spot in reversed(record.spots):
            if spot.status == "ok" and spot.target == self._target:
                move = record.moves[spot.move]
                candidates.setdefault((move.pan_steps, move.tilt_steps), spot)
        for counters, spot in list(candidates.items())[:REFERENCE_LOOKS]:
            self._require_going()
            self._move(counters, None, reference=True)
            self._look(None, None, None, reference=spot)

    def _retake(self, step: PlanStep) -> None:
        """Repeats a look of the plan that a repair of the journal lost, reached by the same motions."""
        self._require_going()
        self._report(step)
        before = self._before(step.step)
        self._put_sheet(before, "for a look that was lost")
        # Moves start from the previous counters, for the same sense and the same side of the play.
        for move in before.moves[-2:]:
            self._move((move.pan_steps, move.tilt_steps), None)
        self._look(step.step, step.experiment, step.point)

    def _put_sheet(self, before: PlanLog, remark: str) -> None:
        if before.sheet and before.sheet != self._target:
            self._place(before.sheet, len(before.targets) - 1, remark, None)

    def _goes_on(self) -> bool:
        return not self._stop.requested

    def _require_going(self) -> None:
        if self._stop.requested:
            raise _Stopped

    def _report(self, step: PlanStep) -> None:
        remaining = self.plan[step.step :]
        latest = None if self._estimate is None else self._estimate.latest
        progress = Progress(
            step=step.step,
            steps=len(self.plan),
            looks=sum(s.action == "look" for s in self.plan[: step.step]),
            looks_total=sum(s.action == "look" for s in self.plan),
            refused=sum(spot.status not in ("ok", UNDETECTED) for spot in self._log.record.looks),
            retries=self._retries,
            seconds_left=plan_seconds(self.rig, remaining),
            doing=_in_words(step),
            estimate="" if latest is None else latest.text,
        )
        self._show(progress)
        self._live.estimated(latest)
        coming = tuple(map(_in_words, remaining[1 : 1 + COMING_MAX]))
        self._live.publish(progress=progress, coming=coming, warnings=tuple(self._log.warnings[-REMARKS_MAX:]))

    def _begin_live(self) -> None:
        """Publishes values that do not change during the run."""
        stereo, created = self.rig.stereo_pair, self.journal.records[0].data
        self._live.publish(
            name=str(created.get("name", "")),
            simulated=bool(created.get("synthetic")),
            image_px=(stereo.image_width, stereo.image_height),
            **({} if self._estimate is None else {"aim": self._estimate.aim}),
        )
        self._live.begun()


def _in_words(step: PlanStep) -> str:
    return {
        "home": "homing",
        "place": f"placing {step.target}",
        "move": f"moving to {step.pan_steps}, {step.tilt_steps}",
        "look": "looking",
    }[step.action]


def _approach(axis: str, steps: int, ends_negative: bool) -> str:
    """The side from which an axis arrives by `steps` after a homing, which may end in the negative sense."""
    cleared = abs(steps) >= CLEARED_STEPS or (steps <= 0 and ends_negative)
    return direction_of(axis, 1 if steps > 0 else -1) if cleared else "unknown"
