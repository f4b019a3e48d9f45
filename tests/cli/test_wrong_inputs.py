"""Mistakes of new users: each is named, with a remedy."""

from __future__ import annotations

import shutil

import pytest
from support.commands import DATA, PAPER_TWIN
from support.wrong_inputs import SPOILT


@pytest.mark.parametrize("name", SPOILT)
def test_the_remedy_fits_the_mistake(say, tmp_path, name):
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
