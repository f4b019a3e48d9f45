"""Registry of parameters: name, unit, prior, range and block of each, in the order of vectors and files.

Units are those of the names: degrees where a name says `deg`, radians where it says `rad`, mm, px; "1" has none.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, Literal, get_args

from tvsbayes.instrument.axes import AXES, DIRECTIONS
from tvsbayes.instrument.quantities import Quantities, Quantity, Unit

Distribution = Literal["normal", "half-normal", "log-normal"]
KINDS: tuple[Distribution, ...] = get_args(Distribution)
Place = Literal["rig", "rig.prior", "stereo"]
HARMONIC_ORDERS = (1, 2)
"""Orders of a transmission error with a stated shape, in turns per period."""
PERIODS_MAX = 3
"""Largest number of periods of one axis' transmission error: those of wheel, pinion and teeth."""


@dataclass(frozen=True, slots=True)
class Prior:
    """Prior distribution of one parameter.

    `value` and `u` mean: normal: mean and standard uncertainty; half-normal: 0 and scale;
    log-normal: median and standard deviation of the logarithm. `u = 0` fixes the parameter.
    """

    value: float
    u: float
    distribution: Distribution = "normal"


UNSTATED = Prior(0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class Parameter(Quantity):
    """One parameter of the instrument.

    Attributes:
        place: the table `[rig]` or `[rig.prior]` of a file, or the stereo calibration.
        prior: default prior; the cameras' prior is the covariance of their calibration.
        low, high, u_max: lowest and highest value and highest standard uncertainty that a file may state. Wide: they
            detect a wrong unit or a typing error, not an unusual instrument.
        noise: a scale of noise: the point estimate alternates between noise scales and geometry with stereo.
        receiver: observable only through aperture readings.
    """

    place: Place
    prior: Prior = UNSTATED
    low: float = -math.inf
    high: float = math.inf
    u_max: float = math.inf
    noise: bool = False
    receiver: bool = False

    @property
    def cause(self) -> str:
        """Name of its cause in budgets of uncertainty; the stereo calibration is one cause, and so is a block."""
        if self.place == "stereo":
            return "stereo calibration"
        return "focal scale" if self.name == "focal_scale" else f"prior of {self.name.split('.')[0]}"


def _block(
    block: str,
    parts: Collection[str],
    unit: Unit,
    prior: Prior,
    limits: tuple[float, float, float],
    words: str,
    label: str = "",
    place: Place = "rig.prior",
    **fields: Any,
) -> list[Parameter]:
    """Make parameters that differ only in their parts; limits are `low`, `high` and `u_max`."""
    fields |= {"unit": unit, "prior": prior, "words": words, "label": label, "place": place}
    return Parameter.many(block, parts, **fields, **dict(zip(("low", "high", "u_max"), limits, strict=True)))


def _cameras() -> tuple[Parameter, ...]:
    """The stereo calibration, with OpenCV's names and order; its file has its own reader and limits."""
    units: dict[str, Unit] = {name: "px" for name in ("fx", "fy", "cx", "cy")}
    units |= {name: "1" for name in ("k1", "k2", "p1", "p2", "k3")}
    units_of = {f"stereo.{side}": units for side in ("left", "right")}
    units_of |= {
        "stereo.rotation_rad": dict.fromkeys("xyz", "rad"),
        "stereo.translation_mm": dict.fromkeys("xyz", "mm"),
    }
    return tuple(
        Parameter(name=f"{block}.{part}", block=block, unit=unit, place="stereo")
        for block, block_units in units_of.items()
        for part, unit in block_units.items()
    )


_SMALL, _XYZ = Prior(0.0, 0.5), ("x", "y", "z")
_RATIO, _ANGLE, _LENGTH, _SD = (1e-6, 10.0, 10.0), (-30.0, 30.0, 30.0), (-100.0, 100.0, 100.0), (1e-6, 10.0, 5.0)
_SCALE, _REACH = (0.0, 0.0, 10.0), (0.1, 360.0, 5.0)
_AMPLITUDES = tuple(f"{axis}.{number}" for axis in AXES for number in range(1, PERIODS_MAX + 1))
_HARMONICS = tuple(f"{axis}.{order}.{part}" for axis in AXES for order in HARMONIC_ORDERS for part in ("cos", "sin"))
_OF_GEARS = "the ratio of the gears"
GEARS = (
    *_block("degrees_per_step", ("pan",), "deg/step", Prior(0.06, 0.01), _RATIO, _OF_GEARS, headline=True),
    *_block("degrees_per_step", ("tilt",), "deg/step", Prior(0.07, 0.01), _RATIO, _OF_GEARS, headline=True),
    *_block("ratio_contrast_deg_per_step", AXES, "deg/step", Prior(0.0, 2e-4), (-1.0, 1.0, 1.0),
            "the difference of the ratios of both directions"),
    *_block("backlash_deg", AXES, "deg", Prior(0.0, 0.5, "half-normal"), (0.0, 0.0, 45.0),
            "the backlash", "backlash {0}", headline=True, judged=True, target="backlash.{0}"),
)  # fmt: skip
"""Ratios and play, the first coordinates of every instrument."""
MIRRORS = (
    *_block("tilt_zero_deg", (), "deg", Prior(0.0, 2.0), (-90.0, 90.0, 180.0), "the tilt mirror at counter 0"),
    *_block("mirror_offset_mm", (), "mm", Prior(30.0, 5.0), (-1000.0, 1000.0, 1000.0),
            "the mirror offset", "mirror offset L"),
    *_block("mirror1_error_deg", (), "deg", _SMALL, _ANGLE, "the angle of mirror 1"),
    *_block("mirror2_error_deg", (), "deg", _SMALL, _ANGLE, "the angle of mirror 2"),
    *_block("laser_tilt_deg", ("x", "y"), "deg", _SMALL, _ANGLE, "the laser's direction"),
    *_block("laser_offset_mm", ("x", "y"), "mm", _SMALL, _LENGTH, "the laser's place"),
    *_block("tilt_axis_skew_deg", (), "deg", _SMALL, _ANGLE, "the skew of the tilt axis"),
    *_block("tilt_axis_offset_mm", ("x", "z"), "mm", _SMALL, _LENGTH, "the place of the tilt axis"),
)  # fmt: skip
"""The beam's path through the scanner, the zero of the tilt axis first."""
LOOKS = (
    *_block("extrinsics.rotation_rad", _XYZ, "rad", Prior(0.0, 0.5), (-3.15, 3.15, 3.15),
            "the positioner's attitude", "positioner turned about {0}"),
    *_block("extrinsics.translation_mm", _XYZ, "mm", Prior(0.0, 100.0), (-1e5, 1e5, 1e5),
            "the positioner's place", "positioner at {0}"),
    *_block("stop_sd_deg", DIRECTIONS, "deg", Prior(0.04, 1.0, "log-normal"), _SD,
            "the scatter of stops", "stop scatter {0}", noise=True),
    *_block("pixel_scale", (), "1", Prior(1.0, 0.5, "log-normal"), (1e-3, 1e3, 5.0),
            "the noise of looks over the stated one", "noise, estimated / stated", noise=True),
    *_block("focal_scale", (), "1", Prior(1.0, 0.002), (0.5, 2.0, 0.5), "the focal scale", place="rig"),
    *_block("baseline_mm", (), "mm", Prior(200.0, 0.1), (1.0, 1e5, 1e4), "the baseline", place="rig", receiver=True),
    *_block("pan_zero_emission_deg", (), "deg", Prior(90.0, 0.2), (0.0, 180.0, 180.0),
            "the emission angle at pan 0", place="rig", receiver=True),
    *_block("aperture_zero_deg", (), "deg", Prior(0.0, 0.1), (-180.0, 180.0, 180.0),
            "the aperture's zero", place="rig", receiver=True),
    *_block("aperture_sd_deg", (), "deg", Prior(0.02, 0.0, "log-normal"), _SD,
            "the scatter of aperture readings", place="rig", noise=True, receiver=True),
    # The transmission error is zero unless a rig states it or an option of the fit frees it.
    *_block("harmonic_deg", _HARMONICS, "deg", UNSTATED, (-10.0, 10.0, 10.0), "the periodic error of the gears"),
    *_block("transmission_error_deg", AXES, "deg", Prior(0.0, 0.05, "half-normal"), _SCALE,
            "the transmission error, sd", "transmission error sd, {0}", noise=True),
    *_block("transmission_error_length_deg", AXES, "deg", Prior(8.0, 0.7, "log-normal"), _REACH,
            "the angle over which the transmission error changes", "correlation length, {0}", noise=True),
    *_block("play_variation_deg", AXES, "deg", Prior(0.0, 0.02, "half-normal"), _SCALE,
            "the variation of play, sd", "play variation sd, {0}", noise=True),
    *_block("drift_deg_per_root_hour", AXES, "deg", Prior(0.0, 0.02, "half-normal"), _SCALE,
            "the drift in a root hour, sd", "drift of the zero per root hour, {0}", noise=True),
    *_block("harmonic_amplitude_deg", _AMPLITUDES, "deg", Prior(0.0, 0.05, "half-normal"), _SCALE,
            "the amplitude of a periodic error", "period {1}, amplitude sd, {0}", noise=True),
    *_block("look_scatter_deg", AXES, "deg", Prior(0.0, 0.01, "half-normal"), _SCALE,
            "the scatter of looks, sd", "look scatter {0}", noise=True),
    *_block("creep_deg", AXES, "deg", Prior(0.0, 0.05), (-10.0, 10.0, 10.0),
            "the creep of the zero", "creep of the zero, {0}"),
    *_block("creep_minutes", (), "min", Prior(20.0, 0.8, "log-normal"), (1e-3, 1e5, 5.0),
            "the time constant of the creep"),
    *_block("thermal_deg_per_K", AXES, "deg/K", Prior(0.0, 0.01), (-10.0, 10.0, 10.0),
            "the shift of the zero per kelvin", "zero per kelvin, {0}"),
    *_block("home_sd_deg", AXES, "deg", Prior(0.05, 1.0, "log-normal"), (1e-9, 10.0, 5.0),
            "the scatter of homings, sd", "homing scatter {0}", noise=True),
)  # fmt: skip
"""Pose, scatter of stops and looks, receiver, errors of the gears that repeat or vary, shifts of the zeros."""
CAMERAS = _cameras()
"""The stereo pair, the last coordinates of an instrument whose spots it sees."""
_TURN, _TERM = Prior(0.0, 10.0), Prior(0.0, 0.5)
TERMS = (
    *_block("elevation_zero_deg", (), "deg", _TURN, (-360.0, 360.0, 360.0),
            "the elevation at counter 0", "elevation at counter 0"),
    *_block("elevation_axis_offset_mm", (), "mm", _SMALL, (-1000.0, 1000.0, 1000.0),
            "the elevation axis before the azimuth axis", "elevation axis ahead"),
    *_block("axes_not_square_deg", (), "deg", _TERM, _ANGLE, "the axes not square to each other", "axes not square"),
    *_block("beam_not_square_deg", (), "deg", _TERM, _ANGLE,
            "the beam not square to the elevation axis", "beam not square"),
    *_block("azimuth_axis_tilt_deg", ("north", "east"), "deg", _TERM, _ANGLE,
            "the lean of the azimuth axis", "azimuth axis leans {0}"),
    *_block("beam_offset_mm", ("y", "z"), "mm", _SMALL, _LENGTH, "the beam off the elevation axis",
            "beam off axis, {0}"),
    *_block("flexure_deg", (), "deg", UNSTATED, _ANGLE, "the flexure with cos(elevation)", "flexure, cos(elevation)"),
    *_block("azimuth_zero_deg", (), "deg", _TURN, (-360.0, 360.0, 360.0),
            "the azimuth at counter 0", "azimuth at counter 0"),
    *_block("tangent_flexure_deg", (), "deg", UNSTATED, _ANGLE,
            "the flexure with cot(elevation)", "flexure, cot(elevation)"),
)  # fmt: skip
"""The line of sight of a head, the zero of the elevation axis first, with TPOINT's names: elevation_zero IE,
azimuth_zero -IA, azimuth_axis_tilt north AN and east -AW, axes_not_square NPAE, beam_not_square CA, flexure TF,
tangent_flexure TX."""
_many = Quantity.many
_LINES = (
    *_many("effective_deg_per_step", DIRECTIONS, unit="deg/step", words="the effective ratio", label="effective {0}",
           headline=True, judged=True, ratio=True, target="{0}", stated="degrees_per_step.{axis}"),
    *_many("effective_contrast_deg_per_step", AXES, unit="deg/step", label="{sides}",
           words="the difference of the effective ratios", headline=True, ratio=True, target="contrast.{0}"),
)  # fmt: skip
_DERIVED = (
    *_many("degrees_per_step", DIRECTIONS, unit="deg/step", words=_OF_GEARS),
    *_many("effective_mirror_offset_mm", (), unit="mm", words="beam off the pan axis", label="beam off the pan axis",
           headline=True, target="mirror_offset", stated="mirror_offset_mm"),
    *_many("local_deg_per_step", DIRECTIONS, unit="deg/step", words="the local ratio", ratio=True),
    *_many("transmission_error_at_deg", (), unit="deg", words="the transmission error"),
    *_many("play_variation_at_deg", (), unit="deg", words="the variation of play"),
)  # fmt: skip

REGISTRY = Quantities(*GEARS, *MIRRORS, *TERMS, *LOOKS, *CAMERAS)
"""Every parameter of an instrument with two axes by its name; which of them an instrument has: `mechanisms`."""
BLOCKS = REGISTRY.blocks
"""Names by block; the parameters of a block are consecutive."""


def names_of(*blocks: str) -> tuple[str, ...]:
    """Names of the parameters of blocks, in the order of the arguments."""
    return tuple(name for block in blocks for name in BLOCKS[block])


STEREO_PARAMETER_NAMES: tuple[str, ...] = tuple(p.name for p in CAMERAS)
"""The 24 stereo parameters in the order of `parameter_covariance` of a stereo file."""
HARMONIC_NAMES = names_of("harmonic_deg")
"""Transmission error by axis, order and phase."""
AMPLITUDE_NAMES = names_of("harmonic_amplitude_deg")
"""Amplitudes of the periodic parts of the transmission error by axis and number of the stated period."""
GEAR_ERROR_NAMES = names_of(
    *("transmission_error_deg", "transmission_error_length_deg", "play_variation_deg", "drift_deg_per_root_hour"),
    "harmonic_amplitude_deg",
)
"""Scales of the gears' errors that repeat by position, of play that varies and of zeros that drift."""
OPTICS_NAMES: tuple[str, ...] = tuple(p.name for p in MIRRORS[1:])
"""Geometry of the beam's path through the scanner; all but the first are zero in the nominal rig."""
LOOK_SCATTER_NAMES = names_of("look_scatter_deg")
"""Sds of the deviation of the beam's angle at a look from the angle of the axis."""
CREEP_NAMES = names_of("creep_deg", "creep_minutes")
"""Creep of the zeros during warm-up, and its time constant, which both zeros share."""
ZERO_SHIFT_NAMES = names_of("creep_deg", "creep_minutes", "thermal_deg_per_K")
"""Shifts of the zeros in time and with the temperature."""
HOME_SD_NAMES = names_of("home_sd_deg")
"""Sds of the shift of a zero by a homing, by axis."""
LATE_NAMES = (*LOOK_SCATTER_NAMES, *ZERO_SHIFT_NAMES, *HOME_SD_NAMES)
"""Parameters that earlier versions did not have: files omit them where they have their defaults."""
NOISE_NAMES: tuple[str, ...] = tuple(p.name for p in LOOKS if p.noise)
RECEIVER_NAMES: tuple[str, ...] = tuple(p.name for p in LOOKS if p.receiver)
QUANTITIES: Quantities[Quantity] = Quantities(*_LINES, *REGISTRY.values(), *_DERIVED)
"""Quantities of scanner and head: parameters and derived quantities. `HEADLINES` and `TARGETS` have this order."""
HEADLINES = tuple(quantity for quantity in QUANTITIES.values() if quantity.headline)
TARGETS = {quantity.target: quantity for quantity in HEADLINES if quantity.target}
"""Headlines that plans and studies may target, by their target names."""
TARGET_ROWS = {target: row for row, target in enumerate(TARGETS)}


def unit_of(name: str) -> str:
    """Unit of a parameter or a derived quantity: `backlash_deg.pan` -> deg; "1" where it has none."""
    quantity = QUANTITIES.of(name)
    if quantity is None:
        raise KeyError(name)
    return quantity.unit
