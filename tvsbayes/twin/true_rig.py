"""A true rig: its drawn parameters, cameras and gears, their realisation in a run, and `truth.json`.

Degrees where a name says `_deg`, mm, pixels. No estimator reads any of it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tvsbayes.errors import InputError
from tvsbayes.files.disk import read_bytes
from tvsbayes.files.documents import JSON_BYTES_MAX, parse_json
from tvsbayes.instrument.axes import AXES, SENSES, SIDES
from tvsbayes.instrument.campaign import Campaign
from tvsbayes.instrument.mechanisms import MECHANISMS, Mechanism
from tvsbayes.instrument.parameters import (
    GEAR_ERROR_NAMES,
    HARMONIC_NAMES,
    LATE_NAMES,
    REGISTRY,
    STEREO_PARAMETER_NAMES,
    Prior,
)
from tvsbayes.instrument.rig import Rig
from tvsbayes.instrument.stereo_pair import Stereo, WithStereo, stereo_covariance, stereo_parameters
from tvsbayes.twin.gear_errors import PERFECT, AxisErrors, GearErrors, Tabulated, draw_gear_errors
from tvsbayes.twin.physics import effective_mirror_offset_mm, local_deg_per_step
from tvsbayes.twin.true_headlines import effective_deg_per_step

TRUTH_FORMAT = "tvsbayes-truth/1"
Pair = tuple[float, float]
"""Numbers for pan and tilt."""


@dataclass(frozen=True)
class Truth(WithStereo):
    """A true rig, which no estimator may read.

    Attributes:
        parameters: every physical parameter by its public name, derived ones included.
        stereo: the true cameras (the campaign carries the stated ones); None for a head with sightings.
        mirror_angles_deg: (psi, beta) of each move as realised, stop errors included; empty before a run.
        stop_errors_deg: (pan, tilt) stop error after each move.
        home_offsets_deg: (pan, tilt) home offset of each segment.
        drift_deg: (pan, tilt) drift of the zero at each move, since its homing.
        homing_side: side from which each homing of pan and tilt ends, "unknown" for anywhere; None before a run.
        reference_pose_deg: mean (psi, beta) over the ok spots without stop errors, None before a run.
        gear_errors: errors of the gears by position; None lets each run draw them by the scales in `parameters`. From a
            truth.json they are tabulated at the counters of its campaign.
        note: what a reader of truth.json should know.
    """

    parameters: dict[str, float]
    stereo: Stereo | None
    mirror_angles_deg: tuple[Pair, ...] = ()
    stop_errors_deg: tuple[Pair, ...] = ()
    home_offsets_deg: tuple[Pair, ...] = ()
    drift_deg: tuple[Pair, ...] = ()
    homing_side: tuple[str, str] | None = None
    reference_pose_deg: Pair | None = None
    gear_errors: GearErrors | None = None
    note: str = "The true rig of a simulated campaign; no estimator reads this file."

    def with_gears(self, errors: GearErrors = PERFECT) -> Truth:
        """Return the rig with these gear errors only: all scales by which errors are drawn are 0."""
        scales = {name: 0.0 for name in GEAR_ERROR_NAMES if REGISTRY[name].prior.distribution == "half-normal"}
        return replace(self, parameters={**self.parameters, **scales}, gear_errors=errors)

    def effective_deg_per_step(self, campaign: Campaign) -> dict[str, float] | None:
        """Compute the effective ratios over the looks of a campaign, see `true_headlines`; None without looks."""
        # A ratio contrast rotates axes by degrees over long travel, and with a tilted axis the lines depend on the
        # other axis' angle. For a scanner this effect is 1e-5.
        pose_deg = self.reference_pose_deg if campaign.rig.mechanism.all_round else None
        return effective_deg_per_step(self.parameters, self.gear_errors or PERFECT, campaign, pose_deg)

    def headlines(self, campaign: Campaign, pose_deg: Pair) -> dict[str, float] | None:
        """Compute parameters and derived quantities by public name, over the looks of a campaign and at a pose."""
        ratio = self.effective_deg_per_step(campaign)
        if ratio is None:
            return None
        contrast = {axis: ratio[first] - ratio[second] for axis, (first, second) in SENSES.items()}
        return {
            **self.parameters,
            **{f"effective_deg_per_step.{direction}": value for direction, value in ratio.items()},
            **{f"effective_contrast_deg_per_step.{axis}": value for axis, value in contrast.items()},
            "effective_mirror_offset_mm": effective_mirror_offset_mm(self.parameters, pose_deg),
        }

    def as_json(self, campaign: Campaign) -> dict[str, Any]:
        """Return the document of truth.json for a campaign of this rig, with effective ratios if it has looks."""
        mechanism = campaign.rig.mechanism
        constants, stereo = mechanism.constants, self.stereo
        cameras = {} if stereo is None else dict(zip(STEREO_PARAMETER_NAMES, stereo.vector.tolist(), strict=True))
        document: dict[str, Any] = {
            "format": TRUTH_FORMAT,
            "note": self.note,
            "parameters": {name: float(v) for name, v in self.parameters.items() if name not in constants},
            "stereo": cameras,
            "mirror_angles_deg": self.mirror_angles_deg,
            "stop_errors_deg": self.stop_errors_deg,
            "home_offsets_deg": self.home_offsets_deg,
            "drift_deg": self.drift_deg,
            "homing_side": None if self.homing_side is None else dict(zip(AXES, self.homing_side, strict=True)),
            "reference_pose_deg": self.reference_pose_deg,
            "gear_error": {axis: self._gear_error(axis, campaign) for axis in AXES},
        }
        effective = self.effective_deg_per_step(campaign)
        if effective is not None:
            document["effective_deg_per_step"] = effective
        if (pose_deg := self.reference_pose_deg) is not None:
            document["local_deg_per_step"] = local_deg_per_step(self.parameters, pose_deg)
            if "effective_mirror_offset_mm" not in mechanism.absent:
                document["effective_mirror_offset_mm"] = effective_mirror_offset_mm(self.parameters, pose_deg)
        return document

    def _gear_error(self, axis: str, campaign: Campaign) -> dict[str, list[float]]:
        steps = sorted({getattr(move, f"{axis}_steps") for move in campaign.moves})
        angle_deg = self.parameters[f"degrees_per_step.{axis}"] * np.array(steps, float)
        errors = (self.gear_errors or PERFECT)[axis]
        return {
            "steps": steps,
            "error_deg": errors.error_deg(angle_deg).tolist(),
            "play_deg": errors.play_deg(angle_deg).tolist(),
        }

    @classmethod
    def from_json(cls, document: Mapping[str, Any], stated: Stereo | None) -> Truth:
        """Rebuild from truth.json; image size and covariance come from the campaign's `stated` stereo."""
        pose, known = document["reference_pose_deg"], document["stereo"]
        # Older files without errors of gears, scatter of looks and shifts of zeros have none of them.
        perfect = {name: REGISTRY[name].prior.value for name in (*GEAR_ERROR_NAMES, *LATE_NAMES)}
        parameters = {name: float(value) for name, value in document["parameters"].items()}
        kinds = (kind for kind in MECHANISMS.values() if kind.tilt_zero in parameters)
        constants = {name: value for kind in kinds for name, value in _constants(kind).items()}
        parameters = {**perfect, **constants, **parameters}
        side, tables = document.get("homing_side"), document.get("gear_error")
        return cls(
            parameters=parameters,
            stereo=stated and stated.with_vector(np.array([float(known[name]) for name in STEREO_PARAMETER_NAMES])),
            mirror_angles_deg=pan_and_tilt(document["mirror_angles_deg"]),
            stop_errors_deg=pan_and_tilt(document["stop_errors_deg"]),
            home_offsets_deg=pan_and_tilt(document["home_offsets_deg"]),
            drift_deg=pan_and_tilt(document.get("drift_deg", ())),
            homing_side=None if side is None else (str(side["pan"]), str(side["tilt"])),
            reference_pose_deg=None if pose is None else (float(pose[0]), float(pose[1])),
            gear_errors=PERFECT if tables is None else _tabulated(tables, parameters),
            note=str(document["note"]),
        )


