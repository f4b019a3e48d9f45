"""Campaign files beside a journal: written after every look, kept where the user edited them."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pytest
from support.bench_runs import HEADER, Run, ctrl_c, small_plan

from tvsbayes.acquisition.journal import EMPTY_REMEDY, LOG
from tvsbayes.acquisition.journal_check import behind_journal
from tvsbayes.acquisition.session import begin
from tvsbayes.cli.main import run
from tvsbayes.errors import InputError
from tvsbayes.instrument.campaign import read_campaign

pytestmark = pytest.mark.usefixtures("ctrl_c_works")


@pytest.fixture(scope="module")
def eight_looks(mounted_rig, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("eight") / "c"
    Run(mounted_rig, folder).engine.run()
    return folder


@pytest.fixture
def finished(eight_looks, tmp_path) -> Path:
    """A folder of its own of a run of eight looks that is done."""
    return Path(shutil.copytree(eight_looks, tmp_path / "c"))


@pytest.mark.parametrize("refusals", [3, 10_000])
def test_a_table_open_in_another_program_does_not_end_the_run(mounted_rig, tmp_path, monkeypatch, refusals):
    """On Windows `os.replace` refuses while a spreadsheet holds spots.csv; the journal has the look already."""
    replace_, left = os.replace, [refusals]

    def held(source, destination):
        if Path(destination).name == "spots.csv" and left[0] > 0:
            left[0] -= 1
            raise PermissionError(13, "The process cannot access the file")
        replace_(source, destination)

    monkeypatch.setattr(os, "replace", held)
    outcome = Run(mounted_rig, tmp_path / "c").engine.run()
    assert (outcome.reason, outcome.looks) == ("done", 8)
    assert [text for text in outcome.warnings if "behind the journal" in text] == list(outcome.warnings)
    assert len(outcome.warnings) == (refusals > 8)
    if not outcome.warnings:
        assert len(read_campaign(tmp_path / "c").spots) == 8


def test_what_was_edited_since_is_kept_beside(mounted_rig, tmp_path):
    """A refused spot, and a prior stated in campaign.toml: resuming writes these files again."""
    Run(mounted_rig, tmp_path / "c", at=3, then=ctrl_c).engine.run()
    spots, header = tmp_path / "c" / "spots.csv", tmp_path / "c" / "campaign.toml"
    edited = spots.read_text().replace(",ok", ",dust", 1)
    assert edited != spots.read_text()
    spots.write_text(edited)
    stated = header.read_text() + "\n# mirror looked at on Monday\n"
    header.write_text(stated)
    outcome = Run(mounted_rig, tmp_path / "c", resume=True, start=1).engine.run()
    assert (tmp_path / "c" / "spots.edited-1.csv").read_text() == edited
    assert (tmp_path / "c" / "campaign.edited-1.toml").read_text() == stated
    named = [w.split(" was")[0] for w in outcome.warnings if "edited" in w]
    assert sorted(named) == ["campaign.toml", "spots.csv"]
    assert not list((tmp_path / "c").glob("moves.edited*"))
    again = Run(mounted_rig, tmp_path / "c", resume=True, start=2).engine.run()
    assert (
        not any("edited" in warning for warning in again.warnings)
        and len(list((tmp_path / "c").glob("*.edited-*"))) == 2
    )


@pytest.mark.parametrize("kept", ["half", "created"])
def test_a_journal_that_lost_its_end_is_told_from_tables_behind(mounted_rig, finished, capsys, kept):
    """Rows that only the tables have are lost looks, not edits; they are kept."""
    folder = finished
    before = {name: (folder / name).read_bytes() for name in ("moves.csv", "spots.csv")}
    lines = (folder / LOG).read_bytes().splitlines(keepends=True)
    (folder / LOG).write_bytes(b"".join(lines[: len(lines) // 2 if kept == "half" else 1]))
    assert run(["check", str(folder), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    looks = document["journal"]["looks"] if kept == "half" else 0
    lost = [warning for warning in document["warnings"] if "lost looks" in warning]
    assert len(lost) == 1 and f"{8 - looks} looks" in lost[0] and "-" not in lost[0].split(" looks and ")[0][-5:]
    assert not any("behind the journal" in warning for warning in document["warnings"])
    outcome = Run(mounted_rig, folder, resume=True, start=1).engine.run()
    assert outcome.reason == "done" and sum(s.experiment is not None for s in read_campaign(folder).spots) == 8
    assert not any("edited" in warning for warning in outcome.warnings) and not list(folder.glob("*.edited-*"))
    assert sum("lost its end" in warning for warning in outcome.warnings) == 2
    copies = {name: (folder / name.replace(".csv", ".longer-1.csv")).read_bytes() for name in before}
    assert copies == before


def test_tables_that_lack_a_look_of_the_journal_say_which(finished, capsys):
    """As a killed run leaves them: `classic` and `fit` use the tables."""
    folder = finished
    assert behind_journal(folder, read_campaign(folder)) == ""
    lines = (folder / "spots.csv").read_bytes().splitlines(keepends=True)
    (folder / "spots.csv").write_bytes(b"".join(lines[:-1]))
    assert run(["classic", str(folder)]) == 0
    assert "warning: spots.csv lacks look 7, which log.jsonl holds" in " ".join(capsys.readouterr().err.split())
    (folder / LOG).write_bytes(b"damaged\n")
    assert behind_journal(folder, read_campaign(folder)) == "", "what is wrong with a journal is reported by check"


def test_what_a_killed_run_left_unfinished_is_removed_at_its_resume(mounted_rig, tmp_path):
    folder = tmp_path / "c"
    Run(mounted_rig, folder, at=3, then=ctrl_c).engine.run()
    (folder / "frames").mkdir()
    unfinished = [folder / ".moves.csv.0123456789ab.tmp", folder / ".campaign.toml.ba9876543210.tmp"]
    unfinished += [folder / "frames" / ".000004_left.png.tmp"]
    others = [folder / ".notes.csv.0123456789ab.tmp", folder / ".moves.csv.mine.tmp"]
    for path in unfinished + others:
        path.write_bytes(b"half")
    Run(mounted_rig, folder, resume=True, start=1).engine.run()
    assert not any(path.exists() for path in unfinished) and all(path.exists() for path in others)


def test_an_empty_journal_has_one_remedy(mounted_rig, tmp_path, capsys):
    """`check`, --resume and a new beginning all say the same."""
    folder = tmp_path / "c"
    folder.mkdir()
    (folder / LOG).write_bytes(b"")
    assert run(["check", str(folder), "--json"]) == 0
    warnings = [warning for warning in json.loads(capsys.readouterr().out)["warnings"] if "no event" in warning]
    assert len(warnings) == 1 and EMPTY_REMEDY in warnings[0]
    for resume in (True, False):
        with pytest.raises(InputError) as caught:
            begin(folder, mounted_rig, small_plan(), resume, HEADER)
        assert caught.value.remedy == EMPTY_REMEDY


def test_a_missing_homing_is_reported(mounted_rig, tmp_path, capsys):
    begin(tmp_path / "c", mounted_rig, small_plan(), False, HEADER).close()
    assert run(["check", str(tmp_path / "c"), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["kind"] == "journal" and "no homing" in document["warnings"][-1]
