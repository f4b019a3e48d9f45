"""A calibration as a C header for a microcontroller: its numbers, its origin, and the shipped functions (C99).

Degrees, mm, steps by suffix; literals have as many digits as a double holds.
"""

from __future__ import annotations

import re
import textwrap
from functools import partial
from typing import Any

from tvsbayes.calibration.calibration_file import (
    DIGITS,
    Origin,
    calibration_json,
    content_sha256,
    expected_error,
    gear_errors,
)
from tvsbayes.calibration.pointing import INPUT_NAMES, Calibration
from tvsbayes.errors import InputError
from tvsbayes.files.templates import double, filled
from tvsbayes.instrument.axes import AXES

_TABLES = {
    "ERROR": "transmission_error_deg",
    "ERROR_U": "u_transmission_error_deg",
    "PLAY": "play_variation_deg",
    "PLAY_U": "u_play_variation_deg",
}
"""Tables of the header by the names of `gear_errors`."""
_UNCOMMENTED = re.compile(r"[^A-Za-z0-9 .,:()+=_-]")
"""Characters not allowed in a comment of C: its end, trigraphs, backslashes, non-ASCII."""


def calibration_header(calibration: Calibration, origin: Origin | None = None, promise: str = "") -> str:
    """Write a C header with the estimates and the beam as a function of the counters, for a Teensy or similar.

    Its first lines have `origin` and the SHA-256 of the same calibration as JSON; they end with a `promise` in words.
    Gears without repeating errors have tables of zeros.

    Raises:
        InputError: the calibration is of a head, for which there is no header.
    """
    if calibration.names != INPUT_NAMES:
        remedy = "take --export json, whose estimates are the terms of the head"
        raise InputError("usage", "the C header has the mirrors of a scanner, and this is a head", remedy=remedy)
    none: dict[str, Any] = dict.fromkeys(("steps", *_TABLES.values()), [0.0] * 4)
    none |= dict.fromkeys((f"beyond_{name}" for name in _TABLES.values()), 0.0)
    errors = gear_errors(calibration)
    return filled(
        "tvs_calibration.h",
        calibration=calibration,
        origin=origin,
        sha256=content_sha256(calibration_json(calibration)),
        error=expected_error(calibration),
        promise=textwrap.wrap(promise, 110),
        gears={axis: errors.get(axis, none) for axis in AXES},
        tables=_TABLES,
        plain=partial(_UNCOMMENTED.sub, "_"),
        number=lambda value: double(f"{value:.{DIGITS}g}"),
    )
