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
    ("red", ("verdict: VALIDATION FAILED", "verdict: UNCONVERGED", "NO NUMBER OF LOOKS")),
    ("yellow", ("warning:", "weak", "prior conflict:", "hangs on one stop:", "few stops", "spots that disagree")),
    ("green", ("verdict: usable",)),
    ("cyan", ("next:", "what to do:", "what helps:")),
)
"""Colour, and how lines of that colour begin."""
TABLE = "  "
"""Stands between cells, never between words of a sentence."""
BOLD = ("error:", "verdict:", "next:", "VALIDATION FAILED")


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
    folded = line
    if len(line) > width and TABLE not in line.strip():
        lines = textwrap.wrap(line, width, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)
        folded = "\n".join(lines)
    colour = next((colour for colour, begins in COLOUR_OF if line.startswith(begins)), None)
    if colour is None or not colours:
        return folded
    return typer.style(folded, fg=colour, bold=line.startswith(BOLD))
