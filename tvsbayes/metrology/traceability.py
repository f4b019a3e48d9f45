"""What a campaign states of its date, its length standard and its conditions, passed on and never checked.

Lengths in mm, temperatures in degC, relative humidity in %, each with its standard uncertainty.
"""

from __future__ import annotations

import datetime
from dataclasses import dataclass

from tvsbayes.instrument.campaign import Campaign

NOT_STATED = "not stated"


@dataclass(frozen=True)
class StatedValue:
    """A quantity as the user states it, with its standard uncertainty."""

    value: float
    u: float


@dataclass(frozen=True)
class Traceability:
    """What may be said of traceability.

    Attributes:
        statement: a sentence for certificates and reports.
        declared: the campaign names the certificate of its length standard, which nobody checks here.
    """

    statement: str
    declared: bool


@dataclass(frozen=True)
class Performance:
    """First and last day of a campaign, and whether they were recorded."""

    begin: datetime.date
    end: datetime.date
    recorded: bool


def performed(campaign: Campaign, issued: datetime.date) -> Performance:
    """When the campaign was measured; the date of issue where it does not say."""
    created = campaign.header.get("created")
    if not isinstance(created, datetime.date):
        return Performance(issued, issued, False)
    if not isinstance(created, datetime.datetime):
        return Performance(created, created, True)
    # Times of moves count from any instant: a clock, or the start of the campaign.
    seconds = campaign.moves[-1].time_s - campaign.moves[0].time_s if campaign.moves else 0.0
    try:
        return Performance(created.date(), (created + datetime.timedelta(seconds=seconds)).date(), True)
    except OverflowError:
        return Performance(created.date(), created.date(), True)


def header_table(campaign: Campaign, name: str) -> dict[str, object]:
    """`[environment]` or `[traceability]` of `campaign.toml`; empty where it is left out."""
    table = campaign.header.get(name)
    return table if isinstance(table, dict) else {}


def stated_value(campaign: Campaign, name: str, key: str) -> StatedValue | None:
    """A quantity of such a table."""
    entry = header_table(campaign, name).get(key)
    return StatedValue(entry["value"], entry["u"]) if isinstance(entry, dict) else None


UNITS = {"degC": "degC", "percent": "%", "mm": "mm"}
"""By the end of a key."""


def stated_text(campaign: Campaign, name: str, key: str) -> tuple[str, str]:
    """An entry of such a table for readers: its name, a quantity's without the unit, and what it says."""
    stated = stated_value(campaign, name, key)
    if stated is None:
        return key, str(header_table(campaign, name)[key])
    label, _, end = key.rpartition("_")
    return label, f"{stated.value:g} {UNITS[end]}, u = {stated.u:g} {UNITS[end]}"


def plain_text(value: object) -> str:
    """Text on one line, with a word for none."""
    return " ".join(str(value).split()) or NOT_STATED


def traceability(campaign: Campaign) -> Traceability:
    """The campaign's word on its length standard, passed on, not checked; simulated data are never traceable."""
    certificate = plain_text(header_table(campaign, "traceability").get("board_certificate", ""))
    if campaign.header.get("synthetic"):
        return Traceability("Simulated data: not traceable.", False)
    if certificate == NOT_STATED:
        text = "Not traceable: the campaign names no certificate of the length standard (the calibration board)."
        return Traceability(text, False)
    text = f"As declared by the user and not verified here: length from the board with certificate {certificate}."
    return Traceability(text, True)
