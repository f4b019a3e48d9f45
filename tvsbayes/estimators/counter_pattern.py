"""Tests of counters against spots: the wrong sign, steps of each move, columns exchanged, rows shifted.

Spots move across when a counter grows. Their angles across and up, deg, are regressed on the counters, steps, and the
sheet's distance. The axes are those of frame P as far as the campaign states them. A counter is tested only where its
spread is large against the play and scatter that the priors allow; a smaller motion need not be visible. The limits are
far from the values of correct campaigns (experiments/robustness/mistakes.md). No JAX.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from tvsbayes.estimators.findings import Finding, line_of, mending_command
from tvsbayes.estimators.spot_pattern import SPOTS_MIN, SpotPattern, sheet_groups
from tvsbayes.instrument.axes import AXES, SENSES, Axis
from tvsbayes.instrument.campaign import Campaign
from tvsbayes.instrument.parameters import Prior, names_of
from tvsbayes.instrument.stereo_pair import rotation_matrix

PRIOR_SDS = 3.0
"""Standard uncertainties of a prior up to which play, scatter and the cameras' mounting are considered possible."""
EXPECTED = 3.0
"""Least ratio of a counter's spread to the motion possible by play and scatter; a correct one then explains 0.9."""
UNEXPLAINED = 1.5
"""Least ratio of unexplained motion to that of play and scatter for other rows to be tried."""
FOLLOWED, LOST = 0.8, 0.5
"""Share of the motion that a correct counter explains at least (correct campaigns: 0.94), a wrong one at most."""
LEAST_SLOPE = 0.3
"""Negative slope, as a share of the stated ratio, from which a counter has the wrong sign."""
BETTER = 3.0
"""Factor by which the unexplained motion must fall with corrected counters: sums of steps, or counters of the row
before or after."""
STOPS_FREE_MIN, STOPS_CERTAIN, STOPS_MANY = 4, 8, 30
"""Stops beyond the coefficients of a line from which a pattern counts, is certain, and cannot be chance even within
play and scatter."""
CERTAIN = 9.0
"""`BETTER` for certainty that rows are shifted."""
OTHER = dict(zip(AXES, reversed(AXES), strict=True))
"""The other axis, by axis."""
LOOKS_TRIED, BEGINS_TRIED = 2000, 64
"""Evenly spread looks by which rows are compared with their neighbours, and how many of them are tried as the first
shifted one before those around the best."""


@dataclass(frozen=True)
class _Seen:
    """Looks prepared for the comparison with counters.

    Attributes:
        pattern: spots of the campaign.
        at: (n,) move of every look.
        angles_deg: across (left) and up of every look, (n,) by axis.
        nearness: (n,) mean distance of all sheets over that of the sheet.
        counters: steps of all moves by axis.
        hidden_deg: motion that play and scatter may hide, by axis.
        ratios: degrees per step as stated, by axis.
    """

    pattern: SpotPattern
    at: np.ndarray
    angles_deg: Mapping[Axis, np.ndarray]
    nearness: np.ndarray
    counters: Mapping[Axis, np.ndarray]
    hidden_deg: Mapping[Axis, float]
    ratios: Mapping[Axis, float]

    @property
    def campaign(self) -> Campaign:
        """Return the campaign of the looks."""
        return self.pattern.campaign


@dataclass(frozen=True)
class _Followed:
    """Result of explaining a motion by a counter.

    Attributes:
        share: explained share of the motion that other columns leave.
        slope: deg per step at the mean distance.
        left_deg: root mean square of the residual motion.
        spread_steps: standard deviation of the counter given the other columns.
        stops_free: stops beyond the coefficients.
    """

    share: float
    slope: float
    left_deg: float
    spread_steps: float
    stops_free: int

    @property
    def follows(self) -> bool:
        """Whether this counter explains the motion, with either sign."""
        return self.share > FOLLOWED


class _LeastSquares(NamedTuple):
    """Coefficients, residuals and rank of a design."""

    coefficients: np.ndarray
    residuals: np.ndarray
    rank: int


