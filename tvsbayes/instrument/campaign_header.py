"""The header of `campaign.toml`: object, time, operator and conditions of a measurement; all keys but `[rig]`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tvsbayes.errors import InputError
from tvsbayes.files.disk import read_bytes
from tvsbayes.files.documents import TOML_BYTES_MAX, Keys, Kind, parse_toml
from tvsbayes.instrument.conditions import check_power
from tvsbayes.instrument.mechanisms import WORDS

CAMPAIGN_FORMAT = "tvsbayes-campaign/1"


def _quantity(keys: Keys, key: str, low: float, high: float, u_max: float) -> dict[str, float]:
    return keys.quantity(key, low, high, u_max)._asdict()


TIMES: dict[str, Kind] = dict.fromkeys(("created", "powered_on"), Keys.date)
ORIGIN: dict[str, Kind] = {"synthetic": Keys.flag, "seed": (Keys.integer, 0, 2**63 - 1)}
PEOPLE: dict[str, Kind] = {
    **dict.fromkeys(("operator", "instrument", "serial", "method"), Keys.text),
    "notes": (Keys.text, 4000),
}
ENVIRONMENT: dict[str, Kind] = {
    "temperature_degC": (_quantity, -100.0, 200.0, 100.0),
    "humidity_percent": (_quantity, 0.0, 100.0, 100.0),
}
"""Keys of the headers of every instrument, with `[environment]`."""
_TRACEABILITY: dict[str, Kind] = {
    "board_certificate": Keys.text,
    "pitch_mm": (_quantity, 1e-3, 1e4, 1e3),
    "stereo_calibrated": Keys.date,
}
_URDF: dict[str, Kind] = {
    **dict.fromkeys(("pan_joint", "tilt_joint"), Keys.text),
    "steps_per_turn": (Keys.number, 1.0, 1e9),
}
_KEYS: dict[str, Kind] = {
    **{"name": Keys.text, **TIMES, **ORIGIN, **PEOPLE},
    **{
        "environment": (Keys.nested, ENVIRONMENT),
        "traceability": (Keys.nested, _TRACEABILITY),
        "urdf": (Keys.nested, _URDF),
    },
    "rig": Keys.table,
}


def parse_header(keys: Keys) -> dict[str, object]:
    """The keys of `campaign.toml` outside `[rig]`, checked; other keys are refused."""
    entries = keys.document(CAMPAIGN_FORMAT, _KEYS)
    entries.pop("rig", None)
    return header_of(keys, entries)


def header_of(keys: Keys, entries: Mapping[str, Any]) -> dict[str, object]:
    """The header with these checked entries: tables come last, empty ones are left out."""
    check_power(keys, entries)
    ordered = sorted(entries.items(), key=lambda entry: isinstance(entry[1], dict))
    return {name: value for name, value in ordered if value != {}}


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
