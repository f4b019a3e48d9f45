"""A compensation with its promise, and its test on a machine: `results/compensation.json`, `verify --json`.

Commands in the campaign's counts; readings, errors and uncertainties in its unit.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

from msgspec import Meta, field, structs

from tvsbayes.display import Shown, View
from tvsbayes.results.records import (
    Count,
    HasFolder,
    NotNegative,
    Positive,
    Probability,
    Record,
    read_record,
    stored_document,
)
from tvsbayes.statistics.predicted_readings import frees_shift

COMPENSATION_FORMAT = "tvsbayes-compensation/1"
AIMED_FORMAT = "tvsbayes-aimed-promise/1"
"""Of `results/compensation.json` of a scanner or head."""
VERIFICATION_FORMAT = "tvsbayes-verification/1"
AppliedBy = Literal["controller", "host"]
Verdict = Literal["KEPT", "BROKEN", "CANNOT TELL"]
KEPT: Verdict = "KEPT"
BROKEN: Verdict = "BROKEN"
CANNOT_TELL: Verdict = "CANNOT TELL"
APPLIED, NOT_APPLIED, TWICE, WRONG_SIGN = "applied", "not applied", "applied twice", "wrong sign"
OTHER_MACHINE = "another machine"
WORLDS = (APPLIED, NOT_APPLIED, TWICE, WRONG_SIGN, OTHER_MACHINE)
"""Hypotheses on a table in use; the last also stands for a machine that changed."""
CAUSES = ("table", "format", "stops", "homing", "drift", "creep", "temperature", "travel", "readings")
"""Causes of the errors that remain after applying: uncertainty of the table, resolution of the format, scatter of stops
and of homings, the walk of the zero since the last homing, its creep, its shift with the temperature and, by a contrast
of the directions, with the travel, each off the table's state, and scatter of the readings that verify it."""


class TableRow(Record, frozen=True):
    """A command and the readings expected there.

    Attributes:
        command: the commanded position.
        forward, backward: reading expected without compensation, arriving by a rising or a falling command.
        u_forward, u_backward: standard uncertainty of a single arrival.
        add_forward, add_backward: corrections that the format adds to the command.
    """

    command: float
    forward: float
    backward: float
    u_forward: NotNegative
    u_backward: NotNegative
    add_forward: float
    add_backward: float


class SidePromise(Record, frozen=True, omit_defaults=True):
    """Errors that remain after applying, for readings from one side within the range, over posterior and use.

    Attributes:
        error95: 95 % of errors are at most this size, either sign; after removing one common shift where one homing
            was read, or the format leaves the zero open.
        rms: root mean square of the same errors.
        without95: `error95` without compensation.
        causes: error that each cause alone would leave, 95 %.
        shift_free95: `error95` of errors after removing one common shift, as within one homing; None in older
            files.
        error95_with_homing: the same with the next homing's error; None in files of 0.3, whose `error95` is that.
    """

    error95: NotNegative
    rms: NotNegative
    without95: NotNegative
    causes: dict[str, NotNegative]
    shift_free95: NotNegative | None = None
    error95_with_homing: NotNegative | None = None


type Sides = Annotated[dict[str, SidePromise], Meta(extra_json_schema={"required": ("forward", "backward")})]


