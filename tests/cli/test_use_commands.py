"""`locate` and `steps-for` as commands, on a campaign with drawn instead of fitted results."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.small_campaign import seen_steps, small_campaign
from support.stored_fits import store

from tvsbayes.assessment.fitted_calibration import calibration_of_draws
from tvsbayes.calibration.calibration_file import CALIBRATION_FORMAT
from tvsbayes.calibration.pointing import Calibration
from tvsbayes.errors import InputError
from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.campaign import read_campaign, write_campaign
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.pipeline import load_calibration

POINT = ("--pan-steps", 100, "--tilt-steps", 20, "--aperture-deg", 70)
RELATIVE_SD = 0.01
"""Of every parameter: small enough for all draws to meet their line of sight."""


def drawn_calibration(campaign) -> Calibration:
    """Normal draws about the default rig; mirror errors and tilts of 0.1 deg."""
    generator = np.random.default_rng(8)
    columns = []
    for name in TWO_MIRROR.names:
        value = TWO_MIRROR.priors[name].value if name in TWO_MIRROR.priors else 0.0
        value = 0.1 if name.startswith(("mirror1", "mirror2", "laser_tilt", "tilt_axis", "backlash")) else value
        sd = RELATIVE_SD * abs(value) if name.startswith(("degrees", "mirror", "laser", "backlash")) else 0.0
        columns.append(value + sd * generator.standard_normal(600))
    causes = ("pixel noise", "stereo calibration")
    calibration = calibration_of_draws(
        TWO_MIRROR.names, np.stack(columns, axis=1), campaign, "posterior", 0, seen_steps(campaign)
    )
    parts = np.stack([0.25 * calibration.covariance, 0.75 * calibration.covariance])
    return replace(calibration, causes=causes, cause_covariance=parts)


@pytest.fixture
def folder(tmp_path) -> Path:
    """A campaign folder with results that fit it."""
    folder = tmp_path / "campaign"
    write_campaign(small_campaign(), folder)
    store(folder / "results", drawn_calibration(read_campaign(folder)))
    return folder


def table_of(path: Path, *rows: str) -> Path:
    """A file of points with these rows."""
    path.write_text("\n".join(("tilt_steps,pan_steps,aperture_deg,pan_approach,tilt_approach", *rows)) + "\n")
    return path


def test_locate_one_point(ask, folder):
    code, document = ask("locate", folder, *POINT, "--pan-approach", "left", "--tilt-approach", "up")
    assert code == 0
    assert document["estimator"] == "posterior"
    assert np.shape(document["xyz_mm"]) == (3,)
    assert np.shape(document["covariance_mm2"]) == (3, 3)
    assert np.shape(document["u95_mm"]) == (3,)
    assert set(document["linear"]) >= {"xyz_mm", "covariance_mm2", "u95_mm", "digits", "validated"}
    by_hand = load_calibration(folder).locate(100, 20, 70.0)
    np.testing.assert_allclose(document["linear"]["xyz_mm"], by_hand.xyz_mm, rtol=1e-9)
    # Draws and law differ by curvature, a few hundredths of u here, and by 600 draws' noise.
    sd = np.sqrt(np.diag(document["covariance_mm2"]))
    np.testing.assert_allclose(document["xyz_mm"], by_hand.xyz_mm, atol=0.25 * sd.max())
    assert ask("locate", folder, *POINT)[1] == document
    from_right = ask("locate", folder, *POINT, "--pan-approach", "right")[1]["linear"]["xyz_mm"]
    by_hand = load_calibration(folder).locate(100, 20, 70.0, ("right", "up"))
    np.testing.assert_allclose(from_right, by_hand.xyz_mm, rtol=1e-9)
    assert from_right[0] != document["linear"]["xyz_mm"][0]


def test_counters_that_no_look_reached_are_told(ask, say, folder, tmp_path):
    """In JSON, in the text, of one point, of many, and of the counters for a target."""
    (low, high), _ = load_calibration(folder).range_steps.astype(int).tolist()
    far = ("--pan-steps", high + 1, "--tilt-steps", 20, "--aperture-deg", 70)
    assert ask("locate", folder, *POINT)[1]["extrapolated"] is False
    assert ask("locate", folder, *far)[1]["extrapolated"] is True
    rows = [f"20,{n},{deg},left,up" for n in (low - 1, low, high) for deg in (70, 175)]
    points = table_of(tmp_path / "points.csv", *rows)
    entries = ask("locate", folder, "--points", points)[1]["points"]
    assert [entry["extrapolated"] for entry in entries] == [True, True, False, False, False, False]
    assert "refused" in entries[1] and entries[0]["xyz_mm"]
    for direction, flagged in ((0.0, False), (-40.0, True)):
        command = ("steps-for", folder, "--azimuth-deg", direction, "--elevation-deg", 1.0)
        assert ask(*command)[1]["extrapolated"] is flagged
        code, text, _ = say(*command)
        assert code == 0 and ("EXTRAPOLATED" in text) is flagged
    for options, count in ((POINT, 0), (far, 2)):
        code, text, _ = say("locate", folder, *options)
        assert code == 0 and text.count("EXTRAPOLATED") == count
        # The axis and the range of the looks.
        assert (f"pan {high + 1} lies outside {low} to {high}" in text) is bool(count) and "tilt 20 lies" not in text
    assert entries[0]["unseen"] == f"pan {low - 1} lies outside {low} to {high}" and entries[2]["unseen"] == ""


def test_no_point_is_behind_the_scanner(ask, say, folder, tmp_path):
    """A point behind the scanner is refused by name: one point, many points, a cloud."""
    back = load_calibration(folder)
    turned = next(n for n in range(2000, 4000, 10) if back.ray(n, 20).direction[0] < -0.5)
    aim = back.ray(turned, 20)
    reading = back.reading(aim.origin_mm + 500 * aim.direction)
    code, document = ask("locate", folder, "--pan-steps", turned, "--tilt-steps", 20, "--aperture-deg", reading)
    assert (code, document["error"]["code"]) == (2, "behind") and "behind the scanner" in document["error"]["message"]
    with pytest.raises(InputError, match="behind the scanner"):
        back.locate(turned, 20, reading)
    with pytest.raises(InputError, match="no mirror angles"):
        back.steps_for(aim.origin_mm + 500 * aim.direction)
    points = table_of(tmp_path / "points.csv", f"20,{turned},{reading},left,up", "20,100,70,left,up")
    out = tmp_path / "cloud.csv"
    entries = ask("locate", folder, "--points", points)[1]["points"]
    assert entries[0]["refused"]["code"] == "behind" and "refused" not in entries[1]
    document = ask("locate", folder, "--points", points, "--cloud", out)[1]
    assert (document["written"], document["refused"]) == (1, 1)
    assert "behind" in (tmp_path / "cloud.refused.csv").read_text()
    assert set(document["checked"]) == {"points", "held", "off_mm", "most_off_mm"}
    text = say("locate", folder, "--points", points, "--cloud", out)[1]
    assert "1 point," in text and "of 1 point carried" in text and "1 points" not in text
    assert "1 look has no point (behind 1)" in text


@pytest.mark.parametrize("cloud", [False, True])
def test_points_of_a_spreadsheet_are_read(ask, folder, tmp_path, cloud):
    """Semicolons and decimal commas, as a spreadsheet in much of the world saves them."""
    ours = table_of(tmp_path / "ours.csv", "20,100,70.5,left,up", "20,100,69.25,left,up")
    theirs = tmp_path / "theirs.csv"
    theirs.write_text(ours.read_text().replace(",", ";").replace(".", ","))
    outputs = []
    for file in (ours, theirs):
        out = ("--cloud", tmp_path / f"{file.stem}.ply") if cloud else ()
        code, document = ask("locate", folder, "--points", file, *out)
        assert code == 0
        outputs.append((tmp_path / f"{file.stem}.ply").read_bytes() if cloud else document)
    assert outputs[0] == outputs[1]
    theirs.write_text(theirs.read_text().replace("aperture_deg", "B"))
    code, document = ask("locate", folder, "--points", theirs)
    assert code == 2 and document["error"]["column"] == "B" and "import" not in document["error"]["remedy"]
    theirs.write_text("tilt_steps;pan_steps;aperture_deg;pan_approach;tilt_approach\n\n20;100;7O;left;up\n")
    code, document = ask("locate", folder, "--points", theirs)
    assert (document["error"]["line"], document["error"]["column"]) == (3, "aperture_deg")


@pytest.mark.parametrize(
    ("row", "code", "column"),
    [
        ("20,100,70,up,up", "approach", "pan_approach"),
        ("20,100,nan,left,up", "number", "aperture_deg"),
        ("20,1e12,70,left,up", "number", "pan_steps"),
    ],
)
def test_invalid_points_are_refused_with_line_and_column(ask, folder, tmp_path, row, code, column):
    points = table_of(tmp_path / "points.csv", "20,100,70,left,up", row)
    exit_code, document = ask("locate", folder, "--points", points)
    error = document["error"]
    assert (exit_code, error["code"], error["line"], error["column"]) == (2, code, 3, column)
    assert error["remedy"] and error["allowed"]


def test_budget_adds_up(ask, folder):
    code, document = ask("locate", folder, *POINT, "--budget")
    assert code == 0
    shares = {entry["cause"]: entry["share"] for entry in document["budget"]["causes"]}
    assert sum(shares.values()) == pytest.approx(1.0, abs=1e-12)
    assert shares["stereo calibration"] == pytest.approx(3 * shares["pixel noise"], rel=1e-9)
    variance = sum(np.square(entry["u_mm"]) for entry in document["budget"]["causes"])
    np.testing.assert_allclose(variance, np.diag(document["linear"]["covariance_mm2"]), rtol=1e-9)


def test_steps_for_a_point_are_those_of_the_library(ask, folder):
    code, answer = ask("steps-for", folder, "--x-mm", 700, "--y-mm", 20, "--z-mm", 40)
    expected = json.loads(json.dumps(load_calibration(folder).steps_for((700.0, 20.0, 40.0)).as_json()))
    assert code == 0 and {**answer, **expected} == answer


def test_limits_of_a_rig_are_kept(ask, folder, tmp_path):
    source = shipped_data() / "rigs" / "mounted"
    text = (source / "rig.toml").read_text()
    # An uncertain backlash: clearing it takes more steps than its best estimate.
    calibration = replace(load_calibration(folder), overshoot_steps={"pan": 6, "tilt": 6})
    store(folder / "results", calibration)
    limits = "[positioner]\npan_min_steps = 97\npan_max_steps = 200\ntilt_min_steps = -100\ntilt_max_steps = 100\n"
    assert "[positioner]" not in text
    (tmp_path / "rig.toml").write_text(f"{text}\n{limits}")
    (tmp_path / "stereo.json").write_bytes((source / "stereo.json").read_bytes())
    aim = calibration.ray(100, 20).direction
    azimuth, elevation = np.degrees([np.arctan2(aim[1], aim[0]), np.arcsin(aim[2])])
    direction = ("--azimuth-deg", azimuth, "--elevation-deg", elevation)
    free = ask("steps-for", folder, *direction)[1]
    assert (free["pan_steps"], free["approach"]["pan"]) == (100, "left")
    code, kept = ask("steps-for", folder, *direction, "--rig", tmp_path / "rig.toml")
    assert code == 0
    assert kept["approach"]["pan"] == "right"
    assert kept["via_pan_steps"] > kept["pan_steps"] >= 97
    code, document = ask("steps-for", folder, *direction, "--rig", tmp_path / "rig.toml", "--pan-approach", "left")
    assert (code, document["error"]["code"]) == (2, "outside-limits")


def test_exports_are_read_back(folder, ask, say, tmp_path):
    code, text, _ = say("steps-for", folder, "--export", "json")
    path = tmp_path / "calibration.json"
    path.write_text(text)
    assert code == 0 and json.loads(path.read_text())["format"] == CALIBRATION_FORMAT
    stored, exported = load_calibration(folder), load_calibration(path)
    point = (600.0, 10.0, 30.0)
    expected, answer = (each.steps_for(point) for each in (stored, exported))
    assert (expected.pan_steps, expected.tilt_steps) == (answer.pan_steps, answer.tilt_steps)
    # Fifteen digits of every number.
    np.testing.assert_allclose(expected.u95_mm, answer.u95_mm, rtol=1e-12)
    code, header, _ = say("steps-for", folder, "--export", "header")
    assert code == 0 and "Expected error (posterior, 95 %)" in header
    assert "@" not in header.split("#ifndef")[0] and "Campaign: " in header
    for kind in ("header", "json"):
        place = tmp_path / f"out.{kind}"
        code, text, _ = say("steps-for", folder, "--export", kind, "--out", place)
        assert code == 0 and str(place) in text.replace("\n", "")
    assert (tmp_path / "out.header").read_text() == header
    assert say("compensate", folder, "--to", "header")[:2] == (0, header)
    before = (folder / "moves.csv").read_bytes()
    code, _ = ask("compensate", folder, "--to", "header", "-o", folder / "moves.csv")
    assert code == 2 and (folder / "moves.csv").read_bytes() == before
    code, document = ask("compensate", folder, "--to", "linuxcnc")
    assert code == 2 and "--to header" in document["error"]["remedy"]
    assert load_calibration(path).steps_for(point).as_json() == exported.steps_for(point).as_json()


def test_damaged_results_are_refused_and_not_replaced(ask, folder):
    draws = folder / "results" / "draws.npz"
    draws.write_bytes(draws.read_bytes()[:1000])
    code, document = ask("locate", folder, *POINT)
    assert (code, document["error"]["code"]) == (2, "damaged-results")
    assert draws.stat().st_size == 1000


@pytest.mark.parametrize("ending", ["ply", "csv"])
def test_a_file_of_points_becomes_a_cloud(ask, say, folder, tmp_path, ending):
    rows = "20,100,70,left,up", "20,100,150,left,up", "-20,0,75,right,down", "20,5000,70,left,up"
    points, out = table_of(tmp_path / "points.csv", *rows), tmp_path / f"cloud.{ending}"
    code, document = ask("locate", folder, "--points", points, "--cloud", out)
    assert code == 0 and out.exists() and document["cloud"] == str(out)
    entries = ask("locate", folder, "--points", points)[1]["points"]
    valid = [entry["xyz_mm"] is not None for entry in entries]
    assert (document["written"], document["refused"]) == (sum(valid), 4 - sum(valid))
    assert document["refused_file"] == str(tmp_path / "cloud.refused.csv") and 0 < document["checked"]["points"] <= 4
    assert {"x", "sd_x", "nominal_x"} <= set(document["columns"])
    assert document["extrapolated"] == sum(e["extrapolated"] for e, good in zip(entries, valid, strict=True) if good)
    code, text, _ = say("locate", folder, "--points", points, "--cloud", out)
    assert code == 0 and "cloud.refused.csv" in text
    before = points.read_bytes()
    assert ask("locate", folder, "--points", points, "--cloud", points)[0] == 2 and points.read_bytes() == before


@pytest.mark.parametrize("kind", ["json", "header"])
def test_an_exported_calibration_replaces_its_kind_only(ask, folder, tmp_path, kind):
    out, command = tmp_path / "calibration", ("steps-for", folder, "--export", kind, "-o", tmp_path / "calibration")
    assert ask(*command)[0] == 0 and ask(*command)[0] == 0
    other = {"json": "header", "header": "json"}[kind]
    code, document = ask("steps-for", folder, "--export", other, "-o", out)
    assert (code, document["error"]["code"]) == (2, "occupied")
    out.write_text("mine")
    assert ask(*command)[0] == 2 and out.read_text() == "mine"
    assert ask(*command, "--force")[0] == 0 and out.read_text() != "mine"


@pytest.mark.parametrize("command", [("steps-for", "--export", "json"), ("report",), ("view",)])
@pytest.mark.parametrize("name", ["moves.csv", "campaign.toml", "log.jsonl", "frames/000003_left.png"])
def test_no_output_replaces_the_data_of_a_campaign(ask, tmp_path, command, name):
    """Refused before the fit; outside of a campaign folder the name is allowed."""
    (tmp_path / "frames").mkdir()
    for part in ("campaign.toml", name):
        (tmp_path / part).write_bytes(b"mine")
    code, document = ask(command[0], tmp_path, *command[1:], "-o", tmp_path / name)
    assert code == 2 and "would replace data of the campaign" in document["error"]["message"]
    assert (tmp_path / name).read_bytes() == b"mine"


@pytest.mark.parametrize(
    "command", [("detect",), ("report",), ("steps-for", "--export", "json", "-o"), ("view", "-o"), ("report", "-o")]
)
def test_a_folder_that_cannot_be_written_is_refused_before_the_work(ask, folder, tmp_path, monkeypatch, command):
    """As of another user's folder: nothing is searched, fitted or drawn that could not be kept."""

    def denied(**_: object) -> None:
        raise PermissionError(13, "Permission denied")

    for work in ("cameras.detection.detect", "report.page.page_html", "view.page.page_html"):
        monkeypatch.setattr(f"tvsbayes.{work}", lambda *_, **__: pytest.fail("worked"), raising=False)
    monkeypatch.setattr("tempfile.TemporaryFile", denied)
    out = [tmp_path / "out.x"] if command[-1] == "-o" else []
    code, document = ask(command[0], folder, *command[1:], *out)
    assert (code, document["error"]["code"], document["error"]["found"]) == (2, "write", "Permission denied")


@pytest.mark.parametrize("command", [("steps-for", "--export", "json"), ("report",), ("plan",)])
def test_an_output_without_a_folder_is_refused_before_the_fit(ask, tmp_path, command):
    """Refused before the campaign is read: this one is unreadable."""
    code, document = ask(command[0], tmp_path, *command[1:], "-o", tmp_path / "nowhere" / "out.x")
    error = document["error"]
    assert (code, error["code"], error["found"]) == (2, "write", "no such folder")
