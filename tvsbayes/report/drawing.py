"""The common style of all figures: size, colours, text, and a figure as an SVG document.

Figures are as wide as a phone (4.6 inch) with text of 9 points. Colours are Okabe and Ito's (safe for colour-blind
readers, jfly.uni-koeln.de/color); a colour with a meaning always has a marker or label too. Importing the module
loads no matplotlib.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

WIDTH_IN = 4.6
BLACK, ORANGE, SKY, GREEN, BLUE, RED, PURPLE, GREY = (
    *("#000000", "#E69F00", "#56B4E9", "#009E73", "#0072B2", "#D55E00", "#CC79A7"),
    "#767676",
)
ESTIMATOR_STYLE = {"nominal": (GREY, "s"), "classic": (RED, "^"), "joint": (BLUE, "o")}
"""Colour and marker of each estimator in every figure."""
DIRECTION_STYLE = {
    **{"left": ("<", BLUE), "right": (">", RED), "up": ("^", GREEN), "down": ("v", ORANGE)},
    **{"forward": (">", BLUE), "backward": ("<", RED), "": ("x", GREY)},
}
"""Marker and colour of each direction of a scanner and of an axis in every figure; "" for an unknown direction."""
SMALLEST_SHARE = 0.005
"""Least share of a variance with its own bar or row; smaller shares appear only in fit.json."""
DIVERGING, SEQUENTIAL = (BLUE, "#FFFFFF", RED), ("#FFFFFF", SKY, BLUE, "#00263E")
"""Colours of maps, from the lowest to the highest value."""
RASTER_DPI = 150
"""Resolution of parts of a figure with hundreds of points."""
STYLE: dict[Any, object] = {
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#DDDDDD",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "legend.fontsize": 9.0,
    "svg.hashsalt": "tvsbayes",
}


@contextmanager
def drawing(height_in: float) -> Iterator[Figure]:
    """A figure in the common style, as wide as a phone, filled by the caller."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        yield Figure(figsize=(WIDTH_IN, height_in), layout="constrained")


def legend(figure: Figure, columns: int, panel: Axes | None = None) -> None:
    """Draw a legend below the panels, for one of them or for all, without repetition."""
    handles: dict[object, Artist] = {}
    for axes in figure.axes if panel is None else [panel]:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    figure.legend(list(handles.values()), list(map(str, handles)), loc="outside lower center", ncols=columns)


def banded(axes: Axes, x: np.ndarray, band: np.ndarray, name: str, light: str = SKY, dark: str = BLUE) -> None:
    """A curve with its 95 % band; `band` has low, mean, high, shape (3, n)."""
    axes.fill_between(x, band[0], band[2], color=light, alpha=0.4, linewidth=0, label=f"{name}, 95 %")
    axes.plot(x, band[1], color=dark, linewidth=1.2, label="its mean")


def colour_map(stops: Sequence[str]) -> Colormap:
    """A map of colours between these, from the lowest to the highest value."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("-".join(stops), stops)


def svg(figure: Figure) -> bytes:
    """A figure as an SVG document; the same figure gives the same bytes."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    buffer, dpi = io.BytesIO(), figure.dpi
    # Writing creates the identifiers in the file. The canvas draws once; `savefig` would draw the layout first.
    with rc_context(STYLE):
        figure.dpi = RASTER_DPI
        FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None, "Creator": None})
        figure.dpi = dpi
    return re.sub(rb">\s+<", b"><", buffer.getvalue())
