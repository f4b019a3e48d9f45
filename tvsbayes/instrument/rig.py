"""The declared instrument: the `[rig]` table with its priors, and rig files (data/docs/campaign-files.md).

Units are those of the names: mm, degrees, radians, px, s; counters in steps. No JAX.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from pathlib import Path, PureWindowsPath
from typing import Any, Literal

from tvsbayes.errors import InputError, closest, entry_refusal, escaped
from tvsbayes.files.disk import read_bytes
from tvsbayes.files.documents import TOML_BYTES_MAX, Keys, Kind, StatedValue, parse_toml, toml_text
from tvsbayes.instrument.axes import AXES, DIRECTION_SIGNS, FULL_TURN_DEG
from tvsbayes.instrument.counter_limits import COUNTER_MAX, HOME_KEYS, LIMIT_KEYS, CounterLimits
from tvsbayes.instrument.mechanisms import MECHANISMS, TWO_MIRROR, WORDS, Mechanism, mechanism_named
from tvsbayes.instrument.parameters import (
    AMPLITUDE_NAMES,
    HARMONIC_NAMES,
    LATE_NAMES,
    PERIODS_MAX,
    REGISTRY,
    Place,
    Prior,
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
            if priors[name] == REGISTRY[name].prior and not _has_period(name, self.harmonic_period_deg):
                priors[name] = replace(priors[name], value=0.0, u=0.0)
        for axis in self.absolute:
            name = f"home_sd_deg.{axis}"
            priors[name] = replace(priors[name], value=0.0, u=0.0)
        object.__setattr__(self, "priors", priors)
        require_periods(self.priors, self.harmonic_period_deg)

    @property
    def values(self) -> dict[str, float]:
        """The stated values by name, and the constants of the instrument."""
        return {**self.mechanism.constants, **{name: prior.value for name, prior in self.priors.items()}}

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
_PERIOD_OF = {name: (name.split(".")[1], 1) for name in HARMONIC_NAMES} | {
    name: (name.split(".")[1], int(name.split(".")[2])) for name in AMPLITUDE_NAMES
}
"""Axis and number, from 1, of the period of every name in `PERIODIC_NAMES`."""
_GROUPS = {
    name.rsplit(".", n)[0] for kind in MECHANISMS.values() for name in (*kind.names, *_PERIOD_NAMES) for n in (1, 2, 3)
}
_OWN_KEYS = ("aperture_convention", "mechanism", "absolute", "prior")
"""Keys of `[rig]` without a value and a u."""


def _names_at(place: Place, mechanism: Mechanism) -> tuple[str, ...]:
    """Parameter names allowed in a table of a mechanism's file."""
    return tuple(p.name for p in mechanism.parameters.values() if p.place == place)


def _has_period(name: str, period_deg: Mapping[str, tuple[float, ...]]) -> bool:
    """Whether the axis of a periodic parameter states its period."""
    axis, order = _PERIOD_OF[name]
    return len(period_deg.get(axis, ())) >= order


def _period_remedy(name: str) -> str:
    axis, order = _PERIOD_OF[name]
    value = "P" if order == 1 else "[" + ", ".join(f"P{n}" for n in range(1, order + 1)) + "]"
    return (
        f'add "harmonic_period_deg.{axis}" = {{ value = {value}, u = 0.0 }} to [rig]: degrees of the output per turn '
        f"of the faulty member, {FULL_TURN_DEG:g} for the wheel, {FULL_TURN_DEG:g} x teeth of the pinion / teeth of "
        "the wheel for the pinion"
    )


def require_periods(
    priors: Mapping[str, Prior], period_deg: Mapping[str, tuple[float, ...]], table: Keys | None = None
) -> None:
    """Refuse harmonics and amplitudes without a stated period: their error would have no known angle.

    Args:
        priors: by name.
        period_deg: stated periods by axis.
        table: states the priors, for the place in a file.

    Raises:
        InputError: a value or u other than 0 on an axis without the period.
    """
    for name in PERIODIC_NAMES:
        fixed = name not in priors or priors[name].value == priors[name].u == 0
        if fixed or _has_period(name, period_deg):
            continue
        code, remedy = "missing-period", _period_remedy(name)
        if table is None:
            raise InputError(code, f"{name} has no period", column=name, remedy=remedy)
        allowed = "harmonics and amplitudes of an axis whose periods are stated"
        raise table.refuse(name, code, allowed, remedy, f"{name.split('.')[0]} without a period")


