"""Errors that true gears repeat: their distribution over rigs, their place in a campaign, drift between homings.

Degrees and hours. Nothing here imports an estimator's model.
"""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from support.commands import steps

from tvsbayes.instrument.axes import AXES, DIRECTIONS
from tvsbayes.instrument.parameters import Prior
from tvsbayes.instrument.plan import PlanStep
from tvsbayes.instrument.rig import Rig
from tvsbayes.statistics.gaussian_process import matern52
from tvsbayes.twin.gear_errors import PERFECT, AxisErrors, Tabulated, Waves, draw_gear_errors, drift_deg, matern_waves
from tvsbayes.twin.physics import local_deg_per_step, mirror_chain
from tvsbayes.twin.simulated_campaign import draw_home_approach, simulate
from tvsbayes.twin.true_headlines import effective_deg_per_step
from tvsbayes.twin.true_rig import Truth, draw_truth, with_derived

SEEDS = 400
FOUR_SE = 4 / np.sqrt(SEEDS)
"""Four standard errors of a correlation of 0; of an sd they are this over the root of 2."""
SCALES = {
    "transmission_error_deg": 0.05,
    "transmission_error_length_deg": 8.0,
    "play_variation_deg": 0.02,
    "drift_deg_per_root_hour": 0.02,
}


