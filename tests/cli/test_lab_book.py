"""A lab book with its pictures: one command to a campaign whose looks wait for `detect`, and the paper's lab whole."""

from __future__ import annotations

import re
import shutil

import pytest
from support.commands import MOUNTED, assert_error
from support.drawn_pictures import drawn

from experiments.common.paper_lab import LABS, keys_of, misplaced, write_lab
from tvsbayes.estimators.four_point import classic
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.campaign import CAMERAS, frame_name, read_campaign
from tvsbayes.instrument.protocols import four_point_protocol
from tvsbayes.instrument.stereo_pair import write_stereo
from tvsbayes.twin.frames import write_frames
from tvsbayes.twin.simulated_campaign import simulate


@pytest.fixture(scope="module")
def run(mounted_rig):
    return simulate(mounted_rig, four_point_protocol(2), seed=5)


@pytest.fixture(scope="module")
def frames(run, tmp_path_factory):
    """Small pictures under the names of the frames: which look and camera each is of can be told."""
    folder = tmp_path_factory.mktemp("frames")
    names = [frame_name(spot.spot, side).rpartition("/")[2] for spot in run.campaign.spots for side in CAMERAS]
    drawn(folder / "frames", *names)
    return folder


@pytest.mark.parametrize("lab", LABS, ids=[lab.name for lab in LABS])
def test_every_picture_comes_to_its_look(ask, run, frames, tmp_path, lab):
    """Experiments count from 1 in each direction; the book's numbers, planes, moves and day are kept."""
    names = write_lab(lab, run.campaign, frames, tmp_path)
    mine = tmp_path / "mine"
    book = "import", tmp_path / "book.csv", "--to", mine, "--relative", "--pictures", tmp_path / "pictures"
    code, document = ask(*book)
    assert code == 0 and not mine.exists()
    code, document = ask(*book, "--yes")
    assert (code, document["spots"], document["pictures"], document["warnings"]) == (0, 32, 64, [])
    shutil.copy(MOUNTED / "stereo.json", mine)
    campaign = read_campaign(mine)
    assert misplaced(names, tmp_path / "pictures", mine) == 0
    keys = keys_of(run.campaign)
    looks = sorted(campaign.spots, key=lambda spot: (spot.move, spot.spot))
    assert [look.experiment for look in looks] == [keys[spot][1] for spot in sorted(keys)]
    assert [(m.pan_steps, m.tilt_steps) for m in campaign.moves] == [
        (m.pan_steps, m.tilt_steps) for m in run.campaign.moves
    ]
    assert str(campaign.header["created"]) == "2025-07-24 09:00:00" and {s.status for s in looks} == {"undetected"}
    assert ask("check", mine)[0] == 0


def test_what_a_book_lacks_is_counted_and_named(ask, say, run, frames, tmp_path):
    write_lab(LABS[0], run.campaign, frames, tmp_path)
    pictures = tmp_path / "pictures"
    (pictures / "up" / "exp02_P3_R.png").unlink()
    drawn(pictures, "bench.png")
    book = "import", tmp_path / "book.csv", "--to", tmp_path / "mine", "--relative"
    code, text, _ = say(*book, "--pictures", pictures, "--yes")
    assert code == 0 and "32 looks, 0 with a spot, 31 of them with pictures" in text
    assert re.search(
        r"not used: 1 named by the book, and no such pair of pictures: line \d+ up/exp02_P3_L\.png\n", text
    )
    assert "not used: 2 not named by the book: " in text and "bench.png" in text and "up/exp02_P3_L.png" in text
    assert "next: `tvsbayes stereo" in text and "tvsbayes detect" in text
    # Without its pictures the looks wait all the same, and what brings them is said.
    code, document = ask(*book[:3], tmp_path / "bare", "--relative", "--yes")
    assert (code, document["spots"]) == (0, 32) and any("--pictures FOLDER" in text for text in document["assumed"])
    code, document = ask(*book[:3], tmp_path / "other", "--left", "a/*.png", "--right", "b/*.png")
    assert code == 2 and "add --pictures FOLDER" in assert_error(document, "usage")["remedy"]


def test_pictures_of_another_size_than_the_calibration_are_refused(ask, run, frames, tmp_path):
    write_lab(LABS[0], run.campaign, frames, tmp_path)
    mine = tmp_path / "mine"
    mine.mkdir()
    shutil.copy(MOUNTED / "stereo.json", mine)
    book = "import", tmp_path / "book.csv", "--to", mine, "--relative", "--pictures", tmp_path / "pictures", "--yes"
    code, document = ask(*book)
    assert code == 2 and "8 x 6 px" in assert_error(document, "image-size")["found"]
    assert [path.name for path in mine.iterdir()] == ["stereo.json"]


@pytest.mark.thorough
def test_the_papers_lab_gives_its_table(ask, run, tmp_path):
    """Rendered pictures in folders of directions and a book, through detect to the classic estimate of every direction.

    Centres lie within 0.3 px of the twin's, which moves a ratio of 200 steps by less than 0.002 deg/step.
    """
    write_frames(tmp_path, run, 5)
    write_lab(LABS[0], run.campaign, tmp_path, tmp_path)
    mine = tmp_path / "mine"
    book = "import", tmp_path / "book.csv", "--to", mine, "--relative", "--pictures", tmp_path / "pictures", "--yes"
    assert ask(*book)[0] == 0
    write_stereo(run.campaign.stereo_pair, mine / "stereo.json")
    code, document = ask("detect", mine)
    assert (code, document["ok"], document["warnings"]) == (0, 32, [])
    code, document = ask("classic", mine)
    truth = classic(run.campaign).directions
    for way in DIRECTIONS:
        assert document["directions"][way]["n"] == 2
        mean = document["directions"][way]["mean_deg_per_step"]
        assert mean == pytest.approx(truth[way].mean_deg_per_step, abs=0.002)
    assert [(e["experiment"], e["direction"]) for e in document["experiments"]] == [
        (n, way) for n in (1, 2) for way in DIRECTIONS
    ]
