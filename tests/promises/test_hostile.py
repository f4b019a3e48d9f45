"""Hostile campaign folders: every one is read or refused with its place, never a traceback.

The rows are threats to readers of TOML, JSON, CSV and paths; data/docs/campaign-files.md states what is allowed.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.hostile_folders import CRAFTED, MEGABYTE, TARGETS, good_folder, mutations, png, sealed
from support.small_campaign import small_campaign

from tvsbayes.acquisition.journal import LOG_ENTRIES_MAX, LOG_EVENTS_MAX, Journal, read_journal
from tvsbayes.acquisition.journal_check import repair, verify
from tvsbayes.calibration.calibration_file import read_draws
from tvsbayes.cameras.detection import detect
from tvsbayes.cli.app import report_line
from tvsbayes.cli.main import run
from tvsbayes.errors import DeviceFault, InputError, NotConverged
from tvsbayes.files.disk import output_place, read_arrays
from tvsbayes.files.images import decode_image
from tvsbayes.instrument.campaign import input_hashes, read_campaign, write_campaign
from tvsbayes.pipeline import StoredOrFitted

FILES = ("campaign.toml", "stereo.json", "moves.csv", "spots.csv")
Edit = Callable[[bytes], bytes]


@pytest.fixture
def folder(tmp_path) -> Path:
    """A good campaign; line 2 of spots.csv is spot 10, line 2 of moves.csv is move 0."""
    write_campaign(small_campaign(), tmp_path / "c")
    return tmp_path / "c"


def cell(line: int, column: str, value: str) -> Edit:
    """Replaces one cell of a CSV file (the header is line 1)."""

    def edit(data: bytes) -> bytes:
        lines = data.decode().split("\n")
        header = lines[0].split(",")
        # The sheet's name in quotes holds a comma: split outside quotes only.
        cells = re.findall(r'(?:"[^"]*"|[^,])+|(?<=,)(?=,|$)|^(?=,)', lines[line - 1])
        assert len(cells) == len(header)
        cells[header.index(column)] = value
        lines[line - 1] = ",".join(cells)
        return "\n".join(lines).encode()

    return edit


def swap(old: str, new: str) -> Edit:
    """Replaces the first occurrence of `old`, which must be there."""

    def edit(data: bytes) -> bytes:
        assert old.encode() in data
        return data.replace(old.encode(), new.encode(), 1)

    return edit


def whole(data: bytes) -> Edit:
    return lambda _: data


def header_only(data: bytes) -> bytes:
    return data.split(b"\n")[0] + b"\n"


def row_twice(data: bytes) -> bytes:
    return data + data.rstrip(b"\n").split(b"\n")[-1] + b"\n"


# name: (file, edit, line, column, code)
CASES: dict[str, tuple[str, Edit, int | None, str | None, str]] = {
    # spots.csv
    "nan": ("spots.csv", cell(2, "u_left_px", "nan"), 2, "u_left_px", "number"),
    "infinity": ("spots.csv", cell(3, "v_left_px", "infinity"), 3, "v_left_px", "number"),
    "1e999": ("spots.csv", cell(3, "v_left_px", "1e999"), 3, "v_left_px", "number"),
    "underscore": ("spots.csv", cell(4, "u_right_px", "9_4.7"), 4, "u_right_px", "number"),
    "arabic digits": ("spots.csv", cell(4, "u_right_px", "\u0661\u0662\u0663"), 4, "u_right_px", "number"),
    "fullwidth digits": ("spots.csv", cell(4, "u_right_px", "\uff11\uff12"), 4, "u_right_px", "number"),
    "decimal comma": ("spots.csv", cell(4, "u_right_px", "123,4"), 4, None, "row-length"),
    "quoted comma": ("spots.csv", cell(4, "u_right_px", '"123,4"'), 4, "u_right_px", "number"),
    "formula number": ("spots.csv", cell(2, "su_left_px", "=1+1"), 2, "su_left_px", "number"),
    "formula target": ("spots.csv", cell(3, "target", "=1+1"), 3, "target", "text"),
    "formula status": ("spots.csv", cell(3, "status", "@SUM(A1)"), 3, "status", "text"),
    "padded number": ("spots.csv", cell(2, "su_left_px", " 0.08"), 2, "su_left_px", "number"),
    "empty pixel": ("spots.csv", cell(5, "v_right_px", ""), 5, "v_right_px", "missing"),
    "empty sd": ("spots.csv", cell(5, "sv_right_px", ""), 5, "sv_right_px", "missing"),
    "zero sd": ("spots.csv", cell(5, "sv_right_px", "0"), 5, "sv_right_px", "number"),
    "negative sd": ("spots.csv", cell(5, "sv_right_px", "-0.08"), 5, "sv_right_px", "number"),
    "huge sd": ("spots.csv", cell(5, "sv_right_px", "101"), 5, "sv_right_px", "number"),
    "outside image": ("spots.csv", cell(6, "u_left_px", "1500"), 6, "u_left_px", "outside-image"),
    "above image": ("spots.csv", cell(6, "v_left_px", "-100"), 6, "v_left_px", "outside-image"),
    "duplicate id": ("spots.csv", cell(4, "spot", "10"), 4, "spot", "duplicate"),
    "duplicate id, padded": ("spots.csv", cell(4, "spot", "0010"), 4, "spot", "duplicate"),
    "negative id": ("spots.csv", cell(4, "spot", "-1"), 4, "spot", "integer"),
    "fractional id": ("spots.csv", cell(4, "spot", "14.0"), 4, "spot", "integer"),
    "huge id": ("spots.csv", cell(4, "spot", "9" * 5000), 4, "spot", "integer"),
    "missing move": ("spots.csv", cell(8, "move", "5"), 8, "move", "missing-move"),
    "empty move": ("spots.csv", cell(8, "move", ""), 8, "move", "integer"),
    "point 5": ("spots.csv", cell(2, "point", "5"), 2, "point", "integer"),
    "point without experiment": ("spots.csv", cell(2, "experiment", ""), 2, "experiment", "missing"),
    "experiment without point": ("spots.csv", cell(2, "point", ""), 2, "point", "missing"),
    "point twice": ("spots.csv", cell(3, "point", "1"), 3, "point", "duplicate"),
    "aperture": ("spots.csv", cell(2, "aperture_deg", "361"), 2, "aperture_deg", "number"),
    "correlation 1": ("spots.csv", cell(2, "ruv_left", "1"), 2, "ruv_left", "number"),
    "correlation empty": ("spots.csv", cell(2, "ruv_left", ""), 2, "ruv_left", "number"),
    "empty status": ("spots.csv", cell(2, "status", ""), 2, "status", "missing"),
    "long status": ("spots.csv", cell(2, "status", "x" * 201), 2, "status", "text"),
    "escape in status": ("spots.csv", cell(2, "status", "\x1b[2J"), 2, None, "control-character"),
    "bidi in target": ("spots.csv", cell(3, "target", "d\u202e1"), 3, "target", "text"),
    "nul": ("spots.csv", cell(3, "target", "d\0"), 3, None, "control-character"),
    "huge cell": ("spots.csv", cell(3, "target", "x" * 200_000), 3, None, "size"),
    "unclosed quote": ("spots.csv", cell(3, "target", '"d1'), 3, None, "csv"),
    "unknown column": ("spots.csv", swap("aperture_deg", "apertur_deg"), 1, "apertur_deg", "unknown-column"),
    "missing column": ("spots.csv", whole(b"spot,move\n"), 1, "target", "missing-column"),
    "column twice": ("spots.csv", swap("v_left_px", "u_left_px"), 1, "u_left_px", "duplicate-column"),
    "spaced column": ("spots.csv", swap(",move", ", move"), 1, " move", "unknown-column"),
    "row too long": (
        "spots.csv",
        lambda d: d.replace(b"\n", b",1\n").replace(b",1\n", b"\n", 1),
        2,
        None,
        "row-length",
    ),
    "semicolons": ("spots.csv", lambda d: d.replace(b",", b";"), 1, None, "csv"),
    "latin-1": ("spots.csv", lambda d: d.replace(b"d1", b"d\xe9", 1), 3, None, "encoding"),
    "utf-16": ("spots.csv", lambda d: d.decode().encode("utf-16"), None, None, "encoding"),
    "empty spots": ("spots.csv", whole(b""), 1, None, "empty"),
    "binary": ("spots.csv", whole(bytes(range(256))), None, None, "encoding"),
    # moves.csv
    "gap in moves": ("moves.csv", cell(4, "move", "3"), 4, "move", "order"),
    "moves from 1": ("moves.csv", cell(2, "move", "1"), 2, "move", "order"),
    "decreasing times": ("moves.csv", cell(4, "time_s", "1.4"), 4, "time_s", "order"),
    "nan time": ("moves.csv", cell(4, "time_s", "nan"), 4, "time_s", "number"),
    "segment from 1": ("moves.csv", cell(2, "segment", "1"), 2, "segment", "order"),
    "segment falls": ("moves.csv", cell(6, "segment", "0"), 6, "segment", "order"),
    "segment jumps": ("moves.csv", cell(6, "segment", "3"), 6, "segment", "order"),
    "float counter": ("moves.csv", cell(3, "pan_steps", "200.0"), 3, "pan_steps", "integer"),
    "huge counter": ("moves.csv", cell(3, "pan_steps", "100000001"), 3, "pan_steps", "integer"),
    "exponent counter": ("moves.csv", cell(3, "tilt_steps", "1e3"), 3, "tilt_steps", "integer"),
    "no approach": ("moves.csv", cell(5, "pan_approach", ""), 5, "pan_approach", "approach"),
    "approach inside": ("moves.csv", cell(4, "tilt_approach", "up"), 4, "tilt_approach", "approach"),
    "approach of pan": ("moves.csv", cell(2, "pan_approach", "up"), 2, "pan_approach", "approach"),
    "approach in capitals": ("moves.csv", cell(2, "pan_approach", "Left"), 2, "pan_approach", "approach"),
    "no moves": ("moves.csv", header_only, 1, None, "empty"),
    "last move twice": ("moves.csv", row_twice, 7, "move", "order"),
    # campaign.toml
    "format": ("campaign.toml", swap("campaign/1", "campaign/2"), 1, "format", "word"),
    "unknown key": ("campaign.toml", swap("name =", "nme ="), 2, "nme", "unknown-key"),
    "name is a number": ("campaign.toml", swap('"two lines', '1 # "'), 6, "notes", "text"),
    "created is text": ("campaign.toml", swap("2026-01-15T10:00:00+00:00", '"today"'), 3, "created", "date"),
    "synthetic is text": ("campaign.toml", swap("false", '"false"'), 4, "synthetic", "boolean"),
    "negative seed": ("campaign.toml", swap("seed = 7", "seed = -7"), 5, "seed", "integer"),
    "escape in name": ("campaign.toml", swap('name = "', 'name = "\\u001b[2J'), 2, "name", "text"),
    "long name": ("campaign.toml", swap('name = "', 'name = "' + "x" * 300), 2, "name", "text"),
    "environment key": (
        "campaign.toml",
        swap("temperature_degC", "temperature_K"),
        8,
        "environment.temperature_K",
        "unknown-key",
    ),
    "temperature": (
        "campaign.toml",
        swap("value = 21.0", "value = 1e999"),
        8,
        "environment.temperature_degC.value",
        "number",
    ),
    "certificate": ("campaign.toml", swap('"B-17"', "17"), 10, "traceability.board_certificate", "text"),
    "calibration date": (
        "campaign.toml",
        swap("2026-01-03", "2026"),
        11,
        "traceability.stereo_calibrated",
        "date",
    ),
    "rig nan": ("campaign.toml", swap("value = 200.0", "value = nan"), 14, "rig.baseline_mm.value", "number"),
    "rig is an array": ("campaign.toml", swap("[rig]", "[[rig]]"), 12, "rig", "table"),
    "key twice": ("campaign.toml", swap("seed = 7", "seed = 7\nseed = 7"), 6, None, "toml"),
    "brackets": ("campaign.toml", swap("seed = 7", "seed = " + "[" * 10_000), 5, None, "nesting"),
    "40 000 parts": ("campaign.toml", whole(b"a." * 20_000 + b"a = 1\n"), 1, None, "nesting"),
    "toml too large": ("campaign.toml", lambda d: d + b"#" * 70_000, None, None, "size"),
    "toml nul": ("campaign.toml", swap("two lines", "two\0lines"), 6, None, "control-character"),
    "toml empty": ("campaign.toml", whole(b""), None, "format", "missing-key"),
    # stereo.json
    "json nan": ("stereo.json", swap("802.0", "NaN"), 6, None, "number"),
    "json 1e999": ("stereo.json", swap("802.0", "1e999"), 6, None, "number"),
    "json text": ("stereo.json", swap("802.0", '"802"'), 5, "M1", "matrix"),
    "json key twice": ("stereo.json", swap('"rms_px"', '"T"'), None, None, "duplicate-key"),
    "json brackets": ("stereo.json", whole(b"[" * 100_000), 1, None, "nesting"),
    "json too large": ("stereo.json", lambda d: d + b" " * 5_000_000, None, None, "size"),
    "json empty": ("stereo.json", whole(b""), 1, None, "json"),
    "json list": ("stereo.json", whole(b"[]"), 1, None, "json"),
    "no rotation": ("stereo.json", swap('"R": [\n  [0.99', '"R": [\n  [0.98'), 15, "R", "rotation"),
    "surrogate key": ("stereo.json", swap('"rms_px"', '"\\ud800"'), None, "\\ud800", "unknown-key"),
}


@pytest.mark.parametrize("name", CASES)
def test_a_hostile_folder_is_refused_with_its_place(folder, name):
    file, edit, line, column, code = CASES[name]
    path = folder / file
    path.write_bytes(edit(path.read_bytes()))
    with pytest.raises(InputError) as caught:
        read_campaign(folder)
    error = caught.value
    assert (error.file, error.code) == (file, code)
    assert error.column == column
    if line is not None:
        assert error.line == line
    assert error.exit_code == 2 and error.found and error.allowed and error.remedy
    # A message goes to a terminal and into JSON: printable, encodable, short.
    assert error.message.isprintable() and error.message.encode() and len(error.message) < 1200


@pytest.mark.parametrize("file", FILES)
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


def test_no_folder_and_a_file_in_its_place(folder):
    for place in (folder / "nowhere", folder / "spots.csv", folder / "a\x1bb"):
        with pytest.raises(InputError, match="a campaign folder") as caught:
            read_campaign(place)
        assert caught.value.code == "missing-file" and caught.value.message.isprintable()


def test_a_link_to_the_folder_is_accepted(folder, tmp_path):
    (tmp_path / "link").symlink_to(folder)
    assert read_campaign(tmp_path / "link").moves == small_campaign().moves


@pytest.fixture(scope="module")
def good(tmp_path_factory) -> Path:
    """A folder with a journal, results, frames and all else; every test leaves it as it is."""
    return good_folder(tmp_path_factory.mktemp("good") / "c")


@pytest.mark.thorough
def test_random_mutations_are_read_or_refused(good):
    """1300 seeded mutations of a good folder: success or a documented error, whatever else is a defect."""
    refused = dict.fromkeys(TARGETS, 0)
    for outcome in mutations(good, range(1300), 20260115):
        if outcome.error is not None:
            refused[outcome.target] += 1
            message = outcome.error.message
            assert message.isprintable() and message.encode() and len(message) < 1200, message
    # A changed digit or name may pass; without refused mutations the test would be empty.
    assert all(10 < count for count in refused.values()), refused


def test_mutations_take_little_memory(good):
    """The files hold 0.1 MB; reading them may take a hundred times as much."""
    peaks = [outcome.peak_bytes for outcome in mutations(good, range(130), 7, traced=True)]
    assert max(peaks) < 20 * MEGABYTE


def place_of(good: Path, tmp_path: Path) -> Path:
    """A copy to make hostile; its parent holds nothing else."""
    return Path(shutil.copytree(good, tmp_path / "in" / "c"))


def outside(tmp_path: Path) -> dict[str, bytes]:
    """Files beside the folder."""
    files = (path for path in (tmp_path / "in").rglob("*") if path.is_file())
    inside = tmp_path / "in" / "c"
    return {str(path): path.read_bytes() for path in files if not path.is_relative_to(inside)}


LIGHT = {
    name: crafted
    for name, crafted in CRAFTED.items()
    if not crafted.large
    and crafted.codes == {2}
    and any(c.startswith(("check @", "classic")) for c in crafted.commands)
}


@pytest.mark.parametrize("name", LIGHT)
def test_crafted_folders_are_refused_by_the_commands(good, tmp_path, capsys, name):
    folder = place_of(good, tmp_path)
    LIGHT[name].edit(folder)
    before = outside(tmp_path)
    for command in LIGHT[name].commands:
        if command.startswith(("check", "classic")):
            code = run(shlex.split(command.replace("@", str(folder))))
            output = capsys.readouterr()
            assert code == 2 and "Traceback" not in output.err and "\x1b" not in output.out + output.err
    assert outside(tmp_path) == before


ARCHIVES = [name for name, crafted in CRAFTED.items() if crafted.threat == "pickle, npz, npy" and not crafted.large]


@pytest.mark.parametrize("name", ARCHIVES)
def test_hostile_archives_use_no_memory_and_run_no_commands(good, tmp_path, monkeypatch, name):
    """NumPy's own reader would make gigabytes of 0.5 kB, zipfile of 1 kB."""
    folder = place_of(good, tmp_path)
    monkeypatch.chdir(tmp_path)
    CRAFTED[name].edit(folder)
    tracemalloc.start()
    try:
        with pytest.raises(InputError) as caught:
            read_draws(folder / "results" / "draws.npz")
        assert tracemalloc.get_traced_memory()[1] < 20 * MEGABYTE
    finally:
        tracemalloc.stop()
    assert caught.value.code == "damaged-results" and caught.value.message.isprintable()
    assert not (tmp_path / "pwned").exists()


