"""The summary of a fit: headlines, contraction, weak directions, leverage, the classic predicted."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import equinox as eqx
import numpy as np
import pytest

from tvsbayes.assessment.summary import CLASSIC_DRAWS, _classic_predicted, summarise, worth_sampling
from tvsbayes.estimators.four_point import classic, experiment_rows, four_point_ratios, select_experiments
from tvsbayes.estimators.joint_fit import Alternative, fit
from tvsbayes.instrument.campaign import Campaign
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.model_choice import ModelChoice
from tvsbayes.instrument.parameters import (
    CREEP_NAMES,
    GEAR_ERROR_NAMES,
    HARMONIC_NAMES,
    HOME_SD_NAMES,
    RECEIVER_NAMES,
    Prior,
    names_of,
)
from tvsbayes.instrument.plan import PlanStep
from tvsbayes.instrument.protocols import four_point_protocol, paper_protocol
from tvsbayes.pipeline import unusable
from tvsbayes.report.fit_text import fit_text
from tvsbayes.results.estimates import CONTRACTION_LIMIT, FitSummary
from tvsbayes.statistics.intervals import interval95
from tvsbayes.twin.simulated_campaign import simulate


@pytest.fixture(scope="module")
def paper(mounted_rig) -> Campaign:
    """The paper's go-and-return protocol: one |N|, the first start is the homing itself.

    Two moves without a look at the end make it as long as the shipped twin, for which the model is compiled.
    """
    steps = paper_protocol()
    unseen = (PlanStep(len(steps) + k, "move", 100 * k, 0) for k in range(2))
    return simulate(mounted_rig, (*steps, *unseen), seed=8).campaign


@pytest.fixture(scope="module")
def short(mounted_rig) -> Campaign:
    """A quarter of it."""
    return simulate(mounted_rig, paper_protocol(repeats=6), seed=8).campaign


@pytest.fixture(scope="module")
def fitted(paper):
    return fit(paper)


@pytest.fixture(scope="module")
def summary(fitted) -> FitSummary:
    return summarise(fitted)


def test_every_parameter_of_the_contract_is_there_and_only_those(fitted, summary):
    optional = (*HARMONIC_NAMES, *GEAR_ERROR_NAMES, *CREEP_NAMES, *names_of("thermal_deg_per_K"), *HOME_SD_NAMES)
    absent = {name for name in optional if not fitted.free[TWO_MIRROR.index[name]]}
    expected = set(TWO_MIRROR.names) - set(RECEIVER_NAMES) - absent
    expected |= {f"degrees_per_step.{d}" for d in ("left", "right", "up", "down")} | {"effective_mirror_offset_mm"}
    assert set(summary.parameters) == expected


def test_intervals_hold_their_value_and_match_their_sd(summary):
    for name, estimate in summary.parameters.items():
        low, high = estimate.interval95
        assert low <= estimate.value <= high, name
        if name.startswith(("extrinsics", "stereo", "degrees_per_step")):
            # Linear in Gaussian coordinates: 2 x 1.96 sd. Derived ones come from 2048 draws (3 % of an end).
            assert high - low == pytest.approx(2 * 1.96 * estimate.sd, rel=0.1), name
        if name.startswith("backlash_deg"):
            assert low > 0, name


@pytest.mark.thorough
def test_intervals_of_several_ways_of_homing_are_those_of_their_sds(fitted, summary):
    """Two ways whose backlashes lie five sds apart: no interval is the first way's alone."""
    name = "backlash_deg.pan"
    apart, physical = 5 * summary.parameters[name].sd, np.array(fitted.draws.physical)
    physical[:, TWO_MIRROR.index[name]] += apart
    other = replace(fitted, draws=eqx.tree_at(lambda d: d.physical, fitted.draws, physical))
    ways = Alternative({"pan": "left"}, 0.6, fitted), Alternative({"pan": "right"}, 0.4, other)
    alone, both = summary.parameters, summarise(replace(fitted, alternatives=ways)).parameters
    # Of a mixture: the mean of the variances and p (1 - p) times the squared distance.
    assert both[name].sd == pytest.approx(np.hypot(alone[name].sd, np.sqrt(0.24) * apart), rel=1e-6)
    assert both[name].interval95[1] > alone[name].interval95[1] + 0.7 * apart
    assert both["mirror_offset_mm"].sd == pytest.approx(alone["mirror_offset_mm"].sd, rel=1e-6)


