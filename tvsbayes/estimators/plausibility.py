"""Checks of a campaign before it is fitted: impossible spots, and parameters that its moves cannot separate.

Sightings are tested for another sign of an axis and for azimuth and elevation exchanged, by the stated ratios within
three of their u. Angles are in degrees on the circle. Depths of spots are triangulated, mm along X of frame S; counters
in steps. Certain findings stop commands that fit.
"""

from __future__ import annotations

import datetime
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tvsbayes.errors import listed
from tvsbayes.estimators.counter_pattern import counter_findings
from tvsbayes.estimators.findings import Finding, doubts, line_of, mending_command
from tvsbayes.estimators.four_point import SkippedExperiment, select_experiments
from tvsbayes.estimators.spot_pattern import (
    MISMATCH_PX,
    SPOTS_LISTED,
    SPOTS_MIN,
    mismatch_px,
    mismatch_spread_px,
    pattern_of,
    picture_findings,
    table_findings,
)
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.campaign import (
    MOVES,
    PIXEL_SDS,
    UNDETECTED,
    Campaign,
    Spot,
    ordered_spots,
    pixels_of,
    stereo_spots,
)
from tvsbayes.instrument.conditions import interpolated, temperature_doubts
from tvsbayes.instrument.parameters import names_of
from tvsbayes.instrument.sightings import SIGHTINGS, sighted_deg, sightings_of
from tvsbayes.instrument.stereo_pair import SHORTEST_BASELINE_MM, baseline_doubt, pair_doubts, triangulate
from tvsbayes.instrument.stops import lone_doubts, observed_stops, separation
from tvsbayes.results.records import Record

RATIOS_TRIED, RATIO_SDS = 61, 3.0
"""Ratios by which sightings are compared with counters, up to so many u from the stated one."""
FAR_DEG, NEARER = 5.0, 4.0
"""Median misfit of a line above which sightings do not follow their counters, and the factor by which it must fall with
other counters to be certain."""
LEAST = 6
"""Least number of different counters of an axis for a test."""
LISTED = 6
"""Largest number of sightings listed."""
NEAREST_SHEET_MM, FARTHEST_SHEET_MM = 20.0, 100_000.0
"""Possible depths of a sheet: nearer than a lens barrel or beyond a hall, the pair is mismatched."""
SHORTEST_MM = 0.5
"""All stated lengths of a rig are longer in mm, and shorter if given in metres."""
CORNER_SHARE = 0.02
"""Share of the picture's height: if all spots are nearer to the first pixel, they are not in pixels."""
ODD_SHARE = 0.1
"""Share of spots at impossible depths from which counters and names are not tested."""
NOISE_OFF = 4.0
"""Ratio of pixel noise to the stated one, either way, that a fit's prior (a factor of 1.6, log-normal) excludes."""
SHALLOW = 1.2
"""Ratio of the largest to the smallest depth below which the sheet had one position (the paper's: 1.6)."""


def _misspelt(campaign: Campaign, looks: str, file: str, most: int) -> list[Finding]:
    """Find looks whose status is nearly the word ok; at most so many are listed."""
    misspelt = [s.spot for s in campaign.spots if s.status != "ok" and s.status.strip().lower() == "ok"]
    said = f"{looks} {listed(misspelt, most)} are left out: their status is not spelt ok, in small letters"
    return [Finding("status", said, file=file)] if misspelt else []


def _move_findings(campaign: Campaign) -> list[Finding]:
    """Find temperatures that no sensor measured, and counters with a digit too many."""
    findings = doubts("temperature", temperature_doubts(campaign.moves), MOVES.file)
    for axis in AXES:
        column = f"{axis}_steps"
        lone = lone_doubts(campaign.moves, [getattr(move, column) for move in campaign.moves], column)
        findings += doubts("lone-counter", lone, MOVES.file)
    return findings


