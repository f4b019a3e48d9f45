"""Formats of controllers and models: a table of what each can hold and how it is written.

A format holds a two-sided table, or one ratio with one play, or one ratio, or one period. The remaining errors are part
of the promise. Numbers have a decimal point in any locale.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from tvsbayes.compensation.correction import Correction
from tvsbayes.errors import InputError
from tvsbayes.results.compensation_record import AppliedBy, Compensation, TableRow

Holds = Literal["table", "ratio and play", "ratio", "period"]
LINUXCNC_DECIMALS = 7


@dataclass(frozen=True)
class Origin:
    """Origin of a file: `text` names program and folder, `data_sha256` is the hash of the folder's data."""

    text: str
    data_sha256: str


_UNCOMMENTED = re.compile(r"[^A-Za-z0-9 .,:=_+%/$\[\]-]")
"""Characters replaced in names: those that end a comment, control characters, non-ASCII."""


def plainly(text: str) -> str:
    """Return text from a file with characters that a comment may hold."""
    return _UNCOMMENTED.sub("_", text)


def number(value: float, digits: int = 9) -> str:
    """Format a number with this many digits, zero without a sign."""
    return f"{value + 0.0:.{digits}g}"


def stated(made: Compensation, origin: Origin) -> list[str]:
    """Return the first lines of every file: origin, sense of addition, remaining errors, limits of the format."""
    low, high = made.range_command
    unit = plainly(made.unit)
    lines = [
        f"compensation by {plainly(origin.text)}, data {origin.data_sha256[:16]}",
        f"table {made.table_id}: its promise is in results/, for tvsbayes verify --table",
        f"machine: {plainly(made.machine) or 'not named'}; unit {unit}",
        f"for commands from {number(low)} to {number(high)}",
        f"state when this was written: applied to nothing; apply it once, in one place; then {made.shown_by}",
        f"to be applied by the {made.applied_by}",
        f"aim: reading = {number(made.offset)} + {number(made.per_command)} x command",
        "sense: what is added to a command is (aim - reading expected) / (reading per command)",
    ]
    for side, left in made.sides.items():
        before = f"{left.without95:.3g} without"
        shift = ", but for one shift common to all," if made.shift_free and not made.in_motion else ""
        lines.append(f"promise, {side}: 95 % of errors{shift} at most {left.error95:.3g} {unit} ({before})")
        if made.shift_matters and left.error95_with_homing is not None:
            lines[-1] += f"; with the next homing, by its prior, {left.error95_with_homing:.3g}"
    if made.in_motion:
        lines.append(f"within {number(made.travel_command, 6)} commands, off the drive's own line, but for one shift")
    else:
        lines += [
            f"within {made.hours:.3g} h and {number(made.travel_command, 4)} commands of travel "
            f"{'since homing' if made.homings else 'after the campaign'}",
            f"arrive with at least {number(made.reversal_command, 4)} commands of travel on a side",
        ]
    return lines + [plainly(text) for text in made.unsaid]


def _commented(made: Compensation, origin: Origin) -> list[str]:
    return [f"# {line}" for line in stated(made, origin)]


CSV_COLUMNS = ("command", "forward", "backward", "u_forward", "u_backward")
PHASE_COLUMNS = ("phase", "add_forward", "add_backward", "u_forward", "u_backward")


def _csv(made: Compensation, origin: Origin) -> str:
    names = PHASE_COLUMNS if (period := made.settings.get("period_command")) else CSV_COLUMNS
    rows = [
        ",".join(number(v, d) for v, d in zip(_cells(made, row), (12, *[9] * 4), strict=True)) for row in made.table
    ]
    says = "# columns: reading expected at a command, arriving forward (rising command) or backward; standard"
    if period:
        says = f"# period: {number(period)} commands; columns: command within a period, what is added to it arriving"
        says += " forward (rising command) or backward; standard"
    says += " uncertainty of a single arrival"
    return "\n".join([*_commented(made, origin), says, ",".join(names), *rows, ""])


def _cells(made: Compensation, row: TableRow) -> tuple[float, ...]:
    if "period_command" in made.settings:
        return row.command, row.add_forward, row.add_backward, row.u_forward, row.u_backward
    return row.command, row.forward, row.backward, row.u_forward, row.u_backward


