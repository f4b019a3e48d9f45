"""List of the instruments with two axes: mechanism of the beam, kind of observation, parameters.

An instrument has its own parameters and no other's; they are the coordinates of its vectors, in their order.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

from tvsbayes.instrument.axes import AXES, SIDES
from tvsbayes.instrument.parameters import (
    BLOCKS,
    CAMERAS,
    GEARS,
    LOOKS,
    MIRRORS,
    RECEIVER_NAMES,
    REGISTRY,
    STEREO_PARAMETER_NAMES,
    TERMS,
    Parameter,
    Prior,
    names_of,
)
from tvsbayes.instrument.quantities import Quantities

if TYPE_CHECKING:
    import numpy as np

RATIO_COLUMNS, CONTRAST_COLUMNS, BACKLASH_COLUMNS = (
    [number for number, parameter in enumerate(GEARS) if parameter.block == block]
    for block in ("degrees_per_step", "ratio_contrast_deg_per_step", "backlash_deg")
)
"""Coordinates of ratios, contrasts and plays, with which every instrument begins."""


@dataclass(frozen=True, eq=False)
class Mechanism:
    """A kind of instrument.

    Attributes:
        key: its name in the program.
        word: its name in rig and campaign files.
        path: parameters of the beam's path, the zero of the tilt axis first.
        constants: values of what its model has and it lacks, such as a receiver; they are no parameters of it.
        own_priors: priors that replace the registry's.
        absent: derived quantities that it lacks.
        all_round: its axes turn all round; else the beam is aimed ahead only.
        sightings: looks are sightings; else spots seen by a stereo pair.
        noise: name of the noise of its looks.
        residuals: independent residuals of a look without the aperture: four pixels less the range, or two angles.
    """

    key: str
    word: str
    path: tuple[Parameter, ...] = MIRRORS
    constants: Mapping[str, float] = field(default_factory=dict)
    own_priors: Mapping[str, Prior] = field(default_factory=dict)
    absent: tuple[str, ...] = ()
    all_round: bool = False
    sightings: bool = False
    noise: str = "pixel noise"
    residuals: int = 3

    def __reduce__(self) -> tuple[Callable[[str], Mechanism], tuple[str]]:
        """Copying, also to another process, returns the entry of the list: mechanisms are compared by identity."""
        return mechanism_by_key, (self.key,)

    @property
    def declared(self) -> tuple[Parameter, ...]:
        """Its parameters and constants of the rig, in the order in which true rigs are drawn."""
        return (*GEARS, *self.path, *LOOKS)

    @cached_property
    def parameters(self) -> Quantities[Parameter]:
        """Every parameter by its name, in the order of the coordinates: those of `[rig]`, then the cameras."""
        return Quantities(*(each for each in (*self.declared, *CAMERAS) if each.name not in self.constants))

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of all coordinates."""
        return tuple(self.parameters)

    @cached_property
    def index(self) -> dict[str, int]:
        """Coordinates by name."""
        return {name: number for number, name in enumerate(self.names)}

    @cached_property
    def rig_names(self) -> tuple[str, ...]:
        """Names of coordinates with a prior in `[rig]`, which come first."""
        return tuple(name for name, of in self.parameters.items() if of.place != "stereo")

    def columns(self, *names_or_blocks: str) -> np.ndarray:
        """Coordinates of parameters or whole blocks, those that the instrument has, in the order of the arguments."""
        import numpy as np

        names = (name for each in names_or_blocks for name in BLOCKS.get(each, (each,)))
        return np.array([self.index[name] for name in names if name in self.index], dtype=int)

    @cached_property
    def stop_columns(self) -> np.ndarray:
        """Coordinates of the stop sds by axis and side, (right, left) and (down, up): shape (2, 2)."""
        import numpy as np

        return np.array([[self.index[f"stop_sd_deg.{side}"] for side in SIDES[axis]] for axis in AXES])

    @cached_property
    def optics_names(self) -> tuple[str, ...]:
        """Names of the geometry of the beam's path, without the zero of the tilt axis."""
        return tuple(parameter.name for parameter in self.path[1:])

    @cached_property
    def has_receiver(self) -> bool:
        """Whether a receiver may see its beam."""
        return "aperture_zero_deg" in self.parameters

    @cached_property
    def tilt_zero(self) -> str:
        """Name of the zero of the tilt axis."""
        return self.path[0].name

    @cached_property
    def zeros(self) -> tuple[str, str]:
        """Names of the parameters that shift the pan angle and the tilt angle as a whole."""
        own = {parameter.name for parameter in self.path}
        return "azimuth_zero_deg" if "azimuth_zero_deg" in own else "pan_zero_emission_deg", self.tilt_zero

    @cached_property
    def prior_groups(self) -> dict[str, list[int]]:
        """Coordinates by cause of uncertainty, the stereo calibration first."""
        columns, rig = list(enumerate(self.parameters.values())), len(self.rig_names)
        groups: dict[str, list[int]] = {}
        for column, parameter in (*columns[rig:], *columns[:rig]):
            groups.setdefault(parameter.cause, []).append(column)
        return groups

    @cached_property
    def priors(self) -> dict[str, Prior]:
        """Default priors of the parameters of `[rig]`."""
        return {name: self.own_priors.get(name, REGISTRY[name].prior) for name in self.rig_names}


