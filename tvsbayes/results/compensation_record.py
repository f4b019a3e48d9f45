"""A compensation and its promise, and whether a machine keeps it: `results/compensation.json`, `verify --json`.

Commands as the campaign counts them; readings, errors and uncertainties in its unit.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

from msgspec import Meta, structs

from tvsbayes.display import Shown, View
from tvsbayes.results.records import (
    Count,
    FromOne,
    HasFolder,
    NotNegative,
    Positive,
    Probability,
    Record,
    read_record,
    stored_document,
)

COMPENSATION_FORMAT = "tvsbayes-compensation/1"
VERIFICATION_FORMAT = "tvsbayes-verification/1"
AppliedBy = Literal["controller", "host"]
Verdict = Literal["KEPT", "BROKEN", "CANNOT TELL"]
KEPT: Verdict = "KEPT"
BROKEN: Verdict = "BROKEN"
CANNOT_TELL: Verdict = "CANNOT TELL"
APPLIED, NOT_APPLIED, TWICE, WRONG_SIGN = "applied", "not applied", "applied twice", "wrong sign"
OTHER_MACHINE = "another machine"
WORLDS = (APPLIED, NOT_APPLIED, TWICE, WRONG_SIGN, OTHER_MACHINE)
"""What may have become of a table; the last also stands for a machine that changed."""
CAUSES = ("table", "format", "stops", "homing", "drift", "readings")
"""Of what is left after applying: uncertainty of the table itself, what the format cannot hold, scatter of stops, of
homings, the walk of the zero since the last one, scatter of the readings that verify it."""


class TableRow(Record, frozen=True):
    """A command and what is expected there.

    Attributes:
        command: asked for.
        forward, backward: reading expected without compensation, arriving by a rising or a falling command.
        u_forward, u_backward: standard uncertainty of a single arrival.
        add_forward, add_backward: what the format adds to the command.
    """

    command: float
    forward: float
    backward: float
    u_forward: NotNegative
    u_backward: NotNegative
    add_forward: float
    add_backward: float


class SidePromise(Record, frozen=True):
    """What is left after applying, of readings of one side within the range.

    Attributes:
        error95: 95 % of errors are at most so large, either sign.
        rms: root mean square of the errors expected.
        without95: `error95` if nothing is applied.
        causes: what each cause alone would leave, 95 %.
        shift_free95: `error95` of errors but for one shift common to all, as within one homing; None in older
            files.
    """

    error95: NotNegative
    rms: NotNegative
    without95: NotNegative
    causes: dict[str, NotNegative]
    shift_free95: NotNegative | None = None


type Sides = Annotated[dict[str, SidePromise], Meta(extra_json_schema={"required": ("forward", "backward")})]


class Compensation(Shown, Record, frozen=True, kw_only=True):
    """A two-sided table for one controller, and the promise of what is left after applying it.

    Attributes:
        target: format, as `--to` has it.
        machine: name or serial number, as `campaign.toml` has it.
        unit: of readings.
        applied_by: who adds the corrections: the controller by itself, or the program that commands it.
        per_command, offset: the line that is aimed at: reading = offset + per_command x command.
        zero_free: the format leaves the zero open: errors count but for one shift, common to all.
        range_command: the promise holds between these commands.
        resolution: least command that the controller carries out; 0 where it is fine.
        reversal_command: travel, in commands, that arrives on a side whatever came before.
        hours, travel_command: since homing, for which the promise holds: the campaign's longest segment.
        homings: in the campaign; of one alone, the scatter of homings is known by its prior.
        table: by rising command.
        settings: numbers of formats that hold no table, by name.
        promise: by side.
        unsaid: what the format cannot say, in words.
        text: content of the file; no part of the document.
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
    homings: FromOne
    table: Annotated[tuple[TableRow, ...], Meta(min_length=2)]
    settings: dict[str, float]
    promise: Sides
    unsaid: tuple[str, ...]
    text: str = ""
    beside: ClassVar = ("text",)

    @property
    def digest(self) -> str:
        """Of table and promise, so that a verification knows of which it is."""
        return hashlib.sha256(json.dumps(self.as_json(), sort_keys=True).encode()).hexdigest()

    @property
    def in_motion(self) -> bool:
        """Whether it is of a drive at constant rate, which never turns back: a table of one period."""
        return self.reversal_command == 0 and "period_command" in self.settings

    @property
    def shown_by(self) -> str:
        """What shows whether the promise is kept."""
        if self.in_motion:
            return "log again and run tvsbayes fit: its wave of this period is what is left"
        return "take fresh readings and run tvsbayes verify"

    def shown(self) -> View:
        """The table."""
        rows = [(r.command, r.forward, r.backward, r.u_forward, r.u_backward) for r in self.table]
        left = ", ".join(f"{side} {self.promise[side].error95:.3g}" for side in ("forward", "backward"))
        title = f"Compensation for {self.target}: left after applying, 95 %: {left} {self.unit}"
        return View(title, ("command", "forward", "backward", "u_forward", "u_backward"), rows)


