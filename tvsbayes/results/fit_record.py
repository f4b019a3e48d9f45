"""`results/fit.json` as one record: what a fit says, why it can be believed, and what it was made from and by.

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
from dataclasses import asdict, dataclass, fields, replace
from functools import cache
from importlib.metadata import version
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tvsbayes.display import Shown, View
from tvsbayes.errors import escaped, shown
from tvsbayes.files.disk import read_bytes, shipped_data
from tvsbayes.files.documents import JSON_BYTES_MAX, Keys, parse_json
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.results.comparison_record import Gap
from tvsbayes.results.estimates import KEPT_AS, Cause, FitSummary, StopResidual
from tvsbayes.results.metrology_tables import FIGURES, AxisPositioning, BudgetTable
from tvsbayes.results.records import plain, read_record

if TYPE_CHECKING:
    from jsonschema import Draft202012Validator

FIT_FORMAT = "tvsbayes-fit/1"
FIT_FORMATS = (FIT_FORMAT,)
"""Versions of `results/fit.json` that can be read; the schema of each is in `data/schemas`."""
SCHEMA_PROBLEMS = 20
"""Among which the one to name is chosen: a document of another making has thousands."""
PACKAGES = (*("tvsbayes", "jax", "optimistix", "equinox", "emcee", "arviz", "numpy", "scipy"), "opencv-python-headless")
"""Whose versions a result states."""
AGAIN = "run `tvsbayes fit` again"


@dataclass(frozen=True)
class NamedCovariance:
    """Of the draws behind the values; rows and columns of `matrix`, shape (n, n), are `names`, in their units."""

    names: tuple[str, ...]
    matrix: np.ndarray


@dataclass(frozen=True)
class FitEvidence:
    """What reports show of a fit besides its estimates.

    Attributes:
        residuals: stops against the fitted model; some where there are very many.
        residual_causes: whether their deviations depend on depth, direction, N, step phase or time.
        gap: classic minus joint by its terms, deg/step; None without an experiment that tells it.
        budgets: GUM budgets of ratios and backlashes.
        positioning: ISO 230-2-style tables of both axes; empty where the fit must not be used.
    """

    residuals: tuple[StopResidual, ...] = ()
    residual_causes: tuple[Cause, ...] = ()
    gap: dict[str, Gap | None] | None = None
    budgets: tuple[BudgetTable, ...] = ()
    positioning: tuple[AxisPositioning, ...] = ()

    def as_json(self) -> dict[str, object]:
        """Keys of `fit.json`."""
        return plain(self) | {"budgets": [table.as_json() for table in self.budgets]}


@dataclass(frozen=True)
class Provenance:
    """What results were made from and by.

    Attributes:
        inputs: SHA-256 of what the estimate depends on: moves, spots, stereo, rig.
        versions: of Python and `PACKAGES`.
        seed: of everything random.
        command: as it was typed.
    """

    inputs: dict[str, str]
    versions: dict[str, str]
    seed: int
    command: str


def provenance(inputs: Mapping[str, str], seed: int) -> Provenance:
    """Of results that this process makes."""
    versions = {"python": sys.version.split()[0], **{name: version(name) for name in PACKAGES}}
    return Provenance(dict(inputs), versions, seed, shlex.join(["tvsbayes", *sys.argv[1:]]))


def covariance_of_draws(names: Sequence[str], physical: np.ndarray, told: Mapping[str, object]) -> NamedCovariance:
    """Of the columns that were told of; `physical` has shape (draws, names), in the units of the names."""
    told_of = [index for index, name in enumerate(names) if name in told]
    return NamedCovariance(tuple(names[i] for i in told_of), np.cov(physical[:, told_of], rowvar=False))


@dataclass(frozen=True, repr=False)
class FitRecord(Shown):
    """Everything that `results/fit.json` holds.

    Attributes:
        summary: estimates and diagnostics.
        covariance: of the parameters' draws.
        evidence: what reports show besides; None in documents without.
        provenance: inputs, versions, seed, command.
    """

    summary: FitSummary
    covariance: NamedCovariance
    evidence: FitEvidence | None
    provenance: Provenance

    def shown(self) -> View:
        """Its summary, and the number of the results."""
        return replace(self.summary.shown(), title=f"FitRecord {self.results_id}: {self.summary.shown().title}")

    def as_json(self) -> dict[str, object]:
        """The document."""
        evidence = {} if self.evidence is None else self.evidence.as_json()
        head = {"format": FIT_FORMAT, **self.summary.as_json(), "covariance": plain(self.covariance)}
        return {**head, **evidence, **asdict(self.provenance)}

    @property
    def digest(self) -> str:
        """SHA-256 of what the results say, from what and by what: the identity of everything made from them."""
        said = plain([self.summary.estimator, self.summary.effective, self.summary.parameters])
        made = [self.provenance.inputs, self.provenance.versions, self.provenance.seed]
        return hashlib.sha256(json.dumps([said, made], sort_keys=True).encode()).hexdigest()

    @property
    def results_id(self) -> str:
        """Number of these results, the same in every report of them: twelve hexadecimal digits."""
        return self.digest[:12].upper()

    def certificate_id(self, issued: datetime.date, besides: Sequence[str | None]) -> str:
        """Of a certificate of these results that says so much besides: `tvsbayes-` and 32 hexadecimal digits."""
        text = json.dumps([self.digest, issued.isoformat(), *besides])
        return f"tvsbayes-{hashlib.sha256(text.encode()).hexdigest()[:32]}"


@cache
def _fit_validator(version: str) -> Draft202012Validator:
    from jsonschema import Draft202012Validator

    path = shipped_data() / "schemas" / f"fit-{version}.schema.json"
    return Draft202012Validator(json.loads(path.read_text(encoding="utf-8")))


def _schema_problem(values: object, version: str) -> tuple[list[str | int], str] | None:
    """The place that most likely breaks the schema of `fit.json`, as keys and list indices, and what is allowed."""
    from jsonschema.exceptions import best_match

    error = best_match(islice(_fit_validator(version).iter_errors(values), SCHEMA_PROBLEMS))
    if error is None:
        return None
    place, rule = list(error.absolute_path), error.validator_value
    if "propertyNames" in error.absolute_schema_path:
        # jsonschema gives the place of the table whose key is wrong.
        place.append(error.instance)
    match error.validator:
        case "required":
            return [*place, next(name for name in rule if name not in error.instance)], "this key"
        case "additionalProperties":
            known = error.schema.get("properties", {})
            return [*place, next(name for name in error.instance if name not in known)], "no such key"
        case "type":
            return place, rule if isinstance(rule, str) else " or ".join(rule)
        case "const":
            return place, shown(rule)
        case "enum":
            return place, " or ".join(map(shown, rule))
        case other:
            return place, f"{other} {shown(rule)}"


def _check_schema(keys: Keys, version: str) -> None:
    problem = _schema_problem(keys.values, version)
    if problem is None:
        return
    place, allowed = problem
    value: object = keys.values
    for part in place:
        if isinstance(value, list) and isinstance(part, int):
            value = value[part]
        else:
            value = value.get(str(part), "nothing") if isinstance(value, dict) else "nothing"
    # An entry of a list is named by the key of the list.
    *path, key = (part for part in place if isinstance(part, str))
    raise Keys({}, keys.file, keys.text, tuple(path)).refuse(key, "schema", allowed, AGAIN, shown(value))


def _check_agreement(keys: Keys) -> None:
    """What no schema can say: sizes that belong together, names that others stand for."""
    covariance = keys.table("covariance")
    names, matrix = covariance.values["names"], covariance.values["matrix"]
    # The schema has them as lists.
    assert isinstance(names, list) and isinstance(matrix, list)
    if any(len(row) != len(names) for row in [matrix, *matrix]):
        raise covariance.refuse("matrix", "shape", f"{len(names)} rows of {len(names)} numbers", AGAIN)
    keys.integer("seed", 0, 2**63 - 1)
    keys.text_value("command", 20_000)
    for name in ("python", "tvsbayes", *keys.table("versions").values):
        keys.table("versions").text_value(name)


def _summary_keys(keys: Keys) -> Keys:
    """The document's table under the names that `FitSummary` gives to what it holds."""
    values = {KEPT_AS.get(key, key): value for key, value in keys.values.items()} | keys.table("noise").values
    if keys.values["curves"] is not None:
        curves = keys.table("curves")
        along = {}
        for axis, points in curves.table("effective_deg_per_step").values.items():
            assert isinstance(points, list)
            ratios = [{key: of for key, of in point.items() if key in DIRECTIONS} for point in points]
            along[axis] = [{**point, "ratios": of} for point, of in zip(points, ratios, strict=True)]
        values["curves"] = {"ratios": along, "lost_motion": curves.values["lost_motion"]}
    return Keys(values, keys.file, keys.text)


