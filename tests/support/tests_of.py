"""Names the test files that import a module of the package: `python tests/support/tests_of.py estimators.looks`."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

if __package__ is None:
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from support.package_imports import imported


def files_importing(module: str, folder: str = "tests") -> list[str]:
    """Files below a folder, helpers of tests among them, that import it or name it in a string of code."""
    root = Path(__file__).resolve().parents[2]
    files = {path: imported(ast.parse(path.read_text(encoding="utf-8"))) for path in (root / folder).rglob("*.py")}
    return sorted(path.relative_to(root).as_posix() for path, names in files.items() if f"tvsbayes.{module}" in names)


if __name__ == "__main__":
    print("\n".join(files_importing(sys.argv[1])))
