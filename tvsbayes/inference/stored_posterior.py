"""A posterior read from `results/`, of any instrument: draws by name, propagated into any quantity.

Needs no model, no fit and no JAX. `fit.json` states what the draws are, `draws.npz` holds them.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from tvsbayes.display import Shown, View
from tvsbayes.errors import NotConverged
from tvsbayes.files.documents import Keys
from tvsbayes.inference.summaries import NamedDraws
from tvsbayes.results.records import AnswerKind
from tvsbayes.results.store import AGAIN, FitFiles, damaged_draws

FORMAT, OLDER = re.compile(r"tvsbayes-(?:[a-z]+-)?fit/1"), re.compile(r"tvsbayes-(?:[a-z]+-)?fit/[0-9]+")
"""Formats of `fit.json` whose draws can be read, of any instrument; formats of any version."""
ANSWERS: tuple[AnswerKind, ...] = ("accepted", "rough", "laplace")
COLUMNS = (("names", "physical"), ("names", "draws"), ("derived_names", "derived"))
"""Arrays of `draws.npz`: names of columns, and the draws."""


@dataclass(frozen=True, repr=False)
class StoredPosterior(NamedDraws, Shown):
    """Draws of a posterior from `results/`; for an axis in the unit of its readings.

    Attributes:
        by_name, weights: as of `NamedDraws`, shape (n,). Repeats of a draw are merged, with the sum of their weights.
        answer: "accepted"; with `anyway` also "rough", or "laplace" for the approximation at the mode.
    """

    by_name: Mapping[str, np.ndarray]
    weights: np.ndarray
    answer: AnswerKind

    def shown(self) -> View:
        """Show means, sds and 95 % intervals."""
        return self.view_of(f"Posterior of {len(self.weights)} stored draws, {self.answer}", tuple(self.by_name))


def posterior_in(files: FitFiles, *, anyway: bool = False) -> StoredPosterior:
    """The draws of a fit by name, from its files; `anyway` takes a rough answer or the Laplace approximation too.

    Raises:
        InputError: they are damaged or of a version that cannot be read.
        NotConverged: the fit has no answer, or none that is accepted.
    """
    keys, kind = files.keys, files.keys.text("format")
    if not FORMAT.fullmatch(kind):
        remedy = "read it with the tvsbayes that wrote it, or fit again" if OLDER.fullmatch(kind) else AGAIN
        raise keys.refuse("format", "format", "a fit of version 1, such as tvsbayes-fit/1", remedy)
    answer = answer_of(keys)
    if answer != "accepted" and not anyway:
        what = "a rough answer" if answer == "rough" else "the Laplace approximation at the mode, no sample"
        message = f"results/fit.json: the fit is {what}: its intervals are not accepted"
        remedy = "run `tvsbayes fit` without --no-sample or --quick; or load it with anyway=True and say so"
        raise NotConverged("unaccepted", message, remedy=remedy)
    return _merged(_draws(files.arrays), answer)


def answer_of(keys: Keys) -> AnswerKind:
    """Return the answer of a fit by its `fit.json`.

    Raises:
        NotConverged: the fit found no mode that explains the data.
    """
    if not keys.flag("converged"):
        remedy = "see the message of `tvsbayes fit`, correct the fault and fit again"
        raise NotConverged(
            "not-converged", "results/fit.json: the fit has not converged: no draw of it counts", remedy=remedy
        )
    if keys.values.get("answer") is None:
        # Up to 0.2.0 a converged sample was accepted.
        return "accepted" if keys.word("estimator", "posterior", "laplace") == "posterior" else "laplace"
    return ANSWERS[ANSWERS.index(keys.word("answer", *ANSWERS))]


def _draws(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return all named columns."""
    draws: dict[str, np.ndarray] = {}
    try:
        for names, values in COLUMNS:
            if names in arrays and values in arrays:
                columns = np.asarray(arrays[values], dtype=float)
                if columns.ndim != 2 or len(columns) < 2 or not np.all(np.isfinite(columns)):
                    raise ValueError(f"{values} of shape {columns.shape}")
                draws |= dict(zip(map(str, arrays[names].tolist()), columns.T, strict=True))
        if not draws or len({len(column) for column in draws.values()}) > 1:
            raise ValueError("no draws by name, or columns of other lengths")
    except (TypeError, ValueError) as error:
        raise damaged_draws(error, "draws by name, finite, as `tvsbayes fit` writes them") from error
    return draws


def _merged(by_name: dict[str, np.ndarray], answer: AnswerKind) -> StoredPosterior:
    """Merge repeated draws of equal weight, which systematic resampling leaves adjacent."""
    rows = np.stack(list(by_name.values()), axis=1)
    first = np.flatnonzero(np.r_[True, np.any(rows[1:] != rows[:-1], axis=1)])
    weights = np.diff(np.r_[first, len(rows)]) / len(rows)
    kept = MappingProxyType({name: column[first] for name, column in by_name.items()})
    return StoredPosterior(kept, weights, answer)
