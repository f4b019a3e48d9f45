"""The declared instrument: the `[rig]` table with its priors, and rig files (data/docs/campaign-files.md).

Units are those of the names: mm, degrees, radians, px, s; counters in steps. No JAX.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path, PureWindowsPath
from typing import Literal, NamedTuple

from tvsbayes.errors import InputError, closest, entry_refusal, escaped
from tvsbayes.files.disk import read_bytes
from tvsbayes.files.documents import TOML_BYTES_MAX, Keys, parse_toml, toml_line
from tvsbayes.instrument.axes import AXES, DIRECTION_SIGNS, FULL_TURN_DEG
from tvsbayes.instrument.counter_limits import COUNTER_MAX, HOME_KEYS, LIMIT_KEYS, CounterLimits
from tvsbayes.instrument.mechanisms import MECHANISMS, TWO_MIRROR, WORDS, Mechanism, mechanism_named
from tvsbayes.instrument.parameters import (
    AMPLITUDE_NAMES,
    HARMONIC_NAMES,
    LATE_NAMES,
    PERIODS_MAX,
    REGISTRY,
    RIG_PRIORS,
    Place,
    Prior,
    parameter_of,
)
from tvsbayes.instrument.stereo_pair import Stereo, WithStereo, read_stereo

SPOT_SD_PX = 0.08
"""Default standard uncertainty of a spot centre."""
SIGHTING_SD_DEG = 0.005
"""Default standard uncertainty of a sighting."""
PERIODIC_NAMES = (*HARMONIC_NAMES, *AMPLITUDE_NAMES)
"""Parameters that apply only to an axis with a stated period."""
Setting = str | int | float
"""A value of `[positioner]` or `[cameras]`, of the type that its key requires."""


@dataclass(frozen=True)
class RigTable:
    """The `[rig]` table of a campaign or rig file: every prior of the estimators.

    `priors` maps every name of the mechanism's `priors` to its `Prior`; omitted names take the default. Where an axis
    does not state the period that a name needs, its default is 0, fixed.
    `harmonic_period_deg` maps "pan" and "tilt", where declared, to the periods of the transmission error in
    degrees of the output, 1 to `PERIODS_MAX` different ones: `FULL_TURN_DEG` for the wheel, less for pinion and teeth.
    `harmonic_deg` belongs to the first period, `harmonic_amplitude_deg.<axis>.<number>` to each. `absolute` names the
    axes whose encoders keep their zero over a homing; its shift by one is 0.

    Raises:
        InputError: harmonics or amplitudes of an axis without their period.
    """

    priors: dict[str, Prior] = field(default_factory=dict)
    aperture_convention: Literal["in-plane", "azimuth"] = "in-plane"
    harmonic_period_deg: dict[str, tuple[float, ...]] = field(default_factory=dict)
    mechanism: Mechanism = TWO_MIRROR
    absolute: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        priors = {**self.mechanism.priors, **self.priors}
        for name in PERIODIC_NAMES:
            if priors[name] == RIG_PRIORS[name] and not _has_period(name, self.harmonic_period_deg):
                priors[name] = replace(priors[name], value=0.0, u=0.0)
        for axis in self.absolute:
            name = f"home_sd_deg.{axis}"
            priors[name] = replace(priors[name], value=0.0, u=0.0)
        object.__setattr__(self, "priors", priors)
        require_periods(self.priors, self.harmonic_period_deg)

    @property
    def first_period_deg(self) -> dict[str, float]:
        """The first stated period of each axis that states one: that of its `harmonic_deg`."""
        return {axis: periods[0] for axis, periods in self.harmonic_period_deg.items()}


@dataclass(frozen=True)
class Rig(WithStereo):
    """A rig file: the declared rig, its stereo calibration, and the drivers of the hardware.

    `truth` is the distribution from which `simulate` and `study` draw true rigs; names absent from `[truth]` take the
    prior. `sheets_mm` gives the nominal X of each named target in frame S.
    `positioner`, `cameras`, `costs_s` are the remaining tables, checked but otherwise as written. Defaults are filled
    in for `cameras["spot_sd_px"]`, the standard uncertainty stated for simulated spots, and for the costs. `header`
    holds name and notes.
    """

    table: RigTable
    stereo: Stereo | None
    truth: dict[str, Prior]
    sheets_mm: dict[str, float]
    positioner: dict[str, Setting]
    cameras: dict[str, Setting]
    costs_s: dict[str, float]
    path: Path | None = None
    header: dict[str, str] = field(default_factory=dict)

    @property
    def spot_sd_px(self) -> float:
        """Standard uncertainty stated for the centres of simulated spots."""
        return float(self.cameras.get("spot_sd_px", SPOT_SD_PX))

    @property
    def sighting_sd_deg(self) -> float:
        """Standard uncertainty stated for simulated sightings."""
        return float(self.cameras.get("sighting_sd_deg", SIGHTING_SD_DEG))

    @property
    def look_sd(self) -> float:
        """Standard uncertainty of a simulated look: px of a spot's centre, rad of a sighting."""
        return self.spot_sd_px if self.has_images else math.radians(self.sighting_sd_deg)

    @property
    def depths_mm(self) -> dict[str, float]:
        """Depths of the sheets; directions have one target, without a name."""
        return self.sheets_mm if self.has_images else {"": 1.0}

    @property
    def limits(self) -> CounterLimits:
        """Lowest and highest counters, where `[positioner]` states them."""
        return CounterLimits.of(self.positioner)


