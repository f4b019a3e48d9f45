"""Hostile campaign folders: every one is read or refused with its place, never a traceback.

data/docs/campaign-files.md states what is allowed. Refusals by form alone (numbers, rows, nesting, encodings) are those
of `tests/files`; here are those of what a file means, of edits that Hypothesis makes, and of crafted folders.
"""

from __future__ import annotations

import csv
import io
import os
import shlex
import shutil
from collections import Counter
from functools import partial
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.hostile_folders import (
    CRAFTED,
    FIT,
    TARGETS,
    change,
    edited_files,
    good_folder,
    outcome,
    printable,
)
from support.small_campaign import small_campaign

from tvsbayes.acquisition.journal import read_journal
from tvsbayes.calibration.calibration_file import read_draws
from tvsbayes.cli.app import report_line
from tvsbayes.cli.main import run
from tvsbayes.errors import InputError, NotConverged, TvsError
from tvsbayes.instrument.campaign import input_hashes, read_campaign, write_campaign
from tvsbayes.instrument.plan import read_plan
from tvsbayes.instrument.rig import read_rig
from tvsbayes.instrument.stereo_pair import read_stereo
from tvsbayes.pipeline import StoredOrFitted
from tvsbayes.results.fit_record import read_fit


@pytest.fixture(scope="module")
def good(tmp_path_factory) -> Path:
    """A folder with a journal, results, frames and all else; every test leaves it as it is."""
    return good_folder(tmp_path_factory.mktemp("good") / "c")


@pytest.fixture
def folder(tmp_path) -> Path:
    """A good campaign."""
    write_campaign(small_campaign(), tmp_path / "c")
    return tmp_path / "c"


def refused(good: Path, target: str, content: bytes) -> InputError:
    """How a file with other content is refused."""
    error = outcome(good, TARGETS[target], content).error
    assert isinstance(error, InputError) and error.found and error.allowed
    return error


# (file, line, column): cells that are refused there, with the code. Line 2 of spots.csv is spot 10.
CELLS: dict[tuple[str, int, str], dict[str, str]] = {
    ("spots.csv", 4, "spot"): {"10": "duplicate", "0010": "duplicate", "-1": "integer"},
    ("spots.csv", 8, "move"): {"5": "missing-move", "": "integer"},
    ("spots.csv", 3, "target"): {"d\u202e1": "text"},
    ("spots.csv", 2, "experiment"): {"": "missing"},
    ("spots.csv", 2, "point"): {"5": "integer", "": "missing"},
    ("spots.csv", 3, "point"): {"1": "duplicate"},
    ("spots.csv", 6, "u_left_px"): {"nan": "number", "1500": "outside-image"},
    ("spots.csv", 6, "v_left_px"): {"-100": "outside-image"},
    ("spots.csv", 5, "v_right_px"): {"": "missing"},
    ("spots.csv", 5, "sv_right_px"): {"": "missing", "0": "number", "-0.08": "number", "101": "number"},
    ("spots.csv", 2, "aperture_deg"): {"361": "number"},
    ("spots.csv", 2, "status"): {"": "missing", "x" * 201: "text"},
    ("spots.csv", 2, "ruv_left"): {"1": "number", "": "number"},
    ("moves.csv", 2, "move"): {"1": "order"},
    ("moves.csv", 4, "move"): {"3": "order"},
    ("moves.csv", 4, "time_s"): {"1.4": "order"},
    ("moves.csv", 2, "segment"): {"1": "order"},
    ("moves.csv", 6, "segment"): {"0": "order", "3": "order"},
    ("moves.csv", 3, "pan_steps"): {"100000001": "integer"},
    ("moves.csv", 5, "pan_approach"): {"": "approach"},
    ("moves.csv", 4, "tilt_approach"): {"up": "approach"},
    ("moves.csv", 2, "pan_approach"): {"up": "approach"},
    ("plan.csv", 2, "action"): {"rm -rf": "action"},
}


@pytest.mark.parametrize(("file", "line", "column"), CELLS)
def test_a_hostile_cell_is_refused_with_its_place(good, file, line, column):
    for value, code in CELLS[file, line, column].items():
        rows = list(csv.reader(io.StringIO((good / file).read_text())))
        rows[line - 1][rows[0].index(column)] = value
        csv.writer(table := io.StringIO(), lineterminator="\n").writerows(rows)
        error = refused(good, file, table.getvalue().encode())
        assert (error.code, error.line, error.column) == (code, line, column)


