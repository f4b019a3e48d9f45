"""Functions shared by all commands."""

from __future__ import annotations

import json

import pytest

from tvsbayes.cli.app import keep

pytestmark = pytest.mark.usefixtures("own_compilation_cache")


def test_a_cache_that_cannot_be_written_does_not_stop_the_result(tmp_path, capsys):
    (tmp_path / "results").write_text("a file where the folder should be")
    assert not keep({}, tmp_path / "results" / "compare.json")
    assert "warning: not kept" in capsys.readouterr().err
    assert keep({"a": 1}, tmp_path / "new" / "compare.json")
    assert json.loads((tmp_path / "new" / "compare.json").read_text()) == {"a": 1}
