"""Lines on a terminal: colour by their first words, sentences wrapped between words.

No colour where NO_COLOR is set (https://no-color.org); files and pipes get the plain text, line by line.
"""

from __future__ import annotations

import os
import shutil
import textwrap
from typing import IO

import typer

COLOUR_STARTS = (
    ("red", ("error:", "VALIDATION FAILED", "NOT CONVERGED", "UNCONVERGED", "EXTRAPOLATED", "verdict: NOT CONVERGED")),
    ("red", ("verdict: VALIDATION FAILED", "verdict: UNCONVERGED", "verdict: PRIOR CONFLICT", "NO NUMBER OF LOOKS")),
    ("red", ("MOVED (p ",)),
    ("yellow", ("warning:", "weak", "prior conflict:", "depends on one stop:", "few stops", "spots that disagree")),
    ("yellow", ("CANNOT TELL (p ", "verdict: DOUBTFUL", "doubt:")),
    ("green", ("verdict: usable", "OK (p ")),
    ("cyan", ("next:", "what to do:", "what helps:")),
)
"""Colours, with the first words of lines in that colour."""
CELL_GAP = "  "
"""Separator of cells, which never separates words of a sentence."""
LAST_CELL_MIN = 16
"""Least width of the last cell for which it is wrapped below itself."""
BOLD_STARTS = ("error:", "verdict:", "next:", "VALIDATION FAILED", "MOVED (p ", "CANNOT TELL (p ", "OK (p ")


def shows_colour(stream: IO[str]) -> bool:
    """Whether a stream is a terminal that may be coloured."""
    return not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb" and stream.isatty()


def styled(text: str, stream: IO[str]) -> str:
    """Text with colours and line breaks for a terminal; unchanged for other streams."""
    if not stream.isatty():
        return text
    width, colours = shutil.get_terminal_size().columns, shows_colour(stream)
    return "\n".join(_line(line, width, colours) for line in text.split("\n"))


def _line(line: str, width: int, colours: bool) -> str:
    folded = line if len(line) <= width else _folded(line, width)
    colour = next((colour for colour, starts in COLOUR_STARTS if line.startswith(starts)), None)
    if colour is None or not colours:
        return folded
    return typer.style(folded, fg=colour, bold=line.startswith(BOLD_STARTS))


def _folded(line: str, width: int) -> str:
    """A wrapped line: a sentence is indented by two columns, the last cell of a row to the start of the cell."""
    start = line.rstrip().rfind(CELL_GAP) + len(CELL_GAP) if CELL_GAP in line.strip() else 0
    if start > width - LAST_CELL_MIN:
        return line
    indent = " " * (start or 2)
    lines = textwrap.wrap(
        line[start:],
        width,
        initial_indent=" " * start,
        subsequent_indent=indent,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return line[:start] + "\n".join(lines)[start:]
