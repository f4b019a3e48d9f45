"""`new`: files become a campaign, nothing is overwritten, the next command is printed."""

from __future__ import annotations

import re
import shlex
import shutil

import numpy as np
import pytest
from support.commands import MOUNTED, assert_error, steps
from support.drawn_pictures import drawn, pairs

from tvsbayes.instrument.campaign import moves_bytes, pixels_of, read_campaign
from tvsbayes.instrument.rig import RigTable, read_rig
from tvsbayes.instrument.stereo_pair import write_stereo
from tvsbayes.twin.frames import write_frames
from tvsbayes.twin.simulated_campaign import simulate


def test_new_campaign_lacks_only_its_stereo_calibration(ask, say, tmp_path):
    out = tmp_path / "mine"
    code, document = ask("new", out)
    assert code == 0
    assert sorted(document["files"]) == ["campaign.toml", "moves.csv", "rig.toml", "spots.csv"]
    code, document = ask("check", out)
    assert code == 2
    assert assert_error(document, "missing-file")["file"] == "stereo.json"
    (out / "stereo.json").write_bytes((MOUNTED / "stereo.json").read_bytes())
    code, document = ask("check", out)
    assert code == 0
    assert (document["moves"], document["spots"]) == (1, 0)
    assert ask("check", out / "rig.toml")[0] == 0
    # The templates state nothing but the default priors.
    assert read_campaign(out).rig == read_rig(out / "rig.toml").table == RigTable()
    code, text, log = say("new", out)
    assert (code, text) == (2, "")
    assert "nothing is overwritten" in log


@pytest.fixture(scope="module")
def two_looks(mounted_rig, tmp_path_factory):
    """A simulated campaign of two moves and its pictures under arbitrary names."""
    plan = steps(("home", 0, 0), ("place", "d1"), ("look",), ("move", 100, 30), ("look",))
    run = simulate(mounted_rig, plan, seed=5)
    folder = tmp_path_factory.mktemp("rendered")
    write_frames(folder, run, 5)
    for path in (folder / "frames").iterdir():
        number, side = path.stem.split("_")
        path.rename(folder / f"{side.title()}_{int(number) + 1}.png")
    (folder / "frames").rmdir()
    return run.campaign, folder


def test_pictures_become_looks_that_detect_finds(ask, say, two_looks, tmp_path):
    """From a folder of pictures to centres; the twin's own centroids lie within a few of their uncertainties."""
    campaign, pictures = two_looks
    out = tmp_path / "mine"
    assert ask("new", out)[0] == 0
    (out / "moves.csv").write_bytes(moves_bytes(campaign.moves))
    write_stereo(campaign.stereo, out / "stereo.json")
    code, document = ask("detect", out)
    assert code == 3 and "--pictures" in assert_error(document, "no-frames")["remedy"]
    code, text, _ = say("new", out, "--pictures", pictures)
    assert code == 0 and "next: `tvsbayes detect" in text and "count from" not in text
    first = campaign.moves[campaign.spots[0].move]
    assert f"seen after move {first.move} at pan {first.pan_steps}, tilt {first.tilt_steps} steps" in text
    code, document = ask("detect", out)
    assert (code, document["ok"], document["missing"]) == (0, 2, 0)
    pixels = pixels_of(read_campaign(out).spots)
    # Both scatter by 0.1 px or less; five of those.
    np.testing.assert_allclose(pixels, pixels_of(campaign.spots), rtol=0, atol=0.5)
    code, document = ask("new", out, "--pictures", pictures)
    assert code == 2 and "none waits" in assert_error(document, "occupied")["message"]


def test_moves_beside_the_pictures_are_copied(ask, two_looks, tmp_path):
    campaign, pictures = two_looks
    shutil.copytree(pictures, tmp_path / "pictures")
    (tmp_path / "pictures" / "moves.csv").write_bytes(moves_bytes(campaign.moves))
    code, document = ask("new", tmp_path / "mine", "--pictures", tmp_path / "pictures")
    assert (code, document["looks"], document["moves_to_fill_in"]) == (0, 2, False)
    assert (tmp_path / "mine" / "moves.csv").read_bytes() == moves_bytes(campaign.moves)


def test_a_question_has_the_commands_that_answer_it(ask, say, tmp_path):
    """Two folders without a word of a camera: the command of each answer runs as it is printed."""
    for name in ("A", "B"):
        drawn(tmp_path / "my pictures" / name, "1.png", "2.png", "3.png")
    drawn(tmp_path / "my pictures" / "A", "4.jpg")
    command = ("new", tmp_path / "mine", "--pictures", tmp_path / "my pictures")
    code, text, log = say(*command)
    assert code == 2 and not text and not (tmp_path / "mine").exists()
    printed = re.findall(r"`(tvsbayes new .*?)`", log)
    code, document = ask(*command)
    answers = assert_error(document, "ambiguous")["candidates"]
    assert [each["command"] for each in answers] == printed
    assert answers[1]["says"] == "B/1.png is the left camera's" and len(answers) == 3
    code, text, _ = say(*shlex.split(printed[1])[1:])
    assert code == 0 and "for example B/1.png and A/1.png: spot 0" in text
    assert "not paired: A/4.jpg: no camera in the name" in text


def test_renumbered_moves_are_reported(say, tmp_path):
    drawn(tmp_path / "pictures", *pairs("0930", "1015"))
    code, text, _ = say("new", tmp_path / "mine", "--pictures", tmp_path / "pictures")
    assert code == 0 and "930 to 1015, are too sparse for moves: these are renumbered in order" in text