def test_contraction_tells_data_from_prior(summary):
    assert all(e.contraction > 0.99 for e in summary.effective.values())
    # Nearly a gauge against the laser's offset and the extrinsics.
    assert summary.parameters["tilt_axis_offset_mm.x"].contraction < 0.2
    for name, estimate in summary.parameters.items():
        assert estimate.informed == (estimate.contraction is not None and estimate.contraction >= CONTRACTION_LIMIT), (
            name
        )
    assert summary.headline_informed


@pytest.mark.parametrize(
    "problem", ["nothing was learned", *(pytest.param(p, marks=pytest.mark.thorough) for p in (None, "it stopped"))]
)
def test_only_a_converged_fit_that_learned_something_is_worth_sampling(fitted, problem):
    """By the same rule as for the whole summary, which takes much longer to make."""
    fit = fitted
    if problem == "it stopped":
        fit = replace(fit, converged=False, problems=(problem,))
    elif problem == "nothing was learned":
        fit = replace(fit, prior_draws=fit.draws)
    assert worth_sampling(fit) == (unusable(summarise(fit)) is None) == (problem is None)


def test_one_step_count_is_named_as_a_weak_direction(summary):
    texts = [weak.text for weak in summary.weak_directions]
    pan = next(t for t in texts if t.startswith("pan ratio and pan backlash move together"))
    # The tilt phase parks the pan axis at 100 once: nearly, not only.
    assert "nearly every leg has |N| = 200 and reverses; add N = 100 or a cleared approach" in pan


@pytest.mark.thorough
def test_two_step_counts_and_cleared_approaches_are_not(mounted_rig):
    approaches = {d: ("reversed", "cleared") for d in ("left", "right", "up", "down")}
    plan = four_point_protocol(repeats=6, steps=(100, 200), approaches=approaches)
    texts = [w.text for w in summarise(fit(simulate(mounted_rig, plan, seed=8).campaign)).weak_directions]
    assert not any("every leg has" in text or "only one |N|" in text for text in texts)


@pytest.fixture(scope="module")
def pan_only(mounted_rig) -> Campaign:
    """Left and right alone: after the homing every leg reverses, so move 0 alone separates ratio and backlash."""
    campaign = simulate(mounted_rig, paper_protocol(repeats=12), seed=8).campaign
    last = next(m.move for m in campaign.moves if m.tilt_steps != 0)
    return replace(
        campaign,
        moves=campaign.moves[: last - 1],
        spots=tuple(s for s in campaign.spots if s.move < last - 1),
    )


@pytest.mark.thorough
def test_the_recorded_approach_of_move_0_is_named_as_leverage(pan_only):
    fitted = fit(pan_only)
    summary = summarise(fitted)
    entry = next(e for e in summary.leverage if e.quantity == "effective left")
    assert entry.move == 0
    assert "its recorded approach (left, up)" in entry.text
    documents = summary.as_json()["leverage"]
    assert documents and all(set(d) == {"move", "spots", "quantity", "factor", "text"} for d in documents)
    assert documents == json.loads(json.dumps(documents, allow_nan=False))
    assert entry.factor > 2
    assert summary.effective["up"] is None
    # A refit without its spots loses as much to within a factor of two: the linear prediction does not see that
    # the half-normal prior bounds a backlash which nothing else holds any more.
    without = fit(replace(pan_only, spots=tuple(s for s in pan_only.spots if s.spot not in entry.spots)))
    grown = without.draws.effective_deg_per_step[:, 0].std() / fitted.draws.effective_deg_per_step[:, 0].std()
    assert 0.5 < grown / entry.factor < 2


