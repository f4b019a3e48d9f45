"""Results/ of a fit: fit.json and draws.npz, written and read."""

from __future__ import annotations

import io
import json
import shlex
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tvsbayes.calibration.calibration_file import (
    RESULTS_BYTES_MAX,
    UNPACKED_BYTES_MAX,
    calibration_bytes,
    damaged_calibration,
    stored_calibration,
)
from tvsbayes.calibration.pointing import Calibration
from tvsbayes.errors import escaped, shown
from tvsbayes.files.disk import make_folder, read_arrays, read_bytes, shipped_data, write_atomically
from tvsbayes.files.documents import JSON_BYTES_MAX, Keys, parse_json
from tvsbayes.instrument.campaign import Campaign, input_hashes

if TYPE_CHECKING:
    from tvsbayes.estimators.joint_fit import JointFit
    from tvsbayes.model.headlines import Derived
    from tvsbayes.results.estimates import FitSummary


@dataclass(frozen=True)
class StoredMode:
    """Where a fit ended, as `draws.npz` keeps it: enough to go on without fitting again.

    Attributes:
        names: parameters, in the order of the coordinates.
        z, covariance: mode and Laplace covariance in prior coordinates, shapes (p,) and (p, p).
        log_density: at the mode.
        prior: value and u of every parameter of the rig that the fit used, shape (2, r).
        valid, weight: whether each spot, in the order of the fit, was used, and its weight; shape (spots,).
    """

    names: tuple[str, ...]
    z: np.ndarray
    covariance: np.ndarray
    log_density: float
    prior: np.ndarray
    valid: np.ndarray
    weight: np.ndarray


_MODE_ARRAYS = ("z", "covariance", "prior", "valid", "weight")


def mode_arrays(mode: StoredMode) -> dict[str, np.ndarray]:
    """The arrays of `draws.npz` that `stored_mode` reads back; the names stand there already."""
    return {f"mode_{name}": getattr(mode, name) for name in _MODE_ARRAYS} | {
        "mode_log_density": np.array(mode.log_density)
    }


def stored_mode(campaign: Campaign) -> StoredMode | None:
    """Where the fit in `results/` ended, if it was made from exactly these data and priors, and converged.

    Raises:
        InputError: there are results, but damaged.
    """
    if stored_calibration(campaign) is None:
        return None
    path = campaign.path / "results" / "draws.npz"
    try:
        file = read_arrays(path, RESULTS_BYTES_MAX, UNPACKED_BYTES_MAX)
        if "mode_z" not in file:
            return None
        found = {name: np.array(file[f"mode_{name}"], dtype=float) for name in (*_MODE_ARRAYS, "log_density")}
        names = tuple(file["names"].tolist())
        count, spots = len(names), sum(spot.status == "ok" for spot in campaign.spots)
        shapes = {"z": (count,), "covariance": (count, count), "valid": (spots,), "weight": (spots,), "log_density": ()}
        if any(found[name].shape != shape for name, shape in shapes.items()) or found["prior"].shape[:1] != (2,):
            raise ValueError("a mode of another shape")
        if not all(np.isfinite(array).all() for array in found.values()):
            raise ValueError("a mode that is not finite")
        return StoredMode(names, **(found | {"log_density": float(found["log_density"])}))
    except (KeyError, TypeError, ValueError) as error:
        raise damaged_calibration(path, error) from error


FIT_FORMATS = ("tvsbayes-fit/1",)
"""Versions of `results/fit.json` that can be read; the schema of each is in `data/schemas`."""
SCHEMA_PROBLEMS = 20
"""Among which the one to name is chosen: a document of another making has thousands."""


@cache
def _fit_validator(version: str):
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


def _check_agreement(keys: Keys) -> None:
    """What no schema can say: sizes that belong together, names that others stand for."""
    again = "run `tvsbayes fit` again"
    covariance = keys.table("covariance")
    count = len(covariance.values["names"])
    if any(len(row) != count for row in [covariance.values["matrix"], *covariance.values["matrix"]]):
        raise covariance.refuse("matrix", "shape", f"{count} rows of {count} numbers", again)
    keys.integer("seed", 0, 2**63 - 1)
    keys.text_value("command", 20_000)
    for name in ("python", "tvsbayes", *keys.table("versions").values):
        keys.table("versions").text_value(name)


