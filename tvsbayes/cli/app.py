"""The command, and the common parts of all commands: options, output as text or one JSON document, errors."""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from tvsbayes.cli.examples import FIRST, epilog
from tvsbayes.cli.terminal import styled
from tvsbayes.errors import InputError, Question, TvsError, escaped, refusal, typed
from tvsbayes.files.disk import make_folder, require_writable, write_atomically, write_folder
from tvsbayes.files.own_outputs import require_own
from tvsbayes.files.packages import own_version

INTERRUPTED = 130
TARGET_MISSED = 1
"""Exit code of a complete command whose limit or target is not met."""
app = typer.Typer(
    name="tvsbayes",
    help="What one motor step of a geared, stepper-driven mechanism does, and how sure that is.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


def _print_version(requested: bool) -> None:
    if requested:
        _print(f"tvsbayes {own_version()}")
        raise typer.Exit


@app.callback(epilog=epilog(FIRST))
def _options(
    _version: Annotated[
        bool, Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    pass


Json = Annotated[bool, Option("--json", help="Print one JSON document on stdout.")]
Seed = Annotated[int, Option("--seed", min=0, help="Seed of everything random.")]
Force = Annotated[bool, Option("--force", help="Replace a file that tvsbayes did not write.")]
Anyway = Annotated[bool, Option("--anyway", help="Go on at what `check` is certain of.")]
OldOut = Annotated[Path | None, Option("--output", hidden=True)]
"""The former name of --out."""
CampaignFolder = Annotated[Path, Argument(metavar="CAMPAIGN", help="Campaign folder.")]


class Ended(Exception):
    """Ends a command with an exit code other than 0 after its document was printed."""

    def __init__(self, exit_code: int):
        super().__init__(exit_code)
        self.exit_code = exit_code


def report_line(text: str) -> None:
    """Print a line for people on stderr; control characters in text from files are replaced."""
    try:
        typer.echo(styled("".join(c if c.isprintable() else "?" for c in text), sys.stderr), err=True)
    except OSError:
        # Ctrl-C also ends a `tee` that reads stderr: nobody reads it any more, and the work continues. The rest of the
        # stream's buffer must not cause another error when Python ends.
        sys.stderr = open(os.devnull, "w", encoding="utf-8")


class OutputFailed(Exception):
    """Standard output accepts no more data, as on a full disk."""


def _print(text: str) -> None:
    try:
        typer.echo(styled(text, sys.stdout))
    except OSError as error:
        # The rest of its buffer must not cause another error when Python ends.
        sys.stdout = open(os.devnull, "w", encoding="utf-8")
        if isinstance(error, BrokenPipeError):
            # The reader, such as `head`, has ended; the work is complete and keeps its exit code.
            return
        raise OutputFailed(error.strerror or str(error)) from error


def print_json(document: Mapping[str, Any]) -> None:
    """Print the only document on stdout; NaN is an error in the program, not a value."""
    _print(json.dumps(document, indent=1, allow_nan=False, ensure_ascii=True))


def error_document(error: TvsError) -> dict[str, Any]:
    """The JSON document of an error."""
    fields: dict[str, Any] = {"code": error.code, "file": error.file, "line": error.line, "column": error.column}
    fields |= {"message": error.message, "found": error.found, "allowed": error.allowed, "remedy": error.remedy}
    if isinstance(error, Question):
        answers = zip(error.candidates, error.commands, strict=False)
        fields["candidates"] = [
            {"says": answer.says, "command": command, "first": {k: list(v) for k, v in answer.first.items()}}
            for answer, command in answers
        ]
    return {"error": fields}


def is_interactive() -> bool:
    """Whether standard input is a terminal; a closed standard input (`<&-`) is None."""
    return sys.stdin is not None and sys.stdin.isatty()


def report_error(error: TvsError) -> None:
    """Print an error for people, with the remedy where the message does not contain it."""
    report_line(f"error: {error.message}")
    if error.remedy and error.remedy not in error.message:
        report_line(f"what to do: {error.remedy}")


def finish(document: Mapping[str, Any], text: str, as_json: bool, error: TvsError | None = None) -> None:
    """Print a result as text or JSON; a result that must not be used has an error, which sets the exit code."""
    if as_json:
        print_json(document if error is None else {**document, **error_document(error)})
    else:
        _print(text)
    if error is not None:
        if not as_json:
            report_error(error)
        raise Ended(error.exit_code)


def print_part(text: str, as_json: bool) -> None:
    """Print a part of a longer command's text at once; with --json it is part of the document at the end."""
    if not as_json:
        _print(f"{text}\n")


def command_line(*words: object) -> str:
    """The text of a command, its words quoted where a shell needs it."""
    return "tvsbayes " + " ".join(typed(word, 400) for word in words)


def write_files(to: Path, files: Mapping[str, bytes]) -> list[str]:
    """Write files by name into a folder; returns their paths."""
    for name, data in files.items():
        write_atomically(to / name, data)
    return [str(to / name) for name in files]


CAMERAS = ("stereo.json",)
"""Files that the folder of a new campaign may contain: cameras are often calibrated before."""


def write_new(out: Path, files: Mapping[str, bytes], next_steps: str, as_json: bool) -> None:
    """Write the files of an empty campaign into a new folder, and print them with the next steps."""
    write_folder(out, files, but=CAMERAS)
    text = f"{escaped(str(out), 200)}: {', '.join(files)}\nnext: {next_steps}"
    finish({"campaign": str(out), "files": list(files)}, text, as_json)


def keep(document: Mapping[str, Any], path: Path) -> bool:
    """Write a document for a later report; a folder that cannot be written gives only a warning."""
    try:
        make_folder(path.parent)
        write_atomically(path, json.dumps(document, indent=1, allow_nan=False).encode())
    except InputError as error:
        report_line(f"warning: not kept for the report: {error.message}")
        return False
    return True


def finish_kept(document: Mapping[str, Any], text: str, path: Path, as_json: bool) -> None:
    """Print a result that is kept for a later report, with its file."""
    files: dict[str, str] = {}
    if keep(document, path):
        files, text = {path.stem: str(path)}, f"{text}\nwritten: {path}"
    finish({**document, "files": files}, text, as_json)


PARTS = ("campaign.toml", "stereo.json", "moves.csv", "spots.csv", "readings.csv", "log.jsonl")
"""Files of a campaign of a scanner or an axis, and its journal."""


def is_part(path: Path) -> bool:
    """Whether a file is a part of a campaign in its folder, or one of its pictures."""
    is_picture = path.parent.name == "frames"
    folder = path.parent.parent if is_picture else path.parent
    return (is_picture or path.name in PARTS) and path.is_file() and (folder / PARTS[0]).is_file()


def refuse_options(reason: str, remedy: str, **given: object) -> None:
    """Refuse options that this use of a command would ignore; None and False are options not given."""
    names = [option_of(name) for name, value in given.items() if value is not None and value is not False]
    if names:
        raise InputError("usage", f"{' and '.join(names)} {'are' if len(names) > 1 else 'is'} {reason}", remedy=remedy)


def check_word(option: str, given: str | None, allowed: Collection[str], remedy: str) -> None:
    """Refuse a word that an option does not take; None is an option not given."""
    if given is not None and given not in allowed:
        names = ", ".join(allowed)
        raise InputError("usage", f"{option} {escaped(given)}; allowed: {names}", allowed=names, remedy=remedy)


def missing_options(**given: object) -> list[str]:
    """The options that are not given."""
    return [option_of(name) for name, value in given.items() if value is None]


def option_of(name: str) -> str:
    """The option of a parameter: `--pan-steps` of pan_steps."""
    return f"--{name.replace('_', '-')}"


def check_order(rig: Path, plan: Path) -> None:
    """Refuse a rig file and a plan in swapped order."""
    if rig.suffix.lower() == ".csv" and plan.suffix.lower() == ".toml":
        swapped = f"{escaped(str(plan), 200)} {escaped(str(rig), 200)}"
        message = "the plan is given in place of the rig file: they are swapped"
        raise InputError("usage", message, allowed="RIG PLAN", remedy=f"write {swapped}")


def check_output(out: Path | None, *inputs: Path | None, kind: str = "", force: bool = False) -> None:
    """Refuse an output before the work: without a folder, or in the place of what may be somebody's only copy.

    Args:
        out: the file; None for none.
        inputs: files that the command reads, never replaced; nor are parts of a campaign.
        kind: one of `own_outputs.KINDS`: any other file is replaced only with `force`.
        force: option --force.
    """
    if out is None:
        refuse_options("for an output", "name one with -o, or leave it out", force=force)
        return
    name = escaped(str(out), 200)
    if not out.parent.is_dir():
        found, remedy = "no such folder", "make the folder, or name another place"
        raise refusal("write", file=name, found=found, allowed="a writable folder with free space", remedy=remedy)
    is_input = out.is_file() and any(path is not None and path.is_file() and path.samefile(out) for path in inputs)
    if is_input or is_part(out):
        replaced = "a file that is read" if is_input else "data of the campaign in that folder"
        message = f"-o {name} would replace {replaced}"
        raise InputError("usage", message, found=name, allowed="another file", remedy="name another file")
    require_writable(out.parent)
    if kind and not force:
        require_own(out, kind)


def finite(**values: float | None) -> None:
    """Refuse NaN and infinity, which option parsing accepts."""
    for name, value in values.items():
        if value is not None and not math.isfinite(value):
            option, allowed, remedy = option_of(name), "a finite number", "write a decimal number"
            raise InputError("number", f"{option} is {value}", column=option, allowed=allowed, remedy=remedy)