def _explanation(name: str, allowed: tuple[str, ...]) -> str:
    """The remedy for a name that is not allowed in its table."""
    stem, _, last = name.partition(".")
    if name in _PERIOD_NAMES:
        return "it belongs in [rig] itself: tooth counts fix it, so it has no prior and no other truth"
    parameter = REGISTRY.get(name)
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


def _in_blocks(names: Iterable[str]) -> str:
    """Short list of names: one word for those of a block, as `harmonic_deg.pan|tilt.1|2.cos|sin`."""
    blocks: dict[str, list[list[str]]] = {}
    for name in names:
        parameter = REGISTRY.get(name)
        block = name.split(".")[0] if parameter is None else parameter.block
        blocks.setdefault(block, []).append(name.removeprefix(block).split(".")[1:])
    return ", ".join(
        ".".join([block, *("|".join(dict.fromkeys(part)) for part in zip(*parts, strict=True))])
        for block, parts in blocks.items()
    )


def _flat(table: Keys, names: tuple[str, ...], besides: tuple[str, ...] = ()) -> Keys:
    """The entries `names` of a table by their full names, for quoted and dotted keys; `besides` are other keys."""
    flat = Keys({}, table.file, table.content, table.path)

    def add(values: Mapping[str, Any], prefix: str = "") -> None:
        for key, value in values.items():
            name = prefix + key
            if isinstance(value, dict) and value and name in _GROUPS and not {"value", "u"} & value.keys():
                add(value, f"{name}.")
            elif name not in (*names, *besides):
                allowed = "only " + _in_blocks((*names, *besides))
                raise flat.refuse(name, "unknown-key", allowed, _explanation(name, names), f"the name {escaped(name)}")
            elif name in flat:
                raise flat.refuse(name, "duplicate-key", "every name once", "remove one", f"{name} twice")
            elif name in names:
                flat.values[name] = value

    add(table.values)
    return flat


def _prior(keys: Keys, name: str) -> Prior:
    """A stated prior, checked."""
    parameter, stated = REGISTRY.get(name), keys.values[name]
    assert parameter is not None
    distribution = parameter.prior.distribution
    if distribution == "half-normal" and isinstance(stated, dict) and stated.get("value", 0) != 0:
        remedy = "write value = 0: it is the size of something that has no sign, a half-normal whose scale is u"
        raise keys.table(name).refuse("value", "number", "exactly 0", remedy)
    return Prior(*keys.quantity(name, parameter.low, parameter.high, parameter.u_max), distribution)


def _periods(keys: Keys, key: str) -> tuple[float, ...]:
    """Periods in degrees of the output, bare or as { value, u }; exact, since tooth counts determine them."""
    value = keys.values[key]
    if isinstance(value, dict):
        allowed = "{ value = period or list of periods, u = 0.0 }, both and nothing else"
        if value.keys() != {"value", "u"}:
            raise keys.refuse(key, "quantity", allowed, "u = 0 states that the value is exact")
        if keys.table(key).number("u", 0.0, FULL_TURN_DEG) != 0:
            remedy = "write u = 0.0: tooth counts give the period exactly (the wheel's is 360)"
            raise keys.refuse(key, "period-uncertain", "a period with u = 0", remedy)
        keys, key = keys.table(key), "value"
    return keys.numbers(key, _PERIOD_MIN_DEG, FULL_TURN_DEG, PERIODS_MAX)


def _priors(flat: Keys, period_deg: Mapping[str, tuple[float, ...]]) -> dict[str, Prior]:
    """The priors in a table, by their full names."""
    priors = flat.entries(dict.fromkeys(flat.values, _prior))
    require_periods(priors, period_deg, flat)
    return priors


def _stated_mechanism(table: Keys, sightings: bool) -> Mechanism:
    """The mechanism by its key in `[rig]`."""
    word = table.word("mechanism", *WORDS) if "mechanism" in table else WORDS[0]
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
    mechanism, convention = _stated_mechanism(table, sightings), "aperture_convention"
    names, prior_names = (_names_at(place, mechanism) for place in ("rig", "rig.prior"))
    own = _flat(table, (*names, *_PERIOD_NAMES), _OWN_KEYS)
    declared = own.entries(dict.fromkeys(names, _prior) | dict.fromkeys(_PERIOD_NAMES, _periods))
    period_deg: dict[str, tuple[float, ...]] = {
        axis: declared.pop(name) for name, axis in _PERIOD_NAMES.items() if name in declared
    }
    # Any parameter may stand in [rig.prior], also one that belongs to [rig].
    stated = _flat(table.table("prior"), (*prior_names, *names))
    prior = _priors(stated, period_deg)
    absolute = table.some_words("absolute", *AXES) if "absolute" in table else ()
    for name in prior:
        refuse = partial(stated.refuse, name)
        if name in declared:
            found = f"{name} in [rig] and in [rig.prior]"
            raise refuse("duplicate-key", "every name once", "remove one", found)
        if name in (f"home_sd_deg.{axis}" for axis in absolute):
            allowed = "no entry for an axis in `absolute`"
            raise refuse("absolute", allowed, "leave one of them out: no homing sets an absolute zero")
    if convention in table and not mechanism.has_receiver:
        remedy = "leave it out: a head has no receiver"
        raise table.refuse(convention, "unknown-key", "no aperture", remedy, f"the name {convention}")
    azimuth = convention in table and table.word(convention, "in-plane", "azimuth") == "azimuth"
    return RigTable({**prior, **declared}, "azimuth" if azimuth else "in-plane", period_deg, mechanism, absolute)


