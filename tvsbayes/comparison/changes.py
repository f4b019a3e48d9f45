"""Two campaigns of one rig."""

from __future__ import annotations

import datetime
from typing import TYPE_CHECKING

import numpy as np

from tvsbayes.comparison.gap import camera_influence
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.campaign import Campaign
from tvsbayes.results.comparison_record import Change, Comparison

if TYPE_CHECKING:
    from tvsbayes.estimators.joint_fit import JointFit


def compare(first: JointFit, second: JointFit) -> Comparison:
    """Whether an instrument has changed between two campaigns (normalised differences; ISO 13528 9.7 has the idea).

    The u of a difference leaves out what both campaigns share: with the same stereo calibration, its error and that
    of the focal scale move both estimates alike, by influences known from the fits. Everything else is taken as
    independent.

    Args:
        first: converged fit of A.
        second: converged fit of B.
    """
    import jax
    import jax.numpy as jnp
    from scipy import stats

    from tvsbayes.instrument.parameters import INDEX
    from tvsbayes.model.headlines import derived_quantities

    pose = first.reference_pose_rad
    cameras = first.campaign.stereo, second.campaign.stereo
    shared = bool(
        np.array_equal(cameras[0].vector, cameras[1].vector)
        and np.array_equal(cameras[0].parameter_covariance, cameras[1].parameter_covariance)
    )
    values, influence = [], []
    for found in (first, second):
        with jax.enable_x64(True):
            at_pose = derived_quantities(
                jnp.asarray(np.vstack([found.z, found.draws_z])), found.space, jnp.asarray(pose)
            )
        backlash = np.asarray(at_pose.physical)[:, [INDEX["backlash_deg.pan"], INDEX["backlash_deg.tilt"]]]
        rows = np.concatenate([np.asarray(at_pose.effective_deg_per_step), backlash], axis=1)
        values.append(rows)
        influence.append(camera_influence(found, rows[1:]))
    names = [*(f"effective_deg_per_step.{d}" for d in DIRECTIONS), "backlash_deg.pan", "backlash_deg.tilt"]
    units = ["deg/step"] * 4 + ["deg"] * 2
    limit = float(stats.norm.isf(0.5 * (1 - 0.95 ** (1 / len(names)))))
    variance = sum(v[1:].var(axis=0, ddof=1) for v in values)
    if shared:
        variance = variance - 2 * np.sum(influence[0] * influence[1], axis=1)
    changes = []
    for k, name in enumerate(names):
        a, b = (float(v[0, k]) for v in values)
        # What both hold fixed has changed if the statements differ; its variance is zero but for rounding.
        fixed = all(np.ptp(v[1:, k]) == 0 for v in values)
        u = 0.0 if fixed else float(np.sqrt(max(variance[k], 0.0)))
        ratio = (b - a) / u if u > 0 else None
        significant = a != b if ratio is None else abs(ratio) > limit
        changes.append(Change(name, units[k], a, b, b - a, u, ratio, significant))
    moved = [c for c in changes if c.significant]
    listed = ", ".join(
        f"{c.quantity} by {c.difference:+.3g} {c.unit} "
        + ("(held fixed)" if c.normalised is None else f"({c.normalised:+.1f} u)")
        for c in moved
    )
    verdict = f"changed: {listed}" if moved else "no significant change"
    days = _days_between(first.campaign, second.campaign)
    pan, tilt = np.degrees(pose)
    return Comparison((float(pan), float(tilt)), tuple(changes), shared, days, limit, verdict)


def _days_between(first: Campaign, second: Campaign) -> float | None:
    """Days between two campaigns that both say when they were made; dates count from midnight, UTC."""
    made = []
    for campaign in (first, second):
        when = campaign.header.get("created")
        if not isinstance(when, datetime.date):
            return None
        if not isinstance(when, datetime.datetime):
            when = datetime.datetime.combine(when, datetime.time())
        made.append(when if when.tzinfo else when.replace(tzinfo=datetime.UTC))
    return (made[1] - made[0]).total_seconds() / 86400
