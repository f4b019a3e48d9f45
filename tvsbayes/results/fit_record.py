"""`results/fit.json` as one record: the estimates of a fit, the evidence for them, and their provenance.

Written from the record and read into it; its JSON form is a contract (`data/schemas/fit-1.schema.json`: keys may be
added within a version, never removed or given another meaning). Units stand in the names.
"""

from __future__ import annotations

import datetime
import hashlib
import json
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, structs

from tvsbayes.display import Shown, View
from tvsbayes.errors import escaped
from tvsbayes.files.disk import read_bytes
from tvsbayes.files.documents import JSON_BYTES_MAX, Keys, parse_json
from tvsbayes.files.packages import UNKNOWN, version_of
from tvsbayes.results.comparison_record import Gap
from tvsbayes.results.estimates import Cause, FitSummary, StopResidual
from tvsbayes.results.metrology_tables import FIGURES, AxisPositioning, BudgetTable
from tvsbayes.results.records import (
    ByDirection,
    ClosedRecord,
    Matrix,
    Record,
    hold_to_schema,
    plain,
    read_record,
    schema_of,
)
from tvsbayes.results.store import AGAIN, fit_id
from tvsbayes.results.tiers import CHAIN

FIT_FORMAT = "tvsbayes-fit/1"
FIT_FORMATS = (FIT_FORMAT,)
"""Versions of `results/fit.json` that can be read; the schema of each is in `data/schemas`."""
type Sha256 = Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]
PACKAGES = (*("tvsbayes", "jax", "optimistix", "equinox", CHAIN, "arviz", "numpy", "scipy"), "opencv-python-headless")
"""Packages whose versions a result states."""


class NamedCovariance(ClosedRecord, frozen=True):
    """Covariance of the draws behind the values; rows and columns of `matrix`, shape (n, n), are `names`."""

    names: Annotated[tuple[str, ...], Meta(min_length=1)]
    matrix: Matrix


class FitEvidence(Record, frozen=True):
    """Evidence of a fit that reports show besides its estimates.

    Attributes:
        residuals: stops against the fitted model; a selection where there are very many.
        residual_causes: whether their deviations depend on depth, direction, N, step phase or time.
        gap: classic minus joint by its terms, deg/step; None without an experiment that determines it.
        budgets: GUM budgets of ratios and backlashes.
        positioning: ISO 230-2-style tables of both axes; empty where the fit must not be used.
    """

    residuals: tuple[StopResidual, ...] = ()
    residual_causes: tuple[Cause, ...] = ()
    gap: ByDirection[Gap | None] | None = None
    budgets: tuple[BudgetTable, ...] = ()
    positioning: tuple[AxisPositioning, ...] = ()


class Provenance(Record, frozen=True):
    """Provenance of results.

    Attributes:
        inputs: SHA-256 of the inputs of the estimate, by file.
        versions: versions of Python and `PACKAGES`; null where a package's metadata are missing.
        seed: seed of all random numbers.
        command: the command as typed.
        fit_id: SHA-256 of the fit that these results are or rest on, without the command; absent in results of 0.3.0
            and earlier.
    """

    inputs: dict[str, Sha256]
    versions: Annotated[dict[str, str | None], Meta(extra_json_schema={"required": ("python", "tvsbayes")})]
    seed: Annotated[int, Meta(ge=0, le=2**63 - 1)]
    command: str
    fit_id: Sha256 | None = None

    @property
    def shown_versions(self) -> dict[str, str]:
        """Versions for people."""
        return {name: version or UNKNOWN for name, version in self.versions.items()}


def provenance(inputs: Mapping[str, str], seed: int, fit: str | None = None) -> Provenance:
    """The provenance of results that this process makes; `fit` is the id of the fit that they rest on."""
    versions = {"python": sys.version.split()[0], **{name: version_of(name) for name in PACKAGES}}
    return Provenance(dict(inputs), versions, seed, shlex.join(["tvsbayes", *sys.argv[1:]]), fit)


def covariance_of_draws(names: Sequence[str], physical: np.ndarray, columns: Mapping[str, object]) -> NamedCovariance:
    """Covariance of the named columns; `physical` has shape (draws, names), in the units of the names."""
    kept = [index for index, name in enumerate(names) if name in columns]
    return NamedCovariance(tuple(names[i] for i in kept), np.cov(physical[:, kept], rowvar=False))


