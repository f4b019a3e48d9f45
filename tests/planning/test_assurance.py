"""What fits will report of drawn rigs: noise scales as they will be estimated, many instruments at once."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.coarse_planning import ROUNDING

from tvsbayes.errors import InputError
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.parameters import CREEP_NAMES, NOISE_NAMES
from tvsbayes.planning.assurance import Assurance, Family, judged_z
from tvsbayes.planning.drawn_rigs import Instruments, draw_instruments
from tvsbayes.planning.expectation import information_of
from tvsbayes.planning.looks import CONTRAST_COLUMNS
from tvsbayes.planning.target import DEFAULT_TARGET, parse_target, sensitivity
from tvsbayes.statistics.optimal_design import covariance_of

pytestmark = [pytest.mark.thorough, pytest.mark.usefixtures("small_searches")]


def believers(knowledge, *z) -> Instruments:
    """Instruments at points of the space that is known."""
    value = np.asarray(knowledge.space.value)
    return Instruments.at(np.array(z), np.broadcast_to(value, (len(z), len(value))), knowledge.space)


@pytest.mark.parametrize(("together", "kept"), [pytest.param(4096, 16, marks=pytest.mark.slow), (1, 2)])
def test_what_is_reported_is_the_whole_plan_judged_at_each_instrument(knowledge, pool, monkeypatch, together, kept):
    """One by one, move by move through the filter: at the true noise for the scales, at these for the covariance.

    In parts of any size, and a design requested later than others.
    """
    monkeypatch.setattr(Assurance, "PAIRS", together)
    monkeypatch.setattr(Assurance, "CACHED", kept)
    picks = np.random.default_rng(4).integers(0, len(pool.looks), 12)
    family = Family(knowledge, pool, np.concatenate([picks, picks]), False)
    target = parse_target(DEFAULT_TARGET)
    drawn = draw_instruments(knowledge, 2, 5)
    drawn.z[:, CONTRAST_COLUMNS] = 0.0
    # Looks count without creep, by the median of its time constant.
    drawn.z[:, [TWO_MIRROR.index[name] for name in CREEP_NAMES]] = 0.0
    assurance = Assurance(family, target, Instruments.at(drawn.z, drawn.value, drawn.common), 5)
    first = assurance.values([2])
    reported = {**first, **assurance.values([6, 2])}
    instruments = assurance.instruments
    for row in range(2):
        instrument, z, space = instruments[np.array([row])], instruments.z[row], instruments.space_of(row)
        seen = assurance.arrays.at(z, space)
        for n in (2, 6):
            steps, chosen = family.arranged(n).steps, assurance.index[: 4 * n]
            exact = information_of(steps, knowledge, z=z, space=space).fisher
            noise = assurance.noise[None, row]
            covariance = covariance_of(knowledge.precision + exact)[None]
            at = judged_z(instrument, seen[None], assurance.looks.side, chosen, covariance, knowledge, noise)[0]
            pose = seen.mirror_angles_rad[assurance.index].mean(axis=0)
            judged = information_of(steps, knowledge, z=at, space=space).fisher
            expected = sensitivity(target, z, space, knowledge.rig.table, pose).value(
                covariance_of(knowledge.precision + judged)
            )
            assert reported[n][row] == pytest.approx(expected, rel=ROUNDING)


def test_instruments_that_miss_the_point_or_see_nothing_report_no_uncertainty(knowledge, pool, monkeypatch):
    """Infinite, and the others as if those were not there."""
    family = Family(knowledge, pool, np.arange(8), False)
    target = parse_target("u(left) <= 1 deg/step")
    instruments = draw_instruments(knowledge, 4, 1)
    every = Assurance(family, target, instruments, 1).values([2])[2]
    poses = []

    def refused(*arguments):
        poses.append(arguments)
        if len(poses) == 2:
            raise InputError("out-of-reach", "no beam")
        return sensitivity(*arguments)

    monkeypatch.setattr("tvsbayes.planning.assurance.sensitivity", refused)
    blind = Assurance(family, target, instruments, 1)
    shown = blind.arrays.at_all

    def closed(z, value, turning):
        seen = shown(z, value, turning)
        seen.seen[3] = False
        return seen

    monkeypatch.setattr(blind.arrays, "at_all", closed)
    values = blind.values([2])[2]
    assert np.isinf(values[[1, 3]]).all() and len(poses) == 3
    assert values[[0, 2]] == pytest.approx(every[[0, 2]], rel=1e-12) and np.isfinite(every).all()


def test_a_noise_scale_is_believed_by_the_weight_of_the_stops(knowledge, pool, seen):
    """Thousands of stops give the true sd; none leave the prior's root mean square; the scatter is 1 / sqrt(2 n)."""
    true = knowledge.z.copy()
    columns = TWO_MIRROR.stop_columns.ravel()
    true[columns] = 1.5
    truth, exact = believers(knowledge, true), np.zeros((1, len(TWO_MIRROR.names), len(TWO_MIRROR.names)))
    many = np.tile(np.arange(len(pool.looks)), 40)

    def scales(chosen, noise):
        noise = np.full((1, 5), noise)
        return judged_z(truth, seen[None], pool.looks.side, chosen, exact, knowledge, noise)[0, columns]

    assert scales(many, 0.0) == pytest.approx(1.5, abs=0.01)
    one = scales(many[:1], 0.0)
    assert (np.abs(one) < 1.5).all()
    # E s^2 of a log-normal with sd u of ln s is exp(2 u^2) times the square of its median: its root lies at z = u.
    unseen = ~np.isin(columns, TWO_MIRROR.stop_columns[np.arange(2), (pool.looks.side[many[0]] > 0).astype(int)])
    np.testing.assert_allclose(one[unseen], np.asarray(knowledge.space.u)[columns][unseen], rtol=1e-12)
    per_direction = len(many) / 2
    # Stops of 0.18 deg against pixels: what pixels leave open lowers the information by a few per cent.
    assert scales(many, 1.0) - scales(many, 0.0) == pytest.approx(1 / math.sqrt(2 * per_direction), rel=0.1)


