"""Validation of the residuals: score tests of defects that the model leaves out.

Residuals are whitened by the pixel noise, four components a spot (range projected out; the last is empty without a
reading); coordinates are in sds of their priors. Counters in steps, angles in degrees.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from tvsbayes.assessment.headlines import linear_headlines
from tvsbayes.assessment.residuals import CAUSE_BINS, STEP_PHASES
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.estimators.linear_spots import StopGroup, linear_spots, stop_information
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.campaign import ordered_spots
from tvsbayes.instrument.parameters import CREEP_NAMES, STEREO_PARAMETER_NAMES
from tvsbayes.instrument.stops import rests_of
from tvsbayes.results.estimates import Validation, ValidationTest
from tvsbayes.statistics.chances import log_chance
from tvsbayes.statistics.score import Directions, Score

VALIDATION_LEVEL = 0.01
"""Probability, for all tests together, that a correct campaign fails; `experiments/robustness/model_error.md`."""
CHANGE_POINTS = 16
"""Number of places, evenly over the spots, at which cameras may have moved; twice as many for lost steps."""
WAVES = 16
"""Number of periods tested per axis for transmission errors: 1/2, 1, 3/2 ... periods over the range seen."""
ABSORBED = 1e-3
"""Share of a defect's effect below which the fit has absorbed it: the remainder is its curvature only."""
KNOWN_DIRECTION = 1e-4
"""Information (in prior sds) above which the fit can move along a direction."""
_POSE = ("extrinsics.rotation_rad", "extrinsics.translation_mm")


type Placed = list[tuple[str, np.ndarray]]
"""Places of a defect, with columns d(prediction)/d(its size) there, shape (spots, 4, q)."""


def _times(columns: np.ndarray, pattern: np.ndarray) -> np.ndarray:
    """Scale columns (spots, 4, q) by a pattern (spots,), the amount of the defect at each spot."""
    return columns * pattern[:, None, None]


class _SeenAxis(NamedTuple):
    """One axis at the spots: effect of its angle (spots, 4, 1), angle, counter, last move."""

    name: str
    push: np.ndarray
    angle_deg: np.ndarray
    counter: np.ndarray
    leg_steps: np.ndarray


def _seen_axes(fit: JointFit) -> list[_SeenAxis]:
    slope, angle = np.asarray(fit.linearised.slope), np.degrees(fit.linearised.mirror_angles_rad)
    axes = []
    for index, axis in enumerate(AXES):
        rests = rests_of(fit.campaign.moves, axis)
        at = [rests[spot.move] for spot in ordered_spots(fit.campaign)]
        counter, leg = (np.array([getattr(rest, field) for rest in at]) for field in ("steps", "distance"))
        axes.append(_SeenAxis(axis, slope[:, :, index : index + 1], angle[:, index], counter, leg))
    return axes


def _epipolar(fit: JointFit) -> np.ndarray:
    """Compute columns of a shift of one camera's rows against the other's, and its gradients, shape (n, 4, 3).

    They are the part of a residual that neither a mirror angle nor a range explains, independent of the beam's model.
    """
    jacobian, slope = np.asarray(fit.linearised.residual_jacobian), np.asarray(fit.linearised.slope)
    readings = -jacobian[:, :, fit.space.mechanism.columns("aperture_zero_deg")].sum(axis=2)
    # Without a reading the last of the four components is empty.
    readings = np.where(np.any(readings, axis=1, keepdims=True), readings, np.eye(4)[3])
    slopes = np.concatenate([slope.transpose(0, 2, 1), readings[:, None]], axis=1)
    normal = np.linalg.svd(slopes)[2][:, -1]
    row = np.linalg.pinv(np.asarray(fit.space.stereo_root))[:, STEREO_PARAMETER_NAMES.index("stereo.right.cy")]
    shift = -jacobian[:, :, fit.space.rig :] @ row
    shift = normal * np.sum(normal * shift, axis=1, keepdims=True)
    place = np.asarray(fit.linearised.predicted)[:, :2]
    spread = place.std(axis=0)
    place = (place - place.mean(axis=0)) / np.where(spread > 0, spread, 1.0)
    return shift[:, :, None] * np.concatenate([np.ones((len(place), 1)), place], axis=1)[:, None, :]