def test_the_classic_answer_is_predicted(paper, summary):
    assert summary.few_stops == {}
    reported = classic(paper).directions
    for direction, predicted in summary.classic_predicted.items():
        result = reported[direction]
        # The classic mean scatters by its type A u about what the model expects.
        distance = abs(result.mean_deg_per_step - predicted.value)
        assert distance < 5 * np.hypot(result.u_type_a_deg_per_step, predicted.sd), direction


def test_the_predicted_classic_is_the_chain_run_on_every_draws_pixels(paper, fitted, summary):
    selection = select_experiments(paper)
    rows = experiment_rows(paper, selection)
    pixels = np.asarray(fitted.linearised.predicted)[rows][..., :4]
    push = np.asarray(fitted.linearised.predicted_jacobian)[rows][..., :4, :]
    chain = [
        four_point_ratios(pixels + push @ dz, selection.steps, selection.axis, paper.stereo)
        for dz in fitted.draws_z[:CLASSIC_DRAWS] - fitted.z
    ]
    for direction, predicted in summary.classic_predicted.items():
        means = np.array(chain)[:, selection.direction == direction].mean(axis=1)
        # What slopes leave out is a thousandth of an sd, in single draws a hundredth; a pixel left out is tenths.
        assert abs(predicted.sd / means.std() - 1) < 5e-3, direction
        assert np.abs(np.array(predicted.interval95) - interval95(means)).max() < 5e-3 * means.std(), direction


