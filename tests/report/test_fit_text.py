"""Text of a fit: results, warnings and the truth of a demo."""

from __future__ import annotations

from dataclasses import replace

import pytest
from msgspec import structs
from support.small_results import small_summary

from tvsbayes.estimators.findings import Finding
from tvsbayes.estimators.four_point import ClassicResult, DirectionResult
from tvsbayes.importing.sightings import STEP_DEG
from tvsbayes.report.evidence import Criterion
from tvsbayes.report.fit_text import FINE_DEG, classic_text, demo_text, fit_text, next_steps
from tvsbayes.report.result_tables import KEY_PARAMETERS
from tvsbayes.report.scanner_document import verdict_of
from tvsbayes.results.convergence import Agreement, Importance, MonteCarloError, NamedValue, Sampling
from tvsbayes.results.estimates import FitSummary, Validation, ValidationTest, WeakDirection


def test_a_fit_that_did_not_converge_shows_no_results():
    """The place where it stopped is printed; uncertainties and diagnoses are not."""
    astray = structs.replace(small_summary(), converged=False, problems=("it ran away",), few_stops={"up": 3})
    text = fit_text(astray)
    assert text.splitlines()[0] == "NOT CONVERGED: it ran away"
    assert "NOT results" in text and "95 %" not in text and "0.0621" not in text and "weak" not in text
    assert "19 and 10 more" in text and "cause" not in text
    causes = [Finding("counter-sign", "spots move right", "flip it", True)]
    assert fit_text(astray, causes=causes).splitlines()[-1] == "cause: spots move right"
    assert next_steps(astray, "mine", causes) == ["Use none of the numbers: spots move right; flip it."]
    assert "tvsbayes check" in next_steps(astray, "mine")[0]


@pytest.mark.parametrize(
    ("estimator", "word"), [("laplace", "too short; sample"), ("posterior", "intervals include this")]
)
def test_few_stops_are_reported(estimator, word):
    lines = fit_text(structs.replace(small_summary(), few_stops={"up": 3, "down": 2}, estimator=estimator)).splitlines()
    (line,) = (line for line in lines if line.startswith("few stops"))
    assert "(up 3, down 2)" in line and word in line
    assert "few stops" not in fit_text(small_summary())


def test_fit_text_shows_results_and_warnings():
    text = fit_text(small_summary(), details=True, written=["results/fit.json"])
    lines = {line.split("  ")[0]: line for line in text.splitlines()}
    assert "pan 6.00 deg, tilt 0.50 deg" in lines["joint estimator (Laplace) at pan 6.00 deg, tilt 0.50 deg"]
    assert "0.06210(10)" in lines["effective left, deg/step"]
    assert "never moved" in lines["effective right, deg/step"]
    assert lines["mirror offset L, mm"].endswith("prior")
    assert lines["stop scatter up, deg"].endswith("fixed")
    assert "left - right" not in text
    assert "chi2 31.0 for 30.5 degrees of freedom" in text
    assert "weak (set by the priors, not by the data): the tilt axis was never moved" in text
    assert "depends on one stop: without move 0 it is lost" in text
    assert "excluded spots: 17\n" in text
    # A long list of ids is shortened.
    assert "spots that disagree with all others: 0, 1, 2" in text
    assert ", 19 and 10 more; look at them" in text


def test_scales_known_only_in_their_sum_are_not_set_by_the_data():
    """The line says what the word of the table means; it is no further weak direction."""
    text = "only the sum of the variances of stop scatter left and look scatter pan is known (correlation -0.84)"
    summary = small_summary()
    known = WeakDirection(text, {"stop_sd_deg.left": 1.0, "look_scatter_deg.pan": -0.84})
    shared = structs.replace(summary, weak_directions=(*summary.weak_directions, known))
    for details in (False, True):
        lines = fit_text(shared, details).splitlines()
        origin = {line.split("  ")[0]: line.split(" ")[-1] for line in lines}
        assert lines.count(f"not separated: {text}") == 1
        assert origin["stop scatter left, deg"] == origin["look scatter pan, deg"] == "sum"
        assert origin["stop scatter right, deg"] == origin["noise, estimated / stated"] == "data"
        assert not any(line.startswith("weak") and text in line for line in lines)
    assert "1 weak direction," in fit_text(shared) and "sum" not in fit_text(summary)


