"""List of the instruments with two axes: mechanism of the beam, kind of observation, names of the geometry.

Vectors of parameters have one layout (`parameters.NAMES`). A mechanism other than the scanner uses the coordinates of
the mirrors for its own terms: the gears' coordinates, and every array, are the same.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

from tvsbayes.instrument.parameters import (
    HEAD_TERMS,
    NAMES,
    RECEIVER_NAMES,
    REGISTRY,
    RIG_NAMES,
    STEREO_PARAMETER_NAMES,
    Parameter,
    Prior,
    names_of,
)


@dataclass(frozen=True)
class Mechanism:
    """A kind of instrument.

    Attributes:
        key: its name in the program.
        word: its name in rig and campaign files.
        terms: terms of its geometry, by the scanner's parameter whose coordinate they use.
        fixed: values of parameters that do not apply to it; documents omit them.
        own_priors: priors that replace the registry's.
        absent: derived quantities that it lacks.
        all_round: its axes turn all round; else the beam is aimed ahead only.
        sightings: looks are sightings; else spots seen by a stereo pair.
        noise: name of the noise of its looks.
        residuals: independent residuals of a look without the aperture: four pixels less the range, or two angles.
    """

    key: str
    word: str
    terms: Mapping[str, Parameter] = field(default_factory=dict)
    fixed: Mapping[str, float] = field(default_factory=dict)
    own_priors: Mapping[str, Prior] = field(default_factory=dict)
    absent: tuple[str, ...] = ()
    all_round: bool = False
    sightings: bool = False
    noise: str = "pixel noise"
    residuals: int = 3

    def __reduce__(self) -> tuple[Callable[[str], Mechanism], tuple[str]]:
        """Copying, also to another process, returns the entry of the list: mechanisms are compared by identity."""
        return mechanism_by_key, (self.key,)

    @cached_property
    def parameters(self) -> dict[str, Parameter]:
        """Every parameter by its name, in the order of the coordinates."""
        return {(parameter := self.terms.get(name, REGISTRY[name])).name: parameter for name in NAMES}

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of all coordinates."""
        return tuple(self.parameters)

    def named(self, names: Iterable[str]) -> tuple[str, ...]:
        """The mechanism's names for the scanner's coordinates of these names; other names are unchanged."""
        return tuple(self.terms[name].name if name in self.terms else name for name in names)

    @cached_property
    def tilt_zero(self) -> str:
        """Name of the zero of the tilt axis."""
        return self.named(("tilt_zero_deg",))[0]

    @cached_property
    def zeros(self) -> tuple[str, str]:
        """Names of the parameters that shift the pan angle and the tilt angle as a whole."""
        return "azimuth_zero_deg" if "azimuth_zero_deg" in self.names else "pan_zero_emission_deg", self.tilt_zero

    @cached_property
    def prior_groups(self) -> dict[str, list[int]]:
        """Coordinates by cause of uncertainty, the stereo calibration first."""
        columns = list(enumerate(self.parameters.values()))
        groups: dict[str, list[int]] = {}
        for column, parameter in (*columns[len(RIG_NAMES) :], *columns[: len(RIG_NAMES)]):
            groups.setdefault(parameter.cause, []).append(column)
        return groups

    @cached_property
    def rig_names(self) -> tuple[str, ...]:
        """Names of coordinates with a prior in `[rig]`, which come first."""
        return self.names[: len(RIG_NAMES)]

    @cached_property
    def documented(self) -> frozenset[str]:
        """Names allowed in files and documents."""
        return frozenset(self.names) - frozenset(self.fixed)

    @cached_property
    def priors(self) -> dict[str, Prior]:
        """Default priors; parameters that do not apply are fixed."""

        def prior(name: str) -> Prior:
            stated = self.own_priors.get(name, self.parameters[name].prior)
            return replace(stated, value=self.fixed[name], u=0.0) if name in self.fixed else stated

        return {name: prior(name) for name in self.rig_names}


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
    "pan-tilt", "pan-tilt", HEAD_TERMS, _LASER | _RECEIVER, absent=("effective_mirror_offset_mm",), all_round=True
)
SIGHTING_HEAD = replace(
    HEAD,
    key="pan-tilt-sightings",
    fixed=_SIGHT | _RECEIVER,
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