_PERIOD_NAMES = {f"harmonic_period_deg.{axis}": axis for axis in AXES}
_PERIOD_MIN_DEG = 1e-6
_GROUPS = {
    name.rsplit(".", n)[0] for kind in MECHANISMS.values() for name in (*kind.names, *_PERIOD_NAMES) for n in (1, 2, 3)
}


def _names_at(place: Place, mechanism: Mechanism) -> tuple[str, ...]:
    """Parameter names allowed in a table of a mechanism's file."""
    return tuple(p.name for p in mechanism.parameters.values() if p.place == place and p.name in mechanism.documented)


def _period_number(name: str) -> int:
    """Number of the period of a periodic parameter, from 1: the first, or the amplitude's own."""
    return int(name.rpartition(".")[2]) if name in AMPLITUDE_NAMES else 1


def _has_period(name: str, period_deg: Mapping[str, tuple[float, ...]]) -> bool:
    """Whether the axis of a periodic parameter states its period."""
    return len(period_deg.get(name.split(".")[1], ())) >= _period_number(name)


def _without_period(priors: Mapping[str, Prior], period_deg: Mapping[str, tuple[float, ...]]) -> str | None:
    """The first periodic parameter that is not fixed at 0 and whose period is unstated."""
    free = (name for name in PERIODIC_NAMES if name in priors and (priors[name].value != 0 or priors[name].u != 0))
    return next((name for name in free if not _has_period(name, period_deg)), None)


def _period_remedy(name: str) -> str:
    axis, number = name.split(".")[1], _period_number(name)
    value = "P" if number == 1 else "[" + ", ".join(f"P{n}" for n in range(1, number + 1)) + "]"
    return (
        f'add "harmonic_period_deg.{axis}" = {{ value = {value}, u = 0.0 }} to [rig]: degrees of the output per turn '
        f"of the faulty member, {FULL_TURN_DEG:g} for the wheel, {FULL_TURN_DEG:g} x teeth of the pinion / teeth of "
        "the wheel for the pinion"
    )


def require_periods(priors: Mapping[str, Prior], period_deg: Mapping[str, tuple[float, ...]]) -> None:
    """Refuse harmonics and amplitudes without a stated period: their error would have no known angle.

    Raises:
        InputError: a value or u other than 0 on an axis without the period.
    """
    name = _without_period(priors, period_deg)
    if name is not None:
        message = f"{name} has no period"
        raise InputError("missing-period", message, column=name, remedy=_period_remedy(name))