def test_arrays_come_back_as_they_were_written(tmp_path):
    arrays = {
        "fortran": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        "text": np.array(["a", "bcd"]),
        "flag": np.array(True),
        "none": np.zeros((0, 4, 4)),
        "counts": np.arange(5, dtype=np.uint32),
    }
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "a.npz", **arrays)
        again = read_arrays(tmp_path / "a.npz", MEGABYTE)
        assert set(again) == set(arrays)
        for name, array in arrays.items():
            assert again[name].dtype == array.dtype
            np.testing.assert_array_equal(again[name], array)
    np.savez_compressed(tmp_path / "b.npz", zeros=np.zeros(MEGABYTE))
    assert (tmp_path / "b.npz").stat().st_size < MEGABYTE
    with pytest.raises(ValueError, match="unpacked"):
        read_arrays(tmp_path / "b.npz", MEGABYTE)


def test_results_are_not_written_through_a_link(good, tmp_path):
    """A hostile `results` may link into a home directory."""
    folder = place_of(good, tmp_path)
    assert output_place(folder, "results", "overlay") == folder / "results" / "overlay"
    CRAFTED["results folder links outside"].edit(folder)
    for names in (("results",), ("results", "overlay")):
        with pytest.raises(InputError) as caught:
            output_place(folder, *names)
        assert caught.value.code == "path" and "--out" in caught.value.message
    before = outside(tmp_path)
    assert run(["report", str(folder)]) == 2
    assert run(["detect", str(folder), "--overlay"]) == 2
    assert outside(tmp_path) == before


