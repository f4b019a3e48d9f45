"""The command line of a script: its docstring is its help."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

from experiments.common.rows import read_rows, rows_of, run_rows

Action = Callable[[argparse.Namespace], object]


def parser(doc: str | None, **actions: Action) -> argparse.ArgumentParser:
    """A parser whose help is the script's docstring as it stands; its first argument is one of the actions, if any."""
    cli = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    if actions:
        cli.add_argument("action", choices=list(actions))
        cli.set_defaults(actions=actions)
    return cli


def print_only(doc: str | None) -> None:
    """The command line of a script without options."""
    parser(doc).parse_args()


def act(cli: argparse.ArgumentParser) -> object:
    """Carry out the action of the command line."""
    arguments = cli.parse_args()
    return arguments.actions[arguments.action](arguments)


def by_seed(kinds: Iterable[object], n: int) -> list[tuple]:
    """Tasks of kinds, which may be tuples, with every seed below `n`: an interrupted run leaves balanced rows."""
    return [(*(kind if isinstance(kind, tuple) else (kind,)), seed) for seed in range(n) for kind in kinds]


def study(
    script: str,
    doc: str | None,
    one: Callable,
    keys: Sequence[str],
    tasks: Callable[[argparse.Namespace], Sequence[tuple]] | Iterable[object],
    table: Callable[[list[dict]], object],
    n: int | None = None,
    options: Mapping[str, Mapping] | None = None,
    **actions: Action,
) -> None:
    """Carry out an action of a study: `run` makes the rows that are not there yet, `table` prints the page of all.

    Args:
        script: its `__file__`; its rows are those of `rows_of` where `--rows` names no other file.
        doc: its docstring.
        one: a module-level function from task to row.
        keys: names of a task's parts in the row.
        tasks: of the options, in the order in which they are done; or kinds, see `by_seed`.
        table: prints the page from the rows.
        n: default of `--n`; without it there is no such option.
        options: further arguments, by their names.
        actions: beside `run` and `table`.
    """

    def run(arguments: argparse.Namespace) -> None:
        chosen = tasks(arguments) if callable(tasks) else by_seed(tasks, arguments.n)
        run_rows(one, chosen, arguments.rows, keys, arguments.cores)

    cli = parser(doc, run=run, table=lambda arguments: table(read_rows(arguments.rows)), **actions)
    cli.add_argument("--cores", type=int, nargs="+", default=[0], metavar="CORE", help="one worker is pinned to each")
    cli.add_argument("--rows", type=Path, default=rows_of(script), help="file of rows (%(default)s)")
    if n is not None:
        cli.add_argument("--n", type=int, default=n, help="how many (%(default)s)")
    for name, keywords in (options or {}).items():
        cli.add_argument(name, **keywords)
    act(cli)
