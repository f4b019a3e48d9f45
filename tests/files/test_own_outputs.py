"""Outputs in the place of files: only what tvsbayes wrote as this kind is replaced, all else with --force alone."""

from __future__ import annotations

import os
import shutil

import pytest
from support.compensated import results

from tvsbayes.errors import InputError
from tvsbayes.files.own_outputs import PDF_MARK, require_own
from tvsbayes.single_axis.axis_campaign import write_axis
from tvsbayes.single_axis.axis_record import keep_fit

NOTES = "my notes of tvsbayes, the only copy\n"


def test_an_empty_file_and_a_missing_one_may_be_written(tmp_path):
    (tmp_path / "empty").touch()
    require_own(tmp_path / "empty", "plan")
    require_own(tmp_path / "missing", "plan")


@pytest.mark.parametrize("found", ["notes", "other kind", "folder", "pipe"])
def test_anything_else_is_refused(tmp_path, found):
    path = tmp_path / "out"
    if found == "folder":
        path.mkdir()
    elif found == "pipe":
        os.mkfifo(path)
    else:
        plan = b"step,action,pan_steps,tilt_steps,target,experiment,point\n"
        path.write_bytes(NOTES.encode() if found == "notes" else plan)
    with pytest.raises(InputError, match="would be replaced: a f") as refused:
        require_own(path, "report")
    assert (refused.value.code, refused.value.exit_code) == ("occupied", 2) and "--force" in refused.value.remedy


def test_a_long_pdf_is_known_by_its_end(tmp_path):
    (tmp_path / "r.pdf").write_bytes(b"%PDF-1.4\n" + bytes(20_000) + b"%%EOF" + PDF_MARK)
    require_own(tmp_path / "r.pdf", "printed report")
    (tmp_path / "r.pdf").write_bytes(b"%PDF-1.4\n" + bytes(20_000) + b"%%EOF")
    with pytest.raises(InputError):
        require_own(tmp_path / "r.pdf", "printed report")


@pytest.fixture(scope="module")
def axis(tmp_path_factory):
    """An axis with its fit."""
    folder = tmp_path_factory.mktemp("axis") / "stage"
    write_axis(results().fit.campaign, folder)
    keep_fit(results().fit, results().summary, folder / "results")
    return folder


def check_kept(ask, say, command, out):
    """Refused in the place of notes, written there with --force, written again; what that says."""
    out.write_text(NOTES)
    code, document = ask(*command, "-o", out)
    assert (code, document["error"]["code"]) == (2, "occupied") and out.read_text() == NOTES
    assert "my notes" in document["error"]["found"]
    assert ask(*command, "-o", out, "--force")[0] == 0
    whole = out.read_bytes()
    code, _, err = say(*command, "-o", out)
    assert code == 0 and out.read_bytes()[:200] == whole[:200]
    return err


@pytest.mark.thorough
def test_a_table_replaces_tables_only_and_names_the_promise_that_ends(ask, say, axis, tmp_path):
    folder, out = shutil.copytree(axis, tmp_path / "stage"), tmp_path / "table"
    assert "promise" not in check_kept(ask, say, ("compensate", folder, "--to", "csv"), out), "the same table"
    _, _, err = say("compensate", folder, "--to", "linuxcnc", "-o", out)
    assert "the promise of the table made before (--to csv" in err and "ends" in err


def test_the_file_beside_a_table_is_kept_too(ask, axis, tmp_path):
    beside = tmp_path / "stage.xacro.yaml"
    beside.write_text(NOTES)
    code, _ = ask("compensate", axis, "--to", "urdf", "-o", tmp_path / "stage.xacro")
    assert code == 2 and beside.read_text() == NOTES and not (tmp_path / "stage.xacro").exists()


def test_a_page_replaces_pages_only(ask, say, axis, tmp_path, no_pictures):
    check_kept(ask, say, ("report", axis), tmp_path / "page.html")


@pytest.mark.parametrize("command", ["compensate --to csv", "plan --given", "report"])
def test_force_without_an_output_is_refused(ask, axis, command):
    name, *rest = command.split()
    words = (name, *rest, axis) if name == "plan" else (name, axis, *rest)
    code, document = ask(*words, "--force")
    assert code == 2 and "--force" in document["error"]["message"]