def _constants(mechanism: Mechanism) -> dict[str, float]:
    """Return the constants of an instrument but for cameras."""
    return {name: value for name, value in mechanism.constants.items() if name not in STEREO_PARAMETER_NAMES}


def _tabulated(tables: Mapping[str, Mapping[str, Sequence[float]]], parameters: Mapping[str, float]) -> GearErrors:
    """Build gear errors from the tables of a truth.json."""
    errors: dict[str, AxisErrors] = {}
    for axis in AXES:
        table = tables[axis]
        angle_deg = parameters[f"degrees_per_step.{axis}"] * np.array(table["steps"], float)
        values = [np.array(table[name], float) for name in ("error_deg", "play_deg")]
        if any(value.shape != angle_deg.shape or value.ndim != 1 for value in values):
            raise ValueError(f"gear_error.{axis} has columns of different lengths")
        errors[axis] = AxisErrors(*(Tabulated(angle_deg, value) for value in values))
    return errors


def pan_and_tilt(rows: Iterable[Sequence[float]]) -> tuple[Pair, ...]:
    """Convert rows of two numbers to the form of `Truth`."""
    return tuple((float(pan), float(tilt)) for pan, tilt in rows)


def read_truth(path: str | Path, stated: Stereo | None) -> Truth:
    """Read a truth.json; `stated` is the stereo calibration of its campaign.

    Raises:
        InputError: the file cannot be read, or is not a truth file of this format.
    """
    path = Path(path)
    keys = parse_json(read_bytes(path, JSON_BYTES_MAX), path.name)
    keys.word("format", TRUTH_FORMAT)
    try:
        return Truth.from_json(keys.values, stated)
    except (AttributeError, KeyError, TypeError, ValueError, IndexError) as error:
        raise InputError(
            "truth",
            f"{path.name} does not hold a truth file's entries: {error}",
            file=path.name,
            allowed="a truth.json as `tvsbayes simulate` writes it",
            remedy="simulate the campaign again, or delete the file: no estimator needs it",
        ) from error


