"""What spots in space say of the tables, before any fit: of pictures, counters, names of sheets, single mistyped cells.

Points are triangulated, mm in frame S (X depth, Y left, Z up); counters in steps; px. A rig of any kind leaves the same
pattern: both pictures of a spot agree, spots move across when a counter grows, spots of one sheet lie on a plane. The
limits are far from what good campaigns show (experiments/robustness/mistakes.md). No JAX.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from tvsbayes.errors import escaped, listed
from tvsbayes.instrument.axes import AXES, SENSES, Axis
from tvsbayes.instrument.campaign import Campaign, Spot, pixels_of
from tvsbayes.instrument.parameters import names_of
from tvsbayes.instrument.stereo_pair import Stereo, project_pair, rotation_matrix, triangulate

SPOTS_MIN = 8
"""Fewer show no pattern."""
SPOTS_LISTED = 10
MISMATCH_PX = 3.0
"""Distance of a spot's pixels from those of its point that no calibration in use leaves on most spots."""
CURED = 0.25
"""Share of the mismatch that may be left where another size of the pictures explains it."""
STRAY_MISMATCH = 10.0
"""Times the median mismatch, and above `MISMATCH_PX`, that makes a single spot stray."""
KNOCK_PX, KNOCK_SPREADS = 1.0, 6.0
"""Step of the mismatch within sheets, absolute and in its own standard deviations, by which one camera has moved."""
TRAVEL_MIN_DEG = 3.0
"""Travel of an axis, by its prior ratio, from which its counter must show in the spots."""
FOLLOWED, LOST = 0.8, 0.5
"""Share of the motion across that a right counter explains at least (good campaigns: 0.94), a wrong one at most."""
BETTER = 3.0
"""Times less of the motion that the right counters leave than those of the table: sums of cells that are steps, or the
counters of the row before or after."""
LOOKS_TRIED, BEGINS_TRIED = 2000, 64
"""Looks, spread evenly, by which rows are held against their neighbours, and how many of them are tried as the first
that belongs to another; then those around the best."""
GAP_MM, GAP_SHARE = 10.0, 0.1
"""Least gap between the depths of two sheets, absolute and of the depth."""
STRAY_PLANE, STRAY_NEIGHBOUR, NEIGHBOUR_FLOOR = 3.5, 8.0, 0.4
"""Deviations from the plane of its sheet (in standard deviations of all placements), and from both neighbours in time
on that sheet (in theirs, at least that share of the former), that make a spot stray: a sheet put there anew is seen by
all looks of its placement."""


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
    """How far pixels (n, 4) lie from those of their triangulated points (n, 3), (n,): left and right contradict."""
    return np.linalg.norm(project_pair(stereo, points_mm) - pixels, axis=1)


def pattern_of(campaign: Campaign, spots: Sequence[Spot], points_mm: np.ndarray) -> SpotPattern:
    """Spots in space, in the order of the looks.

    Args:
        campaign: where they come from.
        spots: usable ones.
        points_mm: (n, 3) where they are, frame S; finite.
    """
    order = sorted(range(len(spots)), key=lambda k: (spots[k].move, spots[k].spot))
    ordered, points_mm = tuple(spots[k] for k in order), points_mm[order]
    pixels = pixels_of(ordered)
    return SpotPattern(campaign, ordered, pixels, points_mm, mismatch_px(campaign.stereo, pixels, points_mm))


def pattern_doubts(pattern: SpotPattern) -> tuple[str, ...]:
    """What the pattern of the spots contradicts, in words; empty for good campaigns and for too few spots."""
    if len(pattern.spots) < SPOTS_MIN:
        return ()
    pictures = _picture_doubts(pattern) or _knock_doubts(pattern)
    # A spot of another sheet would stray from the plane of the one that it is called after.
    return pictures or (*_counter_doubts(pattern), *(_name_doubts(pattern) or _stray_doubts(pattern)))


def _picture_doubts(pattern: SpotPattern) -> tuple[str, ...]:
    """Pixels of pictures of another size, or of pictures that do not belong together."""
    off_px = float(np.median(pattern.mismatch_px))
    if off_px < MISMATCH_PX:
        return ()
    stereo = pattern.campaign.stereo
    for factor, word in ((2.0, "half"), (0.5, "twice")):
        pixels = factor * pattern.pixels
        other = mismatch_px(stereo, pixels, triangulate(stereo, pixels))
        if np.median(other) < CURED * off_px:
            size = f"{stereo.image_width} x {stereo.image_height} px"
            return (
                f"the pixels look like those of pictures of {word} the size of stereo.json ({size}): left and right "
                f"contradict each other by {off_px:.1f} px, and agree once all pixels are multiplied by {factor:g}",
            )
    return (
        f"left and right contradict each other by {off_px:.1f} px (median): pictures of another size or calibration, "
        "rows of one camera shifted, or x and y exchanged?",
    )


