"""A plan run look by look."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tvsbayes.acquisition.journal import FRAME_NAME, Journal
from tvsbayes.acquisition.journal_check import orphans
from tvsbayes.acquisition.observation import Observation, Observer
from tvsbayes.acquisition.operator import HAZARD, Operator, Progress, StopKey
from tvsbayes.acquisition.recorder import (
    HOME_TOLERANCE_STEPS,
    Recorded,
    Recorder,
    campaign_of,
    keep_edited,
    write_derived,
)
from tvsbayes.acquisition.running_estimate import RunningEstimate
from tvsbayes.errors import DeviceFault, TvsError
from tvsbayes.instrument.axes import APPROACH_SIGN, SENSES
from tvsbayes.instrument.campaign import Campaign, Spot
from tvsbayes.instrument.plan import PlanStep, plan_seconds, run_plan
from tvsbayes.instrument.rig import Rig
from tvsbayes.positioner.driver import Clock, HomeReport, Positioner

ATTEMPTS_PER_LOOK = 3
PLACEMENTS_MAX = 3
"""How often the operator is asked for the same sheet before the run stops."""
REFERENCE_LOOKS = 3
REFERENCE_SHIFT_MAX_PX = 20.0
"""Change of a reference spot after a resume that is worth a word. A stop error and a home offset of 0.1 degrees
together move it by 2 px, a sheet put back within 1 mm by as much (f 700 px, 85 mm baseline, 175 mm)."""
SETTLE_S = 0.3
"""Rest between motion and picture where the rig file states none: a light mechanism rings for about 0.1 s."""
CLEARED_STEPS = 20
"""Fewer steps than these after homing may leave play: then the approach is unknown. 20 steps are 1.2 degrees at 0.06
degrees per step, against 0.5 degrees of lost motion in the paper."""
DERIVED_EVERY = 100
"""Up to this many spots the campaign files are written after every look, then ever more rarely: at least 99 % of the
looks are in them at any time, all of them in the journal."""
DEPTH_SHARE = 0.25
"""Share of the distance to the next target by which a sheet may be off before it counts as misplaced."""


@dataclass(frozen=True)
class Outcome:
    """How a run ended.

    Attributes:
        reason: "done", "target met", "interrupted" or "declined".
        looks: looks of this campaign, of all its runs.
        ok: how many of them count.
        refused: how many found no usable spot.
        references: how many of `looks` are none of the plan's: resumed runs look again at spots seen before. They
            count as any other.
        retries: looks repeated in this run.
        lost_segments: segments in which steps were lost.
        warnings: what the user should know.
    """

    reason: str
    looks: int
    ok: int
    refused: int
    references: int
    retries: int
    lost_segments: tuple[int, ...]
    warnings: tuple[str, ...]

    def as_json(self) -> dict[str, object]:
        """The document of `tvsbayes acquire`."""
        return {
            "reason": self.reason,
            "looks": self.looks,
            "ok": self.ok,
            "refused": self.refused,
            "references": self.references,
            "retries": self.retries,
            "lost_segments": list(self.lost_segments),
            "warnings": list(self.warnings),
        }


class _Stopped(Exception):
    """Ends the plan early, in good order."""


@dataclass(frozen=True)
class _Scene:
    """Sheet and counters at a step of a plan.

    Attributes:
        target: where the sheet stands, "" before the first placement.
        placement: which placement of the plan that is, from 0; -1 before the first.
        counters: (pan, tilt) of the motion before the last and of the last, fewer at the beginning.
    """

    target: str
    placement: int
    counters: tuple[tuple[int, int], ...]


class Acquisition:
    """One run of a plan, from its first step or from where an earlier run ended.

    Args:
        rig: the rig.
        plan: checked by `check_plan`.
        journal: from `begin`; closed in the end.
        positioner: connected; closed in the end.
        observer: takes the looks.
        operator: is asked before the laser and for every sheet.
        clock: for settling.
        utc: the time of day, for `time_s`.
        stop: the stop key, in force while `run` runs.
        show: told about progress.
        annotate: further entries of every motion's event (the twin's true angles).
        details: what to write down of device and cameras at the start.
        estimate: the running estimate; a run that meets its target ends.
    """

    def __init__(
        self,
        rig: Rig,
        plan: Sequence[PlanStep],
        journal: Journal,
        positioner: Positioner,
        observer: Observer,
        operator: Operator,
        *,
        clock: Clock,
        utc: Callable[[], datetime.datetime],
        stop: StopKey | None = None,
        show: Callable[[Progress], None] = lambda progress: None,
        annotate: Callable[[], Mapping[str, object]] = dict,
        details: Mapping[str, object] | None = None,
        estimate: RunningEstimate | None = None,
    ):
        self._estimate = estimate
        self.rig, self.plan, self.journal = rig, tuple(plan), journal
        self.positioner, self.observer, self.operator = positioner, observer, operator
        self._clock, self._utc, self._stop, self._show = clock, utc, stop or StopKey(), show
        self._annotate, self._details = annotate, dict(details or {})
        self._settle_s = float(rig.positioner.get("settle_s", SETTLE_S))
        self._retries, self._warnings, self._check_depth = 0, [], False
        self._behind = ""
        self._placement = -1
        self._recorder = Recorder()
        for record in journal.records:
            self._recorder.add(record)
        self._time_s = max((move.time_s for move in self._recorder.moves), default=0.0)
        self._spot = self._next_spot()

    def run(self) -> Outcome:
        """Runs the plan to its end, or to the stop key.

        Raises:
            DeviceFault: device, camera or disk failed; the journal says so too.
            KeyboardInterrupt: interrupted twice, or ended from outside; laser off, journal closed.
        """
        # What stands in the journal where an error of the program itself ends the run.
        reason, exit_code = "crashed", 1
        with self._stop:
            try:
                reason = self._run()
                exit_code = 130 if reason == "interrupted" else 0
            except _Stopped:
                reason, exit_code = "interrupted", 130
            except KeyboardInterrupt:
                reason, exit_code = "interrupted at once", 130
                raise
            except TvsError as error:
                reason, exit_code = error.code, error.exit_code
                raise
            finally:
                # An assignment, no call: Python lets no signal in before it has taken effect.
                self._stop.closing = True
                # The positioner is closed first: light matters more than the log.
                try:
                    self.positioner.close()
                finally:
                    self._end(reason, exit_code)
        done = self._recorder.result()
        spots = done.spots
        ok = sum(spot.status == "ok" for spot in spots)
        waiting = sum(spot.status == "undetected" for spot in spots)
        lost = tuple(segment for segment, _ in done.lost)
        refused = len(spots) - ok - waiting
        beside = done.references, self._retries
        return Outcome(reason, len(spots), ok, refused, *beside, lost, tuple(self._warnings))

    def _run(self) -> str:
        if not self.operator.accept(HAZARD):
            return "declined"
        self._log("start", utc=self._utc_text(), **self._details)
        resumed = self._recorder.result()
        # Before the first homing nothing counts, whatever was placed.
        next_row = resumed.next_step if resumed.moves else 0
        if resumed.moves:
            self._keep_edited()
        self._recover(resumed, next_row)
        for step in self.plan[next_row:]:
            if self._stop.requested:
                return "interrupted"
            self._tell(step)
            self._do(step)
            if step.action == "look" and self._estimate is not None and self._estimate.update(self._ok_looks()):
                reason = "target met"
                break
        else:
            reason = "done"
        if self._recorder.moves:
            self._close_segment(self.positioner.home())
        return reason

    def _ok_looks(self) -> int:
        return sum(spot.status == "ok" for spot in self._recorder.spots)

    def _end(self, reason: str, exit_code: int) -> None:
        """Writes down how it ended, as well as the disk allows."""
        try:
            self._log("stop", reason=reason, exit_code=exit_code, utc=self._utc_text())
        except DeviceFault:
            # A broken disk was the reason, and is on its way to the user already.
            pass
        finally:
            self.journal.close()
        self._derive(always=True)
        if self._behind:
            self._warnings.append(f"the campaign files are behind the journal: {self._behind}")

    def _do(self, step: PlanStep) -> None:
        if step.action == "home":
            self._home(step.step, step.counters((0, 0)))
        elif step.action == "place":
            self._place(step.target, self._scene(step.step).placement + 1, "", step.step)
        elif step.action == "move":
            self._move(*step.counters(self._scene(step.step).counters[-1]), step.step)
        else:
            self._look(step.step, step.experiment, step.point)

    @property
    def _done(self) -> Recorded:
        """Where the run stands, without its moves and spots."""
        return self._recorder.state

    def _now_s(self) -> float:
        """Seconds since the campaign was created, never going back, whatever the clock of the computer does."""
        created = self.journal.records[0].data.get("created")
        start = datetime.datetime.fromisoformat(str(created))
        self._time_s = max(self._time_s, round((self._utc() - start).total_seconds(), 3))
        return self._time_s

    def _utc_text(self) -> str:
        return self._utc().isoformat(timespec="milliseconds")

    def _home(self, step: int | None, counters: tuple[int, int]) -> None:
        self.journal.append("intent", step=step, action="home")
        report = self.positioner.home()
        self._close_segment(report)
        switches = report.state.pan_steps, report.state.tilt_steps
        state = self.positioner.move_to(*counters)
        self._clock.sleep(self._settle_s)
        approach = [
            _approach(to - start, names) for to, start, names in zip(counters, switches, SENSES.values(), strict=True)
        ]
        reached = {"pan_steps": state.pan_steps, "tilt_steps": state.tilt_steps, "boot": state.boot}
        self._log("homed", step=step, time_s=self._now_s(), **reached, approach=approach, **self._annotate())

    def _close_segment(self, report: HomeReport) -> None:
        """What homing says about the segment that it ends."""
        if not self._recorder.moves:
            return
        known = report.known or (report.compared and report.state.boot == self._done.boot)
        segment, deviation = self._recorder.moves[-1].segment, list(report.deviation_steps) if known else None
        self._log("verified", segment=segment, deviation_steps=deviation)
        if deviation is not None and max(map(abs, deviation)) > HOME_TOLERANCE_STEPS:
            self._warnings.append(
                f"segment {segment}: the home switches were found {deviation[0]} and {deviation[1]} steps off: steps "
                "were lost, its spots do not count; lower the speed or free the mechanism"
            )

    def _place(self, target: str, placement: int, remark: str, step: int | None) -> None:
        again = step is None
        if not self.operator.place(target, self.rig.sheets_mm[target], placement, remark):
            raise _Stopped
        self._log("placed", step=step, target=target, again=again, utc=self._utc_text())
        self._placement, self._check_depth = placement, True

    def _move(self, pan: int, tilt: int, step: int | None, **more: object) -> None:
        self.journal.append("intent", step=step, action="move", pan_steps=pan, tilt_steps=tilt)
        state = self.positioner.move_to(pan, tilt)
        self._clock.sleep(self._settle_s)
        reached = {"pan_steps": state.pan_steps, "tilt_steps": state.tilt_steps}
        self._log("moved", step=step, time_s=self._now_s(), **reached, **more, **self._annotate())

    def _look(self, step: int | None, experiment: int | None, point: int | None, reference: Spot | None = None) -> None:
        for _ in range(PLACEMENTS_MAX):
            observation = self._observe()
            wrong = self._misplaced(observation)
            if wrong is None:
                break
            self._place(self._done.target, self._placement, wrong, None)
        else:
            remedy = "check the sheet and [sheets] of the rig file, then go on with --resume"
            raise DeviceFault("placement", f"the sheet is not where it should be: {wrong}; {remedy}", remedy=remedy)
        frames = [self.journal.store(name, data).as_json() for name, data in observation.pictures.items()]
        found = observation.detection
        more: dict[str, object] = {}
        if reference is not None:
            shift_px = _shift_px(reference, found.pixels_px)
            more = {"reference_of": reference.spot, "shift_px": shift_px}
            if shift_px is None or shift_px > REFERENCE_SHIFT_MAX_PX:
                seen = "is not seen" if shift_px is None else f"has moved by {shift_px:.0f} px"
                self._warnings.append(f"the reference spot {reference.spot} {seen}: have camera or sheet been moved?")
        self._log(
            "looked",
            step=step,
            spot=self._spot,
            target=self._done.target,
            experiment=experiment,
            point=point,
            status=found.status,
            pixels_px=found.pixels_px,
            sds_px=found.sds_px,
            correlations=found.correlations,
            frames=frames,
            time_s=self._now_s(),
            **more,
        )
        self._spot += 1
        self._derive()

    def _observe(self) -> Observation:
        """A look; one that finds no spot is repeated, the last one counts."""
        for attempt in range(ATTEMPTS_PER_LOOK):
            self._retries += attempt > 0
            observation = self.observer.observe(self.positioner, self._spot)
            if observation.detection.status in ("ok", "undetected") or self._stop.requested:
                break
        return observation

    def _misplaced(self, observation: Observation) -> str | None:
        """Why the sheet seems to stand elsewhere, judged by the first spot after it was placed."""
        pixels = observation.detection.pixels_px
        if not self._check_depth or observation.detection.status != "ok" or pixels is None:
            return None
        from tvsbayes.instrument.stereo_pair import triangulate

        depth = float(triangulate(self.rig.stereo, np.array([pixels]))[0, 0])
        nominal = self.rig.sheets_mm[self._done.target]
        others = [abs(x - nominal) for x in self.rig.sheets_mm.values() if x != nominal]
        tolerance = DEPTH_SHARE * min([*others, nominal])
        if abs(depth - nominal) > tolerance:
            return f"its spot lies at X = {depth:.0f} mm, {self._done.target} is at {nominal:.0f} mm"
        self._check_depth = False
        return None

    def _scene(self, row: int) -> _Scene:
        """What the plan has made of sheet and counters when the step in this row begins."""
        done = run_plan(self.plan[:row], self.rig)
        counters = tuple((move.pan_steps, move.tilt_steps) for move in done.moves[-2:])
        return _Scene(done.sheet, len(done.targets) - 1, counters)

    def _recover(self, before: Recorded, next_row: int) -> None:
        """Goes back to where the plan stood: the sheet, a new segment with reference looks, and what a repair lost.

        Where the plan stood is read off the plan. What the journal has last may be a reference look that was
        interrupted too.
        """
        rest, scene = self.plan[next_row:], self._scene(next_row)
        lost = [s for s in self.plan[:next_row] if s.action == "look" and s.step not in before.looked_steps]
        if not (rest or lost):
            return
        if scene.target:
            self._place(scene.target, scene.placement, "as before the interruption", None)
        homes_next = bool(rest) and rest[0].action == "home"
        if not before.moves or (homes_next and not lost):
            return
        self._home(None, before.home_steps)
        self._look_at_references(before)
        for step in lost:
            self._retake(step)
        if lost and rest and rest[0].action != "place":
            self._put_sheet(scene, "as before the looks that were taken again")
        if rest and not homes_next:
            self._move(*scene.counters[-1], None)

    def _look_at_references(self, before: Recorded) -> None:
        """Looks again where the last spots on the present sheet were seen."""
        candidates: dict[tuple[int, int], Spot] = {}
        for spot in reversed(before.spots):
            if spot.status == "ok" and spot.target == self._done.target:
                move = before.moves[spot.move]
                candidates.setdefault((move.pan_steps, move.tilt_steps), spot)
        for (pan, tilt), spot in list(candidates.items())[:REFERENCE_LOOKS]:
            self._heed_stop()
            self._move(pan, tilt, None, reference=True)
            self._look(None, None, None, reference=spot)

    def _retake(self, step: PlanStep) -> None:
        """Takes a look of the plan that a repair of the journal lost, reached as the plan reached it."""
        self._heed_stop()
        self._tell(step)
        scene = self._scene(step.step)
        self._put_sheet(scene, "for a look that was lost")
        # From the counters before: the same sense, so the same side of the play.
        for counters in scene.counters:
            self._move(*counters, None)
        self._look(step.step, step.experiment, step.point)

    def _put_sheet(self, scene: _Scene, remark: str) -> None:
        if scene.target and scene.target != self._done.target:
            self._place(scene.target, scene.placement, remark, None)

    def _heed_stop(self) -> None:
        if self._stop.requested:
            raise _Stopped

    def _log(self, event: str, **data: object) -> None:
        self._recorder.add(self.journal.append(event, **data))
        if event in ("homed", "verified"):
            self._derive(always=True)

    def _next_spot(self) -> int:
        """The first number that neither an event nor a frame of an interrupted look has."""
        used = [spot.spot for spot in self._recorder.spots]
        names = orphans(self.journal.folder, tuple(self.journal.records))
        # Other pictures, which somebody has put there, have no number.
        used += [int(name.split("/")[1][:6]) for name in names if FRAME_NAME.fullmatch(name)]
        return max(used, default=-1) + 1

    def _keep_edited(self) -> None:
        """Files that somebody has changed since the run was interrupted are about to be written again."""
        campaign = self._campaign()
        if campaign is None:
            return
        for name, copy in keep_edited(campaign, self.journal.folder).items():
            self._warnings.append(f"{name} was edited since: what stood in it is kept in {copy.name}")

    def _derive(self, always: bool = False) -> None:
        count = len(self._recorder.spots)
        if not always and count > DERIVED_EVERY and count % (count // DERIVED_EVERY):
            return
        campaign = self._campaign()
        if campaign is None:
            return
        try:
            write_derived(campaign, self.journal.folder, tables_only=not always)
            self._behind = ""
        except TvsError as error:
            # Somebody has the table open, say. The journal has everything, and the next look tries again; after the
            # last one --resume does.
            self._behind = error.message

    def _campaign(self) -> Campaign | None:
        """What the journal holds so far, None before the first homing."""
        header = {"name": str(self.journal.records[0].data.get("name", "acquired campaign"))}
        created = datetime.datetime.fromisoformat(str(self.journal.records[0].data.get("created")))
        header["created"] = created.astimezone(datetime.UTC)
        for name in ("synthetic", "seed"):
            if name in self.journal.records[0].data:
                header[name] = self.journal.records[0].data[name]
        return campaign_of(self._recorder.result(), self.rig, header)

    def _tell(self, step: PlanStep) -> None:
        left = self.plan[step.step :]
        spots = self._recorder.spots
        doing = {
            "home": "homing",
            "place": f"placing {step.target}",
            "move": f"moving to {step.pan_steps}, {step.tilt_steps}",
            "look": "looking",
        }[step.action]
        self._show(
            Progress(
                step.step,
                len(self.plan),
                sum(s.action == "look" for s in self.plan[: step.step]),
                sum(s.action == "look" for s in self.plan),
                sum(spot.status not in ("ok", "undetected") for spot in spots),
                self._retries,
                plan_seconds(self.rig, left),
                doing,
                "" if self._estimate is None or self._estimate.latest is None else self._estimate.latest.text,
            )
        )


def _approach(steps: int, names: tuple[str, str]) -> str:
    """The side from which an axis stands after homing and a move of so many steps.

    Homing itself ends in the negative sense, over more steps than any play.
    """
    if steps == 0:
        return names[1]
    name = names[0] if steps > 0 else names[1]
    assert APPROACH_SIGN[name] * steps > 0
    return name if abs(steps) >= CLEARED_STEPS or steps < 0 else "unknown"


def _shift_px(before: Spot, now: Sequence[float] | None) -> float | None:
    """Largest change of a coordinate since the reference, px."""
    if now is None:
        return None
    return round(max(abs(a - b) for a, b in zip(_pixels(before), now, strict=True)), 3)


def _pixels(spot: Spot) -> tuple[float, ...]:
    return tuple(float(v or 0.0) for v in (spot.u_left_px, spot.v_left_px, spot.u_right_px, spot.v_right_px))
