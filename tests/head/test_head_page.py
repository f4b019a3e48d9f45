"""The page on heads: its commands from a URDF to `verify` print the output on the page."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import pytest
from support.commands import caching_in
from support.printed_pages import follow, shown

PAGE = Path(__file__).resolve().parents[2] / "data" / "docs" / "head.md"


@pytest.mark.slow
def test_commands_from_a_urdf_to_verify_print_the_output_of_the_page(tmp_path, monkeypatch, capsys):
    part = PAGE.read_text(encoding="utf-8").split("\n## From a URDF to `verify`\n")[1].split("\n## ")[0]
    blocks = re.findall(r"```(\w+)\n(.*?)```", part, flags=re.DOTALL)
    assert {kind for kind, _ in blocks} == {"xml", "console", "sh"}
    with caching_in(tmp_path / "cache"):
        for kind, block in blocks:
            if kind == "xml":
                (tmp_path / "unit.urdf").write_text(block, encoding="utf-8")
            elif kind == "sh":
                command, *files, folder = shlex.split(block)
                assert command == "cp"
                for file in files:
                    shutil.copy(tmp_path / file, tmp_path / folder)
            else:
                follow(shown(f"```console\n{block}```"), tmp_path, monkeypatch, capsys)
