"""What all commands share."""

from __future__ import annotations

import json

import pytest

from tvsbayes.cli.app import keep

pytestmark = pytest.mark.usefixtures("own_compilation_cache")


def test_what_cannot_be_kept_costs_nobody_the_result(tmp_path, capsys):
    (tmp_path / "results").write_text("a file where the folder should be")
    assert not keep({}, tmp_path / "results" / "compare.json")
    assert "warning: not kept" in capsys.readouterr().err
    assert keep({"a": 1}, tmp_path / "new" / "compare.json")
    assert json.loads((tmp_path / "new" / "compare.json").read_text()) == {"a": 1}
