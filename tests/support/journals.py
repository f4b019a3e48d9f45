"""Journals with a few looks, as a run would write them."""

from __future__ import annotations

from pathlib import Path

from tvsbayes.acquisition.journal import Disk, Journal


def picture(spot: int, side: str) -> bytes:
    return f"picture {spot} {side} ".encode() * 20


def write_looks(folder: Path, looks: int, disk: Disk | None = None, acknowledge=lambda number: None) -> None:
    """A small acquisition: created, then for every look an intent and the look with two frames, then stop."""
    journal = Journal.create(folder, disk, id="0123", plan_sha256="ab" * 32)
    acknowledge(len(journal.records))
    continue_looks(journal, looks, acknowledge)
    journal.append("stop", reason="done", exit_code=0)
    acknowledge(len(journal.records))
    journal.close()


def continue_looks(journal: Journal, looks: int, acknowledge=lambda number: None, first: int = 0) -> None:
    for spot in range(first, first + looks):
        journal.append("intent", step=spot)
        acknowledge(len(journal.records))
        frames = [journal.store(f"frames/{spot:06d}_{side}.png", picture(spot, side)) for side in ("left", "right")]
        journal.append("looked", spot=spot, frames=[frame.as_json() for frame in frames])
        acknowledge(len(journal.records))
