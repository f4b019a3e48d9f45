"""The command, and what all commands share: options, output as text or one JSON document, errors."""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from tvsbayes.cli.examples import FIRST, epilog
from tvsbayes.cli.terminal import shown
from tvsbayes.errors import InputError, TvsError, escaped, refusal, typed
from tvsbayes.files.disk import make_folder, write_atomically

INTERRUPTED = 130
TARGET_MISSED = 1
"""Done, but a limit or target that the user gave is not met."""
app = typer.Typer(
    name="tvsbayes",
    help="What one motor step of a geared laser positioner does to the beam, and how sure that is.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        _print(f"tvsbayes {version('tvsbayes')}")
        raise typer.Exit


@app.callback(epilog=epilog(FIRST))
def _options(
    _version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    pass


Json = Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout.")]
Seed = Annotated[int, typer.Option("--seed", min=0, help="Seed of everything random.")]
Anyway = Annotated[bool, typer.Option("--anyway", help="Go on at what `check` is certain of.")]
OldOut = Annotated[Path | None, typer.Option("--output", hidden=True)]
"""The former name of --out."""
CampaignFolder = Annotated[Path, typer.Argument(metavar="CAMPAIGN", help="Campaign folder.")]


class Ended(Exception):
    """Ends a command whose document is out with an exit code other than 0."""

    def __init__(self, exit_code: int):
        super().__init__(exit_code)
        self.exit_code = exit_code


def report_line(text: str) -> None:
    """A line for people, on stderr; text from files may hold control characters."""
    try:
        typer.echo(shown("".join(c if c.isprintable() else "?" for c in text), sys.stderr), err=True)
    except OSError:
        # Ctrl-C ends the `tee` behind us too: nobody is left to be informed, and the work goes on. What is still in the
        # stream's buffer must not fail again while Python ends.
        sys.stderr = open(os.devnull, "w", encoding="utf-8")


class OutputFailed(Exception):
    """Standard output took no more, as on a full disk."""


def _print(text: str) -> None:
    try:
        typer.echo(shown(text, sys.stdout))
    except OSError as error:
        # What is still in its buffer must not fail again while Python ends.
        sys.stdout = open(os.devnull, "w", encoding="utf-8")
        if isinstance(error, BrokenPipeError):
            # Anyone who read has gone, like `head`; the work is done, and its exit code stands.
            return
        raise OutputFailed(error.strerror or str(error)) from error


def print_json(document: Mapping[str, Any]) -> None:
    """The one document on stdout; NaN is a bug, not a value."""
    _print(json.dumps(document, indent=1, allow_nan=False, ensure_ascii=True))


def error_document(error: TvsError) -> dict[str, Any]:
    """What `--json` prints of an error."""
    fields = {"code": error.code, "file": error.file, "line": error.line, "column": error.column}
    fields |= {"message": error.message, "found": error.found, "allowed": error.allowed, "remedy": error.remedy}
    return {"error": fields}


def somebody_there() -> bool:
    """Whether a question would be read by somebody; a closed standard input (`<&-`) is None."""
    return sys.stdin is not None and sys.stdin.isatty()


def confirmed(lines: list[str], to: Path, yes: bool, as_json: bool) -> bool:
    """Whether an import may be written; somebody who can answer is shown the `lines`, which are empty then."""
    if yes or as_json or not somebody_there():
        return yes
    typer.echo("\n".join(lines))
    lines.clear()
    return typer.confirm(f"write this into {escaped(str(to), 200)}?", default=False)


def report_error(error: TvsError) -> None:
    """An error for people, with what to do where the message does not say it."""
    report_line(f"error: {error.message}")
    if error.remedy and error.remedy not in error.message:
        report_line(f"what to do: {error.remedy}")


def finish(document: Mapping[str, Any], text: str, as_json: bool, error: TvsError | None = None) -> None:
    """Print a result in the wanted form; one that must not be used carries its error and its exit code."""
    if as_json:
        print_json(document if error is None else {**document, **error_document(error)})
    else:
        _print(text)
    if error is not None:
        if not as_json:
            report_error(error)
        raise Ended(error.exit_code)


def tell_part(text: str, as_json: bool) -> None:
    """A part of a longer command's text, as soon as it is known; under --json the document at the end has it."""
    if not as_json:
        _print(f"{text}\n")


def tell_removed(names: Iterable[str], written: Mapping[str, str], *, certificates: bool = True) -> None:
    """Say which files made of an earlier page are gone, but for those written anew; an axis has no certificates."""
    gone = [name for name in names if name not in {Path(place).name for place in written.values()}]
    if gone:
        again = "`tvsbayes report --pdf`" + " or `--dcc`" * certificates
        report_line(f"removed: {', '.join(gone)}, made of an earlier report; {again} makes them again")


def command_line(*words: object) -> str:
    """A command to be typed, its words quoted where a shell needs it."""
    return "tvsbayes " + " ".join(typed(word, 400) for word in words)


def keep(document: Mapping[str, Any], path: Path) -> bool:
    """Write what a later report will show; a folder that cannot be written costs nobody the result."""
    try:
        make_folder(path.parent)
        write_atomically(path, json.dumps(document, indent=1, allow_nan=False).encode())
    except InputError as error:
        report_line(f"warning: not kept for the report: {error.message}")
        return False
    return True


PARTS = ("campaign.toml", "stereo.json", "moves.csv", "spots.csv", "readings.csv", "log.jsonl")
"""Of a campaign, of a scanner or an axis, and its journal."""


def is_part(path: Path) -> bool:
    """Whether a file is one of those that make a campaign of the folder it lies in, or one of its pictures."""
    pictured = path.parent.name == "frames"
    folder = path.parent.parent if pictured else path.parent
    return (pictured or path.name in PARTS) and path.is_file() and (folder / PARTS[0]).is_file()


def refuse_options(reason: str, remedy: str, **given: object) -> None:
    """Refuse options that this use of a command would ignore; given are those that are neither None nor False."""
    named = ["--" + name.replace("_", "-") for name, value in given.items() if value is not None and value is not False]
    if named:
        raise InputError("usage", f"{' and '.join(named)} {'are' if len(named) > 1 else 'is'} {reason}", remedy=remedy)


def in_order(rig: Path, plan: Path) -> None:
    """Refuse a rig file and a plan in each other's place."""
    if rig.suffix.lower() == ".csv" and plan.suffix.lower() == ".toml":
        both = f"{escaped(str(plan), 200)} {escaped(str(rig), 200)}"
        message = "the plan stands where the rig file belongs: they are swapped"
        raise InputError("usage", message, allowed="RIG PLAN", remedy=f"write {both}")


def spared(out: Path | None, *inputs: Path | None) -> None:
    """Refuse an output before the work: without a folder, or in the place of what is read or of a campaign's data."""
    if out is None:
        return
    name = escaped(str(out), 200)
    if not out.parent.is_dir():
        found, remedy = "no such folder", "make the folder, or name another place"
        raise refusal("write", file=name, found=found, allowed="a writable folder with free space", remedy=remedy)
    read = out.is_file() and any(one is not None and one.is_file() and one.samefile(out) for one in inputs)
    if read or is_part(out):
        what = "a file that is read" if read else "data of the campaign in that folder"
        message = f"-o {name} would replace {what}"
        raise InputError("usage", message, found=name, allowed="another file", remedy="name another file")


def finite(**values: float | None) -> None:
    """Refuse NaN and infinity, which option parsing lets through."""
    for name, value in values.items():
        if value is not None and not math.isfinite(value):
            option = "--" + name.replace("_", "-")
            allowed, remedy = "a finite number", "write a decimal number"
            raise InputError("number", f"{option} is {value}", column=option, allowed=allowed, remedy=remedy)
