"""A true rig drawn, a plan run on it, and what a stranger would get: the campaign, with the truth beside it.

Frames S (stereo) and P (positioner), mm; degrees where a name says `_deg`; pixels with the integer at the centre of a
pixel. The parts of chance (rig, stop errors, home offsets, sheets, pixels, aperture) have their own random streams:
changing one leaves the others as they were.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NotRequired, TypedDict, cast

import numpy as np

from tvsbayes.errors import InputError
from tvsbayes.files.disk import read_bytes, write_atomically
from tvsbayes.files.documents import JSON_BYTES_MAX, parse_json
from tvsbayes.instrument.axes import FULL_TURN_DEG, HOME_APPROACH, HOME_SD_DEG, SIDES, PanApproach, TiltApproach
from tvsbayes.instrument.campaign import NO_PIXELS, Campaign, Move, Spot, with_pixels, write_campaign
from tvsbayes.instrument.parameters import GEAR_ERROR_NAMES, HARMONIC_NAMES, RIG_NAMES, STEREO_PARAMETER_NAMES, Prior
from tvsbayes.instrument.plan import PlanLog, PlannedLook, PlanStep, run_plan
from tvsbayes.instrument.rig import PERIODIC_NAMES, Rig, require_periods
from tvsbayes.instrument.stereo_pair import Stereo
from tvsbayes.twin.physics import (
    Light,
    Sheet,
    aperture_angle_deg,
    effective_deg_per_step,
    effective_mirror_offset_mm,
    harmonics_deg,
    inside_images,
    light_on_sheet,
    project,
    stop_errors,
    to_tvs,
    transmission,
)

SHEET_DEPTH_SD_MM = 1.0
"""Standard deviation of a placed sheet's depth about its nominal X: a hand against a stop."""
SHEET_TILT_SD_DEG = 0.5
"""Standard deviation of a placed sheet's rotation about Y and about Z, each."""
TRUTH_FORMAT = "tvsbayes-truth/1"
Pair = tuple[float, float]
"""Of pan and tilt."""


class TruthDocument(TypedDict):
    """truth.json; see `Truth`."""

    format: str
    note: str
    parameters: dict[str, float]
    stereo: dict[str, float]
    mirror_angles_deg: Sequence[Pair]
    stop_errors_deg: Sequence[Pair]
    home_offsets_deg: Sequence[Pair]
    reference_pose_deg: Pair | None
    effective_deg_per_step: NotRequired[dict[str, float]]
    effective_mirror_offset_mm: NotRequired[float]


@dataclass(frozen=True)
class Truth:
    """A true rig: what no estimator may read.

    Attributes:
        parameters: every physical parameter by its contract name, derived ones included.
        stereo: the true cameras (the campaign carries the stated ones).
        mirror_angles_deg: (psi, beta) of each move as realised, stop errors included; empty before a run.
        stop_errors_deg: (pan, tilt) stop error of each move, as held.
        home_offsets_deg: (pan, tilt) per segment.
        reference_pose_deg: mean (psi, beta) over the ok spots without stop errors, None before a run.
        note: what a reader of truth.json should know.
    """

    parameters: dict[str, float]
    stereo: Stereo
    mirror_angles_deg: tuple[Pair, ...] = ()
    stop_errors_deg: tuple[Pair, ...] = ()
    home_offsets_deg: tuple[Pair, ...] = ()
    reference_pose_deg: Pair | None = None
    note: str = "The true rig of a simulated campaign; no estimator reads this file."

    def as_json(self) -> TruthDocument:
        """The document of truth.json, with the effective ratios at the reference pose where one is known."""
        document: TruthDocument = {
            "format": TRUTH_FORMAT,
            "note": self.note,
            "parameters": {name: float(value) for name, value in self.parameters.items()},
            "stereo": dict(zip(STEREO_PARAMETER_NAMES, map(float, self.stereo.vector), strict=True)),
            "mirror_angles_deg": self.mirror_angles_deg,
            "stop_errors_deg": self.stop_errors_deg,
            "home_offsets_deg": self.home_offsets_deg,
            "reference_pose_deg": self.reference_pose_deg,
        }
        if self.reference_pose_deg is not None:
            document["effective_deg_per_step"] = effective_deg_per_step(self.parameters, self.reference_pose_deg)
            document["effective_mirror_offset_mm"] = effective_mirror_offset_mm(
                self.parameters, self.reference_pose_deg
            )
        return document

    @classmethod
    def from_json(cls, document: TruthDocument, stated: Stereo) -> Truth:
        """Rebuild from truth.json; image size and covariance come from the campaign's `stated` stereo."""
        pose, known = document["reference_pose_deg"], document["stereo"]
        return cls(
            parameters={name: float(value) for name, value in document["parameters"].items()},
            stereo=stated.with_vector(np.array([float(known[name]) for name in STEREO_PARAMETER_NAMES])),
            mirror_angles_deg=pan_and_tilt(document["mirror_angles_deg"]),
            stop_errors_deg=pan_and_tilt(document["stop_errors_deg"]),
            home_offsets_deg=pan_and_tilt(document["home_offsets_deg"]),
            reference_pose_deg=None if pose is None else (float(pose[0]), float(pose[1])),
            note=str(document["note"]),
        )


