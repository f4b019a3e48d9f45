"""Uncertainty budgets of an axis by the GUM: what u of the line, of the play and of ISO 230-2's figures consists of.

Given the scales, the posterior of a linear quantity f is normal, and its variance is exactly a sum over causes: with
the gain G of the readings, G V G' of each kind of noise V, and (f - G X) S (f - G X)' of each block S of the prior. It
is averaged over the draws of the scales (formulation 8.6). Unit of the readings.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from tvsbayes.metrology.budget_tables import Source, budget_table
from tvsbayes.results.estimates import Estimate
from tvsbayes.results.metrology_tables import BudgetTable
from tvsbayes.single_axis.axis_density import HEADLINE_DRAWS, headline_functionals, mean_play
from tvsbayes.single_axis.axis_fit import AxisFit
from tvsbayes.single_axis.axis_model import noise_covariances
from tvsbayes.single_axis.classic_line import AXIS_SYMBOLS, ClassicAxis, figure_parts, target_runs

STRATA = 24
"""Groups of draws of like variance; one of each is taken apart, at the exact mean variance of its group."""
ROWS_MAX = 400
"""Largest number of rows of a budget: the noise is worked out row by row."""
NOTE = "variances given the scales of the model, averaged over their posterior; degrees of freedom by GUM G.3"
SCALES = "scales of the model, which move the estimate"
REFERENCE = "reference, "
BLOCKS = {
    "homed": ("homings", "A"),
    "unknown": ("unknown side of first stops", "B"),
    "waves": ("waves", "A, B"),
    "error": ("error by position", "A"),
    "play": ("play by position", "A"),
}
"""Name and kind (GUM 4.2, 4.3) of the blocks of columns; line, shifts and reference have a name each column."""
LINE = ("offset", "ratio per command", "contrast of the directions", "backlash")
NOISE = {"drift": "drift of the zero", "stops": "errors of stops", "readings": "noise of readings"}
"""Name by the cause in `noise_covariances`."""
SCALE_OF = {
    "drift of the zero": "drift_per_root_hour",
    "errors of stops": "stop_sd.forward",
    "homings": "home_sd",
    "error by position": "transmission_error",
}
"""The scale that is the input of a part."""


def _columns(fit: AxisFit) -> dict[str, tuple[list[int], str]]:
    """Columns and kind of every part of the prior."""
    model, parts = fit.model, {}
    for block, columns in model.layout.items():
        numbers = list(range(columns.start, columns.stop))
        if block in BLOCKS:
            name, kind = BLOCKS[block]
            parts[f"prior of {name}" if block == "waves" else name] = (numbers, kind)
            continue
        names = {"line": LINE, "shifts": model.shifts, "reference": fit.rows.reference_causes}[block]
        start = REFERENCE if block == "reference" else "prior of "
        parts |= {f"{start}{name}": ([number], "B") for name, number in zip(names, numbers, strict=True)}
    return {name: part for name, part in parts.items() if part[0]}


def _variances(fit: AxisFit, functionals: np.ndarray, w: np.ndarray) -> dict[str, np.ndarray]:
    """Variances (n,) by cause of functionals (n, columns) at draws w (n, d)."""
    model, rows = fit.model, fit.rows
    white, factor = model.white(w, np.eye(len(rows.move))), model.prior_factor(w)
    loaded, inverse_root = white[:, :, 1 : 1 + model.columns] @ factor, white[:, :, 1 + model.columns :]
    # Errors of the prior's own normal numbers, and the gain of the readings.
    information = np.swapaxes(loaded, 1, 2) @ loaded + np.eye(model.columns)
    by_prior = np.linalg.solve(information, np.swapaxes(factor, 1, 2) @ functionals[..., None])
    gain = (np.swapaxes(inverse_root, 1, 2) @ (loaded @ by_prior))[..., 0]
    variances = {name: np.sum(by_prior[:, columns] ** 2, axis=(1, 2)) for name, (columns, _) in _columns(fit).items()}
    readings = rows.zero, np.cumsum(rows.redrawn), rows.since_homing, rows.side, rows.variance
    noise = noise_covariances(model.coordinates.values(w), rows, *readings)
    by_noise = {name: np.einsum("ni,nij,nj->n", gain, noise[cause], gain) for cause, name in NOISE.items()}
    return variances | by_noise


def _sources(fit: AxisFit, functionals: np.ndarray, unit: str) -> list[Source]:
    """Sources of a quantity with functionals (columns,) or (n, columns)."""
    by_draw = np.broadcast_to(functionals, (len(fit.w), functionals.shape[-1]))
    total = fit.linear.sd_of(functionals[..., None, :])[:, 0] ** 2
    means = fit.linear.mean_of(functionals[..., None, :])[:, 0]
    groups = np.array_split(np.argsort(total), min(STRATA, len(total)))
    chosen = [group[len(group) // 2] for group in groups]
    parts = _variances(fit, by_draw[chosen], fit.w[chosen])
    factor = np.array([total[group].mean() for group in groups]) / sum(parts.values())
    kinds = {part: kind for part, (_, kind) in _columns(fit).items()} | dict.fromkeys(NOISE.values(), "A")
    sources = []
    for part, kind in kinds.items():
        each = factor * parts[part]
        mean, spread = float(each.mean()), float(each.var(ddof=1)) if len(each) > 1 else 0.0
        # GUM G.3: the relative sd of a variance of nu degrees of freedom is the root of 2 / nu.
        dof = max(2 * mean**2 / spread, 1.0) if spread > 1e-12 * mean**2 and kind == "A" else math.inf
        contribution, (u, own_unit) = math.sqrt(mean), _input(fit, part)
        if not u:
            # Its input is no single number.
            u, own_unit = contribution, unit
        sources.append(Source(part, own_unit, None, u, kind, "normal", dof, contribution / u if u else 1.0))
    return [*sources, Source(SCALES, unit, None, float(means.std()), "A", "sampled posterior", math.inf, 1.0)]


def _input(fit: AxisFit, part: str) -> tuple[float, str]:
    """Standard uncertainty and unit of an input; 0 where it is not a single number."""
    reference, unit = fit.campaign.reference, fit.campaign.unit
    stated = {
        f"{REFERENCE}u": (reference.u, unit),
        f"{REFERENCE}u_per_unit": (reference.u_per_unit, "1"),
        f"{REFERENCE}expansion_per_K": (reference.expansion_per_K.u, "1/K"),
        f"{REFERENCE}u of readings": (1.0, "its u"),
        "noise of readings": (float(np.sqrt(np.mean(fit.rows.variance))), unit),
    }
    if (scale := fit.draws.get(SCALE_OF.get(part, ""))) is not None:
        return float(np.mean(scale)), unit
    return stated.get(part, (0.0, ""))


def axis_budgets(fit: AxisFit, line: Estimate, play: Estimate | None, classic: ClassicAxis) -> tuple[BudgetTable, ...]:
    """Budgets of the line through the positions read, of the play, and of ISO 230-2's figures.

    None for a drive that never stops, or with too many rows; a quantity that is stated exactly has none.

    Args:
        fit: the fit.
        line: its mean slope.
        play: its mean play over the positions read.
        classic: its classic estimate.
    """
    if fit.rows.in_motion or len(fit.rows.move) > ROWS_MAX or not len(fit.w):
        return ()
    slope = headline_functionals(fit.model, fit.w)[..., HEADLINE_DRAWS.index("effective_per_command"), :]
    unit = fit.campaign.unit
    wanted = [("effective_per_command", f"{unit} per command", line, slope)]
    wanted += [] if play is None else [("effective_backlash", unit, play, mean_play(fit.model))]
    tables = [
        budget_table(name, its_unit, each.value, each.sd, _sources(fit, functional, its_unit), notes=(NOTE,))
        for name, its_unit, each, functional in wanted
        if each.sd > 0
    ]
    return (*tables, *_figure_budgets(fit, classic))


def _figure_budgets(fit: AxisFit, classic: ClassicAxis) -> Iterator[BudgetTable]:
    """Budgets of E and A, of how they were measured."""
    runs, unit = target_runs(fit.rows).runs, fit.campaign.unit
    for name, parts in () if runs is None else figure_parts(runs, fit.rows).items():
        value = (classic.iso230 or {}).get(name)
        if name not in ("systematic", "accuracy") or value is None or not parts.u or parts.u < 1e-9 * value:
            continue
        causes = [REFERENCE + cause for cause in fit.rows.reference_causes]
        contributions = dict(zip(causes, parts.reference.tolist(), strict=True))
        contributions |= {"noise of readings": parts.noise} if parts.noise else {}
        sources = []
        for cause, contribution in contributions.items():
            u, own_unit = _input(fit, cause)
            sources.append(Source(cause, own_unit, None, u, "B", "normal", math.inf, contribution / u))
        yield budget_table(f"ISO 230-2 {AXIS_SYMBOLS[name]}", unit, value, parts.u, sources)
