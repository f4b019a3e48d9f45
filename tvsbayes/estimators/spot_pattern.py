"""Tests of the tables by spots in space, before any fit: pictures, names of sheets, single mistyped cells.

Points are triangulated, mm in frame S (X depth, Y left, Z up); px. With any rig, both pictures of a spot agree and
spots of one sheet lie on a plane; for counters see `counter_pattern`. The limits are far from the values of correct
campaigns (experiments/robustness/mistakes.md). No JAX.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from tvsbayes.errors import escaped, listed
from tvsbayes.estimators.findings import Finding, doubts
from tvsbayes.instrument.campaign import Campaign, Spot, pixels_of
from tvsbayes.instrument.stereo_pair import Stereo, project_pair, triangulate

SPOTS_MIN = 8
"""Least number of spots for a test."""
SPOTS_LISTED = 10
MISMATCH_PX = 3.0
"""Distance of a spot's pixels from those of its point that no calibration in use exceeds on most spots."""
CURED = 0.25
"""Largest remaining share of the mismatch where another size of the pictures, or the transpose of R, explains it."""
STRAY_MISMATCH = 10.0
"""Multiple of the median mismatch, and at least `MISMATCH_PX`, above which a single spot is an outlier."""
KNOCK_PX, KNOCK_SPREADS = 1.0, 6.0
"""Step of the mismatch within sheets, absolute and in its standard deviations, from which one camera has moved."""
GAP_MM, GAP_SHARE = 10.0, 0.1
"""Least gap between the depths of two sheets, absolute and of the depth."""
PLANE_MIN = 16
"""Least number of looks at a sheet for the spread about its plane, which three of them determine."""
SHEET_SLOPE = 0.026
"""Slope, 1.5 deg, by which a sheet may differ after it is put back."""
ALONE = 3.0
"""Factor on the distance from the plane for a look that is the only one of its placement."""
STRAY_PLANE, STRAY_FEW, STRAY_NEIGHBOUR, NEIGHBOUR_FLOOR = 3.5, 12.0, 8.0, 0.4
"""Limits for an outlier. Its deviation from the plane of its sheet is in standard deviations of all placements, with a
limit increased by `STRAY_FEW` over the number of looks. That from both neighbours in its placement is in their standard
deviation, at least `NEIGHBOUR_FLOOR` of the former: a moved sheet shows in all looks of its placement."""


@dataclass(frozen=True)
class SpotPattern:
    """The usable spots of a campaign in space.

    Attributes:
        campaign: where they come from.
        spots: those with status ok, in the order of the looks.
        pixels: (n, 4), px.
        points_mm: (n, 3), frame S.
        mismatch_px: (n,) distance of the four pixels from those of the point.
    """

    campaign: Campaign
    spots: tuple[Spot, ...]
    pixels: np.ndarray
    points_mm: np.ndarray
    mismatch_px: np.ndarray


def mismatch_px(stereo: Stereo, pixels: np.ndarray, points_mm: np.ndarray) -> np.ndarray:
    """Compute the distance (n,) of pixels (n, 4) from those of their triangulated points (n, 3)."""
    return np.linalg.norm(project_pair(stereo, points_mm) - pixels, axis=1)


def pattern_of(campaign: Campaign, spots: Sequence[Spot], points_mm: np.ndarray) -> SpotPattern:
    """Build the pattern of spots in space, in the order of the looks.

    Args:
        campaign: where they come from.
        spots: usable ones.
        points_mm: (n, 3) where they are, frame S; finite.
    """
    order = sorted(range(len(spots)), key=lambda k: (spots[k].move, spots[k].spot))
    ordered, points_mm = tuple(spots[k] for k in order), points_mm[order]
    pixels = pixels_of(ordered)
    return SpotPattern(campaign, ordered, pixels, points_mm, mismatch_px(campaign.stereo_pair, pixels, points_mm))


