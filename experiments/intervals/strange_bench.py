"""Strangers' benches: a rig, its calibration by OpenCV and its table of looks, by (seed, number); written as files.

A bench is a folder with `looks.csv` (counters, sheet, centroids; empty where a camera does not see the spot),
`rig_stereo.yml` (OpenCV's FileStorage, no covariance) and `truth.json`. Nothing here is the package's: see
`strange_optics`. True values are drawn evenly from ranges inside the package's default priors, but for the offset of
the mirrors: looks leave half of its prior's variance, and intervals hold what is distributed as the prior. World and
units of `strange_optics`.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import NormalDist

import cv2
import numpy as np

from experiments.common.opencv_stereo import calibrated
from experiments.intervals.strange_optics import Camera, Gear, Head, Waves, turn, turned

AXES = ("pan", "tilt")
SIDES = {"pan": {1: "left", -1: "right"}, "tilt": {1: "up", -1: "down"}}
SIZES = ((1280, 960), (1280, 720), (1024, 768), (1440, 1080), (1600, 1200), (1920, 1080))
BOARDS = ((9, 6, 25.0), (8, 5, 30.0), (11, 8, 20.0), (7, 6, 35.0))
"""Inner corners by row and column, side of a square in mm."""
PATTERNS = ("grid", "snake", "random", "four-point")
HEADER = ("no", "time_s", "segment", "pan_steps", "tilt_steps", "sheet", "uL", "vL", "uR", "vR")
SHEETS = ("near", "far", "third")
FEWEST, LEAST_SHARE, LEAST_PER_SHEET = 24, 0.7, 8
"""Looks with a spot in both images, their share of all looks, and those of a sheet, that a bench has at least."""
RMS_MOST_PX = 1.0
"""OpenCV's descent sometimes ends far off; its owner sees that by the RMS and takes other views."""
ALL_SEEN_AGAIN = 0.9
"""Share of the benches that see every look which are drawn again: most tables have looks that a camera missed."""
TRIES = 20_000
OFFSET_MM, OFFSET_SD_MM = 30.0, 5.0
"""Of the mirrors, as the package's default prior."""
AIM_SD_DEG = 6.0
"""How far the middle of a pattern lies from the middle of the view, by eye."""
TO_CAMERA = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""From axes forward, left, up to OpenCV's right, down, forward."""


@dataclass(frozen=True)
class Traits:
    """What kind of bench it is; `rows` are the looks of its table, about."""

    pattern: str
    rows: int
    sheets: int
    covariance: bool
    homing_recorded: bool
    look_scatter: bool
    second_homing: bool