def test_a_play_that_varies_by_more_than_itself_is_doubted():
    """Of the axis that it is of; a play that may be none is not doubted."""
    summary = small_summary()
    play = structs.replace(next(iter(summary.parameters.values())), value=0.2, sd=0.01, contraction=0.9)

    def lines(mean, low, variation):
        named = {
            "backlash_deg.pan": structs.replace(play, value=mean, interval95=(low, mean + 0.02)),
            "play_variation_deg.pan": structs.replace(play, value=variation, interval95=(variation - 0.02, 0.4)),
        }
        text = fit_text(structs.replace(summary, parameters={**summary.parameters, **named}))
        return [line for line in text.splitlines() if line.startswith("doubt: ")]

    [line] = lines(0.2, 0.18, 0.25)
    assert "the play of pan varies by 0.250(10) deg (sd), more than the play itself, 0.200(10)" in line
    assert lines(0.2, 0.18, 0.19) == lines(0.2, -0.01, 0.25) == []


def test_the_ratio_of_fine_steps_is_stated_for_many_counts():
    summary = small_summary()
    known = next(iter(summary.parameters.values()))
    fine = structs.replace(known, value=1.01234e-5, sd=3.1e-9)
    both = {**summary.parameters, "degrees_per_step.pan": fine}
    assert "turn pan by 1.01234(31) deg\n" in fit_text(structs.replace(summary, parameters=both))
    assert "counts, 1 deg" not in fit_text(summary)
    assert FINE_DEG == STEP_DEG


def test_a_fit_ends_with_its_table_and_its_verdict():
    """What a terminal of 80 columns still shows when it is done; the rest comes first, or with --details."""
    lines = fit_text(small_summary(), written=["results/fit.json"]).splitlines()
    assert lines[-1] == "verdict: usable; too few spots to look for model errors"
    blank = lines.index("")
    assert lines[blank + 1].startswith("joint estimator") and len(lines) - blank < 24
    assert "written: results/fit.json" in lines[:blank]
    assert "--details and the report say more: 1 weak direction, 1 stop that decides a result" in lines[:blank]
    assert not [line for line in lines if line.startswith(("weak", "hangs"))]
    assert max(map(len, lines[blank:])) <= 80


def sampled(answer: str, missing: tuple[str, ...], steps: int | None = None) -> FitSummary:
    """The small summary with a diagnosis of its draws."""
    least = NamedValue("effective left", 310.0)
    importance = Importance(
        not missing, missing, 64, 65536, 0.01, least, 0.8, NamedValue("backlash", 0.9), 0.08, -7.0, 0.1, 0, answer
    )
    diagnosis = Sampling(
        converged=answer != "laplace",
        missing=missing,
        walkers=None if steps is None else 64,
        steps=steps,
        discarded=None if steps is None else steps // 10,
        thin=None if steps is None else 1,
        tau_steps=None,
        worst_rhat=None if steps is None else NamedValue("effective left", 1.03),
        least_ess_bulk=least,
        least_ess_tail=least,
        acceptance=None,
        least_acceptance=None,
        stuck_walkers=(),
        invalid_evaluations=0,
        proposal_pareto_k=0.8,
        importance=importance,
    )
    errors = {"effective left": MonteCarloError(0.17, (0.31, 0.28)), "backlash": MonteCarloError(0.05, (0.1, 0.1))}
    return structs.replace(
        small_summary(),
        estimator="laplace" if answer == "laplace" else "posterior",
        tier=None if answer == "laplace" else "importance" if steps is None else "emcee",
        converged=answer != "laplace",
        answer=answer,
        monte_carlo_error=errors,
        sampling=diagnosis,
        problems=missing,
    )


@pytest.mark.parametrize(
    ("steps", "helps"),
    [
        (None, "fit without --quick, or with --resume and more --max-minutes"),
        (900, "fit with --resume and more --max-minutes"),
    ],
)
def test_a_rough_answer_states_its_error_and_remedy(steps, helps):
    """The table stays; what is missing, the worst Monte Carlo error and the way to more stand before it."""
    text = fit_text(sampled("rough", ("known to 0.17 sd, wanted 0.1",), steps))
    lines = text.splitlines()
    assert "rough: known to 0.17 sd, wanted 0.1" in lines
    worst = "0.17 sd of the mean, 0.31 and 0.28 sd of the interval's ends (effective left)"
    assert f"Monte Carlo error, largest: {worst}" in lines
    assert any(line.startswith("what helps: ") and line.endswith(helps) for line in lines)
    assert "0.06210(10)" in text and lines[-1] == "verdict: usable, but rough: see the Monte Carlo error"
    assert "NOT" not in text


