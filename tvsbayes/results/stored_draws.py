"""`results/draws.npz`: draws behind `fit.json`, the calibration that `locate` reads, and the fit's mode.

Draws in the units of the names, ratios in deg/step, pose in rad; mode and covariance in prior coordinates.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tvsbayes.calibration.calibration_file import (
    calibration_bytes,
    damaged_calibration,
    stored_calibration,
)
from tvsbayes.calibration.pointing import Calibration
from tvsbayes.files.disk import RESULTS_BYTES_MAX, read_arrays
from tvsbayes.instrument.axes import AXES, SENSES
from tvsbayes.instrument.campaign import Campaign
from tvsbayes.instrument.homing import ANYWHERE
from tvsbayes.results.fit_record import FitRecord, write_files


@dataclass(frozen=True)
class StoredMode:
    """The mode of a fit in `draws.npz`, sufficient to continue without a new fit.

    Attributes:
        names: parameters, in the order of the coordinates.
        z, covariance: mode and Laplace covariance in prior coordinates, shapes (p,) and (p, p).
        log_density: log density at the mode.
        prior: value and u of every parameter of the rig that the fit used, shape (2, r).
        valid, weight: whether each spot, in the order of the fit, was used, and its weight; shape (spots,).
        sides: homing sides of pan and tilt assumed by the fit; "" where the campaign recorded them.
    """

    names: tuple[str, ...]
    z: np.ndarray
    covariance: np.ndarray
    log_density: float
    prior: np.ndarray
    valid: np.ndarray
    weight: np.ndarray
    sides: tuple[str, ...] = ("", "")


@dataclass(frozen=True)
class ResultDraws:
    """Draws behind a record, from a posterior or the Laplace approximation.

    Attributes:
        names: columns of `physical`.
        physical: shape (draws, names), in the units of the names.
        effective_deg_per_step: left, right, up, down, slopes of the lines through the looks, shape (draws, 4).
        reference_pose_rad: mean mirror angles (pan, tilt) of the looks used, shape (2,).
        derived_names: columns of `derived`, quantities that are not parameters.
        derived: shape (draws, derived names), in the units of the names.
    """

    names: tuple[str, ...]
    physical: np.ndarray
    effective_deg_per_step: np.ndarray
    reference_pose_rad: np.ndarray
    derived_names: tuple[str, ...]
    derived: np.ndarray


_MODE_ARRAYS = ("z", "covariance", "prior", "valid", "weight")


def _draws_bytes(
    draws: ResultDraws, estimator: str, calibration: Calibration | None = None, mode: StoredMode | None = None
) -> bytes:
    """The content of `draws.npz`; without a calibration the draws must not be used for calculations."""
    arrays = {**vars(draws), "names": np.array(draws.names), "derived_names": np.array(draws.derived_names)}
    if calibration is None:
        buffer = io.BytesIO()
        np.savez(buffer, estimator=np.array(estimator), **arrays)
        return buffer.getvalue()
    if mode is not None:
        arrays |= {f"mode_{name}": getattr(mode, name) for name in _MODE_ARRAYS}
        arrays["mode_log_density"] = np.array(mode.log_density)
        arrays["mode_sides"] = np.array(mode.sides)
    return calibration_bytes(calibration, **arrays)


def write_results(
    folder: Path,
    record: FitRecord,
    draws: ResultDraws,
    calibration: Calibration | None = None,
    mode: StoredMode | None = None,
) -> dict[str, str]:
    """Write `fit.json` and `draws.npz`, each completely or not at all.

    Args:
        folder: is created where it does not exist.
        record: the results of the fit.
        draws: the draws behind the record.
        calibration: read by `locate` and `steps-for`; None for a fit that must not be used.
        mode: starting point of `compare` and `plan`.

    Returns:
        Paths by "draws" and "fit".

    Raises:
        InputError: the folder cannot be written.
    """
    content = _draws_bytes(draws, record.summary.estimator, calibration, mode)
    return write_files(folder, content, record.as_json())


def stored_mode(campaign: Campaign) -> StoredMode | None:
    """The mode of the fit in `results/`, if it converged and was made from exactly these data and priors.

    Raises:
        InputError: the results are damaged.
    """
    if campaign.path is None or stored_calibration(campaign) is None:
        return None
    path = campaign.path / "results" / "draws.npz"
    try:
        file = read_arrays(path, RESULTS_BYTES_MAX)
        if "mode_z" not in file:
            return None
        arrays = {name: np.array(file[f"mode_{name}"], dtype=float) for name in _MODE_ARRAYS}
        log_density = np.array(file["mode_log_density"], dtype=float)
        names = tuple(file["names"].tolist())
        count, spots = len(names), sum(spot.status == "ok" for spot in campaign.spots)
        shapes = {"z": (count,), "covariance": (count, count), "valid": (spots,), "weight": (spots,)}
        if any(arrays[name].shape != shape for name, shape in shapes.items()) or arrays["prior"].shape[:1] != (2,):
            raise ValueError("a mode of another shape")
        if log_density.shape or not all(np.isfinite(array).all() for array in (*arrays.values(), log_density)):
            raise ValueError("a mode that is not finite")
        sides = tuple(map(str, file["mode_sides"].tolist())) if "mode_sides" in file else ("", "")
        if any(side not in ("", ANYWHERE, *SENSES[axis]) for axis, side in zip(AXES, sides, strict=True)):
            raise ValueError("a way of homing that there is not")
        return StoredMode(names, log_density=float(log_density), sides=sides, **arrays)
    except (KeyError, TypeError, ValueError) as error:
        raise damaged_calibration(path, error) from error
