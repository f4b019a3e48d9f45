"""The C header of a calibration in a program of its own."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterable, Sequence
from pathlib import Path

import pytest

needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler here")
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-pedantic")


def answers_of_header(folder: Path, header: str, program: str, requests: Iterable[Sequence[float]]) -> list[str]:
    """What a program with `tvs_calibration.h` prints, a line for each line of numbers that it reads."""
    (folder / "tvs_calibration.h").write_text(header)
    (folder / "main.c").write_text(program)
    subprocess.run(["cc", *STRICT, "main.c", "-o", "main", "-lm"], cwd=folder, check=True)
    text = "".join(" ".join(map(repr, row)) + "\n" for row in requests)
    done = subprocess.run([folder / "main"], input=text, capture_output=True, text=True, check=True)
    return done.stdout.splitlines()
