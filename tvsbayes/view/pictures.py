"""Pictures in the page of a campaign: every look's, reduced, as data URIs within a limit of total size.

px of the sensor with the integer at the centre of a pixel.
"""

from __future__ import annotations

import base64
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tvsbayes.errors import InputError
from tvsbayes.files.images import WINDOW_PX, read_image, small_picture
from tvsbayes.instrument.campaign import CAMERAS, frame_name
from tvsbayes.progress import Advance
from tvsbayes.view.scene import LookColumns

WIDTH_PX = 320
"""Width of a whole picture."""
PICTURES_BYTES_MAX = 24_000_000
"""Limit for all pictures of a page: 600 looks of two cameras in a lit room, 3800 in the dark."""
GOLDEN = (5**0.5 - 1) / 2


@dataclass(frozen=True)
class PagePicture:
    """One picture of a look.

    Attributes:
        whole: data URI of the whole picture, reduced.
        spot: data URI of the region around the spot, unreduced; None without a spot in the picture.
        corner_px: (u, v) of the outer corner of this region.
        side_px: side of this region.
    """

    whole: str
    spot: str | None
    corner_px: tuple[float, float] | None
    side_px: int = WINDOW_PX

    @property
    def size(self) -> int:
        """Size in the page, bytes."""
        return len(self.whole) + len(self.spot or "")


def look_pictures(
    folder: Path | None, looks: LookColumns, bytes_max: int = PICTURES_BYTES_MAX, advance: Advance = lambda share: None
) -> dict[int, dict[str, PagePicture]]:
    """Select pictures by look and camera: suspect looks first, then looks evenly chosen until the limit is reached.

    Args:
        folder: folder of the campaign; links that lead out of it are not followed.
        looks: the looks, with their pictures and spots.
        bytes_max: largest total size of data URIs.
        advance: called with the share done.
    """
    pictures: dict[int, dict[str, PagePicture]] = {}
    kept = np.flatnonzero(looks.pictures.any(axis=1))
    # Multiples of the golden ratio modulo 1 are evenly distributed for any number of them (Weyl).
    order = sorted(kept.tolist(), key=lambda row: (not looks.suspect[row], row * GOLDEN % 1.0))
    size = 0
    for count, row in enumerate(order if folder is not None else ()):
        of_look = _pictures(Path(folder or ""), looks, row)
        size += sum(picture.size for picture in of_look.values())
        if size > bytes_max:
            break
        if of_look:
            pictures[int(looks.spot[row])] = of_look
        advance((count + 1) / len(order))
    return pictures


def _pictures(folder: Path, looks: LookColumns, row: int) -> dict[str, PagePicture]:
    """Pictures of one look; damaged ones, and links out of the folder, are left out."""
    pictures = {}
    for k, camera in enumerate(CAMERAS):
        if not looks.pictures[row, k]:
            continue
        try:
            image = read_image(folder / frame_name(int(looks.spot[row]), camera), folder)
        except InputError:
            continue
        u, v = looks.pixels_px[row, 2 * k : 2 * k + 2].tolist()
        spot, corner = None, None
        if 0 <= u <= image.shape[1] - 1 and 0 <= v <= image.shape[0] - 1:
            spot = _uri(small_picture(image, (u, v)))
            corner = (round(u) - WINDOW_PX / 2 - 0.5, round(v) - WINDOW_PX / 2 - 0.5)
        pictures[camera] = PagePicture(_uri(small_picture(image, width_px=WIDTH_PX)), spot, corner)
    return pictures


def _uri(jpeg: bytes) -> str:
    return f"data:image/jpeg;base64,{base64.b64encode(jpeg).decode('ascii')}"
