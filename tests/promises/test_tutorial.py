"""The tutorial shows the output of the commands; the drawing of the instrument has the signs of the code."""

from __future__ import annotations

import doctest
import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from support.commands import caching_in
from support.printed_pages import follow, shown

from tvsbayes.cli.main import run

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "data" / "tutorial" / "README.md"
TEXT = PAGE.read_text(encoding="utf-8")
QUICK = ("simulate", "check", "classic", "new")
"""Commands without a fit: they run by default."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Working folder of the page's commands: a folder with `data/`, as the root of a clone."""
    clone = tmp_path_factory.mktemp("clone")
    (clone / "data").symlink_to(ROOT / "data")
    return clone


def test_commands_without_a_fit_print_the_output_of_the_tutorial(folder, monkeypatch, capsys):
    steps = [step for step in shown(TEXT) if step.arguments[0] in QUICK]
    assert {step.arguments[0] for step in steps} == set(QUICK)
    follow(steps, folder, monkeypatch, capsys)


def test_python_examples_print_the_output_of_the_tutorial(folder, monkeypatch):
    monkeypatch.chdir(folder)
    code = "\n".join(re.findall(r"```pycon\n(.*?)```", TEXT, flags=re.DOTALL))
    example = doctest.DocTestParser().get_doctest(code, {}, "tutorial", "README.md", 0)
    report: list[str] = []
    results = doctest.DocTestRunner(verbose=False).run(example, out=report.append)
    assert results.attempted >= 3
    assert not results.failed, "".join(report)


@pytest.mark.slow
def test_all_commands_print_the_output_of_the_tutorial(tmp_path, monkeypatch, capsys):
    (tmp_path / "data").symlink_to(ROOT / "data")
    steps = shown(TEXT)
    wanted = {"fit", "compare", "steps-for", "locate", "plan", "report"}
    assert wanted <= {step.arguments[0] for step in steps}
    with caching_in(tmp_path / "cache"):
        follow(steps, tmp_path, monkeypatch, capsys)
    assert (tmp_path / "trial" / "results" / "report.html").stat().st_size > 100_000


@pytest.fixture(scope="module")
def drawing():
    """The script that draws the instrument."""
    pytest.importorskip("matplotlib")
    from experiments.inputs import draw_rig

    return draw_rig


def test_picture_from_above_obeys_the_conventions(drawing):
    """The drawing: S has X depth (up the page), Y left, Z up (to the reader); pan positive = left."""
    origin, x, y, z = drawing.seen_from_above(np.vstack([np.zeros(3), np.eye(3)]))
    assert (x - origin).tolist() == [0, 1]
    assert (y - origin).tolist() == [-1, 0]
    assert (z - origin).tolist() == [0, 0]
    ahead, left = (drawing.seen_from_above(drawing.beam_to_sheet(pan, 0.0, 275.0))[2] for pan in (0.0, 11.0))
    assert left[0] < ahead[0] - 10  # mm on the page
    # Positioner right of both cameras, aperture right of the positioner by the baseline.
    aperture = drawing.in_stereo(drawing.scanner_in_positioner([0.0, -drawing.BASELINE_MM / 2, 0.0]))
    assert drawing.T_SP_MM[1] < -drawing.CAMERA_PITCH_MM
    assert drawing.seen_from_above(aperture)[0] > drawing.seen_from_above(drawing.T_SP_MM)[0]
    assert np.linalg.norm(aperture - drawing.T_SP_MM) == pytest.approx(drawing.BASELINE_MM, abs=1e-9)


def test_oblique_picture_is_no_mirror_image(drawing):
    """Two page axes and the direction to the viewer are right-handed; z points up, mirror 2 lies right of mirror 1."""
    page = drawing.seen_obliquely(np.eye(3))
    viewer = drawing.VIEWER / np.linalg.norm(drawing.VIEWER)
    assert np.linalg.det(np.column_stack((page, viewer))) == pytest.approx(1.0, abs=1e-12)
    assert page[2].tolist()[0] == pytest.approx(0.0, abs=1e-12)
    assert page[2, 1] > 0.5
    second, direction = drawing.mirror_chain(0.0, 0.0, drawing.GEOMETRY)
    assert drawing.seen_obliquely(second)[0] > 5  # mm, of L = 30
    _, raised = drawing.mirror_chain(0.0, np.radians(10.0), drawing.GEOMETRY)
    assert drawing.seen_obliquely(raised - direction)[1] > 0.05


HALF_POINT = 0.5
"""Of the picture's lines, pt: less than the thinnest is long; another matplotlib may set text a little otherwise."""


def test_shipped_picture_is_that_of_the_script(drawing, tmp_path, monkeypatch):
    picture = tmp_path / "rig.svg"
    monkeypatch.setattr(drawing, "OUT", picture)
    monkeypatch.setattr("sys.argv", ["draw_rig"])
    drawing.main()
    texts = [path.read_text(encoding="utf-8") for path in (picture, ROOT / "data" / "tutorial" / "rig.svg")]
    words, shipped_words = (re.findall(r"<!-- (.*?) -->", text, flags=re.DOTALL) for text in texts)
    assert words == shipped_words
    assert {"S: stereo frame, Z up", "P: positioner frame, z up", "laser spot", "B", "C", "L"} <= set(words)
    lines = [" ".join(re.findall(r'clip-path="[^"]*"|<path d="([^"]*)"', text)) for text in texts]
    numbers, shipped = (np.array(re.findall(r"-?\d+(?:\.\d+)?", line), float) for line in lines)
    assert len(numbers) == len(shipped) > 500
    assert np.abs(numbers - shipped).max() < HALF_POINT
    # The label at the arc of the pan angle says "> 0: left".
    assert drawing.PAN_DEG > 0


@pytest.mark.slow
def test_the_steps_without_an_instrument_end_with_the_numbers_of_the_page(tmp_path, monkeypatch, capsys):
    """Six commands of instrument.md, then the sentence below them: looks, minutes, ratio, interval, truth."""
    page = (ROOT / "data" / "docs" / "instrument.md").read_text(encoding="utf-8")
    block, sentence = re.search(r"```sh\n(tvsbayes plan .*?)```\s+(The plan holds .*?)\n\n", page, re.DOTALL).groups()
    (tmp_path / "data").symlink_to(ROOT / "data")
    monkeypatch.chdir(tmp_path)
    with caching_in(tmp_path / "cache"):
        for line in block.splitlines():
            assert run(shlex.split(line)[1:]) == 0, line
    printed = capsys.readouterr().out
    left = json.loads((tmp_path / "run/results/fit.json").read_text())["effective_deg_per_step"]["left"]
    truth = json.loads((tmp_path / "run/truth.json").read_text())["effective_deg_per_step"]["left"]
    looks, minutes, *values = map(float, re.findall(r"\d+\.?\d*", sentence))
    shown = (float(re.search(rf"^{name} +([\d.]+)$", printed, re.M)[1]) for name in ("looks", "minutes"))
    assert [looks, minutes] == [round(value, 1) for value in shown]
    # To the digits that the page shows.
    np.testing.assert_allclose([left["value"], *left["interval95"], truth], values, rtol=0, atol=5.1e-5)
