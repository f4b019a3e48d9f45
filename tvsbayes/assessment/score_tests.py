"""Validation of the residuals: score tests of defects that the model leaves out.

Residuals are whitened by the pixel noise, four components a spot (range projected out; the last is empty without a
reading); coordinates are in sds of their priors. Counters in steps, angles in degrees.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tvsbayes.assessment.residuals import CAUSE_BINS, STEP_PHASES
from tvsbayes.assessment.weaknesses import headline_gradients, judged_headlines, moved_directions
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.estimators.linear_spots import StopGroup, linear_spots, stop_information
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.campaign import ordered_spots
from tvsbayes.instrument.parameters import CREEP_NAMES, INDEX, NAMES, RIG_NAMES, STEREO_PARAMETER_NAMES, names_of
from tvsbayes.instrument.stops import rests_of
from tvsbayes.results.estimates import Validation, ValidationTest
from tvsbayes.statistics.chances import log_chance

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
BY_PRIOR = np.isin(NAMES, CREEP_NAMES)
"""Coordinates known by their priors, as errors of stops are: creeps of any size would absorb what changes in time."""
_POSE = names_of("extrinsics.rotation_rad", "extrinsics.translation_mm")


@dataclass(frozen=True)
class _Defect:
    """A defect: columns d(prediction)/d(size of the defect), shape (spots, 4, q), for each of its `places`."""

    name: str
    places: tuple[str, ...]
    columns: tuple[np.ndarray, ...]


def _times(columns: np.ndarray, pattern: np.ndarray) -> np.ndarray:
    """Scale columns (spots, 4, q) by a pattern (spots,), the amount of the defect at each spot."""
    return columns * pattern[:, None, None]


@dataclass(frozen=True)
class _SeenAxis:
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
    readings = -jacobian[:, :, INDEX["aperture_zero_deg"]]
    # Without a reading the last of the four components is empty.
    readings = np.where(np.any(readings, axis=1, keepdims=True), readings, np.eye(4)[3])
    slopes = np.concatenate([slope.transpose(0, 2, 1), readings[:, None]], axis=1)
    normal = np.linalg.svd(slopes)[2][:, -1]
    row = np.linalg.pinv(np.asarray(fit.space.stereo_root))[:, STEREO_PARAMETER_NAMES.index("stereo.right.cy")]
    shift = -jacobian[:, :, len(RIG_NAMES) :] @ row
    shift = normal * np.sum(normal * shift, axis=1, keepdims=True)
    place = np.asarray(fit.linearised.predicted)[:, :2]
    spread = place.std(axis=0)
    place = (place - place.mean(axis=0)) / np.where(spread > 0, spread, 1.0)
    return shift[:, :, None] * np.concatenate([np.ones((len(place), 1)), place], axis=1)[:, None, :]


def _defects_in_time(fit: JointFit, axes: Sequence[_SeenAxis]) -> list[_Defect]:
    """Build defects of motion, drift or slip during the campaign."""
    spots, moves = ordered_spots(fit.campaign), fit.campaign.moves
    order = np.arange(len(spots))
    time = np.array([moves[spot.move].time_s for spot in spots])
    # Without times the order is used.
    time = order if np.ptp(time) == 0 else time
    drift = (time - time.mean()) / max(np.ptp(time), 1)
    segment = np.array([moves[spot.move].segment for spot in spots])
    jacobian, pose = np.asarray(fit.linearised.residual_jacobian), [INDEX[name] for name in _POSE]
    cameras, warmed = -jacobian[:, :, pose], -jacobian[:, :, [*pose, INDEX["focal_scale"]]]
    apart = _epipolar(fit)

    def rows(count: int) -> np.ndarray:
        edges = np.unique(np.linspace(0, len(spots), count + 2)[1:-1].astype(int))
        return edges[edges > 0]

    def since(row: int) -> np.ndarray:
        return (order >= row).astype(float)

    def place(row: int) -> str:
        return f"from {fit.campaign.looks[:-1]} {spots[row].spot} on (move {spots[row].move})"

    few, many = rows(CHANGE_POINTS), rows(2 * CHANGE_POINTS)
    places = tuple(map(place, few))
    slips = tuple((axis, row) for axis in axes for row in many)
    return [
        _Defect("the cameras moved", places, tuple(_times(cameras, since(row)) for row in few)),
        _Defect("the cameras drifted (pose or focal length)", ("with time",), (_times(warmed, drift),)),
        _Defect(
            "one camera moved against the other (epipolar)",
            ("with time", *places),
            (_times(apart, drift), *(_times(apart, since(row)) for row in few)),
        ),
        _Defect(
            "a ratio drifted",
            tuple(f"{axis.name}, with time" for axis in axes),
            tuple(_times(axis.push, drift * (axis.angle_deg - axis.angle_deg.mean())) for axis in axes),
        ),
        _Defect(
            "steps were lost, or a joint slipped",
            tuple(f"{axis.name} {place(row)}" for axis, row in slips),
            # A homing restores the zero.
            tuple(_times(axis.push, since(row) * (segment == segment[row])) for axis, row in slips),
        ),
    ]


def _defects_in_place(fit: JointFit, axes: Sequence[_SeenAxis]) -> list[_Defect]:
    """Build defects that depend on position, approach, or sheet."""
    targets = np.array([spot.target for spot in ordered_spots(fit.campaign)])
    places, waves = [], []
    for axis in axes:
        stops = len(np.unique(axis.counter))
        # Any wave fits three stops; a search that failed may end where an axis does not turn.
        reach = 2 * float(np.ptp(axis.angle_deg)) if stops > 3 else 0.0
        periods = reach / np.arange(1, min(WAVES, 2 * stops) + 1) if reach else ()
        for period in [*periods, *fit.campaign.rig.harmonic_period_deg.get(axis.name, ())]:
            phase = 2 * np.pi * axis.angle_deg / period
            waves.append(np.concatenate([_times(axis.push, np.cos(phase)), _times(axis.push, np.sin(phase))], axis=2))
            places.append(f"{axis.name}, period near {period:.3g} deg")

    def by_group(name: str, groups: Sequence[np.ndarray]) -> _Defect:
        columns = [
            np.concatenate([_times(axis.push, (group == value).astype(float)) for value in np.unique(group)], axis=2)
            for axis, group in zip(axes, groups, strict=True)
        ]
        return _Defect(name, tuple(axis.name for axis in axes), tuple(columns))

    edges = [np.unique(np.quantile(axis.leg_steps, np.linspace(0, 1, CAUSE_BINS + 1)[1:-1])) for axis in axes]
    return [
        _Defect("the gears have a transmission error", tuple(places), tuple(waves)),
        by_group(f"stops depend on the step phase (n mod {STEP_PHASES})", [a.counter % STEP_PHASES for a in axes]),
        by_group(
            "stops depend on the length of the move",
            [np.digitize(axis.leg_steps, edge) for axis, edge in zip(axes, edges, strict=True)],
        ),
        by_group("the sheets disagree", [targets, targets]),
    ]


@dataclass(frozen=True)
class _Tested:
    """A test before the joint decision; `log_p`, since p of chi-squares of hundreds underflows."""

    log_p: float
    name: str
    where: str
    chi2: float
    dof: int
    shift_sd: float
    places: int = 1


@dataclass(frozen=True)
class _Scores:
    """Scores of all columns, each scaled to unit information, with the fit's coordinates eliminated.

    Attributes:
        score: shape (q,).
        variance: shape (q, q).
        moved_by: shift of every headline by a defect of unit size, in its sds, shape (headlines, q).
    """

    score: np.ndarray
    variance: np.ndarray
    moved_by: np.ndarray

    def test(self, name: str, place: str, rows: slice) -> _Tested | None:
        """Test some columns; None where the fit can absorb them entirely."""
        values, vectors = np.linalg.eigh(self.variance[rows, rows])
        kept = values > ABSORBED
        if not kept.any():
            return None
        along = vectors[:, kept].T @ self.score[rows]
        chi2, dof = float(np.sum(along**2 / values[kept])), int(kept.sum())
        size = (vectors[:, kept] / values[kept]) @ along
        shift = float(np.max(np.abs(self.moved_by[:, rows] @ size)))
        return _Tested(float(log_chance(chi2, dof)), name, place, chi2, dof, shift)


@dataclass(frozen=True)
class _Common:
    """Arrays common to all tests.

    Attributes:
        groups: stops of the campaign; the first p columns of their Jacobians are the fit's own, then the defects'.
        own_score: remaining score of the fit's own columns, shape (p,).
        followed: inverse information of the directions that the fit can absorb, shape (p, p).
        scores: scores of the defects' columns.
    """

    groups: Sequence[StopGroup]
    own_score: np.ndarray
    followed: np.ndarray
    scores: _Scores


def _common(fit: JointFit, defects: Sequence[_Defect]) -> _Common:
    columns_of_fit = fit.linearised.by_coordinates(fit.held)
    columns_of_all = np.concatenate(
        [columns_of_fit, *(columns for defect in defects for columns in defect.columns)], axis=2
    )
    information = stop_information(linear_spots(fit.linearised, fit.arrays, columns_of_all))
    score = information.score(columns_of_all)
    p = columns_of_fit.shape[2]
    cross, own_score = information.fisher[:p, p:], score[:p] - BY_PRIOR * fit.z
    values, vectors = np.linalg.eigh(information.fisher[:p, :p] + np.diag(BY_PRIOR))
    kept = values > KNOWN_DIRECTION
    inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T
    followed = inverse @ cross
    whole = np.diag(information.fisher)[p:]
    scale = 1 / np.sqrt(np.where(whole > 0, whole, 1.0))
    gradient = headline_gradients(fit, judged_headlines(fit, moved_directions(fit)))
    sd = np.sqrt(np.einsum("qi,ij,qj->q", gradient, fit.covariance, gradient))
    scores = _Scores(
        score=(score[p:] - followed.T @ own_score) * scale,
        variance=(information.fisher[p:, p:] - cross.T @ followed) * np.outer(scale, scale),
        moved_by=gradient @ fit.covariance @ cross * scale / sd[:, None],
    )
    return _Common(information.groups, own_score, inverse, scores)


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
    defects = [*_defects_in_time(fit, axes), *_defects_in_place(fit, axes)]
    common = _common(fit, defects)
    results = [_single_spots(fit, common)]
    start = 0
    for defect in defects:
        tested = []
        for place, columns in zip(defect.places, defect.columns, strict=True):
            rows = slice(start, start + columns.shape[2])
            start = rows.stop
            one = common.scores.test(defect.name, place, rows)
            if one is not None:
                tested.append(one)
        if tested:
            worst = min(tested, key=lambda a: a.log_p)
            results.append(replace(worst, log_p=worst.log_p + np.log(len(tested)), places=len(tested)))
    return _holm(results)


def _single_spots(fit: JointFit, common: _Common) -> _Tested:
    """Test the spot that all others predict worst; its effect on headlines is not computed (`--robust` drops it).

    As `linear_spots.leave_one_out_chi2`, with the fit's coordinates eliminated.
    """
    spots = ordered_spots(fit.campaign)
    p, shift = len(common.own_score), common.followed @ common.own_score
    errors = np.concatenate([(g.residual - g.jacobian[:, :p] @ shift).reshape(-1, 4) for g in common.groups])
    blocks = []
    for group in common.groups:
        fitted = group.jacobian[:, :p]
        left = group.precision - fitted @ common.followed @ fitted.T
        blocks += [left[k : k + 4, k : k + 4] for k in range(0, len(left), 4)]
    values, vectors = np.linalg.eigh(np.stack(blocks))
    kept = values > ABSORBED
    along = np.einsum("nij,ni->nj", vectors, errors)
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
            name=a.name,
            where=a.where,
            chi2=a.chi2,
            dof=a.dof,
            places=a.places,
            p=float(min(1.0, np.exp(a.log_p))),
            failed=rank < bad,
            shift_sd=a.shift_sd,
        )
        for rank, a in enumerate(tested)
    )
    cause = f"{tests[0].name}: {tests[0].where}" if bad else ""
    inflation = float(np.hypot(1.0, max((t.shift_sd for t in tests[:bad]), default=0.0)))
    return Validation(bad == 0, VALIDATION_LEVEL, cause, inflation, tests)
