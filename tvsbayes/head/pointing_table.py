"""Pointing tables of telescopes: one block of lines per star, with both encoder readings and the star's direction.

A block begins with `CAT:`. `RAA:` holds elevation and azimuth of the encoders, `TAA:` those of the star computed from
catalogue and time; degrees, azimuth as 180 deg minus the azimuth from north through east. `LST:` is the local sidereal
time, the only clock. Other lines are ignored.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tvsbayes.errors import escaped, refusal
from tvsbayes.files.csv_table import CSV_BYTES_MAX
from tvsbayes.files.disk import read_bytes
from tvsbayes.importing.sightings import STEP_DEG
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.campaign import Campaign, Move, next_move
from tvsbayes.instrument.mechanisms import SIGHTING_HEAD
from tvsbayes.instrument.parameters import Prior, names_of
from tvsbayes.instrument.rig import RigTable
from tvsbayes.instrument.sightings import Sighting

ARCSEC = 1 / 3600
U_ARCSEC = 0.5
"""Default u of a star's direction; the remaining errors are estimated as the scatter of stops."""
SIDEREAL_S = 86164.0905 / 86400
"""Seconds of mean solar time per second of sidereal time (IERS conventions)."""
DAY_S = 86400.0
AZIMUTH_FROM_DEG = 180.0
NEEDED = {"RAA", "TAA", "LST"}
"""Tags that a pointing's block must have."""


def encoder_priors() -> dict[str, Prior]:
    """Priors of a telescope with encoders on its axes: no gear errors, only those of bearings."""
    halves = names_of("transmission_error_deg", "play_variation_deg", "look_scatter_deg")
    return {
        **dict.fromkeys(names_of("degrees_per_step"), Prior(STEP_DEG, 1e-6 * STEP_DEG)),
        **dict.fromkeys(names_of("ratio_contrast_deg_per_step"), Prior(0.0, 0.0)),
        **dict.fromkeys(names_of("backlash_deg"), Prior(0.0, 2 * ARCSEC, "half-normal")),
        **dict.fromkeys(names_of("stop_sd_deg"), Prior(ARCSEC, 0.7, "log-normal")),
        **dict.fromkeys(halves, Prior(0.0, 0.0, "half-normal")),
        **dict.fromkeys(names_of("drift_deg_per_root_hour"), Prior(0.0, ARCSEC, "half-normal")),
        **dict.fromkeys(names_of("thermal_deg_per_K"), Prior(0.0, 0.0)),
        **dict.fromkeys(("azimuth_zero_deg", "elevation_zero_deg"), Prior(0.0, 2.0)),
        **dict.fromkeys(("axes_not_square_deg", "beam_not_square_deg", "flexure_deg"), Prior(0.0, 60 * ARCSEC)),
        **dict.fromkeys(("azimuth_axis_tilt_deg.north", "azimuth_axis_tilt_deg.east"), Prior(0.0, 60 * ARCSEC)),
        "tangent_flexure_deg": Prior(0.0, 20 * ARCSEC),
    }


@dataclass(frozen=True)
class Star:
    """One pointing: elevation and azimuth of encoders and star, deg, and the sidereal time, s."""

    encoder_deg: tuple[float, float]
    true_deg: tuple[float, float]
    sidereal_s: float


def _blocks(text: str) -> Iterator[tuple[int, dict[str, str]]]:
    """Lines of each star by their tags, with the number of its first line."""
    block: dict[str, str] = {}
    begin = 0
    for number, line in enumerate(text.splitlines(), 1):
        tag, _, rest = line.partition(":")
        if tag == "CAT" and block:
            yield begin, block
            block = {}
        begin = number if tag == "CAT" else begin
        block[tag] = rest
    if block:
        yield begin, block


def _numbers(text: str, count: int) -> tuple[float, ...]:
    """Read `count` finite numbers from a line."""
    numbers = tuple(map(float, text.replace(":", " ").split()))
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise ValueError(f"{len(numbers)} numbers where {count} are expected")
    return numbers


@dataclass(frozen=True)
class PointingTable:
    """The stars of a table, in its order, and the number of blocks left out as aborted pointings."""

    stars: tuple[Star, ...]
    left_out: int


def read_stars(path: Path) -> PointingTable:
    """Read a pointing table.

    Raises:
        InputError: not a pointing table; with the first line that does not fit.
    """
    text = read_bytes(path, CSV_BYTES_MAX).decode("utf-8", "replace")
    blocks, stars = list(_blocks(text)), []
    whole = [(line, block) for line, block in blocks if NEEDED <= block.keys()]
    for line, block in whole or blocks or [(1, {})]:
        try:
            (el, az), (true_el, true_az) = (_numbers(block[tag], 2) for tag in ("RAA", "TAA"))
            hours, minutes, seconds = _numbers(block["LST"], 3)
        except (KeyError, ValueError) as error:
            raise refusal(
                "pointing-table",
                file=escaped(path.name),
                line=line,
                found=f"a block without what is needed: {escaped(str(error))}",
                allowed="blocks that begin with CAT: and hold RAA: and TAA: (elevation, azimuth) and LST: (h:m:s)",
                remedy="give a pointing table as the MMT writes it",
            ) from error
        stars.append(Star((el, az), (true_el, true_az), 3600 * hours + 60 * minutes + seconds))
    return PointingTable(tuple(stars), len(blocks) - len(stars))


def campaign_of(
    stars: tuple[Star, ...], name: str, u_arcsec: float = U_ARCSEC, encoders: str | None = None
) -> Campaign:
    """Make the campaign of a night: encoder angles as counters of `STEP_DEG`, stars as sightings.

    An encoder does not resolve whole turns: the azimuth axis is assumed on the turn of the star's stated azimuth.

    Args:
        stars: in time order.
        name: of the campaign.
        u_arcsec: standard uncertainty of a star's direction.
        encoders: "output" or "motor" for absolute ones, on the axes or before the gears; else each night has its zero.
    """
    elevation, azimuth = np.array([star.encoder_deg for star in stars]).T
    stated = np.array([star.true_deg[1] for star in stars])
    azimuth = AZIMUTH_FROM_DEG - azimuth - 360.0 * np.round((stated - azimuth) / 360.0)
    sidereal = np.unwrap([star.sidereal_s for star in stars], period=DAY_S)
    time_s = (sidereal - sidereal[0]) * SIDEREAL_S
    pan, tilt = (np.rint(angle / STEP_DEG).astype(int).tolist() for angle in (azimuth, elevation))
    moves: list[Move] = []
    for time, *counters in zip(time_s.tolist(), pan, tilt, strict=True):
        sides = ("", "") if moves else ("unknown", "unknown")
        moves.append(next_move(moves, 0, time, (counters[0], counters[1]), sides))  # type: ignore[arg-type]
    sightings = tuple(
        Sighting(
            sighting=k,
            move=k,
            azimuth_deg=float((AZIMUTH_FROM_DEG - star.true_deg[1]) % 360.0),
            elevation_deg=star.true_deg[0],
            u_deg=u_arcsec * ARCSEC,
        )
        for k, star in enumerate(stars)
    )
    none = dict.fromkeys(names_of("backlash_deg"), Prior(0.0, 0.0, "half-normal")) if encoders == "output" else {}
    absolute = AXES if encoders in ("output", "motor") else ()
    table = RigTable({**encoder_priors(), **none}, mechanism=SIGHTING_HEAD, absolute=absolute)
    return Campaign(tuple(moves), sightings, None, table, {"name": name})