def test_a_log_is_capped_in_events_and_entries(good, tmp_path):
    folder = place_of(good, tmp_path)
    for make, what in (
        (lambda: b"\n" * (LOG_EVENTS_MAX + 1), "events"),
        (lambda: b"[" * (LOG_ENTRIES_MAX + 1), "entries"),
    ):
        (folder / "journal" / "log.jsonl").write_bytes(make())
        for read in (read_journal, lambda place: repair(place, tmp_path / "repaired")):
            with pytest.raises(InputError, match=what) as caught:
                read(folder / "journal")
            assert caught.value.code == "size"
    assert not (tmp_path / "repaired").exists()


def test_a_full_journal_is_reported_and_stays_readable(tmp_path, monkeypatch):
    monkeypatch.setattr("tvsbayes.acquisition.journal.LOG_EVENTS_MAX", 3)
    journal = Journal.create(tmp_path / "run")
    for step in range(2):
        journal.append("intent", step=step)
    with pytest.raises(DeviceFault) as caught:
        journal.append("intent", step=2)
    assert caught.value.code == "journal-full"
    assert len(read_journal(tmp_path / "run").records) == 3


def test_a_frame_named_twice_is_read_once(good, tmp_path):
    folder = place_of(good, tmp_path) / "journal"
    lines = (folder / "log.jsonl").read_bytes().split(b"\n")
    looked = [k for k, line in enumerate(lines) if b"looked" in line]
    lines[looked[1]] = lines[looked[1]].replace(b"000001_left", b"000000_left")
    (folder / "log.jsonl").write_bytes(sealed(b"\n".join(lines)))
    with pytest.raises(InputError, match="a frame that an event before it names"):
        verify(folder)
    done = repair(folder, tmp_path / "repaired")
    assert done.lost_frames == ["frames/000000_left.png"]