def rig_table_toml(table: RigTable) -> str:
    """`[rig]` and `[rig.prior]` with every entry, including defaults, so that the file is complete.

    Harmonics and amplitudes appear only where they apply: on an axis with a stated period. The scatter of looks and the
    shifts of the zeros appear only where they differ from the defaults: earlier campaigns keep their text and hash.
    """

    def entries(names: Iterable[str]) -> dict[str, object]:
        return {name: StatedValue(float(table.priors[name].value), float(table.priors[name].u)) for name in names}

    kind, stated = table.mechanism, table.harmonic_period_deg
    periods: dict[str, object] = {
        name: {"value": stated[axis][0] if len(stated[axis]) == 1 else stated[axis], "u": 0.0}
        for name, axis in _PERIOD_NAMES.items()
        if stated.get(axis)
    }
    has_aperture = kind.has_receiver
    own = {"aperture_convention": table.aperture_convention} if has_aperture else {"mechanism": kind.word}
    omitted = {name for name in LATE_NAMES if table.priors[name] == REGISTRY[name].prior}
    omitted |= {*PERIODIC_NAMES, *(f"home_sd_deg.{axis}" for axis in table.absolute)}
    names = [name for name in _names_at("rig.prior", kind) if name not in omitted]
    names += [name for name in PERIODIC_NAMES if _has_period(name, stated)]
    rig = {**entries(_names_at("rig", kind)), **periods, **own, "absolute": table.absolute or None}
    return toml_text({"rig": rig, "rig.prior": entries(names)})


COSTS_S = {"move_s": 1.5, "look_s": 1.0, "placement_s": 60.0}
"""Default durations of a move, a look and the placement of a sheet."""


def _options(keys: Keys, key: str) -> dict[str, Setting]:
    """The table `options` of a driver, as entries `options.NAME`; the driver checks them."""
    kinds: dict[type, Kind] = {
        **{str: Keys.text, bool: lambda table, name: int(table.values[name])},
        **{int: (Keys.integer, -(2**53), 2**53), float: (Keys.number, -1e300, 1e300)},
    }
    options = keys.table(key)
    return {
        f"options.{name}": options.read(name, kinds.get(type(value), kinds[float]))
        for name, value in options.values.items()
    }


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


def _device(keys: Keys, key: str) -> Setting:
    """A camera, by name or number."""
    return keys.text(key) if isinstance(keys.values[key], str) else keys.integer(key, 0, 1000)


# Serial libraries interpret addresses: one kind of address writes a file of that name.
_PORT = (
    *(Keys.held, lambda port: "://" not in port, "port", "the name of a serial port, no address"),
    "give a port's name, such as /dev/ttyACM0 or COM3; `tvsbayes doctor` lists those there are",
    Keys.text,
)
_POSITIONER: dict[str, Kind] = {
    **{"driver": Keys.text, "port": _PORT, "baud": (Keys.integer, 300, 10_000_000)},
    **dict.fromkeys((*chain(*LIMIT_KEYS.values()), *HOME_KEYS.values()), (Keys.integer, -COUNTER_MAX, COUNTER_MAX)),
    **{"speed_steps_per_s": (Keys.number, 1e-3, 1e7), "acceleration_steps_per_s2": (Keys.number, 10.0, 1e5)},
    **{"laser_watchdog_s": (Keys.number, 0.1, 10.0), "settle_s": (Keys.number, 0.0, 3600.0), "options": _options},
}
_CAMERAS: dict[str, Kind] = {
    **{"driver": Keys.text, **dict.fromkeys(("source", "left", "right"), _device)},
    **dict.fromkeys(("width", "height"), (Keys.integer, 1, 65_535)),
    **{
        "exposure": (Keys.number, -100.0, 1e9),
        "spot_sd_px": (Keys.number, 1e-4, 100.0),
        "sighting_sd_deg": (Keys.number, 1e-7, 30.0),
    },
    "options": _options,
}