def sighting_findings(campaign: Campaign) -> tuple[Finding, ...]:
    """Find sightings that no head can have made, as `implausible` does for spots."""
    findings = _misspelt(campaign, "sightings", SIGHTINGS.file, LISTED)
    ok = ordered_spots(campaign)
    steps = np.array([(m.pan_steps, m.tilt_steps) for m in (campaign.moves[s.move] for s in ok)], float).reshape(-1, 2)
    angles_deg = sighted_deg(sightings_of(ok))
    names = "azimuth", "elevation"
    for k, axis in enumerate(AXES):
        if len(np.unique(steps[:, k])) < LEAST:
            continue
        misfit_deg, other = (_misfit_deg(campaign, axis, steps[:, k], angles_deg[:, j]) for j in (k, 1 - k))
        turned = _misfit_deg(campaign, axis, -steps[:, k], angles_deg[:, k])
        if misfit_deg < FAR_DEG:
            continue
        what = f"{names[k]} does not follow {axis}_steps by the stated ratio ({misfit_deg:.0f} deg off in the median)"
        if turned * NEARER < misfit_deg:
            remedy = f"it does with the other sign: turn the sign of {axis}_steps, or of {names[k]}"
            findings.append(Finding("counter-sign", what, remedy, certain=True, file=SIGHTINGS.file))
        elif other * NEARER < misfit_deg:
            remedy = f"{names[1 - k]} does: the columns are exchanged, or the counters"
            findings.append(Finding("exchanged", what, remedy, certain=True, file=SIGHTINGS.file))
        else:
            remedy = f"correct degrees_per_step.{axis} in [rig.prior], or the table"
            findings.append(Finding("counters", what, remedy, file=SIGHTINGS.file))
    return tuple(findings)


def _misfit_deg(campaign: Campaign, axis: str, steps: np.ndarray, angle_deg: np.ndarray) -> float:
    """Compute the median distance of angles (n,) from a line over counters (n,), on the circle, by the best ratio."""
    prior = campaign.rig.priors[f"degrees_per_step.{axis}"]
    ratios = prior.value + prior.u * np.linspace(-RATIO_SDS, RATIO_SDS, RATIOS_TRIED)
    turned = np.exp(1j * np.radians(angle_deg - ratios[:, None] * steps))
    mean = turned.mean(axis=1, keepdims=True)
    off = np.degrees(np.abs(np.angle(turned * np.conj(mean))))
    return float(np.median(off, axis=1).min())


class CampaignCheck(Record, frozen=True, tag_field="kind", tag="campaign"):
    """Result of `check` for a readable campaign: counts, findings, and all warnings in words."""

    moves: int
    segments: int
    spots: int
    ok_spots: int
    refused: dict[str, int]
    aperture_readings: int
    experiments: int
    findings: tuple[Finding, ...]
    warnings: tuple[str, ...]


def _can_stand(depths_mm: np.ndarray) -> np.ndarray:
    return (depths_mm > NEAREST_SHEET_MM) & (depths_mm < FARTHEST_SHEET_MM)


def implausible(campaign: Campaign, points_mm: np.ndarray | None = None) -> tuple[Finding, ...]:
    """Find data that no rig can have measured: wrong units, swapped cameras, wrong counters, misspelt words.

    Args:
        campaign: a campaign that its reader accepted.
        points_mm: (n, 3) usable spots in frame S, if known already.

    Returns:
        Findings, certain ones and doubts; `Finding.sentence` is printed.
    """
    of_moves = _move_findings(campaign)
    if not campaign.has_images:
        return (*of_moves, *sighting_findings(campaign))
    points_mm = campaign.usable_points_mm if points_mm is None else points_mm
    spots = stereo_spots(campaign.spots)
    ok = [spot for spot in spots if spot.status == "ok"]
    findings = [*of_moves, *_misspelt(campaign, "spots", "spots.csv", SPOTS_LISTED)]
    stray = [s.spot for s in spots if s.status == UNDETECTED and s.u_left_px is not None]
    if stray:
        named = listed(stray, SPOTS_LISTED)
        said = f"spots {named} are undetected and have pixels, which nothing uses: ok, or refused?"
        findings.append(Finding("status", said, file="spots.csv"))
    if not ok:
        return tuple(findings)
    findings += _stereo_findings(campaign)
    findings += doubts("units", _metres(campaign), "campaign.toml")
    if (unit := _pixel_unit(campaign, ok)) is not None:
        return (*findings, unit)
    findings += _from_one(campaign, ok)
    stands = _can_stand(points_mm[:, 0])
    odd = [spot for spot, can in zip(ok, stands, strict=True) if not can]
    if odd:
        findings.append(_impossible_depths(campaign, ok, odd))
    if len(odd) < ODD_SHARE * len(ok):
        there = [spot for spot, can in zip(ok, stands, strict=True) if can]
        if len(there) >= SPOTS_MIN:
            pattern = pattern_of(campaign, there, points_mm[stands])
            # Counters and planes cannot be tested where the pictures contradict each other.
            pictures = picture_findings(pattern)
            findings += pictures or [*counter_findings(pattern), *table_findings(pattern)]
    return (*findings, *_reading_findings(ok))


