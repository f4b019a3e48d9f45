"""One geared axis and its readings: `campaign.toml`, `moves.csv`, `readings.csv` of an axis folder.

Readings in the unit that the folder states, commands in steps or the controller's own unit; s. Columns are
found by name. No JAX.
"""

from __future__ import annotations

import datetime
import hashlib
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, fields, replace
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from tvsbayes.display import Shown, View
from tvsbayes.files.csv_kind import (
    Column,
    CsvKind,
    Values,
    filled_where_ok,
    first_of_segment,
    follows_a_move,
    templates,
    unique,
)
from tvsbayes.files.csv_table import CSV_BYTES_MAX, Table, csv_bytes
from tvsbayes.files.disk import read_bytes, require_campaign_folder, write_folder
from tvsbayes.files.documents import TOML_BYTES_MAX, Keys, Kind, StatedValue, is_number, parse_toml, toml_text
from tvsbayes.instrument.campaign import MOVES, SPOTS, TEMPERATURES_DEGC
from tvsbayes.instrument.campaign_header import ENVIRONMENT, ORIGIN, PEOPLE, TIMES, header_of, header_values
from tvsbayes.instrument.conditions import powered_on_s
from tvsbayes.instrument.copies import refuse_copied
from tvsbayes.single_axis.axis_parameters import AXIS_KEYS, AxisPrior
from tvsbayes.single_axis.waves import WavePeriods

FORMAT = "tvsbayes-axis/1"
Approach = Literal["forward", "backward", "unknown"]
"""Forward means an increasing command, for either sign of the unit per command."""
UNIT_CHARS_MAX = 20
COMMAND_MAX = 1e12
"""Largest absolute command or reading."""
DEGREES = {
    **{"deg": 1.0, "rad": math.degrees(1.0), "mrad": math.degrees(1e-3), "urad": math.degrees(1e-6)},
    **{"arcmin": 1 / 60, "arcsec": 1 / 3600, "gon": 0.9},
}
"""Units of angle of readings, in deg."""
TURNS = {**{unit: 360.0 / in_deg for unit, in_deg in DEGREES.items()}, "turn": 1.0}
"""One turn in each unit of angle."""
REFERENCE, COMMON = "reference", "common"
"""Table of what reads the axis; its word for a u of readings.csv that is one error of all readings."""
NO_EXPANSION, EXPANSION_MAX = StatedValue(0.0, 0.0), 1e-2
"""Largest relative expansion, 1/K."""
_NEVER_ZERO = ("transmission_error_length", "reading_scale", "creep_minutes", "seeing_s")
"""Log-normal parameters by which the model divides: the density is undefined where they are fixed at 0."""
PERIODS_MAX, RANGES_MAX = 8, 4
"""Largest numbers of stated and of unknown periods; each period adds two sampled coordinates."""


@dataclass(frozen=True, slots=True)
class AxisMove:
    """A row of `moves.csv`: the command AFTER the move; `approach` in the first row of a segment, else empty."""

    move: Annotated[int, MOVES["move"]]
    segment: Annotated[int, MOVES["segment"]]
    time_s: Annotated[float, MOVES["time_s"]]
    command: Annotated[
        float,
        Column(
            "absolute counter or commanded position AFTER the move; decimals allowed",
            *(-COMMAND_MAX, COMMAND_MAX),
        ),
    ]
    approach: Annotated[
        Approach | Literal[""],
        Column(
            "in the first row of a segment: `forward` (rising command), `backward` or `unknown`; empty elsewhere",
            rule=first_of_segment,
        ),
    ] = ""
    temperature_degC: Annotated[
        float | None,
        Column(
            "optional: of the axis; the readings' zero shifts with it. Empty cells are interpolated in time",
            *TEMPERATURES_DEGC,
            group="temperature",
        ),
    ] = None
    assumed: Annotated[int, MOVES["assumed"]] = 0


@dataclass(frozen=True, slots=True)
class Reading:
    """A row of `readings.csv`: value and standard uncertainty in the folder's unit; u = 0 means unknown.

    `value` is a number where `status` is "ok", else it may be None.
    """

    reading: Annotated[int, Column("unique id", rule=unique)]
    move: Annotated[int, Column("the last move before it")]
    value: Annotated[
        float | None,
        Column(
            "in `unit`; angles without jumps of a whole turn (those are refused: add or subtract a turn, as `import` "
            "does)",
            *(-COMMAND_MAX, COMMAND_MAX),
            rule=filled_where_ok("give the value, or say why there is none"),
        ),
    ] = None
    u: Annotated[
        float,
        Column(
            "standard uncertainty; empty or 0 where unknown: readings repeated at one move then determine it, else "
            "the scatter of stops includes it",
            *(0.0, COMMAND_MAX),
        ),
    ] = 0.0
    status: Annotated[
        str,
        replace(SPOTS["status"], meaning="`ok`, or why the reading is not to be used (`value` may be empty)"),
    ] = "ok"
    time_s: Annotated[
        float | None,
        Column(
            "of a reading in motion, in a folder with `rate`: seconds, on the clock of moves.csv, not before its move",
            *(MOVES["time_s"].low, MOVES["time_s"].high),
            group="motion",
        ),
    ] = None


