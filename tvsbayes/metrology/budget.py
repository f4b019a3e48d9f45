"""What a metrologist signs under: ISO 230-2-style figures, GUM uncertainty budgets, a DCC-schema XML.

Beam angles in degrees, about the axis that turns (azimuth for pan, elevation for tilt); counters in steps; mm where a
name says so. Nothing is fitted here: fits, calibrations and `results/fit.json` come in, results and bytes go out.
No JAX.

Clause numbers 2.11 to 2.20 of ISO 230-2:2006 are those that an independent implementation carries; neither edition's
text was at hand, and further definitions have no number here (research/report.md section 3). GUM = JCGM 100:2008.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from tvsbayes.calibration.pointing import INPUT_NAMES, Calibration
from tvsbayes.instrument.parameters import unit_of
from tvsbayes.statistics.intervals import coverage_factor, effective_dof

PROBABILITY = 0.95


@dataclass(frozen=True)
class Source:
    """An input quantity of a budget.

    Attributes:
        quantity, unit: its name and the unit of estimate and u; unit "1" for a standardised effect.
        estimate: its value, None where it is no single quantity.
        u: standard uncertainty.
        kind: "A" by statistics of the campaign, "B" otherwise (GUM 4.2, 4.3), "A, B" for a parameter fitted from both.
        distribution: from which u comes.
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


@dataclass(frozen=True)
class BudgetRow:
    """A line of a budget; fields as in `Source`, None where a line sums up several or is the correlation row.

    `contribution` is sensitivity times u, signed, in the unit of the result; `share` is of the combined variance and
    negative where correlations take variance away.
    """

    quantity: str
    unit: str
    estimate: float | None
    u: float | None
    kind: str
    distribution: str
    dof: float | None
    sensitivity: float | None
    contribution: float | None
    share: float


@dataclass(frozen=True)
class BudgetTable:
    """A GUM uncertainty budget.

    Attributes:
        quantity, unit: of the result.
        estimate: the result.
        rows: largest contribution first; the last one is `CORRELATIONS`, so that the shares sum to 1.
        u: combined standard uncertainty (GUM 5.1.2, 5.2.2).
        dof: effective degrees of freedom (GUM eq. G.2b), infinite where no input's are finite.
        coverage_factor: k = t_p(dof) (GUM G.4.1).
        probability: coverage probability p.
        expanded: U = k u.
        notes: what the reader must know.
    """

    quantity: str
    unit: str
    estimate: float
    rows: tuple[BudgetRow, ...]
    u: float
    dof: float
    coverage_factor: float
    probability: float
    expanded: float
    notes: tuple[str, ...]

    def as_json(self) -> dict[str, object]:
        """Infinite degrees of freedom become null."""

        def finite(entry: dict[str, object]) -> dict[str, object]:
            dof = entry["dof"]
            return {**entry, "dof": None if dof is None or math.isinf(dof) else dof}

        document = finite(asdict(self))
        return {**document, "rows": [finite(row) for row in document["rows"]], "notes": list(self.notes)}


CORRELATIONS = "correlations, and what linear propagation leaves"
SMALL_SHARE = 1e-3
"""Inputs below this share of the variance are summed up in one line."""
INDEPENDENCE = (
    "effective degrees of freedom by Welch-Satterthwaite (GUM G.4.1), which takes the inputs as independent: with a "
    "large correlation row they are approximate"
)


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
    """Assemble a budget.

    Args:
        quantity: name of the result.
        unit: its unit.
        estimate: its value.
        u: its combined standard uncertainty, correlations and all: what the rows do not reach is the correlation row.
        sources: input quantities.
        probability: of U.
        notes: put before the standing one.

    Returns:
        The table.

    Raises:
        ValueError: u is not positive, or a number is not finite.
    """
    contributions = [s.sensitivity * s.u for s in sources]
    if not (u > 0 and math.isfinite(u) and all(map(math.isfinite, (estimate, *contributions)))):
        raise ValueError(f"{quantity}: a budget needs finite contributions and a positive uncertainty, not {u}")
    shares = [(c / u) ** 2 for c in contributions]
    rows, small = [], []
    for source, contribution, share in sorted(zip(sources, contributions, shares, strict=True), key=lambda x: -x[2]):
        if share < SMALL_SHARE:
            small.append((source, contribution, share))
        else:
            rows.append(BudgetRow(**vars(source), contribution=contribution, share=share))
    if small:
        kinds = sorted({kind for source, _, _ in small for kind in source.kind.split(", ")})
        several = (f"{len(small)} further inputs, each below {100 * SMALL_SHARE:g} %", "", None, None, ", ".join(kinds))
        together = math.sqrt(sum(c**2 for _, c, _ in small))
        rows.append(BudgetRow(*several, "", None, None, together, sum(share for _, _, share in small)))
    rows.append(BudgetRow(CORRELATIONS, "", None, None, "", "", None, None, None, 1 - sum(shares)))
    dof = effective_dof(u, contributions, [s.dof for s in sources])
    k = coverage_factor(dof, probability)
    return BudgetTable(quantity, unit, estimate, tuple(rows), u, dof, k, probability, k * u, (*notes, INDEPENDENCE))


_UNIT_NOISES = {
    "stop error pan": ("A", "normal", 1.0),
    "stop error tilt": ("A", "normal", 1.0),
    "place in the play, pan": ("B", "uniform", 12**-0.5),
    "place in the play, tilt": ("B", "uniform", 12**-0.5),
    "aperture noise": ("B", "normal", 1.0),
}
"""Noises of one look, as `coordinates` carries them: in units of their own scale."""


