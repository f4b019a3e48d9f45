"""Errors of gears where nobody looked: against dense Gaussian processes, written out once more."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from tvsbayes.assessment.gear_tables import Process, conditional, drawn_gears
from tvsbayes.calibration.gear_table import GEAR_INPUTS
from tvsbayes.instrument.parameters import INDEX, NAMES, RIG_PRIORS
from tvsbayes.model.gear_processes import GearScales, place_root

AGREEMENT = 1e-8
"""Relative to the sd: a Cholesky factor and a solution of normal equations of condition 1e6."""
DRAWS = 1500
RATIO = {"pan": 0.06, "tilt": -0.07}


def dense(one: np.ndarray, other: np.ndarray, sd: float, length: float, wave: float, period: float) -> np.ndarray:
    """Covariance of a Matern process of smoothness 5/2 and a cosine of random phase (formulation 3.1)."""
    d = np.abs(one[:, None] - other[None, :])
    root = np.sqrt(5) * d / length
    return sd**2 * (1 + root + 5 * d**2 / (3 * length**2)) * np.exp(-root) + wave**2 * np.cos(2 * np.pi * d / period)


@pytest.mark.parametrize("wave", [0.0, 0.03])
def test_a_table_is_the_process_given_its_places(wave):
    """Mean and covariance of one draw at new angles are those of a dense Gaussian process (GPML 2.19)."""
    seen, new = np.array([-9.0, -4.2, 0.0, 1.1, 6.0, 8.5]), np.linspace(-30.0, 30.0, 23)
    values = np.array([0.03, -0.02, 0.05, 0.04, -0.06, -0.01])
    one = Process(np.array([0.05]), np.array([7.0]), np.array([[wave]]), (25.0,))
    floor = 1e-10 * (0.05**2 + wave**2) * np.eye(len(seen))
    own = dense(seen, seen, 0.05, 7.0, wave, 25.0) + floor
    across = dense(new, seen, 0.05, 7.0, wave, 25.0)
    found = conditional(one, seen[None], values[None], new[None], np.zeros((1, len(new))))
    np.testing.assert_allclose(found.expected[0], across @ np.linalg.solve(own, values), atol=AGREEMENT)
    assert np.all(found.left_open == 0)
    # As many equal draws as angles, with unit normals in turn: the factor of what is left open, column by column.
    count = len(new)
    same = Process(*(np.repeat(x, count, axis=0) for x in (one.sd, one.length, one.amplitudes)), one.periods)
    tiled = [np.tile(x, (count, 1)) for x in (seen, values, new)]
    factor = conditional(same, *tiled, np.eye(count)).left_open
    left = dense(new, new, 0.05, 7.0, wave, 25.0) - across @ np.linalg.solve(own, across.T)
    np.testing.assert_allclose(factor.T @ factor, left, atol=0.05 * AGREEMENT)


def fitted(steps: dict[str, list[float]], scales: dict[str, float]):
    """What `drawn_gears` reads of a fit: padded places, their prior's factor, the mode."""
    counters = np.array([*steps["pan"], *steps["tilt"], 0.0, 0.0])
    on_tilt = np.array([*(False for _ in steps["pan"]), *(True for _ in steps["tilt"]), False, False])
    valid = np.arange(len(counters)) < len(counters) - 2
    mode = np.array([RIG_PRIORS[name].value if name in RIG_PRIORS else 0.0 for name in NAMES])
    for axis, ratio in RATIO.items():
        mode[INDEX[f"degrees_per_step.{axis}"]] = ratio
        for block, value in scales.items():
            mode[INDEX[f"{block}.{axis}"]] = value
    rad = np.radians([scales["transmission_error_deg"]] * 2)
    shape = GearScales(
        rad,
        np.radians([scales["transmission_error_length_deg"]] * 2),
        np.radians([scales["play_variation_deg"]] * 2),
        np.zeros(2),
        np.zeros((2, 3)),
        np.full((2, 3), 2 * np.pi),
    )
    angle = np.radians(counters * np.where(on_tilt, RATIO["tilt"], RATIO["pan"]))
    root = np.asarray(place_root(shape, angle, on_tilt, valid, np))
    places = SimpleNamespace(steps=counters, on_tilt=on_tilt, valid=valid)
    fit = SimpleNamespace(
        arrays=SimpleNamespace(gears=SimpleNamespace(places=places)),
        linearised=SimpleNamespace(place_root=root),
        mode=SimpleNamespace(physical=mode),
        campaign=SimpleNamespace(rig=SimpleNamespace(harmonic_period_deg={})),
    )
    return fit, mode, root


