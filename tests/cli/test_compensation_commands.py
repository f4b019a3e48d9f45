"""compensate, verify and plan --verify: files, documents by their schemas, exit codes, refusals."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import jsonschema
import numpy as np
import pytest
from support.commands import assert_error
from support.compensated import driven, results, to_and_fro, true_axis
from support.fit_documents import shipped_schema

from tvsbayes.compensation.correction import Correction
from tvsbayes.compensation.verification import stored_compensation
from tvsbayes.single_axis.axis_campaign import read_axis, write_axis
from tvsbayes.single_axis.axis_record import keep_fit


@pytest.fixture
def folder(tmp_path):
    """An axis with its fit."""
    write_axis(replace(results().fit.campaign, path=None), tmp_path / "stage")
    keep_fit(results().fit, results().summary, tmp_path / "stage" / "results")
    return tmp_path / "stage"


def drive(folder, place, factors):
    """Fresh readings under the table in a folder's results."""
    commands, read = to_and_fro(np.array([-15.0, -7.0, 1.0, 6.0, 12.0, 18.0]))
    by = Correction.of(stored_compensation(read_axis(folder)))
    write_axis(driven(true_axis(), commands, read, 7, by=by, factors=factors), place)
    return place


def test_from_a_fit_to_a_verified_machine(ask, say, folder, tmp_path, no_pictures):
    out = tmp_path / "stage.comp"
    code, document = ask("compensate", folder, "--to", "linuxcnc", "-o", out, "--applied-by", "host")
    assert code == 0 and document["applied_by"] == "host" and out.read_text().startswith("-20.0000000")
    kept = json.loads((folder / "results" / "compensation.json").read_text())
    schema = shipped_schema("compensation-1")
    jsonschema.validate(kept, schema)
    # Without temperatures there is no range of them.
    assert {*kept, "kelvin"} == set(schema["properties"]) and kept["table"] == document["table"]

    code, planned = ask("plan", folder, "--verify", "-o", tmp_path / "plan.csv")
    assert code == 0 and planned["enough"]
    assert (tmp_path / "plan.csv").read_text().startswith("step,command,direction,read")

    code, document = ask("verify", folder, drive(folder, tmp_path / "kept", (1.0, 1.0)))
    jsonschema.validate(document, shipped_schema("verification-1"))
    assert set(document) == {"verdict", "p", "worlds", "before", "after", "promised95", "readings"}
    assert (code, document["verdict"]) == (0, "KEPT")
    code, _, _ = say("report", folder)
    shown = (folder / "results" / "report.html").read_text()
    assert "Applied correction and remaining error" in shown and "KEPT: 12 fresh readings" in shown

    code, text, _ = say("verify", folder, drive(folder, tmp_path / "turned", (-1.0, -1.0)))
    assert code == 1 and text.startswith("BROKEN: wrong sign") and "what to do" in text
    ask("compensate", folder, "--to", "csv", "-o", tmp_path / "stage.csv")
    say("report", folder)
    assert "No fresh readings have verified it" in (folder / "results" / "report.html").read_text()


def test_a_second_file_stands_beside_the_first(ask, folder, tmp_path):
    code, document = ask("compensate", folder, "--to", "urdf", "-o", tmp_path / "stage.xacro")
    beside = tmp_path / "stage.xacro.yaml"
    assert code == 0 and document["files"]["yaml"] == str(beside) and "covariance:" in beside.read_text()


def test_without_a_file_nothing_is_written(say, folder):
    code, text, _ = say("compensate", folder, "--to", "csv")
    assert code == 0 and "nothing written" in text and "command,forward,backward" in text
    assert not (folder / "results" / "compensation.json").exists()
    code, _, err = say("verify", folder, folder)
    assert code == 2 and "tvsbayes compensate" in err


def test_too_few_readings_give_no_verdict(ask, folder, tmp_path):
    ask("compensate", folder, "--to", "csv", "-o", tmp_path / "stage.csv")
    fresh = read_axis(drive(folder, tmp_path / "many", (1.0, 1.0)))
    few = replace(fresh, readings=tuple(replace(r, u=0.5) for r in fresh.readings[:3]))
    write_axis(few, tmp_path / "few")
    code, document = ask("verify", folder, tmp_path / "few")
    assert code == 3 and document["verdict"] == "CANNOT TELL"
    code, document = ask("verify", folder, folder)
    assert code == 2
    assert_error(document, "same-looks")


@pytest.mark.thorough
def test_a_promise_is_tied_to_its_table(ask, say, folder, tmp_path):
    """A second table leaves the first in force, one in its place ends it, a file of 0.3.0 is known by its numbers."""
    first, second = tmp_path / "one.comp", tmp_path / "two.csv"
    ask("compensate", folder, "--to", "linuxcnc", "-o", first)
    fresh = drive(folder, tmp_path / "fresh", (1.0, 1.0))
    code, _, err = say("compensate", folder, "--to", "csv", "-o", second, "--per-command", "1.01")
    assert code == 0 and "stays" in err
    # Alone, the readings are held against the last table, which aims at another ratio.
    code, document = ask("verify", folder, fresh)
    assert (code, document["verdict"]) == (1, "BROKEN")
    for remarks in (first.read_text(), "\n".join(line for line in first.read_text().splitlines() if line[0] != "#")):
        (tmp_path / "table").write_text(remarks)
        code, document = ask("verify", folder, fresh, "--table", tmp_path / "table")
        assert (code, document["verdict"]) == (0, "KEPT")
    (tmp_path / "table").write_text(re.sub("table [0-9a-f]{16}", "table 0123456789abcdef", second.read_text()))
    code, document = ask("verify", folder, fresh, "--table", tmp_path / "table")
    assert code == 2
    assert_error(document, "other-table")
    code, _, err = say("compensate", folder, "--to", "csv", "-o", second)
    assert code == 0 and "ends: its file is replaced" in err