def _explanation(name: str, allowed: tuple[str, ...]) -> str:
    """The remedy for a name that is not allowed in its table."""
    stem, _, last = name.partition(".")
    if name in _PERIOD_NAMES:
        return "it belongs in [rig] itself: tooth counts fix it, so it has no prior and no other truth"
    parameter = parameter_of(name)
    if parameter is not None and parameter.place != "stereo":
        elsewhere = parameter.place == "rig.prior" and "backlash_deg.pan" not in allowed
        other = "it means nothing to this mechanism: leave it out, or correct `mechanism` in [rig]"
        return "it belongs in [rig.prior]" if elsewhere else other
    if stem == "degrees_per_step" and last in DIRECTION_SIGNS:
        axis, _ = DIRECTION_SIGNS[last]
        return f"it is derived: state degrees_per_step.{axis} and ratio_contrast_deg_per_step.{axis}"
    if stem == "effective_mirror_offset_mm":
        return "it is derived: state mirror_offset_mm"
    if stem == "stereo":
        return "stereo parameters and their covariance come from stereo.json"
    return closest(name, allowed)


class _Place(NamedTuple):
    """The table of an entry, and its key there."""

    keys: Keys
    key: str


def _entries(table: Keys, prefix: str = "") -> Iterator[tuple[str, _Place]]:
    """Every entry by its full name, for quoted and dotted keys."""
    for key, value in table.values.items():
        name = prefix + key
        if isinstance(value, dict) and value and name in _GROUPS and not {"value", "u"} & set(value):
            yield from _entries(table.table(key), name + ".")
        else:
            yield name, _Place(table, key)


def _in_blocks(names: Iterable[str]) -> str:
    """Short list of names: one word for those of a block, as `harmonic_deg.pan|tilt.1|2.cos|sin`."""
    blocks: dict[str, list[list[str]]] = {}
    for name in names:
        parameter = parameter_of(name)
        block = name.split(".")[0] if parameter is None else parameter.block
        blocks.setdefault(block, []).append(name.removeprefix(block).split(".")[1:])
    return ", ".join(
        ".".join([block, *("|".join(dict.fromkeys(part)) for part in zip(*parts, strict=True))])
        for block, parts in blocks.items()
    )


def _named_entries(table: Keys, allowed: tuple[str, ...]) -> dict[str, _Place]:
    """Place of each parameter name in a table; `allowed` lists the permitted names."""
    entries: dict[str, _Place] = {}
    for name, place in _entries(table):
        if name not in allowed:
            # Keys of [rig] that are not priors were read before.
            own_keys = () if "rig" not in table.path or "prior" in table.path else _OWN_KEYS
            names = "only " + _in_blocks((*allowed, *own_keys))
            found = f"the name {escaped(name)}"
            raise place.keys.refuse(place.key, "unknown-key", names, _explanation(name, allowed), found)
        if name in entries:
            raise place.keys.refuse(place.key, "duplicate-key", "every name once", "remove one", f"{name} twice")
        entries[name] = place
    return entries


def _parse_priors(entries: Mapping[str, _Place]) -> dict[str, Prior]:
    """The stated priors, checked."""
    priors: dict[str, Prior] = {}
    for name, (keys, key) in entries.items():
        parameter = parameter_of(name)
        assert parameter is not None
        stated = keys.values.get(key)
        if parameter.prior.distribution == "half-normal" and isinstance(stated, dict) and stated.get("value", 0) != 0:
            remedy = "write value = 0: it is the size of something that has no sign, a half-normal whose scale is u"
            raise keys.table(key).refuse("value", "number", "exactly 0", remedy)
        expected = keys.quantity(key, parameter.low, parameter.high, parameter.u_max)
        priors[name] = Prior(expected.value, expected.u, parameter.prior.distribution)
    return priors


def _parse_periods(keys: Keys, key: str) -> tuple[float, ...]:
    """Periods in degrees of the output, bare or as { value, u }; exact, since tooth counts determine them."""
    value = keys.values[key]
    if isinstance(value, dict):
        allowed = "{ value = period or list of periods, u = 0.0 }, both and nothing else"
        if set(value) != {"value", "u"}:
            raise keys.refuse(key, "quantity", allowed, "u = 0 states that the value is exact")
        if keys.table(key).number("u", 0.0, FULL_TURN_DEG) != 0:
            remedy = "write u = 0.0: tooth counts give the period exactly (the wheel's is 360)"
            raise keys.refuse(key, "period-uncertain", "a period with u = 0", remedy)
        keys, key = keys.table(key), "value"
    return keys.numbers(key, _PERIOD_MIN_DEG, FULL_TURN_DEG, PERIODS_MAX)


