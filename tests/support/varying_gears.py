"""Rigs whose gears repeat errors by position, or do not, whatever the defaults."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.parameters import BLOCKS, GEAR_ERROR_NAMES, Prior
from tvsbayes.instrument.rig import Rig, RigTable
from tvsbayes.model.parameter_space import ParameterSpace, coordinates_of, physical_at

PERIODS_DEG = {"pan": (30.0, 7.0), "tilt": (45.0,)}
SCALE_U_DEG = 0.05
LENGTH = Prior(8.0, 0.7, "log-normal")
OFF, ON = Prior(0.0, 0.0, "half-normal"), Prior(0.0, SCALE_U_DEG, "half-normal")


def perfect_gears(table: RigTable) -> RigTable:
    """Gears that repeat no error, do not drift and do not creep."""
    scales = {name: replace(LENGTH, u=0.0) if "length" in name else OFF for name in GEAR_ERROR_NAMES}
    still = dict.fromkeys(BLOCKS["creep_deg"], Prior(0.0, 0.0))
    return replace(table, priors={**table.priors, **scales, **still}, harmonic_period_deg={})


def perfect_rig(rig: Rig) -> Rig:
    """A rig of such gears, true rigs drawn from it included."""
    none = {name: Prior(0.0, 0.0, "half-normal") for name in GEAR_ERROR_NAMES if "length" not in name}
    return replace(rig, table=perfect_gears(rig.table), truth={**rig.truth, **none})


def varying_gears(table: RigTable, scale_u_deg: float = SCALE_U_DEG, periods: bool = True) -> RigTable:
    """Gears of which every scale is estimated; two periods are stated on pan, one on tilt."""
    stated = PERIODS_DEG if periods else {}
    scales = {name: LENGTH if "length" in name else Prior(0.0, scale_u_deg, "half-normal") for name in GEAR_ERROR_NAMES}
    for name in scales:
        block, axis, *number = name.split(".")
        if block == "harmonic_amplitude_deg" and int(number[0]) > len(stated.get(axis, ())):
            scales[name] = OFF
    return replace(table, priors={**table.priors, **scales}, harmonic_period_deg=stated)


def coordinates_with(space: ParameterSpace, z: np.ndarray, values: Mapping[str, float]) -> np.ndarray:
    """The point z with these parameters, in the units of their names, in place of its own."""
    physical = physical_at(z, space).value
    for name, value in values.items():
        physical[TWO_MIRROR.index[name]] = value
    named = [TWO_MIRROR.index[name] for name in values]
    point = z.copy()
    point[named] = coordinates_of(space, physical)[named]
    assert point.shape == (len(TWO_MIRROR.names),)
    return point