class ErrorSize(Record, frozen=True):
    """Root mean square and largest size of errors."""

    rms: NotNegative
    worst: NotNegative


class Millimetres(Record, frozen=True):
    """Errors of the points of a scanner, at a distance along the beam.

    Attributes:
        distance_mm: along the beam.
        before, after, promised95: as in the verification, mm across all directions.
    """

    distance_mm: Positive
    before: ErrorSize
    after: ErrorSize
    promised95: Positive


class Verification(Shown, Record, frozen=True, kw_only=True):
    """Fresh readings of an axis under a table in force, or fresh looks of a scanner that its calibration aimed.

    Attributes:
        verdict: `KEPT`, `BROKEN` or `CANNOT_TELL`.
        p: probability of readings this far off, if the table was applied to this machine as promised.
        worlds: probability of each of `WORLDS`.
        before: errors that the same stops would have without the table, as the campaign expects them.
        after: errors of the fresh readings.
        promised95: 95 % of errors are at most so large, of these stops, by the promise.
        readings: how many were used; of a scanner looks, each of which shows both axes.
        millimetres: the same of points; of a scanner alone.
        unit: of errors; with `needed`, `remarks` and `looks` no part of the document.
        needed: readings that would tell; None where no number does, 0 where these do.
        remarks: what else is to be said, in sentences.
        looks: these are looks of two axes that a calibration aimed.
    """

    verdict: Verdict
    p: Probability
    worlds: Annotated[dict[str, Probability], Meta(extra_json_schema={"required": WORLDS})]
    before: ErrorSize
    after: ErrorSize
    promised95: Positive
    readings: Count
    millimetres: Millimetres | None = None
    unit: str = ""
    needed: int | None = 0
    remarks: tuple[str, ...] = ()
    looks: bool = False
    beside: ClassVar = ("unit", "needed", "remarks", "looks")

    def as_json(self) -> dict[str, Any]:
        """The document; an axis has no points."""
        return {key: value for key, value in super().as_json().items() if key != "millimetres" or value is not None}

    @property
    def world(self) -> str:
        """The most probable one."""
        return max(self.worlds, key=lambda name: self.worlds[name])

    def shown(self) -> View:
        """Probabilities of the worlds."""
        title = f"Verification: {self.verdict}, p = {self.p:.3g}"
        return View(title, ("world", "probability"), list(self.worlds.items()))


def stored_verification(campaign: HasFolder, inputs: Mapping[str, str], table: str, unit: str) -> Verification | None:
    """What `verify` said last; None where it has not, or of other data or another table.

    Args:
        campaign: whose folder it lies in.
        inputs: hashes of its data.
        table: digest of the table or calibration in force.
        unit: of errors.

    Raises:
        InputError: it is damaged.
    """
    keys = stored_document(campaign, "verification.json", (VERIFICATION_FORMAT,), inputs)
    if keys is None or keys.values.get("table") != table:
        return None
    return structs.replace(read_record(Verification, keys, "run `tvsbayes verify` again"), unit=unit)