class Compensation(Shown, Record, frozen=True, kw_only=True, omit_defaults=True):
    """A two-sided table for one controller, and the promised bound of the errors that remain after applying it.

    Attributes:
        target: format, as in `--to`.
        machine: name or serial number, as in `campaign.toml`.
        unit: unit of the readings.
        applied_by: what adds the corrections: the controller itself, or the program that commands it.
        per_command, offset: the target line: reading = offset + per_command x command.
        zero_free: the format leaves the zero open: one shift, common to all errors, does not count.
        range_command: commands between which the promise holds.
        resolution: least command that the controller carries out; 0 where it is fine.
        reversal_command: travel, in commands, after which an arrival is on one side whatever came before.
        hours, travel_command: limits since homing for which the promise holds: the campaign's longest segment.
        homings: number whose zeros the campaign read; with 1 the promise is of errors less one common shift, since the
            prior alone determines the scatter of homings; with 0, of an encoder that keeps its zero, of all.
        table: rows by increasing command.
        settings: numbers of formats that hold no table, by name.
        promise: promised errors, by side.
        unsaid: corrections that the format cannot express, in words.
        state: state of the table, for all commands: hours and travel since the homing, `warm_hours` since the machine
            was switched on, `kelvin` less the temperature of the campaign's first move; empty in files of 0.3.
        kelvin: range of temperatures of the promise, less that of the first move; None where none was recorded.
        text: content of the file; not part of the document.
    """

    target: str
    machine: str
    unit: str
    applied_by: AppliedBy
    per_command: float
    offset: float
    zero_free: bool
    range_command: tuple[float, float]
    resolution: NotNegative
    reversal_command: NotNegative
    hours: NotNegative
    travel_command: NotNegative
    homings: Count
    table: Annotated[tuple[TableRow, ...], Meta(min_length=2)]
    settings: dict[str, float]
    promise: Sides
    unsaid: tuple[str, ...]
    state: dict[str, float] = field(default_factory=dict)
    kelvin: tuple[float, float] | None = None
    text: str = ""
    beside: ClassVar = ("text",)

    @property
    def digest(self) -> str:
        """Hash of table and promise, by which a verification identifies them."""
        return hashlib.sha256(json.dumps(self.as_json(), sort_keys=True).encode()).hexdigest()

    @property
    def table_id(self) -> str:
        """The id in the file, the beginning of `digest`."""
        return self.digest[:16]

    @property
    def in_motion(self) -> bool:
        """Whether the table is one period of a drive at constant rate, which never reverses."""
        return self.reversal_command == 0 and "period_command" in self.settings

    @property
    def sides(self) -> dict[str, SidePromise]:
        """The promise by kind of motion, in words: by side of arrival, of a drive once.

        Those of 0.3 are read as later ones: `error95` less one shift where `shift_free`.
        """
        if self.in_motion:
            return {"while it drives": self.promise["forward"]}
        sides = {}
        for side, promise in self.promise.items():
            if promise.error95_with_homing is None and promise.shift_free95 is not None:
                first = promise.shift_free95 if self.shift_free else promise.error95
                promise = structs.replace(promise, error95=first, error95_with_homing=promise.error95)
            sides[f"arriving {side}"] = promise
        return sides

    @property
    def shift_matters(self) -> bool:
        """Whether nothing but a prior tells how homings scatter: the promise is of errors less one common shift."""
        return frees_shift(self.homings) and not self.in_motion and not self.zero_free

    @property
    def shift_free(self) -> bool:
        """Whether one shift common to all readings does not count in a verification."""
        return self.zero_free or self.shift_matters

    @property
    def shown_by(self) -> str:
        """The readings that test whether the promise is kept."""
        if self.in_motion:
            return "log again and run tvsbayes fit: its wave of this period is what is left"
        return "take fresh readings and run tvsbayes verify"

    def shown(self) -> View:
        """Show the table."""
        rows = [(r.command, r.forward, r.backward, r.u_forward, r.u_backward) for r in self.table]
        left = ", ".join(f"{side} {promise.error95:.3g}" for side, promise in self.sides.items())
        title = f"Compensation for {self.target}: left after applying, 95 %: {left} {self.unit}"
        return View(title, ("command", "forward", "backward", "u_forward", "u_backward"), rows)


class AimedPromise(Shown, Record, frozen=True, kw_only=True, omit_defaults=True):
    """The promised bound of the pointing errors of a scanner or head that is aimed by its calibration.

    Attributes:
        target: "header", whose counters are those of `steps-for`, or "urdf".
        machine: name or serial number, as in `campaign.toml`.
        unit: unit of errors, "deg" of a mirror or joint: the turn of the axis that moves the beam as far, seen from
            where looks are seen, at their distance.
        table: SHA-256 of the calibration as JSON.
        range_steps: counters of each axis between which the promise holds, those of the looks.
        reversal_steps: travel of each axis, steps, after which an arrival is on one side whatever came before.
        hours, travel_steps: limits since homing for which the promise holds, travel by axis: the campaign's longest
            segment.
        homings: number whose zeros the campaign saw, by axis; with 1 the promise of an axis is of errors less one
            common shift, with 0, of an encoder that keeps its zero, of all.
        promise: promised errors by side; none of an axis that never moved.
        unsaid: corrections that the format cannot express, in words.
        state: state of the calibration by axis, as in `Compensation`; `travel` in steps.
        kelvin: range of temperatures of the promise, less that of the first move; None where none was recorded.
    """

    target: str
    machine: str
    unit: str
    table: str
    range_steps: dict[str, tuple[float, float]]
    reversal_steps: dict[str, Count]
    hours: NotNegative
    travel_steps: dict[str, NotNegative]
    homings: dict[str, Count]
    promise: dict[str, SidePromise]
    unsaid: tuple[str, ...]
    state: dict[str, dict[str, float]]
    kelvin: tuple[float, float] | None = None
    in_motion: ClassVar = False

    @property
    def sides(self) -> dict[str, SidePromise]:
        """The promise by side of arrival."""
        return self.promise

    @property
    def free_axes(self) -> tuple[str, ...]:
        """Axes whose promise is of errors less one shift common to all, since nothing but a prior tells their zero."""
        return tuple(axis for axis, count in self.homings.items() if frees_shift(count))

    def shown(self) -> View:
        """Show the promise."""
        rows = [(side, each.without95, each.error95, each.error95_with_homing) for side, each in self.promise.items()]
        title = f"Promise of a calibration ({self.target}): 95 % of errors, {self.unit}"
        return View(title, ("arriving", "without", "after", "with homing"), rows)


