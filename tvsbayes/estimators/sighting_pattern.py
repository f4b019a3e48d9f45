"""Whether sightings follow the counters: another sign of an axis, azimuth and elevation exchanged.

Degrees on the circle; nothing but the stated ratios is believed, and these within three of their u.
"""

from __future__ import annotations

import numpy as np

from tvsbayes.errors import listed
from tvsbayes.estimators.findings import Finding
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.campaign import Campaign, ordered_spots
from tvsbayes.instrument.sightings import SIGHTINGS, sighted_deg, sightings_of

RATIOS_TRIED, RATIO_SDS = 61, 3.0
FAR_DEG, NEARER = 5.0, 4.0
"""Median misfit of a rough line from which sightings do not follow their counters, and how much better they must follow
others to be sure which."""
LEAST = 6
"""Sightings at different counters of an axis below which nothing is said."""
LISTED = 6


def sighting_findings(campaign: Campaign) -> tuple[Finding, ...]:
    """What no head can have seen, as `plausibility.implausible` lists it."""
    misspelt = [s.spot for s in campaign.spots if s.status != "ok" and s.status.strip().lower() == "ok"]
    found = []
    if misspelt:
        named = listed(misspelt, LISTED)
        said = f"sightings {named} are left out: their status is not spelt ok, in small letters"
        found.append(Finding("status", said, file=SIGHTINGS.file))
    ok = ordered_spots(campaign)
    steps = np.array([(m.pan_steps, m.tilt_steps) for m in (campaign.moves[s.move] for s in ok)], float).reshape(-1, 2)
    angles_deg = sighted_deg(sightings_of(ok))
    names = "azimuth", "elevation"
    for k, axis in enumerate(AXES):
        if len(np.unique(steps[:, k])) < LEAST:
            continue
        own, other = (_misfit_deg(campaign, axis, steps[:, k], angles_deg[:, j]) for j in (k, 1 - k))
        turned = _misfit_deg(campaign, axis, -steps[:, k], angles_deg[:, k])
        if own < FAR_DEG:
            continue
        what = f"{names[k]} does not follow {axis}_steps by the stated ratio ({own:.0f} deg off in the middle)"
        if turned * NEARER < own:
            remedy = f"it does with the other sign: turn the sign of {axis}_steps, or of {names[k]}"
            found.append(Finding("counter-sign", what, remedy, certain=True, file=SIGHTINGS.file))
        elif other * NEARER < own:
            remedy = f"{names[1 - k]} does: the columns are exchanged, or the counters"
            found.append(Finding("exchanged", what, remedy, certain=True, file=SIGHTINGS.file))
        else:
            remedy = f"correct degrees_per_step.{axis} in [rig.prior], or the table"
            found.append(Finding("counters", what, remedy, file=SIGHTINGS.file))
    return tuple(found)


def _misfit_deg(campaign: Campaign, axis: str, steps: np.ndarray, angle_deg: np.ndarray) -> float:
    """Median distance of angles (n,) from a line over counters (n,), on the circle, by the best stated ratio."""
    prior = campaign.rig.priors[f"degrees_per_step.{axis}"]
    ratios = prior.value + prior.u * np.linspace(-RATIO_SDS, RATIO_SDS, RATIOS_TRIED)
    turned = np.exp(1j * np.radians(angle_deg - ratios[:, None] * steps))
    mean = turned.mean(axis=1, keepdims=True)
    off = np.degrees(np.abs(np.angle(turned * np.conj(mean))))
    return float(np.median(off, axis=1).min())
