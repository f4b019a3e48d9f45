"""`import`: shown before it is written, nothing overwritten, columns asked for at a terminal."""

from __future__ import annotations

import inspect
import io
import os
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from support.commands import MOUNTED, assert_error

from tvsbayes.cli import axis_import
from tvsbayes.cli.import_command import AXIS, KINDS_OF, import_
from tvsbayes.instrument.campaign import moves_bytes, pixels_of, read_campaign, write_campaign

UNIT = Path(__file__).parents[1] / "head" / "unit.urdf"
TABLE = "Nr;Pan;Tilt;XL;YL;XR;YR;Blatt\n1;0;0;640,5;360,25;500;360;nah\n2;200;0;700,5;360,25;560;360;nah\n"


def test_every_option_declares_its_kinds_of_files():
    """An undeclared option would be ignored without a message."""
    for_all = {"file", "to", "yes", "as_json"}
    assert set(KINDS_OF) == set(inspect.signature(import_).parameters) - for_all
    of_an_axis = {option for option, kinds in KINDS_OF.items() if AXIS in kinds}
    assert set(axis_import.KINDS_OF) == of_an_axis - {"axis", "kind"}


@pytest.fixture
def table(tmp_path):
    path = tmp_path / "looks.csv"
    path.write_text(TABLE, encoding="utf-16")
    return path


def test_a_table_is_shown_then_written_and_read_by_check(ask, say, table, tmp_path):
    out = tmp_path / "mine"
    code, text, _ = say("import", table, "--to", out, "--pixels-from", 1)
    assert code == 0 and not out.exists()
    assert "semicolons between cells, UTF-16, decimal commas; 2 rows" in text
    assert [line.split() for line in text.splitlines() if line.startswith("u_left_px")] == [
        ["u_left_px", "XL", "px", "from", "1", "640.5,", "700.5"]
    ]
    assert "nothing written: add --yes" in text
    code, document = ask("import", table, "--to", out, "--pixels-from", 1, "--yes", "--pan-approach", "left")
    assert (code, document["moves"], document["spots"], document["unused"]) == (0, 2, 2, [])
    assert document["columns"]["target"] == {"column": "Blatt", "first": ["nah", "nah"], "empty": 0}
    shutil.copy(MOUNTED / "stereo.json", out)
    campaign = read_campaign(out)
    assert pixels_of(campaign.spots)[:, 0].tolist() == [639.5, 699.5]
    assert (campaign.moves[0].pan_approach, campaign.moves[1].pan_steps) == ("left", 200)
    assert ask("check", out)[0] == 0
    before = {path: path.read_bytes() for path in out.iterdir()}
    code, document = ask("import", table, "--to", out, "--yes")
    assert code == 2 and assert_error(document, "occupied")["file"].endswith("moves.csv")
    assert {path: path.read_bytes() for path in out.iterdir()} == before


def test_a_log_for_a_campaign_with_empty_counters_is_refused_with_a_remedy(ask, tmp_path):
    """`new --pictures` leaves empty counters; a log of them is imported first."""
    out, table = tmp_path / "mine", tmp_path / "log.csv"
    assert ask("new", out)[0] == 0
    (out / "moves.csv").write_text(
        "move,segment,time_s,pan_steps,tilt_steps,pan_approach,tilt_approach\n0,0,0,,,unknown,unknown\n1,0,1,,,,\n"
    )
    table.write_text("Nr;Pan;Tilt\n0;0;0\n1;200;0\n")
    code, document = ask("import", table, "--to", out, "--yes")
    error = document["error"]
    assert code == 2 and (error["line"], error["column"], error["found"]) == (2, "pan_steps", "an empty cell")
    assert "import it --to a new folder" in error["remedy"] and "--pictures FOLDER" in error["remedy"]