AXIS_MOVES = CsvKind(
    AxisMove,
    "moves.csv",
    "a row after every move, in time order",
    ("at least one row", "write row 0: the command and the approach to the first stop"),
    [AxisMove(0, 0, 0.0, 0, "unknown")],
)
READINGS = CsvKind(Reading, "readings.csv", "a row for every reading")


CERTIFIED = ("certificate", "valid_until")
"""Entries of `[reference]` on which no estimate depends."""


@dataclass(frozen=True)
class Reference:
    """What `[reference]` states of what reads the axis: uncertainties common to all its readings.

    A reading errs by u, by u_per_unit times the reading, by an error of the expansion times reading and temperature
    less 20 degC, and with `u_is = "common"` by its stated u, each times one normal number for the folder (formulation
    8.6). The unit is that of the readings; degC.

    Attributes:
        u: standard uncertainty of an offset of all readings, unit.
        u_per_unit: standard uncertainty of the scale, relative.
        expansion_per_K: relative expansion of the reference: a reading r at T means r (1 + expansion (T - 20 degC)).
        u_is: whether the u of readings.csv is one error of all readings, `COMMON`, or noise of each.
        certificate: name of its certificate, "" where not stated.
        valid_until: last day of its validity.
    """

    u: float = 0.0
    u_per_unit: float = 0.0
    expansion_per_K: StatedValue = NO_EXPANSION
    u_is: str = "independent"
    certificate: str = ""
    valid_until: datetime.date | None = None

    @property
    def expands(self) -> bool:
        """Whether its readings depend on the temperature."""
        return self.expansion_per_K != NO_EXPANSION

    @property
    def common(self) -> bool:
        """Whether the u of readings.csv is one error of all readings."""
        return self.u_is == COMMON

    @property
    def entries(self) -> dict[str, object]:
        """The entries of `[reference]`."""
        return {f.name: value for f in fields(self) if (value := getattr(self, f.name)) != f.default}


@dataclass(frozen=True, repr=False)
class AxisCampaign(Shown):
    """An axis folder, checked.

    Attributes:
        unit: unit of the readings.
        moves: moves in time order.
        readings: readings in the order of the file.
        stated: entries of `[axis]`; omitted names take the default, which scales with the travel.
        header: keys of `campaign.toml` outside `[axis]` but `format` and `unit`.
        periods: waves that `[axis]` defines.
        limits: lowest and highest command that a plan may give, as `[axis]` states them; None where it does not.
        path: the folder; None where it was never written.
        absolute: whether the encoder keeps its zero over a homing.
        command_unit: unit of the commands; None where `[axis]` does not state it.
        reference: what `[reference]` states.
    """

    unit: str
    moves: tuple[AxisMove, ...]
    readings: tuple[Reading, ...]
    stated: dict[str, AxisPrior] = field(default_factory=dict)
    header: dict[str, object] = field(default_factory=dict)
    periods: WavePeriods = field(default_factory=WavePeriods)
    path: Path | None = None
    absolute: bool = False
    limits: tuple[float, float] | None = None
    command_unit: str | None = None
    reference: Reference = field(default_factory=Reference)

    @property
    def noisy(self) -> tuple[Reading, ...]:
        """Readings with the u of their own noise: 0, unknown, where the stated one is common to all."""
        return tuple(replace(r, u=0.0) for r in self.readings) if self.reference.common else self.readings

    @property
    def priors(self) -> dict[str, AxisPrior]:
        """Stated priors; a zero that no homing sets has no scatter of homings."""
        return {**self.stated, "home_sd": AxisPrior(0.0, 0.0)} if self.absolute else self.stated

    @property
    def rate(self) -> float | None:
        """Commands per second of a drive in continuous motion; None where the axis is read at stops."""
        rate = self.header.get("rate")
        return float(rate) if isinstance(rate, int | float) else None

    @property
    def range_allowed(self) -> tuple[float, float]:
        """Lowest and highest command of plans and their run-ups: stated, else those that were really made."""
        made = [move.command for move in self.moves if not move.assumed]
        return self.limits or (min(made), max(made))

    @property
    def powered_on_s(self) -> float | None:
        """When the machine was switched on, on the clock of `time_s`; None where unknown."""
        return powered_on_s(self.header)

    def shown(self) -> View:
        """Show counts, and the readings with their commands."""
        command_of = {move.move: move.command for move in self.moves}
        ok = sum(reading.status == "ok" for reading in self.readings)
        title = f"AxisCampaign in {self.unit}: {len(self.moves)} moves, {len(self.readings)} readings ({ok} ok)"
        rows = [(r.reading, r.move, command_of.get(r.move), r.value, r.u, r.status) for r in self.readings]
        return View(
            title, ("reading", "move", "command", f"value, {self.unit}", f"u, {self.unit}", "status"), rows, most=5
        )


