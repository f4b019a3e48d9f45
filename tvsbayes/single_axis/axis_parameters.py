"""The parameters of one axis: names, priors, defaults that scale with its travel, coordinates.

A coordinate w has a standard normal prior; a parameter is a monotonic function of it. Linear quantities (offset, unit
per command, its contrast, the processes) have no coordinate here: they are integrated out exactly.
Formulation 8.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np

from tvsbayes.instrument.quantities import Quantities, Quantity
from tvsbayes.single_axis.waves import Wave, WaveDraws, log_order, names_of, wave_draws

Kind = Literal["normal", "half-normal", "log-normal"]


@dataclass(frozen=True)
class AxisPrior:
    """Value and standard uncertainty; for a log-normal the median and the sd of the log, for a half-normal 0 and u."""

    value: float
    u: float


@dataclass(frozen=True, kw_only=True)
class AxisQuantity(Quantity):
    """A quantity of an axis; in its unit, {unit} stands for that of the folder.

    Attributes:
        line: function of the middle command; it returns the factors of `per_command`, `ratio_contrast`, `backlash` and
            the offset at the middle command whose sum the quantity is. None for all other quantities.
    """

    line: Callable[[float], Mapping[str, float]] | None = None


@dataclass(frozen=True, kw_only=True)
class AxisKey(AxisQuantity):
    """A key of `[axis]`.

    Attributes:
        kind: kind of its prior.
        share: default value (log-normal) or u, as a share of the travel; None where it does not scale.
        u: sd of the log of a log-normal default.
        median: median of a log-normal default that does not scale.
    """

    kind: Kind
    share: float | None
    u: float = 0.0
    median: float = 1.0


def _key(name: str, kind: Kind, share: float | None, label: str, unit: str = "{unit}", **fields: Any) -> AxisKey:
    return AxisKey(name=name, block=name, kind=kind, share=share, label=label, unit=unit, **fields)


def _side(part: float, middle: float) -> dict[str, float]:
    """Factors of the ratio in one direction, given its part of the contrast."""
    return {"per_command": 1.0, "ratio_contrast": part}


_PER_COMMAND = "{unit} per command"
CONTRAST_PARTS = {"forward": 0.5, "backward": -0.5}
"""Parts of the contrast that the ratios of both directions have."""
AXIS_QUANTITIES: Quantities[AxisQuantity] = Quantities(
    _key(
        *("per_command", "normal", None, "unit per command", _PER_COMMAND),
        target="per_command",
        line=lambda middle: {"per_command": 1.0},
    ),
    _key(
        *("ratio_contrast", "normal", None, "forward less backward", _PER_COMMAND),
        line=lambda middle: {"ratio_contrast": 1.0},
    ),
    *(
        AxisQuantity(
            name=f"per_command.{side}",
            block="per_command",
            unit=_PER_COMMAND,
            headline=True,
            line=partial(_side, part),
        )
        for side, part in CONTRAST_PARTS.items()
    ),
    *AxisQuantity.many("effective_per_command", (), unit=_PER_COMMAND, target="effective_per_command"),
    _key(
        *("backlash", "normal", 0.05, "play lost in a reversal"),
        headline=True,
        target="backlash",
        line=lambda middle: {"backlash": 1.0},
    ),
    _key("transmission_error", "half-normal", 0.002, "error by position, sd"),
    _key("transmission_error_length", "log-normal", 0.2, "correlation length", u=0.7),
    _key("play_variation", "half-normal", 0.001, "play by position, sd"),
    _key("drift_per_root_hour", "half-normal", 0.0005, "drift of the zero per root hour"),
    _key("stop_sd", "log-normal", 0.0005, "scatter of stops", u=1.5),
    *AxisQuantity.many("stop_sd", CONTRAST_PARTS, unit="{unit}", label="scatter of stops, {0}"),
    # 95 % from 1.5e-7 T, an index pulse, to 3e-3 T, a motor that stalls at its stop. A narrower prior far from the data
    # makes the promise after two or three homings too wide.
    _key("home_sd", "log-normal", 0.00002, "scatter of homings", u=2.5),
    _key("reading_scale", "log-normal", None, "scatter of readings / u", "1", u=0.5),
    _key("creep", "normal", 0.0005, "zero creeps while warming up"),
    _key("creep_minutes", "log-normal", None, "time constant of creep, minutes", "min", u=0.8, median=20.0),
    _key("thermal_per_K", "normal", 0.0001, "zero shifts per kelvin", "{unit}/K"),
    _key("seeing_scale", "log-normal", None, "seeing / u of a reading", "1", u=1.0),
    _key("seeing_s", "log-normal", None, "seeing lasts, s", "s", u=1.2, median=10.0),
    *AxisQuantity.many(
        *("offset", ()),
        unit="{unit}",
        label="reading at command 0",
        line=lambda middle: {"offset": 1.0, "per_command": -middle},
    ),
)
"""Reported quantities of an axis."""
AXIS_KEYS = {name: key for name, key in AXIS_QUANTITIES.items() if isinstance(key, AxisKey)}
"""Shares of the travel: half-normals and stop scatter come from eleven stepper axes measured by others, where left-out
positions, with the scales integrated out, lie within 1.96 u in 95 % of cases. Backlash: cheap gears lose up to some per
cent; any reversal determines it well, so a wide prior is harmless. Homings: index marks repeat to a micrometre, worn
switches to tenths of a millimetre; a prior that excluded the former would be most of a promise after a few homings.
Seeing: errors of readings in motion that last for seconds, caused by air, a guider's loop or the reader; its sd is in
units of a reading's u."""
CONTRAST_SHARE = 1e-4
"""sd of the difference of both directions' ratios over the ratio, of an axis that is not read in a length: gears have
one ratio. With a larger sd, two ratios would explain the warming of a machine on a long path."""
LENGTHS = ("nm", "um", "mm", "cm", "m", "thou", "mil", "inch", "in")
"""Units of length: of an axis in one of them the difference is 0 unless stated, since a screw, a rack or a belt keeps
step over its length."""
SAMPLED = (
    *("backlash", "transmission_error", "transmission_error_length", "play_variation", "drift_per_root_hour"),
    *("stop_sd.forward", "stop_sd.backward", "home_sd", "reading_scale"),
    *("creep_minutes", "seeing_scale", "seeing_s"),
)
"""Parameters in which the readings are not linear; `stop_sd` of `[axis]` is the prior of both directions."""


