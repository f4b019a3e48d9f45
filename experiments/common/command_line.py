"""The command line of a script: its docstring is its help."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

Action = Callable[[argparse.Namespace], object]


def parser(doc: str | None) -> argparse.ArgumentParser:
    """A parser whose help is the script's docstring as it stands."""
    return argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)


def print_only(doc: str | None) -> None:
    """The command line of a script without options."""
    parser(doc).parse_args()


def study_parser(
    doc: str | None, rows: Path, n: int | None = None, actions: tuple[str, ...] = ("run", "table")
) -> argparse.ArgumentParser:
    """A parser for a study that makes rows on given cores and prints a table of them.

    Args:
        doc: the script's docstring.
        rows: the default file of rows.
        n: default of `--n`; without it there is no such option.
        actions: the actions, see `act`.
    """
    cli = parser(doc)
    cli.add_argument("action", choices=actions)
    cli.add_argument("--cores", type=int, nargs="+", default=[0], metavar="CORE", help="one worker is pinned to each")
    cli.add_argument("--rows", type=Path, default=rows, help="file of rows (%(default)s)")
    if n is not None:
        cli.add_argument("--n", type=int, default=n, help="how many (%(default)s)")
    return cli


def act(cli: argparse.ArgumentParser, **actions: Action) -> None:
    """Carry out the action of the command line."""
    arguments = cli.parse_args()
    actions[arguments.action](arguments)
