"""Random streams of one seed, one for each named purpose, independent of each other.

The numbers fix the draws of a seed: another number draws other values. The twin numbers its streams itself.
"""

from __future__ import annotations

from enum import IntEnum, unique

import numpy as np


@unique
class Stream(IntEnum):
    """Purposes of draws for a scanner or head, and those shared with an axis."""

    PREDICTED_MOVES = 1
    """Predictive draws of `posterior.nc`."""
    EQUAL_DRAWS = 2
    """Offset of systematic resampling."""
    ORDER_OF_DRAWS = 3
    POOLED_ROUNDS = 4
    """Errors of the gears at places, for rounds of importance sampling; the seed is the state of the generator of w."""
    CALIBRATION_NOISE = 5
    """Scatter of stops and aperture readings in a calibration."""
    LOOKS = 6
    """Errors of looks to be located."""
    GEAR_TABLES = 7
    """Errors of the gears at counters without looks."""
    WAVES = 13
    """Errors of stated period in the gears."""
    CHAIN_PLACES = 14
    """Errors of the gears at places, for the draws of a chain."""
    WATCHED_CHANGES = 15
    """Directions of the changes that looks of `plan --watch` should detect."""
    OTHER_HOMING = 16
    """Errors of the gears at places, for draws weighted under another homing hypothesis."""
    HELD_OUT = 17
    """Looks predicted for held-out experiments, fold by fold."""
    PROMISE = 22
    WORLDS = 23
    """Replicates behind the p of `verify`."""
    PROMISED_LENGTHS = 24
    INSTRUMENTS = 31
    """Instruments for the assurance of a plan."""
    INSTRUMENT_SCALES = 37
    CYCLE_COUNTERS = 230
    CYCLES = 2302
    """Simulated cycles of ISO 230-2."""


@unique
class AxisStream(IntEnum):
    """Purposes of draws for an axis."""

    RESAMPLING = 1
    LINEAR_TERMS = 3
    DEVIATIONS = 4
    HELD_OUT = 5
    HELD_OUT_BY_WEIGHTS = 8
    PERIODS = 9
    EFFECTIVE_BACKLASH = 10
    PRIOR_CONFLICTS = 11
    DOUBTS = 12
    COMPARISON = 13
    PREDICTED_STOPS = 21


def random_stream(seed: int, stream: Stream | AxisStream, *part: int) -> np.random.Generator:
    """Return the generator of random numbers of one purpose, or of a numbered part of it."""
    return np.random.default_rng([seed, stream.value, *part])
