"""Whether a measured figure conforms to a tolerance: decision rules of ISO 14253-1 and JCGM 106:2012.

The true value is normal about the measured one with its standard uncertainty; a tolerance is the largest value allowed.
Any unit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tvsbayes.errors import InputError

CONFORMS, FAILS, UNDECIDED = "conforms", "does not conform", "undecided"
RULES = ("simple", "guarded", "probability")
"""Decision rules: the value within the limit; within the limit less the guard band; with a probability of 0.95."""
GUARD_DEFAULT = 2.0
"""Guard band of the rule `guarded`, in standard uncertainties: U with k = 2 (ISO 14253-1 allows 1.65 for one limit)."""
CONFORMING_PROBABILITY = 0.95


@dataclass(frozen=True)
class Criterion:
    """A figure or an error against its limit.

    Attributes:
        quantity: the figure, or the quantity whose error is limited.
        limit: largest value allowed, in `unit`.
        unit: unit of the limit.
        probability: probability that the true value is within the limit; None where its uncertainty is not known.
        verdict: "conforms", "does not conform" or "undecided"; of a limit on an error, given as such, "met", "not met"
            or "cannot tell", by the rule "probability".
        rule: one of `RULES`.
        guard_band: width that the rule takes off the limit, in `unit`; None without one.
        risk: specific risk (JCGM 106, 9.3): probability that the verdict is wrong; None where it decides nothing, or
            the uncertainty is not known.
        value, u: measured value and its standard uncertainty; None for an error, known by draws.
    """

    quantity: str
    limit: float
    unit: str
    probability: float | None
    verdict: str
    rule: str = "probability"
    guard_band: float | None = None
    risk: float | None = None
    value: float | None = None
    u: float | None = None


@dataclass(frozen=True)
class Tolerance:
    """A limit as the user gives it.

    Attributes:
        limit: largest value allowed, in the unit of the figure.
        of: name of the figure.
        rule: one of `RULES`.
        guard: guard band of `guarded` in standard uncertainties.
    """

    limit: float
    of: str
    rule: str
    guard: float = GUARD_DEFAULT

    def judged(self, quantity: str, unit: str, value: float, u: float | None) -> Criterion:
        """Judge a measured value with its standard uncertainty, None where it is not known.

        Raises:
            InputError: the rule needs an uncertainty that is not known.
        """
        if u is None and self.rule != "simple":
            raise InputError(
                "no-uncertainty",
                f"--rule {self.rule}: the uncertainty of {quantity} is not known",
                allowed="an uncertainty of the reference or of the readings, or the rule `simple`",
                remedy="state [reference] in campaign.toml, or u in readings.csv; or write --rule simple",
            )
        probability = None if u is None else _within(value, u, self.limit)
        band = self.guard * (u or 0.0) if self.rule == "guarded" else None
        if self.rule == "probability":
            conforms = (probability or 0.0) >= CONFORMING_PROBABILITY
            fails = (probability or 0.0) <= 1 - CONFORMING_PROBABILITY
        else:
            conforms, fails = value <= self.limit - (band or 0.0), value > self.limit + (band or 0.0)
        verdict = CONFORMS if conforms else FAILS if fails else UNDECIDED
        risk = None if probability is None else {CONFORMS: 1 - probability, FAILS: probability}.get(verdict)
        return Criterion(quantity, self.limit, unit, probability, verdict, self.rule, band, risk, value, u)

    def judged_error(self, quantity: str, unit: str, errors: np.ndarray) -> Criterion:
        """Judge an error that is 0 as far as is known, by its draws (n,), against a limit to both sides.

        Raises:
            InputError: the rule `simple` leaves out all that is judged.
        """
        if self.rule == "simple":
            message = "--rule simple: the limit is on an uncertainty, which this rule leaves out"
            raise InputError("usage", message, allowed="guarded, probability", remedy="write --rule probability")
        probability, u = float(np.mean(np.abs(errors) <= self.limit)), float(np.sqrt(np.mean(errors**2)))
        band = self.guard * u if self.rule == "guarded" else None
        conforms = probability >= CONFORMING_PROBABILITY if band is None else band <= self.limit
        fails = probability <= 1 - CONFORMING_PROBABILITY and band is None
        verdict = CONFORMS if conforms else FAILS if fails else UNDECIDED
        risk = {CONFORMS: 1 - probability, FAILS: probability}.get(verdict)
        return Criterion(quantity, self.limit, unit, probability, verdict, self.rule, band, risk, 0.0, u)


def _within(value: float, u: float, limit: float) -> float:
    """Probability that a true value normal about the measured one is at most the limit (JCGM 106, 7.3)."""
    if u <= 0:
        return float(value <= limit)
    return 0.5 * math.erfc((value - limit) / (u * math.sqrt(2)))
