"""A calibration as a C header for a microcontroller: its numbers, its origin, and the shipped functions (C99).

Degrees, mm, steps by suffix; literals have as many digits as a double holds.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping
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
from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.axes import AXES

_TABLED = ("transmission_error_deg", "u_transmission_error_deg", "play_variation_deg", "u_play_variation_deg")
_UNCOMMENTED = re.compile(r"[^A-Za-z0-9 .,:()+=_-]")
"""Characters not allowed in a comment of C: its end, trigraphs, backslashes, non-ASCII."""


def calibration_header(calibration: Calibration, origin: Origin | None = None, promise: str = "") -> str:
    """Write a C header with the estimates and the beam as a function of the counters, for a Teensy or similar.

    Its first lines have `origin` and the SHA-256 of the same calibration as JSON; they end with a `promise` in words.

    Raises:
        InputError: the calibration is of a head, for which there is no header.
    """
    if calibration.names != INPUT_NAMES:
        remedy = "take --export json, whose estimates are the terms of the head"
        raise InputError("usage", "the C header has the mirrors of a scanner, and this is a head", remedy=remedy)
    template = (shipped_data() / "export" / "tvs_calibration.h").read_text()
    error = expected_error(calibration)
    macro = {name: "TVS_" + name.replace(".", "_").upper() for name in INPUT_NAMES}
    lines = [f"#define {macro[name]} {_double(value)}" for name, value in calibration.estimates.items()]
    for axis in AXES:
        lines.append(f"#define TVS_PERIOD_{axis.upper()}_DEG {_double(calibration.period_deg.get(axis, 0.0))}")
        lines.append(f"#define TVS_OVERSHOOT_{axis.upper()}_STEPS {calibration.overshoot_steps[axis]}")
    lines.append(f"#define TVS_AZIMUTH_CONVENTION {int(calibration.azimuth)}")
    lines += _header_gears(calibration)
    estimator = _UNCOMMENTED.sub("_", calibration.estimator)
    stated = (
        f"Expected error ({estimator}, 95 %) at pan {error.pan_steps}, tilt {error.tilt_steps} "
        f"steps: azimuth {error.u95_azimuth_deg:.3f} deg, elevation {error.u95_elevation_deg:.3f} deg; "
        f"at 1 m {max(error.u95_at_1_m_mm):.2f} mm."
    )
    stated += "".join(f"\n * {line}" for line in textwrap.wrap(promise, 110))
    template = template.replace("@ORIGIN@", _origin_lines(calibration, origin))
    return template.replace("@EXPECTED_ERROR@", stated).replace("@VALUES@", "\n".join(lines))


def _double(value: float) -> str:
    """Format a floating literal of C with as many digits as a double holds."""
    text = f"{value:.{DIGITS}g}"
    return text if set(text) & set(".en") else f"{text}.0"


def _origin_lines(calibration: Calibration, origin: Origin | None) -> str:
    """Return the comment lines on the origin of the header; names are untrusted."""
    if origin is None:
        return " * Of a calibration without a campaign."
    name = _UNCOMMENTED.sub("_", origin.campaign)
    sha256 = content_sha256(calibration_json(calibration))
    measured = origin.measured or "on an unrecorded date"
    sentence = f"Campaign: {name}, measured {measured}; exported {origin.exported} by tvsbayes {origin.tvsbayes}."
    return f" * {sentence}\n * SHA-256 of the same calibration as JSON, without its origin: {sha256}."


def _header_gears(calibration: Calibration) -> list[str]:
    """Return the counters seen and the table of gear errors; zeros without repeating errors."""
    lines: list[str] = []
    errors: Mapping[str, Mapping[str, Any]] = gear_errors(calibration)
    none: Mapping[str, Any] = {
        "steps": [0.0] * 4,
        **{name: [0.0] * 4 for name in _TABLED},
        **{f"beyond_{name}": 0.0 for name in _TABLED[1::2]},
    }
    for axis, (low, high) in zip(AXES, calibration.range_steps.tolist(), strict=True):
        upper, table = axis.upper(), errors.get(axis, none)
        nodes = table["steps"]
        lines += [
            f"#define TVS_SEEN_{upper}_LOW {_double(low)}",
            f"#define TVS_SEEN_{upper}_HIGH {_double(high)}",
            f"#define TVS_TABLE_{upper}_SIZE {len(nodes)}",
            f"#define TVS_TABLE_{upper}_FIRST {_double(nodes[0])}",
            f"#define TVS_TABLE_{upper}_LAST {_double(nodes[-1])}",
            f"#define TVS_BEYOND_{upper}_ERROR_U_DEG {_double(table['beyond_u_transmission_error_deg'])}",
            f"#define TVS_BEYOND_{upper}_PLAY_U_DEG {_double(table['beyond_u_play_variation_deg'])}",
        ]
        for name, values in zip(("ERROR", "ERROR_U", "PLAY", "PLAY_U"), (table[n] for n in _TABLED), strict=True):
            listed = ",\n    ".join(", ".join(map(_double, values[k : k + 4])) for k in range(0, len(values), 4))
            lines.append(f"static const double TVS_{name}_{upper}_DEG[] = {{\n    {listed}}};")
    return lines
