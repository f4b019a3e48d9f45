"""Looks and readings that are those of an earlier folder: they confirm it whatever has happened since. No JAX."""

from __future__ import annotations

from collections.abc import Collection, Iterable

from tvsbayes.errors import refusal
from tvsbayes.instrument.campaign import Campaign, ordered_spots, pixels_of
from tvsbayes.instrument.sightings import sighted_deg, sightings_of

COPIED_SHARE = 0.5
"""Largest share of new looks that may be looks of the campaign: those confirm themselves, whatever has changed."""


def refuse_copied(known: Iterable[tuple[object, ...]], new: Collection[tuple[object, ...]], file: str) -> None:
    """Refuse new looks that are looks of the campaign, to the last digit.

    Args:
        known: what tells the looks of the campaign apart, such as their pixels.
        new: the same of the new looks.
        file: their file.

    Raises:
        InputError: more than `COPIED_SHARE` of them are known.
    """
    copied = len(set(known).intersection(new))
    if copied > COPIED_SHARE * len(new):
        found = f"{copied} of {len(new)} rows that stand in {file} of the first folder too, digit by digit"
        allowed = "other looks than those of the first"
        remedy = "name the folder of what was measured afterwards: the same data again say nothing about the machine"
        raise refusal("same-looks", file=file, found=found, allowed=allowed, remedy=remedy)


def refuse_same_looks(known: Campaign, new: Campaign) -> None:
    """Refuse looks that are copies of looks of the campaign; see `refuse_copied`."""
    refuse_copied(_told_apart(known), _told_apart(new), new.looks_table.file)


def _told_apart(campaign: Campaign) -> list[tuple[object, ...]]:
    """What tells looks apart: pixels; of sightings, which may be rounded, time, counters and angles."""
    looks = ordered_spots(campaign)
    if campaign.has_images:
        return [tuple(row) for row in pixels_of(looks).tolist()]
    at = [campaign.moves[look.move] for look in looks]
    angles = sighted_deg(sightings_of(looks)).tolist()
    return [(m.time_s, m.pan_steps, m.tilt_steps, *row) for m, row in zip(at, angles, strict=True)]
