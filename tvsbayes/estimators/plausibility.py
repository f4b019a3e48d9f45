"""Hints about a campaign before it is fitted: spots that no rig can have seen, and what its moves cannot tell apart.

Depths are triangulated, mm along X of frame S; counters in steps. Sentences for people, no verdict that stops a fit.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass
from functools import partial

import numpy as np

from tvsbayes.errors import listed
from tvsbayes.estimators.four_point import select_experiments
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.campaign import Campaign, pixels_of
from tvsbayes.instrument.stereo_pair import pair_doubts, triangulate
from tvsbayes.instrument.stops import observed_stops, separation

NEAREST_SHEET_MM, FARTHEST_SHEET_MM = 20.0, 100_000.0
"""Depths between which a sheet can stand: nearer than a lens barrel, or beyond a hall, is a mismatched pair."""
SHORTEST_BASELINE_MM = 2.0
"""Two lenses cannot stand closer; the longest baseline in metres that anybody calls a stereo pair is shorter."""
SPOTS_LISTED = 10
SHALLOW = 1.2
"""Ratio of the largest to the smallest depth below which the sheet stood at one place (the paper's: 1.6)."""


@dataclass(frozen=True)
class CampaignCheck:
    """What `check` says of a readable campaign: counts, and warnings in words."""

    moves: int
    segments: int
    spots: int
    ok_spots: int
    refused: dict[str, int]
    aperture_readings: int
    experiments: int
    warnings: tuple[str, ...]

    def as_json(self) -> dict[str, object]:
        """The document of `check --json`."""
        return {"kind": "campaign", **asdict(self), "warnings": list(self.warnings)}


def _depths_mm(campaign: Campaign) -> np.ndarray:
    """X of the usable spots, frame S; not a number where no undistorted point is seen."""
    return triangulate(campaign.stereo, pixels_of(s for s in campaign.spots if s.status == "ok"))[:, 0]


def _can_stand(depths_mm: np.ndarray) -> np.ndarray:
    return (depths_mm > NEAREST_SHEET_MM) & (depths_mm < FARTHEST_SHEET_MM)


def implausible(campaign: Campaign, depths_mm: np.ndarray | None = None) -> tuple[str, ...]:
    """What no rig can have measured: wrong units, swapped cameras, words that miss their spelling.

    Args:
        campaign: a campaign that its reader accepted.
        depths_mm: of its usable spots, where they are known already.
    """
    depths_mm = _depths_mm(campaign) if depths_mm is None else depths_mm
    few = partial(listed, most=SPOTS_LISTED)
    ok = [spot for spot in campaign.spots if spot.status == "ok"]
    found = []
    misspelt = [s.spot for s in campaign.spots if s.status != "ok" and s.status.strip().lower() == "ok"]
    if misspelt:
        found.append(f"spots {few(misspelt)} are left out: their status is not spelt ok, in small letters")
    stray = [s.spot for s in campaign.spots if s.status == "undetected" and s.u_left_px is not None]
    if stray:
        found.append(f"spots {few(stray)} are undetected and have pixels, which nothing uses: ok, or refused?")
    if not ok:
        return tuple(found)
    found += pair_doubts(campaign.stereo)
    baseline_mm = float(np.linalg.norm(campaign.stereo.T))
    if baseline_mm < SHORTEST_BASELINE_MM:
        found.append(f"T of stereo.json is {baseline_mm:.3g} mm long: is it in metres? Lengths are mm")
    odd = [spot.spot for spot, can in zip(ok, _can_stand(depths_mm), strict=True) if not can]
    if odd:
        limits = f"{NEAREST_SHEET_MM:g} to {FARTHEST_SHEET_MM:g} mm"
        question = "are left and right swapped, or mismatched?"
        found.append(f"spots {few(odd)} triangulate outside {limits}: {question}")
    readings = {s.spot: s.aperture_deg for s in ok if s.aperture_deg is not None}
    beyond = [spot for spot, reading in readings.items() if not 0 < reading < 180]
    if beyond:
        found.append(f"aperture readings of spots {few(beyond)} lie outside 0 to 180 deg from the baseline")
    elif readings and max(readings.values()) < np.pi:
        found.append(f"all aperture readings lie below {np.pi:.2f}: are they in radians? aperture_deg is in degrees")
    return tuple(found)


def check_campaign(campaign: Campaign) -> CampaignCheck:
    """Plausibility and identifiability of a campaign before any fit.

    Args:
        campaign: a campaign that its reader accepted.

    Returns:
        Counts and warnings; an empty tuple means that nothing stands in the way of a fit.
    """
    ok = [spot for spot in campaign.spots if spot.status == "ok"]
    refused = Counter(spot.status for spot in campaign.spots if spot.status != "ok")
    selection = select_experiments(campaign)
    warnings = [f"experiment {s.experiment} is not complete: {s.reason}" for s in selection.skipped]
    if not ok:
        warnings.append("no spot has status ok: there is nothing to estimate from")
    observed = {spot.move for spot in ok}
    for axis in AXES if ok else ():
        reason = separation(observed_stops(campaign.moves, observed, axis), axis)
        if reason is not None:
            warnings.append(f"{axis} ratio and {axis} backlash are hard to tell apart: {reason}")
    for move in campaign.moves:
        if "unknown" in (move.pan_approach, move.tilt_approach):
            warnings.append(f"segment {move.segment} begins with an unknown approach: its first reversal tells less")
    depths_mm = _depths_mm(campaign)
    warnings += implausible(campaign, depths_mm)
    if ok and np.all(_can_stand(depths_mm)) and depths_mm.max() < SHALLOW * depths_mm.min():
        warnings.append("all spots lie at one depth: a second sheet position sharpens ratios threefold")
    if campaign.stereo.assumed:
        warnings.append("the stereo covariance is assumed, not estimated: uncertainties are only as good as it is")
    if not np.any(campaign.stereo.parameter_covariance):
        warnings.append(
            "the stereo covariance is zero: its error (0.3 to 0.5 % of a ratio) is missing from every interval"
        )
    return CampaignCheck(
        moves=len(campaign.moves),
        segments=1 + campaign.moves[-1].segment,
        spots=len(campaign.spots),
        ok_spots=len(ok),
        refused=dict(refused),
        aperture_readings=sum(spot.aperture_deg is not None for spot in ok),
        experiments=len(selection.experiments),
        warnings=tuple(warnings),
    )
