"""Texts of fits, plans, points, clouds and watches, frozen: what is said, and when, reads as a diff."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from msgspec import structs
from support.axes import drawn, runs
from support.small_results import estimate, small_record, small_summary

from tvsbayes.coordinates.cloud import LawChecked
from tvsbayes.coordinates.cloud_files import CloudFile
from tvsbayes.estimators.findings import Finding
from tvsbayes.estimators.four_point import ClassicResult, DirectionResult
from tvsbayes.importing.sightings import STEP_DEG
from tvsbayes.report.axis_document import (
    axis_document,
    axis_fit_text,
    axis_plan_text,
    deviation_table,
    for_firmware,
    worst_place,
)
from tvsbayes.report.command_text import cloud_text, locations_text, watch_text
from tvsbayes.report.document import Issue
from tvsbayes.report.evidence import Criterion
from tvsbayes.report.fit_text import FINE_DEG, classic_text, demo_text, fit_text, next_steps
from tvsbayes.report.result_tables import KEY_PARAMETERS, estimate_row
from tvsbayes.report.scanner_document import verdict_of
from tvsbayes.report.scanner_sections import method_section
from tvsbayes.results.convergence import Agreement, Importance, MonteCarloError, NamedValue, Sampling
from tvsbayes.results.estimates import FitSummary, Validation, ValidationTest, WeakDirection
from tvsbayes.results.watch_record import MOVED, MovedPart, Watch
from tvsbayes.single_axis.axis_campaign import AxisCampaign, AxisMove, Reading
from tvsbayes.single_axis.axis_fit import fit_axis
from tvsbayes.single_axis.axis_record import PositionDeviation, results_for, summarise_axis
from tvsbayes.single_axis.next_stops import AxisPlan, NextStop
from tvsbayes.single_axis.waves import WavePeriods


def changed(**values: object) -> FitSummary:
    return structs.replace(small_summary(), **values)


def with_parameters(**values: object) -> FitSummary:
    named = {name.replace("__", "."): value for name, value in values.items()}
    return changed(parameters={**small_summary().parameters, **named})


def sampled(
    answer: str, missing: tuple[str, ...] = (), steps: int | None = None, agrees: bool | None = None
) -> FitSummary:
    """The small summary with a diagnosis of its draws."""
    least = NamedValue("effective left", 310.0)
    shift = NamedValue("backlash", 0.9)
    importance = Importance(not missing, missing, 64, 65536, 0.01, least, 0.8, shift, 0.08, -7.0, 0.1, 0, answer)
    chain = {
        "walkers": 64,
        "steps": steps,
        "discarded": 90,
        "thin": 1,
        "worst_rhat": NamedValue("effective left", 1.03),
    }
    diagnosis = Sampling(
        **{"converged": answer != "laplace", "missing": missing, "tau_steps": None, "invalid_evaluations": 0},
        **{"least_ess_bulk": least, "least_ess_tail": least, "acceptance": None, "least_acceptance": None},
        **{"stuck_walkers": (), "proposal_pareto_k": 0.8, "importance": importance},
        **(chain if steps else dict.fromkeys(chain)),
    )
    if agrees is not None:
        diagnosis = replace(diagnosis, agreement=Agreement(agrees, 4.0, NamedValue("backlash", 1.2)))
    errors = {"effective left": MonteCarloError(0.17, (0.31, 0.28)), "backlash": MonteCarloError(0.05, (0.1, 0.1))}
    return changed(
        estimator="laplace" if answer == "laplace" else "posterior",
        tier=None if answer == "laplace" else "emcee" if steps else "importance",
        converged=answer != "laplace",
        answer=answer,
        monte_carlo_error=errors,
        sampling=diagnosis,
        problems=missing,
    )


ASTRAY = changed(converged=False, problems=("it ran away",), few_stops={"up": 3})
CAUSES = [Finding("counter-sign", "spots move right", "flip it", True)]
SUM = "only the sum of the variances of stop scatter left and look scatter pan is known (correlation -0.84)"
SHARED = changed(
    weak_directions=(
        *small_summary().weak_directions,
        WeakDirection(SUM, {"stop_sd_deg.left": 1.0, "look_scatter_deg.pan": -0.84}),
    )
)
SINGLE = ValidationTest("single spots disagree", "most at spot 7", 80.0, 3, 90, 6.3e-42, True, 0.03)
FAILED = changed(validation=Validation(False, 0.01, "single spots disagree: most at spot 7", 1.0004, (SINGLE,)))
LARGER = changed(validation=structs.replace(FAILED.validation, inflation=1.0051))


def play(mean: float, low: float, variation: float) -> FitSummary:
    """A play that varies: more than itself, or where it may be none."""
    known = structs.replace(estimate(0.2, 0.01), contraction=0.9)
    return with_parameters(
        backlash_deg__pan=structs.replace(known, value=mean, interval95=(low, mean + 0.02)),
        play_variation_deg__pan=structs.replace(known, value=variation, interval95=(variation - 0.02, 0.4)),
    )


def direction(mean: float, u: float | None) -> DirectionResult:
    interval = None if u is None else (mean - 2 * u, mean + 2 * u)
    n = 1 if u is None else 4
    return DirectionResult(n, mean, None if u is None else 2 * u, u, interval, u, interval, 1e-4, None)


CLASSIC = ClassicResult(
    {"left": direction(0.0594, 0.0002), "right": direction(0.062, None), "up": None, "down": None}, (), ()
)
TRUTH = {"left": 0.06205, **dict.fromkeys(KEY_PARAMETERS[:3], 1.0)}


def located(aperture_read: bool) -> str:
    points = SimpleNamespace(
        **{"refused": [None], "covariance_mm2": np.eye(3)[None], "xyz_mm": np.array([[751.0, 173.0, 7.7]])},
        **{"u95_mm": np.ones((1, 3)), "digits_held": np.ones((1, 3)), "law_off_mm": np.zeros(1)},
        **{"extrapolated": [False], "unseen": [""], "draws": 1000, "estimator": "posterior"},
    )
    return locations_text(points, aperture_read)


def cloud(held: int) -> str:
    file = CloudFile("out.ply", ("x", "y"), 1000, 0, 0, None, {})
    return cloud_text(file, LawChecked(156, held, 5.7, 2700.0), SimpleNamespace())


def watched(*parts: tuple[str, float, str]) -> str:
    moved = tuple(MovedPart(what, value, 0.1, unit) for what, value, unit in parts)
    return watch_text(Watch(MOVED, 0.0, 0.01, moved, 16, 0.5, (), True), 0.8)


def plan(after: float) -> str:
    stop = NextStop(1_250_000.0, "forward", None, after, 1.0 - after, 0.1)
    return axis_plan_text(AxisPlan("per_command", 1.0, (stop,), 0.5), "mm")


TEXTS = {
    "a fit": lambda: fit_text(small_summary(), written=["results/fit.json"]),
    "a fit in detail": lambda: fit_text(small_summary(), details=True, written=["results/fit.json"]),
    "astray": lambda: fit_text(ASTRAY),
    "astray with a cause": lambda: fit_text(ASTRAY, causes=CAUSES),
    "steps after both": lambda: "\n".join([*next_steps(ASTRAY, "mine", CAUSES), *next_steps(ASTRAY, "mine")]),
    "few stops": lambda: fit_text(changed(few_stops={"up": 3, "down": 2})),
    "few stops sampled": lambda: fit_text(changed(few_stops={"up": 3, "down": 2}, estimator="posterior")),
    "scales known in their sum": lambda: fit_text(SHARED, details=True),
    "a play that varies by more than itself": lambda: fit_text(play(0.2, 0.18, 0.25)),
    "a play that varies by less": lambda: fit_text(play(0.2, 0.18, 0.19)),
    "a play that may be none": lambda: fit_text(play(0.2, -0.01, 0.25)),
    "fine steps": lambda: fit_text(with_parameters(degrees_per_step__pan=estimate(1.01234e-5, 3.1e-9))),
    "rough": lambda: fit_text(sampled("rough", ("known to 0.17 sd, wanted 0.1",))),
    "a rough chain": lambda: fit_text(sampled("rough", ("known to 0.17 sd, wanted 0.1",), 900)),
    "rough scales alone": lambda: fit_text(structs.replace(sampled("rough", ("short",), 900), monte_carlo_error={})),
    "not sampled": lambda: fit_text(sampled("laplace", ("Pareto k 0.80, wanted below 0.70",))),
    "no chain either": lambda: fit_text(sampled("laplace", ("Pareto k 0.80, wanted below 0.70",), 900)),
    "accepted": lambda: fit_text(sampled("accepted")),
    "a chain that agrees": lambda: fit_text(sampled("accepted", (), 900, agrees=True)),
    "a chain that does not": lambda: fit_text(sampled("accepted", (), 900, agrees=False)),
    "single spots disagree": lambda: fit_text(FAILED),
    "the same with a limit": lambda: verdict_of(FAILED, (Criterion("ratio left", 1e-3, "deg/step", 0.99, "met"),)).text,
    "a misfit with a factor": lambda: fit_text(LARGER),
    "classic": lambda: classic_text(CLASSIC),
    "a demo": lambda: demo_text(CLASSIC, small_summary(), TRUTH),
    "a demo that misses": lambda: demo_text(CLASSIC, small_summary(), {**TRUTH, "backlash_deg.pan": 2.0}),
    **{f"points, readings {read}": lambda read=read: located(read) for read in (False, True)},
    # A user's 25 of 156; 149 of 156 is above 95 %.
    **{f"a cloud, {held} held": lambda held=held: cloud(held) for held in (25, 149)},
    **{
        f"moved by {value} {unit}": lambda value=value, unit=unit: watched(("positioner: shift along y", value, unit))
        for value, unit in ((-12.0, "mm"), (9.0, "mm"), (1.5, "deg"), (0.4, "deg"), (0.3, "%"))
    },
    "cameras moved, and a remainder": lambda: watched(
        ("cameras: shift along y", 3.0, "mm"), ("positioner: shift along y", 3.0, "mm")
    ),
    **{f"a plan to {after} of u": lambda after=after: plan(after) for after in (0.99, 0.96, 0.94, 0.3)},
}


@pytest.mark.parametrize("name", TEXTS)
def test_text(name, snapshot):
    assert TEXTS[name]() == snapshot


def test_the_last_lines_fit_a_terminal():
    """What one of 80 columns still shows when a fit is done; the rest comes first, or with --details."""
    lines = fit_text(small_summary(), written=["results/fit.json"]).splitlines()
    last = lines[lines.index("") :]
    assert len(last) < 24 and max(map(len, last)) <= 80 and FINE_DEG == STEP_DEG


def test_rows_say_whether_data_or_prior_set_a_value():
    assert estimate_row("x", estimate(0.5, 0.01), "deg") == ["x, deg", "0.500(10)", "[0.480, 0.520]", "data"]
    words = [estimate_row("x", e, "deg")[-1] for e in (estimate(0.5, 0.01, 0.09), estimate(0.5, 0.0, None))]
    assert words == ["prior", "fixed"] and estimate_row("x", None, "deg")[1] == "never moved"


def test_a_stated_length_is_printed_with_its_unit_and_u():
    """As temperature and humidity of the set-up are."""
    stated = {"board_certificate": "PTB 123", "pitch_mm": {"value": 30.0, "u": 0.02}}
    e = SimpleNamespace(fit=small_record(), campaign=SimpleNamespace(header={"traceability": stated}))
    rows = {row[1]: row[2] for row in method_section(e).tables[0].rows if row[0] == "traceability"}
    assert rows == {"board_certificate": "PTB 123", "pitch": "30 mm, u = 0.02 mm"}


# --- an axis ---------------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def clean():
    summary = summarise_axis(fit_axis(drawn(7, runs(2)).campaign, sampled=False))
    return structs.replace(summary, converged=True, problems=(), prior_conflicts=(), warnings=())


def variants(clean) -> Iterator[tuple[str, object]]:
    for warnings in (("segment 2 reads 16 times what others read",), ("reading 5 lies 9 sds off", "no times")):
        yield f"{len(warnings)} warnings", structs.replace(clean, warnings=warnings)
    for tier, worst in (("importance", None), ("emcee", 2.04), ("emcee", 7.0), ("emcee", None)):
        yield f"{tier} {worst}", structs.replace(clean, tier=tier, sampling={"agreement": worst})
    yield "not converged", structs.replace(clean, converged=False, sampling={}, problems=("no mode",))


def test_what_the_text_of_an_axis_adds(clean, snapshot):
    """Lines that a clean fit does not print."""
    usual = set(axis_fit_text(clean).splitlines())
    assert {
        name: [s for s in axis_fit_text(v).splitlines() if s not in usual] for name, v in variants(clean)
    } == snapshot
    assert usual >= {"verdict: usable"} and sum("for your firmware" in line for line in usual) == 1
    assert not any("firmware" in line for line in axis_fit_text(dict(variants(clean))["not converged"]).splitlines())


@pytest.mark.parametrize(("value", "low", "high"), [(0.15, 0.13, 0.17), (-0.15, -0.17, -0.13), (0.015, -0.01, 0.04)])
def test_numbers_for_firmware(clean, snapshot, value, low, high):
    """1/0.05 = 20, u 0.0005/0.05^2 = 0.2; 0.15/0.05 = 3, u 0.01/0.05 = 0.2."""
    sides = {name: structs.replace(of, value=-0.05, sd=0.0005) for name, of in clean.effective_per_command.items()}
    clean = structs.replace(clean, effective_per_command=sides, range_command=(0.0, 1250000.0))
    play = structs.replace(clean.parameters["backlash"], value=value, sd=0.01, interval95=(low, high))
    mean = for_firmware(structs.replace(clean, effective_backlash=play))
    of_one = structs.replace(clean, effective_backlash=None, parameters={**clean.parameters, "backlash": play})
    assert mean.replace(" on average", "") == for_firmware(of_one) != mean
    assert mean == snapshot


def test_place_and_possible_cause_of_the_largest_error_by_position(clean, snapshot):
    deviations = (
        PositionDeviation(0.0, 0.02, 0.01, (0.0, 0.04)),
        PositionDeviation(1250000.0, -0.05, 0.01, (-0.07, -0.03)),
        PositionDeviation(2500000.0, 0.03, 0.01, (0.01, 0.05)),
    )
    assert [worst_place(structs.replace(clean, deviations=deviations[:n])) for n in (3, 1)] == snapshot


@pytest.mark.parametrize(("count", "kept"), [(1, 1), (40, 40), (41, 40), (900, 40)])
def test_a_long_table_keeps_both_ends_and_says_what_it_leaves_out(count, kept):
    deviations = [PositionDeviation(float(k), 0.0, 1.0, (-2.0, 2.0)) for k in range(count)]
    table = deviation_table(deviations, "mm", 40)
    positions = [float(row[0]) for row in table.rows]
    assert len(set(positions)) == kept and (positions[0], positions[-1]) == (0, count - 1)
    # Evenly: rounding to whole rows makes neighbouring gaps differ by one.
    assert count == 1 or np.ptp(np.diff(positions)) <= 1
    assert (f"{kept} of {count}" in table.caption) is ("fit.json" in table.caption) is (kept < count)


def test_the_text_of_a_drive_has_no_play_directions_or_stops():
    """Numbers and advice for an axis with stops are left out."""
    rate, time_s = 15.0, 5.0 * np.arange(200)
    value = rate * time_s + 4.0 * np.sin(2 * np.pi * time_s / 200.0) + 0.3 * np.random.default_rng(1).normal(size=200)
    rows = zip(value, time_s, strict=True)
    readings = tuple(Reading(k, 0, float(v), 0.3, time_s=float(t)) for k, (v, t) in enumerate(rows))
    periods = WavePeriods(stated=(200.0,), in_seconds=True)
    campaign = AxisCampaign("arcsec", (AxisMove(0, 0, 0.0, 0.0, "forward"),), readings, {}, {"rate": rate}, periods)
    results = results_for(campaign)
    document = axis_document(results, Issue.today())
    text = axis_fit_text(results.summary)
    assert not document.numbers and "compensate AXIS --to pec" in document.steps[0]
    assert "What repeats by position" not in [section.title for section in document.sections]
    assert "backward" not in text and "play" not in text and "a wave of" in text
    assert document.picture is not None and "every 200 s" in document.picture.caption