@pytest.mark.parametrize("steps", [None, 900])
def test_where_nothing_could_be_sampled_the_laplace_table_is_given_with_its_warning(steps):
    summary = sampled("laplace", ("Pareto k 0.80, wanted below 0.70",), steps)
    assert summary.explained
    lines = fit_text(summary).splitlines()
    assert "not sampled: Pareto k 0.80, wanted below 0.70" in lines
    assert not [line for line in lines if line.startswith("Monte Carlo error")]
    assert any("0.06210(10)" in line for line in lines)
    assert lines[-1].startswith("verdict: usable with care: the posterior could not be sampled; the table is the Lap")
    assert "too short" in lines[-1]


def test_an_accepted_answer_has_no_remark():
    text = fit_text(sampled("accepted", ()))
    assert "rough" not in text and "what helps" not in text and "Monte Carlo" not in text


def test_a_chain_without_headlines_has_no_largest_error():
    """A rig whose geometry is stated as known: what may be rough are its scales alone."""
    summary = structs.replace(sampled("rough", ("short",), 900), monte_carlo_error={})
    assert "rough: short" in fit_text(summary) and "Monte Carlo error, largest" not in fit_text(summary)


def direction(mean: float, u: float | None) -> DirectionResult:
    interval = None if u is None else (mean - 2 * u, mean + 2 * u)
    n = 1 if u is None else 4
    return DirectionResult(n, mean, None if u is None else 2 * u, u, interval, u, interval, 1e-4, None)


def test_classic_text_has_a_row_per_direction_with_or_without_experiments():
    directions = {"left": direction(0.0594, 0.0002), "right": direction(0.062, None), "up": None, "down": None}
    rows = [line.split() for line in classic_text(ClassicResult(directions, (), ())).splitlines()]
    assert rows[2] == ["left", "4", "0.059400", "0.000400", "0.000200", "[0.05900,", "0.05980]"]
    assert rows[3] == ["right", "1", "0.062000", "-", "-", "-"]
    assert rows[4] == ["up", "0", "no", "experiment"]


def test_demo_text_says_which_interval_holds_the_truth():
    classic = ClassicResult({"left": direction(0.0594, 0.0002), "right": None, "up": None, "down": None}, (), ())
    truth = {"left": 0.06205, **dict.fromkeys(KEY_PARAMETERS[:3], 1.0)}
    text = demo_text(classic, small_summary(), truth)
    row = next(line.split() for line in text.splitlines() if line.startswith("left"))
    assert row == ["left", "0.05940(20)", "NO", "0.06210(10)", "yes", "0.062050"]
    off = demo_text(classic, small_summary(), {**truth, "backlash_deg.pan": 2.0})
    assert next(line for line in off.splitlines() if line.startswith("backlash pan")).split()[4] == "NO"


def test_a_factor_of_one_is_no_remedy():
    """What single spots do to results, no factor holds: the last line says what to do instead."""
    test = ValidationTest("single spots disagree", "most at spot 7", 80.0, 3, 90, 6.3e-42, True, 0.03)
    failed = Validation(False, 0.01, "single spots disagree: most at spot 7", 1.0004, (test,))
    text = fit_text(structs.replace(small_summary(), validation=failed))
    lines = text.splitlines()
    assert "multiply" not in text and "1.00" not in lines[0]
    assert lines[0].startswith("VALIDATION FAILED: single spots disagree: most at spot 7 (p 6.3e-42); ")
    assert lines[0].endswith("; the table is as fitted, no factor on u covers it")
    assert lines[-1] == (
        "verdict: VALIDATION FAILED, no factor on u covers it: look at those spots, or fit with --robust"
    )
    assert "what helps: look at those spots, or fit with --robust" in text
    limit = Criterion("ratio left", 1e-3, "deg/step", 0.99, "met")
    assert "As fitted: Met" in verdict_of(structs.replace(small_summary(), validation=failed), (limit,)).text
    larger = structs.replace(failed, inflation=1.0051)
    assert fit_text(structs.replace(small_summary(), validation=larger)).endswith("half-width by 1.01")


def test_a_chain_says_whether_it_agrees_with_the_weighted_draws():
    chain = sampled("accepted", (), 900)
    assert "the largest difference is" not in fit_text(sampled("accepted", ()))
    for agrees, words in ((True, "agree on every result"), (False, "DISAGREE")):
        agreement = Agreement(agrees, 4.0, NamedValue("backlash", 1.2))
        text = fit_text(structs.replace(chain, sampling=replace(chain.sampling, agreement=agreement)))
        assert f"emcee and importance sampling {words}: the largest difference is 1.2 Monte Carlo errors" in text