def _defects_in_time(fit: JointFit, axes: Sequence[_SeenAxis]) -> dict[str, Placed]:
    """Build defects of motion, drift or slip during the campaign."""
    spots, moves = ordered_spots(fit.campaign), fit.campaign.moves
    order = np.arange(len(spots))
    time = np.array([moves[spot.move].time_s for spot in spots])
    # Without times the order is used.
    time = order if np.ptp(time) == 0 else time
    drift = (time - time.mean()) / max(np.ptp(time), 1)
    segment = np.array([moves[spot.move].segment for spot in spots])

    def since(count: int, effect: Callable[[int], np.ndarray], of: str = "") -> Placed:
        """An effect that begins at one of some spots."""
        rows = np.unique(np.linspace(0, len(spots), count + 2)[1:-1].astype(int))
        place = f"{of}from {fit.campaign.looks[:-1]} {{}} on (move {{}})"
        return [(place.format(spots[row].spot, spots[row].move), effect(row)) for row in rows[rows > 0]]

    def slipped(axis: _SeenAxis, row: int) -> np.ndarray:
        # A homing restores the zero.
        return _times(axis.push, (order >= row) * (segment == segment[row]).astype(float))

    defects: dict[str, Placed] = {}
    if fit.campaign.has_images:
        jacobian, columns = -np.asarray(fit.linearised.residual_jacobian), fit.space.mechanism.columns
        cameras, warmed = jacobian[:, :, columns(*_POSE)], jacobian[:, :, columns(*_POSE, "focal_scale")]
        apart = _epipolar(fit)
        defects = {
            "the cameras moved": since(CHANGE_POINTS, lambda row: _times(cameras, order >= row)),
            "the cameras drifted (pose or focal length)": [("with time", _times(warmed, drift))],
            "one camera moved against the other (epipolar)": [
                ("with time", _times(apart, drift)),
                *since(CHANGE_POINTS, lambda row: _times(apart, order >= row)),
            ],
        }
    return defects | {
        "a ratio drifted": [
            (f"{axis.name}, with time", _times(axis.push, drift * (axis.angle_deg - axis.angle_deg.mean())))
            for axis in axes
        ],
        "steps were lost, or a joint slipped": [
            placed for axis in axes for placed in since(2 * CHANGE_POINTS, partial(slipped, axis), f"{axis.name} ")
        ],
    }


def _defects_in_place(fit: JointFit, axes: Sequence[_SeenAxis]) -> dict[str, Placed]:
    """Build defects that depend on position, approach, or sheet."""
    targets = np.array([spot.target for spot in ordered_spots(fit.campaign)])
    waves: Placed = []
    for axis in axes:
        stops = len(np.unique(axis.counter))
        # Any wave fits three stops; a search that failed may end where an axis does not turn.
        reach = 2 * float(np.ptp(axis.angle_deg)) if stops > 3 else 0.0
        periods = reach / np.arange(1, min(WAVES, 2 * stops) + 1) if reach else ()
        for period in [*periods, *fit.campaign.rig.harmonic_period_deg.get(axis.name, ())]:
            phase = 2 * np.pi * axis.angle_deg / period
            columns = axis.push * np.column_stack([np.cos(phase), np.sin(phase)])[:, None]
            waves.append((f"{axis.name}, period near {period:.3g} deg", columns))

    def by_group(group_of: Callable[[_SeenAxis], np.ndarray]) -> Placed:
        groups = [(axis, group_of(axis)) for axis in axes]
        return [(axis.name, axis.push * (group[:, None] == np.unique(group))[:, None]) for axis, group in groups]

    def lengths(axis: _SeenAxis) -> np.ndarray:
        edges = np.quantile(axis.leg_steps, np.linspace(0, 1, CAUSE_BINS + 1)[1:-1])
        return np.digitize(axis.leg_steps, np.unique(edges))

    return {
        "the gears have a transmission error": waves,
        f"stops depend on the step phase (n mod {STEP_PHASES})": by_group(lambda axis: axis.counter % STEP_PHASES),
        "stops depend on the length of the move": by_group(lengths),
        "the sheets disagree": by_group(lambda axis: targets),
    }


class _Tested(NamedTuple):
    """A test before the joint decision; `log_p`, since p of chi-squares of hundreds underflows."""

    log_p: float
    name: str
    where: str
    chi2: float
    dof: int
    shift_sd: float
    places: int = 1


