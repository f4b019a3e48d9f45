"""The digital twin: draws a true rig, runs a plan on it and writes down what the cameras would see.

It shares formats and parameter names with the estimators, but no formula: its physics is `optics`, NumPy.
Frames S (stereo), P (positioner) and T (TVS) as in DESIGN 2; mm; degrees and radians by suffix. The parts
of chance (rig, stop errors, sheets, pixels, aperture) have their own random streams: changing one leaves
the others as they were.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from tvsbayes.campaign import Campaign, Move, PlanStep, Spot, write_campaign
from tvsbayes.documents import JSON_BYTES_MAX, parse_json
from tvsbayes.files import InputError, read_bytes, write_atomically
from tvsbayes.optics import (
    aperture_angle_deg,
    effective_deg_per_step,
    effective_mirror_offset_mm,
    inside_images,
    mirror_chain,
    project,
    stop_errors,
    to_tvs,
    transmission,
)
from tvsbayes.rigs import (
    DECLARED_PRIORS,
    DEFAULT_PRIORS,
    HOME_SD_DEG,
    STEREO_PARAMETER_NAMES,
    Prior,
    Rig,
    Stereo,
    rotation_matrix,
)

SHEET_DEPTH_SD_MM = 1.0
"""Standard deviation of a placed sheet's depth about its nominal X: a hand against a stop."""
SHEET_TILT_SD_DEG = 0.5
"""Standard deviation of a placed sheet's rotation about Y and about Z, each."""
SPOT_SD_PX = 0.08
"""Standard uncertainty stated for a spot centre where neither caller nor rig names one."""
COST_KEYS = {"home": "move_s", "place": "placement_s", "move": "move_s", "look": "look_s"}
"""Entry of `[costs]` that each action of a plan takes; a homing counts as a move."""
TRUTH_FORMAT = "tvsbayes-truth/1"
HOME_APPROACH = ("left", "up")
"""Side from which homing ends, per axis, where the caller names none."""


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
class SimulatedCampaign:
    """What the twin wrote: the campaign as a stranger would get it, and the truth behind it."""

    campaign: Campaign
    truth: Truth

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


@dataclass
class _Log:
    """What the plan did, in time order, while it is being read."""

    moves: list[Move] = field(default_factory=list)
    looks: list[tuple[PlanStep, int, int]] = field(default_factory=list)
    targets: list[str] = field(default_factory=list)


