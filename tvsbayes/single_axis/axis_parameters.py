"""The parameters of one axis: names, priors, defaults that scale with its travel, coordinates.

A coordinate w has a standard normal prior; a parameter is a monotone function of it. What is linear in the readings
(offset, unit per command, its contrast, the processes) has no coordinate here: it is integrated out exactly.
Formulation 8.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

Kind = Literal["normal", "half-normal", "log-normal"]


@dataclass(frozen=True)
class AxisPrior:
    """Value and standard uncertainty; of a log-normal the median and the sd of the log, of a half-normal 0 and u."""

    value: float
    u: float


@dataclass(frozen=True)
class AxisKey:
    """A key of `[axis]`.

    Attributes:
        kind: of its prior.
        share: what the default's value (log-normal) or u is of the travel; None where it does not scale.
        u: sd of the log of a log-normal default.
        what: in words, for tables.
    """

    kind: Kind
    share: float | None
    u: float
    what: str


AXIS_KEYS = {
    "per_command": AxisKey("normal", None, 1.0, "unit per command"),
    "backlash": AxisKey("normal", 0.05, 0.0, "play lost in a reversal"),
    "transmission_error": AxisKey("half-normal", 0.002, 0.0, "error by position, sd"),
    "transmission_error_length": AxisKey("log-normal", 0.2, 0.7, "it changes over a way of"),
    "play_variation": AxisKey("half-normal", 0.001, 0.0, "play over positions, sd"),
    "drift_per_root_hour": AxisKey("half-normal", 0.0005, 0.0, "zero walks in a root hour"),
    "stop_sd": AxisKey("log-normal", 0.0005, 1.5, "scatter of stops"),
    "home_sd": AxisKey("log-normal", 0.001, 1.5, "scatter of homings"),
    "reading_scale": AxisKey("log-normal", None, 0.5, "scatter of readings / u"),
}
"""Shares of the travel: half-normals and stop scatter by eleven stepper axes that others measured, on which the scales
integrated out give left-out positions that lie within 1.96 u in 95 % of cases. Backlash: cheap gears lose up to some
per cent; any reversal measures it well, so a wide prior costs nothing."""
STATED_KEYS = tuple(AXIS_KEYS)
CONTRAST_SHARE = 1e-4
"""sd of the difference of both directions' ratios, of the ratio: gears and screws have one. Over a long path more would
pass a warming frame off as two ratios."""
SAMPLED = (
    *("backlash", "transmission_error", "transmission_error_length", "play_variation", "drift_per_root_hour"),
    *("stop_sd.forward", "stop_sd.backward", "home_sd", "reading_scale"),
)
"""Everything that is not linear in the readings; `stop_sd` of `[axis]` is the prior of both."""


def kind_of(name: str) -> Kind:
    """Of the prior of a name in `SAMPLED` or `AXIS_KEYS`."""
    return AXIS_KEYS[name.split(".")[0]].kind


def axis_priors(
    stated: Mapping[str, AxisPrior], travel: float, per_command: float, u_per_command: float = 0.0
) -> dict[str, AxisPrior]:
    """Every prior of an axis, defaults filled in.

    Args:
        stated: entries of `[axis]`.
        travel: range of the readings' quantity, > 0: range of commands times |unit per command|.
        per_command: of the least-squares line: centre of a prior as wide as itself, where nothing is stated.
        u_per_command: its standard error, which widens that prior.
    """
    priors = {}
    for name, key in AXIS_KEYS.items():
        if name == "per_command":
            default = AxisPrior(per_command, abs(per_command) + 2 * u_per_command)
        elif key.share is None:
            default = AxisPrior(1.0, key.u)
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
        names: free parameters, in the order of the coordinates.
        priors: of every name in `SAMPLED`.
    """

    names: tuple[str, ...]
    priors: dict[str, AxisPrior]

    @classmethod
    def of(cls, priors: Mapping[str, AxisPrior], unused: frozenset[str]) -> AxisCoordinates:
        """Of the priors of an axis; what is `unused` by the data, or has u = 0, is held at its value."""
        of_each = {name: priors[name.split(".")[0]] for name in SAMPLED}
        free = tuple(name for name in SAMPLED if of_each[name].u > 0 and name not in unused)
        return cls(free, of_each)

    def values(self, w: np.ndarray) -> dict[str, np.ndarray]:
        """Every name of `SAMPLED` at coordinates (n, d): arrays (n,)."""
        from scipy.special import log_ndtr, ndtri_exp

        found = {}
        for name, prior in self.priors.items():
            if name not in self.names:
                found[name] = np.full(len(w), prior.value)
                continue
            z, kind = w[:, self.names.index(name)], kind_of(name)
            if kind == "half-normal":
                # u Phi^-1((1 + Phi(z)) / 2) = -u Phi^-1(Phi(-z) / 2), exact in the far tail too.
                found[name] = -prior.u * ndtri_exp(log_ndtr(-z) - np.log(2.0))
            elif kind == "log-normal":
                found[name] = prior.value * np.exp(prior.u * z)
            else:
                found[name] = prior.value + prior.u * z
        return found

    def coordinate(self, name: str, value: float) -> float:
        """Of a free parameter with a normal or log-normal prior."""
        prior = self.priors[name]
        return float(np.log(value / prior.value) if kind_of(name) == "log-normal" else value - prior.value) / prior.u
