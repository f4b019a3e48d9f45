"""Calibrations on disk: `draws.npz` of `results/`, and JSON for another language.

NumPy alone. Files are untrusted: size limits, shapes and finite numbers are checked before a calibration is built.
Units as in the names; matrices in the order of `INPUT_NAMES`.
"""

from __future__ import annotations

import datetime
import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tvsbayes.calibration.frames import EXTRINSICS_NAMES, NO_POSE
from tvsbayes.calibration.gear_table import NO_GEARS, table_of
from tvsbayes.calibration.optics import ERROR_AT, PLAY_AT
from tvsbayes.calibration.pointing import INPUT_NAMES, NOISE_NAMES, Calibration, input_names
from tvsbayes.calibration.states import ZERO_NAMES, columns_of, poses_at, poses_of, shifts_at
from tvsbayes.errors import InputError, escaped
from tvsbayes.files.disk import RESULTS_BYTES_MAX, read_arrays, read_bytes
from tvsbayes.files.documents import parse_json
from tvsbayes.files.packages import own_version
from tvsbayes.instrument.axes import AXES, Axis
from tvsbayes.instrument.campaign import Campaign
from tvsbayes.instrument.mechanisms import MECHANISMS
from tvsbayes.statistics.predicted_readings import State

CALIBRATION_FORMAT = "tvsbayes-calibration/2"
FORMATS = ("tvsbayes-calibration/1", CALIBRATION_FORMAT)
"""Formats that can be read; the first one has no errors of the gears."""
NO_CALIBRATION = "no-calibration"
"""Code of the refusal of valid results without a calibration."""
NAME_CHARS_MAX = 200
DRAWS = Path("draws.npz")
_ARRAYS = ("mean", "covariance", "range_steps", "inputs", "noise", "cause_covariance")


def calibration_arrays(calibration: Calibration) -> dict[str, np.ndarray]:
    """A calibration as arrays of `draws.npz`."""
    # What is no array, under the names of `Calibration`.
    tables = {
        "noise_variance": calibration.noise_variance,
        "overshoot_steps": calibration.overshoot_steps,
        "period_deg": calibration.period_deg,
        "inputs_sha256": calibration.inputs_sha256,
        "causes": list(calibration.causes),
        "gear_steps": {axis: list(steps) for axis, steps in zip(AXES, calibration.gears.steps, strict=True)},
        "states": {axis: state._asdict() for axis, state in calibration.states.items()},
    }
    others = {
        "format": CALIBRATION_FORMAT,
        "input_names": calibration.names,
        "noise_names": NOISE_NAMES,
        "estimator": calibration.estimator,
        "azimuth": calibration.azimuth,
        "tables": json.dumps(tables),
    }
    arrays = {name: getattr(calibration, name) for name in _ARRAYS}
    return {name: np.asarray(value) for name, value in {**arrays, **others}.items()}


KNOWN_INPUTS = {input_names(each) for each in MECHANISMS.values()}
"""Names of inputs that a stored calibration may have."""
DIGITS = 15
"""Significant digits of any decimal number that a double holds: one more would print rounding errors."""


def _plain(value: Any) -> Any:
    """Round the numbers of a document to `DIGITS`."""
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}")
    if isinstance(value, Mapping):
        return {key: _plain(each) for key, each in value.items()}
    return [_plain(each) for each in value] if isinstance(value, list | tuple) else value


@dataclass(frozen=True)
class Origin:
    """Origin of an exported calibration, so that it can be identified on a controller.

    Attributes:
        campaign: name of the campaign.
        measured: its date in `campaign.toml`; "" where it is not stated.
        exported: day of the export (UTC).
        tvsbayes: version that exported it.
    """

    campaign: str
    measured: str
    exported: str
    tvsbayes: str

    @classmethod
    def of(cls, campaign: Campaign) -> Origin:
        """Build the origin of a campaign's calibration exported today."""
        created, today = campaign.header.get("created"), datetime.datetime.now(datetime.UTC).date()
        measured = created.isoformat() if isinstance(created, datetime.date) else ""
        return cls(campaign.title, measured, today.isoformat(), own_version())


def content_sha256(document: Mapping[str, object]) -> str:
    """Compute the SHA-256 of an exported calibration, without its origin."""
    content = {key: value for key, value in document.items() if key != "origin"}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def calibration_json(calibration: Calibration, origin: Origin | None = None) -> dict[str, Any]:
    """Build the JSON of a calibration without its draws, for a ROS node or another language.

    `read_calibration_json` reads it. `origin` is added with the SHA-256 of all other content. Numbers have `DIGITS`.
    """
    document: dict[str, Any] = _plain(
        {
            "format": CALIBRATION_FORMAT,
            "estimator": calibration.estimator,
            "aperture_convention": "azimuth" if calibration.azimuth else "in-plane",
            "harmonic_period_deg": dict(calibration.period_deg),
            "estimates": calibration.estimates,
            "covariance": {
                "names": [*calibration.names, *calibration.gears.names],
                "matrix": calibration.covariance.tolist(),
            },
            "noise_variance_deg2": dict(calibration.noise_variance),
            "overshoot_steps": dict(calibration.overshoot_steps),
            "range_steps": {axis: list(steps) for axis, steps in calibration.seen_steps.items()},
            "gear_errors": gear_errors(calibration),
            "state": {axis: state._asdict() for axis, state in calibration.states.items()},
            "inputs": dict(calibration.inputs_sha256),
            "expected_error": asdict(expected_error(calibration)),
        }
    )
    if origin is not None:
        document["origin"] = {**asdict(origin), "sha256": content_sha256(document)}
    return document


