"""Calibrations of a stereo pair in files of other programs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from tvsbayes.cameras.calibration_formats import Imported, read_calibration
from tvsbayes.instrument.stereo_pair import Stereo

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
