"""Priors of an axis that its readings contradict.

The error and the play by position stretch to bear a wrong ratio or play, so that the posterior stays at the prior and
looks content: what the readings say is asked of a model without that prior.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tvsbayes.results.estimates import CONFLICT_LIMIT, conflict_sentence
from tvsbayes.single_axis.axis_mode import find_mode
from tvsbayes.single_axis.axis_model import AxisModel
from tvsbayes.single_axis.axis_parameters import AxisPrior

STRETCHED = {"per_command": "slope", "backlash": "backlash"}
"""Keys of `[axis]` that processes of position can stand in for, with their functionals."""
REMEDY = (
    "check sign and unit of commands (steps or microsteps?) and readings, or state the prior wider or leave it out of "
    "[axis]"
)
DRAWS = 200
"""Of the Laplace approximation, for a value and its sd."""


@dataclass(frozen=True)
class PriorConflict:
    """A prior and what the readings say against it.

    Attributes:
        name: of the parameter.
        value, sd: by the readings without that prior; of a scale, of its posterior. Folder's unit.
        prior: what was stated, or the default.
        stated: whether the prior was stated.
        distance: of the value from the prior's centre, in prior sds; infinite where the prior holds it exactly.
    """

    name: str
    value: float
    sd: float
    prior: AxisPrior
    stated: bool
    distance: float


def prior_conflicts(
    model: AxisModel, w: np.ndarray, stated: Mapping[str, AxisPrior], defaults: Mapping[str, AxisPrior]
) -> tuple[PriorConflict, ...]:
    """Priors that the readings contradict.

    Args:
        model: that was fitted.
        w: coordinates of equal draws of its posterior, shape (n, d).
        stated: entries of `[axis]`.
        defaults: complete priors, as if nothing were stated.
    """
    found = [_of_stretched(model, name, defaults[name]) for name in STRETCHED if name in stated]
    values = model.coordinates.values(w)
    for k, name in enumerate(model.coordinates.names):
        key = name.split(".")[0]
        if key.startswith("wave_"):
            continue
        off = float(w[:, k].mean())
        # That an axis is far better than the default is no fault of what was stated.
        if key not in STRETCHED and (off if key not in stated else abs(off)) > CONFLICT_LIMIT:
            drawn = values[name]
            found.append(
                PriorConflict(name, float(drawn.mean()), float(drawn.std()), model.priors[key], key in stated, abs(off))
            )
    return tuple(conflict for conflict in found if conflict is not None)


def conflict_text(conflict: PriorConflict) -> str:
    """In words: what the readings say, what the prior does, what to do."""
    prior, key = conflict.prior, conflict.name.split(".")[0]
    whose = "of [axis]" if conflict.stated else "by default"
    said = f"`{key} = {{ value = {prior.value:.10g}, u = {prior.u:.6g} }}` {whose}"
    # To the second digit of its u.
    digits = int(np.clip(2 + np.ceil(np.log10(max(abs(conflict.value), 1e-300) / conflict.sd)), 2, 12))
    quantity = f"{conflict.name} = {conflict.value:.{digits}g} (u = {conflict.sd:.2g})"
    return conflict_sentence(quantity, conflict.distance, said, REMEDY)


def _of_stretched(model: AxisModel, name: str, wide: AxisPrior) -> PriorConflict | None:
    """Whether prior and readings, each with its own u, differ beyond reason; None where not, or where none tells."""
    prior = model.priors[name]
    if prior.u >= wide.u or (name == "backlash" and not model.rows.both_sides):
        return None
    alone = AxisModel.of(model.rows, {**model.priors, name: wide}, None, model.coordinates.waves)
    mode = find_mode(alone)
    if mode.missing:
        return None
    rng = np.random.default_rng(0)
    w = rng.multivariate_normal(mode.w, mode.covariance, DRAWS) if len(mode.w) else np.zeros((DRAWS, 0))
    drawn = alone.linear(w).drawn(alone.head(**{STRETCHED[name]: 1.0})[None], rng)[:, 0]
    value, sd = float(drawn.mean()), float(drawn.std())
    off = abs(value - prior.value)
    if off <= CONFLICT_LIMIT * float(np.hypot(prior.u, sd)):
        return None
    return PriorConflict(name, value, sd, prior, True, off / prior.u if prior.u else np.inf)