def picture_findings(pattern: SpotPattern) -> list[Finding]:
    """Find contradictions to the cameras: pictures of another size or mismatched, a camera that moved."""
    said = _picture_doubts(pattern)
    return doubts("pictures", said) or doubts("camera-moved", _knock_doubts(pattern))


def table_findings(pattern: SpotPattern) -> list[Finding]:
    """Find contradictions to the sheets: wrong names, single outliers."""
    # A spot with the name of another sheet would be an outlier to the plane of that sheet.
    named = doubts("sheet-name", _name_doubts(pattern), "spots.csv")
    return named or doubts("spot-apart", _stray_doubts(pattern), "spots.csv")


def sheet_groups(depths_mm: np.ndarray) -> np.ndarray:
    """Number the sheet of every depth, (n,), by gaps between depths: 0 for the nearest."""
    order = np.argsort(depths_mm)
    far = np.diff(depths_mm[order]) > np.maximum(GAP_MM, GAP_SHARE * depths_mm[order][:-1])
    group = np.empty(len(depths_mm), int)
    group[order] = np.concatenate([[0], np.cumsum(far)])
    return group


def _picture_doubts(pattern: SpotPattern) -> tuple[str, ...]:
    """Describe pixels of pictures of another size, or of mismatched pictures."""
    off_px = float(np.median(pattern.mismatch_px))
    if off_px < MISMATCH_PX:
        return ()
    stereo = pattern.campaign.stereo_pair
    for factor, word in ((2.0, "half"), (0.5, "twice")):
        pixels = factor * pattern.pixels
        other = mismatch_px(stereo, pixels, triangulate(stereo, pixels))
        if np.median(other) < CURED * off_px:
            size = f"{stereo.image_width} x {stereo.image_height} px"
            return (
                f"the pixels look like those of pictures of {word} the size of stereo.json ({size}): left and right "
                f"contradict each other by {off_px:.1f} px, and agree once all pixels are multiplied by {factor:g}",
            )
    turned = replace(stereo, R=stereo.R.T)
    if np.median(mismatch_px(turned, pattern.pixels, triangulate(turned, pattern.pixels))) < CURED * off_px:
        return (
            f"R of stereo.json looks transposed: left and right contradict each other by {off_px:.1f} px, and agree "
            "with its transpose: import the calibration again with --key R=NAME.T, or without it",
        )
    return (
        f"left and right contradict each other by {off_px:.1f} px (median): pictures of another size or calibration, "
        "rows of one camera shifted, or x and y exchanged?",
    )


def signed_mismatch_px(pattern: SpotPattern) -> np.ndarray:
    """Compute the mismatch with the sign of the left row's, (n,)."""
    projected = project_pair(pattern.campaign.stereo_pair, pattern.points_mm)
    return pattern.mismatch_px * np.sign((projected - pattern.pixels)[:, 1])


def mismatch_spread_px(pattern: SpotPattern) -> float:
    """Estimate the standard deviation of a centre's error, px, from the mismatch of both pictures.

    Four coordinates have one condition, whose error is that of one coordinate. Linear trends over the pictures and with
    distance are due to the calibration and removed.
    """
    off, pixels = signed_mismatch_px(pattern), pattern.pixels
    design = np.column_stack((np.ones(len(off)), pixels[:, :2], pixels[:, 0] - pixels[:, 2]))
    design[:, 1:] -= design[:, 1:].mean(axis=0)
    rest = off - design @ np.linalg.lstsq(design, off, rcond=None)[0]
    return _spread(rest) * math.sqrt(len(off) / max(len(off) - design.shape[1], 1))


