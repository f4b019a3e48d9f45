"""The command line: reads options, calls the library, prints tables or one JSON document.

Heavy modules are imported inside the commands that need them; `tvsbayes --help` loads none of them. Exit codes: 0 done,
1 done but a limit or target is not met, 130 interrupted, others by the classes of `errors`.
"""

from __future__ import annotations

import functools
import gc
import io
import logging
import os
import re
import sys
import warnings
from collections.abc import Callable

try:
    import typer
except ModuleNotFoundError as missing:
    # An installation without dependencies has only the Python part for robots, not the command.
    sys.exit(f"error: the command tvsbayes needs the package {missing.name}; what to do: pip install tvsbayes")

from tvsbayes.cli.acquire_command import acquire
from tvsbayes.cli.app import (
    INTERRUPTED,
    Ended,
    OutputFailed,
    app,
    error_document,
    print_json,
    report_error,
    report_line,
)
from tvsbayes.cli.begin_commands import new
from tvsbayes.cli.bench_commands import doctor, export, stereo
from tvsbayes.cli.campaign_commands import check, demo, detect, simulate
from tvsbayes.cli.compensation_commands import compensate, verify
from tvsbayes.cli.estimate_commands import classic, compare, fit
from tvsbayes.cli.examples import EXAMPLES, epilog
from tvsbayes.cli.import_command import import_
from tvsbayes.cli.report_commands import calibrate, report, view
from tvsbayes.cli.use_commands import locate, plan, steps_for, study
from tvsbayes.cli.watch_command import watch
from tvsbayes.errors import InputError, Question, TvsError

COMMANDS = (
    *(demo, new, import_, simulate, detect, stereo, check, acquire, doctor, export),
    *(classic, fit, calibrate, report, view, compare, watch, locate, steps_for, compensate, verify, plan, study),
)
"""Commands in the order of `--help`."""
GC_THRESHOLDS = 100_000, 20, 20
"""Thresholds of Python's garbage collector in a command; the default, 2000 new objects, is for small programs."""
_DECIMAL_COMMA = re.compile(r"(?:--[a-z0-9-]+=)?([-+]?[0-9]*,[0-9]+)")
for command in COMMANDS:
    name = command.__name__.rstrip("_").replace("_", "-")
    app.command(name, epilog=epilog(EXAMPLES[name]))(command)


def run(arguments: list[str]) -> int:
    """Run one command and return its exit code; no traceback reaches a user."""
    try:
        return _run(arguments)
    except OutputFailed as error:
        report_line(f"error: the result cannot be written to standard output: {error}")
        return InputError.exit_code


@functools.cache
def _commands() -> Callable[..., int | None]:
    """All commands, read from their signatures once in a process: a twentieth of a second."""
    return typer.main.get_command(app)


def _run(arguments: list[str]) -> int:
    wants_json = "--json" in arguments
    try:
        # Typer returns the code of its own Exit, into which it also turns Ctrl-C; commands return None.
        code = _commands()(arguments, prog_name="tvsbayes", standalone_mode=False) or 0
    except TvsError as error:
        if isinstance(error, Question):
            error = error.asked_by(["tvsbayes", *(word for word in arguments if word != "--json")])
        if wants_json:
            print_json(error_document(error))
        else:
            report_error(error)
        return error.exit_code
    except Ended as ending:
        return ending.exit_code
    except typer.Exit as ending:
        return ending.exit_code
    except (KeyboardInterrupt, typer.Abort):
        code = INTERRUPTED
    except Exception as error:
        # Wrong options are bad input like any other; typer's own classes carry the text to show.
        if not (hasattr(error, "format_message") and hasattr(error, "show")):
            raise
        numbers = [match[1] for word in arguments if (match := _DECIMAL_COMMA.fullmatch(word))]
        remedy = f"write a decimal point: {numbers[0].replace(',', '.')}" if numbers else "see tvsbayes --help"
        if wants_json:
            print_json(error_document(InputError("usage", error.format_message(), remedy=remedy)))
        else:
            usage = io.StringIO()
            error.show(file=usage)
            for line in [*usage.getvalue().splitlines(), *[f"what to do: {remedy}"] * bool(numbers)]:
                report_line(line)
        return InputError.exit_code
    if code == INTERRUPTED:
        if wants_json:
            print_json(error_document(TvsError("interrupted", "interrupted", remedy="run it again")))
        report_line("interrupted")
    return code


def main() -> None:
    """Entry point of the `tvsbayes` script."""
    # Read at the first import of NumPy. The matrices are small: OpenBLAS' second thread only waits, and its busy
    # waiting slows XLA's threads, tenfold where two fits share two cores.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # XLA reports a compilation of more than two minutes, as on a small computer, as an error for its authors.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    # Warnings and logs of libraries are for programmers, who ask for them by `python -W`.
    if not sys.warnoptions:
        warnings.simplefilter("ignore")
        logging.getLogger().addHandler(logging.NullHandler())
    # A command ends after seconds: the collector's passes over the objects of JAX take a twentieth of them.
    gc.set_threshold(*GC_THRESHOLDS)
    # A closed stream (`2>&-`) is None; the next file would get its number, and libraries would write errors into it.
    sys.stdout, sys.stderr = (
        open(os.devnull, "w", encoding="utf-8") if stream is None else stream for stream in (sys.stdout, sys.stderr)
    )
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        # Like Python's own stderr: characters of a name that cannot be encoded are escaped, and the command continues.
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        code = run(sys.argv[1:])
    except KeyboardInterrupt:
        # Between the end of a command and the end of the process.
        code = INTERRUPTED
    # All objects end with the process: Python would search them for cycles once more, for half a second.
    gc.freeze()
    sys.exit(code)