def gear_errors(calibration: Calibration) -> dict[str, dict[str, Any]]:
    """Return the errors of each axis at regular counters, and beyond them, with their standard uncertainties, deg.

    Empty without repeating errors.
    """
    first, table = len(INPUT_NAMES), calibration.gears
    u = np.sqrt(np.maximum(np.diag(calibration.covariance)[first:], 0.0))
    errors: dict[str, dict[str, Any]] = {}
    for axis, steps in zip(AXES, table.steps, strict=True):
        if not table.size:
            break
        error, play = (table.parts[f"{kind}.{axis}"] for kind in (ERROR_AT, PLAY_AT))
        errors[axis] = {
            "steps": list(steps),
            "transmission_error_deg": calibration.mean[first:][error][:-1].tolist(),
            "u_transmission_error_deg": u[error][:-1].tolist(),
            "play_variation_deg": calibration.mean[first:][play][:-1].tolist(),
            "u_play_variation_deg": u[play][:-1].tolist(),
            "beyond_u_transmission_error_deg": float(u[error][-1]),
            "beyond_u_play_variation_deg": float(u[play][-1]),
        }
    return errors


@dataclass(frozen=True)
class ExpectedError:
    """95 % half widths of the beam at counters: azimuth, elevation, and position at 1 m (x, y, z)."""

    pan_steps: int
    tilt_steps: int
    u95_azimuth_deg: float
    u95_elevation_deg: float
    u95_at_1_m_mm: list[float]


def expected_error(calibration: Calibration) -> ExpectedError:
    """Compute the error of a calibration at the middle of its campaign's counters, reached from left and up."""
    pan, tilt = (round(float(value)) for value in calibration.range_steps.mean(axis=1))
    counters, sides = (float(pan), float(tilt)), (1.0, 1.0)
    azimuth, elevation = calibration.beam_u95_deg(counters, sides).tolist()
    at_1_m = calibration.beam_u95_mm(counters, sides, 1000.0).tolist()
    return ExpectedError(pan, tilt, azimuth, elevation, at_1_m)


def damaged_calibration(path: Path, reason: object) -> InputError:
    """Build the refusal of a file that tvsbayes did not write."""
    return InputError(
        "damaged-results",
        f"{escaped(path.name)} is not a calibration that tvsbayes wrote: {escaped(str(reason), 200)}",
        file=escaped(path.name),
        allowed=f"format {' or '.join(FORMATS)}",
        remedy="run `tvsbayes fit` on the campaign again",
    )


def _shaped(calibration: Calibration) -> Calibration:
    """Refuse arrays of other shapes or with values that are not finite."""
    n, count = len(calibration.inputs), len(INPUT_NAMES) + calibration.gears.size
    shapes = {"mean": (count,), "covariance": (count, count), "range_steps": (2, 2), "inputs": (n, count)}
    if len(calibration.extrinsics):
        shapes["extrinsics"] = (n, len(EXTRINSICS_NAMES))
    shapes |= {"noise": (n, len(NOISE_NAMES)), "cause_covariance": (len(calibration.causes), count, count)}
    for name, shape in shapes.items():
        array = getattr(calibration, name)
        if array.shape != shape or array.dtype != np.float64 or not np.all(np.isfinite(array)):
            raise ValueError(f"{name} has shape {array.shape}, wanted {shape} of finite numbers")
    for text in (calibration.estimator, *calibration.causes):
        # These texts are printed on terminals and in reports.
        if not (isinstance(text, str) and len(text) <= NAME_CHARS_MAX and text.isprintable()):
            raise ValueError("a name of an estimator or cause is no plain text")
    if not set(NOISE_NAMES) <= set(calibration.noise_variance) or not set(AXES) <= set(calibration.overshoot_steps):
        raise ValueError("a noise variance or an overshoot is missing")
    if not all(math.isfinite(variance) and variance >= 0 for variance in calibration.noise_variance.values()):
        raise ValueError("a noise variance is no variance")
    if not all(isinstance(steps, int) and steps >= 0 for steps in calibration.overshoot_steps.values()):
        raise ValueError("an overshoot is no number of steps")
    if not all(math.isfinite(period) and period > 0 for period in calibration.period_deg.values()):
        raise ValueError("a period of a transmission error is not positive")
    return calibration


def read_draws(path: Path) -> Calibration:
    """Read a `draws.npz` by itself.

    Raises:
        InputError: it holds no calibration that tvsbayes wrote.
    """
    try:
        arrays = read_arrays(path, RESULTS_BYTES_MAX)
    except ValueError as error:
        raise damaged_calibration(path, error) from error
    return calibration_in(arrays, path)


