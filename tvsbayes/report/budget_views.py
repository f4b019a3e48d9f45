"""A GUM budget of an axis as a table."""

from __future__ import annotations

from tvsbayes.errors import escaped
from tvsbayes.report.tables import TableView, three_digits, two_digits
from tvsbayes.results.metrology_tables import BudgetTable

BUDGET_WORDS = {
    "effective_per_command": "line through the positions read, mean of both directions",
    "effective_backlash": "mean play over the positions read",
}
"""Results of an axis, by the name of their budget."""


def budget_view(budget: BudgetTable) -> TableView:
    """A budget with its columns by GUM 7.2.7; its caption has the result."""
    rows = []
    for row in budget.rows:
        u = "" if row.u is None else f"{two_digits(row.u)} {row.unit}".removesuffix(" 1")
        dof = "" if row.u is None else "infinite" if row.dof is None else f"{row.dof:.0f}"
        sensitivity = "" if row.sensitivity is None else three_digits(row.sensitivity)
        contribution = "" if row.contribution is None else two_digits(abs(row.contribution))
        rows.append([row.quantity, row.kind, u, dof, sensitivity, contribution, f"{100 * row.share:.1f}"])
    dof = "infinite" if budget.dof is None else f"{budget.dof:.0f}"
    caption = (
        f"{BUDGET_WORDS.get(budget.quantity, budget.quantity)}: {budget.estimate:.10g} {escaped(budget.unit)}, "
        f"u = {two_digits(budget.u)}, effective degrees of freedom {dof}, k = {budget.coverage_factor:.2f}, "
        f"U = {two_digits(budget.expanded)}"
    )
    return TableView(caption, ["source", "type", "u", "dof", "sensitivity", "contribution", "share %"], rows)
