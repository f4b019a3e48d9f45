"""Simulation of a plan on a drawn true rig: the campaign as a user would get it, with its truth.

Frames S (stereo) and P (positioner), mm; degrees where a name says `_deg`; pixels with the integer at the centre of a
pixel. Rig, stop errors, home offsets, sheets, pixels, aperture, drift, errors of gears, homing sides and scatter of
looks have separate random streams: changing one does not change the others.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tvsbayes.display import Shown, View
from tvsbayes.files.disk import write_folder
from tvsbayes.instrument.axes import FULL_TURN_DEG, HOME_APPROACH, SIDES, PanApproach, TiltApproach
from tvsbayes.instrument.campaign import UNDETECTED, Campaign, Move, Spot, campaign_bytes, stereo_spots, with_pixels
from tvsbayes.instrument.conditions import powered_on_s
from tvsbayes.instrument.mechanisms import mechanism_of
from tvsbayes.instrument.parameters import Prior
from tvsbayes.instrument.plan import PlanLog, PlannedLook, PlanStep, run_plan
from tvsbayes.instrument.rig import PERIODIC_NAMES, Rig, RigTable, require_periods
from tvsbayes.instrument.sightings import Sighting
from tvsbayes.twin.gear_errors import PERFECT, draw_gear_errors, drift_deg, kelvin_of, zero_shift_deg
from tvsbayes.twin.head_physics import sighted_angles
from tvsbayes.twin.physics import (
    Light,
    Sheet,
    aperture_angle_deg,
    harmonics_deg,
    inside_images,
    light_on_sheet,
    mirror_chain,
    project,
    stop_errors,
    to_tvs,
    transmission,
)
from tvsbayes.twin.true_rig import Truth, draw_truth, pan_and_tilt

SHEET_DEPTH_SD_MM = 1.0
"""Standard deviation of a sheet's depth about its nominal X, placed by hand against a stop."""
SHEET_TILT_SD_DEG = 0.5
"""Standard deviation of a placed sheet's rotation about Y and about Z, each."""
STREAMS = "truth", "stops", "homes", "sheets", "pixels", "aperture", "drift", "gears", "sides", "looks"
_Streams = Mapping[str, np.random.Generator]
HOME_SIDE_CHANCES = 0.45, 0.45, 0.1
"""Probabilities that homings always end from the left (up), from the right (down), or anywhere (formulation 3.1)."""


@dataclass(frozen=True, repr=False)
class SimulatedCampaign(Shown):
    """Result of a simulation: the campaign as a user would get it, its truth, and the light for pictures."""

    campaign: Campaign
    truth: Truth
    light: Light

    def shown(self) -> View:
        """Show the campaign; the truth is in `truth`."""
        view = self.campaign.shown()
        return replace(view, title=f"Simulated {view.title}; the truth is in .truth")

    def undetected(self) -> SimulatedCampaign:
        """Return the same run before detection in its pictures: no pixels, status "undetected"."""
        spots = tuple(with_pixels(spot, UNDETECTED) for spot in stereo_spots(self.campaign.spots))
        return replace(self, campaign=replace(self.campaign, spots=spots))

    def files(self) -> dict[str, bytes]:
        """Return the contents of the campaign folder and of truth.json by name, campaign.toml last."""
        entries = (
            f' "{key}": {json.dumps(value, indent=2 if isinstance(value, dict) else None, allow_nan=False)}'
            for key, value in self.truth.as_json(self.campaign).items()
        )
        truth = ("{\n" + ",\n".join(entries) + "\n}\n").encode()
        return {"truth.json": truth, **campaign_bytes(self.campaign)}

    def write(self, folder: str | Path) -> None:
        """Write the campaign folder and its truth.json."""
        write_folder(Path(folder), self.files())