_FILES = {"moves.csv": CSV_BYTES_MAX, "readings.csv": CSV_BYTES_MAX, "campaign.toml": TOML_BYTES_MAX}
"""campaign.toml is written last: a folder without it is incomplete."""


def parse_axis_moves(data: bytes, file: str = "moves.csv") -> tuple[AxisMove, ...]:
    """The checked rows of `moves.csv`; at least one."""
    return AXIS_MOVES.parse(data, file)


def parse_readings(
    data: bytes, moves: int, move_rows: tuple[AxisMove, ...] = (), in_motion: bool = False
) -> tuple[Reading, ...]:
    """The checked rows of `readings.csv`.

    Args:
        data: content of the file.
        moves: number of moves, which `move` must name.
        move_rows: the moves, where readings were taken `in_motion`: each ok reading then has its time.
        in_motion: whether the folder states a `rate`.
    """
    return READINGS.parse(data, READINGS.file, follows_a_move(moves, "reading"), _times_in_motion(move_rows, in_motion))


def _times_in_motion(moves: tuple[AxisMove, ...], in_motion: bool) -> Callable[[Table, Values], None]:
    """Refuse times of readings at stops, and readings in motion without a time between their move and the next."""

    def check(table: Table, values: Values) -> None:
        for row, (time_s, move, status) in enumerate(
            zip(values["time_s"], values["move"], values["status"], strict=True)
        ):
            if not in_motion and time_s is not None:
                allowed = "an empty cell, or no such column, where campaign.toml states no rate"
                raise table.refuse(row, "time_s", "motion", allowed, "state `rate` in campaign.toml, or remove it")
            if in_motion and time_s is None and status == "ok":
                allowed = "the time of every reading that is ok, since campaign.toml states a rate"
                place = "time_s" if "time_s" in table.columns else "reading"
                raise table.refuse(row, place, "motion", allowed, "add time_s, or remove `rate`")
            if in_motion and time_s is not None:
                end_s = moves[move + 1].time_s if move + 1 < len(moves) else COMMAND_MAX
                if not moves[move].time_s <= time_s <= end_s:
                    allowed = f"from {moves[move].time_s:g}, the time of move {move}, to {end_s:g}"
                    raise table.refuse(row, "time_s", "order", allowed, "name the last move before the reading")

    return check


def _prior(keys: Keys, key: str) -> AxisPrior:
    """A prior of `[axis]`; a half-normal has value 0, or u = 0 and its fixed value."""
    kind = AXIS_KEYS[key].kind
    value, u = keys.quantity(key, -COMMAND_MAX if kind == "normal" else 0.0, COMMAND_MAX, COMMAND_MAX)
    refuse = partial(keys.table(key).refuse, "value")
    if kind == "half-normal" and value and u:
        raise refuse("half-normal", "0 where u is not 0", "give the scale as u, or fix it by u = 0")
    if kind == "log-normal" and not value and (u or key in _NEVER_ZERO):
        raise refuse("log-normal", "a positive median", "u is the sd of the logarithm")
    if key == "per_command" and not value:
        raise refuse("zero", "a number other than 0", "state what one command does, or leave it out")
    return AxisPrior(value, u)


def _ranges(keys: Keys, key: str) -> tuple[tuple[float, float], ...]:
    """[low, high], or a list of such pairs, one for every unknown period."""
    refuse = partial(keys.refuse, key, "range")
    allowed = f"[low, high] with 0 < low < high, or a list of up to {RANGES_MAX} such pairs"
    stated: Any = keys.values[key]
    entries = stated if isinstance(stated, list) else [stated]
    pairs = entries if entries and all(isinstance(entry, list) for entry in entries) else [entries]
    for pair in pairs:
        if len(pair) != 2 or not all(map(is_number, pair)):
            raise refuse(allowed, "give both ends of every range, in their unit")
        if not 0 < pair[0] < pair[1] <= COMMAND_MAX:
            raise refuse(allowed, "order the ends; a known period goes into `periods`")
    for (low, high), other in combinations(pairs, 2):
        if [low, high] != other and low < other[1] and other[0] < high:
            rule = "ranges that are the same or do not overlap"
            raise refuse(rule, "write one range twice where both periods may be there")
    if len(pairs) > RANGES_MAX:
        raise refuse(allowed, "ask for fewer unknown periods at once")
    return tuple((float(low), float(high)) for low, high in pairs)