@dataclass(frozen=True)
class SimulatedCampaign:
    """What the twin wrote: the campaign as a stranger would get it, and the truth and the light behind it."""

    campaign: Campaign
    truth: Truth
    light: Light

    def undetected(self) -> SimulatedCampaign:
        """The same run before anybody has looked at its pictures: no pixels, status "undetected"."""
        spots = tuple(with_pixels(spot, "undetected") for spot in self.campaign.spots)
        return replace(self, campaign=replace(self.campaign, spots=spots))

    def write(self, folder: str | Path) -> None:
        """Write the campaign folder and its truth.json."""
        write_campaign(self.campaign, Path(folder))
        entries = (
            f' "{key}": {json.dumps(value, indent=2 if isinstance(value, dict) else None, allow_nan=False)}'
            for key, value in self.truth.as_json().items()
        )
        write_atomically(Path(folder) / "truth.json", ("{\n" + ",\n".join(entries) + "\n}\n").encode())


def pan_and_tilt(rows: Iterable[Sequence[float]]) -> tuple[Pair, ...]:
    """Rows of two numbers as a `Truth` holds them."""
    return tuple((float(pan), float(tilt)) for pan, tilt in rows)


def read_truth(path: str | Path, stated: Stereo) -> Truth:
    """Read a truth.json; `stated` is the stereo calibration of its campaign.

    Raises:
        InputError: unreadable, or not a truth file of this format.
    """
    path = Path(path)
    keys = parse_json(read_bytes(path, JSON_BYTES_MAX), path.name)
    keys.word("format", (TRUTH_FORMAT,))
    try:
        # What stands in the entries is converted, or refused below.
        return Truth.from_json(cast("TruthDocument", keys.values), stated)
    except (AttributeError, KeyError, TypeError, ValueError, IndexError) as error:
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
    # Of a stream of its own: rigs with perfect gears are the same rigs whatever is drawn here.
    (gears,) = rng.spawn(1)

    def drawn(names: Iterable[str], stream: np.random.Generator) -> dict[str, float]:
        return {name: _draw(rig.truth.get(name, rig.table.priors[name]), stream) for name in names}

    parameters = drawn((n for n in RIG_NAMES if n not in (*HARMONIC_NAMES, *GEAR_ERROR_NAMES)), rng)
    # Through the eigenvectors: fixed parameters give a semi-definite covariance that Cholesky refuses.
    variances, vectors = np.linalg.eigh(np.asarray(rig.stereo.parameter_covariance, float))
    offset = vectors @ (np.sqrt(np.clip(variances, 0.0, None)) * rng.standard_normal(len(variances)))
    # Last: rigs without transmission error are the same rigs whatever is drawn here.
    parameters |= drawn(HARMONIC_NAMES, rng) | drawn(GEAR_ERROR_NAMES, gears)
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
    """Add the four directional ratios that mean ratios and contrasts imply (formulation 3.1)."""
    result = dict(parameters)
    for axis, (negative, positive) in SIDES.items():
        ratio, contrast = result[f"degrees_per_step.{axis}"], result[f"ratio_contrast_deg_per_step.{axis}"]
        result[f"degrees_per_step.{positive}"] = ratio + contrast / 2
        result[f"degrees_per_step.{negative}"] = ratio - contrast / 2
    return result


@dataclass(frozen=True)
class _Streams:
    """The parts of chance in a simulated campaign."""

    truth: np.random.Generator
    stops: np.random.Generator
    homes: np.random.Generator
    sheets: np.random.Generator
    pixels: np.random.Generator
    aperture: np.random.Generator