def simulate(
    rig: Rig,
    plan: Iterable[PlanStep],
    seed: int,
    truth: Truth | None = None,
    *,
    aperture: bool = False,
    spot_sd_px: float | None = None,
    home_approach: tuple[PanApproach, TiltApproach] | None = HOME_APPROACH,
    sides_recorded: bool = True,
    header: Mapping[str, object] | None = None,
    temperature_degC: Callable[[np.ndarray], np.ndarray] | None = None,
) -> SimulatedCampaign:
    """Run a plan on a true rig and return the campaign as a user would get it, with its truth.

    Args:
        rig: declared rig; its table and stereo calibration go into the campaign.
        plan: plan steps in order.
        seed: seed of all random numbers; recorded in the campaign.
        truth: the true rig; None draws one with `draw_truth`.
        aperture: whether each look also reads the aperture angle.
        spot_sd_px: standard uncertainty stated for every coordinate, by default `[cameras] spot_sd_px`;
            true noise is this times pixel_scale.
        home_approach: side from which each homing ends, (pan, tilt); "unknown" is anywhere in the play, drawn each
            time; None draws one of the three per axis, by `HOME_SIDE_CHANCES`.
        sides_recorded: whether the campaign records it; False writes "unknown" for any side.
        header: further keys of campaign.toml; the zeros creep from `powered_on` on, by default from the first move.
        temperature_degC: temperature of the machine at times (n,) in s, recorded with every move; None for no records.

    Raises:
        InputError: the plan looks before a sheet is placed, or names a sheet that the rig does not have; or the true
            rig has a transmission error whose period the declared one does not state.
    """
    seeds = np.random.SeedSequence(seed).spawn(len(STREAMS))
    streams = dict(zip(STREAMS, map(np.random.default_rng, seeds), strict=True))
    if truth is None:
        truth = draw_truth(rig, streams["truth"])
    if truth.gear_errors is None:
        errors = draw_gear_errors(truth.parameters, rig.table.harmonic_period_deg, streams["gears"])
        truth = replace(truth, gear_errors=errors)
    if home_approach is None:
        home_approach = draw_home_approach(streams["sides"])
    sd_px = rig.spot_sd_px if spot_sd_px is None else float(spot_sd_px)
    log = run_plan(plan, rig, home_approach)
    fixed = {name: Prior(value, 0.0) for name, value in truth.parameters.items() if name in PERIODIC_NAMES}
    require_periods(fixed, rig.table.harmonic_period_deg)
    full_header = {"name": "simulated campaign", "synthetic": True, "seed": int(seed), **(header or {})}
    if temperature_degC is not None:
        time_s = np.array([move.time_s for move in log.moves])
        measured = np.asarray(temperature_degC(time_s), float).tolist()
        log.moves = [replace(move, temperature_degC=one) for move, one in zip(log.moves, measured, strict=True)]
    truth, resting_deg = _drive(log.moves, truth, rig.table, streams, powered_on_s(full_header))
    truth = replace(truth, homing_side=home_approach)
    looks: tuple[Spot | Sighting, ...]
    if not rig.has_images:
        light = Light(*[np.zeros((0, 3))] * 4)
        looks = _sightings(log, rig, truth, streams)
    else:
        light = _light(log, rig, truth, streams)
        pixels = project(light.points_mm, truth.stereo_pair, truth.parameters["focal_scale"])
        noise_px = truth.parameters["pixel_scale"] * sd_px * streams["pixels"].standard_normal(pixels.shape)
        pixels = inside_images(pixels + noise_px, truth.stereo_pair)
        angles = _aperture_deg(light, truth.parameters, rig, streams["aperture"]) if aperture else [None] * len(pixels)
        looks = tuple(
            _spot(number, look, log.targets[look.placement], pixels[number], sd_px, angles[number])
            for number, look in enumerate(log.looks)
        )
    moves_seen = [look.move for look in looks if look.status == "ok"]
    if moves_seen:
        pan, tilt = resting_deg[moves_seen].mean(axis=0)
        truth = replace(truth, reference_pose_deg=(float(pan), float(tilt)))
    moves = log.moves
    if not sides_recorded:
        unknown = {"pan_approach": "unknown", "tilt_approach": "unknown"}
        moves = [replace(move, **unknown) if move.pan_approach else move for move in moves]  # type: ignore[arg-type]
    campaign = Campaign(tuple(moves), looks, rig.stereo, rig.table, full_header)
    return SimulatedCampaign(campaign, truth, light)