def draw_truth(rig: Rig, rng: np.random.Generator) -> Truth:
    """Draw a true rig: every quantity from `rig.truth`, the cameras from their own covariance.

    No quantity keeps its stated value unless its `u` is 0: with exact cameras a study would report a coverage that no
    real calibration has.
    """
    # A separate stream, so that rigs with perfect gears do not depend on these draws.
    (gears,) = rng.spawn(1)

    def drawn(names: Iterable[str], stream: np.random.Generator) -> dict[str, float]:
        return {name: _draw(rig.truth.get(name, priors[name]), stream) for name in names}

    constants = _constants(rig.table.mechanism)
    priors = rig.table.priors | {name: Prior(value, 0.0) for name, value in constants.items()}
    late = (*HARMONIC_NAMES, *GEAR_ERROR_NAMES, *LATE_NAMES)
    parameters = drawn((each.name for each in rig.table.mechanism.declared if each.name not in late), rng)
    # By eigenvectors, since fixed parameters give a semi-definite covariance, for which Cholesky fails.
    cameras, covariance = stereo_parameters(rig.stereo), stereo_covariance(rig.stereo)
    variances, vectors = np.linalg.eigh(covariance)
    offset = vectors @ (np.sqrt(np.clip(variances, 0.0, None)) * rng.standard_normal(len(variances)))
    # Last, so that rigs without transmission error do not depend on these draws.
    parameters |= drawn(HARMONIC_NAMES, rng) | drawn(GEAR_ERROR_NAMES, gears)
    stereo = None if rig.stereo is None else rig.stereo.with_vector(cameras + offset)
    errors = draw_gear_errors(parameters, rig.table.harmonic_period_deg, gears)
    # After the gears' errors, which must not depend on these draws.
    parameters |= drawn(LATE_NAMES, gears)
    return Truth(with_derived(parameters), stereo, gear_errors=errors)


def _draw(prior: Prior, rng: np.random.Generator) -> float:
    """Draw one number; the generator always advances by one, so that fixing a parameter changes no other."""
    z = rng.standard_normal()
    if prior.distribution == "log-normal":
        return float(prior.value * np.exp(prior.u * z))
    if prior.distribution == "half-normal":
        return float(prior.value + prior.u * abs(z))
    return float(prior.value + prior.u * z)


def with_derived(parameters: Mapping[str, float]) -> dict[str, float]:
    """Add the four directional ratios that mean ratios and contrasts imply (formulation 3.1)."""
    result = dict(parameters)
    for axis, (negative, positive) in SIDES.items():
        ratio, contrast = result[f"degrees_per_step.{axis}"], result[f"ratio_contrast_deg_per_step.{axis}"]
        result[f"degrees_per_step.{positive}"] = ratio + contrast / 2
        result[f"degrees_per_step.{negative}"] = ratio - contrast / 2
    return result
