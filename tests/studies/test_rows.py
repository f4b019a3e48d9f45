"""The file of rows: designs apart, foreign files and places that cannot be written refused."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import pytest
from support.invented_studies import invented, sweep

from tvsbayes.errors import InputError
from tvsbayes.planning.target import parse_target
from tvsbayes.studies.rows import StudyRow, StudyRows
from tvsbayes.studies.study import study


def test_one_file_keeps_designs_apart(job, quick, tmp_path, mounted_rig, monkeypatch):
    path = tmp_path / "rows.jsonl"
    study(job, 3, StudyRows(path))
    others = (
        replace(job, seed=8),
        replace(job, aperture=True),
        replace(job, estimator="laplace"),
        replace(job, steps=sweep(("d1",))),
        replace(job, target=parse_target("u(left) <= 1e-3 deg/step")),
        replace(job, rig=replace(mounted_rig, sheets_mm={**mounted_rig.sheets_mm, "d1": 176.0})),
        replace(job, rig=replace(mounted_rig, cameras={**mounted_rig.cameras, "spot_sd_px": 0.1})),
        replace(
            job, rig=replace(mounted_rig, truth={**mounted_rig.truth, "pixel_scale": mounted_rig.truth["focal_scale"]})
        ),
    )
    assert len({job.key, *(other.key for other in others)}) == 1 + len(others)
    for other in others:
        assert StudyRows(path).of(other.key) == {}
    # Rows of another release answer another question.
    monkeypatch.setattr("tvsbayes.studies.study_job.own_version", lambda: "0.0.1")
    assert StudyRows(path).of(replace(job).key) == {}
    assert sorted(StudyRows(path).of(job.key)) == [0, 1, 2]


@pytest.mark.parametrize("line", ["{", "[]", "1", '{"format": "tvsbayes-study/1"}', '{"a": 1}'])
def test_a_foreign_file_is_refused_with_its_line(job, quick, tmp_path, line):
    path = tmp_path / "rows.jsonl"
    study(job, 2, StudyRows(path))
    path.write_text(path.read_text() + line + "\n")
    with pytest.raises(InputError, match="line 3 is no row"):
        StudyRows(path)


def test_a_foreign_line_without_an_end_is_no_torn_row(tmp_path, job):
    """A foreign only line is kept; the torn beginning of a first row is cut off."""
    path = tmp_path / "truth.json"
    for text in (b'{"my": "only copy"}', b"\x00\x00", b"x"):
        path.write_bytes(text)
        with pytest.raises(InputError, match="line 1 is no row"):
            StudyRows(path)
        assert path.read_bytes() == text
    StudyRows(tmp_path / "whole").append(invented(job, 0))
    line = (tmp_path / "whole").read_bytes()
    for kept in (1, 20, len(line) - 1):
        path.write_bytes(line[:kept])
        StudyRows(path).append(invented(job, 0))
        assert path.read_bytes() == line


def test_a_second_study_cuts_off_nothing_that_the_first_has_written(tmp_path, job):
    """It begins while a row is half on disk, and adds its own after that row has become whole."""
    path = tmp_path / "rows.jsonl"
    first = StudyRows(path)
    first.append(invented(job, 0))
    first.append(invented(job, 1))
    data = path.read_bytes()
    path.write_bytes(data[:-30])
    second = StudyRows(path)
    path.write_bytes(data)
    second.append(invented(job, 2))
    first.append(invented(job, 3))
    assert path.read_bytes().startswith(data) and sorted(StudyRows(path).of(job.key)) == [0, 1, 2, 3]


def edited(line: str, **numbers: object) -> str:
    """A line with other numbers, and the hash of the true ones."""
    return json.dumps({**json.loads(line), **numbers})


@pytest.mark.parametrize(
    "forge",
    [
        lambda line: edited(line, target=1e-9),
        lambda line: edited(line, index=7),
        lambda line: json.dumps({k: v for k, v in json.loads(line).items() if k != "sha256"}),
        lambda line: re.sub(r'"pit": [^,]*,', '"pit": 0.5,', line, count=1),
    ],
)
def test_a_row_that_does_not_say_what_was_written_is_made_again(job, quick, tmp_path, forge):
    path = tmp_path / "rows.jsonl"
    whole = study(job, 3, StudyRows(path))
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0], forge(lines[1]), lines[2]]) + "\n")
    stored = StudyRows(path)
    assert stored.damaged(job.key) == [2] and sorted(stored.of(job.key)) == [0, 2]
    quick.clear()
    assert study(job, 3, stored) == whole and quick == [1]
    assert sorted(StudyRows(path).of(job.key)) == [0, 1, 2], "the good row that was added counts"


def test_rows_that_cannot_be_written_are_refused_before_the_first_fit(tmp_path):
    with pytest.raises(InputError) as error:
        StudyRows(tmp_path / "no such folder" / "rows.jsonl")
    StudyRows(tmp_path / "rows.jsonl")
    assert list(tmp_path.iterdir()) == [], "nothing is written before there is a row"
    assert error.value.code == "write" and "--rows" in error.value.remedy


def test_a_file_that_takes_no_row_is_refused_before_the_first_fit(tmp_path, monkeypatch):
    """By trying: root may write whatever `access` states, but not a file that is immutable."""
    path = tmp_path / "rows.jsonl"
    path.touch()
    taken = type(path).open

    def refused(self, mode="r", *rest, **more):
        if "a" in mode:
            raise PermissionError(1, "Operation not permitted")
        return taken(self, mode, *rest, **more)

    monkeypatch.setattr(type(path), "open", refused)
    with pytest.raises(InputError, match="found Operation not permitted"):
        StudyRows(path)


def test_a_row_is_read_as_it_was_written(job):
    """Also one whose fit failed, which has neither headlines nor a target."""
    failed = StudyRow(job.key, 4, 1, False, 2, ("did not settle",), 1.0)
    for row in (invented(job, 1), failed):
        document = json.loads(json.dumps(row.as_json(), allow_nan=False))
        assert StudyRow.from_json(document) == row
    without = {"design", "index", "seed", "estimator", "converged", "unseen", "problems", "seconds"}
    assert set(failed.as_json()) == without
    # Rows of the days when there was one estimator.
    older = {key: value for key, value in failed.as_json().items() if key != "estimator"}
    assert StudyRow.from_json(older).estimator == "laplace"