def _solved(design: np.ndarray, values: np.ndarray) -> _LeastSquares:
    scale = np.maximum(np.abs(design).max(axis=0), 1e-12)
    solution, _, rank, _ = np.linalg.lstsq(design / scale, values, rcond=1e-9)
    return _LeastSquares((solution.T / scale).T, values - (design / scale) @ solution, int(rank))


def _columns(nearness: np.ndarray, *counters: np.ndarray) -> np.ndarray:
    """Build a line in counters whose constant and slopes vary with distance: beams do not start at the cameras."""
    products = [part for steps in (np.ones_like(nearness), *counters) for part in (steps, steps * nearness)]
    return np.column_stack(products)


def _followed(pattern: _Seen, axis: Axis, steps: np.ndarray, other: np.ndarray) -> _Followed:
    """Fit a line in the counter, given another counter."""
    base = _columns(pattern.nearness, other)
    full = np.column_stack((base, steps, steps * pattern.nearness))
    before, rest = _solved(base, pattern.angles_deg[axis]).residuals, _solved(base, steps).residuals
    solution, after, rank = _solved(full, pattern.angles_deg[axis])
    motion = float(before @ before)
    return _Followed(
        share=1 - float(after @ after) / motion if motion > 0 else 0.0,
        slope=float(solution[-2] + solution[-1] * pattern.nearness.mean()),
        left_deg=float(np.sqrt(np.mean(after**2))),
        spread_steps=float(np.sqrt(np.mean(rest**2))),
        stops_free=len(np.unique(pattern.at)) - rank,
    )


def hidden_deg(priors: Mapping[str, Prior], axis: Axis) -> float:
    """Compute the motion of the beam, deg, not due to counters: half the play, scatter of stops, errors of gears."""

    def highest(name: str) -> float:
        prior = priors[name]
        if prior.distribution == "log-normal":
            return prior.value * math.exp(PRIOR_SDS / 2 * prior.u)
        return abs(prior.value) + PRIOR_SDS * prior.u

    parts = [highest(f"backlash_deg.{axis}") / 2, highest(f"transmission_error_deg.{axis}")]
    parts.append(max(highest(f"stop_sd_deg.{direction}") for direction in SENSES[axis]))
    return math.hypot(*parts)


def _seen(pattern: SpotPattern) -> _Seen:
    campaign = pattern.campaign
    priors = campaign.rig.priors
    turned = rotation_matrix(np.array([priors[name].value for name in names_of("extrinsics.rotation_rad")]))
    # Rotated to the axes of frame P, as far as the campaign states them: columns X depth, Y left, Z up.
    depth_mm, *across_mm = (pattern.points_mm @ turned).T
    group = sheet_groups(pattern.points_mm[:, 0])
    # Depth of the sheet, not of the spot: on an oblique sheet depth varies across, as a counter does.
    sheet_mm = np.array([depth_mm[group == g].mean() for g in range(group.max() + 1)])[group]
    angles_deg = {axis: np.degrees(np.arctan2(across, depth_mm)) for axis, across in zip(AXES, across_mm, strict=True)}
    return _Seen(
        pattern,
        np.array([spot.move for spot in pattern.spots]),
        angles_deg,
        sheet_mm.mean() / sheet_mm,
        {axis: np.array([getattr(m, f"{axis}_steps") for m in campaign.moves], float) for axis in AXES},
        {axis: hidden_deg(priors, axis) for axis in AXES},
        {axis: abs(priors[f"degrees_per_step.{axis}"].value) for axis in AXES},
    )