def _expansion(keys: Keys, key: str) -> StatedValue:
    if isinstance(keys.values[key], int | float):
        return StatedValue(keys.number(key, -EXPANSION_MAX, EXPANSION_MAX), 0.0)
    return keys.quantity(key, -EXPANSION_MAX, EXPANSION_MAX, EXPANSION_MAX)


_COMMAND, _PERIOD = (-COMMAND_MAX, COMMAND_MAX), (1.0 / COMMAND_MAX, COMMAND_MAX)
_AXIS: dict[str, Kind] = {
    **dict.fromkeys(AXIS_KEYS, _prior),
    "absolute": Keys.flag,
    "limits": (
        *(Keys.held, lambda ends: len(ends) == 2 and ends[0] < ends[1], "range"),
        *("[lowest, highest] command, the lower one first", "give both ends that the machine allows, in commands"),
        (Keys.numbers, *_COMMAND, 2),
    ),
    "command_unit": (Keys.text, UNIT_CHARS_MAX),
    "periods": (Keys.numbers, *_PERIOD, PERIODS_MAX),
    "periods_in": (Keys.word, "unit", "seconds"),
    "period_between": _ranges,
    "encoder_period": (Keys.number, *_PERIOD),
}
"""Keys of `[axis]`; then those of `[reference]` and of the whole file."""
_REFERENCE: dict[str, Kind] = {
    **dict.fromkeys(("u", "u_per_unit"), (Keys.number, 0.0, COMMAND_MAX)),
    "expansion_per_K": _expansion,
    "u_is": (Keys.word, COMMON, "independent"),
    "certificate": Keys.text,
    "valid_until": (
        *(Keys.held, lambda day: type(day) is datetime.date, "date"),
        *("a date such as 2027-01-15", "write it without quotes"),
    ),
}
_UNIT = (
    *(Keys.held, str.strip, "text", 'the unit of readings, such as "deg" or "mm"', "name it"),
    (Keys.text, UNIT_CHARS_MAX),
)
_RATE = (
    *(Keys.held, bool, "zero", "commands per second, not 0", "leave it out of an axis that stops"),
    (Keys.number, *_COMMAND),
)
_CAMPAIGN: dict[str, Kind] = {
    **{"unit": _UNIT, "name": Keys.text, **PEOPLE, **TIMES, "rate": _RATE, **ORIGIN},
    **{"axis": (Keys.nested, _AXIS), REFERENCE: (Keys.nested, _REFERENCE), "environment": (Keys.nested, ENVIRONMENT)},
    "traceability": (Keys.nested, {"reference_certificate": Keys.text, "reference_calibrated": Keys.date}),
}


def _parse_files(files: dict[str, bytes], path: Path | None) -> AxisCampaign:
    keys = parse_toml(files["campaign.toml"], "campaign.toml")
    entries = keys.document(FORMAT, _CAMPAIGN, required=("unit",))
    unit, stated, reference = entries.pop("unit"), entries.pop("axis", {}), entries.pop(REFERENCE, {})
    if stated.get("absolute") and "home_sd" in stated:
        allowed, remedy = "no home_sd beside absolute = true", "leave one of them out: no homing sets an absolute zero"
        raise keys.table("axis").refuse("home_sd", "absolute", allowed, remedy)
    header, moves = header_of(keys, entries), parse_axis_moves(files["moves.csv"])
    readings = parse_readings(files["readings.csv"], len(moves), moves, "rate" in header)
    if "expansion_per_K" in reference and all(move.temperature_degC is None for move in moves):
        allowed = "an expansion where temperatures are recorded"
        remedy = "add the column temperature_degC to moves.csv, or leave the expansion out"
        raise keys.table(REFERENCE).refuse("expansion_per_K", "temperature", allowed, remedy)
    return AxisCampaign(
        *(unit, moves, readings),
        stated={name: prior for name, prior in stated.items() if name in AXIS_KEYS},
        header=header,
        periods=WavePeriods(
            *(stated.get("periods", ()), stated.get("period_between", ())),
            in_seconds=stated.get("periods_in") == "seconds",
            encoder=stated.get("encoder_period"),
        ),
        path=path,
        absolute=stated.get("absolute", False),
        limits=stated.get("limits"),
        command_unit=stated.get("command_unit"),
        reference=Reference(**reference),
    )


