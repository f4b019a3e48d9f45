"""What do two small pan-tilt heads say: a camera over a floor of marked points, and two hobby servos?

    python -m experiments.real.pan_tilts FOLDER > experiments/real/pan_tilts.md

FOLDER holds camera.csv, servo_pan.csv, servo_tilt.csv. A picture of a known point gives where the optical axis points,
if the camera's place is known: a row becomes a sighting, counters are the commanded degrees with the other sign. The
height of the camera over the floor is the one at which least squares leave least.
"""

from __future__ import annotations

import csv
import json
import tempfile
from collections import defaultdict
from pathlib import Path

import numpy as np

from experiments.common.command_line import parser
from experiments.common.commands import quietly
from experiments.common.page import heading
from tvsbayes.head.pointing_model import pointing_model
from tvsbayes.instrument.campaign import Campaign, Move
from tvsbayes.instrument.mechanisms import SIGHTING_HEAD
from tvsbayes.instrument.parameters import Prior, names_of
from tvsbayes.instrument.rig import RigTable
from tvsbayes.instrument.sightings import Sighting

CENTRE_PX, FOCAL_PX = np.array([301.39, 267.57]), np.array([471.34, 472.98])
"""Of the camera, as the program that came with the table has them, at twice the recorded scale."""
HEIGHTS = np.arange(35.0, 65.1, 0.5)
U_DEG = 0.1


def columns(path: Path) -> np.ndarray:
    """Of a table with a line of names, shape (rows, columns)."""
    with path.open() as file:
        return np.array([[float(cell) for cell in row] for row in list(csv.reader(file))[1:]])


def sighted(rows: np.ndarray, height: float) -> np.ndarray:
    """Azimuth and elevation (n, 2), deg, of the optical axis: the point's direction, less where the picture has it."""
    off = (2 * rows[:, 2:4] - CENTRE_PX) / FOCAL_PX
    rays = np.stack([np.ones(len(rows)), -off[:, 0], -off[:, 1]], axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    to = np.column_stack([rows[:, 4:6], np.full(len(rows), -height)])
    to /= np.linalg.norm(to, axis=1, keepdims=True)
    # A camera without roll: z of the point after the turn about the elevation axis, then the azimuth that is left.
    level = np.arcsin(np.clip(to[:, 2] / np.hypot(rays[:, 0], rays[:, 2]), -1, 1)) - np.arctan2(rays[:, 2], rays[:, 0])
    ahead = rays[:, 0] * np.cos(level) - rays[:, 2] * np.sin(level)
    turn = np.arctan2(to[:, 1], to[:, 0]) - np.arctan2(rays[:, 1], ahead)
    return np.degrees(np.stack([turn, level], axis=1))


def head_of(rows: np.ndarray, angles_deg: np.ndarray) -> Campaign:
    first = {"pan_approach": "unknown", "tilt_approach": "unknown"}
    moves = [
        Move(move=k, segment=0, time_s=float(k), pan_steps=-round(pan), tilt_steps=-round(tilt), **({} if k else first))
        for k, (pan, tilt) in enumerate(rows[:, :2].tolist())
    ]
    looks = [
        Sighting(sighting=k, move=k, azimuth_deg=azimuth, elevation_deg=elevation, u_deg=U_DEG)
        for k, (azimuth, elevation) in enumerate(angles_deg.tolist())
    ]
    ratios = dict.fromkeys(names_of("degrees_per_step"), Prior(1.0, 0.2))
    return Campaign(tuple(moves), tuple(looks), None, RigTable(ratios, mechanism=SIGHTING_HEAD))


def camera(rows: np.ndarray) -> None:
    """Terms by least squares, and one pose by one point and by another."""
    models = {height: pointing_model(head_of(rows, sighted(rows, height))) for height in HEIGHTS.tolist()}
    height, model = min(models.items(), key=lambda item: item[1].rms_deg)
    print(f"## Camera, {len(rows)} pictures\n\nCamera {height:g} above the floor: {model.rms_deg:.2f} deg RMS.\n")
    print("| term | least squares |\n|---|---|")
    for name, value, error in zip(model.names, model.value, model.standard_error, strict=True):
        print(f"| `{name}` | {value:.3f} ({error:.3f}) |")
    poses: dict[tuple[float, ...], list[np.ndarray]] = defaultdict(list)
    for pose, angles in zip(rows[:, :2].tolist(), sighted(rows, height), strict=True):
        poses[tuple(pose)].append(angles)
    again = [np.array(each) - np.mean(each, axis=0) for each in poses.values() if len(each) > 1]
    dof = sum(len(each) - 1 for each in again)
    scatter = np.sqrt(np.sum(np.concatenate(again) ** 2, axis=0) / dof)
    print(f"\n{len(poses)} poses, {len(again)} of them seen by several pictures: azimuth and elevation of one pose")
    print(f"scatter by {scatter[0]:.2f} and {scatter[1]:.2f} deg.")


def servo(file: Path) -> None:
    """One axis as a user has it: imported, fitted, its answer."""
    with tempfile.TemporaryDirectory() as place:
        folder = str(Path(place) / "axis")
        assert quietly("import", str(file), "--axis", "--to", folder, "--yes")[0] == 0
        document = json.loads(quietly("fit", folder, "--quick", "--json")[1])
    print(f"\n## `{file.name}`, {len(columns(file))} stops, all from below\n\n{heading('quantity | value | 95 %')}")
    parameters = document["parameters"]
    for name in ("per_command", "backlash", "transmission_error", "stop_sd.forward"):
        one = document["per_command"]["forward"] if name == "per_command" else parameters[name]
        low, high = one["interval95"]
        print(f"| `{name}` | {one['value']:.4f} ({one['sd']:.4f}) | {low:.4f} to {high:.4f} |")
    reduction = 1 - (parameters["backlash"]["sd"] / parameters["backlash"]["prior_sd"]) ** 2
    print(f"\nOf what the prior leaves open of the play the readings take away {100 * max(reduction, 0):.0f} %.")


TEXT = """# Two small pan-tilt heads

Made by `python -m experiments.real.pan_tilts FOLDER`. A pan-tilt-zoom camera over marked points of a floor
(usstdqq/pan_tilt_camera_calibration, commit 9d3bc351bb), angles as commanded; two hobby servos read by an accelerometer
(rowan-jansens/pan_tilt, commit c5ab90109a), commands rising by one. deg; lengths in the unit of the points.

The pictures tell both ratios, and that directions from one place are not all there is: points are near, and the camera
stands off its axes by lengths that sightings do not have, so that the terms take up parallax and mean nothing. Commands
in steps of 5 deg and more tell no play. The servos came from one side alone: play stays as the prior has it, and the
tilt's curve, a linkage, is an error by position several times what the prior expects, which the fit says.
"""


def main() -> None:
    cli = parser(__doc__)
    cli.add_argument("folder", type=Path)
    folder = cli.parse_args().folder
    print(TEXT)
    camera(columns(folder / "camera.csv"))
    for axis in ("pan", "tilt"):
        servo(folder / f"servo_{axis}.csv")


if __name__ == "__main__":
    main()