def _linuxcnc(made: Compensation, origin: Origin) -> str:
    """Write triplets nominal, forward, reverse with rising nominal; the controller subtracts entry minus nominal.

    LinuxCNC counts in units: nominal = per_command x command. If per_command is negative, forward and reverse are
    exchanged. Its reader stops at the first line that is not a triplet, so comments follow the table.
    """
    scale, rows = made.per_command, []
    for row in made.table:
        added = {"forward": scale * row.add_forward, "backward": scale * row.add_backward}
        ahead, back = ("forward", "backward") if scale > 0 else ("backward", "forward")
        # 0 has no sign in a file.
        nominal = scale * row.command + 0.0
        rows.append((nominal, nominal - added[ahead], nominal - added[back]))
    lines = [" ".join(f"{value:.{LINUXCNC_DECIMALS}f}" for value in values) for values in sorted(rows)]
    says = (
        "# in [JOINT_N]: COMP_FILE = this file, COMP_FILE_TYPE = 0; the play is in it: BACKLASH beside it is not used"
    )
    return "\n".join([*lines, *_commented(made, origin), says, ""])


def _grbl(made: Compensation, origin: Origin) -> str:
    lines = [f"{name}={value:.3f}" for name, value in made.settings.items()]
    return "\n".join([*(f"; {line}" for line in stated(made, origin)), *lines, ""])


def _klipper(made: Compensation, origin: Origin) -> str:
    lines = [f"rotation_distance: {made.settings['rotation_distance']:.6f}"]
    return "\n".join([*_commented(made, origin), "# in the section of the stepper:", *lines, ""])


def _header(made: Compensation, origin: Origin) -> str:
    said = "\n".join(f" * {line}" for line in stated(made, origin))
    arrays = []
    for name, field in (("command", "command"), ("forward", "add_forward"), ("backward", "add_backward")):
        values = ", ".join(_c_double(getattr(row, field)) for row in made.table)
        arrays.append(f"static const double axis_{name}[AXIS_ROWS] = {{{values}}};")
    text = HEADER
    if period := made.settings.get("period_command"):
        by_phase = PHASE_IN_C.replace("@PERIOD@", _c_double(period))
        text = text.replace("axis_sent", "axis_of_one_turn").replace("\n#endif\n", by_phase)
    return text.replace("@SAID@", said).replace("@ROWS@", str(len(made.table))).replace("@ARRAYS@", "\n".join(arrays))


def _c_double(value: float) -> str:
    text = number(value, 12)
    return text if set(text) & set(".en") else f"{text}.0"


HEADER = """/*
@SAID@
 */
#ifndef TVSBAYES_AXIS_COMPENSATION_H
#define TVSBAYES_AXIS_COMPENSATION_H

#define AXIS_ROWS @ROWS@
@ARRAYS@

/* What the mechanics are to get for a command; side: 1 arriving by a rising command, -1 by a falling one. */
static double axis_sent(double command, int side)
{
    const double *add = side < 0 ? axis_backward : axis_forward;
    int k = 0;
    if (command <= axis_command[0]) return command + add[0];
    if (command >= axis_command[AXIS_ROWS - 1]) return command + add[AXIS_ROWS - 1];
    while (command > axis_command[k + 1]) k++;
    return command + add[k] + (add[k + 1] - add[k]) * (command - axis_command[k])
                              / (axis_command[k + 1] - axis_command[k]);
}

#endif
"""
PHASE_IN_C = """
static const double axis_period = @PERIOD@;

/* The same for a command of any turn: what is added repeats with the period, in commands. */
static double axis_sent(double command, int side)
{
    double turns = (double)(long long)((command - axis_command[0]) / axis_period);
    double at = command - turns * axis_period;
    if (at < axis_command[0]) at += axis_period;
    return command - at + axis_of_one_turn(at, side);
}

#endif
"""


APPLIED_ONCE = (
    "a model that states axis_corrects with this value is corrected already: the same correction is not added again"
)


