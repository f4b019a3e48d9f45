"""Commands on pages of the documentation: as they are typed, with what they print."""

from __future__ import annotations

import io
from contextlib import redirect_stderr, redirect_stdout

from tvsbayes.cli.main import run


def quietly(*line: str) -> tuple[int, str, str]:
    """Exit code of a command, what it prints, and what it warns of."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        code = run(list(line))
    return code, out.getvalue(), err.getvalue()


def console(*line: str, last: int = 0, first: int | None = None) -> str:
    """A command and what it prints, as a block of Markdown; of a refusal the message.

    Args:
        line: what follows `tvsbayes`.
        last: how many of the last lines are shown; 0: all.
        first: how many of the first ones are shown; None: all.
    """
    code, out, err = quietly(*line)
    printed = [text.rstrip() for text in (out if code < 2 else err).splitlines()]
    shown = f" | tail -{last}" if last else "" if first is None else f" | head -{first}"
    return "\n".join(["```console", f"$ tvsbayes {' '.join(line)}{shown}", *printed[-last:][:first], "```", ""])