class ErrorSize(Record, frozen=True):
    """Root mean square and largest size of errors."""

    rms: NotNegative
    worst: NotNegative


class ShiftFree(Record, frozen=True):
    """Errors of fresh readings less their mean, and the size that 95 % of them have at most by the promise."""

    after: ErrorSize
    promised95: Positive


class Millimetres(Record, frozen=True):
    """Errors of the points of a scanner, at a distance along the beam.

    Attributes:
        distance_mm: distance along the beam.
        before, after, promised95: as in the verification, mm across all directions.
    """

    distance_mm: Positive
    before: ErrorSize
    after: ErrorSize
    promised95: Positive


class Verification(Shown, Record, frozen=True, kw_only=True, omit_defaults=True):
    """Test of a promise by fresh readings of an axis with its table in force, or fresh looks aimed by a calibration.

    Attributes:
        verdict: `KEPT`, `BROKEN` or `CANNOT_TELL`.
        p: probability of deviations this large if the table was applied to this machine as promised.
        worlds: probability of each hypothesis of `WORLDS`.
        before: errors of the same stops without the table, as predicted from the campaign.
        after: errors of the fresh readings.
        promised95: 95 % of errors of these stops are at most this size, by the promise; this, `before`, `after` and `p`
            are of errors less one shift common to all where one homing was read.
        readings: number used; for a scanner looks, each of which shows both axes.
        millimetres: the same for points; only for a scanner.
        shift_free: `after` and `promised95` again, the name of 0.3; None where the scatter of homings was read.
        after_with_homing, promised95_with_homing: the same with the error of the homing; None as `shift_free`.
        unit: unit of errors; it and what follows are not part of the document.
        needed: readings needed for a verdict; None where no number suffices, 0 where these do.
        remarks: further remarks, in sentences.
        looks: whether these are looks of two axes aimed by a calibration.
    """

    verdict: Verdict
    p: Probability
    worlds: Annotated[dict[str, Probability], Meta(extra_json_schema={"required": WORLDS})]
    before: ErrorSize
    after: ErrorSize
    promised95: Positive
    readings: Count
    millimetres: Millimetres | None = None
    shift_free: ShiftFree | None = None
    after_with_homing: ErrorSize | None = None
    promised95_with_homing: Positive | None = None
    unit: str = ""
    needed: int | None = 0
    remarks: tuple[str, ...] = ()
    looks: bool = False
    beside: ClassVar = ("unit", "needed", "remarks", "looks")

    @property
    def world(self) -> str:
        """The most probable hypothesis."""
        return max(self.worlds, key=lambda name: self.worlds[name])

    def shown(self) -> View:
        """Show the probabilities of the hypotheses."""
        title = f"Verification: {self.verdict}, p = {self.p:.3g}"
        return View(title, ("world", "probability"), list(self.worlds.items()))


def stored_verification(campaign: HasFolder, inputs: Mapping[str, str], table: str, unit: str) -> Verification | None:
    """The last result of `verify`; None without one, or where it belongs to other data or another table.

    Args:
        campaign: campaign whose folder contains it.
        inputs: hashes of the campaign's data.
        table: digest of the table or calibration in force.
        unit: unit of errors.

    Raises:
        InputError: the file is damaged.
    """
    keys = stored_document(campaign, "verification.json", (VERIFICATION_FORMAT,), inputs)
    if keys is None or keys.values.get("table") != table:
        return None
    return structs.replace(read_record(Verification, keys, "run `tvsbayes verify` again"), unit=unit)
