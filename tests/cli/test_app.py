"""What all commands share."""

from __future__ import annotations

import json

import pytest

from tvsbayes.cli.app import keep, report_removed

pytestmark = pytest.mark.usefixtures("own_compilation_cache")


def test_what_cannot_be_kept_costs_nobody_the_result(tmp_path, capsys):
    (tmp_path / "results").write_text("a file where the folder should be")
    assert not keep({}, tmp_path / "results" / "compare.json")
    assert "warning: not kept" in capsys.readouterr().err
    assert keep({"a": 1}, tmp_path / "new" / "compare.json")
    assert json.loads((tmp_path / "new" / "compare.json").read_text()) == {"a": 1}


def test_what_makes_a_removed_file_again_is_what_there_is(capsys):
    """`calibrate` has no --dcc, and an axis no certificate."""
    report_removed(["report.pdf", "dcc.xml"], {"report": "r/report.html"})
    assert "removed: report.pdf, dcc.xml" in (told := capsys.readouterr().err)
    assert "`tvsbayes report --pdf` or `--dcc`" in told
    report_removed(["report.pdf"], {}, certificates=False)
    assert "`tvsbayes report --pdf`" in (told := capsys.readouterr().err) and "--dcc" not in told
    report_removed(["report.pdf"], {"pdf": "r/report.pdf"})
    assert not capsys.readouterr().err