_LASER = dict.fromkeys(("azimuth_zero_deg", "azimuth_axis_tilt_deg.north", "azimuth_axis_tilt_deg.east"), 0.0)
"""Gauge of a head whose spots a stereo pair sees: its frame P depends on the azimuth axis, and its pose is fitted."""
_RECEIVER = {name: REGISTRY[name].prior.value for name in RECEIVER_NAMES} | {"baseline_mm": 0.0}
"""No receiver: frame T is frame P."""
_SIGHT = {
    **dict.fromkeys(("elevation_axis_offset_mm", "beam_offset_mm.y", "beam_offset_mm.z"), 0.0),
    **dict.fromkeys(names_of("extrinsics.rotation_rad", "extrinsics.translation_mm"), 0.0),
    **dict.fromkeys(STEREO_PARAMETER_NAMES, 0.0),
    "focal_scale": 1.0,
}
"""A head with sightings has neither cameras nor lengths."""
TWO_MIRROR = Mechanism("two-mirror", "two-mirror")
HEAD = Mechanism(
    "pan-tilt", "pan-tilt", TERMS, _LASER | _RECEIVER, absent=("effective_mirror_offset_mm",), all_round=True
)
SIGHTING_HEAD = replace(
    HEAD,
    key="pan-tilt-sightings",
    constants=_SIGHT | _RECEIVER,
    own_priors={"flexure_deg": Prior(0.0, 0.1)},
    sightings=True,
    noise="noise of sightings",
    residuals=2,
)
MECHANISMS: dict[str, Mechanism] = {mechanism.key: mechanism for mechanism in (TWO_MIRROR, HEAD, SIGHTING_HEAD)}
"""Mechanisms by key."""
WORDS: tuple[str, ...] = tuple(dict.fromkeys(mechanism.word for mechanism in MECHANISMS.values()))
"""Values of the key `mechanism` in files, the default first."""


def mechanism_by_key(key: str) -> Mechanism:
    """The entry of the list."""
    return MECHANISMS[key]


def mechanism_named(word: object, sightings: bool) -> Mechanism | None:
    """The entry with this word in files and this kind of looks; None where there is none."""
    kinds = MECHANISMS.values()
    return next((kind for kind in kinds if (kind.word, kind.sightings) == (word, sightings)), None)


def mechanism_of(names: Container[str]) -> Mechanism:
    """The first entry with such parameters, by the name of the zero of the tilt axis; without one the scanner."""
    return next((kind for kind in MECHANISMS.values() if kind.tilt_zero in names), TWO_MIRROR)