def _check_periods(table: Keys, priors: Mapping[str, Prior], period_deg: Mapping[str, tuple[float, ...]]) -> None:
    """Check as `require_periods`, with the location in the file."""
    name = _without_period(priors, period_deg)
    if name is not None:
        allowed = "harmonics and amplitudes of an axis whose periods are stated"
        found = f"{name.split('.')[0]} without a period"
        raise table.refuse(name, "missing-period", allowed, _period_remedy(name), found)


_OWN_KEYS = ("aperture_convention", "mechanism", "absolute", "prior")
"""Keys of `[rig]` without a value and a u."""


def _stated_mechanism(table: Keys, sightings: bool) -> Mechanism:
    """The mechanism by its key in `[rig]`."""
    word = table.word("mechanism", WORDS) if "mechanism" in table else WORDS[0]
    if (mechanism := mechanism_named(word, sightings)) is None:
        remedy = 'write mechanism = "pan-tilt" into [rig]; a scanner needs stereo.json and spots.csv instead'
        allowed = "a pan-tilt head where there are sightings and no stereo pair"
        raise table.refuse("mechanism", "mechanism", allowed, remedy, f"a {word} instrument")
    return mechanism


def parse_rig_table(table: Keys, sightings: bool = False) -> RigTable:
    """The `[rig]` table with its `[rig.prior]`; absent entries take their defaults.

    Args:
        table: table of a campaign or rig file.
        sightings: for a head with sightings, which has no spots and no stereo pair.

    Raises:
        InputError: unknown or misplaced names, entries that are not { value, u }, values out of range,
            a half-normal with a value other than 0, harmonics or amplitudes without a period, a period with u > 0.
    """
    mechanism = _stated_mechanism(table, sightings)
    declared_names, prior_names = (_names_at(place, mechanism) for place in ("rig", "rig.prior"))
    extra = {k: v for k, v in table.values.items() if k not in _OWN_KEYS}
    own_keys = Keys(extra, table.file, table.text, table.path)
    own_entries = _named_entries(own_keys, (*declared_names, *_PERIOD_NAMES))
    period_deg: dict[str, tuple[float, ...]] = {
        axis: _parse_periods(*own_entries.pop(n)) for n, axis in _PERIOD_NAMES.items() if n in own_entries
    }
    declared = _parse_priors(own_entries)
    # Any parameter may stand in [rig.prior], also one that belongs to [rig].
    prior_entries = _named_entries(table.table("prior"), (*prior_names, *declared_names))
    absolute = table.some_words("absolute", AXES) if "absolute" in table else ()
    for name in (f"home_sd_deg.{axis}" for axis in absolute):
        if name in prior_entries:
            keys, key = prior_entries[name]
            allowed = "no entry for an axis in `absolute`"
            raise keys.refuse(key, "absolute", allowed, "leave one of them out: no homing sets an absolute zero")
    prior = _parse_priors(prior_entries)
    for name in declared:
        if name in prior:
            found = f"{name} in [rig] and in [rig.prior]"
            raise table.table("prior").refuse(name, "duplicate-key", "every name once", "remove one", found)
    _check_periods(table.table("prior"), prior, period_deg)
    key = "aperture_convention"
    if key in table and "aperture_zero_deg" not in mechanism.documented:
        raise table.refuse(key, "unknown-key", "no aperture", "leave it out: a head has no receiver", f"the name {key}")
    azimuth = key in table and table.word(key, ("in-plane", "azimuth")) == "azimuth"
    convention: Literal["in-plane", "azimuth"] = "azimuth" if azimuth else "in-plane"
    return RigTable({**prior, **declared}, convention, period_deg, mechanism, absolute)