def draw_home_approach(rng: np.random.Generator) -> tuple[PanApproach, TiltApproach]:
    """Draw how a machine homes: always from one side, always from the other, or anywhere, for each axis."""
    pan: tuple[PanApproach, ...] = ("left", "right", "unknown")
    tilt: tuple[TiltApproach, ...] = ("up", "down", "unknown")
    one, two = (int(number) for number in rng.choice(3, 2, p=HOME_SIDE_CHANCES))
    return pan[one], tilt[two]


def _drive(
    moves: Sequence[Move], truth: Truth, rig: RigTable, streams: _Streams, on_s: float | None
) -> tuple[Truth, np.ndarray]:
    """Drive a machine switched on at `on_s`, by default at the first move.

    Returns:
        The true rig with its angles, stop errors and home offsets as realised; the angles (n, 2) without stop errors.
    """
    p = truth.parameters
    counters = np.array([(m.pan_steps, m.tilt_steps) for m in moves], float).reshape(-1, 2)
    segments = np.array([m.segment for m in moves], int)
    first = np.diff(segments, prepend=-1) != 0
    home_sd_deg = [0.0 if axis in rig.absolute else p[f"home_sd_deg.{axis}"] for axis in SIDES]
    home_draws = np.array(home_sd_deg) * streams["homes"].standard_normal((int(segments.max(initial=0)) + 1, 2))
    home_draws[0] = 0.0
    stop_draws = streams["stops"].standard_normal((len(moves), 2))
    start_draws = streams["stops"].uniform(-0.5, 0.5, (len(moves), 2))
    drift_draws, time_s = streams["drift"].standard_normal((len(moves), 2)), np.array([m.time_s for m in moves])
    warm_minutes = (time_s - (time_s[0] if on_s is None else on_s)) / 60.0
    kelvin = kelvin_of(moves)
    resting, errors, drift = np.empty_like(counters), np.empty_like(counters), np.empty_like(counters)
    for i, (axis, (negative, positive)) in enumerate(SIDES.items()):
        approach = [getattr(m, f"{axis}_approach") for m in moves]
        side = {positive: -0.5, negative: 0.5}
        start = np.array([side.get(name, draw) for name, draw in zip(approach, start_draws[:, i], strict=True)])
        ratios = p[f"degrees_per_step.{axis}"], p[f"ratio_contrast_deg_per_step.{axis}"]
        repeated = (truth.gear_errors or PERFECT)[axis]
        place_deg = p[f"degrees_per_step.{axis}"] * counters[:, i]
        resting[:, i] = transmission(
            counters[:, i],
            first,
            start,
            home_draws[segments, i],
            ratios,
            repeated.play_at(p[f"backlash_deg.{axis}"], place_deg),
            harmonics_deg(p, axis),
            rig.first_period_deg.get(axis, FULL_TURN_DEG),
        )
        scale = p.get(f"drift_deg_per_root_hour.{axis}", 0.0)
        # The zero that an absolute encoder keeps drifts on.
        is_set = np.arange(len(moves)) == 0 if axis in rig.absolute else first
        drift[:, i] = drift_deg(time_s, is_set, scale, drift_draws[:, i], repeated.warming_deg)
        resting[:, i] += repeated.error_deg(place_deg) + drift[:, i]
        resting[:, i] += zero_shift_deg(p, axis, warm_minutes, kelvin)
        sds = {"+": p[f"stop_sd_deg.{positive}"], "-": p[f"stop_sd_deg.{negative}"]}
        errors[:, i] = stop_errors(counters[:, i], first, approach, stop_draws[:, i], sds)
    resting[:, 1] += p[mechanism_of(p).tilt_zero]
    realised = replace(
        truth,
        mirror_angles_deg=pan_and_tilt((resting + errors).tolist()),
        stop_errors_deg=pan_and_tilt(errors.tolist()),
        home_offsets_deg=pan_and_tilt(home_draws.tolist()),
        drift_deg=pan_and_tilt(drift.tolist()),
    )
    return realised, resting


