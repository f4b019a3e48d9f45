"""A true rig drawn, and a plan run on it."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tvsbayes.errors import InputError
from tvsbayes.files.disk import read_bytes, write_atomically
from tvsbayes.files.documents import JSON_BYTES_MAX, parse_json
from tvsbayes.instrument.axes import FULL_TURN_DEG, HOME_SD_DEG
from tvsbayes.instrument.campaign import Campaign, Move, Spot, write_campaign
from tvsbayes.instrument.parameters import (
    DECLARED_PRIORS,
    DEFAULT_PRIORS,
    HARMONIC_PRIORS,
    STEREO_PARAMETER_NAMES,
    Prior,
)
from tvsbayes.instrument.plan import HOME_APPROACH, PlanLog, PlannedLook, PlanStep, run_plan
from tvsbayes.instrument.rig import Rig, require_periods
from tvsbayes.instrument.stereo_pair import Stereo, rotation_matrix
from tvsbayes.twin.physics import (
    aperture_angle_deg,
    effective_deg_per_step,
    effective_mirror_offset_mm,
    harmonics_deg,
    inside_images,
    mirror_chain,
    project,
    stop_errors,
    to_tvs,
    transmission,
)

SHEET_DEPTH_SD_MM = 1.0
"""Standard deviation of a placed sheet's depth about its nominal X: a hand against a stop."""
SHEET_TILT_SD_DEG = 0.5
"""Standard deviation of a placed sheet's rotation about Y and about Z, each."""
SPOT_SD_PX = 0.08
"""Standard uncertainty stated for a spot centre where neither caller nor rig names one."""
TRUTH_FORMAT = "tvsbayes-truth/1"


@dataclass(frozen=True)
class Truth:
    """A true rig: what no estimator may read.

    Attributes:
        parameters: every physical parameter by its contract name (DESIGN 8), derived ones included.
        stereo: the true cameras (the campaign carries the stated ones).
        mirror_angles_deg: (psi, beta) of each move as realised, stop errors included; empty before a run.
        stop_errors_deg: (pan, tilt) stop error of each move, as held.
        home_offsets_deg: (pan, tilt) per segment.
        reference_pose_deg: mean (psi, beta) over the ok spots without stop errors, None before a run.
        note: what a reader of truth.json should know.
    """

    parameters: dict[str, float]
    stereo: Stereo
    mirror_angles_deg: tuple[tuple[float, float], ...] = ()
    stop_errors_deg: tuple[tuple[float, float], ...] = ()
    home_offsets_deg: tuple[tuple[float, float], ...] = ()
    reference_pose_deg: tuple[float, float] | None = None
    note: str = "The true rig of a simulated campaign; no estimator reads this file."

    def as_json(self) -> dict[str, object]:
        """The document of truth.json, with the effective ratios at the reference pose where one is known."""
        document: dict[str, object] = {
            "format": TRUTH_FORMAT,
            "note": self.note,
            "parameters": {name: float(value) for name, value in self.parameters.items()},
            "stereo": dict(zip(STEREO_PARAMETER_NAMES, map(float, self.stereo.vector), strict=True)),
            "mirror_angles_deg": [list(pair) for pair in self.mirror_angles_deg],
            "stop_errors_deg": [list(pair) for pair in self.stop_errors_deg],
            "home_offsets_deg": [list(pair) for pair in self.home_offsets_deg],
            "reference_pose_deg": None,
        }
        if self.reference_pose_deg is not None:
            document["reference_pose_deg"] = list(self.reference_pose_deg)
            document["effective_deg_per_step"] = effective_deg_per_step(self.parameters, self.reference_pose_deg)
            document["effective_mirror_offset_mm"] = effective_mirror_offset_mm(
                self.parameters, self.reference_pose_deg
            )
        return document

    @classmethod
    def from_json(cls, document: Mapping[str, object], stated: Stereo) -> Truth:
        """Rebuild from truth.json; image size and covariance come from the campaign's `stated` stereo."""
        pairs = {
            name: tuple(tuple(map(float, pair)) for pair in document[name])
            for name in ("mirror_angles_deg", "stop_errors_deg", "home_offsets_deg")
        }
        pose = document["reference_pose_deg"]
        vector = np.array([document["stereo"][name] for name in STEREO_PARAMETER_NAMES], float)
        return cls(
            parameters={name: float(value) for name, value in document["parameters"].items()},
            stereo=stated.with_vector(vector),
            reference_pose_deg=None if pose is None else (float(pose[0]), float(pose[1])),
            note=str(document["note"]),
            **pairs,
        )