def misfit_causes(campaign: Campaign, pixel_scale: float | None = None) -> tuple[Finding, ...]:
    """Find explanations for a failed fit of a campaign, likeliest first.

    Args:
        campaign: the fitted campaign.
        pixel_scale: pixel noise over the stated one where the fit ended; None without a fit.

    Returns:
        Findings of `implausible`, and noise that is not as stated: a poor calibration has the same effect, so `check`
        does not test it. Empty where nothing explains the failure.
    """
    findings = [*implausible(campaign)]
    if not campaign.has_images:
        return tuple(findings)
    ok = [spot for spot in stereo_spots(campaign.spots) if spot.status == "ok"]
    points_mm = campaign.usable_points_mm
    stands = _can_stand(points_mm[:, 0])
    if stands.sum() < 2 * SPOTS_MIN or stands.mean() <= 1 - ODD_SHARE:
        return tuple(findings)
    there = [spot for spot, can in zip(ok, stands, strict=True) if can]
    seen_px = mismatch_spread_px(pattern_of(campaign, there, points_mm[stands]))
    stated_px = float(np.median([[getattr(spot, name) for name in PIXEL_SDS] for spot in there]))
    said = f"left and right of a spot agree to {seen_px:.2g} px (sd), su and sv of spots.csv say {stated_px:.2g} px"
    if not 1 / NOISE_OFF < seen_px / stated_px < NOISE_OFF:
        remedy = f"state {seen_px:.2g} px in su and sv, by `tvsbayes import --sd-px {seen_px:.2g}` of a table without"
        findings.append(Finding("pixel-noise", said, remedy, file="spots.csv"))
    elif pixel_scale is not None and pixel_scale > NOISE_OFF:
        said += f", but beams miss them by {pixel_scale:.2g} times that: the beam scatters, not the pixels"
        remedy = "look for a loose laser or mirror, vibration, steps that were lost, or a sheet that moved"
        findings.append(Finding("beam-scatter", said, remedy))
    # Certain findings come first.
    return tuple(sorted(findings, key=lambda finding: not finding.certain))


def _stereo_findings(campaign: Campaign) -> list[Finding]:
    """Find contradictions in the pair of cameras; an impossible baseline is certain."""
    unit = baseline_doubt(campaign.stereo_pair)
    others = doubts("stereo", (text for text in pair_doubts(campaign.stereo_pair) if text != unit), "stereo.json")
    if unit is None:
        return others
    given = "m" if float(np.linalg.norm(campaign.stereo_pair.T)) < SHORTEST_BASELINE_MM else "mm"
    remedy = f"import it again: `tvsbayes stereo --import FILE --import-unit {given} -o stereo.json`"
    return [Finding("units", unit, remedy, certain=True, file="stereo.json"), *others]


def _pixel_unit(campaign: Campaign, ok: Sequence[Spot]) -> Finding | None:
    """Find centres that are not in pixels: all of them are near the corner of the picture."""
    largest_px = float(np.abs(pixels_of(ok)).max())
    if largest_px >= CORNER_SHARE * campaign.stereo_pair.image_height:
        return None
    said = f"no pixel is larger than {largest_px:.3g}: are the centres in millimetres? They are in px"
    remedy = "import the table again with centres in px, by --column u_left_px=NAME and so on"
    return Finding("units", said, remedy, len(ok) >= SPOTS_MIN, "spots.csv", line_of(campaign.spots.index(ok[0])))


