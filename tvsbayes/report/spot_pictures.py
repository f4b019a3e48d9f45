"""Cut-outs of a few spots with their centres, where a campaign has its frames.

Grey values of the raw pictures; px of the sensor with the integer at the centre of a pixel.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tvsbayes.errors import InputError
from tvsbayes.files.images import read_image
from tvsbayes.instrument.campaign import CAMERAS, Campaign, Spot, frame_name, stereo_spots
from tvsbayes.report.drawing import RED, drawing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LOOKS_SHOWN = 4
HALF_PX = 20
"""Half the side of a cut-out."""


@dataclass(frozen=True)
class SpotCrop:
    """The region around a spot in one picture.

    Attributes:
        spot: id of the look.
        camera: left or right.
        grey: values, rows from top to bottom, shape (h, w).
        corner_px: pixel (u, v) of the first value.
        centre_px: (u, v) of the spot as the campaign states it.
    """

    spot: int
    camera: str
    grey: np.ndarray
    corner_px: tuple[int, int]
    centre_px: tuple[float, float]


def spot_crops(campaign: Campaign, suspects: Sequence[int]) -> tuple[SpotCrop, ...]:
    """Make cut-outs, of suspect spots first, then of others evenly chosen; none for missing or damaged frames."""
    if campaign.path is None or not (campaign.path / "frames").is_dir():
        return ()
    usable = [spot for spot in stereo_spots(campaign.spots) if spot.status == "ok"]
    suspected = [spot for spot in usable if spot.spot in set(suspects)][:LOOKS_SHOWN]
    others = [spot for spot in usable if spot not in suspected]
    count = min(LOOKS_SHOWN - len(suspected), len(others))
    indices = np.linspace(0, len(others) - 1, count).round().astype(int).tolist()
    return tuple(crop for spot in [*suspected, *(others[k] for k in indices)] for crop in _crops(campaign.path, spot))


def _crops(folder: Path, spot: Spot) -> Iterator[SpotCrop]:
    """Both cameras' cut-outs of a look."""
    for camera in CAMERAS:
        try:
            picture = read_image(folder / frame_name(spot.spot, camera), folder)
        except InputError:
            # A missing picture must not stop the report.
            continue
        u, v = float(getattr(spot, f"u_{camera}_px")), float(getattr(spot, f"v_{camera}_px"))
        left, top = max(round(u) - HALF_PX, 0), max(round(v) - HALF_PX, 0)
        # The centre of a spot cut by the edge may be outside; a negative index would count from the other edge.
        right, bottom = max(round(u) + HALF_PX + 1, 0), max(round(v) + HALF_PX + 1, 0)
        grey = picture[top:bottom, left:right].mean(axis=2)
        if grey.size:
            yield SpotCrop(spot.spot, camera, grey, (left, top), (u, v))


def spot_gallery(crops: Sequence[SpotCrop]) -> Figure:
    """Draw the cut-outs, a column per look, with a cross at each centre."""
    looks = list(dict.fromkeys(crop.spot for crop in crops))
    with drawing(2.9) as figure:
        panels = figure.subplots(len(CAMERAS), len(looks), squeeze=False)
        for axes in panels.flat:
            axes.set_axis_off()
        for crop in crops:
            axes = panels[CAMERAS.index(crop.camera), looks.index(crop.spot)]
            (left, top), (height, width) = crop.corner_px, crop.grey.shape
            extent = (left - 0.5, left + width - 0.5, top + height - 0.5, top - 0.5)
            axes.imshow(crop.grey, cmap="gray", extent=extent, interpolation="nearest")
            axes.plot(*crop.centre_px, "+", color=RED, markersize=9)
            axes.set_title(f"{crop.spot}, {crop.camera}")
    return figure
