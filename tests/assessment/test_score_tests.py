"""Validation of a fit: exact under the model, blind to what the fit can follow, and right about planted defects.

Residuals are drawn at a true rig from the linear model (pixel noise, stop errors that persist) instead of refitted: the
tests do not see what a fit would take away, which is itself tested.
"""

from __future__ import annotations

import json
from dataclasses import replace

import equinox as eqx
import jax
import numpy as np
import pytest
from msgspec import structs
from scipy import stats
from support.commands import steps
from support.dozen_spots import coordinates
from support.drawn_residuals import drawn_residual
from support.fit_documents import changed, kept, problems, schema_of
from support.small_results import small_summary

from tvsbayes.assessment.score_tests import (
    KNOWN_DIRECTION,
    VALIDATION_LEVEL,
    _defects_in_place,
    _holm,
    _SeenAxis,
    _Tested,
    validate,
)
from tvsbayes.estimators.joint_fit import JointFit, fit_at
from tvsbayes.estimators.linear_spots import linear_spots
from tvsbayes.estimators.mode_search import Problem
from tvsbayes.instrument.campaign import ordered_spots
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.parameters import CREEP_NAMES, NOISE_NAMES
from tvsbayes.report.evidence import Criterion
from tvsbayes.report.fit_text import fit_text, validation_lines
from tvsbayes.report.scanner_document import verdict_of
from tvsbayes.results.estimates import Validation, ValidationTest
from tvsbayes.results.records import plain
from tvsbayes.statistics.chances import log_chance
from tvsbayes.statistics.least_squares import Mode
from tvsbayes.twin.simulated_campaign import simulate

PAN = (0, 70, 141, 200, 142, 71)
CREEPS = np.isin(TWO_MIRROR.names, CREEP_NAMES)
TILT = (-60, -36, -12, 13, 36, 61, 37, 12, -12, -36)