@dataclass(frozen=True)
class Light:
    """Where the beam of each look met its sheet, in frame S: what a picture of it is made from.

    Attributes:
        points_mm: (n, 3) points on the sheet; NaN where the beam never meets it.
        directions: (n, 3) unit vectors along the beam.
        normals: (n, 3) normals of the sheet, of any length.
    """

    points_mm: np.ndarray
    directions: np.ndarray
    normals: np.ndarray


@dataclass(frozen=True)
class SimulatedCampaign:
    """What the twin wrote: the campaign as a stranger would get it, and the truth and the light behind it."""

    campaign: Campaign
    truth: Truth
    light: Light

    def undetected(self) -> SimulatedCampaign:
        """The same run before anybody has looked at its pictures: no pixels, status "undetected"."""
        empty = dict.fromkeys(f"{s}{c}_{side}_px" for s in ("", "s") for c in "uv" for side in ("left", "right"))
        spots = tuple(replace(spot, **empty, status="undetected") for spot in self.campaign.spots)
        return replace(self, campaign=replace(self.campaign, spots=spots))

    def write(self, folder: str | Path) -> None:
        """Write the campaign folder and its truth.json."""
        write_campaign(self.campaign, Path(folder))
        entries = (
            f' "{key}": {json.dumps(value, indent=2 if isinstance(value, dict) else None, allow_nan=False)}'
            for key, value in self.truth.as_json().items()
        )
        write_atomically(Path(folder) / "truth.json", ("{\n" + ",\n".join(entries) + "\n}\n").encode())


def read_truth(path: str | Path, stated: Stereo) -> Truth:
    """Read a truth.json; `stated` is the stereo calibration of its campaign.

    Raises:
        InputError: unreadable, or not a truth file of this format.
    """
    path = Path(path)
    keys = parse_json(read_bytes(path, JSON_BYTES_MAX), path.name)
    keys.word("format", (TRUTH_FORMAT,))
    try:
        return Truth.from_json(keys.values, stated)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise InputError(
            "truth",
            f"{path.name} does not hold a truth file's entries: {error}",
            file=path.name,
            allowed="a truth.json as `tvsbayes simulate` writes it",
            remedy="simulate the campaign again, or delete the file: no estimator needs it",
        ) from error


def draw_truth(rig: Rig, rng: np.random.Generator) -> Truth:
    """Draw a true rig: every quantity of `rig.truth` anew, the cameras from their own covariance.

    Nothing is left at its stated value unless its `u` is 0: a study whose cameras were exact would
    report a coverage that no real calibration has.
    """
    parameters = {
        name: _draw(rig.truth.get(name, rig.table.priors[name]), rng) for name in (*DEFAULT_PRIORS, *DECLARED_PRIORS)
    }
    # Through the eigenvectors: fixed parameters give a semi-definite covariance that Cholesky refuses.
    variances, vectors = np.linalg.eigh(np.asarray(rig.stereo.parameter_covariance, float))
    offset = vectors @ (np.sqrt(np.clip(variances, 0.0, None)) * rng.standard_normal(len(variances)))
    # Last: rigs without transmission error are the same rigs whatever is drawn here.
    parameters |= {name: _draw(rig.truth.get(name, rig.table.priors[name]), rng) for name in HARMONIC_PRIORS}
    return Truth(with_derived(parameters), rig.stereo.with_vector(rig.stereo.vector + offset))


def _draw(prior: Prior, rng: np.random.Generator) -> float:
    """One draw; the generator always advances by one, so that fixing a parameter moves no other."""
    z = rng.standard_normal()
    if prior.distribution == "log-normal":
        return float(prior.value * np.exp(prior.u * z))
    if prior.distribution == "half-normal":
        return float(prior.value + prior.u * abs(z))
    return float(prior.value + prior.u * z)


