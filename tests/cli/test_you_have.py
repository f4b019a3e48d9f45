"""The page of foreign files shows the output of the commands."""

from __future__ import annotations

import pytest

from experiments.inputs.you_have import FILES, PAGE, SAMPLES, sections, shown

TEXT = PAGE.read_text(encoding="utf-8")
BEGUN = {title: SAMPLES.split(part)[0] for title, part in sections(TEXT).items() if title}
"""Up to the first command that samples: its last digits may differ with the versions of libraries."""
QUICK = [title for title, part in BEGUN.items() if "$ tvsbayes" in part and title != "A lab book and its pictures"]
"""Whose files need no rendered pictures either."""


@pytest.mark.parametrize("title", QUICK)
def test_output_of_quick_commands_is_that_of_the_page(title, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert shown(title, BEGUN[title]) == BEGUN[title]


def test_the_page_has_every_kind_and_no_refusal_but_that_of_the_board():
    assert list(BEGUN) == list(FILES) and len(QUICK) == len(FILES) - 3
    refused = [line for line in TEXT.splitlines() if line.startswith("error:")]
    assert len(refused) == 1 and "6x4 inner corners are seen" in refused[0]
