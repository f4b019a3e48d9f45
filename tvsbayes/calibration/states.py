"""States of a machine with two axes: time, travel and temperature since the homing, and the shifts of its zeros.

A calibration is of one stated state for all counters and both sides: `states_of`. deg, steps.
"""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence

import numpy as np

from tvsbayes.calibration.frames import EXTRINSICS_NAMES
from tvsbayes.gears.states import HOUR_MINUTES, HOUR_S, crept, travelled
from tvsbayes.instrument.axes import AXES, Axis
from tvsbayes.instrument.campaign import Campaign, Look, ordered_spots
from tvsbayes.instrument.conditions import kelvin, powered_on_s, warm_minutes
from tvsbayes.instrument.mechanisms import mechanism_of
from tvsbayes.instrument.parameters import RECEIVER_NAMES, names_of
from tvsbayes.statistics.predicted_readings import State, Use

ZERO_NAMES = names_of(
    *("ratio_contrast_deg_per_step", "drift_deg_per_root_hour", "creep_deg", "creep_minutes", "thermal_deg_per_K"),
    "home_sd_deg",
)
"""What a zero depends on in use, of both axes."""


def zero_shifts(zeros: Mapping[str, np.ndarray], axis: str, state: State) -> dict[str, np.ndarray]:
    """Compute the shifts of a zero at states by cause, deg, shape (n, 1 or r) (formulation 3.1).

    Args:
        zeros: draws (n,) of `ZERO_NAMES`.
        axis: the axis.
        state: one for all, or (r,) or (n, r); the contrast of the directions adds with the travel.
    """
    hours, steps, degrees = (np.atleast_2d(each) for each in (state.warm_hours, state.travel, state.kelvin))
    minutes = zeros["creep_minutes"][:, None]
    return {
        "creep": zeros[f"creep_deg.{axis}"][:, None] * crept(HOUR_MINUTES * hours, minutes),
        "temperature": zeros[f"thermal_deg_per_K.{axis}"][:, None] * degrees,
        "travel": 0.5 * zeros[f"ratio_contrast_deg_per_step.{axis}"][:, None] * steps,
    }


def total_shift(zeros: Mapping[str, np.ndarray], axis: str, state: State) -> np.ndarray:
    """Compute the sum of `zero_shifts`."""
    return np.asarray(sum(zero_shifts(zeros, axis, state).values()))


def columns_of(names: Sequence[str], physical: np.ndarray, wanted: Sequence[str]) -> np.ndarray:
    """Select columns of draws (n, names), shape (n, wanted); (0, wanted) where one is not among the names."""
    if not set(wanted) <= set(names):
        return np.zeros((0, len(wanted)))
    return physical[:, [names.index(name) for name in wanted]]


def shifts_at(zeros: np.ndarray, states: Mapping[Axis, State]) -> np.ndarray:
    """Compute the shifts (n, 2) of both zeros at one state of each axis, deg, from draws (n, k) of `ZERO_NAMES`."""
    column = dict(zip(ZERO_NAMES, zeros.T, strict=True))
    shifts = [total_shift(column, axis, states[axis])[:, 0] for axis in AXES if states]
    return np.stack(shifts, axis=1) if shifts else np.zeros((len(zeros), len(AXES)))


def poses_of(names: Sequence[str], physical: np.ndarray) -> np.ndarray:
    """Select the extrinsics (n, 6) of draws (n, names); zeros of a head with sightings, whose frame is P."""
    poses = columns_of(names, physical, EXTRINSICS_NAMES)
    is_head = mechanism_of(names).zeros[0] not in RECEIVER_NAMES
    return np.zeros((len(physical), len(EXTRINSICS_NAMES))) if is_head and not len(poses) else poses


def poses_at(extrinsics: np.ndarray, names: Container[str], turned_deg: np.ndarray) -> np.ndarray:
    """Compute the extrinsics (n, 6) of a positioner whose pan is shifted by (n,) degrees.

    Frame P of a scanner turns with its pan stage; that of a head, with an azimuth zero of its own among `names`, stays.
    """
    if not np.any(turned_deg) or mechanism_of(names).zeros[0] not in RECEIVER_NAMES:
        return extrinsics
    from scipy.spatial.transform import Rotation

    about_pan = np.multiply.outer(turned_deg, [0.0, 0.0, 1.0])
    turned = Rotation.from_rotvec(extrinsics[:, :3]) * Rotation.from_rotvec(about_pan, degrees=True)
    return np.column_stack([turned.as_rotvec(), extrinsics[:, 3:]])


def _timeline(campaign: Campaign) -> tuple[np.ndarray, dict[Axis, State]]:
    """First row of the segment of each move, and states (moves,) by axis."""
    moves = campaign.moves
    segment, time_s = (np.array([getattr(m, key) for m in moves], dtype=float) for key in ("segment", "time_s"))
    first = np.searchsorted(segment, segment)
    warm_hours = warm_minutes(moves, powered_on_s(campaign.header)) / HOUR_MINUTES
    states: dict[Axis, State] = {}
    for axis in AXES:
        steps = np.array([getattr(move, f"{axis}_steps") for move in moves], dtype=float)
        states[axis] = State((time_s - time_s[first]) / HOUR_S, travelled(steps, segment), warm_hours, kelvin(moves))
    return first, states


def states_at(campaign: Campaign, looks: Sequence[Look]) -> dict[Axis, State]:
    """Compute the states (n,) of looks of a campaign by axis."""
    number = {move.move: row for row, move in enumerate(campaign.moves)}
    rows, (_, states) = [number[look.move] for look in looks], _timeline(campaign)
    return {axis: State(*(np.asarray(each)[rows] for each in state)) for axis, state in states.items()}


def states_of(campaign: Campaign) -> dict[Axis, State]:
    """Compute the state of a calibration by axis: the mean of the looks, without travel; empty without looks.

    Travel shifts a zero by the contrast of the directions alone, from the homing on: a machine that is homed and sent
    to a point has none.
    """
    if not (looks := ordered_spots(campaign)):
        return {}
    means = {
        axis: State(*(float(np.mean(each)) for each in state)) for axis, state in states_at(campaign, looks).items()
    }
    return {axis: state._replace(travel=0.0) for axis, state in means.items()}


def homings_of(campaign: Campaign) -> dict[str, int]:
    """Count the homings whose zeros were seen, by axis; 0 of an absolute encoder."""
    segment = {move.move: move.segment for move in campaign.moves}
    seen = len({segment[spot.move] for spot in ordered_spots(campaign)})
    return {axis: 0 if axis in campaign.rig.absolute else seen for axis in AXES}


def uses_of(campaign: Campaign) -> dict[Axis, Use]:
    """Compute the use of each axis as in a campaign: its longest time and travel after a homing, its temperatures."""
    first, states = _timeline(campaign)
    return {
        axis: Use(
            float(np.max(state.hours)),
            float(np.max(state.travel)),
            np.asarray(state.warm_hours)[np.unique(first)],
            (float(np.min(state.kelvin)), float(np.max(state.kelvin))),
        )
        for axis, state in states.items()
    }