def _from_one(campaign: Campaign, ok: Sequence[Spot]) -> list[Finding]:
    """Find centres outside the picture by less than a pixel, as where the first pixel is called 1."""
    width, height = campaign.stereo_pair.image_width, campaign.stereo_pair.image_height
    last = np.array([width, height, width, height]) - 0.5
    pixels = pixels_of(ok)
    beyond = np.any(pixels > last, axis=1)
    # Counted from 1, they range from 0.5 to the size + 0.5.
    if not beyond.any() or pixels.min() < 0.5 or np.any(pixels > last + 1):
        return []
    first = ok[int(np.argmax(beyond))]
    said = (
        f"spot {first.spot} lies outside its picture of {width} x {height} px by less than a pixel, and so do "
        f"{int(beyond.sum())} in all: do pixels count from 1? (0, 0) is the centre of the first"
    )
    remedy = f"take 1 from all pixels: {mending_command(campaign, '--pixels-from 1')}"
    line = line_of(campaign.spots.index(first))
    # A single one may be a spot cut by the edge of the picture.
    return [Finding("pixels-from-one", said, remedy, bool(beyond.sum() > 1), "spots.csv", line)]


def _impossible_depths(campaign: Campaign, ok: Sequence[Spot], odd: Sequence[Spot]) -> Finding:
    """Report spots at impossible depths; cameras are swapped where exchanged pictures put nearly all on sheets."""
    limits = f"{NEAREST_SHEET_MM:g} to {FARTHEST_SHEET_MM:g} mm"
    said = f"spots {listed([spot.spot for spot in odd], SPOTS_LISTED)} triangulate outside {limits}: "
    line = line_of(campaign.spots.index(odd[0]))
    exchanged = pixels_of(ok)[:, [2, 3, 0, 1]]
    points_mm = triangulate(campaign.stereo_pair, exchanged)
    stands = _can_stand(points_mm[:, 0])
    swapped = len(ok) >= SPOTS_MIN and len(odd) > (1 - ODD_SHARE) * len(ok) and stands.mean() > 1 - ODD_SHARE
    if not swapped:
        return Finding("depths", f"{said}are left and right swapped, or mismatched?", file="spots.csv", line=line)
    off_px = float(np.median(mismatch_px(campaign.stereo_pair, exchanged[stands], points_mm[stands])))
    said += f"are left and right swapped? Exchanged, both pictures of a spot agree to {off_px:.1f} px"
    remedy = f"exchange them: {mending_command(campaign, '--swap')}"
    return Finding("cameras-swapped", said, remedy, off_px < MISMATCH_PX, "spots.csv", line)


def _reading_findings(ok: Sequence[Spot]) -> list[Finding]:
    """Find aperture readings in another unit, or from another direction."""
    readings = {s.spot: s.aperture_deg for s in ok if s.aperture_deg is not None}
    beyond = [spot for spot, reading in readings.items() if not 0 < reading < 180]
    if beyond:
        said = f"aperture readings of spots {listed(beyond, SPOTS_LISTED)} lie outside 0 to 180 deg from the baseline"
        return [Finding("aperture", said, file="spots.csv")]
    if not readings or max(readings.values()) >= np.pi:
        return []
    said = f"all aperture readings lie below {np.pi:.2f}: are they in radians? aperture_deg is in degrees"
    # A sheet in front of both cameras is never seen so close to the baseline's direction.
    remedy = "import the table again with --angles rad"
    return [Finding("units", said, remedy, len(readings) >= SPOTS_MIN, "spots.csv")]


def _metres(campaign: Campaign) -> list[str]:
    """Find lengths stated in metres where the name says mm."""
    lengths = campaign.rig.mechanism.parameters.keys() & {"mirror_offset_mm"}
    stated = {name: campaign.rig.values[name] for name in lengths}
    origin = [campaign.rig.values[name] for name in names_of("extrinsics.translation_mm")]
    stated["extrinsics.translation_mm"] = max(origin, key=abs)
    traceability = campaign.header.get("traceability")
    if isinstance(traceability, dict) and isinstance(traceability.get("pitch_mm"), dict):
        stated["pitch_mm"] = float(traceability["pitch_mm"]["value"])
    return [
        f"{name} of campaign.toml is {value:g}: is it in metres? Lengths are mm"
        for name, value in stated.items()
        if 0 < abs(value) < SHORTEST_MM
    ]