@pytest.fixture(scope="module")
def clean(mounted_rig) -> JointFit:
    """60 stops of both axes on two sheets in turn, linearised at the true rig."""
    orders: list[tuple] = [("home", 0, 0)]
    for look in range(60):
        if look % 15 == 0:
            orders.append(("place", ("d1", "d2")[look // 15 % 2]))
        orders += [("move", PAN[look % 6], TILT[look % 10]), ("look",)]
    simulated = simulate(mounted_rig, steps(*orders), seed=4)
    with jax.enable_x64(True):
        problem = Problem(simulated.campaign, simulated.campaign.rig)
        z = np.where(problem.free, coordinates(problem.space, simulated.truth), 0.0)
        fisher = problem.information(problem.linearised(z)).fisher
        mode = Mode(z, np.linalg.inv(fisher + np.eye(len(z))), 0.0, ())
        return fit_at(simulated.campaign, problem, mode, 0)


def with_residual(fit: JointFit, residual: np.ndarray) -> JointFit:
    """The same fit with other residuals, shape (n, 4)."""
    return replace(fit, linearised=eqx.tree_at(lambda lin: lin.residual, fit.linearised, residual))


def own_columns(fit: JointFit) -> np.ndarray:
    held = np.isin(TWO_MIRROR.names, NOISE_NAMES) | ~fit.free
    return np.where(held, 0.0, -fit.linearised.residual_jacobian)


def drawn(fit: JointFit, seed: int) -> np.ndarray:
    """Residuals by the model, at a true rig."""
    return drawn_residual(linear_spots(fit.linearised, fit.arrays, own_columns(fit)), seed)


def test_what_the_fit_can_follow_is_not_seen(clean):
    """Adding J a changes no test: the true rig may lie anywhere, and no refit is needed to see a defect."""
    residual = drawn(clean, 1)
    size = np.where(CREEPS, 0.0, 0.3 * np.random.default_rng(2).standard_normal(len(TWO_MIRROR.names)))
    before, after = (validate(with_residual(clean, r)).tests for r in (residual, residual + own_columns(clean) @ size))
    first, second = ({t.name: t for t in tests} for tests in (before, after))
    assert len(first) >= 8
    for name, test in first.items():
        # Directions in which the spots gain less than 1e-4 prior sds are not followed: 0.3 sd of 50 of them.
        assert second[name].chi2 == pytest.approx(test.chi2, abs=0.3), name


def test_a_creep_is_known_by_its_prior_wherever_the_fit_is_linearised(clean):
    """From z to z + a with the residual that follows: a mode between zero and the true creep decides no test."""
    residual, size = (
        drawn(clean, 1),
        np.where(CREEPS, np.random.default_rng(3).standard_normal(len(TWO_MIRROR.names)), 0.0),
    )
    moved = replace(with_residual(clean, residual - own_columns(clean) @ size), z=clean.z + size)
    first, second = ({t.name: t.chi2 for t in validate(fit).tests} for fit in (with_residual(clean, residual), moved))
    assert second == pytest.approx(first, rel=KNOWN_DIRECTION)


@pytest.mark.thorough
def test_p_values_are_uniform_and_false_alarms_rare(clean):
    """Twenty-five clean campaigns with creeps by their prior: Kolmogorov-Smirnov and numbers of alarms, at 1e-4."""
    rng = np.random.default_rng(4)
    creeps = [own_columns(clean) @ np.where(CREEPS, rng.standard_normal(len(TWO_MIRROR.names)), 0.0) for _ in range(25)]
    validations = [validate(with_residual(clean, drawn(clean, k) + creep)) for k, creep in enumerate(creeps)]
    alarms = sum(not v.passed for v in validations)
    assert alarms <= stats.binom.isf(1e-4, len(validations), VALIDATION_LEVEL)
    by_name: dict[str, list[ValidationTest]] = {}
    for validation in validations:
        for test in validation.tests:
            by_name.setdefault(test.name, []).append(test)
    drift = [t.p for t in by_name["the cameras drifted (pose or focal length)"]]
    assert stats.kstest(drift, "uniform").pvalue > 1e-4
    for name, tests in by_name.items():
        assert len(tests) == len(validations), name
        # Shared levels are conservative: small p at most as often as they say.
        share = sum(t.p < 0.1 for t in tests)
        assert share <= stats.binom.isf(1e-4, len(tests), 0.1), name


DEFECTS = (
    *("the cameras moved", "the cameras drifted", "a ratio drifted", "steps were lost", "the gears"),
    "stops depend on the step phase",
)


def planted(fit: JointFit, name: str) -> np.ndarray:
    """What a defect adds to the residuals, written without the package's own columns."""
    spots = ordered_spots(fit.campaign)
    count = len(spots)
    along = np.arange(count) / (count - 1)
    lin = fit.linearised
    pan, tilt = (np.radians(1) * lin.slope[:, :, k] for k in (0, 1))
    angle = np.degrees(lin.mirror_angles_rad)
    pose = [TWO_MIRROR.index[f"extrinsics.rotation_rad.{a}"] for a in "xyz"]
    units = np.asarray(fit.space.u)[pose]
    turned = -lin.residual_jacobian[:, :, pose] @ (np.radians([1.5, -1.0, 0.5]) / units)
    counters = np.array([fit.campaign.moves[s.move].pan_steps for s in spots])
    patterns = {
        "the cameras moved": turned * (along > 0.6)[:, None],
        "the cameras drifted": 2 * turned * along[:, None],
        "a ratio drifted": pan * (0.1 * (along - 0.5) * (angle[:, 0] - angle[:, 0].mean()))[:, None],
        "steps were lost": -pan * (0.24 * (along > 0.4))[:, None],
        "the gears": 0.2 * tilt * np.cos(2 * np.pi * angle[:, 1] / 1.7)[:, None],
        "stops depend on the step phase": 0.2 * pan * np.where(counters % 4 == 2, 1.0, -1.0)[:, None],
    }
    return patterns[name]


@pytest.mark.parametrize("name", DEFECTS)
def test_a_planted_defect_is_named(clean, name):
    validation = validate(with_residual(clean, drawn(clean, 5) + planted(clean, name)))
    assert not validation.passed
    assert validation.cause.startswith(name)
    assert validation.inflation > 1


def test_a_lost_step_is_placed(clean):
    validation = validate(with_residual(clean, drawn(clean, 5) + planted(clean, "steps were lost")))
    row = int(validation.cause.split("from spot ")[1].split(" ")[0])
    # 32 places over 60 spots: the nearest lies within two.
    assert validation.cause.split(": ")[1].startswith("pan") and abs(row - 24) <= 2


def test_one_bad_spot_is_named_and_moves_no_uncertainty(clean):
    residual = drawn(clean, 6)
    residual[33, :3] += 12.0
    validation = validate(with_residual(clean, residual))
    worst = next(t for t in validation.tests if t.name.startswith("single"))
    assert worst.failed and worst.where.endswith(f"spot {ordered_spots(clean.campaign)[33].spot}")


def test_holm_shares_the_level_and_the_factor_takes_failed_tests_alone():
    logs = np.log([0.004, 1e-5, 0.5, 0.004999])
    answers = [_Tested(float(p), f"t{k}", "here", 9.0, 1, 2.0 + k) for k, p in enumerate(logs)]
    check = _holm(answers)
    # Four tests: 1e-5 <= 0.01/4, then 0.004 > 0.01/3.
    assert [t.name for t in check.tests if t.failed] == ["t1"]
    assert check.cause == "t1: here" and check.inflation == pytest.approx(np.hypot(1, 3.0))
    # 0.004 <= 0.01/2 once only two are left.
    check = _holm([answers[0], answers[2]])
    assert [t.failed for t in check.tests] == [True, False] and check.inflation == pytest.approx(np.hypot(1, 2.0))
    nothing = _holm([answers[2]])
    assert nothing.passed and nothing.inflation == 1.0 and nothing.cause == ""


FAILED = Validation(
    False,
    0.01,
    "the cameras moved: from spot 60 on (move 70)",
    3.25,
    (ValidationTest("the cameras moved", "from spot 60 on (move 70)", 80.0, 6, 16, 1e-9, True, 3.09),),
)


def test_no_reader_of_the_text_can_miss_a_failure():
    unasked = fit_text(small_summary())
    assert "alidation" not in unasked and "VALIDATION" not in unasked
    lines = fit_text(structs.replace(small_summary(), validation=FAILED)).splitlines()
    warning = validation_lines(FAILED)[0]
    assert "3.25" in warning and "the cameras moved: from spot 60" in warning
    assert lines[0] == warning and lines[-1] == "verdict: VALIDATION FAILED, multiply every u and half-width by 3.25"
    assert [line for line in lines if line.startswith("what helps: fix the cameras")]
    no_sign = structs.replace(FAILED.tests[0], failed=False)
    passed = structs.replace(FAILED, passed=True, cause="", inflation=1.0, tests=(no_sign,))
    # Spots that scatter eleven times as far: noise to be stated where the model holds, its failure where not.
    scale = structs.replace(small_summary().parameters["pixel_scale"], value=11.0)
    noisy = structs.replace(small_summary(), parameters={**small_summary().parameters, "pixel_scale": scale})
    warned = [("state larger ones" in fit_text(structs.replace(noisy, validation=each))) for each in (passed, FAILED)]
    assert warned == [True, False]
    text = fit_text(structs.replace(small_summary(), validation=passed), details=True)
    assert "VALIDATION" not in text and "validation: no sign of a model error in 1 tests" in text


def test_no_reader_of_the_report_can_miss_a_failure():
    summary = structs.replace(small_summary(), validation=FAILED)
    warning = validation_lines(FAILED)[0]
    met = Criterion("ratio left", 1e-3, "deg/step", 0.99, "met")
    for criteria, kind in (((), "cannot-tell"), ((met,), "met")):
        verdict = verdict_of(summary, criteria)
        assert verdict.text.startswith(warning) and verdict.kind == kind
    assert verdict_of(small_summary(), (met,)).text.startswith("Met")


def test_the_entry_obeys_the_schema():
    document = kept("fit-1-laplace.json")
    schema = schema_of(document)
    written = json.loads(json.dumps({**document, "validation": plain(FAILED)}))
    assert problems(written, schema) == [] and problems({**written, "validation": None}, schema) == []
    for path, value in (("inflation", 0.5), ("passed", 1), ("tests/0/p", 2.0), ("tests/0/dof", 0), ("level", ...)):
        assert problems(changed(written, f"validation/{path}", value), schema), path


def test_the_larger_of_two_gross_defects_is_the_cause():
    """The chance of a chi-square with two degrees of freedom is exp(-x / 2), however small; others stay ordered."""
    far = np.array([10.0, 1e3, 1e5, 1e7])
    np.testing.assert_allclose(log_chance(far, 2), -far / 2, rtol=1e-12)
    for dof in (1, 3, 6):
        near = np.array([1.0, 30.0, 600.0])
        np.testing.assert_allclose(log_chance(near, dof), stats.chi2.logsf(near, dof), rtol=1e-12)
        # Continued from where the plain law still has digits: the asymptotic slope is -1/2.
        ends = log_chance(np.array([1000.0, 2000.0, 1e5]), dof)
        assert np.all(np.isfinite(ends)) and np.all(np.diff(ends) < 0)
        assert (ends[1] - ends[0]) / 1000 == pytest.approx(-0.5, abs=3 / 1000)
    spot, cameras = (_Tested(float(log_chance(x, 3)), str(x), "", x, 3, 0.0) for x in (1600.0, 1e5))
    assert _holm([spot, cameras]).cause.startswith("100000.0")


def test_an_axis_that_a_search_has_left_without_motion_has_no_waves(clean):
    """A ratio of zero, where a search ended that fits no rig: its misfit refuses it, not a division by 0."""
    n = len(ordered_spots(clean.campaign))
    moving, still = (
        _SeenAxis("pan", np.ones((n, 4, 1)), angle, np.arange(n), np.ones(n)) for angle in (np.arange(n), np.zeros(n))
    )
    name = "the gears have a transmission error"
    assert _defects_in_place(clean, [moving, moving])[name]
    assert not _defects_in_place(clean, [still, still])[name]
