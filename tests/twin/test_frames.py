"""Pictures of a simulated campaign: an interrupted run goes on, and its folder does not look whole before."""

from __future__ import annotations

from dataclasses import replace

import pytest
from support.commands import steps

from tvsbayes.errors import InputError
from tvsbayes.instrument.campaign import read_campaign
from tvsbayes.twin import frames
from tvsbayes.twin.frames import write_with_frames
from tvsbayes.twin.simulated_campaign import simulate

PLAN = steps(("home", 0, 0), ("place", "d1"), ("look",), ("move", 100, 30), ("look",))


@pytest.fixture(scope="module")
def runs(mounted_rig):
    """Two simulations of one plan."""
    return [simulate(mounted_rig, PLAN, seed).undetected() for seed in (5, 6)]


def contents(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_an_interrupted_run_goes_on(runs, tmp_path, monkeypatch):
    assert write_with_frames(tmp_path / "whole", runs[0], 5, views=0) == 4
    rendered = []
    render = frames.render_spots

    def interrupted(*arguments):
        if len(rendered) == 1:
            raise KeyboardInterrupt
        rendered.append(arguments[-1])
        return render(*arguments)

    monkeypatch.setattr(frames, "render_spots", interrupted)
    monkeypatch.setattr(frames, "cpu_count", lambda: 1)
    with pytest.raises(KeyboardInterrupt):
        write_with_frames(tmp_path / "begun", runs[0], 5, views=0)
    with pytest.raises(InputError, match=r"campaign\.toml: found no such file .* an unfinished run"):
        read_campaign(tmp_path / "begun")
    monkeypatch.setattr(frames, "render_spots", render)
    kept = tmp_path / "begun" / "frames" / "000000_left.png"
    before = kept.stat().st_mtime_ns
    assert write_with_frames(tmp_path / "begun", runs[0], 5, views=0) == 4
    assert kept.stat().st_mtime_ns == before
    assert contents(tmp_path / "begun") == contents(tmp_path / "whole")


@pytest.mark.parametrize("case", ["finished", "another", "edited", "foreign"])
def test_what_another_run_left_is_not_touched(runs, tmp_path, case):
    write_with_frames(tmp_path, runs[0], 5, views=0)
    if case != "finished":
        (tmp_path / "campaign.toml").unlink()
    if case == "edited":
        (tmp_path / "spots.csv").write_text("mine")
    elif case == "foreign":
        (tmp_path / "notes.txt").write_text("mine")
    before = contents(tmp_path)
    with pytest.raises(InputError, match="nothing is overwritten"):
        write_with_frames(tmp_path, runs[case == "another"], 5 + (case == "another"), views=0)
    assert contents(tmp_path) == before


def test_nothing_is_written_of_cameras_that_see_no_board_together(runs, tmp_path):
    """Cameras two metres apart: no board stands in both of their pictures."""
    stereo = runs[0].truth.stereo
    apart = replace(runs[0], truth=replace(runs[0].truth, stereo=replace(stereo, T=stereo.T * 25)))
    with pytest.raises(InputError, match="fits into both images 0 of 20 times") as caught:
        write_with_frames(tmp_path / "c", apart, 5)
    assert caught.value.remedy and not (tmp_path / "c").exists()