def counter_findings(pattern: SpotPattern) -> list[Finding]:
    """Find counters that are steps of a move, have the wrong sign, or belong to the other axis or to other spots."""
    seen = _seen(pattern)
    table = {axis: steps[seen.at] for axis, steps in seen.counters.items()}
    summed = {axis: _summed(seen.campaign, axis)[seen.at] for axis in AXES}
    followed: dict[Axis, _Followed] = {}
    crossed: dict[Axis, _Followed] = {}
    added: dict[Axis, _Followed] = {}
    for axis in AXES:
        other = table[OTHER[axis]]
        followed[axis] = _followed(seen, axis, table[axis], other)
        crossed[axis] = _followed(seen, axis, other, table[axis])
        added[axis] = _followed(seen, axis, summed[axis], summed[OTHER[axis]])
    enough = [axis for axis in AXES if followed[axis].stops_free >= STOPS_FREE_MIN]
    expected = [
        axis for axis in enough if followed[axis].spread_steps * seen.ratios[axis] > EXPECTED * seen.hidden_deg[axis]
    ]
    if len(expected) == 2 and all(followed[axis].share < LOST and crossed[axis].follows for axis in AXES):
        message = "spots move across with the tilt counter and up with the pan counter: are both columns exchanged?"
        return [Finding("columns-exchanged", message, file="moves.csv")]
    steps = [axis for axis in enough if _are_steps(seen, axis, followed[axis], added[axis])]
    if steps:
        return [_steps_finding(seen, steps, followed)]
    if enough and (shifted := _row_finding(seen)) is not None:
        return [shifted]
    signs = [axis for axis in expected if _runs_back(seen, axis, followed[axis])]
    findings = [_sign_finding(seen, signs, followed)] if signs else []
    return findings + [
        Finding(
            "counter-lost",
            f"spots do not follow {axis}_steps: rows of moves.csv and spots.csv shifted, or counters of another run?",
            file="moves.csv",
        )
        for axis in expected
        if followed[axis].share < LOST
    ]


def _runs_back(seen: _Seen, axis: Axis, followed: _Followed) -> bool:
    """Whether spots move against a counter, with cameras that cannot be upside down."""
    roll = seen.campaign.rig.priors["extrinsics.rotation_rad.x"]
    mounted = PRIOR_SDS * roll.u < np.pi / 2
    return mounted and followed.follows and followed.slope < -LEAST_SLOPE * seen.ratios[axis]


def _are_steps(seen: _Seen, axis: Axis, followed: _Followed, added: _Followed) -> bool:
    """Whether the cells of a counter are the steps of each move."""
    # A motion within play and scatter is explained by sums of a few counters by chance.
    decided = followed.stops_free >= STOPS_MANY or followed.left_deg > UNEXPLAINED * seen.hidden_deg[axis]
    return decided and added.follows and followed.left_deg**2 > BETTER * added.left_deg**2


def _steps_finding(seen: _Seen, axes: list[Axis], followed: Mapping[Axis, _Followed]) -> Finding:
    names = " and ".join(f"{axis}_steps" for axis in axes)
    remedy = f"moves.csv holds absolute counters AFTER the move: {mending_command(seen.campaign, '--relative')}"
    return Finding(
        "relative-counters",
        f"spots follow the sum of {names}, not {names}: are these the steps of each move?",
        remedy,
        certain=any(
            followed[axis].stops_free >= STOPS_CERTAIN and followed[axis].left_deg > UNEXPLAINED * seen.hidden_deg[axis]
            for axis in axes
        ),
        file="moves.csv",
    )


def _sign_finding(seen: _Seen, axes: list[Axis], followed: Mapping[Axis, _Followed]) -> Finding:
    """Describe counters of the wrong sign, and a shift of rows by one where that has the same effect."""
    parts, pair = [], (0, 0)
    for axis in axes:
        positive, negative = SENSES[axis]
        # The two consecutive looks between which the counter changed most serve as example.
        steps = seen.counters[axis][seen.at]
        first = int(np.argmax(np.abs(np.diff(steps))))
        pair = first, first + 1
        spots, moved = [seen.pattern.spots[k] for k in pair], float(np.diff(seen.angles_deg[axis])[first])
        where = f"spot {spots[0].spot} at {steps[pair[0]]:.0f}, spot {spots[1].spot} at {steps[pair[1]]:.0f}"
        parts.append(
            f"spots move {negative} while {axis}_steps grows ({where}: {abs(moved):.1f} deg "
            f"{positive if moved > 0 else negative}); {positive} counts up"
        )
    options = " ".join(f"--flip {axis}_steps" for axis in axes)
    remedy = f"write the other sign: {mending_command(seen.campaign, options)}"
    if len(axes) == len(AXES):
        remedy += ", or state in [rig.prior] extrinsics.rotation_rad that the cameras hang upside down"
    lags = [lag for lag in (1, -1) if _shift_shows_the_same(seen, axes, lag)]
    remedy += "".join(
        "; on an axis that moves to and fro, rows shifted by one have the same effect, then "
        + mending_command(seen.campaign, f"--shift-moves {lag}")
        for lag in lags[:1]
    )
    return Finding(
        "counter-sign",
        "; ".join(parts),
        remedy,
        certain=min(followed[axis].stops_free for axis in axes) >= STOPS_CERTAIN,
        file="moves.csv",
        line=line_of(seen.pattern.spots[pair[1]].move),
    )


