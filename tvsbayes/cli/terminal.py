"""How lines look on a terminal: colour by how they begin, sentences folded between words.

Colour only where nobody said NO_COLOR (https://no-color.org); files and pipes get the plain text, line by line.
"""

from __future__ import annotations

import os
import shutil
import textwrap
from typing import IO

import typer

COLOUR_OF = (
    ("red", ("error:", "VALIDATION FAILED", "NOT CONVERGED", "UNCONVERGED", "EXTRAPOLATED", "verdict: NOT CONVERGED")),
    ("red", ("verdict: VALIDATION FAILED", "verdict: UNCONVERGED", "verdict: PRIOR CONFLICT", "NO NUMBER OF LOOKS")),
    ("red", ("MOVED (p ",)),
    ("yellow", ("warning:", "weak", "prior conflict:", "depends on one stop:", "few stops", "spots that disagree")),
    ("yellow", ("CANNOT TELL (p ",)),
    ("green", ("verdict: usable", "OK (p ")),
    ("cyan", ("next:", "what to do:", "what helps:")),
)
"""Colour, and how lines of that colour begin."""
TABLE = "  "
"""Stands between cells, never between words of a sentence."""
LAST_CELL_LEAST = 24
"""Columns that a cell needs to go on below itself."""
BOLD = ("error:", "verdict:", "next:", "VALIDATION FAILED", "MOVED (p ", "CANNOT TELL (p ", "OK (p ")


def shows_colour(stream: IO[str]) -> bool:
    """Whether a stream is a terminal that may be coloured."""
    return not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb" and stream.isatty()


def shown(text: str, stream: IO[str]) -> str:
    """Text as a terminal is to show it; the text itself where the stream is none."""
    if not stream.isatty():
        return text
    width, colours = shutil.get_terminal_size().columns, shows_colour(stream)
    return "\n".join(_line(line, width, colours) for line in text.split("\n"))


def _line(line: str, width: int, colours: bool) -> str:
    folded = line if len(line) <= width else _folded(line, width)
    colour = next((colour for colour, begins in COLOUR_OF if line.startswith(begins)), None)
    if colour is None or not colours:
        return folded
    return typer.style(folded, fg=colour, bold=line.startswith(BOLD))


def _folded(line: str, width: int) -> str:
    """A sentence goes on below, two columns in; one that is the last cell of a row goes on below that cell."""
    begins = line.rstrip().rfind(TABLE) + len(TABLE) if TABLE in line.strip() else 0
    if begins > width - LAST_CELL_LEAST:
        return line
    indent = " " * (begins or 2)
    lines = textwrap.wrap(
        line[begins:],
        width,
        initial_indent=" " * begins,
        subsequent_indent=indent,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return line[:begins] + "\n".join(lines)[begins:]