MANY = "[rig.prior]\n" + "".join(f"a{k}=1\n" for k in range(7900))
# (file, what gives way, to what, line, column, code); the empty text is the whole file.
REFUSED = (
    ("moves.csv", "", "move,segment,time_s,pan_steps,tilt_steps,pan_approach,tilt_approach\n", 1, None, "empty"),
    ("campaign.toml", "campaign/1", "campaign/2", 1, "format", "word"),
    ("campaign.toml", "name =", "nme =", 2, "nme", "unknown-key"),
    ("campaign.toml", '"two lines', '1 # "', 6, "notes", "text"),
    ("campaign.toml", "2026-01-15T10:00:00+00:00", '"today"', 3, "created", "date"),
    ("campaign.toml", "false", '"false"', 4, "synthetic", "boolean"),
    ("campaign.toml", "seed = 7", "seed = -7", 5, "seed", "integer"),
    ("campaign.toml", 'name = "', 'name = "\\u001b[2J', 2, "name", "text"),
    ("campaign.toml", 'name = "', 'name = "' + "x" * 300, 2, "name", "text"),
    ("campaign.toml", "temperature_degC", "temperature_K", 8, "environment.temperature_K", "unknown-key"),
    ("campaign.toml", "21.0", "1e999", 8, "environment.temperature_degC.value", "number"),
    ("campaign.toml", '"B-17"', "17", 10, "traceability.board_certificate", "text"),
    ("campaign.toml", "2026-01-03", "2026", 11, "traceability.stereo_calibrated", "date"),
    ("campaign.toml", "value = 200.0", "value = nan", 14, "rig.baseline_mm.value", "number"),
    ("campaign.toml", "[rig]", "[[rig]]", 12, "rig", "table"),
    ("campaign.toml", "[rig.prior]", MANY, 20, "rig.prior.a0", "unknown-key"),
    ("campaign.toml", "", "\n", None, "format", "missing-key"),
    ("stereo.json", '"rms_px"', '"\\ud800"', None, "\\ud800", "unknown-key"),
    ("camera.yml", "", "a: " + "[" * 100_000, None, None, "container"),
    ("camera.yml", "M1:", ":", None, None, "container"),
    ("camera.yml", "rows: 3", "rows: [3]", None, "M1", "matrix"),
    ("camera.yml", "3\n   cols: 3", "100000\n   cols: 100000", None, "M1", "matrix"),
    ("fit.json", '"problems": [', '"problems": ["\\u2028"', None, "problems", "schema"),
    ("compare.json", '"joint",\n', "5,\n", None, "held_out.verdict", "schema"),
    ("compare.json", '"classic": {', '"classic": null, "x": {', None, "held_out.classic", "table"),
    ("compare.json", '"rms_deg": 0.1', '"rms_deg": "0.1"', None, "held_out.classic.rms_deg", "schema"),
    ("compare.json", '"left": 0.0001', '"<b>": 1.0', None, "held_out.unseen.<b>", "schema"),
    ("compare.json", '"unseen": {', '"unseen": [], "x": {', None, "held_out.unseen", "schema"),
    ("compare.json", '"by"', '"\\ud800": 1, "by"', None, "held_out.\\ud800", "schema"),
)


@pytest.mark.parametrize("case", REFUSED, ids=lambda case: f"{case[0]}-{case[1]}-{case[2]}"[:50])
def test_a_hostile_text_is_refused_with_its_place(good, case):
    file, old, new, line, column, code = case
    text = (good / TARGETS[file].file).read_text()
    assert old in text
    error = refused(good, file, (text.replace(old, new, 1) if old else new).encode())
    assert (error.code, error.column) == (code, column) and (line is None or error.line == line)


