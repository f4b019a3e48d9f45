"""Limits with their verdicts: the table of a page, lines of a terminal, the class of a verdict's colour."""

from __future__ import annotations

from collections.abc import Sequence

from tvsbayes.metrology.conformity import CONFORMS, FAILS, UNDECIDED, Criterion
from tvsbayes.report.evidence import MET, NOT_MET
from tvsbayes.report.tables import TableView, chance_text, three_digits, two_digits
from tvsbayes.results.comparison_record import CANNOT_TELL

WORST_FIRST = (FAILS, NOT_MET, UNDECIDED, CANNOT_TELL, CONFORMS, MET)
COLOUR = {
    **dict.fromkeys((FAILS, NOT_MET), "not-met"),
    **dict.fromkeys((UNDECIDED, CANNOT_TELL), "cannot-tell"),
    **dict.fromkeys((CONFORMS, MET), "met"),
}
"""Class of a verdict on the page."""


def criterion_text(c: Criterion) -> str:
    """A limit with its verdict, as a line."""
    chance = "" if c.probability is None else f"probability {chance_text(c.probability)}"
    if c.value is None:
        return f"{c.quantity} within {c.limit:g} {c.unit}: {c.verdict} ({chance})"
    words = [f"rule {c.rule}"]
    words += [] if c.guard_band is None else [f"guard band {two_digits(c.guard_band)} {c.unit}"]
    words += [text for text in (chance,) if text]
    words += [] if c.risk is None else [f"risk {chance_text(c.risk)}"]
    u = "" if not c.u else f", u = {two_digits(c.u)}"
    measured = f" {three_digits(c.value)} {c.unit}{u}:" if c.value else ""
    return f"{c.quantity}:{measured} {c.verdict} to {c.limit:g} {c.unit} ({', '.join(words)})"


def criteria_table(criteria: Sequence[Criterion]) -> TableView | None:
    """Every limit with its verdict and the rule; None where no limit was stated."""
    if not criteria:
        return None
    if all(c.value is None for c in criteria):
        rows = [[c.quantity, f"{c.limit:.3g} {c.unit}", _chance(c), c.verdict] for c in criteria]
        caption = "Decision rule: met if P(|error| <= limit) >= 0.95, not met if <= 0.05, else cannot tell"
        return TableView(caption, ["error of", "limit", "probability", "verdict"], rows)
    rows = [
        [
            c.quantity,
            "" if not c.value else three_digits(c.value),
            "" if not c.u else two_digits(c.u),
            f"{c.limit:.3g} {c.unit}",
            c.rule,
            "" if c.guard_band is None else two_digits(c.guard_band),
            "" if c.probability is None else chance_text(c.probability),
            "" if c.risk is None else chance_text(c.risk),
            c.verdict,
        ]
        for c in criteria
    ]
    caption = "Conformity by ISO 14253-1 and JCGM 106: guard band taken off the limit; risk that the verdict is wrong"
    columns = ["", "measured", "u", "limit", "rule", "guard band", "probability", "risk", "verdict"]
    return TableView(caption, columns, rows)


def _chance(c: Criterion) -> str:
    """The probability; where the verdict is open, also the number in a hundred beyond the limit."""
    probability = c.probability or 0.0
    text = chance_text(probability)
    return text if c.verdict != CANNOT_TELL else f"{text}: {100 - round(100 * probability)} of 100 are off by more"
