"""The instrument as declared: parameter names and priors, the `[rig]` table, rig files.

Frames and units: DESIGN section 2. mm, degrees where a name says `_deg`, radians where it says `_rad`,
image px with the integer at the centre of a pixel. No JAX.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PureWindowsPath
from typing import Literal

from tvsbayes.files import TOML_BYTES_MAX, InputError, Keys, closest, escaped, parse_toml, read_bytes, toml_line
from tvsbayes.stereo import (
    STEREO_PARAMETER_NAMES,
    Stereo,
    read_stereo,
    rotation_matrix,
    rotation_vector,
    write_stereo,
)

__all__ = [
    "DECLARED_PRIORS",
    "DEFAULT_PRIORS",
    "HARMONIC_PRIORS",
    "HOME_SD_DEG",
    "RIG_PRIORS",
    "STEREO_PARAMETER_NAMES",
    "Distribution",
    "Prior",
    "Rig",
    "RigTable",
    "Stereo",
    "parse_rig_table",
    "read_rig",
    "read_stereo",
    "rig_table_toml",
    "rotation_matrix",
    "rotation_vector",
    "write_stereo",
]

Distribution = Literal["normal", "half-normal", "log-normal"]


@dataclass(frozen=True, slots=True)
class Prior:
    """One parameter's state of knowledge before the spots (DESIGN 3.2 and 7).

    `value` and `u` mean: normal: mean and standard uncertainty; half-normal: 0 and scale;
    log-normal: median and standard deviation of the logarithm. `u = 0` fixes the parameter.
    """

    value: float
    u: float
    distribution: Distribution = "normal"


DEFAULT_PRIORS: dict[str, Prior] = {
    "degrees_per_step.pan": Prior(0.06, 0.01),
    "degrees_per_step.tilt": Prior(0.07, 0.01),
    "ratio_contrast_deg_per_step.pan": Prior(0.0, 2e-4),
    "ratio_contrast_deg_per_step.tilt": Prior(0.0, 2e-4),
    "backlash_deg.pan": Prior(0.0, 0.5, "half-normal"),
    "backlash_deg.tilt": Prior(0.0, 0.5, "half-normal"),
    "tilt_zero_deg": Prior(0.0, 2.0),
    "mirror_offset_mm": Prior(30.0, 5.0),
    "mirror1_error_deg": Prior(0.0, 0.5),
    "mirror2_error_deg": Prior(0.0, 0.5),
    "laser_tilt_deg.x": Prior(0.0, 0.5),
    "laser_tilt_deg.y": Prior(0.0, 0.5),
    "laser_offset_mm.x": Prior(0.0, 0.5),
    "laser_offset_mm.y": Prior(0.0, 0.5),
    "tilt_axis_skew_deg": Prior(0.0, 0.5),
    "tilt_axis_offset_mm.x": Prior(0.0, 0.5),
    "tilt_axis_offset_mm.z": Prior(0.0, 0.5),
    "extrinsics.rotation_rad.x": Prior(0.0, 0.5),
    "extrinsics.rotation_rad.y": Prior(0.0, 0.5),
    "extrinsics.rotation_rad.z": Prior(0.0, 0.5),
    "extrinsics.translation_mm.x": Prior(0.0, 100.0),
    "extrinsics.translation_mm.y": Prior(0.0, 100.0),
    "extrinsics.translation_mm.z": Prior(0.0, 100.0),
    "stop_sd_deg.left": Prior(0.04, 1.0, "log-normal"),
    "stop_sd_deg.right": Prior(0.04, 1.0, "log-normal"),
    "stop_sd_deg.up": Prior(0.04, 1.0, "log-normal"),
    "stop_sd_deg.down": Prior(0.04, 1.0, "log-normal"),
    "pixel_scale": Prior(1.0, 0.5, "log-normal"),
}
"""Priors that `[rig.prior]` may replace, in the order of the parameter vector (DESIGN 3.2)."""

DECLARED_PRIORS: dict[str, Prior] = {
    "focal_scale": Prior(1.0, 0.002),
    "baseline_mm": Prior(200.0, 0.1),
    "pan_zero_emission_deg": Prior(90.0, 0.2),
    "aperture_zero_deg": Prior(0.0, 0.1),
    "aperture_sd_deg": Prior(0.02, 0.0, "log-normal"),
}
"""Entries of `[rig]` itself, with the defaults of DESIGN 7."""

HARMONIC_ORDERS = (1, 2)
HARMONIC_PRIORS: dict[str, Prior] = {
    f"harmonic_deg.{axis}.{order}.{part}": Prior(0.0, 0.0)
    for axis in ("pan", "tilt")
    for order in HARMONIC_ORDERS
    for part in ("cos", "sin")
}
"""Transmission error by axis, order and phase, part of `[rig.prior]` (DESIGN 3.1); none unless asked for."""

RIG_PRIORS: dict[str, Prior] = {**DEFAULT_PRIORS, **DECLARED_PRIORS, **HARMONIC_PRIORS}
"""Every prior of a rig with its default, in the order of the parameter vector."""

FULL_TURN_DEG = 360.0
"""Period of the wheel (the output member); a shorter one is the pinion's."""