def kind_of(name: str) -> Kind:
    """Kind of the prior of a name in `SAMPLED` or `AXIS_KEYS`."""
    return AXIS_KEYS[name.split(".")[0]].kind


def axis_priors(
    stated: Mapping[str, AxisPrior], travel: float, per_command: float, u_per_command: float = 0.0, unit: str = ""
) -> dict[str, AxisPrior]:
    """Every prior of an axis, defaults filled in.

    Args:
        stated: entries of `[axis]`.
        travel: range of the readings' quantity, > 0: range of commands times |unit per command|.
        per_command: slope of the least-squares line, for centre and u of the default prior.
        u_per_command: its standard error, which widens that prior.
        unit: unit of the readings.
    """
    priors = {}
    for name, key in AXIS_KEYS.items():
        if name == "per_command":
            default = AxisPrior(per_command, abs(per_command) + 2 * u_per_command)
        elif name == "ratio_contrast":
            default = AxisPrior(0.0, 0.0 if unit in LENGTHS else CONTRAST_SHARE * abs(per_command))
        elif key.share is None:
            default = AxisPrior(key.median, key.u)
        elif key.kind == "log-normal":
            default = AxisPrior(key.share * travel, key.u)
        else:
            default = AxisPrior(0.0, key.share * travel)
        priors[name] = stated.get(name, default)
    return priors


def prior_sd(kind: Kind, prior: AxisPrior) -> float:
    """Standard deviation of a prior."""
    if kind == "half-normal":
        return prior.u * float(np.sqrt(1 - 2 / np.pi))
    if kind == "log-normal":
        return prior.value * float(np.exp(0.5 * prior.u**2) * np.sqrt(np.expm1(prior.u**2)))
    return prior.u


@dataclass(frozen=True)
class AxisCoordinates:
    """Coordinates with standard normal priors of the sampled parameters, and the values of the fixed ones.

    Attributes:
        names: free parameters, in the order of the coordinates; those of the waves come last.
        priors: prior of every name in `SAMPLED`.
        waves: waves whose scales and periods are also sampled, as `wave_scale.1`, `wave_period.1`, ...
    """

    names: tuple[str, ...]
    priors: dict[str, AxisPrior]
    waves: tuple[Wave, ...] = ()

    @classmethod
    def of(cls, priors: Mapping[str, AxisPrior], unused: frozenset[str], waves: Sequence[Wave] = ()) -> AxisCoordinates:
        """Coordinates from the priors of an axis; parameters in `unused`, or with u = 0, are fixed at their value."""
        prior_of = {name: priors[name.split(".")[0]] for name in SAMPLED}
        free = tuple(name for name in SAMPLED if prior_of[name].u > 0 and name not in unused)
        return cls((*free, *names_of(waves)), prior_of, tuple(waves))

    def wave_draws(self, w: np.ndarray) -> list[WaveDraws]:
        """Every wave at coordinates (n, d)."""
        draws = []
        for k, wave in enumerate(self.waves, start=1):
            coordinate = None if wave.is_fixed else w[:, self.names.index(f"wave_period.{k}")]
            draws.append(wave_draws(wave, w[:, self.names.index(f"wave_scale.{k}")], coordinate))
        return draws

    def log_prior(self, w: np.ndarray) -> np.ndarray:
        """Log prior density at coordinates (n, d) up to a constant, shape (n,)."""
        density: np.ndarray = -0.5 * np.sum(w**2, axis=1)
        if self.waves:
            draws = self.wave_draws(w)
            density = density + log_order(self.waves, draws) + sum(wave.log_prior for wave in draws)
        return density

    def values(self, w: np.ndarray) -> dict[str, np.ndarray]:
        """Every name of `SAMPLED` at coordinates (n, d): arrays (n,)."""
        from tvsbayes.gears.priors import values_at

        names, priors = list(self.priors), self.priors.values()
        free = {name: w[:, k] for k, name in enumerate(self.names)}
        z = np.column_stack([free.get(name, np.zeros(len(w))) for name in names])
        value, u = (np.array(column) for column in zip(*((prior.value, prior.u) for prior in priors), strict=True))
        half, log = (np.array([kind_of(name) == kind for name in names]) for kind in ("half-normal", "log-normal"))
        fixed = np.array([name not in free for name in names])
        values = np.where(fixed, value, values_at(z, value, u, half, log))
        return dict(zip(names, np.ascontiguousarray(values.T), strict=True))

    def coordinate(self, name: str, value: float) -> float:
        """Coordinate of a free parameter with a normal or log-normal prior."""
        prior = self.priors[name]
        return float(np.log(value / prior.value) if kind_of(name) == "log-normal" else value - prior.value) / prior.u