def calibration_in(arrays: Mapping[str, np.ndarray], path: Path = DRAWS) -> Calibration:
    """Build the calibration that must be in `draws.npz`; errors as in `read_draws`."""
    if (calibration := calibration_of_arrays(arrays, path)) is None:
        name = escaped(path.name)
        message = f"{name} holds draws and no calibration: its fit did not converge, or an older tvsbayes wrote it"
        raise InputError(NO_CALIBRATION, message, file=name, remedy="run `tvsbayes fit` on the campaign again")
    return calibration


def calibration_of_arrays(file: Mapping[str, np.ndarray], path: Path = DRAWS) -> Calibration | None:
    """Build the calibration in `draws.npz`, None where its fit did not converge; errors as in `read_draws`."""
    if "format" not in file and "physical" in file:
        return None
    try:
        names = tuple(file["input_names"].tolist())
        columns = names in KNOWN_INPUTS and file["noise_names"].tolist() == list(NOISE_NAMES)
        if str(file["format"]) not in FORMATS or not columns:
            raise ValueError(f"format {str(file['format'])[:60]!r} or other columns")
        tables = _tables(str(file["tables"]), path)
        states = _states(tables.get("states", {}))
        # They are among the draws of `fit.json`, row by row with the inputs.
        known, physical = (file["names"].tolist(), file["physical"]) if "names" in file else ([], NO_POSE)
        zeros, extrinsics = columns_of(known, physical, ZERO_NAMES), poses_of(known, physical)
        if states:
            extrinsics = poses_at(extrinsics, names, shifts_at(zeros, states)[:, 0])
        return _shaped(
            Calibration(
                mean=file["mean"],
                covariance=file["covariance"],
                noise_variance=tables["noise_variance"],
                overshoot_steps=tables["overshoot_steps"],
                azimuth=bool(file["azimuth"]),
                period_deg=tables["period_deg"],
                estimator=str(file["estimator"]),
                range_steps=file["range_steps"],
                inputs_sha256=tables["inputs_sha256"],
                inputs=file["inputs"],
                noise=file["noise"],
                causes=tuple(tables["causes"]),
                cause_covariance=file["cause_covariance"],
                gears=NO_GEARS if str(file["format"]) == FORMATS[0] else table_of(tables["gear_steps"]),
                extrinsics=extrinsics,
                names=names,
                states=states,
                zeros=zeros,
            )
        )
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise damaged_calibration(path, error) from error


def _states(stored: Mapping[str, Mapping[str, float]]) -> dict[Axis, State]:
    """States by axis, of both axes or none; a missing or other key is a `KeyError` or `TypeError`."""
    return {axis: State(**{name: float(n) for name, n in stored[axis].items()}) for axis in AXES if stored}


def _tables(text: str, path: Path) -> Mapping[str, Any]:
    """Parse the tables as JSON without further checks; `_shaped` refuses invalid ones."""
    try:
        return parse_json(text.encode(), escaped(path.name)).values
    except InputError as error:
        raise damaged_calibration(path, f"its tables are no JSON of tvsbayes: {error.found}") from error


def read_calibration_json(path: Path) -> Calibration:
    """Read what `calibration_json` made; errors as in `read_draws`."""
    keys = parse_json(read_bytes(path, RESULTS_BYTES_MAX), escaped(path.name))
    known = keys.word("format", *FORMATS)
    convention = keys.word("aperture_convention", "in-plane", "azimuth")
    try:
        # Wrong types fail below or in `_shaped`.
        d: Mapping[str, Any] = keys.values
        errors = {} if known == FORMATS[0] else d["gear_errors"]
        gears = table_of({axis: errors[axis]["steps"] for axis in AXES}) if errors else NO_GEARS
        named = tuple(d["covariance"]["names"])
        names = named[: len(INPUT_NAMES)]
        if names not in KNOWN_INPUTS or named[len(names) :] != gears.names:
            raise ValueError("the covariance names other inputs")
        mean = [d["estimates"][name] for name in names]
        for name in gears.inputs:
            kind, axis = name.split(".")
            # Beyond the table the expected error is zero.
            mean += [*(errors[axis]["transmission_error_deg" if kind == ERROR_AT else "play_variation_deg"]), 0.0]
        return _shaped(
            Calibration(
                mean=np.array(mean, dtype=float),
                covariance=np.array(d["covariance"]["matrix"], dtype=float),
                noise_variance={name: float(value) for name, value in d["noise_variance_deg2"].items()},
                overshoot_steps={axis: int(value) for axis, value in d["overshoot_steps"].items()},
                azimuth=convention == "azimuth",
                period_deg={axis: float(value) for axis, value in d["harmonic_period_deg"].items()},
                estimator=str(d["estimator"]),
                range_steps=np.array([d["range_steps"][axis] for axis in AXES], dtype=float),
                inputs_sha256=dict(d["inputs"]),
                inputs=np.zeros((0, len(mean))),
                cause_covariance=np.zeros((0, len(mean), len(mean))),
                gears=gears,
                names=names,
                states=_states(d.get("state", {})),
            )
        )
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise damaged_calibration(path, error) from error
