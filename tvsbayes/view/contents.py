"""What a page serves: its files by a list, the document of the scenes, pictures of looks by number.

No path of a request is ever a path on the disk, and nothing can be written.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from tvsbayes.errors import InputError
from tvsbayes.files.disk import read_bytes, shipped_data
from tvsbayes.files.images import IMAGE_BYTES_MAX
from tvsbayes.instrument.campaign import CAMERAS, frame_name

PAGE_FILES = {
    "/": ("page.html", "text/html; charset=utf-8"),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
    "/columns.js": ("columns.js", "text/javascript; charset=utf-8"),
    "/plots.js": ("plots.js", "text/javascript; charset=utf-8"),
    "/rig.js": ("rig.js", "text/javascript; charset=utf-8"),
    "/page.js": ("page.js", "text/javascript; charset=utf-8"),
}
"""Paths of the page, their files in `data/view` and what they are."""
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


@dataclass(frozen=True)
class Contents:
    """What a page serves.

    Attributes:
        document: JSON of the scenes.
        folders: of their campaigns, in the same order.
        files: content and type by path.
        pictures: looks by campaign whose pictures may be asked for.
    """

    document: bytes
    folders: tuple[Path, ...]
    pictures: tuple[frozenset[int], ...]
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


def page_files() -> dict[str, tuple[bytes, str]]:
    """The page and Plotly's script, by path.

    Raises:
        InputError: without the extra.
    """
    try:
        import tornado  # noqa: F401
        from plotly.offline import get_plotlyjs
    except ImportError as error:
        raise InputError(
            "no-view", "view needs the extra view (plotly, tornado)", remedy="pip install 'tvsbayes[view]'"
        ) from error
    folder = shipped_data() / "view"
    files = {path: ((folder / name).read_bytes(), kind) for path, (name, kind) in PAGE_FILES.items()}
    return {**files, "/plotly.js": (get_plotlyjs().encode(), "text/javascript; charset=utf-8")}
