"""The digital twin: draws a true rig, runs a plan on it and writes down what the cameras would see.

It shares formats and parameter names with the estimators, but no formula: its physics (gears with play, mirrors,
cameras, aperture; DESIGN 3 and 5) is written here a second time, from the design alone, so that an error in the
estimators' model cannot hide in the twin. Frames S (stereo), P (positioner), Q (pan stage) and T (TVS) as in
DESIGN 2; mm; degrees and radians by suffix; pixels with the integer at the centre of a pixel. The parts of chance
(rig, stop errors, sheets, pixels, aperture) have their own random streams: changing one leaves the others as they
were.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from tvsbayes.campaign import Campaign, Move, PlanStep, Spot, write_campaign
from tvsbayes.files import JSON_BYTES_MAX, InputError, parse_json, read_bytes, write_atomically
from tvsbayes.rigs import (
    DECLARED_PRIORS,
    DEFAULT_PRIORS,
    FULL_TURN_DEG,
    HARMONIC_ORDERS,
    HARMONIC_PRIORS,
    HOME_SD_DEG,
    STEREO_PARAMETER_NAMES,
    Prior,
    Rig,
    Stereo,
    require_periods,
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


def plan_seconds(rig: Rig, plan: Iterable[PlanStep]) -> float:
    """Duration of a plan by `[costs]`, s; what a rig that no file describes leaves unstated costs nothing."""
    return sum(float(rig.costs_s.get(COST_KEYS[step.action], 0.0)) for step in plan)


TRUTH_FORMAT = "tvsbayes-truth/1"
HOME_APPROACH = ("left", "up")
"""Side from which homing ends, per axis, where the caller names none."""


def play(q_deg: Sequence[float], start_deg: float, backlash_deg: float) -> np.ndarray:
    """Output of a gear with play for driving angles q (n,), from output `start_deg` on."""
    output, y = np.empty(len(q_deg)), start_deg
    for i, q in enumerate(q_deg):
        y = min(max(y, q - backlash_deg / 2), q + backlash_deg / 2)
        output[i] = y
    return output


def transmission(
    counters: np.ndarray,
    first: np.ndarray,
    start_fraction: np.ndarray,
    home_deg: np.ndarray,
    ratios_deg_per_step: tuple[float, float],
    backlash_deg: float,
    harmonics_deg: Sequence[complex] = (),
    period_deg: float = FULL_TURN_DEG,
) -> np.ndarray:
    """Output angle (n,) in degrees of one axis after each move, stop errors excluded (DESIGN 3.1).

    Args:
        counters: (n,) absolute counters.
        first: (n,) True at the first row of a segment.
        start_fraction: (n,) where the play stands at such a row, -1/2 (left, up) to +1/2; unused elsewhere.
        home_deg: (n,) home offset of the row's segment.
        ratios_deg_per_step: mean ratio and contrast; positive moves turn by mean + contrast / 2 per step.
        backlash_deg: full width of the play.
        harmonics_deg: cosine part - i sine part of the transmission error for orders 1, 2 ...
        period_deg: its period in degrees of the output: a full turn for the wheel, behind the play; less for the
            pinion, before it.
    """
    mean, contrast = ratios_deg_per_step
    wheel = period_deg == FULL_TURN_DEG
    output = np.empty(len(counters))
    starts = [*np.flatnonzero(first), len(counters)]
    for begin, end in pairwise(starts):
        steps = np.diff(counters[begin:end])
        turned = steps * np.where(steps > 0, mean + contrast / 2, mean - contrast / 2)
        q = mean * counters[begin] + home_deg[begin] + np.concatenate(([0.0], np.cumsum(turned)))
        if not wheel:
            q = q + _wobble(q, harmonics_deg, period_deg)
        output[begin:end] = play(q, q[0] + start_fraction[begin] * backlash_deg, backlash_deg)
    return output + _wobble(output, harmonics_deg, period_deg) if wheel else output


def _wobble(angle_deg: np.ndarray, harmonics_deg: Sequence[complex], period_deg: float) -> np.ndarray:
    """Transmission error at angles: the real part of sum_o (c_o - i s_o) e^(i o phase)."""
    turn = np.exp(2j * np.pi * np.asarray(angle_deg) / period_deg)
    return sum((part * turn**order for order, part in enumerate(harmonics_deg, start=1)), np.zeros(len(turn))).real


def stop_errors(
    counters: np.ndarray,
    first: np.ndarray,
    approach: Sequence[str],
    draws: np.ndarray,
    sds: Mapping[str, float],
) -> np.ndarray:
    """Stop error (n,) of one axis as held after each move, in the unit of `sds`.

    Redrawn when this axis' counter changes, even if play absorbs the motion, and at first rows; held
    while only the other axis moves. `sds` maps "+", "-" to the standard deviation of positive and negative
    moves; an unknown approach takes their root mean square. `approach` (n,) is read at first rows.
    """
    held, error = np.empty(len(counters)), 0.0
    both = float(np.sqrt((sds["+"] ** 2 + sds["-"] ** 2) / 2))
    for i in range(len(counters)):
        if first[i]:
            side = {"left": "+", "up": "+", "right": "-", "down": "-"}.get(approach[i])
            error = draws[i] * (sds[side] if side else both)
        elif counters[i] != counters[i - 1]:
            error = draws[i] * sds["+" if counters[i] > counters[i - 1] else "-"]
        held[i] = error
    return held


def mirror_chain(
    psi_rad: np.ndarray | float, beta_rad: np.ndarray | float, geometry: Mapping[str, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Beam leaving mirror 2 for mirror angles psi, beta: origin (..., 3) mm and direction (..., 3) in P.

    True reflections at true intersections (DESIGN 3.2). The laser is turned into the pan stage Q instead
    of the mirrors out of it. `geometry` maps contract names to values.
    """
    psi, beta = np.broadcast_arrays(np.asarray(psi_rad, float), np.asarray(beta_rad, float))
    tx, ty = (np.tan(np.radians(geometry[f"laser_tilt_deg.{axis}"])) for axis in "xy")
    ox, oy = geometry["laser_offset_mm.x"], geometry["laser_offset_mm.y"]
    m1 = np.radians(45 + geometry["mirror1_error_deg"])
    m2 = np.radians(45 + geometry["mirror2_error_deg"])
    skew = np.radians(geometry["tilt_axis_skew_deg"])
    laser = np.array([tx, ty, -1.0]) / np.sqrt(tx * tx + ty * ty + 1)
    point = _about_z(np.broadcast_to([ox, oy, 0.0], (*psi.shape, 3)), -psi)
    direction = _about_z(np.broadcast_to(laser, (*psi.shape, 3)), -psi)
    point, direction = _reflect(point, direction, np.zeros(3), np.array([0.0, -np.sin(m1), np.cos(m1)]))
    centre = np.array(
        [geometry["tilt_axis_offset_mm.x"], -geometry["mirror_offset_mm"], geometry["tilt_axis_offset_mm.z"]]
    )
    axis = np.array([0.0, np.cos(skew), np.sin(skew)])
    across, up = np.array([1.0, 0.0, 0.0]), np.array([0.0, -np.sin(skew), np.cos(skew)])
    radial = np.cos(beta)[..., None] * across + np.sin(beta)[..., None] * up
    point, direction = _reflect(point, direction, centre, np.sin(m2) * radial + np.cos(m2) * axis)
    return _about_z(point, psi), _about_z(direction, psi)