def test_a_draw_that_went_astray_drops_no_experiment(paper, fitted, monkeypatch):
    """One draw of 256 shows the first experiment beyond the lens model, and most show the second there."""
    selection = select_experiments(paper)
    ratios = np.random.default_rng(3).normal(0.06, 1e-4, (CLASSIC_DRAWS, len(selection.experiments)))
    ratios[0, 0] = np.nan
    ratios[: CLASSIC_DRAWS // 2 + 1, 1] = np.nan
    monkeypatch.setattr("tvsbayes.assessment.summary.ideal_pixels", lambda *_: np.zeros((1, len(paper.spots))))
    monkeypatch.setattr("tvsbayes.assessment.summary.four_point_ratios", lambda *_: ratios)
    direction = selection.direction[0]
    mine = selection.direction == direction
    mine[1] = False
    predicted = _classic_predicted(SimpleNamespace(fit=fitted, posterior=object()))[direction]
    # The draw itself does not determine the mean of all; the experiment is in it.
    assert predicted.sd == pytest.approx(ratios[1:, mine].mean(axis=1).std(), rel=1e-9)
    assert predicted.value == pytest.approx(np.nanmean(ratios[:, mine], axis=0).mean(), rel=1e-12)


def test_dof_counts_spots_less_what_they_determine(summary, paper):
    residuals = 3 * len(paper.spots)
    assert residuals - 60 < summary.noise.dof < residuals - 10
    # 1e-4 bounds of chi-square over dof by its normal approximation.
    assert abs(summary.noise.chi2 / summary.noise.dof - 1) < 4 * np.sqrt(2 / summary.noise.dof)


@pytest.mark.thorough
def test_an_axis_that_never_moved_is_null_and_named(short):
    tilted = {m.move for m in short.moves if m.tilt_steps != 0}
    pan_only = replace(
        short,
        moves=tuple(replace(m, tilt_steps=0) for m in short.moves),
        spots=tuple(s for s in short.spots if s.move not in tilted),
    )
    summary = summarise(fit(pan_only))
    assert summary.effective["up"] is None
    assert summary.effective["down"] is None
    assert summary.effective["left"] is not None
    assert summary.contrasts["tilt"] is None
    assert any("tilt axis was never moved" in weak.text for weak in summary.weak_directions)


@pytest.mark.thorough
def test_aperture_readings_bring_their_parameters(mounted_rig):
    plan = four_point_protocol(repeats=3, steps=(100, 200))
    fitted = fit(simulate(mounted_rig, plan, seed=4, aperture=True).campaign)
    summary = summarise(fitted)
    # Counted by hand along the twelve and thirteen rests of the protocol, the homing (left, up) among them.
    assert summary.few_stops == {"left": 7, "right": 5, "up": 7, "down": 6}
    parameters = summary.parameters
    assert set(RECEIVER_NAMES) <= set(parameters)
    # Readings of 0.02 deg see C0 (0.2 deg) only together with the zero (0.1 deg) and the axes' offsets.
    assert parameters["pan_zero_emission_deg"].informed
    assert fitted.free[TWO_MIRROR.index["pan_zero_emission_deg"]]


@pytest.mark.thorough
def test_gears_without_play_are_not_called_weak_for_it(short):
    """With one |N| the ratio is inseparable from play; with gears stated to have none it is not."""
    summary = summarise(fit(short, model=ModelChoice(no_backlash=True)))
    assert not any("backlash" in weak.text for weak in summary.weak_directions)
    assert not any("backlash" in entry.quantity for entry in summary.leverage)
    for axis in ("pan", "tilt"):
        fixed = summary.parameters[f"backlash_deg.{axis}"]
        assert (fixed.value, fixed.sd, fixed.interval95, fixed.contraction) == (0.0, 0.0, (0.0, 0.0), None)
    assert "nan" not in fit_text(summary)
    json.dumps(summary.as_json(), allow_nan=False)


@pytest.mark.thorough
def test_harmonics_are_listed_where_they_are_free_or_known(short):
    table = replace(
        short.rig,
        priors={**short.rig.priors, "harmonic_deg.tilt.1.cos": Prior(0.05, 0.0)},
        harmonic_period_deg={"pan": (7.0,), "tilt": (360.0,)},
    )
    stated = replace(short, rig=replace(table, priors={**table.priors, "harmonic_deg.pan.1.sin": Prior(0.0, 0.05)}))
    parameters = summarise(fit(stated)).parameters
    listed = {name: parameters[name] for name in HARMONIC_NAMES if name in parameters}
    assert set(listed) == {"harmonic_deg.pan.1.sin", "harmonic_deg.tilt.1.cos"}
    assert listed["harmonic_deg.tilt.1.cos"].value == pytest.approx(0.05)
    assert listed["harmonic_deg.tilt.1.cos"].contraction is None
    assert listed["harmonic_deg.pan.1.sin"].prior_sd == pytest.approx(0.05)


@pytest.mark.thorough
def test_a_prior_that_the_data_contradict_is_named(short, summary):
    assert summary.prior_conflicts == ()
    wrong = Prior(summary.parameters["degrees_per_step.pan"].value + 0.01, 1e-4)
    priors = {**short.rig.priors, "degrees_per_step.pan": wrong}
    contradicted = summarise(fit(replace(short, rig=replace(short.rig, priors=priors))))
    # A tight wrong prior pushes what is softer: the ratio keeps its value and others are named in its place.
    assert any("prior sds from its prior's centre" in text for text in contradicted.prior_conflicts)


@pytest.mark.thorough
def test_prior_sensitivity_is_what_a_refit_finds(paper, fitted, summary):
    """The stereo calibration twice as uncertain: predicted to first order, and fitted."""
    doubled = {
        e.quantity: e for e in summary.prior_sensitivity if (e.parameter, e.factor) == ("stereo calibration", 2.0)
    }
    stereo = replace(paper.stereo, parameter_covariance=4.0 * np.asarray(paper.stereo.parameter_covariance))
    refit = fit(replace(paper, stereo=stereo))
    assert doubled, "some effective ratio depends on the cameras"
    for k, direction in enumerate(("left", "right", "up", "down")):
        if f"effective {direction}" not in doubled:
            continue
        predicted = doubled[f"effective {direction}"]
        before, after = (f.draws.effective_deg_per_step[:, k] for f in (fitted, refit))
        sd = before.std()
        # The change itself is a tenth of an sd; second order leaves a third of that, the refit's own pose less.
        assert predicted.shift_sd == pytest.approx((after.mean() - before.mean()) / sd, abs=0.05)
        assert predicted.sd_ratio == pytest.approx(after.std() / sd, abs=0.03)
