"""Decision rules against numbers worked out by hand from JCGM 106 and ISO 14253-1."""

from __future__ import annotations

import numpy as np
import pytest
from support.refusals import refusal

from tvsbayes.metrology.conformity import CONFORMS, FAILS, UNDECIDED, Tolerance

LIMIT = 15.0


@pytest.mark.parametrize(
    ("rule", "guard", "value", "verdict"),
    [
        ("simple", 2.0, 15.0, CONFORMS),
        ("simple", 2.0, 15.001, FAILS),
        # U = 2 um: conforms up to 13, fails beyond 17.
        ("guarded", 2.0, 13.0, CONFORMS),
        ("guarded", 2.0, 13.001, UNDECIDED),
        ("guarded", 2.0, 17.0, UNDECIDED),
        ("guarded", 2.0, 17.001, FAILS),
        # One-sided by ISO 14253-1: 1.65 u.
        ("guarded", 1.65, 13.35, CONFORMS),
        ("guarded", 1.65, 13.36, UNDECIDED),
        # The normal quantile of 0.95 is 1.6449.
        ("probability", 2.0, 13.355, CONFORMS),
        ("probability", 2.0, 13.356, UNDECIDED),
        ("probability", 2.0, 16.644, UNDECIDED),
        ("probability", 2.0, 16.645, FAILS),
    ],
)
def test_verdicts_change_at_the_limits_of_the_rule(rule, guard, value, verdict):
    c = Tolerance(LIMIT, "accuracy", rule, guard).judged("A", "um", value, 1.0)
    assert (c.verdict, c.rule, c.value, c.u) == (verdict, rule, value, 1.0)
    assert c.guard_band == (guard if rule == "guarded" else None)


def test_risk_is_the_probability_that_the_verdict_is_wrong():
    """Phi(1) = 0.8413: one u within the limit, and one beyond it."""
    simple = Tolerance(LIMIT, "accuracy", "simple")
    within, beyond = (simple.judged("A", "um", value, 1.0) for value in (14.0, 16.0))
    assert within.probability == pytest.approx(0.841345, abs=1e-6) and within.risk == pytest.approx(0.158655, abs=1e-6)
    assert beyond.probability == pytest.approx(0.158655, abs=1e-6) and beyond.risk == pytest.approx(0.158655, abs=1e-6)
    open_ = Tolerance(LIMIT, "accuracy", "guarded").judged("A", "um", 14.0, 1.0)
    assert open_.verdict == UNDECIDED and open_.risk is None


def test_without_an_uncertainty_only_the_simple_rule_decides():
    known = Tolerance(LIMIT, "accuracy", "simple").judged("A", "um", 14.0, None)
    assert (known.verdict, known.probability, known.risk) == (CONFORMS, None, None)
    for rule in ("guarded", "probability"):
        error = refusal(lambda rule=rule: Tolerance(LIMIT, "accuracy", rule).judged("A", "um", 14.0, None))
        assert error.code == "no-uncertainty" and "[reference]" in error.remedy


def test_an_error_is_judged_by_its_draws():
    errors = np.random.default_rng(1).normal(0.0, 1.0, 100_000)
    wide, narrow = (Tolerance(limit, "left", "probability").judged_error("ratio", "1", errors) for limit in (2.5, 0.05))
    assert wide.verdict == CONFORMS and wide.probability == pytest.approx(0.98758, abs=0.002)
    assert narrow.verdict == FAILS and narrow.risk == pytest.approx(0.03988, abs=0.003)
    guarded = Tolerance(2.1, "left", "guarded").judged_error("ratio", "1", errors)
    assert guarded.verdict == CONFORMS and guarded.guard_band == pytest.approx(2.0, abs=0.02)
    assert Tolerance(1.9, "left", "guarded").judged_error("ratio", "1", errors).verdict == UNDECIDED
    assert refusal(lambda: Tolerance(1.9, "left", "simple").judged_error("r", "1", errors)).code == "usage"