def test_a_counter_with_the_wrong_sign_is_refused_and_corrected_by_the_remedy(ask, say, grid_campaign, tmp_path):
    """The command named by `check` writes a corrected copy of the campaign."""
    moves = tuple(replace(m, tilt_steps=-m.tilt_steps) for m in grid_campaign.moves)
    write_campaign(replace(grid_campaign, moves=moves), tmp_path / "wrong")
    code, document = ask("check", tmp_path / "wrong")
    (finding,) = document["findings"]
    assert code == 0 and finding["certain"] and finding["code"] == "counter-sign"
    assert "certain: 1 of them" in say("check", tmp_path / "wrong")[1]
    for command in ("fit", "calibrate"):
        code, document = ask(command, tmp_path / "wrong", "--quick")
        error = assert_error(document, "counter-sign")
        assert (code, error["file"], error["line"]) == (2, "moves.csv", finding["line"])
        assert finding["remedy"] in error["remedy"] and "--anyway" in error["remedy"]
    words = shlex.split(finding["remedy"].split("`")[1])
    code, document = ask(*words[1:])
    assert code == 0 and document["files"] and "approaches stay" in document["assumed"][0]
    repaired, sound = read_campaign(tmp_path / "wrong-mended"), grid_campaign
    assert (repaired.moves, repaired.spots) == (sound.moves, sound.spots)
    assert (repaired.path / "campaign.toml").read_bytes() == (tmp_path / "wrong" / "campaign.toml").read_bytes()
    assert ask("check", repaired.path)[1]["findings"] == []
    assert ask(*words[1:])[0] == 2, "nothing is overwritten"


def test_a_campaign_is_copied_only_with_a_correction(ask, say, grid_folder, tmp_path):
    code, document = ask("import", grid_folder, "--to", tmp_path / "x", "--yes")
    assert code == 2 and "--flip" in document["error"]["remedy"]
    for option in (("--column", "move=Nr"), ("--sd-px", "0.2"), ("--pan-approach", "left")):
        code, document = ask("import", grid_folder, "--to", tmp_path / "x", "--swap", *option, "--yes")
        assert code == 2 and option[0] in document["error"]["message"]
    code, text, _ = say("import", grid_folder, "--to", tmp_path / "x", "--shift-moves", "1")
    assert code == 0 and "nothing written" in text and not (tmp_path / "x").exists()


def test_looks_go_to_the_moves_of_a_campaign(ask, grid_campaign, tmp_path):
    out, table = tmp_path / "mine", tmp_path / "t.csv"
    assert ask("new", out)[0] == 0
    (out / "moves.csv").write_bytes(moves_bytes(grid_campaign.moves))
    table.write_text("move,x1,y1,x2,y2\n3,600,300,500,300\n")
    code, document = ask("import", table, "--to", out, "--yes")
    assert (code, document["moves"], document["spots"]) == (0, None, 1)
    assert (out / "moves.csv").read_bytes() == moves_bytes(grid_campaign.moves)


def test_columns_not_recognised_are_asked_for(ask, say, table, tmp_path, monkeypatch):
    table.write_text("pan_goal,pan_pos,tilt,XL,YL,XR,bottom\n0,1,0,640,360,500,360\n")
    code, document = ask("import", table, "--to", tmp_path / "mine", "--yes")
    error = assert_error(document, "missing-column")
    assert code == 2 and "pan_steps (pan_goal or pan_pos)" in error["found"] and "v_right_px" in error["found"]
    # The recognised columns are shown before the question.
    assert "understood so far: tilt_steps = tilt, u_left_px = XL, v_left_px = YL, u_right_px = XR" in error["found"]
    stated = ("--column", "pan_steps=pan_pos", "--column", "v_right_px=bottom")
    assert ask("import", table, "--to", tmp_path / "mine", *stated)[1]["columns"]["pan_steps"]["column"] == "pan_pos"

    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    monkeypatch.setattr("sys.stdin", Terminal("\n\n"))
    code, _, _ = say("import", table, "--to", tmp_path / "asked")
    assert (code, (tmp_path / "asked" / "moves.csv").exists()) == (2, False)
    monkeypatch.setattr("sys.stdin", Terminal("bottom\npan_pos\ny\n"))
    code, _, log = say("import", table, "--to", tmp_path / "asked")
    assert code == 0, log
    assert (tmp_path / "asked" / "moves.csv").read_text().splitlines()[1].startswith("0,0,0.0,1,0,")


def test_every_needed_column_is_asked_for_and_none_may_be_left_out(ask, tmp_path):
    (tmp_path / "log.csv").write_text("# bench 3\n\na,b\n1,2\n")
    code, document = ask("import", tmp_path / "log.csv", "--to", tmp_path / "axis", "--axis")
    assert assert_error(document, "missing-column")["line"] == 3
    remedy = assert_error(document, "missing-column")["remedy"]
    assert code == 2 and "--column command=NAME --column value=NAME" in remedy and "none" not in remedy