def _sheets(keys: Keys, key: str) -> dict[str, float]:
    """Depths of the sheets by name."""
    sheets = keys.table(key)
    for name in sheets.values:
        if not (name.isprintable() and 0 < len(name) <= 100):
            raise sheets.refuse(name, "text", "a printable name of 1 to 100 characters", "rename the sheet")
    return sheets.entries(dict.fromkeys(sheets.values, (Keys.number, 50.0, 100_000.0)))


def _lies_beside(name: str) -> bool:
    """Whether a file's name stays in the folder of the file that states it, or below, on every system."""
    windows = PureWindowsPath(name)
    leaves = Path(name).is_absolute() or windows.drive or windows.root or ".." in windows.parts
    return bool(name) and not leaves


_RIG: dict[str, Kind] = {
    **{"name": Keys.text, "notes": (Keys.text, 2000)},
    "stereo": (
        *(Keys.held, _lies_beside, "path", "a file name relative to the rig file, inside its folder"),
        "put the file beside the rig file and give its name",
        Keys.text,
    ),
    **{"rig": Keys.table, "truth": Keys.table, "sheets": _sheets, "positioner": (Keys.nested, _POSITIONER)},
    **{"cameras": (Keys.nested, _CAMERAS), "costs": (Keys.nested, dict.fromkeys(COSTS_S, (Keys.number, 0.0, 1e6)))},
}
"""Keys of a rig file."""


def _check_limits(table: Keys, positioner: Mapping[str, Any]) -> None:
    for lowest, highest in LIMIT_KEYS.values():
        if lowest in positioner and positioner[lowest] > positioner.get(highest, math.inf):
            raise table.refuse(highest, "limits", f"at least {lowest} = {positioner[lowest]}", "swap the two limits")


def _check_pictures(table: Keys, cameras: Mapping[str, Any], stereo: Stereo) -> None:
    """Require that the cameras take pictures of the size at which they are calibrated."""
    if stereo.right_image_size is not None:
        remedy = "record with the cameras' own program, then `tvsbayes new --pictures FOLDER`"
        found = "a stereo file of two picture sizes"
        raise table.refuse("stereo", "image-size", "cameras of one picture size", remedy, found)
    for key, size in (("width", stereo.image_width), ("height", stereo.image_height)):
        if cameras.get(key, size) != size:
            remedy = "calibrate and observe at one image size"
            raise table.refuse(key, "image-size", f"{size} px, as in the stereo file", remedy)


def _settings(entries: Mapping[str, Any]) -> dict[str, Setting]:
    """A table of settings with the options of its driver beside the others."""
    return {key: value for key, value in entries.items() if key != "options"} | entries.get("options", {})


def read_rig(path: Path) -> Rig:
    """Read a rig file (format tvsbayes-rig/1) and the stereo file it names.

    Raises:
        InputError: either file unreadable, unknown keys, values out of range, a stereo path that leaves
            the folder.
    """
    path = Path(path)
    keys = parse_toml(read_bytes(path, TOML_BYTES_MAX), escaped(path.name))
    stated = keys.values.get("rig")
    sightings = "stereo" not in keys and isinstance(stated, dict) and mechanism_named(stated.get("mechanism"), True)
    entries = keys.document("tvsbayes-rig/1", _RIG, () if sightings else ("stereo",))
    table = parse_rig_table(keys.table("rig"), bool(sightings))
    stereo = None if sightings else read_stereo(path.parent / entries["stereo"], folder=path.parent)
    positioner, cameras = (_settings(entries.get(name, {})) for name in ("positioner", "cameras"))
    _check_limits(keys.table("positioner"), positioner)
    if stereo is not None:
        _check_pictures(keys.table("cameras"), cameras, stereo)
    names = table.mechanism.rig_names
    return Rig(
        table=table,
        stereo=stereo,
        truth=table.priors | _priors(_flat(keys.table("truth"), names), table.harmonic_period_deg),
        sheets_mm=entries.get("sheets", {}),
        positioner=positioner,
        cameras={"spot_sd_px": SPOT_SD_PX, **cameras},
        costs_s=COSTS_S | entries.get("costs", {}),
        path=path,
        header={key: entries[key] for key in ("name", "notes") if key in entries},
    )