def rig_table_toml(table: RigTable) -> str:
    """`[rig]` and `[rig.prior]` with every entry, including defaults, so that the file is complete.

    Harmonics and amplitudes appear only where they apply: on an axis with a stated period. The scatter of looks and the
    shifts of the zeros appear only where they differ from the defaults: earlier campaigns keep their text and hash.
    """

    def entry(name: str) -> str:
        prior = table.priors[name]
        return toml_line(name, {"value": float(prior.value), "u": float(prior.u)})

    kind = table.mechanism
    has_aperture = "aperture_zero_deg" in kind.documented
    own = ("aperture_convention", table.aperture_convention) if has_aperture else ("mechanism", kind.word)
    stated = {name: table.harmonic_period_deg.get(axis, ()) for name, axis in _PERIOD_NAMES.items()}
    periods = [
        toml_line(name, {"value": numbers[0] if len(numbers) == 1 else numbers, "u": 0.0})
        for name, numbers in stated.items()
        if numbers
    ]
    periodic = [entry(name) for name in PERIODIC_NAMES if _has_period(name, table.harmonic_period_deg)]
    declared = map(entry, _names_at("rig", kind))
    omitted = {name for name in LATE_NAMES if table.priors[name] == REGISTRY[name].prior}
    omitted |= {f"home_sd_deg.{axis}" for axis in table.absolute}
    priors = [entry(name) for name in _names_at("rig.prior", kind) if name not in {*PERIODIC_NAMES, *omitted}]
    absolute = [toml_line("absolute", list(table.absolute))] if table.absolute else []
    return (
        "\n".join(["[rig]", *declared, *periods, toml_line(*own), *absolute, "[rig.prior]", *priors, *periodic]) + "\n"
    )


COSTS_S = {"move_s": 1.5, "look_s": 1.0, "placement_s": 60.0}
"""Default durations of a move, a look and the placement of a sheet."""


_NUMBERS = {
    "speed_steps_per_s": (1e-3, 1e7),
    "acceleration_steps_per_s2": (10.0, 1e5),
    "laser_watchdog_s": (0.1, 10.0),
    "settle_s": (0.0, 3600.0),
}
"""Entries of `[positioner]` that are numbers, with their range."""


def _parse_options(table: Keys) -> dict[str, Setting]:
    """The table `options` of a driver, as entries `options.NAME`; the driver checks them."""
    if "options" not in table:
        return {}
    options = table.table("options")
    values: dict[str, Setting] = {}
    for key, value in options.values.items():
        if isinstance(value, str):
            values[f"options.{key}"] = options.text_value(key)
        elif isinstance(value, bool):
            values[f"options.{key}"] = int(value)
        elif isinstance(value, int):
            values[f"options.{key}"] = options.integer(key, -(2**53), 2**53)
        else:
            values[f"options.{key}"] = options.number(key, -1e300, 1e300)
    return values


def driver_options(table: Mapping[str, Setting], section: str, known: Iterable[str]) -> dict[str, Setting]:
    """The options of a driver by name, of `[positioner]` or `[cameras]`.

    Raises:
        InputError: an option that is not `known`.
    """
    options = {key.removeprefix("options."): value for key, value in table.items() if key.startswith("options.")}
    for name, value in options.items():
        if name not in known:
            raise entry_refusal(section, section, f"options.{name}", escaped(str(value)), ", ".join(known), "remove it")
    return options


def _parse_positioner(table: Keys) -> dict[str, Setting]:
    """`[positioner]`: driver, port, limits, counters at the home switches, speeds; `options` of other drivers."""
    keys = [key for pair in LIMIT_KEYS.values() for key in pair] + list(HOME_KEYS.values())
    table.only(("driver", "port", "baud", *keys, *_NUMBERS, "options"))
    values: dict[str, Setting] = {key: table.text_value(key) for key in ("driver", "port") if key in table}
    # Serial libraries interpret addresses: one kind of address writes a file of that name.
    if "://" in str(values.get("port", "")):
        remedy = "give a port's name, such as /dev/ttyACM0 or COM3; `tvsbayes doctor` lists those there are"
        raise table.refuse("port", "port", "the name of a serial port, no address", remedy)
    if "baud" in table:
        values["baud"] = table.integer("baud", 300, 10_000_000)
    steps = {key: table.integer(key, -COUNTER_MAX, COUNTER_MAX) for key in keys if key in table}
    for lowest, highest in LIMIT_KEYS.values():
        if lowest in steps and highest in steps and steps[lowest] > steps[highest]:
            raise table.refuse(highest, "limits", f"at least {lowest} = {steps[lowest]}", "swap the two limits")
    values |= {key: table.number(key, *limits) for key, limits in _NUMBERS.items() if key in table}
    return {**values, **steps, **_parse_options(table)}