def unit_of_folder(folder: Path) -> str | None:
    """The unit of readings in a folder's `campaign.toml`; None where it cannot be read."""
    unit = header_values(folder).get("unit")
    return unit if isinstance(unit, str) else None


def read_axis(folder: Path | str) -> AxisCampaign:
    """Read and check an axis folder (data/docs/campaign-files.md), without `truth.json` and results.

    Raises:
        InputError: missing, malformed or contradictory entries, with file, line and column.
    """
    folder = Path(folder)
    require_campaign_folder(folder, "an axis folder")
    return _parse_files({name: read_bytes(folder / name, limit, folder) for name, limit in _FILES.items()}, folder)


def axis_templates() -> dict[str, bytes]:
    """The commented files of an empty axis folder."""
    return templates("axis_templates", AXIS_MOVES, READINGS)


def _axis_entries(campaign: AxisCampaign) -> dict[str, object]:
    """The entries of `[axis]` on which an estimate depends."""
    priors = {name: StatedValue(prior.value, prior.u) for name, prior in sorted(campaign.stated.items())}
    entries = {**campaign.periods.entries(), "absolute": campaign.absolute}
    return priors | {name: value for name, value in entries.items() if value}


def axis_toml(campaign: AxisCampaign) -> bytes:
    """The content of `campaign.toml`."""
    besides = {"limits": campaign.limits, "command_unit": campaign.command_unit}
    tables = {
        "": {"format": FORMAT, "unit": campaign.unit, **campaign.header},
        "axis": besides | _axis_entries(campaign),
    }
    reference = campaign.reference.entries
    return toml_text(tables | ({REFERENCE: reference} if reference else {})).encode()


def axis_bytes(campaign: AxisCampaign) -> dict[str, bytes]:
    """The three files; reading them returns the same campaign.

    Raises:
        InputError: `read_axis` would refuse them.
    """
    contents = AXIS_MOVES.content(campaign.moves), READINGS.content(campaign.readings), axis_toml(campaign)
    files = dict(zip(_FILES, contents, strict=True))
    _parse_files(files, None)
    return files


def write_axis(campaign: AxisCampaign, folder: Path) -> None:
    """Write the three files into a new or empty folder, all or none.

    Raises:
        InputError: the folder is not empty or cannot be written, or `axis_bytes` refuses.
    """
    write_folder(Path(folder), axis_bytes(campaign))


def axis_hashes(campaign: AxisCampaign) -> dict[str, str]:
    """SHA-256 of the inputs of an estimate, by "moves", "readings" and "axis", over values in canonical text."""
    readings = sorted(campaign.readings, key=lambda reading: reading.reading)
    timing = {key: campaign.header[key] for key in ("rate", "powered_on") if key in campaign.header}
    reference = {name: value for name, value in campaign.reference.entries.items() if name not in CERTIFIED}
    axis = f"{campaign.unit}\n{toml_text({'': timing | _axis_entries(campaign) | reference})}".rstrip("\n")
    contents = AXIS_MOVES.content(campaign.moves), READINGS.content(readings), axis.encode()
    names = ("moves", "readings", "axis")
    return {name: hashlib.sha256(data).hexdigest() for name, data in zip(names, contents, strict=True)}


def refuse_same_readings(known: AxisCampaign, new: AxisCampaign) -> None:
    """Refuse fresh readings that are copies of readings of the folder; see `refuse_copied`."""

    def rows(campaign: AxisCampaign) -> list[tuple[object, ...]]:
        at = campaign.moves
        return [(at[r.move].time_s, at[r.move].command, r.value) for r in campaign.readings if r.status == "ok"]

    refuse_copied(rows(known), rows(new), READINGS.file)


class AxisStop(NamedTuple):
    """A stop of a plan: the command visited before, or None; the command; its direction of approach."""

    via: float | None
    command: float
    direction: str


def stops_csv(stops: Iterable[AxisStop]) -> bytes:
    """`plan.csv` of an axis: step, command, direction, read (1 or 0)."""
    rows: list[tuple[int, float, str, int]] = []
    for via, command, direction in stops:
        if via is not None:
            rows.append((len(rows), via, "backward" if direction == "forward" else "forward", 0))
        rows.append((len(rows), command, direction, 1))
    return csv_bytes(("step", "command", "direction", "read"), rows)
