"""Figures of pages: in the house style of the reports, and the line by which a page begins with one."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from matplotlib.figure import Figure

from tvsbayes.report.drawing import WIDTH_IN, drawing

DPI = 130


@contextmanager
def page_figure(path: Path, height_in: float, width_in: float = WIDTH_IN) -> Iterator[Figure]:
    """A figure in the house style; written where the caller is done with it, and not if drawing fails.

    Args:
        path: the PNG.
        height_in: of the figure, inches.
        width_in: as wide as a phone's page; wider for panels side by side.
    """
    with drawing(height_in) as figure:
        figure.set_figwidth(width_in)
        yield figure
        figure.savefig(path, dpi=DPI)


def title_and_figure(script: str, title: str, path: Path, words: str) -> str:
    """How a page begins: its title, then its figure.

    Args:
        script: the `__file__` of the script beside whose page it is.
        title: of the page.
        path: the PNG that `page_figure` writes.
        words: what is seen, for those who see no pictures.
    """
    place = Path(os.path.relpath(path.resolve(), Path(script).resolve().parent)).as_posix()
    return f"# {title}\n\n![{words}]({place})\n"
