"""What a page serves: its files by a list, the document of the scenes, pictures of looks by number.

No path of a request is ever a path on the disk, and nothing can be written.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from tvsbayes.errors import InputError
from tvsbayes.files.disk import read_bytes, shipped_data
from tvsbayes.files.images import IMAGE_BYTES_MAX, PNG_SIGNATURE
from tvsbayes.instrument.campaign import CAMERAS, frame_name

HTML, CSS, SCRIPT = ("text/html; charset=utf-8", "text/css; charset=utf-8", "text/javascript; charset=utf-8")
SHARED_FILES = {"/page.css": ("page.css", CSS), "/access.js": ("access.js", SCRIPT)}
PAGE_FILES = {
    "/": ("page.html", HTML),
    **SHARED_FILES,
    "/columns.js": ("columns.js", SCRIPT),
    "/plots.js": ("plots.js", SCRIPT),
    "/rig.js": ("rig.js", SCRIPT),
    "/page.js": ("page.js", SCRIPT),
}
"""Paths of the page of a campaign, their files in `data/view` and what they are."""
LIVE_FILES = {
    "/": ("live.html", HTML),
    **SHARED_FILES,
    "/live.css": ("live.css", CSS),
    "/live.js": ("live.js", SCRIPT),
}
"""The same of the page of a run."""


@dataclass(frozen=True)
class Contents:
    """What a page serves.

    Attributes:
        document: JSON of the scenes.
        folders: of their campaigns, in the same order.
        files: content and type by path.
        pictures: looks by campaign whose pictures may be asked for.
    """

    document: bytes = b"{}"
    folders: tuple[Path, ...] = ()
    pictures: tuple[frozenset[int], ...] = ()
    files: dict[str, tuple[bytes, str]] = field(default_factory=dict)

    def picture(self, campaign: int, spot: int, camera: str) -> bytes | None:
        """A picture of a look as it lies in `frames/`; None where there is none, or what lies there is none."""
        if campaign >= len(self.folders) or spot not in self.pictures[campaign] or camera not in CAMERAS:
            return None
        folder = self.folders[campaign]
        try:
            content = read_bytes(folder / frame_name(spot, camera), IMAGE_BYTES_MAX, folder)
        except InputError:
            return None
        return content if content.startswith(PNG_SIGNATURE) else None


def page_files(names: Mapping[str, tuple[str, str]] = PAGE_FILES) -> dict[str, tuple[bytes, str]]:
    """A page and Plotly's script, by path.

    Args:
        names: files in `data/view` and what they are, by path.

    Raises:
        InputError: without the extra.
    """
    try:
        import tornado  # noqa: F401
        from plotly.offline import get_plotlyjs
    except ImportError as error:
        raise InputError(
            "no-view", "the page needs the extra view (plotly, tornado)", remedy="pip install 'tvsbayes[view]'"
        ) from error
    folder = shipped_data() / "view"
    files = {path: ((folder / name).read_bytes(), kind) for path, (name, kind) in names.items()}
    return {**files, "/plotly.js": (get_plotlyjs().encode(), SCRIPT)}
