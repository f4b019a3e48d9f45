"""`results/draws.npz` of scanner and head: draws behind `fit.json`, the calibration, and the fit's mode.

Draws in the units of the names, ratios in deg/step, pose in rad; mode and covariance in prior coordinates.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tvsbayes.calibration.calibration_file import calibration_arrays
from tvsbayes.calibration.pointing import Calibration
from tvsbayes.instrument.axes import AXES, SENSES
from tvsbayes.instrument.homing import ANYWHERE
from tvsbayes.instrument.parameters import STEREO_PARAMETER_NAMES
from tvsbayes.results.store import damaged_draws, write_fit

if TYPE_CHECKING:
    from tvsbayes.results.fit_record import FitRecord


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

    def of(self, names: Sequence[str], rig_names: Sequence[str]) -> StoredMode | None:
        """The mode of these parameters alone, those with a prior in `[rig]`; None where the file lacks one.

        Heads of 0.3.0 and before also stored what they lack, fixed and so independent of all others.
        """
        own = {name: row for row, name in enumerate(self.names)}
        if not set(names) <= set(own) or len(self.names) - self.prior.shape[1] not in (0, len(STEREO_PARAMETER_NAMES)):
            return None
        rows, rig = [own[name] for name in names], [own[name] for name in rig_names]
        covariance = self.covariance[np.ix_(rows, rows)]
        return replace(self, names=tuple(names), z=self.z[rows], covariance=covariance, prior=self.prior[:, rig])


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


def write_results(
    folder: Path,
    record: FitRecord,
    draws: ResultDraws,
    calibration: Calibration | None = None,
    mode: StoredMode | None = None,
    posterior: bytes | None = None,
) -> dict[str, str]:
    """Write the files of a fit as one set; errors and paths as of `write_fit`.

    Args:
        folder: is created where it does not exist.
        record: the results of the fit.
        draws: the draws behind the record.
        calibration: read by `locate` and `steps-for`; None for a fit that must not be used.
        mode: starting point of `compare` and `plan`.
        posterior: content of `posterior.nc`.
    """
    arrays = {**vars(draws), "names": np.array(draws.names), "derived_names": np.array(draws.derived_names)}
    if calibration is None:
        arrays["estimator"] = np.array(record.summary.estimator)
    else:
        arrays |= calibration_arrays(calibration)
        if mode is not None:
            arrays |= {f"mode_{name}": getattr(mode, name) for name in (*_MODE_ARRAYS, "log_density", "sides")}
    return write_fit(folder, record.identified().as_json(), arrays, posterior)


def mode_of(arrays: Mapping[str, np.ndarray], spots: int) -> StoredMode | None:
    """The mode in `draws.npz`; None where the fit has none that may be used.

    Raises:
        InputError: it is damaged, or not that of so many spots.
    """
    if "mode_z" not in arrays:
        return None
    try:
        numbers = {name: np.array(arrays[f"mode_{name}"], dtype=float) for name in (*_MODE_ARRAYS, "log_density")}
        names = tuple(arrays["names"].tolist())
        count = len(names)
        shapes = {"z": (count,), "covariance": (count, count), "valid": (spots,), "weight": (spots,), "log_density": ()}
        if any(numbers[name].shape != shape for name, shape in shapes.items()) or numbers["prior"].shape[:1] != (2,):
            raise ValueError("a mode of another shape")
        if not all(np.isfinite(array).all() for array in numbers.values()):
            raise ValueError("a mode that is not finite")
        sides = tuple(map(str, arrays["mode_sides"].tolist())) if "mode_sides" in arrays else ("", "")
        if any(side not in ("", ANYWHERE, *SENSES[axis]) for axis, side in zip(AXES, sides, strict=True)):
            raise ValueError("a homing hypothesis that there is not")
    except (KeyError, TypeError, ValueError) as error:
        raise damaged_draws(error) from error
    return StoredMode(names, log_density=float(numbers.pop("log_density")), sides=sides, **numbers)


def ratios_of(arrays: Mapping[str, np.ndarray]) -> np.ndarray:
    """Draws of the effective ratios left, right, up, down, deg/step, shape (draws, 4).

    Raises:
        InputError: they are missing or damaged.
    """
    draws = arrays.get("effective_deg_per_step", np.zeros(0))
    if draws.dtype.kind != "f" or draws.ndim != 2 or draws.shape[1] != 4 or not np.all(np.isfinite(draws)):
        raise damaged_draws("effective_deg_per_step")
    return draws