HOME_SD_DEG = 0.05
"""Standard deviation of the home offset of every segment after the first (DESIGN 3.2, fixed)."""


@dataclass(frozen=True)
class RigTable:
    """The `[rig]` table of a campaign or rig file: every prior the estimators use.

    `priors` maps every name of `RIG_PRIORS` to its `Prior`; names left out take the default.
    `harmonic_period_deg` maps "pan" and "tilt", where declared, to the period of the transmission error in
    degrees of the output: `FULL_TURN_DEG` for the wheel, less for the pinion.

    Raises:
        InputError: harmonics of an axis without a period.
    """

    priors: dict[str, Prior] = field(default_factory=dict)
    aperture_convention: Literal["in-plane", "azimuth"] = "in-plane"
    harmonic_period_deg: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "priors", {**RIG_PRIORS, **self.priors})
        require_periods(self.priors, self.harmonic_period_deg)


@dataclass(frozen=True)
class Rig:
    """A rig file: the declared rig, its stereo calibration and how it is driven (DESIGN 7).

    `truth` is the distribution from which `simulate` and `study` draw true rigs (complete: names absent
    from `[truth]` take the prior). `sheets_mm` gives the nominal X of each named target in frame S.
    `positioner`, `cameras`, `costs_s` are the remaining tables, checked but otherwise as written (defaults
    filled in for `cameras["spot_sd_px"]`, the standard uncertainty stated for simulated spots, and for the
    costs). `header` holds name and notes.
    """

    table: RigTable
    stereo: Stereo
    truth: dict[str, Prior]
    sheets_mm: dict[str, float]
    positioner: dict[str, object]
    cameras: dict[str, object]
    costs_s: dict[str, float]
    path: Path | None = None
    header: dict[str, str] = field(default_factory=dict)


# Lowest and highest value and highest standard uncertainty by the first part of a name. Wide: they catch
# a wrong unit or a slipped key, not an unusual instrument.
_RANGES: dict[str, tuple[float, float, float]] = {
    "degrees_per_step": (1e-6, 10.0, 10.0),
    "ratio_contrast_deg_per_step": (-1.0, 1.0, 1.0),
    "backlash_deg": (0.0, 0.0, 45.0),
    "tilt_zero_deg": (-90.0, 90.0, 180.0),
    "mirror_offset_mm": (-1000.0, 1000.0, 1000.0),
    "mirror1_error_deg": (-30.0, 30.0, 30.0),
    "mirror2_error_deg": (-30.0, 30.0, 30.0),
    "laser_tilt_deg": (-30.0, 30.0, 30.0),
    "laser_offset_mm": (-100.0, 100.0, 100.0),
    "tilt_axis_skew_deg": (-30.0, 30.0, 30.0),
    "tilt_axis_offset_mm": (-100.0, 100.0, 100.0),
    "extrinsics": (-1e5, 1e5, 1e5),
    "stop_sd_deg": (1e-6, 10.0, 5.0),
    "pixel_scale": (1e-3, 1e3, 5.0),
    "focal_scale": (0.5, 2.0, 0.5),
    "baseline_mm": (1.0, 1e5, 1e4),
    "pan_zero_emission_deg": (0.0, 180.0, 180.0),
    "aperture_zero_deg": (-180.0, 180.0, 180.0),
    "aperture_sd_deg": (1e-6, 10.0, 5.0),
    "harmonic_deg": (-10.0, 10.0, 10.0),
}
_PRIOR_NAMES = (*DEFAULT_PRIORS, *HARMONIC_PRIORS)
_PERIOD_NAMES = {f"harmonic_period_deg.{axis}": axis for axis in ("pan", "tilt")}
_PERIOD_MIN_DEG = 1e-6
_GROUPS = {name.rsplit(".", n)[0] for name in (*RIG_PRIORS, *_PERIOD_NAMES, *STEREO_PARAMETER_NAMES) for n in (1, 2, 3)}


