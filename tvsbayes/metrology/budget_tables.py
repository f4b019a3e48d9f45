"""Uncertainty budgets by the GUM: input quantities, their contributions, effective degrees of freedom, U.

Any unit, stated in each row. GUM = JCGM 100:2008.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from tvsbayes.results.metrology_tables import BudgetRow, BudgetTable
from tvsbayes.statistics.intervals import coverage_factor, effective_dof

PROBABILITY = 0.95


@dataclass(frozen=True)
class Source:
    """An input quantity of a budget.

    Attributes:
        quantity, unit: its name and the unit of estimate and u; unit "1" for a standardised effect.
        estimate: its value, None where it is not a single quantity.
        u: standard uncertainty.
        kind: "A" by statistics of the campaign, "B" otherwise (GUM 4.2, 4.3), "A, B" for a parameter fitted from both.
        distribution: distribution of u.
        dof: degrees of freedom of u (GUM G.4), infinite where it is taken as known.
        sensitivity: change of the result per unit of the quantity.
    """

    quantity: str
    unit: str
    estimate: float | None
    u: float
    kind: str
    distribution: str
    dof: float
    sensitivity: float


CORRELATIONS = "correlations, and what linear propagation leaves"
SMALL_SHARE = 1e-3
"""Inputs below this share of the variance are summed up in one line."""
INDEPENDENCE = (
    "effective degrees of freedom by Welch-Satterthwaite (GUM G.4.1), which takes the inputs as independent: with a "
    "large correlation row they are approximate"
)


def _finite(dof: float) -> float | None:
    return dof if math.isfinite(dof) else None


def budget_table(
    quantity: str,
    unit: str,
    estimate: float,
    u: float,
    sources: Sequence[Source],
    *,
    probability: float = PROBABILITY,
    notes: Sequence[str] = (),
) -> BudgetTable:
    """Assemble a budget of a result: largest inputs first, small ones together, correlations as what is left of u.

    Args:
        quantity: name of the result.
        unit: its unit.
        estimate: its value.
        u: its combined standard uncertainty, correlations included.
        sources: input quantities.
        probability: coverage probability of U.
        notes: notes before the default one.

    Raises:
        ValueError: u is not positive, or a number is not finite.
    """
    parts = sorted(((s, s.sensitivity * s.u) for s in sources), key=lambda part: -(part[1] ** 2))
    if not (u > 0 and math.isfinite(u) and all(map(math.isfinite, (estimate, *(c for _, c in parts))))):
        raise ValueError(f"{quantity}: a budget needs finite contributions and a positive uncertainty, not {u}")
    large = [(s, c) for s, c in parts if (c / u) ** 2 >= SMALL_SHARE]
    rows = [BudgetRow(**vars(s) | {"dof": _finite(s.dof)}, contribution=c, share=(c / u) ** 2) for s, c in large]
    if small := parts[len(large) :]:
        kinds = ", ".join(sorted({kind for s, _ in small for kind in s.kind.split(", ")}))
        together, name = math.hypot(*(c for _, c in small)), f"{len(small)} further inputs, each below"
        several = (f"{name} {100 * SMALL_SHARE:g} %", "", None, None, kinds, "", None, None)
        rows.append(BudgetRow(*several, together, (together / u) ** 2))
    rest = 1 - sum((c / u) ** 2 for _, c in parts)
    rows.append(BudgetRow(CORRELATIONS, "", None, None, "", "", None, None, None, rest))
    dof = effective_dof(u, [c for _, c in parts], [s.dof for s, _ in parts])
    k = coverage_factor(dof, probability)
    remarks = (*notes, INDEPENDENCE)
    return BudgetTable(quantity, unit, estimate, tuple(rows), u, _finite(dof), k, probability, k * u, remarks)