def test_words_that_exclude_looks_are_reported_and_foreign_words_for_good_are_known(ask, table, tmp_path):
    rows = [f"{pan},0,640,360,500,360,{word}" for pan, word in enumerate(("gut", "gültig", "oui", "odd", "mal", "ok"))]
    table.write_text("\n".join(["pan,tilt,XL,YL,XR,YR,state", *rows, "9,0,,,,,odd"]) + "\n", encoding="utf-8")
    code, document = ask("import", table, "--to", tmp_path / "mine", "--yes")
    assert code == 0 and "status: 3 looks left out by column state: odd 2, mal 1" in document["assumed"]
    spots = (tmp_path / "mine" / "spots.csv").read_text(encoding="utf-8").splitlines()[1:]
    assert [line.rpartition(",")[2] for line in spots] == ["ok", "ok", "ok", "odd", "refused: mal", "ok", "odd"]
    log = tmp_path / "log.csv"
    log.write_text("steps,deg,quality\n0,0.1,bien\n9,0.2,hit\n18,0.3,\n")
    remarks = ask("import", log, "--to", tmp_path / "axis", "--axis")[1]["assumed"]
    assert "status: 1 reading left out by column quality: hit 1" in remarks


def test_a_log_of_one_axis_goes_to_an_axis_folder(ask, say, tmp_path):
    """With --axis, or where the folder is one; nothing of it is overwritten."""
    log, out = tmp_path / "log.csv", tmp_path / "axis"
    turns = [*range(0, 7, 2), *range(4, -1, -2)] * 2
    log.write_text(
        "time;steps;encoder_deg\n" + "".join(f"{k};{n};{0.5 * n + 0.01 * k:.3f}\n" for k, n in enumerate(turns))
    )
    code, document = ask("import", log, "--to", out)
    assert code == 2 and "--axis" in assert_error(document, "missing-column")["remedy"]
    assert "value  " in say("import", log, "--to", out, "--axis")[1] and not out.exists()
    code, document = ask("import", log, "--to", out, "--axis", "--pixels-from", 1)
    assert code == 2 and "--pixels-from" in assert_error(document, "usage")["message"]
    assert ask("new", out, "--axis")[0] == 0
    code, document = ask("import", log, "--to", out, "--yes")
    assert (code, document["readings"], document["columns"]["value"]["column"]) == (0, 14, "encoder_deg")
    assert any("campaign.toml says; the column says deg" in text for text in document["assumed"])
    assert ask("check", out)[1]["readings"] == 14
    code, document = ask("import", log, "--to", out, "--yes")
    assert code == 2 and assert_error(document, "occupied")["file"].endswith("moves.csv")


