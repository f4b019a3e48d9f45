"""Small random pictures of two cameras, for tests that need only their file names."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

SIZE = (6, 8)
"""Height and width of a drawn picture, px."""


def drawn(folder: Path, *names: str, size: tuple[int, int] = SIZE) -> None:
    """Pictures without two alike."""
    rng = np.random.default_rng(4)
    folder.mkdir(exist_ok=True, parents=True)
    for name in names:
        picture = rng.integers(0, 256, (*size, 3), dtype=np.uint8)
        cv2.imwrite(str(folder / name), picture)


def pairs(*views: str) -> list[str]:
    return [f"{side}{view}.png" for view in views for side in ("left", "right")]
