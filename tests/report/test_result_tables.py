"""Tables that texts and the page share."""

from __future__ import annotations

from support.small_results import estimate

from tvsbayes.report.result_tables import estimate_row


def test_rows_say_whether_data_or_prior_set_a_value():
    assert estimate_row("x", estimate(0.5, 0.01), "deg") == ["x, deg", "0.500(10)", "[0.480, 0.520]", "data"]
    assert estimate_row("x", estimate(0.5, 0.01, 0.09), "deg")[-1] == "prior"
    assert estimate_row("x", estimate(0.5, 0.0, None), "deg")[-1] == "fixed"
    assert estimate_row("x", None, "deg")[1] == "never moved"