def _knock_doubts(pattern: SpotPattern) -> tuple[str, ...]:
    """Describe a step in the mismatch of left and right during the campaign: a camera was knocked, turned or refocused.

    The mismatch has the sign of the left row's, and its step is taken within each sheet: under a poor calibration the
    mismatch depends on distance.
    """
    off = signed_mismatch_px(pattern)
    if len(off) < 2 * SPOTS_MIN:
        return ()
    limit = 5 * _spread(off) + KNOCK_PX
    kept = np.clip(off, np.median(off) - limit, np.median(off) + limit)
    n = np.arange(1, len(kept))
    mean = kept.mean()
    # Find the most likely row of a single step in the mean.
    gain = np.cumsum(kept - mean)[:-1] ** 2 / (n * (len(kept) - n))
    row = int(np.argmax(gain[SPOTS_MIN - 1 : 1 - SPOTS_MIN])) + SPOTS_MIN
    names = np.array([spot.target for spot in pattern.spots])
    later = np.arange(len(off)) >= row
    steps, rest = [], []
    for name in np.unique(names):
        parts = [off[(names == name) & (later == side)] for side in (False, True)]
        if min(map(len, parts)) >= SPOTS_MIN:
            middles = [float(np.median(part)) for part in parts]
            steps.append(middles[1] - middles[0])
            rest += [part - middle for part, middle in zip(parts, middles, strict=True)]
    step = float(np.median(steps)) if steps else 0.0
    if abs(step) < KNOCK_PX or abs(step) < KNOCK_SPREADS * _spread(np.concatenate(rest)):
        return ()
    first, middles = pattern.spots[row], [float(np.median(off[later == side])) for side in (False, True)]
    return (
        f"from spot {first.spot} (move {first.move}) on left and right contradict each other by {middles[1]:+.1f} px, "
        f"before by {middles[0]:+.1f} px: was a camera knocked, turned or refocused? give the spots that "
        "stereo.json was not made for another status than ok",
    )


def _name_doubts(pattern: SpotPattern) -> tuple[str, ...]:
    """Describe spots at the depth of a sheet of another name, and sheets without names."""
    depths = pattern.points_mm[:, 0]
    group = sheet_groups(depths)
    names = [spot.target for spot in pattern.spots]
    blank = [k for k, name in enumerate(names) if not name.strip()]
    if blank and len({group[k] for k in blank}) > 1:
        means = [f"{depths[group == g].mean():.0f}" for g in sorted({int(group[k]) for k in blank})]
        return (
            f"the column target is empty for {len(blank)} spots, which lie at {listed_text(means)} mm: "
            "name each placement of the sheet in spots.csv, or import the table with --column target=NAME",
        )
    counts = Counter(zip(names, group.tolist(), strict=True))
    home = {name: max((g for n, g in counts if n == name), key=lambda g: counts[name, g]) for name in set(names)}
    owner = {g: max((n for n in home if counts[n, g]), key=lambda n: counts[n, g]) for g in set(group.tolist())}
    strays = [
        k
        for k, name in enumerate(names)
        if group[k] != home[name] and owner[int(group[k])] != name and home[owner[int(group[k])]] == group[k]
    ]
    if not strays:
        return ()
    first = strays[0]
    names_shown = escaped(names[first]), escaped(owner[int(group[first])])
    example = f"spot {pattern.spots[first].spot} is called {names_shown[0]} and stands where {names_shown[1]} is"
    return (
        f"{len(strays)} spots ({listed([pattern.spots[k].spot for k in strays], SPOTS_LISTED)}) lie at the depth of a "
        f"sheet of another name: {example}, {depths[first]:.0f} mm; correct the column target",
    )


def listed_text(words: Sequence[str]) -> str:
    """Join words, with "and" before the last."""
    return " and ".join(filter(None, (", ".join(words[:-1]), words[-1])))