def _parse_cameras(table: Keys, stereo: Stereo | None) -> dict[str, Setting]:
    """`[cameras]`: driver, devices, size (that of the calibration), exposure, spot uncertainty, `options`."""
    numbers = {"exposure": (-100.0, 1e9), "spot_sd_px": (1e-4, 100.0), "sighting_sd_deg": (1e-7, 30.0)}
    table.only(("driver", "source", "left", "right", "width", "height", *numbers, "options"))
    values: dict[str, Setting] = {"spot_sd_px": SPOT_SD_PX, **_parse_options(table)}
    if "driver" in table:
        values["driver"] = table.text_value("driver")
    for key in ("source", "left", "right"):
        if key in table:
            is_name = isinstance(table.values[key], str)
            values[key] = table.text_value(key) if is_name else table.integer(key, 0, 1000)
    if stereo is not None and stereo.right_image_size is not None:
        remedy = "record with the cameras' own program, then `tvsbayes new --pictures FOLDER`"
        found = "a stereo file of two picture sizes"
        raise table.refuse("stereo", "image-size", "cameras of one picture size", remedy, found)
    calibrated = {} if stereo is None else {"width": stereo.image_width, "height": stereo.image_height}
    for key in ("width", "height"):
        if key in table:
            size = values[key] = table.integer(key, 1, 65_535)
            if size != calibrated.get(key, size):
                remedy = "calibrate and observe at one image size"
                raise table.refuse(key, "image-size", f"{calibrated[key]} px, as in the stereo file", remedy)
    values |= {key: table.number(key, *limits) for key, limits in numbers.items() if key in table}
    return values


def _file_beside(keys: Keys, key: str, folder: Path) -> Path:
    """The file that `key` names, which must lie in the folder of the rig file or below."""
    name = keys.text_value(key)
    windows = PureWindowsPath(name)
    if not name or Path(name).is_absolute() or windows.drive or windows.root or ".." in windows.parts:
        allowed = "a file name relative to the rig file, inside its folder"
        raise keys.refuse(key, "path", allowed, "put the file beside the rig file and give its name")
    return folder / name


def read_rig(path: Path) -> Rig:
    """Read a rig file (format tvsbayes-rig/1) and the stereo file it names.

    Raises:
        InputError: either file unreadable, unknown keys, values out of range, a stereo path that leaves
            the folder.
    """
    path = Path(path)
    keys = parse_toml(read_bytes(path, TOML_BYTES_MAX), escaped(path.name))
    keys.word("format", ("tvsbayes-rig/1",))
    tables = ("rig", "truth", "sheets", "positioner", "cameras", "costs")
    keys.only(("format", "name", "notes", "stereo", *tables))
    header = {key: keys.text_value(key, length) for key, length in (("name", 200), ("notes", 2000)) if key in keys}
    sightings = "stereo" not in keys and mechanism_named(keys.table("rig").values.get("mechanism"), True) is not None
    table = parse_rig_table(keys.table("rig"), sightings)
    stereo = None if sightings else read_stereo(_file_beside(keys, "stereo", path.parent), folder=path.parent)
    sheets = keys.table("sheets")
    for name in sheets.values:
        if not (name.isprintable() and 0 < len(name) <= 100):
            raise sheets.refuse(name, "text", "a printable name of 1 to 100 characters", "rename the sheet")
    costs = keys.table("costs")
    costs.only(COSTS_S)
    names = tuple(name for name in table.mechanism.rig_names if name in table.mechanism.documented)
    truth = {**table.priors, **_parse_priors(_named_entries(keys.table("truth"), names))}
    _check_periods(keys.table("truth"), truth, table.harmonic_period_deg)
    return Rig(
        table=table,
        stereo=stereo,
        truth=truth,
        sheets_mm={name: sheets.number(name, 50.0, 100_000.0) for name in sheets.values},
        positioner=_parse_positioner(keys.table("positioner")),
        cameras=_parse_cameras(keys.table("cameras"), stereo),
        costs_s={k: costs.number(k, 0.0, 1e6) if k in costs else v for k, v in COSTS_S.items()},
        path=path,
        header=header,
    )