def test_what_the_geometry_takes_from_the_stops_is_not_left_for_their_scatter(knowledge, pool, seen):
    """Less p for n: with every geometric coordinate determined by L looks, 1 - p / (2 L) of the information is left."""
    columns = TWO_MIRROR.stop_columns.ravel()
    true = knowledge.z.copy()
    true[columns] = 1.5
    truth = believers(knowledge, true)
    chosen = np.resize(np.arange(len(pool.looks)), 60)

    def scatter(covariance):
        low, high = (
            judged_z(truth, seen[None], pool.looks.side, chosen, covariance[None], knowledge, np.full((1, 5), x))
            for x in (0.0, 1.0)
        )
        return (high - low)[0, columns]

    exact = np.zeros((len(TWO_MIRROR.names), len(TWO_MIRROR.names)))
    geometry = ~np.isin(TWO_MIRROR.names, NOISE_NAMES) & (np.arange(len(TWO_MIRROR.names)) < len(TWO_MIRROR.rig_names))
    # No information is gained where the covariance is the prior's; a precision of 0 is a coordinate held fixed.
    precision = np.diag(knowledge.precision)
    unknown = np.diag(np.divide(1.0, precision, out=np.zeros(len(TWO_MIRROR.names)), where=precision > 0))
    left_over = 1 - np.sum(geometry & (precision > 0)) / (2 * seen.seen[chosen].sum())
    # Scatter is 1 / sqrt(information) but for the prior, which 30 stops of a direction outweigh 50 times.
    assert scatter(exact) / scatter(unknown) == pytest.approx(1 / math.sqrt(left_over), rel=0.03)
