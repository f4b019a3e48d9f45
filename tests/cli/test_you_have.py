"""The page of foreign files shows the output of the commands."""

from __future__ import annotations

from pathlib import Path

import pytest

from experiments.inputs.you_have import KINDS, Kind

PAGE = Path(__file__).parents[2] / "data" / "docs" / "you-have.md"
QUICK = [kind for kind in KINDS if kind.commands[0].quick]


@pytest.mark.parametrize("kind", QUICK, ids=lambda kind: kind.title)
def test_output_of_quick_commands_is_that_of_the_page(kind: Kind, tmp_path, monkeypatch):
    """Up to the first command that samples: its last digits may differ with the versions of libraries."""
    monkeypatch.chdir(tmp_path)
    part = PAGE.read_text(encoding="utf-8").split(f"\n## {kind.title}\n")[1].split("\n## ")[0]
    blocks = list(kind.blocks(quick=True))
    assert len(blocks) >= 1
    for block in blocks:
        assert block in part


def test_the_page_has_every_kind_and_no_refusal_but_that_of_the_board():
    text = PAGE.read_text(encoding="utf-8")
    assert [line[3:] for line in text.splitlines() if line.startswith("## ")] == [kind.title for kind in KINDS]
    refused = [line for line in text.splitlines() if line.startswith("error:")]
    assert len(refused) == 1 and "6x4 inner corners are seen" in refused[0]
    assert len(QUICK) == len(KINDS) - 3