def with_derived(parameters: Mapping[str, float]) -> dict[str, float]:
    """Add the four directional ratios that mean ratios and contrasts imply (DESIGN 3.1)."""
    result = dict(parameters)
    for axis, positive, negative in (("pan", "left", "right"), ("tilt", "up", "down")):
        ratio, contrast = result[f"degrees_per_step.{axis}"], result[f"ratio_contrast_deg_per_step.{axis}"]
        result[f"degrees_per_step.{positive}"] = ratio + contrast / 2
        result[f"degrees_per_step.{negative}"] = ratio - contrast / 2
    return result


def simulate(
    rig: Rig,
    plan: Iterable[PlanStep],
    seed: int,
    truth: Truth | None = None,
    *,
    aperture: bool = False,
    spot_sd_px: float | None = None,
    home_approach: tuple[str, str] = HOME_APPROACH,
    header: Mapping[str, object] | None = None,
) -> SimulatedCampaign:
    """Run a plan on a true rig and return the campaign a stranger would see, with its truth.

    Args:
        rig: declared rig; its table and stereo calibration go into the campaign.
        plan: plan steps in order.
        seed: of everything random; recorded in the campaign.
        truth: the true rig; None draws one with `draw_truth`.
        aperture: whether each look also reads the aperture angle.
        spot_sd_px: standard uncertainty stated for every coordinate, by default `[cameras] spot_sd_px`;
            true noise is this times pixel_scale.
        home_approach: side from which each homing ends, (pan, tilt); "unknown" leaves it open.
        header: further keys of campaign.toml.

    Raises:
        InputError: the plan looks before a sheet is placed, or names a sheet the rig does not have; the true
            rig has a transmission error whose period the declared one does not state.
    """
    streams = dict(
        zip(
            ("truth", "stops", "homes", "sheets", "pixels", "aperture"),
            map(np.random.default_rng, np.random.SeedSequence(seed).spawn(6)),
            strict=True,
        )
    )
    if truth is None:
        truth = draw_truth(rig, streams["truth"])
    sd_px = float(rig.cameras.get("spot_sd_px", SPOT_SD_PX) if spot_sd_px is None else spot_sd_px)
    log = run_plan(plan, rig, home_approach)
    fixed = {name: Prior(value, 0.0) for name, value in truth.parameters.items() if name in HARMONIC_PRIORS}
    require_periods(fixed, rig.table.harmonic_period_deg)
    truth, resting_deg = _drive(log.moves, truth, rig.table.harmonic_period_deg, streams["stops"], streams["homes"])
    light, points_P = _light(log, rig, truth, streams["sheets"])
    p = truth.parameters
    pixels = project(light.points_mm, truth.stereo, p["focal_scale"])
    noise_px = p["pixel_scale"] * sd_px * streams["pixels"].standard_normal(pixels.shape)
    pixels = inside_images(pixels + noise_px, truth.stereo)
    readings: list[float | None] = [None] * len(pixels)
    if aperture:
        points_T = to_tvs(points_P, p["baseline_mm"], p["pan_zero_emission_deg"])
        angle = aperture_angle_deg(points_T, p["baseline_mm"], rig.table.aperture_convention)
        noise = p["aperture_sd_deg"] * streams["aperture"].standard_normal(len(pixels))
        readings = [float(b) for b in angle + p["aperture_zero_deg"] + noise]
    spots = tuple(
        _spot(number, look, log.targets[look.placement], pixels[number], sd_px, readings[number])
        for number, look in enumerate(log.looks)
    )
    seen = [look.move for look, spot in zip(log.looks, spots, strict=True) if spot.status == "ok"]
    if seen:
        truth = replace(truth, reference_pose_deg=tuple(map(float, resting_deg[seen].mean(axis=0))))
    full_header = {"name": "simulated campaign", "synthetic": True, "seed": int(seed), **(header or {})}
    campaign = Campaign(tuple(log.moves), spots, rig.stereo, rig.table, full_header)
    return SimulatedCampaign(campaign, truth, light)


