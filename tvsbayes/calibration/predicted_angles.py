"""Predicted angles of one axis of a scanner or head: an adapter of `statistics.predicted_readings.PredictedMachine`.

Commands are counters, readings the angles of a mirror or joint, deg. Draws are those of a calibration; given one,
gears, play and shifts of the zero are known, so `expected` and `shifts` have no covariance.

An angle differs from its best estimate by the turn of the mirror that moves the beam as far, seen from where looks are
seen, at their distance. So errors of zero, mirrors and pose that cancel in the beam cancel here.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tvsbayes.calibration.frames import P_INPUTS
from tvsbayes.calibration.optics import Values, beam_components, output_deg
from tvsbayes.calibration.pointing import INPUT_NAMES, NOISE_NAMES, Calibration
from tvsbayes.calibration.states import ZERO_NAMES, homings_of, uses_of, zero_shifts
from tvsbayes.errors import NothingToEstimate
from tvsbayes.gears.states import HOUR_S, scatter_covariances
from tvsbayes.instrument.axes import AXES, SIDES, Axis
from tvsbayes.instrument.campaign import Campaign, ordered_spots, pixels_of
from tvsbayes.instrument.stereo_pair import triangulate
from tvsbayes.statistics.predicted_readings import PredictedReadings, State, Use

DRAWS = 320
"""Number of draws of the calibration in a prediction."""
SLOPE_DEG = 1e-3
"""Turn of a mirror for the derivatives of the beam, by central differences."""


class PredictedAngles:
    """One axis of a calibrated scanner or head as a `PredictedMachine`.

    Attributes:
        state: state of the calibration.
        use: use as in the campaign.
        homings: number of homings that were seen.
        other: counters of the other axis, one for all readings or one for each (r,).

    Raises:
        NothingToEstimate: the calibration has no draws of the shifts of its zeros.
    """

    unit = "deg"

    def __init__(self, calibration: Calibration, campaign: Campaign, axis: Axis, other: np.ndarray | float):
        if not len(calibration.zeros) or not calibration.states:
            message = "these results hold no draws of the shifts of the zeros: an older tvsbayes wrote them"
            raise NothingToEstimate("no-draws", message, remedy="run `tvsbayes fit` again")
        self.calibration, self.axis, self.other = calibration, axis, other
        self.state: State = calibration.states[axis]
        self.use: Use = uses_of(campaign)[axis]
        rows = np.linspace(0, len(calibration.inputs) - 1, DRAWS).round().astype(int)
        inputs, self._gears = np.split(calibration.inputs[rows], [len(INPUT_NAMES)], axis=1)
        self._inputs = dict(zip(calibration.names, inputs.T[..., None], strict=True))
        self._noise = dict(zip(NOISE_NAMES, calibration.noise[rows].T, strict=True))
        self._zeros = dict(zip(ZERO_NAMES, calibration.zeros[rows].T, strict=True))
        self._poses, self._pose = calibration.extrinsics[rows], calibration.extrinsics.mean(axis=0, keepdims=True)
        self._range_mm = _range_mm(campaign, self._poses[:, 3:].mean(axis=0))
        self.homings = homings_of(campaign)[axis]
        # An absolute zero walks from the first move on, and a use goes on from the last.
        times_s = [move.time_s for move in campaign.moves if axis in campaign.rig.absolute]
        self._walked_hours = (times_s[-1] - times_s[0]) / HOUR_S if times_s else 0.0
        self._home_sd_deg = (axis not in campaign.rig.absolute) * self._zeros[f"home_sd_deg.{axis}"]

    def expected(self, command: np.ndarray, side: np.ndarray, state: State | None = None) -> PredictedReadings:
        """Predict the repeatable part of angles."""
        own = AXES.index(self.axis)
        counters = [np.broadcast_to(np.asarray(n, dtype=float), np.shape(command)) for n in (command, self.other)]
        sides = [np.asarray(side, dtype=float), np.ones(np.shape(command))]
        (pan, tilt), sides = (counters, sides) if own == 0 else (counters[::-1], sides[::-1])

        def angles_of(values: Values) -> list[np.ndarray]:
            periods = [self.calibration.period_deg.get(axis) for axis in AXES]
            rows = zip(AXES, (pan, tilt), sides, periods, strict=True)
            return [np.asarray(output_deg(values, axis, n, at, period)) for axis, n, at, period in rows]

        values = self._inputs | self.calibration.gears.at(self._gears, (pan, tilt))
        best = self.calibration.estimates_at((pan, tilt))
        points, mean, pose = self._points(values, angles_of(values), self._poses), angles_of(best), self._pose
        slopes = []
        for off in SLOPE_DEG * np.eye(2):
            ends = [self._points(best, [mean[0] + k * off[0], mean[1] + k * off[1]], pose)[0] for k in (1, -1)]
            slopes.append((ends[0] - ends[1]) / (2 * SLOPE_DEG))
        turned = np.linalg.pinv(np.stack(slopes, axis=-1)) @ (points - points.mean(axis=0))[..., None]
        # The zero of a scanner's pan is that of its frame.
        zero = self.calibration.estimates.get("azimuth_zero_deg", 0.0) if own == 0 else 0.0
        shifts = {} if state is None else self.shifts(state, self.state)
        return _known(mean[own] + zero + turned[..., own, 0] + sum(each.mean for each in shifts.values()))

    def _points(self, values: Values, angles: Sequence[np.ndarray], poses: np.ndarray) -> np.ndarray:
        """Compute points of the beam at the looks' distance, of a pair of cameras in frame S: (n, r, 3)."""
        from scipy.spatial.transform import Rotation

        beam = beam_components({**values, **P_INPUTS}, angles[0], angles[1])
        ends = np.moveaxis(beam.at(self._range_mm), 0, -1)
        turns = Rotation.from_rotvec(poses[:, :3]).as_matrix()
        return np.einsum("nij,nrj->nri", turns, ends.reshape(len(poses), -1, 3)) + poses[:, None, 3:]

    def shifts(self, use: State, at: State) -> dict[str, PredictedReadings]:
        """Predict what the state adds: creep, temperature, and travel by the contrast of the directions."""
        later, earlier = (zero_shifts(self._zeros, self.axis, state) for state in (use, at))
        added = {cause: later[cause] - earlier[cause] for cause in later}
        return {cause: _known(each) for cause, each in added.items() if np.any(each)}

    def scatter(self, side: np.ndarray, use: State, u: np.ndarray | float) -> dict[str, np.ndarray]:
        """Compute what does not repeat, by cause, of angles after one homing, each at a stop of its own."""
        hours = np.broadcast_to(np.asarray(use.hours, dtype=float), np.shape(side)) + self._walked_hours
        low, high = (self._noise[f"stop_sd_deg.{name}"][:, None] ** 2 for name in SIDES[self.axis])
        stops = np.where(np.asarray(side) > 0, high, low)
        scales = self._home_sd_deg, self._zeros[f"drift_deg_per_root_hour.{self.axis}"]
        readings = np.broadcast_to(np.square(u), stops.shape)
        return scatter_covariances(scales, stops, readings, hours, np.zeros(len(side)), np.arange(len(side)))


def _known(angles: np.ndarray) -> PredictedReadings:
    """Angles (n, r) that each draw determines."""
    return PredictedReadings(angles, np.zeros((len(angles), angles.shape[1], angles.shape[1])))


def _range_mm(campaign: Campaign, origin_mm: np.ndarray) -> float:
    """Median distance of the looks from an origin (3,) of frame S, mm; 1 of sightings, which are directions."""
    spots = ordered_spots(campaign)
    if not campaign.has_images or not spots:
        return 1.0
    points = triangulate(campaign.stereo_pair, pixels_of(spots))
    return float(np.nanmedian(np.linalg.norm(points - origin_mm, axis=-1)))
