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
from tvsbayes.files.templates import filled
from tvsbayes.results.compensation_record import AppliedBy, Compensation

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


CSV_COLUMNS = ("command", "forward", "backward", "u_forward", "u_backward")
APPLIED_ONCE = (
    "a model that states axis_corrects with this value is corrected already: the same correction is not added again"
)
PHASES = 64
"""Number of lines of a period's table."""


def _stated(made: Compensation, origin: Origin) -> list[str]:
    """First lines of every file: origin, sense of addition, remaining errors, limits of the format."""
    return filled("compensation/said", made=made, origin=origin, plain=plainly, number=number).splitlines()


def _by(template: str) -> Callable[[Compensation, Origin], str]:
    """What writes a file by a template in `data/export/compensation`."""

    def written(made: Compensation, origin: Origin) -> str:
        return filled(
            f"compensation/{template}",
            made=made,
            origin=origin,
            said=_stated(made, origin),
            period=made.settings.get("period_command"),
            number=number,
            triplets=_triplets,
            phases=_phases,
            applied_once=APPLIED_ONCE,
        )

    return written


def _triplets(made: Compensation) -> list[tuple[float, float, float]]:
    """Triplets nominal, forward, reverse with rising nominal; LinuxCNC subtracts entry minus nominal.

    It counts in units: nominal = per_command x command. If per_command is negative, forward and reverse are exchanged.
    Its reader stops at the first line that is not a triplet, so comments follow the table.
    """
    scale, rows = made.per_command, []
    for row in made.table:
        # 0 has no sign in a file.
        nominal = scale * row.command + 0.0
        sides = (row.add_forward, row.add_backward) if scale > 0 else (row.add_backward, row.add_forward)
        rows.append((nominal, nominal - scale * sides[0], nominal - scale * sides[1]))
    return sorted(rows)


def _phases(made: Compensation) -> list[tuple[float, float]]:
    """Phases of a period and what is added there."""
    period, low, phase = made.settings["period_command"], made.table[0].command, np.arange(PHASES) / PHASES
    at = low + (phase * period - low) % period
    added = Correction.of(made).sent(at, np.zeros(PHASES)) - at
    return list(zip(phase.tolist(), added.tolist(), strict=True))


def _urdf_yaml(made: Compensation, origin: Origin) -> str:
    """Write the joint and its covariance for programs, in the unit of readings."""
    import yaml

    settings, between = made.settings, made.settings["covariance_zero_reduction"]
    document = {
        "axis_corrects": origin.data_sha256,
        "applied": False,
        "machine": plainly(made.machine),
        "unit": plainly(made.unit),
        "range_command": list(made.range_command),
        "joint": {
            "names": ["zero", "reduction"],
            "values": [settings["axis_zero"], settings["axis_reduction"]],
            "covariance": [[settings["u_axis_zero"] ** 2, between], [between, settings["u_axis_reduction"] ** 2]],
            "backlash": settings["axis_backlash"],
        },
        "left_after_applying_95": {
            side.removeprefix("arriving "): promise.error95 for side, promise in made.sides.items()
        },
    }
    said = [*_stated(made, origin), f"axis_corrects: {APPLIED_ONCE}"]
    return "\n".join([*(f"# {line}" for line in said), yaml.safe_dump(document, sort_keys=False)])


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
    "csv": Format("table", _by("csv"), by_phase=True),
    "linuxcnc": Format("table", _by("linuxcnc")),
    "header": Format("table", _by("header"), by_phase=True),
    # gnea/grbl, doc/markdown/settings.md: $100 to $102 are steps per mm; no setting compensates backlash.
    "grbl": Format(
        "ratio", _by("grbl"), in_force="$100", unsaid=("grbl has no correction of play: all play remains", _NO_POSITION)
    ),
    # grblHAL core, settings.h: Setting_AxisBacklash is $160 and on, built in by ENABLE_BACKLASH_COMPENSATION.
    "grblhal": Format(
        "ratio and play",
        _by("grbl"),
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
        _by("klipper"),
        in_force="rotation_distance",
        unsaid=("Klipper has no correction of play: all play remains", _NO_POSITION),
    ),
    "urdf": Format(
        "ratio",
        _by("urdf"),
        unsaid=("a URDF holds zero and ratio: play and error by position remain",),
        beside=_urdf_yaml,
    ),
    "pec": Format(
        "period",
        _by("pec"),
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