@pytest.mark.parametrize("file", ("campaign.toml", "stereo.json", "moves.csv", "spots.csv"))
def test_anything_but_a_file_is_refused(folder, tmp_path, file):
    path = folder / file
    content = path.read_bytes()

    def refused() -> str:
        with pytest.raises(InputError) as caught:
            read_campaign(folder)
        assert caught.value.file == file
        return caught.value.code

    path.unlink()
    assert refused() == "missing-file"
    os.mkfifo(path)
    assert refused() == "not-a-file"
    path.unlink()
    path.mkdir()
    assert refused() == "not-a-file"
    path.rmdir()
    (tmp_path / file).write_bytes(content)
    path.symlink_to(tmp_path / file)
    assert refused() == "path"
    path.unlink()
    path.symlink_to(folder.parent / "c" / file)
    assert refused() == "unreadable"  # a link to itself
    path.unlink()
    path.symlink_to("/dev/zero")
    assert refused() == "path"


def test_a_link_to_the_folder_is_accepted(folder, tmp_path):
    (tmp_path / "link").symlink_to(folder)
    assert read_campaign(tmp_path / "link").moves == small_campaign().moves


def files_of(place: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in place.rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    ("examples", "traced"), [(10, True), pytest.param(100, False, marks=pytest.mark.thorough)], ids=("few", "many")
)
@pytest.mark.parametrize("name", TARGETS)
def test_edited_files_are_read_or_refused(good, name, examples, traced):
    """With a printable message that names the file, in little memory, and nothing else is touched."""
    codes: Counter[str] = Counter()
    before = files_of(good.parent)
    assert outcome(good, TARGETS[name], (good / TARGETS[name].file).read_bytes()).error is None
    edited_files(good, TARGETS[name], examples, lambda seen: codes.update([seen.code]), traced)
    assert files_of(good.parent) == before
    # A changed digit or name may pass; without refused edits the test would be empty.
    assert codes.total() - codes["read"] > examples / 2, codes


NAMES = st.text(st.characters(codec="utf-8"), max_size=60) | st.binary(max_size=200).map(os.fsdecode)
READERS = (read_campaign, read_rig, read_stereo, read_plan, read_fit, read_draws, read_journal)


def test_any_name_of_a_file_can_be_printed(tmp_path):
    """Of one that is missing, or that is no file of ours, nor a folder."""

    @settings(max_examples=40, derandomize=True, deadline=None, database=None)
    @given(NAMES.map(lambda name: "n" + name.replace("/", "").replace("\0", "")))
    def refused(name: str) -> None:
        path = tmp_path / name
        for make in (lambda: None, partial(path.write_bytes, b"\xff")):
            make()
            for read in READERS:
                with pytest.raises(TvsError) as caught:
                    read(path)
                assert printable(caught.value)
        path.unlink()

    refused()


LIGHT = [name for name, crafted in CRAFTED.items() if crafted.codes == {2} and not crafted.large]


@pytest.mark.parametrize("name", LIGHT)
def test_crafted_folders_are_refused_and_do_no_harm(good, tmp_path, capsys, monkeypatch, name):
    """By the commands that read them; NumPy's own reader would make gigabytes of 0.5 kB, zipfile of 1 kB."""
    folder = Path(shutil.copytree(good, tmp_path / "c"))
    monkeypatch.chdir(tmp_path)
    CRAFTED[name].spoil(folder)
    before = files_of(tmp_path)
    for command in CRAFTED[name].commands:
        code = run(shlex.split(command.replace("@", str(folder))))
        output = capsys.readouterr()
        assert code == 2 and "Traceback" not in output.err and "\x1b" not in output.out + output.err
    assert files_of(tmp_path) == before
    if "npz" in name:
        result = outcome(folder, TARGETS["draws.npz"], (folder / "results" / "draws.npz").read_bytes(), traced=True)
        assert result.error.code == "damaged-results"


def test_a_report_does_not_use_the_fit_of_other_data(good, tmp_path, monkeypatch):
    """`fit.json` of other data beside `draws.npz` of these: fit again, never combine."""
    folder = Path(shutil.copytree(good, tmp_path / "c"))
    data = read_campaign(folder)
    assert StoredOrFitted(data, report_line).reported.record.provenance.inputs == input_hashes(data)
    change(folder / FIT, **{"inputs/spots": "0" * 64})

    def fitted(*_, **__):
        raise NotConverged("not-converged", "fitted anew", remedy="-")

    monkeypatch.setattr("tvsbayes.pipeline.calibrate", fitted)
    with pytest.raises(NotConverged, match="fitted anew"):
        _ = StoredOrFitted(data, report_line).reported.record
