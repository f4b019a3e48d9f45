"""Budgets on the page: every column adds up, no relevant input is left out, one result is stated as final."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from msgspec import structs

from tvsbayes.metrology.budget_tables import Source, budget_table
from tvsbayes.metrology.look_budget import Budget
from tvsbayes.report.scanner_sections import budgets_section
from tvsbayes.results.estimates import Estimate
from tvsbayes.results.metrology_tables import BudgetTable

COMMON = {"stop errors of the campaign": 0.80, "play variation": 0.37, "prior of laser_tilt_deg.x": 0.003}
"""Shares of the variance."""


def entry(quantity: str, shares: dict[str, float], u: float = 0.017, estimate: float = 0.029) -> BudgetTable:
    sources = [
        Source(name, "deg", 0.0, u * math.sqrt(share), "B" if name.startswith("prior") else "A", "normal", 40.0, 1.0)
        for name, share in shares.items()
    ]
    return budget_table(quantity, "deg", estimate, u, sources)


PAN = entry("backlash_deg.pan", {**COMMON, "prior of backlash_deg.pan": 0.0012, "prior of tilt_zero_deg": 5e-4})
TILT = entry("backlash_deg.tilt", {**COMMON, "stop errors of the campaign": 0.75, "prior of backlash_deg.tilt": 0.096})


def section(*budgets: BudgetTable, **intervals: tuple[float, float]):
    """The section of a report whose fit has these budgets and intervals, by default theirs, and a point's budget."""
    parameters = {}
    for table in budgets:
        linear = (table.estimate - table.expanded, table.estimate + table.expanded)
        interval = intervals.get(table.quantity.rpartition(".")[2], linear)
        parameters[table.quantity] = Estimate(table.estimate, table.u, interval, 0.3, 0.9)
    fit = SimpleNamespace(summary=SimpleNamespace(named=parameters))
    causes = ("pixel noise", "stop errors of the campaign")
    even = np.full((2, 3), 0.5)
    budget = Budget(causes, np.array([0.5, 0.5]), even, (), np.zeros((0, 3)), np.zeros((0, 0)), np.eye(3), (0.0, 0.0))
    point = structs.replace(TILT, quantity="x of the point", unit="mm")
    shown = SimpleNamespace(budgets=budgets)
    return budgets_section(SimpleNamespace(fit=fit, shown=shown, budget=budget, point=point, range_mm=1000.0))


def columns_of(table) -> dict[str, list[float]]:
    """Printed shares by the head of their column."""
    places = [k for k, head in enumerate(table.columns) if head.startswith("share")]
    return {table.columns[k]: [float(row[k]) for row in table.rows if row[k]] for k in places}


@pytest.mark.parametrize("budgets", [(PAN, TILT), (TILT, PAN), (TILT,)])
def test_every_column_of_shares_adds_up(budgets):
    for table in (section(*budgets).tables[0], section(*budgets).tables[-1]):
        columns = columns_of(table)
        assert columns
        for head, shares in columns.items():
            assert sum(shares) == pytest.approx(100, abs=0.05 * len(shares)), (head, table.rows)


@pytest.mark.parametrize("budgets", [(PAN, TILT), (TILT, PAN)])
def test_an_input_of_one_quantity_alone_has_its_row(budgets):
    table = section(*budgets).tables[0]
    rows = {row[0]: row for row in table.rows}
    of_tilt = table.columns.index("share %, tilt"), table.columns.index("share %, pan")
    cells = rows["prior of the backlash, tilt, deg"]
    assert (cells[of_tilt[0]], cells[of_tilt[1]]) == ("9.6", "")
    others = rows["others, each below 0.5 %"]
    # Of pan: 0.3 of the laser's direction, 0.12 and 0.05 of its own.
    assert (others[of_tilt[0]], others[of_tilt[1]]) == ("0.3", "0.5")
    assert table.rows[-1][0].startswith("correlations") and table.rows[-2][0].startswith("others")


def test_an_input_with_a_value_per_quantity_states_both():
    """Stop errors belong to one quantity: its number is not that of another."""
    rows = {row[0]: row for row in section(PAN, TILT).tables[0].rows}
    assert rows["stop errors of the campaign, deg"][2] == "0.015" and rows["play variation, deg"][2] == "0.010"
    wider = entry("backlash_deg.tilt", COMMON, u=0.034)
    rows = {row[0]: row for row in section(PAN, wider).tables[0].rows}
    assert rows["stop errors of the campaign, deg"][2] == "0.015; 0.030"


def test_every_row_with_a_u_names_its_unit():
    """Effects of unit variance are stated in standard deviations."""
    source = Source("stop error pan", "1", 0.0, 1.0, "A", "normal", math.inf, 0.017)
    (table, *_) = section(budget_table("backlash_deg.pan", "deg", 0.5, 0.017, [source])).tables
    assert table.rows[0][0] == "stop error pan, in sds"
    for table in section(PAN, TILT).tables[:1]:
        stated = [row[0] for row in table.rows if row[2]]
        assert len(stated) > 2 and all(name.endswith(", deg") for name in stated)


def test_the_final_result_is_named_once():
    (note,) = (text for text in section(PAN, TILT).text if "first page" in text)
    assert "JCGM 100:2008, clause 5" in note and "at the mode" in note and "where uncertainty comes from" in note


@pytest.mark.parametrize(
    ("budget", "interval", "words"),
    [
        # U = 0.034 about 0.529: ends agree to a rounding, then the half-width or one end does not.
        (structs.replace(PAN, estimate=0.529), (0.4952, 0.5628), ()),
        (structs.replace(PAN, estimate=0.529), (0.4965, 0.5645), ()),
        (structs.replace(PAN, estimate=0.529), (0.484, 0.574), ("first page", "[0.484, 0.574]", "U = 0.045 deg")),
        (structs.replace(PAN, estimate=0.529), (0.500, 0.567), ("first page", "[0.500, 0.567]")),
        # Below zero there is no lost motion.
        (PAN, (0.002, 0.067), ("below 0", "first page", "[0.002, 0.067]")),
    ],
)
def test_a_linear_interval_that_differs_is_remarked_at_its_quantity(budget, interval, words):
    caption = section(budget, pan=interval).tables[0].caption
    assert [word for word in words if word not in caption] == []
    assert ("first page" in caption) == bool(words)
    beside = section(budget, structs.replace(TILT, estimate=0.529), pan=interval).tables[0].caption
    assert beside.count("first page") == bool(words)
    assert ("below 0" in caption) == ("below 0" in words)


def test_notes_of_the_budgets_are_printed_once():
    noted = structs.replace(PAN, notes=("inputs are independent", *PAN.notes))
    items = section(noted, TILT).items
    assert len(items) == len(set(items)) == 2
    assert any("Welch-Satterthwaite" in item and "approximate" in item for item in items)
    assert any(item.startswith("Inputs are independent") for item in items)
