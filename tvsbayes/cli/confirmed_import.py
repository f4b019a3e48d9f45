"""An import of any kind: shown, written where the user agrees, and the next step."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer

from tvsbayes.cli.app import finish, is_interactive
from tvsbayes.errors import InputError, escaped, refusal


def _as_paths(written: list[str]) -> dict[str, Any]:
    return {"files": written}


@dataclass(frozen=True)
class Import:
    """An import before it is written.

    Attributes:
        lines: its contents and assumptions, for people.
        document: the same for programs.
        write: writes it; returns the paths for people.
        next_step: what to do after that.
        hint: how to correct what is shown.
        outcome: last entries of the document, from the written paths.
    """

    lines: Sequence[str]
    document: Mapping[str, Any]
    write: Callable[[], list[str]]
    next_step: str
    hint: str = ""
    outcome: Callable[[list[str]], Mapping[str, Any]] = _as_paths

    def carry_out(self, to: Path, yes: bool, as_json: bool) -> None:
        """Write it into a folder with --yes, or where an interactive user agrees, and print the result."""
        lines = list(self.lines)
        if not yes and not as_json and is_interactive():
            typer.echo("\n".join(lines))
            lines.clear()
            yes = typer.confirm(f"write this into {escaped(str(to), 200)}?", default=False)
        written = self.write() if yes else []
        if written:
            lines += [f"written: {', '.join(written)}", f"next: {self.next_step}"]
        else:
            lines.append(f"nothing written: add --yes{self.hint}")
        finish({**self.document, **self.outcome(written)}, "\n".join(lines), as_json)


def occupied(path: Path, what: str = "rows") -> InputError:
    """The refusal of a table that is filled already: nothing is overwritten."""
    remedy = "name another folder with --to; nothing is overwritten"
    return refusal("occupied", file=escaped(str(path), 200), found=what, allowed=f"no {what} yet", remedy=remedy)
