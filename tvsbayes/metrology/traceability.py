"""Statements of a campaign on its date, length standard and conditions, passed on without any check.

Lengths in mm, temperatures in degC, relative humidity in %, each with its standard uncertainty.
"""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from tvsbayes.files.documents import StatedValue
from tvsbayes.instrument.conditions import TimedMove

NOT_STATED = "not stated"


class Measured(Protocol):
    """A campaign of any kind."""

    @property
    def header(self) -> Mapping[str, object]:
        """Keys of `campaign.toml` outside the instrument's."""

    @property
    def moves(self) -> Sequence[TimedMove]:
        """Moves in time order."""


@dataclass(frozen=True)
class Traceability:
    """Statement on traceability.

    Attributes:
        statement: a sentence for certificates and reports.
        declared: whether the campaign names the certificate of its length standard, which is not checked here.
    """

    statement: str
    declared: bool


@dataclass(frozen=True)
class Performance:
    """First and last day of a campaign, and whether they were recorded."""

    begin: datetime.date
    end: datetime.date
    recorded: bool


def performed(campaign: Measured, issued: datetime.date) -> Performance:
    """Return when the campaign was measured; the date of issue where it does not state it."""
    created = campaign.header.get("created")
    if not isinstance(created, datetime.date):
        return Performance(issued, issued, False)
    if not isinstance(created, datetime.datetime):
        return Performance(created, created, True)
    # Times of moves count from any instant: that of a clock, or the start of the campaign.
    seconds = campaign.moves[-1].time_s - campaign.moves[0].time_s if campaign.moves else 0.0
    try:
        return Performance(created.date(), (created + datetime.timedelta(seconds=seconds)).date(), True)
    except OverflowError:
        return Performance(created.date(), created.date(), True)


def header_table(campaign: Measured, name: str) -> dict[str, object]:
    """Return `[environment]` or `[traceability]` of `campaign.toml`; empty where it is missing."""
    table = campaign.header.get(name)
    return table if isinstance(table, dict) else {}


def stated_value(campaign: Measured, name: str, key: str) -> StatedValue | None:
    """Return a quantity of such a table."""
    entry = header_table(campaign, name).get(key)
    return StatedValue(**entry) if isinstance(entry, dict) else None


UNITS = {"degC": "degC", "percent": "%", "mm": "mm"}
"""Units by the suffix of a key."""


def stated_text(campaign: Measured, name: str, key: str) -> tuple[str, str]:
    """Return an entry of such a table for readers: its name, without the unit of a quantity, and its text."""
    stated = stated_value(campaign, name, key)
    if stated is None:
        return key, str(header_table(campaign, name)[key])
    label, _, end = key.rpartition("_")
    return label, f"{stated.value:g} {UNITS[end]}, u = {stated.u:g} {UNITS[end]}"


def plain_text(value: object) -> str:
    """Return text on one line, "not stated" if empty."""
    return " ".join(str(value).split()) or NOT_STATED


def traceability(campaign: Measured) -> Traceability:
    """Return the campaign's statement on its length standard, not checked; simulated data are never traceable."""
    certificate = plain_text(header_table(campaign, "traceability").get("board_certificate", ""))
    return length_traceability(campaign, certificate, "the board", "the calibration board")


def length_traceability(campaign: Measured, certificate: str, named: str, standard: str) -> Traceability:
    """Return the statement on a length standard by its certificate, `NOT_STATED` for none."""
    if campaign.header.get("synthetic"):
        return Traceability("Simulated data: not traceable.", False)
    if certificate == NOT_STATED:
        text = f"Not traceable: the campaign names no certificate of the length standard ({standard})."
        return Traceability(text, False)
    text = f"As declared by the user and not verified here: length from {named} with certificate {certificate}."
    return Traceability(text, True)
