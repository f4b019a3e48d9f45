"""A picture of one spot as `detect` sees it: outline, centre, or the reason why there is none."""

from __future__ import annotations

import numpy as np

from tvsbayes.cameras.spot_fit import Centre

OVERLAY_HALF_PX, OVERLAY_ZOOM = 32, 8
"""Half the side of the square that an overlay shows, and how many of its pixels show one."""


def overlay_of(picture: np.ndarray, centre: Centre) -> np.ndarray:
    """The surroundings of a spot enlarged: outline green, centre red, the reason of a refusal in words (Figure 9)."""
    import cv2

    if picture.dtype != np.uint8:
        picture = np.clip(np.rint(picture), 0, 255).astype(np.uint8)

    half, zoom = OVERLAY_HALF_PX, OVERLAY_ZOOM
    height, width = picture.shape[:2]
    middle = centre.centre_px
    if middle is None:
        outline = centre.outline_px
        middle = np.array([width, height]) / 2 if outline is None or not len(outline) else outline.mean(axis=0)
    low = np.clip(np.round(middle).astype(int) - half, 0, np.maximum((width, height) - np.array(2 * half), 0))
    crop = picture[low[1] : low[1] + 2 * half, low[0] : low[0] + 2 * half]
    crop = cv2.copyMakeBorder(crop, 0, 2 * half - crop.shape[0], 0, 2 * half - crop.shape[1], cv2.BORDER_CONSTANT)
    large = cv2.resize(crop, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_NEAREST)
    if centre.outline_px is not None and len(centre.outline_px):
        outline = np.round((centre.outline_px - low + 0.5) * zoom).astype(np.int32)
        cv2.polylines(large, [outline.reshape(-1, 1, 2)], True, (0, 255, 0), 1, cv2.LINE_AA)
    if centre.centre_px is not None:
        dot = np.round((centre.centre_px - low + 0.5) * zoom).astype(int)
        cv2.circle(large, tuple(map(int, dot)), zoom // 2, (0, 0, 255), -1, cv2.LINE_AA)
    if centre.status != "ok":
        cv2.putText(
            large, centre.status, (zoom, 3 * zoom), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (0, 255, 255), 1, cv2.LINE_AA
        )
    return large