def _harmonic_without_period(priors: Mapping[str, Prior], period_deg: Mapping[str, float]) -> str | None:
    """The first harmonic that is not fixed at 0 on an axis whose period nobody stated."""
    for name in HARMONIC_PRIORS:
        prior = priors.get(name)
        if prior is not None and (prior.value != 0 or prior.u != 0) and name.split(".")[1] not in period_deg:
            return name
    return None


def _period_remedy(name: str) -> str:
    axis = name.split(".")[1]
    return (
        f'add "harmonic_period_deg.{axis}" = {{ value = P, u = 0.0 }} to [rig]: degrees of the output per turn of the '
        f"faulty member, {FULL_TURN_DEG:g} for the wheel, {FULL_TURN_DEG:g} x teeth of the pinion / teeth of the wheel "
        "for the pinion"
    )


def require_periods(priors: Mapping[str, Prior], period_deg: Mapping[str, float]) -> None:
    """Refuse harmonics whose period is unknown: they would be an error at no known angle.

    Raises:
        InputError: a harmonic with a value or u other than 0 on an axis without a period.
    """
    name = _harmonic_without_period(priors, period_deg)
    if name is not None:
        message = f"{name} has no period"
        raise InputError("missing-period", message, column=name, remedy=_period_remedy(name))


def _explanation(name: str, allowed: tuple[str, ...]) -> str:
    """What to do about a name that may not stand where it does."""
    stem, _, last = name.partition(".")
    if name in DECLARED_PRIORS:
        return "it belongs into [rig] itself, not into [rig.prior]"
    if name in _PERIOD_NAMES:
        return "it belongs into [rig] itself: tooth counts fix it, so it has no prior and no other truth"
    if name in _PRIOR_NAMES:
        return "it belongs into [rig.prior]"
    if stem == "degrees_per_step" and last in ("left", "right", "up", "down"):
        axis = "pan" if last in ("left", "right") else "tilt"
        return f"it is derived: state degrees_per_step.{axis} and ratio_contrast_deg_per_step.{axis}"
    if stem == "effective_mirror_offset_mm":
        return "it is derived: state mirror_offset_mm"
    if stem == "stereo":
        return "stereo parameters and their covariance come from stereo.json"
    return closest(name, allowed)


def _entries(table: Keys, prefix: str = "") -> Iterator[tuple[Keys, str, str]]:
    """Every entry as (its table, its key there, its full name), quoted or dotted keys alike."""
    for key, value in table.values.items():
        name = prefix + key
        if isinstance(value, dict) and value and name in _GROUPS and not {"value", "u"} & set(value):
            yield from _entries(table.table(key), name + ".")
        else:
            yield table, key, name


def _parse_priors(table: Keys, allowed: tuple[str, ...]) -> dict[str, Prior]:
    """The priors of one table, checked; `allowed` lists the names that may stand in it."""
    priors: dict[str, Prior] = {}
    for keys, key, name in _entries(table):
        if name not in allowed:
            names = "only " + ", ".join(allowed)
            found = f"the name {escaped(name)}"
            raise keys.refuse(key, "unknown-key", names, _explanation(name, allowed), found)
        if name in priors:
            raise keys.refuse(key, "duplicate-key", "every name once", "remove one", f"{name} twice")
        if name in _PERIOD_NAMES:
            priors[name] = Prior(_parse_period(keys, key), 0.0)
            continue
        distribution = RIG_PRIORS[name].distribution
        low, high, u_max = _RANGES[name.partition(".")[0]]
        if name.startswith("extrinsics.rotation_rad"):
            low, high, u_max = -3.15, 3.15, 3.15
        value, u = keys.quantity(key, low, high, u_max)
        priors[name] = Prior(value, u, distribution)
    return priors