def _about_z(vector: np.ndarray, angle_rad: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) turned about z, positive = counter-clockwise from above."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    x, y, z = np.moveaxis(vector, -1, 0)
    return np.stack((c * x - s * y, s * x + c * y, z), axis=-1)


def _reflect(
    point: np.ndarray, direction: np.ndarray, on_plane: np.ndarray, normal: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where rays meet a mirror plane, and their directions after it."""
    along = np.sum(direction * normal, axis=-1, keepdims=True)
    distance = np.sum((on_plane - point) * normal, axis=-1, keepdims=True) / along
    return point + distance * direction, direction - 2 * along * normal


def project(points_S_mm: np.ndarray, stereo: Stereo, focal_scale: float = 1.0) -> np.ndarray:
    """Pixels (n, 4: u_left, v_left, u_right, v_right) of points (n, 3) in frame S; NaN where not seen.

    Pinhole with Brown-Conrady; `focal_scale` multiplies fx and fy of both cameras. Not seen: behind a
    camera, beyond the radius where the distortion polynomial turns back, or outside the image, whose
    outermost pixel centres are 0 and width - 1.
    """
    x, y, z = np.asarray(points_S_mm, float).reshape(-1, 3).T
    left = np.column_stack((-y, -z, x))
    right = left @ np.asarray(stereo.R, float).T + np.asarray(stereo.T, float).ravel()
    views = ((left, stereo.M1, stereo.D1), (right, stereo.M2, stereo.D2))
    return inside_images(np.hstack([project_camera(*view, focal_scale) for view in views]), stereo)


def project_camera(
    points_mm: np.ndarray, matrix: np.ndarray, coefficients: np.ndarray, focal_scale: float = 1.0
) -> np.ndarray:
    """Pixels (n, 2) of points (n, 3) in a camera's own axes (x right, y down, z along the view).

    Beyond the image's borders too; NaN behind the camera and beyond the radius where distortion turns back.
    """
    k1, k2, p1, p2, k3 = np.asarray(coefficients, float).ravel()
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (points_mm[:, :2] / points_mm[:, 2:]).T
    r2 = a * a + b * b
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)
    v = b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b
    u = focal_scale * matrix[0, 0] * u + matrix[0, 2]
    v = focal_scale * matrix[1, 1] * v + matrix[1, 2]
    good = (points_mm[:, 2] > 0) & (r2 < _turning_radius_squared(k1, k2, k3))
    return np.where(good[:, None], np.column_stack((u, v)), np.nan)


def inside_images(pixels: np.ndarray, stereo: Stereo) -> np.ndarray:
    """Pixels (n, 4) with NaN rows where one of the two centres is not on its image."""
    last = np.tile([stereo.image_width - 1, stereo.image_height - 1], 2)
    inside = ((pixels >= 0) & (pixels <= last)).all(axis=1, keepdims=True)
    return np.where(inside, pixels, np.nan)


def _turning_radius_squared(k1: float, k2: float, k3: float) -> float:
    """Square of the normalised radius up to which radial distortion grows, infinite if it always does."""
    roots = np.roots([7 * k3, 5 * k2, 3 * k1, 1.0])
    real = roots[np.abs(roots.imag) < 1e-12].real
    return float(min(real[real > 0], default=np.inf))


def to_tvs(points_P_mm: np.ndarray, baseline_mm: float, pan_zero_emission_deg: float) -> np.ndarray:
    """Points (..., 3) from frame P to frame T: p_T = Rz(C0 - 90 deg) p_P + (0, a/2, 0)."""
    turned = _about_z(np.asarray(points_P_mm, float), np.radians(pan_zero_emission_deg - 90.0))
    return turned + np.array([0.0, baseline_mm / 2, 0.0])


def aperture_angle_deg(points_T_mm: np.ndarray, baseline_mm: float, convention: str) -> np.ndarray:
    """Angle B (...,) at the aperture between +y and the spot, "in-plane" or its "azimuth" (DESIGN 5)."""
    x, y, z = np.moveaxis(np.asarray(points_T_mm, float) + np.array([0.0, baseline_mm / 2, 0.0]), -1, 0)
    return np.degrees(np.arctan2(np.hypot(x, z) if convention == "in-plane" else x, y))


def beam_jacobian(geometry: Mapping[str, float], pose_deg: tuple[float, float]) -> np.ndarray:
    """d(azimuth, elevation)/d(psi, beta) (2, 2) of the beam in P at a pose, by central differences."""
    step = 1e-5  # rad: truncation 1e-10, rounding 1e-11
    psi, beta = np.radians(pose_deg)
    directions = mirror_chain(psi + step * np.array([1, -1, 0, 0]), beta + step * np.array([0, 0, 1, -1]), geometry)[1]
    angles = np.stack((np.arctan2(directions[:, 1], directions[:, 0]), np.arcsin(directions[:, 2])))
    return np.stack((angles[:, 0] - angles[:, 1], angles[:, 2] - angles[:, 3]), axis=1) / (2 * step)


def effective_deg_per_step(
    parameters: Mapping[str, float], reference_pose_deg: tuple[float, float]
) -> dict[str, float]:
    """Degrees of the beam per step at a pose: k_dir d(az)/d(psi) and k_dir d(el)/d(beta) (DESIGN 3.2).

    The mean over a period of the transmission error, without its local slope.
    """
    jacobian = beam_jacobian(parameters, reference_pose_deg)
    slopes = {"left": jacobian[0, 0], "right": jacobian[0, 0], "up": jacobian[1, 1], "down": jacobian[1, 1]}
    return {name: float(parameters[f"degrees_per_step.{name}"] * slope) for name, slope in slopes.items()}


def effective_mirror_offset_mm(parameters: Mapping[str, float], pose_deg: tuple[float, float]) -> float:
    """Signed distance of the beam line from the pan axis at a pose, +L for the nominal rig, mm.

    (d_y o_x - d_x o_y) / sqrt(d_x^2 + d_y^2) with origin o and direction d in P: the beam's moment about
    the pan axis over its horizontal length.
    """
    o, d = mirror_chain(*np.radians(pose_deg), parameters)
    return float((d[1] * o[0] - d[0] * o[1]) / np.hypot(d[0], d[1]))


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


def harmonics_deg(parameters: Mapping[str, float], axis: str) -> list[complex]:
    """Transmission error of an axis as `transmission` takes it; a rig that names none has none."""
    names = [f"harmonic_deg.{axis}.{order}" for order in HARMONIC_ORDERS]
    return [complex(parameters.get(f"{name}.cos", 0.0), -parameters.get(f"{name}.sin", 0.0)) for name in names]


def with_derived(parameters: Mapping[str, float]) -> dict[str, float]:
    """Add the four directional ratios that mean ratios and contrasts imply (DESIGN 3.1)."""
    result = dict(parameters)
    for axis, positive, negative in (("pan", "left", "right"), ("tilt", "up", "down")):
        ratio, contrast = result[f"degrees_per_step.{axis}"], result[f"ratio_contrast_deg_per_step.{axis}"]
        result[f"degrees_per_step.{positive}"] = ratio + contrast / 2
        result[f"degrees_per_step.{negative}"] = ratio - contrast / 2
    return result


@dataclass(frozen=True)
class PlannedLook:
    """A look of a plan: its step, the number of the move it follows, and the number of the placement it looks at."""

    step: PlanStep
    move: int
    placement: int


@dataclass
class PlanLog:
    """What the plan did, in time order, while it is being read."""

    moves: list[Move] = field(default_factory=list)
    looks: list[PlannedLook] = field(default_factory=list)
    targets: list[str] = field(default_factory=list)


def run_plan(plan: Iterable[PlanStep], rig: Rig, home_approach: tuple[str, str]) -> PlanLog:
    """Turn plan steps into moves, placements and looks.

    A plan that does not begin with `home` is taken as homed at counters 0, 0. Empty counters of a move
    keep the axis where it is.
    """
    log, time_s, segment = PlanLog(), 0.0, -1
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
            log.looks.append(PlannedLook(step, len(log.moves) - 1, len(log.targets) - 1))
        time_s += plan_seconds(rig, (step,))
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
