"""The page of a campaign: one HTML file with its style, scripts and document, without network requests.

The document contains scenes as JSON, with columns of numbers as little-endian arrays in base64. They have single
precision, sufficient for drawing: 1e-4 px of 2000 px. NaN is kept.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence

import numpy as np
from markupsafe import Markup

from tvsbayes.files.packages import own_version
from tvsbayes.instrument.campaign import CAMERAS, PIXELS
from tvsbayes.report.page import rendered
from tvsbayes.results.records import plain
from tvsbayes.view.pictures import PagePicture
from tvsbayes.view.scene import Looked, Scene
from tvsbayes.view.shapes import PROBABILITY

SCRIPTS = ("drawing.js", "columns.js", "plots.js", "rig.js", "page.js")
"""Scripts in `data/view`, in the order of execution; the page of a run also uses the first."""
KINDS = {"f": "<f4", "i": "<i4", "b": "u1"}
"""Encoding of a column, by the kind of its array."""


def packed(values: np.ndarray) -> dict[str, object]:
    """Pack an array for the page: type, shape, content."""
    kind = KINDS[values.dtype.kind]
    content = np.ascontiguousarray(values, dtype=kind).tobytes()
    return {"type": kind, "shape": list(values.shape), "base64": base64.b64encode(content).decode("ascii")}


Pictures = Mapping[int, Mapping[str, PagePicture]]
"""Pictures by look and camera."""


def _scene(shown: Scene, pictures: Pictures) -> dict[str, object]:
    """The entry of one campaign; residuals are computed in double precision."""
    columns = {**vars(shown.looks), "residual_px": shown.looks.pixels_px - shown.looks.predicted_px}
    numbers = {name: packed(values) for name, values in columns.items() if isinstance(values, np.ndarray)}
    origin_mm = shown.origin_mm.tolist() if np.isfinite(shown.origin_mm).all() else None
    return {
        "name": shown.name,
        "fitted": shown.fitted,
        "notes": list(shown.notes),
        "image_px": list(shown.image_px),
        "looks": {**numbers, **{name: list(texts) for name, texts in columns.items() if name not in numbers}},
        "pictures": {str(spot): plain(by_camera) for spot, by_camera in pictures.items()},
        "pictured": len(pictures),
        "rig": {"cameras": plain(shown.cameras), "sheets": plain(shown.sheets), "origin_mm": origin_mm},
        "gears": [{**plain(band), "seen_steps": list(band.seen_steps)} for band in shown.gears],
        "parameters": plain(shown.parameters),
        "correlation": {"names": list(shown.correlated), "matrix": shown.correlation.round(4).tolist()},
    }


def document(looked: Looked, pictures: Sequence[Pictures] = ()) -> bytes:
    """Make the document of all content of a page.

    Args:
        looked: the scenes.
        pictures: pictures of each scene; none by default.
    """
    held = pictures or [{}] * len(looked.scenes)
    content = {
        "scenes": [_scene(one, of_scene) for one, of_scene in zip(looked.scenes, held, strict=True)],
        "changes": None if looked.changes is None else plain(looked.changes),
        "cameras": list(CAMERAS),
        "pixels": list(PIXELS),
        "probability": PROBABILITY,
    }
    return json.dumps(content, allow_nan=False).encode()


def page_html(document: bytes) -> bytes:
    """The page of a document of scenes, UTF-8; its policy lets only its own script run.

    Args:
        document: JSON, from `document`.
    """
    # No text of a campaign can end the element that contains the document (HTML standard 4.12.1.3).
    held = Markup(document.decode().replace("<", "\\u003c"))
    return rendered("view", "page.html", "page.css", scripts=SCRIPTS, version=own_version(), document=held)