def _parse_period(keys: Keys, key: str) -> float:
    """A period in degrees of the output; exact, since it follows from tooth counts."""
    period_deg, u = keys.quantity(key, _PERIOD_MIN_DEG, FULL_TURN_DEG, FULL_TURN_DEG)
    if u != 0:
        remedy = "write u = 0.0: tooth counts give the period exactly (the wheel's is 360)"
        raise keys.refuse(key, "period-uncertain", "a period with u = 0", remedy)
    return period_deg


def _check_periods(table: Keys, priors: Mapping[str, Prior], period_deg: Mapping[str, float]) -> None:
    """`require_periods` with the place in the file."""
    name = _harmonic_without_period(priors, period_deg)
    if name is not None:
        allowed = "harmonics of an axis whose period is stated"
        raise table.refuse(name, "missing-period", allowed, _period_remedy(name), "a harmonic without a period")


def parse_rig_table(table: Keys) -> RigTable:
    """The `[rig]` table with its `[rig.prior]`; absent entries take their defaults.

    Raises:
        InputError: unknown or misplaced names, entries that are not { value, u }, values out of range,
            a half-normal with a value other than 0, harmonics without a period, a period with u > 0.
    """
    own = {k: v for k, v in table.values.items() if k not in ("aperture_convention", "prior")}
    own_keys = Keys(own, table.file, table.text, table.path)
    declared = _parse_priors(own_keys, (*DECLARED_PRIORS, *_PERIOD_NAMES))
    period_deg = {axis: declared.pop(name).value for name, axis in _PERIOD_NAMES.items() if name in declared}
    prior = _parse_priors(table.table("prior"), _PRIOR_NAMES)
    _check_periods(table.table("prior"), prior, period_deg)
    key = "aperture_convention"
    azimuth = key in table and table.word(key, ("in-plane", "azimuth")) == "azimuth"
    return RigTable({**prior, **declared}, "azimuth" if azimuth else "in-plane", period_deg)


def rig_table_toml(table: RigTable) -> str:
    """`[rig]` and `[rig.prior]` with every entry, also those at their defaults, so that a file says all.

    Harmonics stand only where they mean something: on an axis with a period.
    """

    def entry(name: str) -> str:
        prior = table.priors[name]
        return toml_line(name, {"value": float(prior.value), "u": float(prior.u)})

    convention = toml_line("aperture_convention", table.aperture_convention)
    periods = [
        toml_line(name, {"value": float(table.harmonic_period_deg[axis]), "u": 0.0})
        for name, axis in _PERIOD_NAMES.items()
        if axis in table.harmonic_period_deg
    ]
    harmonics = [entry(name) for name in HARMONIC_PRIORS if name.split(".")[1] in table.harmonic_period_deg]
    declared, priors = map(entry, DECLARED_PRIORS), map(entry, DEFAULT_PRIORS)
    return "\n".join(["[rig]", *declared, *periods, convention, "[rig.prior]", *priors, *harmonics]) + "\n"


_COSTS_S = {"move_s": 1.5, "look_s": 1.0, "placement_s": 60.0}
_COUNTER_MAX = 10**8