def _incomplete(skipped: Sequence[SkippedExperiment]) -> list[str]:
    """Write one sentence for all experiments that are incomplete for the same reason."""
    by_reason: dict[str, list[str]] = {}
    for one in skipped:
        by_reason.setdefault(one.reason, []).append(one.name)
    return [
        f"{'experiments' if len(experiments) > 1 else 'experiment'} {listed(experiments, SPOTS_LISTED)} "
        f"{'are' if len(experiments) > 1 else 'is'} not complete: {reason}"
        for reason, experiments in by_reason.items()
    ]


def _calibrated_later(header: Mapping[str, Any]) -> list[str]:
    """Warn in a sentence if the cameras were calibrated on a later day than the campaign was made."""
    created, calibrated = header.get("created"), header.get("traceability", {}).get("stereo_calibrated")
    if created is None or calibrated is None:
        return []
    # Days are compared: a date has no hour, and a time may have no zone.
    days = [datetime.date(when.year, when.month, when.day) for when in (created, calibrated)]
    if days[1] <= days[0]:
        return []
    return [
        f"stereo_calibrated {days[1]} is later than created {days[0]}: right only if the cameras were not touched in "
        "between; else correct the date"
    ]


def check_campaign(campaign: Campaign) -> CampaignCheck:
    """Check plausibility and identifiability of a campaign before any fit.

    Args:
        campaign: a campaign that its reader accepted.

    Returns:
        Counts and warnings; without warnings the campaign can be fitted.
    """
    ok = [spot for spot in campaign.spots if spot.status == "ok"]
    refused = Counter(spot.status for spot in campaign.spots if spot.status != "ok")
    selection = select_experiments(campaign)
    stereo = campaign.stereo
    points_mm = campaign.usable_points_mm if campaign.has_images else np.zeros((0, 3))
    # Causes first, then their consequences.
    findings = implausible(campaign, points_mm)
    warnings = [*(finding.sentence for finding in findings), *_incomplete(selection.skipped)]
    if not ok:
        warnings.append(f"no {campaign.looks_table.required[0]} has status ok: there is nothing to estimate from")
    if count := interpolated(campaign.moves):
        warnings.append(f"{count} of {len(campaign.moves)} moves have no temperature_degC: interpolated in time")
    observed = {spot.move for spot in ok}
    for axis in AXES if ok else ():
        reason = separation(observed_stops(campaign.moves, observed, axis), axis)
        if reason is not None:
            warnings.append(f"{axis} ratio and {axis} backlash are poorly separated: {reason}")
    unknown = [m.segment for m in campaign.moves if "unknown" in (m.pan_approach, m.tilt_approach)]
    if unknown:
        begin = (
            f"segments {listed(unknown, SPOTS_LISTED)} begin" if len(unknown) > 1 else f"segment {unknown[0]} begins"
        )
        warnings.append(f"{begin} with an unknown approach: the first reversal is less informative")
    depths_mm = points_mm[:, 0]
    if len(depths_mm) and np.all(_can_stand(depths_mm)) and depths_mm.max() < SHALLOW * depths_mm.min():
        warnings.append("all spots lie at one depth: a second sheet position lowers u of ratios threefold")
    if stereo is not None and stereo.assumed:
        warnings.append("the stereo covariance is assumed, not estimated: uncertainties depend on it")
    if stereo is not None and not np.any(stereo.parameter_covariance):
        warnings.append(
            "the stereo covariance is zero: its error (0.3 to 0.5 % of a ratio) is missing from every interval"
        )
    warnings += _calibrated_later(campaign.header)
    return CampaignCheck(
        moves=len(campaign.moves),
        segments=1 + campaign.moves[-1].segment,
        spots=len(campaign.spots),
        ok_spots=len(ok),
        refused=dict(refused),
        aperture_readings=sum(spot.aperture_deg is not None for spot in ok),
        experiments=len(selection.experiments),
        findings=findings,
        warnings=tuple(warnings),
    )
