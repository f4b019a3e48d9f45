"""The header of `campaign.toml`: object, time, operator and conditions of a measurement; all keys but `[rig]`."""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from pathlib import Path

from tvsbayes.errors import InputError
from tvsbayes.files.disk import read_bytes
from tvsbayes.files.documents import TOML_BYTES_MAX, Keys, parse_toml
from tvsbayes.instrument.conditions import check_power
from tvsbayes.instrument.mechanisms import WORDS

_TEXT_CHARS = {
    **dict.fromkeys(("name", "operator", "instrument", "serial", "method"), 200),
    **dict.fromkeys(("board_certificate", "reference_certificate"), 200),
    **dict.fromkeys(("pan_joint", "tilt_joint"), 200),
    "notes": 4000,
}
_QUANTITIES = {
    "temperature_degC": (-100.0, 200.0, 100.0),
    "humidity_percent": (0.0, 100.0, 100.0),
    "pitch_mm": (1e-3, 1e4, 1e3),
}
ENVIRONMENT = ("temperature_degC", "humidity_percent")
"""Keys of `[environment]` of every instrument."""
_HEADER_TABLES = {
    "environment": ENVIRONMENT,
    "traceability": ("board_certificate", "pitch_mm", "stereo_calibrated"),
    "urdf": ("pan_joint", "tilt_joint", "steps_per_turn"),
}
_HEADER_KEYS = (
    *("format", "name", "created", "powered_on", "synthetic", "seed"),
    *("operator", "instrument", "serial", "method", "notes", *_HEADER_TABLES, "rig"),
)


def header_value(keys: Keys, key: str) -> object:
    """One checked value of a header, by the type that its key requires."""
    if key in _TEXT_CHARS:
        return keys.text_value(key, _TEXT_CHARS[key])
    if key in _QUANTITIES:
        return keys.quantity(key, *_QUANTITIES[key])._asdict()
    if key == "synthetic":
        return keys.flag(key)
    if key == "seed":
        return keys.integer(key, 0, 2**63 - 1)
    if key == "steps_per_turn":
        return keys.number(key, 1.0, 1e9)
    if not isinstance(keys.values[key], datetime.date):
        allowed = "a date or time such as 2026-01-15T10:00:00Z"
        raise keys.refuse(key, "date", allowed, "write it without quotes")
    return keys.values[key]


def parse_header(keys: Keys) -> dict[str, object]:
    """The keys of `campaign.toml` outside `[rig]`, checked; other keys are refused."""
    keys.word("format", ("tvsbayes-campaign/1",))
    keys.only(_HEADER_KEYS)
    plain_keys = [key for key in keys.values if key not in ("format", "rig", *_HEADER_TABLES)]
    header = {key: header_value(keys, key) for key in plain_keys} | header_tables(keys, _HEADER_TABLES)
    check_power(keys, header)
    return header


def header_tables(keys: Keys, tables: Mapping[str, tuple[str, ...]]) -> dict[str, dict[str, object]]:
    """The tables of a header by name, checked; empty ones are left out, other keys refused."""
    found = {}
    for name, allowed in tables.items():
        table = keys.table(name)
        table.only(allowed)
        if table.values:
            found[name] = {key: header_value(table, key) for key in table.values}
    return found


def mechanism_key(folder: Path) -> str:
    """The instrument of a campaign folder, by `format` and `[rig] mechanism` of its `campaign.toml`.

    A file `sightings.csv` means a head with sightings in place of spots. An unreadable folder counts as a scanner's:
    the scanner's reader then reports the fault.
    """
    values = header_values(folder)
    format_name = str(values.get("format", "")).partition("/")[0].removeprefix("tvsbayes-")
    rig = values.get("rig")
    mechanism = format_name
    if format_name == "campaign":
        mechanism = str(rig.get("mechanism", WORDS[0])) if isinstance(rig, dict) else WORDS[0]
    return f"{mechanism}-sightings" if (folder / "sightings.csv").is_file() else mechanism


def header_values(folder: Path) -> dict[str, object]:
    """The entries of `campaign.toml`, unchecked; none where it cannot be read."""
    try:
        return parse_toml(read_bytes(folder / "campaign.toml", TOML_BYTES_MAX, folder), "campaign.toml").values
    except InputError:
        return {}