def _stray_doubts(pattern: SpotPattern) -> tuple[str, ...]:
    """Describe single outliers: a mistyped cell, or a reflection."""
    off = pattern.mismatch_px
    apart = off > max(MISMATCH_PX, STRAY_MISMATCH * float(np.median(off)))
    reasons = {int(k): f"left and right contradict each other by {off[k]:.1f} px" for k in np.flatnonzero(apart)}
    for name in sorted({spot.target for spot in pattern.spots}):
        rows = np.array([k for k, s in enumerate(pattern.spots) if s.target == name and not apart[k]], int)
        if len(rows) < PLANE_MIN:
            continue
        away, unsure = _off_plane(pattern.points_mm[rows])
        # Consecutive rows have one placement where no other sheet was used in between.
        placement = np.cumsum(np.diff(rows, prepend=rows[0]) > 1)
        spread, apart_mm = _spread(away), _from_neighbours(away[:, None], placement, np.abs(away) / ALONE)
        usual = max(_spread(np.concatenate((apart_mm, -apart_mm))), NEIGHBOUR_FLOOR * spread)
        least = STRAY_PLANE * (1 + STRAY_FEW / len(rows)) * spread * unsure
        slope_mm = SHEET_SLOPE * _from_neighbours(pattern.points_mm[rows, 1:], placement, np.zeros(len(rows)))
        limit = np.maximum.reduce([least, MISMATCH_PX * _mm_per_pixel(pattern, rows), slope_mm])
        for k in np.flatnonzero((np.abs(away) > limit) & (apart_mm > STRAY_NEIGHBOUR * usual)):
            reasons[int(rows[k])] = f"{abs(away[k]):.1f} mm off the plane of its sheet, others {spread:.1g} mm"
    if not reasons:
        return ()
    first = min(reasons)
    spots = listed([pattern.spots[k].spot for k in sorted(reasons)], SPOTS_LISTED)
    one = f"spot {pattern.spots[first].spot}: {reasons[first]}"
    return (f"spots {spots} lie apart from all others ({one}): a mistyped pixel, a reflection, or a wrong status?",)


def _mm_per_pixel(pattern: SpotPattern, rows: np.ndarray) -> np.ndarray:
    """Compute the change of depth per pixel of disparity, (n,): depth squared over focal length times baseline."""
    stereo = pattern.campaign.stereo_pair
    return pattern.points_mm[rows, 0] ** 2 / (stereo.M1[0, 0] * float(np.linalg.norm(stereo.T)))


class _OffPlane(NamedTuple):
    """Depths (n,) above a plane, mm, and ratios (n,) of their variances to those with a known plane."""

    away_mm: np.ndarray
    unsure: np.ndarray


def _off_plane(points_mm: np.ndarray) -> _OffPlane:
    """Compute depths of points (n, 3) above the plane of most of them; far from all others its slope's error adds."""
    design = np.column_stack((np.ones(len(points_mm)), points_mm[:, 1:] - points_mm[:, 1:].mean(axis=0)))
    weights = np.ones(len(points_mm))
    for _ in range(10):
        plane = np.linalg.lstsq(design * weights[:, None], points_mm[:, 0] * weights, rcond=None)[0]
        away = points_mm[:, 0] - design @ plane
        # With Cauchy's weights an outlier of 10 mm does not tilt the plane.
        weights = 1 / np.sqrt(1 + (away / (2 * _spread(away))) ** 2)
    weighted = design * weights[:, None]
    leverage = np.einsum("ij,jk,ik->i", design, np.linalg.pinv(weighted.T @ weighted), design)
    others = leverage / np.maximum(1 - weights**2 * leverage, 1e-9)
    return _OffPlane(away, 1 + others)


def _from_neighbours(values: np.ndarray, placement: np.ndarray, alone: np.ndarray) -> np.ndarray:
    """Compute distances (n,) of values (n, k) from the nearer of both neighbours in the same placement.

    A single look at a moved sheet cannot be distinguished from a mistyped cell: it gets its value of `alone`.
    """
    steps = np.where(np.diff(placement) == 0, np.linalg.norm(np.diff(values, axis=0), axis=1), math.inf)
    nearer = np.minimum(np.append(math.inf, steps), np.append(steps, math.inf))
    return np.where(np.isfinite(nearer), nearer, alone)


def _spread(values: np.ndarray) -> float:
    """Estimate the standard deviation of normal values by the median absolute deviation; above rounding."""
    return max(1.4826 * float(np.median(np.abs(values - np.median(values)))), 1e-6)