def _shift_shows_the_same(seen: _Seen, axes: list[Axis], lag: int) -> bool:
    """Whether counters of the neighbouring row explain the motion as well, with the correct sign."""
    last = len(seen.campaign.moves) - 1
    at = np.clip(seen.at + lag, 0, last)
    for axis in axes:
        beside = _followed(seen, axis, seen.counters[axis][at], seen.counters[OTHER[axis]][at])
        if not beside.follows or beside.slope < 0:
            return False
    return True


def _row_finding(seen: _Seen) -> Finding | None:
    """Find spots that belong to the moves next to theirs, all or from one on: different numbering, or a missing row."""
    spots = seen.pattern.spots
    chosen = np.unique(np.linspace(0, len(spots) - 1, LOOKS_TRIED).astype(int))
    at, nearness = seen.at[chosen], seen.nearness[chosen]
    table = np.column_stack([seen.counters[axis] for axis in AXES])
    motion_deg = np.column_stack([seen.angles_deg[axis][chosen] for axis in AXES])

    def left(steps: np.ndarray) -> np.ndarray:
        """Compute the variance of both motions that counters (n, 2) leave unexplained, deg^2."""
        return np.mean(_solved(_columns(nearness, *steps.T), motion_deg).residuals ** 2, axis=0)

    def beside(lag: int, begin: int) -> np.ndarray:
        moved = at + lag * (np.arange(len(at)) >= begin)
        return left(table[np.clip(moved, 0, len(table) - 1)])

    unmoved, motion = left(table[at]), left(np.zeros((len(at), 2)))
    hidden = np.array([seen.hidden_deg[axis] for axis in AXES])
    if np.all(unmoved < (UNEXPLAINED * hidden) ** 2):
        return None

    def rest(lag: int, begin: int) -> float:
        return float(beside(lag, begin).sum())

    last = len(at) - SPOTS_MIN
    tried = np.unique(np.linspace(0, last, BEGINS_TRIED).astype(int)).tolist()
    rows = []
    for lag in (-1, 1):
        near = min(tried, key=partial(rest, lag))
        around = range(max(near - last // BEGINS_TRIED, 0), min(near + last // BEGINS_TRIED, last) + 1)
        begin = min(around, key=partial(rest, lag))
        rows.append((rest(lag, begin), lag, begin))
    least, lag, begin = min(rows)
    if unmoved.sum() <= BETTER * least or least > (1 - FOLLOWED) * motion.sum():
        return None
    free = len(np.unique(at)) - np.linalg.matrix_rank(_columns(nearness, *table[at].T))
    first = spots[int(chosen[begin])]
    which = "spots" if begin == 0 else f"from spot {first.spot} on, spots"
    row = seen.campaign.spots.index(first)
    option = f"--shift-moves {lag:d}" + f"@{first.spot}" * (begin > 0)
    return Finding(
        "rows-shifted",
        f"{which} follow the counters of the move {'after' if lag > 0 else 'before'} theirs, not of the one that "
        f"spots.csv names (spot {first.spot}: move {first.move}): do pictures or rows count from 1, or is a row of "
        "moves.csv missing or one too many?",
        f"{'add 1 to' if lag > 0 else 'take 1 from'} their column move: {mending_command(seen.campaign, option)}",
        certain=bool(unmoved.sum() > CERTAIN * least and free >= STOPS_CERTAIN),
        file="spots.csv",
        line=line_of(row),
    )


def _summed(campaign: Campaign, axis: Axis) -> np.ndarray:
    """Sum the counters of an axis within each segment."""
    total, before, sums = 0, -1, []
    for move in campaign.moves:
        total = (total if move.segment == before else 0) + getattr(move, f"{axis}_steps")
        before = move.segment
        sums.append(total)
    return np.array(sums, dtype=float)