def sweep(pans: tuple[int, ...] = (0, 60, 200, 60, 0, -40, 60)) -> tuple[PlanStep, ...]:
    """One homing, then a look at every counter of pan; tilt goes along half as far."""
    there = (order for pan in pans for order in (("move", pan, pan // 2), ("look",)))
    return steps(("home", 0, 0), ("place", "d1"), ("look",), *there)


def quiet(truth: Truth, **known: float) -> Truth:
    """Without stop errors."""
    still = {f"stop_sd_deg.{direction}": 0.0 for direction in DIRECTIONS}
    return replace(truth, parameters={**truth.parameters, **still, **known})


def one_ratio(truth: Truth) -> Truth:
    """The same ratio in both directions."""
    contrasts = {f"ratio_contrast_deg_per_step.{axis}": 0.0 for axis in AXES}
    return replace(truth, parameters=with_derived({**truth.parameters, **contrasts}))


def geared(rig: Rig, period_deg: dict[str, tuple[float, ...]] | None = None, **scales: float) -> Rig:
    """True rigs with gears of known scales, on a declared rig with these periods."""
    fixed = {f"{name}.{axis}": Prior(value, 0.0) for name, value in {**SCALES, **scales}.items() for axis in AXES}
    table = replace(rig.table, harmonic_period_deg=period_deg or {})
    return replace(rig, table=table, truth={**rig.truth, **fixed})


def test_errors_are_draws_of_a_matern_process():
    """4000 rigs: sd, and correlation at half a length, at one and a half, at two; each error is Gaussian about 0.

    Enough to separate it from one of smoothness 3/2, whose correlation at half a length is less by 0.044.
    """
    count, places = 4000, np.array([3.0, 7.0, 19.0])
    rng = np.random.default_rng(5)
    draws = np.array([matern_waves(0.05, 8.0, rng)(places) for _ in range(count)]) / 0.05
    four_se = 4 / np.sqrt(count)
    assert np.abs(draws.mean(axis=0)).max() < four_se
    assert draws.std(axis=0) == pytest.approx(1.0, abs=four_se / np.sqrt(2))
    correlation = np.corrcoef(draws.T)
    for one, other in ((0, 1), (0, 2), (1, 2)):
        expected = float(matern52(places[other] - places[one], 8.0))
        # The standard error of a correlation coefficient of normals is (1 - rho^2) / sqrt(N).
        assert correlation[one, other] == pytest.approx(expected, abs=four_se * (1 - expected**2))
    assert np.mean(np.abs(draws) < 1.96) == pytest.approx(0.95, abs=4 * np.sqrt(0.95 * 0.05 / count))


def test_periodic_parts_repeat_after_their_period():
    """The sd of each stated period's amplitude, the same again a turn later, minus itself half a turn later."""
    amplitudes = {"harmonic_amplitude_deg.pan.1": 0.1, "harmonic_amplitude_deg.pan.2": 0.03}
    rng = np.random.default_rng(6)
    periods = {"pan": (360.0, 36.0)}
    wheel, pinion = [], []
    for _ in range(SEEDS):
        error = draw_gear_errors(amplitudes, periods, rng)["pan"].error_deg
        at, later, half, next_tooth = error(np.array([10.0, 370.0, 190.0, 28.0]))
        assert later == pytest.approx(at, abs=1e-12)
        # Half a turn of the wheel is five of the pinion: the wheel's part changes its sign, the pinion's stays.
        wheel.append((at - half) / 2)
        pinion.append((at + half) / 2)
        assert next_tooth != at
    assert np.std(wheel) == pytest.approx(0.1, rel=FOUR_SE / np.sqrt(2))
    assert np.std(pinion) == pytest.approx(0.03, rel=FOUR_SE / np.sqrt(2))
    assert draw_gear_errors(amplitudes, {}, rng)["pan"].error_deg(np.array(10.0)) == 0.0, "no period, no part"


def test_play_varies_and_is_never_negative(mounted_rig):
    """Its sd over rigs is that of the parameter; where it would be less than none the gears touch."""
    rng = np.random.default_rng(7)
    places = np.linspace(-20.0, 20.0, 9)
    drawn = [draw_gear_errors({"play_variation_deg.pan": 0.02}, {}, rng)["pan"] for _ in range(SEEDS)]
    wide = np.array([errors.play_at(0.5, places) for errors in drawn])
    assert (wide - 0.5).std() == pytest.approx(0.02, rel=FOUR_SE / np.sqrt(2))
    narrow = np.array([errors.play_at(0.01, places) for errors in drawn])
    assert narrow.min() == 0.0 and narrow == pytest.approx(np.maximum(wide - 0.49, 0.0), abs=1e-15)
    # What a reversal loses is the play of the place: to the left half of it behind, to the right half before.
    rig = geared(mounted_rig, transmission_error_deg=0.0, drift_deg_per_root_hour=0.0)
    truth = one_ratio(quiet(draw_truth(rig, rng)))
    run = simulate(mounted_rig, sweep((100, 60, 100)), 1, truth)
    left, right, left_again = np.array(run.truth.mirror_angles_deg)[1:, 0]
    k, b = truth.parameters["degrees_per_step.pan"], truth.parameters["backlash_deg.pan"]
    play = truth.gear_errors["pan"].play_at(b, k * np.array([60.0, 100.0]))
    assert left == left_again == pytest.approx(100 * k - play[1] / 2, abs=1e-12)
    assert right == pytest.approx(60 * k + play[0] / 2, abs=1e-12)


def test_drift_grows_with_the_root_of_time_and_restarts_at_a_homing():
    """400 walks of four hours, homed after two: variance scale^2 x hours since the homing."""
    time_s = 900.0 * np.arange(17)
    first = np.isin(np.arange(17), (0, 8))
    rng = np.random.default_rng(9)
    walks = np.array([drift_deg(time_s, first, 0.02, rng.standard_normal(17), Waves()) for _ in range(SEEDS)])
    hours = np.where(np.arange(17) < 8, np.arange(17), np.arange(17) - 8) / 4
    assert not walks[:, first].any()
    moving = ~first
    # The variance of a variance of N normals is 2 / N.
    ratio = (walks[:, moving] ** 2).mean(axis=0) / (0.02**2 * hours[moving])
    assert ratio == pytest.approx(1.0, abs=FOUR_SE * np.sqrt(2))
    steps = np.diff(walks, axis=1)[:, :7]
    assert np.abs(np.corrcoef(steps.T) - np.eye(7)).max() < FOUR_SE
    warm = drift_deg(time_s, first, 0.0, np.zeros(17), lambda hours: 0.1 * (1 - np.exp(-hours)))
    assert warm[7] == pytest.approx(0.1 * (1 - np.exp(-1.75)), abs=1e-15)
    assert warm[8] == 0.0 and warm[16] == pytest.approx(0.1 * (np.exp(-2.0) - np.exp(-4.0)), abs=1e-15)


def test_scales_alone_let_a_run_draw_the_errors(mounted_rig):
    """A truth that names scales and no errors gets them from the seed of its run, never perfect gears by silence."""
    truth = draw_truth(geared(mounted_rig), np.random.default_rng(11))
    bare = replace(truth, gear_errors=None)
    one, two = (simulate(mounted_rig, sweep(), seed, bare).truth.gear_errors for seed in (1, 2))
    at = np.linspace(-10.0, 10.0, 5)
    assert (
        np.ptp(one["pan"].error_deg(at)) > 1e-3
        and np.abs(one["pan"].error_deg(at) - two["pan"].error_deg(at)).min() > 0
    )


def test_truth_file_knows_the_errors_at_its_counters(mounted_rig):
    rig = geared(mounted_rig, {"pan": (36.0,)})
    rig = replace(rig, truth={**rig.truth, "harmonic_amplitude_deg.pan.1": Prior(0.1, 0.0)})
    run = simulate(rig, sweep(), 5)
    document = json.loads(json.dumps(run.truth.as_json(run.campaign), allow_nan=False))
    table, k = document["gear_error"]["pan"], run.truth.parameters["degrees_per_step.pan"]
    assert table["steps"] == [-40, 0, 60, 200]
    assert table["error_deg"] == run.truth.gear_errors["pan"].error_deg(k * np.array([-40.0, 0, 60, 200])).tolist()
    again = Truth.from_json(document, rig.stereo)
    assert again.drift_deg == run.truth.drift_deg and again.homing_side == ("left", "up")
    for name in ("error_deg", "play_deg"):
        before, after = (getattr(t.gear_errors["tilt"], name)(0.07 * np.array([-20.0])) for t in (run.truth, again))
        assert after == pytest.approx(before, abs=0.01), "near a counter that is known"
    second = simulate(rig, sweep(), 5, again)
    assert second.truth.mirror_angles_deg == pytest.approx(np.array(run.truth.mirror_angles_deg), abs=1e-12)
    assert again.effective_deg_per_step(run.campaign) == pytest.approx(document["effective_deg_per_step"], rel=1e-12)
    document["gear_error"]["pan"]["error_deg"].pop()
    with pytest.raises(ValueError, match="different lengths"):
        Truth.from_json(document, rig.stereo)
    assert not Tabulated(np.zeros(0), np.zeros(0))(np.array([1.0])).any()


def test_the_headline_is_the_line_through_the_looks(mounted_rig):
    """Two counters: the secant, with the error at both; many: least squares; and the local slope beside it."""
    truth = quiet(draw_truth(mounted_rig, np.random.default_rng(12)))
    p = truth.parameters
    step = AxisErrors(error_deg=lambda angle: 0.1 * (np.asarray(angle) > 3.0))
    errors = {"pan": step, "tilt": AxisErrors()}
    two = simulate(mounted_rig, sweep((100, 0, 100)), 1, replace(truth, gear_errors=errors)).campaign
    plain, bent = (effective_deg_per_step(p, gears, two) for gears in (PERFECT, errors))
    slope = local_deg_per_step(p, (3.0, p["tilt_zero_deg"]))["left"] / p["degrees_per_step.left"]
    # 0.1 deg over 100 steps, by the slope of the mirrors, which changes by less than 1e-3 over 6 deg.
    assert bent["left"] - plain["left"] == pytest.approx(1e-3 * slope, rel=1e-3)
    assert bent["left"] - bent["right"] == pytest.approx(plain["left"] - plain["right"], rel=1e-3)
    assert {d: bent[d] for d in ("up", "down")} == pytest.approx({d: plain[d] for d in ("up", "down")}, rel=1e-5)
    assert list(plain) == list(DIRECTIONS)
    many = simulate(mounted_rig, sweep((20, 40, 60, 80, 100, 120)), 1, truth).campaign
    counters = np.array([0.0, 20, 40, 60, 80, 100, 120])
    tilt_deg = p["degrees_per_step.tilt"] * counters.mean() / 2 + p["tilt_zero_deg"]
    direction = mirror_chain(np.radians(p["degrees_per_step.pan"] * counters), np.radians(tilt_deg), p).direction
    line = np.polyfit(counters, np.degrees(np.arctan2(direction[:, 1], direction[:, 0])), 1)[0]
    slopes = effective_deg_per_step(p, PERFECT, many)
    assert (slopes["left"] + slopes["right"]) / 2 == pytest.approx(line, rel=1e-9)
    contrast = p["ratio_contrast_deg_per_step.pan"] * slope
    assert slopes["left"] - slopes["right"] == pytest.approx(contrast, rel=1e-3)
    ramp = np.polyfit(counters, 0.1 * (p["degrees_per_step.pan"] * counters > 3.0), 1)[0]
    rise = effective_deg_per_step(p, errors, many)["left"] - effective_deg_per_step(p, PERFECT, many)["left"]
    assert rise == pytest.approx(ramp * slope, rel=2e-3)
    still = replace(many, spots=tuple(replace(spot, move=0) for spot in many.spots))
    local = local_deg_per_step(p, (0.0, p["tilt_zero_deg"]))
    assert effective_deg_per_step(p, PERFECT, still) == pytest.approx(local, rel=1e-9), "no line through one counter"
    assert effective_deg_per_step(p, PERFECT, replace(many, spots=())) is None


def test_unrecorded_homing_sides(mounted_rig):
    """The mirrors stand where the true side puts them, and the campaign does not say which."""
    truth = quiet(draw_truth(mounted_rig, np.random.default_rng(13)).with_gears(), **{"backlash_deg.pan": 1.0})
    plan = steps(*[("home", 0, 0)] * 30)
    for side, angle_deg in (("left", -0.5), ("right", 0.5)):
        known, hidden = (
            simulate(mounted_rig, plan, 2, truth, home_approach=(side, "up"), sides_recorded=recorded)
            for recorded in (True, False)
        )
        assert known.truth == hidden.truth
        assert {move.pan_approach for move in known.campaign.moves} == {side}
        assert {(move.pan_approach, move.tilt_approach) for move in hidden.campaign.moves} == {("unknown", "unknown")}
        at = np.array(hidden.truth.mirror_angles_deg)[:, 0] - np.array(hidden.truth.home_offsets_deg)[:, 0]
        assert at == pytest.approx(angle_deg, abs=1e-12) and np.any(hidden.truth.home_offsets_deg)
    drawn = simulate(mounted_rig, plan, 3, truth, home_approach=None, sides_recorded=False)
    assert drawn.truth.homing_side is not None
    rng = np.random.default_rng(14)
    sides = [draw_home_approach(rng) for _ in range(SEEDS)]
    for axis, names in enumerate((("left", "right"), ("up", "down"))):
        for name in names:
            assert np.mean([s[axis] == name for s in sides]) == pytest.approx(0.45, abs=FOUR_SE / 2)