def _run_plan(plan: Iterable[PlanStep], rig: Rig, home_approach: tuple[str, str]) -> _Log:
    """Turn plan steps into moves and looks (step, move, placement index).

    A plan that does not begin with `home` is taken as homed at counters 0, 0. Empty counters of a move
    keep the axis where it is.
    """
    log, time_s, segment = _Log(), 0.0, -1
    for step in plan:
        if step.action == "home" or (not log.moves and step.action in ("move", "look")):
            segment += 1
            counters = (step.pan_steps or 0, step.tilt_steps or 0) if step.action == "home" else (0, 0)
            log.moves.append(Move(len(log.moves), segment, time_s, *counters, *home_approach))
        if step.action == "move":
            last = log.moves[-1]
            pan = last.pan_steps if step.pan_steps is None else step.pan_steps
            tilt = last.tilt_steps if step.tilt_steps is None else step.tilt_steps
            log.moves.append(Move(len(log.moves), segment, time_s, pan, tilt))
        elif step.action == "place":
            if step.target not in rig.sheets_mm:
                raise InputError(
                    "unknown-target",
                    f"plan step {step.step} places target {step.target!r}, which the rig does not have",
                    column="target",
                    found=step.target,
                    allowed=", ".join(rig.sheets_mm) or "a target named in [sheets]",
                    remedy="add the target's nominal X to [sheets] of the rig file",
                )
            log.targets.append(step.target)
        elif step.action == "look":
            if not log.targets:
                raise InputError(
                    "no-target",
                    f"plan step {step.step} looks before a target is placed",
                    column="action",
                    remedy="put a `place` step before the first `look`",
                )
            log.looks.append((step, len(log.moves) - 1, len(log.targets) - 1))
        time_s += float(rig.costs_s.get(COST_KEYS[step.action], 0.0))
    return log


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
        InputError: the plan looks before a sheet is placed, or names a sheet the rig does not have.
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
    log = _run_plan(plan, rig, home_approach)
    truth, resting_deg = _drive(log.moves, truth, streams["stops"], streams["homes"])
    points_S, points_P = _light(log, rig, truth, streams["sheets"])
    p = truth.parameters
    pixels = project(points_S, truth.stereo, p["focal_scale"])
    noise_px = p["pixel_scale"] * sd_px * streams["pixels"].standard_normal(pixels.shape)
    pixels = inside_images(pixels + noise_px, truth.stereo)
    readings: list[float | None] = [None] * len(pixels)
    if aperture:
        points_T = to_tvs(points_P, p["baseline_mm"], p["pan_zero_emission_deg"])
        angle = aperture_angle_deg(points_T, p["baseline_mm"], rig.table.aperture_convention)
        noise = p["aperture_sd_deg"] * streams["aperture"].standard_normal(len(pixels))
        readings = [float(b) for b in angle + p["aperture_zero_deg"] + noise]
    spots = tuple(
        _spot(number, look, log.targets[placement], pixels[number], sd_px, readings[number])
        for number, (look, placement) in enumerate((entry, entry[2]) for entry in log.looks)
    )
    seen = [look[1] for look, spot in zip(log.looks, spots, strict=True) if spot.status == "ok"]
    if seen:
        truth = replace(truth, reference_pose_deg=tuple(map(float, resting_deg[seen].mean(axis=0))))
    full_header = {"name": "simulated campaign", "synthetic": True, "seed": int(seed), **(header or {})}
    campaign = Campaign(tuple(log.moves), spots, rig.stereo, rig.table, full_header)
    return SimulatedCampaign(campaign, truth)


def _drive(
    moves: list[Move], truth: Truth, stops: np.random.Generator, homes: np.random.Generator
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
        resting[:, i] = transmission(counters[:, i], first, start, home_draws[segments, i], ratios, backlash)
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


def _light(log: _Log, rig: Rig, truth: Truth, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Where each look's beam meets its sheet: points (n, 3) in S and in P, mm; NaN where it never does."""
    p = truth.parameters
    rotation = rotation_matrix(np.array([p[f"extrinsics.rotation_rad.{a}"] for a in "xyz"]))
    translation = np.array([p[f"extrinsics.translation_mm.{a}"] for a in "xyz"])
    placements = rng.standard_normal((len(log.targets), 3))
    depth = np.array([rig.sheets_mm[name] for name in log.targets]) + SHEET_DEPTH_SD_MM * placements[:, 0]
    slope = np.tan(np.radians(SHEET_TILT_SD_DEG * placements[:, 1:]))
    normals = np.column_stack((np.ones(len(depth)), slope))
    move, placement = np.array([look[1:] for look in log.looks], int).reshape(-1, 2).T
    angles = np.radians(np.array(truth.mirror_angles_deg).reshape(-1, 2)[move])
    origin_P, direction_P = mirror_chain(angles[:, 0], angles[:, 1], p)
    origin, direction = origin_P @ rotation.T + translation, direction_P @ rotation.T
    normal = normals[placement]
    with np.errstate(divide="ignore"):
        distance = (depth[placement] - np.sum(origin * normal, axis=1)) / np.sum(direction * normal, axis=1)
    distance = np.where(distance > 0, distance, np.nan)[:, None]
    return origin + distance * direction, origin_P + distance * direction_P


def _spot(
    number: int,
    look: tuple[PlanStep, int, int],
    target: str,
    pixels: np.ndarray,
    sd_px: float,
    b: float | None,
) -> Spot:
    """A row of spots.csv; the aperture sees what a camera sees, so an unseen spot has no reading."""
    step, move, _ = look
    if not np.isfinite(pixels).all():
        empty = (None,) * 8
        return Spot(number, move, target, step.experiment, step.point, *empty, status="undetected")
    values = (*map(float, pixels), *(sd_px,) * 4)
    return Spot(number, move, target, step.experiment, step.point, *values, aperture_deg=b)