def validate(fit: JointFit) -> Validation:
    """Test for defects that the model does not have, by score tests at the mode.

    For columns D = d(prediction)/d(size of a defect) the score is g = D'^T C^-1 r, C the covariance of pixel noise,
    stop errors and home offsets, D' = D less the part that the fit can absorb. If the model holds, g ~ N(0, D'^T C^-1
    D') and g^T (D'^T C^-1 D')^-1 g is chi-square for any true rig (Rao, Proc. Cambridge Phil. Soc. 44 (1948) 50). A
    creep is in C by its prior, as an error of a stop is. Nothing is refitted. The places of one defect share its level
    (Bonferroni), all tests share `VALIDATION_LEVEL` (Holm, Scand. J. Statist. 6 (1979) 65). Noise scales are the fitted
    ones, which include the effect of a defect.

    A defect of size s = (D'^T C^-1 D')^-1 g, left out of the model, shifts the mode by S J^T C^-1 D s. That is an
    uncorrected systematic effect: its square is added to the squared u (GUM F.2.4.5). `inflation` is sqrt(1 + (largest
    shift of a headline in its sds)^2), over the tests that failed.

    Args:
        fit: a joint fit.

    Returns:
        All tests and the verdict, without tests of defects that the fit can absorb entirely.
    """
    axes = _seen_axes(fit)
    defects, own = _defects_in_time(fit, axes) | _defects_in_place(fit, axes), fit.linearised.by_coordinates(fit.held)
    columns = np.concatenate([own, *(each for placed in defects.values() for _, each in placed)], axis=2)
    information, p = stop_information(linear_spots(fit.linearised, fit.arrays, columns)), own.shape[2]
    score = information.score(columns)
    # Creeps are known by their priors, as errors of stops are: of any size they would absorb what changes in time.
    by_prior = np.isin(fit.names, CREEP_NAMES)
    score[:p] -= by_prior * fit.z
    # Directions that the fit can follow.
    followed = Directions.of(information.fisher[:p, :p] + np.diag(by_prior), KNOWN_DIRECTION).inverse
    left = Score(score, information.fisher).given(slice(p), followed).at(slice(p, None))
    whole = np.diag(information.fisher)[p:]
    scale = np.sqrt(np.where(whole > 0, whole, 1.0))
    headlines = linear_headlines(fit)
    moved_by = headlines.gradients @ fit.covariance @ information.fisher[:p, p:] / headlines.sd[:, None]
    results, start = [_single_spots(fit, information.groups, followed, score[:p])], 0
    for name, placed in defects.items():
        tested = []
        for place, effect in placed:
            rows = slice(start, start := start + effect.shape[2])
            one, known = left.at(rows), Directions.of(left.information[rows, rows], ABSORBED, scale[rows])
            if dof := len(known.values):
                shift = np.max(np.abs(moved_by[:, rows] @ known.inverse @ one.value))
                log_p, chi2 = known.log_chances(one.value), known.chi2(one.value)
                tested.append(_Tested(float(log_p), name, place, float(chi2), dof, float(shift)))
        if tested:
            worst = min(tested, key=lambda one: one.log_p)
            results.append(worst._replace(log_p=worst.log_p + np.log(len(tested)), places=len(tested)))
    return _holm(results)


def _single_spots(fit: JointFit, groups: Sequence[StopGroup], followed: np.ndarray, own_score: np.ndarray) -> _Tested:
    """Test the spot that all others predict worst; its effect on headlines is not computed (`--robust` drops it).

    As `linear_spots.leave_one_out_chi2`, with the fit's coordinates eliminated.
    """
    spots, p = ordered_spots(fit.campaign), len(own_score)
    errors, blocks = [], []
    for group in groups:
        fitted = group.jacobian[:, :p] @ followed
        errors.append((group.residual - fitted @ own_score).reshape(-1, 4))
        left = group.precision - fitted @ group.jacobian[:, :p].T
        blocks += [left[k : k + 4, k : k + 4] for k in range(0, len(left), 4)]
    values, vectors = np.linalg.eigh(np.stack(blocks))
    kept = values > ABSORBED
    along = np.einsum("nij,ni->nj", vectors, np.concatenate(errors))
    distances = np.sum(np.where(kept, along**2 / np.where(kept, values, 1.0), 0.0), axis=1)
    # Without a reading the fourth component is empty.
    dof = np.maximum(kept.sum(axis=1) - ~fit.arrays.read, 1)
    chances = log_chance(distances, dof)
    worst = int(np.argmin(chances))
    return _Tested(
        log_p=float(chances[worst] + np.log(len(spots))),
        name=f"single {fit.campaign.looks} disagree with all others",
        where=f"most of all {fit.campaign.looks[:-1]} {spots[worst].spot}",
        chi2=float(distances[worst]),
        dof=int(dof[worst]),
        shift_sd=0.0,
        places=len(spots),
    )


def _holm(tested: Sequence[_Tested]) -> Validation:
    """Decide all tests together at `VALIDATION_LEVEL`; the defect with the least p is named as the cause."""
    tested = sorted(tested, key=lambda a: a.log_p)
    bad = 0
    while bad < len(tested) and tested[bad].log_p <= np.log(VALIDATION_LEVEL / (len(tested) - bad)):
        bad += 1
    tests = tuple(
        ValidationTest(
            **{name: value for name, value in a._asdict().items() if name != "log_p"},
            p=float(min(1.0, np.exp(a.log_p))),
            failed=rank < bad,
        )
        for rank, a in enumerate(tested)
    )
    cause = f"{tests[0].name}: {tests[0].where}" if bad else ""
    inflation = float(np.hypot(1.0, max((t.shift_sd for t in tests[:bad]), default=0.0)))
    return Validation(bad == 0, VALIDATION_LEVEL, cause, inflation, tests)
