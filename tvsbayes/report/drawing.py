"""The house style of all figures: size, colours, text, and a figure as an SVG document.

Figures are one phone's width (4.6 inch) with text of 9 points. Colours are Okabe and Ito's (safe for colour-blind
readers, jfly.uni-koeln.de/color); wherever a colour means something, a marker or a label says the same. Importing the
module loads no matplotlib.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

WIDTH_IN = 4.6
BLACK, ORANGE, SKY, GREEN, BLUE, RED, PURPLE, GREY = (
    *("#000000", "#E69F00", "#56B4E9", "#009E73", "#0072B2", "#D55E00", "#CC79A7"),
    "#767676",
)
OF_ESTIMATOR = {"nominal": (GREY, "s"), "classic": (RED, "^"), "joint": (BLUE, "o")}
"""Colour and marker of each estimator in every figure."""
OF_DIRECTION = {
    **{"left": ("<", BLUE), "right": (">", RED), "up": ("^", GREEN), "down": ("v", ORANGE)},
    **{"forward": (">", BLUE), "backward": ("<", RED), "": ("x", GREY)},
}
"""Marker and colour of each direction of a scanner and of an axis in every figure; "" where nobody knows it."""
SMALLEST_SHARE = 0.005
"""Of a variance, that has a bar or a row of its own; what is below stands in fit.json alone."""
DIVERGING, SEQUENTIAL = (BLUE, "#FFFFFF", RED), ("#FFFFFF", SKY, BLUE, "#00263E")
"""Colours of maps, from the lowest to the highest value."""
RASTER_DPI = 150
"""Of the parts of a figure with hundreds of points."""
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
    """A figure in the house style, one phone wide, filled by the caller."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        yield Figure(figsize=(WIDTH_IN, height_in), layout="constrained")


def legend(figure: Figure, columns: int, of: Axes | None = None) -> None:
    """What the marks mean, below the panels: of one of them, else of all, each name once."""
    named: dict[object, Artist] = {}
    for axes in figure.axes if of is None else [of]:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            named.setdefault(label, handle)
    figure.legend(list(named.values()), list(map(str, named)), loc="outside lower center", ncols=columns)


def colour_map(stops: Sequence[str]) -> Colormap:
    """Colours between these, from the lowest to the highest value."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("-".join(stops), stops)


def svg(figure: Figure) -> bytes:
    """A figure as an SVG document; the same figure gives the same bytes."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    buffer, dpi = io.BytesIO(), figure.dpi
    # The identifiers in the file are drawn when it is written. The canvas draws once, where `savefig` draws a first
    # time for the layout alone.
    with rc_context(STYLE):
        figure.dpi = RASTER_DPI
        FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None, "Creator": None})
        figure.dpi = dpi
    return re.sub(rb">\s+<", b"><", buffer.getvalue())