def simulate(
    rig: Rig,
    plan: Iterable[PlanStep],
    seed: int,
    truth: Truth | None = None,
    *,
    aperture: bool = False,
    spot_sd_px: float | None = None,
    home_approach: tuple[PanApproach, TiltApproach] = HOME_APPROACH,
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
    streams = _Streams(*map(np.random.default_rng, np.random.SeedSequence(seed).spawn(6)))
    if truth is None:
        truth = draw_truth(rig, streams.truth)
    sd_px = rig.spot_sd_px if spot_sd_px is None else float(spot_sd_px)
    log = run_plan(plan, rig, home_approach)
    fixed = {name: Prior(value, 0.0) for name, value in truth.parameters.items() if name in PERIODIC_NAMES}
    require_periods(fixed, rig.table.harmonic_period_deg)
    driven = _drive(log.moves, truth, rig.table.first_period_deg, streams)
    truth = driven.truth
    light = _light(log, rig, truth, streams.sheets)
    pixels = project(light.points_mm, truth.stereo, truth.parameters["focal_scale"])
    noise_px = truth.parameters["pixel_scale"] * sd_px * streams.pixels.standard_normal(pixels.shape)
    pixels = inside_images(pixels + noise_px, truth.stereo)
    angles = _aperture_deg(light, truth.parameters, rig, streams.aperture) if aperture else [None] * len(pixels)
    spots = tuple(
        _spot(number, look, log.targets[look.placement], pixels[number], sd_px, angles[number])
        for number, look in enumerate(log.looks)
    )
    seen = [look.move for look, spot in zip(log.looks, spots, strict=True) if spot.status == "ok"]
    if seen:
        pan, tilt = driven.resting_deg[seen].mean(axis=0)
        truth = replace(truth, reference_pose_deg=(float(pan), float(tilt)))
    full_header = {"name": "simulated campaign", "synthetic": True, "seed": int(seed), **(header or {})}
    campaign = Campaign(tuple(log.moves), spots, rig.stereo, rig.table, full_header)
    return SimulatedCampaign(campaign, truth, light)


@dataclass(frozen=True)
class _Driven:
    """A true rig with its angles, stop errors and home offsets as realised; the angles (n, 2) without stop errors."""

    truth: Truth
    resting_deg: np.ndarray


def _drive(moves: Sequence[Move], truth: Truth, first_period_deg: Mapping[str, float], streams: _Streams) -> _Driven:
    """Realise the mirror angles of all moves."""
    p = truth.parameters
    counters = np.array([(m.pan_steps, m.tilt_steps) for m in moves], float).reshape(-1, 2)
    segments = np.array([m.segment for m in moves], int)
    first = np.diff(segments, prepend=-1) != 0
    home_draws = HOME_SD_DEG * streams.homes.standard_normal((int(segments.max(initial=0)) + 1, 2))
    home_draws[0] = 0.0
    stop_draws = streams.stops.standard_normal((len(moves), 2))
    start_draws = streams.stops.uniform(-0.5, 0.5, (len(moves), 2))
    resting, errors = np.empty_like(counters), np.empty_like(counters)
    for i, (axis, (negative, positive)) in enumerate(SIDES.items()):
        approach = [getattr(m, f"{axis}_approach") for m in moves]
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
            first_period_deg.get(axis, FULL_TURN_DEG),
        )
        sds = {"+": p[f"stop_sd_deg.{positive}"], "-": p[f"stop_sd_deg.{negative}"]}
        errors[:, i] = stop_errors(counters[:, i], first, approach, stop_draws[:, i], sds)
    resting[:, 1] += p["tilt_zero_deg"]
    realised = replace(
        truth,
        mirror_angles_deg=pan_and_tilt((resting + errors).tolist()),
        stop_errors_deg=pan_and_tilt(errors.tolist()),
        home_offsets_deg=pan_and_tilt(home_draws.tolist()),
    )
    return _Driven(realised, resting)


def placed_sheet(nominal_mm: np.ndarray | float, draws: np.ndarray) -> Sheet:
    """Sheets (...) as a hand puts them at their nominal X; `draws` (..., 3) are standard normal."""
    slope = np.tan(np.radians(SHEET_TILT_SD_DEG * draws[..., 1:]))
    normal = np.concatenate((np.ones((*draws.shape[:-1], 1)), slope), axis=-1)
    return Sheet(nominal_mm + SHEET_DEPTH_SD_MM * draws[..., 0], normal)


def _light(log: PlanLog, rig: Rig, truth: Truth, rng: np.random.Generator) -> Light:
    """Where each look's beam meets its sheet; NaN where it never does."""
    nominal_mm = np.array([rig.sheets_mm[name] for name in log.targets])
    sheets = placed_sheet(nominal_mm, rng.standard_normal((len(log.targets), 3)))
    move, placement = np.array([(look.move, look.placement) for look in log.looks], int).reshape(-1, 2).T
    psi, beta = np.radians(np.array(truth.mirror_angles_deg).reshape(-1, 2)[move]).T
    return light_on_sheet(psi, beta, truth.parameters, Sheet(sheets.depth_mm[placement], sheets.normal[placement]))


def _aperture_deg(light: Light, p: Mapping[str, float], rig: Rig, rng: np.random.Generator) -> list[float]:
    """What the aperture reads of each look, its zero and noise included."""
    points_T = to_tvs(light.points_P_mm, p["baseline_mm"], p["pan_zero_emission_deg"])
    angle = aperture_angle_deg(points_T, p["baseline_mm"], rig.table.aperture_convention)
    noise = p["aperture_sd_deg"] * rng.standard_normal(len(angle))
    return [float(b) for b in angle + p["aperture_zero_deg"] + noise]


def _spot(
    number: int, look: PlannedLook, target: str, pixels: np.ndarray, sd_px: float, aperture_deg: float | None
) -> Spot:
    """A row of spots.csv; the aperture sees what a camera sees, so an unseen spot has no reading."""
    step = look.step
    row = Spot(number, look.move, target, step.experiment, step.point, *NO_PIXELS, *NO_PIXELS, status="undetected")
    if not np.isfinite(pixels).all():
        return row
    return with_pixels(replace(row, aperture_deg=aperture_deg), "ok", pixels.tolist(), (sd_px,) * 4)