def coordinate_budget(
    budget: Budget, calibration: Calibration, xyz_mm: Sequence[float], component: str, *, by: str = "parameter"
) -> BudgetTable:
    """The budget of x, y or z of one located point.

    Args:
        budget: of `comparison.budget`.
        calibration: behind it.
        xyz_mm: the point, frame T, mm.
        component: "x", "y" or "z".
        by: "parameter": every parameter of the calibration and noise of the look, which are correlated; "cause": what
            its uncertainty comes from, independent.

    Raises:
        ValueError: another component or kind.
    """
    if component not in ("x", "y", "z") or by not in ("parameter", "cause"):
        raise ValueError(f"component {component!r} by {by!r}; allowed: x, y, z by parameter or cause")
    index = "xyz".index(component)
    u = math.sqrt(float(budget.covariance_mm2[index, index]))
    sources = []
    if by == "cause":
        notes = ("by cause; the causes are independent",)
        for name, variance in zip(budget.causes, budget.variance_mm2[:, index].tolist(), strict=True):
            noise = name.startswith(("pixel", "stop error"))
            sources.append(
                Source(name, "mm", None, math.sqrt(variance), "A" if noise else "B", "normal", math.inf, 1.0)
            )
    else:
        notes = ("by parameter; parameters fitted together are correlated (GUM 5.2.2)",)
        sd = np.sqrt(np.diag(calibration.covariance)).tolist()
        known = {
            n: (unit_of(n), e, s, "A, B", "normal") for (n, e), s in zip(calibration.estimates.items(), sd, strict=True)
        }
        for name, moved in zip(budget.parameters, budget.contribution_mm[:, index].tolist(), strict=True):
            if name in known:
                unit, estimate, width, kind, shape = known[name]
            else:
                (kind, shape, width), unit, estimate = _UNIT_NOISES[name], "1", 0.0
            if width > 0:
                sources.append(Source(name, unit, estimate, width, kind, shape, math.inf, moved / width))
    return budget_table(f"{component} of the point", "mm", float(xyz_mm[index]), u, sources, notes=notes)


STOP_HERE, APERTURE_HERE, PLAY_HERE = "stop error here", "aperture noise here", "unknown approach here"
"""Causes that belong to the one look and not to the calibration."""


@dataclass(frozen=True)
class Budget:
    """What the variance of one point consists of, by the law of propagation.

    Attributes:
        causes: pixel noise, stop errors of the campaign, stereo calibration, focal scale, every prior, and what this
            one look adds.
        share: of the total variance (sum over x, y, z), shape (causes,); sums to 1.
        variance_mm2: by cause and coordinate, shape (causes, 3).
        parameters: names of the inputs and of this look's noises.
        contribution_mm: sensitivity times standard uncertainty, shape (parameters, 3).
        correlation: of the parameters, shape (parameters, parameters); their contributions do not add up without it.
        covariance_mm2: of the point, shape (3, 3).
    """

    causes: tuple[str, ...]
    share: np.ndarray
    variance_mm2: np.ndarray
    parameters: tuple[str, ...]
    contribution_mm: np.ndarray
    correlation: np.ndarray
    covariance_mm2: np.ndarray

    def as_json(self) -> dict[str, object]:
        """Causes with share and standard uncertainty, parameters with signed contributions and correlations."""
        u = np.sqrt(self.variance_mm2)
        return {
            "causes": [
                {"cause": name, "share": float(share), "u_mm": row.tolist()}
                for name, share, row in zip(self.causes, self.share, u, strict=True)
            ],
            "parameters": [
                {"name": name, "contribution_mm": row.tolist()}
                for name, row in zip(self.parameters, self.contribution_mm, strict=True)
            ],
            "correlation": self.correlation.tolist(),
        }


def budget(
    calibration: Calibration,
    pan_steps: float,
    tilt_steps: float,
    aperture_deg: float,
    approach: tuple[str, str] = ("left", "up"),
) -> Budget:
    """The uncertainty budget of one point (GUM 7.2.7 asks for it): by cause, and by parameter with correlations.

    Args:
        calibration: with causes, as a fit keeps them.
        pan_steps: absolute counter.
        tilt_steps: absolute counter.
        aperture_deg: reading B.
        approach: last move of (pan, tilt): left or right, up or down, or unknown.

    Raises:
        ValueError: a calibration that does not know its causes.
        InputError: an approach that does not exist, or beam and line of sight do not meet.
    """
    if not calibration.causes:
        raise ValueError("this calibration does not know its causes: fit the campaign again")
    jacobian = calibration.derivatives(pan_steps, tilt_steps, aperture_deg, approach)
    covariance = calibration.covariance_with_noise
    count = len(INPUT_NAMES)
    calibrated, here = jacobian[:, :count], jacobian[:, count:]
    by_cause = [np.einsum("ij,jk,ik->i", calibrated, c, calibrated) for c in calibration.cause_covariance]
    own = here**2 * np.diag(covariance)[count:]
    by_cause += [own[:, :2].sum(axis=1), own[:, 2:4].sum(axis=1), own[:, 4]]
    variance = np.array(by_cause)
    u = np.sqrt(np.diag(covariance))
    # What does not vary correlates with nothing.
    safe = np.where(u > 0, u, 1.0)
    noises = (
        "stop error pan",
        "stop error tilt",
        "place in the play, pan",
        "place in the play, tilt",
        "aperture noise",
    )
    return Budget(
        causes=(*calibration.causes, STOP_HERE, PLAY_HERE, APERTURE_HERE),
        share=variance.sum(axis=1) / variance.sum(),
        variance_mm2=variance,
        parameters=(*INPUT_NAMES, *noises),
        contribution_mm=(jacobian * u).T,
        correlation=covariance / np.outer(safe, safe),
        covariance_mm2=jacobian @ covariance @ jacobian.T,
    )