def read_fit(path: Path | str) -> dict[str, object]:
    """Read `results/fit.json` of any version: what reports and certificates are written from, held to its schema.

    Raises:
        InputError: missing, damaged or of an unknown version, with the key.
    """
    keys = parse_json(read_bytes(Path(path), JSON_BYTES_MAX), escaped(Path(path).name))
    version = keys.word("format", FIT_FORMATS).removeprefix("tvsbayes-fit/")
    if problem := _schema_problem(keys.values, version):
        place, allowed = problem
        value: object = keys.values
        for part in place:
            value = value[part] if isinstance(part, int) else value.get(part, "nothing")
        # An entry of a list is named by the key of the list.
        *path, key = (part for part in place if isinstance(part, str))
        table = Keys({}, keys.file, keys.text, tuple(path))
        raise table.refuse(key, "schema", allowed, "run `tvsbayes fit` again", shown(value))
    _check_agreement(keys)
    return keys.values


FIT_FORMAT = "tvsbayes-fit/1"


def fit_document(
    fit: JointFit, summary: FitSummary, seed: int, draws: Derived, evidence: Mapping[str, object] | None = None
) -> dict[str, object]:
    """The content of `results/fit.json` (DESIGN 7): estimates, covariance of `draws` with names, provenance.

    `evidence` adds what reports show besides: residuals by cause, the gap to the classic estimator.
    """
    names = list(summary.parameters)
    packages = ("tvsbayes", "jax", "optimistix", "equinox", "emcee", "arviz", "numpy", "scipy")
    packages += ("opencv-python-headless",)
    estimated = [index for index, name in enumerate(fit.names) if name in names]
    covariance = np.cov(draws.physical[:, estimated], rowvar=False)
    return {
        "format": FIT_FORMAT,
        **summary.as_json(),
        "covariance": {"names": [fit.names[i] for i in estimated], "matrix": covariance.tolist()},
        **(evidence or {}),
        "inputs": input_hashes(fit.campaign),
        "versions": {"python": sys.version.split()[0], **{name: version(name) for name in packages}},
        "seed": seed,
        "command": shlex.join(["tvsbayes", *sys.argv[1:]]),
    }


def write_results(
    fit: JointFit,
    summary: FitSummary,
    folder: Path,
    seed: int,
    calibration: Calibration | None = None,
    draws: Derived | None = None,
    evidence: Mapping[str, object] | None = None,
) -> dict[str, str]:
    """Write `fit.json` and `draws.npz`, each whole or not at all.

    Args:
        fit: the fit.
        summary: what is said of it.
        folder: is made where it does not exist.
        seed: of everything random.
        calibration: what `locate` and `steps-for` read back; None for a fit that must not be used.
        draws: behind the summary, one leading axis; None for the Laplace approximation's.
        evidence: further keys of `fit.json`, see `fit_document`.

    Returns:
        Paths by "fit" and "draws".

    Raises:
        InputError: the folder cannot be written.
    """
    draws = fit.draws if draws is None else draws
    arrays = {
        "names": np.array(fit.names),
        "estimator": np.array(summary.estimator),
        "physical": draws.physical,
        "effective_deg_per_step": draws.effective_deg_per_step,
        "reference_pose_rad": fit.reference_pose_rad,
    }
    if calibration is None:
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **arrays)
        content = buffer.getvalue()
    else:
        del arrays["estimator"]
        content = calibration_bytes(calibration, **arrays, **mode_arrays(fit.stored))
    document = json.dumps(fit_document(fit, summary, seed, draws, evidence), indent=1, allow_nan=False)
    contents = {"draws": ("draws.npz", content), "fit": ("fit.json", document.encode())}
    make_folder(folder)
    for name, data in contents.values():
        write_atomically(folder / name, data)
    return {key: str(folder / name) for key, (name, _) in contents.items()}
