"""The promise of a scanner's or head's calibration: the bound of pointing errors by axis and side.

The calibration is the table: one state (`calibration.states`) for all counters and both sides. The promise
is that of `compensation.promise`, over posterior and use. Counters in steps, errors in degrees of mirror or joint.
"""

from __future__ import annotations

import numpy as np

from tvsbayes.calibration.calibration_file import calibration_json, content_sha256
from tvsbayes.calibration.optics import output_deg
from tvsbayes.calibration.pointing import Calibration
from tvsbayes.calibration.predicted_angles import PredictedAngles
from tvsbayes.calibration.states import homings_of, uses_of
from tvsbayes.compensation.correction import Correction
from tvsbayes.compensation.promise import TRIED_STOPS, promised_sides, tried_use
from tvsbayes.instrument.axes import AXES, SIDES, Axis
from tvsbayes.instrument.campaign import Campaign
from tvsbayes.results.compensation_record import AimedPromise, SidePromise
from tvsbayes.statistics.predicted_readings import frees_shift

NODES = 257
"""Counters of an axis at which the calibration's own are computed; linear between them, to a few per cent of a step."""
GOLDEN = 0.6180339887498949
"""Golden section, whose multiples less whole numbers spread evenly over [0, 1)."""


def nominal_line(campaign: Campaign, axis: Axis) -> tuple[float, float]:
    """Return the angle of an axis at counter 0, and per step, by the centres of the priors."""
    priors, kind = campaign.rig.priors, campaign.rig.mechanism
    zero = priors.get(kind.tilt_zero if axis == AXES[1] else "azimuth_zero_deg")
    return 0.0 if zero is None else zero.value, priors[f"degrees_per_step.{axis}"].value


def aimed_correction(calibration: Calibration, campaign: Campaign, axis: Axis, *, by_ratio: bool = False) -> Correction:
    """Make the calibration's counters of an axis a correction of nominal ones for the same angles.

    Args:
        calibration: the calibration in force.
        campaign: its campaign, whose priors state the nominal counters.
        axis: the axis.
        by_ratio: whether play and errors by position are left out, as by a driver that knows zero and ratio alone.
    """
    own, period = AXES.index(axis), calibration.period_deg.get(axis)
    zero, ratio = nominal_line(campaign, axis)
    # The pan stage's own angle has no zero; that of a head has one in its frame.
    added = calibration.estimates.get("azimuth_zero_deg", 0.0) if own == 0 else 0.0
    drive = calibration.drive(axis)
    ends = [output_deg(drive.values_at(n), axis, n, 0, period) for n in calibration.range_steps[own].tolist()]
    first, last = ((float(end) + added - zero) / ratio for end in ends)
    command = np.sort(np.linspace(first, last, NODES))
    angles = zero + ratio * command - added
    if by_ratio:
        at_zero = calibration.estimates[campaign.rig.mechanism.tilt_zero] if own else 0.0
        counters = np.tile((angles - at_zero) / drive.ratio, (2, 1))
    else:
        counters = np.array([[drive.position(a, side) for a in angles.tolist()] for side in (1, -1)])
    return Correction(command, counters[0] - command, counters[1] - command, resolution=1.0)


def _axis_promise(
    calibration: Calibration, campaign: Campaign, axis: Axis, by_ratio: bool, seed: int
) -> dict[str, SidePromise]:
    """Compute the promise of an axis by side; none where it never moved."""
    own = AXES.index(axis)
    if np.ptp(calibration.range_steps[own]) == 0:
        return {}
    # The other axis goes over its range meanwhile.
    first, last = calibration.range_steps[1 - own]
    other = first + (last - first) * (GOLDEN * np.arange(TRIED_STOPS) % 1.0)
    correction = aimed_correction(calibration, campaign, axis, by_ratio=by_ratio)
    machine = PredictedAngles(calibration, campaign, axis, other)
    between = float(correction.command[0]), float(correction.command[-1])
    _, tried = tried_use(machine, correction, between, nominal_line(campaign, axis), 0.0, seed)
    promise = promised_sides(tried, frees_shift(machine.homings), False)
    return {name: promise[way] for name, way in zip(SIDES[axis], ("backward", "forward"), strict=True)}


def aimed_promise(
    calibration: Calibration, campaign: Campaign, target: str, unsaid: tuple[str, ...] = (), *, seed: int = 0
) -> AimedPromise:
    """Compute the promise of a calibration in a format.

    Args:
        calibration: from an accepted fit.
        campaign: its campaign.
        target: "header" or "urdf".
        unsaid: what the format cannot express, in words.
        seed: seed of all draws.

    Raises:
        NothingToEstimate: the calibration has no draws of the shifts of its zeros.
    """
    uses = uses_of(campaign)
    promise: dict[str, SidePromise] = {}
    for axis in AXES:
        promise |= _axis_promise(calibration, campaign, axis, target == "urdf", seed)
    low, high = uses["pan"].kelvin
    return AimedPromise(
        target=target,
        machine=str(campaign.header.get("serial") or campaign.header.get("instrument") or ""),
        unit=PredictedAngles.unit,
        table=content_sha256(calibration_json(calibration)),
        range_steps={axis: (ends[0], ends[1]) for axis, ends in calibration.seen_steps.items()},
        reversal_steps=dict(calibration.overshoot_steps),
        hours=uses["pan"].hours,
        travel_steps={axis: use.travel for axis, use in uses.items()},
        homings=homings_of(campaign),
        promise=promise,
        unsaid=unsaid,
        state={axis: state._asdict() for axis, state in calibration.states.items()},
        kelvin=(low, high) if high > low else None,
    )