def test_a_report_does_not_use_the_fit_of_other_data(good, tmp_path, monkeypatch):
    """`fit.json` of other data beside `draws.npz` of these: fit again, never combine."""
    folder = place_of(good, tmp_path)
    data = read_campaign(folder)
    assert StoredOrFitted(data, report_line).record.provenance.inputs == input_hashes(data)
    CRAFTED["fit.json of other data"].edit(folder)

    def fitted(campaign, tell, progress):
        raise NotConverged("not-converged", "fitted anew", remedy="-")

    monkeypatch.setattr("tvsbayes.pipeline._converged_fit", fitted)
    with pytest.raises(NotConverged, match="fitted anew"):
        _ = StoredOrFitted(data, report_line).record


@pytest.mark.parametrize(
    ("key", "value", "column"),
    [
        ("verdict", 5, "held_out.verdict"),
        ("classic", None, "held_out.classic"),
        ("joint", {"rms_deg": "0.1"}, "held_out.joint.rms_deg"),
        ("unseen", {"<b>": 1.0}, "held_out.unseen.<b>"),
        ("unseen", [], "held_out.unseen"),
    ],
)
def test_a_damaged_comparison_is_refused_by_key(good, tmp_path, key, value, column):
    from tvsbayes.results.comparison_record import stored_hold_out
    from tvsbayes.results.records import plain

    folder = place_of(good, tmp_path)
    path, data = folder / "results" / "compare.json", read_campaign(folder)
    document = json.loads(path.read_text())
    inputs = document["inputs"]
    assert plain(stored_hold_out(data, inputs)) == document["held_out"]
    assert stored_hold_out(data, {}) is None
    document["held_out"][key] = value
    path.write_text(json.dumps(document))
    with pytest.raises(InputError) as caught:
        stored_hold_out(data, inputs)
    assert caught.value.column == column