@dataclass(frozen=True)
class Rig:
    """A true bench: cameras, head and where it stands (H to world by R x + t), sheets by a point and a normal."""

    left: Camera
    right: Camera
    head: Head
    rotation: np.ndarray
    shift_mm: np.ndarray
    sheets: tuple[tuple[np.ndarray, np.ndarray], ...]

    def spots(self, pan_deg: np.ndarray, tilt_deg: np.ndarray, sheet: np.ndarray) -> np.ndarray:
        """Where beams at stage angles (n,), tilt zero included, meet their sheets (n,), world, (n, 3)."""
        on, ahead = self.head.beams(pan_deg, tilt_deg)
        on, ahead = on @ self.rotation.T + self.shift_mm, ahead @ self.rotation.T
        point, normal = (np.array(part)[sheet] for part in zip(*self.sheets, strict=True))
        reach = np.sum((point - on) * normal, axis=1) / np.sum(ahead * normal, axis=1)
        return on + np.where(reach > 0, reach, np.nan)[:, None] * ahead

    def project(self, spots_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (n, 4) of both cameras, and which spots both see (n,)."""
        pixels = [camera.project(spots_mm) for camera in (self.left, self.right)]
        both = self.left.sees(pixels[0]) & self.right.sees(pixels[1])
        return np.hstack(pixels), both


@dataclass(frozen=True)
class Looks:
    """The order of a campaign: counters (n, 2), sheet (n,), seconds (n,), whether both axes were homed before (n,)."""

    counters: np.ndarray
    sheet: np.ndarray
    time_s: np.ndarray
    homed: np.ndarray


@dataclass(frozen=True)
class Calibration:
    """What the owner of the cameras did: views of a board, and what OpenCV made of them, with its RMS.

    `board`: inner corners by row and column, side of a square in mm; `corners` of both cameras, each (views, corners,
    2), px; `fix_k3`: whether k3 was held at 0; `matrices`: M1 D1 M2 D2 R T.
    """

    board: tuple[int, int, float]
    corners: tuple[np.ndarray, np.ndarray]
    fix_k3: bool
    matrices: dict[str, np.ndarray]
    rms_px: float


@dataclass(frozen=True)
class Bench:
    """A bench with its files' contents."""

    seed: int
    number: int
    traits: Traits
    rig: Rig
    gears: tuple[Gear, Gear]
    looks: Looks
    pixels: np.ndarray
    both: np.ndarray
    calibration: Calibration
    truth: dict[str, object]

    def write(self, folder: Path) -> None:
        """`looks.csv`, `rig_stereo.yml` and `truth.json` into a folder."""
        folder.mkdir(parents=True, exist_ok=True)
        segments = np.cumsum(self.looks.homed)
        with (folder / "looks.csv").open("w", newline="") as file:
            table = csv.writer(file)
            table.writerow(HEADER)
            for i, (pan, tilt) in enumerate(self.looks.counters):
                centre = [f"{x:.2f}" for x in self.pixels[i]] if self.both[i] else [""] * 4
                when = f"{self.looks.time_s[i]:.1f}"
                table.writerow([i + 1, when, segments[i], pan, tilt, SHEETS[self.looks.sheet[i]], *centre])
        storage = cv2.FileStorage(str(folder / "rig_stereo.yml"), cv2.FILE_STORAGE_WRITE)
        for key, matrix in self.calibration.matrices.items():
            storage.write(key, matrix)
        storage.write("image_width", self.rig.left.size[0])
        storage.write("image_height", self.rig.left.size[1])
        storage.release()
        (folder / "truth.json").write_text(json.dumps(self.truth, indent=1))


def bench(seed: int, number: int) -> Bench:
    """The bench of a seed and a number.

    Raises:
        RuntimeError: no rig was found whose cameras see enough; not seen in the first thousand.
    """
    rng = np.random.default_rng([seed, number])
    pattern = str(rng.choice(PATTERNS, p=(0.3, 0.3, 0.25, 0.15)))
    traits = Traits(
        pattern=pattern,
        rows=round(float(np.exp(rng.uniform(np.log(30), np.log(400))))),
        sheets=2 + int(rng.random() < 1 / 4 and pattern != "four-point"),
        covariance=bool(rng.random() < 1 / 3),
        homing_recorded=bool(rng.random() < 2 / 3),
        look_scatter=bool(rng.random() < 1 / 3),
        second_homing=bool(rng.random() < 1 / 4),
    )
    ratios = rng.uniform(0.05, 0.08, 2)
    for _ in range(TRIES):
        rig = _rig(rng, traits)
        looks = _looks(rng, rig, traits, ratios)
        _, both = rig.project(rig.spots(*_angles(rig, looks.counters * ratios), looks.sheet))
        per_sheet = np.bincount(looks.sheet[both], minlength=3)[np.unique(looks.sheet)]
        if both.sum() < max(FEWEST, LEAST_SHARE * len(both)) or per_sheet.min() < LEAST_PER_SHEET:
            continue
        if both.all() and rng.random() < ALL_SEEN_AGAIN:
            continue
        views = _board_views(rng, rig)
        calibration = None if views is None else _calibrated(rng, rig, *views)
        # What its owner would not use.
        if calibration is not None and calibration.rms_px < RMS_MOST_PX:
            return _observed(rng, (seed, number), traits, rig, looks, ratios, calibration)
    raise RuntimeError(f"bench {number} of seed {seed}: no rig sees enough")


def _angles(rig: Rig, gears_deg: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Stage angles of pan and tilt (n,) where the wheels stand (n, 2)."""
    return gears_deg[:, 0], gears_deg[:, 1] + rig.head.tilt_zero_deg


def _camera(rng: np.random.Generator, size: tuple[int, int], focal_px: float, rotation, shift_mm, k3: float) -> Camera:
    """A camera of the nominal focal length with a lens of its own."""
    focal = focal_px * (1 + rng.uniform(-0.01, 0.01))
    k1 = rng.uniform(-0.25, 0.1)
    lens = (k1, rng.uniform(0.0, 0.1) if k1 < 0 else rng.uniform(-0.05, 0.05), *rng.uniform(-1e-3, 1e-3, 2), k3)
    centre = np.array(size) / 2 - 0.5 + rng.uniform(-0.015, 0.015, 2) * size[0]
    return Camera((focal, focal * (1 + rng.uniform(-2e-3, 2e-3))), tuple(centre), lens, rotation, shift_mm, size)


def _rig(rng: np.random.Generator, traits: Traits) -> Rig:
    """Cameras that converge somewhere in the work, a head beside, above or below them, sheets across it."""
    size = SIZES[rng.integers(len(SIZES))]
    focal_px, base_mm = rng.uniform(700, 1600), rng.uniform(80, 300)
    gaps = [rng.uniform(10, 40) if rng.random() < 0.25 else rng.uniform(80, 400) for _ in range(traits.sheets - 1)]
    depths = rng.uniform(300, min(800.0, 1200.0 - sum(gaps))) + np.cumsum([0.0, *gaps])
    middle = float(depths.mean())
    vergence = np.degrees(np.arctan(base_mm / (middle * rng.uniform(0.8, 1.6))))
    # The left camera is the world: the right one looks back at its axis.
    rotation = turned(np.radians(rng.uniform(-1.0, 1.0, 3))) @ turn("y", vergence * rng.uniform(0.0, 1.0))
    place = np.array([base_mm, *rng.uniform(-0.03, 0.03, 2) * base_mm])
    free_k3 = rng.random() < 0.5
    k3 = rng.uniform(-0.02, 0.02, 2) * free_k3
    left = _camera(rng, size, focal_px, np.eye(3), np.zeros(3), k3[0])
    right = _camera(rng, size, focal_px, rotation, -rotation @ place, k3[1])
    head = Head(
        offset_mm=NormalDist(OFFSET_MM, OFFSET_SD_MM).inv_cdf(rng.random()),
        mirror_error_deg=tuple(rng.uniform(-0.5, 0.5, 2)),
        laser_tilt_deg=tuple(rng.uniform(-0.5, 0.5, 2)),
        laser_shift_mm=tuple(rng.uniform(-0.7, 0.7, 2)),
        skew_deg=rng.uniform(-0.5, 0.5),
        axis_shift_mm=tuple(rng.uniform(-0.7, 0.7, 2)),
        tilt_zero_deg=rng.uniform(-2, 2),
    )
    where, across = rng.choice(("beside", "above", "below")), rng.uniform(60, 180)
    beside = (base_mm + across if rng.random() < 0.5 and base_mm + across < 220 else -across, rng.uniform(-60, 60))
    upright = (rng.uniform(0, min(base_mm, 200)), across if where == "below" else -across)
    shift = np.array([*(beside if where == "beside" else upright), rng.uniform(-80, 80)])
    axis = rng.standard_normal(3)
    stand = TO_CAMERA @ turned(axis / np.linalg.norm(axis) * rng.uniform(0, 0.3))
    sheets = []
    for depth in depths:
        lean = turn("x", rng.uniform(-15, 15)) @ turn("y", rng.uniform(-15, 15)) @ np.array([0.0, 0.0, 1.0])
        # On the view's middle, between the two cameras' axes.
        sheets.append((depth * _view(left, right, rotation, place, depth), lean))
    return Rig(left, right, head, stand, shift, tuple(sheets))


def _view(left: Camera, right: Camera, rotation: np.ndarray, place: np.ndarray, depth: float) -> np.ndarray:
    """The middle of what both cameras see at a depth, over that depth."""
    ends = []
    for camera, turn_back, at in ((left, np.eye(3), np.zeros(3)), (right, rotation.T, place)):
        local = (np.array(camera.size) / 2 - np.array(camera.centre_px)) / np.array(camera.focal_px)
        ray = turn_back @ np.array([*local, 1.0])
        ends.append(at + ray * (depth - at[2]) / ray[2])
    return (ends[0] + ends[1]) / (2 * depth)


def _aimed(rig: Rig, ratios: np.ndarray) -> np.ndarray:
    """Counters at which the beam meets the middle of the first and last sheet's points, as a user drives it there."""
    target = (rig.sheets[0][0] + rig.sheets[-1][0]) / 2
    local = rig.rotation.T @ (target - rig.shift_mm)
    counters = np.zeros(2)
    for _ in range(5):
        azimuth, elevation = rig.head.azimuth_elevation_deg(*_angles(rig, counters[None] * ratios))
        on = rig.head.beams(*_angles(rig, counters[None] * ratios))[0][0]
        ahead = local - on
        wanted = np.degrees([np.arctan2(ahead[1], ahead[0]), np.arcsin(ahead[2] / np.linalg.norm(ahead))])
        counters = counters + (wanted - [azimuth[0], elevation[0]]) / ratios
    return counters


def _looks(rng: np.random.Generator, rig: Rig, traits: Traits, ratios: np.ndarray) -> Looks:
    """A pattern about the middle of the view, sheet by sheet; the four points of the paper change sheets all along."""
    middle = np.round((_aimed(rig, ratios) + rng.normal(0, AIM_SD_DEG, 2) / ratios) / 10) * 10
    span = rng.uniform((6, 5), (30, 18)) / ratios
    per_sheet = max(-(-traits.rows // traits.sheets), LEAST_PER_SHEET)
    jitter = rng.integers(5, 25) if rng.random() < 1 / 3 else 0
    if traits.pattern == "four-point":
        places, sheet = _four_points(rng, traits.rows, span)
    else:
        columns = int(np.clip(round(np.sqrt(per_sheet * rng.uniform(0.6, 2.5))), 3, per_sheet // 2))
        grid = _grid(columns, -(-per_sheet // columns), snake=traits.pattern == "snake")
        parts = []
        for _ in range(traits.sheets):
            local = rng.uniform(-0.5, 0.5, (per_sheet, 2)) if traits.pattern == "random" else grid[:per_sheet]
            parts.append(local * span + rng.uniform(-jitter, jitter, (per_sheet, 2)))
        places, sheet = np.concatenate(parts), np.repeat(np.arange(traits.sheets), per_sheet)
    homed = np.arange(len(places)) == 0
    if traits.second_homing:
        homed[int(np.argmax(sheet > 0)) if traits.pattern != "four-point" else len(places) // 8 * 4] = True
    wait_s = rng.uniform(4, 15) * rng.uniform(0.8, 1.2, len(places)) + 60.0 * homed
    wait_s[1:] += rng.uniform(20, 120) * (np.diff(sheet) != 0) * (0.2 if traits.pattern == "four-point" else 1.0)
    return Looks(np.round(middle + places).astype(int), sheet, np.cumsum(wait_s) - wait_s[0], homed)


def _grid(columns: int, rows: int, snake: bool) -> np.ndarray:
    """Places (columns rows, 2) over -0.5 to 0.5, row by row, each from the left or to and fro."""
    across, up = np.linspace(-0.5, 0.5, columns), np.linspace(-0.5, 0.5, max(rows, 2))
    lines = [across[::-1] if snake and i % 2 else across for i in range(len(up))]
    return np.array([(x, y) for y, line in zip(up, lines, strict=True) for x in line])


def _four_points(rng: np.random.Generator, rows: int, span: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The paper's experiments: near, far, moved, near again; one or two numbers of steps, direction by direction."""
    repeats = max(rows // 16, 2)
    steps = span * (0.3 + 0.7 * rng.random())
    two_lengths = rng.random() < 0.5
    places: list[np.ndarray] = []
    for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
        for repeat in range(repeats):
            length = steps[axis] * (0.5 if two_lengths and repeat % 2 else 1.0)
            start, end = np.zeros(2), np.zeros(2)
            start[axis], end[axis] = -sign * 0.5 * length, sign * 0.5 * length
            places += [start, start, end, end]
    return np.array(places), np.tile([0, 1, 1, 0], 4 * repeats)


def _gear(rng: np.random.Generator, ratio: float, places_deg: np.ndarray, hours: float, traits: Traits) -> Gear:
    """A gear whose errors are waves and a bend, whose play varies, and whose zero creeps."""
    low, high = float(places_deg.min()), float(places_deg.max())
    count = rng.integers(2, 6)
    sizes = rng.uniform(0.005, 0.05) * rng.dirichlet(np.ones(count)) ** 0.5
    bend = rng.uniform(0, 0.02) * np.array([1.0, rng.uniform(-1, 1)]) * rng.choice((-1, 1))
    error = Waves(sizes, rng.uniform(15, 120, count), rng.uniform(0, 2 * np.pi, count), tuple(bend), (low, high))
    play, varies = rng.uniform(0, 0.6), rng.uniform(0, 0.02)
    period, phase = rng.uniform(15, 90), rng.uniform(0, 2 * np.pi)
    # A third of the benches stands in a room that keeps its temperature.
    creep = abs(rng.standard_normal()) * 0.01 * np.sqrt(hours) * (rng.random() < 2 / 3)
    slow, start = rng.uniform(0.5, 3.0) * max(hours, 0.05), rng.uniform(0, 2 * np.pi)

    def play_deg(place: np.ndarray) -> np.ndarray:
        return np.maximum(play + varies * np.sin(2 * np.pi * np.asarray(place) / period + phase), 0.0)

    def zero_deg(hour: np.ndarray) -> np.ndarray:
        return creep * (np.sin(2 * np.pi * hour / slow + start) - np.sin(start))

    look = rng.uniform(0, 0.03) * traits.look_scatter
    return Gear(ratio, play_deg, error, zero_deg, rng.uniform(0.01, 0.06), look, rng.uniform(0.01, 0.06))


def _observed(rng: np.random.Generator, key, traits: Traits, rig: Rig, looks: Looks, ratios, calibration) -> Bench:
    """The looks of a bench, with everything that disturbs them."""
    hours = looks.time_s / 3600
    gears, wheels, sides = [], [], {}
    for k, axis in enumerate(AXES):
        gears.append(_gear(rng, float(ratios[k]), ratios[k] * looks.counters[:, k], float(hours[-1]), traits))
        side = int(rng.choice((-1, 1)))
        sides[axis] = SIDES[axis][side]
        wheels.append(gears[k].driven(looks.counters[:, k], looks.homed, hours, side, rng))
    exact, both = rig.project(rig.spots(*_angles(rig, np.column_stack(wheels)), looks.sheet))
    noise_px = rng.uniform(0.05, 0.3)
    pixels = exact + noise_px * rng.standard_normal(exact.shape)
    truth = true_values(rig.head, gears, looks.counters[both]) | {
        "pixel_noise_px": noise_px,
        "stop_sd_deg": {axis: gear.stop_sd_deg for axis, gear in zip(AXES, gears, strict=True)},
        "look_scatter": traits.look_scatter,
        "look_scatter_deg": {axis: gear.look_sd_deg for axis, gear in zip(AXES, gears, strict=True)},
        "approach": sides if traits.homing_recorded else dict.fromkeys(AXES, "unknown"),
    }
    return Bench(*key, traits, rig, tuple(gears), looks, pixels, both, calibration, truth)


def true_values(head: Head, gears: Sequence[Gear], counters: np.ndarray) -> dict[str, object]:
    """Headlines of a bench over the looks seen, each counting once.

    Ratios are slopes of the least-squares line of the beam's azimuth (elevation) on the counter, with transmission
    error and the other axis at its mean; without play, stop error and drift. Play is the mean over the places.

    Args:
        head: its mirrors.
        gears: of pan and tilt.
        counters: of the looks seen, (n, 2).
    """
    places = [gear.deg_per_step * counters[:, k] for k, gear in enumerate(gears)]
    wheels = [place + gear.error_deg(place) for place, gear in zip(places, gears, strict=True)]
    pose = [float(wheels[0].mean()), float(wheels[1].mean()) + head.tilt_zero_deg]
    azimuth, _ = head.azimuth_elevation_deg(wheels[0], np.full(len(counters), pose[1]))
    _, elevation = head.azimuth_elevation_deg(np.full(len(counters), pose[0]), wheels[1] + head.tilt_zero_deg)
    slopes = [np.polyfit(counters[:, k] - counters[:, k].mean(), (azimuth, elevation)[k], 1)[0] for k in (0, 1)]
    plays = [float(gear.play_deg(place).mean()) for gear, place in zip(gears, places, strict=True)]
    return {
        "effective_deg_per_step": dict(zip(AXES, map(float, slopes), strict=True)),
        "backlash_deg": dict(zip(AXES, plays, strict=True)),
        "mirror_offset_mm": head.arm_mm(*pose),
    }


def _board_views(rng: np.random.Generator, rig: Rig) -> tuple[tuple[int, int, float], np.ndarray] | None:
    """Poses (views, 6) of a board as people hold it: near and far, all over the picture, tilted; None if it never fits.

    Every view is wholly in both pictures.
    """
    board = BOARDS[rng.integers(len(BOARDS))]
    points, count = _board(board), int(rng.integers(15, 26))
    poses: list[np.ndarray] = []
    for _ in range(40 * count):
        vector = np.array([*rng.normal(0, 0.4, 2), rng.normal(0, 0.15)])
        share = rng.uniform(0.2, 0.6)
        depth = rig.left.focal_px[0] * board[0] * board[2] / (share * rig.left.size[0])
        pixel = rng.uniform(0.1, 0.9, 2) * rig.left.size
        ray = np.array([*((pixel - rig.left.centre_px) / rig.left.focal_px), 1.0])
        pose = np.array([*vector, *(depth * ray)])
        if rig.project(points @ turned(vector).T + pose[3:])[1].all():
            poses.append(pose)
            if len(poses) == count:
                return board, np.array(poses)
    return None


def _board(board: tuple[int, int, float]) -> np.ndarray:
    """Inner corners about the board's middle, row by row, (corners, 3), mm."""
    columns, rows, pitch_mm = board
    y, x = np.mgrid[:rows, :columns]
    flat = np.column_stack((x.ravel(), y.ravel(), np.zeros(columns * rows)))
    return pitch_mm * (flat - flat.mean(0))


def _calibrated(rng: np.random.Generator, rig: Rig, board: tuple[int, int, float], poses: np.ndarray) -> Calibration:
    """Each camera by itself, then both together, as OpenCV's sample does; intrinsics kept then or refined."""
    points = _board(board)
    exact = np.array([rig.project(points @ turned(pose[:3]).T + pose[3:])[0] for pose in poses])
    corners = exact + rng.uniform(0.05, 0.25) * rng.standard_normal(exact.shape)
    fix_k3 = rig.left.lens[4] == 0.0
    flags = cv2.CALIB_FIX_K3 if fix_k3 else 0
    together = cv2.CALIB_FIX_INTRINSIC if rng.random() < 0.5 else cv2.CALIB_USE_INTRINSIC_GUESS
    threads = cv2.getNumThreads()
    # Sums of several threads differ from run to run, and with them where a descent ends.
    cv2.setNumThreads(1)
    try:
        sides = (corners[..., :2], corners[..., 2:])
        rms, *both = calibrated(points, sides, rig.left.size, together, lens=flags, ends=(100, 1e-6))
    finally:
        cv2.setNumThreads(threads)
    named = dict(zip(("M1", "D1", "M2", "D2", "R", "T"), both, strict=True))
    return Calibration(board, (corners[..., :2], corners[..., 2:]), fix_k3, named, float(rms))