def _urdf(made: Compensation, origin: Origin) -> str:
    values = "\n".join(f'  <xacro:property name="{n}" value="{number(v, 12)}"/>' for n, v in made.settings.items())
    said = "\n".join(f"  {line.replace('--', '- -')}" for line in stated(made, origin))
    return f"""<?xml version="1.0"?>
<!--
{said}
  axis_zero: reading at command 0, to be taken off once, in the joint's origin or in the driver, not in both
  axis_reduction: commands per unit of reading, for <mechanicalReduction>
  axis_backlash: play between both sides, unit; u_...: standard uncertainties, covariance_...: of zero and reduction
  axis_corrects: SHA-256 of the data that it corrects; {APPLIED_ONCE}
-->
<robot xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:property name="axis_corrects" value="{origin.data_sha256}"/>
{values}
</robot>
"""


def _urdf_yaml(made: Compensation, origin: Origin) -> str:
    """Write the joint and its covariance for programs, in the unit of readings."""
    import yaml

    settings = made.settings
    variances = [settings["u_axis_zero"] ** 2, settings["u_axis_reduction"] ** 2]
    between = settings["covariance_zero_reduction"]
    document = {
        "axis_corrects": origin.data_sha256,
        "applied": False,
        "machine": plainly(made.machine),
        "unit": plainly(made.unit),
        "range_command": list(made.range_command),
        "joint": {
            "names": ["zero", "reduction"],
            "values": [settings["axis_zero"], settings["axis_reduction"]],
            "covariance": [[variances[0], between], [between, variances[1]]],
            "backlash": settings["axis_backlash"],
        },
        "left_after_applying_95": {
            side.removeprefix("arriving "): promise.error95 for side, promise in made.sides.items()
        },
    }
    said = [*_commented(made, origin), f"# axis_corrects: {APPLIED_ONCE}"]
    return "\n".join([*said, yaml.safe_dump(document, sort_keys=False)])


PHASES = 64
"""Number of lines of a period's table."""


def _pec(made: Compensation, origin: Origin) -> str:
    period, low = made.settings["period_command"], made.table[0].command
    phase = np.arange(PHASES) / PHASES
    at = low + (phase * period - low) % period
    added = Correction.of(made).sent(at, np.zeros(PHASES)) - at
    seconds, zero_s = made.settings.get("period_s"), made.settings.get("phase_0_s", 0.0)
    in_time = "" if seconds is None else f", {number(seconds, 6)} s"
    at_time = "" if seconds is None else f", {number(round(zero_s, 1), 6)} s after the log begins"
    lines = [f"# period: {number(period)} commands{in_time}; phase 0 at command 0{at_time}; add is in commands"]
    lines += ["phase,add"]
    lines += [f"{number(float(p), 6)},{number(float(a), 7)}" for p, a in zip(phase, added, strict=True)]
    return "\n".join([*_commented(made, origin), *lines, ""])


_REMARKS = re.compile(r"(?s)<!--.*?-->|/\*.*?\*/|^[ \t]*[#;][^\n]*$", re.MULTILINE)
_TABLE_ID = re.compile(r"\btable ([0-9a-f]{16}): its promise")


def content_digest(text: str) -> str:
    """SHA-256 of all that a file holds beside remarks and white space, by which one of 0.3.0, without id, is known."""
    return hashlib.sha256(" ".join(_REMARKS.sub("", text).split()).encode()).hexdigest()


def is_table_of(text: str, made: Compensation, data_sha256: str) -> bool:
    """Whether a file holds a table made of data with this hash: by its id, or by the digest of what it holds."""
    if named := _TABLE_ID.search(text):
        return named[1] == made.table_id
    return content_digest(text) == content_digest(FORMATS[made.target].write(made, Origin("", data_sha256)))


@dataclass(frozen=True)
class Format:
    """A format of compensation files.

    Attributes:
        holds: errors that it can represent.
        write: function that returns the content of the file from a compensation and its origin.
        zero_free: whether the zero is undetermined, by half of the play at a first move.
        in_force: name of the setting whose present value is changed, "" for none.
        unsaid: errors that it cannot correct, in words.
        beside: the same for a second file for programs, YAML; None for most formats.
        by_phase: whether it may hold what repeats with a period, over its phase.
    """

    holds: Holds
    write: Callable[[Compensation, Origin], str]
    zero_free: bool = False
    in_force: str = ""
    unsaid: tuple[str, ...] = ()
    beside: Callable[[Compensation, Origin], str] | None = None
    by_phase: bool = False


