"""What `import` prints and writes for every sample, frozen.

`pytest -n0 tests/importing --snapshot-update` freezes it anew. A difference is no failure of the importer by
itself: it shows what moves, and the change that moves it says why.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
from pathlib import Path

import pytest
from importing.samples import KEYS, sample

from tvsbayes.cli.main import run

ROWS = 12
"""Of a table that are kept as they are; the hash has the others."""
TEMPLATES = {"axis": ("--axis",), "head": ("--mechanism", "pan-tilt", "--sightings"), "scanner": ()}


@pytest.fixture(scope="module")
def template_lines(tmp_path_factory) -> set[str]:
    """Lines of the files that `new` writes."""
    folder = tmp_path_factory.mktemp("templates")
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        for name, words in TEMPLATES.items():
            assert run(["new", str(folder / name), *words]) == 0
    return {line for file in folder.glob("*/*.toml") for line in file.read_text(encoding="utf-8").splitlines()}


def shown(file: Path, template_lines: set[str]) -> str:
    """A written file: of a table the first rows, their number and a hash, of TOML what `new` does not write."""
    data = file.read_bytes()
    rows = data.decode().splitlines()
    if file.suffix == ".csv":
        digest = hashlib.sha256(data).hexdigest()[:12]
        return "\n".join([f"--- {file.name}: {len(rows) - 1} rows, {digest}", *rows[: ROWS + 1]])
    return "\n".join([f"--- {file.name}", *(row for row in rows if row not in template_lines)])


@pytest.mark.parametrize("key", KEYS)
def test_import_prints_and_writes_what_it_did(key, say, tmp_path, monkeypatch, template_lines, snapshot):
    name, content, words = sample(key)
    (tmp_path / name).write_bytes(content.encode() if isinstance(content, str) else content)
    monkeypatch.chdir(tmp_path)
    try:
        code, *texts = say("import", name, *words, "--to", "out", "--yes")
    except Exception as error:
        # A defect, frozen as the others.
        code, texts = type(error).__name__, []
    text = "\n".join([f"$ tvsbayes import {name} {' '.join(words)}: exit {code}", *texts])
    files = sorted(path for path in Path("out").rglob("*") if path.is_file()) if Path("out").is_dir() else []
    text = "\n".join([text.replace(str(tmp_path), "TMP").rstrip(), *(shown(file, template_lines) for file in files)])
    assert text == snapshot
