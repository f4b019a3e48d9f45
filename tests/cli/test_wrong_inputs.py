"""What somebody new does wrong: each mistake is called by its name, with what to do."""

from __future__ import annotations

import shutil

import pytest
from support.commands import DATA, PAPER_TWIN
from support.wrong_inputs import SPOILT


@pytest.mark.parametrize("name", SPOILT)
def test_the_remedy_hits(say, tmp_path, name):
    wrong = SPOILT[name]
    folder = tmp_path / "mine"
    shutil.copytree(PAPER_TWIN, folder)
    wrong.spoil(folder)
    command = wrong.command.replace("CAMPAIGN", str(folder)).replace("DATA", str(DATA))
    code, out, log = say(*command.split())
    printed = " ".join((out + log).split())
    assert code == wrong.code, printed
    for words in wrong.words:
        assert any(word in printed for word in words.split("|")), printed