def read_fit(path: Path | str) -> FitRecord:
    """Read `results/fit.json` of any version: what reports and certificates are written from, held to its schema.

    Raises:
        InputError: missing, damaged or of an unknown version, with the key.
    """
    keys = parse_json(read_bytes(Path(path), JSON_BYTES_MAX), escaped(Path(path).name))
    _check_schema(keys, keys.word("format", FIT_FORMATS).removeprefix("tvsbayes-fit/"))
    _check_agreement(keys)
    # Documents of the first tvsbayes hold none; a part of it is none.
    shown_besides = {field.name for field in fields(FitEvidence)} <= set(keys.values)
    record = FitRecord(
        read_record(FitSummary, _summary_keys(keys), AGAIN),
        read_record(NamedCovariance, keys.table("covariance"), AGAIN),
        read_record(FitEvidence, keys, AGAIN) if shown_besides else None,
        read_record(Provenance, keys, AGAIN),
    )
    validation = record.summary.validation
    if validation is not None and not (validation.passed or validation.tests):
        raise keys.refuse("validation", "schema", "the test that failed", AGAIN, "a failure of no test")
    for table in () if record.evidence is None else record.evidence.positioning:
        if table.predicted is not None and set(table.predicted) != set(FIGURES):
            raise keys.refuse("positioning", "schema", ", ".join(FIGURES), AGAIN, "other figures")
    return record