def _knock_doubts(pattern: SpotPattern) -> tuple[str, ...]:
    """That left and right begin to contradict each other on the way: one camera was knocked, turned or focused anew.

    Of the mismatch the sign counts, that of the left row, and its step within each sheet: by a poor calibration they
    contradict each other at one distance more than at another.
    """
    projected = project_pair(pattern.campaign.stereo, pattern.points_mm)
    off = pattern.mismatch_px * np.sign((projected - pattern.pixels)[:, 1])
    limit = 5 * _spread(off) + KNOCK_PX
    kept = np.clip(off, np.median(off) - limit, np.median(off) + limit)
    n = np.arange(1, len(kept))
    mean = kept.mean()
    # The likeliest single step of a mean.
    gain = np.cumsum(kept - mean)[:-1] ** 2 / (n * (len(kept) - n))
    row = int(np.argmax(gain[SPOTS_MIN // 2 - 1 : 1 - SPOTS_MIN // 2])) + SPOTS_MIN // 2
    names = np.array([spot.target for spot in pattern.spots])
    later = np.arange(len(off)) >= row
    steps, rest = [], []
    for name in np.unique(names):
        parts = [off[(names == name) & (later == side)] for side in (False, True)]
        if min(map(len, parts)) >= SPOTS_MIN // 2:
            middles = [float(np.median(part)) for part in parts]
            steps.append(middles[1] - middles[0])
            rest += [part - middle for part, middle in zip(parts, middles, strict=True)]
    step = float(np.median(steps)) if steps else 0.0
    if abs(step) < KNOCK_PX or abs(step) < KNOCK_SPREADS * _spread(np.concatenate(rest)):
        return ()
    first, middles = pattern.spots[row], [float(np.median(off[later == side])) for side in (False, True)]
    return (
        f"from spot {first.spot} (move {first.move}) on left and right contradict each other by {middles[1]:+.1f} px, "
        f"before by {middles[0]:+.1f} px: was a camera knocked, turned or focused anew? give the spots that "
        "stereo.json was not made for another status than ok",
    )


@dataclass(frozen=True)
class _Followed:
    """How far a counter explains a motion across.

    Attributes:
        share: of the motion that other columns leave.
        slope: mm per step at the mean depth.
    """

    share: float
    slope: float


def _followed(across_mm: np.ndarray, depth_mm: np.ndarray, steps: np.ndarray, other: np.ndarray) -> _Followed:
    """A line in the counter whose slope grows with the depth, beside another counter's."""
    base = np.column_stack((np.ones_like(depth_mm), depth_mm, other, other * depth_mm))
    full = np.column_stack((base, steps, steps * depth_mm))

    def solved(design: np.ndarray) -> tuple[np.ndarray, float]:
        scale = np.maximum(np.abs(design).max(axis=0), 1e-12)
        found = np.linalg.lstsq(design / scale, across_mm, rcond=None)[0] / scale
        return found, float(((across_mm - design @ found) ** 2).sum())

    (_, before), (found, after) = solved(base), solved(full)
    share = 1 - after / before if before > 0 else 0.0
    return _Followed(share, float(found[-2] + found[-1] * depth_mm.mean()))


def _counter_doubts(pattern: SpotPattern) -> tuple[str, ...]:
    """Counters that are steps of a move, run the wrong way, belong to the other axis, or to other spots."""
    campaign = pattern.campaign
    priors = campaign.rig.priors
    turned = rotation_matrix(np.array([priors[name].value for name in names_of("extrinsics.rotation_rad")]))
    # Into the axes of frame P, as far as the campaign states them: columns X depth, Y left, Z up.
    points_mm = pattern.points_mm @ turned
    at = [spot.move for spot in pattern.spots]
    counters = {axis: np.array([getattr(m, f"{axis}_steps") for m in campaign.moves], float) for axis in AXES}
    summed = {axis: _summed(campaign, axis) for axis in AXES}
    seen = {axis: steps[at] for axis, steps in counters.items()}
    fits: dict[Axis, tuple[_Followed, _Followed, _Followed]] = {}
    for column, axis in enumerate(AXES, start=1):
        if abs(priors[f"degrees_per_step.{axis}"].value) * np.ptp(seen[axis]) < TRAVEL_MIN_DEG:
            continue
        other = seen[AXES[axis == AXES[0]]]
        across = partial(_followed, points_mm[:, column], points_mm[:, 0])
        fits[axis] = across(seen[axis], other), across(summed[axis][at], other), across(other, seen[axis])
    if len(fits) == 2 and all(own.share < LOST and other.share > FOLLOWED for own, _, other in fits.values()):
        return ("spots move across with the tilt counter and up with the pan counter: are both columns exchanged?",)
    found = tuple(text for axis, own in fits.items() if (text := _counter_doubt(axis, own)) is not None)
    if not fits or any(_are_steps(own, summed) for own, summed, _ in fits.values()):
        return found
    beside = _row_doubt(pattern, points_mm, counters)
    return found if beside is None else (beside,)


def _are_steps(own: _Followed, summed: _Followed) -> bool:
    """Whether the cells of a counter are the steps of each move."""
    return summed.share > FOLLOWED and 1 - own.share > BETTER * (1 - summed.share)


def _row_doubt(pattern: SpotPattern, points_mm: np.ndarray, counters: dict[Axis, np.ndarray]) -> str | None:
    """That spots belong to the moves beside theirs, all or from one on: two ways to number rows, or a missing row.

    Args:
        pattern: of the campaign.
        points_mm: (n, 3), columns depth, across, up, in the axes of frame P.
        counters: of all moves, steps.
    """
    chosen = np.unique(np.linspace(0, len(pattern.spots) - 1, LOOKS_TRIED).astype(int))
    at = np.array([spot.move for spot in pattern.spots])[chosen]
    depth_mm, motion_mm = points_mm[chosen, :1], points_mm[chosen, 1:]
    table = np.column_stack([counters[axis] for axis in AXES])

    def unexplained(steps: np.ndarray) -> float:
        """What counters (n, 2) leave of the motion, mm^2."""
        design = np.column_stack([np.ones_like(depth_mm), depth_mm, steps, steps * depth_mm])
        design /= np.maximum(np.abs(design).max(axis=0), 1e-12)
        return float(((motion_mm - design @ np.linalg.lstsq(design, motion_mm, rcond=None)[0]) ** 2).sum())

    def beside(lag: int, begin: int) -> float:
        moved = at + lag * (np.arange(len(at)) >= begin)
        return unexplained(table[np.clip(moved, 0, len(table) - 1)])

    own, motion = unexplained(table[at]), unexplained(np.zeros((len(at), 2)))
    last = len(at) - SPOTS_MIN
    tried = np.unique(np.linspace(0, last, BEGINS_TRIED).astype(int)).tolist()
    found = []
    for lag in (-1, 1):
        near = min(tried, key=partial(beside, lag))
        around = range(max(near - last // BEGINS_TRIED, 0), min(near + last // BEGINS_TRIED, last) + 1)
        begin = min(around, key=partial(beside, lag))
        found.append((beside(lag, begin), lag, begin))
    rest, lag, begin = min(found)
    if own <= BETTER * rest or rest > (1 - FOLLOWED) * motion:
        return None
    first = pattern.spots[int(chosen[begin])]
    which = "spots" if begin == 0 else f"from spot {first.spot} on, spots"
    return (
        f"{which} follow the counters of the move {'after' if lag > 0 else 'before'} theirs, not of the one that "
        f"spots.csv names (spot {first.spot}: move {first.move}): do pictures or rows count from 1, or is a row of "
        f"moves.csv missing or one too many? {'add 1 to' if lag > 0 else 'take 1 from'} their column move"
    )


def _counter_doubt(axis: Axis, fits: tuple[_Followed, _Followed, _Followed]) -> str | None:
    """What is odd about the counter of one axis."""
    own, summed, _ = fits
    positive, negative = SENSES[axis]
    if _are_steps(own, summed):
        return (
            f"spots follow the sum of {axis}_steps, not {axis}_steps: are these the steps of each move? "
            "moves.csv holds absolute counters AFTER the move"
        )
    if own.share < LOST:
        return f"spots do not follow {axis}_steps: rows of moves.csv and spots.csv shifted, or counters of another run?"
    if own.share > FOLLOWED and own.slope < 0:
        cure = f"write {axis}_steps with the other sign (and {positive} for {negative} in the approach)"
        mount = "or state in [rig.prior] extrinsics.rotation_rad how the cameras are turned"
        mount += "; looks of an axis that goes to and fro show the same where their rows are one apart"
        return f"spots move {negative} while {axis}_steps grows: {positive} counts up; {cure}, {mount}"
    return None


def _summed(campaign: Campaign, axis: Axis) -> np.ndarray:
    """What the counters of an axis add up to, anew in every segment."""
    total, before, found = 0, -1, []
    for move in campaign.moves:
        total = (total if move.segment == before else 0) + getattr(move, f"{axis}_steps")
        before = move.segment
        found.append(total)
    return np.array(found, dtype=float)


def _name_doubts(pattern: SpotPattern) -> tuple[str, ...]:
    """Spots whose depth is that of a sheet of another name; sheets without names."""
    depths = pattern.points_mm[:, 0]
    order = np.argsort(depths)
    gaps = np.diff(depths[order])
    far = gaps > np.maximum(GAP_MM, GAP_SHARE * depths[order][:-1])
    group = np.empty(len(depths), int)
    group[order] = np.concatenate([[0], np.cumsum(far)])
    names = [spot.target for spot in pattern.spots]
    blank = [k for k, name in enumerate(names) if not name.strip()]
    if blank and len({group[k] for k in blank}) > 1:
        means = [f"{depths[group == g].mean():.0f}" for g in sorted({int(group[k]) for k in blank})]
        return (
            f"the column target is empty for {len(blank)} spots, which lie at {listed_text(means)} mm: "
            "name each placement of the sheet",
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
    """Words with an "and" before the last."""
    return " and ".join(filter(None, (", ".join(words[:-1]), words[-1])))


def _stray_doubts(pattern: SpotPattern) -> tuple[str, ...]:
    """Single spots away from the pattern of all others: a mistyped cell, or a reflection."""
    off = pattern.mismatch_px
    apart = off > max(MISMATCH_PX, STRAY_MISMATCH * float(np.median(off)))
    found = {int(k): f"left and right contradict each other by {off[k]:.1f} px" for k in np.flatnonzero(apart)}
    for name in sorted({spot.target for spot in pattern.spots}):
        rows = np.array([k for k, s in enumerate(pattern.spots) if s.target == name and not apart[k]], int)
        if len(rows) < SPOTS_MIN:
            continue
        away = _off_plane_mm(pattern.points_mm[rows])
        spread, apart_mm = _spread(away), _from_neighbours(away)
        usual = max(_spread(np.concatenate((apart_mm, -apart_mm))), NEIGHBOUR_FLOOR * spread)
        for k in np.flatnonzero((np.abs(away) > STRAY_PLANE * spread) & (apart_mm > STRAY_NEIGHBOUR * usual)):
            found[int(rows[k])] = f"{abs(away[k]):.1f} mm off the plane of its sheet, others {spread:.1g} mm"
    if not found:
        return ()
    first = min(found)
    spots = listed([pattern.spots[k].spot for k in sorted(found)], SPOTS_LISTED)
    one = f"spot {pattern.spots[first].spot}: {found[first]}"
    return (f"spots {spots} lie apart from all others ({one}): a mistyped pixel, a reflection, or a wrong status?",)


def _off_plane_mm(points_mm: np.ndarray) -> np.ndarray:
    """Depths of points (n, 3) above the plane that most of them lie on, (n,)."""
    design = np.column_stack((np.ones(len(points_mm)), points_mm[:, 1:] - points_mm[:, 1:].mean(axis=0)))
    weights = np.ones(len(points_mm))
    for _ in range(10):
        plane = np.linalg.lstsq(design * weights[:, None], points_mm[:, 0] * weights, rcond=None)[0]
        away = points_mm[:, 0] - design @ plane
        # Cauchy's weights: a spot 10 mm off does not tilt the plane.
        weights = 1 / np.sqrt(1 + (away / (2 * _spread(away))) ** 2)
    return away


def _from_neighbours(values: np.ndarray) -> np.ndarray:
    """Distance from the nearer of the values before and after, (n,)."""
    steps = np.abs(np.diff(values))
    return np.minimum(np.append(math.inf, steps), np.append(steps, math.inf))


def _spread(values: np.ndarray) -> float:
    """Standard deviation by the median, for normal ones; above rounding."""
    return max(1.4826 * float(np.median(np.abs(values - np.median(values)))), 1e-6)