_NO_POSITION = "error by position remains: the format has no entry for it"
FORMATS: Mapping[str, Format] = {
    "csv": Format("table", _csv, by_phase=True),
    "linuxcnc": Format("table", _linuxcnc),
    "header": Format("table", _header, by_phase=True),
    # gnea/grbl, doc/markdown/settings.md: $100 to $102 are steps per mm; no setting compensates backlash.
    "grbl": Format(
        "ratio", _grbl, in_force="$100", unsaid=("grbl has no correction of play: all play remains", _NO_POSITION)
    ),
    # grblHAL core, settings.h: Setting_AxisBacklash is $160 and on, built in by ENABLE_BACKLASH_COMPENSATION.
    "grblhal": Format(
        "ratio and play",
        _grbl,
        zero_free=True,
        in_force="$100",
        unsaid=(
            "grblHAL has one play for all positions, and only where ENABLE_BACKLASH_COMPENSATION is built in",
            _NO_POSITION,
        ),
    ),
    # Klipper, Config_Reference.md: [stepper_x] rotation_distance; no option compensates backlash of a stepper.
    "klipper": Format(
        "ratio",
        _klipper,
        in_force="rotation_distance",
        unsaid=("Klipper has no correction of play: all play remains", _NO_POSITION),
    ),
    "urdf": Format(
        "ratio",
        _urdf,
        unsaid=("a URDF holds zero and ratio: play and error by position remain",),
        beside=_urdf_yaml,
    ),
    "pec": Format(
        "period",
        _pec,
        unsaid=("a table of one period holds no play, only errors that repeat with it",),
        by_phase=True,
    ),
}


@dataclass(frozen=True)
class Wish:
    """Options of a compensation; fields as the options of `compensate`.

    Attributes:
        target: name of the format in `FORMATS`.
        applied_by: who adds the corrections.
        per_command: aimed reading per command; None for that of `[axis]`, for 1 or -1 where commands are in the unit of
            readings, else for the fit's.
        resolution: least command that is carried out; 0 where it is fine.
        in_force: present value of the setting, for formats that change one.
        letter: letter of the axis in the settings of grbl: X, Y, Z, A, B or C.
        period: period of a table by phase, in commands; None: of pec that of the strongest wave, else no such table.
    """

    target: str = "csv"
    applied_by: AppliedBy = "controller"
    per_command: float | None = None
    resolution: float = 0.0
    in_force: float | None = None
    letter: str = "X"
    period: float | None = None


def checked(wish: Wish) -> Format:
    """Check the options and return the format.

    Raises:
        InputError: it is unknown, or a required number is missing or impossible.
    """
    form = FORMATS.get(wish.target)
    if form is None:
        allowed = ", ".join(FORMATS)
        remedy = f"name one of {allowed}"
        raise InputError("format", f"--to {wish.target[:60]!r}: unknown", allowed=allowed, remedy=remedy)
    if not (np.isfinite(wish.resolution) and wish.resolution >= 0):
        raise InputError("usage", f"--resolution {wish.resolution:g}", allowed="0 or more", remedy="give commands")
    if form.in_force and wish.in_force is None:
        message = f"--to {wish.target} changes a setting, and nothing says which value {form.in_force} has now"
        raise InputError("usage", message, remedy=f"add --in-force with the value of {form.in_force} in force")
    if wish.in_force is not None and not 0 < wish.in_force < np.inf:
        remedy = "give the value without a sign: which way the axis runs is another setting"
        raise InputError("usage", f"--in-force {wish.in_force:g}", allowed="more than 0", remedy=remedy)
    if wish.in_force is not None and not form.in_force:
        raise InputError("usage", f"--in-force is not for --to {wish.target}", remedy="leave it out")
    if wish.period is not None and not form.by_phase:
        raise InputError("usage", f"--to {wish.target} takes no --period", remedy="leave it out")
    return form
