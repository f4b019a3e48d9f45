"""Axis folders from tables of ISO 230-2 runs that others printed (`experiments.common.printed_runs`).

python -m experiments.real.axis_files FOLDER OUT            # every FOLDER/*.csv becomes OUT/NAME
"""

from __future__ import annotations

from pathlib import Path

from experiments.common.command_line import parser
from experiments.common.printed_runs import axis_of, tables_of
from tvsbayes.single_axis.axis_campaign import write_axis


def main() -> None:
    """Write every folder."""
    cli = parser(__doc__)
    cli.add_argument("folder", type=Path)
    cli.add_argument("out", type=Path)
    arguments = cli.parse_args()
    for table in tables_of(arguments.folder):
        write_axis(axis_of(table), arguments.out / table.stem)
        print(arguments.out / table.stem)


if __name__ == "__main__":
    main()