def _drive(
    moves: list[Move],
    truth: Truth,
    harmonic_period_deg: Mapping[str, float],
    stops: np.random.Generator,
    homes: np.random.Generator,
) -> tuple[Truth, np.ndarray]:
    """Realise the mirror angles of all moves; also return (n, 2) angles without stop errors, degrees."""
    p = truth.parameters
    counters = np.array([(m.pan_steps, m.tilt_steps) for m in moves], float).reshape(-1, 2)
    segments = np.array([m.segment for m in moves], int)
    first = np.diff(segments, prepend=-1) != 0
    home_draws = HOME_SD_DEG * homes.standard_normal((int(segments.max(initial=0)) + 1, 2))
    home_draws[0] = 0.0
    stop_draws, start_draws = (
        stops.standard_normal((len(moves), 2)),
        stops.uniform(-0.5, 0.5, (len(moves), 2)),
    )
    resting, errors = np.empty_like(counters), np.empty_like(counters)
    for i, (axis, positive, negative) in enumerate((("pan", "left", "right"), ("tilt", "up", "down"))):
        approach = [m.pan_approach if axis == "pan" else m.tilt_approach for m in moves]
        side = {positive: -0.5, negative: 0.5}
        start = np.array([side.get(name, draw) for name, draw in zip(approach, start_draws[:, i], strict=True)])
        ratios = p[f"degrees_per_step.{axis}"], p[f"ratio_contrast_deg_per_step.{axis}"]
        backlash = p[f"backlash_deg.{axis}"]
        resting[:, i] = transmission(
            counters[:, i],
            first,
            start,
            home_draws[segments, i],
            ratios,
            backlash,
            harmonics_deg(p, axis),
            harmonic_period_deg.get(axis, FULL_TURN_DEG),
        )
        sds = {"+": p[f"stop_sd_deg.{positive}"], "-": p[f"stop_sd_deg.{negative}"]}
        errors[:, i] = stop_errors(counters[:, i], first, approach, stop_draws[:, i], sds)
    resting[:, 1] += p["tilt_zero_deg"]
    realised = replace(
        truth,
        mirror_angles_deg=tuple(map(tuple, (resting + errors).tolist())),
        stop_errors_deg=tuple(map(tuple, errors.tolist())),
        home_offsets_deg=tuple(map(tuple, home_draws.tolist())),
    )
    return realised, resting


def _light(log: PlanLog, rig: Rig, truth: Truth, rng: np.random.Generator) -> tuple[Light, np.ndarray]:
    """Where each look's beam meets its sheet, and the same points (n, 3) in P, mm; NaN where it never does."""
    p = truth.parameters
    rotation = rotation_matrix(np.array([p[f"extrinsics.rotation_rad.{a}"] for a in "xyz"]))
    translation = np.array([p[f"extrinsics.translation_mm.{a}"] for a in "xyz"])
    placements = rng.standard_normal((len(log.targets), 3))
    depth = np.array([rig.sheets_mm[name] for name in log.targets]) + SHEET_DEPTH_SD_MM * placements[:, 0]
    slope = np.tan(np.radians(SHEET_TILT_SD_DEG * placements[:, 1:]))
    normals = np.column_stack((np.ones(len(depth)), slope))
    move, placement = np.array([(look.move, look.placement) for look in log.looks], int).reshape(-1, 2).T
    angles = np.radians(np.array(truth.mirror_angles_deg).reshape(-1, 2)[move])
    origin_P, direction_P = mirror_chain(angles[:, 0], angles[:, 1], p)
    origin, direction = origin_P @ rotation.T + translation, direction_P @ rotation.T
    normal = normals[placement]
    with np.errstate(divide="ignore"):
        distance = (depth[placement] - np.sum(origin * normal, axis=1)) / np.sum(direction * normal, axis=1)
    distance = np.where(distance > 0, distance, np.nan)[:, None]
    return Light(origin + distance * direction, direction, normal), origin_P + distance * direction_P


def _spot(
    number: int,
    look: PlannedLook,
    target: str,
    pixels: np.ndarray,
    sd_px: float,
    b: float | None,
) -> Spot:
    """A row of spots.csv; the aperture sees what a camera sees, so an unseen spot has no reading."""
    step = look.step
    if not np.isfinite(pixels).all():
        empty = (None,) * 8
        return Spot(number, look.move, target, step.experiment, step.point, *empty, status="undetected")
    values = (*map(float, pixels), *(sd_px,) * 4)
    return Spot(number, look.move, target, step.experiment, step.point, *values, aperture_deg=b)
