"""Calibrations of a stereo pair in files of other programs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from tvsbayes.cameras.imported_calibration import Imported, read_calibration
from tvsbayes.instrument.stereo_pair import Stereo, rotation_matrix, rotation_vector

FOREIGN = Path(__file__).parents[1] / "data" / "foreign"
"""Files in layouts of public repositories with invented numbers: one pair of 640 x 480 px."""


def written(folder: Path, files: dict[str, bytes]) -> list[Path]:
    """The files with these contents."""
    for name, data in files.items():
        (folder / name).write_bytes(data)
    return [folder / name for name in files]


def plain(stereo: Stereo, names: str = "M1 D1 M2 D2 R T") -> dict[str, np.ndarray]:
    """The six matrices under names."""
    values = stereo.M1, stereo.D1, stereo.M2, stereo.D2, stereo.R, stereo.T
    return dict(zip(names.split(), values, strict=True))


def listed(stereo: Stereo, names: str = "M1 D1 M2 D2 R T") -> dict[str, object]:
    """The same as nested lists, with the size of the pictures."""
    lists = {name: value.tolist() for name, value in plain(stereo, names).items()}
    return lists | {"image_size": [stereo.image_width, stereo.image_height]}


def read_json(folder: Path, document: object, **options: object) -> Imported:
    """What is read of a JSON file with this document."""
    path = folder / "m.json"
    path.write_text(json.dumps(document))
    return read_calibration([path], **options)


def check_pair(
    stereo: Stereo,
    k3_left: float = 0.0,
    k3_right: float = 0.0,
    size: tuple[int, int] = (640, 480),
    shift_px: tuple[float, float] = (0.0, 0.0),
) -> None:
    """Hold a pair against that of `FOREIGN`, of which some files have a fifth coefficient, others larger pictures."""
    left = 812.4, 811.9, 318.2, 243.7, -0.21, 0.08, 0.001, -0.0005, k3_left
    right = 809.1, 808.8, 325.6, 239.4, -0.2, 0.07, 0.0004, 0.0007, k3_right
    expected = np.array([*left, *right, 0.01, 0.02, -0.005, -118.6, 0.4, 1.9])
    expected[[2, 3, 11, 12]] += 2 * shift_px
    # Rounding of a few products of three matrices.
    np.testing.assert_allclose(stereo.vector, expected, atol=1e-9)
    assert (stereo.image_width, stereo.image_height) == size


def mistakes(mounted: Stereo) -> dict[str, dict[str, object]]:
    """Mistakes and ambiguities in a plain document: what its entries become, None where they are missing."""
    good, (x, y, z) = listed(mounted), mounted.T
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ mounted.R
    fundamental = np.linalg.solve(mounted.M2.T, essential @ np.linalg.inv(mounted.M1))
    wide = {"D1": [0.1, 0, 0, 0], "D2": [0.1, 0, 0, 0], "distortion_model": "equidistant"}
    four = [-0.02, 0.01, -5e-3, 0]
    others = dict.fromkeys(("M1", "D1", "M2", "D2", "image_size"))
    named = {"master": {"K": good["M1"], "D": good["D1"]}, "slave": {"K": good["M2"], "D": good["D2"]}}
    long = [[16300.0, 0, 640], [0, 16300, 360], [0, 0, 1]]
    return {
        "none": {},
        "R transposed": {"R": mounted.R.T, "E": essential},
        "R of another file": {"R": rotation_matrix(np.array([0, 0.3, 0])), "E": essential},
        "R transposed, by F": {"R": mounted.R.T, "F": fundamental},
        "R as a vector": {"R": rotation_vector(mounted.R)},
        "two poses": {"T_right_left": np.eye(4)},
        "by columns": {"M1": mounted.M1.T},
        "three coefficients": {"D2": [0.1, 0.0, 0.2]},
        "no number": {"T": [None, 0, 0]},
        "no picture's T": {"T": mounted.T * 500},
        "squares": {"T": mounted.T / 25},
        "inches": {"T": mounted.T / 25.4},
        "R no rotation": {"R": 2 * mounted.R},
        "R in degrees": {"R": [0.0, 5.0, 1.0]},
        "omnidirectional": {"camera_model": "omni"},
        "T missing": {"T": None},
        "T zero": {"T": [0, 0, 0]},
        "T in metres": {"T": mounted.T / 1000},
        "size missing": {"image_size": None},
        "size of no picture": {"image_size": [1280.5, 720]},
        "M with skew": {"M1": [[800, 5, 640], [0, 800, 360], [0, 0, 1]]},
        "M not last row": {"M1": [[800, 0, 640], [0, 800, 360], [0, 0, 2]]},
        "D missing": {"D2": None},
        "unknown lens": {"distortion_model": "fov"},
        "two left matrices": {"K1": 2 * mounted.M1},
        "wide fisheye": {**wide, "M1": [[300, 0, 640], [0, 300, 360], [0, 0, 1]]},
        "master and slave": {**others, **named},
        "one camera": {**dict.fromkeys(good), "camera_matrix": good["M1"], "dist_coeffs": good["D1"]},
        "nothing": {**dict.fromkeys(good), "a": 1},
        "large tail": {"distortion_model": "rational_polynomial", "D1": [*mounted.D1.tolist(), 0.5, 0.3, 0.2]},
        "four coefficients": {"D1": four, "D2": four},
        "axes of another frame": {"T": [z, x, y]},
        "left and right swapped": {"T": -mounted.R.T @ mounted.T, "R": mounted.R.T},
        "size of other pictures": {"image_size": [640, 360]},
        "R perhaps transposed": {"R": rotation_matrix(np.array([0, -0.1, 0.02]))},
        "R that converges": {"R": rotation_matrix(np.array([0, 0.1, 0.02]))},
        "matrices of two sizes": {"M2": np.diag([2, 2, 1]).dot(mounted.M2)},
        "rolled": {"R": rotation_matrix(np.array([0.0, 0.1, 0.43]))},
        "rows before columns": {"image_size": [720, 1280]},
        "focal length in mm": {"M1": [[4.2, 0, 640], [0, 4.2, 360], [0, 0, 1]]},
        "looking away": {"R": rotation_matrix(np.array([0, 2.8, 0])), "T": mounted.T},
        "absurd": {"M1": long, "M2": long, "D1": [0.1, 9080.0, 0, 0, 0], "D2": [0.1, 9080.0, 0, 0, 0]},
    }


def changed(mounted: Stereo, changes: dict[str, object]) -> dict[str, object]:
    """The plain document with other entries, without those that are None."""
    lists = {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in changes.items()}
    return {name: value for name, value in {**listed(mounted), **lists}.items() if value is not None}
