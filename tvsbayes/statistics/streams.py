"""Random streams of one seed: what is drawn for different purposes is independent, and each purpose has a name.

The numbers are part of what a seed means: another number draws other values. The twin's have places of their own.
"""

from __future__ import annotations

from enum import IntEnum, unique

import numpy as np


@unique
class Stream(IntEnum):
    """Purposes of a scanner's or head's draws, and those that both instruments share."""

    PREDICTED_MOVES = 1
    """Predictive draws of `posterior.nc`."""
    EQUAL_DRAWS = 2
    """Offset of systematic resampling."""
    ORDER_OF_DRAWS = 3
    POOLED_ROUNDS = 4
    """Errors of the gears at places, of the rounds of importance sampling; its seed is the number of draws before."""
    CALIBRATION_NOISE = 5
    """Of a calibration: what a stop and an aperture reading scatter by."""
    LOOKS = 6
    """Errors of the looks that are located."""
    GEAR_TABLES = 7
    """Errors of the gears at counters without looks."""
    WAVES = 13
    """Of stated period in the gears."""
    CHAIN_PLACES = 14
    """Errors of the gears at places, of the draws of a chain."""
    WATCHED_CHANGES = 15
    """Directions of the changes that looks of `plan --watch` shall show."""
    OTHER_HOMING = 16
    """Errors of the gears at places, of draws weighted under another way of homing."""
    HELD_OUT = 17
    """Looks predicted for experiments that were left out, fold by fold."""
    PROMISE = 22
    WORLDS = 23
    """Replicates behind the p of `verify`."""
    PROMISED_LENGTHS = 24
    INSTRUMENTS = 31
    """Instruments for the assurance of a plan."""
    INSTRUMENT_SCALES = 37
    CYCLE_COUNTERS = 230
    CYCLES = 2302
    """Simulated cycles after ISO 230-2."""


@unique
class AxisStream(IntEnum):
    """Purposes of an axis' draws."""

    RESAMPLING = 1
    LINEAR_TERMS = 3
    DEVIATIONS = 4
    HELD_OUT = 5
    HELD_OUT_BY_WEIGHTS = 8
    PERIODS = 9
    PREDICTED_STOPS = 21


def random_stream(seed: int, stream: Stream | AxisStream, *part: int) -> np.random.Generator:
    """The random numbers of one purpose, or of a numbered part of it."""
    return np.random.default_rng([seed, stream.value, *part])