def _parse_positioner(table: Keys) -> dict[str, object]:
    """`[positioner]`: driver, port, limits and speeds."""
    limits = ("pan_min_steps", "pan_max_steps", "tilt_min_steps", "tilt_max_steps")
    table.only(("driver", "port", "baud", *limits, "speed_steps_per_s", "settle_s"))
    values: dict[str, object] = {key: table.text_value(key) for key in ("driver", "port") if key in table}
    if "baud" in table:
        values["baud"] = table.integer("baud", 300, 10_000_000)
    steps = {key: table.integer(key, -_COUNTER_MAX, _COUNTER_MAX) for key in limits if key in table}
    for axis in ("pan", "tilt"):
        low, high = steps.get(f"{axis}_min_steps"), steps.get(f"{axis}_max_steps")
        if low is not None and high is not None and low > high:
            key = f"{axis}_max_steps"
            raise table.refuse(key, "limits", f"at least {axis}_min_steps = {low}", "swap the two limits")
    for key, low_s, high_s in (("speed_steps_per_s", 1e-3, 1e7), ("settle_s", 0.0, 3600.0)):
        if key in table:
            values[key] = table.number(key, low_s, high_s)
    return {**values, **steps}


def _parse_cameras(table: Keys, stereo: Stereo) -> dict[str, object]:
    """`[cameras]`: source, devices, size (that of the calibration), exposure, spot uncertainty."""
    table.only(("source", "left", "right", "width", "height", "exposure", "spot_sd_px"))
    values: dict[str, object] = {"spot_sd_px": 0.08}
    if "source" in table:
        values["source"] = table.text_value("source")
    for key in ("left", "right"):
        if key in table:
            device = isinstance(table.values[key], str)
            values[key] = table.text_value(key) if device else table.integer(key, 0, 1000)
    for key, calibrated in (("width", stereo.image_width), ("height", stereo.image_height)):
        if key in table:
            values[key] = table.integer(key, 1, 65_535)
            if values[key] != calibrated:
                remedy = "calibrate and observe at one image size"
                raise table.refuse(key, "image-size", f"{calibrated} px, as in the stereo file", remedy)
    for key, low, high in (("exposure", -100.0, 1e9), ("spot_sd_px", 1e-4, 100.0)):
        if key in table:
            values[key] = table.number(key, low, high)
    return values


def _beside(keys: Keys, key: str, folder: Path) -> Path:
    """The file that `key` names, which must lie in the folder of the rig file or below."""
    name = keys.text_value(key)
    windows = PureWindowsPath(name)
    if not name or Path(name).is_absolute() or windows.drive or windows.root or ".." in windows.parts:
        allowed = "a file name relative to the rig file, inside its folder"
        raise keys.refuse(key, "path", allowed, "put the file beside the rig file and give its name")
    return folder / name


def read_rig(path: Path) -> Rig:
    """Reads a rig file (format tvsbayes-rig/1, DESIGN 7) and the stereo file it names.

    Raises:
        InputError: either file unreadable, unknown keys, values out of range, a stereo path that leaves
            the folder.
    """
    path = Path(path)
    keys = parse_toml(read_bytes(path, TOML_BYTES_MAX), escaped(path.name))
    keys.word("format", ("tvsbayes-rig/1",))
    tables = ("rig", "truth", "sheets", "positioner", "cameras", "costs")
    keys.only(("format", "name", "notes", "stereo", *tables))
    header = {key: keys.text_value(key, cap) for key, cap in (("name", 200), ("notes", 2000)) if key in keys}
    stereo = read_stereo(_beside(keys, "stereo", path.parent), folder=path.parent)
    table = parse_rig_table(keys.table("rig"))
    sheets = keys.table("sheets")
    for name in sheets.values:
        if not (name.isprintable() and 0 < len(name) <= 100):
            raise sheets.refuse(name, "text", "a printable name of 1 to 100 characters", "rename the sheet")
    costs = keys.table("costs")
    costs.only(_COSTS_S)
    truth = {**table.priors, **_parse_priors(keys.table("truth"), tuple(RIG_PRIORS))}
    _check_periods(keys.table("truth"), truth, table.harmonic_period_deg)
    return Rig(
        table=table,
        stereo=stereo,
        truth=truth,
        sheets_mm={name: sheets.number(name, 50.0, 100_000.0) for name in sheets.values},
        positioner=_parse_positioner(keys.table("positioner")),
        cameras=_parse_cameras(keys.table("cameras"), stereo),
        costs_s={k: costs.number(k, 0.0, 1e6) if k in costs else v for k, v in _COSTS_S.items()},
        path=path,
        header=header,
    )
