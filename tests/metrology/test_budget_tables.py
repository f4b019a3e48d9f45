"""GUM budgets: the guide's own example, correlations, degrees of freedom."""

from __future__ import annotations

import json
import math

import pytest

from tvsbayes.metrology.budget_tables import CORRELATIONS, Source, budget_table
from tvsbayes.statistics.intervals import coverage_factor


def test_end_gauge_of_the_gum():
    """GUM H.1: u_c = 32 nm with 16 effective degrees of freedom, k_99 = 2.92, U_99 = 93 nm."""
    sources = [
        Source("calibration of the standard", "nm", 50000623.0, 25.0, "B", "normal", 18, 1.0),
        Source("repeated observations", "nm", 215.0, 5.8, "A", "normal", 24, 1.0),
        Source("random effects of the comparator", "nm", 0.0, 3.9, "B", "normal", 5, 1.0),
        Source("systematic effects of the comparator", "nm", 0.0, 6.7, "B", "normal", 8, 1.0),
        Source("difference in expansion coefficients", "nm", 0.0, 2.9, "B", "uniform", 50, 1.0),
        Source("difference in temperatures", "nm", 0.0, 16.6, "B", "uniform", 2, 1.0),
    ]
    u = math.sqrt(sum(s.u**2 for s in sources))
    table = budget_table("length", "nm", 50000838.0, u, sources, probability=0.99)
    assert table.u == pytest.approx(32, abs=0.5)
    assert math.floor(table.dof) == 16
    # The GUM truncates to 16 degrees of freedom; 16.7 here.
    assert table.coverage_factor == pytest.approx(2.92, abs=0.03)
    assert coverage_factor(16, 0.99) == pytest.approx(2.92, abs=0.005)
    assert table.expanded == pytest.approx(93, abs=1.5)
    assert table.rows[0].quantity == "calibration of the standard"
    assert sum(row.share for row in table.rows) == pytest.approx(1.0, abs=1e-12)
    assert table.rows[-1].share == pytest.approx(0.0, abs=1e-12)


def test_correlations_have_a_row_and_shares_sum_to_one():
    """Y = 2 x1 - 3 x2 with r = 0.8: u^2 = 4 + 9 - 2 2 3 0.8 = 3.4 (GUM eq. 16)."""
    sources = [
        Source("x1", "mm", 1.0, 1.0, "A", "normal", 9, 2.0),
        Source("x2", "mm", 2.0, 1.0, "B", "normal", math.inf, -3.0),
        Source("x3", "mm", 0.0, 1e-3, "B", "uniform", math.inf, 1.0),
        Source("x4", "mm", 0.0, 1e-3, "A", "uniform", 3, 1.0),
    ]
    table = budget_table("y", "mm", -4.0, math.sqrt(3.4), sources)
    by_name = {row.quantity: row for row in table.rows}
    assert by_name["x2"].contribution == -3.0
    assert by_name["x1"].share == pytest.approx(4 / 3.4)
    small = table.rows[-2]
    assert small.quantity.startswith("2 further inputs") and small.kind == "A, B"
    assert small.contribution == pytest.approx(math.sqrt(2) * 1e-3)
    assert by_name[CORRELATIONS].share == pytest.approx(1 - 13.000002 / 3.4)
    assert sum(row.share for row in table.rows) == pytest.approx(1.0, abs=1e-12)
    assert table.dof == pytest.approx(3.4**2 / (16 / 9 + 1e-12 / 3))
    assert table.expanded == pytest.approx(table.coverage_factor * table.u)
    document = table.as_json()
    assert [row["dof"] for row in document["rows"] if row["quantity"] == "x2"] == [None]
    json.dumps(document, allow_nan=False)
    assert any("Welch-Satterthwaite" in note for note in table.notes)


def test_known_inputs_give_the_normal_factor():
    table = budget_table("y", "mm", 0.0, 1.0, [Source("x", "mm", 0.0, 1.0, "B", "normal", math.inf, 1.0)])
    assert table.dof is None
    assert table.coverage_factor == pytest.approx(1.959964, abs=1e-6)
    with pytest.raises(ValueError, match="positive"):
        budget_table("y", "mm", 0.0, 0.0, [])