def test_a_log_of_sightings_becomes_a_head(ask, say, tmp_path):
    """Semicolons, decimal commas, German names; a folder that `new` or a URDF made keeps what it says."""
    steps = [(400 * k, 100 * (k * k % 7)) for k in range(12)]
    rows = [f"{k};{pan};{tilt};{0.045 * pan:.4f};{0.05 * tilt + 3:.4f}" for k, (pan, tilt) in enumerate(steps)]
    text = "\n".join(["Zeit;Motor Az;Motor El;Az gemessen [deg];Hoehe gemessen [deg]", *rows]).replace(".", ",")
    (tmp_path / "log.csv").write_text(text)
    words = "import", tmp_path / "log.csv", "--sightings", "--to"
    code, printed, _ = say(*words, tmp_path / "mount")
    assert code == 0 and "nothing written" in printed and not (tmp_path / "mount").exists()
    code, document = ask(*words, tmp_path / "mount", "--yes", "--assume", "u_deg=0.002")
    assert (code, document["moves"], document["ok"]) == (0, 12, 12)
    mount = read_campaign(tmp_path / "mount")
    assert mount.rig.priors["degrees_per_step.pan"].value == pytest.approx(0.045)
    code, printed, _ = say("check", tmp_path / "mount")
    assert code == 0 and "usable sightings" in printed and "aperture" not in printed
    assert ask(*words, tmp_path / "mount", "--yes")[0] == 2, "nothing is overwritten"
    assert ask("import", tmp_path / "mount", "--to", tmp_path / "copy", "--flip", "tilt_steps", "--yes")[0] == 0
    copy = read_campaign(tmp_path / "copy")
    assert [m.tilt_steps for m in copy.moves] == [-m.tilt_steps for m in mount.moves] and copy.spots == mount.spots
    assert ask("import", tmp_path / "mount", "--to", tmp_path / "other", "--swap", "--yes")[0] == 2
    assert ask("new", tmp_path / "new", "--mechanism", "pan-tilt", "--sightings")[0] == 0
    header = (tmp_path / "new" / "campaign.toml").read_bytes()
    assert ask("import", tmp_path / "log.csv", "--to", tmp_path / "new", "--yes")[0] == 0
    assert read_campaign(tmp_path / "new").rig.priors["degrees_per_step.tilt"].value == pytest.approx(0.05)
    assert (tmp_path / "new" / "campaign.toml").read_bytes() != header
    assert ask("import", "--urdf", UNIT, "--steps-per-turn", 400, "--to", tmp_path / "unit", "--yes")[0] == 0
    header = (tmp_path / "unit" / "campaign.toml").read_bytes()
    encoders = text.replace("Motor Az", "Encoder Az [arcsec]")
    (tmp_path / "encoders.csv").write_text(encoders)
    code, document = ask("import", tmp_path / "encoders.csv", "--to", tmp_path / "unit", "--yes")
    assert code == 2 and "table of counters" in assert_error(document, "encoder")["remedy"]
    assert ask("import", tmp_path / "log.csv", "--to", tmp_path / "unit", "--yes")[0] == 0
    stated = read_campaign(tmp_path / "unit").rig.priors["degrees_per_step.pan"]
    assert stated.value == pytest.approx(360 / 400 / 30), "of the URDF"
    code, document = ask(*words, tmp_path / "x", "--column", "azimuth_deg=")
    assert code == 2 and "azimuth_deg" in assert_error(document, "missing-column")["remedy"]
    assert ask(*words, tmp_path / "x", "--sd-px", "0.1")[0] == 2
    assert ask("new", tmp_path / "scanner")[0] == 0
    assert_error(ask(*words, tmp_path / "scanner", "--yes")[1], "instrument")
    assert not (tmp_path / "scanner" / "sightings.csv").exists()


def test_cameras_may_come_first(ask, table, tmp_path):
    """`stereo` makes the folder that it writes into; `import` takes one that holds nothing else."""
    out = tmp_path / "mine"
    code, document = ask("stereo", "--import", MOUNTED / "stereo.json", "-o", out / "stereo.json")
    assert code == 0 and document["files"] == {"stereo": str(out / "stereo.json")}
    cameras = (out / "stereo.json").read_bytes()
    assert ask("import", table, "--to", out, "--yes")[0] == 0
    assert (out / "stereo.json").read_bytes() == cameras and len(read_campaign(out).spots) == 2
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").write_text("mine")
    code, document = ask("import", table, "--to", tmp_path / "other", "--yes")
    assert code == 2 and assert_error(document, "occupied")["found"] == "a folder with files"


TRACKS = [f"step,reading_mm\n{''.join(f'{c},{scale * c + 0.01 * (c > 0):.3f}{chr(10)}' for c in (0, 100, 200, 300))}"
          for scale in (0.01, 0.02)]  # fmt: skip


@pytest.mark.parametrize(
    ("tables", "options"), [([TABLE, TABLE.replace("200", "300")], ()), (TRACKS, ("--axis",))], ids=["scanner", "axis"]
)
def test_of_two_imports_into_one_new_folder_one_wins_whole(say, tmp_path, monkeypatch, tables, options):
    """The second begins and ends while the first is about to show its folder."""
    names, rename, done = ["first.csv", "second.csv"], os.rename, []
    for name, text in zip(names, tables, strict=True):
        (tmp_path / name).write_text(text)

    def run(name: str, out: Path) -> int:
        return say("import", tmp_path / name, "--to", out, "--yes", *options)[0]

    def late(source, target):
        if not done:
            done.append(None)
            done[0] = run("second.csv", tmp_path / "mine")
        rename(source, target)

    monkeypatch.setattr(os, "rename", late)
    assert run("first.csv", tmp_path / "mine") == 2 and done == [0]
    monkeypatch.undo()
    assert run("second.csv", tmp_path / "alone") == 0
    mine, alone = ({p.name: p.read_bytes() for p in (tmp_path / name).iterdir()} for name in ("mine", "alone"))
    assert mine == alone
