"""Sightings: directions of a head with two axes, observed by its camera or telescope.

Azimuth grows with the pan counter, elevation with the tilt counter; deg. Directions are unit vectors (x, y, z) of the
frame in which the user states them: x at azimuth 0, y at azimuth 90 deg, z up. The user corrects for refraction:
azimuth and elevation are those of the arriving light. No JAX.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np

from tvsbayes.files.csv_kind import Column, CsvKind, filled_where_ok, follows_a_move, unique

SIGHTED = (1, 2)
"""Columns of the pixels that hold the two angles of sightings; the first column is where ranges are eliminated."""
_WHERE_OK = filled_where_ok("give the value or a refusal reason")


@dataclass(frozen=True, slots=True, kw_only=True)
class Sighting:
    """A row of `sightings.csv`; azimuth, elevation and u are numbers where `status` is "ok"."""

    sighting: Annotated[int, Column("unique id", rule=unique)]
    move: Annotated[int, Column("the last move before the sighting")]
    azimuth_deg: Annotated[
        float | None,
        Column(
            "where the head was found to point, deg; any turn, no refraction left in it",
            -1080.0,
            1080.0,
            rule=_WHERE_OK,
        ),
    ] = None
    elevation_deg: Annotated[float | None, Column("", -90.0, 90.0, rule=_WHERE_OK)] = None
    u_deg: Annotated[
        float | None,
        Column(
            "standard uncertainty on the sphere, deg: of elevation, and of azimuth times cos(elevation)",
            1e-7,
            30.0,
            rule=_WHERE_OK,
        ),
    ] = None
    status: Annotated[str, Column("`ok`, or a reason in words", chars_max=200, filled=True)] = "ok"
    target: ClassVar[str] = ""
    """Without a name: a head has no sheets."""
    experiment: ClassVar[None] = None
    point: ClassVar[None] = None
    aperture_deg: ClassVar[None] = None
    """A head has no receiver."""

    @property
    def spot(self) -> int:
        """Its id, under the name used for all looks."""
        return self.sighting

    def pixel_covariance(self) -> np.ndarray:
        """The stated covariance (4, 4) of the pixels in whose columns its angles are, rad^2."""
        covariance = np.eye(4)
        covariance[SIGHTED, SIGHTED] = np.radians(self.u_deg or 1.0) ** 2
        return covariance

    def renumbered(self, number: int, move: int) -> Sighting:
        """The sighting with another id, after another move."""
        return replace(self, sighting=number, move=move)


SIGHTINGS = CsvKind(Sighting, "sightings.csv", "a row for every sighting, in any order")


def parse_sightings(data: bytes, file: str, moves: int) -> tuple[Sighting, ...]:
    """The checked rows of `sightings.csv`, in the order of the file; `moves` is the number of moves."""
    return SIGHTINGS.parse(data, file, follows_a_move(moves, "sighting"))


def sightings_of(looks: Sequence[object]) -> list[Sighting]:
    """The sightings among the looks of a campaign."""
    return [look for look in looks if isinstance(look, Sighting)]


def sighted_deg(sightings: Sequence[Sighting]) -> np.ndarray:
    """Azimuth and elevation, shape (n, 2), deg; NaN for missing values."""
    return np.array([(s.azimuth_deg, s.elevation_deg) for s in sightings], dtype=float).reshape(-1, 2)


def tangent_frames(angles_deg: np.ndarray) -> np.ndarray:
    """Unit vectors along azimuth and elevation, and the direction itself, of (n, 2) angles: shape (n, 3, 3)."""
    azimuth, elevation = np.radians(angles_deg).T
    c, s, ce, se = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
    zero = np.zeros_like(c)
    rows = (-s, c, zero), (-se * c, -se * s, ce), (ce * c, ce * s, se)
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=1)
