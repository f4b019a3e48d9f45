"""Studies: counts with their bounds; resumed where they were killed, the same numbers on every engine."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest
from support.invented_studies import invented
from support.waits import check_forward

from tvsbayes.errors import NotConverged
from tvsbayes.instrument.parameters import TARGETS
from tvsbayes.report.command_text import study_text
from tvsbayes.studies.rows import HeadlineRow, StudyRow, StudyRows
from tvsbayes.studies.study import study, study_result


def test_a_study_goes_on_where_it_was_killed(job, quick, tmp_path):
    """The last row is torn, as a kill in the middle of a write leaves it: it is made again, the others are not."""
    path = tmp_path / "rows.jsonl"
    waits = []
    whole = study(job, 9, StudyRows(path), progress=waits.append)
    check_forward(waits)
    assert [state.doing for state in waits[:-1]] == [f"campaigns: {n} of 9" for n in range(10)]
    data = path.read_bytes()
    assert data.count(b"\n") == 9
    cut = data[: data.rfind(b"\n", 0, -1) + 40]
    path.write_bytes(cut)
    quick.clear()
    again = StudyRows(path)
    assert again.torn == 39
    assert study(job, 9, again, progress=waits.append) == whole
    assert [state.doing for state in waits[11:]] == [f"campaigns: {n} of 9" for n in (8, 9, 9)]
    assert quick == [8]
    assert path.read_bytes() == data
    quick.clear()
    assert study(job, 9, StudyRows(path)) == whole and quick == []


def test_the_progress_callback_may_end_a_study_and_loses_no_row(job, quick, tmp_path):
    def stop(state):
        if "3 of 9" in state.doing:
            raise LookupError("enough")

    rows = StudyRows(tmp_path / "rows.jsonl")
    with pytest.raises(LookupError, match="enough"):
        study(job, 9, rows, progress=stop)
    assert sorted(rows.of(job.key)) == [0, 1, 2]
    whole = study(job, 9, StudyRows(tmp_path / "rows.jsonl"))
    assert whole == study(job, 9, StudyRows(tmp_path / "other.jsonl"))


def test_a_study_that_does_not_fit_the_time_says_how_many_ran(job, quick, tmp_path):
    """At least one row each time; the same command goes on, and ends as the whole study."""
    short = study(job, 9, StudyRows(tmp_path / "rows.jsonl"), max_minutes=0.0)
    assert (short.campaigns, short.asked, quick) == (1, 9, [0])
    assert "1 of 9 simulated campaigns" in study_text(short) and "the same command goes on" in study_text(short)
    study(job, 9, StudyRows(tmp_path / "rows.jsonl"), max_minutes=0.0)
    whole = study(job, 9, StudyRows(tmp_path / "rows.jsonl"), max_minutes=60.0)
    assert quick == list(range(9)) and whole == study(job, 9, StudyRows(tmp_path / "other.jsonl"))
    assert "stopped" not in study_text(whole)


def test_counts_of_a_perfect_estimator_are_within_bounds_and_of_a_boastful_one_outside(job):
    rows = [invented(job, i) for i in range(400)]
    result = study_result(job, rows)
    left = result.headlines["left"]
    assert left.within and all(h.within for h in result.headlines.values())
    assert left.rms_z == pytest.approx(left.rms_predicted)
    assert left.predicted_over_rms == pytest.approx(1 / left.rms_z)
    assert result.assurance == 0.75
    low, high = result.assurance_interval95
    assert low < 0.75 < high and high - low == pytest.approx(4 * math.sqrt(0.75 * 0.25 / 400), rel=0.1)
    boastful = [
        replace(row, headlines={name: replace(h, sd=0.8 * h.sd) for name, h in row.headlines.items()}) for row in rows
    ]
    assert not study_result(job, boastful).headlines["left"].within
    assert "reported as met by 75.0 %" in study_text(result) and "too few campaigns to decide" not in study_text(result)
    few = study_result(job, [invented(job, i) for i in range(12)])
    assert few.assurance_interval95[0] < 0.8 < few.assurance_interval95[1]
    assert "too few campaigns to decide whether 80 % do" in study_text(few)
    json.dumps(result.as_json(), allow_nan=False)


def test_what_the_priors_hold_fixed_is_not_counted(job):
    """One ratio per axis: the contrasts are 0 with sd 0, and 0 / 0 is no RMS."""
    fixed = dict.fromkeys(("contrast.pan", "contrast.tilt"), HeadlineRow(0.0, 0.0, 0.0, (0.0, 0.0), 0.0, 0.0))
    rows = [replace(row, headlines={**row.headlines, **fixed}) for row in (invented(job, i) for i in range(40))]
    result = study_result(job, rows)
    assert set(TARGETS) - set(result.headlines) == {"contrast.pan", "contrast.tilt"}
    json.dumps(result.as_json(), allow_nan=False)
    assert "contrast" not in study_text(result)


def test_failures_count_against_the_assurance(job):
    rows = [invented(job, i) for i in (1, 2, 3)]
    failed = StudyRow(job.key, 4, 0, False, 0, ("did not settle",), 1.0)
    result = study_result(job, [*rows, failed])
    assert (result.campaigns, result.converged, result.assurance) == (4, 3, 0.75)
    assert result.problems == ("campaign 4: did not settle",)
    with pytest.raises(NotConverged, match="did not settle"):
        study_result(job, [failed])


@pytest.mark.slow
def test_numbers_are_the_same_in_any_number_of_processes(job, tmp_path):
    """One and two spawned processes, resumed in between: each has one thread, so that sums are the same."""
    study(job, 4, StudyRows(tmp_path / "one.jsonl"), engine="processes", workers=1)
    study(job, 2, StudyRows(tmp_path / "two.jsonl"), engine="processes", workers=1)
    study(job, 4, StudyRows(tmp_path / "two.jsonl"), engine="processes", workers=2)

    def numbers(path):
        return {i: replace(row, seconds=0.0) for i, row in StudyRows(path).of(job.key).items()}

    one, other = numbers(tmp_path / "one.jsonl"), numbers(tmp_path / "two.jsonl")
    assert one == other and sorted(one) == [0, 1, 2, 3]
    assert all(row.converged for row in one.values())