def placed_sheet(nominal_mm: np.ndarray | float, draws: np.ndarray) -> Sheet:
    """Place sheets (...) by hand at their nominal X; `draws` (..., 3) are standard normal."""
    slope = np.tan(np.radians(SHEET_TILT_SD_DEG * draws[..., 1:]))
    normal = np.concatenate((np.ones((*draws.shape[:-1], 1)), slope), axis=-1)
    return Sheet(nominal_mm + SHEET_DEPTH_SD_MM * draws[..., 0], normal)


def look_scatter_deg(parameters: Mapping[str, float], normal: np.ndarray) -> np.ndarray:
    """Compute deviations of looks (..., pan and tilt) from the axes; `normal` (..., 2) are standard normal."""
    return normal * np.array([parameters.get(f"look_scatter_deg.{axis}", 0.0) for axis in SIDES])


def _seen_rad(log: PlanLog, truth: Truth, streams: _Streams) -> np.ndarray:
    """Compute the angles of both axes at each look, with its scatter, shape (2, looks)."""
    move = np.array([look.move for look in log.looks], int)
    off_deg = look_scatter_deg(truth.parameters, streams["looks"].standard_normal((len(move), 2)))
    return np.radians(np.array(truth.mirror_angles_deg).reshape(-1, 2)[move] + off_deg).T


def _light(log: PlanLog, rig: Rig, truth: Truth, streams: _Streams) -> Light:
    """Compute where each look's beam meets its sheet; NaN where it never does."""
    nominal_mm = np.array([rig.sheets_mm[name] for name in log.targets])
    sheets = placed_sheet(nominal_mm, streams["sheets"].standard_normal((len(log.targets), 3)))
    placement = np.array([look.placement for look in log.looks], int)
    psi, beta = _seen_rad(log, truth, streams)
    return light_on_sheet(psi, beta, truth.parameters, Sheet(sheets.depth_mm[placement], sheets.normal[placement]))


def _sightings(log: PlanLog, rig: Rig, truth: Truth, streams: _Streams) -> tuple[Sighting, ...]:
    """Compute the sighting of each look; the noise is that of `[cameras] sighting_sd_deg`."""
    psi, beta = _seen_rad(log, truth, streams)
    directions = mirror_chain(psi, beta, truth.parameters).direction
    noise = truth.parameters["pixel_scale"] * rig.sighting_sd_deg * streams["pixels"].standard_normal((len(psi), 2))
    angles, u_deg = sighted_angles(directions, noise).tolist(), rig.sighting_sd_deg
    return tuple(
        Sighting(sighting=k, move=look.move, azimuth_deg=azimuth, elevation_deg=elevation, u_deg=u_deg)
        for k, (look, (azimuth, elevation)) in enumerate(zip(log.looks, angles, strict=True))
    )


def _aperture_deg(light: Light, p: Mapping[str, float], rig: Rig, rng: np.random.Generator) -> list[float]:
    """Compute the aperture's reading of each look, its zero and noise included."""
    points_T = to_tvs(light.points_P_mm, p["baseline_mm"], p["pan_zero_emission_deg"])
    angle = aperture_angle_deg(points_T, p["baseline_mm"], rig.table.aperture_convention)
    noise = p["aperture_sd_deg"] * rng.standard_normal(len(angle))
    return [float(b) for b in angle + p["aperture_zero_deg"] + noise]


def _spot(
    number: int, look: PlannedLook, target: str, pixels: np.ndarray, sd_px: float, aperture_deg: float | None
) -> Spot:
    """Build a row of spots.csv; a spot that the cameras do not see has no aperture reading either."""
    numbers = look.step.experiment, look.step.point
    row = Spot(spot=number, move=look.move, target=target, experiment=numbers[0], point=numbers[1], status=UNDETECTED)
    if not np.isfinite(pixels).all():
        return row
    return with_pixels(replace(row, aperture_deg=aperture_deg), "ok", pixels.tolist(), (sd_px,) * 4)
