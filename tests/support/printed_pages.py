"""Pages that show commands with what they print: commands found, run, and compared with the page."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from tvsbayes.cli.main import run

NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e-?\d+)?")
ANYTHING = "..."
"""A printed line of dots stands for lines that the page leaves out."""


@dataclass(frozen=True)
class Shown:
    """A command of the page and the output that the page states."""

    arguments: tuple[str, ...]
    printed: str


def shown(text: str) -> list[Shown]:
    """Every `$ tvsbayes ...` of the page in order, long lines joined at their backslashes."""
    commands = []
    for block in re.findall(r"```console\n(.*?)```", text, flags=re.DOTALL):
        for part in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]:
            command, printed = part.replace("\\\n", "").split("\n", 1)
            words = [word.strip("'") for word in re.findall(r"'[^']*'|\S+", command)]
            assert words[0] == "tvsbayes", command
            commands.append(Shown(tuple(words[1:]), printed))
    return commands


def same(line: str, expected: str) -> bool:
    """Words equal, each number within one unit of its last printed digit: another processor rounds otherwise.

    A share of draws with its Monte Carlo error (`52 +- 3.5 %`) is within that error: draws near a limit may cross it.
    """
    if NUMBER.sub("#", " ".join(line.split())) != NUMBER.sub("#", " ".join(expected.split())):
        return False
    pairs = zip(NUMBER.findall(line), NUMBER.finditer(expected), strict=True)
    for number, wanted in pairs:
        digits, _, exponent = wanted[0].partition("e")
        unit = 10.0 ** (int(exponent or 0) - len(digits.partition(".")[2]))
        error = re.match(rf" \+- ({NUMBER.pattern})", expected[wanted.end() :])
        # Half a unit for the binary fractions of the digits themselves.
        if abs(float(number) - float(wanted[0])) > max(1.5 * unit, float(error[1]) if error else 0.0):
            return False
    return True


def first_difference(printed: str, expected: str) -> str | None:
    """The first line of the page that the command did not print in its place, or None."""
    lines, at, free = printed.rstrip("\n").splitlines(), 0, False
    for wanted in expected.rstrip("\n").splitlines():
        if wanted == ANYTHING:
            free = True
            continue
        places = range(at, len(lines)) if free else range(at, min(at + 1, len(lines)))
        place = next((k for k in places if same(lines[k], wanted)), None)
        if place is None:
            return f"page: {wanted!r}, printed: {lines[at] if at < len(lines) else None!r}"
        at, free = place + 1, False
    return None if free or at == len(lines) else f"printed, not on the page: {lines[at]!r}"


def follow(
    steps: list[Shown],
    folder: Path,
    monkeypatch,
    capsys,
    *,
    errors_too: bool = False,
    exit_codes: tuple[int, ...] = (0,),
) -> None:
    """Run commands in a folder and hold what they print against the page; `errors_too`: what goes to stderr first."""
    monkeypatch.chdir(folder)
    for step in steps:
        code = run(list(step.arguments))
        captured = capsys.readouterr()
        assert code == 0, (step.arguments, captured.err)
        printed = captured.err + captured.out if errors_too else captured.out
        assert (difference := first_difference(printed, step.printed)) is None, (step.arguments, difference)