SCALES = {"transmission_error_deg": 0.05, "transmission_error_length_deg": 8.0, "play_variation_deg": 0.02}
STEPS = {"pan": [-200.0, -120.0, 0.0, 77.0, 210.0], "tilt": [-90.0, 0.0, 90.0, 140.0]}


@pytest.mark.parametrize("own_scales", [True, False])
def test_tables_hold_what_draws_hold_at_places_and_forget_it_beyond(own_scales):
    """At a place the draw's own value, but for interpolation (1.2 % of the sd); far away the process itself."""
    fit, mode, root = fitted(STEPS, SCALES)
    rng = np.random.default_rng(5)
    errors = rng.standard_normal((DRAWS, len(root))) @ root.T
    found = drawn_gears(fit, np.tile(mode, (DRAWS, 1)), errors, 3, own_scales)
    drawn, half = found.expected + found.left_open, len(root) // 2
    for name in GEAR_INPUTS:
        kind, axis = name.split(".")
        block, first = (
            ("transmission_error_deg", 0) if kind.startswith("transmission") else ("play_variation_deg", half)
        )
        sd, places = (
            SCALES[block],
            first
            + np.flatnonzero(fit.arrays.gears.places.valid & (fit.arrays.gears.places.on_tilt == (axis == "tilt"))),
        )
        counters = np.array(STEPS[axis])
        at = found.table.at(drawn, (counters, counters))[name]
        off = at - np.degrees(errors[:, places])
        assert np.sqrt(np.mean(off**2)) < 0.02 * sd, name
        part = found.table.parts[name]
        nodes = np.array(found.table.steps[axis == "tilt"])
        # Three lengths beyond: 400 steps of pan, and a standard deviation from 1500 draws is known to 2 %.
        reach = 3 * 8.0 / abs(RATIO[axis])
        assert nodes[0] == pytest.approx(counters.min() - reach) and nodes[-1] == pytest.approx(counters.max() + reach)
        for column in (part.start, part.stop - 2, part.stop - 1):
            assert np.std(drawn[:, column]) == pytest.approx(sd, rel=0.08), (name, column)
        assert abs(np.corrcoef(drawn[:, part.stop - 1], drawn[:, part.stop - 2])[0, 1]) < 5 / np.sqrt(DRAWS)
        np.testing.assert_allclose(drawn[:, part.stop - 1].mean(), 0, atol=1e-12)
    # At the scales of the mode the means follow the places as `by_places` says.
    normal = np.linalg.solve(root, errors.T).T
    np.testing.assert_allclose(found.expected, normal @ found.by_places.T, atol=1e-6)


def test_every_draw_has_scales_of_its_own():
    """Draws of twice the sd are twice as open where nobody looked, and their lengths are theirs."""
    fit, mode, root = fitted(STEPS, SCALES)
    rng = np.random.default_rng(6)
    physical = np.tile(mode, (DRAWS, 1))
    large = np.arange(DRAWS) % 2 == 1
    physical[large, INDEX["transmission_error_deg.pan"]] *= 2
    found = drawn_gears(fit, physical, rng.standard_normal((DRAWS, len(root))) @ root.T, 3)
    part = found.table.parts["transmission_error_at_deg.pan"]
    for column in (part.start, part.stop - 1):
        sds = [np.std(found.left_open[rows, column]) for rows in (~large, large)]
        # Each known to 3 %.
        assert sds[1] / sds[0] == pytest.approx(2.0, rel=0.15)


def test_gears_that_do_not_vary_have_no_table():
    found = drawn_gears(SimpleNamespace(), np.zeros((7, len(NAMES))), np.zeros((7, 0)), 0)
    assert found.table.size == 0 and found.expected.shape == found.left_open.shape == (7, 0)
