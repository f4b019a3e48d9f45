"""Comparison of two campaigns of one instrument: ratios and backlashes that have changed significantly.

Of two axes local ratios in deg/step at the reference pose of the first, backlashes in deg. Effective ratios are not
compared, since lines through looks at other counters are other quantities. JAX is loaded by a comparison, not by the
import.
"""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from tvsbayes.comparison.gap import camera_influence
from tvsbayes.instrument.parameters import TARGETS, unit_of
from tvsbayes.instrument.stereo_pair import stereo_covariance, stereo_parameters
from tvsbayes.results.comparison_record import Change, Comparison

if TYPE_CHECKING:
    from tvsbayes.estimators.joint_fit import JointFit


COMPARED = tuple(of.name for of in TARGETS.values() if of.judged)
"""Names of the compared quantities, as in JSON; the ratios are local ones."""


def _draws_at(fit: JointFit, pose_rad: np.ndarray) -> np.ndarray:
    """Compute `COMPARED` at a pose, shape (1 + draws, quantities): the estimate, then the Laplace draws."""
    from tvsbayes.posterior.draws import local_at

    drawn = local_at(fit, np.vstack([fit.z, fit.draws_z]), pose_rad)
    return np.stack([drawn[name.replace("effective_deg_per_step", "local_deg_per_step")] for name in COMPARED], axis=1)


def compare(first: JointFit, second: JointFit) -> Comparison:
    """Test whether an instrument has changed between two campaigns (normalised differences, as in ISO 13528 9.7).

    The u of a difference excludes common errors: errors of a shared stereo calibration and of the focal scale shift
    both estimates, by influences known from the fits. All other errors are taken as independent.

    Args:
        first: converged fit of A.
        second: converged fit of B.
    """
    pose = first.reference_pose_rad
    ours, theirs = first.campaign.stereo, second.campaign.stereo
    shared = all(np.array_equal(part(ours), part(theirs)) for part in (stereo_parameters, stereo_covariance))
    before, after = _draws_at(first, pose), _draws_at(second, pose)
    common = np.zeros(len(COMPARED))
    if shared:
        influence = camera_influence(first, before[1:]), camera_influence(second, after[1:])
        common = 2 * np.sum(influence[0] * influence[1], axis=1)
    pan, tilt = np.degrees(pose)
    return compared(
        [(name, unit_of(name)) for name in COMPARED],
        before,
        after,
        common,
        reference_pose_deg=(float(pan), float(tilt)),
        shared_cameras=shared,
        days=days_between(first.campaign.header, second.campaign.header),
    )


def compared(
    quantities: Sequence[tuple[str, str]],
    before: np.ndarray,
    after: np.ndarray,
    common: np.ndarray | float = 0.0,
    **about: Any,
) -> Comparison:
    """Test whether quantities differ between two calibrations.

    Args:
        quantities: name and unit of each.
        before: estimate, then draws, of A, shape (1 + draws, quantities).
        after: those of B.
        common: what a common error takes from the variance of each difference.
        about: further fields of `Comparison`.
    """
    from scipy import special

    limit = -float(special.ndtri(0.5 * (1 - 0.95 ** (1 / len(quantities)))))
    variance = before[1:].var(axis=0, ddof=1) + after[1:].var(axis=0, ddof=1) - common
    changes = []
    for k, (name, unit) in enumerate(quantities):
        a, b = float(before[0, k]), float(after[0, k])
        # A quantity fixed in both has changed if the stated values differ; its variance is zero except for rounding.
        fixed = np.ptp(before[1:, k]) == np.ptp(after[1:, k]) == 0
        u = 0.0 if fixed else float(np.sqrt(max(variance[k], 0.0)))
        ratio = (b - a) / u if u > 0 else None
        significant = a != b if ratio is None else abs(ratio) > limit
        changes.append(Change(name, unit, a, b, b - a, u, ratio, significant))
    moved = [c for c in changes if c.significant]
    listed = ", ".join(
        f"{c.label} by {c.difference:+.3g} {c.unit} "
        + ("(held fixed)" if c.normalised is None else f"({c.normalised:+.1f} u)")
        for c in moved
    )
    verdict = f"changed: {listed}" if moved else "no significant change"
    return Comparison(changes=tuple(changes), limit=limit, verdict=verdict, **about)


def days_between(first: Mapping[str, object], second: Mapping[str, object]) -> float | None:
    """Compute the days between two campaigns whose headers both state a date; dates count from midnight, UTC."""
    made = []
    for header in (first, second):
        when = header.get("created")
        if not isinstance(when, datetime.date):
            return None
        if not isinstance(when, datetime.datetime):
            when = datetime.datetime.combine(when, datetime.time())
        made.append(when if when.tzinfo else when.replace(tzinfo=datetime.UTC))
    return (made[1] - made[0]).total_seconds() / 86400
