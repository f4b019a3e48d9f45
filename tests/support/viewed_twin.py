"""The paper twin as a page shows it: with results, one look undetected, one picture kept."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from tvsbayes.files.disk import shipped_data
from tvsbayes.files.images import png_bytes
from tvsbayes.instrument.campaign import frame_name, read_campaign, with_pixels, write_campaign

TWIN = shipped_data() / "twins" / "paper_twin"
UNDETECTED, PICTURED = 7, 3
"""Looks without a spot, and with a left picture."""


@dataclass(frozen=True)
class Viewed:
    """A campaign folder with results, and the same without."""

    folder: Path
    bare: Path


@pytest.fixture(scope="session")
def unfitted_twin(tmp_path_factory) -> Path:
    """Without results."""
    twin = read_campaign(TWIN)
    spots = tuple(with_pixels(s, "undetected") if s.spot == UNDETECTED else s for s in twin.spots)
    folder = tmp_path_factory.mktemp("viewed") / "bare"
    write_campaign(replace(twin, spots=spots, path=None), folder)
    (folder / "frames").mkdir()
    grey = np.random.default_rng(1).integers(0, 40, (72, 128), dtype=np.uint8)
    (folder / frame_name(PICTURED, "left")).write_bytes(png_bytes(grey))
    return folder


@pytest.fixture(scope="session")
def viewed(unfitted_twin) -> Viewed:
    """Fitted without sampling."""
    from tvsbayes.pipeline import calibrate

    folder = unfitted_twin.parent / "fitted"
    shutil.copytree(unfitted_twin, folder)
    calibrate(read_campaign(folder), folder / "results", sampled=False)
    return Viewed(folder, unfitted_twin)