def test_frames_of_another_size_are_refused_before_they_are_decoded(good, tmp_path, monkeypatch):
    folder = place_of(good, tmp_path)
    (folder / "frames" / "000010_left.png").write_bytes(png(1000, 1000))

    decoded = []

    def noted(data, file):
        decoded.append(file)
        return decode_image(data, file)

    monkeypatch.setattr("tvsbayes.cameras.detection.decode_image", noted)
    with pytest.raises(InputError) as caught:
        detect(read_campaign(folder))
    assert caught.value.code == "image-size" and caught.value.file == "000010_left.png"
    assert "000010_left.png" not in decoded


def test_boards_of_too_many_pixels_are_refused_before_they_are_decoded(tmp_path, monkeypatch):
    from tvsbayes.cameras import boards

    def decoded(path, folder):
        raise AssertionError("decoded")

    monkeypatch.setattr(boards, "read_image", decoded)
    (tmp_path / "left01.png").write_bytes(png(5001, 4000, raw=b""))
    with pytest.raises(InputError) as caught:
        boards.find_views(tmp_path, boards.Board.named("9x6", 20.0))
    assert caught.value.code == "image-size" and "20 million" in caught.value.message
    for name in ("left01.png", "right01.png"):
        (tmp_path / name).write_bytes(png(5000, 4000, raw=b""))
    with pytest.raises(AssertionError, match="decoded"):
        boards.find_views(tmp_path, boards.Board.named("9x6", 20.0))
