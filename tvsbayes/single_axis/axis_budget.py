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
from tvsbayes.single_axis.axis_iso230 import AXIS_SYMBOLS, figure_parts, target_runs
from tvsbayes.single_axis.axis_model import FLOOR
from tvsbayes.single_axis.axis_rows import AxisRows
from tvsbayes.single_axis.classic_line import ClassicAxis

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
NOISE = ("drift of the zero", "errors of stops", "noise of readings")


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


def noise_covariances(rows: AxisRows, scales: dict[str, float]) -> list[np.ndarray]:
    """Covariances (rows, rows) of drift, stop errors and noise of readings at one draw of the scales."""
    hours = np.cumsum(rows.hours)
    first = np.array([np.flatnonzero(rows.zero == zero)[0] for zero in rows.zero])
    since = hours - hours[first] + rows.hours[first]
    drift = scales["drift_per_root_hour"] ** 2 * np.minimum.outer(since, since) * np.equal.outer(rows.zero, rows.zero)
    forward = 0.5 * (1.0 + rows.side)
    stop = np.sqrt(scales["stop_sd.forward"] ** 2 * forward + scales["stop_sd.backward"] ** 2 * (1.0 - forward))
    held = np.cumsum(rows.redrawn)
    stop_sd = stop[np.searchsorted(held, held)]
    return [
        drift,
        np.outer(stop_sd, stop_sd) * np.equal.outer(held, held),
        np.diag(scales["reading_scale"] ** 2 * rows.variance + (FLOOR * rows.travel) ** 2),
    ]


def _variances(fit: AxisFit, functional: np.ndarray, w: np.ndarray) -> dict[str, float]:
    """Variance of a functional (columns,) by cause at one draw w (1, d)."""
    model, rows = fit.model, fit.rows
    white, factor = model.white(w)[:, 1:], model.prior_factor(w)
    inverse_root = model.whitened_extra(w, np.eye(len(rows.move)))
    loaded = white @ factor
    # Errors of the prior's own normal numbers, and the gain of the readings.
    by_prior = np.linalg.solve(loaded.T @ loaded + np.eye(loaded.shape[1]), factor.T @ functional)
    gain = inverse_root.T @ (loaded @ by_prior)
    variances = {name: float(by_prior[columns] @ by_prior[columns]) for name, (columns, _) in _columns(fit).items()}
    scales = {name: float(values[0]) for name, values in model.coordinates.values(w).items()}
    noise = noise_covariances(rows, scales)
    return variances | {name: float(gain @ v @ gain) for name, v in zip(NOISE, noise, strict=True)}


def _sources(fit: AxisFit, functionals: np.ndarray, unit: str) -> list[Source]:
    """Sources of a quantity with functionals (columns,) or (n, columns)."""
    by_draw = (
        functionals if functionals.ndim == 2 else np.broadcast_to(functionals, (len(fit.w), functionals.shape[-1]))
    )
    total = fit.linear.sd_of(functionals[..., None, :])[:, 0] ** 2
    means = fit.linear.mean_of(functionals[..., None, :])[:, 0]
    variances = []
    for group in np.array_split(np.argsort(total), min(STRATA, len(total))):
        k = group[len(group) // 2]
        parts = _variances(fit, by_draw[k], fit.w[k : k + 1])
        factor = float(total[group].mean() / sum(parts.values()))
        variances.append({part: factor * variance for part, variance in parts.items()})
    kinds = {part: kind for part, (_, kind) in _columns(fit).items()} | dict.fromkeys(NOISE, "A")
    sources = []
    for part, kind in kinds.items():
        each = np.array([variance[part] for variance in variances])
        mean, spread = float(each.mean()), float(each.var(ddof=1)) if len(each) > 1 else 0.0
        # GUM G.3: the relative sd of a variance of nu degrees of freedom is the root of 2 / nu.
        dof = max(2 * mean**2 / spread, 1.0) if spread > 1e-12 * mean**2 and kind == "A" else math.inf
        sources.append(_source(fit, part, kind, math.sqrt(mean), dof, unit))
    return [*sources, Source(SCALES, unit, None, float(means.std()), "A", "sampled posterior", math.inf, 1.0)]


def _source(fit: AxisFit, part: str, kind: str, contribution: float, dof: float, unit: str) -> Source:
    """A row, with the u of its input where that is a single number."""
    u, own_unit = _input(fit, part)
    if not u:
        return Source(part, unit, None, contribution, kind, "normal", dof, 1.0)
    return Source(part, own_unit, None, u, kind, "normal", dof, contribution / u)


def _input(fit: AxisFit, part: str) -> tuple[float, str]:
    """Standard uncertainty and unit of an input; 0 where it is not a single number."""
    reference, unit, values = fit.campaign.reference, fit.campaign.unit, fit.draws
    stated = {
        f"{REFERENCE}u": (reference.u, unit),
        f"{REFERENCE}u_per_unit": (reference.u_per_unit, "1"),
        f"{REFERENCE}expansion_per_K": (reference.expansion_per_K.u, "1/K"),
        f"{REFERENCE}u of readings": (1.0, "its u"),
        "noise of readings": (float(np.sqrt(np.mean(fit.rows.variance))), unit),
    }
    scales = {"drift of the zero": "drift_per_root_hour", "errors of stops": "stop_sd.forward", "homings": "home_sd"}
    scales["error by position"] = "transmission_error"
    if part in scales:
        return (float(np.mean(values[scales[part]])) if scales[part] in values else 0.0), unit
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
    headline = headline_functionals(fit.model, fit.w)
    slope = headline[..., HEADLINE_DRAWS.index("effective_per_command"), :]
    unit, tables = fit.campaign.unit, []
    if line.sd > 0:
        tables.append(_table(fit, "effective_per_command", f"{unit} per command", line, slope))
    if play is not None and play.sd > 0:
        tables.append(_table(fit, "effective_backlash", unit, play, mean_play(fit.model)))
    return (*tables, *_figure_budgets(fit, classic))


def _table(fit: AxisFit, name: str, unit: str, estimate: Estimate, functionals: np.ndarray) -> BudgetTable:
    sources = _sources(fit, functionals, unit)
    return budget_table(name, unit, estimate.value, estimate.sd, sources, notes=(NOTE,))


def _figure_budgets(fit: AxisFit, classic: ClassicAxis) -> Iterator[BudgetTable]:
    """Budgets of E and A, of how they were measured."""
    runs = target_runs(fit.rows).runs
    for name, parts in () if runs is None else figure_parts(runs, fit.rows).items():
        value = (classic.iso230 or {}).get(name)
        if name not in ("systematic", "accuracy") or value is None or not parts.u or parts.u < 1e-9 * value:
            continue
        unit, sources = fit.campaign.unit, []
        for cause, contribution in zip(fit.rows.reference_causes, parts.reference.tolist(), strict=True):
            u, own_unit = _input(fit, f"{REFERENCE}{cause}")
            sources.append(Source(REFERENCE + cause, own_unit, None, u, "B", "normal", math.inf, contribution / u))
        if parts.noise:
            u, own_unit = _input(fit, "noise of readings")
            sources.append(Source("noise of readings", own_unit, None, u, "B", "normal", math.inf, parts.noise / u))
        yield budget_table(f"ISO 230-2 {AXIS_SYMBOLS[name]}", unit, value, parts.u, sources)
