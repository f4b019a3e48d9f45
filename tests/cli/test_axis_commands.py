"""Commands on an axis folder: documents, exit codes, refusals."""

from __future__ import annotations

import json

import jsonschema
import pytest
from support.axes import campaign, drawn, runs
from support.commands import ESTIMATE_KEYS, assert_error
from support.fit_documents import shipped_schema

from tvsbayes.single_axis.axis_campaign import write_axis
from tvsbayes.single_axis.axis_parameters import AxisPrior


@pytest.fixture
def folder(tmp_path):
    drawn(7, runs(2), backlash=AxisPrior(0.0, 0.1)).write(tmp_path / "axis")
    return tmp_path / "axis"


def test_check_reports_the_contents(ask, folder):
    code, document = ask("check", folder)
    assert code == 0
    assert (document["kind"], document["moves"], document["readings"], document["positions"]) == ("axis", 33, 33, 9)


def test_fit_and_commands_that_use_it(ask, say, folder, tmp_path):
    code, document = ask("fit", folder, "--quick")
    assert code == 0
    assert (document["estimator"], document["tier"], document["converged"]) == ("posterior", "importance", True)
    for side in ("forward", "backward"):
        assert set(document["per_command"][side]) == ESTIMATE_KEYS
        assert document["per_command"][side]["value"] == pytest.approx(0.01, rel=0.03)
    assert document["range_command"] == [-2300.0, 2300.0]
    assert {"per_command", "backlash", "transmission_error", "stop_sd.forward"} <= set(document["parameters"])
    kept = json.loads((folder / "results" / "fit.json").read_text())
    assert kept["per_command"] == document["per_command"] and set(kept["inputs"]) == {"moves", "readings", "axis"}

    schema = shipped_schema("axis-fit-1")
    jsonschema.validate(kept, schema)
    assert set(kept) == set(schema["properties"])

    code, planned = ask("plan", "--given", folder, "-o", tmp_path / "plan.csv", "--minutes", "1")
    assert code == 0 and planned["next"] and planned["next"][0]["actions"][-1] == "read"
    assert (tmp_path / "plan.csv").read_text().startswith("step,command,direction,read")
    code, output, _ = say("plan", "--given", folder, "-o", tmp_path / "none.csv", "--minutes", "0.1")
    assert code == 0 and "nothing written to" in output and not (tmp_path / "none.csv").exists()
    code, _, err = say("report", folder)
    assert code == 0 and "fitting first" not in err
    page = (folder / "results" / "report.html").read_text()
    assert "Calibration of an axis" in page and "data:image/svg+xml" in page


def test_simulate_and_new(ask, folder, tmp_path):
    code, document = ask("simulate", folder, tmp_path / "again", "--seed", "3")
    assert code == 0 and document["readings"] == 33 and (tmp_path / "again" / "truth.json").exists()
    code, document = ask("simulate", folder, folder / "moves.csv", tmp_path / "listed")
    assert code == 0 and document["moves"] == 33
    code, document = ask("new", tmp_path / "new", "--axis")
    assert code == 0 and set(document["files"]) == {"campaign.toml", "moves.csv", "readings.csv"}
    assert ask("check", tmp_path / "new")[0] == 0
    code, document = ask("fit", tmp_path / "new")
    assert code == 3 and assert_error(document, "too-few-positions")


def test_later_readings_are_compared_and_watched(ask, say, folder, tmp_path):
    later = drawn(7, runs(1), backlash=AxisPrior(0.0, 0.1))
    later.write(tmp_path / "later")
    code, document = ask("fit", folder, "--quick")
    assert code == 0 and "doubts" in document
    code, document = ask("compare", folder, tmp_path / "later")
    assert code == 0 and document["kind"] == "two calibrations"
    assert [change["quantity"] for change in document["changes"]] == ["effective_per_command", "effective_backlash"]
    code, document = ask("watch", folder, tmp_path / "later", "--append", tmp_path / "nights.csv")
    assert code == {"OK": 0, "MOVED": 1, "CANNOT TELL": 3}[document["verdict"]]
    jsonschema.validate(document, shipped_schema("watch-1"))
    assert [change["what"] for change in document["changes"]] == ["ratio", "play"]
    assert document["verdict"] in (tmp_path / "nights.csv").read_text()
    assert "new stops against the calibration" in say("watch", folder, tmp_path / "later")[1]
    code, document = ask("plan", folder, "--watch", "-o", tmp_path / "stops.csv")
    assert code == 0 and document["plan"] == str(tmp_path / "stops.csv")
    jsonschema.validate(document, shipped_schema("watch-plan-1"))
    planned = (tmp_path / "stops.csv").read_text().splitlines()
    assert sum(row.endswith(",1") for row in planned[1:]) == document["looks"] >= 4
    code, document = ask("plan", folder, "--given", folder, "--watch")
    assert code == 2 and assert_error(document, "usage")
    for command in ("compare", "watch"):
        code, document = ask(command, folder, folder)
        assert code == 2 and assert_error(document, "same-looks")
        code, document = ask(command, folder, tmp_path)
        assert code == 2 and assert_error(document, "usage")


def test_two_positions_leave_nothing_to_predict(ask, tmp_path):
    moves = runs(2, (0.0, 1000.0), 0.0)
    write_axis(campaign(moves, [0.01 * m.command for m in moves]), tmp_path / "two")
    code, document = ask("compare", tmp_path / "two")
    assert code == 3 and assert_error(document, "too-few-positions")


@pytest.mark.thorough
def test_a_sampler_without_an_answer_falls_back_to_laplace_with_a_warning(ask, folder, monkeypatch):
    """As of a scanner: exit 0 with a warning, no mode is exit 4; of a chain without time weighted draws answer."""
    code, document = ask("fit", folder, "--max-minutes", "0.01")
    assert (code, document["converged"]) == (0, True)
    assert document["monte_carlo_error"]["backlash"]["mean"] < 0.3
    monkeypatch.setattr("tvsbayes.inference.importance.ROUGH_K_MAX", -9.0)
    monkeypatch.setattr("tvsbayes.inference.importance.K_MAX", -9.0)
    monkeypatch.setattr("tvsbayes.inference.importance.ROUNDS_MAX", 4)
    code, document = ask("fit", folder, "--quick")
    assert (code, document["converged"], document["answer"]) == (0, False, "laplace")
    assert document["estimator"] == "laplace" and document["problems"][0].startswith("LAPLACE: the weights")


def test_a_drive_goes_from_its_first_reading_to_its_last(ask, say, tmp_path):
    """Its moves are only where a stretch begins; commands are no powers of ten."""
    (tmp_path / "campaign.toml").write_text('format = "tvsbayes-axis/1"\nunit = "arcsec"\nrate = 15.25\n')
    (tmp_path / "moves.csv").write_text("move,segment,time_s,command,approach\n0,0,10,152.5,forward\n")
    rows = "".join(f"{k},0,{15.25 * (10 + 5 * k) + 0.1 * (k % 3)},0.1,ok,{10 + 5 * k}\n" for k in range(300))
    (tmp_path / "readings.csv").write_text(f"reading,move,value,u,status,time_s\n{rows}")
    code, document = ask("check", tmp_path)
    low, high = document["range_command"]
    # The ends are means of a few readings.
    assert code == 0 and 152.5 <= low < 400 and 22600 < high <= 15.25 * (10 + 5 * 299)
    assert "e+0" not in say("check", tmp_path)[1]