@dataclass(frozen=True, repr=False)
class FitRecord(Shown):
    """The content of `results/fit.json`.

    Attributes:
        summary: estimates and diagnostics.
        covariance: covariance of the parameters' draws.
        evidence: evidence for reports; None in documents without.
        provenance: inputs, versions, seed, command.
    """

    summary: FitSummary
    covariance: NamedCovariance
    evidence: FitEvidence | None
    provenance: Provenance

    def shown(self) -> View:
        """Show the summary and the number of the results."""
        return replace(self.summary.shown(), title=f"FitRecord {self.results_id}: {self.summary.shown().title}")

    def as_json(self) -> dict[str, object]:
        """The document."""
        evidence = {} if self.evidence is None else self.evidence.as_json()
        head = {"format": FIT_FORMAT, **self.summary.as_json(), "covariance": plain(self.covariance)}
        return {**head, **evidence, **self.provenance.as_json()}

    @property
    def digest(self) -> str:
        """The id of the fit: it identifies everything made from it."""
        return self.provenance.fit_id or fit_id(self.as_json())

    def identified(self) -> FitRecord:
        """The record with its id."""
        return replace(self, provenance=structs.replace(self.provenance, fit_id=self.digest))

    @property
    def results_id(self) -> str:
        """Number of these results, the same in all their reports: twelve hexadecimal digits."""
        return self.digest[:12].upper()

    def certificate_id(self, issued: datetime.date, besides: Sequence[str | None]) -> str:
        """Number of a certificate of these results with further entries: `tvsbayes-` and 32 hexadecimal digits."""
        text = json.dumps([self.digest, issued.isoformat(), *besides])
        return f"tvsbayes-{hashlib.sha256(text.encode()).hexdigest()[:32]}"


class FitInputs(ClosedRecord, frozen=True):
    """SHA-256 of the inputs of a fit."""

    moves: Sha256
    spots: Sha256
    stereo: Sha256
    rig: Sha256


@cache
def fit_schema() -> dict[str, Any]:
    """The JSON schema of `results/fit.json`."""
    parts = (FitSummary, FitEvidence, Provenance)
    covariance, made_of = NamedCovariance, FitInputs
    return schema_of(*parts, closed=True, format={"const": FIT_FORMAT}, covariance=covariance, inputs=made_of)


def _check_agreement(keys: Keys) -> None:
    """Check what a schema cannot express: sizes that must match, names that must refer to others."""
    covariance = keys.table("covariance")
    names, matrix = covariance.values["names"], covariance.values["matrix"]
    # The schema declares them as lists.
    assert isinstance(names, list) and isinstance(matrix, list)
    if any(len(row) != len(names) for row in [matrix, *matrix]):
        raise covariance.refuse("matrix", "shape", f"{len(names)} rows of {len(names)} numbers", AGAIN)


def read_fit(path: Path | str) -> FitRecord:
    """Read `results/fit.json` of any version, checked against its schema: the source of reports and certificates.

    Raises:
        InputError: missing, damaged or of an unknown version, with the key.
    """
    return fit_of(parse_json(read_bytes(Path(path), JSON_BYTES_MAX), escaped(Path(path).name)))


def fit_of(keys: Keys) -> FitRecord:
    """The record of a document; errors as of `read_fit`."""
    keys.word("format", *FIT_FORMATS)
    hold_to_schema(keys, fit_schema(), AGAIN)
    _check_agreement(keys)
    # Documents of the first tvsbayes have no evidence; an incomplete one counts as none.
    shown_besides = set(FitEvidence.__struct_fields__) <= set(keys.values)
    record = FitRecord(
        read_record(FitSummary, keys, AGAIN, held=True),
        read_record(NamedCovariance, keys.table("covariance"), AGAIN, held=True),
        read_record(FitEvidence, keys, AGAIN, held=True) if shown_besides else None,
        read_record(Provenance, keys, AGAIN, held=True),
    )
    validation = record.summary.validation
    if validation is not None and not (validation.passed or validation.tests):
        raise keys.refuse("validation", "schema", "the test that failed", AGAIN, "a failure of no test")
    for table in () if record.evidence is None else record.evidence.positioning:
        if table.predicted is not None and set(table.predicted) != set(FIGURES):
            raise keys.refuse("positioning", "schema", ", ".join(FIGURES), AGAIN, "other figures")
    return record
