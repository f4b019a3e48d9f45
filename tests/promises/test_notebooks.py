"""The notebooks are executed, small and free of machine paths; their cells run unchanged."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "data" / "docs" / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
BYTES_MAX = 150_000
MACHINE = re.compile(r"/(?:home|root|tmp|work|Users|mnt)/|[A-Z]:\\\\")
"""Start of an absolute path of a machine."""


def cells(path: Path, kind: str) -> list[dict]:
    return [cell for cell in json.loads(path.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == kind]


def code_of(path: Path) -> str:
    """Code of the cells, without the commands of the notebook itself."""
    source = "\n".join("".join(cell["source"]) for cell in cells(path, "code"))
    return "\n".join(line for line in source.splitlines() if not line.startswith("%"))


def test_there_are_two_and_the_documents_link_them():
    assert [path.stem for path in NOTEBOOKS] == ["first_calibration", "own_data"]
    text = (ROOT / "data" / "docs" / "python.md").read_text(encoding="utf-8")
    assert all(f"(notebooks/{path.name})" in text for path in NOTEBOOKS)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_are_executed_small_and_free_of_machine_paths(path):
    text = path.read_text(encoding="utf-8")
    assert len(text) < BYTES_MAX and not MACHINE.search(text)
    code = cells(path, "code")
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    outputs = [output for cell in code for output in cell["outputs"]]
    assert outputs and not [
        each for each in outputs if each["output_type"] in ("error", "stream") and "text" not in each
    ]
    assert not [each for each in outputs if each.get("name") == "stderr"]
    assert any("image/png" in each.get("data", {}) for each in outputs)
    # Results show themselves as tables.
    assert sum("text/html" in each.get("data", {}) for each in outputs) >= 4
    compile(code_of(path), path.name, "exec")


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_run_unchanged(path, tmp_path, monkeypatch):
    pytest.importorskip("pandas")
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(compile(code_of(path), path.name, "exec"), names)
    assert "tvsbayes" in names
